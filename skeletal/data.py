r"""Skeletons and motions for the skeleton-aware networks: any BVH, families of skeletons, ground truth, foot clean-up.

    A.bvh ──► read_rig ──► Structure (reference pose) ──► Motion ──► features (T, 7 + 4 (J - 1)), windows
                                                           │
              derive, proportions ──► Skeleton ──► truth ◄─┘   whole-body IK, not "the same rotations"

Rest poses say nothing and differ from rig to rig (the T-pose problem).  So every rig is first turned to a reference
pose: the mean pose of its own motion, facing forward.  There all joints' frames equal the world's axes (x forward, y
left, z up), offsets are bones as they stand, and quaternions are turns away from that pose.

The characters are ours [GAP: the paper's are Mixamo's, which is not to be had here].  Lengths in metres (or the file's
unit), z up, quaternions w, x, y, z.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from human import PARENTS as HUMAN_PARENTS
from human import (
    SEGMENTS,
    Clip,
    heading,
    quat_about,
    quat_conj,
    quat_continuous,
    quat_mul,
    quat_rotate,
    quat_slerp,
)
from mocap import bvh, data, rigs
from plumbing.cli import UserError
from skeletal.layers import ROOT, Graph, match_primal

RATE = 30.0
CONTACT_SPEED, CONTACT_HEIGHT = 0.45, 0.22  # legs a second, legs above the lowest: ASSUMED, 0.4 m/s and 0.2 m of a man
BLEND = 5  # frames before and after a contact  [SAN, published code]
LOWEST = 10  # per cent of the frames in which a foot stands: there is the floor; in others it may be on tiptoe. ASSUMED
STUB, LENGTHS = 0.12, 0.3  # ASSUMED: a bone shorter than this share of its chain is merged; +- 30 %


# ------------------------------------------------------------------------------------ skeletons and motions


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints of one character in the reference pose.

    names, parents : (J,); offsets : (J, 3) from the parent, row 0 zero; feet : end effectors that stand on the floor
    """

    names: tuple
    parents: tuple
    offsets: np.ndarray
    feet: tuple

    @property
    def graph(self) -> Graph:
        """Its armatures."""
        return Graph(self.parents)

    def rest(self):
        """(J, 3) joints in the reference pose, the root at 0."""
        out = np.zeros_like(self.offsets)
        for j in range(1, len(out)):
            out[j] = out[self.parents[j]] + self.offsets[j]
        return out

    def reach(self, ends=None):
        """(E,) lengths of the end effectors' chains from the root: h_e of [SAN-7]."""
        out = []
        for e in self.graph.leaves if ends is None else ends:
            length = 0.0
            while e:
                length += np.linalg.norm(self.offsets[e])
                e = self.parents[e]
            out.append(length)
        return np.array(out)

    @property
    def leg(self) -> float:
        """The unit of length: mean chain from the root to a foot."""
        return float(self.reach(self.feet).mean())

    @property
    def height(self) -> float:
        """From the lowest to the highest joint of the reference pose."""
        z = self.rest()[:, 2]
        return float(z.max() - z.min())


@dataclass(frozen=True, eq=False)
class Motion:
    """pos (T, 3) of the root, world; quat (T, J, 4), row 0 the root's orientation, others in their parents' frames."""

    name: str
    skeleton: Skeleton
    pos: np.ndarray
    quat: np.ndarray

    def __len__(self):
        return len(self.pos)

    def __getitem__(self, s):
        return replace(self, pos=self.pos[s], quat=self.quat[s])


def pose(m: Motion):
    """World positions (T, J, 3) and orientations (T, J, 4) of the joints.

    Test: tests/skeletal/test_skeletal_data.py::test_pose_and_features_agree"""
    p, g = np.empty((len(m), len(m.skeleton.names), 3)), np.empty_like(m.quat)
    p[:, 0], g[:, 0] = m.pos, m.quat[:, 0]
    for j in range(1, g.shape[1]):
        above = m.skeleton.parents[j]
        p[:, j] = p[:, above] + quat_rotate(g[:, above], np.broadcast_to(m.skeleton.offsets[j], (len(m), 3)))
        g[:, j] = quat_mul(g[:, above], m.quat[:, j])
    return p, g


def locals_of(g, parents):
    """Orientations (T, J, 4) -> rotations in the parents' frames.

    Test      tests/skeletal/test_skeletal_data.py::test_copy_rotations
    """
    out = g.copy()
    for j in range(1, g.shape[1]):
        out[:, j] = quat_mul(quat_conj(g[:, parents[j]]), g[:, j])
    return out


def features(m: Motion):
    r"""What the networks see of a motion  [SAN §4.1's Q and R].

    Departs   the root's place is its velocity in the heading frame, and its orientation what is left when the
              heading is taken out: nothing depends on where and in which direction somebody walks.  The heading
              itself goes from source to target unchanged, and velocities are in legs a frame
    Returns   (T, 7 + 4 (J - 1)) float32; turn : (T,) complex exp(i psi)
    Test      tests/skeletal/test_skeletal_data.py::test_pose_and_features_agree
    """
    psi = heading(m.quat[:, 0])
    leg = m.skeleton.leg
    step = np.diff(m.pos[:, :2], axis=0, prepend=m.pos[:1, :2])
    step[0] = step[1] if len(m) > 1 else 0.0
    v = (step[:, 0] + 1j * step[:, 1]) * np.exp(-1j * psi) / leg
    q = m.quat.copy()
    q[:, 0] = quat_mul(quat_about(2, -psi), q[:, 0])
    q *= np.where(q[..., :1] < 0, -1.0, 1.0)
    root = np.stack([v.real, v.imag, m.pos[:, 2] / leg], axis=1)
    x = np.concatenate([root, q.reshape(len(q), -1)], axis=1)
    return x.astype(np.float32), np.exp(1j * psi)


def from_features(x, turn, skeleton: Skeleton, name="retargeted", start=(0.0, 0.0)) -> Motion:
    """The motion that `features` describes, from a place on the floor on.

    Test: tests/skeletal/test_skeletal_data.py::test_pose_and_features_agree"""
    x = x.astype(float)
    q = np.concatenate([x[:, None, 3:ROOT], x[:, ROOT:].reshape(len(x), -1, 4)], axis=1)
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    q[:, 0] = quat_mul(quat_about(2, np.angle(turn)), q[:, 0])
    step = (x[:, 0] + 1j * x[:, 1]) * turn
    step[0] = 0.0
    path = np.cumsum(step)
    pos = skeleton.leg * np.stack([path.real, path.imag, x[:, 2]], axis=1)
    pos[:, :2] += start
    return Motion(name, skeleton, pos, quat_continuous(q))


def reverse(m: Motion) -> Motion:
    """Backwards in time [SAN, published code].

    Test      tests/skeletal/test_skeletal_data.py::test_pose_and_features_agree"""
    return replace(m, pos=m.pos[::-1].copy(), quat=m.quat[::-1].copy(), name=m.name + "-reversed")


# ------------------------------------------------------------------------------------ any BVH


@dataclass(frozen=True, eq=False)
class Structure:
    """What all files of one rig share, and how to go between a file's frames and the reference pose.

    reference : (J, 4) rotations of the reference pose in the file's frames, row 0 the root's (facing forward)
    end : (J,) is the joint an End Site; up : axis of the file; unit : metres a unit; before : names of joints above
    the root that never move, with their constant transform
    """

    names: tuple
    parents: tuple
    reference: np.ndarray
    feet: tuple
    end: tuple
    up: str
    unit: float


@dataclass(frozen=True, eq=False)
class Raw:
    """One file in its own joint frames, but z up and metres."""

    path: str
    names: tuple
    parents: tuple
    offsets: np.ndarray
    end: tuple
    pos: np.ndarray
    quat: np.ndarray
    rate: float
    unit: float
    forward: np.ndarray | None  # (3,) the root's forward axis in its own frame, where a rig is known


def read_rig(path, up="y", drop=()) -> Raw:
    """Read a BVH of any skeleton.

    Args      up : the file's axis that points up; drop : shell patterns of joints to leave out, with all below them
    Raises    UserError: no BVH, nothing left, or fewer than two bones
    Test      tests/skeletal/test_skeletal_data.py::test_any_bvh
    """
    b = rigs.read(path)
    place, quat = bvh.local(b)
    if np.any(b.offsets[0]) and any("position" in c for c in b.channels[0]):
        added, _ = bvh.local(b, "add")
        low = lambda p: abs(np.percentile(_lowest(b, p, quat, up), 20))  # noqa: E731
        place = added if low(added) < low(place) else place
    names, parents, end = list(b.names), list(b.parents), [False] * len(b.names)
    offsets = np.median(place, axis=0)
    size = np.abs(offsets[1:]).sum() + sum(np.abs(v).sum() for v in b.end_sites.values())
    for name, site in b.end_sites.items():
        if np.linalg.norm(site) > 1e-3 * size / len(names):  # a zero End Site is no bone
            names.append(f"{name}.end"), parents.append(b.names.index(name)), end.append(True)
            offsets = np.vstack([offsets, site])
            quat = np.concatenate([quat, np.tile([1.0, 0.0, 0.0, 0.0], (len(quat), 1, 1))], axis=1)
    pos, q0, root = place[:, 0].copy(), quat[:, 0].copy(), 0
    while parents.count(root) == 1 and np.ptp(pos, axis=0).max() < 1e-6 * size and np.ptp(q0, axis=0).max() < 1e-6:
        child = parents.index(root)  # a dummy above the real root
        local = place[:, child] if child < place.shape[1] else np.broadcast_to(offsets[child], pos.shape)
        pos, q0, root = pos + quat_rotate(q0, local), quat_mul(q0, quat[:, child]), child
    keep = kept_joints(names, parents, root, drop)
    if len(keep) < 3:
        raise UserError(f"{path}: {len(keep) - 1} bones are left; valid: a root and two bones or more")
    at = {j: i for i, j in enumerate(keep)}
    order, signs, turn = rigs.from_file_axes(up)
    quat = quat[:, keep].copy()
    quat[:, 0] = quat_mul(turn, q0)
    pos = pos[:, order] * signs
    unit = 0.01 if size / 2 > 10 else 1.0
    offsets = offsets[keep] * unit
    offsets[0] = 0.0
    forward, known = None, rigs.rig_of(b)
    if known and names[root] == rigs.RIGS[known].joints["pelvis"]:
        forward = quat_rotate(rigs.RIGS[known].calibration("pelvis"), np.array([1.0, 0.0, 0.0]))
    kept = tuple(names[j] for j in keep)
    parents = (-1, *(at[parents[j]] for j in keep[1:]))
    Graph(parents)
    return Raw(
        str(path),
        kept,
        parents,
        offsets,
        tuple(end[j] for j in keep),
        pos * unit,
        quat,
        1.0 / b.frame_time,
        unit,
        forward,
    )


def kept_joints(names, parents, root, drop):
    """Joints below the root, depth first, without the dropped and what hangs from them."""
    out, stack = [], [root]
    while stack:
        j = stack.pop()
        if j != root and any(fnmatchcase(names[j], d) for d in drop):
            continue
        out.append(j)
        stack += [c for c in range(len(names) - 1, -1, -1) if parents[c] == j]
    return out


def _lowest(b, place, quat, up):
    """(T,) height of the lowest joint."""
    p, g = place.copy(), quat.copy()
    for j, above in enumerate(b.parents):
        if above >= 0:
            p[:, j] = p[:, above] + quat_rotate(g[:, above], p[:, j])
            g[:, j] = quat_mul(g[:, above], g[:, j])
    order, signs, _ = rigs.from_file_axes(up)
    return (p[..., order] * signs)[..., 2].min(axis=1)


def structure_of(raws, up="y") -> Structure:
    """The reference pose of a rig, from files of it: their mean pose, facing forward.

    Forward is the pelvis's where mocap/rigs.py knows the rig, else the direction of travel.
    Raises    UserError: files of different skeletons
    Test      tests/skeletal/test_skeletal_data.py::test_any_bvh, test_rest_poses_do_not_matter
    """
    first = raws[0]
    for r in raws[1:]:
        if r.names != first.names or r.parents != first.parents:
            odd = sorted(set(r.names) ^ set(first.names)) or ["the order of its joints"]
            raise UserError(
                f"{r.path}: another skeleton than {first.path}: they differ in {bvh.listed(odd, 8)}; "
                "valid: one rig a folder"
            )
    q = np.concatenate([r.quat[:: max(len(r.quat) // 60, 1)] for r in raws])
    ref = np.stack([mean_quat(q[:, j]) for j in range(q.shape[1])])
    travel, tilts = 0.0, []
    for r in raws:
        yaw = _twist(quat_mul(r.quat[:, 0], quat_conj(first.quat[0, 0])))
        tilts.append(quat_mul(quat_about(2, -yaw), r.quat[:, 0]))
        v = np.diff(r.pos[:, 0] + 1j * r.pos[:, 1])
        travel = travel + np.sum(v * np.exp(-1j * yaw[1:]))
    ref[0] = mean_quat(np.concatenate(tilts))
    ahead = travel
    if first.forward is not None:
        f = quat_rotate(ref[0], first.forward)
        ahead = f[0] + 1j * f[1]
    ref[0] = quat_mul(quat_about(2, -np.angle(ahead)), ref[0])
    s = Structure(first.names, first.parents, ref, (), first.end, up, first.unit)
    skeleton = replace(_skeleton(first, s), feet=(1,))
    height = np.mean([pose(_rebased(r, s, skeleton))[0][::5, :, 2].mean(axis=0) for r in raws[:8]], axis=0)
    leaves = skeleton.graph.leaves
    low = height[leaves] < height.min() + 0.25 * np.ptp(height)
    return replace(s, feet=tuple(int(e) for e, yes in zip(leaves, low) if yes))


def mean_quat(q):
    """The mean rotation of (N, 4): largest eigenvector of sum q q^T, which does not see the sign."""
    return np.linalg.eigh(q.T @ q)[1][:, -1]


def _twist(q):
    """The part of a rotation about the vertical [rad]."""
    return 2.0 * np.arctan2(q[..., 3], q[..., 0])


def references(s: Structure):
    """(J, 4) orientations of the joints in the reference pose, world."""
    g = s.reference.copy()
    for j in range(1, len(g)):
        g[j] = quat_mul(g[s.parents[j]], g[j])
    return g


def _skeleton(r: Raw, s: Structure) -> Skeleton:
    g = references(s)
    offsets = np.zeros_like(r.offsets)
    for j in range(1, len(g)):
        offsets[j] = quat_rotate(g[s.parents[j]], r.offsets[j])
    return Skeleton(s.names, s.parents, offsets, s.feet)


def _rebased(r: Raw, s: Structure, skeleton: Skeleton) -> Motion:
    g, quat = references(s), r.quat.copy()
    above = np.array((0, *s.parents[1:]))
    quat[:, 1:] = quat_mul(quat_mul(g[above[1:]], r.quat[:, 1:]), quat_conj(g[1:]))
    quat[:, 0] = quat_mul(r.quat[:, 0], quat_conj(g[0]))
    return Motion(Path(r.path).stem, skeleton, r.pos.copy(), quat_continuous(quat))


def to_motion(r: Raw, s: Structure) -> Motion:
    """A file in the reference frames of its structure, at 30 Hz.

    Raises    UserError: a skeleton of another structure
    Test      tests/skeletal/test_skeletal_data.py::test_any_bvh
    """
    if set(r.names) != set(s.names):
        lacks = ", ".join(sorted(set(s.names) - set(r.names))[:8]) or "nothing"
        more = ", ".join(sorted(set(r.names) - set(s.names))[:8]) or "nothing"
        raise UserError(
            f"{r.path}: not the trained structure: it lacks {lacks}, and has {more} more; valid: {', '.join(s.names)}"
        )
    order = [r.names.index(n) for n in s.names]
    parents = (-1, *(s.names.index(r.names[r.parents[j]]) for j in order[1:]))
    if parents != tuple(s.parents):
        raise UserError(
            f"{r.path}: the trained structure's names, but joined otherwise; valid parents: {list(s.parents)}"
        )
    r = replace(r, names=s.names, parents=s.parents, offsets=r.offsets[order], quat=r.quat[:, order])
    return _resampled(_rebased(r, s, _skeleton(r, s)), r.rate)


def _resampled(m: Motion, rate) -> Motion:
    if abs(rate - RATE) < 0.05:
        return m
    n = int(np.floor((len(m) - 1) * RATE / rate + 1e-9)) + 1
    t = np.arange(n) * rate / RATE
    i = np.minimum(t.astype(int), max(len(m) - 2, 0))
    k, w = np.minimum(i + 1, len(m) - 1), t - i
    quat = quat_slerp(m.quat[i], m.quat[k], np.broadcast_to(w[:, None], (n, m.quat.shape[1])))
    return replace(m, pos=m.pos[i] + w[:, None] * (m.pos[k] - m.pos[i]), quat=quat_continuous(quat))


def write_motion(path, m: Motion, s: Structure):
    """Write a motion as a BVH in its structure's own frames, units and axes: what its file had, with other angles.

    Raises    UserError: the folder cannot be written
    Test      tests/skeletal/test_skeletal_data.py::test_any_bvh
    """
    g = references(s)
    above = np.array((0, *s.parents[1:]))
    quat = m.quat.copy()
    quat[:, 1:] = quat_mul(quat_mul(quat_conj(g[above[1:]]), m.quat[:, 1:]), g[1:])
    order, signs, turn = rigs.from_file_axes(s.up)
    quat[:, 0] = quat_mul(quat_conj(turn), quat_mul(m.quat[:, 0], g[0]))
    pos = np.empty_like(m.pos)
    pos[:, order] = m.pos * signs / s.unit
    offsets = np.zeros_like(m.skeleton.offsets)
    for j in range(1, len(offsets)):
        offsets[j] = quat_rotate(quat_conj(g[s.parents[j]]), m.skeleton.offsets[j]) / s.unit
    keep = [j for j in range(len(s.names)) if not s.end[j]]
    at = {j: i for i, j in enumerate(keep)}
    ends = {s.names[s.parents[j]]: offsets[j] for j in range(len(s.names)) if s.end[j]}
    parents = np.array([-1] + [at[s.parents[j]] for j in keep[1:]])
    names = [s.names[j].replace(" ", "_") for j in keep]
    try:
        bvh.write(path, names, parents, offsets[keep], 1 / RATE, pos, quat[:, keep], ends)
    except (OSError, bvh.BvhError) as e:
        raise UserError(f"cannot write {path}: {getattr(e, 'strerror', None) or e}") from None


def folder(path, up="y", drop=(), split="all", clips="*", limit=None):
    """All files of one rig in a folder (or one file) -> Structure, list of Motion.

    Raises    UserError: nothing there, several rigs
    Test      tests/skeletal/test_skeletal_data.py::test_any_bvh
    """
    root = Path(path)
    files = sorted(f for f in root.rglob("*") if f.suffix.lower() == ".bvh") if root.is_dir() else [root]
    files = [f for f in files if fnmatchcase(f.stem, clips)]
    chosen = [f for f in files if split == "all" or data.split_of(f.stem) == split]
    if not chosen:
        raise UserError(
            f"{path}: no .bvh file that matches {clips!r} in split {split!r}; valid: a folder that holds some"
        )
    if limit and len(chosen) > limit:
        chosen = [chosen[int(i)] for i in np.linspace(0, len(chosen) - 1, limit)]
    sample = [read_rig(f, up, drop) for f in files[:: -(-len(files) // 20)]]
    s = structure_of(sample, up)
    return s, [to_motion(read_rig(f, up, drop), s) for f in chosen]


def human_motion(clip: Clip) -> Motion:
    """The canonical human (and so the built-in motions) as a Motion: 15 segments and the balls of the feet, constant
    offsets by their mean.  Test: tests/skeletal/test_skeletal_data.py::test_families"""
    names = (*SEGMENTS, "ball_l", "ball_r")
    parents = (*HUMAN_PARENTS, SEGMENTS.index("foot_l"), SEGMENTS.index("foot_r"))
    order = kept_joints(names, parents, 0, ())
    place = np.concatenate([clip.pos, clip.ball], axis=1)
    g = np.concatenate([clip.quat, clip.quat[:, [parents[-2], parents[-1]]]], axis=1)
    offsets = np.zeros((len(names), 3))
    for j in range(1, len(names)):
        offsets[j] = quat_rotate(quat_conj(g[:, parents[j]]), place[:, j] - place[:, parents[j]]).mean(axis=0)
    above = (-1, *(order.index(parents[j]) for j in order[1:]))
    skeleton = Skeleton(tuple(names[j] for j in order), above, offsets[order], tuple(order.index(j) for j in (15, 16)))
    return Motion(clip.name, skeleton, clip.pos[:, 0].copy(), quat_continuous(locals_of(g[:, order], above)))


def aligned(b: Skeleton, a: Skeleton) -> np.ndarray:
    """The order of b's joints in which its primal skeleton is a's (`skeletal.layers.match_primal`).

    Test: tests/skeletal/test_skeletal_data.py::test_families"""
    return match_primal(a.graph, b.graph, a.rest() / a.leg, b.rest() / b.leg, a.names, b.names)


# ------------------------------------------------------------------------------------ families of skeletons


def derive(a: Skeleton) -> Skeleton:
    r"""A second structure from a first  [GAP; the published code splits three joints to widen the gap].

    Method    by the graph alone: the longest bone of the trunk and of every foot's chain is split in two; a bone inside
              a chain of three or more that is shorter than 12 % of it is merged with the one above (the collar bones)
    Returns   Skeleton; new joints are called NAME.half
    Test      tests/skeletal/test_skeletal_data.py::test_families
    """
    parents, offsets, gone, halves = list(a.parents), a.offsets.copy(), set(), set()
    lengths = np.linalg.norm(offsets, axis=1)
    for chain in a.graph.chains()[1:]:
        trunk = chain[-1] not in a.graph.leaves
        if trunk or chain[-1] in a.feet:
            halves.add(chain[int(np.argmax(lengths[chain]))])
        elif len(chain) >= 3:
            for j in chain[1:-1]:
                if lengths[j] < STUB * lengths[chain].sum():
                    gone.add(parents[j])
                    offsets[j] = offsets[j] + offsets[parents[j]]
                    parents[j] = parents[parents[j]]
                    break
    names, above, out, at = [], [], [], {}
    for j, name in enumerate(a.names):
        if j in gone:
            continue
        p = at[parents[j]] if j else -1
        offset = offsets[j]
        if j in halves:
            names.append(name + ".half"), above.append(p), out.append(offset / 2)
            p, offset = len(names) - 1, offset / 2
        at[j] = len(names)
        names.append(name), above.append(p), out.append(offset)
    return Skeleton(tuple(names), tuple(above), np.array(out), tuple(at[f] for f in a.feet))


def proportions(s: Skeleton, rng, spread=LENGTHS) -> Skeleton:
    """The same structure with every bone 1 +- spread times as long, left as right.

    Test: tests/skeletal/test_skeletal_data.py::test_families"""
    rest = s.rest()
    scale = rng.uniform(1 - spread, 1 + spread, len(s.names))
    mirrored = np.linalg.norm(rest[None] * [1, -1, 1] - rest[:, None], axis=-1)
    depth = np.array([_depth(s.parents, j) for j in range(len(rest))])
    mirrored[depth[:, None] != depth[None]] = np.inf
    twin = mirrored.argmin(axis=1)
    scale = np.array([scale[min(j, twin[j])] if twin[twin[j]] == j else scale[j] for j in range(len(rest))])
    return replace(s, offsets=s.offsets * scale[:, None])


def _depth(parents, j):
    return 0 if j <= 0 else 1 + _depth(parents, parents[j])


# ------------------------------------------------------------------------------------ copies, inverse kinematics, truth

COPIES = ("names", "spread", "global")


def copy_rotations(m: Motion, target: Skeleton, how="global") -> Motion:
    r"""The baseline: the source's rotations on the target's bones, its root's path in the target's legs.

    Args      how : what becomes of joints that only one of the two has.
              names : rotations are copied by name; a joint the target alone has does not turn, one the source alone has
              is lost;
              global : a joint keeps its orientation in the world, so that what is lost is made up for below it; a joint
              the target alone has does not turn;
              spread : the same, and a joint the target alone has takes half of the next one's rotation
    Test      tests/skeletal/test_skeletal_data.py::test_copy_rotations
    """
    index = {n: j for j, n in enumerate(m.skeleton.names)}
    pos = m.pos * (target.leg / m.skeleton.leg)
    local = np.zeros((len(m), len(target.names), 4))
    local[..., 0] = 1.0
    shared = [j for j, n in enumerate(target.names) if n in index]
    if how == "names":
        for j in shared:
            local[:, j] = m.quat[:, index[target.names[j]]]
        return Motion(m.name, target, pos, local)
    source = pose(m)[1]
    g = local.copy()
    for j, name in enumerate(target.names):
        above = target.parents[j]
        g[:, j] = source[:, index[name]] if name in index else g[:, above]
    local = locals_of(g, target.parents)
    if how == "spread":
        one = np.broadcast_to([1.0, 0.0, 0.0, 0.0], local[:, 0].shape)
        for j, name in enumerate(target.names):
            below = [c for c, p in enumerate(target.parents) if p == j]
            if name not in index and len(below) == 1:
                half = quat_slerp(one, local[:, below[0]], np.full(len(m), 0.5))
                local[:, j], local[:, below[0]] = half, quat_mul(quat_conj(half), local[:, below[0]])
    return Motion(m.name, target, pos, quat_continuous(local))


def solve_ik(m: Motion, goals, iterations=10, damping=0.05) -> Motion:
    r"""Damped least squares for all frames at once.

    Equation  d omega = W J^T (J W J^T + lambda^2 I)^-1 (goal - p_e), J = d p_e / d omega = -[p_e - p_j]_x a joint j
    Args      goals : list of (joint e, (T, 3) goal, movable joints, their weights W); each joint in one goal at most
              damping : lambda in lengths of the leg
    Method    a stretched limb swings about its goal: of every frame the best iterate is kept
    Returns   Motion; the root stays
    Test      tests/skeletal/test_skeletal_data.py::test_ik_reaches
    """
    quat, parents = m.quat.copy(), m.skeleton.parents
    lam = (damping * m.skeleton.leg) ** 2 * np.eye(3)
    best, least = quat.copy(), np.full((len(goals), len(m)), np.inf)
    for turn in range(iterations + 1):
        p, g = pose(replace(m, quat=quat))
        for i, (e, goal, joints, weights) in enumerate(goals):
            off = np.linalg.norm(goal - p[:, e], axis=1)
            better = off < least[i]
            least[i] = np.where(better, off, least[i])
            for j in joints:
                best[better, j] = quat[better, j]
            if turn == iterations:
                continue
            arm = p[:, e, None] - p[:, list(joints)]  # (T, n, 3)
            J = np.zeros((*arm.shape, 3))  # (T, n, 3 of p, 3 of omega)
            J[..., 0, 1], J[..., 0, 2], J[..., 1, 2] = arm[..., 2], -arm[..., 1], arm[..., 0]
            J -= np.swapaxes(J, -1, -2)
            w = np.asarray(weights, float)[None, :, None, None]
            A = (w * (J @ np.swapaxes(J, -1, -2))).sum(axis=1) + lam
            y = np.linalg.solve(A, (goal - p[:, e])[..., None])
            omega = (w * (np.swapaxes(J, -1, -2) @ y[:, None]))[..., 0]  # (T, n, 3), world
            angle = np.linalg.norm(omega, axis=-1, keepdims=True)
            omega *= np.minimum(1.0, 0.3 / np.maximum(angle, 1e-12))  # at most 0.3 rad a step
            half = 0.5 * np.linalg.norm(omega, axis=-1, keepdims=True)
            spin = np.concatenate([np.cos(half), 0.5 * omega * np.sinc(half / np.pi)], axis=-1)
            for k, j in enumerate(joints):
                above = g[:, parents[j]]
                quat[:, j] = quat_mul(quat_mul(quat_conj(above), quat_mul(spin[:, k], above)), quat[:, j])
    return replace(m, quat=best / np.linalg.norm(best, axis=-1, keepdims=True))


def _limb(s: Skeleton, leaf):
    """The primal edge that ends in a leaf: its joints from the root outwards."""
    return next(c for c in s.graph.chains() if c[-1] == leaf)


def _stiffness(s: Skeleton, joints):
    """A joint made by splitting a limb bends little.  ASSUMED: 0.1."""
    return [0.1 if s.names[j].endswith(".half") else 1.0 for j in joints]


def truth(m: Motion, target: Skeleton) -> Motion:
    r"""What another character should do  [GAP], by whole-body IK: a copy of rotations is not perfect by construction.

    Equation  p_e - p_b = (L_e^target / L_e^source) (p_e - p_b)^source, L_e the limb's length from b on.  For a foot b
              is the root and the root moves in the same ratio, so that feet stand where they stood: contacts are kept.
              For a hand b is the limb's first joint (the bone before it turns with the trunk and cannot reach).  Ends
              of limbs of fewer than three bones (a head on its neck) go where the copy has them: nothing can bend
    Method    start from `copy_rotations`, then IK a limb.  Feet keep their orientation: the goal is the ankle's
    Returns   Motion of the target
    Test      tests/skeletal/test_skeletal_data.py::test_truth_keeps_ends_and_contacts
    """
    out = copy_rotations(m, target, "global")
    trunk = [c for c in target.graph.chains()[1:] if c[-1] not in target.graph.leaves]
    spread = copy_rotations(m, target, "spread")
    quat = out.quat.copy()
    for chain in trunk:  # extra joints of the trunk bend with it
        quat[:, chain] = spread.quat[:, chain]
    out = replace(out, quat=quat)
    p_source, _ = pose(m)
    for leaf in target.graph.leaves:
        name = target.names[leaf]
        chain, chain_s = _limb(target, leaf), _limb(m.skeleton, m.skeleton.names.index(name))
        if len(chain) < 3 or len(chain_s) < 2:
            continue  # a neck: nothing to bend
        hand = leaf not in target.feet
        base, base_s = (chain[0], chain_s[0]) if hand else (0, 0)
        # For a foot all bones from the root, in case the limb begins further out: the root's ratio is of those.
        length = lambda s, c: (  # noqa: E731
            np.linalg.norm(s.offsets[c[1:]], axis=1).sum() if hand else s.reach(c[-1:])[0]  # noqa: B023
        )
        ratio = length(target, chain) / length(m.skeleton, chain_s)
        p, g = pose(out)
        goal = p[:, base] + ratio * (p_source[:, chain_s[-1]] - p_source[:, base_s])
        if leaf in target.feet and len(chain) > 3:
            ankle = target.parents[leaf]
            keep = g[:, ankle].copy()
            goal = goal - quat_rotate(keep, np.broadcast_to(target.offsets[leaf], goal.shape))
            out = solve_ik(out, [(ankle, goal, chain[:-2], _stiffness(target, chain[:-2]))])
            out = _hold(out, ankle, keep)
        else:
            out = solve_ik(out, [(leaf, goal, chain[:-1], _stiffness(target, chain[:-1]))])
    return replace(out, quat=quat_continuous(out.quat), name=m.name)


def _hold(m: Motion, joint, orientation) -> Motion:
    """Turn one joint so that its orientation in the world is the given one."""
    above = pose(m)[1][:, m.skeleton.parents[joint]]
    quat = m.quat.copy()
    quat[:, joint] = quat_mul(quat_conj(above), orientation)
    return replace(m, quat=quat)


# ------------------------------------------------------------------------------------ feet and errors


def contacts(m: Motion) -> np.ndarray:
    r"""(T, F) bool: the foot stands, that is, its end (the ball or the toes) is low and slow  [SAN §5.2, clean-up].

    Test      tests/skeletal/test_skeletal_data.py::test_foot_cleanup
    """
    p, _ = pose(m)
    out = np.zeros((len(m), len(m.skeleton.feet)), bool)
    if len(m) == 1:  # a pose has no speed
        return out
    for i, f in enumerate(m.skeleton.feet):
        speed = np.linalg.norm(np.gradient(p[:, f], axis=0), axis=1) * RATE / m.skeleton.leg
        low = p[:, f, 2] - np.percentile(p[:, f, 2], 5) < CONTACT_HEIGHT * m.skeleton.leg
        out[:, i] = (speed < CONTACT_SPEED) & low
    return out


def stand_heights(m: Motion, standing) -> np.ndarray:
    """(F,) how high a foot's end is where it stands, in legs: the lowest tenth's; the lowest of one that never stands.

    Test      tests/skeletal/test_skeletal_data.py::test_stand_heights"""
    z = pose(m)[0][:, list(m.skeleton.feet), 2] / m.skeleton.leg
    return np.array([np.percentile(h[s], LOWEST) if s.any() else h.min() for h, s in zip(z.T, standing.T)])


def lowered(m: Motion, standing, heights) -> Motion:
    """The body moved up or down, smoothly in time, so that feet that stand are at their heights (T, F) [m] in the mean.

    Test      tests/skeletal/test_skeletal_data.py::test_feet_come_to_the_floor"""
    some = standing.any(axis=1)
    if not some.any():
        return m
    off = np.where(standing, heights - pose(m)[0][:, list(m.skeleton.feet), 2], 0.0).sum(axis=1)
    t = np.arange(len(m))
    off = np.interp(t, t[some], off[some] / standing[some].sum(axis=1))
    return replace(m, pos=m.pos + [0.0, 0.0, 1.0] * gaussian_filter1d(off, BLEND, mode="nearest")[:, None])


def clean_feet(m: Motion, standing, heights=None) -> Motion:
    r"""Foot clean-up  [SAN §5.2]: while a foot stands, it stays at the mean of its places; blended in and out over +- 5
    frames with a smooth step; by damped least squares on the leg; the foot keeps its orientation.  A leg that ends at
    the ankle is solved for its end.

    Equation  shift = sum_k v_k w_k (goal_k - p_k) / sum_k v_k,  v = w / (1 - w), w the smooth step of stance k, p_k the
              foot, before and after the stance at its edge: within a stance it alone counts
    Args      standing : (T, F) contacts of the input motion; heights : (T, F) [m], where its feet's ends should be:
              the body is `lowered`, and each stance's mean height is the wanted one.  ASSUMED
    Test      tests/skeletal/test_skeletal_data.py::test_foot_cleanup, test_feet_come_to_the_floor,
              test_stances_are_blended
    """
    out = m if heights is None else lowered(m, standing, heights)
    for i, f in enumerate(m.skeleton.feet):
        chain = _limb(m.skeleton, f)
        if len(chain) < 3:
            continue
        ankle, leg = (m.skeleton.parents[f], chain[:-2]) if len(chain) > 3 else (f, chain[:-1])
        p, g = pose(out)
        shift, shares = np.zeros((len(m), 3)), np.zeros((len(m), 1))
        edges = np.flatnonzero(np.diff(np.concatenate([[0], standing[:, i].astype(int), [0]])))
        for a, b in edges.reshape(-1, 2):
            goal = p[a:b, f].mean(axis=0)
            if heights is not None:
                goal[2] = heights[a:b, i].mean()
            t = np.arange(max(a - BLEND, 0), min(b + BLEND, len(m)))
            away = np.maximum(a - t, t - b + 1).clip(0) / (BLEND + 1)
            w = (1 - away * away * (3 - 2 * away))[:, None]
            v = w / (1 - w + 1e-9)
            shift[t] += v * w * (goal - p[t.clip(a, b - 1), f])
            shares[t] += v
        shift /= np.maximum(shares, 1e-12)
        keep = g[:, ankle].copy()
        out = solve_ik(out, [(ankle, p[:, ankle] + shift, leg, _stiffness(m.skeleton, leg))])
        out = _hold(out, ankle, keep)
    return out


def sliding(m: Motion, standing) -> float:
    """Mean speed of the feet's ends on the floor plane while they should stand [m/s].

    Test: tests/skeletal/test_skeletal_data.py::test_foot_cleanup"""
    p, _ = pose(m)
    v = np.linalg.norm(np.diff(p[:, list(m.skeleton.feet), :2], axis=0), axis=-1) * RATE
    both = standing[1:] & standing[:-1]
    return float(v[both].mean()) if both.any() else 0.0


def error(m: Motion, true: Motion, root=True) -> float:
    r"""The paper's measure: mean over frames, joints and axes of ((p - p_true) / height)^2.

    Where on the floor the root of the first frame is does not count: a motion may begin anywhere.
    Args      root : False compares joints relative to the root
    Test      tests/skeletal/test_skeletal_data.py::test_error
    """
    p, q = pose(m)[0], pose(true)[0]
    start = p[:1, :1] - q[:1, :1]
    start[..., 2] = 0.0
    d = p - q - start if root else (p - p[:, :1]) - (q - q[:, :1])
    return float(np.mean((d / true.skeleton.height) ** 2))


def note(text):
    """A line for the user that is no result."""
    print(text, file=sys.stderr)

r"""Real rigs as data: different structures, different people, no pairs; and truth that no network and no IK here made.

    capture file ──► mocap ──► canonical human (Clip) ──► `put_on` another rig, or §3.4's `retarget` onto a character
         └─────────► read_rig ──► Motion in the rig's own joints                       the truth of a pair

    human     15 segments and the balls of the feet: how every file comes in whose rig `mocap` can read
    bandai    21 joints; lafan1  22; cmu  31, of AMC files; jesse, oppy, dino: bodies of the trained characters

A motion on the canonical human says how every segment has turned from upright.  A rig's joints have turned with them,
by a constant that its own files show (`calibration`).  So one clip has a true pose on every rig.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

import character
from human import SEG, SEGMENTS, Clip, quat_conj, quat_continuous, quat_mul, quat_rotate, quat_slerp, resample
from mocap import amc, rigs
from mocap import data as captures
from plumbing.cli import UserError
from retarget import forward_kinematics, retarget
from skeletal import data
from skeletal.data import RATE, Motion, Raw, Skeleton, Structure, human_motion, locals_of, pose

CHARACTERS = ("jesse", "oppy", "dino")
RIGS = ("human", "bandai", "lafan1", "cmu", *CHARACTERS)
DROPPED = {  # what the common primal skeleton has not
    "cmu": ("*thumb", "*fingers"), "oppy": ("tail*", "ear*"), "dino": ("tail*",),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Rig:
    """A rig, one body of it, and how its joints stand when the canonical human stands upright.

    structure : of its files; skeleton : one body's; home : (J,) segment above, segment below and the share of the way
    between them, of every joint; upright : (J, 4) orientation of each joint, reference frames, when the human is
    upright; segments : joint -> the human's segment that it is; character : for `retarget`, None for a human's rig
    """

    name: str
    structure: Structure
    skeleton: Skeleton
    home: tuple
    upright: np.ndarray
    segments: dict
    character: object = None


# ------------------------------------------------------------------------------------ files -> motions and clips


def both(path, drop=()):
    """One capture file -> Raw of its own joints, Clip of the canonical human, joint of every segment.

    Raises    UserError: no BVH or AMC, or a rig that mocap cannot read
    Test      tests/skeletal/test_skeletal_rigs.py::test_both_readings_agree
    """
    if rigs.is_amc(path):
        s, motion = rigs.read_amc(path)
        rig, clip = rigs.cmu_rig(s), rigs.from_amc(path)
        p, g = amc.global_pose(s, motion)
        raw = _raw(path, s.names, tuple(s.parents), p, g, clip.rate, rig.unit, drop)
        return raw, clip, rig.joints
    clip = captures.from_bvh(path)
    rig, _ = captures.rig_for(rigs.read(path, quiet=True))
    return data.read_rig(path, drop=drop), clip, rig.joints


def _raw(path, names, parents, p, g, rate, unit, drop, up="y") -> Raw:
    """Raw from global positions and orientations in a file's units and axes."""
    keep = data.kept_joints(names, parents, 0, drop)
    at = {j: i for i, j in enumerate(keep)}
    parents = (-1, *(at[parents[j]] for j in keep[1:]))
    p, g = p[:, keep], g[:, keep].copy()
    order, signs, turn = rigs.from_file_axes(up)
    offsets = np.zeros((len(keep), 3))
    for j in range(1, len(keep)):
        above = parents[j]
        offsets[j] = quat_rotate(quat_conj(g[:, above]), p[:, j] - p[:, above]).mean(axis=0)
    quat = locals_of(g, parents)
    quat[:, 0] = quat_mul(turn, g[:, 0])
    names = tuple(names[j] for j in keep)
    end = (False,) * len(keep)
    return Raw(str(path), names, parents, offsets * unit, end, p[:, 0, order] * signs * unit, quat, rate, unit, None)


def on_character(char, clip: Clip, name) -> Raw:
    """[Reda23 §3.4]'s kinematic pose of a character as a file of its bodies.  A foot ends twice as far
    from its joint as its centre of mass is: under the toes, 2 to 4 cm below the sole in the default pose (ASSUMED).

    Test      tests/skeletal/test_skeletal_rigs.py::test_character_as_rig
    """
    return _bodies(char, retarget(char, clip).qpos, clip.name, clip.rate, name)


def default_pose(char, name) -> Raw:
    """Two frames of a character that stands as the human does when it stands upright."""
    root = np.concatenate([[0.0, 0.0, char.hip_height], char.rest[char.root], char.default])
    return _bodies(char, np.tile(root, (2, 1)), "default", RATE, name)


def _bodies(char, qpos, title, rate, name) -> Raw:
    m, fk = char.model, forward_kinematics(char, qpos)
    bodies = [b for b in range(1, m.nbody) if m.body_rootid[b] == char.root]
    names = [m.body(b).name for b in bodies]
    parents = [-1] + [bodies.index(m.body_parentid[b]) for b in bodies[1:]]
    p, g = fk.xpos[:, bodies], fk.xquat[:, bodies]
    for side in "lr":
        b = bodies.index(m.body(f"foot_{side}").id)
        tip = p[:, b] + quat_rotate(g[:, b], np.broadcast_to(2.0 * m.body_ipos[bodies[b]], p[:, b].shape))
        names.append(f"foot_{side}.end"), parents.append(b)
        p, g = np.concatenate([p, tip[:, None]], axis=1), np.concatenate([g, g[:, b : b + 1]], axis=1)
    raw = _raw(title, names, tuple(parents), p, g, rate, 1.0, DROPPED.get(name, ()), "z")
    return replace(raw, end=tuple(n.endswith(".end") for n in raw.names), forward=np.array([1.0, 0.0, 0.0]))


def _home(names, parents, joints):
    """(J,) of (segment above, segment below, share): a joint between two known ones has turned part of the way."""
    segment = {joint: SEG[s] for s, joint in joints.items()}
    known = [segment.get(n) for n in names]
    known[0] = SEG["pelvis"]
    out = []
    for j in range(len(names)):
        up, k = 0, j
        while known[k] is None:
            k, up = parents[k], up + 1
        below, down = _below(parents, known, j)
        between = up and below is not None
        out.append((known[k], below if between else known[k], up / (up + down) if between else 0.0))
    return tuple(out)


def _below(parents, known, j):
    """The known segment that a joint without branches leads to, and how far it is."""
    down = 0
    while known[j] is None:
        children = [c for c, p in enumerate(parents) if p == j]
        if len(children) != 1:
            return None, 1
        j, down = children[0], down + 1
    return known[j], down


def turned(clip: Clip, home) -> np.ndarray:
    """(T, J, 4) how every joint's surroundings have turned from upright, world."""
    a, b, w = (np.array(v) for v in zip(*home))
    n = len(clip)
    return quat_slerp(clip.quat[:, a], clip.quat[:, b], np.broadcast_to(w, (n, len(w))))


def calibration(pairs, home) -> np.ndarray:
    r"""(J, 4) C_j: joint j's orientation when the canonical human stands upright.

    Equation  C_j = mean over frames of Q_j^-1 G_j, Q_j how j's segments have turned, G_j its orientation
    Args      pairs : (Motion, Clip) of the same frames
    Test      tests/skeletal/test_skeletal_rigs.py::test_put_on_is_the_file_again
    """
    q = np.concatenate([quat_mul(quat_conj(turned(c, home)), pose(m)[1])[::5] for m, c in pairs])
    return np.stack([data.mean_quat(q[:, j]) for j in range(q.shape[1])])


def load(name, paths, character_clips=None) -> tuple:
    """A rig and its motions  -> Rig, list of (Motion, Clip) at 30 Hz, all of one structure.

    Args      name : of `RIGS`; paths : capture files; for the human and the characters: any that mocap reads
              character_clips : instead of paths, canonical clips (human and characters)
    Raises    UserError: no such rig, no file
    Test      tests/skeletal/test_skeletal_rigs.py::test_put_on_is_the_file_again, test_character_as_rig
    """
    if name not in RIGS:
        raise UserError(f"--rigs {name}: no such rig; valid: {', '.join(RIGS)}")
    if name == "human" or name in CHARACTERS:
        clips = character_clips or [at_30(c) for p in paths for c in captures.read_clips([p])]
        return _human(clips) if name == "human" else _character(name, clips)
    read = [both(p, DROPPED.get(name, ())) for p in paths]
    if not read:
        raise UserError(f"no file of the rig {name}; valid: a folder of such captures")
    s = data.structure_of([r for r, _, _ in read])
    pairs = [(data.to_motion(r, s), at_30(c)) for r, c, _ in read]
    pairs = [(m[: len(c)], c[: len(m)]) for m, c in pairs]
    pairs = [(replace(m, pos=m.pos + _floor_shift(m, c)), c) for m, c in pairs]
    home = _home(s.names, s.parents, read[0][2])
    segments = {joint: segment for segment, joint in read[0][2].items()}
    return Rig(name, s, pairs[0][0].skeleton, home, calibration(pairs, home), segments), pairs


def at_30(clip: Clip) -> Clip:
    """A clip at the networks' rate."""
    return clip if abs(clip.rate - RATE) < 0.05 else resample(clip, RATE)


def _floor_shift(m, clip):
    """mocap may have put a capture on the floor, or have levelled it; the root's height follows."""
    return np.array([0.0, 0.0, np.median(clip.pos[:, 0, 2] - _hips(m.skeleton, pose(m)[0])[:, 2])])


def _hips(s: Skeleton, p):
    """Midpoint of where the two legs begin."""
    starts = [next(c for c in s.graph.chains() if c[-1] == f) for f in s.feet]
    first = [c[0] if np.linalg.norm(s.offsets[c[0]]) > 0.02 * s.leg else c[min(1, len(c) - 1)] for c in starts]
    return p[:, first].mean(axis=1)


def human_raw(clip: Clip) -> Raw:
    """The canonical human as a file of its own, at 30 Hz: what any rig that mocap reads becomes."""
    m = human_motion(clip)
    k, ahead = m.skeleton, np.array([1.0, 0.0, 0.0])
    return Raw(clip.name, k.names, k.parents, k.offsets, (False,) * len(k.names), m.pos, m.quat, RATE, 1.0, ahead)


def _human(clips):
    """The canonical human as a rig of files: turned to the mean pose of its own motion, as every rig is."""
    raws = [human_raw(c) for c in clips]
    s = data.structure_of(raws, "z")
    pairs = [(data.to_motion(r, s), c) for r, c in zip(raws, clips)]
    home = _home(s.names, s.parents, {n: n for n in SEGMENTS})
    same = {n: n for n in SEGMENTS}
    return Rig("human", s, pairs[0][0].skeleton, home, calibration(pairs, home), same), pairs


def _character(name, clips):
    char = character.load(name)
    raws = [on_character(char, c, name) for c in clips]
    s = data.structure_of(raws, "z")
    pairs = [(data.to_motion(r, s), c) for r, c in zip(raws, clips)]
    home = ((0, 0, 0.0),) * len(s.names)
    same = {n: n for n in s.names if n in SEGMENTS}  # the bodies of our characters are called as segments are
    return Rig(name, s, pairs[0][0].skeleton, home, np.tile([1.0, 0, 0, 0], (len(s.names), 1)), same, char), pairs


def character_of(name):
    """The Character that a rig is of, or None."""
    return character.load(name) if name in CHARACTERS else None


# ------------------------------------------------------------------------------------ truth


def put_on(clip: Clip, rig: Rig, skeleton: Skeleton) -> Motion:
    r"""The true motion of a clip on another rig and another body: its segments turn as the human's do.

    Equation  G_j = Q_j C_j (`calibration`); the hips' midpoint moves in the ratio of the legs.  A character moves as
              [Reda23 §3.4] says, but its root travels in the ratio of the legs, too: its path is no error of a pose
    Test      tests/skeletal/test_skeletal_rigs.py::test_put_on_is_the_file_again, test_character_as_rig
    """
    if rig.character is not None:
        m = data.to_motion(on_character(rig.character, clip, rig.name), rig.structure)
        human = human_motion(clip)
        pos = m.pos.copy()
        pos[:, :2] *= skeleton.leg / human.skeleton.leg
        return replace(m, pos=pos)
    g = quat_mul(turned(clip, rig.home), rig.upright)
    m = Motion(clip.name, skeleton, np.zeros((len(clip), 3)), quat_continuous(locals_of(g, skeleton.parents)))
    hips = _hips(skeleton, pose(m)[0])
    return replace(m, pos=clip.pos[:, 0] * _leg_ratio(clip, m) - hips)


def _leg_ratio(clip: Clip, m: Motion):
    """Thigh and shin of a body against the clip's."""
    p = pose(m)[0]
    hips, low = _hips(m.skeleton, p), [m.skeleton.parents[f] for f in m.skeleton.feet]
    mine = np.mean(np.max(np.linalg.norm(p[:, low] - hips[:, None], axis=-1), axis=0))
    feet = clip.pos[:, [SEG["foot_l"], SEG["foot_r"]]] - clip.pos[:, :1]
    return mine / np.mean(np.max(np.linalg.norm(feet, axis=-1), axis=0))


def raw_of(m: Motion, s: Structure) -> Raw:
    """A motion in its file's own joint frames again, z up and metres: the way back from `data.to_motion`.

    Test      tests/skeletal/test_skeletal_correct.py::test_rebased"""
    g = data.references(s)
    above = np.array((0, *s.parents[1:]))
    quat = m.quat.copy()
    quat[:, 1:] = quat_mul(quat_mul(quat_conj(g[above[1:]]), m.quat[:, 1:]), g[1:])
    quat[:, 0] = quat_mul(m.quat[:, 0], g[0])
    offsets = quat_rotate(quat_conj(g[above]), m.skeleton.offsets)
    return Raw(m.name, s.names, s.parents, offsets, s.end, m.pos.copy(), quat, RATE, s.unit, None)


# ------------------------------------------------------------------------------------ which joint is which


def partners(a: Skeleton, b: Skeleton) -> list:
    r"""For every joint of b its counterpart in a, or None: along each primal edge the joints that lie nearest to one
    another, as shares of the edge's length, one to one; ends meet ends.  No names: two rigs have none in common.

    Args      a, b : of one primal skeleton, in one order (`data.aligned`)
    Test      tests/skeletal/test_skeletal_rigs.py::test_partners
    """
    out = [None] * len(b.names)
    for ca, cb in zip(a.graph.chains(), b.graph.chains()):
        at = [_shares(s, c) for s, c in ((a, ca), (b, cb))]
        cost = np.abs(at[0][:, None] - at[1][None])
        cost[-1, :-1] = cost[:-1, -1] = 9.0
        for i, k in zip(*linear_sum_assignment(cost)):
            if cost[i, k] < 9.0:
                out[cb[k]] = ca[i]
    return out


def _shares(s: Skeleton, chain):
    length = np.cumsum(np.linalg.norm(s.offsets[chain], axis=1))
    return length / max(length[-1], 1e-9)


def named_as(b: Skeleton, a: Skeleton) -> Skeleton:
    """b with its joints called as their partners in a, so that what goes by names (copies, IK) can go between rigs."""
    names = [f"only:{n}" if k is None else a.names[k] for n, k in zip(b.names, partners(a, b))]
    return replace(b, names=tuple(names))


def copied(m: Motion, target: Skeleton) -> Motion:
    """The baseline between two rigs: partners keep their orientation against the reference pose.

    Test      tests/skeletal/test_skeletal_rigs.py::test_partners"""
    return replace(data.copy_rotations(m, named_as(target, m.skeleton), "global"), skeleton=target)


def solved(m: Motion, target: Skeleton) -> Motion:
    """The wing's inverse kinematics between two rigs: the copy, whose limbs are then bent (`data.truth`)."""
    return replace(data.truth(m, named_as(target, m.skeleton)), skeleton=target)


def in_order(rig: Rig, pairs, first: Skeleton):
    """The same rig and motions with joints in the order in which the primal skeleton reads as `first`'s.

    Raises    UserError: no common primal skeleton"""
    from_old = data.aligned(rig.skeleton, first)
    at = {int(j): i for i, j in enumerate(from_old)}
    s = rig.structure
    parents = (-1, *(at[s.parents[j]] for j in from_old[1:]))
    feet = tuple(sorted(at[f] for f in s.feet))
    s = replace(s, names=tuple(s.names[j] for j in from_old), parents=parents, reference=s.reference[from_old],
                feet=feet, end=tuple(s.end[j] for j in from_old))  # fmt: skip

    def body(k: Skeleton):
        return Skeleton(s.names, parents, k.offsets[from_old], feet)

    pairs = [(replace(m, skeleton=body(m.skeleton), quat=m.quat[:, from_old]), c) for m, c in pairs]
    home = tuple(rig.home[j] for j in from_old)
    return replace(rig, structure=s, skeleton=body(rig.skeleton), home=home, upright=rig.upright[from_old]), pairs


def captured(motion, folder, name, split, limit) -> tuple:
    """(Rig, pairs) of the captures of a rig in a folder of --motion.  UserError: there are none"""
    if not (found := files(Path(motion) / folder, name, split, limit)):
        raise UserError(f"--motion {motion}: no {split} file of {name} in {folder}/; valid: a folder with {folder}/")
    return load(name, found)


def files(motion, name, split, limit) -> list:
    """Capture files of a folder that have the rig NAME, of one split, evenly chosen."""
    root = Path(motion)
    found = sorted(f for f in root.rglob("*") if f.suffix.lower() in (".bvh", ".amc"))
    found = [f for f in found if rigs.is_amc(f) == (name == "cmu")]
    found = [f for f in found if split == "all" or captures.split_of(f) == split]
    if limit and len(found) > limit:
        found = [found[int(i)] for i in np.linspace(0, len(found) - 1, limit)]
    return found

r"""Human pose -> character pose  [Reda23 §3.4].

    Clip ──► retarget ──► qpos, qvel         joint map, default pose, scaled root
         └─► reference ──► Reference         everything the environment compares with, one row a control step

The kinematic pose slides, floats and sinks: it is a training signal, not a result.

    python retarget.py --character jesse --motion PATH [--png OUT | --video OUT | --bvh OUT]
    python retarget.py --motion PATH --bvh OUT --bvh-names unity       its joints as Mixamo, Unity or VRM call them
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import character
import mocap.data
from character import Character, geom_lowest
from human import (
    FEET,
    PARENTS,
    SEG,
    SENSORS,
    Clip,
    angular_velocity,
    contacts,
    heading,
    headset_height,
    linear_velocity,
    quat_about,
    quat_conj,
    quat_continuous,
    quat_matrix,
    quat_mul,
    quat_rotate,
    sensors,
)
from mocap import humanoid
from mocap.bvh import BvhError, write
from mocap.data import MotionFlags, load
from mocap.rigs import Reading
from plumbing.cli import PNG, UserError, arg, cli, run_main
from plumbing.files import check_folders

STAGE_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)

# ------------------------------------------------------------------------------------ geometry on the model


def body_velocity(cvel, xpos, com):
    r"""Linear velocity of body origins from MuJoCo's centre-of-mass based spatial velocities.

    Equation  ẋ = v_c + ω × (x − c), c the subtree centre of mass of the kinematic tree's root
    Args      cvel (N, l, 6) as (ω, v_c); xpos (N, l, 3); com (N, 3)
    Returns   (N, l, 3) [m/s], world
    Test      tests/test_retarget.py::test_body_velocity
    """
    w, r = cvel[..., :3], xpos - com[:, None]
    v = cvel[..., 3:].copy()
    v[..., 0] += w[..., 1] * r[..., 2] - w[..., 2] * r[..., 1]
    v[..., 1] += w[..., 2] * r[..., 0] - w[..., 0] * r[..., 2]
    v[..., 2] += w[..., 0] * r[..., 1] - w[..., 1] * r[..., 0]
    return v


@dataclass
class Kinematics:
    """Forward kinematics of T poses: what MuJoCo computes of them.  All world frame."""

    xpos: np.ndarray  # (T, nbody, 3)
    xquat: np.ndarray  # (T, nbody, 4)
    velocity: np.ndarray  # (T, nbody, 3) of body origins
    site_xpos: np.ndarray  # (T, 3, 3) headset, controllers
    soles: np.ndarray  # (T, 2, p, 3) end points of the feet's collision shapes, lowered by their radius
    lowest: np.ndarray  # (T,) height of the lowest point of all collision shapes


def forward_kinematics(char: Character, qpos, qvel=None, chunk=1024) -> Kinematics:
    """Poses -> positions, rotations, velocities, through MuJoCo.

    Args      qpos (T, nq); qvel (T, nv) or None for rest
    Test      tests/test_retarget.py::test_forward_kinematics
    """
    m = char.model
    qpos = np.atleast_2d(qpos)
    n = min(chunk, len(qpos))
    b = char.batch(n)
    names = ("qpos", "qvel", "xpos", "xquat", "cvel", "subtree_com", "site_xpos", "geom_xpos", "geom_xmat")
    live = {k: b.bind(k) for k in names}
    parts = []
    for start in range(0, len(qpos), n):
        stop = min(start + n, len(qpos))
        k = stop - start
        live["qpos"][:k] = qpos[start:stop]
        live["qvel"][:k] = 0.0 if qvel is None else qvel[start:stop]
        b.forward(np.arange(k), STAGE_VEL)
        gx, gm = live["geom_xpos"][:k], live["geom_xmat"][:k]
        parts.append((
            live["xpos"][:k].copy(),
            live["xquat"][:k].copy(),
            body_velocity(live["cvel"][:k], live["xpos"][:k], live["subtree_com"][:k, char.root]),
            live["site_xpos"][:k, char.sensor_sites],
            sole_points(char, gx, gm),
            geom_lowest(m, np.flatnonzero(m.geom_conaffinity), gx, gm).min(1),
        ))  # fmt: skip
    return Kinematics(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def sole_points(char: Character, xpos, xmat):
    """Where the feet can touch the floor: ends of capsules and centres of spheres, lowered by the radius; box corners.

    Args      xpos (T, ngeom, 3); xmat (T, ngeom, 9), world
    Returns   (T, 2, p, 3) [m], world; a foot of fewer points than the other one repeats its first
    Test      tests/test_retarget.py::test_sole_points, test_feet_of_two_shapes
    """
    m, feet = char.model, []
    for foot in char.sole_geoms:
        points = []
        for g in foot:
            r = xmat[:, g].reshape(-1, 3, 3)
            radius, half = m.geom_size[g, 0], m.geom_size[g, 1]
            if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
                signs = np.array([[sx, sy, sz] for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)])
                points += [xpos[:, g] + r @ c for c in signs * m.geom_size[g]]
            else:
                ends = (-half, half) if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE else (0.0,)
                points += [xpos[:, g] + r[:, :, 2] * h - [0.0, 0.0, radius] for h in ends]
        feet.append(points)
    most = max(map(len, feet))
    return np.stack([np.stack(f + f[:1] * (most - len(f)), axis=1) for f in feet], axis=1)


# ------------------------------------------------------------------------------------ human pose -> character pose


def root_scale(char: Character, hip_height: float) -> np.ndarray:
    """Scale (s_xy, s_xy, s_z) of the root's position  [Reda23 §3.4], of a user with hips so high [m].

    ASSUMED   travel is not scaled (Fig. 5), height is scaled by the ratio of hip heights.
    Test      tests/test_retarget.py::test_root_scale
    """
    xy, z = char.spec["root"].get("scale_xy", 1.0), char.spec["root"].get("scale_z", "hip")
    z = char.hip_height / hip_height if z == "hip" else z
    return np.array([xy, xy, z])


def headset(char: Character) -> np.ndarray:
    """Where the character's headset is when it stands at the origin in its default pose.  (3,) [m]

    Test      tests/headset/test_stream.py::test_stand"""
    data = mujoco.MjData(char.model)
    data.qpos[:] = char.upright
    mujoco.mj_kinematics(char.model, data)
    return data.site_xpos[char.sensor_sites[0]].copy()


# ASSUMED: from a standing human's hips to the headset, heading frame [m]: Bandai's actor and the built-in human's,
# rounded
HEADSET_AHEAD = np.array([0.14, 0.0, 0.0])


def standing(char: Character, pos, quat) -> np.ndarray:
    """The default pose under headsets, turned as they look, feet on the floor: where a stream begins.

    ASSUMED   the root stands where the user's hips are, HEADSET_AHEAD behind the headset, as in training (§3.4: travel
              is not scaled), not where the character's own headset would be under the user's: Dino's is 0.38 m ahead
    Args      pos (N, 3) [m], quat (N, 4) of headsets, world
    Returns   qpos (N, 7 + j)
    Test      tests/headset/test_stream.py::test_stand, tests/test_env.py::test_standing_starts
    """
    turn = quat_about(2, heading(quat))
    place = pos - quat_rotate(turn, HEADSET_AHEAD)
    root = quat_mul(turn, char.rest[char.root])
    n = len(pos)
    height, pose = np.full((n, 1), char.hip_height), np.broadcast_to(char.default, (n, len(char.default)))
    return np.concatenate([place[:, :2], height, root, pose], axis=1)


def sensor_scale(char: Character, hip_height: float, headset_height: float) -> np.ndarray:
    r"""Scale (s_xy, s_xy, s_z) of headset and controller positions  [Reda23 §3.4].

    Equation  s_z = the character's headset height / the user's, both standing upright
    ASSUMED   the paper sends them through the root's map; ours is another.  A headset sees no hips: this is what a real
              user can be measured by, and a user of any build then wears the headset at the character's head.  With
              `[sensors] scale_z = "hip"` they go through `root_scale`: a CMU subject's headset is then 11 to 20 cm
              above Jesse's head, Oppy's user's 25 cm below Oppy's eyes
    Args      hip_height, headset_height : of the user [m]; of a clip's, or of a stream's
              (`headset.calibration.calibrate`)
    Test      tests/test_retarget.py::test_sensor_scale,
              tests/headset/test_stream.py::test_calibration_scales_as_training
    """
    scale, z = root_scale(char, hip_height), char.spec["sensors"].get("scale_z", "headset")
    if z != "hip":
        scale[2] = headset(char)[2] / headset_height if z == "headset" else z
    return scale


OUTSIDE, SMALL = 10.0, 0.01  # ASSUMED: what a triple of angles costs, beside its jumps (`euler_angles`)


def euler_angles(q, axes: str, low=-np.inf, high=np.inf):
    r"""Angles of intrinsic turns about `axes` (1 to 3 letters) that make the rotation q.

    Equation  q = q_{a1}(α1) q_{a2}(α2) q_{a3}(α3); with fewer than three hinges the turns about the missing axes,
              ordered last, are dropped: what the character cannot do (ASSUMED: not the nearest reachable rotation)
    Method    two triples make one rotation, (α1, α2, α3) and (α1 + π, π − α2, α3 + π).  Of each frame's two those are
              taken that cost least over the whole motion (Viterbi's shortest path):
              Σ_t ‖α_t − α_{t−1}‖² + OUTSIDE ‖α_t beyond low, high‖² + SMALL ‖α_t‖²; a missing axis allows 0 alone
    Why       an arm raised by 150 degrees is (0, 150, 0), not (180, 30, 180), which no shoulder's range holds
    Args      q (T, 4); axes : letters of "xyz", none twice; low, high : a hinge's range [rad], one or each
    Returns   (T, len(axes)) [rad]: about an axis with a range within π of its middle, otherwise unwrapped in time
    Test      tests/test_retarget.py::test_euler_angles, test_arms_above_the_head
    """
    seq, n = axes + "".join(a for a in "yxz" if a not in axes), len(axes)
    low, high = (np.concatenate([np.broadcast_to(v, n).astype(float), np.zeros(3 - n)]) for v in (low, high))
    ranged = np.isfinite(low) & np.isfinite(high)
    middle = np.where(ranged, low + np.where(ranged, high - low, 0.0) / 2, 0.0)
    wrap = lambda a: (a + np.pi) % (2 * np.pi) - np.pi  # noqa: E731
    first = Rotation.from_quat(q, scalar_first=True).as_euler(seq.upper())
    both = np.stack([first, np.array([np.pi, np.pi, np.pi]) + first * [1.0, -1.0, 1.0]], axis=1)  # (T, 2, 3)
    both = middle + wrap(both - middle)
    beyond = np.maximum(low - both, 0.0) + np.maximum(both - high, 0.0)
    cost = OUTSIDE * np.square(beyond).sum(2) + SMALL * np.square(both).sum(2)
    jump = both[1:, None, :, :n] - both[:-1, :, None, :n]  # from one of two to one of two
    jump = np.square(np.where(ranged[:n], jump, wrap(jump))).sum(3)
    angles = both[np.arange(len(q)), shortest(cost, jump), :n]
    return np.where(ranged[:n], angles, np.unwrap(angles, axis=0))


def shortest(cost, jump):
    r"""Viterbi's path through two choices a frame.

    Equation  the choices k_t that minimise  Σ_t cost[t, k_t] + Σ_t jump[t, k_t, k_{t+1}]
    Method    where each frame's cheaper choice costs no dearer jump than it must, that is the path: no sum has smaller
              parts.  So it is in 97 of 100 joints' motions, and saves the loop
    Args      cost (T, 2); jump (T − 1, 2, 2)
    Returns   (T,) int
    Test      tests/test_retarget.py::test_shortest"""
    cheaper = cost.argmin(1)
    jumps = jump[np.arange(len(jump)), cheaper[:-1], cheaper[1:]]
    if np.all(jumps <= jump.min((1, 2)) + 1e-12):
        return cheaper
    (a, b), came = cost[0].tolist(), []
    for (c, d), ((aa, ab), (ba, bb)) in zip(cost[1:].tolist(), jump.tolist(), strict=True):  # lists: 20 times as fast
        came.append((b + ba < a + aa, b + bb < a + ab))
        a, b = c + min(a + aa, b + ba), d + min(a + ab, b + bb)
    path = [int(b < a)]
    for two in reversed(came):
        path.append(int(two[path[-1]]))
    return np.array(path[::-1])


@dataclass
class Pose:
    """Retargeted motion: qpos (T, nq), qvel (T, nv), clipped (T, j) bool: hinge would have left its range."""

    qpos: np.ndarray
    qvel: np.ndarray
    clipped: np.ndarray


def retarget(char: Character, clip: Clip) -> Pose:
    r"""Kinematic retargeting  [Reda23 §3.4].

    Method    root: the human pelvis, position scaled by `root_scale`, orientation as it is.  Hinges: the human's
              rotation of one segment relative to another, shared out along the character's chain as the TOML says;
              the last body of a chain takes the rest, so that chest, head, arms and legs have the human's relative
              rotation exactly (as far as their hinges allow).  Hinges without a counterpart keep the default pose.
              Angles are clipped to the joint ranges.
    Equation  R_body = Q_segment R_rest: a body has turned from its orientation in the default pose (`Character.rest`)
              as the human's segment has from upright.  ASSUMED: the default pose is the human's, standing with
              hanging arms (for a bent-over Dino: §5.2's style by retargeting)
    Frame     qpos: world, quaternion w, x, y, z; qvel: root linear velocity in the world's frame, root angular
              velocity in the root's, as MuJoCo has them
    Test      tests/test_retarget.py::test_retarget_reproduces_segments, ::test_rest_offset
    """
    n, m = len(clip), char.model
    q = np.tile(char.default, (n, 1))
    turned = {}  # (start, end) -> what the chain's bodies have turned so far, from the default pose
    for body, hinges, axes, start, end, shares in char.chains:
        turn = quat_mul(quat_conj(clip.quat[:, start]), clip.quat[:, end])
        done = turned.get((start, end), np.tile([1.0, 0, 0, 0], (n, 1)))
        local = quat_mul(char.rest[m.body_parentid[body]], m.body_quat[body])  # the body, were its hinges at 0
        sign = m.jnt_axis[1 + hinges][np.arange(len(hinges)), ["xyz".index(x) for x in axes]]
        if shares:
            full = dict(zip("yxz", euler_angles(turn, "yxz").T, strict=True))
            angles = np.stack([shares.get(axis, 0.0) * full[axis] for axis in axes], axis=1)
            angles += sign * char.default[hinges]
        else:
            wanted = quat_mul(quat_mul(quat_conj(done), turn), char.rest[body])
            allowed = np.sort(sign[:, None] * char.ranges[hinges], axis=1).T
            angles = euler_angles(quat_mul(quat_conj(local), wanted), axes, *allowed)
        for k, axis in enumerate(axes):
            local = quat_mul(local, quat_about("xyz".index(axis), angles[:, k]))
        turned[start, end] = quat_mul(done, quat_mul(local, quat_conj(char.rest[body])))
        q[:, hinges] = angles * sign
    inside = np.clip(q, char.ranges[:, 0], char.ranges[:, 1])
    root_pos = clip.pos[:, 0] * root_scale(char, clip.hip_height)
    root_quat = quat_continuous(quat_mul(clip.quat[:, 0], char.rest[char.root]))
    qpos = np.concatenate([root_pos, root_quat, inside], axis=1)
    spin = quat_rotate(quat_conj(root_quat), angular_velocity(root_quat, clip.rate))
    qvel = np.concatenate([linear_velocity(root_pos, clip.rate), spin, linear_velocity(inside, clip.rate)], axis=1)
    return Pose(qpos, qvel, np.abs(inside - q) > 1e-9)


def rest_offset(char: Character, quat):
    r"""What the human's root and head demand of the character's  [Reda23 §3.5.1, App. A].

    Equation  q_gt = q_human q_rest, q_rest the orientation of root and head in the character's default pose
    ASSUMED   the paper has no offset; without one a head that rests level on a bent-over spine would be pulled down
    Args      quat (T, 2, 4) of the human's pelvis and head, world
    Returns   (T, 2, 4)
    Test      tests/test_retarget.py::test_rest_offset
    """
    return quat_mul(quat, char.rest[[char.root, char.head]])


def shared_segments(char: Character) -> dict[int, int]:
    """Which of the canonical human's segments a character has: segment -> body, in the human's order.

    The root is its pelvis.  The last body of a chain of the joint map is the segment that the chain leads to.  A body
    that carries a controller is a hand, unless it is another segment already.
    Test      tests/test_retarget.py::test_as_human
    """
    found = {SEG["pelvis"]: char.root}
    found |= {f.end: f.body for f in char.chains if not f.shares}
    for name, site in zip(SENSORS[1:], char.sensor_sites[1:], strict=True):
        body = int(char.model.site_bodyid[site])
        if body not in found.values():
            found.setdefault(SEG[name], body)
    return dict(sorted(found.items()))


def as_human(char: Character, fk: Kinematics):
    r"""A character's poses as the canonical human's: the way back from `retarget`, over the segments that both have.

    Equation  Q_segment = R_body R_rest⁻¹; a segment's joint is its body's origin
    Frame     world
    Returns   positions (T, s, 3) [m], rotations (T, s, 4), of `shared_segments`
    Test      tests/test_retarget.py::test_as_human
    """
    bodies = list(shared_segments(char).values())
    return fk.xpos[:, bodies], quat_mul(fk.xquat[:, bodies], quat_conj(char.rest[bodies]))


@dataclass
class Reference:
    """All that the environment compares with, for F frames of one or more sequences laid end to end.

    first, last : (S,) frame indices of each sequence
    World frame; positions of the human already mapped by `root_scale`, of the devices by `sensor_scale`; matrices as
    their first two columns (F, ., 3, 2).
    """

    names: list
    rate: float  # Hz, of every sequence
    first: np.ndarray
    last: np.ndarray
    qpos: np.ndarray  # (F, nq) float64
    qvel: np.ndarray  # (F, nv) float64
    link_pos: np.ndarray  # (F, l, 3) float32, reward links
    link_vel: np.ndarray  # (F, l, 3) float32
    orientation: np.ndarray  # (F, 2, 4) float64, human root and head, times the character's rest (`rest_offset`)
    contact: np.ndarray  # (F, 2) bool, human feet
    sensor_pos: np.ndarray  # (F, 3, 3) float64
    sensor_rot: np.ndarray  # (F, 3, 3, 2) float32
    sensor_quat: np.ndarray  # (F, 3, 4) float64
    human_pos: np.ndarray  # (F, 15, 3) float32
    scale: np.ndarray  # (F, 3) float32, by which the human's positions were multiplied
    sensor_scale: np.ndarray  # (F, 3) float32, by which the devices' were
    human_rot: np.ndarray  # (F, 15, 3, 2) float32
    still: np.ndarray  # (S,) frames at each sequence's beginning in which the user stands still

    def __len__(self):
        return len(self.qpos)


def reference(char: Character, clips: list[Clip]) -> Reference:
    """Retarget sequences and lay them end to end.

    Raises    ValueError: no clips, or clips of different rates
    Test      tests/test_retarget.py::test_reference
    """
    rates = {c.rate for c in clips}
    if len(rates) != 1:
        raise ValueError(f"expected clips of one rate, got {len(clips)} clips with the rates {sorted(rates)}")
    rows = [_reference_of(char, c) for c in clips]
    lengths = np.array([len(c) for c in clips])
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    # a frame's numbers side by side in memory, because the environment gathers frames
    joined = {k: np.ascontiguousarray(np.concatenate([r[k] for r in rows])) for k in rows[0]}
    still = np.array([c.still for c in clips])
    return Reference([c.name for c in clips], rates.pop(), first, first + lengths - 1, **joined, still=still)


def _reference_of(char, clip):
    pose = retarget(char, clip)
    fk = forward_kinematics(char, pose.qpos, pose.qvel)
    scale = root_scale(char, clip.hip_height)
    size = sensor_scale(char, clip.hip_height, clip.measured or headset_height(clip))
    sensor_pos, sensor_quat = sensors(clip)
    f32 = np.float32
    return dict(
        qpos=pose.qpos,
        qvel=pose.qvel,
        link_pos=fk.xpos[:, char.reward_links].astype(f32),
        link_vel=fk.velocity[:, char.reward_links].astype(f32),
        orientation=rest_offset(char, clip.quat[:, [SEG["pelvis"], SEG["head"]]]),
        contact=contacts(clip),
        sensor_pos=sensor_pos * size,
        sensor_rot=quat_matrix(sensor_quat)[..., :2].astype(f32),
        sensor_quat=sensor_quat,
        human_pos=(clip.pos * scale).astype(f32),
        scale=np.tile(scale, (len(clip), 1)).astype(f32),
        sensor_scale=np.tile(size, (len(clip), 1)).astype(f32),
        human_rot=quat_matrix(clip.quat)[..., :2].astype(f32),
    )


def human_of(ref: Reference, frames, segments):
    """The human of a Reference, as the root's scale maps it: positions (T, s, 3) [m], rotations (T, s, 4), world.

    ASSUMED   that this is the true motion of a character whose body is another
    Args      frames (T,); segments : indices into `human.SEGMENTS`
    Test      tests/test_retarget.py::test_as_human
    """
    at = np.ix_(frames, list(segments))
    x, y = np.moveaxis(ref.human_rot[at].astype(float), -1, 0)
    turn = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1).reshape(-1, 3, 3))
    return ref.human_pos[at].astype(float), turn.as_quat(scalar_first=True).reshape(*x.shape[:-1], 4)


# ------------------------------------------------------------------------------------ artefacts


def sole_motion(soles, rate):
    r"""Lowest point of each sole: its height, and the horizontal speed of that material point.

    Args      soles (T, 2, p, 3) [m]
    Returns   height (T, 2) [m], speed (T, 2) [m/s]
    Test      tests/test_retarget.py::test_sole_motion
    """
    low = np.argmin(soles[..., 2], axis=2)[..., None]
    height = np.take_along_axis(soles[..., 2], low, axis=2)[..., 0]
    speed = np.linalg.norm(linear_velocity(soles[..., :2], rate), axis=-1)
    return height, np.take_along_axis(speed, low, axis=2)[..., 0]


def artefacts(char: Character, clip: Clip, pose: Pose) -> dict:
    """What the kinematic pose does wrong and the policy must repair.

    Returns   limit_share : share of (frame, hinge) clipped; limits : hinge -> share, worst first;
              slide_cm_s : mean speed of the sole while the human's foot is in contact;
              penetration_mm : mean depth of the lower sole over the frames where it is below the floor, and
              below_share : their share; float_mm : mean height of the sole while the human's foot is in contact
    Test      tests/test_retarget.py::test_artefacts
    """
    height, speed = sole_motion(forward_kinematics(char, pose.qpos).soles, clip.rate)
    contact = contacts(clip)
    lowest = height.min(axis=1)
    share = pose.clipped.mean(axis=0)
    worst = sorted(zip(char.hinges, share, strict=True), key=lambda x: -x[1])
    return dict(
        limit_share=float(pose.clipped.mean()),
        limits={h: float(s) for h, s in worst if s > 0},
        slide_cm_s=float(100 * speed[contact].mean()) if contact.any() else float("nan"),
        penetration_mm=float(-1000 * lowest[lowest < 0].mean()) if (lowest < 0).any() else 0.0,
        below_share=float((lowest < 0).mean()),
        float_mm=float(1000 * height[contact].mean()) if contact.any() else float("nan"),
    )


# ------------------------------------------------------------------------------------ export


OWN = "own"  # names of the character's own bodies, and its own frames


def to_file(v):
    """Our axes -> those of BVH and glTF: x forward, y left, z up -> x left, y up, z forward.  (..., 3) -> (..., 3)

    Test      tests/test_retarget_bvh.py::test_bvh_round_trip, tests/extras/test_gltf.py::test_second_reader"""
    return np.roll(v, -1, axis=-1)


def write_bvh(path, char: Character, qpos, rate, names=OWN) -> None:
    r"""A character's motion as BVH: a joint for each of its bodies.

    Method    rotation of a body in its parent, all its hinges in one; the root also moves.  OFFSETs are those of the
              bodies' origins; an End Site lies as far beyond its body's centre of mass as that from the origin
    Names     of a standard: `mocap.humanoid`'s, and its rest pose is a T: without any turn the file shows that.  A body
              between two bones (the third of a spine of four) is held; the next bone turns for both, and has positions
              where that moves its origin (by up to 3 mm when Dino jogs): the pose is the same
    Equation  the joint's turn from the T-pose  G_b = R_b T_b⁻¹, in the file G_parent⁻¹ G_b; OFFSETs are T_parent o_b
    Frame     y up, z forward, x left, centimetres, as animation tools expect: (x, y, z) of ours is (z, x, y)
    Args      qpos (T, nq); rate [Hz]; names : "own" or one of `mocap.humanoid.NAMES`
    Raises    UserError: the file cannot be written, or a body's origin moves in its parent (a hinge beside it)
    Test      tests/test_retarget_bvh.py::test_bvh_round_trip, ::test_bvh_in_another_library, ::test_bvh_of_a_standard
    """
    m, fk = char.model, forward_kinematics(char, qpos)
    bodies = [b for b in range(1, m.nbody) if m.body_rootid[b] == char.root]
    parents = np.array([bodies.index(m.body_parentid[b]) if b != char.root else -1 for b in bodies])
    own = names == OWN
    rest = np.tile([1.0, 0, 0, 0], (m.nbody, 1)) if own else humanoid.t_pose(char)
    called = [m.body(b).name or f"body{b}" for b in range(m.nbody)] if own else humanoid.names(char, names)
    turned, held = quat_mul(fk.xquat, quat_conj(rest)), [] if own else humanoid.between(char)
    local, offsets, moving = turned[:, bodies], np.zeros((len(bodies), 3)), {}
    for k, (b, p) in enumerate(zip(bodies, m.body_parentid[bodies])):
        if b == char.root:
            continue
        offset = quat_rotate(quat_conj(fk.xquat[:, p]), fk.xpos[:, b] - fk.xpos[:, p])
        offsets[k] = quat_rotate(rest[p], offset.mean(axis=0))
        if np.abs(offset - offset.mean(axis=0)).max() > 1e-6:
            raise UserError(f"{path}: a hinge of {m.body(b).name} lies beside the body's origin: BVH has no such joint")
        if b in held:
            turned[:, b] = turned[:, p]
        back = quat_conj(turned[:, p])
        local[:, k] = quat_mul(back, turned[:, b])
        place = quat_rotate(back, fk.xpos[:, b] - fk.xpos[:, p])
        if np.abs(place - offsets[k]).max() > 1e-6:  # its parent is held
            moving[called[b]] = 100.0 * to_file(place)
    local = np.concatenate([local[..., :1], to_file(local[..., 1:])], axis=-1)
    leaves = [b for b in bodies if b not in m.body_parentid[bodies]]
    ends = {called[b]: 200.0 * to_file(quat_rotate(rest[b], m.body_ipos[b])) for b in leaves}
    root, offsets = 100.0 * to_file(fk.xpos[:, char.root]), 100.0 * to_file(offsets)
    try:
        write(path, [called[b] for b in bodies], parents, offsets, 1.0 / rate, root, local, ends, moving=moving)
    except OSError as e:
        raise UserError(f"cannot write {path}: {e.strerror or e}; give a folder that exists and is writable") from None
    except BvhError as e:
        raise UserError(str(e)) from None


@dataclass
class BvhFlags:
    """The flags of every command that writes BVH."""

    bvh: str | None = arg(None, "write the character's motion as BVH, whole; of a stream up to ten minutes")
    bvh_names: str = arg(
        OWN,
        "names of the BVH's joints: the character's own, or a standard's, with a T-pose as rest pose",
        choices=(OWN, *humanoid.NAMES),
    )

    def check_bvh(self) -> None:
        """UserError: names without a file.  Test: tests/test_retarget_bvh.py::test_bvh_names_on_the_command_line"""
        if self.bvh_names != OWN and not self.bvh:
            raise UserError(f"--bvh-names {self.bvh_names}: names the joints of --bvh OUT; give that, too")

    def write_bvh(self, char: Character, qpos, rate) -> None:
        """The file that the flags ask for, and a line on what the standard misses in it.

        Test      tests/test_retarget_bvh.py::test_bvh_names_on_the_command_line"""
        write_bvh(self.bvh, char, qpos, rate, self.bvh_names)
        misses = humanoid.lacking(char, self.bvh_names) if self.bvh_names != OWN else ()
        print(self.bvh + (f": {self.bvh_names} also wants {', '.join(misses)}" if misses else ""))


# ------------------------------------------------------------------------------------ command line


@dataclass
class Options(MotionFlags, BvhFlags, character.Switches):
    """What `python retarget.py` can be told."""

    png: str | None = arg(None, "write a contact sheet of the first clip, human and character", check=PNG)
    camera: str = arg("track", "camera of the pictures: track, side, front, or another of the model's")
    video: str | None = arg(None, "write a video of the first clip (.mp4; needs the extra `view`)")


def draw(char: Character, clip: Clip, pose: Pose, frames, size=(480, 360), camera="track", beside=None):
    """Images with the human (stick figure) at the left of the character.  -> list of (H, W, 3) uint8

    Args      beside : (3,) [m] from the character to the human, world, instead of its left
    Test      tests/test_retarget.py::test_draw"""
    from plumbing import render

    shown = char.mjspec().compile()
    scene, apart = render.Scene(shown, *size, camera=camera), 0.2 + 0.9 * char.hip_height  # m
    data = mujoco.MjData(shown)
    images = []
    for t in frames:
        data.qpos[:] = pose.qpos[t]
        mujoco.mj_forward(shown, data)
        left = quat_rotate(clip.quat[t, 0], np.array([0.0, 1.0, 0.0])) * [1, 1, 0]
        side = apart * left / max(np.linalg.norm(left), 1e-9)
        points = np.concatenate([clip.pos[t], clip.ball[t]]) + (side if beside is None else beside)
        bones = list(PARENTS) + list(FEET)
        images.append(scene.frame(data, markers=render.stick_figure(points, bones)))
    return images


def main(argv=None):
    """Print the artefacts of every clip's kinematic pose; draw the first one.

    Test      tests/test_retarget.py::test_command_line"""
    opt = cli(Options, argv, "retarget.py", __doc__)
    opt.check_bvh()
    check_folders(opt.bvh, opt.png, opt.video, read=mocap.data.parts(opt.motion))
    char = opt.load()
    clips = load(opt.motion, clips=opt.clips, reading=Reading.of(opt))
    print(
        f"{char.name}: hips {char.hip_height:.3f} m, {char.j} hinges, {len(char.limits)} driven, "
        f"{char.model.body_subtreemass[0]:.1f} kg"
    )
    rows = []
    for clip in clips:
        pose = retarget(char, clip)
        a = artefacts(char, clip, pose)
        rows.append(a)
        limits = ", ".join(f"{h} {100 * s:.0f} %" for h, s in list(a["limits"].items())[:3]) or "none"
        print(
            f"{clip.name:36s} {clip.seconds:6.1f} s  slide {a['slide_cm_s']:5.1f} cm/s  "
            f"below floor {100 * a['below_share']:3.0f} % by {a['penetration_mm']:4.1f} mm  "
            f"sole in contact {a['float_mm']:5.1f} mm up  limits hit: {limits}"
        )
    if len(rows) > 1:
        mean = {k: np.nanmean([r[k] for r in rows]) for k in rows[0] if k != "limits"}
        print(
            f"mean of {len(rows)}: slide {mean['slide_cm_s']:.1f} cm/s, "
            f"below floor {100 * mean['below_share']:.0f} % of frames by {mean['penetration_mm']:.1f} mm, "
            f"sole in contact {mean['float_mm']:.1f} mm up, "
            f"limits hit {100 * mean['limit_share']:.2f} % of hinge frames"
        )
    clip, pose = clips[0], retarget(char, clips[0])
    if opt.bvh:
        opt.write_bvh(char, pose.qpos, clip.rate)
    if opt.png or opt.video:
        from plumbing import render

        if opt.png:
            frames = np.linspace(0, len(clip) - 1, 12).astype(int)
            labels = [f"{t / clip.rate:.1f} s" for t in frames]
            images = draw(char, clip, pose, frames, camera=opt.camera)
            render.write_png(opt.png, render.contact_sheet(images, labels, 4))
            print(opt.png)
        if opt.video:
            render.write_video(opt.video, draw(char, clip, pose, range(len(clip)), camera=opt.camera), clip.rate)
            print(opt.video)


if __name__ == "__main__":
    run_main(main)

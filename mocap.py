r"""Human motion: one canonical human, whatever the rig  [Reda23 §3.4, App. A].

    read a file ──────► canonical Clip ──► resample ──► stitch ──► sensors, contacts
    (bvh.py, amc.py)    15 segments        30 Hz        ≥ 30 s     §3.4    App. A
    or gait.py

Everything after the reader speaks of one human only: 15 named segments, each with a joint centre and an
anatomical frame that equals the world's axes (x forward, y left, z up) when the person stands upright with
the arms hanging.  Metres, radians, seconds; quaternions w, x, y, z.

    python mocap.py inspect FILE      skeleton, rate, length, speed, contacts
    python mocap.py inspect FOLDER    one line a clip, and what stitching makes of them
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import amc
import bvh
import gait
from runs import UserError, run_main

SEGMENTS = (
    "pelvis", "chest", "head",
    "thigh_l", "shin_l", "foot_l", "thigh_r", "shin_r", "foot_r",
    "upper_arm_l", "forearm_l", "hand_l", "upper_arm_r", "forearm_r", "hand_r",
)  # fmt: skip
PARENTS = (-1, 0, 1, 0, 3, 4, 0, 6, 7, 1, 9, 10, 1, 12, 13)
SEG = {name: i for i, name in enumerate(SEGMENTS)}
FEET = (SEG["foot_l"], SEG["foot_r"])
CONTROL_RATE = 30.0  # Hz, ASSUMED: Table 3 is lost

# ------------------------------------------------------------------------------------ quaternions


def quat_mul(a, b):
    """Hamilton product of quaternions w, x, y, z, (..., 4) each.  Test: test_mocap.py::test_quaternions."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b), -1, 0)
    return np.stack([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ], axis=-1)  # fmt: skip


def quat_conj(q):
    """Inverse of a unit quaternion.  (..., 4) -> (..., 4).  Test: test_mocap.py::test_quaternions."""
    return np.asarray(q) * np.array([1, -1, -1, -1], dtype=np.asarray(q).dtype)


def quat_rotate(q, v):
    """Rotate vectors v (..., 3) by q = (w, u): v + 2 w (u×v) + 2 u×(u×v).  Test: test_mocap.py::test_quaternions."""
    q, v = np.asarray(q), np.asarray(v)
    u, w = q[..., 1:], q[..., :1]
    t = 2.0 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def quat_matrix(q):
    """Rotation matrices (..., 3, 3) of quaternions (..., 4).  Test: test_mocap.py::test_quaternions."""
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def quat_about(axis: int, angle):
    """Turn by `angle` (...) about coordinate axis 0, 1 or 2 -> (..., 4).  Test: test_mocap.py::test_quaternions."""
    angle = np.asarray(angle, dtype=float)
    q = np.zeros(angle.shape + (4,))
    q[..., 0], q[..., 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return q


def quat_angle(a, b):
    """Geodesic angle |log(a b⁻¹)| in [0, π]; q and −q are one rotation.  Test: test_mocap.py::test_quaternions."""
    r = quat_mul(a, quat_conj(b))
    return 2.0 * np.arctan2(np.linalg.norm(r[..., 1:], axis=-1), np.abs(r[..., 0]))


def quat_slerp(a, b, t):
    """Slerp along the shorter arc.  a, b (..., 4), t (...) in [0, 1].  Test: test_mocap.py::test_resample."""
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b, dot = np.where(dot < 0, -b, b), np.minimum(np.abs(dot), 1.0)
    t = np.asarray(t)[..., None]
    theta = np.arccos(dot)
    small = theta < 1e-6  # sin θ/θ → 1: linear interpolation is exact to 1e-12 there
    s = np.where(small, 1.0, np.sin(theta))
    wa = np.where(small, 1 - t, np.sin((1 - t) * theta) / s)
    wb = np.where(small, t, np.sin(t * theta) / s)
    q = wa * a + wb * b
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def quat_continuous(q):
    """Signs such that consecutive frames lie in one hemisphere.  q (T, ..., 4).  Test: test_mocap.py::test_resample."""
    flip = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=-1, keepdims=True) < 0, -1.0, 1.0), axis=0)
    return np.concatenate([q[:1], q[1:] * flip])


def angular_velocity(q, rate):
    r"""World-frame angular velocity by central differences of log(q_{t+1} q_{t-1}⁻¹).

    Equation  ω_t = log(q_{t+1} q_{t−1}^{-1}) / (2 Δt), one-sided at both ends
    Args      q : (T, ..., 4); rate [Hz]
    Returns   (T, ..., 3) [rad/s], world frame
    Test      tests/test_mocap.py::test_velocities
    """
    nxt, prv = np.concatenate([q[1:], q[-1:]]), np.concatenate([q[:1], q[:-1]])
    d = quat_mul(nxt, quat_conj(prv))
    d = np.where(d[..., :1] < 0, -d, d)
    s = np.linalg.norm(d[..., 1:], axis=-1, keepdims=True)
    log = d[..., 1:] * np.where(s < 1e-9, 2.0, 2.0 * np.arctan2(s, d[..., :1]) / np.maximum(s, 1e-12))
    return log * _span(len(q), rate).reshape((-1,) + (1,) * (q.ndim - 1))


def linear_velocity(x, rate):
    """Central differences of x (T, ...), one-sided at the ends, per second.  Test: test_mocap.py::test_velocities."""
    nxt, prv = np.concatenate([x[1:], x[-1:]]), np.concatenate([x[:1], x[:-1]])
    return (nxt - prv) * _span(len(x), rate).reshape((-1,) + (1,) * (x.ndim - 1))


def _span(n, rate):
    if n < 2:
        return np.zeros(n)
    s = np.full(n, rate / 2.0)
    s[[0, -1]] = rate
    return s


def heading(q):
    r"""Yaw of the heading frame: where the body's LEFT axis says forward is.

    Equation  ψ = atan2(−l_x, l_y), l = q · (0, 1, 0)
    Why       looking up or bending over turns about the left axis and leaves it alone, so the heading cannot flip;
              the projected forward axis would (design.md, mistake 6)
    Args      q : (..., 4) root orientation, world frame
    Returns   (...) [rad]
    Test      tests/test_mocap.py::test_heading_does_not_flip
    """
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    return np.arctan2(-2 * (x * y - w * z), 1 - 2 * (x * x + z * z))


# ------------------------------------------------------------------------------------ the canonical human


@dataclass(frozen=True)
class Clip:
    """A motion of the canonical human.

    name  : where it comes from
    body  : whose body it is (from a file: rig or subject, and limb lengths); only clips of one body are stitched
    rate  : frames a second
    pos   : (T, 15, 3) joint centre at the near end of each segment [m], world; pelvis: midpoint of the hip joints
    quat  : (T, 15, 4) anatomical frame of each segment -> world
    ball  : (T, 2, 3) ball of the left and the right foot [m], world
    """

    name: str
    body: str
    rate: float
    pos: np.ndarray
    quat: np.ndarray
    ball: np.ndarray

    def __len__(self):
        return len(self.pos)

    @property
    def seconds(self):
        return len(self.pos) / self.rate

    def __getitem__(self, s: slice) -> Clip:
        return replace(self, pos=self.pos[s], quat=self.quat[s], ball=self.ball[s])

    def limb(self, a: str, b: str) -> float:
        """Mean distance between two joint centres [m]."""
        return float(np.linalg.norm(self.pos[:, SEG[a]] - self.pos[:, SEG[b]], axis=-1).mean())

    @property
    def hip_height(self) -> float:
        """Height of the hips when standing straight [m]: thigh + shin + the ankle's lowest height, both legs' mean.
        The ankle's 5th percentile, because the lowest frame of a real recording is noise."""
        leg = [self.limb(f"thigh_{s}", f"shin_{s}") + self.limb(f"shin_{s}", f"foot_{s}") for s in "lr"]
        ankle = np.percentile(self.pos[:, FEET, 2], 5, axis=0)
        return float(np.mean(leg) + np.mean(ankle))


@dataclass(frozen=True)
class Rig:
    """How one capture skeleton maps to the canonical human.

    joints : segment -> joint of the file.  pelvis is placed at the midpoint of the thighs' joints
    axes   : segment -> (forward, left, up) in the joint's own frame when standing, each as "-z" or a vector
    pitch  : segment -> degrees by which the joint's forward axis points down when standing; taken out
    balls  : the joints at the balls of the feet, left and right
    """

    joints: dict
    axes: dict
    balls: tuple
    pitch: dict = field(default_factory=dict)
    unit: float = 0.01  # file unit in metres
    signature: tuple = ()

    def calibration(self, segment: str) -> np.ndarray:
        """Constant rotation anatomical frame -> joint frame (4,).  Test: test_mocap.py::test_rigs_stand_upright."""
        cols = np.stack([_axis(a) for a in self.axes[segment]], axis=1)  # (3, 3): forward, left, up as columns
        q = Rotation.from_matrix(cols).as_quat(scalar_first=True)
        return quat_mul(q, quat_about(1, np.radians(-self.pitch.get(segment, 0.0))))


def _axis(a):
    """ "-z" -> (0, 0, -1); a vector passes through, made unit length."""
    if isinstance(a, str):
        v = np.zeros(3)
        v["xyz".index(a[-1])] = -1.0 if a[0] == "-" else 1.0
        return v
    return np.asarray(a, dtype=float) / np.linalg.norm(a)


def _frame(left, up):
    """(forward, left, up) from a left axis made orthogonal to up."""
    left, up = _axis(left), _axis(up)
    left = left - up * (left @ up)
    left /= np.linalg.norm(left)
    return np.cross(left, up), left, up


def _limbs(frames: dict) -> dict:
    """Spread one frame a limb over its segments, and both sides."""
    out = {}
    for limb, (left_side, right_side) in frames.items():
        for segment in {"leg": ("thigh", "shin"), "arm": ("upper_arm", "forearm", "hand"), "foot": ("foot",)}[limb]:
            out[f"{segment}_l"], out[f"{segment}_r"] = left_side, right_side
    return out


# Axes were read off standing and walking frames: the bones lie along local x in both rigs, knees and elbows turn about
# one local axis.  Pitches: the foot's bone slopes down to the ball by this much when the foot is flat; the Bandai head
# looks down by this much in the mean over `walk_normal`, where people look ahead (ASSUMED).
RIGS = {
    "bandai": Rig(
        signature=("joint_Root", "Hips", "UpperLeg_L", "LowerArm_R"),
        joints=dict(
            pelvis="Hips", chest="Chest", head="Head",
            thigh_l="UpperLeg_L", shin_l="LowerLeg_L", foot_l="Foot_L",
            thigh_r="UpperLeg_R", shin_r="LowerLeg_R", foot_r="Foot_R",
            upper_arm_l="UpperArm_L", forearm_l="LowerArm_L", hand_l="Hand_L",
            upper_arm_r="UpperArm_R", forearm_r="LowerArm_R", hand_r="Hand_R",
        ),  # fmt: skip
        balls=("Toes_L", "Toes_R"),
        axes=dict(
            pelvis=("z", "-y", "x"),
            chest=("y", "z", "x"),
            head=("y", "z", "x"),
            **_limbs(dict(
                leg=(("z", "y", "-x"), ("-z", "y", "x")),
                arm=(("z", "y", "-x"), ("-z", "y", "x")),
                foot=(("x", "y", "z"), ("-x", "y", "-z")),
            )),
        ),
        pitch=dict(foot_l=39.6, foot_r=39.6, head=12.6),
    ),
    "lafan1": Rig(
        signature=("Hips", "LeftUpLeg", "Spine2", "LeftForeArm", "LeftToe"),
        joints=dict(
            pelvis="Hips", chest="Spine2", head="Head",
            thigh_l="LeftUpLeg", shin_l="LeftLeg", foot_l="LeftFoot",
            thigh_r="RightUpLeg", shin_r="RightLeg", foot_r="RightFoot",
            upper_arm_l="LeftArm", forearm_l="LeftForeArm", hand_l="LeftHand",
            upper_arm_r="RightArm", forearm_r="RightForeArm", hand_r="RightHand",
        ),  # fmt: skip
        balls=("LeftToe", "RightToe"),
        axes=dict(
            pelvis=("y", "z", "x"),
            chest=("y", "z", "x"),
            head=("y", "z", "x"),
            **_limbs(dict(
                leg=(("y", "-z", "-x"), ("y", "-z", "-x")),
                # the elbows' axis in the arms' frames, the mean of upper arm × forearm over the clip
                arm=(_frame((0, 0.34, 0.94), "-x"), _frame((0, -0.38, 0.92), "-x")),
                foot=(("x", "-z", "y"), ("x", "-z", "y")),
            )),
        ),
        pitch=dict(foot_l=25.8, foot_r=25.8),
    ),
}  # fmt: skip

# y-up file axes (x left, y up, z forward) -> ours: a cyclic permutation, so a proper rotation
_Y_UP = np.array([0.5, 0.5, 0.5, 0.5])


def rig_of(b: bvh.Bvh) -> str:
    """Name of the rig whose joints the file has.

    Raises    UserError: no rig; names the joints found and the rigs known
    Test      tests/test_mocap.py::test_unknown_rig
    """
    for name, rig in RIGS.items():
        if set(rig.signature) | set(rig.balls) | set(rig.joints.values()) <= set(b.names):
            return name
    raise UserError(
        f"{b.path}: unknown skeleton with joints {', '.join(b.names)}; known rigs: "
        + "; ".join(f"{n} ({', '.join(r.signature)}, …)" for n, r in RIGS.items())
    )


def from_bvh(path) -> Clip:
    """Read a BVH of a known rig as the canonical human, at the file's own rate.

    Symbols   p = u·P(p_file), q = q_yup q_file C: unit u, axes P and q_yup, calibration C of the rig
    Frame     world, floor at z = 0, metres
    Raises    UserError: cannot be opened, not a BVH, or an unknown skeleton
    Test      tests/test_mocap.py::test_bvh_against_scipy, ::test_root_offset
    """
    return _canonical(_read(path))


def _read(path) -> bvh.Bvh:
    try:
        return bvh.read(path)
    except bvh.BvhError as e:
        raise UserError(str(e)) from None
    except OSError as e:
        raise UserError(f"{path}: {e.strerror or e}; expected a .bvh file") from None


def _canonical(b: bvh.Bvh) -> Clip:
    name = rig_of(b)
    rig = RIGS[name]
    pose = _clip_of(b, rig, name, "replace")
    root = b.parents.argmin()
    if np.any(b.offsets[root]) and any("position" in c for c in b.channels[root]):
        # Some exporters add the root's OFFSET to its channels, most do not: right is what puts the feet on the floor.
        added = _clip_of(b, rig, name, "add")
        if abs(_lowest(added)) < abs(_lowest(pose)):
            pose = added
    return replace(pose, body=_body(name, pose))


def _body(rig: str, clip: Clip) -> str:
    """Whose body: the rig and the lengths of leg and arm [cm], so that two people in one rig are two bodies."""
    leg = clip.limb("thigh_l", "shin_l") + clip.limb("shin_l", "foot_l")
    arm = clip.limb("upper_arm_l", "forearm_l") + clip.limb("forearm_l", "hand_l")
    return f"{rig}-leg{100 * leg:.0f}-arm{100 * arm:.0f}"


@cache
def _calibrations(rig: str) -> np.ndarray:
    return np.stack([RIGS[rig].calibration(s) for s in SEGMENTS])


def _lowest(clip):
    return np.percentile(clip.ball[..., 2].min(axis=1), 20)


def _clip_of(b, rig, name, root_offset):
    pose = bvh.global_pose(b, root_offset)
    return _human(rig, _calibrations(name), b.names, *pose, Path(b.path).stem, name, 1.0 / b.frame_time)


def _human(rig, calibrations, names, pos, quat, clip, body, rate):
    """The canonical human in a file's joints (file units, y up)."""
    index = {n: i for i, n in enumerate(names)}
    cols = [index[rig.joints[s]] for s in SEGMENTS]
    p = pos[..., [2, 0, 1]] * rig.unit
    q = quat_mul(_Y_UP, quat_mul(quat[:, cols], calibrations))
    joint_pos = p[:, cols].copy()
    joint_pos[:, 0] = 0.5 * (joint_pos[:, SEG["thigh_l"]] + joint_pos[:, SEG["thigh_r"]])
    ball = p[:, [index[n] for n in rig.balls]]
    return Clip(clip, body, rate, joint_pos, quat_continuous(q), ball)


# CMU's skeletons: the same bones and zero pose for every subject, lengths and some directions of their own.  The head's
# joint is where `head` starts: 9 cm below the headband, as in a skull.  The forearm is `radius` and `wrist` together:
# `wrist` only pronates, and `hand` flexes.  `thorax` starts in the middle of the back.
CMU_BONES = dict(
    pelvis="root", chest="thorax", head="head",
    thigh_l="lfemur", shin_l="ltibia", foot_l="lfoot", thigh_r="rfemur", shin_r="rtibia", foot_r="rfoot",
    upper_arm_l="lhumerus", forearm_l="lradius", hand_l="lhand",
    upper_arm_r="rhumerus", forearm_r="rradius", hand_r="rhand",
)  # fmt: skip
# Degrees, means over subjects 07, 08, 16, 35.  In straight walks the head looks down by 15 (10 to 18), and people look
# ahead (ASSUMED).  With ankle and ball both slower than 0.25 m/s the sole, square to the shank in the zero pose, points
# down by 2.9 (1.9 to 5.0).
CMU_PITCH = dict(head=15.0, foot_l=2.9, foot_r=2.9)
INCH = 0.0254  # m; CMU's unit is 1 / (:units length) inches
AMC_RATE = 120.0  # Hz of CMU's AMC files, which do not say it


def cmu_rig(skeleton: amc.Skeleton) -> Rig:
    r"""The rig of a CMU skeleton, from its zero pose: a T-pose with splayed legs, all bones' frames being the file's.

    Method    up: against the bone (thigh, shin, arm, hand), the file's y (trunk, head), the shin's (foot).
              left: the knee's axis, with which the shin bends back, for the leg; against the elbow's axis, with which
              the forearm bends forward, for upper arm and forearm; in the hand the T-pose's palms face down and the
              thumbs forward, so left is up (left hand) or down.  Knee and elbow turn about x of their `axis`
    Frame     of the file: x left, y up, z forward
    Raises    UserError: bones are missing, or a knee or an elbow has no rx; names them
    Test      tests/test_amc.py::test_zero_pose_is_a_t_pose, ::test_cmu_anatomy, ::test_unknown_skeleton
    """
    index = {n: i for i, n in enumerate(skeleton.names)}
    wanted = {*CMU_BONES.values(), "ltoes", "rtoes"}
    hinges = {"ltibia", "rtibia", "lradius", "rradius"}
    missing = sorted(wanted - set(index)) or sorted(n for n in hinges if "rx" not in skeleton.dofs[index[n]])
    if missing:
        raise UserError(
            f"{skeleton.path}: no CMU skeleton: {', '.join(missing)} missing or without rx; "
            f"it has {', '.join(skeleton.names)}"
        )

    def hinge(name):
        i = index[name]
        return Rotation.from_euler(skeleton.axis_orders[i], skeleton.axes[i]).apply([1.0, 0.0, 0.0])

    axes = dict.fromkeys(("pelvis", "chest", "head"), _frame("x", "y"))
    for side, palm in (("l", "y"), ("r", "-y")):
        up = {s: -skeleton.directions[index[side + s]] for s in ("femur", "tibia", "humerus", "radius", "hand")}
        knee, elbow = hinge(f"{side}tibia"), -hinge(f"{side}radius")
        axes[f"thigh_{side}"], axes[f"shin_{side}"] = _frame(knee, up["femur"]), _frame(knee, up["tibia"])
        axes[f"foot_{side}"] = axes[f"shin_{side}"]
        axes[f"upper_arm_{side}"], axes[f"forearm_{side}"] = _frame(elbow, up["humerus"]), _frame(elbow, up["radius"])
        axes[f"hand_{side}"] = _frame(palm, up["hand"])
    return Rig(CMU_BONES, axes, ("ltoes", "rtoes"), CMU_PITCH, INCH / skeleton.length)


def from_amc(path, rate=AMC_RATE) -> Clip:
    """Read a CMU motion as the canonical human; its skeleton lies beside it.

    Symbols   as in `from_bvh`; unit 0.0254 / (:units length) m; the balls of the feet are where the toes start
    Frame     world, floor at z = 0, metres; made level by `level`
    Args      path : SUBJECT_TRIAL.amc beside SUBJECT.asf, or beside a single .asf of any name
              rate : [Hz] of the file, which does not hold it; CMU's are 120
    Returns   Clip at that rate, body cmu-SUBJECT with lengths of leg and arm
    Raises    UserError: cannot be opened, malformed, no skeleton beside it, or not CMU's; names what was looked for
    Test      tests/test_amc.py::test_from_amc_against_matrices, ::test_skeleton_beside, ::test_cmu_anatomy
    """
    s, motion = _read_amc(path)
    rig = cmu_rig(s)
    calibrations = np.stack([rig.calibration(segment) for segment in SEGMENTS])
    pose = amc.global_pose(s, motion)
    clip = level(_human(rig, calibrations, s.names, *pose, Path(path).stem, "", float(rate)))
    return replace(clip, body=_body(f"cmu-{Path(s.path).stem}", clip))


LEVEL_SPREAD, LEVEL_LIMIT = 0.2, 3.0  # m; degrees


def level(clip: Clip) -> Clip:
    r"""The clip turned about the origin so that the floor under its standing feet is level.

    Why       the floor of CMU's subjects 07 and 08 rises by 1.8 to 2.1 cm a metre: 6 cm from end to end of a walk
    Equation  g = argmin mean_i (h_i − g·x_i)² + s² |g|²; h_i, x_i: height and place of a standing ball, both less that
              foot's means.  s = 0.2 m: where the feet spread less than that, as across a straight walk, g stays 0.
              Then a turn by atan |g| about (−g_y, g_x, 0)
    ASSUMED   the floor is a plane through the capture's origin: there the balls of all four subjects stand 3 to 5 cm
              high.  More than 3 degrees are stairs or a ramp, which stay
    Test      tests/test_amc.py::test_level, ::test_cmu_floor
    """
    standing = (clip.ball[..., 2] < CONTACT_HEIGHT) & (
        np.linalg.norm(linear_velocity(clip.ball, clip.rate), axis=-1) < CONTACT_SPEED
    )
    feet = [clip.ball[standing[:, k], k] for k in (0, 1) if standing[:, k].any()]
    if not feet:
        return clip
    d = np.concatenate([f - f.mean(axis=0) for f in feet])
    x, h = d[:, :2], d[:, 2]
    g = np.linalg.solve(x.T @ x / len(x) + LEVEL_SPREAD**2 * np.eye(2), x.T @ h / len(x))
    steep = np.linalg.norm(g)
    angle = np.arctan(steep)
    if not 0.0 < angle < np.radians(LEVEL_LIMIT):
        return clip
    q = np.array([np.cos(angle / 2), *np.sin(angle / 2) / steep * np.array([-g[1], g[0], 0.0])])
    return replace(clip, pos=quat_rotate(q, clip.pos), ball=quat_rotate(q, clip.ball), quat=quat_mul(q, clip.quat))


def _read_amc(path):
    """Skeleton and motion of an .amc file."""
    path = Path(path)
    beside = sorted(f for f in path.parent.glob("*") if f.suffix.lower() == ".asf")
    subject = path.stem.rpartition("_")[0] or path.stem
    skeleton = [f for f in beside if f.stem == subject] or beside
    try:
        if path.exists() and len(skeleton) != 1:
            found = ", ".join(f.name for f in beside[:6]) or "none"
            raise UserError(
                f"{path}: no skeleton beside it: looked for {subject}.asf or a single .asf in {path.parent}; "
                f"there is {found}"
            )
        s = amc.read_asf(skeleton[0]) if skeleton else None
        return s, amc.read_amc(path, s)
    except amc.AmcError as e:
        raise UserError(str(e)) from None
    except OSError as e:
        raise UserError(f"{path}: {e.strerror or e}; expected an .amc file") from None


def _is_amc(path) -> bool:
    return Path(path).suffix.lower() == ".amc"


def resample(clip: Clip, rate: float) -> Clip:
    """The clip at another rate: positions linearly, rotations by slerp.  Test: tests/test_mocap.py::test_resample."""
    if abs(clip.rate - rate) < 1e-3 * rate:
        return replace(clip, rate=rate)
    n = int(np.floor((len(clip) - 1) * rate / clip.rate + 1e-9)) + 1
    t = np.arange(n) * clip.rate / rate
    i = np.minimum(t.astype(int), max(len(clip) - 2, 0))
    j = np.minimum(i + 1, len(clip) - 1)
    w = t - i
    lerp = lambda x: x[i] + (x[j] - x[i]) * w[:, None, None]  # noqa: E731
    quat = quat_slerp(clip.quat[i], clip.quat[j], np.broadcast_to(w[:, None], (n, len(SEGMENTS))))
    return replace(clip, rate=rate, pos=lerp(clip.pos), quat=quat_continuous(quat), ball=lerp(clip.ball))


def place(clip: Clip, yaw: float, pivot, to) -> Clip:
    """Turn by `yaw` about the vertical through `pivot` (2,), put it on `to` (2,).  Test: test_mocap.py::test_place."""
    r = np.eye(3)
    r[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pivot, to = np.append(pivot, 0.0), np.append(to, 0.0)
    move = lambda x: (x - pivot) @ r.T + to  # noqa: E731
    return replace(clip, pos=move(clip.pos), ball=move(clip.ball), quat=quat_mul(quat_about(2, yaw), clip.quat))


# ------------------------------------------------------------------------------------ other users, other gaits

_MIRRORED = tuple(SEG[s[:-2] + {"_l": "_r", "_r": "_l"}[s[-2:]] if s[-2:] in ("_l", "_r") else s] for s in SEGMENTS)
_ARMS = tuple(tuple(SEG[f"{s}_{side}"] for s in ("upper_arm", "forearm", "hand")) for side in "lr")


def mirror(clip: Clip) -> Clip:
    r"""The clip seen in a mirror: left and right change places.

    Equation  p' = M p, R' = M R M with M = diag(1, -1, 1); in quaternions (w, x, y, z) -> (w, -x, y, -z)
    Why       the anatomical frames are symmetric, so that M R M is the other side's frame
    Test      tests/test_mocap.py::test_mirror
    """
    flip = np.array([1.0, -1.0, 1.0])
    quat = clip.quat[:, _MIRRORED] * [1.0, -1.0, 1.0, -1.0]
    pos, ball = clip.pos[:, _MIRRORED] * flip, clip.ball[:, ::-1] * flip
    return replace(clip, name=f"{clip.name}-mirrored", pos=pos, quat=quat, ball=ball)


def warp(clip: Clip, speed: float) -> Clip:
    """The clip played `speed` times as fast, at the same frame rate.  Test: tests/test_mocap.py::test_warp."""
    return resample(replace(clip, name=f"{clip.name}-speed{speed:.2f}", rate=clip.rate * speed), clip.rate)


def resize(clip: Clip, height=1.0, arms=1.0) -> Clip:
    """The same motion by a user `height` times as tall, whose arms are `arms` times as long in proportion.

    All positions grow, travel included: a taller person's steps are longer.
    Test      tests/test_mocap.py::test_resize
    """
    pos = clip.pos * height
    for shoulder, elbow, hand in _ARMS:
        upper, fore = pos[:, elbow] - pos[:, shoulder], pos[:, hand] - pos[:, elbow]
        pos[:, elbow] = pos[:, shoulder] + arms * upper
        pos[:, hand] = pos[:, elbow] + arms * fore
    tag = f"-h{height:.2f}a{arms:.2f}"
    return replace(clip, name=clip.name + tag, body=clip.body + tag, pos=pos, ball=clip.ball * height)


def augment(clips: list[Clip], rng: np.random.Generator, speed=0.15, height=0.2, arms=0.2) -> list[Clip]:
    """Every clip, and its mirror image at a random speed by a user of random height and arm length.

    Args      speed, height, arms : ranges, as shares: speed in 1 +- speed, and so on
    Returns   twice as many clips, the given ones first
    Test      tests/test_mocap.py::test_augment
    """
    draw = lambda r: float(rng.uniform(1.0 - r, 1.0 + r))  # noqa: E731
    return list(clips) + [resize(warp(mirror(c), draw(speed)), draw(height), draw(arms)) for c in clips]


# ------------------------------------------------------------------------------------ what the user wears, and the feet

# Where a headset and two controllers sit, in the frames of head and hands [m].  ASSUMED: the paper only says "offset".
# The headset's eyes lie 11 cm before and 8 cm above the joint between skull and neck; a held controller's origin 9 cm
# beyond the wrist and 2 cm towards the thumb.  Orientations are the segments' own.
SENSORS = ("head", "hand_l", "hand_r")
SENSOR_OFFSETS = np.array([[0.11, 0.0, 0.08], [0.02, 0.0, -0.09], [0.02, 0.0, -0.09]])


def sensors(clip: Clip):
    r"""Synthetic headset and controller poses  [Reda23 §3.4, Eq. 4].

    Symbols   h, l, r -> rows 0, 1, 2
    Frame     world
    Returns   positions (T, 3, 3) [m], orientations (T, 3, 4)
    Test      tests/test_mocap.py::test_sensors
    """
    idx = [SEG[s] for s in SENSORS]
    q = clip.quat[:, idx]
    return clip.pos[:, idx] + quat_rotate(q, np.broadcast_to(SENSOR_OFFSETS, q.shape[:2] + (3,))), q


CONTACT_HEIGHT, CONTACT_SPEED = 0.20, 0.40  # m, m/s  [Reda23 App. A]


def contacts(clip: Clip) -> np.ndarray:
    r"""Human foot contacts  [Reda23 App. A]: height < 0.20 m above the ground and speed < 0.4 m/s.

    ASSUMED   the foot is its ankle OR its ball: from heel strike (ball still moving) to toe-off (heel already up)
    Returns   (T, 2) bool, left and right; computed on the human, before any scaling (design.md, mistake 10)
    Test      tests/test_mocap.py::test_contacts
    """
    points = np.stack([clip.pos[:, FEET], clip.ball])  # (2, T, 2, 3): ankle, ball
    speed = np.stack([np.linalg.norm(linear_velocity(p, clip.rate), axis=-1) for p in points])
    return np.any((points[..., 2] < CONTACT_HEIGHT) & (speed < CONTACT_SPEED), axis=0)


# ------------------------------------------------------------------------------------ stitching

_MATCHED = tuple(SEG[s] for s in ("chest", "head", "shin_l", "foot_l", "shin_r", "foot_r", "hand_l", "hand_r"))
VELOCITY_WEIGHT = 0.1  # s: 1 m/s of velocity counts as 10 cm of pose


def motion_features(clip: Clip) -> np.ndarray:
    r"""Pose and velocity of a frame as one vector whose distances are metres.

    Equation  ‖f_a − f_b‖² = mean_j ( ‖Δp_j‖² + τ² ‖Δv_j‖² ), τ = 0.1 s, over 8 joints in the heading frame on the floor
    Returns   (T, 48) float32
    Test      tests/test_mocap.py::test_stitch_distance
    """
    yaw = heading(clip.quat[:, 0])
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]

    def turn(v):  # world -> heading frame
        return np.stack([c * v[..., 0] + s * v[..., 1], -s * v[..., 0] + c * v[..., 1], v[..., 2]], -1)

    p = clip.pos[:, _MATCHED]
    root = clip.pos[:, :1] * [1.0, 1.0, 0.0]
    f = np.concatenate([turn(p - root), VELOCITY_WEIGHT * turn(linear_velocity(p, clip.rate))], axis=1)
    return (f.reshape(len(clip), -1) / np.sqrt(len(_MATCHED))).astype(np.float32)


@dataclass
class StitchReport:
    """What stitching made, and what it lost."""

    sequences: int = 0
    seconds: float = 0.0
    joins: int = 0
    distances: list = field(default_factory=list)
    lost: list = field(default_factory=list)  # names of clips that are in no sequence
    frames: int = 0  # in all clips
    frames_used: int = 0  # of them in at least one sequence
    limit: float = 0.0

    def __str__(self):
        text = f"{self.sequences} sequences, {self.seconds / 60:.1f} min, "
        if not self.joins and not self.lost:
            return text + "no joins needed"
        if self.joins:
            d = 100 * np.array(self.distances)
            text += f"{self.joins} joins at {d.mean():.1f} cm mean ({d.max():.1f} max, limit {100 * self.limit:g})"
        else:
            text += "no joins"
        text += f"; {100 * self.frames_used / max(self.frames, 1):.0f} % of frames used"
        if self.lost:
            text += f"; lost {len(self.lost)} clips ({', '.join(self.lost[:3])}{', …' if len(self.lost) > 3 else ''})"
        return text


def stitch(clips, rng: np.random.Generator, seconds=30.0, limit=0.15, blend=10, stay=1.0):
    r"""Join short clips into sequences of at least `seconds`.

    Method    at a clip's end the frame of another clip of the same body is chosen whose pose and velocity lie nearest
              (`motion_features`; one of the best three by distance × (1 + times used), so that unused frames
              are favoured); it is aligned with the root on the plane and `blend` frames are cross-faded with a
              smooth step.  If no frame lies within `limit`, earlier exits are tried.
    Args      clips : list of Clip of one rate; limit [m] on the feature distance; stay [s] at least in each clip
    Returns   list of Clip (clips that are long enough pass as they are), StitchReport
    Raises    ValueError: clips of several rates
    Test      tests/test_mocap.py::test_stitch, ::test_stitch_joins, ::test_stitch_bodies
    """
    if len(rates := sorted({c.rate for c in clips})) > 1:
        raise ValueError(f"clips at {', '.join(f'{r:g}' for r in rates)} Hz: resample them to one rate first")
    report = StitchReport(limit=limit, frames=sum(map(len, clips)))
    out = [c for c in clips if c.seconds >= seconds]
    report.frames_used = sum(map(len, out))
    for body in sorted({c.body for c in clips}):
        group = [c for c in clips if c.body == body and c.seconds < seconds]
        out += _stitch_body(group, rng, seconds, limit, blend, stay, report)
    report.sequences, report.seconds = len(out), sum(c.seconds for c in out)
    return out, report


def _stitch_body(group, rng, seconds, limit, blend, stay, report):
    if not group:
        return []
    rate = group[0].rate
    keep = blend + int(stay * rate)  # frames an entered clip must still have
    feats = [motion_features(c) for c in group]
    entries = [np.arange(max(0, len(c) - keep)) for c in group]
    bank = np.concatenate([f[e] for f, e in zip(feats, entries, strict=True)])
    owner = np.repeat(np.arange(len(group)), [len(e) for e in entries])
    frame = np.concatenate(entries)
    norm = np.einsum("ij,ij->i", bank, bank)
    played = [np.zeros(len(c)) for c in group]  # how often each frame is in a sequence

    def nearest(clip, at):
        """(clip, frame, distance) to enter when leaving `clip` at frame `at`, or None."""
        d2 = norm - 2.0 * (bank @ feats[clip][at]) + feats[clip][at] @ feats[clip][at]
        d = np.sqrt(np.maximum(d2, 0.0))
        d[(owner == clip) & (np.abs(frame - at) < keep)] = np.inf  # not back to where it is
        if not len(d) or d.min() > limit:
            return None
        visits = np.concatenate([p[e] for p, e in zip(played, entries, strict=True)])
        score = np.where(d <= limit, d * (1.0 + visits), np.inf)
        pick = np.argsort(score, kind="stable")[:3]  # a choice among the best three: variety
        pick = pick[np.isfinite(score[pick])]
        k = int(rng.choice(pick))
        return int(owner[k]), int(frame[k]), float(d[k])

    sequences = []
    for start in rng.permutation(len(group)):
        if (played[start] > 0).mean() > 0.5:  # mostly in a sequence already
            continue
        parts, joins, length, clip, entry = [], [], 0, int(start), 0
        while True:
            last = len(group[clip]) - 1
            if (length + last + 1 - entry) / rate >= seconds:
                parts.append((clip, entry, last))
                length += last + 1 - entry
                break
            found = None
            for leave in range(last - blend, entry + keep - blend - 1, -3):
                found = nearest(clip, leave)
                if found:
                    break
            if not found:
                break
            parts.append((clip, entry, leave))
            length += leave - entry
            joins.append(found[2])
            clip, entry = found[0], found[1]
        if length / rate < seconds:
            continue
        for c, a, b in parts:
            played[c][a : b + 1] += 1
        sequences.append(_join([(group[c], a, b) for c, a, b in parts], blend, f"{group[start].name}+{len(parts) - 1}"))
        report.joins += len(joins)
        report.distances += joins
    report.frames_used += sum(int((p > 0).sum()) for p in played)
    report.lost += [c.name for c, u in zip(group, played, strict=True) if not u.any()]
    return sequences


def _join(parts, blend, name):
    """Cross-fade (clip, first, last) parts: each is aligned at its entry with the frame where the last is left."""
    clip, a, b = parts[0]
    pos, quat, ball = ([x[a:b]] for x in (clip.pos, clip.quat, clip.ball))
    current = clip
    for nxt, na, nb in parts[1:]:
        yaw = float(heading(current.quat[b, 0]) - heading(nxt.quat[na, 0]))
        nxt = place(nxt, yaw, nxt.pos[na, 0, :2], current.pos[b, 0, :2])
        x = (np.arange(blend) + 1.0) / (blend + 1.0)
        w = x * x * (3 - 2 * x)  # smooth step
        for store, old, new in ((pos, current.pos, nxt.pos), (ball, current.ball, nxt.ball)):
            store.append(old[b : b + blend] + w[:, None, None] * (new[na : na + blend] - old[b : b + blend]))
            store.append(new[na + blend : nb])
        w = np.tile(w[:, None], (1, len(SEGMENTS)))
        quat.append(quat_slerp(current.quat[b : b + blend], nxt.quat[na : na + blend], w))
        quat.append(nxt.quat[na + blend : nb])
        current, b = nxt, nb
    for store, values in ((pos, current.pos), (quat, current.quat), (ball, current.ball)):
        store.append(values[b : b + 1])
    pos, quat, ball = map(np.concatenate, (pos, quat, ball))
    return Clip(name, clip.body, clip.rate, pos, quat_continuous(quat), ball)


# ------------------------------------------------------------------------------------ data sets

SPLITS = ("train", "validation", "style", "body", "all")


def split_of(name: str) -> str:
    """Which part of a data set a clip belongs to: by its name only, so that no run can see a held-out clip by accident.

    body        : NAME.amc (unseen bodies)
    style       : the whole style `youthful` (unseen style)
    validation  : every clip whose trailing number ends in 5 (unseen clips; in LaFAN1 that is subject 5)
    train       : the rest
    Test        tests/test_mocap.py::test_split, tests/test_amc.py::test_body_split
    """
    if _is_amc(name):
        return "body"
    if "youthful" in name:
        return "style"
    number = re.search(r"(\d+)$", name)
    return "validation" if number and number.group(1).endswith("5") else "train"


def builtin_clips(rate=CONTROL_RATE, seed=0) -> list[Clip]:
    """The procedural human of gait.py: the data set that needs no download.  Test: test_mocap.py::test_builtin."""
    out = []
    library = gait.library(rate=rate, seed=seed)
    for i, m in enumerate(library):
        number = (i + 5) % len(library)  # so that the two clips held out, 005 and 015, are straight walks
        name = f"{m['name'].split('_')[1]}_{number:03d}"
        out.append(Clip(name, f"builtin-{number:03d}", m["rate"], m["pos"], m["quat"], m["ball"]))
    return out


def load(motion="builtin", rate=CONTROL_RATE, clips="*", split="all") -> list[Clip]:
    """Single clips of a data set, at one rate.

    Args      motion : "builtin", a .bvh or .amc file, or a folder of them (searched below)
              clips : shell pattern on the names
              split : train | validation | style | body | all.  A folder of fewer than ten files none of whose names is
              in the split is used whole, and says so.  .amc clips are in `body` alone, unless motion holds nothing
              else: then it is meant, its clips are also split by their numbers, and it says so
    Raises    UserError: nothing there, a malformed file, or nothing matches; names what would have been valid
    Test      tests/test_mocap.py::test_split, ::test_load_errors, ::test_bandai_loads_in_seconds,
              tests/test_amc.py::test_body_split
    """
    if split not in SPLITS:
        raise UserError(f"split {split!r} is unknown; valid: {', '.join(SPLITS)}")
    if motion == "builtin":
        items = [(c.name, c.name, c) for c in builtin_clips(rate)]
    else:
        path = Path(motion)
        if not path.exists():
            raise UserError(f"{motion}: no such file or folder; valid: builtin, a .bvh or .amc file, a folder of them")
        files = sorted(f for f in path.rglob("*") if f.suffix.lower() in (".bvh", ".amc")) if path.is_dir() else [path]
        if not files:
            raise UserError(f"{motion}: holds no .bvh file and no .amc file")
        meant = all(map(_is_amc, files)) and split not in ("body", "all")
        if meant:
            print(f"{motion}: only .amc files, else held out as unseen bodies; split by their numbers", file=sys.stderr)
        items = [(f.stem, f.name if _is_amc(f) and not meant else f.stem, f) for f in files]
    matching = [(name, split_of(key), item) for name, key, item in items if fnmatchcase(name, clips)]
    chosen = [item for _, part, item in matching if split in ("all", part)]
    bodies = sum(part == "body" for _, part, _ in matching)
    if split == "train" and bodies:
        print(f"{motion}: {bodies} .amc clips left out: unseen bodies, split body", file=sys.stderr)
    if not matching:
        names = [name for name, _, _ in items]
        more = f", … ({len(names)})" if len(names) > 6 else ""
        raise UserError(f"{motion}: no clip matches {clips!r}; there are {', '.join(names[:6])}{more}")
    if not chosen and motion != "builtin" and len(files) < 10 and split not in ("style", "body") and not bodies:
        print(f"{motion}: only {len(files)} clips, none to hold out: {split} uses all of them", file=sys.stderr)
        chosen = [item for _, _, item in matching]
    if not chosen:
        found = sorted({part for _, part, _ in matching})
        raise UserError(
            f"{motion}: none of the {len(matching)} clips that match {clips!r} is in split {split!r}; "
            f"they are in {' and '.join(found)}"
        )
    if motion == "builtin":
        return chosen
    return [resample(from_amc(f) if _is_amc(f) else from_bvh(f), rate) for f in chosen]


def sequences(
    motion="builtin", split="train", clips="*", rate=CONTROL_RATE, seed=0, limit=0.15, verbose=True
) -> list[Clip]:
    """Stitched sequences of a data set: what training and measuring use.  Test: tests/test_mocap.py::test_sequences.

    A set of which nothing can be joined into a sequence comes back as its single clips, and says so.
    """
    return _sequences(load(motion, rate, clips, split), f"{motion} [{split}]", seed, limit, verbose)


def _sequences(single, title, seed=0, limit=0.15, verbose=True):
    out, report = stitch(single, np.random.default_rng(seed), limit=limit)
    if verbose:
        result = str(report) if out else "too few to join: single clips are used"
        print(f"{title} {len(single)} clips, {sum(c.seconds for c in single) / 60:.1f} min -> {result}")
    return out or list(single)


# ------------------------------------------------------------------------------------ python mocap.py inspect


def describe(clip: Clip) -> str:
    """Rate, length, speed and contacts of a clip in one line.  Test: tests/test_mocap.py::test_inspect."""
    travel = np.linalg.norm(np.diff(clip.pos[:, 0, :2], axis=0), axis=-1).sum()
    speed = travel * clip.rate / max(len(clip) - 1, 1)
    c = contacts(clip)
    falls = int(np.sum(np.diff(c.astype(int), axis=0) > 0))
    return (
        f"{clip.name:36s} {clip.rate:5.1f} Hz {len(clip):5d} frames {clip.seconds:6.1f} s  "
        f"{travel:6.2f} m  {speed:4.2f} m/s  contact L {100 * c[:, 0].mean():3.0f} % R {100 * c[:, 1].mean():3.0f} %  "
        f"{falls:3d} footfalls  hips {clip.hip_height:.2f} m"
    )


def inspect(path) -> None:
    """Print what a file or a folder holds.  Test: tests/test_mocap.py::test_inspect."""
    path = Path(path)
    if path.is_dir():
        clips = load(path)
        for clip in clips:
            print(describe(clip))
        _sequences(clips, f"{path} [all]")
        return
    if _is_amc(path):
        clip, b, rig, joints = from_amc(path), _read_amc(path)[0], "cmu", CMU_BONES
    else:
        b = _read(path)
        clip, rig = _canonical(b), rig_of(b)
        joints = RIGS[rig].joints
    segment = {joint: s for s, joint in joints.items()}
    print(f"{path}: rig {rig}, {len(b.names)} joints")
    depth = []
    for name, parent in zip(b.names, b.parents):
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
        print(f"  {'  ' * depth[-1]}{name:18s} {segment.get(name, '')}".rstrip())
    print(describe(clip))


def main(argv=None) -> None:
    """python mocap.py inspect FILE|FOLDER."""
    parser = argparse.ArgumentParser(
        prog="mocap.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    sub = parser.add_subparsers(dest="command", required=True)
    p = sub.add_parser("inspect", help="print skeleton, rate, length, speed and contacts")
    p.add_argument("path", help="a .bvh or .amc file, or a folder of them")
    for each in (parser, p):  # one line, as in runs.cli
        each.error = lambda message: parser.exit(2, f"mocap.py: error: {message} (see --help)\n")
    inspect(parser.parse_args(argv).path)


if __name__ == "__main__":
    run_main(main)

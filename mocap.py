r"""Human motion: one canonical human, whatever the rig  [Reda23 §3.4, App. A].

    read a BVH ──► canonical Clip ──► resample ──► stitch ──► sensors, contacts
    (bvh.py)       15 segments        30 Hz        ≥ 30 s     §3.4    App. A
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
    body  : whose body it is (from a BVH: rig and limb lengths); only clips of one body are stitched together
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
    pos, quat = bvh.global_pose(b, root_offset)
    index = {n: i for i, n in enumerate(b.names)}
    cols = [index[rig.joints[s]] for s in SEGMENTS]
    p = pos[..., [2, 0, 1]] * rig.unit
    q = quat_mul(_Y_UP, quat_mul(quat[:, cols], _calibrations(name)))
    joint_pos = p[:, cols].copy()
    joint_pos[:, 0] = 0.5 * (joint_pos[:, SEG["thigh_l"]] + joint_pos[:, SEG["thigh_r"]])
    ball = p[:, [index[n] for n in rig.balls]]
    return Clip(Path(b.path).stem, name, 1.0 / b.frame_time, joint_pos, quat_continuous(q), ball)


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

SPLITS = ("train", "validation", "style", "all")


def split_of(name: str) -> str:
    """Which part of a data set a clip belongs to: by its name only, so that no run can see a held-out clip by accident.

    style       : the whole style `youthful` (unseen style)
    validation  : every clip whose trailing number ends in 5 (unseen clips; in LaFAN1 that is subject 5)
    train       : the rest
    Test        tests/test_mocap.py::test_split
    """
    if "youthful" in name:
        return "style"
    number = re.search(r"(\d+)$", name)
    return "validation" if number and number.group(1).endswith("5") else "train"


def builtin_clips(rate=CONTROL_RATE, seed=0) -> list[Clip]:
    """The procedural human of gait.py: the data set that needs no download.  Test: test_mocap.py::test_builtin."""
    return [
        Clip(f"{m['name']}_{i:03d}", f"builtin_{i:03d}", m["rate"], m["pos"], m["quat"], m["ball"])
        for i, m in enumerate(gait.library(rate=rate, seed=seed))
    ]


def load(motion="builtin", rate=CONTROL_RATE, clips="*", split="all") -> list[Clip]:
    """Single clips of a data set, at one rate.

    Args      motion : "builtin", a BVH file, or a folder of them (searched below); clips : shell pattern on the names
              split : train | validation | style | all.  A folder of fewer than ten files none of whose names is in the
              split is used whole, and says so
    Raises    UserError: nothing there, a malformed file, or nothing matches; names what would have been valid
    Test      tests/test_mocap.py::test_split, ::test_load_errors, ::test_bandai_loads_in_seconds
    """
    if split not in SPLITS:
        raise UserError(f"split {split!r} is unknown; valid: {', '.join(SPLITS)}")
    if motion == "builtin":
        items = {c.name: c for c in builtin_clips(rate)}.items()
    else:
        path = Path(motion)
        if not path.exists():
            raise UserError(f"{motion}: no such file or folder; valid: builtin, a .bvh file, or a folder of them")
        files = sorted(f for f in path.rglob("*") if f.suffix.lower() == ".bvh") if path.is_dir() else [path]
        if not files:
            raise UserError(f"{motion}: holds no .bvh file")
        items = [(f.stem, f) for f in files]
    matching = [(name, item) for name, item in items if fnmatchcase(name, clips)]
    chosen = [item for name, item in matching if split in ("all", split_of(name))]
    if not matching:
        names = [name for name, _ in items]
        more = f", … ({len(names)})" if len(names) > 6 else ""
        raise UserError(f"{motion}: no clip matches {clips!r}; there are {', '.join(names[:6])}{more}")
    if not chosen and motion != "builtin" and len(files) < 10 and split != "style":
        print(f"{motion}: only {len(files)} clips, none to hold out: {split} uses all of them", file=sys.stderr)
        chosen = [item for _, item in matching]
    if not chosen:
        found = sorted({split_of(name) for name, _ in matching})
        raise UserError(
            f"{motion}: none of the {len(matching)} clips that match {clips!r} is in split {split!r}; "
            f"they are in {' and '.join(found)}"
        )
    return chosen if motion == "builtin" else [resample(from_bvh(f), rate) for f in chosen]


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
    b = _read(path)
    rig = rig_of(b)
    segment = {joint: s for s, joint in RIGS[rig].joints.items()}
    print(f"{path}: rig {rig}, {len(b.names)} joints")
    depth = []
    for name, parent in zip(b.names, b.parents):
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
        print(f"  {'  ' * depth[-1]}{name:18s} {segment.get(name, '')}".rstrip())
    print(describe(_canonical(b)))


def main(argv=None) -> None:
    """python mocap.py inspect FILE|FOLDER."""
    parser = argparse.ArgumentParser(
        prog="mocap.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    sub = parser.add_subparsers(dest="command", required=True)
    p = sub.add_parser("inspect", help="print skeleton, rate, length, speed and contacts")
    p.add_argument("path", help="a .bvh file, or a folder of them")
    for each in (parser, p):  # one line, as in runs.cli
        each.error = lambda message: parser.exit(2, f"mocap.py: error: {message} (see --help)\n")
    inspect(parser.parse_args(argv).path)


if __name__ == "__main__":
    run_main(main)

r"""The canonical human: 15 named segments, rotations as quaternions, one motion as a Clip.

Every segment has a joint centre at its near end and an anatomical frame that equals the world's axes (x forward,
y left, z up) when the person stands upright with the arms hanging.  Metres, radians, seconds; quaternions w, x, y, z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


def sampled(clip: Clip, frames) -> Clip:
    """The clip at fractional frames (n,): positions linearly, rotations by slerp.

    Test      tests/mocap/test_mocap.py::test_resample"""
    frames = np.asarray(frames, float)
    i = np.clip(frames.astype(int), 0, max(len(clip) - 2, 0))
    j = np.minimum(i + 1, len(clip) - 1)
    w = frames - i

    def lerp(x):
        return x[i] + (x[j] - x[i]) * w[:, None, None]

    quat = quat_slerp(clip.quat[i], clip.quat[j], np.broadcast_to(w[:, None], (len(i), len(SEGMENTS))))
    return replace(clip, pos=lerp(clip.pos), quat=quat_continuous(quat), ball=lerp(clip.ball))


def resample(clip: Clip, rate: float) -> Clip:
    """The clip at another rate: positions linearly, rotations by slerp.

    Test      tests/mocap/test_mocap.py::test_resample"""
    if abs(clip.rate - rate) < 1e-3 * rate:
        return replace(clip, rate=rate)
    n = int(np.floor((len(clip) - 1) * rate / clip.rate + 1e-9)) + 1
    return replace(sampled(clip, np.arange(n) * clip.rate / rate), rate=rate)


def place(clip: Clip, yaw: float, pivot, to) -> Clip:
    """Turn by `yaw` about the vertical through `pivot` (2,), put it on `to` (2,).

    Test      tests/mocap/test_mocap.py::test_place."""
    r = np.eye(3)
    r[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pivot, to = np.append(pivot, 0.0), np.append(to, 0.0)
    move = lambda x: (x - pivot) @ r.T + to  # noqa: E731
    return replace(clip, pos=move(clip.pos), ball=move(clip.ball), quat=quat_mul(quat_about(2, yaw), clip.quat))


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
    Test      tests/mocap/test_mocap.py::test_sensors
    """
    idx = [SEG[s] for s in SENSORS]
    q = clip.quat[:, idx]
    return clip.pos[:, idx] + quat_rotate(q, np.broadcast_to(SENSOR_OFFSETS, q.shape[:2] + (3,))), q


def headset_height(clip: Clip) -> float:
    """Height of the headset when the user stands upright [m]: hips, trunk and neck stretched, the headset's offset.

    Test      tests/test_retarget.py::test_sensor_scale"""
    trunk = clip.limb("pelvis", "chest") + clip.limb("chest", "head")
    return clip.hip_height + trunk + float(SENSOR_OFFSETS[0, 2])


def contacts(clip: Clip) -> np.ndarray:
    r"""Human foot contacts  [Reda23 App. A]: height < 0.20 m above the ground and speed < 0.4 m/s.

    ASSUMED   the foot is its ankle OR its ball: from heel strike (ball still moving) to toe-off (heel already up)
    Returns   (T, 2) bool, left and right; computed on the human, before any scaling
    Test      tests/mocap/test_mocap.py::test_contacts
    """
    points = np.stack([clip.pos[:, FEET], clip.ball])  # (2, T, 2, 3): ankle, ball
    speed = np.stack([np.linalg.norm(linear_velocity(p, clip.rate), axis=-1) for p in points])
    return np.any((points[..., 2] < CONTACT_HEIGHT) & (speed < CONTACT_SPEED), axis=0)


def footfalls(contact, rate, apart=0.1) -> int:
    """How often a foot begins to touch that was in the air for `apart` seconds: a foot at the limits' edge chatters.

    Args      contact : (T, 2) bool; rate [Hz]
    Test      tests/mocap/test_mocap.py::test_footfalls
    """
    n = max(1, round(apart * rate))
    if len(contact) <= n:
        return 0
    before = np.lib.stride_tricks.sliding_window_view(contact[:-1], n, axis=0).any(axis=-1)
    return int(np.sum(contact[n:] & ~before))


def travelled(root) -> float:
    """Length of the root's path on the floor [m].  (T, 3) -> float

    Test      tests/test_metrics.py::test_metrics_on_known_motion, tests/mocap/test_mocap.py::test_inspect"""
    return float(np.linalg.norm(np.diff(root[:, :2], axis=0), axis=-1).sum())


SEGMENTS = (
    "pelvis", "chest", "head",
    "thigh_l", "shin_l", "foot_l", "thigh_r", "shin_r", "foot_r",
    "upper_arm_l", "forearm_l", "hand_l", "upper_arm_r", "forearm_r", "hand_r",
)  # fmt: skip
PARENTS = (-1, 0, 1, 0, 3, 4, 0, 6, 7, 1, 9, 10, 1, 12, 13)
SEG = {name: i for i, name in enumerate(SEGMENTS)}
FEET = (SEG["foot_l"], SEG["foot_r"])
CONTACT_HEIGHT, CONTACT_SPEED = 0.20, 0.40  # m, m/s  [Reda23 App. A]

# ------------------------------------------------------------------------------------ quaternions


def quat_mul(a, b):
    """Hamilton product of quaternions w, x, y, z, (..., 4) each.  Test: tests/mocap/test_mocap.py::test_quaternions."""
    a, b = np.asarray(a), np.asarray(b)
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    out = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    out[..., 0] = aw * bw - ax * bx - ay * by - az * bz
    out[..., 1] = aw * bx + ax * bw + ay * bz - az * by
    out[..., 2] = aw * by - ax * bz + ay * bw + az * bx
    out[..., 3] = aw * bz + ax * by - ay * bx + az * bw
    return out


def quat_conj(q):
    """Inverse of a unit quaternion.  (..., 4) -> (..., 4).  Test: tests/mocap/test_mocap.py::test_quaternions."""
    return np.asarray(q) * np.array([1, -1, -1, -1], dtype=np.asarray(q).dtype)


def cross(a, b):
    """Vector product (..., 3); np.cross, twice as fast.  Test: tests/mocap/test_mocap.py::test_quaternions."""
    out = np.empty(np.broadcast_shapes(np.shape(a), np.shape(b)), np.result_type(a, b))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def quat_rotate(q, v):
    """Rotate vectors v (..., 3) by q = (w, u): v + 2 w (u×v) + 2 u×(u×v).

    Test      tests/mocap/test_mocap.py::test_quaternions."""
    q, v = np.asarray(q), np.asarray(v)
    u, w = q[..., 1:], q[..., :1]
    t = 2.0 * cross(u, v)
    return v + w * t + cross(u, t)


def quat_matrix(q):
    """Rotation matrices (..., 3, 3) of quaternions (..., 4).  Test: tests/mocap/test_mocap.py::test_quaternions."""
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def quat_about(axis: int, angle):
    """Turn by `angle` (...) about coordinate axis 0, 1 or 2 -> (..., 4).

    Test      tests/mocap/test_mocap.py::test_quaternions."""
    angle = np.asarray(angle, dtype=float)
    q = np.zeros(angle.shape + (4,))
    q[..., 0], q[..., 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return q


def quat_angle(a, b):
    """Geodesic angle θ = |log(a b⁻¹)| in [0, π] of unit quaternions; q and −q are one rotation.

    Equation  |a − b| = 2 sin θ/4, |a + b| = 2 cos θ/4, or the other way round where a·b < 0
    Test      tests/mocap/test_mocap.py::test_quaternions"""
    half = np.sum(np.square(a - b), -1), np.sum(np.square(a + b), -1)
    return 4.0 * np.arctan2(np.sqrt(np.minimum(*half)), np.sqrt(np.maximum(*half)))


def quat_slerp(a, b, t):
    """Slerp along the shorter arc.  a, b (..., 4), t (...) in [0, 1].

    Test      tests/mocap/test_mocap.py::test_resample."""
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
    """Signs such that consecutive frames lie in one hemisphere.  q (T, ..., 4).

    Test      tests/mocap/test_mocap.py::test_resample."""
    flip = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=-1, keepdims=True) < 0, -1.0, 1.0), axis=0)
    return np.concatenate([q[:1], q[1:] * flip])


def angular_velocity(q, rate):
    r"""World-frame angular velocity by central differences of log(q_{t+1} q_{t-1}⁻¹).

    Equation  ω_t = log(q_{t+1} q_{t−1}^{-1}) / (2 Δt), one-sided at both ends
    Args      q : (T, ..., 4); rate [Hz]
    Returns   (T, ..., 3) [rad/s], world frame
    Test      tests/mocap/test_mocap.py::test_velocities
    """
    nxt, prv = np.concatenate([q[1:], q[-1:]]), np.concatenate([q[:1], q[:-1]])
    d = quat_mul(nxt, quat_conj(prv))
    d = np.where(d[..., :1] < 0, -d, d)
    s = np.linalg.norm(d[..., 1:], axis=-1, keepdims=True)
    log = d[..., 1:] * np.where(s < 1e-9, 2.0, 2.0 * np.arctan2(s, d[..., :1]) / np.maximum(s, 1e-12))
    return log * _span(len(q), rate).reshape((-1,) + (1,) * (q.ndim - 1))


def linear_velocity(x, rate):
    """Central differences of x (T, ...), one-sided at the ends, per second.

    Test      tests/mocap/test_mocap.py::test_velocities."""
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
              the projected forward axis would
    Args      q : (..., 4) root orientation, world frame
    Returns   (...) [rad]
    Test      tests/mocap/test_mocap.py::test_heading_does_not_flip
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
    measured : headset's height that a stream's first second would show [m]; None: of a user who stands straight
    still : frames at the beginning in which the user stands still (`mocap.augment.lead`)
    """

    name: str
    body: str
    rate: float
    pos: np.ndarray
    quat: np.ndarray
    ball: np.ndarray
    measured: float | None = None
    still: int = 0

    def __len__(self):
        return len(self.pos)

    @property
    def seconds(self):
        return len(self.pos) / self.rate

    def __getitem__(self, s: slice) -> Clip:
        still = max(self.still - s.indices(len(self))[0], 0)
        return replace(self, pos=self.pos[s], quat=self.quat[s], ball=self.ball[s], still=still)

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

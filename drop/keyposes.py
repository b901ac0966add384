r"""Procedural motions from key poses: rising from the back and from the front, and a backflip.

A key pose says where hips, ankles and wrists are and how pelvis, chest, head and feet are pitched; monotone cubic
curves lead from one to the next, two-bone inverse kinematics finds the limbs between, and the lowest sphere touches the
floor in every frame.  They are what HuMoR has from AMASS and our captures lack: people who lie, kneel and get up.

Sources
  [VanSant88]  VanSant 1988, Rising from a supine position to erect stance, Physical Therapy 68(2): the commonest
               combination of young adults is symmetrical: the trunk flexes forward to sitting, then squat, then stance.
  [Ulbrich00]  Ulbrich, Raheja, Alexander 2000, Body positions used by healthy and frail older adults to rise from the
               floor, J. Am. Geriatrics Soc. 48(12): on hands and knees, then half kneeling on one foot, then stance.
  [Flash85]    minimum-jerk profile, as in mocap/gait.py.
ASSUMED: the places and times of the keys, which the sources describe in words.  SI units, z up, x forward at the end,
floor at z = 0; the body is drop/body.py's.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from drop import body
from drop.body import OFFSETS, RADII, STEP, J
from human import SEGMENTS
from mocap import gait

BODY = gait.Body(1.75)
SPLIT = 0.10  # m, ASSUMED: half the distance between the feet
STANDING_HIPS = BODY.ankle_height + BODY.thigh + BODY.shin - 0.012  # knees are not locked

# Columns of a key: time [s]; hips x, z; pitch of pelvis, chest, head [degrees, face down +]; the leading (left) ankle's
# x, z and its foot's pitch (toes down +); the other's; the left wrist's x, y outwards, z; the other's.
_KEYS = {
    "supine": (  # [VanSant88]
        (0.0, 0.00, 0.09, -90, -90, -88, 0.84, 0.075, -50, 0.84, 0.075, -50, 0.05, 0.32, 0.05, 0.05, 0.32, 0.05),
        (0.8, 0.00, 0.10, -25, 25, 15, 0.44, 0.068, 0, 0.44, 0.068, 0, 0.35, 0.22, 0.38, 0.35, 0.22, 0.38),
        (1.4, 0.20, 0.26, 5, 45, 15, 0.44, 0.068, 0, 0.44, 0.068, 0, 0.80, 0.20, 0.50, 0.80, 0.20, 0.50),
        (1.9, 0.36, 0.58, 25, 35, 10, 0.44, 0.068, 0, 0.44, 0.068, 0, 0.70, 0.22, 0.65, 0.70, 0.22, 0.65),
        (2.6, 0.46, STANDING_HIPS, 1, 2, 2, 0.44, 0.068, 0, 0.44, 0.068, 0, 0.48, 0.24, 0.845, 0.48, 0.24, 0.845),
    ),
    "prone": (  # [Ulbrich00]
        (0.0, 0.00, 0.09, 90, 90, 80, -0.84, 0.075, 140, -0.84, 0.075, 140, 0.28, 0.30, 0.05, 0.28, 0.30, 0.05),
        (0.9, -0.30, 0.49, 70, 78, 55, -0.72, 0.075, 130, -0.72, 0.075, 130, 0.20, 0.22, 0.05, 0.20, 0.22, 0.05),
        (1.3, -0.32, 0.52, 50, 60, 40, -0.30, 0.16, 60, -0.72, 0.10, 80, 0.22, 0.22, 0.10, 0.22, 0.22, 0.05),
        (1.8, -0.22, 0.53, 12, 18, 10, 0.12, 0.068, 0, -0.64, 0.12, 65, 0.16, 0.16, 0.56, -0.12, 0.26, 0.55),
        (2.4, -0.02, 0.72, 20, 25, 10, 0.12, 0.068, 0, -0.52, 0.16, 55, 0.16, 0.16, 0.62, 0.02, 0.26, 0.68),
        (2.8, 0.08, 0.87, 8, 10, 5, 0.12, 0.068, 0, -0.15, 0.20, 35, 0.14, 0.20, 0.84, 0.12, 0.24, 0.84),
        (3.2, 0.14, STANDING_HIPS, 1, 2, 2, 0.12, 0.068, 0, 0.12, 0.068, 0, 0.16, 0.24, 0.845, 0.16, 0.24, 0.845),
    ),
    "flip": (  # before the turn: crouch, leap, tuck, reach for the floor, crouch, stand
        (0.0, 0.02, STANDING_HIPS, 1, 2, 2, 0.0, 0.068, 0, 0.0, 0.068, 0, 0.04, 0.24, 0.845, 0.04, 0.24, 0.845),
        (0.6, -0.16, 0.60, 35, 40, 10, 0.0, 0.068, 0, 0.0, 0.068, 0, -0.35, 0.26, 0.85, -0.35, 0.26, 0.85),
        (0.9, 0.00, 0.95, -5, -10, -15, 0.0, 0.11, 25, 0.0, 0.11, 25, 0.15, 0.22, 1.85, 0.15, 0.22, 1.85),
        (1.2, 0.00, 0.95, 10, 35, 20, 0.18, 0.68, 10, 0.18, 0.68, 10, 0.36, 0.20, 0.90, 0.36, 0.20, 0.90),
        (1.5, 0.00, 0.95, 25, 25, 0, 0.14, 0.20, 0, 0.14, 0.20, 0, 0.45, 0.25, 1.15, 0.45, 0.25, 1.15),
        (1.8, -0.08, 0.66, 35, 40, 5, 0.0, 0.068, 0, 0.0, 0.068, 0, 0.50, 0.25, 0.95, 0.50, 0.25, 0.95),
        (2.6, 0.02, STANDING_HIPS, 1, 2, 2, 0.0, 0.068, 0, 0.0, 0.068, 0, 0.04, 0.24, 0.845, 0.04, 0.24, 0.845),
    ),
}  # fmt: skip
FLIGHT = (0.9, 1.55)  # s of the flip in the air
RISES = ("supine", "prone")
HOLD = 0.8  # s of standing at the end


def _pitch(degrees):
    return Rotation.from_euler("y", np.asarray(degrees)[:, None], degrees=True).as_matrix()


def key_pose_motion(kind, tempo=1.0, lead="l", rate=1.0 / STEP):
    r"""One of RISES, or a flip before it turns, as the character's motion.

    Method    monotone cubic curves through the keys; thighs, shins and arms by `mocap.gait.two_bone_leg`, knees towards
              the front, elbows towards the back; the body is put so that its lowest sphere touches the floor
    ASSUMED   elbows bend back and outwards; the keys
    Args      kind : supine, prone or flip; tempo : above 1 is faster; lead : the leg that is set up first, l or r
    Returns   x (T, 22, 3) [m], quat (T, 22, 4), world
    Raises    ValueError: unknown kind, lead or tempo
    Test      tests/drop/test_drop_rising.py::test_key_poses
    """
    if kind not in _KEYS or lead not in ("l", "r") or not 0.2 <= tempo <= 5.0:
        valid = f"{', '.join(_KEYS)}; l, r; 0.2 to 5"
        raise ValueError(f"key poses {kind!r}, lead {lead!r}, tempo {tempo}: valid are {valid}")
    keys = np.array(_KEYS[kind], float)
    t = np.arange(0.0, keys[-1, 0] / tempo + HOLD, 1.0 / rate)
    v = PchipInterpolator(keys[:, 0], keys[:, 1:], axis=0)(np.minimum(t * tempo, keys[-1, 0])).T
    hips = np.stack([v[0], 0 * t, v[1]], axis=1)
    rots = {"pelvis": _pitch(v[2]), "chest": _pitch(v[3]), "head": _pitch(v[4])}
    chest = hips + rots["pelvis"] @ BODY.chest
    for i, side in enumerate((lead, "r" if lead == "l" else "l")):
        sign = 1.0 if side == "l" else -1.0
        ax, az, foot = v[5 + 3 * i : 8 + 3 * i]
        wx, wy, wz = v[11 + 3 * i : 14 + 3 * i]
        hip = hips + rots["pelvis"] @ [0, sign * BODY.hip_half_width, 0]
        ankle = np.stack([ax, 0 * t + sign * SPLIT, az], axis=1)
        front = rots["pelvis"] @ np.array([1.0, 0.06 * sign, 0.0])
        thigh, shin = gait.two_bone_leg(hip, ankle, front, BODY.thigh, BODY.shin)
        rots[f"thigh_{side}"], rots[f"shin_{side}"] = thigh, shin
        rots[f"foot_{side}"] = _pitch(foot)
        shoulder = chest + rots["chest"] @ (BODY.shoulder * [1, sign, 1])
        wrist = np.stack([wx, sign * wy, wz], axis=1)
        back = rots["chest"] @ np.array([-1.0, 0.5 * sign, 0.0])
        upper, fore = gait.two_bone_leg(shoulder, wrist, back, BODY.upper_arm, BODY.forearm)
        # an arm's bones bend about −y: the elbow goes back where a knee would go to the front
        rots[f"upper_arm_{side}"], rots[f"forearm_{side}"] = _facing(upper), _facing(fore)
        rots[f"hand_{side}"] = rots[f"forearm_{side}"]
    quat = np.stack([Rotation.from_matrix(rots[s]).as_quat(scalar_first=True) for s in SEGMENTS], axis=1)
    quat = body.joint_rotations(quat)
    above_hips = np.array([0.0, 0.0, -OFFSETS[J["hip_l"], 2]])
    x = body.forward_kinematics(hips + rots["pelvis"] @ above_hips, quat)
    return on_the_floor(x), quat


def _facing(R):
    """A bone's frame (T, 3, 3) turned about the bone by 180 degrees: its x axis to the other side."""
    return R * np.array([-1.0, -1.0, 1.0])


def on_the_floor(x):
    """A motion (T, 22, 3) moved up or down in each frame until its lowest sphere touches z = 0.

    Test: tests/drop/test_drop_rising.py::test_key_poses"""
    return x - (x[..., 2] - RADII).min(axis=-1)[..., None, None] * [0, 0, 1]


def leap(turns=1.0):
    r"""A backflip: the keys of `flip`, turned backwards about the centre of mass while it flies; a jump with 0 turns.

    Equation  in flight c(t) = c_0 + v t + g t²/2 with the v that lands it in time, and x = c + R_y(−2π n s)(x' − c'),
              n turns, s the time of the flight from 0 to 1
    ASSUMED   the keys, and that the turn goes evenly over the flight
    Returns   x (T, 22, 3) [m], quat (T, 22, 4)
    Test      tests/drop/test_drop_rising.py::test_backflip
    """
    x, quat = key_pose_motion("flip")
    t = np.arange(len(x)) * STEP
    com, (a, b) = x.mean(axis=1), FLIGHT
    s = (t - a) / (b - a)
    inside = (s > 0) & (s < 1)
    first, last = com[s <= 0][-1], com[s >= 1][0]
    path = com.copy()
    path[inside] = first + s[inside, None] * (last - first)
    path[inside, 2] += 0.5 * 9.81 * (b - a) ** 2 * (s * (1 - s))[inside]
    turn = Rotation.from_euler("y", -2 * np.pi * turns * np.clip(s, 0, 1)[:, None])
    x = path[:, None] + np.einsum("tij,tkj->tki", turn.as_matrix(), x - com[:, None])
    q = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True)
    spun = Rotation.from_quat(np.repeat(turn.as_quat(), quat.shape[1], axis=0)) * q
    return x, spun.as_quat(scalar_first=True).reshape(quat.shape)


def rises(tempos=(0.9, 1.15)):
    """(name, x, quat) of every way to rise: both kinds, both legs, some tempos; clips for a prior.

    Test: tests/drop/test_drop_rising.py::test_key_poses"""
    return [
        (f"rise_{kind}_{lead}_{tempo:g}", *key_pose_motion(kind, tempo, lead))
        for kind in RISES for lead in "lr" for tempo in tempos
    ]  # fmt: skip

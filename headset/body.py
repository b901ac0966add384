r"""A body for a recording that has none: people who play, as motion to train on.

    recording ──► Guard ──► 30 Hz ──► pelvis under the headset, planted feet, two-bone arms ──► Clip

The three devices are the recording's own; the body is a guess that moves as a standing player's does.  It is a training
signal, as the kinematic retargeting is: the feet of the real player may have stood elsewhere.
"""

from __future__ import annotations

import os

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from headset.axes import Choice, choose
from headset.bsor import opened
from headset.calibration import Resampler, standing_height
from headset.reader import Clock, Guard, Sample, files_of, sound, to_world
from human import SEG, SEGMENTS, SENSOR_OFFSETS, Clip, heading, quat_about, quat_continuous, quat_matrix, quat_rotate
from mocap.data import CONTROL_RATE
from mocap.gait import Body, smooth, two_bone_leg
from plumbing.cli import UserError, printable

# ASSUMED, all of it: how a player's body goes with the head
PELVIS_LAG, YAW_LAG = 0.2, 0.5  # s, standard deviations of the averages that pelvis and trunk follow the head by
BACK = 0.6  # m that the hips go back for each metre that the head sinks
STEP_FAR, STEP_TURN = 0.12, 0.5  # m, rad that a foot may be from its place before it steps
STEP_SECONDS, STEP_LIFT = 0.35, 0.05  # s, m of a step
STANCE = 0.085  # m, half the distance of standing feet, of a person of 1.75 m
ELBOW = np.array([-0.5, 0.4, -0.8])  # where the left elbow points, in the chest's frame


def read_recording(path, how: Choice | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A recording's devices at the control rate, mended by the Guard.  -> pos (T, 3, 3), quat (T, 3, 4), our axes

    Args      how : its axes, grip, unit and order of the devices; by default what `headset.axes.choose` finds
    Raises    UserError: it cannot be read, or shows no headset
    Test      tests/headset/test_body.py::test_recordings, test_axes_of_players"""
    how = how or choose(path)
    order, clock, guard, resampler, ticks = list(how.order), Clock(), Guard(), Resampler(CONTROL_RATE), []
    for sample in opened(path)[1]:
        t = clock.stamp(sample.t)
        if t is not None:
            poses = to_world(sample.pos[order], sample.quat[order], how.axes, how.grip, how.unit)
            for good in guard.push(Sample(t, *poses)):
                ticks += resampler.push(good)
    if not ticks:
        raise UserError(f"{path}: shows no headset; valid: a recording of one")
    return np.stack([t.pos for t in ticks]), np.stack([t.quat for t in ticks])


def embodied(pos, quat, name="recording", rate=CONTROL_RATE) -> Clip:
    r"""A canonical human who wears the three devices.

    Equation  stature of `mocap.gait.Body` by the standing headset's height.  Pelvis below the head, which it follows by
              an average of PELVIS_LAG, BACK of the head's sinking behind it, as high as a trunk of constant length
              lets it be; trunk along the line from pelvis to head.  Feet by `plant_feet`; legs by two-bone inverse
              kinematics, arms likewise, elbows along ELBOW
    Args      pos (T, 3, 3) [m], quat (T, 3, 4) of headset, left and right controller, floor at z = 0
    Returns   Clip; its `human.sensors` are the given poses
    Test      tests/headset/test_body.py::test_sensors_are_the_recording, test_limbs, test_feet_stay
    """
    body = Body((standing_height(pos[:, 0]) - SENSOR_OFFSETS[0, 2]) / 0.91)
    joints = pos - quat_rotate(quat, np.broadcast_to(SENSOR_OFFSETS, pos.shape))  # head, wrists
    head, size, n = joints[:, 0], body.height / 1.75, len(pos)
    yaw = gaussian_filter1d(np.unwrap(heading(quat[:, 0])), YAW_LAG * rate, mode="nearest")
    trunk, offset = _trunk(body, head, yaw, rate)
    pelvis = head - offset
    r_yaw = quat_matrix(quat_about(2, yaw))
    up = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    r_chest = _upright(up, r_yaw[:, :, 0])
    half = np.array([0.0, 0.0, 1.0]) + up
    r_pelvis = _upright(half / np.linalg.norm(half, axis=1, keepdims=True), r_yaw[:, :, 0])
    places, rots = np.zeros((n, len(SEGMENTS), 3)), np.tile(np.eye(3), (n, len(SEGMENTS), 1, 1))
    places[:, 0], rots[:, 0] = pelvis, r_pelvis
    places[:, SEG["chest"]], rots[:, SEG["chest"]] = pelvis + up * body.chest[2], r_chest
    places[:, SEG["head"]], rots[:, SEG["head"]] = head, quat_matrix(quat[:, 0])
    ball = np.zeros((n, 2, 3))
    ankles, foot_yaw = plant_feet(pelvis, yaw, STANCE * size, body.ankle_height, rate)
    for k, side in enumerate("lr"):
        sign = 1.0 - 2.0 * k
        thigh, shin, foot, upper, fore, hand = (
            SEG[f"{s}_{side}"] for s in ("thigh", "shin", "foot", "upper_arm", "forearm", "hand")
        )
        places[:, thigh] = pelvis + r_pelvis @ np.array([0.0, sign * body.hip_half_width, 0.0])
        places[:, foot] = ankles[:, k]
        rots[:, foot] = quat_matrix(quat_about(2, foot_yaw[:, k]))
        rots[:, thigh], rots[:, shin] = two_bone_leg(
            places[:, thigh], ankles[:, k], r_yaw[:, :, 0], body.thigh, body.shin
        )
        places[:, shin] = places[:, thigh] - body.thigh * rots[:, thigh, :, 2]
        ball[:, k] = ankles[:, k] + rots[:, foot] @ body.ball
        places[:, upper] = places[:, SEG["chest"]] + r_chest @ (body.shoulder * [1.0, sign, 1.0])
        places[:, hand], rots[:, hand] = joints[:, 1 + k], quat_matrix(quat[:, 1 + k])
        rots[:, upper], rots[:, fore] = two_bone_arm(
            places[:, upper], joints[:, 1 + k], r_chest @ (ELBOW * [1.0, sign, 1.0]), body.upper_arm, body.forearm
        )
        places[:, fore] = places[:, upper] - body.upper_arm * rots[:, upper, :, 2]
    q = Rotation.from_matrix(rots.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(n, len(SEGMENTS), 4)
    return Clip(name, name, rate, places, quat_continuous(q), ball)


def _trunk(body, head, yaw, rate):
    """The trunk's length [m], and from the pelvis to the head joint (T, 3)."""
    length, stands = body.chest[2] + body.head[2], 0.91 * body.height
    sunk = gaussian_filter1d(np.maximum(stands - head[:, 2], 0.0), PELVIS_LAG * rate, mode="nearest")
    below = gaussian_filter1d(head[:, :2], PELVIS_LAG * rate, axis=0, mode="nearest")
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    flat = head[:, :2] - below + BACK * sunk[:, None] * ahead
    far = np.linalg.norm(flat, axis=1, keepdims=True)
    flat *= np.minimum(1.0, 0.7 * length / np.maximum(far, 1e-9))
    high = np.sqrt(length**2 - np.sum(flat**2, axis=1))
    # legs are not longer than straight: the trunk stretches where the head is on tiptoe
    high = np.maximum(high, head[:, 2] - (0.53 * body.height + 0.06))
    return length, np.concatenate([flat, high[:, None]], axis=1)


def _upright(up, forward):
    """Frames (T, 3, 3) whose z axis is up (T, 3), a unit vector, and whose x axis is as far as possible forward."""
    y = np.cross(up, forward)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([np.cross(y, up), y, up], axis=2)


def plant_feet(pelvis, yaw, half, height, rate):
    r"""Feet that stay where they stand, and step where they would have to stand now.

    Method    a foot steps when it is STEP_FAR from its place beside the pelvis, or turned by STEP_TURN, and the other
              one stands: in STEP_SECONDS (minimum jerk) to where its place will be by then
    Args      pelvis (T, 3), yaw (T,); half : half the distance of the feet [m]; height : of the ankle [m]
    Returns   ankles (T, 2, 3) [m]; yaw (T, 2) [rad]
    Test      tests/headset/test_body.py::test_feet_stay
    """
    n, steps = len(pelvis), max(round(STEP_SECONDS * rate), 1)
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    place = np.stack([pelvis[:, :2] + half * left, pelvis[:, :2] - half * left], axis=1)  # (T, 2, 2)
    ankles, turned = np.zeros((n, 2, 3)), np.zeros((n, 2))
    at, facing, swing = place[0].copy(), np.array([yaw[0], yaw[0]]), None
    for t in range(n):
        if swing is None:
            off = np.maximum(np.linalg.norm(place[t] - at, axis=1) / STEP_FAR, np.abs(yaw[t] - facing) / STEP_TURN)
            k = int(np.argmax(off))
            if off[k] > 1.0:
                goal = min(t + steps, n - 1)
                swing = k, t, at[k].copy(), facing[k], place[goal, k], yaw[goal]
        ankles[t, :, :2], ankles[t, :, 2], turned[t] = at, height, facing
        if swing:
            k, began, start, was, goal, wanted = swing
            s = (t - began) / steps
            done = float(smooth(s))
            at[k], facing[k] = start + done * (goal - start), was + done * (wanted - was)
            ankles[t, k] = [*at[k], height + STEP_LIFT * 4.0 * s * (1.0 - s)]
            turned[t, k] = facing[k]
            if t - began >= steps:
                swing = None
    return ankles, turned


def two_bone_arm(shoulder, wrist, elbow, a, b):
    r"""Two-bone inverse kinematics of an arm: rotations of upper arm and forearm.

    Equation  as a leg's knee (`mocap.gait.two_bone_leg`), in the plane of shoulder, wrist and `elbow`, the way in which
              the elbow points; then half a turn about the bones, because an elbow bends the other way
    Args      shoulder, wrist, elbow : (T, 3) world; a, b : lengths of upper arm and forearm [m]
    Returns   (T, 3, 3) each, world
    Test      tests/headset/test_body.py::test_two_bone_arm
    """
    upper, fore = two_bone_leg(shoulder, wrist, elbow, a, b)
    half_turn = np.array([-1.0, -1.0, 1.0])
    return upper * half_turn, fore * half_turn


def recordings_of(folder) -> list:
    """The recordings of a folder, or the one that it is.  UserError, before anything is read: there are none

    Test      tests/headset/test_body.py::test_recordings"""
    files = files_of(folder) if os.path.exists(folder) else []
    if not files:
        why = "no recordings" if os.path.exists(folder) else "no such file or folder"
        raise UserError(f"--players {folder}: {why}; valid: .csv or .bsor files that `play.py --stream` reads")
    return files


def players(folder) -> list[Clip]:
    """A body for every recording of a folder that shows a standing player; others are left out, and named.

    Axes      each file's own, or those that fit it best (`headset.axes.choose`)
    Raises    UserError: no recordings there, or none that can be read
    Test      tests/headset/test_body.py::test_recordings, test_axes_of_players"""

    def embody(file):
        how = choose(file)
        pos, quat = read_recording(file, how)
        for line in how.told:
            print(printable(f"{file}: {line}"))
        height = standing_height(pos[:, 0])
        if not 1.0 <= height <= 2.1:
            raise UserError(f"{file}: the headset is {height:.2f} m up; valid: 1.0 to 2.1 m, the floor at 0")
        return embodied(pos, quat, file.stem)

    out, broken = sound(embody, recordings_of(folder))
    for error in broken:
        print(f"left out: {error}")
    return out

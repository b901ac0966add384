r"""One capture, many users: mirrored, at another speed, of another build and bearing, standing before and after.

    clips ──► augment   mirror, restyle, warp, resize: another person does the same
          └─► visits    lead: stands still, sets off, does it, stops, stands: what a headset's user does
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from human import (
    PARENTS,
    SEG,
    SEGMENTS,
    Clip,
    heading,
    headset_height,
    quat_about,
    quat_conj,
    quat_continuous,
    quat_mul,
    quat_rotate,
    quat_slerp,
    resample,
    sampled,
    sensors,
)
from mocap.gait import two_bone_leg

# ------------------------------------------------------------------------------------ other users, other gaits

_MIRRORED = tuple(SEG[s[:-2] + {"_l": "_r", "_r": "_l"}[s[-2:]] if s[-2:] in ("_l", "_r") else s] for s in SEGMENTS)
_ARMS = tuple(tuple(SEG[f"{s}_{side}"] for s in ("upper_arm", "forearm", "hand")) for side in "lr")


def mirror(clip: Clip) -> Clip:
    r"""The clip seen in a mirror: left and right change places.

    Equation  p' = M p, R' = M R M with M = diag(1, -1, 1); in quaternions (w, x, y, z) -> (w, -x, y, -z)
    Why       the anatomical frames are symmetric, so that M R M is the other side's frame
    Test      tests/mocap/test_mocap.py::test_mirror
    """
    flip = np.array([1.0, -1.0, 1.0])
    quat = clip.quat[:, _MIRRORED] * [1.0, -1.0, 1.0, -1.0]
    pos, ball = clip.pos[:, _MIRRORED] * flip, clip.ball[:, ::-1] * flip
    return replace(clip, name=f"{clip.name}-mirrored", pos=pos, quat=quat, ball=ball)


def warp(clip: Clip, speed: float) -> Clip:
    """The clip played `speed` times as fast, at the same frame rate.  Test: tests/mocap/test_mocap.py::test_warp."""
    return resample(replace(clip, name=f"{clip.name}-speed{speed:.2f}", rate=clip.rate * speed), clip.rate)


def reverse(clip: Clip) -> Clip:
    r"""The clip played backwards: of somebody who walks, somebody who walks backwards.

    Equation  p'(t) = p(T − t), and so all else
    Source    joint angles of backward walking are nearly those of forward walking in reverse [Thorstensson 1986;
              Winter, Pluck and Yang 1989]; a run's are not
    Test      tests/mocap/test_mocap.py::test_reverse"""
    flipped = {name: getattr(clip, name)[::-1].copy() for name in ("pos", "quat", "ball")}
    return replace(clip, name=f"{clip.name}-reversed", still=0, **flipped)


def resize(clip: Clip, height=1.0, arms=1.0, trunk=1.0) -> Clip:
    r"""The same motion by a user `height` times as tall, whose arms and trunk are `arms` and `trunk` times as long in
    proportion to the legs.

    Equation  chest' = pelvis + s (chest − pelvis), head' = chest' + s (head − chest); a shoulder keeps its place
              across the chest and rises along it: shoulder' = chest' + R diag(1, 1, s) Rᵀ (shoulder − chest)
    Why       people's trunks differ more than their stature says: the headset of a CMU subject is 1.65 hip heights
              high, of Bandai's actor 1.47
    All positions grow with the height, travel included: a taller person's steps are longer.
    Test      tests/mocap/test_mocap.py::test_resize, test_resize_trunk
    """
    pos = clip.pos * height
    pelvis, chest, head = pos[:, 0].copy(), pos[:, SEG["chest"]].copy(), pos[:, SEG["head"]].copy()
    pos[:, SEG["chest"]] = risen = pelvis + trunk * (chest - pelvis)
    pos[:, SEG["head"]] = risen + trunk * (head - chest)
    up = quat_rotate(clip.quat[:, SEG["chest"]], np.array([0.0, 0.0, 1.0]))
    for arm in _ARMS:
        along = np.sum((pos[:, arm[0]] - chest) * up, axis=1, keepdims=True)
        pos[:, arm] += (risen - chest + (trunk - 1.0) * along * up)[:, None]
    for shoulder, elbow, hand in _ARMS:
        upper, fore = pos[:, elbow] - pos[:, shoulder], pos[:, hand] - pos[:, elbow]
        pos[:, elbow] = pos[:, shoulder] + arms * upper
        pos[:, hand] = pos[:, elbow] + arms * fore
    tag = f"-h{height:.2f}a{arms:.2f}t{trunk:.2f}"
    return replace(clip, name=clip.name + tag, body=clip.body + tag, pos=pos, ball=clip.ball * height)


# Another bearing: segment -> standard deviation [rad] of a constant turn about its parent's x, y, z.  ASSUMED: about as
# far as the mean poses of Bandai's styles lie apart.  Both arms are raised (x), swung forward (y) and turned (z) alike,
# with a fifth of it of their own; elbows only bend further.
_BEARING = {"chest": (0.04, 0.10, 0.05), "head": (0.05, 0.12, 0.08), "upper_arm": (0.12, 0.20, 0.10)}
_ELBOW = 0.5  # rad, standard deviation of a further bend, forward
_GRIP = (0.25, 0.35, 0.35)  # rad, of how a controller lies in the hand; no character follows the hand's rotation


def restyle(clip: Clip, rng: np.random.Generator, swing=(0.1, 1.6), bearing=1.0) -> Clip:
    r"""The same steps with another bearing: trunk, head and arms carried otherwise, swung more or less.

    Equation  of a segment relative to its parent:  R' = exp(φ) R̄ exp(g log(R̄⁻¹ R)), R̄ its mean over the clip
    Symbols   φ a constant turn, normal with standard deviations `_BEARING`; g in `swing`, one for the trunk and head,
              one for the arms
    Why       styles that were never recorded differ from those that were above all in this; pelvis and legs, and with
              them the feet's contacts, stay as they are
    Args      clip, rng; swing : least and most of g; bearing : share of φ, 0 for none
    Returns   Clip; bones keep their lengths
    Test      tests/mocap/test_mocap.py::test_restyle
    """
    rest = dict(zip(SEGMENTS, np.moveaxis(clip.quat, 1, 0)))
    pos, quat = clip.pos.copy(), clip.quat.copy()
    trunk, arms = rng.uniform(*swing, 2)
    both = rng.normal(0.0, _BEARING["upper_arm"])
    bend = bearing * abs(rng.normal(0.0, _ELBOW))
    for i, name in enumerate(SEGMENTS):
        up = PARENTS[i]
        if up < 0 or name[:-2] in ("thigh", "shin", "foot"):
            continue
        own, parent = rest[name], rest[SEGMENTS[up]]
        local = quat_mul(quat_conj(parent), own)  # (T, 4)
        phi, g = np.zeros(3), arms
        if name in ("chest", "head"):
            phi, g = bearing * rng.normal(0.0, _BEARING[name]), trunk
        elif name.startswith("upper_arm"):
            side = 1.0 if name.endswith("_l") else -1.0
            phi = bearing * (both + 0.2 * rng.normal(0.0, _BEARING["upper_arm"])) * [side, 1.0, side]
        elif name.startswith("forearm"):
            phi = np.array([0.0, -bend, 0.0])
        elif name.startswith("hand"):
            phi = bearing * rng.normal(0.0, _GRIP)
        local = Rotation.from_quat(local, scalar_first=True)
        mean = local.mean()
        new = mean * Rotation.from_rotvec(g * (mean.inv() * local).as_rotvec())
        new = new * Rotation.from_rotvec(phi) if name.startswith("forearm") else Rotation.from_rotvec(phi) * new
        arm = quat_rotate(quat_conj(parent), clip.pos[:, i] - clip.pos[:, up])  # bone, in the parent's frame
        pos[:, i] = pos[:, up] + quat_rotate(quat[:, up], arm)
        quat[:, i] = quat_mul(quat[:, up], new.as_quat(scalar_first=True))
    return replace(clip, name=f"{clip.name}-restyled", pos=pos, quat=quat_continuous(quat))


def looking(clip: Clip, degrees=20.0, period=3.0) -> Clip:
    r"""The same by a user who looks to the left and to the right, in turn.

    Equation  R' = R_z(a sin(2π t / T)) R_head about the head's joint, a `degrees`, T `period` [s]
    Test      tests/mocap/test_mocap.py::test_looking"""
    t, quat, head = np.arange(len(clip)) / clip.rate, clip.quat.copy(), SEG["head"]
    yaw = np.deg2rad(degrees) * np.sin(2 * np.pi * t / period)
    quat[:, head] = quat_mul(quat_about(2, yaw), quat[:, head])
    return replace(clip, quat=quat)


ASIDE, IN_TURN = 45.0, (2.0, 6.0)  # degrees at most; s from left to left.  ASSUMED
FASTEST = 4.0  # m/s, ASSUMED: the fastest second of Bandai's runs


def fastest_second(clip: Clip) -> float:
    """Way of the root on the floor in its fastest second, or the mean speed of less [m/s].

    Test      tests/mocap/test_mocap.py::test_fastest_second"""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(clip.pos[:, 0, :2], axis=0), axis=-1))])
    n = max(min(round(clip.rate), len(way) - 1), 1)
    return float(np.max(way[n:] - way[:-n], initial=0.0) * clip.rate / n)


def augment(
    clips: list[Clip], rng: np.random.Generator, speed=0.15, height=0.2, arms=0.2, trunk=(0.95, 1.45),
    swing=(0.1, 1.6), bearing=1.0, looks=0.5,
) -> list[Clip]:  # fmt: skip
    """Every clip, and its mirror image with another bearing at a random speed by a user of random height, arm and trunk
    length, who may look about.

    Args      speed, height, arms : ranges, as shares: speed in 1 +- speed, and so on; trunk : least and most, not even
              about 1 because the trunk of Bandai's actor is short (`resize`); swing, bearing : of `restyle`;
              looks : share of them who look left and right all the time (`looking`), by ASIDE or less
    ASSUMED   nobody's fastest second exceeds FASTEST, whatever the drawn speed: no policy follows that, and `--balance`
              would spend its time on it
    Returns   twice as many clips, the given ones first
    Test      tests/mocap/test_mocap.py::test_augment
    """
    draw = lambda r: float(rng.uniform(1.0 - r, 1.0 + r))  # noqa: E731
    users = [(draw(speed), draw(height), draw(arms), float(rng.uniform(*trunk))) for _ in clips]
    pace = [min(v, FASTEST / max(h * fastest_second(c), 1e-6)) for c, (v, h, *_) in zip(clips, users, strict=True)]
    aside = [(rng.uniform(0.0, ASIDE) * (rng.random() < looks), rng.uniform(*IN_TURN)) for _ in clips]
    other = (warp(restyle(mirror(c), rng, swing, bearing), v) for c, v in zip(clips, pace, strict=True))
    about = (looking(c, *a) for c, a in zip(other, aside, strict=True))
    return list(clips) + [resize(c, *user) for c, (_, *user) in zip(about, users, strict=True)]


# ------------------------------------------------------------------------------------ standing before and after

MOVING = 0.2  # m/s: a clip whose first frames have a faster headset or hand begins in motion
LONGEST = 15.0  # s of a clip in one visit
BACKWARDS, WALKS = 0.15, (0.4, 1.8)  # share of other users' walks that go backwards; m/s of a walk.  ASSUMED
ACCELERATION = (1.2, 2.6)  # m/s², ASSUMED: with which a visitor who runs sets off; the row `streamed` has up to 2.7


def planted(clip: Clip, share) -> Clip:
    r"""The legs moved towards standing: feet flat on the floor below the hips, the rest of the body as it is.

    Equation  of thigh, shin and foot:  R' = slerp(R, R_standing, 3 s² − 2 s³);  R_standing by two-bone inverse
              kinematics from the hip to an ankle as high as this clip's lowest, straight below it
    Why       a walk that is stopped in mid-stride leaves its user on one leg, and no user stands so (ASSUMED)
    Args      share : (T,) s, 0 as it is to 1 standing
    Returns   Clip; bones keep their lengths
    Test      tests/mocap/test_mocap.py::test_planted
    """
    pos, quat, ball = clip.pos.copy(), clip.quat.copy(), clip.ball.copy()
    share = np.asarray(share, float)
    share = share * share * (3.0 - 2.0 * share)
    yaw = heading(clip.quat[:, 0])
    forward, flat = np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1), quat_about(2, yaw)
    for k, side in enumerate("lr"):
        thigh, shin, foot = (SEG[f"{s}_{side}"] for s in ("thigh", "shin", "foot"))
        bone = {  # in the frame of the segment at its near end
            i: quat_rotate(quat_conj(clip.quat[:, i]), end - clip.pos[:, i])
            for i, end in ((thigh, clip.pos[:, shin]), (shin, clip.pos[:, foot]), (foot, clip.ball[:, k]))
        }
        ankle = clip.pos[:, thigh].copy()
        ankle[:, 2] = np.percentile(clip.pos[:, foot, 2], 5)
        lengths = [np.linalg.norm(bone[i], axis=1).mean() for i in (thigh, shin)]
        for i, goal in zip((thigh, shin), two_bone_leg(clip.pos[:, thigh], ankle, forward, *lengths), strict=True):
            mean = bone[i].mean(axis=0)  # a rig's bone is not quite the segment's axis
            axis = Rotation.align_vectors([[0.0, 0.0, -1.0]], [mean / np.linalg.norm(mean)])[0]
            standing = (Rotation.from_matrix(goal) * axis).as_quat(scalar_first=True)
            quat[:, i] = quat_slerp(clip.quat[:, i], standing, share)
        quat[:, foot] = quat_slerp(clip.quat[:, foot], flat, share)
        pos[:, shin] = pos[:, thigh] + quat_rotate(quat[:, thigh], bone[thigh])
        pos[:, foot] = pos[:, shin] + quat_rotate(quat[:, shin], bone[shin])
        ball[:, k] = pos[:, foot] + quat_rotate(quat[:, foot], bone[foot])
    return replace(clip, pos=pos, quat=quat_continuous(quat), ball=ball)


def lead(clip: Clip, still=1.5, rise=1.5, out=0.0) -> Clip:
    r"""The clip with a lead-in: the user stands in its first pose, then its time speeds up from 0 to 1.

    Equation  frame τ(t) of the clip:  dτ/dt = 0 for `still` s, then t / rise for `rise` s, then 1; with `out` the same
              backwards at the end, and `out` s of standing.  While dτ/dt < 1 the feet are `planted` by the rest
    Args      still, rise, out : [s]; a clip too short for its rises gets shorter ones
    Returns   Clip; `measured` is the headset's height while it stands, which is what a stream is calibrated by
    Source    spec of the row `streamed`: 1.5 s each
    Test      tests/mocap/test_mocap.py::test_lead, test_lead_against_scipy
    """
    rate, last = clip.rate, len(clip) - 1.0
    rise = min(rise, 2.0 * last / rate / (2 if out else 1))
    n = 2 * round(rise * rate / 2)  # even: the clip's own frames are played after it, none between two
    up = np.arange(1, n + 1) / max(n, 1)  # dτ/dt while it speeds up
    ramp = np.arange(1, n + 1) ** 2 / (2.0 * max(n, 1))  # frames
    begun = ramp[-1] if n else 0.0
    stop = last - begun if out else last
    middle = np.arange(begun + 1.0, stop + 1e-9)
    down = last - ramp[::-1] if out else np.zeros(0)
    down = down[down > (middle[-1] if len(middle) else begun)]
    waits = [round(still * rate) + 1, round(out * rate) + 1 if out else 0]
    frames = np.concatenate([np.zeros(waits[0]), ramp, middle, down, np.full(waits[1], last)])
    speed = np.concatenate(
        [np.zeros(waits[0]), up, np.ones(len(middle)), np.linspace(1, 0, len(down) + 1)[1:], np.zeros(waits[1])]
    )
    height = float(sensors(clip[:1])[0][0, 0, 2])
    led = sampled(clip, frames)
    led = planted(led, 1.0 - speed) if n else led  # who begins still stands on own feet already
    return replace(led, measured=height, still=waits[0])


def begins_in_motion(clip: Clip) -> bool:
    """Whether a device moves faster than MOVING in the clip's first tenth of a second.

    Test      tests/mocap/test_mocap.py::test_lead"""
    first = sensors(clip[: max(2, round(clip.rate / 10) + 1)])[0]
    return bool(np.linalg.norm(np.diff(first, axis=0), axis=-1).max(initial=0.0) * clip.rate > MOVING)


def visits(clips: list[Clip], rng: np.random.Generator) -> list[Clip]:
    """Every clip twice, as it is and by another user (`augment`), with a lead-in and a lead-out of random lengths.

    ASSUMED   standing 0.6 to 1.6 s, speeding up in 0.8 to 1.6 s, or longer where ACCELERATION to the fastest second
              takes longer, standing 0.5 to 2.5 s at the end; longer clips in parts of LONGEST s, a rest shorter than
              half left out; the height that calibrates is that of the first pose in 70 % of the visits, otherwise
              between it and the user's who stands straight, with a deviation of 1.2 %
    ASSUMED   a share BACKWARDS of the other users who walk do so backwards (`reverse`)
    Why       nine captures of steps backwards are too few to learn them from, and every user makes some;
              a user who runs as fast as ever 0.8 s after standing loses every character, which then learns nothing
    Test      tests/mocap/test_mocap.py::test_visits
    """
    n, out = round(LONGEST * clips[0].rate) if clips else 0, []
    parts = [c[a : a + n] for c in clips for a in range(0, max(len(c) - n // 2, 1), n)]
    for k, clip in enumerate(augment(parts, rng)):
        if k >= len(parts) and WALKS[0] < fastest_second(clip) < WALKS[1] and rng.random() < BACKWARDS:
            clip = reverse(clip)
        rise = max(rng.uniform(0.8, 1.6), fastest_second(clip) / rng.uniform(*ACCELERATION))
        led = lead(clip, rng.uniform(0.6, 1.6), rise, rng.uniform(0.5, 2.5))
        share = 1.0 if rng.random() < 0.7 else rng.random()
        height = share * led.measured + (1.0 - share) * headset_height(clip)
        out.append(replace(led, name=f"{led.name}-visit", measured=height * rng.normal(1.0, 0.012)))
    return out

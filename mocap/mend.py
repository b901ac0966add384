r"""What real files have that a reader does not expect: a rest pose in front, a floor that is elsewhere, a wrong rate.

    rest pose    frame 0 is often the T-pose that an exporter put there, metres away: `leading_rest` counts such frames
    floor        the origin lies beside the floor: `floor_of` says where the feet rest
    frame rate   120 Hz data under a header of 30 Hz: `gait_rate` says at which rate these steps would be a human's

Each gives a number; `mocap.rigs` acts on it, says so in one line, and has a flag that forbids it.
"""

from __future__ import annotations

import numpy as np

from human import FEET, Clip, heading

# ------------------------------------------------------------------------------------ a rest pose in front

REST_FRAMES = 600  # at most so many: 5 s at 120 Hz
REST_JUMP = 0.1  # of the body's size, from the rest pose to the motion: 17 cm of an adult in one frame
REST_RATIO = 2.5  # of the fastest that follows
REST_ALIKE = 2e-3  # of the body's size: how far the frames of a rest pose differ
REST_STILL = 1.5  # instead of 2.5, after two frames or more in which nothing moves at all: nobody stands so still
STILL = 1e-5  # of the body's size: what files round by
REST_SEEN = 1000  # frames that are compared


def leading_rest(pos) -> int:
    r"""Frames at the beginning that are a rest pose and not motion.

    Rule      the frames are alike, and then some joint moves by more than a tenth of the body's size in one frame and
              by 2.5 times as much as any joint does in the 99th percentile of what follows, and the next five;
              after frames that are the same to the digit, by 1.5 times: hanging arms where the walk begins
    ASSUMED   the numbers.  No rate is needed: a wrong one must not hide the jump
    Args      pos : (T, J, 3) joints, any unit
    Returns   0 to REST_FRAMES
    Test      tests/mocap/test_mend.py::test_leading_rest, ::test_no_rest_pose
    """
    pos = pos[:REST_SEEN]
    if len(pos) < 8:
        return 0
    size = float(np.median(np.linalg.norm(np.ptp(pos, axis=1), axis=-1)))
    if not size > 0:
        return 0
    step = np.linalg.norm(np.diff(pos, axis=0), axis=-1).max(axis=1) / size
    still = True
    for k in range(min(REST_FRAMES, len(step) - 6)):
        if k and step[k - 1] > REST_ALIKE:
            break
        still = still and (k == 0 or step[k - 1] < STILL)
        if step[k] <= REST_JUMP:
            continue
        after = max(np.percentile(step[k + 1 :], 99), step[k + 1 : k + 6].max())
        if step[k] > (REST_STILL if k and still else REST_RATIO) * after:
            return k + 1
    return 0


def may_rest(values) -> bool:
    """Whether some channel jumps near the beginning as after a rest pose: cheap, before any kinematics.

    Test      tests/mocap/test_mend.py::test_leading_rest"""
    step = np.abs(np.diff(values[: REST_FRAMES + 8], axis=0))
    step = np.minimum(step, np.abs(step - 360.0))  # an angle that goes from 180 to -180 does not jump
    if len(step) < 7:
        return False
    first = step[:-5]
    after = np.max([step[i : i + len(first)] for i in range(1, 6)], axis=0)
    return bool((first > REST_STILL * after + 1e-9).any())


# ------------------------------------------------------------------------------------ a floor that is elsewhere

FLOOR_LIMIT = 0.06  # m, how far from its place a standing ball may be before the floor is moved
BALL_HEIGHT = 0.02  # m, of a standing ball's joint; where the foot ends it is 0
# Of thigh and shin together, how high an ankle may stand: 0.039 / 0.491 of them (Drillis and Contini 1966), and a sole
# of 2.5 cm under 0.81 m.  Recorded: 0.07 to 0.10, Bandai's 0.15
ANKLE = 0.11


def floor_of(clip: Clip, ends=False) -> float:
    r"""Height of the floor: where the lower foot's ball is in the lowest fifth of the frames, less what a ball has.

    ASSUMED   a joint at the ball stands 2 cm high, the end of a foot on the floor, but no farther below the ankle than
              a sole can be (ANKLE): exporters put End Sites where they please.  Feet stand in a fifth of the frames.
              Within 6 cm nothing is said: rigs differ by as much (Bandai's toes stand at 4 cm)
    Args      ends : the balls are End Sites
    Returns   [m], 0 if the feet rest where the file's floor is, or if the body would sink into the other one
    Test      tests/mocap/test_mend.py::test_floor, tests/mocap/test_rigs.py::test_floor
    """
    soles = clip.ball[..., 2] - BALL_HEIGHT
    if ends:
        leg = np.mean([clip.limb(f"thigh_{s}", f"shin_{s}") + clip.limb(f"shin_{s}", f"foot_{s}") for s in "lr"])
        soles = np.maximum(clip.ball[..., 2], clip.pos[:, FEET, 2] - ANKLE * leg)
    low = float(np.percentile(soles.min(axis=1), 20))
    if abs(low) <= FLOOR_LIMIT:
        return 0.0
    lowest = np.percentile(clip.pos[..., 2].min(axis=1), 5)  # somebody who kneels or lies has the feet up
    return 0.0 if low > 0 and lowest < low - FLOOR_LIMIT else low


# ------------------------------------------------------------------------------------ a rate that is wrong

# m s: length of a step over steps a second, of an adult at any speed (Sekiya et al. 1996: 0.0065 m/(steps/min))
WALK_RATIO = 0.39
CADENCE = (1.2, 3.2)  # steps a second, slow walking to running
STEP_LENGTH = (0.25, 2.0)  # m: what is shorter is no walk
STEADY = 1.6  # ratio of the quartiles of what the steps say, of a walk
# A rate over what the gait says is 0.69 to 1.87 in 780 recorded walks and runs of three studios.
RATE_RANGE = (0.6, 1.9)
RATES = (30.0, 60.0, 120.0, 25.0, 24.0, 50.0, 100.0, 240.0, 90.0, 72.0, 200.0, 480.0)  # Hz, commonest first
LEAST_RATE = 10.0  # Hz


def gait_rate(clip: Clip) -> float | None:
    r"""The frame rate at which the clip's steps are a human's; None where there are too few.

    Equation  W = L / f, so f = L / W: L the step's length, which needs no rate, W the walk ratio; the rate is the
              frames of a step times f.  L and W grow with the legs: both are taken for hips 0.9 m high
    Method    a step is from one extreme of the left foot before the right, along the pelvis' heading, to the other;
              the median over steps of 0.25 to 2 m that go where the pelvis faces.  It is a walk if these are most of
              the steps, and alike: dancers and fencers have paces of their own
    Test      tests/mocap/test_mend.py::test_gait_rate, ::test_recorded_gaits
    """
    yaw = heading(clip.quat[:, 0])
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    scale = 0.9 / clip.hip_height
    apart = scale * np.sum((clip.pos[:, FEET[0], :2] - clip.pos[:, FEET[1], :2]) * ahead, axis=-1)
    turns = extremes(apart, 0.2)
    if len(turns) < 4:
        return None
    place = scale * clip.pos[:, 0, :2]
    step = place[turns[1:]] - place[turns[:-1]]
    length, frames = np.linalg.norm(step, axis=-1), np.diff(turns)
    along = np.sum(step * ahead[(turns[1:] + turns[:-1]) // 2], axis=-1)
    walks = (length > STEP_LENGTH[0]) & (length < STEP_LENGTH[1]) & (along > 0.8 * length)
    if walks.sum() < 3 or walks.mean() < 0.6:
        return None
    rates = frames[walks] * np.clip(length[walks] / WALK_RATIO, *CADENCE)
    low, rate, high = np.percentile(rates, [25, 50, 75])
    return float(rate) if high < STEADY * low else None


def extremes(x, apart):
    """Frames at which x turns, by at least `apart`.  Test: tests/mocap/test_mend.py::test_extremes"""
    turns, high, low, rising = [], 0, 0, None
    for k, value in enumerate(x):
        high = k if value > x[high] else high
        low = k if value < x[low] else low
        if rising is not False and value < x[high] - apart:
            turns += [high] if rising else []
            rising, low = False, k
        elif rising is not True and value > x[low] + apart:
            turns += [low] if rising is False else []
            rising, high = True, k
    return np.array(turns, int)


def doubt_rate(clip: Clip) -> str | None:
    """What is wrong with the frame rate, and which would fit; None: nothing, or too few steps to tell.

    Test      tests/mocap/test_mend.py::test_gait_rate, ::test_recorded_gaits"""
    fits = gait_rate(clip)
    if fits and not RATE_RANGE[0] < clip.rate / fits < RATE_RANGE[1]:
        meant = common_rate(fits, clip.rate)
        return (
            f"nobody walks like this at {clip.rate:.4g} frames a second: its steps fit {fits:.0f}; probably "
            f"--rate {meant:g}"
        )
    if clip.rate < LEAST_RATE and len(clip) > 2:
        return f"{clip.rate:.4g} frames a second: no capture is so slow; say what it is with --rate, as --rate 30"
    return None


def common_rate(rate: float, header: float) -> float:
    """The rate that was probably meant: near what fits, the header's times 2, 4 … or half of it …; else the commonest.

    Test      tests/mocap/test_mend.py::test_common_rate"""
    near = [r for r in RATES if abs(np.log(r / rate)) < 0.35]
    doubled = [r for r in near if abs(np.log2(r / header) - round(np.log2(r / header))) < 0.02]
    return (doubled or near or [float(f"{rate:.2g}")])[0]

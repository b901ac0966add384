r"""Built-in motions of people who exercise in place: squats, toe touches, lunges, jumping jacks, boxing.

    EXERCISES ──► _repeat: keys, one repetition after the other ──► _between ──► a pose at every frame
    pose ──► feet on the floor, trunk and arms by their angles ──► the pelvis by balance ──► legs by two-bone IK

A headset sinks by half its height when its user touches the toes, and flies when they jump, and neither is in a walk.
An exercise is a few key poses, min-jerk between them [Flash85], again and again, larger and smaller, quicker and
slower.  Where the pelvis is comes out of the balance: the centre of mass stays above the feet that bear it.

Frames, units and the human are those of mocap/gait.py, whose limbs these are; sources not named there
  [Winter09]   Winter, Biomechanics and Motor Control of Human Movement, 4th ed., table 4.1: masses of the segments.
ASSUMED   the poses and the numbers below that name no source: gymnastics as taught at school, no recorded person.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d

from mocap.gait import DEG, GRAVITY, Body, about, clip_of, lowered, noise, pose_body, reached, rotate, smooth

# A pose.  Trunk [deg]: bow forwards, tilt to the left, turn to the left about the vertical (a bowed trunk swings to
# that side, it does not twist); nod and look of the head beside it; dip [m]: how far the pelvis sinks.  Feet, left and
# right: ahead, out to its side, up [m], toe up [deg].  Arms as in mocap/gait.py [deg]: flexion, abduction, inward
# rotation, elbow.  All metres are those of a person of 1.75 m.
TRUNK = ("bow", "tilt", "turn", "nod", "look", "dip")
FOOT, ARM = ("ahead", "out", "up", "toe"), ("flex", "abd", "inward", "elbow")
CHANNELS = (*TRUNK, *(f"{name}_{e}" for e in "lr" for name in (*FOOT, *ARM)))
STANDS = {"out": 0.085, "abd": 8, "inward": 8, "elbow": 12}
MASSES = {  # [Winter09, table 4.1], as shares of the whole body's; of a limb one side's
    "trunk": 0.497, "head": 0.081, "upper_arm": 0.028, "forearm": 0.016, "hand": 0.006,
    "thigh": 0.100, "shin": 0.0465, "foot": 0.0145,
}  # fmt: skip
UPPER, FORE, THIGH, SHIN = 0.436, 0.430, 0.433, 0.433  # [Winter09, table 4.1]: where a limb's mass is, from its origin
PELVIS = {"bow": 0.55, "tilt": 0.2, "turn": 0.35}  # the pelvis' share of the trunk's angles
HEAD = {"bow": (0.8, "nod"), "tilt": (0.6, None), "turn": (0.6, "look")}  # and the head's, and what it adds
BEARS = 0.15  # a lifted foot's weight to a standing one's: for a quick step the trunk does not shift all the way
SWAY = 0.30  # s: half of the time over which the weight changes feet
STEP = (0.04, 0.12)  # a foot is lifted by so many metres, and by this share of the step's length
FLIES = (0.4, 0.3)  # share of a jump's move spent in the air, and at most so many seconds
STRAIGHT, SOFT = 6 * DEG, 0.15  # the straightest knee; s: as long before and after the pelvis gives way to short legs


@dataclass(frozen=True)
class Exercise:
    """One exercise.

    seconds : range of a repetition's length; moves : (share of it, the pose's channels that differ from `base`; None
    holds the pose), where a name of FOOT or ARM means both sides, `_near` and `_far` sides that change with every
    repetition, as does the sign of turn; base : the pose it starts from; jumps : every move is a jump; wanders : m, how
    far a repetition may step in any direction"""

    seconds: tuple[float, float]
    moves: tuple
    base: dict | None = None
    jumps: bool = False
    wanders: float = 0.0


GUARD = {"ahead_l": 0.16, "ahead_r": -0.14, "out": 0.13, "dip": 0.04, "flex": 50, "elbow": 125, "inward": 25, "bow": 8}
WINGS = {"out": 0.28, "abd": 85, "elbow": 4}
BACK: dict = {}  # to the base
TOES = {"bow": 108, "flex": 100, "elbow": 4, "dip": 0.05}
SQUAT = {"dip": 0.30, "bow": 38, "flex": 95, "elbow": 5}
ONE_FOOT = {"bow": 98, "turn": 35, "flex_far": 100, "abd_far": 10, "flex_near": -30, "abd_near": 50, "dip": 0.04}
PICKS_UP = {"ahead_near": 0.22, "bow": 72, "turn": 20, "dip": 0.24, "flex_near": 85, "elbow_near": 8, "flex_far": 20}
STEPPED = {"ahead_near": 0.62, "toe_far": -35, "dip": 0.10}
DEEP = STEPPED | {"toe_far": -48, "dip": 0.30, "bow": 8}
KNEE = {"up_near": 0.36, "ahead_near": 0.16, "toe_near": -15, "flex_far": 45, "elbow": 80}
PUNCH = {"flex_near": 88, "elbow_near": 12, "inward_near": 40, "turn": -28, "bow": 14}
EXERCISES = {
    "bend": Exercise((2.0, 4.5), ((0.2, {"flex": 165, "elbow": 5}), (0.35, TOES), (0.1, None), (0.35, BACK))),
    "squat": Exercise((1.6, 3.5), ((0.45, SQUAT), (0.1, None), (0.45, BACK))),
    "windmill": Exercise((1.4, 3.0), ((0.45, ONE_FOOT), (0.1, None), (0.45, BACK)), WINGS),
    "pick": Exercise((1.8, 3.5), ((0.4, PICKS_UP), (0.15, None), (0.45, BACK)), wanders=0.15),
    "jack": Exercise((0.9, 1.4), ((0.5, {"out": 0.34, "abd": 150, "elbow": 20}), (0.5, BACK)), jumps=True),
    "hop": Exercise((0.5, 0.8), ((1.0, {"elbow": 50}),), {"elbow": 40}, jumps=True, wanders=0.08),
    "lunge": Exercise((2.4, 4.2), ((0.3, STEPPED), (0.2, DEEP), (0.2, STEPPED), (0.3, BACK))),
    "raise": Exercise((0.8, 1.8), ((0.5, KNEE), (0.5, BACK))),
    "box": Exercise((0.45, 1.1), ((0.35, PUNCH), (0.65, BACK)), GUARD, wanders=0.20),
}
# Of `library`: nine, not ten, as clips 0 and 10 are held out (`mocap.data.builtin_clips`) and would be all of one kind.
MIX = tuple((kind, {}) for kind in EXERCISES)


def _pose(base, changes, near) -> np.ndarray:
    """(c,) in the order of CHANNELS: what is common to both sides first, then what a side has of its own."""
    far = "r" if near == "l" else "l"
    out = dict.fromkeys(CHANNELS, 0.0)
    for one in (STANDS, base, changes):
        for name, value in one.items():
            if name in (*FOOT, *ARM):
                out[f"{name}_l"] = out[f"{name}_r"] = value
        for name, value in one.items():
            if name == "turn":
                out[name] = value if near == "l" else -value
            elif name not in (*FOOT, *ARM):
                out[name.replace("_near", f"_{near}").replace("_far", f"_{far}")] = value
    return np.array(list(out.values()))


@dataclass
class _Keys:
    """(k,) key poses in time; `_repeat` makes them, `_between` is what lies between them."""

    times: np.ndarray  # s
    poses: np.ndarray  # (k, c) in the order of CHANNELS
    places: np.ndarray  # (k, 2) of the middle between the feet, ahead and to the left [m]
    jumps: np.ndarray  # whether one jumps to get there


def _repeat(one: Exercise, duration, rng, variation) -> _Keys:
    """An exercise over and over: bouts of repetitions, and pauses.

    A bout has 3 to 8 of them, a pause 0.5 to 2 s.  A repetition is 0.6 to 1.1 times as far as EXERCISES says (a
    jump as high as its time allows), to the other side than the one before; who wanders does so in 0.3 of them, and
    takes sides by chance."""
    base, near = one.base or {}, "l"
    stand = _pose(base, {}, near)
    now, place = rng.uniform(0.8, 1.6), np.zeros(2)
    keys = [(0.0, stand, place, False)]
    while now < duration:
        for _ in range(rng.integers(3, 9)):
            far = 1.0 - variation * rng.uniform(-0.1, 0.4)
            near = str(rng.choice(["l", "r"])) if one.wanders else "lr"[near == "l"]
            if one.wanders and rng.uniform() < 0.3:
                place = np.clip(place + rng.uniform(-one.wanders, one.wanders, 2), -0.5, 0.5)
            length = rng.uniform(*one.seconds)
            keys.append((now, *keys[-1][1:3], False))
            for share, changes in one.moves:
                now += share * length
                goal = keys[-1][1] if changes is None else stand + far * (_pose(base, changes, near) - stand)
                keys.append((now, goal, place, one.jumps))
        now += rng.uniform(0.5, 2.0)
    return _Keys(*map(np.array, zip(*keys, strict=True)))


def _between(keys: _Keys, t):
    """What lies between the keys, minimum-jerk [Flash85].

    A foot that is put elsewhere is lifted by STEP; if both are, one after the other.  In a jump the knees bend, both
    feet leave the floor and fly as a stone does, for FLIES of the move, and the knees bend again.
    Equation  up(t) = g (t - a) (b - t) / 2 in a flight from a to b; before it, for G seconds, the pelvis sinks by
              v G u² (1 - u), u from 0 to 1, so that it leaves with the speed v = g (b - a) / 2; after it in reverse
    Returns   poses (T, c); feet (T, 2, 3) left, right: ahead, to the left, above the floor [m]; flight (T,): how
              much of the feet's height is the jump's, and sinks (T,): how far the pelvis goes down around it [m]"""
    k = np.clip(np.searchsorted(keys.times, t, side="right") - 1, 0, len(keys.times) - 2)
    span = keys.times[k + 1] - keys.times[k]
    s, jumps = np.clip((t - keys.times[k]) / span, 0.0, 1.0), keys.jumps[k + 1]
    air = np.minimum(FLIES[0], FLIES[1] / span)  # of the move
    aloft = np.clip((s - 0.5) / air + 0.5, 0.0, 1.0)
    flight = np.where(jumps, 0.5 * GRAVITY * (air * span) ** 2 * aloft * (1 - aloft), 0.0)
    ground = 0.5 * (1 - air)  # of the move, before and after
    u = np.clip(np.minimum(s, 1 - s) / ground, 0.0, 1.0)
    sinks = np.where(jumps, 0.5 * GRAVITY * air * ground * span**2 * u * u * (1 - u), 0.0)
    mix = lambda values, go: values[k] + (values[k + 1] - values[k]) * go[:, None]  # noqa: E731
    poses = mix(keys.poses, smooth(s))
    at = [keys.places + keys.poses[:, [CHANNELS.index(f"{name}_{e}") for name in ("ahead", "out")]] * [1, sign]
          for e, sign in (("l", 1), ("r", -1))]  # fmt: skip
    far = [np.linalg.norm(p[k + 1] - p[k], axis=1) for p in at]
    both = (np.minimum(*far) > 0.01) & ~jumps
    feet = np.zeros((len(t), 2, 3))
    for j, e in enumerate("lr"):
        own = np.where(both, np.clip(2 * s - j, 0.0, 1.0), s)
        feet[:, j, :2] = mix(at[j], smooth(np.where(jumps, aloft, own)))
        step = np.where(far[j] > 0.01, STEP[0] + STEP[1] * far[j], 0.0) * 16 * own**2 * (1 - own) ** 2
        feet[:, j, 2] = poses[:, CHANNELS.index(f"up_{e}")] + np.where(jumps, flight, step)
    return poses, feet, flight, sinks


def _feet(body, poses, feet):
    """World poses of both feet, as `gait.pose_body` takes them; a foot with its toes down stands on its ball."""
    out = []
    for j, e in enumerate("lr"):
        rot = about("y", -poses[:, CHANNELS.index(f"toe_{e}")] * DEG)
        ankle = feet[:, j] + [0, 0, body.ankle_height] + body.ball - rotate(rot, body.ball)
        out.append((ankle, rot, np.zeros(len(poses))))
    return out


def center_of_mass(poss, ball):
    r"""Of the whole body, of the segments' masses.

    Equation  c = Σ mᵢ xᵢ / Σ mᵢ [Winter09, table 4.1]
    Where     the trunk's lies half-way from the hips to the shoulders, the head's in its joint, a hand's in the wrist,
              a foot's half-way from the ankle to the ball
    Args      poss : dict of SEGMENTS, (T, 3) each; ball (T, 2, 3)
    Returns   (T, 3)
    Test      tests/mocap/test_exercise.py::test_center_of_mass
    """
    shoulders = 0.5 * (poss["upper_arm_l"] + poss["upper_arm_r"])
    parts = [(MASSES["trunk"], 0.5 * (poss["pelvis"] + shoulders)), (MASSES["head"], poss["head"])]
    for j, e in enumerate("lr"):
        for name, share, end in (("upper_arm", UPPER, "forearm"), ("forearm", FORE, "hand"), ("thigh", THIGH, "shin"),
                                 ("shin", SHIN, "foot")):  # fmt: skip
            parts.append((MASSES[name], (1 - share) * poss[f"{name}_{e}"] + share * poss[f"{end}_{e}"]))
        parts += [(MASSES["hand"], poss[f"hand_{e}"]), (MASSES["foot"], 0.5 * (poss[f"foot_{e}"] + ball[:, j]))]
    return sum(m * x for m, x in parts) / sum(m for m, _ in parts)


def _bearing(body, feet, rate):
    """Where the weight rests (T, 2): between the feet on the floor, on its way to the next a little before."""
    bears = np.where(feet[..., 2] > 1e-3, BEARS, 1.0)
    bears /= bears.sum(1, keepdims=True)
    middle = 0.5 * (body.heel[0] + body.ball[0])
    rests = (bears[..., None] * (feet[..., :2] + [middle, 0])).sum(1)
    kernel = np.hanning(2 * max(int(SWAY * rate), 1) + 3)[1:-1]
    return convolve1d(rests, kernel / kernel.sum(), axis=0, mode="nearest")


def generate(kind, duration, rate=30.0, seed=0, height=1.75, variation=1.0):
    r"""One clip of somebody who does an exercise.

    Equation  none: key poses, minimum-jerk, two-bone legs, and the pelvis where c_xy = `_bearing` (four times moved
              by what is missing), as high as the legs reach less the pose's dip
    Args      kind : one of EXERCISES; duration [s]; rate [1/s]; seed : int; height : stature [m]; variation : 0, every
              repetition as far as EXERCISES says and nothing restless, times and places still random; 1 is natural
    Returns   as `mocap.gait.generate`
    Raises    ValueError: unknown kind, or a value that makes no motion
    Test      tests/mocap/test_exercise.py
    """
    if kind not in EXERCISES:
        raise ValueError(f"exercise {kind!r}: valid are {', '.join(EXERCISES)}")
    if duration * rate < 2 or height <= 0:
        raise ValueError(f"duration {duration}, rate {rate}, height {height}: must be positive")
    rng, body, size = np.random.default_rng(seed), Body(height), height / 1.75
    t = np.arange(round(duration * rate)) / rate
    poses, feet, flight, sinks = _between(_repeat(EXERCISES[kind], duration, rng, variation), t)
    restless = {"bow": 1.5, "tilt": 1.0, "turn": 2.0, "nod": 4.0, "look": 8.0}  # deg
    restless |= {f"{name}_{e}": 3.0 for e in "lr" for name in ARM}
    for name, much in restless.items():
        poses[:, CHANNELS.index(name)] += much * variation * noise(rng, t, 0.4)
    feet[:, :, :2] *= size
    feet[:, :, 2] = flight[:, None] + size * (feet[:, :, 2] - flight[:, None])
    p = {name: poses[:, i] * (size if name == "dip" else DEG) for i, name in enumerate(CHANNELS)}
    turned = lambda k: about("z", k["turn"]) @ about("y", k["bow"]) @ about("x", -k["tilt"])  # noqa: E731
    rots = {
        "pelvis": turned({name: share * p[name] for name, share in PELVIS.items()}),
        "chest": turned(p),
        "head": turned({name: share * p[name] + p.get(more, 0.0) for name, (share, more) in HEAD.items()}),
    }
    on_floor, rests = _feet(body, poses, feet), _bearing(body, feet, rate)
    arms = np.stack([np.stack([p[f"{name}_{e}"] for name in ARM], 1) for e in "lr"], 1)
    xy = rests
    standing = body.thigh + body.shin + body.ankle_height
    for _ in range(5):
        at = np.column_stack([xy, np.zeros(len(t))])
        limit = reached(body, at, rots["pelvis"], on_floor, STRAIGHT) - flight
        at[:, 2] = lowered(standing, limit, rate, half=SOFT) + flight - sinks - p["dip"]
        posed = pose_body(body, at, PELVIS["turn"] * p["turn"], on_floor, arms, None, rots)
        xy = xy + rests - center_of_mass(*posed[1:])[:, :2]
    return clip_of(*posed, rate, f"{kind}_{seed}")


def library(minutes=10.0, rate=30.0, seed=0, mix=MIX):
    r"""An embedded data set: clips of 24 to 36 s of every exercise in turn, byte-identical for a seed.

    Args      minutes : about the total length, two clips each; rate [1/s]; seed : int;
              mix : (kind, parameters of `generate`) in turn
    Returns   list of clips as `generate` returns them; heights 1.5 to 1.9 m
    Test      tests/mocap/test_exercise.py::test_library, test_same_seed_same_bytes
    """
    rng = np.random.default_rng(seed)
    clips = []
    for i in range(max(1, round(minutes * 2))):
        kind, params = mix[i % len(mix)]
        seconds, own, height = rng.uniform(24.0, 36.0), int(rng.integers(2**31)), float(rng.uniform(1.5, 1.9))
        made = generate(kind, seconds, rate, own, **{"height": height, **params})
        clips.append({**made, "name": f"{i:02d}_{kind}"})
    return clips

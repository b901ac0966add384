r"""Do a stream's axes, unit, device order and grip fit a person?  Which would?

    the first eleven seconds ──► fit of every axes and order ──► judge: what is wrong, and the flag that mends it
                                                             └─► guess: the best, for --axes auto

A stream with one axis turned over plays mirrored: hands behind the back, and nothing else looks wrong.  What tells:

    hands    below the head, left one on the left, held before the face rather than behind it
    head     upright, and as high as a head is
    forearm  a hand turns about its elbow, so the lever from there to the controller shows, in the controller's own
             axes, where forward and the fingers are: forward of where it points, whatever the user does

The lever is what decides between Unity's axes and OpenXR's: somebody may hold the hands behind the back, but nobody
swings them about a point in front of them.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np

from headset.bsor import is_replay, opened
from headset.reader import AXES, DEVICES, GRIP, SAMPLE_RATE, UNIT, Sample, is_live, to_world
from human import heading, quat_matrix, quat_rotate
from plumbing.cli import POSITIVE, UserError, arg

SECONDS = (1.0, 11.0)  # of headset: when a stream is judged, and again
LONG = 60.0  # s of a file in whose first eleven both controllers lie still
SEEN = 30.0  # Hz, at most as many readings are looked at
NAMES = ("unity", "openxr", "mujoco", "unreal")  # openvr has the axes of openxr, and its own grip
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
REACH = (0.25, 1.4)  # m from headset to controller, in the median.  ASSUMED; recorded: 0.45 to 0.95
LAG = 0.1  # s between two poses of a hand that give its lever
FARTHEST = 1e6  # in any unit: a kilometre of millimetres
LIES = 0.01  # m of standard deviation: a controller that moves less is in nobody's hand
HANGS = 0.1  # m, horizontally from the face to a hanging hand, either way
WALKS = 0.4  # m/s of a headset: it is carried somewhere
SWAPPED = 0.8  # what the fit of another order of devices must gain over the one told.  ASSUMED
PERSON = 4.0  # of at most 8: what reads like a person.  Recorded: 4.5 to 6.3, 3.1 with controllers on a table, and at
# most 3.1 read as what it is not, rotations in the order w, x, y, z
NOBODY = "fits no person well: are the columns in place, rotations x, y, z, w?  (A controller that lies fits badly)"
SURE = 0.6  # by how much a fit must be better to be said.  ASSUMED
OTHER_GRIP = 0.3  # what it costs that a controller is not held as these axes' own are.  ASSUMED
GRIP_OFF = 45.0  # degrees from a forearm to where the grip says that the fingers are
USUAL = (0, 1, 2)  # order of the devices: head, left, right
FOUND, OWN = "axes found from head, hands and forearms:", "axes as the file itself says:"


@dataclass
class StreamFlags:
    """The flags of every command that is driven by a headset: which, and how it is to be read."""

    stream: str | None = arg(
        None, "drive the character with a headset's .csv file, a .bsor replay, a named pipe, or - for standard input"
    )
    axes: str = arg(
        "auto", "axes of the stream; auto: what fits a person best (a live stream: unity)", choices=("auto", *AXES)
    )
    grip: float | None = arg(
        None,
        "how far the fingers point below the controllers' forward axis [degrees]: unity 15, else 90 by default",
        check=(lambda v: -180 <= v <= 180, "from -180 to 180 degrees"),
    )
    stream_unit: float | None = arg(None, "metres a unit of the stream; its axes' own by default", check=POSITIVE)
    devices: tuple[str, ...] | None = arg(
        None,
        "which of the stream's devices are head, left and right, as left,head,right; by default as they are named, or "
        "as --axes auto finds them",
        check=(lambda v: sorted(v) == sorted(DEVICES), "head, left and right, each once"),
    )
    sample_rate: float | None = arg(
        None,
        f"rows a second of a stream without times; {SAMPLE_RATE:g} by default",
        check=(lambda v: 10 <= v <= 2000, "from 10 to 2000 rows a second"),
    )
    user_height: float | None = arg(
        None,
        "height of the standing user's headset [m]; from the stream's first second by default",
        check=(lambda v: 0.3 <= v <= 3, "from 0.3 to 3 m"),
    )


@dataclass(frozen=True)
class Fit:
    """How well a reading of the samples fits a person.

    unit : metres a unit, None where none fits; score : sum of the cues, each from -1 to 1
    forearm : degrees by which it lies below the controllers' forward axis, None where the hands hardly turn
    """

    axes: str
    order: tuple
    unit: float | None
    score: float
    forearm: float | None


class Choice(NamedTuple):
    """How to read a stream, for `calibration.Stream`, and what to print about it."""

    axes: str
    grip: float | None
    unit: float | None
    order: tuple
    lines: list

    @property
    def usual(self) -> bool:
        """Whether nothing need be said: Unity's axes without doubt, and the devices as most files have them.

        Test      tests/headset/test_axes.py::test_usual"""
        plain = f"{FOUND} --axes unity --grip {GRIP['unity']:g}", f"{OWN} --axes unity"
        return set(self.lines) <= set(plain)

    @property
    def told(self) -> list:
        """The lines that a user should see: none of a usual choice.  Test: tests/headset/test_axes.py::test_usual"""
        return [] if self.usual else self.lines


# ------------------------------------------------------------------------------------ what tells


def tracked(samples, devices=3) -> list[Sample]:
    """Samples in which every device has a pose, at most 30 a second.  Test: tests/headset/test_axes.py::test_few"""
    out = []
    for s in samples:
        rows = np.concatenate([s.pos, s.quat], axis=1)[:devices]
        whole = (np.abs(rows) < FARTHEST).all() and (np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1.0) < 0.1).all()
        if whole and (not out or not s.t - out[-1].t < 0.9 / SEEN):
            out.append(s)
    return out


def lever(t, pos, quat, lag=LAG):
    r"""The vector, in a device's own axes, from the point about which it turns to the device.

    Equation  p = c + R r with c at rest for 0.1 s:  r = argmin Σ |Δp − ΔR r|², Δ over the lag, ridge 0.1 %
    Args      t (T,) [s]; pos (T, 3); quat (T, 4) w, x, y, z: any frame
    Returns   r (3,) [of pos], share of Δp that it explains, 0 to 1
    Test      tests/headset/test_axes.py::test_lever
    """
    k = max(1, round(lag / max(float(np.median(np.diff(t))), 1e-3)))
    turn = quat_matrix(quat)
    a, b = (turn[k:] - turn[:-k]).reshape(-1, 3), (pos[k:] - pos[:-k]).reshape(-1)
    if not len(b) or not np.abs(b).max() > 0:
        return np.zeros(3), 0.0
    m = a.T @ a
    r = np.linalg.solve(m + (1e-3 * np.trace(m) + 1e-9) * np.eye(3), a.T @ b)
    return r, max(0.0, 1.0 - float(np.sum((b - a @ r) ** 2) / np.sum(b**2)))


def levers(t, pos, quat) -> dict:
    """(headset, hand) -> `lever` of the hand seen from the headset, in the file's axes, for every pair of devices.

    Test      tests/headset/test_axes.py::test_lever"""
    own = np.roll(quat, 1, axis=-1)
    return {(h, k): lever(t, pos[:, k] - pos[:, h], own[:, k]) for h, k in permutations(range(3), 2)}


def fit(t, pos, quat, swings, axes, order=USUAL, unit: float | None = 1.0) -> Fit:
    r"""How well axes, an order of the devices and a unit fit a person.

    Cues      head upright; headset at 0.5 to 2.3 m, or, with a floor of its own, at ±0.5 m; hands below it by 0.3 m
              and before rather than behind the face; left one left of the right one by 0.3 m, and not both to one side;
              the headset carried forwards, a metre or more;
              the forearm's lever between forward and 90 degrees below it, twice, and where these axes' grip has it.  A
              controller that lies is no hand
    Why       each is cut to -1 … 1, so that none outvotes the others: somebody bends over, somebody holds both hands
              on one side
    Args      t (T,); pos (T, 3, 3), quat (T, 3, 4) x, y, z, w, as they came; swings : `levers` of them
    Test      tests/headset/test_axes.py::test_wrong_axes, ::test_recorded
    """
    p, q = to_world(pos[:, list(order)], quat[:, list(order)], axes, 90.0, unit or 1.0)
    yaw = heading(q[:, 0])
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    aside = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    hand = p[:, 1:] - p[:, :1]  # (T, 2, 3)
    held = [k for k in (0, 1) if p[:, 1 + k].std(axis=0).max() > LIES]
    left = np.sum(hand[..., :2] * aside[:, None], axis=-1).mean(axis=0)  # (2,) of left and right hand
    up = float(np.mean(quat_rotate(q[:, 0], np.tile([0.0, 0, 1], (len(q), 1)))[:, 2]))
    height = float(np.median(p[:, 0, 2]))
    cut = lambda x: float(np.clip(x, -1.0, 1.0))  # noqa: E731
    score = cut(2.0 * up - 1.0) + (1.0 if 0.5 < height < 2.3 else 0.0 if abs(height) < 0.5 else -1.0)
    if held:
        forward = float(np.sum(hand[:, held, :2] * ahead[:, None], axis=-1).mean())
        score += cut(-hand[:, held, 2].mean() / 0.3)
        score += cut(np.sign(forward) * max(0.0, abs(forward) - HANGS) / 0.2)
    if len(held) == 2:
        score += cut((left[0] - left[1]) / 0.3) - cut(abs(left.mean()) / 0.3)
    step = np.diff(p[:, 0, :2], axis=0)
    goes = np.linalg.norm(step, axis=-1) > WALKS * np.diff(t)
    score += cut(np.sum(step[goes] * ahead[:-1][goes]))
    angles, weights = [], []
    for k in held:
        r, share = swings[order[0], order[1 + k]]
        r = AXES[axes] @ r * (unit or 1.0)
        long = np.linalg.norm(r)
        if share < 0.2 or not 0.05 < long < 1.0:
            continue
        angle = np.degrees(np.arctan2(-r[2], r[0]))
        off = max(0.0, -10.0 - angle, angle - 90.0)
        score += 2.0 * share / len(held) * cut(1.0 - off / 30.0 - (abs(r[1]) / long) ** 2)
        angles, weights = [*angles, angle], [*weights, share]
    forearm = float(np.average(angles, weights=weights)) if angles else None
    if forearm is not None and abs(forearm - GRIP[axes]) > GRIP_OFF:
        score -= OTHER_GRIP
    return Fit(axes, tuple(order), unit, score, forearm)


def fits(samples, devices=3, order=None) -> list[Fit]:
    """Every axes and order of the devices, best first; none if the samples are too few, or the headset is alone.

    Args      order : of the devices, the only one that is tried
    Test      tests/headset/test_axes.py::test_wrong_axes, ::test_few, ::test_told"""
    samples = tracked(samples, devices)
    if devices < 3 or len(samples) < 20:
        return []
    t, pos, quat = (np.array([s[k] for s in samples]) for k in range(3))
    if not np.isfinite(t).all() or t[-1] - t[0] < 0.5 * SECONDS[0]:
        t = np.arange(len(t)) / 90.0
    unit = unit_of(pos[:, list(order or USUAL)])
    swings = levers(t, pos, quat)
    orders = [tuple(order)] if order else list(permutations(range(3))) if unit else [USUAL]
    found = []
    for some in (orders[:2], orders[2:]):  # the headset first; elsewhere only if nobody wears it there
        if not found or max(f.score for f in found) < PERSON:
            found += [fit(t, pos, quat, swings, axes, order, unit) for axes in NAMES for order in some]
    return sorted(found, key=lambda f: SWAPPED * (f.order != USUAL) - f.score)


def unit_of(pos) -> float | None:
    """Metres a unit: that in which the controllers are an arm's length from the headset; None: in none.

    Test      tests/headset/test_axes.py::test_units"""
    apart = float(np.median(np.linalg.norm(pos[:, 1:] - pos[:, :1], axis=-1)))
    return next((unit for unit in UNITS.values() if REACH[0] <= apart * unit <= REACH[1]), None)


# ------------------------------------------------------------------------------------ what is said


def judge(samples, axes="unity", grip=None, unit=None, order=USUAL, devices=3) -> list[str]:
    """What does not fit a person in how samples are read, each with the flag that mends it.

    Args      samples : a second or more of Reader's; the rest as they are read now
    Test      tests/headset/test_axes.py::test_recorded, ::test_wrong_axes, ::test_grip
    """
    found = fits(samples, devices)
    if not found:
        return []
    best, lines = found[0], []
    alike = [f for f in found if np.array_equal(AXES[f.axes], AXES[axes])]
    told = next((f for f in alike if f.order == tuple(order)), None)
    if told is None:
        return [other_order(best)]
    used = UNIT.get(axes, 1.0) if unit is None else unit
    if best.unit not in (None, used):
        name = next(n for n, u in UNITS.items() if u == best.unit)
        lines.append(
            f"the controllers fit a person's arms in {name}, not at {used:g} m a unit: --stream-unit {best.unit:g}"
        )
    gain = best.score - told.score - SWAPPED * ((best.order != USUAL) - (told.order != USUAL))
    if best is not told and gain > SURE:
        if best.order != told.order:
            lines.append(other_order(best))
        if not np.array_equal(AXES[best.axes], AXES[axes]):
            lines.append(f"hands, head and forearms fit a person with --axes {best.axes}, not {axes}: "
                         f"{best.score:.1f} to {told.score:.1f}")  # fmt: skip
    used = GRIP[axes] if grip is None else grip
    angle = best.forearm
    if angle is not None and abs(angle - used) > GRIP_OFF:
        lines.append(
            f"the forearms lie {angle:.0f} degrees below the controllers' forward axis, the fingers {used:.0f}: "
            f"--grip {grip_of(angle):g}"
        )
    return lines


def other_order(best: Fit) -> str:
    """What is said of devices that are in another order.  Test: tests/headset/test_axes.py::test_wrong_axes"""
    return f"the devices fit a person in another order: {devices_flag(best)}"


def devices_flag(best: Fit) -> str:
    """The flag of play.py for a fit's order.  Test: tests/headset/test_axes.py::test_wrong_axes"""
    return f"--devices {','.join(DEVICES[k] for k in best.order)}"


def grip_of(forearm) -> float:
    """The grip of what is held as the forearm lies: of what points, or of a grip pose.

    Test      tests/headset/test_axes.py::test_grip"""
    return min(set(GRIP.values()), key=lambda g: abs(g - forearm))


def guess(samples, axes="unity", devices=3, grip=None, unit=None, order=None) -> Choice:
    """Axes, grip, unit and order of the devices that fit a person best; `axes` where nothing tells.

    Args      grip, unit, order : what the user gave, or None; they count
    Test      tests/headset/test_axes.py::test_recorded, ::test_wrong_axes, ::test_told"""
    found = fits(samples, devices, order)
    if not found:
        line = f"too little to tell the axes from: --axes {axes}"
        return Choice(axes, grip, unit, tuple(order or USUAL), [line])
    best = found[0]
    rest = [f for f in found if f.axes != best.axes and f.order == best.order]
    lead = best.score - max(f.score for f in rest)
    if grip is None:
        grip = GRIP[best.axes]
        if best.forearm is not None and abs(best.forearm - grip) > GRIP_OFF:
            grip = grip_of(best.forearm)
    if unit is None:
        unit = None if best.unit in (None, UNIT.get(best.axes, 1.0)) else best.unit
    flags = f"--axes {best.axes} --grip {grip:g}" + ("" if best.order == USUAL else f" {devices_flag(best)}")
    flags += f" --stream-unit {unit:g}" if unit else ""
    sure = "" if lead > SURE else f"; not sure: {rest[0].axes} fits nearly as well"
    odd = f"; {best.score:.1f} of 8: {NOBODY}" if best.score < PERSON else ""
    return Choice(best.axes, grip, unit, best.order, [f"{FOUND} {flags}{sure}{odd}"])


# ------------------------------------------------------------------------------------ a file, a live stream


def beginning(path, devices=3, seconds=SECONDS[1]) -> list[Sample]:
    """The readings of a file until the headset has been tracked for so many seconds.

    Raises    UserError: as `Reader`
    Test      tests/headset/test_axes.py::test_choose"""
    out, first = [], None
    for k, sample in enumerate(opened(path, devices=devices)[1]):
        if np.isfinite(sample.pos[0]).all() and sample.quat[0].any():
            first = sample.t if first is None else first
            out.append(sample)
        timed = first is not None and np.isfinite(sample.t)
        if timed and sample.t - first > seconds or k > 40_000 or not timed and len(out) > 90 * seconds:
            break
    return out


def axes_in(path, devices=3) -> str | None:
    """The axes that a file's own first lines tell, as those of a recording of the page.  None: it tells none of AXES

    Raises    UserError: as `Reader`
    Test      tests/headset/test_axes.py::test_choose"""
    reader, samples = opened(path, devices=devices)
    next(samples, None)
    return reader.axes if reader.axes in AXES else None


def lie(samples) -> bool:
    """Whether both controllers lie somewhere, in nobody's hands.  Test: tests/headset/test_axes.py::test_lying"""
    pos = np.array([s.pos for s in tracked(samples)])
    return len(pos) > 0 and bool((pos[:, 1:].std(axis=0) * (unit_of(pos) or 1.0) < LIES).all())


def choose(path, wanted="auto", grip=None, unit=None, order=None, devices=3) -> Choice:
    """How to read a stream: as wanted, with complaints about what does not fit; or, for "auto", as fits best.

    A live stream cannot be read twice: for it "auto" is Unity's axes, and `Watch` complains as it goes on.  A replay's
    axes are known: Unity's.
    Args      grip, unit, order : what the user gave, or None; they count
              devices : of the stream, 1 for the headset alone: controllers that the file has still tell its axes
    Test      tests/headset/test_axes.py::test_choose, ::test_told, ::test_headset_alone"""
    plain = tuple(order or USUAL)
    if wanted != "auto" and wanted not in AXES:
        raise UserError(f"--axes {wanted}: unknown; valid: auto, {', '.join(AXES)}")
    if is_live(path) or wanted == "auto" and is_replay(path):
        return Choice("unity" if wanted == "auto" else wanted, grip, unit, plain, [])
    if devices < 3:
        with contextlib.suppress(UserError):  # it has no controllers, or they cannot be read
            return choose(path, wanted, grip, unit, plain)
    if wanted == "auto" and (own := axes_in(path, devices)):
        return Choice(own, grip, unit, plain, [f"{OWN} --axes {own}"])
    samples = beginning(path, devices)
    if devices == 3 and lie(samples):  # until somebody takes them
        samples = beginning(path, devices, LONG)
    if wanted == "auto":
        return guess(samples, devices=devices, grip=grip, unit=unit, order=order)
    lines = [f"{line}, or --axes auto" for line in judge(samples, wanted, grip, unit, plain, devices)]
    return Choice(wanted, grip, unit, plain, lines)


class Watch:
    """Judges a live stream after one second and again after eleven; every complaint is made once.

    Test      tests/headset/test_axes.py::test_watch"""

    def __init__(self, axes="unity", grip=None, unit=None, order=USUAL, devices=3):
        self.how, self.seen, self.said, self.due = (axes, grip, unit, order, devices), [], set(), list(SECONDS)

    def push(self, sample: Sample) -> list[str]:
        """What is to be said now that this reading came."""
        if not self.due:
            return []
        self.seen += tracked([sample], self.how[-1]) if len(self.seen) < 2000 else []
        since = sample.t - self.seen[0].t if self.seen and np.isfinite(sample.t) else len(self.seen) / 90.0
        if since < self.due[0] and len(self.seen) < 2000:
            return []
        self.due = self.due[1:] if len(self.seen) < 2000 else []
        new = {line: tuple(re.findall(r"--\S+ [\w.,]+", line)) for line in judge(self.seen, *self.how)}
        lines = [line for line, flags in new.items() if flags not in self.said]
        self.said |= set(new.values())
        return lines

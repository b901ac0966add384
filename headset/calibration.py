"""A user's size, floor and forward direction from a second of headset; poses at the control rate from any stream."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from character import Character
from headset.reader import AXES, GAP, REACH, SAMPLE_RATE, Clock, Guard, Sample, blend, to_frame, to_world
from human import heading, quat_about
from mocap.data import CONTROL_RATE
from plumbing.cli import UserError
from retarget import sensor_scale

# ------------------------------------------------------------------------------------ time and size


class Resampler:
    """Samples of any rate -> poses at the control rate.

    Rule      tick k is at k / rate after the first sample; it lies between the last sample before it and the first one
              at or after it (lerp, slerp) and is given out when that one comes: no later change, no look-ahead
    Test      tests/headset/test_stream.py::test_resampler_against_scipy, test_resampler_is_causal
    """

    def __init__(self, rate=CONTROL_RATE):
        self.rate, self.k, self.t0, self.last = rate, 0, None, None

    def push(self, sample: Sample) -> list[Sample]:
        """The ticks that this sample completes."""
        if self.t0 is None:
            self.t0, self.last = sample.t, sample
        out = []
        while (tick := self.t0 + self.k / self.rate) <= sample.t + 1e-9:
            span = sample.t - self.last.t
            u = np.clip((tick - self.last.t) / span, 0.0, 1.0) if span > 0 else 1.0
            pos, quat = blend((self.last.pos, self.last.quat), (sample.pos, sample.quat), u)
            out.append(Sample(self.k / self.rate, pos, quat))
            self.k += 1
        self.last = sample
        return out


CALIBRATION, SEEN = 1.0, 1000  # s of headset; readings kept of it: of a faster stream every other one
AGAIN = 0.5  # s without a headset, the way back included: put on meanwhile, so the second begins again.  ASSUMED
STANDING = (1.0, 2.1)  # m, where the headset of a standing user may be (recorded: 1.37 to 2.00); else no floor at 0
AVERAGE = 1.64  # m, headset of a user of 1.75 m, taken where the floor is not known.  ASSUMED
ABOVE = 0.25  # m: whose headset is so far above the calibrated height for a second had not stood upright.  ASSUMED
HIPS = 0.554  # of that height: the hips, which a headset does not see, for `scale_z = "hip"`.  ASSUMED


@dataclass(frozen=True)
class Calibration:
    """The user's world -> the character's: p' = s ⊙ R_z(−yaw) (p − origin), s as `retarget.sensor_scale`.

    Test      tests/headset/test_stream.py::test_calibration
    """

    height: float  # m, standing user's headset above the floor
    floor: float  # m, height of the floor in the stream
    estimated: bool  # the floor is a guess
    yaw: float  # rad, where the user looked
    origin: np.ndarray  # (3,) on the floor below the headset
    scale: np.ndarray  # (3,)

    def apply(self, sample: Sample) -> Sample:
        """A sample in the character's world."""
        pos, quat = to_frame((self.origin, quat_about(2, self.yaw)), (sample.pos, sample.quat))
        return Sample(sample.t, pos * self.scale, quat)


def standing_height(pos) -> float:
    """Height of a standing user's headset: the 87.5th percentile of its positions (T, 3) [m].

    The median of its upper quarter: people stoop, nobody stretches.
    Test      tests/headset/test_stream.py::test_calibration"""
    return float(np.percentile(pos[:, 2], 87.5))


def calibrate(char: Character, pos, quat, user_height: float | None = None) -> Calibration:
    r"""User's size, floor and forward direction from a second of headset poses.

    Height    `standing_height`
    Scale     `retarget.sensor_scale`, as in training
    Floor     at height 0 of the stream if that makes the user's headset 1.0 to 2.1 m high; otherwise 1.64 m below it;
              with user_height, that much below it
    Forward   the mean heading; the place: the median
    ASSUMED   all but the scale; the paper does not say how a real user is measured
    Args      pos (T, 3), quat (T, 4) of the headset, `to_world`'s axes
    Test      tests/headset/test_stream.py::test_calibration, test_calibration_scales_as_training
    """
    top = standing_height(pos)
    estimated = user_height is not None or not STANDING[0] <= top <= STANDING[1]
    height = (user_height or AVERAGE) if estimated else top
    yaw = heading(quat)
    yaw = float(np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean()))
    origin = np.array([*np.median(pos[:, :2], axis=0), top - height])
    scale = sensor_scale(char, HIPS * height, height)
    return Calibration(height, top - height, estimated, yaw, origin, scale)


class Stream:
    """Samples as they come -> poses at the control rate in the character's world.

    axes, grip, unit : as `to_world`; order : which of the source's devices are head, left, right
    sample_rate : of a stream without times [Hz], or None for SAMPLE_RATE; user_height : as `calibrate`
    devices     : as `Guard`
    Test          tests/headset/test_stream.py::test_round_trip, test_never_nan
    """

    def __init__(
        self, char, axes="unity", rate=CONTROL_RATE, sample_rate=None, grip=None, user_height=None, devices=3,
        unit=None, order=(0, 1, 2),
    ):  # fmt: skip
        if axes not in AXES:
            raise UserError(f"--axes {axes}: unknown; valid: {', '.join(AXES)}")
        self.char, self.axes, self.grip, self.user_height = char, axes, grip, user_height
        self.unit, self.order = unit, list(order)
        self.clock, self.told_rate = Clock(sample_rate or SAMPLE_RATE), sample_rate
        self.guard, self.resampler = Guard(rate, devices), Resampler(rate)
        self.calibration, self.seen, self.unseen, self.rows = None, [], 0.0, 0
        self.above = 0.0  # s for which the headset was ABOVE the calibrated height, or higher

    def push(self, sample: Sample) -> list[Sample]:
        """The ticks that a reading completes; none in the first second, which calibrates."""
        self.rows += 1
        t = self.clock.stamp(sample.t)
        if t is None:
            return []
        poses = to_world(sample.pos[self.order], sample.quat[self.order], self.axes, self.grip, self.unit)
        return self._go(Sample(t, *poses))

    def idle(self, seconds: float) -> list[Sample]:
        """Nothing came for so long: the ticks of a drop-out."""
        if self.guard.t is None:
            return []
        nothing = np.full((3, 7), np.nan)
        return self._go(Sample(self.clock.idle(seconds), nothing[:, :3], nothing[:, 3:]), "drop-out")

    def _go(self, sample, why=None):
        ticks = []
        for s in self.guard.push(sample, why):
            if self.calibration:
                made, top = self.resampler.push(s), self.calibration.floor + self.calibration.height
                self.above += (s.pos[0, 2] > top + ABOVE) * len(made) / self.resampler.rate
                ticks += [self.calibration.apply(tick) for tick in made]
            elif self.guard.live():
                gap = s.t - self.seen[-1][0] if self.seen else 0.0
                self.unseen += max(0.0, gap - GAP)
                if gap > AGAIN:
                    self.seen, self.unseen = [], 0.0
                self.seen.append((s.t, s.pos[0], s.quat[0]))
                self.seen = self.seen if len(self.seen) <= SEEN else self.seen[::2]
                if self.tracked() >= CALIBRATION:
                    _, pos, quat = zip(*self.seen, strict=True)
                    self.calibration = calibrate(self.char, np.array(pos), np.array(quat), self.user_height)
                    self.seen = []
        return ticks

    def tracked(self) -> float:
        """Seconds of headset seen while calibrating; of the time between two readings GAP at most.

        Test      tests/headset/test_stream.py::test_calibration_of_what_is_seen"""
        return self.seen[-1][0] - self.seen[0][0] - self.unseen if self.seen else 0.0

    def uncalibrated(self) -> str:
        """Why there is no calibration, for a complaint.  Test: tests/headset/test_stream.py::test_no_calibration"""
        need = f"calibration needs {CALIBRATION} s"
        if not self.rows:
            return f"no rows after the columns' names; {need}"
        hint = {"far away": ": centimetres? valid: metres", "no rotation": ": valid: quaternions of length 1"}
        bad = [f"{n} {what}{hint.get(what, '')}" for what, n in self.guard.heads.most_common() if what and n]
        bad += [f"{self.clock.dropped} before their predecessor"] if self.clock.dropped else []
        why = f"; of them {', '.join(bad)}" if bad else ""
        return f"{self.rows} rows show the headset for {self.tracked():.2f} s; {need}{why}"

    @property
    def guessed(self) -> bool:
        """Whether the floor is neither the stream's nor told.  Test: tests/headset/test_stream.py::test_remarks"""
        return self.calibration.estimated and not self.user_height

    def remarks(self) -> list[str]:
        """What is to be said of the rows' times, of a user who crouched while calibrating, of controllers elsewhere.

        Test      tests/headset/test_stream.py::test_sample_rate, test_remarks"""
        if self.rows and not self.clock.timed:
            return [f"no time column: {self.clock.rate:g} rows a second (--sample-rate)"]
        lines = ["the stream has times: --sample-rate is not used"] if self.rows and self.told_rate else []
        counts = {"rows before their predecessor": self.clock.dropped, "jumps of the clock": self.clock.jumps}
        lines += [f"{n} {what}" for what, n in counts.items() if n]
        if self.above > 1.0:
            lines.append(
                f"for {self.above:.1f} s the headset is {ABOVE} m or more over its place in the first second, which is "
                "taken for the user's height: stand upright then, or cut the file to where the user does"
            )
        away = sum(s for (_, what), s in self.guard.seconds.items() if what == "out of reach")
        if away > (self.guard.t or 0.0):  # of both hands together: half the time of each
            lines.append(
                f"the controllers are {REACH} m or more from the headset most of the time; valid: all three in one "
                "frame, not relative to the headset, in metres or with --stream-unit"
            )
        return lines

    def report(self) -> list[str]:
        """What was calibrated and what went wrong, for a reader.

        Test      tests/headset/test_stream.py::test_real_recordings"""
        lines = []
        if c := self.calibration:
            how = "guessed" if self.guessed else "as told" if c.estimated else "the stream's"
            lines.append(
                f"user's headset {c.height:.2f} m above the floor; floor at {c.floor:.2f} m ({how}); "
                f"forward {np.degrees(c.yaw):.0f} degrees; heights times {c.scale[2]:.3f}"
            )
        return lines + self.remarks() + self.guard.report()

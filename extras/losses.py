r"""What a character bears of lost devices: completed and fails every, by what was lost and how long  (ours).

    python -m extras.losses                                              built-in walks; nothing is downloaded
    python -m extras.losses --stream FOLDER                              a headset's recordings as well
    python -m extras.losses --characters dino --seconds 10 --json OUT

As ReliaAvatar [Qian24] tests an estimator of poses: single frames are lost, each with a probability, or seconds at a
time; of one device, or of all.  Where it reports errors of a pose, a simulated character falls or does not.

    samples ──► lose (headset.losses) ──► Guard, calibration, 30 Hz ──► ride ──► completed, fails every

The losses of a capture are the same for every character, and begin after the second that calibrates.

[Qian24]  Qian et al., ReliaAvatar: a robust real-time avatar animator with integrated motion prediction, 2024
"""

from __future__ import annotations

import json
import math
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import metrics
import policy
from headset import losses
from headset.axes import choose
from headset.bsor import opened
from headset.calibration import HIPS, Stream
from headset.player import Player, recorded, ride
from headset.reader import SAMPLE_RATE, Sample, sound
from mocap.data import CONTROL_RATE, MotionFlags, load, parts
from mocap.rigs import Reading
from play import recordings_of
from plumbing.cli import NONNEGATIVE, POSITIVE, THREADS, UserError, arg, cell, cli, complain, markdown, run_main
from plumbing.files import atomic_write, check_folders
from retarget import sensor_scale

LENGTHS, EVERY = (0.5, 1.0, 2.0), 5.0  # s of a loss, one in so many seconds
SPARED = 2.0  # s from the beginning in which nothing is lost: a user who puts the headset on looks at it
ONE_OR_ALL = {"one hand": "left", "headset": "head", "all": "all"}
ANY = {"one hand": "left", "both hands": "hands", "headset": "head", "all": "all"}


@dataclass
class Options(MotionFlags):
    """Whose policies, and on what."""

    clips: str = arg("walk*", "shell pattern on clip names")
    characters: tuple[str, ...] = arg(
        ("jesse", "oppy", "dino"), "names or .toml paths, the .npz beside it", check=(len, "one or more names")
    )
    stream: str | None = arg(None, "a headset's recording, or a folder of them: a table of their own")
    seconds: float = arg(20.0, "how much of each capture, lead-in and calibration included", check=POSITIVE)
    most: int = arg(6, "captures of each set at most, the first by name", check=POSITIVE)
    seed: int = arg(0, "seed of what is lost", check=NONNEGATIVE)
    json: str | None = arg(None, "write the tables here")
    threads: int = arg(0, "physics threads, 0 = all cores", check=THREADS)


@dataclass(frozen=True)
class Loss:
    """What is lost: a share of single frames, or so many seconds of every EVERY; of devices, a name of `losses.SETS`.

    always : from the first frame on, as with play.py's `--sensors hmd`: controllers that were never there hang

    Test      tests/extras/test_loss_table.py::test_rows"""

    name: str = "nothing"
    devices: str = "all"
    share: float = 0.0
    seconds: float = 0.0
    always: bool = False

    def mask(self, t, rng) -> np.ndarray:
        """Which of the frames at t [s] are lost.  (n,) bool"""
        if self.always:
            return np.ones(len(t), bool)
        if self.seconds:
            lost = losses.long(t, self.seconds, rng, EVERY)
        else:
            lost = losses.single(len(t), self.share, rng)
        return lost & (t - t[0] >= SPARED)


def rows() -> list[Loss]:
    """The table's rows.  Test: tests/extras/test_loss_table.py::test_rows"""
    single = [Loss(f"frames, {p:.0%}, {w}", d, share=p) for w, d in ONE_OR_ALL.items() for p in losses.SHARES]
    long = [Loss(f"{s:g} s of {EVERY:g}, {w}", d, seconds=s) for w, d in ANY.items() for s in LENGTHS]
    return [Loss(), *single, *long, Loss("always, both hands", "hands", always=True)]


@dataclass
class Capture:
    """What a headset saw: its name and samples, and how a `Stream` of a character reads them."""

    name: str
    samples: list[Sample]
    how: dict

    @property
    def times(self):
        t = np.array([s.t for s in self.samples])
        return t if np.isfinite(t).all() else np.arange(len(t)) / SAMPLE_RATE

    def cut(self, seconds):
        """Its first seconds."""
        t = self.times
        return Capture(self.name, self.samples[: int(np.searchsorted(t, t[0] + seconds))], self.how)


def captures(opt: Options) -> tuple[dict[str, list[Capture]], list[str]]:
    """The sets: clips of the validation part with their lead-in, and recordings.  -> sets, lines on broken files

    Raises    UserError: nothing there
    Test      tests/extras/test_loss_table.py::test_table"""
    clips = load(opt.motion, clips=opt.clips, split="validation", reading=Reading.of(opt))
    out, broken = {opt.motion: []}, []
    for clip in sorted(clips, key=lambda c: c.name)[: opt.most]:
        samples, _ = recorded(clip)
        out[opt.motion].append(Capture(clip.name, samples, {"axes": "mujoco", "rate": clip.rate}).cut(opt.seconds))
    if opt.stream:
        files = recordings_of(opt.stream)[: opt.most]
        takes, broken = sound(lambda file: recording(file, opt.seconds), files)
        out[Path(opt.stream).name or opt.stream] = takes
    return out, broken


def recording(file, seconds) -> Capture:
    """The first seconds of a file; its axes as they fit best.

    Test      tests/extras/test_loss_table.py::test_seconds_without_times"""
    how, samples, first = choose(file), [], None
    for sample in opened(file)[1]:
        first = sample.t if first is None else first
        if sample.t - first > seconds or len(samples) > 1000 * seconds:
            break
        samples.append(sample)
    reading = {"axes": how.axes, "grip": how.grip, "unit": how.unit, "order": how.order}
    take = Capture(file.name, samples, reading)
    return take if np.isfinite([s.t for s in samples]).all() else take.cut(seconds)


def streams_of(char, capture: Capture, seed: int):
    """A capture with every row's losses -> (pos (T, 3, 3), quat (T, 3, 4)) each, and the user's headset height [m].

    Raises    UserError: it shows no headset for a second
    Test      tests/extras/test_loss_table.py::test_the_same_for_all"""
    out, height = [], None
    for loss in rows():
        rng = np.random.default_rng([seed, zlib.crc32(f"{capture.name} {loss.name}".encode())])
        stream, ticks = Stream(char, devices=1 if loss.always else 3, **capture.how), []
        for sample in losses.lose(capture.samples, loss.mask(capture.times, rng), loss.devices):
            ticks += stream.push(sample)
        if not ticks:
            raise UserError(f"{capture.name}: {stream.uncalibrated()}")
        height = stream.calibration.height
        out.append((np.stack([t.pos for t in ticks]), np.stack([t.quat for t in ticks])))
    return out, height


def user_scale(char, height) -> np.ndarray:
    """What `calibrate` scales positions by."""
    return sensor_scale(char, HIPS * height, height)


def cast_of(opt: Options) -> dict:
    """name -> character, policy, devices, path.  UserError: no such character, no policy, or one that does not fit"""
    out = {}
    for name in opt.characters:
        flags = metrics.Options(character=name)
        own, path, meta = policy.find_policy(flags)
        char, devices = policy.load_character(flags, meta, path), policy.devices_of(meta, path, None)
        policy.check_fits(own, Player(char, own.mean_action, devices=devices), path)
        out[char.name] = char, own, devices, path
    return out


def measured(opt: Options, cast) -> tuple[dict, list[str]]:
    """set -> loss -> character -> completed (a share), failures, fails_every_s (None: never); lines on broken captures.

    Args      cast : of `cast_of`

    Test      tests/extras/test_loss_table.py::test_table"""
    found, kinds = {}, rows()
    first = next(iter(cast.values()))[0]
    sets, broken = captures(opt)
    for title, takes in sets.items():
        found[title] = {loss.name: {} for loss in kinds}
        seen, odd = sound(lambda take: streams_of(first, take, opt.seed), takes)
        broken += odd
        for name, (char, own, devices, _) in cast.items():
            streams = []
            for each, height in seen:  # another character's stream differs by its scale alone
                ratio = user_scale(char, height) / user_scale(first, height)
                streams += [(pos * ratio, quat) for pos, quat in each]
            rides = ride(char, own.mean_action, streams, devices, opt.threads)
            for k, loss in enumerate(kinds):
                found[title][loss.name][name] = summary(rides[k :: len(kinds)])
    return found, broken


def summary(rides) -> dict:
    """Of one loss, over all captures.  Test: tests/extras/test_loss_table.py::test_table"""
    failures, seconds = sum(r.failures for r in rides), sum(len(r.qpos) for r in rides) / CONTROL_RATE
    return {
        "captures": len(rides),
        "completed": float(np.mean([r.failures == 0 for r in rides])),
        "failures": failures,
        "fails_every_s": seconds / failures if failures else None,
    }


def table(found: dict) -> str:
    """A set's table: a line a loss, and for every character completed and fails every.

    Test      tests/extras/test_loss_table.py::test_table"""
    names = list(next(iter(found.values())))
    lines = [["lost", *(f"{n.capitalize()}: {what}" for n in names for what in ("completed", "fails every s"))]]
    for loss, row in found.items():
        every = [row[n]["fails_every_s"] or math.inf for n in names]
        cells = [[cell(row[n]["completed"], "{:.2f}"), cell(e, "{:.1f}")] for n, e in zip(names, every, strict=True)]
        lines.append([loss, *sum(cells, [])])
    return markdown(lines)


def main(argv=None) -> int:
    """Print the tables.  -> exit status, 1 if a recording could not be read

    Test      tests/extras/test_loss_table.py::test_table, test_a_broken_recording"""
    opt = cli(Options, argv, "python -m extras.losses", __doc__)
    cast = cast_of(opt)
    check_folders(opt.json, read=(opt.stream, *parts(opt.motion), *(path for *_, path in cast.values())))
    found, broken = measured(opt, cast)
    if opt.json:  # first: whoever reads what is printed may not read to its end
        atomic_write(opt.json, json.dumps(found, indent=2, allow_nan=False) + "\n")
    for title, rows_ in found.items():
        n = next(iter(next(iter(rows_.values())).values()))["captures"]
        print(f"{title}: {n} captures\n\n{table(rows_)}\n")
    return complain(broken)


if __name__ == "__main__":
    run_main(main)

r"""Beat Saber's replays (BSOR, "Beat Saber Open Replay", *.bsor of BeatLeader) -> samples, as a CSV's lines are.

    magic, version | 0 info | 1 frames | 2 notes | 3 walls | 4 heights | 5 pauses | …      little endian

The format is public: github.com/BeatLeader/BS-Open-Replay.  Each section is its number in a byte, then what it holds:
of all but the info a count and so many entries.  A string is its length and UTF-8.  Axes are Unity's.

A frame's time is the song's.  It stands still in a pause, and runs faster or slower than the player's where the song
does, so it is turned into the player's: a pause is then a gap like any other.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

from headset.reader import DEVICES, PARTS, Reader, Sample, is_live, lines_of
from plumbing.cli import UserError

MAGIC, VERSION, LARGEST = 0x442D3D69, 1, 2**28  # bytes: of a file; an hour at 144 Hz has a fifth of it
SECTIONS = ("info", "frames", "notes", "walls", "heights", "pauses")
INFO = (  # name, and the kind as `struct` has it; s: a string
    *((name, "s") for name in (
        "version", "game version", "timestamp", "player's id", "player's name", "platform", "tracking system", "hmd",
        "controller", "hash", "song's name", "mapper", "difficulty",
    )),
    ("score", "i"), ("mode", "s"), ("environment", "s"), ("modifiers", "s"), ("jump distance", "f"),
    ("left-handed", "B"), ("height", "f"), ("start time", "f"), ("fail time", "f"), ("speed", "f"),
)  # fmt: skip
FRAME = np.dtype([("time", "<f4"), ("fps", "<i4"), ("poses", "<f4", (len(DEVICES), len(PARTS)))])
NOTE, CUT = 16, 72  # bytes of a note's event, and of the cut that follows one of kind 0 (good) or 1 (bad)
SIZES = {"walls": 16, "heights": 8, "pauses": 12}  # bytes of an entry
STRING, NAME = 2**16, 255  # bytes: of a string at most; of one whose length is doubted
TRIED = 1000  # ways to read the strings of an info that are tried at most
PAUSE = 1e6  # s, of a pause at most
PACES = {"SS": 0.85, "FS": 1.2, "SF": 1.5}  # Beat Saber's own modifiers: slower, faster, super fast song


class Bytes:
    """The bytes of a file, read one after the other; what they do not hold is a UserError that names the place."""

    def __init__(self, name, raw: bytes, at=0):
        self.name, self.raw, self.at = str(name), raw, at

    def fault(self, what, says, valid) -> UserError:
        """What is wrong here."""
        return UserError(f"{self.name}, byte {self.at}, {what}: {says}; valid: {valid}")

    @property
    def left(self):
        return len(self.raw) - self.at

    def skip(self, size, what) -> int:
        """Step over so many bytes.  -> where they begin"""
        if self.left < size:
            raise self.fault(what, f"wants {size} bytes, and the file has {self.left} more", "a whole file")
        self.at += size
        return self.at - size

    def number(self, kind, what):
        """The next number, of a kind as `struct` has it."""
        return struct.unpack_from(f"<{kind}", self.raw, self.skip(struct.calcsize(f"<{kind}"), what))[0]

    def count(self, size, what) -> int:
        """How many entries of at least so many bytes follow: never more than the file has room for."""
        n = self.number("i", what)
        if not 0 <= n * size <= self.left:
            self.at -= 4
            valid = f"0 to {(self.left - 4) // size}, which is what the file has room for"
            raise self.fault(what, f"a count of {n}", valid)
        return n

    def string(self, what) -> str:
        """The next string, by its length as it stands there."""
        n = self.count(1, f"length of the {what}")
        if n > STRING:
            raise self.fault(what, f"a string of {n} bytes", f"at most {STRING}")
        start = self.skip(n, what)
        return self.raw[start : start + n].decode("utf-8", "replace")


class Replay:
    """One replay, read whole; what a `Reader` is for a CSV.

    name, unreadable : as of a Reader
    info   : what INFO names; times (n,) [s], of the song; poses (n, 3, 7), as they are in the file
    pauses : (start in the song, duration), each [s]
    Raises    UserError: no BSOR, cut short, a count or a string that the file has no room for, a number that is none
    Test      tests/headset/test_bsor.py::test_read_back, test_what_is_wrong, test_cut_anywhere
    """

    unreadable = 0

    def __init__(self, path, devices=3):
        self.name, self.devices = str(path), devices
        b = Bytes(path, whole(path))
        check_start(b)
        self.info, self.pauses = read_info(b), []
        self.times, self.poses = read_frames(b)
        for number, section in enumerate(SECTIONS[2:], 2):
            if not b.left:  # a file may end before a section, and not in one
                break
            begin(b, number)
            if section == "notes":
                skip_notes(b)
            elif section == "pauses":
                self.pauses = read_pauses(b)
            else:
                b.skip(b.count(SIZES[section], section) * SIZES[section], section)

    def samples(self):
        """Samples as `Reader.read` gives them, one by one."""
        seconds = played(self.times, pace(self.info), self.pauses)
        for t, row in zip(seconds.tolist(), self.poses, strict=True):
            row = row.astype(float)
            row[self.devices :] = np.nan
            yield Sample(t, row[:, :3], row[:, 3:])


def whole(path) -> bytes:
    """The bytes of a file.  UserError: as `is_live`, or it is very large."""
    if is_live(path):
        raise UserError(f"--stream {path}: is a pipe; valid: a .bsor file, or a CSV's lines by a pipe")
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            raw = file.read() if size <= LARGEST else b""  # with a limit it would make room for the limit
    except OSError as error:
        raise UserError(f"--stream {path}: {error.strerror or error}; valid: a file that can be read") from None
    if size > LARGEST:
        raise UserError(f"{path}: is of {size} bytes; valid: one replay, of at most {LARGEST}")
    return raw


def check_start(b: Bytes):
    """Magic number and version.  Test: tests/headset/test_bsor.py::test_what_is_wrong"""
    if b.raw[:4] != MAGIC.to_bytes(4, "little"):
        found = f"begins with {b.raw[:4].hex(' ') or 'nothing'}"
        raise b.fault("magic number", found, f"{MAGIC.to_bytes(4, 'little').hex(' ')}, a BSOR's")
    b.skip(4, "magic number")
    version = b.number("B", "version")
    if version != VERSION:
        b.at -= 1
        raise b.fault("version", version, VERSION)


def begin(b: Bytes, number):
    """A section begins with its number."""
    found = b.number("B", SECTIONS[number])
    if found != number:
        b.at -= 1
        raise b.fault(f"begin of the {SECTIONS[number]}", found, number)


def read_info(b: Bytes) -> dict:
    r"""Who played what.

    Why       the length of a string is that of its UTF-8; but older mods wrote the number of its UTF-16 units there,
              and a name with other letters than English ones is then longer than it says
    Method    of a short string every end is possible, from its length up to three times as far, whose text is UTF-8.
              The first is taken from which all that follows can be read, up to the frames: depth first.  Where there is
              none, the lengths are believed, and what is wrong with them is said
    Test      tests/headset/test_bsor.py::test_lengths_that_are_wrong"""
    begin(b, 0)
    tried, ways = 0, [(0, b.at, {})]
    while ways and tried < TRIED:
        k, at, info = ways.pop()
        tried += 1
        if k == len(INFO):
            if b.raw[at : at + 1] in (b"", b"\1") and info["left-handed"] in (0, 1):
                b.at = at
                return info
            continue
        name, kind = INFO[k]
        here = Bytes(b.name, b.raw, at)
        try:
            if kind != "s":
                value = here.number(kind, name)
                ways.append((k + 1, here.at, info | {name: value}))
                continue
            ways += reversed([(k + 1, end, info | {name: text}) for end, text in ends(here, name)])
        except UserError:
            continue
    info = {name: b.string(name) if kind == "s" else b.number(kind, name) for name, kind in INFO}
    if info["left-handed"] not in (0, 1):
        raise b.fault("info, left-handed", info["left-handed"], "0 or 1")
    return info


def ends(b: Bytes, name):
    """Where the next string may end, and its text: first by its length, then later."""
    n = b.count(1, name)
    if n > STRING:
        return
    start, most = b.at, n if n > NAME else 3 * n
    for end in range(start + n, min(start + most, len(b.raw)) + 1):
        try:
            yield end, b.raw[start:end].decode("utf-8")
        except UnicodeDecodeError:
            continue


def read_frames(b: Bytes):
    """Times (n,) of the song [s] and poses (n, 3, 7), all finite."""
    begin(b, 1)
    n = b.count(FRAME.itemsize, "frames")
    if not n:
        raise b.fault("frames", "none", "one or more")
    start = b.skip(n * FRAME.itemsize, "frames")
    frames = np.frombuffer(b.raw, FRAME, n, start)
    numbers = np.concatenate([frames["time"][:, None], frames["poses"].reshape(n, -1)], axis=1)
    if not np.isfinite(numbers).all():
        k, i = np.argwhere(~np.isfinite(numbers))[0]
        what = ("time", *(f"{d} {p}" for d in DEVICES for p in PARTS))[i]
        b.at = start + k * FRAME.itemsize + (4 * i + 4 if i else 0)
        raise b.fault(f"frame {k}, {what}", numbers[k, i], "a finite number")
    return frames["time"].astype(float), frames["poses"]


def skip_notes(b: Bytes):
    """The notes, whose entries are of two sizes."""
    for k in range(b.count(NOTE, "notes")):
        b.skip(NOTE - 4, f"note {k}")
        if b.number("i", f"note {k}") in (0, 1):
            b.skip(CUT, f"cut of note {k}")


def read_pauses(b: Bytes) -> list[tuple[float, float]]:
    """(start in the song, duration), each [s]."""
    out = []
    for k in range(b.count(SIZES["pauses"], "pauses")):
        duration, start = b.number("q", f"pause {k}"), b.number("f", f"pause {k}")
        if not 0 <= duration <= PAUSE or not np.isfinite(start):
            b.at -= SIZES["pauses"]
            raise b.fault(f"pause {k}", f"{duration} s at {start} s", f"0 to {PAUSE:g} s, at a finite time")
        out.append((start, float(duration)))
    return sorted(out)


def pace(info) -> float:
    """Seconds of the song in one of the player's: as practised, or by a modifier.

    Test      tests/headset/test_bsor.py::test_times"""
    if np.isfinite(info["speed"]) and 0.1 <= info["speed"] <= 10.0:
        return info["speed"]
    said = (m.strip() for m in info["modifiers"].split(","))
    return next((PACES[m] for m in said if m in PACES), 1.0)


def played(times, pace: float, pauses) -> np.ndarray:
    r"""The player's time [s] of frames at so many seconds of the song.

    Equation  t = s / pace + Σ duration of the pauses that began before s
    Test      tests/headset/test_bsor.py::test_times"""
    starts, lasted = np.array([[-np.inf, 0.0], *pauses]).T
    return times / pace + np.cumsum(lasted)[np.searchsorted(starts, times) - 1]


# ------------------------------------------------------------------------------------ whatever it is


def is_replay(path) -> bool:
    """Whether a file is named as a replay.  Test: tests/headset/test_bsor.py::test_folder_and_single_file"""
    return str(path) != "-" and Path(path).suffix.lower() == ".bsor"


def opened(path, strict=True, devices=3):
    """A CSV file, a live stream or a replay: its reader, and its samples as they come.

    Args      strict, devices : as `Reader`
    Raises    UserError: as `Reader` and `Replay`
    Test      tests/headset/test_bsor.py::test_folder_and_single_file"""
    if is_replay(path):
        replay = Replay(path, devices)
        return replay, replay.samples()
    reader = Reader("standard input" if str(path) == "-" else str(path), strict, devices)
    return reader, reader.read(lines_of(path))

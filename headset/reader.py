"""A headset's lines -> samples in our axes: columns, axes, and what stands in for a device that is lost."""

from __future__ import annotations

import os
import queue
import re
import sys
import threading
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from human import heading, quat_about, quat_conj, quat_matrix, quat_mul, quat_rotate, quat_slerp
from mocap.data import CONTROL_RATE
from mocap.guess import without_prefix
from plumbing.cli import UserError
from plumbing.files import kind_of, parse_number
from retarget import Reference

DEVICES = ("head", "left", "right")
PARTS = ("px", "py", "pz", "qx", "qy", "qz", "qw")
COLUMNS = ("time", *(f"{d}_{p}" for d in DEVICES for p in PARTS))
SAMPLE_RATE = 90.0  # Hz, of a stream without times
LINE_LIMIT = 65536  # bytes
UNREADABLE_LIMIT = 100  # unreadable lines in a row that end a live stream
EMPTY = ("", "nan", "null", "none")
KINDS = (".csv", ".bsor")  # of files; `headset.bsor` reads the other one
STEPS, JUDGED = (0.0005, 0.1), 11  # s between two rows of a headset; steps by whose median a time column is judged
COMPRESSED = (b"\x1f\x8b", b"PK\3\4", b"BZh", b"\xfd7zXZ", b"(\xb5/\xfd", b"7z\xbc\xaf")  # gz, zip, bz2, xz, zst, 7z
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}  # which are not ours

# ------------------------------------------------------------------------------------ reading


class Sample(NamedTuple):
    """One reading of the three devices: t [s], pos (3, 3) [m], quat (3, 4); NaN where there is none."""

    t: float
    pos: np.ndarray
    quat: np.ndarray


_HEAD = ("head", "hmd", "headset", "centereyeanchor", "centereye", "maincamera")
_SIDES = ("left", "right")
_HELD = ("hand", "controller", "touch", "wand", "index", "anchor", "device", "tracker")
_POSITION = ("p", "pos", "position", "loc", "location", "translation")
_ROTATION = ("q", "quat", "quaternion", "rot", "rotation", "ori", "orient", "orientation")
_MATRIX = ("m", "mat", "matrix", "pose", "transform")
_LOOSE = (
    *("l", "r", "t", "local", "world", "global", "knuckles", "oculus", "quest", "vive", "camera", "user", "player"),
    *("vr", "ovr", "wrist", "node"),
)
_WORD, _LOOSE_WORD = (
    "|".join(sorted((*_HEAD, *_SIDES, *_HELD, *_POSITION, *_ROTATION, *"xyzw", *more), key=len, reverse=True))
    for more in ((), _LOOSE)
)
_TIME = re.compile(
    r"(?:delta|elapsed|session|system|unix|epoch|utc)?(?:time|timestamp|t)(s|sec|seconds|ms|us|ns|milliseconds)?"
)
_SECONDS = {"ms": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "ns": 1e-9}
_METRES = "(?:c|m)?m|(?:centi|milli)?met(?:re|er)s?"
_LENGTH = re.compile(rf"[\[(](?:{_METRES})[\])]|[_ ](?:{_METRES})$", re.I)


def column(name: str, loose=False) -> str | None:
    """The canonical name of a column, or None for one that is not ours: "HeadPosX", "left hand.rotation.w" …

    Rule      the words of a device, of position or rotation, and an axis; in any order and case, with or without
              anything between them; without position or rotation x, y, z are a position.  A pose as a matrix has its
              row and column: "hmd_m03", "left_matrix[1][2]".  loose: also l and r for the hands, tx for a position, a
              camera for the head, and makers' names; for files that lack columns otherwise
    Test      tests/headset/test_stream.py::test_columns, tests/headset/test_columns.py::test_any_order_and_case"""
    text = _LENGTH.sub("", name.strip().strip('"'))
    letters = re.sub(r"[^a-z]", "", text.lower())
    if _TIME.fullmatch(re.sub(r"[^a-z]", "", name.lower())):
        return "time"
    if re.search(r"\d", text):
        return _matrix_column(letters, re.findall(r"\d", text))
    words = _words(letters, loose)
    device, axis = _device(words), [w for w in words if w in tuple("xyzw")]
    turns, moves = (any(w in kind for w in words) for kind in (_ROTATION, (*_POSITION, "t")))
    if not device or len(axis) != 1 or (turns and moves) or (axis == ["w"] and not turns):
        return None
    return f"{device}_{'q' if turns else 'p'}{axis[0]}"


def _words(letters, loose=False) -> list[str]:
    """The words that, one after the other, make up the letters; none if they do not, or if they are too many."""
    found = re.findall(_LOOSE_WORD if loose else _WORD, letters) if len(letters) < 80 else []
    return found if "".join(found) == letters else []


def _device(words) -> str | None:
    devices = {"head" for w in words if w in (*_HEAD, "camera")} | {s for w in words for s in _SIDES if w in (s, s[0])}
    return devices.pop() if len(devices) == 1 else None


def columns(names, wanted) -> list:
    """`column` of each name: as it stands, loosely, or without what nearly all begin with: the first that gives all of
    the wanted ones.

    Test      tests/headset/test_columns.py::test_what_all_columns_share"""
    bare = without_prefix(names)
    ways = [[column(n) for n in names], [column(n, True) for n in names], [column(n, True) for n in bare]]
    twice = lambda way: any(k > 1 for c, k in Counter(way).items() if c and c != "time")  # noqa: E731
    return next((way for way in ways if set(wanted) <= told(way) and not twice(way)), ways[0])


def told(known) -> set:
    """The columns that are there, those that follow from a matrix among them.

    Test      tests/headset/test_columns.py::test_matrices"""
    whole = [d for d in DEVICES if {f"{d}_m{i}{j}" for i in range(3) for j in range(4)} <= set(known)]
    return {*known, *(f"{d}_{p}" for d in whole for p in PARTS)}


def _matrix_column(letters, digits) -> str | None:
    """ "hmd_m03" -> head_m03: row and column, from 0, of the upper three rows of a 4 x 4 matrix."""
    device = re.fullmatch(f"({'|'.join((*_HEAD, *_SIDES))})(?:{'|'.join(_HELD)})*(?:{'|'.join(_MATRIX)})*", letters)
    if not device or len(digits) != 2 or int(digits[0]) > 2 or int(digits[1]) > 3:
        return None
    return f"{_device([device[1]])}_m{digits[0]}{digits[1]}"


def time_unit(name: str) -> float:
    """Seconds in the unit that a time column's name gives: "delta_time_ms" is in milliseconds; 1 without one.

    Test      tests/headset/test_columns.py::test_catalogue"""
    found = _TIME.fullmatch(re.sub(r"[^a-z]", "", name.lower()))
    return _SECONDS.get(found[1] if found else None, 1.0)


class Reader:
    """Lines -> Samples, in the file's own axes, quaternions x, y, z, w.

    name   : of the source, for complaints
    strict : a line that cannot be read is an error (files); otherwise it is skipped and counted (live streams), and
             100 of them in a row are an error.  A file's last line may be cut short: it is skipped
    devices : 3, or 1: the headset's columns alone
    axes   : what a comment before the columns says they are ("# axes: openxr"), or None
    Test     tests/headset/test_stream.py::test_columns, test_garbage_lines, test_garbage_on_stdin, test_headset_only,
             test_time_columns
    """

    def __init__(self, name: str, strict=True, devices=3):
        self.name, self.strict = name, strict
        self.steps, self.before = [], None  # of the time column [s]
        self.wanted = COLUMNS[: 1 + devices * len(PARTS)]
        self.line = self.unreadable = self.in_a_row = 0
        self.at = self.names = None
        self.matrices, self.second, self.axes = [], 1.0, None

    def read(self, lines):
        """Samples of an iterable of lines (bytes or text), one by one."""
        for line in lines:
            self.line += 1
            if self.line == 1 and isinstance(line, bytes) and line.startswith(COMPRESSED):
                raise UserError(f"{self.name}: is compressed: unpack it; valid: a CSV's lines in UTF-8")
            text = line.decode("utf-8", "replace") if isinstance(line, bytes) else line
            if self.at is None and "\r" in text.strip() and "\0" not in text:
                raise UserError(f"{self.name}, line {self.line}: line ends of CR alone; valid: LF, or CR and LF")
            if len(text) >= LINE_LIMIT:
                raise UserError(f"{self.name}, line {self.line}: longer than {LINE_LIMIT} bytes; valid: a CSV's lines")
            cells = text.lstrip("\ufeff").strip()
            if not cells or cells.startswith("#"):
                found = re.search(r"^#.*\baxes:? (\w+)", cells)
                self.axes = self.axes or (found[1] if found else None)
                continue
            if self.at is None:
                if "\0" in text:
                    raise UserError(f"{self.name}, line {self.line}: UTF-16 or no text; valid: a CSV's lines in UTF-8")
                self.header(cells)
                continue
            try:
                values = self.values(cells)
            except ValueError as error:
                self.unreadable += 1
                self.in_a_row += 1
                if self.strict and text.endswith("\n") or self.in_a_row >= UNREADABLE_LIMIT:
                    raise UserError(f"{self.name}, line {self.line}, {error}") from None
                continue
            self.in_a_row = 0
            devices = values[1:].reshape(3, 7)
            if len(self.steps) < JUDGED and not fault(devices[0], far=np.inf):
                self.judge(float(values[0]))
            yield Sample(float(values[0]), devices[:, :3], devices[:, 3:])
        if self.at is None:
            raise UserError(f"{self.name}: is empty; expected a line of column names: {valid_columns()}")

    def judge(self, t):
        """UserError if the first times cannot be a headset's seconds; rows before it was tracked do not count."""
        if np.isfinite(t):
            self.steps += [] if self.before is None else [t - self.before]
            self.before = t
        if len(self.steps) < JUDGED:
            return
        step = sorted(self.steps)[JUDGED // 2] or sum(self.steps) / JUDGED  # coarse times: most are as the one before
        if STEPS[0] <= step < 0.999 * STEPS[1]:
            return
        named = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "minutes": 60.0, "hours": 3600.0}
        unit = next((f": {name}?" for name, u in named.items() if 20 <= 1 / max(abs(step) * u, 1e-300) <= 1000), "")
        valid = f"seconds that increase, {1 / STEPS[1]:.0f} to {1 / STEPS[0]:.0f} rows in each"
        what = f"time steps of {step:.3g} s{unit}"
        if step <= 0:
            what = f"time runs backwards, by {-step:.3g} s a row" if step else "time stands still"
            valid += ", or no column time (then --sample-rate says how many)"
        raise UserError(f"{self.name}, line {self.line}, column {self.names[self.at[0]]}: {what}; valid: {valid}")

    def header(self, line):
        """The first line: where which column is."""
        self.names = [c.strip() for c in line.split(",")]
        known = columns(self.names, self.wanted[1:])
        ours = lambda mark: sum(c is not None for c in map(column, line.split(mark)))  # noqa: E731
        mark = max(SEPARATORS, key=ours)
        if ours(mark) > max(len(known) - known.count(None), 1):
            valid = "commas, and points in the numbers"
            raise UserError(f"{self.name}, line {self.line}: {SEPARATORS[mark]} between the columns; valid: {valid}")
        used = DEVICES[: len(self.wanted) // len(PARTS)]
        entries = [[f"{d}_m{i}{j}" for i in range(3) for j in range(4)] for d in used]
        self.matrices = [
            (k, [known.index(c) for c in names]) for k, names in enumerate(entries) if set(names) <= set(known)
        ]
        missing = [c for c in self.wanted[1:] if c not in told(known)]
        twice = [c for c, k in Counter(known).items() if c and k > 1 and c != "time"]
        if twice:
            raise UserError(f"{self.name}, line {self.line}: column {twice[0]} is there twice; valid: once each")
        if missing:
            more = f" and {len(missing) - 4} more" if len(missing) > 4 else ""
            alone = "" if any(c.startswith("head") for c in missing) else "; --sensors hmd needs the headset's alone"
            raise UserError(
                f"{self.name}, line {self.line}: no column {', '.join(missing[:4])}{more}; "
                f"it has {', '.join(self.names)[:200]}; valid: {valid_columns()}{alone}"
            )
        self.at = [known.index(c) if c in known else -1 for c in self.wanted]
        self.second = time_unit(self.names[self.at[0]]) if self.at[0] >= 0 else 1.0

    def values(self, line):
        """The numbers of a row in the order of COLUMNS.  ValueError: which column, and why."""
        cells = line.split(",")
        if len(cells) != len(self.names):
            column = self.names[min(len(cells), len(self.names)) - 1]
            comma = " (commas in the numbers? valid: points)" if len(cells) > len(self.names) else ""
            valid = f"{len(self.names)}, as in the first line{comma}"
            raise ValueError(f"column {column}: {len(cells)} cells; valid: {valid}")
        out = np.full(len(COLUMNS), np.nan)
        for k, i in enumerate(self.at):
            out[k] = self.number(cells, i)
        out[0] *= self.second
        for k, at in self.matrices:
            out[1 + 7 * k : 8 + 7 * k] = pose_of(np.array([self.number(cells, i) for i in at]).reshape(3, 4))
        return out

    def number(self, cells, i):
        """A cell's number; NaN for a column that is not there, or an empty cell."""
        cell = cells[i].strip().strip('"') if i >= 0 else ""
        if cell.lower() in EMPTY:
            return np.nan
        try:
            return parse_number(cell)
        except ValueError:
            raise ValueError(f"column {self.names[i]}: {cell[:40]!r}; valid: a number, or nothing") from None


def pose_of(matrix):
    """The upper three rows of a pose's matrix -> position and quaternion x, y, z, w (7,); NaN if it is no rotation.

    Test      tests/headset/test_columns.py::test_matrices"""
    turn = matrix[:, :3]
    if not np.isfinite(matrix).all() or not np.allclose(turn @ turn.T, np.eye(3), atol=0.05) or np.linalg.det(turn) < 0:
        return np.full(7, np.nan)
    return np.concatenate([matrix[:, 3], Rotation.from_matrix(turn).as_quat()])


def valid_columns() -> str:
    """The columns as a complaint lists them.  Test: tests/headset/test_stream.py::test_columns"""
    return (
        "time (optional) and DEVICE_px, _py, _pz, _qx, _qy, _qz, _qw for DEVICE head, left, right, "
        "or a matrix's DEVICE_m00 to _m23"
    )


def is_live(path) -> bool:
    """Whether "-" or a named pipe, to be read as the lines come, or a file.

    Raises    UserError: nothing there, a folder, a device
    Test      tests/headset/test_stream.py::test_pipes"""
    if str(path) == "-":
        return True
    valid = "a .csv or .bsor file, a named pipe, or - for standard input"
    try:
        kind = kind_of(path)
    except (OSError, ValueError) as error:
        why = "no such file" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", None) or error
        raise UserError(f"--stream {path}: {why}; valid: {valid}") from None
    if kind not in (None, "a pipe"):
        raise UserError(f"--stream {path}: is {kind}; valid: {valid}")
    return kind is not None


def files_of(path) -> list[Path]:
    """The recordings (.csv, .bsor) of a folder and below it, perhaps none; or the file itself.

    A link to nothing is among them: who reads it says so.
    Test      tests/headset/test_stream.py::test_folder_of_recordings, tests/headset/test_body.py::test_recordings"""
    path = Path(path)
    if not os.path.isdir(path):
        return [path]
    there = lambda f: os.path.isfile(f) or not os.path.exists(f)  # noqa: E731
    return sorted(f for f in path.rglob("*") if f.suffix.lower() in KINDS and there(f))


def sound(read, items) -> tuple[list, list[str]]:
    """`read` of every item, and what is said of those that it cannot: they are left out.

    Raises    UserError: that of the first, where none can be read
    Test      tests/extras/test_loss_table.py::test_a_broken_recording,
              tests/headset/test_stream.py::test_folder_of_recordings"""
    out, broken = [], []
    for item in items:
        try:
            out.append(read(item))
        except UserError as error:
            broken.append(str(error))
    if broken and not out:
        raise UserError(broken[0] + (f"; nor can {len(broken) - 1} others be used" if len(broken) > 1 else ""))
    return out, broken


def lines_of(path):
    """The lines of a file or a pipe, or of standard input for "-", as they come, none longer than LINE_LIMIT.

    Raises    UserError: as `is_live`, or it cannot be read
    Test      tests/headset/test_stream.py::test_columns, test_stdin, test_pipes"""
    if str(path) == "-":
        yield from iter(lambda: sys.stdin.buffer.readline(LINE_LIMIT), b"")
        return
    is_live(path)
    try:
        with open(path, "rb") as file:
            yield from iter(lambda: file.readline(LINE_LIMIT), b"")
    except OSError as error:
        raise UserError(f"--stream {path}: {error.strerror or error}; valid: a file that can be read") from None


def arriving(items, silence: float, period: float):
    """The items of an iterator as they come, and how many seconds nothing came: first `silence`, then every `period`.

    A thread reads ahead, 1000 items at most.
    Test      tests/headset/test_stream.py::test_stdin_that_pauses"""
    box, end = queue.Queue(1000), object()

    def read():
        try:
            for item in items:
                box.put(item)
            box.put(end)
        except BaseException as error:  # noqa: BLE001, raised again where it can be seen
            box.put(error)

    threading.Thread(target=read, daemon=True).start()
    wait = silence
    while True:
        try:
            item = box.get(timeout=wait)
        except queue.Empty:
            yield float(wait)
            wait = period
            continue
        wait = silence
        if item is end:
            return
        if isinstance(item, BaseException):
            raise item
        yield item


# ------------------------------------------------------------------------------------ axes

_BACKWARD = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # x right, y up, z backward: right-handed
AXES = {  # name -> matrix whose rows are our x (forward), y (left), z (up) in the source's coordinates
    "unity": np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]]),  # x right, y up, z forward: left-handed
    "openxr": _BACKWARD,  # grip poses, as OpenXR's and WebXR's gripSpace
    "mujoco": np.eye(3),  # ours, and ROS's
    "openvr": _BACKWARD,  # SteamVR and WebVR: poses of the devices themselves, WebXR's targetRaySpace
    "unreal": np.diag([1.0, -1.0, 1.0]),  # x forward, y right, z up: left-handed; centimetres
}
UNIT = {"unreal": 0.01}  # metres a unit, where it is not 1
# How far the fingers point below the controller's forward axis [degrees].  ASSUMED.  90: OpenXR's grip pose, whose
# forward axis runs along the fist from the little finger to the thumb.  15: what points, as a ray or a sabre does.
# Measured: the forearm lies 5 to 55 degrees below it in 45 of Unity's recordings, 15 to 22 in three of WebVR's.
GRIP = {"unity": 15.0, "openxr": 90.0, "mujoco": 90.0, "openvr": 15.0, "unreal": 15.0}


def to_world(pos, quat, axes: str, grip: float | None = None, unit: float | None = None):
    r"""A source's axes -> ours: x forward, y left, z up, right-handed.

    Equation  p' = M p;  R' = M R Mᵀ, so that (x, y, z, w) -> (w, det(M) M (x, y, z)): an axis of rotation is an
              axial vector, and a left-handed source's turns are the other way round
              hands: R' R_y(−(90° − grip)), because the canonical hand's fingers point along −z
    Args      pos (..., 3, 3), quat (..., 3, 4) x, y, z, w, of head, left, right
              axes : one of AXES; grip [degrees], unit [m], of the axes by default
    Returns   pos (..., 3, 3) [m], quat (..., 3, 4) w, x, y, z
    Raises    UserError: unknown axes
    Test      tests/headset/test_stream.py::test_axes_by_hand, test_axes_against_matrices, test_grip
    """
    if axes not in AXES:
        raise UserError(f"--axes {axes}: unknown; valid: {', '.join(AXES)}")
    m, quat = AXES[axes], np.asarray(quat, float)
    turn = np.radians(-90.0 + (GRIP[axes] if grip is None else grip))
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is the Guard's
        q = np.concatenate([quat[..., 3:], np.round(np.linalg.det(m)) * (quat[..., :3] @ m.T)], axis=-1)
        if turn:
            q[..., 1:, :] = quat_mul(q[..., 1:, :], quat_about(1, turn))
        return np.asarray(pos, float) @ m.T * (UNIT.get(axes, 1.0) if unit is None else unit), q


# ------------------------------------------------------------------------------------ what can go wrong

GAP = 0.1  # s without a row: a drop-out
FROZEN = 0.25  # s without any change while another device moves: lost
FAR_AWAY = 100.0  # m from the source's origin: not a place
REACH = 1.5  # m from headset to controller: longer than an arm
TELEPORT = 1.0  # m between two headset poses: the stream is re-anchored
STEP = 0.2  # m between two samples of a headset: too fast for a head
JUMP = 0.5  # m between two samples of a controller: too fast for a hand
SETTLE = 0.1  # s that a controller which jumped must stay where it is
HOLD, RELAX = 1.0, 0.5  # s that a lost controller is held; time constant with which it then sinks
COAST, SMOOTH = 0.5, 0.15  # s: time constants with which a lost headset slows down, and its velocity is taken
BLEND, CATCH_UP = 0.3, 2.0  # s, m/s: the way back from the held to the true pose
CLOCK_AHEAD, CLOCK_BACK = 5.0, 1.0  # s: farther jumps of the time column are another clock
# The hanging hand in the headset's heading frame [m], of a user of 1.75 m (the built-in human).  ASSUMED
NEUTRAL = np.array([[0.0, 0.0, 0.0], [-0.04, 0.26, -0.90], [-0.04, -0.26, -0.90]])


def controllers_hang(ref: Reference) -> Reference:
    r"""The reference with controllers that hang beside the user, wherever the headset goes  [Reda23 §4.2].

    Equation  p_i = p_head + s ⊙ R_z(ψ) n_i,  R_i = R_z(ψ): ψ the headset's heading, s the devices' scale, n NEUTRAL
    Why       how a policy that was trained with three devices is driven with one.  ASSUMED: §4.2 does not say; it is
              also what `Guard` gives for controllers that were never seen
    Test      tests/headset/test_stream.py::test_controllers_hang
    """
    turn = quat_about(2, heading(ref.sensor_quat[:, 0]))[:, None]  # (F, 1, 4)
    pos, quat = ref.sensor_pos.copy(), ref.sensor_quat.copy()
    pos[:, 1:] = pos[:, :1] + ref.sensor_scale[:, None] * quat_rotate(turn, NEUTRAL[1:])
    quat[:, 1:] = turn
    return replace(ref, sensor_pos=pos, sensor_quat=quat, sensor_rot=quat_matrix(quat)[..., :2].astype(np.float32))


class Clock:
    """The time column -> seconds since the first row, never backwards.

    Rule    no time, or NaN, or ten rows of one time: 1 / rate after the row before; a row up to 1 s before its
            predecessor is dropped; a jump back by more, or by more than 5 s ahead, is another clock: 1 / rate is taken
    Test    tests/headset/test_stream.py::test_unordered_times, test_another_clock
    """

    def __init__(self, rate=SAMPLE_RATE):
        self.rate, self.last, self.base = rate, None, 0.0
        self.dropped = self.jumps = self.same = 0
        self.timed = False  # whether a row had a time
        self.forget = False  # the next row tells a new time

    def stamp(self, t: float) -> float | None:
        """Seconds since the first row, or None for a row to drop."""
        self.timed |= bool(np.isfinite(t))
        if self.last is None:
            self.base = -t if np.isfinite(t) else 0.0
            self.last = 0.0
            return 0.0
        step = t + self.base - self.last if np.isfinite(t) else 1.0 / self.rate
        step = 0.0 if abs(step) < 1e-9 else step
        self.same = self.same + 1 if step == 0 else 0
        if self.forget or self.same >= 10 or not -CLOCK_BACK <= step <= CLOCK_AHEAD:
            self.jumps += not self.forget
            step = 1.0 / self.rate
            self.base = self.last + step - t if np.isfinite(t) else self.base
        self.forget = False
        if step < 0:
            self.dropped += 1
            return None
        self.last += step
        return self.last

    def idle(self, seconds: float) -> float:
        """Time goes on without rows."""
        self.last, self.forget = (self.last or 0.0) + seconds, True
        return self.last


@dataclass
class Track:
    """What the Guard knows of one device."""

    raw: np.ndarray | None = None  # (7,) of the last usable row, as it came
    changed: float = -np.inf  # s, when raw last changed
    good: np.ndarray | None = None  # (3,) last position taken as true, anchored world; of a lost headset, and its way
    yaw: float = 0.0  # its heading
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))  # of the headset, horizontally [m/s]
    lost: str | None = "not seen"  # why, or None
    since: float = 0.0  # s, lost since
    jumped: np.ndarray | None = None  # (3,) where a controller jumped to
    settling: float = 0.0  # s, since when it is there
    last: tuple | None = None  # pose given out: of the headset in the world, of a controller in its heading frame
    held: tuple | None = None  # pose to blend from, likewise
    mix: float = 1.0  # 0 held .. 1 true
    pace: float = 0.0  # of mix, per second


def fault(row, far=FAR_AWAY) -> str | None:
    """Why a device's row (7,) cannot be a pose, or None.  Test: tests/headset/test_stream.py::test_faults"""
    if not np.isfinite(row).all():
        return "not finite"
    if not row.any():
        return "all zero"
    if np.abs(row[:3]).max() > far:
        return "far away"
    return "no rotation" if abs(np.linalg.norm(np.clip(row[3:], -1e3, 1e3)) - 1.0) > 0.1 else None


class Guard:
    r"""Three devices that may be lost at any time -> three finite poses.

    Rule      a device is lost in a row that is all zero, not finite, no rotation (| |q| − 1 | > 0.1) or more than
              100 m away; when it has not changed for 0.25 s while another one moved; a controller also when it is
              1.5 m from the headset, or moved by more than 0.5 m between two rows, until it has stayed there for
              0.1 s.  More than 0.1 s without a row: all are lost
    Hold      a lost headset goes on as it went, horizontally and ever slower (time constant 0.5 s: 0.6 m in all at a
              walk's 1.2 m/s), for its user does not stop.  A lost controller keeps its place relative to the headset;
              after 1 s it sinks to hang beside the body (time constant 0.5 s)
    Return    from the held to the true pose in as long as it was lost, in 0.3 s at most, or at 2 m/s if that is
              longer; in 0.3 s a headset after a step of more than 0.2 m between two rows, too
    Anchor    a headset that comes back, or moves between two rows, by more than 1 m has been teleported: the whole
              stream is then shifted and turned about the vertical, so that the headset goes on from where it was (its
              height only if that changed by more than 0.5 m)
    Devices   with `devices` 1 nothing is said of controllers; that they hang beside the body is the reader's work
    Frame     `to_world`'s, quaternion w, x, y, z; times from `Clock`
    Test      tests/headset/test_stream.py::test_zero_rows, test_nan_rows, test_frozen_sensor, test_drop_out,
              test_teleport,
              test_controller_glitch, test_coast, test_never_nan
    """

    def __init__(self, rate=CONTROL_RATE, devices=3):
        self.rate, self.devices, self.t = rate, devices, None
        self.tracks = [Track() for _ in DEVICES]
        self.yaw, self.shift = 0.0, np.zeros(3)  # the anchor: p' = R_z(yaw) p + shift
        self.events, self.seconds = Counter(), Counter()  # (device, what) -> how often, how long
        self.heads = Counter()  # what the headset's rows were: a fault, or None -> how many

    def push(self, sample: Sample, why=None) -> list[Sample]:
        """The poses to use, in order: several after a drop-out, none before the headset is seen.

        Args      why : the whole row is no reading, for this reason"""
        out = []
        if self.t is not None and sample.t - self.t > GAP:
            nothing = np.full((3, 7), np.nan)
            while self.t + 1.0 / self.rate < sample.t:
                out.append(self._one(self.t + 1.0 / self.rate, nothing, "drop-out"))
        out.append(self._one(sample.t, np.concatenate([sample.pos, sample.quat], axis=1), why))
        return [s for s in out if s is not None]

    def live(self, device=0) -> bool:
        """Is the last pose given out the device's own, not a held or blended one?"""
        return self.tracks[device].lost is None and self.tracks[device].mix >= 1.0

    def report(self) -> list[str]:
        """What happened, one line a kind.  Test: tests/headset/test_stream.py::test_zero_rows"""
        lines = []
        for key, n in sorted(self.events.items()):
            if key[0] not in DEVICES[: self.devices]:
                continue
            lasted = f", {self.seconds[key]:.2f} s" if self.seconds[key] else ""
            lines.append(f"{' '.join(key)}: {n} time{'s' * (n > 1)}{lasted}")
        return lines

    def lost(self) -> dict:
        """Seconds for which each device was lost, for whatever reason.

        Test      tests/headset/test_stream.py::test_folder_of_recordings"""
        names = DEVICES[: self.devices]
        return {name: round(sum(s for key, s in self.seconds.items() if key[0] == name), 3) for name in names}

    def _one(self, t, rows, why=None):
        """One row of every device -> Sample or None."""
        dt = 0.0 if self.t is None else t - self.t
        self.t = t
        faults = [why or fault(row) for row in rows]
        for track, row, bad in zip(self.tracks, rows, faults):
            if not bad and (track.raw is None or not np.array_equal(track.raw, row)):
                track.raw, track.changed = row, t
        newest = max(track.changed for track in self.tracks)
        for i, track in enumerate(self.tracks):
            if not faults[i] and t - track.changed > FROZEN and newest > track.changed:
                faults[i] = "frozen"
        self.heads[faults[0]] += why is None
        lost = np.array([bool(f) for f in faults])
        rows = np.where(lost[:, None], [0.0, 0, 0, 1, 0, 0, 0], rows)
        quat = rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
        if not faults[0]:
            self._anchor(rows[0, :3], quat[0])
        turn = quat_about(2, self.yaw)
        pos, quat = quat_rotate(np.tile(turn, (3, 1)), rows[:, :3]) + self.shift, quat_mul(turn, quat)
        head = self._device(0, t, dt, faults[0], (pos[0], quat[0]), (np.zeros(3), np.array([1.0, 0, 0, 0])))
        if head is None:
            return None
        frame = head[0], quat_about(2, heading(head[1]))
        out = [head]
        for i in (1, 2):
            bad = faults[i] or self._astray(i, t, pos[i], head[0])
            out.append(self._device(i, t, dt, bad, (pos[i], quat[i]), frame))
        return Sample(t, np.stack([p for p, _ in out]), np.stack([q for _, q in out]))

    def _anchor(self, pos, quat):
        """Re-anchor the stream if its headset, given as it came, is suddenly elsewhere."""
        head = self.tracks[0]
        place = lambda: quat_rotate(quat_about(2, self.yaw), pos) + self.shift  # noqa: E731
        if head.good is not None and np.linalg.norm(place() - head.good) > TELEPORT:
            self.events["head", "teleport"] += 1
            self.yaw = float(head.yaw - heading(quat))
            gap = head.good - place()
            self.shift = self.shift + gap * [1.0, 1.0, abs(gap[2]) > 0.5]
        head.yaw = float(heading(quat)) + self.yaw

    def _astray(self, i, t, pos, head):
        """Why a controller's usable row is not to be believed, or None."""
        track = self.tracks[i]
        if np.linalg.norm(pos - head) > REACH:
            return "out of reach"
        if track.lost in (None, "jump") and track.good is not None and np.linalg.norm(pos - track.good) > JUMP:
            if track.jumped is None or np.linalg.norm(pos - track.jumped) > JUMP:
                track.settling = t
            track.jumped = pos
            if t - track.settling < SETTLE:
                return "jump"
        track.jumped = None
        return None

    def _device(self, i, t, dt, bad, true, frame):
        """Hold, blend or believe one device.  true, frame : (pos, quat), world -> (pos, quat), or None: never seen."""
        track = self.tracks[i]
        if bad:
            if track.last is None and i == 0:
                return None
            if track.last is None:
                track.last = (NEUTRAL[i], np.array([1.0, 0, 0, 0]))
            if track.lost is None or track.held is None:
                track.held, track.since = track.last, t
            if track.lost != bad:
                self.events[DEVICES[i], bad] += 1
            self.seconds[DEVICES[i], bad] += dt
            track.lost, track.mix = bad, 0.0
            if i == 0:  # the way of v e^{-s / COAST} since the row before
                way = track.velocity * (COAST * np.exp(-(t - track.since) / COAST) * np.expm1(dt / COAST))
                track.held, track.good = (track.held[0] + way, track.held[1]), track.good + way
            elif t - track.since > HOLD:
                share = 1.0 - np.exp(-dt / RELAX)
                track.held = blend(track.held, (NEUTRAL[i], np.array([1.0, 0, 0, 0])), share)
            track.last = track.held
        else:
            own = to_frame(frame, true)
            step = i == 0 and track.lost is None and np.linalg.norm(true[0] - track.good) > STEP
            if track.last is not None and (track.lost or step):
                if step:
                    self.events["head", "step"] += 1
                track.held, track.mix = track.last, 0.0
                fade = BLEND if step else min(BLEND, max(t - track.since, 1e-6))
                track.pace = 1.0 / max(fade, np.linalg.norm(own[0] - track.held[0]) / CATCH_UP)
            if i == 0 and track.lost is None and track.good is not None and dt > 0 and not step:
                fresh = (true[0] - track.good) / dt * [1.0, 1.0, 0.0]
                track.velocity = track.velocity + (1.0 - np.exp(-dt / SMOOTH)) * (fresh - track.velocity)
            track.lost, track.good = None, true[0]
            track.mix = min(1.0, track.mix + dt * track.pace)
            track.last = own if track.mix >= 1.0 else blend(track.held, own, track.mix)
        return from_frame(frame, track.last)


def blend(a, b, share):
    """Between the poses a and b (pos, quat).  Test: tests/headset/test_stream.py::test_poses"""
    return a[0] + share * (b[0] - a[0]), quat_slerp(a[1], b[1], share)


def to_frame(frame, pose):
    """A world pose (pos, quat) in a frame, itself a pose.  Test: tests/headset/test_stream.py::test_poses"""
    back = quat_conj(frame[1])
    return quat_rotate(back, pose[0] - frame[0]), quat_mul(back, pose[1])


def from_frame(frame, pose):
    """A pose in a frame -> the world.  Test: tests/headset/test_stream.py::test_poses"""
    return frame[0] + quat_rotate(frame[1], pose[0]), quat_mul(frame[1], pose[1])

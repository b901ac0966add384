"""BVH motion-capture files: reader, forward kinematics, writer. Nothing here knows about humans or characters.

A BVH file is text in two sections. HIERARCHY nests the joints: each has an OFFSET from its parent and a list of
CHANNELS; an `End Site` closes a chain with an offset and no channels. MOTION has `Frames:`, `Frame Time:` (seconds) and
one row of numbers per frame: every joint's channels, in the order the joints were declared. There is no standard; these
are the readings taken here:

- Units and axes are the file's own (usually centimetres, y up). Angles are degrees. Nothing is converted.
- Rotation channels compose in the order they are listed, each about the axes left by the one before (intrinsic):
  `CHANNELS 3 Zrotation Xrotation Yrotation` means R = Rz Rx Ry acting on column vectors, SciPy's upper-case "ZXY".
- A joint's position channels REPLACE its OFFSET, axis by axis. A few files store the root's positions relative to its
  OFFSET: read those with `root_offset="add"`. The file does not say which it is; the height of the feet does.
- Quaternions are w, x, y, z. q and -q are one rotation; along time the sign is chosen so that q does not jump.
"""

from __future__ import annotations

import os
import re
import warnings
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from plumbing.files import open_regular

CHANNELS = tuple(axis + kind for kind in ("position", "rotation") for axis in "XYZ")
_CHANNEL = {name.lower(): name for name in CHANNELS}
_KEYWORDS = {"OFFSET", "CHANNELS", "JOINT", "END", "ROOT", "{", "}"}
LIMIT = 1e9  # no offset, position or angle of a file is larger; keeps forward kinematics finite
FRAME_TIMES = (1e-3, 1.0)  # s; no capture is faster, and resampling must not make much of little
_INDENT_LIMIT = 40  # deeper joints are not indented further, so that what is written of a chain is linear in its size


class BvhError(ValueError):
    """A malformed BVH, or a motion that cannot be written as one: one line naming the file and what would be valid."""


@dataclass(frozen=True, eq=False)
class Bvh:
    """One file as it stands: J joints (end sites apart), C channels, T frames; file units, file axes, degrees."""

    names: tuple[str, ...]  # (J,) unique, in file order: a parent always precedes its children
    parents: np.ndarray  # (J,) int, -1 for the root, which is joint 0
    offsets: np.ndarray  # (J, 3) float64 OFFSET from the parent
    end_sites: dict[str, np.ndarray]  # joint name -> (3,) float64 offset of its End Site (the farthest, if several)
    channels: tuple[tuple[str, ...], ...]  # (J,) each joint's channel names in file order, out of CHANNELS
    values: np.ndarray  # (T, C) float64, raw
    frame_time: float  # [s]
    path: str


# ---------------------------------------------------------------- reading


def read(path, frame_time=None) -> Bvh:
    """Read one BVH file.

    Format    keywords in any case; any line endings, tabs, blank lines; `{` on the joint's line or the next; up to six
              distinct channels per joint in any order; motion rows may be wrapped or joined if the total count fits
    Args      path : str or path-like; frame_time : [s] to take whatever the file says
    Returns   Bvh
    Raises    BvhError: the file is malformed (one line: file, line or joint, and what would have been valid)
              OSError: the file cannot be opened, or is no regular file
    Test      tests/mocap/test_bvh.py::test_real_files_against_scipy, ::test_malformed
    """
    path = os.fspath(path)
    with open_regular(path) as f:
        data = f.read()
    if not data.strip():
        _fail(path, "the file is empty; expected a BVH, which starts with HIERARCHY")
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        _fail(path, "UTF-16 text; expected ASCII or UTF-8 (save it again in that encoding)")
    if b"\0" in data:
        _fail(path, f"binary data (zero at byte {data.index(0)}); expected a text BVH, which starts with HIERARCHY")
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not re.match(rb"\s*HIERARCHY\b", data, re.I):
        start = data.split(maxsplit=1)[0] if data.strip() else b""
        _fail(path, f"not a BVH: starts with {_show(start)}, expected HIERARCHY")

    motion = re.search(rb"(?:^|\})[ \t]*(MOTION)\b", data, re.I | re.M)
    cut, end = (motion.start(1), "MOTION") if motion else (len(data), "the end of the file")
    try:
        text = data[:cut].decode("utf-8")
    except UnicodeDecodeError as e:
        _fail(path, f"byte 0x{data[e.start]:02x} is not UTF-8; expected ASCII or UTF-8 text", _line(data, e.start))
    names, parents, offsets, end_sites, channels = _parse_hierarchy(path, text, end)
    if not motion:
        _fail(path, "no MOTION section; expected MOTION, 'Frames: N' and 'Frame Time: SECONDS' after the hierarchy")
    frames, frame_time, body = _parse_motion_header(path, data, motion.end(), frame_time)
    values = _parse_values(path, data, body, frames, names, channels)
    return Bvh(names, parents, offsets, end_sites, channels, values, frame_time, path)


def _fail(path, message, line=None) -> NoReturn:
    raise BvhError(f"{path}{'' if line is None else f', line {line}'}: {message}") from None


def _show(token) -> str:
    """A token for an error message: quoted, on one line, cut to 40 characters."""
    token = token.decode("utf-8", "replace") if isinstance(token, bytes) else token
    return repr(token if len(token) <= 40 else token[:37] + "...")


def listed(names, most=100) -> str:
    """Names for an error message, the first `most` of them.  Test: tests/mocap/test_bvh.py::test_long_lists"""
    names = list(names)
    return ", ".join(names[:most]) + (f", … ({len(names)})" if len(names) > most else "")


def outline(names, parents) -> list:
    """A line a joint, indented by how deep it hangs, up to a limit.  Test: tests/mocap/test_bvh.py::test_outline"""
    depth, lines = [], []
    for name, parent in zip(names, parents):
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
        lines.append("  " * min(depth[-1], _INDENT_LIMIT) + name)
    return lines


def _line(data, position) -> int:
    return data.count(b"\n", 0, position) + 1


def _number(token) -> float | None:
    """The finite or non-finite float that token spells, None if it spells none (Python's 1_000 is not a BVH number)."""
    try:
        return None if "_" in token else float(token)
    except ValueError:
        return None


@dataclass
class _Node:
    """A joint or an End Site while it is being read."""

    label: str  # for messages
    name: str  # an End Site has its joint's
    index: int  # among the joints
    parent: int
    site: bool = False
    offset: np.ndarray | None = None
    channels: tuple[str, ...] | None = None


def _parse_hierarchy(path, text, end):
    """The HIERARCHY section -> names, parents, offsets, end_sites, channels. An explicit stack: any depth will do."""
    rows = enumerate(text.split("\n"), 1)  # braces are words of their own, even when glued to a name
    words = [(word, line) for line, row in rows for word in re.findall(r"[{}]|[^\s{}]+", row, re.ASCII)]
    words.append((None, words[-1][1]))
    at = 1  # past HIERARCHY

    def take(expected):
        nonlocal at
        if words[at][0] is None:
            _fail(path, f"the hierarchy stops at {end}; expected {expected}", words[at][1])
        at += 1
        return words[at - 1]

    def take_name(keyword, line):  # the rest of the line (a name may hold spaces), then '{'
        first = at
        while words[at][1] == line and words[at][0] not in (None, "{", "}"):
            take("")
        name = " ".join(word for word, _ in words[first:at])
        if not name and keyword != "End":
            _fail(path, f"{keyword} without a name; expected '{keyword} NAME'", line)
        brace, line = take(f"'{{' after {keyword} {_show(name)}")
        if brace != "{":
            _fail(path, f"found {_show(brace)} after {keyword} {_show(name)}; expected '{{'", line)
        return name

    def take_offset(label):
        taken = [take(f"three numbers after OFFSET of {label}") for _ in range(3)]
        xyz = [_number(word) for word, _ in taken]
        for value, (word, line) in zip(xyz, taken):
            if value is None or not abs(value) <= LIMIT:
                valid = f"three finite numbers of at most {LIMIT:g}"
                _fail(path, f"OFFSET of {label} has {_show(word)}; expected {valid}", line)
        return np.array(xyz)

    def take_channels(label):
        count, line = take(f"a channel count after CHANNELS of {label}")
        if count not in set("0123456"):
            _fail(path, f"CHANNELS of {label} has count {_show(count)}; expected 0 to 6", line)
        found = []
        for _ in range(int(count)):
            word, line = take(f"{count} channel names for {label}")
            channel = _CHANNEL.get(word.lower())
            if channel is None and word.upper() in _KEYWORDS:
                _fail(
                    path,
                    f"{label} lists {len(found)} channels; its CHANNELS count says {count}, expected as many",
                    line,
                )
            if channel is None:
                _fail(path, f"unknown channel {_show(word)} on {label}; valid: {', '.join(CHANNELS)}", line)
            if channel in found:
                _fail(path, f"channel {channel} twice on {label}; expected each at most once", line)
            found.append(channel)
        return tuple(found)

    joints, end_sites, lines, stack = [], {}, {}, []
    while stack or words[at][0] is not None:
        top = stack[-1] if stack else None
        word, line = take(f"'}}' to close {top.label} (unbalanced braces or truncated file)" if top else "ROOT NAME")
        keyword = word.upper()
        if keyword == ("JOINT" if top else "ROOT") and not (top and top.site):
            name = take_name(keyword, line)
            if not top and joints:
                _fail(path, f"a second ROOT {_show(name)} after {_show(joints[0].name)}; expected one per file", line)
            if name in lines:
                _fail(path, f"joint {_show(name)} again (first on line {lines[name]}); expected unique names", line)
            lines[name] = line
            stack.append(_Node(f"joint {_show(name)}", name, len(joints), top.index if top else -1))
            joints.append(stack[-1])
        elif not top:
            valid = "MOTION" if joints else "ROOT NAME"
            _fail(path, f"found {_show(word)} outside every joint; expected {valid}", line)
        elif keyword == "OFFSET" and top.offset is None:
            top.offset = take_offset(top.label)
        elif keyword == "CHANNELS" and top.channels is None and not top.site:
            top.channels = take_channels(top.label)
        elif keyword == "END" and not top.site:
            take_name("End", line)
            stack.append(_Node(f"the End Site of {top.label}", top.name, top.index, top.index, site=True))
        elif word == "}":
            if top.offset is None:
                _fail(path, f"{top.label} has no OFFSET; expected 'OFFSET x y z'", line)
            if top.channels is None and not top.site:
                _fail(path, f"{top.label} has no CHANNELS; expected 'CHANNELS n NAME...' (n = 0 if it is fixed)", line)
            if top.site:
                end_sites[top.name] = max(end_sites.get(top.name, top.offset), top.offset, key=np.linalg.norm)
            stack.pop()
        else:
            valid = "one OFFSET, '}'" if top.site else "one OFFSET, one CHANNELS, JOINT NAME, End Site, '}'"
            _fail(path, f"found {_show(word)} in {top.label}; expected {valid}", line)
    if not joints:
        _fail(path, f"the hierarchy stops at {end}; expected ROOT NAME", words[-1][1])
    if not any(joint.channels for joint in joints):
        _fail(path, "no joint has a channel, so nothing can move; expected at least one channel")
    names, parents, offsets, channels = zip(*((j.name, j.parent, j.offset, j.channels) for j in joints))
    return names, np.array(parents), np.array(offsets), end_sites, channels


def _parse_motion_header(path, data, start, told=None):
    """`Frames: N` and `Frame Time: s` from byte start on -> frames, frame_time, the byte where the values begin."""
    found = re.compile(rb"\s*Frames\s*:\s*(\S*)", re.I).match(data, start)
    if not found:
        _fail(path, "no 'Frames: N' after MOTION; expected it there", _line(data, start))
    word, line = found[1], _line(data, found.start(1))
    if not re.fullmatch(rb"\+?0*[1-9][0-9]{0,17}", word):
        _fail(path, f"Frames: {_show(word)}; expected a whole number of at least 1", line)
    time = re.compile(rb"\s*Frame[ \t]*Time\s*:\s*(\S*)", re.I).match(data, found.end())
    if not time:
        _fail(path, "no 'Frame Time: SECONDS' after Frames; expected it there", line)
    frame_time = told or _number(time[1].decode("latin-1"))
    least, most = FRAME_TIMES
    if frame_time is None or not least <= frame_time <= most:
        valid = f"a positive number of seconds, {least:g} to {most:g}{_meant(frame_time)}"
        _fail(path, f"Frame Time: {_show(time[1])}; expected {valid}", _line(data, time.start(1)))
    return int(word), frame_time, time.end()


def _meant(frame_time) -> str:
    """What a frame time of 33.3 or 120 was meant to be."""
    if frame_time is None or not 1.0 < frame_time <= 1000.0:
        return ""
    if float(frame_time).is_integer() and frame_time >= 24:
        return f"; a rate? then --rate {frame_time:g}"
    return f"; milliseconds? then --rate {1000.0 / frame_time:.3g}"


def _parse_values(path, data, start, frames, names, channels):
    """The numbers from byte start on -> (frames, C) float64. Memory follows the file's size, not what Frames claims."""
    columns = [(name, channel) for name, listed in zip(names, channels) for channel in listed]
    words = data[start:].split()
    try:
        if b"_" in data[start:]:
            raise ValueError
        values = np.fromiter(map(float, words), np.float64, len(words))
    except ValueError:
        bad = next(i for i, w in enumerate(words) if _number(w.decode("latin-1")) is None)
        _fail(
            path,
            f"{_show(words[bad])} is not a number ({_cell(bad, columns)}); expected one",
            _line_of_value(data, start, bad),
        )
    if len(values) != frames * len(columns):
        expected = f"{frames * len(columns)} ({frames} frames x {len(columns)} channels)"
        short = len(values) < frames * len(columns)
        where = f"stop before {_cell(len(values), columns)}" if short else f"go on after the last frame, {frames - 1}"
        rows = enumerate(map(len, map(bytes.split, data[start:].split(b"\n"))), _line(data, start))
        odd = next((f"; line {n} has {found}" for n, found in rows if found not in (0, len(columns))), "")
        _fail(path, f"found {len(values)} values, expected {expected}; they {where}{odd}")
    fits = np.abs(values) <= LIMIT
    if not fits.all():
        bad = int(np.argmin(fits))
        message = f"{_show(words[bad])} in {_cell(bad, columns)}; expected finite numbers of at most {LIMIT:g}"
        _fail(path, message, _line_of_value(data, start, bad))
    return values.reshape(frames, len(columns))


def _cell(index, columns) -> str:
    name, channel = columns[index % len(columns)]
    return f"frame {index // len(columns)} (from 0), {channel} of {_show(name)}"


def _line_of_value(data, start, index) -> int:
    """The line that holds the index-th number after byte start."""
    line = _line(data, start)
    for row in data[start:].split(b"\n"):
        index -= len(row.split())
        if index < 0:
            return line
        line += 1
    return line


# ---------------------------------------------------------------- poses


def local(bvh: Bvh, root_offset="replace"):
    r"""Each joint's transform relative to its parent.

    Equation  [BVH] x_parent = p_j + R_j x_j, R_j = R_a1(angle 1) R_a2(angle 2) R_a3(angle 3) in channel order
    Symbols   p_j -> positions, R_j -> rotations
    Args      bvh : Bvh
              root_offset : "replace": the root's position channels are p_root; "add": they are added to its OFFSET.
                            Other joints' position channels always replace
    Returns   positions : (T, J, 3) float64 [file units], in the parent's frame
              rotations : (T, J, 4) float64 unit quaternions w, x, y, z, child -> parent; no sign jumps along T
    Raises    ValueError: root_offset is neither "replace" nor "add"
    Test      tests/mocap/test_bvh.py::test_real_files_against_scipy, ::test_rotation_orders,
              ::test_positions_replace_offset
    """
    if root_offset not in ("replace", "add"):
        raise ValueError(f"root_offset {root_offset!r}; valid: 'replace', 'add'")
    T, J = len(bvh.values), len(bvh.names)
    positions = np.tile(bvh.offsets, (T, 1, 1))
    by_order = {}  # rotation axes, e.g. (2, 0, 1) -> joints, first rotation column of each
    column = 0
    for j, listed in enumerate(bvh.channels):
        axes, columns = [], []
        for channel in listed:
            axis = "XYZ".index(channel[0])
            if channel[1:] == "rotation":
                axes.append(axis)
                columns.append(column)
            else:
                base = bvh.offsets[j, axis] if j == 0 and root_offset == "add" else 0.0
                positions[:, j, axis] = bvh.values[:, column] + base
            column += 1
        by_order.setdefault(tuple(axes), []).append((j, columns))

    rotations = np.zeros((T, J, 4))
    rotations[..., 0] = 1.0
    for axes, joints in by_order.items():
        if not axes:
            continue
        half = np.deg2rad(bvh.values[:, [columns for _, columns in joints]]) / 2  # (T, joints, axes)
        cos, sin = np.cos(half), np.sin(half)
        q = [np.ones(half.shape[:2])] + [np.zeros(half.shape[:2])] * 3
        for k, axis in enumerate(axes):
            q = _turn(q, axis, cos[..., k], sin[..., k])
        rotations[:, [j for j, _ in joints]] = np.stack(q, axis=-1)
    return positions, continuous(rotations)


def global_pose(bvh: Bvh, root_offset="replace"):
    r"""Forward kinematics: every joint's transform in the file's world frame (file units, file axes).

    Equation  [BVH] R_j^world = R_parent^world R_j,  p_j^world = p_parent^world + R_parent^world p_j
    Args      bvh : Bvh
              root_offset : as in `local`
    Returns   positions : (T, J, 3) float64 [file units]
              rotations : (T, J, 4) float64 unit quaternions w, x, y, z, joint -> world; no sign jumps along T
    Raises    ValueError: root_offset is neither "replace" nor "add"
    Test      tests/mocap/test_bvh.py::test_real_files_against_scipy
    """
    positions, rotations = local(bvh, root_offset)
    for j, parent in enumerate(bvh.parents):  # parents come first, so theirs are world transforms already
        if parent >= 0:
            positions[:, j] = positions[:, parent] + _rotate(rotations[:, parent], positions[:, j])
            rotations[:, j] = _multiply(rotations[:, parent], rotations[:, j])
    return positions, continuous(rotations)


def continuous(q):
    """Quaternions (T, ..., 4) with signs chosen so that consecutive frames agree; the first frame has w >= 0."""
    sign = np.empty(q.shape[:-1])
    sign[0] = np.where(q[0, ..., 0] < 0, -1.0, 1.0)
    sign[1:] = np.where(np.einsum("...i,...i->...", q[1:], q[:-1]) < 0, -1.0, 1.0)
    return q * np.cumprod(sign, axis=0)[..., None]


def _turn(q, axis, cos, sin):
    """q (four arrays w, x, y, z) times the rotation about one coordinate axis whose half angle has this cos and sin."""
    a, b, c = 1 + axis, 1 + (axis + 1) % 3, 1 + (axis + 2) % 3
    out = [None] * 4
    out[0] = q[0] * cos - q[a] * sin
    out[a] = q[a] * cos + q[0] * sin
    out[b] = q[b] * cos + q[c] * sin
    out[c] = q[c] * cos - q[b] * sin
    return out


def _multiply(p, q):
    """Quaternion product p q, (..., 4) each."""
    a, b, c, d = np.moveaxis(p, -1, 0)
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def _rotate(q, v):
    """Vectors v (..., 3) turned by unit quaternions q (..., 4): v + 2 w (u x v) + 2 u x (u x v), u the vector part."""
    w, a, b, c = np.moveaxis(q, -1, 0)
    x, y, z = np.moveaxis(v, -1, 0)
    i, j, k = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    return np.stack([x + w * i + b * k - c * j, y + w * j + c * i - a * k, z + w * k + a * j - b * i], axis=-1)


# ---------------------------------------------------------------- writing


def write(
    path, names, parents, offsets, frame_time, root_positions, rotations, end_sites=None, order="ZXY", moving=None
):  # fmt: skip
    """Write local transforms as a BVH: six channels on the root, three rotations on every other joint.

    Format    positions replace the root's OFFSET; give the root a zero OFFSET and readers that add it agree too. Joints
              are written depth first, so a reader's joint order is that of `names` only if it is depth first as well.
              Leaves without an entry in end_sites get an End Site at zero, which importers want. Nine decimals
    Args      path : str or path-like; written under a temporary name and renamed
              names : J unique names without whitespace or braces
              parents : (J,) int, -1 for joint 0 (the only root), otherwise an earlier joint
              offsets : (J, 3) [length unit of your choice]
              frame_time : [s], positive
              root_positions : (T, 3) [same unit]
              rotations : (T, J, 4) quaternions w, x, y, z, child -> parent, any length but zero
              end_sites : joint name -> (3,) offset, or None
              order : axes of the rotation channels, a permutation of "XYZ", applied as in the module's docstring
              moving : joint name -> (T, 3) positions in the parent, of joints that have six channels like the root
    Raises    BvhError: a shape, a name, a parent, a value or the order does not fit; nothing is written
    Test      tests/mocap/test_bvh.py::test_round_trip, ::test_joints_that_move
    """
    path, names, end_sites, moving = os.fspath(path), list(names), dict(end_sites or {}), dict(moving or {})
    parents, rotations = np.asarray(parents), np.asarray(rotations, np.float64)
    J, T = len(names), len(rotations)
    _check_writable(path, names, parents, frame_time, rotations, end_sites, order, moving)
    root_positions = _checked(path, "root_positions", root_positions, (T, 3))
    offsets = _checked(path, "offsets", offsets, (J, 3))
    end_sites = {name: _checked(path, f"the End Site of {_show(name)}", v, (3,)) for name, v in end_sites.items()}
    moving = {name: _checked(path, f"positions of {_show(name)}", v, (T, 3)) for name, v in moving.items()}
    moving[names[0]] = root_positions

    children = [[] for _ in names]
    for j in range(1, J):
        children[parents[j]].append(j)
    rotation_channels = " ".join(axis + "rotation" for axis in order)
    lines, depth_first = ["HIERARCHY"], []
    stack = [(0, 0)]  # (joint, depth) to open, (None, depth) to close
    while stack:
        j, depth = stack.pop()
        tab = "\t" * min(depth, _INDENT_LIMIT)
        if j is None:
            lines.append(tab + "}")
            continue
        depth_first.append(j)
        channels = ("Xposition Yposition Zposition " if names[j] in moving else "") + rotation_channels
        lines += [f"{tab}{'JOINT' if j else 'ROOT'} {names[j]}", tab + "{", f"{tab}\tOFFSET {_row(offsets[j])}"]
        lines.append(f"{tab}\tCHANNELS {len(channels.split())} {channels}")
        if names[j] in end_sites or not children[j]:
            site = end_sites.get(names[j], np.zeros(3))
            lines += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {_row(site)}", f"{tab}\t}}"]
        stack.append((None, depth))
        stack += [(child, depth + 1) for child in reversed(children[j])]

    angles = _euler_degrees(rotations[:, depth_first], order)
    columns = []
    for k, j in enumerate(depth_first):
        columns += [moving[names[j]]] if names[j] in moving else []
        columns.append(angles[:, k])
    rows = np.concatenate(columns, axis=1)
    lines += ["MOTION", f"Frames: {T}", f"Frame Time: {float(frame_time)!r}"]
    lines += [_row(row) for row in rows]
    temporary = f"{path}.{os.getpid()}.tmp"
    try:
        with open(temporary, "w", encoding="utf-8", newline="\n") as f:
            f.write("\n".join(lines) + "\n")
        os.replace(temporary, path)
    finally:
        if os.path.exists(temporary):
            os.remove(temporary)


def _row(values) -> str:
    """Nine decimals each; what would print as minus zero prints as zero."""
    return " ".join(["%.9f"] * len(values)) % tuple(np.where(np.abs(values) < 5e-10, 0.0, values))


def _checked(path, what, value, shape):
    value = np.asarray(value, np.float64)
    if value.shape != shape:
        _fail(path, f"{what} has shape {value.shape}; expected {shape}")
    fits = np.abs(value) <= LIMIT
    if not fits.all():
        where = np.argwhere(~fits)[0].tolist()
        _fail(path, f"{what} is {value[tuple(where)]} at {where}; expected finite numbers of at most {LIMIT:g}")
    return value


def _check_writable(path, names, parents, frame_time, rotations, end_sites, order, moving):
    J, T = len(names), len(rotations)
    for j, name in enumerate(names):
        if not isinstance(name, str) or not re.fullmatch(r"[^\s{}]+", name):
            _fail(path, f"joint name {name!r}; expected text without whitespace or braces")
        if name in names[:j]:
            _fail(path, f"joint {name!r} twice; expected unique names")
    tree = J and parents.shape == (J,) and parents.dtype.kind in "iu" and parents[0] == -1
    if not tree or any(not 0 <= parents[j] < j for j in range(1, J)):
        _fail(path, f"parents {parents.tolist()} of {J} joints; expected -1, then integer indices of earlier joints")
    least, most = FRAME_TIMES
    if not least <= frame_time <= most:
        _fail(path, f"frame time {frame_time}; expected a positive number of seconds, {least:g} to {most:g}")
    if not T:
        _fail(path, "rotations has zero frames; expected at least 1")
    _checked(path, "rotations", rotations, (T, J, 4))
    zero = np.argwhere(np.linalg.norm(rotations, axis=-1) < 1e-9)
    if len(zero):
        _fail(path, f"zero quaternion at frame {zero[0, 0]}, joint {names[zero[0, 1]]!r}; expected a unit quaternion")
    if sorted(order) != list("XYZ"):
        _fail(path, f"order {order!r}; expected a permutation of 'XYZ'")
    for what, given in (("End Site", end_sites), ("positions", moving)):
        unknown = [name for name in given if name not in names]
        if unknown:
            _fail(path, f"{what} for {unknown[0]!r}, which is no joint; valid: {listed(names)}")


def _euler_degrees(q, order):
    """(T, J, 4) quaternions -> (T, J, 3) intrinsic angles in degrees, without 360-degree jumps along T."""
    T, J = q.shape[:2]
    rotation = Rotation.from_quat(q.reshape(-1, 4), scalar_first=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock")  # the third angle is zero then, and the rotation still exact
        angles = rotation.as_euler(order, degrees=True)
    return np.unwrap(angles.reshape(T, J, 3), period=360, axis=0)

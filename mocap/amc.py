r"""Acclaim motion-capture files: skeleton (ASF), motion (AMC), forward kinematics. Nothing here knows about humans.

An ASF file describes the skeleton in its zero pose: `:units`, `:root`, `:bonedata` (one `begin` ... `end` block a bone)
and `:hierarchy` (a bone, then its children). An AMC file holds frames: a number on a line of its own, then one line a
bone with a value for each of its degrees of freedom. There is no standard beyond Acclaim's own text; these are the
readings taken here:

- A bone is a joint and the rod behind it. It starts where its parent ends; the root is a point.
- `direction` (a unit vector) and `length` give the rod in the zero pose, in the file's world axes; every bone's
  rotation is the identity there. They are rotations of the world's axes, not of the parent's.
- `axis a b c XYZ` is the frame C in which the bone's degrees of freedom turn: about x first, then y, then z, each about
  the world's axes, C = Rz(c) Ry(b) Rx(a) acting on column vectors; SciPy's lower-case "xyz". The three numbers belong
  to the letters in their order.
- `dof rx ry rz` turn in the listed order about the axes of C: M = Rz Ry Rx. A bone without `dof` is fixed.
- So, down the hierarchy,  R = R_parent C M C⁻¹,  start = end_parent,  end = start + R · direction · length.
- The root's `order` lists its values; its C is its `orientation` in `axis` order; it lies at `position` + (TX, TY, TZ).
- Lengths and axes are the file's own: one length unit is 1 / (`length` of `:units`) inches in CMU's files. Angles are
  radians once read, whatever the files say: `angle` of `:units` holds for the ASF, `:DEGREES` for the AMC.
- A file gives no frame rate.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from mocap.bvh import continuous, listed
from plumbing.files import open_regular

ROOT = "root"
LIMIT = 1e9  # no length, angle or number of a motion is larger, no unit smaller than its inverse; keeps poses finite
_SECTIONS = (":version", ":name", ":units", ":documentation", ":root", ":bonedata", ":hierarchy", ":skin")
_NEEDED = (":units", ":root", ":bonedata", ":hierarchy")
_KEYS = ("id", "name", "direction", "length", "axis", "dof", "limits", "bodymass", "cofmass")
_TURNS, _MOVES = ("rx", "ry", "rz"), ("tx", "ty", "tz")


class AmcError(ValueError):
    """A malformed ASF or AMC: one line naming the file, the line or bone, and what would be valid."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """One ASF: J bones, the root among them; file units, file axes, radians."""

    names: tuple[str, ...]  # (J,) unique, depth first: a parent always precedes its children; the root is "root"
    parents: np.ndarray  # (J,) int, -1 for the root, which is bone 0
    directions: np.ndarray  # (J, 3) float64, of length 1 (0: the root, or a bone without length)
    lengths: np.ndarray  # (J,) float64
    axes: np.ndarray  # (J, 3) float64 [rad], the numbers of `axis`; the root's: its `orientation`
    axis_orders: tuple[str, ...]  # (J,) the letters of `axis`, lower case: "xyz"
    dofs: tuple[tuple[str, ...], ...]  # (J,) "rx", "ry", "rz" in the order of the values, the root's also "tx", ...
    limits: tuple[np.ndarray | None, ...]  # (J,) (number of dofs, 2) [rad] each, or None
    position: np.ndarray  # (3,) float64 of the root
    mass: float  # of :units
    length: float  # of :units
    degrees: bool  # the ASF's angles were degrees
    path: str

    @property
    def columns(self) -> list:
        """(bone, dof) of every value of a frame."""
        return [(name, dof) for name, dofs in zip(self.names, self.dofs) for dof in dofs]


# ---------------------------------------------------------------- what both files share


def _fail(path, message, line=None) -> NoReturn:
    raise AmcError(f"{path}{'' if line is None else f', line {line}'}: {message}") from None


def _show(word) -> str:
    """A word for an error message: quoted, on one line, cut to 40 characters."""
    word = word.decode("utf-8", "replace") if isinstance(word, bytes) else word
    return repr(word if len(word) <= 40 else word[:37] + "...")


def _plain(name) -> str:
    """A bone's name for an error message: as `_show`, without quotes."""
    return _show(name)[1:-1]


def _number(word) -> float:
    """The float that a word spells, NaN if none (Python's 1_000 is no number here)."""
    try:
        return np.nan if "_" in word else float(word)
    except ValueError:
        return np.nan


def _text(path, what) -> str:
    """A file's text with comments taken out, lines kept."""
    with open_regular(path) as f:
        data = f.read()
    if not data.strip():
        _fail(path, f"the file is empty; expected {what}")
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        _fail(path, "UTF-16 text; expected ASCII, UTF-8 or Latin-1 (save it again in that encoding)")
    if b"\0" in data:
        _fail(path, f"binary data (zero at byte {data.index(0)}); expected {what}")
    try:
        text = data.removeprefix(b"\xef\xbb\xbf").decode("utf-8")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # old files have umlauts in comments and in :documentation
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return re.sub(r"#.*", "", text) if "#" in text else text


# ---------------------------------------------------------------- the skeleton


def read_asf(path) -> Skeleton:
    """Read one ASF file.

    Format    sections in any order, keywords in any case; any line endings, tabs, blank lines, `#` comments; the limits
              on one line or several, infinite ones included.  `:documentation`, `:skin` and masses are passed over
    Args      path : str or path-like
    Returns   Skeleton
    Raises    AmcError: the file is malformed (one line: file, line or bone, and what would have been valid)
              OSError: the file cannot be opened
    Test      tests/mocap/test_amc.py::test_read_asf, ::test_malformed_asf,
              tests/robustness/test_damaged.py::test_asf_and_amc
    """
    path = os.fspath(path)
    sections, name = {}, None
    for line, row in enumerate(_text(path, "an ASF, which has :units, :root, :bonedata, :hierarchy").split("\n"), 1):
        words = row.split()
        if not words:
            continue
        if words[0].startswith(":"):
            name = words[0].lower()
            if name not in _SECTIONS:
                _fail(path, f"unknown section {_show(words[0])}; valid: {', '.join(_SECTIONS)}", line)
            if name in sections:
                _fail(path, f"section {name} again; expected one", line)
            sections[name] = [(line, [name])]
        elif name is None:
            _fail(path, f"not an ASF: starts with {_show(words[0])}, expected a section such as :version", line)
        else:
            sections[name].append((line, words))
    for name in _NEEDED:
        if name not in sections:
            _fail(path, f"no {name} section; expected {', '.join(_NEEDED)} (a truncated file?)")

    mass, length, degrees = _parse_units(path, sections[":units"])
    unit = np.pi / 180 if degrees else 1.0
    root, position = _parse_root(path, sections[":root"], unit)
    bones = {ROOT: root, **_parse_bones(path, sections[":bonedata"], unit)}
    names, parents = _parse_hierarchy(path, sections[":hierarchy"], bones)
    of = [bones[n] for n in names]
    return Skeleton(
        names, parents, np.array([b.direction for b in of]), np.array([b.length for b in of]),
        np.array([b.axis for b in of]), tuple(b.order for b in of), tuple(b.dofs for b in of),
        tuple(b.limits for b in of), position, mass, length, degrees, path,
    )  # fmt: skip


@dataclass
class _Bone:
    """One bone while it is being read."""

    direction: np.ndarray
    length: float
    axis: np.ndarray
    order: str
    dofs: tuple
    limits: np.ndarray | None


def _numbers(path, line, label, words, count):
    """count finite numbers out of words."""
    values = np.array([_number(w) for w in words])
    if len(words) != count or not np.all(np.abs(values) <= LIMIT):
        some = "one number" if count == 1 else f"{count} numbers"
        _fail(path, f"{label} is {_show(' '.join(words))}; expected {some} of at most {LIMIT:g}", line)
    return values


def _axis_order(path, line, label, words):
    word = "".join(words).lower()
    if sorted(word) != list("xyz"):
        _fail(path, f"{label} has the order {_show(word)}; expected a permutation of XYZ", line)
    return word


def _entries(path, rows, label, valid):
    """Rows `key value ...` -> {key: (line, values)}, each key at most once; rows that open with "(" go on the last."""
    found = {}
    key = None
    for line, words in rows:
        if words[0].startswith("(") and key == "limits":
            found[key][1].extend(words)
            continue
        key = words[0].lower()
        if key not in valid:
            _fail(path, f"found {_show(words[0])} in {label}; valid: {', '.join(valid)}", line)
        if key in found:
            _fail(path, f"{key} of {label} again (first on line {found[key][0]}); expected one", line)
        found[key] = (line, words[1:])
    return found


def _parse_units(path, rows):
    found = _entries(path, rows[1:], ":units", ("mass", "length", "angle"))
    values = {}
    for key in ("mass", "length"):
        line, words = found.get(key, (rows[0][0], ["1"]))
        values[key] = float(_numbers(path, line, f"{key} of :units", words, 1)[0])
        if values[key] < 1.0 / LIMIT:
            valid = f"a positive number of at least {1.0 / LIMIT:g}"
            _fail(path, f"{key} of :units is {values[key]:g}; expected {valid}", line)
    line, words = found.get("angle", (rows[0][0], []))
    angle = " ".join(words).lower()
    angle = {"degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad"}.get(angle, angle)
    if angle not in ("deg", "rad"):
        _fail(path, f"angle of :units is {_show(angle)}; expected deg or rad", line)
    return values["mass"], values["length"], angle == "deg"


def _parse_root(path, rows, unit):
    found, at = _entries(path, rows[1:], ":root", ("order", "axis", "position", "orientation")), rows[0][0]
    line, words = found.get("order", (at, []))
    dofs = tuple(w.lower() for w in words)
    if not dofs or len(set(dofs)) != len(dofs) or not set(dofs) <= {*_TURNS, *_MOVES}:
        valid = "each at most once of TX TY TZ RX RY RZ"
        _fail(path, f"order of :root is {_show(' '.join(words))}; expected {valid}", line)
    order = _axis_order(path, *_labelled(found, "axis", at, ["XYZ"]))
    position = _numbers(path, *_labelled(found, "position", at, ["0"] * 3), 3)
    orientation = _numbers(path, *_labelled(found, "orientation", at, ["0"] * 3), 3)
    return _Bone(np.zeros(3), 0.0, orientation * unit, order, dofs, None), position


def _labelled(found, key, at, default):
    line, words = found.get(key, (at, default))
    return line, f"{key} of :root", words


def _parse_bones(path, rows, unit):
    """:bonedata -> {name: _Bone}."""
    bones, block, begin = {}, None, rows[0][0]
    for line, words in rows[1:]:
        word = words[0].lower()
        if block is None and word == "begin":
            block, begin = [], line
        elif block is None:
            _fail(path, f"found {_show(words[0])} between two bones; expected begin", line)
        elif word == "begin":
            _fail(path, f"begin in the bone that begins on line {begin}; expected end first", line)
        elif word == "end":
            name, bone = _parse_bone(path, block, begin, unit)
            if name in bones or name == ROOT:
                _fail(path, f"bone {_show(name)} again; expected unique names other than {ROOT}", begin)
            bones[name], block = bone, None
        else:
            block.append((line, words))
    if block is not None:
        _fail(path, "this bone has no end (a truncated file?); expected end", begin)
    if not bones:
        _fail(path, ":bonedata holds no bone; expected begin ... end", begin)
    return bones


def _parse_bone(path, block, begin, unit):
    found = _entries(path, block, f"the bone that begins on line {begin}", _KEYS)
    line, words = found.get("name", (begin, []))
    if len(words) != 1 or words[0].isdecimal() or words[0].startswith((":", "(")):
        _fail(path, f"name of a bone is {_show(' '.join(words))}; expected one word that is no number", line)
    name = words[0]
    label = f"bone {_show(name)}"
    for key in ("direction", "length", "axis"):
        if key not in found:
            _fail(path, f"{label} has no {key}; expected direction, length and axis", begin)
    line, words = found["direction"]
    direction = _numbers(path, line, f"direction of {label}", words, 3)
    line, words = found["length"]
    length = float(_numbers(path, line, f"length of {label}", words, 1)[0])
    if length < 0:
        _fail(path, f"length of {label} is {length:g}; expected a number of at least 0", line)
    norm = np.linalg.norm(direction)
    if length and not 0.99 < norm < 1.01:
        _fail(path, f"direction of {label} has length {norm:.3g}; expected a unit vector", found["direction"][0])
    line, words = found["axis"]
    axis = _numbers(path, line, f"axis of {label}", words[:3], 3) * unit
    order = _axis_order(path, line, f"axis of {label}", words[3:])
    line, words = found.get("dof", (begin, []))
    dofs = tuple(w.lower() for w in words)
    if len(set(dofs)) != len(dofs) or not set(dofs) <= set(_TURNS):
        _fail(path, f"dof of {label} is {_show(' '.join(words))}; expected each at most once of rx ry rz", line)
    line, words = found.get("limits", (begin, None))
    limits = None
    if words is not None:
        bounds = [_number(w) for w in re.findall(r"[^\s()]+", " ".join(words))]
        if len(bounds) != 2 * len(dofs) or np.isnan(bounds).any():
            _fail(path, f"limits of {label} are {_show(' '.join(words))}; expected (low high) for each dof", line)
        limits = np.reshape(bounds, (len(dofs), 2)) * unit
    return name, _Bone(direction / norm if norm else direction, length, axis, order, dofs, limits)


def _parse_hierarchy(path, rows, bones):
    """:hierarchy -> names, depth first, and parents. An explicit stack: any depth will do."""
    children, parent_of, state = {name: [] for name in bones}, {}, "before"
    for line, words in rows[1:]:
        word = words[0].lower()
        if word == "begin" and state == "before":
            state = "in"
        elif word == "end" and state == "in":
            state = "after"
        elif state != "in":
            _fail(path, f"found {_show(words[0])} in :hierarchy; expected begin, bones with their children, end", line)
        else:
            for name in words:
                if name not in bones:
                    _fail(path, f"unknown bone {_show(name)} in :hierarchy; valid: {listed(bones)}", line)
            for child in words[1:]:
                if child == ROOT or child in parent_of:
                    if child == ROOT:
                        _fail(path, f"{ROOT} is a child of {_plain(words[0])}; expected none", line)
                    both = f"{_plain(words[0])} and of {_plain(parent_of[child])}"
                    _fail(path, f"{_plain(child)} is a child of {both}; expected one parent", line)
                parent_of[child] = words[0]
                children[words[0]].append(child)
    if state != "after":
        _fail(path, ":hierarchy has no end (a truncated file?); expected begin ... end", rows[-1][0])
    names, parents, stack = [], [], [(ROOT, -1)]
    while stack:
        name, parent = stack.pop()
        stack += [(child, len(names)) for child in reversed(children[name])]
        names.append(name)
        parents.append(parent)
    if len(names) < len(bones):
        reached = set(names)
        lost = next(n for n in bones if n not in reached)
        why = f"its parents form a cycle without {ROOT}" if lost in parent_of else "it has no parent"
        _fail(path, f"bone {_show(lost)} does not hang on {ROOT}: {why}; expected a tree below {ROOT}", rows[0][0])
    return tuple(names), np.array(parents)


# ---------------------------------------------------------------- the motion


def read_amc(path, skeleton: Skeleton) -> np.ndarray:
    """Read one AMC file of a skeleton.

    Format    `:FULLY-SPECIFIED`, `:DEGREES` or `:RADIANS` (without either: the ASF's unit); frames numbered without
              gaps, from any number on; in each every bone that has degrees of freedom, in any order
    Args      path : str or path-like
              skeleton : of the ASF that belongs to it
    Returns   (T, C) float64, the values of `skeleton.columns`: [file units] and [rad]
    Raises    AmcError: the file is malformed or of another skeleton (one line: file, line, bone, what would be valid)
              OSError: the file cannot be opened
    Test      tests/mocap/test_amc.py::test_read_amc, ::test_malformed_amc,
              tests/robustness/test_damaged.py::test_asf_and_amc
    """
    path = os.fspath(path)
    rows = _text(path, "an AMC, which has frame numbers and a line for each bone").split("\n")
    # A frame has a place for each bone that moves, and so takes no more room than its lines.
    moving = [name for name, dofs in zip(skeleton.names, skeleton.dofs) if dofs]
    slots, dofs_of = {name: k for k, name in enumerate(moving)}, dict(zip(skeleton.names, skeleton.dofs))
    frames, frame, number, degrees = [], None, None, None
    for line, row in enumerate(rows, 1):
        words = row.split()
        if not words:
            continue
        head = words[0]
        if head in dofs_of and frame is not None:
            dofs = dofs_of[head]
            if len(words) != len(dofs) + 1:
                valid = f"{len(dofs)} ({' '.join(dofs)})" if dofs else "none"
                _fail(path, f"{_plain(head)} has {len(words) - 1} values in frame {number}; expected {valid}", line)
            if not dofs:
                continue
            if frame[slots[head]]:
                _fail(path, f"{_plain(head)} again in frame {number}; expected each bone once", line)
            frame[slots[head]] = words[1:]
        elif head.isdecimal() and len(words) == 1 and len(head) < 19:
            if frame is not None:
                _check_whole(path, frame, number, moving, line)
                if int(head) != number + 1:
                    _fail(path, f"frame {head} after frame {number}; expected {number + 1}", line)
            number, frame = int(head), [None] * len(moving)
            frames.append(frame)
        elif head.startswith(":") and frame is None:
            degrees = _parse_keyword(path, head, degrees, line)
        else:
            valid = f"a frame number or a bone of {skeleton.path}: {listed(skeleton.names)}"
            if frame is None:
                valid = ":FULLY-SPECIFIED, :DEGREES, :RADIANS or the first frame's number"
            _fail(path, f"found {_show(head)}; expected {valid}", line)
    if frame is None:
        _fail(path, "holds no frame; expected at least one (a truncated file?)")
    _check_whole(path, frame, number, moving, len(rows))

    flat = [word for frame in frames for words in frame for word in words]
    columns = skeleton.columns
    try:
        if any("_" in word for word in flat):
            raise ValueError
        values = np.fromiter(map(float, flat), np.float64, len(flat))
    except ValueError:
        values = np.array([_number(word) for word in flat])
    if not (np.abs(values) <= LIMIT).all():
        bad = int(np.argmin(np.abs(values) <= LIMIT))
        (bone, dof), at = columns[bad % len(columns)], number - len(frames) + 1 + bad // len(columns)
        line = _line_of(rows, at, bone)
        _fail(
            path,
            f"{dof} of {_plain(bone)} is {_show(flat[bad])} in frame {at}; expected a number of at most {LIMIT:g}",
            line,
        )
    values = values.reshape(len(frames), len(columns))
    if skeleton.degrees if degrees is None else degrees:
        values[:, [dof in _TURNS for _, dof in columns]] *= np.pi / 180
    return values


def _parse_keyword(path, word, degrees, line):
    """True after :DEGREES, False after :RADIANS, unchanged after :FULLY-SPECIFIED."""
    keyword = word.upper()
    if keyword == ":FULLY-SPECIFIED":
        return degrees
    if keyword not in (":DEGREES", ":RADIANS"):
        _fail(path, f"unknown keyword {_show(word)}; valid: :FULLY-SPECIFIED, :DEGREES, :RADIANS", line)
    if degrees not in (None, keyword == ":DEGREES"):
        _fail(path, ":DEGREES and :RADIANS; expected one of them", line)
    return keyword == ":DEGREES"


def _check_whole(path, frame, number, moving, line):
    if None in frame:
        missing = _plain(moving[frame.index(None)])
        _fail(path, f"frame {number} ends without {missing}; expected every bone that has a dof", line)


def _line_of(rows, number, bone):
    """The line of a bone in the frame of this number."""
    inside = False
    for line, row in enumerate(rows, 1):
        words = row.split()
        if len(words) == 1 and words[0].isdecimal():
            inside = int(words[0]) == number
        elif inside and words and words[0] == bone:
            return line
    return None


# ---------------------------------------------------------------- poses


def global_pose(skeleton: Skeleton, motion):
    r"""Forward kinematics: every bone's start and rotation in the file's world frame (file units, file axes).

    Equation  [ASF] R_j = R_parent C_j M_j C_j⁻¹,  p_j = p_parent + R_parent d_parent l_parent
    Symbols   C -> axes, M -> the dofs' turns, d -> directions, l -> lengths; R = 1 for all bones in the zero pose
    Args      skeleton : Skeleton
              motion : (T, C) as `read_amc` gives it
    Returns   positions : (T, J, 3) float64 [file units], where the bone starts
              rotations : (T, J, 4) float64 unit quaternions w, x, y, z; no sign jumps along T
    Raises    ValueError: motion has another number of columns than the skeleton
    Test      tests/mocap/test_amc.py::test_global_pose_against_matrices, ::test_hand_cases, ::test_real_files
    """
    motion = np.asarray(motion, np.float64)
    columns = len(skeleton.columns)
    if motion.ndim != 2 or motion.shape[1] != columns:
        raise ValueError(f"motion has shape {motion.shape}; expected (T, {columns})")
    T, J = len(motion), len(skeleton.names)
    positions, rotations, world, column = np.zeros((T, J, 3)), np.zeros((T, J, 4)), [], 0
    for j, (parent, dofs) in enumerate(zip(skeleton.parents, skeleton.dofs)):
        value = dict(zip(dofs, motion[:, column : column + len(dofs)].T))
        column += len(dofs)
        turns = [dof for dof in dofs if dof in _TURNS]
        local = Rotation.identity()
        if turns:
            c = Rotation.from_euler(skeleton.axis_orders[j], skeleton.axes[j])
            order = "".join(dof[1] for dof in turns)
            m = Rotation.from_euler(order, np.stack([value[dof] for dof in turns], axis=-1))
            local = c * m * c.inv()
        if parent < 0:
            world.append(local if turns else Rotation.from_quat(np.tile([0.0, 0, 0, 1], (T, 1))))
            for dof in _MOVES:
                moved = value.get(dof, 0.0)
                positions[:, 0, _MOVES.index(dof)] = skeleton.position[_MOVES.index(dof)] + moved
        else:
            world.append(world[parent] * local)
            rod = skeleton.directions[parent] * skeleton.lengths[parent]
            positions[:, j] = positions[:, parent] + world[parent].apply(rod)
        rotations[:, j] = world[j].as_quat(scalar_first=True)
    return positions, continuous(rotations)

"""Files: written whole or not at all, and read whatever they hold: a damaged or hostile one is a UserError in one line,
within little time and memory.

Text, TOML, JSON, numbers; the XML of an MJCF before MuJoCo sees it; the arrays of an .npz.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import stat
import struct
import tokenize
import tomllib
import warnings
import zipfile
import zlib
from pathlib import Path
from xml.parsers import expat

import numpy as np

from plumbing.cli import UserError

CHECKPOINT, PREVIOUS, CONFIG, METRICS = "checkpoint.npz", "checkpoint.prev.npz", "config.json", "metrics.csv"
RUN = CHECKPOINT, PREVIOUS, CONFIG, METRICS  # what a run writes into its folder
WRITTEN = (".json", ".png", ".mp4")  # tables and pictures: nothing reads them from a folder, but a run its config.json

# ---- files that are whole or absent ---------------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_path(path, previous=None):
    """Yield a temporary path beside `path` (same suffix); rename it on success, remove it on any exception.

    Args      path : the final file; previous : where an existing file is kept, or None to replace it
    Test      tests/plumbing/test_runs.py::test_atomic_write
    """
    path = Path(path)
    temporary = path.with_name(f"{path.stem}.tmp-{os.getpid()}-{os.urandom(3).hex()}{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        if previous is not None and path.exists():
            os.replace(path, previous)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def atomic_write(path, content, previous=None):
    """Write a whole file or none of it.

    Args      path : final file; content : bytes, str, or a function that is given the open binary file
              previous : where an existing file is kept, or None
    Raises    UserError: the folder is missing or cannot be written
    Test      tests/plumbing/test_runs.py::test_atomic_write
    """
    try:
        with atomic_path(path, previous) as temporary, open(temporary, "wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"cannot write {path}: {reason}; give a folder that exists and is writable") from None


def check_folders(*paths, read=()) -> None:
    """Before the slow work: the files to write, None left out, have a folder and destroy nothing.

    Args      read : files and folders that are read, None left out
    Raises    UserError: no such folder, or one that is read-only; the file is a folder, one of those read, or there in
              a folder of them; it is read-only, or no name of a file
    Test      tests/robustness/test_cli.py::test_folder_to_write, test_nothing_read_is_overwritten
    """
    for out in filter(None, paths):
        file = Path(out).resolve()
        try:
            mode = file.stat().st_mode if file.exists() else None
        except OSError as error:
            raise UserError(f"cannot write {out}: {error.strerror}; give another file") from None
        if not file.parent.is_dir():
            raise UserError(f"cannot write {out}: there is no folder {Path(out).parent}")
        if mode is None and not os.access(file.parent, os.W_OK):
            raise UserError(f"cannot write {out}: the folder {Path(out).parent} is read-only; give another file")
        if any(_is_read(file, Path(source).resolve()) for source in read if source):
            raise UserError(f"cannot write {out}: it is read from, or in a folder that is; give another file")
        if mode and stat.S_ISDIR(mode):
            raise UserError(f"cannot write {out}: it is a folder; give a file")
        if mode and stat.S_ISREG(mode) and not mode & 0o222:
            raise UserError(f"cannot write {out}: it is read-only; give another file")


def _is_read(file, source) -> bool:
    """Whether a file is one that is read, or is there in a folder that is: of a run's folder, what the run wrote; of
    any other all but tables and pictures, which are written there again and again."""
    if file == source or source not in file.parents or not file.exists():
        return file == source
    is_run = any((source / name).exists() for name in RUN)
    return file.name in RUN or not (is_run or file.suffix.lower() in WRITTEN)


def make_folder(path) -> None:
    """Before the slow work: make a folder for files to write, unless it is there; None: none is asked for.

    Raises    UserError: it is a file, or cannot be made
    Test      tests/robustness/test_cli.py::test_make_folder
    """
    try:
        if path:
            Path(path).mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make the folder {path}: {error.strerror}; give another") from None


# ---- files from outside ---------------------------------------------------------------------------------------------

TOML_BYTES, TOML_LINE = 65536, 1000  # tomllib's time and memory grow with the square of the dots in a key
NESTING = 16  # tables and arrays inside one another: no file of ours has more than 4
INTEGER = 60  # digits; a generator's state has 39


KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}


def kind_of(path) -> str | None:
    """What there is that is no regular file: "a folder", "a pipe", "a device", "a socket"; None for a regular one.

    Raises    OSError: nothing there, or not to be seen; ValueError: a name that none can have
    Test      tests/plumbing/test_runs.py::test_regular_files
    """
    kind = stat.S_IFMT(os.stat(path).st_mode)
    return None if kind == stat.S_IFREG else KINDS.get(kind, "a socket")


def open_regular(path):
    """A regular file, open for its bytes.  What else has a name may hang (a pipe) or have no end (/dev/zero).

    Raises    OSError: it cannot be opened, or `strerror` says what it is; ValueError: as `kind_of`
    Test      tests/plumbing/test_runs.py::test_regular_files
    """
    if kind := kind_of(path):
        raise OSError(errno.EINVAL, f"is {kind}", os.fspath(path))
    return open(path, "rb")


def read_text(path, expected, limit=None) -> str:
    """A whole text file.

    Args      path : file, UTF-8 with or without a byte order mark; expected : what it should be, for the message
              limit : bytes, or None
    Raises    UserError: no regular file, cannot be opened, longer than the limit, or another encoding
    Test      tests/plumbing/test_runs.py::test_read_text, test_regular_files
    """
    try:
        with open_regular(path) as file:
            data = file.read(-1 if limit is None else limit + 1)
    except (OSError, ValueError) as error:
        raise UserError(
            f"cannot read {path}: {getattr(error, 'strerror', None) or error}; expected {expected}"
        ) from None
    if limit is not None and len(data) > limit:
        raise UserError(f"{path}: longer than {limit} bytes; expected {expected}")
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise UserError(f"{path}: UTF-16 text; expected {expected}, in UTF-8 (save it again in that encoding)")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UserError(
            f"{path}, line {line}: byte 0x{data[error.start]:02x} is not UTF-8; expected {expected}"
        ) from None


def read_toml(path, expected) -> dict:
    """The tables of a TOML file; time and memory follow its size.

    Args      path : file; expected : what it should be, for the message
    Raises    UserError: cannot be opened, no TOML (with line and column), or nested too deep
    Test      tests/plumbing/test_runs.py::test_read_toml, tests/robustness/test_fuzz.py::test_joint_maps
    """
    text = read_text(path, expected, TOML_BYTES)
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > TOML_LINE:
            raise UserError(f"{path}, line {number}: longer than {TOML_LINE} characters; expected {expected}")
    try:
        table = tomllib.loads(text)
        _check_nesting(table)
    except RecursionError:
        raise UserError(f"{path}: nested more than {NESTING} deep; expected {expected}") from None
    except ValueError as error:
        raise UserError(f"{path}: no TOML: {error}; expected {expected}") from None
    return table


def parse_json(text):
    """JSON without what it does not have: NaN, infinity, a key twice; nor numbers or nesting beyond any use.

    Raises    ValueError: what it is and, where known, where
    Test      tests/plumbing/test_runs.py::test_parse_json, tests/robustness/test_fuzz.py::test_run_folders
    """

    def pairs(items):
        table = dict(items)
        if len(table) < len(items):
            raise ValueError(f"key {twice(name for name, _ in items)[:40]!r} is there twice; valid: once")
        return table

    def finite(word):
        if not np.isfinite(float(word)):
            raise ValueError(f"{word[:40]} is no finite number")
        return float(word)

    def integer(word):
        if len(word) > INTEGER:
            raise ValueError(f"an integer of {len(word)} digits; valid: at most {INTEGER}")
        return int(word)

    try:
        value = json.loads(text, object_pairs_hook=pairs, parse_float=finite, parse_int=integer, parse_constant=finite)
        _check_nesting(value)
    except RecursionError:
        raise ValueError(f"nested more than {NESTING} deep") from None
    return value


def _check_nesting(tree):
    """RecursionError if dicts and lists lie more than NESTING deep in one another."""
    level = [tree]
    for _ in range(NESTING):
        level = [v for each in level if isinstance(each, dict | list) for v in _values(each)]
        if not level:
            return
    if any(isinstance(v, dict | list) for v in level):
        raise RecursionError


def twice(names):
    """The first of the names that is there again."""
    seen = set()
    return next(name for name in names if name in seen or seen.add(name))


def _values(tree):
    return tree.values() if isinstance(tree, dict) else tree


def parse_number(word) -> float:
    """float(word), but without Python's own 1_000.  ValueError: no number"""
    if "_" in word:
        raise ValueError(f"{word[:40]!r} is no number")
    return float(word)


# ---- MJCF ------------------------------------------------------------------------------------------------------------

XML_BYTES = 2**25
COPIES, PIXELS, ENTRIES = 1e4, 2**24, 1e6
CLAIMS = {  # element of an MJCF -> attributes whose product may be so large
    "replicate": ("count", COPIES),
    "composite": ("count", COPIES),
    "flexcomp": ("count", COPIES),
    "texture": ("width height", PIXELS),
    "hfield": ("nrow ncol", PIXELS),
    "size": ("nuserdata nkey njmax nconmax", ENTRIES),
}


def check_claims(path, seen=()):
    """UserError if an MJCF, or one that it includes, is no XML, or asks MuJoCo for much more than its own size.

    Test      tests/robustness/test_fuzz.py::test_what_is_meant_to_hurt"""
    copies, included, parser = [1.0], [], expat.ParserCreate()

    def start(tag, attributes):
        names, most = CLAIMS.get(tag, ("", COPIES))
        keys = [k for k in attributes if k in names.split() or (tag == "size" and k.startswith("nuser"))]
        words = [w for k in keys for w in attributes[k].split() if re.fullmatch(r"\d+(\.\d*)?([eE]\+?\d+)?", w)]
        claim = math.prod(max(float(w), 1.0) for w in words)
        copies.append(copies[-1] * (claim if most == COPIES else 1.0))
        if max(claim / most, copies[-1] / COPIES) > 1.0:
            where = f"{path}, line {parser.CurrentLineNumber}"
            raise UserError(f"{where}: <{tag}> asks for {claim:g} {' x '.join(keys)}; valid: {most:g} in all")
        if tag in ("include", "model") and "file" in attributes:
            included.append(path.parent / attributes["file"])

    def doctype(*_):
        raise UserError(f"{path}, line {parser.CurrentLineNumber}: a document type; expected MJCF without one")

    parser.StartElementHandler, parser.EndElementHandler = start, lambda tag: copies.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(read_text(path, "MJCF", XML_BYTES), True)
    except (expat.ExpatError, ValueError) as e:
        raise UserError(f"{path}: no XML: {e}; expected MJCF") from None
    for other in included:
        if other not in (path, *seen):
            check_claims(other, (path, *seen))


# ---- .npz ------------------------------------------------------------------------------------------------------------

UNREADABLE = (
    OSError, EOFError, ValueError, KeyError, TypeError, RuntimeError, MemoryError, zlib.error, struct.error
)  # fmt: skip


def read_arrays(path, expected) -> dict:
    """The arrays of an .npz, as `runs.save_checkpoint` writes it.

    Its members must be stored as they are, so that none is larger than the file: NumPy's own reader makes room for
    whatever a header or a compressed member claims, before it looks.
    Args      path : file; expected : what it should be, for the message
    Raises    UserError: cut short, no .npz, object arrays, or numbers that are not there
    Test      tests/plumbing/test_runs.py::test_damaged_checkpoints, tests/robustness/test_fuzz.py::test_policies
    """
    try:
        return _members(path)
    except zipfile.BadZipFile:
        with open(path, "rb") as file:
            start = file.read(2)
        damage = "cut short or damaged" if start == b"PK" else "not a zip archive, as .npz is" if start else "empty"
    except UNREADABLE as error:
        damage = f"{type(error).__name__}: {error}"
    raise UserError(f"cannot read checkpoint {path} ({damage}): {expected}")


def _members(path):
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        claimed, size = sum(m.file_size for m in members), os.path.getsize(path)
        if claimed > size or any(m.compress_type != zipfile.ZIP_STORED for m in members):
            raise ValueError(f"its members claim {claimed} bytes of a file of {size}, or are compressed")
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in arrays:
                raise ValueError(f"array {name!r} is there twice")
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("error")  # of headers as Python 2 wrote them
                        shape, fortran, dtype = read_header[version](file)
                except (KeyError, SyntaxError, tokenize.TokenError, Warning) as error:
                    raise ValueError(f"array {name!r} has a damaged header ({error})") from None
                data = file.read()
            if dtype.kind not in "biufcUS" or not dtype.itemsize:
                raise ValueError(f"array {name!r} is of {dtype}, not of numbers or text")
            if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data):
                raise ValueError(f"array {name!r} claims the shape {shape} of {dtype} and has {len(data)} bytes")
            arrays[name] = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy(order="K")
    return arrays

"""What every long run shares: command line, run folder, checkpoints, metrics, progress.

A run is one folder:

    config.json           what was asked for, and the versions and commit that ran it
    checkpoint.npz        the newest state; checkpoint.prev.npz is the one before
    metrics.csv           one row per update, cut back to the checkpoint on resume

Every file is written to a temporary name and renamed, so a run killed at any moment resumes from its last good
checkpoint. NumPy's BLAS starts threads of its own: where the physics is threaded too, set OMP_NUM_THREADS=1 in the
shell before Python starts, or they compete for the same cores.
"""

import argparse
import contextlib
import csv
import dataclasses
import difflib
import errno
import fnmatch
import io
import json
import math
import os
import platform
import signal
import stat
import struct
import subprocess
import sys
import time
import tokenize
import tomllib
import types
import typing
import warnings
import zipfile
import zlib
from importlib import metadata
from pathlib import Path

import numpy as np

CHECKPOINT, PREVIOUS, CONFIG, METRICS = "checkpoint.npz", "checkpoint.prev.npz", "config.json", "metrics.csv"


MESSAGE = 4000  # characters of the longest message; more is cut out of its middle


class UserError(Exception):
    """Bad input from outside. The message names the file, flag or value, and what would have been valid.

    It is one line, and printable: what a damaged file holds reaches the terminal as text.
    Test      tests/test_runs.py::test_user_error_is_one_line
    """

    def __init__(self, message):
        text = printable(" ".join(str(message).split()))
        if len(text) > MESSAGE:
            text = f"{text[: MESSAGE * 3 // 4]} … {text[-MESSAGE // 4 + 3 :]}"
        super().__init__(text)


def printable(text) -> str:
    """Text with control characters and the like escaped.  Test: tests/test_runs.py::test_user_error_is_one_line"""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def run_main(main_fn, argv=None):
    """Call main_fn(argv), then exit: its own int; 2 and one line for a UserError or too little memory; 130 on Ctrl-C.

    Test      tests/test_runs.py::test_run_main
    """
    try:
        code = main_fn(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
    except BrokenPipeError:  # as in `… | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        code = 141  # what a shell calls SIGPIPE
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except MemoryError as error:
        print(f"error: not enough memory: {printable(str(error))[:MESSAGE]}; give smaller numbers", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = 130
    sys.exit(code if isinstance(code, int) else 0)


# ---- command line ---------------------------------------------------------------------------------------------------

HUGE = 1e18  # NumPy has no integers above 2**63; also refuses infinity, and NaN fails every comparison
POSITIVE = (lambda v: 0 < v < HUGE, "greater than 0 and below 1e18")
NONNEGATIVE = (lambda v: 0 <= v < HUGE, "0 or greater, and below 1e18")
UNIT = (lambda v: 0 <= v <= 1, "from 0 to 1")
COUNT = (lambda v: 1 <= v <= 10**6, "from 1 to 1000000")
THREADS = (lambda v: 0 <= v <= 1024, "from 0 to 1024")
ALL_POSITIVE = (lambda v: len(v) > 0 and all(x > 0 for x in v), "one or more numbers greater than 0, as in 256,128")


def arg(default, help, choices=None, flag=None, check=None, metavar=None):
    """Declare one dataclass field that is also a command-line flag.

    Args      default : value; None needs an annotation such as `int | None`
              help : str; choices : valid values, or None for any; metavar : str shown in --help
              flag : "--x"; by default the field's name with dashes
              check : (test, text), where test(value) -> bool and text is the valid range, e.g. POSITIVE
    Returns   dataclasses.field
    Test      tests/test_runs.py::test_cli_reads_every_kind
    """
    settings = {"help": help, "choices": choices, "flag": flag, "check": check, "metavar": metavar}
    return dataclasses.field(default=default, metadata=settings)


def cli(dataclass_type, argv, prog, description):
    """Parse argv into one instance of dataclass_type, whose fields are declared with `arg`.

    `learning_rate` is read from --learning-rate or --learning_rate, a bool from --x or --no-x, a tuple from 256,128;
    an integer may be written 1e6, and an optional value `none`. --help prints every default.

    Args      dataclass_type : class; argv : list of str; prog, description : str
    Returns   dataclass_type
    Raises    SystemExit: 0 after --help; 2 after one line about an unknown flag or a bad value
    Test      tests/test_runs.py::test_cli_reads_every_kind, test_cli_refuses
    """
    raw = argparse.RawDescriptionHelpFormatter  # the commands of a module's first lines stay lines
    parser = argparse.ArgumentParser(prog=prog, description=description, allow_abbrev=False, formatter_class=raw)
    parser.error = lambda message: parser.exit(2, f"{prog}: error: {message} (see --help)\n")
    hints, fields = typing.get_type_hints(dataclass_type), dataclasses.fields(dataclass_type)
    flags = {f.name: f.metadata.get("flag") or "--" + f.name.replace("_", "-") for f in fields}
    for f in fields:
        if f.default is dataclasses.MISSING:
            raise TypeError(f"{dataclass_type.__name__}.{f.name} needs a default: declare it with arg(default, help)")
        read, choices = _reader(hints[f.name]), f.metadata.get("choices")
        if read is bool:
            how = {"action": argparse.BooleanOptionalAction}
        else:
            how = {"type": read, "choices": choices}
            how["metavar"] = f.metadata.get("metavar") or (None if choices else read.__name__.upper())
        action = parser.add_argument(flags[f.name], dest=f.name, default=f.default, **how)
        action.help = f"{f.metadata.get('help', '')} (default: {_shown(f.default)})".replace("%", "%%")
    argv = [_dashed(a) for a in argv]
    values, unknown = parser.parse_known_args(argv)
    if unknown:
        near = difflib.get_close_matches(unknown[0].split("=")[0], list(parser._option_string_actions), 1)
        parser.error(f"unknown argument {unknown[0]}" + (f"; did you mean {near[0]}?" if near else ""))
    for f in fields:
        check, value = f.metadata.get("check"), getattr(values, f.name)
        if check and value is not None and not check[0](value):
            parser.error(f"argument {flags[f.name]}: {_shown(value)} is not valid; it must be {check[1]}")
    return dataclass_type(**vars(values))


def given_flags(argv) -> set:
    """Names of the fields whose flags are on a command line, whatever their values.

    Test      tests/test_ppo.py::test_resume_refuses_other_options, tests/test_skeletal_play.py::test_interrupt"""
    return {a.split("=")[0].lstrip("-").replace("-", "_") for a in argv if a.startswith("--")}


def _dashed(a):
    """--some_flag=a_b -> --some-flag=a_b; anything else unchanged."""
    name, equals, value = a.partition("=")
    return name.replace("_", "-") + equals + value if a.startswith("--") else a


def _shown(value):
    """A value as it would be typed on the command line."""
    if isinstance(value, tuple | list):
        return ",".join(str(v) for v in value)
    return "none" if value is None else str(value)


def _reader(hint):
    """The function that reads one flag's text, from the field's annotation."""
    optional = False
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        optional = True
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
    if hint is bool:
        return bool
    inner = typing.get_args(hint)[0] if typing.get_origin(hint) in (tuple, list) else hint
    many = inner is not hint or hint is tuple
    inner = int if inner is tuple else inner

    def read(text):
        if optional and text.lower() == "none":
            return None
        if many:
            return tuple(_number(inner, part.strip()) for part in text.split(",") if part.strip())
        return _number(hint, text)

    read.__name__ = ("comma-separated " if many else "") + getattr(inner, "__name__", "str").lower()
    return read


def _number(kind, text):
    """kind(text), where an int may also be written 1e6."""
    if kind is int:
        try:
            return int(text)
        except ValueError:
            if float(text).is_integer():
                return int(float(text))
            raise
    return kind(text)


# ---- files that are whole or absent ---------------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_path(path, previous=None):
    """Yield a temporary path beside `path` (same suffix); rename it on success, remove it on any exception.

    Args      path : the final file; previous : where an existing file is kept, or None to replace it
    Test      tests/test_runs.py::test_atomic_write
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
    Test      tests/test_runs.py::test_atomic_write
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
    Raises    UserError: no such folder; the file is one of those read, or motion in a folder of them; it is read-only
    Test      tests/test_cli.py::test_folder_to_write, test_nothing_read_is_overwritten
    """
    for out in filter(None, paths):
        file = Path(out).resolve()
        if not file.parent.is_dir():
            raise UserError(f"cannot write {out}: there is no folder {Path(out).parent}")
        for source in (Path(s).resolve() for s in read if s):
            inside = source in file.parents and source.is_dir() and file.suffix.lower() in (".bvh", ".amc", ".asf")
            if file == source or (inside and file.exists()):
                raise UserError(f"cannot write {out}: it is read from; give another file")
        if file.is_file() and not file.stat().st_mode & 0o222:
            raise UserError(f"cannot write {out}: it is read-only; give another file")


class StopFlag:
    """Ctrl-C or SIGTERM ends a run after the present update, with a checkpoint; a second one at once.

    Test      tests/test_ppo.py::test_interrupt_ends_with_a_checkpoint, tests/test_skeletal_play.py::test_interrupt,
              tests/test_drop_vae.py::test_interrupt
    """

    def __enter__(self):
        self.stop = False
        self.old = {s: signal.signal(s, self._on) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def _on(self, number, frame):
        if self.stop:
            raise KeyboardInterrupt
        self.stop = True

    def __exit__(self, *_):
        for s, handler in self.old.items():
            signal.signal(s, handler)


# ---- files from outside ---------------------------------------------------------------------------------------------

TOML_BYTES, TOML_LINE = 65536, 1000  # tomllib's time and memory grow with the square of the dots in a key
NESTING = 16  # tables and arrays inside one another: no file of ours has more than 4
INTEGER = 60  # digits; a generator's state has 39


KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}


def kind_of(path) -> str | None:
    """What there is that is no regular file: "a folder", "a pipe", "a device", "a socket"; None for a regular one.

    Raises    OSError: nothing there, or not to be seen; ValueError: a name that none can have
    Test      tests/test_runs.py::test_regular_files
    """
    kind = stat.S_IFMT(os.stat(path).st_mode)
    return None if kind == stat.S_IFREG else KINDS.get(kind, "a socket")


def open_regular(path):
    """A regular file, open for its bytes.  What else has a name may hang (a pipe) or have no end (/dev/zero).

    Raises    OSError: it cannot be opened, or `strerror` says what it is; ValueError: as `kind_of`
    Test      tests/test_runs.py::test_regular_files
    """
    if kind := kind_of(path):
        raise OSError(errno.EINVAL, f"is {kind}", os.fspath(path))
    return open(path, "rb")


def read_text(path, expected, limit=None) -> str:
    """A whole text file.

    Args      path : file, UTF-8 with or without a byte order mark; expected : what it should be, for the message
              limit : bytes, or None
    Raises    UserError: no regular file, cannot be opened, longer than the limit, or another encoding
    Test      tests/test_runs.py::test_read_text, test_regular_files
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
    Test      tests/test_runs.py::test_read_toml, tests/test_fuzz.py::test_joint_maps
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
    Test      tests/test_runs.py::test_parse_json, tests/test_fuzz.py::test_run_folders
    """

    def pairs(items):
        table = dict(items)
        if len(table) < len(items):
            raise ValueError(f"key {_twice(name for name, _ in items)[:40]!r} is there twice; valid: once")
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


def _twice(names):
    """The first of the names that is there again."""
    seen = set()
    return next(name for name in names if name in seen or seen.add(name))


def _values(tree):
    return tree.values() if isinstance(tree, dict) else tree


# ---- run folder -----------------------------------------------------------------------------------------------------


def versions():
    """What a number depends on beside the code: interpreter, libraries, machine."""
    found = {"python": platform.python_version()}
    for name in ("numpy", "scipy", "mujoco"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found | {"platform": platform.platform(), "cpus": os.cpu_count()}


def git_state(folder=None):
    """{"commit": hash or None, "dirty": bool or None} of the repository that holds `folder` (default: this file)."""

    def git(*words):
        where = str(folder or Path(__file__).resolve().parent)
        return subprocess.run(["git", "-C", where, *words], capture_output=True, text=True, check=True).stdout.strip()

    try:
        commit = git("rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(git("status", "--porcelain", "--untracked-files=no"))}
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "dirty": None}


def check_run(out, resume=False):
    """Is a run there where one is to be resumed, and none where one is to start?  Call it before slow work.

    Raises    UserError: a run is there already and resume is False; or none is there and resume is True, or its
              metrics.csv cannot be continued
    Test      tests/test_runs.py::test_open_run, tests/test_fuzz.py::test_run_folders
    """
    out = Path(out)
    there = any((out / name).exists() for name in (CONFIG, CHECKPOINT, PREVIOUS, METRICS))
    if there and not resume:
        raise UserError(f"{out} already holds a run: add --resume to continue it, or choose another folder")
    if resume and not there:
        raise UserError(f"{out} holds no run to resume: leave out --resume, or name a folder that has {CONFIG}")
    if resume and (out / METRICS).exists():
        _whole_lines(out / METRICS)


def open_run(out, config, resume=False):
    """Create the run folder, or reopen it to resume, and write config.json.

    On resume the earlier launches stay in config.json under "earlier", and temporary leftovers are removed.

    Args      out : folder; config : dict or dataclass; resume : bool
    Returns   Path of the folder
    Raises    UserError: a run is there already and resume is False; or none is there and resume is True
    Test      tests/test_runs.py::test_open_run
    """
    check_run(out, resume)
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot create the run folder {out}: {error.strerror}") from None
    for leftover in out.glob("*.tmp-*"):
        leftover.unlink(missing_ok=True)
    earlier = []
    if resume and (out / CONFIG).exists():
        last = read_config(out)
        earlier = last.pop("earlier", []) + [last]
    config = dataclasses.asdict(config) if dataclasses.is_dataclass(config) else dict(config)
    record = {"config": config, "versions": versions(), "git": git_state(), "earlier": earlier}
    atomic_write(out / CONFIG, json.dumps(record, indent=2, sort_keys=True, default=_plain) + "\n")
    return out


def read_config(folder):
    """The record in folder/config.json: {"config", "versions", "git", "earlier"}; UserError if it is unreadable.

    Test      tests/test_runs.py::test_open_run, tests/test_fuzz.py::test_run_folders"""
    path = Path(folder) / CONFIG
    expected = f"the {CONFIG} that the run wrote"
    try:
        record = parse_json(read_text(path, expected))
    except ValueError as error:
        raise UserError(f"cannot read {path} ({error}); expected {expected}") from None
    if not isinstance(record, dict) or not isinstance(record.get("config"), dict):
        raise UserError(f'{path} has no "config" table; expected {expected}')
    if not isinstance(record.get("earlier", []), list):
        raise UserError(f'{path}: "earlier" is no list; expected {expected}')
    return record


def stored_options(dataclass_type, folder) -> dict:
    """What config.json says of the fields of dataclass_type, each of its field's kind and in its range.

    Args      dataclass_type : class whose fields are declared with `arg`; folder : of a run
    Returns   field -> value, without fields that the file does not have
    Raises    UserError: the file, the field, and what would be valid
    Test      tests/test_runs.py::test_stored_options, tests/test_fuzz.py::test_run_folders
    """
    config, hints, values = read_config(folder)["config"], typing.get_type_hints(dataclass_type), {}
    for f in dataclasses.fields(dataclass_type):
        if f.name not in config:
            continue
        value, hint = config[f.name], hints[f.name]
        check, choices = f.metadata.get("check"), f.metadata.get("choices")
        if not _fits(hint, value):
            valid = hint.__name__ if isinstance(hint, type) else str(hint)
        elif value is not None and check and not check[0](value):
            valid = check[1]
        elif value is not None and choices and value not in choices:
            valid = " or ".join(map(str, choices))
        else:
            values[f.name] = tuple(value) if isinstance(value, list) else value
            continue
        raise UserError(f"{Path(folder) / CONFIG}: {f.name} = {str(value)[:200]} is not valid; it must be {valid}")
    return values


def _fits(hint, value):
    """Has a value from JSON the kind that a field's annotation asks for?"""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return any(_fits(each, value) for each in typing.get_args(hint))
    if typing.get_origin(hint) in (tuple, list):
        return isinstance(value, list) and all(_fits(typing.get_args(hint)[0], v) for v in value)
    if hint in (int, float):
        return isinstance(value, (int, hint)) and not isinstance(value, bool) and abs(value) < 2**63
    return isinstance(value, str if hint is Path else hint)


def _plain(value):
    """What json.dumps cannot write itself: NumPy scalars and arrays, paths."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


# ---- checkpoints ----------------------------------------------------------------------------------------------------

UNREADABLE = (
    OSError, EOFError, ValueError, KeyError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error, struct.error
)  # fmt: skip


def save_checkpoint(path, arrays, meta):
    """Write arrays and meta to one .npz, whole or not at all.

    A file named checkpoint.npz moves to checkpoint.prev.npz first; any other name is replaced.

    Args      path : file; arrays : dict of name -> array, no objects; meta : dict that JSON can hold
    Raises    ValueError: an object array, or the name __meta__; UserError: the folder cannot be written
    Test      tests/test_runs.py::test_checkpoint_round_trip, test_killed_while_writing
    """
    path = Path(path)
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    for name, value in arrays.items():
        if value.dtype.hasobject or name == "__meta__":
            raise ValueError(f"array {name!r} ({value.dtype}) cannot be saved: use numbers, and a name but __meta__")
    text = json.dumps(meta, default=_plain).encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, value in (arrays | {"__meta__": np.frombuffer(text, np.uint8)}).items():
            with archive.open(zipfile.ZipInfo(name + ".npy"), "w", force_zip64=True) as member:  # a fixed date: 1980
                np.lib.format.write_array(member, value, allow_pickle=False)
    atomic_write(path, buffer.getvalue(), path.with_name(PREVIOUS) if path.name == CHECKPOINT else None)


def load_checkpoint(path, finite=()):
    """Read what save_checkpoint wrote.

    Args      path : file; finite : names or patterns ("policy.*") that must be there and hold no NaN or infinity
    Returns   arrays : dict of name -> array; meta : dict
    Raises    UserError: missing, cut short, not a checkpoint, object arrays, or non-finite numbers
    Test      tests/test_runs.py::test_checkpoint_round_trip, test_damaged_checkpoints
    """
    expected = f"expected an .npz file that save_checkpoint wrote (such as {CHECKPOINT} in a run folder)"
    if not Path(path).is_file():
        raise UserError(f"no checkpoint {path}: {expected}")
    try:
        arrays = _read_arrays(path)
        meta = parse_json(arrays.pop("__meta__").tobytes())
    except (*UNREADABLE, AttributeError, TypeError) as error:
        raise UserError(f"cannot read checkpoint {path} ({_damage(path, error)}): {expected}") from None
    if not isinstance(meta, dict):
        raise UserError(f"cannot read checkpoint {path} (its __meta__ is no table): {expected}")
    for pattern in finite:
        names = fnmatch.filter(arrays, pattern)
        if not names:
            there = ", ".join(name[:40] for name in sorted(arrays)[:50])
            raise UserError(f"checkpoint {path} has no array {pattern!r}; it has: {there}; needed: {', '.join(finite)}")
        for name in names:
            if arrays[name].dtype.kind in "fc" and not np.isfinite(arrays[name]).all():
                raise UserError(f"checkpoint {path}: array {name!r} holds NaN or infinity; give an earlier checkpoint")
    return arrays, meta


def _damage(path, error) -> str:
    """What is wrong with a checkpoint, in a user's words."""
    if isinstance(error, KeyError):
        return "no __meta__ entry"
    if isinstance(error, zipfile.BadZipFile):
        with open(path, "rb") as file:
            start = file.read(2)
        return "cut short or damaged" if start == b"PK" else "no .npz" if start else "empty"
    return f"{type(error).__name__}: {error}"


def _read_arrays(path):
    """The arrays of an .npz.  Its members must be stored as they are, so that none is larger than the file.

    NumPy's own reader makes room for whatever a header or a compressed member claims, before it looks."""
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


def latest_checkpoint(folder, finite=()):
    """Load the newest readable checkpoint of a run folder.

    Falls back to checkpoint.prev.npz, with a printed note, when the newest is missing or damaged.

    Returns   (arrays, meta), or None when the run wrote no checkpoint yet
    Raises    UserError: there are checkpoints and none is readable
    Test      tests/test_runs.py::test_latest_falls_back
    """
    failed = None
    for path in (Path(folder) / CHECKPOINT, Path(folder) / PREVIOUS):
        if not path.exists():
            continue
        try:
            loaded = load_checkpoint(path, finite)
        except UserError as error:
            failed = failed or error
            continue
        if path.name == PREVIOUS:
            if failed:
                print(f"note: {failed}", file=sys.stderr)
            print(f"note: using the previous checkpoint, {path}", file=sys.stderr)
        return loaded
    if failed:
        raise UserError(f"no readable checkpoint in {folder}: {failed}")
    return None


def rng_state(rng):
    """A Generator's whole state as JSON-ready numbers, with the seed sequence that `spawn` draws from."""
    seeds = rng.bit_generator.seed_seq
    names = ("entropy", "spawn_key", "pool_size", "n_children_spawned")
    seeds = {name: getattr(seeds, name) for name in names} if isinstance(seeds, np.random.SeedSequence) else None
    return json.loads(json.dumps({"state": rng.bit_generator.state, "seeds": seeds}, default=_plain))


def rng_from_state(state):
    """The Generator that rng_state described: it draws and spawns exactly what the saved one would have.

    Raises    UserError: not a state that rng_state wrote
    Test      tests/test_runs.py::test_rng_state_is_exact
    """
    kinds = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")
    try:
        name, seeds = state["state"]["bit_generator"], state["seeds"]
        if name not in kinds:
            raise ValueError(f"bit generator {name!r}")
        seeds = None if seeds is None else np.random.SeedSequence(**{**seeds, "spawn_key": tuple(seeds["spawn_key"])})
        bits = getattr(np.random, name)(seeds)
        bits.state = _like(bits.state, state["state"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"not a saved random state ({error}): valid generators are {', '.join(kinds)}") from None
    return np.random.Generator(bits)


def _like(template, value):
    """`value` from JSON, with lists turned back into the arrays that `template` has."""
    if isinstance(template, dict):
        return {key: _like(template[key], value[key]) for key in template}
    return np.array(value, template.dtype) if isinstance(template, np.ndarray) else value


# ---- metrics and progress -------------------------------------------------------------------------------------------


class Metrics:
    """metrics.csv, one row per update; every row reaches the disk's cache at once.

    Args      path : file
              resume_row : rows to keep, i.e. how many were written when the checkpoint was saved (store `.rows` in its
                  meta); the rest is dropped, so the file continues exactly. None starts a new file.
    Test      tests/test_runs.py::test_metrics_resume
    """

    def __init__(self, path, resume_row=None):
        self.path, self.header, self.rows, self.found = Path(path), None, 0, False
        lines = []
        if resume_row is not None and self.path.exists():
            lines = _whole_lines(self.path)[: resume_row + 1]
            self.header, self.rows = (lines[0] if lines else None), max(len(lines) - 1, 0)
            self.found = bool(lines)
            if self.rows < resume_row:
                print(f"note: {path} has {self.rows} of the checkpoint's {resume_row} rows", file=sys.stderr)
        atomic_write(self.path, "".join(_csv(line) for line in lines))
        self.file = open(self.path, "a", newline="")

    def append(self, row):
        """Add one row, a dict of name -> number; every row has the same names.  ValueError otherwise, or UserError if
        the header is the file's"""
        if self.header is None:
            self.header = list(row)
            self.file.write(_csv(self.header))
        if list(row) != self.header:
            odd = sorted(set(row) ^ set(self.header)) or "the order of the names"
            kind = UserError if self.found else ValueError
            raise kind(f"{self.path}: the row differs from the header in {odd}; valid: {', '.join(self.header)}")
        self.file.write(_csv([_plain(v) if isinstance(v, np.ndarray | np.generic) else v for v in row.values()]))
        self.file.flush()
        self.rows += 1

    def close(self):
        self.file.close()


def read_metrics(path):
    """metrics.csv as name -> (rows,) float64; an unfinished last line is left out, an empty cell is NaN.

    A run writes `nan` and `inf` where that is what it found: they are read as such.
    Raises    UserError: no such file, a column twice, or a cell that is no number
    Test      tests/test_runs.py::test_metrics_resume, test_bad_metrics, tests/test_fuzz.py::test_run_folders
    """
    lines = _whole_lines(path)
    header, rows = (lines[0], lines[1:]) if lines else ([], [])
    columns = {name: np.empty(len(rows)) for name in header}
    if len(columns) < len(header):
        raise UserError(f"{path} line 1: column {_twice(header)[:40]!r} is there twice; valid: once each")
    for i, row in enumerate(rows):
        for name, cell in zip(header, row, strict=True):
            try:
                columns[name][i] = parse_number(cell) if cell else np.nan
            except ValueError:
                valid = "is not a number; valid: a number, or nothing"
                raise UserError(f"{path} line {i + 2}, column {name[:40]}: {cell[:40]!r} {valid}") from None
    return columns


def parse_number(word) -> float:
    """float(word), but without Python's own 1_000.  ValueError: no number"""
    if "_" in word:
        raise ValueError(f"{word[:40]!r} is no number")
    return float(word)


def _whole_lines(path):
    """The complete rows of a CSV file, header first."""
    expected = f"the {METRICS} of a run"
    text = read_text(path, expected)
    try:
        lines = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1]), strict=True))
    except csv.Error as error:
        raise UserError(f"{path}: no CSV: {error}; expected {expected}") from None
    for i, line in enumerate(lines):
        if len(line) != len(lines[0]):
            raise UserError(f"{path} line {i + 1} has {len(line)} cells; valid: {len(lines[0])}, as in the header")
    return lines


def _csv(cells):
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


class Progress:
    """One line per update: share done, the numbers given, time spent and time left.

    Args      total : amount of work; start : work done before this launch; unit : its name; stream : None is stdout
    Test      tests/test_runs.py::test_progress
    """

    def __init__(self, total, start=0, unit="steps", stream=None):
        self.total, self.start, self.unit, self.stream = total, start, unit, stream
        self.began = time.perf_counter()

    def line(self, done, values):
        """The text for `done` work and `values`, an ordered dict of name -> formatted text."""
        spent, fresh = time.perf_counter() - self.began, done - self.start
        left = fmt_time(spent * (self.total - done) / fresh) if fresh > 0 else "?"
        share = min(100 * done / max(self.total, 1), 100)
        head = f"{share:5.1f}% {fmt_count(done)}/{fmt_count(self.total)} {self.unit}"
        return "  ".join([head, *(f"{k} {v}" for k, v in values.items()), f"{fmt_time(spent)} spent, {left} left"])

    def update(self, done, values):
        """Print that line."""
        print(self.line(done, values), file=self.stream or sys.stdout, flush=True)


def fmt_time(seconds):
    """Seconds as 42s, 3m07s, 2h05m or 1d03h."""
    s = max(round(seconds), 0)
    for big, small, unit, sub in ((86400, 3600, "d", "h"), (3600, 60, "h", "m"), (60, 1, "m", "s")):
        if s >= big:
            return f"{s // big}{unit}{s % big // small:02d}{sub}"
    return f"{s}s"


def fmt_count(n):
    """A count as 950, 12.3k, 1.2M or 3.4G."""
    for scale, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(n) >= scale:
            return f"{n / scale:.1f}{unit}"
    return str(round(n))

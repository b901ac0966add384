"""What every long run shares: command line, run folder, checkpoints, metrics, progress.

A run is one folder:

    config.json           what was asked for, and the versions and commit that ran it
    checkpoint.npz        the newest state; checkpoint.prev.npz is the one before
    metrics.csv           one row per update, cut back to the checkpoint on resume

Every file is written to a temporary name and renamed, so a run killed at any moment resumes from its last good
checkpoint. NumPy's BLAS starts threads of its own: where the physics is threaded too, set OMP_NUM_THREADS=1 in the
shell before Python starts, or they compete for the same cores.
"""

from __future__ import annotations

import csv
import dataclasses
import fnmatch
import io
import json
import os
import platform
import signal
import subprocess
import sys
import time
import types
import typing
import zipfile
from importlib import metadata
from pathlib import Path

import numpy as np

from plumbing.cli import UserError
from plumbing.files import (
    CHECKPOINT,
    CONFIG,
    METRICS,
    PREVIOUS,
    RUN,
    atomic_write,
    parse_json,
    parse_number,
    read_arrays,
    read_text,
    twice,
)


class StopFlag:
    """Ctrl-C or SIGTERM ends a run after the present update, with a checkpoint; a second one at once.

    Test      tests/robustness/test_killed.py::test_interrupt_ends_with_a_checkpoint,
              tests/skeletal/test_skeletal_play.py::test_interrupt,
              tests/drop/test_drop_vae.py::test_interrupt
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

    Args      resume : is one to be continued?  None: of a command that cannot
    Raises    UserError: a run is there already and resume is False, or the folder cannot be made; or none is there and
              resume is True, or its metrics.csv cannot be continued
    Test      tests/plumbing/test_runs.py::test_open_run, tests/robustness/test_fuzz.py::test_run_folders
    """
    out = Path(out)
    there = any((out / name).exists() for name in RUN)
    if there and not resume:
        go_on = "" if resume is None else "add --resume to continue it, or "
        raise UserError(f"{out} already holds a run: {go_on}choose another folder")
    if resume and not there:
        raise UserError(f"{out} holds no run to resume: leave out --resume, or name a folder that has {CONFIG}")
    if resume and (out / METRICS).exists():
        _whole_lines(out / METRICS)
    above = next(p for p in (out, *out.absolute().parents) if p.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise UserError(f"cannot create the run folder {out}: {above} is no folder that can be written to")


def open_run(out, config, resume=False):
    """Create the run folder, or reopen it to resume, and write config.json.

    On resume the earlier launches stay in config.json under "earlier", and temporary leftovers are removed.

    Args      out : folder; config : dict or dataclass; resume : bool
    Returns   Path of the folder
    Raises    UserError: a run is there already and resume is False; or none is there and resume is True
    Test      tests/plumbing/test_runs.py::test_open_run
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

    Test      tests/plumbing/test_runs.py::test_open_run, tests/robustness/test_fuzz.py::test_run_folders"""
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
    Test      tests/plumbing/test_runs.py::test_stored_options, tests/robustness/test_fuzz.py::test_run_folders
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


def save_checkpoint(path, arrays, meta):
    """Write arrays and meta to one .npz, whole or not at all.

    A file named checkpoint.npz moves to checkpoint.prev.npz first; any other name is replaced.

    Args      path : file; arrays : dict of name -> array, no objects; meta : dict that JSON can hold
    Raises    ValueError: an object array, or the name __meta__; UserError: the folder cannot be written
    Test      tests/plumbing/test_runs.py::test_checkpoint_round_trip,
              tests/robustness/test_killed.py::test_killed_while_writing
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
    Test      tests/plumbing/test_runs.py::test_checkpoint_round_trip, test_damaged_checkpoints
    """
    expected = f"expected a policy (.npz), or {CHECKPOINT} of a run folder, as training writes them"
    if not Path(path).is_file():
        raise UserError(f"no checkpoint {path}: {expected}")
    arrays = read_arrays(path, expected)
    if "__meta__" not in arrays:
        raise UserError(f"cannot read checkpoint {path} (no __meta__ entry): {expected}")
    try:
        meta = parse_json(arrays.pop("__meta__").tobytes())
    except (ValueError, MemoryError) as error:
        raise UserError(f"cannot read checkpoint {path} ({type(error).__name__}: {error}): {expected}") from None
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


def latest_checkpoint(folder, finite=()):
    """Load the newest readable checkpoint of a run folder.

    Falls back to checkpoint.prev.npz, with a printed note, when the newest is missing or damaged.

    Returns   (arrays, meta), or None when the run wrote no checkpoint yet
    Raises    UserError: there are checkpoints and none is readable
    Test      tests/plumbing/test_runs.py::test_latest_falls_back
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
    Test      tests/plumbing/test_runs.py::test_rng_state_is_exact
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
    Test      tests/plumbing/test_runs.py::test_metrics_resume
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
    Test      tests/plumbing/test_runs.py::test_metrics_resume, test_bad_metrics,
              tests/robustness/test_fuzz.py::test_run_folders
    """
    lines = _whole_lines(path)
    header, rows = (lines[0], lines[1:]) if lines else ([], [])
    columns = {name: np.empty(len(rows)) for name in header}
    if len(columns) < len(header):
        raise UserError(f"{path} line 1: column {twice(header)[:40]!r} is there twice; valid: once each")
    for i, row in enumerate(rows):
        for name, cell in zip(header, row, strict=True):
            try:
                columns[name][i] = parse_number(cell) if cell else np.nan
            except ValueError:
                valid = "is not a number; valid: a number, or nothing"
                raise UserError(f"{path} line {i + 2}, column {name[:40]}: {cell[:40]!r} {valid}") from None
    return columns


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
    Test      tests/plumbing/test_runs.py::test_progress
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


class Means:
    """Means of the numbers that have come since the last line.

    Test      tests/plumbing/test_runs.py::test_means"""

    def __init__(self):
        self.sums, self.count = {}, 0

    def add(self, values):
        """One more of each, a dict of name -> number; a name may be missing now and then."""
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        self.count += 1

    def take(self):
        """name -> mean over all that were added; then it begins anew."""
        means = {name: total / self.count for name, total in self.sums.items()}
        self.sums, self.count = {}, 0
        return means


class Journal:
    """What stands around a training loop: the run's folder, metrics.csv, progress, checkpoints, Ctrl-C.

        with Journal(…) as journal:
            while steps < total and not journal.stop:
                …
                journal.write(steps, row, line)

    Args      out, config, resume : as `open_run`; rows : of the checkpoint that is continued, or None
              save : function of the number of rows, writes a checkpoint: after a line where the last one is `seconds`
                  old, and at the end unless an exception is the end
    Test      tests/plumbing/test_runs.py::test_journal
    """

    def __init__(self, out, config, resume, rows, progress: Progress, save, seconds):
        self.metrics = Metrics(open_run(out, config, resume) / METRICS, rows)
        self.progress, self.save, self.seconds = progress, save, seconds
        self.flag, self.saved = StopFlag(), time.monotonic()

    @property
    def stop(self):
        """Has a signal asked for the end?"""
        return self.flag.stop

    def __enter__(self):
        self.flag.__enter__()
        return self

    def write(self, done, row, line):
        """One row of metrics.csv, one line of progress, and a checkpoint if it is time."""
        self.metrics.append(row)
        self.progress.update(done, line)
        if time.monotonic() - self.saved >= self.seconds:
            self.save(self.metrics.rows)
            self.saved = time.monotonic()

    def __exit__(self, error, *_):
        try:
            if error is None:
                self.save(self.metrics.rows)
        finally:
            self.flag.__exit__()
            self.metrics.close()


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

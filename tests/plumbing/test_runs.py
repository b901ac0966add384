"""Runs: the command line, whole files, checkpoints that survive a kill, metrics that continue exactly."""

import json
import os
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plumbing import runs
from plumbing.cli import ALL_POSITIVE, MESSAGE, POSITIVE, UserError, arg, cli, run_main
from plumbing.files import atomic_write, kind_of, open_regular, parse_json, read_text, read_toml

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Options:
    character: str = arg("jesse", "who, 100% of the time", choices=("jesse", "mousey"))
    steps: int = arg(1000, "how many", check=POSITIVE)
    learning_rate: float = arg(3e-4, "step size", check=POSITIVE)
    hidden: tuple[int, ...] = arg((256, 128), "layer sizes", check=ALL_POSITIVE)
    limit: int | None = arg(None, "at most")
    resume: bool = arg(False, "continue")
    normalise: bool = arg(True, "scale the observation")
    out: Path | None = arg(None, "folder", flag="--output-folder")


def parse(*argv):
    return cli(Options, list(argv), "tool", "a tool")


def test_cli_reads_every_kind():
    assert parse() == Options()
    assert parse("--steps", "1e6").steps == 1_000_000
    assert parse("--learning_rate=0.1") == parse("--learning-rate", "0.1")
    assert parse("--hidden", "512, 64,1").hidden == (512, 64, 1)
    assert parse("--limit", "7").limit == 7 and parse("--limit", "none").limit is None
    assert parse("--resume").resume and not parse("--no-resume").resume and not parse("--no-normalise").normalise
    assert parse("--output_folder", "a_b/c").out == Path("a_b/c")
    assert parse("--character=mousey").character == "mousey"


@pytest.mark.parametrize(
    "argv, words",
    [
        (["--step", "3"], ["--step", "--steps"]),
        (["--steps", "-3"], ["--steps", "greater than 0"]),
        (["--steps", "1.5"], ["--steps", "1.5"]),
        (["--steps", "1e30"], ["--steps", "below 1e18"]),
        (["--learning-rate", "nan"], ["--learning-rate", "greater than 0"]),
        (["--learning_rate", "fast"], ["--learning-rate", "fast"]),
        (["--hidden", ""], ["--hidden", "256,128"]),
        (["--hidden", "3,x"], ["--hidden", "3,x"]),
        (["--character", "bob"], ["--character", "jesse", "mousey"]),
        (["stray"], ["stray"]),
    ],
)
def test_cli_refuses(argv, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        parse(*argv)
    text = capsys.readouterr().err
    assert stopped.value.code == 2 and text.count("\n") == 1
    assert all(word in text for word in words), text


def test_help_shows_every_flag_and_default(capsys):
    with pytest.raises(SystemExit) as stopped:
        parse("--help")
    text = " ".join(capsys.readouterr().out.split())
    assert stopped.value.code == 0
    for words in ("--steps", "(default: 1000)", "--no-resume", "(default: 256,128)", "(default: none)", "100% of"):
        assert words in text
    assert text.count("(default:") == 8


@pytest.mark.parametrize(
    "error, code, told",
    [
        (None, 0, ""),
        (UserError("bad\nfile"), 2, "error: bad file\n"),
        (MemoryError("8 TiB"), 2, "error: not enough memory: 8 TiB; give smaller numbers\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_run_main(error, code, told, capsys):
    def main(argv):
        if error is not None:
            raise error

    with pytest.raises(SystemExit) as stopped:
        run_main(main, [])
    assert stopped.value.code == code
    assert capsys.readouterr().err == told


def test_broken_pipe():
    """`… | head` ends a command without a word."""
    code = "from plumbing.cli import run_main; run_main(lambda argv: [print('line') for _ in range(10**5)] and None)"
    command = f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} | head -1"
    done = subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "line\n" and done.stderr == ""


def test_user_error_is_one_line():
    """Line ends of any kind, control characters, and a list of a megabyte: still one line that a terminal can print."""
    assert str(UserError("a\n b\tc\u2028d\x85e")) == "a b c d e"
    assert str(UserError("\x1b[2Jgone \x00 \ud800 \u00e9")) == r"\x1b[2Jgone \x00 \ud800 é"
    said = str(UserError("start " + "x" * 10**6 + " end"))
    assert len(said) <= MESSAGE and said.startswith("start ") and said.endswith(" end") and " … " in said
    assert len(str(UserError("\x00" * 10**6))) <= MESSAGE


def test_read_text(tmp_path):
    path = tmp_path / "a.txt"
    for raw in ("é\r\n".encode(), "é\r\n".encode("utf-8-sig")):
        path.write_bytes(raw)
        assert read_text(path, "a text") == "é\r\n"
    cases = {
        "é".encode("utf-16"): "a.txt: UTF-16 text; expected a text, in UTF-8",
        b"one\ntwo \xe9": "a.txt, line 2: byte 0xe9 is not UTF-8; expected a text",
        b"x" * 11: "a.txt: longer than 10 bytes; expected a text",
    }
    for raw, words in cases.items():
        path.write_bytes(raw)
        with pytest.raises(UserError, match=words):
            read_text(path, "a text", limit=10)
    for odd in (tmp_path, tmp_path / "none", "nul\0"):
        with pytest.raises(UserError, match="cannot read .*; expected a text"):
            read_text(odd, "a text")


def test_regular_files(tmp_path):
    """A pipe is not waited for, a device not read without end; a name that cannot be is an OSError or a ValueError."""
    kinds = {"folder": "a folder"} | ({"pipe": "a pipe"} if hasattr(os, "mkfifo") else {})
    (tmp_path / "folder").mkdir()
    if "pipe" in kinds:
        os.mkfifo(tmp_path / "pipe")
    paths = {tmp_path / name: kind for name, kind in kinds.items()}
    paths |= {Path("/dev/zero"): "a device"} if Path("/dev/zero").exists() else {}
    for path, kind in paths.items():
        assert kind_of(path) == kind
        with pytest.raises(OSError, match=f"is {kind}"):
            open_regular(path)
        with pytest.raises(UserError, match=f"cannot read {path}: is {kind}; expected a text"):
            read_text(path, "a text")
    (tmp_path / "file").write_text("x")
    assert kind_of(tmp_path / "file") is None and open_regular(str(tmp_path / "file")).read() == b"x"
    for odd in (tmp_path / "none", "nul\0"):
        with pytest.raises((OSError, ValueError)):
            open_regular(odd)


def test_read_toml(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("[a]\nb = {c = [1, 2.5]}\n")
    assert read_toml(path, "a table") == {"a": {"b": {"c": [1, 2.5]}}}
    bad = {
        "a = \n": r"no TOML: Invalid value \(at line 1, column 5\)",
        "a = 1\na = 2": "no TOML: Cannot overwrite a value",
        "a = " + "[" * 900: "nested more than 16 deep",
        "a = " + "[" * 30 + "]" * 30: "nested more than 16 deep",
        ".".join("a" * 20) + " = 1": "nested more than 16 deep",
        "#" * 2000: "line 1: longer than 1000 characters",
        "#\n" * 40_000: "longer than 65536 bytes",
    }
    for text, words in bad.items():
        path.write_text(text)
        with pytest.raises(UserError, match=f"a.toml.*{words}.*; expected a table"):
            read_toml(path, "a table")


def test_parse_json():
    """What Python's own reader lets through, and no run writes."""
    whole = {"a": [1, 2.5, None, True, {"b": "é"}], "big": 2**127}
    assert parse_json(json.dumps(whole)) == whole
    bad = [
        "NaN",
        "[-Infinity]",
        "1e999",
        '{"a": 1, "a": 2}',
        "[" * 100_000,
        "[" * 20 + "]" * 20,
        "1" * 61,
        "",
        "{",
        "1 2",
    ]
    for text in bad:
        with pytest.raises(ValueError):
            parse_json(text)
    with pytest.raises(ValueError, match="key 'a' is there twice"):
        parse_json(bad[3])


def test_stored_options(tmp_path):
    """config.json comes back as it was; a value of another kind, or out of range, is told with its place."""
    runs.open_run(tmp_path, Options())
    assert Options(**runs.stored_options(Options, tmp_path)) == Options()
    record = runs.read_config(tmp_path)
    odd = dict(
        steps=[0, "7", 1.5, True, None, 2**70], learning_rate=["fast", -1.0, True], hidden=[[], [3, "x"], 5, [0]],
        character=["bob", 3], resume=[1, "yes"], limit=["none", 0.5], out=[3],
    )  # fmt: skip
    for name, values in odd.items():
        for value in values:
            (tmp_path / "config.json").write_text(json.dumps({"config": record["config"] | {name: value}}))
            with pytest.raises(UserError, match=f"config.json: {name} = .* is not valid; it must be "):
                runs.stored_options(Options, tmp_path)
    (tmp_path / "config.json").write_text(
        json.dumps({"config": {"steps": 5, "limit": 3, "learning_rate": 1, "more": []}})
    )
    assert runs.stored_options(Options, tmp_path) == {"steps": 5, "limit": 3, "learning_rate": 1}


def test_atomic_write(tmp_path):
    path = tmp_path / "a.txt"
    atomic_write(path, "one")
    atomic_write(path, b"two", previous=tmp_path / "b.txt")
    assert path.read_text() == "two" and (tmp_path / "b.txt").read_text() == "one"

    def half(file):
        file.write(b"thr")
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError):
        atomic_write(path, half)
    assert path.read_text() == "two"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.txt"]
    with pytest.raises(UserError, match="nowhere"):
        atomic_write(tmp_path / "nowhere" / "a.txt", "x")


def test_open_run(tmp_path):
    out = tmp_path / "deep" / "run"
    with pytest.raises(UserError, match="--resume"):
        runs.open_run(out, {}, resume=True)
    assert runs.open_run(out, Options()) == out
    record = runs.read_config(out)
    assert record["config"]["hidden"] == [256, 128] and record["versions"]["mujoco"] and record["earlier"] == []
    assert set(record["git"]) == {"commit", "dirty"}
    with pytest.raises(UserError, match="--resume"):
        runs.open_run(out, {})
    (out / "checkpoint.tmp-1-ab.npz").write_bytes(b"half")
    runs.open_run(out, {"steps": np.int64(3)}, resume=True)
    record = runs.read_config(out)
    assert record["config"] == {"steps": 3} and record["earlier"][0]["config"]["steps"] == 1000
    assert [p.name for p in out.iterdir()] == ["config.json"]
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file"):
        runs.open_run(tmp_path / "file" / "run", {})
    (out / "config.json").write_text("{")
    with pytest.raises(UserError, match="config.json"):
        runs.open_run(out, {}, resume=True)


def test_git_state_outside_a_repository(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert runs.git_state(tmp_path) == {"commit": None, "dirty": None}


ARRAYS = {
    "policy.W0": np.arange(6, dtype=np.float32).reshape(2, 3).T,
    "file": np.array(3),
    "names": np.array(["a", "bc"]),
    "empty": np.zeros((0, 4)),
}


def test_checkpoint_round_trip(tmp_path):
    path = tmp_path / "checkpoint.npz"
    runs.save_checkpoint(path, ARRAYS, {"step": np.int64(7), "list": [1, 2]})
    arrays, meta = runs.load_checkpoint(path, finite=["policy.*", "empty"])
    assert meta == {"step": 7, "list": [1, 2]} and arrays.keys() == ARRAYS.keys()
    for name, value in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], value)
        assert arrays[name].dtype == value.dtype
    with np.load(path, allow_pickle=False) as plain:  # an ordinary .npz to anyone else
        assert json.loads(bytes(plain["__meta__"]))["step"] == 7
    first = path.read_bytes()
    runs.save_checkpoint(path, ARRAYS, {"step": 7, "list": [1, 2]})
    assert path.read_bytes() == first == (tmp_path / "checkpoint.prev.npz").read_bytes()
    runs.save_checkpoint(tmp_path / "jesse.npz", ARRAYS, {})
    runs.save_checkpoint(tmp_path / "jesse.npz", ARRAYS, {})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint.npz", "checkpoint.prev.npz", "jesse.npz"]
    for bad in ({"x": np.array([None])}, {"__meta__": np.zeros(1)}):
        with pytest.raises(ValueError):
            runs.save_checkpoint(path, bad, {})


def damage(path, kind):
    whole = path.read_bytes()
    if kind == "absent":
        path.unlink()
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "text":
        path.write_text("hello")
    elif kind == "flipped":
        middle = whole.index(b"NUMPY") + 130
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    elif kind == "npy":
        with open(path, "wb") as file:
            np.save(file, np.zeros(3))
    else:
        meta = {"no meta": {}, "bad json": {"__meta__": np.frombuffer(b"{x", np.uint8)}}
        meta |= {"list": {"__meta__": np.frombuffer(b"[1]", np.uint8)}, "objects": {"x": np.array([{}], object)}}
        np.savez(path, a=np.zeros(3), **meta[kind])


KINDS = ["absent", "empty", "cut", "text", "flipped", "npy", "no meta", "bad json", "list", "objects"]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_checkpoints(tmp_path, kind):
    path = tmp_path / "x.npz"
    runs.save_checkpoint(path, ARRAYS, {})
    damage(path, kind)
    said = {"empty": r"\(empty\)", "cut": r"\(cut short or damaged\)", "text": r"\(not a zip"}.get(kind, "")
    with pytest.raises(UserError, match=f"x.npz.*{said}.*expected a policy"):
        runs.load_checkpoint(path)


def test_non_finite_checkpoint(tmp_path):
    path = tmp_path / "x.npz"
    runs.save_checkpoint(path, {"a": np.array([1.0, np.nan]), "b": np.zeros(2), "n": np.arange(2)}, {})
    runs.load_checkpoint(path, finite=["b", "n"])
    with pytest.raises(UserError, match="'a' holds NaN"):
        runs.load_checkpoint(path, finite=["*"])
    with pytest.raises(UserError, match="no array 'c'; it has: a, b, n"):
        runs.load_checkpoint(path, finite=["c"])


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_damage_is_a_user_error_or_harmless(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("c") / "x.npz"
    runs.save_checkpoint(path, ARRAYS, {"step": 1})
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw[: data.draw(st.integers(len(raw) // 2, len(raw)))])
    try:
        runs.load_checkpoint(path)
    except UserError:
        pass


def test_latest_falls_back(tmp_path, capsys):
    assert runs.latest_checkpoint(tmp_path) is None
    path = tmp_path / "checkpoint.npz"
    for step in (1, 2):
        runs.save_checkpoint(path, {"a": np.full(2, step)}, {"step": step})
    (tmp_path / "checkpoint.tmp-9-ff.npz").write_bytes(b"half")
    assert runs.latest_checkpoint(tmp_path)[1] == {"step": 2}
    assert capsys.readouterr().err == ""
    damage(path, "cut")
    assert runs.latest_checkpoint(tmp_path)[1] == {"step": 1}
    assert "previous checkpoint" in capsys.readouterr().err
    path.unlink()
    assert runs.latest_checkpoint(tmp_path)[1] == {"step": 1}
    damage(tmp_path / "checkpoint.prev.npz", "text")
    with pytest.raises(UserError, match="no readable checkpoint"):
        runs.latest_checkpoint(tmp_path)


@pytest.mark.parametrize("kind", ["PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"])
def test_rng_state_is_exact(kind):
    rng = np.random.Generator(getattr(np.random, kind)(5))
    rng.spawn(2), rng.normal(size=7), rng.integers(0, 9, dtype=np.uint32)  # a half-used word is part of the state
    copy = runs.rng_from_state(json.loads(json.dumps(runs.rng_state(rng))))
    assert (rng.integers(0, 2**31, 3, np.uint32) == copy.integers(0, 2**31, 3, np.uint32)).all()
    assert (rng.normal(size=100) == copy.normal(size=100)).all()
    assert (rng.spawn(1)[0].normal(size=9) == copy.spawn(1)[0].normal(size=9)).all()


@pytest.mark.parametrize("bad", [{}, None, {"state": {"bit_generator": "os"}, "seeds": None}, {"state": 3, "seeds": 1}])
def test_bad_rng_state(bad):
    with pytest.raises(UserError, match="PCG64"):
        runs.rng_from_state(bad)


def test_means():
    means = runs.Means()
    for values in ({"a": 1.0, "b": 2.0}, {"a": 4.0}, {"a": 1.0, "b": 4.0}):
        means.add(values)
    assert means.count == 3 and means.take() == {"a": 2.0, "b": 2.0}
    assert means.count == 0 and means.take() == {}


def test_journal(tmp_path, capsys, monkeypatch):
    """Rows, lines, checkpoints by the clock and at the end; a signal asks for the end; an error saves nothing."""
    out, saved, now = tmp_path / "run", [], [100.0]
    monkeypatch.setattr(runs.time, "monotonic", lambda: now[0])

    def journal(resume, rows=None):
        return runs.Journal(out, {"steps": 9}, resume, rows, runs.Progress(9), saved.append, 60)

    before = signal.getsignal(signal.SIGTERM)
    with journal(False) as j:
        for step in range(1, 4):
            now[0] += 40.0
            j.write(step, {"step": step, "loss": step / 2}, {"loss": f"{step / 2}"})
            assert len(runs.read_metrics(out / "metrics.csv")["step"]) == step  # at once
        assert saved == [2] and not j.stop  # after 80 s, not after 40 and 120
        os.kill(os.getpid(), signal.SIGTERM)
        assert j.stop
    assert saved == [2, 3] and signal.getsignal(signal.SIGTERM) is before
    assert j.metrics.file.closed and json.loads((out / "config.json").read_text())["config"] == {"steps": 9}
    assert "3/9 steps  loss 1.5" in capsys.readouterr().out
    with pytest.raises(ZeroDivisionError), journal(True, 2) as j:
        j.write(3, {"step": 3, "loss": 7.0}, {})
        raise ZeroDivisionError
    assert saved == [2, 3] and j.metrics.file.closed and signal.getsignal(signal.SIGTERM) is before
    np.testing.assert_array_equal(runs.read_metrics(out / "metrics.csv")["loss"], [0.5, 1.0, 7.0])
    with pytest.raises(UserError, match="already holds a run"):
        journal(False)


def test_metrics_resume(tmp_path, capsys):
    path, straight = tmp_path / "metrics.csv", tmp_path / "straight.csv"
    rows = [{"step": i, "reward": np.float32(i) / 3, "note, x": float("nan")} for i in range(6)]
    metrics = runs.Metrics(straight)
    for row in rows:
        metrics.append(row)
    metrics.close()

    metrics = runs.Metrics(path)
    for row in rows[:4]:
        metrics.append(row)
    with pytest.raises(ValueError, match="loss"):
        metrics.append({"step": 1, "loss": 2})
    assert metrics.rows == 4 and len(runs.read_metrics(path)["step"]) == 4  # each row is there at once
    with open(path, "a") as file:
        file.write("4,1.3")  # killed in the middle of a row
    assert len(runs.read_metrics(path)["step"]) == 4
    metrics = runs.Metrics(path, resume_row=2)
    for row in rows[2:]:
        metrics.append(row)
    assert path.read_bytes() == straight.read_bytes()
    table = runs.read_metrics(path)
    assert list(table) == ["step", "reward", "note, x"] and np.isnan(table["note, x"]).all()
    np.testing.assert_array_equal(table["reward"], [row["reward"] for row in rows])
    with pytest.raises(UserError, match="metrics.csv: the row differs from the header in .*loss"):
        metrics.append({"step": 1, "loss": 2})  # the header was the file's
    runs.Metrics(path, resume_row=9).close()
    assert "6 of the checkpoint's 9" in capsys.readouterr().err
    runs.Metrics(path, resume_row=0).append({"step": 1, "reward": 2, "note, x": 3})
    assert runs.Metrics(path, resume_row=1).rows == 1
    assert runs.Metrics(path).rows == 0 and runs.read_metrics(path) == {}


@pytest.mark.parametrize("text, words", [("a,b\n1\n", "line 2 has 1"), ("a,b\n1,x\n", "line 2, column b: 'x'")])
def test_bad_metrics(tmp_path, text, words):
    path = tmp_path / "metrics.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=words):
        runs.read_metrics(path)
    with pytest.raises(UserError, match="none.csv"):
        runs.read_metrics(tmp_path / "none.csv")


def test_progress(capsys):
    progress = runs.Progress(2_000_000, start=500_000)
    progress.began -= 60
    progress.update(1_000_000, {"reward": "0.71", "kl": "0.01"})
    assert capsys.readouterr().out == " 50.0% 1.0M/2.0M steps  reward 0.71  kl 0.01  1m00s spent, 2m00s left\n"
    assert "? left" in progress.line(500_000, {})
    cases = [(0, "0s"), (59.4, "59s"), (187, "3m07s"), (7500, "2h05m"), (97300, "1d03h")]
    assert [runs.fmt_time(s) for s, _ in cases] == [text for _, text in cases]
    cases = [(7, "7"), (12_345, "12.3k"), (1_200_000, "1.2M"), (-3_400_000_000, "-3.4G")]
    assert [runs.fmt_count(n) for n, _ in cases] == [text for _, text in cases]

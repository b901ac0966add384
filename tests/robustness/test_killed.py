"""Runs that are killed, interrupted or cut short while they write: what is on disk is whole, and they go on exactly."""

import itertools
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from test_ppo import ROOT, TINY, assert_same_run, train

import ppo
from plumbing import runs
from plumbing.runs import CHECKPOINT, METRICS

can_kill = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Six updates without a break."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    train(out, 6)
    return out


def test_resume_from_a_damaged_checkpoint(whole, tmp_path, capsys, monkeypatch):
    """Cut short while it was written: the one before is taken, and the rows after it are made again."""
    out = tmp_path / "a"
    monkeypatch.setattr(ppo, "CHECKPOINT_SECONDS", 0)
    train(out, 4)
    newest = out / CHECKPOINT
    newest.write_bytes(newest.read_bytes()[:-500])
    with open(out / METRICS, "a") as file:
        file.write("5,320,0.1")  # a row that was being written
    (out / "checkpoint.tmp-1-abc.npz").write_bytes(b"half")
    train(out, 6, "--resume")
    assert "previous" in capsys.readouterr().err
    assert not list(out.glob("*.tmp-*"))
    assert_same_run(whole, out)


@can_kill
def test_resume_after_sigkill(tmp_path):
    """Killed among its checkpoints, which it writes after every update, a run continues to the same numbers."""
    out = tmp_path / "killed"
    often = "import sys, ppo; ppo.CHECKPOINT_SECONDS = 0; ppo.main(sys.argv[1:])"
    command = [sys.executable, "-c", often, *TINY, "--steps", "1e9", "--out", str(out)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 600  # a busy machine
        while not ((out / METRICS).exists() and (out / METRICS).read_text().count("\n") > 6):
            assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
            time.sleep(0.003)
    finally:
        process.kill()
        process.communicate()
    meta = runs.latest_checkpoint(out)[1]
    assert meta["updates"] >= 4
    train(out, meta["updates"] + 2, "--resume")
    train(tmp_path / "whole", meta["updates"] + 2)
    assert_same_run(tmp_path / "whole", out)


def test_interrupt_ends_with_a_checkpoint(tmp_path, monkeypatch, capsys, whole, request):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # some shells start their children without
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    lines = itertools.count(1)
    monkeypatch.setattr(runs.Progress, "update", lambda *_: next(lines) == 2 and signal.raise_signal(signal.SIGINT))
    _, meta = train(tmp_path / "a", 6)
    assert meta["updates"] == 2
    assert f"python ppo.py --resume --out {tmp_path / 'a'}" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.setattr(runs.Progress, "update", lambda *_: None)
    train(tmp_path / "a", 6, "--resume")
    assert_same_run(whole, tmp_path / "a")
    monkeypatch.setattr(runs.Progress, "update", lambda *_: [signal.raise_signal(signal.SIGTERM) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):  # the second one: at once
        train(tmp_path / "b", 6)


WRITER = """
import sys, numpy as np, plumbing.runs
step = int(sys.argv[2])
while True:
    step += 1
    plumbing.runs.save_checkpoint(sys.argv[1] + "/checkpoint.npz", {"a": np.full(20_000, step)}, {"step": step})
    print(step, flush=True)
"""


@can_kill
def test_killed_while_writing(tmp_path):
    rng, step = np.random.default_rng(0), 0
    for _ in range(6):
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(tmp_path), str(step)], stdout=subprocess.PIPE, text=True, cwd=ROOT
        )
        writer.stdout.readline()  # the first checkpoint of this launch is written
        time.sleep(rng.uniform(0.0, 0.1))
        os.kill(writer.pid, signal.SIGKILL)
        done = step + 1 + len(writer.stdout.read().split())
        writer.wait()
        arrays, meta = runs.latest_checkpoint(tmp_path)
        assert (arrays["a"] == meta["step"]).all()
        assert done - 1 <= meta["step"] <= done + 1 and meta["step"] > step
        step = meta["step"]
    runs.open_run(tmp_path, {}, resume=True)
    assert not list(tmp_path.glob("*.tmp-*"))

"""The scripts as a user meets them: help, first output, and one clear line for whatever is wrong."""

import dataclasses
import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from test_mocap import walk, write_as
from test_rigs import write_rig

import character
import metrics
import mocap.data
import play
import ppo
import retarget
from env import Env
from extras import losses, policies, users
from mocap import __main__ as mocap_command
from mocap import bvh
from mocap.data import load
from plumbing import render
from plumbing.cli import UserError, run_main
from plumbing.files import check_folders, make_folder
from plumbing.runs import CHECKPOINT, CONFIG, METRICS, load_checkpoint, read_metrics, save_checkpoint
from policy import Policy, load_policy

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = {"mocap": mocap_command, "retarget": retarget, "ppo": ppo, "play": play}
OTHERS = {"metrics": metrics, "policies": policies, "losses": losses, "users": users}
RUNS = ("retarget", "ppo", "play")
TINY = "--recipe none --clips *stand* --envs 4 --horizon 4 --steps 16 --hidden 8 --value-hidden 8 --threads 1".split()


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty current folder: whatever a script writes by default lands in it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(script, *args):
    """The exit code of `python SCRIPT.py ARGS`, run in this process; anything but SystemExit is a traceback."""
    with pytest.raises(SystemExit) as end:
        run_main((SCRIPTS | OTHERS)[script].main, [str(a) for a in args])
    return end.value.code


def refuse(capsys, folder, script, *args):
    """Run what must fail: code 2, one line on stderr, nothing on disk.  -> that line"""
    state = lambda: {p: p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}  # noqa: E731
    before = state()
    capsys.readouterr()
    assert run(script, *args) == 2, args
    err = capsys.readouterr().err
    assert err.endswith("\n") and err.count("\n") == 1 and "Traceback" not in err, err
    assert state() == before
    return err


def small_policy(path, char="jesse"):
    ref = retarget.reference(character.load(char), [load("builtin", clips="stand_007")[0][:10]])
    env = Env(character.load(char), ref, 1, threads=1)
    policy = Policy(env.obs_size, env.critic_size, env.action_size, (8,), (4,), 0.1, 1.0, np.random.default_rng(0))
    save_checkpoint(path, policy.arrays(), {"policy": policy.shape()})
    return path


# ------------------------------------------------------------------------------------ help


@pytest.mark.parametrize("script", RUNS)
def test_help(script, capsys):
    assert run(script, "--help") == 0
    out, err = capsys.readouterr()
    assert err == ""
    text = " ".join(out.split())
    for f in dataclasses.fields(SCRIPTS[script].Options):
        assert re.search(rf"--{f.name.replace('_', '-')}\b", text), f.name
        words = " ".join(f.metadata["help"].split())
        assert words and words.split()[0] in text, f.name
    assert text.count("(default: ") == len(dataclasses.fields(SCRIPTS[script].Options))


def test_help_as_scripts():
    """From the shell, all at once; --help needs no OpenGL, no motion and no policy."""
    commands = [[f"{s}.py", "--help"] for s in SCRIPTS if s != "mocap"]
    commands += [["-m", "mocap", *command, "--help"] for command in ([], ["inspect"], ["fetch"])]
    started = [subprocess.Popen([sys.executable, *c], cwd=ROOT, stdout=-1, stderr=-1, text=True) for c in commands]
    for process, command in zip(started, commands):
        out, err = process.communicate(timeout=60)
        assert process.returncode == 0 and err == "", (command, err)
        assert "usage: " + (command[0] if command[0] != "-m" else "python -m " + command[1]) in out


# ------------------------------------------------------------------------------------ what is wrong is said


@pytest.mark.parametrize("script", SCRIPTS)
def test_unknown_flags(script, here, capsys):
    args = ["inspect", "x"] if script == "mocap" else []
    assert "--colour" in refuse(capsys, here, script, *args, "--colour", "red")


def test_bad_values(here, capsys):
    refuse(capsys, here, "mocap")
    refuse(capsys, here, "mocap", "dance")
    for flag, value in (("--envs", "0"), ("--lr", "-1"), ("--gamma", "2"), ("--steps", "many"), ("--hidden", "8,0")):
        for recipe in ((), ("--recipe", "none")):
            assert flag in refuse(capsys, here, "ppo", *recipe, flag, value)
    assert "did you mean --envs" in refuse(capsys, here, "ppo", "--env", "4")
    assert "window" in refuse(capsys, here, "play", "--view", "hologram")
    assert "train, validation, style" in refuse(capsys, here, "play", "--measure", "--split", "test").replace("'", "")
    assert "nothing to do" in refuse(capsys, here, "play")


@pytest.mark.parametrize("script", RUNS)
def test_wrong_character(script, here, capsys):
    more = ["--measure"] if script == "play" else []
    err = refuse(capsys, here, script, "--character", "jessy", *more)
    assert "no character 'jessy'; there are: " in err and "jesse" in err
    assert f"no file {here / 'absent.toml'}; there are: " in refuse(
        capsys, here, script, "--character", here / "absent.toml", *more
    )
    bad = here / "bob.toml"
    for text, words in (
        ("name = [", "bob.toml"),
        ('name = "bob"', "no table [root]"),
        (b"\xff\xfe", "bob.toml"),
        ((character.CHARACTERS / "jesse.toml").read_text(), "jesse.xml"),  # its model is not beside it
    ):
        bad.write_bytes(text.encode() if isinstance(text, str) else text)
        assert words in refuse(capsys, here, script, "--character", bad, *more)
    (here / "jesse.xml").write_text("<mujoco><worldbody>")
    assert "jesse.xml" in refuse(capsys, here, script, "--character", bad, *more)
    bad.unlink()
    assert "bob.toml" in refuse(capsys, here, script, "--character", bad, *more)


BVH = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\n"


@pytest.mark.parametrize("script", SCRIPTS)
def test_broken_motion(script, here, capsys):
    if script == "mocap":
        check = lambda path: refuse(capsys, here, "mocap", "inspect", path)  # noqa: E731
    else:
        more = ["--measure", "--all", "--policy", small_policy(here / "p.npz")] if script == "play" else []
        check = lambda path: refuse(capsys, here, script, "--motion", path, *more)  # noqa: E731
    assert "nowhere" in check("nowhere")
    bad = here / "bad.bvh"
    whole = write_as(here / "whole.bvh", "bandai", walk(0.2)).read_text()
    (here / "whole.bvh").unlink()
    for text in (
        "",
        "not a motion",
        "HIERARCHY\nROOT a {",
        BVH + "MOTION\nFrames: 1\nFrame Time: 0.1\n0 0 x\n",
        BVH + "MOTION\nFrames: 2\nFrame Time: 0.1\n0 0 0\n",
        BVH + "MOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0\n",  # well made, of an unknown skeleton
        whole[: len(whole) // 2],
        whole.replace("Frame Time: 0.0", "Frame Time: -0.0"),
        "\0\1\2" * 50,
    ):
        bad.write_text(text)
        assert "bad.bvh" in check(bad), text
        assert "bad.bvh" in check(here), text  # in a folder
    bad.unlink()
    (here / "empty").mkdir()
    assert "one that holds .bvh or .amc files" in check(here / "empty")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("what", ["f.bvh", ".", "07_01.amc", "map.toml", "/dev/zero"])
def test_pipes_and_devices(what, here, capsys):
    """None is waited for or read without end: one line says what it is."""
    write_rig(here / "w.bvh", walk(0.5), "mixamo")
    names = {"07_01.amc": "07.asf", "map.toml": "map.toml"}
    if what != "/dev/zero":
        os.mkfifo(here / names.get(what, "f.bvh"))
    if what == "07_01.amc":
        (here / what).write_text("1\nroot 0 0 0 0 0 0\n")
    args = ["w.bvh", "--joint-map", what] if what == "map.toml" else [what]
    old = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("it waits"))
    signal.alarm(20)
    try:
        assert run("mocap", "inspect", *args) == 2
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    kind = "device" if what == "/dev/zero" else "pipe"
    assert re.search(rf"{names.get(what, 'f.bvh' if what == '.' else what)}: is a {kind}; expected ", err), err


def test_make_folder(tmp_path):
    make_folder(None)
    for _ in range(2):  # one that is there is kept
        make_folder(tmp_path / "a")
        assert (tmp_path / "a").is_dir()
    (tmp_path / "b").write_text("mine")
    for path in (tmp_path / "b", tmp_path / "b" / "c", tmp_path / "none" / "d"):
        with pytest.raises(UserError, match=f"cannot make the folder {path}"):
            make_folder(path)
    assert (tmp_path / "b").read_text() == "mine" and not (tmp_path / "none").exists()


def test_folder_to_write(here, capsys, monkeypatch):
    """Said before the slow work: no motion is read."""
    for script, flags in (
        ("retarget", ("--bvh", "--png", "--video")),
        ("play", ("--bvh", "--png", "--video", "--json")),
    ):
        more = ["--measure", "--policy", "none.npz"] if script == "play" else []
        for flag in flags:
            out = here / "no" / ("x.png" if flag == "--png" else "x.bvh")
            err = refuse(capsys, here, script, *more, "--motion", "none", flag, out)
            assert f"cannot write {out}: there is no folder {here / 'no'}" in err
        err = refuse(capsys, here, script, *more, "--motion", "none", "--png", here / "x.tga")
        assert "x.tga is not valid; it must be a name that ends in .png" in err
    monkeypatch.setattr("plumbing.files.os.access", lambda path, how: path != here)  # root may write everywhere
    with pytest.raises(UserError, match="the folder .* is read-only; give another file"):
        check_folders(here / "x.bvh")


def test_nothing_read_is_overwritten(here, capsys):
    """A motion, one in a folder of motions, a link to it, a policy, a stream, and what is read-only: all stay."""
    folder = here / "motion"
    folder.mkdir()
    own, other = folder / "walk_001.bvh", here / "kept.png"
    own.write_text("a motion")
    other.write_text("a picture")
    other.chmod(0o444)
    (here / "link.bvh").symlink_to(own)
    policy = small_policy(here / "p.npz")
    for script, *flags in (
        ("retarget", "--motion", own, "--bvh", own),
        ("retarget", "--motion", f"builtin,{folder}", "--bvh", own),
        ("retarget", "--motion", own, "--bvh", here / "link.bvh"),
        ("play", "--motion", folder, "--bvh", own, "--policy", policy),
        ("play", "--video", policy, "--policy", policy),
        ("play", "--stream", own, "--bvh", own),
    ):
        assert f"cannot write {flags[3] if flags[2] != '--policy' else flags[1]}: it is read from" in refuse(
            capsys, here, script, *flags
        )
    assert "it is read-only; give another file" in refuse(capsys, here, "retarget", "--motion", own, "--png", other)
    assert own.read_text() == "a motion" and other.read_text() == "a picture"


def test_outputs_that_are_inputs(here, capsys):
    """Files that are read and what is there in folders that are stay; a run's folder takes pictures and tables."""
    takes, run_folder = here / "takes", here / "run"
    for file in (takes / "a.csv", run_folder / CHECKPOINT, run_folder / CONFIG, run_folder / "t.json", here / "t.json"):
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")
    a, b, own = small_policy(here / "a.npz"), small_policy(here / "b.npz"), run_folder / CHECKPOINT
    (here / "own.npz").symlink_to(a)
    for script, *flags, out in (
        ("metrics", "--compare", a, b, "--json", a),
        ("metrics", "--policy", a, "--json", here / "own.npz"),
        ("policies", "ship", a, a),
        ("policies", "ship", run_folder, own),
        ("policies", "blend", a, b, a),
        ("losses", "--characters", "jesse", "--stream", takes, "--json", takes / "a.csv"),
        ("losses", "--characters", "jesse", "--motion", takes, "--json", takes / "a.csv"),
        ("losses", "--characters", "jesse", "--json", character.CHARACTERS / "jesse.npz"),
        ("users", "--characters", "jesse", "--json", character.CHARACTERS / "jesse.npz"),
    ):
        assert f"cannot write {out}: it is read from" in refuse(capsys, here, script, *flags, out), flags
    (run_folder / "p.npz").write_text("mine")
    written = run_folder / "t.json", run_folder / "p.npz", here / "t.json", takes / "new.csv", None
    check_folders(*written, read=[takes, run_folder, None])
    check_folders(here / "t.json", read=[here])  # once more
    for out in (own, run_folder / CONFIG):
        with pytest.raises(UserError, match="it is read from"):
            check_folders(out, read=[run_folder])
    for script in ("metrics", "losses"):
        assert f"cannot write {takes}: it is a folder; give a file" in refuse(capsys, here, script, "--json", takes)


def test_names_too_long(here, capsys):
    """A name that no system takes is one line, wherever it is given; data sets are parted however many they are."""
    long = 300 * "x"
    for script, *flags in (
        ("metrics", "--motion", long),
        ("metrics", "--policy", long),
        ("metrics", "--character", long),
        ("metrics", "--json", long),
        ("play", "--png", f"{long}.png"),
        ("mocap", "inspect", long),
        ("losses", "--characters", "jesse", "--stream", long),
        ("policies", "ship", long, "y.npz"),
        ("ppo", "--out", long),
    ):
        assert "File name too long" in refuse(capsys, here, script, *flags), flags
    assert mocap.data.parts(",".join(["builtin"] * 50)) == ["builtin"] * 50


@pytest.mark.parametrize("script", RUNS)
def test_no_clip_matches(script, here, capsys):
    more = ["--measure", "--policy", small_policy(here / "p.npz")] if script == "play" else []
    err = refuse(capsys, here, script, "--clips", "*swim*", *more)
    assert "no clip matches '*swim*'" in err and "walk" in err


def test_too_short(here, capsys, monkeypatch):
    """Two frames are a motion, and no place to start from."""
    short = [load("builtin", clips="stand_007")[0][:2]]
    monkeypatch.setattr(mocap.data, "load", lambda *_, **__: short)  # under every script that makes sequences
    assert "three frames" in refuse(capsys, here, "ppo", *TINY, "--out", here / "run")
    policy = small_policy(here / "p.npz")
    assert "three frames" in refuse(capsys, here, "play", "--measure", "--policy", policy)


def test_broken_policy(here, capsys):
    bad = here / "bad.npz"
    good = small_policy(here / "good.npz").read_bytes()
    (here / "good.npz").unlink()
    np.savez(bad, a=np.zeros(3))
    foreign = bad.read_bytes()
    for content in (b"", b"PK\3\4 no zip", good[: len(good) // 2], foreign):
        bad.write_bytes(content)
        assert "bad.npz" in refuse(capsys, here, "play", "--measure", "--policy", bad)
        assert "bad.npz" in refuse(capsys, here, "ppo", *TINY, "--init", bad, "--out", here / "run")
    for missing in (here / "none.npz", here):  # a folder without a checkpoint
        assert str(missing) in refuse(capsys, here, "play", "--measure", "--policy", missing)
        assert str(missing) in refuse(capsys, here, "ppo", *TINY, "--init", missing, "--out", here / "run")


def test_broken_run_folder(here, capsys):
    out = here / "run"
    assert "run" in refuse(capsys, here, "ppo", "--resume", "--out", out)  # nothing there
    assert run("ppo", *TINY, "--out", out) == 0
    assert "already holds a run" in refuse(capsys, here, "ppo", *TINY, "--out", out)
    assert "--lr 0.0001" in refuse(capsys, here, "ppo", "--resume", "--out", out, "--lr", "1")
    config = (out / CONFIG).read_text()
    for text in ("", "{", "[]", '{"config": 3}'):
        (out / CONFIG).write_text(text)
        assert CONFIG in refuse(capsys, here, "ppo", "--resume", "--out", out)
    (out / CONFIG).write_text(config)
    assert run("ppo", "--resume", "--out", out, "--steps", 32) == 0
    (here / "file").write_text("")
    assert "file" in refuse(capsys, here, "ppo", *TINY, "--out", here / "file" / "run")


# ------------------------------------------------------------------------------------ what works


def test_mocap_inspect(tmp_path):
    path = write_as(tmp_path / "walk_001.bvh", "bandai", walk(1.0, 60.0))
    done = subprocess.run([sys.executable, "-m", "mocap", "inspect", path], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    first, *_, last = done.stdout.splitlines()
    assert first == f"{path}: rig bandai, {len(done.stdout.splitlines()) - 2} joints"
    assert re.search(r"\n +LowerLeg_L +shin_l\n", done.stdout)
    assert re.search(
        r"walk_001 +60.0 Hz +60 frames +1.0 s .* m/s +contact L +\d+ % R +\d+ % .*footfalls +"
        r"balls \d\.\d cm up in contact +hips 0\.",
        last,
    )


def test_any_bvh(here, capsys):
    """A rig of other names, through every script that reads motion; what was guessed goes to stderr, once."""
    write_rig(here / "walk.bvh", walk(2.0), "mixamo", unit=1.0, up="z")
    assert run("mocap", "inspect", "walk.bvh") == 0
    out, err = capsys.readouterr()
    assert "rig guessed, " in out and re.search(r"mixamorig:LeftLeg +shin_l\n", out)
    assert "thigh_r <- mixamorig:RightUpLeg" in err and "z is up" in err and "unit m:" in err and err.count("\n") == 3
    assert run("retarget", "--motion", "walk.bvh", "--bvh", "jesse.bvh") == 0
    assert "jesse.bvh" in capsys.readouterr().out and len(bvh.read("jesse.bvh").values) == 60
    (here / "map.toml").write_text('unit = "m"\n[joints]\nhead = "mixamorig:Skull"\n')
    for script in ("mocap", "retarget"):
        args = ["inspect", "walk.bvh"] if script == "mocap" else ["--motion", "walk.bvh"]
        err = refuse(capsys, here, script, *args, "--joint-map", "map.toml")
        assert "map.toml: head = 'mixamorig:Skull'" in err and "mixamorig:Head" in err
        assert "--unit 'ell'" in refuse(capsys, here, script, *args, "--unit", "ell")
        assert "--up 'w'" in refuse(capsys, here, script, *args, "--up", "w")
        assert "nowhere.toml" in refuse(capsys, here, script, *args, "--joint-map", "nowhere.toml")


def test_play_bvh(here, capsys, monkeypatch):
    """What the character did, frame for frame."""
    monkeypatch.setattr(mocap.data, "sequences", lambda *_, **__: [load("builtin", clips="stand_007")[0][:20]])
    policy = small_policy(here / "p.npz")
    assert run("play", "--policy", policy, "--bvh", "did.bvh", "--threads", 1) == 0
    lived = re.search(r"lived (\d\.\d) s", capsys.readouterr().out)
    b = bvh.read("did.bvh")
    assert len(b.values) - 1 == pytest.approx(30 * float(lived[1]), abs=1.6) and b.names[0] == "pelvis"
    assert "no folder" in refuse(capsys, here, "play", "--policy", policy, "--bvh", "no/did.bvh")


def test_fetch_refuses(here, capsys):
    assert "bandai" in refuse(capsys, here, "mocap", "fetch", "mixamo")
    assert "http://" in refuse(capsys, here, "mocap", "fetch", "bandai", "--url", "somewhere")
    assert "127.0.0.1:9" in refuse(capsys, here, "mocap", "fetch", "bandai", "--url", "http://127.0.0.1:9")


def test_retarget(here, capsys):
    assert run("retarget", "--clips", "*_00[57]") == 0
    out = capsys.readouterr().out
    assert re.search(r"jesse: hips 0\.\d+ m, \d+ hinges, \d+ driven, [\d.]+ kg", out)
    assert "walk_005" in out and "stand_007" in out and "mean of 2: slide" in out
    assert not list(here.iterdir())


def test_ppo(tmp_path):
    """With no option but a folder it trains at once; Ctrl-C ends it with a checkpoint and says how to go on."""
    out, began = tmp_path / "run", time.monotonic()
    env = os.environ | {"OMP_NUM_THREADS": "1"}  # as plumbing/runs.py advises: on a busy machine BLAS threads only wait
    command = [sys.executable, "-u", "ppo.py", "--out", str(out)]
    process = subprocess.Popen(command, cwd=ROOT, env=env, stdout=-1, stderr=-1, text=True)
    guard = threading.Timer(60, process.kill)
    guard.start()
    try:
        lines = []
        while not (lines and "steps/s" in lines[-1]):
            lines.append(process.stdout.readline())
            assert lines[-1], process.stderr.read()
        waited = time.monotonic() - began
        process.send_signal(signal.SIGINT)
        rest, err = process.communicate(timeout=60)
    finally:
        guard.cancel()
        process.kill()
    assert waited < 40, f"the first progress line came after {waited:.0f} s"
    assert process.returncode == 0 and "Traceback" not in err, err
    assert "jesse: " in "".join(lines) and re.search(r"^ +\d\.\d% .* steps .* spent, .* left$", lines[-1].rstrip())
    assert f"continue with: python ppo.py --resume --out {out}" in rest
    config = json.loads((out / CONFIG).read_text())
    assert config["config"]["character"] == "jesse" and config["config"]["motion"] == "builtin"
    meta = load_checkpoint(out / CHECKPOINT, ("policy.*",))[1]
    metrics = read_metrics(out / METRICS)
    assert meta["updates"] == meta["rows"] == len(metrics["update"]) >= 1
    samples = config["config"]["envs"] * config["config"]["horizon"]
    assert metrics["steps"][-1] == meta["steps"] == samples * meta["updates"]
    assert not list(out.glob("*.tmp-*"))


def test_ppo_default_folder(here, capsys):
    assert run("ppo", *TINY) == 0
    assert sorted(p.name for p in (here / "runs" / "jesse").iterdir()) == [CHECKPOINT, CONFIG, METRICS]
    assert "100.0%" in capsys.readouterr().out
    assert run("ppo", "--resume", "--steps", 48) == 0  # the same folder, its own options
    assert read_metrics(here / "runs" / "jesse" / METRICS)["steps"].tolist() == [16, 32, 48]
    policy, meta = load_policy("runs/jesse")
    assert policy.hidden == (8,) and meta["steps"] == 48


@pytest.mark.skipif(render.gl_backend() is None, reason="no OpenGL: neither egl nor osmesa starts here")
def test_play_png(here, capsys, monkeypatch):
    monkeypatch.setattr(mocap.data, "sequences", lambda *_, **__: [load("builtin", clips="stand_007")[0][:20]])
    policy = small_policy(here / "p.npz")
    assert run("play", "--policy", policy, "--png", "sheet.png", "--seconds", 0.5, "--every", 0.25, "--threads", 1) == 0
    out = capsys.readouterr().out
    assert "sheet.png" in out and re.search(r"stand_007: lived 0\.\d s of 0\.5", out)
    data = (here / "sheet.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    assert width > 900 and height >= 360 and len(data) > 20_000  # several pictures, and not of one colour


def test_play_is_as_long_as_asked(here, monkeypatch):
    """A BVH is the whole motion or so many seconds, a picture ten or so many, never more than there are: no training
    episode's 500 steps cut them."""
    clip = load("builtin", clips="walk_105")[0]
    monkeypatch.setattr(mocap.data, "sequences", lambda *_, **__: [clip])
    asked = []

    def simulated(char, ref, act, horizon, *_, **__):
        asked.append(horizon)
        raise UserError("seen")

    monkeypatch.setattr(play, "simulate", simulated)
    whole, policy = len(clip) - 1, small_policy(here / "p.npz")
    assert whole > 700
    for flags, steps in (
        ("--bvh w.bvh", whole), ("--bvh w.bvh --seconds 20", 600), ("--png w.png", 300),
        ("--png w.png --seconds 22", 660), ("--png w.png --bvh w.bvh", whole), ("--png w.png --seconds 99", whole),
    ):  # fmt: skip
        assert run("play", "--policy", policy, *flags.split(), "--threads", 1) == 2
        assert asked.pop() == steps, flags


def test_run_main_reports_only_what_the_user_did(capsys):
    """A mistake of ours is a traceback, and not hidden as a user's."""

    def broken(argv):
        raise ZeroDivisionError("ours")

    with pytest.raises(ZeroDivisionError):
        run_main(broken, [])


@pytest.mark.parametrize(
    "flags, says",
    [
        (
            "--stream x.csv --motion builtin --user-scale 1.2",
            "--motion, --user-scale are of a motion, and --stream has none",
        ),
        ("--measure --axes openxr --realtime", "--axes, --realtime are of --stream FILE"),
    ],
)
def test_play_flags_that_would_do_nothing(flags, says, capsys):
    """Said before anything is read, not passed over."""
    with pytest.raises(SystemExit) as stopped:
        run_main(play.main, flags.split())
    assert stopped.value.code != 0 and says in capsys.readouterr().err

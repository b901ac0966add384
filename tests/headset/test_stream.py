"""Headset streams: columns, axes, losses, calibration, and a character that is driven whatever comes."""

import io
import json
import os
import re
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from test_mocap import walk as make_walk

import character
import metrics
import play
import retarget
from env import Env, headset_only, observation_terms
from headset import calibration
from headset.axes import Watch
from headset.calibration import Calibration, Resampler, Stream
from headset.player import Pace, Player, Ride, drive, ride, source_of, stream_of, tally, ticks_of
from headset.reader import (
    AXES,
    COAST,
    COLUMNS,
    DEVICES,
    GRIP,
    NEUTRAL,
    SEPARATORS,
    UNIT,
    Clock,
    Guard,
    Reader,
    Sample,
    arriving,
    blend,
    column,
    controllers_hang,
    fault,
    from_frame,
    is_live,
    lines_of,
    to_frame,
    to_world,
    valid_columns,
)
from human import (
    heading,
    headset_height,
    place,
    quat_about,
    quat_angle,
    quat_conj,
    quat_matrix,
    quat_mul,
    quat_rotate,
    sensors,
)
from mocap import bvh
from mocap.data import load
from plumbing.cli import UserError, run_main
from plumbing.runs import save_checkpoint
from policy import Policy

ROOT = Path(__file__).resolve().parents[2]
XYZW = lambda q: np.roll(q, -1, axis=-1)  # noqa: E731


@pytest.fixture(scope="module")
def jesse():
    return character.load("jesse")


@pytest.fixture(scope="module")
def walk():
    return make_walk(6.0)


@pytest.fixture
def sensors_dir():
    """The folder of recorded headsets: SENSORS_DIR, or `sensors` beside MOCAP_DIR; skipped without it."""
    name = os.environ.get("SENSORS_DIR")
    if not name and os.environ.get("MOCAP_DIR"):
        name = Path(os.environ["MOCAP_DIR"]).resolve().parent / "sensors"
    if not name or not Path(name).is_dir():
        pytest.skip("no recorded headsets: set SENSORS_DIR to their folder")
    return Path(name)


def standing(seconds=3.0, rate=90.0, height=1.65, seed=0):
    """A user of that headset height who sways, in our axes: list of Sample, w, x, y, z."""
    rng, out = np.random.default_rng(seed), []
    for k in range(round(seconds * rate)):
        t = k / rate
        pos = NEUTRAL + [0.02 * np.sin(t), 0.01 * np.cos(2 * t), height]
        pos[1:] += 0.05 * np.sin(3 * t + np.arange(6).reshape(2, 3)) + 1e-5 * rng.standard_normal((2, 3))
        quat = quat_mul(quat_about(2, 0.1 * np.sin(t + np.arange(3))), quat_about(1, 0.05 * np.cos(t)))
        out.append(Sample(t, pos, quat))
    return out


def guarded(samples, guard=None):
    guard = guard or Guard()
    return [s for sample in samples for s in guard.push(sample)], guard


def with_rows(samples, where, device, pos=None, quat=None):
    """Copies; the rows `where` of a device (index or slice) replaced."""
    out = [Sample(s.t, s.pos.copy(), s.quat.copy()) for s in samples]
    for k in where:
        if pos is not None:
            out[k].pos[device] = pos
        if quat is not None:
            out[k].quat[device] = quat
    return out


def steps(out, device):
    """Largest movement between two samples [m]."""
    return np.linalg.norm(np.diff([s.pos[device] for s in out], axis=0), axis=-1).max()


def to_csv(t, pos, quat, axes="mujoco"):
    """Lines of a file in the axes given, from our axes; the inverse of `to_world` with grip 90."""
    m = AXES[axes]
    out = [",".join(COLUMNS) + "\n"]
    for k in range(len(pos)):
        q = np.concatenate([np.round(np.linalg.det(m)) * (quat[k][:, 1:] @ m), quat[k][:, :1]], axis=1)
        row = np.concatenate([pos[k] @ m / UNIT.get(axes, 1.0), q], axis=1)
        out.append(",".join([f"{t[k]:.9g}", *(f"{v:.9g}" for v in row.ravel())]) + "\n")
    return out


def tiny_policy(char, path, gain=0.01):
    """A policy that fits the character, in a file."""
    obs = sum(observation_terms(char)["actor"].values())
    policy = Policy(obs, obs + 3, len(char.limits), (8,), (8,), 0.1, 1.0, np.random.default_rng(0))
    save_checkpoint(path, policy.arrays(), {"policy": policy.shape()})
    return path


# ------------------------------------------------------------------------------------ reading


def test_columns(tmp_path):
    """Any order, other names, extra columns; complaints name file, line, column and what is valid."""
    values = np.arange(22.0)
    order = np.random.default_rng(0).permutation(22)
    names = [COLUMNS[k] for k in order]
    rows = [",".join([*names, "score"]), ",".join([*(str(values[k]) for k in order), "great"])]
    (sample,) = Reader("x").read(rows)
    assert sample.t == 0 and np.array_equal(np.hstack([sample.pos, sample.quat]).ravel(), values[1:])
    known = {"HMD_pos_x": "head_px", "left_hand_rot_w": "left_qw", " right_controller_z": "right_pz", "t": "time"}
    assert {k: column(k) for k in known} == known and column("right_pz") == "right_pz"
    assert column("\ufefftime".lstrip("\ufeff")) == "time" and column("head_pw") is None
    cases = {
        "time,head_px\n": r"f.csv, line 1: no column head_py, .* more; it has time, head_px; valid: .*DEVICE_px",
        ",".join([*COLUMNS, "left_px"]): "column left_px is there twice",
        "": "is empty",
        b"\x1f\x8b\x08\0\r\xff": "f.csv: is compressed: unpack it; valid",
        "a" * 70000: "longer than 65536 bytes",
        **{
            mark.join(COLUMNS): f"f.csv, line 1: {name} between the columns; valid: commas, and points"
            for mark, name in SEPARATORS.items()
        },
        ",".join(COLUMNS) + "\n" + ",".join(["0,5"] * 22) + "\n": r"column right_qw: 44 cells.*valid: points\)",
        ",".join(COLUMNS) + "\r" + "0," * 30 + "\r": "line 1: line ends of CR alone; valid: LF",
        ",".join(COLUMNS) + "\r" + "0," * 40000: "line 1: line ends of CR alone; valid: LF",
    }
    for text, message in cases.items():
        (tmp_path / "f.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(UserError, match=message):
            list(Reader("f.csv").read(lines_of(tmp_path / "f.csv")))
    with pytest.raises(UserError, match="no such file; valid"):
        list(lines_of(tmp_path / "none.csv"))
    (tmp_path / "d.csv").mkdir()
    with pytest.raises(UserError, match="d.csv: is a folder; valid: a .csv or .bsor file, a named pipe, or -"):
        list(lines_of(tmp_path / "d.csv"))
    assert "head, left, right" in valid_columns()


def test_garbage_lines():
    """A file's garbage is an error with line and column; an empty cell is a lost device; a cut last line is skipped."""
    good = to_csv([0.0, 0.1], *(np.tile(v, (2, 3, 1)) for v in ([0.0, 0, 1], [1.0, 0, 0, 0])))
    bad = good[1].replace("1,", "oops,", 1)
    with pytest.raises(UserError, match=r"f, line 3, column head_pz: 'oops'; valid: a number"):
        list(Reader("f").read([good[0], good[1], bad]))
    with pytest.raises(UserError, match=r"f, line 2, column head_py: 3 cells; valid: 22"):
        list(Reader("f").read([good[0].replace("\n", "\r\n"), "1,2,3\n"]))
    assert len(list(Reader("f").read([good[0], "\n", "# a note\n", good[1], good[2][:20]]))) == 1
    empty = good[1].split(",")
    empty[1], empty[8] = "", "NaN"
    (sample,) = Reader("f").read([good[0], ",".join(empty)])
    assert np.isnan(sample.pos[:2, 0]).all() and np.isfinite(sample.pos[2]).all()


def test_garbage_on_stdin():
    """A live stream survives garbage, but not garbage alone."""
    good = to_csv([0.0, 0.1], *(np.tile(v, (2, 3, 1)) for v in ([0.0, 0, 1], [1.0, 0, 0, 0])))
    reader = Reader("standard input", strict=False)
    assert len(list(reader.read([good[0], b"\xff\xfe\x00 garbage\n", good[1], "1,2\n", good[2]]))) == 2
    assert reader.unreadable == 2
    with pytest.raises(UserError, match="line 101, column"):
        list(Reader("standard input", strict=False).read([good[0], *["x\n"] * 200]))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_pipes(tmp_path, monkeypatch):
    """A named pipe is a live source, read as the lines come; a device is none; permission denied is one line."""
    pipe, lines = tmp_path / "live", lines_in_our_axes(1.5)
    os.mkfifo(pipe)
    assert is_live(pipe) and is_live("-") and not is_live(__file__)

    def write():
        with open(pipe, "w") as file:
            file.write("".join(lines) + lines[1][:30])  # a program that dies in the middle of a line

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    reader = Reader("live", strict=False)
    assert len(list(reader.read(lines_of(pipe)))) == len(lines) - 1 and reader.unreadable == 1
    writer.join(10)
    with pytest.raises(UserError, match="/dev/zero: is a device; valid: a .csv or .bsor file"):
        is_live("/dev/zero")

    def denied(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("builtins.open", denied)
    (good, _), bad = os.path.split(__file__), UserError
    with pytest.raises(bad, match=f"--stream {good}.*: Permission denied; valid: a file that can be read"):
        list(lines_of(__file__))


def timed(times, seconds=3.0):
    """A file of a standing user with another time column."""
    lines = lines_in_our_axes(seconds)
    rows = [line.split(",", 1)[1] for line in lines[1:]]
    return [lines[0], *(f"{t:.15g},{row}" for t, row in zip(times, rows))]


TIMES = {  # name: (seconds of the k-th row, what is said of it)
    "milliseconds": (lambda k: 1000 * k / 90, r"time steps of 11.1 s: milliseconds\?; valid: seconds"),
    "microseconds": (lambda k: 1e6 * k / 90, r"time steps of 1.11e\+04 s: microseconds\?; valid: seconds"),
    "3.3": (lambda k: 3.3 * k, r"time steps of 3.3 s: milliseconds\?; valid: seconds that increase, 10 to 2000 rows"),
    "tenths": (lambda k: 0.1 * k, r"time steps of 0.1 s; valid: seconds"),
    "minutes": (lambda k: k / 5400, r"time steps of 0.000185 s: minutes\?; valid"),
    "constant": (lambda k: 7.0, r"time stands still; valid: seconds that increase, .* or no column time"),
    "backwards": (lambda k: -k / 90, r"time runs backwards, by 0.0111 s a row; valid: seconds that increase"),
}


@pytest.mark.parametrize("kind", TIMES)
def test_time_columns(jesse, kind):
    """Other units, a clock that stands or runs backwards: said by the 12th tracked row, before the character moves."""
    times, words = TIMES[kind]
    lines = timed([times(k) for k in range(200)])
    lost = lines[1].split(",", 1)[0] + "," + ",".join(["0"] * 21) + "\n"
    source, ticks = Stream(jesse, "mujoco"), []
    with pytest.raises(UserError, match=rf"f.csv, line 16, column time: {words}"):
        for sample in Reader("f.csv").read([lines[0], lost, lost, lost, *lines[1:]]):
            ticks += source.push(sample)
    assert not ticks and source.rows == 14


@pytest.mark.parametrize(
    "times",
    [lambda k: k // 3 / 30, lambda k: np.floor(k / 9) / 10, lambda k: k / 1000, lambda k: 1e9 + k / 11,
     lambda k: k / 90 - (k % 50 == 0), lambda k: k / 90 + 4 * (k // 15)],
)  # fmt: skip
def test_good_time_columns(times):
    """Coarse clocks, fast and slow devices, late rows and drop-outs are left to the Clock and the Guard."""
    assert len(list(Reader("f.csv").read(timed([times(k) for k in range(200)])))) == 200


# ------------------------------------------------------------------------------------ axes


def at(axes, pos=(0, 0, 0), turn=(0, 0, 0, 1)):
    """The same pose for all three devices."""
    return to_world(np.tile(np.array(pos, float), (3, 1)), np.tile(np.array(turn, float), (3, 1)), axes, 90)


def test_axes_by_hand():
    """Forward, left, up; a head that turns left, looks up, tilts to the right."""
    units = {
        "unity": [(0, 0, 1), (-1, 0, 0), (0, 1, 0)],
        "openxr": [(0, 0, -1), (-1, 0, 0), (0, 1, 0)],
        "mujoco": np.eye(3),
    }
    for axes, (forward, left, up) in units.items():
        for k, v in enumerate((forward, left, up)):
            assert np.allclose(at(axes, v)[0][0], np.eye(3)[k])
        assert np.allclose(at(axes)[1], [1, 0, 0, 0])
    s, c = np.sin(0.2), np.cos(0.2)
    # left-handed: a positive turn about up goes forward -> right; right-handed: forward -> left
    for axes, turn in {"unity": (0, -s, 0, c), "openxr": (0, s, 0, c), "mujoco": (0, 0, s, c)}.items():
        assert np.isclose(heading(at(axes, turn=turn)[1][0]), 0.4)  # to the left
    for axes, turn in {"unity": (-s, 0, 0, c), "openxr": (s, 0, 0, c), "mujoco": (0, -s, 0, c)}.items():
        assert quat_rotate(at(axes, turn=turn)[1][0], np.array([1.0, 0, 0]))[2] > 0.3  # looks up
    for axes, turn in {"unity": (0, 0, -s, c), "openxr": (0, 0, -s, c), "mujoco": (s, 0, 0, c)}.items():
        assert quat_rotate(at(axes, turn=turn)[1][0], np.array([0.0, 0, 1]))[1] < -0.3  # head to the right shoulder
    with pytest.raises(UserError, match="--axes blender: unknown; valid: unity, openxr, mujoco, openvr, unreal"):
        to_world(np.zeros((3, 3)), np.zeros((3, 4)), "blender")


@pytest.mark.parametrize("axes", AXES)
def test_axes_against_matrices(axes):
    """R' = M R Mᵀ by SciPy's matrices, det +1, and points seen from a device are the same points."""
    rng, m = np.random.default_rng(0), AXES[axes]
    q, p, point = rng.standard_normal((50, 3, 4)), rng.standard_normal((50, 3, 3)), rng.standard_normal(3)
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    pos, quat = to_world(p, q, axes, 90, unit=1.0)
    r = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(50, 3, 3, 3)
    assert np.allclose(quat_matrix(quat), m @ r @ m.T) and np.allclose(np.linalg.det(quat_matrix(quat)), 1)
    assert np.allclose(pos + quat_rotate(quat, np.broadcast_to(m @ point, pos.shape)), (p + r @ point) @ m.T)


def test_grip():
    """What points forward (grip 0) has the fingers, −z of the hand, forward; a grip pose (90) is the hand's own."""
    for grip, fingers in ((0, [1, 0, 0]), (90, [0, 0, -1]), (15, [np.cos(np.pi / 12), 0, -np.sin(np.pi / 12)])):
        _, quat = to_world(np.zeros((3, 3)), np.tile([0.0, 0, 0, 1], (3, 1)), "unity", grip)
        assert np.allclose(quat_rotate(quat[1:], np.tile([0.0, 0, -1], (2, 1))), fingers)
        assert np.allclose(quat[0], [1, 0, 0, 0])
    default = to_world(np.zeros((3, 3)), np.tile([0.0, 0, 0, 1], (3, 1)), "unity")[1]
    assert np.allclose(default, to_world(np.zeros((3, 3)), np.tile([0.0, 0, 0, 1], (3, 1)), "unity", 15)[1])


# ------------------------------------------------------------------------------------ what can go wrong


@pytest.mark.parametrize("axes,grip", [("unity", 15), ("openxr", 90), ("mujoco", 90)])
def test_grip_by_default(axes, grip):
    pos, quat = np.zeros((3, 3)), np.tile([0.0, 0, 0, 1], (3, 1))
    np.testing.assert_allclose(to_world(pos, quat, axes)[1], to_world(pos, quat, axes, grip)[1])


def test_unordered_times():
    """Late rows are dropped, equal times stay, missing times follow the rate."""
    clock = Clock(90)
    assert [clock.stamp(t) for t in (5.0, 5.1, 5.05, 5.2)] == [0.0, pytest.approx(0.1), None, pytest.approx(0.2)]
    assert clock.stamp(5.2) == pytest.approx(0.2) and clock.dropped == 1
    assert clock.stamp(np.nan) == pytest.approx(0.2 + 1 / 90)
    constant = Clock(90)
    assert [constant.stamp(1.0) for _ in range(200)][-1] > 1.5  # a time column that stands still does not stop time


def test_sample_rate(jesse, walk, tmp_path):
    """Rows without times are so many a second, which is said; a rate for rows with times is not used, which is, too."""
    lines, path = to_csv(np.arange(len(walk)) / walk.rate, *sensors(walk)), tmp_path / "a.csv"
    timeless = [line.split(",", 1)[1] for line in lines]
    for text, rate, said in (
        (lines, None, ""),
        (lines, 30.0, "the stream has times: --sample-rate is not used"),
        (timeless, None, "no time column: 90 rows a second (--sample-rate)"),
        (timeless, 30.0, "no time column: 30 rows a second (--sample-rate)"),
    ):
        path.write_text("".join(text))
        pos, _, told = ticks_of(jesse, path, 3, play.Options(axes="mujoco", grip=90.0, sample_rate=rate))
        assert told["notes"] == ([said] if said else []) and (told["axes"], told["grip"]) == ("mujoco", 90.0)
        assert abs(len(pos) - (len(walk) / (3 if text is timeless and not rate else 1) - 30)) <= 2
    short, *_ = ticks_of(jesse, path, 3, play.Options(axes="mujoco", grip=90.0, seconds=0.01))
    assert len(short) == 1


def test_remarks(jesse, walk, tmp_path):
    """Who crouches while calibrating, controllers relative to the headset, a row that is cut: each is said."""
    pos, quat = sensors(walk)
    pos, path = np.concatenate([pos, pos[-1:].repeat(60, 0)]), tmp_path / "a.csv"
    quat, t = np.concatenate([quat, quat[-1:].repeat(60, 0)]), np.arange(len(pos)) / walk.rate
    low, relative = pos.copy(), pos.copy()
    low[: round(1.5 * walk.rate), :, 2] *= 0.55
    relative[:, 1:] -= pos[:, :1]
    for given, end, said in (
        (pos, "\n", []),
        (low, "\n", ["no floor at 0: taken 1.64 m below", "over its place in the first second"]),
        (relative, "\n", ["not relative to the headset"]),
        (pos, "", ["its last line is cut short: left out"]),
    ):
        lines = to_csv(t, given, quat)
        path.write_text("".join(lines)[: None if end else -40])
        notes = ticks_of(jesse, path, 3, play.Options(axes="mujoco", grip=90.0))[2]["notes"]
        assert len(notes) == len(said) and all(any(s in n for n in notes) for s in said), notes


def test_another_clock():
    """One absurd time is one jump there and one back; time goes on by a period."""
    clock = Clock(100)
    out = [clock.stamp(t) for t in (0.0, 0.01, 1e12, 0.03, 0.04, -1e9, 0.06, np.inf)]
    assert np.allclose(np.diff(out), 0.01) and clock.jumps == 4
    assert clock.idle(0.5) == pytest.approx(out[-1] + 0.5) and clock.stamp(77.0) == pytest.approx(out[-1] + 0.51)


def test_faults():
    """Each reason why a row is no pose."""
    row = np.array([0.0, 0, 1.6, 0, 0, 0, 1])
    assert fault(row) is None and fault(np.zeros(7)) == "all zero"
    assert fault(row * np.nan) == fault(row + np.inf) == "not finite"
    assert fault(row * [1, 1, 1, 1, 1, 1, 0.8]) == "no rotation" and fault(row + 1e6) == "far away"
    assert fault(np.full(7, 1e308)) == "far away"


def test_poses():
    """Frames there and back, and the ends of a blend."""
    rng = np.random.default_rng(0)
    poses = [(rng.standard_normal(3), q / np.linalg.norm(q)) for q in rng.standard_normal((2, 4))]
    back = from_frame(poses[0], to_frame(poses[0], poses[1]))
    assert np.allclose(back[0], poses[1][0]) and quat_angle(back[1], poses[1][1]) < 1e-9
    for share, pose in ((0.0, poses[0]), (1.0, poses[1])):
        mixed = blend(*poses, share)
        assert np.allclose(mixed[0], pose[0]) and quat_angle(mixed[1], pose[1]) < 1e-7


def test_clean_stream_is_left_alone():
    """A good stream passes unchanged."""
    samples = standing()
    out, guard = guarded(samples)
    assert len(out) == len(samples) and not guard.events
    for a, b in zip(samples, out, strict=True):
        assert np.allclose(a.pos, b.pos) and quat_angle(a.quat, b.quat).max() < 1e-7


@pytest.mark.parametrize("device", [0, 1, 2])
def test_zero_rows(device):
    """Held, then back to the truth without a jump; counted."""
    lost = range(100, 130)
    samples = with_rows(standing(), lost, device, np.zeros(3), np.zeros(4))
    out, guard = guarded(samples)
    assert steps(out, device) < 0.02
    if device == 0:
        assert all(np.linalg.norm(out[k].pos[0] - out[99].pos[0]) < 0.01 for k in lost)  # it sways, and coasts so far
    assert np.allclose(out[-1].pos, samples[-1].pos) and guard.live(device)
    assert guard.report() == [f"{DEVICES[device]} all zero: 1 time, 0.33 s"]
    first, _ = guarded(with_rows(standing(), range(5), 0, np.zeros(3), np.zeros(4)))
    assert len(first) == len(standing()) - 5  # nothing before the headset is seen


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_nan_rows(value):
    """NaN, infinities and absurd numbers of one device or all; a controller sinks after a second."""
    samples = with_rows(standing(6), range(180, 480), 1, np.full(3, value))
    out, guard = guarded(samples)
    assert np.isfinite([s.pos for s in out]).all() and steps(out, 1) < 0.03
    sunk = out[479].pos[1] - out[479].pos[0]
    turn = quat_about(2, heading(out[479].quat[0]))
    assert np.linalg.norm(sunk - quat_rotate(turn, NEUTRAL[1])) < 0.02
    assert guard.events["left", "far away" if value == 1e300 else "not finite"] == 1
    out, _ = guarded([Sample(s.t, s.pos * np.nan, s.quat) if k > 50 else s for k, s in enumerate(standing())])
    assert np.isfinite([s.pos for s in out]).all()
    assert guarded([Sample(0.0, np.full((3, 3), np.nan), np.zeros((3, 4)))])[0] == []


def test_frozen_sensor():
    """A headset that reports one pose while the hands move is lost after 0.25 s; so is a frozen hand."""
    for device in (0, 2):
        samples = standing()
        samples = with_rows(samples, range(100, 200), device, samples[100].pos[device], samples[100].quat[device])
        out, guard = guarded(samples)
        assert guard.events[DEVICES[device], "frozen"] == 1
        assert guard.seconds[DEVICES[device], "frozen"] == pytest.approx(100 / 90 - 0.25, abs=0.05)
        assert steps(out, device) < 0.02 and guard.live(device)
    first = standing()[0]
    still = [Sample(k / 90, first.pos, first.quat) for k in range(200)]
    assert not guarded(still)[1].events  # all still: nobody moved


def test_drop_out():
    """1 s without rows: held at the control rate, no jump back, the hands where they were."""
    samples = standing(4)
    samples = samples[:120] + [Sample(s.t, s.pos + [0.6, 0, 0], s.quat) for s in samples[210:]]  # walked 0.6 m
    out, guard = guarded(samples)
    assert guard.events["head", "drop-out"] == 1 and not guard.events["head", "teleport"]
    assert np.diff([s.t for s in out]).max() < 0.04
    held = [s for s in out if samples[119].t < s.t < samples[120].t]
    assert len(held) >= 29 and all(np.allclose(s.pos, out[119].pos, atol=0.015) for s in held)  # it sways
    speed = np.linalg.norm(np.diff([s.pos[0] for s in out], axis=0), axis=-1) / np.diff([s.t for s in out])
    assert speed.max() < 2.5 and np.allclose(out[-1].pos, samples[-1].pos)


def test_coast():
    """A headset lost on a walk goes on by v τ (1 − e^{−t/τ}), hands with it; one that stood stays; both come back."""
    calm = [Sample(s.t, NEUTRAL + [0.0, 0.0, 1.65], np.tile([1.0, 0, 0, 0], (3, 1))) for s in standing(4)]
    for speed in (1.2, 0.0):
        samples = [Sample(s.t, s.pos + [0.0, speed * s.t, 0.0], s.quat) for s in calm]
        out, guard = guarded(with_rows(samples, range(180, 270), slice(0, 3), np.zeros(3), np.zeros(4)))
        assert guard.events["head", "all zero"] == 1
        for s in out[180:270]:
            way = speed * COAST * -np.expm1(-(s.t - out[179].t) / COAST)
            np.testing.assert_allclose(s.pos - out[179].pos, np.tile([0.0, way, 0.0], (3, 1)), atol=0.01 * speed + 1e-9)
        assert np.allclose(out[-1].pos, samples[-1].pos) and steps(out, 0) < 0.055  # CATCH_UP, and the user walks on


def test_teleport():
    """3 m and a quarter turn between two rows: the headset goes on from where it was, hands with it; and back."""
    samples, turn = standing(4), quat_about(2, 1.5)
    away = lambda s: Sample(s.t, quat_rotate(np.tile(turn, (3, 1)), s.pos) + [3, 1, 0], quat_mul(turn, s.quat))  # noqa: E731
    moved = [away(s) if 100 <= k < 250 else s for k, s in enumerate(samples)]
    out, guard = guarded(moved)
    assert guard.events["head", "teleport"] == 2 and max(steps(out, d) for d in range(3)) < 0.03
    for a, b in zip(samples, out, strict=True):
        assert np.abs(a.pos - b.pos).max() < 0.01 and quat_angle(a.quat, b.quat).max() < 0.01
    up, guard = guarded([Sample(s.t, s.pos + [0, 0, 3 * (k > 100)], s.quat) for k, s in enumerate(samples)])
    assert guard.events["head", "teleport"] == 1 and steps(up, 0) < 0.02


def test_head_step():
    """0.5 m between two rows is no teleport, and no jump either."""
    samples = [Sample(s.t, s.pos + [0.5 * (k >= 100), 0, 0], s.quat) for k, s in enumerate(standing())]
    out, guard = guarded(samples)
    assert guard.events["head", "step"] == 1 and steps(out, 0) < 0.05 and np.allclose(out[-1].pos, samples[-1].pos)


def test_controller_glitch():
    """A controller that jumps for three rows is not believed; one that stays is, after 0.1 s; beyond an arm never."""
    samples = standing()
    out, guard = guarded(with_rows(samples, range(100, 103), 1, np.array([0.7, 0.3, 1.9])))
    assert guard.events["left", "jump"] == 1 and steps(out, 1) < 0.03
    stay = samples[0].pos[1] + [0.4, 0.0, 0.8]
    moved = [
        Sample(s.t, np.stack([s.pos[0], stay + [0.001 * np.sin(k), 0, 0], s.pos[2]]), s.quat) if k >= 100 else s
        for k, s in enumerate(samples)
    ]
    out, guard = guarded(moved)
    assert guard.seconds["left", "jump"] == pytest.approx(0.1, abs=0.02) and np.allclose(out[-1].pos, moved[-1].pos)
    assert steps(out, 1) < 0.05
    _, guard = guarded(with_rows(samples, range(100, 200), 2, np.array([2.5, 0, 1])))
    assert guard.events["right", "out of reach"] == 1


# ------------------------------------------------------------------------------------ time and size


def test_resampler_against_scipy():
    """Ticks of an irregular stream are SciPy's interpolation at k / 30."""
    rng = np.random.default_rng(0)
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(0.002, 0.05, 300))])
    q = Rotation.random(len(t) * 3, rng=rng).as_quat(scalar_first=True).reshape(-1, 3, 4)
    p = rng.standard_normal((len(t), 3, 3))
    r = Resampler(30)
    out = [s for k in range(len(t)) for s in r.push(Sample(t[k], p[k], q[k]))]
    ticks = np.array([s.t for s in out])
    assert np.allclose(ticks, np.arange(len(out)) / 30) and len(out) == int(t[-1] * 30) + 1
    for d in range(3):
        slerp = Slerp(t, Rotation.from_quat(q[:, d], scalar_first=True))(ticks)
        assert quat_angle(np.array([s.quat[d] for s in out]), slerp.as_quat(scalar_first=True)).max() < 1e-6
        for k in range(3):
            assert np.allclose([s.pos[d, k] for s in out], np.interp(ticks, t, p[:, d, k]))


def test_resampler_is_causal():
    """What comes later does not change what was given out; a tick waits for one sample at most."""
    samples = standing(1.0)
    r = Resampler(30)
    for s in samples:
        ticks = r.push(s)
        assert all(s.t - 1 / 90 - 1e-9 < tick.t <= s.t + 1e-9 for tick in ticks)
    a, b = Resampler(30), Resampler(30)
    for k, s in enumerate(samples[:60]):
        other = s if k < 40 else Sample(s.t, s.pos + 9, s.quat)
        x, y = a.push(s), b.push(other)
        assert k >= 40 or all(np.array_equal(i.pos, j.pos) for i, j in zip(x, y, strict=True))


def test_calibration(jesse):
    """A turned, shifted, raised user of any height stands where the character stands, looking along x."""
    users = ((1.5, 0.0, 2.0), (1.95, 0.0, -3.0), (2.05, 0.0, 1.0), (1.6, -1.6, 0.3), (2.3, 0.0, 0.0))
    for height, raised, yaw in users:
        turn = quat_about(2, yaw)
        pos = np.tile([4.0, -2.0, height + raised], (100, 1)) - np.linspace(0, 0.01, 100)[:, None] * [0, 0, 1]
        c = calibration.calibrate(jesse, pos, np.tile(turn, (100, 1)))
        plausible = raised == 0 and height < 2.1
        assert c.estimated is not plausible and np.isclose(
            c.height, height if plausible else calibration.AVERAGE, atol=0.01
        )
        out = c.apply(Sample(0.0, np.tile(pos[:1], (3, 1)), np.tile(turn, (3, 1))))
        assert np.allclose(out.pos, [0, 0, retarget.headset(jesse)[2]], atol=0.01)
        assert np.allclose(np.abs(out.quat), [1, 0, 0, 0], atol=1e-9)
        ahead = c.apply(Sample(0.0, pos[:1] + quat_rotate(turn, np.array([1.0, 0, 0])), turn[None])).pos[0]
        assert np.allclose(ahead[:2], [1, 0], atol=1e-9)  # travel is not scaled
    told = calibration.calibrate(jesse, pos, np.tile(turn, (100, 1)), user_height=1.7)
    assert told.height == 1.7 and told.floor == pytest.approx(2.3 - 1.7, abs=0.01)


@pytest.mark.parametrize("lost, height, counted", [(0.15, 1.65, 0.6), (2.0, 0.7, 0.0)])
def test_calibration_of_what_is_seen(jesse, lost, height, counted):
    """Half a second is seen, then nothing: that time does not count, and after a long one the second begins again."""
    first, source = standing(0.5, height=height), Stream(jesse, "mujoco")
    for s in [*first, *(Sample(s.t + first[-1].t + lost, s.pos, s.quat) for s in standing(3.0))]:
        source.push(Sample(s.t, s.pos, XYZW(s.quat)))
        if source.calibration:
            break
    back = min(0.3, lost) if counted else 0.95 / 2.0  # s: the Guard's way back from where it was held
    assert s.t - first[-1].t - lost - back == pytest.approx(1.0 - counted, abs=0.05)
    assert source.calibration.height == pytest.approx(1.65, abs=0.02)


def test_calibration_scales_as_training(walk):
    """[root] scale_xy and [sensors] scale_z mean to a stream what they mean to `retarget.sensor_scale`."""
    hips, top = walk.hip_height, headset_height(walk)
    head, turn = np.tile([4.0, -2.0, top], (50, 1)), np.tile([1.0, 0, 0, 0], (50, 1))
    for change in ("root.scale_xy=0.5", "sensors.scale_z=0.7", 'sensors.scale_z="hip"', 'sensors.scale_z="headset"'):
        c = character.load("jesse", set=(change,))
        found, trained = calibration.calibrate(c, head, turn).scale, retarget.sensor_scale(c, hips, top)
        np.testing.assert_allclose(found, trained, rtol=0.01, err_msg=change)  # hips are guessed from the headset


NO_CALIBRATION = {  # name: (row of the headset, of a good one; what is said of 200 such rows)
    "zero": (lambda row: 0 * row, "200 rows show the headset for 0.00 s; .*; of them 200 all zero"),
    "inf": (lambda row: row + np.inf, "of them 200 not finite"),
    "1e308": (lambda row: row * 0 + 1e308, "of them 200 far away: centimetres"),
    "centimetres": (lambda row: row * [100, 100, 100, 1, 1, 1, 1], "of them 200 far away: centimetres. valid: metres"),
    "matrices": (lambda row: row * [1, 1, 1, 3, 3, 3, 3], "of them 200 no rotation: valid: quaternions of length 1"),
    "one row": (None, r"1 rows show the headset for 0.00 s; calibration needs 1.0 s$"),
    "none": (None, "no rows after the columns' names; calibration needs 1.0 s$"),
}


@pytest.mark.parametrize("kind", NO_CALIBRATION)
def test_no_calibration(jesse, kind):
    """What the rows were, where a second of headset is not among them."""
    change, words = NO_CALIBRATION[kind]
    source = Stream(jesse, "mujoco")
    for s in standing(200 / 90)[: {"one row": 1, "none": 0}.get(kind, 200)]:
        rows = np.concatenate([s.pos, XYZW(s.quat)], axis=1)
        rows[0] = rows[0] if change is None else change(rows[0])
        assert source.push(Sample(s.t, rows[:, :3], rows[:, 3:])) == []
    assert source.calibration is None and re.search(words, source.uncalibrated()), source.uncalibrated()


@pytest.mark.parametrize("axes", AXES)
def test_round_trip(jesse, walk, axes):
    """mocap -> CSV in other axes -> stream = the mapped sensors of the mocap."""
    pos, quat = sensors(walk)
    lines = to_csv(np.arange(len(pos)) / 30, pos, quat, axes)
    source = Stream(jesse, axes, grip=90.0)
    ticks = [tick for s in Reader("x").read(lines) for tick in source.push(s)]
    assert isinstance(source.calibration, Calibration) and not source.guard.events
    first = len(pos) - len(ticks)
    assert 30 <= first <= 32
    c = source.calibration
    scale = np.array([1.0, 1.0, retarget.headset(jesse)[2] / np.percentile(pos[:first, 0, 2], 87.5)])
    back = quat_about(2, -c.yaw)
    for k, tick in enumerate(ticks):
        want = quat_rotate(np.tile(back, (3, 1)), pos[first + k] - c.origin) * scale
        assert np.allclose(tick.pos, want, atol=1e-5)
        assert quat_angle(tick.quat, quat_mul(back, quat[first + k])).max() < 1e-6


def test_headset_only(jesse, walk):
    """§4.2: without controllers' columns, or with ones that are not read: the headset's ticks, hands hanging."""
    pos, quat = sensors(walk)
    times = np.arange(len(pos)) / 30
    lines = to_csv(times, pos, quat)
    headset = [",".join(line.strip().split(",")[:8]) + "\n" for line in lines]
    with pytest.raises(UserError, match="no column left_px, .* and 10 more.*--sensors hmd"):
        list(Reader("x").read(headset))
    with pytest.raises(UserError, match="no column head_qw"):
        list(Reader("x", devices=1).read([",".join(line.split(",")[:7]) + "\n" for line in headset]))
    found = []
    for text in (headset, lines):
        source = Stream(jesse, "mujoco", devices=1)
        ticks = [tick for s in Reader("x", devices=1).read(text) for tick in source.push(s)]
        assert len(ticks) > 100 and len(source.report()) == 1  # the calibration; no device is missed
        found.append(ticks)
    whole = Stream(jesse, "mujoco")
    for a, b, c in zip(*found, [t for s in Reader("x").read(lines) for t in whole.push(s)], strict=True):
        np.testing.assert_array_equal(a.pos, b.pos)
        np.testing.assert_allclose(a.pos[0], c.pos[0])
        turn = quat_about(2, heading(a.quat[0]))
        offset = quat_rotate(quat_conj(turn), a.pos[1:] - a.pos[0]) / source.calibration.scale
        np.testing.assert_allclose(offset, NEUTRAL[1:], atol=1e-9)
        assert quat_angle(a.quat[1:], turn).max() < 1e-6
    player = Player(jesse, lambda obs: np.zeros((1, len(jesse.limits))), devices=1)
    player.step(a.pos[None], a.quat[None])
    assert "hand" not in " ".join(player.report()) and player.obs.shape == (1, 189 - 36)


def test_controllers_hang(jesse, walk):
    """For a recorded motion the same as a stream whose controllers are never seen, in the character's size."""
    ref = retarget.reference(jesse, [walk])
    hang = controllers_hang(ref)
    pos, quat = sensors(walk)
    lost = [Sample(k / 30, *(np.where(np.arange(3)[:, None], np.nan, v[k]) for v in (pos, quat))) for k in range(60)]
    out, guard = guarded(lost)
    assert guard.events["left", "not finite"] == 1
    for k, sample in enumerate(out):
        np.testing.assert_allclose(hang.sensor_pos[k], sample.pos * ref.sensor_scale[k], atol=1e-6)
        assert quat_angle(hang.sensor_quat[k], sample.quat).max() < 1e-6
    np.testing.assert_array_equal(hang.sensor_pos[:, 0], ref.sensor_pos[:, 0])
    np.testing.assert_array_equal(hang.sensor_rot[:, 0], ref.sensor_rot[:, 0])
    np.testing.assert_allclose(hang.sensor_rot, quat_matrix(hang.sensor_quat)[..., :2], atol=1e-6)
    assert np.abs(ref.sensor_pos[:, 1:] - hang.sensor_pos[:, 1:]).max() > 0.05  # the argument is as it was


# ------------------------------------------------------------------------------------ the character


def test_hands_hang_where_a_humans_do():
    """NEUTRAL is where the built-in human's hands are when it stands: the left one on the left."""
    pos, quat = sensors(make_walk(4.0, kind="stand", variation=0.0))
    back = quat_about(2, -heading(quat[:, 0]))[:, None]
    hang = quat_rotate(np.tile(back, (1, 3, 1)), pos - pos[:, :1]).mean(0)
    np.testing.assert_allclose(hang, NEUTRAL, atol=0.15)


@pytest.mark.parametrize("devices", [3, 1])
def test_player_observes_as_env(jesse, walk, devices):
    """From one state, with one user, Player and Env see and do the same for a second."""
    ref = retarget.reference(jesse, [walk])
    env = Env(jesse, ref if devices == 3 else headset_only(ref), 1, threads=1, autoreset=False)
    env.reset(frames=[10])
    act = lambda obs: 0.3 * np.sin(np.arange(len(jesse.limits)) + 5 * obs[:, :1])  # noqa: E731
    player = Player(jesse, act, devices=devices)
    player.before = (ref.sensor_pos[9][None, :devices], ref.sensor_rot[9][None, :devices])
    player.qpos[:], player.qvel[:] = env.qpos, env.qvel
    player.batch.forward(np.arange(1), retarget.STAGE_VEL)
    for k in range(30):
        seen = env.full[:, : env.obs_size].copy()
        assert player.obs_size == env.obs_size
        ended = env.step(act(seen))[2]
        player.step(ref.sensor_pos[10 + k][None], ref.sensor_quat[10 + k][None])
        assert np.allclose(player.obs, seen, atol=1e-6), k
        if ended[0]:
            break
        assert np.allclose(player.qpos, env.qpos, atol=1e-9)
    assert k > 5


def test_stand(jesse):
    """Feet on the floor, the root a human's distance behind the headset, turned and moving as it is."""
    player = Player(jesse, lambda obs: np.zeros((1, len(jesse.limits))))
    turn = quat_about(2, 0.8)
    pos, quat = np.array([[[3.0, -1.0, 1.4]] * 3]), np.tile(turn, (1, 3, 1))
    player.stand(pos, quat)
    behind = pos[0, 0, :2] - retarget.HEADSET_AHEAD[0] * np.array([np.cos(0.8), np.sin(0.8)])
    assert np.allclose(player.qpos[0, :2], behind, atol=1e-9) and retarget.HEADSET_AHEAD[0] == 0.14
    assert np.isclose(player.site_xpos[0, jesse.sensor_sites[0], 2], retarget.headset(jesse)[2])
    assert np.isclose(heading(player.qpos[0, 3:7]), 0.8) and not player.qvel.any()
    lowest = character.geom_lowest(jesse.model, jesse.sole_geoms.ravel(), player.geom_xpos, player.geom_xmat).min()
    assert abs(lowest) < 1e-6
    player.before = (pos - [0.01, 0.02, 0.5], None)
    player.stand(pos, quat)
    assert np.allclose(player.qvel[0, :3], [0.3, 0.6, 0.0])


def test_standing_root_is_where_training_has_it(walk):
    """A standing human's headset is HEADSET_AHEAD before the hips, to three centimetres."""
    still = load("standing", clips="stand_005")[0]
    way = sensors(still)[0][:, 0] - still.pos[:, 0]
    yaw = heading(still.quat[:, 0])
    ahead = np.cos(yaw) * way[:, 0] + np.sin(yaw) * way[:, 1]
    assert np.mean(ahead) == pytest.approx(retarget.HEADSET_AHEAD[0], abs=0.03)


def test_away_is_from_the_headset(jesse):
    player = Player(jesse, lambda obs: np.zeros((1, 33)))
    pos, quat = np.tile([3.0, -1.0, 1.4], (1, 3, 1)), np.tile([1.0, 0, 0, 0], (1, 3, 1))
    player.stand(pos, quat)
    assert player._ends(pos - [1.001, 0, 0]) == ["away"] and player._ends(pos + [0.999, 0, 0]) == [None]


def test_errors_are_distances(jesse):
    """Of the headset, and the mean of both controllers."""
    player = Player(jesse, lambda obs: np.zeros((1, 33)))
    pos, quat = np.tile([0.11, 0.0, 1.475], (1, 3, 1)), np.tile([1.0, 0, 0, 0], (1, 3, 1))
    player.stand(pos, quat)
    player.before = (pos, quat_matrix(quat)[..., :2])
    sites = player.site_xpos[:, jesse.sensor_sites] + [[0.01, 0, 0], [0, 0.02, 0], [0, 0, 0.06]]
    player.step(sites, quat)
    assert player.head_error[0] == pytest.approx(0.01) and player.hand_error[0] == pytest.approx(0.04)


def test_falls_are_counted(jesse):
    """All torques at their limit: it falls and stands again; away from the user it is put back; NaN is no end."""
    still = np.tile([[0.11, 0.0, 1.475]], (1, 3, 1)), np.tile([1.0, 0, 0, 0], (1, 3, 1))
    player = Player(jesse, lambda obs: np.ones((1, len(jesse.limits))))
    for _ in range(90):
        player.step(*still)
    assert player.ends[0]["fall"] >= 1 and np.isfinite(player.qpos).all()
    assert "falls" in player.report()[0] and "head error" in player.report()[1] and "p99" in player.report()[2]
    assert ["hand error" in player.report(told)[1] for told in (True, False)] == [True, False]  # False: they hang
    player.stand(*still)
    before = player.ends[0]["away"]
    assert player.step(still[0] + [3.0, 0, 0], still[1]) == ["away"] and player.ends[0]["away"] == before + 1
    assert np.linalg.norm(player.qpos[0, :2] - [3.0, 0]) < 0.2
    broken = Player(jesse, lambda obs: np.full((1, len(jesse.limits)), np.nan))
    assert [broken.step(*still) for _ in range(3)] == [["bad"]] * 3 and np.isfinite(broken.qpos).all()
    assert Player(jesse, None).report() == ["0 s played"]


def test_side_by_side(jesse, walk):
    """Streams of several lengths: each character does what it does alone; only ticks of its own stream count."""
    ref = retarget.reference(jesse, [walk])
    act = lambda obs: 0.3 * np.sin(np.arange(len(jesse.limits)) + 5 * obs[:, :1])  # noqa: E731
    whole = ref.sensor_pos[:70], ref.sensor_quat[:70]
    part = whole[0][5:55] + [0.5, 0, 0], whole[1][5:55]  # long enough to be played beside the whole, which falls later
    streams = [whole, part, whole, (whole[0][:30], whole[1][:30])]
    rides = ride(jesse, act, streams)
    for stream, found in zip(streams, rides):
        [alone] = ride(jesse, act, [stream], threads=1)
        assert np.allclose(found.qpos, alone.qpos, atol=1e-9) and found.ends == alone.ends
        assert np.array_equal(found.anew, alone.anew) and np.array_equal(found.contact, alone.contact)
        assert found.head == pytest.approx(alone.head) and found.hands == pytest.approx(alone.hands)
        assert len(found.qpos) == len(stream[0]) and found.anew.sum() in (found.failures, found.failures + 1)
        mj = mujoco.MjData(jesse.model)
        errors = []
        for qpos, target in zip(found.qpos, stream[0]):
            mj.qpos[:] = qpos
            mujoco.mj_kinematics(jesse.model, mj)
            errors.append(np.linalg.norm(mj.site_xpos[jesse.sensor_sites[0]] - target[0]))
        assert found.farthest == pytest.approx(max(errors)) and found.head == pytest.approx(sum(errors))
    assert rides[0].failures > 0 and rides[0].anew[0]  # it falls, and the start counts as a stand, not as a failure
    # the contacts of a tick are those of the step before it, as Env sees them
    env = Env(jesse, ref, 1, threads=1, autoreset=False)
    player = Player(jesse, act)
    player.stand(ref.sensor_pos[:1], ref.sensor_quat[:1])
    env.reset(frames=[0])
    env.qpos[:], env.qvel[:] = player.qpos, player.qvel
    env.refresh()
    seen = 0
    for k in range(12):
        player.step(ref.sensor_pos[[k]], ref.sensor_quat[[k]])
        env.step(player.ctrl.copy())
        assert np.array_equal(player.contact, env.contact)
        seen += player.contact.sum()
    assert seen


def test_folder_of_recordings(jesse, tmp_path, capsys, walk):
    """A line a file and a JSON; the same numbers as alone; what is no recording is named, and the exit says so."""
    pos, quat = sensors(walk)
    parts = ("px", "py", "pz", "qx", "qy", "qz", "qw")
    names = ["time", *(f"{d}_{p}" for d in ("head", "left", "right") for p in parts)]
    rows = np.concatenate([pos, np.roll(quat, -1, axis=-1)], axis=-1).reshape(len(pos), -1)
    rows = np.concatenate([np.arange(len(pos))[:, None] / walk.rate, rows], axis=1)
    out, tmp_path = tmp_path / "o.json", tmp_path / "in"
    (tmp_path / "sub").mkdir(parents=True)
    for name, n in (("a.csv", len(rows)), ("sub/b.csv", len(rows) // 2)):
        np.savetxt(tmp_path / name, rows[:n], delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    common = ["--character", "jesse", "--axes", "mujoco"]

    def played(path, *more):
        with pytest.raises(SystemExit) as end:
            run_main(play.main, [*common, "--stream", str(path), "--json", str(out), *more])
        return end.value.code, json.loads(out.read_text())

    code, found = played(tmp_path)
    assert code == 0 and set(found["files"]) == {"a.csv", "sub/b.csv"} and set(found["all"]) == set(play.OF_FILE)
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("a.csv: ") and told[2].startswith("all 2, completed ") and found["refused"] == {}
    for name, row in found["files"].items():
        how = {k: row.pop(k) for k in ("axes", "grip", "notes", "lost_s")}
        assert set(row) == set(play.OF_FILE) and row["completed"] == (row["failures"] == 0)
        nothing = {"head": 0, "left": 0, "right": 0}
        assert how == {"axes": "mujoco", "grip": 90.0, "notes": how["notes"], "lost_s": nothing}
        code, alone = played(tmp_path / name)
        [same] = alone["files"].values()
        assert code == 0 and {k for k in same if same[k] is None} == {k for k in row if row[k] is None}
        for key in play.OF_FILE:
            assert same[key] is None or same[key] == pytest.approx(row[key], rel=1e-4), key
    total = found["all"]
    assert total["seconds"] == pytest.approx(sum(r["seconds"] for r in found["files"].values()), abs=0.01)
    assert total["failures"] == sum(r["failures"] for r in found["files"].values())
    assert total["completed"] == np.mean([r["completed"] for r in found["files"].values()])
    assert total["survival"] == pytest.approx(np.mean([r["survival"] for r in found["files"].values()]))
    assert all((r["survival"] == 1.0) == r["completed"] and 0.0 < r["survival"] <= 1.0 for r in found["files"].values())
    (tmp_path / "broken.csv").write_text("time,head_px\n0,1\n")
    (tmp_path / "gone.csv").symlink_to(tmp_path / "nothing")
    (tmp_path / "sub" / "b.csv").rename(tmp_path / "b\x1b[31m\udcff.csv")
    code, found = played(tmp_path)
    told, wrong = capsys.readouterr()
    assert code == 1 and len(found["files"]) == 2 and "broken.csv, line 1: no column" in wrong
    assert "gone.csv: no such file" in wrong and "\nb\\x1b[31m\\udcff.csv: " in told
    assert set(found["refused"]) == {"broken.csv", "gone.csv"} and "\nall 2 of 4, 2 refused, completed " in told
    assert found["refused"]["broken.csv"] in wrong
    rows[60:90, 1:8] = np.nan  # the headset, from 2 to 3 s
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    [row] = played(tmp_path / "a.csv")[1]["files"].values()
    assert row["lost_s"] == {"head": pytest.approx(30 / walk.rate, abs=0.04), "left": 0, "right": 0}
    assert f"; lost: head {row['lost_s']['head']:.1f} s\n" in capsys.readouterr().out
    rows[:, 8:] = np.nan  # no controllers at all: what stands in for them is nobody's hands
    np.savetxt(tmp_path / "none.csv", rows, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    _, found = played(tmp_path / "none.csv")
    assert found["files"]["none.csv"]["hands_cm"] is found["all"]["hands_cm"] is None
    assert found["files"]["none.csv"]["lost_s"]["left"] == pytest.approx(found["all"]["seconds"], abs=0.1)
    (tmp_path / "none.csv").unlink()
    _, short = played(tmp_path / "a.csv", "--seconds", "1")
    assert short["all"]["seconds"] == 1.0
    (tmp_path / "none").mkdir()
    with pytest.raises(SystemExit):
        run_main(play.main, [*common, "--stream", str(tmp_path / "none")])
    assert "a folder without recordings" in capsys.readouterr().err
    for more in ([], ["--json", str(out)]):
        assert run(*common, "--stream", "x" * 300, *more) == 2
        assert "xxx: File name too long; valid: " in capsys.readouterr().err


def ridden(ticks, *cuts):
    """A ride of so many ticks that was stood up anew before these."""
    anew, empty = np.zeros(ticks, bool), np.zeros((ticks, 1))
    anew[[0, *cuts]] = True
    return Ride(empty, empty, empty, anew, Counter(fall=len(cuts)), 0.0, 0.0, 0.0)


def test_tally():
    """By hand: one falls twice, in step 10 and 25 of 40, one in step 30 of 60, one never in 20; one in its last."""
    found = tally([ridden(40, 10, 25), ridden(60, 30), ridden(20)])
    asked = dict(seconds=4.0, completed=1 / 3, survival=(9 / 40 + 29 / 60 + 1) / 3, failures=3, fails_every_s=4 / 3)
    assert found == pytest.approx(asked | dict(first_failure_s=19 / 30))
    last = replace(ridden(20), ends=Counter(fall=1))  # stood up after its last tick
    assert (tally([last])["completed"], tally([last])["survival"]) == (0.0, 0.95)
    assert tally([ridden(20)])["fails_every_s"] == tally([ridden(20)])["first_failure_s"] == float("inf")


def test_captures_far_away(jesse, walk):
    """A capture that begins 150 m from the origin is as one that does not; a user of 175 m is refused by name."""
    near, far = (stream_of(jesse, place(walk, 0.0, np.zeros(2), np.array(to))) for to in ([3.0, 0.0], [150.0, -120.0]))
    for a, b in zip(near[:2] + near[3:], far[:2] + far[3:]):
        np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_allclose(near[2].pos, far[2].pos, atol=1e-9)
    tall = replace(walk, pos=100.0 * walk.pos, ball=100.0 * walk.ball)
    with pytest.raises(UserError, match=f"{walk.name}: .* rows show the headset for 0.00 s; .* far away: centimetres"):
        stream_of(jesse, tall)


def test_slides_as_measured(jesse):
    """Own slide of a ride is the streamed row's: a character that is stood up does not land."""
    clip, act = load("standing", clips="stand_005")[0], lambda obs: np.zeros((len(obs), len(jesse.limits)))
    rides = ride(jesse, act, [stream_of(jesse, clip)[:2]])
    assert rides[0].failures > 1 and any(rides[0].contact[a + 1].any() for a, _ in rides[0].lives)
    found = play.summary_of(rides, [play.slides_of(jesse, r) for r in rides], True)
    measured = metrics.streamed(jesse, act, [clip])
    for key in ("head_cm", "hands_cm", "own_slide_cm_s"):
        assert found[key] == pytest.approx(measured[key], rel=1e-5), key


def test_policy_of_another_character(jesse, tmp_path, capsys, walk):
    """A policy that does not fit is refused in a line that names both, for one recording and for a folder."""
    (tmp_path / "a.csv").write_text("".join(to_csv(np.arange(len(walk)) / walk.rate, *sensors(walk))))
    tiny_policy(jesse, tmp_path / "jesse.npz")
    flags = ["--character", "dino", "--policy", str(tmp_path / "jesse.npz")]
    for stream in (tmp_path / "a.csv", tmp_path):
        with pytest.raises(SystemExit) as end:
            run_main(play.main, [*flags, "--stream", str(stream)])
        said = capsys.readouterr().err
        assert end.value.code == 2 and said.count("\n") == 1
        assert "jesse.npz: a policy of" in said and "dino needs" in said


def wreck(samples, rng):
    """Every fault at once: zeros, NaN, absurd numbers, frozen, teleports, gaps, late and absurd times."""
    for k, s in enumerate(samples):
        pos, quat, t = s.pos.copy(), XYZW(s.quat), s.t
        kind = rng.integers(12) if k % 7 == 0 else -1
        d = rng.integers(3)
        if kind == 0:
            pos[d], quat[d] = 0.0, 0.0
        elif kind in (1, 2):
            pos[d, rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e308])
        elif kind == 3:
            quat[d] = rng.choice([np.nan, np.inf, 0.0, 1e308, 1e-308])
        elif kind == 4:
            pos += rng.uniform(-5, 5, 3)
        elif kind == 5:
            pos[d] += rng.uniform(-3, 3, 3)
        elif kind == 6:
            t = rng.choice([np.nan, np.inf, 1e18, -1e18, t - 0.3, t + 3.0])
        elif kind == 7:
            quat[d] = -quat[d]
        elif kind == 8:
            pos, quat = pos * np.nan, quat * np.nan
        if not (kind == 9 and k % 3):
            yield Sample(t, pos, quat)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.filterwarnings("error")
def test_never_nan(jesse, seed):
    """Whatever comes, the character's state and all poses are finite, and time goes on."""
    rng = np.random.default_rng(seed)
    player = Player(jesse, lambda obs: np.tanh(obs[:, : len(jesse.limits)]))
    source, good = Stream(jesse, "mujoco"), []

    def see(player, tick):
        good.append(np.isfinite(player.qpos).all() and np.isfinite(player.obs).all() and np.isfinite(tick.pos).all())
        good.append(np.allclose(np.linalg.norm(tick.quat, axis=1), 1))

    drive(source, wreck(standing(8, seed=seed), rng), player, see=see)
    assert len(good) > 200 and all(good)


def test_realtime():
    """A pace with a clock of its own: on time, one late step, then a long stop."""
    now = SimpleNamespace(t=0.0)

    def sleep(s):
        now.t += s

    pace = Pace(0.1, clock=lambda: now.t, sleep=sleep)
    for took in (0.05, 0.05, 0.15, 0.01, 3.0, 0.01):
        pace.wait()
        now.t += took
        pace.done()
    assert pace.missed == 2 and pace.restarts == 1 and "2 deadlines missed, 1 times" in pace.report()[0]


# ------------------------------------------------------------------------------------ command line


def run(*args):
    with pytest.raises(SystemExit) as end:
        run_main(play.main, [str(a) for a in args])
    return end.value.code


def lines_in_our_axes(seconds=3.0):
    samples = standing(seconds)
    return to_csv(*(np.array(v) for v in zip(*samples, strict=True)), "mujoco")


def test_command_line(jesse, tmp_path, capsys):
    """A file is played, pushed, reported; what is wrong is one line."""
    policy = tiny_policy(jesse, tmp_path / "p.npz")
    (tmp_path / "s.csv").write_text("".join(lines_in_our_axes(4)))
    base = ("--character", "jesse", "--policy", policy, "--stream", tmp_path / "s.csv")
    assert run(*base, "--axes", "mujoco", "--push", "300@0.5:left", "--seconds", 2, "--realtime") == 0
    out = capsys.readouterr().out
    for words in ("2.0 s played", "head error", "p99", "user's headset 1.6", "deadlines missed"):
        assert words in out
    for args, words in (
        (("--axes", "blender"), "invalid choice: 'blender'"),
        (("--measure",), "a stream has not"),
        (("--push", "much"), "--push much: valid: N@T"),
        (("--user-height", 0), "from 0.3 to 3 m"),
        (("--user-height", 1e9), "from 0.3 to 3 m"),
        (("--grip", "nan"), "from -180 to 180 degrees"),
        (("--sample-rate", 1e-3), "from 10 to 2000 rows a second"),
    ):
        assert run(*base, *args) == 2
        assert words in capsys.readouterr().err
    (tmp_path / "s.csv").write_text("".join(lines_in_our_axes(0.5)))
    assert run(*base, "--axes", "mujoco") == 2
    assert "45 rows show the headset for 0.49 s; calibration needs 1.0 s" in capsys.readouterr().err


def test_stream_as_bvh(jesse, tmp_path, capsys):
    """What the character did under a headset, by another tool's names; not of a folder."""
    policy = tiny_policy(jesse, tmp_path / "p.npz")
    (tmp_path / "s.csv").write_text("".join(lines_in_our_axes(4)))
    base = ("--character", "jesse", "--policy", policy, "--axes", "mujoco", "--bvh", tmp_path / "out.bvh")
    assert run(*base, "--stream", tmp_path / "s.csv", "--seconds", 2, "--bvh-names", "mixamo") == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "out.bvh")
    file = bvh.read(tmp_path / "out.bvh")
    assert len(file.values) == 60 and file.names[0] == "mixamorig:Hips" and "mixamorig:LeftForeArm" in file.names
    first = bvh.local(file)[0][0, 0] / 100  # the root's place: x left, y up, z forward
    assert first[1] == pytest.approx(jesse.hip_height, abs=0.1) and np.abs(first[[0, 2]]).max() < 0.4
    assert run(*base, "--stream", tmp_path) == 2
    assert "is a folder, played side by side: leave out pictures, --bvh" in capsys.readouterr().err


def test_stdin(jesse, tmp_path, capsys, monkeypatch):
    """`--stream -` reads lines as they come, garbage among them."""
    lines = lines_in_our_axes()
    lines.insert(100, "garbage\n")
    data = "".join(lines).encode()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(data)))
    policy = tiny_policy(jesse, tmp_path / "p.npz")
    assert run("--policy", policy, "--stream", "-", "--axes", "mujoco") == 0
    out = capsys.readouterr().out
    assert "1 lines could not be read" in out and "2.0 s played" in out


def test_stdin_that_breaks(jesse, tmp_path, capsys, monkeypatch):
    """Of a live stream that ends in garbage the seconds played are told and written; then comes the error."""
    data = "".join([*lines_in_our_axes(), *["garbage\n"] * 200]).encode()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(data)))
    flags = ("--policy", tiny_policy(jesse, tmp_path / "p.npz"), "--axes", "mujoco", "--bvh", tmp_path / "o.bvh")
    assert run(*flags, "--stream", "-") == 2
    told = capsys.readouterr()
    assert "2.0 s played" in told.out and "error: standard input, line 371, column" in told.err
    assert len(bvh.read(tmp_path / "o.bvh").values) == 60
    (tmp_path / "s.csv").write_bytes(data)
    (tmp_path / "o.bvh").unlink()
    assert run(*flags, "--stream", tmp_path / "s.csv") == 2 and not (tmp_path / "o.bvh").exists()  # a file is mended


def test_stdin_that_pauses(jesse):
    """With the wall clock the character goes on while nothing comes, and the stream goes on after it."""
    samples = [Sample(s.t, s.pos, XYZW(s.quat)) for s in standing(2.0)]

    def slowly():
        yield from samples[:130]
        time.sleep(0.5)
        yield from samples[130:]

    items = list(arriving(slowly(), 0.1, 1 / 30))
    silent = [i for i in items if isinstance(i, float)]
    assert len(items) - len(silent) == len(samples) and 0.3 < sum(silent) < 0.6 and silent[0] == 0.1
    source = Stream(jesse, "mujoco")
    ticks = [t for i in items for t in (source.idle(i) if isinstance(i, float) else source.push(i))]
    assert source.guard.events["head", "drop-out"] == 1 and len(ticks) > 30 + 30 * sum(silent) - 4
    assert Stream(jesse).idle(1.0) == []

    def broken():
        yield samples[0]
        raise UserError("torn")

    with pytest.raises(UserError, match="torn"):
        list(arriving(broken(), 0.1, 0.1))


def test_web_view(jesse, tmp_path, capsys, monkeypatch):
    """--view with a stream draws every tick and ends when the viewer is closed."""
    drawn = []

    class Handle:
        __enter__ = lambda self: self  # noqa: E731
        __exit__ = lambda self, *_: None  # noqa: E731
        sync = lambda self: drawn.append(1)  # noqa: E731
        is_running = lambda self: len(drawn) < 5  # noqa: E731

    monkeypatch.setattr(play, "_open_viewer", lambda *_: Handle())
    policy = tiny_policy(jesse, tmp_path / "p.npz")
    (tmp_path / "s.csv").write_text("".join(lines_in_our_axes()))
    assert run("--policy", policy, "--stream", tmp_path / "s.csv", "--axes", "mujoco", "--view", "web") == 0
    assert len(drawn) == 5 and "0.2 s played" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["quest_2_beatsaber.csv", "vive_pro_2_beatsaber.csv"])
def test_real_recordings(jesse, sensors_dir, name):
    """10 s of two games: poses that a standing player can have, in our axes."""
    source, ticks = Stream(jesse), []
    for sample in Reader(name).read(lines_of(sensors_dir / name)):
        ticks += source.push(sample)
        if len(ticks) >= 300:
            break
    pos, quat = np.array([t.pos for t in ticks]), np.array([t.quat for t in ticks])
    assert abs(pos[:, 0, 2].max() - retarget.headset(jesse)[2]) < 0.1 and np.abs(pos[:, 0, :2]).max() < 0.5
    assert np.abs(heading(quat[:, 0])).max() < 0.5
    assert (pos[:, 1, 1] > pos[:, 2, 1]).mean() > 0.8  # the left hand is mostly left of the right one
    assert np.linalg.norm(pos[:, 1:] - pos[:, :1], axis=-1).max() < 1.2
    assert "the stream's" in source.report()[0]  # one of them is 1.97 m up
    assert np.isfinite(pos).all() and not source.guard.events["head", "teleport"]


def pointing(clip):
    """A clip's sensors with controllers that point, as Unity's do: t, pos, quat in our axes."""
    pos, quat = sensors(clip)
    quat = quat.copy()
    quat[:, 1:] = quat_mul(quat[:, 1:], quat_about(1, np.radians(90.0 - GRIP["unity"])))
    return np.arange(len(pos)) / clip.rate, pos, quat


def test_axes_are_found(jesse, walk, tmp_path, capsys):
    """A file is read in its own axes by itself; a live stream is watched, and what does not fit is said."""
    path = tmp_path / "a.csv"
    for name in ("unity", "openxr"):
        path.write_text("".join(to_csv(*pointing(walk), name)))
        source, how = source_of(jesse, path, 3, play.Options())
        assert (source.axes, source.grip, source.order) == (name, 15.0, [0, 1, 2]) and how.usual == (name == "unity")
    source, how = source_of(jesse, path, 3, play.Options(axes="unity", devices=("head", "right", "left")))
    assert (source.axes, source.order) == ("unity", [0, 2, 1]) and "--axes auto" in how.lines[0]
    samples = list(Reader("x").read(to_csv(*pointing(walk), "unity")))
    assert list(play.watched(samples, Watch("unity"))) == samples
    assert capsys.readouterr().out == ""
    list(play.watched(samples, Watch("mujoco")))
    assert "--axes" in capsys.readouterr().out


def test_what_is_said_of_a_folder(jesse, walk, tmp_path):
    """Of many recordings a guess is said, unless it is what most files are."""
    lines = to_csv(*pointing(walk), "unity")
    headset = [",".join(line.strip().split(",")[:8]) + "\n" for line in lines]
    still = [lines[0], *(f"{k / 90},{lines[1].split(',', 1)[1]}" for k in range(200))]  # nobody holds the controllers
    for text, devices, said in (
        (lines, 3, ""),
        (lines, 1, ""),
        (to_csv(*pointing(walk), "openxr"), 3, "--axes openxr"),
        (["# axes: openxr\n", *to_csv(*pointing(walk), "openxr")], 1, "axes as the file itself says: --axes openxr"),
        (headset, 1, "too little to tell the axes from: --axes unity"),
        (still, 3, "not sure"),
    ):
        (tmp_path / "a.csv").write_text("".join(text))
        notes = ticks_of(jesse, tmp_path / "a.csv", devices, play.Options())[2]["notes"]
        assert len(notes) == bool(said) and said in "".join(notes)

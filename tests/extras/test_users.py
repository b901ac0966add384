"""extras/users.py: builds, the rows of the table, and one row against `metrics.streamed`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_stream import ridden

import character
import metrics
from extras import users
from headset.player import AWAY, from_user, ride, stream_of
from human import SEG, headset_height, sensors
from mocap import data
from mocap.augment import looking
from plumbing.cli import run_main


@pytest.fixture(scope="module")
def clip():
    return data.load("builtin", clips="walk_105")[0][:60]


def length(clip, a, b):
    return np.linalg.norm(clip.pos[:, SEG[a]] - clip.pos[:, SEG[b]], axis=1).mean()


def test_of_build(clip):
    """The stature asked for; trunk and arms grow beside the legs by their factors, and keep their directions."""
    legs = length(clip, "thigh_l", "shin_l")
    for height, trunk, arms in ((1.45, 1.0, 1.0), (2.0, 1.25, 1.0), (1.75, 1.0, 0.85)):
        other = users.of_build(clip, height, trunk, arms)
        assert headset_height(other) / users.EYES == pytest.approx(height, rel=1e-6)
        bigger = length(other, "thigh_l", "shin_l") / legs
        assert length(other, "pelvis", "chest") / length(clip, "pelvis", "chest") == pytest.approx(bigger * trunk)
        assert length(other, "upper_arm_r", "forearm_r") / length(clip, "upper_arm_r", "forearm_r") == pytest.approx(
            bigger * arms
        )
        np.testing.assert_array_equal(other.quat, clip.quat)
    assert users.of_build(clip, users.stature(clip)).pos == pytest.approx(clip.pos)


def test_rows(clip):
    """Every height as recorded and with a long trunk; arms at one height alone; or users as they are; or every pace; or
    legs under others' trunks."""
    rows = users.users(users.Options(heights=(1.5, users.MIDDLE)))
    assert list(rows) == [
        "1.50 m", "1.50 m, long trunk", "1.75 m", "1.75 m, long trunk", "1.75 m, long arms", "1.75 m, short arms"
    ]  # fmt: skip
    assert [round(users.stature(f([clip])[0]), 6) for f in rows.values()] == [1.5] * 2 + [1.75] * 4
    [(_, same)] = users.users(users.Options(by="none")).items()
    assert users.users(users.Options(by="time"))["stitched"]([clip]) == [clip]
    assert same([clip]) == [clip]
    paces = users.users(users.Options(by="pace"))
    lengths = [len(f([clip])[0]) for f in paces.values()]
    assert list(paces)[-1] == "2 of the pace" and lengths == [79, 60, 48, 40, 30]  # 59 intervals ÷ s
    tilts = users.users(users.Options(by="head"))
    looks = ["looks 20° aside", "looks 40° aside"]
    assert list(tilts) == ["head -20°", "head -10°", "head +0°", "head +10°", "head +20°", *looks]
    np.testing.assert_array_equal(tilts[looks[1]]([clip])[0].quat, looking(clip, 40.0).quat)
    np.testing.assert_array_equal(tilts["head -20°"]([clip])[0].quat, users.tilted(clip, -20.0).quat)
    same, cross = users.users(users.Options(by="crossing")).values()
    names = [c.name for c in cross([replace(clip, name=n) for n in "abcde"])]
    assert names == [f"{a}-under-{b}" for a, b in zip("abcde", "cdeab", strict=True)]


def test_tilted(clip):
    """SciPy's rotation of the head about its own left; all else stays; the headset goes where the head takes it."""
    other = users.tilted(clip, 10.0)
    turn = Rotation.from_quat(clip.quat[:, SEG["head"]], scalar_first=True).inv() * Rotation.from_quat(
        other.quat[:, SEG["head"]], scalar_first=True
    )
    np.testing.assert_allclose(turn.as_rotvec(degrees=True), np.tile([0.0, 10.0, 0.0], (len(clip), 1)), atol=1e-6)
    rest = [i for name, i in SEG.items() if name != "head"]
    np.testing.assert_array_equal(other.quat[:, rest], clip.quat[:, rest])
    (was, was_turned), (pos, turned) = sensors(clip), sensors(other)
    assert 0.01 < np.linalg.norm(pos[:, 0] - was[:, 0], axis=1).mean() < 0.04
    ahead = [Rotation.from_quat(q[:, 0], scalar_first=True).as_matrix()[:, 2, 0].mean() for q in (was_turned, turned)]
    assert ahead[1] < ahead[0] - 0.1  # positive: chin down
    np.testing.assert_array_equal(pos[:, 1:], was[:, 1:])


def test_pushes():
    """Four directions of each size; a free body as heavy goes as fast as the row says."""
    char = character.load("oppy")
    rows = users.pushes(char, users.Options(by="push"))
    assert len(rows) == 1 + 4 * len(users.PUSHES) and rows[""] is None
    push, dt, moved = rows[", left by 0.5 m/s"], 1e-3, 0.0
    for k in range(6000):
        moved = moved + push.force(k * dt, 0.0) / float(char.model.body_mass.sum()) * dt
    np.testing.assert_allclose(moved, [0.0, 0.5, 0.0], atol=1e-3)
    assert users.pushes(char, users.Options(by="head")) == {"": None}


def test_pushed_while_played(clip):
    """A push moves the character when it comes, and not before; a large one throws it over."""
    char = character.load("oppy")
    rows = users.pushes(char, users.Options(by="push"))
    streams = [stream_of(char, data.load("standing")[0])[:2]]
    limp = lambda obs: np.zeros((len(obs), len(char.limits)))  # noqa: E731
    calm, pushed = (
        ride(char, limp, streams, force=push and replace(push, at=0.5).force)
        for push in (None, rows[", left by 1 m/s"])
    )
    at = round(0.5 * data.CONTROL_RATE)
    np.testing.assert_array_equal(calm[0].qpos[: at + 1], pushed[0].qpos[: at + 1])
    sideways = pushed[0].qpos[at : at + 8, 1] - calm[0].qpos[at : at + 8, 1]
    assert sideways[0] == 0.0 and (np.diff(sideways) > 0).all() and sideways[-1] > 0.05
    for short in (10, 17):  # beside one whose stream ends before the push, or within it
        beside = [tuple(part[:short] for part in streams[0]), streams[0]]
        force = replace(rows[", left by 1 m/s"], at=0.5).force
        _, both = ride(char, limp, beside, force=force)
        np.testing.assert_array_equal(both.qpos, pushed[0].qpos)  # to the end: it is pushed as long, and once


def test_crossed(clip):
    """Legs are one's; every joint above the pelvis, and the bones' lengths, are the other's, by SciPy."""
    other = data.load("builtin", clips="gesture_155")[0][30:110]
    found = users.crossed(clip, other)
    legs = [i for i in range(len(SEG)) if i not in users.UPPER]
    assert len(found) == 60 and len(legs) == 7
    np.testing.assert_array_equal(found.pos[:, legs], clip.pos[:, legs])
    np.testing.assert_array_equal(found.quat[:, legs], clip.quat[:, legs])
    for k in (0, 33):
        relative = []
        for c in (found, other):
            R = Rotation.from_quat(c.quat[k], scalar_first=True)
            relative.append(((R[0].inv() * R).as_matrix(), R[0].inv().apply(c.pos[k] - c.pos[k, 0])))
        for mine, theirs in zip(*relative, strict=True):
            np.testing.assert_allclose(mine[users.UPPER], theirs[users.UPPER], atol=1e-6)


def test_row(clip):
    """A policy that does nothing falls; the numbers are those of `metrics.streamed`, and falls and losses are told."""
    char, act = character.load("jesse"), lambda obs: np.zeros((len(obs), 33))
    row, other = users.row_of(char, act, [clip], 3, 1), metrics.streamed(char, act, [clip], 3, 1)
    assert row["falls"] + row["lost"] + row["diverged"] == other["failures"] > 0
    for key in ("completed", "survival", "fails_every_s", "first_failure_s", "own_slide_cm_s"):
        assert row[key] == pytest.approx(other[key]), key
    assert row["captures"] == 1 and row["head_cm"] > 5
    push = users.pushes(char, users.Options(by="push"))[", left by 1 m/s"]
    pushed = users.row_of(char, act, [clip], 3, 1, replace(push, at=0.2))
    assert pushed["first_failure_s"] < row["first_failure_s"] - 1.0  # it is down sooner for it


def test_why_it_fails():
    """A limp one topples under who stands; it is left behind, upright still, by who goes 5 m/s for 0.4 s."""
    char = character.load("oppy")
    limp = lambda obs: np.zeros((len(obs), len(char.limits)))  # noqa: E731
    pos, quat = (a[:60] for a in stream_of(char, data.load("standing")[0])[:2])
    away = pos[:12] + np.arange(12)[:, None, None] * [5.0 / data.CONTROL_RATE, 0.0, 0.0]
    for stream, ends in (((pos, quat), (1, 0, 0)), ((away, quat[:12]), (0, 1, 0))):
        row = users.row_of_streams(char, limp, [stream], 3, 1)
        assert (row["falls"], row["lost"], row["diverged"]) == ends


def test_by_time(clip):
    """The distance from a user who goes 0.2 m/s faster, by hand; a start under the headset, and a limp one."""
    seconds = np.arange(600) / data.CONTROL_RATE

    row = users.times_of([ridden(600), ridden(600, 150, 180), ridden(599)], [20 * seconds, 10 * seconds, seconds])
    assert (row["captures"], row["without failure"], row["failures after 3 s"]) == (3, 1, 1)  # others are too short
    since = [20 * (np.arange(a * 30, b * 30) / 30).mean() for a, b in users.SINCE.values()]
    before = [10 * (5.0 - t) for t in users.BEFORE]
    asked = dict(zip([*users.SINCE, *(f"{t:g} s before" for t in users.BEFORE)], since + before, strict=True))
    assert {k: row[k] for k in asked} == pytest.approx(asked)

    char, limp = character.load("oppy"), lambda obs: np.zeros((len(obs), len(char.limits)))
    stream = stream_of(char, clip)[:2]
    [one] = ride(char, limp, [stream])
    far = from_user(one.qpos, stream[0][:, 0])
    assert far[0] == pytest.approx(0.0, abs=1e-3) and far[1:].max() <= AWAY + 0.1  # one step more
    turn = Rotation.from_euler("z", 0.7)
    moved = one.qpos.copy()
    moved[:, :3] = turn.apply(moved[:, :3])
    moved[:, 3:7] = (turn * Rotation.from_quat(moved[:, 3:7], scalar_first=True)).as_quat(scalar_first=True)
    np.testing.assert_allclose(from_user(moved, turn.apply(stream[0][:, 0])), far, atol=1e-5)
    assert users.by_time(char, limp, [clip], 3, 1)["without failure"] == 0


def test_command(clip, tmp_path, monkeypatch, capsys):
    """A line for every character and user, as JSON too; a wrong split is said in a line."""
    monkeypatch.setattr(metrics, "captures_of", lambda opt: [clip])
    flags = ["--heights", "1.5", "--threads", "1", "--json", str(tmp_path / "u.json")]
    users.main(["--characters", "oppy", *flags])
    out, found = capsys.readouterr().out, json.loads((tmp_path / "u.json").read_text())
    assert list(found) == ["oppy: 1.50 m", "oppy: 1.50 m, long trunk"]
    for title, row in found.items():
        assert f"| {title} | 1 | {row['completed']:.2f} |" in out
    monkeypatch.undo()
    with pytest.raises(SystemExit):
        run_main(users.main, ["--clips", "swim*"])
    assert "no clip matches 'swim*'" in capsys.readouterr().err
    for flags, says in (
        ("--heights 175", "from 0.5 to 2.5 metres"),
        ("--by pace --heights 1.6", "leave out --heights, or --by"),
        ("--clips walk_105", "--half report: none of the 1 captures; valid: both, select"),
    ):
        with pytest.raises(SystemExit):
            run_main(users.main, ["--characters", "jesse", *flags.split()])
        assert says in capsys.readouterr().err

"""extras/users.py: builds, the rows of the table, and one row against `metrics.streamed`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import character
import metrics
from extras import users
from human import SEG, headset_height
from mocap import data
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
    assert same([clip]) == [clip]
    paces = users.users(users.Options(by="pace"))
    lengths = [len(f([clip])[0]) for f in paces.values()]
    assert list(paces)[-1] == "2 of the pace" and lengths == [79, 60, 48, 40, 30]  # 59 intervals ÷ s
    same, cross = users.users(users.Options(by="crossing")).values()
    names = [c.name for c in cross([replace(clip, name=n) for n in "abcde"])]
    assert names == [f"{a}-under-{b}" for a, b in zip("abcde", "cdeab", strict=True)]


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


def test_command(clip, tmp_path, monkeypatch, capsys):
    """A line for every character and user, as JSON too; a wrong split is said in a line."""
    monkeypatch.setattr(metrics, "motion_of", lambda opt: ([clip], []))
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

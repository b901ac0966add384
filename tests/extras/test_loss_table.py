"""extras/losses.py: the table of falls under lost devices, on little."""

import json

import numpy as np
import pytest
from test_stream import standing, to_csv

import character
from extras import losses
from headset.reader import SAMPLE_RATE, Reader
from plumbing.cli import UserError, run_main


def test_rows():
    """Nothing first; single frames and seconds, of one device and of all; only the last begins before it calibrates."""
    kinds, rng = losses.rows(), np.random.default_rng(0)
    assert len({k.name for k in kinds}) == len(kinds) == 23 and kinds[0] == losses.Loss()
    t = 100.0 + np.arange(3000) / 30
    assert kinds[-1].always and kinds[-1].mask(t, rng).all() and not any(k.always for k in kinds[:-1])
    for kind in kinds[:-1]:
        lost = kind.mask(t, rng)
        want = kind.seconds / losses.EVERY or kind.share
        assert not lost[:60].any() and abs(lost[60:].mean() - want) < 0.04, kind
        if kind.seconds:
            edges = np.flatnonzero(np.diff(lost[150:-150].astype(int), prepend=0, append=0))
            long = np.diff(edges)[::2] / 30
            assert np.median(long) == pytest.approx(kind.seconds, abs=0.04) and max(long) < 2 * kind.seconds + 0.1


def takes(seconds=4.0):
    t, pos, quat = zip(*standing(seconds, 30.0))
    samples = list(Reader("f").read(to_csv(t, pos, quat, "unity")))
    return losses.Capture("a", samples, {"axes": "unity"})


def test_the_same_for_all():
    """A capture's losses do not depend on the character, nor on when they are drawn; a scale is all that differs."""
    jesse, dino = (character.load(n) for n in ("jesse", "dino"))
    (a, height), (again, _), (b, _) = (losses.streams_of(c, takes(), 0) for c in (jesse, jesse, dino))
    other, _ = losses.streams_of(jesse, takes(), 1)
    ratio = losses.user_scale(dino, height) / losses.user_scale(jesse, height)
    for (pos, quat), same, scaled in zip(a, again, b, strict=True):
        np.testing.assert_array_equal(pos, same[0])
        np.testing.assert_allclose(pos * ratio, scaled[0], atol=1e-9)
        np.testing.assert_allclose(quat, scaled[1], atol=1e-12)
    names = [k.name for k in losses.rows()]
    assert np.abs(a[names.index("2 s of 5, all")][0] - a[0][0]).max() > 0.01  # something was lost
    assert any(np.abs(x[0] - y[0]).max() > 0 for x, y in zip(a[1:], other[1:], strict=True))
    np.testing.assert_array_equal(a[0][0], other[0][0])
    np.testing.assert_array_equal(a[-1][0][:, 0], a[0][0][:, 0])  # without controllers the headset is the same
    assert np.ptp(a[-1][0][:, 1:, 2] - a[-1][0][:, :1, 2], axis=0).max() < 1e-6 < np.ptp(a[0][0][:, 1, 2])  # they hang
    with pytest.raises(UserError, match="a: .* rows show the headset for"):
        losses.streams_of(jesse, takes(0.5), 0)


def test_table(tmp_path, capsys):
    """The command on one walk and one recording of a few seconds: every row, the same numbers twice, as JSON too."""
    t, pos, quat = zip(*standing(4.0, 30.0))
    (tmp_path / "takes").mkdir()
    (tmp_path / "takes" / "a.csv").write_text("".join(to_csv(t, pos, quat, "unity")))
    flags = ["--characters", "jesse", "--most", "1", "--seconds", "3", "--stream", str(tmp_path / "takes")]
    flags += ["--threads", "1", "--json", str(tmp_path / "o.json")]
    assert losses.main(flags) == 0
    out, found = capsys.readouterr().out, json.loads((tmp_path / "o.json").read_text())
    assert set(found) == {"builtin", "takes"} and out.count("| 1 s of 5, both hands |") == 2
    for rows in found.values():
        assert list(rows) == [k.name for k in losses.rows()]
        for row in rows.values():
            one = row["Jesse" if "Jesse" in row else "jesse"]
            assert one["captures"] == 1 and one["completed"] == float(not one["failures"])
            assert (one["fails_every_s"] is None) == (not one["failures"])
    assert found["builtin"]["nothing"]["jesse"]["completed"] == 1.0
    assert losses.main(flags) == 0
    assert capsys.readouterr().out == out
    (tmp_path / "none").mkdir()
    with pytest.raises(SystemExit):
        run_main(losses.main, [*flags[:6], "--stream", str(tmp_path / "none")])
    assert "a folder without recordings" in capsys.readouterr().err


def test_a_broken_recording(tmp_path, monkeypatch, capsys):
    """It is named and left out, and so is one that is too short to calibrate; the tables are written all the same."""
    whole = "".join(to_csv(*zip(*standing(3.0, 30.0)), "unity"))
    (tmp_path / "bad.csv").write_text("no recording")
    (tmp_path / "good.csv").write_text(whole)
    (tmp_path / "short.csv").write_text("".join(whole.splitlines(keepends=True)[:20]))
    monkeypatch.setattr(losses, "rows", lambda: [losses.Loss()])
    flags = ["--characters", "jesse", "--most", "3", "--seconds", "3", "--threads", "1", "--clips", "walk_105"]
    assert losses.main([*flags, "--stream", str(tmp_path), "--json", str(tmp_path / "o.json")]) == 1
    *_, bad, short = capsys.readouterr().err.splitlines()
    assert "bad.csv" in bad and "short.csv" in short
    assert json.loads((tmp_path / "o.json").read_text())[tmp_path.name]["nothing"]["jesse"]["captures"] == 1
    (tmp_path / "good.csv").unlink()
    (tmp_path / "short.csv").unlink()
    with pytest.raises(UserError, match="bad.csv"):
        losses.main([*flags, "--stream", str(tmp_path)])


def test_seconds_without_times(tmp_path):
    """A file without times is cut by its rows, one with times where it was."""
    t, pos, quat = zip(*standing(4.0, 60.0))
    lines = "".join(to_csv(t, pos, quat, "unity")).splitlines()
    for name, first, want in (("with", 0, 121), ("without", 1, 2 * SAMPLE_RATE)):
        file = tmp_path / f"{name}.csv"
        file.write_text("\n".join(",".join(line.split(",")[first:]) for line in lines) + "\n")
        assert len(losses.recording(file, 2.0).samples) == want

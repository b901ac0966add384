"""extras/streamed.py: the sets and their halves, all of them together, and the table by its command."""

import json
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

import character
import metrics
import retarget
from extras import streamed
from headset.player import ride, stream_of
from mocap import data
from plumbing.cli import UserError

CHARACTER = Path(character.CHARACTERS) / "dino.npz"


def test_captures(tmp_path):
    """The halves share no capture and are all together; few captures are reported whole; no folder, none."""
    one = streamed.Set("walks", "builtin")
    names = [{c.name for c in streamed.captures_of(one, tmp_path, half)} for half in streamed.HALVES]
    assert streamed.HALVES == ["select", "report"] and not names[0] & names[1]
    assert names[0] | names[1] == {c.name for c in data.load("builtin", split="validation")}
    few = streamed.Set("walks", "builtin", whole=True)
    assert {c.name for c in streamed.captures_of(few, tmp_path, "report")} == names[0] | names[1]
    assert {c.name for c in streamed.captures_of(few, tmp_path, "select")} == names[0]  # chosen on no more than others
    for nowhere in (tmp_path, Path()):
        assert streamed.captures_of(streamed.Set("gone", "bandai"), nowhere, "report") == []


def test_statue():
    """Against MuJoCo's own forward kinematics of the standing pose, tick by tick; a user who hangs the arms is near."""
    char = character.load("jesse")
    pos, quat = streamed.motionless(char, 3)
    moved = pos[:40] + np.linspace(0, 1, 40)[:, None, None] * [1.0, -0.5, 0.0]
    streams, errors = [(pos[:20], quat[:20]), (moved, quat[:40])], []
    data = mujoco.MjData(char.model)
    for p, q in streams:
        for place, turn in zip(p, q, strict=True):
            data.qpos[:] = retarget.standing(char, place[:1], turn[:1])[0]
            mujoco.mj_forward(char.model, data)
            errors.append([np.linalg.norm(data.site_xpos[char.sensor_sites[k]] - place[k]) for k in (1, 2)])
    found = streamed.statue(char, streams)["statue_cm"]
    assert found == pytest.approx(100 * np.mean(errors), rel=1e-5) and 1.0 < found < 25.0


def test_together():
    """Two sets as one against the captures one by one."""
    a = dict(clips=3, completed=2 / 3, within_1m=1 / 3, survival=0.8, seconds=10.0, failures=2, root_cm=5.0)
    b = dict(clips=1, completed=0.0, within_1m=0.0, survival=0.4, seconds=5.0, failures=1, root_cm=9.0)
    both = streamed.together([a, b])
    assert both["clips"] == 4 and both["completed"] == pytest.approx(np.mean([1, 1, 0, 0]))
    assert both["within_1m"] == pytest.approx(np.mean([1, 0, 0, 0])) and both["survival"] == pytest.approx(0.7)
    assert both["fails_every_s"] == pytest.approx(5.0) and "root_cm" not in both
    assert streamed.together([a | {"failures": 0}])["fails_every_s"] == float("inf")


def test_trained_captures(tmp_path):
    """What is trained on, whole: no capture that is held out, and of the built-in ones sidesteps and stops alone."""
    aside = [s for s in streamed.TRAINED if s.folder in ("builtin", "standing")]
    names = [c.name for one in aside for c in streamed.captures_of(one, tmp_path, "train")]
    assert len(names) == 9 and {n.rpartition("_")[0] for n in names} == {"sidestep", "stop"}
    back = {c.name for c in streamed.captures_of(streamed.TRAINED[0], tmp_path, "train")}
    assert back == {c.name for c in data.load("backwards", split="train")}
    assert all(s.split == "train" or s.folder.endswith("/train") for s in streamed.TRAINED)
    assert all("exercises" in {s.folder for s in sets} for sets in (streamed.SETS, streamed.TRAINED))


def test_put_off():
    """The first round is the streams; later every device of every stream has its own error at all ticks, and shakes."""
    rng = np.random.default_rng(0)
    streams = [(rng.normal(size=(t, 3, 3)), rng.normal(size=(t, 3, 4))) for t in (400, 60)]
    out = streamed.put_off(streams, 3)
    assert len(out) == 6 and all(a is b for a, b in zip(out, streams))
    off = np.stack([np.mean(out[k][0] - streams[0][0], axis=0) for k in (2, 4)])  # (round, device, axis)
    assert 0.5 * streamed.PUT < off.std() < 2 * streamed.PUT and np.unique(off).size == off.size
    assert np.abs(np.mean(out[3][0] - streams[1][0], axis=0) - off[0]).min() > 1e-4  # the other stream's
    shaken = out[2][0] - streams[0][0] - off[0]
    assert shaken.std() == pytest.approx(streamed.SHAKEN, rel=0.05)
    assert abs(np.corrcoef(shaken[:, 0].ravel(), shaken[:, 1].ravel())[0, 1]) < 0.15  # of two devices
    assert out[2][1] is streams[0][1]
    again = streamed.put_off(streams, 2)
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(again, out))  # the same noise, for every policy


def test_rounds(tmp_path, monkeypatch, capsys):
    """Two rounds: twice the captures, and the failures of both, counted ride by ride."""
    one = streamed.Set("aside", "builtin", "train", "stop*")
    monkeypatch.setattr(streamed, "TRAINED", (one,))
    monkeypatch.setattr(streamed, "MINUTE", 3.0)
    out = tmp_path / "table.json"
    words = ["--character", "dino", "--half", "train", "--rounds", "2", "--json", str(out), "--threads", "1"]
    assert streamed.main(words) == 0
    aside, every, limp, _ = json.loads(out.read_text()).values()
    printed = capsys.readouterr().out
    assert f"{CHARACTER}, dino, training captures, 2 rounds" in printed
    assert "| failures |" in printed and "springs" not in printed
    policy, _, _ = metrics.find_policy(metrics.Options(character="dino"))
    char = character.load("dino")
    streams = [stream_of(char, c, 3)[:2] for c in streamed.captures_of(one, tmp_path, "train")]
    still = lambda obs: np.zeros((len(obs), len(char.limits)))  # noqa: E731
    for row, act in ((every, policy.mean_action), (limp, still)):
        rides = [ride(char, act, [s])[0] for s in streamed.put_off(streams, 2)]
        assert row["clips"] == len(rides) == 2 * len(streams)
        assert row["failures"] == sum(r.failures for r in rides)
        assert row["completed"] == pytest.approx(np.mean([r.failures == 0 for r in rides]))
    assert limp["failures"] > 0 and aside["failures"] == every["failures"]


def test_motionless():
    """A minute is played, in which no device moves."""
    pos, quat = streamed.motionless(character.load("dino"), 3)
    assert 60.0 <= len(pos) / data.CONTROL_RATE <= streamed.MINUTE - 0.9
    assert np.ptp(pos, axis=0).max() < 1e-6 and np.ptp(quat, axis=0).max() < 1e-6


def headset_file(path, seconds, speed):
    """A headset's and two controllers' recording, of somebody who stands and then goes straight on."""
    t = np.arange(0.0, seconds, 1 / 45)
    x = np.maximum(t - 1.5, 0.0) * speed
    rows = [[s, *(v for side in ((0, 1.7), (-0.3, 1), (0.3, 1)) for v in (*side, d, 0, 0, 0, 1))] for s, d in zip(t, x)]
    names = [f"{n}_{k}" for n in ("head", "left", "right") for k in ("px", "py", "pz", "qx", "qy", "qz", "qw")]
    head = ",".join(["time", *names])
    path.write_text(head + "\n" + "\n".join(",".join(f"{v:.5f}" for v in row) for row in rows) + "\n")


def test_recordings(tmp_path):
    """A row a source: the first word of the files' names; a broken file costs itself alone, and is named."""
    for name in ("game_1.csv", "game_2.csv", "walk_1.csv"):
        headset_file(tmp_path / name, 3.0, 0.3)
    (tmp_path / "walk_2.csv").write_text("time,head_px\n0,1\n")
    found, [broken] = streamed.recorded(character.load("dino"), tmp_path, 3)
    assert "walk_2.csv" in broken
    assert {k: len(v) for k, v in found.items()} == {"recordings: game": 2, "recordings: walk": 1}
    pos, quat = found["recordings: walk"][0]
    assert pos.shape[1:] == (3, 3) and quat.shape[1:] == (3, 4) and len(pos) == len(quat)


def test_command(tmp_path, monkeypatch, capsys):
    """The rows of two policies: as `metrics.streamed` has them, and in the file; no torque completes nothing."""
    one = streamed.Set("walks", "builtin", clips="walk_*")
    monkeypatch.setattr(streamed, "SETS", (one, streamed.Set("gone", "bandai"), streamed.Set("thin", "cmu")))
    (tmp_path / "cmu").mkdir()
    monkeypatch.setattr(streamed, "MINUTE", 3.0)
    monkeypatch.setattr(metrics, "MOST", 2)
    other, out = tmp_path / "other.npz", tmp_path / "table.json"
    shutil.copy(CHARACTER, other)
    words = ["--character", "dino", "--policy", CHARACTER, other, "--mocap", tmp_path, "--half", "select"]
    assert streamed.main([*map(str, words), "--json", str(out)]) == 1  # for the set that holds nothing
    (printed, wrong), rows = capsys.readouterr(), json.loads(out.read_text())
    assert wrong.splitlines()[-1].startswith(f"error: {tmp_path / 'cmu'}: a folder without motion")
    assert f"--mocap {tmp_path} is without gone; thin" in printed and printed.count("| all, no torque |") == 1
    mine, again = ([v for k, v in rows.items() if k.startswith(f"{p}: ")] for p in (CHARACTER, other))
    assert len(mine) == 4 and mine[:2] + mine[3:] == again  # no torque: once a body
    walks, every, limp, still = mine
    policy, path, meta = metrics.find_policy(metrics.Options(character="dino"))
    char = character.load("dino")
    direct = metrics.streamed(char, policy.mean_action, streamed.captures_of(one, tmp_path, "select"))
    assert 1.0 < walks.pop("statue_cm") < 100.0
    assert walks == pytest.approx(json.loads(metrics.as_json({"": direct}))[""])
    assert every["completed"] == walks["completed"] > limp["completed"] == 0.0
    assert still["clips"] == 1 and still["completed"] == 1.0


@pytest.mark.parametrize(
    "words, says",
    [
        (["--mocap", "/nope"], "--mocap /nope: no such folder"),
        (["--recordings", "/nope"], "--recordings /nope: no such folder"),
        (["--policy", "nope.npz"], "no policy nope.npz"),
        (["--character", "oppy", "--policy", str(CHARACTER)], "oppy needs"),
        (["--json", "/nope/x.json"], "there is no folder /nope"),
    ],
)
def test_wrong_commands(words, says, monkeypatch):
    """One line, before any motion is read."""
    monkeypatch.setattr(streamed, "captures_of", lambda *_: pytest.fail("motion was read"))
    with pytest.raises(UserError, match=says):
        streamed.main(words)

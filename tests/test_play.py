"""Play: running, failing, pushing, choosing; policies beside one another."""

import functools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

import character
import metrics
import play
import retarget
from env import Env, headset_only
from headset.player import ride, stream_of
from headset.reader import controllers_hang
from human import heading
from mocap import bvh, data
from mocap.augment import looking
from plumbing import render
from plumbing.cli import UserError
from plumbing.runs import save_checkpoint
from policy import Policy, load_policy, trained_as

COLUMNS = [key for key, *_ in metrics.COLUMNS]


@pytest.fixture(scope="module")
def char():
    return character.load("jesse")


@pytest.fixture(scope="module")
def ref(char):
    walk, stand = (data.load("builtin", clips=c)[0] for c in ("walk_005", "stand_007"))
    return retarget.reference(char, [walk[:40], stand[:90], walk[60:90]])


@pytest.fixture(scope="module")
def long(char):
    return retarget.reference(char, data.load("builtin", clips="stand_007"))


def cheat(env):
    """No torque, but the state is put back on the reference first: it survives for as long as there are frames."""
    env.qpos[:], env.qvel[:] = env.ref.qpos[env.frame], env.ref.qvel[env.frame]
    return metrics.zero_action(env)


# ------------------------------------------------------------------------------------ pushes


def test_push(char, ref):
    """What the flag says, when the force acts, and the momentum it gives: N × 0.2 s along the heading."""
    assert metrics.parse_push(None) is None and metrics.parse_push("200@2") == metrics.Push(200.0, 2.0, 0.0)
    assert metrics.parse_push("50.5@.5:left") == metrics.Push(50.5, 0.5, np.pi / 2)
    for text in ("200", "200@", "-3@2", "200@2:up", "nan@2", "200@2:leftx"):
        with pytest.raises(UserError, match="valid: N@T or N@T:DIRECTION.*forward, left, back, right"):
            metrics.parse_push(text)
    push = metrics.parse_push("300@0.1:right")
    times = np.array([0.0, 0.09, 0.1, 0.29, 0.3, 1.0])
    assert np.flatnonzero(np.linalg.norm(push.force(times, np.zeros(6)), axis=1)).tolist() == [2, 3]
    assert np.allclose(push.force(0.1, np.pi / 2), [300, 0, 0])  # its right, when it looks along y
    env = Env(char, ref, 1, threads=1, autoreset=False, horizon=1000)
    env.reset(frames=[1])
    env.qpos[:, 2] += 5.0  # in the air nothing else pushes
    env.qvel[:] = 0.0
    yaw, xfrc, com = heading(env.qpos[0, 3:7]), env.batch.bind("xfrc_applied"), []
    env.batch.forward(np.arange(1), retarget.STAGE_VEL)
    for _ in range(15):
        xfrc[:, char.root, :3] = push.force(env.steps * env.dt, yaw)
        com.append(env.com[0, char.root].copy())
        env.step(metrics.zero_action(env))
    velocity = (com[14] - com[12]) / (2 * env.dt)
    gain = 300 * metrics.PUSH_SECONDS / char.model.body_subtreemass[0]
    np.testing.assert_allclose(velocity[:2], gain * np.array([np.sin(yaw), -np.cos(yaw)]), rtol=0.02, atol=0.01)


def test_largest_push(char, ref, monkeypatch):
    """What it reports is survived, and a little more is not; without a survivor it says so."""
    monkeypatch.setattr(metrics, "RECOVERY", 1.0)
    found = metrics.largest_push(char, ref, cheat, 0.5, 60_000.0, rounds=5, threads=1)
    assert found["tried"] == 1 and found["resolution"] == 60_000 / 32
    for name, angle in metrics.DIRECTIONS.items():
        (most,) = found[name]
        assert 0 < most < 60_000
        for newtons, fails in ((most, False), (most + found["resolution"], True)):
            rec = metrics.simulate(char, ref, cheat, only=[1], threads=1, push=metrics.Push(newtons, 0.5, angle))[0]
            assert rec.failed is fails
    text = metrics.push_report(found, metrics.Push(60_000.0, 0.5))
    assert "1 of 1 sequences" in text and text.count("median") == 4
    limp = metrics.largest_push(char, ref, lambda env: np.ones((env.n, env.action_size)), 0.5, 100.0, threads=1)
    assert len(limp["left"]) == 0 and "0 of 1 sequences" in metrics.push_report(limp, metrics.Push(100.0, 0.5))
    with pytest.raises(UserError, match="no sequence is 31.0 s long"):
        metrics.largest_push(char, ref, cheat, 30.0, 100.0)
    five, tried = retarget.reference(char, [data.load("builtin", clips="stand_007")[0][:50]] * 5), []
    act = lambda env: (tried.append(env.sequence.copy()), cheat(env))[1]  # noqa: E731
    assert metrics.largest_push(char, five, act, 0.5, 100.0, sequences=3, rounds=0, threads=1)["tried"] == 3
    assert set(np.ravel(tried)) == {0, 2, 4}  # evenly chosen


def test_largest_push_of_what_is_shown(char, tmp_path, monkeypatch):
    """§4.2: a policy of the headset alone sees nothing else while it is pushed."""
    monkeypatch.setattr(metrics, "RECOVERY", 0.2)
    clips = [data.load("builtin", clips="stand_007")[0][:30]]
    monkeypatch.setattr(metrics, "motion_of", lambda opt: (clips, clips))
    less = headset_only(retarget.reference(char, clips))
    path, out = save_policy(tmp_path / "hmd.npz", char, less, character="jesse", sensors="hmd"), tmp_path / "p.json"
    play.main(["--policy", str(path), "--measure", "--push", "2000@0", "--threads", "1", "--json", str(out)])
    found = metrics.largest_push(char, less, metrics.policy_action(load_policy(path)[0]), 0.0, 2000.0, threads=1)
    assert json.loads(out.read_text()) == {k: np.array(v).tolist() for k, v in found.items()}
    assert 0 < found["left"] < found["back"] < 2000


# ------------------------------------------------------------------------------------ what drives it


def test_pd_action(char, ref):
    env = Env(char, ref, 5, threads=1)
    env.reset(0)
    rng = np.random.default_rng(0)
    env.qpos[:, 7:] += 0.2 * rng.standard_normal((5, char.j))
    env.qvel[:] += rng.standard_normal(env.qvel.shape)
    a = metrics.pd_action(env)
    assert a.shape == (5, char.model.nu) and np.abs(a).max() == 1.0 and (np.abs(a) < 1).any()
    for n in range(5):
        for k in range(char.model.nu):
            joint = char.model.actuator_trnid[k, 0]
            p, v = char.model.jnt_qposadr[joint], char.model.jnt_dofadr[joint]
            goal_p, goal_v = ref.qpos[env.frame[n], p], ref.qvel[env.frame[n], v]
            x = metrics.PD_STIFFNESS * (goal_p - env.qpos[n, p]) + metrics.PD_DAMPING * (goal_v - env.qvel[n, v])
            assert a[n, k] == pytest.approx(max(-1.0, min(1.0, x)))
    env.reset(0)
    np.testing.assert_allclose(metrics.pd_action(env), 0.0, atol=1e-12)  # on the reference there is nothing to correct
    np.testing.assert_array_equal(metrics.zero_action(env), np.zeros((5, char.model.nu)))


def test_policy_action_is_the_mean(char, ref):
    env = Env(char, ref, 4, threads=1)
    env.reset(0)
    rng = np.random.default_rng(0)
    policy = Policy(env.obs_size, env.critic_size, env.action_size, (8,), (4,), 5.0, 1.0, rng)
    act = metrics.policy_action(policy)
    np.testing.assert_array_equal(act(env), act(env))  # no noise, whatever σ
    np.testing.assert_array_equal(act(env), policy.mean_action(env.full[:, : env.obs_size]))
    before = act(env)
    env.full[:, env.obs_size :] += 1.0  # what only the critic may see
    np.testing.assert_array_equal(act(env), before)


def test_simulate(char, ref):
    recordings = metrics.simulate(char, ref, metrics.zero_action, threads=1)
    assert len(recordings) == 3 and any(r.failed for r in recordings)
    for i, rec in enumerate(recordings):
        env = Env(char, ref, 1, threads=1, autoreset=False)
        env.reset(frames=ref.first[[i]])
        np.testing.assert_array_equal(rec.qpos[0], ref.qpos[ref.first[i]])
        np.testing.assert_array_equal(rec.contact[0], ref.contact[ref.first[i]])
        assert rec.available == ref.last[i] - ref.first[i] and not rec.action[0].any()
        for k in range(1, rec.available + 2):
            if k == len(rec.frames):
                break
            _, _, terminated, truncated, _ = env.step(np.zeros((1, env.action_size)))
            assert not terminated[0]  # no state that failed is in the recording
            np.testing.assert_allclose(rec.qpos[k], env.qpos[0], atol=1e-9)
            np.testing.assert_array_equal(rec.contact[k], env.contact[0])
            assert rec.frames[k] == env.frame[0] == ref.first[i] + k
        if rec.failed:
            assert env.step(np.zeros((1, env.action_size)))[2][0] and len(rec.frames) <= rec.available
        else:
            assert truncated[0] and rec.frames[-1] == ref.last[i] and len(rec.frames) == rec.available + 1
    only = metrics.simulate(char, ref, metrics.zero_action, threads=1, only=[1])
    assert len(only) == 1 and len(only[0].frames) == len(recordings[1].frames)
    np.testing.assert_allclose(only[0].qpos, recordings[1].qpos, atol=1e-9)


def test_what_happens_after_the_end_does_not_count(char, ref):
    """Sequences of other lengths go on beside one that is complete; it may fall then."""

    def fall_later(env):
        action = cheat(env)
        if env.steps[0] > 32:
            env.qpos[2, 0] += 5.0
        return action

    first, second, third = metrics.simulate(char, ref, fall_later, threads=1)
    assert not (first.failed or second.failed or third.failed)
    assert [len(r.frames) for r in (first, second, third)] == [40, 90, 30]


def test_simulate_stops_at_500_steps(char, long):
    assert len(long) > 600
    (rec,) = metrics.simulate(char, long, cheat, threads=1)
    assert not rec.failed and rec.available == 500 and len(rec.frames) == 501 and rec.frames[-1] == 500
    (kin,) = metrics.kinematic(char, long)
    assert kin.available == 500 and len(kin.frames) == 501
    (short,) = metrics.simulate(char, long, cheat, horizon=7, threads=1)
    assert short.available == 7 and len(short.frames) == 8 and not short.failed


def test_time_to_failure(char, long, monkeypatch):
    assert metrics.time_to_failure(char, long, cheat, n=3, seconds=1.0, threads=1) == float("inf")
    found = metrics.time_to_failure(char, long, metrics.zero_action, n=6, seconds=3.0, seed=4, threads=1)
    env = Env(char, long, 6, threads=1, autoreset=False)
    draw = np.random.default_rng(4)  # the starts that the environment draws, replayed by hand
    env.reset(frames=env.starts.draw(draw, 6)[0])
    failures = 0
    for _ in range(90):
        _, _, terminated, truncated, _ = env.step(np.zeros((6, env.action_size)))
        failures += terminated.sum()
        done = np.flatnonzero(terminated | truncated)
        if len(done):
            env._reset(done, env.starts.draw(draw, len(done))[0])
    assert failures >= 3 and found == pytest.approx(6 * 3.0 / failures)
    monkeypatch.setattr(metrics, "time_to_failure", functools.partial(metrics.time_to_failure, seconds=3.0))
    opt = play.Options(random_starts=6, seed=4, threads=1)
    rows = [metrics.measure_one("zero", char, long, metrics.zero_action, replace(opt, seed=s)) for s in (4, 0)]
    assert rows[0]["fails_every_s"] == found != rows[1]["fails_every_s"]  # from the starts that --seed draws


# ------------------------------------------------------------------------------------ command line


def save_policy(path, char, ref, seed=0, **options):
    """A small policy that fits, in a file that says what it was trained for."""
    env = Env(char, ref, 1, threads=1)
    policy = Policy(env.obs_size, env.critic_size, env.action_size, (8,), (4,), 0.1, 1.0, np.random.default_rng(seed))
    policy.norm.update(np.random.default_rng(1).standard_normal((50, env.critic_size)))
    policy.theta_pi[:] *= 30.0  # so that two policies do different things
    policy.log_std[:] = -2.0
    meta = {"policy": policy.shape(), "steps": 1500}
    save_checkpoint(path, policy.arrays(), meta | ({"options": options} if options else {}))
    return path


@pytest.fixture
def policy_file(char, ref, tmp_path):
    return save_policy(tmp_path / "p.npz", char, ref)


def test_measure_json(policy_file, tmp_path, capsys, monkeypatch):
    one = [data.load("builtin", clips="walk_005")[0][:70]]
    monkeypatch.setattr(metrics, "motion_of", lambda opt: (one, one))
    monkeypatch.setattr(metrics, "time_to_failure", functools.partial(metrics.time_to_failure, seconds=1.0))
    out = tmp_path / "table.json"
    args = ["--policy", str(policy_file), "--measure", "--json", str(out), "--threads", "1"]
    play.main([*args, "--random-starts", "4"])
    text = capsys.readouterr().out
    rows = json.loads(out.read_text(), parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert list(rows) == ["streamed", "tracked", "kinematic", "zero", "pd"]
    for name, row in rows.items():
        assert set(COLUMNS) - {"fails_every_s", "first_failure_s", "within_1m"} <= set(row), name
        assert ("fails_every_s" in row) == (name != "kinematic")
        assert all(v is None or isinstance(v, int | float) for v in row.values())
        assert f"| {name} |" in text
        assert row["human_jitter_m_s3"] > 0
    assert rows["kinematic"]["completed"] == 1.0 and rows["kinematic"]["root_cm"] == pytest.approx(0.0)
    assert rows["zero"]["torque_rms"] == 0.0 < rows["pd"]["torque_rms"]


def test_split_and_all(policy_file, monkeypatch):
    asked = []

    def sequences(motion, split, clips, seed, reading):
        asked.append((motion, split, clips, seed))
        raise UserError("enough")

    monkeypatch.setattr(data, "sequences", sequences)
    monkeypatch.setattr(data, "load", lambda *a, **k: [])
    for more in ([], ["--split", "train"], ["--split", "style"], ["--all"], ["--clips", "*walk*", "--seed", "3"]):
        with pytest.raises(UserError, match="enough"):
            play.main(["--measure", "--policy", str(policy_file), *more])
    assert [a[1] for a in asked] == ["validation", "train", "style", "all", "validation"]
    assert asked[-1][2:] == ("*walk*", 3)


def test_which_policy(policy_file, tmp_path, monkeypatch, char, ref):
    with pytest.raises(UserError, match="no policy .*missing.npz: train one .*ppo.py --character jesse"):
        play.main(["--measure", "--policy", str(tmp_path / "missing.npz")])
    for name in ("jesse.toml", "jesse.xml"):
        (tmp_path / name).write_bytes((character.CHARACTERS / name).read_bytes())
    monkeypatch.setattr(character, "CHARACTERS", tmp_path)
    with pytest.raises(UserError, match="no policy .*jesse.npz"):
        metrics.find_policy(play.Options())
    (tmp_path / "jesse.npz").write_bytes(policy_file.read_bytes())
    assert metrics.find_policy(play.Options())[1] == tmp_path / "jesse.npz"  # shipped beside the character
    elsewhere = tmp_path / "mine" / "bob.toml"
    elsewhere.parent.mkdir()
    with pytest.raises(UserError, match="no file .*mine/bob.toml"):
        metrics.find_policy(play.Options(character=str(elsewhere)))
    elsewhere.write_text((tmp_path / "jesse.toml").read_text())
    (elsewhere.parent / "jesse.xml").write_bytes((tmp_path / "jesse.xml").read_bytes())
    with pytest.raises(UserError, match="no policy .*mine/bob.npz"):
        metrics.find_policy(play.Options(character=str(elsewhere)))
    other = Policy(7, 9, 2, (4,), (4,), 0.1, 1.0, np.random.default_rng(0))
    save_checkpoint(tmp_path / "other.npz", other.arrays(), {"policy": other.shape()})
    monkeypatch.undo()
    monkeypatch.setattr(data, "sequences", lambda *_, **__: data.load("builtin", clips="stand_007"))
    with pytest.raises(UserError, match="other.npz: a policy of 7 observations and 2 actions; jesse needs"):
        play.main(["--measure", "--policy", str(tmp_path / "other.npz")])


def test_what_cannot_be_done_is_said_first(policy_file, tmp_path):
    """Before anything is simulated."""
    with pytest.raises(UserError, match="nothing to do: give --measure"):
        play.main(["--policy", str(policy_file)])
    with pytest.raises(UserError, match="--json writes the table of --measure, --compare or --stream"):
        play.main(["--policy", str(policy_file), "--json", "x.json", "--png", "x.png"])
    for flag, name in (("--json", "t.json"), ("--png", "t.png"), ("--video", "t.mp4")):
        with pytest.raises(UserError, match=f"cannot write .*{name}: there is no folder"):
            play.main(["--policy", str(policy_file), "--measure", flag, str(tmp_path / "none" / name)])
    with pytest.raises(UserError, match="--sequence 7: there are 1, from 0"):
        play.main(["--policy", str(policy_file), "--png", "x.png", "--sequence", "7", "--clips", "walk_005"])
    late = ["--policy", str(policy_file), "--clips", "walk_005", "--push", "100@9000"]
    with pytest.raises(UserError, match="no sequence is 9003.0 s long: push before [1-9]"):
        play.main([*late, "--measure"])
    with pytest.raises(UserError, match="--push 100@9000: only .* s are shown: push earlier, or give more --seconds"):
        play.main([*late, "--bvh", str(tmp_path / "walk.bvh")])
    assert not (tmp_path / "walk.bvh").exists()
    compare = ["--compare", str(policy_file), str(policy_file.with_name("q.npz"))]
    for wrong, says in (
        (compare[:2], "two policies or more, none twice"),
        ([*compare, str(policy_file)], "none twice"),
        ([*compare, "--character", "jesse", "--bvh", "x.bvh", "--scale", "2"], "leave out --character, --scale, --bvh"),
        ([*compare, "--push", "400@2"], "leave out --push"),
        ([*compare, "--rows", "tracked,zero,pd"], "--rows zero,pd: is of no policy; valid: streamed"),
        ([*compare, "--json", str(tmp_path / "none" / "t.json")], "there is no folder"),
    ):
        with pytest.raises(UserError, match=says):
            play.main(wrong)


# ------------------------------------------------------------------------------------ what the file says


def test_what_is_read_is_not_overwritten(policy_file, tmp_path):
    """The files of a character, its policy found beside it, and a policy that is compared."""
    for kind in (".toml", ".xml", ".npz"):
        (tmp_path / f"mine{kind}").touch()
        for more in (["--stream", __file__], ["--measure"], []):
            out = str(tmp_path / f"mine{kind}")
            flag = "--json" if more else "--bvh"
            with pytest.raises(UserError, match=f"cannot write .*mine{kind}: it is read from"):
                play.main(["--character", str(tmp_path / "mine.toml"), flag, out, *more])
    with pytest.raises(UserError, match="cannot write .*p.npz: it is read from"):
        play.main(["--compare", "x.npz", str(policy_file), "--json", str(policy_file)])


@pytest.mark.parametrize(
    "flags, says",
    [
        ("--png x.png --half report --rows tracked", "--half, --rows says something of --measure or --compare alone"),
        ("--bvh x.bvh --random-starts 4", "--random-starts says something of --measure or --compare alone"),
        ("--measure --port 8080", "--port says something of --view web alone"),
        ("--stream x.csv --port 8080", "--port says something of --view web alone"),
        ("--stream x.csv --every 1", "--every says something of --png alone"),
        ("--stream x.csv --seed 1", "--seed is of a motion, and --stream has none"),
        ("--figure 5 --half report", "--figure 5: has its own policies, streamed: leave out --half"),
    ],
)
def test_flags_of_what_is_not_asked_for(flags, says):
    """Refused, not passed over."""
    with pytest.raises(UserError, match=says):
        play.main(flags.split())


def test_seconds_of_a_bvh(policy_file, tmp_path, monkeypatch, char, ref):
    """All frames, or as many as --seconds says."""
    monkeypatch.setattr(play, "sequence_of", lambda *_: ref)
    monkeypatch.setattr(play, "policy_action", lambda _: cheat)
    for more, frames in ([], 40), (["--seconds", "1"], 31), (["--seconds", "0.01"], 2):
        play.main(["--policy", str(policy_file), "--bvh", str(tmp_path / "o.bvh"), "--threads", "1", *more])
        assert len(bvh.read(tmp_path / "o.bvh").values) == frames


def test_character_of_the_policy(char, ref, tmp_path):
    """The policy's own character and variation, unless a flag says something else."""
    meta = {"options": {"character": "oppy", "scale": 0.8, "set": "reward.contact=[0, 1]"}}

    def variant(meta=meta, **flags):
        char = metrics.load_character(play.Options(**flags), meta, "p")
        return char.name, char.variant

    own = {"scale": 0.8, "set": ["reward.contact=[0, 1]"]}
    assert variant() == variant(character="oppy") == ("oppy", own)
    assert variant(scale=1.2) == ("oppy", own | {"scale": 1.2})
    assert variant(scale=1.0) == ("oppy", {"set": own["set"]}) and variant(character="jesse") == ("jesse", {})
    assert variant({}) == variant({"options": {"lr": 1}}) == ("jesse", {})
    assert variant({}, scale=0.9) == ("jesse", {"scale": 0.9})
    for damage in ({"scale": "big"}, {"scale": -1.0}, {"tail": 3}, {"set": [1]}, {"character": None}):
        with pytest.raises(UserError, match="p: its options name no character"):
            variant({"options": meta["options"] | damage})
    path = save_policy(tmp_path / "p.npz", char, ref, character="jesse", sensors="hmd", scale=2)
    with pytest.raises(UserError, match="a policy of 189 observations .* jesse needs 153"):
        play.main(["--policy", str(path), "--measure", "--clips", "walk_005"])


def test_note_on_another_body(capsys):
    """Another size or posture that happens to have as many joints is played, and said; other weights are not."""
    meta = {"options": {"character": "oppy", "scale": 1.7, "set": "reward.contact=[0, 1]; pose.spine_y=0.1"}}
    note = "note: p was trained with --set pose.spine_y=0.1 --scale 1.7, and is played with"
    for flags, says in (
        ({}, ""),
        ({"scale": 1.7}, ""),
        ({"set": "reward.q=[1, 2]; pose.spine_y=0.1"}, ""),
        ({"scale": 1.0}, f"{note} --set pose.spine_y=0.1\n"),
        ({"set": "reward.q=[1, 2]", "scale": 1.0}, f"{note} no changes\n"),
    ):
        metrics.load_character(play.Options(**flags), meta, "p")
        assert capsys.readouterr().err == says
    metrics.load_character(play.Options(scale=1.5), {}, "p")
    assert not capsys.readouterr().err  # what it was trained as is not known


def test_headset_only(char, ref, tmp_path):
    """§4.2: a policy of the headset alone sees it alone; another one's controllers hang; targets stay the user's."""
    less = headset_only(ref)
    full, hmd = ({"options": {"sensors": s}} for s in ("full", "hmd"))
    assert metrics.shown_to(full, "p", ref, None) is ref and metrics.shown_to({}, "p", ref, "full") is ref
    np.testing.assert_array_equal(metrics.shown_to(full, "p", ref, "hmd").sensor_pos, controllers_hang(ref).sensor_pos)
    for flag in (None, "hmd"):
        assert metrics.shown_to(hmd, "p", ref, flag).sensor_pos.shape == less.sensor_pos.shape
    with pytest.raises(UserError, match="p: was trained with the headset alone"):
        metrics.shown_to(hmd, "p", ref, "full")

    policy, _ = load_policy(save_policy(tmp_path / "hmd.npz", char, less, sensors="hmd"))
    opt = play.Options(random_starts=0, threads=1)
    seen = []
    act = lambda env: (seen.append(env.full.copy()), metrics.policy_action(policy)(env))[1]  # noqa: E731
    row = metrics.measure_one("policy", char, ref, act, opt, less)
    assert seen[0].shape[1] == 459 - 36
    again = metrics.measure(char, ref, metrics.simulate(char, less, metrics.policy_action(policy), threads=1))
    assert row == pytest.approx(again, nan_ok=True)
    assert row["hands_cm"] > 1.0  # to the user's hands, which it was not shown
    hang = controllers_hang(ref)
    hung = metrics.measure_one("zero", char, ref, metrics.zero_action, opt, hang)
    assert hung["hands_cm"] != metrics.measure_one("zero", char, ref, metrics.zero_action, opt)["hands_cm"]
    given = metrics.measure(char, hang, metrics.simulate(char, ref, metrics.zero_action, threads=1))
    assert hung["hands_cm"] == pytest.approx(given["hands_cm"])  # to the hands it was shown, which hang
    rows = metrics.measure_all(char, ref, policy, opt, less)
    assert rows["tracked"] == pytest.approx(row, nan_ok=True) and list(rows) == ["tracked", "kinematic", "zero", "pd"]


def test_a_long_sheet_has_sixty_pictures(tmp_path, monkeypatch, capsys):
    """Half a second apart while they are few, evenly spread where they would be many; --every says otherwise."""
    drawn = []
    monkeypatch.setattr(play, "pictures", lambda char, ref, recording, frames, *_, **__: drawn.append(list(frames)))
    monkeypatch.setattr(render, "contact_sheet", lambda images, labels, columns: None)
    monkeypatch.setattr(render, "write_png", lambda path, image: None)
    for last, every in ((90, None), (3600, None), (3600, 1.0)):
        play._write_pictures(None, None, None, last, play.Options(png=str(tmp_path / "a.png"), every=every))
    assert drawn[0] == list(range(0, 91, 15)) and drawn[1] == list(range(0, 3601, 60)) and len(drawn[2]) == 121
    assert capsys.readouterr().out.count("a.png") == 3


# ------------------------------------------------------------------------------------ comparing


@pytest.fixture
def two(tmp_path, monkeypatch):
    """Policies of two characters, one of them smaller and with the headset alone, and the clips they are shown."""
    clips = [data.load("builtin", clips=c)[0][:45] for c in ("walk_005", "stand_007")]
    monkeypatch.setattr(data, "sequences", lambda *_, **__: clips)
    monkeypatch.setattr(data, "load", lambda *_, **__: list(clips))
    out = []
    for name, options in (("jesse", {"sensors": "hmd", "without": ["contact"]}), ("oppy", {"scale": 0.8})):
        char = character.load(name, scale=options.get("scale", 1.0))
        ref = retarget.reference(char, clips)
        ref = headset_only(ref) if "sensors" in options else ref
        out.append(save_policy(tmp_path / f"{name}.npz", char, ref, seed=3, character=name, **options))
    return out


def test_compare(two, tmp_path, capsys):
    """Each policy in its own column, as it measures alone, on the same sequences; its title says what it is."""
    out = tmp_path / "t.json"
    more = ["--random-starts", "0", "--threads", "1"]
    play.main(["--compare", *map(str, two), "--json", str(out), *more])
    text = capsys.readouterr().out
    rows = json.loads(out.read_text())
    policies = [name for path in two for name in (f"{path} streamed", f"{path} tracked")]
    assert list(rows) == [*policies, "kinematic jesse", "kinematic oppy scale 0.8"]
    assert f"{two[0]}: jesse, 1.5k steps, without contact, headset only" in text
    assert f"{two[1]}: oppy scale 0.8, 1.5k steps\n" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert lines[0].split("|")[2:6] == [f" {p} " for p in policies]
    assert len(lines) == len(COLUMNS) + 2 + 2 + len(metrics.FIELD) + 2
    for path in two:
        play.main(["--policy", str(path), "--measure", "--json", str(out), *more])
        alone = json.loads(out.read_text())
        assert alone["tracked"] == rows[f"{path} tracked"] and alone["streamed"] == rows[f"{path} streamed"]
    assert alone["kinematic"] == rows["kinematic oppy scale 0.8"]
    [arm] = metrics.arms_of(data.sequences()[:1], play.Options(compare=(str(two[1]),)))
    title = replace(arm, meta=arm.meta | {"carried": "old.npz"}).title()
    assert title.endswith("1.5k steps, carried over from old.npz, not trained since")
    play.main([f"--compare={two[0]},{two[1]}", "--sensors", "hmd", "--json", str(out), *more])
    hanging = json.loads(out.read_text())
    for path, same in ((two[0], True), (two[1], False)):
        for name in (f"{path} streamed", f"{path} tracked"):
            assert (hanging[name] == rows[name]) is same
    assert "oppy scale 0.8, 1.5k steps, controllers hang" in capsys.readouterr().out
    with pytest.raises(UserError, match="oppy.npz|jesse.npz"):
        play.main(["--compare", *map(str, two), "--sensors", "full", *more])


def test_comparison_sheet_streamed(two, monkeypatch):
    """Without the tracked row: from the default pose, by the sensors of a stream, until the first fall."""
    clip = data.sequences()[0]
    opt = play.Options(compare=tuple(map(str, two)), rows=("streamed",), threads=1)
    for arm in metrics.arms_of([clip], opt):
        recording, shown = play.played(arm, clip, opt)
        pos, quat, _, _ = stream_of(arm.char, clip, arm.devices)
        np.testing.assert_allclose(shown.sensor_pos[:, 0], pos[:, 0], atol=1e-6)
        if arm.devices == 3:
            _, hung = play.played(arm, clip, replace(opt, sensors="hmd"))
            assert np.abs(hung.sensor_pos[:, 1:] - pos[:, 1:]).max() > 0.1
        [r] = ride(arm.char, arm.policy.mean_action, [(pos, quat)], arm.devices, 1)
        np.testing.assert_allclose(recording.qpos[:10], r.qpos[:10], atol=1e-3)
        assert len(recording.qpos) == len(recording.frames) <= len(r.qpos)


def test_comparison_sheet(two, tmp_path, monkeypatch):
    """A row of eight pictures for the human and for each policy, at the same moments; empty where one had failed."""
    if render.gl_backend() is None:
        pytest.skip("no OpenGL")
    clips = data.sequences()
    opt = play.Options(compare=tuple(map(str, two)), threads=1)
    arms = metrics.arms_of(clips, opt)
    falls = lambda obs: np.ones((len(obs), arms[1].char.model.nu))  # noqa: E731
    arms[1].policy.mean_action = falls
    lived = metrics.simulate(arms[1].char, arms[1].seen, lambda env: falls(env.full), threads=1, only=[0])[0]
    assert len(lived.frames) < 40
    sheet = play.comparison_sheet(arms, clips[0], opt, size=(96, 80))
    assert sheet.shape == (3 * (20 + 80), 8 * 96, 3) and sheet.dtype == np.uint8
    cells = sheet.reshape(3, 100, 8, 96, 3)[:, 20 + 18 :].swapaxes(1, 2)  # (row, column, …) below the labels
    white = (cells == 255).all((2, 3, 4))
    times = np.unique(np.arange(0, 45, 44 / 7).round().astype(int))
    np.testing.assert_array_equal(white, [[False] * 8, white[1], [t >= len(lived.frames) for t in times]])
    assert not white[:, 0].any() and white[2, -1]
    blank = lambda *a, **_: [np.zeros((80, 96, 3), np.uint8)] * len(a[3])  # noqa: E731, drawing is slow
    monkeypatch.setattr(retarget, "draw", blank), monkeypatch.setattr(play, "pictures", blank)
    coarse = play.comparison_sheet(arms, clips[0], play.Options(threads=1, every=0.5, seconds=1.0), size=(96, 80))
    assert coarse.shape[1] == 3 * 96
    monkeypatch.setattr(play, "EPISODE_STEPS", 15)  # by which a tracked sequence ends, no streamed one
    for row, columns in (("tracked", 2), ("streamed", 3)):
        asked = play.Options(threads=1, every=0.5, seconds=1.0, rows=(row,))
        assert play.comparison_sheet(arms, clips[0], asked, size=(96, 80)).shape[1] == columns * 96


@pytest.fixture
def figure(two, monkeypatch):
    """Figure 6 is two untrained policies, on a second and a half of a walk."""
    clip = data.load("builtin")[0]
    monkeypatch.setattr(play, "CHARACTERS", two[0].parent)
    monkeypatch.setitem(play.FIGURES, 6, tuple(p.stem for p in two))
    monkeypatch.setattr(metrics, "motion_of", lambda opt: ([clip], [clip]))
    return clip


def test_figure(two, figure, tmp_path, monkeypatch, capsys):
    """The numbers are `metrics.streamed`'s; the sheet has a band of them under every policy; so has the video."""
    if render.gl_backend() is None:
        pytest.skip("no OpenGL")
    small = functools.partial(play.comparison_sheet, size=(300, 80))
    monkeypatch.setattr(play, "comparison_sheet", small)
    assert play.main(["--figure", "6", "--png", str(tmp_path / "f.png"), "--seconds", "1", "--threads", "1"]) == 0
    [arm, _] = metrics.arms_of([figure], play.Options(compare=tuple(map(str, two)), threads=1))
    row = metrics.streamed(arm.char, arm.policy.mean_action, [looking(figure)], arm.devices, 1)
    said = capsys.readouterr().out
    assert f"| root cm | {row['root_cm']:.1f} |" in said and "| joints cm |" not in said
    options = play.Options(figure=6, compare=tuple(map(str, two)), rows=("streamed",), threads=1, seconds=1.0)
    arms = metrics.arms_of([figure], options)
    numbers = {a.path: "one 1  two 2" for a in arms}
    with_numbers, without = small(arms, figure, options, numbers=numbers), small(arms, figure, options)
    assert len(with_numbers) - len(without) == 2 * 20 and with_numbers.shape[1] == without.shape[1]
    np.testing.assert_array_equal(with_numbers[-20:], play.lines_of("one 1  two 2", without.shape[1])[0])
    images = list(play.film(arms, figure, options, numbers, size=(96, 80)))
    height = 80 + 20 * len(play.lines_of("one 1  two 2", 96))
    assert len(images) == 31 and {i.shape for i in images} == {(height, 2 * 96, 3)}
    bands = play.lines_of("one 1  two 2  " + "x" * 99, 160)
    assert len(bands) == 2 and {b.shape for b in bands} == {(20, 160, 3)}


def test_same_view():
    """Bodies of one size, or two characters, keep their own cameras; two sizes of one are seen from one distance."""
    arm = lambda name, scale=1.0: SimpleNamespace(char=character.load(name, scale=scale))  # noqa: E731
    assert play.same_view([arm("oppy"), arm("oppy")]) is None and play.same_view([arm("oppy"), arm("jesse")]) is None
    view = play.same_view([small := arm("oppy", 0.9), tall := arm("oppy", 1.15)])
    assert view.distance == pytest.approx(7 * tall.char.hip_height) and view.trackbodyid == small.char.root


def test_figure_options(figure, tmp_path, monkeypatch):
    """One walk of one user unless another is asked for; a picture unless a video is; no flags of other plays."""
    of = lambda *argv: play.figure_options(play.cli(play.Options, ["--figure", "6", *argv], "t", ""), argv)  # noqa: E731
    opt = of()
    assert (opt.clips, opt.png, opt.rows) == (play.USER, "figure-6.png", ("streamed",))
    assert [Path(p).stem for p in opt.compare] == list(play.FIGURES[6])
    assert of("--motion", "x").clips == "*" and of("--clips", "turn_115").clips == "turn_115"
    assert of("--video", "v.mp4").png is None
    for wrong in (["--policy", "x"], ["--rows", "tracked"], ["--bvh", "x"], ["--sensors", "hmd"]):
        with pytest.raises(UserError, match=f"--figure 6: has its own policies, streamed: leave out {wrong[0]}"):
            of(*wrong)
    monkeypatch.setitem(play.FIGURES, 6, ("dino", "dino-gone"))
    monkeypatch.setattr(play, "CHARACTERS", tmp_path)
    (tmp_path / "dino.npz").touch()
    with pytest.raises(UserError, match="no policy .*dino-gone.npz; .*: git checkout .*dino-gone.npz"):
        of()


def test_shipped_figures():
    """What is shipped of a figure is small, of the body or reward that it is about, and trained as long as the rest."""
    told = {"small": "scale", "tall": "scale", "passive": "tail", "fixed": "tail"}
    there = {n for names in play.FIGURES.values() for n in names if (character.CHARACTERS / f"{n}.npz").is_file()}
    assert there == {n for names in play.FIGURES.values() for n in names}
    for name in sorted(there):
        path = character.CHARACTERS / f"{name}.npz"
        _, meta = load_policy(path)
        own, (_, _, kind) = trained_as(meta, path), name.partition("-")
        assert list(own.load().variant) == ([told[kind]] if kind in told else []), name
        assert path.stat().st_size < 1.5e6
        assert ("orientation" in meta["options"]["without"]) == (kind == "orientation")
        if kind in ("small", "tall"):
            assert (own.scale < 1) == (kind == "small")
        elif kind in told:
            assert own.tail == kind
    for names in (play.FIGURES[6], play.FIGURES[8]):
        steps = [load_policy(character.CHARACTERS / f"{n}.npz")[1]["steps"] for n in names]
        assert max(steps) < 1.02 * min(steps), names


def test_horizontal():
    """§5.2: bent over, its tail up, the shipped one follows a user for ten seconds."""
    lean, tail, clip = {}, {}, data.load("builtin", clips=play.USER)[0][:300]
    for name in ("dino-driven", "dino-horizontal"):
        policy, meta = load_policy(character.CHARACTERS / f"{name}.npz")
        char = trained_as(meta, name).load()
        [r] = ride(char, policy.mean_action, [stream_of(char, clip)[:2]], 3, 1)
        assert r.failures == 0
        body, sim, up, tip = char.model.body, mujoco.MjData(char.model), [], []
        for qpos in r.qpos[60:]:
            sim.qpos[:] = qpos
            mujoco.mj_kinematics(char.model, sim)
            trunk = sim.xpos[body("spine3").id] - sim.xpos[body("pelvis").id]
            up.append(np.degrees(np.arccos(trunk[2] / np.linalg.norm(trunk))))
            tip.append(sim.xpos[body("tail7").id, 2])
        lean[name], tail[name] = np.mean(up), np.mean(tip)
    assert lean["dino-horizontal"] > lean["dino-driven"] + 12.0  # degrees
    assert tail["dino-horizontal"] > tail["dino-driven"] + 0.1  # m


def test_told_life():
    """How long, and of one that failed why a tracked play ends."""
    shape = dict(qpos=None, contact=None, action=None)
    whole = metrics.Recording(np.arange(31), failed=False, available=30, **shape)
    assert play.told_life("walk", whole) == "walk: lived 1.0 s of 1.0"
    short = metrics.Recording(np.arange(16), failed=True, available=30, **shape)
    said = "walk: lived 0.5 s of 1.0: it fell, or was 0.3 m from the user's root (§3.6)"
    assert play.told_life("walk", short) == said

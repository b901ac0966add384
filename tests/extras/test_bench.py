"""extras/bench.py: the figures exist, are rates, and the parts cost less than the whole."""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

import character
import ppo
import retarget
from env import Env
from extras import bench, gym_env
from mocap import data
from plumbing.cli import UserError


def test_bench_json(tmp_path, capsys):
    out = tmp_path / "bench.json"
    bench.main(["--character", "jesse", "--envs", "16", "--rounds", "3", "--json", str(out)])
    r = json.loads(out.read_text())["characters"]["jesse"]
    needed = "physics environment inference update train policy_step_ms_p50 policy_step_ms_p99 peak_mb".split()
    assert all(r[k] > 0 for k in needed)
    # one control step of training is one of each part, so it cannot be faster than the slowest of them; the
    # environment is nearly all of it and timed apart, which scatters by more than the rest costs where other jobs run
    assert r["train"] < min(1.25 * r["environment"], r["inference"], r["update"])
    assert r["policy_step_ms_p50"] <= r["policy_step_ms_p99"]
    printed = capsys.readouterr().out
    assert f"{r['physics']:,.0f}" in printed and "policy step" in printed


def test_physics_is_the_same_physics():
    """`mujoco.rollout` from a reference state arrives where `Env.step` does."""
    char = character.load("jesse")
    clips = [c for c in data.builtin_clips() if c.name.startswith("walk")][:1]
    env = Env(char, retarget.reference(char, clips), 4, threads=1)
    physics = bench.Physics(env, np.random.default_rng(0))
    physics.step()
    frames = np.random.default_rng(0).choice(env.starts.frames, 4)
    env.reset(frames=frames)
    rng = np.random.default_rng(0)
    rng.choice(env.starts.frames, 4)
    env.step(0.13 * rng.standard_normal((4, 1, env.action_size))[:, 0])
    nq = char.model.nq
    start = mujoco.mj_stateSize(char.model, mujoco.mjtState.mjSTATE_TIME.value)
    alive = env.steps > 0
    assert alive.any()
    np.testing.assert_allclose(physics.state[alive, start : start + nq], env.qpos[alive], atol=1e-9)


def test_physics_table():
    """Few sub-steps are cheaper; the reference agrees with itself; settings are put back."""
    char = character.load("jesse")
    ref = retarget.reference(char, [c for c in data.builtin_clips() if c.name.startswith("walk")][:1])
    before = char.model.opt.solver, char.model.opt.iterations
    rows = bench.physics_table(char, ref, lambda env: np.zeros((env.n, env.action_size)), 32, 0.3, threads=1)
    by = {(r["substeps"], r["solver"], r["iterations"]): r for r in rows}
    assert list(by) == bench.SETTINGS and rows[0]["root_mm"] == 0.0
    assert by[16, "NEWTON", 100]["control_steps_per_s"] < by[2, "PGS", 5]["control_steps_per_s"]
    apart = {r["root_mm"] for r in rows if r["substeps"] == 4}
    assert len(apart) == 7, apart  # every setting is another physics
    assert all(1.0 < r["slide_cm_s"] < 100.0 for r in rows)
    assert by[4, "PGS", 10]["root_mm"] < by[2, "PGS", 5]["root_mm"] < 50
    assert all(r["bad"] == 0 and 0 < r["sole_mm"] < 50 and r["survived"] > 0.5 for r in rows)
    assert before == (char.model.opt.solver, char.model.opt.iterations)


def test_bench_drop(tmp_path, capsys, monkeypatch):
    """The figures of DROP's simulator exist, and characters cost in proportion."""
    short = bench.bench_drop
    monkeypatch.setattr(bench, "bench_drop", lambda rounds: short(frames=5, rounds=3))
    monkeypatch.setattr(bench.demos, "BUILTIN", (("walk", 6, {"speed": 1.2}), ("stand", 4, {})))
    out = tmp_path / "bench.json"
    bench.main(["--drop", "--json", str(out)])
    r = json.loads(out.read_text())["drop"]
    assert r["fps"] > 20 and r["fps_pushed"] > 20 and r["fps_vae"] > 10 and set(r["samples"]) == {"1", "4", "64", "256"}
    assert r["characters"]["8"] < 0.5 * r["characters"]["2"] < r["fps"]
    assert "frames/s" in capsys.readouterr().out


def test_bench_skeletal(tmp_path, capsys, monkeypatch):
    """Windows a second; PyTorch's loss is ours to 1e-3 (checked inside), or its absence is said."""
    short = bench.bench_skeletal
    monkeypatch.setattr(bench, "bench_skeletal", lambda rounds: short(batch=2, rounds=2))
    out = tmp_path / "bench.json"
    bench.main(["--skeletal", "--json", str(out)])
    r, printed = json.loads(out.read_text())["skeletal"], capsys.readouterr().out
    assert r["windows_per_s"] > 1 and "training windows/s" in printed
    if r["torch_ratio"] is None:
        assert "PyTorch is not installed" in printed
    else:
        assert r["torch_ratio"] > 0 and "ratio" in printed
    step = bench.SkeletalStep(2, np.random.default_rng(0))
    first = step()
    assert min(step() for _ in range(3)) < first


def test_torch_updates_as_we_do():
    """The twin that is timed ends with the same weights."""
    pytest.importorskip("torch", reason="torch is not installed (extra torch)")
    char = character.load("jesse")
    ref = retarget.reference(char, [data.load("builtin", clips="stand_007")[0][:60]])
    small = dict(envs=8, horizon=8, minibatch=20, hidden=(12,), value_hidden=(10, 8), epochs=3, threads=1)
    opt = ppo.Options(**small, target_kl=1e9, lr=1e-2)
    trainer = ppo.Trainer(opt, Env(char, ref, 8, threads=1))
    trainer.start()
    trainer.collect()
    before, update = trainer.policy.arrays(), bench.torch_update(trainer)
    theirs = update()
    np.testing.assert_array_equal(trainer.policy.theta_pi, before["policy.pi"])  # ours are left alone
    trainer.update()
    for mine, its, old in zip(
        (trainer.policy.theta_pi, trainer.policy.critic.theta), theirs, (before["policy.pi"], before["policy.critic"])
    ):
        assert np.abs(mine - old).max() > 5e-3
        np.testing.assert_allclose(its, mine, atol=2e-4)


def test_bench_peers(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (extra peers)")
    monkeypatch.setattr(data, "sequences", lambda *_: [data.load("builtin", clips="stand_007")[0][:60]])
    out = tmp_path / "bench.json"
    small = "--envs", "8", "--processes", "2", "--rounds", "2", "--threads", "1"
    bench.main(["--peers", *small, "--json", str(out)])
    r = json.loads(out.read_text())["peers"]
    assert {"ours", "sb3_batched", "sb3_subproc", "torch_update_ratio"} <= set(r)
    assert set(r["cpu_s"]) == {"ours", "update", "torch", "sb3_batched"}
    assert min(v for k, v in r.items() if k != "cpu_s") > 0 < min(r["cpu_s"].values())
    assert r["cpu_s"]["update"] < r["cpu_s"]["ours"]
    for k in ("sb3_batched", "sb3_subproc"):  # medians of two: a ratio of means and a mean of ratios
        assert r[f"ours_of_{k}"] == pytest.approx(r["ours"] / r[k], rel=0.5)
    assert f"{r['sb3_subproc']:,.0f}" in capsys.readouterr().out


def test_peers_without_stable_baselines(monkeypatch):
    for name in ("stable_baselines3", "stable_baselines3.common.vec_env"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match="peers"):
        bench.bench_peers(None, None, bench.Options())
    gym_env._vec_env.cache_clear()
    with pytest.raises(UserError, match="peers"):
        gym_env.as_sb3(None)


def test_one_blas_thread_before_numpy():
    """Every program that wants one BLAS thread says so before NumPy is loaded; later nobody hears it, and training has
    two thirds of its speed."""
    root, found = Path(bench.__file__).parent.parent, 0
    for path in (*root.glob("*.py"), *root.glob("extras/*.py")):
        text = path.read_text()
        if "OPENBLAS_NUM_THREADS" in text:
            found += 1
            assert text.index('environ.setdefault("OPENBLAS_NUM_THREADS"') < text.index("\nimport numpy"), path
    assert found >= 5

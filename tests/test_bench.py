"""bench.py: the figures exist, are rates, and the parts cost less than the whole."""

import json

import mujoco
import numpy as np

import bench
import character
import mocap
import retarget
from env import Env


def test_bench_json(tmp_path, capsys):
    out = tmp_path / "bench.json"
    bench.main(["--character", "jesse", "--envs", "16", "--rounds", "3", "--json", str(out)])
    r = json.loads(out.read_text())["characters"]["jesse"]
    needed = "physics environment inference update train policy_step_ms_p50 policy_step_ms_p99 peak_mb".split()
    assert all(r[k] > 0 for k in needed)
    # one control step of training is one of each part, so it cannot be faster than the slowest of them
    assert r["train"] < min(r["environment"], r["inference"], r["update"])
    assert r["policy_step_ms_p50"] <= r["policy_step_ms_p99"]
    printed = capsys.readouterr().out
    assert f"{r['physics']:,.0f}" in printed and "policy step" in printed


def test_physics_is_the_same_physics():
    """`mujoco.rollout` from a reference state arrives where `Env.step` does."""
    char = character.load("jesse")
    clips = [c for c in mocap.builtin_clips() if c.name.startswith("walk")][:1]
    env = Env(char, retarget.reference(char, clips), 4, threads=1)
    physics = bench.Physics(env, np.random.default_rng(0))
    physics.step()
    frames = np.random.default_rng(0).choice(env.starts, 4)
    env.reset(frames=frames)
    rng = np.random.default_rng(0)
    rng.choice(env.starts, 4)
    env.step(0.13 * rng.standard_normal((4, 1, env.action_size))[:, 0])
    nq = char.model.nq
    start = mujoco.mj_stateSize(char.model, mujoco.mjtState.mjSTATE_TIME.value)
    alive = env.steps > 0
    assert alive.any()
    np.testing.assert_allclose(physics.state[alive, start : start + nq], env.qpos[alive], atol=1e-9)


def test_physics_table():
    """Few sub-steps are cheaper; the reference agrees with itself; settings are put back."""
    char = character.load("jesse")
    ref = retarget.reference(char, [c for c in mocap.builtin_clips() if c.name.startswith("walk")][:1])
    before = char.model.opt.solver, char.model.opt.iterations
    rows = bench.physics_table(char, ref, lambda env: np.zeros((env.n, env.action_size)), 32, 0.3, threads=1)
    by = {(r["substeps"], r["solver"], r["iterations"]): r for r in rows}
    assert list(by) == bench.SETTINGS and rows[0]["root_mm"] == 0.0
    assert by[16, "NEWTON", 50]["control_steps_per_s"] < by[2, "PGS", 5]["control_steps_per_s"]
    assert by[4, "PGS", 10]["root_mm"] < by[2, "PGS", 5]["root_mm"] < 50
    assert all(r["bad"] == 0 and 0 < r["sole_mm"] < 50 and r["survived"] > 0.5 for r in rows)
    assert before == (char.model.opt.solver, char.model.opt.iterations)


def test_bench_drop(tmp_path, capsys, monkeypatch):
    """The figures of DROP's simulator exist, and characters cost in proportion."""
    short = bench.bench_drop
    monkeypatch.setattr(bench, "bench_drop", lambda rounds: short(frames=5, rounds=3))
    monkeypatch.setattr(bench.drop_demos, "BUILTIN", (("walk", 6, {"speed": 1.2}), ("stand", 4, {})))
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

"""extras/gpu.py, on the processor: MuJoCo Warp has a CPU device, and NumPy stands where CuPy would."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

import character
import env as env_module
import human
import nn
import policy
import ppo
import retarget
from env import Env
from extras import gpu, train
from extras.train import Curriculum, Disturbance
from plumbing.cli import UserError
from plumbing.runs import load_checkpoint
from policy import load_policy


def trainer(char, ref, **options):
    opt = ppo.Options(**{"envs": 3, "horizon": 4, "minibatch": 6, "hidden": (16,), "value_hidden": (16,)} | options)
    return gpu.Trainer(opt, Env(char, ref, opt.envs, seed=1, threads=1))


def needs_warp():
    pytest.importorskip("mujoco_warp", reason="mujoco-warp is not installed (extra gpu)")


def test_worlds_are_mujoco(char):
    """A second of standing under small torques is MuJoCo's own, by Newton's method: states, forces, kinematics."""
    needs_warp()
    rng = np.random.default_rng(0)
    m, n = character.load("jesse").model, 3
    m.opt.timestep = 1 / 120
    worlds = gpu.Worlds(m, n, "cpu")
    assert (m.opt.solver, m.opt.iterations) == character.SOLVERS["newton"]  # as it was
    datas = [mujoco.MjData(m) for _ in range(n)]
    for k, d in enumerate(datas):
        d.qpos[2], d.qpos[7:] = char.hip_height - 0.003, char.default
        d.ctrl[:] = 0.05 * rng.uniform(-1, 1, m.nu)
        worlds.bind("qpos")[k], worlds.bind("qvel")[k], worlds.bind("ctrl")[k] = d.qpos, d.qvel, d.ctrl
    for _ in range(30):
        worlds.step(4)
        for d in datas:
            mujoco.mj_step(m, d, nstep=4)
    force = np.abs([d.sensordata[char.contact_adr] for d in datas])
    assert force.max() > 100
    np.testing.assert_allclose(worlds.bind("sensordata")[:, char.contact_adr], force, atol=0.5)
    np.testing.assert_allclose(worlds.bind("qpos"), [d.qpos for d in datas], atol=1e-4)
    worlds.forward()
    for d in datas:
        mujoco.mj_forward(m, d)
    for name in ("xpos", "xquat", "xmat", "cvel", "subtree_com", "geom_xpos", "geom_xmat"):
        want = np.array([getattr(d, name) for d in datas])
        np.testing.assert_allclose(worlds.bind(name).reshape(want.shape), want, atol=2e-3, err_msg=name)


def test_moved_trainer_sees_the_same(char, ref):
    """The first observations, values and rewards of a moved trainer are those of the trainer that stayed."""
    needs_warp()
    newton = character.load("jesse")
    newton.model.opt.solver, newton.model.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, 100
    stayed, gone = trainer(newton, ref), gpu.moved(trainer(character.load("jesse"), ref), "cpu")
    with gpu.arrays_of(gone):
        infos = []
        for t in (stayed, gone):
            t.env.reset(5)
            a = 0.1 * np.random.default_rng(2).standard_normal((3, char.limits.size))
            for _ in range(3):
                obs, reward, terminated, truncated, info = t.env.step(a)
            infos.append((obs.copy(), reward, terminated, info["terms"]))
            t.collect()
            t.update()
    np.testing.assert_allclose(infos[0][0], infos[1][0], atol=0.05)
    np.testing.assert_allclose(infos[0][1], infos[1][1], atol=0.05)
    np.testing.assert_array_equal(infos[0][2], infos[1][2])
    assert gone.policy.actor.theta.base is gone.policy.log_std.base is gone.policy.theta_pi  # still one vector
    assert gone.steps == stayed.steps == 12


def test_generator_draws_what_the_environment_asks_for(char, ref):
    """Every switch that draws random numbers finds them in the GPU's generator."""
    starts = Curriculum(replace(ref, still=np.full(len(ref.first), 9)), balance=True, retry=0.5, stand=0.5, begin=0.2)
    env = Env(char, ref, 8, threads=1, starts=starts, disturbance=Disturbance(8, 3, 0.1, 0.1, 1.0))
    env.rng = gpu.Generator(np, 0)
    env.reset()
    starts.lost[:] = ref.first[0] + 20
    for _ in range(30):
        env.step(env.rng.standard_normal((8, env.action_size), dtype=np.float32))
    assert starts.lost.min() > 0 and env.rng.permutation(5).size == 5


def test_swap_ends(char, ref):
    """Whatever happens in the loop, the modules have NumPy again."""
    needs_warp()
    gone = gpu.moved(trainer(character.load("jesse"), ref), "cpu")
    gone.env.batch.xp = fake = object()
    with pytest.raises(ZeroDivisionError), gpu.arrays_of(gone):
        assert nn.np is fake and ppo.np is fake
        raise ZeroDivisionError
    assert nn.np is np and ppo.np is np


def test_every_module_of_the_loop_is_swapped(char, ref):
    """Whatever module computes with arrays in collect and update is named, the curriculum's by where it is defined."""
    starts = Curriculum(ref, balance=True)
    t = trainer(char, ref)
    t.env.parts["starts"] = starts
    fake = t.env.batch = SimpleNamespace(xp=object())
    with gpu.arrays_of(t):
        for module in (env_module, nn, character, human, retarget, policy, ppo, train):
            assert module.np is fake.xp, module.__name__
    assert train.np is ppo.np is np


def test_missing_packages(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(UserError, match="pip install"):
        gpu.Worlds(character.load("jesse").model, 1)


def test_checkpoint_is_a_policy(char, ref, tmp_path):
    """A run on the GPU leaves what --init, extras/policies.py and play.py read."""
    needs_warp()
    gone = gpu.moved(trainer(character.load("jesse"), ref), "cpu")
    with gpu.arrays_of(gone):
        gone.start(), gone.collect(), gone.update()
        gone.save(tmp_path / "checkpoint.npz", {"options": {}})
    arrays, meta = load_checkpoint(tmp_path / "checkpoint.npz", ("policy.*",))
    saved, _ = load_policy(tmp_path / "checkpoint.npz")
    np.testing.assert_array_equal(saved.theta_pi, gone.policy.theta_pi)
    assert meta["steps"] == 12

r"""How fast it is: every part of training beside the physics it cannot beat, in one run.

    python -m extras.bench                                  every character
  python -m extras.bench --character jesse --json OUT     characters.NAME.{physics, environment, inference, update, ...}
    python -m extras.bench --scaling                        1 and all threads, 64 to 4,096 environments
  python -m extras.bench --physics                        what other steps, solvers and iterations would cost and spoil
    python -m extras.bench --drop --json OUT                DROP's simulator: drop.{fps, fps_pushed, fps_vae, …}
  python -m extras.bench --skeletal --json OUT            skeleton-aware networks: skeletal.{windows_per_s, torch_ratio}
  python -m extras.bench --peers --json OUT  the same training by others: peers.{ours, sb3_batched, sb3_subproc,
                                                     torch_update_ratio, ...}

physics       bare `mujoco.rollout` of the same model and substeps, from the same states
environment   `Env.step`: physics, refresh, reward, termination, reset, observation
inference     normalise, actor, noise, log-probability
update        all epochs of both losses, per collected step
train         collect and update, as ppo.py does

All in control steps a second.  The parts are timed in turn, round after round, and each figure is the median over the
rounds: a disturbance of the machine hits all of them, so the ratios can be trusted where the bare times cannot.
"""

from __future__ import annotations

import functools
import json
import os
import resource
import time
from dataclasses import dataclass, replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import mujoco
import numpy as np
from mujoco import rollout

import ppo
import retarget
from character import CHARACTERS, Switches, available, geom_lowest
from drop import body, demos
from env import BAD, SUBSTEPS, Env
from extras import gym_env
from metrics import Recording, measure
from mocap import data
from nn import LEAKY_SLOPE, Adam, gaussian_logp
from plumbing.cli import COUNT, POSITIVE, THREADS, UserError, arg, cli, run_main
from plumbing.files import atomic_write
from plumbing.runs import rng_from_state, rng_state, versions
from policy import load_policy
from skeletal.layers import SLOPE, fk_backward, fk_forward
from skeletal.net import Generator, rec_loss


@dataclass
class Options(Switches):
    """What to time, and how often."""

    character: str | None = arg(None, "one character; all of them by default")
    motion: str = arg("builtin", data.MOTION)
    clips: str = arg("*", "shell pattern on clip names")
    envs: int = arg(512, "characters simulated side by side", check=COUNT)
    threads: int = arg(0, "physics threads, 0 = all cores", check=THREADS)
    rounds: int = arg(7, "how often each part is timed", check=POSITIVE)
    scaling: bool = arg(False, "also the table over threads and environments")
    physics: bool = arg(False, "the table over physics steps, solvers and iterations instead")
    drop: bool = arg(False, "frames a second of DROP's simulator instead, against samples and characters")
    skeletal: bool = arg(False, "training windows a second of the skeleton-aware networks, against PyTorch, instead")
    peers: bool = arg(False, "training by Stable-Baselines3 and an update by PyTorch instead, beside ours")
    processes: int = arg(8, "with --peers: characters of SubprocVecEnv, a process each", check=COUNT)
    json: str | None = arg(None, "write the figures here")


class Physics:
    """Bare `mujoco.rollout`: the limit.

    From states of the reference, with noise as control, started anew every 16 control steps.
    Test: tests/extras/test_bench.py::test_physics_is_the_same_physics
    """

    def __init__(self, env: Env, rng):
        self.env, self.rng, self.steps = env, rng, 0
        m = env.char.model
        threads = env.batch.nthread
        self.data = [mujoco.MjData(m) for _ in range(threads)]
        self.pool = rollout.Rollout(nthread=threads)
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
        probe, self.fresh = mujoco.MjData(m), np.zeros((env.n, mujoco.mj_stateSize(m, spec)))
        for i, f in enumerate(rng.choice(env.starts.frames, env.n)):
            probe.qpos[:], probe.qvel[:] = env.ref.qpos[f], env.ref.qvel[f]
            mujoco.mj_getState(m, probe, self.fresh[i], spec)

    def step(self):
        if self.steps % 16 == 0:
            self.state = self.fresh
        self.steps += 1
        control = 0.13 * self.rng.standard_normal((self.env.n, 1, self.env.action_size))
        states, _ = self.pool.rollout(
            self.env.char.model, self.data, self.state, np.repeat(control, SUBSTEPS, axis=1), skip_checks=False
        )
        self.state = states[:, -1]


def bench(char, ref, opt: Options) -> dict:
    """All figures of one character.

    Test      tests/extras/test_bench.py::test_bench_json
    """
    settings = ppo.Options(envs=opt.envs, threads=opt.threads)
    env = Env(char, ref, opt.envs, threads=opt.threads)
    trainer = ppo.Trainer(settings, Env(char, ref, opt.envs, threads=opt.threads))
    trainer.start()
    env.reset()
    trainer.collect(), trainer.update()  # warm
    rng = np.random.default_rng(0)
    physics = Physics(Env(char, ref, opt.envs, threads=opt.threads), rng)
    noise = lambda: 0.13 * rng.standard_normal((env.n, env.action_size))  # noqa: E731
    policy, horizon = trainer.policy, settings.horizon

    def infer():
        x = policy.norm.normalise(env.full)
        mu = policy.actor(x[:, : env.obs_size])
        a = mu + np.exp(policy.log_std) * rng.standard_normal(mu.shape, dtype=np.float32)
        gaussian_logp(a, mu, policy.log_std)

    times = {k: [] for k in ("physics", "environment", "inference", "update", "train")}
    for _ in range(opt.rounds):
        times["physics"].append(_seconds(physics.step, horizon) / horizon)
        times["environment"].append(_seconds(lambda: env.step(noise()), horizon) / horizon)
        times["inference"].append(_seconds(infer, horizon) / horizon)
        collect = _seconds(trainer.collect, 1)
        update = _seconds(trainer.update, 1)
        times["update"].append(update / horizon)
        times["train"].append((collect + update) / horizon)
    out = {k: float(opt.envs / np.median(t)) for k, t in times.items()}
    out["train_of_physics"] = float(np.median(np.array(times["physics"]) / np.array(times["train"])))
    out["environment_of_physics"] = float(np.median(np.array(times["physics"]) / np.array(times["environment"])))
    p50, p99 = policy_step(char, ref, policy)
    out |= {"policy_step_ms_p50": p50, "policy_step_ms_p99": p99}
    out["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return out


def policy_step(char, ref, policy, n=2000):
    """Milliseconds to observe and infer for one character, the latency a headset would see: median, 99th percentile.

    What only the critic sees is left out: it is not there when playing.
    Test: tests/extras/test_bench.py::test_bench_json
    """
    env = Env(char, ref, 1, threads=1, asymmetric=False)
    env.reset()
    times = []
    for _ in range(n):
        t = time.perf_counter()
        env.observe(slice(None))
        policy.mean_action(env.full[:, : env.obs_size])
        times.append(time.perf_counter() - t)
    return float(1e3 * np.percentile(times, 50)), float(1e3 * np.percentile(times, 99))


SETTINGS = [  # (substeps, solver, iterations); the first is what the others are compared with
    (16, "NEWTON", 100), (8, "PGS", 5), (4, "NEWTON", 100), (4, "CG", 5), (4, "PGS", 3),
    (4, "PGS", 5), (4, "PGS", 10), (4, "PGS", 20), (4, "PGS", 40), (3, "PGS", 5), (2, "PGS", 5),
]  # fmt: skip


def physics_table(char, ref, act, envs=256, seconds=1.0, seed=0, threads=0) -> list[dict]:
    r"""What another physics step, solver or number of iterations costs, and what it spoils.

    Method    the same characters from the same random frames, driven by `act`, until they fail.  All settings in turn,
              control step by control step, so that a disturbance of the machine hits all of them.
    Args      act : function of the Env -> actions (N, u)
    Returns   for each of SETTINGS: substeps, solver, iterations; control_steps_per_s (median);
              root_mm : median distance of the root from the first setting's after `seconds`, of those alive in both;
              sole_mm : mean depth of the lowest sole where it is below the floor; slide_cm_s : `metrics.measure`'s
              foot_slide_cm_s of those who live; survived : share; bad : simulations that diverged
    Test      tests/extras/test_bench.py::test_physics_table
    """
    options = char.model.opt
    kept = options.solver, options.iterations, options.timestep
    steps, runs = round(seconds * ref.rate), []
    for substeps, solver, iterations in SETTINGS:  # a batch keeps the options that it was made with
        options.solver, options.iterations = getattr(mujoco.mjtSolver, f"mjSOL_{solver}"), iterations
        env = Env(char, ref, envs, seed, threads, substeps=substeps, autoreset=False)
        first = env.starts.frames
        whole = first[first + steps <= ref.last[env.starts.owner[first]]]  # nobody's sequence ends meanwhile
        env.reset(frames=np.random.default_rng(seed).choice(whole, envs))
        runs.append((env, [], [], np.ones(envs, bool), [env.qpos.copy()]))
    for _ in range(steps):
        for env, times, depth, alive, poses in runs:
            start = time.perf_counter()
            terminated = env.step(act(env))[2]
            times.append(time.perf_counter() - start)
            alive &= ~terminated
            poses.append(env.qpos.copy())
            low = geom_lowest(char.model, char.sole_geoms.ravel(), env.geom_xpos, env.geom_xmat).min(1)[alive]
            depth.append(-1000 * low[low < 0])
    options.solver, options.iterations, options.timestep = kept
    rows, (best, _, _, alive_best, _) = [], runs[0]
    for (substeps, solver, iterations), (env, times, depth, alive, poses) in zip(SETTINGS, runs, strict=True):
        both = alive & alive_best
        lived, none = np.stack(poses, 1)[alive], np.zeros((steps + 1, 2), bool)
        frames = env.frame[alive, None] + np.arange(-steps, 1)
        still = np.zeros((steps + 1, env.action_size))
        records = [Recording(f, q, none, still, False, steps) for f, q in zip(frames, lived, strict=True)]
        apart = 1000 * np.linalg.norm(env.qpos[both, :3] - best.qpos[both, :3], axis=1)
        rows.append({"substeps": substeps, "solver": solver, "iterations": iterations,
                     "control_steps_per_s": float(envs / np.median(times)), "root_mm": float(np.median(apart)),
                     "sole_mm": float(np.concatenate(depth).mean()), "survived": float(alive.mean()),
                     "slide_cm_s": measure(char, ref, records)["foot_slide_cm_s"],
                     "bad": int((env.batch.warning[:, BAD, 1] > 0).any(1).sum())})  # fmt: skip
    return rows


def bench_drop(frames=60, rounds=7) -> dict:
    r"""DROP's frames a second on one core: default prior, soft correction, energies and contact forces computed.

    Method    CPU time of the process (run it with OMP_NUM_THREADS=1), median of rounds of 2 s of walking
    Returns   fps; fps_pushed : the same, pushed sideways all the time, so that most steps are corrected; fps_vae : by
              the learned prior, its 16 samples, and the pose VAE;
              samples : {n: fps}; characters : {k: frames a second of the scene}
    Test      tests/extras/test_bench.py::test_bench_drop
    """
    nearest = demos.Stage(demos.Options())
    rng = np.random.default_rng(0)

    def rate(characters=1, newton=0.0, stage=nearest, **settings):
        sim, first = stage.start(1.2, **settings)
        force = np.zeros((body.N, 3))
        force[body.J["spine3"], 1] = newton
        times = []
        for _ in range(rounds + 1):  # the first round fills the cache of factorised matrices
            states, t = [first] * characters, time.process_time()
            for _ in range(frames):
                states = [sim.step(s, force, rng=rng)[0] for s in states]
            times.append((time.process_time() - t) / frames)
        return float(1.0 / np.median(times[1:]))

    out = {"fps": rate(), "fps_pushed": rate(newton=70.0)}
    out["fps_vae"] = rate(stage=demos.Stage(demos.Options(prior="vae", range="vae")))
    out["samples"] = {n: rate(samples=n) for n in (1, 4, 64, 256)}
    out["characters"] = {k: rate(characters=k) for k in (2, 4, 8)}
    return out


SKELETON = (-1, 0, 1, 2, 3, 2, 5, 6, 7, 2, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19)  # a captured human's 21 joints


class SkeletalStep:
    r"""One training step of the skeletal auto-encoder [SAN-4], ours: forward, loss with kinematics, backward, Adam.

    Test      tests/extras/test_bench.py::test_bench_skeletal
    """

    def __init__(self, batch, rng, window=64):
        self.net = Generator(SKELETON, rng)
        self.adam = Adam(self.net.n_params, 2e-4)
        self.s = rng.standard_normal((3 * len(SKELETON), batch), dtype=np.float32)
        self.turn = np.ones((window, batch), complex)
        x = 0.1 * rng.standard_normal((self.net.n_x, window, batch), dtype=np.float32)
        x[3::4] += 1.0  # quaternions near 1
        self.x, self.offsets = x, self.s.reshape(-1, 3, batch)
        self.true = fk_forward(x, self.offsets, SKELETON, self.turn)[1]

    def __call__(self):
        net = self.net
        features, static = net.static_forward(self.s)
        z, encoded = net.encode_forward(self.x, features)
        y, decoded = net.decode_forward(z, features)
        _, world, kin = fk_forward(y, self.offsets, SKELETON, self.turn)
        loss, dy, dworld = rec_loss(y, self.x, world, self.true, 1.0, 1.0)
        net.grad[:] = 0.0
        dz, df2 = net.decode_backward(dy + fk_backward(None, dworld, kin), decoded)
        _, df1 = net.encode_backward(dz, encoded, want_dx=False)
        net.static_backward(df1, df2, static)
        self.adam.step(net.theta, net.grad)
        return loss


def torch_step(ours: SkeletalStep, torch):
    """The same step in PyTorch, from the same weights: dense convolutions times a mask, as in the published code.

    Returns   function that makes one step and returns its loss
    Test      tests/extras/test_bench.py::test_bench_skeletal
    """
    F, net = torch.nn.functional, ours.net
    batch_first = lambda a: torch.tensor(np.ascontiguousarray(np.moveaxis(a, -1, 0)))  # noqa: E731

    def layer(number, plan):
        W, V, b = net.params[number]
        dense, static = np.zeros((plan.n_out, plan.n_in, plan.kernel), "f"), np.zeros((plan.n_out, plan.n_static), "f")
        mask, seen = np.zeros_like(dense), np.zeros_like(static)
        for o, rows, columns, w, v in zip(plan.out, plan.rows, plan.static_rows, W, V):
            dense[o.start : o.stop, rows], mask[o.start : o.stop, rows] = w.transpose(1, 2, 0), 1.0
            if plan.n_static:
                static[o.start : o.stop, columns], seen[o.start : o.stop, columns] = v, 1.0
        weights = [torch.nn.Parameter(torch.tensor(a)) for a in (dense, static, b.copy())]
        return weights, torch.tensor(mask), torch.tensor(seen), plan

    layers = {n: layer(n, p) for n, p in zip((*net.e, *net.d, *net.s), (*net.plans, *net.statics))}
    adam = torch.optim.Adam([w for weights, *_ in layers.values() for w in weights], 2e-4)

    def merge(groups):
        m = torch.zeros(len(groups), sum(map(len, groups)))
        for k, g in enumerate(groups):
            m[k, g] = 1.0 / len(g)
        return m

    pools = [merge(net.pool1), merge(net.pool2)]
    grouped = lambda x, m: (m @ x.reshape(len(x), m.shape[1], -1)).reshape(len(x), -1, *x.shape[2:])  # noqa: E731
    opened = lambda x, m: grouped(x, (m.T > 0).float())  # noqa: E731

    def conv(number, x, s=None):
        (w, v, b), mask, seen, plan = layers[number]
        half = plan.kernel // 2
        y = F.conv1d(F.pad(x, (half, half), mode="reflect") if half else x, w * mask, b, stride=plan.stride)
        return y if s is None else y + (s @ (v * seen).T)[..., None]

    leaky = lambda x: F.leaky_relu(x, SLOPE)  # noqa: E731
    up = lambda x: F.interpolate(x, scale_factor=2, mode="linear", align_corners=False)  # noqa: E731
    x, s, offsets, true = map(batch_first, (ours.x, ours.s, ours.offsets, ours.true))
    x, true = x.contiguous(), true

    def kinematics(x):  # (B, C, T) -> (B, J, 3, T); the heading stays 0 here
        q = torch.cat([x[:, None, 3:7], x[:, 7:].reshape(len(x), -1, 4, x.shape[2])], 1)
        w, i, j, k = (q / q.norm(dim=2, keepdim=True)).unbind(2)
        rows = [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j), 2 * (i * j + w * k),
                1 - 2 * (i * i + k * k), 2 * (j * k - w * i), 2 * (i * k - w * j), 2 * (j * k + w * i),
                1 - 2 * (i * i + j * j)]  # fmt: skip
        m = torch.stack(rows, -1).reshape(*w.shape, 3, 3)  # (B, J, T, 3, 3)
        step = torch.cat([torch.zeros_like(x[:, :2, :1]), x[:, :2, 1:]], 2)
        root = torch.cat([step.cumsum(2), x[:, 2:3]], 1).transpose(1, 2)
        g, p = [m[:, 0]], [root]
        for joint in range(1, len(SKELETON)):
            above = SKELETON[joint]
            p.append(p[above] + (g[above] @ offsets[:, joint, None, :, None])[..., 0])
            g.append(g[above] @ m[:, joint])
        return torch.stack(p, 1).transpose(2, 3)

    def step():
        f1 = leaky(grouped(conv(net.s[0], s[..., None]), pools[0]))
        f2 = leaky(grouped(conv(net.s[1], f1), pools[1]))
        z = leaky(grouped(conv(net.e[0], x, s), pools[0]))
        z = leaky(grouped(conv(net.e[1], z, f1[..., 0]), pools[1]))
        y = leaky(conv(net.d[0], opened(up(z), pools[1]), opened(f2, pools[1])[..., 0]))
        y = conv(net.d[1], opened(up(y), pools[0]), s)
        p = kinematics(y)
        loss = F.mse_loss(y, x) + F.mse_loss(p - p[:, :1], true - true[:, :1]) + F.mse_loss(p[:, 0], true[:, 0])
        adam.zero_grad()
        loss.backward()
        adam.step()
        return float(loss.detach())

    return step


def bench_skeletal(batch=32, rounds=7) -> dict:
    r"""Training windows a second of the skeletal auto-encoder, and the same network's in PyTorch, in turn.

    Method    CPU time of the process, one thread each (run it with OMP_NUM_THREADS=1), median over the rounds; the
              losses of the first steps are compared first: it is the same network
    Returns   windows_per_s; torch_windows_per_s and torch_ratio (ours over PyTorch's), or None where it is missing
    Test      tests/extras/test_bench.py::test_bench_skeletal
    """
    ours = SkeletalStep(batch, np.random.default_rng(0))
    out, theirs = {"torch_windows_per_s": None, "torch_ratio": None}, None
    try:
        import torch

        torch.set_num_threads(1)
        theirs = torch_step(ours, torch)
    except ImportError:
        print("PyTorch is not installed, so there is nothing to compare with: python -m pip install -e '.[torch]'")
    pairs = [(ours(), theirs() if theirs else None) for _ in range(2)]
    if theirs and not np.allclose(*zip(*pairs), rtol=1e-3):
        raise RuntimeError(f"PyTorch's losses differ from ours: {pairs}")
    times = {ours: [], theirs: []}
    for _ in range(rounds):
        for step in filter(None, (ours, theirs)):
            start = time.process_time()
            step()
            times[step].append(time.process_time() - start)
    out["windows_per_s"] = float(batch / np.median(times[ours]))
    if theirs:
        out["torch_windows_per_s"] = float(batch / np.median(times[theirs]))
        out["torch_ratio"] = float(np.median(np.array(times[theirs]) / np.array(times[ours])))
    return out


def torch_update(trainer: ppo.Trainer):
    """What `ppo.Trainer.update` does to the weights, by PyTorch's automatic gradients.

    Args      trainer : has collected; only read, and its random state is left as it was
    Returns   function without arguments that does the update once more, from the same samples, and returns the weights
              (policy with log σ, critic) after it; the weights go on from call to call
    Note      the rate is the trainer's at the first call, and no epoch is left out for the KL divergence
    Test      tests/extras/test_bench.py::test_torch_updates_as_we_do
    """
    import torch

    opt, policy, rng = trainer.opt, trainer.policy, rng_from_state(rng_state(trainer.rng))
    nets = []
    for mine in (policy.actor, policy.critic):
        layers = []
        for i in range(mine.n_layers):
            layers.append(torch.nn.Linear(mine.sizes[i], mine.sizes[i + 1]))
            with torch.no_grad():
                layers[-1].weight[:] = torch.tensor(mine.params[f"W{i}"].T)
                layers[-1].bias[:] = torch.tensor(mine.params[f"b{i}"])
            layers.append(torch.nn.LeakyReLU(LEAKY_SLOPE))
        nets.append(torch.nn.Sequential(*layers[:-1]))
    actor, critic = nets
    log_std = torch.nn.Parameter(torch.tensor(policy.log_std))
    of_policy = [*actor.parameters(), log_std]
    rates = (of_policy, trainer.adam_pi.lr), (list(critic.parameters()), opt.value_lr)
    adams = [torch.optim.Adam(p, lr=lr, eps=trainer.adam_pi.eps) for p, lr in rates]

    def weights():
        flat = lambda net: [p.detach().numpy().T.ravel() for p in net.parameters()]  # noqa: E731
        return np.concatenate([*flat(actor), log_std.detach().numpy()]), np.concatenate(flat(critic))

    def update():
        done = trainer.terminated | trainer.truncated
        advantage, target = ppo.gae(trainer.reward, trainer.old_value, trainer.next_value, done, opt.gamma, opt.lam)
        flat = lambda v: torch.from_numpy(np.ascontiguousarray(v.reshape(-1, *v.shape[2:]), np.float32))  # noqa: E731
        x, action, logp_old = flat(trainer.x), flat(trainer.action), flat(trainer.logp)
        adv, target = flat(ppo.standardise(advantage)), flat(target / policy.value_scale)
        for _ in range(opt.epochs):
            order = torch.from_numpy(rng.permutation(len(adv)))
            for rows in torch.split(order, opt.minibatch):
                xb, ab = x[rows], adv[rows]
                pi = torch.distributions.Normal(actor(xb[:, : policy.obs_size]), log_std.exp(), validate_args=False)
                ratio = torch.exp(pi.log_prob(action[rows]).sum(-1) - logp_old[rows])
                loss = -torch.min(ratio * ab, torch.clamp(ratio, 1 - opt.clip_eps, 1 + opt.clip_eps) * ab).mean()
                v_loss = 0.5 * torch.square(critic(xb)[:, 0] - target[rows]).mean()
                for each, adam, parameters in ((loss, adams[0], of_policy), (v_loss, adams[1], critic.parameters())):
                    adam.zero_grad(set_to_none=True)
                    each.backward()
                    torch.nn.utils.clip_grad_norm_(parameters, ppo.MAX_GRAD_NORM)
                    adam.step()
                with torch.no_grad():
                    log_std.clamp_(min=float(np.log(opt.min_sigma)))
        return weights()

    return update


def bench_peers(char, ref, opt: Options) -> dict:
    r"""The same training written by others, in turn with ours: as many samples, minibatches, epochs, layers and units.

    Method    ours         `ppo.Trainer`, collect and update
              sb3_batched  Stable-Baselines3's PPO over the same N characters simulated together
              (`extras.gym_env.as_sb3`)
              sb3_subproc  its PPO over `opt.processes` single characters (`extras.gym_env.OneCharacter`) in
              SubprocVecEnv
              torch_update_ratio  seconds of the same update by PyTorch, over ours
              Stable-Baselines3's inputs are normalised by its VecNormalize, as ours are.  Its critic sees what the
              actor does and not the human (189 numbers for Jesse, not 369), which makes its work less
    Returns   control steps a second of the three (medians), ours_of_sb3_batched, ours_of_sb3_subproc and
              torch_update_ratio (medians of the rounds' ratios); cpu_s : name -> seconds of this process's CPU time for
              what was timed, which other programs disturb less; torch_threads
    Raises    UserError: stable-baselines3 is not installed
    Test      tests/extras/test_bench.py::test_bench_peers
    """
    try:
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize
    except ImportError:
        raise UserError(gym_env.NO_SB3) from None
    # a KL divergence beyond the target would leave out epochs
    settings = ppo.Options(envs=opt.envs, threads=opt.threads, target_kl=1e9, steps=10**9)
    trainer = ppo.Trainer(settings, Env(char, ref, opt.envs, threads=opt.threads))
    trainer.start()
    trainer.collect()
    by_torch = torch_update(trainer)
    samples = settings.horizon * opt.envs

    def sb3(envs):
        return PPO(
            "MlpPolicy", VecNormalize(envs, norm_reward=False), n_steps=samples // envs.num_envs, device="cpu", seed=0,
            batch_size=settings.minibatch, n_epochs=settings.epochs, gamma=settings.gamma, gae_lambda=settings.lam,
            clip_range=settings.clip_eps, learning_rate=settings.lr, max_grad_norm=ppo.MAX_GRAD_NORM,
            policy_kwargs={
                "net_arch": {"pi": list(settings.hidden), "vf": list(settings.value_hidden)},
                "activation_fn": torch.nn.LeakyReLU, "log_std_init": float(np.log(trainer.opt.sigma)),
            },
        )  # fmt: skip

    batched = gym_env.as_sb3(gym_env.Characters(char, ref, opt.envs, threads=opt.threads))
    single = functools.partial(gym_env.OneCharacter, char, ref)
    apart = SubprocVecEnv([functools.partial(single, seed=i) for i in range(opt.processes)])
    try:
        models = {"sb3_batched": sb3(batched), "sb3_subproc": sb3(apart)}
        times = {k: [] for k in ("ours", *models, "update", "torch")}
        for k in range(opt.rounds + 1):
            now = {"update": _two_clocks(trainer.update), "torch": _two_clocks(by_torch)}
            now["ours"] = now["update"] + _two_clocks(trainer.collect)
            for name, model in models.items():
                now[name] = _two_clocks(lambda: model.learn(samples, reset_num_timesteps=False))  # noqa: B023
            if k:  # the first round is to warm up
                [times[name].append(seconds) for name, seconds in now.items()]
    finally:
        apart.close()
    cpu = {k: float(np.median(t, 0)[1]) for k, t in times.items() if k != "sb3_subproc"}
    times = {k: np.array(t)[:, 0] for k, t in times.items()}
    out = {k: float(samples / np.median(times[k])) for k in ("ours", *models)}
    out |= {f"ours_of_{k}": float(np.median(times[k] / times["ours"])) for k in models}
    out["torch_update_ratio"] = float(np.median(times["torch"] / times["update"]))
    return out | {
        "cpu_s": cpu, "envs": opt.envs, "processes": opt.processes, "torch_threads": torch.get_num_threads()
    }  # fmt: skip


def _two_clocks(f):
    """Seconds on the wall, seconds of CPU time.  (2,)"""
    wall, cpu = time.perf_counter(), time.process_time()
    f()
    return np.array([time.perf_counter() - wall, time.process_time() - cpu])


def _seconds(f, repeats):
    t = time.perf_counter()
    for _ in range(repeats):
        f()
    return time.perf_counter() - t


def main(argv=None):
    """Print the table of every character.  Test: tests/extras/test_bench.py::test_bench_json"""
    opt = cli(Options, argv, "bench.py", __doc__)
    other = opt.drop or opt.skeletal or opt.peers
    names = [] if other else [opt.character] if opt.character else available()
    print(
        f"{os.cpu_count()} cores, " + ", ".join(f"{k} {v}" for k, v in versions().items() if k in ("numpy", "mujoco"))
    )
    results, more = {}, {}
    if opt.drop:
        more["drop"] = r = bench_drop(rounds=opt.rounds)
        print(f"\nDROP, one character, one core: {r['fps']:.0f} frames/s; {r['fps_pushed']:.0f} while it is pushed; "
              f"{r['fps_vae']:.0f} with both VAEs")  # fmt: skip
        print("  samples     " + "   ".join(f"{n}: {v:.0f}" for n, v in r["samples"].items()))
        print("  characters  " + "   ".join(f"{k}: {v:.0f}" for k, v in r["characters"].items()))
    if opt.skeletal:
        more["skeletal"] = r = bench_skeletal(rounds=opt.rounds)
        print(f"\nskeletal auto-encoder, one core: {r['windows_per_s']:.0f} training windows/s", end="")
        print(f"; PyTorch {r['torch_windows_per_s']:.0f}: ratio {r['torch_ratio']:.2f}" if r["torch_ratio"] else "")
    if opt.peers:
        char = replace(opt, character=opt.character or "jesse").load().solved_by("pgs")
        more["peers"] = r = bench_peers(
            char, retarget.reference(char, data.sequences(opt.motion, "train", opt.clips)), opt
        )
        print(f"\n{char.name}, {opt.envs} characters, training, control steps/s:\n  {'ours':12s} {r['ours']:10,.0f}")
        for k in ("sb3_batched", "sb3_subproc"):
            print(f"  {k:12s} {r[k]:10,.0f}   ours {r[f'ours_of_{k}']:.2f} × as fast")
        print(f"  an update by PyTorch takes {r['torch_update_ratio']:.2f} × as long")
        print("  CPU seconds an update: " + ", ".join(f"{k} {v:.2f}" for k, v in r["cpu_s"].items()))
    for name in names:
        char = replace(opt, character=name).load().solved_by("pgs")  # as in training
        ref = retarget.reference(char, data.sequences(opt.motion, "train", opt.clips))
        if opt.physics:
            policy, _ = load_policy(CHARACTERS / f"{name}.npz")
            act = lambda env: policy.mean_action(env.full[:, : env.obs_size])  # noqa: B023, E731
            results[name] = {"settings": physics_table(char, ref, act, opt.envs, threads=opt.threads)}
            print(f"\n{name}, {opt.envs} characters, its shipped policy, 1 s\n"
                  "substeps solver iterations  control steps/s  "
                  "root mm  soles mm  slide cm/s  survived  bad")  # fmt: skip
            for row in results[name]["settings"]:
                print("{substeps:8d} {solver:6s} {iterations:10d} {control_steps_per_s:16,.0f} {root_mm:8.1f} "
                      "{sole_mm:9.1f} {slide_cm_s:11.1f} {survived:9.2f} {bad:4d}".format(**row))  # fmt: skip
            continue
        r = results[name] = bench(char, ref, opt)
        print(f"\n{name}, {opt.envs} characters, control steps/s:")
        for k in ("physics", "environment", "inference", "update", "train"):
            print(f"  {k:12s} {r[k]:10,.0f}   {r[k] / r['physics']:6.2f} × physics")
        print(
            f"  policy step {r['policy_step_ms_p50']:.3f} ms (p99 {r['policy_step_ms_p99']:.3f});  "
            f"peak {r['peak_mb']:,.0f} MB"
        )
        if opt.scaling:
            print("  threads  envs   physics     train   of physics")
            for threads in sorted({1, os.cpu_count()}):
                for envs in (64, 256, 1024, 4096):
                    s = bench(char, ref, replace(opt, threads=threads, envs=envs, rounds=3))
                    results[name].setdefault("scaling", []).append({"threads": threads, "envs": envs} | s)
                    print(
                        f"  {threads:7d} {envs:5d} {s['physics']:9,.0f} {s['train']:9,.0f} {s['train_of_physics']:9.2f}"
                    )
    if opt.json:
        atomic_write(opt.json, json.dumps({"characters": results, **more, "versions": versions()}, indent=2) + "\n")


if __name__ == "__main__":
    run_main(main)

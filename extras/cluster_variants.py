r"""Two other ways to share the work with a cluster's workers, to be compared with extras/cluster.py's.

    python -m extras.cluster_variants --scheme stale --workers 4 --recipe none --out /tmp/a --steps 1e6

samples     extras/cluster.py: one synchronisation an update
gradients   the samples stay with the workers; for each minibatch the driver averages their gradients and sends weights
            [Wijmans et al. 2020, DD-PPO]
stale       as samples, but the next rollout begins before the update: by weights that are one update old
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import numpy as np

import ppo
from extras import cluster, train
from extras.cluster import Worker, Workers
from nn import clip_grad_norm, gaussian_kl
from plumbing.cli import arg, run_main
from plumbing.training import read_options
from policy import widths


@dataclass
class Options(cluster.Options):
    """extras/cluster.py's options, and the scheme."""

    scheme: str = arg("samples", "who learns from what", ("samples", "gradients", "stale"))
    speed: bool = arg(False, "time all schemes in turn, an update each, beside ppo.py --threads 2")
    rounds: int = arg(10, "with --speed: how often")
    toy: bool = arg(False, "learning curves on a small task (PYTHONPATH=tests), 10 seeds")
    here: bool = arg(False, "all workers in this process, one after the other: for learning curves")


class Local(Workers):
    """Workers in this process."""

    def share(self, value):
        return value

    def begin(self, k, cores):
        self.actors[k] = self.kind(self.opt, self.parts)

    def ask(self, k, name, *args):
        return partial(getattr(self.actors[k], name), *args)

    def answer(self, asked):
        return asked()


# ------------------------------------------------------------------------------------ gradients


class Learner(Worker):
    """Keeps its samples, and gives gradients."""

    def collect(self, weights, rng, state=None):
        found, t = super().collect(weights, rng, state), self.trainer
        self.batch = t.samples()
        done = t.terminated | t.truncated
        self.adv = ppo.gae(t.reward, t.old_value, t.next_value, done, t.opt.gamma, t.opt.lam)[0]
        self.batch.old_std = t.policy.log_std.copy()
        del found["samples"]
        return found | {"moments": (self.adv.mean(), self.adv.std()), "explained": self.batch.explained}

    def epoch(self, mean, std):
        """A new order of the samples.  -> number of minibatches"""
        self.batch.adv = ((self.adv - mean) / (std + 1e-8)).astype(np.float32).reshape(-1)
        self.parts = self.trainer.minibatches(len(self.batch.adv))
        return len(self.parts)

    def gradient(self, weights, j):
        """Both gradients of minibatch j, and its numbers."""
        policy, b, rows = self.trainer.policy, self.batch, self.parts[j]
        policy.theta_pi[:], policy.critic.theta[:] = weights
        drawn = b.x[rows, : policy.obs_size], b.action[rows], b.logp[rows]
        loss, grad, out = ppo.policy_loss(policy, *drawn, b.adv[rows], self.trainer.opt.clip_eps)
        value_loss, value_grad = ppo.critic_loss(policy, b.x[rows], b.target[rows])
        kl = gaussian_kl(b.mu[rows], b.old_std, out["mu"], policy.log_std)
        clipped = float(np.mean(np.abs(out["ratio"] - 1.0) > self.trainer.opt.clip_eps))
        return grad, value_grad, {"kl": kl, "clip_fraction": clipped, "policy_loss": loss, "value_loss": value_loss}

    def random(self):
        return self.trainer.rng


class Averager(cluster.Trainer):
    """Steps by the mean of the workers' gradients."""

    def collect(self):
        found = self.env.collect(self.policy.arrays(), [self.rng, *self.env.rngs])
        self.seen, self.found = [f["seen"] for f in found], found
        self.steps += self.reward.size
        return cluster.merged([f["stats"] for f in found], self.reward.size * self.env.dt)

    def update(self):
        opt, policy, env, epochs = self.opt, self.policy, self.env, []
        each = [f["moments"] for f in self.found]
        mean = fmean(m for m, _ in each)
        std = np.sqrt(fmean(s * s + (m - mean) ** 2 for m, s in each))
        for _ in range(opt.epochs):
            count, rows = env.gather("epoch", [(mean, std)] * env.workers)[0], []
            for j in range(count):
                weights = env.share((policy.theta_pi, policy.critic.theta))
                grads, value_grads, told = zip(*env.gather("gradient", [(weights, j)] * env.workers))
                grad, value_grad = sum(grads) / len(grads), sum(value_grads) / len(grads)
                clip_grad_norm(grad, ppo.MAX_GRAD_NORM), clip_grad_norm(value_grad, ppo.MAX_GRAD_NORM)
                self.adam_pi.step(policy.theta_pi, grad)
                np.maximum(policy.log_std, np.log(opt.min_sigma), out=policy.log_std)
                self.adam_v.step(policy.critic.theta, value_grad)
                rows.append({k: fmean(t[k] for t in told) for k in told[0]})
            epochs.append({k: fmean(r[k] for r in rows) for k in rows[0]})
            if (kl := epochs[-1]["kl"]) > 2.0 * opt.target_kl:
                break
        self.adam_pi.follow_kl(kl, opt.target_kl)
        for seen in self.seen:
            cluster.merge(policy.norm, seen)
        self.rng, *env.rngs = env.gather("random", [()] * env.workers)
        explained = fmean(f["explained"] for f in self.found)
        return self.told({k: fmean(e[k] for e in epochs) for k in epochs[0]} | {"kl": kl}, explained)


# ------------------------------------------------------------------------------------ stale


class Overlapped(cluster.Trainer):
    """The next rollout is under way while this one is learnt from."""

    def __init__(self, opt, workers, policy=None):
        super().__init__(opt, workers, policy)
        self.pending, self.first = None, np.random.default_rng([opt.seed, 1, opt.workers])

    def ask(self):
        env, shared = self.env, self.env.share(self.policy.arrays())
        args = [(shared, rng) for rng in (self.first, *env.rngs)]
        self.pending = [(env.ask(k, "collect", *a), a) for k, a in enumerate(args)], self.policy.log_std.copy()

    def collect(self):
        if not self.pending:
            self.ask()
        asked, self.acted = self.pending
        env = self.env
        found = [env.persist(k, "collect", a, args) for k, (a, args) in enumerate(asked)]
        env.states = [f["state"] for f in found]
        self.first, *env.rngs = (f["rng"] for f in found)
        for name in cluster.SENT:
            np.concatenate([f["samples"][name] for f in found], axis=1, out=getattr(self, name))
        self.seen = [f["seen"] for f in found]
        self.steps += self.reward.size
        self.ask()
        return cluster.merged([f["stats"] for f in found], self.reward.size * env.dt)

    def fit_policy(self, batch, parts):
        batch.old_std = self.acted  # of the policy that acted
        return super().fit_policy(batch, parts)


SCHEMES = {"samples": (Worker, cluster.Trainer), "gradients": (Learner, Averager), "stale": (Worker, Overlapped)}


def made(opt, env, engine):
    """A trainer by opt.scheme, its workers by `engine`."""
    kind, trainer = SCHEMES[opt.scheme]
    engine = type("Engine", (engine,), {"kind": kind})
    of_workers = replace(opt, minibatch=opt.minibatch // opt.workers) if opt.scheme == "gradients" else opt
    workers = engine(env, of_workers)
    return trainer(opt, workers)


class Point(Worker):
    """A worker whose characters are points on a line."""

    def __init__(self, opt, parts):
        self.trainer = ppo.Trainer(opt, parts["reach"](opt.envs))

    def reset(self, seed):
        self.trainer.env.reset(seed)
        self.trainer.env.state = lambda: None
        return {"full": self.trainer.env.full.copy(), "state": None}


class LearningPoint(Learner):
    """The same, which gives gradients."""

    __init__, reset = Point.__init__, Point.reset


def toy(opt, updates=40, seeds=10):
    """Mean reward of the last five of 40 updates, and of the first twenty, over seeds; 4 workers of 16 points."""
    from test_ppo import Reach

    small = dict(envs=64, horizon=12, minibatch=256, hidden=(16,), value_hidden=(16,), out="/tmp/reach")
    opt = replace(opt, **small, sigma=0.5, gamma=0.9, lr=1e-3, value_lr=3e-3, steps=10**9)
    kinds = {"samples": (Point, cluster.Trainer), "gradients": (LearningPoint, Averager), "stale": (Point, Overlapped)}
    cluster.made_of = lambda env: {"reach": Reach}
    cluster.Trainer.tell = lambda *_: None
    for name in ("ppo.py", *kinds):
        last, early, kls, reached = [], [], [], []
        for seed in range(seeds):
            one = replace(opt, seed=seed, minibatch=64 if name == "gradients" else 256)
            if name == "ppo.py":
                trainer = ppo.Trainer(one, Reach(64))
            else:
                env = Reach(64)
                env.ref = None
                workers = type("Engine", (Local,), {"kind": kinds[name][0]})(env, one)
                trainer = kinds[name][1](replace(one, minibatch=256), workers)
            trainer.start()
            rows = [trainer.collect() | trainer.update() for _ in range(updates)]
            last.append(fmean(r["reward"] for r in rows[-5:]))
            early.append(fmean(r["reward"] for r in rows[:20]))
            reached.append(next((k + 1 for k, r in enumerate(rows) if r["reward"] > 0.7), updates))
            kls.append(fmean(r["kl"] for r in rows))
        error = np.std(early) / np.sqrt(seeds)
        print(f"{name}: first 20 {fmean(early):.3f} ± {error:.3f}, last 5 {fmean(last):.3f} ± "
              f"{np.std(last) / np.sqrt(seeds):.3f}, kl {fmean(kls):.4f}, "
              f"0.7 after {fmean(reached):.1f} ± {np.std(reached) / np.sqrt(seeds):.1f} updates")  # fmt: skip


def speed(opt, env):
    """Steps a second of every scheme, in turn; ratios are medians of the rounds'."""
    from extras.cluster_bench import below, processor

    loops = {"ppo.py --threads 2": ppo.Trainer(replace(opt, threads=2), train.make_env(replace(opt, threads=2)))}
    loops |= {scheme: made(replace(opt, scheme=scheme), env, Workers) for scheme in SCHEMES}
    for trainer in loops.values():
        trainer.start()
    times, used = {name: [] for name in loops}, {name: [] for name in loops}
    for k in range(opt.rounds + 1):
        for name in list(loops)[k % 4 :] + list(loops)[: k % 4]:
            pids = [os.getpid(), *below(os.getpid())]
            cpu, began = processor(pids), time.perf_counter()
            loops[name].collect(), loops[name].update()
            if name == "stale":  # nothing runs on beside another loop
                cluster.ray.wait([a for a, _ in loops[name].pending[0]], num_returns=opt.workers)
            times[name].append(time.perf_counter() - began)
            used[name].append(processor(pids) - cpu)
    base = np.array(times["samples"][1:])
    for name, each in times.items():
        wall = np.array(each[1:])
        print(f"{name}: {opt.envs * opt.horizon / np.median(wall):.0f} steps/s, {np.median(base / wall):.2f}, "
              f"{1e6 * np.median(used[name][1:]) / opt.envs / opt.horizon:.0f} µs of processor a step")  # fmt: skip


def main(argv=None):
    opt = read_options(Options, argv, "extras.cluster_variants", __doc__, widths)
    if opt.toy:
        return toy(opt)
    env = train.make_env(replace(opt, envs=1, threads=1))
    if opt.speed:
        os.makedirs(opt.out)
        with cluster.connected(replace(opt, workers=3 * opt.workers)):
            return speed(opt, env)
    if opt.here:
        return ppo.run(made(opt, env, Local))
    with cluster.connected(opt):
        ppo.run(made(opt, env, Workers))


if __name__ == "__main__":
    run_main(main)

r"""Our PPO on a task that everybody knows, with CleanRL's settings  [Huang22].

    python -m extras.cleanrl HalfCheetah-v4                            1 M steps; a continuous task of Gymnasium's
    python -m extras.cleanrl HalfCheetah-v4 --no-value-clip            one of its nine differences to ppo.py left out
    python ppo.py --resume --out runs/HalfCheetah-v4                   continue exactly

What CleanRL does otherwise than ppo.py: tanh; a learning rate that falls to 0; Adam's epsilon; the value's change is
clipped, too; one norm clips both gradients; advantages are standardised by minibatch; the normaliser learns at every
step; rewards are divided by the spread of the return; a time limit is a failure (off here: ours bootstraps, which
Gymnasium has since asked for).  Each is an option; all else is `ppo.Trainer`.

[Huang22]   Huang et al., CleanRL: high-quality single-file implementations of deep reinforcement learning, JMLR 2022,
            ppo_continuous_action.py
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from statistics import fmean

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import ppo
from extras.gym_env import Task
from nn import ACTIVATIONS, Adam, clip_grad_norm, gaussian_kl
from plumbing.cli import ALL_POSITIVE, COUNT, NONNEGATIVE, POSITIVE, UNIT, UserError, arg, cli, run_main
from plumbing.runs import check_run, latest_checkpoint
from plumbing.training import progress_line, resumed_options
from policy import Policy, check_fits, load_policy, total_steps

MAX_GRAD_NORM = 0.5  # [Huang22]


@dataclass
class Options:
    """CleanRL's settings; the last nine are its differences to ppo.py."""

    BY = "extras.cleanrl"
    threads = 1  # a task has no threads of its own

    task: str = arg("HalfCheetah-v4", "a continuous task of Gymnasium's")
    steps: int = arg(1_000_000, "steps to train", check=POSITIVE)
    envs: int = arg(1, "copies of the task", check=COUNT)
    horizon: int = arg(2048, "steps of each copy per update", check=COUNT)
    seed: int = arg(0, "seed of everything random", check=NONNEGATIVE)
    out: str | None = arg(None, "run folder; runs/TASK by default")
    resume: bool = arg(False, "continue the run in --out exactly")
    init: str | None = arg(None, "start from a policy (.npz) or a run folder of the same sizes")
    gamma: float = arg(0.99, "discount", check=UNIT)
    lam: float = arg(0.95, "lambda of generalised advantage estimation", check=UNIT)
    clip_eps: float = arg(0.2, "epsilon of the clipped losses", check=ppo.BELOW_ONE)
    epochs: int = arg(10, "passes over the samples per update", check=COUNT)
    minibatch: int = arg(64, "samples per gradient step", check=COUNT)
    lr: float = arg(3e-4, "policy's learning rate to start from", check=POSITIVE)
    value_lr: float = arg(3e-4, "value network's learning rate to start from", check=POSITIVE)
    target_kl: float = arg(0.025, "with --schedule kl: KL divergence per update to aim at", check=POSITIVE)
    hidden: tuple[int, ...] = arg((64, 64), "hidden layers of the policy", check=ALL_POSITIVE)
    value_hidden: tuple[int, ...] = arg((64, 64), "hidden layers of the value network", check=ALL_POSITIVE)
    sigma: float = arg(1.0, "standard deviation of the exploration noise at the start", check=POSITIVE)
    min_sigma: float = arg(1e-6, "below this the standard deviations do not fall", check=POSITIVE)
    activation: str = arg("tanh", "of the hidden layers", choices=tuple(ACTIVATIONS))
    schedule: str = arg("linear", "learning rates: linear, to 0 at --steps, or by --target-kl", ("linear", "kl"))
    adam_eps: float = arg(1e-5, "epsilon of Adam", check=POSITIVE)
    value_clip: bool = arg(True, "clip the value's change, too, by --clip-eps")
    joint_clip: float | None = arg(0.5, "clip both gradients by one norm, the value's times this", check=POSITIVE)
    standardise_minibatch: bool = arg(True, "standardise the advantages of each minibatch, too")
    norm_each_step: bool = arg(True, "the normaliser of the inputs learns every step, not between updates")
    reward_norm: bool = arg(True, "rewards divided by the spread of the running return, clipped at 10")
    limit_ends: bool = arg(False, "a time limit counts as a failure, as in CleanRL: no bootstrap")


def clipped_value_loss(policy: Policy, x, target, old, eps):
    r"""`ppo.critic_loss` that stops where V has gone far enough towards the target, and its gradient.

    Equation  L = ½ mean max((V − target)², (clip(V, old ± eps) − target)²)
    Args      x (B, critic), normalised; target, old (B,), in units of policy.value_scale
    Returns   loss : float; gradient (P,)
    Source    most PPO code; [Huang22, detail 9]
    Test      tests/extras/test_cleanrl.py::test_value_clip_gradient
    """
    v, cache = policy.critic.forward(x)
    free, held = v[:, 0] - target, np.clip(v[:, 0], old - eps, old + eps) - target
    loss = 0.5 * float(np.mean(np.maximum(free**2, held**2)))
    dv = np.where(free**2 >= held**2, free / len(free), 0.0).astype(v.dtype)
    _, dtheta = policy.critic.backward(dv[:, None], cache, want_dx=False)
    return loss, dtheta


class Trainer(ppo.Trainer):
    """`ppo.Trainer` with CleanRL's differences; its environment is a `Task`.

    Test      tests/extras/test_cleanrl.py::test_learns, test_resume_is_exact
    """

    def __init__(self, opt: Options, env: Task, policy: Policy | None = None):
        sizes = env.obs_size, env.critic_size, env.action_size, opt.hidden, opt.value_hidden
        rng, scale = np.random.default_rng([opt.seed, 2]), env.value_scale(opt.gamma)
        super().__init__(opt, env, policy or Policy(*sizes, opt.sigma, scale, rng, activation=opt.activation))
        self.adam_pi = Adam(self.policy.theta_pi.size, opt.lr, eps=opt.adam_eps)
        self.adam_v = Adam(self.policy.critic.theta.size, opt.value_lr, eps=opt.adam_eps)

    def data(self):
        """What tells whether two runs are of the same task."""
        return self.env.data()

    def step(self, t):
        """As `ppo.Trainer.step`; the normaliser learns what comes next."""
        super().step(t)
        if self.opt.norm_each_step:
            self.policy.norm.update(self.env.full)

    def collect(self):
        """As `ppo.Trainer.collect`, and the mean return of the latest episodes, as the task counts it."""
        return super().collect() | self.env.stats()

    @staticmethod
    def line(stats):
        """The line of progress begins with what others print."""
        return {"return of 100": f"{stats['return_100']:.0f}"} | progress_line(stats)

    def update(self):
        """Epochs of minibatches, each a step of both networks.

        Test      tests/extras/test_cleanrl.py::test_linear_schedule, test_joint_clip"""
        opt, policy, batch, rows_of = self.opt, self.policy, self.samples(), []
        old_std, old_value = policy.log_std.copy(), (self.old_value / policy.value_scale).ravel().astype(np.float32)
        if opt.schedule == "linear":
            left = max(1.0 - (self.steps - self.reward.size) / opt.steps, 0.0)
            self.adam_pi.lr, self.adam_v.lr = left * opt.lr, left * opt.value_lr
        if not opt.norm_each_step:
            policy.norm.update(self.raw)
        for _ in range(opt.epochs):
            order, kls = self.rng.permutation(len(batch.adv)), []
            for start in range(0, len(order), opt.minibatch):
                rows = order[start : start + opt.minibatch]
                adv = ppo.standardise(batch.adv[rows]) if opt.standardise_minibatch else batch.adv[rows]
                drawn = batch.x[rows, : policy.obs_size], batch.action[rows], batch.logp[rows]
                loss, grad, out = ppo.policy_loss(policy, *drawn, adv, opt.clip_eps)
                given = policy, batch.x[rows], batch.target[rows]
                clipped = (old_value[rows], opt.clip_eps) if opt.value_clip else ()
                value_loss, value_grad = (clipped_value_loss if clipped else ppo.critic_loss)(*given, *clipped)
                grad, value_grad = self.limited(grad, value_grad)
                kls.append(gaussian_kl(batch.mu[rows], old_std, out["mu"], policy.log_std))
                self.adam_pi.step(policy.theta_pi, grad)
                self.adam_v.step(policy.critic.theta, value_grad)
                np.maximum(policy.log_std, np.log(opt.min_sigma), out=policy.log_std)
                moved = float(np.mean(np.abs(out["ratio"] - 1.0) > opt.clip_eps))
                rows_of.append({"clip_fraction": moved, "policy_loss": loss, "value_loss": value_loss})
            kl = fmean(kls)
            if opt.schedule == "kl" and kl > 2.0 * opt.target_kl:
                break
        if opt.schedule == "kl":
            self.adam_pi.follow_kl(kl, opt.target_kl)
        return self.told({k: fmean(r[k] for r in rows_of) for k in rows_of[0]} | {"kl": kl}, batch.explained)

    def limited(self, grad, value_grad):
        """Both gradients, clipped by one norm, or each by its own.

        Test      tests/extras/test_cleanrl.py::test_joint_clip"""
        if not self.opt.joint_clip:
            clip_grad_norm(grad, MAX_GRAD_NORM), clip_grad_norm(value_grad, MAX_GRAD_NORM)
            return grad, value_grad
        both = np.concatenate([grad, self.opt.joint_clip * value_grad])
        clip_grad_norm(both, MAX_GRAD_NORM)
        return np.split(both, [len(grad)])


def make_env(opt: Options) -> Task:
    """Copies of the task.  Test: tests/extras/test_cleanrl.py::test_time_limit_is_bootstrapped"""
    return Task(opt.task, opt.envs, opt.seed, opt.gamma, opt.reward_norm, opt.limit_ends)


def initial(opt: Options, env: Task):
    """The policy of --init and its steps.  UserError: another task's, or other layers

    Test      tests/extras/test_cleanrl.py::test_settings"""
    policy, meta = load_policy(opt.init)
    check_fits(policy, env, opt.init)
    for name in ("activation", "hidden", "value_hidden"):
        if getattr(policy, name) != getattr(opt, name):
            raise UserError(f"{opt.init}: its {name} is {getattr(policy, name)}: give --{name.replace('_', '-')}")
    policy.norm.frozen = False
    return policy, total_steps(meta)


def main(argv=None):
    """python -m extras.cleanrl TASK.  Test: tests/extras/test_cleanrl.py::test_settings"""
    argv = list(argv or [])
    argv = ["--task", *argv] if argv and not argv[0].startswith("-") else argv
    opt = cli(Options, argv, "extras.cleanrl", __doc__)
    opt = replace(opt, out=opt.out or f"runs/{opt.task.rpartition('/')[2]}")
    check_run(opt.out, opt.resume)
    opt = resumed_options(opt, argv) if opt.resume else opt
    env = make_env(opt)
    loaded = latest_checkpoint(opt.out, ppo.FINITE) if opt.resume else None
    policy, before = initial(opt, env) if opt.init and not loaded else (None, 0)
    ppo.run(Trainer(opt, env, policy), loaded, before)


if __name__ == "__main__":
    run_main(main)

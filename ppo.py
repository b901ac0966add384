r"""Proximal policy optimisation, every gradient by hand  [Reda23 §3.1, §3.7, Appendix B].

    python ppo.py --character jesse                                    learn on the built-in motions
    python ppo.py --character jesse --motion FOLDER --out runs/a       learn on motion capture
    python ppo.py --resume --out runs/a --steps 20e6                   continue exactly where it stopped
    python ppo.py --character jesse --recipe none                      by the defaults below: the paper's uniform starts

One update:  collect `horizon` steps of `envs` characters with the present policy  ->  values, advantages (gae)  ->
`epochs` passes over the samples in minibatches of the clipped loss (policy) and the squared error (value).

A character's [training] is its recipe: hyper-parameters, and `by`, the module that trains by it (`python -m
extras.train --help`).  The command line wins over the recipe, the recipe over the defaults below.
"""

from __future__ import annotations

import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace

# OpenBLAS's threads would take the cores from physics and `aside`, spinning while they wait; said before NumPy loads
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import character
import retarget
from env import SENSORS, TRACK, WITHOUT, Env, ablated, headset_only
from mocap import data
from mocap.rigs import Reading
from nn import Adam, clip_grad_norm, gaussian_entropy, gaussian_kl, gaussian_logp, gaussian_logp_backward, value_loss
from plumbing import runs, training
from plumbing.cli import ALL_POSITIVE, COUNT, NONNEGATIVE, POSITIVE, THREADS, UNIT, arg, run_main, some_of
from policy import Policy, initial, widths

FINITE = ("policy.*", "adam_*", "env.*")  # of a checkpoint's arrays
CHECKPOINT_SECONDS = 180.0
MAX_GRAD_NORM = 1.0  # ASSUMED
SOLVER = "pgs"  # ASSUMED: of contacts; a fifth faster than the exact one, by which policies are played
BELOW_ONE = (lambda v: 0 < v < 1, "between 0 and 1")
KNOWN = some_of(WITHOUT)


@dataclass
class Options(data.MotionFlags, character.Switches):
    """Everything a run is made of.  ASSUMED, from measured runs: Table 3 (hyper-parameters) is not in our text."""

    BY = "ppo"  # who goes on with a run

    steps: int = arg(20_000_000, "control steps to train", check=POSITIVE)
    envs: int = arg(512, "characters simulated side by side", check=COUNT)
    horizon: int = arg(16, "control steps of each character per update", check=COUNT)
    seed: int = arg(0, "seed of everything random", check=NONNEGATIVE)
    out: str | None = arg(None, "run folder, runs/CHARACTER by default; retargeted motion is kept beside it")
    resume: bool = arg(False, "continue the run in --out exactly")
    init: str | None = arg(None, "start from a policy (.npz) or a run folder of the same sizes")
    recipe: str = arg("character", "hyper-parameters: the character's, or none: the defaults", ("character", "none"))
    threads: int = arg(0, "physics threads, 0 = all cores; if not 1, actor and critic learn at once", check=THREADS)
    gamma: float = arg(0.97, "discount (QuestSim's)", check=UNIT)
    lam: float = arg(0.95, "lambda of generalised advantage estimation; 1 is Appendix B's return", check=UNIT)
    clip_eps: float = arg(0.2, "epsilon of the clipped loss", check=BELOW_ONE)
    epochs: int = arg(2, "passes over the samples per update", check=COUNT)
    minibatch: int = arg(2048, "samples per gradient step", check=COUNT)
    lr: float = arg(1e-4, "policy's learning rate to start from; adapted to --target-kl", check=POSITIVE)
    value_lr: float = arg(1e-3, "value network's learning rate", check=POSITIVE)
    target_kl: float = arg(0.025, "KL divergence per update that the policy's learning rate aims at", check=POSITIVE)
    hidden: tuple[int, ...] = arg((256, 128), "hidden layers of the policy", check=ALL_POSITIVE)
    value_hidden: tuple[int, ...] = arg((256, 128), "hidden layers of the value network", check=ALL_POSITIVE)
    sigma: float = arg(0.135, "standard deviation of the exploration noise at the start", check=POSITIVE)
    min_sigma: float = arg(0.05, "below this the standard deviations do not fall", check=POSITIVE)
    sensors: str = arg("full", "what it sees of the user [§4.2]: full, or hmd, the headset alone", SENSORS)
    without: tuple[str, ...] = arg((), f"what to leave out [§4.3, §5.3]: {KNOWN[1]}", check=KNOWN, metavar="NAME,…")
    track: str = arg("all", "what it imitates of the kinematic pose [§3.5.1]: all, or the root's place", TRACK)


# ------------------------------------------------------------------------------------ Appendix B


def gae(reward, value, next_value, done, gamma, lam):
    r"""Generalised advantage estimation; with λ = 1 the return of Appendix B minus the old value.

    Equation  δ_t = r_t + γ V(o_{t+1}) − V(o_t);  A_t = δ_t + γ λ (1 − done_t) A_{t+1}
    Symbols   V(o_{t+1}) -> next_value: of the state the step led to, BEFORE any reset: 0 after a failure, the old
              network's value after a truncation and at the end of the collected trajectory (bootstrap)
    Args      reward, value, next_value : (T, N); done : (T, N) bool, terminated or truncated
    Returns   advantage (T, N), return = advantage + value (T, N)
    Raises    ValueError: shapes differ
    Source    Schulman et al. 2016, Eq. 16; [Reda23 App. B]
    Test      tests/test_ppo.py::test_gae_against_slow_loop, test_lambda_one_is_appendix_b
    """
    if not reward.shape == value.shape == next_value.shape == done.shape:
        shapes = f"reward {reward.shape}, value {value.shape}, next_value {next_value.shape}, done {done.shape}"
        raise ValueError(f"shapes differ: {shapes}")
    delta = reward + gamma * next_value - value
    advantage = np.zeros_like(delta)
    carry = np.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carry = delta[t] + gamma * lam * np.where(done[t], 0.0, carry)
        advantage[t] = carry
    return advantage, advantage + value


def clipped_surrogate(logp, logp_old, adv, eps):
    r"""Clipped policy loss and its gradient.

    Equation  [Reda23 App. B] L = mean min(ρ A, clip(ρ, 1−ε, 1+ε) A), ρ = exp(log π − log π_old)
    Symbols   ρ_t -> ratio, A_t -> adv, ε -> eps
    Departs   returns −L, because the optimiser minimises
    Args      logp, logp_old : (B,) float32 [nat]; adv : (B,) float32 [-], standardised
    Returns   loss : float; dlogp : (B,) d loss / d logp; ratio : (B,)
    Raises    ValueError: shapes differ, or eps outside (0, 1)
    Test      tests/test_ppo.py::test_clipped_surrogate, tests/test_gradients.py::test_backward
    """
    if not (np.shape(logp) == np.shape(logp_old) == np.shape(adv)):
        raise ValueError(f"shapes differ: logp {np.shape(logp)}, logp_old {np.shape(logp_old)}, adv {np.shape(adv)}")
    if not 0.0 < eps < 1.0:
        raise ValueError(f"eps is {eps}, expected a number in (0, 1)")
    ratio = np.exp(logp - logp_old)  # (B,)
    free, held = ratio * adv, np.clip(ratio, 1.0 - eps, 1.0 + eps) * adv  # (B,)
    loss = -float(np.mean(np.minimum(free, held)))
    # The gradient flows where the unclipped term is the smaller one; d ratio / d logp = ratio.
    dlogp = np.where(free <= held, -free / len(free), 0.0).astype(free.dtype)  # (B,)
    return loss, dlogp, ratio


def standardise(x):
    """Â = (A − mean) / (std + 1e-8).  ASSUMED: Appendix B's Â is not defined.

    Test      tests/test_ppo.py::test_standardise
    """
    return (x - x.mean()) / (x.std() + 1e-8)


def policy_loss(policy: Policy, x, action, logp_old, adv, eps, also=None):
    r"""Loss of a minibatch and its gradient with respect to all of the policy's parameters.

    Equation  −L(θ) of Appendix B, π_θ = N(μ_θ(o), diag σ²)
    Args      x (B, obs), normalised; action (B, u), unclipped; logp_old, adv (B,); also : of μ, a loss and dμ to add
    Returns   loss : float; gradient (P,) laid out as policy.theta_pi; dict(mu, ratio)
    Test      tests/test_ppo.py::test_policy_loss, tests/test_gradients.py::test_backward
    """
    mu, cache = policy.actor.forward(x)
    logp = gaussian_logp(action, mu, policy.log_std)
    loss, dlogp, ratio = clipped_surrogate(logp, logp_old, adv, eps)
    dmu, dlog_std = gaussian_logp_backward(dlogp, action, mu, policy.log_std)
    more, extra = also(mu) if also else (0.0, 0.0)
    _, dtheta = policy.actor.backward(dmu + extra, cache, want_dx=False)
    return loss + more, np.concatenate([dtheta, dlog_std.astype(dtheta.dtype)]), {"mu": mu, "ratio": ratio}


def critic_loss(policy: Policy, x, target):
    r"""½ mean (V(o) − target)² and its gradient  [Reda23 App. B, "supervised learning"].

    Args      x (B, critic), normalised; target (B,), in units of policy.value_scale
    Returns   loss : float; gradient (P,)
    Test      tests/test_ppo.py::test_critic_loss, tests/test_gradients.py::test_backward
    """
    v, cache = policy.critic.forward(x)
    loss, dv = value_loss(v[:, 0], target)
    _, dtheta = policy.critic.backward(dv[:, None], cache, want_dx=False)
    return loss, dtheta


def explained_variance(value, target):
    """1 − Var(target − value) / Var(target): 1 is a perfect critic, 0 as good as the mean.

    Test      tests/test_ppo.py::test_explained_variance
    """
    var = np.var(target)
    return float(1.0 - np.var(target - value) / var) if var > 0 else 0.0


# ------------------------------------------------------------------------------------ the loop

SECOND = ThreadPoolExecutor(1)  # `aside`; its thread begins with the first use


def aside(work, two=True):
    """Begin `work`, a function without arguments, on a second core, if there are `two`.  NumPy lets other threads run
    while it computes on large arrays; work must share nothing with what its caller does meanwhile.

    Returns   function that waits for what work returns, or raises what it raised
    Test      tests/test_ppo.py::test_second_thread_changes_nothing
    """
    return SECOND.submit(work).result if two else work


class Trainer:
    """Collect, estimate, update; all state that a resumed run needs.

    env, policy : what is trained; `run` begins with `start`
    Test     tests/test_ppo.py::test_resume_is_exact, test_learns, test_non_finite_state_does_not_reach_the_networks
    """

    GO_ON = "--resume --out"
    line = staticmethod(training.progress_line)

    def __init__(self, opt: Options, env: Env, policy: Policy | None = None):
        sizes = env.obs_size, env.critic_size, env.action_size, opt.hidden, opt.value_hidden
        self.opt, self.env = opt, env
        rng = np.random.default_rng([opt.seed, 2])
        self.policy = policy or Policy(*sizes, opt.sigma, env.value_scale(opt.gamma), rng)
        self.rng = np.random.default_rng([opt.seed, 1])  # exploration and minibatches
        self.adam_pi = Adam(self.policy.theta_pi.size, opt.lr)
        self.adam_v = Adam(self.policy.critic.theta.size, opt.value_lr)
        self.steps = self.updates = 0
        t, n = opt.horizon, env.n
        self.raw, self.x = (np.zeros((t, n, env.critic_size), np.float32) for _ in range(2))  # x : normalised
        self.action, self.mu = (np.zeros((t, n, env.action_size), np.float32) for _ in range(2))
        self.logp = np.zeros((t, n), np.float32)
        self.reward, self.next_value = (np.zeros((t, n)) for _ in range(2))
        self.terminated, self.truncated = (np.zeros((t, n), bool) for _ in range(2))
        self.two = opt.threads != 1 and opt.minibatch >= 1024

    def start(self):
        """First observation; the normaliser begins with it, or the first update would see unscaled inputs."""
        self.env.reset(self.opt.seed)
        if self.policy.norm.count == 0:
            self.policy.norm.update(self.env.full)

    def collect(self) -> dict:
        """`horizon` steps of every character with the present policy.  -> what happened, for the progress line

        Test      tests/test_ppo.py::test_stored_action_is_unclipped, test_time_to_failure
        """
        env, samples = self.env, self.reward.size
        self.finals, self.lengths, self.shares = [], [], []
        self.sums = {f"r_{name}": 0.0 for name in env.TERMS} | {f"end_{name}": 0 for name in env.ENDS}
        for t in range(self.opt.horizon):
            self.step(t)
        self.steps += samples
        action, mu = (a.reshape(samples, -1) for a in (self.action, self.mu))
        self.logp[:] = gaussian_logp(action, mu, self.policy.log_std).reshape(self.logp.shape)
        self.values()
        failures = int(self.terminated.sum())
        stats = {"episodes": sum(map(len, self.lengths)), "failures": failures, "reward": float(self.reward.mean())}
        for name, each in (("length", np.concatenate(self.lengths)), ("survival", np.concatenate(self.shares))):
            stats[name] = float(each.mean()) if len(each) else float("nan")
        stats["time_to_failure"] = samples * env.dt / max(failures, 1)
        return stats | {name: v / samples if name.startswith("r_") else v for name, v in self.sums.items()}

    def step(self, t):
        """One control step of every character: what was seen, drawn and earned goes into row t of the samples."""
        env, policy = self.env, self.policy
        self.raw[t] = env.full
        x = policy.norm.normalise(env.full, out=self.x[t])
        self.mu[t] = policy.actor(x[:, : env.obs_size])
        noise = self.rng.standard_normal(self.mu[t].shape, dtype=np.float32)
        self.action[t] = self.driving(t) + np.exp(policy.log_std) * noise
        _, self.reward[t], self.terminated[t], self.truncated[t], info = env.step(self.action[t])
        ids, done = np.flatnonzero(self.truncated[t]), self.terminated[t] | self.truncated[t]
        if len(ids):  # what they saw before the reset
            self.finals.append((t, ids, policy.norm.normalise(info["final_critic"][ids])))
        for name in env.TERMS:
            self.sums[f"r_{name}"] += float(info["terms"][name].sum())
        for name in env.ENDS:
            self.sums[f"end_{name}"] += int(info["ends"][name].sum())
        self.lengths.append(info["length"][done])
        self.shares.append((info["length"] / info["available"])[done])

    def driving(self, t):
        """The mean of the actions of step t: the policy's.  extras/teacher.py has others drive, too."""
        return self.mu[t]

    def values(self):
        """V(o_t) and V(o_{t+1}) of everything collected, with the old network.

        Test      tests/test_ppo.py::test_bootstrap_is_before_the_reset
        """
        policy, samples = self.policy, self.reward.size
        self.old_value = policy.value(self.x.reshape(samples, -1)).reshape(self.reward.shape)
        self.next_value[:-1] = self.old_value[1:]
        # App. B: bootstrap at the trajectory's end
        self.next_value[-1] = policy.value(policy.norm.normalise(self.env.full))
        for t, ids, rows in self.finals:  # truncation is not failure
            self.next_value[t, ids] = policy.value(rows)
        self.next_value[self.terminated] = 0.0

    def samples(self) -> SimpleNamespace:
        """What was collected, a row a sample, with its standardised advantage and the value's target."""
        opt, scale = self.opt, self.policy.value_scale
        done = self.terminated | self.truncated
        advantage, target = gae(self.reward, self.old_value, self.next_value, done, opt.gamma, opt.lam)
        arrays = {name: getattr(self, name) for name in ("x", "action", "mu", "logp")}
        arrays |= {"adv": standardise(advantage).astype(np.float32), "target": (target / scale).astype(np.float32)}
        flat = {name: a.reshape(-1, *a.shape[2:]) for name, a in arrays.items()}
        return SimpleNamespace(**flat, explained=explained_variance(self.old_value, target))

    def update(self) -> dict:
        """Several epochs of minibatches of the two losses; then the learning rate follows the KL divergence.

        Test      tests/test_ppo.py::test_update_improves_both_losses, test_rate_follows_kl_and_sigma_has_a_floor,
                  test_what_an_update_is_made_of, test_normaliser_learns_raw_observations
        """
        opt, policy, batch, epochs = self.opt, self.policy, self.samples(), []
        batch.old_std = policy.log_std.copy()
        for epoch in range(opt.epochs):
            parts = self.minibatches(len(batch.adv))
            critic = aside(partial(self.fit_critic, batch, parts), self.two)
            if epoch == 0:  # for the next samples; these are normalised already
                policy.norm.update(self.raw)
            epochs.append(self.fit_policy(batch, parts) | {"value_loss": critic()})
            kl = epochs[-1]["kl"]
            if kl > 2.0 * opt.target_kl:  # ASSUMED: leave the samples before they no longer describe the policy
                break
        self.adam_pi.follow_kl(kl, opt.target_kl)
        return self.told({k: fmean(e[k] for e in epochs) for k in epochs[0]} | {"kl": kl}, batch.explained)

    def minibatches(self, samples) -> list:
        """The numbers of so many samples in a random order, cut into minibatches: of one epoch."""
        order, size = self.rng.permutation(samples), self.opt.minibatch
        return [order[k : k + size] for k in range(0, samples, size)]

    def fit_policy(self, batch, parts) -> dict:
        """One epoch of the actor.  -> means over its minibatches"""
        opt, policy, kls, clipped, losses = self.opt, self.policy, [], [], []
        for rows in parts:
            drawn = batch.x[rows, : policy.obs_size], batch.action[rows], batch.logp[rows]
            loss, grad, out = policy_loss(policy, *drawn, batch.adv[rows], opt.clip_eps, self.also(batch, rows))
            clip_grad_norm(grad, MAX_GRAD_NORM)
            kls.append(gaussian_kl(batch.mu[rows], batch.old_std, out["mu"], policy.log_std))
            self.adam_pi.step(policy.theta_pi, grad)
            np.maximum(policy.log_std, math.log(opt.min_sigma), out=policy.log_std)
            clipped.append(float(np.mean(np.abs(out["ratio"] - 1.0) > opt.clip_eps)))
            losses.append(loss)
        return {"kl": fmean(kls), "clip_fraction": fmean(clipped), "policy_loss": fmean(losses)}

    def also(self, batch, rows):
        """What is added to `policy_loss`: nothing.  extras/teacher.py adds a teacher's pull."""

    def fit_critic(self, batch, parts) -> float:
        """One epoch of the value network.  -> mean loss"""
        losses = []
        for rows in parts:
            loss, grad = critic_loss(self.policy, batch.x[rows], batch.target[rows])
            clip_grad_norm(grad, MAX_GRAD_NORM)
            self.adam_v.step(self.policy.critic.theta, grad)
            losses.append(loss)
        return fmean(losses)

    def told(self, stats, explained) -> dict:
        """The numbers of an update."""
        self.updates += 1
        log_std, saturated = self.policy.log_std, np.abs(self.action) > 0.99
        sizes = {"sigma": float(np.exp(log_std).mean()), "entropy": float(gaussian_entropy(log_std))}
        sizes |= {"lr": self.adam_pi.lr, "saturation": float(np.mean(saturated))}
        return stats | {"explained_variance": explained} | sizes

    def data(self) -> dict:
        """What tells whether two runs saw the same.  Test: tests/test_ppo.py::test_resume_refuses_other_tables"""
        char = self.env.char
        return training.motions(self.env.ref) | {"tables": training.tables_of(char), "model": training.model_of(char)}

    def save(self, path, meta):
        """Everything: policy, optimisers, environment, random states."""
        arrays, rest = self.env.state()
        arrays = {f"env.{k}": v for k, v in arrays.items()} | self.policy.arrays()
        for name in ("adam_pi", "adam_v"):
            arrays |= {f"{name}.{k}": v for k, v in getattr(self, name).state().items()}
        own = dict(steps=self.steps, updates=self.updates, lr=self.adam_pi.lr, policy=self.policy.shape())
        runs.save_checkpoint(path, arrays, meta | own | {"rng": runs.rng_state(self.rng), "env": rest})

    def restore(self, arrays, meta, path="the checkpoint"):
        """Continue bit-exactly from what `save` wrote.  UserError, naming path: something else was saved"""
        with training.fitting(path):
            training.check_progress(meta)
            self.policy.load(arrays)
            for name in ("adam_pi", "adam_v"):
                getattr(self, name).load_state(training.part_of(arrays, name))
            self.adam_pi.lr, self.steps, self.updates = meta["lr"], meta["steps"], meta["updates"]
            self.rng = runs.rng_from_state(meta["rng"])
            self.env.load_state(training.part_of(arrays, "env"), meta["env"])


def run(trainer: Trainer, loaded=None, before=0):
    """Collect and update until --steps or a signal, with checkpoints.

    Args      loaded : the checkpoint to continue from, or None; before : steps of the policies that it goes on from
    Raises    UserError: the motions have changed since the run began
    Test      tests/robustness/test_killed.py::test_interrupt_ends_with_a_checkpoint, test_resume_after_sigkill"""
    opt, env, out, data = trainer.opt, trainer.env, Path(trainer.opt.out), trainer.data()
    if loaded:
        training.check_same(loaded[1].get("data", data), data, out)
    trainer.restore(*loaded, out / runs.CHECKPOINT) if loaded else trainer.start()
    meta = {"options": asdict(opt), "data": data, "before": before}
    config, rows = asdict(opt) | {"data": data, "by": opt.BY}, loaded[1].get("rows", 0) if loaded else None
    save = lambda rows: trainer.save(out / runs.CHECKPOINT, meta | {"rows": rows})  # noqa: E731
    progress = runs.Progress(opt.steps, trainer.steps)
    journal = runs.Journal(out, config, opt.resume, rows, progress, save, CHECKPOINT_SECONDS)
    print(f"{env.name}: {trainer.policy.summary()}, {data['sequences']} sequences, {data['minutes']:.1f} min")
    if trainer.steps >= opt.steps:
        print(f"nothing to do: --steps {opt.steps} is the total to reach, and {trainer.steps} are done")
    with journal:
        while trainer.steps < opt.steps and not journal.stop:
            t0 = time.perf_counter()
            stats = trainer.collect()
            t1 = time.perf_counter()
            stats |= trainer.update()
            t2 = time.perf_counter()
            stats |= {"steps_per_s": trainer.reward.size / (t2 - t0), "collect_s": t1 - t0, "update_s": t2 - t1}
            row = {"update": trainer.updates, "steps": trainer.steps} | stats
            journal.write(trainer.steps, row, trainer.line(stats))
    if journal.stop:
        print(f"stopped at {runs.fmt_count(trainer.steps)} steps; continue with: python ppo.py {trainer.GO_ON} {out}")


# ------------------------------------------------------------------------------------ command line


def make_env(opt: Options) -> Env:
    """The character, and the motions retargeted to it.  Test: tests/test_ppo.py::test_switches_reach_the_environment"""
    whole = opt.load()
    training.say_idle(whole, {name: WITHOUT[name] for name in opt.without})
    char = ablated(whole, opt.without, opt.track).solved_by(SOLVER)
    clips = data.sequences(opt.motion, "train", opt.clips, seed=opt.seed, reading=Reading.of(opt))
    ref = retarget.reference(char, clips)
    shown = headset_only(ref) if opt.sensors == "hmd" else ref
    return Env(char, shown, opt.envs, opt.seed, opt.threads, asymmetric="asymmetric" not in opt.without)


def train(opt: Options, env: Env, policy: Policy | None = None, trainer=Trainer) -> Trainer:
    """Train a policy, by default a new one or that of --init; or resume the run in --out.

    Test      tests/test_ppo.py::test_resume_is_exact, tests/robustness/test_cli.py::test_ppo"""
    loaded = runs.latest_checkpoint(opt.out, FINITE) if opt.resume else None
    before = loaded[1].get("before", 0) if loaded else 0
    if opt.init and not (loaded or policy):  # a run resumed before its first checkpoint begins as it began
        policy, before = initial(opt.init, opt, env)
    made = trainer(opt, env, policy)
    run(made, loaded, before)
    return made


def main(argv=None):
    """python ppo.py: train by the character's recipe, or resume.  Test: tests/robustness/test_cli.py::test_ppo"""
    if (module := training.trained_by(character.Switches, argv, Options.BY)) != Options.BY:
        print(f"trained by {module}, as the recipe or the run says (--recipe none: by ppo.py's own defaults)")
        return training.main_of(module)(argv)
    opt = training.read_options(Options, argv, "ppo.py", __doc__, widths)
    train(opt, make_env(opt))


if __name__ == "__main__":
    run_main(main)

r"""Proximal policy optimisation, every gradient by hand  [Reda23 §3.1, §3.7, Appendix B].

    python ppo.py --character jesse                                    learn on the built-in motions
    python ppo.py --character jesse --motion FOLDER --out runs/a       learn on motion capture
    python ppo.py --resume --out runs/a --steps 20e6                   continue exactly where it stopped
    python ppo.py --ship characters/jesse.npz --out runs/a             write the policy of a run, without the rest
    python ppo.py --ship NEW.npz --out runs/a --blend OLD.npz          averaged with that one
    python ppo.py --gym HalfCheetah-v4                                 learn another's task, with CleanRL's settings

One update:  collect `horizon` steps of `envs` characters with the present policy  ->  values, advantages (gae)  ->
`epochs` passes over the samples in minibatches of the clipped loss (policy) and the squared error (value).
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from statistics import fmean

# OpenBLAS's threads would take the cores from the physics, spinning while they wait, and from `aside`.
# It must be said before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import character
import mocap.augment
import mocap.data
import retarget
from env import EPISODE_STEPS, SENSORS, TRACK, WITHOUT, Disturbance, Env, ablated, headset_only, input_names
from extras.gpu import arrays_of, fetched, moved
from extras.gym_env import Task, character_only, with_defaults_of_cleanrl
from mocap.data import MOTION, sequences
from mocap.rigs import HELP, Reading
from nn import (
    ACTIVATIONS,
    MLP,
    Adam,
    RunningNorm,
    clip_grad_norm,
    gaussian_entropy,
    gaussian_kl,
    gaussian_logp,
    gaussian_logp_backward,
    value_loss,
    widened,
)
from plumbing.cli import (
    ALL_POSITIVE,
    COUNT,
    NONNEGATIVE,
    POSITIVE,
    THREADS,
    UNIT,
    UserError,
    arg,
    cli,
    given_flags,
    run_main,
)
from plumbing.runs import (
    CHECKPOINT,
    METRICS,
    Metrics,
    Progress,
    StopFlag,
    check_run,
    fmt_count,
    git_state,
    latest_checkpoint,
    load_checkpoint,
    open_run,
    rng_from_state,
    rng_state,
    save_checkpoint,
    stored_options,
    versions,
)

FINITE = ("policy.*", "adam_*", "env*")  # of a checkpoint's arrays
WEIGHT_LIMIT, NORM_LIMIT = 1e6, 1e30  # no weight of a policy, no sum of its normaliser is larger: float32 stays finite
BELOW_ONE = (lambda v: 0 < v < 1, "between 0 and 1")
NOISE = {"sigma": 0.135, "min_sigma": 0.05}  # where neither the command line nor the character's [training] says


@dataclass
class Options(character.Switches):
    """Everything a run is made of.

    Table 3 of the paper (its hyper-parameters) is not in the text we work from: these are ASSUMED, from measured runs.
    """

    motion: str = arg("builtin", MOTION)
    clips: str = arg("*", "shell pattern on clip names, such as '*walk*'")
    joint_map: str | None = arg(None, HELP["joint_map"])
    unit: str | None = arg(None, HELP["unit"])
    up: str | None = arg(None, HELP["up"])
    steps: int = arg(20_000_000, "control steps to train", check=POSITIVE)
    envs: int = arg(512, "characters simulated side by side", check=COUNT)
    horizon: int = arg(16, "control steps of each character per update", check=COUNT)
    seed: int = arg(0, "seed of everything random", check=NONNEGATIVE)
    out: str | None = arg(None, "run folder; runs/CHARACTER by default")
    resume: bool = arg(False, "continue the run in --out exactly")
    ship: str | None = arg(None, "write the policy of the run in --out to this .npz, and train nothing")
    blend: tuple[str, ...] = arg((), "with --ship: average its weights with those of these policies, of one ancestor")
    share: float = arg(0.5, "of them all together in that average", check=UNIT)
    gain: float = arg(
        1.0, "with --ship: makes the policy's standardised observations so many times as large", check=POSITIVE
    )
    init: str | None = arg(None, "start from the weights of a policy (.npz) or a run folder, with layers as wide")
    gpu: bool = arg(False, "train on an NVIDIA GPU (extra gpu); give thousands of --envs")
    threads: int = arg(
        0, "physics threads, 0 = all cores; if not 1, actor and critic learn side by side", check=THREADS
    )
    solver: str = arg(
        "pgs", "of contacts: pgs, a fifth faster, or newton, exact, as when playing", choices=tuple(character.SOLVERS)
    )
    checkpoint_minutes: float = arg(3.0, "minutes between checkpoints", check=NONNEGATIVE)
    gamma: float = arg(0.97, "discount (QuestSim's)", check=UNIT)
    lam: float = arg(0.95, "lambda of generalised advantage estimation; 1 is Appendix B's return", check=UNIT)
    clip_eps: float = arg(0.2, "epsilon of the clipped loss", check=BELOW_ONE)
    epochs: int = arg(2, "passes over the samples per update", check=COUNT)
    minibatch: int = arg(2048, "samples per gradient step", check=COUNT)
    lr: float = arg(1e-4, "policy's learning rate to start from; adapted to --target-kl", check=POSITIVE)
    value_lr: float = arg(1e-3, "value network's learning rate", check=POSITIVE)
    target_kl: float = arg(0.025, "KL divergence per update that the policy's learning rate aims at", check=POSITIVE)
    max_grad_norm: float = arg(1.0, "gradient norm limit", check=POSITIVE)
    hidden: tuple[int, ...] = arg((256, 128), "hidden layers of the policy", check=ALL_POSITIVE)
    value_hidden: tuple[int, ...] = arg((256, 128), "hidden layers of the value network", check=ALL_POSITIVE)
    sigma: float | None = arg(
        None, "standard deviation of the exploration noise at the start: the character's, or 0.135", check=POSITIVE
    )
    min_sigma: float | None = arg(
        None, "below this the standard deviations do not fall: the character's, or 0.05", check=POSITIVE
    )
    balance: bool = arg(False, "start more often where episodes end soon, so that all motion is simulated equally long")
    retry: float = arg(
        0.0, "share of episodes that start up to 2 s before a place where one failed of late", check=UNIT
    )
    stand: float = arg(
        0.0, "share of episodes that start in the default pose under the headset, as a stream does", check=UNIT
    )
    augment: bool = arg(False, "also mirrored clips at other speeds, by users of other heights and arm lengths")
    sensor_offset: float = arg(0.0, "constant error of device positions in an episode [m]", check=NONNEGATIVE)
    sensor_noise: float = arg(0.0, "white noise on device positions [m]", check=NONNEGATIVE)
    push: float = arg(0.0, "largest random push, every 2 s on average [m/s]", check=NONNEGATIVE)
    episode: int = arg(EPISODE_STEPS, "control steps to truncation [§3.6]", check=POSITIVE)
    sensors: str = arg("full", "what it sees of the user [§4.2]: full, or hmd, the headset alone", choices=SENSORS)
    without: tuple[str, ...] = arg(
        (), f"what to leave out [§4.3, §5.3], one or several of {','.join(WITHOUT)}",
        check=(lambda v: set(v) <= set(WITHOUT), f"one or several of {', '.join(WITHOUT)}"), metavar="NAME,…",
    )  # fmt: skip
    track: str = arg("all", "what it imitates of the kinematic pose [§3.5.1]: all, or the root's place", choices=TRACK)
    gym: str | None = arg(None, "a continuous task of Gymnasium's instead; the defaults are then CleanRL's")
    activation: str = arg("leaky_relu", "of the hidden layers", choices=tuple(ACTIVATIONS))
    schedule: str = arg("kl", "learning rates: by --target-kl, or linear, to 0 at --steps", choices=("kl", "linear"))
    adam_eps: float = arg(1e-8, "epsilon of Adam", check=POSITIVE)
    value_clip: bool = arg(False, "clip the value's change, too, by --clip-eps")
    joint_clip: float | None = arg(None, "clip both gradients by one norm, the value's times this", check=POSITIVE)
    standardise_minibatch: bool = arg(False, "standardise the advantages of each minibatch, not of all samples at once")
    norm_each_step: bool = arg(False, "the normaliser of the inputs learns every step, not between updates")
    reward_norm: bool = arg(False, "with --gym: rewards divided by the spread of the running return, clipped at 10")
    limit_ends: bool = arg(False, "with --gym: a time limit counts as a failure, as in CleanRL: no bootstrap")


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
        raise ValueError(
            f"shapes differ: reward {reward.shape}, value {value.shape}, "
            f"next_value {next_value.shape}, done {done.shape}"
        )
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
    Test      tests/test_ppo.py::test_clipped_surrogate
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


def policy_loss(policy: Policy, x, action, logp_old, adv, eps):
    r"""Loss of a minibatch and its gradient with respect to all of the policy's parameters.

    Equation  −L(θ) of Appendix B, π_θ = N(μ_θ(o), diag σ²)
    Args      x (B, obs), normalised; action (B, u), unclipped; logp_old, adv (B,)
    Returns   loss : float; gradient (P,) laid out as policy.theta_pi; dict(mu, ratio)
    Test      tests/test_ppo.py::test_policy_loss_gradient
    """
    mu, cache = policy.actor.forward(x)
    logp = gaussian_logp(action, mu, policy.log_std)
    loss, dlogp, ratio = clipped_surrogate(logp, logp_old, adv, eps)
    dmu, dlog_std = gaussian_logp_backward(dlogp, action, mu, policy.log_std)
    _, dtheta = policy.actor.backward(dmu, cache, want_dx=False)
    return loss, np.concatenate([dtheta, dlog_std.astype(dtheta.dtype)]), {"mu": mu, "ratio": ratio}


def critic_loss(policy: Policy, x, target, old=None, eps=None):
    r"""½ mean (V(o) − target)² and its gradient  [Reda23 App. B, "supervised learning"].

    Departs   with old and eps (`--value-clip`) ½ mean max((V − target)², (clip(V, old ± eps) − target)²), which stops
              where V has gone far enough towards the target; most PPO code has it, the paper has not
    Args      x (B, critic), normalised; target, old (B,), in units of policy.value_scale
    Returns   loss : float; gradient (P,)
    Test      tests/test_ppo.py::test_critic_loss_gradient, test_value_clip_gradient
    """
    v, cache = policy.critic.forward(x)
    if old is None:
        loss, dv = value_loss(v[:, 0], target)
    else:
        free, held = v[:, 0] - target, np.clip(v[:, 0], old - eps, old + eps) - target
        loss = 0.5 * float(np.mean(np.maximum(free**2, held**2)))
        dv = np.where(free**2 >= held**2, free / len(free), 0.0).astype(v.dtype)
    _, dtheta = policy.critic.backward(dv[:, None], cache, want_dx=False)
    return loss, dtheta


def explained_variance(value, target):
    """1 − Var(target − value) / Var(target): 1 is a perfect critic, 0 as good as the mean.

    Test      tests/test_ppo.py::test_explained_variance
    """
    var = np.var(target)
    return float(1.0 - np.var(target - value) / var) if var > 0 else 0.0


# ------------------------------------------------------------------------------------ two cores

SECOND = ThreadPoolExecutor(1)  # `aside`; its thread begins with the first use
HALVES = 64  # `environments`; fewer characters are one batch, whose physics takes no longer than what is around it


def aside(work, two=True):
    """Begin `work`, a function without arguments, on a second core, if there are `two`.  NumPy lets other threads run
    while it computes on large arrays; work must share nothing with what its caller does meanwhile, and then the results
    are those of one thread.

    Returns   function that waits for what work returns, or raises what it raised
    Test      tests/test_ppo.py::test_second_thread_changes_nothing
    """
    return SECOND.submit(work).result if two else work


# ------------------------------------------------------------------------------------ policy


class Policy:
    """Actor, critic, exploration noise and the normaliser of their inputs.

    theta_pi    : (P + u,) the actor's weights, then log σ: one vector, so one Adam
    norm        : of the whole critic observation; its first obs_size entries are the actor's
    value_scale : V = value_scale × critic(o), so that the network's output is of order 1
    """

    def __init__(
        self, obs_size, critic_size, action_size, hidden, value_hidden, sigma, value_scale, rng, dtype=np.float32,
        activation="leaky_relu",
    ):  # fmt: skip
        self.obs_size, self.critic_size, self.action_size = obs_size, critic_size, action_size
        self.value_scale = value_scale
        self.hidden, self.value_hidden = tuple(hidden), tuple(value_hidden)
        self.activation = activation
        self.actor = MLP((obs_size, *hidden, action_size), activation, rng, gain=0.01, dtype=dtype)
        self.critic = MLP((critic_size, *value_hidden, 1), activation, rng, gain=1.0, dtype=dtype)
        log_std = np.full(action_size, np.log(sigma), dtype)
        self.theta_pi = np.concatenate([self.actor.theta, log_std])
        self.actor.theta = self.theta_pi[: self.actor.n_params]
        self.log_std = self.theta_pi[self.actor.n_params :]
        self.norm = RunningNorm(critic_size)

    def mean_action(self, obs):
        """The policy without noise, for playing.  obs (N, obs_size), raw -> (N, u)"""
        n = self.norm
        x = np.clip((obs - n.mean[: self.obs_size]) * n.inv_std[: self.obs_size], -n.clip, n.clip)
        return self.actor(x)

    def value(self, x, rows=4096, two=False):
        """V of normalised critic observations (B, critic_size) -> (B,) float64; two : on two cores."""
        parts = [x[i : i + rows] for i in range(0, len(x), rows)]
        half = len(parts) // 2
        first = aside(lambda: [self.critic(p)[:, 0] for p in parts[:half]], two)
        second = [self.critic(p)[:, 0] for p in parts[half:]]
        return np.concatenate(first() + second).astype(float) * self.value_scale

    def arrays(self):
        """All that makes the policy, for a checkpoint.  Test: tests/test_ppo.py::test_policy_round_trip"""
        norm = {f"policy.norm.{k}": v for k, v in self.norm.state().items()}
        return {"policy.pi": self.theta_pi.copy(), "policy.critic": self.critic.theta.copy(), **norm}

    def shape(self):
        return {
            "obs_size": self.obs_size,
            "critic_size": self.critic_size,
            "action_size": self.action_size,
            "hidden": list(self.hidden),
            "value_hidden": list(self.value_hidden),
            "value_scale": self.value_scale,
            "activation": self.activation,
        }

    def load(self, arrays):
        """Take over what `arrays` returned.  ValueError: other sizes"""
        for name, own in (("policy.pi", self.theta_pi), ("policy.critic", self.critic.theta)):
            if arrays[name].shape != own.shape:
                raise ValueError(f"{name} has shape {arrays[name].shape}, expected {own.shape}")
            if arrays[name].dtype.kind != "f" or not np.all(np.abs(arrays[name].astype(float)) <= WEIGHT_LIMIT):
                raise ValueError(f"{name} holds no weights, valid: numbers of at most {WEIGHT_LIMIT:g}")
            own[:] = arrays[name]
        count, mean, m2 = (arrays[f"policy.norm.{k}"] for k in ("count", "mean", "m2"))
        if count.dtype.kind not in "iu" or mean.dtype.kind != "f" or m2.dtype.kind != "f" or count.min() < 0:
            raise ValueError("policy.norm holds no count, mean and sum of squares")
        mean, m2 = mean.astype(float), m2.astype(float)
        if not np.all(np.abs(mean) <= NORM_LIMIT) or not np.all((m2 >= 0) & (m2 <= NORM_LIMIT)):
            raise ValueError(f"policy.norm's numbers are beyond 0 and {NORM_LIMIT:g}")
        self.norm.load_state(dict(count=count, mean=mean, m2=m2))

    def rearranged(self, inputs, obs_size, outputs) -> Policy:
        """The same policy with other inputs and outputs: one left out is as if it stayed at its mean, a new one is
        ignored, a new action is 0.

        Args      inputs : (critic,) which of this policy's inputs each is, -1 for a new one, the actor's first;
                  obs_size : how many the actor has; outputs : (u,) the same of the actions
        Test      tests/test_ppo.py::test_init_headset_only, test_init_of_another_character"""
        inputs, outputs = np.asarray(inputs), np.asarray(outputs)
        sizes = obs_size, len(inputs), len(outputs), self.hidden, self.value_hidden
        out = Policy(*sizes, 1.0, self.value_scale, np.random.default_rng(0), self.theta_pi.dtype, self.activation)
        for mine, its, rows in ((self.actor, out.actor, inputs[:obs_size]), (self.critic, out.critic, inputs)):
            last = mine.n_layers - 1
            for name, value in mine.params.items():
                if name == "W0":
                    value = value[rows] * (rows >= 0)[:, None]
                if its is out.actor and name in (f"W{last}", f"b{last}"):
                    value = value[..., outputs] * (outputs >= 0)
                its.params[name][:] = value
        out.log_std[:] = np.where(outputs >= 0, self.log_std[outputs], self.log_std.mean())
        state = {k: v if k == "count" else v[inputs] for k, v in self.norm.state().items()}
        state["mean"] = np.where(inputs >= 0, state["mean"], 0.0)
        state["m2"] = np.where(inputs >= 0, state["m2"], float(state["count"]))
        out.norm.load_state(state)
        return out

    def begin_from(self, other: Policy, path, rng):
        """Take over another policy's function; its networks may be narrower (`nn.widened`).

        Where this critic sees no more than the actor [§5.3] and the other's does, it stays as it was made.
        Raises    UserError, naming path: another depth, a wider layer, or another critic's observation
        Test      tests/test_ppo.py::test_init_widens, test_init_symmetric"""
        anew = self.critic_size == self.obs_size < other.critic_size
        if other.activation != self.activation:
            raise UserError(f"{path}: its hidden layers are {other.activation}: give --activation {other.activation}")
        try:
            actor = widened(other.actor, self.actor.sizes, rng)
            critic = self.critic if anew else widened(other.critic, self.critic.sizes, rng)
        except ValueError:
            raise UserError(
                f"{path}: its networks are {other.hidden} and {other.value_hidden}, with {other.critic_size} inputs "
                "for the critic: give --hidden and --value-hidden as many layers, none smaller"
            ) from None
        self.theta_pi[:] = np.concatenate([actor.theta, other.log_std])
        self.critic.theta[:] = critic.theta
        seen = {k: v if k == "count" else v[: self.critic_size] for k, v in other.norm.state().items()}
        self.norm.load_state(seen)
        if anew:
            sees = f"its critic sees {other.critic_size} numbers, this one's only the actor's {self.obs_size}"
            print(f"{path}: {sees}: the critic begins anew")


def load_policy(path) -> tuple[Policy, dict]:
    """Read a policy from a run folder, or from a checkpoint's or shipped policy's .npz.

    Returns   Policy with the normaliser frozen; meta with "options", "steps" and what else was saved
    Raises    UserError: missing, damaged, or not a policy
    Test      tests/test_ppo.py::test_policy_round_trip, test_broken_policies
    """
    path = Path(path)
    names = ("policy.pi", "policy.critic", "policy.norm.mean", "policy.norm.m2")
    loaded = latest_checkpoint(path, names) if path.is_dir() else load_checkpoint(path, names)
    if loaded is None:
        raise UserError(f"{path}: holds no checkpoint; valid: a run folder with {CHECKPOINT}, or a policy's .npz")
    arrays, meta = loaded
    try:
        shape = _checked_shape(meta["policy"], arrays)
        policy = Policy(sigma=1.0, rng=np.random.default_rng(0), **shape)
        policy.load(arrays)
    except (KeyError, TypeError, ValueError) as e:
        raise UserError(f"{path}: not a policy ({e}); valid: a checkpoint that ppo.py wrote") from None
    policy.norm.frozen = True
    return policy, meta


def _checked_shape(shape, arrays) -> dict:
    """The networks' sizes, if the arrays have them: nothing is made that the file does not hold.  ValueError if not"""
    shape = {"activation": "leaky_relu"} | dict(shape)
    if shape["activation"] not in ACTIVATIONS:
        raise ValueError(f"activation {str(shape['activation'])[:80]!r}, valid: {', '.join(ACTIVATIONS)}")
    layers = {k: [shape[f"{k}_size"], *shape[h]] for k, h in (("obs", "hidden"), ("critic", "value_hidden"))}
    layers = {"policy.pi": [*layers["obs"], shape["action_size"]], "policy.critic": [*layers["critic"], 1]}
    for name, sizes in layers.items():
        if not all(type(n) is int and n > 0 for n in sizes):
            raise ValueError(f"layers of {str(sizes)[:80]}, valid: integers greater than 0")
        weights = sum((a + 1) * b for a, b in zip(sizes, sizes[1:])) + (sizes[-1] if name == "policy.pi" else 0)
        if arrays[name].shape != (weights,):
            raise ValueError(f"{name} has shape {arrays[name].shape}, expected {(weights,)} for layers of {sizes}")
    if type(shape["value_scale"]) not in (int, float) or not shape["value_scale"] > 0:
        raise ValueError(f"value_scale is {str(shape['value_scale'])[:80]}, valid: a number greater than 0")
    return shape


def blended(policy: Policy, others: list[Policy], share: float) -> Policy:
    r"""A policy's weights averaged with those of its ancestor, or of others that were fine-tuned from the same one.

    Equation  theta = (1 - s) theta + s mean(theta'), and so the normaliser's means and variances  [Wortsman22, "model
              soups"]; the critic stays as it is if one of the others was trained with another reward
    Why       what was learnt lately on some motions and what was known before on others are both kept: such policies
              lie in one valley, and its middle is lower than its slopes (measured, REPRODUCE.md)
    Args      share : s, of the others together
    Returns   policy, changed
    Raises    ValueError: networks of other sizes
    Test      tests/test_ppo.py::test_blended
    """
    own = policy.shape()
    for other in others:
        if other.shape() | {"value_scale": own["value_scale"]} != own:
            raise ValueError(f"networks {other.shape()}, expected {own}")

    def mix(get):
        rest = np.mean([get(p).astype(float) for p in others], axis=0)
        return (1.0 - share) * get(policy) + share * rest

    policy.theta_pi[:] = mix(lambda p: p.theta_pi)
    if all(p.value_scale == policy.value_scale for p in others):
        policy.critic.theta[:] = mix(lambda p: p.critic.theta)
    mean, var, count = mix(lambda p: p.norm.mean64), mix(lambda p: p.norm.var), policy.norm.count
    policy.norm.load_state({"count": np.array(count), "mean": mean, "m2": var * count})
    return policy


def total_steps(meta) -> int:
    """Control steps that a policy has seen, those of the policies that it went on from with --init included.

    Test      tests/test_ppo.py::test_ship"""
    return sum(meta[k] for k in ("steps", "before") if type(meta.get(k)) is int)


def _body(meta, path) -> tuple:
    """Which body a policy was trained with: the character and its variation, rewards left out; () of none named."""
    own = trained_as(meta, path)
    if own is None:
        return ()
    changes = {c.strip() for c in (own.set or "").split(";")}
    body = sorted(c for c in changes if c and not c.startswith("reward"))
    return Path(own.character).stem, own.tail, own.scale, *body


def ship(run, path, blend=(), share=0.5, gain=1.0) -> dict:
    """Write a run's policy for others to play: weights, normaliser, how it was trained, its data's licence.

    Args      blend : policies to average it with (`blended`), share : of them together
              gain : the normaliser's deviations are divided by it.  Averaging shrinks weights where policies differ,
              and with them the answer to a deviation; a gain of some per cent gives it back (measured, REPRODUCE.md)
    Returns   what was written beside the weights
    Raises    UserError: the run has no checkpoint, a policy does not fit, or the path cannot be written
    Test      tests/test_ppo.py::test_ship, test_blended
    """
    policy, meta = load_policy(run)
    loaded = [load_policy(p) for p in blend]
    try:
        own = _body(meta, run)
        if odd := [str(p) for p, (_, m) in zip(blend, loaded, strict=True) if _body(m, p) != own]:
            raise ValueError(f"{', '.join(odd)}: another body or pose than {own}")
        policy = blended(policy, [p for p, _ in loaded], share) if blend else policy
    except ValueError as e:
        raise UserError(
            f"--blend {','.join(map(str, blend))}: {e}; valid: policies of one ancestor with {run}"
        ) from None
    try:
        motion, _, _, _ = str(meta["options"]["motion"]), meta["options"]["init"], meta["steps"], meta["data"]
    except (KeyError, TypeError) as e:
        raise UserError(f"{run}: does not say how it was trained ({e}); valid: a folder that ppo.py wrote") from None
    sets = mocap.data.parts(motion)
    licences = [f"weights trained on {text}" for text in mocap.data.licences(sets)]
    if "licence" in meta:  # was shipped before
        licences = [str(meta["licence"])] if meta["licence"] != "MIT" else []
    kept = {"policy": meta["policy"], "steps": total_steps(meta), "data": meta["data"]}
    kept["options"] = meta["options"] | {"motion": ",".join(Path(s).name for s in sets), "out": None, "init": None}
    policy.norm.load_state(policy.norm.state() | {"m2": policy.norm.m2 / gain**2})
    kept |= {"gain": gain} if gain != 1.0 else {}
    if blend:
        kept["blend"] = {"with": [Path(p).name for p in blend], "share": share}
        older = {str(m["licence"]) for _, m in loaded if m.get("licence", "MIT") != "MIT"}
        licences += sorted(older - set(licences))
    kept |= {"licence": "; ".join(licences) or "MIT", "versions": versions(), "git": git_state()}
    save_checkpoint(path, policy.arrays(), kept)
    return kept


def check_fits(policy: Policy, env: Env, path):
    """UserError if a policy was trained for another character or another observation."""
    have, need = (policy.obs_size, policy.action_size), (env.obs_size, env.action_size)
    if have != need:
        raise UserError(
            f"{path}: a policy of {have[0]} observations and {have[1]} actions; "
            f"{env.name} needs {need[0]} and {need[1]}: use the character it was trained for"
        )


# ------------------------------------------------------------------------------------ the loop


class Trainer:
    """Collect, estimate, update; all state that a resumed run needs.

    envs : one, or the two halves of `environments`; env : the first, which knows all sizes; n : characters in all
    rngs : of each one's exploration; the first draws the minibatches, too
    Test      tests/test_ppo.py::test_resume_is_exact, test_learns, test_non_finite_state_does_not_reach_the_networks
    """

    def __init__(self, opt: Options, *envs: Env | Task):
        env = envs[0]
        noise = {k: v for k, v in (NOISE | env.training).items() if getattr(opt, k) is None}
        self.opt, self.env, self.envs = (opt := replace(opt, **noise)), env, envs
        ends = np.cumsum([e.n for e in envs])
        self.n, self.rows = int(ends[-1]), [slice(int(end) - e.n, int(end)) for end, e in zip(ends, envs, strict=True)]
        self.rngs = [np.random.default_rng([opt.seed, 1, k]) for k in range(len(envs))]
        sizes = (env.obs_size, env.critic_size, env.action_size)
        self.policy = Policy(
            *sizes, opt.hidden, opt.value_hidden, opt.sigma, env.value_scale(opt.gamma),
            np.random.default_rng([opt.seed, 2]), activation=opt.activation,
        )  # fmt: skip
        self.adam_pi = Adam(self.policy.theta_pi.size, opt.lr, eps=opt.adam_eps)
        self.adam_v = Adam(self.policy.critic.theta.size, opt.value_lr, eps=opt.adam_eps)
        self.steps = self.updates = 0
        t, n = opt.horizon, self.n
        self.x = np.zeros((t, n, env.critic_size), np.float32)  # normalised observations
        self.raw = np.zeros((t, n, env.critic_size), np.float32)
        self.action, self.mu = (np.zeros((t, n, env.action_size), np.float32) for _ in range(2))
        self.logp = np.zeros((t, n), np.float32)
        self.reward, self.next_value = np.zeros((t, n)), np.zeros((t, n))
        self.terminated, self.truncated = np.zeros((t, n), bool), np.zeros((t, n), bool)
        self.two = opt.threads != 1 and opt.minibatch >= 1024

    @property
    def full(self):
        """The present observations of all characters.  (n, critic_size)"""
        return self.env.full if len(self.envs) == 1 else np.concatenate([e.full for e in self.envs])

    def start(self):
        """First observation; the normaliser begins with it, or the first update would see unscaled inputs."""
        for k, env in enumerate(self.envs):  # the GPU's random numbers have their seed already
            env.reset(None if self.opt.gpu else [self.opt.seed, k] if k else self.opt.seed)
        if self.policy.norm.count == 0:
            self.policy.norm.update(self.full)

    def collect(self) -> dict:
        """`horizon` steps of every environment with the present policy.  -> what happened, for the progress line

        Test      tests/test_ppo.py::test_stored_action_is_unclipped, test_second_thread_changes_nothing
        """
        later = [aside(partial(self._simulate, k), self.opt.threads != 1) for k in range(1, len(self.envs))]
        finals, sums, ends, lengths, shares = zip(self._simulate(0), *(wait() for wait in later), strict=True)
        self.steps += self.opt.horizon * self.n
        flat = (-1, self.env.action_size)
        logp = gaussian_logp(self.action.reshape(flat), self.mu.reshape(flat), self.policy.log_std)
        self.logp[:] = logp.reshape(self.logp.shape)
        self._values([f for part in finals for f in part])
        lengths, shares = np.concatenate(lengths), np.concatenate(shares)
        seconds = self.opt.horizon * self.n * self.env.dt
        stats = dict(
            episodes=len(lengths),
            length=float(lengths.mean()) if len(lengths) else float("nan"),
            survival=float(shares.mean()) if len(shares) else float("nan"),
            time_to_failure=seconds / max(int(self.terminated.sum()), 1),
            failures=int(self.terminated.sum()),
            reward=float(self.reward.mean()),
        )
        stats |= {f"r_{k}": sum(part[k] for part in sums) / (self.opt.horizon * self.n) for k in self.env.TERMS}
        return stats | {f"end_{k}": sum(part[k] for part in ends) for k in self.env.ENDS} | self.env.stats()

    def _simulate(self, k):
        """Environment k's steps, stored in its rows of the samples; nothing else that is shared changes.

        Returns   finals : (step, rows, normalised observations) at truncations, before the reset
                  sums : reward terms over steps and characters; ends : episodes by their end
                  lengths, shares : of the episodes that ended, steps lived and their share of those there were
        """
        env, policy, norm, rng, rows = self.envs[k], self.policy, self.policy.norm, self.rngs[k], self.rows[k]
        finals, lengths, shares = [], [], []
        sums, ends = dict.fromkeys(env.TERMS, 0.0), dict.fromkeys(env.ENDS, 0)
        sigma = np.exp(policy.log_std)
        for t in range(self.opt.horizon):
            self.raw[t, rows] = env.full
            x = norm.normalise(env.full, out=self.x[t, rows])
            mu = policy.actor(x[:, : env.obs_size])
            noise = rng.standard_normal(mu.shape, dtype=np.float32)
            a = mu + sigma * noise
            self.mu[t, rows], self.action[t, rows] = mu, a
            _, r, terminated, truncated, info = env.step(a)
            self.reward[t, rows], self.terminated[t, rows], self.truncated[t, rows] = r, terminated, truncated
            if self.opt.norm_each_step:
                norm.update(env.full)
            if truncated.any():
                ids = np.flatnonzero(truncated)
                finals.append((t, rows.start + ids, norm.normalise(info["final_critic"][ids])))
            for name in sums:
                sums[name] += float(info["terms"][name].sum())
            for name in ends:
                ends[name] += int(info["ends"][name].sum())
            done = terminated | truncated
            lengths.append(info["length"][done])
            shares.append((info["length"] / info["available"])[done])
        return finals, sums, ends, np.concatenate(lengths), np.concatenate(shares)

    def _values(self, finals):
        """V(o_t) and V(o_{t+1}) of everything collected, with the old network.

        Test      tests/test_ppo.py::test_bootstrap_is_before_the_reset
        """
        policy = self.policy
        t, n = self.reward.shape
        self.old_value = policy.value(self.x.reshape(t * n, -1), two=self.two).reshape(t, n)
        self.next_value[:-1] = self.old_value[1:]
        # App. B: bootstrap at the trajectory's end
        self.next_value[-1] = policy.value(policy.norm.normalise(self.full))
        for step, ids, rows in finals:  # truncation is not failure
            self.next_value[step, ids] = policy.value(rows)
        self.next_value[self.terminated] = 0.0

    def update(self) -> dict:
        """Several epochs of minibatches of the two losses; then the learning rate follows the KL divergence.

        Test      tests/test_ppo.py::test_update_improves_both_losses, test_rate_follows_kl_and_sigma_has_a_floor,
                  test_linear_schedule, test_joint_clip
        """
        opt, policy = self.opt, self.policy
        follows_kl = opt.schedule == "kl"
        if not follows_kl:  # linear
            left = max(1.0 - (self.steps - self.reward.size) / opt.steps, 0.0)
            self.adam_pi.lr, self.adam_v.lr = left * opt.lr, left * opt.value_lr
        done = self.terminated | self.truncated
        advantage, target = gae(self.reward, self.old_value, self.next_value, done, opt.gamma, opt.lam)
        variance = explained_variance(self.old_value, target)
        flat = lambda v: v.reshape(-1, *v.shape[2:])  # noqa: E731
        x, action, mu, logp = flat(self.x), flat(self.action), flat(self.mu), flat(self.logp)
        seen = x[:, : policy.obs_size]
        adv = (advantage if opt.standardise_minibatch else standardise(advantage)).ravel().astype(np.float32)
        old_value = (self.old_value / policy.value_scale).ravel().astype(np.float32)
        target = (target / policy.value_scale).ravel().astype(np.float32)
        old_std = policy.log_std.copy()
        samples = len(adv)
        kls, clipped, pi_losses, v_losses = [], [], [], []

        def critic(rows):
            old = (old_value[rows], opt.clip_eps) if opt.value_clip else ()
            return critic_loss(policy, x[rows], target[rows], *old)

        def critic_step(rows):
            loss, grad = critic(rows)
            clip_grad_norm(grad, opt.max_grad_norm)
            self.adam_v.step(policy.critic.theta, grad)
            return loss

        for epoch in range(opt.epochs):
            order = self.rngs[0].permutation(samples)
            batches = [order[start : start + opt.minibatch] for start in range(0, samples, opt.minibatch)]
            kls, apart = [], [] if opt.joint_clip else batches
            learnt = aside(lambda apart=apart: [critic_step(rows) for rows in apart], self.two)
            if epoch == 0 and not opt.norm_each_step:  # for the next samples; these are normalised already
                policy.norm.update(self.raw)
            for rows in batches:
                advb = standardise(adv[rows]) if opt.standardise_minibatch else adv[rows]
                loss, grad, out = policy_loss(policy, seen[rows], action[rows], logp[rows], advb, opt.clip_eps)
                if opt.joint_clip:
                    v_loss, v_grad = critic(rows)
                    both = np.concatenate([grad, opt.joint_clip * v_grad])
                    clip_grad_norm(both, opt.max_grad_norm)
                    grad, v_grad = np.split(both, [len(grad)])
                    self.adam_v.step(policy.critic.theta, v_grad)
                    v_losses.append(v_loss)
                else:
                    clip_grad_norm(grad, opt.max_grad_norm)
                kls.append(gaussian_kl(mu[rows], old_std, out["mu"], policy.log_std))
                self.adam_pi.step(policy.theta_pi, grad)
                np.maximum(policy.log_std, math.log(opt.min_sigma), out=policy.log_std)
                clipped.append(float(np.mean(np.abs(out["ratio"] - 1.0) > opt.clip_eps)))
                pi_losses.append(loss)
            v_losses += learnt()
            kl = fmean(kls)
            # ASSUMED: leave the samples before they no longer describe the policy
            if follows_kl and kl > 2.0 * opt.target_kl:
                break
        # ASSUMED: the step size follows the KL divergence of the last epoch
        if follows_kl and kl > 1.3 * opt.target_kl:
            self.adam_pi.lr = max(self.adam_pi.lr / 1.2, 1e-6)
        elif follows_kl and kl < opt.target_kl / 1.3:
            self.adam_pi.lr = min(self.adam_pi.lr * 1.2, 1e-2)
        self.updates += 1
        return dict(
            kl=kl,
            clip_fraction=fmean(clipped),
            explained_variance=variance,
            lr=self.adam_pi.lr,
            sigma=float(np.exp(policy.log_std).mean()),
            entropy=float(gaussian_entropy(policy.log_std)),
            policy_loss=fmean(pi_losses),
            value_loss=fmean(v_losses),
            saturation=float(np.mean(np.abs(self.action) > 0.99)),
        )

    # ---- checkpoints

    def save(self, path, meta):
        """Everything: policy, optimisers, environments, random states."""
        own = dict(steps=self.steps, updates=self.updates, lr=self.adam_pi.lr, policy=self.policy.shape())
        if self.opt.gpu:  # the policy alone: --init goes on from it
            save_checkpoint(path, fetched(self.policy.arrays()), meta | own)
            return
        arrays, rest = self.policy.arrays(), dict(rng=[rng_state(r) for r in self.rngs], env=[])
        for k, env in enumerate(self.envs):
            env_arrays, env_meta = env.state()
            arrays |= {f"env{k}.{name}": v for name, v in env_arrays.items()}
            rest["env"].append(env_meta)
        for name, adam in (("adam_pi", self.adam_pi), ("adam_v", self.adam_v)):
            arrays |= {f"{name}.{k}": v for k, v in adam.state().items()}
        save_checkpoint(path, arrays, meta | own | rest)

    def restore(self, arrays, meta, path="the checkpoint"):
        """Continue bit-exactly from what `save` wrote.  UserError, naming path: something else was saved"""
        try:
            for key in ("steps", "updates", "rows"):
                if type(meta.get(key, 0)) is not int or meta.get(key, 0) < 0:
                    raise ValueError(f"{key} is {str(meta[key])[:80]}, valid: an integer of at least 0")
            if type(meta["lr"]) not in (int, float) or not meta["lr"] > 0:
                raise ValueError(f"lr is {str(meta['lr'])[:80]}, valid: a number greater than 0")
            self.policy.load(arrays)
            for name, adam in (("adam_pi", self.adam_pi), ("adam_v", self.adam_v)):
                state = {k: arrays[f"{name}.{k}"] for k in ("t", "m", "v")}
                if {a.dtype for a in state.values()} != {np.dtype(np.int64), adam.m.dtype} or state["t"].min() < 0:
                    raise ValueError(f"{name} holds no optimiser's state")
                if not np.all(state["v"] >= 0):
                    raise ValueError(f"{name}.v is negative")
                adam.load_state(state)
            self.adam_pi.lr, self.steps, self.updates = meta["lr"], meta["steps"], meta["updates"]
            self.rngs = [rng_from_state(r) for _, r in zip(self.envs, meta["rng"], strict=True)]
            for k, (env, own) in enumerate(zip(self.envs, meta["env"], strict=True)):
                prefix = f"env{k}."
                env.load_state({n.removeprefix(prefix): v for n, v in arrays.items() if n.startswith(prefix)}, own)
        except (KeyError, TypeError, ValueError) as e:
            raise UserError(
                f"{path}: does not fit this run ({type(e).__name__}: {e}); give another --out, with --init {path}"
            ) from None
        except UserError as e:
            raise UserError(f"{path}: {e}") from None


def fingerprint(ref) -> str:
    """Hash of the reference motions: tells whether two runs saw the same data.

    Test      tests/test_ppo.py::test_fingerprint
    """
    return hashlib.sha256(np.ascontiguousarray(ref.qpos)).hexdigest()[:16]


def environments(char, ref, opt: Options) -> list[Env]:
    """A run's characters, as two halves if there are many: one half is observed while the other's physics runs.

    What is trained does not depend on how many threads do it.
    Test      tests/test_ppo.py::test_halves, test_second_thread_changes_nothing"""
    sizes = [opt.envs - opt.envs // 2, opt.envs // 2]
    if opt.envs < HALVES or opt.gpu or opt.norm_each_step:
        sizes = [opt.envs]
    settings = dict(
        threads=opt.threads, horizon=opt.episode, balance=opt.balance, retry=opt.retry, stand=opt.stand,
        disturbance=Disturbance(opt.sensor_offset, opt.sensor_noise, opt.push),
        asymmetric="asymmetric" not in opt.without,
    )  # fmt: skip
    return [Env(char, ref, n, [opt.seed, k], **settings) for k, n in enumerate(sizes)]


def make_envs(opt: Options) -> list[Env] | list[Task]:
    """Character, stitched training sequences, augmented if asked for, environments.  Or Gymnasium's task.

    Test      tests/test_ppo.py::test_make_envs_augments, tests/extras/test_gym_env.py::test_wrong_tasks
    """
    if opt.gym:
        character_only(opt, Options())
        return [Task(opt.gym, opt.envs, opt.seed, opt.gamma, opt.reward_norm, opt.limit_ends)]
    if opt.reward_norm or opt.limit_ends:
        raise UserError("--reward-norm and --limit-ends are of tasks: give --gym, or leave them out")
    char = ablated(opt.load(), opt.without, opt.track).solved_by(opt.solver)
    clips = sequences(opt.motion, "train", opt.clips, seed=opt.seed, reading=Reading.of(opt))
    if opt.augment:
        clips = mocap.augment.augment(clips, np.random.default_rng([opt.seed, 3]))
    ref = retarget.reference(char, clips)
    return environments(char, headset_only(ref) if opt.sensors == "hmd" else ref, opt)


def initial_policy(path, env: Env, sigma) -> Policy:
    """The policy of --init, rearranged by the names of inputs and joints where it is another character's or knows more.

    Of one with controllers the inputs that remain without them go on [§4.2]; of another variation of the character (its
    tail, §5.1) what both have.  Another character's policy keeps what the two have names for in common; its normaliser
    and σ begin anew, because the sizes are others.
    Raises    UserError: it does not fit; it knows the headset alone and the run has controllers
    Test      tests/test_ppo.py::test_init_headset_only, test_init_of_another_character, test_init_of_a_variation"""
    policy, meta = load_policy(path)
    if isinstance(env, Task):
        check_fits(policy, env, path)
        return policy
    trained = sensors_of(meta, path)
    if trained == "hmd" and env.devices == 3:
        raise UserError(f"{path}: was trained with the headset alone: give --sensors hmd")
    own = trained_as(meta, path)
    if own is None:
        check_fits(policy, env, path)
        return policy
    same, char = own.character in (env.char.name, str(env.char.path)), own.load()
    devices, asymmetric = (3 if trained == "full" else 1), policy.critic_size > policy.obs_size
    have = input_names(char, devices, asymmetric), [char.hinges[h] for h in char.driven]
    need = input_names(env.char, env.devices, asymmetric), [env.char.hinges[h] for h in env.char.driven]
    if have == need or (len(have[0]), len(have[1])) != (policy.critic_size, policy.action_size):
        check_fits(policy, env, path)
        return policy
    inputs, outputs = (
        [names.index(n) if n in names else -1 for n in wanted] for names, wanted in zip(have, need, strict=True)
    )
    policy = policy.rearranged(inputs, env.obs_size, outputs)
    if not same:
        policy.norm.load_state(RunningNorm(policy.critic_size).state())
        policy.log_std[:] = np.log(sigma)
        print(
            f"{path}: {char.name}'s policy: {sum(i >= 0 for i in inputs)} of {len(inputs)} inputs and "
            f"{sum(i >= 0 for i in outputs)} of {len(outputs)} torques have the same names here and go on"
        )
    return policy


def trained_as(meta, path) -> character.Switches | None:
    """Which character, with which variation, a policy was trained for; None where its file names none.

    Raises    UserError: its options are damaged
    Test      tests/test_play.py::test_character_of_the_policy"""
    options = meta.get("options")
    if not isinstance(options, dict) or "character" not in options:
        return None
    found = {f.name: options.get(f.name, f.default) for f in fields(character.Switches)}
    texts = [found["character"], found["tail"] or "", found["set"] or ""]
    if not all(isinstance(t, str) for t in texts) or type(found["scale"]) not in (int, float) or not found["scale"] > 0:
        raise UserError(f"{path}: its options name no character: {str(found)[:200]}; valid: what ppo.py wrote")
    return character.Switches(**found)


def sensors_of(meta, path) -> str:
    """What a policy was trained to see, "full" or "hmd".  UserError: its options say something else

    Test      tests/test_ppo.py::test_init_headset_only"""
    options = meta.get("options", {})
    found = options.get("sensors", "full") if isinstance(options, dict) else options
    if found not in SENSORS:
        raise UserError(f"{path}: its options have sensors {str(found)[:80]!r}; valid: {', '.join(SENSORS)}")
    return found


CHANGEABLE = ("steps", "threads", "checkpoint_minutes", "resume", "out")


def resumed_options(opt: Options, argv) -> Options:
    """The stored options of the run in --out; the command line may change only what keeps the run the same run.

    Raises    UserError: a given option differs from the stored one
    Test      tests/test_ppo.py::test_resume_refuses_other_options
    """
    check_run(opt.out, resume=True)
    stored = stored_options(Options, opt.out)
    given = given_flags(argv)
    values = {}
    for f in fields(Options):
        value = stored.get(f.name, getattr(opt, f.name))
        if f.name in given and getattr(opt, f.name) != value:
            if f.name not in CHANGEABLE:
                raise UserError(
                    f"{opt.out}: was started with --{f.name} {value}; to resume, leave it out "
                    f"(can change: {', '.join(CHANGEABLE[:3])})"
                )
            value = getattr(opt, f.name)
        values[f.name] = value
    return Options(**values | {"resume": True, "out": opt.out})


def train(opt: Options) -> Trainer:
    """Run, or resume, a training run.

    Test      tests/test_ppo.py::test_resume_is_exact, tests/robustness/test_cli.py::test_ppo"""
    out = Path(opt.out)
    if opt.gpu and (opt.gym or opt.resume):
        raise UserError("--gpu trains a character, and goes on with --init: leave --gym and --resume out")
    loaded = latest_checkpoint(out, FINITE) if opt.resume else None
    began = time.perf_counter()
    check_run(out, opt.resume)
    # The configuration is checked and the motions are read before the folder is made: a typo leaves nothing behind.
    trainer = Trainer(opt, *make_envs(opt))
    opt, env = trainer.opt, trainer.env
    before = loaded[1].get("before", 0) if loaded else 0  # steps of the policies that it goes on from
    if opt.init and not loaded:  # a run resumed before its first checkpoint begins as it began
        policy = initial_policy(opt.init, env, opt.sigma)
        before = total_steps(load_policy(opt.init)[1])
        trainer.policy.begin_from(policy, opt.init, np.random.default_rng([opt.seed, 4]))
        np.maximum(trainer.policy.log_std, np.log(opt.min_sigma), out=trainer.policy.log_std)
    data = env.data() if opt.gym else {
        "fingerprint": fingerprint(env.ref), "sequences": len(env.ref.names), "minutes": len(env.ref) * env.dt / 60
    }  # fmt: skip
    seen = loaded[1].get("data", data) if loaded else data
    if not isinstance(seen, dict) or seen.get("fingerprint") != data["fingerprint"]:
        raise UserError(
            f"{out}: the {'task has' if opt.gym else 'motions have'} changed since the run began "
            f"({seen} against {data}); start a new run with --init {out}"
        )
    with ExitStack() as stack:
        if opt.gpu:
            stack.enter_context(arrays_of(moved(trainer)))
        _loop(trainer, loaded, {"options": asdict(opt), "data": data, "before": before}, time.perf_counter() - began)
    return trainer


def _loop(trainer: Trainer, loaded, meta, seconds):
    """Collect and update until --steps or a signal, with checkpoints."""
    opt, env, data, out = trainer.opt, trainer.env, meta["data"], Path(trainer.opt.out)
    if loaded:
        trainer.restore(*loaded, out / CHECKPOINT)
    else:
        trainer.start()
    open_run(out, asdict(opt) | {"data": data}, opt.resume)
    metrics = Metrics(out / METRICS, loaded[1].get("rows", 0) if loaded else None)
    progress = Progress(opt.steps, trainer.steps)
    print(
        f"{env.name}: {env.obs_size} observations ({env.critic_size} for the critic), {env.action_size} actions, "
        f"{data['sequences']} sequences, {data['minutes']:.1f} min; policy {trainer.policy.actor.n_params:,} and "
        f"critic {trainer.policy.critic.n_params:,} weights; ready in {seconds:.1f} s"
    )
    if trainer.steps >= opt.steps:
        print(
            f"nothing to do: {fmt_count(trainer.steps)} steps are done, and --steps {opt.steps} is the total to reach"
        )
    saved = time.perf_counter()
    with StopFlag() as flag:
        while trainer.steps < opt.steps and not flag.stop:
            t0 = time.perf_counter()
            stats = trainer.collect()
            t1 = time.perf_counter()
            stats |= trainer.update()
            t2 = time.perf_counter()
            stats |= {"steps_per_s": opt.horizon * trainer.n / (t2 - t0), "collect_s": t1 - t0, "update_s": t2 - t1}
            metrics.append({"update": trainer.updates, "steps": trainer.steps} | stats)
            progress.update(trainer.steps, progress_line(stats))
            if t2 - saved >= 60 * opt.checkpoint_minutes:
                trainer.save(out / CHECKPOINT, meta | {"rows": metrics.rows})
                saved = t2
    trainer.save(out / CHECKPOINT, meta | {"rows": metrics.rows})
    metrics.close()
    if flag.stop:
        print(
            f"stopped at {fmt_count(trainer.steps)} steps; continue with: python ppo.py "
            + (f"--init {out}" if opt.gpu else f"--resume --out {out}")
        )


def progress_line(s) -> dict:
    """The numbers a watcher needs, short."""
    terms = " ".join(f"{k[2:]} {v:.2f}" for k, v in s.items() if k.startswith("r_") and v)
    ends = " ".join(f"{k[4:]} {v}" for k, v in s.items() if k.startswith("end_") and v)
    known = {"return of 100": f"{s['return_100']:.0f}"} if "return_100" in s else {}
    return known | {
        "steps/s": f"{s['steps_per_s']:.0f}",
        "fails every": f"{s['time_to_failure']:.2f} s" if s["failures"] else "never",
        "survival": f"{s['survival']:.2f}",
        "reward": f"{s['reward']:.2f}",
        "[": f"{terms} ]",
        "ends": ends or "none",
        "kl": f"{s['kl']:.3f}",
        "clip": f"{s['clip_fraction']:.2f}",
        "ev": f"{s['explained_variance']:.2f}",
        "σ": f"{s['sigma']:.3f}",
    }


def main(argv=None):
    """python ppo.py: train, or resume.  Test: tests/robustness/test_cli.py::test_ppo"""
    of_gym = any(a.split("=")[0] == "--gym" for a in argv)
    opt = cli(with_defaults_of_cleanrl(Options) if of_gym else Options, argv, "ppo.py", __doc__)
    opt, given = replace(opt, out=opt.out or f"runs/{Path(opt.gym or opt.character).stem}"), given_flags(argv)
    if not opt.ship and given & {"blend", "share", "gain"}:
        raise UserError("--blend, --share and --gain are of --ship FILE.npz: give it, or leave them out")
    if not opt.blend and "share" in given:
        raise UserError("--share is of --blend A,B,…: give it, or leave it out")
    if opt.ship:
        meta = ship(opt.out, opt.ship, opt.blend, opt.share, opt.gain)
        mixed = f", {1 - opt.share:g} of it and {opt.share:g} of {', '.join(opt.blend)}" if opt.blend else ""
        print(f"{opt.ship}: {fmt_count(meta['steps'])} steps on {meta['options']['motion']}{mixed}; {meta['licence']}")
        return
    if opt.resume:
        opt = resumed_options(opt, argv)
    elif opt.init:  # as wide as what it begins from, unless told otherwise
        policy, _ = load_policy(opt.init)
        opt = replace(opt, **{k: getattr(policy, k) for k in ("hidden", "value_hidden") if k not in given})
    train(opt)


if __name__ == "__main__":
    run_main(main)

"""PPO: Appendix B's formulas against slow loops and torch; the loop's bookkeeping; exact resume."""

import itertools
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.stats import norm

import character
import ppo
from character import CHARACTERS, TERMS
from env import Env, Uniform
from mocap import data
from nn import gaussian_logp
from plumbing import training
from plumbing.cli import UserError
from plumbing.runs import CHECKPOINT, CONFIG, METRICS, load_checkpoint, read_config, read_metrics, save_checkpoint
from policy import Policy, load_policy
from ppo import Options, Trainer

ROOT = Path(__file__).resolve().parent.parent
TIMES = ("steps_per_s", "collect_s", "update_s")
TINY = "--recipe none --clips *stand* --envs 8 --horizon 8 --minibatch 32".split()
TINY += "--hidden 12 --value-hidden 10,8 --threads 1".split()


def tiny(**changes):
    small = dict(envs=6, horizon=8, minibatch=16, hidden=(12,), value_hidden=(10, 8), threads=1)
    return Options(**small | changes)


def trainer_of(char, ref, episode=500, **changes):
    opt = tiny(**changes)
    asymmetric = "asymmetric" not in opt.without
    trainer = Trainer(opt, Env(char, ref, opt.envs, opt.seed, opt.threads, episode, asymmetric=asymmetric))
    trainer.start()
    return trainer


# ------------------------------------------------------------------------------------ Appendix B


def rollout(rng, t=9, n=7):
    """Random rewards, values and ends; next_value as the loop makes it: the state before any reset."""
    reward, value = rng.standard_normal((2, t, n))
    terminated, truncated = rng.random((t, n)) < 0.15, rng.random((t, n)) < 0.2
    truncated &= ~terminated
    last, final = rng.standard_normal(n), rng.standard_normal((t, n))
    next_value = np.where(truncated, final, np.append(value[1:], last[None], 0))
    next_value[terminated] = 0.0
    return reward, value, next_value, terminated, truncated


def test_gae_against_slow_loop():
    rng = np.random.default_rng(0)
    reward, value, next_value, terminated, truncated = rollout(rng, 40, 5)
    assert terminated.any() and truncated.any()
    gamma, lam = 0.9, 0.8
    advantage, target = ppo.gae(reward, value, next_value, terminated | truncated, gamma, lam)
    for n in range(5):
        for t in range(40):
            expected = 0.0  # A_t = Σ_k (γλ)^k δ_{t+k}, to the episode's end or the trajectory's
            for k in range(40 - t):
                s = t + k
                bootstrap = 0.0 if terminated[s, n] else next_value[s, n]
                expected += (gamma * lam) ** k * (reward[s, n] + gamma * bootstrap - value[s, n])
                if terminated[s, n] or truncated[s, n]:
                    break
            assert advantage[t, n] == pytest.approx(expected, rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(target, advantage + value)
    # The value of the state after a reset (the next row) must not matter where an episode ended.
    done = terminated | truncated
    t, n = np.argwhere(done[:-1])[0]
    other = value.copy()
    other[t + 1, n] += 100.0
    changed, _ = ppo.gae(reward, other, next_value, done, gamma, lam)
    np.testing.assert_array_equal(changed[: t + 1, n], advantage[: t + 1, n])
    with pytest.raises(ValueError, match=r"done \(4, 5\)"):
        ppo.gae(reward, value, next_value, done[:4], gamma, lam)


def test_lambda_one_is_appendix_b():
    """V(o_t) = r_t + γ V(o_{t+1}), V(o_T) = r_T + γ V_old(o_{T+1}); A = V − V_old."""
    rng = np.random.default_rng(1)
    reward, value, next_value, terminated, truncated = rollout(rng)
    done = terminated | truncated
    advantage, target = ppo.gae(reward, value, next_value, done, 0.95, 1.0)
    for n in range(reward.shape[1]):
        v = None
        for t in reversed(range(len(reward))):
            end = v is None or done[t, n]
            v = reward[t, n] + 0.95 * (next_value[t, n] if end else v)
            assert target[t, n] == pytest.approx(v, rel=1e-12, abs=1e-12)
            assert advantage[t, n] == pytest.approx(v - value[t, n], rel=1e-12, abs=1e-12)


def surrogate_batch(rng, rows=40, eps=0.2):
    """log-probabilities and advantages on both sides of both clip limits, 1e-2 away from every kink."""
    ratio = rng.uniform(0.5, 1.6, rows)
    for limit in (1 - eps, 1 + eps):
        near = np.abs(ratio - limit) < 0.01
        ratio[near] = limit + 0.05
    adv = rng.uniform(0.1, 2.0, rows) * np.where(np.arange(rows) % 2, 1.0, -1.0)
    logp_old = rng.normal(-3.0, 2.0, rows)
    for side, sign in itertools.product((ratio < 1 - eps, ratio > 1 + eps, np.abs(ratio - 1) < eps), (1, -1)):
        assert (side & (adv * sign > 0)).any()
    return logp_old + np.log(ratio), logp_old, adv


def test_clipped_surrogate():
    eps = 0.2
    logp, logp_old, adv = surrogate_batch(np.random.default_rng(2))
    loss, dlogp, ratio = ppo.clipped_surrogate(logp, logp_old, adv, eps)
    total = 0.0
    for i in range(len(adv)):
        r = np.exp(logp[i] - logp_old[i])
        held = min(max(r, 1 - eps), 1 + eps)
        total += min(r * adv[i], held * adv[i])
        # the four corners: no gradient once the ratio has moved far enough in the direction that the advantage wants
        stopped = (adv[i] > 0 and r > 1 + eps) or (adv[i] < 0 and r < 1 - eps)
        assert dlogp[i] == pytest.approx(0.0 if stopped else -r * adv[i] / len(adv), rel=1e-12)
        assert ratio[i] == pytest.approx(r)
    assert loss == pytest.approx(-total / len(adv), rel=1e-12)
    f32 = [v.astype(np.float32) for v in (logp, logp_old, adv)]
    assert ppo.clipped_surrogate(*f32, eps)[1].dtype == np.float32
    with pytest.raises(ValueError, match=r"adv \(3,\)"):
        ppo.clipped_surrogate(logp, logp_old, adv[:3], eps)
    for wrong in (0.0, 1.0, -0.1, np.nan):
        with pytest.raises(ValueError, match="eps"):
            ppo.clipped_surrogate(logp, logp_old, adv, wrong)


def test_standardise():
    x = np.random.default_rng(3).normal(5.0, 3.0, (20, 4))
    y = ppo.standardise(x)
    assert abs(y.mean()) < 1e-12 and abs(y.std() - 1.0) < 1e-8
    np.testing.assert_allclose(np.argsort(y, axis=None), np.argsort(x, axis=None))
    np.testing.assert_array_equal(ppo.standardise(np.full(5, 2.0)), 0.0)  # no spread: no advantage, and no NaN


def test_explained_variance():
    y = np.random.default_rng(3).standard_normal(50)
    assert ppo.explained_variance(y, y) == 1.0
    assert ppo.explained_variance(np.full(50, 3.0), y) == pytest.approx(0.0)
    assert ppo.explained_variance(-y, y) == pytest.approx(-3.0)
    assert ppo.explained_variance(y, np.ones(50)) == 0.0


def kink_distance(mlp, x):
    """How near any hidden unit is to the rectifier's kink."""
    h, nearest = x, np.inf
    for i in range(mlp.n_layers - 1):
        z = h @ mlp.params[f"W{i}"] + mlp.params[f"b{i}"]
        nearest, h = min(nearest, np.abs(z).min()), np.where(z > 0, z, 0.01 * z)
    return nearest


def policy_batch(rows=24):
    """A float64 policy and a batch away from every kink: both signs of advantage on both clip sides."""
    for seed in itertools.count():
        rng = np.random.default_rng(seed)
        policy = Policy(5, 8, 3, (7, 6), (6, 5), 0.4, 3.0, rng, dtype=np.float64)
        policy.theta_pi += 0.3 * rng.standard_normal(policy.theta_pi.size)  # biases and log σ differ, too
        policy.critic.theta += 0.3 * rng.standard_normal(policy.critic.theta.size)
        x = rng.standard_normal((rows, 8))
        action = policy.actor(x[:, :5]) + np.exp(policy.log_std) * rng.standard_normal((rows, 3))
        shift = rng.normal(0.0, 0.3, rows)
        logp_old = gaussian_logp(action, policy.actor(x[:, :5]), policy.log_std) - shift
        adv = rng.standard_normal(rows)
        ratio = np.exp(shift)
        margin = np.abs(ratio[:, None] - [0.8, 1.2]).min()
        sides = [((ratio < 0.8) & (adv < 0)).any(), ((ratio > 1.2) & (adv > 0)).any()]
        near = min(kink_distance(policy.actor, x[:, :5]), kink_distance(policy.critic, x))
        if margin > 0.005 and near > 0.002 and all(sides):
            return policy, x, action, logp_old, adv, rng.standard_normal(rows)


def test_policy_loss():
    """By SciPy's densities; the gradient is laid out as θ, with that of log σ at its end."""
    policy, x, action, logp_old, adv, _ = policy_batch()
    loss, gradient, out = ppo.policy_loss(policy, x[:, :5], action, logp_old, adv, 0.2)
    mu = policy.actor(x[:, :5])
    ratio = np.exp(norm.logpdf(action, mu, np.exp(policy.log_std)).sum(1) - logp_old)
    slow = -np.mean([min(r * a, np.clip(r, 0.8, 1.2) * a) for r, a in zip(ratio, adv, strict=True)])
    assert loss == pytest.approx(slow) and gradient.shape == policy.theta_pi.shape and np.all(gradient[-3:] != 0)
    np.testing.assert_array_equal(out["mu"], mu)
    np.testing.assert_allclose(out["ratio"], ratio)


def test_policy_loss_gradient_against_torch():
    torch = pytest.importorskip("torch", reason="torch (extra torch) is compared with")
    policy, x, action, logp_old, adv, _ = policy_batch()
    gradient, theta = ppo.policy_loss(policy, x[:, :5], action, logp_old, adv, 0.2)[1], policy.theta_pi.copy()
    t = torch.tensor(theta, requires_grad=True)
    p = dict(zip(policy.actor.shapes, torch.split(t[:-3], [int(np.prod(s)) for s in policy.actor.shapes.values()])))
    h = torch.tensor(x[:, :5])
    for i in range(3):
        h = h @ p[f"W{i}"].reshape(policy.actor.shapes[f"W{i}"]) + p[f"b{i}"]
        h = torch.nn.functional.leaky_relu(h, 0.01) if i < 2 else h
    pi = torch.distributions.Normal(h, torch.exp(t[-3:]))
    rho = torch.exp(pi.log_prob(torch.tensor(action)).sum(-1) - torch.tensor(logp_old))
    a = torch.tensor(adv)
    (-torch.min(rho * a, torch.clamp(rho, 0.8, 1.2) * a).mean()).backward()
    np.testing.assert_allclose(gradient, t.grad.numpy(), rtol=1e-9, atol=1e-12)


def test_critic_loss():
    policy, x, *_, target = policy_batch()
    slow = sum((policy.critic(x[i : i + 1])[0, 0] - target[i]) ** 2 for i in range(len(x))) / (2 * len(x))
    assert ppo.critic_loss(policy, x, target)[0] == pytest.approx(slow, rel=1e-12)
    np.testing.assert_allclose(policy.value(x, rows=7), 3.0 * policy.critic(x)[:, 0])  # value_scale; in pieces


# ------------------------------------------------------------------------------------ what is collected


def test_stored_action_is_unclipped(char, ref):
    """The physics gets the clipped action; the ratio is of what the policy drew."""
    t = trainer_of(char, ref, sigma=1.5)
    given = []
    step = t.env.step
    t.env.step = lambda a: (given.append(a.copy()), step(a))[1]
    t.collect()
    assert (np.abs(t.action) > 1).mean() > 0.3
    np.testing.assert_array_equal(np.stack(given), t.action)
    assert np.abs(t.env.ctrl).max() == 1.0 and np.abs(t.env.action).max() <= 1.0
    sigma = np.exp(t.policy.log_std)
    mu = t.policy.actor(t.x.reshape(-1, t.env.critic_size)[:, : t.env.obs_size]).reshape(t.mu.shape)
    np.testing.assert_allclose(t.mu, mu, atol=1e-6)
    expected = norm.logpdf(t.action.astype(float), t.mu.astype(float), sigma.astype(float)).sum(-1)
    np.testing.assert_allclose(t.logp, expected, rtol=1e-5)
    clipped = norm.logpdf(np.clip(t.action, -1, 1), t.mu, sigma).sum(-1)
    assert np.abs(clipped - t.logp).max() > 1.0  # the test can tell them apart
    loss, _, out = ppo.policy_loss(t.policy, t.x[0][:, : t.env.obs_size], t.action[0], t.logp[0], t.reward[0], 0.2)
    np.testing.assert_allclose(out["ratio"], 1.0, atol=1e-4)  # nothing was updated yet


def test_bootstrap_is_before_the_reset(char, ref):
    """Truncation: V of the observation before the reset.  Failure: 0.  Otherwise V(o_{t+1})."""
    t = trainer_of(char, ref, episode=3)
    twin = Env(char, ref, t.env.n, t.opt.seed, 1, 3)
    twin.reset(t.opt.seed)
    for each in (t.env, twin):  # one character starts too far from its target, and fails in its first step
        each.qpos[2, 0] += 1.0
    t.collect()
    value = lambda full: t.policy.value(t.policy.norm.normalise(full))  # noqa: E731
    terminated, truncated, moved = 0, 0, 0
    for k in range(t.opt.horizon):
        _, reward, term, trunc, info = twin.step(t.action[k])
        np.testing.assert_array_equal(reward, t.reward[k])
        after = value(twin.full)
        expected = after.copy()
        if trunc.any():
            expected[trunc] = value(info["final_critic"])[trunc]
            moved += np.sum(np.abs(expected - after)[trunc] > 1e-3)
        expected[term] = 0.0
        np.testing.assert_allclose(t.next_value[k], expected, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(t.terminated[k], term)
        np.testing.assert_array_equal(t.truncated[k], trunc)
        terminated, truncated = terminated + term.sum(), truncated + trunc.sum()
    assert t.terminated[0, 2] and t.next_value[0, 2] == 0.0 and terminated >= 1
    assert truncated >= 10 and moved > truncated // 2  # the reset's value would have been another
    assert t.reward[0, 2] < t.reward[0, [0, 1, 3, 4, 5]].min() - 4.0  # the −5


def test_non_finite_state_does_not_reach_the_networks(char, ref, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the current folder
    t = trainer_of(char, ref)
    step, calls = t.env.step, itertools.count()

    def poisoned(a):
        if next(calls) == 2:
            t.env.qvel[1], t.env.qpos[4, 9] = 1e300, np.nan
        return step(a)

    t.env.step = poisoned
    stats = t.collect()
    t.update()
    assert stats["end_bad"] == 2 and t.terminated[2, [1, 4]].all()
    arrays = t.policy.arrays() | {"x": t.x, "r": t.reward, "v": t.next_value, "full": t.env.full, "m": t.adam_pi.m}
    for name, array in arrays.items():
        assert np.isfinite(array).all(), name
    t.collect(), t.update()


def test_what_an_update_is_made_of(char, ref, monkeypatch):
    """Advantages end with the episodes and are standardised; samples are drawn anew in each epoch; KL(old ‖ new)."""
    t, seen = trainer_of(char, ref, episode=3, epochs=2, target_kl=10.0), {}
    t.collect()
    assert t.truncated.any()

    def spy(name, f):
        def spied(*a):
            seen.setdefault(name, []).append([v.copy() if isinstance(v, np.ndarray) else v for v in a])
            return f(*a)

        return spied

    for name in ("gae", "policy_loss", "gaussian_kl"):
        monkeypatch.setattr(ppo, name, spy(name, getattr(ppo, name)))
    old, batches = t.policy.log_std.copy(), t.reward.size // t.opt.minibatch
    t.update()
    [(_, _, _, done, gamma, lam)] = seen["gae"]
    np.testing.assert_array_equal(done, t.terminated | t.truncated)
    assert (gamma, lam) == (t.opt.gamma, t.opt.lam)
    given = [np.concatenate([call[k] for call in seen["policy_loss"]]) for k in (2, 4)]
    (first, second), (advantage, _) = (np.split(v, 2) for v in given)
    assert abs(advantage.mean()) < 1e-5 and abs(advantage.std() - 1) < 1e-4
    flat = t.action.reshape(-1, t.env.action_size)
    assert (first != flat).any() and (first != second).any()
    np.testing.assert_array_equal(np.sort(first, axis=0), np.sort(flat, axis=0))
    assert len(seen["gaussian_kl"]) == 2 * batches and any((std != old).any() for *_, std in seen["gaussian_kl"])
    for _, std, *_ in seen["gaussian_kl"]:
        np.testing.assert_array_equal(std, old)


def test_epochs_and_rate_follow_kl(char, ref):
    """Beyond twice the target the epoch is the last; within 1.3 of it the rate stays as it is."""
    kl = {}
    for lr in (1e-2, 2e-3):
        once = trainer_of(char, ref, epochs=1, lr=lr)
        once.collect()
        kl[lr] = once.update()["kl"]
    for target, epochs in ((kl[1e-2] / 3, 1), (kl[1e-2], 2)):
        t = trainer_of(char, ref, epochs=2, lr=1e-2, target_kl=target)
        t.collect(), t.update()
        assert t.adam_pi.t == epochs * 3
    t = trainer_of(char, ref, epochs=1, lr=2e-3, target_kl=kl[2e-3])
    t.collect(), t.update()
    assert t.adam_pi.lr == 2e-3


def test_time_to_failure(char, ref):
    t = trainer_of(char, ref, envs=32, horizon=30)
    stats = t.collect()
    assert t.terminated.any() and stats["time_to_failure"] == pytest.approx(32 * 30 / 30 / t.terminated.sum())


def test_survival():
    """Steps lived, and the share of those to be lived, of the episodes that ended: counted by hand."""
    t = Trainer(tiny(envs=40, horizon=30, sigma=1.0), Reach(40))
    t.start()
    stats, lengths, lived = t.collect(), [], np.zeros(40)
    for ended in t.terminated | t.truncated:
        lived += 1
        lengths += lived[ended].tolist()
        lived[ended] = 0
    assert stats["episodes"] == len(lengths) > stats["failures"] > 0
    assert stats["length"] == pytest.approx(np.mean(lengths))
    assert stats["survival"] == pytest.approx(np.mean(lengths) / 12)  # twelve could be lived


def test_update_improves_both_losses(char, ref):
    t = trainer_of(char, ref, envs=16, horizon=16, minibatch=64, epochs=5)
    t.collect()
    done = t.terminated | t.truncated
    advantage, target = ppo.gae(t.reward, t.old_value, t.next_value, done, t.opt.gamma, t.opt.lam)
    flat = lambda v: v.reshape(-1, *v.shape[2:])  # noqa: E731
    adv = ppo.standardise(advantage).ravel().astype(np.float32)
    x, goal = flat(t.x), (target / t.policy.value_scale).ravel()

    def losses():
        args = (x[:, : t.env.obs_size], flat(t.action), flat(t.logp), adv, 0.2)
        return ppo.policy_loss(t.policy, *args)[0], ppo.critic_loss(t.policy, x, goal)[0]

    before = losses()
    assert before[0] == pytest.approx(0.0, abs=1e-4)  # the ratio is 1, the mean of Â is 0
    raw, count = t.raw.copy(), t.policy.norm.count
    stats = t.update()
    unexplained = np.mean((advantage - advantage.mean()) ** 2) / np.mean((target - target.mean()) ** 2)
    assert stats["explained_variance"] == pytest.approx(1.0 - unexplained)
    after = losses()
    assert after[0] < -0.05 and after[1] < 0.7 * before[1]
    assert 0 < stats["kl"] and 0 <= stats["clip_fraction"] < 0.9
    assert t.policy.norm.count == count + raw.shape[0] * raw.shape[1]  # then, and only then, the normaliser learns


def test_rate_follows_kl_and_sigma_has_a_floor(char, ref):
    t = trainer_of(char, ref, target_kl=1e-6, lr=1e-2, sigma=0.06, min_sigma=0.059)
    t.collect(), t.update()
    assert t.adam_pi.lr == pytest.approx(1e-2 / 1.2)
    assert t.policy.log_std.min() >= np.float32(np.log(0.059))
    t = trainer_of(char, ref, target_kl=10.0)
    t.collect(), t.update()
    assert t.adam_pi.lr == pytest.approx(1e-4 * 1.2)


def test_gradients_are_clipped(char, ref, monkeypatch):
    """Actor's and critic's: where next to no gradient is let through, neither moves."""
    moved = []
    for most in (ppo.MAX_GRAD_NORM, 1e-12):  # far below what Adam divides by at least
        monkeypatch.setattr(ppo, "MAX_GRAD_NORM", most)
        t = trainer_of(char, ref)
        t.collect()
        before = t.policy.arrays()
        t.update()
        after = t.policy.arrays()
        moved.append([np.abs(after[name] - before[name]).max() for name in ("policy.pi", "policy.critic")])
    (actor, critic), (held_actor, held_critic) = moved
    assert held_actor < 0.01 * actor and held_critic < 0.01 * critic


# ------------------------------------------------------------------------------------ learning


class Reach:
    """Points on a line, with the interface of Env: go to the target and stay; |x| > 2 fails, 12 steps truncate."""

    ENDS, TERMS, name = Env.ENDS, Env.TERMS, "reach"
    obs_size, critic_size, action_size, dt = 2, 3, 1, 0.1

    def value_scale(self, gamma):
        return 1.0 / (1.0 - gamma)

    def __init__(self, n):
        self.n, self.full = n, np.zeros((n, 3), np.float32)
        self.x, self.target, self.steps = np.zeros(n), np.zeros(n), np.zeros(n, int)

    def reset(self, seed):
        self.rng = np.random.default_rng(seed)
        self._reset(np.arange(self.n))

    def _reset(self, ids):
        self.x[ids], self.target[ids] = self.rng.uniform(-1.5, 1.5, (2, len(ids)))
        self.steps[ids] = 0
        self._observe()

    def _observe(self):
        self.full[:] = np.stack([self.x, self.target, self.steps], 1)

    def step(self, action):
        self.x += 0.3 * np.clip(action[:, 0], -1, 1)
        self.steps += 1
        terminated = np.abs(self.x) > 2.0
        truncated = (self.steps >= 12) & ~terminated
        near = np.exp(-4.0 * (self.x - self.target) ** 2)
        self._observe()
        info = {"final_critic": self.full.copy(), "length": self.steps.copy(), "available": np.full(self.n, 12)}
        info["terms"] = {k: near * (k == "q") for k in TERMS}
        none = np.zeros(self.n, bool)
        info["ends"] = dict(fall=none, far=terminated, bad=none, time=truncated, clip=none)
        self._reset(np.flatnonzero(terminated | truncated))
        return self.full[:, :2], near + np.where(terminated, -5.0, 0.0), terminated, truncated, info


def test_learns():
    """The whole loop learns a small task that needs looking ahead: a wrong sign anywhere fails here."""
    small = dict(envs=64, horizon=12, minibatch=256, hidden=(16,), value_hidden=(16,))
    opt = Options(**small, sigma=0.5, gamma=0.9, lr=1e-3, value_lr=3e-3)
    trainer = Trainer(opt, Reach(64))
    trainer.start()
    history = [trainer.collect() | trainer.update() for _ in range(40)]
    rewards = [s["reward"] for s in history]
    assert np.mean(rewards[:3]) < 0.35 and np.mean(rewards[-5:]) > 0.75
    assert np.mean([s["explained_variance"] for s in history[-5:]]) > 0.5
    assert history[-1]["end_far"] <= 2 and history[-1]["survival"] > 0.95


# ------------------------------------------------------------------------------------ checkpoints


def train(out, updates, *more):
    """Run (or resume) the command line in this process, to `updates` updates in all."""
    steps = [] if updates is None else ["--steps", str(64 * updates)]
    args = list(more) if "--resume" in more else [*TINY, *more]
    ppo.main([*args, "--out", str(out), *steps])
    return load_checkpoint(Path(out) / CHECKPOINT)


def assert_same_run(a, b):
    (arrays_a, meta_a), (arrays_b, meta_b) = (load_checkpoint(Path(d) / CHECKPOINT) for d in (a, b))
    assert set(arrays_a) == set(arrays_b)
    for name in arrays_a:
        np.testing.assert_array_equal(arrays_a[name], arrays_b[name], err_msg=name)
    for name in ("steps", "updates", "lr", "rng", "env", "policy", "rows", "data"):
        assert meta_a[name] == meta_b[name], name
    ours, theirs = (read_metrics(Path(d) / METRICS) for d in (a, b))
    assert list(ours) == list(theirs)
    for name in set(ours) - set(TIMES):
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Six updates without a break."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    train(out, 6)
    return out


def test_resume_is_exact(whole, tmp_path):
    train(tmp_path / "a", 3)
    _, meta = train(tmp_path / "a", 6, "--resume")
    assert meta["updates"] == 6 and meta["steps"] == 6 * 64 and meta["rows"] == 6
    assert_same_run(whole, tmp_path / "a")
    metrics = read_metrics(whole / METRICS)
    assert sum(metrics[f"end_{e}"].sum() for e in Env.ENDS) > 0  # episodes ended, so resets were continued, too
    assert metrics["steps"].tolist() == [64 * k for k in range(1, 7)]


def test_seeds(char, ref):
    """Two seeds begin in other states, with other networks and noise; the same seed does not."""
    begun = []
    for seed in (3, 3, 4):
        t = trainer_of(char, ref, seed=seed)
        begun.append((t.env.qpos.copy(), t.policy.theta_pi, t.rng.random(9)))
    for one, again, other in zip(*begun, strict=True):
        np.testing.assert_array_equal(one, again)
        assert (one != other).any()


def test_second_thread_changes_nothing(char, ref):
    """Actor and critic learn the same side by side as one after the other; so do the characters."""
    one, two = (trainer_of(char, ref, envs=128, horizon=40, minibatch=1024, threads=n) for n in (1, 2))
    assert two.two and not one.two
    for t in (one, two):
        before = t.policy.critic.theta.copy(), t.policy.norm.count
        for _ in range(2):
            stats = t.collect()
            losses = t.update()
        assert not np.array_equal(t.policy.critic.theta, before[0]) and np.isfinite(losses["value_loss"])
        assert t.policy.norm.count == before[1] + 2 * 40 * 128
        assert stats["end_far"] + stats["end_fall"] == t.terminated.sum() > 0
    for name, value in one.policy.arrays().items():
        np.testing.assert_array_equal(value, two.policy.arrays()[name], err_msg=name)
    for name in ("raw", "action", "reward", "next_value", "truncated"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
    with pytest.raises(ZeroDivisionError):
        ppo.aside(lambda: 1 / 0)()


def test_resume_refuses_other_options(whole, tmp_path, monkeypatch):
    before = {p: p.read_bytes() for p in whole.iterdir()}
    for flag, value in (("--lr", "1e-3"), ("--hidden", "64"), ("--seed", "1"), ("--clips", "*walk*"), ("--envs", "4")):
        with pytest.raises(UserError, match=f"was started with {flag} "):
            train(whole, None, "--resume", flag, value)
    with pytest.raises(UserError, match="holds no run|cannot read"):
        train(tmp_path / "none", 6, "--resume")
    with pytest.raises(UserError, match="already holds a run"):
        train(whole, 6)
    original = data.builtin_clips
    monkeypatch.setattr(data, "builtin_clips", lambda rate, name: original(rate, seed=1))
    with pytest.raises(UserError, match="motions have changed.*--init"):
        train(whole, 8, "--resume")
    assert before == {p: p.read_bytes() for p in whole.iterdir()}  # refused: untouched


def test_resume_refuses_other_tables(tmp_path, capsys):
    """A weight that was changed in the TOML is the ablation of a new run, not of the one that goes on."""
    own = tmp_path / "mine.toml"
    shutil.copy(CHARACTERS / "dino.xml", tmp_path)
    shutil.copy(CHARACTERS / "dino.toml", own)
    train(tmp_path / "a", 1, "--character", str(own))
    kept = read_config(tmp_path / "a")["config"]["data"]["tables"]
    assert kept["reward"]["orientation"] == character.load("dino").spec["reward"]["orientation"]
    as_it_was = own.read_text()
    changed = re.sub(r"(?m)^orientation *= *\[[^,]*", "orientation = [0", as_it_was)
    assert changed != as_it_was
    own.write_text(changed)
    before = {p: p.read_bytes() for p in (tmp_path / "a").iterdir()}
    with pytest.raises(UserError, match=r"\[reward\] of the character's TOML changed.*--init"):
        train(tmp_path / "a", 2, "--resume")
    assert before == {p: p.read_bytes() for p in (tmp_path / "a").iterdir()}  # refused: untouched
    own.write_text(as_it_was)
    body = (tmp_path / "dino.xml").read_text()
    for pattern, other, name in (
        (r"mass=\"13\"", 'mass="14"', "body_mass"),
        (r"friction=\"[\d. ]+\"", 'friction="0.2"', "geom_friction"),
        (r"(<site name=\"headset\" pos=\")[\d.]+", r"\g<1>0.5", "site_pos"),
        (r"<worldbody>", '<option gravity="0 0 -1.62"/><worldbody>', "gravity"),
    ):
        changed = re.sub(pattern, other, body, count=1)
        assert changed != body
        (tmp_path / "dino.xml").write_text(changed)
        with pytest.raises(UserError, match=rf"{name}.* of the character's model.*--init"):
            train(tmp_path / "a", 2, "--resume")
    (tmp_path / "dino.xml").write_text(body + "<!-- a comment is no change -->")
    assert before == {p: p.read_bytes() for p in (tmp_path / "a").iterdir()}
    own.write_text(re.sub(r"(?m)^lr *= .*", "lr = 1e-6", as_it_was))  # the recipe is read once, when a run begins
    train(tmp_path / "a", 2, "--resume")
    capsys.readouterr()
    training.with_a_note(Options(character=str(own), recipe="none"))
    assert not capsys.readouterr().out
    training.with_a_note(Options(character=str(own), lr=5e-5))
    assert "not by today's [training] of mine.toml: " in (told := capsys.readouterr().out)
    assert "lr 5e-05 (recipe: 1e-06)" in told
    training.with_a_note(Options(character=str(own), lr=5e-5, init="x", hidden=(7,)))  # its widths are --init's
    assert "lr 5e-05 (recipe: 1e-06)" in (told := capsys.readouterr().out) and "hidden" not in told


def test_resume_accepts_what_changes_nothing(whole, tmp_path):
    """The same value given again and other threads do not make it another run."""
    train(tmp_path / "a", 2)
    same = ["--lr", "1e-4", "--hidden", "12", "--threads", "2"]
    train(tmp_path / "a", 6, "--resume", *same)
    assert_same_run(whole, tmp_path / "a")


def test_resume_before_the_first_checkpoint(whole, tmp_path):
    out = tmp_path / "a"
    train(out, 2, "--init", str(whole))
    start = load_checkpoint(out / CHECKPOINT)
    for path in (*out.glob("*.npz"), out / METRICS):
        path.unlink()
    resumed = train(out, 2, "--resume")  # from --init again, not from nothing
    for name in start[0]:
        np.testing.assert_array_equal(start[0][name], resumed[0][name], err_msg=name)


def test_resume_refuses_a_foreign_checkpoint(whole, tmp_path):
    train(tmp_path / "a", 1)
    arrays, meta = load_checkpoint(whole / CHECKPOINT)
    path = tmp_path / "a" / CHECKPOINT
    for change in ({k: v for k, v in arrays.items() if "adam" not in k}, arrays | {"env.frame": np.zeros(3, int)}):
        save_checkpoint(path, change, meta)
        path.with_suffix(".prev.npz").unlink()  # a damaged one would be replaced by the one before
        with pytest.raises(UserError, match="does not fit|no array"):
            train(tmp_path / "a", 2, "--resume")


def test_init_fine_tunes(whole, tmp_path, monkeypatch):
    seen = []
    start = Trainer.start
    monkeypatch.setattr(Trainer, "start", lambda self: (start(self), seen.append(self.policy.arrays())))
    _, meta = train(tmp_path / "a", 1, "--init", str(whole), "--seed", "5")
    saved, _ = load_checkpoint(whole / CHECKPOINT)
    for name, value in seen[0].items():  # weights, σ and normaliser
        np.testing.assert_array_equal(value, saved[name], err_msg=name)
    assert meta["updates"] == 1 and meta["steps"] == 64
    arrays, meta = train(tmp_path / "c", 1, "--init", str(whole), "--gamma", "0.9", "--min-sigma", "0.2")
    (weights, log_std), (before, _) = (np.split(a["policy.pi"], [-33]) for a in (seen[1], saved))
    np.testing.assert_array_equal(weights, before)
    np.testing.assert_allclose(np.exp(log_std), 0.2, rtol=1e-6)  # it was 0.135, below this run's least
    weight = sum(w for w, _ in (character.load("jesse").reward[t] for t in TERMS))
    assert meta["policy"]["value_scale"] == pytest.approx(10 * weight)  # the largest return by this γ, not by 0.97
    assert arrays["policy.norm.count"] == saved["policy.norm.count"] + 64  # the normaliser goes on learning
    for flag, name in (("--hidden", r"hidden \(12,\), not \(9,\)"), ("--value-hidden", r"value_hidden \(10, 8\), not")):
        with pytest.raises(UserError, match=f"does not fit jesse: {name}.*extras.policies carry .* --character jesse"):
            train(tmp_path / "b", 1, "--init", str(whole), flag, "9")
    policy = Policy(7, 9, 2, (4,), (4,), 0.1, 1.0, np.random.default_rng(0))
    save_checkpoint(tmp_path / "other.npz", policy.arrays(), {"policy": policy.shape()})
    with pytest.raises(UserError, match="obs_size 7, not 189; .*action_size 2, not 33; .*policies carry"):
        train(tmp_path / "b", 1, "--init", str(tmp_path / "other.npz"), "--hidden", "4", "--value-hidden", "4")
    with pytest.raises(UserError, match="no checkpoint"):
        train(tmp_path / "b", 1, "--init", str(tmp_path / "missing.npz"))
    assert not (tmp_path / "b").exists()


def test_init_says_what_differs(whole, tmp_path, capsys):
    """A run that goes on from a policy says by which flags it was trained otherwise, and that it is shown ahead."""
    train(tmp_path / "a", 1, "--init", str(whole))
    assert "note: " not in capsys.readouterr().out
    arrays, meta = load_checkpoint(whole / CHECKPOINT)
    meta |= {"reward": ["reward.x=[2.0,24.0]"], "damping": 0.025}
    meta["options"] |= {"gamma": 0.99, "root_limit": 0.9}  # ppo.py alone has no --root-limit
    save_checkpoint(tmp_path / "b.npz", arrays, meta)
    train(tmp_path / "c", 1, "--init", str(tmp_path / "b.npz"))
    [note] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert 'was trained with --gamma 0.99 --set "reward.x=[2.0,24.0]", which this run has not; is shown' in note
    assert "ship IN OUT --damping -0.025" in note and "--root" not in note
    train(tmp_path / "d", 1, "--init", str(tmp_path / "b.npz"), "--gamma", "0.99", "--set", "reward.x=[2.0, 24.0]")
    assert "was trained with" not in capsys.readouterr().out


def test_init_brings_its_widths(whole, tmp_path):
    """Layers are as wide as those of --init where the command line does not say, whatever the recipe says."""
    small = [a for a in TINY if a not in ("--hidden", "12", "--value-hidden", "10,8")]
    ppo.main([*small, "--init", str(whole), "--steps", "64", "--out", str(tmp_path / "a")])
    policy, _ = load_policy(tmp_path / "a")
    assert (policy.hidden, policy.value_hidden) == ((12,), (10, 8))
    with pytest.raises(UserError, match=r"hidden \(12,\), not \(20,\)"):
        ppo.main([*small, "--init", str(whole), "--hidden", "20", "--steps", "64", "--out", str(tmp_path / "b")])


def test_init_points_to_carry(whole, tmp_path):
    """Another character, fewer sensors or a critic that sees less: one line with the command that makes it fit."""
    for more, says in (
        (("--character", "dino"), "does not fit dino: it is jesse's; this makes one that does"),
        (("--sensors", "hmd"), "obs_size 189, not 153; critic_size 459, not 423"),
        (("--without", "asymmetric"), "critic_size 459, not 189"),
    ):
        with pytest.raises(UserError, match=f"{says}.*python -m extras.policies carry {whole} NEW.npz") as error:
            train(tmp_path / "b", 1, "--init", str(whole), *more)
        assert "\n" not in str(error.value)
    assert not (tmp_path / "b").exists()


def test_line_of_progress(char, ref):
    t = trainer_of(char, ref, horizon=1)
    stats = t.collect() | dict.fromkeys(("steps_per_s", "kl", "clip_fraction", "explained_variance", "sigma"), 0.0)
    assert stats["failures"] == 0 and t.line(stats)["fails every"] == "never"
    assert t.line(stats | {"failures": 2, "time_to_failure": 1.5})["fails every"] == "1.50 s"


@pytest.mark.parametrize("recipe", ["none", "character"])
def test_out_is_checked_before_the_motion_is_read(recipe, tmp_path, monkeypatch):
    """A folder that holds a run, or that cannot be made, is said at once: a large data set takes minutes."""
    for name in ("load", "sequences"):
        monkeypatch.setattr(data, name, lambda *_, **__: pytest.fail("the motion was read first"))
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / CONFIG).write_text("{}")
    (tmp_path / "file").write_text("")
    cases = {"old": "already holds a run", "file": "cannot create", "file/run": "cannot create", "new": "no checkpoint"}
    for out, says in cases.items():
        more = ["--init", str(tmp_path / "nothing.npz")] if out == "new" else []
        with pytest.raises(UserError, match=says):
            ppo.main(["--character", "jesse", "--recipe", recipe, "--out", str(tmp_path / out), *more])
    assert not (tmp_path / "new").exists()  # nothing is made before the motion is read


def test_without_what_weighs_nothing(capsys):
    """Jesse's contact has weight 0: a note, on stderr; none where something is left out, or only the critic's part."""
    opt = Options(clips="*stand*", envs=2, threads=1)
    ppo.make_env(replace(opt, without=("contact", "action", "asymmetric")))
    err = capsys.readouterr().err
    assert err == "note: --without contact changes nothing: jesse's reward gives it no weight\n"
    ppo.make_env(replace(opt, character="oppy", without=("contact",)))
    assert "note" not in capsys.readouterr().err


def test_switches_reach_the_environment():
    """Each flag, and the variant of the character, in the environment that is trained."""
    opt = Options(clips="*stand*", envs=3, threads=1)
    plain = ppo.make_env(opt)
    env = ppo.make_env(replace(opt, without=("contact", "action", "asymmetric"), sensors="hmd", scale=0.9))
    assert {t for t in TERMS if env.char.reward[t][0] == 0} == {"contact", "action_diff", "action_min"}
    assert (env.devices, env.asymmetric, env.char.variant) == (1, False, {"scale": 0.9})
    assert (plain.devices, plain.asymmetric, plain.char.variant) == (3, True, {})
    assert type(plain.starts) is Uniform and plain.disturbance is None  # the paper's
    assert (plain.root_limit == 0.30).all()
    assert plain.char.model.opt.solver == mujoco.mjtSolver.mjSOL_PGS  # as loaded it is Newton's
    env = ppo.make_env(replace(opt, track="root", seed=1))
    assert env.rng.random() != plain.rng.random()
    assert env.char.reward["q"][0] == 0 < env.char.reward["x"][0] and env.ref.link_pos.shape[1] == 1
    for wrong in (["--without", "contact,gravity"], ["--track", "head"], ["--sensors", "none"]):
        with pytest.raises(SystemExit):
            ppo.main(["--recipe", "none", "--out", "nowhere", *wrong])


def test_sensors_reach_the_run(tmp_path):
    """§4.2: a run with the headset alone, resumed, and gone on from."""
    _, meta = train(tmp_path / "a", 1, "--sensors", "hmd")
    assert meta["options"]["sensors"] == "hmd" and meta["policy"]["obs_size"] == 153
    train(tmp_path / "a", 2, "--resume")
    _, meta = train(tmp_path / "b", 1, "--init", str(tmp_path / "a"), "--sensors", "hmd")
    assert meta["before"] == 128


def own_recipe(folder, text):
    """A Jesse with another [training].  -> path of its .toml"""
    before, _, after = (character.CHARACTERS / "jesse.toml").read_text().partition("[training]")
    (folder / "own.toml").write_text(f"{before}[training]\n{text}\n{after[after.index('# ---') :]}")
    shutil.copy(character.CHARACTERS / "jesse.xml", folder)
    return str(folder / "own.toml")


def recipe_options(*argv):
    return training.read_options(Options, list(argv), "ppo.py", "")


def test_recipe(tmp_path, monkeypatch, capsys):
    """The command line wins over the character's [training], that over the defaults; `by` says who trains."""
    monkeypatch.chdir(tmp_path)
    ours = own_recipe(tmp_path, "sigma = 0.06\nlr = 2e-5\nhidden = [24, 12]\nhorizon = 4\ntarget_kl = 1")
    opt = recipe_options("--character", ours, "--lr", "1e-3")
    assert (opt.sigma, opt.lr, opt.hidden, opt.horizon, opt.target_kl) == (0.06, 1e-3, (24, 12), 4, 1)
    assert (opt.min_sigma, opt.value_hidden, opt.out) == (0.05, (256, 128), "runs/own")
    capsys.readouterr()
    changed = recipe_options("--character", ours, "--set", "training.sigma=0.2")
    assert "recipe, [training] of own.toml: " in (told := capsys.readouterr().out) and "sigma 0.2" in told
    assert changed.sigma == 0.2 and changed.horizon == 4
    plain = recipe_options("--character", ours, "--recipe", "none")
    assert replace(plain, character="jesse", recipe="character") == Options(out="runs/own")
    with pytest.raises(UserError, match=r'jesse.toml: \[training\] balance, .*retry, .*by = "extras.train"'):
        recipe_options("--character", "jesse")
    with pytest.raises(SystemExit):
        recipe_options("--recipe", "mine")
    by = lambda *argv: training.trained_by(character.Switches, argv, "ppo")  # noqa: E731
    assert by() == by("--character=dino", "--horizon", "9") == "extras.train"
    assert by("--recipe", "none") == by("--character", ours) == by("--help") == "ppo"
    with pytest.raises(UserError, match="no character 'jessy'"):
        by("--character", "jessy")
    assert training.value_of(["--out", "a", "--out=b", "--x"], "out") == "b"
    assert training.value_of(["--out"], "out") is training.value_of([], "out") is None
    assert training.given_names(["--no-balance", "--lr=1", "x", "--norm-x"]) == {"balance", "lr", "norm_x"}
    run = recipe_options(*TINY, "--sigma", "0.3")
    t = Trainer(run, ppo.make_env(run))
    np.testing.assert_allclose(t.policy.log_std, np.log(0.3), rtol=1e-6)


def test_what_was_used_is_recorded(tmp_path):
    """A recipe's values, not its name, are in the run's folder, and a resumed run has them from there."""
    small = [a for a in TINY if a not in ("--recipe", "none", "--horizon", "8")]
    ours = own_recipe(tmp_path, "horizon = 8\nsigma = 0.2")
    ppo.main([*small[:3], "8", *small[3:], "--character", ours, "--steps", "64", "--out", str(tmp_path / "a")])
    config = read_config(tmp_path / "a")["config"]
    assert (config["horizon"], config["sigma"], config["by"]) == (8, 0.2, "ppo")
    _, meta = train(tmp_path / "a", 2, "--resume")
    assert meta["options"]["horizon"] == 8 and meta["updates"] == 2


def test_few_options():
    """What a reader has to read: twenty-five at most beside the character's and the motion's."""
    shared = {f.name for base in (character.Switches, data.MotionFlags) for f in fields(base)}
    assert len({f.name for f in fields(Options)} - shared) <= 25
    assert len((ROOT / "ppo.py").read_text().splitlines()) <= 450
    assert len((ROOT / "env.py").read_text().splitlines()) <= 600


def test_normaliser_learns_raw_observations(char, ref):
    """Mean and variance are those of what the environment showed, not of what the networks saw."""
    t = trainer_of(char, ref)
    seen, step = [t.env.full.copy()], t.env.step  # the first observation counts twice: `start` begins with it
    t.env.step = lambda a: (seen.append(t.env.full.copy()), step(a))[1]
    for _ in range(3):
        t.collect(), t.update()
    rows = np.concatenate(seen).astype(float)
    assert t.policy.norm.count == len(rows) == 6 * (3 * 8 + 1)
    np.testing.assert_allclose(t.policy.norm.mean64, rows.mean(0), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(t.policy.norm.var, rows.var(0), rtol=1e-5, atol=1e-8)
    assert np.abs(rows.mean(0)).max() > 1.0  # normalised ones would be about 0


def test_fingerprint(char, ref):
    told = training.motions(ref)
    assert told == training.motions(replace(ref, qpos=ref.qpos.copy())) and told["sequences"] == len(ref.names)
    assert told["minutes"] == pytest.approx(len(ref) / 30 / 60)
    assert told["fingerprint"] == training.fingerprint(np.asfortranarray(ref.qpos))
    moved = ref.qpos.copy()
    moved[5, 8] += 1e-12
    assert told["fingerprint"] != training.fingerprint(moved)


def test_config_tells_what_was_run(whole):
    config = read_config(whole)
    assert config["config"]["clips"] == "*stand*" and config["config"]["data"]["sequences"] == 1
    assert (whole / CONFIG).exists() and {"python", "mujoco"} <= set(config["versions"])

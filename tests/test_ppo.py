"""PPO: Appendix B's formulas against slow loops, finite differences and torch; the loop's bookkeeping; exact resume."""

import itertools
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

import character
import env
import ppo
import retarget
from character import TERMS
from env import Disturbance, Env, input_names
from mocap import data
from nn import check_gradient, gaussian_logp
from plumbing import runs
from plumbing.cli import UserError
from plumbing.runs import CHECKPOINT, CONFIG, METRICS, load_checkpoint, read_config, read_metrics, save_checkpoint
from ppo import Options, Policy, Trainer

ROOT = Path(__file__).resolve().parent.parent
TIMES = ("steps_per_s", "collect_s", "update_s")
TINY = "--clips *stand* --envs 8 --horizon 8 --minibatch 32 --hidden 12 --value-hidden 10,8 --threads 1".split()


pytestmark = pytest.mark.usefixtures("motions_once")


def tiny(**changes):
    small = dict(envs=6, horizon=8, minibatch=16, hidden=(12,), value_hidden=(10, 8), threads=1)
    return Options(**small | changes)


def trainer_of(char, ref, episode=500, **changes):
    opt = tiny(episode=episode, **changes)
    trainer = Trainer(opt, *ppo.environments(char, ref, opt))
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
    check_gradient(lambda v: ppo.clipped_surrogate(v, logp_old, adv, eps)[0], logp, dlogp)
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


def test_policy_loss_gradient():
    policy, x, action, logp_old, adv, _ = policy_batch()
    loss, gradient, out = ppo.policy_loss(policy, x[:, :5], action, logp_old, adv, 0.2)
    assert gradient.shape == policy.theta_pi.shape and np.all(gradient[-3:] != 0)  # log σ is in it
    np.testing.assert_array_equal(out["mu"], policy.actor(x[:, :5]))
    theta = policy.theta_pi.copy()

    def f(v):
        policy.theta_pi[:] = v
        return ppo.policy_loss(policy, x[:, :5], action, logp_old, adv, 0.2)[0]

    check_gradient(f, theta, gradient, rtol=1e-6, atol=1e-9)


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


def test_critic_loss_gradient():
    policy, x, *_, target = policy_batch()
    loss, gradient = ppo.critic_loss(policy, x, target)
    slow = sum((policy.critic(x[i : i + 1])[0, 0] - target[i]) ** 2 for i in range(len(x))) / (2 * len(x))
    assert loss == pytest.approx(slow, rel=1e-12)
    theta = policy.critic.theta.copy()

    def f(v):
        policy.critic.theta[:] = v
        return ppo.critic_loss(policy, x, target)[0]

    check_gradient(f, theta, gradient, rtol=1e-6, atol=1e-9)
    policy.critic.theta[:] = theta
    np.testing.assert_allclose(policy.value(x, rows=7), 3.0 * policy.critic(x)[:, 0])  # value_scale; in pieces


def test_value_clip_gradient():
    """½ mean of the larger square; no gradient once V has left old ± ε towards the target."""
    policy, x, *_, target = policy_batch()
    v, rng = policy.critic(x)[:, 0], np.random.default_rng(0)
    old = v + rng.choice([-0.5, -0.1, 0.1, 0.5], len(v))
    loss, gradient = ppo.critic_loss(policy, x, target, old, 0.2)
    slow, kinds = 0.0, set()
    for i in range(len(v)):
        held = min(max(v[i], old[i] - 0.2), old[i] + 0.2)
        slow += max((v[i] - target[i]) ** 2, (held - target[i]) ** 2) / (2 * len(v))
        kinds.add((held == v[i], (held - target[i]) ** 2 > (v[i] - target[i]) ** 2))
    assert kinds == {(True, False), (False, False), (False, True)}
    assert loss == pytest.approx(slow, rel=1e-12) and loss > ppo.critic_loss(policy, x, target)[0]
    theta = policy.critic.theta.copy()

    def f(u):
        policy.critic.theta[:] = u
        return ppo.critic_loss(policy, x, target, old, 0.2)[0]

    check_gradient(f, theta, gradient, rtol=1e-6, atol=1e-9)


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


def test_play_clips_observations_as_training(char, ref):
    t = trainer_of(char, ref)
    far = t.env.full + 100.0
    want = t.policy.actor(t.policy.norm.normalise(far)[:, : t.env.obs_size])
    np.testing.assert_allclose(t.policy.mean_action(far[:, : t.env.obs_size]), want, rtol=1e-5, atol=1e-6)


def test_time_to_failure(char, ref):
    t = trainer_of(char, ref, envs=32, horizon=30)
    stats = t.collect()
    assert t.terminated.any() and stats["time_to_failure"] == pytest.approx(32 * 30 / 30 / t.terminated.sum())


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


def test_linear_schedule(char, ref):
    """Both learning rates fall to 0 at --steps, whatever the KL divergence; no epoch is left out for it."""
    t = trainer_of(char, ref, schedule="linear", epochs=4, steps=48 * 4, target_kl=1e-6, lr=1e-2, value_lr=2e-2)
    rates, per_update = [], 4 * 3  # epochs × minibatches
    for k in range(4):
        t.collect(), t.update()
        rates.append((t.adam_pi.lr, t.adam_v.lr))
        assert t.adam_pi.t == per_update * (k + 1)
    np.testing.assert_allclose(rates, [(1e-2 * s, 2e-2 * s) for s in (1.0, 0.75, 0.5, 0.25)])


def test_joint_clip(char, ref, monkeypatch):
    """One norm over both gradients, the value's weighted; and advantages standardised minibatch by minibatch."""
    given, seen = [], []
    monkeypatch.setattr(ppo, "clip_grad_norm", lambda g, m: given.append((g.copy(), m)))
    loss = ppo.policy_loss
    monkeypatch.setattr(ppo, "policy_loss", lambda *a: seen.append(a[4]) or loss(*a))
    sizes = []
    for more in ({}, {"joint_clip": 0.5, "max_grad_norm": 0.3, "standardise_minibatch": True}):
        t = trainer_of(char, ref, epochs=1, **more)
        t.collect()
        seen.clear(), given.clear()
        t.update()
        sizes.append([len(g) for g, _ in given])
    both = t.policy.theta_pi.size + t.policy.critic.theta.size
    apart = [t.policy.theta_pi.size] * 3 + [t.policy.critic.theta.size] * 3  # on one thread the critic comes second
    assert sizes == [apart, [both] * 3] and given[0][1] == 0.3
    np.testing.assert_allclose([a.mean() for a in seen], 0.0, atol=1e-6)
    np.testing.assert_allclose([a.std() for a in seen], 1.0, atol=1e-3)


# ------------------------------------------------------------------------------------ learning


class Reach:
    """Points on a line, with the interface of Env: go to the target and stay; |x| > 2 fails, 12 steps truncate."""

    ENDS, TERMS, name, training = Env.ENDS, Env.TERMS, "reach", {}
    obs_size, critic_size, action_size, dt = 2, 3, 1, 0.1
    value_scale, stats = (lambda self, gamma: 1.0 / (1.0 - gamma)), (lambda self: {})

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


def test_second_thread_changes_nothing(char, ref):
    """Both halves are simulated, and actor and critic learn, the same side by side as one after the other."""
    one, two = (trainer_of(char, ref, envs=128, horizon=40, minibatch=1024, threads=n) for n in (1, 2))
    assert two.two and not one.two and [e.n for e in two.envs] == [64, 64]
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


def test_halves(char, ref):
    """From `ppo.HALVES` characters on there are two environments; each one's samples are what it does alone."""
    t = trainer_of(char, ref, envs=65, horizon=12, threads=2, episode=5)
    assert [e.n for e in t.envs] == [33, 32] and t.x.shape[:2] == (12, 65) and t.full.shape == (65, t.env.critic_size)
    assert len(ppo.environments(char, ref, tiny(envs=65, norm_each_step=True))) == 1
    assert [e.n for e in ppo.environments(char, ref, tiny(envs=63))] == [63]
    stats, value = t.collect(), lambda full: t.policy.value(t.policy.norm.normalise(full))
    terms = dict.fromkeys(TERMS, 0.0)
    for k, rows in enumerate((slice(0, 33), slice(33, 65))):
        twin = Env(char, ref, t.envs[k].n, threads=1, horizon=5)
        twin.reset([t.opt.seed, k] if k else t.opt.seed)
        for step in range(12):
            np.testing.assert_array_equal(t.raw[step, rows], twin.full)
            _, reward, terminated, truncated, info = twin.step(t.action[step, rows])
            np.testing.assert_array_equal(t.reward[step, rows], reward)
            after = value(np.where(truncated[:, None], info.get("final_critic", twin.full), twin.full))
            expected = np.where(terminated, 0.0, after)
            np.testing.assert_allclose(t.next_value[step, rows], expected, rtol=1e-4, atol=0.01)  # of 1,000
            for name in terms:
                terms[name] += info["terms"][name].sum() / (12 * 65)
        assert truncated.sum() + t.truncated[:, rows].sum() > 20
    for name, mean in terms.items():
        assert stats[f"r_{name}"] == pytest.approx(mean, rel=1e-6)
    assert not np.array_equal(t.action[0, :32], t.action[0, 33:])  # each explores by itself


def test_resume_of_halves_is_exact(tmp_path):
    """Two environments, which two threads simulate before the stop and one after it."""
    many = ("--envs", "64", "--minibatch", "256")
    train(tmp_path / "whole", 2 * 8, *many)
    train(tmp_path / "a", 8, *many, "--threads", "2")
    train(tmp_path / "a", 2 * 8, "--resume", "--threads", "1")
    assert_same_run(tmp_path / "whole", tmp_path / "a")


def test_resume_is_exact_when_disturbed(tmp_path):
    """The same with everything on that draws random numbers: other users, device errors, pushes."""
    more = "--augment --balance --sensor-offset 0.02 --sensor-noise 0.005 --push 5".split()
    train(tmp_path / "whole", 4, *more)
    train(tmp_path / "a", 2, *more)
    train(tmp_path / "a", 4, "--resume")
    assert_same_run(tmp_path / "whole", tmp_path / "a")


def test_make_envs_augments(ref):
    opt = Options(clips="*stand*", envs=5, horizon=4, threads=1, episode=77)
    [plain], [again] = ppo.make_envs(opt), ppo.make_envs(replace(opt, out="elsewhere"))
    assert plain.n == 5 and plain.horizon == 77 and plain.ref.names == ["stand_007"]
    assert ppo.fingerprint(plain.ref) == ppo.fingerprint(again.ref)
    assert plain.disturbance == Disturbance()  # nothing is added unless asked for
    more = replace(opt, augment=True, sensor_offset=0.02, sensor_noise=0.01, push=0.3)
    [env] = ppo.make_envs(more)
    frames = len(plain.ref)
    assert len(env.ref.names) == 2 and "mirrored" in env.ref.names[1]
    np.testing.assert_array_equal(env.ref.qpos[:frames], plain.ref.qpos)
    assert env.disturbance == Disturbance(sensor_offset=0.02, sensor_noise=0.01, push=0.3)
    assert ppo.fingerprint(env.ref) == ppo.fingerprint(ppo.make_envs(more)[0].ref) != ppo.fingerprint(plain.ref)
    assert ppo.fingerprint(env.ref) != ppo.fingerprint(ppo.make_envs(replace(more, seed=1))[0].ref)


def test_resume_from_a_damaged_checkpoint(whole, tmp_path, capsys):
    """Cut short while it was written: the one before is taken, and the rows after it are made again."""
    out = tmp_path / "a"
    train(out, 4, "--checkpoint-minutes", "0")
    newest = out / CHECKPOINT
    newest.write_bytes(newest.read_bytes()[:-500])
    with open(out / METRICS, "a") as file:
        file.write("5,320,0.1")  # a row that was being written
    (out / "checkpoint.tmp-1-abc.npz").write_bytes(b"half")
    train(out, 6, "--resume")
    assert "previous" in capsys.readouterr().err
    assert not list(out.glob("*.tmp-*"))
    assert_same_run(whole, out)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_resume_after_sigkill(tmp_path):
    """Killed among its checkpoints, which it writes after every update, a run continues to the same numbers."""
    out = tmp_path / "killed"
    command = [sys.executable, "ppo.py", *TINY, "--steps", "1e9", "--checkpoint-minutes", "0", "--out", str(out)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 60
        while not ((out / METRICS).exists() and (out / METRICS).read_text().count("\n") > 6):
            assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
            time.sleep(0.003)
    finally:
        process.kill()
        process.communicate()
    meta = runs.latest_checkpoint(out)[1]
    assert meta["updates"] >= 4
    train(out, meta["updates"] + 2, "--resume")
    train(tmp_path / "whole", meta["updates"] + 2)
    assert_same_run(tmp_path / "whole", out)


def test_interrupt_ends_with_a_checkpoint(tmp_path, monkeypatch, capsys, whole):
    lines = itertools.count(1)
    monkeypatch.setattr(runs.Progress, "update", lambda *_: next(lines) == 2 and signal.raise_signal(signal.SIGINT))
    _, meta = train(tmp_path / "a", 6)
    assert meta["updates"] == 2
    assert f"python ppo.py --resume --out {tmp_path / 'a'}" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.setattr(runs.Progress, "update", lambda *_: None)
    train(tmp_path / "a", 6, "--resume")
    assert_same_run(whole, tmp_path / "a")
    monkeypatch.setattr(runs.Progress, "update", lambda *_: [signal.raise_signal(signal.SIGTERM) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):  # the second one: at once
        train(tmp_path / "b", 6)


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


def test_resume_accepts_what_changes_nothing(whole, tmp_path):
    """The same value given again, other threads and other checkpoint times do not make it another run."""
    train(tmp_path / "a", 2)
    same = ["--lr", "1e-4", "--hidden", "12", "--threads", "2", "--checkpoint-minutes", "0"]
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
    for change in ({k: v for k, v in arrays.items() if "adam" not in k}, arrays | {"env0.frame": np.zeros(3, int)}):
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
    for flag in ("--hidden", "--value-hidden"):
        with pytest.raises(UserError, match=r"networks are \(12,\) and \(10, 8\), with .* give --hidden"):
            train(tmp_path / "b", 1, "--init", str(whole), flag, "9")
    policy = Policy(7, 9, 2, (4,), (4,), 0.1, 1.0, np.random.default_rng(0))
    save_checkpoint(tmp_path / "other.npz", policy.arrays(), {"policy": policy.shape()})
    with pytest.raises(UserError, match="7 observations and 2 actions; jesse needs"):
        train(tmp_path / "b", 1, "--init", str(tmp_path / "other.npz"))
    with pytest.raises(UserError, match="no checkpoint"):
        train(tmp_path / "b", 1, "--init", str(tmp_path / "missing.npz"))
    assert not (tmp_path / "b").exists()


def test_init_widens():
    rng = np.random.default_rng(1)
    old = Policy(9, 11, 3, (8, 6), (7,), 0.1, 2.0, rng)
    old.norm.update(rng.normal(2.0, 3.0, (50, 11)))
    new = Policy(9, 11, 3, (16, 6), (12,), 0.5, 2.0, rng)
    new.begin_from(old, "a.npz", rng)
    x = rng.normal(2.0, 3.0, (20, 11)).astype(np.float32)
    np.testing.assert_allclose(new.mean_action(x[:, :9]), old.mean_action(x[:, :9]), atol=1e-6)
    np.testing.assert_allclose(new.value(new.norm.normalise(x)), old.value(old.norm.normalise(x)), rtol=1e-5)
    np.testing.assert_array_equal(new.log_std, old.log_std)
    with pytest.raises(UserError, match="a.npz: its networks are"):
        Policy(9, 11, 3, (8, 5), (7,), 0.1, 2.0, rng).begin_from(old, "a.npz", rng)


def test_init_brings_its_widths(whole, tmp_path):
    """Layers are as wide as those of --init where the command line does not say; --share alone averages nothing."""
    small = [a for a in TINY if a not in ("--hidden", "12", "--value-hidden", "10,8")]
    ppo.main([*small, "--init", str(whole), "--steps", "64", "--out", str(tmp_path / "a")])
    policy, _ = ppo.load_policy(tmp_path / "a")
    assert (policy.hidden, policy.value_hidden) == ((12,), (10, 8))
    ppo.main([*small, "--init", str(whole), "--hidden", "20", "--steps", "64", "--out", str(tmp_path / "b")])
    policy, _ = ppo.load_policy(tmp_path / "b")
    assert (policy.hidden, policy.value_hidden) == ((20,), (10, 8))
    with pytest.raises(UserError, match="--share is of --blend"):
        ppo.main(["--ship", str(tmp_path / "c.npz"), "--share", "0.3", "--out", str(tmp_path / "a")])
    assert not (tmp_path / "c.npz").exists()


def test_line_of_progress(char, ref):
    t = trainer_of(char, ref, horizon=1)
    stats = t.collect() | dict.fromkeys(("steps_per_s", "kl", "clip_fraction", "explained_variance", "sigma"), 0.0)
    assert stats["failures"] == 0 and ppo.progress_line(stats)["fails every"] == "never"
    assert ppo.progress_line(stats | {"failures": 2, "time_to_failure": 1.5})["fails every"] == "1.50 s"


def test_init_symmetric(whole, tmp_path, capsys, char, ref):
    """§5.3: the actor goes on, the critic, which sees less, begins; the other way round nothing fits."""
    _, meta = train(tmp_path / "a", 1, "--init", str(whole), "--without", "asymmetric")
    says = f"{whole}: its critic sees 459 numbers, this one's only the actor's 189: the critic begins anew"
    assert says in capsys.readouterr().out
    assert meta["options"]["without"] == ["asymmetric"] and meta["policy"]["critic_size"] == 189
    old, _ = ppo.load_policy(whole)
    new = trainer_of(char, ref, without=("asymmetric",)).policy
    critic = new.critic.theta.copy()
    new.begin_from(old, "a.npz", np.random.default_rng(0))
    x = np.random.default_rng(1).normal(size=(20, 189)).astype(np.float32)
    np.testing.assert_allclose(new.mean_action(x), old.mean_action(x), atol=1e-6)
    np.testing.assert_array_equal(new.critic.theta, critic)
    with pytest.raises(UserError, match="with 189 inputs for the critic"):
        train(tmp_path / "b", 1, "--init", str(tmp_path / "a"))


def test_init_headset_only(whole, tmp_path, char):
    """§4.2: where the controllers' numbers are at their means, the policy without them does and expects the same."""
    rng = np.random.default_rng(0)
    old, _ = ppo.load_policy(whole)
    keep = [input_names(char).index(n) for n in input_names(char, 1)]
    new = old.rearranged(keep, 189 - 36, np.arange(33))
    gone = np.setdiff1d(np.arange(459), keep)
    assert (new.obs_size, new.critic_size) == (153, 423) and len(gone) == 36 and gone.max() < 189
    x = (old.norm.mean + rng.normal(size=(50, 459)) / old.norm.inv_std).astype(np.float32)
    x[:, gone] = old.norm.mean[gone]
    np.testing.assert_allclose(new.mean_action(x[:, keep[:153]]), old.mean_action(x[:, :189]), atol=1e-6)
    np.testing.assert_allclose(new.value(new.norm.normalise(x[:, keep])), old.value(old.norm.normalise(x)), rtol=1e-5)
    moved = x.copy()
    moved[:, gone] += 1.0
    assert np.abs(old.mean_action(moved[:, :189]) - old.mean_action(x[:, :189])).max() > 1e-4  # they had mattered
    np.testing.assert_array_equal(new.log_std, old.log_std)

    _, meta = train(tmp_path / "a", 1, "--init", str(whole), "--sensors", "hmd", "--hidden", "16")
    assert meta["options"]["sensors"] == "hmd" and meta["policy"]["obs_size"] == 153
    train(tmp_path / "a", 2, "--resume")
    train(tmp_path / "b", 1, "--init", str(tmp_path / "a"), "--sensors", "hmd", "--hidden", "16")
    with pytest.raises(UserError, match="trained with the headset alone: give --sensors hmd"):
        train(tmp_path / "c", 1, "--init", str(tmp_path / "a"), "--hidden", "16")
    arrays, meta = load_checkpoint(tmp_path / "a" / CHECKPOINT)
    save_checkpoint(tmp_path / "p.npz", arrays, meta | {"options": {"sensors": "three"}})
    with pytest.raises(UserError, match="p.npz: its options have sensors 'three'; valid: full, hmd"):
        train(tmp_path / "c", 1, "--init", str(tmp_path / "p.npz"), "--sensors", "hmd")


def test_switches_reach_the_environment():
    """Each flag, and the variant of the character, in the environment that is trained."""
    opt = Options(clips="*stand*", envs=3, threads=1)
    [plain] = ppo.make_envs(opt)
    [env] = ppo.make_envs(replace(opt, without=("contact", "action", "asymmetric"), sensors="hmd", scale=0.9))
    assert {t for t in TERMS if env.char.reward[t][0] == 0} == {"contact", "action_diff", "action_min"}
    assert (env.devices, env.asymmetric, env.char.variant) == (1, False, {"scale": 0.9})
    assert (plain.devices, plain.asymmetric, plain.char.variant) == (3, True, {})
    [env] = ppo.make_envs(replace(opt, track="root"))
    assert env.char.reward["q"][0] == 0 < env.char.reward["x"][0] and env.ref.link_pos.shape[1] == 1
    for wrong in (["--without", "contact,gravity"], ["--track", "head"], ["--sensors", "none"]):
        with pytest.raises(SystemExit):
            ppo.main(["--out", "nowhere", *wrong])


def test_noise_is_the_characters(char, ref):
    """σ: of the command line, else of the character's [training], else of NOISE; what was used is recorded."""
    other = replace(char, training={"sigma": 0.06})
    for c, given, sigma, least in (
        (char, {}, 0.135, 0.05),
        (other, {}, 0.06, 0.05),
        (other, {"sigma": 0.2}, 0.2, 0.05),
    ):
        t = trainer_of(c, ref, **given)
        assert (t.opt.sigma, t.opt.min_sigma) == (sigma, least)
        np.testing.assert_allclose(t.policy.log_std, np.log(sigma), rtol=1e-6)


def test_init_of_another_character(whole, tmp_path, capsys):
    """What has the same name goes on, whatever its place; the rest is silent; normaliser and σ begin anew."""
    old, _ = ppo.load_policy(whole)
    _, meta = train(tmp_path / "dino", 1, "--character", "dino", "--init", str(whole))
    assert "jesse's policy: 459 of 487 inputs and 33 of 37 torques" in capsys.readouterr().out
    assert meta["policy"]["action_size"] == 37
    jesse, dino = character.load("jesse"), character.load("dino")
    clip = data.builtin_clips()[0][:40]
    a, b = (Env(c, retarget.reference(c, [clip]), 3, threads=1) for c in (jesse, dino))
    new = ppo.initial_policy(whole, b, 0.07)
    np.testing.assert_allclose(new.log_std, np.log(0.07), rtol=1e-6)
    assert new.norm.count == 0
    names = [env.input_names(c) for c in (jesse, dino)]
    assert [len(n) for n in names] == [a.full.shape[1], b.full.shape[1]]
    x = np.random.default_rng(0).normal(size=(5, len(names[0]))).astype(np.float32)
    y = np.random.default_rng(1).normal(size=(5, len(names[1]))).astype(np.float32)  # what is new can be anything
    for i, name in enumerate(names[1]):
        if name in names[0]:
            y[:, i] = x[:, names[0].index(name)]
    had, has = old.actor(x[:, : old.obs_size]), new.actor(y[:, : new.obs_size])
    for k, h in enumerate(dino.driven):
        hinge = dino.hinges[h]
        want = had[:, jesse.hinges.index(hinge)] if hinge in jesse.hinges else 0.0
        np.testing.assert_allclose(has[:, k], want, atol=1e-5, err_msg=hinge)
    np.testing.assert_allclose(new.critic(y), old.critic(x), atol=1e-5)


def test_init_of_a_variation(tmp_path):
    """Dino's tail without motors: four are gone, the others' torques and the normaliser are as they were."""
    clip, rng = data.builtin_clips()[0][:40], np.random.default_rng(0)
    whole, limp = (character.load("dino", tail=tail) for tail in (None, "passive"))
    a, b = (Env(c, retarget.reference(c, [clip]), 3, threads=1) for c in (whole, limp))
    assert a.obs_size == b.obs_size and a.action_size == b.action_size + 4
    old = Policy(a.obs_size, a.critic_size, a.action_size, (8,), (4,), 0.1, 1.0, rng)
    old.norm.update(rng.normal(size=(50, a.critic_size)))
    save_checkpoint(tmp_path / "p.npz", old.arrays(), {"policy": old.shape(), "options": {"character": "dino"}})
    new = ppo.initial_policy(tmp_path / "p.npz", b, 0.3)
    x = rng.normal(size=(5, a.obs_size)).astype(np.float32)
    kept = [k for k, h in enumerate(whole.driven) if not whole.hinges[h].startswith("tail")]
    np.testing.assert_allclose(new.mean_action(x), old.mean_action(x)[:, kept], atol=1e-6)
    np.testing.assert_array_equal(new.norm.mean, old.norm.mean)
    np.testing.assert_array_equal(new.log_std, old.log_std[kept])


def test_policy_round_trip(tmp_path, char, ref):
    """What is played is what was trained: the normaliser is in the file, and frozen."""
    t = trainer_of(char, ref)
    t.collect(), t.update()
    t.save(tmp_path / CHECKPOINT, {"options": {"character": "jesse"}})
    for path in (tmp_path, tmp_path / CHECKPOINT):
        policy, meta = ppo.load_policy(path)
        assert meta["steps"] == t.steps and meta["options"]["character"] == "jesse"
        for name, value in t.policy.arrays().items():
            np.testing.assert_array_equal(policy.arrays()[name], value, err_msg=name)
        obs = t.env.full[:, : t.env.obs_size]
        expected = t.policy.actor(t.policy.norm.normalise(t.env.full)[:, : t.env.obs_size])
        np.testing.assert_array_equal(policy.mean_action(obs), expected)
        assert policy.norm.frozen and np.abs(policy.norm.mean).max() > 0.1
        policy.norm.update(np.full((100, t.env.critic_size), 50.0))
        np.testing.assert_array_equal(policy.mean_action(obs), expected)
    ppo.check_fits(policy, t.env, tmp_path)


def test_broken_policies(tmp_path):
    policy = Policy(7, 9, 2, (4,), (4,), 0.1, 1.0, np.random.default_rng(0))
    arrays, meta = policy.arrays(), {"policy": policy.shape()}
    path = tmp_path / "p.npz"
    save_checkpoint(path, arrays, meta)
    whole = path.read_bytes()
    assert ppo.load_policy(path)[0].shape() == policy.shape()

    def saved(new_arrays=arrays, new_meta=meta):
        save_checkpoint(path, new_arrays, new_meta)

    def foreign():
        np.savez(path, a=np.zeros(3))

    nan = arrays["policy.pi"].copy()
    nan[3] = np.nan
    cases = [
        lambda: path.write_bytes(whole[: len(whole) // 2]),
        lambda: path.write_bytes(b""),
        lambda: path.write_text("not a zip"),
        foreign,
        lambda: saved(new_meta={}),
        lambda: saved(new_meta={"policy": 3}),
        lambda: saved(new_meta={"policy": meta["policy"] | {"hidden": [5]}}),
        lambda: saved(new_meta={"policy": meta["policy"] | {"hidden": ["x"]}}),
        lambda: saved(new_meta={"policy": meta["policy"] | {"more": 1}}),
        lambda: saved({k: v for k, v in arrays.items() if k != "policy.pi"}),
        lambda: saved({k: v for k, v in arrays.items() if k != "policy.norm.count"}),
        lambda: saved(arrays | {"policy.pi": np.zeros(1, np.float32)}),  # would broadcast
        lambda: saved(arrays | {"policy.norm.mean": np.zeros(3)}),
        lambda: saved(arrays | {"policy.pi": nan}),
    ]
    for i, breaks in enumerate(cases):
        breaks()
        with pytest.raises(UserError, match="p.npz") as error:
            ppo.load_policy(path)
        assert len(str(error.value).splitlines()) == 1, i
    for missing in (tmp_path / "none.npz", tmp_path / "none"):
        with pytest.raises(UserError, match="no checkpoint"):
            ppo.load_policy(missing)
    path.unlink()
    with pytest.raises(UserError, match="holds no checkpoint"):
        ppo.load_policy(tmp_path)


def test_fingerprint(char, ref):
    assert ppo.fingerprint(ref) == ppo.fingerprint(replace(ref, qpos=ref.qpos.copy()))
    moved = ref.qpos.copy()
    moved[5, 8] += 1e-12
    assert ppo.fingerprint(ref) != ppo.fingerprint(replace(ref, qpos=moved))


def test_config_tells_what_was_run(whole):
    config = read_config(whole)
    assert config["config"]["clips"] == "*stand*" and config["config"]["data"]["sequences"] == 1
    assert (whole / CONFIG).exists() and {"python", "mujoco"} <= set(config["versions"])


def test_blended(tmp_path):
    """Shares of 0 and 1 are the two policies; between them weights, and the normaliser's variances, are means."""
    paths = tmp_path / "old", tmp_path / "new"
    for seed, path in enumerate(paths):
        train(path, 2, "--seed", str(seed))
    obs = np.random.default_rng(0).standard_normal((5, ppo.load_policy(paths[0])[0].obs_size)).astype(np.float32)
    old, new = (ppo.load_policy(p)[0] for p in paths)
    for share, like in ((0.0, new), (1.0, old)):
        assert ppo.ship(paths[1], tmp_path / "b.npz", paths[:1], share)["blend"] == {"with": ["old"], "share": share}
        got = ppo.load_policy(tmp_path / "b.npz")[0]
        np.testing.assert_allclose(got.mean_action(obs), like.mean_action(obs), atol=1e-5)
    ppo.main(["--ship", str(tmp_path / "b.npz"), "--out", str(paths[1]), "--blend", str(paths[0]), "--share", "0.25"])
    got = ppo.load_policy(tmp_path / "b.npz")[0]
    np.testing.assert_allclose(got.theta_pi, 0.75 * new.theta_pi + 0.25 * old.theta_pi, atol=1e-6)
    np.testing.assert_allclose(got.norm.var, 0.75 * new.norm.var + 0.25 * old.norm.var, rtol=1e-5)
    np.testing.assert_allclose(got.norm.mean, 0.75 * new.norm.mean + 0.25 * old.norm.mean, atol=1e-5)
    ppo.ship(paths[1], tmp_path / "b.npz", [paths[0], paths[0], paths[1]], 0.75)
    np.testing.assert_allclose(
        ppo.load_policy(tmp_path / "b.npz")[0].theta_pi, 0.5 * (new.theta_pi + old.theta_pi), atol=1e-6
    )
    ppo.ship(paths[1], tmp_path / "b.npz", gain=1.25)
    x = np.random.default_rng(1).standard_normal((3, new.critic_size))
    louder = ppo.load_policy(tmp_path / "b.npz")[0]
    inside = np.abs(new.norm(x)) < 8  # the rest is clipped
    np.testing.assert_allclose(louder.norm(x)[inside], 1.25 * new.norm(x)[inside], rtol=0.01)
    other = Path(ppo.__file__).parent / "characters" / "jesse-hmd.npz"
    assert ppo.load_policy(other)[1]["licence"] != "MIT"
    assert ppo.ship(other, tmp_path / "again.npz")["licence"] == ppo.load_policy(other)[1]["licence"]
    with pytest.raises(UserError, match="--blend .*: networks .*; valid: policies of one ancestor with "):
        ppo.ship(paths[1], tmp_path / "c.npz", [other])
    arrays, meta = load_checkpoint(paths[0] / CHECKPOINT, ("policy.*",))
    save_checkpoint(tmp_path / "bent.npz", arrays, meta | {"options": meta["options"] | {"set": "pose.spine_y=0.2"}})
    with pytest.raises(UserError, match="bent.npz: another body or pose"):
        ppo.ship(paths[1], tmp_path / "c.npz", [tmp_path / "bent.npz"])
    save_checkpoint(tmp_path / "odd.npz", arrays, meta | {"options": meta["options"] | {"set": 5}})
    with pytest.raises(UserError, match="odd.npz: its options name no character"):
        ppo.ship(paths[1], tmp_path / "c.npz", [tmp_path / "odd.npz"])
    save_checkpoint(tmp_path / "less.npz", arrays, meta | {"options": meta["options"] | {"set": "reward.q=[0, 1]"}})
    ppo.ship(paths[1], tmp_path / "d.npz", [tmp_path / "less.npz"])  # another reward is the same body
    with pytest.raises(UserError, match="--blend, --share and --gain are of --ship"):
        ppo.main(["--blend", str(paths[0]), "--out", str(tmp_path / "never")])
    assert not (tmp_path / "c.npz").exists() and not (tmp_path / "never").exists()


def test_ship(tmp_path, monkeypatch):
    """A shipped policy acts as the run's does, is small, and carries its data's licence."""
    folder = tmp_path / "motion"
    folder.mkdir()
    (folder / "LICENSE").write_text("Non-commercial.\n")
    monkeypatch.setattr(data, "sequences", lambda *a, **k: data.builtin_clips()[:1])
    size = ["--envs", "4", "--horizon", "4", "--steps", "16", "--minibatch", "16"]
    ppo.main(["--motion", str(folder), "--out", str(tmp_path / "run"), *size])
    target = tmp_path / "jesse.npz"
    ppo.main(["--ship", str(target), "--out", str(tmp_path / "run")])
    (a, _), (b, meta) = ppo.load_policy(tmp_path / "run"), ppo.load_policy(target)
    obs = np.random.default_rng(0).standard_normal((3, a.obs_size)).astype(np.float32)
    np.testing.assert_array_equal(a.mean_action(obs), b.mean_action(obs))
    assert meta["licence"] == "weights trained on motion, licensed: Non-commercial." and meta["steps"] == 16
    assert target.stat().st_size < 4e6
    assert str(tmp_path) not in json.dumps(meta)  # no path of the machine
    ppo.main(["--motion", f"builtin,{folder},standing", "--out", str(tmp_path / "both"), *size])
    ppo.main(["--motion", str(folder), "--init", str(target), "--out", str(tmp_path / "more"), *size])
    more = ppo.ship(tmp_path / "more", tmp_path / "more.npz")
    assert more["steps"] == 32 == ppo.total_steps(ppo.load_policy(tmp_path / "more")[1]) and not more["options"]["init"]
    assert ppo.ship(tmp_path / "both", target)["licence"] == meta["licence"]
    assert ppo.load_policy(target)[1]["options"]["motion"] == "builtin,motion,standing"
    with pytest.raises(UserError):
        ppo.ship(tmp_path / "nothing", target)

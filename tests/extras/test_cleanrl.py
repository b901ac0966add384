"""extras/cleanrl.py: each of its nine differences, and all of them on a task of Gymnasium's."""

import itertools
import signal

import numpy as np
import pytest
from test_gym_env import Point, gymnasium, point  # noqa: F401, a fixture
from test_ppo import policy_batch

import ppo
from extras import cleanrl, gym_env
from nn import check_gradient
from plumbing.cli import UserError, run_main
from plumbing.runs import CHECKPOINT, METRICS, load_checkpoint, read_metrics
from policy import load_policy

pytestmark = [pytest.mark.usefixtures("point"), pytest.mark.filterwarnings("ignore::DeprecationWarning")]


def trainer(**changes):
    settings = dict(task="Point-v0", envs=4, horizon=32, minibatch=32, epochs=4, lr=3e-3, value_lr=3e-3, sigma=0.5)
    opt = cleanrl.Options(**settings | dict(hidden=(16,), value_hidden=(16,), gamma=0.9) | changes)
    made = cleanrl.Trainer(opt, cleanrl.make_env(opt))
    made.start()
    return made


# ------------------------------------------------------------------------------------ the differences


def test_value_clip_gradient():
    """½ mean of the larger square; no gradient once V has left old ± ε towards the target."""
    policy, x, *_, target = policy_batch()
    v, rng = policy.critic(x)[:, 0], np.random.default_rng(0)
    old = v + rng.choice([-0.5, -0.1, 0.1, 0.5], len(v))
    loss, gradient = cleanrl.clipped_value_loss(policy, x, target, old, 0.2)
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
        return cleanrl.clipped_value_loss(policy, x, target, old, 0.2)[0]

    check_gradient(f, theta, gradient, rtol=1e-6, atol=1e-9)


def test_linear_schedule(char, ref):
    """Both learning rates fall to 0 at --steps, whatever the KL divergence; no epoch is left out for it."""
    t = trainer(envs=6, horizon=8, minibatch=16, epochs=4, steps=48 * 4, target_kl=1e-6, lr=1e-2, value_lr=2e-2)
    rates, per_update = [], 4 * 3  # epochs × minibatches
    for k in range(4):
        t.collect(), t.update()
        rates.append((t.adam_pi.lr, t.adam_v.lr))
        assert t.adam_pi.t == per_update * (k + 1)
    np.testing.assert_allclose(rates, [(1e-2 * s, 2e-2 * s) for s in (1.0, 0.75, 0.5, 0.25)])


def test_schedule_by_kl():
    """As ppo.py's: the rate follows the divergence, and epochs end early."""
    for target, factor, steps in ((1e-6, 1 / 1.2, 3), (10.0, 1.2, 6)):
        t = trainer(envs=6, horizon=8, minibatch=16, epochs=2, schedule="kl", target_kl=target, lr=1e-2)
        t.collect(), t.update()
        assert t.adam_pi.lr == pytest.approx(min(1e-2 * factor, 1e-2)) and t.adam_pi.t == steps


def test_joint_clip(monkeypatch):
    """One norm over both gradients, the value's weighted; and advantages standardised minibatch by minibatch."""
    given, seen = [], []
    monkeypatch.setattr(cleanrl, "clip_grad_norm", lambda g, m: given.append((g.copy(), m)))
    loss = ppo.policy_loss
    monkeypatch.setattr(ppo, "policy_loss", lambda *a: seen.append(a[4]) or loss(*a))
    sizes = []
    for more in ({"joint_clip": None, "standardise_minibatch": False}, {}):
        t = trainer(envs=6, horizon=8, minibatch=16, epochs=1, **more)
        t.collect()
        seen.clear(), given.clear()
        t.update()
        sizes.append([len(g) for g, _ in given])
        each = np.array([[a.mean(), a.std()] for a in seen])
        assert np.allclose(each, [0.0, 1.0], atol=1e-3) != bool(more)
    policy, critic = t.policy.theta_pi.size, t.policy.critic.theta.size
    assert sizes == [[policy, critic] * 3, [policy + critic] * 3] and given[0][1] == 0.5


def test_normaliser(monkeypatch):
    """Every step, or between updates; Adam's epsilon and the activation are what was asked for."""
    for each, before, after in ((True, 4 + 4 * 8, 4 + 4 * 8), (False, 4, 4 + 4 * 8)):
        t = trainer(horizon=8, norm_each_step=each, adam_eps=1e-3, activation="leaky_relu")
        t.collect()
        assert t.policy.norm.count == before
        t.update()
        assert t.policy.norm.count == after
    assert t.adam_pi.eps == t.adam_v.eps == 1e-3 and t.policy.actor.activation == "leaky_relu"


def test_non_finite_task(monkeypatch):
    """A task that diverges fails, and nothing of it reaches the networks."""
    monkeypatch.setattr(Point, "fault", "nan")
    t = trainer()
    stats = t.collect() | t.update()
    assert stats["end_bad"] > 3
    for array in (t.x, t.reward, t.next_value, t.policy.theta_pi, t.policy.norm.mean64):
        assert np.isfinite(array).all()


def test_time_limit_is_bootstrapped():
    """The value after a time limit is of the state before the reset; with limit_ends it is 0."""
    for limit_ends in (False, True):
        t = trainer(horizon=14, limit_ends=limit_ends)
        finals, step = [], t.env.step

        def noted(a, step=step, finals=finals):
            out = step(a)
            finals.append(out[4].get("final_critic"))
            return out

        t.env.step = noted
        t.policy.norm.frozen = True
        t.collect()
        limited = np.stack([f is not None for f in finals])[:, None] & (t.truncated | t.terminated)
        assert limited[:12].any()
        for k, i in np.argwhere(limited):
            expected = t.policy.value(t.policy.norm.normalise(finals[k][i : i + 1]))[0]
            if t.terminated[k, i]:
                expected = 0.0
            assert t.next_value[k, i] == pytest.approx(expected, abs=1e-5)
        assert t.truncated.any() != limit_ends


# ------------------------------------------------------------------------------------ the whole


def test_learns():
    """Our PPO, with CleanRL's switches, learns a task of Gymnasium's."""
    t = trainer(steps=128 * 70)
    history = [t.collect() | t.update() for _ in range(70)]
    assert history[2]["return_100"] < 4.0 < 7.0 < history[-1]["return_100"]  # of 12 at most
    assert history[-1]["lr"] == pytest.approx(3e-3 / 70, rel=1e-6)
    assert history[-1]["end_fail"] == 0 and np.mean([h["explained_variance"] for h in history[-5:]]) > 0.3


@pytest.mark.parametrize("task", ["Point-v0", "Pendulum-v1", "Hopper-v4"])
def test_resume_is_exact(task, tmp_path, capsys, request):
    """Stopped in the middle of an episode and continued: the same numbers to the last bit."""
    try:
        gym_env.make(task)
    except UserError as e:
        pytest.skip(f"{task} cannot be made: {e}")
    small = task, "--horizon", "50", "--minibatch", "25", "--epochs", "2", "--hidden", "8"
    cleanrl.main([*small, "--steps", "300", "--out", str(tmp_path / "whole")])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # some shells start their children without
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    monkey = pytest.MonkeyPatch()
    with monkey.context() as patch:  # stopped after 3 of the 6 updates
        update, count = cleanrl.Trainer.update, itertools.count(1)

        def stopping(self):
            out = update(self)
            if next(count) == 3:
                signal.raise_signal(signal.SIGINT)
            return out

        patch.setattr(cleanrl.Trainer, "update", stopping)
        cleanrl.main([*small, "--steps", "300", "--out", str(tmp_path / "parts")])
    meta = load_checkpoint(tmp_path / "parts" / CHECKPOINT)[1]
    assert meta["steps"] == 150
    ppo.main(["--resume", "--out", str(tmp_path / "parts")])  # which hands on
    assert "does not repeat" not in capsys.readouterr().err
    (a, meta_a), (b, meta_b) = (load_checkpoint(tmp_path / d / CHECKPOINT) for d in ("whole", "parts"))
    assert set(a) == set(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    assert {k: meta_a[k] for k in ("rng", "env", "lr", "rows", "data")} == {
        k: meta_b[k] for k in ("rng", "env", "lr", "rows", "data")
    }
    parts = read_metrics(tmp_path / "parts" / METRICS)
    np.testing.assert_array_equal(read_metrics(tmp_path / "whole" / METRICS)["return_100"], parts["return_100"])


def test_settings(tmp_path):
    """The command line changes CleanRL's settings; what was used is in the file; a policy can be gone on from."""
    tiny = ["Point-v0", "--steps", "64", "--horizon", "32", "--hidden", "8"]
    cleanrl.main([*tiny, "--out", str(tmp_path / "a")])
    options = load_checkpoint(tmp_path / "a" / CHECKPOINT)[1]["options"]
    wanted = dict(task="Point-v0", steps=64, horizon=32, hidden=[8], value_hidden=[64, 64], minibatch=64, lr=3e-4)
    wanted |= dict(activation="tanh", schedule="linear", adam_eps=1e-5, value_clip=True, joint_clip=0.5)
    wanted |= dict(standardise_minibatch=True, norm_each_step=True, reward_norm=True, limit_ends=False)
    assert {k: options[k] for k in wanted} == wanted
    policy, meta = load_policy(tmp_path / "a")
    assert policy.activation == policy.actor.activation == policy.critic.activation == "tanh"
    assert policy.value_scale == 1.0 and (policy.obs_size, policy.action_size) == (2, 1)
    assert meta["data"]["task"] == "Point-v0"
    row = read_metrics(tmp_path / "a" / METRICS)
    assert row["end_time"].sum() + row["end_fail"].sum() == row["episodes"].sum() > 2
    more = [*tiny, "--init", str(tmp_path / "a")]
    cleanrl.main([*more, "--out", str(tmp_path / "b")])
    a, b = (load_checkpoint(tmp_path / d / CHECKPOINT)[0] for d in "ab")
    assert b["policy.norm.count"] == a["policy.norm.count"] + 64 and b["adam_pi.t"] == a["adam_pi.t"]
    cases = (["--activation", "leaky_relu"], "activation is tanh"), (["--hidden", "9"], r"hidden is \(8,\)")
    for flags, says in cases:
        with pytest.raises(UserError, match=says):
            cleanrl.main([*more, *flags, "--out", str(tmp_path / "c")])


def test_wrong_tasks(tmp_path, capsys, monkeypatch):
    """One line, code 2, nothing written."""
    monkeypatch.chdir(tmp_path)

    def refuse(*args):
        with pytest.raises(SystemExit) as end:
            run_main(cleanrl.main, [str(a) for a in args])
        err = capsys.readouterr().err.splitlines()
        assert end.value.code == 2 and not list(tmp_path.iterdir())
        return [line for line in err if line.startswith("error:") or ": error:" in line][-1]

    assert "HalfCheetah-v4" in refuse("HalfCheetahs-v4")
    assert "no/where" in refuse("no/where")
    assert "Discrete(2); valid: a Box" in refuse("--task", "CartPole-v1")
    assert "--motion" in refuse("Pendulum-v1", "--motion", "x")
    assert "leaky_relu, tanh" in refuse("--activation", "sine").replace("'", "")
    assert "valid: a task that gymnasium.make knows" in refuse("nobodys_tasks:Walk-v0")

    def without_imageio(*args, **flags):
        raise ModuleNotFoundError("No module named 'imageio'", name="imageio")

    monkeypatch.setattr(gym_env.gymnasium, "make", without_imageio)
    assert "'imageio'; python -m pip install -e '.[gym]'" in refuse("HalfCheetah-v4")
    monkeypatch.setattr(gym_env, "gymnasium", None)
    assert "pip install -e '.[gym]'" in refuse("Pendulum-v1")

"""extras/gym_env.py: our characters as Gymnasium's environments, and Gymnasium's tasks as what our PPO learns."""

import json

import numpy as np
import pytest

import character
import retarget
from env import Env
from extras import gym_env
from mocap import data
from plumbing import render
from plumbing.cli import UserError

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed (extra gym)")

from gymnasium.utils.env_checker import check_env  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def actions(n, steps, size=33, scale=0.5, seed=0):
    return scale * np.random.default_rng(seed).standard_normal((steps, n, size))


# ------------------------------------------------------------------------------------ our characters for others


def test_check_env(char, ref, recwarn):
    """Gymnasium's own checker, and no complaint but that the observation has no bounds."""
    one = gym_env.as_gymnasium(char, ref)
    check_env(one, skip_render_check=True)
    told = {str(w.message) for w in recwarn if "gymnasium" in w.filename or "WARN" in str(w.message)}
    assert all("infinity" in t or "spec" in t for t in told), told
    assert one.observation_space.shape == (189,) and one.action_space.shape == (33,)
    assert one.metadata["render_fps"] == 30


def test_one_is_the_environment(char, ref):
    """The episodes of `Env` of the same seed, resets and all; a frame of one's choice."""
    one, same = gym_env.as_gymnasium(char, ref, horizon=12), Env(char, ref, 1, 7, 1, 12)
    obs, info = one.reset(seed=7)
    np.testing.assert_array_equal(obs, same.reset(7)[0][0])
    np.testing.assert_array_equal(info["critic"], same.full[0])
    ended = set()
    for a in actions(1, 40):
        obs, reward, terminated, truncated, info = one.step(a[0])
        obs_b, reward_b, terminated_b, truncated_b, info_b = same.step(a)
        assert (reward, terminated, truncated) == (reward_b[0], terminated_b[0], truncated_b[0])
        assert type(reward) is float and type(terminated) is type(truncated) is bool
        assert info["length"] == info_b["length"][0] and info["available"] == info_b["available"][0]
        assert info["terms"] == {k: v[0] for k, v in info_b["terms"].items()}
        if terminated or truncated:
            np.testing.assert_array_equal(obs, info_b["final_obs"][0])
            np.testing.assert_array_equal(info["critic"], info_b["final_critic"][0])
            ended.add(next(k for k, v in info["ends"].items() if v))
            obs, info = one.reset()
        np.testing.assert_array_equal(obs, obs_b[0])
        np.testing.assert_array_equal(info["critic"], same.full[0])
    assert ended >= {"time"} and len(ended) > 1
    one.reset(options={"frame": 20})
    assert one.env.frame[0] == 20
    kept = obs.copy()
    one.step(np.zeros(33))
    np.testing.assert_array_equal(obs, kept)  # what was returned is not overwritten
    with pytest.raises(ValueError, match="phase; valid: frame"):
        one.reset(options={"phase": 1})
    with pytest.raises(ValueError, match="human"):
        gym_env.as_gymnasium(char, ref, render_mode="human")


def test_vector_is_the_environment(char, ref):
    """Same seed, same numbers as `Env`; autoreset in the same step, declared; nothing returned is overwritten."""
    many, same = gym_env.as_gymnasium(char, ref, 6, horizon=12, threads=1), Env(char, ref, 6, 3, 1, 12)
    assert isinstance(many, gymnasium.vector.VectorEnv) and many.num_envs == 6
    assert many.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    obs, info = many.reset(seed=3)
    np.testing.assert_array_equal(obs, same.reset(3)[0])
    assert obs in many.observation_space and many.action_space.shape == (6, 33)
    kept, truncations = [(obs, obs.copy())], 0
    for a in actions(6, 30):
        obs, reward, terminated, truncated, info = many.step(a)
        obs_b, reward_b, terminated_b, truncated_b, info_b = same.step(a)
        for x, y in ((obs, obs_b), (reward, reward_b), (terminated, terminated_b), (truncated, truncated_b)):
            np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(info["critic"], info_b["critic"])
        done = terminated | truncated
        np.testing.assert_array_equal(info["_final_obs"], done)
        assert ("final_obs" in info) == done.any()
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(info["final_obs"][i], info_b["final_obs"][i])
            assert np.abs(info["final_obs"][i] - obs[i]).max() > 1e-3  # obs is already the new episode's
        truncations += truncated.sum()
        kept += [(obs, obs.copy()), (info["critic"], info["critic"].copy())]
    assert truncations > 3
    for now, then in kept:
        np.testing.assert_array_equal(now, then)
    np.testing.assert_array_equal(many.reset(seed=3)[0], kept[0][1])
    many.reset(options={"frames": np.arange(20, 26)})
    np.testing.assert_array_equal(many.env.frame, np.arange(20, 26))
    with pytest.raises(ValueError, match="one integer"):
        many.reset(seed=[1, 2, 3, 4, 5, 6])
    with pytest.raises(ValueError, match="reset_mask; valid: frames"):
        many.reset(options={"reset_mask": np.ones(6, bool)})
    many.close()


def test_defaults(ref, monkeypatch):
    """A character may be given by name; the built-in motions are the default."""
    asked = []
    monkeypatch.setattr(data, "sequences", lambda *a: asked.append(a) or ["clips"])
    monkeypatch.setattr(retarget, "reference", lambda char, clips: asked.append((char.name, clips)) or ref)
    assert gym_env.as_gymnasium(n=2, threads=1).num_envs == 2
    assert asked == [("builtin", "train"), ("jesse", ["clips"])]


def test_wrappers(char, ref):
    """Gymnasium's own wrappers read the information."""
    wrappers, many = gymnasium.wrappers.vector, gym_env.as_gymnasium(char, ref, 4, horizon=5, threads=1)
    many = wrappers.DictInfoToList(wrappers.RecordEpisodeStatistics(many))
    many.reset(seed=0)
    episodes = 0
    for a in actions(4, 12):
        _, _, terminated, truncated, infos = many.step(a)
        for i, done in enumerate(terminated | truncated):
            assert set(infos[i]["terms"]) == set(character.TERMS) and ("final_obs" in infos[i]) == done
            if done:
                assert infos[i]["episode"]["l"] == infos[i]["length"]
                episodes += 1
    assert episodes > 4


@pytest.mark.skipif(render.gl_backend() is None, reason="no OpenGL: neither egl nor osmesa starts here")
def test_render(char, ref):
    one = gym_env.as_gymnasium(char, ref, render_mode="rgb_array")
    one.reset(seed=0)
    first = one.render()
    assert first.shape == (360, 480, 3) and first.dtype == np.uint8 and first.std() > 5
    for a in actions(1, 8):
        one.step(a[0])
    assert np.abs(one.render().astype(int) - first).max() > 30
    assert gym_env.as_gymnasium(char, ref).render() is None


def test_sb3_trains_on_both(char, ref):
    """Stable-Baselines3's PPO takes the batch and the single character, and its weights move."""
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (extra peers)")
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    sb3_check_env(gym_env.as_gymnasium(char, ref))
    batch = gym_env.as_sb3(gym_env.as_gymnasium(char, ref, 8, horizon=10, threads=1))
    for given, n in ((batch, 8), (gym_env.as_gymnasium(char, ref, horizon=10), 1)):
        model = sb3.PPO("MlpPolicy", given, n_steps=64 // n, batch_size=32, n_epochs=2, seed=0, device="cpu")
        before = [p.detach().clone() for p in model.policy.parameters()]
        model.learn(128)
        assert model.num_timesteps == 128
        assert any((a != b).any() for a, b in zip(before, model.policy.parameters()))
        assert len(model.ep_info_buffer) > 4 and all(e["l"] <= 10 for e in model.ep_info_buffer)


def test_sb3_sees_what_gymnasium_sees(char, ref):
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (extra peers)")
    batch = gym_env.as_sb3(gym_env.as_gymnasium(char, ref, 4, horizon=6, threads=1))
    same = gym_env.as_gymnasium(char, ref, 4, horizon=6, threads=1)
    batch.seed(5)
    np.testing.assert_array_equal(batch.reset(), same.reset(seed=5)[0])
    total, seen = np.zeros(4), 0
    for a in actions(4, 15):
        obs, reward, done, infos = batch.step(a)
        obs_b, reward_b, terminated, truncated, info = same.step(a)
        np.testing.assert_array_equal(obs, obs_b)
        np.testing.assert_allclose(reward, reward_b, rtol=1e-6)
        np.testing.assert_array_equal(done, terminated | truncated)
        total += reward_b
        for i in range(4):
            assert bool(infos[i]) == done[i]
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"] == truncated[i]
            assert infos[i]["episode"]["r"] == pytest.approx(total[i])
            total[i], seen = 0.0, seen + 1
    assert seen > 4


def test_without_gymnasium(char, ref, monkeypatch):
    monkeypatch.setattr(gym_env, "gymnasium", None)
    for make in (lambda: gym_env.as_gymnasium(char, ref), lambda: gym_env.as_gymnasium(char, ref, 4)):
        with pytest.raises(UserError, match=r"pip install -e '.\[gym\]'"):
            make()
    with pytest.raises(UserError, match=r"pip install -e '.\[gym\]'"):
        gym_env.make("Pendulum-v1")


# ------------------------------------------------------------------------------------ others' tasks for us


class Point(gymnasium.Env):
    """Go to the target on a line and stay.  Beyond 2 it fails; 12 steps are the limit."""

    observation_space = gymnasium.spaces.Dict(
        {"at": gymnasium.spaces.Box(-9, 9, (1,)), "to": gymnasium.spaces.Box(-9, 9, (1,))}
    )
    action_space = gymnasium.spaces.Box(-0.5, 0.25, (1,), np.float32)
    given, fault = [], None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.to = self.np_random.uniform(-1.5, 1.5, 2)
        return self.obs(), {}

    def obs(self):
        return {"at": np.array([self.x], np.float32), "to": np.array([self.to], np.float32)}

    def step(self, action):
        Point.given.append(action.copy())
        self.x += float(action[0]) if self.fault != "random" else np.random.default_rng().random()
        reward = np.exp(-4.0 * (self.x - self.to) ** 2) - 5.0 * (abs(self.x) > 2)
        if self.fault == "nan" and len(self.given) % 7 == 0:
            self.x = np.nan
        return self.obs(), reward, bool(abs(self.x) > 2), False, {}


@pytest.fixture(scope="module", autouse=True)
def point():
    gymnasium.register("Point-v0", entry_point=lambda: Point(), max_episode_steps=12)
    yield
    del gymnasium.registry["Point-v0"]


def test_interface(char, ref):
    """What `ppo.Trainer` uses is there in both, and means the same."""
    ours, theirs = Env(char, ref, 3, threads=1, horizon=5), gym_env.Task("Point-v0", 3)
    for e in (ours, theirs):
        e.reset(0)
        names = "name TERMS ENDS dt n obs_size critic_size action_size full reset step state load_state"
        assert all(hasattr(e, name) for name in names.split()) and e.full.shape == (3, e.critic_size)
        assert np.isfinite(e.value_scale(0.9))
        for _ in range(12):
            _, reward, terminated, truncated, info = e.step(np.zeros((3, e.action_size)))
            assert set(info["terms"]) == set(e.TERMS) and set(info["ends"]) == set(e.ENDS)
            np.testing.assert_array_equal(sum(info["ends"].values()), terminated | truncated)
            assert (info["length"] <= info["available"]).all() and reward.shape == (3,)
            if truncated.any():
                break
        assert truncated.any() and info["final_critic"].shape == e.full.shape
    assert ours.value_scale(0.9) == pytest.approx(sum(char.reward[t][0] for t in character.TERMS) / 0.1)
    assert set(theirs.stats()) == {"return_100"}


def test_task_is_the_task():
    """Against gymnasium.make by hand: clipped actions, the state before a reset, ends, returns of episodes."""
    task, same = gym_env.Task("Point-v0", 1, limit_ends=False), gymnasium.make("Point-v0")
    task.reset(4)
    same.reset(seed=4)
    flat = lambda o: np.concatenate([o["at"], o["to"]])  # noqa: E731
    np.testing.assert_array_equal(task.full[0], flat(same.reset()[0]))
    total, returns, ends = 0.0, [], []
    for a in actions(1, 300, 1, 0.6):
        Point.given.clear()
        before = a.copy()
        _, reward, terminated, truncated, info = task.step(a)
        np.testing.assert_array_equal(a, before)
        np.testing.assert_array_equal(Point.given[0], np.clip(a[0], -0.5, 0.25).astype(np.float32))
        obs, r, term, trunc, _ = same.step(np.clip(a[0], -0.5, 0.25).astype(np.float32))
        assert (reward[0], terminated[0], truncated[0]) == (r, term, trunc)
        total += r
        if term or trunc:
            np.testing.assert_array_equal(info["final_critic"][0], flat(obs))
            ends.append(next(k for k, v in info["ends"].items() if v[0]))
            assert info["length"][0] <= 12 == info["available"][0]
            returns, total, obs = [*returns, total], 0.0, same.reset()[0]
        np.testing.assert_array_equal(task.full[0], flat(obs))
    assert set(ends) == {"fail", "time"}
    assert task.stats()["return_100"] == pytest.approx(np.mean(returns[-100:]))
    ended = gym_env.Task("Point-v0", 2, limit_ends=True)
    ended.reset(0)
    for _ in range(12):
        _, _, terminated, truncated, _ = ended.step(np.zeros((2, 1)))
    assert terminated.all() and not truncated.any()
    with pytest.raises(ValueError, match="copy 1 is not finite"):
        ended.step(np.array([[0.0], [np.nan]]))


def test_reward_normalisation():
    """r / √(Var G), G the discounted return so far: by a slow loop over all that was."""
    plain, task = gym_env.Task("Point-v0", 3), gym_env.Task("Point-v0", 3, gamma=0.9, reward_norm=True)
    plain.reset(1), task.reset(1)
    g, seen = np.zeros(3), []
    for a in actions(3, 60, 1, 0.8):
        _, r, terminated, truncated, _ = plain.step(a)
        _, scaled, *_ = task.step(a)
        g = 0.9 * g + r
        seen += list(g)
        np.testing.assert_allclose(scaled, np.clip(r / np.sqrt(np.var(seen) + 1e-8), -10, 10), rtol=1e-9)
        g[terminated | truncated] = 0.0
    assert plain.stats() == task.stats() and np.abs(scaled).max() <= 10
    _, first, *_ = gym_env_first(reward_norm=True)
    assert np.abs(first).max() == 10.0  # one return has no spread


def gym_env_first(**settings):
    task = gym_env.Task("Point-v0", 1, **settings)
    task.reset(0)
    return task.step(np.zeros((1, 1)))


def test_unrepeatable_task(monkeypatch, capsys):
    """A task with randomness of its own is continued with new episodes, and a note says so."""
    monkeypatch.setattr(Point, "fault", "random")
    task = gym_env.Task("Point-v0", 2)
    task.reset(0)
    task.step(np.zeros((2, 1)))
    other = gym_env.Task("Point-v0", 2)
    other.load_state(*task.state())
    assert "Point-v0 does not repeat itself: copy 1" in capsys.readouterr().err
    assert not other.steps.any()
    arrays, meta = task.state()
    for name, value in (("full", np.zeros((3, 2), np.float32)), ("actions0", np.zeros((5, 1))), ("steps", np.ones(2))):
        with pytest.raises(ValueError, match=f"env.{name}"):
            other.load_state(arrays | {name: value}, meta)
    scaled = gym_env.Task("Point-v0", 2, reward_norm=True)
    scaled.reset(0)
    arrays_s, meta_s = scaled.state()
    with pytest.raises(ValueError, match="env.scale"):
        scaled.load_state(arrays_s | {"scale.m2": np.array([-1.0])}, meta_s)
    with pytest.raises(ValueError, match="1 episodes, expected 2"):
        other.load_state(arrays, meta | {"starts": meta["starts"][:1]})


# ------------------------------------------------------------------------------------ the peers


def test_train_sb3(tmp_path, capsys):
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (extra peers)")
    gym_env.main(["--task", "Point-v0", "--steps", "2048", "--json", str(tmp_path / "a.json")])
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["steps"] == 2048 and figures["episodes"] == 100 and -60 < figures["return_100"] < 12
    assert f"return_100 {figures['return_100']:.4g}" in capsys.readouterr().out

r"""Gymnasium, both ways: our characters as its environments, and its tasks as what our PPO learns.

    as_gymnasium      one character as a gymnasium.Env, or N of them as a gymnasium.vector.VectorEnv
    as_sb3            those N as a VecEnv of Stable-Baselines3, which takes no other
    Task              a continuous task of Gymnasium's with the interface of `env.Env`, for extras/cleanrl.py

`python -m extras.gym_env --task NAME` trains Stable-Baselines3's PPO on a task, to compare.

Gymnasium is the extra `gym`: without it this module can be imported, and says so when one of these is made.

[Huang22]   Huang et al., CleanRL: high-quality single-file implementations of deep reinforcement learning, JMLR 2022
"""

from __future__ import annotations

import functools
import hashlib
import json
import sys
import time
from collections import deque
from dataclasses import dataclass
from importlib import metadata

import mujoco
import numpy as np

import retarget
from character import Character, load
from env import Env
from mocap import data
from nn import RunningNorm
from plumbing.cli import NONNEGATIVE, POSITIVE, UserError, arg, cli, run_main
from plumbing.files import atomic_write
from plumbing.runs import rng_from_state, rng_state, versions

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv

    One = gymnasium.Env
except ImportError:
    gymnasium, One, VectorEnv = None, object, object

INSTALL = "python -m pip install -e '.[gym]'"
NO_SB3 = "stable-baselines3 is not installed: python -m pip install -e '.[peers]'"
REWARD_CLIP = 10.0  # of normalised rewards [Huang22]
RECENT = 100  # episodes in the mean return that is printed


def need_gymnasium():
    """UserError where the extra is missing.  Test: tests/extras/test_gym_env.py::test_without_gymnasium"""
    if gymnasium is None:
        raise UserError(f"gymnasium is not installed: {INSTALL}")


# ------------------------------------------------------------------------------------ our characters for others


def as_gymnasium(char="jesse", ref: retarget.Reference | None = None, n: int | None = None, **settings):
    """`env.Env` with Gymnasium's interface (extra `gym`): `OneCharacter`, or `Characters`.

    Args      char : a Character (`solved_by("pgs")`: a fifth faster), or what `character.load` takes
              ref : the motions, the built-in ones by default
              n : None for one character, a gymnasium.Env; a number for as many, a gymnasium.vector.VectorEnv
              settings : of `Env`: seed, threads, horizon, substeps, starts, disturbance, asymmetric, root_limit
    Raises    UserError: gymnasium is not installed, or no such character
    Test      tests/extras/test_gym_env.py::test_check_env, test_vector_is_the_environment
    """
    need_gymnasium()
    char = char if isinstance(char, Character) else load(char)
    if ref is None:
        ref = retarget.reference(char, data.sequences("builtin", "train"))
    return OneCharacter(char, ref, **settings) if n is None else Characters(char, ref, n, **settings)


def _spaces(env: Env):
    """Observation and action space of one character."""
    return (
        spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32),
        spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )


def _option(options, name):
    """What reset's options say, or None.  ValueError: another option"""
    if odd := set(options or {}) - {name}:
        raise ValueError(f"reset's options have {', '.join(sorted(map(str, odd)))}; valid: {name}")
    return (options or {}).get(name)


class OneCharacter(One):
    """One character as a gymnasium.Env: the actor's observation, torques in [−1, 1], the paper's reward.

    Who calls resets, at a random frame of the motions or at options={"frame": k}.  The same seed gives the same
    episodes as `Env` of one character.
    info has critic (the critic's observation), and after a step terms and ends by name, length, available.
    Args      char, ref, settings : as of `Env`; render_mode : None, or "rgb_array"
    Test      tests/extras/test_gym_env.py::test_check_env, test_one_is_the_environment, test_render
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, char, ref, render_mode=None, seed=0, **settings):
        need_gymnasium()
        self.env = Env(char, ref, 1, seed, autoreset=False, **{"threads": 1} | settings)
        self.observation_space, self.action_space = _spaces(self.env)
        self.render_mode, self.metadata = render_mode, self.metadata | {"render_fps": round(ref.rate)}
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; valid: None, 'rgb_array'")
        self._np_random, self._np_random_seed, self._scene = self.env.rng, seed, None

    def reset(self, *, seed=None, options=None):
        """A new episode.  -> observation (obs,) float32, info.  ValueError: options that are none"""
        super().reset(seed=seed)
        self.env.rng = self.np_random
        frame = _option(options, "frame")
        obs, info = self.env.reset(frames=None if frame is None else [frame])
        return obs[0].copy(), {"critic": info["critic"][0].copy()}

    def step(self, action):
        """One control step.  -> observation, reward, terminated, truncated, info"""
        obs, reward, terminated, truncated, info = self.env.step(np.asarray(action, float)[None])
        told = {
            "critic": info["critic"][0].copy(),
            "terms": {k: float(v[0]) for k, v in info["terms"].items()},
            "ends": {k: bool(v[0]) for k, v in info["ends"].items()},
        }
        told |= {k: int(info[k][0]) for k in ("length", "available")}
        return obs[0].copy(), float(reward[0]), bool(terminated[0]), bool(truncated[0]), told

    def render(self):
        """An image of the character, (H, W, 3) uint8; None without render_mode."""
        if self.render_mode is None:
            return None
        if self._scene is None:
            from plumbing import render

            shown = self.env.char.mjspec().compile()
            self._scene = shown, mujoco.MjData(shown), render.Scene(shown, 480, 360, camera="track")
        shown, data, scene = self._scene
        data.qpos[:] = self.env.qpos[0]
        mujoco.mj_forward(shown, data)
        return scene.frame(data)


class Characters(VectorEnv):
    """N characters as a gymnasium.vector.VectorEnv with autoreset in the same step, which metadata declares.

    Observations, rewards and ends are those of an `Env` of the same seed, copied.  info is as `Env.step` has it, and
    beside every key the mask _key that Gymnasium's wrappers look for; final_obs and final_critic stand where _final_obs
    is true.  reset's seed is one number; options={"frames": (N,)} starts at these.
    Args      char, ref, n, settings : as of `Env`
    Test      tests/extras/test_gym_env.py::test_vector_is_the_environment, test_wrappers
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP if gymnasium else None, "render_modes": []}

    def __init__(self, char, ref, n, seed=0, **settings):
        need_gymnasium()
        self.env, self.num_envs = Env(char, ref, n, seed, **settings), n
        self.single_observation_space, self.single_action_space = _spaces(self.env)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, n)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, n)
        self._np_random, self._np_random_seed = self.env.rng, seed

    def reset(self, *, seed=None, options=None):
        """Start all.  -> observations (N, obs) float32, info.  ValueError: a list of seeds, or options that are none"""
        if seed is not None and not isinstance(seed, int | np.integer):
            raise ValueError(f"seed is {seed!r}; valid: one integer, from which all characters' starts are drawn")
        super().reset(seed=seed)
        self.env.rng = self.np_random
        obs, info = self.env.reset(frames=_option(options, "frames"))
        return obs.copy(), self._masked({"critic": info["critic"].copy()})

    def step(self, actions):
        """One control step of all.  -> observations, rewards, terminations, truncations, info"""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        return obs.copy(), reward, terminated, truncated, self._masked(info | {"critic": info["critic"].copy()})

    def _masked(self, info):
        """info with a mask beside each key: all characters have it, but for what ended."""
        ended, every = info.get("_final_obs"), np.ones(self.num_envs, bool)
        out = {}
        for key, value in info.items():
            if not key.startswith("_"):
                out[key] = self._masked(value) if isinstance(value, dict) else value
                out["_" + key] = ended if key.startswith("final_") else every
        return out | ({} if ended is None else {"_final_obs": ended})


@functools.cache
def _vec_env():
    """The class that `as_sb3` makes: Stable-Baselines3 is imported when it is asked for."""
    try:
        from stable_baselines3.common.vec_env import VecEnv
    except ImportError:
        raise UserError(NO_SB3) from None

    class Batched(VecEnv):
        """`Characters` as Stable-Baselines3's VecEnv: one `done`, a dict of information for each character."""

        def __init__(self, characters: Characters):
            self.characters, self.began = characters, time.perf_counter()
            super().__init__(characters.num_envs, characters.single_observation_space, characters.single_action_space)

        def reset(self):
            obs, _ = self.characters.reset(seed=self._seeds[0])
            self._reset_seeds()
            self.total = np.zeros(self.num_envs)
            return obs

        def step_async(self, actions):
            self.actions = actions

        def step_wait(self):
            obs, reward, terminated, truncated, info = self.characters.step(self.actions)
            done, infos = terminated | truncated, [{} for _ in range(self.num_envs)]
            self.total += reward
            for i in np.flatnonzero(done):
                ran = {"r": self.total[i], "l": int(info["length"][i]), "t": time.perf_counter() - self.began}
                infos[i] = {"terminal_observation": info["final_obs"][i], "episode": ran}
                infos[i]["TimeLimit.truncated"] = bool(truncated[i])
            self.total[done] = 0.0
            return obs, reward.astype(np.float32), done, infos

        def close(self):
            self.characters.close()

        def get_attr(self, attr_name, indices=None):
            return [getattr(self.characters, attr_name) for _ in self._get_indices(indices)]

        def set_attr(self, attr_name, value, indices=None):
            setattr(self.characters, attr_name, value)

        def env_method(self, method_name, *args, indices=None, **kwargs):
            raise NotImplementedError(f"{method_name}: the characters are simulated together and have no methods each")

        def env_is_wrapped(self, wrapper_class, indices=None):
            return [False for _ in self._get_indices(indices)]

    return Batched


def as_sb3(characters: Characters):
    """The same N characters as a VecEnv, for Stable-Baselines3 (extra `peers`), which knows no VectorEnv.

    After a truncation it bootstraps, as we do: infos carry terminal_observation and TimeLimit.truncated.
    Raises    UserError: stable-baselines3 is not installed
    Test      tests/extras/test_gym_env.py::test_sb3_trains_on_both, test_sb3_sees_what_gymnasium_sees
    """
    return _vec_env()(characters)


# ------------------------------------------------------------------------------------ others' tasks for us


def make(task):
    """gymnasium.make, of a task with continuous actions.

    Raises    UserError: gymnasium, or what the task needs, is not installed; no such task; its actions or observations
              are no numbers
    Test      tests/extras/test_cleanrl.py::test_wrong_tasks"""
    need_gymnasium()
    try:
        made = gymnasium.make(task, disable_env_checker=True)
    except (gymnasium.error.Error, ImportError) as e:
        lacks = isinstance(e, (gymnasium.error.DependencyNotInstalled, ModuleNotFoundError)) and ":" not in str(task)
        valid = "valid: a task that gymnasium.make knows, as HalfCheetah-v4"
        raise UserError(f"{task}: {e}; {INSTALL if lacks else valid}") from None
    if not isinstance(made.action_space, spaces.Box) or len(made.action_space.shape) != 1:
        raise UserError(f"{task}: its actions are {made.action_space}; valid: a Box of one dimension")
    if not made.observation_space.is_np_flattenable:
        raise UserError(f"{task}: its observations are {made.observation_space}; valid: what can be flattened")
    return made


class Task:
    r"""N copies of a task of Gymnasium's, with that of `env.Env`'s interface that `ppo.Trainer` uses.

    Actions are clipped to the task's Box, after the policy has remembered what it drew.  An episode that ends begins
    anew in the same step; a time limit is a truncation, and the state before it is in info["final_critic"].
    Equation  with reward_norm  r ← clip(r / √(Var G + 1e-8), ±10),  G ← γ G + r, anew in each episode
    Args      task : Gymnasium's name; n : copies; seed : copy i is seeded with seed + i; gamma : for reward_norm
              limit_ends : a time limit counts as a failure (CleanRL's reading), and is not bootstrapped
    Source    the normalised reward: [Huang22]
    Test      tests/extras/test_gym_env.py::test_task_is_the_task, test_reward_normalisation,
              tests/extras/test_cleanrl.py::test_resume_is_exact
    """

    ENDS, TERMS = ("fail", "bad", "time"), ()

    def __init__(self, task, n=1, seed=0, gamma=0.99, reward_norm=False, limit_ends=False):
        self.name, self.n, self.gamma, self.limit_ends = str(task), n, gamma, limit_ends
        self.envs = [make(task) for _ in range(n)]
        one = self.envs[0]
        box, self.observation_space = one.action_space, one.observation_space
        self.low, self.high, self.dtype = box.low, box.high, box.dtype
        self.obs_size = self.critic_size = spaces.flatdim(self.observation_space)
        self.action_size = box.shape[0]
        self.dt = float(getattr(one.unwrapped, "dt", 1.0))
        self.limit = one.spec.max_episode_steps
        self.full = np.zeros((n, self.obs_size), np.float32)
        self.steps, self.total, self.discounted = np.zeros(n, int), np.zeros(n), np.zeros(n)
        self.scale = RunningNorm(1) if reward_norm else None
        self.recent = deque(maxlen=RECENT)  # returns of the latest episodes
        self.starts, self.actions = [None] * n, [[] for _ in range(n)]  # random state at an episode's start; since then
        self.seed = seed

    def value_scale(self, gamma):
        """The critic's output is the return itself: normalised rewards make it of order 1."""
        return 1.0

    def stats(self) -> dict:
        """return_100: mean return of the latest 100 episodes, as the task counts it."""
        return {"return_100": float(np.mean(self.recent)) if self.recent else float("nan")}

    def data(self) -> dict:
        """What decides how the task behaves.  Test: tests/extras/test_cleanrl.py::test_resume_is_exact"""
        versions = {name: metadata.version(name) for name in ("gymnasium", "mujoco")}
        mark = hashlib.sha256(repr((self.name, versions)).encode()).hexdigest()[:16]
        return {"fingerprint": mark, "task": self.name, "sequences": 0, "minutes": 0.0} | versions

    def reset(self, seed=None):
        """All copies anew.  -> observations (N, obs) float32, info"""
        for i, env in enumerate(self.envs):
            if seed is not None:
                env.reset(seed=seed + i)
            self._begin(i)
        return self.full, {"critic": self.full}

    def _begin(self, i):
        """A new episode of copy i; what it takes to repeat it is kept."""
        env = self.envs[i]
        self.starts[i], self.actions[i] = rng_state(env.unwrapped.np_random), []
        self.full[i] = self._flat(env.reset()[0])
        self.steps[i], self.total[i], self.discounted[i] = 0, 0.0, 0.0

    def _flat(self, obs):
        return obs.ravel() if isinstance(obs, np.ndarray) else spaces.flatten(self.observation_space, obs)

    def step(self, action):
        """As `Env.step`: observations of the new episode where one ended, info["final_critic"] before that.

        A reward or an observation that is not finite ends the episode as a failure.
        Raises    ValueError: an action is not finite
        Test      tests/extras/test_gym_env.py::test_task_is_the_task,
                  tests/extras/test_cleanrl.py::test_non_finite_task"""
        if not np.isfinite(action).all():
            raise ValueError(f"action of copy {int(np.argmin(np.isfinite(action).all(1)))} is not finite")
        clipped = np.clip(action, self.low, self.high).astype(self.dtype)  # only the task sees clipped actions
        reward, terminated, truncated, bad = np.zeros(self.n), *(np.zeros(self.n, bool) for _ in range(3))
        for i, env in enumerate(self.envs):
            self.actions[i].append(clipped[i])
            obs, reward[i], terminated[i], truncated[i], _ = env.step(clipped[i])
            obs = self._flat(obs)
            bad[i] = not (np.isfinite(obs).all() and np.isfinite(reward[i]))
            if not bad[i]:
                self.full[i] = obs
        reward[bad] = 0.0
        self.steps += 1
        self.total += reward
        terminated |= bad | (truncated if self.limit_ends else False)
        truncated &= ~terminated
        ends = {"fail": terminated & ~bad, "bad": bad, "time": truncated}
        if self.scale is not None:
            self.discounted = self.gamma * self.discounted + reward
            self.scale.update(self.discounted[:, None])
            reward = np.clip(reward / np.sqrt(self.scale.var + self.scale.eps), -REWARD_CLIP, REWARD_CLIP)
        available = np.full(self.n, self.limit) if self.limit else self.steps.copy()
        info = {"terms": {}, "ends": ends, "length": self.steps.copy(), "available": available}
        done = np.flatnonzero(terminated | truncated)
        if len(done):
            info["final_critic"] = self.full.copy()
            for i in done:
                self.recent.append(float(self.total[i]))
                self._begin(i)
        info["critic"] = self.full
        return self.full, reward, terminated, truncated, info

    # ---- exact resume

    def state(self) -> tuple[dict, dict]:
        """Arrays and JSON that `load_state` continues from.

        A task says nothing of its state, but repeats itself: each episode's random state and the actions since.
        Test      tests/extras/test_cleanrl.py::test_resume_is_exact"""
        arrays = {k: getattr(self, k).copy() for k in ("full", "steps", "total", "discounted")}
        arrays |= {f"actions{i}": np.reshape(a, (-1, self.action_size)) for i, a in enumerate(self.actions)}
        if self.scale is not None:
            arrays |= {f"scale.{k}": v for k, v in self.scale.state().items()}
        return arrays, {"starts": list(self.starts), "recent": list(self.recent)}

    def load_state(self, arrays, meta):
        """Continue from what `state` returned: the present episode is played again, with the same actions.

        A task that then is elsewhere does not repeat itself (it has randomness of its own): its copy begins a new
        episode, and a note says so.
        Raises    ValueError: another task's state
        Test      tests/extras/test_cleanrl.py::test_resume_is_exact,
                  tests/extras/test_gym_env.py::test_unrepeatable_task"""
        for name in ("full", "steps", "total", "discounted"):
            have, need = arrays[name], getattr(self, name)
            if have.shape != need.shape or have.dtype.kind != need.dtype.kind or not np.isfinite(have).all():
                raise ValueError(f"env.{name} is {have.dtype} {have.shape}, expected finite {need.dtype} {need.shape}")
        if len(meta["starts"]) != self.n or not all(type(r) in (int, float) for r in meta["recent"]):
            raise ValueError(f"env: {len(meta['starts'])} episodes, expected {self.n}; or returns that are no numbers")
        if self.scale is not None:
            scale = {k: arrays[f"scale.{k}"] for k in ("count", "mean", "m2")}
            if scale["count"].min() < 0 or not np.all(scale["m2"] >= 0):
                raise ValueError("env.scale holds no count and sum of squares")
            self.scale.load_state(scale)
        self.recent = deque(meta["recent"], RECENT)
        for i, env in enumerate(self.envs):
            actions = arrays[f"actions{i}"]
            if actions.shape != (arrays["steps"][i], self.action_size) or not np.isfinite(actions).all():
                raise ValueError(f"env.actions{i} has shape {actions.shape}, expected as many as steps")
            env.reset(seed=0)
            env.unwrapped.np_random = rng_from_state(meta["starts"][i])
            self._begin(i)
            for a in actions.astype(self.dtype):
                self.actions[i].append(a)
                self.full[i] = self._flat(env.step(a)[0])
            if np.array_equal(self.full[i], arrays["full"][i]):
                self.steps[i], self.total[i], self.discounted[i] = (
                    arrays[k][i] for k in ("steps", "total", "discounted")
                )
            else:
                print(f"note: {self.name} does not repeat itself: copy {i} begins a new episode", file=sys.stderr)
                self._begin(i)
        return self.full, {"critic": self.full}


# ------------------------------------------------------------------------------------ the peer, on the same task


@dataclass
class Options:
    """What `python -m extras.gym_env` can be told."""

    task: str = arg("HalfCheetah-v4", "a continuous task of Gymnasium's")
    steps: int = arg(1_000_000, "steps to train", check=POSITIVE)
    seed: int = arg(0, "seed of everything random", check=NONNEGATIVE)
    json: str | None = arg(None, "write the figures here")


def train_sb3(opt: Options) -> dict:
    """Stable-Baselines3's PPO with its own defaults, observations and rewards normalised, on one copy of a task.

    Returns   return_100 : mean return of the latest 100 episodes of training, as of `Task.stats`; steps_per_s
    Raises    UserError: stable-baselines3 is not installed, or as of `make`
    Test      tests/extras/test_gym_env.py::test_train_sb3
    """
    try:
        from stable_baselines3 import PPO
        from stable_baselines3.common.monitor import Monitor
        from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
    except ImportError:
        raise UserError(NO_SB3) from None
    envs = VecNormalize(DummyVecEnv([lambda: Monitor(gymnasium.wrappers.FlattenObservation(make(opt.task)))]))
    model, began = PPO("MlpPolicy", envs, seed=opt.seed, device="cpu"), time.perf_counter()
    model.learn(opt.steps)
    returns = [e["r"] for e in model.ep_info_buffer]
    return {
        "task": opt.task, "seed": opt.seed, "steps": model.num_timesteps, "episodes": len(returns),
        "return_100": float(np.mean(returns)), "steps_per_s": model.num_timesteps / (time.perf_counter() - began),
    }  # fmt: skip


def main(argv=None):
    """Train Stable-Baselines3's PPO on a task, to compare.  Test: tests/extras/test_gym_env.py::test_train_sb3"""
    opt = cli(Options, argv, "extras.gym_env", "Stable-Baselines3 on a task, to compare `extras.cleanrl` with.")
    figures = train_sb3(opt)
    print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in figures.items()))
    if opt.json:
        atomic_write(opt.json, json.dumps(figures | {"versions": versions()}, indent=2) + "\n")


if __name__ == "__main__":
    run_main(main)

r"""The policy: actor, critic, noise, and the normaliser of what they see; save and load  [Reda23 §3.1, §3.7].

    observation ──► normaliser ──► actor ──► mean action μ ──► N(μ, diag σ²)     σ is the same for all observations
                              └──► critic ──► V, which also sees the human [§3.3]

A policy's file holds the weights and the normaliser, and says which character it was trained for, and on what.
"""

from __future__ import annotations

import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

import character
from character import Character, Switches
from env import SENSORS
from nn import ACTIVATIONS, MLP, RunningNorm
from plumbing.cli import UserError
from plumbing.runs import CHECKPOINT, latest_checkpoint, load_checkpoint

STUB = (8, 8)  # hidden layers of the critic in a file that is only to be watched (`extras.arms.ship`): nothing asks it
WEIGHT_LIMIT, NORM_LIMIT = 1e6, 1e30  # no weight of a policy, no sum of its normaliser is larger: float32 stays finite


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

    def value(self, x, rows=4096):
        """V of normalised critic observations (B, critic_size) -> (B,) float64; by `rows` at a time, for the caches."""
        parts = [self.critic(x[i : i + rows])[:, 0] for i in range(0, len(x), rows)]
        return np.concatenate(parts).astype(float) * self.value_scale

    def arrays(self):
        """All that makes the policy, for a checkpoint.  Test: tests/test_policy.py::test_policy_round_trip"""
        norm = {f"policy.norm.{k}": v for k, v in self.norm.state().items()}
        return {"policy.pi": self.theta_pi.copy(), "policy.critic": self.critic.theta.copy(), **norm}

    def shape(self):
        """Sizes and kind of the networks, for a checkpoint."""
        return {
            "obs_size": self.obs_size,
            "critic_size": self.critic_size,
            "action_size": self.action_size,
            "hidden": list(self.hidden),
            "value_hidden": list(self.value_hidden),
            "value_scale": self.value_scale,
            "activation": self.activation,
        }

    def with_critic(self, value_hidden, rng) -> Policy:
        """The same actor with a new critic of such layers.  Test: tests/extras/test_arms.py::test_ship"""
        out = Policy(sigma=1.0, rng=rng, **self.shape() | {"value_hidden": value_hidden})
        out.load(self.arrays() | {"policy.critic": out.critic.theta})
        return out

    def summary(self) -> str:
        """Inputs, actions and weights, for a run's first line."""
        inputs = f"{self.obs_size} observations ({self.critic_size} for the critic), {self.action_size} actions"
        return f"{inputs}; policy {self.actor.n_params:,} and critic {self.critic.n_params:,} weights"

    def load(self, arrays):
        """Take over what `arrays` returned.

        Raises    ValueError: other sizes, or no numbers
        Test      tests/test_policy.py::test_broken_policies"""
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


# ------------------------------------------------------------------------------------ files


def load_policy(path) -> tuple[Policy, dict]:
    """Read a policy from a run folder, or from a checkpoint's or shipped policy's .npz.

    Returns   Policy with the normaliser frozen; meta with "options", "steps" and what else was saved
    Raises    UserError: missing, damaged, or not a policy
    Test      tests/test_policy.py::test_policy_round_trip, test_broken_policies
    """
    path = Path(path)
    names = ("policy.pi", "policy.critic", "policy.norm.mean", "policy.norm.m2")
    loaded = latest_checkpoint(path, names) if path.is_dir() else load_checkpoint(path, names)
    if loaded is None:
        raise UserError(f"{path}: holds no checkpoint; valid: a run folder with {CHECKPOINT}, or a policy's .npz")
    arrays, meta = loaded
    try:
        shape = _checked_shape(meta["policy"], arrays)
        policy = Policy(sigma=1.0, rng=None, **shape)
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


# ------------------------------------------------------------------------------------ what a file says of itself


def check_fits(policy: Policy, env, path):
    """UserError if a policy was trained for another character or another observation than the environment's.

    Test      tests/test_policy.py::test_policy_round_trip,
              tests/headset/test_stream.py::test_policy_of_another_character"""
    have, need = (policy.obs_size, policy.action_size), (env.obs_size, env.action_size)
    if have != need:
        whose = anothers(load_policy(path)[1], path, env.name) if Path(path).exists() else []
        raise UserError(
            f"{path}: {''.join(f'{w}, ' for w in whose)}a policy of {have[0]} observations and {have[1]} actions; "
            f"{env.name} needs {need[0]} and {need[1]}: use the character it was trained for"
        )


def check_exact(policy: Policy, meta, path, opt, env):
    """UserError unless a policy can go on as it is: the same character, and sizes of all layers.

    Args      opt : character, hidden, value_hidden of the run; env : the sizes of its observations and actions
    Test      tests/test_ppo.py::test_init_fine_tunes, test_init_points_to_carry"""
    names = ("obs_size", "critic_size", "action_size", "hidden", "value_hidden")
    need = {name: getattr(env if name.endswith("size") else opt, name) for name in names}
    odd = [f"{k} {getattr(policy, k)}, not {need[k]}" for k in names if getattr(policy, k) != need[k]]
    if odd := [*anothers(meta, path, opt.character), *odd]:
        raise misfit(path, opt.character, odd)


def anothers(meta, path, character) -> list[str]:
    """What to say of a policy that is another character's; nothing where it is this one's, or names none.

    Test      tests/test_ppo.py::test_init_points_to_carry"""
    own = trained_as(meta, path)
    return [f"it is {Path(own.character).stem}'s"] if own and Path(own.character).stem != Path(character).stem else []


def misfit(path, character, odd) -> UserError:
    """The error of a policy that does not fit, with the command that makes one that does.

    Test      tests/test_ppo.py::test_init_points_to_carry"""
    make = f"python -m extras.policies carry {path} NEW.npz --character {character}"
    return UserError(f"{path}: does not fit {Path(character).stem}: {'; '.join(odd)}; this makes one that does: {make}")


def initial(path, opt, env) -> tuple[Policy, int]:
    """A policy to go on from, and the steps that it has seen: no σ below the run's, V in the environment's scale.

    A file that is only to be watched has a stub of a critic; the run begins with a new one.
    Args      opt : of the run (`check_exact`), with gamma, min_sigma and seed
    Raises    UserError: of another character, or other sizes
    Test      tests/test_ppo.py::test_init_fine_tunes, test_init_says_what_differs,
              tests/extras/test_arms.py::test_ship"""
    policy, meta = load_policy(path)
    if policy.value_hidden == STUB != tuple(opt.value_hidden):
        policy = policy.with_critic(opt.value_hidden, np.random.default_rng([opt.seed, 2]))
        print(f"{path}: has no critic, to be small; begins with a new one")
    check_exact(policy, meta, path, opt, env)
    if notes := trained_otherwise(meta, opt):
        print(f"note: {path}: {'; '.join(notes)}")
    policy.norm.frozen, policy.value_scale = False, env.value_scale(opt.gamma)
    np.maximum(policy.log_std, np.log(opt.min_sigma), out=policy.log_std)
    return policy, total_steps(meta)


def shown_ahead(meta) -> dict:
    """λ and μ of `extras.policies.led` as a policy's file says, those that are not 0: {"lead": …, "damping": …}.

    Test      tests/extras/test_policies.py::test_led_by_command"""
    return {k: v for k in ("lead", "damping") if isinstance(v := meta.get(k), (int, float)) and v}


def flags_of(options) -> str:
    """{"lead": 0.08} -> "--lead 0.08".  Test: tests/extras/test_policies.py::test_join_command"""
    return " ".join(f"--{k} {v:g}" for k, v in options.items())


LEARNT = ("gamma", "root_limit", "root_lag", "near", "sigma", "min_sigma")  # options that --init does not bring


def trained_otherwise(meta, opt) -> list[str]:
    """What a run that goes on from a policy does not do as the policy was trained, with the flags that would.

    Args      meta : of the policy's file; opt : of the run
    Test      tests/test_ppo.py::test_init_says_what_differs"""
    before, flags = meta.get("options"), []
    before = before if isinstance(before, dict) else {}
    for name in LEARNT:
        if hasattr(opt, name) and before.get(name) not in (None, getattr(opt, name)):
            flags.append(f"--{name.replace('_', '-')} {before[name]}")
    tight = lambda change: "".join(str(change).split())  # noqa: E731
    asked = {tight(change) for part in parted(getattr(opt, "set", None)) for change in part}
    changes = meta.get("reward") or sum(parted(before.get("set")), [])
    if odd := [change for change in changes if tight(change) not in asked]:
        flags.append(f'--set "{"; ".join(map(str, odd))}"')
    notes = [f"was trained with {' '.join(flags)}, which this run has not"] if flags else []
    if ahead := {k: -v for k, v in shown_ahead(meta).items()}:
        back = f"python -m extras.policies ship IN OUT {flags_of(ahead)}"
        notes.append(f"is shown the user ahead, which a run unlearns: {back}")
    return notes


def widths(path, character) -> dict:
    """The hidden layers of a policy's two networks, by the names of the options; not those of a stub.

    Raises    UserError: it is another character's, which is said here, before motions are read
    Test      tests/test_ppo.py::test_init_brings_its_widths, test_init_points_to_carry"""
    policy, meta = load_policy(path)
    if odd := anothers(meta, path, character):
        raise misfit(path, character, odd)
    critic = {} if policy.value_hidden == STUB else {"value_hidden": policy.value_hidden}
    return {"hidden": policy.hidden} | critic


def trained_as(meta, path) -> Switches | None:
    """Which character, with which variation, a policy was trained for; None where its file names none.

    Raises    UserError: its options are damaged
    Test      tests/test_play.py::test_character_of_the_policy"""
    options = meta.get("options")
    if not isinstance(options, dict) or "character" not in options:
        return None
    found = {f.name: options.get(f.name, f.default) for f in fields(Switches)}
    found["scale"] = 1.0 if found["scale"] is None else found["scale"]
    texts = [found["character"], found["tail"] or "", found["set"] or ""]
    if not all(isinstance(t, str) for t in texts) or type(found["scale"]) not in (int, float) or not found["scale"] > 0:
        raise UserError(f"{path}: its options name no character: {str(found)[:200]}; valid: what ppo.py wrote")
    return Switches(**found)


def sensors_of(meta, path) -> str:
    """What a policy was trained to see, "full" or "hmd".  UserError: its options say something else

    Test      tests/test_policy.py::test_sensors_of_a_policy"""
    options = meta.get("options", {})
    found = options.get("sensors", "full") if isinstance(options, dict) else options
    if found not in SENSORS:
        raise UserError(f"{path}: its options have sensors {str(found)[:80]!r}; valid: {', '.join(SENSORS)}")
    return found


def total_steps(meta) -> int:
    """Control steps that a policy has seen, those of the policies that it went on from with --init included.

    Test      tests/extras/test_policies.py::test_ship"""
    return sum(meta[k] for k in ("steps", "before") if type(meta.get(k)) is int)


# ------------------------------------------------------------------------------------ which policy is meant


def find_policy(opt):
    """The policy named, or the shipped one, its path and what its file says; UserError says how to make one."""
    name = Path(opt.character or "jesse")
    shipped = name.with_suffix(".npz") if name.suffix == ".toml" else character.CHARACTERS / f"{name}.npz"
    path = Path(opt.policy) if opt.policy else shipped
    if not path.exists():
        character.load(str(name))  # a wrong name, or a broken character, is the better complaint
        make = f"python ppo.py --character {name} --out runs/a"
        raise UserError(f"no policy {path}: train one ({make}), then --policy runs/a")
    policy, meta = load_policy(path)
    return policy, path, meta


def load_character(opt, meta, path) -> Character:
    """The character that the flags ask for; where they ask for nothing, the policy's own with its variation.

    A flag changes that one thing; another character has none of the policy's variations.  A note on stderr says where
    the policy has not learnt to move what it is given: sizes agree where limbs and postures do not.
    Test      tests/test_play.py::test_character_of_the_policy, test_note_on_another_body"""
    known = trained_as(meta, path)
    own = known or Switches()
    base = own if opt.character in (None, own.character) else Switches(opt.character)
    given = {k: v for k in ("tail", "scale", "set") if (v := getattr(opt, k)) != getattr(Switches(), k)}
    asked = replace(base, **given)
    if known and body_of(asked) != body_of(own):
        now, then = (" ".join(f"--{k} {v}" for k, v in body_of(s).items()) or "no changes" for s in (asked, own))
        print(f"note: {path} was trained with {then}, and is played with {now}", file=sys.stderr)
    return asked.load()


def parted(changes) -> tuple[list[str], list[str]]:
    """The changes of --set: those of the body, and those of the reward, which it plays without.

    Test      tests/extras/test_policies.py::test_ship_names_the_reward"""
    each = [c.strip() for c in (changes or "").split(";") if c.strip()]
    return [c for c in each if not c.startswith("reward")], [c for c in each if c.startswith("reward")]


def body_of(switches: Switches) -> dict:
    """What flags change in a body: --tail, --scale, and of --set what is no weight of a reward.

    Test      tests/test_play.py::test_note_on_another_body"""
    changes = "; ".join(sorted(c for c in parted(switches.set)[0] if c.split(".")[0] not in ("training", "metrics")))
    found = {"tail": (switches.tail, "active"), "set": (changes, ""), "scale": (switches.scale, 1.0)}
    return {name: value for name, (value, usual) in found.items() if value not in (None, usual)}


def devices_of(meta, path, sensors: str | None) -> int:
    """How many devices a policy was trained with, 3 or 1.  UserError: fewer than `sensors` "full" asks for

    Test      tests/test_play.py::test_headset_only"""
    devices = 1 if sensors_of(meta, path) == "hmd" else 3
    if devices == 1 and sensors == "full":
        raise UserError(f"{path}: was trained with the headset alone: leave out --sensors, or give --sensors hmd")
    return devices

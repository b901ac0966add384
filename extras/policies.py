r"""Policies made of policies: shipped, averaged, joined, carried over to another body.

    python -m extras.policies ship RUN OUT.npz                         the policy of a run, with its data's licence
    python -m extras.policies blend OUT.npz A B … --share 0.3          A's weights averaged with those of the others
    python -m extras.policies ship OLD.npz NEW.npz --lead 0.07 --damping 0.1
                                                                       is shown its user ahead, farther where the user
                                                                       is faster than it: is less late
    python -m extras.policies join OUT.npz A B --motors 'elbow_*'      one network of two: A's elbows, all else B's
    python -m extras.policies join OUT.npz A B --backwards 0.15        or B where headset and root go backwards
    python -m extras.policies join OUT.npz A B --faster 1.5            or B where they go forwards, faster
    python -m extras.policies carry OLD.npz NEW.npz --character dino   to go on with as another character, another
                                                                       variation, with other sensors or wider layers

Each has flags of its own: `python -m extras.policies join --help`.  `carry` keeps what both have names for, and what an
action did: where the limit or the spring of a joint has changed, the same torque is asked for.  `ppo.py --init NEW.npz`
then goes on from it, as from what `join` made.

[Jacobs91]    Jacobs et al., Adaptive mixtures of local experts, Neural Computation 1991
[Wortsman22]  Wortsman et al., Model soups: averaging weights of multiple fine-tuned models, ICML 2022
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

import character
from character import Character
from env import SENSORS, WITHOUT, observation_terms
from headset.player import Player, stream_of
from mocap import data
from mocap.data import CONTROL_RATE
from nn import LEAKY_SLOPE, MLP, RunningNorm
from plumbing.cli import ALL_POSITIVE, POSITIVE, UNIT, UserError, arg, cli, given_flags, run_main, some_of, words_first
from plumbing.files import check_folders
from plumbing.runs import fmt_count, git_state, save_checkpoint, versions
from policy import (
    Policy,
    devices_of,
    flags_of,
    load_policy,
    parted,
    sensors_of,
    shown_ahead,
    total_steps,
    trained_as,
)

GATE = dict(width=0.1, depth=10.0, scale=3.0)  # of `gated`: m/s; how far units are put off; a unit's size.  ASSUMED
RUN_WIDTH = 0.4  # m/s, of the gate to an expert of runs: a runner's speed swings in every step.  ASSUMED
ROOT_SHARE = 0.8  # of the speed that opens it: the character's own, the rest the headset's.  ASSUMED (RESULTS.md)
LEADS = (lambda v: abs(v) <= 0.5, "from -0.5 to 0.5 s")
SPEEDS = (lambda v: 0.0 < v <= 5.0, "above 0, at most 5 m/s")
SIGMA = 0.135  # exploration noise of a policy that goes on as another character, where that one's recipe has none

# ------------------------------------------------------------------------------------ ship, blend


def blended(policy: Policy, others: list[Policy], share: float) -> Policy:
    r"""A policy's weights averaged with those of its ancestor, or of others that were fine-tuned from the same one.

    Equation  theta = (1 - s) theta + s mean(theta'), and so the normaliser's means and variances  [Wortsman22, "model
              soups"]; the critic stays as it is if one of the others was trained with another reward
    Why       what was learnt lately on some motions and what was known before on others are both kept: such policies
              lie in one valley, and its middle is lower than its slopes (measured)
    Args      share : s, of the others together
    Returns   policy, changed
    Raises    ValueError: networks of other sizes
    Test      tests/extras/test_policies.py::test_blended
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


def led(policy: Policy, char: Character, devices=3, *, lead=0.0, damping=0.0) -> Policy:
    r"""A policy that is shown its user as far ahead as the headset goes in so many seconds; by its first layer alone.

    Equation  p'_t = p_t + d, p'_{t-1} = p_{t-1} + d of every device, d = λ v_t + μ (v_t - v_root), horizontally,
              v_t = (h_t - h_{t-1}) / Δt: o' = o + S o is linear in the observation, so W(x(o')) + b is W' x(o) + b';
              d has none of itself in it, S² = 0, so -λ, -μ is the inverse
    Symbols   λ lead, μ damping [s]; h the headset's position, v_root the root's linear velocity at t, in its
              heading's frame as all of o; x the normalised observation, of which the clipping is left aside
    Why       a policy trained by Table 2's kernel of links, 0.95 at 9 cm, follows its user 8 to 10 cm late: asked to
              be where the user will be, it is where the user is (measured).  That is right while both go as fast.  In
              turns, starts and stops they do not, and μ tells of it a step before a distance does, as the derivative's
              part of a PD controller.  PPO that goes on by that kernel takes it back, 1 cm in 2 to 4 M steps; by a
              sharper one it keeps it (RESULTS.md)
    Returns   policy, changed
    Test      tests/extras/test_policies.py::test_led
    """
    names, norm, w = input_names(char, devices, False), policy.norm, policy.actor.params
    inverse, mean, step = norm.inv_std.astype(float), norm.mean.astype(float), (lead + damping) * CONTROL_RATE
    for axis in "xy":
        now, before, root = (names.index(n + axis) for n in ("user.h.", "user_previous.h.", "qd.v"))
        moved = [names.index(f"{t}.{d}.{axis}") for t in ("user", "user_previous") for d in "hlr"[:devices]]
        answer = inverse[moved] @ w["W0"][moved].astype(float)  # of the first layer to a metre
        for k, metres in ((now, step), (before, -step), (root, -damping)):
            w["W0"][k] += metres * answer / inverse[k]
            w["b0"][:] += metres * answer * mean[k]
    return policy


def _body(meta, path) -> tuple:
    """Which body a policy was trained with: the character and its variation, rewards left out; () of none named."""
    own = trained_as(meta, path)
    if own is None:
        return ()
    return Path(own.character).stem, own.tail, own.scale, *sorted(set(parted(own.set)[0]))


TRAINED = "weights trained on "


def each_once(licences) -> str:
    """The terms of several policies in one line: each once, and no set as one of unknown terms whose terms are known.

    Test      tests/extras/test_policies.py::test_each_once"""
    joint = f"; {TRAINED}"
    terms = dict.fromkeys(term for line in licences for term in line.replace(joint, f"\n{TRAINED}").split("\n"))
    known = {term.split(", licensed: ")[0] for term in terms if not term.endswith(data.UNKNOWN)}
    return "; ".join(t for t in terms if not (t.endswith(data.UNKNOWN) and t.split(", licensed: ")[0] in known))


def pairs_of(experts) -> list[tuple[str, str]]:
    """PATTERN=POLICY, … of `extras.teacher`, each parted; the policy is "" where there is none.

    Test      tests/extras/test_policies.py::test_ship"""
    parted = [str(one).partition("=") for one in experts or ()]
    return [(pattern, path) for pattern, _, path in parted]


def sets_of(options) -> list[str]:
    """The data sets of a run: its motions and its players."""
    return data.parts(str(options["motion"])) + ([str(options["players"])] if options.get("players") else [])


def licences_of(meta, path, way=()) -> list[str]:
    """The terms of a policy's weights, none for MIT: its own licence; without one, those of its data sets and of the
    policies that it began from and copied.

    Args      path : of the policy, for the message; way : the files that led here, so that a circle ends
    Test      tests/extras/test_policies.py::test_licences_of_ancestors"""
    if "licence" in meta:  # was shipped before
        return [str(meta["licence"])] if meta["licence"] != "MIT" else []
    name = Path(path).name
    try:
        options = meta["options"]
        out = [TRAINED + text for text in data.licences(sets_of(options))]
        ancestors = [options.get("init"), *(file for _, file in pairs_of(options.get("expert")))]
    except (KeyError, TypeError, AttributeError, UserError):
        return [f"{TRAINED}what {name} was, licensed: unknown: {name} is gone, or does not say"]
    for file in filter(None, ancestors):
        where = Path(str(file)).resolve()
        its = {} if where in way else meta_of(where)  # in a circle one was replaced
        out += licences_of(its, where, (*way, where))
    return out


def meta_of(path) -> dict:
    """What a policy's file says; {} if it cannot be read."""
    try:
        return load_policy(path)[1]
    except UserError:
        return {}


def ship(run, path, blend=(), share=0.5, gain=1.0, lead=0.0, damping=0.0) -> dict:
    """Write a run's policy for others to play: weights, normaliser, how it was trained, its data's licence.

    Args      blend : policies to average it with (`blended`), share : of them together
              gain : the normaliser's deviations are divided by it.  Averaging shrinks weights where policies differ,
              and with them the answer to a deviation; a gain of some per cent gives it back (measured)
              lead, damping : λ, μ of `led` [s]
    Returns   what was written beside the weights
    Raises    UserError: the run has no checkpoint, a policy does not fit, or the path cannot be written
    Test      tests/extras/test_policies.py::test_ship, test_blended
    """
    policy, meta = load_policy(run)
    loaded = [load_policy(p) for p in blend]
    try:
        own = _body(meta, run)
        if odd := [str(p) for p, (_, m) in zip(blend, loaded, strict=True) if _body(m, p) != own]:
            raise ValueError(f"{', '.join(odd)}: another body or pose than {own}")
        policy = blended(policy, [p for p, _ in loaded], share) if blend else policy
    except ValueError as e:
        raise UserError(f"blend {run} {' '.join(map(str, blend))}: {e}; valid: policies of one ancestor") from None
    try:
        sets, _, _, _ = sets_of(meta["options"]), meta["options"]["init"], meta["steps"], meta["data"]
    except (KeyError, TypeError) as e:
        raise UserError(f"{run}: does not say how it was trained ({e}); valid: a folder that ppo.py wrote") from None
    licences = licences_of(meta, run)
    for p, (_, its) in zip(blend, loaded, strict=True):
        licences += licences_of(its, p)
    kept = {"policy": meta["policy"], "steps": total_steps(meta), "data": meta["data"]}
    kept["options"] = meta["options"] | {"motion": ",".join(map(data.set_name, sets)), "out": None, "init": None}
    kept["options"] |= {"players": None}  # among the motions now
    body, reward = parted(meta["options"].get("set"))
    kept["options"] |= {"set": "; ".join(body) or None}
    reward = sorted({*reward, *meta.get("reward", ())})
    kept |= {"reward": reward} if reward else {}
    if experts := pairs_of(meta["options"].get("expert")):  # a policy's name, no folder of this machine
        kept["options"]["expert"] = [f"{pattern}={Path(file).name}" for pattern, file in experts]
    policy.norm.load_state(policy.norm.state() | {"m2": policy.norm.m2 / gain**2})
    ahead = {"lead": lead, "damping": damping}
    if any(ahead.values()):
        policy = led(policy, trained_as(meta, run).load(), devices_of(meta, run, None), **ahead)
    for k in ahead:
        before = [m.get(k, 0.0) for m in (meta, *(its for _, its in loaded))]  # in the weights, and averaged with them
        ahead[k] += before[0] if not blend else (1.0 - share) * before[0] + share * float(np.mean(before[1:]))
    gain *= meta.get("gain", 1.0)
    kept |= ({"gain": gain} if gain != 1.0 else {}) | shown_ahead({k: round(v, 4) for k, v in ahead.items()})
    kept |= {k: meta[k] for k in ("carried", "blend", "joined") if k in meta}
    if blend:
        kept["blend"] = {"with": [Path(p).name for p in blend], "share": share}
    kept |= {"licence": each_once(licences) or "MIT", "versions": versions(), "git": git_state()}
    save_checkpoint(path, policy.arrays(), kept)
    return kept


# ------------------------------------------------------------------------------------ join


def with_hidden(policy: Policy, hidden) -> Policy:
    """A policy with another's critic, normaliser and σ; its actor has such hidden layers, whose weights are to be set.

    Test      tests/extras/test_policies.py::test_joined, test_gated"""
    sizes = policy.obs_size, policy.critic_size, policy.action_size, hidden, policy.value_hidden
    rng, dtype = np.random.default_rng(0), policy.theta_pi.dtype
    out = Policy(*sizes, 1.0, policy.value_scale, rng, dtype, policy.activation)
    out.log_std[:] = policy.log_std
    out.critic.theta[:] = policy.critic.theta
    out.norm.load_state(policy.norm.state())
    return out


def joined(one: Policy, other: Policy, inputs, own) -> Policy:
    r"""One network of two: the hidden units of both beside one another, some outputs from those of one, the rest from
    those of the other.

    Equation  every layer is [[W, 0], [0, W']]; of the last a column is (W_i, 0) or (0, W'_i).  The other's first layer
              reads one's normalised inputs: W'_k s'_k / s_j, b' + Σ_k W'_k s'_k (μ_j − μ'_k), j = inputs[k]
    Symbols   s, μ the inverse deviations and means of the two normalisers, of which the clipping is left aside
    Why       legs that learnt without arms keep their feet under raised arms, and arms learn beside them: what one
              policy knows is kept whole where two that are no relations cannot be averaged (`blended`)
    Args      inputs : (other.obs_size,) which of one's inputs each of the other's is; own : (u,) bool, one's outputs
    Returns   Policy with one's critic, normaliser and σ
    Raises    ValueError: other outputs, another depth or activation
    Test      tests/extras/test_policies.py::test_joined
    """
    same = [(len(p.hidden), p.action_size, p.activation) for p in (one, other)]
    if same[0] != same[1]:
        raise ValueError(f"layers, outputs and activation {same[1]}, expected {same[0]}")
    out = with_hidden(one, tuple(a + b for a, b in zip(one.hidden, other.hidden, strict=True)))
    a, b, c = one.actor.params, {k: v.astype(float) for k, v in other.actor.params.items()}, out.actor.params
    inverse, theirs, inputs = one.norm.inv_std.astype(float), other.norm.inv_std.astype(float), np.asarray(inputs)
    k = np.arange(len(inputs))
    b["b0"] = b["b0"] + (theirs[k] * (one.norm.mean[inputs] - other.norm.mean[k])) @ b["W0"]
    first = np.zeros((one.obs_size, other.hidden[0]))
    first[inputs] = b["W0"] * (theirs[k] / inverse[inputs])[:, None]
    last = out.actor.n_layers - 1
    c["W0"][:] = np.hstack([a["W0"], first])
    for i in range(1, last):
        c[f"W{i}"][:] = block_diag(a[f"W{i}"], b[f"W{i}"])
    for i in range(last):
        c[f"b{i}"][:] = np.concatenate([a[f"b{i}"], b[f"b{i}"]])
    c[f"W{last}"][:] = np.vstack([a[f"W{last}"] * own, b[f"W{last}"] * ~np.asarray(own)])
    c[f"b{last}"][:] = np.where(own, a[f"b{last}"], b[f"b{last}"])
    return out


def gated(one: Policy, other: Policy, inputs, moves, speed, width, depth, scale) -> Policy:
    r"""One network of two and of a gate: the other acts while a speed that is seen is above a threshold  [Jacobs91].

    Equation  v = Σ_i m_i o_i of the raw observation, clipping left aside;  g(t) = min(1, max(0, (v − t) / w)),
              g_A = g(v_0 − 0.15 w), g_B = g(v_0 − 0.85 w);  a = W_A φ(z_A − K g_A) + W_B φ(z_B − K (1 − g_B))
              + b_A (1 − g_A) + b_B g_B + s K (g_A Σ W_A + (1 − g_B) Σ W_B)
    Method    four units of the first layer, φ(c (v − t) / w), make the two ramps: two of them, w apart, differ by
              c (s + (1 − s) g(t)); two units of the second layer hold g_A and g_B, plus 0.1, for what is linear in them
    Symbols   v_0 speed [m/s], w width, K depth, c scale; z the second layer before φ, the leaky ReLU of slope s; W, b
              the last layer; A one, B other
    Why       what a walker does not unlearn (it stands until it falls where the user steps back), an expert of it
              does; half of both, or a student that has not taken a step, falls.  g_A and 1 − g_B cross at v_0, where
              they are 0.15: there both act a little, never neither.  PPO then goes on with all of it, the gate, too;
              sizes are such that no weight of it changes the actions more than others do in a step of Adam
    Args      inputs : as of `joined`; moves {i: m_i} of one's inputs
    Returns   Policy with one's critic, normaliser and σ; 0.85 w beside v_0 as the one that acts, but for s z W of the
              other, if no z of it is above K
    Raises    ValueError: as `joined`; not two hidden layers of leaky ReLUs
    Test      tests/extras/test_policies.py::test_gated
    """
    if len(one.hidden) != 2 or one.activation != "leaky_relu":
        raise ValueError(f"hidden layers {one.hidden} of {one.activation}, expected two of leaky_relu")
    both = joined(one, other, inputs, np.ones(one.action_size, bool))
    (h, k), ours, slope = both.hidden, one.hidden[1], LEAKY_SLOPE
    out = with_hidden(one, (h + 4, k + 2))
    w = {name: np.zeros(v.shape) for name, v in out.actor.params.items()}
    for name, v in both.actor.params.items():
        w[name][tuple(slice(n) for n in v.shape)] = v
    at, by = list(moves), np.array(list(moves.values()))[:, None]
    w["W0"][at, h:] = by / one.norm.inv_std[at, None] * (scale / width)
    w["b0"][h:] = ((one.norm.mean[at] @ by) - speed) * (scale / width) + scale * np.array([0.85, 0.15, -0.15, -0.85])
    g_b, g_a = (np.array(r) / (scale * (1.0 - slope)) for r in ([1, 0, -1, 0], [0, 1, 0, -1]))
    leak = -slope / (1.0 - slope)  # what the two units of a ramp differ by where it is 0
    w["W1"][h:, :ours], w["W1"][h:, ours:k] = -depth * g_a[:, None], depth * g_b[:, None]
    w["b1"][:ours] -= depth * leak
    w["b1"][ours:k] += depth * (leak - 1.0)
    w["W1"][h:, k:] = np.stack([g_a, g_b], axis=1)
    w["b1"][k:] = leak + 0.1  # so that neither is ever below 0
    a, b = one.actor.params, {name: v.astype(float) for name, v in other.actor.params.items()}
    w["W2"][ours:k] = b["W2"]
    lost_a, lost_b = (slope * depth * p["W2"].astype(float).sum(axis=0) for p in (a, b))
    w["W2"][k:] = lost_a - a["b2"], b["b2"] - lost_b
    w["b2"][:] = a["b2"] + lost_b - 0.1 * w["W2"][k:].sum(axis=0)
    for name, v in out.actor.params.items():
        v[:] = w[name]
    return out


def motors_of(char: Character, patterns) -> np.ndarray:
    """(u,) bool: which motors' hinges such patterns name.  UserError: one that no motor fits, or all of them fit

    Test      tests/extras/test_policies.py::test_join_command"""
    names = [char.hinges[h] for h in char.driven]
    fits = np.array([[fnmatch(name, pattern) for name in names] for pattern in patterns])
    own = fits.any(axis=0)
    if own.all() or not fits.any(axis=1).all():
        odd = next((m for m, f in zip(patterns, fits) if not f.any()), ",".join(patterns))
        raise UserError(f"--motors {odd}: {'all' if own.all() else 'none'}; valid: some of {', '.join(names)}")
    return own


def join(out_path, one_path, other_path, opt: Join) -> dict:
    """Write one network of two policies of a character (`joined`, `gated`).  -> what its file says

    Args      opt.motors : patterns of hinges, as in 'shoulder_*': those act by the first policy, the rest by the
              second, which may know the headset alone; or opt.backwards [m/s]: the second acts while headset and root
              go backwards, in the character's heading, faster than that (ROOT_SHARE: a user's steps are not even, and
              a network has no memory but its body); or opt.faster: while they go forwards faster
    Raises    UserError: none or several of these; another body, a pattern that no motor or every motor fits, inputs
              that the first does not have, a policy that is shown its user ahead
    Test      tests/extras/test_policies.py::test_join_command"""
    asked = {k: v for k in ("motors", "backwards", "faster") if (v := getattr(opt, k)) not in (None, ())}
    if len(asked) != 1:
        raise UserError("join: valid: one of --motors, --backwards and --faster")
    (one, meta), (other, its) = load_policy(one_path), load_policy(other_path)
    bodies = _body(meta, one_path), _body(its, other_path)
    if not all(bodies) or bodies[0] != bodies[1]:
        raise UserError(f"{other_path}: of the body {bodies[1]}; valid: as {one_path}, {bodies[0]}")
    char = trained_as(meta, one_path).load()
    own = motors_of(char, opt.motors) if opt.motors else None
    for path, m in ((one_path, meta), (other_path, its)):
        if ahead := shown_ahead(m):  # PPO that goes on by Table 2's kernel unlearns it
            undo = f"python -m extras.policies ship {path} NEW.npz {flags_of({k: -v for k, v in ahead.items()})}"
            raise UserError(f"{path}: is shown its user ahead, {flags_of(ahead)}; valid: without, as by {undo}")
    have, need = (input_names(char, devices_of(m, p, None), False) for m, p in ((meta, one_path), (its, other_path)))
    if lacking := [n for n in need if n not in have]:
        raise UserError(f"{other_path}: sees {lacking[0]}, which {one_path} does not; valid: in the other order")
    inputs, step = [have.index(n) for n in need], (1.0 - ROOT_SHARE) * CONTROL_RATE
    moves = {"user_previous.h.x": -step, "user.h.x": step, "qd.vx": ROOT_SHARE}  # m/s forwards
    sign, gate = (-1.0, GATE) if opt.backwards else (1.0, GATE | {"width": RUN_WIDTH})
    moves, speed = {have.index(n): sign * m for n, m in moves.items()}, opt.backwards or opt.faster
    try:
        if own is not None:
            policy = joined(one, other, inputs, own)
        else:
            policy = gated(one, other, inputs, moves, speed, **gate)
    except ValueError as e:
        raise UserError(f"join {one_path} {other_path}: {e}; valid: networks of as many layers") from None
    kept = {k: meta[k] for k in ("data", "gain", "reward") if k in meta}
    kept |= {"policy": policy.shape(), "steps": total_steps(meta)}
    kept["options"] = meta["options"] | {"hidden": list(policy.hidden), "init": None, "out": None}
    kept["licence"] = each_once(licences_of(meta, one_path) + licences_of(its, other_path)) or "MIT"
    kept["joined"] = {"with": Path(other_path).name} | {k: list(v) if k == "motors" else v for k, v in asked.items()}
    kept |= {"versions": versions(), "git": git_state()}
    save_checkpoint(out_path, policy.arrays(), kept)
    return kept


# ------------------------------------------------------------------------------------ carry


def input_names(char: Character, devices=3, asymmetric=True) -> list[str]:
    """A name for every number of the observation, in its order: q.knee_l_y, x.head.2, user.h.R0, human_pos.17, ….

    What two characters, or one with and without controllers, have names for in common, one's policy knows of the other.
    Args      as of `observation_terms`
    Test      tests/extras/test_policies.py::test_input_names"""
    links = [char.model.body(b).name for b in char.obs_links]
    user = [f"{d}.{i}" for d in "hlr"[:devices] for i in "xyz"]
    user += [f"{d}.R{i}" for d in "hlr"[:devices] for i in range(6)]
    own = dict(
        q=char.hinges,
        qd=["vx", "vy", "vz", "wx", "wy", "wz", *char.hinges],
        x=[f"{link}.{i}" for link in links for i in "xyz"],
        R=[f"{link}.R{i}" for link in links for i in range(6)],
        user_previous=user,
        user=user,
    )
    terms = observation_terms(char, devices, asymmetric)
    return [f"{t}.{i}" for t, n in (terms["actor"] | terms["critic"]).items() for i in own.get(t, range(n))]


def widened(mlp, sizes, rng):
    r"""The same function by a network of more units a layer.

    Method    old weights in the upper left corner; a new unit's incoming weights are drawn as `MLP` draws them, its
              outgoing weights to old units and outputs are 0, so that it is silent until it is trained
    Source    the idea of function-preserving transformations: Chen et al. 2016, "Net2Net"
    Args      mlp : MLP; sizes : as many as mlp.sizes, the same inputs and outputs, none smaller; rng : Generator
    Returns   MLP of the dtype of mlp
    Raises    ValueError: other inputs or outputs, other depth, or a smaller layer
    Test      tests/extras/test_policies.py::test_widened_is_the_same_function
    """
    old, new = mlp.sizes, tuple(int(n) for n in sizes)
    same = len(old) == len(new) and old[0] == new[0] and old[-1] == new[-1]
    if not same or any(b < a for a, b in zip(old, new, strict=True)):
        raise ValueError(f"sizes are {new}, expected {len(old)} from {old[0]} to {old[-1]} and none below {old}")
    out = MLP(new, mlp.activation, rng, dtype=mlp.theta.dtype)
    for i in range(out.n_layers):
        rows, columns = old[i], old[i + 1]
        out.params[f"W{i}"][:rows, :columns] = mlp.params[f"W{i}"]
        out.params[f"W{i}"][rows:, :columns] = 0.0
        out.params[f"b{i}"][:columns] = mlp.params[f"b{i}"]
    return out


def rearranged(policy: Policy, inputs, obs_size, outputs) -> Policy:
    """The same policy with other inputs and outputs: one left out is as if it stayed at its mean, a new one is ignored,
    a new action is 0.

    Args      inputs : (critic,) which of this policy's inputs each is, -1 for a new one, the actor's first;
              obs_size : how many the actor has; outputs : (u,) the same of the actions
    Test      tests/extras/test_policies.py::test_headset_only, test_another_character"""
    inputs, outputs = np.asarray(inputs), np.asarray(outputs)
    sizes = obs_size, len(inputs), len(outputs), policy.hidden, policy.value_hidden
    rng, dtype = np.random.default_rng(0), policy.theta_pi.dtype
    out = Policy(*sizes, 1.0, policy.value_scale, rng, dtype, policy.activation)
    for mine, its, rows in ((policy.actor, out.actor, inputs[:obs_size]), (policy.critic, out.critic, inputs)):
        last = mine.n_layers - 1
        for name, value in mine.params.items():
            if name == "W0":
                value = value[rows] * (rows >= 0)[:, None]
            if its is out.actor and name in (f"W{last}", f"b{last}"):
                value = value[..., outputs] * (outputs >= 0)
            its.params[name][:] = value
    out.log_std[:] = np.where(outputs >= 0, policy.log_std[outputs], policy.log_std.mean())
    state = {k: v if k == "count" else v[inputs] for k, v in policy.norm.state().items()}
    state["mean"] = np.where(inputs >= 0, state["mean"], 0.0)
    state["m2"] = np.where(inputs >= 0, state["m2"], float(state["count"]))
    out.norm.load_state(state)
    return out


def with_layers(policy: Policy, hidden, value_hidden, path) -> Policy:
    """The same function by wider layers.  UserError, naming path: another depth, or a narrower layer

    Test      tests/extras/test_policies.py::test_wider_layers"""
    sizes = policy.obs_size, policy.critic_size, policy.action_size, hidden, value_hidden
    rng, dtype = np.random.default_rng(0), policy.theta_pi.dtype
    out = Policy(*sizes, 1.0, policy.value_scale, rng, dtype, policy.activation)
    try:
        out.actor.theta[:] = widened(policy.actor, out.actor.sizes, rng).theta
        out.critic.theta[:] = widened(policy.critic, out.critic.sizes, rng).theta
    except ValueError:
        has = f"its layers are {policy.hidden} and {policy.value_hidden}"
        raise UserError(f"{path}: {has}: give --hidden and --value-hidden as many, none smaller") from None
    out.log_std[:] = policy.log_std
    out.norm.load_state(policy.norm.state())
    return out


def with_limits(policy: Policy, old: Character, new: Character, springs=True) -> Policy:
    r"""The same torques from a body with other limits and springs, at the default pose.

    Equation  a_new = (a_old L_old + k_old (r_old − q) − k_new (r_new − q)) / L_new,  q the default pose: W and b of the
              last layer × L_old / L_new, b + the rest, log σ + log (L_old / L_new)
    Symbols   L limit, k stiffness, r the spring's angle of rest, of each hinge that both drive; all of them divided by
              size⁴, with which they grow (`character.load`), so that a body of another size does what this one did
    Args      policy : its outputs are new's motors already; springs : False where those that `hold` bear another pose,
              which they are meant to
    Returns   policy, changed
    Test      tests/extras/test_policies.py::test_another_body, test_another_pose"""
    last = policy.actor.n_layers - 1
    weights, bias = (policy.actor.params[f"{name}{last}"] for name in "Wb")
    sizes = [c.variant.get("scale", 1.0) ** 4 for c in (old, new)]
    driven = [{c.hinges[h]: k for k, h in enumerate(c.driven)} for c in (old, new)]
    for name in driven[0].keys() & driven[1].keys():
        limits, pulls = [], []
        for c, own, size in zip((old, new), driven, sizes, strict=True):
            h = c.driven[own[name]]
            limits.append(c.limits[own[name]] / size)
            pulls.append(c.model.jnt_stiffness[1 + h] * (c.model.qpos_spring[7 + h] - c.default[h]) / size)
        k, ratio = driven[1][name], limits[0] / limits[1]
        weights[:, k] *= ratio
        bias[k] = bias[k] * ratio + springs * (pulls[0] - pulls[1]) / limits[1]
        policy.log_std[k] += np.log(ratio)
    return policy


def at_rest(char: Character, devices=3) -> dict:
    """What the actor observes in the default pose under somebody who stands: name -> number.

    Test      tests/extras/test_policies.py::test_another_pose"""
    pos, quat, _, _ = stream_of(char, data.load("standing", clips="stand_005")[0], devices)
    player = Player(char, lambda obs: np.zeros((len(obs), len(char.limits))), devices=devices)
    player.step(pos[:1], quat[:1])  # which observes before it moves
    return dict(zip(input_names(char, devices, False), player.obs[0].astype(float), strict=True))


def reposed(policy: Policy, old: Character, new: Character, devices=3) -> Policy:
    r"""Another default pose is taken for the old one: the policy sees itself stand as it did, and does what it did.

    Equation  mean of the normaliser += o_new − o_old, o the observation `at_rest`
    Why       a bent Dino (§5.2) whose policy still senses an upright one's angles rights itself at once
    Args      policy : its inputs are new's already
    Returns   policy, changed
    Test      tests/extras/test_policies.py::test_another_pose"""
    was, now = at_rest(old, devices), at_rest(new, devices)
    state = policy.norm.state()
    mean = state["mean"].copy()
    mean[: policy.obs_size] += [value - was.get(name, value) for name, value in now.items()]
    policy.norm.load_state(state | {"mean": mean})
    return policy


def carried(path, old: Character, new: Character, opt: Carry) -> tuple[Policy, dict]:
    """A policy as that of another body, and what its file says.

    What only one of the two has a name for is silent.  A lead (`led`) is taken back where devices or the character
    change, for what it added to the headset's weights was of all devices and of that normaliser.  Another character's
    policy keeps its actions, whatever they are in newton metres, because its mass is another; its normaliser and σ
    begin anew, because its sizes are others.  Another default pose is taken for the old one (`reposed`).
    Args      old, new : characters; opt.sensors, opt.without, opt.hidden, opt.value_hidden : of the new one
    Raises    UserError: it does not fit old; it knows the headset alone and the new one has controllers
    Test      tests/extras/test_policies.py::test_headset_only, test_another_character, test_a_variation
    """
    policy, meta = load_policy(path)
    trained = sensors_of(meta, path)
    sensors = opt.sensors or trained
    if trained == "hmd" and sensors == "full":
        raise UserError(f"{path}: was trained with the headset alone: give --sensors hmd")
    asymmetric = policy.critic_size > policy.obs_size
    sees = asymmetric and "asymmetric" not in opt.without
    ways = [(old, 3 if trained == "full" else 1, asymmetric), (new, 3 if sensors == "full" else 1, sees)]
    have, need = (input_names(*way) for way in ways)
    outputs, wanted = ([c.hinges[h] for h in c.driven] for c in (old, new))
    if (len(have), len(outputs)) != (policy.critic_size, policy.action_size):
        sizes = f"has {policy.critic_size} inputs and {policy.action_size} actions"
        body = f"{old.path} has {len(have)} and {len(outputs)}"
        raise UserError(f"{path}: {sizes}, {body}: give the body it was trained with as --from-character PATH")
    if (ahead := shown_ahead(meta)) and (sensors != trained or old.name != new.name):
        policy = led(policy, old, ways[0][1], **{k: -v for k, v in ahead.items()})
        meta = {k: v for k, v in meta.items() if k not in ahead}
        print(f"{path}: was shown its user ahead; no longer: ship {flags_of(ahead)} does it again")
    place = lambda names, name: names.index(name) if name in names else -1  # noqa: E731
    inputs, motors = [place(have, n) for n in need], [place(outputs, n) for n in wanted]
    actor = sum(observation_terms(new, ways[1][1], sees)["actor"].values())
    policy = rearranged(policy, inputs, actor, motors)
    if old.name == new.name:
        default = [dict(zip(c.hinges, c.default)) for c in (old, new)]
        posed = any(default[0].get(h, angle) != angle for h, angle in default[1].items())
        policy = with_limits(policy, old, new, springs=not posed)
        policy = reposed(policy, old, new, ways[1][1]) if posed else policy
    else:
        policy.norm.load_state(RunningNorm(policy.critic_size).state())
        policy.log_std[:] = np.log(new.training.get("sigma", SIGMA))
    policy = with_layers(policy, opt.hidden or policy.hidden, opt.value_hidden or policy.value_hidden, path)
    known = sum(i >= 0 for i in inputs), sum(i >= 0 for i in motors)
    print(
        f"{path}: {old.name}'s policy: {known[0]} of {len(inputs)} inputs and {known[1]} of {len(motors)} torques of "
        f"{new.name} have the same names and go on"
    )
    options = dict(meta.get("options", {}))
    never = [w for w in options.get("without") or () if w not in ("asymmetric", *opt.without)]  # it learnt so, once
    options |= {"sensors": sensors, "without": [*never, *opt.without]}
    options |= {"hidden": list(policy.hidden), "value_hidden": list(policy.value_hidden), "init": None, "out": None}
    kept = {k: meta[k] for k in ("data", "blend", "joined", "gain", "reward") if k in meta} | shown_ahead(meta)
    kept["licence"] = each_once(licences_of(meta, path)) or "MIT"  # what it began from is not named any more
    kept |= {"policy": policy.shape(), "options": options, "steps": total_steps(meta), "carried": Path(path).name}
    return policy, kept | {"versions": versions(), "git": git_state()}


# ------------------------------------------------------------------------------------ command line


@dataclass
class Ship:
    """What `ship` can be told."""

    gain: float = arg(1.0, "makes the policy's standardised observations so many times as large", check=POSITIVE)
    lead: float = arg(0.0, "shows the policy its user so many seconds ahead, by the headset's velocity", check=LEADS)
    damping: float = arg(0.0, "and by so many seconds times (headset's velocity - root's)", check=LEADS)


@dataclass
class Blend(Ship):
    """What `blend` can be told."""

    share: float = arg(0.5, "of the others together in the average", check=UNIT)


@dataclass
class Join:
    """What `join` can be told."""

    motors: tuple[str, ...] = arg((), "names of hinges, with * and ?: those of A's network act, of all others B's")
    backwards: float | None = arg(None, "instead: B's network acts while both go backwards faster, m/s", check=SPEEDS)
    faster: float | None = arg(None, "instead: B's network acts while both go forwards faster, m/s", check=SPEEDS)


@dataclass
class Carry(character.Switches):
    """What `carry` can be told: the new body, by default the old one."""

    character: str | None = arg(None, "name in characters/, or path of a .toml; the policy's own by default")
    from_character: str | None = arg(None, ".toml of the body that it was trained with; its own by default")
    sensors: str | None = arg(None, "what it will see of the user: full, or hmd, the headset alone", choices=SENSORS)
    without: tuple[str, ...] = arg(
        (), "asymmetric: its critic will see no more than its actor [§5.3]", check=some_of(WITHOUT)
    )
    hidden: tuple[int, ...] | None = arg(None, "hidden layers of the policy, none narrower", check=ALL_POSITIVE)
    value_hidden: tuple[int, ...] | None = arg(None, "hidden layers of the value network", check=ALL_POSITIVE)


def carry(old_path, new_path, opt: Carry, given=()) -> dict:
    """Write a policy as that of another body.  -> what its file says

    Args      given : names of the flags that were given: the policy's own variation holds for the others
    Raises    UserError: the file names no character; as `carried`
    Test      tests/extras/test_policies.py::test_carry_command"""
    _, meta = load_policy(old_path)
    own = trained_as(meta, old_path)
    if own is None:
        raise UserError(f"{old_path}: does not say of which character it is; valid: what ppo.py wrote")
    base = own if opt.character in (None, own.character) else character.Switches(opt.character)
    variation = {f.name: getattr(opt, f.name) for f in fields(character.Switches) if f.name in given}
    to = replace(base, **variation)
    old = replace(own, character=opt.from_character or own.character).load()
    policy, kept = carried(old_path, old, to.load(), opt)
    kept["options"] |= asdict(to)
    save_checkpoint(new_path, policy.arrays(), kept)
    return kept


def check_new(out) -> None:
    """UserError: a policy is there already.  `blend` and `join` name OUT first: a slip of order would cost a policy.

    Test      tests/extras/test_policies.py::test_nothing_is_overwritten"""
    if Path(out).suffix != ".npz":
        raise UserError(f"{out}: valid: a name that ends in .npz")
    if Path(out).exists():
        raise UserError(f"{out} exists already: valid: the name of a new file (of blend and join it stands first)")


COMMANDS = {  # how many files each wants, least and most; its flags; how it is called
    "ship": (2, 2, Ship, "ship RUN OUT.npz"),
    "blend": (3, 100, Blend, "blend OUT.npz A B …"),
    "join": (3, 3, Join, "join OUT.npz A B"),
    "carry": (2, 2, Carry, "carry OLD.npz NEW.npz"),
}


def main(argv=None):
    """Ship, blend, join or carry.

    Test      tests/extras/test_policies.py::test_carry_command, test_join_command, test_ship, test_wrong_commands"""
    words, flags = words_first(argv)
    what, files = (words[0], words[1:]) if words else ("", [])
    least, most, kind, usage = COMMANDS.get(what, (1, 0, Ship, "|".join(COMMANDS) + " FILE …"))
    if not {"-h", "--help"} & set(flags) and not least <= len(files) <= most:
        ways = ", ".join(way for *_, way in COMMANDS.values())
        raise UserError(f"{' '.join(words) or 'no command'}: valid: {ways}, then flags")
    opt = cli(kind, flags, f"extras.policies {usage}", __doc__)
    out, *read = files if what in ("blend", "join") else files[::-1]
    check_folders(out, read=read)
    check_new(out)
    if what == "carry":
        meta = carry(*files, opt, given_flags(flags))
        print(f"{out}: {meta['options']['character']}, {fmt_count(meta['steps'])} steps before")
    elif what == "join":
        meta = join(*files, opt)
        ours, rest = ("forwards", "backwards") if opt.backwards else ("slower", "faster")
        ours, rest = (", ".join(opt.motors), "the rest") if opt.motors else (ours, rest)
        print(f"{out}: {ours} of {read[0]}, {rest} of {read[1]}; {meta['licence']}")
    else:
        run, *others = read
        meta = ship(run, out, others, **asdict(opt))
        mixed = f", {1 - opt.share:g} of it and {opt.share:g} of {', '.join(others)}" if others else ""
        print(f"{out}: {fmt_count(meta['steps'])} steps on {meta['options']['motion']}{mixed}; {meta['licence']}")


if __name__ == "__main__":
    run_main(main)

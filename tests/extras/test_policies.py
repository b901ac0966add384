"""extras/policies.py: shipped, averaged, and carried over to another body."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_ppo import train, whole  # noqa: F401, whole is a fixture

import character
import metrics
import nn
import ppo
import retarget
from env import Env, headset_only
from extras import policies
from extras.policies import Carry, carried, input_names
from mocap import data
from nn import LEAKY_SLOPE
from plumbing.cli import UserError
from plumbing.runs import CHECKPOINT, load_checkpoint, save_checkpoint
from policy import Policy, load_policy, total_steps, trained_as

# ------------------------------------------------------------------------------------ ship, blend


def test_ship(tmp_path, monkeypatch):
    """A shipped policy acts as the run's does, is small, and carries its data's licence."""
    folder = tmp_path / "motion"
    folder.mkdir()
    (folder / "LICENSE").write_text("Non-commercial.\n")
    monkeypatch.setattr(data, "sequences", lambda *a, **k: data.builtin_clips()[:1])
    size = ["--recipe", "none", "--envs", "4", "--horizon", "4", "--steps", "16", "--minibatch", "16"]
    ppo.main(["--motion", str(folder), "--out", str(tmp_path / "run"), *size])
    target = tmp_path / "jesse.npz"
    policies.main(["ship", str(tmp_path / "run"), str(target)])
    (a, _), (b, meta) = load_policy(tmp_path / "run"), load_policy(target)
    obs = np.random.default_rng(0).standard_normal((3, a.obs_size)).astype(np.float32)
    np.testing.assert_array_equal(a.mean_action(obs), b.mean_action(obs))
    assert meta["licence"] == "weights trained on motion, licensed: Non-commercial." and meta["steps"] == 16
    assert target.stat().st_size < 4e6
    assert str(tmp_path) not in json.dumps(meta)  # no path of the machine
    ppo.main(["--motion", f"builtin,{folder},standing", "--out", str(tmp_path / "both"), *size])
    ppo.main(["--motion", str(folder), "--init", str(target), "--out", str(tmp_path / "more"), *size])
    more = policies.ship(tmp_path / "more", tmp_path / "more.npz")
    assert more["steps"] == 32 == total_steps(load_policy(tmp_path / "more")[1]) and not more["options"]["init"]
    assert policies.ship(tmp_path / "both", target)["licence"] == meta["licence"]
    student, told = load_policy(tmp_path / "run")
    told["options"]["expert"] = [f"*_run_*={tmp_path}/expert.npz", "back_*=other.npz"]
    save_checkpoint(tmp_path / "student.npz", student.arrays(), told)
    shipped = policies.ship(tmp_path / "student.npz", tmp_path / "shipped.npz")
    assert shipped["options"]["expert"] == ["*_run_*=expert.npz", "back_*=other.npz"]
    assert load_policy(target)[1]["options"]["motion"] == "builtin,motion,standing"
    with pytest.raises(UserError):
        policies.ship(tmp_path / "nothing", target)


def test_ship_names_the_reward(whole, tmp_path):  # noqa: F811
    """Trained with another reward it plays the same body: shipped, it says so apart from the body's changes."""
    policy, meta = load_policy(whole)
    change = {"set": "reward.contact=[4, 1]; pose.spine_y=0.1"}
    save_checkpoint(tmp_path / "a.npz", policy.arrays(), meta | {"options": meta["options"] | change})
    told = policies.ship(tmp_path / "a.npz", tmp_path / "b.npz")
    assert told["options"]["set"] == "pose.spine_y=0.1" and told["reward"] == ["reward.contact=[4, 1]"]
    assert policies.ship(tmp_path / "b.npz", tmp_path / "c.npz")["reward"] == ["reward.contact=[4, 1]"]
    policies.main(["carry", str(tmp_path / "b.npz"), str(tmp_path / "e.npz"), "--hidden", "16"])
    assert load_policy(tmp_path / "e.npz")[1]["reward"] == ["reward.contact=[4, 1]"]
    assert "reward" not in policies.ship(whole, tmp_path / "d.npz")
    clip = data.load("builtin", clips="stand_007")[:1]
    [arm] = metrics.arms_of(clip, metrics.Options(compare=(str(tmp_path / "c.npz"),), threads=1))
    assert arm.title().endswith("trained with reward.contact=[4, 1]")
    assert arm.char.variant == {"set": ["pose.spine_y=0.1"]}


def kept(path, **meta):
    """A policy's file that says of itself what it is told to; the same weights each time."""
    policy = Policy(3, 3, 2, (4,), (4,), 0.1, 1.0, np.random.default_rng(0))
    path.parent.mkdir(exist_ok=True)
    save_checkpoint(path, policy.arrays(), {"policy": policy.shape()} | meta)
    return str(path)


def run_on(path, motion="builtin", init=None, **options):
    return kept(path, options={"motion": str(motion), "init": init} | options, steps=16, data={})


def test_licences_of_ancestors(tmp_path):
    """What a policy began from, what it copied and what it is averaged with keep their terms, at any distance; what is
    gone is said."""
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "LICENSE").write_text("Non-commercial.")
    line, out = "weights trained on m, licensed: Non-commercial.", tmp_path / "out.npz"
    terms = lambda *args: policies.ship(*args)["licence"]  # noqa: E731
    shipped, mine = kept(tmp_path / "s.npz", licence=line), kept(tmp_path / "free.npz", licence="MIT")
    run = run_on(tmp_path / "run" / CHECKPOINT, tmp_path / "m")
    first = run_on(tmp_path / "a.npz", init=str(tmp_path / "run"))
    for path in (run, first, run_on(tmp_path / "b.npz", init=first), run_on(tmp_path / "c.npz", init=shipped)):
        assert terms(path, out) == line
    expert = (f"back_*={mine}",)
    assert terms(run_on(tmp_path / "d.npz", init=mine, expert=expert), out) == "MIT"
    assert policies.pairs_of(["a=b=c", "d"]) == [("a", "b=c"), ("d", "")]
    assert terms(run_on(tmp_path / "e.npz", init=mine, expert=(*expert, f"*={first}")), out) == line
    assert terms(mine := run_on(tmp_path / "f.npz"), out) == "MIT"
    assert terms(mine, out, [mine, tmp_path / "run"]) == line
    gone = run_on(tmp_path / "g.npz", init=str(tmp_path / "old" / "x.npz"))
    said = "weights trained on what x.npz was, licensed: unknown: x.npz is gone, or does not say"
    assert terms(gone, out) == terms(mine, out, [gone, gone]) == said
    again = tmp_path / "x.npz"
    assert terms(run_on(again, init=str(again)), out) == said  # replaced by its own descendant


def test_each_once():
    """An average of averages names a set once, and by its terms where one of them knew them."""
    a, b, unknown = "a, licensed: X; or Y", "b, licensed: Z", f"a, licensed: {data.UNKNOWN}"
    line = f"weights trained on {a}; weights trained on {b}"
    assert policies.each_once([line, line]) == policies.each_once([line]) == line
    assert policies.each_once([f"weights trained on {unknown}", line]) == line
    assert policies.each_once([f"weights trained on {unknown}"]) == f"weights trained on {unknown}"
    assert policies.each_once(["any other terms", line]) == f"any other terms; {line}"
    assert policies.each_once([]) == ""


def test_blended(tmp_path, capsys):
    """Shares of 0 and 1 are the two policies; between them weights, and the normaliser's variances, are means."""
    paths = tmp_path / "old", tmp_path / "new"
    for seed, path in enumerate(paths):
        train(path, 2, "--seed", str(seed))
    obs = np.random.default_rng(0).standard_normal((5, load_policy(paths[0])[0].obs_size)).astype(np.float32)
    old, new = (load_policy(p)[0] for p in paths)
    for share, like in ((0.0, new), (1.0, old)):
        meta = policies.ship(paths[1], tmp_path / "b.npz", paths[:1], share)
        assert meta["blend"] == {"with": ["old"], "share": share}
        got = load_policy(tmp_path / "b.npz")[0]
        np.testing.assert_allclose(got.mean_action(obs), like.mean_action(obs), atol=1e-5)
    policies.main(["blend", str(tmp_path / "quarter.npz"), str(paths[1]), str(paths[0]), "--share", "0.25"])
    got = load_policy(tmp_path / "quarter.npz")[0]
    np.testing.assert_allclose(got.theta_pi, 0.75 * new.theta_pi + 0.25 * old.theta_pi, atol=1e-6)
    np.testing.assert_allclose(got.norm.var, 0.75 * new.norm.var + 0.25 * old.norm.var, rtol=1e-5)
    np.testing.assert_allclose(got.norm.mean, 0.75 * new.norm.mean + 0.25 * old.norm.mean, atol=1e-5)
    policies.ship(paths[1], tmp_path / "b.npz", [paths[0], paths[0], paths[1]], 0.75)
    np.testing.assert_allclose(
        load_policy(tmp_path / "b.npz")[0].theta_pi, 0.5 * (new.theta_pi + old.theta_pi), atol=1e-6
    )
    policies.ship(paths[1], tmp_path / "b.npz", gain=1.25)
    x = np.random.default_rng(1).standard_normal((3, new.critic_size))
    louder = load_policy(tmp_path / "b.npz")[0]
    inside = np.abs(new.norm(x)) < 8  # the rest is clipped
    np.testing.assert_allclose(louder.norm(x)[inside], 1.25 * new.norm(x)[inside], rtol=0.01)
    other = Path(ppo.__file__).parent / "characters" / "jesse-hmd.npz"
    assert load_policy(other)[1]["licence"] != "MIT"
    assert policies.ship(other, tmp_path / "again.npz")["licence"] == load_policy(other)[1]["licence"]
    weights, own = load_checkpoint(other, ("policy.*",))
    stiff = own["options"] | {"set": "passive.stiffness.shoulder=40"}
    save_checkpoint(tmp_path / "stiff.npz", weights, own | {"options": stiff})
    with pytest.raises(UserError, match="stiff.npz: another body or pose"):
        policies.ship(paths[1], tmp_path / "c.npz", [tmp_path / "stiff.npz"])
    with pytest.raises(UserError, match="blend .*: networks .*; valid: policies of one ancestor"):
        policies.ship(paths[1], tmp_path / "c.npz", [other])
    arrays, meta = load_checkpoint(paths[0] / CHECKPOINT, ("policy.*",))
    save_checkpoint(tmp_path / "bent.npz", arrays, meta | {"options": meta["options"] | {"set": "pose.spine_y=0.2"}})
    with pytest.raises(UserError, match="bent.npz: another body or pose"):
        policies.ship(paths[1], tmp_path / "c.npz", [tmp_path / "bent.npz"])
    save_checkpoint(tmp_path / "odd.npz", arrays, meta | {"options": meta["options"] | {"set": 5}})
    with pytest.raises(UserError, match="odd.npz: its options name no character"):
        policies.ship(paths[1], tmp_path / "c.npz", [tmp_path / "odd.npz"])
    save_checkpoint(tmp_path / "less.npz", arrays, meta | {"options": meta["options"] | {"set": "reward.q=[0, 1]"}})
    policies.ship(paths[1], tmp_path / "d.npz", [tmp_path / "less.npz"])  # another reward is the same body
    with pytest.raises(SystemExit):
        policies.main(["ship", str(paths[0]), str(tmp_path / "c.npz"), "--share", "0.3"])
    assert "unknown argument --share" in capsys.readouterr().err
    with pytest.raises(UserError, match="c.txt: valid: a name that ends in .npz"):
        policies.main(["ship", str(paths[0]), str(tmp_path / "c.txt")])
    assert not (tmp_path / "c.npz").exists()


@pytest.mark.parametrize("devices", (3, 1))
def test_led(char, ref, devices):
    """It acts as the old policy does where all devices are ahead by what the headset goes in that time, and by what it
    goes more than the root in the other; heights and rotations are as they were, so is the critic, and led back it is
    the old one."""
    env = Env(char, headset_only(ref) if devices == 1 else ref, 64, seed=1)
    env.reset(seed=2)
    policy = Policy(env.obs_size, env.critic_size, env.action_size, (16, 8), (8,), 0.1, 1.0, np.random.default_rng(0))
    policy.norm.update(env.full)  # means that are not 0
    policy.actor.params["W2"][:] *= 100.0
    obs, names = env.reset(seed=3)[0].astype(float), input_names(char, devices, asymmetric=False)
    policy.norm.clip = 100.0  # beyond which it is another function
    ahead = obs.copy()
    for row, shown in zip(obs, ahead):
        seen = dict(zip(names, row))
        for k, (term, *rest) in enumerate(name.split(".") for name in names):
            if term.startswith("user") and rest[1] in "xy":
                v = 30.0 * (seen[f"user.h.{rest[1]}"] - seen[f"user_previous.h.{rest[1]}"])
                shown[k] += 0.07 * v + 0.1 * (v - seen[f"qd.v{rest[1]}"])
    assert np.abs(ahead - obs).max() > 0.02
    expected, before = policy.mean_action(ahead), policy.mean_action(obs)
    assert np.abs(expected - before).max() > 0.05
    critic, ahead_by = policy.critic.theta.copy(), lambda sign: {"lead": sign * 0.07, "damping": sign * 0.1}
    np.testing.assert_allclose(policies.led(policy, char, devices, **ahead_by(1)).mean_action(obs), expected, atol=2e-4)
    np.testing.assert_array_equal(policy.critic.theta, critic)
    np.testing.assert_allclose(policies.led(policy, char, devices, **ahead_by(-1)).mean_action(obs), before, atol=2e-4)


def test_nothing_is_overwritten(whole, tmp_path):  # noqa: F811
    """A policy that is there stays: `blend` names the new file first, and a slip of order would cost another."""
    a, b, c = (tmp_path / f"{n}.npz" for n in "abc")
    for path in (a, b, c):
        policies.ship(whole, path)
    was = a.read_bytes()
    for words in (["blend", a, b, c], ["join", a, b, c], ["ship", b, a], ["carry", b, a, "--sensors", "hmd"]):
        with pytest.raises(UserError, match="a.npz exists already: valid: the name of a new file"):
            policies.main([str(w) for w in words])
    assert a.read_bytes() == was


def test_ancestry_is_kept(whole, tmp_path):  # noqa: F811
    """What a policy was averaged or carried over from is said by its copies, too, led or not."""
    a, b, c = (tmp_path / f"{n}.npz" for n in "abc")
    policies.main(["carry", str(whole), str(a), "--set", "reward.q=[0, 1]"])
    policies.main(["ship", str(a), str(b), "--lead", "0.05"])
    assert load_policy(b)[1]["carried"] == whole.name
    policies.main(["blend", str(c), str(b), str(a)])
    told = policies.ship(c, tmp_path / "d.npz")
    assert told["carried"] == whole.name and told["blend"] == {"with": ["a.npz"], "share": 0.5}


def test_carried_without_its_lead(whole, tmp_path, char, capsys):  # noqa: F811
    """Carried to another character or to the headset alone, a led policy is what it was before its lead."""
    led, files = str(tmp_path / "led.npz"), [str(tmp_path / f"{n}.npz") for n in "abcdef"]
    policies.main(["ship", str(whole), led, "--lead", "0.08", "--damping", "0.1"])
    for k, flags in enumerate((["--sensors", "hmd"], ["--character", "dino"], ["--hidden", "40"])):
        for old, new in zip((str(whole), led), files[2 * k : 2 * k + 2], strict=True):
            policies.main(["carry", old, new, *flags])
        (plain, _), (other, meta) = load_policy(files[2 * k]), load_policy(files[2 * k + 1])
        close = np.allclose(plain.actor.params["W0"], other.actor.params["W0"], atol=1e-5)
        assert close is (k < 2) and ("lead" in meta) is ("damping" in meta) is (k == 2)
    assert capsys.readouterr().out.count("ahead; no longer: ship --lead 0.08 --damping 0.1 does") == 2


def test_led_by_command(whole, tmp_path, capsys):  # noqa: F811
    """`ship --lead` says in the file how far ahead, and adds to what was there; averages and copies keep it."""
    once, twice = tmp_path / "once.npz", tmp_path / "twice.npz"
    policies.main(["ship", str(whole), str(once), "--lead", "0.05"])
    policies.main(["ship", str(once), str(twice), "--lead", "0.02", "--damping", "0.1"])
    told = lambda *paths: [load_policy(p)[1].get("lead", 0.0) for p in paths]  # noqa: E731
    assert told(once, twice) == [0.05, 0.07]
    assert policies.shown_ahead(load_policy(twice)[1]) == {"lead": 0.07, "damping": 0.1}
    policies.ship(once, tmp_path / "copy.npz")
    policies.ship(once, tmp_path / "mean.npz", [whole, twice], share=0.4)
    policies.ship(whole, tmp_path / "none.npz", [whole])
    assert told(*(tmp_path / f"{n}.npz" for n in ("copy", "mean", "none"))) == [0.05, 0.044, 0.0]
    policy, meta = load_policy(whole)
    char = trained_as(meta, whole).load()
    asked = policies.led(policy, char, lead=0.07, damping=0.1)
    np.testing.assert_allclose(load_policy(twice)[0].theta_pi, asked.theta_pi, atol=1e-5)
    with pytest.raises(SystemExit):
        policies.main(["ship", str(whole), str(once), "--lead", "2"])
    assert "from -0.5 to 0.5 s" in capsys.readouterr().err


# ------------------------------------------------------------------------------------ join


def test_joined():
    """Some outputs are one policy's, the rest the other's, which reads some of the same inputs by other statistics."""
    rng = np.random.default_rng(5)
    one, other = Policy(7, 9, 4, (6, 5), (3,), 0.1, 2.0, rng), Policy(4, 5, 4, (8, 3), (2,), 0.2, 1.0, rng)
    for policy in (one, other):
        for net in (policy.actor, policy.critic):
            net.theta[:] = rng.normal(size=net.theta.shape)
        policy.norm.update(rng.normal(1.0, 2.0, (40, policy.critic_size)))
    inputs, own = [6, 0, 3, 4], np.array([True, False, False, True])
    both = policies.joined(one, other, inputs, own)
    x = rng.normal(1.0, 1.0, (30, 9)).astype(np.float32)
    asked = np.where(own, one.mean_action(x[:, :7]), other.mean_action(x[:, inputs]))
    np.testing.assert_allclose(both.mean_action(x[:, :7]), asked, atol=1e-5)
    np.testing.assert_allclose(both.value(both.norm.normalise(x)), one.value(one.norm.normalise(x)), rtol=1e-6)
    np.testing.assert_array_equal(both.log_std, one.log_std)
    assert both.hidden == (14, 8)
    with pytest.raises(ValueError, match="expected .2, 4"):
        policies.joined(one, Policy(4, 5, 4, (8,), (2,), 0.2, 1.0, rng), inputs, own)


def test_gated():
    """Below the threshold the outputs are one policy's, above it the other's, each but for a hundredth of the other."""
    rng = np.random.default_rng(6)
    one, other = Policy(7, 9, 4, (60, 50), (3,), 0.1, 2.0, rng), Policy(5, 5, 4, (80, 30), (2,), 0.2, 1.0, rng)
    for policy in (one, other):
        policy.norm.update(rng.normal(1.0, 2.0, (40, policy.critic_size)))
        for k, w in policy.actor.params.items():
            w[:] = rng.normal(size=w.shape) / (np.sqrt(len(w)) if k.startswith("W") else 1.0)
    inputs, speed, width, depth = [6, 0, 3, 4, 1], 0.5, 0.2, 40.0
    both = policies.gated(one, other, inputs, {2: 3.0, 5: -3.0}, speed, width, depth, 3.0)
    assert both.hidden == (144, 82)
    x = rng.normal(1.0, 0.5, (4000, 9)).astype(np.float32)
    v = 3.0 * (x[:, 2] - x[:, 5])
    a, b, y = one.mean_action(x[:, :7]), other.mean_action(x[:, inputs]), both.mean_action(x[:, :7])

    leaky = lambda z: np.maximum(z, LEAKY_SLOPE * z)  # noqa: E731

    def last(policy, x):  # the last hidden layer before its activation, and the last layer
        p = policy.actor.params
        z = leaky(x @ p["W0"] + p["b0"]) @ p["W1"] + p["b1"]
        assert z.max() < 0.85 * depth  # a unit that is put off is off
        return z.astype(float), p["W2"].astype(float), p["b2"].astype(float)

    z_a, w_a, b_a = last(one, one.norm.normalise(x)[:, :7])
    z_b, w_b, b_b = last(other, other.norm.normalise(x[:, inputs]))
    off_a, off_b = z_a @ w_a, z_b @ w_b
    g_a, g_b = (np.clip((v - speed) / width + edge, 0.0, 1.0)[:, None] for edge in (0.15, 0.85))
    asked = leaky(z_a - depth * g_a) @ w_a + leaky(z_b - depth * (1.0 - g_b)) @ w_b + (1.0 - g_a) * b_a + g_b * b_b
    asked += LEAKY_SLOPE * depth * (g_a * w_a.sum(axis=0) + (1.0 - g_b) * w_b.sum(axis=0))
    np.testing.assert_allclose(y, asked, atol=1e-3)  # everywhere, the ramps, too
    assert (np.abs(v - speed) < 0.5 * width).sum() > 50
    below, above = v < speed - 0.85 * width, v > speed + 0.85 * width
    assert below.sum() > 500 and above.sum() > 500
    np.testing.assert_allclose(y[below], (a + LEAKY_SLOPE * off_b)[below], atol=2e-4)
    np.testing.assert_allclose(y[above], (b + LEAKY_SLOPE * off_a)[above], atol=2e-4)
    assert np.abs(a - b).mean() > 0.5 and np.abs(y - a)[below].mean() < 0.05
    np.testing.assert_allclose(both.value(both.norm.normalise(x)), one.value(one.norm.normalise(x)), rtol=1e-6)
    for hidden, activation in (((6,), "leaky_relu"), ((6, 5), "tanh")):
        wrong = Policy(7, 9, 4, hidden, (3,), 0.1, 2.0, rng, activation=activation)
        with pytest.raises(ValueError, match="expected two of leaky_relu"):
            policies.gated(wrong, wrong, range(7), {2: 3.0}, speed, width, depth, 3.0)


def test_join_command(whole, tmp_path, char, capsys):  # noqa: F811
    """The arms of one policy and the rest of one that knows the headset alone; training goes on from it."""
    hmd, out = str(tmp_path / "hmd.npz"), str(tmp_path / "both.npz")
    policies.main(["carry", str(whole), hmd, "--sensors", "hmd"])
    arms = ["--motors", "shoulder_*,elbow_*"]
    policies.main(["join", out, str(whole), hmd, *arms])
    assert "shoulder_*, elbow_* of" in capsys.readouterr().out
    (a, _), (b, _), (both, meta) = (load_policy(p) for p in (whole, hmd, out))
    names = input_names(char, asymmetric=False)
    x = (a.norm.mean + np.random.default_rng(0).normal(size=(20, 459)) / a.norm.inv_std).astype(np.float32)[:, :189]
    seen = [names.index(n) for n in input_names(char, 1, False)]
    own = np.array([char.hinges[h].startswith(("shoulder", "elbow")) for h in char.driven])
    asked = np.where(own, a.mean_action(x), b.mean_action(x[:, seen]))
    np.testing.assert_allclose(both.mean_action(x), asked, atol=1e-5)
    assert np.abs(a.mean_action(x) - b.mean_action(x[:, seen])).max() > 1e-4  # they do not agree by themselves
    assert meta["joined"] == {"with": "hmd.npz", "motors": ["shoulder_*", "elbow_*"]}
    hidden = ",".join(map(str, both.hidden))
    assert train(tmp_path / "more", 1, "--init", out, "--hidden", hidden)[1]["before"] == meta["steps"]

    led, damped, new = (str(tmp_path / f"{n}.npz") for n in ("led", "damped", "new"))
    policies.main(["ship", str(whole), led, "--lead", "0.05", "--damping", "0.1"])
    policies.main(["ship", str(whole), damped, "--damping", "0.1"])
    for files, flags, line in (
        ([hmd, str(whole)], arms, "sees user_previous.l.x, which .*hmd.npz does not"),
        ([str(whole), hmd], ["--motors", "wing_*"], "--motors wing_.: none; valid: some of hip_l_y"),
        ([str(whole), hmd], ["--motors", "elbow_*,wing_*"], "--motors wing_.: none; valid"),
        ([str(whole), hmd], ["--motors", "*"], "--motors .: all; valid"),
        ([led, hmd], arms, "ahead, --lead 0.05 --damping 0.1; valid: .*--lead -0.05 --damping -0.1"),
        ([damped, hmd], arms, "ahead, --damping 0.1; valid: .*NEW.npz --damping -0.1"),
        ([str(whole), hmd], [], "valid: one of --motors, --backwards and --faster"),
        ([str(whole), hmd], [*arms, "--backwards", "0.2"], "valid: one of --motors, --backwards and --faster"),
    ):
        with pytest.raises(UserError, match=line):
            policies.main(["join", new, *files, *flags])
    assert not Path(new).exists()
    with pytest.raises(UserError, match="hidden layers .12,. of leaky_relu, expected two"):
        policies.main(["join", new, str(whole), hmd, "--backwards", "0.2"])


@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_join_backwards(tmp_path, char, capsys, way):
    """Standing and one way one policy acts, the other way the other, which knows the headset alone."""
    two, hmd, out = (str(tmp_path / n) for n in ("two", "hmd.npz", "both.npz"))
    train(tmp_path / "two", 1, "--hidden", "12,8")
    policies.main(["carry", two, hmd, "--sensors", "hmd"])
    flag, speed = ("backwards", 0.2) if way < 0 else ("faster", 1.5)
    policies.main(["join", out, two, hmd, f"--{flag}", str(speed)])
    assert ("forwards of" if way < 0 else "slower of") in capsys.readouterr().out
    (a, _), (b, _), (both, meta) = (load_policy(p) for p in (two, hmd, out))
    assert meta["joined"] == {"with": "hmd.npz", flag: speed}
    names = input_names(char, asymmetric=False)
    x = (a.norm.mean + np.random.default_rng(0).normal(size=(200, 459)) / a.norm.inv_std)[:, : a.obs_size]
    seen = [names.index(n) for n in input_names(char, 1, False)]
    now, before, root = (names.index(n) for n in ("user.h.x", "user_previous.h.x", "qd.vx"))
    cases = (-0.1, -0.1, a, b), (0.5, 0.05, a, b), (0.5, 0.4, b, a), (-1.5, 0.4, a, b)  # m/s, that way: headset, root
    if way > 0:
        cases = (0.0, 0.0, a, b), (1.2, 1.0, a, b), (3.0, 2.5, b, a), (2.2, 2.1, b, a), (-2.0, -2.0, a, b)
    for speed, own, acts, rests in cases:
        x[:, now], x[:, root] = a.norm.mean[now], way * own
        x[:, before] = x[:, now] - way * speed / 30.0
        asked, left = (p.mean_action(x[:, seen] if p is b else x) for p in (acts, rests))
        assert np.abs(both.mean_action(x) - asked).mean() < 0.1 * np.abs(asked - left).mean()


# ------------------------------------------------------------------------------------ carry


def test_input_names(char, ref):
    """Each name where the observation has that number: looked up in MuJoCo's own arrays."""
    env = Env(char, ref, 2, seed=1)
    env.reset()
    names, m = input_names(char), char.model
    assert len(names) == len(set(names)) == env.full.shape[1]
    at = lambda name: env.full[:, names.index(name)]  # noqa: E731
    for hinge in ("knee_l_y", "hip_r_z"):
        k = m.joint(hinge).qposadr[0]
        np.testing.assert_allclose(at(f"q.{hinge}"), env.qpos[:, k], rtol=1e-6)
        np.testing.assert_allclose(at(f"qd.{hinge}"), env.qvel[:, k - 1], rtol=1e-6)
    for body in ("head", "foot_r"):
        np.testing.assert_allclose(at(f"x.{body}.z"), env.xpos[:, m.body(body).id, 2], rtol=1e-5)
        np.testing.assert_allclose(at(f"R.{body}.R4"), env.xmat[:, m.body(body).id, 6], atol=1e-5)  # row 2, column 0
    np.testing.assert_allclose(at("user.r.z"), ref.sensor_pos[env.frame, 2, 2], rtol=1e-5)
    assert set(input_names(char, 1)) < set(names) and "human_pos_in_15.44" in names


def test_widened_is_the_same_function():
    rng = np.random.default_rng(3)
    mlp = nn.MLP((7, 12, 9, 4), rng=rng, dtype=np.float64)
    for name in ("b0", "b1", "b2"):
        mlp.params[name][:] = rng.normal(size=mlp.params[name].shape)
    wide = policies.widened(mlp, (7, 20, 9, 4), rng)
    x = rng.normal(size=(30, 7))
    np.testing.assert_allclose(wide(x), mlp(x), rtol=1e-12)
    # the new units are silent, not dead: their outgoing weights have a gradient
    y, cache = wide.forward(x)
    _, dtheta = wide.backward(rng.normal(size=y.shape), cache)
    assert np.abs(wide.unflatten(dtheta)["W1"][12:]).min() > 0
    for sizes in ((7, 12, 4), (8, 20, 9, 4), (7, 20, 8, 4), (7, 20, 9, 5)):
        with pytest.raises(ValueError, match="expected 4 from 7 to 4"):
            policies.widened(mlp, sizes, rng)


def test_wider_layers():
    rng = np.random.default_rng(1)
    old = Policy(9, 11, 3, (8, 6), (7,), 0.1, 2.0, rng)
    old.norm.update(rng.normal(2.0, 3.0, (50, 11)))
    new = policies.with_layers(old, (16, 6), (12,), "a.npz")
    x = rng.normal(2.0, 3.0, (20, 11)).astype(np.float32)
    np.testing.assert_allclose(new.mean_action(x[:, :9]), old.mean_action(x[:, :9]), atol=1e-6)
    np.testing.assert_allclose(new.value(new.norm.normalise(x)), old.value(old.norm.normalise(x)), rtol=1e-5)
    np.testing.assert_array_equal(new.log_std, old.log_std)
    assert new.shape() == old.shape() | {"hidden": [16, 6], "value_hidden": [12]}
    for wrong in (((8, 5), (7,)), ((8, 6, 4), (7,)), ((8, 6), (6,))):
        with pytest.raises(UserError, match="a.npz: its layers are .*none smaller"):
            policies.with_layers(old, *wrong, "a.npz")


def test_headset_only(whole, tmp_path, char):  # noqa: F811
    """§4.2: where the controllers' numbers are at their means, the policy without them does and expects the same."""
    rng = np.random.default_rng(0)
    old, _ = load_policy(whole)
    new, _ = carried(whole, char, char, Carry(sensors="hmd"))
    keep = [input_names(char).index(n) for n in input_names(char, 1)]
    gone = np.setdiff1d(np.arange(459), keep)
    assert (new.obs_size, new.critic_size) == (153, 423) and len(gone) == 36 and gone.max() < 189
    x = (old.norm.mean + rng.normal(size=(50, 459)) / old.norm.inv_std).astype(np.float32)
    x[:, gone] = old.norm.mean[gone]
    np.testing.assert_allclose(new.mean_action(x[:, keep[:153]]), old.mean_action(x[:, :189]), atol=1e-6)
    for policy in (old, new):  # in double precision: the order of single precision's sums is the BLAS's affair
        policy.critic.theta = policy.critic.theta.astype(float)
    np.testing.assert_allclose(new.value(new.norm.normalise(x[:, keep])), old.value(old.norm.normalise(x)), rtol=1e-5)
    moved = x.copy()
    moved[:, gone] += 1.0
    assert np.abs(old.mean_action(moved[:, :189]) - old.mean_action(x[:, :189])).max() > 1e-4  # they had mattered
    np.testing.assert_array_equal(new.log_std, old.log_std)

    file, more = str(tmp_path / "hmd.npz"), ["--sensors", "hmd", "--init", str(tmp_path / "hmd.npz")]
    policies.main(["carry", str(whole), file, "--sensors", "hmd", "--hidden", "16"])
    _, meta = train(tmp_path / "a", 1, *more, "--hidden", "16")
    assert meta["options"]["sensors"] == "hmd" and meta["policy"]["obs_size"] == 153 and meta["before"] == 6 * 64
    with pytest.raises(UserError, match="trained with the headset alone: give --sensors hmd"):
        policies.main(["carry", file, str(tmp_path / "b.npz"), "--sensors", "full"])


def test_symmetric_critic(whole, char):  # noqa: F811
    """§5.3: the critic goes on without what only it saw; the actor is the same."""
    old, _ = load_policy(whole)
    new, meta = carried(whole, char, char, Carry(without=("asymmetric",)))
    assert new.obs_size == new.critic_size == 189 and meta["options"]["without"] == ["asymmetric"]
    x = (old.norm.mean + np.random.default_rng(1).normal(size=(20, 459)) / old.norm.inv_std).astype(np.float32)
    x[:, 189:] = old.norm.mean[189:]
    np.testing.assert_allclose(new.mean_action(x[:, :189]), old.mean_action(x[:, :189]), atol=1e-6)
    seen = new.norm.normalise(x[:, :189])
    np.testing.assert_allclose(new.value(seen), old.value(old.norm.normalise(x)), rtol=1e-5)


def test_another_character(whole, tmp_path, capsys):  # noqa: F811
    """What has the same name goes on, whatever its place; the rest is silent; normaliser and σ begin anew."""
    old, _ = load_policy(whole)
    file = tmp_path / "dino.npz"
    policies.main(["carry", str(whole), str(file), "--character", "dino"])
    assert "jesse's policy: 459 of 487 inputs and 33 of 37 torques of dino" in capsys.readouterr().out
    _, meta = train(tmp_path / "dino", 1, "--character", "dino", "--init", str(file))
    assert meta["policy"]["action_size"] == 37 and meta["options"]["character"] == "dino"
    jesse, dino = character.load("jesse"), character.load("dino")
    clip = data.builtin_clips()[0][:40]
    a, b = (Env(c, retarget.reference(c, [clip]), 3, threads=1) for c in (jesse, dino))
    new, _ = load_policy(file)
    np.testing.assert_allclose(new.log_std, np.log(0.06), rtol=1e-6)  # of Dino's recipe
    assert new.norm.count == 0
    names = [input_names(c) for c in (jesse, dino)]
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


def saved(folder, char, **options):
    """A policy of a character, not trained, and its file."""
    rng = np.random.default_rng(0)
    sizes = len(input_names(char)), len(char.driven)
    policy = Policy(sizes[0] - 270, sizes[0], sizes[1], (8,), (4,), 0.1, 1.0, rng)
    policy.theta_pi += 0.3 * rng.standard_normal(policy.theta_pi.size).astype(np.float32)
    policy.norm.update(rng.normal(size=(50, sizes[0])))
    path, told = folder / "p.npz", {"character": char.name, "motion": "builtin"} | options
    save_checkpoint(path, policy.arrays(), {"policy": policy.shape(), "options": told, "steps": 5})
    return policy, path


def test_a_variation(tmp_path):
    """Dino's tail without motors: four are gone, the others' torques and the normaliser are as they were."""
    rng = np.random.default_rng(0)
    dino, limp = (character.load("dino", tail=tail) for tail in (None, "passive"))
    old, path = saved(tmp_path, dino)
    new, _ = carried(path, dino, limp, Carry())
    x = rng.normal(size=(5, old.obs_size)).astype(np.float32)
    kept = [k for k, h in enumerate(dino.driven) if not dino.hinges[h].startswith("tail")]
    np.testing.assert_allclose(new.mean_action(x), old.mean_action(x)[:, kept], atol=1e-6)
    np.testing.assert_array_equal(new.norm.mean, old.norm.mean)
    np.testing.assert_array_equal(new.log_std, old.log_std[kept])
    small = character.load("dino", scale=0.5)  # limits grow with springs and weights: the same action does the same
    np.testing.assert_allclose(carried(path, dino, small, Carry())[0].mean_action(x), old.mean_action(x), atol=1e-6)


def test_another_body(tmp_path):
    """Other limits and springs: in the default pose the same torque acts on every joint, and is explored as widely."""
    change = ("torque.base.default=400", "torque.scale.Neck=0.5", "passive.stiffness.spine=80", 'passive.hold=["head"]')
    before, after = character.load("dino"), character.load("dino", set=change)
    old, path = saved(tmp_path, before)
    new, _ = carried(path, before, after, Carry())
    x = np.random.default_rng(0).normal(size=(5, old.obs_size)).astype(np.float32)
    assert not np.allclose(before.limits, after.limits)
    torque = []
    for char, policy in ((before, old), (after, new)):
        m, h = char.model, char.driven
        spring = m.jnt_stiffness[1 + h] * (m.qpos_spring[7 + h] - char.default[h])
        torque.append(policy.mean_action(x) * char.limits + spring)
    np.testing.assert_allclose(torque[0], torque[1], rtol=1e-4, atol=1e-2)
    sigma = [np.exp(p.log_std) * c.limits for p, c in ((old, before), (new, after))]
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=1e-5)
    bias = [policies.with_limits(p, c, c).actor.params["b1"].copy() for p, c in ((new, after),)]
    np.testing.assert_array_equal(bias[0], new.actor.params["b1"])  # the same body: nothing


def test_another_pose(tmp_path):
    """A bent spine: what is sensed of it at rest, by MuJoCo, is as if it were upright, and so is what is done then."""
    bent = {"pose.spine_y": 0.28, "pose.neck_y": -0.5, "pose.head_y": -0.55}
    chars = character.load("dino"), character.load("dino", set=[f"{k}={v}" for k, v in bent.items()])
    before, path = saved(tmp_path, chars[0])
    after, _ = carried(path, *chars, Carry())
    names, sites = input_names(chars[0]), []
    for char in chars:
        sim = mujoco.MjData(char.model)
        sim.qpos[:] = char.upright
        mujoco.mj_kinematics(char.model, sim)
        sites.append(sim.site_xpos[char.sensor_sites[0], 2] - sim.xpos[1, 2])
    shift = dict(zip(names, after.norm.mean - before.norm.mean))
    for hinge, old, new in zip(chars[0].hinges, chars[0].default, chars[1].default, strict=True):
        np.testing.assert_allclose(shift[f"q.{hinge}"], new - old, atol=1e-6)
    assert all(v == 0.0 for n, v in shift.items() if n.startswith(("qd.", "human_")))
    lower = sites[1] - sites[0]  # of the headset above the root; the user's heights are scaled to it
    assert lower < -0.1 and abs(shift["user.h.z"] - lower) < 0.02 and abs(shift["user.h.y"]) < 1e-6
    rest = [np.array([[*policies.at_rest(c).values()]], np.float32) for c in chars]
    np.testing.assert_allclose(after.mean_action(rest[1]), before.mean_action(rest[0]), atol=1e-4)
    assert np.abs(after.mean_action(rest[0]) - before.mean_action(rest[0])).max() > 0.01


def test_carry_command(tmp_path, capsys):
    """The old body from a file; the policy's own variation where no flag says otherwise; what the file says then."""
    dino = character.load("dino")
    text = dino.path.read_text().replace("default = 288.0", "default = 144.0")
    (tmp_path / "old.toml").write_text(text)
    (tmp_path / "dino.xml").write_text(dino.xml.read_text())
    _, path = saved(tmp_path, dino, set="reward.contact=[0.5, 1.0]", without=["contact", "asymmetric"])
    out = tmp_path / "new.npz"
    args = ["carry", str(path), str(out), "--from-character", str(tmp_path / "old.toml"), "--hidden", "12"]
    policies.main([*args, "--value-hidden", "6"])
    assert "new.npz: dino, 5 steps before" in capsys.readouterr().out
    (a, _), (b, meta) = load_policy(path), load_policy(out)
    np.testing.assert_allclose(b.log_std, a.log_std + np.log(0.5), rtol=1e-5)
    assert meta["options"]["set"] == "reward.contact=[0.5, 1.0]" and meta["options"]["character"] == "dino"
    assert (b.hidden, b.value_hidden, meta["carried"], meta["steps"]) == ((12,), (6,), "p.npz", 5)
    assert meta["licence"] == "MIT"
    assert meta["options"]["without"] == ["contact"]  # it learnt so; which critic it gets is said anew
    saved(tmp_path, dino, init=str(character.CHARACTERS / "dino.npz"))  # not named by what is carried: its terms are
    out.unlink()
    policies.main(args)
    terms = load_policy(character.CHARACTERS / "dino.npz")[1]["licence"]
    assert load_policy(out)[1]["licence"] == terms
    saved(tmp_path, dino, set="reward.contact=[0.5, 1.0]")
    out.unlink()
    policies.main(["carry", str(path), str(out), "--tail", "passive", "--set", ""])
    _, meta = load_policy(out)
    assert meta["options"]["tail"] == "passive" and not meta["options"]["set"] and meta["policy"]["action_size"] == 33
    with pytest.raises(UserError, match="33 actions.*37: give the body it was trained with as --from-character"):
        carried(out, dino, dino, Carry())
    save_checkpoint(path, a.arrays(), {"policy": a.shape()})
    with pytest.raises(UserError, match="does not say of which character"):
        policies.main(["carry", str(path), str(tmp_path / "none.npz")])


def test_wrong_commands(tmp_path, capsys):
    for words in ("", "shop", "ship a", "ship a b c", "blend a b", "join a b", "carry a"):
        with pytest.raises(UserError, match="valid: ship RUN OUT.npz, blend OUT.npz A B …, join OUT.npz A B, carry "):
            policies.main(words.split())
    with pytest.raises(SystemExit) as end:
        policies.main(["carry", "--help"])
    assert end.value.code == 0 and "--from-character" in capsys.readouterr().out
    with pytest.raises(UserError, match="no checkpoint"):
        policies.main(["ship", str(tmp_path / "none.npz"), str(tmp_path / "b.npz")])
    with pytest.raises(UserError, match="there is no folder"):
        policies.main(["ship", "a.npz", str(tmp_path / "none" / "b.npz")])

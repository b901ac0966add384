"""extras/arms.py: every arm is a command; arms take turns; the table and the curves of what was run."""

import json
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest

import env
import metrics
from extras import arms, train
from mocap import data
from plumbing import runs
from plumbing.cli import UserError, cli, run_main
from policy import STUB, initial, load_policy, widths
from retarget import Reference

TINY = "--recipe none --envs 4 --horizon 4 --minibatch 16 --hidden 8 --value-hidden 8"


@pytest.fixture
def two(tmp_path, monkeypatch):
    """Two arms of 64 steps on the built-in motions, in turns of 32; -> the folder"""
    monkeypatch.setattr(arms, "BATCH", TINY)
    flags = ["--steps", "64", "--turn", "32", "--out", str(tmp_path / "arms")]
    arms.main(["run", "dino", "dino-contact", *flags])
    return tmp_path / "arms"


def test_every_arm_is_a_command():
    """Each can be parsed and loaded, and differs from its claim's other arms of that character; each is in a claim."""
    opt = arms.Options(motion="builtin", seed=3)
    for name, arm in arms.ARMS.items():
        asked = cli(train.Options, arms.command_of(name, opt, 7), "t", "")
        assert (asked.character, asked.recipe, asked.steps, asked.seed) == (arm.character, "none", 7, 3)
        assert asked.out.endswith(f"{name}.3") and not asked.resume
        char = env.ablated(asked.load(), asked.without, asked.track)
        assert bool(char.variant) == any(k in arm.flags for k in ("tail", "scale", "set"))
    assert set(arms.ARMS) == {n for claim in arms.CLAIMS for n in claim.arms}
    for claim in arms.CLAIMS:
        made = [(arms.ARMS[n].character, arms.ARMS[n].flags) for n in claim.arms]
        assert len(set(made)) == len(made) and set(claim.sets) <= set(arms.SETS)
        for character in {c for c, _ in made}:  # one without a change to compare with, and the same motions for all
            own = [n for n in claim.arms if arms.ARMS[n].character == character]
            assert [arms.ARMS[n].flags for n in own].count("") == 1
            assert len({arms.ARMS[n].clips for n in own}) == 1


def test_arms_take_turns(two, tmp_path, capsys):
    """In turns is as in one go; a second command goes on, or does nothing where all is done."""
    opt = arms.Options(out=str(two))
    assert [arms.steps_of(name, opt) for name in ("dino", "dino-contact", "oppy")] == [64, 64, 0]
    one = ["run", "dino-contact", "--steps", "64", "--turn", "1000", "--out", str(tmp_path / "one")]
    arms.main(one)
    (a, meta), (b, _) = load_policy(two / "dino-contact.0"), load_policy(tmp_path / "one" / "dino-contact.0")
    np.testing.assert_array_equal(a.theta_pi, b.theta_pi)
    assert meta["options"]["without"] == ["contact"]
    capsys.readouterr()
    arms.main(one)
    assert "extras.train" not in capsys.readouterr().out


def test_whose_turn_it_is(monkeypatch):
    """The one that is least far, to the next multiple of a turn; a signal ends it."""
    steps, seen = {"dino": 250, "oppy": 0}, []
    monkeypatch.setattr(arms, "steps_of", lambda name, opt: steps[name])
    monkeypatch.setattr(train, "read_options", lambda kind, argv, *_: cli(kind, argv, "t", ""))
    monkeypatch.setattr(train, "train", lambda opt: seen.append((opt.character, opt.steps)) or opt)
    arms.run(["dino", "oppy"], arms.Options(steps=500, turn=200))
    assert seen == [("oppy", 200), ("oppy", 400), ("dino", 400), ("dino", 500), ("oppy", 500)]
    seen.clear()
    monkeypatch.setattr(train, "train", lambda opt: seen.append(1) or SimpleNamespace(steps=opt.steps - 1))
    arms.run(["dino", "oppy"], arms.Options(steps=500, turn=200))
    assert len(seen) == 1


def test_pieces():
    """Cut from the first frame on; the rest is left out; evenly chosen; a sequence that is too short gives none."""
    arrays = {f.name: np.arange(200) for f in fields(Reference) if f.name not in ("names", "rate", "first", "last")}
    ref = Reference(["a", "b", "c"], 30.0, np.array([0, 100, 120]), np.array([99, 119, 199]), **arrays)
    cut = arms.pieces(ref, 1.0, 99)
    assert cut.names == ["a", "a", "a", "c", "c"]
    assert cut.qpos[cut.first].tolist() == [0, 30, 60, 120, 150]
    assert cut.qpos[cut.last].tolist() == [30, 60, 90, 150, 180]
    assert cut.first[0] == 0 and cut.last[-1] == len(cut) - 1 and (cut.first[1:] == cut.last[:-1] + 1).all()
    assert arms.pieces(ref, 1.0, 2).qpos[[0, 31]].tolist() == [0, 150]
    with pytest.raises(UserError, match="--seconds 9: no sequence is so long; valid: 3.3 or less"):
        arms.pieces(ref, 9.0, 2)


def test_curve(tmp_path):
    """Time lived by failures over the tenth before a mark; marks that were not reached are left out."""
    steps = np.arange(1, 61) * 10_000
    failures = np.where(steps <= 100_000, 10, 20)
    rows = [f"{s},{f},{5.0 * 10 / f},0,0" for s, f in zip(steps, failures, strict=True)]
    (tmp_path / "m.csv").write_text("\n".join(["steps,failures,time_to_failure,survival,length", *rows, ""]))
    assert arms.curve(tmp_path / "m.csv") == {0.1: 5.0, 0.2: 2.5, 0.5: 2.5}


def test_headset_arm_is_held_against_the_user():
    """§4.2: what it is not shown is measured all the same: hands against the user's controllers, not its headset."""
    char = train.Options(character="jesse").load()
    ref = arms.pieces(arms.reference(char, data.sequences("builtin", "validation", "*walk*", verbose=False)), 1.0, 2)
    alone = arms.measured(char, ref, metrics.zero_action, 1, env.headset_only(ref))
    assert alone["hands_cm"] == pytest.approx(arms.measured(char, ref, metrics.zero_action, 1)["hands_cm"])


def test_table(two, tmp_path, capsys):
    """A table of the claims whose arms were run, their baselines, and the curves; the numbers are metrics.py's."""
    capsys.readouterr()
    flags = ["--out", str(two), "--most", "6", "--seconds", "1", "--json", str(tmp_path / "t.json")]
    arms.main(["table", *flags])
    out, found = capsys.readouterr().out, json.loads((tmp_path / "t.json").read_text())
    assert "§4.3.1 contact reward; walks, tracked: 6 pieces of 1 s" in out and "| oppy | not run |" in out
    assert "§5.1" not in out and "fails every, s, while it learns" in out
    title = "§4.3.1 contact reward; walks"
    assert {k.split("; ")[-1] for k in found if k.startswith(title)} == {
        "dino", "dino-contact", "dino, no torque", "dino, kinematic"
    }  # fmt: skip
    row = found[f"{title}; dino"]
    assert row["steps"] == 64 and row["clips"] == 6
    char = train.Options(character="dino").load()
    ref = arms.pieces(arms.reference(char, data.sequences("builtin", "validation", "*walk*", verbose=False)), 1.0, 6)
    policy, _ = load_policy(two / "dino.0")
    again = metrics.simulate(char, ref, metrics.policy_action(policy), threads=1)
    failed = sum(r.failed for r in again)
    lived = (sum(len(r.frames) - 1 for r in again) + failed) / 30  # the step that failed, too
    assert row["fails_every_s"] == pytest.approx(lived / failed)
    assert row["survival"] == pytest.approx(np.mean([(len(r.frames) - 1) / 30 for r in again]))
    with pytest.raises(UserError, match="no two arms of a claim and seed 9 were run"):
        arms.table(arms.Options(out=str(two), seed=9))


def test_an_arm_is_measured_in_its_own_body(tmp_path, monkeypatch):
    """§4.3.1: a small Oppy's row is of a small Oppy."""
    monkeypatch.setattr(arms, "BATCH", TINY)
    arms.main(["run", "oppy-small", "--steps", "16", "--turn", "16", "--out", str(tmp_path)])
    measuring = arms.Measuring(arms.Options(out=str(tmp_path), seconds=1.0, most=2))
    measuring.clips["walks"] = [data.load("builtin", clips="walk_105")[0][:70]]
    row = measuring.arm("oppy-small", "walks")
    policy, _ = load_policy(tmp_path / "oppy-small.0")
    small = train.Options(character="oppy", scale=0.7).load()
    ref = arms.pieces(arms.reference(small, measuring.clips["walks"]), 1.0, 2)
    again = arms.measured(small, ref, metrics.policy_action(policy), 1)
    assert row == pytest.approx(again | {"steps": 16}, nan_ok=True)


def test_unequal_arms_are_named():
    """Arms of one character with other steps are not to be compared; those of two characters are."""
    rows = {"dino": {"steps": 10}, "dino-contact": {"steps": 20}, "oppy": {"steps": 5}, "oppy-contact": None}
    assert arms.unequal(rows) == ["not to be compared: dino 10, dino-contact 20"]
    assert arms.unequal(rows | {"dino": {"steps": 20}}) == []


def test_ship(two, tmp_path, capsys):
    """The same actions from a smaller file, which says what it is."""
    out = tmp_path / "x.npz"
    arms.main(["ship", str(two / "dino-contact.0"), str(out)])
    assert "64 steps; MIT" in capsys.readouterr().out
    (own, _), (light, meta) = load_policy(two / "dino-contact.0"), load_policy(out)
    seen = np.random.default_rng(0).standard_normal((5, own.obs_size))
    np.testing.assert_array_equal(own.mean_action(seen), light.mean_action(seen))
    assert light.value_hidden == STUB and meta["options"]["without"] == ["contact"]
    assert meta["options"]["out"] is None
    assert widths(out, "dino") == {"hidden": own.hidden}  # who goes on learning begins with a new critic
    opt = SimpleNamespace(character="dino", gamma=0.9, min_sigma=0.01, seed=3, hidden=own.hidden, value_hidden=(7,))
    env = SimpleNamespace(**own.shape() | {"value_scale": lambda gamma: 2.0})
    whole, steps = initial(out, opt, env)
    assert (whole.value_hidden, steps) == ((7,), 64) and "begins with a new one" in capsys.readouterr().out
    np.testing.assert_array_equal(whole.actor.theta, own.actor.theta)
    assert whole.critic.theta.any() and whole.norm.count == own.norm.count
    with pytest.raises(UserError, match="exists already"):
        arms.main(["ship", str(two / "dino-contact.0"), str(out)])


@pytest.mark.parametrize(
    "argv, says",
    [
        (["walk"], "walk: valid: run NAME …, table, or ship"),
        (["run"], "run: valid: run NAME"),
        (["table", "dino"], "table dino: valid: run NAME"),
        (["run", "dina"], "dina: no such arm; valid: dino, dino-contact"),
        (["run", "dino", "--json", "x"], "--json would do nothing for run"),
        (["table", "--turn", "5"], "--turn would do nothing for table"),
    ],
)
def test_wrong_commands(argv, says, capsys):
    """One line that says what would be valid; without words the arms are listed."""
    with pytest.raises(SystemExit):
        run_main(arms.main, argv)
    assert says in capsys.readouterr().err
    arms.main([])
    assert "§5.1 Dino's tail" in capsys.readouterr().out


def test_folder_names_arm_and_seed():
    """Two seeds do not share a folder."""
    assert runs.CONFIG and arms.folder_of("dino", arms.Options(out="o", seed=2)).as_posix() == "o/dino.2"

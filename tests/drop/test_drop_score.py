"""drop/score.py: the measures of the scoreboard are right, and it is written whole."""

import json

import numpy as np
import pytest

from drop import body, demos, figures, score, simulator
from drop.__main__ import main
from drop.body import STANDING, STEP, J, N
from drop.simulator import State
from plumbing.cli import run_main

STAND = body.forward_kinematics(body.OFFSETS[0], np.tile([1.0, 0, 0, 0], (N, 1)))


@pytest.fixture(scope="module")
def stage():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demos, "BUILTIN", (("walk", 8, {"speed": 1.2}), ("jog", 6, {"speed": 2.5}), ("stand", 4, {})))
        yield demos.Stage(demos.Options())


def test_spread():
    """The mean over pairs, by a loop."""
    p = np.random.default_rng(0).standard_normal((5, 2))
    slow = [np.linalg.norm(p[i] - p[j]) for i in range(5) for j in range(i)]
    assert score.spread(p) == pytest.approx(np.mean(slow))
    assert score.spread(np.ones((8, 2))) == 0.0


def test_stands():
    """On the feet; not kneeling, not bent double."""
    still = lambda x: State(x, 0 * x, np.tile([1.0, 0, 0, 0], (N, 1)))  # noqa: E731
    assert score.stands(still(STAND))
    assert not score.stands(still(STAND - [0, 0, 0.25 * STANDING]))
    bent = STAND.copy()
    bent[J["neck"]] = bent[0] + [0.4, 0, 0.1]
    assert not score.stands(still(bent))


def test_walks(stage):
    """Seeds differ; the slide is measure's; one who is asked for more goes faster."""
    takes = score.walks(stage, seeds=2, frames=60)
    assert [len(t) for t in takes.values()] == [2, 2]
    assert score.slide(takes["free"]) == pytest.approx(np.mean([demos.measure(t)[0]["slide"] for t in takes["free"]]))
    assert score.spread(np.array([t.states[-1][0].com[:2] for t in takes["pushed"]])) > 0
    run = score.hurried(stage, frames=60)
    travel = np.linalg.norm(run.states[-1][0].com[:2] - run.states[30][0].com[:2]) / (29 * STEP)
    assert travel > 1.4


def test_pushed_over(stage):
    """He falls; lies still without rising; one who is not pushed hard enough is not counted."""
    states = score.pushed_over(stage, 1, 240, rise=False)
    assert len(states) == 240 and any(demos.fallen(s) for s in states)
    assert max(np.linalg.norm(s.v, axis=1).max() for s in states[-30:]) < 0.05
    assert not score.stands(states[-1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demos, "FELLING", 5.0)
        assert score.pushed_over(stage, 1, 100) is None


def test_every_particle_of_who_lies_is_still(monkeypatch):
    """Whom the learned prior let fall lies still in all his particles within four seconds, and stays so.

    The two who moved longest when joint limits clipped angles: for nine seconds at up to 5.6 m/s, and for six."""
    felled = demos.Stage(demos.Options(prior="vae", range="vae"))
    for number in (2, 7):
        states = score.pushed_over(felled, number, 180, rise=False)
        speed = np.linalg.norm([s.v for s in states], axis=-1)  # (180, 22)
        assert speed.shape == (180, N) and speed[120:].max() < 0.05, number


def test_command(monkeypatch, capsys, tmp_path):
    """Every key for both priors; what is wrong is told in one line."""
    monkeypatch.setattr(demos, "BUILTIN", (("walk", 6, {"speed": 1.2}), ("jog", 6, {"speed": 2.5})))
    for name, value in (("SEEDS", 2), ("RECOVER", 70), ("LYING", 70), ("LIERS", 1)):
        monkeypatch.setattr(score, name, value)
    monkeypatch.setattr(score.walks, "__defaults__", (2, 40))
    monkeypatch.setattr(score.hurried, "__defaults__", (40,))
    monkeypatch.setattr(figures, "RECOVERY", (20, 30))
    file = tmp_path / "s.json"
    main(["score", "--count", "1", "--frames", "35", "--json", str(file)])
    found = json.loads(file.read_text())
    assert list(found) == ["nearest", "vae"] and "nearest: diversity_m" in capsys.readouterr().out
    for each in found.values():
        keys = "diversity_m foot_slide_m_s ekin_lowered falls getups pushed lying_speed_m_s"
        assert set(keys.split()) <= set(each)
        assert np.isfinite([v for v in each.values() if not isinstance(v, str)]).all() and each["pushed"] <= 1
    with pytest.raises(SystemExit) as end:
        run_main(main, ["score", "--prior", "none"])
    assert end.value.code == 2 and capsys.readouterr().err.count("\n") == 1
    assert simulator.Weights().inside > 0

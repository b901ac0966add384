"""drop/figures.py: the energies' figures, ablations and failures, each number computed another way."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drop import demos, figures
from drop.__main__ import main
from drop.body import GRAVITY, OFFSETS, RADII, STEP, J, N, forward_kinematics
from drop.prior import NearestPrior
from drop.simulator import Outcome, Simulator, State
from plumbing import render
from plumbing.cli import UserError, run_main

SHORT = (("walk", 8, {"speed": 1.2}), ("jog", 6, {"speed": 2.5}), ("stand", 4, {}))


@pytest.fixture(scope="module")
def stage():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demos, "BUILTIN", SHORT)
        yield demos.Stage(demos.Options())


def test_watched(stage):
    """Switched off, the range of motion is measured still, by the rule given; the motion is the same as without."""
    _, state = stage.start(1.2)
    step = lambda kind, **kw: kind(stage.general, **kw).step(state, rng=np.random.default_rng(0))  # noqa: E731
    np.testing.assert_array_equal(step(figures.Watched, limits=None)[0].x, step(Simulator, limits=None)[0].x)
    sim = figures.Watched(stage.general, limits=None)
    sim.measure = lambda x, twist: x + [0, 0, 0.01]
    found = sim.step(state, rng=np.random.default_rng(0))[1]
    assert found.energies["range_of_motion"] == pytest.approx(0.5 * 9 * 900 * N * 1e-4)
    assert sim.limits is None


def test_prior_mean(stage):
    """E_kin of the mode alone by hand; never below that of the whole set by more than the iterations leave."""
    sim, state = stage.start(1.2)
    e, down = figures.pushed(sim, state, 12, np.zeros((N, 3)), np.random.default_rng(0))
    assert e.shape == (12, 6) and not down.any()
    fresh = NearestPrior([c[1:] for c in stage.clips])
    again = Simulator(fresh).step(state, rng=np.random.default_rng(0))
    mode = fresh.mode(state)[0]
    assert e[0, 1] == pytest.approx(0.5 * 9 * 900 * np.sum((again[0].x - mode) ** 2))
    assert e[0, 0] == pytest.approx(again[1].energies["prior"])
    assert np.median(e[:, 0]) <= np.median(e[:, 1]) + 1e-9


def test_ensemble(stage):
    """The same motions and pushes whatever is switched off; the push comes when it should, and raises the energies."""
    opt = figures.Options(count=2, frames=80, newton=150.0)
    full, down, names = figures.ensemble(stage, opt)
    brief = figures.Options(count=2, frames=6)
    bare, _, again = figures.ensemble(stage, brief, contact=False, limits=False)
    assert full.shape == (2, 80, 6) and down.shape == (2, 80) and names == again
    m = figures.median(full)
    assert m[64:78, 2].mean() > 3 * m[30:60, 2].mean()  # momentum
    assert np.isfinite(bare[:, :, 2:]).all()


def test_the_bare_figure_has_neither_contact_nor_limits(stage, monkeypatch, capsys):
    """Fig. 5 is the same ensemble without contact and range of motion, both measured by the whole one's rule."""
    made = []

    class Seen(figures.Watched):
        def __init__(self, *args, **settings):
            super().__init__(*args, **settings)
            made.append(self)

    monkeypatch.setattr(figures, "Watched", Seen)
    monkeypatch.setattr(demos, "Stage", lambda opt: stage)
    figures.energies(figures.Options(count=1, frames=2))
    full, bare = made
    assert full.contact and full.limits is stage.limits is not None
    assert not bare.contact and bare.limits is None
    assert full.measure is bare.measure is stage.limits


def test_claims():
    """From medians whose ratios are known; a median over motions leaves out those without a prior."""
    full = np.tile([7.0, 10.0, 1, 1, 1, 1], (160, 1))
    c = figures.claims(full, np.tile([35.0, 50.0, 6, 6, 6, 6], (160, 1)))
    assert c["lowered"] == pytest.approx(0.3) and c["prior"] == pytest.approx(5) and c["physics"] == pytest.approx(6)
    e = np.array([[[1.0] * 6], [[np.nan] * 6], [[3.0] * 6]])
    np.testing.assert_array_equal(figures.median(e), [[2.0] * 6])


def test_joint_torques():
    """A held arm stretched sideways: weight times lever; free fall: nothing; the contact takes its share away."""
    rest = np.tile([1.0, 0, 0, 0], (N, 1))
    x0 = forward_kinematics(OFFSETS[0], rest)
    arm = np.linalg.norm(OFFSETS[J["elbow_l"]]), np.linalg.norm(OFFSETS[J["wrist_l"]])
    x0[J["elbow_l"]] = x0[J["shoulder_l"]] + [0, arm[0], 0]
    x0[J["wrist_l"]] = x0[J["elbow_l"]] + [0, arm[1], 0]
    still, none = np.tile(x0, (5, 1, 1)), np.zeros((5, N, 3))
    torque = figures.joint_torques(still, none)
    assert torque[1, J["shoulder_l"]] == pytest.approx(9.81 * (2 * arm[0] + arm[1]))
    assert torque[1, J["elbow_l"]] == pytest.approx(9.81 * arm[1]) and torque[1, J["wrist_l"]] == 0
    fall = still + 0.5 * GRAVITY * (np.arange(5) * STEP)[:, None, None] ** 2
    np.testing.assert_allclose(figures.joint_torques(fall, none), 0.0, atol=1e-9)
    found = Outcome({}, np.zeros(N, bool), 0, 0, 0, x0[[J["wrist_l"]]] - [0, 0, 0.05], np.array([[0, 0, 9.81]]), 0)
    held = np.tile(figures.contact_of(x0, found), (5, 1, 1))
    assert figures.joint_torques(still, held)[1, J["elbow_l"]] == pytest.approx(0.0, abs=1e-9)


def test_detector(stage):
    """Recorded walking is not superhuman; a body that spins on the floor is, and the root wrench does not say so."""
    detect = figures.Detector.calibrated(stage.clips, 3.0)
    assert 5 < detect.limit < 2000
    _, x, quat = stage.clips[0]
    nothing = Outcome({}, np.zeros(N, bool), 0, 5.0, 5.0, np.zeros((0, 3)), np.zeros((0, 3)), 0.0)
    states = [State(a, 0 * a, q) for a, q in zip(x[:90], quat[:90])]
    outcomes = [nothing] * 90
    assert not detect(states, outcomes)["spin"].any()
    flat = Rotation.from_euler("y", 90, degrees=True)
    turns = [Rotation.from_rotvec([0, 0, 12.0 * t * STEP]) * flat for t in range(90)]
    body = x[0] - x[0].mean(axis=0)
    spun = [State(r.apply(body) + [0, 0, 0.15], 0 * body,
                  (r * Rotation.from_quat(quat[0], scalar_first=True)).as_quat(scalar_first=True))
            for r in turns]  # fmt: skip
    by = detect(spun, outcomes)
    assert by["spin"].mean() > 0.9 and not by["wrench"].any()
    hits = figures.Detector(1.0)._lasting(np.r_[np.zeros(20), np.full(20, 2.0), np.zeros(20)], 1.0)
    assert hits[29] and not hits[0] and not hits[-1] and 14 <= hits.sum() <= 22
    lone = figures.Detector(1.0)._lasting(np.r_[np.zeros(20), np.full(3, 9.0), np.zeros(20)], 1.0)
    assert not lone.any()


def short(monkeypatch, frames):
    monkeypatch.setattr(demos, "BUILTIN", SHORT)
    single = demos.single
    monkeypatch.setattr(
        demos, "single", lambda name, sim, state, n, rng, act: single(name, sim, state, min(n, frames), rng, act)
    )


def test_ablations(monkeypatch):
    """Each switch does what §8.3 says: no prior lies down, no contact sinks, no correction leaves the wrench."""
    short(monkeypatch, 55)
    monkeypatch.setattr(figures, "ABLATION", 100.0)
    takes = {t.name: t for t in figures.ablations(figures.Options())}
    assert set(takes) == {"whole", "no prior", "no range of motion", "no contact", "no correction"}
    low = lambda t: min(s[0].x[0, 2] for s in takes[t].states)  # noqa: E731
    assert low("no prior") < 0.4 < low("whole")
    deep = lambda t: max((RADII - s[0].x[:, 2]).max() for s in takes[t].states)  # noqa: E731
    assert deep("no contact") > deep("whole")
    wrench = lambda t: max(o[0].wrench for o in takes[t].outcomes)  # noqa: E731
    assert wrench("no correction") > wrench("whole")
    bent = np.tile([1.0, 0, 0, 0], (N, 1))
    bent[J["knee_l"]] = Rotation.from_euler("y", -60, degrees=True).as_quat(scalar_first=True)
    bent[J["ankle_l"]] = bent[J["foot_l"]] = bent[J["knee_l"]]
    x = forward_kinematics(OFFSETS[0], bent)
    assert figures.outside(State(x, 0 * x, bent)) > 5
    stand = np.tile([1.0, 0, 0, 0], (N, 1))
    assert figures.outside(State(forward_kinematics(OFFSETS[0], stand), 0 * x, stand)) < 1e-6


def test_failures(monkeypatch):
    short(monkeypatch, 40)
    takes = figures.failures(figures.Options())
    assert len(takes) == 3 and all("torque" in t.notes["found superhuman"] for t in takes)


def test_command(monkeypatch, capsys, tmp_path):
    """python -m drop energies: help, numbers, CSV with every column, a picture; one line for what is wrong."""
    short(monkeypatch, 34)

    def run(*args):
        with pytest.raises(SystemExit) as end:
            run_main(main, [str(a) for a in args])
        return end.value.code, capsys.readouterr()

    code, out = run("energies", "--help")
    assert code == 0 and "--count" in out.out
    csv_file, png = tmp_path / "e.csv", tmp_path / "e.png"
    args = ["energies", "--count", 1, "--frames", 104, "--csv", csv_file]
    try:
        render.extra("matplotlib")
        args += ["--png", png]
    except UserError:
        png = None
    code, out = run(*args)
    assert code == 0 and "lowers E_kin" in out.out
    with open(csv_file, newline="") as file:
        rows = list(csv.reader(file))
    assert len(rows) == 105 and rows[0][:3] == ["frame", "full prior", "full prior mean"] and len(rows[0]) == 13
    assert png is None or png.read_bytes()[:4] == b"\x89PNG"
    code, out = run("energies", "--count", 0)
    assert code == 2 and out.err.count("\n") == 1
    code, out = run("ablations")
    assert code == 0 and "no contact" in out.out

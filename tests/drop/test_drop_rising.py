"""drop/keyposes.py, drop/rising.py: the motions from key poses are possible, and whoever is down stands up again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drop import body, demos, keyposes, rising, simulator
from drop.body import FEET, LENGTHS, RADII, STANDING, STEP, J, N
from drop.prior import ClipPrior, down
from drop.simulator import Plane, Simulator, State
from human import heading


def lying(kind, turn=0.0, roll=0.0):
    """A State at rest on the floor: the first pose of a way to rise, rolled about its long axis and turned."""
    x, quat = keyposes.key_pose_motion(kind)
    spin = Rotation.from_euler("z", turn) * Rotation.from_euler("x", roll)
    q = (spin * Rotation.from_quat(quat[0], scalar_first=True)).as_quat(scalar_first=True)
    x = keyposes.on_the_floor((x[0] - x[0, 0]) @ spin.as_matrix().T)
    return State(x, np.zeros((N, 3)), q)


@pytest.mark.parametrize("kind", keyposes.RISES)
@pytest.mark.parametrize("lead", "lr")
def test_key_poses(kind, lead):
    """On the floor in each frame, from lying to standing, no joint faster than people's, bones whole, mirror images."""
    x, quat = keyposes.key_pose_motion(kind, 1.0, lead)
    np.testing.assert_allclose((x[..., 2] - RADII).min(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(body.forward_kinematics(x[:, 0], quat), x, atol=1e-9)
    assert x[0, :, 2].max() < 0.5 and x[0].mean(axis=0)[2] < 0.2
    trunk = x[:, J["neck"]] - x[:, 0]
    assert x[-1, 0, 2] > 0.95 * STANDING and trunk[-1, 2] > 0.99 * np.linalg.norm(trunk[-1])
    assert np.linalg.norm(np.diff(x, axis=0), axis=-1).max() / STEP < 4.0
    outside = [np.abs(body.project_range_of_motion(a, body.twists(q)) - a).max() for a, q in zip(x[::5], quat[::5])]
    assert max(outside) < 0.05
    fast = keyposes.key_pose_motion(kind, 2.0, lead)[0]
    assert len(fast) < 0.75 * len(x)
    other = keyposes.key_pose_motion(kind, 1.0, "r" if lead == "l" else "l")[0]
    pairs = [J[n[:-2] + {"_l": "_r", "_r": "_l"}.get(n[-2:], n[-2:])] for n in body.JOINTS]
    np.testing.assert_allclose(other[:, pairs] * [1, -1, 1], x, atol=1e-9)
    with pytest.raises(ValueError, match="supine, prone, flip"):
        keyposes.key_pose_motion("sideways")
    names = [r[0] for r in keyposes.rises()]
    assert len(set(names)) == len(names) == 8


def test_backflip():
    """Once round backwards; in flight the centre of mass falls freely and nothing touches the floor."""
    x, quat = keyposes.leap()
    up = Rotation.from_quat(quat[:, 0], scalar_first=True).apply([0, 0, 1.0])[:, 2]
    assert up.min() < -0.9 and up[0] > 0.99 and up[-1] > 0.99
    t = np.arange(len(x)) * STEP
    a, b = keyposes.FLIGHT
    flies = (t > a + STEP) & (t < b - STEP)
    second = np.diff(x.mean(axis=1), 2, axis=0)[:, 2] / STEP**2
    np.testing.assert_allclose(second[flies[1:-1]], -9.81, atol=1e-6)
    assert (x[flies][..., 2] - RADII).min() > 0.0
    pitch = np.unwrap(np.arctan2(*(x[:, J["neck"]] - x[:, 0])[:, [0, 2]].T))
    assert pitch[-1] - pitch[0] == pytest.approx(-2 * np.pi, abs=0.2)
    np.testing.assert_allclose(np.linalg.norm(body.DIFFERENCE @ x, axis=-1), np.tile(LENGTHS, (len(x), 1)), rtol=1e-6)
    jump, _ = keyposes.leap(0.0)  # the same without the turn
    np.testing.assert_allclose(jump.mean(axis=1), x.mean(axis=1), atol=1e-9)
    assert (jump[:, J["head"], 2] > jump[:, 0, 2]).all()


@pytest.mark.parametrize("kind, roll", [("supine", 0.0), ("prone", 0.0), ("supine", 1.2), ("prone", -1.2)])
def test_plan(kind, roll):
    """From where the body lies, on the back, front or side, in any heading; continuous; ends upright near there."""
    state = lying(kind, 2.0, roll)
    assert rising.faces_up(state) == (kind == "supine")
    for rng in (None, np.random.default_rng(0)):
        x, quat = rising.plan(state, rng)
        np.testing.assert_allclose((x[..., 2] - RADII).min(axis=1), 0.0, atol=1e-9)
        assert np.linalg.norm(x[0] - state.x, axis=1).max() < 0.1  # begins slowly
        assert np.linalg.norm(np.diff(x, axis=0), axis=-1).max() / STEP < 6.0
        assert x[-1, 0, 2] > 0.95 * STANDING and np.linalg.norm(x[-1, 0, :2] - state.x[0, :2]) < 0.8
    trunk = (state.x[J["neck"]] - state.x[0]) * (-1 if kind == "supine" else 1)
    off = heading(quat[-1, 0]) - np.arctan2(trunk[1], trunk[0])
    assert abs((off + np.pi) % (2 * np.pi) - np.pi) < 1e-6
    lifted = State(state.x + [0, 0, 0.4], state.v, state.quat)
    np.testing.assert_allclose(rising.plan(lifted, None, 0.4)[0], rising.plan(state)[0] + [0, 0, 0.4], atol=1e-9)


@pytest.fixture(scope="module")
def standing():
    """A prior that stands: the last pose of a rise, for ever."""
    x, quat = keyposes.key_pose_motion("supine")
    return ClipPrior(x[-1:], quat[-1:])


class Still:
    """Where the body is, upright, with `standing`'s pose; nothing for one who is far from it."""

    def __init__(self, prior):
        self.prior = prior

    def mode(self, state):
        x, quat = self.prior.mode(state)
        return x + (state.x[0] - x[0]) * [1, 1, 0], quat

    def sample(self, state, n, rng):
        x, quat = self.mode(state)
        near = int(np.linalg.norm(x - state.x, axis=1).mean() < 0.2)
        return x[None][:near], quat[None][:near]


@pytest.mark.parametrize("kind", keyposes.RISES)
def test_rising(kind, standing):
    """Who lies rests for CALM frames as a rag doll, then stands up by himself; without `rise` he stays."""
    for rise in (True, False):
        prior = rising.Rising(Still(standing), rise)
        sim = Simulator(prior)
        state, found = lying(kind, 1.0, 0.5), []
        for _ in range(210):
            state, out = sim.step(state, rng=np.random.default_rng(0))
            found.append(out.sample)
        limp = np.array(found) < 0
        if rise:
            first = int(np.argmin(limp))
            assert rising.CALM - 1 <= first < 60 and limp[:first].all() and not limp[first:].any()
            assert state.x[0, 2] > 0.9 * STANDING and not demos.fallen(state)
        else:
            assert limp.all() and down(None, state) and np.linalg.norm(state.v, axis=1).max() < 0.05
    prior.floor = Plane()  # Still has none
    assert prior.floor is None


def test_pushed_while_rising(standing):
    """Who is thrown over while he rises is a rag doll again, and rises once more."""
    prior = rising.Rising(Still(standing))
    sim, state, limp, force = Simulator(prior), lying("supine"), [], np.zeros((N, 3))
    force[[J["spine3"], J["head"]], 1] = 400.0
    for t in range(420):
        state, out = sim.step(state, force if 75 <= t < 85 else None, rng=np.random.default_rng(0))
        limp.append(out.sample < 0)
    limp = np.array(limp)
    assert not limp[30:75].any() and limp[76:130].any() and not limp[-30:].any()
    assert state.x[0, 2] > 0.9 * STANDING and not demos.fallen(state)


def test_the_pushed_over_stand_again():
    """The whole way with nearest transitions: two walkers are pushed over and walk on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demos, "BUILTIN", (("walk", 8, {"speed": 1.2}), ("stand", 6, {}), ("start", 8, {})))
        stage = demos.Stage(demos.Options())
    for way in (1.0, -1.0):
        sim, state = stage.start(1.2)
        act = demos.pushing("spine3", np.array([0.0, way * 300.0, 0.0]), (0, 8))
        take = demos.single("", sim, state, 300, np.random.default_rng(0), act)
        states = [s[0] for s in take.states]
        assert any(down(None, s) for s in states[:60])
        assert all(s.x[0, 2] > 0.8 * STANDING and not demos.fallen(s) for s in states[-30:])
    feet = simulator.gaps(states[-1].x, [Plane()])[0][FEET]
    assert feet.min() < 0.02

"""drop/demos.py: what is measured is right, every demonstration runs, and shows what it should."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drop import body, demos, momenta, pictures, simulator
from drop.__main__ import main
from drop.body import RADII, STEP, J, N
from drop.prior import VaePrior, load_networks
from drop.simulator import Plane, Simulator, State
from human import heading
from plumbing import render
from plumbing.cli import UserError, run_main

ALL = demos.BUILTIN
SHORT = (
    ("walk", 8, {"speed": 1.2}), ("jog", 8, {"speed": 2.5}), ("turn", 8, {"speed": 1.1, "turn_rate": 0.6}),
    ("stand", 6, {}), ("sidestep", 6, {"sidestep": 0.4}),
)  # fmt: skip


@pytest.fixture(scope="module")
def stage():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demos, "BUILTIN", SHORT)
        yield demos.Stage(demos.Options())


@pytest.fixture(scope="module")
def full(stage):
    """Takes of a whole demonstration, seed 0; each simulated once."""
    takes = {}

    def get(name):
        if name not in takes:
            takes[name] = demos.DEMOS[name](stage, np.random.default_rng(0))
            sane(takes[name])
        return takes[name]

    return get


def sane(takes):
    for take in takes:
        for r in demos.measure(take):
            assert r["bone"] < 1e-6 and np.isfinite([v for v in r.values() if not isinstance(v, (str, dict))]).all()
        assert take.name in demos.report(take)


def numbers(text):
    return [float(v) for v in re.findall(r"-?\d+\.?\d*", text)]


def cut(monkeypatch, frames):
    """Shorten every take."""
    single = demos.single
    monkeypatch.setattr(
        demos, "single", lambda name, sim, state, n, rng, act: single(name, sim, state, min(n, frames), rng, act)
    )


def test_motions(stage, tmp_path):
    assert [c[0].split("_")[0] for c in stage.clips] == [k for k, _, _ in SHORT]
    assert abs(demos.pace(stage.clips[0][1]) - 1.2) < 0.1
    assert demos.pick_motion(stage.clips, 2.4)[0].startswith("jog")
    assert demos.pick_motion(stage.clips, 0.0)[0].startswith("stand")
    with pytest.raises(UserError, match="no such file or folder"):
        demos.motions(demos.Options(motion=str(tmp_path / "nothing")))


def test_fallen():
    x = body.forward_kinematics(body.OFFSETS[0], np.tile([1.0, 0, 0, 0], (N, 1)))
    at = lambda x: State(x, 0 * x, np.zeros((N, 4)))  # noqa: E731
    assert not demos.fallen(at(x)) and demos.fallen(at(x - [0, 0, 0.5]))
    lying = x @ Rotation.from_euler("y", 80, degrees=True).as_matrix().T + [0, 0, 1.0]
    assert demos.fallen(at(lying))
    assert not demos.fallen(at(x + [2.0, 0, 0.5]), Plane(np.array([-0.24, 0, 0.97]), 0.0))


def test_measure(stage):
    """Against a motion whose numbers are known: shifted by 1 cm a frame, feet in contact, 2 cm below the floor."""
    x = body.forward_kinematics(body.OFFSETS[0], np.tile([1.0, 0, 0, 0], (N, 1))) - [0, 0, 0.02]
    _, found = Simulator().step(State(x, 0 * x, np.tile([1.0, 0, 0, 0], (N, 1))))
    found.active[:] = True
    take = demos.Take("t")
    for t in range(20):
        take.add([State(x + [0.01 * t, 0, 0], 0 * x, np.zeros((N, 4)))], [found])
    (r,) = demos.measure(take)
    assert r["speed"] == pytest.approx(0.3) and r["slide"] == pytest.approx(0.3)
    assert r["below_mm"] == pytest.approx(20 - 1e3 * (x + [0, 0, 0.02])[:, 2].__sub__(RADII).min(), abs=1e-6)
    assert r["end"] == "upright" and r["bone"] < 1e-9 and r["limp"] == 1.0
    assert "0.30 m/s" in demos.report(take)
    state, found = Simulator().step(State(x, 0 * x, np.tile([1.0, 0, 0, 0], (N, 1))))
    found.energies["direction"] = 2.0  # who is led until he falls: one frame has the term, the others do not
    take.add([state], [found])
    assert demos.measure(take)[0]["energies"]["direction"] == 2.0


def test_ball_momentum(stage):
    """What the ball loses the body gets: impulses are equal and opposite; a ball that misses falls freely."""
    _, state = stage.start(0.0)
    target = state.x[J["spine3"]]
    ball = demos.Ball(target + [0.0, 0.6, 0.0], np.array([0.0, -9.0, 0.0]))
    before, given = ball.v.copy(), np.zeros(3)
    for _ in range(6):
        force = ball.frame(state)
        given += force.sum(axis=0) * STEP
    lost = ball.mass * (before + 6 * STEP * body.GRAVITY - ball.v)
    np.testing.assert_allclose(given, lost, atol=1e-9)
    assert np.linalg.norm(given) > 3.0
    free = demos.Ball(np.array([9.0, 9.0, 5.0]), np.array([1.0, 0.0, 0.0]))
    assert np.abs(free.frame(state)).max() == 0
    np.testing.assert_allclose(free.x[:2], [9 + STEP, 9.0])
    low = demos.Ball(np.array([9.0, 9.0, 0.13]), np.array([0.0, 0.0, -3.0]))
    for _ in range(30):
        low.frame(state)
    assert low.x[2] > 0.11 and abs(low.v[2]) < 1.5


def test_escape(stage):
    """Across a ball's path, not along it; nothing to flee from, nothing to do."""
    _, state = stage.start(0.0)
    coming = demos.Ball(state.com + [4.0, 0, 0], np.array([-9.0, 0, 0]))
    lead = demos.escape(state, [coming], lead=np.zeros(2))
    assert abs(lead[1]) > abs(lead[0]) and np.linalg.norm(lead) == pytest.approx(demos.DODGE * STEP)  # no jump
    for _ in range(20):
        before, lead = lead, demos.escape(state, [coming], lead=lead)
        assert np.linalg.norm(lead - before) <= demos.DODGE * STEP + 1e-12
    assert np.linalg.norm(lead) == pytest.approx(1.4, abs=0.1)
    v, way, x, h = np.array([1.0, 0.2]), np.array([-0.5, 1.0]), np.zeros(2), 1e-4
    for i in range(8000):  # `ramp` against small steps; at 3 m/s² the change takes 0.57 s
        change = way - v
        v = v + change * min(1.0, 3.0 * h / max(np.linalg.norm(change), 1e-9))
        x = x + h * v
        if i in (2999, 7999):
            speed, gone = demos.ramp(np.array([1.0, 0.2]), way, (i + 1) * h, 3.0)
            np.testing.assert_allclose(np.append(speed, gone), np.append(v, x), atol=1e-3)
    assert demos.escape(state, [demos.Ball(state.com + [4.0, 0, 0], np.array([9.0, 0, 0]))]) is None
    assert demos.escape(state, []) is None


def test_cylinder_momenta(stage):
    """A rigid body turned with growing speed about its centre of mass: L̇ = I α, I by points that fill the bones."""
    mass, inertia = momenta.cylinder_inertia()
    assert mass.sum() == pytest.approx(N)
    np.testing.assert_allclose(inertia, np.swapaxes(inertia, 1, 2), atol=1e-12)
    rest = np.tile([1.0, 0, 0, 0], (N, 1))
    x0 = body.forward_kinematics(body.OFFSETS[0], rest)
    middle = 0.5 * (x0[1:] + x0[body.PARENTS[1:]])
    x0, middle = x0 - mass @ middle / N, middle - mass @ middle / N
    axis, alpha = np.array([0.0, 0.0, 1.0]), 3.0
    angle = 0.5 * alpha * (np.arange(5) * STEP) ** 2
    turns = Rotation.from_rotvec(angle[:, None] * axis)
    x = np.array([r.apply(x0) for r in turns])
    quat = np.repeat(turns.as_quat(scalar_first=True)[:, None], N, axis=1)
    b, com = momenta.momenta_of_cylinders(x, quat)
    whole = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) + i for m, p, i in zip(mass, middle, inertia))
    np.testing.assert_allclose(b[0, 3:], whole @ axis * alpha, atol=2e-2)
    np.testing.assert_allclose(b[0, :3], 0.0, atol=1e-9)
    np.testing.assert_allclose(com, 0.0, atol=1e-9)
    j = J["knee_l"] - 1  # one bone's inertia by points that fill a cylinder
    rng, length = np.random.default_rng(0), body.LENGTHS[j]
    r = 0.8 * min(RADII[J["knee_l"]], RADII[J["hip_l"]])
    disc = rng.uniform(-1, 1, (400_000, 2))
    disc = disc[np.sum(disc**2, axis=1) < 1] * r
    points = np.column_stack([disc, rng.uniform(-0.5, 0.5, len(disc)) * length])
    brute = mass[j] * np.mean(
        np.sum(points**2, axis=1)[:, None, None] * np.eye(3) - points[:, :, None] * points[:, None], axis=0
    )
    np.testing.assert_allclose(inertia[j], brute, atol=2e-2 * brute.max())


def test_root_wrench_of_motions(stage):
    """Standing needs next to none, walking little, a walk hung in the air the body's weight; both models agree."""
    walk, stand = stage.clips[0], stage.clips[3]
    points, cylinders = (momenta.root_wrench(walk[1][:90], walk[2][:90], c) for c in (False, True))
    assert np.median(points) < 15 and np.corrcoef(points, cylinders)[0, 1] > 0.7
    assert np.median(momenta.root_wrench(stand[1][:60], stand[2][:60])) < 5
    hung = momenta.root_wrench(walk[1][:40] + [0, 0, 1], walk[2][:40])
    assert abs(np.median(hung) / (N * 9.81) - 1) < 0.2


def test_shapes_and_arrows(stage):
    _, state = stage.start(0.0)
    shapes = pictures.body_shapes(state.x, pictures.COLOURS[0])
    assert len(shapes) == N and isinstance(shapes[-1], render.Marker)
    shaft, head = pictures.arrow(np.array([0.0, 0, 1]), [0.0, 0, 100.0], (1, 0, 0, 1))
    assert np.linalg.norm(head.end - [0, 0, 1]) < np.linalg.norm(shaft.start - [0, 0, 1]) <= 0.8
    assert pictures.arrow(np.zeros(3), np.zeros(3), (1, 0, 0, 1)) == []


def test_contact_forces_are_drawn_above_the_floor(stage):
    """A floor is opaque: its forces on a walker's feet start at the contact and point up and away from it."""
    sim, state = stage.start(1.2)
    for _ in range(10):
        state, found = sim.step(state, rng=np.random.default_rng(0))
    shapes = pictures.contact_arrows(found)
    assert shapes and found.forces[:, 2].max() > 50
    ends = np.array([p for s in shapes for p in (s.start, s.end)])
    assert ends[:, 2].min() > -0.01 and ends[:, 2].max() > 0.1


FULL = ("projectiles", "collide", "constrain", "stiff-knee", "wrench")  # tested whole, below


@pytest.mark.parametrize("name", [n for n in demos.DEMOS if n not in ("backflip", "follow", "weights", *FULL)])
def test_every_demo(name, stage, monkeypatch):
    """A second and a third of each: finite, bones exact, a line of numbers."""
    cut(monkeypatch, 40)
    sane(demos.DEMOS[name](stage, np.random.default_rng(0)))


def test_projectiles(full):
    """Most of the balls hit a walker, who feels them; one who dodges is hit by fewer, and is not dragged."""
    plain, dodging = full("projectiles")
    hit, thrown = numbers(plain.notes["balls that hit"])
    assert thrown == 6 and hit >= 4 and numbers(dodging.notes["balls that hit"])[0] < hit
    who_is_not_dragged(dodging)
    pushed = [t for t, arrows in enumerate(plain.arrows) if arrows]
    assert pushed and any(plain.window[0] <= t <= plain.window[1] for t in pushed)  # the sheet shows a hit
    shown = np.linspace(*plain.window, 9).round().astype(int)
    assert max(np.linalg.norm(f) for t in shown for _, f in plain.arrows[t]) > 50  # and its force


def who_is_not_dragged(dodging):
    (r,) = demos.measure(dodging)
    assert r["end"] == "upright" and r["slide"] < 0.22 and r["wrench"] < 30


def test_a_dodger_with_the_learned_prior_stays_on_his_feet(all_clips, monkeypatch):
    """With targets that jumped he fell in two of four takes, or slid at 0.3 m/s under a root wrench of 37 N.

    Of seeds 200 to 211 he falls in four; the last bit of a sum decides which, so conftest.py fixes BLAS's threads."""
    monkeypatch.setattr(all_clips, "general", VaePrior(load_networks()[0]))
    monkeypatch.setattr(all_clips.opt, "prior", "vae")
    takes = [demos.projectiles(all_clips, np.random.default_rng(200 + k), (True,))[0] for k in range(4)]
    rows = [demos.measure(take)[0] for take in takes]
    assert np.mean([numbers(take.notes["balls that hit"])[0] for take in takes]) < 4  # of 6, which hit a walker
    assert sum(r["end"] == "fell" for r in rows) <= 1
    assert np.mean([r["slide"] for r in rows]) < 0.18 and np.mean([r["wrench"] for r in rows]) < 30


def test_who_is_down_does_not_dodge(stage, monkeypatch):
    """Eq. 16 leads nobody who lies or is about to rise."""
    asked, step = [], Simulator.step

    def watched(sim, state, force=None, v_tar=None, **more):
        asked.append((demos.fallen(state), v_tar is not None))
        return step(sim, state, force, v_tar, **more)

    monkeypatch.setattr(Simulator, "step", watched)
    hit = demos.one_force("spine3", np.array([0.0, 400.0, 0.0]))
    frame = demos.Ball.frame
    monkeypatch.setattr(demos.Ball, "frame", lambda ball, *a: frame(ball, *a) + hit * (abs(ball.x[2] - 1) < 0.4))
    demos.projectiles(stage, np.random.default_rng(0))
    dodging = asked[len(asked) // 2 :]
    assert any(down for down, _ in dodging) and any(led for _, led in dodging)
    assert not any(down and led for down, led in dodging)


def test_collide(full):
    """Two who meet touch and do not sink into one another: spheres overlap by less than a limb is thick."""
    for take in full("collide"):
        assert numbers(take.notes["deepest overlap of the two"])[0] < 15
        com = np.array([[s.com[:2] for s in states] for states in take.states])
        apart = np.linalg.norm(com[:, 0] - com[:, 1], axis=1)
        assert apart.min() < 0.8  # they did meet


@pytest.mark.parametrize("prior", ["nearest", "vae"])
def test_who_collides_goes_on(all_clips, monkeypatch, prior):
    """They bump, get past each other and are soon apart, upright; the whole trunk passes on one side."""
    trunk = [J[n] for n in ("pelvis", "spine1", "spine2", "spine3", "neck", "head")]
    if prior == "vae":
        monkeypatch.setattr(all_clips, "general", VaePrior(load_networks()[0]))
        monkeypatch.setattr(all_clips.opt, "prior", "vae")
    for take in demos.collide(all_clips, np.random.default_rng(1)):
        ahead = np.array([a.x[trunk] - b.x[trunk] for a, b in take.states])
        assert 0 < numbers(take.notes["they touch"])[0] < 1.5
        assert ahead[0, :, 0].max() < -2 and ahead[-1, :, 0].min() > 2
        sides = [a[int(np.argmax(a[:, 0] > 0)), 1] for a in np.swapaxes(ahead, 0, 1)]
        assert len(set(np.sign(sides))) == 1
        assert [r["end"] for r in demos.measure(take)] == ["upright", "upright"]


def test_constrain(full):
    """An energy holds the hand at its place, a force comes nearer; let go, the hand leaves it."""
    force, energy = (numbers(t.notes["hand to its place"]) for t in full("constrain"))
    assert energy[1] < 4 and force[1] < force[0] - 5
    assert force[2] > force[1] and energy[2] > energy[1] + 5


def test_stiff_knee(full):
    """The spring takes flexion from its own knee, compared with the same walk without it."""
    free, stiff = (numbers(t.notes["flexion of the left knee"])[0] for t in full("stiff-knee"))
    other = numbers(full("stiff-knee")[1].notes["flexion of the right knee"])[0]
    assert stiff < free - 10 and other > stiff + 10


def test_nobody_runs_without_a_run(stage, monkeypatch, capsys):
    """A motion of walks alone has no runner to push, whatever its fastest walk."""
    walks = [c for c in stage.clips if demos.pace(c[1]) < demos.RUN]
    monkeypatch.setattr(stage, "clips", walks)
    monkeypatch.setattr(demos, "single", lambda name, *_: demos.Take(name))
    for name in ("_centres", "_displacement"):
        monkeypatch.setattr(demos, name, lambda *_: None)
    names = [t.name for t in demos.push(stage, None)]
    assert len(names) == 7 and all(n.startswith("walk ") for n in names) and "no clip runs" in capsys.readouterr().out


def test_a_small_push_displaces_and_a_large_one_more(stage, monkeypatch):
    """The torso's small push moves a walker against the unpushed take, by less than a large one, and fells nobody."""
    monkeypatch.setattr(demos, "PUSHES", {"torso": demos.PUSHES["torso"]})
    cut(monkeypatch, 68)
    small, large = demos.push(stage, None)[:2]
    away = [numbers(t.notes["away from the unpushed take"])[0] for t in (small, large)]
    assert 1.0 < away[0] < away[1] and away[1] > 10
    assert demos.measure(small)[0]["end"] == "upright"


def test_correction_lowers_the_root_wrench(full):
    """§8.5: in one pushed run, what the solver wants and what Eq. 14 leaves; without it nothing is taken away."""
    without, corrected = full("wrench")
    for take in (without, corrected):
        pd, left = (np.array([getattr(o[0], n) for o in take.outcomes]) for n in ("wrench_pd", "wrench"))
        push = slice(*demos.PUSH_FRAMES)
        if take is corrected:
            assert np.median(left[push]) < 0.7 * np.median(pd[push]) and left.mean() < pd.mean()
        else:
            np.testing.assert_allclose(left, pd, atol=8.0)  # bones restored, no more
        assert "median" in take.notes["root wrench, whole take"]
    assert numbers(corrected.notes["away from the unpushed take"])[0] > numbers(
        without.notes["away from the unpushed take"])[0]  # fmt: skip


def test_weights(stage, monkeypatch, capsys):
    """The table prints a line a setting; its pendulum is that of tests/drop/test_drop.py, swinging as the exact one
    does."""
    monkeypatch.setattr(demos, "SCALES", ((3, 9),))
    assert demos.weights(stage, None) == []
    rigid, other, bone, hand, swing, period, *_ = numbers(capsys.readouterr().out.splitlines()[1])
    assert (rigid, other) == (3, 9) and 0 < bone < 10 and hand > 1
    assert abs(swing / 81.2 - 1) < 0.1 and abs(period / 1.088 - 1) < 0.1


def test_wrench_limit_is_physics(stage):
    """One weight on the toes, two where people run; whatever the clip needs itself."""
    limits = [stage.start(v)[0].wrench_limit for v in (0.0, 1.2, 2.5)]
    assert limits == [simulator.WRENCH_LIMIT, simulator.WRENCH_LIMIT, 2 * simulator.WRENCH_LIMIT]
    x = demos.pick_motion(stage.clips, 1.2)[1]
    shaken = x + 0.02 * np.random.default_rng(0).standard_normal(x.shape)
    assert np.percentile(momenta.root_wrench(shaken[:60], np.zeros((60, N, 4))), 95) > 100
    assert stage.wrench_limit(x[:60] + 1e-3) == simulator.WRENCH_LIMIT
    assert stage.start(2.5, wrench_limit=20.0)[0].wrench_limit == 20.0


@pytest.mark.parametrize("speed, led", [(1.2, False), (2.5, False), (1.2, True), (2.5, True)])
def test_follower_keeps_the_speed(stage, speed, led):
    """Through one turn: mean speed within 15 %, facing the new way; led by the hand, the hand is ahead."""
    take = demos._follow(stage, np.random.default_rng(0), speed, led, speed, frames=210)
    (r,) = demos.measure(take)
    com = np.array([s[0].com[:2] for s in take.states])
    mean = np.linalg.norm(np.diff(com, axis=0), axis=1).mean() / STEP
    assert abs(mean / speed - 1) < 0.15 and r["end"] == "upright"
    turned = drop_turn(take.states[-1][0].quat[0], take.states[0][0].quat[0])
    assert 60 < turned < 120
    if led:
        assert numbers(take.notes["hand to the place it is led to"])[0] < 60


class Caught(Exception):
    """Carries what a demonstration was about to simulate."""


@pytest.mark.parametrize("speed", [1.2, 2.5])
def test_follower_waits_and_hurries(stage, monkeypatch, speed):
    """v_tar leads to where the dot is in 0.6 s, so a follower near it slows down; far behind, at most 1.25 times the
    dot's speed."""

    def caught(name, sim, state, frames, rng, act):
        raise Caught(state, act)

    monkeypatch.setattr(demos, "single", caught)
    for behind in (0.0, 0.2, 1.0, 1.2, 2.0, 9.0):  # of the distance that the dot is ahead at its own speed
        with pytest.raises(Caught) as found:
            demos._follow(stage, np.random.default_rng(0), speed, False, speed)
        state, act = found.value.args
        yaw = heading(state.quat[0])
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        way = 0.6 * speed * (1.0 - behind) + speed * STEP  # so much nearer to the dot, which has moved
        _, more, ((dot, *_),) = act(0, State(state.x + way * ahead, state.v, state.quat))
        gap = dot[:2] - (state.com + way * ahead)[:2]
        np.testing.assert_allclose(gap, 0.6 * speed * behind * ahead[:2], atol=1e-9)
        wanted = gap / 0.6
        wanted *= min(1.0, 1.25 * speed / max(np.linalg.norm(wanted), 1e-9))
        np.testing.assert_allclose(more["v_tar"], wanted, atol=1e-9)


def drop_turn(a, b):
    d = heading(a) - heading(b)
    return np.degrees((d + np.pi) % (2 * np.pi) - np.pi)


@pytest.fixture(scope="module")
def all_clips():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demos, "BUILTIN", ALL)
        yield demos.Stage(demos.Options())


def test_the_tripped_stumble(all_clips, monkeypatch):
    """A walker pitches over the held foot, seldom if Eq. 14 leaves a fifth of the torque; a runner falls."""
    cut(monkeypatch, 120)
    leans = []
    for seed in range(3):
        walk = demos._trip(all_clips, np.random.default_rng(seed), 1.2)
        assert -5 <= numbers(walk.notes["heel held"].split(",")[1])[0] <= 30, "caught in its swing, behind the other"
        slowest = float(re.search(r"([\d.]+) at the least", walk.notes["stumble"])[1])
        assert slowest < 0.8
        leans.append(numbers(walk.notes["stumble"])[1])
    assert min(leans) > 12 and max(leans) > 60, leans
    run = demos._trip(all_clips, np.random.default_rng(0), 2.5)
    assert demos.measure(run)[0]["end"] == "fell"
    monkeypatch.setattr(demos, "TRIP_WEIGHT", simulator.WRENCH_WEIGHT)
    stiff = [numbers(demos._trip(all_clips, np.random.default_rng(s), 1.2).notes["stumble"])[1] for s in (1, 2)]
    assert max(stiff) < 30


@pytest.mark.parametrize("down, low, high", [(0.6, 0.0, 0.25), (0.0, 0.25, 9.0)])
def test_who_lies_is_not_dragged(down, low, high, all_clips, monkeypatch):
    """A tripped runner of the learned prior comes to rest; asked in spite of lying, the prior drags it on (§8.7)."""
    monkeypatch.setattr(all_clips, "general", VaePrior(load_networks()[0], down=down))
    monkeypatch.setattr(all_clips, "prior", lambda *clip: all_clips.general)  # and nobody rises
    run = demos._trip(all_clips, np.random.default_rng(0), 2.5)
    assert demos.measure(run)[0]["end"] == "fell"
    speed = float(re.search(r"([\d.]+) at the end", run.notes["stumble"])[1])
    assert low <= speed < high


@pytest.mark.parametrize(
    "clips, prior, slide", [("all", "nearest", 0.15), ("few", "nearest", 0.3), ("all", "vae", 0.7)]
)
def test_a_tilted_walker_walks_on(clips, prior, slide, all_clips, stage, monkeypatch):
    """Across the slope and up, without skating more than on the level, sinking in or needing a phantom wrench."""
    stage = all_clips if clips == "all" else stage
    if prior == "vae":
        monkeypatch.setattr(stage, "general", VaePrior(load_networks()[0]))
        monkeypatch.setattr(stage.opt, "prior", "vae")
    for take in demos.tilt(stage, np.random.default_rng(0)):
        (r,) = demos.measure(take)
        assert r["end"] == "upright" and r["below_mm"] < 40 and r["slide"] < slide and r["speed"] > 0.8
        assert r["wrench"] < 1.3 * simulator.WRENCH_LIMIT
        assert np.degrees(np.arccos(take.floor[-1].normal[2])) == pytest.approx(15)


def test_backflip(stage, monkeypatch):
    """Without a flip it is the built-in one; with one (a clip turned over in the air) it is tracked until the push."""
    (take,) = demos.backflip(stage, np.random.default_rng(0))
    up = [Rotation.from_quat(s[0].quat[0], scalar_first=True).apply([0, 0, 1])[2] for s in take.states]
    assert take.name == "backflip built in" and min(up) < -0.5
    assert not demos.fallen(take.states[-1][0]) and take.states[-1][0].x[0, 2] > 0.8 * body.STANDING
    n = 120
    turn = Rotation.from_rotvec(np.interp(np.arange(n), [30, 60], [0, -2 * np.pi])[:, None] * [0.0, 1.0, 0.0])
    quat = np.repeat(turn.as_quat(scalar_first=True)[:, None], N, axis=1)
    height = body.STANDING + np.interp(np.arange(n), [30, 45, 60], [0, 0.9, 0])
    x = body.forward_kinematics(np.stack([0 * height, 0 * height, height], axis=1), quat)
    monkeypatch.setattr(stage, "clips", [*stage.clips, ("flip", x, quat)])
    (take,) = demos.backflip(stage, np.random.default_rng(0))
    up = [Rotation.from_quat(s[0].quat[0], scalar_first=True).apply([0, 0, 1])[2] for s in take.states]
    assert min(up) < -0.5 and len(take.arrows[0]) == 0 and any(take.arrows)


def test_outputs_are_checked_first(monkeypatch, tmp_path):
    """A picture that cannot be written is said so before anything is simulated."""
    monkeypatch.setattr(demos, "Stage", lambda opt: pytest.fail("simulated first"))
    nowhere = tmp_path / "no"
    for flag, path in (("--png", tmp_path), ("--png", nowhere / "a.png"), ("--video", nowhere / "a.mp4")):
        with pytest.raises(UserError, match="cannot write"):
            demos.main(["push", flag, str(path)])
    take = tmp_path / "a.bvh"
    take.write_text("HIERARCHY")
    with pytest.raises(UserError, match="it is read from"):
        demos.main(["push", "--motion", str(take), "--png", str(take)])


def test_command(stage, monkeypatch, capsys, tmp_path):
    """python -m drop DEMO: help, numbers, pictures, and one line for whatever is wrong."""
    monkeypatch.setattr(demos, "motions", lambda opt: [(name, x[:130], q[:130]) for name, x, q in stage.clips])
    cut(monkeypatch, 10)

    def run(*args):
        with pytest.raises(SystemExit) as end:
            run_main(main, [str(a) for a in args])
        return end.value.code, capsys.readouterr()

    code, out = run("--help")
    assert code == 0 and "--prior" in out.out and "stiff-knee" in out.out
    code, out = run("dance")
    assert code == 2 and out.err.count("\n") == 1 and "valid: push, " in out.err
    assert run()[0] == 2
    code, out = run("--seed", 0, "push")
    assert code == 2 and "comes first: python -m drop push --seed 0" in out.err
    code, out = run("push", "--prior", "guess")
    assert code == 2 and "nearest" in out.err
    code, out = run("backflip")
    assert code == 0 and "backflip built in" in out.out
    for prior in ("clip", "none", "vae"):
        code, out = run("stiff-knee", "--prior", prior, "--range", "vae")
        assert code == 0 and "stiff knee" in out.out
    if render.gl_backend() is None:
        pytest.skip("no OpenGL: neither egl nor osmesa starts here")
    sheet = tmp_path / "sheet.png"
    code, out = run("stiff-knee", "--png", sheet)
    assert code == 0 and sheet.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and sheet.stat().st_size > 20_000

"""drop/simulator.py: every equation of DROP's simulator computed another way, then the simulator as a whole."""

import functools
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from drop import body, simulator
from drop import prior as prior_module
from drop.body import (
    AXIS,
    DIFFERENCE,
    FEET,
    GRAVITY,
    HIGH,
    JOINTS,
    LEAF_DAMPING,
    LEAVES,
    LENGTHS,
    LIMITED,
    LIMITS,
    LOW,
    OFFSETS,
    PARENTS,
    PATH,
    RADII,
    STANDING,
    STEP,
    J,
    N,
    _swing_matrix,
    _turn,
    align,
    character_motion,
    forward_kinematics,
    joint_angles,
    project_range_of_motion,
    swing,
    swing_twist,
    twists,
)
from drop.demos import forearm
from drop.prior import LEGS, ClipPrior, NearestPrior, SwitchPrior
from drop.simulator import Box, Plane, Simulator, Spheres, State, Weights
from human import Clip, quat_matrix
from mocap import gait

REST = np.tile([1.0, 0.0, 0.0, 0.0], (N, 1))
STAND = forward_kinematics(OFFSETS[0], REST)


@functools.cache
def motion(kind="walk", seconds=6.0, seed=0, **params):
    m = gait.generate(kind, seconds, 30.0, seed=seed, height=1.75, **params)
    return character_motion(Clip(kind, "x", 30.0, m["pos"], m["quat"], m["ball"]))


@functools.cache
def prior():
    return NearestPrior([motion(), motion("stand"), motion("jog", speed=2.5)])


def state_of(sim, kind="walk", frame=60, **more):
    x, quat = motion(kind, **more)
    return sim.begin(x[frame], quat[frame], (x[frame] - x[frame - 1]) / STEP)


def jiggled(seed, size=0.05):
    return STAND + size * np.random.default_rng(seed).standard_normal((N, 3))


# ------------------------------------------------------------------------------------ the character


def test_character():
    """A 1.75 m person of the canonical proportions: spheres of the feet touch the floor, the rest is above it."""
    body = gait.Body(1.75)
    assert JOINTS[0] == "pelvis" and len(JOINTS) == N == 22 and (PARENTS[1:] < np.arange(1, N)).all()
    np.testing.assert_allclose(LENGTHS[J["knee_l"] - 1], body.thigh)
    np.testing.assert_allclose(LENGTHS[J["wrist_r"] - 1], body.forearm)
    gap = STAND[:, 2] - RADII
    assert np.abs(gap[FEET]).max() < 1e-3 and gap.min() > -1e-3
    mirrored = [J[n[:-2] + {"_l": "_r", "_r": "_l"}[n[-2:]] if n[-2:] in ("_l", "_r") else n] for n in JOINTS]
    np.testing.assert_allclose(STAND[mirrored] * [1, -1, 1], STAND, atol=1e-12)


def test_forward_kinematics():
    """Against a slow recursion with matrices."""
    rng = np.random.default_rng(0)
    quat = Rotation.random(2 * N, random_state=1).as_quat(scalar_first=True).reshape(2, N, 4)
    root = rng.standard_normal((2, 3))
    got = forward_kinematics(root, quat)
    for b in range(2):
        x = [root[b]]
        for j in range(1, N):
            x.append(x[PARENTS[j]] + quat_matrix(quat[b, PARENTS[j]]) @ OFFSETS[j])
        np.testing.assert_allclose(got[b], x, atol=1e-12)


def test_character_motion():
    """A clip of the same stature keeps its joints; a taller person's is scaled; planted feet touch the floor."""
    m = gait.generate("walk", 3.0, 30.0, seed=0, height=1.75)
    x, quat = character_motion(Clip("c", "x", 30.0, m["pos"], m["quat"], m["ball"]))
    for joint, segment in (("knee_l", "shin_l"), ("ankle_r", "foot_r"), ("elbow_l", "forearm_l"), ("head", "head")):
        np.testing.assert_allclose(x[:, J[joint]], m["pos"][:, gait.SEGMENTS.index(segment)], atol=2e-3)
    np.testing.assert_allclose(x[:, J["foot_l"]], m["ball"][:, 0], atol=2e-3)
    tall = gait.generate("walk", 3.0, 30.0, seed=0, height=1.9)
    y, _ = character_motion(Clip("c", "x", 30.0, tall["pos"], tall["quat"], tall["ball"]))
    travel = np.linalg.norm(tall["pos"][-1, 0] - tall["pos"][0, 0]) * 1.75 / 1.9
    assert abs(np.linalg.norm(y[-1, 0] - y[0, 0]) / travel - 1) < 0.01
    lowest = (y[..., 2] - RADII)[:, FEET].min(axis=1)
    assert abs(np.median(lowest)) < 3e-3


# ------------------------------------------------------------------------------------ energies


def numerical(f, x, eps=1e-6):
    out = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        d = np.zeros_like(x)
        d[i] = eps
        out[i] = (f(x + d) - f(x - d)) / (2 * eps)
    return out


def test_energy_gradients():
    """Finite differences of the energies, with the projection redone at each point (the envelope theorem)."""
    x, x_t, y = jiggled(0), jiggled(1, 0.02), jiggled(2)
    x_t[:, 2] -= 0.01
    twist = twists(REST)
    samples = np.stack([jiggled(3), jiggled(4)])
    eye = np.eye(N)

    def contact(x):
        active, x_c = simulator.project_contact(x, x_t, [Plane()])
        return simulator.spring(9.0 * active, eye, x, x_c)

    bent = x.copy()
    bent[J["wrist_l"]] = bent[J["elbow_l"]] + [-0.2, 0.0, -0.1]  # the elbow bent the wrong way
    slow = x_t + 0.01 * (x - x_t)  # slower than SLIP: the projection does not depend on x
    for name, f, at in (
        ("momentum", lambda x: simulator.momentum(x, y), x),
        ("rigidity", lambda x: simulator.spring(2.0, DIFFERENCE, x, simulator.project_rigidity(x)), x),
        ("contact", contact, slow),
        ("prior", lambda x: simulator.spring(3.0, eye, x, samples[simulator.project_prior(x, samples)]), x),
        ("direction", lambda x: simulator.direction(0.3, x, x_t, [1.2, 0.4]), x),
    ):
        value, gradient = f(at)
        assert value > 0, name
        expected = numerical(lambda z, f=f: f(z)[0], at)
        np.testing.assert_allclose(gradient, expected, atol=1e-5 * np.abs(expected).max(), err_msg=name)
    # Pose limits and a pin: the gradient of (w/2) ‖x − p‖² holds p fixed.  For a pin p is fixed; the limits' projection
    # lays the moved pose on x, so its value must fall along its own negative gradient at the rate the gradient says,
    # but for the change of the pose inside.
    knee = np.zeros((1, N))
    knee[0, J["hip_l"]], knee[0, J["ankle_l"]] = -1.0, 1.0
    pin = np.zeros((1, N))
    pin[0, J["wrist_r"]] = 1.0
    for name, A, project in (
        ("positional constraint", pin, lambda x: np.array([[0.3, -0.2, 1.0]])),
        ("stiff knee", knee, lambda x: simulator.project_rigidity(x, knee, np.array([0.85]))),
    ):
        value, gradient = simulator.spring(7.0, A, x, project(x))
        assert value > 0, name
        expected = numerical(lambda z, A=A, p=project: simulator.spring(7.0, A, z, p(z))[0], x)
        np.testing.assert_allclose(gradient, expected, atol=1e-6 * np.abs(expected).max(), err_msg=name)
    limit = lambda z: simulator.spring(9.0, eye, z, project_range_of_motion(z, twist))  # noqa: E731
    value, gradient = limit(bent)
    step = 1e-6 * gradient / np.linalg.norm(gradient)
    rate = (limit(bent + step)[0] - limit(bent - step)[0]) / 2e-6
    assert value > 0 and 0.5 < rate / np.linalg.norm(gradient) < 1.5
    r = bent - project_range_of_motion(bent, twist)
    assert np.sum(r * r) > 1e-3
    np.testing.assert_allclose(r.sum(axis=0), 0, atol=1e-12)  # no net force
    np.testing.assert_allclose(np.cross(bent - bent.mean(axis=0), r).sum(axis=0), 0, atol=1e-10)  # and no torque


def test_projections_are_nearest_and_idempotent():
    """Projecting twice is projecting once; and no point of the set is nearer than the projection."""
    x, rng = jiggled(5, 0.1), np.random.default_rng(0)
    d = simulator.project_rigidity(x)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), LENGTHS)
    for _ in range(50):
        other = rng.standard_normal(d.shape)
        other *= (LENGTHS / np.linalg.norm(other, axis=1))[:, None]
        assert np.all(
            np.linalg.norm(DIFFERENCE @ x - d, axis=1) <= np.linalg.norm(DIFFERENCE @ x - other, axis=1) + 1e-12
        )
    chain = PATH @ d
    np.testing.assert_allclose(simulator.project_rigidity(chain), d, atol=1e-12)
    collapsed = simulator.project_rigidity(np.zeros((N, 3)))
    np.testing.assert_allclose(np.linalg.norm(collapsed, axis=1), LENGTHS)
    twist = twists(REST)
    r = project_range_of_motion(x, twist)
    assert np.abs(r - x).max() > 1e-3
    np.testing.assert_allclose(project_range_of_motion(r, twist), r, atol=1e-9)
    low = STAND - [0, 0, 0.02]
    active, x_c = simulator.project_contact(low, low, [Plane()])
    again, x_cc = simulator.project_contact(x_c, x_c, [Plane()])
    assert active.any()
    np.testing.assert_allclose(x_cc[active], x_c[active], atol=1e-12)


def test_obstacles():
    """Distances against a brute-force nearest surface point; normals against finite differences of the distance."""
    rng = np.random.default_rng(0)
    n = np.array([0.6, 0.0, 0.8])
    box = Box(
        np.array([0.2, 0.1, 0.3]),
        np.array([0.3, 0.2, 0.1]),
        Rotation.from_rotvec([0.3, 0.5, -0.2]).as_quat(scalar_first=True),
    )
    balls = Spheres(rng.standard_normal((4, 3)), np.array([0.2, 0.1, 0.3, 0.15]))
    x = rng.uniform(-1.5, 1.5, (60, 3))
    for thing in (Plane(n, 0.2), balls, box):
        d, normal = thing.distance(x)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
        step = 1e-5
        slope = np.stack(
            [(thing.distance(x + step * e)[0] - thing.distance(x - step * e)[0]) / (2 * step) for e in np.eye(3)], 1
        )
        smooth = np.abs(np.linalg.norm(slope, axis=1) - 1) < 1e-4  # off the edges where two faces are equally near
        assert smooth.mean() > 0.9
        np.testing.assert_allclose(normal[smooth], slope[smooth], atol=1e-3)
        on = x - d[:, None] * normal
        np.testing.assert_allclose(thing.distance(on)[0], 0.0, atol=1e-9)
    side = rng.uniform(-1, 1, (40_000, 3))
    face = rng.integers(3, size=len(side))
    side[np.arange(len(side)), face] = np.sign(side[np.arange(len(side)), face])
    surface = box.centre + side * box.half @ quat_matrix(box.quat).T
    d = box.distance(x)[0]
    brute = np.array([np.linalg.norm(surface - p, axis=1).min() for p in x])
    np.testing.assert_allclose(np.abs(d), brute, atol=0.02)
    gap, _ = simulator.gaps(STAND, [Plane(), Spheres(STAND[:1], np.array([0.05]))])
    assert gap[0] == pytest.approx(-0.05 - RADII[0])


def test_project_contact():
    """Eq. 6 on a tilted plane: only what penetrates is held; p is x_t moved along the normal; slow contacts stick."""
    plane = Plane(np.array([np.sin(0.3), 0.0, np.cos(0.3)]), 0.1)
    x_t = STAND.copy()
    depth = plane.distance(x_t)[0] - RADII
    x_t += (0.01 - depth.min()) * plane.normal  # 1 cm above
    low = int(depth.argmin())
    free, _ = simulator.project_contact(x_t, x_t, [plane])
    assert not free.any()
    x = x_t.copy()
    x[low] += [0.01, 0.005, -0.05]
    active, x_c = simulator.project_contact(x, x_t, [plane])
    assert active[low] and active.sum() == 1
    np.testing.assert_allclose(x_c[low], x_t[low], atol=1e-12)  # 0.3 m/s: sticks where it was
    x[low] = x_t[low] + [0.2, 0.0, -0.1]  # 6 m/s: slides, slowed by SLIP
    move = simulator.project_contact(x, x_t, [plane])[1][low] - x_t[low]
    along = (x[low] - x_t[low]) - ((x[low] - x_t[low]) @ plane.normal) * plane.normal
    assert abs(move @ plane.normal) < 1e-12
    assert np.linalg.norm(move) == pytest.approx(np.linalg.norm(along) - simulator.SLIP * STEP)
    down = x_t - 0.009 * plane.normal  # a millimetre above the plane: in contact already
    for lift, held in ((0.0, True), (0.003, False)):  # what the solver lifts lets go: no glue
        assert simulator.project_contact(down + lift * plane.normal, down, [plane])[0][low] == held
    sunk = x_t - 0.02 * plane.normal
    active, x_c = simulator.project_contact(sunk, sunk, [plane])
    np.testing.assert_allclose(plane.distance(x_c[active])[0] - RADII[active], 0.0, atol=1e-12)


def test_contact_slips():
    """Beside another person a particle is pushed out along the normal and slides freely; a wall would hold it."""
    hand = J["wrist_l"]
    x_t = STAND + [0.0, 0.0, 0.5]  # in the air: the sphere is all that is near
    place = x_t[hand] + [0.0, RADII[hand] + 0.3 + 0.004, 0.0]
    x = x_t.copy()
    x[hand] += [0.01, 0.02, 0.0]
    for slippery, along in ((False, 0.0), (True, 0.01)):
        person = simulator.Spheres(place[None], np.array([0.3]), slippery)
        active, x_c = simulator.project_contact(x, x_t, (Plane(), person))
        assert active[hand]
        np.testing.assert_allclose(x_c[hand] - x_t[hand], [along, 0.0, 0.0], atol=1e-12)
    low = int(np.argmin(STAND[:, 2] - RADII))  # a foot on the floor sticks, although a person is slippery
    stand = STAND - [0.0, 0.0, (STAND[:, 2] - RADII).min()]
    moved = stand.copy()
    moved[low, 0] += 0.01
    np.testing.assert_allclose(simulator.project_contact(moved, stand, (Plane(), person))[1][low, 0], stand[low, 0])


def test_project_prior():
    """Eq. 10 against a loop."""
    samples = np.stack([jiggled(k) for k in range(20)])
    x = jiggled(30)
    loop = min(range(20), key=lambda k: sum(float(np.sum((a - b) ** 2)) for a, b in zip(x, samples[k])))
    assert simulator.project_prior(x, samples) == loop


# ------------------------------------------------------------------------------------ rotations, range of motion


def test_swing_twist():
    """Rotations survive the way through positions and twists; the parts against SciPy."""
    for kind in ("walk", "jog"):
        x, quat = motion(kind, **({"speed": 2.5} if kind == "jog" else {}))
        for t in range(0, len(x), 13):
            R, u = swing_twist(x[t], twists(quat[t]))
            np.testing.assert_allclose(R[LIMITED], quat_matrix(quat[t])[LIMITED], atol=1e-9)
            b = x[t, 7] - x[t, 4]
            np.testing.assert_allclose(R[PARENTS[4]] @ u[4], b / np.linalg.norm(b), atol=1e-9)
    rng = np.random.default_rng(0)
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.standard_normal((2, 30, 3)))
    b[0] = -a[0]
    s = swing(a, b)
    np.testing.assert_allclose(Rotation.from_rotvec(s).apply(a), b, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(s, axis=1), np.arccos(np.clip(np.sum(a * b, axis=1), -1, 1)), atol=1e-7)
    np.testing.assert_allclose(_turn(s), Rotation.from_rotvec(s).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(_swing_matrix(a, b), Rotation.from_rotvec(s).as_matrix(), atol=1e-7)
    o, p = rng.standard_normal((2, 5, 3))
    np.testing.assert_allclose(align(o[None], p[None])[0], Rotation.align_vectors(p, o)[0].as_matrix(), atol=1e-9)
    turn = Rotation.from_rotvec(0.7 * AXIS[1])  # a twist of the hip is read off as it is
    quat = REST.copy()
    quat[1] = turn.as_quat(scalar_first=True)
    assert twists(quat)[0][1] == pytest.approx(0.7)
    waved = REST.copy()
    waved[J["head"]] = Rotation.from_rotvec([0, 0, 0.5]).as_quat(scalar_first=True)
    leaf = Rotation.from_matrix(twists(waved)[1][list(LEAVES).index(J["head"])]).magnitude()
    assert 0.4 < leaf < 0.5 * (1 - LEAF_DAMPING) + 0.01  # damped towards rest


def test_range_of_motion():
    """Built-in motions are inside; an elbow and a knee bent backwards come back to their limits, bones intact."""
    for kind in ("walk", "jog", "stand"):
        x, quat = motion(kind, **({"speed": 2.5} if kind == "jog" else {}))
        inside = [project_range_of_motion(a, twists(q)) is a for a, q in zip(list(x), quat)]
        assert np.mean(inside) > 0.99, kind
    quat = REST.copy()
    bent = Rotation.from_euler("y", 60, degrees=True).as_quat(scalar_first=True)  # forwards is negative for the elbow
    quat[J["elbow_l"]] = quat[J["wrist_l"]] = bent
    x = forward_kinematics(OFFSETS[0], quat)
    r = project_range_of_motion(x, twists(quat))
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ r, axis=1), LENGTHS)
    _, u = swing_twist(r, twists(quat))
    angle = np.degrees(np.arccos(u[J["elbow_l"]] @ AXIS[J["elbow_l"]]))
    assert angle == pytest.approx(LIMITS["elbow"][0][1], abs=0.1)
    assert (LOW[LIMITED] < HIGH[LIMITED]).all()
    left, right = J["hip_l"], J["hip_r"]
    assert LOW[left, 1] == -HIGH[right, 1] and LOW[left, 0] == LOW[right, 0]


def spread_leg(out, flexed):
    """Someone who stands, the right leg lifted sideways by `out` and forwards by `flexed` [degrees]."""
    quat = REST.copy()
    leg = Rotation.from_euler("yx", [-flexed, -out], degrees=True).as_quat(scalar_first=True)
    quat[[J[f"{name}_r"] for name in ("hip", "knee", "ankle", "foot")]] = leg
    return forward_kinematics(OFFSETS[0], quat)


def test_a_limp_range_of_motion_is_an_energy():
    """A leg led round a loop outside its limits gains nothing; clipped angles give it a third of all work."""
    phase = np.linspace(0.0, 2.0 * np.pi, 201)
    loop = [spread_leg(62.0 + 6.0 * np.cos(a), 130.0 + 6.0 * np.sin(a)) for a in phase]
    moved, twist = np.diff(loop, axis=0), twists(REST)

    def gain(project):
        pull = np.array([project(x, twist) - x for x in loop])
        return abs(np.sum(0.5 * (pull[1:] + pull[:-1]) * moved, axis=(1, 2)).sum())

    assert gain(project_range_of_motion) > 0.02  # m², times w/h² a work: 240 J a round
    assert gain(body.nearest_in_range) < 0.03 * gain(project_range_of_motion)


def test_nearest_in_range():
    """Inside its limits, of whole bones, no force, no torque, projected twice is once; no pose inside is nearer."""
    x, twist, rng = spread_leg(66.0, 134.0), twists(REST), np.random.default_rng(0)
    r = body.nearest_in_range(x, twist)
    angles = joint_angles(r, twist)
    assert (angles < HIGH + 1e-9)[LIMITED].all() and (angles > LOW - 1e-9)[LIMITED].all()
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ r, axis=1), LENGTHS)
    np.testing.assert_allclose((r - x).sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(x - x.mean(axis=0), r - x).sum(axis=0), 0, atol=1e-10)
    np.testing.assert_allclose(body.nearest_in_range(r, twist), r, atol=1e-9)
    assert body.nearest_in_range(STAND, twist) is STAND
    far, root = np.sum((r - x) ** 2), np.tile(np.eye(3), (N, 1, 1))
    assert far < 0.1 * np.sum((project_range_of_motion(x, twist) - x) ** 2)
    free = [(j, k) for j in LIMITED for k in (0, 1)] + [(9, 2)]
    rows, columns = np.array(free).T

    def distance(values):
        other = np.zeros((N, 3))
        other[rows, columns] = values
        return np.sum((body._posed(other, root, x - x.mean(axis=0))[0] - x + x.mean(axis=0)) ** 2)

    bounds = list(zip(LOW[rows, columns], HIGH[rows, columns], strict=True))
    best = minimize(distance, angles[rows, columns], bounds=bounds, method="L-BFGS-B")
    assert best.fun <= far < 1.05 * best.fun
    for _ in range(20):
        other = angles[rows, columns] + 0.05 * rng.standard_normal(len(free))
        assert distance(np.clip(other, *np.array(bounds).T)) > far


def test_range_of_motion_on_recorded_motion(mocap_dir):
    """The limits hold recorded walking and running."""
    from mocap import data

    clips = data.load(mocap_dir / "bandai", 30.0, "*_00[1-2]*")[:6]
    inside = []
    for clip in clips:
        x, quat = character_motion(clip)
        inside += [project_range_of_motion(a, twists(q)) is a for a, q in zip(list(x[::4]), quat[::4])]
    assert np.mean(inside) > 0.95


# ------------------------------------------------------------------------------------ root wrench


def test_momentum_rate():
    """Eqs. 12 and 13 against the momenta before and after."""
    x_t, v_t, x = jiggled(0), 0.3 * jiggled(1), jiggled(2)
    com = x_t.mean(axis=0)
    v = (x - x_t) / STEP
    momenta = [np.concatenate([u.sum(axis=0), sum(np.cross(p - com, w) for p, w in zip(x_t, u))]) for u in (v_t, v)]
    np.testing.assert_allclose(simulator.momentum_rate(x, x_t, v_t), (momenta[1] - momenta[0]) / STEP, rtol=1e-9)


def test_wrench_map():
    """B x − a against Eqs. 12 and 13 less gravity and the external forces; zero in free flight."""
    x_t, v_t, x, force = jiggled(0), 0.3 * jiggled(1), jiggled(2), 5.0 * jiggled(3)
    B, a = simulator.wrench_map(x_t, v_t, force)
    expected = simulator.momentum_rate(x, x_t, v_t)
    expected[:3] -= N * GRAVITY + force.sum(axis=0)
    expected[3:] -= np.cross(x_t - x_t.mean(axis=0), force).sum(axis=0)
    np.testing.assert_allclose(B @ x.ravel() - a, expected, atol=1e-8)
    y = simulator.inertial_target(x_t, v_t, force)
    np.testing.assert_allclose(B @ y.ravel() - a, 0.0, atol=1e-8)


def test_friction_basis():
    """Edges lie on the cone, and their wrenches are forces at the points."""
    points = np.array([[0.1, 0.0, 0.0], [-0.1, 0.2, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6]])
    com = np.array([0.0, 0.1, 0.9])
    F, d = simulator.friction_basis(points, normals, com, mu=0.5, edges=6)
    assert F.shape == (6, 12)
    for k in range(12):
        n, p = normals[k // 6], points[k // 6]
        assert np.linalg.norm(d[k] - (d[k] @ n) * n) == pytest.approx(0.5 * (d[k] @ n))
        np.testing.assert_allclose(F[:, k], np.concatenate([d[k], np.cross(p - com, d[k])]))


def test_nnls_against_brute_force():
    """Eq. 11: the best over all supports of the unconstrained least squares that come out non-negative."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        F, b = rng.standard_normal((6, 7)), rng.standard_normal(6)
        c, residual = simulator.contact_forces(F, b)
        best = np.linalg.norm(b)
        for k in range(1, 7):
            for support in itertools.combinations(range(7), k):
                s = np.linalg.lstsq(F[:, support], b, rcond=None)[0]
                if (s >= 0).all():
                    best = min(best, np.linalg.norm(F[:, support] @ s - b))
        assert (c >= 0).all()
        assert np.linalg.norm(residual) == pytest.approx(best, abs=1e-9)
    assert simulator.contact_forces(np.zeros((6, 0)), b)[1] is b


def test_a_standing_body_needs_no_root_wrench():
    """Someone who stands still is held up by the floor alone, with m g."""
    sim = Simulator(None)
    B, a = simulator.wrench_map(STAND, np.zeros((N, 3)), np.zeros((N, 3)))
    points, normals = sim.touching(STAND)
    F, d = simulator.friction_basis(points, normals, STAND.mean(axis=0))
    c, residual = simulator.contact_forces(F, B @ STAND.ravel() - a)
    assert len(points) == 4 and np.linalg.norm(residual) < 0.2
    np.testing.assert_allclose((c[:, None] * d).sum(axis=0), -N * GRAVITY, atol=0.2)


def test_soft_correction_both_ways():
    """Eq. 14: closed form, KKT system and a general optimiser agree; a larger w_p leaves less."""
    x, x_t, v_t = jiggled(0), jiggled(1, 0.01), 0.1 * jiggled(2)
    B, a = simulator.wrench_map(x_t, v_t, np.zeros((N, 3)))
    Fc = np.random.default_rng(0).standard_normal(6) * 100
    residual = B @ x.ravel() - a - Fc
    left = []
    for weight in (1e-8, 1e-6, 1e-4):
        closed = simulator.soft_correction(x, B, residual, weight)
        kkt, epsilon = simulator.soft_correction_kkt(x, B, residual, weight)
        np.testing.assert_allclose(closed, kkt, atol=1e-9)
        np.testing.assert_allclose(B @ closed.ravel() - a - Fc, epsilon, atol=1e-5)
        left.append(np.linalg.norm(epsilon))
    assert left[2] < left[1] < left[0] < np.linalg.norm(residual)

    def objective(z):
        e = B @ z - a - Fc
        return np.sum((z - x.ravel()) ** 2) + 1e-6 * e @ e, 2 * (z - x.ravel()) + 2e-6 * B.T @ e

    found = minimize(
        objective, x.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 2000, "ftol": 1e-15, "gtol": 1e-10}
    )
    np.testing.assert_allclose(simulator.soft_correction(x, B, residual, 1e-6).ravel(), found.x, atol=1e-5)


@pytest.mark.parametrize(
    "weight, force, roll, pitch, turn", [(1e-6, 0.95, 0.82, 0.81, 0.20), (5e-6, 0.99, 0.96, 0.96, 0.55)]
)
def test_what_the_correction_removes(weight, force, roll, pitch, turn):
    """Of a unit wrench on someone standing, along each axis: what the comments of w_p say."""
    B, _ = simulator.wrench_map(STAND, np.zeros((N, 3)), np.zeros((N, 3)))
    left = [B @ (simulator.soft_correction(STAND, B, e, weight) - STAND).ravel() for e in np.eye(6)]
    removed = [-v[i] for i, v in enumerate(left)]
    np.testing.assert_allclose(removed, [force] * 3 + [roll, pitch, turn], atol=0.01)


def test_a_simulator_corrects_with_its_own_weight():
    """A larger w_p leaves less of the root wrench of a step, bones not restored."""
    left = []
    for weight in (1e-8, 1e-6, 1e-4):
        sim = Simulator(prior(), restore=False, wrench_limit=0.0, wrench_weight=weight)
        force = np.zeros((N, 3))
        force[J["spine3"], 1] = 150.0
        left.append(sim.step(state_of(sim), force)[1].wrench)
    assert left[2] < 0.3 * left[1] < 0.3 * left[0]


# ------------------------------------------------------------------------------------ the step


def test_step_solves_equation_4():
    """One iteration's global step minimises Eq. 1 with the projections held, by SciPy; the energies' sum falls."""
    sim = Simulator(None, contact=True, limits=None, restore=False, iterations=1)
    assert sim.w.friction > 0
    state = State(STAND - [0, 0, 0.01], np.zeros((N, 3)), REST)
    got, _ = sim.step(state)
    y = simulator.inertial_target(state.x, state.v, np.zeros((N, 3)))
    start = y.copy()
    active, x_c = simulator.project_contact(y, state.x, [Plane()])
    start[active] = x_c[active]
    d = simulator.project_rigidity(start)
    active, x_c = simulator.project_contact(start, state.x, [Plane()])
    unit, w = 1 / STEP**2, sim.w
    laid = simulator.project_friction(start, state.x)

    def energy(z):
        z = z.reshape(N, 3)
        parts = [
            simulator.momentum(z, y),
            simulator.spring(w.rigidity * unit, DIFFERENCE, z, d),
            simulator.spring(w.contact * unit * active, np.eye(N), z, x_c),
            simulator.spring(w.friction * unit, np.eye(N), z, laid),
        ]
        return sum(p[0] for p in parts), sum(p[1] for p in parts).ravel()

    found = minimize(energy, state.x.ravel(), jac=True, method="BFGS", options={"gtol": 1e-7, "maxiter": 3000})
    np.testing.assert_allclose(got.x.ravel(), found.x, atol=1e-6)
    H = sim.inverse(active, False, friction=w.friction)
    rhs = y + sim.JT @ d + w.contact * active[:, None] * x_c + w.friction * laid
    np.testing.assert_allclose(np.linalg.inv(H) @ got.x, rhs, atol=1e-9)

    totals = []
    for iterations in (1, 3, 10, 40):
        sim = Simulator(None, limits=None, restore=False, iterations=iterations)
        _, out = sim.step(State(STAND - [0, 0, 0.01], 0.5 * jiggled(3), REST))
        totals.append(sum(out.energies.values()))
    assert all(b <= a + 1e-9 for a, b in zip(totals, totals[1:])), totals


def test_step_with_everything_is_a_minimum():
    """All terms together: the step's x is where SciPy finds the minimum with the last projections."""
    sim = Simulator(prior(), correction=False, restore=False, iterations=60, samples=4)
    state = state_of(sim)
    pins, v_tar = {J["wrist_l"]: state.x[J["wrist_l"]] + 0.1}, np.array([1.5, 0.3])
    got, out = sim.step(state, v_tar=v_tar, pins=pins, rng=np.random.default_rng(0))
    x, unit, w = got.x, 1 / STEP**2, sim.w
    y = simulator.inertial_target(state.x, state.v, np.zeros((N, 3)))
    samples, rotations = sim._ask(state, np.random.default_rng(0))
    twist = twists(rotations[out.sample])
    active, x_c = simulator.project_contact(x, state.x, sim.obstacles)
    gradient = simulator.momentum(x, y)[1] + simulator.direction(w.direction, x, state.x, v_tar)[1]
    for weight, A, p in ((sim.w_rigid, sim.A, simulator.project_rigidity(x)), (w.contact * active, np.eye(N), x_c),
                         (w.range_of_motion, np.eye(N), project_range_of_motion(x, twist)),
                         (w.prior, np.eye(N), samples[out.sample])):  # fmt: skip
        gradient += simulator.spring(weight * unit, A, x, p)[1]
    gradient[J["wrist_l"]] += w.constraint * unit * (x[J["wrist_l"]] - pins[J["wrist_l"]])
    assert np.abs(gradient).max() < 1e-2 * unit * w.prior * 1e-2  # a hundredth of a millimetre of the prior's spring


def test_free_fall():
    """No contact: every particle falls by the implicit Euler's g h² t (t + 1) / 2, bones intact."""
    sim, state = Simulator(None), None
    state = sim.begin(STAND + [0, 0, 5.0], REST)
    for t in range(1, 16):
        state, out = sim.step(state)
        np.testing.assert_allclose(state.x, STAND + [0, 0, 5.0] + GRAVITY * STEP**2 * t * (t + 1) / 2, atol=1e-9)
    assert out.bone_error < 1e-9 and out.energies["momentum"] < 1e-12


def test_momentum_is_conserved():
    """A tumbling body, and forces that cancel: linear momentum exactly, angular to what implicit Euler loses."""
    sim = Simulator(None, contact=False)
    x, quat = (a[40] for a in motion())
    spin = np.cross([0.2, 1.0, 0.3], x - x.mean(axis=0)) + [1.0, 0.5, 0.0]
    state = sim.begin(x + [0, 0, 3], quat, spin)
    total = lambda s: (s.v.sum(axis=0), np.cross(s.x - s.com, s.v).sum(axis=0))  # noqa: E731
    p0, L0 = total(state)
    force = np.zeros((N, 3))
    force[J["wrist_l"]], force[J["wrist_r"]] = (0, 20, 0), (0, -20, 0)
    for _ in range(10):
        state, _ = sim.step(state)
    p, L = total(state)
    np.testing.assert_allclose(p, p0 + 10 * STEP * N * GRAVITY, atol=1e-9)
    assert np.linalg.norm(L - L0) < 0.10 * np.linalg.norm(L0)
    pushed, _ = sim.step(state, force)
    np.testing.assert_allclose(total(pushed)[0], p + STEP * N * GRAVITY, atol=1e-9)


def period(angle):
    cross = [i + angle[i] / (angle[i] - angle[i + 1]) for i in range(len(angle) - 1) if angle[i] * angle[i + 1] < 0]
    return 2 * STEP * np.mean(np.diff(cross))


@pytest.mark.parametrize("degrees", [20, 60])
def test_pendulum(degrees):
    """Swing in a third of a second and period within 10 % of the exact pendulum's, bone error below 1 %."""
    theta, length = np.radians(degrees), LENGTHS[J["wrist_l"] - 1]
    exact = solve_ivp(
        lambda t, y: [y[1], GRAVITY[2] / length * np.sin(y[0])],
        [0, 2],
        [theta, 0],
        t_eval=np.arange(61) * STEP,
        rtol=1e-9,
    ).y[0]
    angle, worst = forearm(Weights(), degrees)
    assert worst < 0.01
    assert abs((theta - angle[10]) / (theta - exact[10]) - 1) < 0.10
    assert abs(period(angle) / period(exact) - 1) < 0.10
    assert forearm(Weights(), degrees, restore=False)[1] < 0.05  # strong springs alone


def test_restore_bones():
    """Lengths exact; with equal anchors neither linear nor angular momentum changes; heavy anchors stay."""
    x, equal = STAND + 0.01 * np.random.default_rng(0).standard_normal((N, 3)), np.ones(N)
    out = simulator.restore_bones(x, equal)
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ out, axis=1), LENGTHS)
    np.testing.assert_allclose(out.mean(axis=0), x.mean(axis=0), atol=1e-12)
    torque = np.cross(x - x.mean(axis=0), out - x).sum(axis=0)
    assert np.abs(torque).max() < 0.05 * np.abs(np.cross(x - x.mean(axis=0), out - x)).sum()
    anchor = equal.copy()
    anchor[FEET] = 1e6
    assert np.abs(simulator.restore_bones(STAND + 0.01 * (x - STAND), anchor) - x)[FEET].max() < 0.05
    # the nearest change, by SciPy
    lengths = {"type": "eq", "fun": lambda z: np.linalg.norm(DIFFERENCE @ z.reshape(N, 3), axis=1) - LENGTHS}
    options = {"maxiter": 60, "ftol": 1e-12}
    distance = lambda z: (np.sum((z - x.ravel()) ** 2), 2 * (z - x.ravel()))  # noqa: E731
    found = minimize(distance, x.ravel(), jac=True, method="SLSQP", constraints=lengths, options=options)
    near = np.sum((out - x) ** 2)
    assert near < 1.01 * found.fun + 1e-9
    np.testing.assert_allclose(
        np.linalg.norm(DIFFERENCE @ simulator.restore_bones(np.zeros((N, 3)), equal), axis=1), LENGTHS
    )


def test_bones_and_wrench_together():
    """Eq. 14 with bones as constraints, against SciPy; anchored bones alone change the wrench, together they do not."""
    rng = np.random.default_rng(3)
    x, v = STAND + 0.02 * rng.standard_normal((N, 3)), 0.3 * rng.standard_normal((N, 3))
    anchor = np.where(np.isin(np.arange(N), FEET), 10.0, 1.0)
    B, a = simulator.wrench_map(STAND, v, np.zeros((N, 3)))
    t = B @ x.ravel() - np.array([60.0, -30.0, 20.0, 10.0, -5.0, 8.0])
    weight = 1e-6
    out = simulator.restore_bones(x, anchor, (B, t, weight), iterations=8)
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ out, axis=1), LENGTHS)

    def cost(z):
        d, e = z - x.ravel(), B @ z - t
        return d @ (np.repeat(anchor, 3) * d) + weight * e @ e, 2 * np.repeat(anchor, 3) * d + 2 * weight * B.T @ e

    lengths = {"type": "eq", "fun": lambda z: np.linalg.norm(DIFFERENCE @ z.reshape(N, 3), axis=1) - LENGTHS}
    options = {"maxiter": 200, "ftol": 1e-14}
    found = minimize(cost, x.ravel(), jac=True, method="SLSQP", constraints=lengths, options=options)
    assert cost(out.ravel())[0] < 1.02 * found.fun
    alone = simulator.restore_bones(x, anchor)
    stiff = simulator.restore_bones(x, anchor, (B, B @ x.ravel(), 1.0), iterations=8)
    away = lambda y: np.linalg.norm(B @ (y - x).ravel())  # noqa: E731
    assert away(stiff) < 0.05 * away(alone)
    free = simulator.restore_bones(x, np.ones(N), (B, t, weight), iterations=8) - x  # no bone's error: Eq. 14 alone
    exact = STAND.copy()
    got = simulator.restore_bones(exact, np.ones(N), (B, B @ exact.ravel() - 1e-3, weight))
    np.testing.assert_allclose(got, simulator.soft_correction(exact, B, np.full(6, 1e-3), weight), atol=1e-6)
    assert np.abs(free).max() < 0.2


def test_nobody_leads_who_has_no_motion():
    """Eq. 16 draws a body that the prior carries and no rag doll: its step is the same without, to the bit."""
    sim = Simulator(None)
    state = state_of(sim)
    led, free = sim.step(state, v_tar=[2.5, 0.0]), sim.step(state)
    np.testing.assert_array_equal(led[0].x, free[0].x)
    assert "direction" not in led[1].energies
    carried = Simulator(prior(), samples=4)
    led, free = (carried.step(state, v_tar=v, rng=np.random.default_rng(0))[0] for v in ([2.5, 0.0], None))
    assert (led.x - free.x)[:, 0].mean() > 1e-3


def test_friction_of_limp_joints():
    """The pose is laid on as a rigid body: no force, no torque; whatever a rigid motion did to it is not held back."""
    rng = np.random.default_rng(5)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.8]).as_matrix()
    moved = STAND @ turn.T + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(simulator.project_friction(moved, STAND), moved, atol=1e-12)
    x = STAND + 0.03 * rng.standard_normal((N, 3))
    p = simulator.project_friction(x, STAND)
    np.testing.assert_allclose(p.mean(axis=0), x.mean(axis=0), atol=1e-12)
    assert np.abs(np.cross(x - x.mean(axis=0), p - x).sum(axis=0)).max() < 1e-12
    near = np.sum((p - x) ** 2)
    for _ in range(50):  # no rigid motion of STAND lies nearer
        other = STAND @ Rotation.from_rotvec(0.05 * rng.standard_normal(3)).as_matrix().T
        assert near <= np.sum((other - other.mean(axis=0) + x.mean(axis=0) - x) ** 2) + 1e-12


@pytest.mark.parametrize("newton, seed", [(0.0, 0), (300.0, 1)])
def test_who_lies_lies_still(newton, seed):
    """Ten seconds after a rag doll fell no particle moves; one that balances on its feet does not count as lying."""
    x, quat = motion()
    sim = Simulator(None)
    state = sim.begin(x[60 + seed], quat[60 + seed], (x[60 + seed] - x[59 + seed]) / STEP)
    assert not simulator.at_rest(np.zeros((N, 3)), simulator.gaps(state.x, [Plane()])[0])
    force = np.zeros((N, 3))
    force[J["spine3"], 1] = newton
    for t in range(300):
        state, _ = sim.step(state, force if t < 8 else None)
    assert np.linalg.norm(state.v, axis=1).max() < 0.05 and state.com[2] < 0.3
    assert simulator.at_rest(state.v, simulator.gaps(state.x, [Plane()])[0])


def test_inverse_is_kept():
    """One factorisation an active set; Eq. 16's rank-one term is another set."""
    sim = Simulator(None)
    a, b = np.zeros(N, bool), np.zeros(N, bool)
    b[7] = True
    first = sim.inverse(a, True)
    assert sim.inverse(a.copy(), True) is first and sim.inverse(b, True) is not first
    w = sim.w
    H = (
        np.diag(1 + w.range_of_motion + w.prior + 0.0 * a)
        + w.rigidity * DIFFERENCE.T @ DIFFERENCE
        + w.direction * np.ones((N, N))
    )
    np.testing.assert_allclose(sim.inverse(a, True, w.range_of_motion, (), True) @ H, np.eye(N), atol=1e-9)


def test_walking_goes_on():
    """Unperturbed, the default prior walks on: at its speed, upright, feet planted, hardly any correction."""
    sim, rng = Simulator(prior()), np.random.default_rng(0)
    state = state_of(sim)
    first, wrench, slide = state.com, [], []
    for _ in range(150):
        new, out = sim.step(state, rng=rng)
        feet = out.active[FEET]
        slide += list(np.linalg.norm(new.v[FEET], axis=1)[feet])
        wrench.append(out.wrench_pd)
        state = new
        assert out.sample >= 0
    assert 1.0 < np.linalg.norm((state.com - first)[:2]) / 5.0 < 1.5
    assert 0.85 < state.x[0, 2] / STANDING < 1.05
    assert np.mean(slide) < 0.06 and np.median(wrench) < 15
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ state.x, axis=1), LENGTHS, atol=1e-9)


def test_a_push_moves_and_a_harder_one_fells():
    """A sideways impulse: none, small, huge; displacement grows, and the huge one ends on the floor."""
    away = []
    for newton in (0.0, 120.0, 400.0):
        sim, rng = Simulator(prior()), np.random.default_rng(0)
        state = state_of(sim)
        force = np.zeros((N, 3))
        force[J["spine3"], 1] = newton
        for t in range(90):
            state, _ = sim.step(state, force if 5 <= t < 13 else None, rng=rng)
            if t == 25:
                away.append(state.com[1])
    assert away[1] > away[0] + 0.08 and away[2] > away[1]
    assert state.com[2] < 0.5


def test_switches():
    """§8.3's ablations do what they say."""
    state = state_of(Simulator(None))
    low = State(state.x - [0, 0, 0.2], state.v, state.quat)
    assert not Simulator(None, contact=False).step(low)[1].active.any()
    assert Simulator(None).step(low)[1].active.any()
    force = np.zeros((N, 3))
    force[J["spine3"], 1] = 300.0
    run = lambda **kw: Simulator(prior(), **kw).step(state, force, rng=np.random.default_rng(0))  # noqa: E731
    assert run()[1].wrench < run()[1].wrench_pd - 20
    as_it_is, out = run(correction=False)
    assert out.wrench == pytest.approx(out.wrench_pd, rel=0.05)
    # the metric is of the motion itself, bones restored: with the forces that were found, from the positions
    B, a = simulator.wrench_map(state.x, state.v, force)
    found = np.concatenate([out.forces.sum(axis=0), np.cross(out.points - state.com, out.forces).sum(axis=0)])
    assert out.wrench == pytest.approx(np.linalg.norm(B @ as_it_is.x.ravel() - a - found), rel=1e-6)
    assert np.abs(run(limits=None)[0].x - run()[0].x).max() > 0
    assert np.abs(run(start="y")[0].x - run()[0].x).max() > 0
    assert np.abs(run(prior_at_first=True)[0].x - run()[0].x).max() > 0
    assert np.abs(np.linalg.norm(DIFFERENCE @ run(restore=False)[0].x, axis=1) / LENGTHS - 1).max() > 1e-4
    with pytest.raises(ValueError, match="mode, y"):
        Simulator(None, start="x")


def test_without_contact_the_prior_still_walks():
    """§8.3's switch is Eq. 6's alone: Eq. 11's contacts stay, or Eq. 14 would make the walker fall freely."""
    sim, rng = Simulator(prior(), contact=False), np.random.default_rng(0)
    state = state_of(sim)
    height = [state.com[2]]
    for _ in range(60):
        state, out = sim.step(state, rng=rng)
        height.append(state.com[2])
        assert not out.active.any()
    assert np.ptp(height) < 0.1 and len(out.points)


def test_energy_inside_the_limits():
    """With p = x E_3's own weight drags a body towards the mode; of a led or held one it is left out.

    Whether a pose is inside is seen from the numbers: a projection that returns a copy is the same projection."""
    state = state_of(Simulator(None))
    pins = {J["wrist_l"]: state.x[J["wrist_l"]] + 0.05}

    def run(inside, pins=None, limits=project_range_of_motion):
        sim = Simulator(prior(), weights=Weights(inside=inside), limits=limits)
        return sim.step(state, pins=pins, rng=np.random.default_rng(0))[0].x

    mode = prior().mode(state)[0]
    off = [np.linalg.norm(run(inside) - mode) for inside in (0.0, 1.0, 9.0)]
    assert off[2] < off[0] and off[1] != off[0]
    np.testing.assert_array_equal(run(9.0, pins), run(0.0, pins))
    copy = lambda x, twist: project_range_of_motion(x, twist).copy()  # noqa: E731
    np.testing.assert_array_equal(run(0.0, limits=copy), run(0.0))


def test_a_small_push_is_not_swallowed():
    """40 N for 0.27 s move a walker visibly; where nothing is corrected a phantom wrench bears them."""

    def centre(newton, **settings):
        sim, rng = Simulator(prior(), **settings), np.random.default_rng(0)
        state, force = state_of(sim), np.zeros((N, 3))
        force[J["spine3"], 1] = newton
        for t in range(13):
            state, _ = sim.step(state, force if t >= 5 else None, rng=rng)
        return state.com[1]

    moved = centre(40.0) - centre(0.0)
    free = 40.0 / N * STEP**2 * 8 * 9 / 2  # 7 cm, without anything to hold it
    assert 0.2 * free < moved < 1.2 * free
    assert centre(40.0, wrench_limit=1e9) - centre(0.0, wrench_limit=1e9) < 0.3 * moved
    assert simulator.WRENCH_LIMIT <= 0.08 * N * 9.81  # of the weight


def test_standing_on_a_box():
    """A limp body that falls on a box lies on it, and not in it or on the floor below."""
    x, quat = (a[30] for a in motion("stand"))
    box = Box(np.array([*x[0, :2], 0.2]), np.array([1.5, 1.5, 0.2]))
    sim = Simulator(None, obstacles=(Plane(), box))
    state = sim.begin(x, quat)
    assert (state.x[:, 2] - RADII).min() == pytest.approx(0.4, abs=0.01)
    for _ in range(60):
        state, out = sim.step(state)
    assert out.active.any() and (state.x[:, 2] - RADII).min() > 0.4 - 0.05 and state.com[2] < 0.8


def test_stiff_knee_spring():
    """A spring between hip and heel keeps their distance."""
    bent = REST.copy()
    bent[1], bent[4] = (Rotation.from_euler("y", a, degrees=True).as_quat(scalar_first=True) for a in (-40, 40))
    x = forward_kinematics(OFFSETS[0] + [0, 0, 2], bent)
    length = LENGTHS[3] + LENGTHS[6]
    sim = Simulator(None, springs=((1, 7, length, 60.0),))
    state = sim.begin(x, bent)
    for _ in range(10):
        state, _ = sim.step(state)
    assert np.linalg.norm(x[1] - x[7]) < 0.8 * length
    assert np.linalg.norm(state.x[1] - state.x[7]) > 0.97 * length


# ------------------------------------------------------------------------------------ priors


def test_clip_and_switch_priors():
    """The next frame, the last one after the end; another prior from the frame of the force on."""
    x, quat = motion()
    clip = ClipPrior(x, quat, 10)
    state = State(x[10], 0 * x[10], quat[10], 0)
    np.testing.assert_array_equal(clip.mode(state)[0], x[11])
    late = State(x[10], 0 * x[10], quat[10], 10_000)
    np.testing.assert_array_equal(clip.sample(late, 5, None)[0][0], x[-1])
    both = SwitchPrior(clip, prior(), 5)
    assert len(both.sample(state, 8, np.random.default_rng(0))[0]) == 1
    assert len(both.sample(State(x[10], 0 * x[10], quat[10], 5), 8, np.random.default_rng(0))[0]) == 8
    sim = Simulator(clip)
    state = sim.begin(x[10], quat[10], (x[10] - x[9]) / STEP)
    for _ in range(60):
        state, out = sim.step(state)
    assert np.abs(state.x - x[70]).max() < 0.06  # tracked


def test_nearest_prior():
    """A frame of the set leads to its own next frame, wherever it stands and looks; far from the set nothing fits."""
    p, (x, quat) = prior(), motion()
    turn = Rotation.from_euler("z", 1.1)
    q = (
        (turn * Rotation.from_quat(quat[49:52].reshape(-1, 4), scalar_first=True))
        .as_quat(scalar_first=True)
        .reshape(3, N, 4)
    )
    moved = np.einsum("ij,tkj->tki", turn.as_matrix(), x[49:52]) + [3.0, -2.0, 0.0]
    state = State(moved[1], (moved[1] - moved[0]) / STEP, q[1])
    got, rotation = p.mode(state)
    rest = np.setdiff1d(np.arange(N), LEGS[1:].ravel())
    np.testing.assert_allclose(got[rest], moved[2][rest], atol=1e-6)
    np.testing.assert_allclose(got, moved[2], atol=0.01)  # planted: the standing foot does not move at all
    np.testing.assert_allclose(quat_matrix(rotation), quat_matrix(q[2]), atol=1e-6)
    # nearest, against a loop over the whole features
    f = p.features(state.x[None], state.v[None], state.quat[None])[0]
    z, bank = (f - p.mean) @ p.basis, p.bank.astype(float)
    assert p.nearest(state, 5)[0][0] == np.argmin([np.sum((z - b) ** 2) for b in bank])
    samples, rotations = p.sample(state, 12, np.random.default_rng(0))
    assert samples.shape == (12, N, 3) and rotations.shape == (12, N, 4)
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ samples, axis=-1), np.tile(LENGTHS, (12, 1)), atol=1e-9)
    again = p.sample(state, 12, np.random.default_rng(0))[0]
    np.testing.assert_array_equal(samples, again)
    upside = State(moved[1] * [1, 1, -1] + [0, 0, 2], 0 * state.v, q[1])
    assert len(p.sample(upside, 12, np.random.default_rng(0))[0]) == 0
    with pytest.raises(ValueError, match="three frames"):
        NearestPrior([(x[:2], quat[:2])])
    assert NearestPrior([motion()], floor=Plane(offset=0.2)).ground(np.full((N, 3), 2.0)) == pytest.approx(0.2)


def test_plant():
    """A foot in contact stays, one that swings clears the floor, bones keep their lengths, the rest does not move."""
    x, _ = motion()
    held = prior_module.contacts_of(x)
    assert 0.3 < held.mean() < 0.7 and held.shape == (len(x), 4)
    slow = np.linalg.norm(np.diff(x[:, FEET, :2], axis=0), axis=-1) / STEP
    low = x[:, FEET, 2] - RADII[FEET]
    for t in range(1, len(x), 7):
        want = (low[t] < 0.03) & (low[t - 1] < 0.03) & (slow[t - 1] < 0.5)
        np.testing.assert_array_equal(held[t], want)
    t = int(np.flatnonzero(held[:, 1] & ~held[:, 2:].any(axis=1))[3])  # on the left ball alone
    slid = x[t + 1] + [0.02, -0.01, 0.0]
    out = prior_module.plant(x[t], slid[None], held[t][None])[0]
    np.testing.assert_allclose(out[FEET[1], :2], x[t, FEET[1], :2], atol=1e-3)
    assert np.linalg.norm((slid - x[t])[FEET[1], :2]) > 0.015
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ out, axis=-1), LENGTHS, rtol=1e-6)
    rest = np.setdiff1d(np.arange(N), LEGS[1:].ravel())
    np.testing.assert_array_equal(out[rest], slid[rest])
    none = prior_module.plant(STAND, STAND[None], np.zeros((1, 4), bool))[0]
    gap = (none - STAND)[FEET, 2] + (STAND[FEET, 2] - RADII[FEET])
    np.testing.assert_allclose(gap, prior_module.CLEAR, atol=1e-3)
    raised = prior_module.plant(x[t] + [0, 0, 0.5], slid[None] + [0, 0, 0.5], held[t][None], 0.5)[0]
    np.testing.assert_allclose(raised, out + [0, 0, 0.5], atol=1e-9)


def test_who_stands_does_not_drift_from_his_feet():
    """On four contacts the body goes with its feet; on fewer the feet alone are put back."""
    four, moved = np.ones((1, 4), bool), STAND + [0.004, -0.002, 0.003]
    lowest = (STAND[FEET, 2] - RADII[FEET]).min() * np.array([0, 0, 1])
    np.testing.assert_allclose(prior_module.plant(STAND, moved[None], four)[0], STAND - lowest, atol=1e-3)
    lean = STAND.copy()
    lean[np.setdiff1d(np.arange(N), LEGS[1:].ravel())] += [0.01, 0.0, -0.02]  # the trunk over feet that stand: kept
    out = prior_module.plant(STAND, lean[None], four)[0]
    np.testing.assert_allclose(out[0], lean[0] - lowest, atol=1e-6)
    three = np.array([[True, True, False, True]])
    np.testing.assert_allclose(prior_module.plant(STAND, moved[None], three)[0, 0], moved[0], atol=1e-6)


# ------------------------------------------------------------------------------------ what goes wrong


class Broken:
    """A prior with a chosen answer."""

    def __init__(self, x, quat):
        self.x, self.quat = x, quat

    def sample(self, state, n, rng):
        return self.x, self.quat

    def mode(self, state):
        return state.x, state.quat


def test_bad_input():
    """One clear error each; no samples is a rag doll's step."""
    sim = Simulator(None)
    state = state_of(sim)
    for force, words in ((np.full((N, 3), np.nan), "force holds NaN"), (np.zeros((3, 3)), r"force has shape \(3, 3\)"),
                         (np.full((N, 3), np.inf), "force holds NaN or infinity")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            sim.step(state, force)
    with pytest.raises(ValueError, match="v_tar"):
        sim.step(state, v_tar=[1.0, np.nan])
    with pytest.raises(ValueError, match="pin of joint 3"):
        sim.step(state, pins={3: [0.0, 1.0]})
    x, quat = state.x[None], state.quat[None]
    for bad, words in (
        ((x * np.nan, quat), "Broken: positions holds NaN"),
        ((x[:, :5], quat), r"positions has shape \(1, 5, 3\)"),
        ((x, quat[..., :3]), "rotations has shape"),
        ((x, quat * np.inf), "rotations holds NaN"),
    ):
        with pytest.raises(ValueError, match=words):
            Simulator(Broken(*bad)).step(state)
    nothing, out = Simulator(Broken(x[:0], quat[:0])).step(state)
    doll, _ = Simulator(None).step(state)
    np.testing.assert_array_equal(nothing.x, doll.x)
    assert out.sample == -1


@pytest.mark.parametrize("answer", [None, (None, None), 3, ("a", "b"), ([[1.0], [2.0, 3.0]], [[1.0]]), (1.0, 2.0)])
def test_a_prior_without_arrays(answer):
    """Whatever `sample` or `mode` returns, the error is one line that names the prior."""
    state = state_of(Simulator(None))

    class Odd(Broken):
        def sample(self, state, n, rng):
            return answer

    class Modeless(Broken):
        def mode(self, state):
            return answer

    for kind in (Odd, Modeless):
        with pytest.raises(ValueError, match=f"prior {kind.__name__}: ") as error:
            Simulator(kind(state.x[None], state.quat[None])).step(state)
        assert "\n" not in str(error.value)


def test_priors_with_lists_and_without_rotations():
    """Lists of numbers do; quaternions of length 0 do not."""
    state = state_of(Simulator(None))

    class Lists(Broken):
        def sample(self, state, n, rng):
            return self.x.tolist(), self.quat.tolist()

        def mode(self, state):
            return state.x.tolist(), state.quat.tolist()

    x, quat = state.x[None], state.quat[None]
    got, _ = Simulator(Lists(x, quat)).step(state)
    np.testing.assert_array_equal(got.x, Simulator(Broken(x, quat)).step(state)[0].x)
    with pytest.raises(ValueError, match="prior Broken: rotations: quaternions have length 1, not 0"):
        Simulator(Broken(x, 0 * quat)).step(state)


def test_bad_settings():
    """What a simulator cannot be made with: one line each."""
    for wrong, words in (
        ({"samples": 0}, "samples 0"), ({"samples": -1}, "samples -1"), ({"samples": 1.5}, "samples 1.5"),
        ({"samples": True}, "samples True"), ({"iterations": 0}, "iterations 0"), ({"start": "x"}, "mode, y"),
        ({"obstacles": ()}, "no obstacles"), ({"weights": Weights(contact=-1.0)}, "contact -1"),
        ({"weights": Weights(prior=np.nan)}, "prior nan"), ({"wrench_limit": -1.0}, "wrench_limit -1"),
        ({"wrench_weight": 0.0}, "wrench_weight 0"), ({"wrench_weight": np.inf}, "wrench_weight inf"),
        ({"springs": ((0, 99, 1.0, 1.0),)}, "joints of 0 to 21"), ({"springs": ((0, 7, 1.0, np.nan),)}, "spring"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            Simulator(None, **wrong)
    assert Simulator(None, samples=np.int64(1), iterations=1).samples == 1


def test_bad_states():
    """A state that is no state is said to be one, before anything is computed with it."""
    sim = Simulator(prior())
    state = state_of(sim)
    nan, x, v, quat = state.x * np.nan, state.x, state.v, state.quat
    for bad, words in (
        (State(nan, v, quat), "state's positions holds NaN"), (State(x, nan, quat), "state's velocities holds NaN"),
        (State(x[:5], v, quat), "state's positions has shape"), (State(x, v, 0 * quat), "state's rotations: quat"),
        (State(x, 1e300 * v, quat), r"state's velocities holds values beyond 1e\+09"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            sim.step(bad)
    for args, words in (((nan, quat), "positions holds NaN"), ((x[:5], quat), r"positions has shape \(5, 3\)"),
                        ((x, quat, nan), "velocities holds NaN"), ((x, 0 * quat), "length 1, not 0")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            sim.begin(*args)
    for joint in (99, -1):
        with pytest.raises(ValueError, match="joints are 0 to 21"):
            sim.step(state, pins={joint: np.zeros(3)})
    with pytest.raises(ValueError, match=r"force holds values beyond 1e\+09"):
        sim.step(state, np.full((N, 3), 1e300))
    assert np.isfinite(sim.step(state, np.full((N, 3), 1e9), rng=np.random.default_rng(0))[0].x).all()


def test_bad_obstacles():
    """A normal of any length is the same half space; of none, an error.  A box's turn must be one."""
    x = np.random.default_rng(0).standard_normal((20, 3))
    d, n = Plane(np.array([0.0, 3.0, 4.0]), 5.0).distance(x)
    np.testing.assert_allclose(d, x @ [0.0, 0.6, 0.8] - 1.0)
    np.testing.assert_allclose(n[0], [0.0, 0.6, 0.8])
    for normal, offset in ((np.zeros(3), 0.0), (np.array([0.0, 0.0, 1.0]), np.nan)):
        with pytest.raises(ValueError, match="no half space"):
            Plane(normal, offset)
    with pytest.raises(ValueError, match="Plane: normal holds NaN"):
        Plane(np.full(3, np.nan))
    with pytest.raises(ValueError, match="Box: quat: quaternions have length 1, not 2"):
        Box(np.zeros(3), np.ones(3), np.array([2.0, 0.0, 0.0, 0.0]))


def test_nearest_prior_sees_a_new_floor():
    """What was found over one floor is not used over another, for the same state."""
    p, (x, quat) = NearestPrior([motion()]), motion()
    state = State(x[50], (x[50] - x[49]) / STEP, quat[50])
    level = p.mode(state)[0]
    p.floor = Plane(offset=-0.1)
    np.testing.assert_array_equal(p.mode(state)[0], NearestPrior([motion()], floor=Plane(offset=-0.1)).mode(state)[0])
    assert np.abs(p.mode(state)[0] - level).max() > 0.01


def test_incline():
    """Ankles are as far above the slope as they were above the floor; nothing is stretched; undone; velocities too."""
    from drop.prior import incline, level_state

    x, quat = motion("walk")
    x, quat = x[20:80], quat[20:80]
    lengths = lambda p: np.linalg.norm(DIFFERENCE @ p, axis=-1)  # noqa: E731
    for floor in (Plane([-0.27, 0.0, 1.0], 0.3), Plane([0.2, 0.15, 1.0], 0.3)):
        height = lambda p: (floor.offset - p[..., :2] @ floor.normal[:2]) / floor.normal[2]  # noqa: B023, E731
        y = incline(floor, x)
        np.testing.assert_allclose(lengths(y), np.tile(LENGTHS, (60, 1)), atol=1e-9)
        ankles, feet = [J["ankle_l"], J["ankle_r"]], [J["foot_l"], J["foot_r"]]
        np.testing.assert_allclose((y[..., 2] - height(y))[:, ankles], x[:, ankles, 2], atol=1e-9)
        np.testing.assert_allclose((y[..., 2] - height(y))[:, feet], x[:, feet, 2], atol=0.02)
        low = np.array([min(0.0, *(height(p[a]) - height(p[0]) for a in ankles)) for p in x])
        np.testing.assert_allclose(y[:, 0, 2], x[:, 0, 2] + height(x[:, 0]) + low, atol=1e-9)
        trunk = [j for j in range(N) if not JOINTS[j].startswith(("knee", "ankle", "foot"))]
        np.testing.assert_allclose((y - y[:, :1])[:, trunk], (x - x[:, :1])[:, trunk], atol=1e-9)
        for side in "lr":  # a knee is before the line from hip to ankle, as the toes are
            hip, knee, ankle, foot = (y[:, J[f"{n}_{side}"]] for n in ("hip", "knee", "ankle", "foot"))
            assert np.sum((knee - 0.5 * (hip + ankle)) * (foot - ankle), axis=1).min() > -1e-3
        np.testing.assert_allclose(incline(floor, y, down=True), x, atol=2e-3)
        state = State(y[40], (y[40] - y[39]) / STEP, quat[40], 0, (y[40] - y[39]) / STEP)
        level = level_state(floor, state)
        np.testing.assert_allclose(level.x, x[40], atol=2e-3)
        np.testing.assert_allclose(level.v, (x[40] - x[39]) / STEP, atol=0.05)
        np.testing.assert_array_equal(level.v, level.v_own)
        np.testing.assert_allclose(forward_kinematics(level.x[0], level.quat), level.x, atol=2e-2)
    np.testing.assert_allclose(incline(Plane(offset=0.3), x), x + [0, 0, 0.3], atol=2e-3)
    folded = np.zeros((N, 3))
    assert np.isfinite(incline(floor, folded)).all() and np.isfinite(incline(floor, -x, down=True)).all()


def test_a_prior_on_a_slope_is_the_prior_on_the_level():
    """Nearest transitions: from a state put on a slope, the level answer put on it; bones are exact."""
    from drop.prior import incline

    x, quat = motion("walk")
    floor = Plane([-0.27, 0.0, 1.0], 0.3)
    y = incline(floor, x[59:61])
    level, slope = prior(), NearestPrior([motion(), motion("stand"), motion("jog", speed=2.5)], floor=floor)
    wanted = level.mode(State(x[60], (x[60] - x[59]) / STEP, quat[60]))[0]
    got = slope.mode(State(y[1], (y[1] - y[0]) / STEP, quat[60]))[0]
    np.testing.assert_allclose(got, incline(floor, wanted), atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ got, axis=-1), LENGTHS, atol=1e-9)


def test_starting_under_the_floor():
    """`begin` lifts the body out; a body sunk later is pushed out without being thrown into the air."""
    x, quat = (a[30] for a in motion())
    sim = Simulator(prior())
    state = sim.begin(x - [0, 0, 0.7], quat)
    assert (state.x[:, 2] - RADII).min() > -2e-3
    np.testing.assert_allclose(state.x[:, :2], x[:, :2])
    sunk, top = State(x - [0, 0, 0.3], np.zeros((N, 3)), quat), 0.0
    doll = Simulator(None)
    for _ in range(60):
        sunk, _ = doll.step(sunk)
        top = max(top, sunk.com[2])
    assert np.isfinite(sunk.x).all() and top < 1.3 and (sunk.x[:, 2] - RADII).min() > -0.05


@settings(max_examples=15, deadline=None)
@given(
    joint=st.integers(0, N - 1), newton=st.floats(0, 1e4), way=st.tuples(*[st.floats(-1, 1)] * 3),
    tilt=st.floats(0, 80), doll=st.booleans(), seed=st.integers(0, 5),
)  # fmt: skip
def test_never_nan(joint, newton, way, tilt, doll, seed):
    """Forces to 10 kN, platforms to 80 degrees: always finite, bones always exact."""
    angle = np.radians(tilt)
    plane = Plane(np.array([np.sin(angle), 0.0, np.cos(angle)]), 0.0)
    sim, rng = Simulator(None if doll else prior(), obstacles=[plane]), np.random.default_rng(seed)
    state = state_of(sim, frame=60 + seed)
    force = np.zeros((N, 3))
    force[joint] = newton * np.array(way)
    for t in range(25):
        state, out = sim.step(state, force if t < 5 else None, rng=rng)
        assert np.isfinite(state.x).all() and np.isfinite(state.v).all() and np.isfinite(state.quat).all()
        assert np.isfinite(out.wrench) and np.isfinite(list(out.energies.values())).all()
    np.testing.assert_allclose(np.linalg.norm(DIFFERENCE @ state.x, axis=1), LENGTHS, rtol=1e-6)


def test_same_seed_same_motion():
    """Two runs with one seed agree to the last bit."""
    ends = []
    for _ in range(2):
        sim, rng = Simulator(NearestPrior([motion()])), np.random.default_rng(7)
        state = state_of(sim)
        for _ in range(20):
            state, _ = sim.step(state, rng=rng)
        ends.append(state.x)
    np.testing.assert_array_equal(*ends)

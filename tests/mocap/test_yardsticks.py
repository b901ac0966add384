"""The field's own units: each against a slow loop, or against SciPy."""

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from human import PARENTS, SEG, SEGMENTS, quat_about, quat_mul
from mocap import yardsticks
from mocap.data import load

ALL = tuple(range(len(SEGMENTS)))
SOME = tuple(SEG[s] for s in ("pelvis", "head", "foot_l", "forearm_l", "hand_l"))  # chest, thigh, … are not there


@pytest.fixture(scope="module")
def motions():
    """A walk, and the same with noise on joints and rotations: (pos, quat) twice."""
    clip, rng = load("builtin", clips="walk_005")[0][:40], np.random.default_rng(4)
    turn = Rotation.from_rotvec(0.3 * rng.standard_normal((40 * 15, 3))).as_quat(scalar_first=True).reshape(40, 15, 4)
    return (clip.pos + 0.1 * rng.standard_normal(clip.pos.shape), quat_mul(clip.quat, turn)), (clip.pos, clip.quat)


def rotation(q):
    return Rotation.from_quat(q, scalar_first=True)


def test_at_rate(motions):
    """Positions by SciPy's other spline, rotations by SciPy's Slerp; frames that were there stay; ends are ends."""
    pos, quat = motions[0]
    quat = quat * np.where(np.arange(40) % 3 == 1, -1.0, 1.0)[:, None, None]  # q and −q are one rotation
    for to in (60.0, 50.0):
        p, q = yardsticks.at_rate(pos, quat, 30.0, to)
        t = np.arange(len(p)) / to
        assert len(p) == len(q) == int(39 / 30 * to) + 1
        np.testing.assert_allclose(p, make_interp_spline(np.arange(40) / 30, pos, k=3)(t), atol=1e-9)
        for s in ALL:
            wanted = Slerp(np.arange(40) / 30, rotation(quat[:, s]))(np.minimum(t, 39 / 30))
            assert (wanted.inv() * rotation(q[:, s])).magnitude().max() < 1e-7
    np.testing.assert_allclose(yardsticks.at_rate(pos, quat, 30.0)[0][::2], pos, atol=1e-12)
    for few in (1, 2, 3):
        p, q = yardsticks.at_rate(pos[:few], quat[:few], 30.0)
        assert len(p) == len(q) == 2 * few - 1 and np.isfinite(p).all()
    t = np.arange(40)[:, None, None] / 30.0
    parabola = np.broadcast_to(2.0 * t**2, (40, 1, 3))  # no third derivative: a kink at a frame would show
    third = np.diff(yardsticks.at_rate(parabola, quat[:, :1], 30.0)[0], n=3, axis=0) * 60.0**3
    assert np.abs(third).max() < 1e-6


@pytest.mark.parametrize("segments", [ALL, SOME])
def test_positions(motions, segments):
    """MPJPE and its parts, one joint at a time, with the head put where the true one is."""
    (pos, _), (true, _) = motions
    p, t = pos[:, segments], true[:, segments]
    moved = yardsticks.head_moved(p, t, segments)
    slow = {k: [] for k in ("mpjpe", *yardsticks.PARTS)}
    for f in range(len(p)):
        for k, s in enumerate(segments):
            shift = true[f, SEG["head"]] - pos[f, SEG["head"]]
            off = 100 * np.sqrt(sum((pos[f, s, i] + shift[i] - true[f, s, i]) ** 2 for i in range(3)))
            slow["mpjpe"].append(off)
            name = SEGMENTS[s]
            legs = name == "pelvis" or name.startswith(("thigh", "shin", "foot"))
            slow["lower_pe" if legs else "upper_pe"].append(off)
            if name in ("pelvis", "hand_l", "hand_r"):
                slow["root_pe" if name == "pelvis" else "hand_pe"].append(off)
            assert moved[f, k] == pytest.approx(pos[f, s] + shift)
    np.testing.assert_allclose(yardsticks.mpjpe(moved, t).ravel(), slow["mpjpe"])
    for part in yardsticks.PARTS:
        np.testing.assert_allclose(yardsticks.part_error(moved, t, segments, part).ravel(), slow[part])
    assert moved[:, segments.index(SEG["head"])] == pytest.approx(t[:, segments.index(SEG["head"])])
    np.testing.assert_array_equal(yardsticks.head_moved(pos[:, :1], true[:, :1], (0,)), pos[:, :1])  # no head


def test_velocities(motions):
    (pos, _), (true, _) = motions
    found = yardsticks.mpjve(pos, true, 30.0)
    assert found.shape == (39, 15)
    for f in range(39):
        for s in ALL:
            v, w = (pos[f + 1, s] - pos[f, s]) * 30.0, (true[f + 1, s] - true[f, s]) * 30.0
            assert found[f, s] == pytest.approx(100 * np.hypot(np.hypot(*(v - w)[:2]), (v - w)[2]))
    assert not yardsticks.mpjve(pos + [1.0, 2.0, 3.0], pos, 30.0).max() > 1e-9  # a constant error has no speed
    assert yardsticks.mpjve(pos[:1], true[:1]).shape == (0, 15)


@pytest.mark.parametrize("segments", [ALL, SOME])
def test_rotations(motions, segments):
    """MPJRE through SciPy's rotations, relative to the nearest segment above that is there."""
    (_, quat), (_, true) = motions
    found = yardsticks.mpjre(quat[:, segments], true[:, segments], segments)
    columns = [s for s in segments if s != SEG["pelvis"]]
    assert found.shape == (40, len(columns), 3)
    for k, s in enumerate(columns):
        above = PARENTS[s]
        while above not in segments:
            above = PARENTS[above]
        vectors = [(rotation(q[:, above]).inv() * rotation(q[:, s])).as_rotvec() for q in (quat, true)]
        apart = vectors[0] - vectors[1]
        apart = (apart + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(found[:, k], np.degrees(np.abs(apart)), atol=1e-6)
    assert yardsticks.mpjre(-quat, quat, ALL).max() < 1e-6  # q and −q are one rotation
    # no angle between rotations: 10 degrees about one axis is 10 in one of three numbers; across a half turn it is the
    # rest of the turn
    straight = np.tile([1.0, 0, 0, 0], (1, 2, 1))
    for a, b, wanted in ((0.0, 10.0, 10.0), (175.0, -175.0, 10.0)):
        one, two = straight.copy(), straight.copy()
        one[:, 1], two[:, 1] = quat_about(2, np.radians(a)), quat_about(2, np.radians(b))
        assert yardsticks.mpjre(one, two, (0, 1))[0, 0] == pytest.approx([0.0, 0.0, wanted], abs=1e-6)
    assert yardsticks.mpjre(quat[:, :1], true[:, :1], (0,)).shape == (40, 0, 3)


def test_successes(motions):
    """Each limit on both sides of it, on one frame only."""
    _, (true, quat) = motions
    pos = true.copy()
    pos[7, :, 0] += 0.499
    assert yardsticks.success_phc(true, true) and yardsticks.success_phc(pos, true)
    pos[7, 3, 0] += 15 * 0.002  # the mean passes half a metre
    assert not yardsticks.success_phc(pos, true)

    held = {"pelvis", "foot_l", "foot_r", "hand_l", "hand_r"}
    for s, name in enumerate(SEGMENTS):
        for rise, fine in ((0.249, True), (-0.251, name not in held)):
            pos = true.copy()
            pos[5, s, 2] += rise
            assert yardsticks.success_height(pos, quat, true, quat, ALL) == fine, (name, rise)
    pos = true + [3.0, -2.0, 0.0]  # heights alone count
    for s in (0, 4):
        for angle, fine in ((0.99, True), (1.01, s != 0)):
            turned = quat.copy()
            turned[9, s] = quat_mul(quat_about(1, angle), turned[9, s])
            assert yardsticks.success_height(pos, turned, true, quat, ALL) == fine, (s, angle)
            assert yardsticks.success_height(pos, -turned, true, quat, ALL) == fine

"""skeletal/data.py: any BVH in and out, families, inverse kinematics, truth, feet, errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_skeletal_train import BODY, NAMES, OFFSETS, PARENTS, walk

from human import quat_about, quat_conj, quat_mul, quat_rotate
from mocap import bvh
from mocap import data as motion
from plumbing.cli import UserError
from skeletal import data


def random_quats(n, seed=0):
    return Rotation.random(n, rng=np.random.default_rng(seed)).as_quat(scalar_first=True)


def write_rig(path, m, frames=None, unit=100.0, seed=0):
    """A motion as a y-up BVH whose joints' frames are turned at random (frames): a rest pose that says nothing."""
    J = len(m.skeleton.names)
    F = random_quats(J, seed) if frames is None else frames
    p, g = data.pose(m)
    turn = np.array([0.5, -0.5, -0.5, -0.5])  # z up -> y up: file x = ours y, file y = ours z, file z = ours x
    world = quat_mul(turn, quat_mul(g, F))
    local = data.locals_of(world, m.skeleton.parents)
    offsets = np.zeros((J, 3))
    for j in range(1, J):
        offsets[j] = unit * quat_rotate(quat_conj(F[m.skeleton.parents[j]]), m.skeleton.offsets[j])
    names, parents = list(m.skeleton.names), list(m.skeleton.parents)
    pos = unit * m.pos[:, [1, 2, 0]]
    bvh.write(path, names, np.array(parents), offsets, 1 / data.RATE, pos, local)
    return F


def test_pose_and_features_agree():
    """features and from_features are inverse; pose is Rotation's; reversed motion is the same poses backwards."""
    m = walk(40)
    p, g = data.pose(m)
    R, q = [Rotation.from_quat(m.quat[7, 0], scalar_first=True)], [m.pos[7]]
    for j in range(1, len(NAMES)):
        q.append(q[PARENTS[j]] + R[PARENTS[j]].apply(OFFSETS[j]))
        R.append(R[PARENTS[j]] * Rotation.from_quat(m.quat[7, j], scalar_first=True))
    np.testing.assert_allclose(p[7], q, atol=1e-12)
    x, turn = data.features(m)
    back = data.from_features(x, turn, m.skeleton, start=m.pos[0, :2])
    np.testing.assert_allclose(data.pose(back)[0], p, atol=1e-5)
    spin = quat_about(2, 1.0)
    turned = replace(m, pos=quat_rotate(spin, m.pos) + [3, 4, 0], quat=m.quat.copy())
    turned.quat[:, 0] = quat_mul(spin, m.quat[:, 0])
    np.testing.assert_allclose(data.features(turned)[0], x, atol=1e-5)  # neither place nor compass is seen
    np.testing.assert_allclose(data.pose(data.reverse(m))[0], p[::-1])


def test_any_bvh(tmp_path):
    """Frames at random, y up, centimetres: what is read moves as what was written; so does what is written again."""
    m = walk(60)
    F = write_rig(tmp_path / "a.bvh", m)
    write_rig(tmp_path / "b.bvh", walk(60, seed=1), F)
    s, motions = data.folder(tmp_path)
    assert s.names == NAMES and s.parents == PARENTS and s.feet == (6, 10) and s.unit == 0.01
    np.testing.assert_allclose(data.pose(motions[0])[0], data.pose(m)[0], atol=1e-6)
    assert motions[0].skeleton.leg == pytest.approx(BODY.leg, rel=1e-6)
    data.write_motion(tmp_path / "c.bvh", motions[0], s)
    a, c = (bvh.global_pose(bvh.read(tmp_path / f"{n}.bvh")) for n in "ac")
    np.testing.assert_allclose(a[0], c[0], atol=1e-4)
    np.testing.assert_allclose(np.abs(np.sum(a[1] * c[1], axis=-1)), 1.0, atol=1e-7)
    raw = data.read_rig(tmp_path / "a.bvh", drop=("toe*",))
    assert raw.names == tuple(n for n in NAMES if "toe" not in n)
    with pytest.raises(UserError, match="lacks toe_l, toe_r"):
        data.to_motion(raw, s)
    with pytest.raises(UserError, match="0 bones are left"):
        data.read_rig(tmp_path / "a.bvh", drop=("*",))
    with pytest.raises(UserError, match="no .bvh file"):
        data.folder(tmp_path, clips="nothing*")
    other = data.derive(BODY)
    write_rig(tmp_path / "d.bvh", walk(60, other))
    with pytest.raises(UserError, match="another skeleton.*one rig a folder"):
        data.folder(tmp_path)


def test_rest_poses_do_not_matter(tmp_path):
    """Two rigs of one body whose rest poses differ become the same skeleton and the same features."""
    out = []
    for k in range(2):
        (tmp_path / str(k)).mkdir()
        for i in range(3):
            write_rig(tmp_path / str(k) / f"{i}.bvh", walk(60, seed=i), random_quats(len(NAMES), k))
        out.append(data.folder(tmp_path / str(k))[1][0])
    np.testing.assert_allclose(out[0].skeleton.offsets, out[1].skeleton.offsets, atol=1e-6)
    np.testing.assert_allclose(data.features(out[0])[0], data.features(out[1])[0], atol=1e-4)


def test_bandai_rig(mocap_dir):
    """A dummy above the root, six channels a joint: 21 joints, feet found, forward where the rig says."""
    s, motions = data.folder(mocap_dir / "bandai", clips="dataset-2_walk_normal_00[1-3]")
    m = motions[0]
    assert len(s.names) == 21 and s.names[0] == "Hips" and [s.names[f] for f in s.feet] == ["Toes_L", "Toes_R"]
    raw = bvh.global_pose(bvh.read(mocap_dir / "bandai" / "dataset-2_walk_normal_001.bvh"))[0][:, 1:]
    np.testing.assert_allclose(data.pose(m)[0], raw[..., [2, 0, 1]] * 0.01, atol=1e-4)
    x, _ = data.features(m)
    assert x[:, 0].mean() > 5 * abs(x[:, 1].mean())  # people walk forward


def test_families():
    """Derived by the graph alone; left as right; the primal skeleton is the same."""
    human = data.human_motion(motion.load("builtin", clips="walk_005")[0])
    for a in (human.skeleton, BODY):
        b = data.derive(a)
        assert any(n.endswith(".half") for n in b.names)
        rest = dict(zip(b.names, b.rest()))
        for n, p in zip(a.names, a.rest()):
            if n in rest:
                np.testing.assert_allclose(rest[n], p, atol=1e-12)  # the same body, cut otherwise
        order = data.aligned(b, a)
        assert order.tolist() == list(range(len(b.names)))
        c = data.proportions(b, np.random.default_rng(0))
        ratio = np.linalg.norm(c.offsets[1:], axis=1) / np.linalg.norm(b.offsets[1:], axis=1)
        assert 0.7 <= ratio.min() < 0.9 and 1.1 < ratio.max() <= 1.3
        by = dict(zip(b.names[1:], ratio))
        assert all(by[n] == pytest.approx(by[n[:-2] + "_r"]) for n in by if n.endswith("_l"))


def test_stubs_are_merged():
    """A collar bone, short inside a chain of four, goes; the shoulder stays where it was."""
    names = ("hips", "chest", "collar", "arm", "elbow", "hand", "head", "leg", "foot")
    offsets = np.array([[0, 0, 0], [0, 0, 0.5], [0, 0.1, 0], [0, 0.05, 0], [0, 0.3, 0], [0, 0.3, 0], [0, 0, 0.2],
                        [0, 0, -0.5], [0, 0, -0.5]])  # fmt: skip
    a = data.Skeleton(names, (-1, 0, 1, 2, 3, 4, 1, 0, 7), offsets, (8,))
    b = data.derive(a)
    assert "collar" not in b.names and b.parents[b.names.index("arm")] == b.names.index("chest")
    np.testing.assert_allclose(b.rest()[b.names.index("hand")], a.rest()[5])


def test_copy_rotations():
    """On the same bones a copy is exact; orientation-keeping copies make up for what is lost."""
    m, b = walk(30), data.derive(BODY)
    p = data.pose(m)[0]
    for how in ("names", "global"):
        np.testing.assert_allclose(data.pose(data.copy_rotations(m, BODY, how))[0], p, atol=1e-12)
    g = data.pose(m)[1]
    np.testing.assert_allclose(
        data.locals_of(g, PARENTS),
        m.quat * np.sign(np.sum(data.locals_of(g, PARENTS) * m.quat, -1))[..., None],
        atol=1e-12,
    )  # noqa: E501
    copy = data.copy_rotations(m, b, "global")
    np.testing.assert_allclose(data.pose(copy)[0][:, [b.names.index(n) for n in NAMES]], p, atol=1e-12)
    spread = data.copy_rotations(m, b, "spread")
    half, thigh = b.names.index("shin_l.half"), b.names.index("thigh_l")
    turn = data.locals_of(data.pose(copy)[1], b.parents)[:, b.names.index("shin_l")]
    angle = lambda q: 2 * np.arccos(np.clip(np.abs(q[..., 0]), 0, 1))  # noqa: E731
    np.testing.assert_allclose(angle(spread.quat[:, half]), 0.5 * angle(turn), atol=1e-6)
    np.testing.assert_allclose(data.pose(spread)[1][:, thigh], data.pose(copy)[1][:, thigh], atol=1e-9)


def test_ik_reaches():
    """Damped least squares: goals within reach are reached, others approached, the rest stays."""
    m = walk(20)
    p = data.pose(m)[0]
    goal = p[:, 5] + [0.05, 0.03, 0.04]
    out = data.solve_ik(m, [(5, goal, [3, 4], [1, 1])], 30)
    q = data.pose(out)[0]
    np.testing.assert_allclose(q[:, 5], goal, atol=1e-3)
    np.testing.assert_allclose(q[:, :4], p[:, :4], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(q[:, 5] - q[:, 4], axis=1), np.linalg.norm(OFFSETS[5]))
    far = data.solve_ik(m, [(5, p[:, 3] + [0, 0, -9.0], [3, 4], [1, 1])], 40)
    straight = np.linalg.norm(data.pose(far)[0][:, 5] - p[:, 3], axis=1)
    assert straight.min() > 0.98 * (np.linalg.norm(OFFSETS[4]) + np.linalg.norm(OFFSETS[5]))


def test_truth_keeps_ends_and_contacts():
    """[GAP] Ends keep their place in units of the limb, so a standing foot keeps standing."""
    m = data.human_motion(motion.load("builtin", clips="walk_005")[0])[:60]
    for structure in (m.skeleton, data.derive(m.skeleton)):
        c = data.proportions(structure, np.random.default_rng(3))
        t = data.truth(m, c)
        copy = data.copy_rotations(m, c)
        p, q, r = (data.pose(x)[0] for x in (m, t, copy))
        for f_s, f_t in zip(m.skeleton.feet, c.feet):
            wanted = p[:, f_s] * (c.reach([f_t])[0] / m.skeleton.reach([f_s])[0])
            off = np.linalg.norm(q[:, f_t] - wanted, axis=1)
            assert np.median(off) < 0.02 and np.median(off) < 0.5 * np.median(
                np.linalg.norm(r[:, f_t] - wanted, axis=1)
            )
        hand_s, hand_t = m.skeleton.names.index("hand_l"), c.names.index("hand_l")
        arm_s, arm_t = m.skeleton.names.index("upper_arm_l"), c.names.index("upper_arm_l")
        long_s, long_t = (
            sum(np.linalg.norm(s.offsets[s.names.index(n)]) for n in ("forearm_l", "hand_l")) for s in (m.skeleton, c)
        )
        wanted = (p[:, hand_s] - p[:, arm_s]) * long_t / long_s
        assert np.median(np.linalg.norm(q[:, hand_t] - q[:, arm_t] - wanted, axis=1)) < 0.01
        assert data.error(copy, t) > 1e-5  # and is no copy


def test_truth_where_legs_begin_further_out():
    """Legs that hang from a pelvis below the root: feet still stand where they stood, in the root's ratio."""
    names, parents = ("root", "pelvis", "head", *NAMES[3:]), (-1, 0, 0, 1, 3, 4, 5, 1, 7, 8, 9)
    offsets = OFFSETS + 0.0
    offsets[1:3] = [0, 0, -0.15], [0, 0, 0.5]
    s = data.Skeleton(names, parents, offsets, (6, 10))
    c = replace(s, offsets=offsets * np.where(np.arange(11) == 1, 1.3, 0.8)[:, None])
    m = walk(40, s)
    t = data.truth(m, c)
    p, q = data.pose(m)[0], data.pose(t)[0]
    assert s.reach()[1] == pytest.approx(0.15 + 0.1 + sum(np.linalg.norm(v) for v in offsets[4:7]))
    assert s.height == pytest.approx(0.15 + 0.88 + 0.5) and s.leg == pytest.approx(s.reach([6])[0])
    for f in s.feet:
        wanted = (p[:, f] - p[:, 0]) * c.leg / s.leg
        assert np.median(np.linalg.norm(q[:, f] - q[:, 0] - wanted, axis=1)) < 0.01


def test_foot_cleanup():
    """Standing feet stop sliding, flying feet and the rest of the body stay."""
    m = data.human_motion(motion.load("builtin", clips="walk_005")[0])[:90]
    standing = data.contacts(m)
    assert 0.3 < standing.mean() < 0.9
    drift = replace(m, pos=m.pos + np.linspace(0, 0.25, 90)[:, None] * [1.0, 0.5, 0.0])
    before, clean = data.sliding(drift, standing), data.clean_feet(drift, standing)
    assert before > 0.06 and data.sliding(clean, standing) < 0.3 * before
    p, q = data.pose(drift)[0], data.pose(clean)[0]
    upper = [m.skeleton.names.index(n) for n in ("chest", "head", "hand_l")]
    np.testing.assert_allclose(q[:, upper], p[:, upper], atol=1e-9)
    assert np.abs(np.diff(q, 2, axis=0)).max() < 3 * np.abs(np.diff(p, 2, axis=0)).max()  # blended: no jumps
    nobody = np.zeros_like(standing)
    np.testing.assert_allclose(data.pose(data.clean_feet(drift, nobody))[0], p, atol=1e-9)
    assert data.sliding(m, nobody) == 0.0


def test_stand_heights():
    """Counted frame by frame: a tenth of the standing frames is lower; a foot that never stands has its lowest."""
    m = data.human_motion(motion.load("builtin", clips="walk_005")[0])[:90]
    standing = data.contacts(m)
    standing[:, 1] = False
    p = data.pose(m)[0]
    left = sorted(p[t, m.skeleton.feet[0], 2] / m.skeleton.leg for t in range(90) if standing[t, 0])
    k = (len(left) - 1) // 10
    got = data.stand_heights(m, standing)
    assert left[k] <= got[0] <= left[k + 1] and 0.0 < got[0] < 0.1
    assert got[1] == pytest.approx(p[:, m.skeleton.feet[1], 2].min() / m.skeleton.leg)
    assert not data.contacts(m[:1]).any()  # one frame has no speed


def test_feet_come_to_the_floor():
    """A body that floats ever higher comes down, each standing foot is where it should be; who never stands is left."""
    m = data.human_motion(motion.load("builtin", clips="walk_005")[0])[:90]
    standing, feet = data.contacts(m), list(m.skeleton.feet)
    wanted = data.pose(m)[0][:, feet, 2]
    rise = np.linspace(0.03, 0.15, 90)
    high = replace(m, pos=m.pos + [0.0, 0.0, 1.0] * rise[:, None])
    clean = data.clean_feet(high, standing, wanted)
    np.testing.assert_allclose(clean.pos[:, 2], m.pos[:, 2], atol=0.01)
    assert np.abs(np.diff(clean.pos[:, 2] - m.pos[:, 2], 2)).max() < 1e-3  # smoothly
    off = lambda r: np.abs((data.pose(r)[0][:, feet, 2] - wanted)[standing]).mean()  # noqa: E731
    assert off(clean) < 0.01 and off(data.clean_feet(high, standing)) > 0.08
    nobody = np.zeros_like(standing)
    np.testing.assert_array_equal(data.clean_feet(high, nobody, wanted).pos, high.pos)


def test_stances_are_blended():
    """A foot that leaves the floor for a frame and lands elsewhere does not jump: no step is larger than before."""
    m = data.human_motion(motion.load("builtin", clips="walk_005")[0])[:60]
    still = replace(m, pos=np.repeat(m.pos[:1], 60, 0), quat=np.repeat(m.quat[:1], 60, 0))
    still = replace(still, pos=still.pos + 0.3 / 59 * np.arange(60)[:, None] * [1.0, 0.0, 0.0])  # it slides
    standing = np.zeros((60, 2), bool)
    standing[:29, 0] = standing[30:, 0] = True
    x = data.pose(data.clean_feet(still, standing))[0][:, m.skeleton.feet[0], 0]
    steps = np.abs(np.diff(x))
    assert steps[:27].max() < 0.002 and steps[31:].max() < 0.002  # it stands, and stands elsewhere
    away = np.abs(x[30] - x[28])
    assert away > 0.1 and steps.max() < 0.6 * away  # half of the way in each of the two steps between


def test_foot_cleanup_without_toes():
    """A leg of thigh, shin and ankle alone: both of its joints help, and the ankle stays where it stood."""
    m = data.human_motion(motion.load("builtin", clips="walk_005")[0])[:90]
    s, kept = m.skeleton, [i for i, n in enumerate(m.skeleton.names) if not n.startswith("ball")]
    parents = tuple(kept.index(p) if p >= 0 else -1 for p in np.array(s.parents)[kept])
    names = tuple(s.names[i] for i in kept)
    feet = tuple(names.index(n) for n in ("foot_l", "foot_r"))
    bare = data.Skeleton(names, parents, s.offsets[kept], feet)
    stand = data.contacts(m)
    pos = m.pos + np.linspace(0, 0.25, 90)[:, None] * [1.0, 0.5, 0.0]
    drift = replace(m, skeleton=bare, quat=m.quat[:, kept], pos=pos)
    clean = data.clean_feet(drift, stand)
    assert data.sliding(drift, stand) > 0.06 and data.sliding(clean, stand) < 0.3 * data.sliding(drift, stand)
    turned = [
        np.abs(clean.quat[:, names.index(n)] - drift.quat[:, names.index(n)]).max() for n in ("thigh_l", "shin_l")
    ]
    assert min(turned) > 1e-3
    np.testing.assert_allclose(data.pose(clean)[1][:, feet], data.pose(drift)[1][:, feet], atol=1e-9)  # orientation


def test_error():
    """By a slow loop; where the clip starts does not count; relative to the root travel does not either."""
    m = walk(10)
    other = replace(m, pos=m.pos + np.array([5.0, 2.0, 0.0]) + np.arange(10)[:, None] * [0.01, 0.0, 0.0])
    p, q = data.pose(other)[0] - [5.0, 2.0, 0.0], data.pose(m)[0]
    h = np.ptp(m.skeleton.rest()[:, 2])
    slow = np.mean(
        [((p[t, j, c] - q[t, j, c]) / h) ** 2 for t in range(10) for j in range(len(NAMES)) for c in range(3)]
    )
    assert data.error(other, m) == pytest.approx(slow) and data.error(other, m, root=False) == pytest.approx(
        0.0, abs=1e-20
    )

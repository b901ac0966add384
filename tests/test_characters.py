"""Tests of character.py and of the characters: files against each other, tables against the paper, variations."""

import dataclasses
import re
import shutil
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_retarget import MINI_TOML, MINI_XML, clip_of, posed, random_states

import character
import metrics
import retarget
from character import CHARACTERS
from characters import check
from env import Env
from plumbing.cli import UserError, arg, cli, run_main

NAMES = ("jesse", "oppy", "dino")
TABLE2 = {  # [Reda23 App. A]: w, k; a weight of 0 is printed without a k
    "oppy": dict(q=(1, 20), qd=(0,), x=(1, 6), xd=(0,), contact=(1.5, 1), orientation=(1, 3), action_diff=(2, 150),
                 action_min=(0.2, 25)),
    "jesse": dict(q=(4, 25), qd=(0.5, 1), x=(2.5, 6), xd=(0.7, 2), contact=(0,), orientation=(2, 3),
                  action_diff=(1.5, 10), action_min=(0.5, 25)),
}  # fmt: skip
TABLE2["dino"] = TABLE2["oppy"]
TABLE4 = {"shoulder": 0.2, "elbow": 0.1, "head": 0.1, "neck": 0.1}  # [Reda23 App. D], the same for all three
SPINE = {"oppy": 1.0, "dino": 1.0, "jesse": 0.25}
LOWER = ("hip", "knee", "ankle")


@pytest.fixture(scope="module")
def chars():
    return {n: character.load(n) for n in NAMES}


@pytest.fixture(scope="module")
def mini(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mini")
    (folder / "mini.xml").write_text(MINI_XML)
    (folder / "mini.toml").write_text(MINI_TOML)
    return character.load(folder / "mini.toml")


@pytest.fixture
def rng():
    return np.random.default_rng(20230)


# ----------------------------------------------------------------------------------------- tables


@pytest.mark.parametrize("name", NAMES)
def test_tables(chars, name):
    """What the paper prints, digit by digit, and that it arrives in what is simulated and rewarded."""
    c = chars[name]
    for term, wanted in TABLE2[name].items():
        assert c.reward[term][: len(wanted)] == wanted, term
    assert c.reward["fail"] == -5
    group = [n.split("_")[0] for n in c.hinges]
    table4 = TABLE4 | {f"spine{i}": SPINE[name] for i in range(4)}
    table4 |= {"tail0": 0.5, "tail1": 0.4} if name == "dino" else {}
    assert {k.lower(): v for k, v in c.spec["torque"]["scale"].items()} == table4
    base = c.spec["torque"]["base"]
    for h, limit in zip(c.driven, c.limits, strict=True):
        assert limit == pytest.approx(base["default"] * table4.get(group[h], 1.0)), c.hinges[h]
    assert base == {"default": pytest.approx(10 / 3 * c.model.body_mass.sum(), rel=3e-3)}  # N m per kg
    # Eq. 11: lower body 0.3 (Jesse 1); tails and ears not at all
    low = 1.0 if name == "jesse" else 0.3
    wanted = np.array([0.0 if g[:3] in ("tai", "ear") else low if g in LOWER else 1.0 for g in group])
    np.testing.assert_allclose(c.joint_weights, wanted / wanted.sum())
    links = {c.model.body(b).name: w for b, w in zip(c.reward_links, c.link_weights, strict=True)}
    if name == "jesse":  # root and end effectors
        assert links == {b: pytest.approx(1 / 6) for b in ("pelvis", "head", "hand_l", "hand_r", "foot_l", "foot_r")}
    else:
        assert links == {"pelvis": 1.0}
    passive = {n.split("_")[0] for n in c.hinges} - {group[h] for h in c.driven}
    ears = {"ear", "tail0", "tail1", "tail2", "tail3"}
    assert passive == {"jesse": set(), "oppy": ears, "dino": {f"tail{i}" for i in range(2, 8)}}[name]
    # the exploration noise that a k of 150 leaves alive (e^(-2 k s^2), spec 3.7)
    if c.training:
        assert np.exp(-2 * c.reward["action_diff"][1] * c.training["min_sigma"] ** 2) > 0.8


def test_weights_and_groups(mini):
    """Weights that differ, and hinges without human motion: leg_l_y .3, leg_r_y .3, head_y 1, head_z 2, tail_y none."""
    weights = dict(zip(mini.hinges, mini.joint_weights, strict=True))
    assert weights["tail_y"] == 0.0
    np.testing.assert_allclose([weights[n] * 3.6 for n in ("leg_l_y", "head_y", "head_z")], [0.3, 1.0, 2.0])
    np.testing.assert_allclose(mini.link_weights, [0.75, 0.25])
    np.testing.assert_array_equal(character.normalised([0.0, 0.0]), [0.0, 0.0])
    names = ("hip_l_y", "spine0_y", "left_hip_y", "right_knee", "R_Elbow_y", "leftover_x")
    assert [character.joint_group(n) for n in names] == ["hip", "spine0", "hip", "knee", "elbow", "leftover"]
    assert [character.numberless(n) for n in ("hip_l_y", "spine0_y", "tail12")] == ["hip_l_y", "spine_y", "tail"]
    assert [mini.hinges[h] for h in mini.driven] == ["leg_l_y", "leg_r_y", "head_y", "head_z"]  # in the motors' order
    np.testing.assert_allclose(mini.limits, [20, 20, 2, 2])


@pytest.mark.parametrize("which", [*NAMES, "mini"])
def test_torques_and_springs_in_the_model(which, rng, mini, chars):
    """Motors turn control -1..1 into -limit..limit; springs pull to the default pose."""
    c = mini if which == "mini" else chars[which]
    m, spec = c.model, c.spec["passive"]
    qpos, qvel = (x[0] for x in random_states(c, rng, 1))
    d = posed(m, qpos, qvel)
    q, v = qpos[7:][c.driven], qvel[6:][c.driven]
    table = spec["stiffness"]
    groups = [c.hinges[h].split("_")[0] for h in c.driven]
    k = np.array([table.get(g, table.get(g.rstrip("0123"), table.get("default"))) for g in groups])
    want = -k * (q - m.qpos_spring[7:][c.driven]) - spec["damping"] * k * v
    np.testing.assert_allclose(d.qfrc_passive[6:][c.driven], want, rtol=1e-9, atol=1e-9)
    for ctrl, force in ((1.0, 1.0), (-0.5, -0.5)):
        d.ctrl[:] = ctrl
        mujoco.mj_forward(m, d)
        np.testing.assert_allclose(d.qfrc_actuator[6:][c.driven], force * c.limits, rtol=1e-12)
    if which == "mini":  # the tail keeps the MJCF's stiffness; its spring pulls to the default pose
        k = c.hinges.index("tail_y")
        assert d.qfrc_passive[6 + k] == pytest.approx(-3.0 * (qpos[7 + k] - 0.7))


@pytest.mark.parametrize("name", NAMES)
def test_springs_hold_the_default_pose(chars, name):
    """A spring in `hold` cancels the weight in the default pose; the others rest there."""
    c = chars[name]
    held = [h for h in c.driven if {c.hinges[h].split("_")[0], character.numberless(c.hinges[h].split("_")[0])}
            & set(c.spec["passive"].get("hold", ()))]  # fmt: skip
    assert bool(held) == (name == "dino")
    d = posed(c.model, np.concatenate([[0, 0, 2, 1, 0, 0, 0], c.default]), np.zeros(c.model.nv))
    force = d.qfrc_passive - d.qfrc_bias
    assert not held or np.abs(d.qfrc_bias[6:][held]).max() > 50
    np.testing.assert_allclose(force[6:][held], 0.0, atol=1e-9)
    rest = np.setdiff1d(np.arange(c.j), held)
    np.testing.assert_array_equal(c.model.qpos_spring[7:][rest], c.default[rest])


@pytest.mark.parametrize("name", NAMES)
def test_parts_are_what_they_are_called(chars, name):
    """Armature; links, sites, limbs, and what may touch the floor; left is left, of hands and of contact sensors."""
    c = chars[name]
    m, d, armature = c.model, mujoco.MjData(c.model), c.spec["passive"]["armature"]
    bodies = lambda ids: [m.body(b).name for b in ids]  # noqa: E731
    kinds = lambda names: {n.split("_")[0].rstrip("0123456789") for n in names}  # noqa: E731
    for h in c.driven:
        group = character.joint_group(c.hinges[h])
        assert m.dof_armature[6 + h] == armature.get(group, armature.get(character.numberless(group))), c.hinges[h]
    assert bodies(c.obs_links) == ["pelvis", "spine3", "head", "hand_l", "hand_r", "foot_l", "foot_r"]
    assert bodies(m.site_bodyid[c.sensor_sites]) == ["head", "hand_l", "hand_r"]
    assert set(bodies(metrics.sip_bodies(c))) == {f"{part}_{s}" for part in ("upper_arm", "thigh") for s in "lr"}
    fall = set(bodies(m.geom_bodyid[c.fall_geoms]))
    others = set(bodies(b for b, a in zip(m.geom_bodyid, m.geom_conaffinity, strict=True) if a and b)) - fall
    low = {"thigh", "shin", "foot", "tail", "ear"}
    assert kinds(others) <= low and not kinds(fall) & low
    for foot, lean in enumerate((-0.15, 0.15)):  # to the left, to the right: that foot alone is on the floor
        mujoco.mj_resetData(m, d)
        d.qpos[2], d.qpos[7:] = c.hip_height, c.default
        d.qpos[3:7] = Rotation.from_rotvec([lean, 0, 0]).as_quat(scalar_first=True)
        mujoco.mj_kinematics(m, d)
        d.qpos[2] -= character.geom_lowest(m, c.sole_geoms[foot], d.geom_xpos[None], d.geom_xmat[None]).min() + 2e-3
        mujoco.mj_forward(m, d)
        assert list(np.abs(d.sensordata[c.contact_adr]) > 1.0) == [foot == 0, foot == 1]
        _, left, right = d.site_xpos[c.sensor_sites]
        assert left[1] > right[1] + 0.1


def test_hold_names_driven_joints():
    with pytest.raises(UserError, match=r"\[passive\] names driven joint 'wing'; there are: .*tail0"):
        character.load("dino", set=("passive.hold=['wing']",))


@pytest.mark.parametrize("name", NAMES)
def test_joint_ranges_are_radians(chars, name):
    tree, c = ET.parse(CHARACTERS / f"{name}.xml"), chars[name]
    assert tree.find("compiler").get("angle") == "radian"
    for joint in tree.iter("joint"):
        if joint.get("name"):
            low, high = map(float, joint.get("range").split())
            np.testing.assert_array_equal(c.ranges[c.hinges.index(joint.get("name"))], [low, high])
            assert -np.pi < low <= 0 <= high < np.pi and high - low > np.radians(20)


@pytest.mark.parametrize("name", NAMES)
def test_shapes_to_look_at_change_nothing(chars, name, rng):
    c = chars[name]
    shown, m = c.mjspec().compile(), c.model
    assert np.all(m.geom_contype | m.geom_conaffinity)
    assert shown.ngeom > 2 * m.ngeom and np.sum(shown.geom_contype | shown.geom_conaffinity) == m.ngeom
    for field in ("body_mass", "body_inertia", "body_ipos", "jnt_range"):
        np.testing.assert_allclose(getattr(shown, field), getattr(m, field), atol=1e-12, err_msg=field)
    for field in ("jnt_stiffness", "dof_damping", "dof_armature", "actuator_gear", "qpos_spring"):
        getattr(shown, field)[:] = getattr(m, field)
    mujoco.mj_setConst(shown, mujoco.MjData(shown))
    a, b = mujoco.MjData(m), mujoco.MjData(shown)
    for _ in range(20):
        a.ctrl[:] = b.ctrl[:] = rng.uniform(-1, 1, m.nu)
        mujoco.mj_step(m, a), mujoco.mj_step(shown, b)
    np.testing.assert_allclose(a.qpos, b.qpos, atol=1e-9)


# ----------------------------------------------------------------------------------------- bodies


def mirror(c, qpos, qvel):
    """The same state seen in a mirror, y -> -y: left and right change places, turns about x and z change sign."""
    m = c.model
    q, v = qpos.copy(), qvel.copy()
    q[[1, 4, 6]] *= -1  # y; x and z of the root's quaternion
    v[[1, 3, 5]] *= -1
    for h, name in enumerate(c.hinges):
        other = c.hinges.index(re.sub("_([lr])_", lambda s: "_r_" if s[1] == "l" else "_l_", name))
        sign = 1.0 if abs(m.jnt_axis[1 + h][1]) > 0.5 else -1.0
        q[7 + other], v[6 + other] = sign * qpos[7 + h], sign * qvel[6 + h]
    return q, v


@pytest.mark.parametrize("name", NAMES)
def test_left_is_right_in_a_mirror(chars, name, rng):
    """Masses, shapes, springs, ranges and motors at once: a mirrored state accelerates as the mirror image, on the
    floor and in the air."""
    c = chars[name]
    m = c.model
    for low in (0.7, 1.5):
        qpos, qvel = random_states(c, rng, 1)
        qpos, qvel = qpos[0], qvel[0]
        qpos[2] = low * c.hip_height
        qpos[3:7] = Rotation.from_euler("zyx", [0.3, 0.1, -0.2]).as_quat(scalar_first=True)
        qpos[7:] = c.default + 0.2 * (qpos[7:] - c.default)
        a = posed(m, qpos, qvel)
        b = posed(m, *mirror(c, qpos, qvel))
        assert (a.ncon > 0) == (low < 1) and a.ncon == b.ncon
        drive = rng.uniform(-1, 1, m.nu)
        forces = np.zeros(m.nv)
        forces[6 + c.driven] = drive
        _, mirrored = mirror(c, np.zeros(m.nq), forces)
        a.ctrl[:], b.ctrl[:] = drive, mirrored[6 + c.driven]
        mujoco.mj_fwdActuation(m, a), mujoco.mj_fwdActuation(m, b)
        smooth = lambda d: d.qfrc_passive + d.qfrc_actuator - d.qfrc_bias  # noqa: E731
        for get, tol in ((smooth, 1e-9), (lambda d: d.qacc_smooth, 1e-6)):
            _, want = mirror(c, np.zeros(m.nq), get(a))
            np.testing.assert_allclose(get(b), want, rtol=1e-6, atol=tol * max(1.0, np.abs(want).max()))
        # the solver goes through the contacts in another order
        _, want = mirror(c, np.zeros(m.nq), a.qfrc_constraint)
        np.testing.assert_allclose(b.qfrc_constraint, want, atol=0.05 * max(1.0, np.abs(want).max()))


@pytest.mark.parametrize("name", NAMES)
def test_solvers(name):
    """As loaded, exactly: more of Newton's iterations change nothing; PGS after five is near, not there."""
    c = character.load(name)
    assert c.model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    qpos = np.concatenate([[0, 0, c.hip_height - 2e-3], c.rest[c.root], c.default])

    def forces():
        d = posed(c.model, qpos, np.zeros(c.model.nv))
        return d.efc_force[: d.nefc].copy()

    assert c.solved_by("newton") is c
    newton = forces()
    c.model.opt.iterations = 1000
    np.testing.assert_allclose(newton, forces(), atol=1e-6)
    c.solved_by("pgs")
    apart = np.linalg.norm(forces() - newton) / np.linalg.norm(newton)
    assert 1e-6 < apart < 0.5


def test_upright(chars):
    """Both soles on the floor, the head above the root, the joints at their defaults; the body looks along x."""
    for c in chars.values():
        d = posed(c.model, c.upright)
        assert abs(retarget.sole_points(c, d.geom_xpos[None], d.geom_xmat[None])[..., 2].min(axis=-1)).max() < 1e-9
        np.testing.assert_array_equal(c.upright[7:], c.default)
        left, right = d.xpos[c.feet]
        assert left[1] > right[1] and abs(left[0] - right[0]) < 1e-9 and d.xpos[c.head, 2] > d.xpos[c.root, 2]
        assert not c.upright[:2].any() and d.site_xpos[c.sensor_sites[0], 0] > 0


def test_builds(chars):
    """What the issue of each body is: sizes, masses, the centre of mass over the feet, what hangs where."""
    part = lambda c, *names: sum(  # noqa: E731
        c.model.body_mass[b] for b in range(c.model.nbody) if c.model.body(b).name.startswith(names)
    )
    jesse, oppy, dino = (chars[n] for n in NAMES)
    assert jesse.model.body_subtreemass[0] == pytest.approx(60, abs=0.1)
    assert oppy.model.body_subtreemass[0] == pytest.approx(20, abs=0.1) and 0.9 < oppy.height < 1.1
    assert dino.model.body_subtreemass[0] == pytest.approx(86.5, abs=0.1) and 1.8 < dino.height < 2.0
    share = {n: part(c, "head") / c.model.body_subtreemass[0] for n, c in chars.items()}
    assert share["oppy"] > 0.24 and share["dino"] > 0.1 and share["jesse"] < 0.06
    assert part(dino, "tail") > 0.15 * dino.model.body_subtreemass[0]
    assert oppy.hip_height / oppy.height < 0.36 < 0.5 < jesse.hip_height / jesse.height  # short legs
    for c in chars.values():
        d = posed(c.model, c.upright)
        soles = retarget.sole_points(c, d.geom_xpos[None], d.geom_xmat[None])[0]
        com = d.subtree_com[c.root]
        assert soles[..., 0].min() + 0.02 < com[0] < soles[..., 0].max() - 0.02 and abs(com[1]) < 1e-6
        assert abs(soles[..., 2].min(axis=1)).max() < 1e-9  # both feet stand
        others = [g for g in range(c.model.ngeom) if c.model.geom_bodyid[g] not in (0, *c.feet)]
        assert character.geom_lowest(c.model, others, d.geom_xpos[None], d.geom_xmat[None]).min() > 0.04
    arm = lambda c: np.linalg.norm(c.model.body("forearm_l").pos) + np.linalg.norm(c.model.body("hand_l").pos)  # noqa: E731
    assert arm(dino) / dino.height < 0.6 * arm(jesse) / jesse.height  # short arms


@pytest.mark.parametrize("name", NAMES)
def test_nothing_explodes(chars, name):
    """Zero action, and random actions at up to 0.85 for two seconds: falls, but never a broken simulation.

    At full strength, lying on the floor, an Oppy in a thousand steps does break: `Env` ends it as a failure."""
    c = chars[name]
    ref = retarget.reference(c, [clip_of("walk", 3.0)])
    env, rng = Env(c, ref, 16, threads=1, autoreset=False), np.random.default_rng(0)
    for strength in (0.0, 0.85):
        env.reset(0)
        for _ in range(60):
            *_, info = env.step(strength * rng.uniform(-1, 1, (16, env.action_size)))
            assert not info["ends"]["bad"].any()
        assert np.isfinite(env.qpos).all() and np.abs(env.qvel[:, 6:]).max() < 200


@pytest.mark.parametrize("name", ["oppy", "dino"])
def test_tails_and_ears_swing(chars, name):
    """Pinned at the root and plucked, every passive hinge comes back to where gravity and its spring leave it, slower
    than the simulation's step by far, and swings past it: it is a spring, neither limp nor stiff."""
    c = chars[name]
    if name == "dino":  # the first two joints of its tail are held, as its motors hold them
        held = 'passive.hold = ["spine", "neck", "head", "tail"]'
        c = character.load("dino", set=[held, "passive.stiffness.tail0=300", "passive.stiffness.tail1=240"])
    spec = c.mjspec()
    spec.delete(next(j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE))
    m = spec.compile()
    for field, first in (("jnt_stiffness", 1), ("dof_damping", 6), ("dof_armature", 6), ("qpos_spring", 7)):
        getattr(m, field)[:] = getattr(c.model, field)[first:]
    d = mujoco.MjData(m)
    mujoco.mj_step(m, d, 1500)
    still = d.qpos.copy()
    assert np.abs(d.qvel).max() < 0.05
    for h in np.setdiff1d(np.arange(c.j), c.driven):
        assert abs(still[h] - c.default[h]) < 0.45 and c.ranges[h][0] + 0.1 < still[h] < c.ranges[h][1] - 0.1
        d.qpos[:], d.qvel[:] = still, 0.0
        d.qpos[h] += 0.3
        track = []
        for _ in range(240):
            mujoco.mj_step(m, d)
            track.append(d.qpos[h] - still[h])
        crossing = np.flatnonzero(np.diff(np.sign(track)))
        assert len(crossing) and 0.03 < crossing[0] / 120 < 0.5, c.hinges[h]
        assert 0.015 < -min(track) and abs(track[-1]) < 0.15, c.hinges[h]


# ----------------------------------------------------------------------------------------- variations


def test_tail(chars):
    """Fig. 8: two driven and six passive, two driven and six fixed, all passive."""
    dino = chars["dino"]
    tails = lambda c: [h for h in c.hinges if h.startswith("tail")]  # noqa: E731
    active, fixed, passive = (character.load("dino", tail=t) for t in ("active", "fixed", "passive"))
    assert active.hinges == dino.hinges and len(active.limits) == 37
    assert tails(fixed) == ["tail0_y", "tail0_z", "tail1_y", "tail1_z"] and len(fixed.limits) == 37
    assert passive.hinges == dino.hinges and len(passive.limits) == 33
    assert not any(passive.hinges[h].startswith("tail") for h in passive.driven)
    assert [c.variant for c in (dino, active, fixed, passive)] == [{}, *({"tail": t} for t in character.TAILS)]
    for c in (active, fixed, passive):
        assert c.model.body_subtreemass[0] == pytest.approx(86.5)
        at = {n: (c.model.jnt_stiffness[1 + h], c.model.dof_damping[6 + h]) for h, n in enumerate(c.hinges)}
        assert at["tail0_y"] == (60.0, 3.0) and at["tail1_z"] == (48.0, 48.0 * 0.05)  # the springs stay
        np.testing.assert_allclose(c.joint_weights.sum(), 1.0)
        env = Env(c, retarget.reference(c, [clip_of("walk", 1.0)]), 2, threads=1)
        env.reset(0)
        assert np.isfinite(env.step(np.zeros((2, env.action_size)))[1]).all()
    for how in ("active", "passive"):
        with pytest.raises(UserError, match=f"--tail {how}: no hinge of its tail has a motor, .*; valid: fixed"):
            character.load("oppy", tail=how)
    with pytest.raises(UserError, match="--tail fixed: no hinge of jesse.xml is called tail"):
        character.load("jesse", tail="fixed")
    with pytest.raises(UserError, match="--tail wagging: .*valid: active, fixed, passive"):
        character.load("dino", tail="wagging")
    assert character.load("oppy").j == 40 and character.load("oppy", tail="fixed").j == 35


def test_fixed_tail_keeps_its_pose():
    """Welded where the default pose has it: every body lies where it lies when the hinges are there."""
    pose = ("pose.tail2_y=0.2", "pose.tail2_z=-0.3", "pose.tail5_z=0.4", "pose.tail0_z=0.1")
    free, fixed = (character.load("dino", tail=t, set=pose) for t in ("active", "fixed"))
    assert fixed.j == free.j - 10
    a, b = (posed(c.model, [0, 0, 1, 1, 0, 0, 0, *c.default]) for c in (free, fixed))
    np.testing.assert_allclose(a.xpos, b.xpos, atol=1e-12)
    np.testing.assert_allclose(a.xquat, b.xquat, atol=1e-12)
    shown = fixed.mjspec().compile()
    assert shown.nq == fixed.model.nq and shown.ngeom > fixed.model.ngeom


@pytest.mark.parametrize("which,scale", [("oppy", 0.5), ("oppy", 1.6), ("mini", 2.0)])
def test_scale(chars, mini, which, scale):
    """Fig. 5.  Sizes S, masses S^3, inertias S^5, torques S^4; and all together: without contact a body of another size
    moves through the same angles in sqrt(S) times the time."""
    c = mini if which == "mini" else chars[which]
    name = c.path if which == "mini" else which
    s, big = scale, character.load(name, scale=scale)
    assert big.variant == {"scale": s} and big.hip_height == pytest.approx(s * c.hip_height)
    np.testing.assert_allclose(big.model.body_mass, s**3 * c.model.body_mass, rtol=1e-9)
    np.testing.assert_allclose(big.model.body_inertia, s**5 * c.model.body_inertia, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(big.limits, s**4 * c.limits)
    for field, power in (("body_pos", 1), ("site_pos", 1), ("geom_size", 1), ("jnt_stiffness", 4), ("dof_damping", 4.5),
                         ("dof_armature", 5)):  # fmt: skip
        inside = slice(1, None) if field in ("geom_size", "body_pos") else slice(None)  # not the floor
        want = s**power * getattr(c.model, field)[inside]
        np.testing.assert_allclose(getattr(big.model, field)[inside], want, rtol=1e-6, atol=1e-12, err_msg=field)
    np.testing.assert_allclose(big.model.qpos_spring[7:], c.model.qpos_spring[7:])
    models = []
    for char_, size in ((c, 1.0), (big, s)):
        m = char_.mjspec().compile()
        for field in ("jnt_stiffness", "dof_damping", "dof_armature", "actuator_gear", "qpos_spring"):
            getattr(m, field)[:] = getattr(char_.model, field)
        m.opt.timestep = 0.002 * np.sqrt(size)
        m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # contacts and limits have times of their own
        models.append(m)
    tracks = []
    for m, size in zip(models, (1.0, s), strict=True):
        d = mujoco.MjData(m)
        d.qpos[2], d.qpos[7:] = 3.0 * size, c.default + 0.1
        track = []
        for k in range(150):
            d.ctrl[:] = 0.2 * np.sin(0.05 * k + np.arange(m.nu))
            mujoco.mj_step(m, d)
            track.append(np.concatenate([d.qpos[:3] / size, d.qpos[3:]]))
        tracks.append(track)
    np.testing.assert_allclose(tracks[0], tracks[1], atol=1e-5)
    assert np.ptp(tracks[0], axis=0)[7:].max() > 0.2  # it did move
    if which == "oppy":  # scale_z = "hip": the root follows the legs
        ref = retarget.reference(big, [clip_of("walk", 1.0)])
        assert ref.qpos[:, 2].mean() == pytest.approx(big.hip_height, rel=0.15)


def test_set(chars):
    """A changed entry is the file with that line changed; what cannot be, says what can."""
    c = character.load("jesse", set=["reward.contact=[1.5, 1]", "torque.base.hip=100", "reward.joints.knee = 0.3"])
    assert c.reward["contact"] == (1.5, 1.0) and c.limits[0] == 100 and chars["jesse"].limits[0] == 200
    k, other = c.hinges.index("knee_l_y"), c.hinges.index("hip_l_y")
    assert c.joint_weights[k] == pytest.approx(0.3 * c.joint_weights[other])
    assert c.variant == {"set": ["reward.contact=[1.5, 1]", "torque.base.hip=100", "reward.joints.knee = 0.3"]}
    assert c.reward["q"] == chars["jesse"].reward["q"]
    bent = character.load("dino", set=["pose.spine_y=0.28", "pose.spine3_y=0.1"])
    at = dict(zip(bent.hinges, bent.default, strict=True))
    assert [at[f"spine{i}_y"] for i in range(4)] == [0.28, 0.28, 0.28, 0.1] and at["spine2_z"] == 0.0
    for change, says in (
        ("reward.contat=[0, 1]", "with reward.contat=.*'contat', which means nothing; valid: .*contact"),
        ("reward.contact=[0]", r"\[reward\] contact = \[0\] must be \[w, k\]"),
        ("reward.contact", "cannot set 'reward.contact'; valid is TABLE.KEY=VALUE"),
        ("reward.contact=[0, 1", "cannot set .*valid is TABLE.KEY=VALUE"),
        ("contact=[0, 1]", "cannot set 'contact"),
        ("reward.q.w=1", "reward.q is not a table; there are: .*reward"),
        ("pose.spine_w=1", r"\[pose\] names joint 'spine_w'; there are: hip_l_y, .*spine0_y"),
        ("posture.spine_y=1", "'posture', which means nothing"),
        ("root.scale_z=-1", "scale_z = -1 must be greater than 0"),
        ("training.sigma=0", r"\[training\] sigma = 0 must be greater than 0"),
        ("training.lr='fast'", r"\[training\] lr = 'fast' is not a finite number"),
        ("training.hidden=[8, 0]", r"\[training\] hidden = 0 must be greater than 0"),
        ("training.hidden=[8.5]", r"\[training\] hidden = 8.5 must be a whole number"),
        ("training.horizon=3.5", r"\[training\] horizon = 3.5 must be a whole number"),
        ("training.balance=1", r"\[training\] balance = 1 must be true or false"),
        ("training.retry=2", r"\[training\] retry = 2 must be from 0 to 1"),
        ("training.by='os'", r"\[training\] by = 'os' must be a module of ours"),
        ("training.speed=1", r"\[training\] has 'speed', which means nothing; valid: hidden, .*by"),
    ):
        with pytest.raises(UserError, match=says) as error:
            character.load("jesse", set=[change])
        assert "\n" not in str(error.value) and "jesse.toml" in str(error.value)


def test_training_recipe():
    """Every key of [training] is read as it stands, and what it cannot be is one line."""
    recipe = {
        "hidden": "[512, 256]", "horizon": "32", "lr": "3e-4", "balance": "true", "retry": "0.5", "sensor_noise": "0",
        "push": "0.6", "by": "'extras.train'",
    }  # fmt: skip
    c = character.load("jesse", set=[f"training.{key}={text}" for key, text in recipe.items()])
    assert c.training["hidden"] == [512, 256] and c.training["balance"] is True and c.training["by"] == "extras.train"
    for key, text, says in (
        ("hidden", "256", "is not a list"), ("hidden", "[256, 0.5]", "whole number"), ("horizon", "0", "greater"),
        ("horizon", "true", "finite number"), ("lr", "'fast'", "finite number"), ("augment", "1", "true or false"),
        ("retry", "1.5", "from 0 to 1"), ("push", "-1", "at least 0"), ("by", "'os.path'", "extras"),
        ("speed", "1", "means nothing; valid: hidden, value_hidden, horizon"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=rf"jesse.toml with .*\[training\].*{key}.*{says}"):
            character.load("jesse", set=[f"training.{key}={text}"])


def test_switches():
    """The flags that every command shares say the same as the arguments of `load`."""

    @dataclasses.dataclass
    class Options(character.Switches):
        more: int = arg(1, "another flag")

    flags = ["--character", "dino", "--tail", "passive", "--scale", "0.5"]
    flags += ["--set", "reward.contact=[0, 1]; pose.spine_y=0.3"]
    c = cli(Options, flags, "x", "").load()
    assert c.variant == {"tail": "passive", "scale": 0.5, "set": ["reward.contact=[0, 1]", "pose.spine_y=0.3"]}
    assert c.reward["contact"] == (0.0, 1.0) and c.default[c.hinges.index("spine1_y")] == 0.3
    assert cli(Options, [], "x", "").load().variant == {}
    for bad in (["--tail", "wag"], ["--scale", "0"], ["--scale", "-1"]):
        with pytest.raises(SystemExit):
            cli(Options, bad, "x", "")


# ----------------------------------------------------------------------------------------- complaints


TOML, XML = "jesse.toml", "jesse.xml"
MUTATIONS = [  # what, file, old text, new text, what the one line must say
    *[(f"no {t}", TOML, f"[{t}]", f"[gone_{t}]", (f"no table [{t}]", "valid:")) for t in (
        "root", "map", "passive", "observation", "feet", "sensors", "fall")],
    ("not a table", TOML, "[fall]", "[[fall]]", ("[fall] =", "is not a table")),
    ("broken TOML", TOML, "[root]", "[root", ("jesse.toml", "line")),
    ("XML syntax", XML, "</worldbody>", "</worldbdy>", (XML,)),
    ("XML schema", XML, '<freejoint name="root"/>', '<freejoin name="root"/>', (XML, "freejoin")),
    ("model missing", TOML, 'model = "jesse.xml"', 'model = "joss.xml"', ("joss.xml", "jesse.xml")),
    ("degrees", XML, 'angle="radian"', 'angle="degree"', (XML, "radian")),
    ("range in degrees", XML, 'range="-0.05 2.6"', 'range="-3 150"', (XML, "knee_l_y", "150", "radians")),
    ("pose in degrees", TOML, "[pose] ", "[pose]\nelbow_l_y = -90\n#", ("[pose] elbow_l_y", "-90", "radians")),
    ("pose joint", TOML, "[pose] ", "[pose]\nelbo_l_y = -0.9\n#", ("[pose]", "'elbo_l_y'", "elbow_l_y")),
    ("pose type", TOML, "[pose] ", '[pose]\nelbow_l_y = "up"\n#', ("[pose] elbow_l_y", "'up'", "number")),
    ("root body", TOML, 'body = "pelvis"', 'body = "hips"', ("[root]", "'hips'", "pelvis")),
    ("root not free", TOML, 'body = "pelvis"', 'body = "spine0"', ("[root] body", "'spine0'", "'pelvis'")),
    ("root type", TOML, 'body = "pelvis"', "body = 1", ("[root] body = 1", "str")),
    ("scale_z", TOML, 'scale_z = "hip"', 'scale_z = "hips"', ("[root] scale_z", "'hips'", '"hip"')),
    ("scale_xy", TOML, "scale_xy = 1.0", "scale_xy = -1.0", ("[root] scale_xy", "-1.0", "greater than 0")),
    ("map body", TOML, "spine0 = {", "spina0 = {", ("[map]", "'spina0'", "spine0")),
    ("map welded", TOML, "spine0 = {", "hand_l = {", ("[map]", "hand_l", "no hinge")),
    ("map segment", TOML, 'to = "shin_l"', 'to = "calf_l"', ("[map.shin_l]", "'calf_l'", "shin_l, foot_l")),
    ("map key", TOML, "y = 0.25 }", "w = 0.25 }", ("[map.spine0]", "'w'", "from, to, x")),
    ("map share", TOML, "y = 0.25 }", 'y = "half" }', ("[map.spine0] y", "'half'", "number")),
    ("map share axis", TOML, "y = 0.25 }", "z = 0.25 }", ("[map] spine0 shares z", "turn about, y")),
    ("map no head", TOML, 'to = "head"', 'to = "chest"', ("[map]", "human's head")),
    ("torque group", TOML, "default = 200.0", "default = 200.0\nhop = 150.0", ("[torque.base]", "'hop'", "hip")),
    ("torque missing", TOML, "default = 200.0", "knee = 200.0", ("[torque.base]", "hip")),
    ("torque negative", TOML, "default = 200.0", "default = -150.0", ("[torque.base] default", "-150.0")),
    ("torque zero", TOML, "default = 200.0", "default = 0", ("[torque.base] default = 0", "greater than 0")),
    ("torque type", TOML, "default = 200.0", 'default = "strong"', ("[torque.base] default", "'strong'", "number")),
    ("torque bool", TOML, "default = 200.0", "default = true", ("[torque.base] default", "True", "number")),
    ("torque nan", TOML, "default = 200.0", "default = nan", ("[torque.base] default", "nan", "finite")),
    ("scale group", TOML, "Elbow = 0.1", "Elbows = 0.1", ("[torque.scale]", "'elbows'", "elbow")),
    ("scale negative", TOML, "Elbow = 0.1", "Elbow = -0.1", ("[torque.scale] Elbow", "-0.1")),
    ("unknown table", TOML, "[pose]", "[posse]", ("'posse'", "pose", "metrics")),
    ("unknown key", TOML, "scale_xy = 1.0", "scale_yx = 1.0", ("[root]", "'scale_yx'", "scale_xy")),
    ("unknown passive", TOML, "damping = 0.05", "damping = 0.05\nstifness = 3", ("[passive]", "'stifness'")),
    ("no scale", TOML, "[torque.scale]", "[torque.sale]", ("[torque] has 'sale'", "no scale", "base")),
    ("stiffness", TOML, "stiffness = { hip =", "stiffness = { hop =", ("[passive.stiffness]", "hip")),
    ("damping", TOML, "damping = 0.05", "damping = -0.05", ("[passive] damping", "-0.05")),
    ("armature", TOML, "hip = 0.05, ", "", ("[passive.armature]", "hip")),
    ("armature type", TOML, "hip = 0.05, ", 'hip = "x", ', ("[passive.armature] hip", "'x'")),
    ("links", TOML, '"spine3", "head", "hand_l"', '"spine9", "head"', ("[observation]", "'spine9'", "spine3")),
    ("links type", TOML, 'links = ["pelvis"', 'links = "x" # ["pelvis"', ("[observation] links", "'x'", "list")),
    ("no term", TOML, "action_diff = [1.5, 10.0]", "", ("[reward] has no action_diff",)),
    ("term name", TOML, "action_diff =", "action_dif =", ("[reward]", "'action_dif'", "action_diff")),
    ("term pair", TOML, "xd = [0.7, 2.0]", "xd = [0.7]", ("[reward] xd", "[0.7]", "[w, k]")),
    ("term negative", TOML, "xd = [0.7, 2.0]", "xd = [0.7, -2.0]", ("[reward] xd", "-2.0")),
    ("term type", TOML, "xd = [0.7, 2.0]", "xd = 0.7", ("[reward] xd", "0.7", "list")),
    ("fail type", TOML, "fail = -5.0", 'fail = "much"', ("[reward] fail", "'much'")),
    ("joint weight", TOML, "default = 1.0", "defalt = 1.0", ("[reward.joints]", "'defalt'", "default")),
    ("joint weight type", TOML, "default = 1.0", 'default = "1"', ("[reward.joints] default", "'1'")),
    ("link weight", TOML, "pelvis = 1.0", "plevis = 1.0", ("[reward.links]", "'plevis'", "pelvis")),
    ("link weight type", TOML, "pelvis = 1.0", 'pelvis = "1"', ("[reward.links] pelvis", "'1'")),
    ("foot", TOML, 'bodies = ["foot_l"', 'bodies = ["feet_l"', ("[feet]", "'feet_l'", "foot_l")),
    ("one foot", TOML, 'bodies = ["foot_l", "foot_r"]', 'bodies = ["foot_l"]', ("[feet]", "two bodies", "1 and 2")),
    ("contact sensor", TOML, '"contact_l"', '"contakt_l"', ("[feet]", "'contakt_l'", "contact_l")),
    ("site", TOML, '"headset"', '"headest"', ("[sensors]", "'headest'", "headset")),
    ("two sites", TOML, '"headset", ', "", ("[sensors]", "three sites", "2")),
    ("fall body", TOML, '"neck", "head", "upper', '"nek", "upper', ("[fall]", "'nek'", "neck")),
    ("fall nothing", TOML, 'bodies = ["pelvis", "spine0"', 'bodies = [] # ["pelvis", "spine0"', ("[fall]", "no geom")),
    ("two hinges, one axis", XML, 'name="hip_l_x" class="x"', 'name="hip_l_x" class="y"', (XML, "thigh_l", "yyz")),
    ("oblique hinge", XML, 'name="hip_l_x" class="x"', 'name="hip_l_x" axis="1 1 0"', (XML, "one axis")),
    ("slide joint", XML, 'name="hip_l_x" class="x"', 'name="hip_l_x" type="slide"', (XML, "hinges")),
    ("not free", XML, '<freejoint name="root"/>', '<joint name="root" class="x" range="-1 1"/>', (XML, "free")),
    ("fall shape", XML, 'type="sphere" pos="0.005 0 0.11" size="0.115"', 'type="ellipsoid" size=".1 .1 .1"',
     ("[fall]", "sphere, capsule and box")),
    ("no floor", XML, '<geom name="floor"', '<geom name="floor" pos="0 0 -0.1"', (XML, "floor", "height 0")),
    ("sensor gone", XML, 'name="contact_l"', 'name="contact_left"', ("[feet]", "'contact_l'", "contact_left")),
    ("motor twice", XML, 'name="hip_l_x" joint="hip_l_x"', 'name="hip_l_x" joint="hip_l_y"', (XML, "hinge of its own")),
    ("servo", XML, '<motor name="knee_l_y" joint="knee_l_y"/>', '<position joint="knee_l_y"/>', (XML, "plain <motor>")),
    ("one-sided motor", XML, 'ctrlrange="-1 1"', 'ctrlrange="0 1"', (XML, "plain <motor>", "-1 1")),
    ("root faces y", XML, '<body name="pelvis" ', '<body name="pelvis" euler="0 0 1.57" ', (XML, "y axis of pelvis")),
    ("sip", TOML, 'sip = ["upper_arm_l"', 'sip = ["upperarm_l"', ("[metrics]", "'upperarm_l'", "upper_arm_l")),
    ("training", TOML, "min_sigma = 0.06", "min_sigma = -1", ("[training] min_sigma", "-1")),
]  # fmt: skip


def one_line(error, *parts):
    text = str(error.value)
    assert "\n" not in text and len(text) < 1000, text
    for part in parts:
        assert part in text, f"{part!r} is not in: {text}"


@pytest.mark.parametrize("file,old,new,says", [m[1:] for m in MUTATIONS], ids=[m[0] for m in MUTATIONS])
def test_checks(tmp_path, thin_xml, file, old, new, says):
    """Each mistake in the TOML or the MJCF is one line that names the file, the place and what would be valid."""
    text = {TOML: (CHARACTERS / TOML).read_text(), XML: thin_xml}
    assert old in text[file], "the mutation no longer fits the file"
    text[file] = text[file].replace(old, new)
    for name, content in text.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(UserError) as error:
        character.load(tmp_path / TOML)
    one_line(error, str(tmp_path), *says)


@pytest.fixture(scope="module")
def thin_xml():
    """Jesse's MJCF without the shapes to look at: a tenth of the time."""
    tree = ET.parse(CHARACTERS / XML)
    for body in list(tree.iter("body")):
        for geom in body.findall("geom"):
            if geom.get("class") == "visual":
                body.remove(geom)
    return ET.tostring(tree.getroot(), encoding="unicode").replace(" />", "/>")


def test_unmutated_files_load(tmp_path, thin_xml, chars):
    (tmp_path / XML).write_text(thin_xml)
    shutil.copy(CHARACTERS / TOML, tmp_path)
    same = character.load(str(tmp_path / TOML))
    np.testing.assert_array_equal(same.ranges, chars["jesse"].ranges)
    assert same.path == tmp_path / TOML and same.name == "jesse"


def test_unknown_character(tmp_path, capsys):
    for name in ("jess", tmp_path / "none.toml"):
        with pytest.raises(UserError) as error:
            character.load(name)
        one_line(error, str(name), "jesse")
    assert "jesse" in character.available()
    with pytest.raises(SystemExit) as stop:
        run_main(retarget.main, ["--character", "jess"])
    out = capsys.readouterr()
    assert stop.value.code == 2 and out.err.count("\n") == 1 and "jesse" in out.err and not out.out


def test_unnamed_hinge(tmp_path):
    (tmp_path / "mini.xml").write_text(MINI_XML.replace('<joint name="tail_y"', "<joint"))
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    found = check.check(tmp_path / "mini.xml")
    assert any("every hinge needs a name" in line and "'tail'" in line for line in found)


def test_check_names_everything(tmp_path, thin_xml):
    """Not only the first: every one of many mistakes in both files, a line each."""
    for name in (TOML, XML):
        (tmp_path / name).write_text(thin_xml if name == XML else (CHARACTERS / TOML).read_text())
    assert check.check(tmp_path / TOML) == check.check(tmp_path / XML) == check.check("jesse") == []
    chosen = [m for m in MUTATIONS if m[0] in (
        "map body", "map segment", "torque group", "scale group", "stiffness", "links", "term pair", "no term", "foot",
        "site", "fall body", "link weight", "joint weight", "sip", "no floor", "scale_xy", "pose joint", "armature",
    )]  # fmt: skip
    text = {TOML: (CHARACTERS / TOML).read_text(), XML: thin_xml}
    for _, file, old, new, _ in chosen:
        assert old in text[file]
        text[file] = text[file].replace(old, new, 1)
    for name, content in text.items():
        (tmp_path / name).write_text(content)
    found = check.check(tmp_path / TOML)
    for what, _, _, _, says in chosen:
        assert any(all(part in line for part in says) for line in found), what
    assert all("\n" not in line and str(tmp_path) in line for line in found) and len(found) >= len(chosen)
    assert check.check(tmp_path / XML) == found
    with pytest.raises(UserError) as error:
        character.load(tmp_path / TOML)
    assert str(error.value) == found[0]


def test_check_command(tmp_path, thin_xml, capsys):
    """Status 0 and the summary, or status 1 and all that is wrong; 2 when there is no such file."""
    assert check.main(["oppy"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("oppy: 20.0 kg") and "40 hinges, 31 driven, 46 degrees of freedom" in out
    rows = {line.split()[0]: line for line in out.splitlines()[2:]}
    assert rows["shoulder_l_x"].split()[1:3] == ["13.34", "2.50"] and rows["shoulder_l_x"].endswith("upper_arm_l")
    assert rows["ear_l_y"].endswith("nobody: passive") and "shoulder_r_x" not in rows and "head 5.00" in out
    (tmp_path / "bare.xml").write_text(thin_xml.replace('<freejoint name="root"/>', ""))
    assert check.main([str(tmp_path / "bare.xml")]) == 1
    out = capsys.readouterr().out
    assert "bare.toml: is not there" in out and "has no table [root], [map]" in out
    assert "first joint must be free" in out
    (tmp_path / "other.toml").write_text((CHARACTERS / TOML).read_text())
    (tmp_path / XML).write_text(thin_xml)
    (tmp_path / "other.xml").write_text(thin_xml)
    assert check.main([str(tmp_path / "other.xml")]) == 1
    assert "its model is jesse.xml, not other.xml" in capsys.readouterr().out
    for nothing in ("nobody", tmp_path / "none.xml", tmp_path / "none.toml"):
        with pytest.raises(SystemExit) as stop:
            run_main(check.main, [str(nothing)])
        assert stop.value.code == 2 and "none" in capsys.readouterr().err.replace("nobody", "none")


# ----------------------------------------------------------------------------------------- characters/README.md


def readme():
    return (CHARACTERS / "README.md").read_text(encoding="utf-8")


def test_readme_table(chars):
    """The table that stands in for Table 1 says what the models are."""
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in readme().splitlines() if line.startswith("|")]
    header = rows[0]
    assert header[1:] == ["Jesse", "Oppy", "Dino"]
    table = {row[0]: dict(zip(NAMES, row[1:], strict=True)) for row in rows[1:] if len(row) == 4}
    for name, c in chars.items():
        m = c.model
        facts = {
            "links": m.nbody - 1, "hinges": c.j, "driven": len(c.driven), "degrees of freedom": m.nv,
            "mass, kg": f"{m.body_subtreemass[0]:.1f}", "height, m": f"{c.height:.2f}",
            "hips above the soles, m": f"{c.hip_height:.2f}",
        }  # fmt: skip
        for row, value in facts.items():
            assert table[row][name] == str(value), (row, name)
        limits = {character.joint_group(c.hinges[h]): x for h, x in zip(c.driven, c.limits, strict=True)}
        for group in ("hip", "knee", "ankle", "spine0", "shoulder", "elbow", "neck", "head", *(
                ("tail0", "tail1") if name == "dino" else ())):  # fmt: skip
            base = c.spec["torque"]["base"]["default"]
            row = "torque: " + group.replace("spine0", "spine")
            assert table[row][name] == f"{base:g} ({limits[group]:g})", (row, name)


def fourth(folder):
    """The character that characters/README.md works out, written as it stands there."""
    section = re.search(r"^### A fourth one.*?(?=^### )", readme(), re.M | re.S)[0]
    blocks = re.findall(r"```(toml|xml)\n(.*?)```", section, re.S)
    text = {kind: content for kind, content in blocks}
    assert sorted(kind for kind, _ in blocks) == ["toml", "xml"]
    for kind, content in text.items():
        (folder / f"peg.{kind}").write_text(content)
    return folder / "peg.toml", text["toml"]


def test_fourth_character(tmp_path, capsys):
    """It passes the check, is retargeted to, and can be simulated, rewarded and observed."""
    path, toml = fourth(tmp_path)
    assert check.main([str(tmp_path / "peg.xml")]) == 0
    assert capsys.readouterr().out.startswith("peg: ")
    assert sum(1 for line in toml.splitlines() if line.split("#")[0].strip()) <= 40
    c, clip = character.load(path), clip_of("walk", 2.0)
    pose = retarget.retarget(c, clip)
    report = retarget.artefacts(c, clip, pose)
    assert report["limit_share"] < 0.02 and abs(report["float_mm"]) < 30
    d = posed(c.model, pose.qpos[20])
    human = Rotation.from_quat(clip.quat[20, 0], scalar_first=True)  # pelvis
    assert (Rotation.from_quat(d.xquat[c.root], scalar_first=True).inv() * human).magnitude() < 1e-6
    ref = retarget.reference(c, [clip])
    row = metrics.measure(c, ref, metrics.kinematic(c, ref))
    assert row["root_cm"] == 0.0 and np.isnan(row["sip_deg"]) and "| - |" in metrics.table({"kinematic": row})
    env = Env(c, ref, 4, threads=1)
    obs, _ = env.reset(0)
    start = env.reward_terms(np.zeros((4, env.action_size)))
    assert all(np.all(start[t] > 0.9 * c.reward[t][0]) for t in ("q", "x"))  # it starts where the reference is
    for _ in range(10):
        obs, reward, *_ = env.step(np.zeros((4, env.action_size)))
    assert np.isfinite(obs).all() and np.isfinite(reward).all() and obs.shape == (4, env.obs_size)

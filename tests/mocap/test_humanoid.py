"""mocap/humanoid.py: the bones that tools know, and a T-pose, found without its own rules: by names and by hinges."""

import re

import mujoco
import numpy as np
import pytest

import character
from human import quat_about, quat_angle, quat_rotate
from mocap import humanoid

THREE = ("jesse", "oppy", "dino")
# Written from the standards' own texts.  Unity: HumanTrait.RequiredBone.  VRM: humanoid.humanBones that 0.x and 1.0
# require together.  Mixamo requires nothing; these are all that it has but shoulders, toes, fingers and end points.
SIDES = ("Left", "Right")
UNITY = ["Hips", "Spine", "Head"]
UNITY += [s + b for s in SIDES for b in "UpperLeg LowerLeg Foot UpperArm LowerArm Hand".split()]
VRM = "hips spine chest neck head".split()
VRM += [s + b for s in ("left", "right") for b in "UpperLeg LowerLeg Foot UpperArm LowerArm Hand".split()]
MIXAMO = [f"mixamorig:{b}" for b in "Hips Spine Spine1 Spine2 Neck Head".split()]
MIXAMO += [f"mixamorig:{s}{b}" for s in SIDES for b in "UpLeg Leg Foot Arm ForeArm Hand".split()]
REQUIRED = {"unity": UNITY, "vrm": VRM, "mixamo": MIXAMO}


@pytest.fixture(scope="module", params=THREE)
def char(request):
    return character.load(request.param)


@pytest.mark.parametrize("standard", humanoid.NAMES)
def test_required_bones(char, standard):
    """All three have every bone that a standard requires, once."""
    names = humanoid.names(char, standard)
    assert len(set(names)) == len(names) and set(REQUIRED[standard]) <= set(names)
    assert humanoid.lacking(char, standard) == []
    optional = {humanoid.NAMES[standard][bone] for bone in humanoid.OPTIONAL[standard]}
    assert set(humanoid.NAMES[standard].values()) - optional == set(REQUIRED[standard])


def test_names():
    """Bodies by name; a tail and ears keep theirs."""
    oppy = character.load("oppy")
    own = [oppy.model.body(b).name for b in range(oppy.model.nbody)]
    named = {s: dict(zip(own, humanoid.names(oppy, s))) for s in humanoid.NAMES}
    for body, unity, vrm, mixamo in (
        ("pelvis", "Hips", "hips", "mixamorig:Hips"),
        ("spine0", "Spine", "spine", "mixamorig:Spine"),
        ("spine1", "Chest", "chest", "mixamorig:Spine1"),
        ("spine2", "spine2", "spine2", "spine2"),
        ("spine3", "UpperChest", "upperChest", "mixamorig:Spine2"),
        ("neck", "Neck", "neck", "mixamorig:Neck"),
        ("head", "Head", "head", "mixamorig:Head"),
        ("upper_arm_l", "LeftUpperArm", "leftUpperArm", "mixamorig:LeftArm"),
        ("forearm_r", "RightLowerArm", "rightLowerArm", "mixamorig:RightForeArm"),
        ("hand_l", "LeftHand", "leftHand", "mixamorig:LeftHand"),
        ("thigh_r", "RightUpperLeg", "rightUpperLeg", "mixamorig:RightUpLeg"),
        ("shin_l", "LeftLowerLeg", "leftLowerLeg", "mixamorig:LeftLeg"),
        ("foot_l", "LeftFoot", "leftFoot", "mixamorig:LeftFoot"),
        ("tail3", "tail3", "tail3", "tail3"),
        ("ear_r", "ear_r", "ear_r", "ear_r"),
    ):
        assert (named["unity"][body], named["vrm"][body], named["mixamo"][body]) == (unity, vrm, mixamo)


def test_between_bones_nothing_turns(char):
    """The third of the spine, and no tail, no ear: those stand behind the bones."""
    assert [char.model.body(b).name for b in humanoid.between(char)] == ["spine2"]


def test_a_character_of_ones_own(tmp_path):
    """The wooden doll of characters/README.md: a spine of one, arms of one piece."""
    text = (character.CHARACTERS / "README.md").read_text()
    for kind in ("xml", "toml"):
        (tmp_path / f"peg.{kind}").write_text(re.search(rf"```{kind}\n(.*?)```", text, re.S)[1])
    peg = character.load(tmp_path / "peg.toml")
    found = {peg.model.body(b).name: bone for b, bone in humanoid.bones(peg).items()}
    assert found["trunk"] == "Spine" and found["head"] == "Head" and found["arm_l"] == "LeftUpperArm"
    hands = ["LeftLowerArm", "RightLowerArm", "LeftHand", "RightHand"]
    assert humanoid.lacking(peg, "unity") == hands and "neck" in humanoid.lacking(peg, "vrm")
    assert humanoid.between(peg) == []


def test_turn_between():
    rng = np.random.default_rng(0)
    for a, b in [*rng.normal(size=(20, 2, 3)), ([0, 0, 2], [0, 0, -1]), ([1, 0, 0], [3, 0, 0])]:
        q = humanoid.turn_between(a, b)
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        np.testing.assert_allclose(quat_rotate(q, a), b, atol=1e-12)
        assert quat_angle(q, np.eye(4)[0]) == pytest.approx(np.arccos(np.clip(a @ b, -1, 1)), abs=1e-6)


def test_t_pose(char):
    """The same by hinges: shoulders to the side, elbows and knees straight.  MuJoCo says where the bodies are then."""
    m, data = char.model, mujoco.MjData(char.model)
    xpos, turns = t_positions(char), humanoid.t_pose(char)
    at = {name: xpos[m.body(name).id] for name in ("upper_arm_l", "forearm_l", "hand_l", "thigh_l", "shin_l", "foot_l")}
    for a, b in (("upper_arm_l", "forearm_l"), ("forearm_l", "hand_l")):
        along = at[b] - at[a]
        np.testing.assert_allclose(along / np.linalg.norm(along), [0, 1, 0], atol=1e-9)
    for a, b in (("thigh_l", "shin_l"), ("shin_l", "foot_l")):
        along = at[b] - at[a]
        np.testing.assert_allclose(along / np.linalg.norm(along), [0, 0, -1], atol=1e-9)
    # by hinges: all at zero is upright, each shoulder to the side by as much as its arm lacks of the horizontal
    for s, sign in (("l", 1.0), ("r", -1.0)):
        out = m.body(f"forearm_{s}").pos[1:]
        data.qpos[m.joint(f"shoulder_{s}_x").qposadr] = sign * (np.pi / 2 - np.arctan2(sign * out[0], -out[1]))
    mujoco.mj_kinematics(m, data)
    arms = [m.body(f"{part}_{s}").id for part in ("upper_arm", "forearm", "hand") for s in "lr"]
    if char.name != "jesse":  # the others' forearms are not in line with their upper arms where the elbow is at zero
        arms = arms[:2]
    # Dino's arms bend forward by default, and are raised from there
    assert np.degrees(quat_angle(turns[arms], data.xquat[arms])).max() < (1.0 if char.name == "dino" else 1e-4)
    for name in ("pelvis", "spine0", "spine3", "head", "foot_l", "foot_r"):
        assert quat_angle(turns[m.body(name).id], data.xquat[m.body(name).id]) < 1e-6, name
    palm = quat_rotate(turns[m.body("hand_l").id], np.array([0.0, -1.0, 0.0]))  # to the thigh, where the arm hangs
    np.testing.assert_allclose(palm, [0, 0, -1], atol=1e-6 if char.name == "jesse" else 0.2)


def test_t_pose_of_a_bent_character():
    """Bent knees, arms before the body: the limbs are straight all the same, palms down, feet flat."""
    angles = {"hip": -0.5, "knee": 1.0, "ankle": -0.5, "shoulder": -0.6, "elbow": -0.8}
    bent = character.load("jesse", set=[f"pose.{j}_{s}_y={a}" for j, a in angles.items() for s in "lr"])
    straight = character.load("jesse")
    assert np.degrees(quat_angle(bent.rest, straight.rest)).max() > 30
    assert np.degrees(quat_angle(humanoid.t_pose(bent), humanoid.t_pose(straight))).max() < 1e-4
    raised = humanoid.t_pose(straight)[straight.model.body("forearm_r").id]
    assert quat_angle(raised, quat_about(0, -np.pi / 2)) < 1e-6


def t_positions(char):
    """Where the bodies' origins are in the T-pose, the root's at the origin.  (nbody, 3)"""
    m, turns = char.model, humanoid.t_pose(char)
    xpos = np.zeros((m.nbody, 3))
    for b in range(1, m.nbody):
        p = m.body_parentid[b]
        xpos[b] = xpos[p] + quat_rotate(turns[p], m.body_pos[b]) if b != char.root else 0.0
    return xpos

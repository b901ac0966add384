"""retarget.py's BVH: read by our reader and by another, by the character's own names and by the standards'."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_retarget import clip_of

import character
import retarget
from human import SEG, quat_angle
from mocap import bvh, data, humanoid
from plumbing.cli import UserError


def exported(path, name="jesse", seconds=3.0):
    """A walk's kinematic pose written as BVH.  -> character, pose, clip"""
    char, clip = character.load(name), clip_of("walk", seconds, turn_rate=0.5)
    pose = retarget.retarget(char, clip)
    retarget.write_bvh(path, char, pose.qpos, clip.rate)
    return char, pose, clip


def test_bvh_round_trip(tmp_path):
    """Our reader's kinematics of the file are MuJoCo's of the motion: 1e-4 m, 1e-4 degrees."""
    char, pose, clip = exported(tmp_path / "walk.bvh")
    b, fk = bvh.read(tmp_path / "walk.bvh"), retarget.forward_kinematics(char, pose.qpos)
    pos, quat = bvh.global_pose(b)
    bodies = [char.model.body(n).id for n in b.names]
    assert len(bodies) == char.model.nbody - 1 and b.frame_time == pytest.approx(1 / clip.rate)
    to_file = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # x left, y up, z forward
    np.testing.assert_allclose(pos / 100, fk.xpos[:, bodies] @ to_file.T, atol=1e-6)
    turn = Rotation.from_matrix(to_file)
    want = turn * Rotation.from_quat(fk.xquat[:, bodies].reshape(-1, 4), scalar_first=True) * turn.inv()
    got = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True)
    assert np.degrees((got * want.inv()).magnitude()).max() < 1e-4
    assert set(b.end_sites) == {n for j, n in enumerate(b.names) if j not in b.parents}
    assert all(np.linalg.norm(v) > 1.0 for v in b.end_sites.values())  # cm: importers drop bones without length
    assert not b.offsets[0].any()  # adding the root's OFFSET or not is the same


def test_bvh_is_a_human_again(tmp_path, capsys):
    """The character's own file, read as a human of an unknown rig, in its own size: Oppy's hips are no adult's."""
    for name in ("oppy", "dino"):
        char = exported(tmp_path / f"{name}.bvh", name)[0]
        small = data.from_bvh(tmp_path / f"{name}.bvh")
        assert "unit cm" in capsys.readouterr().err
        assert small.hip_height == pytest.approx(char.hip_height, rel=0.2)
    char, pose, clip = exported(tmp_path / "walk.bvh")
    got = data.from_bvh(tmp_path / "walk.bvh")
    assert "unit cm" in capsys.readouterr().err
    for s in ("thigh_l", "shin_r", "upper_arm_l", "forearm_r", "pelvis"):
        assert np.degrees(quat_angle(got.quat, clip.quat))[:, SEG[s]].mean() < 8, s


@pytest.mark.parametrize("name, names", [("jesse", "own"), ("dino", "unity")])
def test_bvh_in_another_library(tmp_path, name, names):
    """bvhsdk reads the same positions, of a joint that moves in its parent too."""
    sdk = pytest.importorskip("bvhsdk")
    char, clip = character.load(name), clip_of("walk", 0.5, turn_rate=0.5)
    qpos = retarget.retarget(char, clip).qpos
    retarget.write_bvh(tmp_path / "walk.bvh", char, qpos, clip.rate, names)
    fk, other = retarget.forward_kinematics(char, qpos), sdk.ReadFile(str(tmp_path / "walk.bvh"))
    called = [char.model.body(b).name for b in range(char.model.nbody)]
    called = called if names == "own" else humanoid.names(char, names)
    assert other.frames == len(qpos)
    for joint in other.getlistofjoints():
        for t in (0, 7, len(qpos) - 1):
            want = 100 * fk.xpos[t, called.index(joint.name)][[1, 2, 0]]
            np.testing.assert_allclose(joint.getPosition(t), want, atol=1e-4)


@pytest.mark.parametrize("name", ["jesse", "oppy", "dino"])
@pytest.mark.parametrize("standard", humanoid.NAMES)
def test_bvh_of_a_standard(tmp_path, name, standard):
    """Another's names, a T-pose at rest, and our reader's kinematics are MuJoCo's: 1e-6 m, 1e-4 degrees."""
    char, clip = character.load(name), clip_of("gesture", 2.0, gesture="reach_up")
    pose = retarget.retarget(char, clip)
    pose.qpos[:, 7:] += np.random.default_rng(0).uniform(-0.3, 0.3, char.j)  # the spine's turns, the tail's, the ears'
    retarget.write_bvh(tmp_path / "a.bvh", char, pose.qpos, clip.rate, standard)
    b, fk, m = bvh.read(tmp_path / "a.bvh"), retarget.forward_kinematics(char, pose.qpos), char.model
    pos, quat = bvh.global_pose(b)
    named = humanoid.names(char, standard)
    bodies = np.array([named.index(n) for n in b.names])
    assert sorted(bodies) == list(range(1, m.nbody))
    to_file = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # x left, y up, z forward
    np.testing.assert_allclose(pos / 100, fk.xpos[:, bodies] @ to_file.T, atol=1e-6)
    turn = Rotation.from_matrix(to_file)
    rest = Rotation.from_quat(humanoid.t_pose(char)[bodies], scalar_first=True)
    for t in (0, len(quat) // 2, len(quat) - 1):
        world = turn.inv() * Rotation.from_quat(quat[t], scalar_first=True) * turn * rest
        off = (world * Rotation.from_quat(fk.xquat[t, bodies], scalar_first=True).inv()).magnitude()
        assert np.degrees(np.delete(off, b.names.index("spine2"))).max() < 1e-4
    _, local = bvh.local(b)
    assert np.abs(local[:, b.names.index("spine2"), 1:]).max() < 1e-9  # tools would discard what it turns
    moving = [n for n, channels in zip(b.names, b.channels) if len(channels) == 6]
    chest = humanoid.NAMES[standard]["UpperChest"]
    assert moving == [b.names[0], *([] if name == "oppy" else [chest])]  # Oppy's third only twists
    at = rest_positions(b)  # a T: hands at the shoulders' height, ankles under the hips, the face to z
    for side in ("Left", "Right"):
        arm = at[[b.names.index(humanoid.NAMES[standard][side + x]) for x in ("UpperArm", "LowerArm", "Hand")]]
        leg = at[[b.names.index(humanoid.NAMES[standard][side + x]) for x in ("UpperLeg", "LowerLeg", "Foot")]]
        assert np.ptp(arm[:, 1:], axis=0).max() < 1e-6 and np.ptp(leg[:, [0, 2]], axis=0).max() < 1e-6
        assert (np.diff(arm[:, 0]) * (1 if side == "Left" else -1) > 5).all() and (np.diff(leg[:, 1]) < -5).all()


def rest_positions(b):
    """Of a BVH's joints without any turn.  (J, 3)"""
    at = np.zeros((len(b.names), 3))
    for j, parent in enumerate(b.parents):
        at[j] = b.offsets[j] + (at[parent] if parent >= 0 else 0.0)
    return at


def test_bvh_names_on_the_command_line(tmp_path, capsys):
    """The flag, what it needs, and what a character of one's own lacks."""
    out = str(tmp_path / "a.bvh")
    few = ["--motion", "builtin", "--clips", "walk_005"]
    retarget.main([*few, "--bvh", out, "--bvh-names", "vrm"])
    assert capsys.readouterr().out.splitlines()[-1] == out
    assert {"hips", "upperChest", "leftLowerArm"} <= set(bvh.read(out).names)
    with pytest.raises(UserError, match="--bvh-names unity: names the joints of --bvh OUT"):
        retarget.main([*few, "--bvh-names", "unity"])
    text = (character.CHARACTERS / "README.md").read_text()
    for kind in ("xml", "toml"):
        (tmp_path / f"peg.{kind}").write_text(re.search(rf"```{kind}\n(.*?)```", text, re.S)[1])
    retarget.main([*few, "--character", str(tmp_path / "peg.toml"), "--bvh", out, "--bvh-names", "unity"])
    assert "unity also wants LeftLowerArm, RightLowerArm, LeftHand, RightHand" in capsys.readouterr().out


@pytest.mark.parametrize("standard", humanoid.NAMES)
def test_bvh_of_a_standard_is_a_human_again(tmp_path, capsys, standard):
    """Read as an unknown rig, by names alone."""
    char, clip = character.load("jesse"), clip_of("walk", 3.0, turn_rate=0.5)
    retarget.write_bvh(tmp_path / "walk.bvh", char, retarget.retarget(char, clip).qpos, clip.rate, standard)
    got = data.from_bvh(tmp_path / "walk.bvh")
    for s in ("thigh_l", "shin_r", "upper_arm_l", "forearm_r", "pelvis"):
        assert np.degrees(quat_angle(got.quat, clip.quat))[:, SEG[s]].mean() < 8, s


def test_bvh_refuses(tmp_path):
    char, clip = character.load("jesse"), clip_of("walk", 0.2)
    pose = retarget.retarget(char, clip)
    with pytest.raises(UserError, match="cannot write"):
        retarget.write_bvh(tmp_path / "nowhere" / "a.bvh", char, pose.qpos, clip.rate)
    char.model.jnt_pos[5] = [0.0, 0.0, 0.1]
    with pytest.raises(UserError, match="lies beside the body's origin"):
        retarget.write_bvh(tmp_path / "a.bvh", char, pose.qpos, clip.rate)
    assert not list(tmp_path.iterdir())

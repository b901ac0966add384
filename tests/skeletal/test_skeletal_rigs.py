"""skeletal/rigs.py: real rigs as data, and truth across them."""

import os
from pathlib import Path

import numpy as np
import pytest

import character
from human import quat_mul
from mocap import data as captures
from plumbing.cli import UserError
from retarget import forward_kinematics, retarget
from skeletal import data, rigs

MOCAP = os.environ.get("MOCAP_DIR")
CAPTURES = {
    "bandai": "bandai/dataset-2_walk_normal_001.bvh",
    "lafan1": "lafan1/Lafan1_example.bvh",
    "cmu": "cmu/16/16_15.amc",
}


@pytest.fixture(scope="module")
def clips():
    return [c[:70] for c in captures.builtin_clips() if c.name.startswith("walk")][:2]


@pytest.fixture(scope="module")
def human(clips):
    return rigs.load("human", [], clips)


def capture(name):
    if not MOCAP:
        pytest.skip("needs captures: set MOCAP_DIR")
    path = Path(MOCAP) / CAPTURES[name]
    found = path if path.exists() else next(iter(sorted(path.parent.glob("*.bvh"))), None)
    if found is None:
        pytest.skip(f"no {path}")
    return found


@pytest.mark.parametrize("name", CAPTURES)
def test_both_readings_agree(name):
    """A file's legs are as long and point as the canonical human's: metres, z up, the same frames."""
    raw, clip, joints = rigs.both(capture(name))
    s = data.structure_of([raw])
    m, c = data.to_motion(raw, s), rigs.at_30(clip)
    n = min(len(m), len(c))
    p = data.pose(m)[0][:n, m.skeleton.names.index(joints["thigh_l"])] - data.pose(m)[0][
        :n, m.skeleton.names.index(joints["foot_l"])
    ]
    q = c.pos[:n, 3] - c.pos[:n, 5]
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1), atol=1e-3)
    assert np.abs(p - q).max() < 0.05  # mocap may have levelled the floor by up to 3 degrees


@pytest.mark.parametrize("name", CAPTURES)
def test_put_on_is_the_file_again(name):
    """A clip put on its own rig and body is the file; the joints between known segments are all that is not exact."""
    rig, [(m, c)] = rigs.load(name, [capture(name)])
    d = data.pose(rigs.put_on(c, rig, m.skeleton))[0] - data.pose(m)[0]
    assert np.abs(d - d.mean(axis=(0, 1))).mean() < 0.025 * m.skeleton.leg


def test_human_put_on_is_the_clip(human):
    rig, [(m, c), _] = human
    np.testing.assert_allclose(data.pose(rigs.put_on(c, rig, m.skeleton))[0], data.pose(m)[0], atol=1e-9)
    np.testing.assert_allclose(data.pose(m)[0][:, m.skeleton.names.index("hand_r")], c.pos[:, 14], atol=2e-3)


@pytest.mark.parametrize("name", rigs.CHARACTERS)
def test_character_as_rig(name, clips):
    """Bodies stand where MuJoCo has them in the retargeted pose; the truth is that pose with its path in legs."""
    rig, pairs = rigs.load(name, [], clips)
    char = character.load(name)
    fk = forward_kinematics(char, retarget(char, clips[0]).qpos)
    p, _ = data.pose(pairs[0][0])
    for body in ("hand_l", "foot_r", "head"):
        j = rig.skeleton.names.index(body)
        np.testing.assert_allclose(p[:, j], fk.xpos[:, char.model.body(body).id], atol=1e-9)
    true = data.pose(rigs.put_on(clips[0], rig, rig.skeleton))[0]
    np.testing.assert_allclose(true - true[:, :1], p - p[:, :1], atol=1e-9)
    assert not any(n.startswith("tail") for n in rig.skeleton.names)


def test_partners(human, clips):
    """Jesse's joints meet the human's in order, ends meet ends; a copy turns partners alike; no path is lost."""
    jesse, pairs = rigs.load("jesse", [], clips)
    jesse, _ = rigs.in_order(jesse, pairs, human[0].skeleton)
    a, b = human[0].skeleton, jesse.skeleton
    found = rigs.partners(a, b)
    named = {b.names[j]: a.names[k] for j, k in enumerate(found) if k is not None}
    assert named["forearm_l"] == "forearm_l" and named["shin_r"] == "shin_r" and named["foot_r.end"] == "ball_r"
    kept = [k for k in found if k is not None]
    assert len(set(kept)) == len(kept) == len(a.names)
    m = human[1][0][0]
    copy = rigs.copied(m, b)
    g, h = data.pose(m)[1], data.pose(copy)[1]
    j = b.names.index("forearm_r")
    turn = quat_mul(h[:, j] * [1, -1, -1, -1], g[:, found[j]])
    np.testing.assert_allclose(np.abs(turn[:, 0]), 1.0, atol=1e-9)
    np.testing.assert_allclose(copy.pos / b.leg, m.pos / a.leg, atol=1e-12)


def test_raw_is_the_way_back(human):
    """raw_of undoes to_motion, also against another reference pose."""
    rig, [(m, _), _] = human
    again = data.to_motion(rigs.raw_of(m, rig.structure), rig.structure)
    np.testing.assert_allclose(data.pose(again)[0], data.pose(m)[0], atol=1e-9)
    np.testing.assert_allclose(again.skeleton.offsets, m.skeleton.offsets, atol=1e-12)


def test_bad_rigs(clips):
    with pytest.raises(UserError, match="no such rig; valid: human, bandai"):
        rigs.load("wolf", [], clips)
    with pytest.raises(UserError, match="no file of the rig bandai"):
        rigs.load("bandai", [])
    with pytest.raises(UserError, match="--motion /nowhere: no train file of bandai in bandai/"):
        rigs.captured("/nowhere", "bandai", "bandai", "train", 2)

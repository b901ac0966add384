"""headset/body.py: a body for recordings that have none, against what was recorded and what a body can do."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_stream import to_csv

from headset import body
from human import SEG, contacts, heading, headset_height, quat_matrix, sensors
from mocap import gait
from mocap.data import Clip, load
from plumbing.cli import UserError


@pytest.fixture(scope="module")
def worn():
    """What a built-in person who stands and strikes would have recorded."""
    clip = load("standing", clips="stand_115")[0]
    return clip, sensors(clip)


def test_sensors_are_the_recording(worn):
    """The devices are where they were; the guessed person is as tall as the real one."""
    clip, (pos, quat) = worn
    found = body.embodied(pos, quat)
    p, q = sensors(found)
    np.testing.assert_allclose(p, pos, atol=1e-9)
    assert np.abs(np.sum(q * quat, axis=-1)).min() > 1 - 1e-9
    assert headset_height(found) == pytest.approx(headset_height(clip), abs=0.05)
    assert np.linalg.norm(found.pos[:, 0] - clip.pos[:, 0], axis=-1).mean() < 0.08  # the hips, which nobody recorded


def test_limbs(worn):
    """Bones keep their lengths, knees bend forward, nothing is NaN."""
    _, (pos, quat) = worn
    found = body.embodied(pos, quat)
    person = gait.Body((body.standing_height(pos[:, 0]) - 0.08) / 0.91)
    for a, b, length in (
        ("thigh_l", "shin_l", person.thigh), ("thigh_r", "shin_r", person.thigh),
        ("upper_arm_l", "forearm_l", person.upper_arm), ("upper_arm_r", "forearm_r", person.upper_arm),
    ):  # fmt: skip
        bones = np.linalg.norm(found.pos[:, SEG[a]] - found.pos[:, SEG[b]], axis=-1)
        np.testing.assert_allclose(bones, length, atol=1e-9, err_msg=a)
    shins = np.linalg.norm(found.pos[:, SEG["shin_l"]] - found.pos[:, SEG["foot_l"]], axis=-1)
    assert np.percentile(np.abs(shins - person.shin), 95) < 0.01
    turn = quat_matrix(found.quat[:, SEG["thigh_l"]]).swapaxes(1, 2) @ quat_matrix(found.quat[:, SEG["shin_l"]])
    assert Rotation.from_matrix(turn).as_euler("YXZ")[:, 0].min() > -1e-6
    assert all(np.isfinite(v).all() for v in (found.pos, found.quat, found.ball))


def test_feet_stay():
    """A pelvis that goes a metre to the left: feet stand still but for steps, one at a time, and come along."""
    n, rate = 240, 30.0
    s = gait.smooth(np.linspace(-1, 3, n))
    pelvis, yaw = np.stack([0 * s, s, 0.9 + 0 * s], axis=1), 0.8 * s
    ankles, turned = body.plant_feet(pelvis, yaw, 0.085, 0.07, rate)
    speed = np.linalg.norm(np.diff(ankles[..., :2], axis=0), axis=-1) * rate
    moving = speed > 1e-9
    assert not (moving[:, 0] & moving[:, 1]).any() and 2 <= moving.sum() / (0.35 * rate) <= 20
    np.testing.assert_allclose(ankles[1:][~moving][:, 2], 0.07, atol=body.STEP_LIFT)
    middle = ankles[-1].mean(axis=0)
    assert np.linalg.norm(middle[:2] - pelvis[-1, :2]) < body.STEP_FAR
    assert np.abs(turned[-1] - yaw[-1]).max() < body.STEP_TURN
    still, _ = body.plant_feet(pelvis[:1].repeat(60, 0), 0 * yaw[:60], 0.085, 0.07, rate)
    assert np.ptp(still, axis=0).max() == 0.0


def test_two_bone_arm():
    """Upper arm and forearm meet at an elbow of the right lengths, on the side that was asked for."""
    rng = np.random.default_rng(0)
    shoulder = rng.normal(size=(40, 3))
    way = rng.normal(size=(40, 3))
    wrist = shoulder + way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0.1, 0.55, (40, 1))
    hint = rng.normal(size=(40, 3))
    upper, fore = body.two_bone_arm(shoulder, wrist, hint, 0.33, 0.26)
    elbow = shoulder - 0.33 * upper[:, :, 2]
    np.testing.assert_allclose(elbow - 0.26 * fore[:, :, 2], wrist, atol=1e-9)
    across = elbow - 0.5 * (shoulder + wrist)
    along = (wrist - shoulder) / np.linalg.norm(wrist - shoulder, axis=1, keepdims=True)
    flat = hint - np.sum(hint * along, axis=1, keepdims=True) * along
    assert (np.sum(across * flat, axis=1) > 0).all()
    for r in (upper, fore):
        np.testing.assert_allclose(r @ r.swapaxes(1, 2), np.tile(np.eye(3), (40, 1, 1)), atol=1e-9)
    far = body.two_bone_arm(shoulder, shoulder + 3.0 * way, hint, 0.33, 0.26)[0]  # out of reach: pointed at
    np.testing.assert_allclose(-far[:, :, 2], way / np.linalg.norm(way, axis=1, keepdims=True), atol=1e-3)


def test_recordings(worn, tmp_path, capsys):
    """A folder of recordings: one that is none is named and left out; none at all is an error."""
    with pytest.raises(UserError, match="--players .*: no recordings; valid: .csv or .bsor files"):
        body.players(tmp_path)
    with pytest.raises(UserError, match="--players .*nothing: no such file or folder; valid: .csv"):
        body.players(tmp_path / "nothing")
    (tmp_path / "broken.csv").write_text("time,head_px\n0,1\n")
    with pytest.raises(UserError, match="broken.csv, line 1: no column"):
        body.players(tmp_path)
    clip, (pos, quat) = worn
    (tmp_path / "sound.csv").write_text("".join(to_csv(np.arange(len(pos)) / clip.rate, pos, quat, "unity")))
    assert [c.name for c in body.players(tmp_path)] == ["sound"]
    assert f"left out: {tmp_path / 'broken.csv'}, line 1: " in capsys.readouterr().out


@pytest.mark.parametrize("first, unit", [("# axes: openxr\n", 1.0), ("", 0.01)])
def test_axes_of_players(worn, tmp_path, first, unit):
    """In OpenXR's axes: a file that says so, and one in centimetres that does not; the devices are where they were."""
    clip, (pos, quat) = worn
    lines = to_csv(np.arange(len(pos)) / clip.rate, pos / unit, quat, "openxr")
    (tmp_path / "a.csv").write_text(first + "".join(lines))
    [found] = body.players(tmp_path)
    p, q = sensors(found)
    np.testing.assert_allclose(p, pos[: len(p)], atol=1e-5)
    yaw = heading(q[:, 0])
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)[:, None]
    assert np.sum((p[:, 1:] - p[:, :1])[..., :2] * ahead, axis=-1).mean() > 0.1


@pytest.mark.skipif("MOCAP_DIR" not in os.environ, reason="MOCAP_DIR is not set: real recordings lie beside it")
def test_real_players():
    """A real player: the devices are kept, feet are on the floor most of the time, no joint is far from a body's."""
    folder = Path(os.environ["MOCAP_DIR"]).resolve().parent / "sensors" / "train"
    file = folder / "beatsaber_1_3.csv"
    if not file.exists():
        pytest.skip(f"{file.name} is not beside MOCAP_DIR")
    pos, quat = (v[:450] for v in body.read_recording(file))
    clip = body.embodied(pos, quat, "player")
    assert isinstance(clip, Clip) and len(clip) == 450 and 0.9 < clip.hip_height < 1.2
    np.testing.assert_allclose(sensors(clip)[0], pos, atol=1e-9)
    assert contacts(clip).mean() > 0.7 and np.abs(np.diff(clip.pos[:, 0], axis=0)).max() * 30 < 1.5

"""Columns as people name them: any order and case, matrices, milliseconds and centimetres."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_stream import standing, to_csv

import character
from headset import axes
from headset.calibration import Stream
from headset.reader import COLUMNS, Reader, column, columns, time_unit
from plumbing.cli import UserError

FORMS = {  # one name of a position and one of a rotation, of head and of left
    "oculus": ("HeadPosX", "HeadOrientationW", "LeftTouchPosZ", "LeftTouchOrientationY"),
    "capitals": ("HEADPOSX", "HEADORIENTATIONW", "LEFTTOUCHPOSZ", "LEFTTOUCHORIENTATIONY"),
    "small": ("headposx", "headorientationw", "lefttouchposz", "lefttouchorientationy"),
    "turned": ("x pos head", "w.rot.head", "PosZ_Left_Hand", "y-quaternion-left-controller"),
    "dots": ("HMD.Position.x", "HMD.Rotation.w", "LeftController.Position.z", "LeftController.Rotation.y"),
    "anchors": ("CenterEyeAnchor_pos_X", "CenterEyeAnchor_quat_W", "LeftControllerAnchor_pos_Z", "LeftHandAnchor_qy"),
    "units": ("head_pos_x [m]", "head_rot_w", "left_pos_z_cm", "left_rot_y"),
    "short": ("hmd_x", "hmd_qw", "left z", "left_qy"),
    "spelt": ("Headset Location X", "Headset Quat W", "left wand location z", "left wand quat y"),
}


@pytest.mark.parametrize("form", FORMS)
def test_any_order_and_case(form):
    assert [column(n) for n in FORMS[form]] == ["head_px", "head_qw", "left_pz", "left_qy"]


LOOSE = {  # forms that are read only where a file lacks columns otherwise: head, left, position, rotation
    "letters": ("head", "l", "pos", "rot"),
    "hands": ("HMD", "L_Hand", "Position", "Quat"),
    "t": ("head", "left", "t", "q"),
    "local": ("CenterEyeAnchor", "LeftHandAnchor", "localPosition", "localRotation"),
    "makers": ("vive headset", "left vive wand", "pos", "rot"),
    "prefix": ("player1.Head", "player1.LeftTouch", "Pos", "Orientation"),
    "metres": ("head", "left", "pos", "rot"),
    "wrists": ("Head", "LeftWrist", "Pos", "Rot"),
    "nodes": ("headNode", "leftNode", "position", "rotation"),
    "players": ("userHead", "userLeftHand", "pos", "rot"),
    "virtual": ("OVRHead", "VRLeft", "pos", "quat"),
}


@pytest.mark.parametrize("form", LOOSE)
def test_what_all_columns_share(form):
    """Sides as letters, makers' names, a prefix that all share, in any order; a column that is plain wins over them."""
    head, left, position, rotation = LOOSE[form]
    right = left.replace("Left", "Right").replace("left", "right") if "eft" in left else left.replace("l", "r", 1)
    right = right if right != left else left.replace("L", "R")
    devices, unit = dict(zip(("head", "left", "right"), (head, left, right))), " [Meters]" if form == "metres" else ""
    want = list(COLUMNS[1:])[::-1]
    names = [f"{devices[c.split('_')[0]]} {position if '_p' in c else rotation}{c[-1]}" for c in want]
    names = [n + unit * ("_p" in c) for n, c in zip(names, want)]
    assert columns(["unix time (ms)", *names, "frame"], COLUMNS[1:]) == ["time", *want, None]
    both = [*COLUMNS[1:], "l_pos_x", "local_head_pos_x", "camera_x", "left_wrist_px"]
    assert columns(both, COLUMNS[1:]) == [*COLUMNS[1:], None, None, None, None]


@pytest.mark.parametrize("name", [
    "head_vel_x", "left_thumbstick_x", "head_rot_euler_x", "left_eye_pos_x", "gaze_x", "x", "", "head", "head_w",
    "head_pw", "head_pos_rot_x", "left_right_x", "left_pos_x_y", "hmd_m33", "hmd_m4", "left1", "head" * 500,
    "HeadAngularVelocityX", "right_trigger", "leftover_x", "time_of_day", "timer",
])  # fmt: skip
def test_others_are_ignored(name):
    assert column(name) is None


def rows(n=30):
    t, pos, quat = zip(*standing(n / 90.0))
    return np.array(t), np.array(pos), np.array(quat)


def test_matrices():
    """SteamVR's 3 x 4 matrices give the same samples as positions and quaternions; what is no rotation is a loss."""
    t, pos, quat = rows()
    lines = to_csv(t, pos, quat, "openvr")
    plain = list(Reader("f").read(lines))
    names = ["time", *(f"{d}_m{i}{j}" for d in ("hmd", "left", "right_controller") for i in range(3) for j in range(4))]
    out = [",".join(names)]
    for s in plain:
        m = Rotation.from_quat(s.quat).as_matrix()
        out.append(",".join(f"{v:.9g}" for v in (s.t, *np.concatenate([m, s.pos[..., None]], axis=-1).ravel())))
    got = list(Reader("f").read(out))
    for a, b in zip(got, plain):
        np.testing.assert_allclose(a.pos, b.pos, atol=1e-7)
        np.testing.assert_allclose(np.abs(np.sum(a.quat * b.quat, axis=-1)), 1.0, atol=1e-7)
    cells = out[1].split(",")
    out[1] = ",".join(["0"] * 13 + cells[13:])
    lost = next(iter(Reader("f").read(out)))
    assert np.isnan(lost.pos[0]).all() and np.isfinite(lost.pos[1:]).all()
    with pytest.raises(UserError, match="no column left_px"):  # one entry is missing
        list(Reader("f").read([out[0].replace("left_m00", "left_m99"), *out[1:]]))


def test_catalogue(tmp_path):
    """The XR Motion Dataset Catalogue: delta_time_ms, centimetres, x right, y up, z forward."""
    t, pos, quat = rows(300)
    names = [c.replace("_p", "_pos_").replace("_q", "_rot_") for c in COLUMNS]
    names = [n.replace("left", "left_hand").replace("right", "right_hand") for n in names]
    lines = to_csv(1000 * t, 100 * pos, quat, "unity")
    lines[0] = ",".join(["delta_time_ms", *names[1:]]) + "\n"
    (tmp_path / "f.csv").write_text("".join(lines))
    got = list(Reader("f").read(lines))
    assert got[90].t == pytest.approx(1.0) and got[0].pos[0, 1] > 100
    found = axes.choose(tmp_path / "f.csv", "unity")
    assert "centimetres" in found.lines[0] and "--stream-unit 0.01" in found.lines[0]
    auto = axes.choose(tmp_path / "f.csv")
    assert (auto.axes, auto.unit) == ("unity", 0.01)
    stream = Stream(character.load("jesse"), auto.axes, unit=auto.unit, order=auto.order)
    ticks = [tick for sample in got for tick in stream.push(sample)]
    assert stream.calibration.height == pytest.approx(1.65, abs=0.03) and len(ticks) > 60


def test_times():
    units = {"time": 1, "delta_time_ms": 1e-3, "timestamp_ns": 1e-9, "Time (us)": 1e-6, "t": 1}
    assert {n: time_unit(n) for n in units} == units
    assert all(column(n) == "time" for n in ("Time (s)", "Timestamp", "elapsed time [ms]", "session_time"))

"""extras/vmc.py: another library's receiver understands what comes, and the hands are where MuJoCo has them."""

import io
import socket
import struct
import sys
import threading
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import character
import play
import retarget
from extras import vmc
from mocap.data import load
from plumbing.cli import UserError
from policy import find_policy

SIDES = ("Left", "Right")
UNITY = np.array([[0.0, -1, 0], [0, 0, 1], [1, 0, 0]])  # x right, y up, z forward: a mirror, too
# HumanBodyBones, and the bone that each hangs on
ABOVE = {"Spine": "Hips", "Chest": "Spine", "UpperChest": "Chest", "Neck": "UpperChest", "Head": "Neck"}
for side in SIDES:
    ABOVE |= {f"{side}UpperLeg": "Hips", f"{side}LowerLeg": f"{side}UpperLeg", f"{side}Foot": f"{side}LowerLeg"}
    ABOVE |= {f"{side}UpperArm": "UpperChest", f"{side}LowerArm": f"{side}UpperArm", f"{side}Hand": f"{side}LowerArm"}


def read_text(data, at):
    """OSC-string: up to the zero; four bytes or a multiple of them with it."""
    end = data.index(b"\0", at)
    after = at + (end - at) // 4 * 4 + 4
    assert not any(data[end:after])
    return data[at:end].decode("ascii"), after


def read_message(data):
    """One message by OSC 1.0: address, values."""
    assert len(data) % 4 == 0
    address, at = read_text(data, 0)
    tags, at = read_text(data, at)
    assert address[0] == "/" and tags[0] == ","
    values = []
    for tag in tags[1:]:
        if tag == "s":
            value, at = read_text(data, at)
        else:
            (value,) = struct.unpack_from({"i": ">i", "f": ">f"}[tag], data, at)
            at += 4
        values.append(value)
    assert at == len(data)
    return address, values


def read_bundle(data):
    """The messages of a bundle."""
    assert data[:16] == b"#bundle\0" + bytes(7) + b"\1"
    at, out = 16, []
    while at < len(data):
        (size,) = struct.unpack_from(">i", data, at)
        out.append(read_message(data[at + 4 : at + 4 + size]))
        at += 4 + size
    return out


def in_world(got):
    """An avatar of Unity's: bone -> (place, Rotation) in its world, of local places and turns as they were sent."""
    out = {}

    def find(bone):
        if bone not in out:
            place, turn = np.array(got[bone][:3]), Rotation.from_quat(got[bone][3:])
            if bone in ABOVE:
                above, rotation = find(ABOVE[bone])
                place, turn = above + rotation.apply(place), rotation * turn
            out[bone] = place, turn
        return out[bone]

    for bone in got:
        find(bone)
    return out


def bones_sent(bones, qpos):
    """name -> seven numbers, through the bytes."""
    packets = vmc.osc_bundles(bones.messages(qpos, 0.5))
    messages = [m for packet in packets for m in read_bundle(packet)]
    return {values[0]: values[1:] for address, values in messages if address == "/VMC/Ext/Bone/Pos"}


def test_osc_by_its_specification():
    """The examples of the OSC 1.0 text, byte by byte, and bundles that fit a packet."""
    assert vmc.osc_text("OSC") == b"OSC\0" and vmc.osc_text("data") == b"data\0\0\0\0"
    want = bytes.fromhex("2f6f7363696c6c61746f722f342f6672657175656e637900 2c660000 43dc0000")
    assert vmc.osc_message("/oscillator/4/frequency", 440.0) == want
    want = bytes.fromhex("2f666f6f00000000 2c69697366660000 000003e8 ffffffff 68656c6c6f000000 3f9df3b6 40b5b22d")
    assert vmc.osc_message("/foo", 1000, -1, "hello", 1.234, 5.678) == want
    messages = [vmc.osc_message("/a", "x" * k, k, 0.5 * k) for k in range(60)]
    packets = vmc.osc_bundles(messages, 400)
    assert len(packets) > 5 and max(map(len, packets)) <= 400
    assert [m for p in packets for m in read_bundle(p)] == [("/a", ["x" * k, k, 0.5 * k]) for k in range(60)]


def test_unity_frame():
    """Left is left, and a turn to the left stays one: mirrored matrices."""
    v = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(vmc.to_unity(v), v @ UNITY.T)
    turns = Rotation.random(20, random_state=1)
    got = Rotation.from_quat(vmc.turn_to_unity(turns.as_quat(scalar_first=True))).as_matrix()
    np.testing.assert_allclose(got, UNITY @ turns.as_matrix() @ UNITY.T, atol=1e-12)


@pytest.mark.parametrize("upper_chest", [True, False])
@pytest.mark.parametrize("name", ["jesse", "oppy", "dino"])
def test_bones_of_all_three(name, upper_chest):
    """Every joint of the avatar is where MuJoCo has it, and the head looks where MuJoCo's does; any pose."""
    char = character.load(name)
    bones, data = vmc.Bones(char, upper_chest), mujoco.MjData(char.model)
    assert set(bones.names) == {"Hips", *ABOVE} - (set() if upper_chest else {"UpperChest"})
    rng = np.random.default_rng(3)
    for _ in range(4):
        data.qpos[:3], data.qpos[3:7] = rng.normal(size=3), Rotation.random(random_state=rng).as_quat()
        data.qpos[7:] = char.default + rng.uniform(-0.6, 0.6, char.j)
        mujoco.mj_kinematics(char.model, data)
        got = bones_sent(bones, data.qpos)
        if not upper_chest:
            got["UpperChest"] = [0.0] * 6 + [1.0]  # an avatar without it: as if it never moved
        world = in_world(got)
        for bone, body in (("LeftHand", "hand_l"), ("RightHand", "hand_r"), ("RightFoot", "foot_r"), ("Head", "head")):
            np.testing.assert_allclose(world[bone][0], UNITY @ data.body(body).xpos, atol=1e-5)
        want = UNITY @ data.body("head").xmat.reshape(3, 3) @ UNITY.T  # the head rests level in all three
        np.testing.assert_allclose(world["Head"][1].as_matrix(), want, atol=1e-5)


@pytest.mark.parametrize("name", ["jesse", "oppy", "dino"])
def test_limbs_turn_from_the_t_pose(name):
    """An avatar of other proportions, its arms to the sides and legs down, holds its limbs as the character does."""
    char = character.load(name)
    clip = load("builtin", clips="turn_006")[0]
    bones, data = vmc.Bones(char), mujoco.MjData(char.model)
    for qpos in retarget.retarget(char, clip).qpos[::40]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(char.model, data)
        world = in_world(bones_sent(bones, qpos))
        for side, s, out in (("Left", "l", -1.0), ("Right", "r", 1.0)):
            for bone, body, end, rest in (
                ("UpperArm", "upper_arm", "forearm", [out, 0, 0]),
                ("LowerArm", "forearm", "hand", [out, 0, 0]),
                ("UpperLeg", "thigh", "shin", [0, -1, 0]),
                ("LowerLeg", "shin", "foot", [0, -1, 0]),
            ):
                along = UNITY @ (data.body(f"{end}_{s}").xpos - data.body(f"{body}_{s}").xpos)
                got = world[side + bone][1].apply(rest)
                np.testing.assert_allclose(got, along / np.linalg.norm(along), atol=1e-5)


def test_the_t_pose_has_no_turns():
    """Jesse with raised arms: every bone as in the avatar's rest."""
    char = character.load("jesse")
    qpos = np.concatenate([[0, 0, char.hip_height, 1, 0, 0, 0], char.default])
    for name, angle in (("shoulder_l_x", np.pi / 2), ("shoulder_r_x", -np.pi / 2)):
        qpos[7 + char.hinges.index(name)] = angle
    got = bones_sent(vmc.Bones(char), qpos)
    for numbers in got.values():
        np.testing.assert_allclose(numbers[3:], [0, 0, 0, 1], atol=1e-6)
    assert got["LeftUpperArm"][0] < 0 < got["RightUpperArm"][0]  # left is -x
    tall = bones_sent(vmc.Bones(char, hips=1.5), qpos)  # an avatar of another height stands on the same floor
    assert tall["Hips"][1] == pytest.approx(1.5) and tall["Hips"][3:] == got["Hips"][3:]


def stream_file(path, seconds=3.0):
    """A user who stands, then walks on with swinging hands: Unity's axes."""
    rows = ["time," + ",".join(f"{d}_{c}" for d in ("head", "left", "right") for c in "px py pz qx qy qz qw".split())]
    for k in range(round(60 * seconds)):
        t = k / 60
        ahead, swing = 0.3 * max(0.0, t - 1.2), 0.1 * np.sin(5 * max(0.0, t - 1.2))
        head, left, right = (0, 1.6, ahead), (-0.25, 0.8, ahead + 0.1 + swing), (0.25, 0.8, ahead + 0.1 - swing)
        rows.append(f"{t:.5f}," + ",".join(f"{p[0]},{p[1]},{p[2]:.5f},0,0,0,1" for p in (head, left, right)))
    path.write_text("\n".join(rows) + "\n")
    return path


def truth(stream, seconds):
    """What the same policy does under the same stream, tick by tick."""
    policy, path, _ = find_policy(SimpleNamespace(character="jesse", policy=None))
    poses = []
    opt = play.Options(stream=str(stream), axes="unity", seconds=seconds)
    play.follow(character.load("jesse"), policy, path, 3, opt, lambda player, tick: poses.append(player.qpos[0].copy()))
    return np.array(poses)


def test_a_receiver_understands(tmp_path, capsys):
    """python-osc's server, over UDP, in real time: names, order, times; hands where MuJoCo has them."""
    pytest.importorskip("pythonosc", reason="python-osc is not installed")
    from pythonosc.dispatcher import Dispatcher
    from pythonosc.osc_server import BlockingOSCUDPServer

    seen, dispatcher = [], Dispatcher()
    dispatcher.set_default_handler(lambda address, *values: seen.append((address, values)))
    server = BlockingOSCUDPServer(("127.0.0.1", 0), dispatcher)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    stream, port = stream_file(tmp_path / "s.csv"), server.server_address[1]
    flags = ["--character", "jesse", "--stream", str(stream), "--axes", "unity", "--seconds", "1"]
    vmc.main([*flags, "--port", str(port)])
    out = capsys.readouterr().out
    assert f"18 bones of jesse to 127.0.0.1:{port}, 30 times a second" in out and "real time:" in out
    socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(vmc.osc_message("/end"), server.server_address)
    while not seen or seen[-1][0] != "/end":  # the server's thread reads on
        thread.join(0.01)
    server.shutdown()
    server.server_close()
    ticks, poses = [], truth(stream, 1.0)
    for address, values in seen[:-1]:
        if address == "/VMC/Ext/OK":
            assert values == (1, 3, 0)
            ticks.append({})
        elif address == "/VMC/Ext/T":
            ticks[-1]["time"] = values[0]
        elif address == "/VMC/Ext/Root/Pos":
            assert values == ("root", 0, 0, 0, 0, 0, 0, 1)
        else:
            assert address == "/VMC/Ext/Bone/Pos" and len(values) == 8
            ticks[-1][values[0]] = values[1:]
    assert len(ticks) == len(poses) == 30
    np.testing.assert_allclose([t.pop("time") for t in ticks], np.arange(1, 31) / 30, atol=1e-6)
    char = character.load("jesse")
    fk, m = retarget.forward_kinematics(char, poses), char.model
    for k, got in enumerate(ticks):
        assert set(got) == {"Hips", *ABOVE}
        world = in_world(got)
        for bone, body in (("LeftHand", "hand_l"), ("RightHand", "hand_r"), ("Hips", "pelvis"), ("Head", "head")):
            np.testing.assert_allclose(world[bone][0], UNITY @ fk.xpos[k, m.body(body).id], atol=1e-5)


def test_command_line(tmp_path, capsys, monkeypatch):
    """What is wrong is one line; that nobody listens is not."""
    stream = str(stream_file(tmp_path / "s.csv", 1.5))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    vmc.main(["--stream", stream, "--axes", "unity", "--seconds", "0.1", "--port", port, "--no-upper-chest"])
    assert "17 bones of jesse" in capsys.readouterr().out
    with open(stream, "rb") as file:  # live: what comes on standard input
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(file.read())))
    vmc.main(["--stream", "-", "--port", port])
    assert "0.5 s played" in capsys.readouterr().out
    for args, says in (
        ([], "nothing to send: give --stream FILE.csv"),
        (["--stream", stream, "--host", "no such host"], "--host no such host: .*valid: a name or an address"),
        (["--stream", stream, "--host", "255.255.255.255", "--axes", "unity"], "cannot send to 255.255.255.255:39539"),
        (["--stream", str(tmp_path / "none.csv")], "none.csv"),
        (["--stream", str(tmp_path)], "is a folder"),
    ):
        with pytest.raises(UserError, match=says):
            vmc.main(args)
    with pytest.raises(SystemExit):
        vmc.main(["--stream", stream, "--port", "70000"])
    assert "it must be from 1 to 65535" in capsys.readouterr().err

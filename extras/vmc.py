r"""The character live in VTubers' tools: its bones by the VMC protocol, OSC over UDP.

    python -m extras.vmc --character jesse --stream FILE.csv          a recording, in real time
    python -m extras.vmc --character jesse --stream - --port 39540    live, to another port than 39539

    headset ──► policy, physics ──► bodies ──► bones, from a T-pose ──► OSC bundles ──► UDP

A receiver (VSeeFace, Warudo, VNyan, EVMC4U in Unity, VMC4B in Blender …) turns its own avatar by these bones.  Each
tick sends, to this machine alone unless --host says another:

    /VMC/Ext/OK        1 3 0: loaded, calibrated, normal mode
    /VMC/Ext/T         seconds since the character stood up
    /VMC/Ext/Root/Pos  "root", place, turn: the world's origin, which does not move
    /VMC/Ext/Bone/Pos  a name of Unity's HumanBodyBones, place, turn; of each bone in the bone above it

Unity's frame: x right, y up, z forward, left-handed; metres; quaternions x, y, z, w.  A turn counts from the T-pose,
in which all bones of an avatar have none.
"""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass

import mujoco
import numpy as np

import play
from character import Character, Switches
from env import SENSORS
from headset.player import Pace
from human import quat_conj, quat_mul, quat_rotate
from mocap import humanoid
from mocap.data import CONTROL_RATE
from plumbing.cli import POSITIVE, UserError, arg, cli, run_main
from policy import devices_of, find_policy, load_character

PORT = 39539  # where VMC's receivers listen
PACKET = 1400  # bytes of a bundle at most: a network carries 1500 whole
PORTS = (lambda v: 1 <= v <= 65535, "from 1 to 65535")


@dataclass
class Options(play.StreamFlags, Switches):
    """Which policy, under which headset, and to whom."""

    character: str | None = arg(None, "name in characters/, or path of a .toml; the policy's own by default, or jesse")
    policy: str | None = arg(None, "run folder or policy .npz; characters/NAME.npz by default")
    sensors: str | None = arg(None, "hmd: the policy is shown the headset alone (play.py)", choices=SENSORS)
    seconds: float | None = arg(None, "how much of the stream; all by default", check=POSITIVE)
    host: str = arg("127.0.0.1", "where to send to; this machine by default")
    port: int = arg(PORT, "the receiver's UDP port", check=PORTS)
    hips: float | None = arg(
        None, "height of the avatar's hips [m], to which places are scaled; the character's by default", check=POSITIVE
    )
    upper_chest: bool = arg(True, "the avatar has the bone UpperChest; if not, its chest turns for both")


# ------------------------------------------------------------------------------------ OSC 1.0


def osc_text(text: str) -> bytes:
    """A string: ASCII, ended by a zero, padded with zeros to a multiple of four bytes.

    Test      tests/extras/test_vmc.py::test_osc_by_its_specification"""
    data = text.encode("ascii") + b"\0"
    return data + b"\0" * (-len(data) % 4)


def osc_message(address: str, *values) -> bytes:
    """An address, the values' types, the values: int, float and str as big-endian i, f and s.

    Test      tests/extras/test_vmc.py::test_osc_by_its_specification"""
    tags, body = ",", b""
    for v in values:
        if isinstance(v, str):
            tags, body = tags + "s", body + osc_text(v)
        elif isinstance(v, int):
            tags, body = tags + "i", body + struct.pack(">i", v)
        else:
            tags, body = tags + "f", body + struct.pack(">f", v)
    return osc_text(address) + osc_text(tags) + body


def osc_bundles(messages, most=PACKET) -> list[bytes]:
    """Messages in as few bundles as hold them, each of at most so many bytes, to be obeyed at once (time tag 1).

    Test      tests/extras/test_vmc.py::test_osc_by_its_specification"""
    head = osc_text("#bundle") + struct.pack(">Q", 1)
    out = [head]
    for message in messages:
        element = struct.pack(">i", len(message)) + message
        if len(out[-1]) + len(element) > most and out[-1] != head:
            out.append(head)
        out[-1] += element
    return out


# ------------------------------------------------------------------------------------ bones


def to_unity(v):
    """x forward, y left, z up, right-handed -> x right, y up, z forward, left-handed.  (..., 3) -> (..., 3)

    Test      tests/extras/test_vmc.py::test_unity_frame"""
    v = np.asarray(v)
    return np.stack([-v[..., 1], v[..., 2], v[..., 0]], axis=-1)


def turn_to_unity(q):
    """Quaternions w, x, y, z -> x, y, z, w of the same turn in Unity's frame.  (..., 4) -> (..., 4)

    Equation  a mirrored axis turns the other way round: (−M u, w), M of `to_unity`
    Test      tests/extras/test_vmc.py::test_unity_frame"""
    q = np.asarray(q)
    return np.concatenate([-to_unity(q[..., 1:]), q[..., :1]], axis=-1)


class Bones:
    """A character's bones as an avatar has them: each in the one above it, turned from a T-pose.

    Equation  G_b = R_b T_b⁻¹; turn G_p⁻¹ G_b, place G_p⁻¹ (x_b − x_p), p the next bone above b; the hips' in the world
    Why       bodies between two bones are left out, and what they turn is in the next bone's turn
    Args      upper_chest, hips : as in Options
    Test      tests/extras/test_vmc.py::test_bones_of_all_three, test_limbs_turn_from_the_t_pose
    """

    def __init__(self, char: Character, upper_chest=True, hips: float | None = None):
        known = humanoid.bones(char)
        if not upper_chest and "UpperChest" in known.values():
            known = {b: "Chest" if n == "UpperChest" else n for b, n in known.items() if n != "Chest"}
        self.m, self.data = char.model, mujoco.MjData(char.model)
        self.bodies = sorted(known)  # a body comes after the one it hangs on
        self.names = [known[b] for b in self.bodies]
        self.above = [self.bodies.index(self._next(b)) if b != char.root else -1 for b in self.bodies]
        self.back = quat_conj(humanoid.t_pose(char)[self.bodies])
        self.scale = hips / char.hip_height if hips else 1.0

    def _next(self, b):
        """The body above b that is a bone."""
        b = self.m.body_parentid[b]
        return b if b in self.bodies else self._next(b)

    def of(self, qpos):
        """Places (n, 3) and turns (n, 4) in a pose (nq,), in our frame.

        Test      tests/extras/test_vmc.py::test_bones_of_all_three"""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.m, self.data)
        places, turns = self.scale * self.data.xpos[self.bodies], quat_mul(self.data.xquat[self.bodies], self.back)
        below = np.flatnonzero(np.array(self.above) >= 0)
        above = np.array(self.above)[below]
        back, out, turned = quat_conj(turns[above]), places.copy(), turns.copy()
        out[below], turned[below] = quat_rotate(back, places[below] - places[above]), quat_mul(back, turns[below])
        return out, turned

    def messages(self, qpos, seconds: float) -> list[bytes]:
        """All that is sent in one tick.  Test: tests/extras/test_vmc.py::test_a_receiver_understands"""
        places, turns = self.of(qpos)
        numbers = np.concatenate([to_unity(places), turn_to_unity(turns)], axis=1).tolist()
        return [
            osc_message("/VMC/Ext/OK", 1, 3, 0),
            osc_message("/VMC/Ext/T", seconds),
            osc_message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
            *(osc_message("/VMC/Ext/Bone/Pos", name, *row) for name, row in zip(self.names, numbers)),
        ]


# ------------------------------------------------------------------------------------ sending


class Sender:
    """A UDP socket that sends to one host and port.

    Raises    UserError: no such host, or it cannot be sent to
    Test      tests/extras/test_vmc.py::test_command_line"""

    def __init__(self, host: str, port: int):
        self.name = f"{host}:{port}"
        try:
            family, kind, _, _, self.address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self.socket = socket.socket(family, kind)
        except (OSError, UnicodeError) as e:
            raise UserError(
                f"--host {host}: {getattr(e, 'strerror', None) or e}; valid: a name or an address"
            ) from None

    def send(self, packets) -> None:
        """All of them.  That nobody listens is no fault: receivers come and go.

        Raises    UserError: the network refuses"""
        try:
            for packet in packets:
                self.socket.sendto(packet, self.address)
        except OSError as e:
            raise UserError(f"cannot send to {self.name}: {e.strerror or e}") from None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()


def main(argv=None) -> None:
    """python -m extras.vmc: send a character's bones.  Test: tests/extras/test_vmc.py::test_command_line"""
    opt = cli(Options, argv, "python -m extras.vmc", __doc__)
    if not opt.stream:
        raise UserError("nothing to send: give --stream FILE.csv, or --stream - for standard input")
    policy, path, meta = find_policy(opt)
    char = load_character(opt, meta, path)
    bones = Bones(char, opt.upper_chest, opt.hips)
    if missing := humanoid.lacking(char, "unity"):
        print(f"{char.name} has no {', '.join(missing)}: the avatar's stay as they are")
    with Sender(opt.host, opt.port) as sender:

        def see(player, tick):
            sender.send(osc_bundles(bones.messages(player.qpos[0], float(player.ticks[0] * player.dt))))

        print(f"{len(bones.names)} bones of {char.name} to {sender.name}, {CONTROL_RATE:g} times a second", flush=True)
        play.follow(char, policy, path, devices_of(meta, path, opt.sensors), opt, see, Pace(1.0 / CONTROL_RATE))


if __name__ == "__main__":
    run_main(main)

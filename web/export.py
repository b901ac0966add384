r"""Characters and their policies as the page reads them: one JSON and one binary each.

    characters/NAME.{xml,toml,npz} ──► data/NAME.json   names, indices, small tables, the MJCF's text
                                   └─► data/NAME.bin    the arrays that JSON's "arrays" lists: dtype, shape, offset
    built-in motions               ──► data/demo.csv    a headset's recording, made by `demonstration`
                                   └─► data/index.json  which characters there are

The MJCF is shipped as it was written: MuJoCo's own writer rounds to six digits, and a rounded Dino starts on other
contacts.  What `character.load` changes after compiling are five arrays; they travel as float64, so that the browser's
physics is ours to the last bit.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import character
from character import CHARACTERS, Character
from env import observation_terms
from headset.reader import AXES, COLUMNS
from human import Clip, sensors
from mocap import gait
from mocap.stitch import join, motion_features
from nn import LEAKY_SLOPE
from plumbing.cli import UserError, arg, cli
from plumbing.files import atomic_write
from policy import devices_of, load_policy, trained_as
from retarget import headset

FORMAT, VERSION = "sparse-retarget-web", 1
NAMES = ("jesse", "oppy", "dino")
FOLDER = Path(__file__).resolve().parent / "dist" / "data"
COMPILED = ("jnt_stiffness", "dof_damping", "dof_armature", "actuator_gear", "qpos_spring")  # changed after compiling


@dataclass
class Options:
    """What `python -m web export` can be told."""

    out: str = arg(str(FOLDER), "folder to write to; it is made where there is none")
    characters: str = arg(",".join(NAMES), "names in characters/ that have a policy, separated by commas")


# ------------------------------------------------------------------------------------ a character


def tables(char: Character, policy, meta, path) -> tuple[dict, dict]:
    """All that the page needs of a character and its policy.

    Args      path : of the policy, for complaints
    Returns   table : as JSON; arrays : name -> float32 or float64 array, for the binary
    Raises    UserError: a variation that is not in the MJCF's text, or a policy of another body
    Test      tests/web/test_web.py::test_round_trip
    """
    if char.variant.get("tail", "active") != "active" or "scale" in char.variant:
        raise UserError(f"{path}: its body varies (tail, scale), which the MJCF's text does not say; valid: neither")
    devices = devices_of(meta, path, None)
    m, norm, n = char.model, policy.norm, policy.obs_size
    actions, observations = len(char.limits), sum(observation_terms(char, devices)["actor"].values())
    if (n, policy.action_size) != (observations, actions):
        have, need = f"{n} observations and {policy.action_size} actions", f"{observations} and {actions}"
        raise UserError(f"{path}: a policy of {have}; {char.name} needs {need}")
    arrays = {name: np.asarray(getattr(m, name), np.float64) for name in COMPILED}
    arrays |= {"norm_mean": norm.mean[:n], "norm_inv_std": norm.inv_std[:n], "theta": policy.actor.theta}
    table = dict(
        format=FORMAT,
        version=VERSION,
        name=char.name,
        licence=str(meta.get("licence", "unknown")),
        policy=dict(
            sizes=list(policy.actor.sizes), activation=policy.activation, slope=LEAKY_SLOPE, clip=norm.clip,
            devices=devices,
        ),
        root=char.root,
        head=char.head,
        obs_links=char.obs_links.tolist(),
        fall_geoms=char.fall_geoms.tolist(),
        sensor_sites=char.sensor_sites.tolist(),
        bodies=[m.body(b).name or f"body{b}" for b in range(m.nbody)],
        geoms=m.ngeom,  # without the shapes that are only looked at
        hip_height=char.hip_height,
        headset=headset(char).tolist(),
        default=char.default.tolist(),
        rest_root=char.rest[char.root].tolist(),
        scale=dict(
            root_xy=char.spec["root"].get("scale_xy", 1.0),
            root_z=char.spec["root"].get("scale_z", "hip"),
            sensors_z=char.spec["sensors"].get("scale_z", "headset"),
        ),
        xml=char.xml.read_text(encoding="utf-8"),
    )  # fmt: skip
    return table, arrays


def packed(arrays: dict) -> tuple[dict, bytes]:
    """Arrays end to end, little-endian, each at a multiple of eight bytes, and where they are.

    Test      tests/web/test_web.py::test_round_trip"""
    where, parts, offset = {}, [], 0
    for name, array in arrays.items():
        raw = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
        where[name] = {"dtype": array.dtype.name, "shape": list(array.shape), "offset": offset}
        padding = -len(raw) % 8
        parts.append(raw + b"\0" * padding)
        offset += len(raw) + padding
    return where, b"".join(parts)


def unpacked(where: dict, data: bytes) -> dict:
    """What `packed` put together.  Test: tests/web/test_web.py::test_round_trip"""
    out = {}
    for name, entry in where.items():
        count = int(np.prod(entry["shape"]))
        out[name] = np.frombuffer(data, entry["dtype"], count, entry["offset"]).reshape(entry["shape"])
    return out


def export(name: str, folder: Path) -> dict:
    """Write NAME.json and NAME.bin.

    Returns   the character's line of index.json
    Raises    UserError: no such character, or no policy for it
    Test      tests/web/test_web.py::test_round_trip, test_bad_arguments
    """
    path = CHARACTERS / f"{name}.npz"
    if not path.is_file():
        character.load(name)  # a wrong name is the better complaint
        raise UserError(f"no policy {path}: train one (python ppo.py --character {name})")
    policy, meta = load_policy(path)
    own = trained_as(meta, path)
    char = own.load() if own else character.load(name)
    table, arrays = tables(char, policy, meta, path)
    table["arrays"], data = packed(arrays)
    # The checksum is part of the binary's address: a browser never pairs this JSON with an older binary.
    table["binary"] = {"file": f"{name}.bin", "bytes": len(data), "crc32": zlib.crc32(data)}
    atomic_write(folder / f"{name}.bin", data)
    atomic_write(folder / f"{name}.json", json.dumps(table, allow_nan=False))
    return {"name": name, "file": f"{name}.json", "licence": table["licence"]}


# ------------------------------------------------------------------------------------ the demonstration

DEMO_RATE = 60.0  # Hz
DEMO = (  # kind, seconds made, seconds kept at least, parameters: somebody stands, waves, walks, turns, runs, stops
    ("gesture", 7.0, 5.5, {"gesture": "wave"}),
    ("start", 9.0, 5.5, {"speed": 1.1}),
    ("turn", 8.0, 4.5, {"speed": 1.0, "turn_rate": 0.7}),
    ("jog", 8.0, 4.0, {"speed": 2.2, "turn_rate": 0.25}),
    ("walk", 6.0, 2.0, {"speed": 1.3}),
    ("stop", 9.0, 5.0, {"speed": 1.1}),
    ("stand", 4.0, 3.0, {}),
)
DEMO_SEED = 3


def demonstration() -> Clip:
    """Half a minute of the built-in human: stands, waves, walks, turns, runs, walks and stops.

    Method    each motion is left and the next one entered where pose and velocity fit best (`motion_features`)
    Test      tests/web/test_web.py::test_demonstration
    """
    clips = []
    for i, (kind, seconds, _, params) in enumerate(DEMO):
        m = gait.generate(kind, seconds, DEMO_RATE, seed=DEMO_SEED + i, variation=0.6, **params)
        clips.append(Clip(kind, "demo", m["rate"], m["pos"], m["quat"], m["ball"]))
    blend, entry, parts = int(DEMO_RATE / 3), 0, []
    features = [motion_features(c) for c in clips]
    for i, clip in enumerate(clips[:-1]):
        first = entry + int(DEMO[i][2] * DEMO_RATE)
        leave = np.arange(min(first, len(clip) - blend - 2), len(clip) - blend - 1)
        enter = np.arange(int(1.5 * DEMO_RATE))
        apart = np.linalg.norm(features[i][leave][:, None] - features[i + 1][enter], axis=-1)
        a, b = np.unravel_index(np.argmin(apart), apart.shape)
        parts.append((clip, entry, int(leave[a])))
        entry = int(enter[b])
    parts.append((clips[-1], entry, len(clips[-1]) - 1))
    return join(parts, blend, "demonstration")


def as_csv(clip: Clip) -> str:
    """A headset's recording of a clip in WebXR's axes, as the page itself records one.

    Test      tests/web/test_web.py::test_demonstration"""
    pos, quat = sensors(clip)
    m = AXES["openxr"]
    pos, axis = pos @ m, quat[..., 1:] @ m  # the inverse of `to_world`; the openxr grip needs no turn
    t = np.arange(len(clip)) / clip.rate
    devices = np.concatenate([pos, axis, quat[..., :1]], axis=-1).reshape(len(clip), -1)
    rows = (",".join(f"{v:.5f}" for v in (s, *row)) for s, row in zip(t, devices))
    head = "# made by `python -m web export` from built-in motions; axes: openxr"
    return "\n".join([head, ",".join(COLUMNS), *rows]) + "\n"


# ------------------------------------------------------------------------------------ command line


def main(argv=None):
    """Write the data of the page.  Test: tests/web/test_web.py::test_bad_arguments"""
    opt = cli(Options, argv, "web export", __doc__)
    names, folder = [n.strip() for n in opt.characters.split(",") if n.strip()], Path(opt.out)
    if not names:
        raise UserError(f"--characters {opt.characters!r}: names none; valid: {', '.join(character.available())}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder}: {error.strerror or error}; valid: a folder that can be written") from None
    lines = [export(name, folder) for name in names]
    atomic_write(folder / "demo.csv", as_csv(demonstration()))
    atomic_write(folder / "index.json", json.dumps({"format": FORMAT, "version": VERSION, "characters": lines}))
    for line in lines:
        size = sum((folder / f"{line['name']}.{kind}").stat().st_size for kind in ("json", "bin"))
        print(f"{folder / line['file']}: {size / 1e6:.2f} MB with its binary; {line['licence']}")
    print(f"{folder / 'demo.csv'}: {(folder / 'demo.csv').stat().st_size / 1e6:.2f} MB")

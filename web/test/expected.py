"""What Python computes, for the tests of the page: JSON on standard output.

python web/test/expected.py loop CSV       each character: physics under given controls, first tick, 20 s of closed loop
python web/test/expected.py stream CSV ... each file: the ticks, or the complaint
python web/test/expected.py axes CSV ...       each file: axes, grip, unit, order and what is said of them
python web/test/expected.py bvh FILE       names and frames; with NAME QPOS how far it is from Python's
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import character  # noqa: E402
from headset.axes import choose  # noqa: E402
from headset.bsor import Replay, is_replay  # noqa: E402
from headset.calibration import Stream  # noqa: E402
from headset.player import Player, drive  # noqa: E402
from headset.reader import Reader, lines_of  # noqa: E402
from mocap.bvh import read  # noqa: E402
from plumbing.cli import UserError  # noqa: E402
from retarget import write_bvh  # noqa: E402
from web.export import NAMES, devices_of, load_policy, trained_as  # noqa: E402

STEPS, SECONDS = 240, 20.0


def physics(char):
    """240 steps from the default pose under sinusoidal controls."""
    m, data = char.model, mujoco.MjData(char.model)
    m.opt.timestep = 1 / 120
    data.qpos[:] = char.upright
    start = data.qpos.copy()
    t, k = np.arange(STEPS)[:, None] / 120, np.arange(m.nu)
    controls = 0.1 * np.sin(2 * np.pi * (0.5 + 0.1 * k) * t + k)
    for row in controls:
        data.ctrl[:] = row
        mujoco.mj_step(m, data)
    return dict(start=start.tolist(), controls=controls.tolist(), qpos=data.qpos.tolist(), qvel=data.qvel.tolist())


def loop(path):
    """Every character under one recording."""
    out = {}
    for name in NAMES:
        shipped = character.CHARACTERS / f"{name}.npz"
        policy, meta = load_policy(shipped)
        char = trained_as(meta, shipped).load()
        entry = {"physics": physics(char)}
        devices = devices_of(meta, shipped, None)
        player, roots = Player(char, policy.mean_action, devices=devices), []

        count, when = player.ends[0].copy(), []

        def see(player, tick, entry=entry, roots=roots, count=count, when=when):
            when += [(len(roots), k) for k in player.ENDS if player.ends[0][k] > count[k]]
            count.update(player.ends[0] - count)
            if not roots:
                entry["obs"], entry["action"] = player.obs[0].tolist(), player.act(player.obs)[0].tolist()
            roots.append(player.qpos[0, :3].tolist())

        stream = Stream(char, "openxr", devices=devices)
        drive(stream, Reader(path, devices=devices).read(lines_of(path)), player, SECONDS, see=see)
        c = stream.calibration
        entry["calibration"] = [c.height, c.floor, c.yaw, *c.origin.tolist(), *c.scale.tolist()]
        out[name] = entry | {"roots": roots, "when": when, "ends": {k: player.ends[0][k] for k in player.ENDS}}
    return out


def stream(paths):
    """The ticks of each file, for Jesse: [[pos, quat] ...], or why there are none; the file is called FILE."""
    char, out = character.load("jesse"), []
    for path in paths:
        try:
            source = Stream(char, "unity")
            samples = Replay(path).samples() if is_replay(path) else Reader("FILE").read(lines_of(path))
            ticks = [tick for s in samples for tick in source.push(s)]
            if source.calibration is None:
                raise UserError(f"FILE: {source.uncalibrated()}")
            out.append({"ticks": [np.concatenate([t.pos.ravel(), t.quat.ravel()]).tolist() for t in ticks]})
        except UserError as error:
            out.append({"error": str(error).replace(path, "FILE")})
    return out


def axes(paths):
    """How each file is read where nobody told its axes."""
    return [choose(path)._asdict() for path in paths]


def bvh(path, name=None, qpos=None):
    """What a BVH file of the page holds, and how far it is from `write_bvh`'s of the same states (JSON)."""
    motion = read(path)
    out = {"names": motion.names, "frames": len(motion.values)}
    if name:
        own = Path(path).with_suffix(".own.bvh")
        write_bvh(own, character.load(name), np.array(json.loads(Path(qpos).read_text())), 30.0)
        ours = read(own)
        turns = (motion.values - ours.values)[:, 3:] / 360.0  # whole turns are none
        apart = np.abs(turns - np.round(turns)).max() * 360.0
        out["place"], out["angle"] = float(np.abs(motion.values - ours.values)[:, :3].max()), float(apart)
        out["offsets"] = float(np.abs(motion.offsets - ours.offsets).max())
        out["same"] = motion.names == ours.names and motion.parents.tolist() == ours.parents.tolist()
    return out


if __name__ == "__main__":
    command, *paths = sys.argv[1:]
    results = {"loop": lambda: loop(paths[0]), "stream": lambda: stream(paths), "axes": lambda: axes(paths)}
    results["bvh"] = lambda: bvh(*paths)
    json.dump(results[command](), sys.stdout)

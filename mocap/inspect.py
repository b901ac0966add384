"""mocap.inspect.inspect."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from human import Clip, contacts, footfalls
from mocap import bvh, data, fetch, rigs
from mocap.data import _sequences, load
from mocap.rigs import AS_IT_IS, Reading, from_amc, is_amc
from plumbing.cli import printable, run_main

# ------------------------------------------------------------------------------------ python -m mocap inspect


def describe(clip: Clip) -> str:
    """Rate, length, speed and contacts of a clip in one line; the balls' mean height while the feet are in contact.

    Test      tests/mocap/test_mocap.py::test_inspect"""
    travel = np.linalg.norm(np.diff(clip.pos[:, 0, :2], axis=0), axis=-1).sum()
    speed = travel * clip.rate / max(len(clip) - 1, 1)
    c = contacts(clip)
    height = f"{100 * clip.ball[c, 2].mean():.1f}" if c.any() else "-"
    return (
        f"{clip.name:36s} {clip.rate:5.1f} Hz {len(clip):5d} frames {clip.seconds:6.1f} s  "
        f"{travel:6.2f} m  {speed:4.2f} m/s  contact L {100 * c[:, 0].mean():3.0f} % R {100 * c[:, 1].mean():3.0f} %  "
        f"{footfalls(c, clip.rate):3d} footfalls  balls {height} cm up in contact  hips {clip.hip_height:.2f} m"
    )


def inspect(path, reading=AS_IT_IS) -> None:
    """Print what a file or a folder holds.  Test: tests/mocap/test_mocap.py::test_inspect."""
    path = Path(path)
    if path.is_dir() or str(path) in data.BUILTIN:
        clips = load(str(path), reading=reading)
        for clip in clips:
            print(describe(clip))
        _sequences(clips, f"{path} [all]")
        return
    if is_amc(path):
        clip, b, name, joints = from_amc(path), rigs.read_amc(path)[0], "cmu", rigs.CMU_BONES
    else:
        b = rigs.read(path)
        rig, name = data.rig_for(b, reading)
        clip, joints = rigs.canonical(b, rig, name), rig.joints
    segment = {joint: s for s, joint in joints.items()}
    print(f"{path}: rig {name}, {len(b.names)} joints")
    for joint, line in zip(b.names, bvh.outline(b.names, b.parents)):
        indent = len(line) - len(joint)
        print(f"  {' ' * indent}{printable(joint):18s} {segment.get(joint, '')}".rstrip())
    print(describe(clip))


def main(argv=None) -> None:
    """python -m mocap inspect FILE|FOLDER, or fetch NAME.  Test: tests/robustness/test_cli.py::test_mocap_inspect"""
    parser = argparse.ArgumentParser(
        prog="python -m mocap", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    sub = parser.add_subparsers(dest="command", required=True)
    p = sub.add_parser("inspect", help="print skeleton, rate, length, speed and contacts")
    p.add_argument("path", help="a .bvh or .amc file, a folder of them, builtin or standing")
    for name, text in rigs.HELP.items():
        p.add_argument("--" + name.replace("_", "-"), help=text)
    f = sub.add_parser("fetch", help="download a data set, its licence and citation first")
    f.add_argument("name", choices=tuple(fetch.DATASETS))
    f.add_argument("--out", help="folder (default: data/NAME)")
    f.add_argument("--url", metavar="BASE", help="another server with the same paths, such as http://127.0.0.1:8000")
    for each in (parser, p, f):  # one line, as in plumbing.cli.cli
        each.error = lambda message: parser.exit(2, f"python -m mocap: error: {message} (see --help)\n")
    args = parser.parse_args(argv)
    if args.command == "fetch":
        fetch.fetch(args.name, args.out, args.url)
        return
    inspect(args.path, Reading.of(args))


if __name__ == "__main__":
    run_main(main)

"""python -m mocap inspect: what files of motion hold, and what had to be assumed to read them."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from human import Clip, contacts, footfalls, resample, travelled
from mocap import bvh, data, fetch, rigs
from mocap.data import CONTROL_RATE, load, stitched
from mocap.rigs import AS_IT_IS, Reading, from_amc, is_amc
from plumbing.cli import UserError, printable, run_main
from plumbing.files import atomic_write, check_folders

# ------------------------------------------------------------------------------------ python -m mocap inspect


def numbers(clip: Clip | None, warnings=()) -> dict:
    """What --json holds of a file: its rate [Hz], frames, seconds, the pelvis' speed over the ground [m/s], the hips'
    height [m], the share of the time that a foot is in contact (both feet's mean), and what was said of it.  None
    instead of numbers where it could not be read.

    Test      tests/mocap/test_mend.py::test_inspect_json"""
    out = dict.fromkeys(("rate", "frames", "seconds", "speed", "hips", "contact"))
    if clip:
        out |= {
            "rate": round(clip.rate, 4),
            "frames": len(clip),
            "seconds": round(clip.seconds, 4),
            "speed": round(travelled(clip.pos[:, 0]) * clip.rate / max(len(clip) - 1, 1), 4),
            "hips": round(clip.hip_height, 4),
            "contact": round(float(contacts(clip).mean()), 4),
        }
    return out | {"warnings": list(warnings)}


def describe(clip: Clip) -> str:
    """Rate, length, speed and contacts of a clip in one line; the balls' mean height while the feet are in contact.

    Test      tests/mocap/test_mocap.py::test_inspect"""
    travel = travelled(clip.pos[:, 0])
    speed = travel * clip.rate / max(len(clip) - 1, 1)
    c = contacts(clip)
    height = f"{100 * clip.ball[c, 2].mean():.1f}" if c.any() else "-"
    return (
        f"{clip.name:36s} {clip.rate:5.1f} Hz {len(clip):5d} frames {clip.seconds:6.1f} s  "
        f"{travel:6.2f} m  {speed:4.2f} m/s  contact L {100 * c[:, 0].mean():3.0f} % R {100 * c[:, 1].mean():3.0f} %  "
        f"{footfalls(c, clip.rate):3d} footfalls  balls {height} cm up in contact  hips {clip.hip_height:.2f} m"
    )


def inspect(path, reading=AS_IT_IS) -> dict:
    """Print what a file or a folder holds.

    Returns   path of each file -> `numbers`
    Test      tests/mocap/test_mocap.py::test_inspect, tests/mocap/test_mend.py::test_inspect_json"""
    path = Path(path)
    if path.is_dir() or str(path) in data.BUILTIN:
        return _inspect_folder(path, reading)
    with rigs.heard() as said:
        if is_amc(path):
            clip, b, name, joints = from_amc(path, reading), rigs.read_amc(path)[0], "cmu", rigs.CMU_BONES
        else:
            b = rigs.read(path, reading)
            rig, name = data.rig_for(b, reading)
            clip, joints = rigs.canonical(b, rig, name, reading), rig.joints
    segment = {joint: s for s, joint in joints.items()}
    print(f"{path}: rig {name}, {len(b.names)} joints")
    for joint, line in zip(b.names, bvh.outline(b.names, b.parents)):
        indent = len(line) - len(joint)
        print(f"  {' ' * indent}{printable(joint):18s} {segment.get(joint, '')}".rstrip())
    print(describe(clip))
    return {str(path): numbers(clip, [text for _, text in said])}


def _inspect_folder(path, reading):
    """A line a file, at the rate that training takes, and what stitching makes of them."""
    files = [] if str(path) in data.BUILTIN else data.files_of(path)
    with rigs.heard() as said:
        clips = data.read_clips(files, reading) if files else load(str(path))  # which says what a folder must hold
    trained = [resample(clip, CONTROL_RATE) for clip in clips]
    for clip in trained:
        print(describe(clip))
    stitched(trained, f"{path} [all]")
    own = [str(file) for file in files] or [clip.name for clip in clips]
    return {f: numbers(clip, [text for name, text in said if name == f]) for f, clip in zip(own, clips, strict=True)}


def main(argv=None) -> None:
    """python -m mocap inspect PATH..., or fetch NAME.  Test: tests/robustness/test_cli.py::test_mocap_inspect"""
    parser = argparse.ArgumentParser(
        prog="python -m mocap", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    sub = parser.add_subparsers(dest="command", required=True)
    p = sub.add_parser("inspect", help="print skeleton, rate, length, speed and contacts")
    p.add_argument("path", nargs="+", help="a .bvh or .amc file, a folder of them, builtin or standing")
    p.add_argument("--json", metavar="OUT", help="write rate, frames, seconds, speed, hips, contact, warnings of each")
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
    check_folders(args.json, read=args.path)
    reading, found, failed = Reading.of(args), {}, None
    for path in args.path:
        try:
            found |= inspect(path, reading)
        except UserError as error:  # the others are still told
            failed, found[path] = error, numbers(None, [str(error)])
            if len(args.path) > 1:
                print(f"error: {error}", file=sys.stderr)
    if args.json:
        atomic_write(args.json, json.dumps(found, indent=2, ensure_ascii=False) + "\n")
    if failed:
        bad = sum(f["rate"] is None for f in found.values())
        raise failed if len(args.path) == 1 else UserError(f"{bad} of {len(args.path)} could not be read")


if __name__ == "__main__":
    run_main(main)

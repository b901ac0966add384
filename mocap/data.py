r"""Human motion: one canonical human, whatever the rig  [Reda23 §3.4, App. A].

    read a file ──────► canonical Clip ──► resample ──► stitch ──► sensors, contacts
    (mocap/rigs.py)           15 segments        30 Hz        ≥ 30 s     §3.4    App. A
    or mocap/gait.py, mocap/exercise.py

Everything after the reader speaks of one human only: 15 named segments, each with a joint centre and an
anatomical frame that equals the world's axes (x forward, y left, z up) when the person stands upright with
the arms hanging.  Metres, radians, seconds; quaternions w, x, y, z.

    python -m mocap inspect FILE      skeleton, rate, length, speed, contacts
    python -m mocap inspect FOLDER    one line a clip, and what stitching makes of them
    python -m mocap fetch NAME        download bandai, cmu or lafan1 (mocap/fetch.py)
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from human import Clip, resample
from mocap import bvh, exercise, gait
from mocap.augment import reverse
from mocap.guess import unknown_rig
from mocap.rigs import (
    AS_IT_IS,
    FLOORS,
    HELP,
    REST_POSES,
    RIGS,
    canonical,
    checked_unit,
    from_amc,
    is_amc,
    known_rig,
    read,
)
from mocap.stitch import stitch
from plumbing.cli import UserError, arg

CONTROL_RATE = 30.0  # Hz, ASSUMED: Table 3 is not in the text we have


# ------------------------------------------------------------------------------------ data sets

SPLITS = ("train", "validation", "style", "body", "all")


UNSEEN = ("07", "08", "16", "35")  # CMU's people whose bodies nothing that is shipped was trained on


def split_of(path) -> str:
    """Which part of a data set a clip belongs to, by its folder or its name: no run can see a held-out one by accident.

    train, validation : what lies in a folder of that name, the nearest one counting
    body        : the people of UNSEEN, by the first number of SUBJECT_TRIAL, whatever the file's format
    style       : the whole style `youthful` (unseen style)
    validation  : every clip whose trailing number ends in 5 (unseen clips; in LaFAN1 that is subject 5)
    train       : the rest
    Args        path : of the file, from the data set's own folder on; or a clip's name
    Test        tests/mocap/test_mocap.py::test_split, tests/mocap/test_amc.py::test_body_split
    """
    path = Path(path)
    name = path.stem if path.suffix.lower() in (".bvh", ".amc") else path.name
    for folder in reversed(path.parts[:-1]):
        if folder in ("train", "validation"):
            return folder
    if (found := re.fullmatch(r"(\d+)_\d+", name)) and found[1] in UNSEEN:
        return "body"
    if "youthful" in name:
        return "style"
    number = re.search(r"(\d+)$", name)
    return "validation" if number and number.group(1).endswith("5") else "train"


# AMASS's protocol 1, its CMU trials: what AvatarPoser tests on (data_split/CMU/test_split.txt of its repository, which
# AGRoL and HMD-Poser took over) beside trials of BioMotionLab and HDM05.  `mocap fetch cmu` gets eight of them
PROTOCOL1 = """
01_02 05_04 07_08 07_09 07_10 08_01 10_02 10_05 102_14 102_19 102_23 103_01 103_02 103_05 105_05 105_19 105_21 105_31
105_39 105_45 105_50 105_52 106_01 106_14 106_16 106_17 107_03 108_04 108_06 108_07 108_08 108_16 108_18 108_21 108_26
111_01 111_13 111_32 111_33 113_01 113_14 118_02 118_09 118_17 120_05 120_08 120_16 122_12 122_43 122_59 122_66 122_67
123_07 125_03 125_06 126_02 126_05 127_02 127_26 13_10 13_12 13_34 131_07 132_05 132_15 132_28 132_33 132_47 133_23
133_25 135_04 136_01 136_11 136_14 136_23 136_29 137_06 137_12 137_14 137_18 139_34 141_02 141_07 141_09 141_22 142_02
142_11 142_19 143_01 143_07 143_39 143_40 144_03 144_06 144_17 15_06 15_07 15_10 16_34 17_05 17_07 18_02 18_04 18_08
18_09 18_10 18_14 20_04 22_17 22_18 22_22 27_11 29_03 29_08 29_19 30_02 30_09 30_17 31_19 35_08 35_16 35_18 35_26
35_28 35_29 36_07 36_14 36_19 36_20 36_22 40_11 41_03 41_04 54_03 54_05 54_06 54_17 54_20 55_11 55_20 55_28 60_05
60_08 62_12 62_18 62_25 63_02 63_09 63_15 63_20 63_26 64_16 64_17 64_21 74_13 77_02 77_09 77_16 77_32 78_05 78_34
79_13 79_21 79_24 79_26 79_27 79_36 79_50 79_65 79_77 79_94 80_14 80_18 80_31 80_36 80_67 82_17 83_14 83_16 83_26
83_32 83_35 83_39 83_43 83_46 83_55 83_59 83_68 84_04 84_16 85_08 86_04 86_05 86_15 88_10 90_12 90_18 90_19 90_23
91_06 91_36 91_37 91_42 91_43 91_45 93_06 94_16
"""
NAMED = {"protocol1": frozenset(PROTOCOL1.split())}  # sets of clips that --clips knows by name
BUILTIN = {  # no download
    "builtin": gait.MIX,
    "standing": gait.STANDING,
    "backwards": gait.BACKWARDS,
    "exercises": exercise.MIX,
}
MOTION = f"{', '.join(BUILTIN)}, a .bvh or .amc file, a folder of them, several with commas between them"


@dataclass
class MotionFlags:
    """The flags of every command that reads motion: which, and what the user says of its files."""

    motion: str = arg("builtin", MOTION)
    clips: str = arg("*", f"shell pattern on clip names, such as '*walk*'; or a named set: {', '.join(NAMED)}")
    joint_map: str | None = arg(None, HELP["joint_map"])
    unit: str | None = arg(None, HELP["unit"])
    up: str | None = arg(None, HELP["up"])
    rate: float | None = arg(None, HELP["rate"])
    floor: str | None = arg(None, HELP["floor"], choices=FLOORS)
    rest_pose: str | None = arg(None, HELP["rest_pose"], choices=REST_POSES)


def builtin_clips(rate=CONTROL_RATE, seed=0, name="builtin") -> list[Clip]:
    """The procedural human: people who walk (builtin), stand and step (standing), step back (backwards: those who step
    forwards, `mocap.augment.reverse`d), all of mocap/gait.py, or exercise in place (exercises, mocap/exercise.py).

    Twenty clips, two of them held out by their numbers; and ten more, of every kind and by other people, all held out.
    Test      tests/mocap/test_mocap.py::test_builtin, ::test_joined, tests/mocap/test_exercise.py::test_library"""
    mix, out = BUILTIN[name], []
    library_of = exercise.library if name == "exercises" else gait.library
    library = library_of(rate=rate, seed=seed, mix=mix)
    each = tuple({kind: (kind, ranges) for kind, ranges in reversed(mix)}.values())  # one of every kind
    held_out = library_of(minutes=5.0, rate=rate, seed=seed + 1000, mix=each)
    numbers = [(i + 5) % len(library) for i in range(len(library))]  # of `builtin` 005 and 015 are straight walks
    numbers += [105 + 10 * i for i in range(len(held_out))]
    for m, number in zip(library + held_out, numbers, strict=True):
        title = f"{m['name'].split('_')[1]}_{number:03d}"
        clip = Clip(title, f"{name}-{number:03d}", m["rate"], m["pos"], m["quat"], m["ball"])
        out.append(replace(reverse(clip), name=f"back_{number:03d}") if name == "backwards" else clip)
    return out


def parts(motion) -> list[str]:
    """The data sets of a --motion: one, or several with commas between them (unless a file has that name).

    Test      tests/mocap/test_mocap.py::test_joined"""
    try:
        sets = [str(motion)] if Path(motion).exists() else str(motion).split(",")
    except OSError:  # too long for a name
        sets = str(motion).split(",")
    if "" in sets:
        raise UserError(f"--motion {motion}: an empty name, a comma too many; valid: {MOTION}")
    return sets


UNKNOWN = "no licence file beside the motion"
CMU = "free to use, credit CMU Graphics Lab Motion Capture Database (mocap.cs.cmu.edu), funded by NSF EIA-0196217"


def licences(sets) -> list[str]:
    """Of each data set that is not built in: its name, and the first lines of the licence files in it and above its
    part; of a folder without one whose name begins with `cmu`, the credit that CMU asks for.

    Test      tests/mocap/test_mocap.py::test_licences, tests/extras/test_policies.py::test_ship
    """
    out = []
    for path in (Path(s) for s in sets if s not in BUILTIN):
        whole = path.parent if path.name in ("train", "validation") else path
        notes = [note for folder in (path, whole) if folder.is_dir() for note in sorted(folder.glob("LICENSE*"))]
        absent = CMU if whole.name.lower().startswith("cmu") else UNKNOWN
        titles = [note.read_text(errors="replace").strip().split("\n")[0] for note in notes] or [absent]
        out.append(f"{set_name(path)}, licensed: {', '.join(dict.fromkeys(titles))}")
    return out


def set_name(motion) -> str:
    """A data set's name without where it lies: of a part of it, both.

    Test      tests/mocap/test_mocap.py::test_licences"""
    path = Path(motion)
    return f"{path.parent.name}/{path.name}" if path.name in ("train", "validation") else path.name


def files_of(path: Path) -> list[Path]:
    """The motion files of a folder and below, or the file itself.  Test: tests/mocap/test_mocap.py::test_load_errors"""
    if not path.is_dir():
        return [path]
    return sorted(f for f in path.rglob("*") if f.suffix.lower() in (".bvh", ".amc") and not f.is_dir())


def keys_of(path: Path, files) -> list[Path]:
    """What `split_of` reads of a data set's files: each from the set's own folder on."""
    top = path if path.is_dir() else path.parent
    return [Path(top.resolve().name) / f.relative_to(top) for f in files]


def check_unseen(sets, split) -> None:
    """UserError: among several sets to train on, one that holds only people held out as unseen bodies.

    Why       alone it is meant, and is split by its trials; beside others nobody reads the line that says so, and
              afterwards no body is unseen
    Test      tests/mocap/test_mocap.py::test_unseen_beside_others"""
    if split != "train" or len(sets) == 1:
        return
    for one in sets:
        path = Path(one)
        files = files_of(path) if one not in BUILTIN and path.exists() else []
        if files and all(split_of(k) == "body" for k in keys_of(path, files)):
            raise UserError(
                f"{one}: holds only people held out as unseen bodies ({', '.join(UNSEEN)}): leave it out; by itself it "
                "can be trained on"
            )


def load(motion="builtin", rate=CONTROL_RATE, clips="*", split="all", reading=AS_IT_IS) -> list[Clip]:
    """Single clips of a data set, at one rate.

    Args      motion : one of BUILTIN, a .bvh or .amc file, or a folder of them (searched below); or several of these
              with commas between them: each must have what is asked for
              clips : shell pattern on the names, or one of NAMED
              reading : what the user says about joints, unit and axes of BVH files
              split : train | validation | style | body | all.  A folder of fewer than ten files none of whose names is
              in the split is used whole, and says so.  People of UNSEEN are in `body` alone, unless motion holds nobody
              else: then they are meant, are split by their trials for train and validation, and it says so
    Raises    UserError: nothing there, a malformed file, or nothing matches; names what would have been valid
    Test      tests/mocap/test_mocap.py::test_split, ::test_load_errors, ::test_bandai_loads_in_seconds,
              tests/mocap/test_amc.py::test_body_split
    """
    if split not in SPLITS:
        raise UserError(f"split {split!r} is unknown; valid: {', '.join(SPLITS)}")
    if len(sets := parts(motion)) > 1:
        check_unseen(sets, split)
        return [c for one in sets for c in load(one, rate, clips, split, reading)]
    if motion in BUILTIN:
        items = [(c.name, c.name, c) for c in builtin_clips(rate, name=motion)]
    else:
        path = Path(motion)
        if not path.exists():
            raise UserError(f"{motion}: no such file or folder; valid: {MOTION}")
        files = files_of(path)
        if not files:
            raise UserError(f"{motion}: a folder without motion; valid: one that holds .bvh or .amc files")
        keys = keys_of(path, files)
        if split in ("train", "validation") and all(split_of(k) == "body" for k in keys):
            print(f"{motion}: only people held out as unseen bodies: meant, and split by their trials", file=sys.stderr)
            keys = [k.stem.rpartition("_")[2] for k in keys]
        items = [(f.stem, key, f) for f, key in zip(files, keys, strict=True)]
    asked = NAMED[clips].__contains__ if clips in NAMED else lambda name: fnmatchcase(name, clips)
    matching = [(name, split_of(key), item) for name, key, item in items if asked(name)]
    chosen = [item for _, part, item in matching if split in ("all", part)]
    bodies = sum(part == "body" for _, part, _ in matching)
    if split == "train" and bodies:
        print(f"{motion}: {bodies} clips left out: unseen bodies, split body", file=sys.stderr)
    if not matching:
        names = [name for name, _, _ in items]
        more = f", … ({len(names)})" if len(names) > 6 else ""
        raise UserError(f"{motion}: no clip matches {clips!r}; there are {', '.join(names[:6])}{more}")
    if not chosen and motion not in BUILTIN and len(files) < 10 and split not in ("style", "body") and not bodies:
        print(
            f"{motion}: only {len(files)} clip{'s' * (len(files) > 1)}, none to hold out: {split} uses all of them",
            file=sys.stderr,
        )
        chosen = [item for _, _, item in matching]
    if not chosen:
        found = sorted({part for _, part, _ in matching})
        raise UserError(
            f"{motion}: none of the {len(matching)} clips that match {clips!r} is in split {split!r}; "
            f"they are in {' and '.join(found)}; valid: --all or --split, a clip whose number ends in 5, or folders "
            "called train and validation (mocap/README.md)"
        )
    if motion in BUILTIN:
        return chosen
    return [resample(clip, rate) for clip in read_clips(chosen, reading, files)]


def sequences(
    motion="builtin", split="train", clips="*", rate=CONTROL_RATE, seed=0, limit=0.15, verbose=True, reading=AS_IT_IS
) -> list[Clip]:
    """Stitched sequences of a data set: what training and measuring use.  Test:
    tests/mocap/test_mocap.py::test_sequences.

    Of several sets each is stitched by itself.
    A set of which nothing can be joined into a sequence comes back as its single clips, and says so; one clip alone,
    a user's recording, is not looped.
    """
    if len(sets := parts(motion)) > 1:
        check_unseen(sets, split)
        return [c for one in sets for c in sequences(one, split, clips, rate, seed, limit, verbose, reading)]
    return stitched(load(motion, rate, clips, split, reading), f"{motion} [{split}]", seed, limit, verbose)


def stitched(single, title, seed=0, limit=0.15, verbose=True) -> list[Clip]:
    """Single clips joined into sequences, with a line under the title: what `sequences` makes of one set.

    Test      tests/mocap/test_mocap.py::test_sequences"""
    if len(single) == 1:
        if verbose:
            print(f"{title} one clip, {single[0].seconds:.1f} s, as it is")
        return list(single)
    out, report = stitch(single, np.random.default_rng(seed), limit=limit)
    if verbose:
        result = str(report) if out else "too few to join: single clips are used"
        print(f"{title} {len(single)} clips, {sum(c.seconds for c in single) / 60:.1f} min -> {result}")
    return out or list(single)


def from_bvh(path, reading=AS_IT_IS) -> Clip:
    """Read a BVH as the canonical human, at the file's own rate.

    Symbols   p = u·P(p_file), q = q_up q_file C: unit u, axes P and q_up, calibration C of the rig
    Frame     world, floor at z = 0, metres
    Raises    UserError: cannot be opened, not a BVH, or a skeleton that neither is known nor can be guessed
    Test      tests/mocap/test_mocap.py::test_bvh_against_scipy, ::test_root_offset
    """
    return read_clips([path], reading)[0]


SAMPLE = 20  # files of a folder from which an unknown rig is measured, evenly spread over the names


def read_clips(paths, reading=AS_IT_IS, among=None) -> list[Clip]:
    """Read files; an unknown rig is guessed and measured once for all files that share a skeleton, and printed.

    Args      among : the folder's files, from which it is measured whatever is read: the parts of a split must not
              see different axes.  Default: paths
    Raises    UserError: as `from_bvh`, `from_amc`
    Test      tests/mocap/test_rigs.py::test_folder_is_measured_once
    """
    among = list(among or paths)
    measured, sampled = {}, None
    out = []
    for path in paths:
        if is_amc(path):
            out.append(from_amc(path, reading))
            continue
        b = read(path, reading)
        if not reading.joint_map and known_rig(b):
            out.append(canonical(b, *rig_for(b, reading), reading))
            continue
        key = _skeleton(b)
        if key not in measured:
            if sampled is None:
                files = [f for f in among if not is_amc(f)]
                chosen = files[:: -(-len(files) // SAMPLE)]
                sampled = [s for s in (_read_or_none(f, reading) for f in chosen) if s]
            measured[key] = rig_for(b, reading, [s for s in sampled if _skeleton(s) == key] or [b])
        out.append(canonical(b, *measured[key], reading))
    return out


def _skeleton(b):
    """What files of one skeleton have in common: all but the root's OFFSET."""
    ends = tuple((n, *np.round(v, 3)) for n, v in b.end_sites.items())
    return b.names, tuple(b.parents), np.round(b.offsets[1:], 3).tobytes(), ends


def _read_or_none(path, reading):
    try:
        return read(path, reading, quiet=True)
    except UserError:
        return None  # told when it is its turn


def rig_for(b: bvh.Bvh, reading=AS_IT_IS, group=None):
    """(Rig, its name) of a file: known, or guessed and measured over a group of files of the same skeleton.

    Test      tests/mocap/test_rigs.py::test_any_rig, ::test_overrides
    """
    known = None if reading.joint_map else known_rig(b)
    if not known:
        return unknown_rig(b, group or [b], reading)
    rig, unit, up = RIGS[known], checked_unit("--unit", reading.unit), reading.up
    return replace(rig, unit=unit or rig.unit, up=up or rig.up), known

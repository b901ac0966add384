r"""Skeleton-aware networks at work: retargeting, measuring, the auto-encoder comparison  [SAN §4.4, §5].

    python -m skeletal train       two structures, unpaired: losses [SAN-3] to [SAN-8]
    python -m skeletal autoencode  §4.4: skeletal against plain temporal convolution, both noises
    python -m skeletal correct     corrections of copies between any real rigs (skeletal/correct.py)
    python -m skeletal retarget    one BVH onto the skeleton of another, or any human onto a trained rig
    python -m skeletal measure     pairs of real rigs, beside copies, inverse kinematics and a constant pose
    python -m skeletal families    the two families' errors beside the copy baselines

`--help` after any of the words lists its settings.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import mocap.data
from mocap.rigs import FLOORS, HELP, REST_POSES, Reading
from plumbing import render
from plumbing.cli import COUNT, POSITIVE, UserError, arg, cli, given_flags
from plumbing.files import atomic_write, check_folders, make_folder
from plumbing.runs import latest_checkpoint, load_checkpoint, versions
from skeletal import correct, data, rigs
from skeletal.autoencode import autoencode
from skeletal.correct import Correction
from skeletal.data import Motion, Skeleton
from skeletal.layers import PLACE, ROOT
from skeletal.measure import measure
from skeletal.net import Generator, carry_root
from skeletal.pictures import draw
from skeletal.train import base_motions, choices_of, domains_from, train

SHIPPED = Path(__file__).resolve().parent / "skeletal.npz"

# ------------------------------------------------------------------------------------ using it


class Retargeter:
    """Trained networks and what they know of two structures.

    Args      path : a run folder or an .npz
    Test      tests/skeletal/test_skeletal_play.py::test_ship_and_load
    """

    def __init__(self, path):
        path = Path(path)
        if path.is_dir():
            found = latest_checkpoint(path, finite=("generator*",))
            if not found:
                raise UserError(f"{path} has no checkpoint; valid: a folder of python -m skeletal train, or an .npz")
            arrays, meta = found
        else:
            arrays, meta = load_checkpoint(path, finite=("generator*",))
        self.meta, self.domains = meta, domains_from(arrays, meta, path)
        rng = np.random.default_rng(0)
        self.choices = choices_of(meta.get("variant", "ours"), meta.get("root", "decoded"))
        self.nets = [Generator(d.parents, rng, self.choices, meta.get("pool", "mean")) for d in self.domains]
        for k, net in enumerate(self.nets):
            theta = arrays[f"generator{k}"]
            if theta.shape != net.theta.shape:
                raise UserError(f"{path}: generator{k} has {theta.size} numbers, expected {net.theta.size}")
            net.theta[:] = theta

    def which(self, names, path) -> int:
        """The structure that has the joints of a file."""
        for k, d in enumerate(self.domains):
            if set(d.names) == set(names):
                return k
        known = "; or ".join(", ".join(d.names) for d in self.domains)
        raise UserError(
            f"{path}: no trained structure has its joints, {', '.join(names)}; valid: {known}; "
            "for another rig train on it (python -m skeletal train --a FOLDER --b FOLDER)"
        )

    def __call__(self, m: Motion, source, target: Skeleton, to) -> Motion:
        r"""[SAN-3] Q~_B = D_B(E_Q^A(S_A, Q_A), E_S^B(S_B)), on a whole clip.

        Args      m : of structure number `source`; target : of structure number `to`
        Returns   Motion of the target, from the same place on the floor in its own legs
        Test      tests/skeletal/test_skeletal_play.py::test_retargeter_any_length
        """
        A, B, G, H = self.domains[source], self.domains[to], self.nets[source], self.nets[to]
        x, turn = data.features(m)
        pad = max(-len(x) % 4, 32 - len(x))  # whole latent frames, and enough of them to reflect
        x = np.concatenate([x, np.repeat(x[-1:], pad, axis=0)])
        mean, std = A.statistics_of(m.skeleton)
        features, _ = G.static_forward(A.static(m.skeleton)[0][:, None])
        z, _ = G.encode_forward(((x - mean) / std).T[..., None].copy(), features)
        features, _ = H.static_forward(B.static(target)[0][:, None])
        y, _ = H.decode_forward(z, features)
        mean, std = B.statistics_of(target)
        if self.choices.carry_root:
            carry_root(y, x.T[..., None], mean[:, None, None], std[:, None, None])
        y = (y[..., 0].T * std + mean)[: len(turn)]
        start = m.pos[0, :2] * (target.leg / m.skeleton.leg)
        return data.from_features(y, turn, target, m.name, start)


@dataclass
class RetargetOptions:
    """One motion onto another skeleton."""

    source: str | None = arg(None, "BVH file to retarget")
    target: str | None = arg(
        None, "a trained rig, as dino, or a BVH file of a body of one (the source is any human that mocap reads); "
        "or A/NUMBER or B/NUMBER: a character of two trained families",
    )  # fmt: skip
    out: str | None = arg(None, "BVH file to write")
    weights: str | None = arg(
        None, ".npz of python -m skeletal correct for a rig, else run folder or .npz of python -m skeletal train; "
        "default: the shipped ones", metavar="FILE",
    )  # fmt: skip
    up: str = arg("y", "axis of files of trained rigs that points up", choices=("x", "y", "z", "-x", "-y", "-z"))
    drop: str = arg("", "joints of files of trained rigs to leave out, as in training")
    unit: str | None = arg(None, f"of the source, onto a rig: {HELP['unit']}")
    rate: float | None = arg(None, f"of the source, onto a rig: {HELP['rate']}")
    floor: str | None = arg(None, f"of the source, onto a rig: {HELP['floor']}", choices=FLOORS)
    rest_pose: str | None = arg(None, f"of the source, onto a rig: {HELP['rest_pose']}", choices=REST_POSES)
    clean: bool = arg(True, "foot clean-up")
    png: str | None = arg(None, "contact sheet of source and result")
    video: str | None = arg(None, "the same as .mp4")
    every: float = arg(0.5, "seconds between the pictures of the sheet", check=POSITIVE)


def retarget(argv) -> int:
    """python -m skeletal retarget.  Test: tests/skeletal/test_skeletal_play.py::test_retarget_command"""
    opt = cli(RetargetOptions, argv, "python -m skeletal retarget", RetargetOptions.__doc__)
    if not opt.source or not opt.target or not (opt.out or opt.png or opt.video):
        raise UserError("give --source FILE.bvh, --target FILE.bvh (or B/0), and --out FILE.bvh, --png or --video")
    check_folders(opt.out, opt.png, opt.video, read=(opt.source, opt.target, opt.weights))
    render.check_video(opt.video)
    in_file, (word, _, number) = opt.target.lower().endswith(".bvh"), opt.target.partition("/")
    family = len(word) == 1 and not in_file
    weights = opt.weights or (SHIPPED if family else correct.SHIPPED)
    if not Path(weights).is_dir() and "rigs" in load_checkpoint(weights)[1]:
        if not in_file and (odd := given_flags(argv) & {"up", "drop"}):
            raise UserError(f"--{', --'.join(sorted(odd))} would do nothing: the source is read as mocap reads it")
        return onto_rig(opt, Correction(weights))
    if odd := given_flags(argv) & {"unit", "rate", "floor", "rest_pose"}:
        raise UserError(f"--{', --'.join(sorted(odd)).replace('_', '-')}: for a target that is a rig, such as dino")
    net = Retargeter(weights)
    patterns = tuple(p for p in opt.drop.split(",") if p)
    up = lambda k: net.domains[k].structure.up  # noqa: E731

    def read(path):
        raw = data.read_rig(path, opt.up, patterns)
        k = net.which(raw.names, path)
        if up(k) != opt.up:  # a trained structure knows its axis
            raw = data.read_rig(path, up(k), patterns)
        return k, data.to_motion(raw, net.domains[k].structure)

    source, m = read(opt.source)
    if family and word in ("A", "B") and number:
        to = "AB".index(word)
        cast = net.domains[to].characters
        if not number.isdigit() or int(number) >= len(cast):
            raise UserError(f"--target {opt.target}: no such character; valid: {word}/0 to {word}/{len(cast) - 1}")
        target = cast[int(number)]
    elif family:
        raise UserError(f"--target {opt.target}: valid: A or B and the number of a character, as B/3, or a .bvh file")
    else:
        to, other = read(opt.target)
        target = other.skeleton
    way = f"structure {'AB'[source]} -> {'AB'[to]}"
    finish(opt, m, net(m, source, target, to), net.domains[to].structure, way, "retargeted")
    return 0


def finish(opt, m, out, structure, way, label, clean=data.clean_feet):
    """Clean the feet if asked to, say how far they slide, and write and draw what is wanted.

    Args      m, out : source and result; structure : to write it with; way : from what to what; label : in pictures;
              clean : function of (result, contacts of the source)
    Test      tests/skeletal/test_skeletal_play.py::test_retarget_command"""
    standing = data.contacts(m)
    before = data.sliding(out, standing)
    if opt.clean:
        out = clean(out, standing)
    after = f"after the clean-up {100 * data.sliding(out, standing):.1f}" if opt.clean else "not cleaned"
    print(f"{opt.source}: {len(m)} frames, {way}; feet slide {100 * before:.1f} cm/s, {after}; "
          f"source {100 * data.sliding(m, standing):.1f}")  # fmt: skip
    if opt.out:
        data.write_motion(opt.out, out, structure)
    if opt.png or opt.video:
        draw([m, out], ["source", label], opt.png, opt.video, opt.every)
    print(*filter(None, (opt.out, opt.png, opt.video)), sep="\n")


def target_body(net: Correction, target, up, drop):
    """(number of the rig, body) of a rig's name, or of a BVH file that has a trained rig's joints: a static skeleton.

    Raises    UserError: neither
    Test      tests/skeletal/test_skeletal_correct.py::test_retarget_to_a_static_skeleton
    """
    if not target.lower().endswith(".bvh"):
        return net.index(target), net.sides[net.index(target)].rig.skeleton
    fits = []
    for k, side in enumerate(net.sides):
        raw = data.read_rig(target, up, (*drop, *rigs.DROPPED.get(side.rig.name, ())))
        if set(raw.names) == set(side.names):
            body = data.to_motion(raw, side.rig.structure).skeleton
            far = min(np.abs(body.offsets / body.leg - b.offsets / b.leg).max() for b in side.bodies)
            fits.append((far, k, body))
    if fits:  # Jesse, Oppy and Dino have the same joints: the one whose proportions are nearest
        return min(fits, key=lambda fit: fit[:2])[1:]
    known = "; or ".join(f"{s.rig.name}: {', '.join(s.names)}" for s in net.sides)
    raise UserError(f"{target}: no trained rig has its joints, {', '.join(raw.names)}; valid: {known}")


def onto_rig(opt, net: Correction) -> int:
    """A file of any rig that mocap can read, by its canonical human, onto a trained rig or a body of one.

    Raises    UserError: a rig that mocap cannot read, or a target that no network was trained for
    Test      tests/skeletal/test_skeletal_correct.py::test_retarget_any_human
    """
    to, body = target_body(net, opt.target, opt.up, tuple(p for p in opt.drop.split(",") if p))
    said = replace(Reading.of(opt), up=None)  # --up is of the target's file
    clip = rigs.at_30(mocap.data.read_clips([opt.source], said)[0])
    source = net.index("human")
    m = data.to_motion(rigs.human_raw(clip), net.sides[source].rig.structure)
    B = net.sides[to].rig
    in_file = replace(B.structure, up="y", unit=0.01)
    clean = lambda out, _: net.clean(out, m, source, to)  # noqa: E731
    finish(opt, m, net(m, source, body, to), in_file, f"human -> {B.name}", B.name, clean)
    return 0


# ------------------------------------------------------------------------------------ measuring


@dataclass
class FamilyOptions:
    """Errors of two trained families on unseen clips of unseen characters."""

    weights: str = arg(str(SHIPPED), "run folder or .npz of python -m skeletal train; more than one, with commas")
    motion: str = arg("builtin", "folder of the recorded rig's BVH files, or builtin")
    clips: str = arg("*", "shell pattern on clip names")
    drop: str = arg("", "joints to leave out, as in training")
    up: str = arg("y", "axis of the files that points up", choices=("x", "y", "z", "-x", "-y", "-z"))
    limit: int = arg(12, "held-out clips at most, evenly chosen", check=COUNT)
    characters: int = arg(2, "unseen characters a structure", check=COUNT)
    seed: int = arg(1, "seed of their proportions")
    png: str | None = arg(None, "folder, made if need be, for contact sheets of source, result and truth")
    sheets: int = arg(3, "clips drawn there", check=COUNT)
    every: float = arg(0.6, "seconds between the pictures of a sheet", check=POSITIVE)
    json: str | None = arg(None, "write the figures here")


LEGEND = """cross, intra: ((p - p_true) / height)^2 x 1000 across the two structures and within them; _clean: after the
foot clean-up; _pose: joints relative to the root; _ab, _ba: from the first structure to the second, back; copy_: the
best of the three copies; slide: mean speed of standing feet [cm/s], retargeted, after the clean-up, and the truth's"""


def families(argv) -> int:
    """python -m skeletal families: errors x 1000.  Test: tests/skeletal/test_skeletal_play.py::test_measure_command"""
    opt = cli(FamilyOptions, argv, "python -m skeletal families", FamilyOptions.__doc__)
    check_folders(opt.json, read=opt.weights.split(","))
    make_folder(opt.png)
    nets = {name: Retargeter(name) for name in opt.weights.split(",")}
    cases = held_out(opt, next(iter(nets.values())))
    results = {"copies": copies(cases), "shifted": shifted(cases, next(iter(nets.values())))}
    for how, row in results["copies"].items():
        print(f"copy ({how})".ljust(15) + "  ".join(f"{k} {v:.3f}" for k, v in row.items()))
    print("copy in the target's statistics  " + "  ".join(f"{k} {v:.3f}" for k, v in results["shifted"].items()))
    best = {k: min(row[k] for row in results["copies"].values()) for k in ("cross", "intra")}
    for name, net in nets.items():
        row = errors(cases, net)
        row |= {"copy_cross": best["cross"], "copy_intra": best["intra"]}
        results[Path(name).stem if Path(name).suffix else Path(name).name] = row
        print(f"{name}\n  " + "  ".join(f"{k} {v:.3f}" for k, v in row.items()))
    print(LEGEND)
    first = next(v for k, v in results.items() if k not in ("copies", "shifted"))
    if opt.png:
        sheets(cases, next(iter(nets.values())), opt)
    if opt.json:
        atomic_write(opt.json, json.dumps(first | {"rows": results, "versions": versions()}, indent=2) + "\n")
    return 0


def held_out(opt, net: Retargeter) -> list:
    """(kind, structure, motion, structure, true motion) of held-out clips on characters nobody trained on.

    Raises    UserError: the motions are not of the structures trained on
    Test      tests/skeletal/test_skeletal_play.py::test_measure_command
    """
    _, motions = base_motions(opt, "validation", opt.limit)
    rng = np.random.default_rng([opt.seed, 12])
    a = motions[0].skeleton
    b = data.derive(a)
    for d, s in zip(net.domains, (a, b)):
        if set(d.names) != set(s.names):
            raise UserError(
                f"{opt.motion}: joints {', '.join(s.names)}; trained on {', '.join(d.names)}; valid: the same"
            )
    cast = [[data.proportions(s, rng) for _ in range(opt.characters)] for s in (a, b)]
    out = []
    for i, m in enumerate(motions):
        true = [[data.truth(m, c) for c in row] for row in cast]
        k, j = i % opt.characters, (i + 1) % opt.characters
        out += [("cross", 0, true[0][k], 1, true[1][j]), ("cross", 1, true[1][k], 0, true[0][j])]
        if opt.characters > 1:
            out += [("intra", 0, true[0][k], 0, true[0][j]), ("intra", 1, true[1][k], 1, true[1][j])]
    return out


def copies(cases) -> dict:
    """The copy baselines' errors x 1000: all three forms, cross and intra.  Test:
    tests/skeletal/test_skeletal_play.py::test_measure_command"""  # noqa: E501
    out = {}
    for how in data.COPIES:
        rows = [
            (kind, 1e3 * data.error(data.copy_rotations(m, true.skeleton, how), true)) for kind, _, m, _, true in cases
        ]
        out[how] = {k: float(np.mean([v for kind, v in rows if kind == k] or [np.nan])) for k in ("cross", "intra")}
    return out


def shifted_copy(net: Retargeter, m: Motion, source, target: Skeleton, to) -> Motion:
    r"""A copy of rotations in the target's statistics: how far the mean poses alone get, without a network.

    Equation  x_c = (copy_c - mean_c^A) / std_c^A std_c^B + mean_c^B for the root's rotation and for joints that both
              have, by name; other joints, the root's path and its height as in the copy
    Args      net : for its statistics; the rest as Retargeter's
    Test      tests/skeletal/test_skeletal_play.py::test_shifted_copy
    """
    A, B = net.domains[source], net.domains[to]
    copy = data.copy_rotations(m, target, "global")
    x, turn = data.features(copy)
    (mean_a, std_a), (mean_b, std_b) = A.statistics_of(m.skeleton), B.statistics_of(target)
    at = {n: j for j, n in enumerate(A.names)}
    pairs = [(slice(PLACE, ROOT),) * 2]
    pairs += [(slice(3 + 4 * at[n], 7 + 4 * at[n]), slice(3 + 4 * j, 7 + 4 * j))
              for j, n in enumerate(B.names) if j and at.get(n)]  # fmt: skip
    for a, b in pairs:
        x[:, b] = (x[:, b] - mean_a[a]) / std_a[a] * std_b[b] + mean_b[b]
    return data.from_features(x, turn, target, m.name, copy.pos[0, :2])


def shifted(cases, net) -> dict:
    """Errors x 1000 of `shifted_copy`, cross and intra.

    Test      tests/skeletal/test_skeletal_play.py::test_measure_command"""
    rows = [(kind, 1e3 * data.error(shifted_copy(net, m, a, true.skeleton, b), true)) for kind, a, m, b, true in cases]
    return {k: float(np.mean([v for kind, v in rows if kind == k] or [np.nan])) for k in ("cross", "intra")}


def sheets(cases, net, opt):
    """Contact sheets of cross retargetings, evenly chosen: source, result after the clean-up, truth.

    Raises    UserError: no OpenGL
    Test      tests/skeletal/test_skeletal_play.py::test_sheets"""
    cross = [c for c in cases if c[0] == "cross"]
    for i in np.unique(np.linspace(0, len(cross) - 1, opt.sheets).astype(int)):
        _, a, m, b, true = cross[i]
        out = data.clean_feet(net(m, a, true.skeleton, b), data.contacts(m))
        path = Path(opt.png) / f"{m.name}-{'AB'[a]}{'AB'[b]}.png"
        draw([m, out, true], ["source", "retargeted", "truth"], path, None, opt.every, (0, 1, 1))


def errors(cases, net) -> dict:
    """Errors x 1000 of trained networks, before and after the clean-up, with the root's drift and without it; and how
    fast standing feet slide [cm/s].  Test: tests/skeletal/test_skeletal_play.py::test_measure_command"""
    sums = {}
    for kind, source, m, to, true in cases:
        got = net(m, source, true.skeleton, to)
        standing = data.contacts(m)
        clean = data.clean_feet(got, standing)
        row = {kind: 1e3 * data.error(got, true), f"{kind}_clean": 1e3 * data.error(clean, true),
               f"{kind}_pose": 1e3 * data.error(got, true, root=False),
               f"{kind}_ab" if source == 0 else f"{kind}_ba": 1e3 * data.error(got, true),
               "slide": 100 * data.sliding(got, standing), "slide_clean": 100 * data.sliding(clean, standing),
               "slide_true": 100 * data.sliding(true, standing)}  # fmt: skip
        for k, v in row.items():
            sums.setdefault(k, []).append(v)
    return {k: float(np.mean(v)) for k, v in sums.items()}


# ------------------------------------------------------------------------------------ command line

COMMANDS = {"train": train, "correct": correct.correct, "autoencode": autoencode, "retarget": retarget,
            "measure": measure, "families": families}  # fmt: skip


def main(argv=None) -> int:
    """The first word says which; the rest is that command's.  Test: tests/skeletal/test_skeletal_play.py::test_help"""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv and argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    if not argv or argv[0] not in COMMANDS:
        given = f"unknown command {argv[0]!r}" if argv else "no command"
        raise UserError(f"python -m skeletal: {given}; valid: {', '.join(COMMANDS)}, each with --help")
    return COMMANDS[argv[0]](argv[1:])

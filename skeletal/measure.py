r"""What is gained over a copy: pairs of real rigs, on clips that no network saw.

The truth is `skeletal.rigs.put_on`'s, which no network and no inverse kinematics here made.  Every row gets the same
source motion and the same target body.  `copy`: rotations against the reference pose, where the correction starts;
`shifted_copy`: the same in the target's statistics; `ik`: the copy with its limbs bent to the source's ends;
`mean_pose`: the target's mean pose, carried along the path.  All carry the root's path in the target's legs.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import mocap.data
from plumbing.cli import COUNT, POSITIVE, UserError, arg, cli
from plumbing.files import atomic_write, check_folders, make_folder
from plumbing.runs import versions
from skeletal import data, rigs
from skeletal.correct import LAFAN_TRAIN, SHIPPED, Correction, bases_of, limbs
from skeletal.data import RATE, Motion
from skeletal.pictures import draw

ROWS = ("network", "network_clean", "shifted_copy", "copy", "ik", "mean_pose", "truth")
METRICS = ("joint", "ee", "slide_cm_s", "float_cm")
FRAMES = 150  # of a clip, at most
LEGEND = """joint: ((p - p_true) / height)^2 x 1000, relative to the root; ee: distance of the ends of arms, legs and
head from the truth's, relative to the root, in lengths of the limb; slide_cm_s: mean speed of the feet that stand in
the source; float_cm: how far above or below the truth's their ends are.  Four figures a row, in this order"""


@dataclass
class MeasureOptions:
    """Errors on unseen clips of pairs of real rigs, beside copies, inverse kinematics and a constant pose."""

    weights: str = arg(str(SHIPPED), ".npz of python -m skeletal correct; several seeds with commas", metavar="FILES")
    motion: str | None = arg(None, "folder that holds bandai, lafan1, cmu; left out: the built-in human on all others")
    limit: int = arg(3, "clips a pair at most", check=COUNT)
    json: str | None = arg(None, "write the figures here")
    png: str | None = arg(None, "folder, made if need be, for a sheet a pair: source, result over truth")
    every: float = arg(0.6, "seconds between the pictures of a sheet", check=POSITIVE)


def unseen(name, opt) -> list:
    """Canonical clips of held-out captures of a rig, with their own motions: (rig, pairs) or None without captures.

    Test      tests/skeletal/test_skeletal_correct.py::test_measure"""
    if name == "human":
        clips = [c for c in mocap.data.load("builtin", RATE, split="validation") if len(c) >= 64][: opt.limit]
        return rigs.load(name, [], [c[:FRAMES] for c in clips])
    if opt.motion is None or name in rigs.CHARACTERS:
        return None
    root = Path(opt.motion)
    if name == "lafan1":
        rig, [(m, c)] = rigs.load(name, [root / "lafan1" / "walk4_subject1.bvh"])
        starts = np.linspace(int(LAFAN_TRAIN * len(m)), len(m) - FRAMES, opt.limit).astype(int)
        return rig, [(m[a : a + FRAMES], c[a : a + FRAMES]) for a in starts]
    split, folder = {"bandai": ("validation", "bandai"), "cmu": ("body", "cmu")}[name]
    rig, pairs = rigs.captured(root, folder, name, split, opt.limit)
    return rig, [(m[:FRAMES], c[:FRAMES]) for m, c in pairs]


def cases(net: Correction, opt) -> list:
    """(name of the pair, source, motion, target, true motion) of every unseen clip on every other rig.

    The source's reference pose is the trained one: `rebased` turns its files to that."""
    out, first = [], net.sides[0].rig.skeleton
    for source, A in enumerate(net.sides):
        found = unseen(A.rig.name, opt)
        if found is None:
            continue
        rig, pairs = rigs.in_order(*found, first)
        for m, clip in pairs:
            m = rebased(m, rig.structure, A.rig.structure)
            for target, B in enumerate(net.sides):
                if target != source:
                    true = rigs.put_on(clip, B.rig, B.rig.skeleton)
                    out.append((f"{A.rig.name}-{B.rig.name}", source, m, target, true))
    return out


def rebased(m: Motion, old, new) -> Motion:
    """A motion against another reference pose of the same rig.

    Test      tests/skeletal/test_skeletal_correct.py::test_rebased"""
    return data.to_motion(rigs.raw_of(m, old), new)


def end_error(m: Motion, true: Motion, mask) -> float:
    r"""End effectors' mean distance from the truth's, relative to the root, in lengths of their limbs.

    Equation  mean over frames and ends of |(p_e - p_0) - (p_e - p_0)^true| / l_e
    Args      mask : (E, J) `skeletal.correct.limbs`
    Test      tests/skeletal/test_skeletal_correct.py::test_end_error
    """
    p, q = data.pose(m)[0], data.pose(true)[0]
    ends = true.skeleton.graph.leaves
    length = mask @ np.linalg.norm(true.skeleton.offsets, axis=1)
    d = (p[:, ends] - p[:, :1]) - (q[:, ends] - q[:, :1])
    return float(np.mean(np.linalg.norm(d, axis=-1) / length))


def floating(m: Motion, true: Motion, standing) -> float:
    """Mean distance in height of the feet's ends from the truth's, while they stand in the source [m].

    Test      tests/skeletal/test_skeletal_correct.py::test_results_stand_on_the_floor"""
    feet = list(m.skeleton.feet)
    d = data.pose(m)[0][:, feet, 2] - data.pose(true)[0][:, feet, 2]
    return float(np.abs(d[standing]).mean()) if standing.any() else 0.0


def row(m: Motion, true: Motion, standing, mask) -> dict:
    """The four metrics of one result."""
    values = (1e3 * data.error(m, true, root=False), end_error(m, true, mask),
              100 * data.sliding(m, standing), 100 * floating(m, true, standing))  # fmt: skip
    return dict(zip(METRICS, values))


def baselines(net: Correction, case) -> dict:
    """Rows without a network."""
    _, source, m, target, true = case
    B = net.sides[target]
    standing, mask = data.contacts(m), limbs(B.names, B.rig.skeleton, bases_of(B.rig))
    shifted = net(m, source, true.skeleton, target, correct=False)
    x, turn = data.features(shifted)
    x[:, 3:] = B.mean[3:]
    still = data.from_features(x, turn, true.skeleton, m.name, shifted.pos[0, :2])
    made = {"shifted_copy": shifted, "copy": rigs.copied(m, true.skeleton), "ik": rigs.solved(m, true.skeleton),
            "mean_pose": still, "truth": true}  # fmt: skip
    return {k: row(v, true, standing, mask) for k, v in made.items()}


def network_rows(net: Correction, case) -> dict:
    """Rows of one network, before and after the clean-up."""
    _, source, m, target, true = case
    B = net.sides[target]
    standing, mask = data.contacts(m), limbs(B.names, B.rig.skeleton, bases_of(B.rig))
    got = net(m, source, true.skeleton, target)
    return {"network": row(got, true, standing, mask),
            "network_clean": row(net.clean(got, m, source, target), true, standing, mask)}  # fmt: skip


def averaged(rows) -> dict:
    """Mean of dicts of rows of metrics."""
    return {k: {v: float(np.mean([r[k][v] for r in rows])) for v in METRICS} for k in rows[0]}


def sheets(net: Correction, found, opt):
    """One contact sheet a pair: the source, and the result after the clean-up over the truth.

    Raises    UserError: no OpenGL"""
    drawn = set()
    for name, source, m, target, true in found:
        if name not in drawn:
            drawn.add(name)
            got = net.clean(net(m, source, true.skeleton, target), m, source, target)
            path, labels = Path(opt.png) / f"{name}.png", ["source", "cleaned", "truth"]
            draw([m, got, true], labels, path, None, opt.every, (0, 1, 1))


def table(nets, found) -> dict:
    """All pairs: rows averaged over clips and, for networks, over seeds; and each seed's own."""
    out = {}
    for case in found:
        base = baselines(nets[0], case)
        own = [network_rows(net, case) for net in nets]
        out.setdefault(case[0], []).append((case, base, own))
    pairs, seeds = {}, {}
    for name, kept in out.items():
        each = [averaged([own[k] for _, _, own in kept]) for k in range(len(nets))]
        pairs[name] = {k: v for k, v in (averaged(each) | averaged([b for _, b, _ in kept])).items()}
        pairs[name] = {k: pairs[name][k] for k in ROWS}
        seeds[name] = each
    return {"pairs": pairs, "seeds": seeds}


def summary(pairs) -> dict:
    """Means over pairs, and what the network gains on the shifted copy."""
    out = averaged(list(pairs.values()))
    gain = {k: 1.0 - out["network"][k] / out["shifted_copy"][k] for k in METRICS}
    ahead = {k: sum(p["network"][k] < p["shifted_copy"][k] for p in pairs.values()) for k in METRICS}
    return {"mean": out, "gain": gain, "ahead": ahead, "of": len(pairs)}


def measure(argv) -> int:
    """python -m skeletal measure.  Test: tests/skeletal/test_skeletal_correct.py::test_measure"""
    opt = cli(MeasureOptions, argv, "python -m skeletal measure", MeasureOptions.__doc__)
    check_folders(opt.json, read=opt.weights.split(","))
    nets = [Correction(p) for p in opt.weights.split(",")]
    if any(n.names != nets[0].names for n in nets):
        raise UserError(f"--weights {opt.weights}: trained on different rigs; valid: seeds of one training")
    found = cases(nets[0], opt)
    if not found:
        names = ", ".join(nets[0].names)
        raise UserError(f"--weights {opt.weights}: no clip of {names} is at hand; valid: --motion FOLDER")
    make_folder(opt.png)
    result = table(nets, found)
    result |= summary(result["pairs"])
    head = f"{'':22s}" + "".join(f"{r:>32s}" for r in ROWS)
    print(head)
    for name, rows in (*result["pairs"].items(), ("mean", result["mean"])):
        print(f"{name:22s}" + "".join("{:10.2f}{:8.3f}{:8.1f}{:6.1f}".format(*rows[r].values()) for r in ROWS))
    ahead, of = result["ahead"], result["of"]
    gain = ", ".join(f"{k} {100 * v:.0f} % ({ahead[k]} of {of} pairs)" for k, v in result["gain"].items())
    print(f"network below the shifted copy by {gain}")
    print(LEGEND)
    if opt.png:
        sheets(nets[0], found, opt)
    if opt.json:
        atomic_write(opt.json, json.dumps(result | {"versions": versions()}, indent=2) + "\n")
    return 0

r"""Skeleton-aware networks at work: retargeting, measuring, the auto-encoder comparison  [SAN §4.4, §5].

    python -m skeletal train       two structures, unpaired: losses [SAN-3] to [SAN-8]
    python -m skeletal autoencode  §4.4: skeletal against plain temporal convolution, both noises
    python -m skeletal retarget    one BVH onto the skeleton of another
    python -m skeletal measure     errors beside the copy baselines, before and after the foot clean-up

`--help` after any of the four words lists its settings.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from nn import Adam
from plumbing import render
from plumbing.cli import COUNT, NONNEGATIVE, POSITIVE, UserError, arg, cli
from plumbing.files import atomic_write, check_folders
from plumbing.runs import Progress, check_run, latest_checkpoint, load_checkpoint, open_run, save_checkpoint, versions
from skeletal import data
from skeletal.data import Motion, Skeleton
from skeletal.layers import PLACE, ROOT, fk_forward
from skeletal.layers import fk_backward as fk_grad
from skeletal.net import Generator, carry_root, mse
from skeletal.train import WINDOW, Domain, base_motions, choices_of, domains_from, train

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
    target: str | None = arg(None, "BVH file of the skeleton to move, or A/NUMBER or B/NUMBER: a trained character")
    out: str | None = arg(None, "BVH file to write")
    weights: str = arg(
        str(SHIPPED), "run folder or .npz of python -m skeletal train; default: the shipped one, if any", metavar="FILE"
    )
    up: str = arg("y", "axis of the files that points up", choices=("x", "y", "z", "-x", "-y", "-z"))
    drop: str = arg("", "joints to leave out, as in training")
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
    net = Retargeter(opt.weights)
    patterns = tuple(p for p in opt.drop.split(",") if p)
    up = lambda k: net.domains[k].structure.up  # noqa: E731

    def read(path):
        raw = data.read_rig(path, opt.up, patterns)
        k = net.which(raw.names, path)
        if up(k) != opt.up:  # a trained structure knows its axis
            raw = data.read_rig(path, up(k), patterns)
        return k, data.to_motion(raw, net.domains[k].structure)

    source, m = read(opt.source)
    word, _, number = opt.target.partition("/")
    if word in ("A", "B") and number:
        to = "AB".index(word)
        cast = net.domains[to].characters
        if not number.isdigit() or int(number) >= len(cast):
            raise UserError(f"--target {opt.target}: no such character; valid: {word}/0 to {word}/{len(cast) - 1}")
        target = cast[int(number)]
    elif word.isalpha() and len(word) == 1 and number.isdigit():
        raise UserError(f"--target {opt.target}: valid: A or B and the number of a character, as B/3, or a .bvh file")
    else:
        to, other = read(opt.target)
        target = other.skeleton
    out = net(m, source, target, to)
    standing = data.contacts(m)
    before = data.sliding(out, standing)
    if opt.clean:
        out = data.clean_feet(out, standing)
    after = data.sliding(out, standing)
    print(f"{opt.source}: {len(m)} frames, structure {'AB'[source]} -> {'AB'[to]}; feet slide {100 * before:.1f} cm/s, "
          f"after the clean-up {100 * after:.1f}; source {100 * data.sliding(m, standing):.1f}")  # fmt: skip
    if opt.out:
        data.write_motion(opt.out, out, net.domains[to].structure)
    if opt.png or opt.video:
        _pictures([m, out], ["source: blue", "retargeted: orange"], opt.png, opt.video, opt.every)
    print(*filter(None, (opt.out, opt.png, opt.video)), sep="\n")
    return 0


FLOOR = """<mujoco><visual><headlight ambient=".5 .5 .5"/></visual><asset><texture name="g" type="2d" builtin="checker"
rgb1=".85 .87 .9" rgb2=".75 .78 .82" width="256" height="256"/><material name="g" texture="g" texrepeat="1 1"
texuniform="true"/></asset><worldbody><light pos="0 0 5" dir="0 0 -1" directional="true"/><geom type="plane"
size="60 60 .1" material="g"/></worldbody></mujoco>"""
COLOURS = ((0.35, 0.6, 0.9, 1), (0.9, 0.5, 0.2, 1), (0.4, 0.75, 0.4, 1), (0.6, 0.6, 0.6, 1))


def _pictures(motions, labels, png, video, every):
    """Stick figures side by side, each on its own line across the walk, followed by the camera."""
    model = mujoco.MjModel.from_xml_string(FLOOR)
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    poses = [data.pose(m)[0] for m in motions]
    for i, (p, m) in enumerate(zip(poses, motions)):
        p -= np.array([*p[0, 0, :2], np.percentile(p[..., 2].min(axis=1), 5)])
        p *= 1.0 / m.skeleton.leg  # everybody's legs are 1 m long
        p[..., 1] -= 1.1 * (i - 0.5 * (len(poses) - 1))
    count = min(map(len, poses))
    camera = lambda t: _camera(np.mean([p[t, :1] for p in poses], axis=0), 3.2 + 0.6 * len(poses))  # noqa: E731
    scene = render.Scene(model, 480, 360, camera(0), fast=True)

    def frame(t):
        marks = []
        for p, m, c in zip(poses, motions, COLOURS):
            marks += render.stick_figure(p[t], m.skeleton.parents, c, 0.025)
        return scene.frame(physics, camera(t), marks)

    if png:
        times = range(0, count, max(round(every * data.RATE), 1))
        text = [f"{t / data.RATE:.1f} s " + " ".join(labels) for t in times]
        render.write_png(png, render.contact_sheet([frame(t) for t in times], text, 4))
    if video:
        render.write_video(video, (frame(t) for t in range(count)), round(data.RATE))
    scene.close()


def _camera(p, distance):
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [*p[0, :2], 0.8]
    camera.distance, camera.azimuth, camera.elevation = distance, 120, -12
    return camera


# ------------------------------------------------------------------------------------ measuring


@dataclass
class MeasureOptions:
    """Errors on unseen clips of unseen characters."""

    weights: str = arg(str(SHIPPED), "run folder or .npz of python -m skeletal train; more than one, with commas")
    motion: str = arg("builtin", "folder of the recorded rig's BVH files, or builtin")
    clips: str = arg("*", "shell pattern on clip names")
    drop: str = arg("", "joints to leave out, as in training")
    up: str = arg("y", "axis of the files that points up", choices=("x", "y", "z", "-x", "-y", "-z"))
    limit: int = arg(12, "held-out clips at most, evenly chosen", check=COUNT)
    characters: int = arg(2, "unseen characters a structure", check=COUNT)
    seed: int = arg(1, "seed of their proportions")
    png: str | None = arg(None, "folder for contact sheets of source, result and truth")
    sheets: int = arg(3, "clips drawn there", check=COUNT)
    every: float = arg(0.6, "seconds between the pictures of a sheet", check=POSITIVE)
    json: str | None = arg(None, "write the figures here")


LEGEND = """cross, intra: ((p - p_true) / height)^2 x 1000 across the two structures and within them; _clean: after the
foot clean-up; _pose: joints relative to the root; _ab, _ba: from the first structure to the second, back; copy_: the
best of the three copies; slide: mean speed of standing feet [cm/s], retargeted, after the clean-up, and the truth's"""


def measure(argv) -> int:
    """python -m skeletal measure: errors x 1000.  Test: tests/skeletal/test_skeletal_play.py::test_measure_command"""
    opt = cli(MeasureOptions, argv, "python -m skeletal measure", MeasureOptions.__doc__)
    check_folders(opt.json, Path(opt.png) / "sheet.png" if opt.png else None)
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

    Raises    UserError: no such folder, or no OpenGL
    Test      tests/skeletal/test_skeletal_play.py::test_sheets"""
    cross = [c for c in cases if c[0] == "cross"]
    for i in np.unique(np.linspace(0, len(cross) - 1, opt.sheets).astype(int)):
        _, a, m, b, true = cross[i]
        out = data.clean_feet(net(m, a, true.skeleton, b), data.contacts(m))
        path = Path(opt.png) / f"{m.name}-{'AB'[a]}{'AB'[b]}.png"
        _pictures([m, out, true], ["source", "retargeted", "truth"], path, None, opt.every)


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


# ------------------------------------------------------------------------------------ §4.4: two auto-encoders


@dataclass
class AutoOptions:
    """§4.4: skeletal against plain temporal convolution, under two noises."""

    motion: str = arg("builtin", "folder of one rig's BVH files, or builtin")
    clips: str = arg("*", "shell pattern on clip names")
    drop: str = arg("", "joints to leave out with all below them")
    up: str = arg("y", "axis of the files that points up", choices=("x", "y", "z", "-x", "-y", "-z"))
    limit: int = arg(200, "clips at most, evenly chosen", check=COUNT)
    held: int = arg(20, "held-out clips at most", check=COUNT)
    out: str | None = arg(None, "run folder; default runs/autoencode")
    resume: bool = arg(False, "continue: networks that are finished are not trained again")
    steps: int = arg(600, "optimiser steps a network", check=COUNT)
    batch: int = arg(16, "windows a step", check=COUNT)
    lr: float = arg(1e-3, "Adam's learning rate", check=POSITIVE)
    sigma: float = arg(0.01, "standard deviation of the Gaussian noise on quaternions", check=POSITIVE)
    zeros: float = arg(0.05, "share of (joint, frame) pairs set to zero", check=NONNEGATIVE)
    seeds: tuple[int, ...] = arg((0, 1, 2), "one pair of networks each")
    json: str | None = arg(None, "write the table here")


def noisy(x, kind, opt, rng):
    """A window (T, C) with Gaussian noise on its quaternions, or with random (joint, frame) pairs zeroed  [SAN §4.4].

    Test: tests/skeletal/test_skeletal_play.py::test_noise"""
    x = x.copy()
    if kind == "gaussian":
        x[:, 3:] += opt.sigma * rng.standard_normal(x[:, 3:].shape).astype(x.dtype)
    elif kind == "zeros":
        q = x[:, 3:].reshape(len(x), -1, 4)
        q[rng.random(q.shape[:2]) < opt.zeros] = 0.0
        x[:, 3:] = q.reshape(len(x), -1)
    return x


def autoencode(argv) -> int:
    """python -m skeletal autoencode.  Test: tests/skeletal/test_skeletal_play.py::test_autoencode_command"""
    opt = cli(AutoOptions, argv, "python -m skeletal autoencode", AutoOptions.__doc__)
    out = Path(opt.out or "runs/autoencode")
    check_run(out, opt.resume)
    structure, motions = base_motions(opt, "train", opt.limit)
    skeleton = motions[0].skeleton
    domain = Domain([skeleton], [(0, replace(m, skeleton=skeleton)) for m in motions], structure=structure)
    # One deviation for all quaternions: by its own, a joint that hardly moves would see a zero 50 deviations away.
    domain.std[:, 3:] = np.sqrt(np.mean(domain.std[:, 3:] ** 2))
    _, held = base_motions(opt, "validation", opt.held)
    open_run(out, asdict(opt), opt.resume)
    table = {}
    for seed in opt.seeds:
        for kind in ("skeletal", "plain"):
            net = Generator(domain.parents, np.random.default_rng([seed, 1]), plain=kind == "plain")
            path = out / f"{kind}-{seed}.npz"
            if path.exists():
                net.theta[:] = load_checkpoint(path)[0]["theta"]
            else:
                loss = _fit(net, domain, opt, seed, f"{kind} {seed}")
                save_checkpoint(path, {"theta": net.theta}, {"loss": loss})
            for noise in ("clean", "gaussian", "zeros"):
                table[f"{kind}_{noise}_{seed}"] = 1e3 * _rebuild(net, domain, held, noise, opt, seed)
            print(
                "  ".join(f"{n} {table[f'{kind}_{n}_{seed}']:.3f}" for n in ("clean", "gaussian", "zeros")),
                f"({kind}, seed {seed}, {net.n_params} weights)",
            )  # noqa: E501
    for noise in ("clean", "gaussian", "zeros"):
        row = {k: np.mean([table[f"{k}_{noise}_{s}"] for s in opt.seeds]) for k in ("skeletal", "plain")}
        table |= {f"{k}_{noise}": float(v) for k, v in row.items()}
        print(f"{noise:9s} skeletal {row['skeletal']:.3f}  plain {row['plain']:.3f}   ((p - p_true) / height)^2 x 1000")
    if opt.json:
        atomic_write(opt.json, json.dumps(table | {"versions": versions()}, indent=2) + "\n")
    return 0


def _fit(net, domain, opt, seed, label):
    """Train one auto-encoder; the loss is on forward kinematics' positions alone, as in §4.4."""
    rng, adam = np.random.default_rng([seed, 2]), Adam(net.n_params, opt.lr)
    progress, recent = Progress(opt.steps, 0, f"steps {label}"), []
    for step in range(opt.steps):
        adam.lr = opt.lr * (1.0 - 0.9 * step / opt.steps)
        x, turn, who = domain.sample(rng, opt.batch)
        s, off, _, _, mean, std = domain.body(who)
        _, true, _ = fk_forward(x * std + mean, off, domain.parents, turn)
        features, static = net.static_forward(s)
        z, encoded = net.encode_forward(x, features)
        y, decoded = net.decode_forward(z, features)
        _, world, kin = fk_forward(y * std + mean, off, domain.parents, turn)
        loss, dworld = mse(world, true)
        net.grad[:] = 0.0
        dz, df2 = net.decode_backward(std * fk_grad(None, 100.0 * dworld, kin), decoded)
        _, df1 = net.encode_backward(dz, encoded, want_dx=False)
        net.static_backward(df1, df2, static)
        adam.step(net.theta, net.grad)
        recent.append(loss)
        if (step + 1) % 100 == 0 or step + 1 == opt.steps:
            progress.update(step + 1, {"loss": f"{np.mean(recent[-100:]):.3g}"})
    return float(np.mean(recent[-100:]))


def _rebuild(net, domain, held, noise, opt, seed):
    """Mean error of held-out windows whose input is disturbed."""
    rng, out = np.random.default_rng([seed, 3]), []
    skeleton, mean, std = domain.characters[0], domain.mean[0], domain.std[0]
    features, _ = net.static_forward(domain.statics[0][0][:, None])
    for m in held:
        x, turn = data.features(replace(m, skeleton=skeleton))
        for a in range(0, len(x) - WINDOW + 1, WINDOW):
            part = x[a : a + WINDOW]
            z, _ = net.encode_forward((((noisy(part, noise, opt, rng) - mean) / std).T[..., None]).copy(), features)
            y = net.decode_forward(z, features)[0][..., 0].T * std + mean
            got, true = (data.from_features(v, turn[a : a + WINDOW], skeleton) for v in (y, part))
            out.append(data.error(got, true))
    return float(np.mean(out))


# ------------------------------------------------------------------------------------ command line

COMMANDS = {"train": train, "autoencode": autoencode, "retarget": retarget, "measure": measure}


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

r"""Two auto-encoders that denoise: skeletal against plain temporal convolution  [SAN §4.4].

    x + noise ──► E ──► latent ──► D ──► r ──► y = x + noise + r ──► FK ──► positions

Both decoders add to their noisy input.  Without that, a latent a third as large as the input loses 30 to 100 times what
the noise does (skeletal/REPRODUCE.md, part 3).  A joint whose quaternion was zeroed has only r to turn by, since a
quaternion is divided by its length: a small r everywhere fills the gaps and hardly moves the rest.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from nn import Adam
from plumbing.cli import COUNT, NONNEGATIVE, POSITIVE, UserError, arg, cli
from plumbing.files import atomic_write
from plumbing.runs import Progress, check_run, load_checkpoint, open_run, save_checkpoint, versions
from plumbing.training import resumed_options
from skeletal import data
from skeletal.layers import PLACE, fk_forward
from skeletal.layers import fk_backward as fk_grad
from skeletal.net import Generator, mse
from skeletal.train import WINDOW, Domain, base_motions

NOISES = ("clean", "gaussian", "zeros")
EPS = 0.02  # ASSUMED: of the identity, added to every quaternion, so that a zeroed one has a direction to begin with
CLIP = 1.0  # ASSUMED: longest gradient
KINDS = ("skeletal", "plain")
AGAIN = ("held", "seeds", "json", "resume", "out")  # may differ when a run is measured again or gets more seeds
PLAIN = (7, 16)  # channels of the plain one: within 3 % of the skeletal one's weights on Bandai's rig, instead of 10 %


@dataclass
class AutoOptions:
    """§4.4: skeletal against plain temporal convolution, under two noises."""

    motion: str = arg("builtin", "folder of one rig's BVH files, or builtin")
    clips: str = arg("*", "shell pattern on clip names")
    drop: str = arg("", "joints to leave out with all below them")
    up: str = arg("y", "axis of the files that points up", choices=("x", "y", "z", "-x", "-y", "-z"))
    limit: int = arg(200, "clips at most, evenly chosen", check=COUNT)
    held: int = arg(20, "held-out clips at most, of known styles and of an unknown one", check=COUNT)
    out: str | None = arg(None, "run folder; default runs/autoencode")
    resume: bool = arg(False, "continue: networks that are finished are not trained again")
    steps: int = arg(600, "optimiser steps a network at most", check=COUNT)
    minutes: float = arg(1e9, "CPU minutes a network at most: equal time for both", check=POSITIVE)
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


def begun(x):
    """Features whose quaternions all have a direction: EPS of the identity is added; the root's place is as it is."""
    x = x.copy()
    x[..., PLACE::4] += EPS
    return x


def autoencode(argv) -> int:
    """python -m skeletal autoencode.  Test: tests/skeletal/test_skeletal_play.py::test_autoencode_command"""
    opt = cli(AutoOptions, argv, "python -m skeletal autoencode", AutoOptions.__doc__)
    out = Path(opt.out or "runs/autoencode")
    check_run(out, opt.resume)
    if opt.resume:
        opt = resumed_options(replace(opt, out=str(out)), argv, AGAIN)
    structure, motions = base_motions(opt, "train", opt.limit)
    skeleton = motions[0].skeleton
    domain = Domain([skeleton], [(0, replace(m, skeleton=skeleton)) for m in motions], structure=structure)
    # One deviation for all quaternions: by its own, a joint that hardly moves would see a zero 50 deviations away.
    domain.std[:, 3:] = np.sqrt(np.mean(domain.std[:, 3:] ** 2))
    sets = held_out(opt)
    open_run(out, asdict(opt), opt.resume)
    table, curves = {}, {}
    for seed in opt.seeds:
        for kind in KINDS:
            net = network(domain.parents, kind, seed)
            path = out / f"{kind}-{seed}.npz"
            if path.exists():
                arrays, meta = load_checkpoint(path)
                net.theta[:], curve = arrays["theta"], meta["curve"]
            else:
                curve = _fit(net, domain, opt, seed, f"{kind} {seed}")
                save_checkpoint(path, {"theta": net.theta}, {"curve": curve})
            curves[f"{kind}_{seed}"] = curve
            for of, held in sets.items():
                for noise in NOISES:
                    table[f"{of}{kind}_{noise}_{seed}"] = 1e3 * _rebuild(net, domain, held, noise, opt, seed)
                figures = "  ".join(f"{n} {table[f'{of}{kind}_{n}_{seed}']:.4f}" for n in NOISES)
                print(f"{of}{kind}, seed {seed}: {figures} ({net.n_params} weights, {curve[-1][0]} steps)", flush=True)
        for of, held in sets.items():
            for noise in NOISES:
                table[f"{of}input_{noise}_{seed}"] = 1e3 * _rebuild(None, domain, held, noise, opt, seed)
    for of, held in sets.items():
        table[f"{of}mean_pose"] = mean = mean_pose_error(domain, held)
        for noise in NOISES:
            row = {k: float(np.mean([table[f"{of}{k}_{noise}_{s}"] for s in opt.seeds])) for k in ("input", *KINDS)}
            table |= {f"{of}{k}_{noise}": v for k, v in row.items()}
            figures = "  ".join(f"{k} {v:.4f}" for k, v in row.items())
            print(f"{of}{noise}: {figures}  mean pose {mean:.3f}   ((p - p_true) / height)^2 x 1000")
    if opt.json:
        table |= {"curves": curves, "versions": versions()}
        atomic_write(opt.json, json.dumps(table, indent=2) + "\n")
    return 0


def held_out(opt) -> dict:
    """Motions no network was trained on: "" clips of styles it knows, "style_" a style it does not, where there is one.

    Test: tests/skeletal/test_skeletal_play.py::test_autoencode_command"""
    sets = {"": base_motions(opt, "validation", opt.held)[1]}
    try:
        sets["style_"] = base_motions(opt, "style", opt.held)[1]
    except UserError:  # the folder has none
        pass
    return sets


def network(parents, kind, seed) -> Generator:
    """One of the two, its decoder's last layer zero: training begins at the noisy input."""
    plain = kind == "plain"
    more = {"channels": PLAIN} if plain else {}
    net = Generator(parents, np.random.default_rng([seed, 1]), plain=plain, **more)
    W, V, b = net.params[net.d[1]]
    for a in (*W, *V, b):
        a[...] = 0.0
    return net


def _fit(net, domain, opt, seed, label):
    """Train one; the loss is on forward kinematics' positions alone, as in §4.4.  -> (step, CPU s, loss) rows"""
    rng, adam = np.random.default_rng([seed, 2]), Adam(net.n_params, opt.lr)
    progress, recent, curve, begin = Progress(opt.steps, 0, f"steps {label}"), [], [], time.process_time()
    for step in range(opt.steps):
        spent = time.process_time() - begin
        if spent > 60 * opt.minutes:
            break
        adam.lr = opt.lr * (1.0 - 0.9 * max(step / opt.steps, spent / (60 * opt.minutes)))
        x, turn, who = domain.sample(rng, opt.batch)
        s, off, _, _, mean, std = domain.body(who)
        true_x = x * std + mean
        noises = [NOISES[i] for i in rng.integers(len(NOISES), size=opt.batch)]
        dirty = np.stack([noisy(true_x[..., b].T, k, opt, rng) for b, k in enumerate(noises)], axis=-1)  # (T, C, B)
        dirty = np.ascontiguousarray(dirty.transpose(1, 0, 2))
        _, true, _ = fk_forward(true_x, off, domain.parents, turn)
        features, static = net.static_forward(s)
        z, encoded = net.encode_forward((dirty - mean) / std, features)
        r, decoded = net.decode_forward(z, features)
        r[:PLACE] = 0.0
        y = np.moveaxis(begun(np.moveaxis(dirty, 0, -1)), -1, 0) + std * r
        _, world, kin = fk_forward(np.ascontiguousarray(y), off, domain.parents, turn)
        loss, dworld = mse(world, true)
        net.grad[:] = 0.0
        dr = std * fk_grad(None, 100.0 * dworld, kin)
        dr[:PLACE] = 0.0
        dz, df2 = net.decode_backward(dr, decoded)
        _, df1 = net.encode_backward(dz, encoded, want_dx=False)
        net.static_backward(df1, df2, static)
        norm = np.linalg.norm(net.grad)  # a zeroed quaternion of small r has a steep direction
        net.grad *= min(1.0, CLIP / max(norm, 1e-12))
        adam.step(net.theta, net.grad)
        recent.append(loss)
        if (step + 1) % 50 == 0 or step + 1 == opt.steps:
            curve.append([step + 1, round(spent, 1), float(np.mean(recent[-50:]))])
            progress.update(step + 1, {"loss": f"{curve[-1][2]:.3g}"})
    return curve


def _rebuild(net, domain, held, noise, opt, seed):
    """Mean error of held-out windows whose input is disturbed; without a network, of the input itself."""
    rng, out = np.random.default_rng([seed, 3]), []
    skeleton, mean, std = domain.characters[0], domain.mean[0], domain.std[0]
    features = net and net.static_forward(domain.statics[0][0][:, None])[0]
    for m in held:
        x, turn = data.features(replace(m, skeleton=skeleton))
        for a in range(0, len(x) - WINDOW + 1, WINDOW):
            part = x[a : a + WINDOW]
            dirty = noisy(part, noise, opt, rng)
            y = dirty + identity_where_zero(dirty)
            if net:
                z, _ = net.encode_forward((((dirty - mean) / std).T[..., None]).copy(), features)
                r = net.decode_forward(z, features)[0][..., 0].T * std
                r[:, :PLACE] = 0.0
                y = begun(dirty) + r
            got, true = (data.from_features(v, turn[a : a + WINDOW], skeleton) for v in (y, part))
            out.append(data.error(got, true))
    return float(np.mean(out))


def identity_where_zero(x):
    """What the noisy input itself is measured with: a quaternion of length zero is no rotation, so it does not turn."""
    q = x[:, PLACE:].reshape(len(x), -1, 4)
    out = np.zeros_like(x)
    out[:, PLACE::4] = (q == 0.0).all(axis=-1)
    return out


def mean_pose_error(domain, held) -> float:
    """Error x 1000 of the training set's mean pose, carried along the path: a constant instead of a network."""
    skeleton, out = domain.characters[0], []
    for m in held:
        m = replace(m, skeleton=skeleton)
        x, turn = data.features(m)
        x[:, 3:] = domain.mean[0][3:]
        out.append(data.error(data.from_features(x, turn, skeleton, start=m.pos[0, :2]), m))
    return 1e3 * float(np.mean(out))

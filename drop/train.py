r"""Train, measure and ship DROP's learned priors  [DROP §5, §7].

    python -m drop train --motion FOLDER --out runs/prior     (--resume goes on exactly)
    python -m drop evaluate --motion FOLDER                   reconstruction of held-out clips, calibration
    python -m drop rollout --motion FOLDER --frames 10000     the prior alone and inside DROP, on the manifold?
    python -m drop ship --out runs/prior --weights mine.npz   write them, with their data's licence

Training goes by rollouts of K frames from a random frame of the train clips: scheduled sampling feeds the networks
their own output, ever more often (HuMoR's way), and a share of the states is disturbed as pushes would.  A state that
has left the recording by d aims at the recording's next frame plus (1 − β) d: at the recorded change, and back by β.
Gradients do not flow from a frame to the one before.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drop import body, simulator, vae
from drop.body import FEET, STEP, N
from drop.keyposes import rises
from drop.prior import WEIGHTS, NearestPrior, PoseRange, VaePrior, contacts_of, load_networks, pose_angles
from drop.simulator import Simulator
from mocap import data
from nn import Adam, clip_grad_norm
from plumbing.cli import COUNT, NONNEGATIVE, POSITIVE, UNIT, UserError, arg, cli
from plumbing.runs import (
    CHECKPOINT,
    Journal,
    Means,
    Progress,
    check_run,
    git_state,
    latest_checkpoint,
    rng_from_state,
    rng_state,
    save_checkpoint,
    stored_options,
    versions,
)
from plumbing.training import resumed_options

NORM_LIMIT = 5e3  # of a gradient: far above a usual one, so that only accidents are cut
SIZES = ("latent", "hidden", "pose_latent", "pose_hidden")
COUNT_SHOWN = 25  # rollouts a printed line
AGAIN = ("updates", "checkpoint_minutes", "resume", "out")  # may differ when a run goes on


@dataclass
class Options:
    """What to train on, and how.  Everything here is ASSUMED: DROP takes its priors ready made."""

    motion: str = arg("builtin", data.MOTION)
    clips: str = arg("*", "shell pattern on clip names")
    out: str = arg("runs/drop_prior", "run folder")
    resume: bool = arg(False, "continue the run in --out exactly")
    init: str | None = arg(None, "begin with this file's networks, at its count of updates; fresh moments")
    updates: int = arg(7_000, "updates of the motion VAE; the pose VAE has half", check=POSITIVE)
    batch: int = arg(192, "transitions an update", check=COUNT)
    rollout: int = arg(8, "frames K of a rollout, an update each", check=COUNT)
    latent: int = arg(32, "entries of the motion prior's z", check=COUNT)
    hidden: int = arg(384, "units of the decoder's layers; the encoders have half", check=COUNT)
    pose_latent: int = arg(24, "entries of the pose VAE's z", check=COUNT)
    pose_hidden: int = arg(192, "units of the pose VAE's layers", check=COUNT)
    lr: float = arg(1e-3, "Adam's step at first; it falls to a hundredth as a half cosine", check=POSITIVE)
    kl: float = arg(0.5, "weight of the KL divergence, grown from 0 in the first fifth", check=NONNEGATIVE)
    beta: float = arg(0.2, "share of a deviation that the target takes back in a frame", check=UNIT)
    rises: int = arg(0, "how many times the eight built-in get-ups are among the clips", check=NONNEGATIVE)
    seed: int = arg(0, "seed of weights, batches and noise", check=NONNEGATIVE)
    checkpoint_minutes: float = arg(2.0, "minutes between checkpoints", check=NONNEGATIVE)
    frames: int = arg(10_000, "rollout: frames", check=POSITIVE)
    weights: str = arg(str(WEIGHTS), "evaluate, rollout: which weights; ship: where to")


# ------------------------------------------------------------------------------------ data


class Recording:
    r"""Frames of many clips in one array.

    Args      clips : list of (x (T, 22, 3), quat (T, 22, 4))
    Symbols   x (F, 22, 3), columns (F, 22, 2, 3), contacts (F, 4) of FEET, float32; `starts(K)`: frames with one before
              and K after
    Test      tests/drop/test_drop_vae.py::test_recording
    """

    def __init__(self, clips):
        clips = [(x, q) for x, q in clips if len(x) > 2]
        if not clips:
            raise UserError("no clip has three frames or more: give longer ones")
        self.x = np.concatenate([x for x, _ in clips]).astype(np.float32)
        self.columns = np.concatenate([vae.columns_of(q) for _, q in clips]).astype(np.float32)
        self.contacts = np.concatenate([contacts_of(x) for x, _ in clips]).astype(np.float32)
        self.lengths = [len(x) for x, _ in clips]

    def starts(self, K):
        """Frames t such that t − 1 to t + K are of one clip."""
        first = np.cumsum([0, *self.lengths[:-1]])
        found = [np.arange(a + 1, a + n - K) for a, n in zip(first, self.lengths) if n > K + 1]
        if not found:
            raise UserError(f"no clip has {K + 2} frames: give longer ones, or a smaller --rollout")
        return np.concatenate(found)

    def at(self, frames, flip):
        """x, columns of frames (B,), of the mirror image where flip (B,)."""
        x, columns = self.x[frames], self.columns[frames]
        mx, mc = vae.mirrored(x, columns)
        return np.where(flip[:, None, None], mx, x), np.where(flip[:, None, None, None], mc, columns)

    def contacts_at(self, frames, flip):
        """Contacts (B, 4) of frames (B,), of the mirror image where flip (B,)."""
        c = self.contacts[frames]
        return np.where(flip[:, None], c[:, [2, 3, 0, 1]], c)


def recorded(motion, split, clips="*", stitched=True, verbose=True):
    """Clips of a split as (x, quat); train clips stitched into sequences.

    Test: tests/drop/test_drop_vae.py::test_recording"""
    if stitched:
        found = data.sequences(motion, split, clips, 1 / STEP, verbose=verbose)
    else:
        found = data.load(motion, 1 / STEP, clips, split)
    return [body.character_motion(c) for c in found if len(c) > 2]


def held_out(sets, clips="*"):
    """Validation clips of those of the sets that have some.

    Raises    UserError: none has
    Test      tests/drop/test_drop_vae.py::test_recording"""
    found, problem = [], None
    for one in sets:
        try:
            found += recorded(one, "validation", clips, stitched=False)
        except UserError as none:
            problem = none
    if not found and problem:
        raise problem
    return found


def transition(recording, frames, flip, x, columns, v, beta):
    r"""What a batch of states, on the recording or beside it, should lead to.

    Equation  target = recorded next frame + (1 − β) (state − recorded state), each in its own heading frame; nothing
              pulls at place and heading
    Args      recording : Recording; frames, flip (B,); x, columns, v : world states
    Returns   (state vector, height, columns, target x, columns, contacts) for MotionVAE.loss; frame of the state;
              the recorded x and columns, now and next, world
    Test      tests/drop/test_drop_vae.py::test_transition
    """
    now, after = recording.at(frames, flip), recording.at(frames + 1, flip)
    cx, cc, cv, frame = vae.canonical(x, columns, v)
    nx, nc, _, there = vae.canonical(*now, now[0])
    ax, ac, _, _ = vae.canonical(*after, after[0], there)
    keep = np.float32(1.0 - beta)
    batch = vae.state_vector(cx, cc, cv), cx[:, 0, 2], cc, ax + keep * (cx - nx), ac + keep * (cc - nc)
    return (*batch, recording.contacts_at(frames + 1, flip)), frame, now, after


# ------------------------------------------------------------------------------------ training


class Trainer:
    """Both networks, their optimisers and the random state.

    Test      tests/drop/test_drop_vae.py::test_training_resumes"""

    def __init__(self, opt, recording):
        self.opt, self.recording, self.updates = opt, recording, 0
        self.starts = recording.starts(opt.rollout)
        self.rng = np.random.default_rng([opt.seed, 1])
        motion, pose = self._statistics(np.random.default_rng([opt.seed, 2]))
        rng = np.random.default_rng([opt.seed, 3])
        self.motion = vae.MotionVAE(opt.latent, opt.hidden, motion, rng)
        self.pose = vae.PoseVAE(opt.pose_latent, opt.pose_hidden, pose, rng)
        self.nets = vae.networks(self.motion, self.pose)
        self.adam = {k: Adam(net.n_params, opt.lr) for k, net in self.nets.items()}

    def _statistics(self, rng, n=20_000, floor=0.02):
        """Means and standard deviations of states and residuals, disturbed ones among them, and of poses."""
        states, residuals, poses = [], [], []
        for _ in range(0, n, 1000):
            frames, flip = rng.choice(self.starts, 1000), rng.random(1000) < 0.5
            x, columns, v = self._begin(frames, flip, rng)
            (s, height, columns, tx, tc, _), _, _, _ = transition(
                self.recording, frames, flip, x, columns, v, self.opt.beta
            )
            move = tx[:, 0] - np.stack([0 * height, 0 * height, height], axis=1)
            states.append(s)
            residuals.append(np.concatenate([move, (tc - columns).reshape(len(s), -1)], axis=1))
            C, _ = vae.gram_schmidt_forward(self.recording.at(frames, flip)[1])
            poses.append(vae.pose_columns(C).reshape(len(s), -1))
        s, r, p = map(np.concatenate, (states, residuals, poses))
        spread = lambda a, least: np.maximum(a.std(axis=0), least)  # noqa: E731
        motion = {
            "mean": s.mean(axis=0),
            "std": spread(s, floor),
            "scale": spread(r, floor / 4),
            "offset": r.mean(axis=0),
        }
        return motion, {"mean": p.mean(axis=0), "std": spread(p, floor)}

    def _begin(self, frames, flip, rng):
        (before, _), (x, columns) = self.recording.at(frames - 1, flip), self.recording.at(frames, flip)
        return vae.disturbed(x, columns, (x - before) / np.float32(STEP), rng)

    def schedule(self):
        """Learning rate, KL weight and share of rows that go on from their own output, for this update.

        Test: tests/drop/test_drop_vae.py::test_training_learns"""
        done = self.updates / self.opt.updates
        lr = self.opt.lr * (0.01 + 0.99 * 0.5 * (1.0 + np.cos(np.pi * min(done, 1.0))))
        return lr, self.opt.kl * min(done / 0.2, 1.0), float(np.clip((done - 0.1) / 0.3, 0.0, 0.95))

    def iterate(self):
        """One rollout: K updates.  Returns the means of the loss's parts."""
        opt, rng = self.opt, self.rng
        frames, flip = rng.choice(self.starts, opt.batch), rng.random(opt.batch) < 0.5
        x, columns, v = self._begin(frames, flip, rng)
        sums = {}
        for k in range(opt.rollout):
            lr, kl, own = self.schedule()
            batch, frame, now, after = transition(self.recording, frames + k, flip, x, columns, v, opt.beta)
            eps = rng.standard_normal((opt.batch, opt.latent)).astype(np.float32)
            parts, grads, nx, C = self.motion.loss(*batch, eps, kl)
            pose_parts, pose_grads = self._pose_loss(now, kl) if k % 2 == 0 else ({}, {})  # an easier task
            if own > 0:  # half of what goes on by itself comes from a sample of the prior, as in use
                nx, C = self._sampled(batch, nx, C)
            self._step(
                {f"motion.{n}": g for n, g in grads.items()} | {f"pose.{n}": g for n, g in pose_grads.items()}, lr
            )
            for name, value in (parts | {f"pose_{n}": p for n, p in pose_parts.items()}).items():
                sums.setdefault(name, []).append(value)
            there = vae.to_world(nx, np.ascontiguousarray(C[..., :2, :]), frame)
            alone = rng.random(opt.batch) < own
            moved = np.where(alone[:, None, None], there[0] - x, after[0] - now[0])
            x = np.where(alone[:, None, None], there[0], after[0])
            columns = np.where(alone[:, None, None, None], there[1], after[1])
            v = moved / np.float32(STEP)
            self.updates += 1
        return {name: float(np.mean(values)) for name, values in sums.items()}

    def _sampled(self, batch, x, C):
        state, height, columns = batch[:3]
        half = len(state) // 2
        s = self.motion.normalise(state[:half])
        mu, log_std, _ = self.motion.gaussian("prior", s)
        z = mu + np.exp(log_std) * self.rng.standard_normal(mu.shape).astype(np.float32)
        sx, sC, _ = self.motion.decode(s, z, height[:half], columns[:half])
        return np.concatenate([sx, x[half:]]), np.concatenate([sC, C[half:]])

    def _pose_loss(self, now, kl):
        C, _ = vae.gram_schmidt_forward(now[1])
        x = np.matmul(now[0] - now[0][:, :1], np.swapaxes(C[:, 0], -1, -2))
        eps = self.rng.standard_normal((len(x), self.opt.pose_latent)).astype(np.float32)
        return self.pose.loss(vae.pose_columns(C), x, eps, kl)

    def _step(self, grads, lr):
        for name, grad in grads.items():
            clip_grad_norm(grad, NORM_LIMIT)
            self.adam[name].lr = lr
            self.adam[name].step(self.nets[name].theta, grad)

    def begin_from(self, path):
        """Go on from shipped networks, which have no optimiser: their weights and updates, this data's statistics.

        Raises    UserError: networks of other sizes
        Test      tests/drop/test_drop_vae.py::test_training_from_shipped_networks
        """
        motion, pose, meta = load_networks(path)
        for k, net in vae.networks(motion, pose).items():
            if net.shapes != self.nets[k].shapes:
                o = meta["options"]
                sizes = " ".join(f"--{n.replace('_', '-')} {o[n]}" for n in SIZES)
                raise UserError(f"{path}: its networks have other sizes; give them: {sizes}")
            self.nets[k].theta[:] = net.theta
        rebase(self.motion, motion.stats, self.motion.stats)
        self.pose.stats = pose.stats
        self.updates = int(meta["updates"])

    def arrays(self):
        """Everything a checkpoint holds: weights, statistics, moments."""
        out = network_arrays(self.motion, self.pose)
        return out | {f"adam.{k}.{n}": v for k, a in self.adam.items() for n, v in a.state().items()}

    def restore(self, arrays, meta, path):
        """Go on exactly from a checkpoint.  Raises UserError: it is of other networks"""
        try:
            self.updates = int(meta["updates"])
            self.rng = rng_from_state(meta["rng"])
            for k, net in self.nets.items():
                if arrays[k].shape != net.theta.shape:
                    raise ValueError(f"{k} has {arrays[k].size} weights, not {net.n_params}")
                net.theta[:] = arrays[k]
                self.adam[k].load_state({n: arrays[f"adam.{k}.{n}"] for n in ("t", "m", "v")})
            for each, name in ((self.motion, "motion"), (self.pose, "pose")):
                each.stats = {n: arrays[f"{name}.{n}"].astype(np.float32) for n in each.stats}
        except (KeyError, TypeError, ValueError) as e:
            raise UserError(
                f"{path}: not a checkpoint of this run ({e}); valid: what python -m drop train wrote"
            ) from None


def rebase(net, old, new):
    r"""The same function of metres, with other statistics: a MotionVAE's first and last layers, in place.

    Equation  inputs (r − m)/s: W' = diag(s'/s) W, b' = b + ((m' − m)/s) W;  outputs y c + o: W' = W diag(c/c'), b' =
              (b c + o − o')/c'.  What the old statistics cut at CLIP standard deviations may be seen now
    Args      net : MotionVAE; old, new : statistics, those that its weights are for and those that it shall have
    Test      tests/drop/test_drop_vae.py::test_rebase
    """
    n, k = vae.STATE, vae.OUTPUT
    shift, stretch = (new["mean"] - old["mean"]) / old["std"], new["std"] / old["std"]
    moved, grown = (new["offset"] - old["offset"]) / old["scale"], new["scale"] / old["scale"]
    for name, each in net.nets.items():
        W, b = each.params["W0"], each.params["b0"]
        b += shift @ W[:n]
        W[:n] *= stretch[:, None]
        if name == "posterior":
            b += moved @ W[n:]
            W[n:] *= grown[:, None]
    last = net.nets["decoder"].n_layers - 1
    W, b = (net.nets["decoder"].params[f"{p}{last}"] for p in "Wb")
    W[:, :k] /= grown
    b[:k] = (b[:k] - moved) / grown
    net.stats = {name: np.asarray(v, net.stats[name].dtype) for name, v in new.items()}


def network_arrays(motion, pose, dtype=np.float32):
    """Weights and statistics by name.  Test: tests/drop/test_drop_vae.py::test_shipped"""
    out = {k: net.theta.astype(dtype) for k, net in vae.networks(motion, pose).items()}
    return out | {f"{m}.{k}": v for m, each in (("motion", motion), ("pose", pose)) for k, v in each.stats.items()}


def train(opt):
    """python -m drop train.  Test: tests/drop/test_drop_vae.py::test_training_resumes, ::test_command"""
    check_run(opt.out, opt.resume)
    recording = Recording(recorded(opt.motion, "train", opt.clips) + opt.rises * [r[1:] for r in rises()])
    trainer, meta = Trainer(opt, recording), {"rows": 0}
    if opt.resume and (found := latest_checkpoint(opt.out)):
        trainer.restore(*found, Path(opt.out) / CHECKPOINT)
        meta = found[1]
    elif opt.init:
        trainer.begin_from(opt.init)
    out = Path(opt.out)

    def save(rows):
        kept = {"options": vars(opt), "updates": trainer.updates, "rng": rng_state(trainer.rng), "rows": rows}
        save_checkpoint(out / CHECKPOINT, trainer.arrays(), kept)

    rows, progress = meta["rows"] if opt.resume else None, Progress(opt.updates, trainer.updates, "updates")
    journal = Journal(out, opt, opt.resume, rows, progress, save, 60 * opt.checkpoint_minutes)
    sizes = {k: net.n_params for k, net in trainer.nets.items()}
    print(f"{sum(recording.lengths)} frames; weights: " + ", ".join(f"{k} {n}" for k, n in sizes.items()))
    means = Means()
    with journal:
        while trainer.updates < opt.updates and not journal.stop:
            means.add(trainer.iterate())
            if means.count == COUNT_SHOWN or trainer.updates >= opt.updates:
                lr, kl, own = trainer.schedule()
                row = means.take()
                line = {k: f"{v:.1f}" for k, v in row.items()} | {"own": f"{own:.2f}"}
                more = {"lr": lr, "kl_weight": kl, "own": own}
                journal.write(trainer.updates, {"updates": trainer.updates} | row | more, line)
    if journal.stop:
        print(f"stopped at {trainer.updates} updates; continue with: python -m drop train --resume --out {out}")
    return trainer


# ------------------------------------------------------------------------------------ measuring


class LinearAR:
    r"""The baseline: the residual as a linear function of the state, by ridge regression on train transitions.

    Equation  min ‖S A + b − R‖² + λ ‖A‖², S normalised states, R normalised residuals, the VAE's own
    Test      tests/drop/test_drop_vae.py::test_linear_baseline
    """

    def __init__(self, net, recording, n=60_000, ridge=10.0, seed=0):
        self.net = net
        frames = np.random.default_rng(seed).choice(recording.starts(1), n)
        s, wanted = [], []
        for part in np.array_split(frames, max(n // 2000, 1)):
            state, height, columns, tx, tc, _ = _clean(recording, part)[0]
            move = tx[:, 0] - np.stack([0 * height, 0 * height, height], axis=1)
            s.append(net.normalise(state))
            wanted.append(np.concatenate([move, (tc - columns).reshape(len(s[-1]), -1)], axis=1))
        s, r = np.concatenate(s).astype(float), np.concatenate(wanted).astype(float)
        r = (r - net.stats["offset"]) / net.stats["scale"]
        s1 = np.concatenate([s, np.ones((len(s), 1))], axis=1)
        self.A = np.linalg.solve(s1.T @ s1 + ridge * np.eye(s1.shape[1]), s1.T @ r).astype(np.float32)

    def __call__(self, s, height, columns):
        """Next frame, as MotionVAE.decode."""
        move, change = self.net.residual(s @ self.A[:-1] + self.A[-1])
        C, _ = vae.gram_schmidt_forward(columns + change)
        root = move.copy()
        root[:, 2] += height
        return vae.kinematics_forward(root, C), C


def _clean(recording, frames):
    flip = np.zeros(len(frames), bool)
    (before, _), (x, columns) = recording.at(frames - 1, flip), recording.at(frames, flip)
    return transition(recording, frames, flip, x, columns, (x - before) / np.float32(STEP), 0.0)


def one_step(net, linear, recording, rng, n=4000, samples=16):
    r"""Mean distance of joints from the recorded next frame [mm], one frame ahead, and the ELBO's parts [nat].

    Returns   dict: constant velocity, linear, mode, best of `samples`, reconstruction (z of the posterior's mean),
              rotation error of the reconstruction [degrees], kl, nll (the reconstruction term)
    Test      tests/drop/test_drop_vae.py::test_linear_baseline
    """
    frames = rng.choice(recording.starts(1), min(n, len(recording.starts(1))), replace=False)
    found = {}

    def add(name, value):
        found[name] = found.get(name, 0.0) + float(np.sum(value)) / len(frames)

    for part in np.array_split(frames, max(len(frames) // 500, 1)):
        batch, *_ = _clean(recording, part)
        state, height, columns, tx, tc, _ = batch
        s, error = net.normalise(state), lambda x: 1e3 * np.linalg.norm(x - tx, axis=-1).mean(axis=-1)  # noqa: B023
        v = state[:, -3 * N :].reshape(-1, N, 3) / vae.VELOCITY_SCALE
        here = np.concatenate([np.zeros((len(s), 1, 3), np.float32), state[:, 1 : 3 * N - 2].reshape(-1, N - 1, 3)], 1)
        here[:, 0, 2] = height
        add("constant velocity", error(here + STEP * v)), add("linear", error(linear(s, height, columns)[0]))
        mu, log_std, _ = net.gaussian("prior", s)
        add("mode", error(net.decode(s, mu, height, columns)[0]))
        best = np.full(len(s), np.inf)
        for _ in range(samples):
            z = mu + np.exp(log_std) * rng.standard_normal(mu.shape).astype(np.float32)
            best = np.minimum(best, error(net.decode(s, z, height, columns)[0]))
        add("best", best)
        parts, _, x, C = net.loss(*batch, np.zeros_like(mu))
        add("reconstruction", error(x))
        turn = np.einsum("bjki,bjki->bj", C, vae.gram_schmidt_forward(tc)[0])
        add("degrees", np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1))).mean(axis=1))
        add("nll", parts["reconstruction"] * len(s)), add("kl", parts["kl"] * len(s))
    return found


def open_loop(net, predict, recording, rng, horizons=(5, 15, 30), n=300):
    """Mean distance of joints [mm] after so many frames on its own, from held-out starts; `predict` as decode.

    Test: tests/drop/test_drop_vae.py::test_linear_baseline"""
    starts = recording.starts(max(horizons) + 1)
    frames = rng.choice(starts, min(n, len(starts)), replace=False)
    flip = np.zeros(len(frames), bool)
    (before, _), (x, columns) = recording.at(frames - 1, flip), recording.at(frames, flip)
    v, out = (x - before) / np.float32(STEP), []
    for k in range(1, max(horizons) + 1):
        cx, cc, cv, frame = vae.canonical(x, columns, v)
        nx, C, *_ = predict(net.normalise(vae.state_vector(cx, cc, cv)), cx[:, 0, 2], cc)
        there = vae.to_world(nx, np.ascontiguousarray(C[..., :2, :]), frame)
        x, columns, v = there[0], there[1], (there[0] - x) / np.float32(STEP)
        if k in horizons:
            out.append(1e3 * float(np.linalg.norm(x - recording.at(frames + k, flip)[0], axis=-1).mean()))
    return out


def pose_norms(net, recording, frames):
    """‖E(q)‖ and the reconstruction's joint error [mm] of frames.

    Test      tests/drop/test_drop_vae.py::test_pose_range"""
    C, _ = vae.gram_schmidt_forward(recording.columns[frames])
    pose = vae.pose_columns(C)
    z = net.encode(pose)
    x = np.matmul(recording.x[frames] - recording.x[frames, :1], np.swapaxes(C[:, 0], -1, -2))
    ex = vae.kinematics_forward(np.zeros((len(x), 3), np.float32), net.decode(z)) - x
    return np.linalg.norm(z, axis=1), 1e3 * np.linalg.norm(ex, axis=-1).mean(axis=1)


BOUND_PERCENTILE = 99.9  # of held-out poses: the boundary of the range of motion
ANGLE_FACTOR = 2.0  # ASSUMED: of that percentile of the angle, so that other styles stay inside


def calibrate(net, recording):
    """The bound r of Eq. 15, a percentile of ‖E(q)‖ over held-out poses; and PoseRange's angle [rad].

    Test: tests/drop/test_drop_vae.py::test_pose_range"""
    norms, _ = pose_norms(net, recording, np.arange(len(recording.x)))
    pose = vae.pose_columns(vae.gram_schmidt_forward(recording.columns)[0])
    angles = pose_angles(pose, net.decode(net.encode(pose)))
    return float(np.percentile(norms, BOUND_PERCENTILE)), ANGLE_FACTOR * float(np.percentile(angles, BOUND_PERCENTILE))


WRONG = {  # joint, axis of its own frame, degrees: what no body does
    "knee 60 degrees backwards": ("knee_l", (0, 1, 0), -60), "elbow 60 degrees backwards": ("elbow_l", (0, 1, 0), 60),
    "head turned by 130 degrees": ("neck", (0, 0, 1), 130), "ankle 90 degrees out": ("ankle_l", (0, 0, 1), 90),
    "trunk 90 degrees back": ("spine2", (0, 1, 0), -90), "leg 100 degrees back": ("hip_l", (0, 1, 0), 100),
}  # fmt: skip


def detection(limit, recording, rng, n=500):
    r"""Share of poses, each with one joint turned to where it cannot be, that each range of motion calls outside.

    Args      limit : PoseRange
    Returns   {what: (share by ‖E‖ alone, by the pose VAE, by drop.LIMITS)}, `recorded` first
    Test      tests/drop/test_drop_vae.py::test_pose_range
    """
    frames = rng.choice(len(recording.x), n, replace=False)
    C0, _ = vae.gram_schmidt_forward(recording.columns[frames].astype(float))
    out, norm = {}, PoseRange(limit.net, limit.bound)
    for what, change in {"recorded": None, **WRONG}.items():
        C = C0.copy()
        if change is not None:
            joint, axis, degrees = body.J[change[0]], np.array(change[1], float), np.radians(change[2])
            below = vae.ANCESTORS[:, joint] > 0
            parent = C0[:, body.PARENTS[joint]]
            rest = np.matmul(C0[:, below], np.swapaxes(C0[:, [joint]], -1, -2))  # descendants relative to the joint
            straight = vae.rotate_rows(np.eye(3), degrees * axis)  # the joint's turn as rows, Lᵀ of R = R_parent L
            bent = np.matmul(straight, parent)
            C[:, below] = np.matmul(rest, bent[:, None])
        x = vae.kinematics_forward(np.zeros((n, 3)), C)
        quat = (
            Rotation.from_matrix(np.swapaxes(C, -1, -2).reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(n, N, 4)
        )
        by = [
            [rule(a, body.twists(q)) is not a for a, q in zip(x, quat)]
            for rule in (norm, limit, body.project_range_of_motion)
        ]
        out[what] = tuple(float(np.mean(b)) for b in by)
    return out


def evaluate(opt):
    """python -m drop evaluate: the tables.  Test: tests/drop/test_drop_vae.py::test_command"""
    motion, pose, meta = load_networks(opt.weights)
    rng = np.random.default_rng(opt.seed)
    train = Recording(recorded(opt.motion, "train", opt.clips))
    linear = LinearAR(motion, train)
    heads = ("constant velocity", "linear", "mode", "best", "reconstruction", "degrees", "nll", "kl")
    print(f"one frame ahead, mm  {'  '.join(f'{h:>17s}' for h in heads)}   pose mm")
    recordings = {"train": train}
    for split in ("validation", "style"):
        try:
            recordings[split] = Recording(recorded(opt.motion, split, opt.clips, stitched=False))
        except UserError as none:
            print(f"{split}: {none}")
    for split, recording in recordings.items():
        r = one_step(motion, linear, recording, rng)
        frames = rng.choice(len(recording.x), min(5000, len(recording.x)), replace=False)
        norms, mm = pose_norms(pose, recording, frames)
        print(f"{split:20s} {'  '.join(f'{r[h]:17.2f}' for h in heads)}   {mm.mean():7.1f}")
        by = (("linear", linear), ("mode", lambda s, h, c: motion.decode(s, motion.gaussian("prior", s)[0], h, c)))
        for name, predict in by:
            far = open_loop(motion, predict, recording, np.random.default_rng(opt.seed))
            print(f"  {name:10s} alone for 5, 15, 30 frames: " + ", ".join(f"{d:.0f} mm" for d in far))
        p = np.percentile(norms, [50, 99, 99.9])
        print(f"  ‖E(q)‖: median {p[0]:.2f}, 99 % {p[1]:.2f}, 99.9 % {p[2]:.2f}; bound {meta['bound']:.2f}")
    last = list(recordings.values())[-1]
    limit = PoseRange.of(pose, meta)
    found = detection(limit, recordings.get("validation", last), rng, min(500, len(last.x)))
    for what, by in found.items():
        shares = (f"{rule} {100 * b:5.1f} %" for rule, b in zip(("‖E‖", "pose VAE", "limits"), by, strict=True))
        print(f"  outside, {what:28s} " + "   ".join(shares))


# ------------------------------------------------------------------------------------ long rollouts


def free_rollout(prior, first, frames, rng, sim=None):
    """States of the prior on its own, or of a Simulator that has it.

    Test: tests/drop/test_drop_vae.py::test_free_rollout"""
    states, state = [], first
    for _ in range(frames):
        if sim is None:
            x, quat = (a[0] for a in prior.sample(state, 1, rng))
            v = (x - state.x) / STEP
            state = simulator.State(x, v, quat, state.frame + 1, v)
        else:
            state, _ = sim.step(state, rng=rng)
        states.append(state)
    return states


def on_manifold(bank, states, limit):
    r"""How near a motion stays to the recorded one.

    Method    RMS distance of 12 joints (and 0.1 s times their velocities) in the heading frame to the nearest recorded
              train frame (NearestPrior.nearest); `limit` is the 99th percentile of the same over held-out clips
    Returns   dict: median and 99th percentile [m], share below the limit, longest excursion [frames of `states`]
    Test      tests/drop/test_drop_vae.py::test_free_rollout
    """
    d = np.array([bank.nearest(s, 1)[1] for s in states])
    out, longest, run = d > limit, 0, 0
    for o in out:
        run = run + 1 if o else 0
        longest = max(longest, run)
    return {"median": float(np.median(d)), "p99": float(np.percentile(d, 99)), "inside": float(1 - out.mean()),
            "longest": longest}  # fmt: skip


def rollout(opt, stride=5):
    """python -m drop rollout.  Test: tests/drop/test_drop_vae.py::test_command"""
    motion, pose, meta = load_networks(opt.weights)
    bank = NearestPrior(recorded(opt.motion, "train", opt.clips))
    held = recorded(opt.motion, "validation", opt.clips, stitched=False)
    d = [
        bank.nearest(simulator.State(x[t], (x[t] - x[t - 1]) / STEP, q[t]), 1)[1]
        for x, q in held
        for t in range(1, len(x), 15)
    ]
    limit = float(np.percentile(d, 99))
    print(f"held-out clips: nearest recorded frame {100 * np.median(d):.1f} cm, the limit (99 %) {100 * limit:.1f} cm")
    prior, rng = VaePrior(motion), np.random.default_rng(opt.seed)
    limits = PoseRange.of(pose, meta)
    x, q = held[0]
    for name, sim in (("prior alone", None), ("inside DROP", Simulator(prior, limits=limits))):
        began = time.process_time()
        first = (sim or Simulator()).begin(x[1], q[1], (x[1] - x[0]) / STEP)
        states = free_rollout(prior, first, opt.frames, rng, sim)
        seconds = time.process_time() - began
        p = np.array([s.x for s in states])
        r = on_manifold(bank, states[::stride], limit)
        speed = np.linalg.norm(np.diff(p.mean(axis=1)[:, :2], axis=0), axis=1) / STEP
        C = np.swapaxes(Rotation.from_quat(np.array([s.quat for s in states[::stride]]).reshape(-1, 4),
                                           scalar_first=True).as_matrix(), -1, -2).reshape(-1, N, 3, 3)  # fmt: skip
        norms = limits.norm(C.astype(np.float32))
        low = p[:, FEET, 2] - body.RADII[FEET]
        slide = np.linalg.norm(np.diff(p[:, FEET, :2], axis=0), axis=-1)[low[1:] < 0.01] / STEP
        print(
            f"{name}: {len(states)} frames, {'finite' if np.isfinite(p).all() else 'NOT FINITE'}, nearest recorded "
            f"frame {100 * r['median']:.1f} cm (99 %: {100 * r['p99']:.1f}), {100 * r['inside']:.1f} % within the limit"
            f", longest excursion {r['longest'] * stride * STEP:.1f} s; "
            f"pose in range {100 * np.mean(norms <= limits.bound):.1f} %; "
            f"pelvis {p[:, 0, 2].min():.2f} to {p[:, 0, 2].max():.2f} m; speed {np.percentile(speed, 5):.2f}, "
            f"{np.median(speed):.2f}, {np.percentile(speed, 95):.2f} m/s; slide {slide.mean():.2f} m/s; "
            f"{len(states) / seconds:.0f} frames/s"
        )


# ------------------------------------------------------------------------------------ shipping


def ship(opt):
    r"""Write a run's networks to --weights: float16, the pose bound, how they were trained, the data's licence.

    Returns   what was written beside the weights
    Raises    UserError: the run has no checkpoint; no file is named, and the one that is shipped would be lost
    Test      tests/drop/test_drop_vae.py::test_shipped, test_ship_names_its_file
    """
    if opt.weights == str(WEIGHTS):
        raise UserError("python -m drop ship: say where to, with --weights FILE.npz")
    motion, pose, meta = load_networks(Path(opt.out) / CHECKPOINT)
    trained = stored_options(Options, opt.out)
    sets = data.parts(trained["motion"])
    held = Recording(held_out(sets, trained["clips"]))
    options = {k: v for k, v in trained.items() if k not in ("weights", "out", "resume")} | {
        "motion": ",".join(map(data.set_name, sets))
    }
    licence = "; ".join(f"weights trained on {text}" for text in data.licences(sets)) or "MIT"
    bound, angle = calibrate(pose, held)
    kept = {"options": options, "updates": meta["updates"], "bound": bound, "angle": angle, "licence": licence,
            "versions": versions(), "git": git_state()}  # fmt: skip
    save_checkpoint(opt.weights, network_arrays(motion, pose, np.float16), kept)
    return kept


COMMANDS = {"train": train, "evaluate": evaluate, "rollout": rollout, "ship": ship}


def main(argv=None):
    """python -m drop COMMAND.  Test: tests/drop/test_drop_vae.py::test_command"""
    argv = list(sys.argv[1:] if argv is None else argv)
    name = argv.pop(0) if argv and not argv[0].startswith("-") else None
    opt = cli(Options, argv, f"python -m drop {name or '|'.join(COMMANDS)}", __doc__)
    if name not in COMMANDS:
        raise UserError(
            f"python -m drop needs a command{'' if name is None else f', not {name!r}'}; valid: {', '.join(COMMANDS)}"
        )
    if opt.resume:
        opt = resumed_options(opt, argv, AGAIN)
    found = COMMANDS[name](opt)
    if name == "ship":
        print(f"{opt.weights}: {found['updates']} updates, bound {found['bound']:.2f}; {found['licence']}")

r"""A copy and a learnt correction: skeleton-aware networks for minutes of one core, on any number of real rigs.

    x_A ──► E_A ──► latent ──► D_B ──► r ──► y_B = c_B + r ──► FK ──► limbs, velocities, contacts, critic
      └───► copy of rotations, standardised: c_B ─────┘

[SAN-3] decodes the whole pose.  After 40 minutes of one core that has not caught up with a copy of rotations in the
target's statistics (skeletal/REPRODUCE.md, part 3).  Here the decoder adds to a copy, and its last layer starts at
zero, so that training begins at the copy.  Layers, encoders, decoders and, with --adv, critics are the
paper's, of `skeletal.net`; all rigs share one latent space and one primal skeleton.  Still no pairs.

    python -m skeletal correct --motion FOLDER --rigs human,bandai,dino --out runs/c
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import mocap.data
from mocap.data import licences
from nn import Adam
from plumbing.cli import COUNT, NONNEGATIVE, POSITIVE, UserError, arg, cli
from plumbing.files import check_folders
from plumbing.runs import Progress, check_run, git_state, load_checkpoint, open_run, save_checkpoint, versions
from skeletal import data, rigs
from skeletal.data import RATE, Motion, Skeleton, Structure
from skeletal.layers import PLACE, ROOT, fk_forward
from skeletal.layers import fk_backward as fk_grad
from skeletal.net import Critic, FakePool, Generator, ee_loss, lsgan, ltc_loss, mse
from skeletal.train import MIN_STD, STRIDE, WINDOW

SHIPPED = Path(__file__).resolve().parent / "rigs.npz"
TERMS = ("stay", "limb", "ee", "stand", "ltc", "adv")
LAFAN_TRAIN = 0.7  # ASSUMED: the first 70 % of the one LaFAN1 take are trained on, the rest is measured on


# ------------------------------------------------------------------------------------ rigs, statistics, windows


def limbs(names, skeleton: Skeleton, bases) -> np.ndarray:
    """(E, J) 0 or 1: the bones of each limb, from its base joint (shoulder, hip; the root for a head) to its end.

    Test      tests/skeletal/test_skeletal_correct.py::test_limbs
    """
    out = np.zeros((len(skeleton.graph.leaves), len(names)), np.float32)
    for e, j in enumerate(skeleton.graph.leaves):
        while j > 0 and j not in bases:
            out[e, j] = 1.0
            j = skeleton.parents[j]
    return out


def statistics(xs):
    """Mean and deviation (C,) of features, one deviation an armature (`skeletal.train.Domain`)."""
    x = np.concatenate(xs)
    v = x.var(axis=0)
    v[:2], v[3:ROOT] = v[:2].mean(), v[3:ROOT].mean()
    v[ROOT:] = np.repeat(v[ROOT:].reshape(-1, 4).mean(axis=1), 4)
    std = np.sqrt(v)
    std[2:] = np.maximum(std[2:], MIN_STD)
    std[:2] = np.maximum(std[:2], 1e-3)
    return x.mean(axis=0).astype(np.float32), std.astype(np.float32)


class Side:
    """One rig in training: bodies, statistics, clips.

    anchor : (E, 3) limbs when the canonical human stands upright, less a human's: 0 for people, a bent-over Dino's not
    stand  : (F,) `skeletal.data.stand_heights` of its clips, the median
    """

    def __init__(self, rig: rigs.Rig, bodies, clips=(), stats=None, anchor=None, stand=None):
        self.rig, self.bodies, self.clips = rig, list(bodies), list(clips)
        s = rig.skeleton
        self.parents, self.names, self.ends = np.array(s.parents), s.names, s.graph.leaves
        self.feet = [self.ends.index(f) for f in s.feet]
        self.limbs = limbs(s.names, s, bases_of(rig))
        self.anchor = np.zeros((len(self.ends), 3), np.float32) if anchor is None else anchor
        seen = [data.features(m) for _, m in self.clips]
        self.x, self.turn = [x for x, _ in seen], [t for _, t in seen]
        self.mean, self.std = stats if stats is not None else statistics(self.x)
        self.standing = [data.contacts(m) for _, m in self.clips]
        heights = [data.stand_heights(m, s) for (_, m), s in zip(self.clips, self.standing)]
        self.stand = np.median(heights, axis=0) if stand is None else stand
        self.static = [(k.offsets / k.leg).astype(np.float32) for k in self.bodies]
        self.lengths = [self.limb_lengths(k) for k in self.bodies]
        self.reach = [(k.reach() / k.leg).astype(np.float32) for k in self.bodies]
        self.windows = [(i, a) for i, x in enumerate(self.x) for a in range(0, len(x) - WINDOW + 1, STRIDE)]

    def limb_lengths(self, k: Skeleton):
        """(E,) lengths of a body's limbs, in its legs."""
        return (self.limbs @ np.linalg.norm(k.offsets / k.leg, axis=1)).astype(np.float32)

    def batch(self, who):
        """S (3 J, B), offsets (J, 3, B), limb lengths (E, B), reach (E, B) of bodies (B,)."""
        s = np.stack([self.static[k] for k in who], axis=-1)
        pick = lambda rows: np.stack([rows[k] for k in who], axis=-1)  # noqa: E731
        return s.reshape(-1, len(who)), s, pick(self.lengths), pick(self.reach)


def bases_of(rig: rigs.Rig) -> set:
    """Joints where arms and legs begin: those that are an upper arm or a thigh to mocap."""
    from_names = {"thigh_l", "thigh_r", "upper_arm_l", "upper_arm_r"}
    return {j for j, n in enumerate(rig.skeleton.names) if rig.segments.get(n) in from_names}


def upright_limbs(side: Side):
    """(E, 3) limbs over their lengths when the canonical human stands upright, heading frame."""
    rig, k = side.rig, side.rig.skeleton
    if rig.character is None:
        g = rig.upright[None]
    else:
        m = data.to_motion(rigs.default_pose(rig.character, rig.name), rig.structure)
        g = data.pose(m)[1][:1]
    p, _ = data.pose(Motion("upright", k, np.zeros((1, 3)), data.locals_of(g.copy(), k.parents)))
    bones = p[0] - p[0][np.maximum(k.parents, 0)]
    return (side.limbs @ bones / (side.limb_lengths(k) * k.leg)[:, None]).astype(np.float32)


def copy_features(m: Motion, target: Skeleton):
    """Features of a copy of rotations on another rig; its root's path and height in the target's legs."""
    return data.features(rigs.copied(m, target))


class Copies:
    r"""Copies of rotations of one rig's clips on another: what the decoder adds to, and their statistics.

    Equation  c = (copy - mean_B) / std_B; the shifted copy is (copy - mean_copy) / std_copy, the root's path as it is
    Test      tests/skeletal/test_skeletal_correct.py::test_starts_at_the_copy
    """

    def __init__(self, a: Side, b: Side, stats=None):
        self.b = b
        self.x = [] if stats is not None else [copy_features(m, b.bodies[0])[0] for _, m in a.clips]
        self.mean, self.std = stats if stats is not None else statistics(self.x)

    def standardised(self, x):
        """(T, C) copied features, in the target's deviations from its mean."""
        return (x - self.b.mean) / self.b.std

    def shifted(self, x):
        """The same with the target's own statistics instead of the copy's: the baseline."""
        c = self.standardised(x)
        c[:, PLACE:] = (x[:, PLACE:] - self.mean[PLACE:]) / self.std[PLACE:]
        return c


# ------------------------------------------------------------------------------------ losses


def limb_loss(bones_a, bones_b, side_a: Side, side_b: Side, length_a, length_b):
    r"""Where limbs point, over their lengths: [SAN-7] with places in the limb's frame instead of velocities.

    Equation  mean over frames of sum_e |v_e^A / l_e^A - a_e^A - v_e^B / l_e^B + a_e^B|^2, v_e = sum of the limb's bones
    Departs   [SAN-7] sees velocities alone, and a wrong mean pose has right velocities.  ASSUMED
    Symbols   v_e (3, T, B) heading frame; l_e (E, B); a_e `Side.anchor`
    Returns   loss; d bones_b (A is data)
    Test      tests/skeletal/test_skeletal_correct.py::test_limb_loss_gradient
    """
    va = np.tensordot(side_a.limbs, bones_a, 1) / length_a[:, None, None] - side_a.anchor[:, :, None, None]
    vb = np.tensordot(side_b.limbs, bones_b, 1) / length_b[:, None, None] - side_b.anchor[:, :, None, None]
    d = vb - va
    n = d.shape[2] * d.shape[3]
    g = d * (2.0 / n) / length_b[:, None, None]
    return float(np.sum(d * d, dtype=np.float64) / n), np.tensordot(side_b.limbs.T, g, 1).astype(bones_b.dtype)


def stand_loss(world, feet, standing):
    r"""A foot that stands in the source does not move in the target.

    Equation  mean over frames of sum_f s_f |p_f(t) - p_f(t - 1)|^2, horizontal, s_f: stood at t and t - 1 [legs^2]
    Departs   the paper leaves this to the clean-up.  ASSUMED
    Args      world (J, 3, T, B); feet : joints; standing (F, T, B)
    Returns   loss; d world
    Test      tests/skeletal/test_skeletal_correct.py::test_stand_loss_gradient
    """
    s = standing[:, None, 1:] * standing[:, None, :-1]
    d = np.diff(world[feet][:, :2], axis=2) * s
    n = d.shape[2] * d.shape[3]
    out = np.zeros_like(world)
    for k, f in enumerate(feet):
        g = d[k] * (2.0 / n)
        out[f, :2, 1:] += g
        out[f, :2, :-1] -= g
    return float(np.sum(d * d, dtype=np.float64) / n), out


# ------------------------------------------------------------------------------------ training


@dataclass
class CorrectOptions:
    """Train corrections of copies between rigs, unpaired.  The weights are ASSUMED."""

    motion: str | None = arg(None, "folder that holds bandai, lafan1, cmu-inplace; left out: the built-in human alone")
    rigs: str = arg("human,jesse,oppy,dino", "rigs, commas between them: " + ", ".join(rigs.RIGS))
    limit: int = arg(40, "clips a rig at most, evenly chosen", check=COUNT)
    out: str | None = arg(None, "run folder; default runs/correct")
    ship: str | None = arg(None, "also write the first seed's networks to this .npz, in half precision")
    steps: int = arg(2000, "optimiser steps; one is two directions between two rigs", check=COUNT)
    batch: int = arg(8, "windows a direction", check=COUNT)
    lr: float = arg(1e-3, "Adam's learning rate, falling to a tenth", check=POSITIVE)
    intra: float = arg(0.15, "share of the directions that stay within a rig", check=NONNEGATIVE)
    stay: float = arg(0.05, "weight of the correction's own square; 20 times as much within a rig", check=NONNEGATIVE)
    limb: float = arg(10.0, "weight of where limbs point", check=NONNEGATIVE)
    ee: float = arg(1000.0, "weight of [SAN-7]", check=NONNEGATIVE)
    stand: float = arg(5000.0, "weight of standing feet's velocity", check=NONNEGATIVE)
    ltc: float = arg(0.0, "weight of [SAN-5]", check=NONNEGATIVE)
    adv: float = arg(0.0, "weight of [SAN-6]", check=NONNEGATIVE)
    seeds: tuple[int, ...] = arg((0,), "one set of networks each, OUT/correct-SEED.npz")
    minutes: float = arg(1e9, "CPU minutes a seed at most", check=POSITIVE)


def gather(opt) -> list:
    """A Side a rig: every rig moves as other people did, at other times.

    Raises    UserError: an unknown rig, or captures that are not there
    Test      tests/skeletal/test_skeletal_correct.py::test_gather_is_unpaired
    """
    names = [n.strip() for n in opt.rigs.split(",") if n.strip()]
    if bad := [n for n in names if n not in rigs.RIGS]:
        raise UserError(f"--rigs {bad[0]}: no such rig; valid: {', '.join(rigs.RIGS)}")
    if len(names) < 2 or len(set(names)) < len(names):
        raise UserError(f"--rigs {opt.rigs}: one rig, or one twice; valid: two or more of {', '.join(rigs.RIGS)}")
    found, first = [], None
    for k, name in enumerate(names):
        rig, pairs = clips_of(name, opt, k, len(names))
        if first is None:
            first = rig.skeleton
        rig, pairs = rigs.in_order(rig, pairs, first)
        bodies, clips = [], []
        for m, _ in pairs:
            if len(m) < WINDOW:
                continue
            same = (i for i, b in enumerate(bodies) if np.allclose(b.offsets, m.skeleton.offsets, atol=1e-3 * b.leg))
            i = next(same, len(bodies))
            if i == len(bodies):
                bodies.append(m.skeleton)
            clips.append((i, m))
        if not clips:
            raise UserError(f"rig {name}: no clip of {WINDOW} frames at 30 Hz; valid: longer ones")
        found.append(Side(rig, bodies, clips))
    return anchored(found)


def anchored(sides) -> list:
    """Anchors of characters against a human's."""
    people = [s for s in sides if s.rig.character is None]
    for s in sides:
        if s.rig.character is not None and people:
            s.anchor = upright_limbs(s) - upright_limbs(people[0])
    return sides


def clips_of(name, opt, k, n):
    """(Rig, pairs) of a rig's own training clips; the human's and the characters' are every n-th built-in one."""
    root = Path(opt.motion) if opt.motion else None
    if name in ("human", *rigs.CHARACTERS):
        clips = [c for c in mocap.data.load("builtin", RATE, split="train") if len(c) >= WINDOW][k::n]
        if name == "human" and root:  # people of many sizes
            more = [*rigs.files(root / "bandai", "bandai", "train", opt.limit // 2),
                    *rigs.files(root / "cmu-inplace", "cmu", "train", opt.limit // 8)]  # fmt: skip
            clips = clips[: opt.limit // 2] + [rigs.at_30(c) for p in more for c in mocap.data.read_clips([p])]
        return rigs.load(name, [], [c[:600] for c in clips[: opt.limit]])
    if root is None:
        raise UserError(f"--rigs {name} needs captures; give --motion FOLDER that holds {name}")
    if name == "lafan1":
        rig, pairs = rigs.load(name, [root / "lafan1" / "walk4_subject1.bvh"])
        cut = int(LAFAN_TRAIN * len(pairs[0][0]))
        return rig, [(m[:cut], c[:cut]) for m, c in pairs]
    folder = {"bandai": "bandai", "cmu": "cmu-inplace"}[name]
    return rigs.captured(root, folder, name, "train", opt.limit)


def copies_between(sides) -> dict:
    """Copies of every rig's clips on every other."""
    return {(m, n): Copies(a, b) for m, a in enumerate(sides) for n, b in enumerate(sides) if m != n}


class Corrector:
    r"""Networks of N rigs and one optimiser step.

    Test      tests/skeletal/test_skeletal_correct.py::test_whole_gradient, test_step_learns
    """

    def __init__(self, opt: CorrectOptions, sides, seed=0, copies=None, dtype=np.float32):
        self.opt, self.sides, self.dtype, self.step_count = opt, sides, dtype, 0
        self.weights = {k: getattr(opt, k) for k in TERMS}
        self.nets = [generator(s, seed, dtype) for s in sides]
        init = np.random.default_rng([seed, 1])
        self.critics = [Critic(s.parents, init, dtype=dtype) for s in sides] if opt.adv else []
        self.pools = [FakePool() for _ in sides]
        self.adams = [Adam(n.n_params, opt.lr, dtype=dtype) for n in (*self.nets, *self.critics)]
        self.rng = np.random.default_rng([seed, 2])
        self.copies = copies or copies_between(sides)

    def sample(self, m, n):
        """Windows of rig m, standardised (C, T, B), their copies on rig n, headings, bodies, standing feet."""
        A, B = self.sides[m], self.sides[n]
        picks = [A.windows[i] for i in self.rng.integers(len(A.windows), size=self.opt.batch)]
        stack = lambda rows: np.ascontiguousarray(np.stack(rows, axis=-1).transpose(1, 0, 2))  # noqa: E731
        x = stack([(A.x[i][a : a + WINDOW] - A.mean) / A.std for i, a in picks])
        c = x
        if m != n:
            kept = self.copies[m, n]
            c = stack([kept.standardised(kept.x[i][a : a + WINDOW]) for i, a in picks])
        turn = np.stack([A.turn[i][a : a + WINDOW] for i, a in picks], axis=-1)
        stand = stack([A.standing[i][a : a + WINDOW] for i, a in picks]).astype(self.dtype)
        who = [A.clips[i][0] for i, _ in picks]
        targets = who if m == n else self.rng.integers(len(B.bodies), size=len(who))
        return x.astype(self.dtype), c.astype(self.dtype), turn, stand, who, targets

    def direction(self, m, n, batch):
        r"""A = m to B = n: the correction, its losses, all gradients by hand.

        Equation  L = w_stay |r|^2 (20 times within a rig) + w_limb L_limb + w_ee L_ee [SAN-7] + w_stand L_stand
                  + w_ltc L_ltc [SAN-5] + w_adv L_adv [SAN-6]
        Returns   losses; (fake bones, S_B) for the critic
        """
        A, B, w = self.sides[m], self.sides[n], self.weights
        G, H = self.nets[m], self.nets[n]
        x, c, turn, stand, who, targets = batch
        s_a, off_a, length_a, reach_a = A.batch(who)
        s_b, off_b, length_b, reach_b = B.batch(targets)
        f_a, static_a = G.static_forward(s_a.astype(self.dtype))
        z, encoded = G.encode_forward(x, f_a)
        f_b, static_b = H.static_forward(s_b.astype(self.dtype))
        r, decoded = H.decode_forward(z, f_b)
        r[:PLACE] = 0.0
        y = c + r
        mean, std = (v[:, None, None].astype(self.dtype) for v in (B.mean, B.std))
        raw = x * A.std[:, None, None] + A.mean[:, None, None]
        real_bones, real_world, _ = fk_forward(raw, off_a, A.parents, turn)
        bones, world, kin = fk_forward(y * std + mean, off_b, B.parents, turn)
        losses = {}
        losses["stay"], dy = mse(r, np.zeros_like(r))
        dr = (w["stay"] * (20.0 if m == n else 1.0)) * dy
        losses["limb"], d = limb_loss(real_bones, bones, A, B, length_a, length_b)
        dbones = w["limb"] * d
        losses["ee"], d = ee_loss(real_world, world, A.ends, B.ends, reach_a, reach_b)
        dworld = w["ee"] * d
        losses["stand"], d = stand_loss(world, list(B.rig.skeleton.feet), stand)
        dworld = dworld + w["stand"] * d
        flat = bones.reshape(-1, *bones.shape[2:])
        dz = np.zeros_like(z)
        df1_b = np.zeros_like(f_b[1])
        if w["adv"]:
            score, judged = self.critics[n].forward(flat, s_b)
            losses["adv"], dscore = lsgan(score, 1.0)
            dbones = dbones + self.critics[n].backward(w["adv"] * dscore, judged).reshape(bones.shape)
        if w["ltc"]:
            z_fake, again = H.encode_forward(y, f_b)
            losses["ltc"], dfake, d = ltc_loss(z_fake, z)
            dz += w["ltc"] * d
            d, df1_b = H.encode_backward(w["ltc"] * dfake, again)
            dr = dr + d
        dr = dr + std * fk_grad(dbones.astype(self.dtype), dworld.astype(self.dtype), kin)
        dr[:PLACE] = 0.0
        d, df2_b = H.decode_backward(dr, decoded)
        dz += d
        H.static_backward(df1_b, df2_b, static_b)
        _, df1 = G.encode_backward(dz, encoded, want_dx=False)
        G.static_backward(df1, np.zeros_like(f_a[2]), static_a)
        return losses, (flat, s_b), (real_bones.reshape(-1, *real_bones.shape[2:]), s_a)

    def step(self):
        """One pair of rigs, both ways, then their critics; -> mean losses."""
        pair = [int(i) for i in self.rng.choice(len(self.sides), 2, replace=False)]
        for k in pair:
            self.nets[k].grad[:] = 0.0
        total, fakes, reals = {}, {}, {}
        for m, other in (pair, pair[::-1]):
            n = m if self.rng.random() < self.opt.intra else other
            losses, fake, real = self.direction(m, n, self.sample(m, n))
            fakes.setdefault(n, []).append(fake)
            reals[m] = real
            if m != n:
                for k, v in losses.items():
                    total.setdefault(k, []).append(v)
        for k in pair:
            self.adams[k].step(self.nets[k].theta, self.nets[k].grad)
        for n, made in fakes.items() if self.critics else ():
            C = self.critics[n]
            C.grad[:] = 0.0
            for fake in made:
                for (bones, s), label in ((reals[n], 1.0), (self.pools[n].exchange(*fake, self.rng), 0.0)):
                    score, cache = C.forward(bones, s)
                    C.backward(0.5 * lsgan(score, label)[1], cache, want_dx=False)
            self.adams[len(self.nets) + n].step(C.theta, C.grad)
        self.step_count += 1
        return {k: float(np.mean(v)) for k, v in total.items()}


def generator(side: Side, seed, dtype=np.float32) -> Generator:
    """A rig's encoder and decoder, the decoder's last layer zero: training starts at the copy."""
    net = Generator(side.parents, np.random.default_rng([seed, 3]), dtype=dtype)
    W, V, b = net.params[net.d[1]]
    for a in (*W, *V, b):
        a[...] = 0.0
    return net


# ------------------------------------------------------------------------------------ keeping and using it


def arrays_of(nets, sides, copies) -> dict:
    """All of a run that its user needs."""
    out = {}
    for k, (net, s) in enumerate(zip(nets, sides)):
        r = s.rig
        out |= {f"generator{k}": net.theta, f"mean{k}": s.mean, f"std{k}": s.std, f"anchor{k}": s.anchor,
                f"stand{k}": s.stand, f"offsets{k}": np.stack([b.offsets for b in s.bodies]),
                f"reference{k}": r.structure.reference, f"upright{k}": r.upright,
                f"home{k}": np.array(r.home, float)}  # fmt: skip
    for (m, n), c in copies.items():
        out |= {f"copy_mean{m}-{n}": c.mean, f"copy_std{m}-{n}": c.std}
    return out


def meta_of(sides) -> list:
    """The rest of it, as JSON."""
    out = []
    for s in sides:
        t = s.rig.structure
        out.append({"rig": s.rig.name, "names": list(t.names), "parents": [int(p) for p in t.parents], "unit": t.unit,
                    "feet": [int(f) for f in t.feet], "end": [bool(e) for e in t.end], "up": t.up,
                    "segments": s.rig.segments})  # fmt: skip
    return out


class Correction:
    """Trained corrections: a motion of one rig onto a body of another.

    Args      path : .npz of `python -m skeletal correct`
    Raises    UserError: no such file, or another kind of file
    Test      tests/skeletal/test_skeletal_correct.py::test_train_ship_use
    """

    def __init__(self, path):
        arrays, self.meta = load_checkpoint(path, finite=("generator*", "*"))
        if "rigs" not in self.meta:
            raise UserError(f"{path}: not of python -m skeletal correct; valid: its .npz")
        if "stand0" not in arrays:
            raise UserError(f"{path}: has no standing heights, as older files; valid: trained anew")
        try:
            self.sides = [side_from(arrays, d, k) for k, d in enumerate(self.meta["rigs"])]
            self.nets = [generator(s, 0) for s in self.sides]
            for k, net in enumerate(self.nets):
                if arrays[f"generator{k}"].shape != net.theta.shape:
                    raise ValueError(f"generator{k} has {arrays[f'generator{k}'].size} numbers, not {net.theta.size}")
                net.theta[:] = arrays[f"generator{k}"]
            n = range(len(self.sides))
            self.copies = {(a, b): Copies(self.sides[a], self.sides[b],
                                          (arrays[f"copy_mean{a}-{b}"], arrays[f"copy_std{a}-{b}"]))
                           for a in n for b in n if a != b}  # fmt: skip
        except (KeyError, TypeError, ValueError, IndexError) as e:
            raise UserError(f"{path}: no corrections ({type(e).__name__}: {e}); valid: a whole file") from None

    @property
    def names(self):
        """Of the rigs."""
        return [s.rig.name for s in self.sides]

    def index(self, name) -> int:
        """Which rig has a name.  UserError: none"""
        if name not in self.names:
            raise UserError(f"{name}: not among the trained rigs; valid: {', '.join(self.names)}")
        return self.names.index(name)

    def __call__(self, m: Motion, source, target: Skeleton, to, correct=True) -> Motion:
        """The corrected copy; correct=False: the shifted copy, no network; onto the source's own rig: the copy."""
        start = m.pos[0, :2] * (target.leg / m.skeleton.leg)
        x, turn = data.features(m)
        copy = copy_features(m, target)[0]
        if source == to:
            return data.from_features(copy, turn, target, m.name, start)
        A, B, kept = self.sides[source], self.sides[to], self.copies[source, to]
        base = kept.standardised(copy) if correct else kept.shifted(copy)
        n, pad = len(x), max(-len(x) % 4, 32 - len(x))
        if correct:
            full = np.concatenate([x, np.repeat(x[-1:], pad, axis=0)])
            s_a = (m.skeleton.offsets / m.skeleton.leg).astype(np.float32).reshape(-1, 1)
            s_b = (target.offsets / target.leg).astype(np.float32).reshape(-1, 1)
            z, _ = self.nets[source].encode_forward(
                np.ascontiguousarray(((full - A.mean) / A.std).T[..., None]), self.nets[source].static_forward(s_a)[0]
            )
            r, _ = self.nets[to].decode_forward(z, self.nets[to].static_forward(s_b)[0])
            base[:, PLACE:] += r[PLACE:, :n, 0].T
        return data.from_features(base * B.std + B.mean, turn, target, m.name, start)

    def clean(self, out: Motion, m: Motion, source, to) -> Motion:
        r"""The foot clean-up of a result; feet that stand are as high as the target rig's do in its own clips.

        Equation  h_B = l_B (stand_B + h_A / l_A - stand_A - g),  g = min_f (stand heights of m - stand_A)
        Symbols   h (T, F) height of a foot's end; l the legs; stand `Side.stand`; g how far the source's floor is from
                  where its rig has it, told by its lower foot: a foot that is held up stays up
        Args      m : the source
        Test      tests/skeletal/test_skeletal_correct.py::test_results_stand_on_the_floor
        """
        standing, stand = data.contacts(m), self.sides[source].stand
        floor = np.min(data.stand_heights(m, standing) - stand)
        above = data.pose(m)[0][:, list(m.skeleton.feet), 2] / m.skeleton.leg - stand - floor
        return data.clean_feet(out, standing, out.skeleton.leg * (self.sides[to].stand + above))


def side_from(arrays, d, k) -> Side:
    """One rig of a checkpoint."""
    names, parents, feet = tuple(d["names"]), tuple(d["parents"]), tuple(d["feet"])
    s = Structure(names, parents, arrays[f"reference{k}"], feet, tuple(d["end"]), d["up"], d["unit"])
    bodies = [Skeleton(names, parents, o, feet) for o in arrays[f"offsets{k}"]]
    home = tuple((int(a), int(b), float(w)) for a, b, w in arrays[f"home{k}"])
    rig = rigs.Rig(d["rig"], s, bodies[0], home, arrays[f"upright{k}"], d["segments"], rigs.character_of(d["rig"]))
    stats = arrays[f"mean{k}"], arrays[f"std{k}"]
    if arrays[f"stand{k}"].shape != (len(feet),):
        raise ValueError(f"stand{k} has not {len(feet)} numbers")
    return Side(rig, bodies, stats=stats, anchor=arrays[f"anchor{k}"], stand=arrays[f"stand{k}"])


def correct(argv) -> int:
    """python -m skeletal correct.  Test: tests/skeletal/test_skeletal_correct.py::test_train_ship_use"""
    opt = cli(CorrectOptions, argv, "python -m skeletal correct", CorrectOptions.__doc__)
    out = Path(opt.out or "runs/correct")
    check_run(out, None)
    check_folders(opt.ship, read=(opt.motion,))
    sides = gather(opt)
    open_run(out, asdict(opt), None)
    copies = copies_between(sides)
    for s in sides:
        print(f"{s.rig.name}: {len(s.names)} joints, {len(s.bodies)} bodies, {len(s.windows)} windows")
    for seed in opt.seeds:
        train(opt, Corrector(opt, sides, seed, copies), out / f"correct-{seed}.npz", seed)
    if opt.ship:
        ship(out / f"correct-{opt.seeds[0]}.npz", opt.ship)
    return 0


def ship(run, path):
    """A checkpoint for others: the networks in half precision, which moves no joint by a millimetre.

    Test      tests/skeletal/test_skeletal_correct.py::test_train_ship_use"""
    arrays, meta = load_checkpoint(run)
    small = {k: v.astype(np.float16) if k.startswith("generator") else v for k, v in arrays.items()}
    save_checkpoint(path, small, meta)


def train(opt, trainer, path, seed):
    """Steps of one seed, with a checkpoint and a line every fifty, and a checkpoint at the end.

    Test      tests/skeletal/test_skeletal_correct.py::test_minutes"""
    progress, recent, curve, start = Progress(opt.steps, 0, f"steps of seed {seed}"), [], [], time.process_time()
    over = False
    while not over:
        for adam in trainer.adams:
            adam.lr = opt.lr * (1.0 - 0.9 * trainer.step_count / opt.steps)
        if row := trainer.step():
            recent.append(row)
        over = trainer.step_count >= opt.steps or time.process_time() - start >= 60 * opt.minutes
        if not over and trainer.step_count % 50:
            continue
        if recent:
            means = {k: float(np.mean([r[k] for r in recent])) for k in recent[0]}
            curve.append({"step": trainer.step_count} | means)
            progress.update(trainer.step_count, {k: f"{v:.3g}" for k, v in means.items()})
            recent = []
        save(path, trainer, opt, curve, seed)


def save(path, trainer, opt, curve, seed):
    """Networks, statistics and bodies, with the data's licence.

    Test      tests/skeletal/test_skeletal_correct.py::test_train_ship_use"""
    asked, motions = [s.rig.name for s in trainer.sides], ["builtin"]
    if opt.motion:
        used = {"bandai": "bandai", "lafan1": "lafan1", "cmu": "cmu-inplace"}
        people = ("bandai", "cmu") if "human" in asked else ()
        motions += [str(Path(opt.motion) / folder) for n, folder in used.items() if n in asked or n in people]
    own = licences(motions)
    meta = {"rigs": meta_of(trainer.sides), "steps": trainer.step_count, "seed": seed, "curve": curve,
            "licence": "weights trained on " + "; on ".join(own) if own else "MIT",
            "weights": trainer.weights, "versions": versions(), "git": git_state()}  # fmt: skip
    save_checkpoint(path, arrays_of(trainer.nets, trainer.sides, trainer.copies), meta)

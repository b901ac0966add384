r"""Skeleton-aware networks: unpaired training of two structures  [SAN §5].

    clips ──► Domain (characters, statistics, windows) ──► Trainer.step ──► checkpoint ──► `ship`

`python -m skeletal train` takes two folders of BVH files (--a, --b: any two rigs with a common primal skeleton), or
makes two families of characters from one (--motion).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import mocap.data
from mocap.data import licences
from nn import Adam
from plumbing.cli import COUNT, NONNEGATIVE, POSITIVE, UserError, arg, cli
from plumbing.runs import (
    CHECKPOINT,
    Journal,
    Means,
    Progress,
    check_run,
    git_state,
    latest_checkpoint,
    load_checkpoint,
    rng_from_state,
    rng_state,
    save_checkpoint,
    versions,
)
from plumbing.training import resumed_options
from skeletal.data import (
    Motion,
    Skeleton,
    Structure,
    aligned,
    derive,
    features,
    folder,
    human_motion,
    proportions,
    reverse,
    truth,
)
from skeletal.layers import CHOICES, PLACE, ROOT, Choices, fk_forward
from skeletal.layers import fk_backward as fk_grad
from skeletal.net import Critic, FakePool, Generator, carry_root, ee_loss, lsgan, ltc_loss, rec_loss

WINDOW, STRIDE = 64, 32  # frames  [SAN, published code]
MIN_STD = 0.02  # ASSUMED: armatures that hardly move are not blown up
TERMS = ("rec", "ltc", "adv", "ee")


# ------------------------------------------------------------------------------------ data of one structure


class Domain:
    r"""Characters of one structure, their statistics and their clips.

    Statistics are per character, as in the published code; one deviation an armature, so that a quaternion's four
    numbers keep their proportions (ASSUMED).  A character of which only the proportions are known gets the mean of the
    trained characters' statistics, weighted by exp(-(d / 0.1)^2 / 2), d the RMS difference of log lengths (ASSUMED)
    Args      characters : Skeletons; clips : (character, Motion) pairs, or None without data; arrays : instead,
              (character, features, turn) of every clip, both ways in time; stats : (mean, std) or None
    Test      tests/skeletal/test_skeletal_train.py::test_statistics
    """

    def __init__(self, characters, clips=None, stats=None, structure=None, arrays=None):
        self.characters, self.structure = list(characters), structure
        first = self.characters[0]
        self.parents, self.names, self.feet = np.array(first.parents), first.names, first.feet
        self.ends = first.graph.leaves
        self.lengths = np.log([self._bones(c) for c in self.characters])
        self.arrays = [(c, *features(m)) for k, m0 in clips or () for c, m in ((k, m0), (k, reverse(m0)))]
        if arrays is not None:
            self.arrays = arrays
        self.mean, self.std = stats if stats is not None else self._statistics()
        self.windows = np.array(
            [(i, at) for i, (_, x, _) in enumerate(self.arrays) for at in range(0, len(x) - WINDOW + 1, STRIDE)]
        )
        self.statics = [self.static(c) for c in self.characters]

    @staticmethod
    def _bones(c):
        return np.maximum(np.linalg.norm(c.offsets[1:], axis=1) / c.leg, 1e-3)

    def static(self, c: Skeleton):
        """(3 J,) offsets, (E,) reach and height of a character, in its legs."""
        return (c.offsets / c.leg).astype(np.float32).ravel(), c.reach() / c.leg, c.height / c.leg

    def _statistics(self):
        means, stds = [], []
        for k in range(len(self.characters)):
            x = np.concatenate([x for c, x, _ in self.arrays if c == k] or [x for _, x, _ in self.arrays])
            v = x.var(axis=0)
            v[:2], v[3:ROOT] = v[:2].mean(), v[3:ROOT].mean()
            v[ROOT:] = np.repeat(v[ROOT:].reshape(-1, 4).mean(axis=1), 4)
            means.append(x.mean(axis=0))
            std = np.sqrt(v)
            std[2:] = np.maximum(std[2:], MIN_STD)
            std[:2] = np.maximum(std[:2], 1e-3)
            stds.append(std)
        return np.array(means, np.float32), np.array(stds, np.float32)

    def statistics_of(self, c: Skeleton):
        """(mean, std) of any character of this structure, from its proportions."""
        d2 = np.mean((self.lengths - np.log(self._bones(c))) ** 2, axis=1)
        if d2.min() < 1e-6:  # bones equal to a tenth of a per cent: that character, whose own it has
            return self.mean[d2.argmin()], self.std[d2.argmin()]
        w = np.exp(-0.5 * (d2 - d2.min()) / 0.1**2)
        w /= w.sum()
        return (w @ self.mean).astype(np.float32), (w @ self.std).astype(np.float32)

    def sample(self, rng, n):
        """n windows: x (C, T, B) standardised, turn (T, B), characters (B,)."""
        picks = self.windows[rng.integers(len(self.windows), size=n)]
        x = np.stack([self.arrays[i][1][a : a + WINDOW] for i, a in picks], axis=-1)  # (T, C, B)
        turn = np.stack([self.arrays[i][2][a : a + WINDOW] for i, a in picks], axis=-1)
        who = np.array([self.arrays[i][0] for i, _ in picks])
        x = np.ascontiguousarray(x.transpose(1, 0, 2))
        return (x - self.mean[who].T[:, None]) / self.std[who].T[:, None], turn, who

    def body(self, who):
        """Of characters (B,): S (3 J, B), offsets (J, 3, B), reach (E, B), height (B,), mean and std (C, 1, B)."""
        s = np.stack([self.statics[k][0] for k in who], axis=-1)
        reach = np.stack([self.statics[k][1] for k in who], axis=-1).astype(np.float32)
        height = np.array([self.statics[k][2] for k in who], np.float32)
        return s, s.reshape(-1, 3, len(who)), reach, height, self.mean[who].T[:, None], self.std[who].T[:, None]


def families(opt) -> tuple:
    """Two families of characters from one set of motions  [GAP]: unpaired, every clip is on one character only.

    The first character of the first structure is the recorded actor.  -> two Domains
    Test      tests/skeletal/test_skeletal_play.py::test_families_are_unpaired
    """
    structure, motions = base_motions(opt, "train", opt.limit)
    rng = np.random.default_rng([opt.seed, 11])
    a = motions[0].skeleton
    b = derive(a)
    cast = [[a] + [proportions(a, rng) for _ in range(opt.characters - 1)],
            [proportions(b, rng) for _ in range(opt.characters)]]  # fmt: skip
    clips = [[], []]
    for i, m in enumerate(motions):
        side, k = i % 2, i // 2 % opt.characters
        clips[side].append((k, m if side == k == 0 else truth(m, cast[side][k])))
    return Domain(cast[0], clips[0], structure=structure), Domain(
        cast[1], clips[1], structure=derived_structure(b, structure)
    )


def derived_structure(b: Skeleton, a: Structure) -> Structure:
    """The family's second structure as a BVH of its own: a zero pose that is the reference pose.

    Test: tests/skeletal/test_skeletal_play.py::test_retarget_command"""
    ref = np.tile([1.0, 0.0, 0.0, 0.0], (len(b.names), 1))
    return Structure(b.names, b.parents, ref, b.feet, (False,) * len(b.names), "z", a.unit)


def base_motions(opt, split, limit):
    """Structure and motions that families are made of: a folder of one rig's files, or the built-in human."""
    if opt.motion == "builtin":
        motions = [human_motion(c) for c in mocap.data.load("builtin", split=split)]
        first = motions[0].skeleton
        keep = [replace(m, skeleton=first) for m in motions][:limit]
        s = Structure(first.names, first.parents, np.tile([1.0, 0, 0, 0], (len(first.names), 1)), first.feet,
                      (False,) * len(first.names), "z", 1.0)  # fmt: skip
        return s, keep
    patterns = tuple(p for p in opt.drop.split(",") if p)
    s, motions = folder(opt.motion, opt.up, patterns, split, opt.clips, limit)
    motions = [m for m in motions if len(m) >= WINDOW]
    if not motions:
        raise UserError(f"{opt.motion}: no clip of {WINDOW} frames at 30 Hz or more; valid: longer ones")
    return s, motions


def own_folders(opt) -> tuple:
    """Two folders of BVH files of two rigs, each file's proportions a character.  -> two Domains

    Raises    UserError: no common primal skeleton
    Test      tests/skeletal/test_skeletal_play.py::test_own_folders
    """
    patterns, domains, first = tuple(p for p in opt.drop.split(",") if p), [], None
    for path in (opt.a, opt.b):
        s, motions = folder(path, opt.up, patterns, "all", opt.clips, opt.limit)
        if first is not None:
            order = aligned(motions[0].skeleton, first)
            s = reorder_structure(s, order)
            motions = [reorder_motion(m, s, order) for m in motions]
        first = first or motions[0].skeleton
        motions = [m for m in motions if len(m) >= WINDOW]
        if not motions:
            raise UserError(f"{path}: no clip of {WINDOW} frames at 30 Hz or more; valid: longer ones")
        cast, clips = [], []
        for m in motions:
            same = (k for k, c in enumerate(cast) if np.allclose(c.offsets, m.skeleton.offsets, atol=1e-3 * c.leg))
            k = next(same, len(cast))
            if k == len(cast):
                cast.append(m.skeleton)
            clips.append((k, replace(m, skeleton=cast[k])))
        domains.append(Domain(cast, clips, structure=s))
    return tuple(domains)


def reorder_structure(s: Structure, order) -> Structure:
    """The same structure with its joints in another order."""
    at = {int(j): i for i, j in enumerate(order)}
    parents = (-1, *(at[s.parents[j]] for j in order[1:]))
    return replace(s, names=tuple(s.names[j] for j in order), parents=parents, reference=s.reference[order],
                   feet=tuple(sorted(at[f] for f in s.feet)), end=tuple(s.end[j] for j in order))  # fmt: skip


def reorder_motion(m: Motion, s: Structure, order) -> Motion:
    """The same motion with its joints in the order of `reorder_structure`'s s."""
    skeleton = Skeleton(s.names, s.parents, m.skeleton.offsets[order], s.feet)
    return replace(m, skeleton=skeleton, quat=m.quat[:, order])


# ------------------------------------------------------------------------------------ training


AGAIN = ("steps", "lr", "save_minutes", "resume", "out")  # may differ when a run goes on


@dataclass
class TrainOptions:
    """Unpaired training of two structures."""

    motion: str = arg("builtin", "folder of one rig's BVH files to make two families of, or builtin")
    a: str | None = arg(None, "instead: folder of BVH files of one rig ...")
    b: str | None = arg(None, "... and of another, whose primal skeleton is the same")
    clips: str = arg("*", "shell pattern on file names")
    drop: str = arg("", "joints to leave out with all below them, shell patterns: *Finger*,*Thumb*")
    up: str = arg("y", "axis of the files that points up", choices=("x", "y", "z", "-x", "-y", "-z"))
    data: str | None = arg(None, "file to keep the prepared windows in: written if it is not there, else read")
    limit: int = arg(240, "clips at most, evenly chosen", check=COUNT)
    characters: int = arg(4, "characters a family", check=COUNT)
    out: str | None = arg(None, "run folder; default runs/skeletal")
    resume: bool = arg(False, "continue the run in --out")
    ship: str | None = arg(None, "only write the generators of the run in --out to this .npz, with the data's licence")
    steps: int = arg(20000, "optimiser steps", check=COUNT)
    batch: int = arg(16, "windows a structure and step; the paper's is 256", check=COUNT)
    lr: float = arg(5e-4, "Adam's learning rate, falling to a tenth at --steps; the paper's is 2e-4", check=POSITIVE)
    intra: float = arg(0.3, "share of the steps that retarget within the structure", check=NONNEGATIVE)
    variant: str = arg("ours", "errata: ours, as printed, or the published code's numbers", choices=tuple(CHOICES))
    pool: str = arg("mean", "skeletal pooling", choices=("mean", "max"))
    root: str | None = arg(
        None, "the root's path and height: from the source in legs, or decoded; default: the variant's",
        choices=("carried", "decoded"),
    )  # fmt: skip
    without: str | None = arg(None, "leave one loss out", choices=TERMS)
    save_minutes: float = arg(5.0, "minutes between checkpoints", check=POSITIVE)
    seed: int = arg(0, "seed")


def choices_of(variant, root=None) -> Choices:
    """The choices of a variant, its root carried or decoded if that is said.  Test:
    tests/skeletal/test_skeletal_train.py::test_root_is_carried"""  # noqa: E501
    choices = CHOICES[variant]
    return replace(choices, carry_root=root == "carried") if root else choices


class Trainer:
    r"""Generators and critics of two structures, and one optimiser step  [SAN §5].

    Test      tests/skeletal/test_skeletal_train.py::test_step_learns, test_resume_is_exact, test_whole_loss_gradient,
              test_direction_by_the_equations, test_critics_tell_fakes
    """

    def __init__(self, opt: TrainOptions, domains, dtype=np.float32, channels=None):
        self.opt, self.domains, self.step_count = opt, domains, 0
        self.choices = choices_of(opt.variant, opt.root)
        more = {"channels": channels} if channels else {}
        init = np.random.default_rng([opt.seed, 1])
        same = lambda: np.random.default_rng([opt.seed, 3])  # noqa: E731
        self.nets = [Generator(d.parents, same(), self.choices, opt.pool, dtype=dtype, **more) for d in domains]
        self.critics = [Critic(d.parents, init, self.choices, dtype=dtype, **more) for d in domains]
        if self.nets[0].n_latent != self.nets[1].n_latent:
            raise ValueError("the structures' latent sizes differ: their primal skeletons do")
        self.adams = [Adam(n.n_params, opt.lr, dtype=dtype) for n in (*self.nets, *self.critics)]
        self.pools = [FakePool(), FakePool()]
        self.rng = np.random.default_rng([opt.seed, 2])
        self.weights = dict(zip(TERMS, self.choices.weights))
        if opt.without:
            self.weights[opt.without] = 0.0

    def direction(self, m, n, batch, targets):
        r"""One direction, A = m to B = n: [SAN-3] forward, the losses, and all gradients by hand.

        Equation  [SAN-8] L = w_rec L_rec + w_ltc L_ltc + w_adv L_adv + w_ee L_ee
        Returns   losses; (real bones, S_A), (fake bones, S_B) for the critics
        """
        A, B, w = self.domains[m], self.domains[n], self.weights
        G, H, C = self.nets[m], self.nets[n], self.critics[n]
        x, turn, who = batch
        s, off, reach, height, mean, std = A.body(who)
        features, static = G.static_forward(s)
        z, encoded = G.encode_forward(x, features)
        raw, carried = x * std + mean, slice(PLACE if self.choices.carry_root else 0)
        real_bones, real_world, _ = fk_forward(raw, off, A.parents, turn)
        losses, dz, df1, df2 = {}, np.zeros_like(z), np.zeros_like(features[1]), np.zeros_like(features[2])
        if w["rec"]:
            y, decoded = G.decode_forward(z, features)
            if self.choices.carry_root:
                carry_root(y, raw, mean, std)
            _, world, kin = fk_forward(y * std + mean, off, A.parents, turn)
            losses["rec"], dy, dworld = rec_loss(y, x, world, real_world, self.choices.position, self.choices.path)
            dy = w["rec"] * (dy + std * fk_grad(None, dworld, kin))
            dy[carried] = 0.0
            d, df2 = G.decode_backward(dy, decoded)
            dz += d
        s_b, off_b, reach_b, height_b, mean_b, std_b = B.body(targets)
        features_b, static_b = H.static_forward(s_b)
        y, decoded = H.decode_forward(z, features_b)  # [SAN-3]
        if self.choices.carry_root:
            carry_root(y, raw, mean_b, std_b)
        bones, world, kin = fk_forward(y * std_b + mean_b, off_b, B.parents, turn)
        dy, df1_b = np.zeros_like(y), np.zeros_like(features_b[1])
        if w["ltc"]:
            z_fake, again = H.encode_forward(y, features_b)
            losses["ltc"], dfake, d = ltc_loss(z_fake, z)
            dz += w["ltc"] * d
            d, df1_b = H.encode_backward(w["ltc"] * dfake, again)
            dy += d
        dbones = dworld = None
        flat = bones.reshape(-1, *bones.shape[2:])
        if w["adv"]:
            score, judged = C.forward(flat, s_b)
            losses["adv"], dscore = lsgan(score, 1.0)
            dbones = C.backward(w["adv"] * dscore, judged).reshape(bones.shape)
        if w["ee"]:
            if self.choices.ee_height:
                reach, reach_b = np.broadcast_to(height, reach.shape), np.broadcast_to(height_b, reach_b.shape)
            losses["ee"], dworld = ee_loss(real_world, world, A.ends, B.ends, reach, reach_b)
            dworld = w["ee"] * dworld
        if dbones is not None or dworld is not None:
            dy += std_b * fk_grad(dbones, dworld, kin)
        dy[carried] = 0.0
        d, df2_b = H.decode_backward(dy, decoded)
        dz += d
        H.static_backward(df1_b, df2_b, static_b)
        _, d = G.encode_backward(dz, encoded, want_dx=False)
        df1 += d
        G.static_backward(df1, df2, static)
        return losses, (real_bones.reshape(-1, *real_bones.shape[2:]), s), (flat, s_b)

    def step(self):
        """One step of both generators, then of both critics; -> mean losses."""
        total, fakes, reals = dict.fromkeys((*TERMS, "critic"), 0.0), [[], []], [None, None]
        for net in (*self.nets, *self.critics):
            net.grad[:] = 0.0
        for m in (0, 1):
            n = m if self.rng.random() < self.opt.intra else 1 - m
            batch = self.domains[m].sample(self.rng, self.opt.batch)
            targets = self.rng.integers(len(self.domains[n].characters), size=self.opt.batch)
            losses, reals[m], fake = self.direction(m, n, batch, targets)
            fakes[n].append(fake)
            for k, v in losses.items():
                total[k] += 0.5 * v
        for net, adam in zip(self.nets, self.adams):
            adam.step(net.theta, net.grad)
        if self.weights["adv"]:
            for n, C in enumerate(self.critics):
                C.grad[:] = 0.0
                for fake in fakes[n]:
                    total["critic"] += 0.5 * self._critic_step(C, reals[n], self.pools[n].exchange(*fake, self.rng))
                if fakes[n]:
                    self.adams[2 + n].step(C.theta, C.grad)
        self.step_count += 1
        return total

    def _critic_step(self, C, real, fake):
        loss = 0.0
        for (bones, s), label in ((real, 1.0), (fake, 0.0)):
            score, cache = C.forward(bones, s)
            value, d = lsgan(score, label)
            C.backward(0.5 * d, cache, want_dx=False)
            loss += 0.5 * value
        return loss

    def arrays(self):
        """All that a resumed run needs beside `meta`."""
        out = {}
        for k, net in enumerate(self.nets):
            out[f"generator{k}"] = net.theta
        for k, net in enumerate(self.critics):
            out[f"critic{k}"] = net.theta
        for k, adam in enumerate(self.adams):
            out |= {f"adam{k}.{name}": v for name, v in adam.state().items()}
        for k, pool in enumerate(self.pools):
            if pool.bones:
                out |= {f"pool{k}.bones": np.stack(pool.bones), f"pool{k}.statics": np.stack(pool.statics)}
        return out | domain_arrays(self.domains)

    def load(self, arrays, meta):
        """Continue from `arrays` and what `meta` holds."""
        for k in (0, 1):
            self.nets[k].theta[:], self.critics[k].theta[:] = arrays[f"generator{k}"], arrays[f"critic{k}"]
            if f"pool{k}.bones" in arrays:
                self.pools[k].bones = list(arrays[f"pool{k}.bones"])
                self.pools[k].statics = list(arrays[f"pool{k}.statics"])
        for k, adam in enumerate(self.adams):
            adam.load_state({name: arrays[f"adam{k}.{name}"] for name in ("t", "m", "v")})
        self.rng, self.step_count = rng_from_state(meta["rng"]), meta["steps"]


def domain_arrays(domains) -> dict:
    """Characters and statistics, for a checkpoint."""
    out = {}
    for k, d in enumerate(domains):
        out |= {f"offsets{k}": np.stack([c.offsets for c in d.characters]), f"mean{k}": d.mean, f"std{k}": d.std}
        out[f"reference{k}"] = d.structure.reference
    return out


def domain_meta(domains) -> list:
    """The rest of it, as JSON."""
    out = []
    for d in domains:
        s = d.structure
        out.append({"names": list(d.names), "parents": [int(p) for p in d.parents], "feet": [int(f) for f in d.feet],
                    "end": [bool(e) for e in s.end], "up": s.up, "unit": s.unit})  # fmt: skip
    return out


def prepared(opt) -> tuple:
    """The two Domains of `families` or `own_folders`; from the file --data where it is there.

    Test: tests/skeletal/test_skeletal_play.py::test_train_command"""
    if opt.data and Path(opt.data).exists():
        arrays, meta = load_checkpoint(opt.data)
        return domains_from(arrays, meta, opt.data)
    domains = own_folders(opt) if opt.a else families(opt)
    if opt.data:
        arrays = domain_arrays(domains)
        for k, d in enumerate(domains):
            who, x, turn = zip(*d.arrays)
            arrays |= {f"who{k}": np.array(who), f"long{k}": np.array([len(v) for v in x]), f"x{k}": np.concatenate(x),
                       f"turn{k}": np.concatenate(turn)}  # fmt: skip
        save_checkpoint(opt.data, arrays, {"domains": domain_meta(domains), "motions": origins(opt)})
    return domains


def origins(opt) -> list:
    """The folders that a run's motions come from, whose licences its weights have; of --data, those it was made of.

    Test: tests/skeletal/test_skeletal_play.py::test_licence_is_the_motions"""
    if opt.data and Path(opt.data).exists() and (kept := load_checkpoint(opt.data)[1].get("motions")):
        return kept
    return [opt.a, opt.b] if opt.a else [opt.motion]


def domains_from(arrays, meta, path) -> tuple:
    """Two Domains from a checkpoint: without clips, or from a file of --data with them.

    Raises    UserError: something is missing
    Test      tests/skeletal/test_skeletal_play.py::test_ship_and_load
    """
    try:
        out = []
        for k, d in enumerate(meta["domains"]):
            names, parents, feet = tuple(d["names"]), tuple(d["parents"]), tuple(d["feet"])
            s = Structure(names, parents, arrays[f"reference{k}"], feet, tuple(d["end"]), d["up"], d["unit"])
            cast = [Skeleton(names, parents, o, feet) for o in arrays[f"offsets{k}"]]
            clips = None
            if f"x{k}" in arrays:
                cuts = np.cumsum(arrays[f"long{k}"])[:-1]
                x, turn = (np.split(arrays[f"{v}{k}"], cuts) for v in ("x", "turn"))
                clips = list(zip((int(w) for w in arrays[f"who{k}"]), x, turn))
            out.append(Domain(cast, stats=(arrays[f"mean{k}"], arrays[f"std{k}"]), structure=s, arrays=clips))
        return tuple(out)
    except (KeyError, TypeError, IndexError) as e:
        raise UserError(
            f"{path}: no skeletal checkpoint ({type(e).__name__}: {e}); valid: one of python -m skeletal train"
        ) from None


def train(argv) -> int:
    """python -m skeletal train.  Test: tests/skeletal/test_skeletal_play.py::test_train_command"""
    opt = cli(TrainOptions, argv, "python -m skeletal train", TrainOptions.__doc__)
    out = Path(opt.out or "runs/skeletal")
    if opt.ship:
        meta = ship(out, opt.ship)
        print(f"{opt.ship}: {meta['steps']} steps; {meta['licence']}")
        return 0
    check_run(out, opt.resume)
    if opt.resume:
        opt = resumed_options(replace(opt, out=str(out)), argv, AGAIN)
    if (opt.a is None) != (opt.b is None):
        raise UserError("--a and --b go together: two folders of two rigs; or give --motion alone")
    domains, origin = prepared(opt), origins(opt)
    for name, d in zip("AB", domains):
        print(f"{name}: {len(d.names)} joints, {len(d.characters)} characters, {len(d.windows)} windows")
    if not all(len(d.windows) for d in domains):
        raise UserError(f"no window of {WINDOW} frames in one of the two sets; valid: longer clips")
    trainer, rows = Trainer(opt, domains), None
    if opt.resume and (found := latest_checkpoint(out)):
        trainer.load(*found)
        rows = found[1]["rows"]

    def save(rows):
        meta = {"steps": trainer.step_count, "rows": rows, "rng": rng_state(trainer.rng)}
        meta |= {"variant": opt.variant, "root": "carried" if trainer.choices.carry_root else "decoded"}
        meta |= {"pool": opt.pool, "motions": origin, "domains": domain_meta(domains)}
        save_checkpoint(out / CHECKPOINT, trainer.arrays(), meta)

    means, progress = Means(), Progress(opt.steps, trainer.step_count)
    with Journal(out, opt, opt.resume, rows, progress, save, 60 * opt.save_minutes) as journal:
        while trainer.step_count < opt.steps and not journal.stop:
            for adam in trainer.adams:
                adam.lr = opt.lr * (1.0 - 0.9 * trainer.step_count / opt.steps)
            means.add(trainer.step())
            if trainer.step_count % 50 == 0 or trainer.step_count == opt.steps:
                row = means.take()
                line = {k: f"{v:.4g}" for k, v in row.items()}
                journal.write(trainer.step_count, {"step": trainer.step_count} | row, line)
    if journal.stop:
        print(f"stopped at {trainer.step_count} steps; continue with: python -m skeletal train --resume --out {out}")
    return 0


def ship(run, path) -> dict:
    """The generators, characters and statistics of a run, for others to use, with the data's licence.

    Raises    UserError: the run has no checkpoint, or the path cannot be written
    Test      tests/skeletal/test_skeletal_play.py::test_ship_and_load
    """
    found = latest_checkpoint(run)
    if not found:
        raise UserError(f"{run} has no checkpoint; valid: a folder that python -m skeletal train wrote")
    arrays, meta = found
    keep = {k: v for k, v in arrays.items() if not k.startswith(("adam", "critic", "pool"))}
    motions = meta.get("motions") or [meta["motion"]]  # one word in older runs
    own = licences(motions)
    licence = "weights trained on " + "; on ".join(own) if own else "MIT"
    meta = {k: v for k, v in meta.items() if k not in ("rng", "rows", "motions")}
    meta |= {"motion": ", ".join(Path(m).name for m in motions), "licence": licence}
    meta |= {"versions": versions(), "git": git_state()}
    save_checkpoint(path, keep, meta)
    return meta

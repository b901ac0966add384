r"""Training as the shipped policies began: a curriculum of starts, other users and devices  (ours, beyond the paper).

    python -m extras.train --character dino --motion FOLDER --out runs/a        by [training] in characters/dino.toml
    python -m extras.train --gpu --character jesse --motion FOLDER --envs 8192  on an NVIDIA GPU (extra gpu)
    python -m extras.train --recipe none --character jesse --balance            by defaults, and what is given

    clips ──► augment, visits ──► retarget ──► Reference ──► Env(starts=Curriculum, disturbance=Disturbance) ──► ppo.run
                                                   └──► cache/KEY.npz, beside the run

`python ppo.py --character NAME` comes here by itself where the recipe says `by = "extras.train"`.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import character
import ppo
import retarget
from env import EPISODE_STEPS, ROOT_LIMIT, WITHOUT, Env, Uniform, ablated, headset_only
from extras import gpu
from headset import body
from human import quat_conj, quat_mul
from mocap import augment, data
from mocap.rigs import Reading
from plumbing.cli import NONNEGATIVE, POSITIVE, UNIT, UserError, arg, run_main
from plumbing.files import atomic_write
from plumbing.runs import fmt_time, load_checkpoint
from plumbing.training import read_options, say_idle
from policy import initial, widths
from retarget import Reference

RETRY, PLACES = (3, 60), 512  # ASSUMED: steps before a failure from which it is tried again; failures remembered
LATE = 1.5  # ASSUMED: s for which a fast user excuses that the character is late
MOST = 2.0  # ASSUMED: a beginning that fails more often than so many times the mean is drawn no more often for it
SHORTEST = 1.0  # s of a clip that is made a visit
RUNS = 2.0  # m/s, ASSUMED: a stitched sequence with a faster second is made visits, too
FEW, MORE = 100, 2  # ASSUMED: visits of parts of --motion that have fewer clips are made by so many more other users
EARLY = 8  # first frames of a recording, ASSUMED: a start among them has its transient
PLAYERS_STAND = 1.5  # ASSUMED: s at a recording's beginning in which a player stands well enough to start under
AIDED = 10.0  # s between failures, ASSUMED: sequences that do as well are not aided
REACHED = 0.5  # s, ASSUMED: in which the hand that aids would have the root at its target
PUSH_EVERY = 2.0  # s, mean time between pushes
CODE = 7  # counts up when retargeting or augmenting changes what it makes: older caches are then made anew
CHUNK = 100  # clips retargeted between two lines of progress


@dataclass
class Options(ppo.Options):
    """ppo.py's options, and the curriculum's."""

    BY = "extras.train"

    balance: bool = arg(False, "start more often where episodes end soon, so that all motion is simulated equally long")
    retry: float = arg(0.0, "share of episodes that start up to 2 s before a place where one failed", check=UNIT)
    stand: float = arg(0.0, "share that start in the default pose under the headset, as a stream does", check=UNIT)
    begin: float = arg(
        0.0, "share that start so under a user who stands, then sets off into a clip, and stands again", check=UNIT
    )
    early: float = arg(
        0.0, "share that start in the first frames of recordings in motion, as `tracked` does", check=UNIT
    )
    kinds: float = arg(0.0, "share of the starts that goes to kinds of motion by how often each fails", check=UNIT)
    players: str | None = arg(
        None, "also the people of a headset's recordings (a folder of .csv files), with bodies (headset/body.py)"
    )
    visits: bool = arg(False, "also every clip with a user who stands before and after it; --begin has them, too")
    augment: bool = arg(False, "also mirrored clips at other speeds, by users of other heights and arm lengths")
    sensor_offset: float = arg(0.0, "constant error of device positions in an episode [m]", check=NONNEGATIVE)
    sensor_noise: float = arg(0.0, "white noise on device positions [m]", check=NONNEGATIVE)
    push: float = arg(0.0, "largest random push, every 2 s on average [m/s]", check=NONNEGATIVE)
    aid: float = arg(
        0.0,
        "where a sequence fails often a hand leads the root: at most so much of its velocity's error goes a step",
        check=UNIT,
    )
    root_limit: float = arg(ROOT_LIMIT, "an episode ends as far from the root's target [§3.6: 0.30 m]", check=POSITIVE)
    near: float | None = arg(
        None, "--root-limit of sequences that begin in motion, if it is another [m]", check=POSITIVE
    )
    root_lag: float = arg(
        0.0, "seconds of the user's own speed of late that are added to it: who runs may be late", check=NONNEGATIVE
    )
    episode: int = arg(EPISODE_STEPS, "control steps to truncation [§3.6]", check=POSITIVE)
    solver: str = arg("pgs", "of contacts: pgs, or newton, exact, as when playing", tuple(character.SOLVERS))
    gpu: bool = arg(False, "train on an NVIDIA GPU (extra gpu); give thousands of --envs")


# ------------------------------------------------------------------------------------ where episodes start


class Curriculum(Uniform):
    r"""Starts where it fails, and as a headset's user starts.

    Equation  uniform over all frames [§3.6]; with `balance` half of the simulated time is shared out by frames and half
              by frames × rate of failure:  p(sequence) ∝ frames (1 + h / ⟨h⟩) / E[T],  E[T] = (1 − e^{−hH}) / h, within
              the sequence uniform.  A share `retry` starts RETRY steps before a place where an episode failed of late.
              A share `early` starts in the first EARLY frames of sequences that begin in motion, drawn by
              1 + min(h / ⟨h⟩, MOST).  A share `begin` starts in the still frames before a visit, in sequences drawn so
              with `balance`, evenly without.  Those stand in the default pose, and a share `stand` of all.
              A share `kinds` of the time and of the beginnings is shared out among kinds of motion by how often each
              fails, times the square root of its frames, and within a kind by frames × h, of beginnings by
              min(h / ⟨h⟩, MOST)  (`by_kind`)
    Symbols   h failures a step, of late (`count`); ⟨h⟩ its mean over frames, of beginnings over sequences; H horizon;
              T steps of an episode
    Why       after a while most failures are in a few sequences, and a uniform draw spends its steps on the others;
              within them they are at a few places, such as the first steps of a run.  And a policy that has always been
              put into mid-motion has never set off.  What has few recordings is not what users do seldom: sixty
              gestures and steps backwards beside nine hundred walks and runs were one start in thirty, and not learnt.
              Recordings of runs begin while their user speeds up; one start in 500 is there, and there `tracked` fails
    Note      with `balance` a failure of a start in the default pose counts as one of the sequence that it was in
    Test      tests/extras/test_train.py::test_balanced_starts, test_retried_starts, test_begun_starts,
              test_kinds_of_starts, test_early_starts
    """

    def __init__(
        self, ref: Reference, horizon=EPISODE_STEPS, balance=False, retry=0.0, stand=0.0, begin=0.0, kinds=0.0,
        kind=None, early=0.0,
    ):  # fmt: skip
        """kind : (S,) of each sequence, 0, 1, …  (`kind_of`); all of one by default"""
        super().__init__(ref)
        self.horizon, self.balance, self.retry, self.stand, self.begin = horizon, balance, retry, stand, begin
        self.kinds, self.kind = kinds, np.zeros(len(ref.first), int) if kind is None else np.asarray(kind)
        self.failed = np.full(len(ref.first), 0.5)  # of each sequence, failures and steps lived, of late
        self.lived = np.full(len(ref.first), float(horizon))
        self.lost = np.zeros(PLACES, int)  # frames at which episodes failed of late; 0: none yet
        self.early, self.leads = early, np.flatnonzero(ref.still > 1)  # sequences that begin with a user who stands
        self.moving = np.flatnonzero((ref.still <= 1) & (ref.last - ref.first > EARLY))
        if begin and not len(self.leads):
            raise UserError(f"--begin {begin}: no sequence begins with a user who stands; valid: 0, or with visits")
        if early and not len(self.moving):
            raise UserError(f"--early {early}: every sequence begins with a user who stands; valid: 0")

    def draw(self, rng, n):
        """As `Uniform.draw`: frames (n,), and which start in the default pose (n,) bool."""
        f = self.balanced(rng, n) if self.balance or self.kinds else rng.choice(self.frames, n)
        if self.early:
            f = np.where(rng.random(n) < self.early, self.first_frames(rng, n), f)
        if self.retry:
            place = self.lost[rng.integers(PLACES, size=n)]
            before = place - rng.integers(*RETRY, size=n)
            again = (rng.random(n) < self.retry) & (place > 0)
            f = np.where(again, np.maximum(before, self.ref.first[self.owner[place]] + 1), f)
        upright = np.zeros(n, bool)
        if self.begin:
            upright = rng.random(n) < self.begin
            f = np.where(upright, self.beginnings(rng, n), f)
        if self.stand:
            upright |= rng.random(n) < self.stand
        return f, upright

    def balanced(self, rng, n):
        """Frames (n,): sequences by how often they are wanted, frames within them evenly."""
        ref = self.ref
        frames = np.maximum(ref.last - ref.first - 1, 0)  # that can be started from
        h = np.maximum(self.failed / self.lived, 1e-6)
        steps = -np.expm1(-h * self.horizon) / h  # E[T]
        time = frames * (1.0 + h / np.average(h, weights=frames) if self.balance else steps)
        weights = by_kind(time, frames * h, frames, self.kind, self.kinds) / steps
        k = drawn(rng, weights, n)
        return ref.first[k] + 1 + (frames[k] * rng.random(n)).astype(int)

    def beginnings(self, rng, n):
        """Frames (n,) among the still ones at the beginning of the sequences that have some."""
        ref, k = self.ref, self.leads
        hard = self.hardness(k)
        p = 1.0 + hard if self.balance else np.ones(len(k))
        k = k[drawn(rng, by_kind(p, hard, np.ones(len(k)), self.kind[k], self.kinds), n)]
        return ref.first[k] + 1 + (rng.random(n) * (ref.still[k] - 1)).astype(int)

    def hardness(self, k):
        """min(h / ⟨h⟩, MOST) of the sequences k, by their numbers of failures a step.  -> (len(k),)"""
        h = np.maximum(self.failed[k] / self.lived[k], 1e-6)
        return np.minimum(h / h.mean(), MOST)

    def first_frames(self, rng, n):
        """Frames (n,) among the first EARLY of sequences that begin in motion."""
        k = self.moving[drawn(rng, 1.0 + self.hardness(self.moving), n)]
        return self.ref.first[k] + 1 + rng.integers(0, EARLY, n)

    def count(self, rng, frames, failed, steps):
        """Running counts of failures and of steps lived per sequence, decayed by 0.9 at each episode's end; and the
        frames of the failures, each in the place of any earlier one.

        Args      frames, failed, steps : (m,) of the episodes that ended
        Test      tests/extras/test_train.py::test_balanced_starts, test_retried_starts"""
        if self.retry:
            lost = frames[failed]
            self.lost[rng.integers(PLACES, size=len(lost))] = lost
        k, sequences = self.owner[frames], len(self.failed)
        kept = 0.9 ** np.bincount(k, minlength=sequences)
        self.failed[:] = kept * self.failed + np.bincount(k, failed, sequences)
        self.lived[:] = kept * self.lived + np.bincount(k, steps, sequences)

    def state(self):
        """Arrays that a resumed run needs."""
        return {name: getattr(self, name).copy() for name in ("failed", "lived", "lost")}

    def load_state(self, arrays):
        """Continue from what `state` returned.  ValueError: another run's"""
        if arrays["lost"].max() >= len(self.owner):
            raise ValueError(f"env.starts.lost is beyond the motions' {len(self.owner)} frames")
        if not (np.all(arrays["failed"] >= 0) and np.all(arrays["lived"] > 0)):
            raise ValueError("env.starts.failed or lived is negative")
        for name, value in arrays.items():
            getattr(self, name)[:] = value


def drawn(rng, weights, n) -> np.ndarray:
    """n indices by their weights (S,) >= 0.  Test: tests/extras/test_train.py::test_balanced_starts"""
    cdf = np.cumsum(weights)
    return np.searchsorted(cdf, cdf[-1] * rng.random(n), side="right").clip(0, len(cdf) - 1)


def by_kind(p, failing, size, kind, share):
    r"""Weights of which a share is divided among kinds of motion, by how often each fails and the square root of
    how much is recorded of it.

    Equation  p' = (1 − share) p / Σ p + share (r_K / Σ r) f / Σ_K f,  r_K = √s_K min(f_K / s_K, MOST ⟨f_K / s_K⟩),
              f_K and s_K the sums over kind K, ⟨·⟩ the mean over the kinds that have any weight
    Why       √s_K: kinds of one or two captures that fail whatever is done would take nearly half of the share
    Args      p, failing (f), size (s) : (S,) weights ≥ 0; kind : (S,) int; share in [0, 1]
    Returns   (S,), whose sum is 1
    Test      tests/extras/test_train.py::test_kinds_of_starts"""
    total, sizes = np.bincount(kind, failing), np.bincount(kind, size)
    rate = np.divide(total, sizes, out=np.zeros(len(total)), where=total > 0)
    rate = np.minimum(rate, MOST * rate[total > 0].mean()) * np.sqrt(sizes)
    own = (rate / rate.sum() / np.where(total > 0, total, 1.0))[kind]
    return (1.0 - share) * p / p.sum() + share * own * failing


class Disturbance:
    r"""What training adds: so that a policy survives other users and devices, or, `aid`, so that it learns at all.

    sensor_offset : standard deviation of a constant error of each device's position in an episode [m]
    sensor_noise  : of white noise on it [m]
    push          : largest change of the root's horizontal velocity in a push [m/s]
    aid           : largest α of a hand that leads the root to its target
    error         : (n, 3, 3 devices) of the devices' positions, in the heading frame: constant, of the frame before, of
                    this frame
    pull          : (n,) α of the present episodes
    Equation  before a control step  v ← v + α (v̂ + (p̂ − p) / REACHED − v),  ω ← ω + α (ω̂ + φ / REACHED − ω);
              α = aid u max(0, 1 − T / AIDED),  u uniform in [0, 1] for each episode
    Symbols   p, v, ω the root's, hats its target's of the next frame; φ the turn from one to the other, 2 Im(q⁻¹ q̂);
              T seconds between the failures of the episode's sequence, of late
    Why       noise does not find the first step backwards: a character that stands is safe until it is too far.  Led
              by the hand it steps, by the reward for its legs, and the hand lets go as it fails less
    Source    the idea of an assistant that withdraws: Yu, Turk, Liu 2018, "Learning Symmetric and Low-Energy
              Locomotion", ACM TOG 37(4)
    Test      tests/extras/test_train.py::test_disturbance, test_aid
    """

    def __init__(self, n, devices=3, sensor_offset=0.0, sensor_noise=0.0, push=0.0, aid=0.0):
        self.sensor_offset, self.sensor_noise, self.push, self.aid = sensor_offset, sensor_noise, push, aid
        self.error, self.pull = np.zeros((n, 3, 3 * devices)), np.zeros(n)

    def begin(self, env, ids):
        """Other devices, and another hand, for the episodes that begin in the environments ids."""
        if self.sensor_offset:
            self.error[ids, 0] = self.sensor_offset * env.rng.standard_normal(self.error[ids, 0].shape)
        if self.aid:
            k, starts = env.sequence[ids], env.starts
            apart = env.dt * starts.lived[k] / np.maximum(starts.failed[k], 1e-6)  # T
            self.pull[ids] = self.aid * np.maximum(1.0 - apart / AIDED, 0.0) * env.rng.random(len(ids))

    def step(self, env):
        """Before a control step: the hand that aids, pushes, and the next frame's sensor noise."""
        rng = env.rng
        if self.aid:
            self._lead(env)
        if self.push:
            pushed = np.flatnonzero(rng.random(env.n) < env.dt / PUSH_EVERY)
            angle, size = rng.uniform(0, 2 * np.pi, len(pushed)), rng.uniform(0, self.push, len(pushed))
            env.qvel[pushed, 0] += size * np.cos(angle)
            env.qvel[pushed, 1] += size * np.sin(angle)
        if self.sensor_noise:
            self.error[:, 1] = self.error[:, 2]
            self.error[:, 2] = self.sensor_noise * rng.standard_normal(self.error[:, 2].shape)

    def _lead(self, env):
        """The root's velocities (MuJoCo's: v in the world, ω in the root's frame) towards those that reach the target.

        Test      tests/extras/test_train.py::test_aid"""
        led, ref = np.flatnonzero(self.pull), env.ref
        f = np.minimum(env.frame[led] + 1, ref.last[env.sequence[led]])
        turn = quat_mul(quat_conj(env.qpos[led, 3:7]), ref.qpos[f, 3:7])
        phi = 2.0 * np.sign(turn[:, :1]) * turn[:, 1:]
        way = np.concatenate([ref.qpos[f, :3] - env.qpos[led, :3], phi], axis=1) / REACHED
        env.qvel[led, :6] += self.pull[led, None] * (ref.qvel[f, :6] + way - env.qvel[led, :6])

    def errors(self, ids):
        """What the environments ids see wrong, of the frame before and of this one: two of (m, 3 devices) [m]"""
        constant, before, now = np.moveaxis(self.error[ids], 1, 0)
        return constant + before, constant + now

    def state(self):
        """Arrays that a resumed run needs."""
        return {"error": self.error.copy(), "pull": self.pull.copy()}

    def load_state(self, arrays):
        """Continue from what `state` returned."""
        self.error[:], self.pull[:] = arrays["error"], arrays["pull"]


# ------------------------------------------------------------------------------------ motions, read once


def clips_of(opt: Options) -> list:
    """The stitched training sequences; with `augment` twice, with `visits` every single clip as a visit, too, and every
    sequence that runs: a run of two seconds is over before its user has sped up.  Visits of parts of --motion that have
    fewer than FEW clips are made by MORE other users.

    Test      tests/extras/test_train.py::test_clips"""
    reading, single, clips, runs, few = Reading.of(opt), [], [], [], []
    data.check_unseen(data.parts(opt.motion), "train")
    if opt.players:
        body.recordings_of(opt.players)
    for each in data.parts(opt.motion):  # as `data.sequences`, but the single clips are wanted, too, and read once
        say(f"reading {each}")
        found = data.load(each, clips=opt.clips, split="train", reading=reading)
        made = data.stitched(found, f"{each} [train]", opt.seed)
        single, clips, once = single + found, clips + made, set(map(id, found))
        few += found if len(found) < FEW else []
        runs += [c for c in made if id(c) not in once and augment.fastest_second(c) > RUNS]
    if opt.augment:
        say(f"augmenting {len(clips)} sequences")
        clips = augment.augment(clips, np.random.default_rng([opt.seed, 3]))
    if opt.visits or opt.begin:
        single = [c for c in single if c.seconds >= SHORTEST] + runs
        if not single:
            raise UserError(f"--motion {opt.motion}: no clip of {SHORTEST:g} s or more to make a visit of")
        say(f"making visits of {len(single)} clips")
        clips = clips + augment.visits(single, np.random.default_rng([opt.seed, 5]))
        few = [c for c in few if c.seconds >= SHORTEST]
        for k in range(MORE if few else 0):
            again = augment.visits(few, np.random.default_rng([opt.seed, 7, k]))
            clips += again[len(again) // 2 :]  # the other users' half
    if opt.players:
        say(f"bodies for the recordings of {opt.players}")
        people = body.players(opt.players)
        clips = clips + augment.visits(people, np.random.default_rng([opt.seed, 6]))
        clips += [replace(c, still=round(PLAYERS_STAND * c.rate)) for c in people]
    return clips


CHANGED = re.compile(r"(\+\d+)?(-mirrored.*)?(-visit)?$")  # what stitching, `augment` and `visits` add to a name


def kind_of(names, opt: Options) -> np.ndarray:
    """The kind of motion of each sequence: which part of --motion or --players it is from (what is built in counts as
    one), the first word of its name that has no digit, `walk-back` of dataset-1_walk-back_active_001, and whether it is
    played backwards (`augment.reverse`).

    Args      names : of sequences, as a Reference has them
    Returns   (S,) int, 0, 1, … in order of their first appearance
    Test      tests/extras/test_train.py::test_kinds_of_starts"""
    found, kinds = {}, {}
    for i, part in enumerate([*data.parts(opt.motion), *([opt.players] if opt.players else [])], 1):
        path = Path(part)
        if part not in data.BUILTIN:
            found |= {f.stem: i for f in (path.rglob("*") if path.is_dir() else [path])}
    recorded = [CHANGED.sub("", name) for name in names]
    words = [next((w for w in name.split("_") if not re.search(r"\d", w)), "") for name in recorded]
    keys = [
        (found.get(short, 0), word, "-reversed" in name)
        for name, short, word in zip(names, recorded, words, strict=True)
    ]
    return np.array([kinds.setdefault(key, len(kinds)) for key in keys])


def say(text):
    """A line of progress, at once.  Test: tests/extras/test_train.py::test_cache"""
    print(text, flush=True)


def retargeted(char, clips) -> Reference:
    """`retarget.reference` of many clips, with lines of progress.

    Test      tests/extras/test_train.py::test_retargeted_in_parts"""
    parts, began = [], time.perf_counter()
    for k in range(0, len(clips), CHUNK):
        parts.append(retarget.reference(char, clips[k : k + CHUNK]))
        done = min(k + CHUNK, len(clips))
        left = (time.perf_counter() - began) * (len(clips) - done) / done
        say(f"retargeted {done} of {len(clips)} clips" + (f", {fmt_time(left)} left" if done < len(clips) else ""))
    return joined(parts)


def joined(parts: list) -> Reference:
    """References laid end to end.  Test: tests/extras/test_train.py::test_retargeted_in_parts"""
    if len(parts) == 1:
        return parts[0]
    starts = np.cumsum([0, *(len(p) for p in parts[:-1])])
    values = {"names": [name for p in parts for name in p.names], "rate": parts[0].rate}
    for f in fields(Reference):
        if f.name in ("first", "last"):
            values[f.name] = np.concatenate([getattr(p, f.name) + s for p, s in zip(parts, starts, strict=True)])
        elif f.name not in values:
            values[f.name] = np.concatenate([getattr(p, f.name) for p in parts])
    return Reference(**values)


def key_of(opt: Options, char) -> str:
    """A name for the reference that these options make of these files.

    Made of    the character's tables and model, the options that matter, name, size and time of every file, and CODE
    Test       tests/extras/test_train.py::test_cache
    """
    m, names = char.model, [*(f.name for f in fields(data.MotionFlags)), "seed", "augment", "players"]
    asked = {name: getattr(opt, name) for name in names} | {"visits": opt.visits or opt.begin > 0}
    paths = [Path(p) for p in data.parts(opt.motion) if p not in data.BUILTIN]
    paths += [Path(p) for p in (opt.joint_map, opt.players) if p]
    found = (f for p in paths for f in (sorted(p.rglob("*")) if p.is_dir() else [p]) if f.is_file())
    files = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in found]
    tables = {k: v for k, v in char.spec.items() if k not in ("torque", "passive", "reward", "training")}
    shapes = m.body_pos, m.body_quat, m.jnt_pos, m.jnt_axis, m.jnt_range, m.site_pos, m.geom_type
    shapes += m.geom_pos, m.geom_quat, m.geom_size
    body = [tables, char.default.tolist(), char.reward_links.tolist(), *(a.tolist() for a in shapes)]
    text = json.dumps([CODE, asked, files, body], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def reference_of(opt: Options, char) -> Reference:
    """The training motions retargeted to a character: from cache/KEY.npz beside the run, or made and written there.

    A cache that is damaged, or cannot be written, costs a line and the time to make it.
    Test      tests/extras/test_train.py::test_cache, test_damaged_cache"""
    path = Path(opt.out).parent / "cache" / f"{key_of(opt, char)}.npz"
    if path.is_file():
        try:
            ref = read_reference(path, char)
            say(f"{len(ref.names)} sequences, {len(ref) / ref.rate / 60:.1f} min, retargeted before: {path}")
            return ref
        except UserError as e:
            print(f"note: {e}; it is made anew", file=sys.stderr)
    ref = retargeted(char, clips_of(opt))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_reference(path, ref)
    except (OSError, UserError) as e:
        print(f"note: not kept for the next run: {e}", file=sys.stderr)
    return ref


def write_reference(path, ref: Reference):
    """One array after the other into a .npz that `load_checkpoint` reads, whole or not at all.

    Test      tests/extras/test_train.py::test_cache"""
    arrays = {f.name: getattr(ref, f.name) for f in fields(Reference) if f.name not in ("names", "rate")}
    meta = np.frombuffer(json.dumps({"names": ref.names, "rate": ref.rate}).encode(), np.uint8)
    atomic_write(path, lambda file: np.savez(file, allow_pickle=False, __meta__=meta, **arrays))


def read_reference(path, char) -> Reference:
    """What `write_reference` wrote.  UserError: damaged, or of another character

    Test      tests/extras/test_train.py::test_damaged_cache"""
    arrays, meta = load_checkpoint(path, ("qpos", "qvel", "link_*", "sensor_*", "human_*", "orientation", "*scale"))
    inner = {"qpos": (char.model.nq,), "qvel": (char.model.nv,), "orientation": (2, 4), "contact": (2,)}
    inner |= {"link_pos": (len(char.reward_links), 3), "link_vel": (len(char.reward_links), 3)}
    inner |= {"sensor_pos": (3, 3), "sensor_rot": (3, 3, 2), "sensor_quat": (3, 4), "scale": (3,), "sensor_scale": (3,)}
    inner |= {"human_pos": (15, 3), "human_rot": (15, 3, 2)}
    try:
        frames, sequences = len(arrays["qpos"]), len(meta["names"])
        need = {name: (frames, *shape) for name, shape in inner.items()}
        need |= dict.fromkeys(("first", "last", "still"), (sequences,))
        have = {name: a.shape for name, a in arrays.items()}
        if have != need:
            raise ValueError(f"arrays {have}, expected {need}")
        first, last = arrays["first"], arrays["last"]
        whole = sequences and first[0] == 0 and last[-1] == frames - 1 and np.all(first[1:] == last[:-1] + 1)
        if not (whole and np.all(last >= first) and arrays["still"].min() >= 0 and meta["rate"] > 0):
            raise ValueError("its sequences do not lie end to end")
        return Reference(names=list(map(str, meta["names"])), rate=float(meta["rate"]), **arrays)
    except (KeyError, TypeError, ValueError, IndexError) as e:
        raise UserError(f"{path}: no reference of {char.name} ({e})") from None


# ------------------------------------------------------------------------------------ training


def patience(ref: Reference, limit, lag, near=None):
    r"""How far from its target the root may be at each frame: farther under a fast user than under one who stands.

    Equation  limit + lag × the user's highest speed in the last LATE seconds; limit is `near` in sequences that do not
              begin with a user who stands
    Why       with one limit for all, a character that may be late for a run may also wander off from a user who waves,
              and one that may catch up with a user who set off need not keep up with one who runs
    Returns   (F,) [m]
    Test      tests/extras/test_train.py::test_patience"""
    speed = np.linalg.norm(ref.qvel[:, :2], axis=1)
    out = np.empty(len(ref))
    n = round(LATE * ref.rate)
    for a, b, still in zip(ref.first, ref.last, ref.still, strict=True):
        part = np.concatenate([np.zeros(n - 1), speed[a : b + 1]])
        out[a : b + 1] = lag * np.lib.stride_tricks.sliding_window_view(part, n).max(axis=1)
        out[a : b + 1] += limit if near is None or still > 1 else near
    return out


def make_env(opt: Options) -> Env:
    """The character, its motions, and the curriculum, as `ppo.make_env` without the last.

    Test      tests/extras/test_train.py::test_switches_reach_the_environment"""
    whole = opt.load()
    say_idle(whole, {name: WITHOUT[name] for name in opt.without})
    char = ablated(whole, opt.without, opt.track).solved_by(opt.solver)
    ref = reference_of(opt, char)
    ref = headset_only(ref) if opt.sensors == "hmd" else ref
    added = {name: getattr(opt, name) for name in ("sensor_offset", "sensor_noise", "push", "aid")}
    starts = {name: getattr(opt, name) for name in ("balance", "retry", "stand", "begin", "kinds", "early")}
    counted = any(starts.values()) or opt.aid  # failures by sequence
    return Env(
        char,
        ref,
        opt.envs,
        opt.seed,
        opt.threads,
        opt.episode,
        disturbance=Disturbance(opt.envs, ref.sensor_pos.shape[1], **added) if any(added.values()) else None,
        asymmetric="asymmetric" not in opt.without,
        starts=Curriculum(ref, opt.episode, **starts, kind=kind_of(ref.names, opt)) if counted else None,
        root_limit=patience(ref, opt.root_limit, opt.root_lag, opt.near),
    )


def train(opt: Options) -> ppo.Trainer:
    """Train by the options, or resume.  Test: tests/extras/test_train.py::test_resume_is_exact_when_disturbed"""
    if opt.gpu and opt.resume:
        raise UserError("--gpu goes on with --init, for its random numbers are not stored: leave --resume out")
    env = make_env(opt)
    if not opt.gpu:
        return ppo.train(opt, env)
    policy, before = initial(opt.init, opt, env) if opt.init else (None, 0)
    trainer = gpu.moved(gpu.Trainer(opt, env, policy))
    with gpu.arrays_of(trainer):
        ppo.run(trainer, before=before)
    return trainer


def main(argv=None):
    """python -m extras.train: by the character's recipe.  Test: tests/extras/test_train.py::test_ppo_hands_on"""
    train(read_options(Options, argv, "extras.train", __doc__, widths))


if __name__ == "__main__":
    run_main(main)

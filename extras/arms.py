r"""The paper's ablations, each from scratch: an arm is a line of a table  [Reda23 §3.5.1, §4.2, §4.3, §5.1 to §5.4].

    python -m extras.arms                                            the arms, and what each is for
    python -m extras.arms run dino dino-contact --motion FOLDER      train them in turns, or go on exactly
    python -m extras.arms table --motion FOLDER --png curves.png     a table for every claim, and the curves
    python -m extras.arms ship RUN characters/NAME.npz               a policy to watch: play.py --figure

    ARMS ──► extras.train, --recipe none ──► OUT/NAME.SEED ──► pieces of 2 s, tracked ──► a table a claim

A policy that walks already does not unlearn it in a million steps, so fine-tuning shows little of what a reward is for.
Here every arm begins with random weights, by the paper's uniform starts, without a curriculum and without noise.
The arms of a claim differ in one flag and take turns, so that they have the same steps whenever they are stopped.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections import Counter
from dataclasses import dataclass, fields
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import metrics
from character import Character
from env import Env
from extras import policies, train
from mocap import data
from plumbing import render, runs
from plumbing.cli import (
    COUNT,
    NONNEGATIVE,
    POSITIVE,
    THREADS,
    UserError,
    arg,
    cell,
    cli,
    given_flags,
    markdown,
    run_main,
    words_first,
)
from plumbing.files import atomic_write, check_folders
from policy import STUB, check_fits, load_policy, trained_as
from retarget import Reference, reference

# ASSUMED: half of ppo.py's batch, so that a million steps are 244 updates.  σ starts at the default 0.135: from scratch
# Dino learns nothing in 0.25 M steps with the 0.06 of its recipe, and in 0.65 M as much as Jesse with this one.
BATCH = "--recipe none --envs 256 --horizon 16 --minibatch 1024 --epochs 2 --lr 1e-4 --min-sigma 0.02"
WALKS, ALL = "*walk*", "*"  # clips: walks and turns; runs and, of the built-in motions, all others too


@dataclass(frozen=True)
class Arm:
    """One training from scratch.  character : its name; flags : of extras/train.py, what the arm is about; clips"""

    character: str
    flags: str = ""
    clips: str = WALKS


HORIZONTAL = "--set=pose.spine_y=0.28;pose.neck_y=-0.5;pose.head_y=-0.55"
ARMS = {
    "dino": Arm("dino"),
    "dino-contact": Arm("dino", "--without contact"),
    "dino-orientation": Arm("dino", "--without orientation"),
    "dino-imitation": Arm("dino", "--without imitation"),
    "dino-action": Arm("dino", "--without action"),
    "dino-root": Arm("dino", "--track root"),
    "dino-passive": Arm("dino", "--tail passive"),
    "dino-fixed": Arm("dino", "--tail fixed"),
    "dino-horizontal": Arm("dino", HORIZONTAL),
    "oppy": Arm("oppy"),
    "oppy-contact": Arm("oppy", "--without contact"),
    "oppy-orientation": Arm("oppy", "--without orientation"),
    "oppy-small": Arm("oppy", "--scale 0.7"),
    "oppy-tall": Arm("oppy", "--scale 1.7"),
    "jesse-runs": Arm("jesse", clips=ALL),
    "jesse-symmetric": Arm("jesse", "--without asymmetric", ALL),
    "dino-runs": Arm("dino", clips=ALL),
    "dino-symmetric": Arm("dino", "--without asymmetric", ALL),
    "jesse": Arm("jesse"),
    "jesse-hmd": Arm("jesse", "--sensors hmd"),
    "oppy-hmd": Arm("oppy", "--sensors hmd"),
    "dino-hmd": Arm("dino", "--sensors hmd"),
}

SETS = {  # what is measured: the split and the clips of it; `bodies` is of --bodies
    "walks": ("validation", "*walk*"),
    "runs": ("validation", "*run*"),
    "style": ("style", "*"),
    "bodies": ("body", "*"),
}


@dataclass(frozen=True)
class Claim:
    """What the paper says, the arms that show it, the sets that they are measured on."""

    title: str
    arms: tuple[str, ...]
    sets: tuple[str, ...] = ("walks",)


CLAIMS = (
    Claim("§4.2 headset only", ("jesse", "jesse-hmd", "oppy", "oppy-hmd", "dino", "dino-hmd")),
    Claim("§4.3.1 contact reward", ("dino", "dino-contact", "oppy", "oppy-contact")),
    Claim("§4.3.1 size, Fig. 5", ("oppy-small", "oppy", "oppy-tall")),
    Claim("§4.3.2 orientation reward, Fig. 6", ("dino", "dino-orientation", "oppy", "oppy-orientation")),
    Claim("§5.1 Dino's tail, Fig. 8", ("dino", "dino-passive", "dino-fixed")),
    Claim("§5.2 a horizontal Dino", ("dino", "dino-horizontal")),
    Claim(
        "§5.3 asymmetric critic",
        ("jesse-runs", "jesse-symmetric", "dino-runs", "dino-symmetric"),
        ("walks", "runs", "style", "bodies"),
    ),
    Claim("§3.5.1 what is imitated; the action terms", ("dino", "dino-root", "dino-imitation", "dino-action")),
)

COLUMNS = tuple(
    c
    for key in "completed survival fails_every_s root_cm head_deg head_wobble_deg_s joint_rot_deg contact_agreement "
    "foot_slide_cm_s own_slide_cm_s jitter_m_s3 steps_per_m torque_rms".split()
    for c in metrics.COLUMNS
    if c[0] == key
)
CURVES = ("time_to_failure", "survival", "length")  # of metrics.csv: rewards differ between arms by what they leave out
MARKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)  # million steps at which the curves are printed


@dataclass
class Options:
    """Where the motions are, how far the arms go."""

    motion: str = arg("builtin", f"what the arms learn from, and are measured on where it is recorded: {data.MOTION}")
    bodies: str | None = arg(None, "a folder of CMU's: unseen bodies, for the critics' table")
    out: str = arg("runs/arms", "folder of the arms' runs")
    steps: int = arg(10_000_000, "control steps of each arm", check=POSITIVE)
    turn: int = arg(200_000, "control steps of an arm before it is the next one's turn", check=POSITIVE)
    seed: int = arg(0, "seed of everything random in training", check=NONNEGATIVE)
    threads: int = arg(1, "physics threads, 0 = all cores", check=THREADS)
    seconds: float = arg(2.0, "length of the pieces that are measured", check=POSITIVE)
    most: int = arg(256, "pieces of a set at most, evenly chosen", check=COUNT)
    json: str | None = arg(None, "write the table here")
    png: str | None = arg(None, "plot the curves here (extra view)")


RUN = {"motion", "out", "steps", "turn", "seed", "threads"}  # the flags of `run`; the others are of `table`
TABLE = {f for f in Options.__dataclass_fields__} - {"steps", "turn"}

# ------------------------------------------------------------------------------------ run


def folder_of(name, opt: Options) -> Path:
    """Where an arm's run is.  Test: tests/extras/test_arms.py::test_arms_take_turns"""
    return Path(opt.out) / f"{name}.{opt.seed}"


def command_of(name, opt: Options, steps: int) -> list[str]:
    """An arm as the command line of extras/train.py: whoever copies it trains the same.

    Test      tests/extras/test_arms.py::test_every_arm_is_a_command"""
    arm, out = ARMS[name], folder_of(name, opt)
    argv = f"--character {arm.character} {BATCH} {arm.flags}".split()
    argv += ["--motion", opt.motion, "--clips", arm.clips, "--seed", str(opt.seed), "--threads", str(opt.threads)]
    argv += ["--steps", str(steps), "--out", str(out)]
    return argv + ["--resume"] * (out / runs.CONFIG).is_file()


def steps_of(name, opt: Options) -> int:
    """How far an arm is; 0 before it began.  Test: tests/extras/test_arms.py::test_arms_take_turns"""
    loaded = runs.latest_checkpoint(folder_of(name, opt))
    return loaded[1]["steps"] if loaded else 0


def run(names, opt: Options) -> None:
    """Train arms in turns of `--turn` steps, the one that is least far first, until all have `--steps`, or a signal.

    Test      tests/extras/test_arms.py::test_arms_take_turns"""
    done = {name: steps_of(name, opt) for name in names}
    while (name := min(done, key=done.get)) and done[name] < opt.steps:
        goal = min(opt.steps, (done[name] // opt.turn + 1) * opt.turn)
        argv = command_of(name, opt, goal)
        print(f"{name}: python -m extras.train {shlex.join(argv)}", flush=True)
        trainer = train.train(train.read_options(train.Options, argv, "extras.arms", __doc__, train.widths))
        if trainer.steps < goal:  # a signal
            return
        done[name] = trainer.steps


# ------------------------------------------------------------------------------------ table


def pieces(ref: Reference, seconds, most) -> Reference:
    """The reference's sequences cut into pieces, at most so many of them, evenly chosen; a shorter rest is left out.

    Why       an arm of a million steps lives a second: of every sequence one would see the first steps alone
    Test      tests/extras/test_arms.py::test_pieces"""
    n = round(seconds * ref.rate)
    starts = [np.arange(a, b - n + 1, n) for a, b in zip(ref.first, ref.last, strict=True)]
    start, owner = np.concatenate(starts), np.repeat(np.arange(len(starts)), [len(s) for s in starts])
    if not len(start):
        longest = np.max(ref.last - ref.first) / ref.rate
        raise UserError(f"--seconds {seconds:g}: no sequence is so long; valid: {longest:.1f} or less")
    k = np.unique(np.linspace(0, len(start) - 1, min(most, len(start))).round().astype(int))
    frames = (start[k, None] + np.arange(n + 1)).ravel()  # laid end to end, as `Env` wants them
    own = {f.name: getattr(ref, f.name) for f in fields(Reference)}
    cut = {name: v[frames] for name, v in own.items() if name not in ("names", "rate", "first", "last", "still")}
    first = np.arange(len(k)) * (n + 1)
    names = [ref.names[i] for i in owner[k]]
    return Reference(names, ref.rate, first, first + n, **cut, still=np.zeros(len(k), int))


def measured(char: Character, ref: Reference, act, threads, seen: Reference | None = None) -> dict:
    """Every metric of a policy on pieces, tracked; `fails_every_s` is of them, too.

    Args      act : None: the kinematic pose; seen : what the policy is shown, by default ref, against which all is held
    Test      tests/extras/test_arms.py::test_table, test_headset_arm_is_held_against_the_user"""
    found = metrics.simulate(char, seen or ref, act, threads=threads) if act else metrics.kinematic(char, ref)
    row, failures = metrics.measure(char, ref, found), sum(r.failed for r in found)
    lived = sum(len(r.frames) - 1 + r.failed for r in found) / ref.rate  # the failing step, too, as everywhere
    return row | {"fails_every_s": lived / failures if failures else float("inf")}


class Measuring:
    """Motions read and retargeted once a character, baselines measured once.  opt : Options"""

    def __init__(self, opt: Options):
        self.opt, self.clips, self.refs, self.rows = opt, {}, {}, {}

    def ref(self, char: Character, name) -> Reference:
        """Pieces of a set of SETS for a character."""
        split, clips = SETS[name]
        if name not in self.clips:
            recorded = [part for part in data.parts(self.opt.motion) if part not in data.BUILTIN]
            motion = self.opt.bodies if name == "bodies" else ",".join(recorded) or self.opt.motion
            self.clips[name] = data.sequences(motion, split, clips, verbose=False)
        key = name, metrics.name_of(char)
        if key not in self.refs:
            self.refs[key] = pieces(reference(char, self.clips[name]), self.opt.seconds, self.opt.most)
        return self.refs[key]

    def arm(self, name, of) -> dict | None:
        """An arm's row on a set, with its steps; None: it was not run."""
        folder = folder_of(name, self.opt)
        if not (folder / runs.CHECKPOINT).is_file():
            return None
        if (name, of) not in self.rows:
            policy, meta = load_policy(folder)
            char = trained_as(meta, folder).load()
            ref = self.ref(char, of)
            seen = metrics.shown_to(meta, folder, ref, None)
            check_fits(policy, Env(char, seen, 1), folder)
            row = measured(char, ref, metrics.policy_action(policy), self.opt.threads, seen)
            self.rows[name, of] = row | {"steps": meta["steps"]}
        return self.rows[name, of]

    def baselines(self, character, of) -> dict:
        """No torque, and the kinematic pose, of the character as it is."""
        for label, act in (("no torque", metrics.zero_action), ("kinematic", None)):
            if (key := (f"{character}, {label}", of)) not in self.rows:
                char = train.Options(character=character).load()
                self.rows[key] = measured(char, self.ref(char, of), act, self.opt.threads)
        return {label: self.rows[label, of] for label in (f"{character}, no torque", f"{character}, kinematic")}


def claim_rows(claim: Claim, of, measuring: Measuring) -> dict:
    """Row name -> numbers of one claim on one set: arms, then each character's baselines.

    {} where fewer than two arms of one character were run: there is nothing to compare.

    Test      tests/extras/test_arms.py::test_table"""
    there = [n for n in claim.arms if (folder_of(n, measuring.opt) / runs.CHECKPOINT).is_file()]
    if not there or max(Counter(ARMS[n].character for n in there).values()) < 2:
        return {}
    rows = {name: measuring.arm(name, of) for name in claim.arms}
    for character in dict.fromkeys(ARMS[name].character for name, row in rows.items() if row):
        rows |= measuring.baselines(character, of)
    return rows


def unequal(rows: dict) -> list[str]:
    """Lines about arms of one character that have not had the same steps.

    Test      tests/extras/test_arms.py::test_unequal_arms_are_named"""
    out, steps = [], {n: r["steps"] for n, r in rows.items() if r and "steps" in r}
    for character in dict.fromkeys(ARMS[n].character for n in steps):
        own = {n: s for n, s in steps.items() if ARMS[n].character == character}
        if len(set(own.values())) > 1:
            out.append("not to be compared: " + ", ".join(f"{n} {runs.fmt_count(s)}" for n, s in own.items()))
    return out


def table(opt: Options) -> dict:
    """Print a table for every claim and set of which two arms were run.  -> claim -> set -> row -> numbers

    Test      tests/extras/test_arms.py::test_table"""
    measuring, out = Measuring(opt), {}
    for claim in CLAIMS:
        for of in claim.sets:
            if of == "bodies" and not opt.bodies:
                continue
            rows = claim_rows(claim, of, measuring)
            if not rows:
                continue
            n = next(r["clips"] for r in rows.values() if r)
            print(f"\n{claim.title}; {of}, tracked: {n} pieces of {opt.seconds:g} s, seed {opt.seed}\n")
            head = ["arm", "steps", *(h for _, h, _ in COLUMNS)]
            print(markdown([head, *(line_of(name, row) for name, row in rows.items())]))
            print(*unequal(rows), sep="\n", end="\n" if unequal(rows) else "", flush=True)
            out.setdefault(claim.title, {})[of] = {k: v for k, v in rows.items() if v}
    if not out:
        raise UserError(f"{opt.out}: no two arms of a claim and seed {opt.seed} were run; valid: extras.arms run A B")
    return out


def line_of(name, row) -> list[str]:
    """A row's cells.  Test: tests/extras/test_arms.py::test_table"""
    if row is None:
        return [name, "not run", *["-"] * len(COLUMNS)]
    steps = runs.fmt_count(row["steps"]) if "steps" in row else "-"
    return [name, steps, *metrics.cells(name.split(", ")[-1], row, COLUMNS)]


def curve(file) -> dict:
    """Million steps -> mean time to failure [s] over the tenth of the steps before, for the marks that a run reached.

    Test      tests/extras/test_arms.py::test_curve"""
    columns, out = runs.read_metrics(file), {}
    steps = columns["steps"] / 1e6
    for mark in MARKS:
        near = (steps > 0.9 * mark) & (steps <= mark)
        if near.any() and steps[-1] >= 0.99 * mark:
            failures = columns["failures"][near].sum()
            lived = (columns["time_to_failure"] * np.maximum(columns["failures"], 1))[near].sum()
            out[mark] = float(lived / failures) if failures else float("inf")
    return out


def curves(opt: Options) -> None:
    """Print every arm's curve, and plot them with --png.  Test: tests/extras/test_arms.py::test_table"""
    files = {n: folder_of(n, opt) / runs.METRICS for n in ARMS}
    files = {n: f for n, f in files.items() if f.is_file()}
    found = {n: curve(f) for n, f in files.items()}
    marks = [m for m in MARKS if any(m in c for c in found.values())]
    print("\nfails every, s, while it learns: with noise, from uniform starts\n")
    rows = [[n, *(cell(c.get(m, float("nan")), "{:.2f}") for m in marks)] for n, c in found.items()]
    print(markdown([["arm", *(f"{m:g} M" for m in marks)], *rows]))
    if opt.png:
        render.plot_curves(opt.png, list(files.values()), CURVES, labels=list(files))
        print(opt.png)


# ------------------------------------------------------------------------------------ ship


def ship(run, path) -> dict:
    """`extras.policies.ship` of a policy to watch: its critic is a stub, which halves the file.

    Why       nothing that plays asks the critic; who goes on learning from the file begins with a new one
    Test      tests/extras/test_arms.py::test_ship"""
    meta = policies.ship(run, path)
    policy, _ = load_policy(path)
    light = policy.with_critic(STUB, np.random.default_rng(0))
    meta |= {"policy": light.shape(), "options": meta["options"] | {"value_hidden": list(STUB)}}
    runs.save_checkpoint(path, light.arrays(), meta)
    return meta


# ------------------------------------------------------------------------------------ command line


def listed() -> str:
    """The arms by claim.  Test: tests/extras/test_arms.py::test_wrong_commands"""
    lines = []
    for claim in CLAIMS:
        lines.append(claim.title)
        lines += [f"    {n:18s} {ARMS[n].character} {ARMS[n].flags}".rstrip() for n in claim.arms]
    return "\n".join(lines)


def main(argv=None):
    """List, run, measure or ship arms.  Test: tests/extras/test_arms.py::test_arms_take_turns, test_table, test_ship"""
    words, flags = words_first(argv)
    if not words and not flags:
        print(listed())
        return
    what, names = (words[0], words[1:]) if words else ("", [])
    if what == "ship" and len(names) == 2 and not flags:
        policies.check_new(names[1])
        check_folders(names[1], read=names[:1])
        meta = ship(*names)
        print(f"{names[1]}: {runs.fmt_count(meta['steps'])} steps; {meta['licence']}")
        return
    opt = cli(Options, flags, f"extras.arms {what}", __doc__)
    if what not in ("run", "table") or (what == "run") != bool(names):
        asked = " ".join(words) or "no command"
        raise UserError(f"{asked}: valid: run NAME …, table, or ship RUN OUT.npz; without words the arms are listed")
    if odd := [n for n in names if n not in ARMS]:
        raise UserError(f"{', '.join(odd)}: no such arm; valid: {', '.join(ARMS)}")
    if wrong := sorted(given_flags(flags) - (RUN if what == "run" else TABLE)):
        raise UserError(f"--{', --'.join(wrong)} would do nothing for {what}: leave it out")
    read = *data.parts(opt.motion), opt.bodies, *(folder_of(name, opt) for name in ARMS)
    check_folders(opt.json, opt.png, read=read)
    if what == "run":
        run(list(dict.fromkeys(names)), opt)
        return
    found = table(opt)
    curves(opt)
    if opt.json:
        flat = {f"{c}; {of}; {r}": v for c, sets in found.items() for of, rows in sets.items() for r, v in rows.items()}
        atomic_write(opt.json, metrics.as_json(flat))


if __name__ == "__main__":
    sys.exit(run_main(main))

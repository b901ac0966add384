r"""The headline by one command: every set of captures, streamed, a row each; all together; no torque  [Reda23 §4].

    python -m extras.streamed --character dino --mocap FOLDER --recordings sensors/validation --json OUT
    python -m extras.streamed --character dino --mocap FOLDER --policy A.npz B.npz --half select      candidates
    python -m extras.streamed --character dino --mocap FOLDER --half train --rounds 3      failures, with less of chance

    SETS ──► captures ──► metrics.streamed ──► a row a set ──► together ──► README.md's and RESULTS.md's tables
    recordings, a user who does not move ──► users.row_of_streams ──► a row a source
    rounds: streams ──► put_off ──► users.row_of_streams ──► a row a set

`--mocap` holds the folders bandai, cmu, bandai-standing, bandai-actions, cmu-inplace and cmu-dance-karate; a set whose
folder is not there is left out, and says so.  Choose on one half (`--half select`), report the other.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import metrics
import mocap.data
import play
from character import Character
from extras.users import row_of_streams
from headset.calibration import Stream
from headset.player import Player, stream_of, ticks_of
from headset.reader import Sample, sound
from human import sensors
from mocap.data import CONTROL_RATE
from plumbing.cli import THREADS, UserError, arg, cell, cli, complain, markdown, run_main
from plumbing.files import atomic_write, check_folders
from policy import check_fits, devices_of, find_policy, load_character
from retarget import forward_kinematics, standing

HALVES = [half for half in metrics.HALVES if half != "both"]
PUT, SHAKEN = 0.012, 0.002  # m, ASSUMED standard deviations of a position error: of a round, of a tick


@dataclass
class Set:
    """A row of the table.  folder : below --mocap, or a built-in motion; split : "all" for a folder that is held out;
    whole : both halves are shown, as there are too few to halve"""

    title: str
    folder: str
    split: str = "validation"
    clips: str = "*"
    whole: bool = False


SETS = (
    Set("walks, unseen clips", "bandai", clips="*walk_*"),
    Set("turns, unseen clips", "bandai", clips="*walk-turn*"),
    Set("runs, unseen clips", "bandai", clips="*_run_*"),
    Set("youthful: unseen style", "bandai", "style"),
    Set("CMU: unseen bodies", "cmu", "body"),
    Set("youthful, standing, arms", "bandai-standing/validation", "all"),
    Set("CMU 14: exercises in place, boxing", "cmu-inplace/validation", "all", whole=True),
    Set("CMU 61: salsa", "cmu-dance-karate/validation", "all"),
    Set("built-in: start, stop, turn, sidestep, …", "builtin"),
    Set("built-in: stand, strike, crouch, step", "standing"),
    Set("built-in: exercises in place", "exercises"),
)
TRAINED = (  # what is hard of the training sets: there is more of it than is held out
    Set("steps back", "backwards", "train"),
    Set("actions", "bandai-actions/train", "all"),
    Set("exercises in place", "cmu-inplace/train", "all"),
    Set("dance, martial arts", "cmu-dance-karate/train", "all"),
    Set("built-in: exercises in place", "exercises", "train"),
    Set("built-in: sidesteps, stops", "builtin", "train", "s[it][do][ep]*"),
    Set("built-in, standing: sidesteps, stops", "standing", "train", "s[it][do][ep]*"),
)
ROUNDS = (lambda v: 1 <= v <= 100, "from 1 to 100")
MINUTE = 62.0  # s of the user who does not move, of which the first second calibrates
COLUMNS = [
    ("clips", "captures", "{:d}"),
    *(c for c in metrics.COLUMNS if c[0] in (
        "completed", "within_1m", "survival", "fails_every_s", "first_failure_s", "root_cm", "head_cm", "hands_cm",
        "foot_slide_cm_s", "own_slide_cm_s", "contact_agreement", "self_penetration_mm", "spring_share",
    )),
]  # fmt: skip
COLUMNS.insert([c[0] for c in COLUMNS].index("hands_cm") + 1, ("statue_cm", "hands of a statue cm", "{:.1f}"))
OF_ROUNDS = [c for c in COLUMNS if c[0] not in (
    "within_1m", "root_cm", "foot_slide_cm_s", "contact_agreement", "self_penetration_mm", "spring_share",
)]  # fmt: skip
OF_ROUNDS.insert(3, ("failures", "failures", "{:d}"))


@dataclass
class Options:
    """Which policies, on what."""

    character: str | None = arg(None, "name in characters/, or path of a .toml; the policy's own by default, or jesse")
    policy: tuple[str, ...] = arg((), "run folders or policy .npz, a table each; the character's own by default")
    mocap: str | None = arg(None, "folder of the motion captures; the environment's MOCAP_DIR by default")
    recordings: str | None = arg(None, "folder of headsets' recordings, too: a row for each source")
    half: str = arg(
        "report",
        "which captures: select, on which policies are chosen; report, the rest; train, hard ones of the training sets",
        ("train", *HALVES),
    )
    rounds: int = arg(
        1, "play captures this often: as they are, then with position errors; fewer columns", check=ROUNDS
    )
    json: str | None = arg(None, "write the tables here")
    threads: int = arg(0, "physics threads, 0 = all cores", check=THREADS)


def captures_of(one: Set, folder: Path, half: str) -> list:
    """A set's captures of that half; [] if its folder is not there.

    Test      tests/extras/test_streamed.py::test_captures, test_trained_captures"""
    built_in = one.folder in mocap.data.BUILTIN
    motion = one.folder if built_in else str(folder / one.folder)
    if not built_in and not os.path.isdir(motion):
        return []
    half = "both" if half == "train" or one.whole and half == "report" else half
    how = dict(all=True) if one.split == "all" else dict(split=one.split)
    return metrics.captures_of(metrics.Options(motion=motion, clips=one.clips, half=half, **how))


def put_off(streams, rounds: int) -> list:
    """Every stream once for each round: first as it is, then with position errors of its own.

    One capture more or less is chance; the failures of several rounds tell a better policy from a lucky one.
    Equation  p' = p + e + n, e ~ N(0, PUT²) for each device and axis, the same all along a stream; n ~ N(0, SHAKEN²) at
              every tick
    Frame     the character's world, after calibration: e does not turn with the device
    Args      streams : (pos (T, devices, 3) [m], quat (T, devices, 4)) of each; rounds : int >= 1
    Returns   rounds × len(streams) of them; the same errors at every call, so that policies compare
    Test      tests/extras/test_streamed.py::test_put_off"""
    out = list(streams)
    for k in range(1, rounds):
        rng = np.random.default_rng([7, k])
        for pos, quat in streams:
            put = rng.normal(0, PUT, (1, *pos.shape[1:]))
            out.append((pos + put + rng.normal(0, SHAKEN, pos.shape), quat))
    return out


def together(rows) -> dict:
    """All captures of several rows as one: shares by captures, failures by time.  Errors stay by set: walks and dance
    have no error in common.

    Test      tests/extras/test_streamed.py::test_together"""
    clips = np.array([r["clips"] for r in rows])
    seconds, failures = sum(r["seconds"] for r in rows), sum(r["failures"] for r in rows)
    shares = [k for k in ("completed", "within_1m", "survival") if all(k in r for r in rows)]
    return {
        "clips": int(clips.sum()),
        **{k: float(clips @ [r[k] for r in rows] / clips.sum()) for k in shares},
        "seconds": seconds,
        "failures": failures,
        "fails_every_s": seconds / failures if failures else float("inf"),
    }


def statue(char: Character, streams) -> dict:
    """The dumbest baseline of the hands: the default pose, put under the user's headset at every tick.

    Args      streams : (pos (T, 3, 3) [m], quat (T, 3, 4)) of each
    Returns   statue_cm : mean distance of its controllers from the user's
    Test      tests/extras/test_streamed.py::test_statue"""
    pos, quat = (np.concatenate([s[k] for s in streams]) for k in (0, 1))
    sites = forward_kinematics(char, standing(char, pos[:, 0], quat[:, 0])).site_xpos
    return {"statue_cm": 100 * float(np.linalg.norm(sites[:, 1:] - pos[:, 1:], axis=-1).mean())}


def motionless(char: Character, devices: int):
    """The stream of a user who stands as the built-in `standing` motions begin, and does not move.

    Test      tests/extras/test_streamed.py::test_motionless"""
    pos, quat = sensors(mocap.data.builtin_clips(CONTROL_RATE, name="standing")[0][:1])
    stream = Stream(char, "mujoco", rate=CONTROL_RATE, devices=devices)
    times, quat = np.arange(round(MINUTE * CONTROL_RATE)) / CONTROL_RATE, np.roll(quat, -1, axis=-1)
    ticks = [tick for t in times for tick in stream.push(Sample(t, pos[0], quat[0]))]
    return np.stack([t.pos for t in ticks]), np.stack([t.quat for t in ticks])


def recorded(char: Character, folder, devices: int) -> tuple[dict, list[str]]:
    """Source -> streams: the recordings of a folder by the first word of their names; a line for each that is broken.

    Test      tests/extras/test_streamed.py::test_recordings"""
    by_source, flags = {}, play.Options(stream=str(folder))
    taken, broken = sound(lambda file: (file, ticks_of(char, file, devices, flags)), play.recordings_of(folder))
    for file, stream in taken:
        play.say(stream[2]["notes"], file)
        by_source.setdefault(f"recordings: {file.stem.partition('_')[0]}", []).append(stream[:2])
    return by_source, broken


def rows_of(char: Character, act, captures: dict, streams: dict, opt: Options, devices: int, idle=True):
    """(title, numbers) of every row, one after the other: the sets, all of them together, no torque (if `idle`), the
    streams.

    Test      tests/extras/test_streamed.py::test_command, test_rounds"""
    still = lambda obs: np.zeros((len(obs), len(char.limits)))  # noqa: E731

    def counted(drive, several):
        row = row_of_streams(char, drive, several, devices, opt.threads)
        return row | {"clips": row["captures"]}

    def row_of(drive, clips):
        if opt.rounds == 1:
            return metrics.streamed(char, drive, clips, devices, opt.threads)
        return counted(drive, clips)

    def beside(several):  # the baseline of the hands
        return statue(char, several) if devices == 3 else {}

    if opt.rounds > 1:
        made = {name: [stream_of(char, clip, devices)[:2] for clip in clips] for name, clips in captures.items()}
        captures = {name: put_off(several, opt.rounds) for name, several in made.items()}
    for title, drive in (("all", act), ("all, no torque", still))[: 1 + idle]:
        rows = []
        for name, clips in captures.items():
            rows.append(row_of(drive, clips))
            if drive is act:
                several = clips if opt.rounds > 1 else [stream_of(char, clip)[:2] for clip in clips]
                yield name, rows[-1] | beside(several)
        if rows:
            yield title, together(rows)
    for name, several in streams.items():
        yield name, counted(act, several) | beside(several)


def main(argv=None) -> int:
    """Print the tables.  -> exit status, 1 if a set or a recording could not be read

    Test      tests/extras/test_streamed.py::test_command, test_wrong_commands"""
    opt = cli(Options, metrics.listed(argv, "--policy"), "extras.streamed", __doc__)
    folder = opt.mocap or os.environ.get("MOCAP_DIR") or ""
    if folder and not os.path.isdir(folder):
        raise UserError(
            f"--mocap {folder}: no such folder; valid: one with bandai, cmu, … in it (python -m mocap fetch)"
        )
    if opt.recordings and not os.path.exists(opt.recordings):
        raise UserError(f"--recordings {opt.recordings}: no such folder; valid: one of .csv or .bsor files")
    found = [find_policy(metrics.Options(character=opt.character, policy=p)) for p in opt.policy or (None,)]
    check_folders(opt.json, read=(folder, opt.recordings, *(path for _, path, _ in found)))
    own, cast = metrics.Options(character=opt.character), []
    for policy, path, meta in found:
        char, devices = load_character(own, meta, path), devices_of(meta, path, None)
        check_fits(policy, Player(char, policy.mean_action, devices=devices), path)
        cast.append((policy, path, char, devices))
    sets = TRAINED if opt.half == "train" else SETS
    read, thin = sound(lambda one: (one.title, captures_of(one, Path(folder), opt.half)), sets)
    captures = dict(read)
    if gone := [one.title for one in sets if not captures.get(one.title)]:
        print(f"{f'--mocap {folder} is' if folder else 'no --mocap:'} without {'; '.join(gone)}", flush=True)
    captures, out, broken = {title: clips for title, clips in captures.items() if clips}, {}, []
    bodies = set()  # that "no torque" was told of: it is the same for all policies of one
    for policy, path, char, devices in cast:
        streams = {"motionless, a minute": [motionless(char, devices)]}
        if opt.recordings:
            by_source, broken = recorded(char, opt.recordings, devices)
            streams |= by_source
        which = "training captures" if opt.half == "train" else f"{opt.half} half"
        print(f"\n{path}, {metrics.name_of(char)}, {which}{f', {opt.rounds} rounds' if opt.rounds > 1 else ''}\n")
        columns = COLUMNS if opt.rounds == 1 else OF_ROUNDS
        print(markdown([["", *(heading for _, heading, _ in columns)]]), flush=True)
        body = (char.path, str(char.variant), devices)
        idle, bodies = body not in bodies, bodies | {body}
        for title, row in rows_of(char, policy.mean_action, captures, streams, opt, devices, idle):
            out[f"{path}: {title}"] = row
            cells = (cell(row.get(key, np.nan), form) for key, _, form in columns)
            print("| " + " | ".join([title, *cells]) + " |", flush=True)
    if opt.json:
        atomic_write(opt.json, metrics.as_json(out))
    return complain([*thin, *broken])


if __name__ == "__main__":
    run_main(main)

r"""Other users through the whole pipeline, and how a character fails under them  [Reda23 §4.1, §6].

    python -m extras.users --motion FOLDER --clips '*walk*'    of other builds, by height, 1.45 to 2.00 m
    python -m extras.users --motion FOLDER --by none           as they are: dance, sport, arms
    python -m extras.users --motion FOLDER --by pace           slower and faster: §6's fast motion
    python -m extras.users --motion FOLDER --by crossing       legs under another's trunk: §6's uncorrelated motion
    python -m extras.users --motion FOLDER --by head           held otherwise, or a headset that sits so; looking around
    python -m extras.users --motion FOLDER --by push           the character is pushed: §6's unbalancing
    python -m extras.users --motion FOLDER --by time           how far from its user, and when: §6's compounding errors

    clips ──► of_build, warp, tilted, … ──► recorded headset, calibrated ──► ride ──► completed, falls, losses, errors
              joints                        by its first second              streamed, from the default pose

Nothing is told of a user's build: stature, trunk and arms change the human, from it the devices are taken, and from
their first second the calibration.  Falls and losses are counted apart: to topple is not to be left behind.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, fields, replace
from itertools import product

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import metrics
from character import Character
from headset.player import Player, from_user, ride, stream_of, tally
from human import SEG, SENSOR_OFFSETS, headset_height, quat_about, quat_conj, quat_mul, quat_rotate
from mocap.augment import looking, resize, warp
from mocap.data import CONTROL_RATE, parts, stitched
from play import errors_of, slides_of
from plumbing.cli import THREADS, UserError, arg, cell, cli, given_flags, markdown, run_main
from plumbing.files import atomic_write, check_folders
from policy import check_fits, devices_of, find_policy, load_character

EYES = 0.936  # ASSUMED: of a standing person's stature, where the headset sits (Drillis and Contini 1966: eye height)
BUILDS = {  # ASSUMED: trunk and arms in proportion to the legs, as times the recorded person's
    "": (1.0, 1.0),
    "long trunk": (1.25, 1.0),  # most of the way from Bandai's actor to CMU's people
    "long arms": (1.0, 1.15),
    "short arms": (1.0, 0.85),
}
MIDDLE = 1.75  # m: at other heights the arms are as recorded
PACES = (0.75, 1.0, 1.25, 1.5, 2.0)  # times as fast as recorded
PUSHES = (0.25, 0.5, 1.0)  # m/s: what they change of the whole body's velocity, so that the light and the heavy compare
PUSHED_AT = 3.5  # s of play: a capture's user has set off by then
TILTS = (-20.0, -10.0, 0.0, 10.0, 20.0)  # degrees, chin down positive
LOOKS = (20.0, 40.0)  # degrees to the left, then to the right, and again
UPPER = [i for name, i in SEG.items() if not name.startswith(("pelvis", "thigh", "shin", "foot"))]
STATURES = (lambda v: v and all(0.5 <= x <= 2.5 for x in v), "one or more statures from 0.5 to 2.5 metres, as 1.6,1.9")


@dataclass
class Options(metrics.MotionFlags):
    """Whose policies, under which users."""

    characters: tuple[str, ...] = arg(
        ("jesse", "oppy", "dino"), "names or .toml paths, the .npz beside it", check=(len, "one or more names")
    )
    heights: tuple[float, ...] = arg((1.45, 1.6, MIDDLE, 1.9, 2.0), "statures of the users [m]", check=STATURES)
    by: str = arg(
        "height", "what the users differ by", choices=("height", "pace", "crossing", "head", "push", "time", "none")
    )
    split: str = arg("validation", "which part", choices=("train", "validation", "style", "body"))
    half: str = arg("report", "which captures, as metrics.py: select, report, both", choices=tuple(metrics.HALVES))
    json: str | None = arg(None, "write the table here")
    threads: int = arg(0, "physics threads, 0 = all cores", check=THREADS)


def stature(clip) -> float:
    """A standing user's height [m], from where the headset is.  Test: tests/extras/test_users.py::test_of_build"""
    return headset_height(clip) / EYES


def of_build(clip, height, trunk=1.0, arms=1.0):
    """The same motion by a user of this stature [m], whose trunk and arms are so many times as long beside the legs.

    Test      tests/extras/test_users.py::test_of_build"""
    shaped, above = resize(clip, 1.0, arms, trunk), float(SENSOR_OFFSETS[0, 2])  # a headset sits so far above the joint
    return resize(shaped, (EYES * height - above) / (headset_height(shaped) - above))


def crossed(clip, other):
    r"""The legs of one under the trunk, head and arms of another, cut to the shorter.

    Equation  R' = P R, p' = p_pelvis + P (p − q_pelvis) with P = R_pelvis Q_pelvisᵀ, for all above the pelvis; Q, q:
              the other's; no joint turns otherwise than one of the two turned it
    Why       §6: nothing above tells of these legs, as nothing in a wave tells how one walks
    Test      tests/extras/test_users.py::test_crossed"""
    n = min(len(clip), len(other))
    clip, other = clip[:n], other[:n]
    turn, pos, quat = quat_mul(clip.quat[:, :1], quat_conj(other.quat[:, :1])), clip.pos.copy(), clip.quat.copy()
    quat[:, UPPER] = quat_mul(turn, other.quat[:, UPPER])
    pos[:, UPPER] = clip.pos[:, :1] + quat_rotate(turn, other.pos[:, UPPER] - other.pos[:, :1])
    return replace(clip, name=f"{clip.name}-under-{other.name}", pos=pos, quat=quat)


def tilted(clip, degrees):
    r"""The same motion with the head, and the headset on it, pitched all the time.

    Equation  R' = R_head R_y(degrees), about the head's joint: the eyes move with it, by 2 cm at 10°
    Why       nobody wears a headset as another does, or holds the head so, and nothing in it tells which
    Test      tests/extras/test_users.py::test_tilted"""
    quat, head = clip.quat.copy(), SEG["head"]
    quat[:, head] = quat_mul(quat[:, head], quat_about(1, np.deg2rad(degrees)))
    return replace(clip, quat=quat)


def users(opt: Options) -> dict:
    """Row name -> function of the captures: who plays them.  Test: tests/extras/test_users.py::test_rows"""
    recorded = {"as recorded": list}
    if opt.by in ("none", "push"):
        return recorded
    if opt.by == "time":
        return {"stitched": lambda clips: stitched(clips, opt.motion, verbose=False)}
    if opt.by == "crossing":  # ASSUMED: the other is half the captures on, of another kind where they are in order
        return recorded | {"crossed": lambda clips: list(map(crossed, clips, clips[len(clips) // 2 :] + clips))}
    if opt.by == "pace":
        return {f"{pace:g} of the pace": lambda clips, s=pace: [warp(c, s) for c in clips] for pace in PACES}
    if opt.by == "head":
        looks = {f"looks {yaw:g}° aside": lambda clips, a=yaw: [looking(c, a) for c in clips] for yaw in LOOKS}
        return {f"head {tilt:+g}°": lambda clips, a=tilt: [tilted(c, a) for c in clips] for tilt in TILTS} | looks
    rows = {}
    for height in opt.heights:
        for name, (trunk, arms) in BUILDS.items():
            if arms == 1.0 or height == MIDDLE:
                title = f"{height:.2f} m" + (f", {name}" if name else "")
                build = (height, trunk, arms)
                rows[title] = lambda clips, build=build: [of_build(c, *build) for c in clips]
    return rows


def pushes(char: Character, opt: Options) -> dict:
    r"""What is added to a row's name -> the push, None for none.

    Equation  F = m Δv / PUSH_SECONDS, m the character's mass
    Test      tests/extras/test_users.py::test_pushes"""
    if opt.by != "push":
        return {"": None}
    mass = char.model.body_subtreemass[char.root]
    return {"": None} | {
        f", {name} by {size:g} m/s": metrics.Push(mass * size / metrics.PUSH_SECONDS, PUSHED_AT, angle)
        for size in PUSHES
        for name, angle in metrics.DIRECTIONS.items()
    }


def row_of(char: Character, act, clips, devices, threads, push=None) -> dict:
    """What a character does under users, each a capture: numbers as `metrics.streamed`'s, and why it failed.

    Test      tests/extras/test_users.py::test_row"""
    return row_of_streams(char, act, [stream_of(char, clip, devices)[:2] for clip in clips], devices, threads, push)


def row_of_streams(char: Character, act, streams, devices, threads, push=None) -> dict:
    """The same under streams of poses, as `headset.player.ride` takes them.

    Args      push : `metrics.Push`, of all of them, counted from the start of play
    Errors    of headset and controllers over all frames [cm]; own slide without the jumps to where it is stood up
    Test      tests/extras/test_users.py::test_row"""
    rides = ride(char, act, streams, devices, threads, push.force if push else None)
    counts, ends = tally(rides), sum((r.ends for r in rides), Counter())
    return {
        "captures": len(rides),
        **counts,
        "falls": ends["fall"],
        "lost": ends["away"],
        "diverged": ends["bad"],
        **errors_of(rides, [slides_of(char, r) for r in rides], devices == 3),
    }


SINCE = {"0–1 s": (0, 1), "1–2 s": (1, 2), "2–5 s": (2, 5), "5–10 s": (5, 10), "10–20 s": (10, 20)}  # of play
BEFORE, LIVED = (2.0, 1.0, 0.5, 0.2), 3.0  # s before a failure, of those that had lived for so many


def by_time(char: Character, act, clips, devices, threads) -> dict:
    """Horizontal distance from the user's headset [cm] (`headset.player.from_user`): by the time since the start, of
    captures of 20 s or more without a failure, and by the time before a failure, of what had lived for 3 s by then.

    Test      tests/extras/test_users.py::test_by_time"""
    streams = [stream_of(char, clip, devices)[:2] for clip in clips]
    rides = ride(char, act, streams, devices, threads)
    far = [100 * from_user(r.qpos, pos[:, 0]) for r, (pos, _) in zip(rides, streams, strict=True)]
    return times_of(rides, far)


def times_of(rides, far) -> dict:
    """The row of `by_time`, from the distances of every tick of every ride.

    Test      tests/extras/test_users.py::test_by_time"""
    rate, long = round(CONTROL_RATE), max(end for _, end in SINCE.values())
    both = list(zip(rides, far, strict=True))
    whole = [f for r, f in both if not r.failures and len(r.qpos) >= long * rate]
    lives = [f[a:b] for r, f in both for a, b in r.lives[: r.failures]]  # the last is no failure's, if there is one
    lost = [f for f in lives if len(f) > LIVED * rate]
    mean = lambda values: float(np.mean(values)) if len(values) else float("nan")  # noqa: E731
    return {
        "captures": len(rides),
        "without failure": len(whole),
        **{title: mean([f[a * rate : b * rate].mean() for f in whole]) for title, (a, b) in SINCE.items()},
        f"failures after {LIVED:g} s": len(lost),
        **{f"{t:g} s before": mean([f[-round(t * rate)] for f in lost]) for t in BEFORE},
    }


TIMES = {"captures": "{:d}", "without failure": "{:d}", **dict.fromkeys(SINCE, "{:.1f}")}
TIMES |= {f"failures after {LIVED:g} s": "{:d}"} | {f"{t:g} s before": "{:.1f}" for t in BEFORE}
COLUMNS = {
    "captures": "{:d}",
    "completed": "{:.2f}",
    "survival": "{:.2f}",
    "fails_every_s": "{:.1f}",
    "first_failure_s": "{:.1f}",
    "falls": "{:d}",
    "lost": "{:d}",
    "diverged": "{:d}",
    "head_cm": "{:.1f}",
    "hands_cm": "{:.1f}",
    "own_slide_cm_s": "{:.1f}",
}


def main(argv=None):
    """Print the table.  Test: tests/extras/test_users.py::test_command"""
    argv = list(argv or [])
    opt = cli(Options, argv, "extras.users", __doc__)
    if opt.by != "height" and "heights" in given_flags(argv):
        raise UserError(f"--by {opt.by} leaves the users' heights as they are: leave out --heights, or --by")
    policies = [find_policy(metrics.Options(character=name)) for name in opt.characters]
    check_folders(opt.json, read=(*parts(opt.motion), *(path for _, path, _ in policies)))
    asked = {f.name: getattr(opt, f.name) for f in fields(metrics.MotionFlags)}
    captures = metrics.captures_of(metrics.Options(**asked, split=opt.split, half=opt.half))
    columns, out = TIMES if opt.by == "time" else COLUMNS, {}
    print(markdown([["", *(k.replace("_", " ") for k in columns)]]), flush=True)
    for name, (policy, path, meta) in zip(opt.characters, policies, strict=True):
        own = metrics.Options(character=name)
        char, devices = load_character(own, meta, path), devices_of(meta, path, None)
        check_fits(policy, Player(char, policy.mean_action, devices=devices), path)
        for (user, played_by), (pushed, push) in product(users(opt).items(), pushes(char, opt).items()):
            how = char, policy.mean_action, played_by(captures), devices, opt.threads
            row = by_time(*how) if opt.by == "time" else row_of(*how, push)
            out[title := f"{metrics.name_of(char)}: {user}{pushed}"] = row
            print("| " + " | ".join([title, *(cell(row[k], f) for k, f in columns.items())]) + " |", flush=True)
    if opt.json:
        atomic_write(opt.json, metrics.as_json(out))


if __name__ == "__main__":
    run_main(main)

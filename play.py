r"""Run a policy: measure it, look at it, record it  [Reda23 §4].

    python play.py --character jesse --motion FOLDER --measure [--json OUT]     the table of spec/metrics, four rows
    python play.py --character jesse --motion FOLDER --png OUT | --video OUT    headless pictures
    python play.py --character jesse --motion FOLDER --bvh OUT                  what the character did, as BVH
    python play.py --character jesse --motion FOLDER --view | --view web        MuJoCo's viewer: window or browser
    python play.py --character jesse --stream FILE.csv | --stream -             a headset's recording, or a live one
    python play.py --character jesse --motion FOLDER --measure --push 400@2     the largest push survived
    python play.py --compare A B … --motion FOLDER [--json OUT] [--png OUT]     policies beside one another

Rows of the table: `policy` (its mean action), `kinematic` (the retargeted pose itself), `zero` (no torque) and `pd`
(open-loop PD tracking of the reference).  Targets and labels are the human's for all rows.

A policy's file says which character it was trained for, with which variation, and whether it saw controllers.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np

import character
import mocap.data
import retarget
from character import Character, Switches, load
from env import EPISODE_STEPS, SENSORS, Env, headset_only
from headset import calibration
from headset.player import Pace, Player, drive
from headset.reader import AXES, GAP, SAMPLE_RATE, Reader, arriving, controllers_hang, is_live, lines_of
from human import CONTACT_SPEED, heading
from metrics import Recording, as_json, comparison, measure, table
from mocap import augment
from mocap.data import CONTROL_RATE, MOTION
from mocap.rigs import HELP, Reading
from plumbing.cli import NONNEGATIVE, POSITIVE, THREADS, UserError, arg, cli, given_flags, run_main
from plumbing.files import atomic_write, check_folders
from plumbing.runs import fmt_count
from policy import check_fits, load_policy, sensors_of, total_steps, trained_as
from retarget import Reference, forward_kinematics, sole_motion

# flags that say something of a motion alone, or of a stream alone
OF_MOTION = {"motion", "clips", "joint_map", "unit", "up", "all", "split", "user_scale", "random_starts", "sequence"}
OF_STREAM = {"axes", "grip", "sample_rate", "user_height", "realtime"}


@dataclass
class Options(Switches):
    """Which policy, on which motion, and what to make of it."""

    character: str | None = arg(None, "name in characters/, or path of a .toml; the policy's own by default, or jesse")
    motion: str = arg("builtin", MOTION)
    clips: str = arg("*", "shell pattern on clip names")
    joint_map: str | None = arg(None, HELP["joint_map"])
    unit: str | None = arg(None, HELP["unit"])
    up: str | None = arg(None, HELP["up"])
    policy: str | None = arg(None, "run folder or policy .npz; characters/NAME.npz by default")
    compare: tuple[str, ...] = arg((), "several of them: a table, and with --png a figure", metavar="A B …")
    sensors: str | None = arg(
        None, "what the policy is shown of the user: by default what it was trained with; hmd [§4.2] for one that was "
        "trained with controllers: they hang beside the body, wherever the user's are", choices=SENSORS,
    )  # fmt: skip
    measure: bool = arg(False, "print every metric for policy, kinematic, zero and pd")
    json: str | None = arg(None, "write the measured table here")
    all: bool = arg(False, "every sequence of the motion, not only its validation part")
    split: str = arg(
        "validation",
        "which part: train, validation (unseen clips), style (unseen style), body (unseen bodies: .amc files)",
        choices=("train", "validation", "style", "body"),
    )
    user_scale: float = arg(1.0, "play the motion by a user this many times as tall", check=POSITIVE)
    random_starts: int = arg(
        256, "characters started at random frames for the time to failure (0: leave it out)", check=NONNEGATIVE
    )
    sequence: int = arg(0, "which sequence to show", check=NONNEGATIVE)
    seconds: float | None = arg(None, "how much of it to show: 10 s by default, all of a stream", check=POSITIVE)
    every: float | None = arg(
        None, "seconds between the pictures of the contact sheet: 0.5; with --compare eight pictures", check=POSITIVE
    )
    png: str | None = arg(None, "write a contact sheet")
    video: str | None = arg(None, "write a video (.mp4; needs the extra `view`)")
    bvh: str | None = arg(None, "write what the character did, until it failed or the episode ended, as BVH")
    view: str | None = arg(
        None, "show it live: window (MuJoCo's viewer) or web (in a browser)", choices=("window", "web")
    )
    port: int = arg(0, "port of the browser viewer, 0 = the first free one from 8080", check=NONNEGATIVE)
    stream: str | None = arg(
        None, "drive the character with a headset's .csv file, a named pipe, or - for standard input"
    )
    axes: str = arg("unity", "axes of the stream", choices=tuple(AXES))
    grip: float | None = arg(
        None, "how far the fingers point below the controllers' forward axis [degrees]: unity 15, else 90 by default"
    )
    sample_rate: float = arg(SAMPLE_RATE, "rows a second of a stream without times", check=POSITIVE)
    user_height: float | None = arg(
        None, "height of the standing user's headset [m]; from the stream's first second by default", check=POSITIVE
    )
    realtime: bool = arg(False, "play a stream at the wall clock's pace and report the deadlines missed")
    push: str | None = arg(
        None,
        "N@T or N@T:DIRECTION: push the root with N newtons for 0.2 s at T s to its forward (default), left, back or "
        "right; with --measure: the largest push survived at T s, up to N, to all four",
    )
    seed: int = arg(0, "seed of stitching and random starts", check=NONNEGATIVE)
    threads: int = arg(0, "physics threads, 0 = all cores", check=THREADS)


# ------------------------------------------------------------------------------------ what drives the character

PD_STIFFNESS, PD_DAMPING = 4.0, 0.2  # per rad and per rad/s, in multiples of the torque limit; ASSUMED


def policy_action(policy):
    """The policy's mean action."""
    return lambda env: policy.mean_action(env.full[:, : env.obs_size])


def zero_action(env: Env):
    """No torque: what the passive springs alone do."""
    return np.zeros((env.n, env.action_size))


def pd_action(env: Env):
    r"""Open-loop tracking of the kinematic pose, gains in multiples of the torque limit.

    Equation  a = clip(K (q* − q) + D (q̇* − q̇))

    Test      tests/test_play.py::test_pd_action
    """
    h, f = env.char.driven, env.frame
    error = env.ref.qpos[f, 7:] - env.qpos[:, 7:]
    rate = env.ref.qvel[f, 6:] - env.qvel[:, 6:]
    return np.clip(PD_STIFFNESS * error + PD_DAMPING * rate, -1.0, 1.0)[:, h]


# ------------------------------------------------------------------------------------ pushes

PUSH_SECONDS = 0.2
RECOVERY = 3.0  # s after the push that the character must live, to have survived it
DIRECTIONS = {"forward": 0.0, "left": np.pi / 2, "back": np.pi, "right": -np.pi / 2}


@dataclass(frozen=True)
class Push:
    """A constant horizontal force on the root's centre of mass for 0.2 s.

    newtons, angle : numbers or (N,); angle to the character's heading at every moment, 0 forward, π/2 left
    at             : seconds from the start
    """

    newtons: float | np.ndarray
    at: float
    angle: float | np.ndarray = 0.0

    def force(self, t, yaw):
        """World force on the root at time t, heading yaw (both (...)).  (..., 3) [N]

        Test      tests/test_play.py::test_push"""
        on = (t > self.at - 1e-9) & (t < self.at + PUSH_SECONDS - 1e-9)
        size, angle = self.newtons * on, yaw + self.angle
        return np.stack([size * np.cos(angle), size * np.sin(angle), 0.0 * size * angle], axis=-1)


def parse_push(text: str | None) -> Push | None:
    """N@T or N@T:DIRECTION.  UserError: anything else.  Test: tests/test_play.py::test_push"""
    if text is None:
        return None
    number = r"(\d+(?:\.\d*)?|\.\d+)"
    found = re.fullmatch(rf"{number}@{number}(?::(\w+))?", text.strip())
    if not found or (found[3] or "forward") not in DIRECTIONS:
        valid = ", ".join(DIRECTIONS)
        raise UserError(f"--push {text}: valid: N@T or N@T:DIRECTION, as 200@2 or 200@2.5:left; directions: {valid}")
    return Push(float(found[1]), float(found[2]), DIRECTIONS[found[3] or "forward"])


def largest_push(char: Character, ref: Reference, act, at, most, sequences=8, rounds=6, threads=0) -> dict:
    r"""The largest push survived, by bisection, on evenly chosen sequences and in four directions.

    Survived  no failure of [Reda23 §3.6] within 3 s after the push began; a sequence that fails without a push before
              then, or ends, is left out
    Args      at : s from the sequence's start; most : largest push tried [N]
    Returns   direction -> (k,) largest push survived [N], 0 if none, on the k sequences that live without one;
              "tried" -> number of sequences; "resolution" [N]
    Test      tests/test_play.py::test_largest_push
    """
    steps = round((at + RECOVERY) * ref.rate)
    long = np.flatnonzero(ref.last - ref.first >= steps)
    chosen = long[np.unique(np.linspace(0, len(long) - 1, min(sequences, len(long))).round().astype(int))]
    if not len(chosen):
        most = np.max(ref.last - ref.first, initial=0) / ref.rate - RECOVERY
        raise UserError(f"no sequence is {at + RECOVERY:.1f} s long: push before {max(most, 0.0):.1f} s")
    angle = np.tile(list(DIRECTIONS.values()), len(chosen))
    first = np.repeat(ref.first[chosen], len(DIRECTIONS))
    env = Env(char, ref, len(first), threads=threads, horizon=len(ref), autoreset=False)
    xfrc = env.batch.bind("xfrc_applied")

    def survives(newtons):
        env.reset(frames=first)
        push, alive = Push(newtons, at, angle), np.ones(env.n, bool)
        for _ in range(steps):
            xfrc[:, char.root, :3] = push.force(env.steps * env.dt, heading(env.qpos[:, 3:7]))
            alive &= ~env.step(act(env))[2]
        return alive

    low, high = np.zeros(env.n), np.full(env.n, float(most))
    lives = survives(low)
    low = np.where(survives(high), high, low)
    for _ in range(rounds):
        middle = (low + high) / 2
        ok = survives(middle)
        low, high = np.where(ok, middle, low), np.where(ok, high, middle)
    rows = {name: low[k :: len(DIRECTIONS)][lives[k :: len(DIRECTIONS)]] for k, name in enumerate(DIRECTIONS)}
    return rows | {"tried": len(chosen), "resolution": most / 2**rounds}


def push_report(found: dict, push: Push) -> str:
    """The largest pushes as text.  Test: tests/test_play.py::test_largest_push"""
    n = len(found["forward"])
    lines = [
        f"largest push survived: {PUSH_SECONDS} s at {push.at} s, then {RECOVERY:.0f} s; up to {push.newtons:.0f} N, "
        f"by {found['resolution']:.1f} N; {n} of {found['tried']} sequences live without one"
    ]
    for name in DIRECTIONS if n else ():
        k = found[name]
        lines.append(f"{name:8s} median {np.median(k):.0f} N ({PUSH_SECONDS * np.median(k):.0f} N s), "
                     f"least {k.min():.0f} N, most {k.max():.0f} N")  # fmt: skip
    return "\n".join(lines)


# ------------------------------------------------------------------------------------ running


def simulate(
    char: Character, ref: Reference, act, horizon=EPISODE_STEPS, threads=0, only=None, push: Push | None = None
) -> list[Recording]:
    """Run every sequence from its first frame, to its end, to `horizon` control steps, or to failure.

    Args      act : function of the Env -> actions (N, u); only : indices of sequences, or None for all
              push : what shoves every character, or None
    Returns   one Recording a sequence; the state that failed is not part of it
    Test      tests/test_play.py::test_simulate
    """
    first = ref.first if only is None else ref.first[only]
    env = Env(char, ref, len(first), threads=threads, horizon=horizon, autoreset=False)
    env.reset(frames=first)
    available = env.available.copy()
    alive = np.ones(env.n, bool)
    qpos, contact, action = [env.qpos.copy()], [env.ref.contact[env.frame]], [np.zeros((env.n, env.action_size))]
    lived, failed = np.zeros(env.n, int), np.zeros(env.n, bool)
    xfrc = env.batch.bind("xfrc_applied")
    while alive.any():
        if push:
            xfrc[:, char.root, :3] = push.force(env.steps * env.dt, heading(env.qpos[:, 3:7]))
        _, _, terminated, truncated, _ = env.step(act(env))
        qpos.append(env.qpos.copy()), contact.append(env.contact.copy()), action.append(env.action.copy())
        failed |= alive & terminated
        lived += alive & ~terminated & (env.steps <= available)  # a single frame has no step to offer
        alive &= ~(terminated | truncated)
    qpos, contact, action = np.stack(qpos, 1), np.stack(contact, 1), np.stack(action, 1)
    return [
        Recording(
            f + np.arange(k + 1),
            qpos[i, : k + 1],
            contact[i, : k + 1],
            action[i, : k + 1],
            bool(failed[i]),
            int(available[i]),
        )
        for i, (f, k) in enumerate(zip(first, lived, strict=True))
    ]


def kinematic(char: Character, ref: Reference, horizon=EPISODE_STEPS) -> list[Recording]:
    """The retargeted pose itself, as if it were a character; its contact is height < 2 cm and speed < 0.4 m/s.

    Test      tests/test_metrics.py::test_metrics_of_kinematic"""
    out = []
    for a, b in zip(ref.first, ref.last, strict=True):
        frames = np.arange(a, min(b, a + horizon) + 1)
        height, speed = sole_motion(forward_kinematics(char, ref.qpos[frames]).soles, ref.rate)
        contact = (height < 0.02) & (speed < CONTACT_SPEED)
        action = np.zeros((len(frames), len(char.limits)))
        out.append(Recording(frames, ref.qpos[frames], contact, action, False, len(frames) - 1))
    return out


def time_to_failure(char, ref, act, n=256, seconds=20.0, seed=0, threads=0) -> float:
    r"""Mean time to failure from random starts: seconds lived by all ÷ failures; infinite if none failed.

    Test      tests/test_play.py::test_time_to_failure
    """
    env = Env(char, ref, n, seed=seed, threads=threads)
    env.reset(seed)
    failures, steps = 0, round(seconds / env.dt)
    for _ in range(steps):
        failures += int(env.step(act(env))[2].sum())
    return n * steps * env.dt / failures if failures else float("inf")


# ------------------------------------------------------------------------------------ measuring


def measure_all(char, ref, policy, opt: Options, seen: Reference | None = None) -> dict:
    """The four rows.  seen : what the policy is shown, if not ref  Test: tests/test_play.py::test_measure_json"""
    actions = {"policy": policy_action(policy), "kinematic": None, "zero": zero_action, "pd": pd_action}
    return {k: measure_one(k, char, ref, act, opt, seen if k == "policy" else None) for k, act in actions.items()}


def measure_one(name, char, ref, act, opt: Options, seen: Reference | None = None) -> dict:
    """One row: of what `act` does, which is shown `seen`; of the kinematic pose without it.  The targets are ref's.

    Test      tests/test_play.py::test_measure_json, test_headset_only"""
    print(f"measuring {name}: {len(ref.names)} sequences", file=sys.stderr, flush=True)
    seen = seen or ref
    row = measure(char, ref, simulate(char, seen, act, threads=opt.threads) if act else kinematic(char, ref))
    if act and opt.random_starts:
        row["fails_every_s"] = time_to_failure(char, seen, act, opt.random_starts, seed=opt.seed, threads=opt.threads)
    return row


# ------------------------------------------------------------------------------------ comparing

PICTURES = 8  # a row of the figure, unless --every says otherwise


@dataclass
class Arm:
    """One of the policies that are compared.  ref : its targets; seen : what it is shown of the user"""

    path: str
    policy: object
    meta: dict
    char: Character
    ref: Reference
    seen: Reference

    def title(self) -> str:
        """What it is, in a line.  Test: tests/test_play.py::test_compare"""
        options, parts = self.meta.get("options", {}), [name_of(self.char)]
        parts += [f"{fmt_count(steps)} steps"] if (steps := total_steps(self.meta)) else []
        parts += [f"without {' '.join(map(str, options['without']))}"] if options.get("without") else []
        parts += ["root tracked only"] if options.get("track") == "root" else []
        if sensors_of(self.meta, self.path) == "hmd":
            parts.append("headset only")
        elif self.seen is not self.ref:
            parts.append("controllers hang")
        return f"{self.path}: {', '.join(parts)}"


def name_of(char: Character) -> str:
    """A character's name and variation.  Test: tests/test_play.py::test_compare"""
    text = lambda v: "; ".join(v) if isinstance(v, list) else v  # noqa: E731
    return " ".join([char.name, *(f"{k} {text(v)}" for k, v in char.variant.items())])


def arms_of(clips, opt: Options) -> list[Arm]:
    """The policies of --compare, each with its own character, all checked before anything is simulated.

    Test      tests/test_play.py::test_compare"""
    arms, own = [], replace(opt, character=None)
    for path in opt.compare:
        policy, meta = load_policy(path)
        char = load_character(own, meta, path)
        ref = retarget.reference(char, clips)
        arms.append(Arm(path, policy, meta, char, ref, shown_to(meta, path, ref, opt.sensors)))
        check_fits(policy, Env(char, arms[-1].seen, 1), path)
    return arms


def compare(arms: list[Arm], opt: Options) -> dict:
    """A row for every policy, on the same sequences, and one for every character's kinematic pose.

    Test      tests/test_play.py::test_compare"""
    out = {a.path: measure_one(a.path, a.char, a.ref, policy_action(a.policy), opt, a.seen) for a in arms}
    several = {name_of(a.char): a for a in arms}
    for name, a in several.items():
        label = f"kinematic {name}" if len(several) > 1 else "kinematic"
        out[label] = measure_one(label, a.char, a.ref, None, opt)
    return out


def comparison_sheet(arms: list[Arm], clip, opt: Options, size=(300, 320)):
    """One picture: the human beside the first character's kinematic pose, then a row for every policy.

    All at the same moments of one sequence; where a policy had failed its row is empty.  The camera follows.
    Test      tests/test_play.py::test_comparison_sheet
    """
    from plumbing import render

    rate, first = arms[0].ref.rate, int(arms[0].ref.first[opt.sequence])
    last = min(len(clip) - 1, EPISODE_STEPS, round((opt.seconds or 10.0) * rate))
    step = max(1, round(opt.every * rate)) if opt.every else max(1, last / (PICTURES - 1))
    frames = np.unique(np.arange(0, last + 1, step).round().astype(int))
    times = [f"{t / rate:.1f} s" for t in frames]
    pose = SimpleNamespace(qpos=arms[0].ref.qpos[first:])
    wide, beside = mujoco.MjvCamera(), np.array([0.0, 0.8, 0.0])  # both in the picture, whichever way they turn
    wide.type, wide.trackbodyid, wide.distance = mujoco.mjtCamera.mjCAMERA_TRACKING, arms[0].char.root, 3.5
    wide.azimuth, wide.elevation = 205, -8
    human = retarget.draw(arms[0].char, clip, pose, frames, size, wide, beside)
    rows = [(f"human and kinematic {name_of(arms[0].char)}: {clip.name}", human, times)]
    for a in arms:
        act = policy_action(a.policy)
        recording = simulate(a.char, a.seen, act, threads=opt.threads, only=[opt.sequence])[0]
        lived = [t for t in frames if t < len(recording.frames)]
        gone = len(frames) - len(lived)
        images = pictures(a.char, a.seen, recording, lived, size)
        images += [np.full_like(images[0], 255)] * gone
        end = f"failed at {(len(recording.frames) - 1) / rate:.1f} s"
        rows.append((a.title(), images, times[: len(lived)] + [end] * gone))
    sheets = []
    for title, images, labels in rows:
        sheet = render.contact_sheet(images, labels, len(images))
        sheets += [render.label_image(np.full((20, sheet.shape[1], 3), 120, np.uint8), title), sheet]
    return np.vstack(sheets)


# ------------------------------------------------------------------------------------ looking


def pictures(char: Character, ref: Reference, recording: Recording, frames, size=(480, 360), fast=False):
    """Images (H, W, 3) of the character with the three sensor poses it was given.

    Args      frames : indices into the recording
    Test      tests/robustness/test_cli.py::test_play_png
    """
    from plumbing import render

    shown = char.mjspec().compile()
    scene = render.Scene(shown, *size, fast=fast)
    data = mujoco.MjData(shown)
    images = []
    for t in frames:
        data.qpos[:] = recording.qpos[t]
        mujoco.mj_forward(shown, data)
        f = recording.frames[t]
        images.append(scene.frame(data, markers=render.device_markers(ref.sensor_pos[f], ref.sensor_quat[f])))
    return images


def show(char: Character, ref: Reference, policy, sequence: int, how: str, port: int, push: Push | None = None) -> None:
    """Run the policy in real time in MuJoCo's viewer until it is closed; over again at the sequence's end or a failure.

    The environment steps the physics; the viewer only draws the states it is sent, the three sensor poses as boxes.

    Args      how : "window" (needs a display) or "web" (serves a page; needs none)
              port : of the page, 0 = the first free one from 8080; push : as in `simulate`
    Raises    UserError: no display, or the port is taken
    Test      tests/test_play_view.py::test_web_view
    """
    import time

    shown = _shown_model(char, ref)
    data = mujoco.MjData(shown)
    env = Env(char, ref, 1, threads=1, horizon=len(ref), autoreset=False)
    act = policy_action(policy)
    start = ref.first[[sequence]]
    env.reset(frames=start)
    xfrc = env.batch.bind("xfrc_applied")

    def pose():
        data.qpos[:], data.mocap_pos[:] = env.qpos[0], ref.sensor_pos[env.frame[0]]
        data.mocap_quat[:] = ref.sensor_quat[env.frame[0]]
        mujoco.mj_forward(shown, data)

    pose()
    with _open_viewer(shown, data, char.root, how, port) as handle:
        clock = time.perf_counter()
        while handle.is_running():
            handle.sync()
            if push:
                xfrc[:, char.root, :3] = push.force(env.steps * env.dt, heading(env.qpos[:, 3:7]))
            _, _, terminated, truncated, _ = env.step(act(env))
            if terminated[0] or truncated[0]:
                why = "fell or lost the user" if terminated[0] else "reached the end"
                print(f"{why} after {env.steps[0] * env.dt:.1f} s; again", flush=True)
                env.reset(frames=start)
            data.time += env.dt
            pose()
            clock = max(clock + env.dt, time.perf_counter() - 0.5)
            time.sleep(max(0.0, clock - time.perf_counter()))


def _shown_model(char: Character, ref: Reference):
    """The character with its visual shapes, and a box with axes for each sensor, to be placed as mocap bodies.

    Test      tests/test_play_view.py::test_shown_model
    """
    from plumbing import render

    spec = char.mjspec()
    for i, device in enumerate(render.device_markers(ref.sensor_pos[0], ref.sensor_quat[0])):
        body = spec.worldbody.add_body(name=f"sensor {i}", mocap=True)
        look = dict(contype=0, conaffinity=0, group=1)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=device.size, rgba=device.rgba, **look)
        for axis in np.eye(3):
            end = [0.0, 0.0, 0.0, *(2.5 * max(device.size) * axis)]
            size = [0.15 * max(device.size), 0.0, 0.0]
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=end, size=size, rgba=[*axis, 1.0], **look)
    return spec.compile()


def _open_viewer(model, data, root, how, port):
    """A handle with is_running(), sync(), close(). The camera follows the body `root`; collision shapes are hidden.

    Test      tests/test_play_view.py::test_taken_port_is_named, test_window_needs_a_display
    """
    import warnings

    def look(camera, option):
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, root
        camera.distance, camera.azimuth, camera.elevation = 3.5, 135, -15
        option.geomgroup[3] = 0
        return camera, option

    if how == "window":
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the reason goes into the error
                import glfw
                from mujoco import viewer

                if not glfw.init():  # MuJoCo would wait for ever
                    raise RuntimeError(glfw.get_error()[1].decode())
            handle = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        except (ImportError, RuntimeError) as error:
            raise UserError(f"no window can be opened ({error}); --view web shows it in a browser") from None
        with handle.lock():
            look(handle.cam, handle.opt)
        return handle
    try:
        from mujoco.studio import launch_thread, viewer_protocol, web_viewer
        from mujoco.studio.web import web_server

        web_server.bind_public_socket("::", port).close()  # a taken port: seen here, not in the viewer's thread
    except (ImportError, RuntimeError, OverflowError) as error:
        raise UserError(f"no page can be served on port {port}: {error}") from None

    def serve(endpoint):
        camera, option = look(mujoco.MjvCamera(), mujoco.MjvOption())
        config = viewer_protocol.ViewerConfig(gfx="web", http_port=port)
        page = web_viewer.WebViewer(config, endpoint, model=model, camera=camera, vis_options=option)
        viewer_protocol.run_viewer_loop(page)

    handle = launch_thread.launch_thread(serve)
    handle.set_model(model, data=data)
    return handle


# ------------------------------------------------------------------------------------ a headset's stream

PICTURED = 600.0  # s of a stream that pictures are kept of, at most


def play_stream(char: Character, policy, path, devices: int, opt: Options) -> None:
    """Drive the character with a recorded or live headset; print what happened.

    Args      devices : what the policy was trained with; of 3, two hang beside the body with --sensors hmd
    Raises    UserError: the stream cannot be read, or shows no headset for a second
    Test      tests/headset/test_stream.py::test_command_line, test_stdin, test_web_view
    """
    live = is_live(opt.stream)
    push = parse_push(opt.push)
    read = 1 if opt.sensors == "hmd" else devices
    player = Player(char, policy.mean_action, force=push.force if push else None, devices=devices)
    check_fits(policy, player, path)
    source = calibration.Stream(
        char, opt.axes, sample_rate=opt.sample_rate, grip=opt.grip, user_height=opt.user_height, devices=read
    )  # fmt: skip
    reader = Reader("standard input" if opt.stream == "-" else opt.stream, strict=not live, devices=read)
    samples = reader.read(lines_of(opt.stream))
    pace = Pace(player.dt) if opt.realtime or opt.view else None
    if live and pace:
        samples = arriving(samples, GAP, player.dt)
    seen = []
    keep = PICTURED / player.dt if opt.png or opt.video else 0
    with contextlib.ExitStack() as stack:
        handle = None
        if opt.view:
            none = np.zeros((1, devices, 3)), np.tile(np.eye(1, 4), (1, devices, 1))
            rest = SimpleNamespace(sensor_pos=none[0], sensor_quat=none[1])
            shown = _shown_model(char, rest)
            data = mujoco.MjData(shown)
            handle = stack.enter_context(_open_viewer(shown, data, char.root, opt.view, opt.port))

        def see(player, tick):
            pos, quat = tick.pos[:devices], tick.quat[:devices]
            if len(seen) < keep:
                seen.append((player.qpos[0].copy(), pos, quat))
            if handle:
                data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = player.qpos[0], pos, quat
                data.time += player.dt
                mujoco.mj_forward(shown, data)
                handle.sync()
                return handle.is_running()

        with contextlib.suppress(KeyboardInterrupt):  # the end of a live stream; what happened is still told
            drive(source, samples, player, opt.seconds, pace, see)
    if source.calibration is None:
        raise UserError(f"{reader.name}: {source.uncalibrated()}")
    unreadable = [f"{reader.unreadable} lines could not be read"] if reader.unreadable else []
    print(*source.report(), *unreadable, *player.report(), *(pace.report() if pace else []), sep="\n")
    if seen:
        qpos, pos, quat = map(np.array, zip(*seen, strict=True))
        recording = SimpleNamespace(qpos=qpos, frames=np.arange(len(qpos)))
        _write_pictures(char, SimpleNamespace(sensor_pos=pos, sensor_quat=quat), recording, len(qpos) - 1, opt)


def _write_pictures(char, ref, recording, last, opt):
    """The contact sheet and the video that the options ask for.  Test: tests/robustness/test_cli.py::test_play_png"""
    from plumbing import render

    if opt.png:
        frames = np.arange(0, last + 1, max(1, round((opt.every or 0.5) * CONTROL_RATE)))
        labels = [f"{t / CONTROL_RATE:.1f} s" for t in frames]
        render.write_png(opt.png, render.contact_sheet(pictures(char, ref, recording, frames), labels, 5))
        print(opt.png)
    if opt.video:
        images = pictures(char, ref, recording, range(last + 1), (640, 480), fast=True)
        render.write_video(opt.video, images, CONTROL_RATE)
        print(opt.video)


# ------------------------------------------------------------------------------------ command line


def find_policy(opt: Options):
    """The policy named, or the shipped one, its path and what its file says; UserError says how to make one."""
    name = Path(opt.character or "jesse")
    shipped = name.with_suffix(".npz") if name.suffix == ".toml" else character.CHARACTERS / f"{name}.npz"
    path = Path(opt.policy) if opt.policy else shipped
    if not path.exists():
        load(str(name))  # a wrong name, or a broken character, is the better complaint
        make = f"python ppo.py --character {name} --out runs/a"
        raise UserError(f"no policy {path}: train one ({make}), then --policy runs/a")
    policy, meta = load_policy(path)
    return policy, path, meta


def load_character(opt: Options, meta, path) -> Character:
    """The character that the flags ask for; where they ask for nothing, the policy's own with its variation.

    A flag changes that one thing; another character has none of the policy's variations.
    Test      tests/test_play.py::test_character_of_the_policy"""
    own = trained_as(meta, path) or Switches()
    base = own if opt.character in (None, own.character) else Switches(opt.character)
    given = {k: v for k in ("tail", "scale", "set") if (v := getattr(opt, k)) != getattr(Switches(), k)}
    return replace(base, **given).load()


def devices_of(meta, path, sensors: str | None) -> int:
    """How many devices a policy was trained with, 3 or 1.  UserError: fewer than `sensors` "full" asks for

    Test      tests/test_play.py::test_headset_only"""
    devices = 1 if sensors_of(meta, path) == "hmd" else 3
    if devices == 1 and sensors == "full":
        raise UserError(f"{path}: was trained with the headset alone: leave out --sensors, or give --sensors hmd")
    return devices


def shown_to(meta, path, ref: Reference, sensors: str | None) -> Reference:
    """What a policy is shown of the user: the devices it was trained with; with `sensors` "hmd" controllers hang.

    Test      tests/test_play.py::test_headset_only"""
    if devices_of(meta, path, sensors) == 1:
        return headset_only(ref)
    return controllers_hang(ref) if sensors == "hmd" else ref


def main(argv=None):
    """python play.py: measure, picture, film or show a policy.  Test: tests/test_play.py::test_measure_json"""
    argv = list(argv or [])
    for i, a in enumerate(argv):  # --view alone means a window
        if a == "--view" and (i + 1 == len(argv) or argv[i + 1].startswith("--")):
            argv[i] = "--view=window"
    if "--compare" in argv:  # A B … are one value
        i = argv.index("--compare") + 1
        n = next((k for k, a in enumerate(argv[i:]) if a.startswith("--")), len(argv) - i)
        argv[i : i + n] = [",".join(argv[i : i + n])] * (n > 0)
    opt = cli(Options, argv, "play.py", __doc__)
    if not (opt.measure or opt.png or opt.video or opt.bvh or opt.view or opt.stream or opt.compare):
        raise UserError(
            "nothing to do: give --measure, --compare A B, --png OUT, --video OUT, --bvh OUT, --view or --stream FILE"
        )
    if opt.compare:
        many = len(opt.compare) > 1 and len(set(opt.compare)) == len(opt.compare)
        if not many:
            raise UserError(f"--compare {' '.join(opt.compare)}: valid: two policies or more, none twice")
        plain, others = Options(), "policy character tail scale set stream view video bvh push".split()
        if wrong := [f"--{k}" for k in others if getattr(opt, k) != getattr(plain, k)]:
            raise UserError(f"--compare takes policies with their own characters: leave out {', '.join(wrong)}")
    if wrong := given_flags(argv) & (OF_MOTION if opt.stream else OF_STREAM):
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(wrong))
        says = "are of a motion, and --stream has none" if opt.stream else "are of --stream FILE"
        raise UserError(f"{flags} {says}: leave out the one or the other")
    if opt.stream and opt.bvh:
        raise UserError("--bvh records a motion, not a stream; give one of the two")
    if opt.stream and opt.measure:
        raise UserError("--measure compares with a human's motion, which a stream has not; give one of the two")
    push = parse_push(opt.push)
    check_folders(opt.json, opt.png, opt.video, opt.bvh, read=(*mocap.data.parts(opt.motion), opt.stream, opt.policy))
    if opt.json and not (opt.measure or opt.compare):
        raise UserError("--json writes the table of --measure or --compare: give one of them")
    if not opt.compare:
        policy, path, meta = find_policy(opt)
        char = load_character(opt, meta, path)
    if opt.stream:
        play_stream(char, policy, path, devices_of(meta, path, opt.sensors), opt)
        return
    clips = mocap.data.sequences(
        opt.motion, "all" if opt.all else opt.split, opt.clips, seed=opt.seed, reading=Reading.of(opt)
    )
    if opt.user_scale != 1.0:
        clips = [augment.resize(c, opt.user_scale) for c in clips]
    if opt.sequence >= len(clips):
        raise UserError(f"--sequence {opt.sequence}: there are {len(clips)}, from 0")
    if opt.compare:
        arms = arms_of(clips, opt)
        print(*(a.title() for a in arms), sep="\n")
        results = compare(arms, opt)
        print(comparison(results))
        if opt.json:
            atomic_write(opt.json, as_json(results))
        if opt.png:
            from plumbing import render

            render.write_png(opt.png, comparison_sheet(arms, clips[opt.sequence], opt))
            print(opt.png)
        return
    ref = retarget.reference(char, clips)
    seen = shown_to(meta, path, ref, opt.sensors)
    check_fits(policy, Env(char, seen, 1), path)
    if opt.measure and push:
        found = largest_push(char, seen, policy_action(policy), push.at, push.newtons, threads=opt.threads)
        print(push_report(found, push))
        if opt.json:
            as_lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in found.items()}
            atomic_write(opt.json, json.dumps(as_lists, indent=2) + "\n")
    elif opt.measure:
        results = measure_all(char, ref, policy, opt, seen)
        print(table(results))
        if opt.json:
            atomic_write(opt.json, as_json(results))
    if opt.png or opt.video or opt.bvh:
        last = int((opt.seconds or 10.0) * CONTROL_RATE) if opt.png or opt.video else EPISODE_STEPS
        shown = min(last, EPISODE_STEPS, int(ref.last[opt.sequence] - ref.first[opt.sequence])) / CONTROL_RATE
        if push and push.at >= shown:
            says = f"only {shown:.1f} s are shown: push earlier, or give more --seconds"
            raise UserError(f"--push {opt.push}: {says}")
        recording = simulate(char, seen, policy_action(policy), threads=opt.threads, only=[opt.sequence], push=push)[0]
        lived = (len(recording.frames) - 1) / CONTROL_RATE
        print(
            f"{ref.names[opt.sequence]}: lived {lived:.1f} s of {recording.available / CONTROL_RATE:.1f}"
            + (f"; pushed by {push.newtons:g} N at {push.at:g} s" if push and push.at < lived else "")
        )
        if opt.bvh:
            retarget.write_bvh(opt.bvh, char, recording.qpos, CONTROL_RATE)
            print(opt.bvh)
        _write_pictures(char, seen, recording, min(last, len(recording.frames) - 1), opt)
    if opt.view:
        show(char, seen, policy, opt.sequence, opt.view, opt.port, push)


if __name__ == "__main__":
    run_main(main)

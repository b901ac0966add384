r"""Watch one policy: picture, video, viewer, BVH; on a motion or a headset's recording  [Reda23 §4].

    python play.py --character jesse --stream FILE.csv (or .bsor) | --stream -  a headset's recording, or a live one
    python play.py --character jesse --stream FOLDER --json OUT                 many recordings, side by side
    python play.py --character jesse --motion FOLDER --png OUT | --video OUT    headless pictures
    python play.py --character jesse --motion FOLDER --bvh OUT                  what the character did, as BVH
    python play.py --character jesse --stream FILE.csv --bvh OUT --bvh-names unity    of a stream, by Unity's names
    python play.py --character jesse --motion FOLDER --view | --view web        MuJoCo's viewer: window or browser
    python play.py --character jesse --motion FOLDER --measure [--json OUT]     every metric (metrics.py)
    python play.py --character jesse --motion FOLDER --measure --push 400@2     the largest push survived
    python play.py --compare A B … --motion FOLDER [--json OUT] [--png OUT]     policies beside one another
    python play.py --figure 5 [--png OUT] [--video OUT]                         a figure of the paper, to be watched

Rows of the table: `streamed` (its mean action, driven by sensors alone, from the default pose), `tracked` (begun on the
user's true pose), `kinematic` (the retargeted pose itself), `zero` (no torque) and `pd` (open-loop PD tracking of the
reference).  Targets and labels are the human's for all rows.

A policy's file says which character it was trained for, with which variation, and whether it saw controllers.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np

import metrics
import mocap.data
import retarget
from character import CHARACTERS, Character
from env import EPISODE_STEPS, ROOT_LIMIT, Env
from headset import axes
from headset.axes import StreamFlags
from headset.bsor import opened
from headset.player import Pace, Player, drive, ride, source_of, stream_of, tally, ticks_of
from headset.reader import GAP, arriving, files_of, is_live, sound
from human import heading
from metrics import ROWS, Arm, Push, Recording, name_of, parse_push, policy_action, simulate
from mocap.augment import looking, resize
from mocap.data import CONTROL_RATE
from mocap.rigs import Reading
from plumbing.cli import NONNEGATIVE, PNG, POSITIVE, UserError, arg, cli, complain, given_flags, printable, run_main
from plumbing.files import atomic_write, check_folders
from policy import check_fits
from retarget import Reference, forward_kinematics

# flags that say something of a motion alone, or of a stream alone
OF_MOTION = {"motion", "clips", "joint_map", "unit", "up", "all", "split", "half", "rows", "user_scale"}
OF_MOTION |= {"random_starts", "sequence", "rate", "floor", "rest_pose", "seed"}
OF_TABLE = {"half", "rows", "random_starts"}  # of --measure and --compare alone
OF_STREAM = {"axes", "grip", "stream_unit", "devices", "sample_rate", "user_height", "realtime"}

FIGURES = {  # of the paper: the policies in characters/ that it puts side by side
    5: ("oppy-small", "oppy-same", "oppy-tall"),  # sizes
    6: ("dino-rewarded", "dino-orientation"),  # with the orientation reward, and without it
    8: ("dino-driven", "dino-passive", "dino-fixed"),  # the tail: two joints driven, none driven, six welded
}
OF_FIGURE = {"completed", "survival", "root_cm", "head_deg", "head_wobble_deg_s", "contact_agreement"}
OF_FIGURE |= {"foot_slide_cm_s", "steps_per_m"}


@dataclass
class Options(retarget.BvhFlags, StreamFlags, metrics.Options):
    """Which policy, on which motion or under which headset, and what to make of it."""

    measure: bool = arg(False, f"print every metric, a row each of {', '.join(ROWS)} (metrics.py)")
    sequence: int = arg(0, "which sequence to show", check=NONNEGATIVE)
    seconds: float | None = arg(
        None, "how much of it to show: 10 s by default, all of a stream or in a BVH", check=POSITIVE
    )
    every: float | None = arg(
        None, "seconds between the pictures of the contact sheet: 0.5, or 60 pictures; --compare: 8", check=POSITIVE
    )
    png: str | None = arg(None, "write a contact sheet", check=PNG)
    video: str | None = arg(None, "write a video (.mp4; needs the extra `view`)")
    view: str | None = arg(
        None, "show it live: window (MuJoCo's viewer) or web (in a browser on this machine)", choices=("window", "web")
    )
    port: int = arg(0, "port of the browser viewer, 0 = the first free one from 8080", check=NONNEGATIVE)
    realtime: bool = arg(False, "play a stream at the wall clock's pace and report the deadlines missed")
    figure: int | None = arg(
        None, "a figure of the paper: its policies, streamed, on one user; by default figure-N.png", tuple(FIGURES)
    )


# ------------------------------------------------------------------------------------ looking

PICTURES = 8  # a row of the figure, unless --every says otherwise
MANY = 60  # pictures of a sheet at most, likewise


def comparison_sheet(arms: list[Arm], clip, opt: Options, size=(300, 320), numbers=None):
    """One picture: the human beside the first character's kinematic pose, then a row for every policy.

    All at the same moments of one sequence; where a policy had failed its row is empty.  The camera follows.  Without
    the row `tracked` the policies are streamed: driven by the sensors alone, from the default pose.
    Args      numbers : path -> a line under that policy's pictures, or None
    Test      tests/test_play.py::test_comparison_sheet
    """
    from plumbing import render

    rate, first = arms[0].ref.rate, int(arms[0].ref.first[opt.sequence])
    tracked, user = "tracked" in opt.rows, clip
    if not tracked:  # the human where the stream has them, lead-in and all
        clip = stream_of(arms[0].char, clip)[2]
    longest = min(len(clip) - 1, EPISODE_STEPS) if tracked else len(clip) - 1
    last = min(longest, round((opt.seconds or 10.0) * rate))
    step = max(1, round(opt.every * rate)) if opt.every else max(1, last / (PICTURES - 1))
    frames = np.unique(np.arange(0, last + 1, step).round().astype(int))
    times = [f"{t / rate:.1f} s" for t in frames]
    pose = SimpleNamespace(qpos=arms[0].ref.qpos[first:]) if tracked else retarget.retarget(arms[0].char, clip)
    wide, beside = mujoco.MjvCamera(), np.array([0.0, 0.8, 0.0])  # both in the picture, whichever way they turn
    wide.type, wide.trackbodyid, wide.distance = mujoco.mjtCamera.mjCAMERA_TRACKING, arms[0].char.root, 3.5
    wide.azimuth, wide.elevation = 205, -8
    human = retarget.draw(arms[0].char, clip, pose, frames, size, wide, beside)
    rows, view = [(f"human and kinematic {name_of(arms[0].char)}: {clip.name}", human, times)], same_view(arms)
    for a in arms:
        recording, seen = played(a, user, opt)
        lived = [t for t in frames if t < len(recording.frames)]
        gone = len(frames) - len(lived)
        images = pictures(a.char, seen, recording, lived, size, camera=view)
        images += [np.full_like(images[0], 255)] * gone
        end = f"failed at {(len(recording.frames) - 1) / rate:.1f} s"
        rows.append((a.title(), images, times[: len(lived)] + [end] * gone))
    sheets = []
    for (title, images, labels), under in zip(rows, [None, *((numbers or {}).get(a.path) for a in arms)], strict=True):
        sheet = render.contact_sheet(images, labels, len(images))
        sheets += [*lines_of(title, sheet.shape[1]), sheet, *(lines_of(under, sheet.shape[1]) if under else [])]
    return np.vstack(sheets)


def lines_of(text, width):
    """Text as bands of an image, as many of its parts a band as there is room for; two spaces part them.

    Test      tests/test_play.py::test_figure"""
    from plumbing import render

    lines = [""]
    for part in text.split("  "):
        longer = f"{lines[-1]}  {part}".strip()
        lines[-1:] = [longer] if 12 * len(longer) <= width - 4 or not lines[-1] else [lines[-1], part]
    return [render.label_image(np.full((20, width, 3), 120, np.uint8), line) for line in lines]


def played(arm: Arm, clip, opt: Options):
    """What a policy did on the sequence that is shown, until it failed, and what it was shown of the user.

    Args      clip : the user's, as it was recorded
    Test      tests/test_play.py::test_comparison_sheet_streamed"""
    if "tracked" in opt.rows:
        act = policy_action(arm.policy)
        return simulate(arm.char, arm.seen, act, threads=opt.threads, only=[opt.sequence])[0], arm.seen
    pos, quat, _, _ = stream_of(arm.char, clip, arm.devices, opt.sensors == "hmd" and arm.devices == 3)
    [r] = ride(arm.char, arm.policy.mean_action, [(pos, quat)], arm.devices, opt.threads)
    lived = r.lives[0][1]
    seen = SimpleNamespace(sensor_pos=pos[:, : arm.devices], sensor_quat=quat[:, : arm.devices])
    return SimpleNamespace(qpos=r.qpos[:lived], frames=np.arange(lived)), seen


def same_view(arms: list[Arm]):
    """One camera for bodies of several sizes, or None: each body has its own, by which all would look alike.

    Test      tests/test_play.py::test_same_view"""
    hips = {a.char.name: set() for a in arms}
    for a in arms:
        hips[a.char.name].add(a.char.hip_height)
    if all(len(h) == 1 for h in hips.values()):
        return None
    view = mujoco.MjvCamera()
    view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, arms[0].char.root
    view.distance, view.azimuth, view.elevation = 7.0 * max(max(h) for h in hips.values()), 205, -8
    return view


def pictures(char: Character, ref: Reference, recording: Recording, frames, size=(480, 360), fast=False, camera=None):
    """Images (H, W, 3) of the character with the three sensor poses it was given.

    Args      frames : indices into the recording; camera : as `render.Scene.frame` has it
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
        images.append(scene.frame(data, camera, render.device_markers(ref.sensor_pos[f], ref.sensor_quat[f])))
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


LOOPBACK = "127.0.0.1"  # where the browser viewer listens


def _open_viewer(model, data, root, how, port):
    """A handle with is_running(), sync(), close(). The camera follows the body `root`; collision shapes are hidden.

    Test      tests/test_play_view.py::test_web_view, test_taken_port_is_named, test_window_needs_a_display
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

        web_server.bind_public_socket(LOOPBACK, port).close()  # a taken port: seen here, not in the viewer's thread
    except (ImportError, RuntimeError, OverflowError) as error:
        raise UserError(f"no page can be served on port {port}: {error}") from None

    class Viewer(web_viewer.WebViewer):
        # MuJoCo's would listen on all interfaces and asks for no password: its "::" is set, and passed over
        _host = property(lambda self: LOOPBACK, lambda self, host: None)

    def serve(endpoint):
        camera, option = look(mujoco.MjvCamera(), mujoco.MjvOption())
        config = viewer_protocol.ViewerConfig(gfx="web", http_port=port)
        page = Viewer(config, endpoint, model=model, camera=camera, vis_options=option)
        viewer_protocol.run_viewer_loop(page)

    handle = launch_thread.launch_thread(serve)
    handle.set_model(model, data=data)
    return handle


# ------------------------------------------------------------------------------------ figures of the paper

USER = "walk_105"  # the built-in walk of the figures, unless --motion or --clips says another
LOOKS = (6,)  # figures whose own user looks about, as the paper's does


def figure_options(opt: Options, argv) -> Options:
    """The options of --figure as those of a comparison of its policies.

    Raises    UserError: a policy of it is not there, or flags that would do nothing
    Test      tests/test_play.py::test_figure_options"""
    given = given_flags(argv)
    may = OF_MOTION - OF_TABLE | {"figure", "png", "video", "seconds", "every", "threads"}
    if wrong := sorted(given - may):
        raise UserError(f"--figure {opt.figure}: has its own policies, streamed: leave out --{', --'.join(wrong)}")
    paths = [Path(os.path.relpath(CHARACTERS / f"{name}.npz")) for name in FIGURES[opt.figure]]
    if gone := [p for p in paths if not p.is_file()]:
        raise UserError(f"--figure {opt.figure}: no policy {gone[0]}; the repository has it: git checkout {gone[0]}")
    clips = opt.clips if given & {"motion", "clips"} else USER
    png = opt.png or (None if opt.video else f"figure-{opt.figure}.png")
    return replace(opt, compare=tuple(map(str, paths)), rows=("streamed",), clips=clips, png=png)


def play_figure(opt: Options) -> None:
    """Play a figure's policies on one user; print their numbers, and put them under the pictures.

    Test      tests/test_play.py::test_figure"""
    from plumbing import render

    check_folders(opt.png, opt.video, read=read_by(opt))
    render.check_video(opt.video)
    _, long = metrics.motion_of(opt)
    clip = chosen(long, opt)
    if opt.figure in LOOKS and opt.clips == USER:
        clip = replace(looking(clip), name=f"{clip.name}, looks about")
    arms, columns = metrics.arms_of([clip], opt), [c for c in metrics.COLUMNS if c[0] in OF_FIGURE]
    rows = {a.path: metrics.streamed(a.char, a.policy.mean_action, [clip], a.devices, opt.threads) for a in arms}
    print(*(a.title() for a in arms), "streamed", metrics.comparison(rows, columns), sep="\n")
    cells = {path: zip(columns, metrics.cells("", row, columns)) for path, row in rows.items()}
    numbers = {path: "  ".join(f"{head} {text}" for (_, head, _), text in pairs) for path, pairs in cells.items()}
    numbers = {path: text.replace("°", "deg").replace("³", "3") for path, text in numbers.items()}  # the font's letters
    if opt.png:
        render.write_png(opt.png, comparison_sheet(arms, clip, replace(opt, sequence=0), numbers=numbers))
        print(opt.png)
    if opt.video:
        render.write_video(opt.video, film(arms, clip, opt, numbers), CONTROL_RATE)
        print(opt.video)


def film(arms: list[Arm], clip, opt: Options, numbers, size=(480, 480)):
    """Images of a video: the policies side by side, streamed on one user, names above, numbers under each.

    One that has failed is white from then on.
    Test      tests/test_play.py::test_figure"""
    from plumbing import render

    user, clip = clip, stream_of(arms[0].char, clip)[2]
    last, films = min(len(clip) - 1, round((opt.seconds or 10.0) * CONTROL_RATE)), []
    for a in arms:
        recording, seen = played(a, user, opt)
        lived = range(min(last + 1, len(recording.frames)))
        films.append(pictures(a.char, seen, recording, lived, size, True, same_view(arms)))
    under = [np.vstack(lines_of(numbers[a.path], size[0])) for a in arms]
    for t in range(last + 1):
        shown = [f[t] if t < len(f) else np.full_like(f[0], 255) for f in films]
        named = [render.label_image(image, name_of(a.char)) for image, a in zip(shown, arms, strict=True)]
        yield render.hstack([np.vstack(parts) for parts in zip(named, under, strict=True)])


# ------------------------------------------------------------------------------------ a headset's stream

KEPT = 600.0  # s of a stream that are kept for pictures and BVH, at most


def say(lines, path=None) -> None:
    """Print lines, of a file by its name.  Test: tests/headset/test_stream.py::test_what_is_said_of_a_folder"""
    for line in lines:
        print(printable(f"{path}: {line}" if path else line), flush=True)


def watched(samples, watch: axes.Watch):
    """The samples of a live stream; what does not fit a person is said as it comes.

    Test      tests/headset/test_stream.py::test_axes_are_found"""
    for sample in samples:
        say(watch.push(sample))
        yield sample


def follow(char: Character, policy, path, devices: int, opt, see, pace: Pace | None = None, push: Push | None = None):
    """Drive the character with a recorded or live headset until it ends; print what happened.

    Args      devices : what the policy was trained with; of 3, two hang beside the body with --sensors hmd
              opt : StreamFlags with `sensors` and `seconds`; see : as `headset.player.drive` has it
    Raises    UserError: the stream cannot be read, or shows no headset for a second; of a live one after the report
    Test      tests/headset/test_stream.py::test_command_line, test_stdin, test_stdin_that_breaks, test_web_view
    """
    live = is_live(opt.stream)
    read = 1 if opt.sensors == "hmd" else devices
    player = Player(char, policy.mean_action, force=push.force if push else None, devices=devices)
    check_fits(policy, player, path)
    source, how = source_of(char, opt.stream, read, opt)
    reader, samples = opened(opt.stream, strict=not live, devices=read)
    if live:  # a file's axes were looked at before
        samples = watched(samples, axes.Watch(source.axes, source.grip, source.unit, tuple(source.order), read))
    say(how.lines)
    if live and pace:
        samples = arriving(samples, GAP, player.dt)
    broken = None
    try:
        drive(source, samples, player, opt.seconds, pace, see)
    except KeyboardInterrupt:  # the end of a live stream; what happened is still told
        pass
    except UserError as error:
        if not live or source.calibration is None:
            raise
        broken = error
    if source.calibration is None:
        raise UserError(f"{reader.name}: {source.uncalibrated()}")
    unreadable = [f"{reader.unreadable} lines could not be read"] if reader.unreadable else []
    told = player.report(controllers=read == 3)
    print(*source.report(), *unreadable, *told, *(pace.report() if pace else []), sep="\n", flush=True)
    if broken:
        raise broken


def play_stream(char: Character, policy, path, devices: int, opt: Options) -> None:
    """Drive the character with a headset; show it, picture it, write it as BVH: of a live one also what it broke off.

    Test      tests/headset/test_stream.py::test_command_line, test_stdin, test_web_view, test_stream_as_bvh,
              test_stdin_that_breaks
    """
    seen, dt, live, broken = [], 1.0 / CONTROL_RATE, is_live(opt.stream), None
    keep = KEPT / dt if opt.png or opt.video or opt.bvh else 0
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

        pace = Pace(dt) if opt.realtime or opt.view else None
        try:
            follow(char, policy, path, devices, opt, see, pace, parse_push(opt.push))
        except UserError as error:
            if not live:
                raise
            broken = error
    if seen:
        qpos, pos, quat = map(np.array, zip(*seen, strict=True))
        recording = SimpleNamespace(qpos=qpos, frames=np.arange(len(qpos)))
        if opt.bvh:
            opt.write_bvh(char, qpos, CONTROL_RATE)
        _write_pictures(char, SimpleNamespace(sensor_pos=pos, sensor_quat=quat), recording, len(qpos) - 1, opt)
    if broken:
        raise broken


def _write_pictures(char, ref, recording, last, opt):
    """The contact sheet and the video that the options ask for.  Test: tests/robustness/test_cli.py::test_play_png"""
    from plumbing import render

    if opt.png:
        every = opt.every or max(0.5, last / CONTROL_RATE / MANY)
        frames = np.arange(0, last + 1, max(1, round(every * CONTROL_RATE)))
        labels = [f"{t / CONTROL_RATE:.1f} s" for t in frames]
        render.write_png(opt.png, render.contact_sheet(pictures(char, ref, recording, frames), labels, 5))
        print(opt.png)
    if opt.video:
        images = pictures(char, ref, recording, range(last + 1), (640, 480), fast=True)
        render.write_video(opt.video, images, CONTROL_RATE)
        print(opt.video)


# ------------------------------------------------------------------------------------ many recordings

FEW = 10  # recordings that are read without a word
OF_FILE = ("seconds", "completed", "survival", "failures", "fails_every_s", "head_cm", "hands_cm", "own_slide_cm_s")


def recordings_of(path) -> list[Path]:
    """The recordings of a folder and below it, or the file itself.

    Raises    UserError: a folder without any
    Test      tests/headset/test_stream.py::test_folder_of_recordings"""
    files = files_of(path)
    if not files:
        raise UserError(f"--stream {path}: a folder without recordings; valid: one that holds .csv or .bsor files")
    return files


def slides_of(char: Character, ride) -> np.ndarray:
    """`metrics.own_slide` of a ride, without the jumps to where it was stood up anew.

    As in `metrics.measure` the contact of a life's start is taken to be its first step's.
    Test      tests/headset/test_stream.py::test_slides_as_measured"""
    soles, contact = forward_kinematics(char, ride.qpos).soles, ride.contact.copy()
    for a, b in ride.lives:
        contact[a] = contact[min(a + 1, b - 1)]
    return np.concatenate([metrics.own_slide(soles[a:b], contact[a:b], CONTROL_RATE) for a, b in ride.lives])


def errors_of(rides, slides, held) -> dict:
    """Means over all ticks of several rides; nan where there is nothing to tell of.

    Args      slides : `slides_of` each; held : bool each, whether its controllers were in the user's hands, or of all
    Test      tests/headset/test_stream.py::test_slides_as_measured"""
    ticks, slides = np.array([len(r.qpos) for r in rides]), np.concatenate(slides)
    with_hands = ticks * np.broadcast_to(held, len(rides))
    hands = np.array([r.hands / len(r.qpos) for r in rides]) @ with_hands
    return {
        "head_cm": 100 * sum(r.head for r in rides) / ticks.sum(),
        "hands_cm": 100 * hands / with_hands.sum() if with_hands.any() else float("nan"),
        "own_slide_cm_s": 100 * float(slides.mean()) if len(slides) else float("nan"),
    }


def summary_of(rides, slides, held) -> dict:
    """Seconds, failures and errors of one ride, or of several together; `completed` is the share of them.

    Args      slides, held : as `errors_of`
    Test      tests/headset/test_stream.py::test_folder_of_recordings"""
    counts = tally(rides)
    return {
        "seconds": round(counts["seconds"], 3),
        **{k: counts[k] for k in ("completed", "survival", "failures")},
        "fails_every_s": counts["fails_every_s"] if counts["failures"] else None,
        **{k: None if np.isnan(v) else v for k, v in errors_of(rides, slides, held).items()},
    }


def in_hand(told, seconds, devices: int) -> bool:
    """Whether a recording's controllers were the user's for half the time: else what stands in for them hangs.

    Args      told : as `ticks_of` has it
    Test      tests/headset/test_stream.py::test_folder_of_recordings"""
    return devices == 3 and told["lost_s"]["left"] + told["lost_s"]["right"] <= seconds


def play_recordings(char: Character, policy, path, devices: int, opt: Options) -> int:
    """Drive one character a recording, side by side; a line each, a line for all, and a JSON of them.

    A file that is no recording is named in a line and left out.  -> exit status, 1 if there was one
    Test      tests/headset/test_stream.py::test_folder_of_recordings"""
    check_fits(policy, Player(char, policy.mean_action, devices=devices), path)
    read, found = 1 if opt.sensors == "hmd" else devices, recordings_of(opt.stream)
    if len(found) > FEW:
        print(f"reading {len(found)} recordings, to play them side by side", file=sys.stderr)
    taken, broken = sound(lambda file: (file, ticks_of(char, file, read, opt)), found)
    files, streams = zip(*taken, strict=True)
    top, many = Path(opt.stream), os.path.isdir(opt.stream)
    names = {f: str(f.relative_to(top)) if many else f.name for f in found}
    for file, (*_, told) in taken:
        say(told["notes"], names[file])
    rides = ride(char, policy.mean_action, [s[:2] for s in streams], devices, opt.threads)
    slides, ours = [slides_of(char, r) for r in rides], [s[2] for s in streams]
    held = [in_hand(told, len(r.qpos) / CONTROL_RATE, read) for told, r in zip(ours, rides)]
    rows = (summary_of([r], [s], h) | {"completed": r.failures == 0} for r, s, h in zip(rides, slides, held))
    each = {names[file]: row | told for file, row, told in zip(files, rows, ours)}
    refused = dict(zip([names[f] for f in found if f not in files], broken, strict=True))
    everything = {"files": each, "all": summary_of(rides, slides, held), "refused": refused}
    if opt.json:
        atomic_write(opt.json, json.dumps(everything, indent=2, allow_nan=False) + "\n")
    for name, r in zip(each, rides, strict=True):
        print(line_of(printable(name), r.ends, each[name]))
    whole = f"all {len(rides)}{f' of {len(found)}, {len(refused)} refused' if refused else ''}"
    ends = sum((r.ends for r in rides), Counter())
    print(line_of(f"{whole}, completed {everything['all']['completed']:.2f}", ends, everything["all"]))
    return complain(broken)


def line_of(name, ends, row) -> str:
    """A recording in a line.  Test: tests/headset/test_stream.py::test_folder_of_recordings"""
    falls = ", ".join(f"{n} {end}" for end, n in sorted(ends.items())) or "no failure"
    hands = "" if row["hands_cm"] is None else f", hands {row['hands_cm']:.1f} cm"
    slide = "" if row["own_slide_cm_s"] is None else f", own slide {row['own_slide_cm_s']:.1f} cm/s"
    lost = ", ".join(f"{device} {s:.1f} s" for device, s in row.get("lost_s", {}).items() if s)
    lost = f"; lost: {lost}" if lost else ""
    return f"{name}: {row['seconds']:.1f} s, {falls}; head {row['head_cm']:.1f} cm{hands}{slide}{lost}"


# ------------------------------------------------------------------------------------ command line


def check_source(opt: StreamFlags, argv) -> None:
    """UserError: flags of a motion beside a stream, or of a stream without one.

    Test      tests/robustness/test_cli.py::test_play_flags_that_would_do_nothing"""
    if wrong := given_flags(argv) & (OF_MOTION if opt.stream else OF_STREAM):
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(wrong))
        says = "of a motion, and --stream has none" if opt.stream else "of --stream FILE"
        raise UserError(f"{flags} {'are' if len(wrong) > 1 else 'is'} {says}: leave out the one or the other")


def check_given(opt: Options, given) -> None:
    """UserError: flags that say something of what is not asked for.

    Test      tests/test_play.py::test_flags_of_what_is_not_asked_for"""
    table = bool(opt.measure or opt.compare)
    for flags, asked, what in (
        (OF_TABLE, table, "--measure or --compare"),
        ({"port"}, opt.view == "web", "--view web"),
        ({"every"}, opt.png, "--png"),
    ):
        if not asked and (wrong := sorted(flags & given)):
            names = ", ".join(f"--{name.replace('_', '-')}" for name in wrong)
            raise UserError(f"{names} says something of {what} alone: give that, or leave out {names}")


def check_options(opt: Options, argv) -> None:
    """UserError: flags that do not go together.

    Test      tests/robustness/test_cli.py::test_play_flags_that_would_do_nothing"""
    if not (opt.measure or opt.png or opt.video or opt.bvh or opt.view or opt.stream or opt.compare):
        raise UserError(
            "nothing to do: give --measure, --compare A B, --figure 5, --png OUT, --video OUT, --bvh OUT, --view or "
            "--stream FILE"
        )
    if opt.compare:
        metrics.check_comparison(opt, "stream", "view", "video", "bvh")
    check_source(opt, argv)
    check_given(opt, given_flags(argv))
    opt.check_bvh()
    if opt.stream and opt.measure:
        raise UserError("--measure compares with a human's motion, which a stream has not; give one of the two")
    if opt.json and not (opt.measure or opt.compare or opt.stream):
        raise UserError("--json writes the table of --measure, --compare or --stream: give one of them")
    many = opt.stream and os.path.isdir(opt.stream)
    if many and (opt.png or opt.video or opt.bvh or opt.view or opt.realtime or opt.push):
        says = "is a folder, played side by side: leave out pictures, --bvh, --view, --push"
        raise UserError(f"--stream {opt.stream}: {says}")
    if opt.stream and opt.json and (opt.realtime or opt.push):
        raise UserError("--stream with --json plays as it is: leave out --push and --realtime")
    if opt.stream and opt.json and not many and is_live(opt.stream):
        raise UserError("--json tells of recordings, not of a live stream; valid: a .csv or .bsor file, or a folder")
    parse_push(opt.push)
    check_folders(opt.json, opt.png, opt.video, opt.bvh, read=read_by(opt))
    if opt.video:
        from plumbing import render

        render.check_video(opt.video)


def read_by(opt: Options) -> list:
    """The files and folders that the options have read: motion, stream, policies, the character's own.

    Test      tests/test_play.py::test_what_is_read_is_not_overwritten"""
    name = Path(opt.character or "jesse")
    own = name.with_suffix("") if name.suffix == ".toml" else CHARACTERS / name
    files = [f"{own}{suffix}" for suffix in (".toml", ".xml", ".npz")]
    return [*mocap.data.parts(opt.motion), opt.joint_map, opt.stream, opt.policy, *opt.compare, *files]


def told_life(name, recording) -> str:
    """A line: how long it lived, and what ends a tracked play.  Test: tests/test_play.py::test_told_life"""
    lived, whole = (n / CONTROL_RATE for n in (len(recording.frames) - 1, recording.available))
    why = f": it fell, or was {ROOT_LIMIT:g} m from the user's root (§3.6)" if recording.failed else ""
    return f"{name}: lived {lived:.1f} s of {whole:.1f}{why}"


def main(argv=None):
    """python play.py: measure, picture, film or show a policy.  Test: tests/test_play.py::test_measure_json"""
    argv = metrics.listed(argv, "--compare")
    for i, a in enumerate(argv):  # --view alone means a window
        if a == "--view" and (i + 1 == len(argv) or argv[i + 1].startswith("--")):
            argv[i] = "--view=window"
    opt = cli(Options, argv, "play.py", __doc__)
    if opt.figure:
        play_figure(figure_options(opt, argv))
        return 0
    check_options(opt, argv)
    if opt.compare:
        _compare(opt)
        return 0
    if opt.measure:
        metrics.run(opt)
        if not (opt.png or opt.video or opt.bvh or opt.view):
            return 0
    policy, path, meta = metrics.find_policy(opt)
    char = metrics.load_character(opt, meta, path)
    if opt.stream:
        devices = metrics.devices_of(meta, path, opt.sensors)
        if opt.json or os.path.isdir(opt.stream):
            code = play_recordings(char, policy, path, devices, opt)
            if not (opt.png or opt.video or opt.bvh or opt.view):
                return code
        play_stream(char, policy, path, devices, opt)
        return 0
    look(char, policy, path, meta, opt)
    return 0


def _compare(opt: Options) -> None:
    """The table, and the figure."""
    arms, clips = metrics.run_comparison(opt)
    clip = chosen(clips, opt)
    if opt.png:
        from plumbing import render

        render.write_png(opt.png, comparison_sheet(arms, clip, opt))
        print(opt.png)


def chosen(clips, opt):
    """The clip that --sequence names.  UserError: there are not so many

    Test      tests/test_play.py::test_what_cannot_be_done_is_said_first"""
    if opt.sequence >= len(clips):
        raise UserError(f"--sequence {opt.sequence}: there are {len(clips)}, from 0")
    return clips[opt.sequence]


def sequence_of(char: Character, opt) -> Reference:
    """The sequence that the options name, for this character.

    Args      opt : Options, or others that say which motion: MotionFlags with `all`, `split`, `seed`, `sequence`,
              `user_scale`
    Raises    UserError: there are not so many
    Test      tests/test_play.py::test_what_cannot_be_done_is_said_first"""
    split = "all" if opt.all else opt.split
    clips = mocap.data.sequences(opt.motion, split, opt.clips, seed=opt.seed, reading=Reading.of(opt))
    clip = chosen(clips, opt)
    return retarget.reference(char, [clip if opt.user_scale == 1.0 else resize(clip, opt.user_scale)])


def look(char: Character, policy, path, meta, opt: Options) -> None:
    """Picture, film, write as BVH or show one sequence.  Test: tests/robustness/test_cli.py::test_play_png"""
    check_fits(policy, Player(char, policy.mean_action, devices=metrics.devices_of(meta, path, opt.sensors)), path)
    ref = sequence_of(char, opt)  # which may take long
    seen, push = metrics.shown_to(meta, path, ref, opt.sensors), parse_push(opt.push)
    if opt.png or opt.video or opt.bvh:
        told = max(1, round(opt.seconds * CONTROL_RATE)) if opt.seconds else None
        whole = max(len(ref) - 1, 1)
        last = min(told or (round(10.0 * CONTROL_RATE) if opt.png or opt.video else whole), whole)
        if push and push.at >= last / CONTROL_RATE:
            says = f"only {last / CONTROL_RATE:.1f} s are shown: push earlier, or give more --seconds"
            raise UserError(f"--push {opt.push}: {says}")
        horizon = whole if opt.bvh and not told else last
        recording = simulate(char, seen, policy_action(policy), horizon, opt.threads, push=push)[0]
        lived = (len(recording.frames) - 1) / CONTROL_RATE
        print(
            told_life(ref.names[0], recording)
            + (f"; pushed by {push.newtons:g} N at {push.at:g} s" if push and push.at < lived else "")
        )
        if opt.bvh:
            opt.write_bvh(char, recording.qpos, CONTROL_RATE)
        _write_pictures(char, seen, recording, min(last, len(recording.frames) - 1), opt)
    if opt.view:
        show(char, seen, policy, 0, opt.view, opt.port, push)


if __name__ == "__main__":
    run_main(main)

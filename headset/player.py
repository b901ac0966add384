r"""Recorded or live headset and controllers drive the character  [Reda23 §3.3 Eq. 4, §4.1].

    CSV lines ──► Reader ──► to_world ──► Guard ──► Calibration ──► Resampler ──► Player
    file, stdin   columns    axes         losses    user's size     30 Hz         observe, policy, physics

Columns, named in the first line, in any order; others are ignored:

    time                                             [s]; may be absent: then the rows are 1 / `sample_rate` apart
    head_px head_py head_pz                          position [m]
    head_qx head_qy head_qz head_qw                  orientation, a unit quaternion
    left_px … left_qw, right_px … right_qw           the controllers

Also known: `t`, `timestamp`; `hmd_`, `headset_`; `left_hand_`, `left_controller_`; `_pos_x`, `_rot_x`.  An empty cell,
`nan` or `null` says that the device is not tracked.  Quaternions are x, y, z, w here, w, x, y, z behind `to_world`.
With the headset alone (`--sensors hmd`, §4.2) the controllers' columns are neither needed nor read.

Nothing here looks ahead.  `drive` needs no more memory for a longer stream; `ride`, of recordings, keeps every tick.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np

from character import Character, geom_lowest
from env import BAD, FORCE_LIMIT, SUBSTEPS, fallen, observation_terms, observe, slices_of
from headset import axes
from headset.bsor import opened
from headset.calibration import Stream
from headset.losses import lose
from headset.reader import DEVICES, FAR_AWAY, GRIP, Sample
from human import Clip, heading, place, quat_about, quat_matrix, quat_rotate, sensors
from mocap.augment import begins_in_motion, lead
from mocap.data import CONTROL_RATE
from plumbing.cli import UserError
from retarget import HEADSET_AHEAD, STAGE_VEL, standing

# ------------------------------------------------------------------------------------ the character

AWAY = 1.0  # m, horizontally from the user's headset to HEADSET_AHEAD before the root: it has lost the user.  ASSUMED
# Its own headset would charge it with its build (Dino's is 0.24 m farther ahead): `Ride.farthest` has that distance


def from_user(qpos, headset) -> np.ndarray:
    """Horizontally from HEADSET_AHEAD before the root, where training has it, to the user's headset [m].

    Args      qpos (N, nq); headset (N, 3), world.  Returns (N,)
    Test      tests/extras/test_users.py::test_by_time"""
    place = qpos[:, :2] + quat_rotate(quat_about(2, heading(qpos[:, 3:7])), HEADSET_AHEAD)[:, :2]
    return np.linalg.norm(place - headset[:, :2], axis=1)


class Player:
    """N characters, each driven by sensor poses of its own; there is no human to compare with.

    Rule      each starts standing in the default pose under its headset, feet on the floor, moving as the headset does
              horizontally.  When its upper body touches the floor, its headset's place before the root is more than 1 m
              (horizontally) from the user's, or its state is not finite, that is counted and it stands under the
              headset again: the state given out is always finite
    Errors    distances of the characters' headset and controller sites from the poses they are given, over all ticks
    Args      act : observations (n, o) -> actions (n, u); force : (seconds, root yaws (n,)) -> (n, 3) [N] on the roots,
              world; devices : 3, or 1 for a policy that sees the headset alone; threads : as `Character.batch`
    Test      tests/headset/test_stream.py::test_player_observes_as_env, test_stand, test_falls_are_counted,
              test_never_nan, test_side_by_side
    """

    ENDS = ("fall", "away", "bad")

    def __init__(
        self, char: Character, act, n=1, rate=CONTROL_RATE, substeps=SUBSTEPS, force=None, devices=3, threads=1
    ):
        self.char, self.act, self.n, self.dt, self.substeps, self.force = char, act, n, 1.0 / rate, substeps, force
        self.name, self.devices = char.name, devices  # as `Env` has them
        char.model.opt.timestep = self.dt / substeps
        self.batch = char.batch(n, threads)
        names = "qpos qvel ctrl qacc_warmstart xfrc_applied xpos xmat cvel geom_xpos geom_xmat site_xpos sensordata"
        for name in names.split():
            setattr(self, name, self.batch.bind(name))
        self.slices = slices_of(observation_terms(char, devices, asymmetric=False))
        self.obs_size, self.action_size = self.slices["user"].stop, len(char.limits)
        self.obs = np.zeros((n, self.obs_size), np.float32)
        self.before = None
        self.contact = np.zeros((n, 2), bool)  # feet that pressed on the floor at the end of the step
        self.ticks = np.zeros(n, int)
        self.ends = [Counter() for _ in range(n)]
        self.head_error, self.hand_error, self.farthest = np.zeros((3, n))  # sums; the headset's greatest error [m]
        self.latency = deque(maxlen=100_000)  # (to the torque, to the new state) [s]

    def stand(self, pos, quat, ids=None):
        """The default pose under headsets, for the characters ids.  pos (n, 3, 3), quat (n, 3, 4), world

        Test      tests/headset/test_stream.py::test_stand"""
        ids = np.arange(self.n) if ids is None else ids
        self.qpos[ids] = standing(self.char, pos[ids, 0], quat[ids, 0])
        for array in (self.qvel, self.ctrl, self.qacc_warmstart, self.xfrc_applied):
            array[ids] = 0.0
        self.qvel[ids, :2] = (pos[ids, 0] - self.before[0][ids, 0])[:, :2] / self.dt if self.before else 0.0
        self.contact[ids] = False
        self.batch.forward(ids, STAGE_VEL)

    def step(self, pos, quat, playing=True) -> list[str | None]:
        """One control step.

        Args      pos (n, 3, 3), quat (n, 3, 4) of this tick; playing : (n,) bool, those whose streams go on: only they
                  are counted
        Returns   why each had to stand anew, one of ENDS, or None"""
        start = time.perf_counter()
        playing = np.broadcast_to(playing, self.n)
        seen = slice(0, self.devices)
        now = (pos[:, seen], quat_matrix(quat)[:, seen, :, :2].astype(np.float32))
        if self.before is None:
            self.stand(pos, quat)
            self.before = now
        error = np.linalg.norm(self.site_xpos[:, self.char.sensor_sites] - pos, axis=-1)  # (n, 3)
        self.head_error += error[:, 0] * playing
        self.farthest = np.fmax(self.farthest, error[:, 0] * playing)
        self.hand_error += error[:, 1:].mean(axis=1) * playing  # not reported where there are no controllers
        observe(self, slice(None), self.before, now, self.obs)
        action = self.act(self.obs)
        self.ctrl[:] = np.clip(action, -1.0, 1.0)
        decided = time.perf_counter()
        if self.force:
            push = self.force(self.ticks.max() * self.dt, heading(self.qpos[:, 3:7]))
            self.xfrc_applied[:, self.char.root, :3] = push
        self.batch.step(nstep=self.substeps, stage=STAGE_VEL)
        self.contact[:] = np.abs(self.sensordata[:, self.char.contact_adr]) > FORCE_LIMIT
        self.ticks += playing
        ends = self._ends(pos)
        ids = np.flatnonzero([end is not None for end in ends])
        if len(ids):
            for i in ids[playing[ids]]:
                self.ends[i][ends[i]] += 1
            self.batch.warning[ids] = 0
            self.stand(pos, quat, ids)
        self.before = now
        self.latency.append((decided - start, time.perf_counter() - start))
        return ends

    def _ends(self, pos) -> list[str | None]:
        """Which of ENDS each present state is, or None."""
        m = self.char.model
        bad = ~np.isfinite(np.concatenate([self.qpos, self.qvel, self.ctrl], axis=1)).all(axis=1)
        bad |= (self.batch.warning[:, BAD, 1] > 0).any(axis=1)
        with np.errstate(invalid="ignore"):
            fall = fallen(geom_lowest(m, self.char.fall_geoms, self.geom_xpos, self.geom_xmat).min(axis=1))
            away = from_user(self.qpos, pos[:, 0]) > AWAY
        return ["bad" if b else "fall" if f else "away" if a else None for b, f, a in zip(bad, fall, away)]

    @property
    def failures(self):
        """How often each had to stand anew.  (n,) int"""
        return np.array([sum(ends.values()) for ends in self.ends])

    def report(self, controllers=True) -> list[str]:
        """Falls, errors, latency.  controllers : were they the user's?  Those that hang have no errors to tell of

        Test      tests/headset/test_stream.py::test_falls_are_counted"""
        ticks = self.ticks.sum()
        if not ticks:
            return ["0 s played"]
        seconds, ends, n = ticks * self.dt, sum(self.ends, Counter()), self.failures.sum()
        counts = f"{ends['fall']} falls, {ends['away']} times lost the user, {ends['bad']} diverged"
        every = f"one every {seconds / n:.1f} s" if n else "none"
        torque, state = (1000 * np.percentile(k, [50, 99]) for k in np.array(self.latency).T)
        hands = ""
        if controllers and self.devices == 3:
            hands = f"hand error {100 * self.hand_error.sum() / ticks:.1f} cm, "
        return [
            f"{seconds:.1f} s played: {counts} ({every})",
            f"head error {100 * self.head_error.sum() / ticks:.1f} cm, {hands}mean over all ticks",
            f"latency: sensors to torque p50 {torque[0]:.2f} ms, p99 {torque[1]:.2f} ms; "
            f"with the physics p50 {state[0]:.2f} ms, p99 {state[1]:.2f} ms",
        ]


@dataclass
class Ride:
    """What a character did under one stream, from its first tick to its last.

    qpos (T, nq), contact (T, 2) bool and action (T, u) belong to the tick whose poses the character was given; anew
    (T,) says where it had just been stood up, the start included; ends counts why; head, hands : sums of errors [m];
    farthest : the headset's greatest error [m]
    """

    qpos: np.ndarray
    contact: np.ndarray
    action: np.ndarray
    anew: np.ndarray
    ends: Counter
    head: float
    hands: float
    farthest: float

    @property
    def failures(self):
        return sum(self.ends.values())

    @property
    def first(self):
        """Steps before the first that failed; all of them without one."""
        return self.lives[0][1] - 1 if self.failures else len(self.qpos)

    @property
    def lives(self) -> list[tuple[int, int]]:
        """(first tick, the one after the last) from each stand to the next; between two of them a jump is no motion."""
        cuts = [*map(int, np.flatnonzero(self.anew)), len(self.qpos)]
        return list(zip(cuts[:-1], cuts[1:]))


def tally(rides: list[Ride]) -> dict:
    """How long several characters kept their feet: the counts of every streamed table.

    completed, survival : means over rides, of whether and of how much of it before the first failure; seconds,
    failures : sums; fails_every_s : seconds / failures; first_failure_s : median of those that failed; inf of none
    Test      tests/headset/test_stream.py::test_tally"""
    ticks, first, failures = (np.array(a) for a in zip(*((len(r.qpos), r.first, r.failures) for r in rides)))
    seconds, failed = ticks.sum() / CONTROL_RATE, failures > 0
    return {
        "seconds": float(seconds),
        "completed": float(np.mean(~failed)),
        "survival": float(np.mean(first / ticks)),
        "failures": int(failures.sum()),
        "fails_every_s": float(seconds / failures.sum()) if failed.any() else float("inf"),
        "first_failure_s": float(np.median(first[failed]) / CONTROL_RATE) if failed.any() else float("inf"),
    }


def ride(char: Character, act, streams, devices=3, threads=0, force=None) -> list[Ride]:
    """Drive one character a stream, side by side with those whose streams are about as long.

    Args      act, force : as `Player`; streams : (pos (T, 3, 3), quat (T, 3, 4)) of each, in the character's world
    Test      tests/headset/test_stream.py::test_side_by_side
    """
    lengths, out = np.array([len(pos) for pos, _ in streams]), {}
    ids = sorted(range(len(streams)), key=lengths.__getitem__)
    while ids:  # who has ended is simulated until all have: so none is much longer than the others
        group = [i for i in ids if lengths[i] <= 1.5 * lengths[ids[0]]]
        out |= zip(group, _ride(char, act, [streams[i] for i in group], devices, threads, force), strict=True)
        ids = ids[len(group) :]
    return [out[i] for i in range(len(streams))]


def _ride(char, act, streams, devices, threads, force) -> list[Ride]:
    """The same of one group."""
    n, lengths = len(streams), np.array([len(pos) for pos, _ in streams])
    player = Player(char, act, n, force=force, devices=devices, threads=threads)
    pos, quat = (
        np.stack([np.concatenate([s[k], np.repeat(s[k][-1:], lengths.max() - len(s[k]), axis=0)]) for s in streams], 1)
        for k in (0, 1)
    )
    qpos, contact, action, anew = [], [], [np.zeros((n, len(char.limits)))], [np.ones(n, bool)]
    for t in range(lengths.max()):
        if t == 0:
            player.stand(pos[0], quat[0])
        qpos.append(player.qpos.copy())
        contact.append(player.contact.copy())
        ends = player.step(pos[t], quat[t], t < lengths)
        action.append(player.ctrl.copy())
        anew.append(np.array([end is not None for end in ends]))
    qpos, contact, action, anew = (np.stack(a[: lengths.max()], axis=1) for a in (qpos, contact, action, anew))
    return [
        Ride(qpos[i, :k], contact[i, :k], action[i, :k], anew[i, :k], player.ends[i], *errors)
        for i, (k, *errors) in enumerate(zip(lengths, player.head_error, player.hand_error, player.farthest))
    ]


FAR = 0.5 * FAR_AWAY  # m: from there nobody walks beyond the Guard's limit in a capture
STANDS, SETS_OFF, CAPTURE = 1.5, 1.5, 20.0  # s of a streamed capture: still, speeding up, of itself at most


def recorded(clip) -> tuple[list[Sample], Clip]:
    """A headset's recording of a clip with its lead-in (`mocap.augment.lead`; no speeding up where it begins still).

    A clip that begins beyond FAR is put on the origin: a headset is where its room is; others stay where they are.
    Returns   samples as a file's reader gives them, axes "mujoco"; the clip with its lead-in
    Test      tests/test_metrics.py::test_streamed, tests/headset/test_stream.py::test_captures_far_away"""
    whole = clip[: round(CAPTURE * clip.rate) + 1]
    start = whole.pos[0, 0, :2]
    whole = place(whole, 0.0, start, np.zeros(2)) if np.abs(start).max() > FAR else whole
    led = lead(whole, STANDS, SETS_OFF if begins_in_motion(whole) else 0.0)
    pos, quat = sensors(led)
    return [Sample(k / clip.rate, pos[k], np.roll(quat[k], -1, axis=-1)) for k in range(len(led))], led


def stream_of(char: Character, clip, devices=3, hang=False):
    r"""What a headset's recording of a clip makes of it: poses at the control rate, and the human where they are.

    Method    `recorded` samples through `headset.calibration.Stream`, as a file's are; the calibrating second is not
              played; hang : without its controllers, which then hang beside the body
    Returns   pos (T, 3, 3), quat (T, 3, 4) in the character's world; the clip in the same world, T frames; scale (3,)
    Raises    UserError: it shows no headset for a second
    Test      tests/test_metrics.py::test_streamed, tests/headset/test_stream.py::test_captures_far_away
    """
    stream = Stream(char, "mujoco", rate=clip.rate, devices=devices)
    samples, led = recorded(clip)
    samples = lose(samples, np.ones(len(samples), bool), "hands") if hang else samples
    ticks = [tick for sample in samples for tick in stream.push(sample)]
    c = stream.calibration
    if not ticks:
        raise UserError(f"{clip.name}: {stream.uncalibrated()}")
    seen = place(led, -c.yaw, c.origin[:2], np.zeros(2))[len(led) - len(ticks) :]
    return np.stack([t.pos for t in ticks]), np.stack([t.quat for t in ticks]), seen, c.scale


def source_of(char: Character, path, devices: int, opt: axes.StreamFlags):
    """The stream's reading as the options say, or as fits it best; and that choice, with what to say about it.

    Test      tests/headset/test_stream.py::test_axes_are_found"""
    order = tuple(map(DEVICES.index, opt.devices)) if opt.devices else None
    how = axes.choose(path, opt.axes, opt.grip, opt.stream_unit, order, devices)
    source = Stream(
        char,
        how.axes,
        sample_rate=opt.sample_rate,
        grip=how.grip,
        user_height=opt.user_height,
        devices=devices,
        unit=how.unit,
        order=how.order,
    )
    return source, how


def ticks_of(char: Character, path, devices: int, opt: axes.StreamFlags):
    """A recording's pos (T, 3, 3), quat (T, 3, 4) at the control rate, in the character's world; and how it was read.

    Args      opt : with `seconds`, how much of it, or None
    Returns   pos, quat; a dict of axes, grip [degrees], notes (what is to be said of it), lost_s (of each device, while
              it was played)
    Raises    UserError: it cannot be read, or shows no headset for a second
    Test      tests/headset/test_stream.py::test_folder_of_recordings"""
    source, how = source_of(char, path, devices, opt)
    reader, samples = opened(path, devices=devices)
    ticks, before, last = [], {}, max(1, round(opt.seconds * CONTROL_RATE)) if opt.seconds else None
    for sample in samples:
        ticks += source.push(sample)
        if not before and source.calibration:
            before = source.guard.lost()
        if last and len(ticks) >= last:
            break
    if not ticks:
        raise UserError(f"{path}: {source.uncalibrated()}")
    cut, c = ["its last line is cut short: left out"] if reader.unreadable else [], source.calibration
    where = f"no floor at 0: taken {c.height:g} m below the headset, at {c.floor:.2f} m (--user-height)"
    told = {
        "axes": how.axes,
        "grip": GRIP[how.axes] if how.grip is None else how.grip,
        "notes": [*how.told, *([where] if source.guessed else []), *source.remarks(), *cut],
        "lost_s": {device: round(s - before[device], 3) for device, s in source.guard.lost().items()},
    }
    return np.stack([t.pos for t in ticks[:last]]), np.stack([t.quat for t in ticks[:last]]), told


@dataclass
class Pace:
    """Real time: every tick has its moment; a step that ends after the next one's has missed its deadline.

    Rule      more than 0.5 s late: the moments start anew
    Test      tests/headset/test_stream.py::test_realtime
    """

    dt: float
    due: float | None = None
    missed: int = 0
    restarts: int = 0
    clock: object = field(default=time.perf_counter)
    sleep: object = field(default=time.sleep)

    def wait(self):
        """Sleep until this tick's moment."""
        now = self.clock()
        if self.due is None or now - self.due > 0.5:
            self.restarts += self.due is not None
            self.due = now
        self.sleep(max(0.0, self.due - now))

    def done(self):
        """The step is done."""
        self.due += self.dt
        self.missed += self.clock() > self.due

    def report(self) -> list[str]:
        """Deadlines missed."""
        late = f", {self.restarts} times more than 0.5 s late" if self.restarts else ""
        return [f"real time: {self.missed} deadlines missed{late}"]


def drive(stream: Stream, samples, player: Player, seconds=None, pace: Pace | None = None, see=None):
    """Play until the samples end, or for so many seconds.

    Args      samples : Sample, or the seconds (float) without one, as from `arriving`
              see : function of (player, tick) called after every step; False ends the play
    Test      tests/headset/test_stream.py::test_round_trip, test_stdin
    """
    last = np.inf if seconds is None else round(seconds / player.dt)
    for sample in samples:
        for tick in stream.idle(sample) if isinstance(sample, float) else stream.push(sample):
            if pace:
                pace.wait()
            player.step(tick.pos[None], tick.quat[None])
            if pace:
                pace.done()
            stop = see(player, tick) is False if see else False
            if stop or player.ticks[0] >= last:
                return

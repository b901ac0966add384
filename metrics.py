r"""Metrics: one definition each, for every table  [Reda23 §4; it prints none].

    python metrics.py --character jesse --motion FOLDER [--split style] [--json OUT]     every metric
    python metrics.py --character jesse --motion FOLDER --push 400@2                     the largest push survived
    python metrics.py --compare A B … --motion FOLDER                                    policies beside one another

    Recording ──► measure ──► key -> number ──► table, comparison, as_json

Contact labels and the human's own figures are taken before any scaling, targets are what the policy is to reach: the
scaled root, the mapped devices, the kinematic pose.  A failure ends a recording, and `completed` and `survival` say how
much of the motion the other numbers are about.
"""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass, replace

import mujoco
import numpy as np

import mocap.data
from character import Character, OwnShapes, Switches, driven_groups
from env import EPISODE_STEPS, SENSORS, Env, headset_only
from headset.player import AWAY, ride, stream_of, tally
from headset.reader import controllers_hang
from human import CONTACT_SPEED, angular_velocity, heading, quat_angle, quat_conj, quat_mul, quat_rotate, travelled
from human import footfalls as footfalls_apart
from mocap import yardsticks
from mocap.augment import resize
from mocap.data import MotionFlags
from mocap.rigs import Reading
from plumbing.cli import NONNEGATIVE, THREADS, UserError, arg, cell, cli, markdown, run_main
from plumbing.files import atomic_write, check_folders
from plumbing.runs import fmt_count
from policy import check_fits, devices_of, find_policy, load_character, load_policy, sensors_of, total_steps
from retarget import Reference, as_human, forward_kinematics, human_of, reference, shared_segments, sole_motion

ROWS = ("streamed", "tracked", "kinematic", "zero", "pd")
HALVES = {"both": slice(None), "select": slice(0, None, 2), "report": slice(1, None, 2)}


@dataclass
class Recording:
    """What a character did on one sequence.

    frames : (T,) reference frames, the start included; qpos (T, nq); contact (T, 2) bool, not used at the start;
    action (T, u), of the step that led to the frame (zero at the start); failed : bool; available : steps the
    sequence had to offer
    """

    frames: np.ndarray
    qpos: np.ndarray
    contact: np.ndarray
    action: np.ndarray
    failed: bool
    available: int


# ------------------------------------------------------------------------------------ one function each


def jitter(x, rate):
    r"""Mean over joints and frames of ‖x_{t+3} − 3x_{t+2} + 3x_{t+1} − x_t‖ / dt³.  x (T, J, 3) -> sum, count.

    Test      tests/test_metrics.py::test_metrics_on_known_motion
    """
    d = np.linalg.norm(np.diff(x, n=3, axis=0), axis=-1) * rate**3
    return d.sum(), d.size


def footfalls(contact):
    """How often a foot begins to touch, each beginning counted: REPRODUCE.md's metrics.  contact (T, 2) bool -> int

    Test      tests/test_metrics.py::test_steps_contacts_and_torques"""
    return footfalls_apart(contact, 1.0, apart=0.0)


def local_rotations(quat, parents):
    """Rotation of each body in its parent.  quat (T, b, 4), parents (b,) -> (T, b, 4)

    Test      tests/test_metrics.py::test_metrics_against_slow_loop"""
    return quat_mul(quat_conj(quat[:, parents]), quat)


def head_rates(quat, rate):
    """Roll and yaw velocity of the head about its own axes.  (T, 4) -> (T, 2) [rad/s]

    Test      tests/test_metrics.py::test_metrics_on_known_motion"""
    return quat_rotate(quat_conj(quat), angular_velocity(quat, rate))[:, [0, 2]]


def sip_bodies(char: Character):
    """Upper arms and thighs, from the TOML's [metrics] table; without that table none, and `sip_deg` is NaN.

    Test      tests/test_metrics.py::test_sip_bodies"""
    if "metrics" not in char.spec:
        return np.array([], int)
    m, names = char.model, char.spec["metrics"].get("sip", [])
    found = [mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, str(n)) for n in names]
    if not found or min(found) < 0:
        valid = ", ".join(m.body(b).name for b in range(1, m.nbody))
        raise UserError(f"{char.path}: [metrics] sip = {names} must name upper arms and thighs; bodies: {valid}")
    return np.array(found)


EVERY = 5  # frames between two at which the character's own shapes are compared: they cost as much as all the rest


def own_slide(soles, contact, rate):
    r"""Horizontal speed of the sole while the character's own foot presses on the floor: skating.

    Equation  ‖p_t − p_{t−1}‖ rate of the material point that is lowest at t, where the foot presses at both steps
    Args      soles (T, 2, p, 3) [m]; contact (T, 2) bool, of the character
    Returns   (k,) [m/s], of the k pairs of a foot and a step
    Test      tests/test_metrics.py::test_own_slide
    """
    low = np.argmin(soles[1:, ..., 2], axis=2)[..., None, None]
    now, before = (np.take_along_axis(s[..., :2], low, axis=2)[:, :, 0] for s in (soles[1:], soles[:-1]))
    return np.linalg.norm(now - before, axis=-1)[contact[1:] & contact[:-1]] * rate


def spring_torque(char: Character, qpos):
    r"""Torque of the passive springs on the driven hinges: τ = −k (q − q_spring).  qpos (T, nq) -> (T, u) [N m]

    Test      tests/test_metrics.py::test_spring_share"""
    h, m = char.driven, char.model
    return -m.jnt_stiffness[1 + h] * (qpos[:, 7 + h] - m.qpos_spring[7 + h])


class _Pool:
    """Sums and counts by key, so that all frames of all recordings count equally."""

    def __init__(self):
        self.sums = {}

    def add(self, key, total, count):
        """A sum of `count` values."""
        self.sums[key] = np.add(self.sums.get(key, (0.0, 0)), (total, count))

    def values(self, key, values):
        """Values themselves."""
        self.add(key, float(np.sum(values)), np.size(values))

    def means(self) -> dict:
        """key -> mean, NaN where there was nothing."""
        return {k: float(total / count) if count else float("nan") for k, (total, count) in self.sums.items()}


def measure(char: Character, ref: Reference, recordings: list[Recording]) -> dict:
    """Every metric of REPRODUCE.md's metrics over recordings, pooled over their frames.

    Frames lived count equally, whichever clip they are in; `completed` and `survival` say how many were lived.
    Joints are the bodies of the joint map; for positions and jitter the hands too.  The human's own figures are taken
    before the scaling.  Contact and action are measured after steps: the start's contact is taken to be the first
    step's, or a character that is put on its feet would seem to land.  In the field's own units
    (`mocap.yardsticks`) the character is held against the human as the root's scale maps it, over the joints that both
    have; a sequence that failed is no success.
    Returns   key -> number; NaN where there was nothing to measure (no frame, no step, no metre travelled);
              "spring_share.GROUP" of every group of driven joints
    ASSUMED   a share of springs is RMS(springs) / (RMS(springs) + RMS(motors))
    Test      tests/test_metrics.py::test_metrics_against_slow_loop, test_metrics_of_kinematic,
              test_metrics_on_known_motion, test_nothing_to_measure, test_field_units_against_slow_loop
    """
    m, rate, pool = char.model, ref.rate, _Pool()
    bodies = np.array(sorted({f.body for f in char.chains}))
    joints = np.union1d(bodies, m.site_bodyid[char.sensor_sites])
    sip, apart, groups = sip_bodies(char), OwnShapes(char), driven_groups(char)
    segments, deepest, rows = shared_segments(char), [], []
    turning = {s for s, body in segments.items() if m.body_jntnum[body]}
    for rec in recordings:
        f, contact = rec.frames, np.concatenate([rec.contact[1:2], rec.contact[1:]])
        sim = forward_kinematics(char, rec.qpos)
        kin = sim if np.array_equal(rec.qpos, ref.qpos[f]) else forward_kinematics(char, ref.qpos[f])
        rows.append((not rec.failed, (len(f) - 1) / rec.available if rec.available else 1.0))
        both = as_human(char, sim), human_of(ref, f, segments)
        errors, successes, joints_60 = yardsticks.held_against(*both, tuple(segments), turning, rate)
        for key, values in errors.items():
            pool.values(key, values)
        for key, held in successes.items():
            pool.values(key, [held and not rec.failed])
        total, count = jitter(joints_60, yardsticks.RATE)
        pool.add("jitter_km_s3", total / 1000, count)
        pool.values("root_cm", 100 * np.linalg.norm(rec.qpos[:, :3] - ref.qpos[f, :3], axis=-1))
        sites = 100 * np.linalg.norm(sim.site_xpos - ref.sensor_pos[f], axis=-1)
        pool.values("head_cm", sites[:, 0])
        pool.values("hands_cm", sites[:, 1:])
        aligned = [k.xpos[:, joints] - k.xpos[:, char.root, None] for k in (sim, kin)]
        pool.values("joint_pos_cm", 100 * np.linalg.norm(aligned[0] - aligned[1], axis=-1))
        pool.values("head_deg", np.degrees(quat_angle(sim.xquat[:, char.head], ref.orientation[f, 1])))
        local = [local_rotations(k.xquat, m.body_parentid)[:, bodies] for k in (sim, kin)]
        pool.values("joint_rot_deg", np.degrees(quat_angle(*local)))
        pool.values("sip_deg", np.degrees(quat_angle(sim.xquat[:, sip], kin.xquat[:, sip])))
        _, speed = sole_motion(sim.soles, rate)
        pool.values("foot_slide_cm_s", 100 * speed[ref.contact[f]] if len(f) > 1 else [])
        pool.values("own_slide_cm_s", 100 * own_slide(sim.soles, contact, rate))
        pool.values("penetration_mm", -1000 * sim.lowest[sim.lowest < 0])
        deepest.append(1000 * apart.overlap(rec.qpos[::EVERY]))
        pool.values("contact_agreement", contact[1:] == ref.contact[f[1:]])
        pool.add("jitter_m_s3", *jitter(sim.xpos[:, joints], rate))
        human = ref.human_pos[f].astype(float) / ref.scale[f, None]
        pool.add("human_jitter_m_s3", *jitter(human, rate))
        pool.add("steps_per_m", footfalls(contact), travelled(rec.qpos))
        pool.add("human_steps_per_m", footfalls(ref.contact[f]), travelled(human[:, 0]))
        wobble = head_rates(sim.xquat[:, char.head], rate) - head_rates(ref.orientation[f, 1], rate)
        pool.values("head_wobble_deg_s", np.degrees(wobble) ** 2 if len(f) > 2 else [])
        pool.values("torque_rms", rec.action[1:] ** 2)
        pool.values("saturation", np.abs(rec.action[1:]) > 0.99)
        spring, motor = spring_torque(char, rec.qpos[1:]) ** 2, (rec.action[1:] * char.limits) ** 2
        for name, of in {"all": np.arange(len(char.limits)), **groups}.items():
            pool.values(f"spring {name}", spring[:, of])
            pool.values(f"motor {name}", motor[:, of])
    out = {
        "clips": len(recordings),
        "completed": float(np.mean([r[0] for r in rows])),
        "survival": float(np.mean([r[1] for r in rows])),
    }
    means = pool.means()
    out |= {k: v for k, v in means.items() if " " not in k}
    out["penetration_mm"] = float(np.nan_to_num(out["penetration_mm"]))  # 0: never below the floor
    for key in ("head_wobble_deg_s", "torque_rms"):
        out[key] = float(np.sqrt(out[key]))
    deepest = np.concatenate(deepest)
    out["self_penetration_mm"] = float(np.percentile(deepest, 95)) if len(deepest) else float("nan")
    out["self_penetration_share"] = float(np.mean(deepest > 10)) if len(deepest) else float("nan")
    for name in ("all", *groups):
        spring, motor = np.sqrt(means[f"spring {name}"]), np.sqrt(means[f"motor {name}"])
        share = float(spring / (spring + motor)) if spring + motor > 0 else float("nan")
        out["spring_share" if name == "all" else f"spring_share.{name}"] = share
    return out


# ------------------------------------------------------------------------------------ tables

COLUMNS = (  # key, heading, format
    ("completed", "completed", "{:.2f}"),
    ("within_1m", "within 1 m", "{:.2f}"),
    ("survival", "survival", "{:.2f}"),
    ("fails_every_s", "fails every s", "{:.2f}"),
    ("first_failure_s", "first fails s", "{:.2f}"),
    ("root_cm", "root cm", "{:.1f}"),
    ("head_cm", "head cm", "{:.1f}"),
    ("hands_cm", "hands cm", "{:.1f}"),
    ("joint_pos_cm", "joints cm", "{:.1f}"),
    ("head_deg", "head °", "{:.1f}"),
    ("joint_rot_deg", "joints °", "{:.1f}"),
    ("sip_deg", "SIP °", "{:.1f}"),
    ("foot_slide_cm_s", "slide cm/s", "{:.1f}"),
    ("own_slide_cm_s", "own slide cm/s", "{:.1f}"),
    ("penetration_mm", "below mm", "{:.1f}"),
    ("contact_agreement", "contact", "{:.2f}"),
    ("jitter_m_s3", "jitter m/s³", "{:.0f}"),
    ("steps_per_m", "steps/m", "{:.2f}"),
    ("head_wobble_deg_s", "wobble °/s", "{:.0f}"),
    ("torque_rms", "torque rms", "{:.2f}"),
    ("saturation", "saturation", "{:.3f}"),
    ("self_penetration_mm", "through itself mm", "{:.1f}"),
    ("spring_share", "springs", "{:.2f}"),
)
FIELD = (  # the same of what published tables print, at 60 Hz
    ("mpjpe_cm", "MPJPE cm", "{:.1f}"),
    ("mpjve_cm_s", "MPJVE cm/s", "{:.1f}"),
    ("root_pe", "root PE cm", "{:.1f}"),
    ("hand_pe", "hand PE cm", "{:.1f}"),
    ("upper_pe", "upper PE cm", "{:.1f}"),
    ("lower_pe", "lower PE cm", "{:.1f}"),
    ("mpjre_deg", "MPJRE °", "{:.2f}"),
    ("jitter_km_s3", "jitter km/s³", "{:.3f}"),
    ("success_phc", "success (PHC)", "{:.2f}"),
    ("success_height", "success (heights)", "{:.2f}"),
)


def table(results: dict, columns=COLUMNS) -> str:
    """The rows as Markdown; a dash where there is nothing to measure.

    The kinematic row completes by definition and has no torque: printed as a dash too.
    Test      tests/test_metrics.py::test_table
    """
    return markdown([["", *(h for _, h, _ in columns)], *([k, *cells(k, v, columns)] for k, v in results.items())])


def comparison(results: dict, columns=COLUMNS) -> str:
    """The same with a metric a row and a policy a column.  Test: tests/test_metrics.py::test_comparison"""
    turned = zip(*(cells(k, v, columns) for k, v in results.items()), strict=True)
    return markdown([["", *results], *([h, *c] for (_, h, _), c in zip(columns, turned, strict=True))])


def report(results: dict, layout=table) -> str:
    """What is printed: our table, the field's, and a line about the human.

    Args      layout : `table` or `comparison`
    Test      tests/test_metrics.py::test_table, test_comparison"""
    human = next((v for k, v in results.items() if k.startswith("kinematic")), [*results.values()][-1])  # every frame
    jitter, pace = cell(human["human_jitter_m_s3"], "{:.0f}"), cell(human["human_steps_per_m"], "{:.2f}")
    line = f"the human: jitter {jitter} m/s³, {pace} steps/m; {human['clips']} sequences"
    beside = [c for c in COLUMNS if c[0] in ("completed", "survival")]  # of whom the errors are
    return "\n\n".join([layout(results), layout(results, [*beside, *FIELD]), line])


def cells(name, row, columns=COLUMNS) -> list[str]:
    """A row's numbers as text, in the order of the columns."""
    kinematic = ("completed", "survival", "fails_every_s", "torque_rms", "saturation", "spring_share")
    dash = kinematic if name.startswith("kinematic") else ()
    return ["-" if k in dash else cell(row.get(k, np.nan), fmt) for k, _, fmt in columns]


def as_json(results: dict) -> str:
    """The same rows as JSON; null for NaN (nothing to measure) and infinity (never failed).

    Test      tests/test_metrics.py::test_json
    """
    clean = {name: {k: v if np.isfinite(v) else None for k, v in row.items()} for name, row in results.items()}
    return json.dumps(clean, indent=2, allow_nan=False) + "\n"


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
RECOVERY = 3.0  # s from the push's beginning that the character must live, to have survived it
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
        f"largest push survived: {PUSH_SECONDS} s at {push.at} s, lived {RECOVERY:.0f} s from then; up to "
        f"{push.newtons:.0f} N, by {found['resolution']:.1f} N; {n} of {found['tried']} sequences live without one"
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
        lived += alive & ~terminated
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


# ------------------------------------------------------------------------------------ as a user plays it


def streamed(char: Character, act, clips, devices=3, threads=0, sensors=None) -> dict:
    """The row `streamed` of REPRODUCE.md's metrics: driven by sensors alone, from the default pose, with a lead-in.

    The errors are of all frames; after a failure the character stands up under the headset and goes on.
    Args      act : observations (n, o) -> actions (n, u); clips : captures, each as long as it is or CAPTURE;
              sensors : as `shown_to`: with "hmd" the controllers of a policy of three devices hang
    Returns   as `measure`, seconds, failures, fails_every_s, first_failure_s (median), within_1m (its own headset's)
    Test      tests/test_metrics.py::test_streamed
    """
    hang = sensors == "hmd" and devices == 3
    streams = [stream_of(char, clip, devices, hang) for clip in clips]
    ref = reference(char, [s[2] for s in streams])
    pos, quat = (np.concatenate([s[k] for s in streams]) for k in (0, 1))
    scale = np.concatenate([np.tile(s[3], (len(s[2]), 1)) for s in streams])
    ref = replace(ref, sensor_pos=pos, sensor_quat=quat, sensor_scale=scale.astype(np.float32))
    rides = ride(char, act, [s[:2] for s in streams], devices, threads)
    pieces = []
    for start, r in zip(ref.first, rides, strict=True):
        for a, b in r.lives:
            parts = (v[a:b] for v in (r.qpos, r.contact, r.action))
            pieces.append(Recording(start + np.arange(a, b), *parts, r.failures > 0, b - a))
    row = measure(char, ref, pieces)
    whole = {k: row[k] * len(pieces) / len(clips) for k in ("success_phc", "success_height")}  # of captures, not lives
    within = [r.failures == 0 and r.farthest <= AWAY for r in rides]
    return row | whole | tally(rides) | {"clips": len(clips), "within_1m": float(np.mean(within))}


# ------------------------------------------------------------------------------------ which policy


def shown_to(meta, path, ref: Reference, sensors: str | None) -> Reference:
    """What a policy is shown of the user: the devices it was trained with; with `sensors` "hmd" controllers hang.

    Test      tests/test_play.py::test_headset_only"""
    if devices_of(meta, path, sensors) == 1:
        return headset_only(ref)
    return controllers_hang(ref) if sensors == "hmd" else ref


# ------------------------------------------------------------------------------------ measuring

MOST = 96  # captures of a streamed row, evenly chosen
TIMES = (lambda v: 0.3 <= v <= 2, "from 0.3 to 2 times the recorded person's height")


@dataclass
class Options(MotionFlags, Switches):
    """Which policy, on which motion."""

    character: str | None = arg(None, "name in characters/, or path of a .toml; the policy's own by default, or jesse")
    policy: str | None = arg(None, "run folder or policy .npz; characters/NAME.npz by default")
    compare: tuple[str, ...] = arg((), "several of them: a table, and with --png a figure", metavar="A B …")
    sensors: str | None = arg(
        None,
        "what the policy is shown of the user: by default what it was trained with; hmd [§4.2] for one that was "
        "trained with controllers: they hang beside the body, wherever the user's are",
        choices=SENSORS,
    )
    json: str | None = arg(None, "write the measured table here")
    all: bool = arg(False, "every sequence of the motion, not only its validation part")
    split: str = arg(
        "validation",
        "which part: train, validation (unseen clips), style (unseen style), body (unseen bodies)",
        choices=("train", "validation", "style", "body"),
    )
    half: str = arg(
        "both",
        "captures of the row streamed: select, every other one by name of those that --clips leaves, to choose "
        "policies on; report, the rest, to report; or both.  The other rows are of all",
        choices=tuple(HALVES),
    )
    rows: tuple[str, ...] = arg(ROWS, f"rows of the table, of {', '.join(ROWS)}", metavar="NAME,…")
    user_scale: float = arg(1.0, "play the motion by a user this many times as tall", check=TIMES)
    random_starts: int = arg(
        256, "characters started at random frames for the time to failure (0: leave it out)", check=NONNEGATIVE
    )
    push: str | None = arg(
        None,
        "N@T or N@T:DIRECTION: push the root with N newtons for 0.2 s at T s to its forward (default), left, back or "
        "right; with --measure: the largest push survived at T s, up to N, to all four",
    )
    seed: int = arg(0, "seed of stitching and random starts", check=NONNEGATIVE)
    threads: int = arg(0, "physics threads, 0 = all cores", check=THREADS)


def captures_of(opt: Options) -> list:
    """The captures for the streamed row.

    ASSUMED   at most MOST, evenly; a half is every other by name of what --clips leaves: other --clips, other halves
    Raises    UserError: a half without captures
    Test      tests/test_metrics.py::test_halves"""
    split, reading = "all" if opt.all else opt.split, Reading.of(opt)
    single = mocap.data.load(opt.motion, clips=opt.clips, split=split, reading=reading)
    half = sorted(single, key=lambda c: c.name)[HALVES[opt.half]]
    if single and not half and "streamed" in opt.rows:
        raise UserError(f"--half {opt.half}: none of the {len(single)} captures; valid: both, select")
    evenly = np.unique(np.linspace(0, len(half) - 1, min(len(half), MOST)).round().astype(int))
    return [resize(half[i], opt.user_scale) if opt.user_scale != 1.0 else half[i] for i in evenly]


def motion_of(opt: Options) -> tuple[list, list]:
    """`captures_of` for the streamed row, and the stitched sequences for all others.

    Raises    UserError: no such row; nothing but single frames, which are left out
    Test      tests/test_metrics.py::test_halves, test_user_scale, test_single_frames_are_left_out"""
    if wrong := set(opt.rows) - set(ROWS):
        raise UserError(f"--rows {','.join(sorted(wrong))}: unknown; valid: {', '.join(ROWS)}")
    single, split = captures_of(opt), "all" if opt.all else opt.split
    long = mocap.data.sequences(opt.motion, split, opt.clips, seed=opt.seed, reading=Reading.of(opt))
    if not (long := [c for c in long if len(c) > 1]):
        raise UserError(f"{opt.motion}: a single frame; valid: motion, of two frames or more")
    return single, [resize(c, opt.user_scale) for c in long] if opt.user_scale != 1.0 else long


def measure_all(char, ref, policy, opt: Options, seen: Reference | None = None, captures=(), devices=3) -> dict:
    """The rows that opt asks for.

    Args      captures : of the streamed row, left out without any; seen : what it is shown when tracked, if not ref
    Test      tests/test_play.py::test_measure_json"""
    rows = {}
    if captures and "streamed" in opt.rows:
        print(f"measuring streamed: {len(captures)} captures", file=sys.stderr, flush=True)
        rows["streamed"] = streamed(char, policy.mean_action, captures, devices, opt.threads, opt.sensors)
    actions = {"tracked": policy_action(policy), "kinematic": None, "zero": zero_action, "pd": pd_action}
    for name, act in actions.items():
        if name in opt.rows:
            rows[name] = measure_one(name, char, ref, act, opt, seen if name == "tracked" else None)
    return rows


def measure_one(name, char, ref, act, opt: Options, seen: Reference | None = None) -> dict:
    """One row: of what `act` does, which is shown `seen`; of the kinematic pose without it.  The targets are ref's.

    Test      tests/test_play.py::test_measure_json, test_headset_only"""
    print(f"measuring {name}: {len(ref.names)} sequences", file=sys.stderr, flush=True)
    seen = seen or ref
    given = ref if seen.sensor_pos.shape[1] < 3 else replace(ref, sensor_pos=seen.sensor_pos)  # hands that hang, too
    row = measure(char, given, simulate(char, seen, act, threads=opt.threads) if act else kinematic(char, ref))
    if act and opt.random_starts:
        row["fails_every_s"] = time_to_failure(char, seen, act, opt.random_starts, seed=opt.seed, threads=opt.threads)
    return row


def run(opt: Options) -> None:
    """Measure one policy, or find the largest push it survives; print the table, and write it.

    Test      tests/test_play.py::test_measure_json, test_largest_push"""
    push = parse_push(opt.push)
    policy, path, meta = find_policy(opt)
    check_folders(opt.json, read=(*mocap.data.parts(opt.motion), path))
    char, devices = load_character(opt, meta, path), devices_of(meta, path, opt.sensors)
    captures, long = motion_of(opt)
    ref = reference(char, long)
    seen = shown_to(meta, path, ref, opt.sensors)
    check_fits(policy, Env(char, seen, 1), path)
    if push:
        found = largest_push(char, seen, policy_action(policy), push.at, push.newtons, threads=opt.threads)
        printed = push_report(found, push)
        lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in found.items()}
        text = json.dumps(lists, indent=2) + "\n"
    else:
        results = measure_all(char, ref, policy, opt, seen, captures, devices)
        printed, text = report(results), as_json(results)
    if opt.json:  # first: whoever reads what is printed may not read to its end
        atomic_write(opt.json, text)
    print(printed)


# ------------------------------------------------------------------------------------ comparing


@dataclass
class Arm:
    """One of the policies that are compared.  ref : its targets; seen : what it is shown of the user"""

    path: str
    policy: object
    meta: dict
    char: Character
    ref: Reference
    seen: Reference
    devices: int

    def title(self) -> str:
        """What it is, in a line.  Test: tests/test_play.py::test_compare"""
        options, parts = self.meta.get("options", {}), [name_of(self.char)]
        parts += [f"{fmt_count(steps)} steps"] if (steps := total_steps(self.meta)) else []
        parts += [f"without {' '.join(map(str, options['without']))}"] if options.get("without") else []
        parts += [f"trained with {'; '.join(reward)}"] if (reward := self.meta.get("reward")) else []
        parts += [f"carried over from {of}, not trained since"] if (of := self.meta.get("carried")) else []
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
        ref = reference(char, clips)
        seen, devices = shown_to(meta, path, ref, opt.sensors), devices_of(meta, path, opt.sensors)
        arms.append(Arm(path, policy, meta, char, ref, seen, devices))
        check_fits(policy, Env(char, arms[-1].seen, 1), path)
    return arms


def compare(arms: list[Arm], opt: Options, captures=()) -> dict:
    """A row for every policy, on the same sequences, and one for every character's kinematic pose.

    Test      tests/test_play.py::test_compare"""
    out = {}
    for a in arms:
        if "streamed" in opt.rows and captures:
            row = streamed(a.char, a.policy.mean_action, captures, a.devices, opt.threads, opt.sensors)
            out[f"{a.path} streamed"] = row
        if "tracked" in opt.rows:
            out[f"{a.path} tracked"] = measure_one(a.path, a.char, a.ref, policy_action(a.policy), opt, a.seen)
    several = {name_of(a.char): a for a in arms}
    for name, a in several.items():
        label = f"kinematic {name}" if len(several) > 1 else "kinematic"
        out[label] = measure_one(label, a.char, a.ref, None, opt)
    return out


def check_comparison(opt: Options, *others) -> None:
    """UserError: not several policies, or flags that would do nothing.  Test: tests/test_play.py::test_compare"""
    if len(opt.compare) < 2 or len(set(opt.compare)) < len(opt.compare):
        raise UserError(f"--compare {' '.join(opt.compare)}: valid: two policies or more, none twice")
    plain, others = type(opt)(), ("policy", "character", "tail", "scale", "set", "push", *others)
    if wrong := [f"--{k}" for k in others if getattr(opt, k) != getattr(plain, k)]:
        raise UserError(f"--compare takes policies with their own characters: leave out {', '.join(wrong)}")
    if opt.rows != plain.rows and (wrong := [r for r in opt.rows if r in ("zero", "pd")]):
        raise UserError(f"--compare --rows {','.join(wrong)}: is of no policy; valid: streamed, tracked, kinematic")


def run_comparison(opt: Options) -> tuple[list[Arm], list]:
    """Print and write the table of several policies.  -> the policies, the sequences

    Test      tests/test_play.py::test_compare"""
    check_comparison(opt)
    check_folders(opt.json, read=(*mocap.data.parts(opt.motion), *opt.compare))
    for path in opt.compare:
        load_policy(path)  # a wrong name is said before motion is read, which takes long
    captures, long = motion_of(opt)
    arms = arms_of(long, opt)
    print(*(a.title() for a in arms), sep="\n")
    results = compare(arms, opt, captures)
    if opt.json:
        atomic_write(opt.json, as_json(results))
    print(report(results, comparison))
    return arms, long


def listed(argv, flag) -> list[str]:
    """`--compare A B` as one value, A,B.  Test: tests/test_play.py::test_compare"""
    argv = list(argv or [])
    if flag in argv:
        i = argv.index(flag) + 1
        n = next((k for k, a in enumerate(argv[i:]) if a.startswith("--")), len(argv) - i)
        argv[i : i + n] = [",".join(argv[i : i + n])] * (n > 0)
    return argv


def main(argv=None):
    """python metrics.py: measure, compare or push.  Test: tests/test_metrics.py::test_command"""
    opt = cli(Options, listed(argv, "--compare"), "metrics.py", __doc__)
    if opt.compare:
        run_comparison(opt)
    else:
        run(opt)


if __name__ == "__main__":
    run_main(main)

r"""Metrics: one definition each, for every table  [Reda23 §4; it prints none].

    Recording ──► measure ──► key -> number ──► table, comparison, as_json

Contact labels and the human's own figures are taken before any scaling, targets are what the policy is to reach: the
scaled root, the mapped devices, the kinematic pose.  A failure ends a recording, and `completed` and `survival` say how
much of the motion the other numbers are about.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import mujoco
import numpy as np

import human
from character import Character
from human import angular_velocity, quat_angle, quat_conj, quat_mul, quat_rotate
from plumbing.cli import UserError
from retarget import Reference, forward_kinematics, sole_motion


@dataclass
class Recording:
    """What a character did on one sequence.

    frames : (T,) reference frames, the start included; qpos (T, nq); contact (T, 2) bool, the human's at the start;
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
    """How often a foot begins to touch, each beginning counted: spec/metrics.  contact (T, 2) bool -> int

    Test      tests/test_metrics.py::test_steps_contacts_and_torques"""
    return human.footfalls(contact, 1.0, apart=0.0)


def travelled(root):
    """Length of the root's path on the floor [m].  (T, 3) -> float

    Test      tests/test_metrics.py::test_metrics_on_known_motion"""
    return float(np.linalg.norm(np.diff(root[:, :2], axis=0), axis=-1).sum())


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


def measure(char: Character, ref: Reference, recordings: list[Recording]) -> dict:
    """Every metric of spec/metrics over recordings, pooled over their frames.

    Frames lived count equally, whichever clip they are in; `completed` and `survival` say how many were lived.
    Joints are the bodies of the joint map; for positions and jitter the hands too.  The human's own figures are taken
    before the scaling.  Contact and action are measured after steps, so not at the start.
    Returns   key -> number; NaN where there was nothing to measure (no frame, no step, no metre travelled)
    Test      tests/test_metrics.py::test_metrics_against_slow_loop, test_metrics_of_kinematic,
              test_metrics_on_known_motion, test_nothing_to_measure
    """
    m, rate = char.model, ref.rate
    bodies = np.array(sorted({b for b, *_ in char.chains}))
    joints = np.union1d(bodies, m.site_bodyid[char.sensor_sites])
    parents = m.body_parentid
    sip = sip_bodies(char)
    rows, sums = [], {}
    add = lambda key, total, count: sums.__setitem__(key, np.add(sums.get(key, (0.0, 0)), (total, count)))  # noqa: E731
    mean_over = lambda key, values: add(key, float(np.sum(values)), np.size(values))  # noqa: E731
    for rec in recordings:
        f = rec.frames
        sim, kin = forward_kinematics(char, rec.qpos), forward_kinematics(char, ref.qpos[f])
        rows.append((not rec.failed, (len(f) - 1) / rec.available if rec.available else 1.0))
        mean_over("root_cm", 100 * np.linalg.norm(rec.qpos[:, :3] - ref.qpos[f, :3], axis=-1))
        sites = 100 * np.linalg.norm(sim.site_xpos - ref.sensor_pos[f], axis=-1)
        mean_over("head_cm", sites[:, 0])
        mean_over("hands_cm", sites[:, 1:])
        aligned = lambda k: k.xpos[:, joints] - k.xpos[:, char.root, None]  # noqa: E731
        mean_over("joint_pos_cm", 100 * np.linalg.norm(aligned(sim) - aligned(kin), axis=-1))
        mean_over("head_deg", np.degrees(quat_angle(sim.xquat[:, char.head], ref.orientation[f, 1])))
        local = [local_rotations(k.xquat, parents)[:, bodies] for k in (sim, kin)]
        mean_over("joint_rot_deg", np.degrees(quat_angle(*local)))
        mean_over("sip_deg", np.degrees(quat_angle(sim.xquat[:, sip], kin.xquat[:, sip])))
        _, speed = sole_motion(sim.soles, rate)
        mean_over("foot_slide_cm_s", 100 * speed[ref.contact[f]] if len(f) > 1 else [])
        mean_over("penetration_mm", -1000 * sim.lowest[sim.lowest < 0])
        mean_over("contact_agreement", rec.contact[1:] == ref.contact[f[1:]])
        add("jitter_m_s3", *jitter(sim.xpos[:, joints], rate))
        human = ref.human_pos[f].astype(float) / ref.scale[f, None]
        add("human_jitter_m_s3", *jitter(human, rate))
        add("steps_per_m", footfalls(rec.contact), travelled(rec.qpos))
        add("human_steps_per_m", footfalls(ref.contact[f]), travelled(human[:, 0]))
        wobble = head_rates(sim.xquat[:, char.head], rate) - head_rates(ref.orientation[f, 1], rate)
        mean_over("head_wobble_deg_s", np.degrees(wobble) ** 2 if len(f) > 2 else [])
        mean_over("torque_rms", rec.action[1:] ** 2)
        mean_over("saturation", np.abs(rec.action[1:]) > 0.99)
    out = {
        "clips": len(recordings),
        "completed": float(np.mean([r[0] for r in rows])),
        "survival": float(np.mean([r[1] for r in rows])),
    }
    out |= {k: float(total / count) if count else float("nan") for k, (total, count) in sums.items()}
    out["penetration_mm"] = float(np.nan_to_num(out["penetration_mm"]))  # 0: never below the floor
    for key in ("head_wobble_deg_s", "torque_rms"):
        out[key] = float(np.sqrt(out[key]))
    return out


# ------------------------------------------------------------------------------------ tables

COLUMNS = (  # key, heading, format
    ("completed", "completed", "{:.2f}"),
    ("survival", "survival", "{:.2f}"),
    ("fails_every_s", "fails every s", "{:.2f}"),
    ("root_cm", "root cm", "{:.1f}"),
    ("head_cm", "head cm", "{:.1f}"),
    ("hands_cm", "hands cm", "{:.1f}"),
    ("joint_pos_cm", "joints cm", "{:.1f}"),
    ("head_deg", "head °", "{:.1f}"),
    ("joint_rot_deg", "joints °", "{:.1f}"),
    ("sip_deg", "SIP °", "{:.1f}"),
    ("foot_slide_cm_s", "slide cm/s", "{:.1f}"),
    ("penetration_mm", "below mm", "{:.1f}"),
    ("contact_agreement", "contact", "{:.2f}"),
    ("jitter_m_s3", "jitter m/s³", "{:.0f}"),
    ("steps_per_m", "steps/m", "{:.2f}"),
    ("head_wobble_deg_s", "wobble °/s", "{:.0f}"),
    ("torque_rms", "torque rms", "{:.2f}"),
    ("saturation", "saturation", "{:.3f}"),
)


def table(results: dict) -> str:
    """The rows as Markdown; a dash where there is nothing to measure.

    The kinematic row completes by definition and has no torque: printed as a dash too.
    Test      tests/test_metrics.py::test_table
    """
    return _markdown([["", *(h for _, h, _ in COLUMNS)], *([k, *cells(k, v)] for k, v in results.items())], results)


def comparison(results: dict) -> str:
    """The same with a metric a row and a policy a column.  Test: tests/test_metrics.py::test_comparison"""
    columns = zip(*(cells(k, v) for k, v in results.items()), strict=True)
    return _markdown([["", *results], *([h, *c] for (_, h, _), c in zip(COLUMNS, columns, strict=True))], results)


def _markdown(rows, results) -> str:
    """Rows of text, the first the heading, and a line about the human."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---" * len(rows[0]) + "|")
    human = next((v for k, v in results.items() if k.startswith("kinematic")), [*results.values()][-1])  # every frame
    jitter, pace = cell(human["human_jitter_m_s3"], "{:.0f}"), cell(human["human_steps_per_m"], "{:.2f}")
    return "\n".join([*lines, f"\nthe human: jitter {jitter} m/s³, {pace} steps/m; {human['clips']} sequences"])


def cells(name, row) -> list[str]:
    """A row's numbers as text, in the order of COLUMNS."""
    kinematic = ("completed", "survival", "fails_every_s", "torque_rms", "saturation")
    dash = kinematic if name.startswith("kinematic") else ()
    return ["-" if k in dash else cell(row.get(k, np.nan), fmt) for k, _, fmt in COLUMNS]


def cell(value, fmt):
    """A number as text: a dash for NaN, `never` for infinity."""
    return "-" if np.isnan(value) else "never" if value == np.inf else fmt.format(value)


def as_json(results: dict) -> str:
    """The same rows as JSON; null for NaN (nothing to measure) and infinity (never failed).

    Test      tests/test_metrics.py::test_json
    """
    clean = {name: {k: v if np.isfinite(v) else None for k, v in row.items()} for name, row in results.items()}
    return json.dumps(clean, indent=2, allow_nan=False) + "\n"

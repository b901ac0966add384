r"""Two motions of the canonical human held against each other, in the units that published tables use.

    predicted, true ──► at_rate ──► head_moved ──► mpjpe, mpjve, part errors     cm, cm/s  [AGRoL]
                            │                      mpjre                         degrees   [AGRoL]
                            └────────────────────► success_phc, success_height             [PHC], [SONIC]

Positions are of joints, (T, s, 3) [m], rotations of segments, (T, s, 4), both in the world; `segments` says which of
`human.SEGMENTS` the s are.  Errors come frame by frame: a metric is their mean over all frames of all sequences.

[AGRoL]  Du et al., Avatars Grow Legs, CVPR 2023, its published code
[PHC]    Luo et al., Perpetual Humanoid Control, ICCV 2023; as UHC, Luo et al., NeurIPS 2021
[SONIC]  Luo et al., SONIC: Supersizing Motion Tracking for Natural Humanoid Whole-Body Control, arXiv 2511.07820
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from human import PARENTS, SEG, SEGMENTS, quat_angle, quat_conj, quat_mul, quat_slerp

RATE = 60.0  # Hz, of AMASS as those tables use it
FAR = 0.5  # m, mean over the body  [PHC]
LOW, TURNED = 0.25, 1.0  # m, rad  [SONIC]
PARTS = {  # AGRoL's parts of the body: the pelvis belongs to the legs
    "root_pe": ("pelvis",),
    "hand_pe": ("hand_l", "hand_r"),
    "upper_pe": tuple(s for s in SEGMENTS if s[:-2] in ("upper_arm", "forearm", "hand") or s in ("chest", "head")),
    "lower_pe": tuple(s for s in SEGMENTS if s[:-2] in ("thigh", "shin", "foot") or s == "pelvis"),
}
HEIGHTS = ("pelvis", "foot_l", "foot_r", "hand_l", "hand_r")  # root, ankles, wrists


def columns_of(segments, names) -> list[int]:
    """Where the named segments stand among `segments`; those that are not there are left out."""
    wanted = [SEG[n] for n in names]
    return [k for k, s in enumerate(segments) if s in wanted]


def at_rate(pos, quat, rate, to=RATE):
    r"""The motion at another rate: positions by a cubic spline, rotations by slerp.

    ASSUMED   the spline.  Linear interpolation has a kink at every frame, which third differences see: four times the
              jitter of a walk
    Args      pos (T, s, 3), quat (T, s, 4) at `rate` [Hz]
    Returns   the same at `to` [Hz], from the first frame to the last
    Test      tests/mocap/test_yardsticks.py::test_at_rate
    """
    if len(pos) < 2:
        return pos, quat
    frames = np.arange(int((len(pos) - 1) * to / rate + 1e-9) + 1) * rate / to
    i = np.minimum(frames.astype(int), len(pos) - 2)
    between = np.broadcast_to((frames - i)[:, None], (len(i), quat.shape[1]))
    return CubicSpline(np.arange(len(pos)), pos)(frames), quat_slerp(quat[i], quat[i + 1], between)


def head_moved(pos, true, segments):
    """The predicted body put where its head is the true one: what a headset knows is not an error.

    Source    [AGRoL]
    Returns   (T, s, 3) [m], world; as it is without a head
    Test      tests/mocap/test_yardsticks.py::test_positions
    """
    head = columns_of(segments, ("head",))
    return pos + (true[:, head] - pos[:, head]) if head else pos


def mpjpe(pos, true):
    r"""Mean per joint position error.

    Equation  ‖p_j − p*_j‖
    Source    [AGRoL], after `head_moved`
    Args      pos, true (T, s, 3) [m], world
    Returns   (T, s) [cm]
    Test      tests/mocap/test_yardsticks.py::test_positions
    """
    return 100.0 * np.linalg.norm(pos - true, axis=-1)


def part_error(pos, true, segments, part):
    r"""`mpjpe` of a part of the body: root_pe, hand_pe, upper_pe, lower_pe.

    Equation  ‖p_j − p*_j‖ over the joints j of PARTS
    Source    [AGRoL], after `head_moved`
    Args      pos, true (T, s, 3) [m], world; part : a key of PARTS
    Returns   (T, k) [cm], of the k joints of that part that are there
    Test      tests/mocap/test_yardsticks.py::test_positions
    """
    return mpjpe(pos, true)[:, columns_of(segments, PARTS[part])]


def mpjve(pos, true, rate=RATE):
    r"""Mean per joint velocity error.

    Equation  ‖(p_{t+1} − p_t) − (p*_{t+1} − p*_t)‖ rate
    Source    [AGRoL], after `head_moved`
    Args      pos, true (T, s, 3) [m], world; rate [Hz]
    Returns   (T − 1, s) [cm/s]
    Test      tests/mocap/test_yardsticks.py::test_velocities
    """
    return 100.0 * np.linalg.norm(np.diff(pos - true, axis=0), axis=-1) * rate


def local_turns(quat, segments):
    """Axis-angle vectors of segments in the nearest segment above that is there; without the root's.

    Args      quat (T, s, 4), world
    Returns   (T, k, 3) [rad]
    """
    out = []
    for k, segment in enumerate(segments):
        above = PARENTS[segment]
        while above >= 0 and above not in segments:
            above = PARENTS[above]
        if above >= 0:
            out.append(quat_mul(quat_conj(quat[:, list(segments).index(above)]), quat[:, k]))
    if not out:
        return np.zeros((len(quat), 0, 3))
    local = np.stack(out, axis=1)
    return Rotation.from_quat(local.reshape(-1, 4), scalar_first=True).as_rotvec().reshape(*local.shape[:2], 3)


def mpjre(quat, true, segments):
    r"""Mean per joint rotation error, as AGRoL counts it: no angle between rotations.

    Equation  |φ_i − φ*_i|, φ the axis-angle vector of a segment in its parent, i = x, y, z; of differences beyond π
              the rest of a turn
    Source    [AGRoL]; the root is left out
    Args      quat, true (T, s, 4), world
    Returns   (T, k, 3) [degrees]
    Test      tests/mocap/test_yardsticks.py::test_rotations
    """
    apart = np.abs(local_turns(quat, segments) - local_turns(true, segments))
    return np.degrees(np.where(apart > np.pi, np.abs(2 * np.pi - apart), apart))


def success_phc(pos, true) -> bool:
    r"""Is the body, on the mean, never farther off than half a metre?

    Equation  max_t mean_j ‖p_j − p*_j‖ ≤ 0.5 m
    Source    [PHC], UHC
    Args      pos, true (T, s, 3) [m], world, the head not moved
    Test      tests/mocap/test_yardsticks.py::test_successes
    """
    return bool(np.linalg.norm(pos - true, axis=-1).mean(axis=-1).max() <= FAR)


def success_height(pos, quat, true, true_quat, segments) -> bool:
    r"""Are root, ankles and wrists never too high or too low, and does the root never face elsewhere?

    Equation  max_t |z_j − z*_j| ≤ 0.25 m for j of HEIGHTS, and max_t angle(q_root, q*_root) ≤ 1 rad
    Source    [SONIC], what ends an episode there
    Args      pos, true (T, s, 3) [m], quat, true_quat (T, s, 4), world
    Test      tests/mocap/test_yardsticks.py::test_successes
    """
    held, root = columns_of(segments, HEIGHTS), columns_of(segments, ("pelvis",))
    low = np.abs(pos[:, held, 2] - true[:, held, 2]).max(initial=0.0)
    turned = quat_angle(quat[:, root], true_quat[:, root]).max(initial=0.0)
    return bool(low <= LOW and turned <= TURNED)


def held_against(predicted, true, segments, turning, rate) -> tuple[dict, dict, np.ndarray]:
    """All of them, of one sequence.

    Args      predicted, true : (pos, quat) at `rate` [Hz]; turning : the segments among them that have a joint of their
              own, for `mpjre`
    Returns   key -> errors, of every frame; key -> success; the predicted joints at RATE, for their jitter
    Test      tests/test_metrics.py::test_field_units_against_slow_loop
    """
    (pos, quat), (true_pos, true_quat) = (at_rate(*motion, rate) for motion in (predicted, true))
    moved, own = head_moved(pos, true_pos, segments), [k for k, s in enumerate(segments) if s in turning]
    errors = {"mpjpe_cm": mpjpe(moved, true_pos), "mpjve_cm_s": mpjve(moved, true_pos)}
    errors |= {part: part_error(moved, true_pos, segments, part) for part in PARTS}
    errors["mpjre_deg"] = mpjre(quat[:, own], true_quat[:, own], [segments[k] for k in own])
    successes = {
        "success_phc": success_phc(pos, true_pos),
        "success_height": success_height(pos, quat, true_pos, true_quat, segments),
    }
    return errors, successes, pos

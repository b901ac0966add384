r"""DROP's character: 22 point masses, their bones, rotations and range of motion  [DROP §4, §7].

The mapping from the canonical human, forward kinematics, rotations by swing and twist, and the projection of Eq. 7.
drop/simulator.py simulates it and says what the conventions are.
"""

from __future__ import annotations

import numpy as np

from human import SEG, quat_conj, quat_matrix, quat_mul, quat_rotate, quat_slerp
from mocap import gait

# ------------------------------------------------------------------------------------ §4: the character

JOINTS = (
    "pelvis", "hip_l", "hip_r", "spine1", "knee_l", "knee_r", "spine2", "ankle_l", "ankle_r", "spine3", "foot_l",
    "foot_r", "neck", "collar_l", "collar_r", "head", "shoulder_l", "shoulder_r", "elbow_l", "elbow_r", "wrist_l",
    "wrist_r",
)  # fmt: skip
PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19])
J = {name: i for i, name in enumerate(JOINTS)}
N = len(JOINTS)
STEP = 1.0 / 30.0  # h [s], §4
GRAVITY = np.array([0.0, 0.0, -9.81])

# Radii of the contact spheres [m].  ASSUMED ("manually-scaled spheres", §7): ankles and balls of the feet just touch
# the floor in the standing pose of a 1.75 m person, the others fill limbs and trunk.
RADII = np.array([
    0.10, 0.08, 0.08, 0.09, 0.055, 0.055, 0.10, 0.068, 0.068, 0.10, 0.0245, 0.0245, 0.06, 0.06, 0.06, 0.11, 0.06,
    0.06, 0.045, 0.045, 0.05, 0.05,
])  # fmt: skip


def rest_offsets(height=1.75):
    r"""Each joint relative to its parent in the standing pose, arms hanging.

    ASSUMED   SMPL's mean body is not to be had here: the canonical human's proportions (`mocap.gait.Body`).
              Joints it lacks: pelvis 0.035 H above the hips, spine1 halfway to the chest's base (spine2), spine3
              0.07 H above it, neck at 0.19 H, collars 0.04 H beside the middle at 0.18 H over it, foot = ball of the
              foot
    Args      height : stature [m]
    Returns   (22, 3) [m]
    Test      tests/drop/test_drop.py::test_character
    """
    b, x = gait.Body(height), np.zeros((N, 3))

    def place(name, at):
        x[J[name]] = at

    hips = np.array([0.0, 0.0, b.ankle_height + b.shin + b.thigh])
    chest = hips + b.chest
    place("pelvis", hips + [0, 0, 0.035 * height])
    place("spine1", 0.5 * (x[0] + chest))
    place("spine2", chest)
    place("spine3", chest + [0, 0, 0.07 * height])
    place("neck", chest + [0, 0, 0.19 * height])
    place("head", chest + b.head)
    for side, sign in (("l", 1), ("r", -1)):
        mirror = np.array([1.0, sign, 1.0])
        hip, shoulder = hips + [0, sign * b.hip_half_width, 0], chest + b.shoulder * mirror
        place(f"hip_{side}", hip)
        place(f"knee_{side}", hip - [0, 0, b.thigh])
        place(f"ankle_{side}", hip - [0, 0, b.thigh + b.shin])
        place(f"foot_{side}", x[J[f"ankle_{side}"]] + b.ball)
        place(f"collar_{side}", chest + np.array([0.0, 0.04, 0.18]) * height * mirror)
        place(f"shoulder_{side}", shoulder)
        place(f"elbow_{side}", shoulder - [0, 0, b.upper_arm])
        place(f"wrist_{side}", shoulder - [0, 0, b.upper_arm + b.forearm])
    out = x - x[PARENTS]
    out[0] = x[0]
    return out


OFFSETS = rest_offsets()
LENGTHS = np.linalg.norm(OFFSETS[1:], axis=-1)  # (21,) of the bone from joint j + 1 to its parent
STANDING = OFFSETS[0, 2]  # height of the standing pelvis [m]
# PATH @ bones = joints relative to the pelvis: PATH[j, i] is 1 where bone i lies between the pelvis and joint j.
PATH = np.zeros((N, N - 1))
for _j in range(1, N):
    PATH[_j] = PATH[PARENTS[_j]]
    PATH[_j, _j - 1] = 1.0
_CROSS_OFFSETS = np.cross(np.eye(3), OFFSETS[1:, None]).swapaxes(1, 2)  # (21, 3, 3): u -> u × o
DIFFERENCE = np.eye(N)[1:] - np.eye(N)[PARENTS[1:]]  # A of Eq. 5: (21, 22), bone = child − parent


def forward_kinematics(root, quat):
    r"""Joint positions from global rotations.

    Equation  x_j = x_parent + R_parent o_j, with global R; hence x = root + PATH · (R_parent o)
    Args      root : (..., 3) pelvis [m]; quat : (..., 22, 4) global rotations
    Returns   (..., 22, 3) [m]
    Test      tests/drop/test_drop.py::test_forward_kinematics
    """
    q, o = quat[..., PARENTS[1:], :], OFFSETS[1:]
    w, u = q[..., :1], q[..., 1:]
    along = np.einsum("...ji,ji->...j", u, o)[..., None]
    across = np.matmul(_CROSS_OFFSETS, u[..., None])[..., 0]  # u × o
    bones = (2.0 * w * w - 1.0) * o + 2.0 * along * u + 2.0 * w * across
    return np.asarray(root)[..., None, :] + PATH @ bones


FEET = [J[n] for n in ("ankle_l", "foot_l", "ankle_r", "foot_r")]

# Canonical segment (and, for the joints between two, the other) whose rotation each joint takes.
_SEGMENT = dict(pelvis="pelvis", spine1="pelvis chest", spine2="chest", spine3="chest", neck="chest head", head="head")
_SEGMENT |= {f"{a}_{s}": f"{b}_{s}" for s in "lr" for a, b in (
    ("hip", "thigh"), ("knee", "shin"), ("ankle", "foot"), ("foot", "foot"), ("shoulder", "upper_arm"),
    ("elbow", "forearm"), ("wrist", "hand"))}  # fmt: skip
_SEGMENT |= {f"collar_{s}": "chest" for s in "lr"}


def joint_rotations(quat):
    """Global rotations (T, 22, 4) of the joints from those of the canonical human's segments (T, 15, 4).

    Test      tests/drop/test_drop.py::test_character_motion"""
    out = np.empty((len(quat), N, 4))
    for j, name in enumerate(JOINTS):
        parts = [quat[:, SEG[s]] for s in _SEGMENT[name].split()]
        out[:, j] = parts[0] if len(parts) == 1 else quat_slerp(*parts, np.full(len(quat), 0.5))
    return out


def character_motion(clip):
    r"""A canonical Clip as this character's motion.

    Method    global rotations are copied (halfway between two segments where SMPL has a joint more), positions follow
              by forward kinematics on the character's own bones; the root's path is scaled by the ratio of leg lengths,
              and the clip is shifted until the lower foot touches the floor in a quarter of all frames
    Args      clip : human.Clip
    Returns   x (T, 22, 3) [m], quat (T, 22, 4), world frame
    Test      tests/drop/test_drop.py::test_character_motion
    """
    quat = joint_rotations(clip.quat)
    legs = [clip.limb(f"thigh_{s}", f"shin_{s}") + clip.limb(f"shin_{s}", f"foot_{s}") for s in "lr"]
    scale = (LENGTHS[J["knee_l"] - 1] + LENGTHS[J["ankle_l"] - 1]) / np.mean(legs)
    above_hips = np.array([0.0, 0.0, -OFFSETS[J["hip_l"], 2]])  # Clip's pelvis is the hips' midpoint
    x = forward_kinematics(scale * clip.pos[:, 0] + quat_rotate(clip.quat[:, 0], above_hips), quat)
    x[..., 2] -= np.percentile((x[..., 2] - RADII)[:, FEET].min(axis=1), 25)
    return x, quat


# ------------------------------------------------------------------------------------ §7: rotations, range of motion

# Joints with one child: its bone gives the swing, the prior the twist.  Pelvis and spine3 have three children, whose
# bones give the whole rotation.  Levels: a joint stands after its parent, and those of a level are solved at once.
CHILD = {j: int(np.flatnonzero(PARENTS == j)[0]) for j in range(N) if np.sum(PARENTS == j) == 1}
LEAVES = np.array([j for j in range(N) if not np.any(PARENTS == j)])
_CHILDREN = np.array([CHILD.get(j, 0) for j in range(N)])
_LEVELS = [
    (g, PARENTS[g], _CHILDREN[g] - 1) for g in map(np.array, ([1, 2, 3, 12, 13, 14], [4, 5, 6, 16, 17], [7, 8, 18, 19]))
]
_FORKS, _ROWS = [0, 9], np.array([[1, 2, 3], [12, 13, 14]])
_FORK_OFFSETS, _FORK_BONES, _FORK_LENGTHS = OFFSETS[_ROWS], _ROWS - 1, LENGTHS[_ROWS - 1, None]
LIMITED = np.array([1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 13, 14, 16, 17, 18, 19])  # non-leaf joints but the root
AXIS = np.zeros((N, 3))  # the bone at rest: the twist's axis
for _j in LIMITED:
    _o = OFFSETS[CHILD.get(_j, J["neck"])]
    AXIS[_j] = _o / np.linalg.norm(_o)
LEAF_DAMPING = 0.1  # ASSUMED: share of the leaves' rotation that the spring towards rest takes away each step (§7)


def _basis():
    """Two unit vectors across each bone: the first as near to the y axis (flexion) as can be."""
    basis = np.zeros((N, 2, 3))
    for j in LIMITED:
        side = np.array([1.0, 0, 0]) if abs(AXIS[j, 1]) > 0.9 else np.array([0, 1.0, 0])
        e = side - (side @ AXIS[j]) * AXIS[j]
        basis[j, 0] = e / np.linalg.norm(e)
        basis[j, 1] = np.cross(AXIS[j], basis[j, 0])
    return basis


BASIS = _basis()
# Limits [degrees] of swing about the flexion axis (for legs, spine and neck: +y, which flexes the knee and extends the
# hip), of swing about the other axis (thigh and upper arm: about +x, outwards on the left side) and of twist.
# ASSUMED: wide textbook ranges, opened until recorded walking and running stays inside.
LIMITS = {
    "hip": ((-125, 40), (-35, 55), (-60, 60)), "knee": ((-8, 155), (-20, 20), (-45, 45)),
    "ankle": ((-45, 65), (-40, 40), (-40, 40)), "spine1": ((-35, 50), (-35, 35), (-35, 35)),
    "spine2": ((-35, 50), (-35, 35), (-35, 35)), "spine3": ((-25, 35), (-25, 25), (-25, 25)),
    "neck": ((-50, 50), (-40, 40), (-60, 60)), "collar": ((-30, 30), (-30, 30), (-30, 30)),
    "shoulder": ((-170, 75), (-70, 165), (-110, 110)), "elbow": ((-155, 10), (-35, 35), (-120, 120)),
}  # fmt: skip


def _limits():
    low, high = np.zeros((N, 3)), np.zeros((N, 3))
    for j in LIMITED:
        name, _, side = JOINTS[j].partition("_")
        low[j], high[j] = np.radians(LIMITS[name]).T
        if side == "r":  # the mirror image: angles about x and about the bone change their signs
            low[j, 1:], high[j, 1:] = -high[j, 1:].copy(), -low[j, 1:].copy()
    return low, high


LOW, HIGH = _limits()
EYE, EYE3 = np.eye(N), np.eye(3)
SKEW = np.zeros((3, 9))  # v @ SKEW is the matrix [v]×, row by row
SKEW[0, [5, 7]], SKEW[1, [2, 6]], SKEW[2, [1, 3]] = (-1, 1), (1, -1), (-1, 1)


def _turn(vectors):
    """Rotation vectors (K, 3) -> matrices (K, 3, 3), by Rodrigues' formula."""
    angle = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    K = (vectors @ SKEW).reshape(-1, 3, 3)
    safe = np.maximum(angle, 1e-12)
    s, c = np.sin(angle) / safe, 2.0 * (np.sin(0.5 * angle) / safe) ** 2
    return EYE3 + s[:, None, None] * K + c[:, None, None] * (K @ K)


def swing(axis, towards):
    r"""Rotation vectors of the smallest turns from `axis` to `towards`.

    Equation  θ n, with n = (a × u) / ‖a × u‖, θ = atan2(‖a × u‖, a · u); opposite vectors turn about any axis across a
    Args      axis, towards : (K, 3) unit vectors
    Returns   (K, 3) [rad], across `axis`
    Test      tests/drop/test_drop.py::test_swing_twist
    """
    n = np.matmul((axis @ SKEW).reshape(-1, 3, 3), towards[:, :, None])[:, :, 0]
    sine, cosine = np.sqrt(np.einsum("ij,ij->i", n, n)), np.einsum("ij,ij->i", axis, towards)
    angle = np.arctan2(sine, cosine)
    out = n * (angle / np.maximum(sine, 1e-12))[:, None]
    if (back := (sine < 1e-9) & (cosine < 0)).any():
        across = np.cross(axis[back], np.eye(3)[np.abs(axis[back]).argmin(axis=1)])
        out[back] = np.pi * across / np.linalg.norm(across, axis=1, keepdims=True)
    return out


def align(offsets, bones):
    r"""The rotations that turn `offsets` best into `bones` (Kabsch): argmin over R of Σ_i ‖R o_i − b_i‖².

    Args      offsets, bones : (K, m, 3)
    Returns   (K, 3, 3)
    Test      tests/drop/test_drop.py::test_swing_twist
    """
    u, _, vt = np.linalg.svd(np.swapaxes(bones, -1, -2) @ offsets)
    u[..., :, 2] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[:, None]
    return u @ vt


def twists(quat):
    r"""What positions cannot say: twist about each bone, and the leaves' local rotations.

    Equation  local q = q_parent⁻¹ q = swing · twist, twist angle = 2 atan2(q_vec · axis, q_w)
    Args      quat : (22, 4) global rotations of the prior's chosen sample
    Returns   angle (22,) [rad], 0 for pelvis and leaves; leaves (5, 3, 3) damped towards rest (LEAF_DAMPING)
    Test      tests/drop/test_drop.py::test_swing_twist
    """
    local = quat_mul(quat_conj(quat[PARENTS]), quat)
    angle = 2.0 * np.arctan2(np.einsum("ij,ij->i", local[:, 1:], AXIS), local[:, 0])
    leaf = local[LEAVES] * np.where(local[LEAVES, :1] < 0, -1.0, 1.0)
    leaf = (1.0 - LEAF_DAMPING) * leaf + LEAF_DAMPING * np.array([1.0, 0, 0, 0])
    leaf /= np.linalg.norm(leaf, axis=1, keepdims=True)
    return (angle + np.pi) % (2 * np.pi) - np.pi, quat_matrix(leaf)


def swing_twist(x, twist):
    r"""Joint rotations from positions.

    Equation  [DROP §7] R_j = R_parent · swing(rest bone → solved bone, in the parent's frame) · twist of the prior's
              sample; pelvis and spine3, with three children, by `align`; leaves: the sample's
    Args      x : (22, 3); twist : what `twists` returns
    Returns   R (22, 3, 3) global; u (22, 3) each limited joint's bone in its parent's frame, unit length
    Test      tests/drop/test_drop.py::test_swing_twist
    """
    angle, leaves = twist
    bones = DIFFERENCE @ x
    bones /= np.maximum(np.sqrt(np.einsum("ij,ij->i", bones, bones)), 1e-9)[:, None]
    R, u = np.empty((N, 3, 3)), AXIS.copy()
    R[_FORKS] = align(_FORK_OFFSETS, bones[_FORK_BONES] * _FORK_LENGTHS)
    turn = _turn(angle[:, None] * AXIS)
    for level, parents, bone in _LEVELS:
        parent = R[parents]
        u[level] = towards = np.matmul(bones[bone, None], parent)[:, 0]  # Rᵀ b: in the parent's frame
        R[level] = parent @ _swing_matrix(AXIS[level], towards) @ turn[level]
    R[LEAVES] = R[PARENTS[LEAVES]] @ leaves
    u[9] = R[6].T @ R[9] @ AXIS[9]
    return R, u


def _swing_matrix(axis, towards):
    """The turn of `swing` as matrices: I + [n]× + [n]×²/(1 + a · u), n = a × u (Rodrigues' formula without angles)."""
    n = np.matmul((axis @ SKEW).reshape(-1, 3, 3), towards[:, :, None])[:, :, 0]
    cosine = np.einsum("ij,ij->i", axis, towards)
    if cosine.min() < -1.0 + 1e-9:
        return _turn(swing(axis, towards))
    K = (n @ SKEW).reshape(-1, 3, 3)
    return EYE3 + K + K @ K / (1.0 + cosine)[:, None, None]


def joint_angles(x, twist, solved=None):
    r"""Swing about two axes and twist of each limited joint: what LIMITS bound.

    Equation  swing vector (`swing`) on BASIS; twist as the prior's sample has it, of spine3 what its three bones say
    Args      x : (22, 3); twist : what `twists` returns; solved : swing_twist(x, twist), if it is known already
    Returns   (22, 3) [rad]
    Test      tests/drop/test_drop.py::test_range_of_motion
    """
    R, u = solved or swing_twist(x, twist)
    local = np.empty((N, 3))
    vectors = swing(AXIS, u)
    local[:, :2] = np.matmul(BASIS, vectors[:, :, None])[:, :, 0]
    local[:, 2] = twist[0]
    spine = _swing_matrix(AXIS[9:10], u[9:10])[0].T @ R[6].T @ R[9]  # what is left is a turn about the axis
    local[9, 2] = np.arctan2(0.5 * np.sum((AXIS[9] @ SKEW).reshape(3, 3) * spine), 0.5 * (np.trace(spine) - 1.0))
    return local


def project_range_of_motion(x, twist, solved=None, low=LOW, high=HIGH):
    r"""The pose moved back inside the joints' limits.

    Equation  [DROP Eq. 7] x_r; here each joint's swing and twist is clipped to LIMITS, then forward kinematics, laid
              on x as a rigid body (`align`): the nearest place, and the one whose pull has no net force or torque
    Departs   §7 projects with a pose VAE (Eq. 15, VPoser), which is not to be had here; `limits` of `Simulator` takes
              any other projection of this form
    Args      x : (22, 3); twist : what `twists` returns; solved : swing_twist(x, twist), if it is known already;
              low, high : (22, 3) [rad] other limits
    Returns   (22, 3): x itself if the pose is inside
    Test      tests/drop/test_drop.py::test_projections_are_nearest_and_idempotent, ::test_range_of_motion
    """
    solved = R, _ = solved or swing_twist(x, twist)
    local = joint_angles(x, twist, solved)
    clipped = np.minimum(np.maximum(local, low), high)
    if np.abs(clipped - local)[LIMITED].max() < 1e-9:
        return x
    R = R.copy()
    turn = _turn(np.matmul(clipped[:, None, :2], BASIS)[:, 0]) @ _turn(clipped[:, 2, None] * AXIS)
    for j in LIMITED:  # parents come before children
        R[j] = R[PARENTS[j]] @ turn[j]
    out = PATH @ np.matmul(R[PARENTS[1:]], OFFSETS[1:, :, None])[:, :, 0]
    out, centred = out - out.mean(axis=0), x - x.mean(axis=0)
    return out @ align(out[None], centred[None])[0].T + x.mean(axis=0)


NEARER = 2  # ASSUMED: steps from clipped angles to the nearest pose inside the limits
_DEPTHS = [np.array(g) for g in ([1, 2, 3], [4, 5, 6], [7, 8, 9], [12, 13, 14], [16, 17], [18, 19])]  # parents first
_SWUNG = np.append(np.repeat(LIMITED, 2), 9)  # the joint of each free angle: two swings each, and spine3's twist
_AXES = np.append(np.tile([0, 1], len(LIMITED)), 2)
_BELOW = PATH[:, np.maximum(_SWUNG - 1, 0)].T * (np.arange(N) != _SWUNG[:, None])  # (33, 22): who turns with it


def nearest_in_range(x, twist, solved=None):
    r"""The nearest pose inside the joints' limits, for a limp body.

    Equation  [DROP Eqs. 3, 7] x_r = argmin over p in C of ‖x − p‖², C = rigid motions of the poses whose swings and
              twists are inside LIMITS.  The clipped angles of `project_range_of_motion` are in C, but not nearest; from
              them `NEARER` steps of Gauss and Newton go on, with the angles in their box
    Why       only with the nearest p is w (p − x) the force of an energy (envelope theorem).  Clipped angles turn a
              whole leg for a fault of its hip; that force does work round a closed path, and where no prior holds the
              body it drove one for nine seconds (REPRODUCE.md, "Lying still").  No net force and no torque, either
    ASSUMED   `NEARER`; a twist is what the body had last, clipped: positions say nothing of it (but of spine3's).  A
              carried body keeps clipped angles, which pull harder: with the nearest pose two who meet overlap by 17 cm
              instead of 15, and a held heel topples a walker who stood
    Args      x : (22, 3); twist : what `twists` returns; solved : swing_twist(x, twist), if it is known already
    Returns   (22, 3): x itself if the pose is inside
    Test      tests/drop/test_drop.py::test_a_limp_range_of_motion_is_an_energy, ::test_nearest_in_range
    """
    held = np.minimum(np.maximum(twist[0], LOW[:, 2]), HIGH[:, 2])
    held[9] = twist[0][9]  # not used: spine3's bones say what its twist is
    if not np.array_equal(held, twist[0]):
        twist, solved = (held, twist[1]), None
    R, _ = solved = solved or swing_twist(x, twist)
    local = joint_angles(x, twist, solved)
    angles = np.minimum(np.maximum(local, LOW), HIGH)
    if np.abs(angles - local)[LIMITED].max() < 1e-9:
        return x
    centred = x - x.mean(axis=0)
    p, turned = _posed(angles, R, centred)
    for _ in range(NEARER):
        step = _nearer(angles, p, turned, centred - p)
        for share in (1.0, 0.3):
            tried = angles.copy()
            tried[_SWUNG, _AXES] += share * step
            tried = np.minimum(np.maximum(tried, LOW), HIGH)
            q, moved = _posed(tried, turned, centred)
            if np.sum((centred - q) ** 2) < np.sum((centred - p) ** 2):
                break
        else:
            break
        angles, p, turned = tried, q, moved
    return p + x.mean(axis=0)


def _posed(angles, R, centred):
    """Forward kinematics of joint angles (22, 3), laid on centred positions (22, 3) as a rigid body.

    Args      R : (22, 3, 3) global rotations, of which the root's and the leaves' are used
    Returns   positions (22, 3) centred; global rotations (22, 3, 3)
    Test      as `nearest_in_range`"""
    R = R.copy()
    turn = _turn(np.matmul(angles[:, None, :2], BASIS)[:, 0]) @ _turn(angles[:, 2, None] * AXIS)
    for level in _DEPTHS:
        R[level] = R[PARENTS[level]] @ turn[level]
    out = PATH @ np.matmul(R[PARENTS[1:]], OFFSETS[1:, :, None])[:, :, 0]
    out -= out.mean(axis=0)
    whole = align(out[None], centred[None])[0]
    return out @ whole.T, whole @ R


def _nearer(angles, p, R, left):
    r"""A step of Gauss and Newton of the free angles, the whole body turning with them as it likes.

    Equation  min over δ, ω of ‖left − J δ − ω × p‖²: ∂p_i/∂angle = a × (p_i − p_j) for i below joint j.  Of a swing v
              a = R_parent J_l(v) e, J_l the left Jacobian of the rotation exp [v]×; of the twist a = R_j axis.  An
              angle at its limit whose gradient points out of the box stays there
    Args      angles (22, 3); p, left (22, 3) centred; R (22, 3, 3)
    Returns   (33,) [rad] of `_SWUNG`, `_AXES`
    Test      as `nearest_in_range`
    """
    v = np.matmul(angles[:, None, :2], BASIS)[:, 0]
    theta = np.maximum(np.sqrt(np.einsum("ij,ij->i", v, v)), 1e-6)[:, None, None]
    K = (v @ SKEW).reshape(-1, 3, 3)
    left_jacobian = EYE3 + (1.0 - np.cos(theta)) / theta**2 * K + (theta - np.sin(theta)) / theta**3 * (K @ K)
    about = np.concatenate([np.swapaxes(BASIS, 1, 2), np.zeros((N, 3, 1))], axis=2)
    about = R[PARENTS] @ left_jacobian @ about
    axis = about[_SWUNG, :, _AXES]
    axis[-1] = R[9] @ AXIS[9]
    columns = np.matmul((p - p[_SWUNG, None]) * _BELOW[:, :, None], (axis @ SKEW).reshape(-1, 3, 3).swapaxes(1, 2))
    columns -= columns.mean(axis=1, keepdims=True)
    A = np.concatenate([columns, np.matmul(p, SKEW.reshape(3, 3, 3).swapaxes(1, 2))]).reshape(len(_SWUNG) + 3, -1)
    gradient, here = A @ left.ravel(), angles[_SWUNG, _AXES]
    free = np.ones(len(A), bool)
    free[:-3] = np.where(gradient[:-3] > 0, here < HIGH[_SWUNG, _AXES] - 1e-9, here > LOW[_SWUNG, _AXES] + 1e-9)
    step = np.zeros(len(A))
    step[free] = np.linalg.solve(A[free] @ A[free].T + 1e-4 * np.eye(free.sum()), gradient[free])
    return step[:-3]


# ------------------------------------------------------------------------------------ checks


def checked(value, shape, name, largest=1e9):
    """The value as an array of floats, or one line that says what is wrong with it.

    Test      tests/drop/test_drop.py::test_bad_input"""
    try:
        value = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be an array of numbers of shape {shape}") from None
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}; it must be {shape}")
    size = np.abs(value).max()
    if not size <= largest:  # NaN is not
        beyond = f"values beyond {largest:g}" if np.isfinite(size) else "NaN or infinity"
        raise ValueError(f"{name} holds {beyond}")
    return value


def checked_unit(quat, name):
    """The quaternions (..., 4), which must have length 1 within a hundredth.

    Test      tests/drop/test_drop.py::test_bad_input"""
    square = np.einsum("...i,...i", quat, quat)
    if np.abs(square - 1.0).max() > 0.02:
        worst = square.ravel()[np.abs(square - 1.0).argmax()]
        raise ValueError(f"{name}: quaternions have length 1, not {np.sqrt(worst):.3g}")
    return quat

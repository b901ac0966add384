r"""DROP's simulator: a projective-dynamics human with a motion prior  [DROP §4 to §7].

Jiang, Won, Ye, Liu, "DROP: Dynamics Responses from Human Motion Prior and Projective Dynamics", ACM TOG 42(6), 2023.

    prior ──► samples X̂, mode μ0 ──► 3 × ( local: project every energy on its own    Eqs. 5, 6, 7, 10
              Eqs. 8, 9               global: one linear solve                 )    Eq. 4
          ──► soft correction of the root wrench (Eqs. 11 to 14) ──► bone lengths restored ──► x, v (Eq. 2), q (§7)

The character is 22 unit point masses at SMPL's joints 0 to 21 (`JOINTS`); bones are springs.  SI units, z up, x
forward, y left, floor at z = 0; world frame unless said otherwise; quaternions w, x, y, z.  The masses sum to 22 kg,
not to a person's 70: a push of F newtons here moves the body as one of 3.2 F would move an adult.

    python drop.py DEMO [--prior nearest] [--motion builtin] [--seed 0] [--png OUT | --video OUT]

Motion priors are in drop_prior.py (§5), the demonstrations in drop_demos.py (§8).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from human import SEG, quat_conj, quat_matrix, quat_mul, quat_rotate, quat_slerp
from runs import run_main

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
ITERATIONS = 3  # §5

# Radii of the contact spheres [m].  ASSUMED ("manually-scaled spheres", §7): ankles and balls of the feet just touch
# the floor in the standing pose of a 1.75 m person, the others fill limbs and trunk.
RADII = np.array([
    0.10, 0.08, 0.08, 0.09, 0.055, 0.055, 0.10, 0.068, 0.068, 0.10, 0.0245, 0.0245, 0.06, 0.06, 0.06, 0.11, 0.06,
    0.06, 0.045, 0.045, 0.05, 0.05,
])  # fmt: skip


def rest_offsets(height=1.75):
    r"""Each joint relative to its parent in the standing pose, arms hanging.

    ASSUMED   SMPL's mean body is not to be had here: the canonical human's proportions (`gait.Body`).  Joints it lacks:
              pelvis 0.035 H above the hips, spine1 halfway to the chest's base (spine2), spine3 0.07 H above it, neck
              at 0.19 H, collars 0.04 H beside the middle at 0.18 H over it, foot = ball of the foot
    Args      height : stature [m]
    Returns   (22, 3) [m]
    Test      tests/test_drop.py::test_character
    """
    import gait

    b, x = gait.Body(height), np.zeros((N, 3))
    place = lambda name, at: x.__setitem__(J[name], at)  # noqa: E731
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
    Test      tests/test_drop.py::test_forward_kinematics
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


def character_motion(clip):
    r"""A canonical Clip as this character's motion.

    Method    global rotations are copied (halfway between two segments where SMPL has a joint more), positions follow
              by forward kinematics on the character's own bones; the root's path is scaled by the ratio of leg lengths,
              and the clip is shifted until the lower foot touches the floor in a quarter of all frames
    Args      clip : human.Clip
    Returns   x (T, 22, 3) [m], quat (T, 22, 4), world frame
    Test      tests/test_drop.py::test_character_motion
    """
    quat = np.empty((len(clip), N, 4))
    for j, name in enumerate(JOINTS):
        parts = [clip.quat[:, SEG[s]] for s in _SEGMENT[name].split()]
        quat[:, j] = parts[0] if len(parts) == 1 else quat_slerp(*parts, np.full(len(clip), 0.5))
    legs = [clip.limb(f"thigh_{s}", f"shin_{s}") + clip.limb(f"shin_{s}", f"foot_{s}") for s in "lr"]
    scale = (LENGTHS[J["knee_l"] - 1] + LENGTHS[J["ankle_l"] - 1]) / np.mean(legs)
    above_hips = np.array([0.0, 0.0, -OFFSETS[J["hip_l"], 2]])  # Clip's pelvis is the hips' midpoint
    x = forward_kinematics(scale * clip.pos[:, 0] + quat_rotate(clip.quat[:, 0], above_hips), quat)
    x[..., 2] -= np.percentile((x[..., 2] - RADII)[:, FEET].min(axis=1), 25)
    return x, quat


# ------------------------------------------------------------------------------------ §4.1: the energies
#
# E_i(x) = (w_i / 2) min over p in C_i of ‖A_i x − p‖² (Eq. 3).  A `project_…` function finds p; `spring` gives value
# and gradient for that p, which is also the gradient of the minimum (envelope theorem).  x is (22, 3), A acts on its
# rows, so x, y and z share it.  Eqs. 5 to 7 drop constants and a factor in print; all are Eq. 3 here.


def spring(w, A, x, p):
    r"""Value and gradient of one projective energy.

    Equation  [DROP Eq. 3] E = (w/2) ‖A x − p‖²,  ∇E = w Aᵀ (A x − p)
    Args      w : float or (K,), a weight each row; A : (K, 22); x : (22, 3); p : (K, 3)
    Returns   E : float, dE : (22, 3)
    Test      tests/test_drop.py::test_energy_gradients
    """
    r = A @ x - p
    wr = np.broadcast_to(w, len(r))[:, None] * r
    return 0.5 * float(np.sum(wr * r)), A.T @ wr


def momentum(x, y, h=STEP):
    r"""The momentum energy, value and gradient, M = I.

    Equation  [DROP Eq. 1] E_mom = 1/(2h²) (x − y)ᵀ M (x − y)
    Args      x : (22, 3); y : (22, 3) of `inertial_target`
    Test      tests/test_drop.py::test_energy_gradients, ::test_free_fall
    """
    return 0.5 / h**2 * float(np.sum((x - y) ** 2)), (x - y) / h**2


def inertial_target(x_t, v_t, force, h=STEP):
    r"""Where the particles go on their own.

    Equation  [DROP Eq. 1] y = x_t + h v_t + h² M⁻¹ f_t + h² g
    Args      x_t, v_t, force : (22, 3) [m], [m/s], [N]
    Test      tests/test_drop.py::test_free_fall
    """
    return x_t + h * v_t + h * h * (force + GRAVITY)


def project_rigidity(x, A=DIFFERENCE, lengths=LENGTHS):
    r"""Bones at their rest lengths, in the directions they have.

    Equation  [DROP Eq. 5] d_i = l_i (A x)_i / ‖(A x)_i‖
    Args      x : (22, 3); A : (K, 22) differences; lengths : (K,) [m]
    Returns   (K, 3); a bone without a direction points up
    Test      tests/test_drop.py::test_projections_are_nearest_and_idempotent
    """
    bones = A @ x
    norm = np.sqrt(np.einsum("ij,ij->i", bones, bones))
    if norm.min() < 1e-9:
        bones[norm < 1e-9], norm = [0.0, 0.0, 1.0], np.where(norm < 1e-9, 1.0, norm)
    return bones * (lengths / norm)[:, None]


@dataclass(frozen=True)
class Plane:
    """The half space normal · x ≥ offset is free.  Test: tests/test_drop.py::test_obstacles"""

    normal: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset: float = 0.0

    def distance(self, x):
        """Signed distance (K,) and outward normal (K, 3) of points (K, 3)."""
        return x @ self.normal - self.offset, np.broadcast_to(self.normal, x.shape)


@dataclass(frozen=True)
class Spheres:
    """Solid spheres, such as another character's.  Test: tests/test_drop.py::test_obstacles"""

    centre: np.ndarray  # (S, 3)
    radius: np.ndarray  # (S,)

    def distance(self, x):
        """Signed distance (K,) and outward normal (K, 3) of points (K, 3) to the nearest surface."""
        d = x[:, None] - self.centre
        r = np.sqrt(np.einsum("ksj,ksj->ks", d, d))
        near = (r - self.radius).argmin(axis=1)
        rows = np.arange(len(x))
        d, r = d[rows, near], r[rows, near]
        normal = np.where(r[:, None] > 1e-9, d / np.maximum(r, 1e-9)[:, None], [0.0, 0.0, 1.0])
        return r - self.radius[near], normal


@dataclass(frozen=True)
class Box:
    """A solid box.  Test: tests/test_drop.py::test_obstacles"""

    centre: np.ndarray  # (3,)
    half: np.ndarray  # (3,) half sizes
    quat: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    def distance(self, x):
        """Signed distance (K,) and outward normal (K, 3) of points (K, 3)."""
        local = quat_rotate(np.broadcast_to(quat_conj(self.quat), (len(x), 4)), x - self.centre)
        q = np.abs(local) - self.half
        out = np.maximum(q, 0.0)
        far = np.linalg.norm(out, axis=1)
        sign = np.where(local < 0, -1.0, 1.0)
        inner = np.eye(3)[q.argmax(axis=1)]  # inside: the nearest face
        normal = sign * np.where(far[:, None] > 1e-12, out / np.maximum(far, 1e-12)[:, None], inner)
        turned = quat_rotate(np.broadcast_to(self.quat, (len(x), 4)), normal)
        return np.where(far > 1e-12, far, q.max(axis=1)), turned


# ASSUMED: "about to penetrate" (§4.1) is a gap below 0, or below 5 mm for a particle that is in contact already.  A
# particle found deep inside is pushed out by at most 3 cm a step (0.9 m/s), because its velocity of Eq. 2 would throw
# it into the air.  Static friction holds up to 1 m/s: a contact that slides faster is slowed by that much a step, or a
# swinging foot that grazes the floor by a millimetre would be nailed to it.
CONTACT_MARGIN, PUSH_OUT, SLIP = 0.005, 0.03, 1.0


def gaps(x, obstacles, radii=RADII):
    r"""Distance of every sphere's surface to the nearest obstacle, and the normal there.

    Returns   gap (22,) [m], negative in penetration; normal (22, 3)
    Test      tests/test_drop.py::test_obstacles
    """
    gap, normal = obstacles[0].distance(x)
    for other in obstacles[1:]:
        g, n = other.distance(x)
        normal = np.where((g < gap)[:, None], n, normal)
        gap = np.minimum(g, gap)
    return gap - radii, normal


def project_contact(x, x_t, obstacles, here=None):
    r"""Which particles are about to penetrate, and where they must stay.

    Equation  [DROP Eq. 6] S: gap of the solver's x below the margin; x_c = x_t moved along the normal to the nearest
              place without penetration: tangentially it is x_t, so contacts stick (static friction)
    ASSUMED   the margin, the largest push, the speed that static friction holds (CONTACT_MARGIN, PUSH_OUT, SLIP)
    Args      x, x_t : (22, 3) the solver's state and the current one; obstacles : list with `distance`;
              here : gaps(x_t, obstacles), if they are known already
    Returns   active : (22,) bool, the diagonal of S; x_c : (22, 3)
    Test      tests/test_drop.py::test_project_contact
    """
    gap_t, normal = here or gaps(x_t, obstacles)
    active = gaps(x, obstacles)[0] < np.where(gap_t < CONTACT_MARGIN, CONTACT_MARGIN, 0.0)
    move = x - x_t
    move = move - np.einsum("ij,ij->i", move, normal)[:, None] * normal
    length = np.sqrt(np.einsum("ij,ij->i", move, move))
    slide = np.maximum(0.0, 1.0 - SLIP * STEP / np.maximum(length, 1e-9))
    return active, x_t + np.minimum(np.maximum(-gap_t, 0.0), PUSH_OUT)[:, None] * normal + slide[:, None] * move


def project_prior(x, samples):
    r"""The nearest sample of the prior.

    Equation  [DROP Eq. 10] x_kin = argmin over X̂ of ‖x − x_kin‖²
    Args      x : (22, 3); samples : (n, 22, 3)
    Returns   its number
    Test      tests/test_drop.py::test_project_prior
    """
    d = (samples - x).reshape(len(samples), -1)
    return int(np.einsum("ij,ij->i", d, d).argmin())


def direction(w, x, x_t, v_tar, h=STEP):
    r"""Centre-of-mass velocity, value and gradient; quadratic as it stands, no projection.

    Equation  [DROP Eq. 16] E_com = (w/2) ‖Σ_j m_j (x_j − x_{j,t})/h − v_tar Σ_j m_j‖²
    ASSUMED   horizontal only: a vertical target of 0 would hold the centre of mass at one height
    Args      x, x_t : (22, 3); v_tar : (2,) [m/s]
    Test      tests/test_drop.py::test_energy_gradients
    """
    r = np.append(((x - x_t).sum(axis=0) / h)[:2] - len(x) * np.asarray(v_tar), 0.0)
    return 0.5 * w * float(r @ r), np.broadcast_to(w / h * r, x.shape).copy()


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
_EYE, _EYE3 = np.eye(N), np.eye(3)
_SKEW = np.zeros((3, 9))  # v @ _SKEW is the matrix [v]×, row by row
_SKEW[0, [5, 7]], _SKEW[1, [2, 6]], _SKEW[2, [1, 3]] = (-1, 1), (1, -1), (-1, 1)


def _turn(vectors):
    """Rotation vectors (K, 3) -> matrices (K, 3, 3), by Rodrigues' formula."""
    angle = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    K = (vectors @ _SKEW).reshape(-1, 3, 3)
    safe = np.maximum(angle, 1e-12)
    s, c = np.sin(angle) / safe, 2.0 * (np.sin(0.5 * angle) / safe) ** 2
    return _EYE3 + s[:, None, None] * K + c[:, None, None] * (K @ K)


def swing(axis, towards):
    r"""Rotation vectors of the smallest turns from `axis` to `towards`.

    Equation  θ n, with n = (a × u) / ‖a × u‖, θ = atan2(‖a × u‖, a · u); opposite vectors turn about any axis across a
    Args      axis, towards : (K, 3) unit vectors
    Returns   (K, 3) [rad], across `axis`
    Test      tests/test_drop.py::test_swing_twist
    """
    n = np.matmul((axis @ _SKEW).reshape(-1, 3, 3), towards[:, :, None])[:, :, 0]
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
    Test      tests/test_drop.py::test_swing_twist
    """
    u, _, vt = np.linalg.svd(np.swapaxes(bones, -1, -2) @ offsets)
    u[..., :, 2] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[:, None]
    return u @ vt


def twists(quat):
    r"""What positions cannot say: twist about each bone, and the leaves' local rotations.

    Equation  local q = q_parent⁻¹ q = swing · twist, twist angle = 2 atan2(q_vec · axis, q_w)
    Args      quat : (22, 4) global rotations of the prior's chosen sample
    Returns   angle (22,) [rad], 0 for pelvis and leaves; leaves (5, 3, 3) damped towards rest (LEAF_DAMPING)
    Test      tests/test_drop.py::test_swing_twist
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
    Test      tests/test_drop.py::test_swing_twist
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
    n = np.matmul((axis @ _SKEW).reshape(-1, 3, 3), towards[:, :, None])[:, :, 0]
    cosine = np.einsum("ij,ij->i", axis, towards)
    if cosine.min() < -1.0 + 1e-9:
        return _turn(swing(axis, towards))
    K = (n @ _SKEW).reshape(-1, 3, 3)
    return _EYE3 + K + K @ K / (1.0 + cosine)[:, None, None]


def project_range_of_motion(x, twist, solved=None):
    r"""The pose moved back inside the joints' limits.

    Equation  [DROP Eq. 7] x_r; here each joint's swing and twist is clipped to LIMITS, then forward kinematics, laid
              on x as a rigid body (`align`): the nearest place, and the one whose pull has no net force or torque
    Departs   §7 projects with a pose VAE (Eq. 15, VPoser), which is not to be had here; `limits` of `Simulator` takes
              any other projection of this form
    Args      x : (22, 3); twist : what `twists` returns; solved : swing_twist(x, twist), if it is known already
    Returns   (22, 3): x itself if the pose is inside
    Test      tests/test_drop.py::test_projections_are_nearest_and_idempotent, ::test_range_of_motion
    """
    R, u = solved or swing_twist(x, twist)
    local = np.empty((N, 3))
    vectors = swing(AXIS, u)
    local[:, :2] = np.matmul(BASIS, vectors[:, :, None])[:, :, 0]
    local[:, 2] = twist[0]
    spine = _swing_matrix(AXIS[9:10], u[9:10])[0].T @ R[6].T @ R[9]  # what is left is a turn about the axis
    local[9, 2] = np.arctan2(0.5 * np.sum((AXIS[9] @ _SKEW).reshape(3, 3) * spine), 0.5 * (np.trace(spine) - 1.0))
    clipped = np.minimum(np.maximum(local, LOW), HIGH)
    if np.abs(clipped - local)[LIMITED].max() < 1e-9:
        return x
    R = R.copy()
    turn = _turn(np.matmul(clipped[:, None, :2], BASIS)[:, 0]) @ _turn(clipped[:, 2, None] * AXIS)
    for j in LIMITED:  # parents come before children
        R[j] = R[PARENTS[j]] @ turn[j]
    out = PATH @ np.matmul(R[PARENTS[1:]], OFFSETS[1:, :, None])[:, :, 0]
    out, centred = out - out.mean(axis=0), x - x.mean(axis=0)
    return out @ align(out[None], centred[None])[0].T + x.mean(axis=0)


# ------------------------------------------------------------------------------------ §6: root wrench

MU, EDGES = 0.8, 4  # ASSUMED: Coulomb friction of a shoe, edges of the linearised cone (Eq. 11)
WRENCH_MARGIN = 0.03  # m, ASSUMED: a sphere this near to an obstacle may carry a contact force
WRENCH_LIMIT = 40.0  # ASSUMED: a residual below is left alone; 95 % of built-in running is below 42 to 58, walking 11
WRENCH_WEIGHT = 1e-6  # w_p of Eq. 14, ASSUMED: removes 95 % of a residual force, 60 to 80 % of a torque


def momentum_rate(x, x_t, v_t, h=STEP):
    r"""Change of linear and angular momentum, M = I.

    Equation  [DROP Eq. 12] Ṗ = (1/h) Σ_j m_j ((x_j − x_{j,t})/h − v_{j,t})
              [DROP Eq. 13] L̇ = (1/h) Σ_j m_j [r_j]_× ((x_j − x_{j,t})/h − v_{j,t}), r_j from the centre of mass of x_t
    Args      x, x_t : (22, 3); v_t : (22, 3)
    Returns   (6,) [N], [N m]
    Test      tests/test_drop.py::test_momentum_rate
    """
    a = ((x - x_t) / h - v_t) / h
    r = x_t - x_t.mean(axis=0)
    return np.concatenate([a.sum(axis=0), np.cross(r, a).sum(axis=0)])


def wrench_map(x_t, v_t, force, h=STEP):
    r"""The wrench that contacts must supply, as an affine function of the next positions.

    Equation  [DROP §6] b = (Ṗ, L̇) − gravity − external forces = B x − a
    Args      x_t, v_t, force : (22, 3)
    Returns   B (6, 66) for x raveled joint by joint; a (6,)
    Test      tests/test_drop.py::test_wrench_map
    """
    r = x_t - x_t.mean(axis=0)
    B = np.zeros((6, N, 3))
    B[[0, 1, 2], :, [0, 1, 2]] = 1.0 / h**2
    B[3:] = np.swapaxes((r @ _SKEW).reshape(N, 3, 3), 0, 1) / h**2
    B = B.reshape(6, -1)
    free = x_t + h * v_t + h * h * (force + GRAVITY)  # where B x − a is 0: Eq. 1's y
    return B, B @ free.ravel()


def friction_basis(points, normals, com, mu=MU, edges=EDGES):
    r"""Contact wrenches about the centre of mass, one column an edge of a linearised friction cone.

    Equation  [DROP Eq. 11] F = [d; (p − com) × d] over the edges d of each contact p
    Args      points, normals : (P, 3); com : (3,); mu [-]; edges : a cone
    Returns   F (6, P edges); d (P edges, 3) unit length
    Test      tests/test_drop.py::test_friction_basis
    """
    across = np.where(np.abs(normals[:, :1]) < 0.9, _EYE3[:1], _EYE3[1:2])
    s = np.matmul((normals @ _SKEW).reshape(-1, 3, 3), across[:, :, None])[:, :, 0]
    s /= np.sqrt(np.einsum("ij,ij->i", s, s))[:, None]
    t = np.matmul((normals @ _SKEW).reshape(-1, 3, 3), s[:, :, None])[:, :, 0]
    angle = 2 * np.pi * np.arange(edges) / edges
    d = normals[:, None] + mu * (np.cos(angle)[:, None] * s[:, None] + np.sin(angle)[:, None] * t[:, None])
    d = (d / np.sqrt(1 + mu * mu)).reshape(-1, 3)
    arm = (np.repeat(points - com, edges, axis=0) @ _SKEW).reshape(-1, 3, 3)
    return np.concatenate([d, np.matmul(arm, d[:, :, None])[:, :, 0]], axis=1).T, d


def contact_forces(F, b):
    r"""The contact forces that explain b best.

    Equation  [DROP Eq. 11] min_c ‖F c − b‖² subject to c ≥ 0, by non-negative least squares
    Returns   c (K,); residual b − F c (6,): the fictitious root wrench, whose norm is the metric
    Test      tests/test_drop.py::test_nnls_against_brute_force
    """
    if F.shape[1] == 0:
        return np.zeros(0), b
    try:
        c = nnls(F, b)[0]
    except RuntimeError:  # too many iterations: no contact force at all is a feasible answer
        c = np.zeros(F.shape[1])
    return c, b - F @ c


def soft_correction(x_pd, B, residual, weight=WRENCH_WEIGHT):
    r"""Move the solved state so that less of the root wrench is fictitious.

    Equation  [DROP Eq. 14] min_{x,ε} ‖x − x_pd‖² + w_p ‖ε‖² s.t. B x − a − F c = ε; eliminating ε and the multiplier
              from its KKT system: x = x_pd − Bᵀ (B Bᵀ + I/w_p)⁻¹ (B x_pd − a − F c)
    Args      x_pd : (22, 3); B : (6, 66); residual : (6,) B x_pd − a − F c; weight : w_p
    Returns   (22, 3)
    Test      tests/test_drop.py::test_soft_correction_both_ways
    """
    lam = np.linalg.solve(B @ B.T + np.eye(6) / weight, residual)
    return x_pd - (B.T @ lam).reshape(x_pd.shape)


def soft_correction_kkt(x_pd, B, residual, weight=WRENCH_WEIGHT):
    r"""Eq. 14 as §6 solves it: the whole KKT system in (x, ε, λ).

    Equation  [DROP Eq. 14] [[2I, 0, Bᵀ], [0, 2 w_p I, −I], [B, −I, 0]] (x, ε, λ) = (2 x_pd, 0, a + F c)
    Returns   (22, 3), (6,) ε
    Test      tests/test_drop.py::test_soft_correction_both_ways
    """
    n = B.shape[1]
    K = np.zeros((n + 12, n + 12))
    K[:n, :n], K[n : n + 6, n : n + 6] = 2 * np.eye(n), 2 * weight * np.eye(6)
    K[:n, n + 6 :], K[n : n + 6, n + 6 :], K[n + 6 :, :n], K[n + 6 :, n : n + 6] = B.T, -np.eye(6), B, -np.eye(6)
    x = x_pd.ravel()
    solved = np.linalg.solve(K, np.concatenate([2 * x, np.zeros(6), B @ x - residual]))
    return solved[:n].reshape(x_pd.shape), solved[n : n + 6]


# ------------------------------------------------------------------------------------ Algorithm 1


@dataclass(frozen=True)
class State:
    """A character at one moment.

    x, v   : (22, 3) positions [m] and velocities [m/s] of Eqs. 1 and 2
    quat   : (22, 4) global rotations
    frame  : steps since the start
    v_own  : (22, 3) velocities the prior itself predicted, not overwritten by differences of the solved x (§7)
    """

    x: np.ndarray
    v: np.ndarray
    quat: np.ndarray
    frame: int = 0
    v_own: np.ndarray | None = None

    @property
    def com(self):
        """Centre of mass (3,)."""
        return self.x.mean(axis=0)


@dataclass(frozen=True)
class Weights:
    r"""Weights of the energies, in units of M/h² = 900 N/m.

    ASSUMED   §7 gives 1, 3, 3, 3 without a scale.  REPRODUCE.md has the table these were chosen from
    """

    rigidity: float = 3.0
    contact: float = 9.0
    range_of_motion: float = 9.0
    prior: float = 9.0
    direction: float = 0.3
    constraint: float = 30.0


@dataclass
class Outcome:
    """What a step found out beside the state; `energies` in joules by term."""

    energies: dict
    active: np.ndarray  # (22,) bool, contacts
    sample: int  # chosen, 0 is the mode; -1 without a prior
    wrench_pd: float  # ‖b − F c‖ before the correction [N, N m]
    wrench: float  # and after
    points: np.ndarray  # (P, 3) where contact forces act
    forces: np.ndarray  # (P, 3) [N] of Eq. 11: slack variables, not simulated
    bone_error: float  # largest relative error of a bone before lengths were restored


class Simulator:
    r"""One character, one step at a time  [DROP Algorithm 1].

    Args      prior : anything with `sample(state, n, rng)` and `mode(state)`; None is §8.3's rag doll
              obstacles : what it may stand on; weights : Weights; samples : n of Eq. 9; iterations : local/global
              start : "mode" (Algorithm 1) or "y": where the solver starts; a rag doll starts at y
              prior_at_first : E_kin also in the first iteration, where Algorithm 1 has it 0
              contact, limits, correction : §8.3's switches; limits may be another projection (x, twist) -> x_r
              restore : bone lengths made exact at the end of a step
              springs : ((joint, joint, length [m], weight), …), such as a stiff knee's
    ASSUMED   `restore`; only the part of the root wrench above WRENCH_LIMIT is corrected (§8.5: down to mocap's range);
              inside the limits E_3, whose p is x, takes part in the matrix only where the prior alone drives: in three
              iterations its drag holds a walker at the prior's mode, but freezes a rag doll or a led body
    Test      tests/test_drop.py::test_step_solves_equation_4, ::test_never_nan, ::test_switches
    """

    def __init__(self, prior=None, obstacles=(Plane(),), weights=None, samples=16, iterations=ITERATIONS, start="mode",
                 prior_at_first=False, contact=True, limits=project_range_of_motion, correction=True, restore=True,
                 springs=()):  # fmt: skip
        if start not in ("mode", "y"):
            raise ValueError(f"start {start!r}: valid are mode, y")
        self.prior, self.obstacles, self.w = prior, tuple(obstacles), weights or Weights()
        self.samples, self.iterations, self.start, self.prior_at_first = samples, iterations, start, prior_at_first
        self.contact, self.limits, self.correction, self.restore = contact, limits, correction, restore
        ends = np.array([[a, b] for a, b, _, _ in springs], int).reshape(-1, 2)
        self.A = np.concatenate([DIFFERENCE, np.eye(N)[ends[:, 0]] - np.eye(N)[ends[:, 1]]])
        self.lengths = np.concatenate([LENGTHS, [s[2] for s in springs]])
        self.w_rigid = np.concatenate([np.full(N - 1, self.w.rigidity), [s[3] for s in springs]])
        self.JT = self.A.T * self.w_rigid
        self._inverses = {}

    # ---- the global step

    def inverse(self, active, prior, outside=False, pinned=(), direction=False):
        r"""The inverse of Eq. 4's matrix, times 1/h², for one set of active energies; computed once and kept.

        Equation  [DROP Eq. 4] M/h² + Σ_i w_i A_iᵀ A_i, divided by 1/h²
        Why       positive definite with a condition number below 100, so that an explicit inverse is as accurate as two
                  triangular solves and several times faster for 22 rows; x, y (and z without Eq. 16) share it
        Args      active : (22,) bool; prior, outside : bool, E_kin and E_3 take part; pinned : joints; direction :
                  bool, the rank-one term of Eq. 16
        Returns   (22, 22)
        """
        key = active.tobytes(), prior, outside, tuple(pinned), direction
        if key not in self._inverses:
            if len(self._inverses) > 5000:
                self._inverses.clear()
            w = self.w
            diagonal = 1.0 + w.contact * active + w.range_of_motion * outside + w.prior * prior
            diagonal[list(pinned)] += w.constraint
            H = np.diag(diagonal) + self.JT @ self.A + (w.direction * np.ones((N, N)) if direction else 0.0)
            self._inverses[key] = cho_solve(cho_factor(H), np.eye(N))
        return self._inverses[key]

    def step(self, state, force=None, v_tar=None, pins=None, rng=None):
        r"""One step of Algorithm 1.

        Args      state : State; force : (22, 3) [N] or None; v_tar : (2,) [m/s] of Eq. 16; pins : {joint: (3,)} held by
                  E_constr = (w/2) ‖x_j − x_tar‖² (§8.2); rng : Generator for the samples
        Returns   State, Outcome
        Raises    ValueError: a force, target or prior's output that is not finite or has a wrong shape
        """
        x_t, v_t = state.x, state.v
        force = np.zeros((N, 3)) if force is None else _checked(force, (N, 3), "force")
        v_tar = None if v_tar is None else _checked(v_tar, (2,), "v_tar")
        pins = {} if pins is None else {int(j): _checked(p, (3,), f"pin of joint {j}") for j, p in pins.items()}
        pinned = tuple(sorted(pins))
        targets = np.array([pins[j] for j in pinned]).reshape(-1, 3)
        w, y = self.w, inertial_target(x_t, v_t, force)

        here = gaps(x_t, self.obstacles)
        samples, rotations = self._ask(state, rng)
        if len(samples):  # row 0 is the mode, which belongs to the set: so E_kin = 0 in the first iteration
            x, choice = (samples[0] if self.start == "mode" else y), 0
        else:  # a rag doll: no prior, or one without an answer here
            x, choice = y.copy(), -1
            if self.contact:  # else what is held falls with its bones, which then feel no gravity
                active, x_c = project_contact(y, x_t, self.obstacles, here)
                x[active] = x_c[active]
            x[list(pinned)] = targets
        twist_of = {-1: twists(state.quat)}

        def twist():
            if choice not in twist_of:
                twist_of[choice] = twists(rotations[choice])
            return twist_of[choice]

        for iteration in range(self.iterations):
            rhs = y + self.JT @ project_rigidity(x, self.A, self.lengths)
            active = np.zeros(N, bool)
            if self.contact:
                active, x_c = project_contact(x, x_t, self.obstacles, here)
                rhs += (w.contact * active)[:, None] * x_c
            if len(samples):
                choice = project_prior(x, samples)
            outside = (
                False  # inside the limits p is x: a drag towards the last iterate, which freezes limp or led bodies
            )
            if self.limits:
                x_r = self.limits(x, twist())
                outside = x_r is not x or (len(samples) > 0 and v_tar is None and not pins)
                rhs += w.range_of_motion * outside * x_r
            kinematic = len(samples) > 0 and (iteration > 0 or self.prior_at_first or self.start == "y")
            if kinematic:
                rhs += w.prior * samples[choice]
            for j, target in zip(pinned, targets, strict=True):
                rhs[j] += w.constraint * target
            x = self.inverse(active, kinematic, outside, pinned) @ rhs
            if v_tar is not None:  # Eq. 16 acts on x and y only
                along = rhs[:, :2] + w.direction * (x_t[:, :2].sum(axis=0) + STEP * N * v_tar)
                x[:, :2] = self.inverse(active, kinematic, outside, pinned, True) @ along
        x_pd = x

        B, a = wrench_map(x_t, v_t, force)
        points, normals = self.touching(x_t, here)
        F, edges = friction_basis(points, normals, state.com)
        c, residual = contact_forces(F, B @ x.ravel() - a)
        wrench_pd = wrench = float(np.sqrt(residual @ residual))
        if self.correction and choice >= 0 and wrench_pd > WRENCH_LIMIT:  # only what is above the limit
            x = soft_correction(x, B, residual * (1.0 - WRENCH_LIMIT / wrench_pd))
            wrench = float(np.linalg.norm(residual + B @ (x - x_pd).ravel()))
        bone_error = float(np.abs(_lengths(x) / LENGTHS - 1).max())
        if self.restore:
            anchor = 1.0 + w.contact * active
            anchor[list(pinned)] += w.constraint
            x = restore_bones(x, anchor)

        solved = swing_twist(x, twist())
        quat = Rotation.from_matrix(solved[0]).as_quat(scalar_first=True)
        x_kin = samples[choice] if choice >= 0 else None
        energies = self.energies(x, y, x_t, x_kin, twist(), v_tar, pins, solved, here)
        forces = (c[: len(edges), None] * edges).reshape(-1, EDGES, 3).sum(axis=1)
        own = state.v_own if x_kin is None else (x_kin - x_t) / STEP
        found = Outcome(energies, active, choice, wrench_pd, wrench, points, forces, bone_error)
        return State(x, (x - x_t) / STEP, quat, state.frame + 1, own), found

    def touching(self, x, here=None):
        """Points (P, 3) on the spheres' surfaces that may carry a contact force, and the normals there."""
        gap, normal = here or gaps(x, self.obstacles)
        near = np.flatnonzero(gap < WRENCH_MARGIN) if self.contact else np.zeros(0, int)
        return x[near] - RADII[near, None] * normal[near], normal[near]

    def energies(self, x, y, x_t, x_kin, twist, v_tar=None, pins=None, solved=None, here=None):
        """Every term of Eq. 1 at x [J], by name.  Test: tests/test_drop.py::test_step_solves_equation_4"""
        w, unit = self.w, 1.0 / STEP**2
        square = lambda r: float(np.sum(r * r))  # noqa: E731
        active, x_c = project_contact(x, x_t, self.obstacles, here)
        if self.limits in (None, project_range_of_motion):  # measured even where it is switched off
            x_r = project_range_of_motion(x, twist, solved)
        else:
            x_r = self.limits(x, twist)
        out = {
            "momentum": 0.5 * unit * square(x - y),
            "rigidity": spring(self.w_rigid * unit, self.A, x, project_rigidity(x, self.A, self.lengths))[0],
            "contact": 0.5 * w.contact * unit * square((x - x_c)[active]),
            "range_of_motion": 0.5 * w.range_of_motion * unit * square(x - x_r),
            "prior": 0.0 if x_kin is None else 0.5 * w.prior * unit * square(x - x_kin),
        }
        if v_tar is not None:
            out["direction"] = direction(w.direction, x, x_t, v_tar)[0]
        if pins:
            out["constraint"] = 0.5 * w.constraint * unit * sum(square(x[j] - p) for j, p in pins.items())
        return out

    def _ask(self, state, rng):
        """Mode and samples of the prior in one array, mode first; empty where the prior has nothing to say."""
        nothing = np.zeros((0, N, 3)), np.zeros((0, N, 4))
        if self.prior is None:
            return nothing
        samples, rotations = self.prior.sample(state, self.samples, rng)
        samples, rotations = np.asarray(samples, float), np.asarray(rotations, float)
        if len(samples) == 0:
            return nothing
        mode, turned = self.prior.mode(state)
        name = f"prior {type(self.prior).__name__}"
        _checked(samples, (len(samples), N, 3), f"{name}: positions")
        _checked(rotations, (len(samples), N, 4), f"{name}: rotations")
        _checked(mode, (N, 3), f"{name}: mode's positions"), _checked(turned, (N, 4), f"{name}: mode's rotations")
        return np.concatenate([mode[None], samples]), np.concatenate([turned[None], rotations])

    def begin(self, x, quat, v=None):
        """A State at rest or with velocities v, lifted until no sphere is in an obstacle.

        Test: tests/test_drop.py::test_starting_under_the_floor"""
        x, v = np.array(x, float), np.zeros((N, 3)) if v is None else np.array(v, float)
        for _ in range(200):
            gap = gaps(x, self.obstacles)[0].min()
            if gap >= -1e-3:
                break
            x[:, 2] += max(-gap, 1e-3)
        return State(x, v, np.array(quat, float), 0, v.copy())


def restore_bones(x, anchor, iterations=3):
    r"""Bones at their rest lengths, by the nearest change of positions.

    Equation  min Σ_j a_j ‖x'_j − x_j‖² subject to ‖A x'‖ = l, by Newton steps on the constraint (the fast projection of
              Goldenthal et al. 2007): A⁻¹ is diag(1/a), x ← x − A⁻¹ Jᵀ (J A⁻¹ Jᵀ)⁻¹ (‖bones‖ − l), J the bones'
              directions. What is left after the last step goes by forward kinematics along the bones
    Why       the change is a sum of forces along bones: with equal a it keeps linear and angular momentum
    ASSUMED   the paper relies on strong springs alone.  `anchor` is 1 a particle, more for those that contacts hold
    Args      x : (22, 3); anchor : (22,) > 0
    Returns   (22, 3)
    Test      tests/test_drop.py::test_restore_bones
    """
    # J A⁻¹ Jᵀ couples two bones through the joint they share: (D A⁻¹ Dᵀ) ∘ (d dᵀ), D the differences
    coupling = (DIFFERENCE / anchor) @ DIFFERENCE.T
    for _ in range(iterations):
        bones = DIFFERENCE @ x
        length = np.sqrt(np.einsum("ij,ij->i", bones, bones))
        error = length - LENGTHS
        if np.abs(error).max() < 1e-6 or length.min() < 1e-3:
            break
        d = bones / length[:, None]
        lam = np.linalg.solve(coupling * (d @ d.T) + 1e-9 * _EYE[1:, 1:], error)
        x = x - (DIFFERENCE.T @ (lam[:, None] * d)) / anchor[:, None]
    out = PATH @ project_rigidity(x)
    return out + anchor @ (x - out) / anchor.sum()


def _lengths(x):
    bones = DIFFERENCE @ x
    return np.sqrt(np.einsum("ij,ij->i", bones, bones))


def _checked(value, shape, name):
    value = np.asarray(value, float)
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}; it must be {shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name} holds NaN or infinity")
    return value


def main(argv=None):
    """python drop.py DEMO: the demonstrations of §8 (drop_demos.py).  Test: tests/test_drop_demos.py::test_command"""
    import drop_demos

    return drop_demos.main(argv)


if __name__ == "__main__":
    run_main(main)

r"""DROP's simulator: a projective-dynamics human with a motion prior  [DROP §4 to §7].

Jiang, Won, Ye, Liu, "DROP: Dynamics Responses from Human Motion Prior and Projective Dynamics", ACM TOG 42(6), 2023.

    prior ──► samples X̂, mode μ0 ──► 3 × ( local: project every energy on its own    Eqs. 5, 6, 7, 10
              Eqs. 8, 9               global: one linear solve                 )    Eq. 4
          ──► soft correction of the root wrench (Eqs. 11 to 14) ──► bone lengths restored ──► x, v (Eq. 2), q (§7)

The character is 22 unit point masses at SMPL's joints 0 to 21 (`JOINTS`); bones are springs.  SI units, z up, x
forward, y left, floor at z = 0; world frame unless said otherwise; quaternions w, x, y, z.  The masses sum to 22 kg,
not to a person's 70: a push of F newtons here moves the body as one of 3.2 F would move an adult.

    python -m drop DEMO [--prior nearest] [--motion builtin] [--seed 0] [--png OUT | --video OUT]

The character's body is in drop/body.py (§4, §7), motion priors in drop/prior.py (§5), demonstrations in drop/demos.py
(§8).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from drop.body import (
    DIFFERENCE,
    EYE3,
    GRAVITY,
    JOINTS,
    LENGTHS,
    PATH,
    RADII,
    SKEW,
    STEP,
    N,
    align,
    checked,
    checked_unit,
    nearest_in_range,
    project_range_of_motion,
    swing_twist,
    twists,
)
from human import quat_conj, quat_rotate

ITERATIONS = 3  # of local and global steps, §5

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
    Test      tests/drop/test_drop.py::test_energy_gradients
    """
    r = A @ x - p
    wr = np.broadcast_to(w, len(r))[:, None] * r
    return 0.5 * float(np.sum(wr * r)), A.T @ wr


def momentum(x, y, h=STEP):
    r"""The momentum energy, value and gradient, M = I.

    Equation  [DROP Eq. 1] E_mom = 1/(2h²) (x − y)ᵀ M (x − y)
    Args      x : (22, 3); y : (22, 3) of `inertial_target`
    Test      tests/drop/test_drop.py::test_energy_gradients, ::test_free_fall
    """
    return 0.5 / h**2 * float(np.sum((x - y) ** 2)), (x - y) / h**2


def inertial_target(x_t, v_t, force, h=STEP):
    r"""Where the particles go on their own.

    Equation  [DROP Eq. 1] y = x_t + h v_t + h² M⁻¹ f_t + h² g
    Args      x_t, v_t, force : (22, 3) [m], [m/s], [N]
    Test      tests/drop/test_drop.py::test_free_fall
    """
    return x_t + h * v_t + h * h * (force + GRAVITY)


def project_rigidity(x, A=DIFFERENCE, lengths=LENGTHS):
    r"""Bones at their rest lengths, in the directions they have.

    Equation  [DROP Eq. 5] d_i = l_i (A x)_i / ‖(A x)_i‖
    Args      x : (22, 3); A : (K, 22) differences; lengths : (K,) [m]
    Returns   (K, 3); a bone without a direction points up
    Test      tests/drop/test_drop.py::test_projections_are_nearest_and_idempotent
    """
    bones = A @ x
    norm = np.sqrt(np.einsum("ij,ij->i", bones, bones))
    if norm.min() < 1e-9:
        bones[norm < 1e-9], norm = [0.0, 0.0, 1.0], np.where(norm < 1e-9, 1.0, norm)
    return bones * (lengths / norm)[:, None]


@dataclass(frozen=True)
class Plane:
    """The half space normal · x ≥ offset is free; both are divided by the normal's length.

    Test: tests/drop/test_drop.py::test_obstacles, ::test_bad_obstacles"""

    normal: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset: float = 0.0

    def __post_init__(self):
        normal = checked(self.normal, (3,), "Plane: normal")
        length = np.sqrt(normal @ normal)
        if not (length > 1e-9 and np.isfinite(self.offset)):
            raise ValueError(f"Plane: normal {self.normal} and offset {self.offset} are no half space")
        object.__setattr__(self, "normal", normal / length)
        object.__setattr__(self, "offset", float(self.offset) / length)

    def distance(self, x):
        """Signed distance (K,) and outward normal (K, 3) of points (K, 3)."""
        return x @ self.normal - self.offset, np.broadcast_to(self.normal, x.shape)


@dataclass(frozen=True)
class Spheres:
    """Solid spheres, such as another character's.

    Test: tests/drop/test_drop.py::test_obstacles, ::test_contact_slips"""

    centre: np.ndarray  # (S, 3)
    radius: np.ndarray  # (S,)
    slippery: bool = False  # contacts with them do not stick (`project_contact`)

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
    """A solid box.  Test: tests/drop/test_drop.py::test_obstacles, ::test_standing_on_a_box"""

    centre: np.ndarray  # (3,)
    half: np.ndarray  # (3,) half sizes
    quat: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    def __post_init__(self):
        object.__setattr__(self, "quat", checked_unit(checked(self.quat, (4,), "Box: quat")[None], "Box: quat")[0])

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
# swinging foot that grazes the floor by a millimetre would be nailed to it.  (`Simulator.begin` lifts a body out of the
# floor at once; a State made without it, 0.7 m under, takes 0.8 s to come up.)
CONTACT_MARGIN, PUSH_OUT, SLIP = 0.005, 0.03, 1.0
LEAVING = 0.001  # m a step, ASSUMED: a particle that the solver lifts faster than that lets go; nothing glues it down


def gaps(x, obstacles, radii=RADII):
    r"""Distance of every sphere's surface to the nearest obstacle, and the normal there.

    Returns   gap (22,) [m], negative in penetration; normal (22, 3)
    Test      tests/drop/test_drop.py::test_obstacles
    """
    if not obstacles:
        raise ValueError("no obstacles; one Plane is the least, however far below")
    gap, normal = obstacles[0].distance(x)
    for other in obstacles[1:]:
        g, n = other.distance(x)
        normal = np.where((g < gap)[:, None], n, normal)
        gap = np.minimum(g, gap)
    return gap - radii, normal


def slips(x, obstacles, radii=RADII):
    """Which particles (22,) have a slippery obstacle nearest.

    Why       Eq. 6 holds a contact at its place in the world.  That is static friction of what stands still; another
              person moves, and both would be nailed to where they touched
    Test      tests/drop/test_drop.py::test_contact_slips"""
    slippery = [o for o in obstacles if getattr(o, "slippery", False)]
    if not slippery:
        return np.zeros(len(x), bool)
    return gaps(x, slippery, radii)[0] <= gaps(x, obstacles, radii)[0]


def project_contact(x, x_t, obstacles, here=None):
    r"""Which particles are about to penetrate, and where they must stay.

    Equation  [DROP Eq. 6] S: gap of the solver's x below the margin; x_c = x_t moved along the normal to the nearest
              place without penetration: tangentially it is x_t, so contacts stick (static friction)
    ASSUMED   the margin, the largest push, the speed that static friction holds (CONTACT_MARGIN, PUSH_OUT, SLIP); what
              is slippery (another person) has no friction: tangentially x_c is x (`slips`)
    Args      x, x_t : (22, 3) the solver's state and the current one; obstacles : list with `distance`;
              here : gaps(x_t, obstacles), if they are known already
    Returns   active : (22,) bool, the diagonal of S; x_c : (22, 3)
    Test      tests/drop/test_drop.py::test_project_contact
    """
    gap_t, normal = here or gaps(x_t, obstacles)
    move = x - x_t
    along = np.einsum("ij,ij->i", move, normal)
    leaves = (gap_t >= CONTACT_MARGIN) | (along > LEAVING)
    active = gaps(x, obstacles)[0] < np.where(leaves, 0.0, CONTACT_MARGIN)
    move = move - along[:, None] * normal
    length = np.sqrt(np.einsum("ij,ij->i", move, move))
    slide = np.maximum(0.0, 1.0 - SLIP * STEP / np.maximum(length, 1e-9))
    slide[slips(x_t, obstacles)] = 1.0
    out = np.maximum(np.minimum(np.maximum(-gap_t, 0.0), PUSH_OUT), along)  # nothing holds it down: no glue
    return active, x_t + out[:, None] * normal + slide[:, None] * move


def project_prior(x, samples):
    r"""The nearest sample of the prior.

    Equation  [DROP Eq. 10] x_kin = argmin over X̂ of ‖x − x_kin‖²
    Args      x : (22, 3); samples : (n, 22, 3)
    Returns   its number
    Test      tests/drop/test_drop.py::test_project_prior
    """
    d = (samples - x).reshape(len(samples), -1)
    return int(np.einsum("ij,ij->i", d, d).argmin())


def project_friction(x, x_t):
    r"""The pose of the last frame, laid on the solver's state as a rigid body.

    Equation  E_fric = (w/2) min over rigid motions (R, c) of ‖x − (R (x_t − x̄_t) + c)‖²: c = x̄, R by `align` (Kabsch)
    Why       a limp body's joints resist being bent; without that one that lies on the floor never comes to rest.  The
              pull has no net force and no torque, so that momentum is kept and a fall through the air is not slowed
    ASSUMED   the paper's rag doll has no such term
    Args      x, x_t : (22, 3) the solver's state and the current one
    Returns   (22, 3)
    Test      tests/drop/test_drop.py::test_friction_of_limp_joints
    """
    centre, there = x.mean(axis=0), x_t - x_t.mean(axis=0)
    return there @ align(there[None], (x - centre)[None])[0].T + centre


REST = 0.15, 0.45  # m/s, ASSUMED: mean and largest speed of the particles of a limp body that comes to rest
TRUNK = np.array([n.startswith(("pelvis", "hip", "spine", "neck", "collar", "head", "shoulder")) for n in JOINTS])


def at_rest(v_t, gap):
    """Does a limp body lie: slow in all its particles, its trunk on something?

    Args      v_t : (22, 3) [m/s]; gap : (22,) of `gaps` [m]
    Test      tests/drop/test_drop.py::test_who_lies_lies_still"""
    speed = np.sqrt(np.einsum("ij,ij->i", v_t, v_t))
    return bool(speed.mean() < REST[0] and speed.max() < REST[1] and gap[TRUNK].min() < CONTACT_MARGIN)


def direction(w, x, x_t, v_tar, h=STEP):
    r"""Centre-of-mass velocity, value and gradient; quadratic as it stands, no projection.

    Equation  [DROP Eq. 16] E_com = (w/2) ‖Σ_j m_j (x_j − x_{j,t})/h − v_tar Σ_j m_j‖²
    ASSUMED   horizontal only: a vertical target of 0 would hold the centre of mass at one height
    Args      x, x_t : (22, 3); v_tar : (2,) [m/s]
    Test      tests/drop/test_drop.py::test_energy_gradients
    """
    r = np.append(((x - x_t).sum(axis=0) / h)[:2] - len(x) * np.asarray(v_tar), 0.0)
    return 0.5 * w * float(r @ r), np.broadcast_to(w / h * r, x.shape).copy()


# ------------------------------------------------------------------------------------ §6: root wrench

MU, EDGES = 0.8, 4  # ASSUMED: Coulomb friction of a shoe, edges of the linearised cone (Eq. 11)
WRENCH_MARGIN = 0.03  # m, ASSUMED: a sphere this near to an obstacle may carry a contact force
# The root wrench that is left alone, ASSUMED: the torque of the body's weight on the part of a foot that the model
# lacks, from the ball's sphere to the tip of the toes (0.28 of the foot's length, mocap.gait.Body).  Up to this much of
# a push is borne by nothing, so it must be small.  Built-in walks have medians of 4 to 8 themselves, runs of 14 to 20.
WRENCH_LIMIT = N * 9.81 * 0.28 * 0.152 * 1.75  # 16 N m
# w_p of Eq. 14, ASSUMED: of someone standing it removes 95 % of a residual force, 81 % of a torque that pitches or
# rolls, 20 % of one that turns about the vertical
WRENCH_WEIGHT = 1e-6


def momentum_rate(x, x_t, v_t, h=STEP):
    r"""Change of linear and angular momentum, M = I.

    Equation  [DROP Eq. 12] Ṗ = (1/h) Σ_j m_j ((x_j − x_{j,t})/h − v_{j,t})
              [DROP Eq. 13] L̇ = (1/h) Σ_j m_j [r_j]_× ((x_j − x_{j,t})/h − v_{j,t}), r_j from the centre of mass of x_t
    Args      x, x_t : (22, 3); v_t : (22, 3)
    Returns   (6,) [N], [N m]
    Test      tests/drop/test_drop.py::test_momentum_rate
    """
    a = ((x - x_t) / h - v_t) / h
    r = x_t - x_t.mean(axis=0)
    return np.concatenate([a.sum(axis=0), np.cross(r, a).sum(axis=0)])


def wrench_map(x_t, v_t, force, h=STEP):
    r"""The wrench that contacts must supply, as an affine function of the next positions.

    Equation  [DROP §6] b = (Ṗ, L̇) − gravity − external forces = B x − a
    Args      x_t, v_t, force : (22, 3)
    Returns   B (6, 66) for x raveled joint by joint; a (6,)
    Test      tests/drop/test_drop.py::test_wrench_map
    """
    r = x_t - x_t.mean(axis=0)
    B = np.zeros((6, N, 3))
    B[[0, 1, 2], :, [0, 1, 2]] = 1.0 / h**2
    B[3:] = np.swapaxes((r @ SKEW).reshape(N, 3, 3), 0, 1) / h**2
    B = B.reshape(6, -1)
    free = x_t + h * v_t + h * h * (force + GRAVITY)  # where B x − a is 0: Eq. 1's y
    return B, B @ free.ravel()


def friction_basis(points, normals, com, mu=MU, edges=EDGES):
    r"""Contact wrenches about the centre of mass, one column an edge of a linearised friction cone.

    Equation  [DROP Eq. 11] F = [d; (p − com) × d] over the edges d of each contact p
    Args      points, normals : (P, 3); com : (3,); mu [-]; edges : a cone
    Returns   F (6, P edges); d (P edges, 3) unit length
    Test      tests/drop/test_drop.py::test_friction_basis
    """
    across = np.where(np.abs(normals[:, :1]) < 0.9, EYE3[:1], EYE3[1:2])
    s = np.matmul((normals @ SKEW).reshape(-1, 3, 3), across[:, :, None])[:, :, 0]
    s /= np.sqrt(np.einsum("ij,ij->i", s, s))[:, None]
    t = np.matmul((normals @ SKEW).reshape(-1, 3, 3), s[:, :, None])[:, :, 0]
    angle = 2 * np.pi * np.arange(edges) / edges
    d = normals[:, None] + mu * (np.cos(angle)[:, None] * s[:, None] + np.sin(angle)[:, None] * t[:, None])
    d = (d / np.sqrt(1 + mu * mu)).reshape(-1, 3)
    arm = (np.repeat(points - com, edges, axis=0) @ SKEW).reshape(-1, 3, 3)
    return np.concatenate([d, np.matmul(arm, d[:, :, None])[:, :, 0]], axis=1).T, d


def contact_forces(F, b):
    r"""The contact forces that explain b best.

    Equation  [DROP Eq. 11] min_c ‖F c − b‖² subject to c ≥ 0, by non-negative least squares
    Returns   c (K,); residual b − F c (6,): the fictitious root wrench, whose norm is the metric
    Test      tests/drop/test_drop.py::test_nnls_against_brute_force
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
    Test      tests/drop/test_drop.py::test_soft_correction_both_ways
    """
    lam = np.linalg.solve(B @ B.T + np.eye(6) / weight, residual)
    return x_pd - (B.T @ lam).reshape(x_pd.shape)


def soft_correction_kkt(x_pd, B, residual, weight=WRENCH_WEIGHT):
    r"""Eq. 14 as §6 solves it: the whole KKT system in (x, ε, λ).

    Equation  [DROP Eq. 14] [[2I, 0, Bᵀ], [0, 2 w_p I, −I], [B, −I, 0]] (x, ε, λ) = (2 x_pd, 0, a + F c)
    Returns   (22, 3), (6,) ε
    Test      tests/drop/test_drop.py::test_soft_correction_both_ways
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
    lead   : (2,) the velocity that Eq. 16 asks for in this step, for priors to read; None where nothing leads
    """

    x: np.ndarray
    v: np.ndarray
    quat: np.ndarray
    frame: int = 0
    v_own: np.ndarray | None = None
    lead: np.ndarray | None = None

    @property
    def com(self):
        """Centre of mass (3,)."""
        return self.x.mean(axis=0)


@dataclass(frozen=True)
class Weights:
    r"""Weights of the energies, in units of M/h² = 900 N/m; of `direction`, whose residual is a momentum, in 1/kg.

    inside is E_3's weight while the pose is inside its limits, where p = x: a drag towards the last iterate, at first
    the prior's mode.  It counts where the prior alone drives (neither v_tar nor pins).  friction and stiction are of a
    limp body's joints, moving and at rest.
    ASSUMED   §7 gives 1, 3, 3, 3 without a scale.  REPRODUCE.md has the tables these were chosen from
    """

    rigidity: float = 3.0
    contact: float = 9.0
    range_of_motion: float = 9.0
    prior: float = 9.0
    direction: float = 0.3
    constraint: float = 30.0
    inside: float = 1.0
    friction: float = 1.0
    stiction: float = 300.0


@dataclass
class Outcome:
    """What a step found out beside the state; `energies` in joules by term."""

    energies: dict
    active: np.ndarray  # (22,) bool, contacts
    sample: int  # chosen, 0 is the mode; -1 without a prior
    wrench_pd: float  # ‖b − F c‖ of the solver's x, before correction and restored bones [N, N m]
    wrench: float  # of the motion itself, with the same c
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
              wrench_limit : the root wrench below which nothing is corrected [N, N m]; wrench_weight : w_p of Eq. 14
    ASSUMED   `restore`; only the part of the root wrench above `wrench_limit` is corrected (§8.5: down to mocap's
              range); a limp body (no samples) has joint limits, whatever `limits` is
              (`nearest_in_range`), friction in its joints (`project_friction`), and once it lies at rest (`at_rest`)
              stays where it is until something moves it
    Raises    ValueError: a setting out of its range
    Test      tests/drop/test_drop.py::test_step_solves_equation_4, ::test_never_nan, ::test_switches,
              ::test_bad_settings
    """

    def __init__(self, prior=None, obstacles=(Plane(),), weights=None, samples=16, iterations=ITERATIONS, start="mode",
                 prior_at_first=False, contact=True, limits=project_range_of_motion, correction=True, restore=True,
                 springs=(), wrench_limit=WRENCH_LIMIT, wrench_weight=WRENCH_WEIGHT):  # fmt: skip
        if start not in ("mode", "y"):
            raise ValueError(f"start {start!r}: valid are mode, y")
        for name, value in (("samples", samples), ("iterations", iterations)):
            if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{name} {value!r}: it must be a whole number of 1 or more")
        for a, b, length, weight in springs:
            if not (0 <= a < N and 0 <= b < N and a != b and 0 <= length < np.inf and 0 <= weight < np.inf):
                raise ValueError(f"spring {(a, b, length, weight)}: two joints of 0 to {N - 1}, a length and a weight")
        self.prior, self.obstacles, self.w = prior, tuple(obstacles), weights or Weights()
        if bad := [f"{k} {v}" for k, v in vars(self.w).items() if not 0 <= v < np.inf]:
            raise ValueError(f"weights: {', '.join(bad)}; they must be 0 or more, and finite")
        if not wrench_limit >= 0:
            raise ValueError(f"wrench_limit {wrench_limit}: it must be 0 or more")
        if not 0 < wrench_weight < np.inf:
            raise ValueError(f"wrench_weight {wrench_weight}: it must be above 0, and finite")
        gaps(np.zeros((N, 3)), self.obstacles)  # complains if there are none
        self.wrench_limit, self.wrench_weight = wrench_limit, wrench_weight
        self.samples, self.iterations, self.start, self.prior_at_first = samples, iterations, start, prior_at_first
        self.contact, self.limits, self.correction, self.restore = contact, limits, correction, restore
        ends = np.array([[a, b] for a, b, _, _ in springs], int).reshape(-1, 2)
        self.A = np.concatenate([DIFFERENCE, np.eye(N)[ends[:, 0]] - np.eye(N)[ends[:, 1]]])
        self.lengths = np.concatenate([LENGTHS, [s[2] for s in springs]])
        self.w_rigid = np.concatenate([np.full(N - 1, self.w.rigidity), [s[3] for s in springs]])
        self.JT = self.A.T * self.w_rigid
        self._inverses = {}

    # ---- the global step

    def inverse(self, active, prior, limited=0.0, pinned=(), direction=False, friction=0.0):
        r"""The inverse of Eq. 4's matrix, times 1/h², for one set of active energies; computed once and kept.

        Equation  [DROP Eq. 4] M/h² + Σ_i w_i A_iᵀ A_i, divided by 1/h²
        Why       positive definite with a condition number below 100, so that an explicit inverse is as accurate as two
                  triangular solves and several times faster for 22 rows; x, y (and z without Eq. 16) share it
        Args      active : (22,) bool; prior, limited, limp : bool, E_kin, E_3 and E_fric take part; pinned :
                  joints; direction : bool, the rank-one term of Eq. 16
        Returns   (22, 22)
        """
        key = active.tobytes(), prior, limited, tuple(pinned), direction, friction
        if key not in self._inverses:
            if len(self._inverses) > 5000:
                self._inverses.clear()
            w = self.w
            diagonal = 1.0 + w.contact * active + limited + w.prior * prior + friction
            diagonal[list(pinned)] += w.constraint
            H = np.diag(diagonal) + self.JT @ self.A + (w.direction * np.ones((N, N)) if direction else 0.0)
            self._inverses[key] = cho_solve(cho_factor(H), np.eye(N))
        return self._inverses[key]

    def step(self, state, force=None, v_tar=None, pins=None, rng=None):
        r"""One step of Algorithm 1.

        Args      state : State; force : (22, 3) [N] or None; v_tar : (2,) [m/s] of Eq. 16, nothing to a body without
                  samples; pins : {joint: (3,)} held by E_constr = (w/2) ‖x_j − x_tar‖² (§8.2); rng : Generator for them
        Returns   State, Outcome
        Raises    ValueError: a state, force, target or prior's output that is not finite or has a wrong shape
        """
        x_t, v_t = checked(state.x, (N, 3), "state's positions"), checked(state.v, (N, 3), "state's velocities")
        checked_unit(checked(state.quat, (N, 4), "state's rotations"), "state's rotations")
        force = np.zeros((N, 3)) if force is None else checked(force, (N, 3), "force")
        v_tar = None if v_tar is None else checked(v_tar, (2,), "v_tar")
        pins = {} if pins is None else {int(j): checked(p, (3,), f"pin of joint {j}") for j, p in pins.items()}
        pinned = tuple(sorted(pins))
        if pinned and not 0 <= pinned[0] <= pinned[-1] < N:
            raise ValueError(f"pins of joints {pinned}: joints are 0 to {N - 1}")
        targets = np.array([pins[j] for j in pinned]).reshape(-1, 3)
        w, y = self.w, inertial_target(x_t, v_t, force)

        here = gaps(x_t, self.obstacles)
        samples, rotations = self._ask(state if v_tar is None else replace(state, lead=v_tar), rng)
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

        limp = not len(samples)
        v_tar = None if limp else v_tar  # who is carried by no motion is led nowhere: dragged, he would never rest
        slow = limp and at_rest(v_t, here[0])
        friction = (w.stiction if slow else w.friction) if limp else 0.0
        inside = w.inside if not limp and v_tar is None and not pins else 0.0
        for iteration in range(self.iterations):
            rhs = y + self.JT @ project_rigidity(x, self.A, self.lengths)
            active = np.zeros(N, bool)
            if self.contact:
                active, x_c = project_contact(x, x_t, self.obstacles, here)
                rhs += (w.contact * active)[:, None] * x_c
            if len(samples):
                choice = project_prior(x, samples)
            limited = 0.0
            if self.limits and not slow:
                x_r = (nearest_in_range if limp else self.limits)(x, twist())
                limited = w.range_of_motion if np.abs(x_r - x).max() > 1e-9 else inside
                rhs += limited * x_r
            if friction:
                rhs += friction * (x_t if slow else project_friction(x, x_t))
            kinematic = not limp and (iteration > 0 or self.prior_at_first or self.start == "y")
            if kinematic:
                rhs += w.prior * samples[choice]
            for j, target in zip(pinned, targets, strict=True):
                rhs[j] += w.constraint * target
            x = self.inverse(active, kinematic, limited, pinned, friction=friction) @ rhs
            if v_tar is not None:  # Eq. 16 acts on x and y only
                along = rhs[:, :2] + w.direction * (x_t[:, :2].sum(axis=0) + STEP * N * v_tar)
                x[:, :2] = self.inverse(active, kinematic, limited, pinned, True, friction) @ along
        x_pd = x

        B, a = wrench_map(x_t, v_t, force)
        points, normals = self.touching(x_t, here)
        F, edges = friction_basis(points, normals, state.com)
        c, residual = contact_forces(F, B @ x.ravel() - a)
        wrench_pd = float(np.sqrt(residual @ residual))
        correct = self.correction and choice >= 0
        kept = residual * min(1.0, self.wrench_limit / max(wrench_pd, 1e-9))  # only what is above the limit is removed
        bone_error = float(np.abs(_lengths(x) / LENGTHS - 1).max())
        if self.restore:
            anchor = 1.0 + w.contact * active
            anchor[list(pinned)] += w.constraint
            wanted = (B, B @ x.ravel() - residual + kept, self.wrench_weight) if correct else None
            x = restore_bones(x, anchor, wanted)
        elif correct:
            x = soft_correction(x, B, residual - kept, self.wrench_weight)
        left = residual + B @ (x - x_pd).ravel()
        wrench = float(np.sqrt(left @ left))

        solved = swing_twist(x, twist())
        quat = Rotation.from_matrix(solved[0]).as_quat(scalar_first=True)
        x_kin = samples[choice] if choice >= 0 else None
        energies = self.energies(x, y, x_t, x_kin, twist(), v_tar, pins, solved, here)
        forces = (c[: len(edges), None] * edges).reshape(-1, EDGES, 3).sum(axis=1)
        own = state.v_own if x_kin is None else (x_kin - x_t) / STEP
        found = Outcome(energies, active, choice, wrench_pd, wrench, points, forces, bone_error)
        return State(x, (x - x_t) / STEP, quat, state.frame + 1, own), found

    def touching(self, x, here=None):
        """Points (P, 3) on the spheres' surfaces that may carry a contact force, and the normals there.

        Eq. 11's contacts do not depend on the switch of Eq. 6: without any, Eq. 14 would enforce free fall.
        Test: tests/drop/test_drop.py::test_without_contact_the_prior_still_walks"""
        gap, normal = here or gaps(x, self.obstacles)
        near = np.flatnonzero(gap < WRENCH_MARGIN)
        return x[near] - RADII[near, None] * normal[near], normal[near]

    def energies(self, x, y, x_t, x_kin, twist, v_tar=None, pins=None, solved=None, here=None):
        """Every term of Eq. 1 at x [J], by name.  Test: tests/drop/test_drop.py::test_step_solves_equation_4"""
        w, unit = self.w, 1.0 / STEP**2
        square = lambda r: float(np.sum(r * r))  # noqa: E731
        active, x_c = project_contact(x, x_t, self.obstacles, here)
        if x_kin is None and self.limits:
            x_r = nearest_in_range(x, twist, solved)
        elif self.limits in (None, project_range_of_motion):  # measured even where it is switched off
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
        if x_kin is None:
            out["friction"] = 0.5 * w.friction * unit * square(x - project_friction(x, x_t))
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
        name = f"prior {type(self.prior).__name__}"
        samples, rotations = _pair(self.prior.sample(state, self.samples, rng), f"{name}: sample")
        if samples.shape[:1] == rotations.shape[:1] == (0,):
            return nothing
        m = max(samples.shape[:1], (1,))[0]
        checked(samples, (m, N, 3), f"{name}: positions")
        checked_unit(checked(rotations, (m, N, 4), f"{name}: rotations"), f"{name}: rotations")
        mode, turned = _pair(self.prior.mode(state), f"{name}: mode")
        checked(mode, (N, 3), f"{name}: mode's positions")
        checked_unit(checked(turned, (N, 4), f"{name}: mode's rotations"), f"{name}: mode's rotations")
        return np.concatenate([mode[None], samples]), np.concatenate([turned[None], rotations])

    def begin(self, x, quat, v=None):
        """A State at rest or with velocities v, lifted until no sphere is in an obstacle.

        Test: tests/drop/test_drop.py::test_starting_under_the_floor"""
        x, quat = checked(x, (N, 3), "positions").copy(), checked(quat, (N, 4), "rotations")
        v = np.zeros((N, 3)) if v is None else checked(v, (N, 3), "velocities").copy()
        for _ in range(200):
            gap = gaps(x, self.obstacles)[0].min()
            if gap >= -1e-3:
                break
            x[:, 2] += max(-gap, 1e-3)
        return State(x, v, checked_unit(quat, "rotations").copy(), 0, v.copy())


def restore_bones(x_pd, anchor, wrench=None, iterations=3):
    r"""Bones at their rest lengths and less of the root wrench, by the nearest change of positions: both at once.

    Equation  [DROP Eq. 14, bones as constraints] min Σ_j a_j ‖x_j − x_pd,j‖² + w_p ‖B x − t‖² s.t. ‖D x‖ = l.  Newton
              steps on the constraints (the fast projection of Goldenthal et al. 2007; the wrench as a compliant one, as
              in XPBD, Macklin et al. 2016): with J the bones' directions, G = [J; B], C = diag(0, I/w_p), c = [‖D x‖ −
              l; B x − t]: δ = (G A⁻¹ Gᵀ + C)⁻¹ (c − C λ), λ ← λ + δ, x ← x − A⁻¹ Gᵀ δ.  What is left after the last
              step goes by forward kinematics along the bones
    Why       one after the other undo each other: restored bones brought back two thirds of the wrench that Eq. 14 had
              removed (REPRODUCE.md).  Without a wrench and with equal a the change is a sum of forces along bones and
              keeps momentum.  An anchor is an outside force on its particle: there the wrench's own term must hold it
    ASSUMED   the paper relies on strong springs alone.  `anchor` is 1 a particle, more for those that contacts hold
    Args      x_pd : (22, 3); anchor : (22,) > 0; wrench : None or (B (6, 66), t (6,), w_p)
    Returns   (22, 3)
    Test      tests/drop/test_drop.py::test_restore_bones, ::test_bones_and_wrench_together
    """
    k, x, weights = N - 1, x_pd, np.repeat(1.0 / anchor, 3)
    rows = k if wrench is None else k + 6
    G, c, lam, C = np.zeros((rows, 3 * N)), np.zeros(rows), np.zeros(rows), np.full(rows, 1e-9)
    if wrench is not None:
        B, wanted, weight = wrench
        G[k:], C[k:] = B, 1.0 / weight
    for i in range(iterations):
        bones = DIFFERENCE @ x
        length = np.sqrt(np.einsum("ij,ij->i", bones, bones))
        c[:k] = length - LENGTHS
        done = np.abs(c[:k]).max() < 1e-6 and (i > 0 or wrench is None)
        if done or length.min() < 1e-3:
            break
        G[:k] = (DIFFERENCE[:, :, None] * (bones / length[:, None])[:, None]).reshape(k, -1)
        if wrench is not None:
            c[k:] = B @ x.ravel() - wanted
        scaled = G * weights
        S = scaled @ G.T
        S[np.diag_indices(rows)] += C
        step = np.linalg.solve(S, c - C * lam)
        lam += step
        x = x - (step @ scaled).reshape(N, 3)
    out = PATH @ project_rigidity(x)
    return out + anchor @ (x - out) / anchor.sum()


def _lengths(x):
    bones = DIFFERENCE @ x
    return np.sqrt(np.einsum("ij,ij->i", bones, bones))


def _pair(answer, name):
    """The two arrays of a prior's answer."""
    try:
        x, quat = answer
        return np.asarray(x, float), np.asarray(quat, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must return two arrays of numbers, positions and rotations") from None

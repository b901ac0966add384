r"""The root wrench that a given motion needs, of a body of points or of cylinders  [DROP §8.5, Fig. 7]."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from drop import body, simulator
from drop.body import GRAVITY, LENGTHS, RADII, STEP, N
from drop.simulator import Simulator
from human import quat_conj, quat_matrix, quat_mul


def cylinder_inertia():
    r"""Masses, centres and inertias of the bones as cylinders, 22 kg in all.

    ASSUMED   radii 0.8 of the thinner end's contact sphere (trunk 0.10 m), equal density
    Returns   mass (21,) [kg]; inertia (21, 3, 3) about the bone's middle, in the parent joint's frame [kg m²]
    Test      tests/drop/test_drop_demos.py::test_cylinder_momenta
    """
    trunk = np.array([body.JOINTS[j].startswith(("spine", "neck", "collar")) for j in range(1, N)])
    r = np.where(trunk, 0.10, 0.8 * np.minimum(RADII[1:], RADII[body.PARENTS[1:]]))
    mass = LENGTHS * r * r
    mass *= N / mass.sum()
    axis = body.OFFSETS[1:] / LENGTHS[:, None]
    along, across = mass * r * r / 2, mass * (3 * r * r + LENGTHS**2) / 12
    outer = axis[:, :, None] * axis[:, None]
    return mass, along[:, None, None] * outer + across[:, None, None] * (np.eye(3) - outer)


def momenta_of_cylinders(x, quat, h=STEP):
    r"""Change of linear and angular momentum of a motion whose bones are cylinders (Fig. 7's second model).

    Equation  Ṗ, L̇ = differences of Σ m v and Σ m r × v + I ω between the half steps before and after t, r from the
              centre of mass at t, I at t
    Args      x (T, 22, 3), quat (T, 22, 4)
    Returns   (T − 2, 6) for frames 1 to T − 2; centre of mass (T − 2, 3)
    Test      tests/drop/test_drop_demos.py::test_cylinder_momenta
    """
    mass, local = cylinder_inertia()
    middle = 0.5 * (x[:, 1:] + x[:, body.PARENTS[1:]])
    turn = quat[:, body.PARENTS[1:]]
    v = np.diff(middle, axis=0) / h
    step = quat_mul(turn[1:], quat_conj(turn[:-1]))
    omega = Rotation.from_quat(step.reshape(-1, 4), scalar_first=True).as_rotvec().reshape(v.shape) / h
    com = np.einsum("j,tji->ti", mass, middle) / mass.sum()
    R = quat_matrix(turn[1:-1])
    inertia = R @ local @ np.swapaxes(R, -1, -2)
    r = middle[1:-1] - com[1:-1, None]
    spin = lambda w: np.matmul(inertia, w[..., None])[..., 0]  # noqa: E731
    L = [(mass[:, None] * np.cross(r, a) + spin(w)).sum(axis=1) for a, w in ((v[:-1], omega[:-1]), (v[1:], omega[1:]))]
    P = [np.einsum("j,tji->ti", mass, a) for a in (v[:-1], v[1:])]
    return np.concatenate([P[1] - P[0], L[1] - L[0]], axis=1) / h, com[1:-1]


def root_wrench(x, quat, cylinders=False):
    r"""The root wrench metric of a motion that is given, frame by frame  [DROP §8.5, Fig. 7].

    Equation  ‖b − F c‖ of Eq. 11, b by differences of the motion itself; the body as points or as cylinders
    Returns   (T − 2,) [N, N m], of 22 kg
    Test      tests/drop/test_drop_demos.py::test_root_wrench_of_motions
    """
    if cylinders:
        b, com = momenta_of_cylinders(x, quat)
    else:
        v = np.diff(x, axis=0) / STEP
        b = np.array([simulator.momentum_rate(x[t + 1], x[t], v[t - 1]) for t in range(1, len(x) - 1)])
        com = x[1:-1].mean(axis=1)
    sim, out = Simulator(), []
    for t, (rate, centre) in enumerate(zip(b, com), 1):
        F, _ = simulator.friction_basis(*sim.touching(x[t]), centre)
        need = rate - np.append(N * GRAVITY, np.zeros(3))
        out.append(np.linalg.norm(simulator.contact_forces(F, need)[1]))
    return np.array(out)

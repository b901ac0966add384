r"""Motion priors for DROP's simulator  [DROP §5]: a clip, nearest transitions of recorded motion, a conditional VAE.

A prior is anything with

    sample(state, n, rng) -> positions (m, 22, 3), rotations (m, 22, 4), m <= n     Eq. 9: the set of samples
    mode(state)           -> positions (22, 3), rotations (22, 4)                   its most likely next frame

`state` is a `drop.simulator.State`: x and v hold the solved motion, v_own the velocities the prior itself predicted,
which §7
does not overwrite.  Positions are bones of the right lengths, rotations global, both in the world frame.  m = 0 says
that nothing fits here; that step is a rag doll's.

    python -m drop train|evaluate|rollout|ship --motion FOLDER     the VAEs of drop/vae.py (drop/train.py)
"""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np

from drop import vae
from drop.body import (
    FEET,
    LENGTHS,
    OFFSETS,
    PARENTS,
    PATH,
    RADII,
    STANDING,
    STEP,
    J,
    N,
    align,
    forward_kinematics,
    swing_twist,
    twists,
)
from human import heading, quat_conj, quat_mul
from plumbing.cli import UserError
from plumbing.runs import load_checkpoint

DOWN = 0.6  # ASSUMED: share of the standing pelvis's height below which a body is down
WEIGHTS = Path(__file__).resolve().parent / "drop.npz"


class ClipPrior:
    r"""The next frame of a clip, always  [DROP §8.1: the mock prior].

    Args      x : (T, 22, 3), quat : (T, 22, 4); start : frame of the clip at the simulation's frame 0
    Test      tests/drop/test_drop.py::test_clip_and_switch_priors
    """

    def __init__(self, x, quat, start=0):
        self.x, self.quat, self.start = x, quat, start

    def mode(self, state):
        """The clip's next frame; after its end, the last."""
        i = min(self.start + state.frame + 1, len(self.x) - 1)
        return self.x[i], self.quat[i]

    def sample(self, state, n, rng):
        """A set of one."""
        x, quat = self.mode(state)
        return x[None], quat[None]


class SwitchPrior:
    """One prior before a frame (the onset of the force), another from it on  [DROP §8.1].

    Test: tests/drop/test_drop.py::test_clip_and_switch_priors"""

    def __init__(self, first, second, frame):
        self.first, self.second, self.frame = first, second, frame

    def _now(self, state):
        return self.first if state.frame < self.frame else self.second

    def mode(self, state):
        """The current prior's."""
        return self._now(state).mode(state)

    def sample(self, state, n, rng):
        """The current prior's."""
        return self._now(state).sample(state, n, rng)


MATCHED = np.array([J[n] for n in (
    "hip_l", "hip_r", "spine3", "head", "knee_l", "knee_r", "ankle_l", "ankle_r", "foot_l", "foot_r", "wrist_l",
    "wrist_r")])  # fmt: skip


class NearestPrior:
    r"""Transitions of recorded motion that start near the present state, as in a Motion Field (Lee et al. 2010).

    Method    features: 12 joints in the heading frame over the pelvis's place on the floor, and τ times their
              velocities; of the nearest 2 n frames of the set n are drawn; each gives its next frame, turned to the
              character's heading: the root moves as recorded, and the difference between character and recording decays
              by β a step; heights are counted from the floor under the pelvis, and on a slope legs and height follow it
              (`slope`)
    ASSUMED   τ, β, the joints, the number of principal components searched, `reach`; and that beyond `reach` nothing
              fits and the prior says so with no samples
    Args      clips : list of (x (T, 22, 3), quat (T, 22, 4)) on a floor at z = 0; tau [s]; beta, beta_height [-]: of
              rotations and of the root's height; reach : RMS distance [m]; spread : standard deviation of the angle
              [rad] by which samples are turned away from the heading (the turn then decays in: the character turns);
              floor : Plane under the character, or None
    Test      tests/drop/test_drop.py::test_nearest_prior
    """

    def __init__(self, clips, tau=0.1, beta=0.2, beta_height=1.0, reach=0.25, spread=0.3, components=16,
                 floor=None):  # fmt: skip
        self.tau, self.beta, self.beta_height, self.reach = tau, beta, beta_height, reach
        self.spread, self.floor = spread, floor
        features, before, after, q0, q1, held = [], [], [], [], [], []
        for x, quat in clips:
            if len(x) < 3:
                continue
            features.append(self.features(x[1:-1], (x[1:-1] - x[:-2]) / STEP, quat[1:-1]))
            before.append(x[1:-1, 0]), after.append(x[2:, 0]), q0.append(quat[1:-1]), q1.append(quat[2:])
            held.append(contacts_of(x)[2:])
        if not features:
            raise ValueError("NearestPrior: no clip has three frames or more")
        self.x0, self.x1, q0, self.q1, self.held = map(np.concatenate, (before, after, q0, q1, held))
        self.yaw, self.change = heading(q0[:, 0]), quat_mul(quat_conj(q0), self.q1)
        f = np.concatenate(features)
        self.mean = f.mean(axis=0)
        _, _, vt = np.linalg.svd((f - self.mean)[:: max(len(f) // 4000, 1)], full_matrices=False)
        self.basis = vt[:components].T
        self.bank = ((f - self.mean) @ self.basis).astype(np.float32)
        self.norm = np.einsum("ij,ij->i", self.bank, self.bank)

    @property
    def floor(self):
        """Plane under the character, or None.  Test: tests/drop/test_drop.py::test_nearest_prior_sees_a_new_floor"""
        return self._floor

    @floor.setter
    def floor(self, plane):
        self._floor, self._last, self._mode, self._level = plane, None, None, None  # found over another floor: void
        self._sloping = sloping(plane)

    def features(self, x, v, quat):
        """(T, 72) features whose distances are RMS metres a joint.  x, v (T, 22, 3), quat (T, 22, 4)."""
        yaw = heading(quat[:, 0])
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        p, u = x[:, MATCHED] - x[:, :1] * [1, 1, 0], self.tau * v[:, MATCHED]
        both = np.concatenate([p, u], axis=1)
        turned = np.stack([c * both[..., 0] + s * both[..., 1], c * both[..., 1] - s * both[..., 0], both[..., 2]], -1)
        return turned.reshape(len(x), -1) / np.sqrt(len(MATCHED))

    def ground(self, x):
        """Height of the floor under the pelvis of x (22, 3) [m]; 0 on a slope, where states are levelled first."""
        return 0.0 if self._sloping else ground(self.floor, x)

    def nearest(self, state, n):
        """Numbers of the n nearest frames, nearest first, and the distance of the nearest [m]."""
        x = state.x - [0.0, 0.0, self.ground(state.x)]
        f = self.features(x[None], state.v[None], state.quat[None])[0] - self.mean
        z = f @ self.basis
        d = self.norm - 2.0 * (self.bank @ z.astype(np.float32))
        n = min(n, len(d))
        pick = np.argpartition(d, n - 1)[:n] if n < len(d) else np.arange(n)
        pick = pick[np.argsort(d[pick])]
        return pick, float(np.sqrt(max(d[pick[0]] + f @ f, 0.0)))

    def follow(self, state, pick, turn=0.0):
        r"""The next frames (m, 22, 3), (m, 22, 4) that transitions `pick` lead to from `state`.

        Equation  q = (1 − β) q_state (q0⁻¹ q1) + β q_yaw q1, normalised: the character goes on by the recorded rotation
                  of this frame, and is drawn towards the recorded pose
        """
        yaw = heading(state.quat[0]) - self.yaw[pick] + turn
        c, s = np.cos(0.5 * yaw)[:, None], np.sin(0.5 * yaw)[:, None]
        w, x, y, z = np.moveaxis(self.q1[pick], -1, 0)
        recorded = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)  # q_yaw q1
        w, x, y, z = state.quat.T
        left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]).transpose(2, 0, 1)
        carried = np.matmul(left, self.change[pick][..., None])[..., 0]  # q_state (q0⁻¹ q1)
        same = np.einsum("...i,...i", carried, recorded)[..., None] >= 0  # q and −q are one rotation
        quat = (1.0 - self.beta) * np.where(same, carried, -carried) + self.beta * recorded
        quat /= np.sqrt(np.einsum("...i,...i", quat, quat))[..., None]
        travel, ground = self.x1[pick] - self.x0[pick], self.ground(state.x)
        c, s = np.cos(yaw), np.sin(yaw)
        root = np.stack([
            state.x[0, 0] + c * travel[:, 0] - s * travel[:, 1],
            state.x[0, 1] + s * travel[:, 0] + c * travel[:, 1],
            self.x1[pick, 2] + (1.0 - self.beta_height) * (state.x[0, 2] - ground - self.x0[pick, 2]) + ground,
        ], axis=1)  # fmt: skip
        return plant(state.x, forward_kinematics(root, quat), self.held[pick], ground), quat

    def sample(self, state, n, rng):
        """n of the 2 n nearest transitions, drawn without replacement; without rng the n nearest."""
        state = self._levelled(state)
        pick, distance = self._nearest(state, 2 * n)
        if distance > self.reach:
            return np.zeros((0, N, 3)), np.zeros((0, N, 4))
        drawn, turn = pick[:n], np.zeros(min(n, len(pick)))
        if rng is not None:
            drawn = rng.choice(pick, len(turn), replace=False)
            turn = rng.normal(0.0, self.spread, len(turn))
        x, quat = self._sloped(*self.follow(state, np.append(pick[0], drawn), np.append(0.0, turn)))
        self._mode = state, x[0], quat[0]  # the simulator asks for the mode of the same state next
        return x[1:], quat[1:]

    def mode(self, state):
        """The nearest transition."""
        state = self._levelled(state)
        if self._mode is None or self._mode[0] is not state:
            x, quat = self._sloped(*self.follow(state, self._nearest(state, 1)[0][:1]))
            self._mode = state, x[0], quat[0]
        return self._mode[1:]

    def _levelled(self, state):
        """The state that recordings are compared with: itself, or `level_state` of it, the same object each time."""
        if not self._sloping:
            return state
        if self._level is None or self._level[0] is not state:
            self._level = state, level_state(self.floor, state)
        return self._level[1]

    def _sloped(self, x, quat):
        return (incline(self.floor, x) if self._sloping else x), quat

    def _nearest(self, state, n):
        if self._last is None or self._last[0] is not state or len(self._last[1]) < min(n, len(self.norm)):
            self._last = state, *self.nearest(state, n)
        return self._last[1:]


# ------------------------------------------------------------------------------------ learned


class VaePrior:
    r"""The conditional VAE of drop/vae.py as a prior  [DROP Eqs. 8, 9].

    Equation  z ~ N(μ0(s), σ0(s)²) for the set of samples, z = μ0(s) for the mode; x̃ by forward kinematics of the
              decoded rotations; feet that it says stand are planted (`plant`); where a direction leads the
              network is told the pace (`led`); on a slope it is shown the state on the level (`level_state`), and its
              answer goes back on the slope (`incline`)
    Args      net : drop.vae.MotionVAE; floor : Plane under the character or None; velocity : "own" (§7: what the prior
              itself predicted) or "solved" (differences of the solved positions); spread : standard deviation of the
              angle [rad] by which samples, not the mode, are turned about the pelvis, as NearestPrior's are; down :
              share of the standing pelvis's height; a body with its pelvis below that, or its neck below its pelvis,
              gets no samples: a rag doll, because trained on people upright the network drags it along (§8.7); 0 never
    ASSUMED   down 0.6; spread 0, and 0.3 where a direction leads (drop.demos.follow): trained on few turns, z alone
              does not turn
    Test      tests/drop/test_drop_vae.py::test_vae_prior
    """

    def __init__(self, net, floor=None, velocity="own", spread=0.0, down=DOWN):
        if velocity not in ("own", "solved"):
            raise ValueError(f"velocity {velocity!r}: valid are own, solved")
        self.net, self.floor, self.velocity, self.spread, self.down = net, floor, velocity, spread, down
        self._mode = None

    def sample(self, state, n, rng):
        """n samples; without rng the mode alone; of a body that is down none."""
        if down(self.floor, state, self.down):
            return np.zeros((0, N, 3)), np.zeros((0, N, 4))
        return self._decoded(state, n, rng)

    def _decoded(self, state, n, rng):
        net, given, inclined = self.net, state, sloping(self.floor)
        if inclined:
            state = level_state(self.floor, state)
        lift = np.array([0.0, 0.0, 0.0 if inclined else ground(self.floor, state.x)])
        v = led(state.v if self.velocity == "solved" or state.v_own is None else state.v_own, state.lead)
        here = state.x - lift - state.x[0] * [1, 1, 0]
        one = [np.asarray(a, np.float32)[None] for a in (here, vae.columns_of(state.quat), v)]
        x, columns, v, frame = vae.canonical(*one)
        s = net.normalise(vae.state_vector(x, columns, v))
        mu, log_std, _ = net.gaussian("prior", s)
        z = np.repeat(mu, 1 + (n if rng is not None else 0), axis=0)
        if rng is not None:
            z[1:] += np.exp(log_std) * rng.standard_normal((n, net.latent)).astype(np.float32)
        out, C, logits = net.decode(np.repeat(s, len(z), axis=0), z, x[0, 0, 2], columns)
        angle = np.full(len(z), np.arctan2(frame[1][0], frame[0][0]), float)
        if rng is not None and self.spread:
            angle[1:] += rng.normal(0.0, self.spread, n)
        spin = np.zeros((len(z), 3, 3))
        spin[:, 0, 0] = spin[:, 1, 1] = np.cos(angle)
        spin[:, 1, 0], spin[:, 0, 1], spin[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
        # float64 again: positions by kinematics of the rotations found (orthonormal to 1e-7)
        R = np.matmul(spin[:, None], np.swapaxes(C, -1, -2).astype(float))
        bones = np.matmul(R[:, PARENTS[1:]], OFFSETS[1:, :, None])[..., 0]
        root = np.matmul(spin, out[:, 0, :, None].astype(float))[..., 0] + state.x[0] * [1, 1, 0] + lift
        quat = vae.quat_of(R)
        found = root[:, None] + PATH @ bones
        found = plant(state.x, found, logits > 0.0, lift[2])
        if inclined:
            found = incline(self.floor, found)
        self._mode = given, found[0], quat[0]
        return (found[1:], quat[1:]) if rng is not None else (found, quat)

    def mode(self, state):
        """The prior's mean latent, decoded."""
        if self._mode is None or self._mode[0] is not state:
            self._decoded(state, 0, None)
        return self._mode[1:]


def pose_angles(pose, C):
    r"""The largest angle [rad] (B,) between the joints of poses (B, 16, 2, 3) and of decoded ones C (B, 22, 3, 3).

    Equation  cos θ = (tr(Aᵀ B) − 1)/2, of rotations relative to the pelvis
    Test      tests/drop/test_drop_vae.py::test_pose_range
    """
    A, _ = vae.gram_schmidt_forward(pose)
    trace = np.einsum("bjki,bjki->bj", A, C[:, vae.POSE])
    return np.arccos(np.clip(0.5 * (trace.min(axis=1) - 1.0), -1.0, 1.0))


class PoseRange:
    r"""Range of motion by the pose VAE: `limits` of drop.simulator.Simulator  [DROP Eqs. 7, 15].

    Equation  [DROP Eq. 15] q_r = D(r E(q)/‖E(q)‖) if ‖E(q)‖ > r, else q; then forward kinematics, laid on x as a rigid
              body as `drop.project_range_of_motion` does
    Departs   E maps a knee bent backwards inside: ‖E‖ tells how far a pose is along what varies in the data, and that
              is not along it.  So a pose is outside, too, if a joint of D(E(q)) is more than `angle` from q's; then
              q_r = D(E(q))
    ASSUMED   r: 6 belongs to VPoser; ours is the 99.9th percentile of ‖E‖ over held-out poses; `angle` twice that of
              the largest angle between q and D(E(q))
    Args      net : drop.vae.PoseVAE; bound : r; angle : [rad]
    Test      tests/drop/test_drop_vae.py::test_pose_range
    """

    def __init__(self, net, bound, angle=np.inf):
        self.net, self.bound, self.angle = net, float(bound), float(angle)

    @classmethod
    def of(cls, net, meta):
        """With the bound and the angle that were shipped with the networks (`load_networks`)."""
        return cls(net, meta["bound"], meta.get("angle", np.inf))

    def norm(self, C):
        """‖E(q)‖ (B,) of rotations (B, 22, 3, 3), whose rows are the columns."""
        return np.linalg.norm(self.net.encode(vae.pose_columns(C)), axis=1)

    def __call__(self, x, twist):
        R, _ = swing_twist(x, twist)
        C = np.swapaxes(R, -1, -2)[None].astype(np.float32)
        pose = vae.pose_columns(C)
        z = self.net.encode(pose)
        norm = float(np.sqrt(z[0] @ z[0]))
        decoded = self.net.decode(z * np.float32(min(1.0, self.bound / max(norm, 1e-9))))
        if not (norm > self.bound or pose_angles(pose, decoded)[0] > self.angle):
            return x
        inside = decoded[0].astype(float)
        out = PATH @ np.matmul(OFFSETS[1:, None], inside[PARENTS[1:]])[:, 0]
        out, centre = out - out.mean(axis=0), x.mean(axis=0)
        return out @ align(out[None], (x - centre)[None])[0].T + centre


SLOW = 0.5  # m/s, ASSUMED: a foot in a recording that is slower stands
# m, ASSUMED: how near a foot must be to be planted, how far it may be put back in a frame, how high a foot swings
TOUCH, MOST, CLEAR = 0.03, 0.06, 0.01
LEGS = np.array([[J[f"{name}_{side}"] for side in "lr"] for name in ("hip", "knee", "ankle", "foot")])


def incline(floor, x, down=False):
    r"""A body on the floor z = 0 put on a sloping one, or back: feet follow it, knees bend, bones keep their lengths.

    Equation  g + r_j = the floor's height under joint j, g under the pelvis: r_j = −(n_xy · (x_j − x_0)_xy) / n_z.
              Ankles go up by g + r, all from the hips up by g + min(r of the ankles, 0), so that no leg has to grow;
              the foot's bone is sheared by the slope and keeps its length; the knee bends in the plane it had, turned
              with the line from hip to ankle, by the law of cosines.  down: the same with −g, −r, which undoes it
    ASSUMED   recordings are of level floors; on a slope the trunk stays upright and hangs from the lower foot
    Args      floor : Plane; x : (..., 22, 3) [m], world
    Returns   (..., 22, 3) [m]
    Test      tests/drop/test_drop.py::test_incline
    """
    sign, out = (-1.0 if down else 1.0), x.copy()
    rise = (x[..., :1, :2] - x[..., :2]) @ floor.normal[:2] / floor.normal[2]
    low = np.minimum(rise[..., LEGS[2]].min(axis=-1), 0.0)[..., None]
    out[..., 2] += sign * (ground(floor, x)[..., None] + low)
    hip, ankle, foot = (x[..., row, :] for row in LEGS[[0, 2, 3]])
    leg, bone = ankle - hip, foot - ankle
    leg[..., 2] += sign * (rise[..., LEGS[2]] - low)
    bone[..., 2] += sign * (rise[..., LEGS[3]] - rise[..., LEGS[2]])
    return bent_legs(x, out, leg, bone)


def bent_legs(x, out, leg, bone):
    r"""Other places for ankles and feet: the knees bend so that bones keep their lengths.

    Equation  the knee bends in the plane it had in x, turned with the line from hip to ankle, by the law of cosines; an
              ankle out of reach is pointed at
    Args      x : (..., 22, 3) [m] as it was; out : the same with its hips where they shall be, changed in place; leg :
              (..., 2, 3) wanted from hip to ankle; bone : (..., 2, 3) from ankle to foot, of any length
    Returns   out
    Test      tests/drop/test_drop.py::test_incline, ::test_plant
    """
    dot = lambda a, b: np.einsum("...i,...i", a, b)[..., None]  # noqa: E731
    unit = lambda a: a / np.maximum(np.sqrt(dot(a, a)), 1e-9)  # noqa: E731
    l1, l2, l3 = (LENGTHS[row - 1][:, None] for row in LEGS[1:])  # (2, 1), left and right
    hip, knee, ankle, foot = (x[..., row, :] for row in LEGS)
    u = unit(ankle - hip)
    reach, v = np.clip(np.sqrt(dot(leg, leg)), abs(l1 - l2) + 1e-6, l1 + l2 - 1e-6), unit(leg)
    side = knee - hip + 0.01 * unit(foot - ankle)  # a straight knee bends towards the toes
    side = side - dot(side, u) * u
    side = unit(side - dot(side, v) / np.maximum(1.0 + dot(u, v), 1e-9) * (u + v))  # turned as u to v
    cosine = (l1 * l1 + reach * reach - l2 * l2) / (2.0 * l1 * reach)
    hip = out[..., LEGS[0], :]
    out[..., LEGS[1], :] = hip + l1 * (cosine * v + np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0)) * side)
    out[..., LEGS[2], :] = hip + reach * v
    out[..., LEGS[3], :] = hip + reach * v + l3 * unit(bone)
    return out


def contacts_of(x):
    r"""Which ankles and balls of the feet stand on the floor in a recording, frame by frame.

    Equation  nearer than TOUCH before and after the step to this frame, and horizontally slower than SLOW in it
    Args      x : (T, 22, 3) on a floor at z = 0
    Returns   (T, 4) bool of FEET; the first frame's are the second's
    Test      tests/drop/test_drop.py::test_plant
    """
    near = x[:, FEET, 2] - RADII[FEET] < TOUCH
    slow = np.linalg.norm(np.diff(x[:, FEET, :2], axis=0), axis=-1) < SLOW * STEP
    held = near[1:] & near[:-1] & slow
    return np.concatenate([held[:1], held])


def plant(x_t, x, contacts, floor=0.0):
    r"""Samples whose feet stay where they stand: what the prior calls in contact does not move along the floor.

    Equation  of each foot that touches the floor in x_t (its sphere nearer than TOUCH): if the ball is in contact, the
              foot is moved horizontally until its ball is where it was in x_t; else, if the ankle is, until its ankle
              is; what is not in contact clears the floor by CLEAR; the knee bends (`bent_legs`).  Where all four are in
              contact, the whole body goes with its feet: horizontally by the mean of both moves, vertically until the
              lowest of the four is on the floor; only what the feet disagree in is left to the knees
    Why       of a prior that says of both whole feet that they stand, what it moves the body by over them is an error,
              too.  With the feet alone put back, someone who stood drifted away from them at 0.1 m/s until his legs
              were stretched, hovered and fell (REPRODUCE.md, get-ups).  Who walks is not on four: there the body's way
              over the standing foot is the walk
    ASSUMED   HuMoR predicts contacts and uses them when it fits motion, not when it rolls out; so a sample's feet slide
              by what the network errs, and its swinging feet graze the floor as the recordings' do.  TOUCH, CLEAR; no
              foot is moved by more than MOST at once
    Args      x_t : (22, 3) the current state; x : (m, 22, 3) samples; contacts : (m, 4) bool of FEET (ankle and ball,
              left, then right); floor : height of the level floor [m]
    Returns   (m, 22, 3)
    Test      tests/drop/test_drop.py::test_plant, ::test_who_stands_does_not_drift_from_his_feet
    """
    touches = x_t[FEET, 2] - RADII[FEET] - floor < TOUCH
    held = (contacts & touches).reshape(-1, 2, 2)  # sample, side, ankle or ball
    drift = (x_t[FEET] - x[:, FEET]).reshape(-1, 2, 2, 3) * [1, 1, 0]
    shift = np.where(held[..., 1:], drift[:, :, 1], np.where(held[..., :1], drift[:, :, 0], 0.0))
    shift *= np.minimum(1.0, MOST / np.maximum(np.linalg.norm(shift, axis=-1, keepdims=True), 1e-9))
    gap = x[:, FEET, 2] - RADII[FEET] - floor
    body = shift.mean(axis=1)
    body[:, 2] = -np.clip(gap.min(axis=1), -MOST, MOST)
    body[~held.all(axis=(1, 2))] = 0.0
    x, shift, gap = x + body[:, None], shift - body[:, None] * [1, 1, 0], gap + body[:, 2:]
    lift = np.where(contacts, 0.0, np.clip(CLEAR - gap, 0.0, MOST)).reshape(-1, 2, 2)
    hip, ankle, foot = (x[:, row] for row in LEGS[[0, 2, 3]])
    leg, bone = ankle + shift - hip, foot - ankle
    leg[..., 2] += lift[..., 0]
    bone[..., 2] += lift[..., 1] - lift[..., 0]
    return bent_legs(x, x.copy(), leg, bone)


GOING = 0.3  # m/s, ASSUMED: who is slower stands, and has no way along which he could be told to hurry


def led(v, lead):
    r"""Velocities as the learned prior is told them where Eq. 16 leads: the mean keeps its way, at the target's speed.

    Equation  v_j + (‖v_tar‖/‖v̄‖ − 1) v̄ with v̄ the horizontal mean; v where nothing leads or ‖v̄‖ < GOING
    Why       the prior reads what it predicted itself (§7), not what was solved.  Untold, it goes on walking at its own
              pace: E_com drags the centre of mass past it, and feet that it has planted are torn loose (REPRODUCE.md,
              a walker asked for 2.5 m/s).  Told to go the target's way, too, it falls in turns
    ASSUMED   the paper leaves all to E_com and to HuMoR's samples; GOING
    Args      v : (22, 3) [m/s]; lead : (2,) or None
    Test      tests/drop/test_drop_vae.py::test_led
    """
    if lead is None:
        return v
    mean = v.mean(axis=0) * [1, 1, 0]
    speed = np.linalg.norm(mean)
    return v if speed < GOING else v + (np.linalg.norm(lead) / speed - 1.0) * mean


def level_state(floor, state):
    r"""The State as it would be on the floor z = 0.

    Equation  x = L(x), L = `incline` down; v = (L(x) − L(x − h v))/h, the prior's own velocities likewise: they do not
              climb
    Test      tests/drop/test_drop.py::test_incline
    """
    x = incline(floor, state.x, down=True)
    v, own = (
        None if u is None else (x - incline(floor, state.x - STEP * u, down=True)) / STEP
        for u in (state.v, state.v_own)
    )
    return replace(state, x=x, v=v, v_own=own, quat=vae.quat_of(swing_twist(x, twists(state.quat))[0]))


def down(floor, state, share=DOWN):
    """Is the pelvis below a share of its standing height over the floor, or the neck below the pelvis?  0 : never.

    Test: tests/drop/test_drop_vae.py::test_vae_prior"""
    height, trunk = state.x[0, 2] - ground(floor, state.x), state.x[J["neck"], 2] - state.x[0, 2]
    return bool(share and (height < share * STANDING or trunk < 0.0))


def ground(floor, x):
    """Height of a floor (Plane or None) under the pelvis of x (..., 22, 3) [m]."""
    return 0.0 if floor is None else (floor.offset - x[..., 0, :2] @ floor.normal[:2]) / floor.normal[2]


def sloping(floor):
    """Is there a floor (Plane or None) that is not level?"""
    return floor is not None and floor.normal[2] < 1.0 - 1e-9


@functools.cache
def load_networks(path=WEIGHTS):
    r"""Both VAEs of a file that `python -m drop ship` wrote, or of a run folder's checkpoint.

    Returns   MotionVAE, PoseVAE, meta
    Raises    UserError: no such file, not such a file, or non-finite numbers
    Test      tests/drop/test_drop_vae.py::test_shipped
    """
    arrays, meta = load_checkpoint(path, ("motion.*", "pose.*"))
    try:
        o = meta["options"]
        pick = lambda net, names: {k: arrays[f"{net}.{k}"] for k in names}  # noqa: E731
        motion = vae.MotionVAE(o["latent"], o["hidden"], pick("motion", ("mean", "std", "scale", "offset")), None)
        pose = vae.PoseVAE(o["pose_latent"], o["pose_hidden"], pick("pose", ("mean", "std")), None)
        for name, net in vae.networks(motion, pose).items():
            if arrays[name].shape != net.theta.shape:
                raise ValueError(f"{name} has {arrays[name].size} weights, not {net.n_params}")
            net.theta[:] = arrays[name]
    except (KeyError, TypeError, ValueError) as e:
        raise UserError(f"{path}: not DROP's priors ({e}); valid: a file that python -m drop ship wrote") from None
    return motion, pose, meta

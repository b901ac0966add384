r"""A prior that gets up: any other prior, and the motions of drop/keyposes.py for a body that is down.

    upright ─► the prior ─► down: no samples, a rag doll ─► at rest ─► a way to rise ─► standing ─► the prior

HuMoR has people who get up in its data.  Ours has only what drop/keyposes.py makes, so that its rising is the paper's
mock prior (§8.1: a clip's next frame, with certainty), begun from wherever the body lies and followed as long as the
simulated body can: who is pushed while he rises is a rag doll again.
"""

from __future__ import annotations

import functools

import numpy as np

from drop import keyposes
from drop.body import STEP, J, N, forward_kinematics
from drop.prior import down, ground, sloping
from human import quat_about, quat_mul, quat_rotate, quat_slerp
from mocap.gait import smooth

CALM = 10  # frames, ASSUMED: so long a body must be slow before it rises
SLOW = 0.3  # m/s, ASSUMED: largest mean speed of its particles meanwhile
PACE = 0.7  # m/s, ASSUMED: mean speed at which the first pose is taken up, over at least 0.5 s
LOST = 0.25  # m, ASSUMED: RMS distance between body and plan, pelvis over pelvis, at which the rising is given up
TEMPO = 0.85, 1.2  # ASSUMED: tempos are drawn between these


@functools.cache
def _way(kind, lead):
    return keyposes.key_pose_motion(kind, 1.0, lead)


def faces_up(state):
    """Does the pelvis of someone who lies look up?  Test: tests/drop/test_drop_rising.py::test_plan"""
    return bool(quat_rotate(state.quat[0], np.array([1.0, 0.0, 0.0]))[2] > 0)


def plan(state, rng=None, floor=0.0):
    r"""A way to rise from where a body lies: the first pose is taken up, then the motion goes on to standing.

    Method    supine or prone by where the pelvis looks; the motion is turned so that its trunk lies along the body's
              and put where the pelvis is.  For the first T = max(0.5 s, distance/PACE) rotations go to the
              first pose's (slerp, minimum jerk [Flash85]), which rolls one who lies on the side; each frame's lowest
              sphere touches the floor.  rng draws tempo and leading leg
    Args      state : drop.simulator.State; floor : its height [m]
    Returns   x (T, 22, 3), quat (T, 22, 4), world
    Test      tests/drop/test_drop_rising.py::test_plan
    """
    up = faces_up(state)
    lead, tempo = ("lr"[int(rng.integers(2))], float(rng.uniform(*TEMPO))) if rng is not None else ("l", 1.0)
    x, quat = _way("supine" if up else "prone", lead)
    times = np.arange(0.0, len(x) - 1, tempo)
    low = times.astype(int)
    share = times - low
    quat = quat_slerp(quat[low], quat[low + 1], np.repeat(share[:, None], N, axis=1))
    root = x[low, 0] + share[:, None] * (x[low + 1, 0] - x[low, 0])
    trunk = (state.x[J["neck"]] - state.x[0]) * (-1.0 if up else 1.0)  # who lies on the back has the head behind
    turn = quat_about(2, np.arctan2(trunk[1], trunk[0]))
    quat = quat_mul(np.broadcast_to(turn, quat.shape), quat)
    root = quat_rotate(np.broadcast_to(turn, (len(root), 4)), root - root[0] * [1, 1, 0]) + state.x[0] * [1, 1, 0]
    here = state.x[0] - [0.0, 0.0, floor]
    far = np.linalg.norm(forward_kinematics(root[0], quat[0]) - (state.x - [0.0, 0.0, floor]), axis=1).mean()
    n = round(max(0.5, far / PACE) / STEP)
    s = smooth(np.arange(1, n + 1) / n)
    first = quat_slerp(np.broadcast_to(state.quat, (n, N, 4)), np.broadcast_to(quat[0], (n, N, 4)),
                       np.repeat(s[:, None], N, axis=1))  # fmt: skip
    quat = np.concatenate([first, quat])
    root = np.concatenate([here + s[:, None] * (root[0] - here), root])
    x = keyposes.on_the_floor(forward_kinematics(root, quat))
    return x + [0.0, 0.0, floor], quat


class Rising:
    r"""A prior with getting up: the other prior while the body is up, a plan to rise once it lies at rest.

    ASSUMED   CALM, SLOW, PACE, LOST, TEMPO; on a slope nobody rises (the plan is of level floors)
    Args      prior : any prior; one Rising belongs to one character, because it remembers the plan it follows
              rise : False leaves whoever is down a rag doll
    Test      tests/drop/test_drop_rising.py::test_rising, ::test_pushed_while_rising
    """

    def __init__(self, prior, rise=True):
        self.prior, self.rise = prior, rise
        self._calm, self._plan, self._next, self._away, self._frame = 0, None, 0, np.zeros(3), None

    @property
    def floor(self):
        """The other prior's floor.  Test: as the class"""
        return getattr(self.prior, "floor", None)

    @floor.setter
    def floor(self, plane):
        if hasattr(self.prior, "floor"):
            self.prior.floor = plane

    def sample(self, state, n, rng):
        """The plan's next frame, alone; else what the other prior says; of a body that is down nothing."""
        self._notice(state, rng)
        if self._plan is not None:
            x, quat = self._planned()
            return x[None], quat[None]
        if down(self.floor, state):
            return np.zeros((0, N, 3)), np.zeros((0, N, 4))
        return self.prior.sample(state, n, rng)

    def mode(self, state):
        """The plan's next frame, or the other prior's mode."""
        return self._planned() if self._plan is not None else self.prior.mode(state)

    def _planned(self):
        return self._plan[0][self._next] + self._away, self._plan[1][self._next]

    def _notice(self, state, rng):
        """Once a frame: count calm frames, begin, go on with or give up a plan."""
        if self._frame is not None and state.frame not in (self._frame, self._frame + 1):  # another take
            self._calm, self._plan = 0, None
        if self._frame == state.frame:
            return
        self._frame = state.frame
        if self._plan is not None:
            self._next += 1
            x = self._plan[0]
            off = state.x - x[self._next - 1]
            self._away = off[0] * [1, 1, 0]  # the plan goes along: who is shoved goes on from where he is
            if self._next >= len(x) or np.sqrt(((off - self._away) ** 2).sum(axis=1).mean()) > LOST:
                self._calm, self._plan = 0, None
            return
        slow = np.linalg.norm(state.v, axis=1).mean() < SLOW
        self._calm = self._calm + 1 if slow and down(self.floor, state) else 0
        if self.rise and self._calm >= CALM and not sloping(self.floor):
            self._plan, self._next, self._away = plan(state, rng, ground(self.floor, state.x)), 0, np.zeros(3)

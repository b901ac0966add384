"""Built-in motions: a procedural human made from published gait curves, so that nothing has to be downloaded.

One motion is planned the way an animator would: a root path (integrated speed and turn rate), a phase clock (left
heel strike at whole numbers, right at halves), footholds fixed on the floor along the path, swing feet between them,
the pelvis above them, legs by two-bone inverse kinematics, trunk, head and arms by normative curves of the phase.
Feet therefore cannot skate or sink. Of the normative curves only the pitch of the foot is an input; hip, knee and
ankle come out of the geometry and are checked against them.

Canonical human (as everywhere: `human.SEGMENTS`): SI units, radians, z up, x forward, y left, quaternions w, x, y, z,
world frame, floor at z = 0. Every segment frame equals the world axes when the person stands upright facing +x, arms
hanging, palms towards the thighs. Flexing the knee is a positive rotation about y; flexing hip, elbow or ankle is a
negative one. A segment's origin is its proximal joint centre.

Sources
  [Drillis66]  Drillis and Contini 1966, body segment lengths as fractions of stature, as tabulated in [Winter09].
  [Winter09]   Winter, Biomechanics and Motor Control of Human Movement, 4th ed., fig. 4.1.
  [Bell89]     Bell, Brand and Pedersen 1989: hip joint centre from the distance between the iliac spines.
  [Winter91]   Winter, The Biomechanics and Motor Control of Human Gait, 1991: knee and ankle angles, natural cadence.
  [Kadaba90]   Kadaba, Ramakrishnan and Wootten 1990: hip flexion and pelvic tilt in level walking.
  [Perry92]    Perry, Gait Analysis, 1992: timing of the gait cycle; thigh within 20..25 degrees of the vertical;
               pelvis rotation and obliquity of about 4 degrees.
  [Sekiya98]   Sekiya and Nagasaki 1998: step length / cadence ("walk ratio") is constant in one person's walking.
  [Orendurff04] Orendurff et al. 2004: vertical and sideways travel of the centre of mass against walking speed.
  [Novacheck98] Novacheck, The biomechanics of running, 1998: sagittal angles, contact and flight.
  [Cavanagh89] Cavanagh and Kram 1989: stride length and frequency of running.
  [Murray67]   Murray 1967: arm swing in walking.
  [Flash85]    Flash and Hogan 1985: the minimum-jerk profile.
Key values of curves are rounded to the shape of the published means, good to a few degrees; they are not digitised
tables. ASSUMED marks what has no source.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from human import SEGMENTS

KINDS = ("walk", "jog", "turn", "start", "stop", "stand", "sidestep", "gesture")
GRAVITY = 9.81
DEG = np.pi / 180.0
PAD = 3.0  # seconds planned before and after a clip, so that its first and last footholds have neighbours
LEAD, LAG = 0.25, 0.10  # ASSUMED: the feet's clock starts this long before the path moves, stops this long after it [s]
FINE = 4  # the path and the clock are integrated at FINE times the frame rate

# Sagittal angles of natural walking [deg] against per cent of the stride, 0 = heel strike; toe off at 62 [Perry92].
# Hip: thigh to the vertical, flexion + ([Kadaba90] hip flexion less 11 degrees of pelvic tilt). Knee flexion + and
# ankle dorsiflexion + [Winter91].
WALK_PERCENT = np.array([0, 5, 10, 15, 20, 30, 40, 50, 55, 60, 65, 70, 75, 80, 85, 90, 95, 100.0])
WALK_ANGLES = {
    "hip": np.array([24, 23, 21, 17, 11, 0, -10, -17, -17, -12, -2, 8, 16, 22, 25, 26, 25, 24.0]),
    "knee": np.array([4, 10, 17, 20, 19, 11, 6, 13, 24, 39, 54, 63, 63, 54, 39, 20, 6, 4.0]),
    "ankle": np.array([0, -5, -2, 2, 4, 7, 9.5, 6, -4, -16, -17, -10, -4, 0, 1, 1, 0, 0.0]),
}
# Stance fraction of the ball joint: the heel of the curves above leaves at 0.38, the ball at 0.58, the toes at 0.62.
WALK_DUTY, JOG_DUTY = 0.58, 0.36

# Pitch of the foot to the floor [deg], toe up +, in per cent of the stride. Walking: hip - knee + ankle of the curves
# above, with 10..31 per cent levelled to flat (the sum stays within 4 degrees there). Jogging: the same sum of the
# curves of [Novacheck98], thigh to the vertical.
PITCH_WALK = np.array([
    [0, 5, 10, 31, 40, 45, 50, 55, 60, 65, 70, 75, 80, 85, 90, 95, 100],
    [17, 5, 0, 0, -6, -12.5, -23, -41, -60, -68, -62, -49, -32, -14, 3, 14, 17.0],
]).T  # fmt: skip
PITCH_JOG = np.array([
    [0, 3, 6, 19, 25, 32, 38, 45, 55, 65, 75, 85, 92, 97, 100],
    [8, 3, 0, 0, -12, -38, -60, -76, -84, -74, -44, -10, 4, 8, 8.0],
]).T  # fmt: skip


def walk_angles(phase):
    r"""Normative sagittal angles of natural walking.

    Equation  periodic cubic spline through WALK_ANGLES [Kadaba90, Winter91]
    Args      phase : (...) stride fraction [-], 0 = heel strike of this leg
    Returns   dict hip, knee, ankle : (...) [rad], flexion and dorsiflexion positive; hip = thigh to the vertical
    Test      tests/mocap/test_gait.py::test_walk_matches_published_curves
    """
    x = np.asarray(phase) % 1.0 * 100.0
    return {k: CubicSpline(WALK_PERCENT, v, bc_type="periodic")(x) * DEG for k, v in WALK_ANGLES.items()}


@dataclass(frozen=True)
class Body:
    r"""Segment offsets of a standing adult from the height alone.

    Equation  [Drillis66; Winter09 fig. 4.1] heights over the floor as fractions of stature H: ankle 0.039, knee 0.285,
              hip 0.530, shoulder 0.818; upper arm 0.186, forearm 0.146, foot length 0.152.
              [Bell89] hip centres 0.72 of the iliac spine distance (about 0.14 H) apart: half of it is 0.050 H.
    ASSUMED   chest base 0.10 H above the hips; head joint at 0.91 H (chin 0.870, eye 0.936 in [Winter09]);
              shoulder centre 0.108 H from the middle (acromion 0.129 H); heel a quarter of the foot length behind
              the ankle, ball 0.72 of it before the heel, ball joint 0.014 H over the floor.
    Args      height : stature [m]
    Test      tests/mocap/test_gait.py::test_body_fractions
    """

    height: float = 1.75

    thigh = property(lambda self: 0.245 * self.height)
    shin = property(lambda self: 0.246 * self.height)
    upper_arm = property(lambda self: 0.186 * self.height)
    forearm = property(lambda self: 0.146 * self.height)
    ankle_height = property(lambda self: 0.039 * self.height)
    ball_height = property(lambda self: 0.014 * self.height)
    hip_half_width = property(lambda self: 0.050 * self.height)
    chest = property(lambda self: np.array([-0.010, 0.0, 0.100]) * self.height, doc="chest base in the pelvis frame")
    head = property(lambda self: np.array([0.010, 0.0, 0.280]) * self.height, doc="head joint in the chest frame")
    shoulder = property(
        lambda self: np.array([0.005, 0.108, 0.188]) * self.height,
        doc="left shoulder in the chest frame; the right one has -y",
    )
    heel = property(
        lambda self: np.array([-0.25 * 0.152, 0.0, -0.039]) * self.height,
        doc="lowest point of the heel in the foot frame",
    )
    ball = property(
        lambda self: np.array([0.47 * 0.152, 0.0, 0.014 - 0.039]) * self.height, doc="ball joint in the foot frame"
    )


@dataclass(frozen=True)
class GaitParams:
    """What a clip can be asked for; `generate` fills kind-dependent defaults."""

    speed: float = 1.3  # forward speed [m/s]
    cadence: float | None = None  # steps per minute; None: normative from speed
    stride: float | None = None  # stride length [m], instead of cadence
    turn_rate: float = 0.0  # [rad/s], left +
    weave: bool = False  # swing between +turn_rate and -turn_rate
    sidestep: float = 0.0  # sideways speed [m/s], left +
    gesture: str | None = None  # one of GESTURES, or None for a random sequence (kind "gesture")
    amplitude: float = 1.0  # scale of the gestures
    strokes: float = 0.0  # arm strokes a second and arm, as in a game of swords and drums
    sway: float = 1.0  # scale of how far a standing pelvis wanders sideways
    crouch: float = 0.0  # deepest bow of the knees while standing: how far the pelvis sinks [m]
    height: float = 1.75  # stature [m]
    variation: float = 1.0  # 0 removes all randomness, 1 is natural


DEFAULTS = {
    "jog": {"speed": 2.5},
    "turn": {"turn_rate": 0.5},
    "start": {"speed": 1.2},
    "stop": {"speed": 1.2},
    "stand": {"speed": 0.0},
    "sidestep": {"speed": 0.0, "sidestep": 0.35},
    "gesture": {"speed": 0.0},
}

# ASSUMED arm poses [deg]: shoulder flexion, abduction, inward rotation, elbow flexion, for the arms that take part.
GESTURES = {
    "wave": ("one", (10, 80, -95, 95)),
    "reach_forward": ("one", (80, 5, 0, 12)),
    "reach_up": ("one", (155, 10, 0, 15)),
    "point": ("one", (80, 30, 0, 6)),
    "think": ("one", (45, 5, 25, 130)),
    "cross": ("both", (38, 6, 62, 95)),
    "open": ("both", (35, 40, -20, 40)),
    "hips": ("both", (-22, 42, 50, 80)),
    "both_up": ("both", (140, 25, 0, 20)),
    "carry": ("both", (20, 8, 5, 85)),
}
# ASSUMED range of the arm poses of strokes [deg], the same four angles: hands before the body, from the hips to above
# the head.
STROKES = ((-10, 130), (0, 50), (-30, 50), (10, 110))


def smooth(x):
    r"""Minimum-jerk step from 0 to 1: zero velocity and acceleration at both ends [Flash85]."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * x * (10.0 - 15.0 * x + 6.0 * x * x)


def noise(rng, t, top, n=6):
    """Smooth zero-mean noise of about unit variance: n sinusoids below `top` Hz."""
    f, p = rng.uniform(0.15, 1.0, n) * top, rng.uniform(0, 2 * np.pi, n)
    return np.sin(2 * np.pi * np.outer(t, f) + p).sum(1) * np.sqrt(2.0 / n)


def about(axis, angle):
    """(T, 3, 3) rotation matrices about one coordinate axis."""
    return Rotation.from_euler(axis, np.asarray(angle)[:, None]).as_matrix()


def rotate(r, v):
    """Rotations (T, 3, 3) of one vector (3,) or of a vector each (T, 3) -> (T, 3)."""
    return np.einsum("tij,...j->t...i", r, v) if np.ndim(v) == 1 else np.einsum("tij,tj->ti", r, v)


def _duty(speed, jog):
    """Stance fraction of the ball joint; it grows when the walk [Perry92] or the run [Novacheck98] is slow."""
    if jog:
        return float(np.clip(JOG_DUTY - 0.05 * (speed - 2.5), 0.30, 0.42))
    return float(np.clip(WALK_DUTY - 0.06 * (speed - 1.3), 0.55, 0.64))


def stride_frequency(speed, height=1.75, jog=False):
    r"""Strides per second that people choose at a speed.

    Equation  [Sekiya98] walking: step / cadence = W, so cadence = sqrt(60 v / W) steps per minute.
              [Cavanagh89] jogging: 2.6 steps per second at 2 m/s, 0.1 more for every m/s.
    ASSUMED   W = 0.0065 m min at 1.75 m, growing as height^1.5 (equal Froude number); jogging steps as height^-0.5
    Args      speed : (...) [m/s]; height [m]
    Returns   (...) [1/s]
    Test      tests/mocap/test_gait.py::test_stride_frequency
    """
    size = height / 1.75
    if jog:
        return 0.5 * (2.6 + 0.1 * (np.asarray(speed) - 2.0)) / np.sqrt(size)
    return np.sqrt(60.0 * np.maximum(speed, 0.1) / (0.0065 * size**1.5)) / 120.0


class _Plan:
    """Root path, clock and rests on a fine time grid that overhangs the clip by PAD on both sides."""

    def __init__(self, kind, duration, rate, p, rng):
        self.jog, self.rate = kind == "jog", rate
        self.moving = abs(p.speed) > 0 or abs(p.sidestep) > 0
        self.frames = int(round(duration * rate))
        n = int(np.ceil(PAD * rate))
        t = self.t = (np.arange((self.frames + 2 * n) * FINE + 1) / FINE - n) / rate
        self.pick = slice(n * FINE, (n + self.frames) * FINE, FINE)
        inside = slice(n * FINE, (n + self.frames) * FINE)
        self.duty = _duty(p.speed, self.jog)
        self.delta = (self.duty - 0.5) / 2  # phase in the middle of double support, where the clock may rest
        wobble = 0.03 * p.variation * noise(rng, t, 0.3)
        wander = 0.06 * p.variation * noise(rng, t, 0.25)

        f = stride_frequency(max(p.speed, 5.0 * abs(p.sidestep)), p.height, self.jog)  # ASSUMED 5: short side steps
        if p.cadence is not None:
            f = p.cadence / 120.0
        elif p.stride is not None:
            f = max(p.speed, abs(p.sidestep)) / p.stride
        self.f = float(f)
        bouts = self._bouts(kind, duration, rng)
        gate, clock, sign = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
        for i, (a, b) in enumerate(bouts):
            on = smooth((t - a) / 1.2) * smooth((b - t) / 1.2)  # ASSUMED 1.2 s to start and to stop
            gate += on
            sign += np.where(on > 0, (-1.0) ** i if kind == "sidestep" else 1.0, 0.0)
            clock += smooth((t - a + LEAD) / 0.5) * smooth((b + LAG - t) / 0.5)
        self.gate = gate
        wobble = wobble - wobble[inside].mean()
        self.speed = p.speed * gate * (1 + wobble)
        self.side = p.sidestep * gate * sign * (1 + wobble)
        turn = p.turn_rate * (np.sin(2 * np.pi * t / 9.0) if p.weave else 1.0)
        if kind != "sidestep":
            turn = turn + (wander - wander[inside].mean())
        self.turn = turn * gate if self.moving else np.zeros_like(t)
        dt = 1.0 / (rate * FINE)

        def integ(x):
            return np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1])) * dt])

        psi = integ(self.turn)
        self.psi = psi - psi[self.pick.start]
        c, s = np.cos(self.psi), np.sin(self.psi)
        xy = np.stack([integ(self.speed * c - self.side * s), integ(self.speed * s + self.side * c)], 1)
        self.xy = xy - xy[self.pick.start]
        self._clock(clock * self.f * (1 + 0.5 * wobble), integ, bouts, kind, p, rng)

    def _bouts(self, kind, duration, rng):
        """Intervals of walking [s]; infinite where a clip begins or ends on the move."""
        if not self.moving:
            return []
        if kind not in ("start", "stop", "sidestep"):
            return [(-np.inf, np.inf)]
        bouts, now = [], -np.inf if kind == "stop" else rng.uniform(1.0, 2.0)
        while not bouts or now < duration - 2.0:
            end = max(now, 0.0) + rng.uniform(4.5, 8.0)
            if end > duration - 1.0:
                end = np.inf if kind == "start" and len(bouts) else max(duration - 1.0, max(now, 0.0) + 3.0)
            bouts.append((now, end))
            now = end + rng.uniform(1.2, 3.0)
        return bouts

    def _clock(self, rate, integ, bouts, kind, p, rng):
        """Integrate the phase; stretch each bout so that the clock rests in mid double support, feet together."""
        t, phase = self.t, integ(rate)
        self.rests = []  # (phase, time)
        if not self.moving:
            self.phase = np.full_like(t, self.delta)
            self.rests = [(self.delta, 0.0)]
            return

        def at(x):
            return np.interp(x, t, phase)

        lead = 0.0 if kind != "sidestep" or p.sidestep < 0 else 0.5  # the foot on the side of travel goes first
        if np.isinf(bouts[0][0]):
            start = 0.0 if p.variation == 0 else rng.uniform()
            if np.isfinite(bouts[0][1]):
                gain = at(bouts[0][1] + LAG) - at(0.0)
                start = self.delta - gain + np.ceil(gain)
            out = phase - at(0.0) + start
        else:
            out = np.full_like(t, self.delta + lead)
        for i, (a, b) in enumerate(bouts):
            lo, hi = at(a - LEAD), at(b + LAG)
            if np.isfinite(a):
                gain = hi - lo
                if np.isfinite(b):
                    want = np.floor(gain) + 0.5 if kind == "sidestep" else max(round(2 * gain), 1) / 2
                else:
                    want = gain
                before = self.rests[-1][0] if self.rests else out[0]
                if not self.rests:
                    self.rests.append((out[0], min(a - LEAD, 0.0)))
                inside = t >= a - LEAD
                out[inside] = before + (np.minimum(phase[inside], hi) - lo) * want / gain
            if np.isfinite(b):
                nxt = bouts[i + 1][0] - LEAD if i + 1 < len(bouts) else b + LAG + 2.0
                self.rests.append((float(np.interp(b + LAG, t, out)), 0.5 * (b + LAG + nxt)))
        self.phase = out


def _swing_profile(rise=0.25, fall=0.24, n=400):
    """Travel of a swing foot, 0 to 1: it speeds up, keeps its speed and brakes, as WALK_ANGLES have it do."""
    s = np.linspace(0, 1, n + 1)
    up, down = np.clip(s / rise, 0, 1), np.clip((1 - s) / fall, 0, 1)
    speed = up * up * (3 - 2 * up) * down * down * (3 - 2 * down)
    travel = CubicSpline(s, speed).antiderivative()
    return lambda x: travel(x) / travel(1.0)


_SWING = _swing_profile()


def _footholds(plan, p, style, side):
    """Where one foot stands or swings to, per fine sample: x, y, yaw of the flat foot, lift, stride and swing phase.

    The foothold of a stance is the path position in mid stance (or where the clock rests during it), set sideways by
    half the step width, so that a foot on the floor does not move at all.
    """
    own = plan.phase - (0.0 if side > 0 else 0.5)
    k = np.arange(np.floor(own[0]) - 1, np.ceil(own[-1]) + 2)
    begin = k + (0.0 if side > 0 else 0.5)
    uniq = np.concatenate([[True], np.diff(plan.phase) > 1e-12])
    mid = np.interp(begin + 0.5 * plan.duty, plan.phase[uniq], plan.t[uniq])
    rest = np.zeros(len(k), bool)
    for phase, when in plan.rests:
        hit = (begin <= phase + 1e-6) & (phase - 1e-6 <= begin + plan.duty)
        mid[hit], rest[hit] = when, True
    psi, v, turn, u, *xy = (np.interp(mid, plan.t, x) for x in (plan.psi, plan.speed, plan.turn, plan.side, *plan.xy.T))
    half = np.where(rest, style["stand_half"], style["step_half"] + 0.25 * np.abs(u) / plan.f + 0.02 * np.abs(turn))
    lean = style["lean"] * v * turn / GRAVITY
    across = side * half - lean * 0.53 * p.height  # feet go outward in a curve, the body leans inward
    ahead = np.where(rest, 0.0, style["ahead"] * np.minimum(v / 1.3, 1.5))
    x = xy[0] + ahead * np.cos(psi) - across * np.sin(psi)
    y = xy[1] + ahead * np.sin(psi) + across * np.cos(psi)
    yaw = psi + side * style["toe_out"]
    i = np.clip(np.floor(own - k[0]).astype(int), 0, len(k) - 2)
    frac = own - k[i]
    s = np.clip((frac - plan.duty) / (1 - plan.duty), 0.0, 1.0)
    go = _SWING(s)

    def move(z):
        return z[i] + (z[i + 1] - z[i]) * go

    far = np.hypot(x[i + 1] - x[i], y[i + 1] - y[i])
    # A swing foot goes around the standing one, and along the arc (its sagitta) rather than the chord of a curve.
    out = (side * style["around"] - far * (psi[i + 1] - psi[i]) / 8) * 16 * s**2 * (1 - s) ** 2
    lift = style["lift"] * (0.45 + 0.55 * np.clip(far / style["usual"], 0, 1.2))
    lift = lift * s**2 * (1 - s) ** (2 if plan.jog else 3)
    head = move(psi)
    return move(x) - out * np.sin(head), move(y) + out * np.cos(head), move(yaw), lift, frac, s


def _foot(plan, body, p, style, side, scale):
    """World pose of one foot: ankle (T, 3), rotation (T, 3, 3), yaw (T,).

    A toe-up foot turns about its heel, a toe-down one about its ball; the pivot changes while the foot is flat and,
    back, during the swing. So the point on the floor stays where it is.
    """
    x, y, yaw, lift, frac, s = (a[plan.pick] for a in _footholds(plan, p, style, side))
    keys, duty = (PITCH_JOG, JOG_DUTY) if plan.jog else (PITCH_WALK, WALK_DUTY)
    at = np.where(s > 0, duty + s * (1 - duty), frac / plan.duty * duty)  # phase of the published curve
    curve = PchipInterpolator(
        np.concatenate([keys[:-1, 0] - 100, keys[:-1, 0], keys[:, 0] + 100]),
        np.concatenate([keys[:-1, 1], keys[:-1, 1], keys[:, 1]]),
    )
    pitch = curve(at * 100) * DEG * scale
    flat = keys[keys[:, 1] == 0, 0][:2] / 100
    to_ball = smooth((at - flat[0]) / (flat[1] - flat[0])) * (1 - smooth(s))  # pivot: heel 0 .. ball 1
    rot = about("z", yaw) @ about("y", -pitch)
    up = about("z", yaw)
    pivot = body.heel + to_ball[:, None] * (body.ball - body.heel)
    ankle = np.stack([x, y, lift + body.ankle_height], 1) + rotate(up, pivot) - rotate(rot, pivot)
    return ankle, rot, yaw


def two_bone_leg(hip, ankle, forward, a, b):
    r"""Two-bone inverse kinematics: rotations of thigh and shin, knee towards `forward`.

    Equation  law of cosines in the plane of hip, ankle and forward; an ankle out of reach is pointed at
    Args      hip, ankle, forward : (T, 3) world; a, b : thigh and shin length [m]
    Returns   thigh, shin : (T, 3, 3)
    Test      tests/mocap/test_gait.py::test_limbs_have_constant_length, tests/headset/test_body.py::test_two_bone_arm
    """
    d = ankle - hip
    n = np.maximum(np.linalg.norm(d, axis=1), 1e-6)
    r = np.clip(n, abs(a - b) + 1e-6, a + b - 1e-9)
    z = -d / n[:, None]
    y = np.cross(z, forward)
    y /= np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-9)
    frame = np.stack([np.cross(y, z), y, z], 2)
    alpha = np.arccos(np.clip((a * a + r * r - b * b) / (2 * a * r), -1, 1))
    beta = np.arccos(np.clip((b * b + r * r - a * a) / (2 * b * r), -1, 1))
    return frame @ about("y", -alpha), frame @ about("y", beta)


def lowered(want, limit, rate, half=0.30):
    """Lower `want` smoothly so that it never exceeds `limit` (T,): a running maximum of ± `half` s, averaged."""
    w = max(int(half * rate), 1)
    over = maximum_filter1d(np.maximum(want - limit, 0.0), 2 * w + 1, mode="nearest")
    kernel = np.hanning(2 * w + 3)[1:-1]
    return want - convolve1d(over, kernel / kernel.sum(), mode="nearest")


def _arm_base(plan, f, habit, rng, p):
    """Arm swing [rad]: (T, 2, 4) flexion, abduction, inward rotation, elbow; left, right [Murray67; Novacheck98]."""
    phase, gate, amount = f.phase, f.gate, f.amount * habit
    out = np.zeros((len(phase), 2, 4))
    for j, o in enumerate((0.0, 0.5)):
        swing = -np.cos(2 * np.pi * (phase - o + 0.02))  # back at the heel strike of the same side
        drift = 2.0 * p.variation * noise(rng, plan.t[plan.pick], 0.4)
        if plan.jog:  # ASSUMED 85 degrees of elbow, forearms slightly inward
            out[:, j] = np.stack(
                [-12 + 26 * amount * swing + drift, 0 * phase + 17, 0 * phase + 14, 85 + 12 * swing], 1
            )
        else:  # [Murray67] about 30 degrees of shoulder and 15..35 of elbow at 1.3 m/s
            out[:, j] = np.stack(
                [
                    -3 + (-4 + 17 * swing) * amount * gate + drift,
                    0 * phase + 8 + 0.4 * drift,
                    0 * phase + 8,
                    14 + (9 + 9 * swing) * amount * gate + np.abs(drift),
                ],
                1,
            )
    return out * DEG


def _gestures(angles, t, duration, p, rng):
    """Blend arm poses from GESTURES into `angles` (T, 2, 4), one after the other with pauses."""
    now, names, previous = rng.uniform(0.8, 1.6), list(GESTURES), None
    out = angles.copy()
    while now < duration - 3.0:
        name = p.gesture or str(rng.choice([n for n in names if n != previous]))
        previous = name
        who, pose = GESTURES[name]
        hold, move = rng.uniform(1.2, 3.0), rng.uniform(0.7, 1.0)
        on = smooth((t - now) / move) * smooth((now + 2 * move + hold - t) / move)
        arms = (0, 1) if who == "both" else (int(rng.integers(2)),)
        for j in arms:
            target = np.array(pose) * DEG * (1 + 0.06 * p.variation * rng.standard_normal(4))
            goal = np.repeat(target[None], len(t), 0)
            if name == "cross":
                goal[:, 0] += (10 if j else -2) * DEG  # one forearm over the other
            if name == "wave":
                goal[:, 2] += 22 * DEG * np.sin(2 * np.pi * 1.4 * (t - now))
            out[:, j] += (p.amplitude * on)[:, None] * (goal - out[:, j])
        now += 2 * move + hold + rng.uniform(0.3, 1.5)
    return out


def _strokes(angles, t, duration, p, rng):
    """Arms that strike: from pose to pose, one movement every 1 / p.strokes seconds and arm on average.

    ASSUMED   poses uniform in STROKES; a movement lasts 0.15 to 0.45 s (min-jerk); wrists turn by up to 25 degrees
    Returns   angles (T, 2, 4) as `_arm_base`, wrist (T, 2, 2) flexion and abduction [rad]
    """
    out, wrist = angles.copy(), np.zeros((len(t), 2, 2))
    low, high = np.array(STROKES).T * DEG
    for j in (0, 1):
        now, pose, turn = rng.uniform(0.0, 1.0), out[0, j], np.zeros(2)
        while now < duration:
            goal, goal_turn = rng.uniform(low, high), rng.uniform(-25, 25, 2) * DEG
            done = smooth((t - now) / rng.uniform(0.15, 0.45))[:, None]
            out[:, j] += done * (goal - pose)
            wrist[:, j] += done * (goal_turn - turn)
            pose, turn = goal, goal_turn
            now += max(rng.exponential(1.0 / p.strokes), 0.2)
    return out, wrist


@dataclass
class _Frames:
    """What a clip does at each of its frames, (T,) each; world frame."""

    t: np.ndarray  # s
    phase: np.ndarray  # of the stride
    psi: np.ndarray  # heading of the path [rad]
    v: np.ndarray  # speed along it [m/s]
    turn: np.ndarray  # rad/s
    gate: np.ndarray  # 1 on the move, 0 at rest
    still: np.ndarray  # 1 - gate
    amount: np.ndarray  # step length to the natural one
    sway: np.ndarray  # noise of about unit variance: of the pelvis at rest,
    look: np.ndarray  # of where the head looks,
    nod: np.ndarray  # of its nodding
    dip: np.ndarray  # how far the pelvis sinks in a crouch [m]


def _frames(plan, p, rng, play):
    """The plan at the clip's frames, and what is random in them."""
    t, phase, gate, psi, v, turn = (
        x[plan.pick] for x in (plan.t, plan.phase, plan.gate, plan.psi, plan.speed, plan.turn)
    )
    still, size = 1 - gate, p.height / 1.75
    amount = np.clip(np.sqrt(np.maximum(v, 0) / (2.5 if plan.jog else 1.3)), 0, 1.15)  # [Sekiya98]
    noises = [noise(rng, t, top) * p.variation for top in (0.25, 0.22, 0.3)]
    dip = p.crouch * size * still * np.clip(noise(play, t, 0.35), 0.0, 1.0) if p.crouch else 0.0 * t
    return _Frames(t, phase, psi, v, turn, gate, still, amount, *noises, dip)


def _style(plan, p, kind, vary):
    """How one person walks or jogs [m, rad]: varies from clip to clip."""
    walk = {"step_half": 0.055 * vary(0.1), "lift": 2.6 * vary(0.1), "ahead": -0.10, "usual": 1.4, "around": 0.02}
    walk["knee"] = (6 + 5 * max(p.speed - 1.2, 0.0)) * DEG
    jog = {"step_half": 0.04 * vary(0.1), "lift": 2.1 * vary(0.1), "ahead": -0.08, "usual": 1.9, "around": 0.03}
    jog["knee"] = 12 * DEG
    both = {"stand_half": 0.085 * vary(0.1), "toe_out": 6 * DEG * vary(0.2), "lean": 0.6}
    style = (jog if plan.jog else walk) | both
    for key in ("step_half", "lift", "ahead", "usual", "stand_half", "around"):
        style[key] *= p.height / 1.75
    if kind == "sidestep":
        style["step_half"] = style["stand_half"]
    return style


def _sway(plan, p, f):
    """The pelvis against the path [m]: up in the middle of a stance (walking) or down (jogging), and sideways towards
    the standing leg."""
    size, cycle = p.height / 1.75, 2 * np.pi * (f.phase - 0.5 * plan.duty)
    if plan.jog:
        up = -0.85 * GRAVITY / (4 * np.pi * plan.f) ** 2 * np.cos(2 * cycle)  # nearly free fall in flight
        side = 0.012 * size * np.cos(cycle)
    else:
        up = 0.5 * np.clip(0.0274 + 0.0232 * (f.v - 0.7), 0.0, 0.055) * f.gate * size * np.cos(2 * cycle + 0.4)
        side = 0.5 * np.clip(0.0699 - 0.0349 * (f.v - 0.7), 0.03, 0.07) * f.gate * size * np.cos(cycle)  # [Orendurff04]
    return up, side + 0.020 * p.sway * size * f.still * f.sway


def _trunk(plan, style, f, vary):
    """Rotations (T, 3, 3) of pelvis, chest and head, and the pelvis' turn from the path (T,)."""
    stride, lean = np.cos(2 * np.pi * f.phase), style["lean"] * f.v * f.turn / GRAVITY
    yaw = -4 * DEG * f.amount * stride * vary(0.15)
    roll = 3.5 * DEG * f.amount * np.sin(2 * np.pi * (f.phase + 0.1)) - lean + 1.5 * DEG * f.still * f.sway
    pitch = (5 if plan.jog else 1) * DEG * f.amount + 60 * DEG * f.dip
    look = f.still * 28 * DEG * np.tanh(f.look) + np.interp(f.t + 0.35, plan.t, plan.psi) - f.psi
    yaw_chest = 3.5 * DEG * f.amount * stride * vary(0.15) + 0.2 * look
    pitch_chest = (9 if plan.jog else 2.5) * DEG * f.amount + 1 * DEG * f.nod * f.still + 120 * DEG * f.dip
    nod = 2 * DEG + 6 * DEG * f.still * f.nod
    roll_chest = -0.3 * (roll + lean) - 1.2 * lean
    rots = {
        "pelvis": about("z", f.psi + yaw) @ about("y", pitch) @ about("x", roll),
        "chest": about("z", f.psi + yaw_chest) @ about("y", pitch_chest) @ about("x", roll_chest),
        "head": about("z", f.psi + look) @ about("y", nod) @ about("x", -0.3 * lean),
    }
    return rots, yaw


def _pelvis(plan, body, style, f, feet, r_pelvis, up, side):
    """Where the pelvis is (T, 3): on the path, as high as the legs reach, lower in a crouch."""
    c, s = np.cos(f.psi), np.sin(f.psi)
    back = 0.3 * f.dip
    x, y = plan.xy[plan.pick].T
    pelvis = np.stack([x - s * side - c * back, y + c * side - s * back, 0 * f.t], 1)
    bent = 0.045 * (body.height / 1.75) if plan.jog else 0.0
    want = body.thigh + body.shin + body.ankle_height - bent + up
    pelvis[:, 2] += lowered(want, reached(body, pelvis, r_pelvis, feet, style["knee"]), plan.rate) - f.dip
    return pelvis


def reached(body, pelvis, r_pelvis, feet, knee):
    """How far above `pelvis` (T, 3) it can be (T,) [m] while both legs, their knees at `knee` [rad], reach the feet."""
    reach = np.sqrt(body.thigh**2 + body.shin**2 + 2 * body.thigh * body.shin * np.cos(knee))
    limits = []
    for hip, (ankle, _, _) in zip(_hips(body, pelvis, r_pelvis), feet, strict=True):
        flat = np.sum((hip - ankle)[:, :2] ** 2, 1)
        limits.append(ankle[:, 2] + np.sqrt(np.maximum(reach**2 - flat, 0.2 * reach**2)) - hip[:, 2])
    return np.min(limits, axis=0)


def _hips(body, pelvis, r_pelvis):
    """The hip joints, left and right, (T, 3) each."""
    return [pelvis + rotate(r_pelvis, np.array([0, sign * body.hip_half_width, 0])) for sign in (1, -1)]


def pose_body(body, pelvis, heading, feet, angles, wrist, rots):
    """All segments [world]: trunk and head by their rotations `rots`, legs from the pelvis (T, 3) and its heading (T,)
    to both feet as `_foot` has them, arms by their angles as `_arm_base` has them; a wrist of None does not turn.
    Returns   rotations (T, 3, 3) and origins (T, 3) by segment, balls (T, 2, 3)"""
    rots, poss = dict(rots), {"pelvis": pelvis, "chest": pelvis + rotate(rots["pelvis"], body.chest)}
    poss["head"] = poss["chest"] + rotate(rots["chest"], body.head)
    ball = np.zeros((len(heading), 2, 3))
    for j, (e, hip, foot) in enumerate(zip("lr", _hips(body, pelvis, rots["pelvis"]), feet, strict=True)):
        ankle, r_foot, yaw_foot = foot
        aim = 0.5 * (yaw_foot + heading)
        thigh, shin = two_bone_leg(hip, ankle, np.stack([np.cos(aim), np.sin(aim), 0 * aim], 1), body.thigh, body.shin)
        rots |= {f"thigh_{e}": thigh, f"shin_{e}": shin, f"foot_{e}": r_foot}
        poss[f"thigh_{e}"] = hip
        poss[f"shin_{e}"] = hip + rotate(thigh, np.array([0, 0, -body.thigh]))
        poss[f"foot_{e}"] = poss[f"shin_{e}"] + rotate(shin, np.array([0, 0, -body.shin]))
        ball[:, j] = poss[f"foot_{e}"] + rotate(r_foot, body.ball)
    for j, (e, sign) in enumerate((("l", 1), ("r", -1))):
        flex, abd, inward, elbow = angles[:, j].T
        upper = rots["chest"] @ about("y", -flex) @ about("x", sign * abd) @ about("z", -sign * inward)
        fore = hand = upper @ about("y", -elbow)
        if wrist is not None:
            hand = fore @ about("y", -wrist[:, j, 0]) @ about("x", sign * wrist[:, j, 1])
        rots |= {f"upper_arm_{e}": upper, f"forearm_{e}": fore, f"hand_{e}": hand}
        poss[f"upper_arm_{e}"] = poss["chest"] + rotate(rots["chest"], body.shoulder * [1, sign, 1])
        poss[f"forearm_{e}"] = poss[f"upper_arm_{e}"] + rotate(upper, np.array([0, 0, -body.upper_arm]))
        poss[f"hand_{e}"] = poss[f"forearm_{e}"] + rotate(fore, np.array([0, 0, -body.forearm]))
    return rots, poss, ball


def _continuous(quat):
    """(T, s, 4) without jumps between q and -q; the first has w > 0."""
    flip = np.where(np.sum(quat[1:] * quat[:-1], -1) < 0, -1.0, 1.0)
    first = np.where(quat[:1, :, 0] < 0, -1.0, 1.0)
    return quat * np.cumprod(np.concatenate([first, flip]), 0)[..., None]


def clip_of(rots, poss, ball, rate, name):
    """The dict that `generate` returns, of what `pose_body` returns."""
    quat = np.stack([Rotation.from_matrix(rots[k]).as_quat(scalar_first=True) for k in SEGMENTS], 1)
    pos = np.stack([poss[k] for k in SEGMENTS], 1)
    return {"pos": pos, "quat": _continuous(quat), "ball": ball, "rate": float(rate), "name": name}


def _asked_for(kind, duration, rate, params) -> GaitParams:
    """The parameters of a clip, checked; ValueError names what is valid."""
    if kind not in KINDS:
        raise ValueError(f"gait kind {kind!r}: valid are {', '.join(KINDS)}")
    valid = [f.name for f in fields(GaitParams)]
    if unknown := sorted(set(params) - set(valid)):
        raise ValueError(f"gait parameter {unknown[0]!r}: valid are {', '.join(valid)}")
    p = GaitParams(**{**DEFAULTS.get(kind, {}), **params})
    if p.gesture is not None and p.gesture not in GESTURES:
        raise ValueError(f"gesture {p.gesture!r}: valid are {', '.join(GESTURES)}")
    if duration * rate < 2 or p.height <= 0 or p.speed < 0:
        raise ValueError(f"duration {duration}, rate {rate}, height {p.height}, speed {p.speed}: must be positive")
    if not (0 <= p.strokes <= 5 and 0 <= p.sway <= 5 and 0 <= p.crouch <= 0.3):
        raise ValueError(
            f"strokes {p.strokes}, sway {p.sway}, crouch {p.crouch}: valid are 0 to 5 a second, 0 to 5, 0 to 0.3 m"
        )
    return p


def generate(kind, duration, rate=30.0, seed=0, **params):
    r"""One clip of procedural human motion.

    Equation  none: footholds on an integrated path, two-bone legs, normative curves (module docstring)
    ASSUMED   step width, place of the foothold under the body, lift of the foot (both set so that the knee and hip
              follow the curves), trunk and head amplitudes, lean of 0.6 of the balanced one in curves, arm poses of
              gestures, start and stop in 1.2 s, all random variation; in a crouch of 0.1 m the trunk bows by 12
              degrees and the pelvis goes back by 3 cm, so that the weight stays above the feet
    Args      kind : one of KINDS; duration [s]; rate [1/s]; seed : int
              params : fields of GaitParams
    Returns   dict pos (T, 15, 3) [m], quat (T, 15, 4) w, x, y, z, ball (T, 2, 3) left, right [m], rate, name;
              world frame; the path starts at the origin facing +x; segments in the order of SEGMENTS
    Raises    ValueError: unknown kind, parameter or gesture, or a value that makes no motion
    Test      tests/mocap/test_gait.py
    """
    p = _asked_for(kind, duration, rate, params)
    rng = np.random.default_rng(seed)
    play = np.random.default_rng([seed, 1])  # of strokes and crouches, so that a clip without them is what it was
    body, plan = Body(p.height), _Plan(kind, duration, rate, p, rng)

    def vary(sd):
        return 1 + sd * p.variation * np.clip(rng.standard_normal(), -2, 2)

    style = _style(plan, p, kind, vary)
    f = _frames(plan, p, rng, play)
    up, side = _sway(plan, p, f)
    rots, yaw = _trunk(plan, style, f, vary)
    scale = f.amount if plan.jog else np.minimum(f.amount, 1.1)
    feet = [_foot(plan, body, p, style, sign, scale) for sign in (1, -1)]
    pelvis = _pelvis(plan, body, style, f, feet, rots["pelvis"], up, side)
    angles, wrist = _arm_base(plan, f, vary(0.15), rng, p), None
    if kind == "gesture":
        angles = _gestures(angles, f.t, duration, p, rng)
    if p.strokes:
        angles, wrist = _strokes(angles, f.t, duration, p, play)
    return clip_of(*pose_body(body, pelvis, f.psi + yaw, feet, angles, wrist, rots), rate, f"{kind}_{seed}")


# The mix of `library`: kind and the ranges its parameters are drawn from, in an order that covers every kind early.
MIX = (
    ("walk", {"speed": (1.1, 1.4)}),
    ("turn", {"speed": (0.8, 1.2), "turn_rate": (0.3, 0.6)}),
    ("stand", {}),
    ("start", {"speed": (0.9, 1.3)}),
    ("jog", {"speed": (2.3, 2.7)}),
    ("gesture", {}),
    ("sidestep", {"sidestep": (0.25, 0.45)}),
    ("walk", {"speed": (0.5, 0.8)}),
    ("turn", {"speed": (0.7, 1.0), "turn_rate": (-1.0, -0.6)}),
    ("stop", {"speed": (1.0, 1.4)}),
    ("walk", {"speed": (1.4, 1.6)}),
    ("gesture", {"speed": (0.7, 1.2)}),
    ("jog", {"speed": (2.0, 2.4)}),
    ("turn", {"speed": (0.9, 1.3), "turn_rate": (0.5, 0.9), "weave": (True,)}),
    ("walk", {"speed": (0.8, 1.1)}),
    ("start", {"speed": (0.6, 1.0)}),
    ("sidestep", {"sidestep": (-0.45, -0.25)}),
    ("jog", {"speed": (2.6, 3.0), "turn_rate": (-0.3, 0.3)}),
    ("turn", {"speed": (0.6, 0.9), "turn_rate": (0.7, 1.0)}),
    ("walk", {"speed": (1.2, 1.5), "turn_rate": (-0.2, 0.2)}),
)


# ASSUMED mix of people who stand, look about, gesture, crouch, strike and step: what a user at home mostly does.
STANDING = (
    ("stand", {"sway": (1.0, 3.0), "crouch": (0.02, 0.05), "strokes": (0.5, 2.0)}),
    ("gesture", {"sway": (1.0, 3.0), "crouch": (0.02, 0.10)}),
    ("sidestep", {"sidestep": (0.2, 0.45), "strokes": (0.5, 2.0)}),
    ("stand", {"sway": (1.0, 2.0)}),
    ("start", {"speed": (0.5, 0.9), "sway": (1.0, 2.0)}),
    ("stand", {"sway": (1.0, 3.0), "crouch": (0.03, 0.15), "strokes": (0.3, 1.5)}),
    ("gesture", {"sway": (0.5, 2.0)}),
    ("sidestep", {"sidestep": (-0.45, -0.2), "sway": (1.0, 2.0)}),
    ("stand", {"sway": (0.5, 3.0), "strokes": (1.0, 3.0)}),
    ("stop", {"speed": (0.6, 1.2), "sway": (1.0, 2.0)}),
)

# ASSUMED mix of people who step back, to be played backwards (`mocap.data.builtin_clips`): slower and in shorter steps
# than they walk.
BACKWARDS = (
    ("stop", {"speed": (0.15, 0.3), "cadence": (75.0, 100.0)}),
    ("stop", {"speed": (0.3, 0.6), "cadence": (80.0, 105.0)}),
    ("start", {"speed": (0.2, 0.5), "cadence": (75.0, 100.0)}),
    ("stop", {"speed": (0.2, 0.4), "cadence": (75.0, 100.0), "turn_rate": (-0.25, 0.25)}),
    ("stop", {"speed": (0.5, 0.8), "cadence": (85.0, 110.0)}),
)


def library(minutes=10.0, rate=30.0, seed=0, mix=MIX):
    r"""An embedded data set: clips of 20 to 40 s of every kind of the mix, byte-identical for a seed.

    ASSUMED   the mix and its ranges; speeds grow with the root of the height (equal Froude number)
    Args      minutes : total length; rate [1/s]; seed : int; mix : MIX, STANDING or BACKWARDS
    Returns   list of clips as `generate` returns them; heights 1.5 to 1.9 m; strides within 6 % of the normative ones,
              where the mix does not say how many steps a minute
    Test      tests/mocap/test_gait.py::test_library_covers_everything, ::test_motions_are_what_they_were
    """
    rng = np.random.default_rng(seed)
    count = max(1, round(minutes * 2))
    length = rng.uniform(24.0, 36.0, count)
    cuts = np.concatenate([[0.0], np.cumsum(length) / length.sum()]) * minutes * 60 * rate
    frames = np.diff(np.round(cuts).astype(int))
    clips = []
    for i, n in enumerate(frames):
        kind, ranges = mix[i % len(mix)]
        params = {k: r[0] if len(r) == 1 else float(rng.uniform(*r)) for k, r in ranges.items()}
        params["height"] = float(rng.uniform(1.5, 1.9))
        if params.get("speed"):
            params["speed"] *= np.sqrt(params["height"] / 1.75)  # equal Froude number
            natural = float(stride_frequency(params["speed"], params["height"], kind == "jog"))
            params.setdefault("cadence", 120.0 * natural * float(rng.uniform(0.94, 1.06)))
        clip = generate(kind, n / rate, rate, seed=int(rng.integers(2**31)), **params)
        clips.append({**clip, "name": f"{i:02d}_{kind}"})
    return clips


def foot_report(clip):
    r"""How far feet skate and sink.

    Equation  contact: the lower of heel and ball is below 0.20 m and horizontally slower than 0.4 m/s
    Args      clip : dict of `generate`; the body height is read off the shin
    Returns   slide [m/s]: mean horizontal speed of the point in contact; sink [m]: deepest sole point below the floor
    Test      tests/mocap/test_gait.py::test_library_feet_neither_skate_nor_sink
    """
    body = body_of(clip)
    speeds, sink = [], 0.0
    for j, e in enumerate("lr"):
        i = SEGMENTS.index(f"foot_{e}")
        turn = Rotation.from_quat(clip["quat"][:, i], scalar_first=True)
        heel = clip["pos"][:, i] + turn.apply(body.heel)
        sole = clip["ball"][:, j] - [0, 0, body.ball_height]
        sink = max(sink, -heel[:, 2].min(), -sole[:, 2].min())
        velocity = [np.linalg.norm(np.diff(x[:, :2], axis=0), axis=1) * clip["rate"] for x in (heel, sole)]
        speed = np.where(heel[1:, 2] < sole[1:, 2], *velocity)
        low = np.minimum(heel, sole)[1:, 2]
        speeds.append(speed[(low < 0.20) & (speed < 0.4)])
    speeds = np.concatenate(speeds)
    return float(speeds.mean()) if len(speeds) else 0.0, float(sink)


def body_of(clip):
    """The Body a clip was made with."""
    shin = clip["pos"][0, SEGMENTS.index("foot_l")] - clip["pos"][0, SEGMENTS.index("shin_l")]
    return Body(float(np.linalg.norm(shin)) / 0.246)

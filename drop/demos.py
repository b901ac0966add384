r"""DROP's demonstrations  [DROP §8]: pushes, projectiles, collisions, constraints, platforms; measured and drawn.

    python -m drop DEMO [--prior nearest|vae] [--motion builtin] [--seed 0] [--png OUT.png] [--video OUT.mp4]

push         torso, hand and foot, small and large (§8.1)          constrain    a hand held by a force, by an energy
projectiles  balls thrown at a walker, who then dodges them        trip         the heel held for 1 s
collide      two characters, each an obstacle to the other         tilt         the platform under a walker tilts
follow       a direction that turns every 4 s, 1.2 and 2.5 m/s,    stiff-knee   a strong spring from hip to heel
             and led by the hand                                   ragdoll      no prior
backflip     a clip until the push, then the prior                 wrench       the root wrench of motions (Fig. 7)
weights      a table: weights against 1/h²                          energies, ablations, failures: drop/figures.py
all          every one of them

Red: forces from outside.  Blue: the contact forces of Eq. 11.  `fell` is a pelvis below 0.6 of its standing height, or
a trunk more than 60 degrees from the vertical, at the end or for half a second.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drop import body, keyposes, simulator
from drop.body import GRAVITY, LENGTHS, RADII, STANDING, STEP, J, N
from drop.momenta import root_wrench
from drop.pictures import check_outputs, write_pictures
from drop.prior import WEIGHTS, ClipPrior, NearestPrior, PoseRange, SwitchPrior, VaePrior, load_networks
from drop.rising import Rising
from drop.simulator import Plane, Simulator, Spheres
from human import Clip, heading, quat_about, quat_mul, quat_rotate
from mocap import gait
from mocap.data import MOTION, load
from plumbing.cli import NONNEGATIVE, UserError, arg, cli


@dataclass
class Options:
    """What to show."""

    prior: str = arg("nearest", "nearest transitions, the learned prior, the clip's next frame, or none (a rag doll)",
                     choices=("nearest", "vae", "clip", "none"))  # fmt: skip
    motion: str = arg("builtin", MOTION)
    clips: str = arg("*", "shell pattern on clip names, for files and folders")
    seed: int = arg(0, "seed of the prior's samples", check=NONNEGATIVE)
    png: str | None = arg(None, "write a contact sheet here")
    video: str | None = arg(None, "write an .mp4 here")
    correction: bool = arg(True, "the soft correction of the root wrench (Eq. 14)")
    contact: bool = arg(True, "the contact energy (Eq. 6)")
    limits: bool = arg(True, "the range-of-motion energy (Eq. 7)")
    rise: bool = arg(True, "who is down gets up (drop/rising.py)")
    range: str = arg("limits", "range of motion: joint limits, or the pose VAE (Eq. 15)", choices=("limits", "vae"))
    weights: str = arg(str(WEIGHTS), "of the learned priors, for `vae`")


# ------------------------------------------------------------------------------------ motions


BUILTIN = (  # kind, seconds, parameters of mocap.gait.generate: one body, so that nothing is scaled
    ("walk", 24, {"speed": 1.2}), ("walk", 16, {"speed": 0.8}), ("walk", 16, {"speed": 1.5}),
    ("jog", 20, {"speed": 2.5}), ("jog", 12, {"speed": 2.0}), ("jog", 12, {"speed": 3.0}),
    ("jog", 16, {"speed": 2.5, "turn_rate": 0.5}), ("jog", 16, {"speed": 2.5, "turn_rate": -0.5}),
    ("turn", 20, {"speed": 1.1, "turn_rate": 0.6}), ("turn", 20, {"speed": 1.1, "turn_rate": -0.6}),
    ("turn", 16, {"speed": 0.9, "turn_rate": 1.0}), ("turn", 16, {"speed": 0.9, "turn_rate": -1.0}),
    ("stand", 16, {}), ("start", 14, {}), ("stop", 14, {}),
    ("sidestep", 14, {"sidestep": 0.4}), ("sidestep", 14, {"sidestep": -0.4}),
)  # fmt: skip


def motions(opt):
    """(name, x, quat) of every clip of the options' motion, here.  Test: tests/drop/test_drop_demos.py::test_motions"""
    if opt.motion != "builtin":
        found = load(opt.motion, 1 / STEP, opt.clips)
    else:
        found = []
        for i, (kind, seconds, params) in enumerate(BUILTIN):
            m = gait.generate(kind, float(seconds), 1 / STEP, seed=i, height=1.75, **params)
            found.append(Clip(f"{kind}_{i:02d}", "builtin", m["rate"], m["pos"], m["quat"], m["ball"]))
    return [(c.name, *body.character_motion(c)) for c in found if len(c) > 30]


def pace(x):
    """Mean horizontal speed of a motion [m/s]."""
    return float(np.linalg.norm(np.diff(x[:, 0, :2], axis=0), axis=1).mean() / STEP)


def pick_motion(clips, speed):
    """The clip whose mean speed is nearest, among those that go straight ahead if there are any."""

    def badness(clip):
        x = clip[1][:, 0, :2]
        straight = np.linalg.norm(x[-1] - x[0]) / max(np.linalg.norm(np.diff(x, axis=0), axis=1).sum(), 1e-9)
        return abs(pace(clip[1]) - speed) + (1.0 if speed > 0.3 and straight < 0.9 else 0.0)

    return min(clips, key=badness)


# ------------------------------------------------------------------------------------ one take


@dataclass
class Take:
    """One recorded simulation: a list entry a frame."""

    name: str
    states: list = field(default_factory=list)  # one State a character
    outcomes: list = field(default_factory=list)
    arrows: list = field(default_factory=list)  # (place, force) from outside
    balls: list = field(default_factory=list)  # (place, radius, rgba)
    floor: list = field(default_factory=list)  # Plane
    notes: dict = field(default_factory=dict)
    window: tuple | None = None  # frames of the contact sheet, first and last; None is all

    def add(self, states, outcomes, arrows=(), balls=(), floor=None):
        """Record a frame."""
        self.states.append(states), self.outcomes.append(outcomes)
        self.arrows.append(list(arrows)), self.balls.append(list(balls)), self.floor.append(floor or Plane())


def fallen(state, floor=None):
    """Is the pelvis below 0.6 of its height, or the trunk beyond 60°?

    Test      tests/drop/test_drop_demos.py::test_fallen"""
    floor = floor or Plane()
    trunk = state.x[J["neck"]] - state.x[0]
    height = (state.x[0] @ floor.normal - floor.offset) / floor.normal[2]
    return bool(height < 0.6 * STANDING or trunk[2] < 0.5 * np.linalg.norm(trunk))


def measure(take):
    """What a take comes to, character by character: a list of dicts.

    Test      tests/drop/test_drop_demos.py::test_measure"""
    rows = []
    for k in range(len(take.states[0])):
        states, found = [s[k] for s in take.states], [o[k] for o in take.outcomes]
        x = np.array([s.x for s in states])
        down = np.array([fallen(s, f) for s, f in zip(states, take.floor)])
        long = np.convolve(down, np.ones(15), "valid").max() >= 15 if len(down) >= 15 else down.all()
        moves = np.linalg.norm(np.diff(x[:, body.FEET], axis=0), axis=-1) / STEP
        still = np.array([np.array_equal(a.normal, b.normal) for a, b in zip(take.floor, take.floor[1:])])
        held = np.array([o.active[body.FEET] for o in found])[1:] & (~down[1:] & still)[:, None]
        depth = max(float(-(s.x @ f.normal - f.offset - RADII).min()) for s, f in zip(states, take.floor))
        bones = np.abs(np.linalg.norm(np.einsum("kn,tnd->tkd", body.DIFFERENCE, x), axis=-1) / LENGTHS - 1)
        travel = np.linalg.norm(np.diff(x.mean(axis=1)[:, :2], axis=0), axis=1)
        terms = dict.fromkeys(n for o in found for n in o.energies)  # a rag doll has friction, who is led direction
        energy = {n: float(np.median([o.energies[n] for o in found if n in o.energies])) for n in terms}
        rows.append({
            "end": "fell" if down[-1] or long else "upright", "down": float(down.mean()),
            "limp": float(np.mean([o.sample < 0 for o in found])), "speed": float(travel.mean() / STEP),
            "slide": float(moves[held].mean()) if held.any() else 0.0, "below_mm": max(1e3 * depth, 0.0),
            "bone": float(bones.max()), "bone_pd": float(np.median([o.bone_error for o in found])),
            "wrench_pd": float(np.median([o.wrench_pd for o in found])),
            "wrench": float(np.median([o.wrench for o in found])),
            "energies": energy,
        })  # fmt: skip
    return rows


def report(take):
    """Lines of text for a take."""
    lines = []
    for k, r in enumerate(measure(take)):
        who = take.name + (f" [{k + 1}]" if len(take.states[0]) > 1 else "")
        lines.append(
            f"{who:26s} {r['end']:8s} down {100 * r['down']:3.0f} %  limp {100 * r['limp']:3.0f} %  "
            f"{r['speed']:4.2f} m/s  "
            f"foot slide {r['slide']:4.2f} m/s  below floor {r['below_mm']:3.0f} mm  bones {100 * r['bone']:.1e} %  "
            f"(before restoring {100 * r['bone_pd']:.1f} %)  wrench {r['wrench_pd']:5.1f} -> {r['wrench']:5.1f}"
        )
        lines.append("  J: " + "  ".join(f"{n} {v:.2f}" for n, v in r["energies"].items()))
    lines += [f"  {k}: {v}" for k, v in take.notes.items()]
    return "\n".join(lines)


class Stage:
    """Simulators and their shared options for one demonstration.

    Test      tests/drop/test_drop_demos.py::test_every_demo"""

    def __init__(self, opt):
        self.opt, self.clips = opt, motions(opt)
        self.general, self.limits = None, body.project_range_of_motion if opt.limits else None
        if "vae" in (opt.prior, opt.range):
            motion, pose, meta = load_networks(opt.weights)
            self.limits = PoseRange.of(pose, meta) if opt.limits and opt.range == "vae" else self.limits
        if opt.prior == "vae":
            self.general = VaePrior(motion)
        elif opt.prior == "nearest":
            self.general = NearestPrior([c[1:] for c in self.clips])

    def again(self):
        """A generator with the seed of the options: takes that are compared draw the same numbers."""
        return np.random.default_rng(self.opt.seed)

    def prior(self, x, quat, at):
        """The prior asked for; a clip's prior follows the clip the take starts from."""
        if self.opt.prior == "clip":
            return ClipPrior(x, quat, at)
        if self.general:
            self.general.floor = None  # an earlier demonstration may have tilted it
        return self.general and Rising(self.general, self.opt.rise)

    def wrench_limit(self, x):
        """The root wrench that is left alone in a motion x (T, 22, 3): by how hard its feet strike, not by the clip.

        Equation  WRENCH_LIMIT for one body weight on the toes; twice that at RUN or faster, where the ground's force
                  peaks at 2 to 2.5 weights (Novacheck 1998)
        Test: tests/drop/test_drop_demos.py::test_wrench_limit_is_physics"""
        return simulator.WRENCH_LIMIT * (2.0 if pace(x) >= RUN else 1.0)

    def start(self, speed, at=60, prior=None, place=None, turn=0.0, **settings):
        """A simulator and its first state: frame `at` of the clip nearest to `speed`, moved to `place` (2,)."""
        _, x, quat = pick_motion(self.clips, speed)
        at = min(at, len(x) // 2)
        if place is not None:
            spin = quat_about(2, turn - heading(quat[at, 0]))
            pivot = x[at, 0] * [1, 1, 0]
            x = quat_rotate(np.broadcast_to(spin, x.shape[:2] + (4,)), x - pivot) + [*place, 0.0]
            quat = quat_mul(np.broadcast_to(spin, quat.shape), quat)
        settings.setdefault("wrench_limit", self.wrench_limit(x))
        o = self.opt
        sim = Simulator(prior or self.prior(x, quat, at), correction=o.correction, contact=o.contact,
                        limits=self.limits, **settings)  # fmt: skip
        if hasattr(sim.prior, "floor"):
            sim.prior.floor = None
        return sim, sim.begin(x[at], quat[at], (x[at] - x[at - 1]) / STEP)


def single(name, sim, state, frames, rng, act):
    """Simulate one character; act(t, state) -> (force or None, arguments of Simulator.step, balls)."""
    take = Take(name)
    for t in range(frames):
        force, more, balls = act(t, state)
        state, found = sim.step(state, force, rng=rng, **more)
        arrows = (
            [] if force is None else [(state.x[j], force[j]) for j in np.flatnonzero(np.abs(force).max(axis=1) > 1)]
        )
        take.add([state], [found], arrows, balls, sim.obstacles[0] if isinstance(sim.obstacles[0], Plane) else None)
    return take


def one_force(joint, vector):
    """(22, 3) with one row."""
    f = np.zeros((N, 3))
    f[J[joint]] = vector
    return f


# ------------------------------------------------------------------------------------ the demonstrations

PUSH_FRAMES = (30, 38)  # a push lasts 0.27 s
FELLING = 300.0  # N for as long: nobody stays on his feet
RUN = 1.9  # m/s, where people of this size begin to run
PUSHES = {"torso": ("spine3", 40.0, 200.0), "hand": ("wrist_l", 30.0, 120.0), "foot": ("ankle_l", 40.0, 160.0)}  # [N]


def push(stage, rng):
    """§8.1: a sideways push of 0.27 s on torso, hand or foot of a walker and of a runner (--prior clip: tracked)."""
    takes = []
    for speed, word in ((1.2, "walk"), (2.5, "run")):
        if word == "run" and pace(pick_motion(stage.clips, speed)[1]) < RUN:
            print(f"no clip runs, at {RUN} m/s or more: nobody is pushed while running")
            continue
        sim, state = stage.start(speed)
        undisturbed = _centres(single("", sim, state, 180, stage.again(), lambda t, state: (None, {}, ())))
        for where, (joint, small, large) in PUSHES.items():
            for size, newton in (("small", small), ("large", large)):
                if word == "run" and where != "torso":
                    continue
                sim, state = stage.start(speed)
                left = quat_rotate(quat_about(2, heading(state.quat[0])), np.array([0.0, 1.0, 0.0]))
                act = pushing(joint, newton * left)
                take = single(f"{word} {where} {size} {newton:.0f} N", sim, state, 180, stage.again(), act)
                take.window = (30, 94)
                take.notes["away from the unpushed take"] = _displacement(take, undisturbed)
                take.notes["impulse"] = f"{newton * np.diff(PUSH_FRAMES)[0] * STEP:.0f} N s on {N} kg"
                takes.append(take)
    sim, state = stage.start(1.2)
    left = quat_rotate(quat_about(2, heading(state.quat[0])), np.array([0.0, FELLING, 0.0]))
    take = single(f"walk pushed over {FELLING:.0f} N", sim, state, 300, stage.again(), pushing("spine3", left))
    take.window = (30, 299)
    takes.append(take)
    return takes


def _centres(take):
    """Centre of mass on the floor (T, 2) of a take's first character."""
    return np.array([s[0].com[:2] for s in take.states])


def _displacement(take, undisturbed):
    away = 100 * np.linalg.norm(_centres(take) - undisturbed, axis=1)
    later = away[: PUSH_FRAMES[1] + round(1 / STEP)][-1]
    return f"{away[PUSH_FRAMES[1] - 1]:.1f} cm when the push ends, {later:.1f} 1 s later"


def pushing(joint, vector, frames=PUSH_FRAMES):
    """What `single` does in every frame: a constant force on a joint in those of `frames`.  vector (3,) [N]"""
    def act(t, state):
        return (one_force(joint, vector) if frames[0] <= t < frames[1] else None), {}, ()

    return act


@dataclass
class Ball:
    r"""A projectile.

    Equation  [DROP §8.2] f = −Σ_j k d_j on the ball's side, +k d_j on sphere j; Newton's second law for the ball
    ASSUMED   k = 4000 N/m, 1 kg, 16 sub-steps a frame, in which the body moves with its velocity: at 10 m/s a ball
              covers a third of a metre in a frame, and would pass through.  The frame's mean force goes to Eq. 1
    Test      tests/drop/test_drop_demos.py::test_ball_momentum
    """

    x: np.ndarray
    v: np.ndarray
    radius: float = 0.12
    mass: float = 1.0
    k: float = 4000.0

    def frame(self, state, floor=None, steps=16):
        """Move for one frame; returns the mean force on each sphere (22, 3) [N]."""
        total, h = np.zeros((N, 3)), STEP / steps
        floor = floor or Plane()
        for i in range(steps):
            d = state.x + i * h * state.v - self.x
            r = np.linalg.norm(d, axis=1)
            depth = np.maximum(RADII + self.radius - r, 0.0)
            f = self.k * depth[:, None] * d / np.maximum(r, 1e-9)[:, None]
            total += f / steps
            self.v = self.v + h * (GRAVITY - f.sum(axis=0) / self.mass)
            self.x = self.x + h * self.v
            under = self.radius - (self.x @ floor.normal - floor.offset)
            if under > 0 and self.v @ floor.normal < 0:  # a dull bounce
                self.x = self.x + under * floor.normal
                self.v = 0.7 * (self.v - 1.5 * (self.v @ floor.normal) * floor.normal)
        return total


DODGE = 3.0  # m/s², ASSUMED: how fast who dodges changes his velocity; friction of 0.8 would allow 7.8


def ramp(v, way, t, a=DODGE):
    """Velocity and way gone after t seconds of who changes from velocity v (2,) to way (..., 2) by a [m/s²] at most.

    Test      tests/drop/test_drop_demos.py::test_escape"""
    change = way - v
    size = np.linalg.norm(change, axis=-1, keepdims=True)
    lasts = np.minimum(t, size / a)
    unit = change / np.maximum(size, 1e-9)
    return v + a * lasts * unit, v * t + a * unit * lasts * (t - 0.5 * lasts)


def escape(state, balls, speed=1.4, lead=None):
    r"""The velocity that leads farthest from the balls' paths, as far as a body can take it up in a frame.

    Equation  [DROP §8.2] v_tar as far as can be from the balls: the best of 16 horizontal directions
    Why       a target that jumps asks Eq. 16 for 150 to 600 N of root wrench; feet bear 170, and the dodger was dragged
              over the floor on crossed legs, or fell
    ASSUMED   farthest: the smallest distance, over balls and the next second, between the centre of mass that goes over
              to that velocity (`ramp`) and the ball flying straight; only balls that come nearer within 6 m count;
              DODGE, by which v_tar goes from the last one (`lead`), or from the body's velocity, towards that velocity
    Returns   (2,) [m/s] or None where no ball threatens
    Test      tests/drop/test_drop_demos.py::test_escape
    """
    com, v = state.com[:2], state.v.mean(axis=0)[:2] if lead is None else lead
    near = [b for b in balls if np.linalg.norm(b.x[:2] - com) < 6 and (b.x[:2] - com) @ b.v[:2] < -1.0]
    if not near:
        return None
    angle = 2 * np.pi * np.arange(16) / 16
    ways = speed * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    times = np.linspace(0.1, 1.0, 10)
    gone = np.array([ramp(v, ways, t)[1] for t in times])
    miss = [
        np.linalg.norm(com + gone - b.x[:2] - times[:, None, None] * b.v[:2], axis=-1).min(axis=0) for b in near
    ]
    return ramp(v, ways[int(np.min(miss, axis=0).argmax())], STEP)[0]


def projectiles(stage, rng, dodging=(False, True)):
    """§8.2: balls of 1 kg at 9 m/s, every 0.9 s from another side; then the same with dodging."""
    takes = []
    for dodge in dodging:
        sim, state = stage.start(1.2)
        balls, seen, lead = [], set(), [None]
        if dodge:
            turning(stage, sim)
        sides = np.radians([90, -60, 180, 30, -120, 100])

        def act(t, state, balls=balls, sides=sides, seen=seen, dodge=dodge, lead=lead):
            if t % 27 == 15 and len(balls) < len(sides):
                a = sides[len(balls)] + heading(state.quat[0])
                from_ = state.com + 5.0 * np.array([np.cos(a), np.sin(a), 0.0])
                time = 5.0 / 9.0
                aim = state.com + time * state.v.mean(axis=0) * [1, 1, 0] + [0, 0, 0.25]
                balls.append(Ball(from_, (aim - from_) / time - 0.5 * GRAVITY * time))
            force = np.zeros((N, 3))
            for i, ball in enumerate(balls):
                f = ball.frame(state)
                if np.abs(f).max() > 1:
                    seen.add(i)
                force += f
            lead[0] = escape(state, balls, lead=lead[0]) if dodge and not fallen(state) else None
            return force, {"v_tar": lead[0]}, [(b.x, b.radius, (0.9, 0.6, 0.1, 1)) for b in balls]

        take = single("projectiles" + (" dodging" if dodge else ""), sim, state, 210, rng, act)
        take.notes["balls that hit"] = f"{len(seen)} of {len(balls)}"
        near = [min((np.linalg.norm(p - s[0].com) for p, _, _ in balls if p[2] > 0.4), default=9.0)
                for s, balls in zip(take.states, take.balls)]  # fmt: skip
        nearest = int(np.argmin(near))  # the sheet: every other frame around the ball that comes nearest
        take.window = (max(nearest - 8, 0), min(nearest + 8, len(near) - 1))
        size = np.array([o[0].wrench for o in take.outcomes])
        take.notes["root wrench"] = f"median {np.median(size):.0f}, 95 % {np.percentile(size, 95):.0f}"
        takes.append(take)
    return takes


def collide(stage, rng):
    """§8.2: two characters, each simulated alone with the other's spheres as obstacles.

    ASSUMED   people do not stick to each other (`Spheres.slippery`), and each wants to go on the way he went: Eq. 16
              with the speed of his clip, and samples that turn as a follower's do.  Without a way of their own they
              stand breast to breast for ever: the samples follow the state, and of who is stopped all samples stand
    Test      tests/drop/test_drop_demos.py::test_collide, ::test_who_collides_goes_on
    """
    takes = []
    for speeds, word in (((1.2, 1.2), "walk into walk"), ((2.5, 1.2), "run into walk")):
        pair = [stage.start(v, at=60 + 7 * i, place=((-1.5 - (v > 2), 0.1) if i == 0 else (1.5, -0.1)), turn=np.pi * i)
                for i, v in enumerate(speeds)]  # fmt: skip
        for sim, _ in pair:
            turning(stage, sim)
        sims, states = [p[0] for p in pair], [p[1] for p in pair]
        goals = [pace(pick_motion(stage.clips, v)[1]) * np.array([1.0 - 2.0 * i, 0.0]) for i, v in enumerate(speeds)]
        take = Take(word)
        nearest, touching = np.inf, 0
        for _ in range(150):
            for sim, other in zip(sims, reversed(states)):
                sim.obstacles = (Plane(), Spheres(other.x, RADII, slippery=True))
            steps = [sim.step(state, v_tar=v, rng=rng) for sim, state, v in zip(sims, states, goals)]
            states = [s for s, _ in steps]
            apart = np.linalg.norm(states[0].x[:, None] - states[1].x, axis=-1) - RADII[:, None] - RADII
            nearest, touching = min(nearest, float(apart.min())), touching + (apart.min() < simulator.WRENCH_MARGIN)
            take.add(states, [o for _, o in steps])
        take.window = (15, 75)
        take.notes["deepest overlap of the two"] = f"{max(-100 * nearest, 0):.1f} cm"
        take.notes["they touch"] = f"for {touching * STEP:.1f} s"
        takes.append(take)
    return takes


def turning(stage, sim):
    """Samples of the learned prior that turn, as those of nearest transitions do, where a direction leads."""
    if isinstance(stage.general, VaePrior):
        sim.prior.prior = VaePrior(stage.general.net, spread=0.3)


def follow(stage, rng):
    r"""§8.2: a red dot runs along a square, turning left every 4 s; Eq. 16 draws the character after it.

    ASSUMED   v_tar points at the dot; its size is the dot's speed times the distance over 0.6 s of way, at most 1.25
    Test      tests/drop/test_drop_demos.py::test_follower_keeps_the_speed
    """
    takes = ((1.2, False, 1.2), (2.5, False, 1.2), (2.5, False, 2.5), (1.2, True, 1.2), (2.5, True, 2.5))
    return [_follow(stage, stage.again(), speed, led, begin) for speed, led, begin in takes]


LEAD_STIFFNESS, LEAD_LIMIT = 200.0, 40.0  # N/m, N, ASSUMED: the hand that leads


def _follow(stage, rng, speed, led, begin, frames=480):
    limit = simulator.WRENCH_LIMIT * (2.0 if speed >= RUN else 1.0)
    sim, state = stage.start(begin, wrench_limit=limit)
    turning(stage, sim)
    yaw, ahead, reach = heading(state.quat[0]), 0.6 * speed, []
    way = lambda t: yaw + (t * STEP // 4) * np.pi / 2  # noqa: E731
    dot = state.com[:2] + ahead * np.array([np.cos(yaw), np.sin(yaw)])

    def act(t, state):
        nonlocal dot
        dot = dot + speed * STEP * np.array([np.cos(way(t)), np.sin(way(t))])
        gap = dot - state.com[:2]
        far = np.linalg.norm(gap)
        v = speed * gap / max(far, 1e-9) * min(far / ahead, 1.25)
        force = None
        if led:  # the hand is drawn to a place half a metre towards the dot
            place = np.append(state.com[:2] + 0.5 * gap / max(far, 1e-9), 1.1)
            pull = LEAD_STIFFNESS * (place - state.x[J["wrist_r"]])
            force = one_force("wrist_r", pull * min(1.0, LEAD_LIMIT / max(np.linalg.norm(pull), 1e-9)))
            reach.append(np.linalg.norm(place - state.x[J["wrist_r"]]))
        return force, {"v_tar": v}, [(np.append(dot, 0.06), 0.06, (0.9, 0.1, 0.1, 1))]

    how = f" from {begin} m/s" * (begin != speed) + " led by the hand" * led
    take = single(f"follow {speed} m/s{how}", sim, state, frames, rng, act)
    take.window = (90, 180)  # before and after the first turn
    flies = [o[0].active[body.FEET].sum() == 0 for o in take.outcomes[frames // 2 :]]
    take.notes["both feet off the floor"] = f"in {100 * np.mean(flies):.0f} % of the second half's frames"
    com = np.array([s[0].com[:2] for s in take.states])
    face = np.array([heading(s[0].quat[0]) for s in take.states])[1:]
    v, t = np.diff(com, axis=0) / STEP, np.arange(1, frames)
    late, a = t * STEP % 4 > 2, np.array([way(i) for i in t])
    off = np.abs((face - a + np.pi) % (2 * np.pi) - np.pi)
    mean = np.linalg.norm(v, axis=1).mean()
    along = np.sum(v * np.stack([np.cos(a), np.sin(a)], axis=1), axis=1)[late].mean()
    take.notes["mean speed"] = f"{mean:.2f} m/s, {100 * (mean / speed - 1):+.0f} % of the target"
    take.notes["2 s after each turn"] = (
        f"{along:.2f} m/s along the dot's way, heading off by {np.degrees(off[late].mean()):.0f} degrees"
    )
    if led:
        take.notes["hand to the place it is led to"] = f"{100 * np.mean(reach):.0f} cm on average"
    return take


def constrain(stage, rng):
    """§8.2: the right hand of someone standing drawn to a place by a force, and by an energy."""
    takes = []
    for kind in ("force", "energy"):
        sim, state = stage.start(0.0)
        yaw = quat_about(2, heading(state.quat[0]))
        goal = state.x[J["wrist_r"]] + quat_rotate(yaw, np.array([0.25, -0.05, 0.20]))

        def act(t, state, goal=goal, kind=kind):
            ball = [(goal, 0.04, (0.9, 0.1, 0.1, 1))]
            if not 30 <= t < 120:
                return None, {}, ball
            if kind == "force":
                return one_force("wrist_r", 400.0 * (goal - state.x[J["wrist_r"]])), {}, ball
            return None, {"pins": {J["wrist_r"]: goal}}, ball

        take = single(f"constrain by {kind}", sim, state, 180, rng, act)
        d = np.array([np.linalg.norm(s[0].x[J["wrist_r"]] - goal) for s in take.states])
        take.notes["hand to its place"] = (
            f"{100 * d[29]:.0f} cm before, {100 * np.median(d[:120][-30:]):.1f} cm held, {100 * d[-1]:.0f} cm after"
        )
        takes.append(take)
    return takes


TRIP_WEIGHT = 5e-6  # w_p of Eq. 14 in a trip, ASSUMED: takes 95 % of a pitching torque away, as the default of a force


def trip(stage, rng):
    """§8.2: the left heel of a walker and of a runner held for 1 s, caught as it swings past the other foot.

    ASSUMED   TRIP_WEIGHT.  The default leaves a fifth of the torque by which the prior holds the trunk upright, enough
              for four of eight tripped walkers to stop and stand; with 1e-5 everywhere all who follow a direction fall
              in turns
    Test      tests/drop/test_drop_demos.py::test_the_tripped_stumble
    """
    return [_trip(stage, stage.again(), speed) for speed in (1.2, 2.5)]


def _trip(stage, rng, speed, hold=30):
    sim, state = stage.start(speed, wrench_weight=TRIP_WEIGHT)
    held = {}

    def act(t, state):
        forward = quat_rotate(quat_about(2, heading(state.quat[0])), np.array([1.0, 0, 0]))
        ahead = (state.x[J["ankle_l"]] - state.x[J["ankle_r"]]) @ forward
        if not held and t > 20 and -0.15 < ahead < 0.05 and state.v[J["ankle_l"]] @ forward > 1.0:
            held.update(at=state.x[J["ankle_l"]].copy(), t=t, ahead=ahead)
        on = held and t < held["t"] + hold
        ball = [(held["at"], 0.05, (0.9, 0.1, 0.1, 1))] if on else []
        return None, ({"pins": {J["ankle_l"]: held["at"]}} if on else {}), ball

    take = single(f"trip at {speed} m/s", sim, state, 180, rng, act)
    trunk = np.array([s[0].x[J["neck"]] - s[0].x[0] for s in take.states])
    lean = np.degrees(np.arccos(np.clip(trunk[:, 2] / np.linalg.norm(trunk, axis=1), -1, 1)))
    pace_of = np.array([np.linalg.norm(s[0].v.mean(axis=0)[:2]) for s in take.states])
    if held:
        t, end = held["t"], held["t"] + hold
        moved = max(np.linalg.norm(s[0].x[J["ankle_l"]] - held["at"]) for s in take.states[t:end])
        take.window = (t - 3, t + 61)
        take.notes["heel held"] = (
            f"from {t * STEP:.1f} s for {hold * STEP:.0f} s, {-100 * held['ahead']:.0f} cm behind the other, "
            f"within {100 * moved:.1f} cm"
        )
        take.notes["stumble"] = (
            f"trunk from {np.mean(lean[:t]):.0f} to {max(lean[t : end + 30]):.0f} degrees; {pace_of[:t].mean():.2f} m/s"
            " "
            f"before, {pace_of[t : end + 15].min():.2f} at the least, {pace_of[-15:].mean():.2f} at the end"
        )
    return take


def tilt(stage, rng):
    """§8.2: the platform under a walker tilts about the axis it walks along, 10 degrees a second to 15; and uphill.

    Test      tests/drop/test_drop_demos.py::test_a_tilted_walker_walks_on"""
    takes = []
    for axis, word in ((np.array([1.0, 0, 0]), "sideways"), (np.array([0, -1.0, 0]), "uphill")):
        sim, state = stage.start(1.2, place=(0.0, 0.0))
        pivot = np.array([0.6, 0.0, 0.0])

        def act(t, state, axis=axis, pivot=pivot, sim=sim):
            angle = np.radians(np.clip((t - 30) * STEP * 10, 0, 15))
            normal = np.array([0, 0, np.cos(angle)]) + np.sin(angle) * np.cross(axis, [0, 0, 1.0])
            plane = Plane(normal, float(normal @ pivot))
            sim.obstacles = (plane,)
            if hasattr(sim.prior, "floor"):
                sim.prior.floor = plane
            return None, {}, ()

        take = single(f"tilt {word}", sim, state, 180, rng, act)
        takes.append(take)
    return takes


def stiff_knee(stage, rng):
    """§8.2: a strong spring between left hip and left heel."""
    length = LENGTHS[J["knee_l"] - 1] + LENGTHS[J["ankle_l"] - 1]
    takes = []
    for springs, word in (((), "free knee"), (((J["hip_l"], J["ankle_l"], length, 300.0),), "stiff knee")):
        sim, state = stage.start(1.2, springs=springs)
        take = single(word, sim, state, 180, rng, lambda t, state: (None, {}, ()))
        for side in "lr":
            a, b, c = (
                np.array([s[0].x[J[f"{n}_{side}"]] for s in take.states[len(take.states) // 4 :]])
                for n in ("hip", "knee", "ankle")
            )
            cos = np.sum((b - a) * (c - b), axis=1) / np.linalg.norm(b - a, axis=1) / np.linalg.norm(c - b, axis=1)
            take.notes[f"flexion of the {'left' if side == 'l' else 'right'} knee"] = (
                f"to {np.degrees(np.arccos(cos.clip(-1, 1))).max():.0f} degrees"
            )
        takes.append(take)
    return takes


def ragdoll(stage, rng):
    """§8.3: no prior; a walker and someone thrown."""
    takes = []
    for lift, word in ((0.0, "rag doll"), (1.0, "rag doll thrown")):
        sim, state = stage.start(1.2)
        sim.prior = None
        state = replace(state, x=state.x + [0, 0, lift], v=state.v + [lift, 0, 0])
        take = single(word, sim, state, 120, rng, lambda t, state: (None, {}, ()))
        lying = [t for t, s in enumerate(take.states) if s[0].com[2] < 0.25]
        still = np.linalg.norm(take.states[-1][0].v, axis=1).mean()
        take.notes["lies"] = f"after {lying[0] * STEP:.1f} s; speed at the end {still:.2f} m/s" if lying else "no"
        takes.append(take)
    return takes


def backflip(stage, rng):
    """§8.1: a clip that turns upside down is tracked until a push, then the prior takes over.

    Without one among the clips it is the built-in one of drop/keyposes.py."""
    for name, x, quat in stage.clips:  # noqa: B007 (used after the loop)
        up = quat_rotate(quat[:, 0], np.broadcast_to([0.0, 0.0, 1.0], (len(quat), 3)))[:, 2]
        if up.min() < -0.5:
            break
    else:
        name, (x, quat) = "built in", keyposes.leap()
        up = quat_rotate(quat[:, 0], np.broadcast_to([0.0, 0.0, 1.0], (len(quat), 3)))[:, 2]
    landing = int(np.flatnonzero(up < -0.5)[-1])
    first, at = max(landing - 45, 1), min(landing + 12, len(x) - 2)
    onset = at - first
    after = stage.prior(x, quat, first) or ClipPrior(x, quat, first)
    sim, _ = stage.start(0.0, prior=SwitchPrior(ClipPrior(x, quat, first), after, onset))
    state = sim.begin(x[first], quat[first], (x[first] - x[first - 1]) / STEP)
    act = pushing("spine3", np.array([0.0, 60.0, 0.0]), (onset, onset + 8))
    take = single(f"backflip {name}", sim, state, onset + 240, rng, act)
    take.window = (onset - 40, onset + 200)
    return [take]


def wrench(stage, rng):
    """§8.5, Fig. 7: the root wrench of the clips, points and cylinders; of a pushed run, corrected or not."""
    for name, x, quat in (*stage.clips[:12], ("built-in jump", *keyposes.leap(0.0))):
        a, b = (root_wrench(x[:240], quat[:240], c) for c in (False, True))
        print(
            f"{name:24s} {pace(x):4.2f} m/s  points: median {np.median(a):5.1f}, 95 % {np.percentile(a, 95):5.1f}   "
            f"cylinders: {np.median(b):5.1f}, {np.percentile(b, 95):5.1f}   correlation {np.corrcoef(a, b)[0, 1]:.2f}"
        )
    takes = []
    for correction in (False, True):
        sim, state = stage.start(2.5)
        sim.correction = correction
        undisturbed = _centres(single("", sim, state, 120, stage.again(), lambda t, state: (None, {}, ())))
        act = pushing("spine3", np.array([0.0, 120.0, 0.0]))
        take = single(f"run pushed {'' if correction else 'un'}corrected", sim, state, 120, stage.again(), act)
        take.window = (30, 94)
        pd, left = (np.array([getattr(o[0], n) for o in take.outcomes]) for n in ("wrench_pd", "wrench"))
        for word, part in (("whole take", slice(None)), ("second from the push on", slice(30, 60))):
            take.notes[f"root wrench, {word}"] = (
                f"solved: median {np.median(pd[part]):.0f}, 95 % {np.percentile(pd[part], 95):.0f}; "
                f"in the motion: {np.median(left[part]):.0f}, {np.percentile(left[part], 95):.0f}"
            )
        take.notes["away from the unpushed take"] = _displacement(take, undisturbed)
        takes.append(take)
    return takes


SCALES = ((1, 3), (3, 9), (10, 30), (100, 3), (30, 9), (300, 9))  # w_1, and w_2, w_3, w_kin, of `weights`


def weights(stage, rng):
    """REPRODUCE.md's table of weights against 1/h²; prints, and has no take.

    Columns   bone: largest error before lengths are restored, 100 N for 0.27 s on a walker's torso; hand: how far 100 N
              move it by then; swing, period: the forearm released at 60 degrees from a held elbow, after 1/3 s; alone:
              its bone error without restoring; walk, run: speed and foot slide of 3 s unperturbed
    Test      tests/drop/test_drop_demos.py::test_weights
    """
    print("w_1; others   bone     hand   swing   period    alone    walk          run")
    nothing = lambda t, state: (None, {}, ())  # noqa: E731
    for rigid, other in SCALES:
        w = simulator.Weights(rigid, other, other, other)
        sim, state = stage.start(1.2, weights=w)
        left = quat_rotate(quat_about(2, heading(state.quat[0])), np.array([0.0, 100.0, 0.0]))
        torso, hand, free = (single("", sim, state, 18, stage.again(), act) for act in (
            pushing("spine3", left, (10, 18)), pushing("wrist_l", left, (10, 18)), nothing))  # fmt: skip
        bone = max(o[0].bone_error for o in torso.outcomes)
        moved = np.linalg.norm((hand.states[-1][0].x - free.states[-1][0].x)[J["wrist_l"]])
        (angle, _), (_, alone) = forearm(w), forearm(w, restore=False)
        cross = np.flatnonzero(angle[:-1] * angle[1:] < 0)
        at = cross + angle[cross] / (angle[cross] - angle[cross + 1])
        gaits = []
        for speed in (1.2, 2.5):
            sim, state = stage.start(speed, weights=w)
            gaits += measure(single("", sim, state, 90, stage.again(), nothing))
        print(
            f"{rigid:3d}; {other:3d}     {100 * bone:5.1f} %  {100 * moved:4.0f} cm  "
            f"{np.degrees(angle[0] - angle[10]):4.1f}°  {2 * STEP * np.diff(at).mean():.3f} s  {100 * alone:5.2f} %   "
            + "   ".join(f"{r['speed']:.2f}, {r['slide']:.2f}" for r in gaits)
        )
    return []


def forearm(w, degrees=60.0, restore=True, steps=60):
    """The left forearm swinging from a held elbow: angles (steps + 1,) [rad], largest relative error of the bone.

    Test: tests/drop/test_drop_demos.py::test_weights"""
    sim = Simulator(None, weights=replace(w, constraint=1e5, friction=0.0), contact=False, limits=None, restore=restore)
    rest = np.tile([1.0, 0.0, 0.0, 0.0], (N, 1))
    x, e, k = body.forward_kinematics(body.OFFSETS[0], rest), J["elbow_l"], J["wrist_l"]
    theta = np.radians(degrees)
    x[k] = x[e] + LENGTHS[k - 1] * np.array([np.sin(theta), 0.0, -np.cos(theta)])
    pins = {j: x[j].copy() for j in range(N) if j != k}
    state, angles, worst = sim.begin(x, rest), [theta], 0.0
    for _ in range(steps):
        state, _ = sim.step(state, pins=pins)
        bone = state.x[k] - state.x[e]
        angles.append(np.arctan2(bone[0], -bone[2]))
        worst = max(worst, abs(np.linalg.norm(bone) / LENGTHS[k - 1] - 1))
    return np.array(angles), worst


DEMOS = {
    "push": push, "projectiles": projectiles, "collide": collide, "follow": follow, "constrain": constrain,
    "trip": trip,
    "tilt": tilt, "stiff-knee": stiff_knee, "ragdoll": ragdoll, "wrench": wrench, "backflip": backflip,
    "weights": weights,
}  # fmt: skip


# ------------------------------------------------------------------------------------ command line


def main(argv, others=()):
    """Run one demonstration, print what it measured, draw it.

    Args      others : words that `python -m drop` knows, too, for the messages
    Test      tests/drop/test_drop_demos.py::test_command"""
    argv, valid = list(argv), [*DEMOS, "all", *others]
    name = argv.pop(0) if argv and not argv[0].startswith("-") else None
    if name is None and (late := next((a for a in argv if a in valid), None)):
        rest = " ".join(a for a in argv if a != late)
        raise UserError(f"the demonstration comes first: python -m drop {late} {rest}")
    opt = cli(Options, argv, f"python -m drop {name or 'DEMO'}", __doc__)
    if name not in (*DEMOS, "all"):
        raise UserError(
            f"python -m drop needs a demonstration{f', not {name!r}' if name else ''}; valid: {', '.join(valid)}"
        )
    check_outputs(opt)
    stage, takes = Stage(opt), []
    print(f"{len(stage.clips)} clips, {sum(len(c[1]) for c in stage.clips) * STEP / 60:.1f} min; prior {opt.prior}")
    for each in DEMOS if name == "all" else [name]:
        takes += DEMOS[each](stage, np.random.default_rng(opt.seed))
    for take in takes:
        print(report(take))
    if takes and (opt.png or opt.video):
        write_pictures(takes, opt)

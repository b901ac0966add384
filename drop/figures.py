r"""DROP's figures, ablations and failures  [DROP §8.3, §8.4, §8.7].

    python -m drop energies [--prior vae] [--range vae] [--count 250] --png OUT.png --csv OUT.csv     Figs. 4 to 7
    python -m drop ablations [--prior vae]                                                             §8.3
    python -m drop failures [--prior vae] [--png OUT.png]                                              §8.7

energies    motions pushed at the pelvis in frames 63 to 78: medians of every term of Eq. 1, with the energy that the
            prior's mean alone would have had; the same without contact and range of motion; one motion; root wrenches
ablations   one push, five times: whole, and without prior, range of motion, contact, soft correction
failures    pushed over, a prior that is asked all the same goes on moving the body as no muscle could; what finds it:
            the root wrench, the joint torques, a spinning pelvis (REPRODUCE.md has what each found)
"""

from __future__ import annotations

import csv
import io
import time
import warnings
from dataclasses import dataclass, replace

import numpy as np

from drop import body, demos, momenta, pictures, simulator
from drop.body import GRAVITY, PARENTS, STANDING, STEP, N
from drop.simulator import Plane, Simulator
from human import quat_angle
from plumbing import render
from plumbing.cli import NONNEGATIVE, POSITIVE, arg, cli
from plumbing.files import atomic_write

PUSHED = (63, 78)  # frames of the push, §8.4
RECOVERY = (100, 150)  # frames of the 30 % claim
TERMS = ("prior", "prior mean", "momentum", "rigidity", "contact", "range_of_motion")
PHYSICS = TERMS[2:]


@dataclass
class Options(demos.Options):
    """What to draw."""

    count: int = arg(250, "energies: motions", check=POSITIVE)
    frames: int = arg(160, "energies: frames of each", check=POSITIVE)
    newton: float = arg(150.0, "the push, 0.5 s on the pelvis, horizontally anywhere [N on 22 kg]", check=POSITIVE)
    samples: int = arg(16, "energies: samples of the prior a frame", check=POSITIVE)
    inside: float = arg(simulator.Weights.inside, "energies: weight of the drag that the range of motion is inside",
                        check=NONNEGATIVE)  # fmt: skip
    csv: str | None = arg(None, "energies: write the medians here")


# ------------------------------------------------------------------------------------ Figs. 4 to 6


class Watched(Simulator):
    r"""A Simulator that measures the range of motion by one rule, also where it is switched off.

    Test: tests/drop/test_drop_figures.py::test_watched"""

    measure = staticmethod(body.project_range_of_motion)

    def energies(self, x, y, x_t, x_kin, twist, v_tar=None, pins=None, solved=None, here=None):
        """As Simulator's."""
        kept, self.limits = self.limits, self.measure
        try:
            return super().energies(x, y, x_t, x_kin, twist, v_tar, pins, solved, here)
        finally:
            self.limits = kept


def pushed(sim, state, frames, force, rng):
    r"""Energies of one pushed motion.

    Equation  "prior mean" is E_kin with the mode as the only sample: (w_kin/2) ‖x − M(x_t, μ0)‖² at the solved x, a
              hypothetical term: the simulation itself has the whole set (§8.4)
    Args      force : (22, 3) [N] in frames PUSHED
    Returns   (frames, 6) [J] by TERMS, NaN where the prior had no sample; (frames,) bool: fallen
    Test      tests/drop/test_drop_figures.py::test_prior_mean
    """
    out, down = np.full((frames, len(TERMS)), np.nan), np.zeros(frames, bool)
    for t in range(frames):
        before = state
        state, found = sim.step(state, force if PUSHED[0] <= t < PUSHED[1] else None, rng=rng)
        e = found.energies
        if found.sample >= 0:
            mode = sim.prior.mode(before)[0]
            out[t, :2] = e["prior"], 0.5 * sim.w.prior / STEP**2 * np.sum((state.x - mode) ** 2)
        out[t, 2:] = [e[k] for k in PHYSICS]
        down[t] = demos.fallen(state)
    return out, down


def ensemble(stage, opt, contact=True, limits=True):
    r"""Energies of opt.count random motions, all pushed in the same frames.

    Method    a random frame of a random clip (clips weigh as their frames do); direction of the push at random; the
              same motions and pushes whatever is switched off
    Returns   (count, frames, 6) [J]; (count, frames) fallen; motions' names
    Test      tests/drop/test_drop_figures.py::test_ensemble
    """
    rng = np.random.default_rng(opt.seed)
    weights = np.array([max(len(c[1]) - 2, 0) for c in stage.clips], float)
    energies, down, names = [], [], []
    for _ in range(opt.count):
        name, x, quat = stage.clips[rng.choice(len(weights), p=weights / weights.sum())]
        at, angle = int(rng.integers(1, len(x) - 1)), rng.uniform(0, 2 * np.pi)
        prior = stage.prior(x, quat, at)
        if hasattr(prior, "floor"):
            prior.floor = None
        sim = Watched(prior, contact=contact, limits=stage.limits if limits else None, correction=opt.correction,
                      samples=opt.samples, weights=simulator.Weights(inside=opt.inside))  # fmt: skip
        sim.measure = stage.limits or body.project_range_of_motion
        state = sim.begin(x[at], quat[at], (x[at] - x[at - 1]) / STEP)
        force = demos.one_force("pelvis", opt.newton * np.array([np.cos(angle), np.sin(angle), 0.0]))
        e, d = pushed(sim, state, opt.frames, force, np.random.default_rng([opt.seed, len(names)]))
        energies.append(e), down.append(d), names.append(name)
    return np.array(energies), np.array(down), names


def median(energies):
    """Medians over motions (frames, 6), NaN left out.  Test: tests/drop/test_drop_figures.py::test_claims"""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a frame in which no motion had a sample: NaN
        return np.nanmedian(energies, axis=0)


def lowered(full):
    r"""The share of E_kin that the whole set of samples takes away in recovery  [DROP §8.4, Fig. 4].

    Equation  mean over the frames RECOVERY of 1 − E_kin/E_mean, of medians (frames, 6)
    Test      tests/drop/test_drop_figures.py::test_claims
    """
    a = full[RECOVERY[0] : RECOVERY[1]]
    with np.errstate(invalid="ignore"):
        share = 1.0 - a[:, 0] / a[:, 1]
    found = share[np.isfinite(share)]  # a frame in which everybody lies has none
    return float(found.mean()) if len(found) else float("nan")


def claims(full, bare):
    r"""The numbers that §8.4 claims, from medians (frames, 6).

    Returns   dict: lowered : 1 − E_kin/E_mean, mean over the frames RECOVERY; prior, physics : final energies without
              contact and range of motion over those with, of the last ten frames
    Test      tests/drop/test_drop_figures.py::test_claims
    """
    b = [m[-10:] for m in (full, bare)]
    sums = [m[:, 2:].sum(axis=1).mean() for m in b]
    return {"lowered": lowered(full), "prior": float(b[1][:, 0].mean() / b[0][:, 0].mean()),
            "physics": float(sums[1] / sums[0])}  # fmt: skip


def table(columns):
    """CSV text of name -> (rows,).  Test: tests/drop/test_drop_figures.py::test_command"""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([f"{v:.6g}" for v in row] for row in zip(*columns.values()))
    return text.getvalue()


def energies(opt):
    """python -m drop energies.  Test: tests/drop/test_drop_figures.py::test_command"""
    stage, began, found = demos.Stage(opt), time.process_time(), {}
    medians, lines = {}, []
    for name, switches in (("full", {}), ("bare", {"contact": False, "limits": False})):
        e, down, motions = ensemble(stage, opt, **switches)
        found[name], medians[name] = (e, down, motions), median(e)
        lines.append(f"{name}: {100 * down[:, -1].mean():.0f} % are down at the end")
        for label, (a, b) in (("before", (30, 60)), ("push", PUSHED), ("recovery", RECOVERY), ("end", (-10, None))):
            m = medians[name][a:b]
            if len(m):
                values = "  ".join(f"{k} {v:.3g}" for k, v in zip(TERMS, m.mean(axis=0)))
                lines.append(f"  {label:9s}{values}  J")
    frames = opt.frames * 2 * opt.count
    print(f"{opt.count} motions of {opt.frames} frames, {len(stage.clips)} clips; prior {opt.prior}, range {opt.range},"
          f" inside {opt.inside};"
          f" {frames / (time.process_time() - began):.0f} frames/s")  # fmt: skip
    print("\n".join(lines))
    if opt.frames > RECOVERY[0]:
        c = claims(medians["full"], medians["bare"])
        print(f"the whole set lowers E_kin by {100 * c['lowered']:.0f} % in recovery (paper: 30 % or more)")
        print(f"without contact and range of motion final energies are {c['prior']:.1f} × (prior), {c['physics']:.1f} ×"
              " (physics) as high (paper: 5 × or more)")  # fmt: skip
    if opt.csv:
        columns = {"frame": np.arange(opt.frames)}
        columns |= {f"{n} {k}": medians[n][:, i] for n in medians for i, k in enumerate(TERMS)}
        atomic_write(opt.csv, table(columns))
        print(opt.csv)
    if opt.png:
        draw(opt, stage, found, medians)
        print(opt.png)


def draw(opt, stage, found, medians):
    """The figure of `energies`.  Test: tests/drop/test_drop_figures.py::test_command"""
    render.extra("matplotlib")
    figure = render.extra("matplotlib.figure").Figure(figsize=(13, 8), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    one = next((i for i, n in enumerate(found["full"][2]) if n.startswith("walk") or "_walk" in n), 0)
    shown = (
        ("Fig. 4: medians, whole", medians["full"]),
        ("Fig. 5: without contact and range of motion", medians["bare"]),
        (f"Fig. 6: one motion, {found['full'][2][one]}", found["full"][0][one]),
    )
    for panel, (title, m) in zip(panels, shown):
        for i, k in enumerate(TERMS):
            panel.semilogy(np.maximum(m[:, i], 1e-5), label=k.replace("_", " "), lw=2.2 if i < 2 else 1.2)
        panel.axvspan(*PUSHED, color="0.85")
        panel.set(title=title, xlabel="frame", ylabel="energy [J]", ylim=(1e-4, None))
    panels[0].legend(fontsize=8)
    name, x, quat = demos.pick_motion(stage.clips, 2.5)
    n = min(len(x), 122)
    for cylinders, label in ((False, "points"), (True, "cylinders")):
        panels[3].plot(momenta.root_wrench(x[:n], quat[:n], cylinders), label=f"{name}, {label}")
    sim, state = stage.start(2.5)  # one take: what Eq. 4's solution would need, and what the motion has after Eq. 14
    act = demos.pushing("spine3", np.array([0.0, 120.0, 0.0]))
    take = demos.single("", sim, state, 120, np.random.default_rng(opt.seed), act)
    panels[3].plot([o[0].wrench_pd for o in take.outcomes], label="pushed run, solved", color="red")
    panels[3].plot([o[0].wrench for o in take.outcomes], label="pushed run, corrected", color="blue")
    panels[3].set(title="Fig. 7: root wrench of 22 kg [N, N m]", xlabel="frame"), panels[3].legend(fontsize=8)
    atomic_write(opt.png, lambda file: figure.savefig(file, format="png", dpi=100))


# ------------------------------------------------------------------------------------ §8.3


def outside(state):
    """Largest distance of a joint from its pose moved into drop.LIMITS [cm].

    Test: tests/drop/test_drop_figures.py::test_ablations"""
    x_r = body.project_range_of_motion(state.x, body.twists(state.quat))
    return 100 * float(np.linalg.norm(x_r - state.x, axis=1).max())


ABLATION = 200.0  # N on the torso for 0.27 s: with 120 N nobody needs the correction


def ablations(opt):
    """python -m drop ablations: takes of one pushed walk.  The one without a prior loses it as the push begins.

    Test: tests/drop/test_drop_figures.py::test_ablations"""
    takes = []
    for name, switch in (("whole", {}), ("no prior", {}), ("no range of motion", {"limits": False}),
                         ("no contact", {"contact": False}), ("no correction", {"correction": False})):  # fmt: skip
        stage = demos.Stage(replace(opt, rise=False, **switch))
        sim, state = stage.start(1.2)
        push = demos.pushing("spine3", np.array([0.0, ABLATION, 0.0]))

        def act(t, state, sim=sim, push=push, name=name):
            if name == "no prior" and t == demos.PUSH_FRAMES[0]:  # he walks until then
                sim.prior = None
            return push(t, state)

        take = demos.single(name, sim, state, 150, np.random.default_rng(opt.seed), act)
        take.window = (30, 94)
        after = slice(demos.PUSH_FRAMES[0], None)
        reach = [outside(s[0]) for s in take.states[after]]
        depth = [max(float((body.RADII - s[0].x[:, 2]).max()), 0.0) for s in take.states[after]]
        w = np.array([o[0].wrench for o in take.outcomes[after]])
        take.notes["after the push"] = (
            f"outside the limits by {max(reach):.1f} cm at most, {np.mean(np.array(reach) > 0.01) * 100:.0f} % of "
            f"frames; below the floor by {1e3 * np.mean(depth):.1f} mm on average, {1e3 * max(depth):.0f} at most; "
            f"root wrench median {np.median(w):.0f}, 95 % {np.percentile(w, 95):.0f}"
        )
        takes.append(take)
    return takes


# ------------------------------------------------------------------------------------ §8.7

BELOW = np.zeros((N, N), bool)  # BELOW[j, k]: k hangs on j
for _k in range(1, N):
    _a = PARENTS[_k]
    while _a >= 0:
        BELOW[_a, _k], _a = True, PARENTS[_a]
_INNER = np.array([j for j in range(1, N) if BELOW[j].any()])


def joint_torques(x, contact):
    r"""What the joints would have to exert for a motion.

    Equation  τ_j = Σ over the particles k that hang on j of (x_k − x_j) × f_k, f = M (ẍ − g) − contact forces
    Args      x : (T, 22, 3) [m]; contact : (T, 22, 3) [N] of frames 1 to T − 2 (others are not read)
    Returns   (T − 2, 22) [N m], 0 for the pelvis and leaves
    Test      tests/drop/test_drop_figures.py::test_joint_torques
    """
    f = (x[2:] - 2 * x[1:-1] + x[:-2]) / STEP**2 - GRAVITY - contact[1:-1]
    out = np.zeros((len(f), N))
    for j in _INNER:
        k = BELOW[j]
        arm = x[1:-1, k] - x[1:-1, j, None]
        out[:, j] = np.linalg.norm(np.cross(arm, f[:, k]).sum(axis=1), axis=1)
    return out


def contact_of(x, found):
    """Contact forces of an Outcome by the particle nearest to each point (22, 3).

    Test: tests/drop/test_drop_figures.py::test_joint_torques"""
    out = np.zeros((N, 3))
    for p, f in zip(found.points, found.forces):
        out[np.linalg.norm(x - p, axis=1).argmin()] += f
    return out


@dataclass
class Detector:
    r"""Superhuman motion: joint torques that recordings never need, or a pelvis that spins near the floor.

    ASSUMED   τ_max: the largest that a recorded clip holds for half a second, twice; superhuman is a window of 15
              frames whose median torque of the largest joint is above it; spinning: more than one turn a second, half a
              second long, with the pelvis below 0.6 of its standing height
    Args      limit : τ_max [N m] of 22 kg
    Test      tests/drop/test_drop_figures.py::test_detector
    """

    limit: float
    window: int = 15

    @classmethod
    def calibrated(cls, clips, seconds=8.0):
        """From recorded motions, contact forces by Eq. 11."""
        sim, torque = Simulator(), []
        for _, x, _ in clips[:12]:
            x = x[: round(seconds / STEP)]
            contact = np.zeros_like(x)
            v = np.diff(x, axis=0) / STEP
            for t in range(1, len(x) - 1):
                points, normals = sim.touching(x[t])
                F, edges = simulator.friction_basis(points, normals, x[t].mean(axis=0))
                b = simulator.momentum_rate(x[t + 1], x[t], v[t - 1]) - np.append(N * GRAVITY, np.zeros(3))
                c, _ = simulator.contact_forces(F, b)
                forces = (c[: len(edges), None] * edges).reshape(-1, simulator.EDGES, 3).sum(axis=1)
                for p, f in zip(points, forces):
                    contact[t, np.linalg.norm(x[t] - p, axis=1).argmin()] += f
            torque.append(held(joint_torques(x, contact).max(axis=1)).max())
        return cls(2.0 * float(max(torque)))

    def __call__(self, states, outcomes, floor=None):
        """{torque, wrench, spin}: frames (T,) that each finds superhuman; `wrench` is what §6's metric would say."""
        x = np.array([s.x for s in states])
        # an Outcome's forces act over the step that leads to its state: they belong to the frame before
        contact = np.zeros_like(x)
        for t in range(len(x) - 1):
            contact[t] = contact_of(x[t], outcomes[t + 1])
        torque = np.pad(joint_torques(x, contact).max(axis=1), 1, mode="edge")
        quat = np.array([s.quat[0] for s in states])
        rate = np.pad(quat_angle(quat[1:], quat[:-1]) / STEP, (1, 0), mode="edge")
        floor = floor or Plane()
        low = (x[:, 0] @ floor.normal - floor.offset) < 0.6 * STANDING
        wrench = np.array([o.wrench for o in outcomes])
        return {"torque": self._lasting(torque, self.limit), "spin": self._lasting(rate * low, 2 * np.pi),
                "wrench": self._lasting(wrench, 100.0)}  # fmt: skip

    def _lasting(self, values, limit):
        """Frames whose window's median is above the limit."""
        return held(values, self.window) > limit


def held(values, window=15):
    """The median of the window around each frame: what lasts for half of it.

    Test: tests/drop/test_drop_figures.py::test_detector"""
    pad = np.pad(values, window // 2, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(pad, window), axis=1)


def failures(opt):
    """python -m drop failures: pushed over, and what finds it.  The learned prior is asked though the body lies.

    Test: tests/drop/test_drop_figures.py::test_failures"""
    stage = demos.Stage(opt)
    if opt.prior == "vae":
        stage.general.down = 0.0
    stage.prior = lambda x, quat, at: stage.general  # nobody rises, and who is down is asked for
    detect, takes = Detector.calibrated(stage.clips), []
    for name, speed, newton in (("walk", 1.2, 0.0), ("walk pushed over", 1.2, 300.0), ("run pushed over", 2.5, 300.0)):
        sim, state = stage.start(speed)
        act = demos.pushing("spine3", np.array([0.0, max(newton, 1e-3), 0.0]))
        take = demos.single(name, sim, state, 240, np.random.default_rng(opt.seed), act)
        take.window = (30, 238)
        states, found = [s[0] for s in take.states], [o[0] for o in take.outcomes]
        by = detect(states, found)
        quat = np.array([s.quat[0] for s in states])
        rate = np.degrees(quat_angle(quat[1:], quat[:-1]) / STEP)[len(states) // 4 :]
        take.notes["found superhuman"] = (
            ", ".join(f"{k} {100 * v.mean():.0f} %" for k, v in by.items())
            + f" of frames (limit {detect.limit:.0f} N m); pelvis turns at up to {np.percentile(rate, 95):.0f} "
            f"degrees/s, median root wrench {np.median([o.wrench for o in found]):.0f}"
        )
        takes.append(take)
    return takes


COMMANDS = {"energies": energies, "ablations": ablations, "failures": failures}


def main(argv):
    """python -m drop energies|ablations|failures.  Test: tests/drop/test_drop_figures.py::test_command"""
    name, *flags = argv
    opt = cli(Options, flags, f"python -m drop {name}", __doc__)
    takes = COMMANDS[name](opt)
    for take in takes or ():
        print(demos.report(take))
    if takes and (opt.png or opt.video):
        pictures.write_pictures(takes, opt)

r"""The one scoreboard: how diverse, how planted, how well recovered, for each prior.

    python -m drop score [--prior both] [--count 24] [--json OUT.json]

diversity   one walker, one push, eight seeds: how far apart the seeds end
foot slide  of the eight undisturbed walks, of the pushed ones, and of the walker who is asked for 2.5 m/s
E_kin       what the whole set of samples lowers in recovery (Fig. 4's claim)
get-ups     walkers pushed over from all sides: how many stand again, ten seconds after the push
lying       of those pushed over who are not to rise: the fastest particle in the last second of ten

The key `getups` counts of `pushed` who fell; who did not fall at the push is pushed again and is not counted twice.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np

from drop import demos, figures
from drop.body import STANDING, STEP
from human import heading
from plumbing.cli import POSITIVE, arg, cli
from plumbing.files import atomic_write

SEEDS = 8
MOTIONS = 12  # of E_kin
MODERATE = 80.0  # N for 0.27 s on the upper body: 21 N s on 22 kg, from which both priors can recover
RECOVER = 300  # frames after the push: 10 s
LIERS = 4  # people pushed over who are not to rise
LYING = 300  # frames after the push of those who do not rise: 10 s


@dataclass
class Options(figures.Options):
    """What to measure."""

    prior: str = arg("both", "whose score", choices=("both", "nearest", "vae"))
    count: int = arg(24, "people pushed over", check=POSITIVE)
    newton: float = arg(60.0, "the push of E_kin, 0.5 s on the pelvis, which most bear [N on 22 kg]", check=POSITIVE)
    json: str | None = arg(None, "write the score here")


def spread(points):
    r"""Mean distance between pairs of points (n, 2) [m].

    Equation  2/(n (n − 1)) Σ_{i<j} ‖p_i − p_j‖
    Test      tests/drop/test_drop_score.py::test_spread
    """
    i, j = np.triu_indices(len(points), 1)
    return float(np.linalg.norm(points[i] - points[j], axis=1).mean())


def stands(state):
    """Upright, on the feet: the pelvis above 0.8 of its standing height, and not `drop.demos.fallen`.

    Test: tests/drop/test_drop_score.py::test_stands"""
    return bool(state.x[0, 2] > 0.8 * STANDING and not demos.fallen(state))


def _nothing(t, state):
    return None, {}, ()


def _sideways(state, angle=0.5 * np.pi):
    a = heading(state.quat[0]) + angle
    return np.array([np.cos(a), np.sin(a), 0.0])


def walks(stage, seeds=SEEDS, frames=180):
    """Takes of a walker, eight seeds: undisturbed, and pushed sideways by MODERATE in demos.PUSH_FRAMES.

    Test: tests/drop/test_drop_score.py::test_walks"""
    out = {"free": [], "pushed": []}
    for seed in range(seeds):
        for word in out:
            sim, state = stage.start(1.2)
            act = _nothing if word == "free" else demos.pushing("spine3", MODERATE * _sideways(state))
            out[word].append(demos.single(word, sim, state, frames, np.random.default_rng([stage.opt.seed, seed]), act))
    return out


def hurried(stage, frames=150):
    """A walker whom Eq. 16 asks for 2.5 m/s straight ahead.  Test: tests/drop/test_drop_score.py::test_walks"""
    sim, state = stage.start(1.2)
    v = 2.5 * _sideways(state, 0.0)[:2]
    return demos.single("hurried", sim, state, frames, stage.again(), lambda t, state: (None, {"v_tar": v}, ()))


def slide(takes):
    """Mean foot slide of takes [m/s], as `drop.demos.measure` has it.

    Test: tests/drop/test_drop_score.py::test_walks"""
    return float(np.mean([r["slide"] for take in takes for r in demos.measure(take)]))


def pushed_over(stage, number, frames, rise=True):
    r"""States after a walker has been pushed over, from the end of the push on; None if he did not fall within 2 s.

    Method    demos.FELLING on the upper body for 0.27 s, direction `number` golden angles from straight ahead; the take
              begins at another frame of the walk each time
    Args      rise : False takes the getting up out of the prior (where it has one)
    Test      tests/drop/test_drop_score.py::test_pushed_over
    """
    sim, state = stage.start(1.2, at=30 + 7 * number)
    sim.prior.rise = rise
    force = demos.one_force("spine3", demos.FELLING * _sideways(state, number * np.pi * (3.0 - np.sqrt(5.0))))
    rng, states = np.random.default_rng([stage.opt.seed, number]), []
    for t in range(frames + 8):
        state, _ = sim.step(state, force if t < 8 else None, rng=rng)
        states.append(state)
        if t == 68 and not any(demos.fallen(s) for s in states):
            return None
    return states[8:]


def standing_again(stage, count):
    """(how many stand through the last second, how many fell) of `count` pushed over; at most twice as many are pushed.

    Test: tests/drop/test_drop_score.py::test_command"""
    over, number = [], 0
    while len(over) < count and number < 2 * count:
        if (states := pushed_over(stage, number, RECOVER)) is not None:
            over.append(all(map(stands, states[-30:])))
        number += 1
    return int(sum(over)), len(over)


def fastest_lying(stage):
    """Speed [m/s] of the fastest particle in the last second of LIERS people who do not rise; how many of them fell.

    Test: tests/drop/test_drop_score.py::test_command"""
    over = [pushed_over(stage, number, LYING, rise=False) for number in range(LIERS)]
    speeds = [max(float(np.linalg.norm(s.v, axis=1).max()) for s in states[-30:]) for states in over if states]
    return max(speeds, default=0.0), len(speeds)


def of_prior(opt):
    """The score of one prior, (key, value) by key as it is found.  Test: tests/drop/test_drop_score.py::test_command"""
    stage = demos.Stage(opt)
    takes = walks(stage)
    yield "diversity_m", spread(np.array([t.states[-1][0].com[:2] for t in takes["pushed"]]))
    yield "foot_slide_m_s", slide(takes["free"])
    yield "foot_slide_pushed_m_s", slide(takes["pushed"])
    yield "walk_m_s", float(np.mean([demos.measure(t)[0]["speed"] for t in takes["free"]]))
    fell = [r["end"] == "fell" for word in takes for t in takes[word] for r in demos.measure(t)]
    yield "falls", int(sum(fell))
    yield "takes", len(fell)
    run = hurried(stage)
    yield "foot_slide_hurried_m_s", slide([run])
    last = [s[0].com[:2] for s in run.states[-60:]]
    yield "hurried_m_s", float(np.linalg.norm(np.diff(last, axis=0), axis=1).mean() / STEP)
    yield "hurried_end", demos.measure(run)[0]["end"]
    energies, _, _ = figures.ensemble(stage, replace(opt, count=min(opt.count, MOTIONS)))
    yield "ekin_lowered", figures.lowered(figures.median(energies))
    speed, liers = fastest_lying(stage)
    yield "lying_speed_m_s", speed
    yield "lying_takes", liers
    up, over = standing_again(stage, opt.count)
    yield "getups", up
    yield "pushed", over


def score(opt):
    """python -m drop score.  Test: tests/drop/test_drop_score.py::test_command"""
    out = {}
    for name in ("nearest", "vae") if opt.prior == "both" else (opt.prior,):
        found = out[name] = {}
        for key, value in of_prior(replace(opt, prior=name, range="vae" if name == "vae" else opt.range)):
            found[key] = value
            print(f"{name}: {key} {value:.3g}" if isinstance(value, float) else f"{name}: {key} {value}", flush=True)
    if opt.json:
        atomic_write(opt.json, json.dumps(out, indent=1) + "\n")
        print(opt.json)


COMMANDS = {"score": score}


def main(argv):
    """python -m drop score.  Test: tests/drop/test_drop_score.py::test_command"""
    name, *flags = argv
    COMMANDS[name](cli(Options, flags, f"python -m drop {name}", __doc__))

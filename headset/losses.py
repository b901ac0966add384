r"""Devices that are lost on purpose, as ReliaAvatar's tests lose them: single frames, or seconds; one device, or all.

    samples ──► lose(samples, single(…) or long(…), devices) ──► Reader's samples with gaps, for Stream or Guard

ASSUMED   the shares and lengths: single frames of a tenth to a half of all, losses of half a second to five seconds
"""

from __future__ import annotations

import numpy as np

from headset.reader import DEVICES, Sample

SETS = {"head": (0,), "left": (1,), "right": (2,), "hands": (1, 2), "all": (0, 1, 2)}
SHARES, LENGTHS = (0.1, 0.3, 0.5), (0.5, 1.0, 5.0)  # of the frames; s


def single(n: int, share: float, rng) -> np.ndarray:
    """Which of n frames are lost, each by itself.  (n,) bool.  Test: tests/headset/test_losses.py::test_what_is_lost"""
    return rng.random(n) < share


def long(t, seconds: float, rng, every=None) -> np.ndarray:
    """Which frames are lost: for so many seconds in every three times as many, at a random moment.

    Args      t (n,) [s]; every : s, another period
    Returns   (n,) bool
    Test      tests/headset/test_losses.py::test_what_is_lost"""
    t = np.asarray(t) - t[0]
    every = every or 3.0 * seconds
    start = rng.uniform(0.0, every - seconds, int(t[-1] // every) + 1)
    phase, turn = t % every, (t // every).astype(int)
    return (phase >= start[turn]) & (phase < start[turn] + seconds)


def lose(samples, lost, devices="all") -> list[Sample]:
    """Samples whose devices have no pose (NaN) where they are lost.

    Args      lost : (n,) bool; devices : a name of SETS
    Test      tests/headset/test_losses.py::test_what_is_lost"""
    rows = [k for k in SETS[devices] if k < len(DEVICES)]
    out = []
    for sample, gone in zip(samples, lost, strict=True):
        pos, quat = sample.pos.copy(), sample.quat.copy()
        if gone:
            pos[rows], quat[rows] = np.nan, np.nan
        out.append(Sample(sample.t, pos, quat))
    return out

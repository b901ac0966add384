"""headset/losses.py, and that the Guard survives what it loses: finite, without jumps, back soon."""

import numpy as np
import pytest
from test_stream import guarded, standing, steps

from headset.losses import LENGTHS, SETS, SHARES, long, lose, single
from headset.reader import BLEND, CATCH_UP, TELEPORT


def test_what_is_lost():
    """Shares and lengths as asked for; the devices asked for, and no input changed."""
    rng, samples = np.random.default_rng(0), standing(30.0)
    t = np.array([s.t for s in samples])
    for share in SHARES:
        assert abs(single(len(t), share, rng).mean() - share) < 0.05
    for seconds in LENGTHS:
        lost = long(t, seconds, rng)
        edges = np.flatnonzero(np.diff(lost.astype(int), prepend=0))
        assert abs(lost.mean() - 1 / 3) < 0.08 and abs((edges[1] - edges[0]) / 90.0 - seconds) < 0.05
    for name, rows in SETS.items():
        out = lose(samples, np.ones(len(t), bool), name)
        assert all(np.isnan(s.pos[list(rows)]).all() for s in out)
        assert all(np.isfinite(s.pos[[k for k in range(3) if k not in rows]]).all() for s in out)
        assert all(np.isfinite(s.pos).all() for s in samples)


def truth_and_played(mask, devices):
    samples = standing(20.0)
    mask = mask(np.array([s.t for s in samples]))
    mask[:90] = mask[-180:] = False  # begins and ends well
    out, guard = guarded(lose(samples, mask, devices))
    return samples, out, guard, mask


@pytest.mark.parametrize("devices", SETS)
@pytest.mark.parametrize("share", SHARES)
def test_single_frames(devices, share):
    """Every row gives a pose, near the true one, and the device never jumps by more than a hand moves."""
    rng = np.random.default_rng(1)
    samples, out, _, mask = truth_and_played(lambda t: single(len(t), share, rng), devices)
    assert len(out) == len(samples) and mask.any()
    error = np.linalg.norm(np.array([s.pos for s in out]) - np.array([s.pos for s in samples]), axis=-1)
    assert np.isfinite(error).all() and error.max() < 0.12, error.max(axis=0)
    for device in range(3):
        assert steps(out, device) < CATCH_UP / 90.0 + 0.01
    np.testing.assert_allclose(out[-1].pos, samples[-1].pos, atol=1e-6)


@pytest.mark.parametrize("devices", SETS)
@pytest.mark.parametrize("seconds", LENGTHS)
def test_seconds(devices, seconds):
    """A device that is gone for seconds is held or hangs, within an arm's reach, and comes back without a jump."""
    rng = np.random.default_rng(2)
    samples, out, guard, mask = truth_and_played(lambda t: long(t, seconds, rng), devices)
    pos, quat = np.array([s.pos for s in out]), np.array([s.quat for s in out])
    assert len(out) == len(samples) and np.isfinite(pos).all() and np.isfinite(quat).all() and mask.any()
    np.testing.assert_allclose(np.linalg.norm(quat, axis=-1), 1.0, atol=1e-6)
    assert np.linalg.norm(pos[:, 1:] - pos[:, :1], axis=-1).max() < TELEPORT + 0.02  # a lost headset coasts its sway
    for device in range(3):
        assert steps(out, device) < CATCH_UP / 90.0 + 0.01
    back = np.flatnonzero(mask[:-1] & ~mask[1:])
    for k in back:
        settled = k + round(90 * (BLEND + 0.6))
        if not mask[k + 1 : settled + 1].any():
            np.testing.assert_allclose(pos[settled], samples[settled].pos, atol=0.02)
    for i, name in enumerate(("head", "left", "right")):
        assert (guard.events[name, "not finite"] > 0) == (i in SETS[devices])


def test_back_as_soon_as_it_was_gone():
    """Who walks is where they are soon after single frames are lost, not 0.3 s later; and times that stand still."""
    samples = standing(6.0)
    walked = [s._replace(pos=s.pos + [1.4 * s.t, 0, 0]) for s in samples]
    rng = np.random.default_rng(3)
    mask = single(len(walked), 0.3, rng)
    mask[:90] = False
    out, _ = guarded(lose(walked, mask, "head"))
    errors = np.array([np.linalg.norm(a.pos[0] - b.pos[0]) for a, b in zip(out, walked, strict=True)])
    settled = ~np.any([np.roll(mask, k) for k in range(6)], axis=0)
    assert settled[90:].any() and errors[settled].max() < 1e-6 and errors.max() < 0.15 and errors.mean() < 0.02
    gone = lose([walked[100], walked[101], walked[101]], np.array([False, True, False]), "head")
    same, _ = guarded(gone)
    assert all(np.isfinite(s.pos).all() for s in same)

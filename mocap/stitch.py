"""Short clips joined into sequences of half a minute: each is entered where pose and velocity fit the last one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from human import SEG, SEGMENTS, Clip, heading, linear_velocity, place, quat_continuous, quat_slerp

# ------------------------------------------------------------------------------------ stitching

_MATCHED = tuple(SEG[s] for s in ("chest", "head", "shin_l", "foot_l", "shin_r", "foot_r", "hand_l", "hand_r"))
VELOCITY_WEIGHT = 0.1  # s: 1 m/s of velocity counts as 10 cm of pose


def motion_features(clip: Clip) -> np.ndarray:
    r"""Pose and velocity of a frame as one vector whose distances are metres.

    Equation  ‖f_a − f_b‖² = mean_j ( ‖Δp_j‖² + τ² ‖Δv_j‖² ), τ = 0.1 s, over 8 joints in the heading frame on the floor
    Returns   (T, 48) float32
    Test      tests/mocap/test_mocap.py::test_stitch_distance
    """
    yaw = heading(clip.quat[:, 0])
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]

    def turn(v):  # world -> heading frame
        return np.stack([c * v[..., 0] + s * v[..., 1], -s * v[..., 0] + c * v[..., 1], v[..., 2]], -1)

    p = clip.pos[:, _MATCHED]
    root = clip.pos[:, :1] * [1.0, 1.0, 0.0]
    f = np.concatenate([turn(p - root), VELOCITY_WEIGHT * turn(linear_velocity(p, clip.rate))], axis=1)
    return (f.reshape(len(clip), -1) / np.sqrt(len(_MATCHED))).astype(np.float32)


@dataclass
class StitchReport:
    """What stitching made, and what it lost."""

    sequences: int = 0
    seconds: float = 0.0
    joins: int = 0
    distances: list = field(default_factory=list)
    lost: list = field(default_factory=list)  # names of clips that are in no sequence
    frames: int = 0  # in all clips
    frames_used: int = 0  # of them in at least one sequence
    limit: float = 0.0

    def __str__(self):
        text = f"{self.sequences} sequences, {self.seconds / 60:.1f} min, "
        if not self.joins and not self.lost:
            return text + "no joins needed"
        if self.joins:
            d = 100 * np.array(self.distances)
            text += f"{self.joins} joins at {d.mean():.1f} cm mean ({d.max():.1f} max, limit {100 * self.limit:g})"
        else:
            text += "no joins"
        text += f"; {100 * self.frames_used / max(self.frames, 1):.0f} % of frames used"
        if self.lost:
            text += f"; lost {len(self.lost)} clips ({', '.join(self.lost[:3])}{', …' if len(self.lost) > 3 else ''})"
        return text


def stitch(clips, rng: np.random.Generator, seconds=30.0, limit=0.15, blend=10, stay=1.0):
    r"""Join short clips into sequences of at least `seconds`.

    Method    at a clip's end the frame of another clip of the same body is chosen whose pose and velocity lie nearest
              (`motion_features`; one of the best three by distance × (1 + times used), so that unused frames
              are favoured); it is aligned with the root on the plane and `blend` frames are cross-faded with a
              smooth step.  If no frame lies within `limit`, earlier exits are tried.
    Args      clips : list of Clip of one rate; limit [m] on the feature distance; stay [s] at least in each clip
    Returns   list of Clip (clips that are long enough pass as they are), StitchReport
    Raises    ValueError: clips of several rates
    Test      tests/mocap/test_mocap.py::test_stitch, ::test_stitch_joins, ::test_stitch_bodies
    """
    if len(rates := sorted({c.rate for c in clips})) > 1:
        raise ValueError(f"clips at {', '.join(f'{r:g}' for r in rates)} Hz: resample them to one rate first")
    report = StitchReport(limit=limit, frames=sum(map(len, clips)))
    out = [c for c in clips if c.seconds >= seconds]
    report.frames_used = sum(map(len, out))
    for body in sorted({c.body for c in clips}):
        group = [c for c in clips if c.body == body and c.seconds < seconds]
        out += _stitch_body(group, rng, seconds, limit, blend, stay, report)
    report.sequences, report.seconds = len(out), sum(c.seconds for c in out)
    return out, report


def _stitch_body(group, rng, seconds, limit, blend, stay, report):
    if not group:
        return []
    rate = group[0].rate
    keep = blend + int(stay * rate)  # frames an entered clip must still have
    feats = [motion_features(c) for c in group]
    entries = [np.arange(max(0, len(c) - keep)) for c in group]
    bank = np.concatenate([f[e] for f, e in zip(feats, entries, strict=True)])
    owner = np.repeat(np.arange(len(group)), [len(e) for e in entries])
    frame = np.concatenate(entries)
    norm = np.einsum("ij,ij->i", bank, bank)
    played = [np.zeros(len(c)) for c in group]  # how often each frame is in a sequence

    def nearest(clip, at):
        """(clip, frame, distance) to enter when leaving `clip` at frame `at`, or None."""
        d2 = norm - 2.0 * (bank @ feats[clip][at]) + feats[clip][at] @ feats[clip][at]
        d = np.sqrt(np.maximum(d2, 0.0))
        d[(owner == clip) & (np.abs(frame - at) < keep)] = np.inf  # not back to where it is
        if not len(d) or d.min() > limit:
            return None
        near = np.flatnonzero(d <= limit)
        visits = np.array([played[owner[k]][frame[k]] for k in near])
        pick = near[np.argsort(d[near] * (1.0 + visits), kind="stable")[:3]]  # among the best three: variety
        k = int(rng.choice(pick))
        return int(owner[k]), int(frame[k]), float(d[k])

    sequences = []
    for start in rng.permutation(len(group)):
        if (played[start] > 0).mean() > 0.5:  # mostly in a sequence already
            continue
        parts, joins, length, clip, entry = [], [], 0, int(start), 0
        while True:
            last = len(group[clip]) - 1
            if (length + last + 1 - entry) / rate >= seconds:
                parts.append((clip, entry, last))
                length += last + 1 - entry
                break
            found = None
            for leave in range(last - blend, entry + keep - blend - 1, -3):
                found = nearest(clip, leave)
                if found:
                    break
            if not found:
                break
            parts.append((clip, entry, leave))
            length += leave - entry
            joins.append(found[2])
            clip, entry = found[0], found[1]
        if length / rate < seconds:
            continue
        for c, a, b in parts:
            played[c][a : b + 1] += 1
        sequences.append(join([(group[c], a, b) for c, a, b in parts], blend, f"{group[start].name}+{len(parts) - 1}"))
        report.joins += len(joins)
        report.distances += joins
    report.frames_used += sum(int((p > 0).sum()) for p in played)
    report.lost += [c.name for c, u in zip(group, played, strict=True) if not u.any()]
    return sequences


def join(parts, blend, name):
    """Cross-fade (clip, first, last) parts: each is aligned at its entry with the frame where the last is left.

    Test      tests/mocap/test_mocap.py::test_stitch_joins"""
    clip, a, b = parts[0]
    pos, quat, ball = ([x[a:b]] for x in (clip.pos, clip.quat, clip.ball))
    current = clip
    for nxt, na, nb in parts[1:]:
        yaw = float(heading(current.quat[b, 0]) - heading(nxt.quat[na, 0]))
        nxt = place(nxt, yaw, nxt.pos[na, 0, :2], current.pos[b, 0, :2])
        x = (np.arange(blend) + 1.0) / (blend + 1.0)
        w = x * x * (3 - 2 * x)  # smooth step
        for store, old, new in ((pos, current.pos, nxt.pos), (ball, current.ball, nxt.ball)):
            store.append(old[b : b + blend] + w[:, None, None] * (new[na : na + blend] - old[b : b + blend]))
            store.append(new[na + blend : nb])
        w = np.tile(w[:, None], (1, len(SEGMENTS)))
        quat.append(quat_slerp(current.quat[b : b + blend], nxt.quat[na : na + blend], w))
        quat.append(nxt.quat[na + blend : nb])
        current, b = nxt, nb
    for store, values in ((pos, current.pos), (quat, current.quat), (ball, current.ball)):
        store.append(values[b : b + 1])
    pos, quat, ball = map(np.concatenate, (pos, quat, ball))
    return Clip(name, clip.body, clip.rate, pos, quat_continuous(quat), ball)

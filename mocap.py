r"""Human motion: one canonical human, whatever the rig  [Reda23 §3.4, App. A].

    read a file ──────► canonical Clip ──► resample ──► stitch ──► sensors, contacts
    (rigs.py)           15 segments        30 Hz        ≥ 30 s     §3.4    App. A
    or gait.py

Everything after the reader speaks of one human only: 15 named segments, each with a joint centre and an
anatomical frame that equals the world's axes (x forward, y left, z up) when the person stands upright with
the arms hanging.  Metres, radians, seconds; quaternions w, x, y, z.

    python mocap.py inspect FILE      skeleton, rate, length, speed, contacts
    python mocap.py inspect FOLDER    one line a clip, and what stitching makes of them
    python mocap.py fetch NAME        download bandai, cmu or lafan1 (fetch.py)
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import bvh
import fetch
import gait
import rigs
from human import (  # noqa: F401 (some are for those who say mocap.X)
    CONTACT_HEIGHT,
    CONTACT_SPEED,
    FEET,
    PARENTS,
    SEG,
    SEGMENTS,
    Clip,
    angular_velocity,
    heading,
    linear_velocity,
    quat_about,
    quat_angle,
    quat_conj,
    quat_continuous,
    quat_matrix,
    quat_mul,
    quat_rotate,
    quat_slerp,
)
from rigs import AS_IT_IS, RIGS, Reading, from_amc, from_bvh, is_amc  # noqa: F401
from runs import UserError, printable, run_main

CONTROL_RATE = 30.0  # Hz, ASSUMED: Table 3 is not in the text we have


def resample(clip: Clip, rate: float) -> Clip:
    """The clip at another rate: positions linearly, rotations by slerp.  Test: tests/test_mocap.py::test_resample."""
    if abs(clip.rate - rate) < 1e-3 * rate:
        return replace(clip, rate=rate)
    n = int(np.floor((len(clip) - 1) * rate / clip.rate + 1e-9)) + 1
    t = np.arange(n) * clip.rate / rate
    i = np.minimum(t.astype(int), max(len(clip) - 2, 0))
    j = np.minimum(i + 1, len(clip) - 1)
    w = t - i
    lerp = lambda x: x[i] + (x[j] - x[i]) * w[:, None, None]  # noqa: E731
    quat = quat_slerp(clip.quat[i], clip.quat[j], np.broadcast_to(w[:, None], (n, len(SEGMENTS))))
    return replace(clip, rate=rate, pos=lerp(clip.pos), quat=quat_continuous(quat), ball=lerp(clip.ball))


def place(clip: Clip, yaw: float, pivot, to) -> Clip:
    """Turn by `yaw` about the vertical through `pivot` (2,), put it on `to` (2,).  Test: test_mocap.py::test_place."""
    r = np.eye(3)
    r[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pivot, to = np.append(pivot, 0.0), np.append(to, 0.0)
    move = lambda x: (x - pivot) @ r.T + to  # noqa: E731
    return replace(clip, pos=move(clip.pos), ball=move(clip.ball), quat=quat_mul(quat_about(2, yaw), clip.quat))


# ------------------------------------------------------------------------------------ other users, other gaits

_MIRRORED = tuple(SEG[s[:-2] + {"_l": "_r", "_r": "_l"}[s[-2:]] if s[-2:] in ("_l", "_r") else s] for s in SEGMENTS)
_ARMS = tuple(tuple(SEG[f"{s}_{side}"] for s in ("upper_arm", "forearm", "hand")) for side in "lr")


def mirror(clip: Clip) -> Clip:
    r"""The clip seen in a mirror: left and right change places.

    Equation  p' = M p, R' = M R M with M = diag(1, -1, 1); in quaternions (w, x, y, z) -> (w, -x, y, -z)
    Why       the anatomical frames are symmetric, so that M R M is the other side's frame
    Test      tests/test_mocap.py::test_mirror
    """
    flip = np.array([1.0, -1.0, 1.0])
    quat = clip.quat[:, _MIRRORED] * [1.0, -1.0, 1.0, -1.0]
    pos, ball = clip.pos[:, _MIRRORED] * flip, clip.ball[:, ::-1] * flip
    return replace(clip, name=f"{clip.name}-mirrored", pos=pos, quat=quat, ball=ball)


def warp(clip: Clip, speed: float) -> Clip:
    """The clip played `speed` times as fast, at the same frame rate.  Test: tests/test_mocap.py::test_warp."""
    return resample(replace(clip, name=f"{clip.name}-speed{speed:.2f}", rate=clip.rate * speed), clip.rate)


def resize(clip: Clip, height=1.0, arms=1.0, trunk=1.0) -> Clip:
    r"""The same motion by a user `height` times as tall, whose arms and trunk are `arms` and `trunk` times as long in
    proportion to the legs.

    Equation  chest' = pelvis + s (chest − pelvis), head' = chest' + s (head − chest); a shoulder keeps its place
              across the chest and rises along it: shoulder' = chest' + R diag(1, 1, s) Rᵀ (shoulder − chest)
    Why       people's trunks differ more than their stature says: the headset of a CMU subject is 1.65 hip heights
              high, of Bandai's actor 1.47
    All positions grow with the height, travel included: a taller person's steps are longer.
    Test      tests/test_mocap.py::test_resize, test_resize_trunk
    """
    pos = clip.pos * height
    pelvis, chest, head = pos[:, 0].copy(), pos[:, SEG["chest"]].copy(), pos[:, SEG["head"]].copy()
    pos[:, SEG["chest"]] = risen = pelvis + trunk * (chest - pelvis)
    pos[:, SEG["head"]] = risen + trunk * (head - chest)
    up = quat_rotate(clip.quat[:, SEG["chest"]], np.array([0.0, 0.0, 1.0]))
    for arm in _ARMS:
        along = np.sum((pos[:, arm[0]] - chest) * up, axis=1, keepdims=True)
        pos[:, arm] += (risen - chest + (trunk - 1.0) * along * up)[:, None]
    for shoulder, elbow, hand in _ARMS:
        upper, fore = pos[:, elbow] - pos[:, shoulder], pos[:, hand] - pos[:, elbow]
        pos[:, elbow] = pos[:, shoulder] + arms * upper
        pos[:, hand] = pos[:, elbow] + arms * fore
    tag = f"-h{height:.2f}a{arms:.2f}t{trunk:.2f}"
    return replace(clip, name=clip.name + tag, body=clip.body + tag, pos=pos, ball=clip.ball * height)


# Another bearing: segment -> standard deviation [rad] of a constant turn about its parent's x, y, z.  ASSUMED: about as
# far as the mean poses of Bandai's styles lie apart.  Both arms are raised (x), swung forward (y) and turned (z) alike,
# with a fifth of it of their own; elbows only bend further.
_BEARING = {"chest": (0.04, 0.10, 0.05), "head": (0.05, 0.12, 0.08), "upper_arm": (0.12, 0.20, 0.10)}
_ELBOW = 0.5  # rad, standard deviation of a further bend, forward


def restyle(clip: Clip, rng: np.random.Generator, swing=(0.1, 1.6), bearing=1.0) -> Clip:
    r"""The same steps with another bearing: trunk, head and arms carried otherwise, swung more or less.

    Equation  of a segment relative to its parent:  R' = exp(φ) R̄ exp(g log(R̄⁻¹ R)), R̄ its mean over the clip
    Symbols   φ a constant turn, normal with standard deviations `_BEARING`; g in `swing`, one for the trunk and head,
              one for the arms
    Why       styles that were never recorded differ from those that were above all in this; pelvis and legs, and with
              them the feet's contacts, stay as they are
    Args      clip, rng; swing : least and most of g; bearing : share of φ, 0 for none
    Returns   Clip; bones keep their lengths
    Test      tests/test_mocap.py::test_restyle
    """
    rest = dict(zip(SEGMENTS, np.moveaxis(clip.quat, 1, 0)))
    pos, quat = clip.pos.copy(), clip.quat.copy()
    trunk, arms = rng.uniform(*swing, 2)
    both = rng.normal(0.0, _BEARING["upper_arm"])
    bend = bearing * abs(rng.normal(0.0, _ELBOW))
    for i, name in enumerate(SEGMENTS):
        up = PARENTS[i]
        if up < 0 or name[:-2] in ("thigh", "shin", "foot"):
            continue
        own, parent = rest[name], rest[SEGMENTS[up]]
        local = quat_mul(quat_conj(parent), own)  # (T, 4)
        phi, g = np.zeros(3), arms
        if name in ("chest", "head"):
            phi, g = bearing * rng.normal(0.0, _BEARING[name]), trunk
        elif name.startswith("upper_arm"):
            side = 1.0 if name.endswith("_l") else -1.0
            phi = bearing * (both + 0.2 * rng.normal(0.0, _BEARING["upper_arm"])) * [side, 1.0, side]
        elif name.startswith("forearm"):
            phi = np.array([0.0, -bend, 0.0])
        local = Rotation.from_quat(local, scalar_first=True)
        mean = local.mean()
        new = mean * Rotation.from_rotvec(g * (mean.inv() * local).as_rotvec())
        new = new * Rotation.from_rotvec(phi) if name.startswith("forearm") else Rotation.from_rotvec(phi) * new
        arm = quat_rotate(quat_conj(parent), clip.pos[:, i] - clip.pos[:, up])  # bone, in the parent's frame
        pos[:, i] = pos[:, up] + quat_rotate(quat[:, up], arm)
        quat[:, i] = quat_mul(quat[:, up], new.as_quat(scalar_first=True))
    return replace(clip, name=f"{clip.name}-restyled", pos=pos, quat=quat_continuous(quat))


FASTEST = 4.0  # m/s, ASSUMED: the fastest second of Bandai's runs


def fastest_second(clip: Clip) -> float:
    """Way of the root on the floor in its fastest second, or the mean speed of less [m/s].

    Test      tests/test_mocap.py::test_fastest_second"""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(clip.pos[:, 0, :2], axis=0), axis=-1))])
    n = max(min(round(clip.rate), len(way) - 1), 1)
    return float(np.max(way[n:] - way[:-n], initial=0.0) * clip.rate / n)


def augment(
    clips: list[Clip], rng: np.random.Generator, speed=0.15, height=0.2, arms=0.2, trunk=(0.95, 1.45),
    swing=(0.1, 1.6), bearing=1.0,
) -> list[Clip]:  # fmt: skip
    """Every clip, and its mirror image with another bearing at a random speed by a user of random height, arm and trunk
    length.

    Args      speed, height, arms : ranges, as shares: speed in 1 +- speed, and so on; trunk : least and most, not even
              about 1 because the trunk of Bandai's actor is short (`resize`); swing, bearing : of `restyle`
    ASSUMED   nobody's fastest second exceeds FASTEST, whatever the drawn speed: no policy follows that, and `--balance`
              would spend its time on it
    Returns   twice as many clips, the given ones first
    Test      tests/test_mocap.py::test_augment
    """
    draw = lambda r: float(rng.uniform(1.0 - r, 1.0 + r))  # noqa: E731
    users = [(draw(speed), draw(height), draw(arms), float(rng.uniform(*trunk))) for _ in clips]
    pace = [min(v, FASTEST / max(h * fastest_second(c), 1e-6)) for c, (v, h, *_) in zip(clips, users, strict=True)]
    other = (warp(restyle(mirror(c), rng, swing, bearing), v) for c, v in zip(clips, pace, strict=True))
    return list(clips) + [resize(c, *user) for c, (_, *user) in zip(other, users, strict=True)]


# ------------------------------------------------------------------------------------ what the user wears, and the feet

# Where a headset and two controllers sit, in the frames of head and hands [m].  ASSUMED: the paper only says "offset".
# The headset's eyes lie 11 cm before and 8 cm above the joint between skull and neck; a held controller's origin 9 cm
# beyond the wrist and 2 cm towards the thumb.  Orientations are the segments' own.
SENSORS = ("head", "hand_l", "hand_r")
SENSOR_OFFSETS = np.array([[0.11, 0.0, 0.08], [0.02, 0.0, -0.09], [0.02, 0.0, -0.09]])


def sensors(clip: Clip):
    r"""Synthetic headset and controller poses  [Reda23 §3.4, Eq. 4].

    Symbols   h, l, r -> rows 0, 1, 2
    Frame     world
    Returns   positions (T, 3, 3) [m], orientations (T, 3, 4)
    Test      tests/test_mocap.py::test_sensors
    """
    idx = [SEG[s] for s in SENSORS]
    q = clip.quat[:, idx]
    return clip.pos[:, idx] + quat_rotate(q, np.broadcast_to(SENSOR_OFFSETS, q.shape[:2] + (3,))), q


def headset_height(clip: Clip) -> float:
    """Height of the headset when the user stands upright [m]: hips, trunk and neck stretched, the headset's offset.

    Test      tests/test_retarget.py::test_sensor_scale"""
    trunk = clip.limb("pelvis", "chest") + clip.limb("chest", "head")
    return clip.hip_height + trunk + float(SENSOR_OFFSETS[0, 2])


def contacts(clip: Clip) -> np.ndarray:
    r"""Human foot contacts  [Reda23 App. A]: height < 0.20 m above the ground and speed < 0.4 m/s.

    ASSUMED   the foot is its ankle OR its ball: from heel strike (ball still moving) to toe-off (heel already up)
    Returns   (T, 2) bool, left and right; computed on the human, before any scaling
    Test      tests/test_mocap.py::test_contacts
    """
    points = np.stack([clip.pos[:, FEET], clip.ball])  # (2, T, 2, 3): ankle, ball
    speed = np.stack([np.linalg.norm(linear_velocity(p, clip.rate), axis=-1) for p in points])
    return np.any((points[..., 2] < CONTACT_HEIGHT) & (speed < CONTACT_SPEED), axis=0)


def footfalls(contact, rate, apart=0.1) -> int:
    """How often a foot begins to touch that was in the air for `apart` seconds: a foot at the limits' edge chatters.

    Args      contact : (T, 2) bool; rate [Hz]
    Test      tests/test_mocap.py::test_footfalls
    """
    n = max(1, round(apart * rate))
    if len(contact) <= n:
        return 0
    before = np.lib.stride_tricks.sliding_window_view(contact[:-1], n, axis=0).any(axis=-1)
    return int(np.sum(contact[n:] & ~before))


# ------------------------------------------------------------------------------------ stitching

_MATCHED = tuple(SEG[s] for s in ("chest", "head", "shin_l", "foot_l", "shin_r", "foot_r", "hand_l", "hand_r"))
VELOCITY_WEIGHT = 0.1  # s: 1 m/s of velocity counts as 10 cm of pose


def motion_features(clip: Clip) -> np.ndarray:
    r"""Pose and velocity of a frame as one vector whose distances are metres.

    Equation  ‖f_a − f_b‖² = mean_j ( ‖Δp_j‖² + τ² ‖Δv_j‖² ), τ = 0.1 s, over 8 joints in the heading frame on the floor
    Returns   (T, 48) float32
    Test      tests/test_mocap.py::test_stitch_distance
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
    Test      tests/test_mocap.py::test_stitch, ::test_stitch_joins, ::test_stitch_bodies
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
        sequences.append(_join([(group[c], a, b) for c, a, b in parts], blend, f"{group[start].name}+{len(parts) - 1}"))
        report.joins += len(joins)
        report.distances += joins
    report.frames_used += sum(int((p > 0).sum()) for p in played)
    report.lost += [c.name for c, u in zip(group, played, strict=True) if not u.any()]
    return sequences


def _join(parts, blend, name):
    """Cross-fade (clip, first, last) parts: each is aligned at its entry with the frame where the last is left."""
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


# ------------------------------------------------------------------------------------ data sets

SPLITS = ("train", "validation", "style", "body", "all")


def split_of(name: str) -> str:
    """Which part of a data set a clip belongs to: by its name only, so that no run can see a held-out clip by accident.

    body        : NAME.amc (unseen bodies)
    style       : the whole style `youthful` (unseen style)
    validation  : every clip whose trailing number ends in 5 (unseen clips; in LaFAN1 that is subject 5)
    train       : the rest
    Test        tests/test_mocap.py::test_split, tests/test_amc.py::test_body_split
    """
    if is_amc(name):
        return "body"
    if "youthful" in name:
        return "style"
    number = re.search(r"(\d+)$", name)
    return "validation" if number and number.group(1).endswith("5") else "train"


BUILTIN = {"builtin": gait.MIX, "standing": gait.STANDING}  # the data sets that need no download
MOTION = "builtin, standing, a .bvh or .amc file, or a folder of them; or several with commas between them"


def builtin_clips(rate=CONTROL_RATE, seed=0, name="builtin") -> list[Clip]:
    """The procedural human of gait.py: people who walk (builtin) or stand and step (standing).

    Test      tests/test_mocap.py::test_builtin, ::test_joined"""
    out = []
    library = gait.library(rate=rate, seed=seed, mix=BUILTIN[name])
    for i, m in enumerate(library):
        number = (i + 5) % len(library)  # so that builtin's two clips held out, 005 and 015, are straight walks
        title = f"{m['name'].split('_')[1]}_{number:03d}"
        out.append(Clip(title, f"{name}-{number:03d}", m["rate"], m["pos"], m["quat"], m["ball"]))
    return out


SETS = "builtin, standing, a .bvh or .amc file, a folder of them, several with commas between them"


def parts(motion) -> list[str]:
    """The data sets of a --motion: one, or several with commas between them (unless a file has that name).

    Test      tests/test_mocap.py::test_joined"""
    sets = str(motion).split(",") if not Path(motion).exists() else [str(motion)]
    if "" in sets:
        raise UserError(f"--motion {motion}: an empty name, a comma too many; valid: {SETS}")
    return sets


def licences(sets) -> list[str]:
    """Of each data set that is not built in: its name, and the first line of the licence file beside it.

    Test      tests/test_mocap.py::test_licences, tests/test_ppo.py::test_ship
    """
    out = []
    for path in (Path(s) for s in sets if s not in BUILTIN):
        notes = sorted(path.glob("LICENSE*")) if path.is_dir() else []
        text = notes[0].read_text(errors="replace") if notes else "no licence file beside the motion"
        title = text.strip().split("\n")[0]
        out.append(f"{path.name}, licensed: {title}")
    return out


def load(motion="builtin", rate=CONTROL_RATE, clips="*", split="all", reading=AS_IT_IS) -> list[Clip]:
    """Single clips of a data set, at one rate.

    Args      motion : "builtin", "standing", a .bvh or .amc file, or a folder of them (searched below); or several of
              these with commas between them: each must have what is asked for
              clips : shell pattern on the names; reading : what the user says about joints, unit and axes of BVH files
              split : train | validation | style | body | all.  A folder of fewer than ten files none of whose names is
              in the split is used whole, and says so.  .amc clips are in `body` alone, unless motion holds nothing
              else: then it is meant, its clips are also split by their numbers, and it says so
    Raises    UserError: nothing there, a malformed file, or nothing matches; names what would have been valid
    Test      tests/test_mocap.py::test_split, ::test_load_errors, ::test_bandai_loads_in_seconds,
              tests/test_amc.py::test_body_split
    """
    if split not in SPLITS:
        raise UserError(f"split {split!r} is unknown; valid: {', '.join(SPLITS)}")
    if len(sets := parts(motion)) > 1:
        return [c for one in sets for c in load(one, rate, clips, split, reading)]
    if motion in BUILTIN:
        items = [(c.name, c.name, c) for c in builtin_clips(rate, name=motion)]
    else:
        path = Path(motion)
        if not path.exists():
            raise UserError(f"{motion}: no such file or folder; valid: {SETS}")
        found = (f for f in path.rglob("*") if f.suffix.lower() in (".bvh", ".amc") and not f.is_dir())
        files = sorted(found) if path.is_dir() else [path]
        if not files:
            raise UserError(f"{motion}: a folder without motion; valid: one that holds .bvh or .amc files")
        meant = all(map(is_amc, files)) and split not in ("body", "all")
        if meant:
            print(f"{motion}: only .amc files, else held out as unseen bodies; split by their numbers", file=sys.stderr)
        items = [(f.stem, f.name if is_amc(f) and not meant else f.stem, f) for f in files]
    matching = [(name, split_of(key), item) for name, key, item in items if fnmatchcase(name, clips)]
    chosen = [item for _, part, item in matching if split in ("all", part)]
    bodies = sum(part == "body" for _, part, _ in matching)
    if split == "train" and bodies:
        print(f"{motion}: {bodies} .amc clips left out: unseen bodies, split body", file=sys.stderr)
    if not matching:
        names = [name for name, _, _ in items]
        more = f", … ({len(names)})" if len(names) > 6 else ""
        raise UserError(f"{motion}: no clip matches {clips!r}; there are {', '.join(names[:6])}{more}")
    if not chosen and motion not in BUILTIN and len(files) < 10 and split not in ("style", "body") and not bodies:
        print(
            f"{motion}: only {len(files)} clip{'s' * (len(files) > 1)}, none to hold out: {split} uses all of them",
            file=sys.stderr,
        )
        chosen = [item for _, _, item in matching]
    if not chosen:
        found = sorted({part for _, part, _ in matching})
        raise UserError(
            f"{motion}: none of the {len(matching)} clips that match {clips!r} is in split {split!r}; "
            f"they are in {' and '.join(found)}"
        )
    if motion in BUILTIN:
        return chosen
    return [resample(clip, rate) for clip in rigs.read_clips(chosen, reading, files)]


def sequences(
    motion="builtin", split="train", clips="*", rate=CONTROL_RATE, seed=0, limit=0.15, verbose=True, reading=AS_IT_IS
) -> list[Clip]:
    """Stitched sequences of a data set: what training and measuring use.  Test: tests/test_mocap.py::test_sequences.

    Of several sets each is stitched by itself.
    A set of which nothing can be joined into a sequence comes back as its single clips, and says so; one clip alone,
    a user's recording, is not looped.
    """
    if len(sets := parts(motion)) > 1:
        return [c for one in sets for c in sequences(one, split, clips, rate, seed, limit, verbose, reading)]
    single = load(motion, rate, clips, split, reading)
    if len(single) == 1:
        if verbose:
            print(f"{motion} [{split}] one clip, {single[0].seconds:.1f} s, as it is")
        return single
    return _sequences(single, f"{motion} [{split}]", seed, limit, verbose)


def _sequences(single, title, seed=0, limit=0.15, verbose=True):
    out, report = stitch(single, np.random.default_rng(seed), limit=limit)
    if verbose:
        result = str(report) if out else "too few to join: single clips are used"
        print(f"{title} {len(single)} clips, {sum(c.seconds for c in single) / 60:.1f} min -> {result}")
    return out or list(single)


# ------------------------------------------------------------------------------------ python mocap.py inspect


def describe(clip: Clip) -> str:
    """Rate, length, speed and contacts of a clip in one line; the balls' mean height while the feet are in contact.

    Test      tests/test_mocap.py::test_inspect"""
    travel = np.linalg.norm(np.diff(clip.pos[:, 0, :2], axis=0), axis=-1).sum()
    speed = travel * clip.rate / max(len(clip) - 1, 1)
    c = contacts(clip)
    height = f"{100 * clip.ball[c, 2].mean():.1f}" if c.any() else "-"
    return (
        f"{clip.name:36s} {clip.rate:5.1f} Hz {len(clip):5d} frames {clip.seconds:6.1f} s  "
        f"{travel:6.2f} m  {speed:4.2f} m/s  contact L {100 * c[:, 0].mean():3.0f} % R {100 * c[:, 1].mean():3.0f} %  "
        f"{footfalls(c, clip.rate):3d} footfalls  balls {height} cm up in contact  hips {clip.hip_height:.2f} m"
    )


def inspect(path, reading=AS_IT_IS) -> None:
    """Print what a file or a folder holds.  Test: tests/test_mocap.py::test_inspect."""
    path = Path(path)
    if path.is_dir():
        clips = load(path, reading=reading)
        for clip in clips:
            print(describe(clip))
        _sequences(clips, f"{path} [all]")
        return
    if is_amc(path):
        clip, b, name, joints = from_amc(path), rigs.read_amc(path)[0], "cmu", rigs.CMU_BONES
    else:
        b = rigs.read(path)
        rig, name = rigs.rig_for(b, reading)
        clip, joints = rigs.canonical(b, rig, name), rig.joints
    segment = {joint: s for s, joint in joints.items()}
    print(f"{path}: rig {name}, {len(b.names)} joints")
    for joint, line in zip(b.names, bvh.outline(b.names, b.parents)):
        indent = len(line) - len(joint)
        print(f"  {' ' * indent}{printable(joint):18s} {segment.get(joint, '')}".rstrip())
    print(describe(clip))


def main(argv=None) -> None:
    """python mocap.py inspect FILE|FOLDER, or fetch NAME.  Test: tests/test_cli.py::test_mocap_inspect"""
    parser = argparse.ArgumentParser(
        prog="mocap.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    sub = parser.add_subparsers(dest="command", required=True)
    p = sub.add_parser("inspect", help="print skeleton, rate, length, speed and contacts")
    p.add_argument("path", help="a .bvh or .amc file, or a folder of them")
    for name, text in rigs.HELP.items():
        p.add_argument("--" + name.replace("_", "-"), help=text)
    f = sub.add_parser("fetch", help="download a data set, its licence and citation first")
    f.add_argument("name", choices=tuple(fetch.DATASETS))
    f.add_argument("--out", help="folder (default: data/NAME)")
    f.add_argument("--url", metavar="BASE", help="another server with the same paths, such as http://127.0.0.1:8000")
    for each in (parser, p, f):  # one line, as in runs.cli
        each.error = lambda message: parser.exit(2, f"mocap.py: error: {message} (see --help)\n")
    args = parser.parse_args(argv)
    if args.command == "fetch":
        fetch.fetch(args.name, args.out, args.url)
        return
    inspect(args.path, Reading.of(args))


if __name__ == "__main__":
    run_main(main)

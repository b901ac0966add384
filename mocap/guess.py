"""mocap.guess."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from human import FEET, PARENTS, SEG, SEGMENTS, linear_velocity, quat_conj, quat_rotate
from mocap import bvh
from mocap.rigs import HIPS, RIGS, UNITS, UPS, Rig, _frame, _from_file, _human, _pose, _unit, _up
from plumbing.cli import UserError, printable
from plumbing.files import read_toml

# ------------------------------------------------------------------------------------ which joint is which segment

_WORDS = {  # what joints are called, side and decoration apart; the first that is there counts
    "thigh": ("upleg", "upperleg", "thigh", "femur", "hip"),
    "shin": ("lowerleg", "lowleg", "shin", "calf", "tibia", "knee", "leg"),
    "foot": ("ankle", "foot"),
    "ball": ("toebase", "toe", "toes", "ball", "foot"),
    "upper_arm": ("upperarm", "uparm", "humerus", "arm", "shldr", "shoulder"),
    "forearm": ("forearm", "lowerarm", "lowarm", "radius", "elbow"),
    "hand": ("wrist", "hand"),
}
_LEG, _ARM = ("thigh", "shin", "foot", "ball"), ("upper_arm", "forearm", "hand")
_SIDES = {"l": "l", "left": "l", "r": "r", "right": "r"}
_DECORATION = {
    "joint", "jnt", "bone", "bip", "biped", "mixamorig", "def", "org", "character", "rig", "b", "j", "m", "avg",
}  # fmt: skip


def read_name(name: str):
    """A joint's name -> (side "l", "r" or "", word): "mixamorig:LeftUpLeg" is (l, upleg), "lThigh" (l, thigh).

    Test      tests/mocap/test_rigs.py::test_names
    """
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name.rsplit(":", 1)[-1])
    words = [w for w in map(str.lower, parts) if w not in _DECORATION]
    side = next((_SIDES[w] for w in words if w in _SIDES), "")
    word = "".join(w for w in words if w not in _SIDES)
    if not side:
        known = {w for each in _WORDS.values() for w in each}
        for pattern in (r"(left|right)(.+)", r"(l|r)(.+)"):  # without capitals: "leftupleg", "lfemur"
            found = re.fullmatch(pattern, word)
            if found and found[2] in known:
                return _SIDES[found[1]], found[2]
    return side, word


def guess(b: bvh.Bvh, joints=None, balls=None):
    """Which joint is which segment, from names along the limbs; the trunk is where the limbs meet.

    Args      joints : segment -> joint, and balls : (left, right) or None: what is known already
    Returns   joints, balls : completed as far as possible;  missing : segments (and ball_l, ball_r) that were not found
    Test      tests/mocap/test_rigs.py::test_any_rig, ::test_partial_joint_map
    """
    joints = dict(joints or {})
    named = [read_name(n) for n in b.names]
    index = {n: j for j, n in enumerate(b.names)}
    index |= {f"{n}.end": index[n] for n in b.end_sites}

    def above(j):
        """Joint j and all that it hangs from."""
        found = set()
        while j >= 0:
            found.add(int(j))
            j = b.parents[j]
        return found

    for side, ball in zip("lr", balls or (None, None)):
        if ball:
            joints[f"ball_{side}"] = ball
        for limb in (_LEG, _ARM):
            top = set()
            for part in limb:
                key = f"{part}_{side}"
                fits = [
                    j
                    for word in _WORDS[part]
                    for j, name in enumerate(named)
                    if name == (side, word) and b.names[j] not in joints.values() and top < above(j)
                ]
                if key not in joints and fits:
                    joints[key] = b.names[fits[0]]
                if key in joints:
                    top = above(index[joints[key]])
        foot = joints.get(f"foot_{side}")
        if foot and f"ball_{side}" not in joints:  # toes of another name: the foot's only child, or where it ends
            children = [n for n, p in zip(b.names, b.parents) if b.names[p] == foot and p >= 0]
            if len(children) == 1:
                joints[f"ball_{side}"] = children[0]
            elif np.linalg.norm(b.end_sites.get(foot, np.zeros(3))) > 0:
                joints[f"ball_{side}"] = f"{foot}.end"
    for part, limb in (("pelvis", "thigh"), ("chest", "upper_arm")):
        pair = [joints.get(f"{limb}_{side}") for side in "lr"]
        if part not in joints and all(pair):
            meet = set.intersection(*(above(index[n]) - {index[n]} for n in pair))
            if meet and b.names[max(meet)] not in joints.values():
                joints[part] = b.names[max(meet)]
    trunk = above(index[joints["chest"]]) if "chest" in joints else set()
    heads = [j for j, (side, word) in enumerate(named) if not side and word.endswith("head") and trunk < above(j)]
    if "head" not in joints and heads:
        joints["head"] = b.names[min(heads, key=lambda j: named[j][1] != "head")]
    balls = tuple(joints.pop(f"ball_{side}", None) for side in "lr")
    missing = [s for s in SEGMENTS if s not in joints] + [f"ball_{s}" for s, n in zip("lr", balls) if not n]
    return {s: joints[s] for s in SEGMENTS if s in joints}, balls, missing


def read_map(path):
    """A joint map -> its tables, checked as far as no file is needed: {"joints": …, "unit": …, "up": …, "balls": …}.

    Raises    UserError: the file, the key, and what would be valid
    Test      tests/mocap/test_rigs.py::test_bad_joint_maps
    """
    table = read_toml(path, "a joint map (TOML)")
    for key in table:
        if key not in ("joints", "unit", "up", "balls"):
            raise UserError(f"{path}: unknown key {key!r}; valid: unit, up, balls, [joints]")
    joints, balls = table.get("joints", {}), table.get("balls")
    if not isinstance(joints, dict):
        raise UserError(f"{path}: joints = {joints!r} is no table; write [joints]")
    for key, value in joints.items():
        if key not in SEGMENTS:
            raise UserError(f"{path}: [joints] {key!r} is no segment; valid: {', '.join(SEGMENTS)}")
        if not isinstance(value, str):
            raise UserError(f"{path}: [joints] {key} = {value!r}; expected the name of a joint")
    if balls is not None and not (
        isinstance(balls, list) and len(balls) == 2 and all(isinstance(n, str) for n in balls)
    ):
        raise UserError(f"{path}: balls = {balls!r}; expected the names of two joints, left and right")
    _unit(f"{path}: unit", table.get("unit"))
    _up(f"{path}: up", table.get("up"))
    return table


def blank_map(b: bvh.Bvh, joints, balls, missing) -> str:
    """A joint map to fill in: what was guessed, and a gap for what was not.

    Test      tests/mocap/test_rigs.py::test_unknown_rig."""
    quote = lambda name: '"' + (name or "").replace("\\", "\\\\").replace('"', '\\"') + '"'  # noqa: E731
    lines = [f"# joint map of {b.path}; its joints, and with .end their End Sites:"]
    lines += [f"#   {printable(line)}" for line in bvh.outline(b.names, b.parents)]
    lines += [f"balls = [{quote(balls[0])}, {quote(balls[1])}]  # of the feet, left and right", "", "[joints]"]
    lines += [f"{s} = {quote(joints.get(s))}" + ("  # ?" if s in missing else "") for s in SEGMENTS]
    return "\n".join(lines)


def _check_map(source, b, joints, balls):
    """Names that are there, none twice, limbs in order; segments without a name and balls that are None are passed."""
    valid = {*b.names, *(f"{n}.end" for n in b.end_sites)}
    used = {}
    for key, name in [*joints.items(), *((f"ball_{s}", n) for s, n in zip("lr", balls) if n)]:
        if name not in valid:
            raise UserError(f"{source}: {key} = {name!r} is no joint of {b.path}; valid: {bvh.listed(b.names)}")
        if name in used:
            raise UserError(f"{source}: {key} and {used[name]} are both {name!r}; expected joints of their own")
        used[name] = key
    for segment, parent in zip(SEGMENTS[3:], PARENTS[3:]):
        low, high = (joints.get(s, "") for s in (segment, SEGMENTS[parent]))
        low, high = (n if n in b.names else n.removesuffix(".end") for n in (low, high))
        if parent > 1 and low and high:
            j = b.names.index(low)
            while j >= 0 and b.names[j] != high:
                j = b.parents[j]
            if j < 0:
                raise UserError(f"{source}: {segment} = {low!r} does not hang from {SEGMENTS[parent]} = {high!r}")


# ------------------------------------------------------------------------------------ how the axes stand


def _unknown(group, reading):
    """(Rig, name) for files of one skeleton that is in no table."""
    b, table = group[0], read_map(reading.joint_map) if reading.joint_map else {}
    source = reading.joint_map or b.path
    given, ends = table.get("joints", {}), table.get("balls")
    _check_map(source, b, given, ends or (None, None))
    joints, balls, missing = guess(b, given, ends)
    _check_map(source, b, joints, balls)
    if missing:
        print(blank_map(b, joints, balls, missing))
        raise UserError(
            f"{b.path}: unknown skeleton, and no guess for {', '.join(missing)} "
            f"among its joints {bvh.listed(b.names)}; "
            f"known: {', '.join((*RIGS, 'cmu'))}; fill in the joint map printed above and give it as --joint-map FILE"
        )
    pairs = [
        f"{s} <- {n}"
        for s, n in [*joints.items(), *zip(("ball_l", "ball_r"), balls)]
        if s not in given and not (ends and s[:4] == "ball")
    ]
    say = lambda text: print(printable(f"{b.path}: {text}"), file=sys.stderr)  # noqa: E731
    if pairs:
        say(f"rig guessed from the joints' names: {', '.join(pairs)}")

    poses = [_pose(each) for each in group]
    names = poses[0][0]
    at = [names.index(n) for n in (*joints.values(), *balls)]
    pos = np.concatenate([p[:, at] for _, p, _ in poses])
    up, unit = reading.up or table.get("up"), _unit("", reading.unit or table.get("unit"))
    if not up:
        up, share = find_up(b.path, pos)
        say(f"{up} is up: the head is above the feet along it in {100 * share:.0f} % of the frames")
    order, signs, _ = _from_file(up)
    pos = pos[..., order] * signs
    if not unit:
        unit, name, hips = find_unit(b.path, pos)
        say(f"unit {name}: the hips of a standing adult are 0.6 to 1.2 m high, these {hips:.2f} m")
    rig = Rig(joints, {}, balls, unit=unit, up=up)
    human = [
        _human(rig, np.tile([1.0, 0, 0, 0], (15, 1)), *p, "", "", 1.0 / e.frame_time) for p, e in zip(poses, group)
    ]
    try:
        axes, notes = measure(b.path, human, [_fingers(b, rig, p) for p in poses])
    except ValueError as e:
        raise UserError(f"{b.path}: the axes of its segments cannot be measured: {e}; expected a human") from None
    for note in notes:
        say(note)
    return replace(rig, axes=axes), Path(reading.joint_map).stem if reading.joint_map else "guessed"


def find_up(path, pos):
    """The axis along which the head is above the feet.

    Args      pos : (T, 17, 3) segments' joints and balls of the feet, in the file's axes
    Returns   axis, share of the frames in which it is the steepest
    Raises    UserError: the body lies, or turns over, too much to tell
    Test      tests/mocap/test_rigs.py::test_units_and_up
    """
    v = pos[:, SEG["head"]] - pos[:, FEET].mean(axis=1)
    v = v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
    mean = v.mean(axis=0)
    k = int(np.abs(mean).argmax())
    up = ("-" if mean[k] < 0 else "") + "xyz"[k]
    share = float(np.mean((np.abs(v).argmax(axis=1) == k) & (np.sign(v[:, k]) == np.sign(mean[k]))))
    if abs(mean[k]) < 0.6:
        raise UserError(f"{path}: no axis along which the head is above the feet; give --up (valid: {', '.join(UPS)})")
    return up, share


def find_unit(path, pos):
    """The unit in which the hips are as high as a standing adult's.

    Args      pos : (T, 17, 3) segments' joints and balls of the feet, z up, file units
    Returns   metres a unit, its name, hip height [m]: thigh + shin + the ankle's height over the ball
    Raises    UserError: no unit fits
    Test      tests/mocap/test_rigs.py::test_units_and_up
    """
    length = lambda a, b: np.linalg.norm(pos[:, SEG[a]] - pos[:, SEG[b]], axis=-1).mean()  # noqa: E731
    legs = np.mean([length(f"thigh_{s}", f"shin_{s}") + length(f"shin_{s}", f"foot_{s}") for s in "lr"])
    low = np.percentile(pos[:, [*FEET, 15, 16], 2], 5, axis=0)
    hips = legs + max(float(np.mean(low[:2] - low[2:])), 0.0)
    for name, unit in UNITS.items():
        if HIPS[0] <= hips * unit <= HIPS[1]:
            return unit, name, hips * unit
    raise UserError(
        f"{path}: the hips are {hips:.4g} file units high, in none of {', '.join(UNITS)} an adult's 0.6 to 1.2 m; "
        "give --unit (one of these, or metres a unit)"
    )


def _fingers(b, rig, pose):
    """(T, 2, 3) where the hands point to: the mean of what hangs from the wrist, thumbs apart; NaN for nothing."""
    names, pos, _ = pose
    order, signs, _ = _from_file(rig.up)
    out = np.full((len(pos), 2, 3), np.nan)
    for k, hand in enumerate((rig.joints["hand_l"], rig.joints["hand_r"])):
        children = [j for j, p in enumerate(b.parents) if p >= 0 and b.names[p] == hand]
        ends = [j for j in children if "thumb" not in b.names[j].lower()] or [
            j for j, n in enumerate(names) if n == f"{hand}.end"
        ]
        p = pos[:, ends].mean(axis=1) if ends else out[:, k]
        if not np.allclose(p, pos[:, names.index(hand)], atol=1e-6):
            out[:, k] = p[:, order] * (signs * rig.unit)
    return out


def measure(path, human, fingers):
    r"""Axes of an unknown rig's joints, without its rest pose.

    Method    every direction below is taken in the world, turned into the joint's own frame and averaged over the clip.
              Limbs: up is against the bone; left is the axis about which knee and elbow bend, d₁×d₂ of the two bones
              (knee) or against it (elbow), so weighted by the sine of the flexion.  Pelvis and chest: up from
              mid-hips to mid-shoulders, left from hip to hip or shoulder to shoulder.  Foot: up is the world's while
              heel and ball stand, forward from ankle to ball.  Hand: up against the fingers, left the forearm's
    ASSUMED   in the mean of the upright frames the trunk is straight and the head looks ahead, level, where the chest
              faces; the wrist is straight and not twisted.  Limbs that never bend (less than 10 degrees in nine frames
              of ten, or to all sides) have the left axis of hips or shoulders, brought along the shortest way
    Args      human : Clips with the joints' own rotations; fingers : (T, 2, 3) each, NaN without
    Returns   segment -> (forward, left, up) in the joint's frame; what had to be assumed beyond that: a list of lines
    Raises    UserError: left and right are swapped
    Test      tests/mocap/test_rigs.py::test_any_rig, ::test_limbs_that_never_bend, ::test_known_rigs_measured
    """
    pos, quat = np.concatenate([c.pos for c in human]), np.concatenate([c.quat for c in human])
    ball, fingers = np.concatenate([c.ball for c in human]), np.concatenate(fingers)
    unit = lambda v: v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)  # noqa: E731
    between = lambda a, b: unit(pos[:, SEG[b]] - pos[:, SEG[a]])  # noqa: E731
    axes, notes, vertical = {}, [], np.array([0.0, 0.0, 1.0])

    def local(segment, v, use=slice(None)):
        """Mean of world vectors in a joint's own frame."""
        q = quat[use, SEG[segment]]
        return quat_rotate(quat_conj(q), np.broadcast_to(v, (len(quat), 3))[use]).mean(axis=0)

    hips = 0.5 * (pos[:, SEG["thigh_l"]] + pos[:, SEG["thigh_r"]])
    shoulders = 0.5 * (pos[:, SEG["upper_arm_l"]] + pos[:, SEG["upper_arm_r"]])
    trunk, across = unit(shoulders - hips), {"pelvis": between("thigh_r", "thigh_l")}
    across["chest"] = between("upper_arm_r", "upper_arm_l")
    toes = unit((ball - pos[:, FEET]).mean(axis=1))
    if np.mean(np.sum(toes * np.cross(across["pelvis"], trunk), axis=-1)) < 0:
        raise UserError(f"{path}: the toes point backwards: left and right are swapped in the joint map or mirrored")
    upright = trunk[:, 2] > np.cos(np.radians(30))
    if upright.mean() < 0.1:
        upright[:] = True
        notes.append("the trunk is upright in fewer than a tenth of the frames: head and trunk are measured in all")
    for segment in ("pelvis", "chest"):
        axes[segment] = _frame(local(segment, across[segment], upright), local(segment, trunk, upright))
    axes["head"] = _frame(local("head", across["chest"], upright), local("head", vertical, upright))

    for k, side in enumerate("lr"):
        for upper, lower, end, sign, base in (
            ("thigh", "shin", "foot", 1.0, "pelvis"),
            ("upper_arm", "forearm", "hand", -1.0, "chest"),
        ):
            upper, lower, end = (f"{s}_{side}" for s in (upper, lower, end))
            d1, d2 = between(upper, lower), between(lower, end)
            bend = sign * np.cross(d1, d2)
            much = np.linalg.norm(bend, axis=-1)
            plain = np.linalg.norm(local(upper, bend)) > 0.8 * much.mean()
            if not plain or np.percentile(much, 90) < np.sin(np.radians(10)):
                bend = _carried(-trunk, d1, across[base])
                joint = "knee" if base == "pelvis" else "elbow"
                notes.append(f"{joint}_{side} hardly bends, or to all sides: its axis is that of hips or shoulders")
            axes[upper], axes[lower] = (
                _frame(local(upper, bend), -local(upper, d1)),
                _frame(local(lower, bend), -local(lower, d2)),
            )
        hand, forearm = f"hand_{side}", f"forearm_{side}"
        along = unit(fingers[:, k] - pos[:, SEG[hand]]) if np.isfinite(fingers[:, k]).all() else between(forearm, hand)
        left = quat_rotate(quat[:, SEG[forearm]], np.broadcast_to(axes[forearm][1], (len(quat), 3)))
        axes[hand] = _frame(local(hand, left), -local(hand, along))

        foot, ankle = f"foot_{side}", pos[:, FEET[k]]
        speed = [
            np.linalg.norm(np.concatenate([linear_velocity(v, c.rate) for v, c in each]), axis=-1)
            for each in (zip([c.pos[:, FEET[k]] for c in human], human), zip([c.ball[:, k] for c in human], human))
        ]
        low = [p[:, 2] < np.percentile(p[:, 2], 10) + 0.03 for p in (ankle, ball[:, k])]
        flat = low[0] & low[1] & (speed[0] < 0.25) & (speed[1] < 0.25)
        if flat.sum() < 5:
            flat = low[0]
            notes.append(f"{foot} never stands: its sole is taken as level where the ankle is lowest")
        up, ahead = local(foot, vertical, flat), local(foot, ball[:, k] - ankle, flat)
        axes[foot] = _frame(np.cross(up, ahead), up)
    return axes, [f"ASSUMED: {note}" for note in notes]


def _carried(a, b, v):
    """v turned as the shortest way turns a to b, unit vectors (T, 3) each."""
    dot = lambda x, y: np.sum(x * y, axis=-1, keepdims=True)  # noqa: E731
    return v - dot(a + b, v) / np.maximum(1.0 + dot(a, b), 1e-6) * (a + b) + 2.0 * dot(a, v) * b

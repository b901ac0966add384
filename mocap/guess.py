"""A rig that is in no table: which joint is which segment, by names; how its axes stand, by where the body moves."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from human import FEET, PARENTS, SEG, SEGMENTS, linear_velocity, quat_conj, quat_rotate
from mocap import bvh
from mocap.rigs import (
    RIGS,
    UNITS,
    UPS,
    Rig,
    axes_of,
    checked_unit,
    checked_up,
    find_unit,
    from_file_axes,
    human_clip,
    pose_of,
    say,
    unit_line,
)
from plumbing.cli import UserError, printable
from plumbing.files import read_toml

CHARACTER = (0.2, 1.5)  # m, ASSUMED: hips of a character; its own file is taken for one of ours, in cm, within

# ------------------------------------------------------------------------------------ which joint is which segment

_WORDS = {  # what joints are called, side and decoration apart; the first that is there counts
    "thigh": ("upleg", "upperleg", "thigh", "femur", "hip"),
    "shin": ("lowerleg", "lowleg", "shin", "calf", "tibia", "knee", "leg"),
    "foot": ("ankle", "foot"),
    "ball": ("toebase", "toe", "toes", "ball", "foot"),
    "upper_arm": ("upperarm", "uparm", "uarm", "humerus", "arm", "shldr", "shoulder"),
    "forearm": ("forearm", "lowerarm", "lowarm", "farm", "radius", "elbow"),
    "hand": ("wrist", "hand"),
}
_KNOWN = {w for each in _WORDS.values() for w in each}
_LEG, _ARM = ("thigh", "shin", "foot", "ball"), ("upper_arm", "forearm", "hand")
_LEFT = "l left lft lf lt links gauche izq izquierda izquierdo sx sinistra"
_RIGHT = "r right rgt rt rechts droite droit der derecha derecho dx destra"
_SIDES = dict.fromkeys(_LEFT.split(), "l") | dict.fromkeys(_RIGHT.split(), "r")
_FIRST = ("upper", "lower", "up", "low", "fore")  # "arm_upper" is the upper arm
_REGION = re.compile("(leg|arm)(.+)")  # "leg_knee" is the knee
_DECORATION = {
    "joint", "jnt", "bone", "bip", "biped", "mixamorig", "def", "org", "character", "rig", "b", "j", "m", "avg", "bend",
}  # fmt: skip


def read_name(name: str):
    """A joint's name -> (side "l", "r" or "", word): "mixamorig:LeftUpLeg" is (l, upleg), "lThigh" (l, thigh).

    Test      tests/mocap/test_rigs.py::test_names
    """
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name.rsplit(":", 1)[-1])
    words = [w for w in map(str.lower, parts) if w not in _DECORATION]
    words = words if "LF" not in parts else ["".join(words)]  # "LFArm" is a left forearm
    side = next((_SIDES[w] for w in words if w in _SIDES), "")
    word = "".join(sorted((w for w in words if w not in _SIDES), key=lambda w: w not in _FIRST))
    if not side:  # without capitals: "leftupleg", "lfemur", "uplegleft"
        for given in _SIDES:
            for rest in (word.removeprefix(given), word.removesuffix(given)):
                if rest != word and rest in _KNOWN:
                    return _SIDES[given], rest
    found = _REGION.fullmatch(word)
    return side, found[2] if found and found[2] in _KNOWN and word not in _KNOWN else word


SHARED = 0.8  # of the joints: a prefix or suffix that so many have is decoration.  ASSUMED


def bare_names(names) -> list[str]:
    """Joints' names without the prefix and the suffix that nearly all of them share, and without numbers.

    Test      tests/mocap/test_mend.py::test_any_prefix_or_suffix, ::test_bare_names"""
    names = [re.sub(r"\d+", "_", n) for n in names]
    for _ in range(2):  # a suffix may hide behind another: "Hips:rig_01"
        names = without_prefix(names)
        names = [n[::-1] for n in without_prefix([n[::-1] for n in names])]
        names = [n.rsplit(":", 1)[-1] for n in names]
    return names


def without_prefix(names) -> list[str]:
    """Names without the longest beginning that nearly all share: in order of the alphabet they surround the middle.

    Test      tests/mocap/test_mend.py::test_bare_names, tests/headset/test_columns.py::test_what_all_columns_share"""
    if len(names) < 5:
        return names
    middle = sorted(names)[len(names) // 2][:100]
    best = 0
    for k in range(1, len(middle) + 1):
        if sum(n.startswith(middle[:k]) for n in names) < SHARED * len(names):
            break
        best = k
    return [n[best:] if n.startswith(middle[:best]) and len(n) > best else n for n in names]


def guess(b: bvh.Bvh, joints=None, balls=None):
    """Which joint is which segment, from names along the limbs; the trunk is where the limbs meet.

    Args      joints : segment -> joint, and balls : (left, right) or None: what is known already
    Returns   joints, balls : completed as far as possible;  missing : segments (and ball_l, ball_r) that were not found
    Test      tests/mocap/test_rigs.py::test_any_rig, ::test_partial_joint_map, tests/mocap/test_mend.py::test_no_hands
    """
    ways = [_guess(b, [read_name(n) for n in names], joints, balls) for names in (bare_names(b.names), b.names)]
    return min(ways, key=lambda way: len(way[2]))


COINCIDE = 0.01  # of the skeleton's size: joints nearer than that are in one place


def _guess(b, named, joints, balls):
    joints = dict(joints or {})
    index = {n: j for j, n in enumerate(b.names)}
    index |= {f"{n}.end": index[n] for n in b.end_sites}
    length = np.linalg.norm(b.offsets, axis=-1)
    length[0] = 0.0
    tiny = COINCIDE * (length.sum() + 1e-9) / 3  # a third of all bones is about the height

    @cache
    def above(j):
        """Joint j and all that it hangs from."""
        found = set()
        while j >= 0:
            found.add(int(j))
            j = b.parents[j]
        return frozenset(found)

    def distinct(fits):
        """Of joints of the best name the first; of a chain of fitting ones in one place the last: it turns the bone."""
        chosen = fits[0]
        for j in sorted(fits[1:]):
            between = above(j) - above(chosen)
            here = length[chosen] <= tiny or sum(length[i] for i in between) <= tiny
            if chosen in above(j) and here:
                chosen = j
        return chosen

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
                    joints[key] = b.names[distinct(fits)]
                if key in joints:
                    top = above(index[joints[key]])
        foot, ball = joints.get(f"foot_{side}"), joints.get(f"ball_{side}")
        if foot and ball in b.names and length[index[ball]] <= tiny and not balls:  # toes in the ankle's place
            del joints[f"ball_{side}"]
            if np.linalg.norm(b.end_sites.get(ball, np.zeros(3))) > tiny:
                joints[f"ball_{side}"] = f"{ball}.end"
        if foot and f"ball_{side}" not in joints:  # toes of another name: the foot's only child, or where it ends
            children = [j for j, p in enumerate(b.parents) if p >= 0 and b.names[p] == foot and length[j] > tiny]
            if len(children) == 1:
                joints[f"ball_{side}"] = b.names[children[0]]
            elif np.linalg.norm(b.end_sites.get(foot, np.zeros(3))) > 0:
                joints[f"ball_{side}"] = f"{foot}.end"
        forearm = joints.get(f"forearm_{side}")
        if f"hand_{side}" not in joints and np.linalg.norm(b.end_sites.get(forearm, np.zeros(3))) > tiny:
            joints[f"hand_{side}"] = f"{forearm}.end"
    for part, limb in (("pelvis", "thigh"), ("chest", "upper_arm")):
        pair = [joints.get(f"{limb}_{side}") for side in "lr"]
        if part not in joints and all(pair):
            meet = set.intersection(*(set(above(index[n]) - {index[n]}) for n in pair))
            if meet and b.names[max(meet)] not in joints.values():
                joints[part] = b.names[max(meet)]
    trunk = above(index[joints["chest"]]) if "chest" in joints else frozenset()
    heads = [j for j, (side, word) in enumerate(named) if not side and word.endswith("head") and trunk < above(j)]
    if "head" not in joints and heads:
        joints["head"] = b.names[min(heads, key=lambda j: named[j][1] != "head")]
    elif "head" not in joints and trunk and (head := _headless(b, named, joints, above, length, tiny)):
        joints["head"] = head
    balls = tuple(joints.pop(f"ball_{side}", None) for side in "lr")
    missing = [s for s in SEGMENTS if s not in joints] + [f"ball_{s}" for s, n in zip("lr", balls) if not n]
    return {s: joints[s] for s in SEGMENTS if s in joints}, balls, missing


NECK = 0.35  # of a shin: what is longer reaches to the top of the head


def _headless(b, named, joints, above, length, tiny):
    """What is the head of a rig without a joint of that name: of the one chain above the arms the bone behind the neck,
    or the last; of a chain that ends at the neck its End Site, or the neck where that is too far up.

    ASSUMED   the head turns as the neck does
    Test      tests/mocap/test_mend.py::test_no_head, ::test_head_of_another_name
    """
    chest = b.names.index(joints["chest"])
    limbs = set().union(*(above(b.names.index(n)) for n in joints.values() if n in b.names))
    free = [j for j, (side, _) in enumerate(named) if not side and j not in limbs and above(chest) < above(j)]
    neck = free[-1] if free else chest  # of the trunk's joints the last
    if "neck" not in named[neck][1]:  # of another name: one chain, without joints that only say where its bone ends
        chain = all(b.parents[j] == i for i, j in zip(free, free[1:]))
        behind = [j for i, j in zip(free, free[1:]) if "neck" in named[i][1]]
        bones = [j for j in free if j in b.parents or np.linalg.norm(b.end_sites.get(b.names[j], np.zeros(3))) > tiny]
        return b.names[(behind or bones or free)[-1]] if free and chain else None
    end, shin = np.linalg.norm(b.end_sites.get(b.names[neck], np.zeros(3))), joints.get("foot_l")
    short = shin not in b.names or end <= NECK * length[b.names.index(shin)]
    if end > 0 and (short or neck == chest):
        return f"{b.names[neck]}.end"
    return b.names[neck] if neck != chest else None


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
    checked_unit(f"{path}: unit", table.get("unit"))
    checked_up(f"{path}: up", table.get("up"))
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


def unknown_rig(b, group, reading):
    """(Rig, name) for a file, and files of its skeleton, that is in no table.

    Test      tests/mocap/test_rigs.py::test_any_rig"""
    table = read_map(reading.joint_map) if reading.joint_map else {}
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
    if pairs:
        say(b.path, f"rig guessed from the joints' names: {', '.join(pairs)}", warning=False)
    called = ["head"] * ("head" not in joints["head"].lower()) + [
        s for s in ("hand_l", "hand_r") if joints[s] == f"{joints[s.replace('hand', 'forearm')]}.end"
    ]
    for segment in called:
        if segment not in given:
            what = segment if segment[-2] == "_" else f"the {segment}"
            say(b.path, f"no joint for {what}: {joints[segment]} is taken for it; another: --joint-map")

    poses = [pose_of(each) for each in group]
    names = poses[0][0]
    at = [names.index(n) for n in (*joints.values(), *balls)]
    up, unit = reading.up or table.get("up"), checked_unit("", reading.unit or table.get("unit"))
    if not up:
        up, share = _of_all(b, group, lambda files, path: find_up(path, np.concatenate([p[:, at] for p in files])),
                            [p for _, p, _ in poses])  # fmt: skip
        say(b.path, f"{up} is up: the head is above the feet along it in {100 * share:.0f} % of the frames", False)
    order, signs, _ = from_file_axes(up)
    pos = np.concatenate([p[:, at] for _, p, _ in poses])[..., order] * signs
    if not unit:
        unit, name, hips = find_unit(pos)
        if CHARACTER[0] <= hips * UNITS["cm"] <= CHARACTER[1] and all(
            joint == segment for segment, joint in joints.items() if segment[-2] == "_"
        ):  # as retarget.write_bvh calls them
            unit = UNITS["cm"]
            say(b.path, f"unit cm: the joints are called as in a character's file; hips {hips * unit:.2f} m", False)
        else:
            say(b.path, unit_line(unit, name, hips), warning=not name)
    rig = Rig(joints, {}, balls, unit=unit, up=up)
    human = [
        human_clip(rig, np.tile([1.0, 0, 0, 0], (15, 1)), *p, "", "", 1.0 / e.frame_time) for p, e in zip(poses, group)
    ]
    fingers = [_fingers(b, rig, p) for p in poses]
    axes, notes = _of_all(b, group, lambda files, path: _measured(path, files), list(zip(human, fingers)))
    for note in notes:
        say(b.path, note)
    return replace(rig, axes=axes), Path(reading.joint_map).stem if reading.joint_map else "guessed"


def _measured(path, files):
    """`measure` of (Clip, fingers) pairs, every complaint a UserError."""
    try:
        return measure(path, [clip for clip, _ in files], [fingers for _, fingers in files])
    except ValueError as e:
        raise UserError(f"{path}: the axes of its segments cannot be measured: {e}; expected a human") from None


def _of_all(b, group, what, files):
    """what(files, path) of all files of a group; if that fails, the file that fails by itself is the one to blame.

    Test      tests/mocap/test_mend.py::test_the_bad_file_is_named"""
    try:
        return what(files, b.path)
    except UserError as error:
        for each, file in zip(group, files):
            if len(group) > 1 and each.path != b.path:
                what([file], each.path)
        raise error


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


def _fingers(b, rig, pose):
    """(T, 2, 3) where the hands point to: the mean of what hangs from the wrist, thumbs apart; NaN for nothing."""
    names, pos, _ = pose
    order, signs, _ = from_file_axes(rig.up)
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
        valid = "toes that point where the left side is left of the right one"
        raise UserError(f"{path}: the toes point backwards: left and right are swapped or mirrored; valid: {valid}")
    upright = trunk[:, 2] > np.cos(np.radians(30))
    if upright.mean() < 0.1:
        upright[:] = True
        notes.append("the trunk is upright in fewer than a tenth of the frames: head and trunk are measured in all")
    for segment in ("pelvis", "chest"):
        axes[segment] = axes_of(local(segment, across[segment], upright), local(segment, trunk, upright))
    axes["head"] = axes_of(local("head", across["chest"], upright), local("head", vertical, upright))

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
                axes_of(local(upper, bend), -local(upper, d1)),
                axes_of(local(lower, bend), -local(lower, d2)),
            )
        hand, forearm = f"hand_{side}", f"forearm_{side}"
        along = unit(fingers[:, k] - pos[:, SEG[hand]]) if np.isfinite(fingers[:, k]).all() else between(forearm, hand)
        left = quat_rotate(quat[:, SEG[forearm]], np.broadcast_to(axes[forearm][1], (len(quat), 3)))
        axes[hand] = axes_of(local(hand, left), -local(hand, along))

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
        axes[foot] = axes_of(np.cross(up, ahead), up)
    return axes, [f"ASSUMED: {note}" for note in notes]


def _carried(a, b, v):
    """v turned as the shortest way turns a to b, unit vectors (T, 3) each."""
    dot = lambda x, y: np.sum(x * y, axis=-1, keepdims=True)  # noqa: E731
    return v - dot(a + b, v) / np.maximum(1.0 + dot(a, b), 1e-6) * (a + b) + 2.0 * dot(a, v) * b

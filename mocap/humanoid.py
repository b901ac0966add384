"""The bones by which animation tools know a human: their names, and a character's bodies that stand for them.

Mixamo, Unity (Humanoid, HumanBodyBones) and VRM want bones of given names under one another, and a rest pose that is a
T: upright, legs straight down, arms straight out to the sides, palms down.  A character's joint map says which of its
bodies follow which segment of a human; from that the names follow, for a character of one's own as for the three.
"""

from __future__ import annotations

import mujoco
import numpy as np

from human import SEG, quat_about, quat_conj, quat_mul, quat_rotate

SIDES = {"l": "Left", "r": "Right"}
LIMBS = {  # segment of the human -> Unity's name without its side, Mixamo's
    "thigh": ("UpperLeg", "UpLeg"),
    "shin": ("LowerLeg", "Leg"),
    "foot": ("Foot", "Foot"),
    "upper_arm": ("UpperArm", "Arm"),
    "forearm": ("LowerArm", "ForeArm"),
    "hand": ("Hand", "Hand"),
}
TRUNK = {"Hips": "Hips", "Spine": "Spine", "Chest": "Spine1", "UpperChest": "Spine2", "Neck": "Neck", "Head": "Head"}
BONES = TRUNK | {SIDES[s] + unity: SIDES[s] + mixamo for unity, mixamo in LIMBS.values() for s in "lr"}  # Unity, Mixamo
NAMES = {  # standard -> bone, by Unity's name, -> the standard's name
    "mixamo": {bone: f"mixamorig:{mixamo}" for bone, mixamo in BONES.items()},
    "unity": {bone: bone for bone in BONES},
    "vrm": {bone: bone[0].lower() + bone[1:] for bone in BONES},
}
OPTIONAL = {  # what a standard does without; VRM 1.0 also does without chest and neck, which VRM 0.x needs
    "mixamo": (),
    "unity": ("Chest", "UpperChest", "Neck"),
    "vrm": ("UpperChest",),
}


def bones(char) -> dict[int, str]:
    """Which body is which bone, by the joint map: body id -> Unity's name of the bone.

    Method    the bodies that share the trunk's turn are Spine, Chest and UpperChest: the first, the second, the last.
              Of the neck's the first is Neck, the last Head.  Of a limb's segment the last, which takes what is left.
              A hand that follows nobody is the body that holds the controller
    Test      tests/mocap/test_humanoid.py::test_names, test_a_character_of_ones_own
    """
    of = {}  # segment -> bodies that follow it, in tree order
    for follower in char.chains:
        of.setdefault(follower.end, []).append(follower.body)
    trunk, neck = of.get(SEG["chest"], []), of.get(SEG["head"], [])
    out = {char.root: "Hips"}
    out |= dict(zip(trunk[:2] + trunk[2:][-1:], ("Spine", "Chest", "UpperChest")))
    out |= dict.fromkeys(neck[:1], "Neck") | dict.fromkeys(neck[-1:], "Head")
    for segment, (name, _) in LIMBS.items():
        for s in "lr":
            out |= dict.fromkeys(of.get(SEG[f"{segment}_{s}"], [])[-1:], SIDES[s] + name)
    for site, s in zip(char.sensor_sites[1:], "lr"):
        if SEG[f"hand_{s}"] not in of:
            out.setdefault(int(char.model.site_bodyid[site]), f"{SIDES[s]}Hand")
    return out


def lacking(char, standard: str) -> list[str]:
    """The bones that a standard requires and a character has not, by the standard's names.

    Test      tests/mocap/test_humanoid.py::test_required_bones, test_a_character_of_ones_own"""
    has = set(bones(char).values())
    return [name for bone, name in NAMES[standard].items() if bone not in has and bone not in OPTIONAL[standard]]


def names(char, standard: str) -> list[str]:
    """A name for each body of the model: the bone's, or the body's own where the standard has no bone for it.

    Test      tests/mocap/test_humanoid.py::test_names"""
    m, known = char.model, {b: NAMES[standard][bone] for b, bone in bones(char).items()}
    own = [m.body(b).name or f"body{b}" for b in range(m.nbody)]
    return [known.get(b, name if name not in known.values() else f"{name}_own") for b, name in enumerate(own)]


def between(char) -> list[int]:
    """The bodies without a bone that stand between two bones: of a spine of four, the third.

    Why       Unity and VRM discard what such a body turns: it must be handed on to the bone that comes next
    Test      tests/mocap/test_humanoid.py::test_between_bones_nothing_turns"""
    m, known = char.model, bones(char)
    above = set()
    for b in known:
        while b := int(m.body_parentid[b]):
            above.add(b)
    return sorted(above - set(known))


def turn_between(a, b):
    """The shortest turn that takes the direction a (3,) to b (3,).  -> (4,)

    Test      tests/mocap/test_humanoid.py::test_turn_between"""
    a, b = (np.asarray(v, float) / np.linalg.norm(v) for v in (a, b))
    q = np.array([1.0 + a @ b, *np.cross(a, b)])
    if q[0] < 1e-9:  # opposite directions: half a turn about any axis across them
        q = np.array([0.0, *np.cross(a, np.eye(3)[np.argmin(np.abs(a))])])
    return q / np.linalg.norm(q)


def t_pose(char):
    """How a character's bodies stand in a T-pose: the rest pose of humanoids, from which their bones' turns count.

    Method    from the default pose, the counterpart of a human who stands with hanging arms (`Character.rest`): each
              arm raised by 90 degrees to its side, so that palms look down; then arms and legs made straight, from
              their first joint outwards.  Feet stay flat; trunk, head, ears and tail stay as they are
    Frame     world, facing x; quaternions w, x, y, z
    Returns   (nbody, 4)
    Test      tests/mocap/test_humanoid.py::test_t_pose, test_t_pose_of_a_bent_character
    """
    m, data, known = char.model, mujoco.MjData(char.model), bones(char)
    data.qpos[7:] = char.default
    mujoco.mj_kinematics(m, data)
    body_of = {bone: b for b, bone in known.items()}
    out = char.rest.copy()
    for b in range(1, m.nbody):
        parent, bone = m.body_parentid[b], known.get(b, "")
        out[b] = quat_mul(out[parent], quat_mul(quat_conj(char.rest[parent]), char.rest[b]))
        side = 1.0 if bone.startswith("Left") else -1.0
        if bone.endswith("Foot"):
            out[b] = char.rest[b]
        elif bone.endswith("UpperArm"):
            out[b] = quat_mul(quat_about(0, side * np.pi / 2), out[b])
        wanted = np.array([0.0, side, 0.0] if bone.endswith("Arm") else [0.0, 0.0, -1.0])
        following = body_of.get(FOLLOWING.get(bone))
        if following:
            along = quat_rotate(quat_conj(char.rest[b]), data.xpos[following] - data.xpos[b])  # in the body's frame
            out[b] = quat_mul(turn_between(quat_rotate(out[b], along), wanted), out[b])
    return out


FOLLOWING = {  # the bones that are made straight -> the joint that they end in
    f"{side}{bone}": f"{side}{end}"
    for side in SIDES.values()
    for bone, end in (("UpperArm", "LowerArm"), ("LowerArm", "Hand"), ("UpperLeg", "LowerLeg"), ("LowerLeg", "Foot"))
}

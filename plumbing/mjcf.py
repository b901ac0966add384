"""MJCF as every character's must be, each rule broken in one line: a free joint, hinges about one axis, plain motors, a
floor."""

from __future__ import annotations

import difflib
import warnings
from contextlib import contextmanager
from functools import partial

import mujoco
import numpy as np

from plumbing.cli import UserError
from plumbing.files import check_claims

LARGEST = 1e9  # no size or mass of a model is larger
SHAPES = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)


@contextmanager
def told(xml):
    """What MuJoCo refuses or warns of, as a UserError that names the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            yield
        except (ValueError, RuntimeError, MemoryError, Warning) as e:
            raise UserError(f"{xml}: {e}; expected MJCF that MuJoCo can compile") from None


def read_mjcf(xml) -> mujoco.MjSpec:
    """An MJCF as it stands in its file.

    Raises    UserError: no MJCF, or it asks for much more than its own size
    Test      tests/test_characters.py::test_checks, tests/robustness/test_fuzz.py::test_character_models"""
    check_claims(xml)
    with told(xml):
        return mujoco.MjSpec.from_file(str(xml))


# ------------------------------------------------------------------------------------ before it is compiled

TWICE = "valid: x, y and z once each"


def broken_parts(spec: mujoco.MjSpec):
    """What no model can be made of, or none of ours, part by part: a line, and a function that takes it out of the way.

    A checker goes on with what is left; who loads stops at the first.
    Test      tests/test_check.py::test_every_mistake"""
    for body in spec.bodies:
        hinges = [j for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
        axes = ["xyz"[np.argmax(np.abs(j.axis))] for j in hinges]
        if len(set(axes)) < len(axes):
            says = f"body {body.name} has two hinges about one axis ({''.join(axes)}); {TWICE}"
            yield says, partial(spread, hinges)
        if body.explicitinertial and not body.mass > 0:
            yield f"body {body.name} has a mass of {body.mass:g}; valid: kg, greater than 0", partial(lighten, body)
        elif len(body.joints) and not has_mass(body):
            says = f"body {body.name} moves, and has neither a shape that can collide nor a mass"
            yield f"{says}; give it a geom of conaffinity 1, or <inertial>", partial(lighten, body)
    for joint in spec.joints:
        low, high = joint.range
        if low >= high and (low or high):
            yield f"the range of joint {joint.name} is {low:g} to {high:g}; valid: the smaller angle first", None
    for geom in spec.geoms:
        where = f"{'geom ' + geom.name if geom.name else 'a geom'} of body {geom.parent.name}"
        heavy, text = ("mass", f"{geom.mass:g}") if np.isfinite(geom.mass) else ("density", f"{geom.density:g}")
        if not getattr(geom, heavy) >= 0:
            yield f"{where} has a {heavy} of {text}; valid: 0 or more", partial(setattr, geom, heavy, 1.0)
    yield from unknown_targets(spec)


def lighten(body):
    """A kilogram in a body's place."""
    body.explicitinertial, body.mass, body.inertia = True, 1.0, [0.01, 0.01, 0.01]


def spread(hinges):
    """Each about an axis of its own, as far as there are three."""
    for hinge, axis in zip(hinges, np.eye(3), strict=False):
        hinge.axis = axis


def has_mass(body) -> bool:
    """Whether a body, or one that is welded to it, has an inertia or shapes that give it one."""
    welded = [b for b in body.bodies if not len(b.joints)]
    return bool(body.explicitinertial or len(body.geoms)) or any(map(has_mass, welded))


def unknown_targets(spec: mujoco.MjSpec):
    """Motors and sensors of what is not there, as `broken_parts`."""
    kinds = mujoco.mjtObj
    named = {
        kinds.mjOBJ_JOINT: spec.joints, kinds.mjOBJ_SITE: spec.sites, kinds.mjOBJ_GEOM: spec.geoms,
        kinds.mjOBJ_BODY: spec.bodies, kinds.mjOBJ_XBODY: spec.bodies,
    }  # fmt: skip
    named = {kind: [item.name for item in items if item.name] for kind, items in named.items()}
    for motor in spec.actuators:
        joints = named[kinds.mjOBJ_JOINT]
        if motor.trntype == mujoco.mjtTrn.mjTRN_JOINT and motor.target not in joints:
            name = f"motor {motor.name}" if motor.name else "a motor"
            says = f"{name} turns joint {motor.target!r}, which is not there; valid: {', '.join(joints)}"
            yield says, partial(spec.delete, motor)
    for sensor in spec.sensors:
        for key in ("obj", "ref"):
            kind, name = getattr(sensor, f"{key}type"), getattr(sensor, f"{key}name")
            if kind in named and name not in named[kind]:
                what, valid = kind.name.removeprefix("mjOBJ_").lower().removeprefix("x"), ", ".join(named[kind])
                says = f"sensor {sensor.name} is of {what} {name!r}, which is not there; valid: {valid or 'none'}"
                near = difflib.get_close_matches(name, named[kind], 1, 0.0)  # what was meant, presumably
                yield says, partial(setattr, sensor, f"{key}name", near[0]) if near else partial(spec.delete, sensor)


# ------------------------------------------------------------------------------------ the model


def compiled(spec: mujoco.MjSpec, xml) -> mujoco.MjModel:
    """The model of an MJCF; no body has two hinges about one axis, and no size or mass is beyond any use."""
    for says, _ in broken_parts(spec):
        raise UserError(f"{xml}: {says}")
    return made(spec, xml)


def made(spec: mujoco.MjSpec, xml) -> mujoco.MjModel:
    """The model, as MuJoCo compiles it."""
    with told(xml):
        m = spec.compile()
    for name in "body_pos body_ipos body_mass body_inertia geom_pos geom_size jnt_pos jnt_range site_pos".split():
        if not np.all(np.abs(getattr(m, name)) <= LARGEST):
            raise UserError(f"{xml}: its {name} holds NaN, or more than {LARGEST:g}; expected SI units")
    return m


def names_of(m, what) -> dict:
    """name -> id of a model's bodies, sites or sensors."""
    kind, count = getattr(mujoco.mjtObj, f"mjOBJ_{what.upper()}"), getattr(m, f"n{what}")
    names = [mujoco.mj_id2name(m, kind, k) for k in range(count)]
    return {name: k for k, name in enumerate(names) if name}


def hinges_of(m, xml):
    """Names and ranges of the hinges of a model that has one free joint and then hinges.

    Returns   names : list of j; ranges (j, 2) [rad], infinite where a hinge has none
    Raises    UserError: other joints, a hinge without a name or about a slant axis, degrees
    Test      tests/test_characters.py::test_checks, ::test_unnamed_hinge"""
    for says in hinge_faults(m):
        raise UserError(f"{xml}: {says}")
    return hinges_as_they_are(m)


def hinges_as_they_are(m):
    """Names and ranges of all joints but the first; "" where one has no name."""
    names = [mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_JOINT, k) or "" for k in range(1, m.njnt)]
    return names, np.where(m.jnt_limited[1:, None].astype(bool), m.jnt_range[1:], [-np.inf, np.inf])


def hinge_faults(m):
    """What is wrong with the joints of a model, line by line.

    Test      tests/test_characters.py::test_checks, tests/test_check.py::test_every_mistake"""
    kinds, (names, _) = mujoco.mjtJoint, hinges_as_they_are(m)
    body = lambda k: m.body(m.jnt_bodyid[k]).name  # noqa: E731
    rule = "the first joint must be free and all others hinges"
    if m.njnt == 0 or m.jnt_type[0] != kinds.mjJNT_FREE:
        root = m.body(m.body_rootid[m.jnt_bodyid[0]]).name if m.njnt else ""
        yield f"{rule}; " + (f"body {root} has no free joint: give it <freejoint/>" if root else "there is none")
    odd = [k for k in range(1, m.njnt) if m.jnt_type[k] != kinds.mjJNT_HINGE]
    for k in odd:
        kind = kinds(m.jnt_type[k]).name.removeprefix("mjJNT_").lower()
        yield f"{rule}; joint {names[k - 1] or 'without a name'} of body {body(k)} is of type {kind}"
    if m.njnt == 1:
        yield f"{rule}; there are no hinges"
    trees = list(dict.fromkeys(m.body(b).name for b in m.body_rootid[m.jnt_bodyid]))
    if len(trees) > 1:
        yield f"one body of the world may have joints, with all others in it; there are {', '.join(trees)}"
    hinges = [k for k in range(1, m.njnt) if k not in odd]
    for k in hinges:
        if not names[k - 1]:
            yield f"every hinge needs a name, such as hip_l_y; one of body {body(k)!r} has none"
    slant = [names[k - 1] for k in hinges if not np.isclose(np.abs(m.jnt_axis[k]).max(), 1.0)]
    if slant:
        yield f"every hinge must turn about one axis of its body's frame (x, y or z); not so {', '.join(slant)}"
    yield from range_faults(m, [k for k in hinges if m.jnt_limited[k]], names)
    for k in hinges:
        for what, value in (("stiffness", m.jnt_stiffness[k]), ("damping", m.dof_damping[m.jnt_dofadr[k]])):
            if np.any(value < 0):
                yield f"hinge {names[k - 1]} has a {what} of {float(np.min(value)):g}; valid: 0 or more"


def range_faults(m, hinges, names):
    """Degrees."""
    if hinges and np.abs(m.jnt_range[hinges]).max() < 0.1:
        yield "joint ranges look like degrees read as radians; set <compiler angle='radian'/>"
    for k in hinges:
        far = np.abs(m.jnt_range[k]).max()
        if far > 2 * np.pi:
            yield f"the range of hinge {names[k - 1]} reaches {far:.0f} rad: it looks like degrees; write radians"


def driven_of(m, xml) -> np.ndarray:
    """Hinge index of each motor of a model whose motors are plain: control -1 to 1 times a gear.

    Test      tests/test_characters.py::test_checks"""
    for says in motor_faults(m):
        raise UserError(f"{xml}: {says}")
    return m.actuator_trnid[:, 0] - 1


def motor_faults(m):
    """What is wrong with the motors of a model, line by line.

    Test      tests/test_characters.py::test_checks, tests/test_check.py::test_every_mistake"""
    driven = m.actuator_trnid[:, 0]
    turns = m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    hinge = turns & (m.jnt_type[np.where(turns, driven, 0)] == mujoco.mjtJoint.mjJNT_HINGE)
    again = np.array([driven[k] in driven[:k][hinge[:k]] for k in range(m.nu)], bool)
    plain = (m.actuator_gaintype == 0) & (m.actuator_biastype == 0) & (m.actuator_gainprm[:, 0] == 1)
    plain &= ~(m.actuator_ctrllimited.astype(bool) & np.any(m.actuator_ctrlrange != [-1, 1], axis=1))

    def names(ids):
        found = [mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, k) for k in ids]
        joint = lambda k: f"that of {m.joint(driven[k]).name}" if turns[k] else f"number {k}"  # noqa: E731
        return ", ".join(name or joint(k) for name, k in zip(found, ids, strict=True))

    rules = (~hinge | again, "motor on a hinge of its own"), (~plain, 'plain <motor>, its ctrlrange "-1 1"')
    for wrong, rule in rules:
        if wrong.any():
            yield f"every actuator must be a {rule}; not so {names(np.flatnonzero(wrong))}"


def check_floor(m, xml):
    """There is something to stand on.  Test: tests/test_characters.py::test_checks"""
    planes = (m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (m.geom_bodyid == 0) & (m.geom_pos[:, 2] == 0.0)
    if not planes.any():
        raise UserError(f"{xml}: needs a floor: a geom of type plane at height 0 in the world body")


def collision_geoms(m, bodies, where) -> np.ndarray:
    """Ids of the bodies' geoms that the floor can touch: spheres, capsules and boxes, whose lowest point is known.

    Args      bodies : ids; where : the entry that names them, for the message
    Test      tests/test_characters.py::test_checks"""
    geoms = np.array([g for b in bodies for g in np.flatnonzero((m.geom_bodyid == b) & (m.geom_conaffinity != 0))], int)
    names = [m.body(b).name for b in bodies]
    if not len(geoms):
        raise UserError(f"{where} = {names!r} have no geom that the floor can touch; give them one of conaffinity 1")
    if not np.isin(m.geom_type[geoms], [int(s) for s in SHAPES]).all():
        raise UserError(f"{where} = {names!r} must have collision geoms of type sphere, capsule and box alone")
    return geoms


# ------------------------------------------------------------------------------------ variations


def weld(spec: mujoco.MjSpec, joints, angles: dict, xml):
    """Take hinges away; their bodies stay where these angles [rad] of their hinges have them.

    Raises    UserError: a turned hinge beside its body's origin, or of a body that a motor turns, too
    Test      tests/test_characters.py::test_fixed_tail_keeps_its_pose"""
    with told(xml):
        flat = spec.copy().compile()
    motors, turned = {a.target for a in spec.actuators}, set()
    for joint in joints:
        body, angle = joint.parent, angles.get(joint.name, 0.0)
        if angle and (np.any(joint.pos) or any(other.name in motors for other in body.joints)):
            wants = "wants its hinge at the origin of its own body"
            raise UserError(f"--tail fixed: [pose] {joint.name} = {angle} {wants}")
        if body.name not in turned:  # its orientation may be written in another way
            body.quat, body.alt.type = flat.body(body.name).quat, mujoco.mjtOrientation.mjORIENTATION_QUAT
            turned.add(body.name)
        turn, out = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, joint.axis / np.linalg.norm(joint.axis), angle)
        mujoco.mju_mulQuat(out, body.quat, turn)
        body.quat = out
        spec.delete(joint)


def resize(spec: mujoco.MjSpec, s, xml):
    """Sizes × s and masses × s³; MuJoCo computes the inertias, × s⁵, of the shapes.

    Test      tests/test_characters.py::test_scale"""
    if len(spec.tendons) or len(spec.equalities):
        raise UserError(f"{xml}: has tendons or equality constraints: --scale does not know how to scale them")
    geoms = [g for g in spec.geoms if g.parent.name != "world"]  # not the floor
    others = [i for i in (*spec.sites, *spec.joints, *spec.cameras, *spec.frames) if i.parent.name != "world"]
    for item in (*spec.bodies, *geoms, *others):
        item.pos = s * item.pos
    for geom in geoms:
        geom.size, geom.fromto, geom.mass = s * geom.size, s * geom.fromto, s**3 * geom.mass
    for site in spec.sites:
        site.size = s * site.size
    for mesh in spec.meshes:
        mesh.scale = s * mesh.scale
    for body in spec.bodies:
        if body.explicitinertial:
            body.ipos, body.mass = s * body.ipos, s**3 * body.mass
            body.inertia, body.fullinertia = s**5 * body.inertia, s**5 * body.fullinertia

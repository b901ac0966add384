"""MJCF as every character's must be, each rule broken in one line: a free joint, hinges about one axis, plain motors, a
floor."""

from __future__ import annotations

import warnings
from contextlib import contextmanager

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


def compiled(spec: mujoco.MjSpec, xml) -> mujoco.MjModel:
    """The model of an MJCF; no body has two hinges about one axis, and no size or mass is beyond any use."""
    for body in spec.bodies:
        axes = ["xyz"[np.argmax(np.abs(j.axis))] for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
        if len(set(axes)) < len(axes):
            text = f"body {body.name} has two hinges about one axis ({''.join(axes)}); valid: x, y and z once each"
            raise UserError(f"{xml}: {text}")
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
    kinds = mujoco.mjtJoint
    if m.njnt < 2 or m.jnt_type[0] != kinds.mjJNT_FREE or np.any(m.jnt_type[1:] != kinds.mjJNT_HINGE):
        raise UserError(f"{xml}: the first joint must be free and all others hinges")
    names = [mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_JOINT, k) for k in range(1, m.njnt)]
    if None in names:
        at = m.body(m.jnt_bodyid[1 + names.index(None)]).name
        raise UserError(f"{xml}: every hinge needs a name, such as hip_l_y; one of body {at!r} has none")
    slant = [n for n, axis in zip(names, m.jnt_axis[1:]) if not np.isclose(np.abs(axis).max(), 1.0)]
    if slant:
        rule = "every hinge must turn about one axis of its body's frame (x, y or z)"
        raise UserError(f"{xml}: {rule}; not so {', '.join(slant)}")
    limited = m.jnt_limited[1:].astype(bool)
    widest = np.abs(m.jnt_range[1:])[limited].max(initial=0.0)
    if limited.any() and widest < 0.1:
        raise UserError(f"{xml}: joint ranges look like degrees read as radians; set <compiler angle='radian'/>")
    if widest > 2 * np.pi:
        worst = names[np.abs(m.jnt_range[1:]).max(axis=1).argmax()]
        text = f"the range of hinge {worst} reaches {widest:.0f} rad: it looks like degrees; write radians"
        raise UserError(f"{xml}: {text}")
    return names, np.where(limited[:, None], m.jnt_range[1:], [-np.inf, np.inf])


def driven_of(m, xml) -> np.ndarray:
    """Hinge index of each motor of a model whose motors are plain: control -1 to 1 times a gear.

    Test      tests/test_characters.py::test_checks"""
    driven = m.actuator_trnid[:, 0] - 1
    if np.any(m.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT) or np.any(driven < 0) or len(set(driven)) < m.nu:
        raise UserError(f"{xml}: every actuator must be a motor on a hinge of its own")
    plain = (m.actuator_gaintype == 0) & (m.actuator_biastype == 0) & (m.actuator_gainprm[:, 0] == 1)
    if not plain.all() or np.any(m.actuator_ctrllimited & np.any(m.actuator_ctrlrange != [-1, 1], axis=1)):
        raise UserError(f'{xml}: every actuator must be a plain <motor>, its ctrlrange "-1 1"')
    return driven


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

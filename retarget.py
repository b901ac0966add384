r"""Characters, and human pose -> character pose  [Reda23 §3.2, §3.4, §3.7].

    NAME.xml + NAME.toml ──► Character       the model with its tables, each checked against the other
    Clip ──► retarget ──► qpos, qvel         joint map, default pose, scaled root
         └─► reference ──► Reference         everything the environment compares with, one row a control step

The kinematic pose slides, floats and sinks: it is a training signal, not a result.

    python retarget.py --character jesse --motion PATH [--png OUT | --video OUT | --bvh OUT]
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

import bvh
import mocap
from mocap import (
    SEG,
    SEGMENTS,
    Clip,
    angular_velocity,
    linear_velocity,
    quat_conj,
    quat_continuous,
    quat_matrix,
    quat_mul,
    quat_rotate,
)
from rigs import HELP, Reading
from runs import UserError, arg, cli, run_main

CHARACTERS = Path(__file__).resolve().parent / "characters"
TERMS = ("q", "qd", "x", "xd", "contact", "orientation", "action_diff", "action_min")  # Table 2's rows
STAGE_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)

# ------------------------------------------------------------------------------------ the character


@dataclass
class Character:
    """A MuJoCo model with the tables of its TOML resolved to indices and arrays.

    nq = 7 + j, nv = 6 + j for j hinges; u of them are driven (have a motor).  Hinge arrays are in model order.
    """

    name: str
    path: Path  # of the TOML
    model: mujoco.MjModel  # collision shapes only, gains of the TOML: what is simulated
    spec: dict  # the TOML
    hinges: list[str]
    ranges: np.ndarray  # (j, 2) rad; infinite where the hinge has no range
    default: np.ndarray  # (j,) rad, default pose
    limits: np.ndarray  # (u,) N m, base × Table 4
    driven: np.ndarray  # (u,) hinge index of each motor
    root: int  # body id
    head: int
    hip_height: float  # m, root above the soles in the default pose
    chains: list  # (body, hinge indices, axes, from, to, shares) in tree order
    mapped: np.ndarray  # (j,) bool, hinges that follow the human
    obs_links: np.ndarray  # body ids
    reward_links: np.ndarray  # body ids
    link_weights: np.ndarray  # normalised to sum 1 (Eq. 11)
    joint_weights: np.ndarray  # (j,) normalised to sum 1 (Eq. 11)
    reward: dict  # term -> (w, k), and "fail"
    feet: np.ndarray  # (2,) body ids
    sole_geoms: np.ndarray  # (2, g) collision geoms of each foot
    contact_adr: np.ndarray  # (2,) address of the normal force in sensordata
    sensor_sites: np.ndarray  # (3,)
    fall_geoms: np.ndarray  # (f,) collision geoms that must not touch the floor

    @property
    def j(self):
        return len(self.hinges)

    def batch(self, n: int, threads: int = 0) -> Batch:
        """n simulations of this character.

        MuJoCo's own thread pool steps them; results do not depend on the number of threads."""
        return Batch(self.model, n, threads, persistent=False)


def available() -> list[str]:
    """Names of the characters that can be loaded.  Test: tests/test_retarget.py::test_character_checks"""
    return sorted(p.stem for p in CHARACTERS.glob("*.toml"))


def character(name: str | Path, visual=False) -> Character:
    """Load characters/NAME.toml and its model, or a path to a TOML file; check both against each other.

    Args      visual : keep the shapes that are only looked at (they cost time in every step)
    Raises    UserError: names the file, what is missing or does not match, and what would have been valid
    Test      tests/test_retarget.py::test_character_tables, test_character_checks
    """
    path = Path(name) if str(name).endswith(".toml") else CHARACTERS / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(available())
        raise UserError(f"no character {str(name)!r}; there are: {known}; or give the path of a .toml file")
    try:
        spec = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise UserError(f"{path}: {e}") from None
    return _Loader(path, spec, visual).load()


class _Loader:
    """Resolves the TOML's names in the model; every complaint names the file, the table and what would be valid."""

    KEYS = dict(  # what each table may hold; None: names that are checked where they are used
        root=("body", "scale_xy", "scale_z"),
        map=None,
        torque=("base", "scale"),
        passive=("stiffness", "damping", "armature"),
        observation=("links",),
        reward=(*TERMS, "fail", "joints", "links"),
        feet=("bodies", "contact_sensors"),
        sensors=("sites",),
        fall=("bodies",),
        pose=None,
        metrics=("sip",),
    )
    TABLES = tuple(t for t in KEYS if t not in ("pose", "metrics"))  # those that must be there
    SHAPES = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)

    def __init__(self, path, spec, visual):
        self.path, self.spec = path, spec
        for table in self.TABLES:
            if not isinstance(spec.get(table), dict):
                self.fail(f"has no table [{table}]; needed: {', '.join(self.TABLES)}")
        for name, value in spec.items():
            if name not in (*self.KEYS, "name", "model"):
                self.fail(f"has {name!r}, which means nothing; valid: name, model, {', '.join(self.KEYS)}")
            for key in value if self.KEYS.get(name) else ():
                if key not in self.KEYS[name]:
                    self.fail(f"[{name}] has {key!r}, which means nothing; valid: {', '.join(self.KEYS[name])}")
        self.xml = path.parent / str(spec.get("model", path.stem + ".xml"))
        if not self.xml.is_file():
            found = ", ".join(sorted(p.name for p in path.parent.glob("*.xml"))) or "none"
            self.fail(f"model = {self.xml.name!r} is not a file beside it; .xml files there: {found}")
        try:
            mjspec = mujoco.MjSpec.from_file(str(self.xml))
            for geom in list(mjspec.geoms) if not visual else []:
                if geom.contype == 0 and geom.conaffinity == 0:
                    mjspec.delete(geom)
            self.model = mjspec.compile()
        except ValueError as e:
            self.fail_xml(" ".join(str(e).split()))

    def load(self) -> Character:
        m, spec = self.model, self.spec
        names, ranges = self.skeleton()
        default = self.default_pose(names)
        driven, limits = self.torques(names)
        self.passive(names, driven)
        chains, mapped = self.chains(names)
        root = self.root()
        feet, soles, contact_adr = self.feet()
        links = self.get("reward", "links", dict)
        link_weights = [self.number(f"[reward.links] {n}", w, 0) for n, w in links.items()]
        sites = self.ids("sensors", self.get("sensors", "sites", list), mujoco.mjtObj.mjOBJ_SITE, "site")
        if len(sites) != 3:
            self.fail(f"[sensors] needs three sites (head, left, right), found {len(sites)}")
        data = mujoco.MjData(m)
        data.qpos[7:] = default
        mujoco.mj_kinematics(m, data)
        lowest = geom_lowest(m, soles.ravel(), data.geom_xpos[None], data.geom_xmat[None]).min()
        return Character(
            name=str(spec.get("name", self.path.stem)),
            path=self.path,
            model=m,
            spec=spec,
            hinges=names,
            ranges=ranges,
            default=default,
            limits=limits,
            driven=driven,
            root=root,
            head=int(self.bodies("map", [self.body_for("head")])[0]),
            hip_height=float(data.xpos[root, 2] - lowest),
            chains=chains,
            mapped=mapped,
            obs_links=self.bodies("observation", self.get("observation", "links", list)),
            reward_links=self.bodies("reward.links", links),
            link_weights=normalised(link_weights),
            joint_weights=self.joint_weights(names, mapped),
            reward=self.rewards(),
            feet=feet,
            sole_geoms=soles,
            contact_adr=contact_adr,
            sensor_sites=sites,
            fall_geoms=self.collision_geoms("fall", self.get("fall", "bodies", list)),
        )

    # ---- complaints and look-ups

    def fail(self, text):
        raise UserError(f"{self.path}: {text}")

    def fail_xml(self, text):
        raise UserError(f"{self.xml}: {text}")

    def number(self, where, value, least=None):
        """`value` if it is a finite number (and at least `least`)."""
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not np.isfinite(value):
            self.fail(f"{where} = {value!r} is not a finite number")
        if least is not None and value < least:
            self.fail(f"{where} = {value!r} must be at least {least}")
        return value

    def get(self, table, key, kind):
        """spec[table][key], which must be a str, list, dict or float (any finite number)."""
        value = self.spec[table].get(key)
        if value is None:
            self.fail(f"[{table}] has no {key}; it has {', '.join(self.spec[table]) or 'nothing'}")
        if kind is float:
            return float(self.number(f"[{table}] {key}", value))
        if not isinstance(value, kind):
            self.fail(f"[{table}] {key} = {value!r} is not a {kind.__name__}")
        return value

    def ids(self, table, names, obj, what):
        count = {"body": self.model.nbody, "site": self.model.nsite, "sensor": self.model.nsensor}[what]
        out = []
        for n in names:
            i = mujoco.mj_name2id(self.model, obj, str(n))
            if i < 0:
                valid = ", ".join(filter(None, (mujoco.mj_id2name(self.model, obj, k) for k in range(count))))
                self.fail(f"[{table}] names {what} {n!r}, which {self.xml.name} lacks; it has {valid}")
            out.append(i)
        return np.array(out, dtype=int)

    def bodies(self, table, names):
        return self.ids(table, names, mujoco.mjtObj.mjOBJ_BODY, "body")

    def collision_geoms(self, table, names):
        """Ids of the bodies' geoms that the floor can touch; only shapes that `geom_lowest` knows."""
        m = self.model
        found = [np.flatnonzero((m.geom_bodyid == b) & (m.geom_conaffinity != 0)) for b in self.bodies(table, names)]
        geoms = np.concatenate(found) if found else np.zeros(0, int)
        if not len(geoms):
            self.fail(f"[{table}] bodies = {names!r} have no geom that the floor can touch (conaffinity 1)")
        if not np.isin(m.geom_type[geoms], [int(s) for s in self.SHAPES]).all():
            self.fail(f"[{table}] bodies = {names!r} have collision geoms of other types than sphere, capsule and box")
        return geoms

    # ---- the parts

    def skeleton(self):
        """Names and ranges of the hinges, and what the rest of this code takes for granted about the model."""
        m, kinds = self.model, mujoco.mjtJoint
        if m.njnt < 2 or m.jnt_type[0] != kinds.mjJNT_FREE or np.any(m.jnt_type[1:] != kinds.mjJNT_HINGE):
            self.fail_xml("the first joint must be free and all others hinges")
        if not np.allclose(np.abs(m.jnt_axis[1:]).max(axis=1), 1.0):
            self.fail_xml("every hinge must turn about one axis of its body's frame (x, y or z)")
        floors = (m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (m.geom_bodyid == 0) & (m.geom_pos[:, 2] == 0.0)
        if not floors.any():
            self.fail_xml("needs a floor: a geom of type plane at height 0 in the world body")
        names = [mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_JOINT, k) for k in range(1, m.njnt)]
        limited = m.jnt_limited[1:].astype(bool)
        widest = np.abs(m.jnt_range[1:])[limited].max(initial=0.0)
        if limited.any() and widest < 0.1:
            self.fail_xml("joint ranges look like degrees read as radians; set <compiler angle='radian'/>")
        if widest > 2 * np.pi:
            worst = names[np.abs(m.jnt_range[1:]).max(axis=1).argmax()]
            self.fail_xml(f"the range of hinge {worst} reaches {widest:.0f} rad: it looks like degrees; write radians")
        return names, np.where(limited[:, None], m.jnt_range[1:], [-np.inf, np.inf])

    def default_pose(self, names):
        """[pose]: angles of the default pose, where the passive springs pull to as well."""
        default, pose = np.zeros(len(names)), self.spec.get("pose", {})
        if not isinstance(pose, dict):
            self.fail(f"pose = {pose!r} is not a table of joint = angle")
        for joint, value in pose.items():
            if joint not in names:
                self.fail(f"[pose] names joint {joint!r}; valid: {', '.join(names)}")
            if abs(self.number(f"[pose] {joint}", value)) > 2 * np.pi:
                self.fail(f"[pose] {joint} = {value!r} looks like degrees; write radians")
            default[names.index(joint)] = value
        self.model.qpos_spring[7:] = default
        return default

    def root(self):
        m = self.model
        root, free = int(self.bodies("root", [self.get("root", "body", str)])[0]), int(m.jnt_bodyid[0])
        if root != free:
            self.fail(f"[root] body = {m.body(root).name!r} must be the body of the free joint, {m.body(free).name!r}")
        for key in ("scale_xy", "scale_z"):
            value = self.spec["root"].get(key, 1.0)
            if isinstance(value, str) and not (key == "scale_z" and value == "hip"):
                self.fail(f"[root] {key} = {value!r}; valid: a number" + (' or "hip"' if key == "scale_z" else ""))
            if value != "hip" and self.number(f"[root] {key}", value) <= 0:
                self.fail(f"[root] {key} = {value!r} must be greater than 0")
        return root

    def feet(self):
        """Body ids (2,), sole geoms (2, g), addresses of the normal forces (2,)."""
        m, names = self.model, self.get("feet", "bodies", list)
        feet = self.bodies("feet", names)
        contact = self.ids("feet", self.get("feet", "contact_sensors", list), mujoco.mjtObj.mjOBJ_SENSOR, "sensor")
        if len(feet) != 2 or len(contact) != 2:
            found = f"{len(feet)} and {len(contact)}"
            self.fail(f"[feet] needs two bodies and two contact_sensors (left, right), found {found}")
        soles = [self.collision_geoms("feet", [n]) for n in names]
        if len(soles[0]) != len(soles[1]):
            self.fail(f"[feet] bodies need as many collision geoms each, found {len(soles[0])} and {len(soles[1])}")
        # A sensor of one number is the normal force; of a vector, world axes, its last number (z) is.
        return feet, np.stack(soles), m.sensor_adr[contact] + (m.sensor_dim[contact] - 1)

    def by_group(self, table, key, groups):
        """A table of numbers by joint group ("spine1", or "spine" for all of spine0, spine1, …), names checked."""
        values = {g.lower(): self.number(f"[{table}.{key}] {g}", v, 0) for g, v in self.get(table, key, dict).items()}
        valid = groups | {g.rstrip("0123456789") for g in groups} | {"default"}
        for g in values:
            if g not in valid:
                self.fail(f"[{table}.{key}] names {g!r}; the model's driven joints are {', '.join(sorted(groups))}")
        return lambda g: values.get(g, values.get(g.rstrip("0123456789"), values.get("default")))

    def torques(self, names):
        """Hinge and limit of each motor: base by joint group times Table 4's scale; written into the motors' gear."""
        m = self.model
        driven = m.actuator_trnid[:, 0] - 1
        if np.any(m.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT) or np.any(driven < 0) or len(set(driven)) < m.nu:
            self.fail_xml("every actuator must be a motor on a hinge of its own")
        groups = {joint_group(names[h]) for h in driven}
        base, scale = (self.by_group("torque", key, groups) for key in ("base", "scale"))
        limits = np.zeros(len(driven))
        for k, h in enumerate(driven):
            g = joint_group(names[h])
            if not base(g):
                valid = ", ".join(sorted(groups))
                self.fail(f"[torque.base] has no positive value for {g} (nor a default); driven joints: {valid}")
            limits[k] = base(g) * (1.0 if scale(g) is None else scale(g))
        m.actuator_gear[:, 0] = limits
        return driven, limits

    def passive(self, names, driven):
        """Spring, damper (a multiple of the spring) and armature of every driven hinge.

        Hinges without a motor (tails, ears) keep what the MJCF gives them."""
        m = self.model
        damping = self.number("[passive] damping", self.get("passive", "damping", float), 0)
        groups = {joint_group(names[h]) for h in driven}
        stiffness, armature = (self.by_group("passive", key, groups) for key in ("stiffness", "armature"))
        for h in driven:
            g = joint_group(names[h])
            for key, value in (("stiffness", stiffness(g)), ("armature", armature(g))):
                if value is None:
                    self.fail(f"[passive.{key}] has no entry for {g}")
            m.jnt_stiffness[1 + h], m.dof_damping[6 + h] = stiffness(g), damping * stiffness(g)
            m.dof_armature[6 + h] = armature(g)
        # MuJoCo scales the softness of contacts and limits by inverse inertias it computed without this armature: again
        mujoco.mj_setConst(m, mujoco.MjData(m))

    def body_for(self, segment):
        """The last body of the map that follows a human segment."""
        found = [b for b, e in self.spec["map"].items() if e["to"] == segment]
        if not found:
            self.fail(f"[map] has no body that follows the human's {segment}")
        return found[-1]

    def chains(self, names):
        """The joint map in tree order: (body, hinges, axes, from, to, shares)."""
        m, out = self.model, []
        mapped = np.zeros(len(names), bool)
        order = sorted(self.spec["map"], key=lambda b: self.bodies("map", [b])[0])
        for body in order:
            entry = self.spec["map"][body]
            keys = {"from", "to", "x", "y", "z"}
            if not isinstance(entry, dict) or {"from", "to"} - set(entry) or set(entry) - keys:
                self.fail(f'[map] {body} must be {{ from = "…", to = "…" }} with optional x, y, z; found {entry!r}')
            for key in ("from", "to"):
                if entry[key] not in SEGMENTS:
                    self.fail(f"[map] {body}.{key} = {entry[key]!r}; valid human segments: {', '.join(SEGMENTS)}")
            b = int(self.bodies("map", [body])[0])
            hinges = np.arange(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]) - 1
            if b == m.jnt_bodyid[0] or not len(hinges):
                self.fail(f"[map] body {body} has no hinge in {self.xml.name}")
            axes = "".join("xyz"[np.argmax(np.abs(m.jnt_axis[1 + h]))] for h in hinges)
            if len(set(axes)) != len(axes):
                self.fail_xml(f"body {body} has two hinges about one axis ({axes})")
            shares = {a: self.number(f"[map] {body}.{a}", entry[a]) for a in "xyz" if a in entry}
            if set(shares) - set(axes):
                extra = ", ".join(sorted(set(shares) - set(axes)))
                self.fail(f"[map] {body} shares {extra}, but its hinges turn about {', '.join(axes)}")
            out.append((b, hinges, axes, SEG[entry["from"]], SEG[entry["to"]], shares))
            mapped[hinges] = True
        return out, mapped

    def joint_weights(self, names, mapped):
        table = self.spec["reward"].get("joints", {})
        if not isinstance(table, dict):
            self.fail(f"[reward] joints = {table!r} is not a table of joint = weight")
        groups = {joint_group(n) for n in names}
        for g, w in table.items():
            if g != "default" and g not in groups and g not in names:
                self.fail(f"[reward.joints] names {g!r}; valid: default, {', '.join(sorted(groups))}, or a joint")
            self.number(f"[reward.joints] {g}", w, 0)
        # what has no human motion is not imitated (§3.5.1)
        w = [table.get(n, table.get(joint_group(n), table.get("default", 1.0))) for n in names]
        return normalised(np.where(mapped, w, 0.0))

    def rewards(self):
        """Table 2: term -> (w, k), and "fail"."""
        valid = (*TERMS, "fail", "joints", "links")
        for key in self.spec["reward"]:
            if key not in valid:
                self.fail(f"[reward] names {key!r}; valid: {', '.join(valid)}")
        out = {"fail": self.get("reward", "fail", float)}
        for term in TERMS:
            pair = self.get("reward", term, list)
            if len(pair) != 2:
                self.fail(f"[reward] {term} = {pair!r} must be [w, k], both at least 0")
            out[term] = tuple(float(self.number(f"[reward] {term} [w, k] {v!r}", v, 0)) for v in pair)
        return out


def joint_group(name: str) -> str:
    """hip_l_y -> hip, spine0_y -> spine0: the name Table 4 uses, in lower case.

    Test      tests/test_retarget.py::test_character_tables"""
    return name.split("_")[0]


def normalised(w):
    """Eq. 11's weights made to sum to 1, so that d is a mean.  ASSUMED: the one place where that is decided.
    With the plain sum over 33 joints and k_q = 25, 0.1 rad everywhere would give e^-8 and no gradient; the mean
    gives e^-0.25.

    Test      tests/test_retarget.py::test_character_tables"""
    w = np.asarray(w, dtype=float)
    return w / w.sum() if w.sum() > 0 else w


# ------------------------------------------------------------------------------------ geometry on the model


def geom_lowest(model, geoms, xpos, xmat):
    r"""Height of the lowest point of spheres, capsules and boxes.

    Equation  capsule: z − |a_z| h − r with axis a; box: z − Σ_i |R_zi| s_i
    Args      geoms : (g,) ids; xpos (N, ngeom, 3); xmat (N, ngeom, 9)
    Returns   (N, g) [m]
    Test      tests/test_retarget.py::test_geom_lowest
    """
    kind, size = model.geom_type[geoms], model.geom_size[geoms]
    row = np.abs(xmat[:, geoms, 6:9])  # third row of R: heights of the geom's axes
    extent = np.where(kind == mujoco.mjtGeom.mjGEOM_SPHERE, size[:, 0], 0.0)
    extent = extent + np.where(kind == mujoco.mjtGeom.mjGEOM_CAPSULE, size[:, 0] + row[..., 2] * size[:, 1], 0.0)
    extent = extent + np.where(kind == mujoco.mjtGeom.mjGEOM_BOX, (row * size).sum(-1), 0.0)
    return xpos[:, geoms, 2] - extent


def body_velocity(cvel, xpos, com):
    r"""Linear velocity of body origins from MuJoCo's centre-of-mass based spatial velocities.

    Equation  ẋ = v_c + ω × (x − c), c the subtree centre of mass of the kinematic tree's root
    Args      cvel (N, l, 6) as (ω, v_c); xpos (N, l, 3); com (N, 3)
    Returns   (N, l, 3) [m/s], world
    Test      tests/test_retarget.py::test_body_velocity
    """
    w, r = cvel[..., :3], xpos - com[:, None]
    v = cvel[..., 3:].copy()
    v[..., 0] += w[..., 1] * r[..., 2] - w[..., 2] * r[..., 1]
    v[..., 1] += w[..., 2] * r[..., 0] - w[..., 0] * r[..., 2]
    v[..., 2] += w[..., 0] * r[..., 1] - w[..., 1] * r[..., 0]
    return v


@dataclass
class Kinematics:
    """Forward kinematics of T poses: what MuJoCo computes of them.  All world frame."""

    xpos: np.ndarray  # (T, nbody, 3)
    xquat: np.ndarray  # (T, nbody, 4)
    velocity: np.ndarray  # (T, nbody, 3) of body origins
    site_xpos: np.ndarray  # (T, 3, 3) headset, controllers
    soles: np.ndarray  # (T, 2, p, 3) end points of the feet's collision shapes, lowered by their radius
    lowest: np.ndarray  # (T,) height of the lowest point of all collision shapes


def forward_kinematics(char: Character, qpos, qvel=None, chunk=1024) -> Kinematics:
    """Poses -> positions, rotations, velocities, through MuJoCo.

    Args      qpos (T, nq); qvel (T, nv) or None for rest
    Test      tests/test_retarget.py::test_forward_kinematics
    """
    m = char.model
    qpos = np.atleast_2d(qpos)
    n = min(chunk, len(qpos))
    b = char.batch(n)
    names = ("qpos", "qvel", "xpos", "xquat", "cvel", "subtree_com", "site_xpos", "geom_xpos", "geom_xmat")
    live = {k: b.bind(k) for k in names}
    parts = []
    for start in range(0, len(qpos), n):
        stop = min(start + n, len(qpos))
        k = stop - start
        live["qpos"][:k] = qpos[start:stop]
        live["qvel"][:k] = 0.0 if qvel is None else qvel[start:stop]
        b.forward(np.arange(k), STAGE_VEL)
        gx, gm = live["geom_xpos"][:k], live["geom_xmat"][:k]
        parts.append((
            live["xpos"][:k].copy(),
            live["xquat"][:k].copy(),
            body_velocity(live["cvel"][:k], live["xpos"][:k], live["subtree_com"][:k, char.root]),
            live["site_xpos"][:k, char.sensor_sites],
            sole_points(char, gx, gm),
            geom_lowest(m, np.flatnonzero(m.geom_conaffinity), gx, gm).min(1),
        ))  # fmt: skip
    return Kinematics(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def sole_points(char: Character, xpos, xmat):
    """Where the feet can touch the floor: ends of capsules and centres of spheres, lowered by the radius; box corners.

    Args      xpos (T, ngeom, 3); xmat (T, ngeom, 9), world
    Returns   (T, 2, p, 3) [m], world
    Test      tests/test_retarget.py::test_sole_points
    """
    m, feet = char.model, []
    for foot in char.sole_geoms:
        points = []
        for g in foot:
            r = xmat[:, g].reshape(-1, 3, 3)
            radius, half = m.geom_size[g, 0], m.geom_size[g, 1]
            if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
                signs = np.array([[sx, sy, sz] for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)])
                points += [xpos[:, g] + r @ c for c in signs * m.geom_size[g]]
            else:
                ends = (-half, half) if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE else (0.0,)
                points += [xpos[:, g] + r[:, :, 2] * h - [0.0, 0.0, radius] for h in ends]
        feet.append(np.stack(points, axis=1))
    return np.stack(feet, axis=1)


# ------------------------------------------------------------------------------------ human pose -> character pose


def root_scale(char: Character, clip: Clip) -> np.ndarray:
    """Scale (s_xy, s_xy, s_z) of root and sensor positions  [Reda23 §3.4].

    ASSUMED   travel is not scaled (Fig. 5), height is scaled by the ratio of hip heights.
    Test      tests/test_retarget.py::test_root_scale
    """
    xy, z = char.spec["root"].get("scale_xy", 1.0), char.spec["root"].get("scale_z", "hip")
    z = char.hip_height / clip.hip_height if z == "hip" else z
    return np.array([xy, xy, z])


def euler_angles(q, axes: str):
    r"""Angles of intrinsic turns about `axes` (1 to 3 letters) that make the rotation q.

    Equation  q = q_{a1}(α1) q_{a2}(α2) q_{a3}(α3); with fewer than three hinges the turns about the missing axes,
              ordered last, are dropped: what the character cannot do (ASSUMED: not the nearest reachable rotation)
    Args      q (T, 4); axes : letters of "xyz", none twice
    Returns   (T, len(axes)) [rad], unwrapped in time
    Test      tests/test_retarget.py::test_euler_angles
    """
    seq = axes + "".join(a for a in "yxz" if a not in axes)
    angles = Rotation.from_quat(q, scalar_first=True).as_euler(seq.upper())
    # Two triples make one rotation; take the one with the smaller angles: an arm raised sideways by 150 degrees is
    # (0, 150, 0), not (180, 30, 180).
    other = angles + np.array([np.pi, 0.0, np.pi])
    other[:, 1] = np.pi - angles[:, 1]
    wrap = lambda a: (a + np.pi) % (2 * np.pi) - np.pi  # noqa: E731
    other = wrap(other)
    far = np.abs(other).sum(1) < np.abs(angles).sum(1) - 1e-9
    angles = np.where(far[:, None], other, angles)
    return np.unwrap(angles, axis=0)[:, : len(axes)]


@dataclass
class Pose:
    """Retargeted motion: qpos (T, nq), qvel (T, nv), clipped (T, j) bool: hinge would have left its range."""

    qpos: np.ndarray
    qvel: np.ndarray
    clipped: np.ndarray


def retarget(char: Character, clip: Clip) -> Pose:
    r"""Kinematic retargeting  [Reda23 §3.4].

    Method    root: the human pelvis, position scaled by `root_scale`, orientation as it is.  Hinges: the human's
              rotation of one segment relative to another, shared out along the character's chain as the TOML says;
              the last body of a chain takes the rest, so that chest, head, arms and legs have the human's relative
              rotation exactly (as far as their hinges allow).  Hinges without a counterpart keep the default pose.
              Angles are clipped to the joint ranges.
    Frame     qpos: world, quaternion w, x, y, z; qvel: root linear velocity in the world's frame, root angular
              velocity in the root's, as MuJoCo has them
    Test      tests/test_retarget.py::test_retarget_reproduces_segments
    """
    n = len(clip)
    q = np.tile(char.default, (n, 1))
    chains = {}  # (from, to) -> what the chain's bodies have turned so far
    for _, hinges, axes, a, b, shares in char.chains:
        turn = quat_mul(quat_conj(clip.quat[:, a]), clip.quat[:, b])
        done = chains.get((a, b), np.tile([1.0, 0, 0, 0], (n, 1)))
        if shares:
            full = dict(zip("yxz", euler_angles(turn, "yxz").T, strict=True))
            angles = np.stack([shares.get(axis, 0.0) * full[axis] for axis in axes], axis=1)
        else:
            angles = euler_angles(quat_mul(quat_conj(done), turn), axes)
        for k, axis in enumerate(axes):
            done = quat_mul(done, mocap.quat_about("xyz".index(axis), angles[:, k]))
        chains[a, b] = done
        sign = char.model.jnt_axis[1 + hinges][np.arange(len(hinges)), ["xyz".index(x) for x in axes]]
        q[:, hinges] += angles * sign
    inside = np.clip(q, char.ranges[:, 0], char.ranges[:, 1])
    root_pos = clip.pos[:, 0] * root_scale(char, clip)
    root_quat = quat_continuous(clip.quat[:, 0])
    qpos = np.concatenate([root_pos, root_quat, inside], axis=1)
    spin = quat_rotate(quat_conj(root_quat), angular_velocity(root_quat, clip.rate))
    qvel = np.concatenate([linear_velocity(root_pos, clip.rate), spin, linear_velocity(inside, clip.rate)], axis=1)
    return Pose(qpos, qvel, np.abs(inside - q) > 1e-9)


@dataclass
class Reference:
    """All that the environment compares with, for F frames of one or more sequences laid end to end.

    first, last : (S,) frame indices of each sequence
    World frame; positions of the human already mapped by `root_scale`; matrices as their first two columns
    (F, ., 3, 2).
    """

    names: list
    rate: float  # Hz, of every sequence
    first: np.ndarray
    last: np.ndarray
    qpos: np.ndarray  # (F, nq) float64
    qvel: np.ndarray  # (F, nv) float64
    link_pos: np.ndarray  # (F, l, 3) float32, reward links
    link_vel: np.ndarray  # (F, l, 3) float32
    orientation: np.ndarray  # (F, 2, 4) float64, human root and head
    contact: np.ndarray  # (F, 2) bool, human feet
    sensor_pos: np.ndarray  # (F, 3, 3) float64
    sensor_rot: np.ndarray  # (F, 3, 3, 2) float32
    sensor_quat: np.ndarray  # (F, 3, 4) float64
    human_pos: np.ndarray  # (F, 15, 3) float32
    scale: np.ndarray  # (F, 3) float32, by which the human's positions were multiplied
    human_rot: np.ndarray  # (F, 15, 3, 2) float32

    def __len__(self):
        return len(self.qpos)


def reference(char: Character, clips: list[Clip]) -> Reference:
    """Retarget sequences and lay them end to end.

    Raises    ValueError: no clips, or clips of different rates
    Test      tests/test_retarget.py::test_reference
    """
    rates = {c.rate for c in clips}
    if len(rates) != 1:
        raise ValueError(f"expected clips of one rate, got {len(clips)} clips with the rates {sorted(rates)}")
    rows = [_reference_of(char, c) for c in clips]
    lengths = np.array([len(c) for c in clips])
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    joined = {k: np.concatenate([r[k] for r in rows]) for k in rows[0]}
    return Reference([c.name for c in clips], rates.pop(), first, first + lengths - 1, **joined)


def _reference_of(char, clip):
    pose = retarget(char, clip)
    fk = forward_kinematics(char, pose.qpos, pose.qvel)
    scale = root_scale(char, clip)
    sensor_pos, sensor_quat = mocap.sensors(clip)
    f32 = np.float32
    return dict(
        qpos=pose.qpos,
        qvel=pose.qvel,
        link_pos=fk.xpos[:, char.reward_links].astype(f32),
        link_vel=fk.velocity[:, char.reward_links].astype(f32),
        orientation=clip.quat[:, [SEG["pelvis"], SEG["head"]]],
        contact=mocap.contacts(clip),
        sensor_pos=sensor_pos * scale,
        sensor_rot=quat_matrix(sensor_quat)[..., :2].astype(f32),
        sensor_quat=sensor_quat,
        human_pos=(clip.pos * scale).astype(f32),
        scale=np.tile(scale, (len(clip), 1)).astype(f32),
        human_rot=quat_matrix(clip.quat)[..., :2].astype(f32),
    )


# ------------------------------------------------------------------------------------ artefacts


def sole_motion(soles, rate):
    r"""Lowest point of each sole: its height, and the horizontal speed of that material point.

    Args      soles (T, 2, p, 3) [m]
    Returns   height (T, 2) [m], speed (T, 2) [m/s]
    Test      tests/test_retarget.py::test_sole_motion
    """
    low = np.argmin(soles[..., 2], axis=2)[..., None]
    height = np.take_along_axis(soles[..., 2], low, axis=2)[..., 0]
    speed = np.linalg.norm(linear_velocity(soles[..., :2], rate), axis=-1)
    return height, np.take_along_axis(speed, low, axis=2)[..., 0]


def artefacts(char: Character, clip: Clip, pose: Pose) -> dict:
    """What the kinematic pose does wrong and the policy must repair.

    Returns   limit_share : share of (frame, hinge) clipped; limits : hinge -> share, worst first;
              slide_cm_s : mean speed of the sole while the human's foot is in contact;
              penetration_mm : mean depth of the lower sole over the frames where it is below the floor, and
              below_share : their share; float_mm : mean height of the sole while the human's foot is in contact
    Test      tests/test_retarget.py::test_artefacts
    """
    height, speed = sole_motion(forward_kinematics(char, pose.qpos).soles, clip.rate)
    contact = mocap.contacts(clip)
    lowest = height.min(axis=1)
    share = pose.clipped.mean(axis=0)
    worst = sorted(zip(char.hinges, share, strict=True), key=lambda x: -x[1])
    return dict(
        limit_share=float(pose.clipped.mean()),
        limits={h: float(s) for h, s in worst if s > 0},
        slide_cm_s=float(100 * speed[contact].mean()) if contact.any() else float("nan"),
        penetration_mm=float(-1000 * lowest[lowest < 0].mean()) if (lowest < 0).any() else 0.0,
        below_share=float((lowest < 0).mean()),
        float_mm=float(1000 * height[contact].mean()) if contact.any() else float("nan"),
    )


# ------------------------------------------------------------------------------------ export


def write_bvh(path, char: Character, qpos, rate) -> None:
    r"""A character's motion as BVH: a joint for each of its bodies.

    Method    rotation of a body in its parent, all its hinges in one; the root also moves.  OFFSETs are those of the
              bodies' origins; an End Site lies as far beyond its body's centre of mass as that from the origin
    Frame     y up, z forward, x left, centimetres, as animation tools expect: (x, y, z) of ours is (z, x, y)
    Args      qpos (T, nq); rate [Hz]
    Raises    UserError: the file cannot be written, or a body's origin moves in its parent (a hinge beside it)
    Test      tests/test_retarget.py::test_bvh_round_trip, ::test_bvh_in_another_library
    """
    m, fk = char.model, forward_kinematics(char, qpos)
    bodies = [b for b in range(1, m.nbody) if m.body_rootid[b] == char.root]
    parents = np.array([bodies.index(m.body_parentid[b]) if b != char.root else -1 for b in bodies])
    to_file = lambda v: np.roll(v, -1, axis=-1)  # noqa: E731  (x, y, z) -> (y, z, x): left, up, forward
    local, offsets = fk.xquat[:, bodies], np.zeros((len(bodies), 3))
    for k, (b, p) in enumerate(zip(bodies, m.body_parentid[bodies])):
        if b != char.root:
            back = quat_conj(fk.xquat[:, p])
            local[:, k] = quat_mul(back, fk.xquat[:, b])
            offset = quat_rotate(back, fk.xpos[:, b] - fk.xpos[:, p])
            offsets[k] = offset.mean(axis=0)
            if np.abs(offset - offsets[k]).max() > 1e-6:
                raise UserError(
                    f"{path}: a hinge of {m.body(b).name} lies beside the body's origin: BVH has no such joint"
                )
    local = np.concatenate([local[..., :1], to_file(local[..., 1:])], axis=-1)
    names = [m.body(b).name or f"body{b}" for b in bodies]
    leaves = {n: 200.0 * to_file(m.body_ipos[b]) for n, b in zip(names, bodies) if b not in m.body_parentid[bodies]}
    root, offsets = 100.0 * to_file(fk.xpos[:, char.root]), 100.0 * to_file(offsets)
    try:
        bvh.write(path, names, parents, offsets, 1.0 / rate, root, local, leaves)
    except OSError as e:
        raise UserError(f"cannot write {path}: {e.strerror or e}; give a folder that exists and is writable") from None
    except bvh.BvhError as e:
        raise UserError(str(e)) from None


# ------------------------------------------------------------------------------------ command line


@dataclass
class Options:
    """What `python retarget.py` can be told."""

    character: str = arg("jesse", "name in characters/, or path of a .toml")
    motion: str = arg("builtin", "builtin, a .bvh or .amc file, or a folder of them")
    clips: str = arg("*", "shell pattern on clip names")
    joint_map: str | None = arg(None, HELP["joint_map"])
    unit: str | None = arg(None, HELP["unit"])
    up: str | None = arg(None, HELP["up"])
    png: str | None = arg(None, "write a contact sheet of the first clip, human and character side by side")
    video: str | None = arg(None, "write a video of the first clip (.mp4; needs the extra `view`)")
    bvh: str | None = arg(None, "write the character's kinematic pose in the first clip as BVH")


def draw(char: Character, clip: Clip, pose: Pose, frames, size=(480, 360)):
    """Images with the human (stick figure) and the character side by side, 1 m apart.  -> list of (H, W, 3) uint8

    Test      tests/test_retarget.py::test_draw"""
    import render

    shown = character(char.path, visual=True)
    scene = render.Scene(shown.model, *size)
    data = mujoco.MjData(shown.model)
    images = []
    for t in frames:
        data.qpos[:] = pose.qpos[t]
        mujoco.mj_forward(shown.model, data)
        left = quat_rotate(clip.quat[t, 0], np.array([0.0, 1.0, 0.0])) * [1, 1, 0]
        side = left / max(np.linalg.norm(left), 1e-9)
        points = np.concatenate([clip.pos[t], clip.ball[t]]) + side
        bones = list(mocap.PARENTS) + list(mocap.FEET)
        images.append(scene.frame(data, markers=render.stick_figure(points, bones)))
    return images


def main(argv=None):
    """Print the artefacts of every clip's kinematic pose; draw the first one.

    Test      tests/test_retarget.py::test_command_line"""
    opt = cli(Options, argv, "retarget.py", __doc__)
    char = character(opt.character)
    clips = mocap.load(opt.motion, clips=opt.clips, reading=Reading.of(opt))
    print(
        f"{char.name}: hips {char.hip_height:.3f} m, {char.j} hinges, {len(char.limits)} driven, "
        f"{char.model.body_subtreemass[0]:.1f} kg"
    )
    rows = []
    for clip in clips:
        pose = retarget(char, clip)
        a = artefacts(char, clip, pose)
        rows.append(a)
        limits = ", ".join(f"{h} {100 * s:.0f} %" for h, s in list(a["limits"].items())[:3]) or "none"
        print(
            f"{clip.name:36s} {clip.seconds:6.1f} s  slide {a['slide_cm_s']:5.1f} cm/s  "
            f"below floor {100 * a['below_share']:3.0f} % by {a['penetration_mm']:4.1f} mm  "
            f"sole in contact {a['float_mm']:5.1f} mm up  limits hit: {limits}"
        )
    if len(rows) > 1:
        mean = {k: np.nanmean([r[k] for r in rows]) for k in rows[0] if k != "limits"}
        print(
            f"mean of {len(rows)}: slide {mean['slide_cm_s']:.1f} cm/s, "
            f"below floor {100 * mean['below_share']:.0f} % of frames by {mean['penetration_mm']:.1f} mm, "
            f"sole in contact {mean['float_mm']:.1f} mm up, "
            f"limits hit {100 * mean['limit_share']:.2f} % of hinge frames"
        )
    clip, pose = clips[0], retarget(char, clips[0])
    if opt.bvh:
        write_bvh(opt.bvh, char, pose.qpos, clip.rate)
        print(opt.bvh)
    if opt.png or opt.video:
        import render

        if opt.png:
            frames = np.linspace(0, len(clip) - 1, 12).astype(int)
            labels = [f"{t / clip.rate:.1f} s" for t in frames]
            render.write_png(opt.png, render.contact_sheet(draw(char, clip, pose, frames), labels, 4))
            print(opt.png)
        if opt.video:
            render.write_video(opt.video, draw(char, clip, pose, range(len(clip))), clip.rate)
            print(opt.video)


if __name__ == "__main__":
    run_main(main)

r"""Characters: a MuJoCo model and the paper's tables for it, as arrays  [Reda23 §3.2, §3.7, App. A, App. D].

    NAME.xml + NAME.toml ──► load ──► Character
         └─► tail, scale, set: the variations of §4 and §5, made while loading

`retarget` uses the joint map and `env` the reward's tables.  `characters/README.md` says how to bring a character,
`python -m characters.check NAME` what is wrong with one.
"""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from human import SEG
from plumbing import mjcf, toml
from plumbing.cli import POSITIVE, UserError, arg
from plumbing.files import read_toml
from plumbing.toml import Each, at, at_least_0, count, number, number_or, one_of, positive, share, switch

CHARACTERS = Path(__file__).resolve().parent / "characters"
TERMS = ("q", "qd", "x", "xd", "contact", "orientation", "action_diff", "action_min")  # Table 2's rows
TAILS = ("active", "fixed", "passive")  # [Reda23 §5.1, Fig. 8]
SOLVERS = {  # ASSUMED: of contacts, with iterations at most: MuJoCo's exact one; a faster one under which feet creep
    "newton": (mujoco.mjtSolver.mjSOL_NEWTON, 100),
    "pgs": (mujoco.mjtSolver.mjSOL_PGS, 5),
}


@dataclass
class Character:
    """A MuJoCo model with the tables of its TOML resolved to indices and arrays.

    nq = 7 + j, nv = 6 + j for j hinges; u of them are driven (have a motor).  Hinge arrays are in model order.
    """

    name: str
    path: Path  # of the TOML
    xml: Path
    variant: dict  # what was changed while loading: tail, scale, set; empty if nothing was
    model: mujoco.MjModel  # collision shapes only, gains of the TOML: what is simulated
    spec: dict  # the TOML, with the changes
    hinges: list[str]
    ranges: np.ndarray  # (j, 2) rad; infinite where the hinge has no range
    default: np.ndarray  # (j,) rad, default pose
    rest: np.ndarray  # (nbody, 4) orientation of each body in the default pose, standing and facing x
    limits: np.ndarray  # (u,) N m, base × Table 4
    driven: np.ndarray  # (u,) hinge index of each motor
    root: int  # body id
    head: int
    hip_height: float  # m, root above the soles in the default pose
    chains: list  # of `Follower`, in tree order
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
    training: dict  # the recipe to train it with (ours), where the TOML says one: TRAINING's keys

    @property
    def j(self):
        return len(self.hinges)

    def solved_by(self, solver: str) -> Character:
        """The same character, its contacts solved from now on by one of SOLVERS; as loaded, by what its MJCF says.

        Why       training can bear feet that creep by half a centimetre a second more, for physics a fifth cheaper
        Test      tests/test_characters.py::test_solvers"""
        self.model.opt.solver, self.model.opt.iterations = SOLVERS[solver]
        return self

    def batch(self, n: int, threads: int = 0) -> Batch:
        """n simulations of this character.

        MuJoCo's own thread pool steps them; results do not depend on the number of threads."""
        return Batch(self.model, n, threads, persistent=False)

    def mjspec(self) -> mujoco.MjSpec:
        """The character to look at: with its visual shapes and its variations, before compiling; a new one each time.

        Test      tests/test_characters.py::test_shapes_to_look_at_change_nothing"""
        return varied(self, mjcf.read_mjcf(self.xml), self.spec.get("pose", {}))

    @property
    def upright(self):
        """The default pose at the origin, looking along x, the soles on the floor.  qpos (nq,)

        Test      tests/test_characters.py::test_upright"""
        return np.concatenate([[0.0, 0.0, self.hip_height], self.rest[self.root], self.default])

    @property
    def height(self):
        """Top of the collision shapes above the soles in the default pose [m]."""
        m, data = self.model, mujoco.MjData(self.model)
        data.qpos[:] = self.upright
        mujoco.mj_kinematics(m, data)
        geoms = np.flatnonzero(m.geom_conaffinity)
        middle = data.geom_xpos[geoms, 2]  # the shapes are symmetric: the top is as far above as the lowest point below
        return float((2 * middle - geom_lowest(m, geoms, data.geom_xpos[None], data.geom_xmat[None])[0]).max())


@dataclass
class Switches:
    """The flags of every command that loads one character: which, and the variations of §4 and §5."""

    character: str = arg("jesse", "name in characters/, or path of a .toml")
    tail: str | None = arg(
        None,
        "tail [§5.1]: active (as the MJCF drives it), fixed (joints without a motor welded), passive (without motors)",
        choices=TAILS,
    )
    scale: float | None = arg(
        None, "size of the character [Fig. 5], 1: masses by its cube, torques by its fourth power", check=POSITIVE
    )
    set: str | None = arg(
        None, "entries of the TOML to change, as in 'reward.contact=[0, 1]; pose.spine_y=0.3'", metavar="T.K=V;…"
    )

    def load(self) -> Character:
        """The character that the flags describe.  Test: tests/test_characters.py::test_switches"""
        return load(self.character, self.tail, self.scale or 1.0, tuple(filter(str.strip, (self.set or "").split(";"))))


def available() -> list[str]:
    """Names of the characters that can be loaded.  Test: tests/test_characters.py::test_unknown_character"""
    return sorted(p.stem for p in CHARACTERS.glob("*.toml"))


def load(name: str | Path, tail: str | None = None, scale: float = 1.0, set=()) -> Character:
    r"""Load characters/NAME.toml and its model, or a path to a TOML file; check both against each other.

    Args      tail : what becomes of the hinges called tail…  [§5.1, Fig. 8]: "active" leaves them as the MJCF has them;
                  "fixed" welds those without a motor in the default pose; "passive" takes the motors away, the springs
                  stay
              scale : S, sizes × S [Fig. 5].  ASSUMED, gravity being the same: masses × S³, inertias and armature × S⁵;
                  torques and springs × S⁴, as the moment of a weight, m g l, so that an action holds the same pose at
                  every size; dampers × S⁴·⁵, as a pendulum's time is √S
              set : entries of the TOML to change, ("reward.contact=[0, 1]", …), the value written as in TOML
    Raises    UserError: the first fault: the file, the table, the entry, and what would have been valid
    Test      tests/test_characters.py::test_tables, ::test_checks, ::test_tail, ::test_scale, ::test_set
    """
    variant = {"tail": tail} if tail else {}
    variant |= {"scale": float(scale)} if scale != 1 else {}
    variant |= {"set": [s.strip() for s in set]} if set else {}
    c = SimpleNamespace(path=toml_of(name), variant=variant, size=variant.get("scale", 1.0))
    for part in PARTS:
        part(c)
    return Character(**{f.name: getattr(c, f.name) for f in fields(Character)})


def toml_of(name) -> Path:
    """The TOML of a name, or the path that is one.  Test: tests/test_characters.py::test_unknown_character"""
    path = Path(name) if str(name).endswith(".toml") else CHARACTERS / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(available())
        what = f"no file {path}" if str(name).endswith(".toml") else f"no character {str(name)!r}"
        raise UserError(f"{what}; there are: {known}; or give the path of a .toml file")
    return path


def fault(c, text) -> UserError:
    """What is wrong with the TOML, as changed by `set`."""
    changes = f" with {'; '.join(c.variant['set'])}" if c.variant.get("set") else ""
    return UserError(f"{c.path}{changes}: {text}")


@contextmanager
def in_toml(c):
    """What is wrong with an entry, as a fault of the file."""
    try:
        yield
    except UserError as error:
        raise fault(c, error) from None


# ------------------------------------------------------------------------------------ what may stand in the TOML


def weight_and_k(place, value):
    """A row of Table 2."""
    if not isinstance(value, list) or len(value) != 2:
        raise UserError(f"{at(place)} = {value!r} must be [w, k], a list of two numbers of at least 0")
    return tuple(float(at_least_0((*place[:-1], f"{place[-1]} [w, k]"), v)) for v in value)


def angle(place, value):
    """Radians."""
    if abs(number(place, value)) > 2 * np.pi:
        raise UserError(f"{at(place)} = {value!r} looks like degrees; write radians")
    return float(value)


def extra(place, value):
    """A module of extras/."""
    if not isinstance(value, str) or not value.startswith("extras."):
        raise UserError(f'{at(place)} = {value!r} must be a module of ours, "extras.…"')
    return value


TRAINING = {  # [training], a recipe: flags of ppo.py and of extras/train.py, which look at their values more closely
    "hidden?": [count], "value_hidden?": [count],
    "horizon?": count, "minibatch?": count, "envs?": count, "epochs?": count,
    "episode?": count, "lr?": positive, "value_lr?": positive, "gamma?": share, "lam?": share, "clip_eps?": share,
    "target_kl?": positive, "sigma?": positive, "min_sigma?": positive,
    "root_limit?": positive, "root_lag?": at_least_0,
    "balance?": switch, "augment?": switch, "visits?": switch,
    "retry?": share, "stand?": share, "begin?": share, "kinds?": share, "aid?": share,
    "sensor_noise?": at_least_0, "sensor_offset?": at_least_0, "push?": at_least_0,
    "by?": extra,
}  # fmt: skip
FOLLOWER = {"from": one_of(SEG, "human segment"), "to": one_of(SEG, "human segment")}
FOLLOWER |= {"x?": number, "y?": number, "z?": number}
TABLES = "root map torque passive observation reward feet sensors fall pose? metrics? training?".split()


def schema(c) -> dict:
    """What may stand in each table.  Names of the model's parts are read as their ids, those of hinges as they are."""
    body, site, sensor = (one_of(mjcf.names_of(c.model, what), what) for what in ("body", "site", "sensor"))
    groups, motored = sorted({joint_group(n) for n in c.joints}), sorted({joint_group(n) for n in c.motored})
    weighted = one_of(["default", *groups, *c.joints], "joint")
    held = one_of([*motored, *map(numberless, motored)], "driven joint")
    driven = toml.any_case(one_of([*motored, *map(numberless, motored), "default"], "driven joint"))
    every = {g: {g, numberless(g), "default"} for g in motored}
    return tables_of(body, site, sensor, weighted, held, driven, every, poses(c))


def tables_of(body, site, sensor, weighted, held, driven, every, pose) -> dict:
    """The tables, by readers of the names in them: every : what [torque.base] and the like must speak of."""
    return {
        "root": {"body": body, "scale_xy?": number_or(), "scale_z?": number_or("hip")},
        "map": Each(body, FOLLOWER),
        "torque": {"base": Each(driven, positive, every), "scale": Each(driven, positive)},
        "passive": {
            "stiffness": Each(driven, at_least_0, every),
            "damping": at_least_0,
            "armature": Each(driven, at_least_0, every),
            "hold?": [held],
        },
        "observation": {"links": [body]},
        "reward": {
            **dict.fromkeys(TERMS, weight_and_k),
            "fail": number,
            "joints?": Each(weighted, at_least_0),
            "links": Each(body, at_least_0),
        },
        "feet": {"bodies": [body], "contact_sensors": [sensor]},
        "sensors": {"sites": [site], "scale_z?": number_or("hip", "headset")},
        "fall": {"bodies": [body]},
        "pose": pose,
        "metrics": {"sip": [body]},
        "training": TRAINING,
    }


def poses(c) -> Each:
    """Hinges' angles; of all in the MJCF, whatever the variation leaves of them."""
    return Each(one_of([*c.joints, *map(numberless, c.joints)], "joint"), angle)


def table(c, name) -> dict:
    """A table of the TOML, read; empty where it is left out, as some may be."""
    if name not in c.spec and f"{name}?" in TABLES:
        return {}
    with in_toml(c):
        return toml.read(schema(c)[name], (name,), c.spec.get(name, {}))


# ------------------------------------------------------------------------------------ the parts of loading
#
# Each finds some of Character's fields, in the TOML, the MJCF, and what the parts before it have found.


def entries(c):
    """The TOML, with its changes."""
    c.spec = read_toml(c.path, "a character's tables (TOML)")
    with in_toml(c):
        c.spec = toml.with_changes(c.spec, c.variant.get("set", ()))


def tables(c):
    """The tables are there, and no others."""
    with in_toml(c):
        toml.check_keys(dict.fromkeys(["name?", "model?", *TABLES], True), (), c.spec)
    c.name = str(c.spec.get("name", c.path.stem))


def mjcf_file(c):
    """Where the model is."""
    c.xml = c.path.parent / str(c.spec.get("model", c.path.stem + ".xml"))
    if not c.xml.is_file():
        there = ", ".join(sorted(p.name for p in c.path.parent.glob("*.xml"))) or "none"
        raise fault(c, f"model = {c.xml.name!r} is not a file beside it; .xml files there: {there}")


def model(c):
    """What is simulated: the variation, without the shapes that are only looked at, which cost time in every step."""
    spec = bare(c)
    with in_toml(c):
        pose = toml.read(poses(c), ("pose",), c.spec.get("pose", {})) if "tail" in c.variant else {}
    c.model = mjcf.compiled(varied(c, spec, pose), c.xml)


def bare(c) -> mujoco.MjSpec:
    """The MJCF without the shapes that are only looked at; its hinges, and those with motors, as the file has them."""
    spec = mjcf.read_mjcf(c.xml)
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    c.joints = [j.name for j in spec.joints if j.type == hinge and j.name]
    c.motored = {a.target for a in spec.actuators}
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0:
            spec.delete(geom)
    return spec


def skeleton(c):
    """Hinges, and which of them have motors."""
    c.hinges, c.ranges = mjcf.hinges_of(c.model, c.xml)
    c.driven = mjcf.driven_of(c.model, c.xml)


def floor(c):
    """What the feet stand on."""
    mjcf.check_floor(c.model, c.xml)


def default_pose(c):
    """Angles of the default pose, where the passive springs pull to as well."""
    angles = pose_angles(table(c, "pose"), c.hinges)
    c.default = np.array([angles.get(n, 0.0) for n in c.hinges])
    c.model.qpos_spring[7:] = c.default


def torques(c):
    """Limit of each motor: base by joint group times Table 4's scale (1 where it says none); written into its gear."""
    said, names = table(c, "torque"), [c.hinges[h] for h in c.driven]
    base, scale = (np.array([by_group(said[key], n, 1.0) for n in names]) for key in ("base", "scale"))
    c.limits = base * scale * c.size**4
    c.model.actuator_gear[:, 0] = c.limits


def springs(c):
    """Spring, damper (a multiple of the spring) and armature of every hinge that the MJCF drives.

    The others (tails, ears) keep what the MJCF gives them.  All are scaled as `load` says."""
    m, s, said, default = c.model, c.size, table(c, "passive"), c.default
    m.jnt_stiffness[1:] *= s**4
    m.dof_damping[6:] *= s**4.5
    m.dof_armature[6:] *= s**5
    own = [h for h, n in enumerate(c.hinges) if n in c.motored]
    for h in own:
        stiffness = by_group(said["stiffness"], c.hinges[h])
        m.jnt_stiffness[1 + h] = stiffness * s**4
        m.dof_damping[6 + h] = said["damping"] * stiffness * s**4.5
        m.dof_armature[6 + h] = by_group(said["armature"], c.hinges[h]) * s**5
    # MuJoCo scales the softness of contacts and limits by inverse inertias it computed without this armature: again
    with mjcf.told(c.xml):
        mujoco.mj_setConst(m, mujoco.MjData(m))
    hold = dict.fromkeys(said.get("hold", ()), True)
    stretch(m, default, [h for h in own if by_group(hold, c.hinges[h])])


def stretch(m, default, hinges):
    """Springs stretched so far that they bear in the default pose what hangs on them, as the ligament in a long neck.

    Equation  q_spring = q_default + moment of the weight / stiffness
    Test      tests/test_characters.py::test_springs_hold_the_default_pose"""
    data = mujoco.MjData(m)
    data.qpos[7:] = default
    mujoco.mj_forward(m, data)
    for h in hinges:
        if m.jnt_stiffness[1 + h] > 0:
            m.qpos_spring[7 + h] += data.qfrc_bias[6 + h] / m.jnt_stiffness[1 + h]


def root(c):
    """The body of the free joint."""
    m, c.root = c.model, table(c, "root")["body"]
    free = m.jnt_bodyid[np.argmax(m.jnt_type == mujoco.mjtJoint.mjJNT_FREE)]
    if c.root != free:
        names = [c.model.body(b).name for b in (c.root, free)]
        raise fault(c, f"[root] body = {names[0]!r} must be the body of the free joint, {names[1]!r}")


NO_HEAD = "[map] has no body that follows the human's head; needed: one with to = 'head'"


def joint_map(c):
    """[§3.4] Which bodies follow which segments of the human, in tree order."""
    c.chains, c.mapped, followers = [], np.zeros(len(c.hinges), bool), {}
    for b, said in sorted(table(c, "map").items()):
        with in_toml(c):
            c.chains.append(chain(c, b, said))
        c.mapped[c.chains[-1][1]] = True
        followers[said["to"]] = b
    if SEG["head"] not in followers:
        raise fault(c, NO_HEAD)
    c.head = followers[SEG["head"]]


class Follower(NamedTuple):
    """A body of the joint map: its hinges take the turn of the human's segment `end` relative to `start`.

    shares : axis -> share of that turn about it; {} takes all that the bodies before it in the chain have left
    """

    body: int
    hinges: np.ndarray  # indices into the joint angles
    axes: str  # of the hinges, such as "yxz"
    start: int  # segments of the human
    end: int
    shares: dict


def chain(c, b, said) -> Follower:
    """What a body of the joint map does."""
    m, name = c.model, c.model.body(b).name
    hinges = np.arange(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]) - 1
    if b == m.body_rootid[b] or not len(hinges):
        raise UserError(f"[map] body {name} has no hinge in {c.xml.name}; give one that has")
    axes = "".join("xyz"[np.argmax(np.abs(m.jnt_axis[1 + h]))] for h in hinges)
    shares = {a: said[a] for a in "xyz" if a in said}
    if odd := sorted({*shares} - {*axes}):
        raise UserError(f"[map] {name} shares {', '.join(odd)}; valid: what its hinges turn about, {', '.join(axes)}")
    return Follower(b, hinges, axes, said["from"], said["to"], shares)


def feet(c):
    """Bodies, soles, and where in the sensor data their normal forces are, left and right."""
    said, m = table(c, "feet"), c.model
    bodies, sensors = said["bodies"], said["contact_sensors"]
    for says in (*miscounted({"feet": said}), *watched(m, bodies, sensors)):
        raise fault(c, says)
    with in_toml(c):
        soles = [mjcf.collision_geoms(m, [b], "[feet] bodies") for b in bodies]
    if len(soles[0]) != len(soles[1]):
        found = f"{len(soles[0])} and {len(soles[1])}"
        raise fault(c, f"[feet] bodies need as many collision geoms each, found {found}")
    c.feet, c.sole_geoms = np.array(bodies), np.stack(soles)
    # A sensor of one number is the normal force; of a vector, world axes, its last number (z) is.
    c.contact_adr = m.sensor_adr[sensors] + (m.sensor_dim[sensors] - 1)


def miscounted(spec):
    """Which of [feet] and [sensors] holds too many or too few names, a line each."""
    feet, sites = spec.get("feet"), spec.get("sensors")
    if isinstance(feet, dict):
        found = [len(v) if isinstance(v := feet.get(k), list) else 0 for k in ("bodies", "contact_sensors")]
        if found != [2, 2]:
            found = f"{found[0]} and {found[1]}"
            yield f"[feet] needs two bodies and two contact_sensors (left, right), found {found}"
    if isinstance(sites, dict) and isinstance(sites.get("sites"), list) and len(sites["sites"]) != 3:
        yield f"[sensors] needs three sites (head, left, right), found {len(sites['sites'])}"


def watched(m, bodies, sensors):
    """What is wrong with the sensors of the feet, a line each: their kinds, and which body they watch."""
    kinds, bodies_too = mujoco.mjtSensor, (int(mujoco.mjtObj.mjOBJ_BODY), int(mujoco.mjtObj.mjOBJ_XBODY))
    for b, s in zip(bodies, sensors):
        name, kind = m.sensor(s).name, kinds(m.sensor_type[s])
        if kind not in (kinds.mjSENS_TOUCH, kinds.mjSENS_CONTACT):
            what = kind.name.removeprefix("mjSENS_").lower()
            yield f"[feet] contact_sensors: {name} is a sensor of {what}; valid: contact with the floor, or touch"
        elif kind == kinds.mjSENS_CONTACT and m.sensor_reftype[s] in bodies_too and m.sensor_refid[s] != b:
            seen = m.body(m.sensor_refid[s]).name
            yield f"[feet] contact_sensors: {name} watches {seen}; valid: one that watches {m.body(b).name}"


def facing(c):
    """In the default pose the root looks along x."""
    m, data = c.model, mujoco.MjData(c.model)
    data.qpos[7:] = c.default
    mujoco.mj_kinematics(m, data)
    root = m.jnt_bodyid[0]
    if not np.allclose(data.xmat[root].reshape(3, 3)[:, 1], [0, 1, 0], atol=1e-6):
        text = f"the y axis of {m.body(root).name} must point to the left: the heading is found from it"
        raise UserError(f"{c.xml}: {text}")


def rest(c):
    """What the default pose is: the counterpart of a human who stands upright with hanging arms, facing x."""
    m, data = c.model, mujoco.MjData(c.model)
    data.qpos[7:] = c.default
    mujoco.mj_kinematics(m, data)
    lowest = geom_lowest(m, c.sole_geoms.ravel(), data.geom_xpos[None], data.geom_xmat[None]).min()
    c.rest, c.hip_height = data.xquat.copy(), float(data.xpos[c.root, 2] - lowest)


def rewards(c):
    """Table 2, and Eq. 11's weights of links and of hinges; what has no human motion is not imitated (§3.5.1)."""
    said = table(c, "reward")
    c.reward = {"fail": float(said["fail"])} | {term: said[term] for term in TERMS}
    c.reward_links, c.link_weights = np.array([*said["links"]], int), normalised([*said["links"].values()])
    joints = said.get("joints", {})
    weights = [joints.get(n, joints.get(joint_group(n), joints.get("default", 1.0))) for n in c.hinges]
    c.joint_weights = normalised(np.where(c.mapped, weights, 0.0))


def links(c):
    """[Eq. 3] What is observed."""
    c.obs_links = np.array(table(c, "observation")["links"], int)


def devices(c):
    """Where the character wears headset and controllers."""
    said = table(c, "sensors")
    for says in miscounted({"sensors": said}):
        raise fault(c, says)
    c.sensor_sites = np.array(said["sites"], int)


def fall(c):
    """[§3.6] What must not touch the floor."""
    bodies, feet = table(c, "fall")["bodies"], table(c, "feet")["bodies"]
    if both := [c.model.body(b).name for b in bodies if b in feet]:
        says = f"[fall] bodies has {', '.join(both)}, which [feet] stands on"
        raise fault(c, f"{says}; valid: bodies that must not touch the floor")
    with in_toml(c):
        c.fall_geoms = mjcf.collision_geoms(c.model, bodies, "[fall] bodies")


def training(c):
    """The recipe."""
    c.training = table(c, "training")


def metrics(c):
    """[metrics] is for metrics.py to read."""
    table(c, "metrics")


PARTS = (
    entries, tables, mjcf_file, model, skeleton, floor, default_pose, torques, springs, root, joint_map, feet, facing,
    rest, rewards, links, devices, fall, training, metrics,
)  # fmt: skip


# ------------------------------------------------------------------------------------ variations  [§5.1, Fig. 5]


def varied(c, spec: mujoco.MjSpec, pose: dict) -> mujoco.MjSpec:
    """An MJCF with the variation's tail and size; the MJCF itself is changed."""
    if "tail" in c.variant:
        vary_tail(c, spec, c.variant["tail"], pose)
    if "scale" in c.variant:
        mjcf.resize(spec, c.variant["scale"], c.xml)
    return spec


def vary_tail(c, spec, how, pose):
    """Fig. 8's tails, of the hinges called tail…  Test: tests/test_characters.py::test_tail"""
    motors = {a.target: a for a in spec.actuators}
    tail = [j for j in spec.joints if joint_group(j.name).startswith("tail")]
    driven = [j.name for j in tail if j.name in motors]
    if how not in TAILS:
        raise fault(c, f"--tail {how}: valid: {', '.join(TAILS)}")
    if not tail:
        raise fault(c, f"--tail {how}: no hinge of {c.xml.name} is called tail…")
    if not driven and how != "fixed":
        raise fault(c, f"--tail {how}: no hinge of its tail has a motor, it is passive as it is; valid: fixed")
    if how == "passive":
        for name in driven:
            spec.delete(motors[name])
    if how == "fixed":
        angles = pose_angles(pose, [j.name for j in spec.joints])
        with in_toml(c):
            mjcf.weld(spec, [j for j in tail if j.name not in motors], angles, c.xml)


# ------------------------------------------------------------------------------------ names, weights, shapes


def pose_angles(pose: dict, names) -> dict:
    """[pose]: hinge -> angle.  A name without its number stands for all: spine_y for spine0_y, spine1_y, …"""
    found = {n: pose[key] for n in names if n for key in (n, numberless(n)) if key in pose}
    return found | {n: pose[n] for n in names if n in pose}


def by_group(values: dict, name: str, default=None):
    """What a table says of a hinge: of its joint group, of that without its number, or of all (default)."""
    group = joint_group(name)
    return values.get(group, values.get(numberless(group), values.get("default", default)))


def joint_group(name: str) -> str:
    """hip_l_y -> hip, left_hip_y -> hip, spine0_y -> spine0: the name Table 4 uses, in lower case.

    Test      tests/test_characters.py::test_tables, ::test_weights_and_groups"""
    return re.sub(r"^(left|right|l|r)_", "", name.lower()).split("_")[0]


def numberless(name: str) -> str:
    """spine0_y -> spine_y, spine0 -> spine: what stands for all of spine0, spine1, …

    Test      tests/test_characters.py::test_tables"""
    return re.sub(r"\d+", "", name)


def driven_groups(char: Character) -> dict:
    """Joint group ("hip", "tail", …) -> indices of its motors.  Test: tests/test_metrics.py::test_spring_share"""
    names = [numberless(joint_group(char.hinges[h])) for h in char.driven]
    return {name: np.flatnonzero(np.array(names) == name) for name in sorted(set(names))}


def normalised(w):
    """Eq. 11's weights made to sum to 1, so that d is a mean.  ASSUMED: the one place where that is decided.
    With the plain sum over 33 joints and k_q = 25, 0.1 rad everywhere would give e^-8 and no gradient; the mean
    gives e^-0.25.

    Test      tests/test_characters.py::test_tables"""
    w = np.asarray(w, dtype=float)
    return w / w.sum() if w.sum() > 0 else w


def geom_lowest(model, geoms, xpos, xmat):
    r"""Height of the lowest point of spheres, capsules and boxes.

    Equation  capsule: z − |a_z| h − r with axis a; box: z − Σ_i |R_zi| s_i
    Args      geoms : (g,) ids; xpos (N, ngeom, 3); xmat (N, ngeom, 9)
    Returns   (N, g) [m]
    Test      tests/test_retarget.py::test_geom_lowest
    """
    kind, size = model.geom_type[geoms], model.geom_size[geoms]
    box, capsule = kind == int(mujoco.mjtGeom.mjGEOM_BOX), kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE)
    half = np.where(box[:, None], size, 0.0)  # (g, 3) half sizes along the geom's axes, without the radius
    half[:, 2] = np.where(capsule, size[:, 1], half[:, 2])
    lowest = xpos[:, geoms, 2] - np.where(box, 0.0, size[:, 0])
    for axis in range(3):
        lowest -= np.abs(xmat[:, geoms, 6 + axis]) * half[:, axis]  # R_zi: height of axis i
    return lowest


class OwnShapes:
    """Which of a character's collision shapes may be in one another's way, and how deep they are in a pose.

    ASSUMED   neighbours, which are left out, are shapes of bodies at most two joints apart, and what overlaps in the
              default pose, as a belly does with thighs
    Test      tests/test_metrics.py::test_self_penetration
    """

    REACH = 0.2  # m beyond which a distance does not matter

    def __init__(self, char: Character):
        self.model, self.data = char.model, mujoco.MjData(char.model)
        m = self.model
        geoms = np.flatnonzero(m.geom_conaffinity)
        pairs = [(a, b) for i, a in enumerate(geoms) for b in geoms[i + 1 :] if not self._near(*m.geom_bodyid[[a, b]])]
        self.pairs = np.array(pairs, int).reshape(-1, 2)
        self._pose(char.upright)
        self.pairs = self.pairs[[self._distance(a, b) > 0 for a, b in self.pairs]]

    def _near(self, a, b):
        """Are two bodies at most two joints apart in the tree?"""
        parent = self.model.body_parentid
        up = [{body, parent[body], parent[parent[body]]} - {0} for body in (a, b)]
        return a in up[1] or b in up[0] or parent[a] == parent[b] != 0

    def _pose(self, qpos):
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)

    def _distance(self, a, b):
        return mujoco.mj_geomDistance(self.model, self.data, a, b, self.REACH, None)

    def overlap(self, qpos):
        """Deepest overlap in each pose.  qpos (T, nq) -> (T,) [m], 0 where nothing overlaps"""
        out, (a, b) = np.zeros(len(qpos)), self.pairs.T
        reach = self.model.geom_rbound[a] + self.model.geom_rbound[b]
        for t, q in enumerate(qpos):
            self._pose(q)
            apart = np.linalg.norm(self.data.geom_xpos[a] - self.data.geom_xpos[b], axis=1)
            near = self.pairs[apart < reach]
            out[t] = max((-self._distance(i, j) for i, j in near), default=0.0)
        return np.maximum(out, 0.0)

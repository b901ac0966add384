r"""Characters: a MuJoCo model and its tables, each checked against the other  [Reda23 §3.2, §3.7, App. A, App. D].

    NAME.xml + NAME.toml ──► load ──► Character
         └─► tail, scale, set: the variations of §4 and §5, made while loading

The joint map is used in `retarget`, the reward's tables in `env`; `characters/README.md` says how to bring one.
"""

from __future__ import annotations

import re
import tomllib
import warnings
from contextlib import suppress
from dataclasses import dataclass
from math import prod
from pathlib import Path
from xml.parsers import expat

import mujoco
import numpy as np
from mujoco.batch import Batch

from human import SEG, SEGMENTS, quat_mul
from plumbing.cli import ALL_POSITIVE, COUNT, NONNEGATIVE, POSITIVE, UNIT, UserError, arg
from plumbing.files import read_text, read_toml

CHARACTERS = Path(__file__).resolve().parent / "characters"
TERMS = ("q", "qd", "x", "xd", "contact", "orientation", "action_diff", "action_min")  # Table 2's rows
TAILS = ("active", "fixed", "passive")  # [Reda23 §5.1, Fig. 8]
SOLVERS = {  # ASSUMED: of contacts, with iterations at most: MuJoCo's exact one; a faster one under which feet creep
    "newton": (mujoco.mjtSolver.mjSOL_NEWTON, 100),
    "pgs": (mujoco.mjtSolver.mjSOL_PGS, 5),
}
RECIPE = {"by": (str, (lambda v: v.startswith("extras."), 'the name of a module in extras, as "extras.train"'))}
RECIPE |= {  # [training]: options of ppo.py and of the module that `by` names -> kind, (test, what is valid)
    key: (kind, check)
    for kind, check, keys in (
        (float, POSITIVE, "lr value_lr target_kl sigma min_sigma root_limit"),
        (float, UNIT, "gamma lam retry stand begin"),
        (float, (lambda v: 0 < v < 1, "between 0 and 1"), "clip_eps"),
        (float, NONNEGATIVE, "sensor_noise sensor_offset push"),
        (int, COUNT, "envs horizon minibatch epochs episode"),
        (list, ALL_POSITIVE, "hidden value_hidden"),
        (bool, None, "balance augment visits"),
    )
    for key in keys.split()
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
    training: dict  # the recipe (ours): hyper-parameters to learn with, by RECIPE's names, where the TOML says

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
        return _Loader(self.path, self.variant, self.spec).mjspec()

    @property
    def height(self):
        """Top of the collision shapes above the soles in the default pose [m]."""
        m, data = self.model, mujoco.MjData(self.model)
        data.qpos[2], data.qpos[7:] = self.hip_height, self.default
        mujoco.mj_kinematics(m, data)
        geoms = np.flatnonzero(m.geom_conaffinity)
        middle = data.geom_xpos[geoms, 2]  # the shapes are symmetric: the top is as far above as the lowest point below
        return float((2 * middle - geom_lowest(m, geoms, data.geom_xpos[None], data.geom_xmat[None])[0]).max())

    def summary(self) -> str:
        """Joints, limits and masses as text; left and right in one line.

        Test      tests/test_characters.py::test_check_command"""
        m, lines = self.model, []
        lines.append(
            f"{self.name}: {m.body_subtreemass[0]:.1f} kg, {self.height:.2f} m tall, hips {self.hip_height:.2f} m up; "
            f"{m.nbody - 1} links, {self.j} hinges, {len(self.driven)} driven, {m.nv} degrees of freedom"
        )
        limits = dict(zip(self.driven, self.limits, strict=True))
        lines.append("hinge           limit N m  spring N m/rad  range rad      weight  follows")
        follows = {h: SEGMENTS[c[4]] for c in self.chains for h in c[1]}
        weight = self.joint_weights / max(self.joint_weights.max(), 1e-9)
        for h, name in enumerate(self.hinges):
            if "_r_" not in name or name.replace("_r_", "_l_") not in self.hinges:
                low, high = self.ranges[h]
                lines.append(
                    f"{name:14s} {limits.get(h, 0.0):10.2f} {m.jnt_stiffness[1 + h]:15.2f}  {low:6.2f} {high:6.2f}  "
                    f"{weight[h]:6.2f}  {follows.get(h, 'nobody: passive' if h not in limits else 'nobody')}"
                )
        masses = {m.body(b).name: float(m.body_mass[b]) for b in range(1, m.nbody)}
        lines.append("kg: " + ", ".join(f"{n} {kg:.2f}" for n, kg in masses.items() if not n.endswith("_r")))
        return "\n".join(lines)


@dataclass
class Switches:
    """The flags of every command that loads one character: which, and the variations of §4 and §5."""

    character: str = arg("jesse", "name in characters/, or path of a .toml")
    tail: str | None = arg(
        None,
        "tail [§5.1]: active (as the MJCF drives it), fixed (joints without a motor welded), passive (without motors)",
        choices=TAILS,
    )
    scale: float = arg(
        1.0, "size of the character [Fig. 5]: masses by its cube, torques by its fourth power", check=POSITIVE
    )
    set: str | None = arg(
        None, "entries of the TOML to change, as in 'reward.contact=[0, 1]; pose.spine_y=0.3'", metavar="T.K=V;…"
    )

    def load(self) -> Character:
        """The character that the flags describe.  Test: tests/test_characters.py::test_switches"""
        return load(self.character, self.tail, self.scale, tuple(filter(str.strip, (self.set or "").split(";"))))


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
    Raises    UserError: names the file, what is missing or does not match, and what would have been valid; the first
              complaint, and how many more there are (`check`)
    Test      tests/test_characters.py::test_tables, ::test_checks, ::test_tail, ::test_scale, ::test_set
    """
    path = _toml(name)
    variant = {"tail": tail} if tail else {}
    variant |= {"scale": float(scale)} if scale != 1 else {}
    variant |= {"set": [s.strip() for s in set]} if set else {}
    loader = _Loader(path, variant)
    found = loader.load()
    if loader.problems:
        more = len(loader.problems) - 1
        hint = f" (and {more} more: python retarget.py --check {path})" if more else ""
        raise UserError(loader.problems[0] + hint)
    return found


def check(name: str | Path) -> list[str]:
    """Everything that is missing or does not match in a character's two files.

    Args      name : of a character, or path of its .toml or .xml; of an .xml the .toml beside it is read, too
    Returns   one line a complaint, none if the character can be loaded
    Raises    UserError: no such file
    Test      tests/test_characters.py::test_check_names_everything
    """
    path = Path(name)
    if path.suffix == ".xml" and not path.is_file():
        raise UserError(f"no file {path}; --check wants a character's .xml or .toml, or its name")
    beside = path.with_suffix(".toml")
    if path.suffix == ".xml" and not beside.is_file():
        loader = _Loader(beside, {}, {"model": path.name})
        loader.complain("is not there")
    else:
        loader = _Loader(beside if path.suffix == ".xml" else _toml(name), {})
        if path.suffix == ".xml" and loader.xml and not loader.xml.samefile(path):
            loader.complain(f"its model is {loader.xml.name}, not {path.name}")
    loader.load()
    return loader.problems


def _toml(name) -> Path:
    path = Path(name) if str(name).endswith(".toml") else CHARACTERS / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(available())
        raise UserError(f"no character {str(name)!r}; there are: {known}; or give the path of a .toml file")
    return path


# ------------------------------------------------------------------------------------ loading and checking

LIMIT = 1e9  # no number of a TOML, no size or mass of a model is larger
XML_BYTES = 2**25
COPIES, PIXELS, ENTRIES = 1e4, 2**24, 1e6
CLAIMS = dict(  # element of an MJCF -> attributes whose product may be so large
    replicate=("count", COPIES), composite=("count", COPIES), flexcomp=("count", COPIES),
    texture=("width height", PIXELS), hfield=("nrow ncol", PIXELS), size=("nuserdata nkey njmax nconmax", ENTRIES),
)  # fmt: skip


def check_claims(path, seen=()):
    """UserError if an MJCF, or one that it includes, is no XML, or asks MuJoCo for much more than its own size.

    Test      tests/robustness/test_fuzz.py::test_what_is_meant_to_hurt"""
    copies, included, parser = [1.0], [], expat.ParserCreate()

    def start(tag, attributes):
        names, most = CLAIMS.get(tag, ("", COPIES))
        keys = [k for k in attributes if k in names.split() or (tag == "size" and k.startswith("nuser"))]
        words = [w for k in keys for w in attributes[k].split() if re.fullmatch(r"\d+(\.\d*)?([eE]\+?\d+)?", w)]
        claim = prod(max(float(w), 1.0) for w in words)
        copies.append(copies[-1] * (claim if most == COPIES else 1.0))
        if max(claim / most, copies[-1] / COPIES) > 1.0:
            where = f"{path}, line {parser.CurrentLineNumber}"
            raise UserError(f"{where}: <{tag}> asks for {claim:g} {' x '.join(keys)}; valid: {most:g} in all")
        if tag in ("include", "model") and "file" in attributes:
            included.append(path.parent / attributes["file"])

    def doctype(*_):
        raise UserError(f"{path}, line {parser.CurrentLineNumber}: a document type; expected MJCF without one")

    parser.StartElementHandler, parser.EndElementHandler = start, lambda tag: copies.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(read_text(path, "MJCF", XML_BYTES), True)
    except (expat.ExpatError, ValueError) as e:
        raise UserError(f"{path}: no XML: {e}; expected MJCF") from None
    for other in included:
        if other not in (path, *seen):
            check_claims(other, (path, *seen))


class _Stop(Exception):
    """This part cannot go on; what is wrong is among the problems."""


class _Loader:
    """Resolves the TOML's names in the model; every complaint names the file, the table and what would be valid.

    Each of PARTS finds some of Character's fields, and may ask for what earlier ones found (`need`).  `complain` goes
    on, `fail` leaves the part; so `problems` has all that is wrong, causes before consequences.
    """

    KEYS = dict(  # what each table may hold; None: names that are checked where they are used
        root=("body", "scale_xy", "scale_z"),
        map=None,
        torque=("base", "scale"),
        passive=("stiffness", "damping", "armature", "hold"),
        observation=("links",),
        reward=(*TERMS, "fail", "joints", "links"),
        feet=("bodies", "contact_sensors"),
        sensors=("sites", "scale_z"),
        fall=("bodies",),
        pose=None,
        metrics=("sip",),
        training=tuple(RECIPE),
    )
    TABLES = tuple(t for t in KEYS if t not in ("pose", "metrics", "training"))  # those that must be there
    PARTS = (
        "compile", "skeleton", "default_pose", "motors", "torques", "springs", "root", "chains", "feet",
        "rest", "links", "link_weights", "joint_weights", "rewards", "sites", "fall", "metrics",
    )  # fmt: skip
    SHAPES = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)

    def __init__(self, path: Path, variant: dict, spec: dict | None = None):
        """path : of the TOML; spec : what it holds, with the changes; None to read it."""
        self.path, self.variant, self.spec = path, variant, spec
        self.problems, self.found, self.xml = [], {}, None
        self.size = variant.get("scale", 1.0)
        self.welded, self.released = [], []  # names of hinges that are gone, or have lost their motors
        with suppress(_Stop):
            if spec is None:
                self.spec = self.read()
            self.tables()
            self.xml = self.find_xml()

    def load(self) -> Character | None:
        """The character, or None where there are problems."""
        for part in self.PARTS if self.xml else ():
            with suppress(_Stop):
                self.found |= getattr(self, part)() or {}
        if self.problems:
            return None
        name = str(self.spec.get("name", self.path.stem))
        return Character(
            name=name, path=self.path, xml=self.xml, variant=self.variant, spec=self.spec,
            training=self.spec.get("training", {}), **self.found,
        )  # fmt: skip

    # ---- complaints and look-ups

    def complain(self, text):
        changes = f" with {'; '.join(self.variant['set'])}" if self.variant.get("set") else ""
        self.problems.append(f"{self.path}{changes}: {text}")

    def fail(self, text):
        self.complain(text)
        raise _Stop

    def fail_xml(self, text):
        self.problems.append(f"{self.xml}: {text}")
        raise _Stop

    def need(self, field):
        """A field of the character that an earlier part has found."""
        if field not in self.found:
            raise _Stop
        return self.found[field]

    def number(self, where, value, least=None):
        """`value` if it is a finite number (and at least `least`)."""
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) <= LIMIT:
            self.fail(f"{where} = {value!r} is not a finite number of at most {LIMIT:g}")
        if least is not None and value < least:
            self.fail(f"{where} = {value!r} must be at least {least}")
        return value

    def table(self, name):
        """spec[name], empty where it may be left out; `tables` complains if it is no table."""
        value = self.spec.get(name, None if name in self.TABLES else {})
        if not isinstance(value, dict):
            raise _Stop
        return value

    def get(self, table, key, kind):
        """spec[table][key], which must be a str, list, dict or float (any finite number)."""
        value = self.table(table).get(key)
        if value is None:
            self.fail(f"[{table}] has no {key}; it has {', '.join(self.spec[table]) or 'nothing'}")
        if kind is float:
            return float(self.number(f"[{table}] {key}", value))
        if not isinstance(value, kind):
            self.fail(f"[{table}] {key} = {value!r} is not a {kind.__name__}")
        return value

    def ids(self, table, names, obj, what):
        m = self.need("model")
        count = {"body": m.nbody, "site": m.nsite, "sensor": m.nsensor}[what]
        out = [mujoco.mj_name2id(m, obj, str(n)) for n in names]
        valid = ", ".join(filter(None, (mujoco.mj_id2name(m, obj, k) for k in range(count)))) or "none"
        for n, i in zip(names, out, strict=True):
            if i < 0:
                self.complain(f"[{table}] names {what} {n!r}, which {self.xml.name} lacks; it has {valid}")
        if -1 in out:
            raise _Stop
        return np.array(out, dtype=int)

    def bodies(self, table, names):
        return self.ids(table, names, mujoco.mjtObj.mjOBJ_BODY, "body")

    def collision_geoms(self, table, names):
        """Ids of the bodies' geoms that the floor can touch; only shapes that `geom_lowest` knows."""
        m = self.need("model")
        found = [np.flatnonzero((m.geom_bodyid == b) & (m.geom_conaffinity != 0)) for b in self.bodies(table, names)]
        geoms = np.concatenate(found) if found else np.zeros(0, int)
        if not len(geoms):
            self.fail(f"[{table}] bodies = {names!r} have no geom that the floor can touch (conaffinity 1)")
        if not np.isin(m.geom_type[geoms], [int(s) for s in self.SHAPES]).all():
            self.fail(f"[{table}] bodies = {names!r} have collision geoms of other types than sphere, capsule and box")
        return geoms

    def by_group(self, table, key, groups):
        """A table of numbers by joint group ("spine1", or "spine" for all of spine0, spine1, …), names checked."""
        values, valid = {}, groups | {numberless(g) for g in groups} | {"default"}
        for name, value in self.get(table, key, dict).items():
            with suppress(_Stop):
                if name.lower() not in valid:
                    joints = ", ".join(sorted(groups)) or "none"
                    self.fail(f"[{table}.{key}] names {name.lower()!r}; valid: the model's driven joints, {joints}")
                values[name.lower()] = self.number(f"[{table}.{key}] {name}", value, 0)
        return lambda g: values.get(g, values.get(numberless(g), values.get("default")))

    # ---- the two files

    def read(self) -> dict:
        """The TOML with the changes of `set`."""
        try:
            spec = read_toml(self.path, "a character's tables (TOML)")
        except UserError as e:
            self.problems.append(str(e))
            raise _Stop from None
        for change in self.variant.get("set", ()):
            place, equals, text = (s.strip() for s in change.partition("="))
            *tables, key = place.split(".")
            try:
                value = tomllib.loads(f"value = {text}")["value"]
            except (ValueError, RecursionError):
                equals = ""
            if not (equals and tables and key):
                self.fail(f"cannot set {change!r}; valid is TABLE.KEY=VALUE with a value as in TOML: a.b=1, a.b=[0, 1]")
            table = spec
            for name in tables:
                table = table.setdefault(name, {}) if isinstance(table, dict) else None
            if not isinstance(table, dict):
                self.fail(f"cannot set {change!r}: {'.'.join(tables)} is not a table; tables: {', '.join(self.KEYS)}")
            table[key] = value
        return spec

    def find_xml(self) -> Path:
        xml = self.path.parent / str(self.spec.get("model", self.path.stem + ".xml"))
        if not xml.is_file():
            there = ", ".join(sorted(p.name for p in self.path.parent.glob("*.xml"))) or "none"
            self.fail(f"model = {xml.name!r} is not a file beside it; .xml files there: {there}")
        return xml

    def tables(self):
        """The TOML's tables and their keys."""
        missing = ", ".join(f"[{table}]" for table in self.TABLES if not isinstance(self.spec.get(table), dict))
        if missing:
            self.complain(f"has no table {missing}; needed: {', '.join(self.TABLES)}")
        for name, value in self.spec.items():
            if name not in (*self.KEYS, "name", "model"):
                self.complain(f"has {name!r}, which means nothing; valid: name, model, {', '.join(self.KEYS)}")
            elif name in self.KEYS and name not in self.TABLES and not isinstance(value, dict):
                self.complain(f"{name} = {value!r} is not a table")
            for key in value if self.KEYS.get(name) and isinstance(value, dict) else ():
                if key not in self.KEYS[name]:
                    self.complain(f"[{name}] has {key!r}, which means nothing; valid: {', '.join(self.KEYS[name])}")
        for key in RECIPE:
            with suppress(_Stop):
                if key in self.table("training"):
                    self.recipe_entry(key, self.table("training")[key])

    def recipe_entry(self, key, value):
        """Kind and range of one entry of [training]."""
        where, (kind, check) = f"[training] {key}", RECIPE[key]
        if kind is float:
            self.number(where, value)
        elif type(value) is not kind:
            valid = {str: "text", int: "an integer", list: "a list of integers", bool: "true or false"}[kind]
            self.fail(f"{where} = {value!r} is not {valid}")
        if kind is list and not all(type(v) is int for v in value):
            self.fail(f"{where} = {value!r} must be integers, as in [512, 256]")
        if check and not check[0](value):
            self.fail(f"{where} = {value!r} must be {check[1]}")

    def mjspec(self, visual=True) -> mujoco.MjSpec:
        """The MJCF with the variations; without the shapes that are only looked at, which cost time in every step."""
        try:
            check_claims(self.xml)
            spec = mujoco.MjSpec.from_file(str(self.xml))
            for geom in list(spec.geoms) if not visual else []:
                if geom.contype == 0 and geom.conaffinity == 0:
                    spec.delete(geom)
            if "tail" in self.variant:
                self.vary_tail(spec, self.variant["tail"])
            if self.size != 1:
                self.resize(spec)
            return spec
        except UserError as e:
            self.problems.append(str(e))
            raise _Stop from None
        except (ValueError, RuntimeError, MemoryError) as e:
            self.fail_xml(f"{e}; expected MJCF that MuJoCo can compile")

    def vary_tail(self, spec, how):
        """Fig. 8's tails, of the hinges called tail…"""
        motors = {a.target: a for a in spec.actuators}
        tail = [j for j in spec.joints if joint_group(j.name).startswith("tail")]
        driven = [j.name for j in tail if j.name in motors]
        if not tail:
            self.fail(f"--tail {how}: no hinge of {self.xml.name} is called tail…")
        if not driven and how != "fixed":
            self.fail(f"--tail {how}: no hinge of its tail has a motor, it is passive as it is; valid: fixed")
        if how not in TAILS:
            self.fail(f"--tail {how}: valid: {', '.join(TAILS)}")
        if how == "passive":
            self.released = driven
            for name in driven:
                spec.delete(motors[name])
        if how == "fixed":
            flat, angles = spec.copy().compile(), self.angles([j.name for j in spec.joints])
            for j in (j for j in tail if j.name not in motors):
                body, angle = j.parent, float(angles.get(j.name, 0.0))
                if angle and (np.any(j.pos) or any(other.name in motors for other in body.joints)):
                    self.fail(f"--tail fixed: [pose] {j.name} = {angle} wants its hinge at the origin of its own body")
                if body.name not in {b for b, _ in self.welded}:  # its orientation may be written in another way
                    body.quat, body.alt.type = flat.body(body.name).quat, mujoco.mjtOrientation.mjORIENTATION_QUAT
                half = angle / 2
                body.quat = quat_mul(body.quat, [np.cos(half), *np.sin(half) * j.axis / np.linalg.norm(j.axis)])
                self.welded.append((body.name, j.name))
                spec.delete(j)

    def resize(self, spec):
        """Sizes × S and masses × S³; MuJoCo computes the inertias, × S⁵, of the shapes."""
        s = self.size
        if len(spec.tendons) or len(spec.equalities):
            self.fail_xml("has tendons or equality constraints: --scale does not know how to scale them")
        own = lambda items: [i for i in items if i.parent.name != "world"]  # noqa: E731  (not the floor)
        for item in (*spec.bodies, *own((*spec.geoms, *spec.sites, *spec.joints, *spec.cameras, *spec.frames))):
            item.pos = s * item.pos
        for geom in own(spec.geoms):
            geom.size, geom.fromto, geom.mass = s * geom.size, s * geom.fromto, s**3 * geom.mass
        for site in spec.sites:
            site.size = s * site.size
        for mesh in spec.meshes:
            mesh.scale = s * mesh.scale
        for body in spec.bodies:
            if body.explicitinertial:
                body.ipos, body.mass = s * body.ipos, s**3 * body.mass
                body.inertia, body.fullinertia = s**5 * body.inertia, s**5 * body.fullinertia

    # ---- the parts

    def compile(self):
        spec = self.mjspec(visual=False)
        for body in spec.bodies:
            hinges = [j for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
            axes = "".join("xyz"[np.argmax(np.abs(j.axis))] for j in hinges)
            if len(set(axes)) != len(axes):
                self.fail_xml(f"body {body.name} has two hinges about one axis ({axes}); valid: x, y and z once each")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                m = spec.compile()
        except (ValueError, RuntimeError, MemoryError, Warning) as e:
            self.fail_xml(f"{e}; expected MJCF that MuJoCo can compile")
        for name in "body_pos body_ipos body_mass body_inertia geom_pos geom_size jnt_pos site_pos".split():
            if not np.all(np.abs(getattr(m, name)) <= LIMIT):
                self.fail_xml(f"its {name} holds NaN, or more than {LIMIT:g}; expected SI units")
        return dict(model=m)

    def skeleton(self):
        """Names and ranges of the hinges, and what the rest of this code takes for granted about the model."""
        m, kinds = self.need("model"), mujoco.mjtJoint
        if m.njnt < 2 or m.jnt_type[0] != kinds.mjJNT_FREE or np.any(m.jnt_type[1:] != kinds.mjJNT_HINGE):
            self.fail_xml("the first joint must be free and all others hinges")
        names = [mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_JOINT, k) for k in range(1, m.njnt)]
        if None in names:
            at = m.body(m.jnt_bodyid[1 + names.index(None)]).name
            self.fail_xml(f"every hinge needs a name, such as hip_l_y; one of body {at!r} has none")
        oblique = [n for n, axis in zip(names, m.jnt_axis[1:]) if not np.isclose(np.abs(axis).max(), 1.0)]
        if oblique:
            text = f"every hinge must turn about one axis of its body's frame (x, y or z); not so {', '.join(oblique)}"
            self.fail_xml(text)
        floors = (m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (m.geom_bodyid == 0) & (m.geom_pos[:, 2] == 0.0)
        if not floors.any():
            with suppress(_Stop):
                self.fail_xml("needs a floor: a geom of type plane at height 0 in the world body")
        limited = m.jnt_limited[1:].astype(bool)
        widest = np.abs(m.jnt_range[1:])[limited].max(initial=0.0)
        if limited.any() and widest < 0.1:
            self.fail_xml("joint ranges look like degrees read as radians; set <compiler angle='radian'/>")
        if widest > 2 * np.pi:
            worst = names[np.abs(m.jnt_range[1:]).max(axis=1).argmax()]
            self.fail_xml(f"the range of hinge {worst} reaches {widest:.0f} rad: it looks like degrees; write radians")
        return dict(hinges=names, ranges=np.where(limited[:, None], m.jnt_range[1:], [-np.inf, np.inf]))

    def angles(self, names) -> dict:
        """[pose]: hinge -> angle.  A name without its number stands for all: spine_y for spine0_y, spine1_y, …"""
        pose = self.table("pose")
        found = {n: pose[key] for n in names if n for key in (n, numberless(n)) if key in pose}
        return found | {n: pose[n] for n in names if n in pose}

    def default_pose(self):
        """Angles of the default pose, where the passive springs pull to as well."""
        m, names, pose, before = self.need("model"), self.need("hinges"), self.table("pose"), len(self.problems)
        every = names + [j for _, j in self.welded]
        valid = {numberless(n) for n in every} | set(every)
        for joint, value in pose.items():
            with suppress(_Stop):
                if joint not in valid:
                    self.fail(f"[pose] names joint {joint!r}; valid: {', '.join(every)}")
                if abs(self.number(f"[pose] {joint}", value)) > 2 * np.pi:
                    self.fail(f"[pose] {joint} = {value!r} looks like degrees; write radians")
        if len(self.problems) > before:
            raise _Stop
        angles = self.angles(names)
        default = np.array([float(angles.get(n, 0.0)) for n in names])
        m.qpos_spring[7:] = default
        return dict(default=default)

    def motors(self):
        m, _ = self.need("model"), self.need("hinges")
        driven = m.actuator_trnid[:, 0] - 1
        if np.any(m.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT) or np.any(driven < 0) or len(set(driven)) < m.nu:
            self.fail_xml("every actuator must be a motor on a hinge of its own")
        plain = (m.actuator_gaintype == 0) & (m.actuator_biastype == 0) & (m.actuator_gainprm[:, 0] == 1)
        if not plain.all() or np.any(m.actuator_ctrllimited & np.any(m.actuator_ctrlrange != [-1, 1], axis=1)):
            self.fail_xml('every actuator must be a plain <motor>, its ctrlrange "-1 1"')
        return dict(driven=driven)

    def torques(self):
        """Limit of each motor: base by joint group times Table 4's scale; written into the motors' gear."""
        m, names, driven = self.need("model"), self.need("hinges"), self.need("driven")
        groups = {joint_group(names[h]) for h in driven} | {joint_group(n) for n in self.released}
        base, scale = (self.by_group("torque", key, groups) for key in ("base", "scale"))
        limits = np.zeros(len(driven))
        missing = sorted({g for g in groups if not base(g)})
        if missing:
            valid = ", ".join(sorted(groups))
            lacking = ", ".join(missing)
            self.fail(f"[torque.base] has no positive value for {lacking} (nor a default); driven joints: {valid}")
        for k, h in enumerate(driven):
            g = joint_group(names[h])
            limits[k] = base(g) * (1.0 if scale(g) is None else scale(g)) * self.size**4
        m.actuator_gear[:, 0] = limits
        return dict(limits=limits)

    def springs(self):
        """Spring, damper (a multiple of the spring) and armature of every hinge that the MJCF drives.

        The others (tails, ears) keep what the MJCF gives them.  All are scaled as `load` says.  Those of the joints in
        `hold` are stretched so far that they bear in the default pose what hangs on them, as the ligament in a long
        neck does: q_spring = q_default + moment of the weight / stiffness."""
        m, names, driven, s = self.need("model"), self.need("hinges"), self.need("driven"), self.size
        before = len(self.problems)
        m.jnt_stiffness[1:] *= s**4
        m.dof_damping[6:] *= s**4.5
        m.dof_armature[6:] *= s**5
        damping = self.number("[passive] damping", self.get("passive", "damping", float), 0)
        own = [*driven, *(names.index(n) for n in self.released)]
        groups = {joint_group(names[h]) for h in own}
        stiffness, armature = (self.by_group("passive", key, groups) for key in ("stiffness", "armature"))
        for key, value in (("stiffness", stiffness), ("armature", armature)):
            missing = ", ".join(sorted(g for g in groups if value(g) is None))
            if missing:
                self.complain(f"[passive.{key}] has no entry for {missing}")
        if len(self.problems) > before:
            raise _Stop
        for h in own:
            g = joint_group(names[h])
            m.jnt_stiffness[1 + h] = stiffness(g) * s**4
            m.dof_damping[6 + h] = damping * stiffness(g) * s**4.5
            m.dof_armature[6 + h] = armature(g) * s**5
        # MuJoCo scales the softness of contacts and limits by inverse inertias it computed without this armature: again
        with warnings.catch_warnings(), suppress(_Stop):
            warnings.simplefilter("error")
            try:
                mujoco.mj_setConst(m, mujoco.MjData(m))
            except Warning as e:
                self.fail_xml(f"{e}; expected masses and inertias that can be moved")
        held = self.table("passive").get("hold", [])
        if not isinstance(held, list) or not {str(g) for g in held} <= groups | {numberless(g) for g in groups}:
            there = ", ".join(sorted(groups)) or "none"
            self.fail(f"[passive] hold = {held!r} must list driven joints; there are {there}")
        data = mujoco.MjData(m)
        data.qpos[7:] = self.need("default")
        mujoco.mj_forward(m, data)
        for h in own:
            if {joint_group(names[h]), numberless(joint_group(names[h]))} & set(held) and m.jnt_stiffness[1 + h] > 0:
                m.qpos_spring[7 + h] += data.qfrc_bias[6 + h] / m.jnt_stiffness[1 + h]

    def root(self):
        m, _ = self.need("model"), self.need("hinges")
        for table, key, words in (("root", "scale_xy", ()), ("root", "scale_z", ("hip",)),
                                  ("sensors", "scale_z", ("hip", "headset"))):  # fmt: skip
            with suppress(_Stop):
                value = self.table(table).get(key, 1.0)
                if isinstance(value, str) and value not in words:
                    valid = " or ".join(["a number", *(f'"{w}"' for w in words)])
                    self.fail(f"[{table}] {key} = {value!r}; valid: {valid}")
                if not isinstance(value, str) and self.number(f"[{table}] {key}", value) <= 0:
                    self.fail(f"[{table}] {key} = {value!r} must be greater than 0")
        root, free = int(self.bodies("root", [self.get("root", "body", str)])[0]), int(m.jnt_bodyid[0])
        if root != free:
            self.fail(f"[root] body = {m.body(root).name!r} must be the body of the free joint, {m.body(free).name!r}")
        return dict(root=root)

    def chains(self):
        """The joint map in tree order: (body, hinges, axes, from, to, shares)."""
        m, names, table = self.need("model"), self.need("hinges"), self.table("map")
        out, mapped, followers = [], np.zeros(len(names), bool), {}
        for body, entry in table.items():
            with suppress(_Stop):
                b = int(self.bodies("map", [body])[0])
                keys = {"from", "to", "x", "y", "z"}
                if not isinstance(entry, dict) or {"from", "to"} - set(entry) or set(entry) - keys:
                    self.fail(f'[map] {body} must be {{ from = "…", to = "…" }} with optional x, y, z; found {entry!r}')
                for key in ("from", "to"):
                    if entry[key] not in SEGMENTS:
                        segments = ", ".join(SEGMENTS)
                        self.fail(f"[map] {body}.{key} = {entry[key]!r}; valid human segments: {segments}")
                hinges = np.arange(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]) - 1
                if b == m.jnt_bodyid[0] or not len(hinges):
                    self.fail(f"[map] body {body} has no hinge in {self.xml.name}")
                axes = "".join("xyz"[np.argmax(np.abs(m.jnt_axis[1 + h]))] for h in hinges)
                shares = {a: self.number(f"[map] {body}.{a}", entry[a]) for a in "xyz" if a in entry}
                if set(shares) - set(axes):
                    extra = ", ".join(sorted(set(shares) - set(axes)))
                    self.fail(f"[map] {body} shares {extra}, but its hinges turn about {', '.join(axes)}")
                out.append((b, hinges, axes, SEG[entry["from"]], SEG[entry["to"]], shares))
                followers[entry["to"]] = b
                mapped[hinges] = True
        if len(out) < len(table):
            raise _Stop
        if "head" not in followers:
            self.fail("[map] has no body that follows the human's head; needed: one with to = 'head'")
        return dict(chains=sorted(out, key=lambda c: c[0]), mapped=mapped, head=followers["head"])

    def feet(self):
        """Body ids (2,), sole geoms (2, g), addresses of the normal forces (2,)."""
        m, names, contact = self.need("model"), self.get("feet", "bodies", list), None
        with suppress(_Stop):
            contact = self.ids("feet", self.get("feet", "contact_sensors", list), mujoco.mjtObj.mjOBJ_SENSOR, "sensor")
        feet = self.bodies("feet", names)
        if contact is None:
            raise _Stop
        if len(feet) != 2 or len(contact) != 2:
            text = f"{len(feet)} and {len(contact)}"
            self.fail(f"[feet] needs two bodies and two contact_sensors (left, right), found {text}")
        soles = [self.collision_geoms("feet", [n]) for n in names]
        if len(soles[0]) != len(soles[1]):
            self.fail(f"[feet] bodies need as many collision geoms each, found {len(soles[0])} and {len(soles[1])}")
        # A sensor of one number is the normal force; of a vector, world axes, its last number (z) is.
        address = m.sensor_adr[contact] + (m.sensor_dim[contact] - 1)
        return dict(feet=feet, sole_geoms=np.stack(soles), contact_adr=address)

    def rest(self):
        """What the default pose is: the counterpart of a human who stands upright with hanging arms, facing x."""
        m, root, data = self.need("model"), self.need("root"), mujoco.MjData(self.need("model"))
        data.qpos[7:] = self.need("default")
        mujoco.mj_kinematics(m, data)
        if not np.allclose(data.xmat[root].reshape(3, 3)[:, 1], [0, 1, 0], atol=1e-6):
            self.fail_xml(f"the y axis of {m.body(root).name} must point to the left: the heading is found from it")
        lowest = geom_lowest(m, self.need("sole_geoms").ravel(), data.geom_xpos[None], data.geom_xmat[None]).min()
        return dict(rest=data.xquat.copy(), hip_height=float(data.xpos[root, 2] - lowest))

    def links(self):
        return dict(obs_links=self.bodies("observation", self.get("observation", "links", list)))

    def link_weights(self):
        """Eq. 11's weights of links."""
        links = self.get("reward", "links", dict)
        bodies, values = None, []
        with suppress(_Stop):
            bodies = self.bodies("reward.links", links)
        for name, value in links.items():
            with suppress(_Stop):
                values.append(self.number(f"[reward.links] {name}", value, 0))
        if bodies is None or len(values) < len(links):
            raise _Stop
        return dict(reward_links=bodies, link_weights=normalised(values))

    def joint_weights(self):
        """Eq. 11's weights of joint angles."""
        names, table = self.need("hinges"), self.table("reward").get("joints", {})
        if not isinstance(table, dict):
            self.fail(f"[reward] joints = {table!r} is not a table of joint = weight")
        every = names + [j for _, j in self.welded]
        groups, before = {joint_group(n) for n in every}, len(self.problems)
        for g, w in table.items():
            with suppress(_Stop):
                if g != "default" and g not in groups and g not in every:
                    self.fail(f"[reward.joints] names {g!r}; valid: default, {', '.join(sorted(groups))}, or a joint")
                self.number(f"[reward.joints] {g}", w, 0)
        # what has no human motion is not imitated (§3.5.1)
        w = [table.get(n, table.get(joint_group(n), table.get("default", 1.0))) for n in names]
        if len(self.problems) > before:
            raise _Stop
        return dict(joint_weights=normalised(np.where(self.need("mapped"), w, 0.0)))

    def rewards(self):
        """Table 2: term -> (w, k), and "fail"."""
        out = {}
        with suppress(_Stop):
            out["fail"] = self.get("reward", "fail", float)
        for term in TERMS:
            with suppress(_Stop):
                pair = self.get("reward", term, list)
                if len(pair) != 2:
                    self.fail(f"[reward] {term} = {pair!r} must be [w, k], both at least 0")
                out[term] = tuple(float(self.number(f"[reward] {term} [w, k] {v!r}", v, 0)) for v in pair)
        return dict(reward=out)

    def sites(self):
        sites = self.ids("sensors", self.get("sensors", "sites", list), mujoco.mjtObj.mjOBJ_SITE, "site")
        if len(sites) != 3:
            self.fail(f"[sensors] needs three sites (head, left, right), found {len(sites)}")
        return dict(sensor_sites=sites)

    def fall(self):
        return dict(fall_geoms=self.collision_geoms("fall", self.get("fall", "bodies", list)))

    def metrics(self):
        if self.table("metrics"):
            self.bodies("metrics", self.get("metrics", "sip", list))


def joint_group(name: str) -> str:
    """hip_l_y -> hip, spine0_y -> spine0: the name Table 4 uses, in lower case.

    Test      tests/test_characters.py::test_tables"""
    return name.split("_")[0]


def numberless(name: str) -> str:
    """spine0_y -> spine_y, spine0 -> spine: what stands for all of spine0, spine1, …

    Test      tests/test_characters.py::test_tables"""
    return re.sub(r"\d+", "", name)


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

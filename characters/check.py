"""What is wrong with a character of one's own?  Every fault in its two files, a line each, with what would be valid.

    python -m characters.check NAME | FILE.xml | FILE.toml

Of an .xml the .toml beside it is read, too.  When nothing is wrong it prints joints, limits and masses.  Loading stops
at the first fault; this asks every part of loading, and every entry of the TOML alone.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np

import character
from character import Character
from human import SEGMENTS
from plumbing import mjcf, toml
from plumbing.cli import UserError, run_main
from plumbing.toml import number


def check(name) -> list[str]:
    """Everything that is missing or does not match in a character's two files.

    Args      name : of a character, or path of its .toml or .xml
    Returns   one line a complaint, none if nothing is wrong
    Method    every part of loading is asked, and goes on where one before it failed: with a model without the parts
              that it could not be made of; then every entry of the TOML alone
    Raises    UserError: no such file
    Test      tests/test_characters.py::test_check_names_everything, tests/test_check.py::test_every_mistake
    """
    path = Path(name)
    xml = path if path.suffix == ".xml" else None
    if xml and not xml.is_file():
        raise UserError(f"no file {xml}; give a character's .xml or .toml, or its name")
    c = SimpleNamespace(path=xml.with_suffix(".toml") if xml else character.toml_of(name), variant={}, size=1.0)
    found = tables_and_file(c, xml)
    if hasattr(c, "xml"):
        found += whole_model(c)
    if c.spec is None:  # no TOML that can be read: nothing more is known
        return list(dict.fromkeys(found))
    for part in character.PARTS[4:]:
        found += complaint(c, part, c) if part is not character.skeleton else skeleton(c)
        if part is character.default_pose and hasattr(c, "hinges") and not hasattr(c, "default"):
            c.default = np.zeros(len(c.hinges))
    if xml and hasattr(c, "xml") and not c.xml.samefile(xml):
        found.append(f"{c.path}: its model is {c.xml.name}, not {xml.name}")
    found += [str(character.fault(c, text)) for text in faults_of_entries(c)]
    return list(dict.fromkeys([*found, *loose_hinges(c), *own_contacts(c)]))


def tables_and_file(c, xml) -> list[str]:
    """The TOML, and where the model is; where it says none, the one that there is."""
    if not c.path.is_file():
        c.xml, c.spec = xml, {}
        return [f"{c.path}: is not there", *complaint(c, character.tables, c)]
    c.spec = None
    found = complaint(c, character.entries, c)
    if c.spec is not None:
        found += complaint(c, character.tables, c)
        found += complaint(c, character.mjcf_file, c)
    if not hasattr(c, "xml") or not c.xml.is_file():
        there = [xml] if xml else [c.path.with_suffix(".xml"), *sorted(c.path.parent.glob("*.xml"))]
        there = [file for file in there if file.is_file()]
        if there and (there[0] == c.path.with_suffix(".xml") or len(there) == 1):
            c.xml = there[0]
        elif hasattr(c, "xml"):
            del c.xml
    return found


def whole_model(c) -> list[str]:
    """The model, or what is left of it without the parts that no model can be made of; the floor."""
    found = []
    try:
        spec = character.bare(c)
        for says, mend in list(mjcf.broken_parts(spec)):
            found.append(f"{c.xml}: {says}")
            if mend:
                mend()
        c.model = mjcf.made(spec, c.xml)
    except UserError as error:
        return [*found, str(error)]
    return found if c.spec is not None else found + skeleton(c) + complaint(c, character.floor, c)


def skeleton(c) -> list[str]:
    """Joints and motors; what was found of them is kept if the other parts can go on with it."""
    if not hasattr(c, "model"):
        return []
    m = c.model
    hinges, motors = list(mjcf.hinge_faults(m)), list(mjcf.motor_faults(m)) if m.njnt else []
    names, ranges = mjcf.hinges_as_they_are(m)
    kinds = mujoco.mjtJoint
    if all(names) and m.njnt > 1 and [*m.jnt_type] == [kinds.mjJNT_FREE] + [kinds.mjJNT_HINGE] * (m.njnt - 1):
        c.hinges, c.ranges = names, ranges
        if not motors:
            c.driven = m.actuator_trnid[:, 0] - 1
    return [f"{c.xml}: {says}" for says in hinges + motors]


def loose_hinges(c):
    """Hinges that nothing holds."""
    for k, name in enumerate(getattr(c, "hinges", ())):
        if name not in c.motored and c.model.jnt_stiffness[1 + k] == 0:
            valid = "valid: a <motor>, or stiffness and damping of its own"
            yield f"{c.xml}: hinge {name} has neither a motor nor a spring; {valid}"


def complaint(c, function, *args) -> list[str]:
    """What a part of loading says, in a list; nothing where it wants what an earlier part could not find."""
    try:
        function(*args)
    except UserError as error:
        return [str(error)]
    except AttributeError as error:
        if error.obj is not c:
            raise
    return []


def own_contacts(c):
    """Shapes that would touch one another: contacts that cost time, and that no character of ours has."""
    if not hasattr(c, "model"):
        return
    m = c.model
    bodies = dict.fromkeys(m.body(m.geom_bodyid[g]).name for g in np.flatnonzero(m.geom_contype) if m.geom_bodyid[g])
    if bodies:
        says = f"the shapes of {', '.join(bodies)} would touch one another"
        yield f'{c.xml}: {says}; valid: contype="0" conaffinity="1", so that they touch the floor alone'


def faults_of_entries(c):
    """What is wrong with each entry of each table alone, without the file's name; names are any without a model."""
    whole, any_name = hasattr(c, "model"), toml.a_name
    known = character.schema(c) if whole else character.tables_of(*[any_name] * 6, {}, toml.Each(any_name, number))
    for name, table in c.spec.items():
        if name in known:
            yield from faults(known[name], (name,), table)
    followed = c.spec["map"] if isinstance(c.spec.get("map"), dict) else {}
    for body, said in followed.items() if whole else ():
        yield from complaint(c, follow, c, known["map"], body, said)
    if followed and not any(isinstance(said, dict) and said.get("to") == "head" for said in followed.values()):
        yield character.NO_HEAD
    yield from character.miscounted(c.spec)
    if whole:
        yield from faults_of_feet(c)


def faults_of_feet(c):
    """Soles and sensors of each foot alone."""
    said = c.spec["feet"] if isinstance(c.spec.get("feet"), dict) else {}
    bodies, sensors = mjcf.names_of(c.model, "body"), mjcf.names_of(c.model, "sensor")
    listed = [said[k] if isinstance(said.get(k), list) else [] for k in ("bodies", "contact_sensors")]
    known = lambda name, names: names.get(name) if isinstance(name, str) else None  # noqa: E731
    for name in listed[0]:
        if known(name, bodies) is not None:
            yield from complaint(None, mjcf.collision_geoms, c.model, [bodies[name]], "[feet] bodies")
    pairs = [(known(b, bodies), known(s, sensors)) for b, s in zip(*listed)]
    for b, s in pairs:
        if b is not None and s is not None:
            yield from character.watched(c.model, [b], [s])


def follow(c, schema, body, said):
    """One entry of the joint map, followed."""
    for b, entry in toml.read(schema, ("map",), {body: said}).items():
        character.chain(c, b, entry)


def faults(schema, place, value):
    """What is wrong with the entries of a table or list, then with itself; a fault may come twice."""
    inner = []
    if isinstance(schema, toml.Each) and isinstance(value, dict):
        inner = [(schema.name, (*place, key), key) for key in value]
        inner += [(schema.value, (*place, key), v) for key, v in value.items()]
        yield from complaint(None, toml.check_needs, schema, place, [key.lower() for key in value])
    elif isinstance(schema, dict) and isinstance(value, dict):
        kinds = {key: toml.kind_of_key(schema, key) for key in value}
        inner = [(kinds[key], (*place, key), v) for key, v in value.items() if kinds[key]]
    elif isinstance(schema, list) and isinstance(value, list) and len(value) > 1:
        inner = [(schema, place, [v]) for v in value]
    for each in inner:
        yield from faults(*each)
    yield from complaint(None, toml.read, schema, place, value)


def mirrored(name) -> str | None:
    """The other side's hinge: hip_r_y -> hip_l_y, left_knee -> right_knee.  Test: as `summary`"""
    for a, b in (("_r_", "_l_"), ("_l_", "_r_"), ("right_", "left_"), ("left_", "right_")):
        if a in name:
            return name.replace(a, b)
    return None


def summary(char: Character) -> str:
    """Joints, limits and masses as text; left and right in one line.

    Test      tests/test_characters.py::test_check_command"""
    m = char.model
    lines = [
        f"{char.name}: {m.body_subtreemass[0]:.1f} kg, {char.height:.2f} m tall, hips {char.hip_height:.2f} m up; "
        f"{m.nbody - 1} links, {char.j} hinges, {len(char.driven)} driven, {m.nv} degrees of freedom",
        "hinge           limit N m  spring N m/rad  range rad      weight  follows",
    ]
    limits = dict(zip(char.driven, char.limits, strict=True))
    follows = {h: SEGMENTS[f.end] for f in char.chains for h in f.hinges}
    weight = char.joint_weights / max(char.joint_weights.max(), 1e-9)
    for h, name in enumerate(char.hinges):
        if mirrored(name) not in char.hinges[:h]:
            low, high = char.ranges[h]
            lines.append(
                f"{name:14s} {limits.get(h, 0.0):10.2f} {m.jnt_stiffness[1 + h]:15.2f}  {low:6.2f} {high:6.2f}  "
                f"{weight[h]:6.2f}  {follows.get(h, 'nobody: passive' if h not in limits else 'nobody')}"
            )
    masses = {m.body(b).name: float(m.body_mass[b]) for b in range(1, m.nbody)}
    lines.append("kg: " + ", ".join(f"{n} {kg:.2f}" for n, kg in masses.items() if not n.endswith("_r")))
    return "\n".join(lines)


def main(argv=None) -> int:
    """Print all that is wrong with a character, or else its joints and masses.  -> exit status, 1 if anything is

    Test      tests/test_characters.py::test_check_command"""
    if argv in (["-h"], ["--help"]):
        print(__doc__)
        return 0
    if len(argv or ()) != 1:
        raise UserError(f"python -m characters.check wants one of {', '.join(character.available())}, or one file")
    problems = check(argv[0])
    for problem in problems:
        print(problem)
    if problems:
        print(f"{len(problems)} to mend")
        return 1
    path = Path(argv[0])
    print(summary(character.load(path.with_suffix(".toml") if path.suffix == ".xml" else argv[0])))
    print("nothing is wrong")
    return 0


if __name__ == "__main__":
    run_main(main)

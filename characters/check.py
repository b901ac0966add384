"""What is wrong with a character of one's own?  Every fault in its two files, a line each, with what would be valid.

    python -m characters.check NAME | FILE.xml | FILE.toml

Of an .xml the .toml beside it is read, too.  When nothing is wrong it prints joints, limits and masses.  Loading stops
at the first fault; this asks every part of loading, and every entry of the TOML alone.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import character
from character import Character
from human import SEGMENTS
from plumbing import toml
from plumbing.cli import UserError, run_main


def check(name) -> list[str]:
    """Everything that is missing or does not match in a character's two files.

    Args      name : of a character, or path of its .toml or .xml
    Returns   one line a complaint, none if the character can be loaded
    Raises    UserError: no such file
    Test      tests/test_characters.py::test_check_names_everything
    """
    path = Path(name)
    xml = path if path.suffix == ".xml" else None
    if xml and not xml.is_file():
        raise UserError(f"no file {xml}; give a character's .xml or .toml, or its name")
    c = SimpleNamespace(path=xml.with_suffix(".toml") if xml else character.toml_of(name), variant={}, size=1.0)
    parts, found = character.PARTS, []
    if not c.path.is_file():
        c.xml, c.spec, found = xml, {}, [f"{c.path}: is not there"]
        parts = [part for part in parts if part not in (character.entries, character.mjcf_file)]
    for part in parts:
        found += complaint(c, part, c)
    if xml and hasattr(c, "xml") and c.xml.is_file() and not c.xml.samefile(xml):
        found.append(f"{c.path}: its model is {c.xml.name}, not {xml.name}")
    if hasattr(c, "model"):
        found += [str(character.fault(c, text)) for text in faults_of_entries(c)]
    return list(dict.fromkeys(found))


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


def faults_of_entries(c):
    """What is wrong with each entry of each table alone, without the file's name."""
    known = character.schema(c)
    for name, table in c.spec.items():
        if name in known:
            yield from faults(known[name], (name,), table)
    for body, said in c.spec["map"].items() if isinstance(c.spec.get("map"), dict) else ():
        yield from complaint(c, follow, c, known["map"], body, said)


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
    elif isinstance(schema, dict) and isinstance(value, dict):
        kinds = {key: toml.kind_of_key(schema, key) for key in value}
        inner = [(kinds[key], (*place, key), v) for key, v in value.items() if kinds[key]]
    elif isinstance(schema, list) and isinstance(value, list) and len(value) > 1:
        inner = [(schema, place, [v]) for v in value]
    for each in inner:
        yield from faults(*each)
    yield from complaint(None, toml.read, schema, place, value)


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
    follows = {h: SEGMENTS[c[4]] for c in char.chains for h in c[1]}
    weight = char.joint_weights / max(char.joint_weights.max(), 1e-9)
    for h, name in enumerate(char.hinges):
        if "_r_" not in name or name.replace("_r_", "_l_") not in char.hinges:
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

"""Tables of a TOML, read as a schema says: what stands there has a meaning and a kind, or one line says what is wrong.

    {"links": [body], "fail": number, "scale_z?": positive, "weights": Each(joint, at_least_0)}

A schema is a reader; [schema], a list; {key: schema}, a table, a "?" at the keys that may be left out; or Each, a table
of names.  A reader is a function of a place, such as ("torque", "base", "hip"), and of what stands there; it returns
what is meant.  The UserErrors do not name the file: whoever reads it does.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field

from plumbing.cli import UserError

LIMIT = 1e9  # no number is larger


@dataclass(frozen=True)
class Each:
    """A table whose keys are names: readers of a key and of its value, and what must be there.

    needs : what -> the keys of which one must be there for it"""

    name: object
    value: object
    needs: dict = field(default_factory=dict)


# ------------------------------------------------------------------------------------ readers


def at(place) -> str:
    """("torque", "base", "hip") -> "[torque.base] hip"."""
    return f"[{'.'.join(place[:-1])}] {place[-1]}"


def number(place, value, least=-LIMIT):
    """A finite number."""
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) <= LIMIT:
        raise UserError(f"{at(place)} = {value!r} is not a finite number of at most {LIMIT:g}")
    if value < least:
        raise UserError(f"{at(place)} = {value!r} must be at least {least}")
    return value


def at_least_0(place, value):
    """A finite number that is not negative."""
    return number(place, value, least=0)


def positive(place, value):
    """A finite number above 0."""
    if number(place, value) <= 0:
        raise UserError(f"{at(place)} = {value!r} must be greater than 0")
    return value


def share(place, value):
    """A number from 0 to 1."""
    if at_least_0(place, value) > 1:
        raise UserError(f"{at(place)} = {value!r} must be from 0 to 1")
    return value


def count(place, value):
    """A whole number above 0."""
    if not isinstance(positive(place, value), int):
        raise UserError(f"{at(place)} = {value!r} must be a whole number")
    return value


def switch(place, value):
    """true or false."""
    if not isinstance(value, bool):
        raise UserError(f"{at(place)} = {value!r} must be true or false")
    return value


def number_or(*words):
    """Reader of a number above 0, or of one of some words."""

    def reader(place, value):
        if isinstance(value, str) and value not in words:
            valid = " or ".join(["a number", *(f'"{w}"' for w in words)])
            raise UserError(f"{at(place)} = {value!r}; valid: {valid}")
        return value if value in words else positive(place, value)

    return reader


def one_of(valid, what: str):
    """Reader of a name: the name itself, or what a table `valid` holds for it."""

    def reader(place, value):
        a_name(place, value)
        if value not in valid:
            there = ", ".join(dict.fromkeys(valid)) or "none"
            raise UserError(f"[{'.'.join(place[:-1])}] names {what} {value!r}; there are: {there}")
        return valid[value] if isinstance(valid, dict) else value

    return reader


def a_name(place, value):
    """Any name."""
    if not isinstance(value, str):
        raise UserError(f"{at(place)} = {value!r} is not a name (str)")
    return value


def any_case(reader):
    """Reader of a name in small letters, however it is written."""

    def lower(place, value):
        return reader(place, value.lower() if isinstance(value, str) else value)

    return lower


# ------------------------------------------------------------------------------------ tables


def read(schema, place, value):
    """What stands at a place, as its schema says.

    Raises    UserError: the first fault, in one line
    Test      tests/plumbing/test_toml.py::test_read, tests/test_characters.py::test_checks"""
    if isinstance(schema, list):
        if not isinstance(value, list):
            raise UserError(f"{at(place)} = {value!r} is not a list")
        return [read(schema[0], place, v) for v in value]
    if isinstance(schema, Each):
        check_table(place, value)
        found = {schema.name((*place, key), key): read(schema.value, (*place, key), v) for key, v in value.items()}
        check_needs(schema, place, found)
        return found
    if isinstance(schema, dict):
        check_keys(schema, place, value)
        return {key: read(kind_of_key(schema, key), (*place, key), v) for key, v in value.items()}
    return schema(place, value)


def check_needs(schema: Each, place, keys):
    """Nothing that must be there is missing."""
    lacking = [what for what, some in schema.needs.items() if not some & set(keys)]
    if lacking:
        raise UserError(f"[{'.'.join(place)}] has no {', '.join(lacking)}; valid: {', '.join(schema.needs)}")


def kind_of_key(schema: dict, key):
    """The schema of a table's key, None where it has none."""
    return schema.get(key, schema.get(f"{key}?"))


def check_keys(schema: dict, place, table):
    """Every key of a table means something, and none that must be there is missing.

    Args      place : () of the tables themselves"""
    check_table(place, table)
    odd = [repr(key) for key in table if not kind_of_key(schema, key)]
    lacking = [key if place else f"[{key}]" for key in schema if key not in table and not key.endswith("?")]
    says = [f"{', '.join(odd)}, which means nothing"] if odd else []
    says += [f"no {'' if place else 'table '}{', '.join(lacking)}"] if lacking else []
    if says:
        where, valid = f"[{'.'.join(place)}] " if place else "", ", ".join(key.rstrip("?") for key in schema)
        raise UserError(f"{where}has {', and '.join(says)}; valid: {valid}")


def check_table(place, value):
    """It is a table."""
    if not isinstance(value, dict):
        raise UserError(f"[{'.'.join(place)}] = {value!r} is not a table")


def with_changes(tables: dict, changes) -> dict:
    """Tables with some entries changed.

    Args      changes : ("reward.contact=[0, 1]", …), the value written as in TOML
    Raises    UserError: no such change, or a place that is in no table
    Test      tests/test_characters.py::test_set"""
    for change in changes:
        place, equals, text = (s.strip() for s in change.partition("="))
        *path, key = place.split(".")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            equals = ""
        if not (equals and path and key):
            valid = "valid is TABLE.KEY=VALUE with a value as in TOML: a.b=1, a.b=[0, 1]"
            raise UserError(f"cannot set {change!r}; {valid}")
        table = tables
        for name in path:
            table = table.setdefault(name, {}) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            raise UserError(f"cannot set {change!r}: {'.'.join(path)} is not a table; there are: {', '.join(tables)}")
        table[key] = value
    return tables

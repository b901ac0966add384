"""plumbing/toml.py: a schema reads what is meant, and says what is wrong where."""

import re

import pytest

from plumbing import toml
from plumbing.cli import UserError

NAME = toml.one_of({"head": 3, "foot": 7}, "body")
SCHEMA = {
    "links": [NAME],
    "fail": toml.number,
    "scale?": toml.number_or("hip"),
    "weights?": toml.Each(toml.any_case(NAME), toml.at_least_0, {"head": {"head", 3}}),
}


def test_read():
    """Names become what they stand for; a key with a question mark may be left out."""
    found = toml.read(SCHEMA, ("t",), {"links": ["foot", "head"], "fail": -5, "weights": {"Head": 0.5, "foot": 0}})
    assert found == {"links": [7, 3], "fail": -5, "weights": {3: 0.5, 7: 0}}
    assert toml.read(SCHEMA, ("t",), {"links": [], "fail": 1.0, "scale": "hip"})["scale"] == "hip"


@pytest.mark.parametrize("table,says", [
    (3, "[t] = 3 is not a table"),
    ({"links": []}, "[t] has no fail; valid: links, fail, scale, weights"),
    ({"links": [], "fale": 1}, "[t] has 'fale', which means nothing, and no fail; valid"),
    ({"links": "foot", "fail": 1}, "[t] links = 'foot' is not a list"),
    ({"links": [1], "fail": 1}, "[t] links = 1 is not a name"),
    ({"links": ["hand"], "fail": 1}, "[t] names body 'hand'; there are: head, foot"),
    ({"links": [], "fail": True}, "[t] fail = True is not a finite number"),
    ({"links": [], "fail": float("nan")}, "[t] fail = nan is not a finite number"),
    ({"links": [], "fail": 1, "scale": "hop"}, '[t] scale = \'hop\'; valid: a number or "hip"'),
    ({"links": [], "fail": 1, "scale": 0}, "[t] scale = 0 must be greater than 0"),
    ({"links": [], "fail": 1, "weights": {"hand": 1}}, "[t.weights] names body 'hand'"),
    ({"links": [], "fail": 1, "weights": {"foot": -1}}, "[t.weights] foot = -1 must be at least 0"),
    ({"links": [], "fail": 1, "weights": {"foot": 1}}, "[t.weights] has no head; valid: head"),
])  # fmt: skip
def test_faults(table, says):
    """The first one, in one line."""
    with pytest.raises(UserError, match=re.escape(says)):
        toml.read(SCHEMA, ("t",), table)


def test_tables_themselves():
    """The tables of a file have no name."""
    with pytest.raises(UserError, match=r"^has 'q', which means nothing, and no table \[a\]; valid: a, b$"):
        toml.check_keys({"a": True, "b?": True}, (), {"q": {}})


@pytest.mark.parametrize("reader,good,bad", [
    (toml.positive, 0.5, (0, -1, "1", True)),
    (toml.count, 3, (0, 1.0, 2.5, False)),
    (toml.share, 1, (-0.1, 1.1)),
    (toml.switch, True, (1, "yes")),
])  # fmt: skip
def test_readers(reader, good, bad):
    assert reader(("t", "k"), good) is good
    for value in bad:
        with pytest.raises(UserError, match=r"\[t\] k = "):
            reader(("t", "k"), value)


def test_with_changes():
    """Entries are changed where they are, and made where there are none."""
    tables = {"a": {"b": 1}}
    assert toml.with_changes(tables, ["a.b=[0, 1]", "c.d.e = 'x'"]) == {"a": {"b": [0, 1]}, "c": {"d": {"e": "x"}}}
    for bad in ("b=1", "a.b", "a.b.c=1", "a.b=[1"):
        with pytest.raises(UserError, match="cannot set"):
            toml.with_changes({"a": {"b": 1}}, [bad])

"""The documents against the code and the tests: every name they give exists, and nothing they owe is missing.

There are three REPRODUCE.md: the paper's at the top, DROP's in drop/, the skeleton-aware networks' in skeletal/.  The
ids of the wings begin with DROP and SAN.
Part 1's table is `id | what | code | test`.  `code` holds `module.name` or `file.toml [table] key`, `test` holds
`tests/test_x.py::test_a`; a row without a test says `not yet`, `not run yet` or `missing`.  Part 2's tables are
`id | not said | choice | where | why`.
All documents: prose that can be read in an editor, and commands that exist.
"""

import ast
import dataclasses
import importlib
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
WINGS = ("characters", "mocap", "headset", "drop", "skeletal", "web", "extras", "plumbing")
FILES = sorted([*ROOT.glob("*.py"), *(f for wing in WINGS for f in (ROOT / wing).rglob("*.py"))])
MODULES = [".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for f in FILES]
PATHS = dict(zip(MODULES, FILES, strict=True))
OPEN = ("not yet", "not run yet", "missing")
REPRODUCE = {"": "REPRODUCE.md", "DROP": "drop/REPRODUCE.md", "SAN": "skeletal/REPRODUCE.md"}  # prefix of ids -> file
DOCUMENTS = [str(f.relative_to(ROOT)) for f in sorted([*ROOT.glob("*.md"), *ROOT.glob("[a-z]*/*.md")])]
LONGEST_LINE, LARGEST = 160, 60_000  # characters of a line of prose; bytes of REPRODUCE.md

REQUIRED = (
    *(f"Eq. {k}" for k in range(1, 12)),
    *("App. B experience", "App. B value recursion", "App. B bootstrap", "App. B advantage", "App. B loss"),
    *("App. B ratio", "App. B value loss"),
    *("Table 1", "Table 2", "Table 3", "Table 4"),
    *("§3.3 frame", "§3.3 heading", "§3.3 asymmetric critic", "§3.4 sensors", "§3.4 kinematic retargeting"),
    *("§3.4 scaled root", "§3.5 orientation", "§3.5 contact", "§3.5 not imitated"),
    *("contact 0.20 m", "contact 0.4 m/s", "contact 1 N"),
    *("§3.6 upper body", "§3.6 0.30 m", "§3.6 500 steps", "§3.6 clip end", "§3.6 fail −5"),
    *("§3.6 reference-state initialisation", "§3.7 actions", "§3.7 passive joints"),
    *(f"§4, §5 point {k}" for k in range(1, 10)),
    *(f"metric {m}" for m in (
        "completed", "survival", "root_cm", "head_cm", "hands_cm", "joint_pos_cm", "head_deg", "joint_rot_deg",
        "sip_deg", "foot_slide_cm_s", "penetration_mm", "contact_agreement", "jitter_m_s3", "steps_per_m",
        "head_wobble_deg_s", "torque_rms", "saturation", "streamed", "own_slide_cm_s", "self_penetration_mm",
        "spring_share", "fails_every_s", "first_failure_s", "mpjpe_cm", "mpjve_cm_s",
        "root_pe, hand_pe, upper_pe, lower_pe", "mpjre_deg", "jitter_km_s3", "success_phc", "success_height",
    )),
    *(f"DROP Eq. {k}" for k in range(1, 17)),
    *("DROP Algorithm 1", "DROP §7 rotations"), *(f"DROP §8.{k}" for k in (1, 2, 3, 4, 5, 7)),
    *(f"SAN-{k}" for k in range(1, 9)),
    *(f"SAN §{s}" for s in ("4.1", "4.2 static branch", "4.3 unpooling", "3 primal skeleton", "4.4", "5.2 networks")),
    *("SAN §5 training", "SAN §5.2 clean-up", "SAN metric"),
)  # fmt: skip
# Missing, or experiments: these need no code and no test.
MAY_BE_OPEN = ("Table 1", "Table 3", "§4, §5")

GAPS = (  # every GAP and ASSUMED of the specification, in its order
    "advantage", "lambda", "Table 3", "Table 1", "previous user frame", "root scale axes", "link weights",
    "weight normalisation", "contact distance", "orientation kernel", "orientation rest offset",
    "termination distance", "fail reward", "base torque", "clipped actions",
)  # fmt: skip


# ------------------------------------------------------------------------------------ reading


def document_of(row_id: str) -> str:
    """Prefix of the document that a row belongs to: DROP, SAN, or nothing for the paper's own."""
    return next((prefix for prefix in REPRODUCE if prefix and row_id.startswith(prefix)), "")


@cache
def part(number: int, document: str) -> str:
    """Text of a numbered part of a document, given by its prefix."""
    file = REPRODUCE[document]
    text = (ROOT / file).read_text(encoding="utf-8")
    found = re.search(rf"^## {number}\. .*?(?=^## \d+\. |\Z)", text, re.M | re.S)
    assert found, f"{file} has no part '## {number}. …'"
    return found[0]


@cache
def rows(number: int, document: str | None = None) -> tuple:
    """Cells of all table rows of a part, headers and rules left out; of one document, or of all three."""
    if document is None:
        return tuple(row for each in REPRODUCE for row in rows(number, each))
    out = []
    for line in part(number, document).splitlines():
        cells = [c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]]
        if cells and not set(cells[0]) <= set("-: ") and cells[0] != "id":
            out.append(tuple(cells))
    return tuple(out)


def quoted(cell: str) -> list:
    """The names between backticks."""
    return re.findall(r"`([^`]+)`", cell)


@cache
def parsed(path: Path) -> ast.Module:
    """Syntax tree of a Python file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def functions_in(name: str) -> frozenset:
    """Names of the test functions of tests/NAME; empty where the file is missing."""
    path = ROOT / "tests" / name
    if not path.is_file():
        return frozenset()
    return frozenset(
        n.name for n in ast.walk(parsed(path)) if isinstance(n, ast.FunctionDef) and n.name.startswith("test_")
    )


def missing_test(name: str) -> str | None:
    """Complaint about a name such as tests/test_x.py::test_a, or None."""
    file, _, function = name.removeprefix("tests/").partition("::")
    if not (ROOT / "tests" / file).is_file():
        return f"{name}: there is no tests/{file}"
    if function and function not in functions_in(file):
        return f"{name}: tests/{file} has no such test"
    return None


def missing_code(name: str) -> str | None:
    """Complaint about `module.name.name` or `file.toml [table] key`, or None."""
    if found := re.fullmatch(r"(\S+\.toml)(?: \[([\w.]+)\](?: (\w+))?)?", name):
        path, table, key = found.groups()
        if not (ROOT / path).is_file():
            return f"{name}: no such file"
        value = tomllib.loads((ROOT / path).read_text(encoding="utf-8"))
        for k in [*(table.split(".") if table else []), *([key] if key else [])]:
            if not isinstance(value, dict) or k not in value:
                return f"{name}: no {k!r}"
            value = value[k]
        return None
    if name.endswith((".xml", ".py", ".lock", ".toml")):
        return None if (ROOT / name).is_file() else f"{name}: no such file"
    parts = name.split(".")
    k = next((k for k in range(len(parts), 0, -1) if ".".join(parts[:k]) in PATHS), 0)
    if not k:
        return f"{name}: no module; there are {', '.join(MODULES)}"
    module, attributes = ".".join(parts[:k]), parts[k:]
    value = importlib.import_module(module)
    for a in attributes:
        fields = getattr(value, "__dataclass_fields__", {})
        if hasattr(value, a):
            value = getattr(value, a)
        elif a in fields:
            value = None
        else:
            return f"{name}: {value!r} has no {a!r}"
    return None


# ------------------------------------------------------------------------------------ part 1


def test_every_row_is_complete():
    """Four cells; named code and a named test, or a word that says why not."""
    bad = []
    for row in rows(1):
        if len(row) != 4:
            bad.append(f"{row[0]}: {len(row)} cells, expected 4")
        elif any(not quoted(cell) and cell not in OPEN for cell in row[2:]):
            bad.append(f"{row[0]}: code {row[2]!r}, test {row[3]!r}; expected names, or one of {', '.join(OPEN)}")
    assert rows(1) and not bad, "\n".join(bad)


def test_rows_stand_in_their_own_document():
    """Ids that begin with DROP in drop/REPRODUCE.md, with SAN in skeletal/REPRODUCE.md, all others at the top."""
    bad = [
        f"{REPRODUCE[prefix]}: {row[0]}"
        for prefix in REPRODUCE
        for number in (1, 2)
        for row in rows(number, prefix)
        if document_of(row[0]) != prefix
    ]
    assert not bad, "in the wrong document: " + ", ".join(bad)


@pytest.mark.parametrize("wanted", REQUIRED)
def test_nothing_of_the_specification_is_missing(wanted):
    """A row for every equation, table, threshold and metric; with code and test unless it is missing or not run."""
    document = document_of(wanted)
    found = [r for r in rows(1, document) if r[0] == wanted]
    assert found, f"{REPRODUCE[document]}, part 1 has no row {wanted!r}"
    if not wanted.startswith(MAY_BE_OPEN):
        assert any(quoted(r[2]) and quoted(r[3]) for r in found), f"{wanted} has no code or no test: {found}"


def test_named_code_exists():
    """Parts 1 and 2 of every document."""
    names = {n for row in rows(1) for n in quoted(row[2])} | {n for row in rows(2) for n in quoted(row[3])}
    bad = sorted(filter(None, map(missing_code, names)))
    assert names and not bad, "\n".join(bad)


def test_named_tests_exist():
    """Part 1 of every document."""
    names = {n for row in rows(1) for n in quoted(row[3])}
    bad = sorted(filter(None, map(missing_test, names)))
    assert names and not bad, "\n".join(bad)


def test_every_equations_test_is_named():
    """tests/test_equations.py is to be read beside the paper: part 1 leads to each of its tests."""
    named = {n for row in rows(1, "") for n in quoted(row[3])}
    missing = [t for t in sorted(functions_in("test_equations.py")) if f"tests/test_equations.py::{t}" not in named]
    assert not missing, f"REPRODUCE.md, part 1 does not name {missing}"


# ------------------------------------------------------------------------------------ part 2


def test_every_gap_is_listed_in_order():
    """The specification's gaps, in its order, each with a choice, a place and a reason."""
    ids = [r[0] for r in rows(2, "")]
    missing = [g for g in GAPS if g not in ids]
    assert not missing, f"REPRODUCE.md, part 2 lacks {missing}"
    assert [i for i in ids if i in GAPS] == list(GAPS), "the gaps are not in the specification's order"
    bad = [r[0] for r in rows(2) if len(r) != 5 or not all(r[1:])]
    assert not bad, f"rows without five filled cells: {bad}"


def assumptions_of_python(path: Path):
    """(line, names one of which must be listed) of every ASSUMED: of the top-level symbol it stands in or before."""
    body = parsed(path).body
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if "ASSUMED" not in line:
            continue
        node = next((n for n in body if number <= n.end_lineno), None)
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names = [node.name]
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
        else:
            names = []
        module = MODULES[FILES.index(path)]
        yield number, [f"{module}.{n}" for n in names] or [str(path.relative_to(ROOT))]


def assumptions_of_toml(path: Path):
    """(line, [table that must be listed]) of every ASSUMED."""
    relative, table = path.relative_to(ROOT), ""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if found := re.match(r"\[([\w.]+)\]", line):
            table = f" [{found[1]}]"
        if "ASSUMED" in line:
            yield number, [f"{relative}{table}"]


def test_every_assumed_is_listed():
    """A word ASSUMED in the code obliges part 2 to name the function, constant or table it stands in.

    What stands in drop/ or skeletal/ may be named in that wing's REPRODUCE.md; all else in the one at the top."""
    listed = {prefix: {n for row in rows(2, prefix) for n in quoted(row[3])} for prefix in REPRODUCE}
    wing = {Path(file).parent.name: prefix for prefix, file in REPRODUCE.items() if prefix}
    bad = []
    sources = [(p, assumptions_of_python(p)) for p in FILES]
    sources += [(p, assumptions_of_toml(p)) for p in sorted((ROOT / "characters").glob("*.toml"))]
    for path, found in sources:
        where = path.relative_to(ROOT)
        names = listed[""] | listed[wing.get(where.parts[0], "")]
        for line, want in found:
            if not any(n == w or n.startswith((w + ".", w + " ")) for n in names for w in want):
                bad.append(f"{where}:{line}: {' or '.join(want)}")
    assert not bad, "part 2 does not name\n" + "\n".join(bad)


# ------------------------------------------------------------------------------------ sizes and commands


@pytest.mark.parametrize("document", DOCUMENTS)
def test_no_section_twice(document):
    """A section pasted twice tells two stories; LOG.md has its experiments by date."""
    text = (ROOT / document).read_text()
    headings = re.findall(r"^#{1,3} .*$", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S), flags=re.M)
    assert [h for h in set(headings) if headings.count(h) > 1] == []


def test_reproduce_is_short():
    """The paper's own document can be read in one sitting."""
    size = (ROOT / "REPRODUCE.md").stat().st_size
    assert size <= LARGEST, f"REPRODUCE.md has {size} bytes; valid: at most {LARGEST}: results go to RESULTS.md, LOG.md"


def prose(text: str):
    """(number, line) of a document without its tables, fenced blocks and indented blocks."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced and not line.startswith(("|", "    ")):
            yield number, line


@pytest.mark.parametrize("document", DOCUMENTS)
def test_lines_of_prose_are_short(document):
    """A line of prose fits an editor's window; tables and code may be wider."""
    text = (ROOT / document).read_text(encoding="utf-8")
    bad = [f"{document}:{n}: {len(line)} characters" for n, line in prose(text) if len(line) > LONGEST_LINE]
    assert not bad, "\n".join(bad)


def commands(text: str) -> list:
    """The commands of a document that run a program of ours: between backticks, or in an indented or fenced block.

    `python FILE.py …`, `python -m PACKAGE.MODULE …`; a backslash at a line's end continues it."""
    text = re.sub(r"\\\n\s*", " ", text)
    paragraphs = "\n".join(line for _, line in prose(text)) + "\n" + "\n\n".join(re.findall(r"^\|.*", text, re.M))
    spans = [span for each in re.split(r"\n\s*\n", paragraphs) for span in quoted(each)]
    fenced = re.findall(r"^```[^\n]*\n(.*?)^```", text, re.M | re.S)
    lines = re.findall(r"^    +(\S.*)$", text, re.M) + [line for block in fenced for line in block.splitlines()]
    out = []
    for line in [*(" ".join(s.split()) for s in spans), *lines]:
        for found in re.finditer(r"\bpython ((?:-m [\w.]+|[\w./]+\.py)\b[^&;|#]*)", line):
            if not found[1].startswith(("-m pip", "-m pytest")):
                out.append(found[1].strip())
    return out


@cache
def flags_of(program: str) -> frozenset | None:
    """Flags that a program knows, from the dataclasses and the texts of its module or package; None: no such program.

    program : FILE.py, or PACKAGE or PACKAGE.MODULE after -m"""
    if program.endswith(".py"):
        names = [program.removesuffix(".py").replace("/", ".")]
    elif f"{program}.__main__" in PATHS:  # a package: any of its modules may read the flag
        names = [m for m in MODULES if m == program or m.startswith(program + ".")]
    else:
        names = [program]
    if any(name not in PATHS for name in names):
        return None
    found = set()
    for name in names:
        for value in vars(importlib.import_module(name)).values():
            if dataclasses.is_dataclass(value) and isinstance(value, type):
                found |= {f.name.replace("_", "-") for f in dataclasses.fields(value) if "help" in f.metadata}
        found |= set(re.findall(r"[\"']--([a-z][a-z-]+)[\"']", PATHS[name].read_text(encoding="utf-8")))
    return frozenset(found | {"help"} | ({"joint-map", "unit", "up"} if program == "mocap" else set()))


def wrong_command(command: str) -> str | None:
    """Complaint about a command, or None."""
    words = command.removeprefix("-m ").split()
    known = flags_of(words[0])
    if known is None:
        return f"python {command}: there is no {words[0]}"
    given = {w.split("=")[0].strip("[](),.:").removeprefix("--") for w in words[1:] if re.match(r"[\[(]*--[a-z]", w)}
    unknown = sorted(g for g in given if g not in known and g.removeprefix("no-") not in known)
    return f"python {command}: no flag {', '.join('--' + u for u in unknown)}" if unknown else None


def test_commands_reader():
    """The reader itself, on the spellings in use."""
    text = (
        "Run `python ppo.py --character jesse\n--out runs/a` or `OMP_NUM_THREADS=1 python -m extras.bench --drop`.\n\n"
        "    python -m pip install -e . && python metrics.py --motion A \\\n        --half report    # all of it\n"
    )
    wanted = ["ppo.py --character jesse --out runs/a", "-m extras.bench --drop", "metrics.py --motion A --half report"]
    assert [" ".join(c.split()) for c in commands(text)] == wanted
    assert not any(map(wrong_command, wanted))
    assert wrong_command("-m drop push --prior vae --no-correction") is None
    assert "no flag --nothing" in wrong_command("metrics.py --nothing 1")
    assert "there is no" in wrong_command("nowhere.py") and "there is no" in wrong_command("-m nowhere")


@pytest.mark.parametrize("document", [d for d in DOCUMENTS if d != "LOG.md"])
def test_commands_exist(document):
    """Programs and flags; LOG.md is history, whose flags may be gone."""
    bad = [c for c in map(wrong_command, commands((ROOT / document).read_text(encoding="utf-8"))) if c]
    assert not bad, f"{document}:\n" + "\n".join(bad)


# ------------------------------------------------------------------------------------ docstrings


def docstrings(module: str):
    """(qualified name, docstring) of a module and all that is in it."""
    tree = parsed(PATHS[module])
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.FunctionDef, ast.ClassDef)) and ast.get_docstring(node):
            yield f"{module}.{getattr(node, 'name', '')}".rstrip("."), ast.get_docstring(node)


def promised_tests(text: str) -> list:
    """Names on the `Test` lines of a docstring, written in full.

    A line is `Test  tests/test_x.py::test_a, test_b`; the folder and the file may be left out after the first."""
    out = []
    for found in re.finditer(r"\bTest:?\s+((?:tests/)?(?:\w+/)?test_\w+\.py(?:[^\n]*,\s*\n)*[^\n]*)", text):
        file = None
        for token in found[1].split(","):
            token = token.strip().rstrip(".")
            match = re.fullmatch(r"(?:(?:tests/)?((?:\w+/)?test_\w+\.py))?(?:(?:::)?(test_\w+))?", token)
            if not match or not token:
                out.append(f"{token!r} cannot be read")
                continue
            file = match[1] or file
            out.append(f"tests/{file}" + (f"::{match[2]}" if match[2] else ""))
    return out


def test_promised_tests_reader():
    """The reader itself, on the spellings in use."""
    assert promised_tests("x.  Test: test_a.py::test_b.") == ["tests/test_a.py::test_b"]
    text = "Test   tests/test_a.py::test_b, ::test_c,\n       test_d, test_e.py::test_f\nmore"
    wanted = ["a.py::test_b", "a.py::test_c", "a.py::test_d", "e.py::test_f"]
    assert promised_tests(text) == [f"tests/test_{w}" for w in wanted]
    assert promised_tests("Test   tests/test_a.py") == ["tests/test_a.py"]
    assert "cannot be read" in promised_tests("Test   tests/test_a.py::test_b and more")[0]
    assert missing_test("tests/test_docs.py::test_promised_tests_reader") is None
    assert missing_test("tests/test_docs.py::test_nothing") and missing_test("tests/test_nowhere.py")
    assert missing_code("ppo.gae") is None and missing_code("env.Env.step") is None
    assert missing_code("characters/jesse.toml [reward] q") is None
    assert missing_code("ppo.nothing") and missing_code("nowhere.gae")
    assert missing_code("characters/jesse.toml [nothing]") and missing_code("nowhere.toml [reward]")


@pytest.mark.parametrize("module", MODULES)
def test_docstrings_name_real_tests(module):
    """Every `Test` line of a product module."""
    bad = [
        f"{where}: {problem}"
        for where, text in docstrings(module)
        for name in promised_tests(text)
        if (problem := name if "cannot be read" in name else missing_test(name))
    ]
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("module", MODULES)
def test_public_names_have_docstrings(module):
    """Functions and classes of a product module, and the module itself."""
    tree = parsed(PATHS[module])
    bad = [] if ast.get_docstring(tree) else [module]
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            if not ast.get_docstring(node):
                bad.append(f"{module}.{node.name} (line {node.lineno})")
    assert not bad, "without a docstring: " + ", ".join(bad)


# ------------------------------------------------------------------------------------ the house

ORDER = (  # a module imports only what stands on a line above its own, or in its own wing
    ("plumbing", "nn", "human"),
    ("mocap", "character"),
    ("retarget",),
    ("env",),
    ("policy",),
    ("ppo", "headset"),
    ("metrics",),
    ("play",),
    ("characters", "drop", "skeletal", "web"),
    ("extras",),
)
BESIDE = {
    "drop": ("human", "mocap", "nn", "plumbing"),
    "skeletal": ("human", "mocap", "nn", "plumbing", "character", "retarget"),
}
RANK = {name: k for k, names in enumerate(ORDER) for name in names}


def imports_of(path: Path):
    """(line, module of ours) of every import in a file, also in a function."""
    for node in ast.walk(parsed(path)):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [node.module]
            names += [f"{node.module}.{a.name}" for a in node.names if f"{node.module}.{a.name}" in PATHS]
        for name in names:
            if name.split(".")[0] in {m.split(".")[0] for m in MODULES}:
                yield node.lineno, name


def test_imports_run_one_way(capsys):
    """No import from below up, and the graph is printed; the wings of other papers stand on the ground alone."""
    bad, graph = [], {}
    for module, path in PATHS.items():
        own = module.split(".")[0]
        for line, name in imports_of(path):
            other = name.split(".")[0]
            if other == own:
                continue
            graph.setdefault(own, set()).add(other)
            allowed = BESIDE.get(own, [n for n, rank in RANK.items() if rank < RANK[own]])
            if other not in allowed:
                bad.append(f"{path.relative_to(ROOT)}:{line}: {own} imports {name}")
    with capsys.disabled():
        print("\n" + "\n".join(f"  {k} < {', '.join(sorted(graph.get(k, ())))}" for k in RANK))
    assert not bad, "\n".join(bad)


LONGEST_FILE = {"ppo.py": 450, "env.py": 600}  # lines; of any other file 800


def test_files_are_one_sitting():
    """Nine files at the top, and none that a reader cannot bear."""
    assert len(list(ROOT.glob("*.py"))) == 9
    sizes = {str(p.relative_to(ROOT)): len(p.read_text(encoding="utf-8").splitlines()) for p in FILES}
    bad = [f"{name}: {n} lines" for name, n in sizes.items() if n > LONGEST_FILE.get(name, 800)]
    assert not bad, "\n".join(bad)


def private_names_of(path: Path):
    """(line, name) of every name with an underscore that a file takes from another module of ours."""
    ours, modules = {m.split(".")[0] for m in MODULES}, {}
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            modules |= {a.asname or a.name: a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in ours:
            modules |= {a.asname or a.name: a.name for a in node.names}
            yield from ((node.lineno, a.name) for a in node.names if re.match(r"_(?!_)", a.name))
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Attribute) and re.match(r"_(?!_)", node.attr) and ast.unparse(node.value) in modules:
            yield node.lineno, ast.unparse(node)


def test_private_names_stay_at_home():
    """A name that begins with an underscore is used in its own file alone."""
    bad = [f"{p.relative_to(ROOT)}:{line}: {name}" for p in FILES for line, name in private_names_of(p)]
    assert not bad, "\n".join(bad)


def test_no_circles():
    """Between files, whatever the wing."""
    edges = {m: {n for _, n in imports_of(p) if n in PATHS and n != m} for m, p in PATHS.items()}
    seen, done = [], set()

    def visit(m):
        assert m not in seen, "circle: " + " -> ".join([*seen[seen.index(m) :], m])
        if m in done:
            return
        seen.append(m)
        for n in sorted(edges[m]):
            visit(n)
        seen.pop()
        done.add(m)

    for m in MODULES:
        visit(m)

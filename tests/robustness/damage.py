"""Damage to files: strategies that cut, splice, rename, double and encode anew; numbers that are none, claims, pickles.

Of text, of JSON, of arrays (.npz), and of binary replays (BSOR)."""

import copy
import io
import json
import re
import struct
import warnings
import zipfile

import numpy as np
from hypothesis import strategies as st

# ---------------------------------------------------------------- text

NUMBERS = [
    b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e999", b"1e-308", b"0", b"-1", b"0.5", b"1000000", b"9" * 5000,
    b"1000000000000", b"-1000000000000", b"99999999999999999999999", b"1_000", b"1,5", b"0x1F", b"--3", b"+",
    "\u0661".encode(), b"", b"1e9", b"-180", b"true",
]  # fmt: skip
PIECES = [
    b"", b"{", b"}", b"[", b"]", b'"', b"'", b"=", b"#", b",", b":", b"\\", b"\n", b"\r", b"\t", b"\0", b"\xff", b"<",
    b">", b"&#0;", b"\x1b[2J", b"\xef\xbb\xbf", b"end", b"root", b"z" * 3000, "\u2028".encode(), b"\xe9", b"[" * 2000,
    b"{" * 500, b"a." * 400 + b"a=1\n", b'{"a":' * 2000,
]  # fmt: skip
NUMBER, WORD = rb"(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?(?![\w.])", rb"[A-Za-z_]\w*"


def cut(draw, raw):
    return raw[: draw(st.integers(0, len(raw)))]


def splice(draw, raw):
    at = draw(st.integers(0, len(raw)))
    return raw[:at] + draw(st.sampled_from(PIECES) | st.binary(max_size=8)) + raw[at + draw(st.integers(0, 40)) :]


def exchange(draw, raw, pattern, others):
    """One of what matches, replaced."""
    found = list(re.finditer(pattern, raw))
    if not found:
        return raw
    one = found[draw(st.integers(0, len(found) - 1))]
    return raw[: one.start()] + draw(st.sampled_from(others)) + raw[one.end() :]


def number(draw, raw):
    return exchange(draw, raw, NUMBER, NUMBERS)


def rename(draw, raw):
    """A word becomes another of the file's: joints, keys and columns of another name, and there twice."""
    return exchange(draw, raw, WORD, sorted(set(re.findall(WORD, raw))) or [b"a"])


def lines(draw, raw):
    """Lines gone, doubled, moved, repeated very often."""
    rows = raw.split(b"\n")
    a, b = (draw(st.integers(0, len(rows) - 1)) for _ in range(2))
    small = len(raw) < 2**18  # what was repeated 500 times is not repeated so again: memory
    what = draw(st.sampled_from(["gone", "span", "swap", "double", *(["often", "long"] if small else [])]))
    if what == "gone":
        del rows[a]
    elif what == "span":
        del rows[min(a, b) : max(a, b)]
    elif what == "swap":
        rows[a], rows[b] = rows[b], rows[a]
    elif what == "double":
        rows.insert(b, rows[a])
    elif what == "often":
        rows[a:a] = [rows[b]] * 500
    else:
        rows[a] = rows[a] * 500
    return b"\n".join(rows)


def encoding(draw, raw):
    codes = ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "utf-7", "cp500")
    how = draw(st.sampled_from([*codes, "crlf", "cr", "upper", "no end", "spaces"]))
    if how in codes:
        return raw.decode("latin-1").encode(how)
    return {"crlf": raw.replace(b"\n", b"\r\n"), "cr": raw.replace(b"\n", b"\r"), "upper": raw.upper(),
            "no end": raw.rstrip(), "spaces": raw.replace(b" ", b"\t \t")}[how]  # fmt: skip


MOVES = (cut, splice, splice, number, number, number, rename, rename, lines, lines, encoding)


@st.composite
def damaged(draw, raw, *more):
    """Damage to a text, mostly once, else two or three times; now and then any bytes at all."""
    if not draw(st.integers(0, 29)):
        return draw(st.binary(max_size=300))
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        raw = draw(st.sampled_from([*MOVES, *more]))(draw, raw)
    return raw


def inserting(text):
    """A move that puts a text between two lines."""

    def insert(draw, raw):
        rows = raw.split(b"\n")
        at = draw(st.integers(0, len(rows)))
        return b"\n".join([*rows[:at], text, *rows[at:]])

    return insert


# ---------------------------------------------------------------- JSON and arrays

VALUES = [
    None, True, -1, 0, 0.5, 1e308, 10**30, 10**59, "", "0", "nan", "a" * 500, [], [[]], {}, {"a": 1}, [1, "b"], [0],
    [-3], [10**6, 10**6], [1e9], ["8"], "builtin", float("nan"), float("inf"),
]  # fmt: skip


@st.composite
def json_damage(draw, tree):
    """One to three values of a tree replaced, gone or nested without end; as text, which is sometimes damaged again."""
    tree = json.loads(json.dumps(tree))
    for _ in range(draw(st.integers(0, 3))):
        at = tree
        while True:
            keys = list(at) if isinstance(at, dict) else list(range(len(at)))
            key = keys[draw(st.integers(0, len(keys) - 1))]
            if not (isinstance(at[key], dict | list) and at[key] and draw(st.booleans())):
                break
            at = at[key]
        what = draw(st.sampled_from(["value", "value", "value", "gone", "deep"]))
        if what == "gone" and len(at) > 1:
            del at[key]
        else:
            at[key] = copy.deepcopy(draw(st.sampled_from(VALUES))) if what == "value" else "DEEP"
    raw = json.dumps(tree).replace('"DEEP"', "[" * 3000 + "]" * 3000).encode()
    return draw(damaged(raw)) if draw(st.integers(0, 3)) == 0 else raw


def members(raw):
    """An .npz -> {name: bytes of its .npy}."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(entries, compressed=()):
    """(name, bytes) -> an .npz."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a name is there twice
        for k, (name, data) in enumerate(entries):
            archive.writestr(name, data, zipfile.ZIP_DEFLATED if k in compressed else zipfile.ZIP_STORED)
    return out.getvalue()


def npy(array, pickled=False):
    out = io.BytesIO()
    np.lib.format.write_array(out, np.asarray(array), allow_pickle=pickled)
    return out.getvalue()


def claiming(descr, shape, order=False, data=b""):
    """A .npy whose header says anything."""
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


CLAIMS = [
    ("'<f4'", "(1000000000000,)"), ("'<f8'", "(1000000,)"), ("'<f8'", "(-1,)"), ("'<f8'", "(0,)"), ("'<f8'", "(1.5,)"),
    ("'<f8'", f"({2**63},)"), ("'<f8'", f"({2**32}, {2**32}, {2**32})"), ("'<f8'", "5"), ("'<f8'", "(True,)"),
    ("'|O'", "(1,)"), ("'<U1000000000'", "(1,)"), ("'|V8'", "(1,)"), ("'V0'", "(1000000000000,)"), ("'<U0'", "(7,)"),
    ("'<M8[s]'", "()"), ("[('a', '<f8')]", "(1,)"), ("'<f8'", "(" * 90 + ")" * 90), ("'what'", "()"), ("None", "()"),
    ("'<c16'", "()"), ("'>f8'", "()"), ("__import__('os')", "()"), ("'<f8'", "(" + "1," * 40 + ")"),
    ("'<f8'", "(1L,)"), ("'<f8", "()"), ("'<f8'", "(1,"),
]  # fmt: skip
ELEMENTS = [np.nan, np.inf, -np.inf, 1e308, -1.0, 0.0, 1e30, 1e-308]


class Code:
    """Unpickled, it writes a file."""

    def __reduce__(self):
        return exec, ("open('unpickled', 'w')",)


@st.composite
def npz_damage(draw, raw):
    """An array's header, numbers, kind or name; a member gone, doubled, compressed or pickled; meta's JSON; bytes."""
    if draw(st.integers(0, 3)) == 0:
        for _ in range(draw(st.integers(1, 3))):
            raw = draw(st.sampled_from([cut, splice, encoding]))(draw, raw)
        return raw
    entries, compressed = list(members(raw).items()), ()
    k = draw(st.integers(0, len(entries) - 1))
    name, data = entries[k]
    array = np.lib.format.read_array(io.BytesIO(data))
    what = draw(st.sampled_from(["meta"] * 4 + ["element"] * 3 + ["claim"] * 2
                                + "dtype shape gone double rename deflate bomb pickle bytes".split()))  # fmt: skip
    if what == "meta":
        k, (name, data) = next((k, e) for k, e in enumerate(entries) if e[0] == "__meta__.npy")
        meta = json.loads(np.lib.format.read_array(io.BytesIO(data)).tobytes())
        entries[k] = name, npy(np.frombuffer(draw(json_damage(meta)), np.uint8))
    elif what == "element" and array.size:
        array = array.astype(array.dtype if array.dtype.kind == "f" else float)
        with np.errstate(over="ignore"):
            array.reshape(-1)[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from(ELEMENTS))
        entries[k] = name, npy(array)
    elif what == "claim":
        entries[k] = name, claiming(*draw(st.sampled_from(CLAIMS)), draw(st.booleans()), data[128:])
    elif what == "dtype":
        kind = draw(st.sampled_from(["f8", "f2", "c16", "i1", "u8", "?", "U8", "S4", ">f4", "M8[s]", "V4"]))
        with np.errstate(all="ignore"):
            entries[k] = name, npy(np.zeros(array.shape, kind))
    elif what == "shape":
        shapes = [array[..., None], array.reshape(-1)[:-1], np.zeros((0, 7)), np.zeros(()), np.repeat(array, 2)]
        entries[k] = name, npy(draw(st.sampled_from(shapes)))
    elif what == "gone":
        del entries[k]
    elif what == "double":
        entries.append(entries[k])
    elif what == "rename":
        entries[k] = draw(st.sampled_from(["a", "../x.npy", "policy.pi.npy", "a" * 5000, "\u2028.npy"])), data
    elif what == "deflate":
        compressed = (k,)
    elif what == "bomb":
        entries.append(("bomb.npy", npy(np.zeros(2**23, np.uint8))))
        compressed = (len(entries) - 1,)
    elif what == "pickle":
        entries[k] = name, npy(np.array([Code()], object), True)
    else:
        entries[k] = name, draw(damaged(data))
    return zipped(entries, compressed)


def npz_bytes(arrays, meta):
    out = zipped([(f"{name}.npy", npy(value)) for name, value in arrays.items()])
    text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    return zipped([*members(out).items(), ("__meta__.npy", npy(text))])


# ---------------------------------------------------------------- replays

INTEGERS = (0, 1, -1, 2, 7, 100, 255, 2**16, 2**24, 2**31 - 1, -(2**31))
FLOATS = (np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, 0.0, -1.0, 1e9)


@st.composite
def bsor_damage(draw, raw):
    """Numbers anywhere, bytes cut, lost, doubled or replaced; mostly once."""
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        at = draw(st.integers(0, max(len(raw) - 4, 0)) | st.integers(0, min(260, len(raw))))
        what = draw(st.sampled_from("integer integer float float cut splice gone double bytes".split()))
        if what in ("integer", "float"):
            value = draw(st.sampled_from(INTEGERS if what == "integer" else FLOATS))
            new = struct.pack("<i" if what == "integer" else "<f", value)
            raw = raw[:at] + new + raw[at + 4 :]
        elif what == "cut":
            raw = raw[:at]
        elif what == "splice":
            raw = splice(draw, raw)
        elif what == "gone":
            raw = raw[:at] + raw[at + draw(st.integers(1, 200)) :]
        elif what == "double":
            raw = raw[:at] + raw[at : at + draw(st.integers(1, 200))] + raw[at:]
        else:
            raw = raw[:at] + draw(st.binary(max_size=40)) + raw[at + draw(st.integers(0, 40)) :]
    return raw

"""mocap/amc.py and CMU's human: against matrices frame by frame, poses worked out by hand, damaged files, and
recordings.

Tests on recorded motion find it through the environment variable MOCAP_DIR; without it they are skipped.
"""

import re
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from test_mocap import rot, walk, write_as

import mocap.data
from human import FEET, SEG, SEGMENTS, contacts, heading, linear_velocity, place, quat_angle
from mocap import amc, inspect, rigs
from mocap.data import split_of
from plumbing.cli import UserError

# ---------------------------------------------------------------- another way: matrices, one frame at a time


def turn(axis, angle):
    """Rotation matrix about one coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    m = np.eye(3)
    m[i, i] = m[j, j] = c
    m[i, j], m[j, i] = -s, s
    return m


def chain(letters, angles):
    """Turns about fixed axes, the first letter first: the last stands leftmost."""
    m = np.eye(3)
    for axis, angle in zip(letters, angles):
        m = turn(axis, angle) @ m
    return m


def slow_pose(s, row):
    """Start, end and matrix of every bone by name."""
    values, starts, ends, turns = iter(row), {}, {}, {}
    for j, name in enumerate(s.names):
        dof = {d: next(values) for d in s.dofs[j]}
        c = chain(s.axis_orders[j], s.axes[j])
        spins = [d for d in s.dofs[j] if d[0] == "r"]
        own = c @ chain([d[1] for d in spins], [dof[d] for d in spins]) @ c.T
        if s.parents[j] < 0:
            turns[name], starts[name] = own, s.position + [dof.get(d, 0.0) for d in ("tx", "ty", "tz")]
        else:
            up = s.names[s.parents[j]]
            turns[name], starts[name] = turns[up] @ own, ends[up]
        ends[name] = starts[name] + turns[name] @ s.directions[j] * s.lengths[j]
    return starts, ends, turns


def assert_pose(s, motion, frames):
    positions, rotations = amc.global_pose(s, motion)
    for t in frames:
        starts, _, turns = slow_pose(s, motion[t])
        for j, name in enumerate(s.names):
            np.testing.assert_allclose(positions[t, j], starts[name], atol=1e-9)
            np.testing.assert_allclose(rot(rotations[t, j]).as_matrix(), turns[name], atol=1e-9)
    assert (np.sum(rotations[1:] * rotations[:-1], axis=-1) > 0).all()


# ---------------------------------------------------------------- files

SMALL = """# a comment
:version 1.10
:name VICON
:units
  mass 2.0
  length 0.45
  angle deg
:documentation
   begin root :) any text
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name hip
     direction 1 0 0
     length 2.0
     axis 0 0 0 XYZ
  end
  begin
     id 2
     name leg
     direction 0 -1 0
     length 4.0
     axis 0 0 20 XYZ
     dof rx rz
     limits (-160.0 20.0)
            (-inf inf)
  end
  begin
     id 3
     name toe
     direction 0 0 1
     length 1.0
     axis 30 -20 10 ZXY
     dof rz rx ry
  end
:hierarchy
  begin
    root hip
    hip leg
    leg toe
  end
"""
MOTION = """#!OML:ASF C:\\a.ASF
:FULLY-SPECIFIED
:DEGREES
7
root 1 2 3 10 20 30
leg 40 50
toe 1 2 3
8
toe 4 5 6
root 1.5 2.5e0 -3 -10 -20 -30
leg -4.0E+1 5
"""


def write(folder, asf=SMALL, motion=MOTION, name="01"):
    """SUBJECT.asf and SUBJECT_01.amc -> their paths."""
    paths = folder / f"{name}.asf", folder / f"{name}_01.amc"
    for path, text in zip(paths, (asf, motion)):
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return paths


@pytest.fixture
def small(tmp_path):
    asf, motion = write(tmp_path)
    s = amc.read_asf(asf)
    return s, amc.read_amc(motion, s)


def random_asf(rng, bones, degrees=True):
    """An ASF of a random tree with random axes and dofs; its text."""
    k, lines = 1.0 if degrees else np.pi / 180, [":units", "mass 1", "length 1", f"angle {'deg' if degrees else 'rad'}"]
    order = rng.permutation(["TX", "TY", "TZ", "RX", "RY", "RZ"])
    axis = lambda n: " ".join(f"{v:.12g}" for v in k * rng.uniform(-180, 180, n))  # noqa: E731
    letters = lambda: "".join(rng.permutation(list("XYZ")))  # noqa: E731
    at = " ".join(f"{v:.6f}" for v in rng.normal(size=3))
    lines += [":root", "order " + " ".join(order), f"axis {letters()}", f"position {at}", f"orientation {axis(3)}"]
    lines += [":bonedata"]
    for i in range(bones):
        d = rng.normal(size=3)
        d = " ".join(f"{v:.12g}" for v in d / np.linalg.norm(d))
        dofs = " ".join(rng.permutation(["rx", "ry", "rz"])[: rng.integers(0, 4)])
        lines += ["begin", f"name b{i}", f"direction {d}", f"length {rng.uniform(0, 5):.6f}"]
        lines += [f"axis {axis(3)} {letters()}", *([f"dof {dofs}"] if dofs else []), "end"]
    lines += [":hierarchy", "begin"]
    for i in range(bones):
        lines.append(f"{f'b{rng.integers(0, i)}' if i and rng.random() < 0.8 else 'root'} b{i}")
    return "\n".join([*lines, "end"]) + "\n"


def motion_text(s, motion, first=1, keyword=":DEGREES"):
    """An AMC of angles in radians, written in degrees."""
    lines, k = [":FULLY-SPECIFIED", keyword], np.pi / 180 if keyword == ":DEGREES" else 1.0
    for t, row in enumerate(motion):
        lines.append(str(first + t))
        values = iter(row)
        for name, dofs in zip(s.names, s.dofs):
            words = [f"{next(values) / (k if d[0] == 'r' else 1.0):.12g}" for d in dofs]
            lines += [" ".join([name, *words])] if dofs else []
    return "\n".join(lines) + "\n"


# ---------------------------------------------------------------- reading


def test_read_asf(small):
    s, _ = small
    assert s.names == ("root", "hip", "leg", "toe") and s.parents.tolist() == [-1, 0, 1, 2]
    assert s.dofs == (("tx", "ty", "tz", "rx", "ry", "rz"), (), ("rx", "rz"), ("rz", "rx", "ry"))
    assert s.lengths.tolist() == [0, 2, 4, 1] and (s.mass, s.length, s.degrees) == (2.0, 0.45, True)
    np.testing.assert_allclose(np.degrees(s.axes), [[0, 0, 0], [0, 0, 0], [0, 0, 20], [30, -20, 10]])
    assert s.axis_orders == ("xyz", "xyz", "xyz", "zxy")
    np.testing.assert_array_equal(s.directions, [[0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 0, 1]])
    np.testing.assert_allclose(np.degrees(s.limits[2]), [[-160, 20], [-np.inf, np.inf]])
    assert s.limits[1] is None and s.limits[3] is None
    assert s.columns[6:] == [("leg", "rx"), ("leg", "rz"), ("toe", "rz"), ("toe", "rx"), ("toe", "ry")]


def test_spellings(tmp_path):
    """Line endings, tabs, comments, capitals, sections in another order, radians: the same skeleton."""
    plain = amc.read_asf(write(tmp_path)[0])
    body, bones = SMALL[: SMALL.index(":bonedata")], SMALL[SMALL.index(":bonedata") : SMALL.index(":hierarchy")]
    tree = SMALL[SMALL.index(":hierarchy") :]
    texts = {
        "crlf": SMALL.replace("\n", "\r\n"),
        "cr": SMALL.replace("\n", "\r"),
        "bom, tabs": "\ufeff" + SMALL.replace("     ", "\t").replace("\n", "  # note\n\n"),
        "capitals": SMALL.replace("dof rx rz", "DOF RX RZ").replace("XYZ", "xyz").replace(":root", ":ROOT"),
        "other order": tree + bones + body,
        "spelt": SMALL.replace("angle deg", "angle Degrees"),
        "limits on one line": SMALL.replace("20.0)\n", "20.0)"),
    }
    for what, text in texts.items():
        s = amc.read_asf(write(tmp_path, text)[0])
        assert (s.names, s.dofs, s.axis_orders) == (plain.names, plain.dofs, plain.axis_orders), what
        np.testing.assert_array_equal(s.axes, plain.axes)
        np.testing.assert_array_equal(s.limits[2], plain.limits[2])
    text = SMALL.replace("angle deg", "angle rad").replace("axis 0 0 20 XYZ", "axis 0 0 0.3490658503988659 XYZ")
    s = amc.read_asf(write(tmp_path, text)[0])
    assert not s.degrees and s.axes[2, 2] == pytest.approx(plain.axes[2, 2])
    assert s.limits[2][0].tolist() == [-160.0, 20.0]


def test_read_amc(small, tmp_path):
    """Bones in any order within a frame; degrees become radians, lengths stay."""
    s, motion = small
    want = [[1, 2, 3, 10, 20, 30, 40, 50, 1, 2, 3], [1.5, 2.5, -3, -10, -20, -30, -40, 5, 4, 5, 6]]
    unit = [1] * 3 + [np.pi / 180] * 8
    np.testing.assert_allclose(motion, np.array(want) * unit, atol=1e-15)

    def read(text):
        return amc.read_amc(write(tmp_path, motion=text)[1], s)

    np.testing.assert_array_equal(read(MOTION.replace("\n", "\r\n")), motion)
    np.testing.assert_array_equal(read(MOTION.replace(":FULLY-SPECIFIED\n:DEGREES\n", "")), motion)  # as the ASF
    np.testing.assert_array_equal(read(MOTION.replace("toe", "hip\ntoe")), motion)  # a fixed bone without values
    np.testing.assert_array_equal(read(MOTION.replace(":DEGREES", ":radians")), want)
    np.testing.assert_array_equal(amc.read_amc(tmp_path / "01_01.amc", replace(s, degrees=False)), want)
    assert len(read(MOTION[: MOTION.index("8\ntoe")])) == 1


def asf_swap(old, new, count=1):
    assert old in SMALL, old
    return SMALL.replace(old, new, count)


HEADER, BODY = SMALL[: SMALL.index(":bonedata")], SMALL[SMALL.index(":bonedata") :]
MALFORMED_ASF = {  # name: (text, what the message must say)
    "empty": ("", "empty"),
    "another format": ("HIERARCHY\nROOT a\n", "line 1: not an ASF: starts with 'HIERARCHY'"),
    "binary": (b":units\n\x00\x01", "binary data"),
    "utf-16": (SMALL.encode("utf-16"), "UTF-16"),
    "junk": (b"\x89PNG\r\n\x1a\n\xff\xfe", "line 1: not an ASF: starts with"),
    "no bones": (HEADER, "no :bonedata section; expected :units, :root, :bonedata, :hierarchy"),
    "no root": (asf_swap(":root", ":skin"), "no :root section"),
    "unknown section": (asf_swap(":root", ":roots"), "unknown section ':roots'; valid: :version"),
    "section twice": (SMALL + ":units\n", "line 47: section :units again"),
    "truncated in a bone": (SMALL[: SMALL.index("     axis 30")] + ":hierarchy\n", "line 33: this bone has no end"),
    "truncated in the hierarchy": (SMALL[: SMALL.rindex("  end")], ":hierarchy has no end"),
    "empty hierarchy": (asf_swap(BODY[BODY.index("  begin\n    root") :], ""), ":hierarchy has no end"),
    "empty bonedata": (HEADER + ":bonedata\n" + BODY[BODY.index(":hierarchy") :], ":bonedata holds no bone"),
    "angle": (asf_swap("angle deg", "angle turns"), "line 7: angle of :units is 'turns'; expected deg or rad"),
    "no angle": (asf_swap("  angle deg\n", ""), "angle of :units is ''"),
    "length zero": (asf_swap("length 0.45", "length 0"), "line 6: length of :units is 0; expected a positive"),
    "length of words": (asf_swap("length 0.45", "length inches"), "length of :units is 'inches'; expected one number"),
    "unknown unit": (asf_swap("mass 2.0", "weight 2"), "found 'weight' in :units; valid: mass, length, angle"),
    "order": (asf_swap("order TX TY TZ", "order TX TX TZ"), "line 11: order of :root is 'TX TX TZ RX RY RZ'"),
    "no order": (asf_swap("   order TX TY TZ RX RY RZ\n", ""), "order of :root is ''"),
    "root axis": (asf_swap("axis XYZ", "axis XYX"), "line 12: axis of :root has the order 'xyx'"),
    "root position": (asf_swap("position 0 0 0", "position 0 0"), "position of :root is '0 0'; expected 3 numbers"),
    "orientation nan": (asf_swap("orientation 0", "orientation nan"), "orientation of :root is 'nan 0 0'"),
    "between bones": (asf_swap("  begin\n     id 2", "  id 2"), "line 23: found 'id' between two bones"),
    "begin in a bone": (asf_swap("  end\n  begin\n     id 2", "  begin\n     id 2"), "begins on line 16"),
    "bone key": (asf_swap("id 1", "colour 1"), "line 17: found 'colour' in the bone that begins on line 16; valid: id"),
    "key twice": (asf_swap("length 2.0", "length 2.0\nlength 3"), "length of the bone that begins on line 16 again"),
    "nameless": (asf_swap("name hip", "name"), "name of a bone is ''"),
    "name a number": (asf_swap("name hip", "name 12"), "name of a bone is '12'; expected one word that is no number"),
    "equal names": (asf_swap("name leg", "name hip"), "bone 'hip' again; expected unique names other than root"),
    "named root": (asf_swap("name leg", "name root"), "bone 'root' again"),
    "no direction": (asf_swap("     direction 1 0 0\n", ""), "bone 'hip' has no direction"),
    "direction of two": (asf_swap("direction 1 0 0", "direction 1 0"), "direction of bone 'hip' is '1 0'; expected 3"),
    "direction long": (asf_swap("direction 1 0 0", "direction 2 0 0"), "has length 2; expected a unit vector"),
    "direction nan": (asf_swap("direction 1", "direction nan"), "line 19: direction of bone 'hip' is 'nan 0 0'"),
    "length negative": (asf_swap("length 2.0", "length -2"), "length of bone 'hip' is -2"),
    "length huge": (asf_swap("length 2.0", "length 1e300"), "'1e300'; expected one number of at most 1e+09"),
    "axis order": (asf_swap("0 0 20 XYZ", "0 0 20 XY"), "axis of bone 'leg' has the order 'xy'; expected a perm"),
    "axis short": (asf_swap("0 0 20 XYZ", "0 20 XYZ"), "axis of bone 'leg' is '0 20 XYZ'; expected 3 numbers"),
    "dof": (asf_swap("dof rx rz", "dof rx tx"), "line 29: dof of bone 'leg' is 'rx tx'; expected each at most once of"),
    "dof twice": (asf_swap("dof rx rz", "dof rx rx"), "dof of bone 'leg' is 'rx rx'"),
    "limits short": (asf_swap("            (-inf inf)\n", ""), "limits of bone 'leg' are '(-160.0 20.0)'; expected"),
    "limits nan": (asf_swap("-inf inf", "low high"), "limits of bone 'leg'"),
    "unknown bone": (asf_swap("leg toe", "leg tail"), "unknown bone 'tail' in :hierarchy; valid: root, hip, leg, toe"),
    "two parents": (asf_swap("leg toe", "leg toe\nhip toe"), "toe is a child of hip and of leg; expected one parent"),
    "root a child": (asf_swap("leg toe", "leg toe root"), "root is a child of leg"),
    "no parent": (asf_swap("    leg toe\n", ""), "bone 'toe' does not hang on root: it has no parent"),
    "cycle": (asf_swap("root hip\n    hip leg", "hip leg\ntoe hip"), "'hip' does not hang on root: its parents form a"),
    "own child": (asf_swap("root hip", "hip hip"), "its parents form a cycle"),
    "after the hierarchy": (SMALL + "root hip\n", "line 47: found 'root' in :hierarchy"),
    "line separator in a name": (asf_swap("name hip", "name h\u2028p"), "name of a bone is 'h p'"),
}  # fmt: skip


@pytest.mark.parametrize("text, message", MALFORMED_ASF.values(), ids=MALFORMED_ASF)
def test_malformed_asf(tmp_path, text, message):
    """Exactly one line, which starts with the file and says what was found or expected."""
    path, _ = write(tmp_path, text)
    with pytest.raises(amc.AmcError) as e:
        amc.read_asf(path)
    said = str(e.value)
    assert said.startswith(str(path)) and message in said, said
    assert len(said.splitlines()) == 1 and len(said) < 400 + len(str(path))


def amc_swap(old, new, count=1):
    assert old in MOTION, old
    return MOTION.replace(old, new, count)


MALFORMED_AMC = {
    "empty": (" \n", "empty"),
    "only comments": ("# nothing\n", "holds no frame"),
    "binary": (b"1\nroot \x00", "binary data"),
    "junk": (b"1\nroot \xff\xfe", "line 2: root has 1 values in frame 1"),
    "no frames": (MOTION[: MOTION.index("7\n")], "holds no frame"),
    "bone before a frame": (amc_swap("7\n", ""), "line 4: found 'root'; expected :FULLY-SPECIFIED, :DEGREES, :RADIANS"),
    "unknown keyword": (amc_swap(":DEGREES", ":DEGREE"), "line 3: unknown keyword ':DEGREE'; valid: :FULLY-SPECIFIED"),
    "both units": (amc_swap(":DEGREES", ":DEGREES\n:RADIANS"), ":DEGREES and :RADIANS; expected one of them"),
    "late keyword": (MOTION + ":DEGREES\n", "line 12: found ':DEGREES'; expected a frame number or a bone"),
    "unknown bone": (amc_swap("toe 1", "tail 1"), "line 7: found 'tail'; expected a frame number or a bone of "),
    "too few values": (amc_swap("toe 1 2 3", "toe 1 2"), "toe has 2 values in frame 7; expected 3 (rz rx ry)"),
    "too many values": (amc_swap("leg 40 50", "leg 40 50 60"), "leg has 3 values in frame 7; expected 2 (rx rz)"),
    "values of a fixed bone": (amc_swap("toe 1", "hip 1\ntoe 1"), "hip has 1 values in frame 7; expected none"),
    "bone missing": (amc_swap("leg 40 50\n", ""), "line 7: frame 7 ends without leg; expected every bone"),
    "truncated": (MOTION[: MOTION.index("leg -4")], "frame 8 ends without leg"),
    "truncated in a row": (MOTION[: MOTION.index(" -20 -30")], "root has 4 values in frame 8"),
    "bone twice": (amc_swap("leg 40 50", "leg 40 50\nleg 40 50"), "line 7: leg again in frame 7"),
    "frame twice": (amc_swap("8\n", "7\n"), "line 8: frame 7 after frame 7; expected 8"),
    "frame skipped": (amc_swap("8\n", "9\n"), "frame 9 after frame 7; expected 8"),
    "frame endless": (amc_swap("8\n", "9" * 6000 + "\n"), "expected a frame number"),
    "frame fraction": (amc_swap("8\n", "8.0\n"), "line 8: found '8.0'"),
    "two numbers": (amc_swap("8\n", "8 9\n"), "line 8: found '8'"),
    "letters": (amc_swap("40 50", "4x 50"), "line 6: rx of leg is '4x' in frame 7; expected a number"),
    "nan": (amc_swap("-4.0E+1", "NaN"), "line 11: rx of leg is 'NaN' in frame 8"),
    "infinite": (amc_swap("2.5e0", "inf"), "line 10: ty of root is 'inf' in frame 8"),
    "huge": (amc_swap("2.5e0", "1e300"), "ty of root is '1e300' in frame 8; expected a number of at most 1e+09"),
    "underscore": (amc_swap("40 50", "4_0 50"), "line 6: rx of leg is '4_0'"),
    "long word": (amc_swap("40 50", "z" * 100000 + " 50"), "..."),
}  # fmt: skip


@pytest.mark.parametrize("text, message", MALFORMED_AMC.values(), ids=MALFORMED_AMC)
def test_malformed_amc(tmp_path, text, message):
    asf, path = write(tmp_path, motion=text)
    with pytest.raises(amc.AmcError) as e:
        amc.read_amc(path, amc.read_asf(asf))
    said = str(e.value)
    assert said.startswith(str(path)) and message in said, said
    assert len(said.splitlines()) == 1 and len(said) < 400 + 2 * len(str(path))


def test_any_depth(tmp_path):
    """A chain of 5000 bones, each turned by a degree: no recursion, and the end where complex numbers put it."""
    n = 5000
    bones = "".join(f"begin\nname b{i}\ndirection 1 0 0\nlength 1\naxis 0 0 0 XYZ\ndof rz\nend\n" for i in range(n))
    tree = "root b0\n" + "".join(f"b{i} b{i + 1}\n" for i in range(n - 1))
    text = HEADER + ":bonedata\n" + bones + ":hierarchy\nbegin\n" + tree + "end\n"
    motion = "1\nroot 0 0 0 0 0 0\n" + "".join(f"b{i} 1\n" for i in range(n))
    asf, path = write(tmp_path, text, motion)
    s = amc.read_asf(asf)
    positions, _ = amc.global_pose(s, amc.read_amc(path, s))
    end = np.exp(1j * np.radians(np.arange(1, n))).sum()  # where the last bone starts
    np.testing.assert_allclose(positions[0, -1], [end.real, end.imag, 0], atol=1e-8)


# ---------------------------------------------------------------- poses


def test_hand_cases(tmp_path, small):
    s, _ = small
    rest = np.zeros((1, 11))
    positions, rotations = amc.global_pose(s, rest)  # the zero pose: rods as `direction` says, whatever the axes
    np.testing.assert_allclose(positions[0], [[0, 0, 0], [0, 0, 0], [2, 0, 0], [2, -4, 0]], atol=1e-12)
    np.testing.assert_allclose(rotations[0], np.tile([1, 0, 0, 0], (4, 1)), atol=1e-12)

    def pose(**values):
        row = rest.copy()
        for key, value in values.items():
            row[0, s.columns.index(tuple(key.split("_")))] = np.radians(value) if key[-2] == "r" else value
        return amc.global_pose(s, row)[0][0]

    # the root's order is rx, ry, rz about fixed axes: the rod along x is left alone by rx, and rz sends it to y
    np.testing.assert_allclose(pose(root_rx=90, root_rz=90)[2], [0, 2, 0], atol=1e-12)
    np.testing.assert_allclose(pose(root_ry=90, root_rz=90)[2], [0, 0, -2], atol=1e-12)  # x to -z, which rz leaves
    np.testing.assert_allclose(pose(root_tx=5, root_tz=7)[2], [7, 0, 7], atol=1e-12)
    # the leg's x axis is the world's x turned by 20 degrees about z; half a turn about it mirrors the rod in it
    a = np.radians(20)
    axis = np.array([np.cos(a), np.sin(a), 0])
    rod = np.array([0, -4.0, 0])
    np.testing.assert_allclose(pose(leg_rx=180)[3], [2, 0, 0] + 2 * (rod @ axis) * axis - rod, atol=1e-12)
    np.testing.assert_allclose(pose(leg_rz=90)[3], [6, 0, 0], atol=1e-12)
    # rx before rz, both about the fixed axes of C
    want = chain("z", [a]) @ chain("xz", np.radians([30, 40])) @ chain("z", [-a]) @ rod
    np.testing.assert_allclose(pose(leg_rx=30, leg_rz=40)[3], [2, 0, 0] + want, atol=1e-12)

    # `axis 90 90 0 XYZ` is Ry Rx: its z axis is the world's -y turned about y, so -y; Rx Ry would make it x
    text = SMALL.replace("axis 0 0 20 XYZ", "axis 90 90 0 XYZ").replace("direction 0 -1 0", "direction 1 0 0")
    s = amc.read_asf(write(tmp_path, text)[0])
    np.testing.assert_allclose(pose(leg_rz=90)[3], [2, 0, 4], atol=1e-12)  # x turned by 90 degrees about -y
    # the same with the letters in the other order: the first number belongs to the first letter
    s = amc.read_asf(write(tmp_path, text.replace("90 90 0 XYZ", "90 90 0 YXZ"))[0])
    np.testing.assert_allclose(pose(leg_rz=90)[3], [6, 0, 0], atol=1e-12)  # Rx Ry: x itself, which leaves the rod
    with pytest.raises(ValueError, match=r"shape \(1, 10\); expected \(T, 11\)"):
        amc.global_pose(s, rest[:, 1:])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 12), st.booleans())
def test_global_pose_against_matrices(tmp_path_factory, seed, bones, degrees):
    """Random trees, axes, orders, dofs and motions."""
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("random")
    s = amc.read_asf(write(folder, random_asf(rng, bones, degrees))[0])
    motion = np.cumsum(rng.normal(0, 0.5, (6, len(s.columns))), axis=0)
    keyword = ":DEGREES" if rng.random() < 0.5 else ":RADIANS"
    read = amc.read_amc(write(folder, motion=motion_text(s, motion, 3, keyword), name="b")[1], s)
    np.testing.assert_allclose(read, motion, atol=1e-9)
    assert_pose(s, motion, range(6))


def test_real_files(mocap_dir):
    """Every file of CMU's reads in seconds; some against matrices."""
    begin, files = time.process_time(), sorted((mocap_dir / "cmu").rglob("*.amc"))
    assert files
    for i, path in enumerate(files):
        s = amc.read_asf(path.with_name(path.stem.split("_")[0] + ".asf"))
        motion = amc.read_amc(path, s)
        assert len(s.names) == 31 and motion.shape == (len(motion), 62) and len(motion) > 100
        if i % 10 == 0:
            assert_pose(s, motion, (0, len(motion) // 2, len(motion) - 1))
        else:
            amc.global_pose(s, motion)
    print(f"{len(files)} files in {time.process_time() - begin:.1f} s")
    assert time.process_time() - begin < 30


# ---------------------------------------------------------------- CMU's human, made up


def cmu_asf():
    """CMU's bones, axes and dofs with round lengths: leg 0.85 m, arm 0.6 m; the right side mirrors the left."""
    inch = 0.45 / 0.0254  # file units a metre
    left = [  # name, parent, direction, metres, axis, dof
        ("hipjoint", "root", (0.6, -0.8, 0), 0.15, (0, 0, 0), ""),
        ("femur", "hipjoint", (0.34202, -0.939693, 0), 0.4, (0, 0, 20), "rx ry rz"),
        ("tibia", "femur", (0.34202, -0.939693, 0), 0.45, (0, 0, 20), "rx"),
        ("foot", "tibia", (0.0943956, -0.25935, 0.961159), 0.12, (-90, 0, 20), "rx rz"),
        ("toes", "foot", (0, 0, 1), 0.06, (-90, 0, 20), "rx"),
        ("clavicle", "thorax", (1, 0, 0), 0.2, (0, 0, 0), "ry rz"),
        ("humerus", "clavicle", (1, 0, 0), 0.3, (180, -30, -90), "rx ry rz"),
        ("radius", "humerus", (1, 0, 0), 0.2, (180, -30, -90), "rx"),
        ("wrist", "radius", (1, 0, 0), 0.1, (0, 90, 90), "ry"),
        ("hand", "wrist", (1, 0, 0), 0.05, (0, 90, 90), "rx rz"),
    ]
    middle = [
        (n, p, (0, 1, 0), 0.12, (0, 0, 0), "rx ry rz")
        for n, p in (("lowerback", "root"), ("upperback", "lowerback"), ("thorax", "upperback"))
        + (("lowerneck", "thorax"), ("upperneck", "lowerneck"), ("head", "upperneck"))
    ]
    bones = list(middle)
    for side, k in (("l", 1), ("r", -1)):
        for name, parent, d, length, axis, dof in left:
            up = parent if parent in ("root", "thorax") else side + parent
            bones.append((side + name, up, (k * d[0], *d[1:]), length, (axis[0], k * axis[1], k * axis[2]), dof))
    lines = [
        ":units",
        "mass 1",
        "length 0.45",
        "angle deg",
        ":root",
        "order TX TY TZ RX RY RZ",
        "axis XYZ",
        ":bonedata",
    ]
    for name, _, d, length, axis, dof in bones:
        lines += ["begin", f"name {name}", "direction {:.9g} {:.9g} {:.9g}".format(*d), f"length {length * inch:.9g}"]
        lines += ["axis {} {} {} XYZ".format(*axis), *([f"dof {dof}"] if dof else []), "end"]
    lines += [":hierarchy", "begin", *(f"{parent} {name}" for name, parent, *_ in bones), "end"]
    return "\n".join(lines) + "\n"


def cmu_file(folder, poses, name="16", heights=0.95):
    """An AMC: poses is a list of {bone: (3, 3) rotation from its parent, in the file's world axes at rest}."""
    s = amc.read_asf(write(folder, cmu_asf(), name=name)[0])
    motion = np.zeros((len(poses), len(s.columns)))
    motion[:, 1] = heights * 0.45 / 0.0254
    for t, pose in enumerate(poses):
        for bone, local in pose.items():
            j = s.names.index(bone)
            c = chain(s.axis_orders[j], s.axes[j])
            spins = [d for d in s.dofs[j] if d[0] == "r"]
            if spins == ["rx", "ry", "rz"]:
                angles = Rotation.from_matrix(c.T @ local @ c).as_euler("xyz")
            else:  # one or two dofs: the turn must be theirs
                v = Rotation.from_matrix(c.T @ local @ c).as_rotvec()
                angles = [v["xyz".index(d[1])] for d in spins]
                np.testing.assert_allclose(chain([d[1] for d in spins], angles), c.T @ local @ c, atol=1e-9)
            for d, angle in zip(spins, angles):
                motion[t, s.columns.index((bone, d))] = angle
    path = folder / f"{name}_01.amc"
    path.write_text(motion_text(s, motion, first=10))
    return path, s, motion


def standing():
    """Turns that bring the zero pose upright: legs closed, arms down with palms inward, head and soles level."""
    a, pitch = np.radians(20), {k: np.radians(v) for k, v in rigs.CMU_PITCH.items()}
    pose = {"head": turn("x", pitch["head"])}
    for side, k in (("l", 1), ("r", -1)):
        pose[f"{side}femur"] = turn("z", -k * a)
        # the foot's pitch, about the leg's own left axis in the zero pose
        pose[f"{side}foot"] = turn("z", k * a) @ turn("x", pitch[f"foot_{side}"]) @ turn("z", -k * a)
        # the arm sinks by 90 degrees; its elbow axis looks 30 degrees outward then, and the upper arm turns it in
        pose[f"{side}humerus"] = turn("y", k * np.radians(-30)) @ turn("z", -k * np.pi / 2)
        # the palm, which would turn in with it, is turned back by pronation, about the arm
        pose[f"{side}wrist"] = turn("x", np.radians(-30))
    return pose


def test_cmu_rate(tmp_path, capsys):
    """CMU's salsa is of 60 Hz: a conversion that says 30 or 120 is read at half, with a line; one that says 60, another
    name, and whoever gives a rate, are left alone."""

    def read(name, header, **how):
        path = tmp_path / name
        write_as(path, "lafan1", walk(2.0))
        path.write_text(re.sub("Frame Time: .*", f"Frame Time: {header}", path.read_text()))
        clip = mocap.data.from_bvh(path, rigs.Reading(**how))
        return clip.rate, "recorded this dance at 60 Hz" in capsys.readouterr().err

    assert read("61_salsa_02.bvh", 0.0333333) == (pytest.approx(15.0, rel=1e-4), True)
    assert read("60_01.bvh", 0.0083333) == (pytest.approx(60.0, rel=1e-4), True)
    assert read("60_01.bvh", 1 / 60) == (pytest.approx(60.0), False)
    assert read("60_02_b.bvh", 0.0333333) == read("62_01.bvh", 0.0333333) == (pytest.approx(30.0, rel=1e-4), False)
    assert read("61_salsa_02.bvh", 0.0333333, rate=30.0) == (30.0, False)
    for name, how, rate in (("61", {}, 60.0), ("16", {}, 120.0), ("60", {"rate": 120.0}, 120.0)):
        clip = rigs.from_amc(cmu_file(tmp_path, [standing()] * 3, name)[0], rigs.Reading(**how))
        assert clip.rate == rate and ("at 60 Hz" in capsys.readouterr().err) is (rate == 60.0)


def test_zero_pose_is_a_t_pose(tmp_path):
    """Hand values: frames of the zero pose, and joints where the rods end."""
    clip = rigs.from_amc(cmu_file(tmp_path, [{}] * 3)[0])
    assert clip.rate == 120.0 and clip.body == "cmu-16-leg85-arm60" and clip.name == "16_01"
    q = {s: rot(clip.quat[0, SEG[s]]).as_matrix() for s in SEGMENTS}
    for s in ("pelvis", "chest"):
        np.testing.assert_allclose(q[s], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(q["head"], turn("y", np.radians(-15)), atol=1e-9)  # looks up: the pitch is taken out
    for side, k in (("l", 1), ("r", -1)):
        # our axes: x forward, y left, z up
        np.testing.assert_allclose(q[f"hand_{side}"], turn("x", k * np.pi / 2), atol=1e-9)
        np.testing.assert_allclose(q[f"thigh_{side}"], turn("x", k * np.radians(20)), atol=1e-6)
        np.testing.assert_allclose(q[f"shin_{side}"], turn("x", k * np.radians(20)), atol=1e-6)
        for s in ("upper_arm", "forearm"):
            want = turn("x", k * np.pi / 2) @ turn("z", k * np.radians(30))  # 30 up of forward
            np.testing.assert_allclose(q[f"{s}_{side}"], want, atol=1e-9)
        hip = np.array([0, k * 0.09, 0.95 - 0.12])
        thigh = 0.4 * np.array([0, k * 0.34202, -0.939693])
        np.testing.assert_allclose(clip.pos[0, SEG[f"thigh_{side}"]], hip, atol=1e-6)
        np.testing.assert_allclose(clip.pos[0, SEG[f"shin_{side}"]], hip + thigh, atol=1e-6)
        np.testing.assert_allclose(clip.pos[0, SEG[f"hand_{side}"]], [0, k * 0.8, 0.95 + 0.36], atol=1e-6)
    np.testing.assert_allclose(clip.pos[0, SEG["pelvis"]], [0, 0, 0.83], atol=1e-9)
    np.testing.assert_allclose(clip.pos[0, SEG["chest"]], [0, 0, 0.95 + 0.24], atol=1e-9)
    np.testing.assert_allclose(clip.pos[0, SEG["head"]], [0, 0, 0.95 + 0.6], atol=1e-9)


AS_THE_FILE = rigs.Reading(floor="file")  # the person in these files stands 8 cm too low


def test_standing_is_the_worlds_axes(tmp_path):
    """Upright with hanging arms every frame is the world's; flexion is about the left axis: knees +, elbows -."""
    bent = {**standing()}
    for side, k in (("l", 1), ("r", -1)):
        c = turn("z", k * np.radians(20))
        bent[f"{side}tibia"] = c @ turn("x", np.radians(40)) @ c.T
        elbow = chain("xyz", np.radians([180, -30 * k, -90 * k]))
        bent[f"{side}radius"] = elbow @ turn("x", np.radians(50)) @ elbow.T
    path, _, motion = cmu_file(tmp_path, [standing(), standing(), bent])
    clip = rigs.from_amc(path, AS_THE_FILE)
    assert quat_angle(clip.quat[:2], [1.0, 0, 0, 0]).max() < 1e-5
    for side, k in (("l", 1), ("r", -1)):
        np.testing.assert_allclose(clip.pos[0, SEG[f"foot_{side}"]], [0, k * 0.09, 0.83 - 0.85], atol=1e-5)
        np.testing.assert_allclose(clip.pos[0, SEG[f"hand_{side}"]], [0, k * 0.2, 1.31 - 0.6], atol=1e-5)
        ball = clip.ball[0, "lr".index(side)] - clip.pos[0, SEG[f"foot_{side}"]]
        assert ball[0] > 0.1 and abs(ball[1]) < 1e-4 and -0.05 < ball[2] < -0.03
        for a, b, flexion in (("thigh", "shin", 40), ("upper_arm", "forearm", -50)):
            r = rot(clip.quat[2, SEG[f"{a}_{side}"]]).inv() * rot(clip.quat[2, SEG[f"{b}_{side}"]])
            np.testing.assert_allclose(np.degrees(r.as_rotvec()), [0, flexion, 0], atol=1e-4)
        shin, hand = clip.pos[2, SEG[f"foot_{side}"]], clip.pos[2, SEG[f"hand_{side}"]]
        assert shin[0] < -0.2 and hand[0] > 0.2  # feet go back, hands come forward


def slow_human(s, row):
    """Joints [m] and anatomical frames in our axes: rods and hinges of the zero pose turned by matrices."""
    starts, ends, turns = slow_pose(s, row)
    ours = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # x forward is the file's z, and so on
    metres = {n: ours @ p * 0.0254 / 0.45 for n, p in starts.items()}
    frames = {}
    for segment in SEGMENTS:
        bone = rigs.CMU_BONES[segment]
        side = segment[-2:]
        hinge = {"thigh": "tibia", "shin": "tibia", "foot": "tibia", "upper_arm": "radius", "forearm": "radius"}
        part = segment.removesuffix(side) if side in ("_l", "_r") else segment
        j = s.names.index(bone if part != "foot" else f"{side[1]}tibia")
        up = np.array([0.0, 1, 0]) if part in ("pelvis", "chest", "head") else -s.directions[j]
        left = {"hand": np.array([0, 1.0 if side == "_l" else -1.0, 0])}.get(part, np.array([1.0, 0, 0]))
        if part in hinge:
            h = s.names.index(side[1] + hinge[part])
            left = chain(s.axis_orders[h], s.axes[h])[:, 0] * (1 if hinge[part] == "tibia" else -1)
        forward = np.cross(left, up)
        forward /= np.linalg.norm(forward)
        m = ours @ turns[bone] @ np.stack([forward, np.cross(up, forward), up], axis=1)
        frames[segment] = m @ turn("y", np.radians(-rigs.CMU_PITCH.get(segment, 0.0)))
    return metres, frames


def check_clip(path, s, motion, frames):
    """from_amc but for `level`, against matrices."""
    clip = rigs.from_amc(path, AS_THE_FILE)
    assert len(clip) == len(motion)
    for t in frames:
        metres, turns = slow_human(s, motion[t])
        for i, segment in enumerate(SEGMENTS):
            want = metres[rigs.CMU_BONES[segment]]
            if segment == "pelvis":
                want = (metres["lfemur"] + metres["rfemur"]) / 2
            np.testing.assert_allclose(clip.pos[t, i], want, atol=1e-9)
            np.testing.assert_allclose(rot(clip.quat[t, i]).as_matrix(), turns[segment], atol=1e-8)
        np.testing.assert_allclose(clip.ball[t], [metres["ltoes"], metres["rtoes"]], atol=1e-9)


def test_from_amc_against_matrices(tmp_path, monkeypatch):
    monkeypatch.setattr(rigs, "level", lambda clip: clip)
    _, s, motion = cmu_file(tmp_path, [{}] * 4)
    motion = np.cumsum(np.random.default_rng(0).normal(0, 0.4, motion.shape), axis=0)
    path = tmp_path / "16_02.amc"
    path.write_text(motion_text(s, motion))
    check_clip(path, s, amc.read_amc(path, s), range(4))


def test_recorded_against_matrices(mocap_dir, monkeypatch):
    monkeypatch.setattr(rigs, "level", lambda clip: clip)
    for name in ("07/07_03", "35/35_28"):
        path = mocap_dir / "cmu" / f"{name}.amc"
        s = amc.read_asf(path.with_name(f"{name[:2]}.asf"))
        motion = amc.read_amc(path, s)
        check_clip(path, s, motion, (0, len(motion) // 3, len(motion) - 1))


def test_unknown_skeleton(tmp_path):
    _, path = write(tmp_path)
    with pytest.raises(UserError, match="01.asf: no CMU skeleton: head, lfemur.* missing or without rx; it has root"):
        rigs.from_amc(path)
    path, *_ = cmu_file(tmp_path, [{}])
    (tmp_path / "16.asf").write_text(cmu_asf().replace("dof rx\nend\nbegin\nname lwrist", "end\nbegin\nname lwrist"))
    (tmp_path / "16_01.amc").write_text("".join(x for x in path.open() if not x.startswith("lradius")))
    with pytest.raises(UserError, match="no CMU skeleton: lradius missing or without rx"):
        rigs.from_amc(path)


def test_skeleton_beside(tmp_path, capsys):
    """SUBJECT.asf, or the only one there; else the message names what was looked for."""
    path, *_ = cmu_file(tmp_path, [standing()] * 2)
    assert rigs.from_amc(path).body.startswith("cmu-16-") and rigs.from_amc(path, rigs.Reading(rate=60)).rate == 60.0
    (tmp_path / "07.asf").write_text(cmu_asf())
    assert rigs.from_amc(path).body.startswith("cmu-16-")  # its own among two
    (tmp_path / "16.asf").rename(tmp_path / "somebody.ASF")

    def message(path):
        with pytest.raises(UserError) as e:
            rigs.from_amc(path)
        assert "\n" not in str(e.value)
        return str(e.value)

    m = message(path)
    assert "looked for 16.asf or a single .asf" in m and "07.asf, somebody.ASF" in m and "16_01.amc" in m
    (tmp_path / "07.asf").unlink()
    (tmp_path / "somebody.ASF").write_text(re.sub(r"(:units\s.*?length )\S+", r"\g<1>4500", cmu_asf(), flags=re.S))
    rigs.from_amc(path)  # a ten thousandth of its size: made an adult's, unless the user says more
    assert ": unit " in capsys.readouterr().err
    with pytest.raises(UserError, match=r"above the floor; valid: 0.1 to 10 m; .* somebody.ASF: 1 / \(length"):
        rigs.from_amc(path, rigs.Reading(unit="1e-4"))
    (tmp_path / "somebody.ASF").write_text(cmu_asf())
    assert rigs.from_amc(path).body == "cmu-somebody-leg85-arm60"
    (tmp_path / "somebody.ASF").unlink()
    assert "there is none" in message(path)
    assert "gone_01.amc" in (m := message(tmp_path / "gone_01.amc")) and "expected a regular file" in m
    write(tmp_path, "nothing", name="16")
    assert "16.asf, line 1: not an ASF" in message(path)
    cmu_file(tmp_path, [{}])
    path.write_text("1\n")
    assert "16_01.amc, line 2: frame 1 ends without" in message(path)


# ---------------------------------------------------------------- level, splits, inspect


def tilted(clip, degrees, azimuth):
    """The clip on a floor that rises towards azimuth."""
    axis = np.array([np.sin(azimuth), -np.cos(azimuth), 0]) * np.radians(degrees)
    r = Rotation.from_rotvec(axis)
    move = lambda p: r.apply(p.reshape(-1, 3)).reshape(p.shape)  # noqa: E731
    quat = (r * rot(clip.quat.reshape(-1, 4))).as_quat(scalar_first=True).reshape(clip.quat.shape)
    return replace(clip, pos=move(clip.pos), ball=move(clip.ball), quat=quat)


@pytest.mark.parametrize("azimuth", [0.0, 0.8, np.pi / 2, 4.0])
def test_level(azimuth):
    """A walk on a floor tilted along its way comes back; steps, soft ground and nothing to stand on are left alone."""
    flat = place(walk(8.0, 60.0, variation=0.0), azimuth, np.zeros(2), np.array([0.3, -0.2]))
    up = tilted(flat, 1.2, azimuth)
    assert up.ball[-1, 0, 2] - flat.ball[-1, 0, 2] > 0.1  # 10 m further on
    got = rigs.level(up)
    assert np.abs(got.pos - flat.pos).max() < 0.02 and np.abs(got.ball[..., 2] - flat.ball[..., 2]).max() < 0.01
    assert np.degrees(quat_angle(got.quat, flat.quat)).max() < 0.05
    np.testing.assert_allclose(np.linalg.norm(got.pos, axis=-1), np.linalg.norm(up.pos, axis=-1), atol=1e-9)
    for name in ("name", "body", "rate"):
        assert getattr(got, name) == getattr(up, name)
    # another way: g by least squares over stacked rows, heights and places less each foot's means
    rows, heights = [], []
    speed = np.linalg.norm(np.gradient(up.ball, 1 / 60, axis=0), axis=-1)
    for k in (0, 1):
        ball = up.ball[(up.ball[:, k, 2] < 0.2) & (speed[:, k] < 0.4), k]
        rows += list(ball[:, :2] - ball[:, :2].mean(0))
        heights += list(ball[:, 2] - ball[:, 2].mean())
    n = len(rows)
    g = np.linalg.lstsq(np.vstack([rows, 0.2 * np.sqrt(n) * np.eye(2)]), np.append(heights, [0, 0]), rcond=None)[0]
    steep = np.hypot(*g)
    turned = Rotation.from_rotvec(np.array([-g[1], g[0], 0]) / steep * np.arctan(steep))
    np.testing.assert_allclose(got.pos[-1], turned.apply(up.pos[-1]), atol=1e-9)
    assert rigs.level(steeper := tilted(flat, 4.0, azimuth)) is steeper
    assert rigs.level(high := replace(flat, ball=flat.ball + [0, 0, 1.0])) is high
    # a tilt across the way is not seen: the feet spread too little
    across = tilted(flat, 1.0, azimuth + np.pi / 2)
    assert np.degrees(quat_angle(rigs.level(across).quat, across.quat)).max() < 0.35


def test_level_on_the_spot(tmp_path):
    """Standing feet that do not move say nothing about the floor."""
    path, *_ = cmu_file(tmp_path, [standing()] * 30)
    assert quat_angle(rigs.from_amc(path).quat, [1.0, 0, 0, 0]).max() < 1e-5


def test_body_split(tmp_path, capsys):
    """AMC files are unseen bodies wherever they lie beside others; alone, they are meant."""
    folder = tmp_path / "cmu"
    folder.mkdir()
    path, *_ = cmu_file(folder, [standing()] * 2)
    for i in (2, 5):
        (folder / f"16_{i:02d}.amc").write_text(path.read_text())
    assert split_of("16_01.amc") == split_of("16_05.AMC") == split_of("cmu/16_01.bvh") == "body"
    assert split_of("13_01.amc") == "train"
    assert split_of("train/16_01.amc") == "train" and split_of("a/validation/walk_001.bvh") == "validation"

    def load(where, split, **kw):
        return [c.name for c in mocap.data.load(where, split=split, reading=AS_THE_FILE, **kw)]

    assert load(folder, "body") == load(folder, "all") == ["16_01", "16_02", "16_05"]
    assert capsys.readouterr().err == ""
    assert load(folder, "train") == ["16_01", "16_02"] and "only people held out" in capsys.readouterr().err
    assert load(folder, "validation") == ["16_05"] and load(path, "train") == ["16_01"]
    assert {c.rate for c in mocap.data.load(folder)} == {30.0} and len(mocap.data.load(folder, rate=240.0)[0]) == 3

    write_as(tmp_path / "walk_005.bvh", "bandai", walk(0.5))  # a parent folder: even with nothing else to train on
    with pytest.raises(UserError, match="none of the 4 clips .* is in split 'train'; they are in body and validation"):
        load(tmp_path, "train")
    write_as(tmp_path / "walk_001.bvh", "bandai", walk(0.5))
    capsys.readouterr()
    assert load(tmp_path, "train") == ["walk_001"] and "3 clips left out" in capsys.readouterr().err
    assert load(tmp_path, "validation") == ["walk_005"] and len(load(tmp_path, "body")) == 3
    assert len(load(tmp_path, "all")) == 5
    with pytest.raises(UserError, match="none of the 3 clips that match '16_.*' is in split 'train'; they are in body"):
        load(tmp_path, "train", clips="16_*")
    for f in folder.iterdir():
        f.unlink()
    with pytest.raises(UserError, match="is in split 'body'; they are in train and validation"):
        load(tmp_path, "body")
    with pytest.raises(UserError, match="split 'body'"):
        load("builtin", "body")


def test_bodies_are_not_mixed(tmp_path):
    """Two subjects of equal limbs are two bodies."""
    for name in ("07", "16"):
        cmu_file(tmp_path, [standing()] * 2, name)
    assert {c.body for c in mocap.data.load(tmp_path)} == {"cmu-07-leg85-arm60", "cmu-16-leg85-arm60"}


def test_inspect(tmp_path, capsys):
    path, *_ = cmu_file(tmp_path, [standing()] * 3)
    inspect.main(["inspect", str(path)])
    out = capsys.readouterr().out
    for word in ("rig cmu, 27 joints", "lfemur", "thigh_l", "120.0 Hz", "3 frames", "footfalls"):
        assert word in out, word
    inspect.main(["inspect", str(tmp_path)])
    assert " 30.0 Hz" in capsys.readouterr().out


# ---------------------------------------------------------------- CMU's humans, recorded

SUBJECTS = ("07", "08", "16", "35")


@pytest.mark.parametrize("subject", SUBJECTS)
def test_cmu_anatomy(mocap_dir, subject):
    """Four people alike: they face where they go, left is left, segments lie along their bones, joints flex."""
    clips = mocap.data.load(mocap_dir / "cmu" / subject)
    assert len({c.body for c in clips}) == 1 and clips[0].body.startswith(f"cmu-{subject}-")
    for clip in clips:
        unit = lambda s, axis, c=clip: rot(c.quat[:, SEG[s]]).apply(axis)  # noqa: E731
        velocity = linear_velocity(clip.pos[:, 0], clip.rate) * [1, 1, 0]
        speed = np.linalg.norm(velocity, axis=-1)
        psi = heading(clip.quat[:, 0])
        ahead, left = (np.stack([np.cos(psi + a), np.sin(psi + a), 0 * psi], -1) for a in (0, np.pi / 2))
        assert np.sum(velocity * ahead, -1)[speed > 0.5].sum() > 0.95 * speed[speed > 0.5].sum()
        for s in ("pelvis", "chest", "head"):
            assert unit(s, [0, 0, 1])[:, 2].min() > 0.9, (clip.name, s)
        assert abs(np.degrees(np.arcsin(unit("head", [1, 0, 0])[:, 2])).mean()) < 14
        for s in ("thigh", "shin", "foot", "upper_arm", "hand"):
            apart = np.sum((clip.pos[:, SEG[s + "_l"]] - clip.pos[:, SEG[s + "_r"]]) * left, -1)
            assert apart.mean() > 0.05, (clip.name, s)
        for k, side in enumerate("lr"):
            for a, b in (("thigh", "shin"), ("shin", "foot"), ("upper_arm", "forearm")):
                bone = clip.pos[:, SEG[f"{b}_{side}"]] - clip.pos[:, SEG[f"{a}_{side}"]]
                bone /= np.linalg.norm(bone, axis=-1, keepdims=True)
                assert np.sum(-unit(f"{a}_{side}", [0, 0, 1]) * bone, -1).min() > 0.999, (clip.name, a, side)
            knee, elbow = (
                np.degrees((rot(clip.quat[:, SEG[a]]).inv() * rot(clip.quat[:, SEG[b]])).as_rotvec())
                for a, b in ((f"thigh_{side}", f"shin_{side}"), (f"upper_arm_{side}", f"forearm_{side}"))
            )
            assert np.abs(knee[:, [0, 2]]).max() < 0.01 > np.abs(elbow[:, [0, 2]]).max()  # hinges
            assert -1 < knee[:, 1].min() and 50 < knee[:, 1].max() < 85
            assert -90 < elbow[:, 1].min() and elbow[:, 1].max() < 1
            yaw = rot(clip.quat[:, SEG["chest"]]).inv() * rot(clip.quat[:, SEG[f"upper_arm_{side}"]])
            assert abs(np.median(np.degrees(yaw.as_euler("ZXY")[:, 0]))) < 35  # elbows bend forward, not sideways
            thumb = np.sum(unit(f"hand_{side}", [1, 0, 0]) * ahead, -1)
            assert thumb.mean() > 0.25  # hands hang with the thumbs ahead
            points = np.stack([clip.pos[:, FEET[k]], clip.ball[:, k]])
            low = np.all(np.linalg.norm(np.gradient(points, 1 / clip.rate, axis=1), axis=-1) < 0.3, axis=0)
            pitch = np.degrees(np.arcsin(unit(f"foot_{side}", [1, 0, 0])[low, 2]))
            assert low.sum() > 5 and abs(np.median(pitch)) < 6, (clip.name, side, np.median(pitch))
        assert 0.8 < clip.hip_height < 1.0 and 0.3 < contacts(clip).mean() < 0.7


@pytest.mark.parametrize("subject", SUBJECTS)
def test_cmu_floor(mocap_dir, subject):
    """Levelled, a foot stands as high at one end of a walk as at the other: 3 to 5 cm at the ball."""
    for path in sorted((mocap_dir / "cmu" / subject).glob("*.amc")):
        clip = rigs.from_amc(path)
        for k in (0, 1):
            stands = np.linalg.norm(linear_velocity(clip.ball[:, k], clip.rate), axis=-1) < 0.3
            along = clip.ball[stands, k, :2] - clip.ball[stands, k, :2].mean(0)
            x = along @ np.linalg.svd(along, full_matrices=False)[2][0]
            rise = np.polyfit(x, clip.ball[stands, k, 2], 1)[0]
            assert abs(rise) < 5e-3, (clip.name, k, rise)  # m per m
            assert 0.02 < np.median(clip.ball[stands, k, 2]) < 0.065, (clip.name, k)


def test_retargeted(mocap_dir):
    """The first character walks as a CMU subject does, with soles on the floor."""
    import character
    import retarget

    char = character.load("jesse")
    for name in ("07/07_03", "08/08_04", "16/16_15", "35/35_02"):
        clip = mocap.data.load(mocap_dir / "cmu" / f"{name}.amc")[0]
        a = retarget.artefacts(char, clip, retarget.retarget(char, clip))
        assert a["slide_cm_s"] < 20 and a["penetration_mm"] < 20 and abs(a["float_mm"]) < 10, (name, a)

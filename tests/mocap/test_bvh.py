"""mocap/bvh.py against SciPy's rotations and a slow forward kinematics, on real files, random skeletons and malformed
text.

Real files are found through the environment variable MOCAP_DIR; without it those tests are skipped.
"""

import itertools
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocap import bvh

REAL = sorted(Path(os.environ["MOCAP_DIR"]).rglob("*.bvh")) if os.environ.get("MOCAP_DIR") else []
needs_mocap = pytest.mark.skipif(not REAL, reason="MOCAP_DIR names no folder with .bvh files")

SMALL = """HIERARCHY
ROOT Hips
{
    OFFSET 1.0 2.0 3.0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
    JOINT Knee
    {
        OFFSET 0.0 -4.0 0.0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {
            OFFSET 0.0 -5.0 0.0
        }
    }
}
MOTION
Frames: 2
Frame Time: 0.04
10 20 30 40 50 60 70 80 90
11 21 31 41 51 61 71 81 91
"""


def read_text(tmp_path, text, name="clip.bvh"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return bvh.read(path)


def slow_pose(clip, frame, root_offset="replace"):
    """World positions and 3x3 rotations of one frame, joint by joint, straight from the format's definition."""
    row = iter(clip.values[frame])
    positions, rotations = [], []
    for j, channels in enumerate(clip.channels):
        p, order, angles = clip.offsets[j].copy(), "", []
        for channel in channels:
            value = next(row)
            if channel.endswith("position"):
                axis = "XYZ".index(channel[0])
                p[axis] = value + (clip.offsets[j][axis] if j == 0 and root_offset == "add" else 0)
            else:
                order, angles = order + channel[0], angles + [value]
        r = Rotation.from_euler(order, angles, degrees=True).as_matrix().reshape(3, 3) if order else np.eye(3)
        parent = clip.parents[j]
        positions.append(p if parent < 0 else positions[parent] + rotations[parent] @ p)
        rotations.append(r if parent < 0 else rotations[parent] @ r)
    return np.array(positions), np.array(rotations)


def assert_pose_equal(clip, frames, root_offset="replace"):
    positions, rotations = bvh.global_pose(clip, root_offset)
    for frame in frames:
        p, r = slow_pose(clip, frame, root_offset)
        np.testing.assert_allclose(positions[frame], p, rtol=0, atol=1e-9 * max(1, np.abs(p).max()))
        ours = Rotation.from_quat(rotations[frame], scalar_first=True).as_matrix()
        np.testing.assert_allclose(ours, r, rtol=0, atol=1e-12)


def angle_deg(p, q):
    """Angle between quaternions, accurate near zero: 2 asin of half the chord, the nearer of q and -q."""
    p, q = p / np.linalg.norm(p, axis=-1, keepdims=True), q / np.linalg.norm(q, axis=-1, keepdims=True)
    chord = np.minimum(np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1))
    return np.degrees(4 * np.arcsin(np.clip(chord / 2, 0, 1)))


# ---------------------------------------------------------------- real files


@needs_mocap
@pytest.mark.parametrize("path", REAL[:: max(1, len(REAL) // 5)] + REAL[-1:], ids=lambda p: p.stem)
def test_real_files_against_scipy(path):
    clip = bvh.read(path)
    T = len(clip.values)
    for root_offset in ("replace", "add"):
        assert_pose_equal(clip, sorted({0, T // 3, T - 1}), root_offset)
    positions, rotations = bvh.global_pose(clip)
    assert positions.flags.c_contiguous and positions.dtype == rotations.dtype == np.float64
    assert np.abs(np.linalg.norm(rotations, axis=-1) - 1).max() < 1e-12
    assert (np.sum(rotations[1:] * rotations[:-1], axis=-1) >= 0).all()


@needs_mocap
def test_real_values_match_a_line_by_line_parse():
    for path in (REAL[0], REAL[-1]):
        lines = path.read_text().splitlines()
        start = next(i for i, line in enumerate(lines) if line.startswith("Frame Time"))
        rows = [[float(x) for x in line.split()] for line in lines[start + 1 :] if line.strip()]
        np.testing.assert_array_equal(bvh.read(path).values, rows)


@needs_mocap
def test_all_real_files_load_quickly():
    start = time.perf_counter()
    clips = [bvh.read(path) for path in REAL]
    seconds = time.perf_counter() - start
    print(f"{len(clips)} files, {sum(len(c.values) for c in clips)} frames: {seconds:.2f} s")
    assert seconds < 60
    for clip in clips:
        assert clip.values.shape[1] == sum(map(len, clip.channels))
        assert clip.parents[0] == -1 and (clip.parents[1:] < np.arange(1, len(clip.names))).all()


@needs_mocap
def test_real_round_trip(tmp_path):
    clip = bvh.read(REAL[-1])
    positions, rotations = bvh.local(clip)
    moving = [n for n, c in zip(clip.names[1:], clip.channels[1:]) if "Xposition" in c]
    if moving:
        pytest.skip("the last file moves joints other than the root, which write() does not store")
    out = tmp_path / "out.bvh"
    args = (clip.names, clip.parents, clip.offsets, clip.frame_time, positions[:, 0], rotations, clip.end_sites)
    bvh.write(out, *args)
    before, after = bvh.global_pose(clip), bvh.global_pose(bvh.read(out))
    assert np.abs(before[0] - after[0]).max() < 1e-6
    assert angle_deg(before[1], after[1]).max() < 1e-4


# ---------------------------------------------------------------- the format's readings


def test_small_file(tmp_path):
    clip = read_text(tmp_path, SMALL)
    assert clip.names == ("Hips", "Knee") and clip.parents.tolist() == [-1, 0]
    assert clip.offsets.tolist() == [[1, 2, 3], [0, -4, 0]]
    assert list(clip.end_sites) == ["Knee"] and clip.end_sites["Knee"].tolist() == [0, -5, 0]
    heel = SMALL.replace("        End Site\n", "        End Site { OFFSET 0 -1 -2 }\n        End Site\n")
    (tmp_path / "heel.bvh").write_text(heel)
    assert bvh.read(tmp_path / "heel.bvh").end_sites["Knee"].tolist() == [0, -5, 0]  # of several the farthest
    assert clip.channels[1] == ("Zrotation", "Xrotation", "Yrotation")
    assert clip.values.tolist() == [[10.0 * i for i in range(1, 10)], [10.0 * i + 1 for i in range(1, 10)]]
    assert clip.frame_time == 0.04 and clip.path.endswith("clip.bvh")
    assert_pose_equal(clip, [0, 1])


@pytest.mark.parametrize("order", ["".join(p) for p in itertools.permutations("XYZ")] + ["X", "ZY", ""])
def test_rotation_orders(tmp_path, order):
    """Every order, and fewer than three axes, against SciPy's intrinsic from_euler."""
    channels = f"CHANNELS {len(order)} " + " ".join(axis + "rotation" for axis in order)
    text = SMALL.replace("CHANNELS 3 Zrotation Xrotation Yrotation", channels)
    angles = np.random.default_rng(0).uniform(-400, 400, (7, 6 + len(order)))
    text = text[: text.index("Frames")] + "Frames: 7\nFrame Time: 0.1\n"
    text += "\n".join(" ".join(f"{x!r}" for x in row) for row in angles.tolist())
    clip = read_text(tmp_path, text)
    assert_pose_equal(clip, range(7))
    if order:
        expected = Rotation.from_euler(order, angles[:, 6:], degrees=True).as_quat(scalar_first=True)
        assert angle_deg(bvh.local(clip)[1][:, 1], expected).max() < 1e-9


def test_rotation_by_hand(tmp_path):
    """Zrotation 90 then Xrotation 90, intrinsic: the child's x points along y, its y along z."""
    row = "0 0 0 90 90 0 0 0 0"
    clip = read_text(tmp_path, SMALL[: SMALL.index("Frames")] + f"Frames: 1\nFrame Time: 1\n{row}\n")
    r = Rotation.from_quat(bvh.global_pose(clip)[1][0, 0], scalar_first=True).as_matrix()
    np.testing.assert_allclose(r[:, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(r[:, 1], [0, 0, 1], atol=1e-15)


def test_positions_replace_offset(tmp_path):
    """Per axis; the root's OFFSET is added on request; another joint's never is."""
    text = SMALL.replace("CHANNELS 6 Xposition Yposition Zposition", "CHANNELS 5 Zposition Xposition")
    text = text.replace("3 Zrotation Xrotation Yrotation", "4 Yrotation Yposition Xrotation Zrotation")
    clip = read_text(tmp_path, text)
    replaced, added = bvh.local(clip)[0], bvh.local(clip, "add")[0]
    assert replaced[0].tolist() == [[20, 2, 10], [0, 70, 0]]
    assert added[0].tolist() == [[21, 2, 13], [0, 70, 0]]
    assert_pose_equal(clip, [0, 1])
    assert_pose_equal(clip, [0, 1], "add")
    with pytest.raises(ValueError, match="'replace', 'add'"):
        bvh.global_pose(clip, "both")


def motion(text):
    """(text before the values, the values' lines)"""
    cut = text.index("0.04\n") + 5
    return text[:cut], text[cut:].splitlines()


HEAD, ROWS = motion(SMALL)
VARIANTS = {
    "crlf": SMALL.replace("\n", "\r\n"),
    "cr": SMALL.replace("\n", "\r"),
    "tabs": SMALL.replace("    ", "\t").replace("Frames: 2", "Frames:\t2").replace("Time: 0.04", "Time:\t4.0e-2"),
    "blank lines": "\n\n" + SMALL.replace("\n", "\n \n\n") + "\n\n\n",
    "trailing spaces": SMALL.replace("\n", " \t\n"),
    "byte order mark": "\ufeff" + SMALL,
    "brace on the joint's line": re.sub(r"\n\s*\{", " {", SMALL),
    "brace glued to the name": re.sub(r"\n\s*\{", "{", SMALL).replace("Site{", "Site {"),
    "lower case": SMALL.lower().replace("hips", "Hips").replace("knee", "Knee"),
    "no colon space": SMALL.replace("Frames: 2", "Frames :2").replace("Frame Time: ", "FrameTime:"),
    "scientific": SMALL.replace("10 20", "1e1 +2.0E+01").replace("-4.0", "-4e0"),
    "one value per line": HEAD + "\n".join(" ".join(ROWS).split()),
    "all on one line": HEAD + " ".join(ROWS),
    "ends without a newline": SMALL.rstrip(),
    "channels before the offset": re.sub(r"( +OFFSET.*\n)( +CHANNELS.*\n)", r"\2\1", SMALL),
}


@pytest.mark.parametrize("text", VARIANTS.values(), ids=VARIANTS)
def test_spellings_of_one_file(tmp_path, text):
    clip, same = read_text(tmp_path, text), read_text(tmp_path, SMALL)
    assert clip.names == same.names and clip.channels == same.channels and clip.frame_time == same.frame_time
    np.testing.assert_array_equal(clip.values, same.values)
    np.testing.assert_array_equal(clip.offsets, same.offsets)
    np.testing.assert_array_equal(clip.end_sites["Knee"], same.end_sites["Knee"])


def test_names(tmp_path):
    """Spaces, colons, other alphabets, and names that are keywords of the format."""
    for name in ("Left Knee", "mixamorig:Knee", "膝", "Motion", "ROOT", "Frames:"):
        assert read_text(tmp_path, SMALL.replace("Knee", name)).names == ("Hips", name)


def test_deep_chain(tmp_path):
    """3000 nested joints, read and written, without recursion; the turn of each adds up."""
    n = 3000
    q = np.tile(Rotation.from_euler("Z", 1, degrees=True).as_quat(scalar_first=True), (2, n, 1))
    names, parents, offsets = [f"j{i}" for i in range(n)], np.arange(n) - 1, np.tile([1.0, 0, 0], (n, 1))
    bvh.write(tmp_path / "deep.bvh", names, parents, offsets, 0.1, np.zeros((2, 3)), q)
    clip = bvh.read(tmp_path / "deep.bvh")
    assert clip.names == tuple(names) and clip.parents.tolist() == parents.tolist()
    positions, _ = bvh.global_pose(clip)
    steps = np.exp(1j * np.radians(np.arange(1, n)))
    np.testing.assert_allclose(positions[1, -1, :2], [steps.sum().real, steps.sum().imag], atol=1e-5)


def test_continuous_signs():
    q = Rotation.from_rotvec(np.linspace(0, 20, 200)[:, None] * [0, 0, 1.0]).as_quat(scalar_first=True)
    flips = np.random.default_rng(1).choice([-1.0, 1.0], 200)
    out = bvh.continuous((q * flips[:, None])[:, None])[:, 0]
    assert out[0, 0] > 0 and (np.sum(out[1:] * out[:-1], axis=-1) > 0.99).all()
    assert angle_deg(out, q).max() < 1e-9


# ---------------------------------------------------------------- writing


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 12), st.integers(1, 5), st.permutations("XYZ"))
def test_round_trip(tmp_path_factory, seed, J, T, order):
    """Random trees, some breadth-first, angles near gimbal lock among them; compared by joint name."""
    rng = np.random.default_rng(seed)
    names = [f"j{i}" for i in range(J)]
    parents = np.array([-1] + [int(rng.integers(0, j)) for j in range(1, J)])
    offsets = rng.normal(0, 30, (J, 3))
    angles = rng.uniform(-180, 180, (T, J, 3))
    angles[rng.random((T, J)) < 0.3, 1] = rng.choice([-90.0, 90.0, 90 - 1e-7, 0.0])
    order = "".join(order)
    q = Rotation.from_euler(order, angles.reshape(-1, 3), degrees=True).as_quat(scalar_first=True).reshape(T, J, 4)
    root = rng.normal(0, 500, (T, 3))
    sites = {names[-1]: rng.normal(0, 5, 3)}
    path = tmp_path_factory.mktemp("round") / "clip.bvh"
    bvh.write(path, names, parents, offsets, 1 / 72, root, q, sites, order)
    clip = bvh.read(path)

    index = [clip.names.index(name) for name in names]
    assert [clip.names[clip.parents[i]] if clip.parents[i] >= 0 else None for i in index] == [
        names[p] if p >= 0 else None for p in parents
    ]
    assert clip.frame_time == 1 / 72 and clip.channels[0][:3] == ("Xposition", "Yposition", "Zposition")
    assert np.abs(clip.end_sites[names[-1]] - sites[names[-1]]).max() < 1e-8
    positions, rotations = bvh.local(clip)
    assert angle_deg(rotations[:, index], q).max() < 1e-4
    assert np.abs(positions[:, 0] - root).max() < 1e-6 and np.abs(clip.offsets[index] - offsets).max() < 1e-6
    expected = slow_pose_of(parents, offsets, root, q)
    positions, rotations = bvh.global_pose(clip)
    # near gimbal lock angles come back 1e-8 rad off, and eleven joints of 30 cm add that up
    assert np.abs(positions[:, index] - expected).max() < 1e-5
    assert not list(path.parent.glob("*.tmp"))


def test_joints_that_move(tmp_path):
    """Six channels on a joint whose origin moves in its parent; its column order follows the hierarchy's."""
    rng = np.random.default_rng(5)
    names, parents, T = ["a", "b", "c", "d"], np.array([-1, 0, 0, 1]), 4
    q = Rotation.random(T * 4, random_state=6).as_quat(scalar_first=True).reshape(T, 4, 4)
    root, offsets, place = rng.normal(0, 50, (T, 3)), rng.normal(0, 9, (4, 3)), rng.normal(0, 9, (T, 3))
    bvh.write(tmp_path / "a.bvh", names, parents, offsets, 1 / 30, root, q, moving={"c": place})
    clip = bvh.read(tmp_path / "a.bvh")
    assert clip.names == ("a", "b", "d", "c") and [len(c) for c in clip.channels] == [6, 3, 3, 6]
    positions, rotations = bvh.local(clip)
    np.testing.assert_allclose(positions[:, 3], place, atol=1e-6)
    np.testing.assert_allclose(positions[:, 0], root, atol=1e-6)
    np.testing.assert_allclose(positions[:, 2], np.tile(offsets[3], (T, 1)), atol=1e-6)
    assert angle_deg(rotations[:, [0, 1, 3, 2]], q).max() < 1e-4
    with pytest.raises(bvh.BvhError, match="positions for 'x', which is no joint"):
        bvh.write(tmp_path / "b.bvh", names, parents, offsets, 1 / 30, root, q, moving={"x": place})
    with pytest.raises(bvh.BvhError, match="positions of 'c' has shape"):
        bvh.write(tmp_path / "b.bvh", names, parents, offsets, 1 / 30, root, q, moving={"c": place[:2]})


def slow_pose_of(parents, offsets, root, q):
    out = np.zeros((*q.shape[:2], 3))
    for t in range(len(q)):
        r = {}
        for j, parent in enumerate(parents):
            own = Rotation.from_quat(q[t, j], scalar_first=True)
            r[j] = own if parent < 0 else r[parent] * own
            out[t, j] = root[t] if parent < 0 else out[t, parent] + r[parent].apply(offsets[j])
    return out


def test_written_angles_do_not_jump(tmp_path):
    turn = Rotation.from_euler("Z", np.linspace(0, 1000, 101)[:, None], degrees=True).as_quat(scalar_first=True)
    bvh.write(tmp_path / "spin.bvh", ["a"], [-1], [[0, 0, 0]], 0.1, np.zeros((101, 3)), turn[:, None])
    assert np.abs(np.diff(bvh.read(tmp_path / "spin.bvh").values[:, 3:], axis=0)).max() < 11


def test_written_text(tmp_path):
    """The exact layout importers expect: one keyword per line, a brace alone, an End Site on every leaf."""
    bvh.write(tmp_path / "a.bvh", ["a", "b"], [-1, 0], np.eye(2, 3), 0.5, [[1, 2, 3]], [[[1, 0, 0, 0]] * 2])
    lines = (tmp_path / "a.bvh").read_text().split("\n")
    channels = "Zrotation Xrotation Yrotation"
    assert [line.strip() for line in lines] == [
        *("HIERARCHY", "ROOT a", "{", "OFFSET 1.000000000 0.000000000 0.000000000"),
        *(f"CHANNELS 6 Xposition Yposition Zposition {channels}", "JOINT b", "{"),
        *("OFFSET 0.000000000 1.000000000 0.000000000", f"CHANNELS 3 {channels}", "End Site", "{"),
        *("OFFSET 0.000000000 0.000000000 0.000000000", "}", "}", "}", "MOTION", "Frames: 1", "Frame Time: 0.5"),
        "1.000000000 2.000000000 3.000000000" + " 0.000000000" * 6,
        "",
    ]


GOOD = dict(
    names=["a", "b"], parents=[-1, 0], offsets=np.zeros((2, 3)), frame_time=0.1, root_positions=np.zeros((4, 3)),
    rotations=np.tile([1.0, 0, 0, 0], (4, 2, 1)),
)  # fmt: skip
UNWRITABLE = {
    "name with a space": (dict(names=["a", "b c"]), "'b c'"),
    "equal names": (dict(names=["a", "a"]), "unique"),
    "no joints": (dict(names=[], parents=[]), "0 joints"),
    "parent after child": (dict(parents=[-1, 1]), "earlier joints"),
    "two roots": (dict(parents=[-1, -1]), "earlier joints"),
    "float parents": (dict(parents=[-1.0, 0.5]), "earlier joints"),
    "offsets shape": (dict(offsets=np.zeros((3, 3))), r"offsets has shape \(3, 3\); expected \(2, 3\)"),
    "root shape": (dict(root_positions=np.zeros((5, 3))), r"expected \(4, 3\)"),
    "rotations shape": (dict(rotations=np.zeros((4, 2, 3))), r"expected \(4, 2, 4\)"),
    "flat rotations": (dict(rotations=np.zeros(4)), r"expected \(4, 2, 4\)"),
    "no frames": (dict(rotations=np.zeros((0, 2, 4))), "zero frames"),
    "nan root": (dict(root_positions=np.full((4, 3), np.nan)), r"nan at \[0, 0\]"),
    "zero quaternion": (dict(rotations=np.zeros((4, 2, 4))), "frame 0, joint 'a'"),
    "frame time": (dict(frame_time=0.0), "positive"),
    "order": (dict(order="ZXZ"), "permutation"),
    "end site": (dict(end_sites={"c": [0, 0, 0]}), "valid: a, b"),
}


@pytest.mark.parametrize("change, message", UNWRITABLE.values(), ids=UNWRITABLE)
def test_unwritable(tmp_path, change, message):
    path = tmp_path / "out.bvh"
    path.write_text("kept")
    with pytest.raises(bvh.BvhError, match=message) as e:
        bvh.write(path, **{**GOOD, **change})
    assert "\n" not in str(e.value) and str(e.value).startswith(str(path))
    assert path.read_text() == "kept" and list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------- malformed input


def swap(old, new, count=1):
    assert old in SMALL
    return SMALL.replace(old, new, count)


KNEE = SMALL[SMALL.index("    JOINT") : SMALL.index("}\nMOTION")]
MALFORMED = {  # name: (text, what the message must say)
    "empty": ("", "empty"),
    "only blank": ("\n \t\n", "empty"),
    "only a byte order mark": ("\ufeff", "HIERARCHY"),
    "another format": ("# Wavefront\nv 1 2 3\n", "not a BVH: starts with '#', expected HIERARCHY"),
    "binary": (b"HIERARCHY\n\x00\x01\x02", "binary data"),
    "image": (b"\x89PNG\r\n\x1a\n\xff\xfe", "not a BVH"),
    "utf-16": (SMALL.encode("utf-16"), "UTF-16"),
    "latin-1 name": (SMALL.replace("Knee", "Genügen").encode("latin-1"), "line 6: byte 0xfc is not UTF-8"),
    "hierarchy only word": ("HIERARCHY", "expected ROOT NAME"),
    "motion only": ("HIERARCHY\nMOTION\nFrames: 1\nFrame Time: 1\n0\n", "expected ROOT NAME"),
    "truncated in a joint": (SMALL[: SMALL.index("End Site")], "stops at the end of the file; expected '}' to close"),
    "truncated in an offset": (SMALL[: SMALL.index("-4.0")], "three numbers after OFFSET of joint 'Knee'"),
    "truncated in channels": (SMALL[: SMALL.index("Zrotation")], "6 channel names for joint 'Hips'"),
    "truncated after a name": ("HIERARCHY\nROOT Hips\n", "'{' after ROOT 'Hips'"),
    "brace missing": (swap("}\nMOTION", "MOTION"), "stops at MOTION; expected '}' to close joint 'Hips'"),
    "brace too many": (swap("}\nMOTION", "}\n}\nMOTION"), "line 16: found '}' outside every joint; expected MOTION"),
    "opening brace missing": (swap("ROOT Hips\n{", "ROOT Hips\n"), "found 'OFFSET' after ROOT 'Hips'; expected '{'"),
    "nameless": (swap("JOINT Knee", "JOINT"), "JOINT without a name"),
    "no channels": (swap("        CHANNELS 3 Zrotation Xrotation Yrotation\n", ""), "'Knee' has no CHANNELS"),
    "no offset": (swap("        OFFSET 0.0 -4.0 0.0\n", ""), "'Knee' has no OFFSET"),
    "end site without offset": (swap("            OFFSET 0.0 -5.0 0.0\n", ""), "Site of joint 'Knee' has no OFFSET"),
    "end site with channels": (swap("-5.0 0.0", "-5.0 0.0\nCHANNELS 1 Xrotation"), "found 'CHANNELS' in the End Site"),
    "joint in an end site": (swap("-5.0 0.0", "-5.0 0.0\nJOINT a\n{\n}"), "found 'JOINT' in the End Site"),
    "second offset": (swap("-4.0 0.0", "-4.0 0.0\nOFFSET 0 0 0"), "found 'OFFSET' in joint 'Knee'; expected one"),
    "second channels": (swap("        End", "CHANNELS 0\nEnd"), "found 'CHANNELS' in joint 'Knee'"),
    "offset of words": (swap("0.0 -4.0", "0.0 down"), "line 8: OFFSET of joint 'Knee' has 'down'"),
    "offset of two": (swap("0.0 -4.0 0.0", "0.0 -4.0"), "OFFSET of joint 'Knee' has 'CHANNELS'"),
    "offset of four": (swap("-4.0 0.0", "-4.0 0.0 7"), "line 8: found '7' in joint 'Knee'"),
    "offset nan": (swap("-4.0", "nan"), "OFFSET of joint 'Knee' has 'nan'; expected three finite numbers"),
    "unknown channel": (swap("3 Zrotation", "3 Wrotation"), "unknown channel 'Wrotation' on joint 'Knee'; valid: Xpos"),
    "channel twice": (swap("3 Zrotation", "3 Yrotation"), "line 9: channel Yrotation twice on joint 'Knee'"),
    "channel count of words": (swap("CHANNELS 3", "CHANNELS three"), "count 'three'; expected 0 to 6"),
    "channel count 7": (swap("CHANNELS 3", "CHANNELS 7"), "count '7'"),
    "channel count above": (swap("CHANNELS 3", "CHANNELS 4"), "lists 3 channels; its CHANNELS count says 4"),
    "channel count below": (swap("CHANNELS 3", "CHANNELS 2"), "found 'Yrotation' in joint 'Knee'"),
    "no channel at all": (re.sub(r"CHANNELS.*", "CHANNELS 0", SMALL), "no joint has a channel"),
    "equal names": (swap("Knee", "Hips"), "line 6: joint 'Hips' again (first on line 2)"),
    "two roots": (swap("}\nMOTION", "}\n" + KNEE.replace("JOINT Knee", "ROOT Two") + "MOTION"), "a second ROOT 'Two'"),
    "root inside": (swap("JOINT", "ROOT"), "found 'ROOT' in joint 'Hips'"),
    "joint outside": (swap("ROOT", "JOINT"), "found 'JOINT' outside every joint; expected ROOT NAME"),
    "unknown keyword": (swap("-4.0 0.0", "-4.0 0.0\nSCALE 2"), "found 'SCALE' in joint 'Knee'"),
    "no motion": (SMALL[: SMALL.index("MOTION")], "no MOTION section"),
    "no frames line": (swap("Frames: 2\n", ""), "line 16: no 'Frames: N'"),
    "ends after motion": (SMALL[: SMALL.index("Frames")], "no 'Frames: N'"),
    "frames zero": (swap("Frames: 2", "Frames: 0"), "line 17: Frames: '0'; expected a whole number of at least 1"),
    "frames negative": (swap("Frames: 2", "Frames: -2"), "'-2'"),
    "frames fraction": (swap("Frames: 2", "Frames: 2.5"), "'2.5'"),
    "frames word": (swap("Frames: 2", "Frames: two"), "'two'"),
    "frames endless": (swap("Frames: 2", "Frames: " + "9" * 6000), "whole number"),
    "frames million": (swap("Frames: 2", "Frames: 100000000000"), "found 18 values, expected 900000000000"),
    "no frame time": (swap("Frame Time: 0.04\n", ""), "no 'Frame Time: SECONDS'"),
    "frame time empty": (SMALL[: SMALL.index(" 0.04")], "Frame Time: ''; expected a positive number"),
    "frame time zero": (swap("0.04", "0.0"), "line 18: Frame Time: '0.0'; expected a positive number of seconds"),
    "frame time tiny": (swap("0.04", "0.00001"), "'0.00001'; expected a positive number of seconds, 0.001 to 1"),
    "frame time negative": (swap("0.04", "-0.04"), "'-0.04'"),
    "frame time nan": (swap("0.04", "nan"), "'nan'"),
    "frame time inf": (swap("0.04", "inf"), "'inf'"),
    "frame time comma": (swap("0.04", "0,04"), "'0,04'"),
    "no values": (SMALL[: SMALL.index("10 20")], "found 0 values, expected 18"),
    "row missing": (swap(ROWS[1], ""), "found 9 values, expected 18 (2 frames x 9 channels); they stop before frame 1"),
    "value missing": (swap("81 91", "81"), "found 17 values, expected 18"),
    "value missing early": (swap("80 90", "80"), "; line 19 has 8"),
    "row too many": (SMALL + ROWS[0], "found 27 values, expected 18"),
    "value of letters": (swap("81", "x81"), "line 20: 'x81' is not a number (frame 1 (from 0), Xrotation of 'Knee')"),
    "value with a comma": (swap("81", "8,1"), "line 20: '8,1' is not a number"),
    "value with an underscore": (swap("81", "8_1"), "'8_1' is not a number"),
    "value not utf-8": (SMALL.encode().replace(b"81", b"\xff1"), "line 20"),
    "value nan": (swap("81", "NaN"), "line 20: 'NaN' in frame 1 (from 0), Xrotation of 'Knee'; expected finite"),
    "value inf": (swap("10 ", "-inf "), "line 19: '-inf' in frame 0 (from 0), Xposition of 'Hips'"),
    "value overflows": (swap("10 ", "1e999 "), "'1e999' in frame 0"),
    "text after the values": (SMALL + "\nHIERARCHY\n", "line 22: 'HIERARCHY' is not a number"),
    "line separator in a name": (swap("JOINT Knee\n", "JOINT Kn\u2028ee\nx"), "found 'x' after JOINT 'Kn\\u2028ee'"),
    "very long word": (swap("-4.0", "z" * 100000), "..."),
}  # fmt: skip


@pytest.mark.parametrize("text, message", MALFORMED.values(), ids=MALFORMED)
def test_malformed(tmp_path, text, message):
    """Exactly one line, which starts with the file and says what was found or expected."""
    with pytest.raises(bvh.BvhError) as e:
        read_text(tmp_path, text, "broken.bvh")
    said = str(e.value)
    assert said.startswith(str(tmp_path / "broken.bvh")) and message in said
    assert len(said.splitlines()) == 1 and len(said) < 400 + len(str(tmp_path))


def test_long_lists():
    """A message lists a hundred names, and says how many there are."""
    assert bvh.listed("ab") == "a, b" and bvh.listed([]) == ""
    said = bvh.listed(map(str, range(10_000)))
    assert said.startswith("0, 1, ") and said.endswith("98, 99, … (10000)")


def test_outline():
    """A branch, and a chain of 10,000 joints, whose listing stays linear."""
    assert bvh.outline(["a", "b", "c", "d"], [-1, 0, 1, 0]) == ["a", "  b", "    c", "  d"]
    lines = bvh.outline(["x"] * 10_000, range(-1, 9_999))
    assert lines[39] == " " * 78 + "x" and {len(line) for line in lines[40:]} == {81}


def test_missing_file_names_itself(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere.bvh"):
        bvh.read(tmp_path / "nowhere.bvh")

"""mocap/data.py against SciPy's rotations, slow loops, hand values and a walk written as other skeletons' files.

Tests on recorded motion find it through the environment variable MOCAP_DIR; without it they are skipped.
"""

import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import quad
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from extras import train
from human import (
    FEET,
    PARENTS,
    SEG,
    SEGMENTS,
    Clip,
    angular_velocity,
    contacts,
    cross,
    footfalls,
    heading,
    linear_velocity,
    place,
    quat_about,
    quat_angle,
    quat_conj,
    quat_matrix,
    quat_mul,
    quat_rotate,
    quat_slerp,
    resample,
    sensors,
)
from mocap import augment, bvh, data, fetch, gait, inspect, stitch
from mocap.rigs import RIGS, _axis, from_amc, rig_of
from plumbing.cli import UserError

# ---------------------------------------------------------------- helpers

# our axes (x forward, y left, z up) -> a file's (x left, y up, z forward)
TO_FILE = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def rot(q):
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


def some_quats(n, seed=0):
    return Rotation.random(n, random_state=seed).as_quat(scalar_first=True)


def walk(seconds=8.0, rate=30.0, seed=3, kind="walk", name="walk_001", body="a", **params) -> Clip:
    m = gait.generate(kind, seconds, rate, seed=seed, **params)
    return Clip(name, body, m["rate"], m["pos"], m["quat"], m["ball"])


def still(n, rate=30.0) -> Clip:
    """An upright human at rest: every frame at the world's axes."""
    m = gait.generate("stand", 4.0, 30.0, seed=0, variation=0.0)
    quat = np.tile([1.0, 0, 0, 0], (n, 15, 1))
    return Clip("still", "a", rate, np.repeat(m["pos"][:1], n, 0), quat, np.repeat(m["ball"][:1], n, 0))


def angle(vectors, axis):
    """Degrees between vectors and an axis."""
    v = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.degrees(np.arccos(np.clip(v @ np.asarray(axis, float), -1, 1)))


def assert_same(a: Clip, b: Clip, atol=1e-6):
    assert len(a) == len(b) and a.rate == pytest.approx(b.rate, rel=1e-6)
    np.testing.assert_allclose(a.pos, b.pos, rtol=0, atol=atol)
    np.testing.assert_allclose(a.ball, b.ball, rtol=0, atol=atol)
    assert quat_angle(a.quat, b.quat).max() < 4 * atol


def write_as(path, rig_name, clip, order="ZYX", six=False, root_offset=None, rename=None):
    """Write a canonical clip as a BVH of a rig: matrices and Euler angles only.

    The rig's joints stand in the file's axes as its table says: joint axes = file axes of (forward, left, up), the
    forward one pitched down.  six: position channels everywhere and wrong OFFSETs.  root_offset: "relative" stores
    the root's positions relative to its OFFSET, "absolute" repeats the first frame as OFFSET beside absolute channels.
    """
    rig, rotation, position, names, parents = RIGS[rig_name], [], [], [], []
    world = rot(clip.quat.reshape(-1, 4)).as_matrix().reshape(len(clip), 15, 3, 3)
    if "joint_Root" in rig.signature:
        names, parents = ["joint_Root"], [-1]  # at the origin; without position channels elsewhere it has to travel
        rotation = [np.tile(np.eye(3), (len(clip), 1, 1))]
        position = [100.0 * (not six) * (clip.pos[:, 0] + world[:, 0] @ [0.02, 0.0, 0.08]) @ TO_FILE.T]
    for i, segment in enumerate(SEGMENTS):
        table = np.stack([_axis(a) for a in rig.axes[segment]], axis=1)
        down = Rotation.from_euler("y", rig.pitch.get(segment, 0.0), degrees=True).as_matrix()
        first = len(names) - i
        names.append(rig.joints[segment])
        parents.append(PARENTS[i] + first if i else first - 1)
        rotation.append(TO_FILE @ world[:, i] @ down @ table.T)
        p = clip.pos[:, i] + (world[:, 0] @ [0.02, 0.0, 0.08] if i == 0 else 0.0)  # its hips joint lies elsewhere
        position.append(100.0 * p @ TO_FILE.T)
    for j, ball in enumerate(rig.balls):
        foot = names.index(rig.joints["foot_" + "lr"[j]])
        names.append(ball)
        parents.append(foot)
        rotation.append(rotation[foot])
        position.append(100.0 * clip.ball[:, j] @ TO_FILE.T)
    children = {j: [k for k, p in enumerate(parents) if p == j] for j in range(len(names))}
    lines, rows = ["HIERARCHY"], []

    def joint(j):
        p = parents[j]
        if p < 0:
            r, x = rotation[j], position[j]
        else:
            r = np.einsum("tji,tjk->tik", rotation[p], rotation[j])
            x = np.einsum("tji,tj->ti", rotation[p], position[j] - position[p])
        offset = [3.0, 1.0, 2.0] if six else x.mean(0) if p >= 0 else x[0] if root_offset else np.zeros(3)
        channels = [a + "rotation" for a in order]
        values = Rotation.from_matrix(r).as_euler(order, degrees=True)
        if six or p < 0:
            channels, values = channels + ["Zposition", "Xposition", "Yposition"], np.hstack([values, x[:, [2, 0, 1]]])
            if root_offset == "relative":
                values[:, 3:] -= offset[[2, 0, 1]]
        rows.append(values)
        lines.extend([f"{'ROOT' if p < 0 else 'JOINT'} {(rename or {}).get(names[j], names[j])}", "{"])
        lines.append("OFFSET " + " ".join(f"{v:.9f}" for v in offset))
        lines.append(f"CHANNELS {len(channels)} {' '.join(channels)}")
        for k in children[j]:
            joint(k)
        lines.extend(["}"] if children[j] else ["End Site", "{", "OFFSET 0 0 0", "}", "}"])

    joint(0)
    lines += ["MOTION", f"Frames: {len(clip)}", f"Frame Time: {1 / clip.rate:.10f}"]
    lines += [" ".join(f"{v:.9f}" for v in row) for row in np.hstack(rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


# ---------------------------------------------------------------- quaternions


def test_quaternions():
    a, b = some_quats(200, 1), some_quats(200, 2)
    v = np.random.default_rng(3).standard_normal((200, 3))
    for sign in (1, -1):  # q and -q are one rotation
        np.testing.assert_allclose(quat_rotate(sign * a, v), rot(a).apply(v), atol=1e-12)
        np.testing.assert_allclose(quat_matrix(sign * a), rot(a).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(quat_angle(sign * a, b), (rot(a) * rot(b).inv()).magnitude(), atol=1e-12)
        assert quat_angle(sign * a, a).max() < 1e-7
    np.testing.assert_array_equal(cross(a[:, 1:], v), np.cross(a[:, 1:], v))
    product = rot(quat_mul(a, b)).as_matrix()
    np.testing.assert_allclose(product, (rot(a) * rot(b)).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rot(quat_conj(a)).as_matrix(), rot(a).inv().as_matrix(), atol=1e-12)
    np.testing.assert_allclose(quat_mul(a, b)[..., 0], np.sum(quat_conj(a) * b, -1), atol=1e-12)
    for axis, letter in enumerate("xyz"):
        for degrees in (0, 30, -90, 179, 180):
            q = quat_about(axis, np.radians(degrees))
            want = Rotation.from_euler(letter, degrees, degrees=True).as_matrix()
            np.testing.assert_allclose(rot(q).as_matrix(), want, atol=1e-12)
            assert quat_angle(q, [1.0, 0, 0, 0]) == pytest.approx(np.radians(abs(degrees)), abs=1e-12)
    # batches broadcast as NumPy arrays do
    grid = quat_mul(a[:6].reshape(2, 3, 4), b[:3])
    np.testing.assert_allclose(grid[1, 2], quat_mul(a[5], b[2]), atol=0)


def test_velocities():
    rate, omega = 50.0, np.array([1.0, -2.0, 3.0])
    t = np.arange(40) / rate
    start = rot(some_quats(1, 5)[0])
    q = (Rotation.from_rotvec(t[:, None] * omega) * start).as_quat(scalar_first=True)  # turns about a WORLD axis
    q[::3] *= -1
    np.testing.assert_allclose(angular_velocity(q, rate), np.tile(omega, (40, 1)), atol=1e-9)

    # an irregular motion of several segments, frame by frame
    wild = np.cumsum(np.random.default_rng(0).normal(0, 0.2, (30, 2, 3)), axis=0)
    q = Rotation.from_rotvec(wild.reshape(-1, 3)).as_quat(scalar_first=True).reshape(30, 2, 4)
    got = angular_velocity(q, rate)
    for i in range(30):
        for j in range(2):
            a, b = max(i - 1, 0), min(i + 1, 29)
            want = (rot(q[b, j]) * rot(q[a, j]).inv()).as_rotvec() * rate / (b - a)
            np.testing.assert_allclose(got[i, j], want, atol=1e-9)
    assert not angular_velocity(np.tile([1.0, 0, 0, 0], (5, 1)), rate).any()

    x = np.stack([t**2, np.sin(t), 3 * t], axis=-1)
    v = linear_velocity(x, rate)
    np.testing.assert_allclose(v[1:-1, 0], 2 * t[1:-1], atol=1e-9)  # exact for a parabola
    np.testing.assert_allclose(v, np.gradient(x, 1 / rate, axis=0), atol=1e-9)
    assert (linear_velocity(x[:1], rate) == 0).all() and angular_velocity(q[:1], rate).shape == (1, 2, 3)
    np.testing.assert_allclose(linear_velocity(x[:2], rate), np.tile((x[1] - x[0]) * rate, (2, 1)), atol=1e-12)


def test_heading_does_not_flip():
    pitch = np.arange(-175, 176, 5)
    for yaw in (-170, -90, -20, 0, 45, 135, 180):
        q = Rotation.from_euler("ZY", np.stack([np.full(len(pitch), yaw), pitch], -1), degrees=True)
        q = q.as_quat(scalar_first=True)
        q[::2] *= -1
        off = np.degrees(heading(q)) - yaw
        np.testing.assert_allclose((off + 180) % 360 - 180, 0, atol=1e-6)
    # the projected forward axis does flip: bent over by more than 90 degrees, the forward axis points backwards
    assert rot(quat_about(1, np.radians(100))).apply([1, 0, 0])[0] < 0
    # leaning sideways turns nothing either, and an upright root's heading is its yaw
    lean = Rotation.from_euler("ZX", [[30, r] for r in (-80, -20, 0, 50, 80)], degrees=True)
    np.testing.assert_allclose(heading(lean.as_quat(scalar_first=True)), np.radians(30), atol=1e-12)
    clip = walk(4.0)
    yaw = rot(clip.quat[:, 0]).as_euler("ZXY")[:, 0]  # Z then X then Y: the last turn is the one about the left axis
    np.testing.assert_allclose(heading(clip.quat[:, 0]), yaw, atol=1e-9)


# ---------------------------------------------------------------- reading


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("order, six, rate", [("ZYX", False, 30.0), ("XZY", True, 60.0), ("YXZ", False, 120.0)])
def test_same_human_from_any_file(tmp_path, rig, order, six, rate):
    """One walk written in each rig, with any channel order, by OFFSET or by position channels, comes back as itself."""
    clip = walk(3.0, rate, turn_rate=0.4)
    path = write_as(tmp_path / "walk_001.bvh", rig, clip, order, six)
    got = data.from_bvh(path)
    assert_same(got, clip)
    assert got.name == "walk_001" and got.body == f"{rig}-leg86-arm58"  # 0.491 and 0.332 of 1.75 m
    np.testing.assert_array_equal(contacts(got), contacts(clip))


@pytest.mark.parametrize("rig", RIGS)
def test_rigs_stand_upright(tmp_path, rig):
    """Hand values: in a standing person's file every anatomical frame is the world's, whatever the joints' own axes."""
    got = data.from_bvh(write_as(tmp_path / "stand.bvh", rig, still(3)))
    assert quat_angle(got.quat, [1.0, 0, 0, 0]).max() < 1e-6
    for segment in SEGMENTS:
        c = rot(RIGS[rig].calibration(segment)).as_matrix()
        assert np.linalg.det(c) == pytest.approx(1.0)
        forward, left, up = (_axis(a) for a in RIGS[rig].axes[segment])
        np.testing.assert_allclose(np.cross(forward, left), up, atol=1e-9)  # right-handed table
        p = np.radians(RIGS[rig].pitch.get(segment, 0.0))
        np.testing.assert_allclose(c.T @ forward, [np.cos(p), 0, -np.sin(p)], atol=1e-9)  # points down by the pitch
        np.testing.assert_allclose(c.T @ left, [0, 1, 0], atol=1e-9)


def walking_human(source, mocap_dir):
    """A person walking ahead: the built-in one, or a recording's walking frames."""
    if source == "builtin":
        return walk(10.0, variation=0.0)
    if source == "lafan1":
        return data.load(mocap_dir / "lafan1")[0]
    return data.load(mocap_dir / "bandai", clips="*walk_normal_001")[0]


@pytest.mark.parametrize("source", ["builtin", "bandai", "lafan1"])
def test_anatomy(source, request):
    """Every source alike: people face where they go, left is left, segments lie along their bones, joints flex."""
    clip = walking_human(source, None if source == "builtin" else request.getfixturevalue("mocap_dir"))
    unit = lambda s, axis: rot(clip.quat[:, SEG[s]]).apply(axis)  # noqa: E731
    velocity = linear_velocity(clip.pos[:, 0], clip.rate) * [1, 1, 0]
    moving = np.linalg.norm(velocity, axis=-1) > 0.7
    assert moving.mean() > 0.5
    psi = heading(clip.quat[:, 0])
    ahead = np.stack([np.cos(psi), np.sin(psi), 0 * psi], -1)
    left = np.stack([-np.sin(psi), np.cos(psi), 0 * psi], -1)
    travel = velocity[moving] / np.linalg.norm(velocity[moving], axis=-1, keepdims=True)
    assert np.sum(travel * ahead[moving], -1).mean() > 0.95
    for s in ("pelvis", "chest", "head"):
        assert np.median(np.sum(unit(s, [1, 0, 0]) * ahead, -1)) > 0.9
        assert np.sum(unit(s, [0, 0, 1]) * [0, 0, 1], -1).mean() > 0.9
    for s in ("thigh", "shin", "foot", "upper_arm", "hand"):
        apart = np.sum((clip.pos[:, SEG[s + "_l"]] - clip.pos[:, SEG[s + "_r"]]) * left, -1)
        assert apart.mean() > 0.05, s
    for side in "lr":
        for a, b in (("thigh", "shin"), ("shin", "foot"), ("upper_arm", "forearm"), ("forearm", "hand")):
            bone = clip.pos[:, SEG[f"{b}_{side}"]] - clip.pos[:, SEG[f"{a}_{side}"]]
            bone /= np.linalg.norm(bone, axis=-1, keepdims=True)
            assert np.sum(-unit(f"{a}_{side}", [0, 0, 1]) * bone, -1).min() > np.cos(np.radians(10)), (a, side)
        knee, elbow = (
            np.degrees((rot(clip.quat[:, SEG[a]]).inv() * rot(clip.quat[:, SEG[b]])).as_rotvec())
            for a, b in ((f"thigh_{side}", f"shin_{side}"), (f"upper_arm_{side}", f"forearm_{side}"))
        )  # flexion in degrees about the left axis
        assert -10 < knee[:, 1].min() and 40 < knee[:, 1].max() < 140 and 10 < knee[:, 1].mean() < 60
        assert np.abs(knee[:, [0, 2]]).max() < 25
        assert elbow[:, 1].mean() < -3 and elbow[:, 1].max() < 20
        foot, ball = SEG[f"foot_{side}"], clip.ball[:, "lr".index(side)]
        along = rot(clip.quat[:, foot]).inv().apply(ball - clip.pos[:, foot])
        assert (along[:, 0] > 0.05).all() and (np.abs(along[:, 1]) < 0.06).all()
        low = (np.abs(ball[:, 2] - np.percentile(ball[:, 2], 10)) < 0.01) & (
            clip.pos[:, foot, 2] < np.percentile(clip.pos[:, foot, 2], 25)
        )  # heel and ball both down: the sole is flat
        assert abs(90 - np.median(angle(unit(f"foot_{side}", [1, 0, 0])[low], [0, 0, 1]))) < 10
    assert 0.7 < clip.hip_height < 1.1
    assert 0.35 < contacts(clip).mean() < 0.75


@pytest.mark.parametrize("name", ["bandai/dataset-2_walk-turn-left_active_001", "lafan1/Lafan1_example"])
def test_bvh_against_scipy(mocap_dir, name):
    """Recorded files: SciPy's rotations down the chain, then centimetres and y up made metres and z up by a matrix."""
    b = bvh.read(mocap_dir / f"{name}.bvh")
    clip = data.from_bvh(mocap_dir / f"{name}.bvh")
    rig = RIGS[name.split("/")[0]]
    assert len(clip) == len(b.values) and clip.rate == pytest.approx(30.0, rel=1e-4)
    for t in (0, len(clip) // 2, len(clip) - 1):
        row, position, rotation = iter(b.values[t]), {}, {}
        for j, joint in enumerate(b.names):
            x, r = b.offsets[j].copy(), np.eye(3)
            for channel in b.channels[j]:
                value, axis = next(row), channel[0]
                if channel.endswith("rotation"):
                    r = r @ Rotation.from_euler(axis, value, degrees=True).as_matrix()
                else:  # this LaFAN1 file's root lies relative to its OFFSET; everywhere else channels replace it
                    add = b.offsets[j]["XYZ".index(axis)] if "lafan1" in name else 0.0
                    x["XYZ".index(axis)] = value + add
            if j:
                up = b.names[b.parents[j]]
                x, r = position[up] + rotation[up] @ x, rotation[up] @ r
            position[joint], rotation[joint] = x, r
        metres = {k: TO_FILE.T @ v / 100 for k, v in position.items()}
        for i, segment in enumerate(SEGMENTS):
            j = rig.joints[segment]
            want = metres[j]
            if segment == "pelvis":
                want = (metres[rig.joints["thigh_l"]] + metres[rig.joints["thigh_r"]]) / 2
            np.testing.assert_allclose(clip.pos[t, i], want, atol=1e-9)
            axes = [TO_FILE.T @ rotation[j] @ _axis(a) for a in rig.axes[segment]]
            p = np.radians(rig.pitch.get(segment, 0.0))
            forward = np.cos(p) * axes[0] + np.sin(p) * axes[2]  # the joint's forward axis, lifted by the pitch
            got = rot(clip.quat[t, i]).as_matrix()
            np.testing.assert_allclose(got[:, 0], forward, atol=1e-9)
            np.testing.assert_allclose(got[:, 1], axes[1], atol=1e-9)
        np.testing.assert_allclose(clip.ball[t], [metres[n] for n in rig.balls], atol=1e-9)
    assert -0.04 < np.percentile(clip.ball[..., 2].min(1), 20) < 0.06  # the feet are on the floor, as captured


@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_root_offset(tmp_path, kind):
    """The root's OFFSET is added or not, whichever puts the feet on the floor."""
    clip = walk(2.0)
    assert_same(data.from_bvh(write_as(tmp_path / "a.bvh", "lafan1", clip, root_offset=kind)), clip)


def test_unknown_rig(tmp_path):
    """Known rigs by their joints' names; the rest is tests/mocap/test_rigs.py's."""
    for name in RIGS:
        assert rig_of(bvh.read(write_as(tmp_path / "ok.bvh", name, still(2)))) == name
    other = write_as(tmp_path / "odd.bvh", "lafan1", still(2), rename={"LeftToe": "LeftBigToe"})
    assert rig_of(bvh.read(other)) is None


def test_bandai_loads_in_seconds(mocap_dir):
    """A quarter of the 716 clips, so that the suite stays short."""
    rigs = {f.name: f.read_text().partition("MOTION")[0] for f in sorted((mocap_dir / "bandai").glob("*_00?.bvh"))}
    names = [tuple(re.findall(r"(?:ROOT|JOINT) (\S+)", text)) for text in rigs.values()]
    odd = [file for file, n in zip(rigs, names, strict=True) if n != max(set(names), key=names.count)]
    if len(rigs) != 180 or odd:
        pytest.skip(
            f"not the data set as published: {len(rigs)} of 180 files, of another rig: {', '.join(odd) or 'none'}"
        )
    start = time.process_time()
    clips = data.load(mocap_dir / "bandai", clips="*_00?")
    seconds = time.process_time() - start
    print(f"{len(clips)} clips in {seconds:.1f} s: 716 in {716 * seconds / len(clips):.1f} s")
    assert len(clips) == 180 and seconds < 20
    assert len({c.body for c in clips}) == 1 and {c.rate for c in clips} == {30.0}


# ---------------------------------------------------------------- rate, place, sensors, contacts


@pytest.mark.parametrize("rate, new", [(30, 120), (120, 30), (60, 30), (100, 30), (30, 36), (24, 30)])
def test_resample(rate, new):
    clip = walk(2.0, float(rate))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], clip.quat.shape[:2] + (1,))
    mixed = replace(clip, quat=clip.quat * signs)  # the shorter arc, whatever the signs
    got = resample(mixed, new)
    old, t = np.arange(len(clip)) / rate, np.arange(len(got)) / new
    assert got.rate == new and t[-1] <= old[-1] + 1e-9 < t[-1] + 1 / new + 1e-6
    t = np.minimum(t, old[-1])
    for j in (0, SEG["foot_l"], SEG["hand_r"]):
        want = np.stack([np.interp(t, old, clip.pos[:, j, k]) for k in range(3)], -1)
        np.testing.assert_allclose(got.pos[:, j], want, atol=1e-9)
        want = Slerp(old, rot(clip.quat[:, j]))(t)
        assert (rot(got.quat[:, j]) * want.inv()).magnitude().max() < 1e-7
    np.testing.assert_allclose(got.ball[:, 1, 2], np.interp(t, old, clip.ball[:, 1, 2]), atol=1e-9)
    assert (np.sum(got.quat[1:] * got.quat[:-1], -1) > 0).all()  # continuous signs
    np.testing.assert_allclose(np.linalg.norm(got.quat, axis=-1), 1, atol=1e-12)
    if rate == 60:
        np.testing.assert_allclose(got.pos, clip.pos[::2], atol=1e-12)
    assert resample(clip, rate).pos is clip.pos


def test_slerp_ends():
    a, b = some_quats(50, 1), some_quats(50, 2)
    for q in (b, -b):
        assert quat_angle(quat_slerp(a, q, np.zeros(50)), a).max() < 1e-7
        assert quat_angle(quat_slerp(a, q, np.ones(50)), b).max() < 1e-7
        half = quat_slerp(a, q, np.full(50, 0.5))
        np.testing.assert_allclose(quat_angle(half, a), quat_angle(a, b) / 2, atol=1e-7)
    same = quat_slerp(a, -a * (1 + 1e-16), np.full(50, 0.3))
    assert np.isfinite(same).all() and quat_angle(same, a).max() < 1e-7


def test_place():
    clip = walk(1.0)
    yaw, pivot, to = 2.5, clip.pos[10, 0, :2], np.array([3.0, -4.0])
    got = place(clip, yaw, pivot, to)
    r = Rotation.from_euler("z", yaw)
    np.testing.assert_allclose(got.pos[10, 0, :2], to, atol=1e-12)
    np.testing.assert_allclose(got.pos[..., 2], clip.pos[..., 2], atol=1e-12)
    want = r.apply(clip.pos[5] - [*pivot, 0]) + [*to, 0]
    np.testing.assert_allclose(got.pos[5], want, atol=1e-12)
    np.testing.assert_allclose(got.ball[5], r.apply(clip.ball[5] - [*pivot, 0]) + [*to, 0], atol=1e-12)
    np.testing.assert_allclose(rot(got.quat[5]).as_matrix(), (r * rot(clip.quat[5])).as_matrix(), atol=1e-12)
    turned = heading(got.quat[:, 0]) - heading(clip.quat[:, 0]) - yaw
    np.testing.assert_allclose((turned + np.pi) % (2 * np.pi) - np.pi, 0, atol=1e-9)


def test_sensors():
    clip = walk(2.0)
    pos, quat = sensors(clip)
    for row, (segment, offset) in enumerate(
        [("head", [0.11, 0, 0.08]), ("hand_l", [0.02, 0, -0.09]), ("hand_r", [0.02, 0, -0.09])]
    ):
        want = clip.pos[:, SEG[segment]] + rot(clip.quat[:, SEG[segment]]).apply(offset)
        np.testing.assert_allclose(pos[:, row], want, atol=1e-12)
        np.testing.assert_array_equal(quat[:, row], clip.quat[:, SEG[segment]])
    # by hand: facing left (+y), the eyes lie 11 cm to the left of the neck; hanging hands hold 9 cm below the wrists
    left = place(still(2), np.pi / 2, np.zeros(2), np.zeros(2))
    pos, _ = sensors(left)
    np.testing.assert_allclose(pos[0, 0] - left.pos[0, SEG["head"]], [0, 0.11, 0.08], atol=1e-12)
    np.testing.assert_allclose(pos[0, 1] - left.pos[0, SEG["hand_l"]], [0, 0.02, -0.09], atol=1e-12)


def test_contacts():
    def feet(ankle_z, ankle_v, ball_z, ball_v):
        """Left foot as asked, right foot a metre up."""
        clip, t = still(9), np.arange(9)[:, None] / 30.0
        pos, ball = clip.pos.copy(), clip.ball.copy()
        pos[:, FEET[0]] = [0, 0, ankle_z] + t * ankle_v
        ball[:, 0] = [0.1, 0, ball_z] + t * ball_v
        pos[:, FEET[1]] = ball[:, 1] = [0, 0, 1.0]
        c = contacts(replace(clip, pos=pos, ball=ball))
        assert c.dtype == bool and c.shape == (9, 2) and not c[:, 1].any() and (c[:, 0] == c[0, 0]).all()
        return c[0, 0]

    x, fast = np.array([1.0, 0, 0]), np.array([2.0, 0, 0])
    assert feet(0.19, 0 * x, 0.5, fast) and not feet(0.21, 0 * x, 0.5, fast)  # 0.20 m
    assert feet(0.1, 0.39 * x, 0.5, fast) and not feet(0.1, 0.41 * x, 0.5, fast)  # 0.4 m/s
    assert not feet(0.05, 0.3 * np.array([1, 1, 0.2]), 0.5, fast)  # 0.43 m/s: all three axes count
    assert feet(0.5, fast, 0.02, 0 * x)  # heel up, ball down: toe-off is still contact
    assert feet(0.1, 0 * x, 0.3, fast)  # heel down, ball up: so is heel strike
    assert not feet(0.5, 0 * x, 0.02, fast) and not feet(0.1, fast, 0.3, 0 * x)  # each point by itself

    clip = walk(3.0)
    want = np.zeros((len(clip), 2), bool)
    for i in range(len(clip)):
        a, b = max(i - 1, 0), min(i + 1, len(clip) - 1)
        for side, foot in enumerate(("foot_l", "foot_r")):
            for p in (clip.pos[:, SEG[foot]], clip.ball[:, side]):
                speed = np.linalg.norm(p[b] - p[a]) / ((b - a) / clip.rate)
                want[i, side] |= p[i, 2] < 0.20 and speed < 0.4
    np.testing.assert_array_equal(contacts(clip), want)
    assert 0.5 < want.mean() < 0.75  # a walk: each foot is down about 62 % of the time
    # labels belong to the human: half the size would move half as fast and be down more often
    small = replace(clip, pos=0.5 * clip.pos, ball=0.5 * clip.ball)
    assert contacts(small).mean() > want.mean() + 0.02


# ---------------------------------------------------------------- stitching


def pieces(seed=0, n=12, body="a"):
    """Short clips of one person: cuts of 3 to 7 s out of three walks."""
    rng, out = np.random.default_rng(seed), []
    for k, speed in enumerate((1.0, 1.2, 1.35)):
        long, at = walk(40.0, seed=seed + k, speed=speed), 0
        for i in range(n // 3):
            length = int(rng.uniform(90, 210))
            out.append(replace(long[at : at + length], name=f"cut_{k}{i:02d}", body=body))
            at += length
    return out


@pytest.fixture
def parts_of(monkeypatch):
    """What stitch joins: a list of (clip, first frame, last frame) for each sequence, filled as it runs."""
    seen, join = [], stitch.join

    def spy(parts, blend, name):
        seen.append(parts)
        return join(parts, blend, name)

    monkeypatch.setattr(stitch, "join", spy)
    return seen


def slow_feature(clip, t):
    """(8, 6): position on the floor below the root and 0.1 s of velocity, turned into the heading frame by SciPy."""
    a, b = max(t - 1, 0), min(t + 1, len(clip) - 1)
    left = rot(clip.quat[t, 0]).apply([0, 1, 0])
    back = Rotation.from_euler("z", -np.arctan2(-left[0], left[1]))
    rows = []
    for s in ("chest", "head", "shin_l", "foot_l", "shin_r", "foot_r", "hand_l", "hand_r"):
        p = clip.pos[:, SEG[s]]
        v = (p[b] - p[a]) * clip.rate / (b - a)
        root = clip.pos[t, 0] * [1, 1, 0]
        rows.append(np.concatenate([back.apply(p[t] - root), 0.1 * back.apply(v)]))
    return np.array(rows)


def slow_distance(a, i, b, j):
    d = slow_feature(a, i) - slow_feature(b, j)
    return np.sqrt(np.mean(np.sum(d**2, axis=1)))


def test_stitch_distance():
    a, b = walk(2.0, speed=1.1), walk(2.0, seed=4, speed=1.4, turn_rate=0.5)
    fa, fb = stitch.motion_features(a), stitch.motion_features(b)
    for i, j in ((0, 0), (10, 30), (59, 59), (25, 7)):
        assert np.linalg.norm(fa[i] - fb[j]) == pytest.approx(slow_distance(a, i, b, j), abs=1e-6)
    # where on the plane and which way it faces do not matter
    moved = stitch.motion_features(place(a, 2.0, np.array([1.0, 2]), np.array([-5.0, 7])))
    np.testing.assert_allclose(moved, fa, atol=1e-5)
    # by hand: one of the eight joints 8 cm higher is sqrt(0.08²/8); a body going 1 m/s faster is 10 cm off
    rest = still(3)
    pos = rest.pos.copy()
    pos[:, SEG["hand_l"], 2] += 0.08
    f = stitch.motion_features(rest)
    lifted = stitch.motion_features(replace(rest, pos=pos))
    assert np.linalg.norm(lifted[1] - f[1]) == pytest.approx(0.08 / np.sqrt(8), abs=1e-6)
    drift = replace(rest, pos=rest.pos + np.arange(3)[:, None, None] / rest.rate * [1.0, 0, 0])
    assert np.linalg.norm(stitch.motion_features(drift)[1] - f[1]) == pytest.approx(0.1, abs=1e-6)


def test_stitch(parts_of):
    clips = pieces()
    copies = [c.pos.copy() for c in clips]
    out, report = stitch.stitch(clips, np.random.default_rng(0))
    first, parts = [(c.name, c.pos.tobytes(), c.quat.tobytes(), c.ball.tobytes()) for c in out], list(parts_of)
    assert all(np.array_equal(c.pos, p) for c, p in zip(clips, copies))
    assert len(out) >= 2 and all(c.seconds >= 30 for c in out) and {c.rate for c in out} == {30.0}

    # the same seed gives the same bytes, another seed other ones
    again, _ = stitch.stitch(clips, np.random.default_rng(0))
    assert [(c.name, c.pos.tobytes(), c.quat.tobytes(), c.ball.tobytes()) for c in again] == first
    other, _ = stitch.stitch(clips, np.random.default_rng(1))
    assert [c.pos.tobytes() for c in other] != [f[1] for f in first]

    # the report, counted another way
    used, distances = {c.name: set() for c in clips}, []
    for joined in parts:
        for clip, a, b in joined:
            used[clip.name] |= set(range(a, b + 1))
        distances += [slow_distance(x[0], x[2], y[0], y[1]) for x, y in zip(joined, joined[1:])]
    assert report.sequences == len(out) and report.seconds == pytest.approx(sum(len(c) for c in out) / 30)
    assert report.joins == len(distances) > 0 and report.frames == sum(map(len, clips))
    np.testing.assert_allclose(report.distances, distances, atol=1e-3)
    assert max(distances) <= 0.15 and report.frames_used == sum(map(len, used.values())) > 0.7 * report.frames
    assert report.lost == [n for n, frames in used.items() if not frames]
    assert f"{report.joins} joins" in str(report) and "limit 15" in str(report)

    # only joins below the limit: one that most of these joins would break, then one that all would
    parts_of.clear()
    limit = 0.008
    fewer, told = stitch.stitch(clips, np.random.default_rng(0), limit=limit)
    assert fewer and all(c.seconds >= 30 for c in fewer) and max(told.distances) <= limit < max(distances)
    exits = [len(clip) - b for joined in parts_of for clip, _, b in joined[:-1]]
    assert max(exits) > 30  # some had to be left early, yet never before a second was over
    assert all(b - a >= 30 for joined in [*parts, *parts_of] for _, a, b in joined[:-1])
    none, told = stitch.stitch(clips, np.random.default_rng(0), limit=1e-6)
    assert none == [] and told.lost == [c.name for c in clips] and f"lost {len(clips)} clips" in str(told)


def check_joins(clips, out, parts):
    """Frame by frame with SciPy: rigid copies of the source, turned about the vertical, ten blended frames a join."""
    for sequence, joined in zip(out, parts, strict=True):
        clip, a, b = joined[0]
        turn, shift = Rotation.identity(), np.zeros(3)
        want, wanted = [clip.pos[t] for t in range(a, b)], [rot(clip.quat[t]) for t in range(a, b)]
        blended = 0
        for new, na, nb in joined[1:]:
            place_old = lambda t, c=clip, r=turn, s=shift: (r.apply(c.pos[t]) + s, r * rot(c.quat[t]))  # noqa: E731
            left = place_old(b)[1][0].apply([0, 1, 0])
            new_left = rot(new.quat[na, 0]).apply([0, 1, 0])
            turn = Rotation.from_euler("z", np.arctan2(-left[0], left[1]) - np.arctan2(-new_left[0], new_left[1]))
            shift = (place_old(b)[0][0] - turn.apply(new.pos[na, 0])) * [1, 1, 0]
            place_new = lambda t, c=new, r=turn, s=shift: (r.apply(c.pos[t]) + s, r * rot(c.quat[t]))  # noqa: E731
            np.testing.assert_allclose(place_new(na)[0][0, :2], place_old(b)[0][0, :2], atol=1e-9)
            for k in range(10):
                x = (k + 1) / 11
                w = 3 * x**2 - 2 * x**3
                (p, r), (p_new, r_new) = place_old(b + k), place_new(na + k)
                want.append((1 - w) * p + w * p_new)
                wanted.append(Rotation.from_rotvec(w * (r_new * r.inv()).as_rotvec()) * r)
                blended += 1
            for t in range(na + 10, nb):
                p, r = place_new(t)
                want.append(p), wanted.append(r)
            clip, b = new, nb
        want.append(turn.apply(clip.pos[b]) + shift), wanted.append(turn * rot(clip.quat[b]))
        assert blended == 10 * (len(joined) - 1)
        np.testing.assert_allclose(sequence.pos, want, atol=1e-8)
        off = [(rot(q) * r.inv()).magnitude().max() for q, r in zip(sequence.quat, wanted)]
        assert max(off) < 1e-6
        assert (np.sum(sequence.quat[1:] * sequence.quat[:-1], -1) > 0).all()

    # across joins nothing jumps more than it does in the clips themselves
    step = lambda c: np.linalg.norm(np.diff(c.pos, axis=0), axis=-1).max()  # noqa: E731
    twist = lambda c: quat_angle(c.quat[1:], c.quat[:-1]).max()  # noqa: E731
    jerk = lambda c: np.linalg.norm(np.diff(c.pos[:, 0], n=2, axis=0), axis=-1).max() * c.rate  # noqa: E731
    assert max(map(step, out)) < 1.2 * max(map(step, clips))
    assert max(map(twist, out)) < 1.2 * max(map(twist, clips)) + np.radians(2)
    assert max(map(jerk, out)) < max(map(jerk, clips)) + 0.15  # m/s from frame to frame


def test_stitch_joins(parts_of):
    clips = pieces()
    out, _ = stitch.stitch(clips, np.random.default_rng(0))
    check_joins(clips, out[:3], parts_of[:3])


def test_stitch_recorded(mocap_dir, parts_of):
    clips = data.load(mocap_dir / "bandai", clips="*_normal_00?", split="train")
    out, report = stitch.stitch(clips, np.random.default_rng(0))
    print(report)
    assert len(out) > 5 and all(c.seconds >= 30 for c in out) and report.frames_used > 0.6 * report.frames
    check_joins(clips, out[:4], parts_of[:4])


def test_stitch_bodies(parts_of):
    """Clips of different bodies are never joined; what is too few to join is lost, and named; long clips pass."""
    a, b = pieces(), [replace(c, name=f"b_{c.name}", body="b") for c in pieces(seed=7)]
    lone = replace(a[0][:35], name="lone", body="c")  # too short to be joined even to itself
    long = walk(31.0, name="long", body="d")
    out, report = stitch.stitch([*a, *b, lone, long], np.random.default_rng(0))
    assert all(len({clip.body for clip, _, _ in joined}) == 1 for joined in parts_of)
    assert [c.body for c in out] == ["d"] + [joined[0][0].body for joined in parts_of]
    assert {"a", "b", "d"} == {c.body for c in out}
    assert out[0] is long and "lone" in report.lost
    assert f"lost {len(report.lost)} clips" in str(report)
    only, report = stitch.stitch([long], np.random.default_rng(0))
    assert only == [long] and report.frames_used == len(long) and "no joins needed" in str(report)
    nothing, report = stitch.stitch([lone], np.random.default_rng(0))
    assert nothing == [] and report.lost == ["lone"] and "lost 1 clips (lone)" in str(report)
    with pytest.raises(ValueError, match="30, 60 Hz"):
        stitch.stitch([lone, replace(lone, rate=60.0)], np.random.default_rng(0))


def test_two_people_in_one_rig_are_two_bodies(tmp_path):
    for height in (1.6, 1.75):
        write_as(tmp_path / f"h{100 * height:.0f}.bvh", "lafan1", walk(1.0, height=height))
    assert len({c.body for c in data.load(tmp_path)}) == 2


def test_a_chain_that_stops_is_lost():
    """Two clips that overlap can be joined once; the 28 s that makes are no sequence."""
    long = walk(29.0, seed=5, speed=1.2, turn_rate=0.3)
    a, b = replace(long[:500], name="first"), replace(long[450:850], name="second")
    out, report = stitch.stitch([a, b], np.random.default_rng(0), limit=3e-3)
    assert out == [] and report.lost == ["first", "second"] and report.joins == report.frames_used == 0
    out, report = stitch.stitch([a, b], np.random.default_rng(0), limit=3e-3, seconds=25.0)
    assert len(out) == 1 and report.lost == [] and out[0].seconds > 25
    n = len(out[0])  # the overlap is the same motion, so the join cannot be seen
    np.testing.assert_allclose(out[0].pos, long.pos[:n], atol=1e-6)


@pytest.fixture(scope="module")
def library():
    return data.builtin_clips()


def test_sequences(tmp_path, capsys):
    for split in ("train", "validation"):
        out = data.sequences("builtin", split)
        assert all(c.seconds >= 30 for c in out)
        line = capsys.readouterr().out
        assert f"builtin [{split}]" in line and "lost" not in line and line.count("\n") == 1
    # one clip is a user's recording: it stays as it is, and is not looped
    write_as(tmp_path / "short_001.bvh", "bandai", walk(3.0))
    out = data.sequences(tmp_path, "train")
    assert [(c.name, c.seconds) for c in out] == [("short_001", 3.0)] and "as it is" in capsys.readouterr().out
    # too little to join anything: single clips, and it says so
    for k in (1, 2):
        write_as(tmp_path / f"short_00{k}.bvh", "bandai", walk(1.0, seed=k))
    out = data.sequences(tmp_path, "train")
    assert [c.name for c in out] == ["short_001", "short_002"] and "single clips are used" in capsys.readouterr().out
    data.sequences(tmp_path, "train", verbose=False)
    assert capsys.readouterr().out == ""


# ---------------------------------------------------------------- data sets


def test_split(tmp_path):
    for name, part in {
        "dataset-2_walk_normal_005": "validation", "dataset-2_walk_normal_015": "validation",
        "dataset-2_walk_normal_050": "train", "dataset-2_walk_normal_051": "train",
        "dataset-2_walk_youthful_005": "style", "dataset-2_run_youthful_001": "style",
        "walk1_subject5": "validation", "walk1_subject1": "train", "walk": "train", "5_walk": "train",
    }.items():  # fmt: skip
        assert data.split_of(name) == part, name

    clip = still(2)
    for i in range(1, 7):
        write_as(tmp_path / f"walk_{i:03d}.bvh", "bandai", clip)
    load = lambda split, **kw: [c.name[-1] for c in data.load(tmp_path, split=split, **kw)]  # noqa: E731
    assert load("train") == list("12346") and load("validation") == ["5"] and load("all") == list("123456")
    assert load("all", clips="*_00[12]") == ["1", "2"]
    names = {s: {c.name for c in data.load("builtin", split=s)} for s in ("train", "validation", "all")}
    assert names["train"] | names["validation"] == names["all"] and not names["train"] & names["validation"]
    assert names["validation"] == {n for n in names["all"] if n.endswith("5")}


def test_protocol1(tmp_path):
    """A named set picks the files that bear its names; `mocap fetch cmu` gets eight of them, all of unseen people."""
    clip = still(2)
    for name in ("07_08", "07_07", "135_04", "walk_1"):
        write_as(tmp_path / f"{name}.bvh", "bandai", clip)
    assert [c.name for c in data.load(tmp_path, clips="protocol1")] == ["07_08", "135_04"]
    named = data.NAMED["protocol1"]
    assert len(named) == 207 and all(re.fullmatch(r"\d\d+_\d\d", n) for n in named)
    got = {Path(f[0]).stem for f in fetch.DATASETS["cmu"].files} & named
    assert len(got) == 8 and {data.split_of(f"{n}.amc") for n in got} == {"body"}
    with pytest.raises(UserError, match="builtin: no clip matches 'protocol1'"):
        data.load("builtin", clips="protocol1")


def test_small_sets_are_used_whole(tmp_path, capsys):
    write_as(tmp_path / "walk_001.bvh", "bandai", still(2))
    assert [c.name for c in data.load(tmp_path, split="validation")] == ["walk_001"]
    assert "none to hold out" in capsys.readouterr().err
    for i in range(2, 12):  # with ten clips one has to be held out
        (tmp_path / f"walk_{10 * i}.bvh").write_text((tmp_path / "walk_001.bvh").read_text())
    with pytest.raises(UserError, match="none of the 11 clips that match '\\*' is in split 'validation'.*in train"):
        data.load(tmp_path, split="validation")


def test_load_errors(tmp_path):
    def message(*args, **kw):
        with pytest.raises(UserError) as e:
            data.load(*args, **kw)
        assert "\n" not in str(e.value)
        return str(e.value)

    assert "no such file or folder" in (m := message(tmp_path / "nowhere")) and "builtin" in m and "nowhere" in m
    assert "a folder without motion; valid: one that holds .bvh" in message(tmp_path)
    assert all(s in message("builtin", split="test") for s in ("'test'", *data.SPLITS))
    assert "'*fly*'" in (m := message("builtin", clips="*fly*")) and "walk_005" in m and "(30)" in m
    m = message("builtin", clips="*jog*", split="style")
    assert "'*jog*'" in m and "'style'" in m and "train" in m
    write_as(tmp_path / "walk_001.bvh", "bandai", still(2))
    (tmp_path / "a.bvh").mkdir()  # a folder is searched, whatever its name
    (tmp_path / "UPPER.BVH").write_text((tmp_path / "walk_001.bvh").read_text())  # other systems' spelling
    assert [c.name for c in data.load(tmp_path)] == ["UPPER", "walk_001"]
    m = message(tmp_path, clips="run*")
    assert "'run*'" in m and "walk_001" in m and "…" not in m
    text = (tmp_path / "walk_001.bvh").read_text().splitlines()
    (tmp_path / "broken_002.bvh").write_text("\n".join([*text[:-1], text[-1].replace("0.", "nan ", 1)]))
    assert "broken_002.bvh" in message(tmp_path)
    with pytest.raises(UserError, match="gone.bvh.*expected a regular .bvh file"):
        data.from_bvh(tmp_path / "gone.bvh")


def test_unseen_beside_others(tmp_path):
    """People held out as unseen bodies are not trained on among others by accident; alone, and to measure, they are."""
    (tmp_path / "held").mkdir(), (tmp_path / "mixed").mkdir()
    for name in ("16_01", "35_02"):
        write_as(tmp_path / "held" / f"{name}.bvh", "bandai", walk(3.0))
    write_as(tmp_path / "mixed" / "16_03.bvh", "bandai", walk(3.0))
    write_as(tmp_path / "mixed" / "20_01.bvh", "bandai", walk(3.0))
    held, mixed = str(tmp_path / "held"), str(tmp_path / "mixed")
    for read in (data.load, data.sequences):
        with pytest.raises(UserError, match="held: holds only people held out as unseen bodies"):
            read(f"builtin,{held}", split="train")
    opt = train.Options(motion=f"builtin,{held}")
    with pytest.raises(UserError, match="held: holds only people held out as unseen bodies"):
        train.clips_of(opt)
    assert {c.name for c in data.load(held, split="train")} == {"16_01", "35_02"}
    assert {"16_01", "35_02"} == {c.name for c in data.load(held, split="body")}
    assert "20_01" in {c.name for c in data.load(f"builtin,{mixed}", split="train")}


def test_joined(tmp_path, capsys):
    """Several sets with commas: each clip of each, each set stitched by itself; a file with a comma is that file."""
    write_as(tmp_path / "walk,turn_001.bvh", "bandai", walk(3.0))
    own = str(tmp_path / "walk,turn_001.bvh")
    assert data.parts(own) == [own] and data.parts(f"builtin,{tmp_path}") == ["builtin", str(tmp_path)]
    assert [c.name for c in data.load(own)] == ["walk,turn_001"]
    both = data.load(f"builtin,standing,{tmp_path}", split="validation")
    alone = [c for s in ("builtin", "standing", tmp_path) for c in data.load(s, split="validation")]
    assert len(alone) == 25 and all(a.name == b.name and np.array_equal(a.pos, b.pos) for a, b in zip(both, alone))
    kinds = {c.name.split("_")[0] for c in data.load("standing")}
    assert kinds == {"stand", "gesture", "sidestep", "start", "stop"}
    capsys.readouterr()
    out = data.sequences(f"standing,{tmp_path}", "train")
    assert [c.name for c in out][-1] == "walk,turn_001" and len(out) == 19
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("standing [train] 18 clips") and lines[1].startswith(str(tmp_path))
    with pytest.raises(UserError, match="nowhere: no such file or folder; valid: builtin, standing, "):
        data.load("builtin,nowhere")
    for wrong in ("builtin,", ",builtin", "builtin,,standing", ","):
        for read in (data.load, data.sequences):
            capsys.readouterr()
            with pytest.raises(UserError, match=f"--motion {wrong}: an empty name, .* valid: builtin, standing, "):
                read(wrong)
            assert capsys.readouterr().out == ""  # said before anything is read


def test_builtin_backwards():
    """People who stand or step, the pelvis never forwards: the gait of the mix, last frame first; one kind, split."""
    clips = data.builtin_clips(name="backwards")
    library = gait.library(mix=gait.BACKWARDS)
    for clip, made in zip(clips, library):
        assert np.array_equal(clip.pos[::-1], made["pos"]) and np.array_equal(clip.ball[::-1], made["ball"])
    standing = 0
    for clip in clips:
        assert clip.name.startswith("back_") and not np.abs(np.diff(clip.quat, axis=0)).max() > 0.5
        speed = np.diff(clip.pos[:, 0, :2], axis=0) * clip.rate
        ahead = (speed * np.stack([np.cos(y := heading(clip.quat[:-1, 0])), np.sin(y)], 1)).sum(1)
        assert -1.1 < ahead.min() < -0.1 and ahead.max() < 0.05
        standing += np.abs(ahead[:10]).max() < 0.05
    assert standing > len(clips) / 2
    assert {data.split_of(c.name) for c in clips} == {"train", "validation"}


def test_licences(tmp_path):
    """The first line of a folder's licence; one without says so; what is built in needs none."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b.bvh").write_text("")
    (tmp_path / "a" / "LICENSE.txt").write_text("\nNon-commercial.\nMore.\n")
    sets = data.parts(f"builtin,{tmp_path / 'a'},standing,{tmp_path / 'b.bvh'}")
    assert data.licences(sets) == [
        "a, licensed: Non-commercial.",
        "b.bvh, licensed: no licence file beside the motion",
    ]
    assert data.licences(["builtin", "standing"]) == []
    (tmp_path / "a" / "train").mkdir()
    assert data.licences([tmp_path / "a" / "train"]) == ["a/train, licensed: Non-commercial."]
    for name, text in (("LICENSE-x", "MIT License"), ("LICENSE-y", "MIT License\nmore"), ("LICENSE-z", "BSD")):
        (tmp_path / "a" / name).write_text(text)
    assert data.licences([tmp_path / "a" / "train"]) == ["a/train, licensed: MIT License, BSD, Non-commercial."]
    credited = [f"{name}, licensed: {data.CMU}" for name in ("cmu-inplace/train", "cmu")]
    assert data.licences(["/x/cmu-inplace/train", "/x/cmu"]) == credited
    assert data.set_name(tmp_path / "a" / "train") == "a/train" and data.set_name("builtin") == "builtin"


def test_builtin(library):
    """Ten minutes, the same bytes for a seed, and feet that neither skate nor sink by our own contact labels."""
    a, b, c = library, data.builtin_clips.__wrapped__(), data.builtin_clips(seed=1)  # b: made again
    for x, y in zip(a, b, strict=True):
        assert x.name == y.name and all(
            getattr(x, k).tobytes() == getattr(y, k).tobytes() for k in ("pos", "quat", "ball")
        )
    assert a[0].pos.tobytes() != c[0].pos.tobytes()
    assert sum(x.seconds for x in a) == pytest.approx(900, abs=0.1)
    assert len({x.body for x in a}) == len({x.name for x in a}) == len(a)
    for split in ("train", "validation"):  # starts, stops, turns and sidesteps are held out, too
        assert {x.name.split("_")[0] for x in a if data.split_of(x.name) == split} == set(gait.KINDS)
    for x in a:
        body = gait.body_of({"pos": x.pos})
        down, lowest = contacts(x), []
        slide = []
        for side, foot in enumerate(FEET):
            heel = x.pos[:, foot] + rot(x.quat[:, foot]).apply(body.heel)
            sole = x.ball[:, side] - [0, 0, body.ball_height]
            lowest += [heel[:, 2].min(), sole[:, 2].min()]
            pair = np.stack([heel, sole])
            speed = np.linalg.norm(np.gradient(pair[..., :2], 1 / x.rate, axis=1), axis=-1)
            under = np.argmin(pair[..., 2], axis=0)
            slide.append(speed[under, np.arange(len(x))][down[:, side]])
        assert np.concatenate(slide).mean() < 0.05, x.name
        assert min(lowest) > -0.02, x.name


# ---------------------------------------------------------------- inspect, and short clips


def test_inspect(tmp_path, capsys):
    clip = walk(1.0, 60.0, name="walk_001")
    path = write_as(tmp_path / "walk_001.bvh", "lafan1", clip)
    inspect.main(["inspect", str(path)])
    out = capsys.readouterr().out
    for word in ("rig lafan1", "17 joints", "LeftUpLeg", "thigh_l", "60.0 Hz", "60 frames", "1.0 s", "footfalls"):
        assert word in out, word
    travel = sum(np.hypot(*(b - a)) for a, b in zip(clip.pos[:, 0, :2], clip.pos[1:, 0, :2]))
    assert f"{travel:6.2f} m" in out and f"{travel / (59 / 60):4.2f} m/s" in out
    assert f"contact L {100 * contacts(clip)[:, 0].mean():3.0f} %" in out
    low = [z for t, c in zip(clip.ball, contacts(clip)) for z, on in zip(t[:, 2], c) if on]
    assert f"balls {100 * sum(low) / len(low):.1f} cm up in contact" in out
    assert " 0 footfalls  balls - cm up" in inspect.describe(data.replace(clip, pos=clip.pos + 1, ball=clip.ball + 1))
    inspect.main(["inspect", str(tmp_path)])
    out = capsys.readouterr().out
    assert "walk_001" in out and " 30.0 Hz" in out and "one clip, 1.0 s, as it is" in out
    with pytest.raises(UserError, match="nowhere"):
        inspect.main(["inspect", str(tmp_path / "nowhere")])


def test_footfalls():
    """Steps that a slow loop counts, whatever the rate; a label that flickers within a tenth of a second adds none."""
    clip = walk(8.0, 30.0)
    counts = []
    for rate in (30.0, 120.0):
        contact = contacts(resample(clip, rate))
        slow, n = 0, round(0.1 * rate)
        for foot in contact.T:
            for k in range(n, len(foot)):
                slow += foot[k] and not any(foot[k - n : k])
        assert footfalls(contact, rate) == slow
        counts.append(slow)
        noisy, rng = contact.copy(), np.random.default_rng(0)
        for k in rng.permutation(np.flatnonzero(contact[n:-n].all(axis=1)))[:20] + n:
            noisy[k] = False
        assert (noisy != contact).any() and footfalls(noisy, rate) == slow
    assert counts[0] == counts[1] and 10 <= slow <= 20
    assert footfalls(contact[:3], 120.0) == footfalls(contact[:0], 30.0) == 0


def test_cmu_footfalls(mocap_dir):
    """A walker of 1.2 m/s takes about two steps a second: by the labels' edges alone there would be 23 in 3.1 s."""
    clip = from_amc(mocap_dir / "cmu" / "35" / "35_12.amc")
    assert 5 <= footfalls(contacts(clip), clip.rate) <= 7


@pytest.mark.parametrize("frames", [1, 2])
def test_one_and_two_frames(tmp_path, frames, capsys):
    path = write_as(tmp_path / "short.bvh", "bandai", still(frames, 60.0))
    clip = data.from_bvh(path)
    assert len(clip) == frames
    assert len(resample(clip, 30.0)) == 1 and len(resample(clip, 120.0)) == 2 * frames - 1
    assert contacts(clip).all() and sensors(clip)[0].shape == (frames, 3, 3)
    assert np.isfinite(stitch.motion_features(clip)).all() and np.isfinite(clip.hip_height)
    np.testing.assert_allclose(angular_velocity(clip.quat, clip.rate), 0, atol=1e-9)
    assert stitch.stitch([clip], np.random.default_rng(0))[1].lost == ["short"]
    inspect.main(["inspect", str(path)])
    assert f"{frames} frames" in capsys.readouterr().out
    assert len(data.sequences(tmp_path)) == 1


# ---------------------------------------------------------------- other users, other gaits


def test_mirror():
    clip = walk(seed=5, turn_rate=0.4)
    m = augment.mirror(clip)
    flip = np.diag([1.0, -1.0, 1.0])
    for name, i in SEG.items():  # one segment at a time, with matrices
        other = {"_l": "_r", "_r": "_l"}.get(name[-2:])
        j = SEG[name[:-2] + other] if other else i
        np.testing.assert_allclose(m.pos[:, i], clip.pos[:, j] @ flip, atol=1e-12)
        expected = flip @ rot(clip.quat[:, j]).as_matrix() @ flip
        np.testing.assert_allclose(rot(m.quat[:, i]).as_matrix(), expected, atol=1e-12)
    np.testing.assert_allclose(m.ball[:, 0], clip.ball[:, 1] @ flip, atol=1e-12)
    np.testing.assert_array_equal(contacts(m), contacts(clip)[:, ::-1])
    np.testing.assert_allclose(heading(m.quat[:, 0]), -heading(clip.quat[:, 0]), atol=1e-9)
    again = augment.mirror(m)
    np.testing.assert_array_equal(again.pos, clip.pos)
    np.testing.assert_array_equal(again.quat, clip.quat)


def test_looking():
    """SciPy's turn of the head about the vertical: none at first, to the left after a quarter; nothing else moves."""
    clip = walk(seed=7)
    other, head = augment.looking(clip, 30.0, 2.0), SEG["head"]
    turn = (rot(other.quat[:, head]) * rot(clip.quat[:, head]).inv()).as_rotvec(degrees=True)
    t = np.arange(len(clip)) / clip.rate
    np.testing.assert_allclose(turn[:, 2], 30.0 * np.sin(np.pi * t), atol=1e-6)
    np.testing.assert_allclose(turn[:, :2], 0.0, atol=1e-6)
    rest = [i for i in range(len(SEG)) if i != head]
    np.testing.assert_array_equal(other.quat[:, rest], clip.quat[:, rest])
    np.testing.assert_array_equal(other.pos, clip.pos)


@pytest.mark.parametrize("speed", [0.85, 1.0, 1.15])
def test_warp(speed):
    clip = walk(seed=6)
    w = augment.warp(clip, speed)
    assert w.rate == clip.rate and abs(w.seconds - clip.seconds / speed) < 2 / clip.rate
    t = np.arange(len(w)) * speed  # frames of the clip, between which SciPy interpolates
    for i in (0, SEG["foot_l"], SEG["hand_r"]):
        np.testing.assert_allclose(
            w.pos[:, i],
            np.stack([np.interp(t, np.arange(len(clip)), clip.pos[:, i, a]) for a in range(3)], 1),
            atol=1e-9,
        )
        expected = Slerp(np.arange(len(clip)), rot(clip.quat[:, i]))(np.minimum(t, len(clip) - 1))
        assert (rot(w.quat[:, i]) * expected.inv()).magnitude().max() < 1e-6


def test_resize():
    clip = walk(seed=7)
    r = augment.resize(clip, 1.2, 0.8)
    np.testing.assert_array_equal(r.quat, clip.quat)
    for a, b, factor in [
        ("pelvis", "chest", 1.2),
        ("thigh_l", "shin_l", 1.2),
        ("chest", "upper_arm_r", 1.2),
        ("upper_arm_r", "forearm_r", 0.96),
        ("forearm_l", "hand_l", 0.96),
    ]:
        assert r.limb(a, b) == pytest.approx(factor * clip.limb(a, b), rel=1e-9)
    assert r.hip_height == pytest.approx(1.2 * clip.hip_height)
    np.testing.assert_allclose(r.ball, 1.2 * clip.ball)
    np.testing.assert_allclose(r.pos[-1, 0] - r.pos[0, 0], 1.2 * (clip.pos[-1, 0] - clip.pos[0, 0]))
    assert r.body != clip.body and clip.pos is not r.pos


def test_resize_trunk():
    """Against walking along the bones: every segment from its parent, the trunk's offsets stretched along the chest."""
    clip, s = walk(seed=7), 1.2
    r = augment.resize(clip, 0.9, 1.1, s)
    chest = Rotation.from_quat(clip.quat[:, SEG["chest"]], scalar_first=True)
    expected = {"pelvis": 0.9 * clip.pos[:, 0]}
    for child, parent in zip(SEGMENTS[1:], PARENTS[1:], strict=True):
        bone = 0.9 * (clip.pos[:, SEG[child]] - clip.pos[:, parent])
        if child in ("chest", "head"):
            bone = s * bone
        elif child.startswith("upper_arm"):
            bone = chest.apply(chest.inv().apply(bone) * [1.0, 1.0, s])
        elif child[:-2] in ("forearm", "hand"):
            bone = 1.1 * bone
        expected[child] = expected[SEGMENTS[parent]] + bone
    for name, pos in expected.items():
        np.testing.assert_allclose(r.pos[:, SEG[name]], pos, atol=1e-12, err_msg=name)
    assert r.hip_height == pytest.approx(0.9 * clip.hip_height)
    np.testing.assert_array_equal(augment.resize(clip, trunk=1.0).pos, clip.pos)


def test_restyle():
    clip = walk(seed=8)
    seg = SEG
    local = lambda c, a, b: Rotation.from_quat(  # noqa: E731
        quat_mul(quat_conj(c.quat[:, seg[a]]), c.quat[:, seg[b]]), scalar_first=True
    )
    a, b = (augment.restyle(clip, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(a.pos, b.pos)
    lower = [seg["pelvis"], *(seg[f"{s}_{side}"] for s in ("thigh", "shin", "foot") for side in "lr")]
    np.testing.assert_array_equal(a.pos[:, lower], clip.pos[:, lower])
    np.testing.assert_allclose(a.quat[:, lower], clip.quat[:, lower], atol=1e-15)
    np.testing.assert_array_equal(contacts(a), contacts(clip))
    for i, up in enumerate(PARENTS):  # each bone keeps its length and, seen from its parent, its direction
        if up >= 0:
            bone = [quat_rotate(quat_conj(c.quat[:, up]), c.pos[:, i] - c.pos[:, up]) for c in (a, clip)]
            np.testing.assert_allclose(*bone, atol=1e-12)
    assert np.abs(a.pos - clip.pos).max() > 0.05
    # without a bearing: deviations from the mean are g times as large, the mean stays
    g = 0.6
    for parent, name in (("pelvis", "chest"), ("chest", "head"), ("chest", "upper_arm_l"), ("forearm_r", "hand_r")):
        damped = augment.restyle(clip, np.random.default_rng(1), (g, g), 0.0)
        was, now = local(clip, parent, name), local(damped, parent, name)
        for t in (0, 7, 20):
            power = scipy.linalg.fractional_matrix_power(was.mean().as_matrix().T @ was[t].as_matrix(), g)
            np.testing.assert_allclose(now[t].as_matrix(), was.mean().as_matrix() @ power.real, atol=1e-8)
    # with it alone: a constant turn, before the trunk's and after the elbow's rotation, which only bends further
    turned = augment.restyle(clip, np.random.default_rng(1), (1.0, 1.0))
    for parent, name in (("pelvis", "chest"), ("chest", "upper_arm_r")):
        extra = (local(turned, parent, name) * local(clip, parent, name).inv()).as_rotvec()
        np.testing.assert_allclose(extra, extra[:1].repeat(len(extra), 0), atol=1e-9)
        assert 0 < np.linalg.norm(extra[0]) < 1.5
    extra = (local(clip, "upper_arm_l", "forearm_l").inv() * local(turned, "upper_arm_l", "forearm_l")).as_rotvec()
    assert extra[0, 1] < 0 and np.abs(extra[:, [0, 2]]).max() < 1e-9
    assert_same(augment.restyle(clip, np.random.default_rng(1), (1.0, 1.0), 0.0), clip)


def test_restyle_turns_both_arms_alike():
    """The right arm is turned as the left one in the mirror."""
    clip, turns = walk(2.0, seed=8), {"l": [], "r": []}

    def local(c, name):
        q = quat_mul(quat_conj(c.quat[0, SEG["chest"]]), c.quat[0, SEG[name]])
        return Rotation.from_quat(q, scalar_first=True)

    for seed in range(30):
        other = augment.restyle(clip, np.random.default_rng(seed), (1.0, 1.0))
        for side, out in turns.items():
            arm = f"upper_arm_{side}"
            out.append((local(other, arm) * local(clip, arm).inv()).as_rotvec())
    left, right = (np.array(v) for v in turns.values())
    x, y, z = (np.corrcoef(left[:, a], right[:, a])[0, 1] for a in range(3))
    assert x < -0.8 and y > 0.8 and z < -0.8


def test_hip_height_of_a_noisy_frame():
    clip = walk(8.0)
    pos = clip.pos.copy()
    pos[100, :, 2] -= 0.1
    assert replace(clip, pos=pos).hip_height == pytest.approx(clip.hip_height, abs=2e-3)


def test_fastest_second():
    """By hand: 1 m/s but for a second at 3 m/s; of half a second the mean; of a single frame nothing."""
    rest = still(121)
    step = np.where((np.arange(121) > 40) & (np.arange(121) <= 70), 3.0, 1.0)[:, None] / rest.rate
    walked = replace(rest, pos=rest.pos + np.cumsum(step, axis=0)[:, None] * [0.6, 0.8, 0.0])
    assert augment.fastest_second(walked) == pytest.approx(3.0)
    assert augment.fastest_second(walked[:15]) == pytest.approx(1.0)
    assert augment.fastest_second(walked[:1]) == 0.0


def test_augment():
    clips = [walk(seed=s, name=f"walk_{s}") for s in (8, 9)]
    a, b = (augment.augment(clips, np.random.default_rng(3)) for _ in range(2))
    assert a[:2] == clips and len(a) == 4
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x.pos, y.pos)
    for clip, other in zip(clips, a[2:], strict=True):
        scale = other.limb("thigh_l", "shin_l") / clip.limb("thigh_r", "shin_r")
        assert 0.8 <= scale <= 1.2 and scale != 1.0
        assert 0.8 <= other.limb("upper_arm_l", "forearm_l") / clip.limb("upper_arm_r", "forearm_r") / scale <= 1.2
        trunk = other.limb("pelvis", "chest") / clip.limb("pelvis", "chest") / scale
        assert 0.95 <= trunk <= 1.45 and trunk != 1.0
        assert 0.84 <= clip.seconds / other.seconds <= 1.16
    sprint = [augment.warp(c, 3.2) for c in clips]
    assert all(augment.fastest_second(c) > 3.4 for c in sprint)
    fast = [augment.fastest_second(c) for s in range(6) for c in augment.augment(sprint, np.random.default_rng(s))[2:]]
    assert max(fast) < 1.02 * augment.FASTEST and min(fast) < 0.95 * augment.FASTEST
    plain = augment.augment(clips, np.random.default_rng(3), 0, 0, 0, (1, 1), (1, 1), 0, 0)
    assert_same(plain[2], augment.mirror(clips[0]))
    turned = []
    for seed in range(20):
        _, _, *others = augment.augment(clips, np.random.default_rng(seed), 0, 0, 0, (1, 1), (1, 1), 0)
        for clip, other in zip(clips, others, strict=True):
            head = rot(other.quat[:, SEG["head"]]) * rot(augment.mirror(clip).quat[:, SEG["head"]]).inv()
            turned.append(np.rad2deg(head.magnitude().max()))
    assert 0.2 < np.mean(np.array(turned) > 1.0) < 0.8 and 20.0 < max(turned) <= augment.ASIDE  # about half look about


# ------------------------------------------------------------------------------------ standing before and after


def test_planted():
    """Share 0 changes nothing; share 1 stands: feet level below the hips, knees forward, bones as long as before."""
    clip = walk(3.0)
    same = augment.planted(clip, np.zeros(len(clip)))
    np.testing.assert_allclose(same.pos, clip.pos, atol=1e-9)
    np.testing.assert_allclose(same.ball, clip.ball, atol=1e-9)
    stands = augment.planted(clip, np.ones(len(clip)))
    low = np.percentile(clip.pos[:, FEET, 2], 5, axis=0)
    for k, side in enumerate("lr"):
        hip, foot = stands.pos[:, SEG[f"thigh_{side}"]], stands.pos[:, FEET[k]]
        np.testing.assert_allclose(foot[:, :2], hip[:, :2], atol=0.01)
        assert np.abs(foot[:, 2] - low[k]).max() < 0.03
        local = quat_mul(quat_conj(stands.quat[:, SEG[f"thigh_{side}"]]), stands.quat[:, SEG[f"shin_{side}"]])
        assert rot(local).as_euler("YXZ")[:, 0].min() > -0.02
    for a, b in (("thigh_l", "shin_l"), ("shin_l", "foot_l"), ("thigh_r", "shin_r"), ("shin_r", "foot_r")):
        before, after = (np.linalg.norm(c.pos[:, SEG[a]] - c.pos[:, SEG[b]], axis=-1) for c in (clip, stands))
        np.testing.assert_allclose(after, before, atol=1e-9)
    arms = [SEG[s] for s in ("pelvis", "chest", "head", "hand_l", "hand_r")]
    np.testing.assert_array_equal(stands.pos[:, arms], clip.pos[:, arms])


def test_lead():
    """Still, then time speeds up: the devices' poses are those of the clip at the integral of its speed."""
    clip = walk(4.0)
    led = augment.lead(clip, 1.5, 1.5)
    pos, own = sensors(led)[0], sensors(clip)[0]
    assert led.still == 46 and led.measured == pytest.approx(own[0, 0, 2])
    np.testing.assert_allclose(pos[:46], np.tile(own[:1], (46, 1, 1)), atol=1e-9)
    for k in range(1, 45):  # k / 30 s after it sets off: tau = t² / (2 · 44 / 30 s), an even number of frames
        tau = k**2 / 88.0
        i = int(tau)
        np.testing.assert_allclose(pos[45 + k], own[i] + (tau - i) * (own[i + 1] - own[i]), atol=1e-4)
    speed = np.linalg.norm(np.diff(pos[:, 0], axis=0), axis=-1) * 30
    assert speed[45] < 0.1 and speed[100:].mean() > 0.8
    assert len(led) == 46 + 44 + len(clip) - 1 - 22
    np.testing.assert_allclose(pos[-60:], own[-60:], atol=1e-12)  # the clip's own frames, not between them
    both = augment.lead(clip, 1.0, 1.0, 1.0)
    np.testing.assert_allclose(sensors(both)[0][-30:], np.tile(own[-1:], (30, 1, 1)), atol=1e-9)
    assert contacts(both)[-20:].all() and contacts(both)[:20].all()  # who stands has both feet on the floor
    short = augment.lead(clip[:20], 0.5, 1.5, 0.5)
    assert np.isfinite(short.pos).all() and len(short) > 20
    assert augment.begins_in_motion(clip) and not augment.begins_in_motion(led)
    assert led[10:].still == 36 and led[60:].still == 0


@pytest.mark.parametrize("out", [0.0, 1.0])
def test_lead_against_scipy(out):
    """Every frame of the led clip is the source's at τ(t), the integral of its speed: SciPy's quadrature and Slerp."""
    clip, n, still = walk(4.0), 30, 46  # n : frames of the rise; it stands for 1.5 s and one frame
    led, last = augment.lead(clip, 1.5, 1.0, out), len(clip) - 1
    speed = lambda k: np.clip(k / n, 0.0, 1.0)  # noqa: E731, of the clip's time, k frames after it sets off
    tau = lambda k: quad(speed, 0, k, points=[n] if k > n else None, epsabs=1e-13)[0]  # noqa: E731
    begun = [(tau(k), speed(k)) for k in range(1, 2 * len(clip))]
    if out:  # the same backwards: the end is a beginning, seen from there
        ended = [(last - at, share) for at, share in begun if at < n / 2] + [(last, 0.0)]
        begun = [(at, share) for at, share in begun if at <= last - n / 2]
        rest = [(last, 0.0)] * round(out * 30)
        at, share = np.array([(0.0, 0.0)] * still + begun + sorted(ended)[:-1] + [(last, 0.0)] + rest).T
    else:
        at, share = np.array([(0.0, 0.0)] * still + [b for b in begun if b[0] <= last + 1e-9]).T
    at = np.minimum(at, last)
    assert len(led) == len(at)
    frames = np.arange(len(clip))
    pos, ball = (interp1d(frames, x, axis=0)(at) for x in (clip.pos, clip.ball))
    quat = [Slerp(frames, rot(clip.quat[:, s]))(at).as_quat(scalar_first=True) for s in range(len(SEGMENTS))]
    wanted = augment.replace(clip, pos=pos, ball=ball, quat=np.stack(quat, axis=1))
    legs = [SEG[f"{s}_{side}"] for s in ("thigh", "shin", "foot") for side in "lr"]
    for part, same in ((slice(None), [s for s in range(len(SEGMENTS)) if s not in legs]), (share == 1.0, legs)):
        assert len(at[part]) > 60
        np.testing.assert_allclose(led.pos[part][:, same], wanted.pos[part][:, same], rtol=0, atol=1e-9)
        signs = np.sign(np.sum(led.quat * wanted.quat, axis=-1, keepdims=True))  # q and −q are one rotation
        np.testing.assert_allclose((signs * led.quat)[part][:, same], wanted.quat[part][:, same], rtol=0, atol=1e-9)
    np.testing.assert_allclose(led.ball[share == 1.0], wanted.ball[share == 1.0], rtol=0, atol=1e-9)
    sets_off = slice(0, still + n)  # the legs, while its time is slower: planted by the rest
    standing = augment.planted(wanted, 1.0 - share)
    np.testing.assert_allclose(led.pos[sets_off], standing.pos[sets_off], rtol=0, atol=1e-9)


def test_reverse(monkeypatch):
    """Backwards in every respect, twice is as before; of visits only other users' walks are, and not runs."""
    clip = walk(4.0)
    back = augment.reverse(clip)
    for name in ("pos", "quat", "ball"):
        np.testing.assert_array_equal(getattr(back, name), getattr(clip, name)[::-1])
        np.testing.assert_array_equal(getattr(augment.reverse(back), name), getattr(clip, name))

    def ahead(c):  # m a frame, along its own heading
        yaw = heading(c.quat[:-1, 0])
        return np.mean(np.sum(np.diff(c.pos[:, 0, :2], axis=0) * np.stack([np.cos(yaw), np.sin(yaw)], 1), axis=1))

    assert ahead(back) == pytest.approx(-ahead(clip), rel=0.02) and ahead(clip) > 0
    monkeypatch.setattr(augment, "BACKWARDS", 1.0)
    run, first = augment.warp(clip, 3.0), {name: getattr(clip, name)[:1] for name in ("pos", "quat", "ball")}
    still = replace(clip, **{name: np.repeat(value, 90, axis=0) for name, value in first.items()})
    names = [c.name for c in augment.visits([clip, still, run], np.random.default_rng(0))]
    assert ["-reversed" in name for name in names] == [False, False, False, True, False, False]
    monkeypatch.setattr(augment, "BACKWARDS", 0.0)
    assert not any("-reversed" in c.name for c in augment.visits([clip], np.random.default_rng(0)))


def test_visits():
    """Two visits a clip, by two people; each begins and ends still; long clips come in parts; the seed decides."""
    clips = [walk(4.0), walk(20.0)]
    found = augment.visits(clips, np.random.default_rng(0))
    assert len(found) == 2 * (1 + 1) and all(c.name.endswith("-visit") for c in found)
    for c in found:
        p = sensors(c)[0][:, 0]
        assert c.still >= 19 and np.ptp(p[: c.still], axis=0).max() < 1e-9 and np.ptp(p[-15:], axis=0).max() < 1e-9
        assert 0.9 < c.measured / p[0, 2] < 1.1 and c.seconds < augment.LONGEST + 6.0
    assert len({c.body for c in found}) > 2
    again = augment.visits(clips, np.random.default_rng(0))
    assert all(np.array_equal(a.pos, b.pos) and a.measured == b.measured for a, b in zip(found, again, strict=True))
    assert augment.visits([], np.random.default_rng(0)) == []

"""mocap/mend.py and what acts on it: real files of each kind, made from one walk, come back as the same human."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_amc import cmu_asf, cmu_file
from test_amc import standing as amc_standing
from test_mocap import rot, walk, write_as
from test_rigs import degrees_off, joints_of, turned_alike, upright, write_rig

from human import FEET, Clip, resample
from mocap import bvh, data, guess, inspect, mend, rigs
from mocap.rigs import Reading
from plumbing.cli import UserError

# ---------------------------------------------------------------- names


DECORATIONS = ("CC_Base_{}", "Model_{}", "{}_jnt", "hero{}", "rig|{}:skin_01", "Left_{}", "x-{}.end_", "{}Right")


@pytest.mark.parametrize("style", ("mixamo", "xsens", "smpl", "lower"))
@pytest.mark.parametrize("form", DECORATIONS)
def test_any_prefix_or_suffix(tmp_path, style, form):
    """What all joints share is decoration, whatever it is, even if it is the name of a side."""
    joints, truth = joints_of(style, walk(0.2))
    names = {n: form.format(n.split(":")[-1]) for n, *_ in joints}
    write_rig(tmp_path / "a.bvh", walk(0.2), style, rename=names)
    found, balls, missing = guess.guess(bvh.read(tmp_path / "a.bvh"))
    assert not missing
    for segment, joint in truth.items():
        got = balls["lr".index(segment[-1])] if segment.startswith("ball") else found[segment]
        assert got == names[joint].replace(" ", "_"), segment


def test_bare_names():
    """Not all need to share it; what would be left without a name keeps it; few joints share nothing."""
    names = ["Armature", *(f"Hero_{n}" for n in "Hips Spine Head LeftArm RightArm LeftLeg RightLeg".split()), "Hero_"]
    assert guess.bare_names(names)[:3] == ["Armature", "Hips", "Spine"] and guess.bare_names(names)[-1] == "Hero_"
    assert guess.bare_names(["a_x", "a_y"]) == ["a_x", "a_y"] and guess.bare_names([]) == []


def cut(path, source, *leaves):
    """Write a BVH without some of its last joints; their parents end where these were."""
    b = bvh.read(source)
    gone = [b.names.index(n) for n in leaves]
    keep = [j for j in range(len(b.names)) if j not in gone]
    moved = {old: new for new, old in enumerate(keep)}
    local_pos, local = bvh.local(b)
    ends = {b.names[b.parents[j]]: b.offsets[j] for j in gone}
    bvh.write(path, [b.names[j] for j in keep], [moved.get(b.parents[j], -1) for j in keep],
              b.offsets[keep], b.frame_time, local_pos[:, 0], local[:, keep], ends)  # fmt: skip
    return path


def test_no_head(tmp_path, capsys):
    """A rig that ends at the neck: the head is where the neck ends, and it is said."""
    write_rig(tmp_path / "a.bvh", walk(2.0), "xsens")
    got = data.from_bvh(cut(tmp_path / "b.bvh", tmp_path / "a.bvh", "Head"))
    assert "no joint for the head: Neck.end is taken for it; another: --joint-map" in capsys.readouterr().err
    np.testing.assert_allclose(got.pos[:, 2], data.from_bvh(tmp_path / "a.bvh").pos[:, 2], atol=1e-6)


def test_no_hands(tmp_path, capsys):
    """A rig that ends at the forearms: hands are where these end, and it is said."""
    write_rig(tmp_path / "a.bvh", walk(2.0), "xsens")
    got = data.from_bvh(cut(tmp_path / "b.bvh", tmp_path / "a.bvh", "LeftWrist", "RightWrist"))
    err = capsys.readouterr().err
    assert "no joint for hand_l: LeftElbow.end is taken for it; another: --joint-map" in err
    assert "joint for the head" not in err
    np.testing.assert_allclose(got.pos, data.from_bvh(tmp_path / "a.bvh").pos, atol=1e-6)


@pytest.mark.parametrize("neck, head", [("Spine5", "Spine6"), ("Neck", "Kopf"), ("spine.005", "spine.006")])
def test_head_of_another_name(tmp_path, capsys, neck, head):
    """The last bone above the arms, or what is behind the neck; what only says where it ends is no bone."""
    write_rig(tmp_path / "a.bvh", walk(2.0), "mixamo", rename={"mixamorig:Neck": neck, "mixamorig:Head": head})
    assert degrees_off(turned_alike(data.from_bvh(tmp_path / "a.bvh"), walk(2.0)), walk(2.0)).max() < 6
    assert f"no joint for the head: {head} is taken for it" in capsys.readouterr().err


# ---------------------------------------------------------------- joints in one place, other axes


@pytest.mark.parametrize(
    "joint, extra, first",
    [("Hip", "HipJoint", True), ("Hip", "HipJoint", False), ("Ankle", "Foot", False), ("Wrist", "Hand", False)],
)
def test_zero_offset_joints(tmp_path, joint, extra, first):
    """LHipJoint in the hips' place before LeftHip, or behind it in its place: the thigh is what turns the leg; so, too,
    feet and hands."""
    clip = walk(3.0)
    write_rig(tmp_path / "a.bvh", clip, "xsens")
    b = bvh.read(tmp_path / "a.bvh")
    pos, quat = bvh.local(b)
    names, parents, offsets, local, new = [], [], [], [], {}
    for j, name in enumerate(b.names):
        side, hip = name[0], name in (f"Left{joint}", f"Right{joint}")
        if hip and first:
            names.append(f"{side}{extra}"), parents.append(new[b.parents[j]]), offsets.append(np.zeros(3))
            local.append(np.tile([1.0, 0, 0, 0], (len(clip), 1)))
        new[j] = len(names)
        names.append(name), parents.append(len(names) - 2 if hip and first else new.get(b.parents[j], -1))
        offsets.append(b.offsets[j])
        local.append(np.tile([1.0, 0, 0, 0], (len(clip), 1)) if hip and not first else quat[:, j])
        if hip and not first:
            names.append(f"{side}{extra}"), parents.append(new[j]), offsets.append(np.zeros(3))
            local.append(quat[:, j])
            new[j] = len(names) - 1
    bvh.write(tmp_path / "b.bvh", names, parents, offsets, b.frame_time, pos[:, 0], np.stack(local, 1), b.end_sites)
    got = turned_alike(data.from_bvh(tmp_path / "b.bvh"), clip)
    np.testing.assert_allclose(got.pos, clip.pos, atol=2e-3)
    assert degrees_off(got, clip).max() < 6


def test_same_names_other_axes(tmp_path, capsys):
    """A known rig's names with other axes in its joints: measured like any other."""
    clip = walk(3.0)
    names = {f"mixamorig:{n}": n for n in "Hips Spine Spine1 Spine2 Neck Head HeadTop_End".split()}
    names |= {f"mixamorig:{s}{n}": s + n.replace("ToeBase", "Toe") for s in ("Left", "Right") for n in
              "Shoulder Arm ForeArm Hand HandIndex1 UpLeg Leg Foot ToeBase".split()}  # fmt: skip
    write_rig(tmp_path / "a.bvh", clip, "mixamo", rename=names)
    assert rigs.rig_of(bvh.read(tmp_path / "a.bvh")) == "lafan1" and not rigs.known_rig(bvh.read(tmp_path / "a.bvh"))
    assert degrees_off(turned_alike(data.from_bvh(tmp_path / "a.bvh"), clip), clip).max() < 6
    assert "rig guessed" in capsys.readouterr().err
    for rig in rigs.RIGS:
        assert rigs.known_rig(bvh.read(write_as(tmp_path / "b.bvh", rig, clip))) == rig


def test_the_bad_file_is_named(tmp_path):
    """Of a folder whose files share a skeleton the one that is wrong, not the first; another skeleton is its own."""
    for k in range(3):
        write_rig(tmp_path / f"walk_00{k}.bvh", walk(1.0, seed=k), "xsens", seed=5)
    over = walk(1.0)
    turn = Rotation.from_euler("y", np.linspace(0, 2 * np.pi, len(over))[:, None])
    pos = np.stack([turn.apply(over.pos[:, s]) for s in range(15)], axis=1)
    ball = np.stack([turn.apply(over.ball[:, s]) for s in range(2)], axis=1)
    quat = np.stack([(turn * rot(over.quat[:, s])).as_quat(scalar_first=True) for s in range(15)], axis=1)
    for k in (1, 2):  # somersaults: no axis is up
        write_rig(tmp_path / f"walk_00{k}.bvh", replace(over, pos=pos, ball=ball, quat=quat), "xsens", seed=5)
    (tmp_path / "walk_000.bvh").unlink()
    write_rig(tmp_path / "walk_000.bvh", walk(0.2), "xsens", seed=5)
    with pytest.raises(UserError, match=r"walk_001\.bvh: no axis along which"):
        data.load(tmp_path, clips="walk_000")


# ---------------------------------------------------------------- size, floor, rest pose


@pytest.mark.parametrize("hips", (8.0, 22.0, 185.0, 3000.0))
@pytest.mark.parametrize("known", (False, True))
def test_any_scale(tmp_path, capsys, hips, known):
    """A figure of any size is made an adult, in one line; --unit says otherwise."""
    clip = walk(2.0)
    unit = clip.hip_height / hips
    if known:
        write_as(tmp_path / "a.bvh", "lafan1", replace(clip, pos=clip.pos * 0.01 / unit, ball=clip.ball * 0.01 / unit))
    else:
        write_rig(tmp_path / "a.bvh", clip, "xsens", unit=unit)
    got = data.from_bvh(tmp_path / "a.bvh")
    err = capsys.readouterr().err
    assert got.hip_height == pytest.approx(0.9, abs=0.01) and err.count("scaled to an adult's 0.9 m") == 1
    assert "another: --unit" in err and "feet rest" not in err
    own = data.from_bvh(tmp_path / "a.bvh", Reading(unit=str(unit * 1.5)))
    assert own.hip_height == pytest.approx(1.5 * clip.hip_height, abs=0.02)
    assert "scaled" not in capsys.readouterr().err


@pytest.mark.parametrize("off", (-0.2, -0.11, 0.12, 0.2))
def test_floor(tmp_path, capsys, off):
    """Known and guessed rigs alike; --floor file leaves it; who lies on the floor stays there."""
    clip = walk(2.0)
    moved = replace(clip, pos=clip.pos + [0, 0, off], ball=clip.ball + [0, 0, off])
    for path in (write_as(tmp_path / "a.bvh", "bandai", moved), tmp_path / "b.bvh"):
        if path.name == "b.bvh":
            write_rig(path, moved, "rokoko")
        got = data.from_bvh(path)
        side = "above" if off > 0 else "below"
        assert re.search(rf"feet rest \d+ cm {side} the floor: levelled", capsys.readouterr().err)
        np.testing.assert_allclose(got.pos[..., 2], clip.pos[..., 2], atol=0.03)
        np.testing.assert_allclose(data.from_bvh(path, Reading(floor="file")).pos[..., 2], moved.pos[..., 2], atol=2e-3)
        assert "feet rest" not in capsys.readouterr().err
    deep = replace(moved, ball=moved.ball - [0, 0, 0.1])  # End Sites below any sole
    assert mend.floor_of(deep, ends=True) == pytest.approx(off, abs=0.03)
    pos = np.concatenate([deep.pos, deep.ball], axis=1)
    assert rigs.find_unit(pos)[2] == pytest.approx(clip.hip_height, abs=0.03 if abs(off) > 0.15 else 0.13)
    up = replace(clip, ball=clip.ball + [0, 0, 0.3], pos=clip.pos * [1, 1, 0.1])
    assert mend.floor_of(up) == 0.0 and mend.floor_of(clip) == 0.0


def in_front(path, clip: Clip, frames, style="xsens", away=(3.0, -2.0), seed=0):
    """A walk with a T-pose before it."""
    pose = upright(frames)
    shift = np.array([*away, 0.0])
    both = replace(clip, pos=np.concatenate([pose.pos + shift, clip.pos]), ball=np.concatenate([pose.ball + shift,
                   clip.ball]), quat=np.concatenate([pose.quat, clip.quat]))  # fmt: skip
    write_rig(path, both, style, seed)


@pytest.mark.parametrize("frames, away", [(1, (3.0, -2.0)), (2, (0.0, 40.0)), (5, (-1.0, 0.5)), (60, (3.0, 0))])
@pytest.mark.parametrize("rate", (30.0, 120.0))
def test_leading_rest(tmp_path, capsys, frames, away, rate):
    clip = walk(3.0, rate=rate)
    in_front(tmp_path / "a.bvh", clip, frames, away=away)
    got = data.from_bvh(tmp_path / "a.bvh")
    err = capsys.readouterr().err
    assert len(got) == len(clip) and err.count("rest pose") == 1 and "--rest-pose keep" in err
    np.testing.assert_allclose(turned_alike(got, clip).pos, clip.pos, atol=2e-3)
    assert len(data.from_bvh(tmp_path / "a.bvh", Reading(rest_pose="keep"))) == len(clip) + frames
    assert "dropped" not in capsys.readouterr().err
    raw = bvh.read(tmp_path / "a.bvh").values
    assert mend.may_rest(raw) and not mend.may_rest(raw[:5])


@pytest.mark.parametrize("frames", (2, 30, 400))
def test_rest_where_it_begins(frames):
    """Arms that hang, where the walk begins: small a jump, but nobody is still to the digit before it."""
    pos = walk(3.0, rate=30.0).pos
    apart = np.linalg.norm(pos[:, FEET[0], :2] - pos[:, FEET[1], :2], axis=-1)
    pos = pos[int(apart.argmax()) :]
    pose = upright(frames).pos
    pose = pose + [*(pos[0, 0, :2] - pose[0, 0, :2]), 0.0]
    assert mend.leading_rest(np.concatenate([pose, pos])) == frames
    moved = pose + 1e-3 * np.random.default_rng(0).normal(size=pose.shape)  # somebody who stands there
    assert mend.leading_rest(np.concatenate([moved, pos])) == 0


def test_no_rest_pose(mocap_dir):
    """Walks, runs, kicks and dances begin where they begin: no recording loses a frame without a jump of 10 m/s."""
    for file in sorted(mocap_dir.glob("bandai-actions/**/*.bvh")) + sorted(mocap_dir.glob("bandai/*run*.bvh"))[:20]:
        b = bvh.read(file)
        assert mend.leading_rest(bvh.global_pose(replace(b, values=b.values[:300]))[0]) == 0
    assert mend.leading_rest(walk(3.0).pos) == 0 and mend.leading_rest(np.zeros((30, 3, 3))) == 0


# ---------------------------------------------------------------- rates


@pytest.mark.parametrize("true", (30.0, 60.0, 120.0))
@pytest.mark.parametrize("factor", (0.25, 0.5, 1.0, 4.0))
def test_gait_rate(tmp_path, capsys, true, factor):
    """A header that is 4 times too fast or too slow, or half as fast: the right rate is named."""
    clip = walk(6.0, rate=true)
    write_rig(tmp_path / "a.bvh", replace(clip, rate=true * factor), "xsens")
    data.from_bvh(tmp_path / "a.bvh")
    err = capsys.readouterr().err
    assert ("nobody walks like this" in err) == (factor != 1)
    assert factor == 1 or f"probably --rate {true:g}\n" in err
    got = data.from_bvh(tmp_path / "a.bvh", Reading(rate=str(true)))
    assert got.rate == true and "nobody walks" not in capsys.readouterr().err


def test_slow_headers(tmp_path, capsys):
    """A frame time of a second, in milliseconds, or a rate in its place."""
    clip = walk(3.0)
    write_rig(tmp_path / "a.bvh", replace(clip, rate=1.0), "xsens")
    data.from_bvh(tmp_path / "a.bvh")
    assert "at 1 frames a second" in capsys.readouterr().err
    write_rig(tmp_path / "b.bvh", replace(upright(9), rate=2.0), "xsens")
    data.from_bvh(tmp_path / "b.bvh")
    assert "2 frames a second: no capture is so slow; say what it is with --rate" in capsys.readouterr().err
    text = (tmp_path / "a.bvh").read_text()
    for time, hint in (("33.3333", r"milliseconds\? then --rate 30"), ("120", r"a rate\? then --rate 120")):
        (tmp_path / "c.bvh").write_text(text.replace("Frame Time: 1.0", f"Frame Time: {time}"))
        with pytest.raises(UserError, match=hint):
            data.from_bvh(tmp_path / "c.bvh")
        assert data.from_bvh(tmp_path / "c.bvh", Reading(rate="30")).rate == 30.0


def test_recorded_gaits(mocap_dir):
    """No recorded walk or run of three studios is doubted."""
    files = [*sorted(mocap_dir.glob("bandai/*.bvh"))[::8], *sorted(mocap_dir.glob("cmu/*/*.amc"))[::4]]
    found = 0
    for clip in data.read_clips(files):
        assert mend.doubt_rate(clip) is None, clip.name
        found += mend.gait_rate(clip) is not None
    assert found > 0.9 * len(files)
    clip = walk(6.0)
    rates = [mend.gait_rate(resample(clip, r)) / r for r in (24.0, 30.0, 120.0)]
    assert np.ptp(rates) < 0.15


def test_extremes():
    """Turning points of a wave with noise, against its own peaks."""
    t = np.arange(200) / 20.0
    x = np.sin(t) + 0.02 * np.random.default_rng(0).standard_normal(200)
    turns = mend.extremes(x, 0.3)
    np.testing.assert_allclose(t[turns], np.pi / 2 + np.pi * np.arange(len(turns)), atol=0.35)
    assert len(turns) == 3 and not len(mend.extremes(np.zeros(5), 0.3))


def test_common_rate():
    assert mend.common_rate(29.3, 7.5) == 30 and mend.common_rate(27.0, 1.0) == 30 and mend.common_rate(66.0, 240) == 60
    assert mend.common_rate(24.5, 100.0) == 25 and mend.common_rate(1e4, 30.0) == 1e4


# ---------------------------------------------------------------- flags, skeletons, inspect


def test_flags():
    """Each is checked, and a command without them reads as ever."""
    assert Reading.of(SimpleNamespace(joint_map=None, unit="cm", up=None)) == Reading(unit="cm")
    assert Reading.of(SimpleNamespace(rate="60", floor="file", rest_pose="keep")) == Reading(
        rate=60, floor="file", rest_pose="keep"
    )
    for bad in (dict(rate="0"), dict(rate="fast"), dict(rate="nan"), dict(floor="up"), dict(rest_pose="no")):
        with pytest.raises(UserError, match="valid: "):
            Reading(**bad)
    assert {f for f in rigs.HELP} == {"joint_map", "unit", "up", "rate", "floor", "rest_pose"}


def test_skeletons_with_suffixes(tmp_path):
    """09-run.asf for 09_06-run.amc, HDM_bd.asf for HDM_bd_01-02.amc, capitals; comments in Latin-1."""
    path, s, motion = cmu_file(tmp_path, [amc_standing()] * 2)
    text, skeleton = path.read_text(), cmu_asf()
    for f in tmp_path.glob("*"):
        f.unlink()
    (tmp_path / "35.asf").write_text(skeleton)
    pairs = {"09_06-run": "09-run", "HDM_bd_01-02_120": "HDM_bd", "7_3": "7-walk", "AB_1": "ab", "08_1": "8"}
    for amc, asf in pairs.items():
        (tmp_path / f"{asf}.asf").write_bytes(b"# K\xfcrzel\n" + skeleton.encode())
        (tmp_path / f"{amc}.amc").write_bytes(b"#!f\xfcr " + amc.encode() + b"\n" + text.encode())
        assert rigs.from_amc(tmp_path / f"{amc}.amc").body.startswith(f"cmu-{asf}-leg")
    (tmp_path / "09-walk.asf").write_text(skeleton)
    assert rigs.skeleton_beside(tmp_path / "09_06-run.amc")[0].name == "09-run.asf"
    assert len(rigs.skeleton_beside(tmp_path / "09_06-jump.amc")) == 2
    with pytest.raises(UserError, match="looked for 12.asf .* there is 09-run.asf"):
        (tmp_path / "12_01.amc").write_text(text)
        rigs.from_amc(tmp_path / "12_01.amc")


def test_inspect_json(tmp_path, capsys):
    """Several paths, a folder among them; what was said of each; a bad one does not hide the others."""
    clip = walk(3.0)
    (tmp_path / "more").mkdir()
    write_rig(tmp_path / "a.bvh", clip, "xsens", unit=0.04)
    write_as(tmp_path / "more" / "b.bvh", "lafan1", resample(clip, 60.0))
    (tmp_path / "c.bvh").write_text("HIERARCHY")
    paths = [str(tmp_path / n) for n in ("a.bvh", "more", "c.bvh")]
    with pytest.raises(UserError, match="1 of 3 could not be read"):
        inspect.main(["inspect", *paths, "--json", str(tmp_path / "out.json")])
    assert "c.bvh, line 1: the hierarchy stops" in capsys.readouterr().err
    found = json.loads((tmp_path / "out.json").read_text())
    keys = ["rate", "frames", "seconds", "speed", "hips", "contact", "warnings"]
    assert list(found) == [paths[0], f"{paths[1]}/b.bvh", paths[2]] and all(list(v) == keys for v in found.values())
    a, b, c = found.values()
    assert len(a["warnings"]) == 1 and "scaled to an adult's" in a["warnings"][0]
    assert (b["rate"], b["frames"], b["warnings"]) == (60.0, 179, []) and c["rate"] is None and c["warnings"]
    assert a["hips"] == pytest.approx(0.9, abs=0.01) and 0.5 < a["speed"] < 2 and 0.4 < b["contact"] < 0.9
    inspect.main(["inspect", paths[0], "--unit", "0.04", "--json", str(tmp_path / "out.json")])
    assert json.loads((tmp_path / "out.json").read_text())[paths[0]]["warnings"] == []

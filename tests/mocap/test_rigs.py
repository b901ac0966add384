"""mocap/rigs.py: one walk written as files of many rigs, with joint frames turned at random, comes back as the same
human."""

import contextlib
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_mocap import TO_FILE, assert_same, rot, still, walk, write_as

from human import FEET, PARENTS, SEG, SEGMENTS, Clip, contacts, heading, place, quat_angle
from mocap import augment, bvh, data, guess, rigs
from mocap.rigs import RIGS, Reading
from mocap.stitch import stitch
from plumbing.cli import UserError

# ---------------------------------------------------------------- a walk in any rig

# rig -> names of pelvis, chest and head; of two joints of the spine, a neck and the skull's top (or None);
# of a side: collar, upper arm, forearm, hand, finger or -, hip dummy or -, thigh, shin, foot, toe
STYLES = {
    "mixamo": (
        ("mixamorig:Hips", "mixamorig:Spine2", "mixamorig:Head"),
        ("mixamorig:Spine", "mixamorig:Spine1", "mixamorig:Neck", "mixamorig:HeadTop_End"),
        "mixamorig:{Left}Shoulder mixamorig:{Left}Arm mixamorig:{Left}ForeArm mixamorig:{Left}Hand "
        "mixamorig:{Left}HandIndex1 - mixamorig:{Left}UpLeg mixamorig:{Left}Leg mixamorig:{Left}Foot "
        "mixamorig:{Left}ToeBase",
    ),
    "xsens": (
        ("Hips", "Chest4", "Head"),
        ("Chest", "Chest2", "Neck", None),
        "{Left}Collar {Left}Shoulder {Left}Elbow {Left}Wrist - - {Left}Hip {Left}Knee {Left}Ankle {Left}Toe",
    ),
    "rokoko": (
        ("Hips", "Spine4", "Head"),
        ("Spine1", "Spine2", "Neck", None),
        "{Left}Shoulder {Left}Arm {Left}ForeArm {Left}Hand {Left}Finger2Proximal - {Left}Thigh {Left}Shin {Left}Foot "
        "{Left}Toe",
    ),
    "games105": (
        ("RootJoint", "lowerback_torso", "torso_head"),
        ("pelvis_lowerback", None, None, None),
        "{l}Torso_Clavicle {l}Shoulder {l}Elbow {l}Wrist - - {l}Hip {l}Knee {l}Ankle {l}ToeJoint",
    ),
    "pfnn": (
        ("Hips", "Spine1", "Head"),
        ("LowerBack", "Spine", "Neck1", None),
        "{Left}Shoulder {Left}Arm {Left}ForeArm {Left}Hand {Left}FingerBase {L}HipJoint {Left}UpLeg {Left}Leg "
        "{Left}Foot {Left}ToeBase",
    ),
    "biped": (
        ("Bip01_Pelvis", "Bip01_Spine3", "Bip01_Head"),
        ("Bip01_Spine", "Bip01_Spine1", "Bip01_Neck", None),
        "Bip01_{L}_Clavicle Bip01_{L}_UpperArm Bip01_{L}_Forearm Bip01_{L}_Hand Bip01_{L}_Finger2 - Bip01_{L}_Thigh "
        "Bip01_{L}_Calf Bip01_{L}_Foot Bip01_{L}_Toe0",
    ),
    "smpl": (
        ("Pelvis", "Spine3", "Head"),
        ("Spine1", "Spine2", "Neck", None),
        "{L}_Collar {L}_Shoulder {L}_Elbow {L}_Wrist {L}_Hand - {L}_Hip {L}_Knee {L}_Ankle {L}_Foot",
    ),
    "rigify": (
        ("hips", "chest", "head"),
        ("spine", None, "neck", None),
        "shoulder.{L} upper_arm.{L} forearm.{L} hand.{L} - - thigh.{L} shin.{L} foot.{L} toe.{L}",
    ),
    "lower": (
        ("root", "thorax", "head"),
        ("lowerback", "upperback", "upperneck", None),
        "{l}clavicle {l}humerus {l}radius {l}wrist {l}fingers {l}hipjoint {l}femur {l}tibia {l}foot {l}toes",
    ),
}  # fmt: skip

# a proper rotation that takes our z to the file's axis
TURNS = {
    "y": TO_FILE,
    "z": np.eye(3),
    "x": np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]),
    "-z": np.diag([1.0, -1, -1]),
    "-y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def joints_of(style, clip):
    """(name, parent's index, segment it turns with, (T, 3) position) of every joint of a rig; the joint map."""
    (pelvis, chest, head), (low, mid, neck, top), side_names = STYLES[style]
    out, where, truth = [], {}, {}

    def add(name, parent, segment, position):
        if name in (None, "-"):
            return parent
        where[name] = len(out)
        out.append((name, where.get(parent, -1), SEG[segment], position))
        return name

    at = lambda s: clip.pos[:, SEG[s]]  # noqa: E731
    on = lambda s, v: at(s) + rot(clip.quat[:, SEG[s]]).apply(v)  # noqa: E731
    add(pelvis, None, "pelvis", on("pelvis", [0.02, 0.0, 0.05]))
    up = add(low, pelvis, "pelvis", on("pelvis", [0.0, 0.0, 0.07]))
    up = add(mid, up, "pelvis", on("pelvis", [-0.01, 0.0, 0.12]))
    add(chest, up, "chest", at("chest"))
    up = add(neck, chest, "chest", on("chest", [0.0, 0.0, 0.4]))
    add(head, up, "head", at("head"))
    add(top, head, "head", on("head", [0.02, 0.0, 0.2]))
    truth |= {"pelvis": pelvis, "chest": chest, "head": head}
    for k, side in enumerate(("Left", "Right")):
        s, y = side[0].lower(), (1, -1)[k]
        names = side_names.format(Left=side, L=side[0], l=s).replace("{Left}", side).split()
        collar, upper, fore, hand, finger, dummy, thigh, shin, foot, toe = names
        up = add(collar, chest, "chest", on("chest", [0.01, 0.02 * y, 0.3]))
        add(upper, up, f"upper_arm_{s}", at(f"upper_arm_{s}"))
        add(fore, upper, f"forearm_{s}", at(f"forearm_{s}"))
        add(hand, fore, f"hand_{s}", at(f"hand_{s}"))
        add(finger, hand, f"hand_{s}", on(f"hand_{s}", [0.0, 0.0, -0.09]))
        up = add(dummy, pelvis, "pelvis", on("pelvis", [0.0, 0.01 * y, 0.0]))
        add(thigh, up, f"thigh_{s}", at(f"thigh_{s}"))
        add(shin, thigh, f"shin_{s}", at(f"shin_{s}"))
        add(foot, shin, f"foot_{s}", at(f"foot_{s}"))
        add(toe, foot, f"foot_{s}", clip.ball[:, k])
        truth |= {f"{n}_{s}": v for n, v in zip(("upper_arm", "forearm", "hand"), (upper, fore, hand))}
        truth |= {f"{n}_{s}": v for n, v in zip(("thigh", "shin", "foot", "ball"), (thigh, shin, foot, toe))}
    return out, truth


def write_rig(path, clip: Clip, style, seed=0, unit=0.01, up="y", rename=None):
    """Write a clip as BVH of a rig whose joints' frames are turned at random; file axes as TURNS says.  -> joint map"""
    joints, truth = joints_of(style, clip)
    rename = rename or {}
    frames = Rotation.random(len(joints), random_state=seed)
    world = Rotation.from_matrix(TURNS[up])
    r = [world * rot(clip.quat[:, s]) * frames[j] for j, (_, _, s, _) in enumerate(joints)]
    p = [world.apply(x) / unit for *_, x in joints]
    names = [rename.get(n, n).replace(" ", "_") for n, *_ in joints]
    parents = np.array([i for _, i, _, _ in joints])
    offsets, local = np.zeros((len(joints), 3)), np.zeros((len(clip), len(joints), 4))
    for j, i in enumerate(parents):
        local[:, j] = (r[j] if i < 0 else r[i].inv() * r[j]).as_quat(scalar_first=True)
        offsets[j] = 0.0 if i < 0 else r[i].inv().apply(p[j] - p[i]).mean(0)
    bvh.write(path, names, parents, offsets, 1.0 / clip.rate, p[0], local)
    return {k: rename.get(v, v) for k, v in truth.items()}


def turned_alike(a: Clip, b: Clip):
    """a, turned about the vertical and moved on the floor to where b is: a file's horizontal axes are anybody's."""
    yaw = float(np.angle(np.exp(1j * (heading(b.quat[:, 0]) - heading(a.quat[:, 0]))).mean()))
    return place(a, yaw, a.pos[0, 0, :2], b.pos[0, 0, :2])


def degrees_off(a: Clip, b: Clip):
    """(15,) mean angle between the segments of two clips [deg]."""
    return np.degrees(quat_angle(a.quat, b.quat)).mean(axis=0)


def upright(n):
    """A human whose segments are all upright, with their joints where that puts them."""
    clip, like = still(n), walk(0.2)
    pos, local = clip.pos.copy(), rot(like.quat[0]).inv()
    for i, parent in enumerate(PARENTS):
        if parent >= 0:
            pos[:, i] = pos[:, parent] + local[parent].apply(like.pos[0, i] - like.pos[0, parent])
    ball = [pos[:, f] + local[f].apply(like.ball[0, k] - like.pos[0, f]) for k, f in enumerate(FEET)]
    return replace(clip, pos=pos, ball=np.stack(ball, axis=1))


# ---------------------------------------------------------------- names


@pytest.mark.parametrize("name, side, word", [
    ("mixamorig:LeftUpLeg", "l", "upleg"), ("LHipJoint", "l", "hip"), ("lThigh", "l", "thigh"), ("Hips", "", "hips"),
    ("RightShoulder", "r", "shoulder"), ("thigh.L", "l", "thigh"), ("UpperLeg_R", "r", "upperleg"),
    ("Bip01 L UpperArm", "l", "upperarm"), ("lToeJoint", "l", "toe"), ("lTorso_Clavicle", "l", "torsoclavicle"),
    ("LEFT_FOOT", "l", "foot"), ("leftforearm", "l", "forearm"), ("rfemur", "r", "femur"), ("lleg", "l", "leg"),
    ("leg", "", "leg"), ("radius", "", "radius"), ("lowerback", "", "lowerback"), ("LeftHandIndex1", "l", "handindex"),
    ("LinksUpLeg", "l", "upleg"), ("Foot_droite", "r", "foot"), ("IzqArm", "l", "arm"), ("RtLeg", "r", "leg"),
    ("Hand_sx", "l", "hand"), ("uplegleft", "l", "upleg"), ("handr", "r", "hand"), ("lThighBend", "l", "thigh"),
    ("LFArm", "l", "farm"), ("RUArm", "r", "uarm"), ("Lf_Arm", "l", "arm"), ("arm_upper_L", "l", "upperarm"),
    ("left_leg_knee_jnt", "l", "knee"), ("LegLower.R", "r", "lowerleg"), ("shoulder", "", "shoulder"),
    ("Character1_LeftArm", "l", "arm"), ("LShldr", "l", "shldr"), ("ns:a:Head", "", "head"), ("R_Wrist", "r", "wrist"),
    ("", "", ""), ("___", "", ""), ("L", "l", ""),
])  # fmt: skip
def test_names(name, side, word):
    assert guess.read_name(name) == (side, word)


# ---------------------------------------------------------------- the same human from any rig


@pytest.mark.parametrize("style, up, unit", list(zip(
    STYLES,
    ("y", "z", "y", "x", "y", "-z", "-y", "z", "y"),
    (0.01, 0.01, 1.0, 1.0, 0.0254 / 0.45, 0.0254, 0.001, 1.0, 0.01),
)))  # fmt: skip
def test_any_rig(tmp_path, capsys, style, up, unit):
    """Guessed from the names alone, with units and axes found: positions exactly, rotations to a few degrees."""
    clip = walk(6.0, turn_rate=0.2)
    for seed in (0, 1):
        path = tmp_path / f"walk_00{seed}.bvh"
        truth = write_rig(path, clip, style, seed, unit, up)
        got = data.from_bvh(path)
        err = capsys.readouterr().err
        for segment, joint in truth.items():
            assert f"{segment} <- {joint}" in re.split(r"names: |, |\n", err), (segment, err)
        name = next(n for n, u in rigs.UNITS.items() if u == unit)
        assert f": {up} is up" in err and f": unit {name}: " in err and "ASSUMED" not in err
        got = turned_alike(got, clip)
        np.testing.assert_allclose(got.pos, clip.pos, atol=2e-3)
        np.testing.assert_allclose(got.ball, clip.ball, atol=2e-3)
        off = dict(zip(SEGMENTS, degrees_off(got, clip)))
        assert max(off.values()) < 6, off
        np.testing.assert_array_equal(contacts(got), contacts(clip))
        assert got.body == "guessed-leg86-arm58" and got.rate == clip.rate


def test_limbs_that_never_bend(tmp_path, capsys):
    """A person who stands still, arms hanging or spread: axes come from hips and shoulders, and it is said."""
    clip = upright(20)
    for degrees in (0.0, 60.0):
        pose, quat = clip.pos.copy(), clip.quat.copy()
        for side, sign in (("l", 1), ("r", -1)):
            arm = [SEG[f"{s}_{side}"] for s in ("upper_arm", "forearm", "hand")]
            turn = Rotation.from_euler("x", sign * degrees, degrees=True)
            pose[:, arm] = clip.pos[:, arm[:1]] + (clip.pos[:, arm] - clip.pos[:, arm[:1]]) @ turn.as_matrix().T
            quat[:, arm] = turn.as_quat(scalar_first=True)
        posed = replace(clip, pos=pose, quat=quat)
        write_rig(tmp_path / "a.bvh", posed, "mixamo", seed=3)
        got = data.from_bvh(tmp_path / "a.bvh")
        err = capsys.readouterr().err
        for joint in ("knee_l", "knee_r", "elbow_l", "elbow_r"):
            assert f"ASSUMED: {joint} hardly bends" in err
        assert degrees_off(got, posed).max() < 3
    flying = replace(clip, pos=clip.pos + np.linspace(0, 3, 20)[:, None, None] * [0, 0, 1.0])
    flying = replace(flying, ball=clip.ball + np.linspace(0, 3, 20)[:, None, None] * [0, 0, 1.0])
    write_rig(tmp_path / "a.bvh", flying, "mixamo", seed=3)
    assert degrees_off(data.from_bvh(tmp_path / "a.bvh"), flying).max() < 3
    assert "ASSUMED: foot_l never stands" in capsys.readouterr().err


def test_folder_is_measured_once(tmp_path, capsys):
    """All clips of one skeleton have the same axes, whichever of them are read; another skeleton has its own."""
    clips = [walk(3.0, seed=k, name=f"walk_00{k}") for k in range(4)]
    for k, clip in enumerate(clips):
        write_rig(tmp_path / f"walk_00{k}.bvh", clip, "xsens", seed=5)
    tall = augment.resize(clips[0], 1.1)
    write_rig(tmp_path / "other_009.bvh", tall, "rokoko", seed=6)
    every = {c.name: c for c in data.load(tmp_path)}
    err = capsys.readouterr().err
    assert err.count("rig guessed") == 2 and err.count(" is up") == 2 and err.count(": unit cm") == 2
    assert len({c.body for c in every.values()}) == 2
    for name, clip in every.items():
        alone = data.load(tmp_path, clips=name)[0]
        assert np.array_equal(alone.quat, clip.quat) and np.array_equal(alone.pos, clip.pos)
    out, report = stitch([every[f"walk_00{k}"] for k in range(4)], np.random.default_rng(0), seconds=5.0)
    assert report.joins
    known = write_as(tmp_path / "bandai_001.bvh", "bandai", clips[0])
    capsys.readouterr()
    assert_same(data.load(tmp_path, clips="bandai*")[0], clips[0])
    assert capsys.readouterr().err == "" and known.exists()


@pytest.mark.parametrize("rig, limit", [("bandai", 10.0), ("lafan1", 15.0)])
def test_known_rigs_measured(mocap_dir, tmp_path, rig, limit):
    """What is measured on recorded people, against the axes in the table.  Not for hands and, in LaFAN1, the head:
    no fingers are recorded, and that person looks down."""
    (tmp_path / "empty.toml").write_text("")  # a joint map that says nothing: known rigs too are guessed with it
    files = sorted((mocap_dir / rig).glob("*walk_normal*.bvh" if rig == "bandai" else "L*example*.bvh"))[:6]
    group = [rigs.read(f) for f in files]
    got, _ = data.rig_for(group[0], Reading(str(tmp_path / "empty.toml")), group)
    want = RIGS[rig]
    assert got.joints == want.joints and got.balls == want.balls and got.unit == want.unit and got.up == want.up
    off = {s: np.degrees(quat_angle(got.calibration(s), want.calibration(s))) for s in SEGMENTS}
    for s, angle in off.items():
        assert angle < (25 if "hand" in s or s == "head" else limit), off
    assert np.mean(list(off.values())) < 8


# ---------------------------------------------------------------- joint maps, units, axes


ODD = {"LeftLeg": "Unterschenkel links", "LeftToeBase": "Zeh", "Head": "Schädel", "Spine2": "Brust"}


def test_unknown_rig(tmp_path, capsys):
    """An error that lists the joints, and a map to fill in that then works."""
    clip = walk(3.0)
    write_rig(tmp_path / "odd.bvh", clip, "mixamo", rename={"mixamorig:" + k: v for k, v in ODD.items()})
    with pytest.raises(UserError) as e:
        data.from_bvh(tmp_path / "odd.bvh")
    for word in ("odd.bvh", "no guess for shin_l among", "Unterschenkel_links", "mixamorig:Hips", "--joint-map", *RIGS):
        assert word in str(e.value), word
    blank = capsys.readouterr().out
    assert 'pelvis = "mixamorig:Hips"\n' in blank and 'shin_l = ""  # ?\n' in blank and 'balls = ["Zeh", ' in blank
    assert 'head = "Schädel"\n' in blank  # what is behind the neck
    filled = blank.replace('shin_l = ""', 'shin_l = "Unterschenkel_links"')
    (tmp_path / "map.toml").write_text(filled, encoding="utf-8")
    got = data.from_bvh(tmp_path / "odd.bvh", Reading(str(tmp_path / "map.toml")))
    assert degrees_off(got, clip).max() < 6 and got.body.startswith("map-leg")
    assert "guessed" not in capsys.readouterr().err


def test_partial_joint_map(tmp_path, capsys):
    """What the map says counts, the rest is guessed; .end names an End Site."""
    clip = walk(3.0)
    truth = write_rig(tmp_path / "odd.bvh", clip, "mixamo", rename={"mixamorig:Head": "Schädel"})
    path = tmp_path / "map.toml"
    path.write_text('unit = 0.01\nup = "y"\n[joints]\nhead = "Schädel"\n', encoding="utf-8")
    got = data.from_bvh(tmp_path / "odd.bvh", Reading(str(path)))
    err = capsys.readouterr().err
    assert "head <-" not in err and f"pelvis <- {truth['pelvis']}" in err and "is up" not in err and "unit" not in err
    assert degrees_off(got, clip).max() < 6
    path.write_text('balls = ["mixamorig:LeftToeBase.end", "mixamorig:RightToeBase.end"]\n[joints]\nhead = "Schädel"\n',
                    encoding="utf-8")  # fmt: skip
    ends = data.from_bvh(tmp_path / "odd.bvh", Reading(str(path)))
    np.testing.assert_allclose(ends.ball, got.ball, atol=1e-9)  # its End Sites have no length


def test_no_toes(tmp_path, capsys):
    """Without toes the balls are where the feet end."""
    clip = walk(3.0)
    write_rig(tmp_path / "a.bvh", clip, "xsens", seed=2)
    text = (tmp_path / "a.bvh").read_text().splitlines()
    for side in ("Left", "Right"):  # the toe becomes the ankle's End Site
        i = next(k for k, line in enumerate(text) if line.strip() == f"JOINT {side}Toe")
        assert text[i + 3].split()[0] == "CHANNELS" and text[i + 4].strip() == "End Site"
        text[i : i + 9] = [text[i].replace(f"JOINT {side}Toe", "End Site"), *text[i + 1 : i + 3], text[i + 8]]
    b = bvh.read(tmp_path / "a.bvh")
    keep = [c for j, n in enumerate(b.names) for c in [not n.endswith("Toe")] * len(b.channels[j])]
    motion = text.index("MOTION") + 3
    rows = [" ".join(w for w, k in zip(row.split(), keep) if k) for row in text[motion:]]
    (tmp_path / "b.bvh").write_text("\n".join(text[:motion] + rows) + "\n")
    got, want = (data.from_bvh(tmp_path / f"{n}.bvh") for n in "ba")
    assert "ball_l <- LeftAnkle.end" in capsys.readouterr().err
    np.testing.assert_allclose(got.ball, want.ball, atol=1e-6)
    assert quat_angle(got.quat, want.quat).max() < 1e-5


@pytest.mark.parametrize("text, words", [
    ("joints = 3", ("joints", "[joints]")),
    ("[joints\n", ("TOML",)),
    ('scale = 1\n', ("'scale'", "unit, up, balls")),
    ('[joints]\ntail = "Hips"\n', ("'tail'", "pelvis, chest, head")),
    ("[joints]\npelvis = 3\n", ("pelvis = 3",)),
    ('[joints]\npelvis = "Hip"\n', ("pelvis = 'Hip'", "walk.bvh", "Hips, Chest")),
    ('[joints]\nhead = "Hips"\npelvis = "Hips"\n', ("head", "pelvis", "'Hips'")),
    ('[joints]\nshin_l = "RightKnee"\n', ("shin_l", "thigh_l")),
    ('balls = ["LeftToe"]', ("balls", "two joints")),
    ('balls = ["LeftToe", "RightToes"]', ("ball_r = 'RightToes'", "RightToe")),
    ('unit = "yard"', ("unit 'yard'", "m, cm, mm, in, cmu")),
    ("unit = -1", ("unit -1",)),
    ("unit = true", ("unit True",)),
    ('up = "w"', ("up 'w'", "-z")),
])  # fmt: skip
def test_bad_joint_maps(tmp_path, text, words):
    path = tmp_path / "map.toml"
    write_rig(tmp_path / "walk.bvh", walk(1.0), "xsens")
    path.write_text(text)
    with pytest.raises(UserError) as e:
        data.from_bvh(tmp_path / "walk.bvh", Reading(str(path)))
    assert "\n" not in str(e.value) and "map.toml" in str(e.value)
    for word in words:
        assert word in str(e.value), e.value


def test_overrides(tmp_path, capsys):
    """What the user says about unit and axes counts more than proportions, maps and tables."""
    clip = walk(2.0)
    write_rig(tmp_path / "a.bvh", clip, "xsens", unit=0.01)
    twice = data.from_bvh(tmp_path / "a.bvh", Reading(unit="0.02"))
    np.testing.assert_allclose(twice.limb("thigh_l", "shin_l"), 2 * clip.limb("thigh_l", "shin_l"), rtol=1e-6)
    assert "unit" not in capsys.readouterr().err
    (tmp_path / "m.toml").write_text('unit = "m"\nup = "z"\n')
    got = data.from_bvh(tmp_path / "a.bvh", Reading(str(tmp_path / "m.toml"), "cm", "y"))
    assert degrees_off(got, clip).max() < 6 and capsys.readouterr().err.count("\n") == 1
    known = write_as(tmp_path / "b.bvh", "lafan1", clip)
    half = data.from_bvh(known, Reading(unit="0.005"))
    np.testing.assert_allclose(half.pos, 0.5 * clip.pos, atol=1e-6)
    capsys.readouterr()
    for path, up, lean in ((known, "z", "[89]"), (known, "-y", 17), (tmp_path / "a.bvh", "x", "[89]")):  # it lies
        with contextlib.suppress(UserError):
            data.from_bvh(path, Reading(up=up))
        assert re.search(rf"the body is {lean}\d degrees off {up}, taken as up; another: --up", capsys.readouterr().err)
    data.from_bvh(known, Reading(up="y"))
    assert capsys.readouterr().err == ""
    for bad in (dict(unit="ell"), dict(unit="nan"), dict(unit="0"), dict(up="north")):
        with pytest.raises(UserError, match="valid: "):
            Reading(**bad)


def test_units_and_up(tmp_path, capsys):
    """People of 1.3 to 2.1 m in every unit, adults in inches; a giant, and who is drawn to taste between two units, are
    made adults; one who somersaults needs to be told about."""
    for name, unit in rigs.UNITS.items():
        for height in (1.55, 2.05) if name in rigs.RARE else (1.3, 2.1):
            clip = augment.resize(walk(1.0), height / 1.75)
            write_rig(tmp_path / "a.bvh", clip, "games105", unit=unit, up="z")
            got = data.from_bvh(tmp_path / "a.bvh")
            np.testing.assert_allclose(got.limb("thigh_l", "shin_l"), clip.limb("thigh_l", "shin_l"), rtol=1e-4)
            assert f"unit {name}: " in capsys.readouterr().err
    for hips in (13.0, 28.0, 45.0, 280.0):
        write_rig(tmp_path / "a.bvh", walk(1.0), "games105", unit=walk(1.0).hip_height / hips)
        assert data.from_bvh(tmp_path / "a.bvh").hip_height == pytest.approx(0.9, abs=0.01)
        assert "units high: scaled to an adult's 0.9 m, " in capsys.readouterr().err
    clip = walk(2.0)
    over = Rotation.from_euler("y", np.linspace(0, 2 * np.pi, len(clip))[:, None])
    pos = np.stack([over.apply(clip.pos[:, s]) for s in range(15)], axis=1)
    ball = np.stack([over.apply(clip.ball[:, s]) for s in range(2)], axis=1)
    quat = np.stack([(over * rot(clip.quat[:, s])).as_quat(scalar_first=True) for s in range(15)], axis=1)
    write_rig(tmp_path / "a.bvh", replace(clip, pos=pos, ball=ball, quat=quat), "games105")
    with pytest.raises(UserError, match="give --up"):
        data.from_bvh(tmp_path / "a.bvh")


def test_swapped_sides(tmp_path):
    """Left and right exchanged in the names: the toes point backwards."""
    other = {f"{a}{n}": f"{b}{n}" for a, b in (("Left", "Right"), ("Right", "Left"))
             for n in "Collar Shoulder Elbow Wrist Hip Knee Ankle Toe".split()}  # fmt: skip
    write_rig(tmp_path / "a.bvh", walk(1.0), "xsens", rename=other)
    with pytest.raises(UserError, match=r"a\.bvh: the toes point backwards"):
        data.from_bvh(tmp_path / "a.bvh")


def test_floor(tmp_path, capsys):
    """A file whose origin is not on the floor: the feet are put there, and it is said."""
    clip = walk(2.0)
    for height in (-0.9, -0.2, -0.11, 0.0, 0.11, 0.2, 2.0):
        up = np.array([0.0, 0.0, height])
        write_rig(tmp_path / "a.bvh", replace(clip, pos=clip.pos + up, ball=clip.ball + up), "rokoko")
        got = data.from_bvh(tmp_path / "a.bvh")
        assert ("the feet rest" in capsys.readouterr().err) == bool(height)
        np.testing.assert_allclose(got.pos, clip.pos, atol=0.02)

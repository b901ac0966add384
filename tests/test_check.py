"""`python -m characters.check` on characters with several mistakes each: it finds them all, and each is one line.

And on the two that characters/README.md works out: a doll, and a humanoid of Gymnasium's."""

import re

import numpy as np
import pytest
from test_characters import fourth, readme
from test_retarget import clip_of

import character
import retarget
from characters import check
from plumbing.cli import UserError

XML, TOML = "peg.xml", "peg.toml"
SENSOR_L = '<contact name="floor_l" geom1="floor" body2="foot_l" data="force" reduce="netforce"/>'
SENSOR_R = '<contact name="floor_r" geom1="floor" body2="foot_r" data="force" reduce="netforce"/>'
TRUNK = '<geom fromto="0 0 0.05 0 0 0.25" size="0.1"/>'
BROKEN = {  # what: (file, old text, new text, what a line says beside the file: the place, and what is valid), …
    "names": [
        (TOML, '"eyes"', '"eye"', ("[sensors]", "'eye'", "eyes, hand_l, hand_r")),
        (TOML, '"floor_r"]', '"floor_right"]', ("[feet]", "'floor_right'", "floor_l, floor_r")),
        (TOML, 'root = { body = "hips" }', 'root = { body = "pelvis" }', ("[root]", "'pelvis'", "hips, trunk")),
        (TOML, "shin_r = { from", "calf_r = { from", ("[map]", "'calf_r'", "shin_r")),
        (TOML, 'to = "thigh_l"', 'to = "upper_leg_l"', ("[map.thigh_l]", "'upper_leg_l'", "thigh_l")),
        (TOML, '"trunk", "head", "arm_l", "arm_r"]', '"trunk", "hed", "arm_l", "arm_r"]', ("[fall]", "'hed'", "head")),
        (TOML, "links = { hips = 1.0", "links = { hip = 1.0", ("[reward.links]", "'hip'", "hips")),
    ],
    "sensors": [
        (XML, SENSOR_L, "", ("[feet]", "'floor_l'", "there are: floor_r")),
        (XML, 'body2="foot_r"', 'body2="fot_r"', ("sensor floor_r", "body 'fot_r'", "valid: world, hips")),
        (XML, '<site name="eyes"', '<site name="hmd"', ("[sensors]", "'eyes'", "hmd, hand_l, hand_r")),
        (TOML, 'trunk = { from = "pelvis"', 'trunk = { from = "hips"', ("[map.trunk]", "'hips'", "pelvis")),
    ],
    "sensors of something else": [
        (XML, SENSOR_L, '<accelerometer name="floor_l" site="eyes"/>', ("floor_l", "accelerometer", "contact")),
        (XML, 'body2="foot_r"', 'body2="foot_l"', ("floor_r watches foot_l", "valid: one that watches foot_r")),
        (TOML, 'sites = ["eyes", "hand_l"', 'sites = ["eyes", "hnd_l", "hand_l"', ("three sites", "found 4")),
        (TOML, '"hand_r"] }', '"hand_r"], scale_z = "head" }', ("[sensors] scale_z", "'head'", '"headset"')),
    ],
    "motors": [
        (XML, 'contype="0" conaffinity="1" density', 'conaffinity="1" density', ("touch one another", 'contype="0"')),
        (XML, '<motor joint="knee_l_y"/>', '<motor joint="nee_l_y"/>', ("a motor", "'nee_l_y'", "knee_l_y")),
        (XML, '<motor joint="hip_r_x"/>', '<motor joint="hip_r_y"/>', ("hinge of its own", "that of hip_r_y")),
        (XML, '<motor joint="head_y"/>', '<position joint="head_y"/>', ("plain <motor>", "-1 1", "that of head_y")),
        (XML, '<motor joint="head_z"/>', "", ("head_z has neither a motor nor a spring", "stiffness and damping")),
        (TOML, "scale = { shoulder = 0.2", "scale = { sholder = 0.2", ("[torque.scale]", "'sholder'", "shoulder")),
    ],
    "degrees": [
        (XML, 'class="y" range="-0.05 2.4"/><geom fromto="0 0 0 0 0 -0.2" size="0.04"/>\n          <body name="foot_l"',
         'class="y" range="-3 140"/><geom fromto="0 0 0 0 0 -0.2" size="0.04"/>\n          <body name="foot_l"',
         ("knee_l_y", "140 rad", "radians")),
        (XML, 'name="shoulder_l_x" class="x" range="-0.5 3"', 'name="shoulder_l_x" class="x" range="-30 170"',
         ("shoulder_l_x", "170 rad", "radians")),
        (XML, 'name="shoulder_r_x" class="x" range="-3 0.5"', 'name="shoulder_r_x" class="x" range="0.5 -3"',
         ("shoulder_r_x", "0.5 to -3", "smaller angle first")),
        (TOML, "[map]", "pose = { hip_y = -20.0, knee = 0.1 }\n[map]", ("[pose] hip_y", "-20.0", "radians")),
        (TOML, "pose = {", "pose = {", ("[pose]", "'knee'", "knee_l_y")),
        (XML, 'name="hips" pos="0 0 0.6"', 'name="hips" pos="0 0 0.6" euler="0 0 1.57"', ("y axis of hips", "left")),
    ],
    "groups": [
        (TOML, "base = { default = 40.0 }", "base = { hip = 40.0, knee = 0, ankle = -5.0, spine = 40.0 }",
         ("[torque.base]", "no head, shoulder", "valid: ")),
        (TOML, "torque", "torque", ("[torque.base] knee", "0", "greater than 0")),
        (TOML, "torque", "torque", ("[torque.base] ankle", "-5.0", "greater than 0")),
        (TOML, "head = 0.1 }", "head = 0.0 }", ("[torque.scale] head", "0.0", "greater than 0")),
        (TOML, "{ default = 30.0, shoulder = 6.0, head = 4.0 }", "{ hip = 30.0, shoulder = -6.0, head = 4.0 }",
         ("[passive.stiffness]", "no ankle, knee, spine", "valid: ")),
        (TOML, "passive", "passive", ("[passive.stiffness] shoulder", "-6.0", "at least 0")),
        (XML, 'joint name="spine_x" class="x"', 'joint name="spine_x" class="y"', ("trunk", "yyz", "x, y and z once")),
    ],
    "falls and feet": [
        (TOML, '"arm_l", "arm_r"] }', '"arm_l", "arm_r", "foot_l"] }', ("[fall]", "foot_l", "must not touch")),
        (TOML, 'links = ["hips", "trunk"', 'links = ["hips", "chest"', ("[observation]", "'chest'", "trunk")),
        (XML, '<joint name="ankle_l_y" class="y" range="-0.9 0.9"/><geom type="box"',
         '<joint name="ankle_l_y" class="y" range="-0.9 0.9"/><geom conaffinity="0" type="box"',
         ("[feet]", "foot_l", "no geom that the floor can touch", "conaffinity 1")),
        (XML, '<joint name="ankle_r_y" class="y" range="-0.9 0.9"/><geom type="box"',
         '<joint name="ankle_r_y" class="y" range="-0.9 0.9"/><geom type="ellipsoid"',
         ("[feet]", "foot_r", "sphere, capsule and box")),
        (XML, 'contype="1" conaffinity="0" rgba', 'pos="0 0 0.1" contype="1" rgba', ("a floor", "height 0")),
    ],
    "masses": [
        (XML, TRUNK, TRUNK.replace("<geom", '<geom mass="-3"'), ("body trunk", "mass of -3", "0 or more")),
        (XML, '<geom fromto="0 0 -0.05 0 0 -0.25" size="0.05"/>\n        <body name="shin_r"',
         '<geom density="-1" fromto="0 0 -0.05 0 0 -0.25" size="0.05"/>\n        <body name="shin_r"',
         ("body thigh_r", "density of -1", "0 or more")),
        (XML, '<body name="shin_l" pos="0 0 -0.3">',
         '<body name="shin_l" pos="0 0 -0.3"><inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>',
         ("body shin_l", "mass of 0", "greater than 0")),
        (XML, 'name="head_z" class="z"', 'name="head_z" class="z" damping="-2"', ("head_z", "damping of -2")),
        (TOML, "damping = 0.05", "damping = -0.05", ("[passive] damping", "-0.05", "at least 0")),
        (TOML, 'head = { from = "chest", to = "head" }\n', "", ("[map]", "human's head", "to = 'head'")),
    ],
    "no free joint": [
        (XML, "<freejoint/>", "", ("first joint must be free", "hips", "<freejoint/>")),
        (XML, 'joint name="spine_z" class="z"', 'joint name="spine_z" type="slide" class="z"', ("spine_z", "slide")),
        (XML, '<motor joint="ankle_l_y"/>', '<motor joint="ankel_l_y"/>', ("'ankel_l_y'", "ankle_l_y")),
        (TOML, "q = [4.0, 25.0]", "q = [4.0]", ("[reward] q", "[w, k]")),
        (TOML, 'feet = { bodies = ["foot_l", "foot_r"]', 'feet = { bodies = ["foot_l"]', ("two bodies", "1 and 2")),
    ],
    "two roots": [
        (XML, '<body name="hips" pos="0 0 0.6">', '<body name="prop" pos="1 0 1"><joint name="prop_y" axis="0 1 0"/>'
         '<geom type="sphere" size="0.1"/></body>\n    <body name="hips" pos="0 0 0.6">',
         ("prop, hips", "one body of the world")),
        (XML, "prop", "prop", ("first joint must be free", "body prop")),
        (XML, 'joint name="head_y" class="y"', 'joint class="y"', ("every hinge needs a name", "'head'", "hip_l_y")),
        (XML, '<motor joint="head_y"/>', "", ("[sensors] has 'site'", "no sites", "valid: sites")),
        (TOML, 'sensors = { sites', "sensors = { site", ("[sensors] has 'site'", "no sites", "valid: sites")),
        (TOML, "fail = -5.0", 'fail = "five"', ("[reward] fail", "'five'", "number")),
    ],
    "typos": [
        (TOML, "observation = {", "observations = {", ("'observations'", "no table [observation]", "valid: name")),
        (TOML, "damping = 0.05", "dampning = 0.05", ("[passive] has 'dampning'", "no damping", "valid: stiffness")),
        (TOML, "xd = [0.7, 2.0]", "xd = [0.7, -2.0]", ("[reward] xd", "-2.0", "at least 0")),
        (TOML, "x = [2.5, 6.0]", "x = 2.5", ("[reward] x", "2.5", "[w, k]")),
        (TOML, 'head = { from = "chest", to = "head" }', 'head = { from = "chest", too = "head" }',
         ("[map.head] has 'too'", "no to", "valid: from, to")),
        (TOML, "[map]", 'model = "pegg.xml"\n[map]', ("model = 'pegg.xml'", "there: peg.xml")),
        (TOML, "root = {", 'metrics = { sip = ["leg"] }\nroot = {', ("[metrics]", "'leg'", "shin_l")),
        (XML, 'joint name="hip_r_x" class="x"', 'joint name="hip_r_x" axis="1 1 0"', ("one axis", "not so hip_r_x")),
    ],
    "a model that cannot be read": [
        (XML, "</worldbody>", "</worldbdy>", ("no XML", "expected MJCF")),
        (TOML, "damping = 0.05", 'damping = "a lot"', ("[passive] damping", "'a lot'", "number")),
        (TOML, "contact = [1.5, 1.0]", "contakt = [1.5, 1.0]", ("[reward] has 'contakt'", "no contact", "valid: q")),
        (TOML, 'to = "chest"', 'to = "breast"', ("[map.trunk]", "'breast'", "chest")),
    ],
    "a table that cannot be read": [
        (TOML, "[map]", "[map", ("peg.toml", "line")),
        (XML, "<freejoint/>", "", ("first joint must be free", "hips", "<freejoint/>")),
        (XML, 'contype="1" conaffinity="0" rgba', 'pos="0 0 0.1" contype="1" rgba', ("a floor", "height 0")),
        (XML, SENSOR_R, SENSOR_R.replace("foot_r", "foot"), ("sensor floor_r", "'foot'", "foot_r")),
    ],
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_every_mistake(tmp_path, case):
    """Each mistake has its line, which names the file, the place and what is valid; loading stops at one of them."""
    path, _ = fourth(tmp_path)
    assert check.check(path) == []
    text = {name: (tmp_path / name).read_text() for name in (XML, TOML)}
    for file, old, new, _ in BROKEN[case]:
        assert old in text[file], old
        text[file] = text[file].replace(old, new, 1)
    for name, content in text.items():
        (tmp_path / name).write_text(content)
    found = check.check(tmp_path / XML)
    told = "\n".join(found)
    for _, _, _, says in BROKEN[case]:
        lines = [line for line in found if all(part in line for part in says)]
        assert lines, f"no line with {says} in\n{told}"
        assert any(str(tmp_path) in line for line in lines), lines
    assert all("\n" not in line and str(tmp_path) in line for line in found), told
    assert len(found) <= 2 * len(BROKEN[case]) + 1, told  # and little that follows from another mistake
    assert check.check(path) == [line for line in found if "its model is" not in line]
    with pytest.raises(UserError) as error:
        character.load(path)
    assert any(str(error.value) == line for line in found), str(error.value)


def test_humanoid_of_the_readme(tmp_path, monkeypatch):
    """Gymnasium's humanoid.xml has many faults as it is; changed as the README says it has none, and can be posed."""
    gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
    monkeypatch.chdir(tmp_path)
    section = re.search(r"^### A fifth one.*", readme(), re.M | re.S)[0]
    [script], [tables] = (re.findall(rf"```{kind}\n(.*?)```", section, re.S) for kind in ("python", "toml"))
    assets = re.search(r'"(envs/\S+humanoid.xml)"', script)[1]
    (tmp_path / "bare.xml").write_bytes((character.Path(gymnasium.__file__).parent / assets).read_bytes())
    bare = "\n".join(check.check(tmp_path / "bare.xml"))
    wrong = "is not there", "not so right_shoulder1", "not so abdomen_y", "touch one another", "[sensors] has no sites"
    for says in wrong:
        assert says in bare, bare
    exec(compile(script, "make.py", "exec"), {})
    (tmp_path / "humanoid.toml").write_text(tables)
    assert check.check(tmp_path / "humanoid.xml") == []
    char, clip = character.load(tmp_path / "humanoid.toml"), clip_of("walk", 3.0)
    report = retarget.artefacts(char, clip, retarget.retarget(char, clip))
    assert report["limit_share"] < 0.01 and abs(report["float_mm"]) < 30
    assert char.j == len(char.driven) == 25 and np.isclose(char.model.body_subtreemass[0], 40.3, atol=0.1)

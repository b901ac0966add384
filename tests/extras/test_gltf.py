"""extras/gltf.py: another library opens the file, and every body stands where MuJoCo has it."""

import json
import struct
import sys

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import character
import retarget
from extras import gltf
from mocap.data import CONTROL_RATE, load
from plumbing.cli import UserError

pytest.importorskip("pygltflib", reason="the extra gltf is not installed")
AXES = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # x left, y up, z forward


@pytest.fixture(scope="module", params=["jesse", "oppy", "dino"])
def made(request, tmp_path_factory):
    """A character, its poses on a second of a walk, and the file of them."""
    char = character.load(request.param)
    qpos = retarget.retarget(char, load("builtin", clips="turn_006")[0][:31]).qpos
    qpos[:, 7:] += np.random.default_rng(0).uniform(-0.2, 0.2, char.j)  # tail and ears, too
    path = tmp_path_factory.mktemp("gltf") / "a.glb"
    path.write_bytes(gltf.gltf_of(char, qpos, CONTROL_RATE, {"licence": "none"}))
    return char, qpos, path


def parsed(path):
    """A .glb by its specification: the JSON and a function that reads an accessor."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    text = json.loads(data[20 : 20 + size])
    more, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and 0 <= more - text["buffers"][0]["byteLength"] < 4
    binary = data[28 + size :]

    def read(k):
        accessor = text["accessors"][k]
        view = text["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(binary, dtype, accessor["count"] * width, start).reshape(-1, width)

    return text, read


def test_second_reader(made):
    """trimesh: nodes of the first frame, then of others through the animation's numbers; positions to 1e-5 m."""
    trimesh = pytest.importorskip("trimesh")
    char, qpos, path = made
    scene, (text, read) = trimesh.load(path), parsed(path)
    fk, m = retarget.forward_kinematics(char, qpos), char.model
    names = [m.body(b).name for b in range(1, m.nbody)]
    assert [n["name"] for n in text["nodes"]] == names and set(names) <= set(scene.graph.nodes)
    parents = {text["nodes"][c]["name"]: n["name"] for n in text["nodes"] for c in n.get("children", [])}
    assert parents == {m.body(b).name: m.body(m.body_parentid[b]).name for b in range(2, m.nbody)}
    for t in (0, 13, 30):
        if t:
            for name, matrix in moved(text, read, t).items():
                scene.graph.update(frame_to=name, frame_from=parents.get(name, "world"), matrix=matrix)
        for name in names:
            got, b = scene.graph.get(name)[0], m.body(name).id
            np.testing.assert_allclose(got[:3, 3], AXES @ fk.xpos[t, b], atol=1e-5)
            want = AXES @ Rotation.from_quat(fk.xquat[t, b], scalar_first=True).as_matrix() @ AXES.T
            np.testing.assert_allclose(got[:3, :3], want, atol=1e-5)
    top, low = scene.bounds[1, 1], scene.bounds[0, 1]  # the shapes stand on the floor, as high as the character is
    assert abs(low) < 0.12 and char.height - 0.1 < top < char.height + 0.3


def moved(text, read, t):
    """Local matrices of all nodes at key t: node's name -> (4, 4)."""
    out = {}
    for node in text["nodes"]:
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix()
        matrix[:3, 3] = node["translation"]
        out[node["name"]] = matrix
    for channel in text["animations"][0]["channels"]:
        sampler = text["animations"][0]["samplers"][channel["sampler"]]
        value, name = read(sampler["output"])[t], text["nodes"][channel["target"]["node"]]["name"]
        if channel["target"]["path"] == "rotation":
            out[name][:3, :3] = Rotation.from_quat(value).as_matrix()
        else:
            out[name][:3, 3] = value
    return out


def test_animation(made):
    """Key times in seconds; unit quaternions without jumps; the root moves, the others turn about their joints."""
    char, qpos, path = made
    text, read = parsed(path)
    assert text["asset"]["version"] == "2.0" and text["asset"]["extras"] == {"licence": "none"}
    animation = text["animations"][0]
    moving = []
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        times, values = read(sampler["input"])[:, 0], read(sampler["output"])
        np.testing.assert_allclose(times, np.arange(31) / 30, atol=1e-6)
        accessor = text["accessors"][sampler["input"]]
        assert accessor["min"] == [0.0] and accessor["max"] == [pytest.approx(1.0)] and len(values) == 31
        if channel["target"]["path"] == "rotation":
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1.0, atol=1e-6)
            assert np.abs(values).max() <= 1.0 and (np.sum(values[1:] * values[:-1], axis=1) > 0).all()
        else:
            moving.append(text["nodes"][channel["target"]["node"]]["name"])
    assert moving == ["pelvis"] and len(animation["channels"]) == char.model.nbody
    assert max(abs(x) for n in text["nodes"] for x in n["rotation"]) <= 1.0


def test_shapes(made):
    """The file's meshes are MuJoCo's shapes: each closed, facing outwards, as large as the shape it stands for."""
    trimesh = pytest.importorskip("trimesh")
    char = made[0]
    m = char.mjspec().compile()
    geoms = gltf.shown(m, char.root)
    assert len(geoms) == ((m.geom_group == 1) & (m.geom_bodyid > 0)).sum()
    kinds = mujoco.mjtGeom
    for g in geoms:
        points, normals, triangles = gltf.shape(m, g)
        mesh = trimesh.Trimesh(points, triangles, process=False)
        mesh.merge_vertices(merge_norm=True, merge_tex=True)
        size, kind = m.geom_size[g], m.geom_type[g]
        volume = {
            kinds.mjGEOM_SPHERE: 4 / 3 * np.pi * size[0] ** 3,
            kinds.mjGEOM_ELLIPSOID: 4 / 3 * np.pi * size.prod(),
            kinds.mjGEOM_CAPSULE: np.pi * size[0] ** 2 * (4 / 3 * size[0] + 2 * size[1]),
            kinds.mjGEOM_CYLINDER: np.pi * size[0] ** 2 * 2 * size[1],
            kinds.mjGEOM_BOX: 8 * size.prod(),
        }[kinds(kind)]
        assert mesh.is_watertight and mesh.is_winding_consistent, m.geom(g).name
        assert 0.93 * volume < mesh.volume < 1.0001 * volume, m.geom(g).name
        np.testing.assert_allclose(mesh.center_mass, m.geom_pos[g], atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
        corner = points[triangles]
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        assert (np.sum(across * normals[triangles].mean(1), axis=1) > 0).all(), m.geom(g).name
        back = Rotation.from_quat(m.geom_quat[g], scalar_first=True).inv().apply(points - m.geom_pos[g])
        np.testing.assert_allclose(np.abs(back).max(0), m.geom_aabb[g, 3:], atol=0.02 * m.geom_aabb[g, 3:].max())


def test_colours(made):
    """Dino's skin as on the screen: sRGB made linear; a character without shapes to look at shows what collides."""
    char, _, path = made
    text, _ = parsed(path)
    factors = np.array([k["pbrMetallicRoughness"]["baseColorFactor"] for k in text["materials"]])
    if char.name == "dino":
        skin = [0.0888, 0.2740, 0.0595, 1.0]  # 0.33, 0.56, 0.27 of a screen
        assert np.abs(factors - skin).max(axis=1).min() < 1e-3
    assert ((factors >= 0) & (factors <= 1)).all() and len({tuple(f) for f in factors}) == len(factors)
    np.testing.assert_allclose(gltf.linear([0.0, 0.04, 1.0]), [0.0, 0.04 / 12.92, 1.0])
    xml = """<mujoco><asset><material name="red" rgba="1 0 0 1"/></asset><worldbody><geom type="plane" size="1 1 1"/>
    <body><freejoint/><geom size="0.1" group="3" material="red"/><geom size="0.1" group="3" material="red"
    rgba="0 1 0 0.5"/><geom size="0.1" rgba="0 0 0 0"/></body></worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    assert gltf.shown(m, 1) == [1, 2]
    assert gltf.colour(m, 1).tolist() == [1, 0, 0, 1] and gltf.colour(m, 2).tolist() == [0, 1, 0, 0.5]


def test_a_mesh():
    """A mesh of an MJCF, turned and moved as MuJoCo centres it; a plane has no surface."""
    xml = """<mujoco><asset><mesh name="wedge" vertex="0 0 0  2 0 0  0 1 0  0 0 3"/></asset><worldbody>
    <body name="b"><freejoint/><geom type="mesh" mesh="wedge"/></body>
    <geom type="plane" size="1 1 1"/></worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    points, normals, triangles = gltf.shape(m, 1)
    assert {tuple(p) for p in points.round(5) + 0.0} == {(0, 0, 0), (2, 0, 0), (0, 1, 0), (0, 0, 3)}
    corner = points[triangles]
    assert np.sum(corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])) / 6 == pytest.approx(1.0, abs=1e-5)  # outwards
    assert len(triangles) == 4 and len(normals) == 12
    with pytest.raises(UserError, match="of world is a plane, which glTF cannot show; valid: sphere, capsule"):
        gltf.shape(m, 0)


def test_command_line(tmp_path, capsys, monkeypatch):
    """A motion and a stream; what is wrong is one line."""
    monkeypatch.chdir(tmp_path)
    gltf.main(["--character", "oppy", "--clips", "walk_005", "--seconds", "1", "--threads", "1"])
    assert "oppy.glb: 25 bodies, 1.0 s" in capsys.readouterr().out
    text, read = parsed(tmp_path / "oppy.glb")
    assert "NonCommercial" in text["asset"]["extras"]["licence"]
    rows = ["time," + ",".join(f"{d}_{c}" for d in ("head", "left", "right") for c in "px py pz qx qy qz qw".split())]
    still = "0,1.6,0,0,0,0,1,-0.25,0.8,0.1,0,0,0,1,0.25,0.8,0.1,0,0,0,1"
    rows += [f"{k / 60},{still}" for k in range(150)]
    (tmp_path / "s.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "short.csv").write_text("\n".join(rows[:62]) + "\n")
    gltf.main(["--stream", "s.csv", "--axes", "unity", "--seconds", "0.5", "--out", "s.glb"])
    out = capsys.readouterr().out
    assert "0.5 s played" in out and "s.glb: 19 bodies, 0.5 s" in out
    text, read = parsed(tmp_path / "s.glb")
    place = read(text["animations"][0]["samplers"][1]["output"])  # the root's second track
    assert place.shape == (15, 3) and (place[:, 1] > 0.7).all()
    for args, says in (
        (["--out", str(tmp_path / "none" / "a.glb")], "cannot write .*a.glb: there is no folder"),
        (["--out", "a.gltf"], "--out a.gltf: is written as .glb"),
        (["--stream", "s.csv", "--clips", "walk*"], "--clips is of a motion, and --stream has none"),
        (["--axes", "unity"], "--axes is of --stream FILE"),
        (["--stream", "nothing.csv"], "nothing.csv"),
        (["--stream", str(tmp_path)], "is a folder"),
        (["--stream", "short.csv", "--axes", "unity"], "short.csv: ends with the second that calibrates"),
        (["--character", "nobody"], "no character 'nobody'"),
        (["--sequence", "99", "--clips", "walk_005"], "--sequence 99: there are 1"),
    ):
        with pytest.raises(UserError, match=says):
            gltf.main(args)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["oppy.glb", "s.csv", "s.glb", "short.csv"]


def test_without_the_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygltflib", None)
    with pytest.raises(UserError, match=r'pygltflib is not installed: .*pip install -e "\.\[gltf\]"'):
        gltf.main(["--character", "jesse"])

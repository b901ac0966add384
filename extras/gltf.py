r"""A character and its motion as glTF, for the web, Blender, Godot, and whatever else shows 3D.

    python -m extras.gltf --character jesse --stream FILE.csv --out jesse.glb      needs the extra `gltf`
    python -m extras.gltf --character dino --motion FOLDER --sequence 3            what the policy does on a motion

    MJCF's shapes ──► a mesh a body ──► nodes, as the bodies hang ──┐
    policy on a motion or a stream ──► turns of the nodes ──────────┴──► .glb

A node is a body of the model and has its name; its mesh is the body's shapes to look at, in their colours.  One
animation turns the nodes and moves the root.  glTF: y up, z forward, x left, metres; quaternions x, y, z, w.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

import mocap.data
import play
from character import Character, Switches
from env import SENSORS, Env
from human import quat_conj, quat_continuous, quat_mul, quat_rotate
from metrics import TIMES, policy_action, shown_to, simulate
from mocap.data import CONTROL_RATE, MotionFlags
from plumbing.cli import NONNEGATIVE, POSITIVE, THREADS, UserError, arg, cli, run_main
from plumbing.files import atomic_write, check_folders
from policy import check_fits, devices_of, find_policy, load_character
from retarget import forward_kinematics, to_file

SLICES, STACKS = 20, 5  # of a round shape: sides, and rings from pole to equator
ROUGHNESS = 0.8  # skin and cloth shine little
FLOAT, UINT, VERTICES, INDICES = 5126, 5125, 34962, 34963  # glTF's numbers for types of data


@dataclass
class Options(play.StreamFlags, MotionFlags, Switches):
    """Which policy, on which motion or under which headset, and where to write it."""

    character: str | None = arg(None, "name in characters/, or path of a .toml; the policy's own by default, or jesse")
    policy: str | None = arg(None, "run folder or policy .npz; characters/NAME.npz by default")
    out: str | None = arg(None, "file to write; NAME.glb by default")
    sensors: str | None = arg(None, "hmd: the policy is shown the headset alone (play.py)", choices=SENSORS)
    sequence: int = arg(0, "which sequence of the motion", check=NONNEGATIVE)
    all: bool = arg(False, "every sequence of the motion, not only its validation part")
    split: str = arg("validation", "which part of the motion", choices=("train", "validation", "style", "body"))
    user_scale: float = arg(1.0, "play the motion by a user this many times as tall", check=TIMES)
    seconds: float | None = arg(None, "how much of it; all by default", check=POSITIVE)
    seed: int = arg(0, "seed of stitching", check=NONNEGATIVE)
    threads: int = arg(0, "physics threads, 0 = all cores", check=THREADS)


# ------------------------------------------------------------------------------------ shapes


def revolved(profile):
    """A surface of revolution about z.

    Args      profile (k, 4) : radius, height, and the normal's two parts, from the lowest point to the highest
    Returns   points (n, 3), normals (n, 3), triangles (f, 3), counter-clockwise seen from outside
    Test      tests/extras/test_gltf.py::test_shapes"""
    r, z, out, up = np.asarray(profile, float).T[:, :, None]
    angle = np.linspace(0.0, 2 * np.pi, SLICES, endpoint=False)[None]
    cos, sin, flat = np.cos(angle), np.sin(angle), np.ones_like(angle)
    points = np.stack([r * cos, r * sin, z * flat], axis=-1)
    normals = np.stack([out * cos, out * sin, up * flat], axis=-1)
    ring, side = (k.ravel() for k in np.meshgrid(np.arange(len(profile) - 1), np.arange(SLICES), indexing="ij"))
    a, b = ring * SLICES + side, ring * SLICES + (side + 1) % SLICES
    triangles = np.concatenate([np.stack([a, b, b + SLICES], 1), np.stack([a, b + SLICES, a + SLICES], 1)])
    points = points.reshape(-1, 3)
    corner = points[triangles]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return points, normals.reshape(-1, 3), triangles[area > 1e-12]


def ball(radius=1.0, half=0.0):
    """Profile of a sphere, or of a capsule whose straight part is 2 half long."""
    low = np.linspace(-np.pi / 2, 0.0, STACKS + 1)
    both = [(-half, low), (half, -low[::-1])] if half else [(0.0, np.concatenate([low, -low[-2::-1]]))]
    return [(radius * np.cos(a), at + radius * np.sin(a), np.cos(a), np.sin(a)) for at, part in both for a in part]


def rod(radius, half):
    """Profile of a cylinder: two flat ends, whose edges are not smoothed."""
    end = [(0.0, half, 0.0, 1.0), (radius, half, 0.0, 1.0)]
    side = [(radius, -half, 1.0, 0.0), (radius, half, 1.0, 0.0)]
    return [(r, -z, 0.0, -1.0) for r, z, _, _ in end] + side + end[::-1]


def box(half):
    """A box of these half sizes (3,): as `revolved` returns it."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
    points, normals, triangles = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.roll([sign, 0.0, 0.0], axis)
            face = np.roll(np.column_stack([np.full(4, sign), corners[:: int(sign)]]), axis, axis=1)
            triangles += [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * len(points)]
            points.append(face * half)
            normals.append(np.tile(normal, (4, 1)))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(triangles)


def shape(m, g: int):
    """A geom's surface in its body's frame.

    Returns   points (n, 3) [m], normals (n, 3), triangles (f, 3)
    Raises    UserError: a shape without a surface of its own, such as a plane
    Test      tests/extras/test_gltf.py::test_shapes, test_a_mesh"""
    kind, size = mujoco.mjtGeom(m.geom_type[g]), m.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        points, normals, triangles = revolved(ball(size[0]))
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        points, normals, triangles = revolved(ball(size[0], size[1]))
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        points, normals, triangles = revolved(rod(size[0], size[1]))
    elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        points, normals, triangles = revolved(ball())
        points, normals = points * size, normals / size
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        points, normals, triangles = box(size)
    elif kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = m.mesh(m.geom_dataid[g])
        faces = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
        points = m.mesh_vert[mesh.vertadr[0] + m.mesh_face[faces]].reshape(-1, 3)
        normals = m.mesh_normal[m.mesh_normaladr[mesh.id] + m.mesh_facenormal[faces]].reshape(-1, 3)
        triangles = np.arange(len(points)).reshape(-1, 3)
    else:
        name = f"geom {m.geom(g).name!r} of {m.body(m.geom_bodyid[g]).name}"
        says = "valid: sphere, capsule, cylinder, ellipsoid, box, mesh"
        raise UserError(f"{name} is a {kind.name.removeprefix('mjGEOM_').lower()}, which glTF cannot show; {says}")
    turn = m.geom_quat[g]
    return quat_rotate(turn, points) + m.geom_pos[g], quat_rotate(turn, normals), triangles


def shown(m, root: int) -> list[int]:
    """The geoms that MuJoCo's viewer shows of a character: groups 0 to 2; all, where there are none in these.

    Test      tests/extras/test_gltf.py::test_colours"""
    own = [g for g in range(m.ngeom) if m.body_rootid[m.geom_bodyid[g]] == root and colour(m, g)[3] > 0]
    return [g for g in own if m.geom_group[g] < 3] or own


def colour(m, g: int):
    """Red, green, blue as on a screen, and opacity: the material's, unless the geom says another than MuJoCo's grey.

    Test      tests/extras/test_gltf.py::test_colours"""
    own, material = m.geom_rgba[g], m.geom_matid[g]
    return m.mat_rgba[material] if material >= 0 and np.allclose(own, [0.5, 0.5, 0.5, 1.0]) else own


def linear(rgb):
    """A screen's colours as glTF wants them: proportional to light.

    Equation  [IEC 61966-2-1] c / 12.92 up to 0.04045, ((c + 0.055) / 1.055)^2.4 above
    Test      tests/extras/test_gltf.py::test_colours"""
    c = np.asarray(rgb, float)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


# ------------------------------------------------------------------------------------ the file


class Blob:
    """The binary part of a .glb while it grows, with the views and accessors that say what is in it."""

    def __init__(self, lib):
        self.lib, self.data, self.views, self.accessors = lib, bytearray(), [], []

    def add(self, array, kind: str, target=None, bounds=False) -> int:
        """Rows of numbers; kind : SCALAR, VEC3 or VEC4.  -> number of the accessor"""
        array = np.ascontiguousarray(array, np.uint32 if target == INDICES else np.float32)
        view = self.lib.BufferView(buffer=0, byteOffset=len(self.data), byteLength=array.nbytes, target=target)
        accessor = self.lib.Accessor(
            bufferView=len(self.views),
            componentType=UINT if target == INDICES else FLOAT,
            count=len(array),
            type=kind,
        )
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor.min, accessor.max = flat.min(0).tolist(), flat.max(0).tolist()
        self.data += array.tobytes()  # of 4 bytes each: all stays aligned
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def xyzw(q):
    """Quaternions w, x, y, z of ours -> x, y, z, w of glTF, in its axes.  (..., 4) -> (..., 4)

    Test      tests/extras/test_gltf.py::test_second_reader"""
    return np.concatenate([to_file(q[..., 1:]), q[..., :1]], axis=-1)


def library():
    """pygltflib.  Raises UserError: it is not installed.  Test: tests/extras/test_gltf.py::test_without_the_library"""
    try:
        import pygltflib
    except ImportError:
        raise UserError('pygltflib is not installed: needed for this; pip install -e ".[gltf]"') from None
    return pygltflib


def gltf_of(char: Character, qpos, rate, notes: dict | None = None) -> bytes:
    r"""A character's shapes and motion as the bytes of a .glb.

    Equation  of a body b in its parent p: turn q_p⁻¹ q_b, place R_p⁻¹ (x_b − x_p); of the root: as they are
    Args      qpos (T, nq); rate [Hz]; notes : more to say of the file, name -> text
    Raises    UserError: pygltflib is not installed, or a shape cannot be shown
    Test      tests/extras/test_gltf.py::test_second_reader, test_animation
    """
    lib = library()
    m, blob = char.mjspec().compile(), Blob(lib)
    bodies = [b for b in range(1, m.nbody) if m.body_rootid[b] == char.root]
    materials, meshes = {}, {}
    for g in shown(m, char.root):
        meshes.setdefault(int(m.geom_bodyid[g]), {}).setdefault(tuple(map(float, colour(m, g))), []).append(g)
    file = lib.GLTF2(asset=lib.Asset(version="2.0", generator="sparse-retarget", extras=notes or {}))
    turns, places = local_motion(char, qpos, bodies)
    for k, b in enumerate(bodies):
        children = [bodies.index(c) for c in bodies if m.body_parentid[c] == b and c != b]
        node = lib.Node(name=m.body(b).name or f"body{b}", children=children)
        node.rotation, node.translation = xyzw(turns[0, k]).tolist(), to_file(places[0, k]).tolist()
        if b in meshes:
            primitives = []
            for rgba, geoms in meshes[b].items():
                number = materials.setdefault(rgba, len(materials))
                primitives.append(primitive(lib, blob, [shape(m, g) for g in geoms], number))
            node.mesh = len(file.meshes)
            file.meshes.append(lib.Mesh(name=node.name, primitives=primitives))
        file.nodes.append(node)
    file.materials = [material(lib, rgba) for rgba in materials]
    file.animations = [animation(lib, blob, char.name, turns, places, rate)]
    file.scenes, file.scene = [lib.Scene(name=char.name, nodes=[bodies.index(char.root)])], 0
    file.bufferViews, file.accessors = blob.views, blob.accessors
    file.buffers = [lib.Buffer(byteLength=len(blob.data))]
    file.set_binary_blob(bytes(blob.data))
    return b"".join(file.save_to_bytes())


def local_motion(char: Character, qpos, bodies):
    """Turns (T, b, 4), continuous in time, and places (T, b, 3) of bodies in their parents; the root's in the world.

    Test      tests/extras/test_gltf.py::test_animation"""
    fk = forward_kinematics(char, qpos)
    turns, places = fk.xquat[:, bodies].copy(), fk.xpos[:, bodies].copy()
    for k, b in enumerate(bodies):
        if b != char.root:
            p = char.model.body_parentid[b]
            back = quat_conj(fk.xquat[:, p])
            turns[:, k] = quat_mul(back, fk.xquat[:, b])
            places[:, k] = quat_rotate(back, fk.xpos[:, b] - fk.xpos[:, p])
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    return quat_continuous(np.clip(turns, -1.0, 1.0)), places  # glTF refuses a number a rounding beyond 1


def primitive(lib, blob: Blob, surfaces, number: int):
    """Surfaces of one material as one list of triangles."""
    points, normals, triangles = zip(*surfaces, strict=True)
    first = np.cumsum([0, *map(len, points)])
    triangles = np.concatenate([t + f for t, f in zip(triangles, first)])
    position = blob.add(to_file(np.concatenate(points)), "VEC3", VERTICES, bounds=True)
    normal = blob.add(to_file(np.concatenate(normals)), "VEC3", VERTICES)
    indices = blob.add(triangles.ravel(), "SCALAR", INDICES)
    return lib.Primitive(
        attributes=lib.Attributes(POSITION=position, NORMAL=normal), indices=indices, material=number, mode=4
    )


def material(lib, rgba):
    """Matt, in a geom's colour."""
    look = lib.PbrMetallicRoughness(
        baseColorFactor=[*linear(rgba[:3]).tolist(), float(rgba[3])], metallicFactor=0.0, roughnessFactor=ROUGHNESS
    )
    return lib.Material(pbrMetallicRoughness=look, alphaMode="OPAQUE" if rgba[3] >= 1.0 else "BLEND")


def animation(lib, blob: Blob, name: str, turns, places, rate):
    """All turns, and the places that change: the root's, and of bodies whose hinge is beside their origin."""
    times = blob.add(np.arange(len(turns)) / rate, "SCALAR", bounds=True)
    samplers, channels = [], []
    for k in range(turns.shape[1]):
        tracks = [("rotation", xyzw(turns[:, k]), "VEC4")]
        if np.ptp(places[:, k], axis=0).max() > 1e-9:
            tracks.append(("translation", to_file(places[:, k]), "VEC3"))
        for path, values, kind in tracks:
            target = lib.AnimationChannelTarget(node=k, path=path)
            channels.append(lib.AnimationChannel(sampler=len(samplers), target=target))
            samplers.append(lib.AnimationSampler(input=times, output=blob.add(values, kind), interpolation="LINEAR"))
    return lib.Animation(name=name, samplers=samplers, channels=channels)


# ------------------------------------------------------------------------------------ command line


def recorded(char: Character, policy, path, meta, opt: Options):
    """What the policy does on the motion or under the headset that the options name.  -> qpos (T, nq)

    Raises    UserError: the motion or the stream cannot be read, or the policy does not fit
    Test      tests/extras/test_gltf.py::test_command_line"""
    if opt.stream:
        seen = []

        def see(player, tick):
            seen.append(player.qpos[0].copy())
            return len(seen) < play.KEPT * CONTROL_RATE

        play.follow(char, policy, path, devices_of(meta, path, opt.sensors), opt, see)
        if not seen:
            raise UserError(f"{opt.stream}: ends with the second that calibrates; give a longer one")
        return np.stack(seen)
    ref = play.sequence_of(char, opt)
    seen = shown_to(meta, path, ref, opt.sensors)
    check_fits(policy, Env(char, seen, 1), path)
    horizon = max(1, round(opt.seconds * CONTROL_RATE) if opt.seconds else len(ref) - 1)
    recording = simulate(char, seen, policy_action(policy), horizon, opt.threads)[0]
    print(play.told_life(ref.names[0], recording))
    return recording.qpos


def main(argv=None) -> None:
    """python -m extras.gltf: write a character and its motion.  Test: tests/extras/test_gltf.py::test_command_line"""
    opt = cli(Options, argv, "python -m extras.gltf", __doc__)
    play.check_source(opt, argv)
    library()
    policy, path, meta = find_policy(opt)
    char = load_character(opt, meta, path)
    out = Path(opt.out or f"{char.name}.glb")
    if out.suffix.lower() != ".glb":
        raise UserError(f"--out {out}: is written as .glb; give a name that ends so")
    check_folders(out, read=(*mocap.data.parts(opt.motion), opt.stream, path))
    qpos = recorded(char, policy, path, meta, opt)
    notes = {"character": char.name, "policy": Path(path).name, "licence": str(meta.get("licence", "not said"))}
    data = gltf_of(char, qpos, CONTROL_RATE, notes)
    atomic_write(out, data)
    size = f"{char.model.nbody - 1} bodies, {(len(qpos) - 1) / CONTROL_RATE:.1f} s, {len(data) / 1e6:.1f} MB"
    print(f"{out}: {size}; policy: {notes['licence']}")


if __name__ == "__main__":
    run_main(main)

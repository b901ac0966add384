"""DROP's takes as pictures: capsules for bodies, arrows for forces, a contact sheet, a video.

Red arrows are forces from outside, blue ones the contact forces of [DROP Eq. 11].
"""

from __future__ import annotations

import mujoco
import numpy as np

from drop import body
from drop.body import RADII, STEP, J, N
from mocap.data import parts
from plumbing import render
from plumbing.files import check_folders

WORLD = """<mujoco><visual><map zfar="60"/>
<headlight ambient=".35 .35 .35" diffuse=".4 .4 .4" specular="0 0 0"/></visual>
<asset><texture name="t" type="2d" builtin="checker" rgb1=".82 .84 .86" rgb2=".70 .73 .76" width="200" height="200"/>
<material name="m" texture="t" texrepeat="1 1" texuniform="true"/>
<texture type="skybox" builtin="gradient" rgb1=".95 .97 1" rgb2=".75 .82 .9" width="64" height="64"/></asset>
<worldbody><body name="floor" mocap="true"><geom type="plane" size="40 40 .1" material="m"/></body>
<body name="light" mocap="true"><light pos="2 -2 6" dir="-.3 .3 -1" directional="true" diffuse=".5 .5 .5"/></body>
</worldbody></mujoco>"""
COLOURS = ((0.25, 0.5, 0.85, 1.0), (0.85, 0.5, 0.25, 1.0))


def body_shapes(x, rgba):
    """Capsules and a head for one character (22, 3).  Test: tests/drop/test_drop_demos.py::test_shapes_and_arrows"""
    dark = tuple(0.6 * np.array(rgba[:3])) + (1.0,)
    shapes = []
    for j in range(1, N):
        side = body.JOINTS[j].endswith("_r")
        radius = min(RADII[j], RADII[body.PARENTS[j]], 0.075) * 0.8
        shapes.append(render.Bone(x[body.PARENTS[j]], x[j], dark if side else rgba, radius))
    return shapes + [render.Marker(x[J["head"]] + [0, 0, 0.02], None, rgba, 0.1)]


def arrow(place, vector, rgba, scale=0.005, longest=0.8, leaves=False):
    """A force as an arrow that ends at `place`; or that leaves it, as a floor's does, which would be hidden below.

    Test: tests/drop/test_drop_demos.py::test_shapes_and_arrows, ::test_contact_forces_are_drawn_above_the_floor"""
    v = scale * np.asarray(vector)
    v = v * min(1.0, longest / max(np.linalg.norm(v), 1e-9))
    if np.linalg.norm(v) < 0.02:
        return []
    place = place + v if leaves else place
    return [
        render.Bone(place - v, place - 0.12 * v, rgba, 0.012),
        render.Bone(place - 0.2 * v, place - 0.1 * v, rgba, 0.03),
    ]


def contact_arrows(found):
    """An Outcome's contact forces.

    Test      tests/drop/test_drop_demos.py::test_contact_forces_are_drawn_above_the_floor"""
    arrows = (arrow(p, f, (0.1, 0.2, 0.9, 1.0), 0.002, leaves=True) for p, f in zip(found.points, found.forces))
    return [shape for shapes in arrows for shape in shapes]


def draw(scene, data, take, t):
    """One frame of a take (H, W, 3)."""
    floor = take.floor[t]
    turn = np.cross([0, 0, 1.0], floor.normal)
    data.mocap_quat[0] = np.append(1.0 + floor.normal[2], turn) / np.linalg.norm(np.append(1.0 + floor.normal[2], turn))
    centre = np.mean([s.com for s in take.states[t]], axis=0)
    data.mocap_pos[:] = floor.offset * floor.normal, centre * [1, 1, 0]  # the light goes along, or shadows end
    mujoco.mj_forward(scene.model, data)
    shapes = []
    for k, (state, found) in enumerate(zip(take.states[t], take.outcomes[t])):
        shapes += body_shapes(state.x, COLOURS[k % 2])
        shapes += contact_arrows(found)
    for p, f in take.arrows[t]:
        shapes += arrow(p, f, (0.9, 0.1, 0.1, 1.0), 0.008)
    shapes += [
        render.Marker(p, None, rgba, radius) for p, radius, rgba in take.balls[t] if np.abs(p - centre).max() < 8
    ]
    camera = mujoco.MjvCamera()
    ground = (floor.offset - floor.normal[:2] @ centre[:2]) / floor.normal[2]
    camera.lookat[:] = [centre[0], centre[1], 0.8 + ground]
    apart = max(np.linalg.norm(s.com - centre) for s in take.states[t])
    camera.distance, camera.azimuth, camera.elevation = (4.0 if apart else 3.2) + 2.0 * apart, 130, -14
    return scene.frame(data, camera, shapes)


def write_pictures(takes, opt, columns=9):
    """The contact sheet, a row a take, and the video, one take after the other."""
    model = mujoco.MjModel.from_xml_string(WORLD)
    data = mujoco.MjData(model)
    if opt.png:
        scene = render.Scene(model, 240, 300, camera=mujoco.MjvCamera(), fast=True)
        scene.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = True  # they show which foot stands
        frames, labels = [], []
        for take in takes:
            shown = np.linspace(*(take.window or (0, len(take.states) - 1)), columns).round().astype(int)
            for t in shown:
                frames.append(draw(scene, data, take, t))
                labels.append(f"{t * STEP:.1f} s {take.name if t == shown[0] else ''}")
        render.write_png(
            opt.png, render.contact_sheet([render.label_image(f, s, 1) for f, s in zip(frames, labels)], None, columns)
        )
        print(opt.png)
        scene.close()
    if opt.video:
        scene = render.Scene(model, 640, 480, camera=mujoco.MjvCamera())
        every = (
            render.label_image(draw(scene, data, take, t), take.name) for take in takes for t in range(len(take.states))
        )
        render.write_video(opt.video, every, fps=round(1 / STEP))
        print(opt.video)


def check_outputs(opt):
    """Can the pictures be written, and do they destroy nothing that is read?  Before the slow work.

    Test: tests/drop/test_drop_demos.py::test_outputs_are_checked_first"""
    check_folders(opt.png, opt.video, read=(*parts(opt.motion), opt.weights))
    render.check_video(opt.video)

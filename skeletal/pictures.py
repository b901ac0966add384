"""Stick figures of motions: contact sheets and videos, result over truth."""

from __future__ import annotations

import mujoco
import numpy as np

from plumbing import render
from skeletal import data

FLOOR = """<mujoco><visual><headlight ambient=".5 .5 .5"/></visual><asset><texture name="sky" type="skybox"
builtin="gradient" rgb1=".42 .66 .90" rgb2=".93 .96 .98" width="64" height="384"/><texture name="g" type="2d"
builtin="checker" rgb1=".85 .87 .9" rgb2=".75 .78 .82" width="256" height="256"/><material name="g" texture="g"
texrepeat="1 1" texuniform="true"/></asset><worldbody><light pos="0 0 5" dir="0 0 -1" directional="true"/><geom
type="plane" size="60 60 .1" material="g"/></worldbody></mujoco>"""
COLOURS = {"blue": (0.2, 0.45, 0.85, 1), "orange": (0.95, 0.45, 0.1, 1), "grey": (0.35, 0.35, 0.35, 1)}
LANE = 1.0  # legs between two figures side by side


def draw(motions, labels, png=None, video=None, every=0.5, lanes=None):
    """Figures side by side or over one another, each with legs of 1 m, followed by the camera.

    Args      motions : Motions; labels : one each, drawn with its colour's name; png, video : files to write, or None
              every : seconds between the pictures of a sheet; lanes : place of each motion across the walk; two of one
              lane lie over one another (default: each its own)
    Test      tests/skeletal/test_skeletal_play.py::test_sheets
    """
    lanes = list(range(len(motions))) if lanes is None else lanes
    model = mujoco.MjModel.from_xml_string(FLOOR)
    physics = mujoco.MjData(model)
    mujoco.mj_forward(model, physics)
    across, poses = max(lanes) + 1, []
    for m, lane in zip(motions, lanes):
        p = data.pose(m)[0]
        p = (p - [*p[0, 0, :2], np.percentile(p[..., 2].min(axis=1), 5)]) / m.skeleton.leg
        place = p[:, :1] * [1.0, 1.0, 0.0]
        p = p - place + [0.0, LANE * (lane - 0.5 * (across - 1)), 0.0]  # every figure walks on its own spot
        poses.append(p)
    count = min(map(len, poses))
    height = max(p[..., 2].max() for p in poses)
    scene = render.Scene(model, 320 * across, 400, _camera(height), fast=True)

    def frame(t):
        marks = []
        for k, (p, m, c) in enumerate(zip(poses, motions, COLOURS.values())):
            marks += render.stick_figure(p[t], m.skeleton.parents, c, 0.028 - 0.006 * k)
        return scene.frame(physics, _camera(height), marks)

    if png:
        times = range(0, count, max(round(every * data.RATE), 1))
        key = ", ".join(f"{c}: {text}" for text, c in zip(labels, COLOURS))
        text = [f"{t / data.RATE:.1f} s  {key}" for t in times]
        render.write_png(png, render.contact_sheet([frame(t) for t in times], text, 4))
    if video:
        render.write_video(video, (frame(t) for t in range(count)), round(data.RATE))
    scene.close()


def _camera(height):
    """From the side ahead, so near that the tallest figure fills the cell."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.0, 0.0, 0.5 * height]
    camera.distance, camera.azimuth, camera.elevation = 1.75 * height, 150, -8
    return camera

"""What every picture shares: headless MuJoCo images, markers and skeletons, contact sheets, video, curves.

Images are (H, W, 3) uint8. PNG files need nothing beyond the run-time dependencies; video and plots need the extra
`view`. Positions are in the world frame [m], quaternions w, x, y, z.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import os
import subprocess
import sys
import weakref
import zlib
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from plumbing.cli import UserError
from plumbing.files import atomic_path, atomic_write
from plumbing.runs import read_metrics

# ---- OpenGL without a display ---------------------------------------------------------------------------------------

_PROBE = "import sys, importlib as i; c = i.import_module('mujoco.' + sys.argv[1]).GLContext(8, 8); c.make_current()"


ADVICE = "install Debian's libegl1 and libgl1-mesa-dri, or libosmesa6, and set MUJOCO_GL to egl or osmesa"


def gl_backend():
    """The OpenGL back end to use: MUJOCO_GL if set, glfw with a display, else egl or osmesa; None if neither starts.

    PyOpenGL can load only one of the two in a process, so each is tried in a process of its own (about a second).

    Test      tests/plumbing/test_render.py::test_backend_is_chosen
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if chosen:
        return chosen if chosen in ("egl", "osmesa", "glfw") else "glfw"
    if os.environ.get("DISPLAY") or sys.platform != "linux":
        return "glfw"
    for name in ("egl", "osmesa"):
        if subprocess.run([sys.executable, "-c", _PROBE, name], capture_output=True).returncode == 0:
            return name
    return None


def _gl_context(width, height):
    name = gl_backend()
    if name is None:
        raise UserError(f"no picture without OpenGL, and neither egl nor osmesa starts: {ADVICE}")
    try:
        os.environ.setdefault("MUJOCO_GL", name)
        context = importlib.import_module("mujoco." + name).GLContext(width, height)
        context.make_current()
        return context
    except Exception as error:  # the back ends raise many kinds
        raise UserError(f"OpenGL back end {name} does not start ({type(error).__name__}: {error}): {ADVICE}") from None


# ---- the scene ------------------------------------------------------------------------------------------------------


class Marker(NamedTuple):
    """A shape drawn beside the character: a sphere, or with `quat` a box and its x, y, z axes in red, green, blue."""

    pos: np.ndarray  # (3,) [m]
    quat: np.ndarray | None = None  # (4,) w, x, y, z
    rgba: tuple = (0.9, 0.5, 0.1, 1.0)
    size: float | tuple = 0.04  # radius, or half sizes of the box [m]


class Bone(NamedTuple):
    """A capsule from `start` to `end`."""

    start: np.ndarray  # (3,) [m]
    end: np.ndarray  # (3,) [m]
    rgba: tuple = (0.3, 0.6, 0.9, 1.0)
    radius: float = 0.02  # [m]


def device_markers(pos, quat, rgba=(0.15, 0.15, 0.2, 1.0)):
    """Markers of the tracked devices: the first is the headset, the others are controllers.

    Args      pos : (D, 3) [m] world; quat : (D, 4) w, x, y, z; rgba : colour
    Returns   list of Marker
    Test      tests/plumbing/test_render.py::test_markers_are_drawn
    """
    sizes = [(0.05, 0.09, 0.05)] + [(0.06, 0.03, 0.03)] * (len(pos) - 1)
    return [Marker(p, q, rgba, size) for p, q, size in zip(pos, quat, sizes, strict=True)]


def stick_figure(positions, parents, rgba=(0.3, 0.6, 0.9, 1.0), radius=0.02):
    """A skeleton as markers: a bone from each joint to its parent and a ball at each joint.

    Args      positions : (J, 3) [m] world; parents : (J,) parent index, negative for a root
              rgba : colour; radius : of the bones [m]
    Returns   list of Bone and Marker, for Scene.frame
    Raises    ValueError: the lengths differ, or a parent is no joint
    Test      tests/plumbing/test_render.py::test_stick_figure
    """
    positions = np.asarray(positions, float)
    if positions.shape != (len(parents), 3) or any(p >= len(parents) for p in parents):
        raise ValueError(f"positions {positions.shape} do not fit {len(parents)} parents: they are (J, 3) and below J")
    bones = [Bone(positions[p], positions[j], rgba, radius) for j, p in enumerate(parents) if p >= 0]
    return bones + [Marker(p, None, rgba, 1.3 * radius) for p in positions]


class Scene:
    """Pictures of one model without a window.

    Collision geoms (group 3) are hidden. The model is copied, so its own visual settings stay as they are.

    Args      model : MjModel; width, height : pixels
              camera : name of a camera of the model, or an MjvCamera; "track" follows the first body when the model
                  has no camera of that name
              fast : without shadows and smoothed edges, several times faster where OpenGL runs on the CPU
    Raises    UserError: no such camera, or no OpenGL
    Test      tests/plumbing/test_render.py::test_frame, test_markers_are_drawn
    """

    def __init__(self, model, width=640, height=480, camera="track", fast=False):
        self.model = copy.copy(model)
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
        if fast:
            self.model.vis.quality.offsamples = 0
        self.width, self.height, self.camera = width, height, self._camera(camera)
        self.option = mujoco.MjvOption()
        self.option.geomgroup[3] = 0
        self.gl = _gl_context(width, height)
        self.scene = mujoco.MjvScene(self.model, maxgeom=10_000)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = not fast
        try:
            self.context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        except mujoco.FatalError as error:  # glfw without a display gives a context that draws nothing
            raise UserError(f"OpenGL back end {gl_backend()} does not start ({error}): {ADVICE}") from None
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        self.close = weakref.finalize(self, _release, self.gl, self.context)

    def frame(self, data, camera=None, markers=()):
        """One picture.

        Args      data : MjData, after mj_forward; camera : as in the constructor, or None for that one
                  markers : Marker and Bone, or plain tuples (pos, quat or None, rgba, size)
        Returns   (H, W, 3) uint8
        Raises    ValueError: a marker is not finite, or the scene is full
        """
        camera = self.camera if camera is None else self._camera(camera)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, data, self.option, None, camera, everything, self.scene)
        for marker in markers:
            self._draw(marker if isinstance(marker, Bone) else Marker(*marker))
        image, area = np.empty((self.height, self.width, 3), np.uint8), mujoco.MjrRect(0, 0, self.width, self.height)
        self.gl.make_current()
        mujoco.mjr_render(area, self.scene, self.context)
        mujoco.mjr_readPixels(image, None, area, self.context)
        return np.flipud(image).copy()  # OpenGL counts rows from the bottom

    def _camera(self, camera):
        if isinstance(camera, mujoco.MjvCamera):
            return camera
        found = mujoco.MjvCamera()
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if number >= 0:
            found.type, found.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, number
        elif camera == "track" and self.model.nbody > 1:
            found.type, found.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
            found.distance, found.azimuth, found.elevation = 3.5, 135, -15
        else:
            names = dict.fromkeys(["track", *(self.model.camera(i).name for i in range(self.model.ncam))])
            raise UserError(f"the model has no camera {camera!r}; valid: {', '.join(names)}")
        return found

    def _draw(self, marker):
        if isinstance(marker, Bone):
            self._capsule(*marker)
        elif marker.quat is None:
            self._add(mujoco.mjtGeom.mjGEOM_SPHERE, marker.pos, np.eye(3), np.full(3, marker.size), marker.rgba)
        else:
            turn, size = np.empty(9), np.broadcast_to(marker.size, 3).astype(float)
            mujoco.mju_quat2Mat(turn, np.asarray(marker.quat, float))
            turn = turn.reshape(3, 3)
            self._add(mujoco.mjtGeom.mjGEOM_BOX, marker.pos, turn, size, marker.rgba)
            for axis, colour in zip(turn.T, np.eye(3), strict=True):
                end = np.asarray(marker.pos) + 2.5 * size.max() * axis
                self._capsule(marker.pos, end, (*colour, 1.0), 0.15 * size.max())

    def _add(self, kind, pos, turn, size, rgba):
        if not (np.isfinite(pos).all() and np.isfinite(turn).all()):
            raise ValueError(f"marker at {pos} is not finite")
        if self.scene.ngeom >= self.scene.maxgeom:
            raise ValueError(f"the scene is full: {self.scene.maxgeom} shapes at most")
        geom = self.scene.geoms[self.scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, np.asarray(pos, float), turn.ravel(), np.asarray(rgba, np.float32))
        self.scene.ngeom += 1
        return geom

    def _capsule(self, start, end, rgba, radius):
        geom = self._add(mujoco.mjtGeom.mjGEOM_CAPSULE, start, np.eye(3), np.full(3, radius), rgba)
        mujoco.mjv_connector(
            geom, mujoco.mjtGeom.mjGEOM_CAPSULE, radius, np.asarray(start, float), np.asarray(end, float)
        )


def _release(gl, context):
    gl.make_current()
    context.free()
    gl.free()


# ---- images ---------------------------------------------------------------------------------------------------------

# A 5x7 font: seven rows per character, each row five bits as two hex digits.
GLYPHS = """\
0 0e11131519110e|1 040c040404040e|2 0e11010204081f|3 1f02040201110e|4 02060a121f0202|5 1f101e0101110e|6 0608101e11110e
7 1f010204080808|8 0e11110e11110e|9 0e11110f01020c|A 0e11111f111111|B 1e11111e11111e|C 0e11101010110e|D 1c12111111121c
E 1f10101e10101f|F 1f10101e101010|G 0e11101711110f|H 1111111f111111|I 0e04040404040e|J 0702020202120c|K 11121418141211
L 1010101010101f|M 111b1515111111|N 11111915131111|O 0e11111111110e|P 1e11111e101010|Q 0e11111115120d|R 1e11111e141211
S 0f10100e01011e|T 1f040404040404|U 1111111111110e|V 11111111110a04|W 1111111515150a|X 11110a040a1111|Y 1111110a040404
Z 1f01020408101f|. 00000000000c0c|, 000000000c0408|: 000c0c000c0c00|- 0000001f000000|+ 0004041f040400|/ 00010204081000
% 18190204081303|= 00001f001f0000|( 02040808080402|) 08040202020408|_ 0000000000001f|' 0c040800000000|? 0e110102040004
[ 0e08080808080e|] 0e02020202020e|; 000c0c000c0408|* 00150e1f0e1500
"""
FONT = dict(glyph.split(" ") for glyph in GLYPHS.strip().replace("\n", "|").split("|")) | {" ": "00" * 7}


def text_mask(text, scale=2):
    """A line of text as pixels, letters in capitals; characters outside FONT become "?".

    Returns   (7 scale, 6 scale len(text)) bool
    Test      tests/plumbing/test_render.py::test_text
    """
    rows = np.zeros((7, 6 * len(text)), bool)
    for i, letter in enumerate(text.upper()):
        glyph = np.frombuffer(bytes.fromhex(FONT.get(letter, FONT["?"])), np.uint8)
        rows[:, 6 * i : 6 * i + 5] = np.unpackbits(glyph[:, None], axis=1)[:, 3:]
    return rows.repeat(scale, 0).repeat(scale, 1)


def label_image(image, text, scale=2):
    """A copy of `image` with white text on a dark band along its top; what does not fit is cut."""
    image, mask = image.copy(), text_mask(text, scale)[:, : max(image.shape[1] - 2 * scale, 0)]
    band = image[: 9 * scale]
    band //= 4
    band[scale : scale + len(mask), scale : scale + mask.shape[1]][mask[: max(len(band) - scale, 0)]] = 255
    return image


def hstack(images):
    """Images side by side; a lower one gets white below."""
    tall = max(len(image) for image in images)
    return np.hstack([np.pad(i, ((0, tall - len(i)), (0, 0), (0, 0)), constant_values=255) for i in images])


def contact_sheet(frames, labels=None, columns=4):
    """Frames in rows of `columns`, each with its label; empty places are white.

    Args      frames : list of (H, W, 3) uint8 of one size; labels : list of str or None; columns : int
    Returns   (R H, C W, 3) uint8
    Raises    ValueError: no frame, several sizes, or another number of labels
    Test      tests/plumbing/test_render.py::test_contact_sheet
    """
    if not len(frames) or len({np.shape(frame) for frame in frames}) > 1 or columns < 1:
        raise ValueError("a contact sheet needs one frame or more, all of one size, and one column or more")
    if labels is not None:
        frames = [label_image(frame, str(text)) for frame, text in zip(frames, labels, strict=True)]
    columns = min(columns, len(frames))
    blank = np.full_like(frames[0], 255)
    frames = list(frames) + [blank] * (-len(frames) % columns)
    return np.vstack([np.hstack(frames[i : i + columns]) for i in range(0, len(frames), columns)])


# ---- files ----------------------------------------------------------------------------------------------------------


def png_bytes(image):
    """An image as a PNG file's bytes.

    Args      image : (H, W, 3) colour or (H, W) grey, uint8
    Raises    ValueError: another shape or type
    Test      tests/plumbing/test_render.py::test_png_decodes_to_the_image
    """
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.ndim == 3 and image.shape[2] != 3 or not image.size:
        raise ValueError(f"a PNG needs (H, W, 3) or (H, W) uint8, not {image.shape} {image.dtype}")
    height, width = image.shape[:2]
    rows = np.zeros((height, 1 + image[0].size), np.uint8)  # each row starts with its filter, 0: none
    rows[:, 1:] = image.reshape(height, -1)

    def chunk(kind, body):
        return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 2 if image.ndim == 3 else 0, 0, 0, 0])
    body = zlib.compress(rows.tobytes(), 6)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def write_png(path, image):
    """Write an image as PNG, whole or not at all."""
    atomic_write(path, png_bytes(image))


def extra(name):
    """Import a module of the extra `view`."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(f"{name} is not installed: python -m pip install -e '.[view]'") from None


def check_video(path):
    """Before the slow work: can a video be written, by its name and the extra `view`?  path None: none is asked for

    Returns   the module that writes it
    Raises    UserError: another suffix, or the extra `view` is missing
    Test      tests/plumbing/test_render.py::test_video_is_checked_first
    """
    if path is None:
        return None
    if Path(path).suffix != ".mp4":
        raise UserError(f"cannot write video {path}: valid names end in .mp4")
    extra("imageio_ffmpeg")
    return extra("imageio.v2")


def write_video(path, frames, fps=36):
    """Write an .mp4, whole or not at all.

    Args      path : file ending in .mp4; frames : iterable of (H, W, 3) uint8, one size; fps : frames per second
    Raises    UserError: another suffix, no frame, the extra `view` is missing, or the folder cannot be written
    Test      tests/plumbing/test_render.py::test_video
    """
    imageio = check_video(path)
    if not Path(path).absolute().parent.is_dir():
        raise UserError(f"cannot write {path}: give a folder that exists and is writable")
    count = 0
    with atomic_path(path) as temporary:
        writer = imageio.get_writer(temporary, fps=fps, codec="libx264", quality=7, macro_block_size=1)
        with contextlib.closing(writer):  # unlike `with writer`, this also ends ffmpeg after an exception
            for frame in frames:
                writer.append_data(frame[: len(frame) // 2 * 2, : frame.shape[1] // 2 * 2])  # H.264 wants even sizes
                count += 1
        if not count:
            raise UserError(f"no frame for {path}: the motion is empty")


def plot_curves(path, files, keys, x="steps", labels=None):
    """Plot columns of several metrics.csv files, one panel per column and one line per file.

    Args      path : .png, .pdf or .svg; files : metrics.csv of each run; keys : column names; x : column across
              labels : one per file; by default the run folder's name
    Raises    UserError: a column is missing, or the extra `view` is
    Test      tests/plumbing/test_render.py::test_plot_curves
    """
    kind = Path(path).suffix[1:]
    if kind not in ("png", "pdf", "svg"):
        raise UserError(f"cannot write plot {path}: valid names end in .png, .pdf or .svg")
    extra("matplotlib")
    figure = extra("matplotlib.figure").Figure(figsize=(4.5 * len(keys), 3.2), layout="constrained")
    panels = figure.subplots(1, len(keys), squeeze=False)[0]
    for file, label in zip(files, labels or [Path(f).absolute().parent.name for f in files], strict=True):
        table = read_metrics(file)
        missing = [name for name in (x, *keys) if name not in table]
        if missing:
            raise UserError(f"{file} has no column {', '.join(missing)}; valid: {', '.join(table)}")
        for panel, key in zip(panels, keys, strict=True):
            panel.plot(table[x], table[key], label=label)
            panel.set(xlabel=x, title=key)
    panels[0].legend()
    atomic_write(path, lambda file: figure.savefig(file, format=kind, dpi=120))

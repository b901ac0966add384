"""Pictures: what is drawn is seen, files hold the image, and missing parts are named."""

import os
import subprocess
import sys
import zlib
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from plumbing import render, runs
from plumbing.cli import UserError

ROOT = Path(__file__).resolve().parents[2]
XML = """
<mujoco>
  <worldbody>
    <light pos="0 0 4"/>
    <camera name="front" pos="3 0 1" xyaxes="0 1 0 0 0 1"/>
    <body name="root" pos="0 0 1">
      <freejoint/>
      <geom size="0.2" rgba="1 0 0 1"/>
      <geom type="box" size="0.6 0.6 0.6" rgba="0 1 0 1" group="3"/>
    </body>
  </worldbody>
</mujoco>
"""
needs_gl = pytest.mark.skipif(render.gl_backend() is None, reason="no OpenGL: neither egl nor osmesa starts here")


@pytest.fixture(scope="module")
def stage():
    """A scene of 160x120 pixels seen from +x, so y points right and z up in the image; and its data."""
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = render.Scene(model, 160, 120, "front")
    yield scene, data
    scene.close()


def where(image, channel):
    """Rows and columns in which one colour channel is well above the others."""
    image = image.astype(int)
    return np.nonzero(image[..., channel] > 40 + np.delete(image, channel, -1).max(-1))


@needs_gl
def test_frame(stage):
    scene, data = stage
    image = scene.frame(data)
    assert image.shape == (120, 160, 3) and image.dtype == np.uint8
    rows, columns = where(image, 0)
    assert len(rows) > 50 and abs(rows.mean() - 59.5) < 3 and abs(columns.mean() - 79.5) < 3
    assert len(where(image, 1)[0]) == 0  # the collision box, group 3, is hidden
    np.testing.assert_array_equal(image, scene.frame(data))
    data.qpos[2] += 0.5
    mujoco.mj_forward(scene.model, data)
    assert where(scene.frame(data), 0)[0].mean() < 45  # up in the world is up in the image
    followed = where(scene.frame(data, "track"), 0)
    assert abs(followed[0].mean() - 59.5) < 3 and abs(followed[1].mean() - 79.5) < 3
    data.qpos[2] -= 0.5
    mujoco.mj_forward(scene.model, data)


@needs_gl
def test_markers_are_drawn(stage):
    scene, data = stage
    before = scene.frame(data)
    image = scene.frame(data, markers=[([0, 0.6, 1.3], None, (0, 0, 1, 1), 0.1)])
    rows, columns = where(image, 2)
    assert len(rows) > 20 and rows.mean() < 55 and columns.mean() > 85
    # A box turned 90 degrees about x: its y axis, green, points up.
    turn = (np.sqrt(0.5), np.sqrt(0.5), 0, 0)
    image = scene.frame(data, markers=[render.Marker([0.5, -0.5, 1.0], turn, (0.5, 0.5, 0.5, 1), 0.1)])
    rows, columns = where(image, 1)
    assert len(rows) > 5 and np.ptp(rows) > 2 * np.ptp(columns) and rows.max() < 58 and columns.mean() < 75
    three = render.device_markers(np.array([[0, 0, 1.6], [0, 0.5, 1], [0, -0.5, 1]]), np.eye(4)[[0, 0, 0]])
    assert (scene.frame(data, markers=three) != before).any()
    np.testing.assert_array_equal(before, scene.frame(data))  # markers do not stay
    with pytest.raises(ValueError, match="not finite"):
        scene.frame(data, markers=[([0, np.nan, 0], None, (0, 0, 1, 1), 0.1)])
    with pytest.raises(ValueError, match="full"):
        scene.frame(data, markers=[([0, 0, 0], None, (0, 0, 1, 1), 0.1)] * 10_001)


@needs_gl
def test_stick_figure(stage):
    scene, data = stage
    positions = [[0, 0.7, 0.6], [0, 0.7, 1.4], [0, 0.9, 1.4]]
    markers = render.stick_figure(positions, [-1, 0, 1], rgba=(0, 0, 1, 1), radius=0.03)
    assert sum(isinstance(m, render.Bone) for m in markers) == 2 and len(markers) == 5
    rows, columns = where(scene.frame(data, markers=markers), 2)
    assert np.ptp(rows) > 30 and columns.min() > 90 and np.ptp(columns) < np.ptp(rows)
    for parents in ([-1, 0], [-1, 0, 5]):
        with pytest.raises(ValueError, match="positions"):
            render.stick_figure(positions, parents)


@needs_gl
def test_scenes_side_by_side_and_large():
    model = mujoco.MjModel.from_xml_string(XML)
    data, other = mujoco.MjData(model), mujoco.MjData(model)
    other.qpos[1] = 0.8
    mujoco.mj_forward(model, data)
    mujoco.mj_forward(model, other)
    small, large = render.Scene(model, 64, 48, "front"), render.Scene(model, 1280, 720)  # above MuJoCo's 640x480
    first = small.frame(data)
    assert large.frame(other).shape == (720, 1280, 3)
    np.testing.assert_array_equal(small.frame(data), first)
    fast = render.Scene(model, 64, 48, "front", fast=True)
    assert np.abs(fast.frame(data).astype(int) - first).mean() < 3  # the same picture, with rougher edges
    assert model.vis.global_.offwidth == 640  # the caller's model is as it was
    with pytest.raises(UserError, match="'side'; valid: track, front"):
        render.Scene(model, camera="side")
    own = mujoco.MjModel.from_xml_string(XML.replace('name="front"', 'name="track"'))  # our name, too, for its own
    with pytest.raises(UserError, match="'side'; valid: track$"):
        render.Scene(own, camera="side")
    small.close(), large.close(), fast.close()


@needs_gl
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux chooses between egl and osmesa")
def test_backend_is_chosen(tmp_path):
    """Without a display or MUJOCO_GL, and with mujoco imported first, a picture comes out and nothing is complained."""
    code = f"import mujoco; from plumbing import render; m = mujoco.MjModel.from_xml_string('''{XML}''')\n"
    code += "d = mujoco.MjData(m)\n"
    code += "mujoco.mj_forward(m, d); print(render.Scene(m, 64, 48).frame(d).max())"
    clean = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "PYOPENGL_PLATFORM")}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=clean, capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 50, done.stderr
    assert "Exception" not in done.stderr


def test_no_opengl_is_a_clear_error(monkeypatch):
    monkeypatch.setattr(render, "gl_backend", lambda: None)
    with pytest.raises(UserError, match="libegl1.*libosmesa6"):
        render.Scene(mujoco.MjModel.from_xml_string(XML))
    monkeypatch.setattr(render, "gl_backend", lambda: "no_such")
    with pytest.raises(UserError, match="no_such does not start.*libegl1"):
        render.Scene(mujoco.MjModel.from_xml_string(XML))


def test_back_end_that_draws_nothing(monkeypatch):
    """glfw without a display: its context is made, and fails when it is used."""

    def fails(*_):
        raise mujoco.FatalError("no OpenGL platform library")

    monkeypatch.setattr(mujoco, "MjrContext", fails)
    monkeypatch.setattr(render, "_gl_context", lambda *_: None)
    with pytest.raises(UserError, match="does not start .no OpenGL platform library.: install .*libegl1"):
        render.Scene(mujoco.MjModel.from_xml_string(XML))


def decode_png(raw):
    """A second reader: walks the chunks, checks each CRC, and undoes filter 0."""
    assert raw[:8] == b"\x89PNG\r\n\x1a\n"
    at, kinds, body = 8, [], b""
    while at < len(raw):
        size, kind = int.from_bytes(raw[at : at + 4], "big"), raw[at + 4 : at + 8]
        content = raw[at + 8 : at + 8 + size]
        assert zlib.crc32(kind + content) == int.from_bytes(raw[at + 8 + size : at + 12 + size], "big")
        kinds.append(kind)
        if kind == b"IHDR":
            width, height = (int.from_bytes(content[i : i + 4], "big") for i in (0, 4))
            assert content[8] == 8 and content[10:] == b"\0\0\0"
            channels = {2: 3, 0: 1}[content[9]]
        body += content if kind == b"IDAT" else b""
        at += 12 + size
    assert kinds == [b"IHDR", b"IDAT", b"IEND"]
    rows = np.frombuffer(zlib.decompress(body), np.uint8).reshape(height, 1 + width * channels)
    assert (rows[:, 0] == 0).all()
    return rows[:, 1:].reshape((height, width, 3) if channels == 3 else (height, width))


@settings(max_examples=50, deadline=None)
@given(hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)) | st.just((5, 4))))
def test_png_decodes_to_the_image(image):
    np.testing.assert_array_equal(decode_png(render.png_bytes(image)), image)


def test_png_file_read_by_matplotlib(tmp_path):
    read = pytest.importorskip("matplotlib.image", reason="matplotlib (extra view) reads the file back").imread
    image = np.random.default_rng(0).integers(0, 256, (33, 21, 3), dtype=np.uint8)
    render.write_png(tmp_path / "a.png", image[:, ::-1])  # not contiguous
    np.testing.assert_array_equal(np.rint(read(tmp_path / "a.png") * 255), image[:, ::-1])
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize("bad", [np.zeros((2, 2, 3)), np.zeros((2, 2, 4), np.uint8), np.zeros((0, 2, 3), np.uint8)])
def test_png_refuses(bad):
    with pytest.raises(ValueError, match="uint8"):
        render.png_bytes(bad)


def test_text():
    rows = ["".join(".#"[int(pixel)] for pixel in row) for row in render.text_mask("1t", 1)]
    assert rows == [
        "..#...#####.",
        ".##.....#...",
        "..#.....#...",
        "..#.....#...",
        "..#.....#...",
        "..#.....#...",
        ".###....#...",
    ]
    assert render.text_mask("ab", 3).shape == (21, 36)
    np.testing.assert_array_equal(render.text_mask("é"), render.text_mask("?"))
    glyphs = set(render.FONT.values())
    assert len(glyphs) == len(render.FONT) == 54 and all(len(glyph) == 14 for glyph in glyphs)


def test_contact_sheet():
    frames = [np.full((40, 60, 3), 10 * i, np.uint8) for i in range(5)]
    sheet = render.contact_sheet(frames, [f"t {i}" for i in range(5)], columns=3)
    assert sheet.shape == (80, 180, 3)
    for i in range(6):
        tile = sheet[40 * (i // 3) :, 60 * (i % 3) :][:40, :60]
        assert (tile[20:] == (10 * i if i < 5 else 255)).all()
        assert i == 5 or (tile[:20] == 255).any() and not (tile[:20] == 255).all()
    assert (frames[1] == 10).all()  # the frames are not drawn on
    np.testing.assert_array_equal(render.contact_sheet(frames[:1]), frames[0])
    render.label_image(np.zeros((5, 3, 3), np.uint8), "longer than the image")
    for bad, labels in (([], None), ([frames[0], frames[1][1:]], None), (frames, ["one"])):
        with pytest.raises(ValueError):
            render.contact_sheet(bad, labels)


def test_hstack():
    image = render.hstack([np.zeros((4, 2, 3), np.uint8), np.ones((3, 5, 3), np.uint8)])
    assert image.shape == (4, 7, 3) and (image[3, 2:] == 255).all() and (image[:3, 2:] == 1).all()


def test_video(tmp_path):
    imageio = pytest.importorskip("imageio.v2", reason="imageio (extra view) writes video")
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg (extra view) writes video")
    path = tmp_path / "a.mp4"
    render.write_video(path, (np.full((49, 65, 3), 20 * i, np.uint8) for i in range(10)), fps=36)
    with imageio.get_reader(path) as video:
        frames = [frame for frame in video]
        assert len(frames) == 10 and frames[0].shape == (48, 64, 3) and video.get_meta_data()["fps"] == 36
    assert [abs(frame.mean() - 20 * i) < 6 for i, frame in enumerate(frames)] == [True] * 10
    before = path.read_bytes()

    def breaks():
        yield np.zeros((48, 64, 3), np.uint8)
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError):
        render.write_video(path, breaks())
    with pytest.raises(UserError, match="empty"):
        render.write_video(path, [])
    with pytest.raises(UserError, match="nowhere"):
        render.write_video(tmp_path / "nowhere" / "a.mp4", [])
    with pytest.raises(UserError, match=".mp4"):
        render.write_video(tmp_path / "a.xyz", [])
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("name", ["imageio_ffmpeg", "imageio.v2", "matplotlib"])
def test_missing_extra_is_named(name, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[view\]'"):
        if name == "matplotlib":
            render.plot_curves(tmp_path / "a.png", [], ["reward"])
        else:
            pytest.importorskip("imageio_ffmpeg") if name == "imageio.v2" else None
            render.write_video(tmp_path / "a.mp4", [])


def test_video_is_checked_first(monkeypatch, tmp_path):
    assert render.check_video(None) is None
    with pytest.raises(UserError, match="valid names end in .mp4"):
        render.check_video(tmp_path / "a.avi")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[view\]'"):
        render.check_video(tmp_path / "a.mp4")


def test_plot_curves(tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib (extra view) draws curves")
    files = []
    for seed in range(2):
        folder = tmp_path / f"seed_{seed}"
        folder.mkdir()
        metrics = runs.Metrics(folder / "metrics.csv")
        for i in range(4):
            metrics.append({"steps": 100 * i, "reward": seed + i / 4})
        metrics.close()
        files.append(metrics.path)
    render.plot_curves(tmp_path / "curve.png", files, ["reward"])
    assert (tmp_path / "curve.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(UserError, match="no column loss; valid: steps, reward"):
        render.plot_curves(tmp_path / "curve.png", files, ["loss"])
    with pytest.raises(UserError, match="valid.*png"):
        render.plot_curves(tmp_path / "curve.xyz", files, ["reward"])

"""What the page is given: exported characters, the demonstration, the server.  `npm test` in web/ does the rest."""

import json
import re
import socket
import threading
import urllib.error
import urllib.request
import zlib
from pathlib import Path

import mujoco
import numpy as np
import pytest

import character
from headset.calibration import Stream
from headset.reader import Reader, to_world
from human import heading, quat_angle, sensors
from plumbing.cli import UserError, run_main
from web import __main__ as commands
from web import export, serve
from web.export import load_policy

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Everything exported once."""
    out = tmp_path_factory.mktemp("data")
    export.main(["--out", str(out)])
    return out


@pytest.fixture
def built(tmp_path):
    """A folder that looks like a built page."""
    (tmp_path / "index.html").write_text("<!doctype html>page")
    (tmp_path / "mujoco.wasm").write_bytes(b"\0asm")
    return tmp_path


def exit_of(capsys, *argv):
    """(exit status, what was said) of python -m web."""
    with pytest.raises(SystemExit) as ended:
        run_main(commands.main, list(argv))
    return ended.value.code, capsys.readouterr().err


# ------------------------------------------------------------------------------------ export


@pytest.mark.parametrize("name", export.NAMES)
def test_round_trip(folder, name):
    """JSON and binary alone give the policy's actions and the character's model."""
    table = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    data = (folder / table["binary"]["file"]).read_bytes()
    assert (len(data), zlib.crc32(data)) == (table["binary"]["bytes"], table["binary"]["crc32"])
    assert (table["format"], table["version"]) == (export.FORMAT, export.VERSION)
    arrays = export.unpacked(table["arrays"], data)

    policy, meta = load_policy(character.CHARACTERS / f"{name}.npz")
    shape, rng = table["policy"], np.random.default_rng(0)
    obs = rng.normal(size=(50, shape["sizes"][0])).astype(np.float32)
    h, start = np.clip((obs - arrays["norm_mean"]) * arrays["norm_inv_std"], -shape["clip"], shape["clip"]), 0
    for i, (n, m) in enumerate(zip(shape["sizes"], shape["sizes"][1:])):
        w, b = arrays["theta"][start : start + n * m].reshape(n, m), arrays["theta"][start + n * m :][:m]
        h, start = h @ w + b, start + (n + 1) * m
        if i < len(shape["sizes"]) - 2:
            h = np.tanh(h) if shape["activation"] == "tanh" else np.maximum(h, shape["slope"] * h)
    assert start == len(arrays["theta"])
    np.testing.assert_allclose(h, policy.mean_action(obs), atol=1e-6)
    assert table["licence"] == meta["licence"]

    char = character.load(name)
    text = re.sub(r'<geom\b[^>]*\bclass="visual"[^>]*/>', "", table["xml"])  # as character.js does
    model = mujoco.MjModel.from_xml_string(text)
    assert model.ngeom == table["geoms"] == char.model.ngeom
    for field in export.COMPILED:
        getattr(model, field)[:] = arrays[field]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for field in (*export.COMPILED, "body_invweight0", "dof_invweight0", "body_mass", "geom_pos", "geom_size"):
        np.testing.assert_allclose(getattr(model, field), getattr(char.model, field), rtol=1e-12, atol=1e-15)
    assert char.fall_geoms.tolist() == table["fall_geoms"]


def test_refuses_another_body(folder):
    """The MJCF's text does not say how a body varies, so such a policy is refused."""
    path = character.CHARACTERS / "dino.npz"
    policy, meta = load_policy(path)
    with pytest.raises(UserError, match="tail, scale"):
        export.tables(character.load("dino", tail="fixed"), policy, meta, path)
    with pytest.raises(UserError, match="needs"):
        export.tables(character.load("oppy"), policy, meta, path)


def test_demonstration(folder):
    """The recording reads as any headset's; it stands for its first second, and walks, turns and runs later."""
    clip, path = export.demonstration(), folder / "demo.csv"
    char = character.load("jesse")
    stream, samples = Stream(char, "openxr"), list(Reader("demo").read(path.read_text().splitlines(keepends=True)))
    ticks = [tick for sample in samples for tick in stream.push(sample)]
    assert len(samples) == len(clip) and 25 < len(ticks) / 30 < 45
    assert stream.calibration.height == pytest.approx(1.67, abs=0.03) and not stream.guard.report()
    pos = np.array([t.pos[0] for t in ticks])
    speed = 30 * np.linalg.norm(np.diff(pos[:, :2], axis=0), axis=1)
    smooth = np.convolve(speed, np.ones(15) / 15, "valid")
    assert smooth[:30].max() < 0.3 and smooth.max() > 1.8 and smooth[-15:].max() < 0.3
    yaw = np.unwrap([heading(t.quat[0]) for t in ticks])
    assert np.ptp(yaw) > 2.0
    hands = np.array([t.pos[1:, 2] for t in ticks])
    assert hands.max() > 0.8 * pos[:, 2].max()  # waves

    # the file's axes, turned back, are the clip's own sensors
    raw = to_world(np.array([s.pos for s in samples]), np.array([s.quat for s in samples]), "openxr")
    own = sensors(clip)
    np.testing.assert_allclose(raw[0], own[0], atol=2e-5)
    assert quat_angle(raw[1], own[1]).max() < 1e-4


# ------------------------------------------------------------------------------------ serve


def get(url):
    with urllib.request.urlopen(url, timeout=5) as answer:
        return answer.read(), answer.headers


def test_loopback_only(built):
    """Bound to 127.0.0.1; hands out the folder's files with the page's policy, and nothing above it."""
    (built.parent / "secret").write_text("no")
    with serve.make_server(serve.Options(port=0, folder=str(built))) as server:
        assert server.server_address[0] == "127.0.0.1"
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_address[1]}"
        page, headers = get(url)
        assert page == b"<!doctype html>page" and serve.POLICY in headers["Content-Security-Policy"]
        assert get(f"{url}/mujoco.wasm")[1]["Content-Type"] == "application/wasm"
        (built / "data").mkdir()
        for path in ("/data/", "/../secret", "/%2e%2e/secret", "/none"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                get(url + path)
        server.shutdown()


def test_policy_of_the_page():
    """The header and the page itself say the same: a host without headers is as strict."""
    page = (ROOT / "web" / "page" / "index.html").read_text(encoding="utf-8")
    assert f'http-equiv="Content-Security-Policy" content="{serve.POLICY}"' in page
    assert not re.search(r"https?://", page)


def test_bad_arguments(capsys, tmp_path, built):
    """One clear line each."""
    taken = socket.create_server(("127.0.0.1", 0))
    (tmp_path / "broken.pem").write_text("no certificate")
    cases = [
        (("export", "--characters", "jesee"), "no character 'jesee'"),
        (("export", "--characters", ","), "names none"),
        (("export", "--out", str(tmp_path / "broken.pem")), "valid: a folder"),
        (("export", "--oot", "x"), "did you mean --out"),
        (("serve", "--folder", str(tmp_path / "none")), "build the page first"),
        (("serve", "--folder", str(built), "--port", str(taken.getsockname()[1])), "give another --port"),
        (("serve", "--folder", str(built), "--port", "70000"), "from 0 to 65535"),
        (("serve", "--folder", str(built), "--host", "nowhere.invalid", "--port", "0"), "cannot listen"),
        (("serve", "--folder", str(built), "--key", "k.pem"), "without --cert"),
        (("serve", "--folder", str(built), "--cert", str(tmp_path / "none.pem")), "valid: a certificate"),
        (("serve", "--folder", str(built), "--cert", str(tmp_path / "broken.pem")), "valid: a certificate"),
    ]
    for argv, expected in cases:
        code, said = exit_of(capsys, *argv)
        assert code == 2 and expected in said and said.count("\n") == 1, (argv, said)
    taken.close()


def test_commands(capsys):
    code, said = exit_of(capsys, "bild")
    assert code == 2 and "valid: export, serve" in said
    with pytest.raises(SystemExit) as ended:
        run_main(commands.main, ["--help"])
    assert ended.value.code == 0

"""The live views: a page that a browser shows, ended by Ctrl-C; a window only where there is a display."""

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import mujoco
import numpy as np
import pytest

import character
import play
import ppo
import retarget
from mocap.data import sequences
from plumbing.cli import UserError

ROOT = Path(__file__).resolve().parent.parent
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--window-size=320,320 --remote-debugging-port=0"
).split()


def wait_for(what, condition, seconds=60.0):
    """What condition() returns once it is true; the test fails after `seconds`."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.1)
    pytest.fail(f"no {what} within {seconds:.0f} s")


def get(url):
    with urllib.request.urlopen(url, timeout=20) as answer:
        return answer.status, answer.read()


def listens(port) -> bool:
    """Whether anything takes connections there."""
    with socket.socket() as s:
        return s.connect_ex((play.LOOPBACK, port)) == 0


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """The run folder of an untrained policy: one tiny update."""
    out = tmp_path_factory.mktemp("run")
    small = "--recipe none --envs 8 --horizon 4 --steps 32 --minibatch 32".split()
    ppo.main([*small, "--out", str(out)])
    return out


@contextlib.contextmanager
def serving(policy, folder):
    """`play.py --view web` on a free port, without a display.  -> process, port, log file; killed if the test fails"""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [sys.executable, "play.py", "--policy", policy, "--view", "web", "--port", str(port)]
    log = folder / "log.txt"
    with open(log, "w") as out:
        # a shell that ran the tests in the background made its children deaf to SIGINT
        hear = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
        server = subprocess.Popen(command, cwd=ROOT, env=env, stdout=out, stderr=subprocess.STDOUT, preexec_fn=hear)
    try:
        wait_for("URL", lambda: server.poll() is not None or f"http://localhost:{port}/" in log.read_text())
        wait_for("answer", lambda: server.poll() is not None or listens(port))  # it prints its URL before it listens
        assert server.poll() is None, log.read_text()
        yield server, port, log
    finally:
        server.kill()
        server.wait()


def test_web_view(policy, tmp_path):
    """It prints its URL, serves the viewer and the character, plays on, and Ctrl-C frees the port."""
    with serving(policy, tmp_path) as (server, port, log):
        status, page = get(f"http://localhost:{port}/")
        assert status == 200 and b"MuJoCo" in page and b"<canvas" in page
        status, program = get(f"http://localhost:{port}/web_client.wasm")
        assert status == 200 and program[:4] == b"\0asm"
        assert json.loads(get(f"http://localhost:{port}/model?total_bytes")[1])["total_bytes"] > 100_000
        for elsewhere in ("127.0.0.2", "::1"):  # it would answer there if it listened on all interfaces
            with pytest.raises(OSError):
                socket.create_connection((elsewhere, port), timeout=5)
        wait_for("second run of the character", lambda: "; again" in log.read_text())
        server.send_signal(signal.SIGINT)
        assert server.wait(20) == 130
        assert "Traceback" not in log.read_text()
        with socket.socket() as s:
            s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            s.bind(("", port))


@contextlib.contextmanager
def browser(url, folder):
    """Headless Chromium on a page.  -> function (DevTools method, parameters) -> result"""
    from websockets.sync.client import connect  # a dependency of mujoco-studio

    quiet = dict(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    chromium = subprocess.Popen([CHROMIUM, *FLAGS, f"--user-data-dir={folder}", url], **quiet)
    try:
        file = folder / "DevToolsActivePort"
        port = wait_for("browser", lambda: file.exists() and "\n" in file.read_text() and file.read_text().split()[0])
        tabs = lambda: json.loads(get(f"http://127.0.0.1:{port}/json")[1])  # noqa: E731
        page = wait_for("tab", lambda: next((t for t in tabs() if t["type"] == "page"), None))
        with connect(page["webSocketDebuggerUrl"], max_size=None) as tab:

            def call(method, **params):
                tab.send(json.dumps(dict(id=1, method=method, params=params)))
                while True:
                    message = json.loads(tab.recv(timeout=180))
                    if message.get("id") == 1:
                        assert "error" not in message, message
                        return message["result"]

            yield call
    finally:
        chromium.terminate()
        chromium.wait()


ORANGE = """(async () => {  // a screenshot -> where it is orange: 1 or 0 for each pixel
  const image = await createImageBitmap(await (await fetch('data:image/png;base64,%s')).blob());
  const canvas = new OffscreenCanvas(image.width, image.height).getContext('2d');
  canvas.drawImage(image, 0, 0);
  const c = canvas.getImageData(0, 0, image.width, image.height).data;
  return Array.from(c.filter((_, i) => i %% 4 == 0), (r, i) =>
    Number(r > 120 && r > 2 * c[4 * i + 1] && c[4 * i + 1] > c[4 * i + 2])).join('');
})()"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_browser_shows_the_character_moving(policy, tmp_path):
    """Jesse's orange hoodie is on the canvas and does not stay where it is; a closed tab leaves the server running."""
    with serving(policy, tmp_path) as (server, port, _):
        with browser(f"http://localhost:{port}/", tmp_path / "profile") as call:

            def evaluate(code):
                answer = call("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
                return answer["result"].get("value")

            if not evaluate("!!new OffscreenCanvas(9, 9).getContext('webgl2')"):
                pytest.skip("this Chromium has no WebGL 2")

            def hoodie():
                shot = call("Page.captureScreenshot", format="png")["data"]
                return np.array(list(evaluate(ORANGE % shot) or "0")) == "1"

            first = wait_for("character", lambda: [h] if (h := hoodie()).sum() > 100 else None, 120)[0]
            wait_for("movement", lambda: (h := hoodie()).sum() > 100 and np.sum(h != first) > 20, 180)
        assert get(f"http://localhost:{port}/")[0] == 200 and server.poll() is None


def test_shown_model():
    """The shown model has the character's bodies and hinges in the same places, then one body for each sensor."""
    char = character.load("jesse")
    clip = sequences("builtin", "validation")[0]
    ref = retarget.reference(char, [clip])
    shown = play._shown_model(char, ref)
    names = [shown.body(i).name for i in range(shown.nbody)]
    assert names == [char.model.body(i).name for i in range(char.model.nbody)] + ["sensor 0", "sensor 1", "sensor 2"]
    assert shown.nq == char.model.nq and shown.nmocap == 3
    data, plain = mujoco.MjData(shown), mujoco.MjData(char.model)
    data.qpos[:] = plain.qpos[:] = ref.qpos[10]
    mujoco.mj_forward(shown, data), mujoco.mj_forward(char.model, plain)
    assert data.xpos[: char.model.nbody] == pytest.approx(plain.xpos)


def test_taken_port_is_named():
    with socket.socket(socket.AF_INET6 if socket.has_ipv6 else socket.AF_INET) as s:
        s.bind(("", 0))
        s.listen()
        port = s.getsockname()[1]
        with pytest.raises(UserError, match=f"port {port}"):
            play._open_viewer(None, None, 1, "web", port)
    with pytest.raises(UserError, match="0-65535"):
        play._open_viewer(None, None, 1, "web", 70000)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="DISPLAY is Linux's")
def test_window_needs_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(UserError, match="no window can be opened .*--view web"):
        play._open_viewer(None, None, 1, "window", 0)

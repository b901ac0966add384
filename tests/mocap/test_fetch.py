"""mocap/fetch.py against a server on this machine that resumes, breaks off, lies and sends hostile archives."""

import hashlib
import http.server
import io
import os
import stat
import threading
import zipfile
from dataclasses import replace

import pytest

from mocap import fetch
from mocap.data import CMU
from mocap.fetch import DATASETS, DataSet
from plumbing.cli import UserError


class Server(http.server.BaseHTTPRequestHandler):
    """Serves `files` (path -> bytes) with ETags and ranges; `cut`: bytes after which a connection breaks once."""

    files, cut, tags, ranges, asked = {}, None, True, True, []

    def do_GET(self):
        cls = type(self)
        cls.asked.append((self.path, self.headers.get("Range")))
        body = cls.files.get(self.path)
        if body is None:
            self.send_error(404)
            return
        tag, start = f'"{hashlib.md5(body).hexdigest()}"', 0
        wanted = self.headers.get("Range")
        if wanted and cls.ranges and self.headers.get("If-Range") == tag:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
        self.send_header("Content-Length", str(len(body) - start))
        if cls.tags:
            self.send_header("ETag", tag)
        self.end_headers()
        cut, cls.cut = cls.cut, None
        self.wfile.write(body[start:] if cut is None else body[start : start + cut])

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    """(handler class, base address)"""
    handler = type("Handler", (Server,), {"files": {}, "asked": []})
    s = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=s.serve_forever, daemon=True)
    thread.start()
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    yield handler, f"http://127.0.0.1:{s.server_address[1]}"
    s.shutdown()
    s.server_close()
    thread.join()


def archive(members, **kinds):
    """Bytes of a .zip; kinds: name -> file mode."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as z:
        for name, content in members.items():
            info = zipfile.ZipInfo(name)
            info.external_attr = kinds.get(name, stat.S_IFREG | 0o644) << 16
            z.writestr(info, content)
    return buffer.getvalue()


def served(handler, name, content):
    """Put content where a data set's (only) file is looked for."""
    handler.files["/" + DATASETS[name].files[0][1].split("/", 3)[3]] = content


TOP = "Bandai-Namco-Research-Motiondataset-74ead3b/dataset/"
GOOD = {
    TOP + "Bandai-Namco-Research-Motiondataset-1/data/other.bvh": "no",
    TOP + "Bandai-Namco-Research-Motiondataset-2/data/": "",
    TOP + "Bandai-Namco-Research-Motiondataset-2/data/a.bvh": "A" * 5000,
    TOP + "Bandai-Namco-Research-Motiondataset-2/data/b.bvh": os.urandom(300_000),
    TOP + "Bandai-Namco-Research-Motiondataset-2/LICENSE": "Attribution-NonCommercial 4.0",
}


def left(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


# ---------------------------------------------------------------- what works


def test_archive(server, tmp_path, capsys):
    """Licence and citation before anything is asked for; only the kept members, flat; the digest; not twice."""
    handler, base = server
    served(handler, "bandai", archive(GOOD))
    assert fetch.fetch("bandai", tmp_path / "x" / "bandai", base) == tmp_path / "x" / "bandai"
    out = capsys.readouterr().out
    assert out.index("Licence: CC BY-NC 4.0") < out.index("arXiv 2306.08861") < out.index("SHA-256")
    assert hashlib.sha256(archive(GOOD)).hexdigest() in out and "3 files" in out
    assert left(tmp_path) == ["x/bandai/LICENSE", "x/bandai/a.bvh", "x/bandai/b.bvh"]
    assert (tmp_path / "x/bandai/b.bvh").read_bytes() == GOOD[TOP + "Bandai-Namco-Research-Motiondataset-2/data/b.bvh"]
    fetch.fetch("bandai", tmp_path / "x" / "bandai", base)
    assert "already" in capsys.readouterr().out and len(handler.asked) == 1


def test_known_checksum(server, tmp_path, capsys, monkeypatch):
    handler, base = server
    content = archive({"walk1_subject1.bvh": "w", "__MACOSX/._walk1_subject1.bvh": "x"})
    served(handler, "lafan1", content)
    name, url, real = DATASETS["lafan1"].files[0]
    assert len(real) == 64
    digest = hashlib.sha256(content).hexdigest()
    monkeypatch.setitem(DATASETS, "lafan1", replace(DATASETS["lafan1"], files=((name, url, digest),)))
    fetch.fetch("lafan1", tmp_path / "lafan1", base + "/")
    assert left(tmp_path) == ["lafan1/LICENSE.txt", "lafan1/walk1_subject1.bvh"]
    assert (tmp_path / "lafan1/LICENSE.txt").read_text().startswith("CC BY-NC-ND 4.0")
    assert "as expected" in capsys.readouterr().out


def test_single_files(server, tmp_path, monkeypatch):
    """CMU's: one by one; a second call fetches what is missing."""
    handler, base = server
    files = DATASETS["cmu"].files
    assert len(files) == 4 + 9 + 8 + 8 + 20 and all(f"/{p.split('/')[0]}/" in u for p, u, _ in files)
    for path, _, _ in files:
        handler.files[f"/subjects/{path}"] = path.encode()
    missing = handler.files.pop("/subjects/16/16.asf")
    with pytest.raises(UserError, match=r"16\.asf: 404"):
        fetch.fetch("cmu", tmp_path / "cmu", base)
    asked = len(handler.asked)
    handler.files["/subjects/16/16.asf"] = missing
    fetch.fetch("cmu", tmp_path / "cmu", base)
    assert len(handler.asked) == len(files) + 1 and asked < len(files)
    assert left(tmp_path / "cmu") == sorted([*(p for p, _, _ in files), "LICENSE.txt"])


@pytest.mark.parametrize("tags, ranges, requests", [
    (True, True, ["None", "bytes=100000-"]),
    (True, False, ["None", "bytes=100000-"]),  # the server sends everything again
    (False, True, ["None", "None"]),  # nothing says that the file is still the same
])  # fmt: skip
def test_resume(server, tmp_path, capsys, tags, ranges, requests):
    handler, base = server
    content = os.urandom(250_000)
    handler.files["/f"], handler.cut, handler.tags, handler.ranges = content, 100_000, tags, ranges
    with pytest.raises(UserError, match=r"broke off after 100\.0 kB of 250\.0 kB; 100\.0 kB are kept"):
        fetch.download(f"{base}/f", tmp_path / "f")
    assert not (tmp_path / "f").exists() and (tmp_path / "f.part").stat().st_size == 100_000
    assert fetch.download(f"{base}/f", tmp_path / "f") == hashlib.sha256(content).hexdigest()
    assert (tmp_path / "f").read_bytes() == content and left(tmp_path) == ["f"]
    assert [str(r) for _, r in handler.asked] == requests
    assert ("going on after 100.0 kB" in capsys.readouterr().out) == (tags and ranges)


def test_changed_file_is_not_joined(server, tmp_path):
    handler, base = server
    handler.files["/f"], handler.cut = b"a" * 1000, 500
    with pytest.raises(UserError):
        fetch.download(f"{base}/f", tmp_path / "f")
    handler.files["/f"] = b"b" * 1000
    fetch.download(f"{base}/f", tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == b"b" * 1000


def test_interrupted(server, tmp_path, monkeypatch):
    """Ctrl-C keeps what has come; the next run goes on."""
    handler, base = server
    content = os.urandom(4 * fetch.CHUNK)
    handler.files["/f"] = content
    copy = fetch._copy

    def interrupted(answer, f, *rest):
        f.write(answer.read(fetch.CHUNK))
        raise KeyboardInterrupt

    monkeypatch.setattr(fetch, "_copy", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fetch.download(f"{base}/f", tmp_path / "f")
    assert left(tmp_path) == ["f.part", "f.part.tag"]
    monkeypatch.setattr(fetch, "_copy", copy)
    fetch.download(f"{base}/f", tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == content and handler.asked[-1][1] == f"bytes={fetch.CHUNK}-"


# ---------------------------------------------------------------- what is refused


def test_wrong_checksum(server, tmp_path):
    handler, base = server
    handler.files["/f"] = b"other"
    with pytest.raises(UserError, match="SHA-256 .* expected 00"):
        fetch.download(f"{base}/f", tmp_path / "f", "00" * 32)
    assert left(tmp_path) == []


def test_errors(server, tmp_path):
    handler, base = server
    with pytest.raises(UserError, match="valid: bandai, lafan1, cmu"):
        fetch.fetch("mixamo", tmp_path / "a")
    for bad in ("ftp://host", "file:///etc", "host"):
        with pytest.raises(UserError, match="http:// or https://"):
            fetch.fetch("cmu", tmp_path / "a", bad)
    with pytest.raises(UserError, match="404"):
        fetch.fetch("bandai", tmp_path / "bandai", base)
    with pytest.raises(UserError, match="refused"):
        fetch.fetch("bandai", tmp_path / "bandai", "http://127.0.0.1:9")
    assert left(tmp_path) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        fetch.fetch("cmu", tmp_path / "file" / "x", base)


KEPT = "x/Bandai-Namco-Research-Motiondataset-2/data/"


@pytest.mark.parametrize("members, kinds, words", [
    ({"../evil.bvh": "x"}, {}, "leaves its folder"),
    ({KEPT + "../../../../evil.bvh": "x"}, {}, "leaves its folder"),
    ({"/etc/evil.bvh": "x"}, {}, "leaves its folder"),
    ({"..\\evil.bvh": "x"}, {}, "leaves its folder"),
    ({"C:/evil.bvh": "x"}, {}, "leaves its folder"),
    ({KEPT + "a.bvh": "/etc/passwd"}, {KEPT + "a.bvh": stat.S_IFLNK | 0o777}, "link"),
    ({KEPT + "a.bvh": ""}, {KEPT + "a.bvh": stat.S_IFIFO | 0o777}, "link or a device"),
    ({KEPT + "a.bvh": "x", "y/" + KEPT + "A.bvh": "x"}, {}, "two members"),
    ({"readme": "x"}, {}, "no member matches"),
])  # fmt: skip
def test_unsafe_archives(server, tmp_path, members, kinds, words):
    """Refused whole: also the good members, also when the bad one is not among the kept."""
    handler, base = server
    good = {} if words == "no member matches" else {KEPT + "good.bvh": "x"}
    served(handler, "bandai", archive(good | members, **kinds))
    (tmp_path / "in").mkdir()
    with pytest.raises(UserError, match=words):
        fetch.fetch("bandai", tmp_path / "in" / "bandai", base)
    assert left(tmp_path) == [] and not (tmp_path / "in" / "bandai").exists()


def test_too_large(tmp_path, monkeypatch):
    (tmp_path / "a.zip").write_bytes(archive({"a.bvh": "x" * 1000}))
    monkeypatch.setattr(fetch, "LIMIT", 999)
    with pytest.raises(UserError, match="more than 999 bytes"):
        fetch.unpack(tmp_path / "a.zip", tmp_path / "a", ("*.bvh",))
    assert left(tmp_path) == []


def test_damaged_archive(server, tmp_path):
    handler, base = server
    whole = archive(GOOD)
    at = whole.index(b"b.bvh") + 1000
    for content in (b"<html>sorry</html>", whole[: len(whole) // 2], whole[:at] + b"\0\0\0\0" + whole[at + 4 :]):
        served(handler, "bandai", content)
        with pytest.raises(UserError, match="damaged archive"):
            fetch.fetch("bandai", tmp_path / "bandai", base)
        assert left(tmp_path) == []


def test_data_sets_say_their_terms():
    for d in DATASETS.values():
        assert isinstance(d, DataSet) and d.licence and d.citation and d.files
        assert all(url.startswith(("https://github.com/", "http://mocap.cs.cmu.edu/")) for _, url, _ in d.files)
    assert DATASETS["cmu"].licence == CMU  # what a policy carries, fetched or not

r"""Downloads of the motion data sets: licence first, then the files, whole or not at all.

    python -m mocap fetch bandai|cmu|lafan1 [--out FOLDER] [--url BASE]

Every address is pinned to a commit where the source has commits.  A download that breaks off goes on where it stopped
the next time, if the server says that the file is still the same one.  Archives are checked before anything is
unpacked, into a new folder that then gets its name.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import os
import shutil
import stat
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
import zipfile
import zlib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from mocap.data import CMU
from plumbing.cli import UserError
from plumbing.files import atomic_write

CHUNK = 1 << 16
LIMIT = 16 << 30  # bytes that an archive may hold unpacked
TIMEOUT = 60.0  # s without a byte


@dataclass(frozen=True)
class DataSet:
    """Where a data set is, and on what terms.

    files : (path below the folder, URL, SHA-256 or None); a single .zip is unpacked
    keep  : patterns on the members' names of that archive; they land in the folder itself, without their folders
    """

    licence: str
    citation: str
    files: tuple
    keep: tuple = ()


def _cmu():
    """Walks and some runs of four subjects."""
    trials = {"07": "01 02 03 06 07 08 09 10 11", "08": "01 02 03 04 06 08 09 10"}
    trials |= {"16": "15 16 21 22 31 32 47 58", "35": "01 02 05 07 08 09 10 11 12 13 14 15 16 28 29 30 31 32 33 34"}
    base = "http://mocap.cs.cmu.edu/subjects"
    for subject, numbers in trials.items():
        for name in (f"{subject}.asf", *(f"{subject}_{n}.amc" for n in numbers.split())):
            yield f"{subject}/{name}", f"{base}/{subject}/{name}", None


_BANDAI, _LAFAN1 = "74ead3ba1ae4696404e6086233779f60de8bf9ef", "610f0658a561c7ef208c396f5d3439844bd3459b"
DATASETS = {
    "bandai": DataSet(
        "CC BY-NC 4.0 (Bandai-Namco-Research-Motiondataset-2)",
        "Kobayashi, Liao, Inoue, Yojima, Takahashi. Motion Capture Dataset for Practical Use of AI-based Motion "
        "Editing and Stylization. arXiv 2306.08861, 2023.",
        ((
            "bandai.zip",
            "https://github.com/BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset/archive/" + _BANDAI + ".zip",
            None,  # GitHub makes the archive anew: its bytes may differ, the files' do not
        ),),
        ("*/Bandai-Namco-Research-Motiondataset-2/data/*.bvh", "*/Bandai-Namco-Research-Motiondataset-2/LICENSE"),
    ),
    "lafan1": DataSet(
        "CC BY-NC-ND 4.0 (Ubisoft La Forge Animation Dataset)",
        "Harvey, Yurick, Nowrouzezahrai, Pal. Robust Motion In-betweening. ACM Transactions on Graphics 39(4), 2020.",
        ((
            "lafan1.zip",
            "https://github.com/ubisoft/ubisoft-laforge-animation-dataset/raw/" + _LAFAN1 + "/lafan1/lafan1.zip",
            "ea918082b500a5d158e9d3aa39039df04cd42e25f5c02fe8f7e88e8e9365a977",
        ),),
        ("*.bvh",),
    ),
    "cmu": DataSet(
        CMU,
        "The data used in this project was obtained from mocap.cs.cmu.edu.",  # whose funding the credit names
        tuple(_cmu()),
    ),
}  # fmt: skip


def fetch(name: str, out=None, base=None) -> Path:
    """Fetch one data set into a folder; what is there already is kept.

    Args      name : of DATASETS; out : folder, data/NAME by default
              base : http(s) address that stands for the servers, the rest of each address the same
    Returns   the folder
    Raises    UserError: unknown name, no such file, a broken connection, a wrong checksum, an unsafe archive
    Test      tests/mocap/test_fetch.py::test_archive, ::test_single_files, ::test_errors
    """
    if name not in DATASETS:
        raise UserError(f"no data set {name!r}; valid: {', '.join(DATASETS)}")
    if base is not None and urllib.parse.urlsplit(base).scheme not in ("http", "https"):
        raise UserError(f"--url {base!r} is no http:// or https:// address")
    d, out = DATASETS[name], Path(out or Path("data") / name)
    terms = f"Licence: {d.licence}\nPlease cite: {d.citation}\n"
    print(f"{name}\n{terms}", end="", flush=True)
    if d.keep and out.exists():
        print(f"{out} is there already; remove it to fetch it again")
        return out
    made = []
    try:
        for local, url, sha256 in d.files:
            target = out.with_name(local) if d.keep else out / local
            made = [p for p in (target.parent, *target.parent.parents) if not p.exists()] + made
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.exists():
                download(url if base is None else _moved(url, base), target, sha256)
        if d.keep:
            count = unpack(target, out, d.keep)
            target.unlink()
        else:
            count = len(d.files)
        if not list(out.glob("LICENSE*")):
            atomic_write(out / "LICENSE.txt", terms.removeprefix("Licence: "))
    except OSError as e:
        raise UserError(f"cannot write {e.filename or out}: {e.strerror or e}") from None
    finally:
        for folder in made:  # those that stayed empty
            with contextlib.suppress(OSError):
                folder.rmdir()
    print(f"{out}: {count} files")
    return out


def _moved(url, base):
    """The same path and query on another server."""
    return base.rstrip("/") + urllib.parse.urlsplit(url).path


def download(url: str, path, sha256=None) -> str:
    """Fetch one file to `path`; what came before a break is kept beside it as .part and continued.

    Continued only if the server named the file's state (ETag or date) then and says now that it is still the same.
    Args      sha256 : expected digest, or None: it is printed
    Returns   SHA-256 of the file
    Raises    UserError: cannot be reached, broke off, or another digest (the file is removed then)
    Test      tests/mocap/test_fetch.py::test_resume, ::test_changed_file_is_not_joined, ::test_wrong_checksum
    """
    path = Path(path)
    part, tag = path.with_name(path.name + ".part"), path.with_name(path.name + ".part.tag")
    have = part.stat().st_size if part.exists() and tag.exists() else 0
    headers = {"User-Agent": "sparse-retarget", "Accept-Encoding": "identity"}
    if have:
        headers |= {"Range": f"bytes={have}-", "If-Range": tag.read_text()}
    try:
        try:
            answer = urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=TIMEOUT)
        except urllib.error.HTTPError as e:
            if not (have and e.code == 416):  # nothing beyond what we have: begin again
                raise
            have = 0
            headers = {k: v for k, v in headers.items() if "Range" not in k}
            answer = urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=TIMEOUT)
        with answer:
            if have and not (answer.status == 206 and f"bytes {have}-" in answer.headers.get("Content-Range", "")):
                have = 0
            length = answer.headers.get("Content-Length")
            total = have + int(length) if length and length.isdigit() else None
            state = answer.headers.get("ETag") or ""
            state = answer.headers.get("Last-Modified") or "" if not state or state.startswith("W/") else state
            if have:
                print(f"{path.name}: going on after {_size(have)}")
            elif state:
                tag.write_text(state)
            else:
                tag.unlink(missing_ok=True)
            with open(part, "ab" if have else "wb") as f:
                _copy(answer, f, have, total, path.name)
    except urllib.error.HTTPError as e:
        raise UserError(f"{url}: {e.code} {e.reason}; --url BASE names another server with the same paths") from None
    except (OSError, http.client.HTTPException, ValueError) as e:
        if isinstance(e, OSError) and e.filename:
            raise
        kept = f"; {_size(part.stat().st_size)} are kept, run it again to go on" if part.exists() else ""
        raise UserError(f"{url}: {getattr(e, 'reason', None) or e}{kept}") from None
    digest = _digest(part)
    tag.unlink(missing_ok=True)
    if sha256 and digest != sha256:
        part.unlink()
        raise UserError(f"{url}: SHA-256 {digest}, expected {sha256}; removed, run it again")
    os.replace(part, path)
    print(
        f"{path.name}: {_size(path.stat().st_size)}, SHA-256 {digest}" + (" as expected" if sha256 else ""), flush=True
    )
    return digest


def _copy(answer, f, done, total, name):
    """Copy the body, telling how far it is once in two seconds."""
    said = time.monotonic()
    while block := answer.read(CHUNK):
        f.write(block)
        done += len(block)
        if time.monotonic() - said > 2.0:
            said = time.monotonic()
            share = f"{100 * done / total:.0f} % of {_size(total)}" if total else _size(done)
            print(f"{name}: {share}", file=sys.stderr, flush=True)
    f.flush()
    if total is not None and done != total:
        raise http.client.HTTPException(f"broke off after {_size(done)} of {_size(total)}")


def _digest(path):
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def _size(n):
    return f"{n / 1e6:.1f} MB" if n >= 1e6 else f"{n / 1e3:.1f} kB" if n >= 1000 else f"{n} bytes"


def unpack(archive, out, keep) -> int:
    """Unpack the members of a .zip that match one of the patterns into a new folder, without their folders.

    The whole archive is refused and removed, and nothing written, if any member's name is absolute, has a `..` or a
    drive, if any is a link, if two of the kept have one name, or if they are larger than LIMIT.
    Returns   how many files
    Raises    UserError: unsafe, damaged (removed then), or nothing matches
    Test      tests/mocap/test_fetch.py::test_unsafe_archives, ::test_damaged_archive
    """
    archive, out = Path(archive), Path(out)
    folder = out.with_name(f"{out.name}.tmp-{os.getpid()}")
    try:
        with zipfile.ZipFile(archive) as z:
            members = _safe(archive, z.infolist(), keep)
            folder.mkdir()
            for target, member in members.items():
                with z.open(member) as source, open(folder / target, "xb") as f:
                    shutil.copyfileobj(source, f, CHUNK)
        os.replace(folder, out)
        return len(members)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, RuntimeError, NotImplementedError, EOFError, zlib.error) as e:
        archive.unlink(missing_ok=True)
        raise UserError(f"{archive}: damaged archive ({e}); removed, run it again") from None
    except UserError:
        archive.unlink()
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _safe(archive, infos, keep):
    """Name in the folder -> member, for the kept ones; every member is checked."""
    found, lower = {}, set()
    for info in infos:
        # zipfile turns os.sep into / and cuts at a zero byte: the name as it was stored counts
        for name in (info.filename, info.orig_filename):
            parts = PurePosixPath(name.replace("\\", "/")).parts
            if name.startswith(("/", "\\")) or ".." in parts or "\0" in name or (parts and ":" in parts[0]):
                raise UserError(f"{archive}: member {name!r} leaves its folder; archive removed")
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise UserError(f"{archive}: member {info.filename!r} is a link or a device; archive removed")
        if info.is_dir() or not any(fnmatchcase(info.filename, pattern) for pattern in keep):
            continue
        target = PurePosixPath(info.filename).name
        if target.startswith("."):
            continue
        if target.lower() in lower:
            raise UserError(f"{archive}: two members are called {target!r}; archive removed")
        lower.add(target.lower())
        found[target] = info
    if sum(info.file_size for info in found.values()) > LIMIT:
        raise UserError(f"{archive}: more than {_size(LIMIT)} unpacked; archive removed")
    if not found:
        raise UserError(f"{archive}: no member matches {' or '.join(keep)}; archive removed")
    return found

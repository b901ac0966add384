"""Beat Saber's replays: a writer from the format's public description, read back; pauses, old lengths, damage."""

import json
import struct
import tracemalloc

import numpy as np
import pytest
from test_stream import standing, tiny_policy, to_csv

import character
import play
from headset import bsor
from headset.axes import choose
from headset.bsor import Replay, opened
from headset.calibration import Stream
from headset.reader import COLUMNS, Reader, files_of
from plumbing.cli import UserError, run_main

INFO = dict(
    version="0.5.4", game_version="1.20.0", timestamp="1662541830", player_id="76561198000000000", player_name="Alice",
    platform="steam", tracking="OpenVR", hmd="Valve Index", controller="Knuckles", hash="A" * 40, song="Song",
    mapper="Mapper", difficulty="ExpertPlus", score=812345, mode="Standard", environment="TheFirst", modifiers="",
    jump=18.5, left_handed=False, height=1.7, start=0.0, fail=0.0, speed=0.0,
)  # fmt: skip


def string(text, units=False):
    """A length and UTF-8; units: the length is that of UTF-16, as older mods wrote it."""
    raw = text.encode()
    return struct.pack("<i", len(text.encode("utf-16-le")) // 2 if units else len(raw)) + raw


def written(rows, info=None, pauses=(), notes=(0, 2, 1, 3), units=False, sections=6, more=b""):
    """A replay's bytes.  rows: (time, (3, 7) poses, x, y, z, w); notes: kinds of events; sections: how many of six."""
    out = []
    fields = b""
    for name, value in (INFO | (info or {})).items():
        if isinstance(value, str):
            fields += string(value, units)
        elif isinstance(value, bool):
            fields += struct.pack("<?", value)
        else:
            fields += struct.pack("<i" if name == "score" else "<f", value)
    out.append(fields)
    frames = b"".join(struct.pack("<fi", t, 90) + struct.pack("<21f", *np.ravel(poses)) for t, poses in rows)
    out.append(struct.pack("<i", len(rows)) + frames)
    events = b""
    for k, kind in enumerate(notes):
        events += struct.pack("<iffi", 20113, k + 0.5, k, kind)
        if kind in (0, 1):  # the cut
            events += struct.pack("<4?f3fiff3f3f4f", 1, 1, 1, 0, 9.5, 0, 1, 0, 1, 0.1, 0.2, *range(6), 0.1, 2, 1, 1)
    out.append(struct.pack("<i", len(notes)) + events)
    out.append(struct.pack("<i", 1) + struct.pack("<ifff", 100, 0.9, 1.0, 0.5))
    out.append(struct.pack("<i", 2) + struct.pack("<4f", 1.7, 0.0, 1.8, 1.0))
    out.append(struct.pack("<i", len(pauses)) + b"".join(struct.pack("<qf", long, start) for start, long in pauses))
    body = b"".join(bytes([k]) + part for k, part in enumerate(out[:sections]))
    return struct.pack("<iB", 0x442D3D69, 1) + body + more


def rows_of(seconds=3.0, rate=90.0):
    """A user who stands, in Unity's axes, as a CSV's reader gives them."""
    t, pos, quat = zip(*standing(seconds, rate))
    return list(Reader("f").read(to_csv(t, pos, quat, "unity")))


def framed(samples):
    return [(s.t, np.concatenate([s.pos, s.quat], axis=1)) for s in samples]


def saved(tmp_path, raw, name="a.bsor"):
    (tmp_path / name).write_bytes(raw)
    return tmp_path / name


def one_line(path):
    with pytest.raises(UserError) as error:
        Replay(path)
    text = str(error.value)
    assert "\n" not in text and path.name in text and "valid" in text and len(text) < 400, text
    return text


def test_read_back(tmp_path):
    """The same samples as a CSV's, all that the info says; a file may end before a section; more may follow."""
    samples = rows_of(1.0)
    raw = written(framed(samples), pauses=[(0.5, 0)], more=b"\6" + bytes(56))
    replay = Replay(saved(tmp_path, raw))
    assert replay.info["player's name"] == "Alice" and replay.info["difficulty"] == "ExpertPlus"
    assert replay.info["score"] == 812345 and replay.info["height"] == pytest.approx(1.7)
    assert replay.pauses == [(0.5, 0.0)]
    got = list(replay.samples())
    assert len(got) == len(samples) == 90
    for a, b in zip(got, samples, strict=True):
        assert a.t == pytest.approx(b.t, abs=1e-6)
        np.testing.assert_allclose(a.pos, b.pos, atol=1e-6)
        np.testing.assert_allclose(a.quat, b.quat, atol=1e-6)
    for sections in range(2, 7):
        assert len(Replay(saved(tmp_path, written(framed(samples), sections=sections))).times) == 90
    alone = next(Replay(saved(tmp_path, raw), devices=1).samples())
    assert np.isfinite(alone.pos[0]).all() and np.isnan(alone.pos[1:]).all()


def test_times(tmp_path):
    """A pause stands between two frames whose times in the song are neighbours; a fast song is slower in the room."""
    rows = framed(rows_of(3.0))
    t = [s.t for s in Replay(saved(tmp_path, written(rows, pauses=[(2.0, 7), (1.0, 2)]))).samples()]
    want = np.arange(270) / 90
    np.testing.assert_allclose(t, want + 2 * (want > 1.0) + 7 * (want > 2.0), atol=1e-5)
    fast, spaced, slow = {"modifiers": "GN,FS"}, {"modifiers": "GN, FS"}, {"modifiers": "SS"}
    for info, speed in ((fast, 1.2), (spaced, 1.2), (slow, 0.85), ({"speed": 0.8}, 0.8), ({}, 1.0)):
        replay = Replay(saved(tmp_path, written(rows, info)))
        assert bsor.pace(replay.info) == pytest.approx(speed)
        assert list(replay.samples())[90].t == pytest.approx(1.0 / speed, rel=1e-5)


def test_pauses_are_gaps(tmp_path):
    """Two seconds are a drop-out that is played; ten are another clock; both are told, and all is finite."""
    rows = framed(rows_of(4.0))
    for long, told in ((2, "no row"), (10, "jumps of the clock")):
        source = Stream(character.load("jesse"), "unity")
        path = saved(tmp_path, written(rows, pauses=[(2.0, long)]))
        ticks = [tick for s in opened(path)[1] for tick in source.push(s)]
        assert len(ticks) / 30 == pytest.approx(3.0 + (long if long < 5 else 0), abs=0.2)
        assert all(np.isfinite(tick.pos).all() and np.isfinite(tick.quat).all() for tick in ticks)
        assert told in " ".join(source.report()).replace("drop-out", "no row")


NAMES = ("Zoë", "太郎", "Ж" * 80, "a😀b", "é", "naïve €uro", "日本" * 20 + "x")


@pytest.mark.parametrize("name", NAMES)
def test_lengths_that_are_wrong(tmp_path, name):
    """Old mods counted UTF-16 units, and wrote UTF-8: in the names of player, song and mapper, alone or together."""
    rows = framed(rows_of(0.1))
    for info in ({"player_name": name}, {"song": name}, {"player_name": name, "song": name[::-1], "mapper": name}):
        for units in (True, False):
            replay = Replay(saved(tmp_path, written(rows, info, units=units)))
            assert replay.info["player's name"] == info.get("player_name", "Alice")
            assert replay.info["song's name"] == info.get("song", "Song") and len(replay.times) == len(rows)
            assert replay.info["mapper"] == info.get("mapper", "Mapper")


def at_frames(raw):
    """Where the count of the frames is."""
    return len(written([], sections=1)) + 1


def put(at, kind, value):
    def change(raw):
        where = at(raw) if callable(at) else at
        new = struct.pack(f"<{kind}", value)
        return raw[:where] + new + raw[where + len(new) :]

    return change


def frame(k, field):
    """Where a number of a frame is: 0 the time, 2 on the poses."""
    return lambda raw: at_frames(raw) + 4 + 92 * k + 4 * field


WRONG = {  # what is done to it, and what the line must say
    "nothing": (lambda raw: b"", "byte 0, magic number: begins with nothing; valid: 69 3d 2d 44"),
    "no replay": (lambda raw: b"time,head_px\n", "byte 0, magic number: begins with 74 69 6d 65"),
    "big endian": (lambda raw: raw[3::-1] + raw[4:], "begins with 44 2d 3d 69"),
    "version": (put(4, "B", 2), "byte 4, version: 2; valid: 1"),
    "no info": (put(5, "B", 1), "byte 5, begin of the info: 1; valid: 0"),
    "a length of two billions": (put(6, "i", 2**31 - 1), "byte 6, length of the version: a count of 2147483647; valid"),
    "a negative length": (put(6, "i", -5), "byte 6, length of the version: a count of -5; valid: 0 to"),
    "a long string": (lambda raw: raw[:6] + struct.pack("<i", 70000) + b"a" * 70000 + raw[10:], "at most 65536"),
    "frames of two billions": (put(at_frames, "i", 2**31 - 1), "frames: a count of 2147483647; valid: 0 to 11,"),
    "negative frames": (put(at_frames, "i", -1), "frames: a count of -1"),
    "a frame too many": (put(at_frames, "i", 12), "frames: a count of 12; valid: 0 to 11,"),
    "a frame less": (put(at_frames, "i", 8), "begin of the notes: "),
    "no frames": (lambda raw: written([]), "frames: none; valid: one or more"),
    "a time that is none": (put(frame(3, 0), "f", np.nan), "frame 3, time: nan; valid: a finite number"),
    "a place that is none": (put(frame(3, 2 + 7), "f", np.inf), "frame 3, left px: inf; valid: a finite number"),
    "a turn that is none": (put(frame(8, 2 + 20), "f", np.nan), "frame 8, right qw: nan"),
    "cut in the frames": (lambda raw: raw[: at_frames(raw) + 300], "frames: a count of 9; valid: 0 to 3,"),
    "cut in a note": (lambda raw: raw[: at_frames(raw) + 4 + 9 * 92 + 75], "note 0: wants 72 bytes, and the file has"),
    "a pause of years": (lambda raw: written(framed(rows_of(0.1)), pauses=[(1.0, 10**12)]), "pause 0: 1000000000000 s"),
    "pauses of two billions": (lambda raw: raw[:-4] + struct.pack("<i", 2**31 - 1), "pauses: a count of 2147483647"),
    "a hand of 2": (put(lambda raw: at_frames(raw) - 18, "B", 2), "left-handed: 2; valid: 0 or 1"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong(tmp_path, case):
    """One line: the file, the byte, what is there, and what would be valid."""
    change, says = WRONG[case]
    raw = change(written(framed(rows_of(0.1))))
    assert says in one_line(saved(tmp_path, raw)), one_line(tmp_path / "a.bsor")


def test_cut_anywhere(tmp_path):
    """Cut at any byte it is refused in a line, unless it ends before a section; and no claim takes memory."""
    rows = framed(rows_of(0.05))
    raw = written(rows, {"player_name": "Zoë"}, pauses=[(0.02, 1)])
    whole = {len(written(rows, {"player_name": "Zoë"}, pauses=[(0.02, 1)], sections=k)) for k in range(2, 7)}
    for n in range(len(raw)):
        path = saved(tmp_path, raw[:n])
        if n in whole:
            assert len(Replay(path).times) == len(rows)
        else:
            one_line(path)
    claims = [at for at in range(6, len(raw) - 4)]
    tracemalloc.start()
    for at in claims[::7]:
        path = saved(tmp_path, put(at, "i", 2**31 - 1)(raw))
        try:
            Replay(path)
        except UserError:
            pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**21, peak


def test_folder_and_single_file(tmp_path, capsys):
    """`play.py --stream`: a replay plays as the CSV of the same user; one that is damaged is named and left out."""
    char = character.load("jesse")
    policy = tiny_policy(char, tmp_path / "p.npz")
    t, pos, quat = zip(*standing(2.5, 60.0))
    folder = tmp_path / "takes"
    folder.mkdir()
    (folder / "a.csv").write_text("".join(to_csv(t, pos, quat, "unity")))
    raw = written(framed(Reader("f").read(to_csv(t, pos, quat, "unity"))))
    saved(folder, raw, "b.BSOR")
    saved(folder, raw[:-2000], "c.bsor")
    assert [f.name for f in files_of(folder)] == ["a.csv", "b.BSOR", "c.bsor"]
    flags = ["--character", "jesse", "--policy", str(policy), "--threads", "1", "--json", str(tmp_path / "o.json")]
    with pytest.raises(SystemExit) as end:
        run_main(play.main, [*flags, "--stream", str(folder)])
    wrong, found = capsys.readouterr().err, json.loads((tmp_path / "o.json").read_text())
    assert end.value.code == 1 and "c.bsor, byte " in wrong and set(found["files"]) == {"a.csv", "b.BSOR"}
    for key, value in found["files"]["a.csv"].items():
        same = found["files"]["b.BSOR"][key]
        assert key == "notes" or same == value or same == pytest.approx(value, rel=0.2), key
    with pytest.raises(SystemExit) as end:
        run_main(play.main, [*flags[:-2], "--stream", str(folder / "b.BSOR")])
    assert end.value.code == 0 and "1.5 s played" in capsys.readouterr().out
    assert choose(folder / "b.BSOR").axes == "unity" and not choose(folder / "b.BSOR").lines
    assert opened("-")[0].name == "standard input" and opened(folder / "a.csv")[0].wanted == COLUMNS

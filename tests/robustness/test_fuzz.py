r"""Every reader against damaged files: it loads what is whole, or says in one line what is wrong with which file.

A small valid file of every kind is cut, spliced, renamed, doubled, encoded anew, given numbers that are none, counts
that are not true, nesting without end; or replaced by any bytes.  For each input one of two things must happen:

- it loads, and then all it holds is finite and fits together: a clip can be retargeted, a policy acts, a stream drives;
- it raises `plumbing.cli.UserError`, whose message is one printable line that names the file and what would be valid.

No other exception, no warning, no hang, no memory beyond a multiple of the file's size, and no file changed.

    python -m pytest tests/robustness/test_fuzz.py                         some hundred inputs a reader, always the same
    FUZZ_EXAMPLES=10000 python -m pytest tests/robustness/test_fuzz.py     10,000 inputs in all; prints how many of
    which reader
    FUZZ_EXAMPLES=10000 FUZZ_SEED=1 python -m pytest tests/robustness/test_fuzz.py     10,000 others
"""

import contextlib
import io
import json
import os
import re
import signal
import struct
import sys
import tracemalloc
import warnings
import zipfile
import zlib
from collections import Counter
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from damage import (
    CLAIMS,
    bsor_damage,
    claiming,
    damaged,
    inserting,
    json_damage,
    npy,
    npz_bytes,
    npz_damage,
    zipped,
)
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from test_amc import cmu_file
from test_amc import standing as cmu_standing
from test_bsor import framed, rows_of, written
from test_mocap import walk, write_as
from test_retarget import MINI_TOML
from test_rigs import write_rig
from test_stream import standing, to_csv

import character
import ppo
import retarget
from env import Env
from headset import calibration
from headset.axes import choose
from headset.bsor import opened
from headset.player import Player
from headset.reader import AXES
from human import sensors
from mocap import inspect, rigs
from mocap.data import load
from mocap.rigs import Reading
from plumbing import runs, training
from plumbing.cli import MESSAGE, UserError
from policy import Policy, load_policy

resource = pytest.importorskip("resource", reason="this system cannot limit a process's memory")

EXAMPLES, SEED = os.environ.get("FUZZ_EXAMPLES"), int(os.environ.get("FUZZ_SEED", 0))
SHARES = dict(  # of the inputs
    test_bvh=15, test_asf_and_amc=15, test_joint_maps=8, test_character_tables=13, test_character_models=13,
    test_policies=14, test_run_folders=13, test_headset_files=5, test_standard_input=4, test_replays=10,
)  # fmt: skip
DEADLINE = 10.0  # s of processor time for one input
ROOM, TIMES = 32 * 2**20, 400  # bytes of memory: for any input, and for each byte of its files
MEASURED = 8  # one input in so many has its memory measured, which is slow; of the others the address space is limited
VALID = re.compile(r"\b(valid|expected|needed|needs|must|give|set|write|fill in|it has|there (are|is)|is not an?)\b")


# ---------------------------------------------------------------- one input


@dataclass
class Input:
    """A folder's files, and which of them is damaged."""

    files: dict
    damaged: str = ""

    def __repr__(self):
        raw = self.files.get(self.damaged, b"")
        return f"{self.damaged} of {len(raw)} bytes: {raw[:200]!r}"

    def write(self, folder):
        """A folder with exactly these files."""
        folder.mkdir(exist_ok=True)
        for old in folder.iterdir():
            old.unlink()
        for name, raw in self.files.items():
            (folder / name).write_bytes(raw)


@contextlib.contextmanager
def limited(size, measured):
    """No more than the deadline, memory for `size` bytes of files, and no warning."""

    def late(*_):
        raise TimeoutError(f"more than {DEADLINE} s")

    room, peak = ROOM + TIMES * size, 0
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else None
    old, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGPROF, late)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if measured:
            tracemalloc.start()
        elif pages:
            most = pages * resource.getpagesize() + 2 * room + 2**30  # threads' stacks are a part of it
            resource.setrlimit(resource.RLIMIT_AS, (most, old[1]))
        signal.setitimer(signal.ITIMER_PROF, DEADLINE)
        try:
            yield
            peak = tracemalloc.get_traced_memory()[1] if measured else 0
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.signal(signal.SIGPROF, handler)
            tracemalloc.stop()
            resource.setrlimit(resource.RLIMIT_AS, old)
    assert peak <= room, f"{peak / 2**20:.0f} MiB of memory for {size} bytes"


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def attempt(read, folder, measured=False, source=None, written=()):
    """Read a folder's files: True if they load, False if they are refused as they should be; or what broke out.

    source : what a message must name, one of the files by default; written : files that reading may change"""
    before, said, told = contents(folder), None, io.StringIO()
    size = sum(map(len, before.values()))
    with limited(size, measured), contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        try:
            read(folder)
        except UserError as error:
            said = str(error)
    assert len(told.getvalue()) < 20_000 + 100 * size
    if said is None:
        return True
    assert len(said.splitlines()) == 1 and said.isprintable() and len(said) <= MESSAGE, said
    names = [source] if source else [p.name for p in folder.iterdir()]
    assert any(name in said for name in names), f"names no file: {said}"
    assert VALID.search(said), f"says not what would be valid: {said}"
    assert contents(folder) == before, "changed its files"
    return False


def finite(thing, what="it"):
    """Every number in arrays, tables and lists."""
    if isinstance(thing, np.ndarray | np.generic | float):
        assert np.asarray(thing).dtype.kind not in "fc" or np.isfinite(thing).all(), what
    elif isinstance(thing, dict):
        for key, value in thing.items():
            finite(value, f"{what}.{key}")
    elif isinstance(thing, list | tuple):
        for value in thing:
            finite(value, what)


@pytest.fixture
def fuzz(tmp_path, capsys, request, monkeypatch):
    """fuzz(valid, read, targets, source): many damaged copies of valid folders, each read."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log where it runs
    name, tally = request.node.name, Counter()

    def run(valid, read, targets, source=None):
        """valid : folders, as {file: bytes}; read : function of a folder; targets : file -> strategy of damage to it"""
        count = round(int(EXAMPLES or 1300) * SHARES[name] / sum(SHARES.values()))
        folder = tmp_path / "fuzzed"
        for files in valid:
            Input(files).write(folder)
            assert attempt(read, folder, True, source), "the undamaged files do not load"
        strategies = [{name: damage(files[name]) for name, damage in targets.items()} for files in valid]

        @st.composite
        def inputs(draw):
            kind = draw(st.integers(0, len(valid) - 1))
            damaged = draw(st.sampled_from(sorted(targets)))
            return Input(valid[kind] | {damaged: draw(strategies[kind][damaged])}, damaged)

        @seed(SEED)
        @settings(max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck),
                  phases=(Phase.generate, Phase.shrink))  # fmt: skip
        @given(inputs())
        def one(it):
            it.write(folder)
            tally["inputs"] += 1
            measured = zlib.crc32(it.files[it.damaged]) % MEASURED == 0
            tally["loaded"] += attempt(read, folder, measured, source)

        one()
        assert 0 < tally["loaded"] < tally["inputs"] >= count
        if EXAMPLES:
            with capsys.disabled():
                print(f"\n{name}: {tally['inputs']} inputs, {tally['loaded']} of them loaded ", end="")

    return run


# ---------------------------------------------------------------- motion


@pytest.fixture(scope="module")
def jesse():
    return character.load("jesse")


def check_clip(clip, char):
    """Shapes, numbers, and what is made of it."""
    n = len(clip)
    assert n and clip.pos.shape == (n, 15, 3) and clip.quat.shape == (n, 15, 4) and clip.ball.shape == (n, 2, 3)
    finite([clip.pos, clip.quat, clip.ball, clip.rate])
    np.testing.assert_allclose(np.linalg.norm(clip.quat, axis=-1), 1.0, atol=1e-6)
    pose = retarget.retarget(char, clip)
    finite([pose.qpos, pose.qvel, *sensors(clip)])


def reading_motion(char, name, joint_map=None):
    """What every command does with --motion FILE."""

    def read(folder):
        reading = Reading(str(folder / joint_map) if joint_map else None)
        for clip in load(folder / name, split="all", reading=reading):
            check_clip(clip, char)
            inspect.describe(clip)

    return read


def chain(joints, channels="CHANNELS 3 Zrotation Xrotation Yrotation"):
    """A BVH of joints in one chain."""
    opened = "\n".join(f"{'JOINT' if k else 'ROOT'} j{k} {{ OFFSET 0 1 0 {channels}" for k in range(joints))
    values = "0 " * int(channels.split()[1]) * joints
    return f"HIERARCHY\n{opened}{'}' * joints}\nMOTION\nFrames: 1\nFrame Time: 0.1\n{values}\n".encode()


@pytest.fixture(scope="module")
def bvh_files(tmp_path_factory):
    """The same walk in two rigs that are known and three that are guessed: rig -> bytes."""
    path, clip, out = tmp_path_factory.mktemp("bvh") / "take.bvh", walk(0.15), {}
    for rig in ("bandai", "lafan1", "mixamo", "smpl", "xsens"):
        write_as(path, rig, clip) if rig in rigs.RIGS else write_rig(path, clip, rig)
        out[rig] = re.sub(rb"(\.\d{4})\d+", rb"\1", path.read_bytes())
    return out


JOINT_MAP = b"""# a map
unit = "cm"
up = "y"
balls = ["LeftToe", "RightToe"]
[joints]
pelvis = "Hips"
head = 'Head'
thigh_l = "LeftHip"
hand_r = "RightWrist"
"""


@pytest.fixture(scope="module")
def cmu_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cmu")
    cmu_file(folder, [cmu_standing()] * 3)
    return {name: (folder / name).read_bytes() for name in ("16.asf", "16_01.amc")}


# ---------------------------------------------------------------- characters


def read_character(folder):
    """What every command does with --character FILE."""
    char = character.load(folder / "mini.toml")
    finite({f.name: getattr(char, f.name) for f in fields(char) if f.name not in ("ranges", "model")})
    assert char.hip_height > 0 and not np.isnan(char.ranges).any()
    m = char.model
    finite([m.qpos0, m.body_mass, m.body_inertia, m.body_pos, m.geom_size, m.jnt_range, m.actuator_gear])
    kinematics = retarget.forward_kinematics(char, m.qpos0)
    finite([kinematics.xpos, kinematics.xquat, kinematics.lowest])


MINI = {"mini.xml": b"""<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom contype="0" conaffinity="1" mass="1"/><joint range="-1.5 1.5"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" contype="1" conaffinity="0"/>
    <body name="hips" pos="0 0 0.5"><freejoint/><geom size="0.1"/>
      <body name="skull" pos="0 0 0.3"><joint name="head_y" axis="0 -1 0"/><joint name="head_z" axis="0 0 1"/>
        <geom type="box" size="0.05 0.06 0.07"/><site name="eyes"/></body>
      <body name="left" pos="0 0.1 -0.1"><joint name="leg_l_y" axis="0 1 0"/>
        <geom type="capsule" size="0.02" fromto="-0.1 0 -0.3 0.1 0 -0.3"/><site name="a"/></body>
      <body name="right" pos="0 -0.1 -0.1"><joint name="leg_r_y" axis="0 1 0"/>
        <geom type="capsule" size="0.02" fromto="-0.1 0 -0.3 0.1 0 -0.3"/><site name="b"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="leg_l_y"/><motor joint="leg_r_y"/><motor joint="head_y"/><motor joint="head_z"/></actuator>
  <sensor><touch name="tl" site="a"/><touch name="tr" site="b"/></sensor>
</mujoco>
""", "mini.toml": re.sub("(scale_z|tail_y) = .*\n", "", MINI_TOML).lstrip().encode()}  # fmt: skip


# ---------------------------------------------------------------- policies and runs

def check_policy(policy):
    finite([policy.theta_pi, policy.critic.theta, policy.norm.mean, policy.norm.inv_std, float(policy.value_scale)])
    finite(policy.mean_action(np.zeros((2, policy.obs_size))))


@pytest.fixture(scope="module")
def policy_file():
    policy = Policy(5, 7, 2, (4,), (3, 2), 0.1, 1.0, np.random.default_rng(0))
    policy.norm.update(np.random.default_rng(0).normal(size=(4, 7)))
    return npz_bytes(policy.arrays(), {"policy": policy.shape(), "steps": 5, "options": {"motion": "builtin"}})


@pytest.fixture(scope="module")
def trainer(jesse):
    """A small run: restored again and again."""
    opt = ppo.Options(envs=2, horizon=2, minibatch=4, hidden=(4,), value_hidden=(4,), threads=1)
    trainer = ppo.Trainer(opt, Env(jesse, retarget.reference(jesse, [walk(1.0)]), 2, 0, 1))
    trainer.start()
    trainer.collect()
    return trainer


@pytest.fixture(scope="module")
def run_files(trainer, tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "whole.npz"
    trainer.save(path, {"rows": 2, "options": asdict(trainer.opt)})
    config = {"config": asdict(trainer.opt) | {"data": {"minutes": 1.5}}, "versions": {}, "git": {}, "earlier": []}
    metrics = b"update,steps,reward,length\n1,4,0.5,nan\n2,8,,12.25\n"
    return {"config.json": json.dumps(config).encode(), "metrics.csv": metrics, "checkpoint.npz": path.read_bytes()}


def resuming(trainer):
    """What `ppo.py --resume` reads before it goes on."""

    def read(folder):
        runs.check_run(folder, resume=True)
        opt = training.resumed_options(ppo.Options(out=str(folder), resume=True), ["--resume"])
        for f in fields(opt):
            kinds = {type(f.default), type(None)} | ({int} if type(f.default) is float else set())
            assert f.default is None or type(getattr(opt, f.name)) in kinds, f.name
        loaded = runs.latest_checkpoint(folder, ppo.FINITE)
        columns = runs.read_metrics(folder / runs.METRICS)
        assert len({len(c) for c in columns.values()}) <= 1
        if loaded:
            trainer.restore(*loaded, folder / runs.CHECKPOINT)
            check_policy(trainer.policy)
            finite([trainer.adam_pi.m, trainer.adam_pi.v, trainer.adam_v.v, trainer.adam_pi.lr, trainer.env.full])
            assert trainer.steps >= 0 and trainer.updates >= 0 and trainer.adam_pi.t >= 0

    return read


# ---------------------------------------------------------------- headsets


@pytest.fixture(scope="module")
def csv_files():
    """A little more than the second that calibrates, of a standing user at 20 Hz: axes -> bytes."""
    t, pos, quat = zip(*standing(1.3, rate=20.0))
    return {axes: re.sub(r"(\.\d{4})\d+", r"\1", "".join(to_csv(t, pos, quat, axes))).encode() for axes in AXES}


@pytest.fixture(scope="module")
def bsor_files():
    """The same as a replay: with notes and a pause; of an old mod, with names that are longer than they say."""
    rows = framed(rows_of(1.3, 20.0))
    names = {"player_name": "Zoë", "song": "夜に駆ける", "mapper": "é"}
    return [written(rows, pauses=[(1.1, 1)]), written(rows, names, units=True)]


def playing(char, live, file="take.csv"):
    """What `play.py --stream` does, with a policy that does nothing."""
    player = Player(char, lambda obs: np.zeros((1, len(char.limits))))

    def read(folder):
        name = "-" if live else folder / file
        if not live:
            choice = choose(name)
            finite([v for v in choice[1:3] if v is not None])
            choose(name, "openxr", unit=0.01)
        source = calibration.Stream(char, (folder / "axes").read_text())
        with pytest.MonkeyPatch.context() as patch:
            if live:
                patch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO((folder / file).read_bytes())))
            ticks = (tick for sample in opened(name, strict=not live)[1] for tick in source.push(sample))
            for k, tick in enumerate(ticks):
                finite(list(tick))
                np.testing.assert_allclose(np.linalg.norm(tick.quat, axis=-1), 1.0, atol=1e-6)
                if k < 20:
                    player.step(tick.pos[None], tick.quat[None])
                    finite([player.qpos, player.qvel, player.obs])
        assert len(source.seen) <= 1000
        source.report()

    return read


# ---------------------------------------------------------------- the tests


@pytest.fixture(scope="module")
def readers(jesse, bvh_files, cmu_files, policy_file, trainer, run_files, csv_files, bsor_files):
    """name -> valid folders, as {file: bytes}; the function that reads one; the strategies of damage to its files"""
    text = lambda *names: {name: damaged for name in names}  # noqa: E731
    deep_bvh = lambda raw: damaged(raw, inserting(chain(50)))  # noqa: E731
    deep_xml = lambda raw: damaged(raw, inserting(b'<body name="b">' * 1000))  # noqa: E731
    take = {axes: {"take.csv": raw, "axes": axes.encode()} for axes, raw in csv_files.items()}
    read_policy = lambda folder: check_policy(load_policy(folder / "p.npz")[0])  # noqa: E731
    resumed = {"config.json": lambda raw: json_damage(json.loads(raw)), "metrics.csv": damaged}
    return {
        "bvh": ([{"take.bvh": raw} for raw in bvh_files.values()], reading_motion(jesse, "take.bvh"),
                {"take.bvh": deep_bvh}),
        "amc": ([cmu_files], reading_motion(jesse, "16_01.amc"), text("16.asf", "16_01.amc")),
        "map": ([{"take.bvh": bvh_files["xsens"], "map.toml": JOINT_MAP}],
                reading_motion(jesse, "take.bvh", "map.toml"), text("map.toml")),
        "toml": ([MINI], read_character, text("mini.toml")),
        "xml": ([MINI], read_character, {"mini.xml": deep_xml}),
        "policy": ([{"p.npz": policy_file}], read_policy, {"p.npz": npz_damage}),
        "run": ([run_files], resuming(trainer), resumed | {"checkpoint.npz": npz_damage}),
        "stream": (list(take.values()), playing(jesse, live=False), text("take.csv")),
        "replay": ([{"take.bsor": raw, "axes": b"unity"} for raw in bsor_files],
                   playing(jesse, live=False, file="take.bsor"), {"take.bsor": bsor_damage}),
        "stdin": ([take["unity"]], playing(jesse, live=True), text("take.csv")),
    }  # fmt: skip


def test_bvh(fuzz, readers):
    fuzz(*readers["bvh"])


def test_asf_and_amc(fuzz, readers):
    fuzz(*readers["amc"])


def test_joint_maps(fuzz, readers):
    fuzz(*readers["map"])


def test_character_tables(fuzz, readers):
    fuzz(*readers["toml"])


def test_character_models(fuzz, readers):
    fuzz(*readers["xml"])


def test_policies(fuzz, readers, tmp_path):
    fuzz(*readers["policy"])
    assert not (tmp_path / "unpickled").exists()


def test_run_folders(fuzz, readers):
    fuzz(*readers["run"])


def test_headset_files(fuzz, readers):
    fuzz(*readers["stream"])


def test_replays(fuzz, readers):
    fuzz(*readers["replay"])


def test_standard_input(fuzz, readers):
    fuzz(*readers["stdin"], source="standard input")


# ---------------------------------------------------------------- what is meant to hurt


def deep_head(raw, joints=10_000):
    """The skeleton of a known rig with so many joints hanging from its head, one from the other."""
    opened = b"".join(b"JOINT x%d { OFFSET 0 1 0 CHANNELS 1 Xrotation " % k for k in range(joints))
    at = raw.index(b"End Site", raw.index(b"JOINT Head"))
    hierarchy, motion = (raw[:at] + opened + b"}" * joints + raw[at:]).split(b"MOTION")
    rows = motion.strip().split(b"\n")
    return b"%sMOTION\nFrames: 1\n%s\n%s" % (hierarchy, rows[1], rows[2] + b" 0" * joints)


def fixed_joints(frames=20_000):
    """One joint that turns, a thousand that do not, and many frames: small to read, large to pose."""
    text = chain(1000, "CHANNELS 0").replace(b"CHANNELS 0", b"CHANNELS 1 Xrotation", 1)
    return re.sub(rb"Frames: 1\n(.*)\n\n", rb"Frames: %d\n\1\n" % frames + b"0\n" * frames, text)


def nanoseconds(raw, rows=1100):
    """A stream whose clock hardly runs: the second that calibrates never ends."""
    lines = raw.split(b"\n")
    still = [re.sub(rb"^[^,]*", b"%.9f" % (2e-9 * k), lines[1 + k % 20]) for k in range(rows)]
    return b"\n".join([lines[0], *still])


def dotted(parts):
    return b".".join([b"a"] * parts) + b" = 1\n"


def overlapping(raw, times=1000):
    """An .npz whose directory names one member so many times."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        start = archive.start_dir
    directory, end = raw[start : raw.index(b"PK\x05\x06", start)], raw[raw.index(b"PK\x05\x06", start) :]
    first = directory[: directory.index(b"PK\x01\x02", 4)]
    end = end[:8] + struct.pack("<HHLL", times, times, len(first) * times, start) + end[20:]
    return raw[:start] + first * times + end


def drop_outs(raw, rows=6):
    """A stream whose clock runs 4.9 s on with every row."""
    lines = raw.split(b"\n")
    moving = [re.sub(rb"^[^,]*", b"%.1f" % (2 + 4.9 * k), lines[1 + k % 20]) for k in range(rows)]
    return b"\n".join([*lines[:-1], *moving])


def bones(raw, count=10_000):
    """A chain of so many bones more, none of which moves."""
    rows = b"".join(b"begin\nname b%d\ndirection 0 1 0\nlength 1\naxis 0 0 0 XYZ\nend\n" % k for k in range(count))
    tree = b"".join(b"b%d b%d\n" % (k, k + 1) for k in range(count - 1))
    return raw.replace(b":hierarchy\nbegin\n", rows + b":hierarchy\nbegin\nroot b0\n" + tree)


def swap(old, new):
    return lambda raw: raw.replace(old, new)


def in_world(text):
    return swap(b"<worldbody>", b"<worldbody>" + text)


BIG = b"1" * 200_000
HURTING = {  # name: (reader, file, function of the valid file's bytes, whether it loads)
    "a million frames": ("bvh", "take.bvh", swap(b"Frames: 4", b"Frames: 1000000"), False),
    "10^12 frames": ("bvh", "take.bvh", swap(b"Frames: 4", b"Frames: 1000000000000"), False),
    "10,000 joints deep": ("bvh", "take.bvh", lambda raw: chain(10_000), False),
    "10,000 joints deep in a known rig": ("bvh", "take.bvh", deep_head, True),
    "joints that cannot move": ("bvh", "take.bvh", lambda raw: fixed_joints(), False),
    "a frame of eleven days": ("bvh", "take.bvh", swap(b"Time: 0.0333", b"Time: 1e6"), False),
    "a name of a megabyte": ("bvh", "take.bvh", swap(b"Hand_L", b"H" * 2**20), False),
    "a line of five megabytes": ("bvh", "take.bvh", swap(b"\nMOTION", b" " * 5 * 2**20 + b"\nMOTION"), True),
    "bones that cannot move": ("amc", "16.asf", bones, False),
    "a frame of number 10^18": ("amc", "16_01.amc", swap(b"\n11\n", b"\n%d\n" % 10**18), False),
    "a map of brackets": ("map", "map.toml", lambda raw: b"unit = " + b"[" * 10_000, False),
    "a map of dots": ("map", "map.toml", lambda raw: dotted(30_000), False),
    "a map of lines of dots": ("map", "map.toml", lambda raw: dotted(480) * 60, False),
    "a map of a table of dots": ("map", "map.toml", lambda raw: b"[a%s]\n" % (b".a" * 490) + b"a.b=1\n" * 9000, False),
    "a map of ten megabytes": ("map", "map.toml", lambda raw: b"#\n" * 5_000_000, False),
    "a site 10^9 times": ("xml", "mini.xml", in_world(b'<replicate count="1e9"><site/></replicate>'), False),
    "a site 100^3 times": ("xml", "mini.xml", in_world(b'<replicate count="100">' * 3 + b"</replicate>" * 3), False),
    "a texture of 10^10 pixels": (
        "xml", "mini.xml",
        swap(b"<default>", b'<asset><texture builtin="flat" width="100000" height="100000"/></asset><default>'), False,
    ),
    "a model that includes itself": ("xml", "mini.xml", in_world(b'<include file="mini.xml"/>'), False),
    "entities of entities": (
        "xml", "mini.xml", lambda raw: b'<!DOCTYPE m [<!ENTITY a "a"><!ENTITY b "&a;&a;">]>' + raw, False,
    ),
    "a policy of 10^12 numbers": ("policy", "p.npz", lambda raw: zipped([("a.npy", claiming(*CLAIMS[0]))]), False),
    "a policy deflated": ("policy", "p.npz", lambda raw: zipped([("a.npy", npy(np.zeros(2**26, "u1")))], (0,)), False),
    "a member a thousand times": ("policy", "p.npz", overlapping, False),
    "20,000 members": ("policy", "p.npz", lambda raw: zipped([(f"{k}.npy", b"") for k in range(20_000)]), False),
    "JSON 100,000 deep": ("run", "config.json", lambda raw: b'{"config": ' + b"[" * 100_000, False),
    "JSON whole and deep": ("run", "config.json", lambda raw: b"[" * 900 + b"]" * 900, False),
    "an integer of 200,000 digits": ("run", "config.json", lambda raw: b'{"config": {"seed": %s}}' % BIG, False),
    "a cell of 200,000 digits": ("run", "metrics.csv", lambda raw: b"a,b\n1,%s\n" % BIG, False),
    "200,000 columns": ("run", "metrics.csv", lambda raw: b"a," * 200_000 + b"b\n", False),
    "a stream of drop-outs": ("stream", "take.csv", drop_outs, True),
    "a stream of nanoseconds": ("stream", "take.csv", nanoseconds, False),
    "a replay of 2^31 frames": (
        "replay", "take.bsor", lambda raw: raw.replace(struct.pack("<i", 26), struct.pack("<i", 2**31 - 1)), False,
    ),
    "a replay of names without end": (
        "replay", "take.bsor", lambda raw: raw[:6] + b"\xff\0\0\0" + "é".encode() * 9999, False,
    ),
    "a replay of pauses": (
        "replay", "take.bsor", lambda raw: written(framed(rows_of(1.3)), pauses=[(1.2, 2)] * 2000), True,
    ),
    "a stream in one line": ("stream", "take.csv", lambda raw: raw.replace(b"\n", b",") * 100, False),
}  # fmt: skip


@pytest.mark.parametrize("case", HURTING)
def test_what_is_meant_to_hurt(readers, tmp_path, case):
    """Claims, bombs, depth and length: within the deadline, and in little memory."""
    reader, name, raw, loads = HURTING[case]
    files, read, _ = readers[reader]
    raw = raw(files[0][name]) if callable(raw) else raw
    assert raw != files[0][name]
    Input(files[0] | {name: raw}).write(tmp_path)
    assert attempt(read, tmp_path, measured=len(raw) < 10_000 and reader != "stream") == loads


FILES = ("bvh take.bvh", "amc 16.asf", "amc 16_01.amc", "map map.toml", "toml mini.toml", "xml mini.xml",
         "policy p.npz", "run config.json", "run metrics.csv", "run checkpoint.npz", "stream take.csv",
         "replay take.bsor")  # fmt: skip


@pytest.mark.parametrize("what", ["folder", "empty", "gone", "zeros"])
@pytest.mark.parametrize("file", FILES)
def test_no_such_file(readers, tmp_path, file, what):
    """A folder in a file's place, an empty file, none, and one of zeros."""
    reader, name = file.split()
    files, read, _ = readers[reader]
    Input(files[0]).write(tmp_path)
    (tmp_path / name).unlink()
    if what == "folder":
        (tmp_path / name).mkdir()
    elif what != "gone":
        (tmp_path / name).write_bytes(bytes(1000) if what == "zeros" else b"")
    nothing = {("checkpoint.npz", "gone"), ("metrics.csv", "empty"), ("metrics.csv", "zeros"), ("map.toml", "empty")}
    assert attempt(read, tmp_path, True, name) == ((name, what) in nothing)

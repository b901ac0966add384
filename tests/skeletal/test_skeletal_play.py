"""skeletal/layers.py's four commands as a user meets them, and what they write."""

import json
import signal
from dataclasses import replace

import numpy as np
import pytest
from test_skeletal_data import write_rig
from test_skeletal_train import BODY, NAMES, small_trainer, walk

from human import quat_conj, quat_mul
from mocap import bvh
from mocap import data as motions
from plumbing.cli import UserError, run_main
from plumbing.runs import CHECKPOINT, load_checkpoint, read_metrics, save_checkpoint
from skeletal import autoencode, data, pictures, play, train
from skeletal.__main__ import main


def run(*args):
    """The exit code of `python -m skeletal ARGS`, run in this process."""
    with pytest.raises(SystemExit) as end:
        run_main(main, [str(a) for a in args])
    return end.value.code


@pytest.fixture(scope="module")
def trained(tmp_path_factory, clips):
    """A run of two steps on the built-in human, and its prepared windows."""
    at = tmp_path_factory.mktemp("skeletal")
    args = "train --clips x --limit 2 --characters 1 --batch 2 --steps 2".split()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(motions, "load", lambda *a, **k: CLIPS)
        assert run(*args, "--data", at / "windows.npz", "--out", at / "run") == 0
    return at


@pytest.fixture(scope="module", autouse=True)
def clips(motions_once):
    """Three short built-in clips stand for all of them."""
    global CLIPS
    CLIPS = [c[:66] for c in motions.builtin_clips() if c.name.startswith("walk")][:3]


def test_help(capsys):
    assert run("--help") == 0 and "autoencode" in capsys.readouterr().out
    for command in play.COMMANDS:
        assert run(command, "--help") == 0
        assert "default" in capsys.readouterr().out
    assert run() == 2 and "valid: train, correct, autoencode, retarget, measure, families" in capsys.readouterr().err
    assert run("fly") == 2 and "'fly'" in capsys.readouterr().err


def test_train_command(trained, capsys, tmp_path):
    """A run folder with metrics and a checkpoint; it goes on where it was; the windows are read again."""
    out = trained / "run"
    assert read_metrics(out / "metrics.csv")["step"].tolist() == [2]
    arrays, meta = load_checkpoint(out / CHECKPOINT)
    assert meta["steps"] == 2 and {"generator0", "critic1", "adam3.m", "offsets1", "std0"} <= set(arrays)
    again = train.prepared(train.TrainOptions(data=str(trained / "windows.npz")))
    assert len(again[0].windows) and np.array_equal(again[1].mean, arrays["mean1"])
    x = again[0].sample(np.random.default_rng(0), 3)[0]
    assert x.shape == (7 + 4 * 16, train.WINDOW, 3) and x.dtype == np.float32
    assert run("train", "--resume", "--out", out, "--steps", 3) == 0
    assert load_checkpoint(out / CHECKPOINT)[1]["steps"] == 3 and "3/3 steps" in capsys.readouterr().out
    assert run("train", "--resume", "--out", out, "--batch", 9) == 2
    assert "was started with --batch 2; to resume, leave it out" in capsys.readouterr().err
    assert run("train", "--out", out) == 2 and "add --resume" in capsys.readouterr().err
    assert run("train", "--a", tmp_path, "--out", tmp_path / "x") == 2 and "--a and --b" in capsys.readouterr().err
    assert run("train", "--steps", 0) == 2 and not (tmp_path / "x").exists()


def test_interrupt(trained, capsys, tmp_path, monkeypatch):
    """Ctrl-C in the second step: a checkpoint after it, how to go on, and --resume goes on to the same --steps."""
    out, step, calls = tmp_path / "run", train.Trainer.step, []

    def press(self):
        calls.append(1)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGINT)
        return step(self)

    monkeypatch.setattr(train.Trainer, "step", press)
    options = ["--data", trained / "windows.npz", "--out", out, "--batch", 2]
    assert run("train", *options, "--steps", 3) == 0
    assert load_checkpoint(out / CHECKPOINT)[1]["steps"] == 2
    assert (
        f"stopped at 2 steps; continue with: python -m skeletal train --resume --out {out}" in capsys.readouterr().out
    )
    assert run("train", "--resume", "--out", out) == 0
    assert load_checkpoint(out / CHECKPOINT)[1]["steps"] == 3 and len(calls) == 3


def test_nothing_read_is_overwritten(trained, tmp_path, capsys):
    """The source, the target and the weights stay; a read-only file, too; folders for sheets are asked for first."""
    a, b = tmp_path / "a.bvh", tmp_path / "b.bvh"
    data.write_motion(a, data.human_motion(CLIPS[0]), play.Retargeter(trained / "run").domains[0].structure)
    b.write_bytes(a.read_bytes())
    kept = tmp_path / "kept.bvh"
    kept.write_text("mine")
    kept.chmod(0o444)
    before = a.read_bytes()
    for out, why in ((a, "read from"), (b, "read from"), (tmp_path / "." / "a.bvh", "read from"), (kept, "read-only")):
        assert run("retarget", "--weights", trained / "run", "--source", a, "--target", b, "--out", out) == 2
        assert f"cannot write {out}: it is {why}" in capsys.readouterr().err
    assert a.read_bytes() == before == b.read_bytes() and kept.read_text() == "mine"
    assert run("families", "--weights", trained / "run", "--png", tmp_path / "none" / "b") == 2
    assert "cannot make the folder" in (said := capsys.readouterr()).err and "copy" not in said.out


def test_ship_and_load(trained, tmp_path):
    """Generators, characters, statistics and the licence; no optimiser, no critic; the same answers."""
    assert run("train", "--out", trained / "run", "--ship", tmp_path / "s.npz") == 0
    arrays, meta = load_checkpoint(tmp_path / "s.npz")
    assert meta["licence"] == "MIT" and not any(k.startswith(("adam", "critic", "pool")) for k in arrays)
    a, b = play.Retargeter(trained / "run"), play.Retargeter(tmp_path / "s.npz")
    m = data.human_motion(CLIPS[0])
    target = a.domains[1].characters[0]
    np.testing.assert_array_equal(a(m, 0, target, 1).quat, b(m, 0, target, 1).quat)
    save_checkpoint(tmp_path / "bad.npz", {"generator0": np.zeros(3)}, {})
    with pytest.raises(UserError, match="no skeletal checkpoint"):
        play.Retargeter(tmp_path / "bad.npz")
    with pytest.raises(UserError, match="no checkpoint"):
        play.Retargeter(tmp_path)


def test_licence_is_the_motions(trained, tmp_path, clips):
    """Weights have the licence of the folders they come from, also of --a and --b, and by way of --data."""
    arrays, meta = load_checkpoint(trained / "run" / CHECKPOINT)
    for k, title in (("a", "CC0"), ("b", "Non-commercial")):
        (tmp_path / k).mkdir()
        (tmp_path / k / "LICENSE.txt").write_text(title + "\nmore\n")
    opt = train.TrainOptions(a=str(tmp_path / "a"), b=str(tmp_path / "b"))
    assert train.origins(train.TrainOptions()) == ["builtin"] and train.origins(opt) == [opt.a, opt.b]
    save_checkpoint(tmp_path / "windows.npz", {}, {"motions": train.origins(opt)})
    found = train.origins(train.TrainOptions(data=str(tmp_path / "windows.npz")))
    (tmp_path / "run").mkdir()
    save_checkpoint(tmp_path / "run" / CHECKPOINT, arrays, meta | {"motions": found})
    meta = train.ship(tmp_path / "run", tmp_path / "s.npz")
    assert meta["licence"] == "weights trained on a, licensed: CC0; on b, licensed: Non-commercial"
    assert meta["motion"] == "a, b" and str(tmp_path) not in str(load_checkpoint(tmp_path / "s.npz")[1])


def test_retargeter_any_length(trained):
    """Whole clips of any length, even shorter than a window; the heading and the path in legs are the source's."""
    net = play.Retargeter(trained / "run")
    m = data.human_motion(CLIPS[0])
    for n in (5, 33, 66):
        target = net.domains[1].characters[0]
        out = net(m[:n], 0, target, 1)
        np.testing.assert_allclose(out.pos / target.leg, m.pos[:n] / m.skeleton.leg, atol=1e-5)
        assert len(out) == n and np.isfinite(out.pos).all()
        np.testing.assert_allclose(np.linalg.norm(out.quat, axis=-1), 1.0)


def test_retarget_command(trained, tmp_path, capsys):
    """Onto a trained character and onto a file, and what is written can be read again; bad input is one line."""
    net = play.Retargeter(trained / "run")
    motion = data.human_motion(CLIPS[0])
    data.write_motion(tmp_path / "a.bvh", motion, net.domains[0].structure)
    common = ("retarget", "--weights", trained / "run", "--source", tmp_path / "a.bvh", "--up", "z")
    assert run(*common, "--target", "B/0", "--out", tmp_path / "b.bvh") == 0
    assert "structure A -> B" in capsys.readouterr().out
    b = bvh.read(tmp_path / "b.bvh")
    assert set(b.names) == set(net.domains[1].names) and len(b.values) == 66
    assert run(*common, "--target", tmp_path / "b.bvh", "--out", tmp_path / "c.bvh", "--no-clean") == 0
    assert set(bvh.read(tmp_path / "c.bvh").names) == set(net.domains[1].names)
    for args, says in (
        ((*common, "--target", "B/9", "--out", tmp_path / "d.bvh"), "B/0 to B/0"),
        (common, "give --source"),
        ((*common[:3], "--source", tmp_path / "no.bvh", "--target", "B/0", "--out", tmp_path / "d.bvh"), "no.bvh"),
        ((*common, "--target", "B/0", "--out", tmp_path / "no" / "d.bvh"), "cannot write"),
    ):
        capsys.readouterr()
        assert run(*args) == 2
        err = capsys.readouterr().err
        assert says in err and err.count("\n") == 1
    write_rig(tmp_path / "rig.bvh", walk(70))
    assert run(*common[:3], "--source", tmp_path / "rig.bvh", "--target", "B/0", "--out", tmp_path / "d.bvh") == 2
    assert "no trained structure has its joints, hips" in capsys.readouterr().err
    assert not (tmp_path / "d.bvh").exists()


def test_pictures(trained, tmp_path):
    m = data.human_motion(CLIPS[0])
    try:
        pictures.draw([m, m], ["a", "b"], tmp_path / "s.png", None, 1.0)
    except UserError as e:
        pytest.skip(f"no software OpenGL: {e}")
    assert (tmp_path / "s.png").stat().st_size > 5000


def test_own_folders(tmp_path):
    """Two rigs of a user's own, joints in another order, frames and rest poses of their own: trained on as they are."""
    other = data.derive(BODY)
    order = [0, *range(3, 8), 1, 2, *range(8, 13)]  # left leg before the trunk
    names = tuple(other.names[j] for j in order)
    assert names[1].startswith("thigh") and len(order) == len(other.names)
    at = {j: i for i, j in enumerate(order)}
    parents = (-1, *(at[other.parents[j]] for j in order[1:]))
    mixed = data.Skeleton(names, parents, other.offsets[order], tuple(at[f] for f in other.feet))
    for k, s in enumerate((BODY, mixed)):
        (tmp_path / str(k)).mkdir()
        frames = None
        for i in range(2):
            frames = write_rig(tmp_path / str(k) / f"{i}.bvh", walk(70, s, i), frames, seed=k)
    opt = train.TrainOptions(a=str(tmp_path / "0"), b=str(tmp_path / "1"), batch=2)
    domains = train.own_folders(opt)
    assert domains[0].names == NAMES and domains[1].names == other.names
    assert [domains[0].names[e] for e in domains[0].ends] == [domains[1].names[e] for e in domains[1].ends]
    tr = train.Trainer(opt, domains, channels=(2, 3))
    assert np.isfinite(list(tr.step().values())).all()
    # The second rig's joints, put into the first one's order, move as they did.
    m = data.folder(tmp_path / "1")[1][1]
    x, turn = data.features(m)
    names = ("root", *m.skeleton.names[1:])
    got = domains[1].arrays[2][1]  # the second file's, forwards
    for j, n in enumerate(domains[1].names):
        k = names.index(n) if j else 0
        np.testing.assert_allclose(got[:, 3 + 4 * j : 7 + 4 * j], x[:, 3 + 4 * k : 7 + 4 * k], atol=1e-6)
    write_rig(tmp_path / "1" / "2.bvh", walk(90, mixed, 2), frames)
    chosen = train.own_folders(train.replace(opt, limit=2))[1].arrays  # evenly chosen: the first and the last of three
    assert sorted({len(x) for _, x, _ in chosen}) == [70, 90]
    (tmp_path / "2").mkdir()
    short = data.Skeleton(NAMES[:7], (-1, 0, 1, 0, 3, 4, 5), BODY.offsets[:7], (6,))
    write_rig(tmp_path / "2" / "a.bvh", walk(70, short))
    with pytest.raises(UserError, match="no common primal skeleton"):
        train.own_folders(train.TrainOptions(a=str(tmp_path / "0"), b=str(tmp_path / "2")))


def test_families_are_unpaired(monkeypatch):
    """No clip is on two characters; the first character is the actor."""
    monkeypatch.setattr(motions, "load", lambda *a, **k: CLIPS[:2])
    seen = []
    monkeypatch.setattr(train, "truth", lambda m, c: seen.append(m.name) or data.truth(m, c))
    a, b = train.families(train.TrainOptions(characters=1))
    assert len(a.arrays) == len(b.arrays) == 2 and len(seen) == 1  # one clip each, both ways in time
    assert len(b.names) == len(data.derive(a.characters[0]).names)


def test_measure_command(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(motions, "load", lambda *a, **k: CLIPS[:1])
    assert run("families", "--weights", trained / "run", "--json", tmp_path / "m.json") == 0
    r = json.loads((tmp_path / "m.json").read_text())
    assert {"cross", "intra", "copy_cross", "copy_intra", "cross_clean", "slide", "slide_clean"} <= set(r)
    assert r["copy_cross"] == min(v["cross"] for v in r["rows"]["copies"].values()) > 0
    assert r["cross"] > 10 * r["copy_cross"]  # two steps do not teach anything
    assert r["slide_clean"] < r["slide"] and "copy (names" in capsys.readouterr().out


def test_contacts_are_the_sources(trained, tmp_path, monkeypatch, capsys):
    """Feet that stand in the source must stand in the result, which cannot excuse itself by sliding all the time."""
    m = data.human_motion(CLIPS[0])
    way = np.outer(np.arange(len(m)) / data.RATE, [2.0, 0.0, 0.0])  # 2 m/s: no foot of it stands
    skating = lambda net, m, *_: replace(m, pos=m.pos + way)  # noqa: E731
    monkeypatch.setattr(play.Retargeter, "__call__", skating)
    net, standing = play.Retargeter(trained / "run"), data.contacts(m)
    assert standing.any() and not data.contacts(net(m)).any()
    row = play.errors([("intra", 0, m, 0, m)], net)
    assert row["slide"] == pytest.approx(100 * data.sliding(net(m), standing)) and row["slide"] > 150
    assert row["slide_clean"] < 0.9 * row["slide"] and row["slide_true"] < 50
    data.write_motion(tmp_path / "a.bvh", m, net.domains[0].structure)
    files = ("--source", tmp_path / "a.bvh", "--target", tmp_path / "a.bvh", "--out", tmp_path / "b.bvh", "--up", "z")
    assert run("retarget", "--weights", trained / "run", *files) == 0
    before, after = capsys.readouterr().out.partition("feet slide ")[2].split(" cm/s, after the clean-up ")
    assert float(before) > 150 and float(after.partition(";")[0]) < 0.9 * float(before)


def test_shifted_copy(trained):
    """With the same statistics on both sides it is the copy; a joint by the equation."""
    net = play.Retargeter(trained / "run")
    m, (A, B) = data.human_motion(CLIPS[0]), net.domains
    same = play.shifted_copy(net, m, 0, m.skeleton, 0)
    np.testing.assert_allclose(data.pose(same)[0], data.pose(m)[0], atol=1e-4)
    target, j = B.characters[0], B.names.index(A.names[-1])
    x, _ = data.features(data.copy_rotations(m, target, "global"))
    a, b = slice(3 + 4 * (len(A.names) - 1), 7 + 4 * (len(A.names) - 1)), slice(3 + 4 * j, 7 + 4 * j)
    q = (x[:, b] - A.mean[0, a]) / A.std[0, a] * B.std[0, b] + B.mean[0, b]
    got = play.shifted_copy(net, m, 0, target, 1)
    angle = quat_mul(quat_conj(got.quat[:, j]), q / np.linalg.norm(q, axis=1, keepdims=True))
    np.testing.assert_allclose(np.abs(angle[:, 0]), 1.0, atol=1e-5)
    np.testing.assert_allclose(got.pos / target.leg, m.pos / m.skeleton.leg, atol=1e-5)


def test_sheets(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(motions, "load", lambda *a, **k: CLIPS[:1])
    net = play.Retargeter(trained / "run")
    opt = play.FamilyOptions(png=str(tmp_path), sheets=1, every=1.0)
    try:
        play.sheets(play.held_out(opt, net), net, opt)
    except UserError as e:
        pytest.skip(f"no software OpenGL: {e}")
    assert [p.stat().st_size > 5000 for p in tmp_path.glob("*-AB.png")] == [True]


def test_noise():
    opt = autoencode.AutoOptions(zeros=0.25)
    x = np.ones((400, 7 + 4 * 4), np.float32)
    r = np.random.default_rng(0)
    g = autoencode.noisy(x, "gaussian", opt, r) - x
    assert g[:, 3:].std() == pytest.approx(0.01, rel=0.05) and not g[:, :3].any()
    z = autoencode.noisy(x, "zeros", opt, r)
    q = z[:, 3:].reshape(400, 5, 4)
    assert np.all((q == 0).all(-1) | (q == 1).all(-1)) and (q == 0).mean() == pytest.approx(0.25, abs=0.04)
    assert np.array_equal(autoencode.noisy(x, "clean", opt, r), x)


def test_autoencode_command(tmp_path, monkeypatch, capsys):
    """Both networks learn; a finished network is not trained again."""
    monkeypatch.setattr(motions, "load", lambda *a, **k: CLIPS)
    args = (
        "autoencode",
        "--steps",
        8,
        "--batch",
        4,
        "--seeds",
        0,
        "--out",
        tmp_path / "a",
        "--json",
        tmp_path / "a.json",
    )
    assert run(*args) == 0
    first = json.loads((tmp_path / "a.json").read_text())
    assert {f"{k}_{n}" for k in ("skeletal", "plain") for n in ("clean", "gaussian", "zeros")} <= set(first)
    assert first["skeletal_zeros"] > first["skeletal_clean"] > 0
    assert {"style_input_zeros", "style_plain_gaussian_0", "style_mean_pose"} <= set(first)
    capsys.readouterr()
    assert run(*args, "--resume") == 0 and "steps skeletal" not in capsys.readouterr().out
    assert json.loads((tmp_path / "a.json").read_text()) == first
    again = ("autoencode", "--resume", "--out", tmp_path / "a")  # the options of the run are its own
    assert run(*again, "--held", 1, "--json", tmp_path / "b.json") == 0 and "steps plain" not in capsys.readouterr().out
    assert json.loads((tmp_path / "b.json").read_text())["curves"] == first["curves"]
    assert run(*again, "--batch", 4) == 0
    assert run(*again, "--batch", 5) == 2
    assert "was started with --batch 4; to resume, leave it out" in capsys.readouterr().err


def test_held_out_without_a_style(monkeypatch):
    """A folder of which no style is held out is measured on its held-out clips alone."""
    opt = autoencode.AutoOptions(held=2)
    monkeypatch.setattr(motions, "load", lambda *a, **k: CLIPS)
    assert {k: len(v) for k, v in autoencode.held_out(opt).items()} == {"": 2, "style_": 2}

    def load(*a, split="all", **k):
        if split == "style":
            raise UserError("no clip")
        return CLIPS

    monkeypatch.setattr(motions, "load", load)
    assert list(autoencode.held_out(opt)) == [""]


def test_small_trainer_is_small():
    """The fixture of the gradient tests has two structures whose latents fit."""
    tr = small_trainer()
    assert tr.nets[0].n_latent == tr.nets[1].n_latent and len(tr.domains[0].names) < len(tr.domains[1].names)

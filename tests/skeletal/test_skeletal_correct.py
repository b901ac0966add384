"""skeletal/correct.py and skeletal/measure.py: corrections of copies between rigs, and what they gain."""

import importlib.util
import json
from dataclasses import replace

import numpy as np
import pytest

import character
from human import quat_about, quat_mul
from mocap import bvh
from mocap import data as captures
from plumbing.cli import UserError, cli, run_main
from plumbing.runs import load_checkpoint, save_checkpoint
from retarget import retarget, write_bvh
from skeletal import correct, data, measure, play, rigs
from skeletal.__main__ import main


def run(*args):
    with pytest.raises(SystemExit) as end:
        run_main(main, [str(a) for a in args])
    return end.value.code


def options(*args):
    return cli(correct.CorrectOptions, [str(a) for a in args], "correct", "")


@pytest.fixture(scope="module", autouse=True)
def clips():
    """Six short built-in clips stand for all of them."""
    kept = [c[:70] for c in captures.builtin_clips() if c.name.startswith("walk")][:6]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(captures, "load", lambda *a, **k: kept)
        yield kept


@pytest.fixture(scope="module")
def sides(clips):
    return correct.gather(options("--rigs", "human,dino"))


@pytest.fixture(scope="module")
def trained(tmp_path_factory, clips):
    out = tmp_path_factory.mktemp("correct") / "run"
    assert run("correct", "--rigs", "human,dino", "--steps", 2, "--batch", 2, "--seeds", "0,1", "--out", out) == 0
    return out


def test_gather_is_unpaired(sides):
    """No clip is on two rigs; people have no anchor, a bent-over Dino has one."""
    names = [{m.name for _, m in s.clips} for s in sides]
    assert all(names) and not names[0] & names[1]
    assert not sides[0].anchor.any() and np.abs(sides[1].anchor).max() > 0.2
    with pytest.raises(UserError, match="needs captures; give --motion"):
        correct.gather(options("--rigs", "human,bandai"))
    with pytest.raises(UserError, match="wolf: no such rig"):
        correct.gather(options("--rigs", "human,wolf"))
    for given in ("human", "dino,dino"):
        with pytest.raises(UserError, match="one rig, or one twice; valid: two or more"):
            correct.gather(options("--rigs", given))


def test_limbs(sides, clips):
    """A limb's bones add up to the way from shoulder to hand, from hip to ball and from the pelvis to the head."""
    s = sides[0]
    m = s.clips[0][1]
    p = data.pose(m)[0]
    bones = p - p[:, np.maximum(m.skeleton.parents, 0)]
    v = np.einsum("ej,tjc->tec", s.limbs, bones)
    at = {n: j for j, n in enumerate(s.names)}
    ends = {s.names[e]: k for k, e in enumerate(s.ends)}
    for end, base in (("hand_l", "upper_arm_l"), ("ball_r", "thigh_r"), ("head", "pelvis")):
        np.testing.assert_allclose(v[:, ends[end]], p[:, at[end]] - p[:, at[base]], atol=1e-6)


def test_starts_at_the_copy(sides):
    """Before the first step the network is the copy of rotations, and shifted is that in the target's statistics."""
    tr = correct.Corrector(options("--rigs", "human,dino", "--batch", 2), sides)
    batch = tr.sample(0, 1)
    z, _ = tr.nets[0].encode_forward(batch[0], tr.nets[0].static_forward(tr.sides[0].batch(batch[4])[0])[0])
    r, _ = tr.nets[1].decode_forward(z, tr.nets[1].static_forward(tr.sides[1].batch(batch[5])[0])[0])
    assert not r.any()
    kept = tr.copies[0, 1]
    x = kept.x[0]
    np.testing.assert_allclose(kept.standardised(x) * sides[1].std + sides[1].mean, x, atol=1e-5)
    all_shifted = np.concatenate([kept.shifted(x) for x in kept.x])
    np.testing.assert_allclose(all_shifted[:, 7:].mean(axis=0), 0.0, atol=1e-3)


def richardson(f, h=1e-3):
    """f'(0) to the fourth order."""
    return (4 * (f(h / 2) - f(-h / 2)) / h - (f(h) - f(-h)) / (2 * h)) / 3


def random_bones(side, rng):
    return rng.standard_normal((len(side.names), 3, 4, 2)), np.abs(rng.standard_normal((len(side.ends), 2))) + 0.5


def test_limb_loss_gradient(sides):
    rng = np.random.default_rng(0)
    (a, la), (b, lb) = (random_bones(s, rng) for s in sides)
    loss, d = correct.limb_loss(a, b, *sides, la, lb)
    way = rng.standard_normal(b.shape)
    assert np.sum(d * way) == pytest.approx(
        richardson(lambda e: correct.limb_loss(a, b + e * way, *sides, la, lb)[0]), rel=1e-6
    )
    va = np.einsum("ej,jctb->ectb", sides[0].limbs, a) / la[:, None, None]
    vb = np.einsum("ej,jctb->ectb", sides[1].limbs, b) / lb[:, None, None] - sides[1].anchor[:, :, None, None]
    assert loss == pytest.approx(np.mean(np.sum((va - vb) ** 2, axis=(0, 1))))


def test_stand_loss_gradient():
    """By the equation, one foot and frame at a time; feet in the air cost nothing."""
    rng = np.random.default_rng(0)
    world, standing = rng.standard_normal((5, 3, 6, 2)), (rng.random((2, 6, 2)) < 0.6).astype(float)
    loss, d = correct.stand_loss(world, [2, 4], standing)
    slow = 0.0
    for k, f in enumerate((2, 4)):
        for t in range(1, 6):
            for b in range(2):
                if standing[k, t, b] and standing[k, t - 1, b]:
                    slow += np.sum((world[f, :2, t, b] - world[f, :2, t - 1, b]) ** 2)
    assert loss == pytest.approx(slow / 10)
    way = rng.standard_normal(world.shape)
    slope = richardson(lambda e: correct.stand_loss(world + e * way, [2, 4], standing)[0])
    assert np.sum(d * way) == pytest.approx(slope, rel=1e-6)
    assert correct.stand_loss(world, [2, 4], 0 * standing)[0] == 0.0


def test_whole_gradient(sides):
    """The gradient of all six losses against a difference along a random direction, for both networks."""
    opt = options("--rigs", "human,dino", "--batch", 1, "--ltc", 2.0, "--adv", 1.0)
    tr = correct.Corrector(opt, sides, dtype=np.float64)
    rng = np.random.default_rng(1)
    for net in tr.nets:
        net.theta += 0.02 * rng.standard_normal(net.theta.shape)
        net.grad[:] = 0.0
    batch = tr.sample(0, 1)

    def total():
        losses = tr.direction(0, 1, batch)[0]
        return sum(tr.weights[k] * v for k, v in losses.items())

    total()
    for net, grad in zip(tr.nets, [net.grad.copy() for net in tr.nets]):
        start, way = net.theta.copy(), rng.standard_normal(net.theta.shape)

        def at(e, net=net, start=start, way=way):
            net.theta[:] = start + e * way
            return total()

        h = 1e-6
        slope = (at(h) - at(-h)) / (2 * h)
        net.theta[:] = start
        assert grad @ way == pytest.approx(slope, rel=2e-3)


def test_step_learns(sides):
    """Twelve steps between human and Dino lower what they are to lower."""
    tr = correct.Corrector(options("--rigs", "human,dino", "--batch", 4, "--intra", 0.0, "--adv", 0.1), sides)
    rows = [tr.step() for _ in range(12)]
    cost = [sum(tr.weights[k] * v for k, v in r.items() if k != "adv") for r in rows]
    assert np.mean(cost[-3:]) < 0.8 * np.mean(cost[:2])


def test_train_ship_use(trained, sides, clips, tmp_path):
    """A checkpoint says its rigs, licence and curve, and gives the same answers; other files are refused in a line."""
    net = correct.Correction(trained / "correct-1.npz")
    assert net.names == ["human", "dino"] and net.meta["licence"] == "MIT" and net.meta["steps"] == 2
    assert net.meta["curve"][-1]["step"] == 2 and {"limb", "stand", "ee"} <= set(net.meta["curve"][-1])
    m = sides[0].clips[0][1]
    got = net(m, 0, net.sides[1].rig.skeleton, 1)
    assert len(got) == len(m) and got.skeleton.names == sides[1].names
    np.testing.assert_allclose(got.pos / got.skeleton.leg, m.pos / m.skeleton.leg, atol=1e-5)
    correct.ship(trained / "correct-1.npz", tmp_path / "small.npz")
    small = correct.Correction(tmp_path / "small.npz")(m, 0, net.sides[1].rig.skeleton, 1)
    np.testing.assert_allclose(data.pose(small)[0], data.pose(got)[0], atol=1e-3)
    with pytest.raises(UserError, match="wolf: not among the trained rigs; valid: human, dino"):
        net.index("wolf")
    np.savez(tmp_path / "other.npz", a=1)
    with pytest.raises(UserError):
        correct.Correction(tmp_path / "other.npz")
    assert run("correct", "--rigs", "human,dino", "--steps", 2, "--out", trained) == 2


def test_results_stand_on_the_floor(trained, sides):
    """Cleaned, standing feet are as high as the target's in its own clips, and as much above that as the source's are
    above its rig's; a foot that is held up all the time stays up."""
    net = correct.Correction(trained / "correct-0.npz")
    a, b = sides[0].stand, net.sides[1].stand
    np.testing.assert_array_equal(b, sides[1].stand)
    heights = np.array([data.stand_heights(m, data.contacts(m)) for _, m in sides[1].clips])
    middle = [(len(heights) - 1) // 2, len(heights) // 2]
    np.testing.assert_allclose(b, np.sort(heights, axis=0)[middle].mean(axis=0))
    m, body = sides[0].clips[0][1], net.sides[1].rig.skeleton
    z = lambda r: data.pose(r)[0][:, list(r.skeleton.feet), 2]  # noqa: E731
    for up in (0.0, 0.4):
        high = replace(m, pos=m.pos + [0.0, 0.0, up])  # the source's floor is elsewhere
        standing = data.contacts(high)
        got = net(high, 0, body, 1)
        floor = min(data.stand_heights(high, standing) - a)
        wanted = body.leg * (b + z(high) / m.skeleton.leg - a - floor)
        off = lambda r: np.abs(z(r) - wanted)[standing].mean()  # noqa: E731, B023
        assert off(net.clean(got, high, 0, 1)) < 0.02 and off(replace(got, pos=got.pos + [0.0, 0.0, 0.1])) > 0.05
    low = replace(got, pos=got.pos - [0.0, 0.0, 0.03])
    assert measure.floating(low, got, standing) == pytest.approx(0.03)
    assert measure.floating(low, got, np.zeros_like(standing)) == 0.0

    s = m.skeleton  # standing on the right leg: the left thigh is raised, the left shin hangs
    thigh, shin = s.names.index("thigh_l"), s.names.index("shin_l")
    quat = np.repeat(m.quat[:1], 40, 0)
    quat[:, thigh] = quat_mul(quat[:, thigh], quat_about(1, np.full(40, -1.2)))
    quat[:, shin] = quat_mul(quat[:, shin], quat_about(1, np.full(40, 1.2)))
    crane = replace(m, pos=np.repeat(m.pos[:1], 40, 0), quat=quat)
    assert (z(crane)[:, 0] - z(crane)[:, 1]).min() > 0.3
    cleaned = net.clean(net(crane, 0, body, 1), crane, 0, 1)
    assert np.abs(z(cleaned)[:, 1] - body.leg * b[1]).max() < 0.02 and z(cleaned)[:, 0].min() > 0.1


def test_minutes(clips, tmp_path):
    """What --minutes ends is kept, with the steps that it had."""
    args = ("--rigs", "human,dino", "--steps", 400, "--batch", 2, "--minutes", 1e-4, "--out", tmp_path / "a")
    assert run("correct", *args) == 0
    assert 0 < correct.Correction(tmp_path / "a" / "correct-0.npz").meta["steps"] < 50


def test_damaged_weights(trained, tmp_path, capsys):
    """Arrays of another size, with NaN, or without standing heights are refused in a line."""
    arrays, meta = load_checkpoint(trained / "correct-0.npz")
    bad = {"generator1": (arrays["generator1"][:1], "generator1 has 1 numbers"),
           "stand1": (arrays["stand1"][:1], "stand1 has not 2 numbers"),
           "offsets1": (np.nan * arrays["offsets1"], "'offsets1' holds NaN")}  # fmt: skip
    for name, (value, said) in bad.items():
        save_checkpoint(tmp_path / "b.npz", arrays | {name: value}, meta)
        with pytest.raises(UserError, match=said):
            correct.Correction(tmp_path / "b.npz")
    old = {k: v for k, v in arrays.items() if not k.startswith("stand")}
    save_checkpoint(tmp_path / "b.npz", old, meta)
    with pytest.raises(UserError, match="has no standing heights, as older files; valid: trained anew"):
        correct.Correction(tmp_path / "b.npz")


def test_retarget_any_human(trained, tmp_path, clips, capsys):
    """A Mixamo-like file of a character goes in by its canonical human, Dino's joints come out, y up in centimetres."""
    jesse = character.load("jesse")
    write_bvh(tmp_path / "a.bvh", jesse, retarget(jesse, clips[0]).qpos, 30.0, "mixamo")
    files = ("--weights", trained / "correct-0.npz", "--source", tmp_path / "a.bvh", "--out", tmp_path / "b.bvh")
    assert run("retarget", *files, "--target", "dino") == 0
    assert "human -> dino; feet slide" in capsys.readouterr().out
    raw = data.read_rig(tmp_path / "b.bvh")
    assert "spine3" in raw.names and len(raw.pos) == len(clips[0])
    assert 0.5 < raw.pos[:, 2].mean() < 1.2 and raw.unit == 0.01
    if sdk := importlib.util.find_spec("bvhsdk") and importlib.import_module("bvhsdk"):
        b = bvh.read(tmp_path / "b.bvh")
        pos, _ = bvh.global_pose(b)
        for joint in sdk.ReadFile(str(tmp_path / "b.bvh")).getlistofjoints():
            np.testing.assert_allclose(joint.getPosition(30), pos[30, b.names.index(joint.name)], atol=1e-3)
    assert run("retarget", *files, "--target", "oppy") == 2 and "valid: human, dino" in capsys.readouterr().err
    for flag, value in (("--up", "z"), ("--drop", "Head")):
        assert run("retarget", *files, "--target", "dino", flag, value) == 2
        assert f"{flag} would do nothing" in capsys.readouterr().err
    assert run("retarget", *files, "--target", "B/none.bvh") == 2 and "character" not in capsys.readouterr().err


def test_retarget_onto_the_human(trained, tmp_path, clips, capsys):
    """The source's own rig needs no network: the plain copy.  What a user says of the file is believed."""
    jesse = character.load("jesse")
    write_bvh(tmp_path / "a.bvh", jesse, retarget(jesse, clips[0]).qpos, 30.0, "mixamo")
    files = ("--weights", trained / "correct-0.npz", "--source", tmp_path / "a.bvh", "--out", tmp_path / "b.bvh")
    assert run("retarget", *files, "--target", "human", "--no-clean") == 0
    assert "human -> human" in (said := capsys.readouterr().out) and "not cleaned" in said and "clean-up" not in said
    net = correct.Correction(trained / "correct-0.npz")
    m = data.to_motion(rigs.human_raw(captures.read_clips([tmp_path / "a.bvh"])[0]), net.sides[0].rig.structure)
    got = net(m, 0, net.sides[0].rig.skeleton, 0)
    turn = np.abs(np.sum(got.quat * m.quat, axis=-1))
    np.testing.assert_allclose(turn, 1.0, atol=1e-4)  # its rotations are the source's, on the trained bones
    assert run("retarget", *files, "--target", "human", "--rate", 60) == 0
    assert f"{(len(m) + 1) // 2} frames" in capsys.readouterr().out


def test_retarget_to_a_static_skeleton(trained, tmp_path, clips, capsys):
    """A file of Dino's joints, a fifth longer, is the body that moves; a file of other joints is refused by name."""
    net = correct.Correction(trained / "correct-0.npz")
    rig = net.sides[1].rig
    long = replace(rig.skeleton, offsets=1.2 * rig.skeleton.offsets)
    still = rigs.put_on(clips[1], rig, rig.skeleton)[:3]
    s = replace(rig.structure, up="y", unit=0.01)
    data.write_motion(tmp_path / "t.bvh", replace(still, skeleton=long), s)
    human = net.sides[0].rig
    m = data.to_motion(rigs.human_raw(clips[0]), human.structure)
    data.write_motion(tmp_path / "a.bvh", m, replace(human.structure, up="y", unit=0.01))
    files = ("--weights", trained / "correct-0.npz", "--source", tmp_path / "a.bvh", "--out", tmp_path / "b.bvh")
    assert run("retarget", *files, "--target", tmp_path / "t.bvh") == 0 and "-> dino" in capsys.readouterr().out
    made = data.read_rig(tmp_path / "b.bvh")
    lengths = np.linalg.norm(made.offsets, axis=1)
    want = np.linalg.norm(long.offsets, axis=1)[[rig.skeleton.names.index(n) for n in made.names]]
    np.testing.assert_allclose(lengths, want, atol=1e-5)
    jesse = character.load("jesse")
    write_bvh(tmp_path / "j.bvh", jesse, retarget(jesse, clips[0]).qpos, 30.0)
    assert run("retarget", *files, "--target", tmp_path / "j.bvh") == 2
    assert "no trained rig has its joints" in capsys.readouterr().err


def test_nearest_body(tmp_path):
    """Jesse's, Oppy's and Dino's joints are the same: a file is of the one whose proportions it has."""
    net = correct.Correction(correct.SHIPPED)
    for name in ("jesse", "oppy", "dino"):
        k = net.index(name)
        rig = net.sides[k].rig
        m = data.Motion("t", rig.skeleton, np.tile([0.0, 0.0, 1.0], (2, 1)), np.tile([1.0, 0, 0, 0], (2, 21, 1)))
        data.write_motion(tmp_path / "t.bvh", m, replace(rig.structure, up="y", unit=0.01))
        assert play.target_body(net, str(tmp_path / "t.bvh"), "y", ())[0] == k


def test_end_error(sides):
    """A hand that is off by its limb's length counts one; the mean is over five ends."""
    m = sides[0].clips[0][1]
    s = sides[0].rig.skeleton
    e = s.graph.leaves[1]
    length = sides[0].limbs[1] @ np.linalg.norm(m.skeleton.offsets, axis=1)
    offsets = m.skeleton.offsets.copy()
    offsets[e] += length * np.array([0.0, 0.0, 1.0])
    moved = replace(m, skeleton=replace(m.skeleton, offsets=offsets))
    assert measure.end_error(moved, m, sides[0].limbs) == pytest.approx(1 / 5)
    assert measure.end_error(m, m, sides[0].limbs) == 0.0


def test_measure(trained, tmp_path, capsys):
    """The default works on what is built in; two seeds are averaged; truth has no error, the copy has some."""
    weights = ",".join(str(trained / f"correct-{k}.npz") for k in (0, 1))
    assert run("measure", "--weights", weights, "--limit", 1, "--json", tmp_path / "m.json") == 0
    r = json.loads((tmp_path / "m.json").read_text())
    rows = r["pairs"]["human-dino"]
    assert set(rows) == set(measure.ROWS) and all(set(v) == set(measure.METRICS) for v in rows.values())
    assert rows["truth"]["joint"] == rows["truth"]["ee"] == 0.0 < rows["copy"]["joint"]
    assert rows["mean_pose"]["ee"] > rows["copy"]["ee"]
    assert rows["network_clean"]["slide_cm_s"] < 0.5 * rows["network"]["slide_cm_s"]
    each = [s["network"]["ee"] for s in r["seeds"]["human-dino"]]
    assert len(each) == 2 and rows["network"]["ee"] == pytest.approx(np.mean(each))
    assert "human-dino" in capsys.readouterr().out
    assert run("correct", "--rigs", "jesse,dino", "--steps", 1, "--batch", 2, "--out", tmp_path / "c") == 0
    args = ("--weights", tmp_path / "c" / "correct-0.npz", "--png", tmp_path / "sheets")
    assert run("measure", *args) == 2 and "no clip of jesse, dino is at hand" in capsys.readouterr().err
    assert not (tmp_path / "sheets").exists()


def test_rebased(sides):
    """Against another reference pose the same poses."""
    m, rig = sides[0].clips[0][1], sides[0].rig
    other = data.structure_of([rigs.raw_of(m[:20], rig.structure)], "z")
    again = measure.rebased(measure.rebased(m, rig.structure, other), other, rig.structure)
    np.testing.assert_allclose(data.pose(again)[0], data.pose(m)[0], atol=1e-9)

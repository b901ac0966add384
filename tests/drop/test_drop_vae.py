"""drop/vae.py, drop/prior.py, drop/train.py: every step computed another way."""

import functools
import json
import signal
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import lstsq
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from drop import body, demos, train, vae
from drop.__main__ import main
from drop.body import LENGTHS, STEP, N
from drop.keyposes import key_pose_motion
from drop.prior import LEGS, WEIGHTS, NearestPrior, PoseRange, VaePrior, incline, led, load_networks, pose_angles
from drop.score import hurried, stands
from drop.simulator import Plane, Simulator, State
from human import Clip, heading
from mocap import gait
from plumbing.cli import UserError, run_main
from plumbing.runs import CHECKPOINT, load_checkpoint, read_metrics, save_checkpoint

RNG = np.random.default_rng


@functools.cache
def motion(kind="walk", seconds=6.0, seed=0, **params):
    m = gait.generate(kind, seconds, 30.0, seed=seed, height=1.75, **params)
    return body.character_motion(Clip(kind, "x", 30.0, m["pos"], m["quat"], m["ball"]))


@functools.cache
def recording():
    return train.Recording([motion(), motion("jog", speed=2.5), motion("turn", speed=1.0, turn_rate=0.8)])


def statistics(rng):
    wide = lambda n: 0.5 + rng.random(n)  # noqa: E731
    motion = {"mean": 0.3 * rng.standard_normal(vae.STATE), "std": wide(vae.STATE),
              "scale": 0.1 * wide(vae.OUTPUT), "offset": 0.01 * rng.standard_normal(vae.OUTPUT)}  # fmt: skip
    return motion, {"mean": 0.5 * rng.standard_normal(vae.POSE_SIZE), "std": wide(vae.POSE_SIZE)}


def frames(rng, n=3):
    """x, columns, v of n random disturbed frames, float64."""
    at = rng.choice(recording().starts(1), n)
    x, columns = (a.astype(float) for a in recording().at(at, rng.random(n) < 0.5))
    return vae.disturbed(x, columns, rng.standard_normal(x.shape), rng)


# ------------------------------------------------------------------------------------ rotations, kinematics, states


def test_gram_schmidt():
    """Orthonormal, against QR; a rotation's columns give it back; degenerate input finite."""
    rng = RNG(0)
    raw = rng.standard_normal((5, 2, 3))
    C, _ = vae.gram_schmidt_forward(raw)
    np.testing.assert_allclose(C @ np.swapaxes(C, 1, 2), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(C), 1.0)
    for k in range(5):
        q, r = np.linalg.qr(raw[k].T)
        np.testing.assert_allclose(C[k, :2], (q * np.sign(np.diag(r))).T, atol=1e-12)
    R = Rotation.random(4, random_state=1)
    found = vae.gram_schmidt_forward(vae.columns_of(R.as_quat(scalar_first=True)))[0]
    np.testing.assert_allclose(np.swapaxes(found, 1, 2), R.as_matrix(), atol=1e-12)
    assert np.isfinite(vae.gram_schmidt_forward(np.zeros((1, 2, 3)))[0]).all()
    some = Rotation.concatenate([R, Rotation.from_rotvec(np.pi * np.eye(3)), Rotation.identity()])
    q, there = vae.quat_of(some.as_matrix()), some.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs(np.sum(q * there, axis=1)), 1.0, atol=1e-12)


def test_kinematics():
    """Against drop.forward_kinematics."""
    rng = RNG(1)
    R = Rotation.random(3 * N, random_state=2)
    quat, root = R.as_quat(scalar_first=True).reshape(3, N, 4), rng.standard_normal((3, 3))
    C = np.swapaxes(R.as_matrix(), 1, 2).reshape(3, N, 3, 3)
    np.testing.assert_allclose(vae.kinematics_forward(root, C), body.forward_kinematics(root, quat), atol=1e-12)


def test_canonical_is_invariant():
    """A state moved and turned about the vertical is the same state; heading as human.heading; and back again."""
    rng = RNG(2)
    x, columns, v = frames(rng)
    cx, cc, cv, frame = vae.canonical(x, columns, v)
    np.testing.assert_allclose(cx[:, 0, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(vae.facing(cc)[1], 0.0, atol=1e-7)
    R = np.swapaxes(vae.gram_schmidt_forward(columns[:, 0])[0], 1, 2)
    from human import heading

    yaw = heading(Rotation.from_matrix(R).as_quat(scalar_first=True))
    np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], vae.facing(columns), atol=1e-9)
    turn = Rotation.from_rotvec([0, 0, 1.234]).as_matrix()
    moved = vae.canonical(x @ turn.T + [3.0, -2.0, 0], columns @ turn.T, v @ turn.T)
    np.testing.assert_allclose(vae.state_vector(*moved[:3]), vae.state_vector(cx, cc, cv), atol=1e-9)
    assert vae.state_vector(cx, cc, cv).shape == (3, vae.STATE)
    back = vae.to_world(cx, cc, frame)
    np.testing.assert_allclose(back[0], x, atol=1e-9), np.testing.assert_allclose(back[1], columns, atol=1e-9)
    up = columns.copy()
    up[:, 0, 1] = [0, 0, 1.0]  # the left axis straight up
    assert np.isfinite(np.concatenate(vae.facing(up))).all()


def test_mirrored():
    """Mirrored rotations give mirrored positions; twice is nothing."""
    x, columns, _ = frames(RNG(3))
    mx, mc = vae.mirrored(x, columns)
    C, _ = vae.gram_schmidt_forward(mc)
    np.testing.assert_allclose(vae.kinematics_forward(mx[:, 0], C), mx, atol=1e-9)
    for a, b in zip(vae.mirrored(mx, mc), (x, columns)):
        np.testing.assert_allclose(a, b)
    assert [body.JOINTS[j].replace("_r", "_l") for j in vae._MIRROR] == [n.replace("_r", "_l") for n in body.JOINTS]


def test_disturbed():
    """Still rotations and exact bones; none where the share is 0; rows turn as SciPy's rotations do."""
    rng = RNG(4)
    x, columns, v = frames(rng, 6)
    np.testing.assert_allclose(np.linalg.norm(body.DIFFERENCE @ x, axis=-1), np.tile(LENGTHS, (6, 1)), atol=1e-9)
    same = vae.disturbed(x, columns, v, rng, share=0.0)
    for a, b in zip(same, (x, columns, v)):
        np.testing.assert_allclose(a, b, atol=1e-9)
    off = np.linalg.norm(vae.disturbed(x, columns, v, rng, share=1.0)[0] - x, axis=-1)
    assert 0.001 < off.mean() < 0.3
    C, w = vae.gram_schmidt_forward(columns)[0][:2], rng.standard_normal((2, N, 3))
    by = np.array([[Rotation.from_rotvec(w[b, j]).apply(C[b, j]) for j in range(N)] for b in range(2)])
    np.testing.assert_allclose(vae.rotate_rows(C, w), by, atol=1e-9)


# ------------------------------------------------------------------------------------ networks


def test_gaussians():
    """KL against SciPy by Monte Carlo; log σ stays in its bound."""
    rng = RNG(5)
    args = [0.5 * rng.standard_normal((2, 3)) for _ in range(4)]
    kl, _ = vae.kl_forward(*args)
    m0, s0, m1, s1 = (a[0] for a in args)
    z = m0 + np.exp(s0) * rng.standard_normal((400_000, 3))
    logp = lambda m, s: multivariate_normal(m, np.diag(np.exp(2 * s))).logpdf(z)  # noqa: E731
    assert kl[0] == pytest.approx(np.mean(logp(m0, s0) - logp(m1, s1)), rel=0.02)
    assert np.abs(vae.bounded_forward(20 * rng.standard_normal((3, 2)))[0]).max() <= vae.LOG_STD_BOUND


def test_latent_mlp():
    """As the equation; z reaches every layer."""
    rng = RNG(6)
    net = vae.LatentMLP((4, 6, 5, 3), 2, rng, dtype=np.float64)
    x, z = rng.standard_normal((3, 4)), rng.standard_normal((3, 2))
    h = x
    for i in range(3):
        W = net.params[f"W{i}"]
        assert W.shape[0] == net.sizes[i] + 2
        h = h @ W[:-2] + z @ W[-2:] + net.params[f"b{i}"]
        h = np.where(h > 0, h, 0.01 * h) if i < 2 else h
    np.testing.assert_allclose(net(x, z), h)


def test_motion_vae():
    """Bones are exact, inputs are cut, the mode is a pose."""
    rng = RNG(7)
    net = vae.MotionVAE(3, 10, statistics(rng)[0], rng, np.float64)
    x, columns, v = frames(rng)
    cx, cc, cv, _ = vae.canonical(x, columns, v)
    state, eps = vae.state_vector(cx, cc, cv), rng.standard_normal((3, 3))
    target = cx + 0.02 * rng.standard_normal(cx.shape), cc + 0.02 * rng.standard_normal(cc.shape)
    contacts = np.array([[1.0, 0, 0, 1], [0, 0, 0, 0], [1, 1, 1, 0]])
    parts, _, nx, _ = net.loss(state, cx[:, 0, 2], cc, *target, contacts, eps, 0.7)
    s = net.normalise(state)
    np.testing.assert_allclose(np.linalg.norm(body.DIFFERENCE @ nx, axis=-1), np.tile(LENGTHS, (3, 1)), atol=1e-9)
    assert np.abs(s).max() <= vae.CLIP
    mu, log_std, _ = net.gaussian("prior", s)
    again = net.decode(s, mu, cx[:, 0, 2], cc)
    np.testing.assert_allclose(again[0], vae.kinematics_forward(again[0][:, 0], again[1]), atol=1e-9)
    assert parts["kl"] >= 0 and mu.shape == log_std.shape == (3, 3)


def test_pose_vae():
    """A pose is independent of place and of the pelvis's rotation."""
    rng = RNG(8)
    net = vae.PoseVAE(3, 8, statistics(rng)[1], rng, np.float64)
    x, columns, _ = frames(rng)
    C, _ = vae.gram_schmidt_forward(columns)
    pose = vae.pose_columns(C)
    turn = Rotation.random(random_state=1).as_matrix()
    np.testing.assert_allclose(vae.pose_columns(C @ turn.T), pose, atol=1e-12)
    np.testing.assert_allclose(net.decode(net.encode(pose))[:, body.LEAVES[0]], net.decode(net.encode(pose))[:, 10])


# ------------------------------------------------------------------------------------ training


def test_recording():
    """Starts keep to their clip, with a frame before them and K after."""
    r = train.Recording([motion(), motion("stand", 2.0)])
    starts = r.starts(8)
    first = len(motion()[0])
    assert starts.min() == 1 and starts.max() + 8 == len(r.x) - 1
    assert set(starts) == set(range(1, first - 8)) | set(range(first + 1, len(r.x) - 8))
    x, columns = r.at(np.array([5]), np.array([False]))
    np.testing.assert_allclose(x[0], motion()[0][5], atol=1e-6)
    np.testing.assert_allclose(columns[0], vae.columns_of(motion()[1][5]), atol=1e-6)
    assert train.held_out(["builtin"], "*stand*")
    with pytest.raises(UserError, match="no clip matches"):
        train.held_out(["builtin"], "nothing")
    with pytest.raises(UserError, match="smaller --rollout"):
        r.starts(10_000)
    with pytest.raises(UserError, match="three frames"):
        train.Recording([(r.x[:1], None)])


def test_transition():
    """On the recording the target is its next frame, whatever the heading; beside it, (1 − β) of the way off."""
    rng = RNG(9)
    at, flip = rng.choice(recording().starts(2), 4), np.array([True, False, True, False])
    x, columns = recording().at(at, flip)
    turn = Rotation.from_rotvec([0, 0, 2.0]).as_matrix().astype(np.float32)
    batch, frame, _, after = train.transition(recording(), at, flip, x @ turn.T, columns @ turn.T, 0 * x, 0.2)
    tx, tc = vae.to_world(batch[3], batch[4], frame)
    np.testing.assert_allclose(tx, after[0] @ turn.T, atol=1e-4)
    np.testing.assert_allclose(tc, after[1] @ turn.T, atol=1e-4)
    lifted = x + np.float32([0, 0, 0.1])
    tx = vae.to_world(*train.transition(recording(), at, flip, lifted, columns, 0 * x, 0.2)[0][3:5], frame)[0]
    flat = train.transition(recording(), at, flip, x, columns, 0 * x, 0.2)[0][3]
    up = train.transition(recording(), at, flip, lifted, columns, 0 * x, 0.2)[0][3]
    np.testing.assert_allclose(up - flat, np.broadcast_to([0, 0, 0.08], up.shape), atol=1e-5)


TINY = dict(updates=24, batch=16, rollout=4, latent=4, hidden=16, pose_latent=4, pose_hidden=16)


def test_training_learns():
    """A tenth of a minute halves both reconstructions and moves information through z; schedules go where they say."""
    t = train.Trainer(
        train.Options(**TINY | {"updates": 240, "batch": 64, "hidden": 48, "lr": 3e-3}), recording()
    )
    first = t.schedule()
    begin = t.iterate()
    while t.updates < t.opt.updates:
        end = t.iterate()
    assert end["reconstruction"] < 0.5 * begin["reconstruction"]
    assert end["pose_reconstruction"] < 0.5 * begin["pose_reconstruction"]
    assert 0.1 < end["kl"] and 0.1 < end["pose_kl"]
    lr, kl, own = t.schedule()
    assert first == (t.opt.lr, 0.0, 0.0) and lr == pytest.approx(0.01 * t.opt.lr) and (kl, own) == (t.opt.kl, 0.95)


def test_training_resumes(tmp_path, monkeypatch):
    """Interrupted and resumed gives the same weights to the last bit."""
    monkeypatch.setattr(train, "recorded", lambda *a, **k: [motion()])
    whole = train.train(train.Options(out=str(tmp_path / "a"), **TINY))
    opt = train.Options(out=str(tmp_path / "b"), checkpoint_minutes=0.0, **TINY)
    iterate = train.Trainer.iterate

    def stop(self):
        if self.updates == 12:
            raise KeyboardInterrupt
        return iterate(self)

    monkeypatch.setattr(train, "COUNT_SHOWN", 3)
    monkeypatch.setattr(train.Trainer, "iterate", stop)
    with pytest.raises(KeyboardInterrupt):
        train.train(opt)
    monkeypatch.setattr(train.Trainer, "iterate", iterate)
    assert load_checkpoint(tmp_path / "b" / CHECKPOINT)[1]["updates"] == 12
    again = train.train(replace(opt, resume=True))
    for name, net in whole.nets.items():
        np.testing.assert_array_equal(net.theta, again.nets[name].theta)
    assert len(read_metrics(tmp_path / "b" / "metrics.csv")["kl"]) == 2
    with pytest.raises(UserError, match="--resume"):
        train.train(opt)
    save_checkpoint(tmp_path / "b" / CHECKPOINT, {"x": np.zeros(2)}, {"updates": 1})
    with pytest.raises(UserError, match="not a checkpoint of this run"):
        train.train(replace(opt, resume=True))


def test_interrupt(tmp_path, monkeypatch, capsys):
    """Ctrl-C after the second update: a checkpoint of it, and how to go on; then the same weights as at one go."""
    monkeypatch.setattr(train, "recorded", lambda *a, **k: [motion()])
    whole = train.train(train.Options(out=str(tmp_path / "a"), **TINY))
    opt = train.Options(out=str(tmp_path / "b"), **TINY)
    iterate, calls = train.Trainer.iterate, []

    def press(self):
        calls.append(1)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGINT)
        return iterate(self)

    monkeypatch.setattr(train.Trainer, "iterate", press)
    stopped = train.train(opt)
    assert len(calls) == 2 and stopped.updates < whole.updates
    assert load_checkpoint(tmp_path / "b" / CHECKPOINT)[1]["updates"] == stopped.updates
    assert f"python -m drop train --resume --out {tmp_path / 'b'}" in capsys.readouterr().out
    again = train.train(replace(opt, resume=True))
    for name, net in whole.nets.items():
        np.testing.assert_array_equal(net.theta, again.nets[name].theta)


def test_training_from_shipped_networks(tmp_path, monkeypatch):
    """Goes on at the shipped count of updates from the very weights; other sizes are refused with the right ones."""
    monkeypatch.setattr(train, "recorded", lambda *a, **k: [motion()])
    out, file = str(tmp_path / "a"), str(tmp_path / "w.npz")
    train.train(train.Options(out=out, **TINY))
    train.ship(train.Options(out=out, weights=file))
    net, pose, meta = load_networks(file)
    longer = TINY | {"updates": meta["updates"] + TINY["rollout"]}
    t = train.Trainer(train.Options(**longer), recording())
    t.begin_from(file)
    assert t.updates == meta["updates"] == TINY["updates"]
    s, z = RNG(0).standard_normal((5, vae.STATE)), np.zeros((5, TINY["latent"]), np.float32)
    raw = t.motion.stats["mean"] + 0.5 * t.motion.stats["std"] * s
    says = lambda each: each.decode(each.normalise(raw), z, raw[:, 0], np.zeros((5, N, 2, 3)) + np.eye(3)[:2])[0]  # noqa: E731
    np.testing.assert_allclose(says(t.motion), says(net), atol=5e-3)  # the same function, other statistics
    np.testing.assert_array_equal(t.pose.nets["encoder"].theta, pose.nets["encoder"].theta)
    own = train.Trainer(train.Options(**longer), recording()).motion.stats
    np.testing.assert_array_equal(t.motion.stats["scale"], own["scale"])
    t = train.train(train.Options(out=str(tmp_path / "b"), init=file, **longer))
    assert t.updates == longer["updates"]
    other = train.Options(out=str(tmp_path / "c"), init=file, **(longer | {"latent": TINY["latent"] + 1}))
    with pytest.raises(UserError, match=f"--latent {TINY['latent']}"):
        train.train(other)


def test_rebase():
    """With other statistics the networks say the same of the same state; inside CLIP, in float64."""
    rng = RNG(11)
    net = vae.MotionVAE(3, 10, statistics(rng)[0], rng, np.float64)
    x, columns, v, _ = vae.canonical(*frames(rng))
    state, z = vae.state_vector(x, columns, v), rng.standard_normal((3, 3))
    old = {k: a.copy() for k, a in net.stats.items()}
    new = {"mean": state.mean(axis=0), "std": 0.4 + 2 * rng.random(vae.STATE),
           "scale": old["scale"] * (0.5 + rng.random(vae.OUTPUT)), "offset": old["offset"] + 0.01}  # fmt: skip
    old["std"] = 0.5 + 2 * rng.random(vae.STATE)
    net.stats = {k: np.asarray(v) for k, v in old.items()}
    assert np.abs((state - old["mean"]) / old["std"]).max() < vae.CLIP

    def says():
        s, wanted = net.normalise(state), (0.01 - net.stats["offset"]) / net.stats["scale"]
        both = np.concatenate([s, np.tile(wanted, (3, 1))], axis=1)
        return *net.decode(s, z, x[:, 0, 2], columns), net.gaussian("prior", s)[0], net.gaussian("posterior", both)[1]

    before = says()
    train.rebase(net, old, new)
    for a, b in zip(before, says(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_array_equal(net.stats["std"], new["std"])


def test_linear_baseline():
    """Ridge regression against SciPy's least squares; what one_step says against a slow loop; alone it drifts."""
    rng = RNG(10)
    net = vae.MotionVAE(3, 8, train.Trainer(train.Options(**TINY), recording()).motion.stats, rng)
    linear = train.LinearAR(net, recording(), n=400, ridge=1e-3)
    at = RNG(0).choice(recording().starts(1), 400)
    batch = train._clean(recording(), at)[0]
    state, height, columns, tx, tc, _ = batch
    move = tx[:, 0] - np.stack([0 * height, 0 * height, height], axis=1)
    wanted = np.concatenate([move, (tc - columns).reshape(400, -1)], axis=1)
    wanted = (wanted - net.stats["offset"]) / net.stats["scale"]
    s1 = np.concatenate([net.normalise(state), np.ones((400, 1))], axis=1).astype(float)
    ridge = np.concatenate([s1, np.sqrt(1e-3) * np.eye(s1.shape[1])])
    A = lstsq(ridge, np.concatenate([wanted, np.zeros((s1.shape[1], vae.OUTPUT))]))[0]
    np.testing.assert_allclose(s1 @ linear.A, s1 @ A, atol=2e-2)
    r = train.one_step(net, linear, recording(), RNG(1), n=50, samples=4)
    at = RNG(1).choice(recording().starts(1), 50, replace=False)
    slow = [1e3 * np.linalg.norm(2 * recording().x[t] - recording().x[t - 1] - recording().x[t + 1], axis=1).mean()
            for t in at]  # fmt: skip
    assert r["constant velocity"] == pytest.approx(np.mean(slow), rel=1e-3)
    assert r["linear"] < r["constant velocity"] and r["best"] <= r["mode"] + 5.0 and r["kl"] >= 0
    far = train.open_loop(net, linear, recording(), RNG(2), (1, 10), n=20)
    assert 0 < far[0] < far[1]


# ------------------------------------------------------------------------------------ the shipped weights


def shipped():
    return load_networks()


def test_ship_names_its_file(tmp_path):
    """The weights that came with the project are never the default."""
    before = WEIGHTS.read_bytes()
    with pytest.raises(UserError, match="say where to, with --weights FILE.npz"):
        train.main(["ship", "--out", str(tmp_path)])
    assert WEIGHTS.read_bytes() == before


def test_shipped():
    """Small, licensed."""
    _, _, meta = shipped()
    assert WEIGHTS.stat().st_size < 4e6
    assert "bandai" in meta["licence"] and "NonCommercial" in meta["licence"] and "bandai" in meta["options"]["motion"]
    assert meta["bound"] > 1 and 0.2 < meta["angle"] < 1.5 and meta["updates"] >= 1000


def test_shipped_on_held_out_clips(mocap_dir):
    """No posterior collapse; on a walk it has not seen better than going on as before."""
    motion_net, _, _ = shipped()
    r = train.Recording(train.recorded(mocap_dir / "bandai", "validation", "*walk_normal_005*", stitched=False))
    linear = train.LinearAR(motion_net, r, n=200)
    found = train.one_step(motion_net, linear, r, RNG(0), n=150)
    assert found["reconstruction"] < 0.8 * found["constant velocity"]
    assert 0.1 < found["kl"] / found["nll"] < 10, "posterior collapse, or a code that says everything"


def test_ship_and_load(tmp_path, monkeypatch):
    """A run is shipped with its bound, and what is not such a file is refused in one line."""
    monkeypatch.setattr(train, "recorded", lambda *a, **k: [motion()])
    out = str(tmp_path / "a")
    t = train.train(train.Options(out=out, **TINY))
    meta = train.ship(train.Options(out=out, weights=str(tmp_path / "w.npz")))
    net, pose, read = load_networks(tmp_path / "w.npz")
    np.testing.assert_allclose(net.nets["decoder"].theta, t.motion.nets["decoder"].theta, atol=1e-3)
    assert (read["bound"], read["angle"]) == pytest.approx((meta["bound"], meta["angle"]), abs=1e-9)
    assert (meta["bound"], meta["angle"]) == pytest.approx(train.calibrate(t.pose, t.recording), rel=0.01)
    assert read["licence"] == "MIT"
    save_checkpoint(tmp_path / "x.npz", {"motion.mean": np.zeros(3), "pose.mean": np.zeros(3)}, {"options": {}})
    with pytest.raises(UserError, match="not DROP's priors"):
        load_networks(tmp_path / "x.npz")
    with pytest.raises(UserError, match="no checkpoint"):
        load_networks(tmp_path / "none.npz")


def start(sim, kind="walk", frame=60, **more):
    x, quat = motion(kind, **more)
    return sim.begin(x[frame], quat[frame], (x[frame] - x[frame - 1]) / STEP)


@pytest.mark.parametrize("seed", [1, 2])
def test_who_stands_stays_over_his_feet(seed):
    """The learned prior left standing for 7 s stands, over his feet: he used to drift 0.6 m off and fall after 6 s."""
    net, pose, meta = shipped()
    x, quat = key_pose_motion("supine")
    sim = Simulator(VaePrior(net), limits=PoseRange.of(pose, meta))
    state, rng, off = sim.begin(x[-1], quat[-1]), RNG(seed), []
    for _ in range(210):
        state, _ = sim.step(state, rng=rng)
        off.append(np.linalg.norm((state.com - state.x[body.FEET].mean(axis=0))[:2]))
    assert stands(state) and max(off) < 0.15


def test_led():
    """The mean keeps its way and takes the target's speed, the rest stays; who stands or is not led is told nothing."""
    v = RNG(0).normal(0.0, 0.3, (N, 3)) + [0.8, 0.6, 0.1]
    out = led(v, np.array([0.0, -2.5]))
    mean, was = out.mean(axis=0), v.mean(axis=0)
    assert np.linalg.norm(mean[:2]) == pytest.approx(2.5) and mean[2] == pytest.approx(was[2])
    np.testing.assert_allclose(mean[:2] / np.linalg.norm(mean[:2]), was[:2] / np.linalg.norm(was[:2]), atol=1e-12)
    np.testing.assert_allclose(out - mean, v - was, atol=1e-12)
    assert led(v, None) is v and led(v - was, np.array([1.0, 0.0])).mean() == pytest.approx(0.0, abs=1e-12)


def test_a_walker_who_is_asked_to_runs():
    """Eq. 16 asks a walker for 2.5 m/s: he runs, flying between steps; he walked on at 1.8, feet torn loose."""
    stage = demos.Stage(demos.Options(prior="vae", range="vae"))
    take = hurried(stage)
    last = [s[0].com[:2] for s in take.states[-60:]]
    flies = np.mean([not o[0].active[body.FEET].any() for o in take.outcomes[-60:]])
    (r,) = demos.measure(take)
    assert np.linalg.norm(last[-1] - last[0]) / (59 * STEP) > 2.2 and flies > 0.4
    assert r["end"] == "upright" and r["slide"] < 0.25


def test_vae_prior():
    """Samples differ, bones are exact, the mode is theirs; the same in another place, heading and on another floor."""
    prior = VaePrior(shipped()[0])
    state = start(Simulator(None))
    x, quat = prior.sample(state, 16, RNG(0))
    mode, turned = prior.mode(state)
    assert x.shape == (16, N, 3) and quat.shape == (16, N, 4) and mode.shape == (N, 3)
    np.testing.assert_allclose(np.linalg.norm(body.DIFFERENCE @ x, axis=-1), np.tile(LENGTHS, (16, 1)), rtol=2e-6)
    rest = np.setdiff1d(np.arange(N), LEGS[1:].ravel())  # legs are planted
    np.testing.assert_allclose(body.forward_kinematics(x[:, 0], quat)[:, rest], x[:, rest], atol=2e-6)
    assert 1e-4 < x.std(axis=0).mean() < 0.05 and np.abs(x - state.x).max() < 0.3
    fresh = VaePrior(shipped()[0])
    np.testing.assert_allclose(fresh.mode(state)[0], mode, atol=1e-6)
    np.testing.assert_allclose(fresh.sample(state, 5, None)[0], mode[None], atol=1e-6)
    turn = Rotation.from_rotvec([0, 0, 1.0])
    quats = (turn * Rotation.from_quat(state.quat, scalar_first=True)).as_quat(scalar_first=True)
    shift, up = np.array([40.0, -7.0, 0.0]), np.array([0, 0, 0.5])
    moved = State(state.x @ turn.as_matrix().T + shift + up, state.v @ turn.as_matrix().T, quats)
    raised = VaePrior(shipped()[0], Plane(offset=0.5))
    np.testing.assert_allclose(raised.mode(moved)[0], mode @ turn.as_matrix().T + shift + up, atol=1e-4)
    floor = Plane([-0.27, 0.1, 1.0], 0.4)
    up, before = (incline(floor, p) for p in (state.x, state.x - STEP * state.v))
    climbing = VaePrior(shipped()[0], floor)
    on_slope = State(up, (up - before) / STEP, state.quat)
    np.testing.assert_allclose(climbing.mode(on_slope)[0], incline(floor, mode), atol=0.01)
    x = climbing.sample(on_slope, 4, RNG(0))[0]
    np.testing.assert_allclose(np.linalg.norm(body.DIFFERENCE @ x, axis=-1), np.tile(LENGTHS, (4, 1)), rtol=2e-6)
    assert np.abs(climbing.mode(state)[0] - mode).max() > 0.05
    lying = State((state.x - state.x[0]) @ Rotation.from_euler("y", 85, degrees=True).as_matrix().T + [0, 0, 0.2],
                  state.v, state.quat)  # fmt: skip
    head_down = State(state.x * [1, 1, -1] + [0, 0, 2.0], state.v, state.quat)
    for down in (lying, head_down):
        assert len(prior.sample(down, 4, RNG(0))[0]) == 0 and len(prior.sample(down, 4, None)[0]) == 0
        assert prior.mode(down)[0].shape == (N, 3)
        assert len(VaePrior(shipped()[0], down=0.0).sample(down, 4, RNG(0))[0]) == 4
    own = State(state.x, state.v, state.quat, 0, 0 * state.v)
    assert np.abs(prior.mode(own)[0] - mode).max() > 1e-3  # the prior's own velocities are what it sees
    np.testing.assert_allclose(VaePrior(shipped()[0], velocity="solved").mode(own)[0], mode, atol=1e-6)
    wide = VaePrior(shipped()[0], spread=0.5)
    faces = heading(wide.sample(state, 60, RNG(1))[1][:, 0]) - heading(turned[0])
    assert 0.3 < np.std(np.angle(np.exp(1j * faces))) < 0.7
    np.testing.assert_allclose(wide.mode(state)[0], mode, atol=1e-6)
    with pytest.raises(ValueError, match="own, solved"):
        VaePrior(shipped()[0], velocity="x")


def test_pose_range():
    """Inside: the very same array.  Outside: ‖E‖ comes down to about the bound, bones are exact, no net force."""
    _, pose, meta = shipped()
    limit = PoseRange(pose, meta["bound"], meta["angle"])
    x, quat = motion()
    assert limit(x[60], body.twists(quat[60])) is x[60] or np.array_equal(limit(x[60], body.twists(quat[60])), x[60])
    tight = PoseRange(pose, 0.5 * train.pose_norms(pose, recording(), np.array([60]))[0][0])
    out = tight(x[60], body.twists(quat[60]))
    assert np.abs(out - x[60]).max() > 1e-3
    np.testing.assert_allclose(np.linalg.norm(body.DIFFERENCE @ out, axis=-1), LENGTHS, rtol=1e-6)
    np.testing.assert_allclose(out.mean(axis=0), x[60].mean(axis=0), atol=1e-9)
    assert np.abs(np.cross(x[60] - x[60].mean(axis=0), out - x[60]).sum(axis=0)).max() < 1e-6  # and no torque
    R, _ = body.swing_twist(out, body.twists(quat[60]))
    assert tight.norm(np.swapaxes(R, 1, 2)[None].astype(np.float32))[0] < 2.0 * tight.bound
    bound, angle = train.calibrate(pose, recording())
    norms, mm = train.pose_norms(pose, recording(), np.arange(len(recording().x)))
    assert bound == pytest.approx(np.percentile(norms, 99.9)) and mm.mean() < 60
    R, _ = body.swing_twist(x[60], body.twists(quat[60]))
    C = np.swapaxes(R, 1, 2)[None].astype(np.float32)
    D = pose.decode(pose.encode(vae.pose_columns(C)))
    local = Rotation.from_matrix(R[0].T @ R[vae.POSE])  # SciPy's angles between the joints of q and D(E(q))
    apart = (local.inv() * Rotation.from_matrix(np.swapaxes(D[0, vae.POSE], 1, 2))).magnitude().max()
    assert pose_angles(vae.pose_columns(C), D)[0] == pytest.approx(apart, abs=1e-3)
    pose_now, twist = x[60], body.twists(quat[60])
    assert PoseRange(pose, 1e9, 0.99 * apart)(pose_now, twist) is not pose_now
    assert PoseRange(pose, 1e9, 1.01 * apart)(pose_now, twist) is pose_now
    found = train.detection(limit, recording(), RNG(0), n=20)
    assert found["recorded"][1] < 0.3 and min(f[1] for w, f in found.items() if w != "recorded") > 0.9
    assert found["knee 60 degrees backwards"][0] < 0.5, "‖E‖ alone sees it now: drop the angle"


@pytest.mark.parametrize("limits", ["vae", "limits"])
def test_drop_with_learned_priors(limits):
    """Five seconds of walking inside DROP: upright, on its feet, never NaN; a push moves it."""
    net, pose, meta = shipped()
    sim = Simulator(
        VaePrior(net),
        limits=PoseRange(pose, meta["bound"], meta["angle"]) if limits == "vae" else body.project_range_of_motion,
    )
    state, rng, force = start(sim), RNG(0), np.zeros((N, 3))
    begin = state.x[0].copy()
    for t in range(150):
        force[9, 1] = 60.0 if 60 <= t < 68 else 0.0
        state, out = sim.step(state, force, rng=rng)
        assert np.isfinite(state.x).all() and np.isfinite(list(out.energies.values())).all()
    assert state.x[0, 2] > 0.7 and np.linalg.norm(state.x[0] - begin) > 1.0


def test_free_rollout():
    """300 frames alone: finite, standing, near the recorded; the measure against a slow loop."""
    prior, rng = VaePrior(shipped()[0]), RNG(0)
    states = train.free_rollout(prior, start(Simulator(None)), 300, rng)
    x = np.array([s.x for s in states])
    assert np.isfinite(x).all() and 0.6 < x[:, 0, 2].min() and x[:, 0, 2].max() < 1.3
    bank = NearestPrior([motion(), motion("stand")])
    r = train.on_manifold(bank, states[:40], 0.1)
    d = [bank.nearest(s, 1)[1] for s in states[:40]]
    assert r["median"] == pytest.approx(np.median(d)) and r["inside"] == pytest.approx(np.mean(np.array(d) <= 0.1))
    assert r["longest"] <= 40


def test_command(tmp_path, monkeypatch, capsys):
    """python -m drop: every command, and one line for whatever is wrong."""
    monkeypatch.setattr(train, "recorded", lambda *a, **k: [motion(), motion("stand")])
    detection = train.detection
    monkeypatch.setattr(train, "detection", lambda *args: detection(*args[:-1], n=40))  # of 500 it takes half a minute

    def run(*args):
        with pytest.raises(SystemExit) as end:
            run_main(main, [str(a) for a in args])
        return end.value.code, capsys.readouterr()

    code, out = run("train", "--help")
    assert code == 0 and "--rollout" in out.out
    code, out = run("dance")
    assert code == 2 and out.err.count("\n") == 1 and "train, evaluate, rollout, ship" in out.err
    assert run()[0] == 2
    small = [w for k, v in TINY.items() for w in (f"--{k}", v)]
    code, out = run("train", "--out", tmp_path / "a", *small)
    assert code == 0 and "100.0%" in out.out
    code, out = run("train", "--resume", "--out", tmp_path / "a", "--hidden", 999)
    assert code == 2 and f"was started with --hidden {TINY['hidden']}; to resume, leave it out" in out.err
    code, out = run("train", "--resume", "--out", tmp_path / "a", "--updates", TINY["updates"] + 1)
    assert code == 0 and f"{TINY['updates'] + 1}" in out.out
    code, out = run("ship", "--out", tmp_path / "a", "--weights", tmp_path / "w.npz")
    assert code == 0 and "MIT" in out.out
    code, out = run("evaluate", "--weights", tmp_path / "w.npz")
    assert code == 0 and "one frame ahead" in out.out and "knee 60 degrees backwards" in out.out
    code, out = run("rollout", "--frames", 40)
    assert code == 0 and "prior alone: 40 frames, finite" in out.out and "inside DROP" in out.out
    code, out = run("evaluate", "--weights", tmp_path / "none.npz")
    assert code == 2 and "no checkpoint" in out.err
    assert json.loads((tmp_path / "a" / "config.json").read_text())["config"]["latent"] == 4

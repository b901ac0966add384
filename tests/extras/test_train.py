"""extras/train.py: where episodes start, what disturbs them, and motions that are read once."""

import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_env import rollout
from test_ppo import TINY, assert_same_run

import character
import ppo
import retarget
from character import TERMS
from env import Env, Uniform, headset_only
from extras import teacher, train
from extras.train import Curriculum, Disturbance, Options
from headset import body
from mocap import augment, data
from plumbing.cli import UserError, run_main
from plumbing.runs import CHECKPOINT, load_checkpoint, read_config
from plumbing.training import motions


def small(out="runs/x", **changes):
    return Options(**{"clips": "*stand*", "envs": 5, "horizon": 4, "threads": 1, "out": str(out)} | changes)


def run(out, updates, *more):
    """Run (or resume) the command line in this process, to `updates` updates in all."""
    args = list(more) if "--resume" in more else [*TINY, *more]
    train.main([*args, "--out", str(out), "--steps", str(64 * updates)])
    return load_checkpoint(Path(out) / CHECKPOINT)


# ------------------------------------------------------------------------------------ starts


def test_balanced_starts(char):
    """Half of the time by frames, half by failures: against simulated episodes; seeded and resumed exactly."""
    clips = [c[:n] for c, n in zip(data.builtin_clips(), (151, 121, 211), strict=False)]
    ref = retarget.reference(char, clips)
    n, rng = 6000, np.random.default_rng(0)
    starts, frames = Curriculum(ref, 100, balance=True), np.array([149, 119, 209])
    every, (drawn, upright) = starts.frames, starts.draw(rng, n)
    assert not upright.any()
    counts = np.bincount(drawn, minlength=len(ref))
    assert set(np.flatnonzero(counts)) <= set(every) and counts[every].min() > 0  # any start, nothing else
    expected = n / len(every)  # before anything has failed: by frames
    assert abs(counts[every].mean() - expected) < 1e-9 and counts.max() < 3 * expected
    hazard = np.array([0.001, 0.05, 0.004])  # failures a step
    starts.failed[:], starts.lived[:] = 7.0, 7.0 / hazard
    begun = np.bincount(starts.owner[starts.draw(rng, n)[0]], minlength=3)
    life = np.array([np.minimum(rng.geometric(h, 200_000), 100).mean() for h in hazard])  # steps of an episode
    time = frames / frames.sum() + frames * hazard / (frames @ hazard)  # the share wanted, times two
    np.testing.assert_allclose(begun * life / (begun @ life), time / 2, atol=0.03)

    small = Env(char, ref, 8, threads=1, seed=1, starts=Curriculum(ref, balance=True))
    small.reset(1)
    while True:
        before, where = (small.starts.failed.copy(), small.starts.lived.copy()), small.sequence.copy()
        _, _, terminated, truncated, info = small.step(np.zeros((8, small.action_size)))
        if terminated.any():
            break
    failed, lived = before
    for i in np.flatnonzero(terminated | truncated):
        failed[where[i]] = 0.9 * failed[where[i]] + terminated[i]
        lived[where[i]] = 0.9 * lived[where[i]] + info["length"][i]
    np.testing.assert_allclose(small.starts.failed, failed)
    np.testing.assert_allclose(small.starts.lived, lived)
    other = Env(char, ref, 8, threads=1, seed=5, starts=Curriculum(ref, balance=True))
    other.load_state(*small.state())
    for _ in range(30):
        a = np.full((8, small.action_size), 0.1)
        np.testing.assert_array_equal(small.step(a)[0], other.step(a)[0])


def test_retried_starts(char):
    """A share of the episodes starts 3 to 59 steps before a remembered failure, in its sequence; the rest anywhere."""
    clips = [c[:n] for c, n in zip(data.builtin_clips(), (151, 121, 211), strict=False)]
    ref = retarget.reference(char, clips)
    n, rng = 4000, np.random.default_rng(0)
    for balance in (False, True):
        starts = Curriculum(ref, retry=0.4, balance=balance)
        every, drawn = starts.frames, lambda starts=starts: np.bincount(starts.draw(rng, n)[0], minlength=len(ref))
        plain = drawn()  # nothing has failed yet
        assert plain[every].min() > 0 and plain[every].max() < 4 * n / len(every)
        starts.lost[:] = ref.first[2] + 100
        counts = drawn()
        near = np.arange(ref.first[2] + 41, ref.first[2] + 98)
        expected = 0.4 * n + 0.6 * n * len(near) / len(every)
        assert abs(counts[near].sum() - expected) < 0.05 * n and counts[near].min() > 0
        assert set(np.flatnonzero(counts)) <= set(every)
        starts.lost[:] = ref.first[1] + 10  # so soon that most starts would lie in the sequence before
        counts = drawn()
        assert set(np.flatnonzero(counts)) <= set(every)
        assert counts[ref.first[1] + 1] > 0.3 * n

    small = Env(char, ref, 64, threads=1, seed=1, starts=Curriculum(ref, retry=0.5))
    small.reset(1)
    fell = set()
    for _ in range(40):
        where = small.frame.copy()
        _, _, terminated, _, _ = small.step(np.zeros((64, small.action_size)))
        fell |= set(where[terminated] + 1)
    lost = small.starts.lost[small.starts.lost > 0]
    assert len(fell) > 20 and set(lost) <= fell and len(lost) > 20
    other = Env(char, ref, 64, threads=1, seed=5, starts=Curriculum(ref, retry=0.5))
    other.load_state(*small.state())
    for _ in range(30):
        a = np.full((64, small.action_size), 0.1)
        np.testing.assert_array_equal(small.step(a)[0], other.step(a)[0])
    arrays, meta = small.state()
    with pytest.raises(ValueError, match="env.starts.lost is beyond"):
        other.load_state(arrays | {"starts.lost": arrays["starts.lost"] + len(ref)}, meta)


@pytest.fixture(scope="module")
def visited(char):
    """Two walks and two visits, of 19 and 31 still frames or so."""
    clips = [c[:90] for c in data.builtin_clips()[:2]]
    return retarget.reference(char, clips + augment.visits(clips, np.random.default_rng(1))[:2])


def test_begun_starts(visited):
    """A share starts standing in the still frames of visits; with `balance` more often where it fails, up to MOST."""
    ref, n, rng = visited, 20_000, np.random.default_rng(0)
    assert list(ref.still > 1) == [False, False, True, True]
    frames, upright = Curriculum(ref, begin=0.4).draw(rng, n)
    assert upright.mean() == pytest.approx(0.4, abs=0.02)
    owner = Uniform(ref).owner
    for k in (2, 3):
        inside = frames[upright & (owner[frames] == k)]
        assert set(inside) == set(range(ref.first[k] + 1, ref.first[k] + ref.still[k]))
        assert len(inside) == pytest.approx(0.2 * n, rel=0.05)  # evenly
        counts = np.bincount(inside - inside.min())
        assert counts.min() > 0.7 * counts.mean()
    starts = Curriculum(ref, begin=1.0, balance=True)
    starts.failed[:], starts.lived[:] = [0, 0, 1, 3], 100.0
    frames, upright = starts.draw(rng, n)
    assert upright.all()
    assert np.mean(owner[frames] == 3) == pytest.approx((1 + 1.5) / (1 + 0.5 + 1 + 1.5), abs=0.02)
    _, upright = Curriculum(ref, begin=0.4, stand=0.5).draw(rng, n)  # and of the others a share stands, too
    assert upright.mean() == pytest.approx(1 - 0.6 * 0.5, abs=0.02)
    _, upright = Curriculum(ref, stand=0.5).draw(rng, n)
    assert upright.mean() == pytest.approx(0.5, abs=0.02)
    walks = replace(ref, still=np.zeros(4, int))
    with pytest.raises(UserError, match="--begin 0.4: no sequence begins with a user who stands"):
        Curriculum(walks, begin=0.4)


def test_early_starts(visited):
    """A share starts in the first frames of what begins in motion, and there more often where it fails, up to MOST."""
    ref, n, rng = visited, 20_000, np.random.default_rng(0)
    starts = Curriculum(ref, early=0.4)
    starts.failed[:], starts.lived[:] = [1, 9, 5, 5], 100.0
    frames, upright = starts.draw(rng, n)
    owner = Uniform(ref).owner
    into = frames - ref.first[owner[frames]]
    assert not upright.any() and into.min() >= 1  # the frame before is the user's, too
    for k, weight in ((0, 1 + 1 / 5), (1, 1 + 9 / 5)):
        early = (owner[frames] == k) & (into <= train.EARLY)
        uniform = 0.6 * train.EARLY / len(starts.frames)
        assert early.mean() == pytest.approx(0.4 * weight / 4 + uniform, abs=0.015)
        assert set(into[early]) == set(range(1, train.EARLY + 1))
    late = (owner[frames] >= 2) | (into > train.EARLY)
    assert late.mean() == pytest.approx(0.6, abs=0.03)
    with pytest.raises(UserError, match="--early 0.4: every sequence begins with a user who stands"):
        Curriculum(replace(ref, still=np.full(4, 20)), early=0.4)


def test_kinds_of_starts(visited, tmp_path):
    """A share of the draws goes to kinds of motion by how often they fail; within a kind most are where it fails."""
    p, failing, size = np.array([1.0, 3.0, 4.0, 0.0]), np.array([2.0, 2.0, 1.0, 0.0]), np.array([10.0, 30.0, 20.0, 5.0])
    kind = np.array([0, 0, 2, 3])  # fail 0.1 and 0.05 a unit of size; kind 1 has nobody, kind 3 never fails
    np.testing.assert_allclose(train.by_kind(p, failing, size, kind, 0.0), p / 8)
    a, b = 4 / 40 * np.sqrt(40), 1 / 20 * np.sqrt(20)
    np.testing.assert_allclose(train.by_kind(p, failing, size, kind, 1.0), np.array([a / 2, a / 2, b, 0]) / (a + b))
    half = (train.by_kind(p, failing, size, kind, 0) + train.by_kind(p, failing, size, kind, 1)) / 2
    np.testing.assert_allclose(train.by_kind(p, failing, size, kind, 0.5), half)
    twice = [np.concatenate([x, x[:2]]) for x in (p, failing, size, kind)]  # twice as much is recorded of kind 0
    assert train.by_kind(*twice, 1.0)[kind.tolist().index(2)] == pytest.approx(b / (np.sqrt(2) * a + b))
    often = train.by_kind(np.ones(4), np.array([9.0, 0.1, 0.1, 0.1]), np.ones(4), np.arange(4), 1.0)
    assert often[0] == pytest.approx(train.MOST * 9.3 / 4 / (train.MOST * 9.3 / 4 + 0.3))  # no more, however often

    ref, n, rng, owner = visited, 20_000, np.random.default_rng(0), Uniform(visited).owner
    frames = (ref.last - ref.first - 1).astype(float)
    for begin, balance in ((0.0, False), (0.0, True), (1.0, False), (1.0, True)):
        starts = Curriculum(ref, begin=begin, balance=balance, kinds=0.6, kind=[0, 1, 1, 0] if begin else [0, 1, 1, 1])
        starts.failed[:], starts.lived[:] = [2, 1, 1, 3], 100.0
        h = starts.failed / 100.0
        if begin:  # sequences 2 and 3 have still frames; each is a kind
            base = 1.0 + np.minimum(h[2:] / h[2:].mean(), train.MOST) if balance else np.ones(2)
            expected = [0, 0, *(0.4 * base / base.sum() + 0.6 * h[2:] / h[2:].sum())]
        else:
            steps = (1.0 - np.exp(-h * starts.horizon)) / h  # of an episode, on average
            time = frames * (1.0 + h / np.average(h, weights=frames)) if balance else frames * steps
            first, rest = h[0] * np.sqrt(frames[0]), (frames * h)[1:].sum() / np.sqrt(frames[1:].sum())
            within = rest * (frames * h)[1:] / (frames * h)[1:].sum()
            starts_of = (0.4 * time / time.sum() + 0.6 * np.array([first, *within]) / (first + rest)) / steps
            expected = starts_of / starts_of.sum()
        drawn = np.bincount(owner[starts.draw(rng, n)[0]], minlength=4) / n
        np.testing.assert_allclose(drawn, expected, atol=0.015)

    (tmp_path / "a/deeper").mkdir(parents=True)
    for name in ("a/x_1.bvh", "a/deeper/y-2_01.bvh", "p_0.csv"):
        (tmp_path / name).touch()
    opt = small(tmp_path / "run", motion=f"standing,{tmp_path / 'a'},builtin", players=str(tmp_path / "p_0.csv"))
    names = ["walk_3+7", "x_1+2", "x_1", "y-2_01-mirrored-restyled-speed1.1-h0.9a1.0t1.2-visit", "p_0-visit", "y-2"]
    names += ["y-2_x_1", "walk_4-mirrored-visit", "walk_4-mirrored-reversed-visit"]  # no file's: as what is built in
    np.testing.assert_array_equal(train.kind_of(names, opt), [0, 1, 1, 2, 3, 4, 5, 0, 6])


def test_begun_episodes_stand(char, visited):
    """In the environment: the default pose under the headset, at a still frame."""
    env = Env(char, visited, 200, threads=1, starts=Curriculum(visited, begin=1.0), root_limit=0.6)
    env.reset(3)
    assert np.abs(env.qpos[:, 7:] - char.default).max() < 1e-12 and not env.qvel[:, 2:].any()
    assert (visited.still[env.sequence] > env.frame - visited.first[env.sequence]).all()
    for _ in range(40):
        env.step(np.zeros((200, env.action_size)))
    assert env.starts.failed[2:].min() > 0.5  # and it counts


# ------------------------------------------------------------------------------------ disturbance


def test_disturbance(char, ref):
    """Sensor errors reach the two user parts' positions only; pushes change the root's horizontal velocity only."""
    n, zero = 400, np.zeros((400, 33))
    frames = np.resize(np.arange(5, 55), n)

    def pair(**kind):
        envs_ = Env(char, ref, n), Env(char, ref, n, disturbance=Disturbance(n, **kind))
        for e in envs_:
            e.reset(frames=frames)
        return envs_

    def errors(plain, disturbed):
        difference = (disturbed.full - plain.full).astype(float)
        parts = [np.arange(plain.full.shape[1])[plain.slices[k]][:9] for k in ("user_previous", "user")]
        np.testing.assert_array_equal(np.delete(difference, np.concatenate(parts), axis=1), 0.0)
        return [difference[:, p] for p in parts]

    plain, env = pair(sensor_offset=0.05)  # constant in an episode, in both frames
    first, second = errors(plain, env)
    np.testing.assert_allclose(first, second, atol=1e-6)
    assert first.std() == pytest.approx(0.05, rel=0.1)
    *_, terminated, truncated, _ = plain.step(zero)
    env.step(zero)
    same = ~(terminated | truncated)
    difference = env.full[:, env.slices["user"]][:, :9] - plain.full[:, env.slices["user"]][:, :9]
    np.testing.assert_allclose(difference[same], first[same], atol=1e-5)
    env.reset(frames=frames)  # another in the next
    assert np.abs(env.disturbance.error[:, 0] - first).min(axis=1).max() > 1e-3

    plain, env = pair(sensor_noise=0.02)
    plain.step(zero), env.step(zero)
    _, now = errors(plain, env)
    assert now.std() == pytest.approx(0.02, rel=0.1) and abs(now.mean()) < 0.002
    ended = plain.step(zero)[2]
    env.step(zero)
    before, later = errors(plain, env)
    np.testing.assert_allclose(before[~ended], now[~ended], atol=1e-5)  # what was seen stays seen
    assert np.abs(later - now).max() > 0.02

    _, env = pair(push=0.5)
    total, largest = 0, 0.0
    for _ in range(60):  # two seconds: one push each on average
        velocity = env.qvel.copy()
        env.disturbance.step(env)
        change = env.qvel - velocity
        assert not change[:, 2:].any()
        size = np.hypot(change[:, 0], change[:, 1])
        total, largest = total + np.sum(size > 0), max(largest, size.max())
    assert total == pytest.approx(n, rel=0.2) and 0.45 < largest <= 0.5

    kind = {"sensor_offset": 0.05, "sensor_noise": 0.02, "push": 0.5}
    env, other = (Env(char, ref, 16, seed=s, disturbance=Disturbance(16, **kind)) for s in (0, 9))
    env.reset(), other.reset()
    rollout(env, 5)
    arrays, meta = env.state()
    want = rollout(env, 8)
    other.load_state(arrays, meta)
    np.testing.assert_array_equal(rollout(other, 8), want)
    assert want[:, :, :2].any()

    less = headset_only(ref)
    noisy = Env(char, less, 300, disturbance=Disturbance(300, 1, 0.05, 0.02))
    plain = Env(char, less, 300)
    noisy.reset(frames=np.full(300, 9)), plain.reset(frames=np.full(300, 9))
    noisy.step(np.zeros((300, 33))), plain.step(np.zeros((300, 33)))
    error = (noisy.full - plain.full)[:, noisy.slices["user"]]
    assert error[:, :3].std() == pytest.approx(np.hypot(0.05, 0.02), rel=0.15) and not error[:, 3:].any()


# ------------------------------------------------------------------------------------ motions


def test_clips(tmp_path, capsys):
    """As they are; with `augment` mirrored, too; with `begin` or `visits` every one as a visit, too, twice."""
    plain = train.clips_of(small())
    assert [c.name for c in plain] == ["stand_007"]
    several = small(motion="builtin,standing", clips="*")
    want = data.sequences("builtin,standing", "train", seed=0, verbose=False)
    for a, b in zip(train.clips_of(several), want, strict=True):  # as ppo.py's
        assert a.name == b.name and np.array_equal(a.pos, b.pos)
    both = train.clips_of(small(augment=True))
    assert len(both) == 2 and "mirrored" in both[1].name and both[0].name == "stand_007"
    for more in ({"begin": 0.1}, {"visits": True}):
        visits = train.clips_of(small(**more))[1:]
        assert len(visits) >= 2 and all(c.name.endswith("-visit") and c.still > 1 for c in visits)
    assert "making visits of 1 clips" in capsys.readouterr().out
    # the clip, its visit, the other user's, and those of MORE users for one of a few; each part of 15 s, each another
    names = [c.name for c in train.clips_of(small(begin=0.1))[1:]]
    others = [n for n in names if "mirrored" in n]
    assert len(others) == (1 + train.MORE) * (len(names) - len(others)) and len(set(others)) == len(others)


def test_patience(ref):
    """The limit under a standing user, and more by the fastest of the last second and a half, sequence by sequence."""
    speed = np.linalg.norm(ref.qvel[:, :2], axis=1)
    found = train.patience(ref, 0.4, 0.2)
    for a, b in zip(ref.first, ref.last):
        for f in range(a, b + 1, 7):
            assert found[f] == pytest.approx(0.4 + 0.2 * speed[max(a, f - 44) : f + 1].max())
    np.testing.assert_array_equal(train.patience(ref, 0.4, 0.0), 0.4)
    assert len(ref.first) > 1  # a user who stood at the beginning has the wider limit
    visit = replace(ref, still=20 * (np.arange(len(ref.first)) == 1))
    limit, inside = train.patience(visit, 0.9, 0.1, near=0.33), Uniform(ref).owner == 1
    np.testing.assert_allclose(limit, train.patience(ref, 0.0, 0.1) + np.where(inside, 0.9, 0.33))
    env = Env(character.load("jesse"), ref, 4, threads=1, root_limit=found, autoreset=False)
    env.reset(frames=[int(ref.first[0])] * 4)
    limit = found[ref.first[0] + 1]
    env.qpos[:, 0] += [0.0, limit - 0.05, limit + 0.05, 3.0]
    far = env.step(np.zeros((4, env.action_size)))[4]["ends"]["far"]
    assert far.tolist() == [False, False, True, True]


def test_players(monkeypatch, tmp_path):
    """Recordings with bodies: each as two visits, and as it is, to be started under while the player stands."""
    person = data.builtin_clips()[2][:90]
    monkeypatch.setattr(body, "players", lambda folder: [person])
    with pytest.raises(UserError, match="--players .*: no recordings"):  # before anything is read
        train.clips_of(small(players=str(tmp_path), motion="no/such/folder"))
    (tmp_path / "a.csv").touch()
    clips = train.clips_of(small(players=str(tmp_path)))
    assert [c.still for c in clips[-1:]] == [45] and clips[-1].name == person.name
    assert sum(c.name.endswith("-visit") for c in clips) == 2
    keys = {train.key_of(small(players=p), character.load("jesse")) for p in (None, str(tmp_path))}
    assert len(keys) == 2


def test_short_clips_are_no_visits(monkeypatch):
    monkeypatch.setattr(data, "load", lambda *_, **__: [data.builtin_clips()[0][:20]])
    with pytest.raises(UserError, match="no clip of 1 s or more"):
        train.clips_of(small(visits=True))


def test_retargeted_in_parts(char, monkeypatch, capsys):
    """As `retarget.reference` does all at once, and a line for each part."""
    monkeypatch.setattr(train, "CHUNK", 2)
    clips = [c[:40] for c in data.builtin_clips()[:5]]
    want, found = retarget.reference(char, clips), train.retargeted(char, clips)
    for f in fields(want):
        np.testing.assert_array_equal(getattr(found, f.name), getattr(want, f.name), err_msg=f.name)
    out = capsys.readouterr().out
    assert "retargeted 2 of 5 clips, " in out and " left" in out and "retargeted 5 of 5 clips" in out


def equal(a, b):
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        assert type(x) is type(y), f.name
        np.testing.assert_array_equal(x, y, err_msg=f.name)


def test_cache(tmp_path, monkeypatch, capsys):
    """Made once for the same files, character and options; anew if any of them has changed."""
    folder = tmp_path / "motion"
    folder.mkdir()
    (folder / "take.bvh").write_text("1")
    monkeypatch.setattr(data, "load", lambda *_, **__: [data.builtin_clips()[0][:40]])
    jesse, opt = character.load("jesse"), small(tmp_path / "runs" / "a", motion=str(folder))
    made = train.reference_of(opt, jesse)
    assert "reading" in capsys.readouterr().out
    [file] = (tmp_path / "runs" / "cache").iterdir()
    again = train.reference_of(replace(opt, out=str(tmp_path / "runs" / "b"), lr=1.0, envs=3), jesse)
    says = capsys.readouterr().out
    assert "retargeted before" in says and str(file) in says and "reading" not in says
    equal(made, again)
    assert motions(made) == motions(again)
    keys = {file.stem}
    for other, char in (
        (replace(opt, augment=True), jesse),
        (replace(opt, seed=1), jesse),
        (replace(opt, begin=0.1), jesse),
        (opt, character.load("oppy")),
        (opt, character.load("jesse", scale=0.9)),
        (opt, character.load("jesse", set=["pose.spine_y=0.1"])),
    ):
        keys.add(train.key_of(other, char))
    tilted = character.load("jesse")
    tilted.model.geom_quat[-1] = [np.cos(0.15), 0.0, np.sin(0.15), 0.0]
    keys.add(train.key_of(opt, tilted))
    (folder / "take.bvh").write_text("22")
    keys.add(train.key_of(opt, jesse))
    monkeypatch.setattr(train, "CODE", -1)
    keys.add(train.key_of(opt, jesse))
    assert len(keys) == 10
    monkeypatch.undo()
    (folder / "take.bvh").write_text("1")
    stronger = character.load("jesse", set=["torque.base.default=100", "training.lr=1.0", "reward.q=[1, 1]"])
    assert train.key_of(replace(opt, sensors="hmd"), stronger) == train.key_of(opt, jesse)  # these change nothing in it


def test_damaged_cache(tmp_path, monkeypatch, capsys):
    """Whatever is wrong with it: one line, and it is made anew; never unpickled."""
    monkeypatch.setattr(data, "load", lambda *_, **__: [data.builtin_clips()[0][:40]])
    jesse, opt = character.load("jesse"), small(tmp_path / "a")
    want = train.reference_of(opt, jesse)
    [file] = (tmp_path / "cache").iterdir()
    whole, capture = file.read_bytes(), capsys.readouterr
    arrays, meta = load_checkpoint(file)

    def saved(**changes):
        told = np.frombuffer(changes.pop("meta", b'{"names": ["a"], "rate": 30.0}'), np.uint8)
        np.savez(file, __meta__=told, **arrays | changes)

    capture()
    for damage in (
        lambda: file.write_bytes(whole[:-900]),
        lambda: file.write_bytes(b""),
        lambda: np.savez(file, a=np.array([{}], object)),
        lambda: saved(qpos=arrays["qpos"][:, :-1]),
        lambda: saved(qpos=np.full_like(arrays["qpos"], np.nan)),
        lambda: saved(last=arrays["last"] + 5),
        lambda: saved(first=arrays["first"][:0]),
        lambda: saved(meta=b'{"names": [], "rate": 30.0}'),
        lambda: saved(meta=b"[]"),
        lambda: saved(more=np.zeros(3)),
    ):
        damage()
        equal(train.reference_of(opt, jesse), want)
        out, err = capture()
        assert err.startswith("note: ") and str(file) in err and err.count("\n") == 1 and "reading" in out
        assert file.read_bytes() == whole
    shutil.rmtree(tmp_path / "cache")
    (tmp_path / "cache").write_text("in the way")
    equal(train.reference_of(opt, jesse), want)
    assert "not kept for the next run" in capture().err


# ------------------------------------------------------------------------------------ training


def test_without_what_weighs_nothing(tmp_path, capsys):
    train.make_env(replace(small(tmp_path / "a"), without=("contact",)))
    assert "note: --without contact changes nothing: jesse's reward" in capsys.readouterr().err


def test_switches_reach_the_environment(tmp_path):
    opt = small(tmp_path / "a")
    plain, again = train.make_env(opt), train.make_env(opt)
    assert type(plain.starts) is Uniform and plain.disturbance is None and (plain.root_limit == 0.30).all()
    assert motions(plain.ref) == motions(again.ref) == motions(ppo.make_env(opt).ref)
    more = dict(sensor_offset=0.02, sensor_noise=0.01, push=0.3, root_limit=0.5, episode=77, solver="newton")
    more |= dict(balance=True, stand=0.2, kinds=0.3, sensors="hmd", without=("contact", "asymmetric"))
    env = train.make_env(replace(opt, **more))
    d, s = env.disturbance, env.starts
    assert (d.sensor_offset, d.sensor_noise, d.push, d.error.shape) == (0.02, 0.01, 0.3, (5, 3, 3))
    assert (s.balance, s.retry, s.stand, s.begin, s.kinds, s.horizon) == (True, 0.0, 0.2, 0.0, 0.3, 77)
    assert len(s.kind) == len(env.ref.names)
    assert (env.n, env.horizon, env.root_limit[0], env.devices, env.asymmetric) == (5, 77, 0.5, 1, False)
    assert {t for t in TERMS if env.char.reward[t][0] == 0} == {"contact"}
    assert env.char.model.opt.iterations == 100 != plain.char.model.opt.iterations
    other = train.make_env(replace(opt, augment=True))
    frames = len(plain.ref)
    np.testing.assert_array_equal(other.ref.qpos[:frames], plain.ref.qpos)
    assert motions(other.ref) != motions(plain.ref)
    assert motions(other.ref) != motions(train.make_env(replace(opt, augment=True, seed=1)).ref)


def test_aid(char, ref):
    """The hand against SciPy's rotations, one character at a time; less of it the less a sequence fails, none from
    AIDED on."""
    n = 64
    env = Env(char, ref, n, starts=Curriculum(ref, balance=True), disturbance=Disturbance(n, aid=0.8))
    env.starts.failed[:], env.starts.lived[:] = 1.0, 2.0 / env.dt  # fails every 2 s
    env.reset(frames=np.resize(np.arange(5, 55), n))
    pull = env.disturbance.pull.copy()
    assert 0.0 <= pull.min() < 0.1 and 0.5 < pull.max() <= 0.8 * (1.0 - 2.0 / train.AIDED)
    rng = np.random.default_rng(1)
    env.qpos[:, :7] += 0.1 * rng.standard_normal((n, 7))
    env.qpos[:, 3:7] *= rng.choice([-1.0, 1.0], (n, 1)) / np.linalg.norm(env.qpos[:, 3:7], axis=1, keepdims=True)
    env.qvel[:] += rng.standard_normal(env.qvel.shape)
    before = env.qvel.copy()
    env.disturbance.step(env)
    np.testing.assert_array_equal(env.qvel[:, 6:], before[:, 6:])
    for i in range(n):
        f = env.frame[i] + 1
        own, target = (Rotation.from_quat(q, scalar_first=True) for q in (env.qpos[i, 3:7], ref.qpos[f, 3:7]))
        turn = (own.inv() * target).as_rotvec()
        small = np.linalg.norm(turn) / 2
        wanted = ref.qvel[f, :6] + np.concatenate(
            [ref.qpos[f, :3] - env.qpos[i, :3], turn * np.sin(small) / small]) / train.REACHED  # fmt: skip
        np.testing.assert_allclose(env.qvel[i, :6], (1 - pull[i]) * before[i, :6] + pull[i] * wanted, atol=1e-6)
    env.starts.lived[:] = train.AIDED / env.dt
    env.reset()
    assert not env.disturbance.pull.any()


def test_resume_is_exact_when_disturbed(tmp_path):
    """The same with everything on that draws random numbers: other users, device errors, pushes."""
    more = "--augment --balance --retry 0.3 --stand 0.3 --begin 0.3 --sensor-offset 0.02 --sensor-noise 0.005".split()
    more += ["--push", "5", "--kinds", "0.3", "--aid", "0.5"]
    run(tmp_path / "whole", 4, *more)
    run(tmp_path / "a", 2, *more)
    run(tmp_path / "a", 4, "--resume")
    assert_same_run(tmp_path / "whole", tmp_path / "a")


def test_recipe_keys_are_options():
    """What [training] may hold is what can be told: nothing in a recipe is passed over, and the three recipes train."""
    assert {k.removesuffix("?") for k in character.TRAINING} - {"by"} <= {f.name for f in fields(Options)}
    for name in character.available():
        recipe = character.load(name).training
        assert recipe["by"] == Options.BY
        opt = train.read_options(Options, ["--character", name, "--out", "runs/never"], "extras.train", "")
        assert {k: getattr(opt, k) for k in recipe if k != "by"} == {
            k: tuple(v) if isinstance(v, list) else v for k, v in recipe.items() if k != "by"
        }


def test_ppo_hands_on(tmp_path, capsys):
    """`python ppo.py` trains by the recipe, and resumes what it began; a module that is none is one line."""
    out = tmp_path / "a"
    tiny = "--clips *stand* --envs 8 --horizon 8 --minibatch 32 --hidden 12 --value-hidden 8 --threads 1".split()
    ppo.main(["--character", "oppy", *tiny, "--steps", "64", "--out", str(out)])
    assert capsys.readouterr().out.startswith("trained by extras.train")
    config = read_config(out)["config"]
    assert config["by"] == "extras.train" and config["balance"] is True and config["root_limit"] == 0.45
    assert config["hidden"] == [12] and config["sigma"] == 0.06
    ppo.main(["--resume", "--out", str(out), "--steps", "128"])
    arrays, meta = load_checkpoint(out / CHECKPOINT)
    assert meta["updates"] == 2 and arrays["env.starts.lost"].shape == (train.PLACES,)
    before = (out / "config.json").read_bytes()
    with pytest.raises(UserError, match="was trained by extras.train; valid: python ppo.py --resume --out"):
        teacher.main(["--resume", "--out", str(out)])  # its rows would not fit, and no teacher has taught
    assert (out / "config.json").read_bytes() == before
    with pytest.raises(UserError, match="was started with --balance True"):
        ppo.main(["--resume", "--out", str(out), "--no-balance"])
    for module in ("extras.nothing", "extras.gpu"):
        with pytest.raises(UserError, match=f"trained by '{module}': no such trainer"):
            ppo.main(["--character", "oppy", "--set", f"training.by='{module}'"])
    (out / "config.json").write_text((out / "config.json").read_text().replace("extras.train", "os"))
    with pytest.raises(UserError, match="trained by 'os': no such trainer"):
        ppo.main(["--resume", "--out", str(out)])


def test_gpu_is_refused_where_it_cannot_be(tmp_path, capsys):
    out = tmp_path / "run"
    run(out, 1)
    with pytest.raises(UserError, match="--gpu goes on with --init"):
        train.train(replace(small(out), gpu=True, resume=True))
    with pytest.raises(SystemExit):
        run_main(train.main, ["--help"])
    assert "--gpu" in capsys.readouterr().out

"""skeletal/train.py: the whole losses' gradients, steps, resuming, statistics."""

from dataclasses import replace

import numpy as np
import pytest

from human import quat_about, quat_mul
from plumbing import runs
from skeletal import data, layers, train
from skeletal.data import Motion, Skeleton
from skeletal.net import carry_root

NAMES = ("hips", "spine", "chest", "thigh_l", "shin_l", "foot_l", "toe_l", "thigh_r", "shin_r", "foot_r", "toe_r")
PARENTS = (-1, 0, 1, 0, 3, 4, 5, 0, 7, 8, 9)
LEG = [[0.05, 0, -0.4], [-0.05, 0, -0.4], [0.15, 0, -0.08]]
OFFSETS = np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0.3], [0, 0.1, 0], *LEG, [0, -0.1, 0], *LEG], float)
BODY = Skeleton(NAMES, PARENTS, OFFSETS, (6, 10))


def walk(n=80, skeleton=BODY, seed=0, name="walk_001"):
    """A motion of smooth random turns that travels."""
    r, t = np.random.default_rng(seed), np.arange(n) / data.RATE
    J = len(skeleton.names)
    angle = 0.25 * np.sin(2 * np.pi * (r.uniform(0.5, 1.2, (J, 3)) * t[:, None, None] + r.uniform(0, 1, (J, 3))))
    angle[:, 0, 2] += 0.4 * t
    q = quat_about(0, angle[..., 0])
    for axis in (1, 2):
        q = quat_mul(quat_about(axis, angle[..., axis]), q)
    pos = np.stack([1.2 * t, 0.1 * np.sin(t), 0.92 + 0.02 * np.sin(9 * t)], axis=1)
    return Motion(name, skeleton, pos, q)


def small_trainer(dtype=np.float32, **settings):
    """Two structures, two characters each, without files."""
    opt = train.TrainOptions(**({"batch": 2, "characters": 2} | settings))
    r = np.random.default_rng(0)
    domains = []
    for s, seed in ((BODY, 0), (data.derive(BODY), 10)):
        cast = [data.proportions(s, r) for _ in range(2)]
        structure = train.derived_structure(s, data.Structure((), (), None, (), (), "z", 1.0))
        clips = [(k, walk(70 + 20 * k, c, seed + k)) for k, c in enumerate(cast)]
        domains.append(train.Domain(cast, clips, structure=structure))
    return train.Trainer(opt, domains, dtype, (2, 3))


# ------------------------------------------------------------------------------------ losses and steps


def check_along(array, direction, f, analytic, step=1e-7):
    """A directional derivative, one number for all of `array`.  A tiny step: thousands of rectifiers have kinks."""
    kept, size = array.copy(), step / np.linalg.norm(direction)
    values = []
    for sign in (1.0, -1.0):
        array[...] = kept + sign * size * direction
        values.append(f())
    array[...] = kept
    numeric = (values[0] - values[1]) / (2 * size)
    assert abs(numeric - analytic) < 1e-6 * np.linalg.norm(direction) + 1e-5 * abs(analytic), (numeric, analytic)


@pytest.mark.parametrize(
    "n, without, root",
    [(0, None, "carried"), (0, None, "decoded"), (1, None, "decoded"), (1, None, "carried"),
     *((1, term, "carried") for term in train.TERMS)],
)  # fmt: skip
def test_whole_loss_gradient(n, without, root):
    """[SAN-8] of one direction, cross and within, with each loss left out once, the root carried or decoded: both
    generators' whole gradients."""
    tr = small_trainer(np.float64, without=without, root=root)
    rng = np.random.default_rng(1)
    x, turn, who = tr.domains[0].sample(rng, 2)
    batch = (x.astype(float), turn, who)
    targets = np.array([0, 1])
    for net in (*tr.nets, *tr.critics):
        net.theta += 0.1 * rng.standard_normal(net.theta.shape)

    def loss():
        kept = [net.grad.copy() for net in (*tr.nets, *tr.critics)]
        losses, *_ = tr.direction(0, n, batch, targets)
        for net, g in zip((*tr.nets, *tr.critics), kept):
            net.grad[:] = g
        return sum(tr.weights[k] * v for k, v in losses.items())

    losses, *_ = tr.direction(0, n, batch, targets)
    assert set(losses) == set(train.TERMS) - {without}
    for net in tr.nets[: n + 1]:
        u = rng.standard_normal(net.theta.shape)
        check_along(net.theta, u, loss, net.grad @ u, 3e-7)
    assert np.any(tr.nets[1].grad) == (n == 1)


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.parametrize("ee_height", [False, True])
def test_direction_by_the_equations(n, ee_height, monkeypatch):
    """[SAN-3] to [SAN-7] put together once more from their parts: whose encoder, decoder, statistics and offsets."""
    monkeypatch.setitem(layers.CHOICES, "ours", layers.Choices(ee_height=ee_height, carry_root=False))
    tr = small_trainer(np.float64)
    A, B, G, H = tr.domains[0], tr.domains[n], tr.nets[0], tr.nets[n]
    x, turn, who = A.sample(np.random.default_rng(1), 2)
    targets = 1 - who  # nobody retargets to himself
    losses, (real, s_real), (fake, s_fake) = tr.direction(0, n, (x, turn, who), targets)
    s_a, s_b = (np.stack([(c.offsets / c.leg).ravel() for c in (d.characters[k] for k in w)], axis=-1)
                for d, w in ((A, who), (B, targets)))  # fmt: skip
    np.testing.assert_allclose(s_real, s_a, atol=1e-6), np.testing.assert_allclose(s_fake, s_b, atol=1e-6)
    f_a, f_b = G.static_forward(s_real)[0], H.static_forward(s_fake)[0]
    z = G.encode_forward(x, f_a)[0]
    y = H.decode_forward(z, f_b)[0]  # [SAN-3]
    assert losses["ltc"] == pytest.approx(np.abs(H.encode_forward(y, f_b)[0] - z).mean())
    score = tr.critics[n].forward(fake, s_fake)[0]
    assert losses["adv"] == pytest.approx(np.mean((score - 1.0) ** 2))  # the generator wants to pass as real
    ee, wanted = 0.0, np.empty((2, 2), object)
    for i in range(2):
        for row, (d, k, v) in enumerate(((A, who[i], x), (B, targets[i], y))):
            c = d.characters[k]
            m = data.from_features(v[..., i].T * d.std[k] + d.mean[k], turn[:, i], c)
            h = c.height if ee_height else c.reach()[:, None]
            wanted[row, i] = np.diff(data.pose(m)[0][:, c.graph.leaves], axis=0) / h
        ee += np.sum((wanted[0, i] - wanted[1, i]) ** 2) / (2 * (train.WINDOW - 1))
    assert losses["ee"] == pytest.approx(ee, rel=1e-4)
    again = (G.decode_forward(z, f_a)[0] - x) ** 2
    assert losses["rec"] > again.mean()  # and the positions' part


def test_critics_tell_fakes():
    """[SAN-6] A critic that trains alone gives real motions more than fakes, and its loss falls."""
    tr = small_trainer(lr=1e-2)
    r, s, C, values = np.random.default_rng(0), np.zeros((33, 16), np.float32), tr.critics[0], []
    fake = r.standard_normal((33, 64, 16)).astype(np.float32)
    real = np.repeat(r.standard_normal((33, 1, 16)), 64, axis=1).astype(np.float32)  # standing still
    for _ in range(30):
        C.grad[:] = 0.0
        values.append(tr._critic_step(C, (real, s), (fake, s)))
        tr.adams[2].step(C.theta, C.grad)
    assert values[-1] < 0.5 * values[0]
    assert C.forward(real, s)[0].mean() > C.forward(fake, s)[0].mean() + 0.1


def test_critics_see_the_pools_fakes():
    """[SAN-6] What each critic is shown as fake is what its own pool gives for the new ones, which the pool keeps."""
    tr, shown = small_trainer(intra=0.0), []
    judge, exchange = tr._critic_step, [pool.exchange for pool in tr.pools]
    for n, pool in enumerate(tr.pools):
        pool.exchange = lambda bones, s, rng, n=n: (exchange[n](bones, s, rng)[0] + 100.0 * (n + 1), s)
    tr._critic_step = lambda C, real, fake: (shown.append((C, real[0], fake[0])), judge(C, real, fake))[1]
    for step in range(1, 3):
        tr.step()
        assert [len(pool.bones) for pool in tr.pools] == [2 * step] * 2
    assert [C for C, *_ in shown] == [*tr.critics] * 2
    for k, (_, real, fake) in enumerate(shown):
        away = 100.0 * (k % 2 + 1)
        assert np.abs(fake - away).max() < 20 and np.abs(real).max() < 20  # shown by way of the pool; the real ones not


def test_targets_are_all_of_the_targets_structure():
    """Every character of the structure that is retargeted to, across and within, is a target as often as any other."""
    tr = small_trainer(batch=8, without="adv", intra=0.3)
    cast = tr.domains[1].characters
    cast += [cast[0]] * 3  # two here, five there
    drawn = {}
    tr.direction = lambda m, n, batch, targets: (drawn.setdefault((m, n), []).extend(targets), ({}, None, None))[1]
    for _ in range(60):
        tr.step()
    assert set(drawn) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    for (_, n), targets in drawn.items():
        share = np.bincount(targets, minlength=len(tr.domains[n].characters)) / len(targets)
        np.testing.assert_allclose(share, 1 / len(tr.domains[n].characters), atol=0.15)
    assert 0.1 < len(drawn[0, 0]) / (60 * 8) < 0.5  # `intra`


def test_root_is_carried():
    """The fake's root moves and stands as the source's, in legs, whatever the decoder says; decoded, it does not."""
    x, turn, who = small_trainer().domains[0].sample(np.random.default_rng(1), 2)
    targets, wanted = np.array([0, 1]), None
    for root in ("carried", "decoded"):
        tr = small_trainer(root=root)
        _, (real, _), (fake, _) = tr.direction(0, 1, (x, turn, who), targets)
        wanted = real[:3]  # row 0 of the bones is the root's velocity and height
        close = np.abs(fake[:3] - wanted).max() < 1e-5
        assert close == (root == "carried") == tr.choices.carry_root
        # The decoder's weights for these channels get no gradient.
        for net in tr.nets:
            bias = net.grads[net.d[1]][2]
            assert np.any(bias[3:]) and np.any(bias[:3]) == (root == "decoded")
    assert [train.choices_of(v).carry_root for v in ("ours", "paper", "code")] == [True, False, False]
    y, mean, std = np.zeros((5, 2, 1)), np.arange(5.0)[:, None, None], np.full((5, 1, 1), 2.0)
    carry_root(y, np.full((4, 2, 1), 6.0), mean, std)
    np.testing.assert_array_equal(y[:, 0, 0], [3.0, 2.5, 2.0, 0.0, 0.0])


def test_step_learns():
    tr = small_trainer(lr=5e-3)
    first = [tr.step() for _ in range(5)]
    for _ in range(25):
        tr.step()
    last = [tr.step() for _ in range(5)]
    mean = lambda rows, k: np.mean([r[k] for r in rows])  # noqa: E731
    assert mean(last, "rec") < 0.5 * mean(first, "rec")
    assert all(np.isfinite(list(r.values())).all() for r in last)


def test_resume_is_exact():
    a, b = small_trainer(), small_trainer(seed=5)
    for _ in range(3):
        a.step()
    arrays = {k: np.array(v) for k, v in a.arrays().items()}
    b.load(arrays, {"rng": runs.rng_state(a.rng), "steps": 3})
    for tr in (a, b):
        tr.step(), tr.step()
    assert all(np.array_equal(x.theta, y.theta) for x, y in zip((*a.nets, *a.critics), (*b.nets, *b.critics)))
    assert a.step_count == b.step_count == 5


def test_variants_differ():
    """Each side of the errata table is another loss or another network."""
    rows = []
    for variant in layers.CHOICES:
        tr = small_trainer(variant=variant)
        rows.append(tr.step())
    assert len({round(r["rec"], 9) for r in rows}) == 3
    tr = {v: small_trainer(variant=v) for v in layers.CHOICES}
    g = layers.Graph(tr["ours"].domains[0].parents)
    for v, mean, scale, ends in (("ours", 0, 1.0, 1), ("paper", 1, 1.0, 1), ("code", 0, 0.01, 0)):
        for plan in (tr[v].nets[0].plans[0], tr[v].critics[0].plans[0]):
            near = g.neighbours(2, bool(ends))
            assert [p.tolist() for p in plan.near] == [p.tolist() for p in near] and plan.static_scale == scale
            assert plan.scale == [1 / len(p) if mean else 1.0 for p in near]
        assert tr[v].choices.ee_height == (v == "code")
    assert [tuple(layers.CHOICES[v].weights) for v in ("paper", "code")] == [(1, 1, 0.25, 2), (5, 2.5, 1, 333)]


def test_statistics():
    """Per character; one deviation an armature; a stranger's from its nearest proportions."""
    d = small_trainer().domains[0]
    x = np.concatenate([x for k, x, _ in d.arrays if k == 1])
    np.testing.assert_allclose(d.mean[1], x.mean(axis=0), atol=1e-5)
    assert d.std[1][7:11].std() == 0 and d.std[1][7] == pytest.approx(
        max(np.sqrt(x[:, 7:11].var(0).mean()), 0.02), rel=1e-4
    )
    for k, c in enumerate(d.characters):  # one who was trained on has his own, whoever else is like him
        near = replace(c, offsets=c.offsets * 1.00001)
        assert np.array_equal(d.statistics_of(near)[0], d.mean[k]) and np.array_equal(d.statistics_of(c)[1], d.std[k])
    half = replace(
        BODY,
        offsets=np.exp(
            0.5 * (np.log(np.abs(d.characters[0].offsets) + 1e-9) + np.log(np.abs(d.characters[1].offsets) + 1e-9))
        ),
    )  # noqa: E501
    mean = d.statistics_of(half)[0]
    low, high = np.minimum(*d.mean) - 1e-6, np.maximum(*d.mean) + 1e-6
    assert np.all((mean >= low) & (mean <= high))

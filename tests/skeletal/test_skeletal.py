"""skeletal/layers.py, skeletal/net.py: operators against slow loops and other libraries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import shortest_path
from scipy.spatial.transform import Rotation

from plumbing.cli import UserError
from skeletal import layers, net

HUMAN = (-1, 0, 1, 2, 3, 2, 5, 6, 7, 2, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19)  # trunk, head, arms, legs
SMALL = (-1, 0, 1, 2, 0, 4, 5, 6)  # two chains, of three and of four bones


@st.composite
def trees(draw):
    """Parents of a random tree of 3 to 25 joints, with long chains."""
    n = draw(st.integers(3, 25))
    back = draw(st.lists(st.sampled_from([1, 1, 1, 2, 3, 7]), min_size=n - 1, max_size=n - 1))
    return [-1] + [max(j - b, 0) for j, b in zip(range(1, n), back)]


def rngs(seed=0):
    return np.random.default_rng(seed)


# ------------------------------------------------------------------------------------ the graph


def test_distances_against_floyd():
    """Edge distances equal shortest paths in the line graph."""
    g = layers.Graph(HUMAN)
    nodes = [{j, HUMAN[j]} if j else {0, -1} for j in range(len(HUMAN))]  # the root's stub ends in nothing
    touch = np.array([[a != b and bool(nodes[a] & nodes[b]) for b in range(len(HUMAN))] for a in range(len(HUMAN))])
    np.testing.assert_array_equal(g.distances(), shortest_path(touch.astype(float), unweighted=True))


def test_neighbours():
    """Within d; the root also sees the end effectors, unless as in the published code."""
    g = layers.Graph(HUMAN)
    near = g.neighbours(2)
    assert near[4].tolist() == [2, 3, 4, 5, 9]  # head: neck; chest and both shoulders at distance 2
    assert set(g.leaves) <= set(near[0]) and set(g.leaves) == {4, 8, 12, 16, 20}
    assert near[0].tolist() == [0, 1, 2, 4, 8, 12, 13, 14, 16, 17, 18, 20]
    assert g.neighbours(2, root_ends=False)[0].tolist() == [0, 1, 2, 13, 14, 17, 18]
    assert g.neighbours(1, False)[15].tolist() == [14, 15, 16]


@given(trees())
@settings(max_examples=30, deadline=None)
def test_pooling_keeps_the_tree(parents):
    """Pooling removes nodes of degree 2 and nothing else: the pooled graph is homeomorphic to the first."""
    g = layers.Graph(parents)

    def shape(graph):  # of the tree without its nodes of degree 2; the root counts its stub
        def walk(j):
            while j and len(graph.children[j]) == 1:
                j = graph.children[j][0]
            return tuple(sorted(walk(c) for c in graph.children[j]))

        return walk(0)

    for whole in (False, True):
        pooled, groups = g.pool(whole)
        assert sorted(j for m in groups for j in m) == list(range(len(g)))  # a partition
        assert shape(pooled) == shape(g)
        assert all(0 <= pooled.parents[k] < k for k in range(1, len(pooled)))
        for m in groups:
            assert all(g.parents[b] == a and len(g.children[a]) == 1 for a, b in zip(m, m[1:]))  # along chains
            assert whole or len(m) <= 2
        if not whole:  # odd remainders stay alone nearest the root
            for chain in g.chains():
                sizes = [len(m) for m in groups if m[0] in chain]
                assert sizes == [1] * (len(chain) % 2) + [2] * (len(chain) // 2)
    primal, groups = g.pool(whole=True)
    assert all(len(primal.children[k]) != 1 for k in range(1, len(primal)))
    assert len(primal.pool(whole=True)[0]) == len(primal)  # nothing is left to merge


def test_human_has_seven_primal_armatures():
    """[SAN §5.2] 21 -> 11 -> 7; both pairs and whole chains are needed, as pairs alone do not shorten five to one."""
    once, _ = layers.Graph(HUMAN).pool()
    assert len(once) == 11 and len(once.pool(whole=True)[0]) == 7
    five, _ = layers.Graph((-1, 0, 1, 2, 3, 4, 0, 6)).pool()
    assert len(five) == 5 and len(five.pool()[0]) == 4 and len(five.pool(whole=True)[0]) == 3


@pytest.mark.parametrize("parents", [(), (-1,), (-1, 0)])
def test_small_skeletons_are_errors(parents):
    with pytest.raises(UserError, match="two bones or more"):
        layers.Graph(parents)
    with pytest.raises(UserError, match="no tree"):
        layers.Graph((-1, 2, 0, 1))


def test_match_primal():
    """Children in another order are found by where their ends are; extra joints on chains do not matter."""
    a = layers.Graph((-1, 0, 1, 0, 3))
    at_a = np.array([[0, 0, 0], [0, 0.1, -0.5], [0, 0.1, -1], [0, -0.1, -0.5], [0, -0.1, -1]], float)
    b = layers.Graph((-1, 0, 0, 2, 3, 1))  # right leg first; left with one joint more
    at_b = np.array([[0, 0, 0], [0, -0.1, -0.5], [0, 0.1, -0.3], [0, 0.1, -0.6], [0, 0.1, -1], [0, -0.1, -1]], float)
    order = layers.match_primal(a, b, at_a, at_b, "abcde", "uvwxyz")
    assert order.tolist() == [0, 2, 3, 4, 1, 5]


def test_different_primals_show_both():
    a, b = layers.Graph((-1, 0, 0)), layers.Graph((-1, 0, 0, 0))
    with pytest.raises(UserError, match=r"hip\(left, right\).*root\(x, y, z\)"):
        layers.match_primal(a, b, np.zeros((3, 3)), np.zeros((4, 3)), ["hip", "left", "right"], ["root", "x", "y", "z"])


# ------------------------------------------------------------------------------------ layers


def conv_case(stride, kernel=5, static=2, seed=0, mean=False):
    r = rngs(seed)
    near = layers.Graph(SMALL).neighbours(1)
    choices = layers.Choices(neighbour_mean=mean, static_scale=0.3)
    plan = layers.plan_conv(near, [3] + [2] * 7, [1, 2, 3, 1, 1, 2, 2, 1], static, kernel, stride, choices)
    shapes = plan.shapes()
    weights = ([r.standard_normal(s) for s in shapes[0]], [r.standard_normal(s) for s in shapes[1]],
               r.standard_normal(shapes[2]))  # fmt: skip
    x = r.standard_normal((plan.n_in, 8, 3))
    s = r.standard_normal((plan.n_static, 3)) if static else None
    return plan, near, weights, x, s, r


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("mean", [False, True])
def test_conv_equals_slow_loop(stride, mean):
    """[SAN-1] as it is printed: armature by armature, static features tiled over time and concatenated."""
    plan, near, (W, V, b), x, s, _ = conv_case(stride, mean=mean)
    y, _ = layers.conv_forward(x, s, (W, V, b), plan)
    T, B, half = 8, 3, plan.kernel // 2
    starts_in, starts_s = np.cumsum([0, 3] + [2] * 7), np.arange(0, 17, 2)
    reflect = lambda t: -t if t < 0 else 2 * (T - 1) - t if t >= T else t  # noqa: E731
    for i, neighbours in enumerate(near):
        for o in range(W[i].shape[1]):
            for u in range(T // stride):
                for n in range(B):
                    total = 0.0
                    col = 0
                    for j in neighbours:
                        for c in range(starts_in[j], starts_in[j + 1]):
                            for k in range(plan.kernel):
                                total += x[c, reflect(stride * u + k - half), n] * W[i][k, o, col]
                            col += 1
                    for place, c in enumerate(c for j in neighbours for c in range(starts_s[j], starts_s[j + 1])):
                        for _ in range(plan.kernel):  # tiled: the same value under every tap; V is the taps' sum
                            total += 0.3 * s[c, n] * V[i][o, place] / plan.kernel
                    scale = 1 / len(neighbours) if mean else 1.0
                    wanted = scale * total + b[plan.out[i]][o]
                    assert abs(y[plan.out[i]][o, u, n] - wanted) < 1e-10


def test_conv_refuses():
    plan, _, weights, x, s, _ = conv_case(2)
    with pytest.raises(ValueError, match="expected"):
        layers.conv_forward(x[:, :7], s, weights, plan)
    with pytest.raises(ValueError, match="expected"):
        layers.conv_forward(x[:, :2], s, weights, plan)
    with pytest.raises(ValueError, match="odd"):
        layers.plan_conv([np.array([0])], 1, 1, kernel=4)


@pytest.mark.parametrize("stride", [1, 2])
def test_conv_matches_torch(stride):
    """A dense convolution whose masked weights are zero, values and gradients."""
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install -e '.[torch]'")
    plan, _, (W, V, b), x, s, r = conv_case(stride, static=0)
    dense = np.zeros((plan.n_out, plan.n_in, plan.kernel))
    for i, rows in enumerate(plan.rows):
        dense[plan.out[i].start : plan.out[i].stop, rows] = W[i].transpose(1, 2, 0)
    y, cache = layers.conv_forward(x, None, (W, V, b), plan)
    tx = torch.tensor(x.transpose(2, 0, 1), requires_grad=True)
    tw, tb = torch.tensor(dense, requires_grad=True), torch.tensor(b, requires_grad=True)
    padded = torch.nn.functional.pad(tx, (plan.kernel // 2,) * 2, mode="reflect")
    ty = torch.nn.functional.conv1d(padded, tw, tb, stride=stride)
    np.testing.assert_allclose(y, ty.detach().numpy().transpose(1, 2, 0), atol=1e-10)
    dy = r.standard_normal(y.shape)
    ty.backward(torch.tensor(dy.transpose(2, 0, 1)))
    (dx, _), (dW, _, db) = layers.conv_backward(dy, cache)
    np.testing.assert_allclose(dx, tx.grad.numpy().transpose(1, 2, 0), atol=1e-10)
    np.testing.assert_allclose(db, tb.grad.numpy(), atol=1e-10)
    for i, rows in enumerate(plan.rows):
        got = tw.grad.numpy()[plan.out[i].start : plan.out[i].stop][:, rows]
        np.testing.assert_allclose(dW[i], got.transpose(2, 0, 1), atol=1e-10)


@pytest.mark.parametrize("how", ["mean", "max"])
def test_pool(how):
    r = rngs()
    _, groups = layers.Graph(SMALL).pool()
    x = r.standard_normal((8 * 2, 3, 2))
    y, _ = layers.pool_forward(x, groups, how)
    slow = np.concatenate([getattr(x.reshape(8, 2, 3, 2)[g], how)(0) for g in groups])
    np.testing.assert_array_equal(y, slow)
    with pytest.raises(ValueError, match="mean"):
        layers.pool_forward(x, groups, "median")


def test_unpool():
    r = rngs()
    _, groups = layers.Graph(SMALL).pool()
    x = r.standard_normal((len(groups) * 2, 3, 2))
    y, _ = layers.unpool_forward(x, groups)
    np.testing.assert_allclose(layers.pool_forward(y, groups)[0], x)  # a copy each: pooling gets it back


def test_upsample():
    r = rngs()
    x = r.standard_normal((3, 4, 2))
    y, _ = layers.upsample_forward(x)
    at = (np.arange(8) + 0.5) / 2 - 0.5
    slow = np.array([[np.interp(at, np.arange(4), x[c, :, n]) for n in range(2)] for c in range(3)]).transpose(0, 2, 1)
    np.testing.assert_allclose(y, slow, atol=1e-12)


def test_upsample_matches_torch():
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install -e '.[torch]'")
    x = rngs().standard_normal((3, 4, 2))
    wanted = torch.nn.functional.interpolate(torch.tensor(x.transpose(2, 0, 1)), scale_factor=2, mode="linear")
    np.testing.assert_allclose(layers.upsample_forward(x)[0], wanted.numpy().transpose(1, 2, 0), atol=1e-12)


def test_leaky():
    x = rngs().standard_normal((3, 4, 2))
    np.testing.assert_allclose(layers.leaky_forward(x)[0], np.where(x > 0, x, 0.2 * x))


def test_batch_norm():
    r = rngs()
    x, w = r.standard_normal((3, 4, 2)), (r.standard_normal(3), r.standard_normal(3))
    y, _ = layers.batch_norm_forward(x, w)
    np.testing.assert_allclose(y.mean(axis=(1, 2)), w[1], atol=1e-12)
    np.testing.assert_allclose(y.std(axis=(1, 2)), np.abs(w[0]), rtol=1e-3)


# ------------------------------------------------------------------------------------ forward kinematics


def fk_case(seed=0, T=5, B=2):
    r = rngs(seed)
    J = len(SMALL)
    x = r.standard_normal((7 + 4 * (J - 1), T, B))
    return x, r.standard_normal((J, 3, B)), np.exp(1j * r.uniform(-3, 3, (T, B))), r


def test_fk_against_scipy():
    x, offsets, turn, _ = fk_case()
    bones, world, _ = layers.fk_forward(x, offsets, SMALL, turn)
    for n in range(2):
        place = np.zeros(2)
        for t in range(5):
            R = [Rotation.from_quat(x[3:7, t, n], scalar_first=True)]
            p = [np.zeros(3)]
            for j in range(1, len(SMALL)):
                bone = R[SMALL[j]].apply(offsets[j, :, n])
                np.testing.assert_allclose(bones[j, :, t, n], bone, atol=1e-12)
                p.append(p[SMALL[j]] + bone)
                R.append(R[SMALL[j]] * Rotation.from_quat(x[3 + 4 * j : 7 + 4 * j, t, n], scalar_first=True))
            yaw = Rotation.from_euler("z", np.angle(turn[t, n]))
            if t:
                place = place + yaw.apply([*x[:2, t, n], 0.0])[:2]
            wanted = yaw.apply(np.array(p)) + [*place, x[2, t, n]]
            np.testing.assert_allclose(world[:, :, t, n], wanted, atol=1e-12)
    np.testing.assert_array_equal(bones[0], x[:3])
    with pytest.raises(ValueError, match="zero length"):
        layers.fk_forward(np.zeros_like(x), offsets, SMALL, turn)


# ------------------------------------------------------------------------------------ networks


TINY = (2, 3)


def net_case(**settings):
    r = rngs(3)
    g = net.Generator(SMALL, r, channels=TINY, dtype=np.float64, **settings)
    g.theta += 0.1 * r.standard_normal(g.theta.shape)
    return g, r.standard_normal((g.n_x, 16, 2)), r.standard_normal((3 * len(SMALL), 2)), r


def test_static_branch_is_a_masked_product():
    """[SAN §4.2] With T = 1 and k = 1 the convolution is a matrix that is zero between armatures that are not near."""
    g, _, s, _ = net_case()
    graph, x = layers.Graph(SMALL), s
    features, _ = g.static_forward(s)
    for k, (wide, whole) in enumerate(((3, False), (layers.STATIC[0], True))):
        (W, _, b), near = g.params[g.s[k]], graph.neighbours(2)
        out, dense = layers.STATIC[k], np.zeros((len(graph) * layers.STATIC[k], len(graph) * wide))
        for i, neighbours in enumerate(near):
            for place, j in enumerate(neighbours):
                dense[out * i : out * i + out, wide * j : wide * j + wide] = W[i][
                    0, :, wide * place : wide * place + wide
                ]
        y = (dense @ x + b[:, None]).reshape(len(graph), out, -1)
        graph, groups = graph.pool(whole)
        x = np.concatenate([y[m].mean(axis=0) for m in groups])
        x = np.where(x > 0, x, 0.2 * x)
        np.testing.assert_allclose(features[k + 1], x, atol=1e-12)


def test_latent_is_the_primal_skeletons():
    g = net.Generator(HUMAN, rngs())
    f, _ = g.static_forward(np.zeros((63, 1), np.float32))
    z, _ = g.encode_forward(np.zeros((87, 64, 1), np.float32), f)
    assert z.shape == (7 * 16, 16, 1) and z.dtype == np.float32


def test_masked_weights_do_not_exist():
    """A far armature cannot be seen: changing it changes nothing outside its neighbours."""
    r = rngs()
    near = layers.Graph(HUMAN).neighbours(2)
    plan = layers.plan_conv(near, 2, 3)
    W, V, b = plan.shapes()
    weights = ([r.standard_normal(w) for w in W], [r.standard_normal(v) for v in V], np.zeros(b))
    x = r.standard_normal((42, 16, 1))
    y = layers.conv_forward(x, None, weights, plan)[0]
    x[2 * 8 : 2 * 9] += 1.0
    changed = {
        i
        for i in range(21)
        if not np.array_equal(y[3 * i : 3 * i + 3], layers.conv_forward(x, None, weights, plan)[0][3 * i : 3 * i + 3])
    }  # noqa: E501
    assert changed == {i for i in range(21) if 8 in near[i]}
    assert sum(w[0] * w[1] * w[2] for w in W) == sum(15 * 3 * 2 * len(n) for n in near)


def test_same_start():
    """Two structures start with the same weights between corresponding armatures, and only there."""
    a, b = (
        net.Generator(p, rngs(), channels=TINY) for p in (SMALL, (-1, 0, 1, 2, 0, 4, 5))
    )  # one bone less, at the root
    assert net.armature_keys(layers.Graph(SMALL))[4:] == [(2, 3), (2, 2), (2, 1), (2, 0)]
    fan = [x.params[x.d[1]][0] for x in (a, b)]
    ia, ib = a.plans[3].near[7].tolist(), b.plans[3].near[6].tolist()  # the ends of the second chains
    assert ia == [5, 6, 7] and ib == [4, 5, 6]
    np.testing.assert_allclose(fan[0][7] * np.sqrt(6), fan[1][6] * np.sqrt(6), rtol=1e-6)
    assert not np.allclose(fan[0][7][..., :2], fan[0][7][..., 2:4])


def test_plain_is_full():
    """Holden's: one armature of all, the same numbers of channels and layers."""
    a, b = net.Generator(HUMAN, rngs()), net.Generator(HUMAN, rngs(), plain=True)
    assert [p.n_out for p in a.plans] == [11 * 8 + 10 * 8, 7 * 16 + 4 * 16, 88, 87] and a.n_latent == b.n_latent
    assert [len(p.rows) for p in b.plans] == [1] * 4 and b.plans[0].n_in == 87 and b.plans[1].n_out == 112
    assert len(a.plans) == len(b.plans) and len(a.statics) == len(b.statics)


def test_critic_scores_patches():
    """One score an armature of the primal skeleton and four frames."""
    r = rngs(5)
    c = net.Critic(SMALL, r, channels=TINY, dtype=np.float64)
    score, _ = c.forward(r.standard_normal((24, 16, 3)), r.standard_normal((24, 3)))
    assert score.shape == (len(layers.Graph(SMALL).pool(True)[0]), 4, 3)


# ------------------------------------------------------------------------------------ losses


def test_losses():
    """Against slow loops."""
    r = rngs()
    y, x = r.standard_normal((2, 4, 3, 2))
    w, wt = r.standard_normal((2, 5, 3, 3, 2))
    value, *_ = net.rec_loss(y, x, w, wt, 7.0, 3.0)
    local = np.mean([(w[j] - w[0] - wt[j] + wt[0]) ** 2 for j in range(5)])
    assert value == pytest.approx(np.mean((y - x) ** 2) + 7 * local + 3 * np.mean((w[0] - wt[0]) ** 2))
    value, *_ = net.ltc_loss(y, x)
    assert value == pytest.approx(np.mean(np.abs(y - x)))
    value, _ = net.lsgan(y, 1.0)
    assert value == pytest.approx(np.mean((y - 1) ** 2)) and net.lsgan(y, 0.0)[0] == pytest.approx(np.mean(y**2))
    w_b = r.standard_normal((6, 3, 3, 2))
    ea, eb, ha, hb = [2, 4], [1, 5], r.uniform(1, 2, (2, 2)), r.uniform(1, 2, (2, 2))
    value, _ = net.ee_loss(w, w_b, ea, eb, ha, hb)
    slow = 0.0
    for e in range(2):
        for t in range(2):
            for n in range(2):
                va = (w[ea[e], :, t + 1, n] - w[ea[e], :, t, n]) / ha[e, n]
                vb = (w_b[eb[e], :, t + 1, n] - w_b[eb[e], :, t, n]) / hb[e, n]
                slow += np.sum((va - vb) ** 2) / (2 * 2)
    assert value == pytest.approx(slow)


def test_fake_pool():
    """50 are kept; then about half of what comes back is older, and what went in is what is kept."""
    pool, r = net.FakePool(50), rngs()
    first = np.arange(60.0).reshape(1, 1, 60)
    out, _ = pool.exchange(first, first[0], r)
    assert np.array_equal(out[..., :50], first[..., :50]) and len(pool.bones) == 50
    more = 100 + np.arange(200.0).reshape(1, 1, 200)
    out, s = pool.exchange(more, more[0], r)
    np.testing.assert_array_equal(out[0], s)
    assert 60 < np.sum(out != more) < 140 and len(pool.bones) == 50

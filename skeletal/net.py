r"""Skeleton-aware networks: encoders, decoders, discriminators and the losses  [SAN §5.2].

    x_A ──► E_Q^A ──► latent ──► D_A ──► x_A again                                       [SAN-4]
    S_A ──► E_S^A                 D_B ──► x~_B ──► FK ──► end effectors, critic C_B      [SAN-7], [SAN-6]
            S_B ──► E_S^B ──────►                  └────► E_Q^B ──► the same latent?     [SAN-5]

Arrays and layers are those of skeletal/layers.py; a network keeps its parameters in one flat vector.
"""

from __future__ import annotations

import math

import numpy as np

from skeletal.layers import (
    CHANNELS,
    CHOICES,
    DISTANCE,
    PLACE,
    ROOT,
    SLOPE,
    STATIC,
    ConvPlan,
    Graph,
    batch_norm_backward,
    batch_norm_forward,
    conv_backward,
    conv_forward,
    leaky_backward,
    leaky_forward,
    plan_conv,
    pool_backward,
    pool_forward,
    unpool_backward,
    unpool_forward,
    upsample_backward,
    upsample_forward,
)

# ------------------------------------------------------------------------------------ networks


GAIN = math.sqrt(2.0 / (1.0 + SLOPE**2))  # He 2015


class Network:
    """Parameters of several layers in one flat vector, and their gradient in another of the same layout.

    Test: tests/test_gradients.py::test_backward"""

    def __init__(self, rng, dtype=np.float32):
        self.rng, self.dtype, self._shapes = rng, dtype, []
        self._init, self._init_w, self._init_v = [], [], []
        self.base = int(rng.integers(2**31))

    def conv(self, plan: ConvPlan, gain=GAIN, keys=None):
        """Reserve a convolution's parameters; -> its number.  He's initial weights, biases zero.

        ASSUMED   V, the static features' weights, at 0.5 / sqrt(inputs): smaller, so that motion leads at first

        keys : a tuple of integers an armature, in and out; the weights from one armature to another are then drawn by
        their keys, so that two structures start with the same weights wherever their armatures correspond
        """
        W, V, b = plan.shapes()
        layer = len(self._shapes)
        self._shapes.append(("conv", W, V, b))
        for i, (w, v) in enumerate(zip(W, V)):
            a, c = self._draw(w, layer, i, plan, keys), self._draw(v, layer + 100, i, plan, keys)
            self._init_w.append(a * gain / (math.sqrt(w[0] * w[2]) * plan.scale[i]))
            self._init_v.append(c * 0.5 / math.sqrt(max(v[1], 1)))
        self._init += [*self._init_w, *self._init_v, np.zeros(b)]
        self._init_w, self._init_v = [], []
        return layer

    def _draw(self, shape, layer, i, plan, keys):
        if keys is None or not shape[-1]:
            return self.rng.standard_normal(shape)
        wide = shape[-1] // len(plan.near[i])  # channels an armature; the root's more follow
        out, at = np.empty(shape), 0
        sizes = plan.sizes[i] if layer < 100 else [wide] * len(plan.near[i])
        for j, size in zip(plan.near[i], sizes):
            block = np.random.default_rng([self.base, layer, *keys[i], *keys[j]])
            out[..., at : at + size] = block.standard_normal((*shape[:-1], size))
            at += size
        return out

    def norm(self, channels):
        """Reserve a batch normalisation's parameters; -> its number."""
        self._shapes.append(("norm", (channels,)))
        self._init += [np.ones(channels), np.zeros(channels)]
        return len(self._shapes) - 1

    def build(self):
        """Lay the vectors out."""
        self.theta = np.concatenate([a.ravel() for a in self._init]).astype(self.dtype)
        self.grad = np.zeros_like(self.theta)
        self.params, self.grads = self._views(self.theta), self._views(self.grad)
        self.n_params = len(self.theta)
        del self._init, self._init_w, self._init_v
        return self

    def _views(self, vector):
        out, at = [], 0

        def take(shape):
            nonlocal at
            at += math.prod(shape)
            return vector[at - math.prod(shape) : at].reshape(shape)

        for kind, *shapes in self._shapes:
            if kind == "conv":
                W, V, b = shapes
                out.append(([take(w) for w in W], [take(v) for v in V], take(b)))
            else:
                out.append((take(shapes[0]), take(shapes[0])))
        return out

    def add(self, number, grads):
        """Add one layer's gradient."""
        for mine, other in zip(self.grads[number], grads):
            if isinstance(mine, list):
                for a, b in zip(mine, other):
                    a += b
            else:
                mine += other


def armature_keys(g: Graph):
    """(chain, place from its far end) of every armature: what corresponds in two structures of one primal skeleton.

    Test: tests/skeletal/test_skeletal.py::test_same_start"""
    out = [None] * len(g)
    for number, chain in enumerate(g.chains()):
        for place, j in enumerate(reversed(chain)):
            out[j] = (number, place)
    return out


class Generator(Network):
    r"""E_Q, E_S and D of one structure  [SAN §5.2].

    E_Q  two of: convolution (stride 2), pool, LeakyReLU; channels 4 -> 8 -> 16 an armature
    E_S  two of: masked matrix product, pool, LeakyReLU, on the offsets alone
    D    two of: twice the frames, unpool, convolution; LeakyReLU between them.  D's first convolution sees the deep
         static features E_S(S), its second S itself
    ASSUMED   two structures start with the same weights wherever their armatures correspond (`armature_keys`), so that
              their latents start in agreement; the paper's start at random
    Args      parents : of the structure; choices : Choices; pool : "mean" or "max"; plain : True makes one armature of
              all (full convolutions, no skeletal pooling): Holden's, for §4.4's comparison, with as many channels
    Test      tests/test_gradients.py::test_backward, tests/skeletal/test_skeletal.py::test_plain_is_full
    """

    def __init__(
        self, parents, rng, choices=CHOICES["ours"], pool="mean", plain=False, channels=CHANNELS, dtype=np.float32
    ):
        super().__init__(rng, dtype)
        g0 = Graph(parents)
        (g1, self.pool1), self.how = g0.pool(), pool
        g2, self.pool2 = g1.pool(whole=True)
        J = (len(g0), len(g1), len(g2))
        self.parents, self.plain = g0.parents, plain
        near0, near1 = (g.neighbours(DISTANCE, choices.root_ends) for g in (g0, g1))
        widths = np.array([ROOT] + [4] * (J[0] - 1))
        self.n_x = int(widths.sum())
        c1, c2 = channels
        s1, s2 = STATIC
        self.n_latent = J[2] * c2
        if plain:  # one armature; the pooled counts of channels stay, so that both squeeze equally hard
            one = [np.array([0])]
            conv = lambda a, b, s, stride: plan_conv(one, a, b, s, stride=stride)  # noqa: E731
            plans = (conv(self.n_x, J[1] * c1, 3 * J[0], 2), conv(J[1] * c1, J[2] * c2, J[1] * s1, 2),
                     conv(J[2] * c2, J[1] * c1, J[2] * s2, 1), conv(J[1] * c1, self.n_x, 3 * J[0], 1))  # fmt: skip
            statics = (plan_conv(one, 3 * J[0], J[1] * s1, kernel=1), plan_conv(one, J[1] * s1, J[2] * s2, kernel=1))
        else:
            conv = lambda n, a, b, s, stride: plan_conv(n, a, b, s, stride=stride, choices=choices)  # noqa: E731
            plans = (conv(near0, widths, c1, 3, 2), conv(near1, c1, c2, s1, 2),
                     conv(near1, c2, c1, s2, 1), conv(near0, c1, widths, 3, 1))  # fmt: skip
            statics = (plan_conv(near0, 3, s1, kernel=1), plan_conv(near1, s1, s2, kernel=1))
        self.plans, self.statics = plans, statics
        keys0, keys1 = (None, None) if plain else (armature_keys(g0), armature_keys(g1))
        self.e = [self.conv(plans[0], GAIN, keys0), self.conv(plans[1], GAIN, keys1)]
        self.d = [self.conv(plans[2], GAIN, keys1), self.conv(plans[3], 1.0, keys0)]
        self.s = [self.conv(statics[0], GAIN, keys0), self.conv(statics[1], GAIN, keys1)]
        self.build()

    # The plain network has no armatures, so nothing to pool but time, which the stride does.
    def _pool(self, x, groups):
        return (x, None) if self.plain else pool_forward(x, groups, self.how)

    def _pool_backward(self, d, cache):
        return d if cache is None else pool_backward(d, cache)[0]

    def _unpool(self, x, groups):
        return (x, None) if self.plain else unpool_forward(x, groups)

    def _unpool_backward(self, d, cache):
        return d if cache is None else unpool_backward(d, cache)[0]

    def static_forward(self, s):
        """E_S: offsets (3 J, B) -> [S, its features after layer 1, after layer 2]; cache."""
        features, caches = [s], []
        for number, plan, groups in zip(self.s, self.statics, (self.pool1, self.pool2)):
            y, c1 = conv_forward(features[-1][:, None], None, self.params[number], plan)
            y, c2 = self._pool(y, groups)
            y, c3 = leaky_forward(y)
            features.append(y[:, 0])
            caches.append((c1, c2, c3))
        return features, caches

    def static_backward(self, d1, d2, caches):
        """From gradients of both features; the offsets are data."""
        d = d2
        for k in (1, 0):
            c1, c2, c3 = caches[k]
            d = self._pool_backward(leaky_backward(d[:, None], c3)[0], c2)
            (d, _), grads = conv_backward(d, c1, want_dx=k > 0)
            self.add(self.s[k], grads)
            d = d[:, 0] + d1 if k else None

    def encode_forward(self, x, features):
        """E_Q: (C, T, B), static features -> (latent (7 x 16, T/4, B), cache)."""
        caches = []
        for k, groups in enumerate((self.pool1, self.pool2)):
            x, c1 = conv_forward(x, features[k], self.params[self.e[k]], self.plans[k])
            x, c2 = self._pool(x, groups)
            x, c3 = leaky_forward(x)
            caches.append((c1, c2, c3))
        return x, caches

    def encode_backward(self, dz, caches, want_dx=True):
        """-> d x or None, d features[1] (C, B)."""
        d, ds = dz, None
        for k in (1, 0):
            c1, c2, c3 = caches[k]
            d = self._pool_backward(leaky_backward(d, c3)[0], c2)
            (d, dstatic), grads = conv_backward(d, c1, want_dx=want_dx or k > 0)
            self.add(self.e[k], grads)
            ds = dstatic if k else ds
        return d, ds

    def decode_forward(self, z, features):
        """D: latent, static features of the target -> (standardised features (C, T, B), cache)."""
        x, _ = upsample_forward(z)
        x, u1 = self._unpool(x, self.pool2)
        s2, u2 = self._unpool(features[2], self.pool2)
        x, c1 = conv_forward(x, s2, self.params[self.d[0]], self.plans[2])
        x, c2 = leaky_forward(x)
        x, _ = upsample_forward(x)
        x, u3 = self._unpool(x, self.pool1)
        x, c3 = conv_forward(x, features[0], self.params[self.d[1]], self.plans[3])
        return x, (u1, u2, c1, c2, u3, c3)

    def decode_backward(self, dy, cache):
        """-> d latent, d features[2] (C, B)."""
        u1, u2, c1, c2, u3, c3 = cache
        (d, _), grads = conv_backward(dy, c3)
        self.add(self.d[1], grads)
        d = upsample_backward(self._unpool_backward(d, u3))[0]
        (d, ds), grads = conv_backward(leaky_backward(d, c2)[0], c1)
        self.add(self.d[0], grads)
        return upsample_backward(self._unpool_backward(d, u1))[0], self._unpool_backward(ds, u2)


class Critic(Network):
    r"""Discriminator C of one structure  [SAN §5.2]: is this a plausible motion of a skeleton with these offsets?

    Input     bone vectors and the root's velocity and height in the heading frame, (3 J, T, B), and S (3 J, B)
    Layers    convolution (stride 2), pool, LeakyReLU; convolution (stride 2), batch norm, pool, LeakyReLU; a
              convolution to one score an armature and four frames (its patches)
    Departs   the published code's bone vectors stand in the world; ours in the heading frame: no compass
    Test      tests/skeletal/test_skeletal.py::test_critic_scores_patches, tests/test_gradients.py::test_backward
    """

    def __init__(self, parents, rng, choices=CHOICES["ours"], channels=CHANNELS, dtype=np.float32):
        super().__init__(rng, dtype)
        g0 = Graph(parents)
        g1, self.pool1 = g0.pool()
        g2, self.pool2 = g1.pool(whole=True)
        near = [g.neighbours(DISTANCE, choices.root_ends) for g in (g0, g1, g2)]
        c1, c2 = channels
        self.plans = (
            plan_conv(near[0], 3, c1, 3, stride=2, choices=choices),
            plan_conv(near[1], c1, c2, stride=2, choices=choices),
            plan_conv(near[2], c2, 1, kernel=1, choices=choices),
        )
        self.c = [self.conv(self.plans[0]), self.conv(self.plans[1]), self.conv(self.plans[2], 1.0)]
        self.n = self.norm(len(g1) * c2)
        self.build()

    def forward(self, bones, s):
        """(3 J, T, B), (3 J, B) -> scores (J', T/4, B), cache."""
        x, a1 = conv_forward(bones, s, self.params[self.c[0]], self.plans[0])
        x, a2 = pool_forward(x, self.pool1)
        x, a3 = leaky_forward(x)
        x, b1 = conv_forward(x, None, self.params[self.c[1]], self.plans[1])
        x, b2 = batch_norm_forward(x, self.params[self.n])
        x, b3 = pool_forward(x, self.pool2)
        x, b4 = leaky_forward(x)
        x, e = conv_forward(x, None, self.params[self.c[2]], self.plans[2])
        return x, (a1, a2, a3, b1, b2, b3, b4, e)

    def backward(self, dy, cache, want_dx=True):
        """-> d bones or None."""
        a1, a2, a3, b1, b2, b3, b4, e = cache
        (d, _), grads = conv_backward(dy, e)
        self.add(self.c[2], grads)
        d, grads = batch_norm_backward(pool_backward(leaky_backward(d, b4)[0], b3)[0], b2)
        self.add(self.n, grads)
        (d, _), grads = conv_backward(d, b1)
        self.add(self.c[1], grads)
        (d, _), grads = conv_backward(pool_backward(leaky_backward(d, a3)[0], a2)[0], a1, want_dx)
        self.add(self.c[0], grads)
        return d


def carry_root(y, raw, mean, std):
    r"""The root's path and height as the source has them, in legs, instead of the decoded ones; in place.

    Equation  y_c = (x_c - mean_c) / std_c, c: velocity forward and left [legs a frame], height [legs]
    Departs   the paper decodes them (Choices.carry_root)
    Args      y : (C, T, B) decoded, standardised; raw : (C', T, B) the source's, not standardised; mean, std : the
              target's, of shapes that broadcast with y
    Test      tests/skeletal/test_skeletal_train.py::test_root_is_carried
    """
    y[:PLACE] = (raw[:PLACE] - mean[:PLACE]) / std[:PLACE]


# ------------------------------------------------------------------------------------ losses


def mse(a, b):
    """Mean square of a - b and its gradient for a.  Test: tests/test_gradients.py::test_backward"""
    d = a - b
    return float(np.mean(d * d, dtype=np.float64)), d * (2.0 / d.size)


def rec_loss(y, x, world, world_true, position, path):
    r"""Reconstruction  [SAN-4]: |D(E(S, Q), E(S)) - Q|^2 + |FK(., S) - FK(Q, S)|^2.

    Departs   FK's part is split, as in the published code: joints relative to the root, and its path, whose error
              adds up over a window and would drown the rest
    Args      y, x : (C, T, B) decoded and given features, standardised; world, world_true : (J, 3, T, B) [legs]
              position, path : weights of the two parts of FK's
    Returns   loss; d y; d world
    Test      tests/skeletal/test_skeletal.py::test_losses,
              tests/skeletal/test_skeletal_train.py::test_whole_loss_gradient
    """
    a, dy = mse(y, x)
    b, dlocal = mse(world - world[:1], world_true - world_true[:1])
    c, droot = mse(world[0], world_true[0])
    dworld = position * dlocal
    dworld[0] += path * droot - dworld.sum(axis=0)
    return a + position * b + path * c, dy, dworld


def ltc_loss(z_fake, z):
    r"""Latent consistency  [SAN-5]: |E_Q^B(S_B, Q~_B) - E_Q^A(S_A, Q_A)|_1, as a mean.

    Returns   loss; d z_fake; d z
    Test      tests/skeletal/test_skeletal.py::test_losses,
              tests/skeletal/test_skeletal_train.py::test_whole_loss_gradient
    """
    d = z_fake - z
    sign = np.sign(d) / d.size
    return float(np.mean(np.abs(d), dtype=np.float64)), sign, -sign


def lsgan(score, real):
    r"""Least squares GAN  [SAN-6]: (C - 1)^2 for what is or should pass as real, C^2 for fakes, as a mean.

    Returns   loss; d score
    Test      tests/skeletal/test_skeletal.py::test_losses, tests/test_gradients.py::test_backward
    """
    return mse(score, score.dtype.type(real))


def ee_loss(world_a, world_b, ends_a, ends_b, reach_a, reach_b):
    r"""End effectors  [SAN-7]: sum_e |V_e^A / h_e^A - V_e^B / h_e^B|^2, a mean over frames and batch.

    Symbols   V_e -> difference of consecutive frames; h_e -> reach (E, B), the chain's length from the root (or the
              whole height, see Choices.ee_height)
    Args      world : (J, 3, T, B); ends : end effectors in the same order
    Returns   loss; d world_b (A is data)
    Test      tests/skeletal/test_skeletal.py::test_losses,
              tests/skeletal/test_skeletal_train.py::test_whole_loss_gradient
    """
    va = np.diff(world_a[ends_a], axis=2) / reach_a[:, None, None]
    vb = np.diff(world_b[ends_b], axis=2) / reach_b[:, None, None]
    d = vb - va
    n = d.shape[2] * d.shape[3]
    g = d * (2.0 / n) / reach_b[:, None, None]
    dworld = np.zeros_like(world_b)
    step = np.zeros_like(world_b[ends_b])
    step[:, :, 1:] += g
    step[:, :, :-1] -= g
    dworld[ends_b] = step
    return float(np.sum(d * d, dtype=np.float64) / n), dworld


class FakePool:
    """The past fakes a discriminator also sees  [SAN-6], so that it does not forget: half of what is asked for is a
    kept one, which is then replaced.

    Args      size : 50  [SAN, published code]
    Test      tests/skeletal/test_skeletal.py::test_fake_pool
    """

    def __init__(self, size=50):
        self.size, self.bones, self.statics = size, [], []

    def exchange(self, bones, s, rng):
        """(3 J, T, B), (3 J, B) -> the same shapes, some of them older."""
        bones, s = bones.copy(), s.copy()
        for i in range(bones.shape[-1]):
            if len(self.bones) < self.size:
                self.bones.append(bones[..., i].copy())
                self.statics.append(s[..., i].copy())
            elif rng.random() < 0.5:
                k = int(rng.integers(self.size))
                old, old_s = self.bones[k], self.statics[k]
                self.bones[k], self.statics[k] = bones[..., i].copy(), s[..., i].copy()
                bones[..., i], s[..., i] = old, old_s
        return bones, s

r"""Skeleton-aware networks: the armature graph, its layers, forward kinematics
[SAN: Aberman et al. 2020, ACM TOG 39(4)].

A motion is a set of armatures.  Armature j >= 1 is the edge from joint parent(j) to joint j: a static offset S_j and a
dynamic unit quaternion Q_j, joint j's rotation in its parent's frame.  Armature 0 is the root: its velocity and height,
and its rotation.  Everything below is derived from `parents`; there is no list of joint names anywhere.

    graph ──────► convolution [SAN-1] ──► pooling [SAN-2] ──► ... ──► latent on the primal skeleton
    distances     masked by neighbours    pairs, then chains          7 armatures x 16 channels x T/4 for a human

Arrays are channel-major, (C, T, B): a shift in time is then a shift in memory, and a convolution needs no copies of
its input (`conv_forward`).  Channels of one armature lie side by side.  Lengths are in units of the character's leg.
Layers follow nn.py: X_forward -> (y, cache), X_backward(dy, cache) -> (dx, grads).

    python -m skeletal train --motion FOLDER --out runs/s      unpaired retargeting between two structures
    python -m skeletal autoencode --motion FOLDER --out runs/a §4.4's comparison
    python -m skeletal retarget --source A.bvh --target B.bvh --out C.bvh
    python -m skeletal measure --json OUT
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from plumbing.cli import UserError

KERNEL, DISTANCE, SLOPE = 15, 2, 0.2  # [SAN §5.2, published code]
CHANNELS, STATIC = (8, 16), (6, 12)  # channels an armature after each layer; STATIC is ASSUMED
BN_EPS = 1e-5
ROOT, PLACE = 7, 3  # channels of the root armature: velocity forward and left, height; quaternion


@dataclass(frozen=True)
class Choices:
    """Where the paper, its author's later correction and the published code differ; the table is in REPRODUCE.md.

    neighbour_mean : the 1/|N_i| of [SAN-1] as printed; the code leaves it out
    static_scale   : of the static features' share; 1: concatenated as printed; the code adds them times 0.01
    root_ends      : the root sees the end effectors, as printed; the code forgets them (its issue 30)
    ee_height      : divide end effectors' velocities by the whole height, as the code does, not by the chain's length
    weights        : of rec, ltc, adv, ee in [SAN-8].  Printed: 1, 1, 0.25, 2; the code's, which multiplies the author's
                     later numbers out: 5, 2.5, 1, 50, with another factor of 100 inside its L_ee.  That one is a mean
                     over five ends and three axes where [SAN-7] prints a sum: 5000 / 15 = 333.  Ours: 300 (ASSUMED)
    position       : weight of the position part of L_rec against the rotation part, in leg lengths squared (ASSUMED)
    path           : the same of the root's path (ASSUMED)
    carry_root     : the root's path and height, in legs, go from source to target, as the heading does (Departs);
                     decoded, as in the paper, a speed wrong by 1 % is already a tenth of a leg off after ten legs
    """

    neighbour_mean: bool = False
    static_scale: float = 1.0
    root_ends: bool = True
    ee_height: bool = False
    weights: tuple = (5.0, 2.5, 1.0, 300.0)
    position: float = 100.0
    path: float = 2.0
    carry_root: bool = True


CHOICES = {  # by name, for --variant
    "ours": Choices(),
    "paper": Choices(neighbour_mean=True, weights=(1.0, 1.0, 0.25, 2.0), carry_root=False),
    "code": Choices(
        static_scale=0.01, root_ends=False, ee_height=True, weights=(5.0, 2.5, 1.0, 333.0), carry_root=False
    ),
}


# ------------------------------------------------------------------------------------ the armature graph


class Graph:
    r"""Armatures of a tree of joints  [SAN §4.1]: distances, neighbours, chains, pooling.

    Args      parents : (J,) int, -1 for joint 0, otherwise an earlier joint; armature j is the edge to joint j,
              armature 0 the root's stub
    Raises    UserError: no joint, one joint, one bone (nothing to pool or to tell apart), or no tree
    Test      tests/skeletal/test_skeletal.py::test_distances_against_floyd, test_small_skeletons_are_errors
    """

    def __init__(self, parents):
        p = self.parents = np.asarray(parents, dtype=int)
        if p.ndim != 1 or len(p) < 3:
            raise UserError(f"a skeleton of {max(p.size - 1, 0)} bones; valid: a root and two bones or more")
        if p[0] != -1 or any(not 0 <= p[j] < j for j in range(1, len(p))):
            raise UserError(f"parents {p.tolist()} are no tree; valid: -1, then indices of earlier joints")
        self.children = [[] for _ in p]
        for j in range(1, len(p)):
            self.children[p[j]].append(j)
        self.leaves = [j for j in range(1, len(p)) if not self.children[j]]

    def __len__(self):
        return len(self.parents)

    def distances(self):
        """(J, J) edge distances: armatures that share a node are 1 apart.  Test:
        tests/skeletal/test_skeletal.py::test_distances_against_floyd"""  # noqa: E501
        touching = [[] for _ in self.parents]  # of each armature: those that share one of its two nodes
        for node, below in enumerate(self.children):
            around = [node, *below]  # the armature that ends in the node, and those that start there
            for a in around:
                touching[a] += [b for b in around if b != a]
        out = np.full((len(self),) * 2, -1)
        for start in range(len(self)):
            out[start, start], front = 0, [start]
            for a in front:
                for b in touching[a]:
                    if out[start, b] < 0:
                        out[start, b] = out[start, a] + 1
                        front.append(b)
        return out

    def neighbours(self, d=DISTANCE, root_ends=True):
        r"""N_i^d of every armature  [SAN §4.2].

        Args      d : edge distance; root_ends : the root's support also contains the end effectors' armatures
        Returns   list of ascending int arrays
        Test      tests/skeletal/test_skeletal.py::test_neighbours
        """
        near = self.distances() <= d
        if root_ends:
            near[0, self.leaves] = True
        return [np.flatnonzero(row) for row in near]

    def chains(self):
        """Maximal runs of armatures joined by nodes of degree 2, each from the root outwards; the root is alone.

        Test: tests/skeletal/test_skeletal.py::test_pooling_keeps_the_tree"""
        out = [[0]]
        for j in range(1, len(self)):
            p = self.parents[j]
            if p == 0 or len(self.children[p]) > 1:
                chain = [j]
                while len(self.children[chain[-1]]) == 1:
                    chain += self.children[chain[-1]]
                out.append(chain)
        return out

    def pool(self, whole=False):
        r"""Merge armatures  [SAN-2]: pairs along every chain, an odd one nearest the root alone; or whole chains.

        Departs   two rounds of pairs do not shorten five edges to one; so the last pool takes whole chains, as the
                  published code's does, and leaves the primal skeleton
        Returns   Graph of the merged armatures; groups : their members, a list of lists
        Test      tests/skeletal/test_skeletal.py::test_pooling_keeps_the_tree
        """
        groups = []
        for chain in self.chains():
            odd = len(chain) % 2
            pairs = [chain[:1]] * odd + [chain[i : i + 2] for i in range(odd, len(chain), 2)]
            groups += [chain] if whole else pairs
        groups.sort(key=lambda g: g[-1])
        owner = {j: k for k, g in enumerate(groups) for j in g}
        pooled = object.__new__(Graph)  # a primal skeleton may have one bone: no check
        pooled.parents = np.array([-1] + [owner[self.parents[g[0]]] for g in groups[1:]])
        pooled.children = [[] for _ in groups]
        for k in range(1, len(groups)):
            pooled.children[pooled.parents[k]].append(k)
        pooled.leaves = [k for k in range(1, len(groups)) if not pooled.children[k]]
        return pooled, groups


def match_primal(a: Graph, b: Graph, at_a, at_b, names_a, names_b):
    r"""The order of b's joints in which its primal skeleton reads as a's  [SAN §3].

    Method    from the root on, the branches of two nodes are paired so that their subtrees have the same shape and
              their ends lie nearest to one another in a typical pose: left stays left, arms stay arms
    Args      a, b : Graph; at_a, at_b : (J, 3) joint positions in units of the leg, x forward, z up
              names_a, names_b : for the message
    Returns   order : (J_b,) permutation, depth first; a parent still precedes its children
    Raises    UserError: the primal skeletons differ; shows both reductions
    Test      tests/skeletal/test_skeletal.py::test_match_primal, test_different_primals_show_both
    """
    ends = [{c[0]: c[-1] for c in g.chains()} for g in (a, b)]  # first armature of a chain -> its last joint

    def shape(g, end, j):
        return tuple(sorted(shape(g, end, end[c]) for c in g.children[j]))

    order = [0]

    def walk(ja, jb):
        left, right = a.children[ja], b.children[jb]
        cost = np.full((len(left), len(right)), 1e9)
        for i, ca in enumerate(left):
            for k, cb in enumerate(right):
                ea, eb = ends[0][ca], ends[1][cb]
                if shape(a, ends[0], ea) == shape(b, ends[1], eb):
                    cost[i, k] = np.sum((at_a[ea] - at_b[eb]) ** 2)
        for i, k in zip(*linear_sum_assignment(cost)):
            cb = right[k]
            order.append(cb)
            while cb != ends[1][right[k]]:
                cb = b.children[cb][0]
                order.append(cb)
            walk(ends[0][left[i]], cb)

    if shape(a, ends[0], 0) != shape(b, ends[1], 0):
        raise UserError(
            "the two skeletons have no common primal skeleton: the first reduces to "
            f"{reduction(a, names_a)}, the second to {reduction(b, names_b)}; valid: the same tree (see --drop)"
        )
    walk(0, 0)
    return np.array(order)


def reduction(g: Graph, names) -> str:
    """The primal skeleton as text: Hips(Chest(Head, Hand_L, Hand_R), ...).  Test:
    tests/skeletal/test_skeletal.py::test_different_primals_show_both"""  # noqa: E501
    end = {c[0]: c[-1] for c in g.chains()}

    def text(j):
        below = ", ".join(text(end[c]) for c in g.children[j])
        return f"{names[j]}({below})" if below else str(names[j])

    return text(0)


# ------------------------------------------------------------------------------------ layers


@dataclass(frozen=True, eq=False)
class ConvPlan:
    """Which channels every output armature reads: all that a masked convolution needs to know of a skeleton.

    rows : (J,) int arrays, input channels of the neighbours; static_rows : the same of the static features
    near, sizes : (J,) the neighbours, and how many input channels each has
    out  : (J,) slices of output channels; scale : (J,) 1 or 1/|N_i|
    """

    rows: list
    static_rows: list
    near: list
    sizes: list
    out: list
    scale: list
    n_in: int
    n_static: int
    n_out: int
    kernel: int
    stride: int
    static_scale: float

    def shapes(self):
        """(k, O_i, K_i), (O_i, Ks_i) of every armature, and the bias's (C_out,)."""
        sizes = [s.stop - s.start for s in self.out]
        return (
            [(self.kernel, o, len(r)) for o, r in zip(sizes, self.rows)],
            [(o, len(r)) for o, r in zip(sizes, self.static_rows)],
            (self.n_out,),
        )


def plan_conv(
    neighbours, widths_in, widths_out, static=0, kernel=KERNEL, stride=1, choices=CHOICES["ours"]
) -> ConvPlan:
    """Lay a masked convolution out.

    Args      neighbours : (J,) index arrays; widths_in, widths_out : channels an armature, int or (J,); static : the
              same of the static features, 0 for none
    Raises    ValueError: an even kernel (no centre)
    Test      tests/skeletal/test_skeletal.py::test_conv_equals_slow_loop
    """
    if kernel % 2 == 0:
        raise ValueError(f"kernel is {kernel}, expected an odd number")
    n = len(neighbours)
    at_in, at_static, at_out = (
        np.concatenate([[0], np.cumsum(np.broadcast_to(w, n))]) for w in (widths_in, static, widths_out)
    )
    pick = lambda at, near: np.concatenate([np.arange(at[j], at[j + 1]) for j in near]).astype(int)  # noqa: E731
    return ConvPlan(
        [pick(at_in, near) for near in neighbours],
        [pick(at_static, near) for near in neighbours],
        list(neighbours),
        [[int(at_in[j + 1] - at_in[j]) for j in near] for near in neighbours],
        [slice(int(at_out[i]), int(at_out[i + 1])) for i in range(n)],
        [1.0 / len(near) if choices.neighbour_mean else 1.0 for near in neighbours],
        int(at_in[-1]), int(at_static[-1]), int(at_out[-1]), kernel, stride, choices.static_scale,
    )  # fmt: skip


def conv_forward(x, s, weights, plan: ConvPlan):
    r"""Skeletal convolution  [SAN-1].

    Equation  Q^_i = (1/|N_i|) sum_{j in N_i} M_j * W_j^i + b^i, M_j = [Q_j, S_j tiled over time]
    Symbols   * -> 1-D convolution in time, reflected at both ends, stride 1 or 2;  W -> W[i] (k, O_i, K_i)
    Method    S_j is constant in time, so its convolution is (sum_k W_k) S_j: a matrix V[i] times S, added once.
              One matrix product an armature over the gathered neighbours alone, all taps stacked:
              Y = [W_0; W_1; ...] x, then y(t) = sum_k Y_k(t + k): the shift comes after the product, so no tap copies
              the input (an im2col matrix would be 15 times as large as it, and masked zeros cost nothing either way)
    Args      x : (C_in, T, B); s : (C_static, B) or None; weights : (W, V, b), lists over armatures and (C_out,)
              plan : ConvPlan.  T must be a multiple of the stride and longer than half a kernel
    Returns   y : (C_out, T / stride, B); cache
    Raises    ValueError: shapes do not fit
    Test      tests/skeletal/test_skeletal.py::test_conv_equals_slow_loop, test_conv_matches_torch,
              tests/test_gradients.py::test_backward
    """
    W, V, b = weights
    C, T, B = x.shape
    stride, half = plan.stride, plan.kernel // 2
    if C != plan.n_in or T % stride or (half and half >= T):
        raise ValueError(f"x is {x.shape}, expected ({plan.n_in}, T, B), T a multiple of {stride} and above {half}")
    out_t = T // stride
    phases = _phases(x, half, stride)
    y = np.empty((plan.n_out, out_t, B), b.dtype)
    for i, rows in enumerate(plan.rows):
        yi, o = y[plan.out[i]], W[i].shape[1]
        first = True
        for f, phase in enumerate(phases):
            w = W[i][f::stride].reshape(-1, len(rows))  # (taps O, K)
            taps, wide = len(w) // o, phase.shape[1]
            if not taps:
                continue
            product = (w @ phase[rows].reshape(len(rows), -1)).reshape(taps, o, wide, B)
            for m in range(taps):
                if first:
                    yi[:] = product[m, :, m : m + out_t]
                    first = False
                else:
                    yi += product[m, :, m : m + out_t]
        if plan.scale[i] != 1.0:
            yi *= plan.scale[i]
        constant = np.repeat(b[plan.out[i], None], B, axis=1)
        if plan.n_static:
            constant += (plan.static_scale * plan.scale[i]) * (V[i] @ s[plan.static_rows[i]])
        yi += constant[:, None]
    return y, (phases, s, weights, plan, T)


def conv_backward(dy, cache, want_dx=True):
    r"""Gradient of `conv_forward`.

    Equation  with dY_k(u) = dy(u - k): dW = dY x^T, dx = W^T dY; dV = (sum_t dy) s^T, ds = V^T sum_t dy, db = sum dy
    Args      dy : (C_out, T / stride, B); want_dx : False where the input is data
    Returns   (dx (C_in, T, B) or None, ds (C_static, B) or None); grads : (dW, dV, db) as the weights
    Test      tests/test_gradients.py::test_backward, tests/skeletal/test_skeletal.py::test_conv_matches_torch
    """
    phases, s, (W, V, _), plan, T = cache
    stride, half = plan.stride, plan.kernel // 2
    out_t, B = dy.shape[1:]
    dphases = [np.zeros_like(p) for p in phases] if want_dx else None
    ds = np.zeros_like(s) if plan.n_static else None
    dW, dV, db = [], [], np.empty(plan.n_out, dy.dtype)
    for i, rows in enumerate(plan.rows):
        di, o = dy[plan.out[i]], W[i].shape[1]
        total = di.sum(axis=1)  # (O, B)
        db[plan.out[i]] = total.sum(axis=1)
        if plan.n_static:
            c = plan.static_scale * plan.scale[i]
            dV.append(c * (total @ s[plan.static_rows[i]].T))
            ds[plan.static_rows[i]] += c * (V[i].T @ total)
        else:
            dV.append(np.zeros_like(V[i]))
        if plan.scale[i] != 1.0:
            di = plan.scale[i] * di
        gradient = np.empty_like(W[i])
        for f, phase in enumerate(phases):
            w = W[i][f::stride]
            taps, wide = len(w), phase.shape[1]
            if not taps:
                continue
            shifted = np.zeros((taps, o, wide, B), dy.dtype)
            for m in range(taps):
                shifted[m, :, m : m + out_t] = di
            shifted = shifted.reshape(taps * o, -1)
            gradient[f::stride] = (shifted @ phase[rows].reshape(len(rows), -1).T).reshape(w.shape)
            if want_dx:
                dphases[f][rows] += (w.reshape(-1, len(rows)).T @ shifted).reshape(len(rows), wide, B)
        dW.append(gradient)
    dx = _phases_backward(dphases, half, stride, T) if want_dx else None
    return (dx, ds), (dW, dV, db)


def _phases(x, half, stride):
    """x (C, T, B) reflected at both ends in time and dealt out to `stride` arrays."""
    if half:
        x = np.concatenate([x[:, half:0:-1], x, x[:, -2 : -half - 2 : -1]], axis=1)
    return [np.ascontiguousarray(x[:, f::stride]) for f in range(stride)]


def _phases_backward(dphases, half, stride, T):
    C, _, B = dphases[0].shape
    padded = np.empty((C, T + 2 * half, B), dphases[0].dtype)
    for f, d in enumerate(dphases):
        padded[:, f::stride] = d
    if not half:
        return padded
    dx = padded[:, half : half + T].copy()
    dx[:, 1 : half + 1] += padded[:, half - 1 :: -1] if half > 1 else padded[:, :1]
    dx[:, T - half - 1 : T - 1] += padded[:, : half + T - 1 : -1]
    return dx


def pool_forward(x, groups, how="mean"):
    r"""Skeletal pooling  [SAN-2]: the features of merged armatures, averaged or their largest.

    Args      x : (J c, ...); groups : members of every new armature; how : "mean" or "max"
    Returns   y : (J' c, ...); cache
    Raises    ValueError: another word than mean or max
    Test      tests/skeletal/test_skeletal.py::test_pool
    """
    if how not in ("mean", "max"):
        raise ValueError(f"pooling {how!r}; expected 'mean' or 'max'")
    J = sum(map(len, groups))
    a = x.reshape(J, -1, *x.shape[1:])
    y = np.stack([a[g[0]] if len(g) == 1 else getattr(a[g], how)(axis=0) for g in groups])
    best = [a[g].argmax(axis=0) for g in groups] if how == "max" else None
    return y.reshape(-1, *x.shape[1:]), (groups, best, J)


def pool_backward(dy, cache):
    """Gradient of `pool_forward`: shared equally, or to the largest.

    Test      tests/test_gradients.py::test_backward
    """
    groups, best, J = cache
    d = dy.reshape(len(groups), -1, *dy.shape[1:])
    dx = np.empty((J, *d.shape[1:]), dy.dtype)
    for k, g in enumerate(groups):
        for place, j in enumerate(g):
            dx[j] = d[k] / len(g) if best is None else np.where(best[k] == place, d[k], 0.0)
    return dx.reshape(-1, *dy.shape[1:]), ()


def unpool_forward(x, groups):
    """[SAN §4.3] Every armature of a group gets the group's features.  x (J' c, ...) -> (J c, ...).

    Test: tests/skeletal/test_skeletal.py::test_unpool"""
    owner = np.empty(sum(map(len, groups)), int)
    for k, g in enumerate(groups):
        owner[g] = k
    y = x.reshape(len(groups), -1, *x.shape[1:])[owner]
    return y.reshape(-1, *x.shape[1:]), groups


def unpool_backward(dy, cache):
    """Gradient of `unpool_forward`: the sum over a group.

    Test      tests/test_gradients.py::test_backward"""
    groups = cache
    d = dy.reshape(sum(map(len, groups)), -1, *dy.shape[1:])
    dx = np.stack([d[g[0]] if len(g) == 1 else d[g].sum(axis=0) for g in groups])
    return dx.reshape(-1, *dy.shape[1:]), ()


def upsample_forward(x):
    r"""Twice as many frames, linearly between them  [SAN §4.3].

    Equation  y(2 t) = (3 x(t) + x(t - 1)) / 4, y(2 t + 1) = (3 x(t) + x(t + 1)) / 4, held at both ends (PyTorch's
              align_corners=False)
    Args      x : (C, T, B)
    Returns   y : (C, 2 T, B); cache
    Test      tests/skeletal/test_skeletal.py::test_upsample, test_upsample_matches_torch
    """
    y = np.empty((x.shape[0], 2 * x.shape[1], x.shape[2]), x.dtype)
    y[:, 0::2], y[:, 1::2] = 0.75 * x, 0.75 * x
    y[:, 2::2] += 0.25 * x[:, :-1]
    y[:, 0] += 0.25 * x[:, 0]
    y[:, 1:-1:2] += 0.25 * x[:, 1:]
    y[:, -1] += 0.25 * x[:, -1]
    return y, None


def upsample_backward(dy, cache=None):
    """Gradient of `upsample_forward`.  Test: tests/test_gradients.py::test_backward"""
    dx = 0.75 * (dy[:, 0::2] + dy[:, 1::2])
    dx[:, :-1] += 0.25 * dy[:, 2::2]
    dx[:, 0] += 0.25 * dy[:, 0]
    dx[:, 1:] += 0.25 * dy[:, 1:-1:2]
    dx[:, -1] += 0.25 * dy[:, -1]
    return dx, ()


def leaky_forward(x):
    """max(x, 0.2 x).  Test: tests/skeletal/test_skeletal.py::test_leaky"""
    y = x * x.dtype.type(SLOPE)
    np.maximum(x, y, out=y)
    return y, y


def leaky_backward(dy, cache):
    """Gradient of `leaky_forward`, by the sign of its output.

    Test      tests/test_gradients.py::test_backward"""
    dx = np.maximum(cache > 0, cache.dtype.type(SLOPE))
    dx *= dy
    return dx, ()


def batch_norm_forward(x, weights):
    r"""Batch normalisation over time and batch, by the batch's own statistics (only the discriminator has it, and it is
    never used after training, so no running statistics are kept).

    Equation  y = gamma (x - mean) / sqrt(var + eps) + beta
    Args      x : (C, T, B); weights : (gamma, beta), (C,) each
    Test      tests/skeletal/test_skeletal.py::test_batch_norm
    """
    gamma, beta = weights
    mean = x.mean(axis=(1, 2), keepdims=True)
    inv = 1.0 / np.sqrt(x.var(axis=(1, 2), keepdims=True) + BN_EPS)
    n = (x - mean) * inv
    return gamma[:, None, None] * n + beta[:, None, None], (n, inv, gamma)


def batch_norm_backward(dy, cache):
    """Gradient of `batch_norm_forward`; grads (dgamma, dbeta).

    Test      tests/test_gradients.py::test_backward
    """
    n, inv, gamma = cache
    dgamma, dbeta = (dy * n).sum(axis=(1, 2)), dy.sum(axis=(1, 2))
    d = gamma[:, None, None] * dy
    mean = lambda v: v.mean(axis=(1, 2), keepdims=True)  # noqa: E731
    return inv * (d - mean(d) - n * mean(d * n)), (dgamma, dbeta)


# ------------------------------------------------------------------------------------ forward kinematics


def _matrices(u):
    """Rotation matrices (J, 3, 3, N) of unit quaternions (J, 4, N)."""
    w, x, y, z = u[:, 0], u[:, 1], u[:, 2], u[:, 3]
    m = np.empty((u.shape[0], 3, 3, *u.shape[2:]), u.dtype)
    m[:, 0, 0], m[:, 0, 1], m[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    m[:, 1, 0], m[:, 1, 1], m[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    m[:, 2, 0], m[:, 2, 1], m[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return m


def _matrices_backward(dm, u):
    w, x, y, z = u[:, 0], u[:, 1], u[:, 2], u[:, 3]
    d = lambda i, j: dm[:, i, j]  # noqa: E731
    du = np.empty_like(u)
    du[:, 0] = 2 * (x * (d(2, 1) - d(1, 2)) + y * (d(0, 2) - d(2, 0)) + z * (d(1, 0) - d(0, 1)))
    du[:, 1] = 2 * (
        y * (d(0, 1) + d(1, 0)) + z * (d(0, 2) + d(2, 0)) + w * (d(2, 1) - d(1, 2)) - 2 * x * (d(1, 1) + d(2, 2))
    )
    du[:, 2] = 2 * (
        x * (d(0, 1) + d(1, 0)) + z * (d(1, 2) + d(2, 1)) + w * (d(0, 2) - d(2, 0)) - 2 * y * (d(0, 0) + d(2, 2))
    )
    du[:, 3] = 2 * (
        x * (d(0, 2) + d(2, 0)) + y * (d(1, 2) + d(2, 1)) + w * (d(1, 0) - d(0, 1)) - 2 * z * (d(0, 0) + d(1, 1))
    )
    return du


def _mat3(a, b):
    """Products of 3 x 3 matrices, (3, 3, N) each: three multiplications of whole arrays, no small BLAS calls."""
    return a[:, 0, None] * b[None, 0] + a[:, 1, None] * b[None, 1] + a[:, 2, None] * b[None, 2]


def fk_forward(x, offsets, parents, turn):
    r"""Forward kinematics, quaternion normalisation included  [SAN-4's FK].

    Equation  G_0 = R(q_0/|q_0|), G_j = G_parent R(q_j/|q_j|), p_j = p_parent + G_parent S_j;
              world: Rz(psi_t) p_j + (sum_{0<u<=t} Rz(psi_u) v_u, height_t)
    Frame     bones and p in the heading frame of their frame; world: from the place on the floor of frame 0
    Args      x : (7 + 4 (J - 1), T, B) root velocity forward and left a frame, height, quaternion; a quaternion a joint
              offsets : (J, 3, B) [legs]; turn : (T, B) complex exp(i psi) of the heading, given, not learnt
    Returns   bones : (J, 3, T, B), p_j - p_parent, and in row 0 the root's velocity and height: what the critic sees
              world : (J, 3, T, B); cache
    Raises    ValueError: a quaternion of zero length
    Test      tests/skeletal/test_skeletal.py::test_fk_against_scipy, tests/test_gradients.py::test_backward
    """
    J, (_, T, B) = len(parents), x.shape
    q = np.concatenate([x[None, 3:ROOT], x[ROOT:].reshape(J - 1, 4, T, B)])
    length = np.sqrt(np.einsum("jctb,jctb->jtb", q, q))[:, None]
    if not length.min() > 1e-12:
        raise ValueError("a quaternion of zero length has no rotation")
    u = q / length
    M = _matrices(u)
    G = np.empty_like(M)
    bones, p = np.empty((2, J, 3, T, B), x.dtype)
    G[0], bones[0], p[0] = M[0], x[:3], 0.0
    for j in range(1, J):
        g, s = G[parents[j]], offsets[j]
        bones[j] = g[:, 0] * s[0] + g[:, 1] * s[1] + g[:, 2] * s[2]
        p[j] = p[parents[j]] + bones[j]
        G[j] = _mat3(g, M[j])
    c, s = turn.real.astype(x.dtype), turn.imag.astype(x.dtype)
    world = np.empty_like(p)
    step = np.stack([c * x[0] - s * x[1], s * x[0] + c * x[1]])
    step[:, 0] = 0.0
    path = np.cumsum(step, axis=1)
    world[:, 0] = c * p[:, 0] - s * p[:, 1] + path[0]
    world[:, 1] = s * p[:, 0] + c * p[:, 1] + path[1]
    world[:, 2] = p[:, 2] + x[2]
    return bones, world, (u, length, M, G, offsets, parents, c, s)


def fk_backward(dbones, dworld, cache):
    """Gradient of `fk_forward` for x; either of the two may be None.

    Test      tests/test_gradients.py::test_backward
    """
    u, length, M, G, offsets, parents, c, s = cache
    J, _, T, B = u.shape
    dx = np.zeros((ROOT + 4 * (J - 1), T, B), u.dtype)
    db = np.zeros((J, 3, T, B), u.dtype)
    if dworld is not None:
        x, y, z = dworld[:, 0], dworld[:, 1], dworld[:, 2]
        db[:, 0], db[:, 1], db[:, 2] = c * x + s * y, c * y - s * x, z
        path = np.stack([x.sum(axis=0), y.sum(axis=0)])
        path = np.cumsum(path[:, ::-1], axis=1)[:, ::-1].copy()
        path[:, 0] = 0.0
        dx[0], dx[1], dx[2] = c * path[0] + s * path[1], c * path[1] - s * path[0], z.sum(axis=0)
        for j in range(J - 1, 0, -1):  # p_j is the sum of the bones above it
            if parents[j] > 0:
                db[parents[j]] += db[j]
        db[0] = 0.0
    if dbones is not None:
        db += dbones
        dx[:3] += db[0]
    dG, dM = np.zeros_like(G), np.empty_like(M)
    for j in range(J - 1, 0, -1):
        p = parents[j]
        dM[j] = _mat3(np.swapaxes(G[p], 0, 1), dG[j])
        dG[p] += _mat3(dG[j], np.swapaxes(M[j], 0, 1))
        dG[p] += db[j][:, None] * offsets[j][None, :, None]
    dM[0] = dG[0]
    du = _matrices_backward(dM, u)
    dq = (du - u * np.einsum("jctb,jctb->jtb", u, du)[:, None]) / length
    dx[3:ROOT], dx[ROOT:] = dq[0], dq[1:].reshape(-1, T, B)
    return dx

r"""The networks of DROP's learned priors: a conditional VAE of motion and a VAE of poses  [DROP §5, §7, Eqs. 8, 15].

    s_t, x_{t+1} ──► posterior q(z | s_t, x_{t+1}) ─┐ z            z at every layer
    s_t ───────────► prior     p(z | s_t) ── KL ────┴──► decoder(s_t, z) ──► residual ──► Gram-Schmidt ──► kinematics
                                                                        └──► which feet stand on the floor
    q ─────────────► encoder E(q), a Gaussian ── KL to N(0, I) ──► decoder D(z) ──► Gram-Schmidt ──► kinematics

The ideas are HuMoR's (Rempe et al., ICCV 2021) and MotionVAE's (Ling et al., SIGGRAPH 2020), the networks small.
Every backward pass is by hand, over nn.py's layers.  A state lives in its heading frame: origin on the floor under the
pelvis, x where the pelvis faces, z up.  Rotations are global (the character's, in that frame) as two columns of their
matrices, (2, 3) each: forward kinematics is then linear in the matrices, and no error runs down a chain of joints.

B rows of a minibatch; J = 22 joints; float32, or float64 in the gradient tests.  Priors, training and commands are in
drop/prior.py.
"""

from __future__ import annotations

import math

import numpy as np

from drop.body import LEAVES, LIMITED, OFFSETS, PARENTS, PATH, STEP, N
from nn import ACTIVATIONS as NN_ACTIVATIONS
from nn import MLP, linear_backward, linear_forward, orthogonal

# What a state is made of: pelvis height; the other joints; columns of all rotations; velocities.
STATE = 1 + 3 * (N - 1) + 6 * N + 3 * N
OUTPUT = 3 + 6 * N  # residual: displacement of the pelvis; change of the columns
CONTACTS = 4  # and do ankle and ball of the left foot, of the right, stand on the floor: logits
VELOCITY_SCALE = 0.1  # s: 1 m/s beside 10 cm of pose, as in mocap.stitch.motion_features
CLIP = 4.0  # ASSUMED: standard deviations beyond which inputs are cut, so that a fallen body stays a sane input
LOG_STD_BOUND = 3.0  # ASSUMED: |log σ| stays below it, smoothly
SIGMA_X, SIGMA_R = 0.005, 0.03  # ASSUMED: standard deviations of the likelihood: joints [m], columns [-]
FEET_WEIGHT = 3.0  # ASSUMED: ankles and balls of the feet count more, because feet that slide are seen first

_WEIGHTS = np.ones(N)
_WEIGHTS[[7, 8, 10, 11]] = FEET_WEIGHT


# ------------------------------------------------------------------------------------ rotations and kinematics


def gram_schmidt_forward(columns):
    r"""Rotation matrices from two columns that need not be orthonormal (Zhou et al., CVPR 2019).

    Equation  c1 = a/‖a‖,  c2 = (b − (c1·b) c1)/‖·‖,  c3 = c1 × c2
    Args      columns : (..., 2, 3), a and b
    Returns   C (..., 3, 3): row k is column k of the rotation, C = Rᵀ; cache.  Columns that are parallel or zero give
              finite numbers, but no rotation
    Test      tests/drop/test_drop_vae.py::test_gram_schmidt
    """
    a, b = columns[..., 0, :], columns[..., 1, :]
    na = np.maximum(np.sqrt(np.einsum("...i,...i", a, a)), 1e-9)[..., None]
    c1 = a / na
    s = np.einsum("...i,...i", c1, b)[..., None]
    rest = b - s * c1
    nb = np.maximum(np.sqrt(np.einsum("...i,...i", rest, rest)), 1e-9)[..., None]
    c2 = rest / nb
    C = np.stack([c1, c2, _cross(c1, c2)], axis=-2)
    return C, (C, b, s, na, nb)


def gram_schmidt_backward(dC, cache):
    r"""Gradient of `gram_schmidt_forward`.

    Equation  dc1 += c2 × dc3, dc2 += dc3 × c1;  d(b − s c1) = (dc2 − (dc2·c2) c2)/‖b − s c1‖;
              db = d − (c1·d) c1, dc1 −= s d + (c1·d) b;  da = (dc1 − (dc1·c1) c1)/‖a‖
    Args      dC : (..., 3, 3)
    Returns   (..., 2, 3)
    Test      tests/test_gradients.py::test_backward
    """
    C, b, s, na, nb = cache
    c1, c2, (dc1, dc2, dc3) = C[..., 0, :], C[..., 1, :], np.moveaxis(dC, -2, 0)
    dc1, dc2 = dc1 + _cross(c2, dc3), dc2 + _cross(dc3, c1)
    d = (dc2 - np.einsum("...i,...i", dc2, c2)[..., None] * c2) / nb
    along = np.einsum("...i,...i", c1, d)[..., None]
    dc1 = dc1 - s * d - along * b
    da = (dc1 - np.einsum("...i,...i", dc1, c1)[..., None] * c1) / na
    return np.stack([da, d - along * c1], axis=-2)


def _cross(a, b):
    """Cross product of (..., 3); np.cross is several times slower."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


_PATHS = {np.dtype(t): PATH.astype(t) for t in (np.float32, np.float64)}
_BONES = {np.dtype(t): OFFSETS[1:].astype(t) for t in (np.float32, np.float64)}


def kinematics_forward(root, C):
    r"""Joint positions from rotations; linear in both.

    Equation  x = root + PATH · bones, bone_i = R_parent o_i = Σ_k o_ik c_k
    Args      root : (B, 3) [m]; C : (B, 22, 3, 3), rows are the rotations' columns
    Returns   (B, 22, 3) [m]
    Test      tests/drop/test_drop_vae.py::test_kinematics
    """
    o = _BONES[C.dtype]
    bones = np.matmul(o[:, None], C[:, PARENTS[1:]])[:, :, 0]
    return root[:, None] + np.matmul(_PATHS[C.dtype], bones)


def kinematics_backward(dx):
    r"""Gradient of `kinematics_forward`.

    Equation  droot = Σ_j dx_j;  dbones = PATHᵀ dx;  dc_k of a joint = Σ over its bones o_ik dbone_i
    Args      dx : (B, 22, 3)
    Returns   droot (B, 3), dC (B, 22, 3, 3)
    Test      tests/test_gradients.py::test_backward
    """
    dbones = np.matmul(_PATHS[dx.dtype].T, dx)
    dC = np.zeros((len(dx), N, 3, 3), dx.dtype)
    o = _BONES[dx.dtype]
    for i, parent in enumerate(PARENTS[1:]):  # several bones may share a parent
        dC[:, parent] += o[i][:, None] * dbones[:, i, None]
    return dx.sum(axis=1), dC


def columns_of(quat):
    """The first two columns (..., 2, 3) of the rotations of quaternions (..., 4).

    Test: tests/drop/test_drop_vae.py::test_gram_schmidt"""
    w, x, y, z = np.moveaxis(np.asarray(quat), -1, 0)
    one = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    two = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=-1)
    return np.stack([one, two], axis=-2)


def quat_of(R):
    r"""Quaternions (..., 4) of rotation matrices (..., 3, 3), real part first.

    Method    the row of 4 q qᵀ with the largest diagonal (Shepperd 1978), normalised; SciPy takes several times as long
    Test      tests/drop/test_drop_vae.py::test_gram_schmidt
    """
    a, b, c = R[..., 0, :], R[..., 1, :], R[..., 2, :]
    xx, yy, zz = a[..., 0], b[..., 1], c[..., 2]
    wx, wy, wz = c[..., 1] - b[..., 2], a[..., 2] - c[..., 0], b[..., 0] - a[..., 1]
    xy, xz, yz = a[..., 1] + b[..., 0], a[..., 2] + c[..., 0], b[..., 2] + c[..., 1]
    rows = np.stack([1 + xx + yy + zz, wx, wy, wz, wx, 1 + xx - yy - zz, xy, xz, wy, xy, 1 - xx + yy - zz, yz,
                     wz, xz, yz, 1 - xx - yy + zz], axis=-1).reshape(-1, 4, 4)  # fmt: skip
    q = rows[np.arange(len(rows)), rows[:, [0, 1, 2, 3], [0, 1, 2, 3]].argmax(axis=1)]
    return (q / np.sqrt(np.einsum("ij,ij->i", q, q))[:, None]).reshape(*R.shape[:-2], 4)


def turned(v, cos, sin):
    """Vectors (B, ..., 3) turned about the vertical by angles given as cos, sin (B,); by −angle with −sin."""
    shape = (len(v),) + (1,) * (v.ndim - 2)
    c, s = cos.reshape(shape), sin.reshape(shape)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]], axis=-1)


# ------------------------------------------------------------------------------------ states


def facing(columns):
    """cos and sin (B,) of the heading: the left axis, the pelvis's second column, turned by −90 degrees.

    Test: tests/drop/test_drop_vae.py::test_canonical_is_invariant"""
    left = columns[:, 0, 1]
    c, s = left[:, 1], -left[:, 0]
    norm = np.sqrt(c * c + s * s)
    flat = norm > 1e-6  # a left axis straight up or down: any heading will do
    norm = np.where(flat, norm, 1.0)
    return np.where(flat, c / norm, 1.0).astype(columns.dtype), np.where(flat, s / norm, 0.0).astype(columns.dtype)


def canonical(x, columns, v, frame=None):
    r"""A state in its heading frame.

    Args      x, v : (B, 22, 3) [m], [m/s]; columns : (B, 22, 2, 3), all in the world; frame : (cos, sin, place (B, 2))
              of another state to use instead of its own
    Returns   x, columns, v in the frame; frame
    Test      tests/drop/test_drop_vae.py::test_canonical_is_invariant
    """
    if frame is None:
        frame = *facing(columns), x[:, 0, :2].copy()
    cos, sin, place = frame
    moved = x.copy()
    moved[..., :2] -= place[:, None]
    return turned(moved, cos, -sin), turned(columns, cos, -sin), turned(v, cos, -sin), frame


def to_world(x, columns, frame):
    """Undo `canonical`.  Test: tests/drop/test_drop_vae.py::test_canonical_is_invariant"""
    cos, sin, place = frame
    x = turned(x, cos, sin)
    x[..., :2] += place[:, None]
    return x, turned(columns, cos, sin)


def state_vector(x, columns, v):
    """(B, STATE) of a canonical state, not yet normalised.

    Test: tests/drop/test_drop_vae.py::test_canonical_is_invariant"""
    b = len(x)
    return np.concatenate(
        [x[:, 0, 2:], x[:, 1:].reshape(b, -1), columns.reshape(b, -1), VELOCITY_SCALE * v.reshape(b, -1)], axis=1
    )


_MIRROR = np.array([0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20])
_FLIP = np.array([1.0, -1.0, 1.0], np.float32)


def mirrored(x, columns):
    r"""A motion seen in a mirror: y changes its sign, left and right change places.

    Equation  x' = M x, R' = M R M, M = diag(1, −1, 1): column 1 becomes M c1, column 2 becomes −M c2
    Args      x : (..., 22, 3); columns : (..., 22, 2, 3)
    Test      tests/drop/test_drop_vae.py::test_mirrored
    """
    x, columns = x[..., _MIRROR, :] * _FLIP, columns[..., _MIRROR, :, :] * _FLIP
    columns[..., 1, :] *= -1.0
    return x, columns


# ------------------------------------------------------------------------------------ Gaussians


def bounded_forward(raw):
    r"""log σ = b tanh(raw / b), b = LOG_STD_BOUND.  Test: tests/drop/test_drop_vae.py::test_gaussians"""
    t = np.tanh(raw / LOG_STD_BOUND)
    return LOG_STD_BOUND * t, t


def bounded_backward(dlog_std, t):
    """Gradient of `bounded_forward`.  Test: tests/test_gradients.py::test_backward"""
    return dlog_std * (1.0 - t * t)


def kl_forward(mu0, log_std0, mu1, log_std1):
    r"""KL(N0 ‖ N1) of diagonal Gaussians row by row, and its gradients.

    Equation  Σ log(σ1/σ0) + (σ0² + (μ0 − μ1)²)/(2 σ1²) − ½
    Args      (B, Z) each
    Returns   KL (B,) [nat]; (dμ0, dlog σ0, dμ1, dlog σ1), each d KL / d its argument
    Test      tests/drop/test_drop_vae.py::test_gaussians, tests/test_gradients.py::test_backward
    """
    inv = np.exp(-2.0 * log_std1)
    ratio, d = np.exp(2.0 * (log_std0 - log_std1)), mu0 - mu1
    kl = (log_std1 - log_std0 + 0.5 * (ratio + d * d * inv) - 0.5).sum(axis=1)
    return kl, (d * inv, ratio - 1.0, -d * inv, 1.0 - ratio - d * d * inv)


# ------------------------------------------------------------------------------------ networks


class LatentMLP(MLP):
    r"""A decoder that gets z at every layer, as HuMoR's and MotionVAE's do, so that it cannot be ignored.

    Equation  h_0 = x, h_{i+1} = act([h_i, z] W_i + b_i), y = [h_{n−1}, z] W_{n−1} + b_{n−1}
    Args      sizes : inputs without z first; latent : entries of z; gain : of the output layer
    Test      tests/drop/test_drop_vae.py::test_latent_mlp, tests/test_gradients.py::test_backward
    """

    def __init__(self, sizes, latent, rng, gain=1.0, dtype=np.float32):
        self.sizes, self.latent, self.activation = tuple(sizes), latent, "leaky_relu"
        self.n_layers = len(sizes) - 1
        self.shapes = {}
        for i, (n_in, n_out) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            self.shapes[f"W{i}"], self.shapes[f"b{i}"] = (n_in + latent, n_out), (n_out,)
        self.n_params = sum(math.prod(s) for s in self.shapes.values())
        self.theta = np.zeros(self.n_params, dtype=dtype)
        for i in range(self.n_layers if rng else 0):  # as MLP: without rng zero, for weights that are read
            g = gain if i == self.n_layers - 1 else NN_ACTIVATIONS[self.activation][2]
            self.params[f"W{i}"][:] = orthogonal(*self.shapes[f"W{i}"], g, rng)

    def forward(self, x, z):
        """y (B, n_n) and the cache of x (B, n_0), z (B, latent)."""
        act, params, h, caches = NN_ACTIVATIONS[self.activation][0], self.params, x, []
        for i in range(self.n_layers):
            h, linear = linear_forward(np.concatenate([h, z], axis=1), params[f"W{i}"], params[f"b{i}"])
            a = None
            if i < self.n_layers - 1:
                h, a = act(h)
            caches.append((linear, a))
        return h, caches

    def backward(self, dy, cache):
        """dx (B, n_0), dz (B, latent), dtheta (P,)."""
        act, dtheta, dz, d = NN_ACTIVATIONS[self.activation][1], np.empty_like(self.theta), 0.0, dy
        grads = self.unflatten(dtheta)
        for i in reversed(range(self.n_layers)):
            linear, a = cache[i]
            if a is not None:
                d, _ = act(d, a)
            d, (grads[f"W{i}"][:], grads[f"b{i}"][:]) = linear_backward(d, linear)
            d, dz = d[:, : -self.latent], dz + d[:, -self.latent :]
        return d, dz, dtheta

    def __call__(self, x, z):
        return self.forward(x, z)[0]


class MotionVAE:
    r"""The conditional VAE of transitions  [DROP Eq. 8: x̃_{t+1} = M(x_t, x_{t−1}, …, z)].

    Symbols   s_t -> normalised state, z -> (B, latent); `nets` prior, posterior, decoder
    Args      latent, hidden : sizes; statistics : mean, std (STATE,) of states, scale (OUTPUT,) and offset of residuals
    ASSUMED   the sizes; two hidden layers each; HuMoR's have latent 48 and up to 1024 units
    Test      tests/drop/test_drop_vae.py::test_motion_vae, tests/test_gradients.py::test_backward
    """

    def __init__(self, latent, hidden, statistics, rng, dtype=np.float32):
        self.latent, self.hidden = latent, hidden
        self.stats = {k: np.asarray(v, dtype) for k, v in statistics.items()}
        half = max(hidden // 2, 8)
        self.nets = {
            "prior": MLP((STATE, half, half, 2 * latent), rng=rng, gain=0.1, dtype=dtype),
            "posterior": MLP((STATE + OUTPUT, half, half, 2 * latent), rng=rng, gain=0.1, dtype=dtype),
            "decoder": LatentMLP((STATE, hidden, hidden, OUTPUT + CONTACTS), latent, rng, gain=0.1, dtype=dtype),
        }

    def normalise(self, state):
        """Standardised and cut to ±CLIP; (B, STATE)."""
        s = (state - self.stats["mean"]) / self.stats["std"]
        return np.clip(s, -CLIP, CLIP).astype(self.stats["mean"].dtype)

    def gaussian(self, name, inputs):
        """μ, log σ (B, latent) of `prior` or `posterior`, and the cache."""
        y, cache = self.nets[name].forward(inputs)
        log_std, t = bounded_forward(y[:, self.latent :])
        return y[:, : self.latent], log_std, (cache, t)

    def gaussian_backward(self, name, dmu, dlog_std, cache):
        """dtheta of `gaussian`."""
        both = np.concatenate([dmu, bounded_backward(dlog_std, cache[1])], axis=1)
        return self.nets[name].backward(both, cache[0], want_dx=False)[1]

    def residual(self, y):
        """The decoder's output in metres and columns: displacement (B, 3), change of the columns (B, 22, 2, 3)."""
        y = y[:, :OUTPUT] * self.stats["scale"] + self.stats["offset"]
        return y[:, :3], y[:, 3:].reshape(-1, N, 2, 3)

    def decode(self, s, z, height, columns):
        """The next frame in the heading frame of this one: x (B, 22, 3), C (B, 22, 3, 3), contacts (B, 4) as logits.

        Test: tests/drop/test_drop_vae.py::test_motion_vae"""
        y = self.nets["decoder"](s, z)
        move, change = self.residual(y)
        C, _ = gram_schmidt_forward(columns + change)
        root = move.copy()
        root[:, 2] += height
        return kinematics_forward(root, C), C, y[:, OUTPUT:]

    def loss(self, state, height, columns, x_next, columns_next, contacts, eps, kl_weight=1.0):
        r"""The negative ELBO of a batch and its gradients.

        Equation  L = mean ‖x̃ − x*‖²_w/(2 σ_x²) + ‖r̃ − r*‖²/(2 σ_R²) + BCE(c̃, c*) + w_KL KL(q(z | s, x*) ‖ p(z | s)),
                  z = μ + σ ε; x̃ by forward kinematics of r̃, the decoder's columns; BCE = Σ log(1 + e^c̃) − c* c̃, the
                  contacts that HuMoR predicts, too
        Args      state (B, STATE) not normalised; height (B,), columns (B, 22, 2, 3) of this frame; x_next,
                  columns_next the target, in the heading frame of this one; contacts (B, 4) of the target, 0 or 1;
                  eps (B, latent) standard normal
        Returns   parts : {reconstruction, contact, kl} [nat], means; dtheta by net; x̃, C of the reconstruction
        Test      tests/drop/test_drop_vae.py::test_motion_vae
        """
        b, stats = len(state), self.stats
        s = self.normalise(state)
        root_next = x_next[:, 0].copy()
        root_next[:, 2] -= height
        wanted = np.concatenate([root_next, (columns_next - columns).reshape(b, -1)], axis=1)
        wanted = np.clip((wanted - stats["offset"]) / stats["scale"], -2 * CLIP, 2 * CLIP)
        mu0, log0, prior_cache = self.gaussian("prior", s)
        mu, log, posterior_cache = self.gaussian("posterior", np.concatenate([s, wanted], axis=1))
        std = np.exp(log)
        z = mu + std * eps

        y, decoder_cache = self.nets["decoder"].forward(s, z)
        move, change = self.residual(y)
        raw = columns + change
        C, gs_cache = gram_schmidt_forward(raw)
        root = move.copy()
        root[:, 2] += height
        x = kinematics_forward(root, C)
        w = _WEIGHTS[:, None].astype(x.dtype)
        ex, er = x - x_next, raw - columns_next
        reconstruction = 0.5 * (np.sum(w * ex * ex) / SIGMA_X**2 + np.sum(er * er) / SIGMA_R**2) / b
        logits = y[:, OUTPUT:]
        contact = float(np.sum(np.logaddexp(0.0, logits) - contacts * logits)) / b
        kl, (dmu, dlog, dmu0, dlog0) = kl_forward(mu, log, mu0, log0)

        droot, dC = kinematics_backward(w * ex / (SIGMA_X**2 * b))
        draw = gram_schmidt_backward(dC, gs_cache) + er / (SIGMA_R**2 * b)
        dy = np.concatenate([droot, draw.reshape(b, -1)], axis=1) * stats["scale"]
        dlogits = (1.0 / (1.0 + np.exp(-logits)) - contacts) / b
        dy = np.concatenate([dy, dlogits], axis=1)
        _, dz, d_decoder = self.nets["decoder"].backward(dy, decoder_cache)
        k = kl_weight / b
        grads = {
            "prior": self.gaussian_backward("prior", k * dmu0, k * dlog0, prior_cache),
            "posterior": self.gaussian_backward("posterior", dz + k * dmu, dz * eps * std + k * dlog, posterior_cache),
            "decoder": d_decoder,
        }
        return {"reconstruction": float(reconstruction), "contact": contact, "kl": float(kl.mean())}, grads, x, C


# ------------------------------------------------------------------------------------ Eq. 15's network

POSE = LIMITED  # joints whose rotation, relative to the pelvis, is the pose
POSE_SIZE = 6 * len(POSE)


def pose_columns(C):
    r"""The pose of a frame: rotations relative to the pelvis.

    Equation  R' = R_pelvisᵀ R_j, joints POSE
    Args      C : (B, 22, 3, 3), rows are columns of global rotations
    Returns   (B, 16, 2, 3)
    Test      tests/drop/test_drop_vae.py::test_pose_vae
    """
    return np.matmul(C[:, POSE, :2], np.swapaxes(C[:, :1], -1, -2))


class PoseVAE:
    r"""The VAE of poses  [DROP Eq. 15: z = E(q), q = D(z)].

    Symbols   E -> encoder's mean, D -> decoder; z (B, latent); the prior of z is N(0, I)
    Args      latent, hidden : sizes; mean, std : (POSE_SIZE,) of the columns
    ASSUMED   sizes, two hidden layers each; KL weight 1 against a likelihood of SIGMA_X, SIGMA_R
    Test      tests/drop/test_drop_vae.py::test_pose_vae, tests/test_gradients.py::test_backward
    """

    def __init__(self, latent, hidden, statistics, rng, dtype=np.float32):
        self.latent, self.hidden = latent, hidden
        self.stats = {k: np.asarray(v, dtype) for k, v in statistics.items()}
        self.nets = {
            "encoder": MLP((POSE_SIZE, hidden, hidden, 2 * latent), rng=rng, gain=0.1, dtype=dtype),
            "decoder": MLP((latent, hidden, hidden, POSE_SIZE), rng=rng, gain=0.1, dtype=dtype),
        }

    def encode(self, pose):
        """E(q) (B, latent) of poses (B, 16, 2, 3)."""
        return self.nets["encoder"](self._normalise(pose))[:, : self.latent]

    def _normalise(self, pose):
        return (pose.reshape(len(pose), -1) - self.stats["mean"]) / self.stats["std"]

    def decode(self, z):
        """C (B, 22, 3, 3) relative to the pelvis; leaves as their parents.  Test: as the class."""
        return self._matrices(self.nets["decoder"](z))[0]

    def _matrices(self, y):
        raw = (y * self.stats["std"] + self.stats["mean"]).reshape(-1, len(POSE), 2, 3)
        some, cache = gram_schmidt_forward(raw)
        C = np.broadcast_to(np.eye(3, dtype=raw.dtype), (len(raw), N, 3, 3)).copy()
        C[:, POSE] = some
        C[:, LEAVES] = C[:, PARENTS[LEAVES]]
        return C, raw, cache

    def loss(self, pose, x, eps, kl_weight=1.0):
        r"""The negative ELBO of a batch of poses and its gradients.

        Equation  as `MotionVAE.loss`, with p(z) = N(0, I) and no condition
        Args      pose (B, 16, 2, 3); x (B, 22, 3) its joints relative to the pelvis, in the pelvis's frame;
                  eps (B, latent)
        Returns   parts, dtheta by net
        Test      tests/drop/test_drop_vae.py::test_pose_vae
        """
        b = len(pose)
        out, encoder_cache = self.nets["encoder"].forward(self._normalise(pose))
        mu, (log, t) = out[:, : self.latent], bounded_forward(out[:, self.latent :])
        std = np.exp(log)
        y, decoder_cache = self.nets["decoder"].forward(mu + std * eps)
        C, raw, gs_cache = self._matrices(y)
        ex = kinematics_forward(np.zeros((b, 3), C.dtype), C) - x
        er = raw - pose
        reconstruction = 0.5 * (np.sum(ex * ex) / SIGMA_X**2 + np.sum(er * er) / SIGMA_R**2) / b
        kl, (dmu, dlog, _, _) = kl_forward(mu, log, np.zeros_like(mu), np.zeros_like(log))

        _, dC = kinematics_backward(ex / (SIGMA_X**2 * b))  # leaves have no bones, so no gradient
        draw = gram_schmidt_backward(dC[:, POSE], gs_cache) + er / (SIGMA_R**2 * b)
        dz, d_decoder = self.nets["decoder"].backward(draw.reshape(b, -1) * self.stats["std"], decoder_cache)
        k = kl_weight / b
        dlog = bounded_backward(dz * eps * std + k * dlog, t)
        both = np.concatenate([dz + k * dmu, dlog], axis=1)
        _, d_encoder = self.nets["encoder"].backward(both, encoder_cache, want_dx=False)
        return {"reconstruction": float(reconstruction), "kl": float(kl.mean())}, {
            "encoder": d_encoder, "decoder": d_decoder}  # fmt: skip


def networks(motion, pose):
    """name -> network, of both VAEs.  Test: tests/drop/test_drop_vae.py::test_ship_and_load"""
    return {f"motion.{n}": m for n, m in motion.nets.items()} | {f"pose.{n}": m for n, m in pose.nets.items()}


# ------------------------------------------------------------------------------------ noise

ANCESTORS = np.eye(N)
for _j in range(1, N):
    ANCESTORS[_j] += ANCESTORS[PARENTS[_j]]


def disturbed(x, columns, v, rng, tilt=0.12, joint=0.10, height=0.03, push=0.3, share=0.7):
    r"""States beside the data, as pushes leave them: what the prior must lead back from.

    Method    every joint turns by a random small angle, which its descendants share; the pelvis by another and up or
              down; velocities as the joints moved, and a common one.  A share of the rows, each by its own size
    ASSUMED   the sizes [rad, m, m/s], log-uniform between a tenth and the whole of them
    Returns   x, columns, v like the arguments
    Test      tests/drop/test_drop_vae.py::test_disturbed
    """
    b, t = len(x), x.dtype
    size = np.exp(rng.uniform(np.log(0.1), 0.0, b)) * (rng.random(b) < share)
    local = joint * rng.standard_normal((b, N, 3))
    local[:, 0] *= tilt / joint
    angle = (size[:, None, None] * np.matmul(ANCESTORS, local)).astype(t)
    C, _ = gram_schmidt_forward(columns)
    C = rotate_rows(C, angle)
    root = x[:, 0].copy()
    root[:, 2] += (size * height * rng.standard_normal(b)).astype(t)
    moved = kinematics_forward(root, C)
    common = (size * push)[:, None] * rng.standard_normal((b, 3))
    shaken = v + common[:, None].astype(t) + (moved - x) * rng.uniform(0, 0.2, (b, 1, 1)).astype(t) / STEP
    return moved, np.ascontiguousarray(C[..., :2, :]), shaken


def rotate_rows(C, vectors):
    r"""Every row of C (..., 3, 3) turned by the rotation vector of its joint (..., 3): Rodrigues' formula.

    Test: tests/drop/test_drop_vae.py::test_disturbed"""
    angle = np.sqrt(np.einsum("...i,...i", vectors, vectors))[..., None]
    axis = vectors / np.maximum(angle, 1e-9)
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    n = np.broadcast_to(axis[..., None, :], C.shape)
    along = np.einsum("...i,...i", n, C)[..., None]
    return c * C + s * _cross(n, C) + (1.0 - c) * along * n

r"""Networks, the Gaussian policy head, Adam and the observation normaliser [Reda23 App. B].

Pure NumPy with hand-written backward passes. A layer is two functions:

    y, cache    = X_forward(x, ...)
    dx, grads   = X_backward(dy, cache)          dy = d loss / d y, dx = d loss / d x

The dtype follows the parameters: float32 in training, float64 in the gradient tests. Nothing upcasts on
the way. Shapes stand on each line: B rows of a minibatch, A actions, P parameters.

The paper's network sizes and hyper-parameters (Table 3) are lost, so every default here is ASSUMED, with
its source beside it.

    [Kingma15]  Kingma and Ba, Adam: a method for stochastic optimization, ICLR 2015
    [Saxe14]    Saxe, McClelland and Ganguli, Exact solutions to the nonlinear dynamics of learning, ICLR 2014
    [He15]      He et al., Delving deep into rectifiers, ICCV 2015
    [Huang22]   Huang et al., The 37 implementation details of PPO, ICLR blog track 2022
    [Chan79]    Chan, Golub and LeVeque, Updating formulae and a pairwise algorithm, Stanford 1979

Run `python nn.py` to check the gradient of a network and to time it on this machine.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from types import MappingProxyType

import numpy as np

# glibc gives freed memory back to the system, and every fresh activation then pays page faults: about a quarter
# of a training step. Its threshold follows the largest block freed so far (up to 32 MiB), so freeing one
# untouched block here keeps the pages. With another allocator this does nothing.
np.empty(31 << 20, dtype=np.uint8)

LEAKY_SLOPE = 0.01  # ASSUMED: the usual slope; the paper names no activation
LOG_2PI = math.log(2.0 * math.pi)


def _check_shape(name, array, expected):
    """Raise ValueError unless `array.shape` is `expected`; a string in `expected` stands for any size."""
    shape = np.shape(array)
    if shape == expected:  # at once, because a network of one row spends a fifth of its time here
        return
    fits = len(shape) == len(expected) and all(
        isinstance(e, str) or s == e for s, e in zip(shape, expected, strict=True)
    )
    if not fits:
        wanted = ", ".join(str(e) for e in expected) + ("," if len(expected) == 1 else "")
        raise ValueError(f"{name} has shape {shape}, expected ({wanted})")


# ------------------------------------------------------------------------------------------------ layers


def linear_forward(x, W, b):
    r"""Affine layer.

    Equation  y = x W + b
    Args      x : (B, n_in), cast to the dtype of W; W : (n_in, n_out); b : (n_out,)
    Returns   y : (B, n_out); cache for `linear_backward`. It holds x and W by reference: change neither
              before the backward pass.
    Raises    ValueError: shapes do not fit
    Test      tests/test_nn.py::test_linear
    """
    _check_shape("W", W, ("n_in", "n_out"))
    _check_shape("b", b, W.shape[1:])
    x = np.asarray(x, dtype=W.dtype)
    _check_shape("x", x, ("B", W.shape[0]))
    y = x @ W  # (B, n_out)
    y += b
    return y, (x, W)


def linear_backward(dy, cache, want_dx=True):
    r"""Gradient of `linear_forward`.

    Equation  dx = dy W^T, dW = x^T dy, db = sum_B dy
    Args      dy : (B, n_out); cache : from `linear_forward`; want_dx : False skips one of the two products,
              which the first layer of a network does not need
    Returns   dx : (B, n_in) or None; grads : (dW (n_in, n_out), db (n_out,)), summed over the batch
    Raises    ValueError: dy does not have the shape of y
    Test      tests/test_gradients.py::test_backward
    """
    x, W = cache
    dy = np.asarray(dy, dtype=W.dtype)
    _check_shape("dy", dy, (x.shape[0], W.shape[1]))
    dx = dy @ W.T if want_dx else None  # (B, n_in)
    return dx, (x.T @ dy, dy.sum(axis=0))


def leaky_relu_forward(x):
    r"""Leaky rectifier.

    Equation  y = max(x, s x), s = LEAKY_SLOPE
    Args      x : any shape
    Returns   y : shape of x; cache for `leaky_relu_backward`
    Test      tests/test_nn.py::test_activations
    """
    y = LEAKY_SLOPE * x
    np.maximum(x, y, out=y)
    return y, y


def leaky_relu_backward(dy, cache):
    r"""Gradient of `leaky_relu_forward`.

    Equation  dx = dy where y > 0, else s dy. The rectifier keeps the sign, so y tells what x was.
    Args      dy : shape of y; cache : from `leaky_relu_forward`
    Returns   dx : shape of y; grads : (), the layer has no parameters
    Raises    ValueError: dy does not have the shape of y
    Test      tests/test_gradients.py::test_backward
    """
    y = cache
    _check_shape("dy", dy, y.shape)
    dx = np.maximum(y > 0, y.dtype.type(LEAKY_SLOPE))  # 1 or s; several times faster than np.where here
    dx *= dy
    return dx, ()


def tanh_forward(x):
    r"""Hyperbolic tangent.

    Equation  y = tanh(x)
    Args      x : any shape
    Returns   y : shape of x; cache for `tanh_backward`
    Test      tests/test_nn.py::test_activations
    """
    y = np.tanh(x)
    return y, y


def tanh_backward(dy, cache):
    r"""Gradient of `tanh_forward`.

    Equation  dx = dy (1 - y^2)
    Args      dy : shape of y; cache : from `tanh_forward`
    Returns   dx : shape of y; grads : (), the layer has no parameters
    Raises    ValueError: dy does not have the shape of y
    Test      tests/test_gradients.py::test_backward
    """
    y = cache
    _check_shape("dy", dy, y.shape)
    dx = y * y
    np.subtract(1.0, dx, out=dx)
    dx *= dy
    return dx, ()


# name -> forward, backward, gain of the initial weights of the layer before it
ACTIVATIONS = {
    "leaky_relu": (leaky_relu_forward, leaky_relu_backward, math.sqrt(2.0 / (1.0 + LEAKY_SLOPE**2))),  # [He15, Eq. 15]
    "tanh": (tanh_forward, tanh_backward, math.sqrt(2.0)),  # [Huang22, detail 2]
}


# ----------------------------------------------------------------------------------------------- network


def orthogonal(n_in, n_out, gain, rng):
    r"""Random matrix with orthogonal rows or columns, times a gain.

    Equation  [Saxe14] W = gain Q with Q^T Q = I (n_in >= n_out) or Q Q^T = I, uniform over such matrices
    Args      n_in, n_out : int; gain : float; rng : np.random.Generator
    Returns   W : (n_in, n_out) float64
    Test      tests/test_nn.py::test_orthogonal
    """
    tall = rng.standard_normal((max(n_in, n_out), min(n_in, n_out)))
    q, r = np.linalg.qr(tall)
    q *= np.sign(np.diag(r))  # the QR signs are a convention of LAPACK; this makes Q uniform
    return gain * (q if n_in >= n_out else q.T)


class MLP:
    r"""Fully connected network: linear, activation, ..., linear.

    Equation  h_0 = x, h_{i+1} = act(h_i W_i + b_i), y = h_{n-1} W_{n-1} + b_{n-1}
    Symbols   theta : (P,), all parameters in the order W0, b0, W1, b1, ...; `params` names its pieces
    Args      sizes : (n_0, ..., n_n), inputs first; activation : a name in ACTIVATIONS; rng : Generator,
              or None: all weights zero, for those that are read from a file;
              gain : of the output layer. ASSUMED [Huang22, detail 2]: 0.01 for a policy, so that it starts
              near zero, and 1 for a value. dtype : float32, or float64 in gradient tests
    Raises    ValueError: fewer than two sizes, a size below 1, or an unknown activation
    Test      tests/test_nn.py::test_mlp, test_mlp_matches_torch

    ASSUMED: orthogonal weights [Saxe14] and zero biases, as most PPO code does [Huang22, detail 2].

    `theta` is one contiguous vector, so an optimiser step is one vector operation and a checkpoint is one
    array. `params` is made anew from `theta` each time: a copied, pickled or rebound `theta` (for example to
    a slice of a longer vector) can never drift apart from its views.
    """

    def __init__(self, sizes, activation="leaky_relu", rng=None, gain=1.0, dtype=np.float32):
        self.sizes = tuple(int(n) for n in sizes)
        if len(self.sizes) < 2 or min(self.sizes) < 1:
            raise ValueError(f"sizes is {self.sizes}, expected at least two positive integers (inputs, ..., outputs)")
        if activation not in ACTIVATIONS:
            raise ValueError(f"unknown activation {activation!r}, expected one of {sorted(ACTIVATIONS)}")
        if not (rng is None or isinstance(rng, np.random.Generator)):
            raise ValueError(f"rng is {rng!r}, expected a np.random.Generator or None")
        self.activation = activation
        self.n_layers = len(self.sizes) - 1
        self.shapes = {}  # name -> shape, in the order of theta
        for i, (n_in, n_out) in enumerate(zip(self.sizes[:-1], self.sizes[1:], strict=True)):
            self.shapes[f"W{i}"] = (n_in, n_out)
            self.shapes[f"b{i}"] = (n_out,)
        self.n_params = sum(math.prod(shape) for shape in self.shapes.values())
        self.theta = np.zeros(self.n_params, dtype=dtype)  # (P,)
        hidden_gain = ACTIVATIONS[activation][2]
        for i, (n_in, n_out) in enumerate(zip(self.sizes[:-1], self.sizes[1:], strict=True) if rng else ()):
            layer_gain = gain if i == self.n_layers - 1 else hidden_gain
            self.params[f"W{i}"][:] = orthogonal(n_in, n_out, layer_gain, rng)

    @property
    def params(self):
        """Read-only map of name -> view into theta. Write through a view: `mlp.params["W0"][:] = W`."""
        return MappingProxyType(self.unflatten(self.theta))

    def unflatten(self, vector):
        r"""Name the pieces of a vector that is laid out as theta (theta itself, a gradient, a moment).

        Args      vector : (P,)
        Returns   dict of name -> view into vector, in order
        Raises    ValueError: vector is not (P,)
        Test      tests/test_nn.py::test_params_are_views
        """
        _check_shape("parameter vector", vector, (self.n_params,))
        views, start = {}, 0
        for name, shape in self.shapes.items():
            stop = start + math.prod(shape)
            views[name] = vector[start:stop].reshape(shape)
            start = stop
        return views

    def forward(self, x):
        r"""Evaluate, and keep what the backward pass needs.

        Args      x : (B, n_0), cast to the dtype of theta
        Returns   y : (B, n_n); cache for `backward`. It refers to x and theta: call `backward` before either
                  changes.
        Raises    ValueError: x is not (B, n_0)
        Test      tests/test_nn.py::test_mlp
        """
        # Fresh arrays for each call: reused buffers would save little (the allocator hands the same pages
        # back), and a second forward pass would overwrite the cache of the first.
        act_forward = ACTIVATIONS[self.activation][0]
        params, h, caches = self.params, x, []
        for i in range(self.n_layers):
            h, linear_cache = linear_forward(h, params[f"W{i}"], params[f"b{i}"])  # (B, n_{i+1})
            act_cache = None
            if i < self.n_layers - 1:
                h, act_cache = act_forward(h)  # (B, n_{i+1})
            caches.append((linear_cache, act_cache))
        return h, caches

    def backward(self, dy, cache, want_dx=True):
        r"""Gradient of `forward`.

        Args      dy : (B, n_n); cache : from `forward`; want_dx : False saves the product for the input
        Returns   dx : (B, n_0) or None; dtheta : (P,), laid out as theta, summed over the batch
        Raises    ValueError: dy does not have the shape of y
        Test      tests/test_gradients.py::test_backward
        """
        act_backward = ACTIVATIONS[self.activation][1]
        dtheta = np.empty_like(self.theta)  # (P,)
        grads = self.unflatten(dtheta)
        d = dy
        for i in reversed(range(self.n_layers)):
            linear_cache, act_cache = cache[i]
            if act_cache is not None:
                d, _ = act_backward(d, act_cache)  # (B, n_{i+1})
            d, (dW, db) = linear_backward(d, linear_cache, want_dx=want_dx or i > 0)  # (B, n_i)
            grads[f"W{i}"][:] = dW
            grads[f"b{i}"][:] = db
        return d, dtheta

    def __call__(self, x):
        r"""Evaluate without a cache. Bit for bit the y of `forward`.

        Args      x : (B, n_0), cast to the dtype of theta
        Returns   y : (B, n_n)
        Raises    ValueError: x is not (B, n_0)
        Test      tests/test_nn.py::test_call_equals_forward
        """
        act_forward, params = ACTIVATIONS[self.activation][0], self.params
        h = np.asarray(x, dtype=self.theta.dtype)
        _check_shape("x", h, ("B", self.sizes[0]))
        for i in range(self.n_layers):  # the layers' own checks would cost as much as a network of one row
            h = h @ params[f"W{i}"]  # (B, n_{i+1})
            h += params[f"b{i}"]
            if i < self.n_layers - 1:
                h, _ = act_forward(h)
        return h


# ------------------------------------------------------------------------------------ Gaussian policy head


def _gaussian_args(a, mu, log_std):
    """Check a (B, A), mu (B, A), log_std (A,) and bring them to the dtype of mu."""
    mu = np.asarray(mu)
    a, log_std = np.asarray(a, dtype=mu.dtype), np.asarray(log_std, dtype=mu.dtype)
    _check_shape("mu", mu, ("B", "A"))
    _check_shape("a", a, mu.shape)
    _check_shape("log_std", log_std, mu.shape[1:])
    return a, mu, log_std


def gaussian_logp(a, mu, log_std):
    r"""Log-density of a diagonal Gaussian, pi(a | o) in rho_t.

    Equation  log pi = -sum_A [ z^2 / 2 + log sigma + log(2 pi) / 2 ], z = (a - mu) / sigma
    Symbols   sigma -> exp(log_std), the same for every observation (ASSUMED [Huang22, detail 1])
    Args      a : (B, A) the action before any clipping; mu : (B, A); log_std : (A,)
    Returns   logp : (B,) [nat], dtype of mu
    Raises    ValueError: shapes differ
    Test      tests/test_nn.py::test_gaussian_logp
    """
    a, mu, log_std = _gaussian_args(a, mu, log_std)
    z = (a - mu) * np.exp(-log_std)  # (B, A)
    return -0.5 * np.einsum("ba,ba->b", z, z) - (log_std.sum() + 0.5 * LOG_2PI * log_std.size)  # (B,)


def gaussian_logp_backward(dlogp, a, mu, log_std):
    r"""Gradient of `gaussian_logp`.

    Equation  dmu = dlogp z / sigma, dlog_std = sum_B dlogp (z^2 - 1)
    Args      dlogp : (B,) d loss / d logp; a, mu, log_std : as in `gaussian_logp`
    Returns   dmu : (B, A); dlog_std : (A,), summed over the batch
    Raises    ValueError: shapes differ
    Test      tests/test_gradients.py::test_backward
    """
    a, mu, log_std = _gaussian_args(a, mu, log_std)
    dlogp = np.asarray(dlogp, dtype=mu.dtype)
    _check_shape("dlogp", dlogp, mu.shape[:1])
    inv_std = np.exp(-log_std)  # (A,)
    z = (a - mu) * inv_std  # (B, A)
    dlog_std = dlogp @ (z * z - 1.0)  # (A,)
    z *= inv_std
    z *= dlogp[:, None]
    return z, dlog_std  # dmu is now in z


def gaussian_entropy(log_std):
    r"""Entropy of a diagonal Gaussian.

    Equation  H = sum_A [ log sigma + log(2 pi e) / 2 ]
    Args      log_std : (A,)
    Returns   H : float [nat]
    Raises    ValueError: log_std is not (A,)
    Test      tests/test_nn.py::test_gaussian_entropy
    """
    _check_shape("log_std", log_std, ("A",))
    return float(np.sum(log_std, dtype=np.float64) + 0.5 * (LOG_2PI + 1.0) * np.size(log_std))


def gaussian_entropy_backward(dentropy, log_std):
    r"""Gradient of `gaussian_entropy`.

    Equation  d H / d log sigma_i = 1
    Args      dentropy : float, d loss / d H; log_std : (A,)
    Returns   dlog_std : (A,), dtype of log_std
    Raises    ValueError: log_std is not (A,)
    Test      tests/test_gradients.py::test_backward
    """
    _check_shape("log_std", log_std, ("A",))
    return np.full_like(log_std, dentropy)


def gaussian_kl(mu0, log_std0, mu1, log_std1):
    r"""Mean divergence of the new policy from the old one, KL(0 || 1), 0 = old, 1 = new.

    Equation  KL = sum_A [ log(s1 / s0) + (s0^2 + (mu0 - mu1)^2) / (2 s1^2) - 1/2 ], mean over the batch
    Symbols   d = log(s0 / s1): the first and last terms are (expm1(2 d) - 2 d) / 2, which does not cancel
              when the policies are close
    Args      mu0, mu1 : (B, A); log_std0, log_std1 : (A,)
    Returns   KL : float [nat]
    Raises    ValueError: shapes differ
    Test      tests/test_nn.py::test_gaussian_kl
    """
    mu0, mu1, log_std1 = _gaussian_args(mu0, mu1, log_std1)
    _check_shape("log_std0", log_std0, log_std1.shape)
    d = np.asarray(log_std0, dtype=np.float64) - log_std1  # (A,)
    z = (mu0 - mu1) * np.exp(-log_std1)  # (B, A)
    return float(0.5 * np.sum(np.expm1(2.0 * d) - 2.0 * d) + 0.5 * np.einsum("ba,ba->b", z, z).mean(dtype=np.float64))


def value_loss(v, target):
    r"""Squared error of the value network.

    Equation  L = mean (v - target)^2 / 2
    Args      v, target : one shape, (B,) or (B, 1). A (B,) beside a (B, 1) would broadcast to (B, B), so it
              is an error.
    Returns   loss : float; dv : shape and dtype of v
    Raises    ValueError: shapes differ, or there are no values
    Test      tests/test_nn.py::test_value_loss, tests/test_gradients.py::test_backward
    """
    v = np.asarray(v)
    target = np.asarray(target, dtype=v.dtype)
    _check_shape("target", target, v.shape)
    if v.size == 0:
        raise ValueError(f"v has shape {v.shape}, expected at least one value")
    error = v - target
    return float(0.5 * np.mean(error * error, dtype=np.float64)), error / v.size


# --------------------------------------------------------------------------------------------- optimiser


def _load_arrays(owner, state, expected):
    """Copies of the arrays of `state` that `expected` (name -> current array) lists, checked."""
    if set(state) != set(expected):
        raise ValueError(f"{owner} state has keys {sorted(state)}, expected {sorted(expected)}")
    for name, array in expected.items():
        _check_shape(f"{owner} state {name!r}", state[name], np.shape(array))
    return {name: np.array(state[name], dtype=np.asarray(array).dtype) for name, array in expected.items()}


class Adam:
    r"""Adam on one flat vector.

    Equation  [Kingma15, Algorithm 1]
              m_t = beta1 m_{t-1} + (1 - beta1) g_t,        m^ = m_t / (1 - beta1^t)
              v_t = beta2 v_{t-1} + (1 - beta2) g_t^2,      v^ = v_t / (1 - beta2^t)
              theta_t = theta_{t-1} - lr m^ / (sqrt(v^) + eps)
    Args      size : int, length of theta; lr, betas, eps : the defaults are the paper's; dtype : of theta
    Raises    ValueError: a value outside its range
    Test      tests/test_nn.py::test_adam_matches_scalar_loop, test_adam_matches_torch

    `lr` may be set between steps. It belongs to the configuration, not to `state()`.
    """

    def __init__(self, size, lr=1e-3, betas=(0.9, 0.999), eps=1e-8, dtype=np.float32):
        if not (lr >= 0 and eps > 0 and 0 <= betas[0] < 1 and 0 <= betas[1] < 1):
            raise ValueError(f"lr {lr}, betas {betas}, eps {eps}: expected lr >= 0, eps > 0 and betas in [0, 1)")
        self.lr, self.betas, self.eps = lr, tuple(betas), eps
        self.t = 0
        self.m = np.zeros(size, dtype=dtype)  # (P,)
        self.v = np.zeros(size, dtype=dtype)  # (P,)
        self._work = np.empty(size, dtype=dtype)  # (P,) scratch, no state

    def step(self, theta, grad):
        r"""One update of theta, in place.

        Args      theta, grad : (P,)
        Raises    ValueError: a shape is not (size,), or theta has another dtype than the moments
        Test      tests/test_nn.py::test_adam_matches_scalar_loop
        """
        _check_shape("theta", theta, self.m.shape)
        _check_shape("grad", grad, self.m.shape)
        if theta.dtype != self.m.dtype:
            raise ValueError(f"theta is {theta.dtype}, expected {self.m.dtype}, the dtype Adam was made with")
        beta1, beta2 = self.betas
        self.t += 1
        work = self._work
        np.multiply(grad, 1.0 - beta1, out=work)
        self.m *= beta1
        self.m += work
        np.multiply(grad, grad, out=work)
        work *= 1.0 - beta2
        self.v *= beta2
        self.v += work
        np.multiply(self.v, 1.0 / (1.0 - beta2**self.t), out=work)  # v^
        np.sqrt(work, out=work)
        work += self.eps
        np.divide(self.m, work, out=work)
        work *= self.lr / (1.0 - beta1**self.t)  # lr m^ / (sqrt(v^) + eps)
        theta -= work

    def follow_kl(self, kl, target):
        """Change lr by a factor of 1.2, within 1e-6 to 1e-2, where the last epoch's KL divergence is off its target.

        ASSUMED   both factors: off is 1.3 times as much, or as little
        Test      tests/test_ppo.py::test_rate_follows_kl_and_sigma_has_a_floor"""
        if kl > 1.3 * target:
            self.lr = max(self.lr / 1.2, 1e-6)
        elif kl < target / 1.3:
            self.lr = min(self.lr * 1.2, 1e-2)

    def state(self):
        r"""Copies of what a resumed run needs: t (), m (P,), v (P,).

        Returns   dict of arrays, fit for np.savez
        Test      tests/test_nn.py::test_adam_resume
        """
        return {"t": np.array(self.t), "m": self.m.copy(), "v": self.v.copy()}

    def load_state(self, state):
        r"""Continue from `state()`, bit for bit.

        Args      state : dict of arrays
        Raises    ValueError: keys or shapes differ, or t or v is negative
        Test      tests/test_nn.py::test_adam_resume
        """
        arrays = _load_arrays("Adam", state, {"t": np.array(self.t), "m": self.m, "v": self.v})
        if not (arrays["t"] >= 0 and np.all(arrays["v"] >= 0)):
            raise ValueError(f"Adam state has t = {arrays['t']} and a least v of {arrays['v'].min(initial=0.0):g}")
        self.t, self.m, self.v = int(arrays["t"]), arrays["m"], arrays["v"]


def clip_grad_norm(grad, max_norm):
    r"""Scale a gradient down, in place, to a largest Euclidean norm.

    Equation  grad <- grad min(1, max_norm / ||grad||)
    Args      grad : (P,); max_norm : float > 0
    Returns   norm : float, before the scaling
    Raises    ValueError: a non-finite entry, which one step would spread over every parameter; max_norm <= 0
    Test      tests/test_nn.py::test_clip_grad_norm
    """
    if not max_norm > 0:
        raise ValueError(f"max_norm is {max_norm}, expected a positive number")
    norm = math.sqrt(np.sum(np.square(grad, dtype=np.float64)))
    if not math.isfinite(norm):
        bad = np.flatnonzero(~np.isfinite(grad))
        raise ValueError(f"gradient has {bad.size} non-finite of {grad.size} entries, first at {bad[:1].tolist()}")
    if norm > max_norm:
        grad *= max_norm / norm
    return norm


# ------------------------------------------------------------------------------------ observation normaliser


class RunningNorm:
    r"""Standardise observations with their running mean and variance.

    Equation  y = clip((x - mean) / sqrt(var + eps), -clip, clip)
    Symbols   var = m2 / count, the population variance of every row seen by `update`
    Args      size : int, entries of one observation; clip : 10 (ASSUMED, as in most PPO code);
              eps : 1e-8 [unit of x squared] (ASSUMED); dtype : of the output
    Test      tests/test_nn.py::test_running_norm_matches_numpy

    Before the first `update` it only clips. Set `frozen = True` to play a policy: `update` then does
    nothing. `state()` belongs in the checkpoint beside the weights.
    """

    def __init__(self, size, clip=10.0, eps=1e-8, dtype=np.float32):
        self.size, self.clip, self.eps, self.dtype = int(size), float(clip), float(eps), np.dtype(dtype)
        self.frozen = False
        self.count = 0
        self.mean64 = np.zeros(self.size)  # (n,) float64
        self.m2 = np.zeros(self.size)  # (n,) float64, sum of squared deviations
        self._refresh()

    @property
    def var(self):
        """Population variance, (n,) float64; ones before the first update."""
        return self.m2 / self.count if self.count else np.ones(self.size)

    def _refresh(self):
        """Cache mean and inv_std in the dtype of the output."""
        self.mean = self.mean64.astype(self.dtype)  # (n,)
        self.inv_std = (1.0 / np.sqrt(self.var + self.eps)).astype(self.dtype)  # (n,)

    def _check(self, x):
        """x as an array (..., n) of finite numbers, or ValueError."""
        x = np.asarray(x)
        if x.ndim == 0 or x.shape[-1] != self.size:
            raise ValueError(f"observations have shape {x.shape}, expected (..., {self.size})")
        finite = np.isfinite(x)
        if not finite.all():
            where = np.argwhere(~finite)
            first = tuple(where[0].tolist())
            raise ValueError(f"{len(where)} non-finite of {x.size} observation entries, first {x[first]} at {first}")
        return x

    def update(self, batch):
        r"""Take in a batch of observations.

        Equation  [Chan79, Eq. 2.1] with d = mean_B - mean, n = count + B:
                  mean <- mean + d B / n,  m2 <- m2 + m2_B + d^2 count B / n
        Args      batch : (..., n), at least one row
        Raises    ValueError: wrong shape, no rows, or a non-finite entry (nothing changes then)
        Test      tests/test_nn.py::test_running_norm_matches_numpy
        """
        if self.frozen:
            return
        rows = self._check(batch).reshape(-1, self.size).astype(np.float64)  # (B, n)
        if len(rows) == 0:
            raise ValueError(f"observations have shape {np.shape(batch)}, expected at least one row")
        mean_b, m2_b = rows[0], 0.0  # (n,), of one row
        if len(rows) > 1:
            mean_b = rows.mean(axis=0)
            rows -= mean_b
            m2_b = np.einsum("bi,bi->i", rows, rows)
        total = self.count + len(rows)
        d = mean_b - self.mean64  # (n,)
        self.mean64 += d * (len(rows) / total)
        self.m2 += m2_b + d * d * (self.count * (len(rows) / total))
        self.count = total
        self._refresh()

    def normalise(self, x, out=None):
        r"""Standardise and clip.

        Args      x : (..., n); out : optional array (..., n) of the output dtype, may be x itself
        Returns   y : (..., n), out where given
        Raises    ValueError: wrong shape, or a non-finite entry
        Test      tests/test_nn.py::test_running_norm_output
        """
        x = self._check(x)
        if out is None:
            out = np.empty(x.shape, dtype=self.dtype)
        _check_shape("out", out, x.shape)
        np.subtract(x, self.mean, out=out, casting="same_kind")  # a float64 x is cut down after the subtraction
        out *= self.inv_std
        return np.clip(out, -self.clip, self.clip, out=out)

    def __call__(self, x):
        """`normalise` into a new array."""
        return self.normalise(x)

    def state(self):
        r"""Copies of what a resumed run needs: count (), mean (n,), m2 (n,), float64.

        Returns   dict of arrays, fit for np.savez
        Test      tests/test_nn.py::test_running_norm_resume
        """
        return {"count": np.array(self.count), "mean": self.mean64.copy(), "m2": self.m2.copy()}

    def load_state(self, state):
        r"""Continue from `state()`, bit for bit.

        Args      state : dict of arrays
        Raises    ValueError: keys or shapes differ
        Test      tests/test_nn.py::test_running_norm_resume
        """
        arrays = _load_arrays("RunningNorm", state, self.state())
        self.count, self.mean64, self.m2 = int(arrays["count"]), arrays["mean"], arrays["m2"]
        self._refresh()


# ----------------------------------------------------------------------------------------- gradient check


def finite_difference(f, x, eps=1e-4):
    r"""Numerical gradient of a scalar function.

    Equation  D(h) = (f(x + h e_i) - f(x - h e_i)) / (2 h),  g_i = (4 D(h/2) - D(h)) / 3
              Richardson's step removes the h^2 error. At h = 1e-4 what is left is rounding, about 1e-12 |f|.
    Args      f : function of an array like x, returns a scalar; x : float64, any shape, not changed;
              eps : h, absolute. A kink of f within h of x spoils the answer.
    Returns   g : shape of x, float64
    Raises    ValueError: x is not float64, where differences would be mostly rounding
    Test      tests/test_nn.py::test_finite_difference
    """
    x = np.array(x)
    if x.dtype != np.float64:
        raise ValueError(f"x is {x.dtype}, expected float64")
    flat, g = x.reshape(-1), np.empty(x.size)
    for i in range(flat.size):
        centre, slopes = flat[i], []
        for h in (eps, 0.5 * eps):
            flat[i] = centre + h
            above = float(f(x))
            flat[i] = centre - h
            below = float(f(x))
            slopes.append((above - below) / (2.0 * h))
        flat[i] = centre
        g[i] = (4.0 * slopes[1] - slopes[0]) / 3.0
    return g.reshape(x.shape)


def check_gradient(f, x, analytic, rtol=1e-6, atol=1e-9, eps=1e-4):
    r"""Compare an analytic gradient with `finite_difference`.

    Equation  |analytic - numeric| <= atol + rtol |numeric| for every entry
    Args      f, x, eps : as in `finite_difference`; analytic : shape of x
    Returns   worst : float, the largest error as a fraction of what is allowed
    Raises    ValueError: shapes differ; AssertionError: an entry is off (or not finite), naming the worst
    Test      tests/test_nn.py::test_check_gradient_catches_wrong_gradients
    """
    analytic = np.asarray(analytic)
    _check_shape("analytic gradient", analytic, np.shape(x))
    numeric = finite_difference(f, x, eps)
    ratio = np.abs(analytic - numeric) / (atol + rtol * np.abs(numeric))
    ratio = np.where(np.isfinite(ratio), ratio, np.inf)
    worst = float(ratio.max(initial=0.0))
    if worst > 1.0:
        i = np.unravel_index(ratio.argmax(), ratio.shape)
        raise AssertionError(
            f"{np.count_nonzero(ratio > 1.0)} of {ratio.size} entries differ; worst at {tuple(map(int, i))}: "
            f"analytic {analytic[i]:.10g}, numeric {numeric[i]:.10g}, {worst:.3g} times the tolerance"
        )
    return worst


# --------------------------------------------------------------------------------------------------- main


def main(argv=None):
    """Check one network's gradient and time it: `python nn.py --rows 4096 --sizes 320 256 128 48`."""
    parser = argparse.ArgumentParser(prog="nn.py", description="Check a network's gradient and time it.")
    parser.add_argument("--sizes", type=int, nargs="+", default=[320, 256, 128, 48], help="layer sizes, inputs first")
    parser.add_argument("--activation", choices=sorted(ACTIVATIONS), default="leaky_relu", help="of hidden layers")
    parser.add_argument("--rows", type=int, default=4096, help="rows of one minibatch")
    parser.add_argument("--repeats", type=int, default=20, help="timed calls; the median is printed")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights and inputs")
    args = parser.parse_args(argv)
    rng = np.random.default_rng(args.seed)

    small = MLP((5, 7, 6, 3), args.activation, rng, dtype=np.float64)
    x, dy = rng.standard_normal((4, 5)), rng.standard_normal((4, 3))
    dx, _ = small.backward(dy, small.forward(x)[1])
    worst = check_gradient(lambda x: np.sum(dy * small(x)), x, dx)
    print(f"gradient check: worst error {worst:.2g} of the tolerance")

    net = MLP(args.sizes, args.activation, rng)
    x = rng.standard_normal((args.rows, net.sizes[0]), dtype=np.float32)
    dy = rng.standard_normal((args.rows, net.sizes[-1]), dtype=np.float32)
    calls = {
        "forward": lambda: net(x),
        "forward + backward": lambda: net.backward(dy, net.forward(x)[1], want_dx=False),
    }
    for name, call in calls.items():
        seconds = []
        for _ in range(args.repeats):
            start = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - start)
        print(f"{name}: {args.rows / np.median(seconds):,.0f} rows/s")
    return 0


if __name__ == "__main__":
    sys.exit(main())

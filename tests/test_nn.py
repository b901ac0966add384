"""Tests of nn.py: every formula computed another way; the gradients are in tests/test_gradients.py."""

import copy
import pickle

import numpy as np
import pytest
from scipy import stats

import nn

SIZES = (5, 7, 6, 3)
ACTIVATIONS = sorted(nn.ACTIVATIONS)


@pytest.fixture
def rng():
    return np.random.default_rng(20230)


# ----------------------------------------------------------------------------------------- gradient check


def test_finite_difference(rng):
    x = rng.standard_normal((3, 4))
    before = x.copy()
    np.testing.assert_allclose(nn.finite_difference(lambda x: np.sum(np.sin(x)), x), np.cos(x), rtol=1e-9, atol=1e-11)
    assert np.array_equal(x, before)
    # Plain central differences miss 1e-6 on this function at this step; Richardson's do not.
    steep, at, h = lambda x: np.exp(8.0 * x[0]), np.array([0.3]), 1e-3
    true = 8.0 * np.exp(2.4)
    plain = (steep(at + h) - steep(at - h)) / (2.0 * h)
    assert abs(plain / true - 1.0) > 1e-6
    assert abs(nn.finite_difference(steep, at, h)[0] / true - 1.0) < 1e-9
    with pytest.raises(ValueError, match="float32, expected float64"):
        nn.finite_difference(np.sum, x.astype(np.float32))


def test_check_gradient_catches_wrong_gradients(rng):
    x = rng.standard_normal((4, 3))
    right = 3.0 * x**2

    def f(x):
        return np.sum(x**3)

    assert nn.check_gradient(f, x, right) <= 1.0
    one_entry = right.copy()
    one_entry[2, 1] *= 1.0 + 1e-5
    with pytest.raises(AssertionError, match=r"1 of 12 entries differ; worst at \(2, 1\)"):
        nn.check_gradient(f, x, one_entry)
    not_finite = right.copy()
    not_finite[0, 0] = np.nan
    for wrong in (-right, 2.0 * right, np.zeros_like(right), right[::-1], not_finite):
        with pytest.raises(AssertionError):
            nn.check_gradient(f, x, wrong)
    with pytest.raises(ValueError, match=r"analytic gradient has shape \(3, 4\), expected \(4, 3\)"):
        nn.check_gradient(f, x, right.T)


def test_check_gradient_catches_wrong_layers(rng):
    """Mistakes that hand-written layers really make."""
    x, W, b, dy = (rng.standard_normal(s) for s in ((6, 4), (4, 4), (4,), (6, 4)))
    _, cache = nn.linear_forward(x, W, b)
    _, (dW, db) = nn.linear_backward(dy, cache)
    for name, f, at, wrong in (
        ("dx without the transpose", lambda x: np.sum(dy * nn.linear_forward(x, W, b)[0]), x, dy @ W),
        ("dW transposed", lambda W: np.sum(dy * nn.linear_forward(x, W, b)[0]), W, dW.T),
        ("db as a mean", lambda b: np.sum(dy * nn.linear_forward(x, W, b)[0]), b, db / 6),
        ("tanh from x, not y", lambda x: np.sum(dy * nn.tanh_forward(x)[0]), x, dy * (1 - x**2)),
        ("relu, not leaky", lambda x: np.sum(dy * nn.leaky_relu_forward(x)[0]), x, dy * (x > 0)),
    ):
        with pytest.raises(AssertionError):
            nn.check_gradient(f, at, wrong)
            pytest.fail(f"the check passed a wrong gradient: {name}")


# ------------------------------------------------------------------------------------------------- layers


def test_linear(rng):
    x, W, b, dy = (rng.standard_normal(s) for s in ((6, 4), (4, 3), (3,), (6, 3)))
    y, cache = nn.linear_forward(x, W, b)
    np.testing.assert_allclose(y, np.einsum("bi,io->bo", x, W) + b, rtol=1e-13)
    _, (dW, db) = nn.linear_backward(dy, cache)
    no_dx, grads = nn.linear_backward(dy, cache, want_dx=False)
    assert no_dx is None
    assert np.array_equal(grads[0], dW) and np.array_equal(grads[1], db)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activations(rng, name):
    forward, backward, _ = nn.ACTIVATIONS[name]
    x = rng.standard_normal((6, 5))
    y, cache = forward(x)
    expected = {"leaky_relu": np.where(x > 0, x, 0.01 * x), "tanh": np.sinh(x) / np.cosh(x)}[name]
    np.testing.assert_allclose(y, expected, rtol=1e-13)
    assert backward(x, cache)[1] == ()


def test_leaky_relu_at_zero_takes_the_lower_slope():
    """The same choice as PyTorch's."""
    _, cache = nn.leaky_relu_forward(np.array([-0.0, 0.0]))
    assert nn.leaky_relu_backward(np.ones(2), cache)[0].tolist() == [nn.LEAKY_SLOPE] * 2


# ---------------------------------------------------------------------------------------------------- MLP


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_mlp(rng, name):
    """Row by row and weight by weight; without the gradient of the input the weights' is the same."""
    mlp = nn.MLP(SIZES, name, rng, dtype=np.float64)
    mlp.theta += 0.1 * rng.standard_normal(mlp.n_params)  # biases away from zero
    x, dy, act = rng.standard_normal((4, 5)), rng.standard_normal((4, 3)), nn.ACTIVATIONS[name][0]
    y, cache = mlp.forward(x)
    for row, h in zip(y, x, strict=True):
        for i in range(3):
            W, b = mlp.params[f"W{i}"], mlp.params[f"b{i}"]
            h = np.array([sum(h[k] * W[k, o] for k in range(len(W))) + b[o] for o in range(len(b))])
            h = act(h)[0] if i < 2 else h
        np.testing.assert_allclose(row, h, rtol=1e-12)
    no_dx, dtheta = mlp.backward(dy, cache, want_dx=False)
    assert no_dx is None and np.array_equal(dtheta, mlp.backward(dy, cache)[1])
    assert not nn.MLP(SIZES, name, None).theta.any()  # to be filled from a file


def test_two_caches_do_not_share_memory(rng):
    """A second forward pass must not disturb the gradient of the first."""
    mlp = nn.MLP(SIZES, "leaky_relu", rng)
    x, dy = rng.standard_normal((4, 5), dtype=np.float32), rng.standard_normal((4, 3), dtype=np.float32)
    _, cache = mlp.forward(x)
    expected = mlp.backward(dy, cache)
    mlp.forward(-x)
    for got, want in zip(mlp.backward(dy, cache), expected, strict=True):
        assert np.array_equal(got, want)


def test_call_equals_forward(rng):
    mlp = nn.MLP(SIZES, "tanh", rng)
    x = rng.standard_normal((9, 5), dtype=np.float32)
    assert np.array_equal(mlp(x), mlp.forward(x)[0])


def test_params_are_views(rng):
    mlp = nn.MLP(SIZES, "leaky_relu", rng)
    assert list(mlp.params) == ["W0", "b0", "W1", "b1", "W2", "b2"]
    assert mlp.n_params == mlp.theta.size == 5 * 7 + 7 + 7 * 6 + 6 + 6 * 3 + 3
    assert np.array_equal(np.concatenate([p.ravel() for p in mlp.params.values()]), mlp.theta)
    mlp.params["b1"][:] = 5.0
    assert np.count_nonzero(mlp.theta == 5.0) == 6
    with pytest.raises(TypeError):
        mlp.params["b1"] = np.zeros(6)  # would leave theta behind
    for twin in (copy.deepcopy(mlp), pickle.loads(pickle.dumps(mlp))):
        twin.theta[:] = 1.0
        assert np.all(twin.params["W0"] == 1.0)
        assert not np.any(mlp.theta == 1.0)
    joint = np.concatenate([mlp.theta, np.zeros(3, np.float32)])
    mlp.theta = joint[:-3]  # one vector for the network and log_std
    joint[:] = 2.0
    assert np.all(mlp.params["W2"] == 2.0)


def test_orthogonal(rng):
    for n_in, n_out in ((9, 4), (4, 9), (5, 5)):
        W = nn.orthogonal(n_in, n_out, 1.5, rng)
        assert W.shape == (n_in, n_out)
        gram = W.T @ W if n_in >= n_out else W @ W.T
        np.testing.assert_allclose(gram, 2.25 * np.eye(min(n_in, n_out)), atol=1e-12)
    # Uniform over rotations: the diagonal has mean zero. Without the sign correction it does not.
    diagonals = [np.diag(nn.orthogonal(3, 3, 1.0, rng)) for _ in range(2000)]
    assert np.abs(np.mean(diagonals)) < 0.03


def test_mlp_initial_scale(rng):
    mlp = nn.MLP((64, 64, 64, 8), "leaky_relu", rng, gain=0.01)
    y = mlp(rng.standard_normal((2000, 64)))
    assert 0.003 < y.std() < 0.03  # a policy that starts near zero
    assert all(not mlp.params[b].any() for b in ("b0", "b1", "b2"))
    wide = nn.MLP((64, 64, 64, 64), "leaky_relu", rng)
    assert wide(rng.standard_normal((2000, 64))).std() == pytest.approx(1.0, abs=0.2)  # [He15]: variance is kept
    again = [nn.MLP(SIZES, "tanh", np.random.default_rng(3)).theta for _ in range(2)]
    assert np.array_equal(*again)


def test_dtype_follows_parameters(rng):
    for dtype in (np.float32, np.float64):
        for name in ACTIVATIONS:
            mlp = nn.MLP(SIZES, name, rng, dtype=dtype)
            y, cache = mlp.forward(rng.standard_normal((4, 5)))  # float64 observations
            arrays = [y, *mlp.backward(rng.standard_normal((4, 3)), cache)]
            arrays += [act for _, act in cache if act is not None] + [lin[0] for lin, _ in cache]
            assert {a.dtype for a in arrays} == {np.dtype(dtype)}
    a, mu, log_std = (rng.standard_normal(s, dtype=np.float32) for s in ((4, 3), (4, 3), 3))
    heads = [nn.gaussian_logp(a, mu, log_std.astype(np.float64))]
    heads += nn.gaussian_logp_backward(heads[0], a.astype(np.float64), mu, log_std)
    heads += [nn.gaussian_entropy_backward(1.0, log_std), nn.value_loss(mu, a)[1]]
    adam = nn.Adam(3)
    adam.step(log_std, mu[0])
    heads += [log_std, adam.m, adam.v]
    norm = nn.RunningNorm(3)
    norm.update(mu.astype(np.float64))
    heads += [norm(a), norm(a.astype(np.float64)), norm.mean, norm.inv_std]
    assert {h.dtype for h in heads} == {np.dtype(np.float32)}


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_mlp_matches_torch(rng, name):
    torch = pytest.importorskip("torch")
    mlp = nn.MLP(SIZES, name, rng, dtype=np.float64)
    mlp.theta += 0.1 * rng.standard_normal(mlp.n_params)
    x, dy = rng.standard_normal((11, 5)), rng.standard_normal((11, 3))
    act = {"leaky_relu": torch.nn.LeakyReLU(nn.LEAKY_SLOPE), "tanh": torch.nn.Tanh()}[name]
    p = {k: torch.tensor(v, requires_grad=True) for k, v in mlp.params.items()}
    tx = torch.tensor(x, requires_grad=True)
    h = act(tx @ p["W0"] + p["b0"])
    ty = act(h @ p["W1"] + p["b1"]) @ p["W2"] + p["b2"]
    ty.backward(torch.tensor(dy))
    y, cache = mlp.forward(x)
    dx, dtheta = mlp.backward(dy, cache)
    np.testing.assert_allclose(y, ty.detach().numpy(), rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(dx, tx.grad.numpy(), rtol=1e-11, atol=1e-13)
    for key, grad in mlp.unflatten(dtheta).items():
        np.testing.assert_allclose(grad, p[key].grad.numpy(), rtol=1e-11, atol=1e-13)


# ------------------------------------------------------------------------------------------ Gaussian head


@pytest.fixture
def head(rng):
    """a (7, 4), mu (7, 4), log_std (4,)."""
    return rng.standard_normal((7, 4)), rng.standard_normal((7, 4)), 0.5 * rng.standard_normal(4)


def test_gaussian_logp(head):
    a, mu, log_std = head
    cov = np.diag(np.exp(2.0 * log_std))
    expected = [stats.multivariate_normal(m, cov).logpdf(row) for row, m in zip(a, mu, strict=True)]
    np.testing.assert_allclose(nn.gaussian_logp(a, mu, log_std), expected, rtol=1e-12)


def test_gaussian_entropy(head):
    log_std = head[2]
    expected = stats.multivariate_normal(np.zeros(4), np.diag(np.exp(2.0 * log_std))).entropy()
    assert nn.gaussian_entropy(log_std) == pytest.approx(expected, rel=1e-12)


def test_gaussian_kl(rng, head):
    mu0, mu1, log_std0 = head
    log_std1 = log_std0 + 0.3 * rng.standard_normal(4)
    # Full-matrix form: (tr(S1^-1 S0) + d^T S1^-1 d - A + log |S1| / |S0|) / 2
    s0, s1 = np.diag(np.exp(2.0 * log_std0)), np.diag(np.exp(2.0 * log_std1))
    log_det = np.linalg.slogdet(s1)[1] - np.linalg.slogdet(s0)[1]
    each = [0.5 * (np.trace(np.linalg.solve(s1, s0)) + d @ np.linalg.solve(s1, d) - 4 + log_det) for d in mu1 - mu0]
    kl = nn.gaussian_kl(mu0, log_std0, mu1, log_std1)
    assert kl == pytest.approx(np.mean(each), rel=1e-12)
    assert kl != pytest.approx(nn.gaussian_kl(mu1, log_std1, mu0, log_std0), rel=0.05)  # the direction matters
    # Monte Carlo of its definition, E_0[log p0 - log p1], for one observation.
    m0, m1 = mu0[:1].repeat(200_000, axis=0), mu1[:1].repeat(200_000, axis=0)
    a = m0 + np.exp(log_std0) * rng.standard_normal(m0.shape)
    sample = nn.gaussian_logp(a, m0, log_std0) - nn.gaussian_logp(a, m1, log_std1)
    error = 5.0 * sample.std() / np.sqrt(sample.size)
    assert nn.gaussian_kl(m0[:1], log_std0, m1[:1], log_std1) == pytest.approx(sample.mean(), abs=error)


def test_gaussian_kl_of_close_policies_is_exact(head):
    _, mu, log_std = head
    assert nn.gaussian_kl(mu, log_std, mu, log_std) == 0.0
    assert nn.gaussian_kl(mu, log_std, mu, log_std + 1e-8) == pytest.approx(4e-16, rel=1e-6, abs=0)  # A d^2


def test_value_loss(rng):
    for shape in ((8,), (8, 1)):
        v, target = rng.standard_normal(shape), rng.standard_normal(shape)
        loss, _ = nn.value_loss(v, target)
        assert loss == pytest.approx(sum((a - b) ** 2 for a, b in zip(v.flat, target.flat, strict=True)) / 16)


# -------------------------------------------------------------------------------------------------- Adam


def test_adam_matches_scalar_loop(rng):
    theta, lr, beta1, beta2, eps = rng.standard_normal(5), 0.01, 0.8, 0.95, 1e-3
    adam = nn.Adam(5, lr, (beta1, beta2), eps, dtype=np.float64)
    slow, m, v = theta.tolist(), [0.0] * 5, [0.0] * 5
    for t in range(1, 31):
        grad = rng.standard_normal(5)
        kept = grad.copy()
        adam.step(theta, grad)
        assert np.array_equal(grad, kept)
        for i in range(5):  # Algorithm 1, line by line
            m[i] = beta1 * m[i] + (1 - beta1) * grad[i]
            v[i] = beta2 * v[i] + (1 - beta2) * grad[i] ** 2
            m_hat, v_hat = m[i] / (1 - beta1**t), v[i] / (1 - beta2**t)
            slow[i] -= lr * m_hat / (v_hat**0.5 + eps)
        np.testing.assert_allclose(theta, slow, rtol=1e-12)


def test_adam_first_step_is_lr(rng):
    """Bias correction: the first step has size lr whatever the gradient's scale."""
    theta = np.zeros(3)
    nn.Adam(3, lr=0.1, dtype=np.float64).step(theta, np.array([1e-3, -5.0, 1e4]))
    np.testing.assert_allclose(theta, [-0.1, 0.1, -0.1], rtol=1e-4)


def test_adam_matches_torch(rng):
    torch = pytest.importorskip("torch")
    theta = rng.standard_normal(50)
    weights = torch.tensor(theta, requires_grad=True)
    adam = nn.Adam(50, 3e-3, (0.85, 0.99), 1e-5, dtype=np.float64)
    theirs = torch.optim.Adam([weights], lr=3e-3, betas=(0.85, 0.99), eps=1e-5)
    for _ in range(40):
        grad = rng.standard_normal(50)
        weights.grad = torch.tensor(grad)
        theirs.step()
        adam.step(theta, grad)
    np.testing.assert_allclose(theta, weights.detach().numpy(), rtol=1e-11)


def through_file(path, state):
    """A state written to and read from a checkpoint."""
    np.savez(path, **state)
    with np.load(path) as archive:
        return dict(archive)


def test_adam_resume(rng, tmp_path):
    grads = rng.standard_normal((20, 9), dtype=np.float32)
    theta, adam = np.ones(9, np.float32), nn.Adam(9, 0.01)
    for grad in grads[:10]:
        adam.step(theta, grad)
    other_theta, other = theta.copy(), nn.Adam(9, 0.01)
    other.load_state(through_file(tmp_path / "adam.npz", adam.state()))
    for grad in grads[10:]:
        adam.step(theta, grad)
        other.step(other_theta, grad)
    assert np.array_equal(theta, other_theta)
    for key, value in adam.state().items():
        assert np.array_equal(value, other.state()[key]) and value.dtype == other.state()[key].dtype
    snapshot = adam.state()
    adam.step(theta, grads[0])
    assert not np.array_equal(snapshot["m"], adam.m)  # a copy, not a view


def test_clip_grad_norm(rng):
    grad = rng.standard_normal(1000).astype(np.float32)
    norm, direction = np.linalg.norm(grad.astype(np.float64)), grad / np.linalg.norm(grad)
    kept = grad.copy()
    assert nn.clip_grad_norm(grad, 1e3) == pytest.approx(norm)
    assert np.array_equal(grad, kept)
    assert nn.clip_grad_norm(grad, 0.5) == pytest.approx(norm)
    assert grad.dtype == np.float32
    np.testing.assert_allclose(grad, 0.5 * direction, rtol=1e-5)
    assert nn.clip_grad_norm(np.zeros(3), 1.0) == 0.0
    assert nn.clip_grad_norm(np.full(4, 1e25, np.float32), 1.0) == pytest.approx(2e25)  # no float32 overflow
    grad[[7, 9]] = np.inf, np.nan
    with pytest.raises(ValueError, match=r"2 non-finite of 1000 entries, first at \[7\]"):
        nn.clip_grad_norm(grad, 1.0)
    with pytest.raises(ValueError, match="max_norm is 0"):
        nn.clip_grad_norm(grad, 0)


def test_adam_minimises_a_regression(rng):
    """Layers, loss and optimiser together fit a function no linear model can."""
    x = rng.uniform(-1, 1, (256, 2)).astype(np.float32)
    target = np.prod(x, axis=1, keepdims=True)
    mlp = nn.MLP((2, 32, 1), "tanh", rng)
    adam = nn.Adam(mlp.n_params, 0.01)
    losses = []
    for _ in range(400):
        y, cache = mlp.forward(x)
        loss, dy = nn.value_loss(y, target)
        _, grad = mlp.backward(dy, cache, want_dx=False)
        nn.clip_grad_norm(grad, 1.0)
        adam.step(mlp.theta, grad)
        losses.append(loss)
    assert losses[-1] < 0.02 * 0.5 * np.var(target)


# -------------------------------------------------------------------------------------------- RunningNorm


def test_running_norm_matches_numpy(rng):
    norm, batches = nn.RunningNorm(4), []
    offset, scale = np.array([0.0, 5.0, -300.0, 1e4]), np.array([1.0, 1e-2, 20.0, 1.0])
    for shape in ((1, 4), (50, 4), (3, 7, 4), (200, 4)):
        batches.append(offset + scale * rng.standard_normal(shape))
        norm.update(batches[-1])
        rows = np.concatenate([b.reshape(-1, 4) for b in batches])
        assert norm.count == len(rows)
        np.testing.assert_allclose(norm.mean64, np.mean(rows, axis=0), rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(norm.var, np.var(rows, axis=0), rtol=1e-9)


def test_running_norm_output(rng):
    norm = nn.RunningNorm(3)
    x = rng.standard_normal((2, 6, 3)).astype(np.float32)
    assert np.array_equal(norm(20.0 * x), np.clip(20.0 * x, -10, 10))  # before any update
    rows = 3.0 + 2.0 * rng.standard_normal((500, 3))
    norm.update(rows)
    expected = np.clip((x - rows.mean(axis=0)) / np.sqrt(rows.var(axis=0) + 1e-8), -10, 10)
    np.testing.assert_allclose(norm(x), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(norm(x.astype(np.float64)), expected, rtol=1e-5, atol=1e-6)
    assert norm(np.array([1e6, -1e6, 3.0])).tolist()[:2] == [10.0, -10.0]
    out = np.empty_like(x)
    assert norm.normalise(x, out=out) is out and np.array_equal(out, norm(x))
    want = norm(x)
    assert np.array_equal(norm.normalise(x, out=x), want)  # in place
    constant = nn.RunningNorm(1)
    constant.update(np.full((10, 1), 1.37))
    assert constant(np.full((1, 1), 1.37))[0, 0] == pytest.approx(0.0, abs=1e-2)


def test_running_norm_frozen(rng):
    norm = nn.RunningNorm(2)
    norm.update(rng.standard_normal((10, 2)))
    before, norm.frozen = norm.state(), True
    norm.update(rng.standard_normal((10, 2)) + 5.0)
    assert all(np.array_equal(value, norm.state()[key]) for key, value in before.items())
    norm.frozen = False
    norm.update(rng.standard_normal((10, 2)))
    assert norm.count == 20


def test_running_norm_resume(rng, tmp_path):
    norm, x = nn.RunningNorm(5), rng.standard_normal((4, 5))
    norm.update(rng.standard_normal((33, 5)))
    other = nn.RunningNorm(5)
    other.load_state(through_file(tmp_path / "norm.npz", norm.state()))
    assert np.array_equal(norm(x), other(x))
    more = rng.standard_normal((21, 5))
    norm.update(more)
    other.update(more)
    assert np.array_equal(norm(x), other(x))
    assert all(np.array_equal(value, other.state()[key]) for key, value in norm.state().items())


def test_running_norm_rejects_non_finite(rng):
    norm, x = nn.RunningNorm(3), rng.standard_normal((4, 3))
    x[2, 1], x[3, 0] = np.nan, np.inf
    for call in (norm, norm.update):
        with pytest.raises(ValueError, match=r"2 non-finite of 12 observation entries, first nan at \(2, 1\)"):
            call(x)
    assert norm.count == 0


# ---------------------------------------------------------------------------------------- error messages


def test_errors(rng):
    mlp = nn.MLP(SIZES, "tanh", rng)
    y, cache = mlp.forward(np.zeros((4, 5)))
    a, log_std = np.zeros((4, 3)), np.zeros(3)
    adam, norm = nn.Adam(3), nn.RunningNorm(3)
    theta = np.zeros(3, np.float32)
    for match, call in {
        r"x has shape \(4, 6\), expected \(B, 5\)": lambda: mlp(np.zeros((4, 6))),
        r"x has shape \(5,\), expected \(B, 5\)": lambda: mlp(np.zeros(5)),
        r"dy has shape \(3, 3\), expected \(4, 3\)": lambda: mlp.backward(np.zeros((3, 3)), cache),
        r"b has shape \(2,\), expected \(3,\)": lambda: nn.linear_forward(a, np.zeros((3, 3)), np.zeros(2)),
        r"dy has shape \(1, 3\), expected \(4, 3\)": lambda: nn.tanh_backward(np.zeros((1, 3)), a),
        r"dy has shape \(4,\), expected \(4, 3\)": lambda: nn.leaky_relu_backward(np.zeros(4), a),
        r"parameter vector has shape \(2,\), expected \(111,\)": lambda: mlp.unflatten(np.zeros(2)),
        r"sizes is \(5,\), expected at least two": lambda: nn.MLP((5,), "tanh", rng),
        r"sizes is \(5, 0, 2\)": lambda: nn.MLP((5, 0, 2), "tanh", rng),
        r"unknown activation 'elu', expected one of \['leaky_relu', 'tanh'\]": lambda: nn.MLP((5, 2), "elu", rng),
        r"rng is 3, expected a np.random.Generator": lambda: nn.MLP((5, 2), "tanh", 3),
        r"a has shape \(4,\), expected \(4, 3\)": lambda: nn.gaussian_logp(np.zeros(4), a, log_std),
        r"log_std has shape \(4, 3\), expected \(3,\)": lambda: nn.gaussian_logp(a, a, a),
        r"dlogp has shape \(4, 1\), expected \(4,\)": lambda: nn.gaussian_logp_backward(a[:, :1], a, a, log_std),
        r"log_std0 has shape \(2,\), expected \(3,\)": lambda: nn.gaussian_kl(a, np.zeros(2), a, log_std),
        r"log_std has shape \(4, 3\), expected \(A,\)": lambda: nn.gaussian_entropy(a),
        r"target has shape \(4,\), expected \(4, 1\)": lambda: nn.value_loss(np.zeros((4, 1)), np.zeros(4)),
        r"v has shape \(0,\)": lambda: nn.value_loss(np.zeros(0), np.zeros(0)),
        r"grad has shape \(2,\), expected \(3,\)": lambda: adam.step(theta, np.zeros(2)),
        r"theta is float64, expected float32": lambda: adam.step(np.zeros(3), np.zeros(3)),
        r"betas \(0.9, 1.0\)": lambda: nn.Adam(3, betas=(0.9, 1.0)),
        r"Adam state has keys \['m'\], expected \['m', 't', 'v'\]": lambda: adam.load_state({"m": theta}),
        r"RunningNorm state 'mean' has shape \(2,\), expected \(3,\)": lambda: norm.load_state(
            nn.RunningNorm(2).state()
        ),
        r"observations have shape \(4, 2\), expected \(..., 3\)": lambda: norm(np.zeros((4, 2))),
        r"observations have shape \(0, 3\), expected at least one row": lambda: norm.update(np.zeros((0, 3))),
        r"out has shape \(3, 3\), expected \(4, 3\)": lambda: norm.normalise(a, out=np.zeros((3, 3), np.float32)),
    }.items():
        with pytest.raises(ValueError, match=match):
            call()


def test_main(capsys):
    nn.main(["--sizes", "6", "5", "2", "--rows", "16", "--repeats", "2"])
    out = capsys.readouterr().out
    assert "gradient check" in out and "forward + backward" in out

"""Every forward/backward pair of nn.py, ppo.py, drop/vae.py and skeletal/ against Richardson differences: one table.

A row makes (arrays, forward, backward) from random numbers, float64:

    arrays            name -> inputs and parameters, all that has a gradient
    forward(**arrays) -> the output, or several
    backward(*ups, **arrays) -> name -> gradient, ups being random upstream gradients, one an output

A loss computes its gradient itself: its row multiplies it with the upstream number.
"""

import copy
import inspect

import numpy as np
import pytest
from test_drop_vae import frames, statistics
from test_ppo import policy_batch, surrogate_batch

import nn
import ppo
from drop import vae
from skeletal import layers, net

WHOLE = 200  # entries of an array that are checked one by one; longer ones along random directions, as strong
DIRECTIONS, STEP = 4, 1e-5  # a smaller step than nn's, because large networks have many kinks
SMALL = (-1, 0, 1, 2, 0, 4, 5, 6)  # a skeleton of two chains, of three and of four bones
ROWS = {}


def pair(name, **settings):
    """A row of the table; `name` is what it checks, as module.function or module.Class."""

    def add(make):
        plain = [str(v) for v in settings.values() if not callable(v)]
        label = f"{name}[{','.join(plain)}]" if plain else name
        ROWS[label] = lambda rng: make(rng, **settings)
        return make

    return add


def normals(rng, **shapes):
    return {name: rng.standard_normal(shape) for name, shape in shapes.items()}


def loss_of(loss, arrays):
    """A row of a function that returns its value, then a gradient an array, then what else."""
    return arrays, lambda **a: loss(**a)[0], lambda up, **a: {k: up * d for k, d in zip(a, loss(**a)[1:])}


def outputs_of(y):
    return y if isinstance(y, tuple) else (y,)


def check(row, spoil=None):
    """Each gradient of a row to 1e-6; `spoil` changes the gradients before."""
    rng = np.random.default_rng(20230)
    arrays, forward, backward = row(rng)
    ups = [rng.standard_normal(np.shape(y)) for y in outputs_of(forward(**arrays))]
    kept = {name: a.copy() for name, a in arrays.items()} | {f"up{k}": np.copy(u) for k, u in enumerate(ups)}
    grads = backward(*ups, **arrays)
    assert all(np.array_equal(kept[name], a) for name, a in arrays.items()), "an argument was changed"
    assert all(np.array_equal(kept[f"up{k}"], u) for k, u in enumerate(ups)), "an upstream gradient was changed"
    assert set(grads) == set(arrays) and all(g.any() for g in grads.values())
    for name in arrays if spoil is None else [spoil(rng, grads)]:
        at, g = arrays[name], grads[name]
        assert g.shape == at.shape

        def f(v, name=name):
            return sum(np.sum(u * y) for u, y in zip(ups, outputs_of(forward(**arrays | {name: v})), strict=True))

        if at.size <= WHOLE:
            nn.check_gradient(f, at, g)
        else:
            u = rng.standard_normal((DIRECTIONS, at.size))
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            line = lambda c, at=at, u=u, f=f: f(at + (c @ u).reshape(at.shape))  # noqa: E731
            nn.check_gradient(line, np.zeros(DIRECTIONS), u @ g.ravel(), eps=STEP)


# ------------------------------------------------------------------------------------ nn.py


@pair("nn.linear")
def linear(rng):
    def backward(dy, x, W, b):
        dx, (dW, db) = nn.linear_backward(dy, nn.linear_forward(x, W, b)[1])
        return dict(x=dx, W=dW, b=db)

    return normals(rng, x=(6, 4), W=(4, 3), b=(3,)), lambda x, W, b: nn.linear_forward(x, W, b)[0], backward


@pair("nn.leaky_relu", forward=nn.leaky_relu_forward, back=nn.leaky_relu_backward)
@pair("nn.tanh", forward=nn.tanh_forward, back=nn.tanh_backward)
@pair("layers.leaky", forward=layers.leaky_forward, back=layers.leaky_backward)
def activation(rng, forward, back):
    x = rng.standard_normal((6, 5, 2))
    x += 0.05 * np.sign(x)  # away from the kink
    return {"x": x}, lambda x: forward(x)[0], lambda dy, x: {"x": back(dy, forward(x)[1])[0]}


@pair("nn.MLP", sizes=(5, 7, 6, 3), activation="leaky_relu")
@pair("nn.MLP", sizes=(5, 7, 6, 3), activation="tanh")
@pair("nn.MLP", sizes=(4, 2), activation="tanh")
def mlp(rng, sizes, activation):
    template = nn.MLP(sizes, activation, rng, dtype=np.float64)

    def at(theta):
        probe = copy.copy(template)
        probe.theta = theta
        return probe

    def backward(dy, x, theta):
        dx, dtheta = at(theta).backward(dy, at(theta).forward(x)[1])
        return dict(x=dx, theta=dtheta)

    theta = template.theta + 0.1 * rng.standard_normal(template.n_params)  # biases away from zero
    x = rng.standard_normal((4, sizes[0]))
    hidden = [act for _, act in at(theta).forward(x)[1] if act is not None and activation == "leaky_relu"]
    assert all(np.abs(np.where(h > 0, h, h / nn.LEAKY_SLOPE)).min() > 0.002 for h in hidden)  # no kink within a step
    return {"x": x, "theta": theta}, lambda x, theta: at(theta)(x), backward


@pair("nn.gaussian_logp")
def gaussian_logp(rng):
    a = rng.standard_normal((7, 4))

    def backward(dlogp, mu, log_std):
        return dict(zip(("mu", "log_std"), nn.gaussian_logp_backward(dlogp, a, mu, log_std)))

    return normals(rng, mu=(7, 4), log_std=(4,)), lambda mu, log_std: nn.gaussian_logp(a, mu, log_std), backward


@pair("nn.gaussian_entropy")
def gaussian_entropy(rng):
    def backward(dH, log_std):
        return {"log_std": nn.gaussian_entropy_backward(dH, log_std)}

    return normals(rng, log_std=(4,)), lambda log_std: nn.gaussian_entropy(log_std), backward


@pair("nn.value_loss", shape=(8,))
@pair("nn.value_loss", shape=(8, 1))
def value_loss(rng, shape):
    target = rng.standard_normal(shape)
    return loss_of(lambda v: nn.value_loss(v, target), normals(rng, v=shape))


# ------------------------------------------------------------------------------------ ppo.py


@pair("ppo.clipped_surrogate")
def clipped_surrogate(rng):
    logp, logp_old, adv = surrogate_batch(rng)  # both sides of both limits, away from the kinks
    return loss_of(lambda logp: ppo.clipped_surrogate(logp, logp_old, adv, 0.2), {"logp": logp})


@pair("ppo.policy_loss")
def policy_loss(rng):
    policy, x, action, logp_old, adv, _ = policy_batch()

    def loss(theta):
        policy.theta_pi[:] = theta  # the network, then log σ
        return ppo.policy_loss(policy, x[:, :5], action, logp_old, adv, 0.2)

    theta = policy.theta_pi.copy()
    assert np.all(loss(theta)[1][-3:] != 0)
    return loss_of(loss, {"theta": theta})


@pair("ppo.critic_loss")
def critic_loss(rng):
    policy, x, *_, target = policy_batch()

    def loss(theta):
        policy.critic.theta[:] = theta
        return ppo.critic_loss(policy, x, target)

    theta = policy.critic.theta.copy()
    return loss_of(loss, {"theta": theta})


# ------------------------------------------------------------------------------------ drop/vae.py


@pair("vae.gram_schmidt")
def gram_schmidt(rng):
    def backward(dC, columns):
        return {"columns": vae.gram_schmidt_backward(dC, vae.gram_schmidt_forward(columns)[1])}

    return normals(rng, columns=(5, 2, 3)), lambda columns: vae.gram_schmidt_forward(columns)[0], backward


@pair("vae.kinematics")
def kinematics(rng):
    def backward(dx, root, C):
        return dict(zip(("root", "C"), vae.kinematics_backward(dx)))

    return normals(rng, root=(2, 3), C=(2, vae.N, 3, 3)), vae.kinematics_forward, backward


@pair("vae.bounded")
def bounded(rng):
    def backward(dlog_std, raw):
        return {"raw": vae.bounded_backward(dlog_std, vae.bounded_forward(raw)[1])}

    return {"raw": 4 * rng.standard_normal((3, 4))}, lambda raw: vae.bounded_forward(raw)[0], backward


@pair("vae.kl")
def kl(rng):
    names = ("mu0", "log_std0", "mu1", "log_std1")

    def backward(up, **four):
        return {name: up[:, None] * d for name, d in zip(names, vae.kl_forward(**four)[1])}

    arrays = {name: 0.5 * rng.standard_normal((2, 3)) for name in names}
    return arrays, lambda **four: vae.kl_forward(**four)[0], backward


@pair("vae.LatentMLP")
def latent_mlp(rng):
    own = vae.LatentMLP((4, 6, 5, 3), 2, rng, dtype=np.float64)

    def forward(x, z, theta):
        own.theta[:] = theta
        return own(x, z)

    def backward(dy, x, z, theta):
        own.theta[:] = theta
        return dict(zip(("x", "z", "theta"), own.backward(dy, own.forward(x, z)[1])))

    theta = own.theta + 0.1 * rng.standard_normal(own.n_params)
    return normals(rng, x=(3, 4), z=(3, 2)) | {"theta": theta}, forward, backward


def elbo(nets, loss):
    """A row of a negative ELBO's two parts by the weights of its networks; the KL's is 0.7."""

    def forward(**thetas):
        for name, theta in thetas.items():
            nets[name].theta[:] = theta
        parts = loss()[0]
        return parts["reconstruction"] + parts.get("contact", 0.0) + 0.7 * parts["kl"]

    def backward(up, **thetas):
        forward(**thetas)
        return {name: up * g for name, g in loss()[1].items()}

    return {name: n.theta.copy() for name, n in nets.items()}, forward, backward


@pair("vae.MotionVAE")
def motion_vae(rng):
    own = vae.MotionVAE(3, 10, statistics(rng)[0], rng, np.float64)
    x, columns, v, _ = vae.canonical(*frames(rng))
    state, eps = vae.state_vector(x, columns, v), rng.standard_normal((3, 3))
    target = x + 0.002 * rng.standard_normal(x.shape), columns + 0.002 * rng.standard_normal(columns.shape)
    contacts = (rng.random((3, vae.CONTACTS)) < 0.5).astype(float)
    return elbo(own.nets, lambda: own.loss(state, x[:, 0, 2], columns, *target, contacts, eps, 0.7))


@pair("vae.PoseVAE")
def pose_vae(rng):
    own = vae.PoseVAE(3, 8, statistics(rng)[1], rng, np.float64)
    x, columns, _ = frames(rng)
    C, _ = vae.gram_schmidt_forward(columns)
    local, eps = np.matmul(x - x[:, :1], np.swapaxes(C[:, 0], -1, -2)), rng.standard_normal((3, 3))
    return elbo(own.nets, lambda: own.loss(vae.pose_columns(C), local, eps, 0.7))


# ------------------------------------------------------------------------------------ skeletal/layers.py


def cut(vector, shapes):
    """The pieces of a flat vector."""
    ends = np.cumsum([int(np.prod(s)) for s in shapes])
    return [part.reshape(s) for part, s in zip(np.split(vector, ends[:-1]), shapes)]


def flat(arrays):
    return np.concatenate([a.ravel() for a in arrays])


@pair("layers.conv", stride=1, mean=False)
@pair("layers.conv", stride=2, mean=True)
@pair("layers.conv", stride=2, mean=False)
def conv(rng, stride, mean):
    choices = layers.Choices(neighbour_mean=mean, static_scale=0.3)
    near = layers.Graph(SMALL).neighbours(1)
    plan = layers.plan_conv(near, [3] + [2] * 7, [1, 2, 3, 1, 1, 2, 2, 1], 2, 5, stride, choices)
    W_shapes, V_shapes, b_shape = plan.shapes()

    def run(x, s, W, V, b):
        return layers.conv_forward(x, s, (cut(W, W_shapes), cut(V, V_shapes), b), plan)

    def backward(dy, **arrays):
        (dx, ds), (dW, dV, db) = layers.conv_backward(dy, run(**arrays)[1])
        return dict(x=dx, s=ds, W=flat(dW), V=flat(dV), b=db)

    sizes = {k: sum(int(np.prod(s)) for s in shapes) for k, shapes in (("W", W_shapes), ("V", V_shapes))}
    return normals(rng, x=(17, 8, 3), s=(16, 3), b=b_shape, **sizes), lambda **a: run(**a)[0], backward


@pair("layers.pool", how="mean")
@pair("layers.pool", how="max")
def pool(rng, how):
    _, groups = layers.Graph(SMALL).pool()

    def backward(dy, x):
        return {"x": layers.pool_backward(dy, layers.pool_forward(x, groups, how)[1])[0]}

    return normals(rng, x=(16, 3, 2)), lambda x: layers.pool_forward(x, groups, how)[0], backward


@pair("layers.unpool")
def unpool(rng):
    _, groups = layers.Graph(SMALL).pool()

    def backward(dy, x):
        return {"x": layers.unpool_backward(dy, layers.unpool_forward(x, groups)[1])[0]}

    return normals(rng, x=(2 * len(groups), 3, 2)), lambda x: layers.unpool_forward(x, groups)[0], backward


@pair("layers.upsample")
def upsample(rng):
    def backward(dy, x):
        return {"x": layers.upsample_backward(dy, layers.upsample_forward(x)[1])[0]}

    return normals(rng, x=(3, 4, 2)), lambda x: layers.upsample_forward(x)[0], backward


@pair("layers.batch_norm")
def batch_norm(rng):
    def run(x, gamma, beta):
        return layers.batch_norm_forward(x, (gamma, beta))

    def backward(dy, **arrays):
        dx, (dgamma, dbeta) = layers.batch_norm_backward(dy, run(**arrays)[1])
        return dict(x=dx, gamma=dgamma, beta=dbeta)

    return normals(rng, x=(3, 4, 2), gamma=(3,), beta=(3,)), lambda **a: run(**a)[0], backward


@pair("layers.fk", outputs=(0, 1))
@pair("layers.fk", outputs=(0,))
@pair("layers.fk", outputs=(1,))
def fk(rng, outputs):
    """Bones and places, or one of them; through the quaternions' normalisation: they are far from unit length."""
    offsets, turn = rng.standard_normal((8, 3, 2)), np.exp(1j * rng.uniform(-3, 3, (5, 2)))

    def run(x):
        return layers.fk_forward(x, offsets, SMALL, turn)

    def backward(*ups, x):
        both = [None, None]
        for k, up in zip(outputs, ups):
            both[k] = up
        return {"x": layers.fk_backward(*both, run(x)[2])}

    return normals(rng, x=(7 + 4 * 7, 5, 2)), lambda x: tuple(run(x)[k] for k in outputs), backward


# ------------------------------------------------------------------------------------ skeletal/net.py


GENERATORS = {"ours": {}, "max": {"pool": "max"}, "plain": {"plain": True}}
GENERATORS["paper"] = {"choices": layers.CHOICES["paper"]}


@pair("net.Generator", kind="ours")
@pair("net.Generator", kind="max")
@pair("net.Generator", kind="plain")
@pair("net.Generator", kind="paper")
def generator(rng, kind):
    """Static branch, encoder and decoder together: latent and result, by the motion and all weights."""
    own = net.Generator(SMALL, rng, channels=(2, 3), dtype=np.float64, **GENERATORS[kind])
    s = rng.standard_normal((3 * len(SMALL), 2))

    def run(x, theta):
        own.theta[:] = theta
        f, static = own.static_forward(s)
        z, encoded = own.encode_forward(x, f)
        y, decoded = own.decode_forward(z, f)
        assert y.shape == x.shape
        return (z, y), (static, encoded, decoded)

    def backward(dz, dy, x, theta):
        static, encoded, decoded = run(x, theta)[1]
        own.grad[:] = 0.0
        d, df2 = own.decode_backward(dy, decoded)
        dx, df1 = own.encode_backward(dz + d, encoded)
        own.static_backward(df1, df2, static)
        return dict(x=dx, theta=own.grad.copy())

    theta = own.theta + 0.1 * rng.standard_normal(own.n_params)
    return normals(rng, x=(own.n_x, 16, 2)) | {"theta": theta}, lambda x, theta: run(x, theta)[0], backward


@pair("net.Critic")
def critic(rng):
    own, s = net.Critic(SMALL, rng, channels=(2, 3), dtype=np.float64), rng.standard_normal((24, 3))

    def run(bones, theta):
        own.theta[:] = theta
        return own.forward(bones, s)

    def backward(dscore, bones, theta):
        cache = run(bones, theta)[1]
        own.grad[:] = 0.0
        return dict(bones=own.backward(dscore, cache), theta=own.grad.copy())

    theta = own.theta + 0.1 * rng.standard_normal(own.n_params)
    return normals(rng, bones=(24, 16, 3)) | {"theta": theta}, lambda **a: run(**a)[0], backward


@pair("net.mse")
def mse(rng):
    b = rng.standard_normal((4, 3, 2))
    return loss_of(lambda a: net.mse(a, b), normals(rng, a=(4, 3, 2)))


@pair("net.rec_loss")
def rec_loss(rng):
    x, true = rng.standard_normal((4, 3, 2)), rng.standard_normal((5, 3, 3, 2))
    return loss_of(lambda y, w: net.rec_loss(y, x, w, true, 7.0, 3.0), normals(rng, y=(4, 3, 2), w=(5, 3, 3, 2)))


@pair("net.ltc_loss")
def ltc_loss(rng):
    return loss_of(lambda z_fake, z: net.ltc_loss(z_fake, z), normals(rng, z_fake=(4, 3, 2), z=(4, 3, 2)))


@pair("net.lsgan", real=1.0)
@pair("net.lsgan", real=0.0)
def lsgan(rng, real):
    return loss_of(lambda score: net.lsgan(score, real), normals(rng, score=(4, 3, 2)))


@pair("net.ee_loss")
def ee_loss(rng):
    source, reach = rng.standard_normal((5, 3, 3, 2)), rng.uniform(1, 2, (2, 2, 2))
    return loss_of(lambda w: net.ee_loss(source, w, [2, 4], [1, 5], *reach), normals(rng, w=(6, 3, 3, 2)))


# ------------------------------------------------------------------------------------ the tests


@pytest.mark.parametrize("name", ROWS)
def test_backward(name):
    check(ROWS[name])


@pytest.mark.parametrize("name", ROWS)
def test_one_wrong_entry_is_found(name):
    """The harness itself: one entry off by a ten-thousandth of the largest."""

    def spoil(rng, grads):
        which = str(rng.choice(list(grads)))
        grads[which] = grads[which].copy()
        grads[which].flat[rng.integers(grads[which].size)] += 1e-4 * np.abs(grads[which]).max() + 1e-6
        return which

    with pytest.raises(AssertionError, match="entries differ"):
        check(ROWS[name], spoil)


def test_no_pair_is_missing():
    """Every X_backward, every class with a backward pass, and every loss of the four modules is in the table."""
    have = {name.partition("[")[0] for name in ROWS}
    wanted = {"ppo.policy_loss", "ppo.critic_loss", "ppo.clipped_surrogate"}
    for module in (nn, vae, layers, net):
        short = module.__name__.rpartition(".")[2]
        for name, thing in vars(module).items():
            if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
                continue
            if inspect.isclass(thing) and any("backward" in method for method in vars(thing)):
                wanted.add(f"{short}.{name}")
            if name.endswith(("_backward", "_loss")):
                wanted.add(f"{short}.{name.removesuffix('_backward')}")
    assert wanted <= have, sorted(wanted - have)

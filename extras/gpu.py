r"""Training on an NVIDIA GPU: the same environment and learner, thousands of characters at once  (extra `gpu`).

    python -m extras.train --gpu --character jesse --motion FOLDER --envs 8192 --minibatch 16384

    Trainer on NumPy ──► moved ──► every array on the GPU; `np` of the modules in SWAPPED is CuPy
    MuJoCo's threads ──► Worlds ──► MuJoCo Warp, one CUDA graph for a control step

Not one equation is written a second time: env.py, ppo.py and nn.py run as they stand.  The paper trained on a GPU; two
cores do some 7,000 control steps a second.  Physics is float32 here, and solved by Newton's method instead of PGS:
MuJoCo Warp has no PGS, and five iterations of that are as accurate.  A run ends as a run folder that --init,
extras/policies.py and play.py read; it is continued with --init, for the random numbers of the GPU are not stored.
"""

from __future__ import annotations

import importlib
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import mujoco
import numpy as np

import ppo
from plumbing.cli import UserError
from plumbing.runs import save_checkpoint

SWAPPED = ("env", "nn", "character", "human", "retarget", "policy", "ppo")  # and those of the curriculum
NEWTON_ITERATIONS, LINE_SEARCH = 10, 15  # ASSUMED: at most; a warm start usually needs 1 to 4
CONTACTS = 48  # most contacts of a character, an upper bound: soles have 8, a fallen body some 20


def _libraries(device):
    """warp, mujoco_warp and the array module of a device: CuPy of "cuda", NumPy of "cpu" (for tests)."""
    try:
        import mujoco_warp
        import warp
    except ImportError as e:
        raise UserError(f"--gpu needs {e.name}: pip install -e '.[gpu]'") from None
    warp.config.quiet = True
    if device == "cpu":
        return warp, mujoco_warp, np
    try:
        import cupy
    except ImportError:
        raise UserError("--gpu needs cupy: pip install -e '.[gpu]'") from None
    if not warp.is_cuda_available():
        raise UserError("--gpu: no NVIDIA GPU with its driver here; leave --gpu out to train on the processor")
    return warp, mujoco_warp, cupy


class Worlds:
    """N simulations of a model on the GPU: what `Env` needs of `mujoco.batch.Batch`.

    bind    : a field of all worlds as an array (N, ...) that shares memory with the simulation
    warning : nothing is counted here; `Env` finds states that are not finite by itself
    Test      tests/extras/test_gpu.py::test_worlds_are_mujoco
    """

    def __init__(self, model, n, device="cuda"):
        self.warp, self.mjw, self.xp = _libraries(device)
        self.device, self.n, self.graphs = device, n, {}
        options = model.opt.solver, model.opt.iterations, model.opt.ls_iterations
        model.opt.solver, model.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, NEWTON_ITERATIONS
        model.opt.ls_iterations = LINE_SEARCH
        with self.warp.ScopedDevice(device):
            self.model = self.mjw.put_model(model)
            self.model.opt.warn_overflow = 0  # a fallen body may need more iterations; it is about to be reset
            limits = int(model.jnt_limited.sum())
            self.data = self.mjw.make_data(model, nworld=n, nconmax=CONTACTS, njmax=4 * CONTACTS + limits)
        model.opt.solver, model.opt.iterations, model.opt.ls_iterations = options
        self.warning = self.xp.zeros((n, mujoco.mjtWarning.mjNWARNING, 2), int)

    def bind(self, name):
        a = getattr(self.data, name)
        a = a.numpy() if self.device == "cpu" else self.xp.asarray(a)
        return a.reshape(*a.shape[:2], 9) if name in ("xmat", "geom_xmat") else a

    def expand(self, name):
        return np.zeros(self.n, int)  # `Env` switches forces off while it refreshes; `forward` computes none

    def step(self, nstep=1):
        """nstep substeps of every world."""
        self._run(("step", nstep), lambda: [self.mjw.step(self.model, self.data) for _ in range(nstep)])

    def forward(self, ids=None, stage=None):
        """Positions and velocities of all bodies, of all worlds: to leave some out would save nothing."""
        parts = self.mjw.kinematics, self.mjw.com_pos, self.mjw.com_vel
        self._run("forward", lambda: [part(self.model, self.data) for part in parts])

    def _run(self, key, work):
        """Once to compile, then as a recorded CUDA graph: the launches of a hundred kernels cost one."""
        with self.warp.ScopedDevice(self.device):
            if self.device == "cpu":
                work()
            elif key not in self.graphs:
                work()
                with self.warp.ScopedCapture() as capture:
                    work()
                self.graphs[key] = capture.graph  # recorded, not run
            else:
                self.warp.capture_launch(self.graphs[key])


class Generator:
    """What env.py, extras/train.py and ppo.py draw, from CuPy."""

    def __init__(self, cupy, seed):
        self.cupy, self.own = cupy, cupy.random.default_rng(seed)

    def standard_normal(self, size, dtype=np.float64):
        return self.own.standard_normal(size, dtype=dtype)

    def random(self, size):
        return self.own.random(size)

    def integers(self, low, high=None, size=None):
        return self.own.integers(low, high, size)

    def uniform(self, low, high, size):
        return low + (high - low) * self.own.random(size)

    def choice(self, values, size):
        return values[self.own.integers(0, len(values), size)]

    def permutation(self, n):
        return self.cupy.argsort(self.own.random(n, dtype=np.float32))


class Trainer(ppo.Trainer):
    """`ppo.Trainer`, to be `moved`: its random numbers have their seeds already, its checkpoints are the policy alone.

    Test      tests/extras/test_gpu.py::test_checkpoint_is_a_policy"""

    GO_ON = "--init"

    def start(self):
        """First observation of all characters."""
        self.env.reset()
        if self.policy.norm.count == 0:
            self.policy.norm.update(self.env.full)

    def save(self, path, meta):
        """The policy: --init goes on from it."""
        own = dict(steps=self.steps, updates=self.updates, lr=self.adam_pi.lr, policy=self.policy.shape())
        save_checkpoint(path, fetched(self.policy.arrays()), meta | own)


def moved(trainer, device="cuda"):
    """Put a trainer's and its environment's arrays, simulations and random numbers on the GPU, in place.

    Raises    UserError: no GPU, or a package is missing
    Test      tests/extras/test_gpu.py::test_moved_trainer_sees_the_same
    """
    env = trainer.env
    worlds = Worlds(env.char.model, env.n, device)
    xp = worlds.xp
    if device != "cpu":
        # one stream for both libraries, or neither would wait for the other's results
        trainer.stream = xp.cuda.ExternalStream(worlds.warp.get_stream(device).cuda_stream)
        trainer.stream.use()
        trainer.rng, env.rng = (Generator(xp, [trainer.opt.seed, k]) for k in (11, 12))
    policy = trainer.policy
    # float64 of thousands of characters would cost as much as their physics
    single = env.char, env.ref, env, *env.parts.values()
    for part in (*single, policy.norm, trainer.adam_pi, trainer.adam_v, trainer):
        for name, value in vars(part).items():
            if isinstance(value, np.ndarray):
                to_single = value.dtype == np.float64 and any(part is s for s in single)
                setattr(part, name, xp.asarray(value, np.float32 if to_single else value.dtype))
    shapes = env.char.model
    env.char.model = SimpleNamespace(geom_type=xp.asarray(shapes.geom_type), geom_size=xp.asarray(shapes.geom_size))
    policy.theta_pi, policy.critic.theta = xp.asarray(policy.theta_pi), xp.asarray(policy.critic.theta)
    policy.actor.theta = policy.theta_pi[: policy.actor.n_params]  # views again
    policy.log_std = policy.theta_pi[policy.actor.n_params :]
    env.attach(worlds)
    trainer.two = False  # the GPU has streams of its own
    return trainer


@contextmanager
def arrays_of(trainer):
    """CuPy in NumPy's place in the modules of the loop, while it runs.

    Test      tests/extras/test_gpu.py::test_swap_ends"""
    xp = trainer.env.batch.xp
    names = {*SWAPPED, *(type(part).__module__ for part in trainer.env.parts.values())}  # also where it is the program
    modules = [sys.modules.get(name) or importlib.import_module(name) for name in names]
    before = [m.np for m in modules]
    for m in modules:
        m.np = xp
    try:
        yield
    finally:
        for m, old in zip(modules, before, strict=True):
            m.np = old


def fetched(arrays):
    """A checkpoint's arrays back in the computer's memory."""
    return {k: v.get() if hasattr(v, "get") else v for k, v in arrays.items()}

r"""Training past one machine: the characters are simulated by many processes, on Ray  (extra `cluster`; ours).

    python -m extras.cluster --character jesse --motion FOLDER --workers 16 --out runs/a                 this machine
    python -m extras.cluster --character jesse --motion FOLDER --workers 64 --address auto --out runs/a  a Ray cluster
    python -m extras.cluster --resume --out runs/a --steps 1e9                                           go on exactly

                 weights, random state ──►  Worker 0: Env of N/W characters, ppo.Trainer.collect  ──┐
    Trainer  ──► weights, random state ──►  Worker 1: …                                             ├──►  Trainer.update
    (driver)     once an update             …                                  samples, final state ┘     by ppo.py's

Not one equation is written a second time.  A worker is `ppo.Trainer` without its update, the driver is `ppo.Trainer`
whose samples come from elsewhere.  The recipe is extras/train.py's; the motions are read once, by the driver, and the
workers of a machine share one copy of them.

With each rollout a worker also returns the state of its simulations.  So the driver can write the same checkpoint as
ppo.py, and a worker that dies begins again on any machine where its last rollout ended: only its unfinished rollout is
simulated twice, and the policy is the same to the bit.
"""

from __future__ import annotations

import hashlib
import os
import socket
import time
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import ppo
from env import Env
from extras import train
from nn import RunningNorm
from plumbing.cli import COUNT, UserError, arg, run_main
from plumbing.runs import Metrics, rng_from_state, rng_state
from plumbing.training import read_options
from policy import Policy, widths

try:
    import ray
except ImportError:  # without the extra `cluster`: main says so
    ray = None

SENT = ("x", "action", "mu", "logp", "reward", "old_value", "next_value", "terminated", "truncated")  # (T, n, …)
MADE_OF = ("char", "ref", "horizon", "substeps", "asymmetric", "starts", "root_limit", "disturbance")  # an Env
LINES = "workers.csv"  # of the run folder: a line a worker and update
PATIENCE = 10.0  # s for a cluster's head to answer
ROOT = Path(__file__).resolve().parent.parent
MADE_BY = [*sorted(ROOT.glob("*.py")), ROOT / "extras/train.py", ROOT / "extras/cluster.py"]  # a rollout
CODE = hashlib.sha256(b"".join(path.read_bytes() for path in MADE_BY)).hexdigest()  # what this machine has of it
TRIES = 5  # a rollout whose worker is lost so often is given up
OURS = ("RAY_USAGE_STATS_ENABLED", "RAY_worker_niceness")  # 0: nothing is sent out; workers as important as the driver
ONE_THREAD = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")}  # of a worker's BLAS


@dataclass
class Options(train.Options):
    """extras/train.py's options, and where the workers are."""

    BY = "extras.cluster"

    threads: int = arg(1, "physics threads of each worker", check=COUNT)
    workers: int = arg(2, "processes that simulate; --envs characters are dealt out evenly", check=COUNT)
    address: str | None = arg(None, "of a Ray cluster, auto or HOST:PORT; without it one is started on this machine")


# ------------------------------------------------------------------------------------ a worker


def made_of(env: Env) -> dict:
    """What an environment is made of, without its characters: `env_of` makes another of it elsewhere.

    Test      tests/extras/test_cluster.py::test_one_worker_is_ppo"""
    return {name: getattr(env, name) for name in MADE_OF}


def env_of(parts: dict, n: int, threads: int) -> Env:
    """An environment of n characters out of what `made_of` took from another.

    Arrays that Ray hands out are shared by all workers of a machine, and cannot be written to: what an environment
    writes to becomes its own.
    Test      tests/extras/test_cluster.py::test_one_worker_is_ppo"""
    starts, disturbance = parts["starts"], parts["disturbance"]
    for name, value in starts.state().items():
        setattr(starts, name, value)  # `state` returned a copy
    if disturbance:
        disturbance.error, disturbance.pull = np.zeros((n, *disturbance.error.shape[1:])), np.zeros(n)
    return Env(n=n, threads=threads, **parts)


class Worker:
    """The characters of one process.  Nothing of it is lost with it: every answer holds the state that it ended in.

    Test      tests/extras/test_cluster.py::test_one_worker_is_ppo, test_lost_worker_changes_nothing"""

    def __init__(self, opt: Options, parts: dict):
        self.trainer = ppo.Trainer(opt, env_of(parts, opt.envs, opt.threads))

    def reset(self, seed) -> dict:
        """Start all characters.  -> full (n, critic) their first observations; state"""
        env = self.trainer.env
        env.reset(seed)
        return {"full": env.full.copy(), "state": env.state(), "code": CODE}

    def load(self, state):
        """Continue from a state.  ValueError: another environment's"""
        self.trainer.env.load_state(*state)

    def collect(self, weights, rng, state=None) -> dict:
        """A rollout by the policy `weights`, from where the last one ended, or from `state`.

        Args      weights : `Policy.arrays`; rng : of the exploration
        Returns   samples : SENT, each (T, n, …); stats : `ppo.Trainer.collect`'s; seen : count, mean and m2 of the raw
                  observations, which are not sent; rng, state : to go on from; seconds : it took; code : CODE"""
        trainer, began = self.trainer, time.perf_counter()
        if state:
            self.load(state)
        trainer.policy.load(weights)
        trainer.rng = rng
        stats = trainer.collect()
        seen = RunningNorm(trainer.env.critic_size)
        seen.update(trainer.raw)
        samples = {name: getattr(trainer, name) for name in SENT}
        ended = {"rng": trainer.rng, "state": trainer.env.state()}
        found = {"samples": samples, "stats": stats, "seen": seen.state()} | ended
        return found | {"seconds": time.perf_counter() - began, "code": CODE}


# ------------------------------------------------------------------------------------ all of them


class Lost(Exception):
    """A worker is gone, or its answer is."""


class Workers:
    """All workers, where `ppo.Trainer` expects an `Env` of n characters: it can reset, tell and take a state.

    states  : of each worker, where its last answer left it; rngs : of exploration, of all but the first worker, whose
              random numbers are the trainer's own, as in ppo.py
    begun   : how often each worker has begun again
    Test      tests/extras/test_cluster.py::test_resume_is_exact, test_killed_worker, test_removed_node
    """

    def __init__(self, env: Env, opt: Options):
        if opt.envs % opt.workers:
            raise UserError(f"--envs {opt.envs} of {opt.workers} workers: not the same number each; valid: a multiple")
        self.env, self.n, self.workers = env, opt.envs, opt.workers
        self.opt = replace(opt, envs=opt.envs // opt.workers)
        for name in ("name", "char", "ref", "dt", "obs_size", "critic_size", "action_size", "value_scale"):
            setattr(self, name, getattr(env, name))
        self.rngs = [np.random.default_rng([opt.seed, 1, k]) for k in range(1, opt.workers)]
        self.states, self.begun = [None] * opt.workers, [0] * opt.workers
        self.actors = [None] * opt.workers
        self.parts = self.share(made_of(env))
        for k in range(opt.workers):
            self.begin(k, opt.threads)

    # what Ray does; tests put their own in its place

    def share(self, value):
        """Put a value where all workers can read it."""
        return ray.put(value)

    def begin(self, k, cores):
        """A new process for worker k, on a machine with so many cores free."""
        if self.actors[k]:
            ray.kill(self.actors[k])  # it may live on behind a broken line
        self.actors[k] = ray.remote(Worker).options(num_cpus=cores, max_restarts=0).remote(self.opt, self.parts)

    def free(self) -> int:
        """Cores that no worker holds."""
        return int(ray.available_resources().get("CPU", 0))

    def ask(self, k, name, *args):
        """Have worker k begin to do something.  -> what `answer` takes"""
        return getattr(self.actors[k], name).remote(*args)

    def answer(self, asked):
        """Wait for what was asked.  Lost: the worker is, or its machine; what the worker itself raised is raised"""
        e = ray.exceptions
        gone = e.RayActorError, e.ObjectLostError, e.NodeDiedError, e.WorkerCrashedError, e.OutOfMemoryError
        try:
            return ray.get(asked)
        except gone as error:
            raise Lost(str(error).partition("\n")[0]) from None

    # what is made of it

    def gather(self, name, args) -> list:
        """What every worker answers, in their order and not in that of time.  One that is lost begins again.

        Args      args : of each worker
        Raises    UserError: a worker is lost time and again; its machine has other code
        Test      tests/extras/test_cluster.py::test_lost_worker_changes_nothing, test_lost_too_often,
                  test_other_code"""
        asked = [self.ask(k, name, *each) for k, each in enumerate(args)]
        found = [self.persist(k, name, asked[k], args[k]) for k in range(self.workers)]
        for k, answer in enumerate(found):
            if answer and answer["code"] != CODE:
                raise UserError(f"worker {k}: its machine has other code than this one; valid: the same commit on all")
        return found

    def persist(self, k, name, asked, args):
        """Worker k's answer to what it was asked, through its losses."""
        for _ in range(TRIES):
            try:
                return self.answer(asked)
            except Lost as lost:
                self.begun[k] += 1
                cores = self.opt.threads if self.free() >= self.opt.threads else 0
                beside = "" if cores else ", beside others, for no core is free"
                print(f"note: worker {k} is lost ({lost}); it begins its rollout again{beside}", flush=True)
                self.begin(k, cores)
                more = (self.states[k],) if name == "collect" else ()  # where to begin
                asked = self.ask(k, name, *args, *more)
        goes_on = f"python -m extras.cluster --resume --out {self.opt.out}"
        raise UserError(f"worker {k} was lost {TRIES} times in one {name}; from the last checkpoint: {goes_on}")

    def reset(self, seed):
        """Start all characters; `full` holds their first observations.  The first worker's seed is ppo.py's."""
        found = self.gather("reset", [([seed, 4, k] if k else seed,) for k in range(self.workers)])
        self.states = [f["state"] for f in found]
        self.full = np.concatenate([f["full"] for f in found])

    def collect(self, weights, rngs) -> list:
        """A rollout of every worker.  Args: weights : `Policy.arrays`; rngs : of each"""
        shared = self.share(weights)
        found = self.gather("collect", [(shared, rng) for rng in rngs])
        # copies, or each would hold its whole rollout in Ray's memory
        self.states = [({k: a.copy() for k, a in arrays.items()}, m) for arrays, m in (f["state"] for f in found)]
        return found

    def state(self) -> tuple[dict, dict]:
        """As `Env.state`: arrays of all workers, one after the other, and their random states.

        Test      tests/extras/test_cluster.py::test_resume_is_exact"""
        arrays, meta = zip(*self.states)
        joined = {name: np.concatenate([a[name] for a in arrays]) for name in arrays[0]}
        others = [m | {"exploration": rng_state(r)} for m, r in zip(meta[1:], self.rngs, strict=True)]
        return joined, meta[0] | ({"others": others} if others else {})

    def load_state(self, arrays, meta):
        """Continue from what `state` returned.  ValueError: of another number of workers, or another environment's

        Test      tests/extras/test_cluster.py::test_resume_is_exact, test_foreign_state"""
        others = meta.get("others", [])
        if len(others) != self.workers - 1:
            raise ValueError(f"it has {len(others) + 1} workers, not {self.workers}")
        parts = {name: np.split(a, self.workers) for name, a in arrays.items()}
        metas = [{"rng": m["rng"]} for m in (meta, *others)]
        self.states = [({name: p[k] for name, p in parts.items()}, m) for k, m in enumerate(metas)]
        self.rngs = [rng_from_state(m["exploration"]) for m in others]
        self.gather("load", [(s,) for s in self.states])


# ------------------------------------------------------------------------------------ the driver


def merge(norm: RunningNorm, seen: dict):
    r"""Take in observations of which only the moments are here, as `RunningNorm.update` does the observations.

    Equation  [Chan79, Eq. 2.1] with d = mean_B − mean, n = count + B:  mean ← mean + d B / n,
              m2 ← m2 + m2_B + d² count B / n
    Args      seen : count B, mean_B (n,), m2_B (n,)
    Test      tests/extras/test_cluster.py::test_merged_moments
    """
    count, b = norm.count, int(seen["count"])
    total, d = count + b, seen["mean"] - norm.mean64
    mean, m2 = norm.mean64 + d * (b / total), norm.m2 + (seen["m2"] + d * d * (count * (b / total)))
    norm.load_state({"count": np.array(total), "mean": mean, "m2": m2})


def merged(each: list, seconds: float) -> dict:
    """The numbers of a rollout out of those of its parts, of equally many steps.

    Counts are added.  Means over steps are averaged; means over episodes are weighted by the episodes.
    Args      each : what `ppo.Trainer.collect` returned, of each part; seconds : simulated in all
    Test      tests/extras/test_cluster.py::test_merged_numbers"""
    episodes, out = sum(s["episodes"] for s in each), {}
    for name in each[0]:
        values = [s[name] for s in each]
        if name in ("episodes", "failures") or name.startswith("end_"):
            out[name] = sum(values)
        elif name in ("length", "survival"):
            means = [s["episodes"] / episodes * s[name] for s in each if s["episodes"]]
            out[name] = sum(means) if means else float("nan")
        elif name == "time_to_failure":
            out[name] = seconds / max(out["failures"], 1)
        else:
            out[name] = fmean(values)
    return out


class Trainer(ppo.Trainer):
    """`ppo.Trainer` with its characters elsewhere.

    Test      tests/extras/test_cluster.py::test_one_worker_is_ppo, test_same_whatever_the_order"""

    def __init__(self, opt: Options, workers: Workers, policy: Policy | None = None):
        super().__init__(opt, workers, policy)
        self.raw = None  # stays with the workers
        self.old_value = np.zeros_like(self.next_value)
        self.two = opt.workers * opt.threads > 1 and opt.minibatch >= 1024  # the workers wait meanwhile
        self.lines = None

    def collect(self) -> dict:
        """A rollout of all workers, laid side by side.  -> what happened"""
        asked = time.perf_counter()
        found = self.env.collect(self.policy.arrays(), [self.rng, *self.env.rngs])
        self.rng, *self.env.rngs = (f["rng"] for f in found)
        for name in SENT:
            np.concatenate([f["samples"][name] for f in found], axis=1, out=getattr(self, name))
        for f in found:  # for the next samples; these are normalised already
            merge(self.policy.norm, f["seen"])
        self.steps += self.reward.size
        self.tell(found, time.perf_counter() - asked)
        return merged([f["stats"] for f in found], self.reward.size * self.env.dt)

    def update(self) -> dict:
        """As `ppo.Trainer.update`; the normaliser has learnt already, from the workers' moments."""
        self.policy.norm.frozen = True
        stats = super().update()
        self.policy.norm.frozen = False
        return stats

    def tell(self, found, seconds):
        """A line of every worker into LINES: how fast it was, how long all took, how often it has begun again.

        Test      tests/extras/test_cluster.py::test_lines_of_the_workers"""
        if not self.lines:
            self.lines = Metrics(Path(self.opt.out) / LINES, self.updates * self.env.workers or None)
        steps = self.reward.size // self.env.workers
        for k, f in enumerate(found):
            row = {"update": self.updates + 1, "worker": k, "steps_per_s": steps / f["seconds"]}
            self.lines.append(row | {"collect_s": f["seconds"], "all_s": seconds, "begun_again": self.env.begun[k]})

    def close(self):
        """No more lines."""
        if self.lines:
            self.lines.close()


# ------------------------------------------------------------------------------------ command line


@contextmanager
def connected(opt: Options):
    """A Ray cluster with a core for every thread, until the block ends: the one at --address, or one of this machine.

    Raises    UserError: none is there, or its machines have no room for all workers
    Test      tests/extras/test_cluster.py::test_bad_commands, test_too_few_cores, test_busy_cluster"""
    need = opt.workers * opt.threads
    for name in OURS:
        os.environ.setdefault(name, "0")
    how = {"address": "local", "num_cpus": need, "include_dashboard": False}
    how = {"address": opt.address} if opt.address else how
    host, colon, port = (opt.address or "").rpartition(":")
    try:
        if colon:  # Ray itself would wait for it for ever
            socket.create_connection((host, int(port)), PATIENCE).close()
        ray.init(**how, runtime_env={"env_vars": ONE_THREAD}, logging_level="error", log_to_driver=False)
    except (OSError, ValueError) as e:
        start = "ray start --head --port 6379"
        where = f"--address {opt.address}: no Ray cluster there, or one with another token (RAY_AUTH_MODE=token)"
        raise UserError(f"{where}: {e}; this starts one: {start}") from None
    try:
        cores = [int(n["Resources"].get("CPU", 0)) for n in ray.nodes() if n["Alive"]]
        room = sum(n // opt.threads for n in cores)  # a worker's threads are of one machine
        if room < opt.workers:
            asked = f"--workers {opt.workers} × --threads {opt.threads}: {need} cores"
            has = f"the cluster has {sum(cores)}, room for {room} workers"
            raise UserError(f"{asked}, and {has}; valid: no more than that")
        free = int(ray.available_resources().get("CPU", 0))
        if free < need:  # Ray itself would say nothing
            print(f"note: {need} cores are needed and {free} are free; this run waits for the others", flush=True)
        yield
    finally:
        ray.shutdown()


def main(argv=None):
    """python -m extras.cluster: by the character's recipe, or resume.

    Test      tests/extras/test_cluster.py::test_killed_driver, test_bad_commands"""
    opt = read_options(Options, argv, "extras.cluster", __doc__, widths)
    if ray is None:
        raise UserError("extras.cluster needs ray: pip install -e '.[cluster]'")
    if opt.gpu:
        raise UserError("--gpu: the workers' physics runs on processors; leave it out, or use extras.train")
    env = train.make_env(replace(opt, envs=1, threads=1))
    with connected(opt):
        trainer = ppo.train(opt, Workers(env, opt), trainer=Trainer)
        trainer.close()


if __name__ == "__main__":
    run_main(main)

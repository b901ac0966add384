r"""What extras/cluster.py costs, what it bears, and how far it goes  (extra `cluster`; ours).

    python -m extras.cluster_bench                    steps a second beside ppo.py's loop, and what a step costs
    python -m extras.cluster_bench --faults           workers killed, nodes removed, drivers killed: what is lost
    python -m extras.cluster_bench --plan             steps a second of up to a thousand cores, simulated

The loops are timed in turn, an update each, round after round; ratios are medians of the rounds' ratios, for a
disturbance of the machine hits all loops.  Processor time is that of driver and workers; Ray's other processes stand
beside it, and take theirs from any loop.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as ppo.py does, and says why; before NumPy is loaded

import numpy as np

import ppo
from extras import cluster, train
from extras.cluster import SENT, Workers, connected
from plumbing.cli import COUNT, POSITIVE, UserError, arg, markdown, run_main
from plumbing.runs import CHECKPOINT, METRICS, latest_checkpoint, load_checkpoint, read_metrics
from plumbing.training import read_options
from policy import widths

LOOPS = ((0, 1), (1, 1), (0, 2), (2, 1), (1, 2), (4, 1))  # (workers, threads of each); no workers: ppo.py's own loop
FAULTS = ("worker killed", "node removed", "driver killed")
PER_NODE = 16  # cores of a machine in the plan
PLAN = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)


@dataclass
class Options(cluster.Options):
    """extras/cluster.py's options, and what to do."""

    rounds: int = arg(15, "how often each loop is timed", check=COUNT)
    faults: bool = arg(False, "the table of faults instead")
    times: int = arg(5, "with --faults: how often each", check=COUNT)
    plan: bool = arg(False, "the table of the plan instead, from the costs below")
    characters: int = arg(64, "with --plan: of each worker", check=COUNT)
    simulate_us: float = arg(116.0, "with --plan: a core's time for a control step [µs]", check=POSITIVE)
    update_us: float = arg(72.8, "with --plan: the driver's time to learn from a step [µs]", check=POSITIVE)
    engine_us: float = arg(1.22, "with --plan: the driver's time to take a step in [µs]", check=POSITIVE)
    sample_bytes: float = arg(2304.0, "with --plan: of a step, on its way to the driver", check=POSITIVE)
    weight_bytes: float = arg(2424260.0, "with --plan: of both networks", check=POSITIVE)
    latency_ms: float = arg(0.7, "with --plan: of a question and its answer [ms]", check=POSITIVE)
    spread: float = arg(0.1, "with --plan: standard deviation of a rollout's time, as a share of it", check=POSITIVE)
    gigabits: float = arg(10.0, "with --plan: of the network, a second", check=POSITIVE)


# ------------------------------------------------------------------------------------ speed


class Loop:
    """One way to train, to be timed an update at a time."""

    def __init__(self, opt: Options, env, workers, threads):
        self.opt = replace(opt, workers=max(workers, 1), threads=threads)
        self.name = f"{workers} worker{'s' * (workers > 1)} × {threads}" if workers else f"ppo.py --threads {threads}"
        self.workers = Workers(env, self.opt) if workers else None
        if workers:
            self.trainer = cluster.Trainer(self.opt, self.workers)
            pids = [a.__ray_call__.remote(lambda _: os.getpid()) for a in self.workers.actors]
            self.pids = cluster.ray.get(pids)
        else:
            self.trainer, self.pids = ppo.Trainer(self.opt, train.make_env(self.opt)), []
        self.trainer.start()
        self.rows = []

    def __call__(self, engine):
        """One update.  engine : process numbers of Ray's own"""
        pids = [os.getpid(), *self.pids]
        cpu, own, began = processor(pids), processor(engine), time.perf_counter()
        self.trainer.collect()
        middle = time.perf_counter()
        self.trainer.update()
        ended = time.perf_counter()
        used = processor(pids) - cpu, processor(engine) - own
        self.rows.append((middle - began, ended - middle, *used))


def processor(pids) -> float:
    """Seconds of processor time that processes have had (Linux).

    Test      tests/extras/test_cluster_bench.py::test_processor_time"""
    ticks = 0
    for pid in pids:
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def below(pid) -> list:
    """Numbers of all processes that a process has started, and those these have started (Linux).

    Test      tests/extras/test_cluster_bench.py::test_processor_time"""
    parents = {}
    for each in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parents[int(each.name)] = int((each / "stat").read_text().rpartition(")")[2].split()[1])
    found = [pid]
    for one in found:  # it grows
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


def speed(opt: Options):
    """Two tables: the loops beside one another; and the costs that the plan needs."""
    env = train.make_env(replace(opt, envs=1, threads=1))
    with connected(replace(opt, workers=sum(w for w, _ in LOOPS), threads=2)):
        loops = [Loop(opt, env, *each) for each in LOOPS]
        workers = {pid for loop in loops for pid in loop.pids}
        engine = [pid for pid in below(os.getpid()) if pid not in workers]
        for k in range(opt.rounds + 1):
            for loop in loops[k % len(loops) :] + loops[: k % len(loops)]:
                loop(engine)
        one = next(loop for loop in loops if loop.name.startswith("1 worker × 1"))
        costs_of(one, opt)
    steps = opt.envs * opt.horizon
    times = {loop.name: np.array(loop.rows[1:]) for loop in loops}  # the first warms up
    head = ["loop", "steps/s", "of ppo.py at equal threads", "processor µs/step", "of ppo.py's"]
    rows = [[*head, "Ray's own µs", "collect, update s"]]
    for (w, t), (name, each) in zip(LOOPS, times.items(), strict=True):
        rival = times[f"ppo.py --threads {max(w, 1) * t if max(w, 1) * t <= 2 else 2}"]
        wall, cpu = each[:, :2].sum(1), each[:, 2]
        ratio, cost = np.median(rival[:, :2].sum(1) / wall), np.median(cpu / rival[:, 2])
        rows.append([name, f"{steps / np.median(wall):,.0f}", f"{ratio:.2f}", f"{1e6 * np.median(cpu) / steps:.0f}"])
        rows[-1] += [f"{cost:.2f}", f"{1e6 * np.median(each[:, 3]) / steps:.0f}"]
        rows[-1].append(f"{np.median(each[:, 0]):.2f}, {np.median(each[:, 1]):.2f}")
    print(markdown(rows))


def costs_of(loop: Loop, opt: Options):
    """Print what a step costs where one worker has one core: the options of --plan.

    Times are the processor's, which other jobs on the machine do not lengthen; the latency is the tenth percentile."""
    trainer, workers, rows, calls = loop.trainer, loop.workers, [], []
    steps, driver, worker = opt.envs * opt.horizon, [os.getpid()], loop.pids
    for _ in range(opt.rounds):
        before = processor(driver), processor(worker)
        trainer.collect()
        middle = processor(driver), processor(worker)
        trainer.update()
        rows.append((middle[1] - before[1], middle[0] - before[0], processor(driver) - middle[0]))
    for _ in range(100):
        began = time.perf_counter()
        cluster.ray.get(workers.actors[0].__ray_call__.remote(lambda _: None))
        calls.append(time.perf_counter() - began)
    rollout, engine, update = np.mean(rows, axis=0)
    sent = sum(getattr(trainer, name).nbytes for name in SENT)
    state = sum(a.nbytes for a in workers.states[0][0].values())
    weights = sum(a.nbytes for a in trainer.policy.arrays().values())
    print(f"--simulate-us {1e6 * rollout / steps:.0f} --update-us {1e6 * update / steps:.1f}", end=" ")
    print(f"--engine-us {1e6 * engine / steps:.2f} --sample-bytes {(sent + state) / steps:.0f}", end=" ")
    print(f"--weight-bytes {weights} --latency-ms {1e3 * np.quantile(calls, 0.1):.1f}", end=" ")
    print(f"--spread {np.std([r[0] for r in rows]) / rollout:.2f}")
    print(f"a rollout of {steps} steps: {sent / 1e6:.1f} MB, and {state / 1e6:.2f} MB of state")


# ------------------------------------------------------------------------------------ faults


class Failing(Workers):
    """Workers whose third rollout is struck in its middle by `fault`, a function of them."""

    fault, rollouts = None, 0

    def ask(self, k, name, *args):
        asked = super().ask(k, name, *args)
        self.rollouts += name == "collect"
        if self.fault and self.rollouts == 3 * self.workers:
            fault, self.fault = self.fault, None
            time.sleep(0.2)  # a rollout takes longer
            fault(self)
        return asked


def trained(opt: Options, fault=None):
    """A run on the cluster at opt.address; -> its checkpoint's arrays, seconds of each rollout"""
    env = train.make_env(replace(opt, envs=1, threads=1))
    with connected(opt):
        workers = Failing(env, opt)
        workers.pids = cluster.ray.get([a.__ray_call__.remote(lambda _: os.getpid()) for a in workers.actors])
        workers.homes = cluster.ray.get([a.__ray_call__.remote(home) for a in workers.actors])
        workers.fault = fault
        ppo.train(opt, workers, trainer=cluster.Trainer).close()
    return load_checkpoint(Path(opt.out) / CHECKPOINT)[0], read_metrics(Path(opt.out) / METRICS)["collect_s"]


def home(_):
    """The node of a worker."""
    return cluster.ray.get_runtime_context().get_node_id()


def faults(opt: Options):
    """A table: each fault `times` times; steps simulated twice, seconds more, and whether the policy is the same."""
    from ray.cluster_utils import Cluster  # not with the others: without the extra, main says what is missing

    steps, memory = opt.envs * opt.horizon, {"object_store_memory": 100 * 2**20}
    opt = replace(opt, workers=4, steps=6 * steps)
    for name in cluster.OURS:
        os.environ.setdefault(name, "0")
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **memory})
    head = "fault", "times", "steps simulated twice", "seconds more, median (most)", "policy the same"
    rows, quiet = [list(head)], io.StringIO()
    try:
        others = [nodes.add_node(num_cpus=1, **memory) for _ in range(4)]
        opt = replace(opt, address=nodes.address)
        with tempfile.TemporaryDirectory() as folder:
            out = lambda name: replace(opt, out=f"{folder}/{name}")  # noqa: E731
            with contextlib.redirect_stdout(quiet):
                whole, usual = trained(out("whole"))
            for fault in FAULTS:
                lost, more, same = [], [], 0
                for k in range(opt.times):
                    with contextlib.redirect_stdout(quiet):
                        found = struck(fault, k, out(f"{fault}-{k}".replace(" ", "-")), nodes, others)
                    arrays, again, seconds = found
                    lost.append(again)
                    more.append(seconds - np.median(usual) if seconds == seconds else seconds)
                    same += all(np.array_equal(whole[name], arrays[name]) for name in whole)
                each = f"{min(lost):,} to {max(lost):,}" if min(lost) < max(lost) else f"{lost[0]:,}"
                rows.append([fault, str(opt.times), each, f"{np.median(more):.1f} ({max(more):.1f})"])
                rows[-1].append(f"{same} of {opt.times}")
                print(rows[-1], flush=True)
    finally:
        nodes.shutdown()
    print(markdown(rows))


def struck(fault, k, opt, nodes, others):
    """A run with a fault.  -> its arrays, steps that are simulated twice, seconds of the rollout that was struck"""
    victim, rollout = k % opt.workers, opt.envs // opt.workers * opt.horizon
    if fault == "worker killed":
        arrays, seconds = trained(opt, lambda w: os.kill(w.pids[victim], signal.SIGKILL))
        return arrays, rollout, seconds[2]
    if fault == "node removed":
        def remove(w):
            gone = next(n for n in others if n.node_id == w.homes[victim])
            others.remove(gone)
            nodes.remove_node(gone)

        arrays, seconds = trained(opt, remove)
        others.append(nodes.add_node(num_cpus=1, object_store_memory=100 * 2**20))
        return arrays, rollout, seconds[2]
    often = "import sys, ppo; ppo.CHECKPOINT_SECONDS = 0; from extras import cluster; cluster.main(sys.argv[1:])"
    given = ["--character", opt.character, "--recipe", opt.recipe, "--clips", opt.clips, "--envs", str(opt.envs)]
    given += ["--horizon", str(opt.horizon), "--minibatch", str(opt.minibatch), "--workers", str(opt.workers)]
    given += ["--seed", str(opt.seed), "--address", opt.address, "--steps", str(opt.steps), "--out", opt.out]
    process = subprocess.Popen([sys.executable, "-c", often, *given], stdout=subprocess.DEVNULL)
    rows = lambda: Path(opt.out, METRICS).read_text().count("\n") if Path(opt.out, METRICS).exists() else 0  # noqa: E731
    while rows() < 4 and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.1 * (k + 1))
    process.kill()
    process.wait()
    done, began = latest_checkpoint(opt.out)[1]["updates"], time.perf_counter()
    again = max(rows() - 1 - done, 0) + 1  # rows that are made again, and the update that was under way
    time.sleep(3.0)  # its workers end with it
    arrays, _ = trained(replace(opt, resume=True))
    return arrays, again * opt.envs * opt.horizon, time.perf_counter() - began


# ------------------------------------------------------------------------------------ the plan


def served(arrivals, seconds) -> float:
    r"""When the last of several arrivals has been served, one after the other, each in so many seconds.

    Equation  f_k = max(f_{k−1}, a_k) + s, in the order of arrival
    Test      tests/extras/test_cluster_bench.py::test_served"""
    end = 0.0
    for a in np.sort(arrivals):
        end = max(end, a) + seconds
    return float(end)


def seconds_of_update(scheme, workers, opt: Options, rng, learners=1) -> float:
    r"""Seconds of one update on so many cores, simulated; the samples of an update grow with the workers.

    samples     weights to every machine; rollouts; samples through the driver's line and its copying, one after the
                other; the update of all of them
    stale       the slowest of three that run side by side: rollouts, the line, the driver
    gradients   rollouts; then epochs × minibatches times: the share of one worker, all gradients through the line,
                weights to every machine.  There are as many minibatches as now, of more samples
    sharded     as samples, each of the learners with its share of the workers, and a ring of 2 (L − 1) messages of
                weights / L for each minibatch
    Args      rng : of the rollouts' times, normal with opt.spread
    Test      tests/extras/test_cluster_bench.py::test_plan_by_hand"""
    samples = opt.characters * opt.horizon  # of a worker
    line, latency = opt.gigabits * 1e9 / 8, 1e-3 * opt.latency_ms
    share, machines = workers / learners, max(workers / learners / PER_NODE, 1.0)
    weights = latency + machines * opt.weight_bytes / line
    each = 1e-6 * opt.simulate_us * samples * np.maximum(1.0 + opt.spread * rng.standard_normal(workers), 0.1)
    take = samples * max(opt.sample_bytes / line, 1e-6 * opt.engine_us)
    learn = 1e-6 * opt.update_us * samples
    rounds = opt.epochs * max(round(opt.envs * opt.horizon / opt.minibatch), 1)
    if scheme == "stale":
        return max(weights + each.max(), workers * take + workers * learn)
    if scheme == "gradients":
        back = workers * opt.weight_bytes / line
        return weights + each.max() + learn + rounds * (latency + back + weights)
    parts = np.array_split(each, learners)
    ready = max(served(weights + part, take) for part in parts)
    ring = rounds * 2 * (learners - 1) * (latency + opt.weight_bytes / learners / line)
    return ready + share * learn + ring


def plan(opt: Options, times=20) -> list:
    """Rows of text: for each number of workers steps a second by each scheme, and days for the paper's 6e9 steps.

    Test      tests/extras/test_cluster_bench.py::test_plan_table"""
    samples, rng = opt.characters * opt.horizon, np.random.default_rng(opt.seed)
    rows = [["workers", "samples", "stale", "gradients", "sharded (learners)", "days for 6e9 steps, samples / best"]]

    def rate(scheme, n, learners=1):
        return n * samples / np.mean([seconds_of_update(scheme, n, opt, rng, learners) for _ in range(times)])

    for n in PLAN:
        one = {scheme: rate(scheme, n) for scheme in ("samples", "stale", "gradients")}
        many = {k: rate("samples", n, k) for k in (2, 4, 8, 16, 32, 64) if k <= n}
        k = max(many, key=many.get) if many else 1
        cells = [f"{n:,}", *(f"{v:,.0f}" for v in one.values()), f"{many[k]:,.0f} ({k})" if many else "–"]
        best = max(*one.values(), *many.values())
        rows.append([*cells, f"{6e9 / one['samples'] / 86400:.1f} / {6e9 / best / 86400:.1f}"])
    return rows


def main(argv=None):
    """python -m extras.cluster_bench.  Test: tests/extras/test_cluster_bench.py::test_plan_table"""
    opt = read_options(Options, argv, "extras.cluster_bench", __doc__, widths)
    if opt.plan:
        print(markdown(plan(opt)))
        return
    if cluster.ray is None:
        raise UserError("extras.cluster_bench needs ray: pip install -e '.[cluster]'")
    if sys.platform != "linux":
        raise UserError("processor time is read from /proc: Linux alone")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "run").mkdir()
        (faults if opt.faults else speed)(replace(opt, out=f"{folder}/run"))


if __name__ == "__main__":
    run_main(main)

"""extras/cluster.py: workers elsewhere change nothing; lost workers, removed nodes, killed drivers.

Most tests run the workers in this process, one after the other, behind the same pickling; the last ones run Ray (extra
`cluster`), on several local nodes, and skip without it.
"""

import os
import pickle
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from test_ppo import ROOT, TINY, assert_same_run

import ppo
from extras import cluster, train
from extras.cluster import LINES, Lost, Worker, Workers
from nn import RunningNorm
from plumbing import runs
from plumbing.cli import UserError
from plumbing.runs import CHECKPOINT, METRICS, load_checkpoint, read_metrics

CURRICULUM = "--balance --retry 0.3 --stand 0.2 --sensor-noise 0.01 --sensor-offset 0.01 --push 0.4".split()
CURRICULUM += "--episode 20 --sigma 0.4".split()


class Here(Workers):
    """The workers in this process, one after the other, in any order; what goes to them and comes back is a copy.

    lose : (number of the question, worker), counted from 0, whose answers are lost; the work is done before
    """

    lose, order, asked = (), 1, 0

    def share(self, value):
        return value

    def begin(self, k, cores):
        self.actors[k] = Worker(self.opt, pickle.loads(pickle.dumps(self.parts)))

    def free(self):
        return 0

    def ask(self, k, name, *args):
        return k, name, pickle.dumps(args)

    def gather(self, name, args):
        self.found = {}
        for k in list(range(self.workers))[:: self.order]:
            self.found[k] = self.do(self.ask(k, name, *args[k]))
        self.asked += 1
        return super().gather(name, args)

    def do(self, asked):
        k, name, args = asked
        return pickle.loads(pickle.dumps(getattr(self.actors[k], name)(*pickle.loads(args))))

    def answer(self, asked):
        k = asked[0]
        if (self.asked - 1, k) in self.lose and k in self.found:
            del self.found[k]
            raise Lost("test")
        return self.found[k] if k in self.found else self.do(asked)


def here(out, updates, *more, main=cluster.main, **changes):
    """The command line with the workers in this process, to `updates` updates in all."""
    args = list(more) if "--resume" in more else [*TINY, *CURRICULUM, *more]

    def make(env, opt):
        made = object.__new__(Here)
        vars(made).update(changes)
        made.__init__(env, opt)
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "Workers", make)
        patch.setattr(cluster, "connected", nullcontext)
        patch.setattr(cluster, "ray", cluster)
        main([*args, "--out", str(out), "--steps", str(64 * updates)])
    return load_checkpoint(Path(out) / CHECKPOINT)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Six updates of two workers without a break."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    here(out, 6, "--workers", "2")
    return out


# ------------------------------------------------------------------------------------ nothing changes


def test_one_worker_is_ppo(tmp_path):
    """To the bit: checkpoint, with the curriculum, the disturbances and all random states, and metrics.csv."""
    here(tmp_path / "one", 6, "--workers", "1")
    train.main([*TINY, *CURRICULUM, "--out", str(tmp_path / "ppo"), "--steps", str(6 * 64)])
    assert_same_run(tmp_path / "ppo", tmp_path / "one")
    ends = read_metrics(tmp_path / "one" / METRICS)
    assert ends["failures"].sum() > 0 and ends["end_time"].sum() > 0  # both kinds of ends were seen


def test_same_whatever_the_order(whole, tmp_path):
    """The answers' order in time does not matter; seed and number of workers do."""
    here(tmp_path / "a", 6, "--workers", "2", order=-1)
    assert_same_run(whole, tmp_path / "a")
    others = {
        (2, 1): here(tmp_path / "b", 6, "--workers", "2", "--seed", "1"),
        (4, 0): here(tmp_path / "c", 6, "--workers", "4"),
    }
    policies = [load_checkpoint(whole / CHECKPOINT)[0], *(arrays for arrays, _ in others.values())]
    for k, a in enumerate(policies):
        assert all(np.abs(a["policy.pi"] - b["policy.pi"]).max() > 1e-5 for b in policies[:k])


def test_workers_differ(whole):
    """No worker does what another does."""
    arrays, meta = load_checkpoint(whole / CHECKPOINT)
    first, second = np.split(arrays["env.state"], 2)
    assert not np.isclose(first, second).all(1).any()
    assert (
        meta["env"]["rng"] != meta["env"]["others"][0]["rng"] and meta["rng"] != meta["env"]["others"][0]["exploration"]
    )


def test_resume_is_exact(whole, tmp_path):
    here(tmp_path / "a", 2, "--workers", "2")
    here(tmp_path / "a", 4, "--resume", "--address", "auto")  # another cluster
    _, meta = here(tmp_path / "a", 6, "--resume", main=ppo.main)  # which hands on
    assert meta["updates"] == 6 and meta["steps"] == 6 * 64
    assert_same_run(whole, tmp_path / "a")
    ours, theirs = (read_metrics(d / LINES) for d in (whole, tmp_path / "a"))
    for name in ("update", "worker"):
        np.testing.assert_array_equal(ours[name], theirs[name])


def test_foreign_state(tmp_path):
    """A checkpoint of another number of workers."""
    here(tmp_path / "a", 1, "--workers", "2")
    config = tmp_path / "a" / runs.CONFIG
    config.write_text(config.read_text().replace('"workers": 2', '"workers": 4'))
    with pytest.raises(UserError, match="checkpoint.npz: does not fit this run.*2 workers, not 4"):
        here(tmp_path / "a", 2, "--resume")


# ------------------------------------------------------------------------------------ its own parts


def test_merged_moments():
    """Moments of parts against all rows at once; of one part to the bit."""
    rng = np.random.default_rng(0)
    parts = [rng.standard_normal((n, 3)) * 5 + 2 for n in (7, 1, 12)]
    ours, theirs = RunningNorm(3), RunningNorm(3)
    for norm in (ours, theirs):
        norm.update(parts[0])
    for part in parts[1:]:
        seen = RunningNorm(3)
        seen.update(part)
        cluster.merge(ours, seen.state())
        theirs.update(part)
        for name, value in theirs.state().items():
            np.testing.assert_array_equal(ours.state()[name], value)
        np.testing.assert_array_equal(ours.inv_std, theirs.inv_std)
    every = np.concatenate(parts)
    np.testing.assert_allclose(ours.mean64, every.mean(0))
    np.testing.assert_allclose(ours.var, every.var(0))


def test_merged_numbers():
    """A rollout cut in two by hand, one part without an episode's end."""
    a = {
        "episodes": 3,
        "failures": 1,
        "reward": 2.0,
        "length": 10.0,
        "survival": 0.5,
        "time_to_failure": 9.0,
        "r_q": 1.0,
        "end_far": 1,
    }
    b = {
        "episodes": 1,
        "failures": 0,
        "reward": 4.0,
        "length": 50.0,
        "survival": 0.1,
        "time_to_failure": 9.0,
        "r_q": 2.0,
        "end_far": 0,
    }
    none = a | {"episodes": 0, "failures": 0, "length": float("nan"), "survival": float("nan"), "end_far": 0}
    found = cluster.merged([a, b, none], 30.0)
    want = {
        "episodes": 4,
        "failures": 1,
        "reward": 8 / 3,
        "length": 20.0,
        "survival": 0.4,
        "time_to_failure": 30.0,
        "r_q": 4 / 3,
        "end_far": 1,
    }
    assert list(found) == list(want) and found == pytest.approx(want)
    assert np.isnan(cluster.merged([none, none], 30.0)["length"])


def test_lines_of_the_workers(whole):
    """A line a worker and update; metrics.csv has ppo.py's columns."""
    lines, rows = read_metrics(whole / LINES), read_metrics(whole / METRICS)
    np.testing.assert_array_equal(lines["update"], np.repeat(np.arange(1, 7), 2))
    np.testing.assert_array_equal(lines["worker"], np.tile([0, 1], 6))
    assert (lines["collect_s"] > 0).all() and (lines["begun_again"] == 0).all()
    np.testing.assert_allclose(lines["steps_per_s"] * lines["collect_s"], 32)
    assert len(rows["update"]) == 6


# ------------------------------------------------------------------------------------ what is lost


def test_lost_worker_changes_nothing(whole, tmp_path, capsys):
    """Lost at the first observation, in the first rollout, in later ones, two at once: the policy is the same."""
    here(tmp_path / "a", 6, "--workers", "2", lose={(0, 1), (1, 0), (3, 1), (5, 0), (5, 1)})
    assert_same_run(whole, tmp_path / "a")
    assert capsys.readouterr().out.count("is lost (test); it begins its rollout again") == 5
    assert read_metrics(tmp_path / "a" / LINES)["begun_again"].tolist() == [1, 1, 1, 1, 1, 2, 1, 2, 2, 3, 2, 3]


def test_lost_too_often(tmp_path):
    def never(self, asked):
        raise Lost("test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Here, "answer", never)
        with pytest.raises(UserError, match=f"worker 0 was lost {cluster.TRIES} times.*--resume --out"):
            here(tmp_path / "a", 1)


def test_bad_commands(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="--envs 8 of 3 workers.*a multiple"):
        here(tmp_path / "a", 1, "--workers", "3")
    with pytest.raises(UserError, match="--gpu"):
        here(tmp_path / "a", 1, "--gpu")
    assert not (tmp_path / "a").exists()
    here(tmp_path / "a", 1, "--workers", "2")
    with pytest.raises(UserError, match="started with --workers 2"):
        here(tmp_path / "a", 2, "--resume", "--workers", "4")
    monkeypatch.setattr(cluster, "ray", None)
    with pytest.raises(UserError, match="needs ray: pip install"):
        cluster.main([*TINY, "--out", str(tmp_path / "b")])


# ------------------------------------------------------------------------------------ Ray


@pytest.fixture(scope="module")
def nodes():
    """A Ray cluster of two local nodes, a core each, beside a head without one."""
    pytest.importorskip("ray", reason="ray is not installed: pip install -e '.[cluster]'")
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        for name in cluster.OURS:
            patch.setenv(name, "0")
        memory = {"object_store_memory": 80 * 2**20}
        found = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **memory})
        found.kept = [found.add_node(num_cpus=1, **memory) for _ in range(2)]
        found.more = lambda n: [found.add_node(num_cpus=1, **memory) for _ in range(n)]
        yield found
        found.shutdown()


def on_ray(nodes, out, updates, *more, fault=None):
    """The command line on a Ray cluster; fault(workers) is called once, while the third rollout is under way."""
    args = list(more) if "--resume" in more else [*TINY, *CURRICULUM, *more]

    class Failing(Workers):
        rollouts = 0

        def ask(self, k, name, *args):
            asked = super().ask(k, name, *args)
            self.rollouts += name == "collect"
            if fault and self.rollouts == 3 * self.workers:
                self.rollouts += 1  # once
                fault(self)
            return asked

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "Workers", Failing)
        cluster.main([*args, "--out", str(out), "--steps", str(64 * updates), "--address", nodes.address])


def test_killed_worker(nodes, whole, tmp_path, capsys):
    """On two nodes: SIGKILL in the middle of a rollout."""
    import ray

    def kill(workers):
        ray.get(workers.actors[1].__ray_call__.remote(lambda self: os.kill(os.getpid(), signal.SIGKILL)), timeout=60)

    def killed(workers):
        with pytest.raises(ray.exceptions.RayActorError):
            kill(workers)

    on_ray(nodes, tmp_path / "a", 6, "--workers", "2", fault=killed)
    assert_same_run(whole, tmp_path / "a")
    assert "worker 1 is lost" in capsys.readouterr().out
    assert read_metrics(tmp_path / "a" / LINES)["begun_again"][-2:].tolist() == [0, 1]


def test_removed_node(nodes, tmp_path, capsys):
    """On four nodes, one of them removed: its worker goes on elsewhere."""
    import ray

    extra = nodes.more(2)

    def remove(workers):
        where = [
            ray.get(a.__ray_call__.remote(lambda _: ray.get_runtime_context().get_node_id())) for a in workers.actors
        ]
        assert len(set(where)) == 4
        nodes.remove_node(next(n for n in extra if n.node_id in where))

    on_ray(nodes, tmp_path / "a", 6, "--workers", "4", fault=remove)
    here(tmp_path / "b", 6, "--workers", "4")
    assert_same_run(tmp_path / "b", tmp_path / "a")
    told = capsys.readouterr().out
    assert "is lost" in told and "no core is free" in told
    assert read_metrics(tmp_path / "a" / LINES)["begun_again"][-4:].sum() == 1


def test_killed_driver(nodes, whole, tmp_path):
    """SIGKILL among its checkpoints: the workers end with it, and the run goes on to the same numbers."""
    out = tmp_path / "killed"
    often = "import sys, ppo; ppo.CHECKPOINT_SECONDS = 0; from extras import cluster; cluster.main(sys.argv[1:])"
    args = [*TINY, *CURRICULUM, "--workers", "2", "--address", nodes.address, "--steps", "1e9", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-c", often, *args], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        deadline = time.monotonic() + 300
        while not ((out / METRICS).exists() and (out / METRICS).read_text().count("\n") > 4):
            assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
            time.sleep(0.003)
    finally:
        process.kill()
        process.communicate()
    updates = runs.latest_checkpoint(out)[1]["updates"] + 2
    on_ray(nodes, out, updates, "--resume")
    here(tmp_path / "b", updates, "--workers", "2")
    assert_same_run(tmp_path / "b", out)


def test_too_few_cores(nodes, tmp_path):
    with pytest.raises(UserError, match="--workers 8 × --threads 1: 8 cores, and the cluster has"):
        on_ray(nodes, tmp_path / "a", 1, "--workers", "8")
    with pytest.raises(UserError, match="--workers 1 × --threads 2: 2 cores, and the cluster has .*room for 0 workers"):
        on_ray(nodes, tmp_path / "a", 1, "--workers", "1", "--threads", "2")  # a core each
    with pytest.raises(UserError, match="--address 127.0.0.1:1: no Ray cluster there.*ray start --head"):
        cluster.main([*TINY, "--workers", "2", "--address", "127.0.0.1:1", "--out", str(tmp_path / "b")])


def test_other_code(tmp_path, monkeypatch):
    """A machine with another commit is found out with its first answer, before anything is learnt from it."""
    collect = Worker.collect
    monkeypatch.setattr(Worker, "collect", lambda *args: collect(*args) | {"code": "another"})
    with pytest.raises(UserError, match="worker 0: its machine has other code than this one; valid: the same commit"):
        here(tmp_path / "a", 2, "--workers", "2")
    assert not (tmp_path / "a" / CHECKPOINT).exists()


def test_busy_cluster(nodes, capsys):
    """Cores that another run holds are waited for, and a line says so."""
    opt = cluster.Options(address=nodes.address, workers=2)
    for free in (1, 2):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cluster.ray, "available_resources", lambda n=free: {"CPU": float(n)})
            with cluster.connected(opt):
                pass
        assert ("2 cores are needed and 1 are free" in capsys.readouterr().out) == (free < 2)

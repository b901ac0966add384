"""extras/cluster_bench.py: the plan against sums by hand, and how processor time is read."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from extras import cluster_bench
from extras.cluster_bench import Options, below, processor, seconds_of_update, served

linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


def test_served():
    """Against the closed form: the last is served when the busiest stretch up to the end is."""
    rng = np.random.default_rng(0)
    for n in (1, 2, 7, 40):
        arrivals, s = rng.uniform(0.0, 1.0, n), rng.uniform(0.001, 0.1)
        want = max(a + (n - k) * s for k, a in enumerate(np.sort(arrivals)))
        assert served(arrivals, s) == pytest.approx(want)


def test_plan_by_hand():
    """Without spread, of 32 workers on two machines, each term as a sum of its own."""
    opt = Options(spread=1e-9, characters=10, horizon=20, envs=100, minibatch=500, epochs=2, gigabits=8.0)
    opt.simulate_us, opt.update_us, opt.engine_us = 100.0, 30.0, 2.0
    opt.sample_bytes, opt.weight_bytes, opt.latency_ms = 4000.0, 1e6, 3.0
    rng, n = np.random.default_rng(0), 32
    weights = 0.003 + 2 * 1e6 / 1e9  # to two machines of 16 cores, a gigabyte a second
    rollout, line, learn = 200 * 100e-6, 200 * 4000 / 1e9, 200 * 30e-6  # a worker's 200 steps; the line is slower than
    assert line > 200 * 2e-6  # the copying
    near = lambda v: pytest.approx(v, rel=1e-6)  # noqa: E731
    assert seconds_of_update("samples", n, opt, rng) == near(weights + rollout + n * line + n * learn)
    assert seconds_of_update("stale", n, opt, rng) == near(max(weights + rollout, n * (line + learn)))
    rounds = 2 * 4  # epochs × minibatches
    each = 0.003 + n * 1e6 / 1e9 + weights
    assert seconds_of_update("gradients", n, opt, rng) == near(weights + rollout + learn + rounds * each)
    one = 0.003 + 1e6 / 1e9  # a learner's 16 workers are one machine
    ring = rounds * 2 * (0.003 + 1e6 / 2 / 1e9)
    assert seconds_of_update("samples", n, opt, rng, 2) == near(one + rollout + 16 * (line + learn) + ring)
    opt.engine_us = 8.0
    slower = seconds_of_update("samples", n, opt, rng)
    assert slower == near(weights + rollout + n * 200 * 8e-6 + n * learn)


def test_plan_table(capsys, tmp_path):
    """The printed table: more workers are never slower, and the driver's update bounds what samples can do."""
    cluster_bench.main(["--plan", "--recipe", "none", "--update-us", "20", "--out", str(tmp_path / "a")])
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [int(r[0].replace(",", "")) for r in rows] == list(cluster_bench.PLAN)
    samples = [float(r[1].replace(",", "")) for r in rows]
    assert samples == sorted(samples) and samples[-1] < 1e6 / 20
    assert samples[0] == pytest.approx(1e6 / (125 + 20 + 3.54), rel=0.1)  # one core: its step, the update, the line
    assert not (tmp_path / "a").exists()


@linux
def test_processor_time():
    """A second process that computes, against its own clock; a sleeping one takes nothing."""
    busy = "import time\nwhile time.process_time() < 0.3: pass\nprint('done', flush=True); time.sleep(60)"
    child = subprocess.Popen([sys.executable, "-c", busy], stdout=subprocess.PIPE)
    try:
        child.stdout.readline()
        assert child.pid in below(os.getpid())
        used = processor([child.pid])
        assert 0.25 < used < 0.6
        time.sleep(0.1)
        assert processor([child.pid]) - used <= 0.02
    finally:
        child.kill()
        child.communicate()
    assert processor([child.pid]) == 0.0

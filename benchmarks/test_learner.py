"""Updates per second of the learner, in CPU time: `pytest benchmarks/test_learner.py`. For peers see `learner.py`."""

import sys
import time
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from learner_work import B, flops_per_update
from learner_workers import WORKERS

CONTESTANTS = [name for name in WORKERS if name.startswith(("coachable", "torchrl"))]


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("name", CONTESTANTS)
def test_updates(benchmark, name):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        run = WORKERS[name]()
        run(5)
        benchmark.pedantic(run, args=(4,), rounds=5)
    finally:
        torch.set_num_threads(threads)
    seconds = benchmark.stats.stats.median / 4
    benchmark.extra_info.update(
        updates_per_s=1 / seconds, samples_per_s=B / seconds, gflops=flops_per_update() / seconds / 1e9
    )

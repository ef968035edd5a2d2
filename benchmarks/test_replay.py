"""What replay costs: stratified batches against a plain buffer of the same content, relabelling against n, writing.

Run with `OMP_NUM_THREADS=1 python -m pytest benchmarks/test_replay.py`. Competitors take turns in one run, timed by the
thread's own CPU time, so that a busy machine distorts little; medians and their ratio are in `extra_info`.
"""

import statistics
import time
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from coachable.replay import EventTableBuffer, StyleEvents
from coachable.styles import (
    ContinuousOneHot,
    Mixture,
    PointMass,
    StyleReward,
    StyleSpace,
    Uniform,
    Weight,
    WeightedSum,
)
from coachable.transforms import TaskImpersonation

BATCH = 256
STYLES = 18
ENVS = 32
OBSERVATION, ACTION = 256, 24  # of the order of the combat domain


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def combat_like_space() -> StyleSpace:
    """18 weights and the paper's mixture of styles."""
    high = [7.5, 0.375, 1.5, 1.8, 2.25, 7.5, 30.0] + [1.5] * 3 + [3.0] * 5 + [4.5] * 2 + [0.3]
    low = [-0.05 * b for b in high[:-1]] + [-0.3]
    mixture = Mixture([PointMass([0.0] * STYLES), Uniform(low, high), ContinuousOneHot(low, high)], [0.03, 0.10, 0.87])
    return StyleSpace([Weight(f"style{i}", a, b) for i, (a, b) in enumerate(zip(low, high, strict=True))], mixture)


SPACE = combat_like_space()
REWARD = StyleReward(SPACE, {"styles": WeightedSum(SPACE.names)})


def transitions(n: int) -> TensorDict:
    """`n` time-major steps of `ENVS` environments."""
    style = SPACE.sample((ENVS,)).repeat(n // ENVS, 1)
    flag = torch.zeros(n, 1, dtype=torch.bool)
    features = torch.rand(n, STYLES)
    return TensorDict(
        {
            "observation": torch.randn(n, OBSERVATION),
            "action": torch.rand(n, ACTION),
            "style": style,
            "done": flag,
            "terminated": flag,
            "truncated": flag,
            "next": {
                "observation": torch.randn(n, OBSERVATION),
                "style": style,
                "task_reward": torch.randn(n, 1),
                "style_features": features,
                "reward": torch.randn(n, 1),
                "events": torch.rand(n, STYLES + 1) < 0.02,
                "done": torch.rand(n, 1) < 0.002,
                "terminated": flag,
                "truncated": flag,
            },
        },
        [n],
    )


def stratified(prioritized: bool = False, **kwargs) -> EventTableBuffer:
    """20 tables: default, one per style, one for kills."""
    return EventTableBuffer.for_events(
        StyleEvents(SPACE, extra=["kill"]),
        capacity=40_000,
        event_capacity=1_000,
        event_horizon=10,
        num_envs=ENVS,
        batch_size=BATCH,
        prioritized=prioritized,
        **kwargs,
    )


def filled(**kwargs) -> EventTableBuffer:
    buffer = stratified(**kwargs)
    for _ in range(30):
        buffer.extend(transitions(64 * ENVS))
    return buffer


def alternate(first: Callable, second: Callable, rounds: int = 400) -> tuple[float, float]:
    """Median CPU seconds of two functions called in turn."""
    for _ in range(20):
        first(), second()
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for function, taken in zip((first, second), times, strict=True):
            start = time.thread_time()
            function()
            taken.append(time.thread_time() - start)
    return statistics.median(times[0]), statistics.median(times[1])


@pytest.mark.parametrize("prioritized", [False, True], ids=["uniform", "prioritised"])
def test_batch_from_20_tables(benchmark, prioritized):
    """At most twice the cost of a plain uniform batch of the same content (uniform within the tables)."""
    buffer = filled(prioritized=prioritized)
    plain = TensorDictReplayBuffer(storage=LazyTensorStorage(len(buffer)), batch_size=BATCH)
    plain.extend(buffer[:])
    assert len(buffer.names) == 20 and all(row["size"] for row in buffer.statistics().values())
    ours, theirs = alternate(buffer.sample, plain.sample)
    benchmark.extra_info.update(
        records=len(buffer), microseconds=ours * 1e6, plain_microseconds=theirs * 1e6, ratio=ours / theirs
    )
    benchmark.extra_info["samples_per_second"] = BATCH / ours
    benchmark(buffer.sample)
    if not prioritized:
        assert ours <= 2 * theirs, benchmark.extra_info


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 8])
def test_relabelling(benchmark, n):
    """The transform alone, and the batch with it against the batch without."""
    plain, relabelled = filled(), filled(transform=TaskImpersonation(REWARD, n=n))
    transform = TaskImpersonation(REWARD, n=n)
    batch = plain.sample()
    with_it, without = alternate(relabelled.sample, plain.sample, 300)
    alone, _ = alternate(lambda: transform(batch), lambda: None, 300)
    benchmark.extra_info.update(
        n=n,
        transform_microseconds=alone * 1e6,
        batch_microseconds=with_it * 1e6,
        plain_batch_microseconds=without * 1e6,
        labels_per_second=BATCH * (n + 1) / with_it,
    )
    benchmark(relabelled.sample)

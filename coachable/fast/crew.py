"""Threads that work on the independent parts of an update side by side."""

import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise

import torch

_FEWEST_ROWS = 32  # of a share


class _Size(threading.local):
    value = 1


_size = _Size()


def crew_size() -> int:
    """Return how many threads share the work: 1 outside of :func:`crew`, and in work that is shared out."""
    return _size.value


def cut_rows(rows: int, shares: int) -> list[slice]:
    """Return slices of nearly equal size that cover all rows.

    Args:
        rows: Number of rows.
        shares: Largest number of slices; few rows are cut into fewer.
    """
    shares = min(shares, max(1, rows // _FEWEST_ROWS))
    return [slice(start, stop) for start, stop in pairwise(rows * i // shares for i in range(shares + 1))]


@contextmanager
def crew(largest: int) -> Iterator[None]:
    """Let threads share the work inside the block, as many as torch has, while torch itself uses one.

    The kernels release Python's lock, so that threads of Python suffice. Torch's own threads would wait for the next
    operation in a loop that takes a core from the others.

    Args:
        largest: Most threads that share the work; with one nothing changes.
    """
    threads = torch.get_num_threads()
    if min(threads, largest) < 2 or _size.value > 1:
        yield
        return
    torch.set_num_threads(1)
    _size.value = min(threads, largest)
    try:
        yield
    finally:
        _size.value = 1
        torch.set_num_threads(threads)


def share_out(calls: Sequence[Callable[[], None]]) -> None:
    """Make all calls, each on a thread of the crew, the first one on this thread."""
    threads = _size.value
    if threads == 1:
        for call in calls:
            call()
        return
    others = [_pool(threads - 1).submit(call) for call in calls[1:]]
    _size.value = 1
    try:
        calls[0]()
    finally:
        _size.value = threads
        for other in others:
            other.result()


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    # Torch remembers its number of threads for each calling thread.
    return ThreadPoolExecutor(threads, "crew", initializer=functools.partial(torch.set_num_threads, 1))

import mmap

import torch

from coachable.fast.memory import Arena


def test_tensors_are_aligned_apart_and_writable():
    arena = Arena(chunk=4096)
    tensors = [arena.zeros(3, 5), arena.empty(7, dtype=torch.bfloat16), arena.zeros(100_000), arena.zeros(1)]
    for i, tensor in enumerate(tensors):
        assert tensor.data_ptr() % 64 == 0
        tensor.fill_(i)
    assert [t.shape for t in tensors] == [(3, 5), (7,), (100_000,), (1,)]
    assert [t.float().unique().tolist() for t in tensors] == [[0.0], [1.0], [2.0], [3.0]]


def test_memory_outlives_the_arena():
    tensor = Arena().zeros(1000)
    other = Arena().empty(1000).fill_(5.0)
    assert not tensor.any()
    assert other.sum() == 5000


def test_without_huge_pages(monkeypatch):
    monkeypatch.delattr(mmap, "MADV_HUGEPAGE", raising=False)
    assert Arena().zeros(10).tolist() == [0.0] * 10

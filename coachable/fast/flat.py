"""Gradients and rounded copies of a network's parameters, each kind in one contiguous buffer."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

_ALIGN = 32  # elements: one cache line of 64 bytes at bfloat16, so that products see aligned matrices


class FlatBuffers:
    """Gradients and rounded copies for the hand-written passes; the parameters themselves stay where they are.

    Args:
        tensors: Float tensors on one device, trained parameters or not.
        low_dtype: Dtype of the rounded copies; with `None` the passes use the tensors themselves.
        trained: Whether the passes compute gradients.

    Attributes:
        originals: The given tensors.
        tensors: The memory of the originals, without autograd.
        low: The rounded copies.
        grad: All gradients as one vector.
        grads: The gradients of the tensors, parts of `grad`.
    """

    def __init__(self, tensors: Sequence[Tensor], low_dtype: torch.dtype | None, trained: bool) -> None:
        self.rounds = low_dtype is not None
        self._low_dtype, self._trained = low_dtype, trained
        self.bind(tensors)

    def bind(self, tensors: Sequence[Tensor]) -> None:
        """Use other tensors, or the same ones after their memory was replaced. The gradients become zero.

        Args:
            tensors: As in the constructor. Kernels read rows, so others become contiguous in place.
        """
        for tensor in tensors:
            if not tensor.is_contiguous():
                tensor.data = tensor.data.contiguous()
        self.originals = list(tensors)
        self.tensors = [tensor.detach() for tensor in tensors]
        self.low = self.tensors if self._low_dtype is None else self._views(self._low_dtype)[1]
        self.grad, self.grads = self._views(self.tensors[0].dtype) if self._trained else (torch.zeros(0), [])
        self._versions: list[int] = []

    def refresh(self) -> None:
        """Round the tensors again if they changed. Changes through `.data` go unnoticed."""
        versions = [tensor._version for tensor in self.tensors]
        if self.rounds and versions != self._versions:
            torch._foreach_copy_(self.low, self.tensors)
            self._versions = versions

    def renewed(self) -> None:
        """Tell torch that a kernel changed the tensors, and remember that it rounded them again."""
        increment_version(self.tensors)
        self._versions = [tensor._version for tensor in self.tensors]

    def another_gradient(self) -> tuple[Tensor, list[Tensor]]:
        """Return a vector like `grad` `(n,)`, and its parts like `grads`."""
        return self._views(self.tensors[0].dtype)

    def _views(self, dtype: torch.dtype) -> tuple[Tensor, list[Tensor]]:
        """Return a buffer of zeros and its parts in the shapes of the tensors."""
        starts, total = [], 0
        for tensor in self.tensors:
            starts.append(total)
            total += -(-tensor.numel() // _ALIGN) * _ALIGN
        buffer = self.tensors[0].new_zeros(total, dtype=dtype)
        parts = zip(starts, self.tensors, strict=True)
        return buffer, [buffer[start : start + t.numel()].view(t.shape) for start, t in parts]

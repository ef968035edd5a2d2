"""`RowStorage`, a storage in memory that reads batches of rows quickly."""

from typing import Any

import torch
from tensordict import TensorDictBase, is_non_tensor
from torch import Tensor
from torchrl.data import LazyTensorStorage


class RowStorage(LazyTensorStorage):
    """`LazyTensorStorage` that reads rows with `index_select`, which copies a row at once instead of number by number.

    `benchmarks/test_replay.py` compares batches with those of a plain buffer.

    Examples:
        >>> from tensordict import TensorDict
        >>> storage = RowStorage(10)
        >>> storage.set(range(3), TensorDict({"x": torch.tensor([5, 6, 7])}, [3]))
        >>> storage.get(torch.tensor([2, 0]))["x"].tolist()
        [7, 5]
    """

    def get(self, indices: Any) -> Any:
        """Return the records at `indices`, which are read as by `LazyTensorStorage`."""
        if not self._has_rows(indices):
            return super().get(indices)
        indices = indices.to(self._storage.device)
        return self._storage.apply(lambda entry: entry.index_select(0, indices), batch_size=indices.shape)

    def _has_rows(self, indices: Any) -> bool:
        """Return whether `indices` are numbers of records in one dimension, none of them negative."""
        if not isinstance(self._storage, TensorDictBase) or not isinstance(indices, Tensor):
            return False
        if any(map(is_non_tensor, self._storage.values(True))):  # which `apply` leaves out
            return False
        if indices.dtype != torch.long or indices.ndim != 1 or not indices.numel():
            return False
        first, last = indices.aminmax()
        return bool(first >= 0) and bool(last < len(self))

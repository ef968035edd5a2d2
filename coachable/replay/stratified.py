"""Sampling of batches with an exact number of records per table, uniform or prioritised within a table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.data.replay_buffers import Storage
from torchrl.data.replay_buffers.samplers import Sampler

from coachable.replay.regions import Regions
from coachable.replay.sum_tree import SumTree

_EPSILON = 1e-8  # added to priorities, so that none is 0


def allot(batch_size: int, proportions: np.ndarray, available: np.ndarray) -> np.ndarray:
    """Divide a batch among the available tables by largest remainders of the renormalised proportions.

    A table whose quota is below 1 gets exactly 1 record, and the other tables share the rest of the batch. Among equal
    remainders the first table's counts as the largest.

    Args:
        batch_size: Number of records in the batch, B.
        proportions: Share of each table, `(tables,)`.
        available: Whether each table has records, `(tables,)` bool.

    Returns:
        Number of records per table, `(tables,)` int64, with sum `batch_size`; 0 for tables without records or share.

    Raises:
        ValueError: If no table is available, or more than `batch_size` are.

    Examples:
        >>> allot(10, np.array([0.5, 0.3, 0.2]), np.array([True, True, True])).tolist()
        [5, 3, 2]
        >>> allot(10, np.array([0.5, 0.3, 0.2]), np.array([True, False, True])).tolist()
        [7, 0, 3]
        >>> allot(4, np.array([0.98, 0.01, 0.01]), np.array([True, True, True])).tolist()
        [2, 1, 1]
    """
    sharing = available & (proportions > 0)
    counts = np.zeros(len(proportions), dtype=np.int64)
    if not sharing.any():
        raise ValueError("no table holds a record to sample: extend the buffer first")
    if sharing.sum() > batch_size:
        raise ValueError(
            f"a batch of {batch_size} cannot hold a record of each of {sharing.sum()} tables: raise batch_size, or "
            "give tables the proportion 0"
        )
    left = batch_size
    while True:
        # Remove float rounding: 0.3 * 10 is 3, not 2.9999999999999996.
        quota = np.round(proportions * sharing / proportions[sharing].sum() * left, 9)
        small = sharing & (quota < 1)
        if not small.any():
            break
        counts[small] = 1
        left -= int(small.sum())
        sharing = sharing & ~small
        if not sharing.any():
            break
    if sharing.any():
        floor = np.floor(quota).astype(np.int64)
        remainder = np.where(sharing, np.round(quota - floor, 9), -1.0)
        extra = np.argsort(-remainder, kind="stable")[: left - int(floor[sharing].sum())]
        counts[sharing] = floor[sharing]
        counts[extra] += 1
    return counts


@dataclass
class _Plan:
    """Tables of all batches of one size, valid until a table grows."""

    table: Tensor  # (B,) int64
    offset: Tensor  # (B,) int64, first slot of the record's table
    size: Tensor  # (B,) float64, live records of it


@dataclass(eq=False, repr=False)
class StratifiedSampler(Sampler):
    """Sampler that draws the same share of every batch from each table (paper, Stratified Sampling; Kompella 2023).

    Args:
        regions: The tables.
        proportions: Shares of the tables, `(tables,)`, which sum to 1.
        prioritized: Whether to draw within a table in proportion to priorities instead of uniformly.
        alpha: Exponent of the priorities.
        beta: Exponent of the importance weights; may be changed while training.
    """

    regions: Regions
    proportions: np.ndarray
    prioritized: bool = False
    alpha: float = 0.6
    beta: float = 0.4

    def __post_init__(self) -> None:
        self._plans: dict[tuple[int, torch.device], tuple[int, _Plan]] = {}
        self._tree: SumTree | None = None
        self._largest: Tensor | None = None
        self._pending_leaves: Tensor | None = None

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draw slots of the buffer's storage, grouped by table.

        Returns:
            Slots `(batch_size,)`, and a dictionary that contains `priority_weight` of that shape if prioritised. The
            weight is ``(n P(i))^-beta`` over the largest one of the batch. n is the number of records of the table,
            P(i) the probability within it.
        """
        device = getattr(storage, "device", None)
        device = device if isinstance(device, torch.device) else torch.device("cpu")
        plan = self._plan(batch_size, device)
        # float64, because a float32 draw reaches at most 2^24 different records.
        uniform = torch.rand(batch_size, dtype=torch.float64, device=device, generator=self._rng)
        info: dict[str, Any] = {}
        if not self.prioritized:
            return uniform.mul_(plan.size).long().add_(plan.offset), info
        tree = self._tree_on(device)
        slot = tree.draw(plan.table, uniform)
        probability = tree.get(slot) / tree.totals[plan.table]
        weight = (plan.size * probability).pow(-self.beta)
        info["priority_weight"] = (weight / weight.max()).float()
        return slot, info

    def can_sample(self, storage: Storage, batch_size: int) -> bool:
        """Return whether a batch of so many slots can be drawn."""
        try:
            self._allot(batch_size)
        except ValueError:
            return False
        return True

    def extend(self, index: Tensor) -> None:
        """Give new records, with the slots `index` `(k,)`, the largest priority so far."""
        if self.prioritized and len(index):
            tree = self._tree_on(index.device)
            tree.update(index, self._largest_priority(index.device).expand(len(index)))

    def update_priority(self, index: Any, priority: Any, *, storage: Storage | None = None) -> None:
        """Set priorities to `(|priority| + 1e-8)^alpha`; if a slot is given more than once, the largest counts.

        Args:
            index: Slots of any shape.
            priority: TD errors of the same shape, possibly with further dimensions, over which the largest counts.
            storage: Not used.

        Raises:
            RuntimeError: If the sampler is not prioritised.
            ValueError: If the priorities have another shape or, on a CPU, are not finite.
        """
        if not self.prioritized:
            raise RuntimeError("this buffer draws uniformly within its tables: priorities need prioritized=True")
        index = torch.as_tensor(index)
        priority = torch.as_tensor(priority, device=index.device).detach().abs().double().add(_EPSILON)
        if priority.ndim and priority.shape[: index.ndim] != index.shape:
            raise ValueError(f"priorities of shape {tuple(priority.shape)} for slots of shape {tuple(index.shape)}")
        if priority.device.type == "cpu" and not priority.isfinite().all():  # elsewhere it would wait for the device
            bad = int((~priority.isfinite()).sum())
            raise ValueError(f"{bad} of {priority.numel()} priorities are not finite: the loss has diverged")
        priority = priority.expand(index.shape) if not priority.ndim else priority.reshape(*index.shape, -1).amax(-1)
        priority = priority.pow(self.alpha)
        tree = self._tree_on(index.device)
        tree.update(index, priority)
        self._largest = torch.maximum(self._largest_priority(index.device), priority.max())

    def _allot(self, batch_size: int) -> np.ndarray:
        return allot(batch_size, self.proportions, self.regions.sizes > 0)

    def _plan(self, batch_size: int, device: torch.device) -> _Plan:
        version, plan = self._plans.get((batch_size, device), (-1, None))
        if plan is None or version != self.regions.version:
            regions = self.regions
            table = np.repeat(np.arange(len(regions)), self._allot(batch_size))
            columns = torch.from_numpy(np.stack([table, regions.offsets[table], regions.sizes[table]])).to(device)
            plan = _Plan(columns[0], columns[1], columns[2].double())
            self._plans[batch_size, device] = self.regions.version, plan
        return plan

    def _tree_on(self, device: torch.device) -> SumTree:
        if self._tree is None:
            self._tree = SumTree(self.regions.capacities, self.regions.offsets, device=device)
            if self._pending_leaves is not None:
                self._tree.load_leaves(self._pending_leaves.to(device))
                self._pending_leaves = None
        return self._tree

    def _largest_priority(self, device: torch.device) -> Tensor:
        if self._largest is None:
            self._largest = torch.tensor(1.0, dtype=torch.float64, device=device)
        return self._largest

    def _empty(self) -> None:
        self._plans.clear()
        self._tree = self._largest = self._pending_leaves = None

    def state_dict(self) -> dict[str, Any]:
        """Return the priorities, or an empty dictionary if the sampler is not prioritised."""
        if not self.prioritized:
            return {}
        tree = self._tree if self._tree is not None else self._tree_on(torch.device("cpu"))
        return {"priorities": tree.leaves(), "largest": self._largest_priority(tree.device).clone(), "beta": self.beta}

    def check(self, state_dict: Mapping[str, Any]) -> None:
        """Raise a `ValueError` if only one of this sampler and the saved one is prioritised."""
        if bool(state_dict) != self.prioritized:
            raise ValueError(
                f"the saved buffer was {'' if state_dict else 'not '}prioritised, this one is "
                f"{'' if self.prioritized else 'not '}prioritised: give the same value of prioritized"
            )

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned; see `check`."""
        self.check(state_dict)
        self._empty()
        if state_dict:
            self._pending_leaves = state_dict["priorities"].clone()
            self._largest = state_dict["largest"].clone()
            self.beta = state_dict["beta"]

    def dumps(self, path: Any) -> None:
        """Raise an error, because `EventTableBuffer.dumps` saves the state dict."""
        raise NotImplementedError("save the buffer (EventTableBuffer.dumps), not its sampler")

    def loads(self, path: Any) -> None:
        """Raise an error, because `EventTableBuffer.loads` restores the state dict."""
        raise NotImplementedError("load the buffer (EventTableBuffer.loads), not its sampler")

    def __repr__(self) -> str:
        shares = ", ".join(f"{n}={p:.3g}" for n, p in zip(self.regions.names, self.proportions, strict=True))
        return f"StratifiedSampler({shares}, prioritized={self.prioritized})"

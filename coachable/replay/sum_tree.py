"""Sum trees in pure torch, for proportional priorities (arXiv 1511.05952) on CPU and GPU.

TorchRL's `PrioritizedSampler` needs a compiled extension that torch 2.13 cannot load. A wide tree needs few kernels:
with 64 children per node, three levels are enough for 262,144 slots.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


class SumTree:
    """Priorities of the slots of several contiguous regions, and draws from a region in proportion to them.

    Every region has its own tree inside the same tensors, so that a draw never returns a slot of another region and the
    rounding of one region's sums does not depend on others. All sums are float64 and are recomputed from their
    children. They therefore do not drift, and a slot that is given twice counts once.

    Args:
        capacities: Number of slots of each region.
        offsets: First slot of each region.
        fanout: Number of children per node.
        device: Device of the tree.

    Examples:
        >>> tree = SumTree([3], [0])
        >>> tree.update(torch.tensor([0, 2]), torch.tensor([1.0, 3.0]))
        >>> tree.totals.tolist()
        [4.0]
        >>> tree.draw(torch.tensor([0, 0]), torch.tensor([0.1, 0.9], dtype=torch.float64)).tolist()
        [0, 2]
    """

    def __init__(
        self,
        capacities: Sequence[int] | np.ndarray,
        offsets: Sequence[int] | np.ndarray,
        fanout: int = 64,
        device: torch.device | str = "cpu",
    ) -> None:
        if fanout < 2:
            raise ValueError(f"fanout is {fanout}: expected at least 2")
        self.fanout = fanout
        self.device = torch.device(device)
        self.capacities = np.asarray(capacities, dtype=np.int64)
        self.offsets = np.asarray(offsets, dtype=np.int64)
        ascending = np.argsort(self.offsets)
        self._region_at = torch.as_tensor(ascending, device=self.device)
        self._boundaries = torch.as_tensor(self.offsets[ascending][1:], device=self.device)
        self._offsets = torch.as_tensor(self.offsets, device=self.device)
        # levels[l] has one row of children per node of level l + 1; the last level has one row per region.
        self.levels: list[Tensor] = []
        self._first_row: list[Tensor] = []
        rows = self.capacities
        while not self.levels or (rows > 1).any():
            rows = -(-rows // fanout)
            self.levels.append(torch.zeros(int(rows.sum()), fanout, dtype=torch.float64, device=self.device))
            self._first_row.append(torch.as_tensor(np.cumsum(rows) - rows, device=self.device))

    @property
    def totals(self) -> Tensor:
        """Sum of the priorities of each region, `(regions,)` float64."""
        return self.levels[-1].sum(-1)

    def update(self, slot: Tensor, priority: Tensor) -> None:
        """Set priorities.

        Args:
            slot: Slots of any shape; if one is repeated, the largest of its priorities counts.
            priority: Non-negative priorities of the same shape.
        """
        slot = slot.reshape(-1).to(self.device)
        priority = priority.detach().reshape(-1).to(self.device, torch.float64)
        region, entry = self._locate(slot)
        leaves = self.levels[0].view(-1)
        leaves.index_fill_(0, entry, 0.0)
        leaves.scatter_reduce_(0, entry, priority, "amax")
        for level in range(len(self.levels) - 1):
            row = entry.div(self.fanout, rounding_mode="floor")
            entry = row - self._first_row[level][region] + self._first_row[level + 1][region] * self.fanout
            self.levels[level + 1].view(-1)[entry] = self.levels[level][row].sum(-1)

    def get(self, slot: Tensor) -> Tensor:
        """Return the priorities of slots, float64 of the same shape."""
        _, entry = self._locate(slot.to(self.device))
        return self.levels[0].view(-1)[entry]

    def draw(self, region: Tensor, uniform: Tensor) -> Tensor:
        """Draw slots in proportion to their priority; a slot of priority 0 is never drawn.

        Args:
            region: Region of each draw, `(draws,)`; each must have a priority above 0.
            uniform: Uniform numbers `(draws,)`, float64 in [0, 1).

        Returns:
            Slots `(draws,)`.
        """
        row = region
        entry = region
        for level in reversed(range(len(self.levels))):
            children = self.levels[level][row]  # (draws, fanout)
            upper = children.cumsum(-1)
            total = upper[:, -1]
            # u < 1, but u * total may round up to total, which belongs to no child.
            target = torch.minimum(uniform * total, torch.nextafter(total, torch.zeros_like(total))).unsqueeze(-1)
            child = torch.searchsorted(upper, target, right=True)
            share = children.gather(-1, child)
            below = upper.gather(-1, child) - share
            # The rest of the number, scaled to [0, 1), selects among the children of the child.
            uniform = ((target - below) / share).clamp(0.0, 1.0 - 2.0**-53).squeeze(-1)
            entry = (row - self._first_row[level][region]) * self.fanout + child.squeeze(-1)
            if level:
                row = self._first_row[level - 1][region] + entry
        return self._offsets[region] + entry

    def leaves(self) -> Tensor:
        """Return all priorities by slot, float64 `(slots,)`."""
        return self.get(torch.arange(int(self.capacities.sum()), device=self.device))

    def load_leaves(self, leaves: Tensor) -> None:
        """Restore the priorities `(slots,)` that `leaves` returned."""
        self.update(torch.arange(leaves.numel(), device=self.device), leaves)

    def _locate(self, slot: Tensor) -> tuple[Tensor, Tensor]:
        region = self._region_at[torch.bucketize(slot, self._boundaries, right=True)]
        return region, self._first_row[0][region] * self.fanout + slot - self._offsets[region]

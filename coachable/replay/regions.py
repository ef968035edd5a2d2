"""Contiguous regions of one storage, one per table, each with its own FIFO cursor."""

from collections.abc import Mapping
from typing import Any

import numpy as np


class Regions:
    """Positions of the records of each table in one storage.

    Regions have the reverse order of the tables. The first table is usually by far the largest. Because it comes last,
    the used prefix of the storage, which checkpoints write, stays short while the buffer fills.

    Args:
        capacities: Number of records of each table, by name.

    Raises:
        ValueError: If there is no table, or a capacity is not a positive integer.

    Examples:
        >>> regions = Regions({"default": 4, "melee": 2})
        >>> regions.allocate(np.array([0, 0, 1]))[0].tolist()
        [2, 3, 0]
        >>> regions.sizes.tolist()
        [2, 1]
    """

    def __init__(self, capacities: Mapping[str, int]) -> None:
        if not capacities:
            raise ValueError("table_capacities is empty: expected at least one table, such as {'default': 100_000}")
        for name, capacity in capacities.items():
            if isinstance(capacity, bool) or not isinstance(capacity, int | np.integer) or capacity <= 0:
                raise ValueError(f"table_capacities[{name!r}] is {capacity!r}: expected a positive integer")
        self.names = tuple(capacities)
        self.capacities = np.array(list(capacities.values()), dtype=np.int64)
        ends = np.cumsum(self.capacities[::-1])[::-1]
        self.offsets = ends - self.capacities
        self.total = int(self.capacities.sum())
        self.written = np.zeros(len(self.names), dtype=np.int64)
        self.version = 0  # increases with every change of a size, so that samplers can cache what depends on sizes

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sizes(self) -> np.ndarray:
        """Number of live records of each table, `(tables,)`."""
        return np.minimum(self.written, self.capacities)

    @property
    def used_prefix(self) -> int:
        """Number of slots up to and including the last one that was ever written."""
        sizes = self.sizes
        return int((self.offsets + sizes)[sizes > 0].max(initial=0))

    def allocate(self, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the next slots, first in first out.

        Args:
            table: Table of each record, `(records,)`, in the order in which they are appended.

        Returns:
            Slots `(records,)`, or -1 for a record that a later one of the same call replaces because the table is too
            small for all of them. Serial numbers `(records,)`, which count all records ever appended to the table.
        """
        counts = np.bincount(table, minlength=len(self))
        order = np.argsort(table, kind="stable")
        rank = np.empty_like(order)
        rank[order] = np.arange(len(table)) - (np.cumsum(counts) - counts)[table[order]]
        serial = self.written[table] + rank
        slot = self.offsets[table] + serial % self.capacities[table]
        slot[rank < (counts - self.capacities)[table]] = -1
        before = self.sizes
        self.written += counts
        self.version += int((before != self.sizes).any())
        return slot, serial

    def table_of(self, slot: np.ndarray) -> np.ndarray:
        """Return the table of each slot, `(slots,)`."""
        ascending = np.argsort(self.offsets)
        return ascending[np.searchsorted(self.offsets[ascending], slot, side="right") - 1]

    def slots(self, table: int) -> np.ndarray:
        """Return the slots `(records,)` int of the live records of one table, oldest first."""
        size, written = int(self.sizes[table]), int(self.written[table])
        return self.offsets[table] + np.arange(written - size, written) % self.capacities[table]

    def unused(self) -> np.ndarray:
        """Return whether each slot of the used prefix was never written, `(used_prefix,)` bool."""
        unused = np.ones(self.used_prefix, dtype=bool)
        for table in range(len(self)):
            unused[self.slots(table)] = False
        return unused

    def clear(self) -> None:
        """Drop every record."""
        self.written[:] = 0
        self.version += 1

    def state_dict(self) -> dict[str, Any]:
        """Return the names, capacities and write counts of the tables."""
        return {"names": list(self.names), "capacities": self.capacities.tolist(), "written": self.written.tolist()}

    def check(self, state: Mapping[str, Any]) -> None:
        """Raise a `ValueError` if the tables differ from the saved ones."""
        saved = dict(zip(state["names"], state["capacities"], strict=True))
        present = dict(zip(self.names, self.capacities.tolist(), strict=True))
        if list(saved.items()) != list(present.items()):
            raise ValueError(
                f"the saved tables are {saved}, this buffer's are {present}: give the same table_capacities "
                "in the same order"
            )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the cursors; see `check`."""
        self.check(state)
        self.written[:] = state["written"]
        self.version += 1

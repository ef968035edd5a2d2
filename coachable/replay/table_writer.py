"""Writes steps to their tables: n-step assembly, routing, and copies of the windows before events."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, Writer

from coachable.keys import TABLE
from coachable.replay.n_step import NStep
from coachable.replay.regions import Regions
from coachable.replay.routing import EventPredicate, Route, checked_events, checked_route
from coachable.replay.steps import Steps, flatten_time_major, read_steps
from coachable.replay.windows import Copies, WindowHistory

__all__ = ["TableWriter"]


class TableWriter(Writer):
    """Writer of an `EventTableBuffer`; it owns the cursors of the tables and what is known about open episodes.

    Args:
        regions: The tables, those that steps are routed to first, then the event tables.
        route: Table of each step; None if there is only one.
        events: Event predicate; None without event tables.
        horizon: H_max.
        n_step: n-step assembly; None for one-step transitions.
        num_envs: Environments in a batch, None if the data tells.
    """

    _storage: LazyTensorStorage  # set when the buffer registers it

    def __init__(
        self,
        regions: Regions,
        route: Route | None,
        events: EventPredicate | None,
        horizon: int,
        n_step: NStep | None,
        num_envs: int | None,
    ) -> None:
        super().__init__()
        self.regions = regions
        self.route = route
        self.events = events
        self.n_step = n_step
        self.num_envs = num_envs
        self.base_tables = len(route.names) if route is not None else 1
        # Whoever was silent for longer than the routed tables remember has nothing left there to look back at.
        kept = int(regions.capacities[: self.base_tables].sum())
        self.history = WindowHistory(len(events.names), horizon, patience=kept) if events is not None else None
        if n_step is not None:
            n_step.patience = kept
        self._arrived = 0
        self._fired = np.zeros(len(regions), dtype=np.int64)
        self._lost = np.zeros(len(regions), dtype=np.int64)

    @property
    def _write_count(self) -> int:
        """Steps written, each counted once however many tables hold it. Collectors read this."""
        return int(self.regions.written[: self.base_tables].sum())

    def add(self, data: TensorDictBase) -> Tensor:
        """Write one step."""
        return self.extend(data.unsqueeze(0))

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write a batch of steps.

        Args:
            data: `(steps,)`, time-major, or `(num_envs, time)`.

        Returns:
            Slots written to, those of the steps themselves before those of their copies in event tables.
        """
        rows, found_envs = flatten_time_major(data)
        rows = rows.exclude("index", TABLE)
        device = getattr(self._storage, "device", None)
        if isinstance(device, torch.device) and rows.device != device:
            rows = rows.to(device)
        if not len(rows):
            return torch.zeros(0, dtype=torch.long)
        if self.history is None and self.n_step is None:
            steps = Steps.unrelated(len(rows))
        else:
            steps = read_steps(rows, found_envs if found_envs is not None else self.num_envs, self._arrived)
        self._arrived += len(rows)
        # Events and routes are those of the step itself, hence evaluated before n-step assembly replaces its future.
        if self.events is not None:
            steps.fired = checked_events(self.events, rows).cpu().numpy()
        if self.route is not None:
            steps.route = checked_route(self.route, rows).to("cpu", torch.int64).numpy()
        if self.n_step is not None:
            rows, steps = self.n_step.push(rows, steps)
        return self._write(rows, steps)

    def finish(self) -> Tensor:
        """End every open episode where its data ends; held back steps are written, no window reaches back over it.

        Returns:
            Slots written to.
        """
        rest = self.n_step.flush() if self.n_step is not None else None
        slots = self._write(*rest) if rest is not None else torch.zeros(0, dtype=torch.long)
        if self.history is not None:
            self.history.clear()
        return slots

    def _write(self, rows: TensorDictBase, steps: Steps) -> Tensor:
        if not len(steps):
            return torch.zeros(0, dtype=torch.long)
        before = self.regions.written.copy()
        slot, serial = self.regions.allocate(steps.route)
        parts = [(slot, rows)]
        if self.history is not None:
            parts += self._copies(self.history.update(steps, slot, serial), rows, before)
            self._fired[self.base_tables :] += steps.fired.sum(0)
        return torch.cat([self._put(*part) for part in parts])

    def _copies(
        self, copies: Copies, rows: TensorDictBase, before: np.ndarray
    ) -> list[tuple[np.ndarray, TensorDictBase]]:
        """Records to append to event tables, read before the batch overwrites anything."""
        table = copies.table + self.base_tables
        home = self.regions.table_of(np.maximum(copies.slot, 0))
        # A step that its own table has dropped meanwhile can no longer be copied.
        lost = (copies.row < 0) & (copies.serial + self.regions.capacities[home] < before[home])
        self._lost += np.bincount(table[lost], minlength=len(self.regions))
        target = np.full(len(table), -1)
        target[~lost], _ = self.regions.allocate(table[~lost])
        here, there = (target >= 0) & (copies.row >= 0), (target >= 0) & (copies.row < 0)
        parts = []
        if here.any():
            parts.append((target[here], rows[self._index(copies.row[here])]))
        if there.any():
            parts.append((target[there], self._stored(copies.slot[there])))
        return parts

    def _put(self, slot: np.ndarray, rows: TensorDictBase) -> Tensor:
        kept = slot >= 0  # the others have already been replaced within this batch
        if not kept.all():
            rows, slot = rows[self._index(np.flatnonzero(kept))], slot[kept]
        index = self._index(slot)
        # A run of slots is written several times faster as a slice.
        run = slot[-1] - slot[0] + 1 == len(slot) and bool((np.diff(slot) == 1).all())
        storage = self._storage
        storage.set(slice(int(slot[0]), int(slot[-1]) + 1) if run else index, rows, set_cursor=False)  # type: ignore[arg-type]
        # TorchRL takes the first `_len` slots for the filled ones; `_last_cursor` only keeps its checkpointer quiet.
        storage._len = self.regions.used_prefix
        if storage._last_cursor is None:
            storage._set_last_cursor(0)
        return index

    def _stored(self, slot: np.ndarray) -> TensorDictBase:
        return self._storage.get(self._index(slot))  # type: ignore[arg-type]

    def _index(self, rows: np.ndarray) -> Tensor:
        device = getattr(self._storage, "device", None)
        return torch.from_numpy(rows).to(device if isinstance(device, torch.device) else "cpu")

    def statistics(self) -> dict[str, dict[str, int | float]]:
        """Per table: `size`, `capacity`, `fill`, records `written` and `evicted`, `events` admitted, copies `lost`."""
        sizes = self.regions.sizes
        return {
            name: {
                "size": int(sizes[i]),
                "capacity": int(self.regions.capacities[i]),
                "fill": float(sizes[i] / self.regions.capacities[i]),
                "written": int(self.regions.written[i]),
                "evicted": int(self.regions.written[i] - sizes[i]),
                "events": int(self._fired[i]),
                "lost": int(self._lost[i]),
            }
            for i, name in enumerate(self.regions.names)
        }

    def _empty(self, empty_write_count: bool = True) -> None:
        self.regions.clear()
        self._arrived = 0
        self._fired[:] = 0
        self._lost[:] = 0
        if self.history is not None:
            self.history.clear()
        if self.n_step is not None:
            self.n_step.clear()

    def state_dict(self) -> dict[str, Any]:
        """Return the cursors, the open episodes and the steps that are held back."""
        return {
            "regions": self.regions.state_dict(),
            "arrived": self._arrived,
            "fired": self._fired.tolist(),
            "lost": self._lost.tolist(),
            "history": self.history.state_dict() if self.history is not None else {},
            "n_step": self.n_step.state_dict() if self.n_step is not None else {},
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            ValueError: If the tables or the horizon are others than the saved ones.
        """
        self.regions.load_state_dict(state_dict["regions"])
        self._arrived = state_dict["arrived"]
        self._fired[:] = state_dict["fired"]
        self._lost[:] = state_dict["lost"]
        if self.history is not None:
            self.history.load_state_dict(state_dict["history"])
        if self.n_step is not None:
            device = getattr(self._storage, "device", None)
            self.n_step.load_state_dict(state_dict["n_step"], device if isinstance(device, torch.device) else None)

    def dumps(self, path: Any) -> None:
        """Not used: `EventTableBuffer.dumps` saves the state dict."""
        raise NotImplementedError("save the buffer (EventTableBuffer.dumps), not its writer")

    def loads(self, path: Any) -> None:
        """Not used: `EventTableBuffer.loads` restores the state dict."""
        raise NotImplementedError("load the buffer (EventTableBuffer.loads), not its writer")

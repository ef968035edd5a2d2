"""Writer of steps to their tables, with n-step assembly, routing, and copies of the windows before events."""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, Writer

from coachable.keys import TABLE
from coachable.replay.n_step import NStep
from coachable.replay.regions import Regions
from coachable.replay.routing import EventPredicate, Route, checked_events, checked_route
from coachable.replay.steps import TRAJECTORY, Steps, flatten_time_major, read_steps
from coachable.replay.windows import Copies, WindowHistory


class TableWriter(Writer):
    """Writer of an `EventTableBuffer`, which contains the cursors of the tables and the state of open episodes.

    Args:
        regions: The tables: routed tables, then event tables.
        route: Route of the steps; None if there is one routed table.
        events: Event predicate; None without event tables.
        horizon: H_max.
        n_step: n-step assembly; None for one-step transitions.
        num_envs: Number of environments in a batch; None if batches are `(num_envs, time)` or have trajectory numbers.
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
        # After so many steps without a step of a stream, the routed tables no longer contain any step of it.
        kept = int(regions.capacities[: self.base_tables].sum())
        self.history = WindowHistory(len(events.names), horizon, patience=kept) if events is not None else None
        if n_step is not None:
            n_step.patience = kept
        self._arrived = 0
        self._fired = np.zeros(len(regions), dtype=np.int64)
        self._lost = np.zeros(len(regions), dtype=np.int64)

    @property
    def _device(self) -> torch.device | None:
        device = getattr(self._storage, "device", None)  # "auto" before the first record
        return device if isinstance(device, torch.device) else None

    @property
    def _write_count(self) -> int:
        """Number of steps written, without copies; collectors read it."""
        return int(self.regions.written[: self.base_tables].sum())

    def add(self, data: TensorDictBase) -> Tensor:
        """Write one step of batch shape `()`, and return the slots `(k,)` of its records."""
        return self.extend(data.unsqueeze(0))

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write a batch of steps; see `EventTableBuffer.extend`."""
        rows, found_envs = flatten_time_major(data)
        rows = rows.exclude("index", TABLE)
        if self._device is not None and rows.device != self._device:
            rows = rows.to(self._device)
        if not len(rows):
            return torch.zeros(0, dtype=torch.long)
        if self.history is None and self.n_step is None:
            steps = Steps.unrelated(len(rows))
        else:
            if found_envs and self.num_envs not in (None, found_envs) and rows.get(TRAJECTORY, None) is None:
                raise ValueError(
                    f"extend got a batch of shape {tuple(data.shape)}, and the buffer has num_envs={self.num_envs}: "
                    "expected (num_envs, time)"
                )
            steps = read_steps(rows, found_envs if found_envs is not None else self.num_envs, self._arrived)
        self._arrived += len(rows)
        # Evaluated before n-step assembly, because events and routes are those of the step itself.
        if self.events is not None:
            steps.fired = checked_events(self.events, rows).cpu().numpy()
        if self.route is not None:
            steps.route = checked_route(self.route, rows).to("cpu", torch.int64).numpy()
        if self.n_step is not None:
            rows, steps = self.n_step.push(rows, steps)
        return self._write(rows, steps)

    def finish(self, streams: np.ndarray | None = None) -> Tensor:
        """End the open episodes of some streams `(k,)` int, or of all; see `EventTableBuffer.finish`."""
        rest = self.n_step.flush(streams) if self.n_step is not None else None
        slots = self._write(*rest) if rest is not None else torch.zeros(0, dtype=torch.long)
        if self.history is not None:
            self.history.clear(streams)
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
        """Return the records to append to event tables, read before the batch overwrites any."""
        table = copies.table + self.base_tables
        home = self.regions.table_of(np.maximum(copies.slot, 0))
        # A step that its routed table no longer contains, or never did, cannot be copied.
        overwritten = copies.serial + self.regions.capacities[home] < before[home]
        lost = (copies.row < 0) & ((copies.slot < 0) | overwritten)
        self._lost += np.bincount(table[lost], minlength=len(self.regions))
        target = np.full(len(table), -1)
        target[~lost], _ = self.regions.allocate(table[~lost])
        here, there = (target >= 0) & (copies.row >= 0), (target >= 0) & (copies.row < 0)
        parts = []
        if here.any():
            parts.append((target[here], rows[self._index(copies.row[here])]))
        if there.any():
            parts.append((target[there], self._storage.get(self._index(copies.slot[there]))))  # type: ignore[arg-type]
        return parts

    def _put(self, slot: np.ndarray, rows: TensorDictBase) -> Tensor:
        kept = slot >= 0  # later records of this batch replace the others
        if not kept.all():
            rows, slot = cast(TensorDictBase, rows[self._index(np.flatnonzero(kept))]), slot[kept]
        index = self._index(slot)
        # Transforms of samples read it, such as `TaskImpersonation`.
        rows = rows.copy().set(TABLE, self._index(self.regions.table_of(slot)))
        # Writing consecutive slots as a slice is several times faster.
        run = slot[-1] - slot[0] + 1 == len(slot) and bool((np.diff(slot) == 1).all())
        storage = self._storage
        storage.set(slice(int(slot[0]), int(slot[-1]) + 1) if run else index, rows, set_cursor=False)  # type: ignore[arg-type]
        # TorchRL treats the first `_len` slots as filled, and its checkpointer needs a `_last_cursor`.
        storage._len = self.regions.used_prefix
        if storage._last_cursor is None:
            storage._set_last_cursor(0)
        return index

    def _index(self, rows: np.ndarray) -> Tensor:
        return torch.from_numpy(rows).to(self._device or "cpu")

    def statistics(self) -> dict[str, dict[str, int]]:
        """Return for each table its `size`, the number of `events` so far, and of `lost` copies."""
        counts = zip(self.regions.names, self.regions.sizes, self._fired, self._lost, strict=True)
        return {
            name: {"size": int(size), "events": int(fired), "lost": int(lost)} for name, size, fired, lost in counts
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
            "sums": self._sums,
        }

    @property
    def _sums(self) -> list[float | None]:
        return [1, None] if self.n_step is None else [self.n_step.n_steps, self.n_step.gamma]

    def check(self, state_dict: Mapping[str, Any]) -> None:
        """Raise a `ValueError` if the tables, the horizon, or steps and discount of n-step sums differ from saved ones.

        Checkpoints of earlier versions do not contain steps and discount.
        """
        self.regions.check(state_dict["regions"])
        if self.history is not None:
            self.history.check(state_dict["history"])
        saved = list(state_dict.get("sums", self._sums))
        if saved != self._sums:
            raise ValueError(
                "the saved buffer has n_steps={} and gamma={}, this one n_steps={} and gamma={}: make it like the "
                "saved one".format(*saved, *self._sums)
            )

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned; see `check`."""
        self.check(state_dict)
        self.regions.load_state_dict(state_dict["regions"])
        self._arrived = state_dict["arrived"]
        self._fired[:] = state_dict["fired"]
        self._lost[:] = state_dict["lost"]
        if self.history is not None:
            self.history.load_state_dict(state_dict["history"])
        if self.n_step is not None:
            self.n_step.load_state_dict(state_dict["n_step"], self._device)

    def dumps(self, path: Any) -> None:
        """Raise an error, because `EventTableBuffer.dumps` saves the state dict."""
        raise NotImplementedError("save the buffer (EventTableBuffer.dumps), not its writer")

    def loads(self, path: Any) -> None:
        """Raise an error, because `EventTableBuffer.loads` restores the state dict."""
        raise NotImplementedError("load the buffer (EventTableBuffer.loads), not its writer")

"""Windows of steps that are copied to the table of an event, within the event's episode."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from coachable.replay.steps import Episodes, Steps

Array = np.ndarray


@dataclass
class Copies:
    """Steps to append to event tables, in the order in which they are appended."""

    table: np.ndarray  # (copies,) event number
    row: np.ndarray  # (copies,) row of the present batch, or -1
    slot: np.ndarray  # (copies,) slot of the storage if row is -1, otherwise -1
    serial: np.ndarray  # (copies,) serial number of the record, which shows whether the slot still contains it


class WindowHistory:
    """Finder of the at most `horizon` steps up to an event that the event's table does not contain yet.

    The window is the event step and the `horizon - 1` steps before it (tau = H_max - 1 in SSET, Kompella 2023). It
    begins no earlier than the episode, and after the previous event of the same table, whose window contains the steps
    before. Between batches the history keeps, for every open episode, the slots of the last `horizon - 1` steps and the
    last step at which each event fired.

    Args:
        events: Number of event tables.
        horizon: H_max.
        patience: Number of steps without a step of a stream after which the stream is dropped, because its steps are no
            longer in the storage.
    """

    def __init__(self, events: int, horizon: int, patience: int = 2**62) -> None:
        self.events = events
        self.horizon = horizon
        self.patience = patience
        self.clear()

    def clear(self, streams: Array | None = None) -> None:
        """Drop the open episodes of some streams `(k,)` int, or of all."""
        if streams is None:
            self._allocate(1)
            return
        rows = self._find(streams)
        self.key[rows[rows >= 0]] = -1
        self._sorted = None

    def update(self, steps: Steps, slot: np.ndarray, serial: np.ndarray) -> Copies:
        """Add a batch.

        Args:
            steps: The batch.
            slot: Slot in which each step is going to be stored, `(steps,)`.
            serial: Serial number of each record, `(steps,)`.

        Returns:
            Steps to append to the event tables, in the order of the tables, of the events' times, and of the steps.
        """
        cut = steps.in_episodes()
        first = np.flatnonzero(cut.first_of_stream)
        known = self._find(cut.stream[first])

        # Rows of continued episodes, and their lengths before this batch.
        kept = np.full(len(cut.start), -1)
        kept[cut.number[first]] = known
        before = np.where(kept >= 0, self.length[kept], 0)
        position = np.arange(len(steps)) - cut.start[cut.number] + before[cut.number]

        fired = steps.fired[cut.order]
        table, at = np.nonzero(fired.T)  # by table, then by stream and time
        copies = self._windows(cut, table, at, position, kept, before)
        self._remember(cut, table, at, position, kept, known, first, slot, serial, steps)
        return copies

    def _windows(self, cut: Episodes, table: Array, at: Array, position: Array, kept: Array, before: Array) -> Copies:
        """Return the steps to copy for each event, which fired at the sorted position `at`."""
        place = kept[cut.number[at]]
        previous = np.where(place >= 0, self.last_event[place, table], -1)
        again = (table[1:] == table[:-1]) & (cut.number[at[1:]] == cut.number[at[:-1]])
        previous[1:][again] = position[at[:-1]][again]
        begin = np.maximum(position[at] - self.horizon + 1, previous + 1).clip(0)

        by_time = np.lexsort((cut.order[at], table))
        table, at, begin = table[by_time], at[by_time], begin[by_time]
        count = position[at] - begin + 1
        event = np.repeat(np.arange(len(at)), count)
        wanted = begin[event] + np.arange(len(event)) - (np.cumsum(count) - count)[event]  # position in the episode
        at = at[event]
        episode = cut.number[at]
        here = wanted >= before[episode]
        row = np.full(len(event), -1)
        row[here] = cut.order[(at - position[at] + wanted)[here]]
        slot, serial = np.full(len(event), -1), np.full(len(event), -1)
        if not here.all():
            past = ~here
            ring = wanted[past] % (self.horizon - 1)
            slot[past] = self.slot[kept[episode[past]], ring]
            serial[past] = self.serial[kept[episode[past]], ring]
        return Copies(table[event], row, slot, serial)

    def _remember(
        self,
        cut: Episodes,
        table: Array,
        at: Array,
        position: Array,
        kept: Array,
        known: Array,
        first: Array,
        slot: Array,
        serial: Array,
        steps: Steps,
    ) -> None:
        """Store the episodes that are open after the batch."""
        streams = len(first)
        stream_of = np.cumsum(cut.first_of_stream) - 1
        last = np.append(first[1:] - 1, len(position) - 1)
        episode = cut.number[last]  # the one that may continue
        is_open = ~cut.ends[last]

        closing = (known >= 0) & ~is_open
        if closing.any():
            self.key[known[closing]] = -1
            self._sorted = None
        place = np.where(is_open, known, -1)
        self.arrival[place[place >= 0]] = steps.arrival.max()  # before `_open`, which frees rows of dropped streams
        fresh = is_open & (known < 0)
        if fresh.any():
            place[fresh] = self._open(cut.stream[first[fresh]], int(steps.arrival.max()))

        latest = np.full((streams, self.events), -1)
        going_on = kept[episode] >= 0
        latest[going_on] = self.last_event[kept[episode[going_on]]]
        current = cut.number[at] == episode[stream_of[at]]
        np.maximum.at(latest, (stream_of[at[current]], table[current]), position[at[current]])

        self.length[place[is_open]] = position[last[is_open]] + 1
        self.last_event[place[is_open]] = latest[is_open]
        if self.horizon > 1:
            recent = is_open[stream_of] & (cut.number == episode[stream_of])
            recent &= position > position[last[stream_of]] - (self.horizon - 1)
            rows = np.flatnonzero(recent)
            target = place[stream_of[rows]], position[rows] % (self.horizon - 1)
            self.slot[target] = slot[cut.order[rows]]
            self.serial[target] = serial[cut.order[rows]]

    # Open episodes are rows of these arrays; a free row has key -1.

    def _allocate(self, rows: int) -> None:
        self.key = np.full(rows, -1)
        self.length = np.zeros(rows, dtype=np.int64)
        self.arrival = np.zeros(rows, dtype=np.int64)
        self.last_event = np.full((rows, self.events), -1)
        self.slot = np.full((rows, self.horizon - 1), -1)
        self.serial = np.full((rows, self.horizon - 1), -1)
        self._sorted: tuple[np.ndarray, np.ndarray] | None = None

    def _find(self, key: np.ndarray) -> np.ndarray:
        if self._sorted is None:
            order = np.argsort(self.key)
            self._sorted = order, self.key[order]
        order, ascending = self._sorted
        at = np.searchsorted(ascending, key).clip(max=len(ascending) - 1)
        return np.where(ascending[at] == key, order[at], -1)

    def _open(self, key: np.ndarray, now: int) -> np.ndarray:
        self.key[self.arrival < now - self.patience] = -1
        free = np.flatnonzero(self.key < 0)
        if len(free) < len(key):
            old = self.state_dict()
            rows = len(self.key)
            self._allocate(max(2 * rows, rows + len(key)))
            for name, value in old.items():
                getattr(self, name)[:rows] = value.numpy()
            free = np.flatnonzero(self.key < 0)
        place = free[: len(key)]
        self.key[place] = key
        self.arrival[place] = now
        self._sorted = None
        return place

    def state_dict(self) -> dict[str, Any]:
        """Return the open episodes as tensors."""
        names = ("key", "length", "arrival", "last_event", "slot", "serial")
        return {name: torch.from_numpy(getattr(self, name).copy()) for name in names}

    def check(self, state: dict[str, Any]) -> None:
        """Raise a `ValueError` if the horizon or the number of event tables differs from the saved one."""
        events, horizon = state["last_event"].shape[1], state["slot"].shape[1] + 1
        if (events, horizon) != (self.events, self.horizon):
            raise ValueError(
                f"the saved history has {events} event tables and event_horizon {horizon}, this buffer "
                f"{self.events} and {self.horizon}: make it like the saved one"
            )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned; see `check`."""
        self.check(state)
        self._allocate(len(state["last_event"]))
        for name, value in state.items():
            getattr(self, name)[:] = value.cpu().numpy()

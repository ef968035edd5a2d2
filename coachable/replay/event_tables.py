"""Replay buffer with event tables and multi-tables (paper, Appendix B, Stratified Sampling)."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from coachable.ranges import NOT_NEGATIVE, Range
from coachable.replay.n_step import NStep
from coachable.replay.replay_files import read_replay, write_replay
from coachable.replay.routing import EventPredicate, KeyRoute, Route
from coachable.replay.row_storage import RowStorage
from coachable.replay.stratified import StratifiedSampler, allot
from coachable.replay.table_settings import checked_horizon, checked_proportions, make_regions
from coachable.replay.table_writer import TableWriter


class EventTableBuffer(TensorDictReplayBuffer):
    """Replay buffer of several first-in-first-out tables, each of which fills an exact share of every batch.

    Every step is stored in one routed table: the table "default", or with `route` the table of its scenario
    (multi-tables). When an event fires, its step and the steps before it are also copied to the event's table (event
    tables). These are at most `event_horizon` steps of the same episode, without those that the table already contains.
    Copies keep their labels, and they stay after the default table has dropped the originals.

    Batches `(steps,)` are read as time-major: all environments at one time, then at the next. Batches `(num_envs,
    time)` are read as TorchRL's collectors yield them. Trajectory numbers, `("collector", "traj_ids")`, override both.
    Episodes may span any number of `extend` calls, and batches of several workers may be interleaved if they contain
    trajectory numbers. Everything runs in the process that calls `extend`.

    Samples contain `index` and `table`, the number of the table in `names`.

    Args:
        table_capacities: Number of records of each table, by name: routed tables and event tables.
        events: Event predicate, which defines the event tables (`coachable.replay.routing`).
        event_horizon: H_max, number of steps stored per event, including its own. Needed with `events`.
        route: Route, which defines the routed tables; None for one table, "default".
        table_proportions: Share of each table in a batch. By default event tables share one half equally, routed tables
            the other (our choice).
        num_envs: Number of environments in a batch `(steps,)` without trajectory numbers.
        n_steps: Number of steps summed into one transition, before routing; see `coachable.replay.n_step.NStep`.
        gamma: Discount of that sum.
        discounted_keys: Keys of further entries to sum besides rewards.
        prioritized: Whether to draw within each table in proportion to priorities; importance weights are relative to
            the table.
        priority_alpha: Exponent of the priorities.
        priority_beta: Exponent of the importance weights (`rb.sampler.beta` may be changed later).
        storage: Returns the storage for a number of records, such as `partial(LazyTensorStorage, device="cuda")` or
            `LazyMemmapStorage`.
        **kwargs: `batch_size`, `transform`, `generator`, `priority_key`, `pin_memory`, `collate_fn` of
            `TensorDictReplayBuffer`.

    Raises:
        ValueError: If a capacity is not positive, names do not match, shares do not sum to 1, `event_horizon` is
            missing or exceeds a table, or `batch_size` is below the number of tables. The first `extend` checks shapes.

    Examples:
        >>> from tensordict import TensorDict
        >>> from coachable.replay import KeyEvents
        >>> rb = EventTableBuffer(
        ...     {"default": 100, "hit": 20}, events=KeyEvents(["hit"]), event_horizon=2, num_envs=1, batch_size=4
        ... )
        >>> hit = torch.tensor([[False], [False], [True], [False]])
        >>> step = {"done": torch.zeros(4, 1, dtype=torch.bool), "events": hit}
        >>> _ = rb.extend(TensorDict({"t": torch.arange(4), "next": step}, [4]))
        >>> rb.table("hit")["t"].tolist()
        [1, 2]
        >>> rb.sample()["table"].tolist()
        [0, 0, 1, 1]
    """

    _storage: LazyTensorStorage
    _writer: TableWriter
    _sampler: StratifiedSampler

    def __init__(
        self,
        table_capacities: Mapping[str, int],
        *,
        events: EventPredicate | None = None,
        event_horizon: int | None = None,
        route: Route | None = None,
        table_proportions: Mapping[str, float] | None = None,
        num_envs: int | None = None,
        n_steps: int = 1,
        gamma: float | None = None,
        discounted_keys: Sequence[str | tuple[str, ...]] = (),
        prioritized: bool = False,
        priority_alpha: float = 0.6,
        priority_beta: float = 0.4,
        storage: Callable[[int], LazyTensorStorage] = RowStorage,
        **kwargs: Any,
    ) -> None:
        regions = make_regions(table_capacities, route, events)
        routed = len(route.names) if route is not None else 1
        horizon = checked_horizon(regions, routed, events, event_horizon, num_envs)
        shares = checked_proportions(regions.names, routed, table_proportions)
        if kwargs.get("batch_size") is not None:
            allot(kwargs["batch_size"], shares, shares > 0)
        for name in ("prefetch", "sampler", "writer", "shared", "sample_unit", "consume_after_n_samples", "dim_extend"):
            if kwargs.get(name):
                raise ValueError(f"EventTableBuffer takes no {name}: it has its own sampler and writer, in one process")
        if n_steps != 1 and gamma is None:
            raise ValueError(f"n_steps is {n_steps} but gamma is missing: give the discount of the loss")
        Range("[0, 1]", optional=True).check("gamma", gamma)
        n_step = None if n_steps == 1 or gamma is None else NStep(n_steps, gamma, discounted_keys)
        NOT_NEGATIVE.check("priority_alpha", priority_alpha)
        NOT_NEGATIVE.check("priority_beta", priority_beta)
        self.regions = regions
        super().__init__(
            storage=storage(regions.total),
            sampler=StratifiedSampler(regions, shares, prioritized, priority_alpha, priority_beta),
            writer=TableWriter(regions, route, events, horizon, n_step, num_envs),
            **kwargs,
        )

    def share(self, shared: bool = True) -> Self:
        """Refuse to be shared with the workers of a collector, which would write to copies."""
        if shared:
            raise RuntimeError(
                "EventTableBuffer cannot be written by other processes: leave out replay_buffer= of the collector, and "
                "extend the buffer with what the collector yields"
            )
        return super().share(shared)

    @classmethod
    def for_events(
        cls,
        events: EventPredicate,
        *,
        capacity: int,
        event_capacity: int,
        event_horizon: int,
        event_share: float = 0.5,
        **kwargs: Any,
    ) -> "EventTableBuffer":
        """Build a buffer with a default table and one table per event, all event tables of one size.

        Args:
            events: Event predicate.
            capacity: Number of records of the default table.
            event_capacity: Number of records of each event table.
            event_horizon: H_max.
            event_share: Share of all event tables together in a batch, divided equally.
            **kwargs: Further arguments of the class.

        Raises:
            ValueError: If the share is not between 0 and 1, or there are no events.
        """
        Range("(0, 1)").check("event_share", event_share)
        if not events.names:
            raise ValueError("events has no names: expected at least one event (StyleEvents has one per weight)")
        capacities = {"default": capacity, **dict.fromkeys(events.names, event_capacity)}
        shares = {"default": 1.0 - event_share, **dict.fromkeys(events.names, event_share / len(events.names))}
        proportions = {"table_proportions": shares, **kwargs}
        return cls(capacities, events=events, event_horizon=event_horizon, **proportions)

    @classmethod
    def for_scenarios(cls, scenarios: Sequence[str], *, capacity: int, **kwargs: Any) -> "EventTableBuffer":
        """Build a buffer with one table per scenario, all of one size and one share of each batch (multi-tables).

        Args:
            scenarios: Names of the scenarios, in the order of the numbers under `scenario` in the data. Without any,
                the data need no `scenario`, and the only table is "default".
            capacity: Number of records of all tables together.
            **kwargs: Further arguments of the class.
        """
        tables = scenarios or ("default",)
        route = KeyRoute(scenarios) if scenarios else None
        return cls(dict.fromkeys(tables, capacity // len(tables)), route=route, **kwargs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tables; `table` in a sample is an index into them."""
        return self.regions.names

    def __len__(self) -> int:
        """Return the number of records in all tables, including copies; `write_count` counts every step once."""
        return int(self.regions.sizes.sum())

    def __getitem__(self, index: Any) -> Any:
        """Return records by slot, as in `index` of a sample; a slice selects from the live records, table by table."""
        if isinstance(index, slice):
            index = np.concatenate([self.regions.slots(i) for i in range(len(self.regions))])[index]
        return super().__getitem__(index)

    def table(self, name: str) -> TensorDictBase:
        """Return the records of one table, oldest first, without transforms.

        Raises:
            KeyError: If there is no such table.
        """
        if name not in self.names:
            raise KeyError(f"no table {name!r}: the tables are {', '.join(self.names)}")
        slots = torch.from_numpy(self.regions.slots(self.names.index(name)))
        with self._replay_lock:
            return self._storage.get(slots.to(self._storage.device))  # type: ignore[arg-type]

    def statistics(self) -> dict[str, dict[str, int]]:
        """Return numbers per table, see `TableWriter.statistics`."""
        return self._writer.statistics()

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Add steps; the input is not changed.

        Args:
            tensordicts: Transitions `(steps,)`, time-major, or `(num_envs, time)`, as collectors yield them.
            update_priority: Not used, because new records get the largest priority so far.

        Returns:
            Slots `(slots,)` of the steps, then of their copies in event tables.

        Raises:
            ValueError: If shapes do not fit the tables (see the class).
        """
        tensordicts = self._transform.inv(tensordicts)
        if tensordicts is None:
            return torch.zeros(0, dtype=torch.long)
        with self._replay_lock, self._write_lock:
            index = self._writer.extend(tensordicts)
            self._sampler.extend(index)
        return index

    def add(self, data: TensorDictBase) -> Tensor:
        """Add one step of batch shape `()`; see `extend`."""
        return self.extend(data.unsqueeze(0))

    def finish(self, trajectories: Tensor | None = None) -> Tensor:
        """End open episodes at their last step, for instance because the environments are going to be reset.

        Unfinished n-step sums are written and bootstrap from the last state. Later windows do not include earlier
        steps. Also call this after loading a checkpoint, unless the environments were restored with it.

        Args:
            trajectories: Trajectory numbers of the episodes to end; None ends all.

        Returns:
            Slots `(slots,)` of the written records.
        """
        with self._replay_lock, self._write_lock:
            index = self._writer.finish(None if trajectories is None else trajectories.cpu().numpy())
            self._sampler.extend(index)
        return index

    def update_tensordict_priority(self, data: TensorDictBase) -> None:
        """Set priorities from `priority_key` of a sample; if a record has several labels, the largest counts.

        Raises:
            KeyError: If the buffer is prioritised and the sample has no `index` or `priority_key`.
        """
        if self._sampler.prioritized:
            for key in ("index", self.priority_key):
                if data.get(key, None) is None:
                    raise KeyError(f"the sample has no {key!r}: expected the buffer's own sample, after its loss")
            self.update_priority(data.get("index"), data.get(self.priority_key))

    def update_priority(self, index: Tensor, priority: Tensor) -> None:
        """Set priorities of slots; see `StratifiedSampler.update_priority`."""
        with self._replay_lock, self._write_lock:
            self._sampler.update_priority(index, priority)

    def state_dict(self) -> dict[str, Any]:
        """Return the whole state in tensors and plain containers."""
        rng = None if self._rng is None else {"state": self._rng.get_state().clone(), "device": str(self._rng.device)}
        with self._replay_lock:
            return {
                "_storage": self._storage.state_dict(),
                "_writer": self._writer.state_dict(),
                "_sampler": self._sampler.state_dict(),
                "_transforms": dict(self._transform.state_dict()),
                "_rng": rng,
                "_batch_size": self._batch_size,
            }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned; the tables must be the same.

        Raises:
            ValueError: If tables, horizon, n-step sums or prioritisation differ; nothing is changed then.
        """
        with self._replay_lock:
            self._writer.check(state_dict["_writer"])  # before anything is overwritten
            self._sampler.check(state_dict["_sampler"])
            self._writer.load_state_dict(state_dict["_writer"])
            if state_dict["_storage"]["initialized"]:
                self._storage.load_state_dict(state_dict["_storage"])
            self._storage._len = self.regions.used_prefix
            self._sampler.load_state_dict(state_dict["_sampler"])
            self._transform.load_state_dict(state_dict["_transforms"])
            self._batch_size = state_dict["_batch_size"]
            if state_dict["_rng"] is not None:
                generator = torch.Generator(device=state_dict["_rng"]["device"])
                generator.set_state(state_dict["_rng"]["state"].cpu())
                self.set_rng(generator)

    def dumps(self, path: Path | str) -> None:
        """Save the buffer to a folder, as checkpoints do; see `write_replay`."""
        with self._replay_lock:
            write_replay(self, Path(path))

    def loads(self, path: Path | str) -> None:
        """Restore what `dumps` saved; see `read_replay`. The tables must be the same.

        Raises:
            CheckpointError: If files are missing, damaged or of another kind, or tables, horizon, n-step sums or
                prioritisation differ.
        """
        with self._replay_lock:
            read_replay(self, Path(path))

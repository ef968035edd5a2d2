"""Event tables and multi-tables against a slow reference, step by step in plain Python."""

from collections import defaultdict, deque
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from coachable.replay import EventTableBuffer, KeyEvents, KeyRoute, PredicateEvents, StyleEvents
from coachable.styles import Setpoint, StyleSpace, Weight


@dataclass
class Reference:
    """What the tables hold, worked out one step at a time."""

    capacities: dict[str, int]
    routed: int
    horizon: int
    n: int = 1
    gamma: float = 1.0
    tables: dict[str, deque] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = list(self.capacities)
        self.arrived = 0
        self.tables = {name: deque(maxlen=c) for name, c in self.capacities.items()}
        self.held: dict = defaultdict(list)
        self.episode: dict = defaultdict(list)
        self.in_table: dict = defaultdict(set)

    def step(self, stream, row) -> None:
        row = {**row, "arrival": self.arrived}
        self.arrived += 1
        if row["init"]:
            self.close(stream)
        self.held[stream].append(row)
        if row["done"]:
            self.close(stream)
        elif len(self.held[stream]) == self.n:
            self.emit(stream)

    def emit(self, stream) -> None:
        window = self.held[stream][: self.n]
        row = self.held[stream].pop(0)
        total = np.float32(0)
        for lag, later in enumerate(window):
            total = (
                np.float32(total + np.float32(self.gamma**lag) * np.float32(later["reward"]))
                if lag
                else np.float32(later["reward"])
            )
        last = window[-1]
        record = {
            "id": row["id"],
            "reward": float(total),
            "next": last["next"],
            "terminated": last["terminated"],
            "steps": len(window),
        }
        self.tables[self.names[row["route"]]].append(record)
        self.episode[stream].append(record)
        for k, fired in enumerate(row["fired"]):
            if fired:
                name = self.names[self.routed + k]
                for step in self.episode[stream][-self.horizon :]:
                    if step["id"] not in self.in_table[name]:
                        self.in_table[name].add(step["id"])
                        self.tables[name].append(step)

    def close(self, stream) -> None:
        while self.held[stream]:
            self.emit(stream)
        self.episode[stream] = []

    def finish(self) -> None:
        for stream in sorted(
            self.held, key=lambda stream: self.held[stream][-1]["arrival"] if self.held[stream] else -1
        ):
            self.close(stream)


class Source:
    """Random episodes of several workers with several environments each, every step with a number of its own."""

    def __init__(self, seed: int, workers: int, envs: int, events: int, routed: int, init: bool) -> None:
        self.rng = np.random.default_rng(seed)
        self.envs, self.events, self.routed, self.init = envs, events, routed, init
        self.count = 0
        self.trajectory = np.arange(workers * envs).reshape(workers, envs)
        self.next_trajectory = workers * envs
        self.chance = self.rng.uniform(0.02, 0.5, 2)

    def batch(self, worker: int, time: int) -> tuple[TensorDict, list[list[dict]]]:
        """`(envs, time)` data and the same as rows[env][t]."""
        n = self.envs * time
        rng = self.rng
        terminated = rng.random(n) < self.chance[0] / 2
        truncated = rng.random(n) < self.chance[0] / 2
        init = (rng.random(n) < 0.1) if self.init else np.zeros(n, bool)
        fired = rng.random((n, self.events)) < self.chance[1]
        route = rng.integers(0, self.routed, n)
        reward = rng.normal(size=n).astype(np.float32)
        number = np.arange(self.count, self.count + n)
        self.count += n
        trajectory = np.zeros(n, dtype=np.int64)
        rows = []
        for e in range(self.envs):
            rows.append([])
            for t in range(time):
                i = e * time + t
                if init[i]:
                    self._renew(worker, e)
                trajectory[i] = self.trajectory[worker, e]
                done = bool(terminated[i] or truncated[i])
                rows[-1].append(
                    {
                        "id": int(number[i]),
                        "reward": float(reward[i]),
                        "next": int(number[i]) + 10**6,
                        "terminated": bool(terminated[i]),
                        "done": done,
                        "init": bool(init[i]),
                        "fired": fired[i],
                        "route": int(route[i]),
                        "trajectory": int(trajectory[i]),
                    }
                )
                if done:
                    self._renew(worker, e)
        data = TensorDict(
            {
                "id": torch.from_numpy(number),
                "scenario": torch.from_numpy(route),
                "is_init": torch.from_numpy(init).unsqueeze(-1),
                "collector": {"traj_ids": torch.from_numpy(trajectory)},
                "next": {
                    "reward": torch.from_numpy(reward).unsqueeze(-1),
                    "observation": torch.from_numpy(number + 10**6).float().unsqueeze(-1),
                    "terminated": torch.from_numpy(terminated).unsqueeze(-1),
                    "truncated": torch.from_numpy(truncated).unsqueeze(-1),
                    "done": torch.from_numpy(terminated | truncated).unsqueeze(-1),
                    "events": torch.from_numpy(fired),
                },
            },
            [n],
        ).reshape(self.envs, time)
        return data, rows

    def _renew(self, worker: int, env: int) -> None:
        self.trajectory[worker, env] = self.next_trajectory
        self.next_trajectory += 1


def assert_equal(buffer: EventTableBuffer, reference: Reference) -> None:
    assert len(buffer) == sum(len(t) for t in reference.tables.values())
    for name, expected in reference.tables.items():
        if not expected:
            assert buffer.statistics()[name]["size"] == 0
            continue
        got = buffer.table(name)
        assert got["id"].tolist() == [r["id"] for r in expected], name
        assert got["next", "reward"].squeeze(-1).tolist() == [r["reward"] for r in expected]
        assert got["next", "observation"].squeeze(-1).tolist() == [float(r["next"]) for r in expected]
        assert got["next", "terminated"].squeeze(-1).tolist() == [r["terminated"] for r in expected]
        if reference.n > 1:
            assert got["steps_to_next_obs"].squeeze(-1).tolist() == [r["steps"] for r in expected]
            discount = torch.tensor([reference.gamma ** r["steps"] for r in expected], dtype=torch.float64).float()
            assert torch.equal(got["discount"].squeeze(-1), discount)


def make_buffer(routed: int, events: int, horizon: int, base: int, fed: int, n: int = 1, **kwargs) -> tuple:
    capacities = {f"scenario{i}": base for i in range(routed)} if routed > 1 else {"default": base}
    names = [f"event{k}" for k in range(events)]
    capacities |= dict.fromkeys(names, fed)
    gamma = 0.9 if n > 1 else None
    buffer = EventTableBuffer(
        capacities,
        events=KeyEvents(names) if events else None,
        event_horizon=horizon if events else None,
        route=KeyRoute([f"scenario{i}" for i in range(routed)]) if routed > 1 else None,
        n_steps=n,
        gamma=gamma,
        **kwargs,
    )
    return buffer, Reference(capacities, routed, horizon, n, gamma or 1.0)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    workers=st.integers(1, 3),
    envs=st.integers(1, 4),
    events=st.integers(0, 3),
    routed=st.integers(1, 3),
    horizon=st.integers(1, 7),
    n=st.integers(1, 5),
    layout=st.sampled_from(["two-dimensional", "flat", "trajectories", "trajectories env-major"]),
    calls=st.lists(st.integers(1, 9), min_size=1, max_size=12),
    finish=st.booleans(),
)
def test_tables_equal_the_reference(seed, workers, envs, events, routed, horizon, n, layout, calls, finish):
    flat = layout == "flat"
    buffer, reference = make_buffer(routed, events, horizon, 2000, 9, n, num_envs=envs if flat else None)
    by_trajectory = layout.startswith("trajectories")
    workers = workers if by_trajectory else 1  # only trajectory numbers tell workers apart
    # Without trajectory numbers only `is_init` can tell that an episode was cut short.
    source = Source(seed, workers, envs, events, routed, init=not by_trajectory)
    for call, time in enumerate(calls):
        worker = int(source.rng.integers(workers))
        data, rows = source.batch(worker, time)
        time_major = [(e, t) for t in range(time) for e in range(envs)]
        order = [(e, t) for e in range(envs) for t in range(time)] if layout.endswith("env-major") else time_major
        if not by_trajectory:
            data = data.exclude(("collector", "traj_ids"))
        if flat or layout == "trajectories":
            data = data.transpose(0, 1).reshape(-1)
        elif layout.endswith("env-major"):
            data = data.reshape(-1)
        buffer.extend(data)
        for e, t in order:
            row = rows[e][t]
            reference.step((worker, row["trajectory"]) if by_trajectory else (worker, e), row)
        if finish and call == len(calls) // 2:
            buffer.finish()
            reference.finish()
        assert_equal(buffer, reference)
    buffer.finish()
    reference.finish()
    assert_equal(buffer, reference)
    assert buffer.write_count == source.count


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), envs=st.integers(1, 3), time=st.integers(1, 30), n=st.integers(1, 3))
def test_small_tables_keep_the_newest(seed, envs, time, n):
    """Batches larger than a table, in one call or many, leave its last records."""
    buffer, reference = make_buffer(1, 0, 1, 7, 1, n)
    source = Source(seed, 1, envs, 0, 1, init=False)
    for _ in range(4):
        data, rows = source.batch(0, time)
        buffer.extend(data)
        for t in range(time):
            for e in range(envs):
                reference.step((0, e if n == 1 else rows[e][t]["trajectory"]), rows[e][t])
        assert_equal(buffer, reference)


def steps(ids, fired, done=None, **extra) -> TensorDict:
    """One environment, one event."""
    n = len(ids)
    done = torch.zeros(n, 1, dtype=torch.bool) if done is None else torch.tensor(done).reshape(n, 1)
    fired = torch.tensor(fired).reshape(n, -1)
    return TensorDict({"id": torch.tensor(ids), **extra, "next": {"done": done, "events": fired}}, [n])


def one_event_buffer(horizon: int, base: int = 100, fed: int = 100, **kwargs) -> EventTableBuffer:
    return EventTableBuffer(
        {"default": base, "hit": fed}, events=KeyEvents(["hit"]), event_horizon=horizon, num_envs=1, **kwargs
    )


def test_window_holds_the_event_step_and_none_after_it():
    buffer = one_event_buffer(3)
    buffer.extend(steps([0, 1, 2, 3, 4, 5], [False, False, False, True, False, False]))
    assert buffer.table("hit")["id"].tolist() == [1, 2, 3]


def test_window_stops_at_the_start_of_the_episode():
    buffer = one_event_buffer(10)
    buffer.extend(steps([0, 1, 2, 3], [False, False, False, True], done=[False, True, False, False]))
    assert buffer.table("hit")["id"].tolist() == [2, 3]


def test_window_on_the_last_step_of_an_episode_and_the_first_of_the_next():
    buffer = one_event_buffer(2)
    buffer.extend(steps([0, 1, 2, 3], [False, True, True, False], done=[False, True, False, False]))
    assert buffer.table("hit")["id"].tolist() == [0, 1, 2]


def test_overlapping_windows_enter_once():
    buffer = one_event_buffer(4)
    for i in range(8):  # one step per call: windows reach back over earlier calls
        buffer.extend(steps([i], [i in (3, 5)]))
    assert buffer.table("hit")["id"].tolist() == [0, 1, 2, 3, 4, 5]


def test_gap_between_windows_stays_out():
    buffer = one_event_buffer(2)
    buffer.extend(steps(range(8), [i in (2, 6) for i in range(8)]))
    assert buffer.table("hit")["id"].tolist() == [1, 2, 5, 6]


def test_copies_outlive_the_originals():
    buffer = one_event_buffer(2, base=4)
    buffer.extend(steps([0, 1], [False, True]))
    buffer.extend(steps(range(2, 8), [False] * 6))
    assert buffer.table("default")["id"].tolist() == [4, 5, 6, 7]
    assert buffer.table("hit")["id"].tolist() == [0, 1]


def test_windows_are_read_before_the_batch_overwrites_them():
    buffer = one_event_buffer(4, base=4)
    buffer.extend(steps([0, 1, 2, 3], [False] * 4))
    buffer.extend(steps(range(4, 10), [i == 5 for i in range(4, 10)]))
    assert buffer.table("hit")["id"].tolist() == [2, 3, 4, 5]
    assert buffer.table("default")["id"].tolist() == [6, 7, 8, 9]


def test_what_was_evicted_meanwhile_is_counted_as_lost():
    """Possible only where the number of environments is not declared, as with trajectory numbers."""
    buffer = EventTableBuffer({"default": 4, "hit": 9}, events=KeyEvents(["hit"]), event_horizon=4)

    def of(trajectory, ids, fired):
        return steps(ids, fired, collector=TensorDict({"traj_ids": torch.full((len(ids),), trajectory)}, [len(ids)]))

    buffer.extend(of(0, [0, 1], [False, False]))
    buffer.extend(of(1, [10, 11, 12], [False] * 3))
    buffer.extend(of(0, [2], [True]))
    assert buffer.table("hit")["id"].tolist() == [1, 2]
    assert buffer.statistics()["hit"]["lost"] == 1


def test_open_episodes_that_nobody_continues_are_forgotten():
    buffer = EventTableBuffer({"default": 50, "hit": 9}, events=KeyEvents(["hit"]), event_horizon=3)
    for trajectory in range(400):
        ids = TensorDict({"traj_ids": torch.full((1,), trajectory)}, [1])
        buffer.extend(steps([trajectory], [False], collector=ids))
    assert len(buffer.writer.history) <= 52
    assert len(buffer.writer.history.key) < 256


def test_held_back_steps_that_nobody_continues_are_written():
    buffer = EventTableBuffer({"default": 50}, n_steps=3, gamma=0.9)
    for trajectory in range(400):
        td = steps([trajectory], [False], collector=TensorDict({"traj_ids": torch.full((1,), trajectory)}, [1]))
        td["next", "reward"] = torch.ones(1, 1)
        buffer.extend(td)
    assert len(buffer.writer.n_step) <= 52
    assert buffer.write_count >= 345


def test_padding_of_split_trajectories_is_dropped():
    td = TensorDict(
        {
            "id": torch.arange(6).reshape(2, 3),
            "collector": {
                "traj_ids": torch.tensor([[0, 0, 0], [1, 1, 1]]),
                "mask": torch.tensor([[True, True, False], [True, True, True]]),
            },
            "next": {
                "done": torch.zeros(2, 3, 1, dtype=torch.bool),
                "events": torch.tensor([[[False], [True], [True]], [[False], [False], [True]]]),
            },
        },
        [2, 3],
    )
    buffer = EventTableBuffer({"default": 9, "hit": 9}, events=KeyEvents(["hit"]), event_horizon=2)
    buffer.extend(td)
    assert sorted(buffer.table("default")["id"].tolist()) == [0, 1, 3, 4, 5]
    assert buffer.table("hit")["id"].tolist() == [0, 1, 4, 5]


def test_extend_leaves_its_input_as_it_is():
    buffer = one_event_buffer(2)
    td = steps([0, 1], [False, True])
    before = td.clone()
    buffer.extend(td)
    assert set(td.keys(True)) == set(before.keys(True)) and (td == before).all()


def test_samples_can_be_put_back_without_their_bookkeeping():
    buffer = one_event_buffer(1)
    buffer.extend(steps([0, 1], [False, True]))
    buffer.extend(buffer.sample(2))
    assert buffer.write_count == 4


def test_style_events_admit_by_weight_and_extra_events_always():
    td = TensorDict(
        {
            "style": torch.tensor([[0.0, 1.0], [-1.0, 0.0], [2.0, 2.0]]),
            "next": {"events": torch.ones(3, 3, dtype=torch.bool)},
        },
        [3],
    )
    events = StyleEvents(["melee", "traps"], [0, 1], extra=["kill"])
    assert events(td).int().tolist() == [[0, 1, 1], [1, 0, 1], [1, 1, 1]]
    assert td["next", "events"].all()


def test_events_of_a_space_make_a_table_per_weight_with_original_labels():
    space = StyleSpace([Weight("melee", -1.0, 1.0), Setpoint("gap", 0.0, 1.0), Weight("traps", 0.0, 1.0)])
    events = StyleEvents.of(space, extra=["kill"])
    buffer = EventTableBuffer.for_events(
        events, capacity=50, event_capacity=10, event_horizon=2, num_envs=1, batch_size=8
    )
    assert buffer.names == ("default", "melee", "traps", "kill")
    style = torch.tensor([[0.5, 0.2, 0.0]]).expand(3, 3)
    buffer.extend(steps([0, 1, 2], [[False] * 3, [True, True, False], [False, False, True]], style=style))
    stats = buffer.statistics()
    assert [stats[name]["size"] for name in buffer.names] == [3, 2, 0, 2]
    assert [stats[name]["events"] for name in buffer.names] == [0, 1, 0, 1]
    assert torch.equal(buffer.table("melee")["style"], style[:2])


def test_predicates_of_other_domains():
    events = PredicateEvents({"fast": lambda td: td["speed"] > 5.0, "slow": lambda td: td["speed"] < 1.0})
    capacities = {"default": 20, "fast": 5, "slow": 5}
    buffer = EventTableBuffer(capacities, events=events, event_horizon=1, num_envs=1)
    buffer.extend(steps([0, 1, 2, 3], [[False]] * 4, speed=torch.tensor([6.0, 0.0, 3.0, 7.0])))
    found = {name: buffer.table(name)["id"].tolist() for name in buffer.names}
    assert found == {"default": [0, 1, 2, 3], "fast": [0, 3], "slow": [1]}


def test_statistics_and_stats():
    buffer = one_event_buffer(2, base=4, fed=3)
    buffer.extend(steps(range(6), [i in (1, 4) for i in range(6)]))
    assert buffer.statistics()["default"] == {
        "size": 4, "capacity": 4, "fill": 1.0, "written": 6, "evicted": 2, "events": 0, "lost": 0,
    }  # fmt: skip
    assert buffer.statistics()["hit"] == {
        "size": 3, "capacity": 3, "fill": 1.0, "written": 4, "evicted": 1, "events": 2, "lost": 0,
    }  # fmt: skip
    stats = buffer.stats()
    assert stats["size"] == len(buffer) == 7 and stats["write_count"] == buffer.write_count == 6
    assert stats["tables/hit/events"] == 2


def test_indexing_and_emptying():
    buffer = one_event_buffer(2, batch_size=4)
    buffer.extend(steps(range(5), [i == 3 for i in range(5)]))
    sample = buffer.sample()
    assert torch.equal(buffer[sample["index"]]["id"], sample["id"])
    assert buffer[:]["id"].tolist() == [0, 1, 2, 3, 4, 2, 3]
    buffer.empty()
    assert len(buffer) == 0 and buffer.write_count == 0 and not buffer.can_sample()
    buffer.extend(steps([7], [True]))
    assert buffer.table("hit")["id"].tolist() == [7]


def test_add_takes_single_steps():
    buffer = one_event_buffer(2)
    for i in range(3):
        buffer.add(steps([i], [i == 2])[0])
    assert buffer.table("default")["id"].tolist() == [0, 1, 2]
    assert buffer.table("hit")["id"].tolist() == [1, 2]


BAD_CONSTRUCTIONS = {
    "empty": (dict(table_capacities={}), "lacks"),
    "capacity": (dict(table_capacities={"default": 0}), "positive integer"),
    "capacity type": (dict(table_capacities={"default": 1.5}), "positive integer"),
    "missing table": (dict(table_capacities={"default": 9}, events=KeyEvents(["hit"]), event_horizon=1), r"\['hit'\]"),
    "stray table": (dict(table_capacities={"default": 9, "hit": 9}), r"no use for \['hit'\]"),
    "no horizon": (dict(events=KeyEvents(["hit"])), "event_horizon is None"),
    "horizon alone": (dict(table_capacities={"default": 9}, event_horizon=3), "no event tables"),
    "horizon zero": (dict(events=KeyEvents(["hit"]), event_horizon=0), "at least 1"),
    "horizon too long": (dict(events=KeyEvents(["hit"]), event_horizon=6), "larger than table_capacities"),
    "default too small": (dict(events=KeyEvents(["hit"]), event_horizon=5, num_envs=3), r"event_horizon \* num_envs"),
    "num_envs": (dict(table_capacities={"default": 9}, num_envs=0), "num_envs"),
    "sum": (dict(table_capacities={"default": 9}, table_proportions={"default": 0.9}), "sum to 1"),
    "negative": (
        dict(
            events=KeyEvents(["hit"]), event_horizon=1, table_proportions={"default": 1.5, "hit": -0.5},
        ),
        "sum to 1",
    ),
    "proportion names": (dict(table_capacities={"default": 9}, table_proportions={"all": 1.0}), "exactly the tables"),
    "batch": (dict(events=KeyEvents(["hit"]), event_horizon=1, batch_size=1), "batch of 1"),
    "gamma": (dict(table_capacities={"default": 9}, n_steps=3), "gamma"),
    "gamma range": (dict(table_capacities={"default": 9}, n_steps=3, gamma=1.1), "gamma"),
    "n_steps": (dict(table_capacities={"default": 9}, n_steps=0, gamma=0.9), "n_steps"),
    "repeated": (dict(events=lambda: KeyEvents(["hit", "hit"])), "repeat"),
    "both": (dict(events=KeyEvents(["default"]), event_horizon=1), "both routed"),
    "prefetch": (dict(table_capacities={"default": 9}, prefetch=2, batch_size=2), "prefetch"),
    "alpha": (dict(table_capacities={"default": 9}, prioritized=True, priority_alpha=-1.0), "priority_alpha"),
    "beta": (dict(table_capacities={"default": 9}, prioritized=True, priority_beta=-1.0), "priority_beta is -1.0"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_CONSTRUCTIONS)
def test_bad_construction(case):
    arguments, message = BAD_CONSTRUCTIONS[case]
    arguments = {"table_capacities": {"default": 9, "hit": 5}, **arguments}
    with pytest.raises(ValueError, match=message):
        if case == "repeated":
            arguments["events"]()
        EventTableBuffer(**arguments)


class Returns:
    """A predicate or route that returns whatever it is told to."""

    def __init__(self, names, value):
        self.names, self.value = names, value

    def __call__(self, steps):
        return self.value


@pytest.mark.parametrize(
    "value", [torch.zeros(3, 2, dtype=torch.bool), torch.zeros(3, dtype=torch.bool), torch.zeros(3, 1), None]
)
def test_predicate_of_wrong_shape_is_reported_at_the_first_extend(value):
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=Returns(("hit",), value), event_horizon=1, num_envs=1)
    with pytest.raises(ValueError, match=r"event predicate Returns .* expected torch.bool \(3, 1\)"):
        buffer.extend(steps([0, 1, 2], [False] * 3))
    assert len(buffer) == 0


@pytest.mark.parametrize("value", [torch.zeros(3, 1).long(), torch.zeros(3), torch.tensor([0, 1, 2]), None])
def test_route_of_wrong_shape_or_range_is_reported(value):
    buffer = EventTableBuffer({"a": 9, "b": 5}, route=Returns(("a", "b"), value))
    with pytest.raises(ValueError, match="the route Returns"):
        buffer.extend(steps([0, 1, 2], [False] * 3))


def test_wrong_event_columns_name_the_tables():
    events = StyleEvents(["melee", "traps"], [0, 1])
    capacities = {"default": 9, "melee": 5, "traps": 5}
    buffer = EventTableBuffer(capacities, events=events, event_horizon=1, num_envs=1)
    with pytest.raises(ValueError, match="melee, traps"):
        buffer.extend(steps([0], [[True]], style=torch.ones(1, 2)))


def test_predicate_columns_must_match_the_steps():
    events = PredicateEvents({"hit": lambda td: td["next", "events"]})
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=events, event_horizon=1, num_envs=1)
    with pytest.raises(ValueError, match="predicate of table 'hit'"):
        buffer.extend(steps([0, 1], [False] * 2))


def test_streams_that_cannot_be_told_apart_are_an_error():
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=KeyEvents(["hit"]), event_horizon=1)
    with pytest.raises(ValueError, match="num_envs"):
        buffer.extend(steps([0, 1], [False] * 2))
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=KeyEvents(["hit"]), event_horizon=1, num_envs=3)
    with pytest.raises(ValueError, match="expected a multiple"):
        buffer.extend(steps([0, 1], [False] * 2))
    with pytest.raises(ValueError, match=r"expected .steps,."):
        buffer.extend(steps([0, 1], [False] * 2).reshape(1, 2, 1))
    with pytest.raises(ValueError, match="done"):
        buffer.extend(steps([0, 1, 2], [False] * 3).exclude(("next", "done")))


def test_unknown_table():
    with pytest.raises(KeyError, match="hit"):
        one_event_buffer(1).table("miss")


def test_n_step_closed_forms():
    """Rewards 1, 2, 4, 8 with gamma 1/2."""

    def run(n, done=(), terminated=()):
        buffer = EventTableBuffer({"default": 9}, n_steps=n, gamma=0.5, num_envs=1)
        flags = torch.tensor([[i in done] for i in range(4)])
        ended = torch.tensor([[i in terminated] for i in range(4)])
        reward = torch.tensor([1.0, 2.0, 4.0, 8.0]).unsqueeze(-1)
        nxt = {
            "reward": reward,
            "task_reward": 10 * reward,
            "style_features": reward,
            "done": flags,
            "terminated": ended,
        }
        buffer.extend(TensorDict({"id": torch.arange(4), "next": nxt}, [4]))
        buffer.finish()
        return buffer.table("default")

    plain = run(3)
    assert plain["next", "reward"].squeeze(-1).tolist() == [3.0, 6.0, 8.0, 8.0]
    assert plain["next", "task_reward"].squeeze(-1).tolist() == [30.0, 60.0, 80.0, 80.0]
    assert plain["discount"].squeeze(-1).tolist() == [0.125, 0.125, 0.25, 0.5]
    assert plain["steps_to_next_obs"].squeeze(-1).tolist() == [3, 3, 2, 1]
    assert ("next", "style_features") not in plain.keys(True)

    cut = run(3, done=[1], terminated=[1])
    assert cut["next", "reward"].squeeze(-1).tolist() == [2.0, 2.0, 8.0, 8.0]
    assert cut["discount"].squeeze(-1).tolist() == [0.25, 0.5, 0.25, 0.5]
    assert cut["next", "terminated"].squeeze(-1).tolist() == [True, True, False, False]

    truncated = run(3, done=[1])
    assert truncated["next", "reward"].squeeze(-1).tolist() == [2.0, 2.0, 8.0, 8.0]
    assert not truncated["next", "terminated"].any() and truncated["next", "done"].squeeze(-1).tolist()[:2] == [
        True,
        True,
    ]


def test_n_step_sums_features_only_on_request():
    buffer = EventTableBuffer(
        {"default": 9}, n_steps=2, gamma=0.5, num_envs=1, discounted_keys=[("next", "style_features")]
    )
    features = TensorDict({"a": torch.tensor([[1.0], [2.0], [4.0]]), "b": torch.ones(3, 2)}, [3])
    buffer.extend(TensorDict({"next": {"style_features": features, "done": torch.zeros(3, 1, dtype=torch.bool)}}, [3]))
    kept = buffer.table("default")["next", "style_features"]
    assert kept["a"].squeeze(-1).tolist() == [2.0, 4.0] and kept["b"][0].tolist() == [1.5, 1.5]


def test_n_step_is_assembled_before_routing():
    """Neighbours in a table are not neighbours in time."""
    buffer = EventTableBuffer({"a": 9, "b": 9}, route=KeyRoute(["a", "b"]), n_steps=2, gamma=1.0, num_envs=1)
    nxt = {"reward": torch.tensor([1.0, 10.0, 100.0]).unsqueeze(-1), "done": torch.zeros(3, 1, dtype=torch.bool)}
    buffer.extend(TensorDict({"scenario": torch.tensor([0, 1, 0]), "next": nxt}, [3]))
    assert buffer.table("a")["next", "reward"].tolist() == [[11.0]]
    assert buffer.table("b")["next", "reward"].tolist() == [[110.0]]


def test_rollouts_of_torchrl_are_taken_as_they_are():
    """A lazy stack, `(num_envs, time)`."""
    frames = [
        TensorDict({"id": torch.tensor([2 * t, 2 * t + 1]), "next": {"done": torch.zeros(2, 1, dtype=torch.bool)}}, [2])
        for t in range(3)
    ]
    buffer = EventTableBuffer({"default": 9})
    buffer.extend(TensorDict.lazy_stack(frames, 1))
    assert buffer.table("default")["id"].tolist() == [0, 1, 2, 3, 4, 5]
    assert isinstance(buffer.storage, LazyTensorStorage)


def test_the_share_of_event_tables():
    events = KeyEvents(["a", "b"])
    sizes = {"capacity": 100, "event_capacity": 50, "event_horizon": 2, "num_envs": 1, "batch_size": 20}
    rb = EventTableBuffer.for_events(events, event_share=0.2, **sizes)
    fired = torch.zeros(60, 2, dtype=torch.bool)
    fired[10, 0], fired[20, 1] = True, True
    step = {"done": torch.zeros(60, 1, dtype=torch.bool), "events": fired}
    rb.extend(TensorDict({"t": torch.arange(60), "next": step}, [60]))
    assert torch.bincount(rb.sample()["table"]).tolist() == [16, 2, 2]
    with pytest.raises(ValueError, match=r"event_share is 1.0: expected a number in \(0, 1\)"):
        EventTableBuffer.for_events(events, event_share=1.0, **sizes)

"""Event tables and multi-tables against a slow reference, step by step in plain Python."""

from collections import defaultdict, deque
from dataclasses import dataclass, field

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from coachable.replay import EventTableBuffer, KeyEvents, KeyRoute


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

    def __init__(self, seed: int, workers: int, envs: int, events: int, routed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.envs, self.events, self.routed = envs, events, routed
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
                trajectory[i] = self.trajectory[worker, e]
                done = bool(terminated[i] or truncated[i])
                rows[-1].append(
                    {
                        "id": int(number[i]),
                        "reward": float(reward[i]),
                        "next": int(number[i]) + 10**6,
                        "terminated": bool(terminated[i]),
                        "done": done,
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
    source = Source(seed, workers, envs, events, routed)
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
    source = Source(seed, 1, envs, 0, 1)
    for _ in range(4):
        data, rows = source.batch(0, time)
        buffer.extend(data)
        for t in range(time):
            for e in range(envs):
                reference.step((0, e if n == 1 else rows[e][t]["trajectory"]), rows[e][t])
        assert_equal(buffer, reference)

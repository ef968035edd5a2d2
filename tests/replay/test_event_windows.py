"""What enters the event tables and what leaves them, case by case."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from coachable.replay import EventTableBuffer, KeyEvents, PredicateEvents, StyleEvents
from coachable.styles import Setpoint, StyleSpace, Weight
from tests.replay.one_event import one_event_buffer, steps


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


def test_a_step_that_its_table_never_contained_is_counted_as_lost():
    buffer = EventTableBuffer({"default": 4, "hit": 9}, events=KeyEvents(["hit"]), event_horizon=4)

    def of(trajectories, ids, fired):
        return steps(ids, fired, collector=TensorDict({"traj_ids": torch.tensor(trajectories)}, [len(ids)]))

    buffer.extend(of([0, 1, 1, 1, 1], [0, 10, 11, 12, 13], [False] * 5))  # one more than the table holds
    buffer.extend(of([0], [1], [True]))
    assert buffer.table("hit")["id"].tolist() == [1]
    assert buffer.statistics()["hit"]["lost"] == 1


def test_open_episodes_that_nobody_continues_are_forgotten():
    buffer = EventTableBuffer({"default": 50, "hit": 9}, events=KeyEvents(["hit"]), event_horizon=3)
    for trajectory in range(400):
        ids = TensorDict({"traj_ids": torch.full((1,), trajectory)}, [1])
        buffer.extend(steps([trajectory], [False], collector=ids))
    assert (buffer.writer.history.key >= 0).sum() <= 52
    assert len(buffer.writer.history.key) < 256


def test_held_back_steps_that_nobody_continues_are_written():
    buffer = EventTableBuffer({"default": 50}, n_steps=3, gamma=0.9)
    for trajectory in range(400):
        td = steps([trajectory], [False], collector=TensorDict({"traj_ids": torch.full((1,), trajectory)}, [1]))
        td["next", "reward"] = torch.ones(1, 1)
        buffer.extend(td)
    assert buffer.write_count >= 348


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
    events = StyleEvents(StyleSpace([Weight("melee", -1.0, 1.0), Weight("traps", 0.0, 2.0)]), extra=["kill"])
    assert events(td).int().tolist() == [[0, 1, 1], [1, 0, 1], [1, 1, 1]]
    assert td["next", "events"].all()


def test_events_of_a_space_make_a_table_per_weight_with_original_labels():
    space = StyleSpace([Weight("melee", -1.0, 1.0), Setpoint("gap", 0.0, 1.0), Weight("traps", 0.0, 1.0)])
    events = StyleEvents(space, extra=["kill"])
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


def test_statistics():
    buffer = one_event_buffer(2, base=4, fed=3)
    buffer.extend(steps(range(6), [i in (1, 4) for i in range(6)]))
    assert buffer.statistics() == {
        "default": {"size": 4, "events": 0, "lost": 0},
        "hit": {"size": 3, "events": 2, "lost": 0},
    }
    assert len(buffer) == 7 and buffer.write_count == 6


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

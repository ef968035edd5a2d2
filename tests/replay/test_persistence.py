"""Saving and restoring: a resumed buffer goes on as if it had never stopped."""

import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import LazyMemmapStorage

from coachable.replay import EventTableBuffer, KeyEvents, KeyRoute
from coachable.styles import StyleReward, StyleSpace, Weight, WeightedFeature
from coachable.transforms import TaskImpersonation

SPACE = StyleSpace([Weight("a", -1.0, 1.0)])
REWARD = StyleReward(SPACE, {"a": WeightedFeature("a", 0)})


def make(n_steps: int = 1, prioritized: bool = False, relabel: bool = False, **kwargs) -> EventTableBuffer:
    return EventTableBuffer(
        {"x": 120, "y": 120, "hit": 15, "miss": 40},
        events=KeyEvents(["hit", "miss"]),
        event_horizon=4,
        route=KeyRoute(["x", "y"]),
        num_envs=3,
        n_steps=n_steps,
        gamma=0.9 if n_steps > 1 else None,
        prioritized=prioritized,
        discounted_keys=[("next", "style_features")],
        batch_size=24,
        generator=torch.Generator().manual_seed(5),
        transform=TaskImpersonation(REWARD, n=2, seed=3) if relabel else None,
        **kwargs,
    )


def batch(seed: int, time: int = 5) -> TensorDict:
    g = torch.Generator().manual_seed(seed)
    n = 3 * time
    style = torch.tensor([0.2, 0.5, 0.8]).repeat(time).unsqueeze(-1)  # of each environment
    task, features = torch.rand(n, 1, generator=g), torch.rand(n, 1, generator=g)
    terminated = torch.rand(n, 1, generator=g) < 0.05
    return TensorDict(
        {
            "id": 1000 * seed + torch.arange(n),
            "style": style,
            "scenario": torch.randint(2, (n,), generator=g),
            "next": {
                "task_reward": task,
                "style_features": features,
                "reward": task + style * features,
                "terminated": terminated,
                "done": terminated | (torch.rand(n, 1, generator=g) < 0.05),
                "events": torch.rand(n, 2, generator=g) < 0.1,
            },
        },
        [n],
    )


def use(buffer: EventTableBuffer, start: int, stop: int) -> list[TensorDict]:
    """Extends, samples and updates priorities, as a training does."""
    samples = []
    for seed in range(start, stop):
        buffer.extend(batch(seed))
        samples.append(buffer.sample())
        if buffer.sampler.prioritized:
            samples[-1]["td_error"] = samples[-1]["next", "reward"].squeeze(-1)
            buffer.update_tensordict_priority(samples[-1])
    return samples


def assert_same(one: EventTableBuffer, other: EventTableBuffer) -> None:
    assert one.statistics() == other.statistics() and one.regions.state_dict() == other.regions.state_dict()
    for name in one.names:
        if one.statistics()[name]["size"]:
            a, b = one.table(name), other.table(name)
            assert set(a.keys(True)) == set(b.keys(True)) and (a == b).all()


def by_state_dict(saved, fresh, folder):
    fresh.load_state_dict(saved.state_dict())


def by_torch_file(saved, fresh, folder):
    torch.save(saved.state_dict(), folder / "replay.pt")
    fresh.load_state_dict(torch.load(folder / "replay.pt", weights_only=True))


def by_dumps(saved, fresh, folder):
    saved.dumps(folder / "replay")
    fresh.loads(folder / "replay")


def by_checkpoint(saved, fresh, folder):
    Checkpoint(replay=saved).save(folder / "checkpoint")
    Checkpoint(replay=fresh).load(folder / "checkpoint")


@pytest.mark.parametrize("way", [by_state_dict, by_torch_file, by_dumps, by_checkpoint])
@pytest.mark.parametrize(
    "kwargs",
    [{}, {"n_steps": 4}, {"prioritized": True}, {"n_steps": 3, "prioritized": True, "relabel": True}],
    ids=["plain", "n-step", "prioritised", "all"],
)
@pytest.mark.parametrize("before", [2, 20], ids=["filling", "full"])
def test_resumed_equals_uninterrupted(way, kwargs, before, tmp_path):
    saved = make(**kwargs)
    use(saved, 0, before)
    resumed = make(**kwargs)
    way(saved, resumed, tmp_path)
    assert_same(saved, resumed)
    after = before + 6
    for a, b in zip(use(saved, before, after), use(resumed, before, after), strict=True):
        assert set(a.keys(True)) == set(b.keys(True)) and (a == b).all()
    assert_same(saved, resumed)
    saved.finish(), resumed.finish()
    assert_same(saved, resumed)


@pytest.mark.parametrize("way", [by_state_dict, by_dumps])
def test_a_buffer_in_use_can_be_restored_to_another_state(way, tmp_path):
    saved, used = make(n_steps=3), make(n_steps=3)
    use(saved, 0, 5)
    use(used, 50, 70)
    way(saved, used, tmp_path)
    assert_same(saved, used)
    use(saved, 5, 9), use(used, 5, 9)
    assert_same(saved, used)


def test_a_loaded_buffer_shares_no_memory_with_what_it_was_loaded_from(tmp_path):
    saved, other = make(n_steps=3), make(n_steps=3)
    use(saved, 0, 3)
    kept = {name: saved.table(name).clone() for name in saved.names if saved.statistics()[name]["size"]}
    other.load_state_dict(saved.state_dict())
    use(other, 100, 160)
    assert all((saved.table(name) == table).all() for name, table in kept.items())
    saved.dumps(tmp_path / "a")
    twin = make(n_steps=3)
    twin.loads(tmp_path / "a")
    use(twin, 100, 160)
    again = make(n_steps=3)
    again.loads(tmp_path / "a")
    assert_same(again, saved)


@pytest.mark.parametrize("way", [by_state_dict, by_dumps])
def test_a_buffer_whose_steps_are_all_held_back_round_trips(way, tmp_path):
    """Before the first return over `n_steps` is complete, the writer has steps and the storage has no record."""
    saved, fresh = make(n_steps=4), make(n_steps=4)
    first = batch(0, time=2)
    first["next", "done"].zero_(), first["next", "terminated"].zero_()
    saved.extend(first)
    assert len(saved) == 0
    way(saved, fresh, tmp_path)
    for buffer in (saved, fresh):
        buffer.extend(batch(1, time=6))
    assert len(saved) > 0
    assert_same(saved, fresh)


@pytest.mark.parametrize("way", [by_state_dict, by_dumps])
def test_zeros_of_steps_that_are_held_back_keep_their_sign(way, tmp_path):
    saved, fresh = make(n_steps=4), make(n_steps=4)
    first = batch(0, time=2)
    first["next", "done"].zero_(), first["next", "terminated"].zero_()
    first["next", "style_features"].fill_(-0.0)
    saved.extend(first)
    way(saved, fresh, tmp_path)
    assert fresh._writer.n_step._data["next", "style_features"].signbit().all()


@pytest.mark.parametrize("way", [by_state_dict, by_dumps])
def test_an_empty_buffer_round_trips(way, tmp_path):
    saved, fresh = make(n_steps=3, relabel=True), make(n_steps=3, relabel=True)
    way(saved, fresh, tmp_path)
    for a, b in zip(use(saved, 0, 3), use(fresh, 0, 3), strict=True):
        assert (a == b).all()


def test_folders_are_read_without_pickle(tmp_path, monkeypatch):
    saved = make(n_steps=3, prioritized=True, relabel=True)
    use(saved, 0, 4)
    saved.dumps(tmp_path / "replay")

    def refuse(*args, **kwargs):
        raise AssertionError("pickle was used")

    def load(*args, weights_only=False, **kwargs):
        assert weights_only
        return torch_load(*args, weights_only=True, **kwargs)

    torch_load = torch.load
    monkeypatch.setattr(torch, "load", load)
    for name in ("load", "loads"):
        monkeypatch.setattr(pickle, name, refuse)
    fresh = make(n_steps=3, prioritized=True, relabel=True)
    fresh.loads(tmp_path / "replay")
    assert_same(saved, fresh)


def test_dumping_twice_into_one_folder(tmp_path):
    saved = make(n_steps=3)
    use(saved, 0, 3)
    saved.dumps(tmp_path / "replay")
    use(saved, 3, 9)
    saved.finish()
    saved.dumps(tmp_path / "replay")
    fresh = make(n_steps=3)
    fresh.loads(tmp_path / "replay")
    assert_same(saved, fresh)


def test_other_tables_are_refused():
    saved = make()
    use(saved, 0, 2)
    other = EventTableBuffer({"x": 120, "y": 90}, route=KeyRoute(["x", "y"]))
    with pytest.raises(ValueError, match="same table_capacities"):
        other.load_state_dict(saved.state_dict())
    with pytest.raises(ValueError, match="prioritized"):
        make(prioritized=True).load_state_dict(saved.state_dict())
    longer = EventTableBuffer(
        {"x": 120, "y": 120, "hit": 15, "miss": 40},
        events=KeyEvents(["hit", "miss"]),
        event_horizon=5,
        route=KeyRoute(["x", "y"]),
    )
    with pytest.raises(ValueError, match="event_horizon 4"):
        longer.load_state_dict(saved.state_dict())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"prioritized": True}, "the saved buffer was not prioritised"),
        ({"n_steps": 1}, "n_steps=3 and gamma=0.9, this one n_steps=1 and gamma=None"),
        ({"n_steps": 2}, "n_steps=3 and gamma=0.9, this one n_steps=2 and gamma=0.9"),
    ],
)
def test_a_refused_state_changes_nothing(changed, message):
    saved, other = make(n_steps=3), make(**{"n_steps": 3, **changed})
    use(saved, 0, 2)
    use(other, 2, 3)
    before = {name: other.table(name) for name in other.names}
    with pytest.raises(ValueError, match=message):
        other.load_state_dict(saved.state_dict())
    for name, records in before.items():
        assert (other.table(name) == records).all()


def test_a_state_of_an_earlier_version_names_no_sums():
    saved, fresh = make(n_steps=3), make(n_steps=3)
    use(saved, 0, 2)
    state = saved.state_dict()
    del state["_writer"]["sums"]
    fresh.load_state_dict(state)
    assert_same(saved, fresh)


def test_memory_mapped_storage(tmp_path):
    saved = make(storage=LazyMemmapStorage)
    use(saved, 0, 4)
    saved.dumps(tmp_path / "replay")
    fresh = make(storage=LazyMemmapStorage)
    fresh.loads(tmp_path / "replay")
    assert_same(saved, fresh)


def test_equal_buffers_have_equal_files_whatever_was_in_memory(tmp_path):
    """Slots between the tables that were never written are not read from memory: their content is arbitrary."""
    for name, stray in (("one", 3.0), ("other", float("nan"))):
        buffer = make()
        use(buffer, 0, 2)
        used = torch.zeros(len(buffer.storage), dtype=torch.bool)
        used[torch.cat([torch.from_numpy(buffer.regions.slots(i)) for i in range(len(buffer.names))])] = True
        assert not used.all()
        buffer.storage._storage["style"][: len(used)][~used] = stray
        buffer.storage._storage["next", "done"][: len(used)][~used] = stray == 3.0
        before = {table: buffer.table(table).clone() for table in buffer.names if len(buffer.table(table))}
        buffer.dumps(tmp_path / name)
        assert all((buffer.table(table) == rows).all() for table, rows in before.items())
    files = sorted((tmp_path / "one").glob("*.npy"))
    assert len(files) == len(buffer.storage[:1].keys(True, True))
    for file in files:
        assert file.read_bytes() == (tmp_path / "other" / file.name).read_bytes(), file.name

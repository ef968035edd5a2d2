"""Event tables behind TorchRL's collector: its batches, trajectory numbers and automatic resets, taken as they are."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from coachable.replay import EventTableBuffer, KeyEvents
from coachable.replay.replay_files import replay_bytes, write_replay

with warnings.catch_warnings():  # TorchRL warns about its own classes while it is imported
    warnings.simplefilter("ignore")
    from torchrl.collectors import Collector


class Counter(EnvBase):
    """Counts; environment i ends an episode at `5 + i`, and its event fires at every third step."""

    def __init__(self, num_envs: int = 3) -> None:
        super().__init__(batch_size=[num_envs])
        n = num_envs
        self.observation_spec = Composite(
            observation=Unbounded((n, 1)), events=Binary(1, (n, 1), dtype=torch.bool), shape=(n,)
        )
        self.action_spec = Unbounded((n, 1))
        self.reward_spec = Unbounded((n, 1))
        self.count = torch.zeros(n, 1)

    def _set_seed(self, seed) -> None:
        pass

    def _reset(self, tensordict=None, **kwargs):
        ended = None if tensordict is None else tensordict.get("_reset", None)
        self.count = torch.zeros_like(self.count) if ended is None else torch.where(ended, 0.0, self.count)
        return TensorDict({"observation": self.count.clone(), "events": torch.zeros(3, 1, dtype=torch.bool)}, [3])

    def _step(self, tensordict):
        self.count = self.count + 1
        done = self.count >= 5 + torch.arange(3).unsqueeze(-1)
        return TensorDict(
            {
                "observation": self.count.clone(),
                "events": self.count % 3 == 0,
                "reward": self.count.clone(),
                "done": done,
                "terminated": done.clone(),
            },
            [3],
        )


def check(buffer: EventTableBuffer) -> None:
    """Each window is two steps of one episode: counts 1-2 and 4-5, but 0 to 1 never from before a reset."""
    hit = buffer.table("hit")
    counts = hit["observation"].squeeze(-1).int()
    trajectory = hit["collector", "traj_ids"]
    assert set(counts.tolist()) == {1, 2, 4, 5}
    first = counts % 3 == 1
    assert (first[0::2]).all() and (~first[1::2]).all()
    assert (counts[1::2] - counts[0::2] == 1).all() and (trajectory[1::2] == trajectory[0::2]).all()
    assert hit["next", "events"].squeeze(-1).tolist() == [False, True] * (len(hit) // 2)


def make_buffer(**kwargs) -> EventTableBuffer:
    return EventTableBuffer({"default": 500, "hit": 400}, events=KeyEvents(["hit"]), event_horizon=2, **kwargs)


def test_batches_of_a_collector():
    for frames in (3, 12, 60):  # windows reach back over none, some or most batches
        collector = Collector(Counter(), None, frames_per_batch=frames, total_frames=180)
        buffer = make_buffer(batch_size=16)
        for data in collector:
            buffer.extend(data)
        assert buffer.write_count == 180
        check(buffer)
        assert buffer.sample()["table"].bincount().tolist() == [8, 8]


def test_the_size_of_a_full_buffer_with_its_event_tables(tmp_path):
    keys = ("observation", "action", ("next", "observation"), ("next", "events"), ("next", "done"))
    buffer = EventTableBuffer({"default": 300, "hit": 90}, events=KeyEvents(["hit"]), event_horizon=2)
    for data in Collector(Counter(), None, frames_per_batch=300, total_frames=600):
        buffer.extend(data.select(*keys))
    assert (len(buffer.table("default")), len(buffer.table("hit"))) == (300, 90)
    write_replay(buffer, tmp_path)
    written = sum(file.stat().st_size for file in tmp_path.glob("*.npy"))
    headers = 128 * len(list(tmp_path.glob("*.npy")))
    assert replay_bytes(buffer, Counter(), keys) == written - headers


def test_n_step_sums_from_a_collector():
    collector = Collector(Counter(), None, frames_per_batch=12, total_frames=180)
    buffer = make_buffer(n_steps=4, gamma=1.0)
    for data in collector:
        buffer.extend(data)
    buffer.finish()
    table = buffer.table("default")
    start, end = table["observation"], table["next", "observation"]
    assert buffer.write_count == 180
    assert torch.equal(end - start, table["steps_to_next_obs"].float())
    # Sum of start + 1 to end: no sum crosses a reset.
    assert torch.equal(table["next", "reward"], (end * (end + 1) - start * (start + 1)) / 2)
    short = table["steps_to_next_obs"] < 4
    unfinished = 3 * 3
    assert table["next", "done"][short].sum() >= short.sum() - unfinished
    check(buffer)


def test_a_collector_that_fills_the_buffer_itself():
    buffer = make_buffer()
    collector = Collector(Counter(), None, frames_per_batch=12, total_frames=180, replay_buffer=buffer)
    for _ in collector:
        pass
    assert buffer.write_count == 180
    check(buffer)


def test_workers_of_a_collector_cannot_fill_it():
    with pytest.raises(RuntimeError, match="cannot be written by other processes: leave out replay_buffer="):
        make_buffer().share()
    buffer = make_buffer()
    buffer.share(False)
    assert not buffer.shared

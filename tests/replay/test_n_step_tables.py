"""Sums over n steps in the tables, by hand."""

import torch
from tensordict import TensorDict

from coachable.replay import EventTableBuffer, KeyEvents, KeyRoute


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
    assert plain["steps_to_next_obs"].squeeze(-1).tolist() == [3, 3, 2, 1]
    assert ("next", "style_features") not in plain.keys(True)

    cut = run(3, done=[1], terminated=[1])
    assert cut["next", "reward"].squeeze(-1).tolist() == [2.0, 2.0, 8.0, 8.0]
    assert cut["steps_to_next_obs"].squeeze(-1).tolist() == [2, 1, 2, 1]
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


def test_sums_of_whole_numbers_and_flags_are_float32():
    buffer = EventTableBuffer(
        {"default": 9}, n_steps=2, gamma=0.5, num_envs=1, discounted_keys=[("next", "style_features")]
    )
    done = torch.tensor([[False], [False], [True]])
    nxt = {"task_reward": torch.tensor([[1], [2], [4]]), "style_features": torch.tensor([[True], [False], [True]])}
    buffer.extend(TensorDict({"id": torch.arange(3), "next": {**nxt, "done": done, "terminated": done}}, [3]))
    sums = buffer.table("default")["next"]
    assert sums["task_reward"].squeeze(-1).tolist() == [2.0, 4.0, 4.0]
    assert sums["style_features"].squeeze(-1).tolist() == [1.0, 0.5, 1.0]


def test_n_step_is_assembled_before_routing():
    """Neighbours in a table are not neighbours in time."""
    buffer = EventTableBuffer({"a": 9, "b": 9}, route=KeyRoute(["a", "b"]), n_steps=2, gamma=1.0, num_envs=1)
    nxt = {"reward": torch.tensor([1.0, 10.0, 100.0]).unsqueeze(-1), "done": torch.zeros(3, 1, dtype=torch.bool)}
    buffer.extend(TensorDict({"scenario": torch.tensor([0, 1, 0]), "next": nxt}, [3]))
    assert buffer.table("a")["next", "reward"].tolist() == [[11.0]]
    assert buffer.table("b")["next", "reward"].tolist() == [[110.0]]


def test_trajectories_that_were_interrupted_are_ended_alone():
    """The sums of their last steps are written without termination, and later events do not look back to them."""
    buffer = EventTableBuffer(
        {"default": 20, "hit": 20}, events=KeyEvents(["hit"]), event_horizon=4, n_steps=3, gamma=0.5
    )

    def step(numbers, reward, hit=False):
        flags = torch.zeros(len(numbers), 1, dtype=torch.bool)
        nxt = {"reward": torch.full((len(numbers), 1), reward), "done": flags, "terminated": flags}
        nxt["events"] = torch.full((len(numbers), 1), hit)
        numbers = torch.tensor(numbers)
        return TensorDict({"collector": {"traj_ids": numbers}, "next": nxt}, [len(numbers)])

    buffer.extend(step([7, 8], 1.0))
    buffer.extend(step([7, 8], 2.0))
    assert len(buffer) == 0
    buffer.finish(torch.tensor([], dtype=torch.long))
    buffer.finish(torch.tensor([8, 5]))
    table = buffer.table("default")
    assert table["collector", "traj_ids"].tolist() == [8, 8]
    assert table["next", "reward"].flatten().tolist() == [2.0, 2.0]
    assert table["steps_to_next_obs"].flatten().tolist() == [2, 1] and not table["next", "terminated"].any()
    buffer.extend(step([7, 9], 4.0))  # 9 is the environment of 8 after the interruption
    buffer.extend(step([7, 9], 8.0, hit=True))
    buffer.finish()
    table = buffer.table("default")
    of = {number: table[table["collector", "traj_ids"] == number] for number in (7, 8, 9)}
    assert of[7]["next", "reward"].flatten().tolist() == [3.0, 6.0, 8.0, 8.0]
    assert of[9]["next", "reward"].flatten().tolist() == [8.0, 8.0]
    assert buffer.table("hit")["collector", "traj_ids"].tolist() == [7, 7, 7, 7, 9, 9]

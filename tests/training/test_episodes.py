"""Statistics of episodes, from transitions written by hand."""

import pytest
import torch
from tensordict import TensorDict

from coachable.keys import STYLE, STYLE_FEATURES, STYLE_REWARD, TASK_REWARD
from coachable.training.episodes import EpisodeStatistics, EpisodeWatch


def transitions(done, terminated, sums=None, features=None):
    n = len(done)
    following = {
        "done": torch.tensor(done)[:, None],
        "terminated": torch.tensor(terminated)[:, None],
        TASK_REWARD: torch.arange(n).float()[:, None],
        STYLE_REWARD: -torch.arange(n).float()[:, None],
    }
    if sums is not None:
        following["episode_sums"] = torch.tensor(sums)
    if features is not None:
        following[STYLE_FEATURES] = features
    return TensorDict({STYLE: torch.full((n, 1), 2.0), "next": following}, [n])


def test_ended_episodes_are_counted_once_and_averaged():
    statistics = EpisodeStatistics()
    sums = [[9.0, 9.0, 9.0, 9.0], [6.0, 5.0, 1.0, 10.0], [2.0, 1.0, 1.0, 20.0]]
    statistics.add(transitions([False, True, True], [False, False, True], sums))
    found = statistics.flush()
    assert found["episode/count"] == 2
    assert found["episode/return"] == 4.0 and found["episode/task_return"] == 3.0
    assert found["episode/style_return"] == 1.0 and found["episode/length"] == 15.0
    assert found["episode/terminated"] == 0.5
    assert found["step/task_reward"] == 1.0 and found["step/style_reward"] == -1.0
    statistics.add(transitions([False], [False], [[1.0, 1.0, 1.0, 1.0]]))
    again = statistics.flush()
    assert again["episode/count"] == 0 and "episode/return" not in again


def test_style_terms_are_averaged_where_there_are_features():
    statistics = EpisodeStatistics(lambda features, theta: {"reach": features[..., 0] * theta[..., 0]})
    statistics.add(transitions([False, False], [False, False], features=torch.tensor([[1.0], [4.0]])))
    assert statistics.flush()["step/style_reach"] == pytest.approx(5.0)
    statistics.add(transitions([False], [False]))
    assert "step/style_reach" not in statistics.flush()
    plain = EpisodeStatistics()
    plain.add(transitions([False], [False], features=torch.ones(1, 1)))
    assert not [name for name in plain.flush() if name.startswith("step/style_reach")]


def test_steps_of_a_long_batch_count_as_much_as_those_of_a_short_one():
    statistics = EpisodeStatistics()
    statistics.add(transitions([False], [False]))  # task reward 0
    statistics.add(transitions([False] * 3, [False] * 3))  # 0, 1, 2
    assert statistics.flush()["step/task_reward"] == pytest.approx(3.0 / 4.0)


def test_a_training_whose_episodes_never_end_is_told_so():
    running = TensorDict({"next": {"done": torch.zeros(3, 5_000, 1, dtype=torch.bool)}}, [3, 5_000])
    watch = EpisodeWatch()
    watch.add(running)
    with pytest.warns(UserWarning, match=r"no episode has ended in 10,000 steps .* only 3 styles were seen"):
        watch.add(running)
    watch.add(running)  # once is enough
    ended = EpisodeWatch()
    ended.add(TensorDict({"next": {"done": torch.ones(3, 1, 1, dtype=torch.bool)}}, [3, 1]))
    for _ in range(3):
        ended.add(running)

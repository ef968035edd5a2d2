"""`StyleWrapper`: an environment with a style is an environment of Gymnasium."""

import functools

import numpy as np
import pytest
import torch

from coachable.styles import PointMass, StyleRangeWarning

gymnasium = pytest.importorskip("gymnasium")
from gymnasium import spaces  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402

from coachable.gym import StyleWrapper  # noqa: E402
from tests.gym_walk import Walk, moved, style_reward  # noqa: E402


@pytest.fixture
def env():
    return StyleWrapper(Walk(), style_reward(), moved)


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version.*:UserWarning")
@pytest.mark.parametrize("flat", [False, True])
def test_gymnasium_approves(flat):
    check_env(StyleWrapper(Walk(), style_reward(), moved, flat=flat), skip_render_check=True)


def test_a_registered_environment_can_be_made_again():
    env = StyleWrapper(gymnasium.make("Pendulum-v1"), style_reward(), lambda o, a, i: a)
    again = gymnasium.make(env.spec)
    assert isinstance(again, StyleWrapper) and again.observation_space == env.observation_space


def test_the_observation_is_a_dict_or_one_vector(env):
    observation, info = env.reset(seed=0)
    assert set(observation) == {"observation", "style"}
    flat = StyleWrapper(Walk(), style_reward(), moved, flat=True)
    vector, _ = flat.reset(seed=0)
    np.testing.assert_array_equal(vector, np.concatenate([observation["observation"], observation["style"]]))
    np.testing.assert_array_equal(info["style"], observation["style"])
    assert vector.dtype == np.float32 and vector.shape == flat.observation_space.shape == (5,)


class Seeing(Walk):
    """A walk whose observation is of any kind."""

    def __init__(self, space):
        self.observation_space = space

    def _observation(self):
        return self.observation_space.sample()


@pytest.mark.parametrize("space", [spaces.Dict(a=spaces.Box(-1.0, 1.0, (2,))), spaces.Tuple([spaces.Discrete(3)])])
def test_a_dict_observation_has_to_be_flattened(space):
    with pytest.raises(ValueError, match=r"the observation is a (Dict|Tuple), .* pass flat=True for one vector"):
        StyleWrapper(Seeing(space), style_reward(), moved)
    env = StyleWrapper(Seeing(space), style_reward(), moved, flat=True)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)


def test_an_observation_without_a_fixed_size_cannot_be_flattened():
    space = spaces.Dict(a=spaces.Sequence(spaces.Box(-1.0, 1.0, (2,))))
    with pytest.raises(ValueError, match="has no fixed size, so flat=True cannot make one vector of it"):
        StyleWrapper(Seeing(space), style_reward(), moved, flat=True)


def test_the_reward_is_of_the_style_that_was_shown(env):
    env.set_style({"stride": 0.5, "hat": "blue"})
    env.reset(seed=0)
    env.set_style({"stride": -0.5, "hat": "blue"})  # shown from the next observation on
    observation, reward, _, _, info = env.step(np.array([0.25], dtype=np.float32))
    assert reward == pytest.approx(1.0 - 0.25)
    assert info["task_reward"] == 1.0 and info["style_reward"] == pytest.approx(-0.25)
    np.testing.assert_array_equal(observation["style"], [-0.5, 0, 1])
    np.testing.assert_array_equal(info["style"], [-0.5, 0, 1])
    _, reward, *_ = env.step(np.array([0.25], dtype=np.float32))
    assert reward == pytest.approx(1.0 - 0.75)


def test_a_style_is_drawn_per_episode_and_kept_within(env):
    shown = []
    for episode in range(20):
        observation, _ = env.reset(seed=3 if episode == 0 else None)
        shown.append(observation["style"])
        for _ in range(3):
            observation, *_ = env.step(np.zeros(1, dtype=np.float32))
            np.testing.assert_array_equal(observation["style"], shown[-1])
    assert len({float(style[0]) for style in shown}) == 20
    env.reset(seed=3)
    np.testing.assert_array_equal(env.reset()[0]["style"], shown[1])  # the seed also restarts the draws


def test_the_draws_are_the_environments_own():
    """Neither torch's global generator nor another wrapper's decides them."""
    first, second = (StyleWrapper(Walk(), style_reward(), moved) for _ in range(2))
    torch.manual_seed(0)
    a = first.reset(seed=1)[0]["style"]
    torch.manual_seed(5)
    np.testing.assert_array_equal(second.reset(seed=1)[0]["style"], a)
    assert not np.array_equal(second.reset(seed=2)[0]["style"], a)


def test_a_held_style_stays_until_it_is_released(env):
    env.set_style({"hat": "blue", "stride": 1.0})
    for _ in range(3):
        np.testing.assert_array_equal(env.reset()[0]["style"], [1, 0, 1])
    env.set_style(None)
    assert len({float(env.reset()[0]["style"][0]) for _ in range(5)}) == 5
    env.set_style([0.25, 1, 0])
    np.testing.assert_array_equal(env.reset()[0]["style"], [0.25, 1, 0])


def test_bad_requests_change_nothing(env):
    env.set_style({"stride": 0.5})
    for request, message in [
        ({"pace": 1.0}, "unknown style parameter 'pace'"),
        ({"hat": "green"}, "is not an option"),
        ([0.5, 1.0], r"expected \(3,\)"),
        ([float("nan"), 1, 0], "NaN"),
    ]:
        with pytest.raises(ValueError, match=message):
            env.set_style(request)
    with pytest.raises(ValueError, match="outside"):
        env.set_style({"stride": 2.0}, strict=True)
    np.testing.assert_array_equal(env.reset()[0]["style"], [0.5, 1, 0])
    with pytest.warns(StyleRangeWarning, match="stride = 2 lies outside"):
        env.set_style({"stride": 2.0})
    np.testing.assert_array_equal(env.reset()[0]["style"], [1, 1, 0])


def test_styles_are_drawn_from_the_sampler_of_the_space():
    reward = style_reward()
    reward.space = reward.space.with_sampler(PointMass([0.5, 0, 1]))
    env = StyleWrapper(Walk(), reward, moved)
    np.testing.assert_array_equal(env.reset()[0]["style"], [0.5, 0, 1])


def test_options_reach_the_environment_inside(env):
    assert env.reset(options={"level": 2})[1]["options"] == {"level": 2}


def test_features_of_another_shape_are_refused():
    env = StyleWrapper(Walk(), style_reward(), lambda o, a, i: float(a[0]))
    env.reset()
    with pytest.raises(ValueError, match=r"returned shape \(\): expected \(F,\)"):
        env.step(np.zeros(1, dtype=np.float32))


def test_vectorised_environments_collect_the_style():
    make = functools.partial(StyleWrapper, Walk(), style_reward(), moved)
    vector = gymnasium.vector.SyncVectorEnv([lambda: make(), lambda: StyleWrapper(Walk(), style_reward(), moved)])
    observation, info = vector.reset(seed=0)
    np.testing.assert_array_equal(observation["style"], info["style"])
    assert observation["style"].shape == (2, 3)
    vector.call("set_style", {"stride": 0.5})
    observation, *_ = vector.step(np.zeros((2, 1), dtype=np.float32))
    np.testing.assert_array_equal(observation["style"], [[0.5, 1, 0]] * 2)

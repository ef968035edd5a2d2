"""Rivals: scripted drivers of different pace, and copies of the policy that the agent had some time ago."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from coachable.domains.racing.families import AGENTS, CARS, racing_family
from coachable.domains.racing.styles import aggressiveness_style_space
from coachable.envs.racing import RacingEnv
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.rivals import Rivals
from coachable.envs.racing.race.scenarios import rolling_start
from coachable.training.collection import SelfPlayEnv

SPACE = aggressiveness_style_space()
STYLES = (SPACE.low, SPACE.high)


class Constant(nn.Module):
    """Steers by a number that training changes."""

    def __init__(self):
        super().__init__()
        self.steer = nn.Parameter(torch.tensor(0.25))
        self.styles = []

    def forward(self, data):
        self.styles.append(data["style"])
        action = torch.stack([self.steer.expand(len(data)), torch.ones(len(data))], -1)
        return data.set("action", action)


def races(rivals_options=None, races=6, seed=0):
    env = RacingEnv(num_envs=1, track="ring", cars=1)
    driver = LineFollower(env.tracks, env.garage.typical)
    rivals = Rivals(driver, STYLES, **(rivals_options or {}))
    return RacingEnv(
        2 * races, track="ring", cars=4, controlled=2, driver=rivals, scenarios=rolling_start(4), seed=seed
    ), rivals


def step(env, n=1):
    for _ in range(n):
        env.step(TensorDict({"action": torch.zeros(env.num_envs, 2)}, env.batch_size))


def test_without_a_policy_all_are_scripted():
    env, rivals = races()
    env.reset()
    step(env, 3)
    assert not rivals.copies
    action = rivals(env.field, env._observation[env.num_envs :])
    assert action.shape == (12, 2)


def test_copies_are_of_the_past_and_drive_their_share():
    env, rivals = races({"scripted": 0.5, "interval": 2, "keep": 3}, races=200)
    assert isinstance(env, SelfPlayEnv)
    policy = Constant()
    env.follow(policy)
    env.reset()
    step(env, 2)
    with torch.no_grad():
        policy.steer.fill_(-0.75)
    assert [copy.steer.item() for copy in rivals.copies] == [0.25]
    observation = env._observation[env.num_envs :]
    action = rivals(env.field, observation)
    by_copy = action[:, 0] == 0.25
    assert 0.4 < by_copy.float().mean() < 0.6
    again = rivals(env.field, observation)  # who is scripted stays; which copy of two is drawn anew
    assert torch.equal((again[:, 0] == 0.25) | (again[:, 0] == -0.75), by_copy)
    step(env, 8)
    assert [copy.steer.item() for copy in rivals.copies][-1] == -0.75 and len(rivals.copies) == 3


def test_copies_of_a_policy_on_another_device_are_where_the_cars_are():
    _, rivals = races()
    rivals.follow(nn.Linear(2, 2, device="meta"))
    with pytest.raises(NotImplementedError, match="Cannot copy out of meta tensor"):  # it would be copied to the cars
        rivals._frozen()


def test_copies_have_styles_of_the_space():
    env, rivals = races({"scripted": 0.0, "interval": 1}, races=100)
    policy = Constant()
    env.follow(policy)
    env.reset()
    step(env)
    rivals(env.field, env._observation[env.num_envs :])
    style = rivals.copies[0].styles[-1]
    assert style.min() >= 0.0 and style[:, 0].max() > 1.5 and style[:, 1].max() <= 1.0
    assert style.std(0).min() > 0.2


def test_scripted_drivers_differ_in_pace():
    env, _ = races(races=50)
    env.reset()
    step(env, 20)
    speed = env.state[3, env.num_envs :]
    assert speed.std() > 0.5


def test_a_rivals_grip_lies_between_the_slowest_share_and_one():
    class Recorder:
        def __call__(self, field, observation, grip):
            self.grip = grip
            return torch.zeros(len(observation), 2)

    env, _ = races(races=100)
    recorder = Recorder()
    rivals = Rivals(recorder, STYLES, slowest=0.6)
    env.reset()
    rivals(env.field, env._observation[env.num_envs :])
    grip = recorder.grip.reshape(env.cars, -1)
    assert grip.min() >= 0.6 and grip.max() <= 1.0
    assert abs(grip.mean() - 0.8) < 5 * 0.4 / 12**0.5 / grip.numel() ** 0.5  # uniform
    assert len(grip.unique()) > 0.9 * grip.numel(), "each car has its own"


def test_the_state_continues_exactly():
    env, _ = races({"interval": 3})
    env.follow(Constant())
    env.set_seed(5)
    env.reset()
    step(env, 7)
    saved = env.simulator_state()
    step(env, 5)
    expected = env.state.clone()
    other, rivals2 = races({"interval": 3})
    other.follow(Constant())
    other.reset()
    other.load_simulator_state(saved)
    assert len(rivals2.copies) == 2
    step(other, 5)
    assert torch.equal(other.state, expected)
    fresh, _ = races({"interval": 3})
    with pytest.raises(ValueError, match="follow"):
        fresh.load_simulator_state(saved)


def test_the_family_has_three_agents_with_one_style():
    family = racing_family("aggressiveness")
    env = family.make_env(num_envs=2 * AGENTS, track="ring", seed=0)
    assert (env.cars, env.controlled, env.races) == (CARS, AGENTS, 2)
    assert family.make_env(num_envs=1, track="ring").controlled == 1
    style = family.make_space().sampler.sample((2 * AGENTS,), torch.Generator().manual_seed(0)).reshape(AGENTS, 2, 2)
    assert torch.equal(style[0], style[1]) and torch.equal(style[0], style[2])
    assert not torch.equal(style[:, 0], style[:, 1])


@pytest.mark.parametrize("options", [{"scripted": 1.5}, {"slowest": 0.0}, {"keep": 0}, {"interval": 0}])
def test_bad_options(options):
    with pytest.raises(ValueError, match="expected"):
        races(options)

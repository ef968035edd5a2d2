"""The shipped agents act, and are rewarded, as on the day that their behaviour was recorded."""

import json
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coachable.training.weights import domain_of, load_policy
from coachable.transforms import coachable_env

RECORDED = json.loads(Path(__file__).with_name("shipped_agents.json").read_text())
"""By agent: the styles drawn, the first and the last of eight actions, and the rewards of the eight steps."""


@pytest.mark.parametrize("name", RECORDED)
def test_actions_and_rewards_are_the_recorded_ones(name):
    recorded, agent = RECORDED[name], load_policy(name)
    domain = domain_of(agent)
    races = {"controlled": 3} if name == "racing_aggressiveness" else {}  # as they were recorded: three agents in one
    simulation = domain.make_env(num_envs=len(recorded["style"]), seed=3, **races)
    env = coachable_env(simulation, agent.space, domain.make_reward(agent.space), seed=3)
    actions, rewards, current = [], [], env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in recorded["rewards"]:
            step, current = env.step_and_maybe_reset(agent.actor(current))
            actions.append(step["action"])
            rewards.append(step["next", "reward"].flatten())
    close = {"rtol": 1e-3, "atol": 1e-3}
    torch.testing.assert_close(step["style"], torch.tensor(recorded["style"]), **close)
    torch.testing.assert_close(actions[0], torch.tensor(recorded["first_action"]), **close)
    torch.testing.assert_close(actions[-1], torch.tensor(recorded["last_action"]), **close)
    torch.testing.assert_close(torch.stack(rewards), torch.tensor(recorded["rewards"]), **close)

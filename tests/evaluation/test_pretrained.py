"""Shipped weights fit the domains that they are named after, with the preset where there are several."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import coachable.pretrained
from coachable.domain import load_domain
from coachable.training.weights import load_policy

# What they do says more than the names of their presets.
ANOTHER_NAME = {"racing_traffic": "racing_resources", "combat_full": "combat"}
SHIPPED = sorted(file.parent.name for file in Path(coachable.pretrained.__path__[0]).glob("*/weights.pt"))


def without_help(parameters):
    return [replace(parameter, help="") for parameter in parameters]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_weights_act_in_their_domain(name):
    agent = load_policy(name)
    owner = agent.metadata["domain"]
    assert ANOTHER_NAME.get(name) == owner or name in (owner, f"{owner}_{agent.config['preset']}")
    domain = load_domain(owner, agent.config)
    space = domain.make_space()
    # It may have been trained on styles drawn otherwise, and with other words for the coach.
    assert without_help(agent.space.parameters) == without_help(space.parameters)
    env = domain.make_env(num_envs=2, num_threads=1)
    start = env.reset().set("style", agent.space.sample((2,)))
    action = agent.actor(start)["action"]
    assert env.action_spec.is_in(action)
    with torch.no_grad():
        styles = torch.stack([agent.space.sample() for _ in range(8)])
        same = TensorDict({"observation": start["observation"][:1].expand(8, -1), "style": styles}, [8])
        loc = agent.actor(same)["loc"]
    assert (loc.std(0) > 0).any()  # the policy looks at the style


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_weights_name_no_path_of_the_machine_that_trained(name):
    config = load_policy(name).config
    for settings in (config, *config.get("stages", [])):
        assert not any(settings.get(key) for key in ("run_dir", "resume", "init_from"))

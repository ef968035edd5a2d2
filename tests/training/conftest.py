"""A run of a recipe and a weights file, which tests copy and damage."""

import shutil
from pathlib import Path

import pytest
import torch
from recipe_config import compose_config

from coachable.domains.humanoid import humanoid_style_space
from coachable.files import save_state
from coachable.networks import make_gaussian_actor
from tests.training.foreign import RECIPE, TINY, build


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A run of a recipe with event tables."""
    run = tmp_path_factory.mktemp("trained") / "run"
    build(compose_config(RECIPE, [*TINY, f"run_dir={run}"])).run()
    return run


@pytest.fixture
def run(trained, tmp_path):
    """A copy of that run, to be damaged."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture(scope="session")
def shipped(tmp_path_factory):
    """A small untrained humanoid as a weights file."""
    space, widths = humanoid_style_space(), [8]
    actor = make_gaussian_actor(82, 21, space, widths)
    target = {"_target_": "coachable.networks.make_gaussian_actor", "obs_dim": 82, "action_dim": 21, "widths": widths}
    file = tmp_path_factory.mktemp("weights") / "weights.pt"
    agent = {"domain": "humanoid", "space": space.to_dict(), "network": {"actor": target}, "config": {"env": {}}}
    weights = {"actor": dict(actor.state_dict()), "critics": {"x": torch.zeros(2)}}
    save_state({"schema": 1, **agent, **weights, "counters": {"frames": 1, "updates": 1}}, file)
    return file

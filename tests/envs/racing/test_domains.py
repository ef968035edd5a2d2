"""The three declarations: they make environments, measure and draw."""

from importlib import import_module

import numpy as np
import pytest
import torch

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.families import race_env
from coachable.envs.racing.measures import RacingMeasures
from coachable.envs.racing.render import RacingRenderer
from coachable.transforms import coachable_env


@pytest.mark.parametrize("family", ["drift", "resources", "aggressiveness"])
def test_a_domain_makes_measures_and_draws(family):
    domain = import_module(f"coachable.envs.racing.domains.{family}").DOMAIN
    space = domain.make_space()
    assert set(domain.grid) == set(space.names)
    env = coachable_env(domain.make_env(num_envs=4, seed=0), space, domain.make_reward(space), seed=0)
    data = env.rollout(3, break_when_any_done=False)
    assert sum(width for _, width in domain.observation_groups) == data["observation"].shape[-1]
    records = [domain.measures.step(data[:, t]) for t in range(3)]
    record = {name: torch.stack([r[name] for r in records]) for name in records[0]}
    alive = torch.ones(3, 4, dtype=torch.bool)
    summary = domain.measures.summarise(record, alive)
    assert set(domain.columns) - {"survived"} <= set(summary)
    assert domain.measures.complies(record).shape == (3, 4)
    renderer = domain.make_renderer(160, 120)
    image = renderer.draw(env, row=1)
    renderer.close()
    assert image.shape == (120, 160, 3) and image.dtype == np.uint8 and image.std() > 10


def test_five_cars_from_the_pool_start_a_race():
    env = race_env(10, seed=0)
    assert (env.reset()["observation"].abs() < 50).all()
    assert env.garage.model.shape == (2,)
    assert len(set(env.compound[2:].argmax(0).reshape(5, 2)[:, 0].tolist())) == 1


def test_an_unknown_family_is_refused():
    with pytest.raises(ValueError, match="unknown family 'speed'"):
        RacingMeasures("speed")


def test_pictures_follow_the_car():
    env = RacingEnv(2, track="ring", seed=0)
    env.reset()
    renderer = RacingRenderer(160, 120)
    assert not np.array_equal(renderer.draw(env, 0), renderer.draw(env, 1))

"""The declaration of the domain: measures add up, pictures are drawn."""

import numpy as np
import pytest
import torch

from coachable.envs.combat.domain import DOMAIN
from coachable.envs.combat.tables import STYLES
from coachable.transforms import coachable_env


@pytest.fixture(scope="module")
def rollout():
    space = DOMAIN.make_space()
    env = coachable_env(DOMAIN.make_env(num_envs=6, machines=["Burrower"]), space, DOMAIN.make_reward(space), seed=0)
    env.hold_style(space.make(melee=1.1))
    return env.rollout(40, break_when_any_done=False)


def test_measures_add_up(rollout):
    rows = [DOMAIN.measures.step(rollout[:, t]) for t in range(rollout.shape[1])]
    record = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
    summary = DOMAIN.measures.summarise(record, torch.ones(40, 6, dtype=torch.bool))
    assert set(STYLES) <= set(summary)
    by_source = sum(summary[name] for name in STYLES[:8])
    torch.testing.assert_close(by_source, summary["damage"], rtol=1e-4, atol=1e-2)
    assert torch.equal(summary["requested"], summary["melee"])
    score = summary["style_score"]
    assert (score[~score.isnan()] <= 1.0 + 1e-5).all()
    assert torch.equal(DOMAIN.measures.complies(record), record["melee"] > 0)
    assert summary["won"].sum() == (record["won"] > 0).sum()


def test_groups_cover_the_observation(rollout):
    assert sum(width for _, width in DOMAIN.observation_groups) == rollout["observation"].shape[-1]


@pytest.mark.parametrize("options", [{}, {"num_enemies": 2, "machines": ["Sunwing"], "sites": ["Shining-wastes"]}])
def test_pictures_show_the_fight(options):
    env = DOMAIN.make_env(num_envs=2, seed=0, **options)
    data = env.rollout(10, break_when_any_done=False)
    assert data.shape == (2, 10)
    renderer = DOMAIN.make_renderer(width=320, height=240)
    image = renderer.draw(env, row=1)
    renderer.close()
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 5

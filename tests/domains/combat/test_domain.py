"""The declaration of the domain: measures add up, pictures are drawn."""

import csv

import numpy as np
import pytest
import torch

from coachable.domain import load_domain
from coachable.domains.combat.domain import DOMAIN
from coachable.domains.combat.fights import composed_styles, evaluate_fights, style_label
from coachable.envs.combat.tables import ELEMENTS, STYLES, load_table
from coachable.evaluation.evaluation_settings import EvaluationSettings
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
    assert sum(group.width for group in DOMAIN.observation_groups) == rollout["observation"].shape[-1]


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


def test_the_domain_is_as_it_was_trained():
    settings = {"_target_": "x", "num_envs": 128, "machines": ["Scrounger"], "styles": ["melee", "skykiller"]}
    domain = load_domain("combat", {"env": {**settings, "observation": "small", "episode_steps": 20, "traps": 0}})
    assert domain.make_space().names == ("melee", "skykiller")
    assert [style_label(cell) for cell in domain.cells()] == ["default", "melee", "skykiller", "no skykiller"]
    env = domain.make_env(num_envs=3, seed=0)
    assert (env.observation, env.episode_steps, env.batch_size) == ("small", 20, (3,))
    assert sum(group.width for group in domain.observation_groups) == env.reset()["observation"].shape[-1]


def test_composed_requests_are_the_blastsling_with_the_elements_of_its_bombs():
    table = load_table("weapons")
    bombs = [name for name in table.rows if table.rows[name]["weapon"] == "Corrosive Blastsling"]
    elements = [table.words(name, "element", ELEMENTS)[0] for name in bombs]
    labels = [style_label(cell) for cell in composed_styles(DOMAIN.make_space())]
    assert labels == [f"corrosive_blastsling + {element}" for element in elements]


class _Idle:
    """An agent that presses nothing, with what `evaluate_fights` reads of one."""

    def __init__(self, space):
        self.space, self.config, self.metadata = space, {"env": {"machines": ["Scrounger", "Burrower"]}}, {"updates": 5}

    def actor(self, tensordict):
        action = torch.zeros(*tensordict.batch_size, 24)
        action[:, [0, 4, 10, 13, 16, 18]] = 1.0
        return tensordict.set("action", action)


def test_fights_are_counted_by_style_and_machine(tmp_path):
    domain = load_domain(
        "combat", {"env": {"styles": ["melee", "corrosive_blastsling", "acid"], "observation": "small", "traps": 0}}
    )
    agent = _Idle(domain.make_space())
    settings = EvaluationSettings(episodes=2, steps=3, progress=False)
    report = evaluate_fights(domain, agent, tmp_path, settings)
    again = evaluate_fights(domain, agent, tmp_path / "again", settings)
    assert report == again and (tmp_path / "report.md").read_text() == report
    styles = ["default", "melee", "corrosive_blastsling", "acid", "corrosive_blastsling + acid"]
    for name in ("damage", "wins", "unseen", "outcomes", "sweep"):
        rows = list(csv.DictReader((tmp_path / f"{name}.csv").read_text().splitlines()))
        if name in ("damage", "wins", "unseen"):
            assert [row["style"] for row in rows] == styles
        if name == "outcomes":
            assert [sum(int(row[key]) for key in row if key != "machine") for row in rows] == [10, 10]
    assert (tmp_path / "damage.png").stat().st_size > 5_000 and (tmp_path / "sweep.png").stat().st_size > 5_000
    with pytest.raises(ValueError, match="episodes per style must be at least 1, got 0"):
        EvaluationSettings(episodes=0)

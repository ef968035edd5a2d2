"""Styles that switch during fights: what is counted after a switch, and what the files say."""

import csv
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import torch
from combat_bots import Bot

from coachable.domain import load_domain
from coachable.domains.combat.coached_fight import (
    SOURCES,
    CoachedFights,
    draw_timeline,
    fight_coached,
    requests_of,
)
from coachable.domains.combat.fights import evaluate_fights
from coachable.envs.combat.tables import MACHINES
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.sweep import WeightSweep
from coachable.training.weights import LoadedPolicy

STYLES = ["melee", "skykiller", "part_shield"]


def coached(requested, damage, requests, *, period, done=None):
    """Sequences with the given damage; everything else is filler."""
    shape = damage.shape
    measures = {name: np.zeros(shape) for name in (*SOURCES, "won", "died", "out_of_bounds")}
    measures |= {"requested": requested, "damage": damage, "melee": damage}
    health = np.ones(shape)
    done = np.zeros(shape, dtype=bool) if done is None else done
    opponent = np.zeros(shape, dtype=int)
    return CoachedFights(("melee", "skykiller"), requests, period, 0.2, measures, health, health, opponent, done)


def test_switches_are_counted_by_hand():
    # One sequence, three windows of 4 steps: melee, Skykiller, melee; the first one has no switch before it.
    requests = np.repeat([0, 1, 0], 4)[:, None]
    damage = np.array([9, 9, 9, 9, 30, 0, 10, 0, 0, 0, 0, 5.0])[:, None]
    requested = np.array([9, 9, 9, 9, 0, 0, 10, 0, 0, 0, 0, 5.0])[:, None]
    melee, skykiller, together = coached(requested, damage, requests, period=4).switches()
    assert melee == {"style": "melee", "switches": 1, "complied": 1.0, "median_seconds": 0.8, "share": 1.0}
    assert skykiller["median_seconds"] == pytest.approx(0.6)  # the third step of the window
    assert skykiller["share"] == 0.25  # 10 of 40
    assert together["switches"] == 2 and together["share"] == pytest.approx(15 / 45)
    assert together["median_seconds"] == pytest.approx(0.7)


def test_what_never_follows_a_switch_counts_as_infinite():
    requests = np.repeat([[0, 1], [1, 0]], 2, axis=0)
    damage = np.array([[1, 1], [1, 1], [5, 5], [5, 5.0]])
    requested = np.array([[1, 1], [1, 1], [np.nan, 0], [np.nan, 0.0]])
    rows = coached(requested, damage, requests, period=2).switches()
    assert [row["complied"] for row in rows] == [0.0, 0.0, 0.0]
    assert all(np.isinf(row["median_seconds"]) for row in rows)
    assert coached(requested[:3], damage[:3], requests[:3], period=2).switches() == []  # no whole window


def test_the_timeline_ends_with_the_last_style_and_says_how_fights_ended(tmp_path):
    requests, damage = np.repeat([0, 1, 0], 4)[:, None], np.ones((12, 1))
    done = np.zeros((12, 1), dtype=bool)
    done[[2, 5, 11]] = True
    fights = coached(damage, damage, requests, period=4, done=done)
    fights.measures["won"][2] = 1.0
    rows = fights.timeline()
    assert len(rows) == 8  # both styles once
    assert [row["fight"] for row in rows] == [0, 0, 0, 1, 1, 1, 2, 2]
    assert [row["ended"] for row in rows] == ["", "", "won", "", "", "timeout", "", ""]
    assert rows[3]["seconds"] == pytest.approx(0.8)
    assert fights.outcomes() == {"fights": 3, "won": 1, "died": 0, "out_of_bounds": 0}
    draw_timeline(rows, tmp_path / "timeline.png")
    assert matplotlib.image.imread(tmp_path / "timeline.png").std() > 0.05


@pytest.fixture(scope="module")
def domain():
    settings = {"styles": STYLES, "machines": ["Burrower"], "observation": "small", "traps": 0, "episode_steps": 60}
    return load_domain("combat", {"env": settings})


class SpearBot:
    """Fights with the spear whatever is asked: reads the state of the env that it finds in `env`."""

    def __init__(self):
        self.env, self.generator = None, torch.Generator().manual_seed(0)

    def __call__(self, tensordict):
        return tensordict.set("action", Bot("melee").act(self.env, self.generator))


def agent_of(domain, actor):
    return LoadedPolicy(actor, domain.make_space(), {"env": {"machines": ["Burrower"]}}, {"updates": 5})


def test_fights_go_on_after_their_end_and_the_request_too(domain):
    bot = SpearBot()

    def make_env(**options):
        bot.env = domain.make_env(**options)
        return bot.env

    watched = replace(domain, make_env=make_env)
    fights = fight_coached(watched, agent_of(domain, bot), sequences=6, steps=90, seed=0, progress=False)
    assert fights.names == ("melee", "skykiller") and fights.period == 45
    assert (fights.requests[:45] != fights.requests[45:]).all()  # two styles: every switch changes the style
    assert (fights.requests[:45, 0] == 0).all()
    ends = fights.outcomes()
    assert ends["won"] >= 6  # a Burrower has 95 HP
    assert fights.measures["damage"].sum() > 6 * MACHINES["Burrower"].hp
    assert (fights.machine[(fights.measures["won"] * fights.done) > 0] == 0.0).all()
    melee, skykiller, _ = fights.switches()
    assert melee["complied"] > 0.8 and melee["share"] == pytest.approx(1.0)
    assert skykiller == skykiller | {"complied": 0.0, "median_seconds": np.inf, "share": 0.0}


def test_the_evaluation_has_the_switches(domain, tmp_path):
    def idle(tensordict):
        action = torch.zeros(*tensordict.batch_size, 24)
        action[:, [0, 4, 10, 13, 16, 18]] = 1.0
        return tensordict.set("action", action)

    agent = agent_of(domain, idle)
    sweeps = [
        WeightSweep(name, np.array([0.0, 1.0]), {key: np.ones((2, 1)) for key in (name, "damage", "won")})
        for name in STYLES
    ]
    settings = EvaluationSettings(episodes=1, switch_episodes=2, steps=20, progress=False, sweeps=sweeps)
    report = evaluate_fights(domain, agent, tmp_path, settings)
    assert "## Style switched every 2 s" in report and "| skykiller |" in report
    rows = {name: (tmp_path / f"{name}.csv").read_text().splitlines() for name in ("sweep", "timeline")}
    assert len(rows["sweep"]) == 1 + 6  # those given, not its own
    timeline = list(csv.DictReader(rows["timeline"]))
    assert [row["requested"] for row in timeline] == ["melee"] * 10 + ["skykiller"] * 10
    assert (tmp_path / "timeline.png").stat().st_size > 5_000
    settings = EvaluationSettings(episodes=1, switch_episodes=0, steps=2, progress=False, sweeps=sweeps)
    without = evaluate_fights(domain, agent, tmp_path / "b", settings)
    assert "switched" not in without and not (tmp_path / "b" / "timeline.csv").exists()


def test_switching_needs_two_styles():
    domain = load_domain("combat", {"env": {"styles": ["melee", "part_shield"]}})
    agent = agent_of(domain, None)
    assert requests_of(agent.space) == ("melee",)
    with pytest.raises(ValueError, match=r"styles \['melee'\]: expected at least 1 and 2 styles"):
        fight_coached(domain, agent, sequences=3, steps=10, seed=0, progress=False)

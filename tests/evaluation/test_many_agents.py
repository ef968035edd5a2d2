"""Several agents side by side."""

import csv
import json
import math

import pytest

from coachable.evaluation import many_agents
from coachable.evaluation.many_agents import evaluate_agents, side_by_side


class Agent:
    def __init__(self, source):
        self.metadata = {"domain": source.split("_")[0]}


@pytest.fixture
def evaluated(monkeypatch):
    """Evaluations that write the summary with the source's name, and return that name."""
    summaries = {}

    def evaluate(source, out, **settings):
        assert settings == {"episodes": 3}
        out.mkdir(parents=True)
        (out / "summary.json").write_text(json.dumps(summaries[source]))
        return source

    monkeypatch.setattr(many_agents, "evaluate", evaluate)
    monkeypatch.setattr(many_agents, "load_policy", Agent)
    return summaries


def test_the_numbers_of_all_agents_are_in_one_table(evaluated, tmp_path):
    evaluated["car_a"] = {"seed": 0, "trial": {"best": 80.0, "laps": [3, None]}, "name": "a", "fine": True}
    evaluated["car_b"] = {"seed": 0, "trial": {"best": 84.0, "laps": [5, 1]}, "name": "b", "fine": True}
    text = evaluate_agents(["car_a", "car_b"], tmp_path, episodes=3)
    assert "| trial, best | 80 | 84 | 82 | 2.828 |" in text
    with (tmp_path / "agents.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["quantity"] for row in rows] == ["seed", "trial, best", "trial, laps, 0", "trial, laps, 1"]
    assert list(rows[0]) == ["quantity", "1_car_a", "2_car_b", "mean", "std"]
    assert rows[3]["1_car_a"] == rows[3]["std"] == "nan" and rows[3]["mean"] == "1"


def test_bounds_are_shown_alone(evaluated, tmp_path):
    for source, laps in (("car_a", 0.9), ("car_b", 1.0), ("car_c", 0.8)):
        evaluated[source] = {"seed": 0, "bounds": {"clean laps": laps}}
    text = evaluate_agents(["car_a", "car_b", "car_c"], tmp_path, episodes=3)
    assert text.splitlines()[2:] == ["| clean laps | 0.9 | 1 | 0.8 | 0.9 | 0.1 |"]


def test_agents_without_a_common_number_have_no_table(evaluated, tmp_path):
    evaluated["car_a"], evaluated["car_b"] = {"bounds": {"clean laps": None}}, {"bounds": {"clean laps": None}}
    assert evaluate_agents(["car_a", "car_b"], tmp_path, episodes=3) == ""
    assert not (tmp_path / "agents.csv").exists()


def test_a_single_agent_has_its_own_report(evaluated, tmp_path):
    evaluated["car_a"] = {}
    assert evaluate_agents(["car_a"], tmp_path / "out", episodes=3) == "car_a"
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["summary.json"]


def test_numbers_that_an_agent_lacks_are_left_out():
    rows = side_by_side({"a": {"x": 1.0, "y": 2.0}, "b": {"x": 3.0}})
    assert [row["quantity"] for row in rows] == ["x"] and rows[0]["mean"] == 2.0
    assert side_by_side({"a": {"x": math.nan}, "b": {"x": math.nan}}) == []

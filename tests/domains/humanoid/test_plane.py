"""The plane of speed and step length: what counts as walked, and the evaluation of an agent."""

import csv

import numpy as np
import pytest
from tensordict.nn import TensorDictModule
from torch import zeros

from coachable.domain import load_domain
from coachable.domains.humanoid import gait_style_space
from coachable.domains.humanoid.plane import plane_rows
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.style_grid import StyleGrid
from coachable.training.weights import LoadedPolicy


@pytest.mark.parametrize(
    ("survived", "speed", "length", "walked"),
    [
        ([1.0] * 10, 0.9, 0.5, "yes"),
        ([1.0] * 9 + [0.0], 0.9, 0.5, "yes"),
        ([1.0] * 8 + [0.0] * 2, 0.9, 0.5, "no"),
        ([1.0] * 10, 1.04, 0.45, "yes"),
        ([1.0] * 10, 1.06, 0.5, "no"),
        ([1.0] * 10, 0.9, 0.57, "no"),
        ([1.0] * 10, np.nan, 0.5, "no"),
    ],
)
def test_a_style_is_walked_without_falls_and_as_asked(survived, speed, length, walked):
    episodes = {"survived": survived, "speed": [speed] * 10, "step_length": [length] * 10}
    cell = {"pose": "t_pose", "step_length": 0.5, "speed": 0.9}
    (row,) = plane_rows(StyleGrid([cell], {k: np.array([v]) for k, v in episodes.items()}, 0, 100))
    assert row["walked"] == walked
    assert row["steps_per_second"] == pytest.approx(1.8)


def test_the_grid_is_five_speeds_times_five_lengths_in_each_pose():
    domain = load_domain("humanoid_gait")
    cells = domain.cells()
    assert len(cells) == 75 and len({cell["speed"] for cell in cells}) == 5
    for cell in cells:
        domain.make_space().make(strict=True, **cell)


def test_the_evaluation_names_the_styles_that_are_not_walked(tmp_path):
    limp = TensorDictModule(
        lambda observation: zeros(len(observation), 21), in_keys=["observation"], out_keys=["action"]
    )
    domain = load_domain("humanoid_gait")
    settings = EvaluationSettings(episodes=1, switch_episodes=1, steps=40, num_threads=1, progress=False)
    report = domain.evaluation(domain, LoadedPolicy(limp, gait_style_space(), {}, {}), tmp_path / "out", settings)
    assert "Walked: 0 of 75 styles" in report and "| pushes of 150 N | 2 |" in report
    assert (tmp_path / "out" / "report.md").read_text() == report
    assert (tmp_path / "out" / "plane.png").is_file()
    with (tmp_path / "out" / "plane.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 75 and {row["walked"] for row in rows} == {"no"}

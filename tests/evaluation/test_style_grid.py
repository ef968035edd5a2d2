"""The grid, the switching test and their files, on an env whose outcome is known: its action is its measured style."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.domain import Domain, load_domain
from coachable.evaluation.episode_records import record_episodes
from coachable.evaluation.evaluate import evaluate_styles
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.style_grid import evaluate_grid, markdown_table, write_csv
from coachable.evaluation.switching import SwitchReport, evaluate_switching
from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace
from coachable.training.weights import LoadedPolicy
from coachable.transforms import coachable_env
from tests.evaluation.toy import IGNORED, ToyEnv, ToyMeasures

SPACE = StyleSpace([Choice("hat", ("red", "blue")), Setpoint("speed", 0.0, 2.0, unit="m/s")], name="toy")


DOMAIN = Domain(
    name="toy",
    make_env=ToyEnv,
    make_space=lambda: SPACE,
    make_reward=lambda space: StyleReward(space, {"all": IGNORED}),
    measures=ToyMeasures(),
    make_renderer=lambda width, height: None,
    grid={"hat": ("red", "blue"), "speed": (0.0, 1.0, 2.0)},
    control_step=0.1,
    episode_steps=10,
)
# Obeys under a red hat; ignores the request under a blue one.
POLICY = TensorDictModule(
    lambda observation, style: torch.where(style[:, :1] > 0, style[:, 2:], torch.full_like(style[:, 2:], 1.0)),
    in_keys=["observation", "style"],
    out_keys=["action"],
)


@pytest.fixture(scope="module")
def grid():
    return evaluate_grid(DOMAIN, POLICY, SPACE, episodes=3, progress=False)


def test_each_cell_gets_its_style_and_its_metrics(grid):
    assert len(grid.cells) == 6
    rows = grid.rows()
    for row in rows:
        obeyed = row["speed"] if row["hat"] == "red" else 1.0
        assert row["measured_speed"] == pytest.approx(obeyed)
        assert row["error"] == pytest.approx(abs(obeyed - row["speed"]))
        assert row["episodes"] == 3
        # Wilson's interval: three episodes that all survive say little about the next one.
        survived = (row["survived_low"], row["survived_high"])
        assert survived == pytest.approx((0.4385, 1.0) if row["survived"] else (0.0, 0.5615), abs=1e-4)


def test_an_episode_counts_until_its_end(grid):
    fast = grid.cells.index({"hat": "red", "speed": 2.0})
    np.testing.assert_array_equal(grid.episodes["survived"][fast], 0)
    np.testing.assert_array_equal(grid.episodes["steps"][fast], 5)
    np.testing.assert_array_equal(grid.episodes["task_return"][fast], 5)
    others = [i for i in range(6) if i != fast]
    np.testing.assert_array_equal(grid.episodes["survived"][others], 1)
    np.testing.assert_array_equal(grid.episodes["steps"][others], 10)


def test_response_tells_the_obedient_from_the_deaf(grid):
    red, blue = grid.response(SPACE)
    assert red["hat"] == "red"
    assert red["slope"] == pytest.approx(1.0)
    assert red["rank_correlation"] == pytest.approx(1.0)
    assert red["mean_error"] == pytest.approx(0.0)
    assert blue["slope"] == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(blue["rank_correlation"])
    assert blue["mean_error"] == pytest.approx(2 / 3)


def test_recorded_styles_follow_the_schedule():
    env = coachable_env(ToyEnv(2), SPACE, DOMAIN.make_reward(SPACE), seed=0)
    styles = torch.stack([SPACE.make(hat="red", speed=v) for v in (0.5, 1.0)]).repeat_interleave(2, 0).view(2, 2, 3)
    record = record_episodes(env, POLICY, lambda step: styles[step // 3], DOMAIN.measures, steps=6, seed=0)
    torch.testing.assert_close(record.measures["speed"][:, 0], torch.tensor([0.5] * 3 + [1.0] * 3))
    assert record.style.shape == (6, 2, 3)


def test_switches_do_not_count_where_compliance_cannot_be_judged():
    class Unjudged(ToyMeasures):
        def judged(self, record):
            return torch.zeros_like(record["error"], dtype=torch.bool)

    domain = replace(DOMAIN, measures=Unjudged())
    report = evaluate_switching(domain, POLICY, SPACE, episodes=20, steps=4, progress=False)
    assert (report.switches, len(report.comply_seconds)) == (0, 0) and np.isnan(report.complied)
    assert report.metrics["survived"] == 1.0


def test_switching_counts_compliance_per_switch():
    report = evaluate_switching(DOMAIN, POLICY, SPACE, episodes=200, steps=4, progress=False)
    # The style has four spans; the half of the styles with a red hat is obeyed at once, i.e. after one step of 0.1 s.
    assert (report.period, report.switches) == (1, 600)
    assert report.complied == pytest.approx(0.5, abs=5 * (0.25 / 600) ** 0.5)
    torch.testing.assert_close(report.comply_seconds, torch.full_like(report.comply_seconds, 0.1))


def test_a_switch_counts_if_a_whole_period_follows():
    report = evaluate_switching(DOMAIN, POLICY, SPACE, episodes=20, steps=9, progress=False)
    assert report.period == 2 and 50 < report.switches <= 3 * 20  # before steps 2, 4 and 6, not 8; some have ended


def test_a_switch_before_a_fall_counts_although_no_episode_lives_longer():
    racer = TensorDictModule(lambda style: torch.full_like(style[:, 2:], 2.0), in_keys=["style"], out_keys=["action"])
    report = evaluate_switching(DOMAIN, racer, SPACE, episodes=20, steps=8, progress=False)  # all fall in step 5
    assert (report.period, report.switches) == (2, 2 * 20)


def test_a_measure_of_steps_does_not_stand_for_the_share_of_the_switches():
    class Racing(ToyMeasures):
        def summarise(self, record, alive):
            return super().summarise(record, alive) | {"complied": torch.full(alive.shape[1:], 0.1)}

    report = evaluate_switching(replace(DOMAIN, measures=Racing()), POLICY, SPACE, episodes=20, steps=4, progress=False)
    assert "complied" not in report.metrics and report.complied > 0.3


def test_the_median_of_an_even_number_of_waits_is_between_the_middle_two():
    report = SwitchReport(100, {}, torch.tensor([0.4, 0.1, 0.2, 0.8]), complied=1.0, switches=4)
    assert report.median_seconds == pytest.approx(0.3)
    assert np.isnan(SwitchReport(100, {}, torch.empty(0), complied=0.0, switches=4).median_seconds)


def test_trials_and_medians_are_reported(tmp_path):
    two_of_nine_fall = torch.tensor([1.5] * 7 + [0.5] * 2)
    domain = replace(
        DOMAIN,
        trials={"calm": {}, "gale": {"limit": two_of_nine_fall}},
        columns={"survived": ".0%", "measured_speed": ".2f", "error": ".2f"},
        targets={"error": 0.2},
        units={"error": "m/s"},
    )
    agent = LoadedPolicy(POLICY, SPACE, {}, {})
    settings = EvaluationSettings(episodes=5, switch_episodes=2, progress=False)
    report, grid = evaluate_styles(domain, agent, tmp_path, settings)
    assert len(grid.cells) == 6
    assert "| hat | speed [m/s] | survived | measured_speed [m/s] | error [m/s] |" in report
    assert "| speed [m/s] | " in report and "\n| survived | speed [m/s] | error [m/s] |" in report
    assert "| calm | 9 | 9 | 70% | 100% |" in report
    assert "| gale | 9 | 7 | 45% | 94% |" in report
    assert "| error | m/s | 0.00 | 0.00 | 1.00 | 0.2 | yes |" in report  # 0, 0, 0, 1, 0, 1
    assert "| survived |  | 100% | 0% | 100% |  |  |" in report
    assert "gale,9,7," in (tmp_path / "trials.csv").read_text()
    assert (tmp_path / "medians.csv").is_file()


def test_targets_of_metrics_that_are_not_published_are_reported(tmp_path):
    agent, settings = LoadedPolicy(POLICY, SPACE, {}, {}), EvaluationSettings(1, switch_episodes=0, progress=False)
    domain = replace(DOMAIN, targets={"speed": 1.0})
    report, _ = evaluate_styles(domain, agent, tmp_path, settings)
    assert (
        "| speed |  | 1 | 0 | 2 | 1 | yes |" in report and "\n| error |  | " in report
    )  # all are published by default
    report, _ = evaluate_styles(replace(domain, columns={"survived": ".0%"}), agent, tmp_path, settings)
    assert "| speed |  | 1 | 0 | 2 | 1 | yes |" in report and "\n| error |  | " not in report
    with pytest.warns(UserWarning, match="targets of the domain toy name pace: expected some of survived, steps"):
        evaluate_styles(replace(domain, targets={"pace": 1.0}), agent, tmp_path, settings)


def test_published_columns_that_a_grid_does_not_have(tmp_path):
    agent, settings = LoadedPolicy(POLICY, SPACE, {}, {}), EvaluationSettings(1, switch_episodes=0, progress=False)
    domain = replace(DOMAIN, grid={"hat": ("red", "blue")}, columns={"survived": ".0%", "measured_speed": ".2f"})
    report, _ = evaluate_styles(domain, agent, tmp_path, settings)
    assert "| hat | survived | speed [m/s] |" in report  # no speed is requested that it could be mistaken for
    with pytest.warns(UserWarning, match="columns of the domain toy name pace: expected some of survived, steps"):
        report, _ = evaluate_styles(replace(domain, columns={"pace": "", "survived": ".0%"}), agent, tmp_path, settings)
    assert "| hat | survived |" in report


def test_names_that_are_no_formula_are_drawn(tmp_path):
    space = StyleSpace([Choice("hat", ("$x^$", "a|b")), Setpoint("speed", 0.0, 2.0)], name="toy")
    domain = replace(DOMAIN, make_space=lambda: space, grid={"hat": ("$x^$", "a|b"), "speed": (0.0, 1.0, 2.0)})
    agent, settings = LoadedPolicy(POLICY, space, {}, {}), EvaluationSettings(2, switch_episodes=0, progress=False)
    report, _ = evaluate_styles(domain, agent, tmp_path, settings)
    assert r"| a\|b | 0 |" in report and (tmp_path / "grid.png").stat().st_size > 1000


def test_a_domain_without_trials_and_targets_reports_none(tmp_path):
    settings = EvaluationSettings(episodes=1, switch_episodes=1, progress=False)
    report, _ = evaluate_styles(DOMAIN, LoadedPolicy(POLICY, SPACE, {}, {}), tmp_path, settings)
    assert "Trials" not in report and "Median" not in report
    assert {file.name for file in tmp_path.iterdir()} == {
        *("grid.csv", "grid.png", "report.md", "response.csv", "summary.json"),
    }


def test_styles_may_name_some_parameters_only(tmp_path):
    """The others have their default, and a table has the same columns in every row."""
    domain = replace(DOMAIN, grid=[{"speed": 2.0}, {"hat": "blue"}])
    settings = EvaluationSettings(episodes=1, switch_episodes=1, progress=False)
    _, found = evaluate_styles(domain, LoadedPolicy(POLICY, SPACE, {}, {}), tmp_path, settings)
    assert found.cells == [{"speed": 2.0, "hat": "red"}, {"speed": 1.0, "hat": "blue"}]
    domain = replace(DOMAIN, grid={"hat": ("red",)})  # the speed is measured
    _, found = evaluate_styles(domain, LoadedPolicy(POLICY, SPACE, {}, {}), tmp_path, settings)
    assert found.cells == [{"hat": "red"}]
    text = (tmp_path / "summary.json").read_text()
    assert "NaN" not in text and json.loads(text)


def test_one_request_has_no_slope():
    domain = replace(DOMAIN, grid=[{"hat": "red", "speed": 2.0}])
    [row] = evaluate_grid(domain, POLICY, SPACE, episodes=3, progress=False).response(SPACE)
    assert np.isnan(row["slope"]) and row["mean_error"] == pytest.approx(0.0)


def test_without_switch_episodes_the_style_does_not_switch(tmp_path):
    settings = EvaluationSettings(episodes=1, switch_episodes=0, progress=False)
    report, _ = evaluate_styles(DOMAIN, LoadedPolicy(POLICY, SPACE, {}, {}), tmp_path, settings)
    assert "Response to the request" in report and "switched" not in report
    assert "switching" not in json.loads((tmp_path / "summary.json").read_text())


def test_tables(tmp_path):
    rows = [{"hat": "red", "speed": 0.12345}, {"hat": "blue", "speed": 2.0}]
    assert markdown_table(rows, {"hat": "", "speed": ".2f"}).splitlines()[2] == "| red | 0.12 |"
    write_csv(rows, tmp_path / "rows.csv")
    assert (tmp_path / "rows.csv").read_text().split() == ["hat,speed", "red,0.12345", "blue,2"]


def test_an_unknown_domain_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown domain 'chess': expected one of \['combat', 'humanoid', .*'racing_"):
        load_domain("chess")


def test_no_episodes_are_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        evaluate_grid(DOMAIN, POLICY, SPACE, episodes=0)


def test_longer_episodes_are_those_of_the_environment():
    made = []
    domain = replace(DOMAIN, make_env=lambda num_envs, episode_steps=10: made.append(episode_steps) or ToyEnv(num_envs))
    for steps in (10, 15):
        grid = evaluate_grid(domain, POLICY, SPACE, episodes=1, steps=steps, progress=False)
        assert grid.steps == steps and grid.episodes["steps"].max() == steps
    assert made == [10, 15]
    with pytest.raises(ValueError, match="steps is 15: expected at most 10, the length of an episode"):
        evaluate_grid(DOMAIN, POLICY, SPACE, episodes=1, steps=15, progress=False)


def test_a_grid_too_small_for_a_line_is_drawn_although_only_the_request_is_published(tmp_path):
    domain = replace(DOMAIN, grid={"speed": (0.5, 1.5)}, columns={"measured_speed": ".2f"})
    agent = LoadedPolicy(POLICY, SPACE, {}, {})
    evaluate_styles(domain, agent, tmp_path, EvaluationSettings(2, switch_episodes=0, progress=False))
    assert (tmp_path / "grid.png").stat().st_size > 1000

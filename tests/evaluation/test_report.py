"""The report of an agent whose behaviour is known: it does as it is told under a red hat, and only then."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.cli import main
from coachable.domain import Domain, load_domain
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.report import report, write_report
from coachable.evaluation.report_page import shown, table
from coachable.evaluation.runs import Estimate, Run, StyleTable, describe, estimate
from coachable.evaluation.style_grid import StyleGrid
from coachable.evaluation.sweep import sweep_weights
from coachable.evaluation.switching import SwitchReport
from coachable.evaluation.wording import counted, heading_of
from coachable.scene.look import TITLE, icon_link, stylesheet
from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Weight, WeightedFeature
from coachable.training.weights import LoadedPolicy, load_policy
from tests.evaluation.toy import IGNORED, ToyEnv, ToyMeasures

SPACE = StyleSpace(
    [Choice("hat", ("red", "blue")), Setpoint("speed", 0.0, 2.0, unit="m/s"), Weight("bold", -1.0, 4.0)], name="toy"
)


def toy_reward(space):
    return StyleReward(space, {"ignored": IGNORED, "bold": WeightedFeature("bold", 0)}, {"bold": 2.0})


DOMAIN = Domain(
    name="toy",
    make_env=ToyEnv,
    make_space=lambda: SPACE,
    make_reward=toy_reward,
    measures=ToyMeasures(),
    make_renderer=lambda width, height: None,
    grid={"hat": ("red", "blue"), "speed": (0.0, 0.5, 1.0, 2.0)},
    control_step=0.1,
    episode_steps=10,
    columns={"survived": ".0%", "measured_speed": ".2f", "error": ".2f"},
)


def act(observation, style):
    """The requested speed under a red hat, else 1; a quarter more per unit of boldness."""
    return torch.where(style[:, :1] > 0, style[:, 2:3], torch.ones_like(style[:, 2:3])) + 0.25 * style[:, 3:]


AGENT = LoadedPolicy(
    TensorDictModule(act, in_keys=["observation", "style"], out_keys=["action"]),
    SPACE,
    {},
    {"domain": "toy", "source": "toy.pt", "frames": 1000, "updates": None},
)
SMALL = {"seeds": 3, "episodes": 2, "switch_episodes": 4, "progress": False}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    (out / "text").write_text(write_report(DOMAIN, {"toy.pt": AGENT}, out, **SMALL))
    return out


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_every_style_with_its_interval(folder):
    rows = rows_of(folder / "styles.csv")
    assert len(rows) == 8
    for row in rows:
        did = float(row["speed"]) if row["hat"] == "red" else 1.0
        for column in ("measured_speed", "measured_speed_low", "measured_speed_high"):
            assert float(row[column]) == pytest.approx(did)
        assert float(row["survived"]) == (did <= 1.6)


def test_the_summary_names_the_extremes(folder):
    survived, speed, _ = rows_of(folder / "summary.csv")
    # One of eight styles ends early: the middle half of 3 runs x 8 styles is all ones.
    assert (survived["metric"], survived["all styles"], survived["lowest"]) == ("survived", "1", "0")
    assert survived["lowest at"] == "red, speed 2"
    assert float(survived["mean"]) == 7 / 8
    assert (speed["metric"], speed["highest"], speed["highest at"]) == ("measured_speed", "2", "red, speed 2")


def test_requests_are_followed_under_a_red_hat(folder):
    red, blue = rows_of(folder / "requests.csv")
    assert (red["hat"], blue["hat"]) == ("red", "blue")
    assert float(red["slope"]) == pytest.approx(1.0) and float(blue["slope"]) == pytest.approx(0.0, abs=1e-6)
    assert float(red["mean_error"]) == pytest.approx(0.0, abs=1e-6)


def test_a_weight_buys_style_with_survival():
    (sweep,) = sweep_weights(DOMAIN, AGENT, points=5, episodes=2, progress=False)
    assert sweep.weight == "bold"
    np.testing.assert_allclose(sweep.values, [0, 1, 2, 3, 4])  # from neutral, not from the lowest
    # The default style asks for a speed of 1 under a red hat. Scale 2 per unit of the feature, whatever the weight.
    assert sweep.score == "unit_style_reward"
    np.testing.assert_allclose(sweep.episodes[sweep.score][:, 0], 2 * np.array([1, 1.25, 1.5, 1.75, 2.0]))
    np.testing.assert_array_equal(sweep.episodes["survived"], [[1, 1]] * 3 + [[0, 0]] * 2)


def test_a_domain_may_measure_a_weight_itself():
    class Measures(ToyMeasures):
        def step(self, transition):
            return {**super().step(transition), "bold": transition["action"].squeeze(-1)}

    domain = Domain(**{**vars(DOMAIN), "measures": Measures()})
    (sweep,) = sweep_weights(domain, AGENT, points=2, episodes=1, progress=False)
    assert sweep.score == "bold"
    np.testing.assert_allclose(sweep.episodes["bold"][:, 0], [1.0, 2.0])


def test_without_weights_there_is_no_sweep(tmp_path):
    space = StyleSpace([Setpoint("speed", 0.0, 2.0)])
    assert sweep_weights(DOMAIN, AGENT._replace(space=space), progress=False) == []


def test_the_page_is_one_file(folder):
    page = (folder / "report.html").read_text()
    for title in ("Summary", "Every style", "Requested and measured", "Styles that change", "What a style costs"):
        assert re.search(rf"<h2[^>]*>{title}", page)
    assert set(re.findall(r'(?:src|href)="([a-z]+:|[^#])', page)) == {"data:"}
    text = re.sub(r'src="data:[^"]*"', "", page)
    assert "<script" not in text and "nan" not in text and "toy.pt" in text
    assert stylesheet() in page and f"<title>{TITLE}: toy" in page and icon_link() in page
    pictures = {"styles.png", "requests.png", "switches.png", "tradeoffs.png"}
    assert page.count("<img") == len(pictures)
    tables = {"styles.csv", "summary.csv", "requests.csv", "switches.csv", "tradeoffs.csv"}
    assert {path.name for path in folder.iterdir()} == {*pictures, *tables, "report.html", "text"}


def test_what_a_domain_measures_itself_is_on_the_page(tmp_path):
    def evaluation(domain, agent, out, settings):
        assert replace(settings, sweeps=None) == EvaluationSettings(episodes=2, switch_episodes=4, progress=False)
        assert [sweep.weight for sweep in settings.sweeps] == ["bold"]
        (out / "every_step.csv").write_text("step\n" + "1\n" * 101)
        (out / "wins.csv").write_text("style,easy_machine,wait,km\nred,0.5,inf,nan\nblue,0.25,2.63,12345.6\n")
        (out / "wins.png").write_bytes((out.parent / "styles.png").read_bytes())
        return "not used"

    domain = replace(DOMAIN, evaluation=evaluation)
    write_report(domain, {"toy.pt": AGENT}, tmp_path, **SMALL)
    page = (tmp_path / "report.html").read_text()
    assert "101 rows: toy/every_step.csv" in page
    assert ">Wins</h2>" in page and "wins, a figure" in page and "easy machine" in page and "0.5" in page
    assert "2.63" in page and ">12346<" in page


def test_task_success_is_no_style(tmp_path):
    class Bold(ToyMeasures):
        def step(self, transition):
            return super().step(transition) | {"bold": transition["style"][:, 3]}

    domain = replace(DOMAIN, measures=Bold(), columns={"measured_bold": ".2f", "survived": ".0%"})
    write_report(domain, {"toy.pt": AGENT}, tmp_path, **SMALL)
    assert "success is survived" in (tmp_path / "report.html").read_text()


def test_the_same_seed_gives_the_same_files(folder, tmp_path):
    write_report(DOMAIN, {"toy.pt": AGENT}, tmp_path, **SMALL)
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (folder / path.name).read_bytes(), path.name


def test_the_text_says_where_it_is(folder):
    text = (folder / "text").read_text()
    assert "survived: 100% [100%, 100%]; lowest 0% [0%, 0%] at red, speed 2" in text
    assert text.endswith(f"wrote {folder / 'report.html'}")


def test_several_agents_are_a_run_each(tmp_path):
    deaf = AGENT._replace(
        actor=TensorDictModule(lambda o, s: torch.ones_like(o), in_keys=["observation", "style"], out_keys=["action"])
    )
    agents = {"a": AGENT, "b": AGENT, "c": AGENT, "deaf": deaf}
    write_report(DOMAIN, agents, tmp_path, **SMALL)
    halted = next(row for row in rows_of(tmp_path / "styles.csv") if (row["hat"], row["speed"]) == ("red", "0"))
    # Three agents at 0 and one at 1: the middle half is 0, and resamples reach higher.
    assert (float(halted["measured_speed"]), float(halted["measured_speed_low"])) == (0.0, 0.0)
    assert 0 < float(halted["measured_speed_high"]) <= 1
    assert "deaf" in (tmp_path / "report.html").read_text()


def test_another_kind_of_grid(tmp_path):
    """No numeric axis, metrics that the domain does not name, an agent that never lives to see a switch."""
    domain = Domain(**{**vars(DOMAIN), "grid": {"hat": ("red", "blue")}, "columns": {}})
    text = write_report(domain, {"toy.pt": AGENT}, tmp_path, **SMALL, steps=1)
    page = (tmp_path / "report.html").read_text()
    assert "task return" in page and "Requested and measured" not in page
    assert "Styles that change" not in page and "switches" not in text and not (tmp_path / "switches.csv").exists()


def test_of_many_parameters_only_what_is_asked_for_is_named():
    space = StyleSpace([Weight(name, 0.0, 5.0) for name in ("melee", "fire", "frost", "lure")])
    cells = [dict.fromkeys(space.names, 0.0), {**dict.fromkeys(space.names, 0.0), "fire": 5.0}]
    grid = StyleGrid(cells, {"survived": np.ones((2, 3))}, 0, 10)
    table = StyleTable([Run("seed 0", grid, SwitchReport(100, {}, torch.empty(0), 0.0, 0), [])], space)
    row = table.rows(["survived"])[1]
    assert row["style"] == "fire 5" and row["survived"].value == 1.0
    assert np.isnan([row["survived"].low, row["survived"].high]).all()  # of one run there is no interval
    assert table.labels[0] == "default"


def test_agents_of_different_kinds_are_refused(make_train, tmp_path):
    make_train(total_frames=80).run()
    with pytest.raises(ValueError, match="cannot share a report with humanoid: the one belongs to echo, the other"):
        report(["humanoid", tmp_path / "run"], tmp_path)
    with pytest.raises(ValueError, match="seeds must be at least 1, got 0"):
        write_report(DOMAIN, {"toy.pt": AGENT}, tmp_path, seeds=0)


@pytest.mark.slow
def test_the_command_on_the_humanoid(tmp_path, capsys):
    arguments = ["report", "humanoid", "--out", str(tmp_path), "--seeds", "2", "--episodes", "1", "--steps", "120"]
    assert main([*arguments, "--switch-episodes", "2", "--threads", "1"]) == 0
    assert "wrote" in capsys.readouterr().out
    assert len(rows_of(tmp_path / "styles.csv")) == 24
    assert load_policy("humanoid").space.names == ("pose", "step_length")


def test_estimates():
    scores = np.array([[0.0, 10.0], [2.0, 12.0], [4.0, 14.0], [6.0, 16.0]])
    value, low, high = estimate(scores)
    assert value == 8.0  # the middle four of eight: 4, 6, 10, 12
    assert low < 8.0 < high
    assert estimate(np.array([1.0, np.nan, 1.0])) == (1.0, 1.0, 1.0)
    assert np.isnan(estimate(np.array([np.nan]))).all()


def test_how_numbers_are_written():
    assert shown(Estimate(0.5, 0.25, 0.75), ".0%") == "50% [25%, 75%]"
    assert shown(float("nan"), ".2f") == "n/a"
    assert shown(Estimate(0.5, np.nan, np.nan), ".0%") == "50%"
    assert describe({"pose": "t_pose", "step_length": 0.5}) == "t pose, step length 0.5"
    text = table([{"style": "<b>", "score": Estimate(1.0, 0.5, 2.0)}], {"score": ".1f"}, colour=True)
    assert "&lt;b&gt;" in text and "1.0 <small>[0.5, 2.0]</small>" in text


def test_headings_have_units_and_one_is_singular():
    domain = load_domain("humanoid")
    space = domain.make_space()
    assert heading_of(domain, space, "power", ".0f") == "power [W]"
    assert heading_of(domain, space, "measured_step_length", ".3f") == "measured step length [m]"
    assert heading_of(domain, space, "step_length_error", ".3f") == "step length error [m]"
    assert heading_of(domain, space, "survived", ".0%") == "survived"
    assert (counted(1, "episode"), counted(2, "episode")) == ("1 episode", "2 episodes")

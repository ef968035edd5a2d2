"""Evaluations of racing: numbers checked by hand, and whole runs of a scripted driver."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from coachable.domain import load_domain
from coachable.domains.racing import laps, stints, traffic
from coachable.domains.racing.drifts import evaluate_drift
from coachable.domains.racing.families import racing_family
from coachable.domains.racing.laps import circuits_report, circuits_summary, drive_circuits
from coachable.domains.racing.metrics import whole_turns
from coachable.domains.racing.races import _count, _overtakes, _pair_results, evaluate_aggressiveness
from coachable.domains.racing.races import _rows as race_rows
from coachable.domains.racing.stints import Stint, _rows, _stint, evaluate_resources, frontier, range_at
from coachable.domains.racing.traffic import draw_traffic, race_in_traffic, traffic_report, traffic_response
from coachable.envs.racing.circuit.circuits import load_track, load_tracks
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.physics.cars import load_car
from coachable.envs.racing.physics.state import ROW
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.statistics import wilson_interval
from coachable.training.weights import LoadedPolicy


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def scripted(family, car, **settings):
    """A domain on the ring and an "agent" that looks at the simulator instead of the observation."""
    domain = load_domain(f"racing_{family}", {"env": {"track": "ring", "car": car, **settings}})
    made = []

    def make_env(**options):
        driver = LineFollower(
            load_tracks(options.get("track", "ring")), load_car("gt3" if car == "pool" else car), grip=0.8
        )
        made.append((domain.make_env(**options), driver))
        return made[-1][0]

    class Policy(torch.nn.Module):
        def forward(self, data):
            env, driver = made[-1]
            return data.set("action", driver(env.field, data["observation"]))

    agent = LoadedPolicy(Policy(), racing_family(family).make_space(), {"env": {"track": "ring", "car": car}}, {})
    return replace(domain, make_env=make_env), agent


@pytest.fixture
def one_circuit(monkeypatch):
    """Only the ring to drive on."""
    monkeypatch.setattr(laps, "DRIVEN", ("ring",))


def test_laps_of_a_stint_are_cut_at_the_line():
    # 30 m/s on a lap of 75 m: 2.5 s each; the flag is raised once, in the second lap.
    distance = 3.0 * np.arange(1, 101)[:, None]
    off = np.zeros((100, 1))
    off[30] = 1.0
    fuel = 100.0 - 0.1 * np.arange(1, 101)[:, None]
    measured = {"distance": distance, "off_time": off, "fuel": fuel, "wear": np.zeros((100, 1))}
    stint = _stint(measured, np.ones((100, 1), dtype=bool), 0, 75.0, "fuel")
    np.testing.assert_allclose(stint.laps, 2.5)
    assert stint.clean.tolist() == [True, False, True, True]
    np.testing.assert_allclose(stint.left, [97.5, 95.0, 92.5, 90.0])
    assert stint.per_km == pytest.approx(0.1 / 0.003)
    assert stint.compared == pytest.approx(2.5)


def test_an_empty_tank_ends_the_stint():
    measured = {"distance": np.full((50, 1), 40.0), "off_time": np.zeros((50, 1)), "wear": np.zeros((50, 1))}
    measured["distance"][:20, 0] = 2.0 * np.arange(1, 21)
    measured["fuel"] = np.maximum(19.0 - np.arange(50.0), 0.0)[:, None]
    stint = _stint(measured, np.ones((50, 1), dtype=bool), 0, 1000.0, "fuel")
    assert len(stint.laps) == 0 and math.isnan(stint.compared) and math.isnan(stint.per_km)


def test_stints_of_a_single_lap_are_left_out_of_the_range():
    def stint(per_km):
        return Stint(laps=np.full(3, 90.0), clean=np.ones(3, dtype=bool), left=np.zeros(3), per_km=per_km)

    single = Stint(laps=np.full(1, 99.0), clean=np.ones(1, dtype=bool), left=np.zeros(1), per_km=math.nan)
    bound = [{"lap_time": 80.0, "range_km": 50.0}, {"lap_time": 95.0, "range_km": 90.0}]
    stints = [[stint(2.0), single], [stint(1.0), single], [single, single]]
    neutral, saving, none = _rows("fuel", [0.0, 1.0, 2.0], stints, bound)
    assert (neutral["range_km"], saving["range_km"], saving["range_gain"]) == (50.0, 100.0, 1.0)
    assert math.isnan(none["range_km"]) and math.isnan(none["range_gain"]) and math.isnan(none["range_gain_low"])


def test_the_frontier_carries_the_fuel_of_the_stints(monkeypatch):
    loads = {}

    def sweep(car, resource, prices, *, track, fuel):
        loads[resource] = fuel
        return [{"lap_time": 80.0, "fuel_per_lap": 10.0, "wear_per_lap": 0.075}]

    monkeypatch.setattr(stints, "sweep", sweep)
    length = load_track("ring").length / 1000.0
    for resource in ("fuel", "tyre"):
        assert frontier("ring", "x2019", resource) == [{"lap_time": 80.0, "range_km": pytest.approx(10.0 * length)}]
    assert loads == {"fuel": 75.0, "tyre": 100.0}


def test_the_frontier_between_its_points():
    bound = [{"lap_time": 80.0, "range_km": 50.0}, {"lap_time": 84.0, "range_km": 90.0}]
    assert range_at(bound, 81.0) == pytest.approx(60.0)
    assert math.isnan(range_at(bound, 79.0)) and math.isnan(range_at(bound, 85.0))


def test_turns_add_up_in_one_direction_only():
    steps = torch.arange(200) / 10.0
    spin = torch.stack([steps, steps.sin(), -2.0 * steps], 1)  # 19.9 rad, back and forth, 39.8 rad the other way
    wrapped = torch.remainder(spin + math.pi, 2 * math.pi) - math.pi
    alive = torch.ones(200, 3, dtype=torch.bool)
    assert whole_turns(wrapped, alive).tolist() == [3.0, 0.0, 6.0]
    alive[100:] = False
    assert whole_turns(wrapped, alive).tolist() == [1.0, 0.0, 3.0]


def test_contacts_within_a_second_count_once():
    touched = np.zeros(100, dtype=bool)
    touched[[3, 4, 12, 40, 51]] = True  # 0.8 s and 1.1 s after the last one
    assert _count(touched) == 3
    assert _count(np.zeros(5, dtype=bool)) == 0


def test_whoever_is_ahead_by_a_length_after_being_behind_has_overtaken():
    own = np.array([0.0, 10.0, 20.0, 30.0, 40.0, 50.0])
    rival = own + np.array([8.0, -4.0, 4.0, -6.0, 7.0, -8.0])
    beside = own + np.array([9.0, 4.0, -4.9, 3.0, 6.0, 0.0])  # never passed
    distance = np.stack([rival, own, beside], axis=1)
    assert _overtakes(distance, 1) == 2
    assert _overtakes(distance[:, :2], 0) == 1
    assert _overtakes(distance[:2], 1) == 0


def test_a_race_ends_when_the_first_car_does():
    distance = np.array([[90.0, 80.0, 70.0], [101.0, 95.0, 99.0], [110.0, 140.0, 150.0]])
    race = dict.fromkeys(("contact", "stranded", "beside", "in_line"), np.eye(3))
    race |= {"distance": distance, "off": np.zeros((3, 3)), "gap_in_line": np.full((3, 3), np.nan)}
    race["gap_beside"] = np.array([[2.0, 0.0, np.nan], [4.0, 0.0, np.nan], [9.0, 0.0, 7.0]])
    result = _pair_results(race, np.array([2, 0, 1]), np.array([True, False, True]), 100.0)
    assert result["top_two"].tolist() == [1.0, 1.0]
    assert result["won"].tolist() == [1.0, 0.0]
    assert result["places_gained"].tolist() == [2.0, 0.0]
    assert result["contacts"].tolist() == result["stranded"].tolist() == [1.0, 0.0]  # the last one came after the end
    assert result["contacts_per_minute"].tolist() == pytest.approx([300.0, 0.0])  # one in 0.2 s
    assert result["gap_beside"][0] == 3.0 and np.isnan([result["gap_beside"][1], *result["gap_in_line"]]).all()
    assert result["beside"].tolist() == result["in_line"].tolist() == [0.5, 0.0]


def test_places_of_the_first_minute_count_apart():
    steps = np.arange(700.0)
    distance = np.stack([40 * steps, 41 * steps - 25, 20 * steps + 13_100], axis=1)  # the third is passed at 655, 625
    names = ("contact", "stranded", "beside", "in_line", "off", "gap_beside", "gap_in_line")
    race = {name: np.zeros((700, 3)) for name in names}
    result = _pair_results({"distance": distance, **race}, np.array([1, 2, 0]), np.array([True, True, False]), 1e9)
    assert result["places_gained"].tolist() == [0.0, 2.0]
    assert result["places_later"].tolist() == [1.0, 1.0]


def test_the_two_cars_of_a_pair_are_one_observation():
    """In half of the races both win, in the others neither does: 10 observations, not 20."""
    won = np.repeat([[1.0], [0.0]], 5, axis=0).repeat(2, axis=1)
    names = ("top_two", "won", "places_gained", "places_later", "overtakes", "contacts", "contacts_per_minute")
    names += ("beside", "in_line", "gap_beside", "gap_in_line", "stranded", "off", "metres")
    [row] = race_rows([("leader", "lateral", 0.0)], dict.fromkeys(names, won[None]))
    assert row["win_rate"] == 0.5
    assert (row["win_rate_low"], row["win_rate_high"]) == (row["contacts_low"], row["contacts_high"])
    assert row["win_rate_high"] - row["win_rate_low"] >= 0.6  # 0.40 if the cars were independent


def test_wilson_interval():
    low, high = wilson_interval(8, 10)
    assert (low, high) == (pytest.approx(0.4902, abs=1e-4), pytest.approx(0.9433, abs=1e-4))
    assert wilson_interval(0, 5)[0] == pytest.approx(0.0)
    with pytest.raises(ValueError, match="3 successes in 2 trials"):
        wilson_interval(3, 2)


@pytest.mark.slow
def test_stints_of_the_scripted_driver(tmp_path, one_circuit, monkeypatch):
    monkeypatch.setattr(stints, "UNSEEN", "oval")
    domain, agent = scripted("resources", "gt3")
    report = evaluate_resources(domain, agent, tmp_path, EvaluationSettings(episodes=1, steps=800, progress=False))
    rows = read(tmp_path / "stints.csv")
    places = [(track, resource) for track in ("ring", "oval") for resource in ("fuel", "tyre") for _ in range(5)]
    assert [(row["circuit"], row["resource"]) for row in rows] == places
    ring, oval = rows[:10], rows[10:]
    assert all(float(row["range_gain"]) == pytest.approx(0.0, abs=0.1) for row in ring)  # it knows no style
    assert all(15 < float(row["lap_time"]) < 30 and float(row["clean_laps"]) >= 0.5 for row in ring)
    assert all(int(row["laps"]) == 1 and float(row["clean_laps"]) == 1.0 for row in oval)  # it is longer
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"fuel", "tyre"} == set(summary["ring"]) == set(summary["oval"])
    assert "It carries 75 l (fuel) or 100 l (tyres)" in report and "## Circuits" in report
    assert {path.name for path in tmp_path.glob("*.png")} == {"stints.png", "tradeoff.png"}


def test_a_driver_who_never_drifts(tmp_path, one_circuit):
    domain, agent = scripted("drift", "street")
    evaluate_drift(domain, agent, tmp_path, EvaluationSettings(episodes=2, steps=60, progress=False))
    rows = read(tmp_path / "drift.csv")
    assert [float(row["weight"]) for row in rows] == 3 * [-0.4, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert sum(float(row["sideslip_corners"]) < 8.0 for row in rows) >= 14  # it loses the car now and then
    assert all(float(row["turns"]) == 0.0 for row in rows)
    assert sum(float(row["turned_per_km"]) == float(row["backwards"]) == 0.0 for row in rows) >= 14
    assert (tmp_path / "drift.png").stat().st_size > 10_000


def test_a_lap_with_a_short_excursion_is_not_clean(one_circuit):
    domain, agent = scripted("drift", "street")

    def make_env(**options):
        env = domain.make_env(**options)
        judge = env._judge

        def judge_once(*args):
            verdict = judge(*args)
            verdict.telemetry[0, TELEMETRY.index("off_time")] = 0.02 * (env._steps[0] == 3)  # of 0.1 s: no "off"
            return verdict

        env._judge = judge_once
        return env

    seen = replace(domain, make_env=make_env)
    [row] = drive_circuits(seen, agent, EvaluationSettings(episodes=2, steps=900, progress=False))
    assert row["laps"] >= 4 and row["clean_laps"] == 1.0 - 1.0 / row["laps"] and row["off"] == 0.0


def test_laps_on_shipped_held_out_and_own_circuits(tmp_path, monkeypatch):
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    points = np.stack([150 * np.cos(angle), 150 * np.sin(angle), 6 + 0 * angle, 6 + 0 * angle], axis=1)
    np.savetxt(tmp_path / "own.csv", points, delimiter=",")
    monkeypatch.setattr(laps, "DRIVEN", ("ring", "oval"))
    tracks = [load_track("ring"), load_track("oval"), Track.from_csv(tmp_path / "own.csv")]
    domain, agent = scripted("resources", "gt3")
    settings = EvaluationSettings(episodes=2, steps=1100, progress=False, env_options={"track": tracks[-1]})
    rows = drive_circuits(domain, agent, settings)
    assert [(row["circuit"], row["trained"]) for row in rows] == [("ring", "yes"), ("oval", "no"), ("own", "no")]
    for row, track in zip(rows, tracks, strict=True):
        assert row["kilometres"] == pytest.approx(track.length / 1000.0)
        assert row["laps"] >= 2 and row["clean_laps"] == 1.0 and row["off"] == row["retired"] == 0.0
        assert 0.0 < row["over"] < 0.3
        assert row["mean_lap"] == pytest.approx(row["quasi_steady_state"] * (1 + row["over"]))
    summary = circuits_summary(rows)
    assert summary["unseen"]["over"] == pytest.approx((rows[1]["over"] + rows[2]["over"]) / 2)
    assert (summary["unseen"]["circuits"], summary["unseen"]["circuits_timed"]) == (2, 2)
    without = circuits_summary([*rows[:2], rows[2] | {"over": math.nan}])["unseen"]
    assert (without["over"], without["circuits"], without["circuits_timed"]) == (rows[1]["over"], 2, 1)
    assert "| own | no |" in circuits_report(rows)


@pytest.mark.parametrize(("family", "car", "fuel"), [("resources", "x2019", 75.0), ("drift", "street", 30.0)])
def test_circuits_are_driven_with_the_fuel_of_the_family(one_circuit, family, car, fuel):
    domain, agent = scripted(family, car)
    made = []
    seen = replace(domain, make_env=lambda **options: made.append(domain.make_env(**options)) or made[-1])
    [row] = drive_circuits(seen, agent, EvaluationSettings(episodes=1, steps=3, progress=False))
    assert row["fuel"] == fuel
    assert made[-1].state[ROW["fuel"]].flatten().tolist() == pytest.approx([fuel], abs=0.5)


def test_races_of_the_scripted_driver(tmp_path, one_circuit):
    domain, agent = scripted("aggressiveness", "gt3")
    settings = EvaluationSettings(episodes=1, steps=40, seed=1, progress=False)
    report = evaluate_aggressiveness(domain, agent, tmp_path, settings)
    rows = read(tmp_path / "races.csv")
    assert len(rows) == 20 and {row["races"] for row in rows} == {"8"}
    kinds = [(row["margin"], row["setting"]) for row in rows[::5]]
    assert kinds == [(margin, setting) for margin in ("lateral", "longitudinal") for setting in ("pursuer", "leader")]
    # It knows no style, and the races of all margins start alike.
    alike = {"margin": "lateral", "requested": "0"}
    assert all(row | alike in (rows[0], rows[5]) for row in rows)
    # In four seconds nobody overtakes: the leaders stay in front, the pursuers behind.
    by_setting = {row["setting"]: row for row in rows}
    assert float(by_setting["leader"]["win_rate"]) > 0.9
    assert float(by_setting["pursuer"]["win_rate"]) < 0.1
    # A rolling start puts 14 m between cars; one driver on one line hardly ever brings them beside each other.
    assert all(0.0 <= float(row["beside"]) < 0.05 for row in rows)
    assert "races per row, 4 laps" in report and (tmp_path / "radar.png").exists()


def test_races_in_the_cars_of_a_pool(tmp_path, one_circuit):
    domain, agent = scripted("aggressiveness", "pool")
    made = []
    seen = replace(domain, make_env=lambda **options: made.append(domain.make_env(**options)) or made[-1])
    report = evaluate_aggressiveness(seen, agent, tmp_path, EvaluationSettings(episodes=1, steps=3, progress=False))
    models = made[0].garage.model.reshape(20, 8)  # margins and settings, races of each
    assert (models == models[0]).all() and len(models[0].unique()) == 8
    assert "the 50 GT3-like cars of the pool in turn" in report


def test_traffic_of_the_scripted_driver(tmp_path, monkeypatch):
    monkeypatch.setattr(traffic, "RACES", 32)
    domain, agent = scripted("resources", "x2019", cars=3)
    rows = race_in_traffic(domain, agent, EvaluationSettings(episodes=1, steps=20, progress=False))
    kinds = [(start, savers) for start in ("passing", "slipstream", "rolling") for savers in ("nobody", "all")]
    assert [(row["start"], row["savers"]) for row in rows[::10]] == kinds
    assert [(row["sweep"], row["weight"]) for row in rows[4:6]] == [("overtake", 2.0), ("defend", 0.0)]
    # It knows no style, and the races of all weights start alike.
    for first in range(0, len(rows), 5):
        assert all(row | {"weight": 0.0} == rows[first] for row in rows[first : first + 5])
    assert rows[10]["overtake"] == rows[0]["overtake"]  # neither does it save
    assert len({rows[first]["defend"] for first in (5, 25, 45)}) == 3  # the starts differ
    # Whoever starts last has nobody behind, whoever starts first nobody ahead.
    assert rows[0]["defend"] == 0.0 and rows[5]["overtake"] == 0.0 and rows[0]["overtake"] != 0.0
    draw_traffic(rows, tmp_path / "traffic.png")
    assert (tmp_path / "traffic.png").stat().st_size > 10_000


def test_traffic_response():
    rows = []
    for sweep in ("overtake", "defend"):
        for weight in (0.0, 0.5, 1.0, 1.5, 2.0):
            gained = weight**2 if sweep == "overtake" else -weight
            row = {"sweep": sweep, "start": "rolling", "savers": "all", "weight": weight, "races": 9, "off": 0.0}
            row |= {"overtake": gained, "defend": gained, "places_gained": -gained, "contact": 0.01 + weight / 100}
            rows.append(row | {f"{sweep}_low": gained - 1.0, f"{sweep}_high": gained + 1.0})
    overtake, defend = response = traffic_response(rows)
    assert (overtake["smallest"], overtake["largest"], overtake["apart"]) == (0.0, 4.0, "yes")
    assert (overtake["metres"], overtake["places"]) == (pytest.approx(1.0), pytest.approx(-1.0))
    assert overtake["contacts"] == pytest.approx(3.0)
    assert (defend["largest"], defend["apart"], defend["metres"]) == (-2.0, "no", pytest.approx(-1.0))
    text = traffic_report(rows, response)
    assert "| overtake | rolling | all | +0.0 | +4.0 | yes | 1.00 | -1.00 | 3.00 |" in text

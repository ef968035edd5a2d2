"""The three declarations: they make environments, measure and draw."""

import math

import numpy as np
import pytest
import torch

from coachable.domain import load_domain
from coachable.domains.racing.events import racing_events
from coachable.domains.racing.families import family_env, racing_family, training_tracks
from coachable.domains.racing.metrics import RacingMeasures
from coachable.domains.racing.stage import RacingStage
from coachable.envs.racing import RacingEnv
from coachable.envs.racing.circuit.circuits import SETS
from coachable.envs.racing.physics.cars import Resources
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.envs.racing.race.scenarios import Conditions
from coachable.evaluation.wording import measured_text, measures_by_parameter
from coachable.scene.renderer import SceneRenderer
from coachable.transforms import coachable_env


@pytest.mark.parametrize("family", ["drift", "resources", "aggressiveness"])
def test_a_domain_makes_measures_and_draws(family):
    domain = load_domain(f"racing_{family}")
    space = domain.make_space()
    assert all(set(cell) == set(space.names) for cell in domain.cells())
    env = coachable_env(domain.make_env(num_envs=4, seed=0), space, domain.make_reward(space), seed=0)
    data = env.rollout(3, break_when_any_done=False)
    assert sum(group.width for group in domain.observation_groups) == data["observation"].shape[-1]
    records = [domain.measures.step(data[:, t]) for t in range(3)]
    record = {name: torch.stack([r[name] for r in records]) for name in records[0]}
    steered = data["action"][..., 0].T
    torch.testing.assert_close(record["steering_change"][1:], steered.diff(dim=0).abs())
    alive = torch.ones(3, 4, dtype=torch.bool)
    summary = domain.measures.summarise(record, alive)
    assert set(domain.columns) - {"survived"} <= set(summary)
    assert set(domain.units) <= set(summary)
    assert domain.measures.complies(record).shape == (3, 4)
    renderer = domain.make_renderer(160, 120)
    image = renderer.draw(env, row=1)
    renderer.close()
    assert image.shape == (120, 160, 3) and image.dtype == np.uint8 and image.std() > 10


def test_five_cars_from_the_pool_start_a_race():
    env = RacingEnv(10, cars=5, track="endurance", car="pool", conditions=Conditions.any_compound(), seed=0)
    assert (env.reset()["observation"].abs() < 50).all()
    assert env.garage.model.shape == (2,)
    assert len(set(env.compound[2:].argmax(0).reshape(5, 2)[:, 0].tolist())) == 1


def test_who_learnt_among_others_is_measured_alone_and_coached_among_others():
    domain = load_domain("racing_resources", {"env": {"track": "ring", "cars": 3}})
    alone, before = domain.make_env(num_envs=4, seed=0), load_domain("racing_resources", {"env": {"track": "ring"}})
    seen = alone.reset()["observation"]
    assert alone.cars == 1 and seen.shape[-1] == sum(group.width for group in domain.observation_groups)
    assert torch.equal(seen[:, :-33], before.make_env(num_envs=4, seed=0).reset()["observation"])
    assert not seen[:, -33:].any()
    coached = domain.make_env(num_envs=1, seed=0, **domain.coached)
    assert (coached.cars, coached.controlled) == (3, 1) and coached.reset()["observation"][:, -33:].any()
    # So does who learnt alone with room for others.
    ready = load_domain("racing_resources", {"env": {"track": "ring", "opponents": True}})
    assert not ready.coached and torch.equal(ready.make_env(num_envs=4, seed=0).reset()["observation"], seen)


def test_drivers_of_many_circuits_are_shown_on_their_familys_or_on_the_users(tmp_path):
    settings = {"env": {"track": "training", "curvature": True}}
    domain = load_domain("racing_resources", settings)
    env = domain.make_env(num_envs=2, seed=0)
    assert [track.name for track in env.tracks] == ["lakeside"]
    assert sum(group.width for group in domain.observation_groups) == env.observation_size
    assert training_tracks("resources", settings["env"]) == SETS["training"]
    points = [(150 * math.cos(a / 20), 150 * math.sin(a / 20), 6, 6) for a in range(126)]
    (tmp_path / "own.csv").write_text("\n".join(",".join(map(str, point)) for point in points))
    moved = domain.with_options(domain.read_options({"track": str(tmp_path / "own.csv")}))
    own = moved.make_env(num_envs=2, seed=0)
    assert [track.name for track in own.tracks] == ["own"] and own.observation_size == env.observation_size
    with pytest.raises(ValueError, match=r"has no option --car: expected --track \(CSV file of a circuit\)"):
        domain.read_options({"car": "gt3"})
    with pytest.raises(ValueError, match=r"humanoid has no option --track: expected no options of its own"):
        load_domain("humanoid").read_options({"track": "own.csv"})


def test_an_agent_of_tyres_and_fuel_races_agents_or_scripted_drivers():
    agents, one = (family_env(n, family="resources", cars=3, track="ring", seed=0) for n in (6, 4))
    assert (agents.races, agents.controlled, one.races, one.controlled) == (2, 3, 4, 1)
    assert one.rollout(3)["next", "observation"].isfinite().all()


@pytest.mark.parametrize(("options", "car"), [({}, "x2019"), ({"car": "gt3"}, "gt3"), ({"car": "pool"}, "gt3")])
def test_tyres_and_fuel_are_used_at_the_rates_that_the_evaluation_has(options, car):
    env = family_env(2, family="resources", track="ring", seed=0, **options)
    assert env.simulation.resources == Resources.calibrated(car)


def test_a_car_whose_savings_cannot_be_evaluated_is_refused():
    with pytest.raises(ValueError, match="no calibrated wear and fuel rates of 'street': expected one of gt3, x2019"):
        family_env(2, family="resources", track="ring", car="street")


def test_an_unknown_family_is_refused():
    with pytest.raises(ValueError, match="unknown family 'speed'"):
        RacingMeasures("speed")


def test_pictures_follow_the_car():
    env = RacingEnv(2, track="ring", seed=0)
    env.reset()
    renderer = SceneRenderer(RacingStage, 160, 120)
    assert not np.array_equal(renderer.draw(env, 0), renderer.draw(env, 1))
    renderer.close()


def test_an_agent_of_all_cars_is_measured_with_the_gt3_cars():
    domain = load_domain("racing_aggressiveness", {"env": {"track": "ring", "car": "pool"}})
    env = domain.make_env(num_envs=2, seed=0)
    assert env.garage.pool.shape[1] == 50 and domain.make_web is None
    assert sum(group.width for group in domain.observation_groups) == env.observation_size


def test_a_domain_is_as_its_training_made_it():
    settings = {"_target_": "x", "family": "resources", "num_envs": 256, "track": "ring", "car": "gt3"}
    # As a configuration has them; a file must not choose what is imported and called.
    settings |= {"scenarios": [{"_target_": "x"}], "conditions": {"_target_": "x"}, "weights": {"_target_": "x"}}
    domain = load_domain("racing_resources", {"env": {**settings, "episode_steps": 20, "course_points": 5}})
    env = domain.make_env(num_envs=2, seed=0)
    assert (env.tracks[0].name, env.num_envs, domain.episode_steps) == ("ring", 2, 20)
    assert sum(group.width for group in domain.observation_groups) == env.observation_size


@pytest.mark.parametrize(
    "family, names", [("drift", ["slide"]), ("aggressiveness", ["contact", "overtake", "slipstream"])]
)
def test_events_are_what_their_names_say(family, names):
    events = racing_events(family)
    assert list(events.names) == ["recovery", *names]
    space, reward = racing_family(family).make_space(), racing_family(family).make_reward
    env = coachable_env(family_env(8, family=family, seed=0), space, reward(space), seed=0)
    data = env.rollout(15, break_when_any_done=False).reshape(-1)
    found = events(data)
    assert found.shape == (120, 1 + len(names))
    off = data["next", "telemetry"][:, TELEMETRY.index("off")] > 0
    assert torch.equal(found[:, 0], off)
    if family == "drift":
        assert torch.equal(found[:, 1], data["next", "style_features"][:, 1] > math.radians(20.0))
        assert found[:, 1].any()
    else:
        assert torch.equal(found[:, 1], data["next", "telemetry"][:, TELEMETRY.index("contact")] > 0)


@pytest.mark.parametrize("make", [racing_family, racing_events, lambda name: family_env(2, family=name)])
def test_families_are_checked_everywhere(make):
    with pytest.raises(ValueError, match="unknown family 'speed': expected drift, resources or aggressiveness"):
        make("speed")


@pytest.mark.parametrize(
    ("family", "parameter", "measures"),
    [
        ("resources", "tire", ["wear_per_km"]),
        ("resources", "overtake", ["overtake"]),
        ("drift", "slip_angle_rear", ["sideslip_corners", "slip_angle_rear"]),
        ("aggressiveness", "lateral", ["lateral_least", "lateral"]),
    ],
)
def test_a_request_has_its_measures_beside_it(family, parameter, measures):
    domain = load_domain(f"racing_{family}")
    names = ["lateral_least", "lateral", "slip_angle_rear", "sideslip_corners", "wear_per_km", "overtake", "pace"]
    space = domain.make_space()
    groups = measures_by_parameter(space, [n for n in names if n in measures or n == "pace"], domain.beside)
    assert groups[parameter] == measures and groups[""] == ["pace"]
    assert measured_text(domain, space, "wear_per_km", 0.0092) == ("0.92%" if family == "resources" else "0.0092")

"""`RacingEnv` as a TorchRL environment, its rewards, starts and endings."""

import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from coachable.domains.racing import (
    aggressiveness_style_reward,
    aggressiveness_style_space,
    resource_style_reward,
    resource_style_space,
)
from coachable.envs.racing import RacingEnv
from coachable.envs.racing.physics.cars import Resources
from coachable.envs.racing.physics.state import HEATS, ROW, WEARS
from coachable.envs.racing.race.counter_rng import normal, uniforms
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.observation import observation_groups
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.envs.racing.race.run import Others, Run
from coachable.envs.racing.race.scenarios import Conditions, Scenario, drift_scenarios, race_scenarios, rolling_start
from coachable.envs.racing.race.task import TaskWeights, metres_gained
from coachable.transforms import coachable_env
from tests.envs.contract import roll

T = {name: column for column, name in enumerate(TELEMETRY)}


def actions(rows, steps, seed=0):
    return 2 * torch.rand(steps, rows, 2, generator=torch.Generator().manual_seed(seed)) - 1


@pytest.mark.parametrize("options", [{}, {"cars": 5, "car": "pool"}, {"cars": 2, "car": "x2019"}], ids=["1", "5", "2"])
def test_specs_hold(options):
    env = RacingEnv(num_envs=2 * options.get("cars", 1), seed=0, track="ring", **options)
    check_env_specs(env, seed=0)
    groups = observation_groups(env.cars > 1, env.garage.pooled)
    assert env.observation_size == sum(group.width for group in groups)


def test_the_same_seed_gives_the_same_races_and_another_does_not():
    runs = [roll(RacingEnv(10, cars=5, seed=s, track="ring"), actions(10, 5))["observation"] for s in (1, 1, 2)]
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0][0], runs[2][0])


def test_a_race_does_not_depend_on_how_many_run_beside_it():
    """Every race has a random stream of its own."""
    few, many = RacingEnv(10, cars=5, seed=1, track="ring"), RacingEnv(30, cars=5, seed=1, track="ring")
    few.reset()
    many.reset()
    torch.testing.assert_close(few.state.reshape(-1, 5, 2), many.state.reshape(-1, 5, 6)[..., :2])


def test_copies_of_a_start_are_alike_and_others_are_not():
    env = RacingEnv(12, cars=2, car="pool", track="ring", seed=3, copies=2)
    starts = env.reset()["observation"].reshape(2, 2, 3, -1)  # (cars, copies, starts, D)
    assert torch.equal(starts[:, 0], starts[:, 1])
    assert not torch.equal(starts[:, 0, 0], starts[:, 0, 1])


def test_uniform_numbers_are_uniform():
    u = uniforms(torch.arange(2000), torch.ones(2000, dtype=torch.int64), 10, 5)
    assert u.shape == (10, 5, 2000) and u.min() >= 0 and u.max() < 1
    assert abs(u.mean() - 0.5) < 5 / math.sqrt(12 * u.numel())
    flat = u.reshape(50, -1)
    assert (torch.corrcoef(flat) - torch.eye(50)).abs().max() < 6 / math.sqrt(2000)


def test_pairs_of_normal_numbers_are_independent():
    """On a grid of uniform numbers; the second of a pair lies a quarter turn on, so that their squares add up."""
    u1, u2 = torch.meshgrid((torch.arange(400.0) + 0.5) / 400, (torch.arange(200.0) + 0.5) / 200, indexing="ij")
    first, second = normal(u1, u2), normal(u1, (u2 + 0.25) % 1.0)
    torch.testing.assert_close(first.square() + second.square(), -2 * (1 - u1).log(), rtol=1e-4, atol=1e-6)
    assert abs((first * second).mean()) < 1e-4
    for power, moment in ((1, 0.0), (2, 1.0), (3, 0.0), (4, 3.0)):
        assert abs(first.pow(power).mean() - moment) < 0.05


def test_partial_reset_touches_no_other_race():
    env = RacingEnv(15, cars=5, seed=0, track="ring")
    roll(env, actions(15, 3))
    before = {k: v.clone() for k, v in env.simulator_state().items()}
    mask = torch.tensor([False, True, False]).repeat(5)[:, None]
    env.reset(TensorDict({"_reset": mask}, [15]))
    after = env.simulator_state()
    kept = ~mask.flatten()
    for name in ("state", "run", "compound"):
        assert torch.equal(before[name][:, kept], after[name][:, kept])
        assert name == "compound" or not torch.equal(before[name][:, ~kept], after[name][:, ~kept])
    with pytest.raises(ValueError, match="all rows of a race"):
        env.reset(TensorDict({"_reset": torch.arange(15)[:, None] == 0}, [15]))


@pytest.mark.parametrize("options", [{"cars": 5, "car": "pool"}, {}], ids=["pool", "solo"])
def test_a_saved_simulation_goes_on_exactly(options):
    first = RacingEnv(10, seed=0, track="ring", resources=Resources(9.0, 3.0), **options)
    start = roll(first, actions(10, 4))[-1]
    saved = first.simulator_state()
    second = RacingEnv(10, seed=5, track="ring", resources=Resources(9.0, 3.0), **options)
    second.reset()
    second.load_simulator_state(saved)
    for action in actions(10, 4, seed=1):
        ends = [env.step(start.clone().set("action", action))["next"] for env in (first, second)]
        assert torch.equal(ends[0]["observation"], ends[1]["observation"])
        assert torch.equal(ends[0]["task_reward"], ends[1]["task_reward"])
    assert torch.equal(first.reset()["observation"], second.reset()["observation"])
    with pytest.raises(ValueError, match="this env has 4 of 1"):
        RacingEnv(4, track="ring").load_simulator_state(RacingEnv(3, track="ring").simulator_state())


def test_bad_actions_are_refused():
    env = RacingEnv(2, track="ring", seed=0)
    start = env.reset()
    with pytest.raises(ValueError, match="NaN"):
        env._step(start.clone().set("action", torch.full((2, 2), torch.nan)))
    with pytest.raises(ValueError, match=r"expected \(2, 2\)"):
        env._step(TensorDict({"action": torch.zeros(2, 3)}, [2]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 3, "cars": 2}, "multiple of the 2"),
        ({"num_envs": 21, "cars": 21}, "20 grid slots"),
        ({"num_envs": 2, "cars": 2, "controlled": 1}, "no driver"),
        ({"num_envs": 6, "cars": 2, "copies": 2}, "divisor of the 3 races"),
        ({"num_envs": 2, "cars": 2, "opponents": False}, "opponents is False for 2 cars"),
        ({"num_envs": 2, "car": "tractor"}, "unknown car"),
        ({"num_envs": 2, "track": "road"}, "unknown track"),
        ({"num_envs": 2, "scenarios": (Scenario("a", 0.5, "solo"),)}, "add up to 0.5"),
        ({"num_envs": 2, "scenarios": "solo"}, "scenarios is 'solo': expected a list of Scenario"),
    ],
)
def test_bad_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RacingEnv(**{"track": "ring", **options})


def test_races_of_shares_that_are_given():
    shares = {"rolling": 0.75, "solo": 0.25}
    assert race_scenarios(5, shares) == (Scenario("solo", 0.25, "solo"), Scenario("rolling", 0.75, "rolling", 5))
    with pytest.raises(ValueError, match="shares of pit given: expected some of solo, one_to_one, field"):
        race_scenarios(5, {"pit": 1.0})


def test_cars_of_a_passing_start_are_close_and_some_are_faster():
    env = RacingEnv(100, cars=5, track="oval", scenarios=(Scenario("p", 1.0, "passing", 5),), seed=0)
    env.reset()
    speed = env.state[ROW["vx"]].reshape(5, 20)
    distance = env.run[Run._fields.index("distance")].reshape(5, 20)
    assert ((speed.amax(0) / speed.amin(0) > 1.01) & (speed.amax(0) / speed.amin(0) <= 1.1 / 0.9)).all()
    assert ((distance.amin(0) >= -4 * 13.0) & (distance.amin(0) <= -4 * 7.0)).all()


def test_task_reward_of_a_clean_straight_is_progress():
    """No slip worth mentioning, nobody near: what remains is metres along the track."""
    env = RacingEnv(4, track="oval", scenarios=(Scenario("s", 1.0, "slipstream"),), seed=0)
    seen = roll(env, torch.zeros(3, 4, 2))
    progress = seen["telemetry"][..., T["progress"]]
    torch.testing.assert_close(seen["task_reward"][..., 0], progress, atol=0.05, rtol=0)
    assert (progress > 1).all()


def test_off_course_costs_the_squared_speed():
    env = RacingEnv(1, track="ring", seed=0)
    start = env.reset()
    x, y, yaw = env.course.place(torch.tensor([100.0]), torch.tensor([9.0]))
    for name, value in (("x", x), ("y", y), ("yaw", yaw), ("vx", 20.0)):
        env.state[ROW[name]] = value
    env.state[6:10] = 20.0 / 0.335
    env.run = env.referee.begin(env.state, torch.tensor([100.0]), torch.zeros(1), env.garage.car, None)
    after = env.step(start.set("action", torch.zeros(1, 2)))["next"]
    kmh = 3.6 * after["telemetry"][0, T["speed"]]
    slip = -after["task_reward"].item() - 0.01 * 0.1 * kmh.item() ** 2
    assert after["telemetry"][0, T["off"]] == 1 and after["telemetry"][0, T["off_time"]] == pytest.approx(0.1)
    assert -1e-3 < slip < 0.05


def test_overheating_is_charged_and_cooling_paid_back():
    conditions = Conditions(heat=130.0)
    free, priced = (
        RacingEnv(8, track="ring", conditions=conditions, seed=0, weights=TaskWeights(tyre_heat=w))
        for w in (0.0, 900.0)
    )

    def lost(env: RacingEnv) -> torch.Tensor:
        """Mean over tyres of 0.2 ((T - 90) / 60)²."""
        return 0.2 * ((env.state[HEATS].clamp(min=90.0) - 90.0) / 60.0).square().mean(0)

    for env in (free, priced):
        env.reset()
    signs = set()
    for action in (torch.tensor([[0.0, 0.0]]), torch.tensor([[1.0, 1.0]])):  # coasts, spins
        for _ in range(5):
            before = lost(priced)
            without, charged = (env.step(TensorDict({"action": action.expand(8, 2)}, [8])) for env in (free, priced))
            due = 900.0 * (lost(priced) - before)
            signs.update(due.sign().tolist())
            difference = (without["next", "task_reward"] - charged["next", "task_reward"])[:, 0]
            torch.testing.assert_close(difference, due, atol=1e-3, rtol=1e-3)
    assert signs == {-1.0, 1.0}


def test_changes_of_the_steering_command_cost():
    free, priced = (RacingEnv(8, track="ring", seed=0, weights=TaskWeights(steering_change=w)) for w in (0.0, 0.5))
    steered = actions(8, 5)
    before = torch.zeros(8)  # of an episode that begins
    for action, without, charged in zip(steered, roll(free, steered), roll(priced, steered), strict=True):
        due = 0.5 * (action[:, 0] - before).square()
        torch.testing.assert_close((without["task_reward"] - charged["task_reward"])[:, 0], due, atol=1e-4, rtol=1e-3)
        before = action[:, 0]


def test_half_a_metre_between_cars_side_by_side_is_seen():
    """Margins of at most a metre are asked for: on a plain scale to 50 m nobody would learn them."""
    env = RacingEnv(2, cars=2, track="oval", scenarios=(Scenario("f", 1.0, "field", 2),), seed=0)
    env.reset()
    sides = []
    for offset in (-1.5, -1.0):
        place = torch.tensor([200.0, 200.0]), torch.tensor([1.0, offset])
        for name, value in zip(("x", "y", "yaw"), env.course.place(*place), strict=True):
            env.state[ROW[name]] = value
        seen = env.referee.observe(env.state, env.run, env.compound, env.garage.car, env.simulation.wheels, env.group)
        sides.append(seen[0, -32])  # of the first opponent, sideways
    assert 0.03 < (sides[0] - sides[1]).abs() < 0.1


def test_metres_gained_count_within_the_window():
    """Ahead 40 m, behind 20 m, before or after; who is ahead is decided before."""
    before = torch.tensor([41.0, 39.0, -5.0, -19.0, -30.0, 2.0, 100.0])
    after = torch.tensor([38.0, 41.0, -7.0, -21.0, -31.0, -1.0, 97.0])
    ones = torch.ones_like(before, dtype=torch.bool)
    gained = [
        [part.item() for part in metres_gained(Others(b[None], b[None], m[None]), Others(a[None], a[None], m[None]))]
        for b, a, m in zip(before, after, ones, strict=True)
    ]
    assert gained == [[3.0, 0.0], [-2.0, 0.0], [0.0, 2.0], [0.0, 2.0], [0.0, 0.0], [3.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("family", ["resources", "aggressiveness"])
def test_rewards_are_the_sum_of_their_stored_parts_bit_for_bit(family):
    torch.manual_seed(0)  # of the actions: with others, no car may come close enough to another
    space = resource_style_space() if family == "resources" else aggressiveness_style_space(cars=5)
    reward = (resource_style_reward if family == "resources" else aggressiveness_style_reward)(space)
    base = RacingEnv(10, cars=5, track="ring", resources=Resources(9.0, 3.0), scenarios=rolling_start(5))
    env = coachable_env(base, space, reward, seed=0)
    data = env.rollout(20, break_when_any_done=False)
    features, theta = data["next", "style_features"], data["style"]
    again = data["next", "task_reward"] + reward(features, theta)
    assert torch.equal(again, data["next", "reward"])
    flat = data["next", "task_reward"].reshape(-1, 1) + reward(features.reshape(200, -1), theta.reshape(200, -1))
    assert torch.equal(flat.reshape(again.shape), again)
    assert (reward(features, theta) != 0).any()
    if family == "aggressiveness":
        assert (theta.reshape(5, 2, 20, 2) == theta.reshape(5, 2, 20, 2)[0]).all()


def test_style_features_of_tyres_and_fuel_are_what_the_step_used():
    env = RacingEnv(4, track="ring", seed=0, resources=Resources(9.0, 3.0))
    start = env.reset()
    wear, fuel = env.state[WEARS].mean(0).clone(), env.state[ROW["fuel"]].clone()
    after = env.step(start.set("action", torch.tensor([[0.3, 1.0]]).repeat(4, 1)))["next"]["style_features"]
    torch.testing.assert_close(after[:, 6], wear - env.state[WEARS].mean(0), atol=1e-8, rtol=1e-3)
    torch.testing.assert_close(after[:, 7], env.state[ROW["fuel"]] - fuel)
    assert (after[:, 6:8] < 0).all()


def test_drifting_features_need_speed():
    env = RacingEnv(400, track="ring", seed=0, scenarios=drift_scenarios(), car="street")
    features = roll(env, torch.zeros(1, 400, 2))[0]["style_features"][:, :4]
    speed = torch.hypot(env.state[ROW["vx"]], env.state[ROW["vy"]])
    assert (features[speed < 4.9] == 0).all()
    assert (features[speed > 5.1].sum(0) > 0).all()
    assert features[:, :2].max() <= math.pi / 2 and features[:, 2:].max() <= 1


def test_launches_and_resources_follow_their_laws():
    env = RacingEnv(4000, track="ring", seed=0, scenarios=drift_scenarios(), conditions=Conditions.resources())
    env.reset()
    speed, fuel, wear = env.state[ROW["vx"]], env.state[ROW["fuel"]], env.state[WEARS]
    slow = (speed < 15).float().mean()  # half of the starts are U(0, 60), the others at 20 m/s or more on this track
    assert abs(slow - 0.5 * 15 / 60) < 5 * (0.125 * 0.875 / 4000) ** 0.5
    assert abs(fuel.mean() - 55.0) < 5 * 26 / 4000**0.5 and fuel.min() >= 10 and fuel.max() <= 100
    assert abs(wear.mean() - 0.375) < 5 * 0.22 / 4000**0.5 and wear.min() >= 0
    spread = (wear - wear.mean(0)).std() * (4 / 3) ** 0.5
    assert abs(spread - 0.05) < 0.003
    assert set(env.compound[2:].argmax(0).tolist()) == {6, 7, 8}


def test_wrong_way_and_standing_end_an_episode():
    env = RacingEnv(2, track="ring", seed=0)
    start = env.reset()
    env.state[ROW["yaw"], 0] += math.pi
    env.state[ROW["vx"]] = torch.tensor([20.0, 0.0])
    env.state[6:10] = env.state[ROW["vx"]] / 0.335
    ends, rewards = [], []
    for _ in range(33):
        after = env.step(start.set("action", torch.tensor([[0.0, 0.0], [0.0, -1.0]])))["next"]
        ends.append(after["terminated"].flatten())
        rewards.append(after["task_reward"].flatten())
    first = torch.stack(ends).int().argmax(0).tolist()
    assert 29 <= first[0] <= 31 and 29 <= first[1] <= 31
    standing = torch.stack(rewards)[:, 1]
    torch.testing.assert_close(standing[first[1]], torch.tensor(-100.0), atol=0.1, rtol=0)
    assert standing[: first[1]].abs().max() < 0.1


def test_episodes_are_truncated_together():
    env = RacingEnv(10, cars=5, track="ring", seed=0, episode_steps=3)
    seen = roll(env, torch.zeros(3, 10, 2))
    assert seen["truncated"][-1].all() and not seen["done"][:-1].any() and not seen["terminated"].any()


def test_cars_of_one_race_end_together_and_only_the_culprit_terminates():
    env = RacingEnv(10, cars=5, track="ring", seed=0)
    start = env.reset()
    env.run[6, 0] = 2.95  # row 0, car 0 of race 0: nearly three seconds the wrong way
    env.state[ROW["yaw"], 0] += math.pi
    env.state[ROW["vx"], 0] = 20.0
    after = env.step(start.set("action", torch.zeros(10, 2)))["next"]
    by_car = after["done"].reshape(5, 2)
    assert by_car[:, 0].all() and not by_car[:, 1].any()
    assert after["terminated"].flatten().nonzero().tolist() == [[0]]


def test_scripted_opponents_drive_the_other_cars():
    driver = LineFollower(RacingEnv(1, track="oval").tracks, RacingEnv(1, track="oval").garage.typical, grip=0.8)
    env = RacingEnv(2, cars=3, controlled=1, driver=driver, track="oval", seed=0, scenarios=rolling_start(3))
    seen = roll(env, torch.zeros(10, 2, 2))
    assert seen["observation"].shape == (10, 2, env.observation_size)
    distance = env.run[4].reshape(3, 2)
    assert (distance[1:] > distance[:1] - 50).all()
    assert (env.state[ROW["throttle"], 2:] > 0).any()


def test_random_driving_stays_finite():
    env = RacingEnv(1500, cars=5, track="lakeside", seed=0, car="pool", resources=Resources(9.0, 3.0))
    seen = roll(env, actions(1500, 10))
    for key in ("observation", "task_reward", "style_features", "telemetry"):
        assert torch.isfinite(seen[key]).all(), key
    assert seen["observation"].abs().max() < 30


@pytest.mark.slow
@pytest.mark.parametrize("car", ["gt3", "x2019", "street", "pool"])
def test_a_million_random_car_steps_stay_finite(car):
    env = RacingEnv(5000, cars=5, track="ridge", seed=0, car=car, resources=Resources(9.0, 3.0))
    current = env.reset()
    for action in actions(5000, 50):
        current.set("action", action)
        stepped, current = env.step_and_maybe_reset(current)
        after = stepped["next"]
        for key in ("observation", "task_reward", "style_features"):
            assert torch.isfinite(after[key]).all(), key
        assert torch.isfinite(env.state).all()


@pytest.mark.gpu
def test_one_step_is_the_same_on_a_gpu():
    options = {"cars": 5, "track": "ring", "seed": 0, "scenarios": rolling_start(5)}
    ends = []
    for device in ("cpu", "cuda"):
        env = RacingEnv(50, device=device, **options)
        start = env.reset()
        ends.append(env.step(start.set("action", actions(50, 1)[0].to(device)))["next"]["observation"].cpu())
    torch.testing.assert_close(*ends, atol=1e-4, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the compiler, about itself
@pytest.mark.parametrize(("cars", "car"), [(1, "gt3"), (5, "gt3"), (5, "pool")])
def test_what_would_be_compiled_is_the_same(monkeypatch, cars, car):
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))  # traced, without a C++ compiler
    seen = []
    for compiled in (False, True):
        env = RacingEnv(10, cars=cars, car=car, track="ring", seed=0, compiled=compiled)
        seen.append(roll(env, actions(10, 2)))
    torch.testing.assert_close(seen[0]["observation"], seen[1]["observation"])

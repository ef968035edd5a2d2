"""What cars feel and see of each other and of the road, against closed forms and a loop over cars in numpy."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.circuit.track import Course
from coachable.envs.racing.physics.cars import CARS, load_car
from coachable.envs.racing.physics.contact import Bodies
from coachable.envs.racing.physics.dynamics import AIR_DENSITY, GRAVITY, WheelSet, total_mass, wheel_loads
from coachable.envs.racing.physics.state import HEATS, ROW, SPINS, WEARS, CarState
from coachable.envs.racing.race.observation import car_columns, opponents_seen, own_car, own_columns
from coachable.envs.racing.race.rescue import RESCUE_SPEED, back_on_track
from coachable.envs.racing.race.run import SLIPSTREAM_LENGTH, SLIPSTREAM_WIDTH, Run, look_around, slipstream, tyre_view
from coachable.envs.racing.race.scenarios import _longest_straight, rolling_cars

F64 = torch.float64


@pytest.fixture(scope="module")
def ring():
    """A circle to the left with a radius of 200 m."""
    return Course(load_track("ring"), dtype=F64)


def test_places_beside_a_circle_lie_on_circles(ring):
    s = torch.linspace(0.0, ring.length * 0.99, 37, dtype=F64)
    offset = torch.linspace(-6.0, 6.0, 37, dtype=F64)
    x, y, direction = ring.place(s, offset)
    x0, y0, along = ring.place(torch.zeros(1, dtype=F64), torch.zeros(1, dtype=F64))
    centre = x0 - 200.0 * along.sin(), y0 + 200.0 * along.cos()
    turned = along + s / 200.0
    torch.testing.assert_close(torch.hypot(x - centre[0], y - centre[1]), 200.0 - offset, atol=2e-3, rtol=0)
    torch.testing.assert_close((direction - turned).sin(), torch.zeros_like(s), atol=1e-3, rtol=0)
    torch.testing.assert_close(x, centre[0] + (200.0 - offset) * turned.sin(), atol=0.2, rtol=0)


def test_finding_a_place_gives_it_back(ring):
    s = torch.linspace(1.0, ring.length * 0.99, 41, dtype=F64)
    offset = torch.linspace(-5.0, 5.0, 41, dtype=F64)
    x, y, _ = ring.place(s, offset)
    for found, arc, _ in (ring.project(x, y, s), ring.project(x, y, s + 20.0), ring.project(x, y, s - 20.0)):
        torch.testing.assert_close(found, s, atol=2e-3, rtol=0)
        torch.testing.assert_close(arc.offset, offset, atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    ("straight", "start", "length"),
    [
        ("--((---((-", 4, 3),
        ("--((--((--", 8, 4),  # over the line
        ("-((((((((-", 9, 2),
        ("((--((((--", 2, 2),  # the first of two
        ("((((((((((", 0, 0),
        ("----------", 0, 10),
    ],
)
def test_the_longest_straight(straight, start, length):
    """Nodes 4 m apart, of which some lie in turns of 500 m."""
    table = torch.zeros(10, 8)
    table[:, 4] = torch.tensor([{"-": 0.0005, "(": -0.002}[sign] for sign in straight])
    assert _longest_straight(SimpleNamespace(table=table, spacing=4.0)) == (4.0 * start, 4.0 * length)


@pytest.mark.parametrize("name", CARS)
def test_a_rolling_car_has_a_gear_and_no_slip(ring, name):
    """One gear per 14 m/s up to the fifth, which every car has."""
    car = load_car(name)
    speed = torch.tensor([0.0, 13.9, 14.1, 29.0, 55.9, 56.1, 69.9, 70.1, 95.0], dtype=F64)
    s, offset, error = torch.linspace(0.0, 1000.0, 9, dtype=F64), torch.full((9,), -2.0, dtype=F64), speed / 100.0
    packed = rolling_cars(ring, car, s, offset, error, speed)
    state = CarState(*packed.unbind(0))
    assert state.gear.tolist() == [1, 1, 2, 3, 4, 5, 5, 5, 5]
    assert state.gear.max() <= car.top_gear
    x, y, along = ring.place(s, offset)
    for found, expected in ((state.x, x), (state.y, y), (state.yaw, along + error), (state.vx, speed)):
        torch.testing.assert_close(found, expected)
    torch.testing.assert_close(packed[SPINS] * car.wheel_radius, speed.expand(4, 9))
    assert packed[HEATS].abs().max() == packed[WEARS].abs().max() == state.fuel.max() == 0.0


def test_wheel_loads_hold_the_car_in_equilibrium():
    car = load_car("gt3")
    wheels = WheelSet.of(car, dtype=F64)
    packed = torch.zeros(29, 5, dtype=F64)
    packed[ROW["vx"]] = torch.tensor([0.0, 50.0, 30.0, 30.0, 40.0])
    packed[ROW["vy"]] = torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0])
    packed[ROW["ax"]] = torch.tensor([0.0, 0.0, 3.0, -4.0, 0.0])
    packed[ROW["ay"]] = torch.tensor([0.0, 0.0, 2.0, -2.0, 5.0])
    packed[ROW["fuel"]] = 40.0
    s = CarState(*packed.unbind(0))
    load = wheel_loads(car, wheels, s)
    mass = total_mass(car, s.fuel)
    lift = 0.5 * AIR_DENSITY * car.lift_area * (s.vx**2 + s.vy**2)
    torch.testing.assert_close(load.sum(0), mass * GRAVITY + lift)
    # Moments about the centre of gravity: braking loads the front, a turn to the left the right-hand wheels.
    lever = car.aero_share_front * car.front_axle - (1.0 - car.aero_share_front) * car.rear_axle
    torch.testing.assert_close((load * wheels.x).sum(0), lift * lever - mass * s.ax * car.cg_height)
    torch.testing.assert_close((load * wheels.y).sum(0), -mass * s.ay * car.cg_height)
    front = ((load[1] - load[0]) * car.track_front / 2)[2:]
    torch.testing.assert_close(front, (car.roll_share_front * mass * s.ay * car.cg_height)[2:])


def test_slip_is_measured_where_the_wheels_are():
    car = load_car("gt3")
    wheels = WheelSet.of(car, dtype=F64)
    packed = torch.zeros(29, 3, dtype=F64)
    packed[ROW["vx"]] = 20.0
    packed[ROW["vy"]] = torch.tensor([0.0, 2.0, 0.0])
    packed[ROW["yaw_rate"]] = torch.tensor([0.0, 0.0, 0.5])
    packed[SPINS] = 22.0 / car.wheel_radius
    packed[HEATS] = 80.0
    seen = tyre_view(car, wheels, packed, torch.ones(3, dtype=F64))
    torch.testing.assert_close(seen.angle[:, 0], torch.zeros(4, dtype=F64))
    torch.testing.assert_close(seen.angle[:, 1], torch.full((4,), math.atan2(2.0, 20.0), dtype=F64))
    turning = torch.atan2((0.5 * wheels.x[:, 0]).abs(), 20.0 - 0.5 * wheels.y[:, 0])
    torch.testing.assert_close(seen.angle[:, 2], turning)
    assert (seen.side[:2, 2] > 0).all() and (seen.side[2:, 2] < 0).all()
    torch.testing.assert_close(seen.ratio[:, :2], torch.full((4, 2), 0.1, dtype=F64), atol=2e-3, rtol=0)


def test_a_slipstream_fades_with_distance_and_to_the_side():
    s = torch.tensor([[0.0, 0.0, 0.0, 980.0], [25.0, 25.0, -25.0, 5.0]], dtype=F64)
    offset = torch.tensor([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0]], dtype=F64)
    others = look_around(s, offset, torch.zeros(2, 4, dtype=torch.int64), 1000.0)
    strength = slipstream(others, 5.0)
    full = math.exp(-20.0 / SLIPSTREAM_LENGTH)
    aside = max(0.0, 1.0 - 1.0 / SLIPSTREAM_WIDTH)
    torch.testing.assert_close(strength[0], torch.tensor([full, aside * full, 0.0, full], dtype=F64))
    torch.testing.assert_close(strength[1], torch.tensor([0.0, 0.0, full, 0.0], dtype=F64))
    apart = look_around(s, offset, torch.tensor([[0], [1]]).expand(2, 4), 1000.0)
    assert (slipstream(apart, 5.0) < 1e-6).all()


def seen_by_hand(b, gap, ego, race):
    """The 32 numbers of one car, by a loop over the others."""
    rows = []
    for k in range(1, b["x"].shape[0]):
        other = (ego + k) % b["x"].shape[0]
        turn = np.array([[np.cos(b["yaw"][ego, race]), np.sin(b["yaw"][ego, race])]])
        turn = np.array([turn[0], [-turn[0, 1], turn[0, 0]]])
        place = turn @ [b["x"][other, race] - b["x"][ego, race], b["y"][other, race] - b["y"][ego, race]]
        speed = turn @ [b["vx"][other, race] - b["vx"][ego, race], b["vy"][other, race] - b["vy"][ego, race]]
        heading = b["yaw"][other, race] - b["yaw"][ego, race]
        far = gap[k - 1, ego, race]
        row = [*np.arcsinh(place / 2) / 4, *speed / 20, np.sin(heading), np.cos(heading), far / 100, 1.0]
        rows.append((abs(far), far, row))
    nearest = [entry for entry in sorted(rows, key=lambda entry: entry[0])[:4] if entry[0] < 150.0]
    ordered = [entry[2] for entry in sorted(nearest, key=lambda entry: entry[1])]
    return np.array(ordered + [[0.0] * 8] * (4 - len(ordered))).ravel()


@pytest.mark.parametrize("cars", [2, 4, 6])
def test_the_nearest_opponents_are_seen_in_the_order_of_the_track(cars):
    random = np.random.default_rng(cars)
    size = (cars, 20)
    b = {name: random.uniform(-50, 50, size) for name in ("x", "y", "vx", "vy")}
    b["yaw"] = random.uniform(-3, 3, size)
    s = random.uniform(0, 800, size)
    t = {name: torch.tensor(values) for name, values in b.items()}
    zero = torch.zeros(size, dtype=F64)
    bodies = Bodies(t["x"], t["y"], t["yaw"].cos(), t["yaw"].sin(), t["vx"], t["vy"], zero, 1.0, 1.0, 2.3, 1.0)
    others = look_around(torch.tensor(s), zero, torch.zeros(size, dtype=torch.int64), 800.0)
    gap = np.stack([(np.roll(s, -k, 0) - s + 400.0) % 800.0 - 400.0 for k in range(1, cars)])
    np.testing.assert_allclose(others.gap, gap, atol=1e-9)
    expected = [seen_by_hand(b, gap, ego, race) for ego in range(cars) for race in range(20)]
    np.testing.assert_allclose(opponents_seen(bodies, others), np.array(expected), atol=1e-9)


def test_a_car_put_back_keeps_its_tyres_and_fuel(ring):
    car = load_car("gt3")
    packed = torch.rand(29, 4, dtype=F64)
    packed[HEATS] += 70.0
    packed[ROW["fuel"]] = torch.tensor([5.0, 20.0, 33.0, 60.0])
    run = Run(*torch.zeros(25, 4, dtype=F64).unbind(0))._replace(s=torch.tensor([0.0, 100.0, 500.0, 900.0]).double())
    state = back_on_track(ring, car, packed, run)
    for kept in (HEATS, WEARS, ROW["fuel"]):
        assert torch.equal(state[kept], packed[kept])
    x, y, along = ring.place(run.s, torch.zeros(4, dtype=F64))
    torch.testing.assert_close(state[ROW["x"]], x)
    torch.testing.assert_close(state[ROW["y"]], y)
    torch.testing.assert_close((state[ROW["yaw"]] - along).sin(), torch.zeros(4, dtype=F64), atol=1e-6, rtol=0)
    torch.testing.assert_close(state[ROW["vx"]], torch.full((4,), RESCUE_SPEED, dtype=F64))
    torch.testing.assert_close(state[SPINS] * car.wheel_radius, torch.full((4, 4), RESCUE_SPEED, dtype=F64))


def test_a_driver_sees_the_scaled_state():
    env = RacingEnv(2, track="ring", seed=0)
    env.reset()
    seen = env.reset()["observation"]
    s = CarState(*env.state.unbind(0))

    def block(name):
        return seen[:, own_columns(name)].T

    motion = torch.stack([s.vx / 50, s.vy / 20, s.yaw_rate / 2, s.ax / 20, s.ay / 20])
    torch.testing.assert_close(block("motion"), motion)
    torch.testing.assert_close(block("tyre_heat"), (env.state[HEATS] - 90.0) / 60.0)
    torch.testing.assert_close(block("tyre_wear"), env.state[WEARS])
    torch.testing.assert_close(block("fuel")[0], s.fuel / 100.0)
    rpm, gear, torque = block("powertrain")
    torch.testing.assert_close(gear, s.gear / 8.0)
    assert ((rpm >= 0) & (rpm <= 1.1)).all() and ((torque >= 0) & (torque <= 1.0)).all()
    assert (block("tyre_load").sum(0) * 5000.0 > 1000.0 * 9.81).all()


def test_the_engine_turns_with_the_driven_wheels():
    """Both axles by their shares of the torque; its torque is limited by power over speed, and ends at full speed."""
    car = replace(load_car("gt3"), drive_share_front=0.4)
    wheels, packed, factor = (
        WheelSet.of(car, dtype=F64),
        torch.zeros(29, 4, dtype=F64),
        torch.tensor([0.5, 1.0, 4.0, 5.0]),
    )
    packed[ROW["gear"]], packed[ROW["throttle"]] = (
        torch.tensor([1.0, 3.0, 6.0, 6.0]),
        torch.tensor([1.0, 0.5, 1.0, 1.0]),
    )
    packed[SPINS] = torch.tensor([[40.0], [50.0], [60.0], [70.0]]) * factor
    packed[ROW["fuel"]] = 1.0
    run = Run(*torch.ones(25, 4, dtype=F64).unbind(0))
    columns = own_car(car, wheels, packed, run, tyre_view(car, wheels, packed, torch.ones(4, dtype=F64)), 1000.0)
    rpm, gear, torque = columns[own_columns("powertrain")]
    omega = (0.4 * 45.0 + 0.6 * 65.0) * factor * torch.tensor([3.15, 1.8, 1.09, 1.09], dtype=F64) * car.final_drive
    torch.testing.assert_close(rpm * car.rpm_max, omega * 60.0 / (2.0 * math.pi))
    torch.testing.assert_close(gear * 8.0, packed[ROW["gear"]])
    expected = torch.tensor([car.torque, 0.5 * car.torque, car.power / omega[2], 0.0], dtype=F64)
    torch.testing.assert_close(torque * car.torque, expected)
    packed[ROW["fuel"]] = 0.0
    columns = own_car(car, wheels, packed, run, tyre_view(car, wheels, packed, torch.ones(4, dtype=F64)), 1000.0)
    assert not columns[own_columns("powertrain")][2].any()
    assert rpm[2] < 1.0 < rpm[3] and expected[2] < car.torque < car.power / omega[1]


def test_a_car_is_described_by_its_parameters_near_one():
    fields = dict(mass=1200.0, power=400e3, torque=450.0, front_axle=1.2, rear_axle=1.8, grip=1.2)
    fields |= dict(lift_area=2.4, drag_area=0.9, drive_share_front=0.3)
    described = car_columns(SimpleNamespace(**{name: torch.tensor([value]) for name, value in fields.items()}))
    expected = [1200 / 1500, 400 / 500, 450 / 600, 1.2 / 3.0, 1.2 / 1.5, 2.4 / 3.0, 0.9, 0.3]
    torch.testing.assert_close(described, torch.tensor([expected]))

"""Physics of one car: performance, symmetry, dissipation, convergence."""

import pytest
import torch

from coachable.envs.racing.physics.cars import Car, Resources, car_pool, load_car
from coachable.envs.racing.physics.dynamics import GRAVITY, WheelSet, substep, total_mass
from coachable.envs.racing.physics.powertrain import FUEL_DENSITY, gear_ratio
from coachable.envs.racing.physics.state import HEATS, ROW, SPINS, WEARS
from coachable.envs.racing.physics.tyres import roll_wheel, slip_curve, wear_factor

KMH = 3.6


@pytest.mark.parametrize(
    ("name", "to_100", "to_200", "stopping"),
    [("gt3", (2.7, 3.8), (8.0, 11.0), (93.0, 120.0)), ("x2019", (2.4, 3.8), (4.5, 7.0), (55.0, 78.0))],
)
def test_acceleration_and_braking(plane, name, to_100, to_200, stopping):
    cars = plane(name, n=2, speed=torch.tensor([0.0, 200.0 / KMH]))
    times = {}
    for step in range(1, 1101):
        # Traction control, as a test driver has in his foot.
        slip = cars.state[SPINS, 0].max() * cars.car.wheel_radius / (cars.get("vx")[0] + 1.0) - 1.0
        foot = (1.6 - slip / cars.car.peak_slip_ratio).clamp(0.1, 1.0)
        cars.command(throttle=torch.stack([foot, 0 * foot]), brake=torch.tensor([0.0, 1.0]))
        cars.step()
        for mark in (100.0, 200.0):
            if cars.get("vx")[0] * KMH >= mark:
                times.setdefault(mark, step * cars.h)
        if len(times) == 2 and cars.get("vx")[1] ** 2 < 1e-4:
            break
    assert to_100[0] <= times[100.0] <= to_100[1]
    assert to_200[0] <= times[200.0] <= to_200[1]
    assert stopping[0] <= cars.get("x")[1] <= stopping[1]
    assert cars.get("vx")[1] ** 2 < 1e-4
    assert torch.equal(cars.state[SPINS][:, 1], torch.zeros(4, dtype=torch.float64))  # locked exactly


@pytest.mark.parametrize(("name", "slowest", "fastest"), [("gt3", 270.0, 300.0), ("x2019", 295.0, 335.0)])
def test_top_speed(plane, name, slowest, fastest):
    cars = plane(name, n=2, speed=torch.tensor([slowest, fastest]) / KMH)
    cars.set("gear", 6.0)
    cars.command(throttle=1.0)
    cars.step(100)
    before = cars.get("vx").clone()
    change = cars.step(20).get("vx") - before
    assert change[0] > 0 > change[1]


@pytest.mark.parametrize(("name", "least", "most"), [("gt3", 2.0, 2.7), ("x2019", 3.8, 5.0)])
def test_peak_deceleration(plane, name, least, most):
    cars = plane(name, speed=280.0 / KMH)
    cars.command(brake=1.0)
    speeds = torch.stack([cars.step().get("vx").clone() for _ in range(60)]).flatten()
    peak = (speeds[:-1] - speeds[1:]).max() / cars.h / GRAVITY
    assert least <= peak <= most


@pytest.mark.parametrize(("name", "expected"), [("gt3", (1.51, 1.68, 1.93, 2.17)), ("x2019", (1.92, 2.51, 3.24, 4.11))])
def test_lateral_acceleration(plane, name, expected):
    """Best of many steering angles, the speed held by an outside force."""
    speeds = torch.tensor([80.0, 140.0, 200.0, 260.0]) / KMH
    steers = torch.linspace(0.02, 0.8, 40)
    held = speeds.repeat_interleave(len(steers)).double()
    cars = plane(name, n=len(held), speed=held, heat=90.0)
    cars.command(steer=steers.repeat(len(speeds)), throttle=0.3)
    seen = []
    for step in range(250):
        scale = held / torch.hypot(cars.get("vx"), cars.get("vy"))
        cars.set("vx", cars.get("vx") * scale)
        cars.set("vy", cars.get("vy") * scale)
        cars.state[HEATS] = 90.0
        cars.step()
        if step >= 150:
            seen.append(cars.get("ay").clone())
    seen = torch.stack(seen) / GRAVITY
    steady = seen.amax(0) - seen.amin(0) < 0.1  # neither spinning nor still turning in
    mean = torch.where(steady, seen.mean(0), 0.0)
    best = mean.reshape(len(speeds), -1).max(1).values
    torch.testing.assert_close(best, torch.tensor(expected).double(), rtol=0.10, atol=0)


def random_motion(cars, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high):
        return low + (high - low) * torch.rand(cars.state.shape[1], generator=generator, dtype=torch.float64)

    for name, low, high in (
        ("vx", 0, 60),
        ("vy", -15, 15),
        ("yaw_rate", -2, 2),
        ("steer", -0.3, 0.3),
        ("yaw", -3, 3),
        ("ay", -8, 8),
    ):
        cars.set(name, uniform(low, high))
    cars.state[SPINS] = cars.get("vx") / cars.car.wheel_radius * (0.6 + 0.8 * uniform(0, 1))
    cars.set("steer_command", cars.get("steer") / cars.car.steer_max)
    return cars


def energy(cars):
    """Kinetic energy of body, wheels and engine."""
    car = cars.car
    mass = total_mass(car, cars.get("fuel"))
    ratio = gear_ratio(car, cars.get("gear"))
    inertia = cars.wheels.inertia + cars.wheels.drive * car.engine_inertia * ratio**2
    body = mass * (cars.get("vx") ** 2 + cars.get("vy") ** 2) + car.yaw_inertia * cars.get("yaw_rate") ** 2
    return 0.5 * (body + (inertia * cars.state[SPINS] ** 2).sum(0))


@pytest.mark.parametrize("name", ["gt3", "x2019", "street"])
def test_coasting_never_gains_energy(plane, name):
    """Engine inertia counted, gear fixed by a shift that never ends."""
    cars = random_motion(plane(name, n=200))
    cars.set("shift_time", 1e9)
    for _ in range(100):
        before = energy(cars)
        after = energy(cars.step())
        assert ((after - before) <= 1e-9 * before).all()


_MIRRORED = ("y", "yaw", "vy", "yaw_rate", "steer", "ay", "steer_command")


def mirrored(state):
    other = state.clone()
    for name in _MIRRORED:
        other[ROW[name]] *= -1
    for wheels in (SPINS, HEATS, WEARS):
        other[wheels] = state[wheels][[1, 0, 3, 2]]
    return other


def test_left_and_right_are_mirror_images(plane):
    here = random_motion(plane(n=50, resources=Resources(9.0, 3.0)))
    there = plane(n=50, resources=Resources(9.0, 3.0))
    there.state = mirrored(here.state)
    for cars in (here, there):
        cars.command(throttle=0.7)
        cars.step(50)
    torch.testing.assert_close(mirrored(there.state), here.state, rtol=1e-9, atol=1e-9)


def test_a_car_does_not_depend_on_the_size_of_its_batch(plane):
    together = random_motion(plane(n=33))
    alone = plane(n=1)
    alone.state = together.state[:, 7:8].clone()
    torch.testing.assert_close(alone.step(20).state[:, 0], together.step(20).state[:, 7], rtol=1e-10, atol=1e-10)


def test_substeps_of_10_ms_are_near_those_of_2_ms(plane):
    """Median position error after a second of random actions at 50 m/s: 0.25 m is what the specification measured."""
    ends = []
    for h in (0.01, 0.002):
        cars = plane(n=100, speed=50.0, h=h)
        generator = torch.Generator().manual_seed(0)
        for _ in range(10):
            actions = torch.rand(3, 100, generator=generator, dtype=torch.float64)
            cars.command(throttle=actions[0] * (actions[2] > 0.5), brake=actions[0] * (actions[2] <= 0.5))
            per_step = (2 * actions[1] - 1 - cars.get("steer_command")) / round(0.1 / h)
            cars.inputs[0] = per_step
            cars.step(round(0.1 / h))
        ends.append(cars.state[:2].clone())
    error = (ends[0] - ends[1]).norm(dim=0).median()
    assert error < 0.3


def test_the_tyre_curve_peaks_at_slip_one():
    for shape in (1.45, 1.55, 1.60):
        rho = torch.linspace(0.5, 1.5, 1001, dtype=torch.float64)
        force = rho * slip_curve(rho, shape)
        assert abs(rho[force.argmax()] - 1.0) < 1e-3
        assert force.max() == pytest.approx(1.0, abs=1e-9)


def test_no_tyre_exceeds_its_friction_circle():
    generator = torch.Generator().manual_seed(0)
    v_long, v_lat, spin = (100 * torch.rand(3, 1000, generator=generator, dtype=torch.float64)).unbind(0)
    limit = torch.full_like(spin, 4000.0)
    zero = torch.zeros_like(spin)
    wheel = roll_wheel(v_long, v_lat - 50, 3 * spin, limit, zero, zero, 1.5, 0.01, 0.33, 0.1, 0.13, 1.55)
    # The secant is averaged over the substep, which may overshoot the curve a little.
    assert torch.hypot(wheel.fx, wheel.fy).max() < 1.1 * 4000


def test_grip_falls_with_wear():
    wear = torch.tensor([0.0, 0.5, 0.75, 1.0])
    torch.testing.assert_close(wear_factor(wear), torch.tensor([1.0, 0.95, 0.925, 0.775]))


def test_fuel_follows_the_law(plane):
    """At full power: k [P (P_e / P)^n + 0.6 T_eb ω] / (0.36 · 43 MJ/kg)."""
    for exponent in (1.0, 2.5):
        cars = plane(speed=60.0, resources=Resources(0.0, 3.0, exponent))
        cars.set("throttle", 0.5)
        cars.command(throttle=0.5)
        cars.set("gear", 6.0)  # where the box stays at half throttle
        cars.step(1)
        before = cars.get("fuel").clone()
        spin = cars.state[SPINS][2:].mean()
        omega = spin * gear_ratio(cars.car, cars.get("gear"))[0]
        cars.step(1)
        share = 0.5 * min(cars.car.torque * omega, cars.car.power) / cars.car.power
        drag = cars.car.engine_brake * (0.3 + 0.7 * omega * 60 / (2 * torch.pi) / cars.car.rpm_max)
        burning = cars.car.power * share**exponent + 0.6 * drag * omega
        expected = 3.0 * burning / (0.36 * 43e6) / FUEL_DENSITY * cars.h
        assert (before - cars.get("fuel")).item() == pytest.approx(expected.item(), rel=1e-3)


def test_wear_and_fuel_can_be_switched_off(plane):
    cars = plane(speed=60.0, resources=Resources(0.0, 0.0))
    cars.command(steer=0.3, throttle=1.0)
    cars.step(20)
    assert (cars.state[WEARS] == 0).all()
    assert cars.get("fuel") == 30.0


def test_a_lighter_car_is_quicker(plane):
    heavy, light = plane(speed=30.0, fuel=100.0), plane(speed=30.0, fuel=10.0)
    for cars in (heavy, light):
        cars.command(throttle=1.0)
        cars.step(100)
    assert light.get("vx") > heavy.get("vx") + 0.1


def test_float32_and_pool_cars_follow_float64(plane):
    """Packing and unpacking a car changes nothing but the precision."""
    exact = plane(n=20, speed=50.0)
    exact.command(steer=torch.linspace(-0.2, 0.2, 20).double(), throttle=0.4)
    state, inputs = exact.state.float(), exact.inputs.float()
    car = Car.unpack(load_car("gt3").pack()[:, None].repeat(1, 20))
    wheels = WheelSet.of(car)
    exact.step(10)
    for _ in range(10):
        state = substep(state, inputs, car, wheels, Resources(), 0.01)
    torch.testing.assert_close(state.double(), exact.state, rtol=1e-4, atol=1e-3)


def test_the_pool_has_530_different_cars():
    pool = car_pool()
    assert pool.shape[1] == 530
    assert len({tuple(column) for column in pool.T.tolist()}) == 530
    assert torch.equal(pool, car_pool())
    car = Car.unpack(pool)
    assert (car.mass > 500).all() and (car.front_axle > 0.8).all() and (car.rear_axle > 0.8).all()
    assert (car.drive_share_front[:50] == 0).all()


def test_unknown_cars_are_refused():
    with pytest.raises(ValueError, match=r"unknown car 'gt4'.*gt3"):
        load_car("gt4")

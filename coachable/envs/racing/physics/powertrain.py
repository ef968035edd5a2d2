"""Model of the engine, the automatic gearbox, the differential and the fuel."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from coachable.envs.racing.physics.cars import MAX_GEARS, Car, Resources

SHIFT_TIME = 0.05  # [s] of torque cut
FUEL_DENSITY = 0.745  # [kg/l]
ENGINE_EFFICIENCY = 0.36
FUEL_ENERGY = 43e6  # [J/kg]
FRICTION_SHARE = 0.6  # of the engine brake that burns fuel while the throttle is open
IDLE_RATE = 1e-4  # [kg/s]
DIFFERENTIAL = 60.0  # [N m s/rad]
DIFFERENTIAL_MAX = 400.0  # [N m]
_RPM = 60.0 / (2.0 * math.pi)


class Drive(NamedTuple):
    """Effect of the engine on the wheels in one substep, and its new state, (N,) each."""

    torque: Tensor  # of all driven wheels together [N m]
    resistance: Tensor  # engine brake at the wheels, not negative [N m]
    inertia: Tensor  # of the engine, as felt by all driven wheels together [kg m²]
    gear: Tensor
    shift_time: Tensor
    fuel: Tensor  # [l]


def gear_ratio(car: Car, gear: Tensor) -> Tensor:
    """Return the total ratio of engine speed to wheel speed in the gears (N,).

    Args:
        car: Parameters.
        gear: Gears (N,), from 1.

    Returns:
        Ratio (N,), with the final drive.
    """
    ratio = torch.zeros_like(gear) + car.gears[0] * car.final_drive
    for index in range(1, MAX_GEARS):
        ratio = torch.where(gear > index + 0.5, car.gears[index] * car.final_drive, ratio)
    return ratio


def engine_speed(car: Car, ratio: Tensor, wheel_speed: Tensor) -> Tensor:
    """Return the engine speed [rpm], at least that at idle, from the mean speed of the driven wheels [rad/s].

    Args:
        car: Parameters.
        ratio: Ratio of engine speed to wheel speed (N,).
        wheel_speed: Mean speed of the driven wheels (N,) [rad/s].

    Returns:
        (N,) [rpm], at least the speed at idle.
    """
    rpm = wheel_speed * ratio * _RPM
    return torch.maximum(rpm, torch.zeros_like(rpm) + car.rpm_idle)


def full_torque(car: Car, omega: Tensor) -> Tensor:
    """Return the torque at full throttle, the lesser of the largest torque and `power / omega`.

    Args:
        car: Parameters.
        omega: Engine speeds (N,) [rad/s].

    Returns:
        (N,) [N m].
    """
    return torch.minimum(torch.zeros_like(omega) + car.torque, car.power / omega)


def drive_wheels(
    car: Car,
    resources: Resources,
    throttle: Tensor,
    wheel_speed: Tensor,
    gear: Tensor,
    shift_time: Tensor,
    fuel: Tensor,
    h: float,
) -> Drive:
    """Advance the engine and the automatic gearbox by one substep.

    At partial throttle the gearbox shifts up earlier, which saves fuel under the game-like law.

    Args:
        car: Parameters.
        resources: Fuel rate and fuel law.
        throttle: Throttle (N,) in [0, 1].
        wheel_speed: Mean speed of the driven wheels (N,) [rad/s].
        gear: Gear (N,), as a float.
        shift_time: Time left of the torque cut (N,) [s].
        fuel: Fuel (N,) [l].
        h: Substep [s].
    """
    ratio = gear_ratio(car, gear)
    rpm = engine_speed(car, ratio, wheel_speed)
    below = engine_speed(car, gear_ratio(car, gear - 1.0), wheel_speed)
    settled = shift_time <= 0.0
    up = settled & (rpm > car.rpm_max * (0.62 + 0.36 * throttle)) & (gear < car.top_gear - 0.5)
    down = settled & (below < car.rpm_max * (0.50 + 0.32 * throttle)) & (gear > 1.5)
    gear = torch.where(up, gear + 1.0, torch.where(down, gear - 1.0, gear))
    shift_time = torch.where(up | down, SHIFT_TIME, torch.clamp(shift_time - h, min=0.0))

    ratio = gear_ratio(car, gear)
    rpm = engine_speed(car, ratio, wheel_speed)
    omega = rpm / _RPM
    pulling = (shift_time <= 0.0) & (rpm <= car.rpm_max) & (fuel > 0.0)
    applied = torch.where(pulling, throttle, 0.0)
    full = full_torque(car, omega)
    drag = car.engine_brake * (0.3 + 0.7 * torch.clamp(rpm / car.rpm_max, max=1.0))

    power = torch.clamp(applied * full * omega / car.power, 0.0, 1.0)
    if resources.fuel_exponent != 1.0:
        power = power**resources.fuel_exponent
    burning = car.power * power + FRICTION_SHARE * drag * omega * (throttle > 0.02)
    mass_rate = resources.fuel * torch.clamp(burning / (ENGINE_EFFICIENCY * FUEL_ENERGY), min=IDLE_RATE)
    fuel = torch.clamp(fuel - h * mass_rate / FUEL_DENSITY, min=0.0)
    return Drive(
        torque=applied * full * ratio * car.efficiency,
        resistance=(1.0 - throttle) * drag * ratio * car.efficiency,
        inertia=car.engine_inertia * ratio * ratio,
        gear=gear,
        shift_time=shift_time,
        fuel=fuel,
    )


def differential(left: Tensor, right: Tensor) -> Tensor:
    """Return the torque that a viscous differential moves from a faster left wheel to the right one [N m].

    Args:
        left: Speed of the left wheel (N,) [rad/s].
        right: Speed of the right wheel (N,) [rad/s].

    Returns:
        (N,) [N m], in proportion to the difference up to a limit.
    """
    return torch.clamp(DIFFERENTIAL * (left - right), -DIFFERENTIAL_MAX, DIFFERENTIAL_MAX)


def driven(share: Any) -> Any:
    """Return 1 if an axle is driven and 0 if its share of the torque is 0."""
    return (share > 0.0).to(share.dtype) if isinstance(share, Tensor) else float(share > 0.0)

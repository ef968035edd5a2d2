"""Quasi-steady-state speeds that friction, power and brakes allow along a line."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coachable.envs.racing.physics.cars import Car
from coachable.envs.racing.physics.dynamics import AIR_DENSITY, GRAVITY
from coachable.envs.racing.physics.powertrain import FUEL_DENSITY

LOAD_TRANSFER = 0.96  # share of the ideal grip that is left when the load shifts between wheels
SPEED_MAX = 110.0  # [m/s]
_RPM = 60.0 / (2.0 * np.pi)
_SHIFT_UP = 0.98  # of the highest engine speed, at full throttle
_LAPS = 2  # so that the end of the lap fits its start


@dataclass(frozen=True)
class Envelope:
    """Accelerations of a car as a point mass, (n,) [m/s²] at speeds (n,) [m/s].

    Attributes:
        car: Parameters of one car, as numbers.
        fuel: Fuel on board [l].
        grip: Factor of the friction coefficient.
        braking: Share of the friction that the brakes can use.
    """

    car: Car
    fuel: float = 30.0
    grip: float = 1.0
    braking: float = 1.0

    @property
    def mass(self) -> float:
        """Mass of the car and its fuel [kg]."""
        return self.car.mass + FUEL_DENSITY * self.fuel

    def friction(self, speed: np.ndarray) -> np.ndarray:
        """Return the largest acceleration in any direction along the road.

        It is μ N / m with the load N of weight and downforce ½ ρ A v², and a friction coefficient μ that falls with the
        load.
        """
        load = self.mass * GRAVITY + 0.5 * AIR_DENSITY * self.car.lift_area * speed**2
        coefficient = self.car.grip + self.car.grip_per_load * 1e-3 * (load / 4 - self.car.reference_load)
        return LOAD_TRANSFER * self.grip * coefficient * load / self.mass

    def drag(self, speed: np.ndarray) -> np.ndarray:
        """Return the deceleration ½ ρ A v² / m + c g by air drag and rolling resistance."""
        air = 0.5 * AIR_DENSITY * self.car.drag_area * speed**2 / self.mass
        return air + self.car.rolling_resistance * GRAVITY

    def engine(self, speed: np.ndarray) -> np.ndarray:
        """Return the acceleration at full throttle in the best gear, with the inertia of wheels and engine."""
        car = self.car
        wheel = np.maximum(speed, 3.0) / car.wheel_radius  # [rad/s]
        wheels = 2 * (car.wheel_inertia_front + car.wheel_inertia_rear)
        best = np.zeros_like(wheel)
        for gear in car.gears:
            ratio = gear * car.final_drive
            omega = np.maximum(wheel * ratio, car.rpm_idle / _RPM)
            force = np.minimum(car.torque, car.power / omega) * ratio * car.efficiency / car.wheel_radius
            spinning = (wheels + car.engine_inertia * ratio**2) / car.wheel_radius**2
            # The gearbox shifts up at 98 % of the highest speed.
            gain = np.where((omega * _RPM <= _SHIFT_UP * car.rpm_max) | (gear == car.gears[-1]), force, 0.0)
            best = np.maximum(best, gain / (self.mass + spinning))
        return best

    def traction(self, speed: np.ndarray) -> np.ndarray:
        """Return the largest acceleration that the tyres of the driven axle allow, after the load transfer."""
        car = self.car
        share = car.front_axle / (car.front_axle + car.rear_axle)
        driven = (1 - car.drive_share_front) * share + car.drive_share_front * (1 - share)
        both = 1.0 if 0.0 < car.drive_share_front < 1.0 else driven + 0.12
        return self.friction(speed) * min(both, 1.0)


def cornering_speed(envelope: Envelope, curvature: np.ndarray) -> np.ndarray:
    """Return the highest steady speed, where `v² |κ|` equals the acceleration by friction, found by bisection.

    Args:
        envelope: The car.
        curvature: (n,) [1/m].

    Returns:
        (n,) [m/s], between 3 m/s and `SPEED_MAX`.
    """
    low, high = np.full(curvature.shape, 3.0), np.full(curvature.shape, SPEED_MAX)
    for _ in range(40):
        middle = 0.5 * (low + high)
        fits = middle**2 * np.abs(curvature) <= envelope.friction(middle)
        low, high = np.where(fits, middle, low), np.where(fits, high, middle)
    return low


def speed_profiles(
    envelope: Envelope, curvatures: Sequence[np.ndarray], spacings: Sequence[np.ndarray | float]
) -> list[np.ndarray]:
    """Return the highest speeds on closed lines within the friction ellipse and the limits of engine and brakes.

    Args:
        envelope: Largest accelerations of the car.
        curvatures: Curvature (n,) of each line [1/m].
        spacings: Distance from each point to the next of each line, (n,) or one number [m].

    Returns:
        Speeds (n,) [m/s] on each line; all are computed at once.
    """
    counts = np.array([len(line) for line in curvatures])
    first = np.cumsum(counts) - counts
    curvature = np.concatenate(curvatures)
    lines = zip(spacings, counts, strict=True)
    step = np.concatenate([np.broadcast_to(np.asarray(s, dtype=float), (int(n),)) for s, n in lines])
    speed = cornering_speed(envelope, curvature)
    grid = np.linspace(3.0, SPEED_MAX, 200)
    engine = envelope.engine(grid)
    rounds = _LAPS * int(counts.max())
    for k in range(rounds):  # braking, backwards
        i = first + (-1 - k) % counts
        ahead = speed[first + (-k) % counts]
        room = envelope.braking * _left(envelope.friction(ahead), ahead**2 * curvature[i]) + envelope.drag(ahead)
        speed[i] = np.minimum(speed[i], np.sqrt(ahead**2 + 2 * room * step[i]))
    for k in range(rounds):  # accelerating, forwards
        i, following = first + k % counts, first + (k + 1) % counts
        now = speed[i]
        traction = envelope.traction(now)
        share = _left(traction, now**2 * curvature[i] * traction / envelope.friction(now))
        gain = np.minimum(share, np.interp(now, grid, engine)) - envelope.drag(now)
        speed[following] = np.minimum(speed[following], np.sqrt(np.maximum(now**2 + 2 * gain * step[i], 1.0)))
    return np.split(speed, first[1:])


def _left(friction: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the longitudinal acceleration that the friction circle leaves beside a lateral one."""
    return np.sqrt(np.maximum(friction**2 - used**2, 0.0))

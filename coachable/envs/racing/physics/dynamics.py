"""One substep of the double-track model for N cars, as a pure function without branches on values (`torch.compile`).

Wheels are the first axis, (4, N). This takes a quarter of the operations of one tensor per wheel, and rows stay
contiguous.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from coachable.envs.racing.physics.body import (
    PlanarForce,
    implicit_change,
    rotate,
    sum_wheels,
    wall_impulse,
    wheel_damping,
    wheel_force,
    wheel_velocity,
)
from coachable.envs.racing.physics.cars import Car, Resources
from coachable.envs.racing.physics.powertrain import FUEL_DENSITY, differential, drive_wheels, driven
from coachable.envs.racing.physics.state import HEATS, SPINS, WEARS, CarInputs, CarState
from coachable.envs.racing.physics.surface import (
    WALL_FRICTION,
    WALL_RESTITUTION,
    beyond,
    locate,
    surface_grip,
    surface_rolling,
)
from coachable.envs.racing.physics.tyres import (
    HEAT_MAX,
    WEAR_ENERGY,
    friction,
    heat_factor,
    heat_rate,
    roll_wheel,
    tangent,
    wear_factor,
)

GRAVITY = 9.81
AIR_DENSITY = 1.2
PEDAL_TIME = 0.03  # [s], lag of throttle and brake
LOAD_TIME = 0.06  # [s], lag of the load transfer
LOAD_MIN = 20.0  # [N]
_CORNER_BLEND = 0.05  # a body nearly parallel to a wall touches it with its side, not with a corner


@dataclass(frozen=True)
class WheelSet:
    """Parameters that differ between the wheels of a car, (4, 1) each, or (4, N) for different cars."""

    front: Tensor  # 1 for front wheels
    x: Tensor  # position [m]
    y: Tensor
    inertia: Tensor  # [kg m²]
    brake: Tensor  # brake torque at full pedal [N m]
    drive: Tensor  # share of the engine's torque
    lock: Tensor  # sign of the differential's torque; 0 for wheels that are not driven
    weight: Tensor  # share of the car's weight
    lift: Tensor  # share of the downforce
    pitch: Tensor  # load per longitudinal acceleration and mass [s²/m · m/s²]
    roll: Tensor  # load per lateral acceleration and mass

    @classmethod
    def of(cls, car: Car, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> WheelSet:
        """Return the wheels of one car, or of N.

        Args:
            car: Parameters, as numbers or tensors (N,).
            device: Device of the tensors.
            dtype: Type of the tensors.
        """

        def wheels(*values: Any) -> Tensor:
            rows = [torch.as_tensor(value, dtype=dtype, device=device).reshape(-1) for value in values]
            return torch.stack(torch.broadcast_tensors(*rows))

        def axles(front: Any, rear: Any) -> Tensor:
            return wheels(front, front, rear, rear)

        base = car.front_axle + car.rear_axle
        share = car.drive_share_front
        pitch = car.cg_height / base / 2
        roll_front = car.cg_height * car.roll_share_front / car.track_front
        roll_rear = car.cg_height * (1.0 - car.roll_share_front) / car.track_rear
        locks = (driven(share), driven(1.0 - share))
        return cls(
            front=axles(1.0, 0.0),
            x=axles(car.front_axle, -car.rear_axle),
            y=wheels(car.track_front / 2, -car.track_front / 2, car.track_rear / 2, -car.track_rear / 2),
            inertia=axles(car.wheel_inertia_front, car.wheel_inertia_rear),
            brake=axles(
                car.brake_torque * car.brake_share_front / 2, car.brake_torque * (1.0 - car.brake_share_front) / 2
            ),
            drive=axles(share / 2, (1.0 - share) / 2),
            lock=wheels(-locks[0], locks[0], -locks[1], locks[1]),
            weight=axles(car.rear_axle / base / 2, car.front_axle / base / 2),
            lift=axles(car.aero_share_front / 2, (1.0 - car.aero_share_front) / 2),
            pitch=axles(-pitch, pitch),
            roll=wheels(-roll_front, roll_front, -roll_rear, roll_rear),
        )


def total_mass(car: Car, fuel: Tensor) -> Tensor:
    """Return the mass of the cars with their fuel (N,) [l] in kg.

    Args:
        car: Parameters.
        fuel: Fuel on board (N,) [l].

    Returns:
        (N,) [kg].
    """
    return car.mass + FUEL_DENSITY * fuel


def wheel_loads(car: Car, wheels: WheelSet, s: CarState, front_lift: Tensor | float = 1.0) -> Tensor:
    """Return the vertical loads on the wheels.

    Braking loads the front wheels, cornering the outer ones.

    Args:
        car: Parameters.
        wheels: Wheels of that car.
        s: State of N cars.
        front_lift: Factor of the downforce on the front axle.

    Returns:
        Loads (4, N) [N].
    """
    mass = total_mass(car, s.fuel)
    lift = 0.5 * AIR_DENSITY * car.lift_area * (s.vx * s.vx + s.vy * s.vy)
    lift = lift * (1.0 + wheels.front * (front_lift - 1.0))
    load = mass * (wheels.weight * GRAVITY + wheels.pitch * s.ax + wheels.roll * s.ay) + wheels.lift * lift
    return torch.clamp(load, min=LOAD_MIN)


def steering(wheels: WheelSet, steer: Tensor) -> tuple[Tensor, Tensor]:
    """Return cosine and sine of each wheel's angle, (4, N), for steering angles (N,) [rad].

    Args:
        wheels: Wheels of the cars.
        steer: Steering angles (N,) [rad].

    Returns:
        Cosine and sine (4, N).
    """
    return 1.0 + wheels.front * (torch.cos(steer) - 1.0), wheels.front * torch.sin(steer)


def wheel_grip(car: Car, load: Tensor, heat: Tensor, wear: Tensor, compound: Tensor) -> Tensor:
    """Return the friction coefficients of tyres on the track, (4, N).

    Args:
        car: Parameters.
        load: Vertical loads (4, N) [N].
        heat: Temperatures (4, N) [°C].
        wear: Wear (4, N) in [0, 1].
        compound: Grip factor of the compound (N,).
    """
    base = friction(load, car.grip, car.grip_per_load, car.reference_load)
    return base * compound * heat_factor(heat) * wear_factor(wear)


def substep(
    packed: Tensor, packed_inputs: Tensor, car: Car, wheels: WheelSet, resources: Resources, h: float
) -> Tensor:
    """Advance the cars by a substep.

    Args:
        packed: State (29, N) with the rows of `CarState`.
        packed_inputs: Inputs (15, N) with the rows of `CarInputs`.
        car: Parameters, as numbers or tensors (N,).
        wheels: Wheels of that car.
        resources: Wear and fuel rates.
        h: Substep [s].

    Returns:
        The new state (29, N).
    """
    s, u = CarState(*packed.unbind(0)), CarInputs(*packed_inputs.unbind(0))
    spins, heats, wears = packed[SPINS], packed[HEATS], packed[WEARS]
    mass = total_mass(car, s.fuel)

    # Actuators.
    command = s.steer_command + u.steer_step
    steer = s.steer + torch.clamp(command * car.steer_max - s.steer, -car.steer_rate * h, car.steer_rate * h)
    lag = h / (PEDAL_TIME + h)
    throttle = s.throttle + lag * (u.throttle - s.throttle)
    brake = s.brake + lag * (u.brake - s.brake)

    # Engine.
    share = car.drive_share_front
    front_lock, rear_lock = differential(s.spin_fl, s.spin_fr), differential(s.spin_rl, s.spin_rr)
    mean_speed = share * (0.5 * (s.spin_fl + s.spin_fr)) + (1.0 - share) * (0.5 * (s.spin_rl + s.spin_rr))
    drive = drive_wheels(car, resources, throttle, mean_speed, s.gear, s.shift_time, s.fuel, h)
    lock = rear_lock + wheels.front * (front_lock - rear_lock)

    # Position of the wheels on the road.
    arc = locate(s.x, s.y, u.node_x, u.node_y, u.node_tx, u.node_ty, u.curvature)
    cos, sin = torch.cos(s.yaw), torch.sin(s.yaw)
    toward_x, toward_y = rotate(arc.nx, arc.ny, cos, -sin)  # normal of the road in the car's frame
    outside = beyond(arc.offset + toward_x * wheels.x + toward_y * wheels.y, u.left, u.right)  # (4, N)
    off = (outside > 0.0).to(packed.dtype)

    # Tyres.
    load = wheel_loads(car, wheels, s, u.front_lift_factor)
    grip = wheel_grip(car, load, heats, wears, u.grip_factor) * surface_grip(outside)
    wheel_cos, wheel_sin = steering(wheels, steer)
    v_long, v_lat = rotate(*wheel_velocity(s.vx, s.vy, s.yaw_rate, wheels.x, wheels.y), wheel_cos, -wheel_sin)
    force = roll_wheel(
        v_long,
        v_lat,
        spins,
        grip * load,
        drive=wheels.drive * drive.torque + wheels.lock * lock,
        brake=wheels.brake * brake + wheels.drive * drive.resistance,
        inertia=wheels.inertia + wheels.drive * drive.inertia,
        h=h,
        radius=car.wheel_radius,
        peak_ratio=car.peak_slip_ratio,
        peak_tangent=tangent(car.peak_slip_angle),
        shape=car.shape,
    )
    heats = torch.clamp(heats + h * heat_rate(force.slip_power, load, v_long.abs(), heats), max=HEAT_MAX)
    if resources.wear != 0.0:
        wear_rate = (h * resources.wear / WEAR_ENERGY) * u.wear_factor
        wears = torch.clamp(wears + wear_rate * force.slip_power, max=1.0)

    # Body.
    tyres = sum_wheels(wheel_force(force.fx, force.fy, wheel_cos, wheel_sin, wheels.x, wheels.y))
    damping = sum_wheels(wheel_damping(force.lateral_damping, wheel_cos, wheel_sin, wheels.x, wheels.y))
    rolling = _sum_rows(load * (car.rolling_resistance + surface_rolling(outside)))
    air = 0.5 * AIR_DENSITY * car.drag_area * u.drag_factor * torch.sqrt(s.vx * s.vx + s.vy * s.vy)
    total = PlanarForce(tyres.x - air * s.vx - rolling * torch.tanh(s.vx), tyres.y - air * s.vy, tyres.yaw)
    dvx, dvy, dr = implicit_change(total, damping, mass, car.yaw_inertia, h)
    vx, vy, yaw_rate = s.vx + dvx, s.vy + dvy, s.yaw_rate + dr

    # The velocity keeps its direction in the world while the car's frame turns; positions by the trapezoidal rule.
    world_x, world_y = rotate(0.5 * (s.vx + vx), 0.5 * (s.vy + vy), cos, sin)
    turn = 0.5 * h * (s.yaw_rate + yaw_rate)
    turned = turn * turn
    vx, vy = rotate(vx, vy, 1.0 - turned * (0.5 - turned / 24.0), -turn * (1.0 - turned / 6.0))

    # Walls.
    offset = arc.offset + h * (arc.nx * world_x + arc.ny * world_y)
    extent = 0.5 * (toward_x.abs() * car.length + toward_y.abs() * car.width)
    depth = beyond(offset, u.left, u.right) + extent - u.margin
    touching = depth > 0.0
    side = torch.where(offset - u.left > -offset - u.right, 1.0, -1.0)
    nx, ny = side * toward_x, side * toward_y
    corner_x = 0.5 * car.length * torch.clamp(nx / _CORNER_BLEND, -1.0, 1.0)
    corner_y = 0.5 * car.width * torch.clamp(ny / _CORNER_BLEND, -1.0, 1.0)
    hit = wall_impulse(
        (vx, vy, yaw_rate),
        (corner_x, corner_y),
        (nx, ny),
        touching,
        mass,
        car.yaw_inertia,
        WALL_RESTITUTION,
        WALL_FRICTION,
    )
    push = torch.where(touching, -side * depth, 0.0)
    filtered = h / (LOAD_TIME + h)
    first = torch.stack(
        [
            s.x + h * world_x + push * arc.nx,
            s.y + h * world_y + push * arc.ny,
            s.yaw + turn,
            vx + hit.vx,
            vy + hit.vy,
            yaw_rate + hit.yaw_rate,
        ]
    )
    middle = torch.stack([steer, s.ax + filtered * (total.x / mass - s.ax), s.ay + filtered * (total.y / mass - s.ay)])
    last = torch.stack(
        [
            drive.fuel,
            drive.gear,
            drive.shift_time,
            throttle,
            brake,
            command,
            s.off_time + h * (_sum_rows(off) > 2.5).to(packed.dtype),
            s.wall_time + h * touching.to(packed.dtype),
        ]
    )
    return torch.cat([first, force.spin, middle, heats, wears, last])


def _sum_rows(values: Tensor) -> Tensor:
    """Sum over the wheels, in a fixed order."""
    return values[0] + values[1] + values[2] + values[3]

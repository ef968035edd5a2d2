"""State of the task beside that of the physics, and quantities derived from both."""

from typing import NamedTuple

import torch
from torch import Tensor

from coachable.envs.racing.circuit.track import Course
from coachable.envs.racing.physics.body import rotate, wheel_velocity
from coachable.envs.racing.physics.cars import Car
from coachable.envs.racing.physics.dynamics import WheelSet, steering, wheel_grip, wheel_loads
from coachable.envs.racing.physics.state import HEATS, SPINS, WEARS, CarState
from coachable.envs.racing.physics.tyres import SLIP_SPEED

SLIPSTREAM_LENGTH = 25.0  # [m]
SLIPSTREAM_WIDTH = 1.5  # [m]
SLIPSTREAM_DRAG, SLIPSTREAM_LIFT = 0.30, 0.15
_FAR = 1e4  # [m], gap to a car of another group


class Run(NamedTuple):
    """Task state of N cars with one tensor (N,) per field, packed as the rows of one tensor (25, N)."""

    s: Tensor  # distance along the centre line [m]
    offset: Tensor  # from it, to the left [m]
    along: Tensor  # cosine of the heading relative to the track
    across: Tensor  # sine of it
    distance: Tensor  # covered in this episode [m]
    steps: Tensor
    wrong_time: Tensor  # going backwards [s]
    stopped_time: Tensor  # [s]
    steer: Tensor  # last action
    pedal: Tensor
    steer_before: Tensor  # the one before
    pedal_before: Tensor
    off: Tensor  # flags, 0 or 1
    wall: Tensor
    contact: Tensor
    slipstream: Tensor  # in [0, 1]
    spins: Tensor  # times that the car turned against the track in this episode
    # Frame of the nearest node: see `track.COLUMNS`.
    node_x: Tensor
    node_y: Tensor
    node_tx: Tensor
    node_ty: Tensor
    curvature: Tensor
    left: Tensor
    right: Tensor
    margin: Tensor


class Field(NamedTuple):
    """All cars of an environment, for drivers: B races of A cars, in which column k * B + b is car k of race b."""

    state: Tensor  # (STATE_ROWS, A * B), packed `CarState`
    run: Tensor  # (RUN_ROWS, A * B), packed `Run`
    car: Car  # parameters
    wheels: WheelSet
    compound_grip: Tensor  # (A * B,)
    course: Course
    group: Tensor  # (A, B), cars of one group meet each other
    seeds: Tensor  # (B,)
    episode: Tensor  # (B,), number of the episode

    @property
    def cars(self) -> int:
        """Number A of cars in each race."""
        return self.group.shape[0]

    @property
    def races(self) -> int:
        """Number B of races."""
        return self.group.shape[1]


RUN_ROWS = len(Run._fields)
FRAME = slice(Run._fields.index("node_x"), RUN_ROWS)


class TyreView(NamedTuple):
    """Loads, slip and grip of the wheels, (4, N) each."""

    load: Tensor  # [N]
    ratio: Tensor  # slip ratio
    angle: Tensor  # slip angle in [0, π/2], unsigned [rad]
    side: Tensor  # signed lateral slip, tangent of the angle at speed
    grip: Tensor  # friction coefficient


def tyre_view(car: Car, wheels: WheelSet, packed: Tensor, compound_grip: Tensor) -> TyreView:
    """Return loads, slip and grip of the tyres.

    Args:
        car: Parameters.
        wheels: Wheels of that car.
        packed: State (29, N).
        compound_grip: Grip factor of the compound (N,).
    """
    s = CarState(*packed.unbind(0))
    load = wheel_loads(car, wheels, s)
    cos, sin = steering(wheels, s.steer)
    v_long, v_lat = rotate(*wheel_velocity(s.vx, s.vy, s.yaw_rate, wheels.x, wheels.y), cos, -sin)
    den = torch.sqrt(v_long * v_long + SLIP_SPEED * SLIP_SPEED)
    return TyreView(
        load=load,
        ratio=(packed[SPINS] * car.wheel_radius - v_long) / den,
        angle=torch.atan2(v_lat.abs(), v_long.abs()),
        side=v_lat / den,
        grip=wheel_grip(car, load, packed[HEATS], packed[WEARS], compound_grip),
    )


def wrap(distance: Tensor, length: float | Tensor) -> Tensor:
    """Return signed distances on a loop of the given length, in [-length / 2, length / 2) [m].

    Args:
        distance: Signed distances [m], any shape.
        length: Length of the loop [m].

    Returns:
        Distances of the same shape [m].
    """
    return torch.remainder(distance + 0.5 * length, length) - 0.5 * length


class Others(NamedTuple):
    """Positions of the other cars relative to each car, (A - 1, A, B) each; entry k - 1 is of the k-th next car."""

    gap: Tensor  # distance along the track from this car to the other, positive ahead [m]
    aside: Tensor  # offset of the other less this one's [m]
    met: Tensor  # bool, of the same group


def others_of(values: Tensor) -> Tensor:
    """Return the values (A, B) of the other cars as (A - 1, A, B); entry k - 1 is that of the k-th next car."""
    return torch.stack([values.roll(-k, 0) for k in range(1, values.shape[0])])


def look_around(s: Tensor, offset: Tensor, group: Tensor, length: float | Tensor) -> Others:
    """Return the positions of the other cars relative to each car.

    Args:
        s: Distances (A, B) along the track [m].
        offset: Offsets (A, B) from the centre line [m].
        group: Groups (A, B) of cars that meet.
        length: Length of the track, or of the track of each race (B,) [m].
    """
    gap = wrap(others_of(s) - s, length)
    met = others_of(group) == group
    return Others(torch.where(met, gap, _FAR), others_of(offset) - offset, met)


def slipstream(others: Others, car_length: Tensor | float) -> Tensor:
    """Return the strength of the strongest slipstream that each car is in.

    Args:
        others: Other cars around each car, (A - 1, A, B) each.
        car_length: Length of a car [m].

    Returns:
        (A, B) in [0, 1].
    """
    clear = others.gap - car_length  # from nose to tail
    beside = torch.clamp(1.0 - others.aside.abs() / SLIPSTREAM_WIDTH, min=0.0)
    strength = torch.exp(-clear.clamp(min=0.0) / SLIPSTREAM_LENGTH) * beside
    return torch.where(others.gap > 0.5 * car_length, strength, 0.0).amax(0)

"""Observations of a driver, scaled by known ranges."""

import math

import torch
from torch import Tensor

from coachable.envs.racing.circuit.track import Course
from coachable.envs.racing.physics.cars import COMPOUNDS, Car
from coachable.envs.racing.physics.contact import Bodies, partner
from coachable.envs.racing.physics.dynamics import WheelSet
from coachable.envs.racing.physics.powertrain import engine_speed, full_torque, gear_ratio
from coachable.envs.racing.physics.state import HEATS, SPINS, WEARS, CarState
from coachable.envs.racing.race.run import Others, Run, TyreView
from coachable.signals import Signal

COURSE_POINTS = 20
COURSE_TIME = 6.0  # [s] of travel that the course points cover
_COURSE_SPEED_MIN = 10.0  # [m/s], so that the course points of a slow car are not all beside it
CURVATURE_SCALE = 30.0  # [m], radius of a tight corner
OPPONENTS = 4
_SEEN = 150.0  # [m]
_OF_OPPONENT = {
    "forward": "asinh(m / 2) / 4",
    "left": "asinh(m / 2) / 4",
    "forward_speed": "20 m/s",
    "left_speed": "20 m/s",
    "heading_sine": "",
    "heading_cosine": "",
    "gap": "100 m",
    "is_seen": "",
}
_OPPONENT_GROUPS = (
    Signal(
        "opponents",
        8 * OPPONENTS,
        tuple(_OF_OPPONENT.values()) * OPPONENTS,
        tuple(f"{name}_{k + 1}" for k in range(OPPONENTS) for name in _OF_OPPONENT),
    ),
    Signal("slipstream", 1),
)
OPPONENT_COLUMNS = sum(group.width for group in _OPPONENT_GROUPS)

_WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
_OWN_GROUPS = (
    Signal(
        "motion",
        5,
        ("50 m/s", "20 m/s", "2 rad/s", "20 m/s^2", "20 m/s^2"),
        ("forward_speed", "left_speed", "yaw_rate", "forward_acceleration", "left_acceleration"),
    ),
    Signal("tyre_load", 4, "5 kN", _WHEELS),
    Signal("slip_ratio", 4, "1/3", _WHEELS),
    Signal("slip_angle", 4, "1/3, as a tangent", _WHEELS),
    Signal(
        "place",
        5,
        ("", "", "half width of the track", "", ""),
        ("lap_sine", "lap_cosine", "left_of_middle", "heading_sine", "heading_cosine"),
    ),
    Signal("flags", 3, "", ("off_track", "at_wall", "in_contact")),
    Signal(
        "controls",
        7,
        ("full lock", *[""] * 6),
        ("wheel_angle", "throttle", "brake", "steering", "pedals", "steering_before", "pedals_before"),
    ),
    Signal("powertrain", 3, ("highest engine speed", "8 gears", "full torque"), ("engine_speed", "gear", "torque")),
    Signal("tyre_heat", 4, "60 degC above 90 degC", _WHEELS),
    Signal("tyre_wear", 4, "", _WHEELS),
    Signal("tyre_grip", 4, "1.5", _WHEELS),
    Signal("fuel", 1, "100 l"),
    Signal("compound", len(COMPOUNDS), "", COMPOUNDS),
)
_CAR = Signal(
    "car",
    8,
    ("1500 kg", "500 kW", "600 N m", "", "1.5", "3 m^2", "m^2", ""),
    ("mass", "power", "torque", "front_axle_share", "grip", "lift_area", "drag_area", "front_drive_share"),
)

ACTION_GROUPS = (
    Signal("controls", 2, ("full lock to the left", "full throttle, or brake if negative"), ("steering", "pedals")),
)


def observation_groups(
    opponents: bool, pool: bool, course_points: int = COURSE_POINTS, curvature: bool = False
) -> tuple[Signal, ...]:
    """Return the blocks of the observation, in order; those of opponents come last.

    Args:
        opponents: Whether drivers see opponents.
        pool: Whether cars differ.
        course_points: Number of points of each edge of the track.
        curvature: Whether drivers see the curvature of the track ahead, and not where on the lap they are.
    """
    edges = [f"{edge}_{axis}" for edge in ("left_edge", "right_edge") for axis in ("forward", "left")]
    points = tuple(f"{edge}_{point + 1}" for edge in edges for point in range(course_points))
    groups = [*_OWN_GROUPS, *([_CAR] if pool else []), Signal("course", 4 * course_points, "100 m", points)]
    if curvature:
        bends = tuple(f"middle_{point + 1}" for point in range(course_points))
        groups.append(Signal("curvature", course_points, "1/30 m", bends))
    return (*groups, *(_OPPONENT_GROUPS if opponents else ()))


def own_columns(name: str) -> slice:
    """Return the columns of a block of `observation_groups`.

    Those of all blocks up to the compound are the same in every race.

    Raises:
        KeyError: If there is no such block.
    """
    first = 0
    for block in observation_groups(False, pool=False):
        if block.name == name:
            return slice(first, first + block.width)
        first += block.width
    raise KeyError(f"no block {name!r} in the observation")


def own_car(
    car: Car, wheels: WheelSet, packed: Tensor, run: Run, tyres: TyreView, length: float | Tensor | None
) -> list[Tensor]:
    """Return the columns (N,) of the car itself, up to the fuel.

    Args:
        car: Parameters.
        wheels: Wheels of that car.
        packed: State (29, N).
        run: Task state.
        tyres: Loads, slip and grip in that state.
        length: Length of the track [m], or None for columns of 0 instead of the place on the lap.
    """
    s = CarState(*packed.unbind(0))
    share = car.drive_share_front
    spins = packed[SPINS]
    mean_speed = share * 0.5 * (spins[0] + spins[1]) + (1.0 - share) * 0.5 * (spins[2] + spins[3])
    rpm = engine_speed(car, gear_ratio(car, s.gear), mean_speed)
    torque = s.throttle * full_torque(car, rpm * (2.0 * math.pi / 60.0)) * (rpm <= car.rpm_max) * (s.fuel > 0.0)
    phase = None if length is None else run.s * (2.0 * math.pi / length)
    place = [torch.zeros_like(run.s)] * 2 if phase is None else [phase.sin(), phase.cos()]
    half = 0.5 * (run.left + run.right)
    columns = [s.vx / 50.0, s.vy / 20.0, s.yaw_rate / 2.0, s.ax / 20.0, s.ay / 20.0]
    columns += (tyres.load / 5000.0).unbind(0)
    columns += torch.clamp(tyres.ratio * 3.0, -3.0, 3.0).unbind(0)
    columns += torch.clamp(tyres.side * 3.0, -3.0, 3.0).unbind(0)
    columns += [*place, (run.offset + 0.5 * (run.right - run.left)) / half, run.across, run.along]
    columns += [run.off, run.wall, run.contact]
    columns += [s.steer / car.steer_max, s.throttle, s.brake]
    columns += [run.steer, run.pedal, run.steer_before, run.pedal_before]
    columns += [rpm / car.rpm_max, s.gear / 8.0, torque / car.torque]
    columns += ((packed[HEATS] - 90.0) / 60.0).unbind(0)
    columns += packed[WEARS].unbind(0)
    columns += (tyres.grip / 1.5).unbind(0)
    return [*columns, s.fuel / 100.0]


def car_columns(car: Car) -> Tensor:
    """Return the columns that describe the car, (N, 8), for races with different cars; its fields must be tensors."""
    base = car.front_axle + car.rear_axle
    columns = (
        car.mass / 1500.0,
        car.power / 500e3,
        car.torque / 600.0,
        car.front_axle / base,
        car.grip / 1.5,
        car.lift_area / 3.0,
        car.drag_area,
        car.drive_share_front,
    )
    return torch.stack(columns, dim=-1)


def course_ahead(course: Course, packed: Tensor, run: Run, points: int, curvature: bool = False) -> Tensor:
    """Return the left and right edge of the track ahead in the car's frame.

    Points are spaced evenly in time, up to six seconds at the present speed.

    Args:
        course: Track.
        packed: State (29, N).
        run: Task state.
        points: Number of points of each edge.
        curvature: Whether to add the curvature of the centre line beside the points.

    Returns:
        Coordinates (N, 4 * points) [100 m], then the curvature (N, points) [1/30 m] if it is wanted.
    """
    s = CarState(*packed.unbind(0))
    speed = torch.clamp(torch.sqrt(s.vx * s.vx + s.vy * s.vy), min=_COURSE_SPEED_MIN)
    times = torch.arange(1, points + 1, device=packed.device, dtype=packed.dtype) * (COURSE_TIME / points)
    ahead = run.s + times[:, None] * speed  # (points, N)
    node = course.node(ahead)
    x, y, tx, ty, bend, left, right, _ = course.frame(node).unbind(0)
    past = course.past(node, ahead)
    dx = x + past * tx - s.x
    dy = y + past * ty - s.y
    cos, sin = torch.cos(s.yaw), torch.sin(s.yaw)
    forward, side = dx * cos + dy * sin, dy * cos - dx * sin
    tangent_x, tangent_y = tx * cos + ty * sin, ty * cos - tx * sin
    edges = (
        forward - left * tangent_y,
        side + left * tangent_x,
        forward + right * tangent_y,
        side - right * tangent_x,
    )
    seen = torch.cat(edges) * 0.01
    return (torch.cat([seen, bend * CURVATURE_SCALE]) if curvature else seen).T


def _squeezed(distance: Tensor) -> Tensor:
    """Scale a distance [m] to about 1 at 50 m, with a higher resolution for cars that are close."""
    return torch.asinh(distance * 0.5) * 0.25


def opponents_seen(bodies: Bodies, others: Others) -> Tensor:
    """Return the four nearest other cars in the order of their gaps, (N, 32).

    Each has eight columns in the frame of the observing car: position, velocity, sine and cosine of the heading, gap
    and mask. Columns without a car are 0.

    Args:
        bodies: Cars (A, B).
        others: Their positions relative to each other.
    """
    cars = bodies.x.shape[0]
    blocks = []
    for k in range(1, cars):
        other = partner(bodies, k)
        dx, dy, dvx, dvy = other.x - bodies.x, other.y - bodies.y, other.vx - bodies.vx, other.vy - bodies.vy
        c, s = bodies.cos, bodies.sin
        blocks.append(
            torch.stack(
                [
                    _squeezed(dx * c + dy * s),
                    _squeezed(dy * c - dx * s),
                    (dvx * c + dvy * s) / 20.0,
                    (dvy * c - dvx * s) / 20.0,
                    other.sin * c - other.cos * s,
                    other.cos * c + other.sin * s,
                    others.gap[k - 1] / 100.0,
                    torch.ones_like(dx),
                ]
            )
        )
    table = torch.stack(blocks)  # (A - 1, 8, A, B)
    seen = others.gap.abs() < _SEEN
    if cars - 1 > OPPONENTS:
        nearest = others.gap.abs().argsort(0)[:OPPONENTS]
        table = table.gather(0, nearest[:, None].expand(-1, 8, -1, -1))
        seen, gap = seen.gather(0, nearest), others.gap.gather(0, nearest)
    else:
        gap = others.gap
    order = torch.where(seen, gap, torch.inf).argsort(0)
    table = table.gather(0, order[:, None].expand(-1, 8, -1, -1)) * seen.gather(0, order)[:, None]
    empty = OPPONENTS - table.shape[0]
    if empty > 0:
        table = torch.cat([table, table.new_zeros(empty, *table.shape[1:])])
    return table.reshape(8 * OPPONENTS, -1).T

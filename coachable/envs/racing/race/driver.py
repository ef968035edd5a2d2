"""`LineFollower`, a scripted driver with traction control that serves as baseline and as opponent."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from coachable.envs.racing.circuit.profile import Envelope, speed_profiles
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.physics.cars import Car
from coachable.envs.racing.physics.dynamics import AIR_DENSITY, GRAVITY, total_mass
from coachable.envs.racing.physics.state import CarState
from coachable.envs.racing.physics.tyres import tangent
from coachable.envs.racing.race.run import Field, Run, TyreView, look_around, tyre_view

_PREVIEW = (5.0, 0.4)  # [m] and [s], constant and speed-dependent part of the distance to the point of aim
_LAG = 0.1  # [s], until a steering command is carried out
_YAW_TIME = 0.3  # [s], in which the steering corrects the yaw rate
_FRONT_MAX = 0.97  # largest share of the front tyres' grip that the steering uses
_PEDAL_TIME = 0.4  # [s], in which the pedals correct the speed
_REACTION = 0.1  # [s], preview in the speed profile: one control step
_GAP_TIME = 0.35  # [s], to a car ahead in the same lane
_BRAKING = 0.75  # share of the friction that braking uses, because the rear wheels lock first
_LANE = 2.2  # [m], lateral distance below which two cars are in the same lane
_LOST_SPEED = 14.0  # [m/s], largest speed off the road or across it


class LineFollower:
    """Scripted driver that aims at a point ahead on a line, follows a speed profile, and slows down behind other cars.

    It steers for the slip angle at which the front tyres give the lateral force that the path needs. The angle is
    relative to the direction in which the front axle moves, which steers into slides. The pedals follow the
    accelerations of the profile, as far as the tyres' combined slip allows. The driver slows down if the tyres have
    less grip than the profile assumes.

    Args:
        track: Circuit, or the circuits of an environment in its order.
        car: Parameters of one car, as numbers.
        grip: Share of the tyres' grip that the profile uses.
        line: Offsets (n,) of the line from the centre line at each node of all circuits, 0 by default [m].
        lanes: Offsets from that line that successive cars of a race take, so that they do not queue up [m].

    Raises:
        ValueError: If `grip` is not in (0, 1.2].

    Example:
        >>> from coachable.envs.racing import RacingEnv
        >>> env = RacingEnv(num_envs=2, track="ring", seed=0)
        >>> driver = LineFollower(env.tracks, env.garage.typical)
        >>> observation = env.reset()["observation"]
        >>> driver(env.field, observation).shape
        torch.Size([2, 2])
    """

    def __init__(
        self,
        track: Track | Sequence[Track],
        car: Car,
        *,
        grip: float = 0.9,
        line: np.ndarray | None = None,
        lanes: tuple[float, ...] = (0.0,),
    ) -> None:
        if not 0.0 < grip <= 1.2:
            raise ValueError(f"grip is {grip}: expected a share of the tyres' grip above 0 and up to 1.2, such as 0.9")
        tracks = (track,) if isinstance(track, Track) else tuple(track)
        ends = np.cumsum([len(one.table) for one in tracks])
        offsets = np.zeros(ends[-1]) if line is None else line
        self.line = torch.as_tensor(offsets, dtype=torch.float32)
        lines = [None] * len(tracks) if line is None else np.split(offsets, ends[:-1])
        curvatures, spacings = zip(*map(line_geometry, tracks, lines), strict=True)
        envelope = Envelope(car, grip=grip, braking=_BRAKING)
        profiles = speed_profiles(envelope, curvatures, spacings)
        gains = [
            (np.roll(profile, -1) ** 2 - profile**2) / (2 * spacing) + envelope.drag(profile)
            for profile, spacing in zip(profiles, spacings, strict=True)
        ]
        self.speeds = torch.as_tensor(np.concatenate(profiles), dtype=torch.float32)
        # Acceleration that engine or brakes must provide.
        self.gains = torch.as_tensor(np.concatenate(gains), dtype=torch.float32)
        self.car, self.lanes = car, lanes
        # `_steer` inverts the force share sin(C atan(B ρ)) of `slip_curve` with ρ = tan α / tan α_p.
        self._stiffness = math.tan(math.pi / 2 / car.shape)
        self._peak = tangent(car.peak_slip_angle)

    def __call__(self, field: Field, observation: Tensor, share: Tensor | float = 1.0) -> Tensor:
        """Return actions (M, 2) for the last M cars of a field.

        Args:
            field: All cars.
            observation: Observations (M, D), of which only the number M is used.
            share: Share of `grip` that each car of the field uses, (N,) or one number.
        """
        m = len(observation)
        if self.speeds.device != observation.device:
            for name in ("speeds", "gains", "line"):
                setattr(self, name, getattr(self, name).to(observation.device))
        state, run = CarState(*field.state.unbind(0)), Run(*field.run.unbind(0))
        tyres = tyre_view(field.car, field.wheels, field.state, field.compound_grip)
        speed = torch.sqrt(state.vx**2 + state.vy**2)
        steer = self._steer(field, state, run, tyres, speed)
        pedal = self._pedal(field, state, run, tyres, speed, share)
        return torch.stack([steer, pedal], dim=-1)[len(speed) - m :]

    def _steer(self, field: Field, state: CarState, run: Run, tyres: TyreView, speed: Tensor) -> Tensor:
        """Return the steering command in [-1, 1] towards a point ahead on the line."""
        car, course = self.car, field.course
        number = torch.arange(len(speed), device=speed.device) // field.races
        lanes = torch.tensor(self.lanes, device=speed.device)[number % len(self.lanes)]
        distance = _PREVIEW[0] + _PREVIEW[1] * speed
        ahead = run.s + distance
        x, y, _ = course.place(ahead, self.line[course.node(ahead)] + lanes)
        forward_speed = state.vx.clamp(min=3.0)
        bearing = torch.atan2(y - state.y, x - state.x) - state.yaw
        bearing = torch.remainder(bearing + math.pi, 2 * math.pi) - math.pi
        off = bearing - torch.atan2(state.vy, forward_speed)  # between the way it moves and the way to the point
        curvature = 2.0 * torch.sin(off.clamp(-0.5 * math.pi, 0.5 * math.pi)) / distance
        base = car.front_axle + car.rear_axle
        turn_in = car.yaw_inertia * (speed * curvature - state.yaw_rate) / _YAW_TIME
        force = (total_mass(car, state.fuel) * speed**2 * curvature * car.rear_axle + turn_in) / base
        share = force / (tyres.grip * tyres.load)[:2].sum(0)
        share = share.clamp(-_FRONT_MAX, _FRONT_MAX)
        slip = torch.atan(self._peak / self._stiffness * torch.tan(torch.asin(share) / car.shape))
        # Which way the front axle will move, seen from the car, when the command has been carried out.
        drift = state.vy + _LAG * (state.ay - state.yaw_rate * forward_speed)
        steer = torch.atan2(drift + car.front_axle * state.yaw_rate, forward_speed) + slip
        lost = (bearing.abs() > 0.5 * math.pi) & (speed < _LOST_SPEED)
        steer = torch.where(lost, torch.sign(bearing) * car.steer_max, steer)
        return (steer / car.steer_max).clamp(-1.0, 1.0)

    def _pedal(
        self, field: Field, state: CarState, run: Run, tyres: TyreView, speed: Tensor, share: Tensor | float
    ) -> Tensor:
        """Return throttle (positive) or brake (negative) in [-1, 1]."""
        car = self.car
        node = field.course.node(run.s + _REACTION * speed)
        expected = car.grip + car.grip_per_load * 1e-3 * (tyres.load.mean(0) - car.reference_load)
        # The car of the plan may press harder on its tyres than that of the field.
        planned = GRAVITY + 0.5 * AIR_DENSITY * car.lift_area * speed**2 / total_mass(car, state.fuel)
        pressed = tyres.load.sum(0) / total_mass(field.car, state.fuel) / planned
        grip = share * (pressed * tyres.grip.mean(0) / expected).clamp(max=1.0)  # of cold, worn or hard tyres
        wanted = self.speeds[node] * torch.sqrt(grip)
        wanted = torch.where((run.off > 0.5) | (run.along < 0.7), wanted.clamp(max=_LOST_SPEED), wanted)
        if field.cars > 1:
            wanted = torch.minimum(wanted, self._behind(field, run, speed))
        force = total_mass(car, state.fuel) * (self.gains[node] * grip + (wanted - speed) / _PEDAL_TIME)
        slip = torch.sqrt((tyres.ratio / car.peak_slip_ratio) ** 2 + (tyres.side / self._peak) ** 2)
        throttle = (force * speed.clamp(min=10.0) / (car.efficiency * car.power)).clamp(0.0, 1.0)
        brake = (-force * car.wheel_radius / car.brake_torque).clamp(0.0, 1.0)
        driven = slip[2:].amax(0) if car.drive_share_front == 0.0 else slip.amax(0)
        throttle = throttle * ((1.0 - driven) / 0.3).clamp(0.0, 1.0)
        brake = brake * ((1.1 - slip[2:].amax(0)) / 0.4).clamp(0.0, 1.0) * ((1.4 - slip.amax(0)) / 0.4).clamp(0.1, 1.0)
        return throttle - brake

    @staticmethod
    def _behind(field: Field, run: Run, speed: Tensor) -> Tensor:
        """Return the speed that keeps the time gap to the next car in the same lane [m/s]."""
        split = (field.cars, field.races)
        others = look_around(
            run.s.reshape(split), run.offset.reshape(split), field.group, field.course.race_length(field.cars)
        )
        in_lane = (others.gap > 0.0) & (others.aside.abs() < _LANE)
        gap = torch.where(in_lane, others.gap, 1e4)
        theirs = torch.stack([speed.reshape(split).roll(-k, 0) for k in range(1, field.cars)])
        nearest = gap.argmin(0, keepdim=True)
        room = gap.gather(0, nearest)[0] - 5.5 - _GAP_TIME * speed.reshape(split)
        return (theirs.gather(0, nearest)[0] + 0.8 * room).clamp(min=3.0).reshape(-1)


def line_geometry(track: Track, line: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the curvature of a line beside the centre line, and the distances between its points.

    Args:
        track: Circuit.
        line: Offsets (n,) from the centre line at each node [m], or None for the centre line itself.

    Returns:
        Curvature (n,) [1/m], and the distance (n,) from each point to the next [m].
    """
    table = track.table.numpy()
    if line is None:
        return table[:, 4], np.full(len(table), track.spacing)
    points = table[:, :2] + line[:, None] * np.stack([-table[:, 3], table[:, 2]], axis=1)
    following, before = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
    a, b, c = (np.linalg.norm(v, axis=1) for v in (following - points, points - before, following - before))
    first, second = points - before, following - points
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return 2.0 * area / (a * b * c), a

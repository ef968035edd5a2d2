"""`LineFollower`: a scripted driver with traction control, as baseline and as opponent."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from coachable.envs.racing.parameters import Car
from coachable.envs.racing.profile import Envelope, speed_profile
from coachable.envs.racing.run import Run, look_around, tyre_view
from coachable.envs.racing.state import CarState
from coachable.envs.racing.track import Track

if TYPE_CHECKING:
    from coachable.envs.racing.env import RacingEnv

_PREVIEW = (5.0, 0.5)  # [m] and [s], distance at which it aims: well beyond the lag of the steering
_YAW_DAMPING = 0.04  # [s]
_SLIDE, _COUNTER_STEER = 0.05, 1.0  # [rad] of body slip that is no slide yet, and steering per radian beyond
_REACTION = 0.12  # [s], looked ahead in the speed profile
_FOLLOWING = 0.35  # [s], time gap to a car ahead in the same lane
_LANE = 2.2  # [m]


class LineFollower:
    """Aims at a point ahead on its line and keeps to a speed profile; slows down behind others.

    Args:
        track: circuit.
        car: parameters, numbers.
        grip: share of the tyres' grip that the profile uses.
        line: (n,) offset of its line from the centre line at each node [m]; default 0.
        lanes: offsets [m] from that line that successive cars of a race take, so that they do not queue up.

    Example:
        >>> from coachable.envs.racing import RacingEnv
        >>> env = RacingEnv(num_envs=2, track="ring", seed=0)
        >>> driver = LineFollower(env.track, env.garage.typical)
        >>> driver(env, env.reset()["observation"]).shape
        torch.Size([2, 2])
    """

    def __init__(
        self,
        track: Track,
        car: Car,
        *,
        grip: float = 0.9,
        line: np.ndarray | None = None,
        lanes: tuple[float, ...] = (0.0,),
    ) -> None:
        if not 0.0 < grip <= 1.2:
            raise ValueError(f"grip is {grip}: expected a share of the tyres' grip, such as 0.9")
        curvature, spacing = line_geometry(track, line)
        self.line = torch.as_tensor(np.zeros(len(track.table)) if line is None else line, dtype=torch.float32)
        profile = speed_profile(Envelope(car, grip=grip), curvature, spacing)
        self.speeds = torch.as_tensor(profile, dtype=torch.float32)
        self.base = float(car.front_axle + car.rear_axle)
        self.steer_max, self.peak = float(car.steer_max), float(car.peak_slip_ratio)
        self.lanes = lanes

    def __call__(self, env: RacingEnv, observation: Tensor) -> Tensor:
        """Actions (M, 2) for the last M cars of an env."""
        m = len(observation)
        if self.speeds.device != observation.device:
            self.speeds, self.line = self.speeds.to(observation.device), self.line.to(observation.device)
        state, run, course = CarState(*env.state.unbind(0)), Run(*env.run.unbind(0)), env.course
        rows = env.state.shape[1]
        car_number = torch.arange(rows, device=observation.device) // env.races
        lanes = torch.tensor(self.lanes, device=observation.device)[car_number % len(self.lanes)]

        speed = torch.sqrt(state.vx**2 + state.vy**2)
        distance = _PREVIEW[0] + _PREVIEW[1] * speed
        ahead = run.s + distance
        target_x, target_y, _ = course.place(ahead, self.line[course.node(ahead)] + lanes)
        dx, dy = target_x - state.x, target_y - state.y
        cos, sin = torch.cos(state.yaw), torch.sin(state.yaw)
        forward, side = dx * cos + dy * sin, dy * cos - dx * sin
        bearing = torch.atan2(side, forward)
        # Pure pursuit, damped in yaw, a little more for the tyres' slip, and a correction of slides.
        curvature = 2.0 * torch.sin(bearing) / distance
        steer = torch.atan(self.base * curvature)
        slide = torch.atan2(state.vy, state.vx.clamp(min=3.0))
        steer = steer + _YAW_DAMPING * (speed * curvature - state.yaw_rate)
        steer = 1.15 * steer + _COUNTER_STEER * (slide.abs() - _SLIDE).clamp(min=0.0) * torch.sign(slide)
        steer = torch.where(bearing.abs() > 0.5 * math.pi, torch.sign(bearing) * self.steer_max, steer)

        wanted = self.speeds[course.node(run.s + _REACTION * speed)]
        # Off the road or across it there is less grip than the profile counts on.
        wanted = torch.where((run.off > 0.5) | (run.along < 0.7), wanted.clamp(max=14.0), wanted)
        if env.cars > 1:
            wanted = torch.minimum(wanted, self._behind(env, run, speed))
        pedal = 0.35 * (wanted - speed)
        tyres = tyre_view(env.garage.car, env.simulation.wheels, env.state, env.compound[0])
        spin = tyres.ratio.amax(0) / self.peak
        lock = -tyres.ratio.amin(0) / self.peak
        # Either pedal takes lateral grip from the rear: both are eased while the car slides.
        ease = (1.0 - (slide.abs() - _SLIDE) / 0.10).clamp(0.0, 1.0)
        pedal = torch.where(speed > 8.0, pedal * ease, pedal)
        throttle = pedal.clamp(0.0, 1.0) * (1.7 - spin).clamp(0.0, 1.0)
        brake = (-pedal).clamp(0.0, 1.0) * (1.9 - lock).clamp(0.1, 1.0)
        action = torch.stack([(steer / self.steer_max).clamp(-1.0, 1.0), throttle - brake], dim=-1)
        return action[rows - m :]

    @staticmethod
    def _behind(env: RacingEnv, run: Run, speed: Tensor) -> Tensor:
        """Speed that keeps the time gap to the next car in the same lane."""
        split = (env.cars, env.races)
        others = look_around(run.s.reshape(split), run.offset.reshape(split), env.group, env.course.length)
        in_lane = (others.gap > 0.0) & (others.aside.abs() < _LANE)
        gap = torch.where(in_lane, others.gap, 1e4)
        theirs = torch.stack([speed.reshape(split).roll(-k, 0) for k in range(1, env.cars)])
        nearest = gap.argmin(0, keepdim=True)
        room = gap.gather(0, nearest)[0] - 5.5 - _FOLLOWING * speed.reshape(split)
        return (theirs.gather(0, nearest)[0] + 0.8 * room).clamp(min=3.0).reshape(-1)


def line_geometry(track: Track, line: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Curvature (n,) of a line beside the centre line, and the distances (n,) between its points [m]."""
    table = track.table.numpy()
    if line is None:
        return table[:, 4], np.full(len(table), track.spacing)
    points = table[:, :2] + line[:, None] * np.stack([-table[:, 3], table[:, 2]], axis=1)
    following, before = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
    a, b, c = (np.linalg.norm(v, axis=1) for v in (following - points, points - before, following - before))
    first, second = points - before, following - points
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return 2.0 * area / (a * b * c), a

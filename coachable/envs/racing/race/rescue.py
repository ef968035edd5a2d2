"""Functions that put stranded cars back on the track, as racing games do."""

import torch
from torch import Tensor

from coachable.envs.racing.circuit.track import Course
from coachable.envs.racing.physics.cars import Car
from coachable.envs.racing.physics.state import HEATS, ROW, WEARS
from coachable.envs.racing.race.run import Run, look_around, others_of
from coachable.envs.racing.race.scenarios import rolling_cars

RESCUE_SPEED = 15.0  # [m/s]
_CLEAR_BEHIND, _CLEAR_AHEAD = 60.0, 15.0  # [m], stretch without other cars


def way_clear(course: Course, run: Run, stranded: Tensor, group: Tensor) -> Tensor:
    """Return whether the track near each car is clear; the first of several stranded cars has priority.

    Args:
        course: Track.
        run: Task state of N = A * B cars.
        stranded: Whether each car is stranded, (N,) bool.
        group: Groups (A, B) of cars that meet.

    Returns:
        Flags (N,) bool.
    """
    cars = group.shape[0]
    if cars == 1:
        return torch.ones_like(stranded)
    others = look_around(run.s.reshape(cars, -1), run.offset.reshape(cars, -1), group, course.race_length(cars))
    near = others.met & (others.gap > -_CLEAR_BEHIND) & (others.gap < _CLEAR_AHEAD)
    index = torch.arange(cars, device=group.device)[:, None].expand_as(group)
    waiting = others_of(stranded.reshape(cars, -1)) & (others_of(index) > index)
    return ~(near & ~waiting).any(0).reshape(-1)


def back_on_track(course: Course, car: Car, packed: Tensor, run: Run) -> Tensor:
    """Return the state of cars that roll along the centre line beside their old places, with the same tyres and fuel.

    Args:
        course: Track.
        car: Parameters.
        packed: State (29, N).
        run: Task state of the N cars.

    Returns:
        The new state (29, N).
    """
    nothing = torch.zeros_like(run.s)
    state = rolling_cars(course, car, run.s, nothing, nothing, nothing + RESCUE_SPEED)
    for kept in (HEATS, WEARS, ROW["fuel"]):
        state[kept] = packed[kept]
    return state

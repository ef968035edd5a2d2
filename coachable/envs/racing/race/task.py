"""Task reward and style features of one control step (docs/domains/racing.md, Rewards)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from coachable.envs.racing.physics.contact import Bodies, body_gaps, partner
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.physics.state import WEARS, CarState
from coachable.envs.racing.race.features import DRIFT_SPEED_MIN, NEAR_DISTANCE, cornering, inward_angle, sideslip
from coachable.envs.racing.race.run import Others, Run, TyreView

BEHIND, AHEAD = 20.0, 40.0  # [m], window in which passing counts
_KMH = 3.6


@dataclass(frozen=True)
class TaskWeights:
    """Weights of the task reward: those of GT Sophy at Lago Maggiore (Wurman et al. 2022, supplement).

    Attributes:
        progress: Reward per metre along the track; there is none while the car is off course.
        off_course: Penalty per second with three wheels off the track, times the squared speed in km/h.
        wall: Penalty per second against a wall, times the squared speed in km/h.
        tyre_slip: Penalty on `Σ min(|slip ratio|, 1) |slip angle|`.
        passing: Reward per metre gained on cars nearby.
        contact: Penalty of any contact.
        rear_end: Penalty of contact with a car ahead, times the squared relative speed.
        stranded: Penalty when a car that stands, drives backwards or is outside the walls ends its episode (our
            choice). Without it, policies learn to park beside the track for good, because that costs nothing.
        steering_change: Penalty on the squared change of the steering command (our choice, after Lee et al. 2025).
            Wheels turn at a limited rate, so that commands from lock to lock and back steer as well as steady ones.
            Without the penalty, policies do not unlearn such commands, which wear the tyres.
        tyre_heat: Penalty on the mean share of grip that tyres lose by being too hot. It is charged as they heat up and
            paid back as they cool down (our choice; it is 0 except in the tyre and fuel family). Without discounting it
            would change nothing. Heat takes a minute to dissipate, however, and the time that a slide costs by then is
            beyond the horizon of the discount.
    """

    progress: float = 1.0
    off_course: float = 0.01
    wall: float = 0.01
    tyre_slip: float = 0.25
    passing: float = 0.5
    contact: float = 4.0
    rear_end: float = 0.1
    stranded: float = 100.0
    steering_change: float = 2.0
    tyre_heat: float = 0.0


class Outcome(NamedTuple):
    """Events of each car in a control step, (N,) each."""

    progress: Tensor  # [m]
    overtake: Tensor  # metres gained on cars ahead
    defend: Tensor  # metres gained or lost to cars behind
    contact: Tensor  # 0 or 1
    rear_end: Tensor  # Σ squared relative speed of contacts with cars ahead [m²/s²]


def metres_gained(before: Others, after: Others) -> tuple[Tensor, Tensor]:
    """Return the metres gained on cars ahead and on cars behind, (A, B) each.

    A car counts while it is at most 40 m ahead or 20 m behind, before or after the step. Its position before the step
    decides whether it is ahead or behind.

    Args:
        before: Positions of the other cars before the step.
        after: Positions of the other cars after the step.

    Returns:
        Metres gained on cars ahead, and on cars behind, (A, B) each [m].
    """
    gained = before.gap - after.gap

    def near(gap: Tensor) -> Tensor:
        return (gap >= -BEHIND) & (gap <= AHEAD)

    counts = after.met & (near(before.gap) | near(after.gap))
    gained = torch.where(counts, gained, 0.0)
    ahead = before.gap >= 0.0
    return torch.where(ahead, gained, 0.0).sum(0), torch.where(ahead, 0.0, gained).sum(0)


def impacts_of(impact: Tensor, cars: int) -> Tensor:
    """Return each car's contacts with the others.

    Args:
        impact: Largest squared relative speed of each pair's contacts (A // 2, A, B) [m²/s²].
        cars: Number of cars per race A.

    Returns:
        (A - 1, A, B) [m²/s²].
    """
    rows: list[Tensor] = []
    for k in range(1, cars):
        rows.append(impact[k - 1] if k <= cars // 2 else impact[cars - k - 1].roll(-k, 0))
    return torch.stack(rows)


def contacts(impact: Tensor, before: Others, cars: int) -> tuple[Tensor, Tensor]:
    """Return which cars were touched, and how hard those ahead were hit.

    Args:
        impact: Largest squared relative speed of each pair's contacts (A // 2, A, B) [m²/s²].
        before: Other cars before the step.
        cars: Number of cars per race A.

    Returns:
        Whether a car was touched (A, B), 0 or 1, and the sum of the squared relative speeds of contacts with cars ahead
        (A, B) [m²/s²].
    """
    each = impacts_of(impact, cars)
    touched = (each > 0.0).any(0).to(impact.dtype)
    return touched, torch.where(before.gap > 0.0, each, 0.0).sum(0)


def task_reward(weights: TaskWeights, state: CarState, run: Run, tyres: TyreView, outcome: Outcome) -> Tensor:
    """Return the task reward Σ weight · term of each car (N,), from states and slip after the step."""
    squared = (_KMH * _KMH) * (state.vx * state.vx + state.vy * state.vy)
    slip = (torch.clamp(tyres.ratio.abs(), max=1.0) * tyres.angle).unbind(0)
    reward = weights.progress * torch.where(run.off > 0.5, 0.0, outcome.progress)
    reward = reward - weights.off_course * state.off_time * squared
    reward = reward - weights.wall * state.wall_time * squared
    reward = reward - weights.tyre_slip * (slip[0] + slip[1] + slip[2] + slip[3])
    reward = reward - weights.steering_change * (run.steer - run.steer_before) ** 2
    reward = reward + weights.passing * (outcome.overtake + outcome.defend)
    return reward - weights.contact * outcome.contact - weights.rear_end * outcome.rear_end


def style_features(
    old: Tensor,
    new: Tensor,
    tyres: TyreView,
    outcome: Outcome,
    curvature: Tensor,
    bodies: Bodies | None,
    group: Tensor | None,
) -> Tensor:
    """Return the raw quantities of all style terms, (N, F).

    Args:
        old: State (29, N) before the step.
        new: State (29, N) after the step.
        tyres: Slip after the step.
        outcome: Events of the step.
        curvature: Curvature of the track after the step (N,) [1/m].
        bodies: Cars (A, B) after the step, if there are several in a race.
        group: Groups (A, B), if there are several cars in a race.
    """
    state = CarState(*new.unbind(0))
    moving = (state.vx * state.vx + state.vy * state.vy > DRIFT_SPEED_MIN * DRIFT_SPEED_MIN).to(new.dtype)
    ratio = torch.clamp(tyres.ratio.abs(), max=1.0)
    drift = [0.5 * (values[axle] + values[axle + 1]) * moving for values in (tyres.angle, ratio) for axle in (0, 2)]
    worn = (new[WEARS] - old[WEARS]).unbind(0)
    tire = -0.25 * (worn[0] + worn[1] + worn[2] + worn[3])
    burnt = state.fuel - CarState(*old.unbind(0)).fuel  # negative
    gaps: list[Tensor] = []
    if bodies is not None and group is not None:
        for k in range(1, group.shape[0]):
            other = partner(bodies, k)
            long, lat = body_gaps(bodies, other)
            apart = (other.x - bodies.x) ** 2 + (other.y - bodies.y) ** 2
            near = (apart <= NEAR_DISTANCE * NEAR_DISTANCE) & (group == group.roll(-k, 0))
            gaps += [long.reshape(-1), lat.reshape(-1), near.to(new.dtype).reshape(-1)]
    share = cornering(curvature, outcome.progress / CONTROL_STEP)
    corner = [share * inward_angle(sideslip(state.vx, state.vy), curvature), share]
    return torch.stack([*drift, outcome.overtake, outcome.defend, tire, burnt, *corner, *gaps], dim=-1)

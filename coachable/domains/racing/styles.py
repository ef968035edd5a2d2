"""Style spaces and rewards of drifting, saving and aggressiveness, with the paper's ranges and laws (Appendix C)."""

from collections.abc import Mapping

import torch
from torch import Tensor

from coachable.envs.racing.race.features import (
    CORNER_DRIFT,
    CORNERING,
    DEFEND,
    DRIFT,
    DRIFT_NAMES,
    FUEL,
    OVERTAKE,
    TIRE,
    gap_columns,
)
from coachable.styles import Setpoint, StyleReward, StyleSpace, Term, Weight, WeightedSum
from coachable.styles.samplers import Mixture, PointMass, Product, Sampler, Shared, Uniform

_DRIFT_BOUNDS = (-0.4, 5.0)
_TIRE_BOUNDS = (-60.0, 12000.0)
_FUEL_BOUNDS = (-3.0, 105.0)


def _three_way(neutral: float, bounds: tuple[float, float]) -> Mixture:
    """Return a mixture of 0 with probability `neutral` and of negative and positive values, equally likely."""
    low, high = bounds
    side = (1.0 - neutral) / 2
    return Mixture([PointMass(0.0), Uniform(low, 0.0), Uniform(0.0, high)], [neutral, side, side])


def drift_style_space() -> StyleSpace:
    """Return the weights of slip angle and ratio, front and rear: 0.5 δ(0) + 0.25 U(-0.4, 0) + 0.25 U(0, 5) each."""
    low, high = _DRIFT_BOUNDS
    helps = ("front tyres sideways", "rear tyres sideways", "front wheels locking or spinning", "rear wheels spinning")
    parameters = [Weight(name, low, high, help=text) for name, text in zip(DRIFT_NAMES, helps, strict=True)]
    return StyleSpace(parameters, Product([_three_way(0.5, _DRIFT_BOUNDS)] * 4), name="racing_drift")


def resource_style_space() -> StyleSpace:
    """Return the weights of overtaking, defending and saving.

    Overtake and defend are U(0, 2), tire is 0.1 δ(0) + 0.45 U(-60, 0) + 0.45 U(0, 12000), and fuel likewise with -3 and
    105.
    """
    parameters = [
        Weight("overtake", 0.0, 2.0, help="gain on cars ahead"),
        Weight("defend", 0.0, 2.0, help="keep cars behind"),
        Weight("tire", *_TIRE_BOUNDS, help="save tyres"),
        Weight("fuel", *_FUEL_BOUNDS, help="save fuel"),
    ]
    laws = [Uniform(0.0, 2.0), Uniform(0.0, 2.0), _three_way(0.1, _TIRE_BOUNDS), _three_way(0.1, _FUEL_BOUNDS)]
    return StyleSpace(parameters, Product(laws), name="racing_resources")


def aggressiveness_style_space(cars: int = 1) -> StyleSpace:
    """Return the margins to other cars: longitudinal U(0, 2) m, lateral U(0, 1) m.

    Args:
        cars: Number of cars of a race that share a style, as in the paper. If it is above 1, the agent must control
            this many cars of each race of the `RacingEnv`.
    """
    parameters = [
        Setpoint("longitudinal", 0.0, 2.0, unit="m", help="distance to keep ahead and behind"),
        Setpoint("lateral", 0.0, 1.0, unit="m", help="distance to keep beside"),
    ]
    law: Sampler = Uniform((0.0, 0.0), (2.0, 1.0))
    return StyleSpace(parameters, law if cars == 1 else Shared(law, cars), name="racing_aggressiveness")


def drift_style_reward(space: StyleSpace, *, in_corners: bool = False, angle_scale: float = 1.0) -> StyleReward:
    """Return the reward Σ w_i g_i of mean slip angles [rad] and slip ratios of the axles.

    Args:
        space: Result of `drift_style_space`.
        in_corners: Whether positive weights pay in corners only (our choice). There g_i counts in proportion to
            `cornering`, and the slip angle of the rear tyres is replaced by the `inward_angle` of the car. Negative
            weights pay everywhere. With False, spinning anywhere earns most.
        angle_scale: Factor of a positive weight of the rear slip angle.

    Raises:
        ValueError: If `in_corners` is neither true nor false, which older files write as 1 and 0.
    """
    if in_corners not in (False, True):
        raise ValueError(f"in_corners is {in_corners}: expected true or false")
    if not in_corners and angle_scale == 1.0:
        return StyleReward(space, {"drift": WeightedSum(DRIFT_NAMES, DRIFT)})

    def requested(name: str) -> Term:
        column, rear_angle = DRIFT_NAMES.index(name), name == "slip_angle_rear"

        def reward(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
            weight, slip = style[name], features[..., column]
            asked = slip
            if in_corners:
                asked = features[..., CORNER_DRIFT] if rear_angle else slip * features[..., CORNERING]
            return weight * torch.where(weight > 0.0, asked * angle_scale if rear_angle else asked, slip)

        return Term(reward, parameters=(name,))

    return StyleReward(space, {name: requested(name) for name in DRIFT_NAMES})


def resource_style_reward(space: StyleSpace, *, gained: float = 1.0, defended: float | None = None) -> StyleReward:
    """Return the reward Σ w_i g_i of metres gained on cars ahead and behind, minus mean wear, minus fuel [l].

    Args:
        space: Result of `resource_style_space`.
        gained: Factor of the metres gained.
        defended: Factor of the metres gained on cars behind; `gained` by default.
    """
    terms = {
        "overtaking": WeightedSum(("overtake",), slice(OVERTAKE, OVERTAKE + 1)),
        "defending": WeightedSum(("defend",), slice(DEFEND, DEFEND + 1)),
        "saving": WeightedSum(("tire", "fuel"), slice(TIRE, FUEL + 1)),
    }
    return StyleReward(space, terms, {"overtaking": gained, "defending": gained if defended is None else defended})


def aggressiveness_style_reward(space: StyleSpace, *, weight: float = 1.0, apart: float = 1.0) -> StyleReward:
    """Return the reward Σ over near opponents of weight · (min(0, d_lon - ξ_lon) + min(0, d_lat - ξ_lat)).

    Args:
        space: Result of `aggressiveness_style_space`.
        weight: Penalty per metre by which a gap is below its margin, in each control step; the paper has none.
        apart: Share of the penalty of a gap along one axis while the cars do not overlap along the other, such as the
            lateral gap to a car straight ahead. 1 charges both gaps of every near car, as in the paper; 0 charges a
            gap only while the cars overlap along the other axis.

    Raises:
        ValueError: If `apart` is not in [0, 1].
    """
    if not 0.0 <= apart <= 1.0:
        raise ValueError(f"apart is {apart}: expected a share between 0 and 1")

    def margins(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
        long, lat, near = gap_columns(features)
        too_long = torch.clamp(long - style["longitudinal"].unsqueeze(-1), max=0.0)
        too_lat = torch.clamp(lat - style["lateral"].unsqueeze(-1), max=0.0)
        too_long = torch.where(lat == 0.0, too_long, apart * too_long)
        too_lat = torch.where(long == 0.0, too_lat, apart * too_lat)
        return weight * (near * (too_long + too_lat)).sum(-1)

    return StyleReward(space, {"margins": Term(margins, parameters=("longitudinal", "lateral"))})

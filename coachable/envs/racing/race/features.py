"""Style features of racing, which are slip, metres gained, wear, fuel, and gaps to other cars."""

import math

import torch
from torch import Tensor

# Columns of `style_features`: four of slip, four of gains and resources, the drift in corners, how much the corner
# counts. Then three per opponent: longitudinal and lateral gap [m], near.
DRIFT_NAMES = ("slip_angle_front", "slip_angle_rear", "slip_ratio_front", "slip_ratio_rear")
DRIFT = slice(0, 4)
OVERTAKE, DEFEND, TIRE, FUEL = range(4, 8)
CORNER_DRIFT, CORNERING = 8, 9
GAPS = 10
GAP_COLUMNS = ("longitudinal", "lateral", "near")

NEAR_DISTANCE = 10.0  # [m] between centres; the paper leaves "nearby" open
DRIFT_SPEED_MIN = 5.0  # [m/s], below which slip counts as none
CORNER_RADIUS = 250.0  # [m], of the centre line, below which a car is in a corner
_FULL_CORNER = 100.0  # [m], radius below which a corner counts fully
_FULL_WAY = 10.0  # [m/s] along the track, from which on a drift counts fully


def style_features_size(cars: int) -> int:
    """Return the number of columns of `style_features` in races of `cars` cars."""
    return GAPS + len(GAP_COLUMNS) * (cars - 1)


def anyone_near(features: Tensor) -> Tensor:
    """Return whether an opponent is near, (...) bool, from style features (..., F) of races."""
    return gap_columns(features)[2].any(-1)


def gap_columns(features: Tensor) -> tuple[Tensor, ...]:
    """Return longitudinal gaps [m], lateral gaps [m] and near flags of all opponents, (..., A - 1) each."""
    return tuple(features[..., GAPS + column :: len(GAP_COLUMNS)] for column in range(len(GAP_COLUMNS)))


def sideslip(vx: Tensor, vy: Tensor) -> Tensor:
    """Return the angle from the heading of cars to their velocity, (N,) in (-π, π], positive to the left [rad].

    Args:
        vx: Forward speed (N,) [m/s].
        vy: Speed to the left (N,) [m/s].
    """
    return torch.atan2(vy, vx)


def cornering(curvature: Tensor, pace: Tensor) -> Tensor:
    """Return how far cars make way through a corner, (N,) from 0 to 1.

    It is proportional to the curvature up to that of a radius of 100 m, 0 on straights, and proportional to the speed
    along the track up to 10 m/s.

    Args:
        curvature: Curvature of the track (N,) [1/m].
        pace: Speed along the track (N,) [m/s].
    """
    bend = curvature.abs()
    counted = torch.where(bend * CORNER_RADIUS >= 1.0, (bend * _FULL_CORNER).clamp(max=1.0), 0.0)
    return counted * (pace / _FULL_WAY).clamp(0.0, 1.0)


def inward_angle(angle: Tensor, curvature: Tensor) -> Tensor:
    """Return by how much noses point further into the corner than the cars move, (N,) from 0 to π / 4 [rad].

    The angle counts fully up to 45 degrees and ever less beyond, to nothing at 90 degrees, so that spinning counts less
    than drifting.

    Args:
        angle: Sideslip (N,) [rad].
        curvature: Curvature of the track, positive to the left (N,) [1/m].
    """
    inwards = -angle * torch.sign(curvature)
    return torch.minimum(inwards, 0.5 * math.pi - inwards).clamp(min=0.0)

"""Style features of racing, which are slip, metres gained, wear, fuel, and gaps to other cars."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

# Columns of `style_features`. Then three per opponent: longitudinal and lateral gap [m], near.
DRIFT_NAMES = ("slip_angle_front", "slip_angle_rear", "slip_ratio_front", "slip_ratio_rear")
DRIFT = slice(0, 4)
OVERTAKE, DEFEND, TIRE, FUEL = range(4, 8)
GAPS = 8
GAP_COLUMNS = ("longitudinal", "lateral", "near")

NEAR_DISTANCE = 10.0  # [m] between centres; the paper leaves "nearby" open
DRIFT_SPEED_MIN = 5.0  # [m/s], below which slip counts as none


def style_features_size(cars: int) -> int:
    """Return the number of columns of `style_features` in races of `cars` cars."""
    return GAPS + len(GAP_COLUMNS) * (cars - 1)


def anyone_near(features: Tensor) -> Tensor:
    """Return whether an opponent is near, (...) bool, from style features (..., F) of races."""
    return gap_columns(features)[2].any(-1)


def anyone_beside(features: Tensor, *, within: float) -> Tensor:
    """Return whether an opponent overlaps lengthwise and is less than `within` metres away sideways, (...) bool."""
    long, lat, near = gap_columns(features)
    return ((near > 0.0) & (long == 0.0) & (lat < within)).any(-1)


def gap_columns(features: Tensor) -> tuple[Tensor, ...]:
    """Return longitudinal gaps [m], lateral gaps [m] and near flags of all opponents, (..., A - 1) each."""
    return tuple(features[..., GAPS + column :: len(GAP_COLUMNS)] for column in range(len(GAP_COLUMNS)))


def pack_style_features(drift: Sequence[Tensor], resources: Sequence[Tensor], gaps: Sequence[Tensor]) -> Tensor:
    """Stack tensors (N,) to the columns of `style_features`, (N, F)."""
    return torch.stack([*drift, *resources, *gaps], dim=-1)

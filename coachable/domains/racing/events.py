"""Rare or hard events that fill the replay tables of racing (Kompella et al. 2023)."""

import math

from tensordict import TensorDictBase
from torch import Tensor

from coachable.domains.racing.families import racing_family
from coachable.envs.racing.race.features import DRIFT_NAMES, OVERTAKE, anyone_near
from coachable.envs.racing.race.observation import own_columns
from coachable.keys import STYLE_FEATURES
from coachable.replay import PredicateEvents

SLIDE = math.radians(20.0)  # mean slip angle of the rear tyres above which a car slides
TOW = 0.3  # strength above which a slipstream counts


def racing_events(family: str = "resources") -> PredicateEvents:
    """Return the events of a family's replay tables.

    All families have "recovery" (three wheels off the track). The family "aggressiveness" also has "contact",
    "overtake" (metres gained on a car ahead) and "slipstream"; the other families have "slide" (rear slip angle above
    20 degrees), also in races.

    Args:
        family: Name of the family: "drift", "resources" or "aggressiveness".

    Raises:
        ValueError: If there is no such family.
    """
    racing_family(family)  # raises an error if there is none
    tables = {"recovery": _off_course}
    if family == "aggressiveness":
        tables |= {"contact": _contact, "overtake": _overtake, "slipstream": _slipstream}
    else:
        tables |= {"slide": _slide}
    return PredicateEvents(tables)


def _flags(steps: TensorDictBase) -> Tensor:
    """Return the flags off course, wall and contact, (N, 3)."""
    return steps["next", "observation"][..., own_columns("flags")]


def _off_course(steps: TensorDictBase) -> Tensor:
    return _flags(steps)[..., 0] > 0.5


def _contact(steps: TensorDictBase) -> Tensor:
    return _flags(steps)[..., 2] > 0.5


def _slide(steps: TensorDictBase) -> Tensor:
    return steps["next", STYLE_FEATURES][..., DRIFT_NAMES.index("slip_angle_rear")] > SLIDE


def _overtake(steps: TensorDictBase) -> Tensor:
    features = steps["next", STYLE_FEATURES]
    return (features[..., OVERTAKE] > 0.0) & anyone_near(features)


def _slipstream(steps: TensorDictBase) -> Tensor:
    return steps["next", "observation"][..., -1] > TOW

"""Families of styles of the humanoid: arm pose and step length, or also the walking speed."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from coachable.domains.humanoid.styles import gait_style_space, humanoid_style_space
from coachable.styles import StyleSpace

_SLOWEST_STEP = 2.0  # [s]; a step of 0.65 m at 0.4 m/s takes 1.6 s


class Family(NamedTuple):
    """Options of `HumanoidEnv` and the function that makes the style space of a family."""

    options: Mapping[str, Any]
    make_space: Callable[[], StyleSpace]

    @property
    def styled_speed(self) -> bool:
        """Whether the style sets the walking speed."""
        return bool(self.options.get("styled_speed"))


_FAMILIES = {
    "steps": Family({}, humanoid_style_space),
    "gait": Family({"styled_speed": True, "step_max": _SLOWEST_STEP}, gait_style_space),
}


def humanoid_family(family: str) -> Family:
    """Return a family by its name, "steps" or "gait".

    Raises:
        ValueError: If there is no such family.
    """
    if family not in _FAMILIES:
        raise ValueError(f"unknown family {family!r}: expected steps or gait")
    return _FAMILIES[family]

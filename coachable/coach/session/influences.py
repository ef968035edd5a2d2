"""What acts on the agent beside its style: live controls and disturbances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from torchrl.envs import EnvBase

from coachable.domain import Domain


class Influences:
    """Live controls of a domain with their values, and its disturbances.

    Args:
        domain: The domain.

    Attributes:
        controls: Live controls by name.
        values: Their values by name, in their units.
        disturbances: Disturbances by name.
    """

    def __init__(self, domain: Domain) -> None:
        self._domain = domain.name
        self.controls = {control.parameter.name: control for control in domain.controls}
        self.values = {name: cast(float, c.parameter.default) for name, c in self.controls.items()}
        self.disturbances = {found.strength.name: found for found in domain.disturbances}

    def fitted(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return values of controls, wrapped around or clamped to their ranges.

        Raises:
            ValueError: For an unknown control or NaN.
        """
        for name in values:
            if name not in self.controls:
                raise ValueError(f"no live control named {name!r}: {self._domain} has {list(self.controls)}")
        return {name: self.controls[name].fit(float(value)) for name, value in values.items()}

    def disturbance(self, name: str, direction: str, strength: float | None) -> dict[str, Any]:
        """Return a disturbance as a recording has it.

        Raises:
            ValueError: If there is no such disturbance, direction or strength.
        """
        if name not in self.disturbances:
            raise ValueError(f"no disturbance named {name!r}: {self._domain} has {list(self.disturbances)}")
        found = self.disturbances[name]
        strength = float(cast(float, found.strength.default) if strength is None else strength)
        found.check(direction, strength)
        return {"name": name, "direction": direction, "strength": strength}

    def steer(self, env: EnvBase) -> None:
        """Write the values of the controls into the base environment."""
        for name, value in self.values.items():
            self.controls[name].apply(env, value)

    def disturb(self, env: EnvBase, event: Mapping[str, Any]) -> None:
        """Disturb the agent in the base environment, as an event of a recording says."""
        self.disturbances[event["name"]].apply(env, event["direction"], event["strength"])

"""Live controls of a session: their values, and how they approach requested ones."""

import math
from collections.abc import Mapping
from typing import cast

from torchrl.envs import EnvBase

from coachable.domain import Control, Domain


class LiveControls:
    """Live controls of a domain with their values.

    Attributes:
        controls: Live controls by name.
        values: Their values in force by name, in their units.
        wanted: The values that they approach.
    """

    def __init__(self, domain: Domain) -> None:
        self._domain = domain.name
        self.controls = {control.parameter.name: control for control in domain.controls}
        self.values = {name: cast(float, c.parameter.default) for name, c in self.controls.items()}
        self.wanted = dict(self.values)

    def approached(self, seconds: float) -> dict[str, float]:
        """Return the values of controls that change during some time [s] on the way to those that are wanted."""
        changing = {name: wanted for name, wanted in self.wanted.items() if wanted != self.values[name]}
        return {name: _approach(self.controls[name], self.values[name], w, seconds) for name, w in changing.items()}

    def change(self, values: Mapping[str, float], settled: bool) -> None:
        """Put values in force.

        Args:
            values: Values of controls by name.
            settled: Whether they are also the wanted ones from now on.
        """
        self.values |= values
        if settled:
            self.wanted |= values

    def fitted(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return values of controls, wrapped around or clamped to their ranges.

        Raises:
            ValueError: For an unknown control or NaN.
        """
        for name in values:
            if name not in self.controls:
                raise ValueError(f"no live control named {name!r}: {self._domain} has {list(self.controls)}")
        return {name: self.controls[name].fit(float(value)) for name, value in values.items()}

    def steer(self, env: EnvBase) -> None:
        """Write the values of the controls into the base environment."""
        for name, value in self.values.items():
            self.controls[name].apply(env, value)


def _approach(control: Control, present: float, wanted: float, seconds: float) -> float:
    """Return the value of a control some time [s] later on the shorter way to another one."""
    apart = wanted - present
    if control.circular:
        apart = math.remainder(apart, control.parameter.high - control.parameter.low)
    if control.rate is None or abs(apart) <= control.rate * seconds:
        return wanted
    return control.fit(present + math.copysign(control.rate * seconds, apart))

"""`GaugeForm`, which makes a gauge from numbers, here and on the exported page."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from coachable.scene.frame import Gauge
from coachable.scene.palette import BLUE, VERMILION, Colour, css


@dataclass(frozen=True)
class GaugeForm:
    """How a gauge is made from numbers with names.

    Attributes:
        name: What it is.
        text: Its text, with places such as `{speed:.0f}` for numbers with so many digits after the point.
        shown: Name of the number that its bar shows.
        full: Number of a full bar.
        colour: Colour of its bar.
        alert: Name of a number that is 1 in an unusual state and 0 otherwise, or "" if there is none.
        alert_text: What is added to the text in that state.
        alert_colour: Colour of the bar in that state.

    Example:
        >>> form = GaugeForm("speed", "{speed:.0f} km/h", "speed", full=300.0)
        >>> form.gauge({"speed": 150.2}).text
        '150 km/h'
    """

    name: str
    text: str
    shown: str
    full: float = 1.0
    colour: Colour = BLUE
    alert: str = ""
    alert_text: str = ""
    alert_colour: Colour = VERMILION

    def gauge(self, values: Mapping[str, float]) -> Gauge:
        """Return the gauge of numbers by name."""
        unusual = bool(self.alert) and values[self.alert] > 0.5
        text = self.text.format(**values) + (self.alert_text if unusual else "")
        colour = self.alert_colour if unusual else self.colour
        return Gauge(self.name, text, values[self.shown] / self.full, colour)

    def told(self) -> dict[str, Any]:
        """Return what the page needs to make the gauge, as JSON."""
        return vars(self) | {"colour": css(self.colour), "alert_colour": css(self.alert_colour)}

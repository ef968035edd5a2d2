"""Bindings of keys and of a gamepad's axes and buttons to parameters, made from their declarations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from coachable.coach.session.session import CoachSession
from coachable.domain import Control
from coachable.ranges import around
from coachable.styles import Choice, StyleSpace

# Pairs of neighbouring keys, for less and more, and axes and pairs of buttons of the standard gamepad of browsers.
_KEYS = ("qw", "as", "zx", "er", "df", "cv", "ty", "gh", "bn", "ui", "jk", "op", "lm", "12", "34", "56", "78", "90")
_AXES = (0, 1, 2, 3)
_BUTTONS = ((4, 5), (6, 7), (14, 15), (13, 12), (0, 3), (2, 1))
_STEP = 0.1  # of the range, per key press


@dataclass(frozen=True)
class Binding:
    """Keys, axis and buttons that change one parameter.

    Attributes:
        name: Name of the parameter or live control.
        is_control: Whether it is a live control, which is steered, and not a style, which is set.
        low: Lowest value of a number, None for a choice.
        high: Highest value of a number, None for a choice.
        options: Options of a choice, in order; empty for a number.
        circular: Whether values wrap around at the ends of the range.
        keys: Keys for less and more, or for the option before and the next one; empty if there are no more keys.
        axis: Axis of the standard gamepad, of which 0 is the middle of the range; None if there are no more axes.
        buttons: Buttons of the standard gamepad, like `keys`; empty if there is an axis, or no more buttons.
    """

    name: str
    is_control: bool
    low: float | None
    high: float | None
    options: tuple[str, ...]
    circular: bool
    keys: tuple[str, ...]
    axis: int | None
    buttons: tuple[int, ...]

    def stepped(self, value: float | str, direction: int) -> float | str:
        """Return the value after a key or button.

        Args:
            value: Value in force.
            direction: -1 for the first key or button of the pair, 1 for the second one.
        """
        if self.options:
            return self.options[(self.options.index(str(value)) + direction) % len(self.options)]
        low, high = self._range()
        stepped = float(value) + direction * _STEP * (high - low)
        return around(stepped, low, high) if self.circular else min(max(stepped, low), high)

    def at(self, position: float) -> float:
        """Return the value of an axis at a position in [-1, 1]."""
        low, high = self._range()
        return low + 0.5 * (min(max(position, -1.0), 1.0) + 1.0) * (high - low)

    def press(self, session: CoachSession, direction: int) -> None:
        """Request the value after a key or button; see `stepped`."""
        self._ask(session, self.stepped((session.style | session.controls)[self.name], direction))

    def move(self, session: CoachSession, position: float) -> None:
        """Request the value of an axis; see `at`."""
        self._ask(session, self.at(position))

    def _ask(self, session: CoachSession, value: float | str) -> None:
        if self.is_control:
            session.steer(**{self.name: float(value)})
        else:
            session.set(**{self.name: value})

    def _range(self) -> tuple[float, float]:
        if self.low is None or self.high is None:
            raise ValueError(f"{self.name} is a choice and has no range: expected a number")
        return self.low, self.high


def make_bindings(space: StyleSpace, controls: Sequence[Control] = ()) -> list[Binding]:
    """Give each parameter keys, and each number an axis or else a pair of buttons, in the order of declaration.

    Live controls come first, because they are changed most often.

    Example:
        >>> from coachable.styles import Setpoint
        >>> (binding,) = make_bindings(StyleSpace([Setpoint("gap", 0.0, 2.0)]))
        >>> binding.keys, binding.axis, binding.at(0.5), binding.stepped(1.0, -1)
        (('q', 'w'), 0, 1.5, 0.8)
    """
    keys, axes, buttons = iter(_KEYS), iter(_AXES), iter(_BUTTONS)
    circular: Mapping[str, bool] = {control.parameter.name: control.circular for control in controls}
    bindings = []
    for parameter in (*(control.parameter for control in controls), *space.parameters):
        axis = None if isinstance(parameter, Choice) else next(axes, None)
        bindings.append(
            Binding(
                name=parameter.name,
                is_control=parameter.name in circular,
                low=None if isinstance(parameter, Choice) else parameter.low,
                high=None if isinstance(parameter, Choice) else parameter.high,
                options=parameter.options,
                circular=circular.get(parameter.name, False),
                keys=tuple(next(keys, "")),
                axis=axis,
                buttons=next(buttons, ()) if axis is None else (),
            )
        )
    return bindings

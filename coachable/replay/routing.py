"""Events and routes: which events fired at a step, and in which table a step is stored.

An event predicate is any object with `names`, one per event table, and `__call__(steps)`, which maps a flat tensordict
of transitions to booleans `(steps, len(names))`. A route also has `names` and returns the table of each step, integers
`(steps,)`. The domains of this library use the classes below; your own domain may define others.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from coachable.keys import EVENTS, SCENARIO, STYLE
from coachable.styles import StyleSpace, Weight


@runtime_checkable
class EventPredicate(Protocol):
    """Event predicate, which tells the events of each step."""

    names: tuple[str, ...]

    def __call__(self, steps: TensorDictBase) -> Tensor:
        """Map transitions `(steps,)` to booleans `(steps, len(names))`."""
        ...


@runtime_checkable
class Route(Protocol):
    """Route, which assigns every step to exactly one table."""

    names: tuple[str, ...]

    def __call__(self, steps: TensorDictBase) -> Tensor:
        """Map transitions `(steps,)` to table numbers `(steps,)`, each in `[0, len(names))`."""
        ...


class StyleEvents:
    """Event predicate that admits event i if it fired and the style's weight w_i is not 0 (paper, Appendix B).

    Args:
        space: Style space. Its weights, in its order, name the first event columns and their tables.
        extra: Names of further event columns, which are admitted in every style, such as kills.

    Raises:
        ValueError: If a name repeats.

    Examples:
        >>> from tensordict import TensorDict
        >>> from coachable.styles import Weight
        >>> events = StyleEvents(StyleSpace([Weight("melee", -1.0, 1.0), Weight("traps", 0.0, 1.0)]))
        >>> fired = torch.tensor([[True, True]])
        >>> steps = TensorDict({"style": torch.tensor([[1.0, 0.0]]), "next": {"events": fired}}, [1])
        >>> events(steps)
        tensor([[ True, False]])
    """

    def __init__(self, space: StyleSpace, extra: Sequence[str] = ()) -> None:
        weights = [parameter.name for parameter in space.parameters if isinstance(parameter, Weight)]
        self.names = _distinct((*weights, *extra))
        self.columns = torch.tensor([space.slices[name].start for name in weights], dtype=torch.long)

    def __call__(self, steps: TensorDictBase) -> Tensor:
        """Return booleans `(steps, len(names))`."""
        fired = _entry(steps, ("next", EVENTS))
        if fired.shape[-1] != len(self.names):
            raise ValueError(
                f"('next', 'events') has shape {tuple(fired.shape)}: expected {len(self.names)} events, one for each "
                f"of {', '.join(self.names)} (weights and extra of StyleEvents)"
            )
        weight = _entry(steps, STYLE).index_select(-1, self.columns.to(fired.device))
        admitted = fired.clone()
        admitted[..., : len(self.columns)] &= weight != 0
        return admitted


class KeyEvents:
    """Event predicate that admits all events that the environment reports, in every style.

    Args:
        names: Table of each column of `("next", "events")`.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = _distinct(names)

    def __call__(self, steps: TensorDictBase) -> Tensor:
        """Return booleans `(steps, len(names))`."""
        return _entry(steps, ("next", EVENTS))


class PredicateEvents:
    """Event predicate that consists of one function per event table.

    Args:
        predicates: Functions by table name, each of which maps transitions `(steps,)` to booleans `(steps,)`.

    Examples:
        >>> from tensordict import TensorDict
        >>> events = PredicateEvents({"fast": lambda steps: steps["next", "speed"] > 50.0})
        >>> events(TensorDict({"next": {"speed": torch.tensor([10.0, 60.0])}}, [2])).tolist()
        [[False], [True]]
    """

    def __init__(self, predicates: Mapping[str, Callable[[TensorDictBase], Tensor]]) -> None:
        self.names = _distinct(predicates)
        self.predicates = dict(predicates)

    def __call__(self, steps: TensorDictBase) -> Tensor:
        """Return booleans `(steps, len(names))`."""
        columns = {name: predicate(steps) for name, predicate in self.predicates.items()}
        for name, column in columns.items():
            if column.shape != steps.shape:
                raise ValueError(
                    f"the predicate of table {name!r} returned shape {tuple(column.shape)}: "
                    f"expected {tuple(steps.shape)}, one boolean per step"
                )
        return torch.stack(list(columns.values()), -1)


class KeyRoute:
    """Route by the number of the scenario, integers `(steps,)` or `(steps, 1)` under the key `scenario`.

    Args:
        names: Table of each scenario number.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = _distinct(names)

    def __call__(self, steps: TensorDictBase) -> Tensor:
        """Return table numbers `(steps,)`."""
        number = _entry(steps, SCENARIO)
        return number.squeeze(-1) if number.shape == (*steps.shape, 1) else number


def checked_events(predicate: EventPredicate, steps: TensorDictBase) -> Tensor:
    """Evaluate a predicate and check the result, booleans `(steps, len(names))`.

    Raises:
        ValueError: If the result is not boolean `(steps, len(names))`.
    """
    fired = predicate(steps)
    wanted = (*steps.shape, len(predicate.names))
    if not isinstance(fired, Tensor) or fired.dtype != torch.bool or tuple(fired.shape) != wanted:
        got = f"{fired.dtype} {tuple(fired.shape)}" if isinstance(fired, Tensor) else type(fired).__name__
        raise ValueError(
            f"the event predicate {type(predicate).__name__} returned {got}: expected torch.bool {wanted}, "
            f"one column for each of its tables ({', '.join(predicate.names)})"
        )
    return fired


def checked_route(route: Route, steps: TensorDictBase) -> Tensor:
    """Evaluate a route and check the result, numbers of tables `(steps,)` int.

    Raises:
        ValueError: If the result is not integer `(steps,)` or names no table.
    """
    table = route(steps)
    whole = isinstance(table, Tensor) and not table.is_floating_point() and table.dtype != torch.bool
    if not whole or table.shape != steps.shape:
        got = f"{table.dtype} {tuple(table.shape)}" if isinstance(table, Tensor) else type(table).__name__
        raise ValueError(f"the route {type(route).__name__} returned {got}: expected integers {tuple(steps.shape)}")
    low, high = (int(bound) for bound in table.aminmax()) if table.numel() else (0, 0)
    if low < 0 or high >= len(route.names):
        raise ValueError(
            f"the route {type(route).__name__} returned table numbers from {low} to {high}: expected 0 to "
            f"{len(route.names) - 1}, for the tables {', '.join(route.names)}"
        )
    return table


def _entry(steps: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry of steps `(steps,)`.

    Raises:
        ValueError: If the steps do not have it.
    """
    value = steps.get(key, None)
    if value is None:
        raise ValueError(
            f"the steps have no {key!r}, from which their tables follow: expected an environment that emits it and a "
            "training loop that stores it (the Trainer's replay_keys)"
        )
    return value


def _distinct(names: Sequence[str] | Mapping[str, object]) -> tuple[str, ...]:
    names = tuple(names)
    if len(set(names)) != len(names):
        raise ValueError(f"table names repeat: {', '.join(names)}")
    return names

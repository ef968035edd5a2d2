"""Checks of the arguments of an `EventTableBuffer`, before any memory is allocated."""

from collections.abc import Mapping, Sequence

import numpy as np

from coachable.ranges import COUNT, Range
from coachable.replay.regions import Regions
from coachable.replay.routing import EventPredicate, Route


def make_regions(capacities: Mapping[str, int], route: Route | None, events: EventPredicate | None) -> Regions:
    """Return the regions of the tables: routed tables, then event tables.

    Args:
        capacities: Records of each table, by name.
        route: Route to the tables that every step enters; None for the single table "default".
        events: Predicate of the event tables; None for none.

    Raises:
        ValueError: If names are missing, unknown or given twice, or a capacity is not positive.
    """
    routed = tuple(route.names) if route is not None else ("default",)
    fed = tuple(events.names) if events is not None else ()
    both = sorted(set(routed) & set(fed))
    if both:
        raise ValueError(f"tables {both} are both routed to and event tables: give one of the two other names")
    missing = [name for name in (*routed, *fed) if name not in capacities]
    stray = [name for name in capacities if name not in (*routed, *fed)]
    if missing or stray:
        raise ValueError(
            f"table_capacities lacks {missing} and has no use for {stray}: expected exactly the routed tables "
            f"{list(routed)} (route=) and the event tables {list(fed)} (events=)"
        )
    return Regions({name: capacities[name] for name in (*routed, *fed)})


def checked_horizon(
    regions: Regions, routed: int, events: EventPredicate | None, horizon: int | None, num_envs: int | None
) -> int:
    """Check H_max against the tables, and return it, or 1 without event tables.

    Args:
        regions: The tables.
        routed: Number of routed tables, which come first.
        events: Predicate of the event tables; None for none.
        horizon: H_max, the longest window before an event [env-steps].
        num_envs: Number of environments that fill the buffer.

    Raises:
        ValueError: If it is missing, not positive, or larger than a table, or there are no event tables.
    """
    Range("[1, inf)", whole=True, optional=True).check("num_envs", num_envs)
    if events is None:
        if horizon is not None:
            raise ValueError(
                f"event_horizon is {horizon} but there are no event tables: give events= as well, or neither"
            )
        return 1
    COUNT.check("event_horizon", horizon)
    assert horizon is not None
    for name, capacity in zip(regions.names[routed:], regions.capacities[routed:].tolist(), strict=True):
        if horizon > capacity:
            raise ValueError(
                f"event_horizon is {horizon}, larger than table_capacities[{name!r}] = {capacity}: a table must hold "
                "at least one window"
            )
    needed = horizon * (num_envs or 1)
    for name, capacity in zip(regions.names[:routed], regions.capacities[:routed].tolist(), strict=True):
        if needed > capacity:
            raise ValueError(
                f"table_capacities[{name!r}] is {capacity}, less than event_horizon * num_envs = {needed}: windows are "
                "copied out of this table, so it must hold the last steps of every environment"
            )
    return horizon


def checked_proportions(names: Sequence[str], routed: int, given: Mapping[str, float] | None) -> np.ndarray:
    """Return the shares of the tables in a batch.

    Args:
        names: Names of the tables, the routed ones first.
        routed: Number of routed tables.
        given: Shares by name; by default 0.5 for the routed tables and 0.5 for the event tables, each split equally.

    Returns:
        Shares `(tables,)`.

    Raises:
        ValueError: If names differ, a share is negative, or they do not sum to 1.
    """
    if given is None:
        fed = len(names) - routed
        base = 0.5 if fed else 1.0
        return np.array([base / routed] * routed + [0.5 / max(fed, 1)] * fed)
    if set(given) != set(names):
        raise ValueError(f"table_proportions names {sorted(given)}: expected exactly the tables {sorted(names)}")
    shares = np.array([float(given[name]) for name in names])
    if not np.isfinite(shares).all() or (shares < 0).any() or abs(shares.sum() - 1.0) > 1e-6:
        raise ValueError(
            f"table_proportions are {dict(given)}, with sum {shares.sum():.6g}: expected shares >= 0 that sum to 1"
        )
    return shares

"""Distributions of training styles for any space of weights: combat's, its ablations, and one for requests."""

from collections.abc import Sequence
from typing import Literal, get_args

from coachable.ranges import SHARE
from coachable.styles.parameters import Setpoint, Weight
from coachable.styles.samplers import ContinuousOneHot, Mixture, OneHot, PointMass, Product, Sampler, Shared, Uniform
from coachable.styles.space import StyleSpace

Single = Literal["continuous_one_hot", "one_hot", "independent"]


def own(space: StyleSpace) -> Sampler:
    """Return the space's own sampler."""
    return space.sampler


def single_weight(space: StyleSpace, name: str) -> Sampler:
    """Return the styles in which one weight is uniform between 0 and its upper bound and the others are 0.

    Raises:
        ValueError: If a parameter is not a weight, or there is none of this name.
    """
    if others := _others(space, (Weight,)):
        raise ValueError(f"{name} alone leaves {', '.join(others)} at 0, which it cannot be: expected weights only")
    if name not in space.names:
        raise ValueError(f"there is no weight {name!r}: expected one of {', '.join(space.names)}")
    high = [bound if other == name else 0.0 for other, bound in zip(space.names, space.high.tolist(), strict=True)]
    return Uniform([0.0] * space.dim, high)


def style_mixture(
    space: StyleSpace, single: Single = "continuous_one_hot", *, neutral: float = 0.03, independent: float = 0.10
) -> Sampler:
    """Return a mixture of no style, all weights at once, and one weight alone (paper, Appendix C, Style Parameters).

    Args:
        space: Style space of weights. With set-points or choices, which have no neutral value, `single` must be
            "independent", and everything is drawn independently.
        single: Distribution of one weight alone: "continuous_one_hot" over its range, "one_hot" at its upper bound, or
            "independent", which draws all weights independently instead (the ablations of Appendix D).
        neutral: Probability that every weight is 0.
        independent: Probability that every weight is drawn, independently.

    Raises:
        ValueError: If `single` is unknown, or a parameter is not a weight.
    """
    if single not in get_args(Single):
        raise ValueError(f"single is {single!r}: expected one of {', '.join(get_args(Single))}")
    if single == "independent" and _others(space, (Weight,)):
        return StyleSpace(space.parameters).sampler
    _require((Weight,), space, f"sampler {single} leaves all weights but one at 0, which {{}} cannot be (not a weight)")
    low, high = space.low.tolist(), space.high.tolist()
    rest = _rest(neutral=neutral, independent=independent)
    every = Uniform(low, high)
    one = {"continuous_one_hot": ContinuousOneHot(low, high), "one_hot": OneHot(high), "independent": every}[single]
    return Mixture([PointMass([0.0] * space.dim), every, one], [neutral, independent, rest])


def with_requests(space: StyleSpace, *, positive: float = 0.25, full: float = 0.15, neutral: float = 0.1) -> Sampler:
    """Return the space's own sampler mixed with styles that people request but that it rarely draws.

    If each of four weights is positive in a quarter of the episodes, all four are positive in one of 256 episodes. A
    network that has to extrapolate to such a request fails.

    Args:
        space: Style space of weights.
        positive: Probability that every weight is drawn uniformly from 0 to its upper bound.
        full: Probability that every weight is at its upper bound.
        neutral: Probability that every weight is 0.

    Raises:
        ValueError: If a parameter is not a weight, or the sum of the probabilities exceeds 1.
    """
    _require((Weight,), space, "sampler with_requests asks for weights of 0, which {} cannot be (not a weight)")
    high, zero = space.high.tolist(), [0.0] * space.dim
    parts = [PointMass(zero), PointMass(high), Uniform(zero, high), space.sampler]
    return Mixture(parts, [neutral, full, positive, _rest(neutral=neutral, full=full, positive=positive)])


def with_extremes(
    space: StyleSpace, *, share: float = 0.5, shared: bool = True, only: str | Sequence[str] | None = None
) -> Sampler:
    """Return the space's own sampler mixed with styles in which every parameter is at one of its bounds.

    Styles differ most between bounds, so that networks learn the differences sooner.

    Args:
        space: Style space of weights and set-points.
        share: Probability that every parameter is at its lower or its upper bound, each equally likely.
        only: Name or names of the parameters that are at a bound in that share; the others are then at their
            default. By default all.
        shared: Whether rows that share a style in the space's own sampler (`Shared`), such as the cars of a race, still
            share it. Otherwise each row has its own style, so that agents meet others of other styles.

    Raises:
        ValueError: If a parameter is a choice or unknown, or the share is not in [0, 1].
    """
    SHARE.check("share", share)
    _require((Weight, Setpoint), space, "sampler with_extremes asks for bounds, which {} cannot have (a choice)")
    chosen = space.names if only is None else (only,) if isinstance(only, str) else tuple(only)
    if unknown := sorted(set(chosen) - set(space.names)):
        raise ValueError(f"extremes of {', '.join(unknown)} asked for: expected some of {', '.join(space.names)}")
    bounds = zip(space.names, space.low.tolist(), space.high.tolist(), space.default.tolist(), strict=True)
    extremes = Product(
        [
            Mixture([PointMass(low), PointMass(high)], [0.5, 0.5]) if name in chosen else PointMass(default)
            for name, low, high, default in bounds
        ]
    )
    own = space.sampler
    if not isinstance(own, Shared):
        return Mixture([extremes, own], [share, 1.0 - share])
    mixed = Mixture([extremes, own.sampler], [share, 1.0 - share])
    return Shared(mixed, own.copies) if shared else mixed


def _rest(**probabilities: float) -> float:
    """Return 1 minus the sum of the probabilities."""
    for name, value in probabilities.items():
        SHARE.check(name, value)
    rest = 1.0 - sum(probabilities.values())
    if rest < -1e-9:
        given = ", ".join(f"{name} {value}" for name, value in probabilities.items())
        raise ValueError(f"{given} exceed 1 together: expected probabilities that sum to 1 at most")
    return max(rest, 0.0)


def _others(space: StyleSpace, kinds: tuple[type, ...]) -> list[str]:
    """Return the names of the parameters that are of none of these kinds."""
    return [p.name for p in space.parameters if not isinstance(p, kinds)]


def _require(kinds: tuple[type, ...], space: StyleSpace, why: str) -> None:
    """Raise a `ValueError` if there are parameters of other kinds, whose names replace "{}" in `why`."""
    if others := _others(space, kinds):
        named = f"{', '.join(others)} of the style space {space.name!r}"
        raise ValueError(f"{why.format(named)}: expected sampler=default or sampler=independent")

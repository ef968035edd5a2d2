"""`StyleReward`, which computes the style part of the reward from features and a style."""

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from coachable.styles.space import StyleSpace
from coachable.styles.terms import StyleTerm


class StyleReward(nn.Module):
    """Sum of scaled style terms, `sum_k scale_k * term_k(features, theta)` (paper: `sum_i w_i g_i(s, a; xi_i)`).

    The same code runs in the environment transform and in relabelling, so that both give the same bits.

    Args:
        space: Style space. Every parameter must be read by a term.
        terms: Terms by name. Each has the attribute `parameters`, the names that it reads; wrap plain functions and
            modules in `Term`.
        scales: Fixed factors by name of the term; 1 for the other terms.

    Raises:
        ValueError: If a term declares no parameters or unknown ones, a parameter is read by no term, or a scale
            belongs to no term.

    Examples:
        >>> import torch
        >>> from coachable.styles import Weight, WeightedFeature
        >>> space = StyleSpace([Weight("fuel", -3, 105)])
        >>> reward = StyleReward(space, {"fuel": WeightedFeature("fuel", 0)}, {"fuel": -1.0})
        >>> reward(torch.tensor([[0.5]]), torch.tensor([[10.0]]))
        tensor([[-5.]])
    """

    def __init__(
        self, space: StyleSpace, terms: Mapping[str, StyleTerm], scales: Mapping[str, float] | None = None
    ) -> None:
        super().__init__()
        self.space = space
        _check_terms(space, terms, scales or {})
        self.terms = dict(terms)
        self.scales = {name: float((scales or {}).get(name, 1.0)) for name in terms}
        # Registered, so that `.to(device)` reaches the weights of a module used as a term.
        functions = {name: getattr(term, "function", None) for name, term in terms.items()}
        self.modules_of_terms = nn.ModuleDict({n: f for n, f in functions.items() if isinstance(f, nn.Module)})

    @property
    def is_linear(self) -> bool:
        """Whether the reward is known to be linear in the features, so that features of several steps may be summed."""
        return all(getattr(term, "is_linear", False) for term in self.terms.values())

    def forward(self, features: Tensor, theta: Tensor) -> Tensor:
        """Return the style part of the reward.

        Args:
            features: Features `(..., F)`, which may broadcast against theta.
            theta: Style `(..., dim)`, not encoded.

        Returns:
            `(..., 1)`, in theta's dtype (float32).

        Raises:
            ValueError: If a term does not return one number per style.
        """
        total: Tensor | None = None
        for name, value in self.terms_of(features, theta).items():
            if self.scales[name] != 1.0:
                value = self.scales[name] * value
            total = value if total is None else total + value
        assert total is not None  # a space has parameters, and each has a term
        return total.to(theta.dtype).unsqueeze(-1)

    def terms_of(self, features: Tensor, theta: Tensor) -> dict[str, Tensor]:
        """Return each term of the reward before it is scaled.

        Args:
            features: Features `(..., F)`, which may broadcast against theta.
            theta: Style `(..., dim)`, not encoded.

        Returns:
            Terms `(...,)` by name.

        Raises:
            ValueError: If a term does not return one number per style.
        """
        style = self.space.view(theta)
        return {name: self._checked(name, term(features, style), theta) for name, term in self.terms.items()}

    @staticmethod
    def _checked(name: str, value: Tensor, theta: Tensor) -> Tensor:
        if value.shape != theta.shape[:-1]:
            raise ValueError(
                f"style term {name!r} returned shape {tuple(value.shape)} for a style of shape {tuple(theta.shape)}: "
                f"expected {tuple(theta.shape[:-1])}, one number per style. Features must broadcast against the style."
            )
        return value


def _check_terms(space: StyleSpace, terms: Mapping[str, Any], scales: Mapping[str, float]) -> None:
    problems = []
    read: set[str] = set()
    for name, term in terms.items():
        parameters = getattr(term, "parameters", None)
        # A bare nn.Module arrives here with its method `parameters`, hence the check for a tuple.
        if not callable(term) or not isinstance(parameters, tuple) or not parameters:
            problems.append(f"term {name!r} declares no parameters: wrap it as Term(function, parameters=(...,))")
            continue
        unknown = [p for p in parameters if p not in space]
        if unknown:
            problems.append(f"term {name!r} reads {unknown}, which the space lacks")
        elif hasattr(term, "mismatch") and (mismatch := term.mismatch(space)):
            problems.append(f"term {name!r} {mismatch}")
        read.update(parameters)
    unread = [p for p in space.names if p not in read]
    if unread:
        problems.append(f"no term reads the parameters {unread}: add one that does, or remove them from the space")
    stray = [name for name in scales if name not in terms]
    if stray:
        problems.append(f"scales are given for {stray}, expected some of the terms {list(terms)}")
    problems += [
        f"the scale of {name!r} is {scale}: expected a finite number"
        for name, scale in scales.items()
        if not _is_finite(scale)
    ]
    if problems:
        label = f" {space.name!r}" if space.name else ""
        raise ValueError(f"StyleReward does not fit the space{label} {list(space.names)}: " + "; ".join(problems) + ".")


def _is_finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except (TypeError, ValueError):
        return False

"""Attribution of a policy's actions to groups of its inputs, by saliency and SHAP."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from coachable.domain import Domain
from coachable.extras import from_extra
from coachable.signals import Signal
from coachable.styles import StyleSpace
from coachable.training.rng import preserved_rng, seed_everything

METHODS = ("SHAP", "saliency")
_SHAP_DRAWS = 8  # baselines per state
_CHUNK = 256  # states per pass


@dataclass(frozen=True)
class Group:
    """Inputs that are ranked together.

    Attributes:
        name: Name of the group, such as "joint_angles" or "style: pose".
        columns: Columns of the network's input, `cat(observation, encode(theta))`.
        is_style: Whether the group is a style parameter rather than a part of the observation.
    """

    name: str
    columns: slice
    is_style: bool


@dataclass(frozen=True)
class Ranking:
    """Importance of each group by one method.

    Attributes:
        method: The method, "SHAP" or "saliency".
        groups: The groups, the most important first.
        means: Mean importance over trajectories (G,).
        deviations: Standard deviation over trajectories (G,).
    """

    method: str
    groups: tuple[Group, ...]
    means: np.ndarray
    deviations: np.ndarray

    def rows(self) -> list[dict[str, Any]]:
        """Return one table row per group."""
        rows = []
        for rank, group in enumerate(self.groups, start=1):
            row = {"method": self.method, "rank": rank, "group": group.name}
            row["kind"] = "style" if group.is_style else "observation"
            rows.append(row | {"mean": float(self.means[rank - 1]), "std": float(self.deviations[rank - 1])})
        return rows


def input_groups(domain: Domain, space: StyleSpace, observation_dim: int) -> list[Group]:
    """List the domain's observation groups, or every entry as a group of its own, followed by the style parameters.

    Raises:
        ValueError: If the widths of the groups do not add up to that of the observation.
    """
    named = list(domain.observation_groups) or [Signal(f"observation {i}", 1) for i in range(observation_dim)]
    covered = sum(signal.width for signal in named)
    if covered != observation_dim:
        raise ValueError(
            f"observation_groups of domain {domain.name!r} cover {covered} entries, the policy observes "
            f"{observation_dim}: correct them where the Domain is declared"
        )
    groups, first = [], 0
    for signal in named:
        groups.append(Group(signal.name, slice(first, first + signal.width), is_style=False))
        first += signal.width
    for name, columns in space.slices.items():
        groups.append(Group(f"style: {name}", slice(first + columns.start, first + columns.stop), is_style=True))
    return groups


def rank_groups(
    outputs: Callable[[Tensor], Tensor],
    trajectories: Sequence[Tensor],
    groups: Sequence[Group],
    *,
    seed: int = 0,
    progress: bool = True,
) -> list[Ranking]:
    """Rank the groups by their importance for the outputs, by SHAP and by saliency.

    Saliency (Simonyan et al. 2014) is the mean of `|d output / d input|` over a group's entries and over the outputs:
    how much a small change of an input changes the action. SHAP (Lundberg and Lee 2017) is estimated by expected
    gradients with the recorded states as baselines: a group's contribution is the sum over its entries of how far they
    move an output from its mean, as an absolute value, averaged over the outputs. Both are first averaged along each
    trajectory; the paper does not say how it pools entries and outputs.

    Args:
        outputs: Differentiable function from inputs (B, D) to outputs (B, outputs).
        trajectories: Recorded inputs (S, D) of each trajectory.
        groups: Groups of the D columns.
        seed: Seed of the baselines.
        progress: Whether to show a progress bar.

    Returns:
        One ranking per method, in the order of `METHODS`.
    """
    with from_extra("explain"):
        from captum import attr
    states = torch.cat(list(trajectories))
    with torch.no_grad():
        count = outputs(states[:1]).shape[-1]
    saliency, shap = attr.Saliency(outputs), attr.GradientShap(outputs)
    totals = {method: np.zeros((len(states), len(groups))) for method in METHODS}
    jobs = [(target, first) for target in range(count) for first in range(0, len(states), _CHUNK)]
    with preserved_rng():
        seed_everything(seed)  # captum draws from the global generators
        for target, first in tqdm(jobs, desc="attributing", disable=None if progress else True, leave=False):
            rows = slice(first, first + _CHUNK)
            gradients = saliency.attribute(states[rows].clone().requires_grad_(), target=target, abs=True)
            totals["saliency"][rows] += _per_group(gradients, groups, Tensor.mean)
            contributions = shap.attribute(
                states[rows].clone(), baselines=states, n_samples=_SHAP_DRAWS, stdevs=0.0, target=target
            )
            totals["SHAP"][rows] += np.abs(_per_group(contributions, groups, Tensor.sum))
    ends = np.cumsum([len(trajectory) for trajectory in trajectories])[:-1]
    rankings = []
    for method, total in totals.items():
        means = np.array([part.mean(0) for part in np.split(total / count, ends)])  # (trajectories, groups)
        order = np.argsort(-means.mean(0), kind="stable")
        ranked = tuple(groups[i] for i in order)
        rankings.append(Ranking(method, ranked, means.mean(0)[order], means.std(0)[order]))
    return rankings


def _per_group(values: Tensor, groups: Sequence[Group], pool: Callable[..., Tensor]) -> np.ndarray:
    values = values.detach()
    return torch.stack([pool(values[:, group.columns], dim=-1) for group in groups], -1).double().numpy()

"""What the training, evaluation and coaching code needs to know of a domain, in one declaration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from itertools import product
from typing import Any, Protocol

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from coachable.styles import StyleReward, StyleSpace

_GROUP = "coachable.domains"  # entry points: name = "package.module:DOMAIN"


class StyleMeasures(Protocol):
    """Measured style: what the agent did, in the units of what was requested."""

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Quantities of one env step.

        Args:
            transition: output of `env.step`, batch shape (N,), with `style` and `next`.

        Returns:
            Name to (N,) tensors.
        """
        ...

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """Quantities of whole episodes, or of any stretch of them.

        Args:
            record: name to (T, N), the outputs of `step`.
            alive: (T, N) bool, steps that count.

        Returns:
            Name to (N,); NaN where an episode gives no value.
        """
        ...

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """(T, N) bool: in this step the agent did what its style asks for."""
        ...


class Renderer(Protocol):
    """Draws one env of a batch."""

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """(height, width, 3) uint8."""
        ...

    def close(self) -> None:
        """Release the graphics context."""
        ...


@dataclass(frozen=True)
class Domain:
    """One domain.

    Attributes:
        name: as the user types it.
        make_env: `(num_envs, seed, num_threads) -> EnvBase`, without style transforms.
        make_space: the style space that its pretrained weights were trained on.
        make_reward: `(space, **scales) -> StyleReward`.
        measures: measured style.
        make_renderer: `(width, height) -> Renderer`.
        make_scene: `(server, session) -> coachable.coach.page.views.View`, which draws the live page in 3-D; None
            shows the renderer's pictures.
        grid: values of each style parameter, whose combinations make up the evaluation grid; or its styles one by one,
            by parameter name, where the combinations are too many.
        control_step: duration of one env step [s].
        episode_steps: length of a full episode.
        columns: metrics of the published table, in order, with the format of their values.
        observation_groups: name and width of each block of the observation, in order, for explanations; without it
            every entry is a group of its own.
        as_trained: this domain as the settings of a training made it (`env` of its configuration: which machines,
            which cars); None where trainings do not differ.
        coached: options of `make_env` for an agent that a person watches, where it then meets others than when it is
            measured.
        evaluation: what `coachable evaluate` does instead of running the grid and switched styles: `(domain, policy,
            folder, settings) -> report`, with the loaded policy and `coachable.evaluation.settings`.
    """

    name: str
    make_env: Callable[..., EnvBase]
    make_space: Callable[[], StyleSpace]
    make_reward: Callable[..., StyleReward]
    measures: StyleMeasures
    make_renderer: Callable[..., Renderer]
    grid: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]]
    control_step: float
    episode_steps: int
    columns: Mapping[str, str] = field(default_factory=dict)
    observation_groups: Sequence[tuple[str, int]] = ()
    as_trained: Callable[[Mapping[str, Any]], Domain] | None = None
    coached: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Callable[..., str] | None = None
    make_scene: Callable[..., Any] | None = None

    def cells(self) -> list[dict[str, Any]]:
        """The styles of the evaluation grid, by parameter name."""
        if isinstance(self.grid, Mapping):
            return [dict(zip(self.grid, values, strict=True)) for values in product(*self.grid.values())]
        return [dict(cell) for cell in self.grid]


def domain_names() -> list[str]:
    """List the domains that installed packages register, this one among them."""
    return sorted({entry.name for entry in entry_points(group=_GROUP)})


def load_domain(name: str, config: Mapping[str, Any] | None = None) -> Domain:
    """Return the declaration of a registered domain.

    A package registers a domain by an entry point of the group `coachable.domains`, which names its `Domain`:
    `[project.entry-points."coachable.domains"]` in pyproject.toml, `pendulum = "my_package.domain:DOMAIN"` below it.

    Args:
        name: of the domain.
        config: of a training; the domain is as it was there.

    Raises:
        ValueError: if no installed package registers such a domain; lists those that exist.
        TypeError: if a package registers something that is not a `Domain`.
    """
    for entry in entry_points(group=_GROUP, name=name):
        domain = entry.load()
        if not isinstance(domain, Domain):
            raise TypeError(f"the entry point {name} = {entry.value!r} is a {type(domain).__name__}: expected a Domain")
        return domain if config is None or domain.as_trained is None else domain.as_trained(config.get("env", {}))
    names = domain_names()
    expected = f"expected one of {names}" if names else "no package registers any; install this one anew with pip"
    raise ValueError(f"unknown domain {name!r}: {expected}")

"""What the training, evaluation and coaching code needs to know of a domain, in one declaration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from inspect import signature
from itertools import product
from typing import Any, Protocol

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

from coachable.defaults import EnvPictures, RewardMeasures, steps_per_episode, style_grid, time_per_step
from coachable.styles import Setpoint, StyleReward, StyleSpace
from coachable.transforms import CoachableEnv, coachable_env

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
class Control:
    """Something that is steered while the agent acts and is no style: the policy sees it in its observation.

    Attributes:
        parameter: name, range, unit and neutral value.
        apply: writes a value into the base environment.
        circular: values beyond one end go on at the other, such as angles.
    """

    parameter: Setpoint
    apply: Callable[[EnvBase, float], None]
    circular: bool = False

    def fit(self, value: float) -> float:
        """Return the value brought into the control's range.

        Raises:
            ValueError: if it is no finite number.
        """
        low, high = self.parameter.low, self.parameter.high
        if not math.isfinite(value):
            raise ValueError(f"{self.parameter.name} = {value}: expected a number in [{low:g}, {high:g}].")
        if self.circular and not low <= value <= high:
            return low + (value - low) % (high - low)
        return min(max(value, low), high)


@dataclass(frozen=True)
class Words:
    """How people speak of a domain, beyond the names and help texts of its styles.

    Attributes:
        vocabulary: phrases by meaning; see `coachable.coach.phrases.grammar.StyleGrammar`.
        presets: named styles.
        examples: phrases that the phrase box suggests.
        terminated: what a terminated episode means, in the past tense: "the agent fell".
    """

    vocabulary: Mapping[str, Sequence[str]] = field(default_factory=dict)
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    examples: Sequence[str] = ()
    terminated: str = "ended"


class _WorkedOut:
    """Default of a field of `Domain` that is worked out from other fields when it is first read."""

    def __init__(self, work_out: Callable[[Domain], Any]) -> None:
        self._work_out = work_out

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, domain: Domain | None, owner: type) -> Any:
        if domain is None:
            return self  # the dataclass takes it for the field's default
        if vars(domain)[self._name] is self:
            vars(domain)[self._name] = self._work_out(domain)
        return vars(domain)[self._name]

    def __set__(self, domain: Domain, value: Any) -> None:
        vars(domain)[self._name] = value


_MEASURES: Any = _WorkedOut(lambda domain: RewardMeasures(domain.make_reward(domain.make_space())))
_GRID: Any = _WorkedOut(lambda domain: style_grid(domain.make_space()))
_CONTROL_STEP: Any = _WorkedOut(lambda domain: time_per_step(domain.make_env))
_EPISODE_STEPS: Any = _WorkedOut(lambda domain: steps_per_episode(domain.make_env))


@dataclass(frozen=True, repr=False, eq=False)
class Domain:
    """One domain: an environment, what can be coached in it, and how that is rewarded. All else has a default.

    Attributes:
        name: as the user types it.
        make_env: `(num_envs, ...) -> EnvBase`, without style transforms; it may also take `seed` and `num_threads`.
        make_space: `() -> StyleSpace`, the styles that its agents are trained on.
        make_reward: `(space) -> StyleReward`; a recipe may pass further settings.
        measures: measured style; default `RewardMeasures`: what the terms of the reward read and pay.
        make_renderer: `(width, height) -> Renderer`; default `EnvPictures`: what the environment draws itself.
        make_scene: `(server, session) -> coachable.coach.page.views.View`, which draws the live page in 3-D; None
            shows the renderer's pictures.
        grid: values of each style parameter, whose combinations make up the evaluation grid; or its styles one by one,
            by parameter name. Default: a few values over each parameter's evaluation range.
        control_step: duration of one env step [s]; default: as the environment tells it, or 1.
        episode_steps: length of a full episode; default: as the environment tells it, or 1000.
        columns: metrics of the published table, in order, with the format of their values; default: all.
        units: of measured quantities, by name, for the axes of figures.
        observation_groups: name and width of each block of the observation, in order, for explanations; without it
            every entry is a group of its own.
        controls: what can be steered while the agent acts and is no style.
        words: how people speak of it.
        as_trained: this domain as the settings of a training made it (`env` of its configuration: which machines,
            which cars); None where trainings do not differ.
        coached: options of `make_env` for an agent that a person watches, where it then meets others than when it is
            measured.
        evaluation: what `coachable evaluate` does instead of running the grid and switched styles: `(domain, policy,
            folder, settings) -> report`, with the loaded policy and `coachable.evaluation.evaluation_settings`.
    """

    name: str
    make_env: Callable[..., EnvBase]
    make_space: Callable[[], StyleSpace]
    make_reward: Callable[..., StyleReward]
    measures: StyleMeasures = _MEASURES
    make_renderer: Callable[..., Renderer] = EnvPictures
    grid: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]] = _GRID
    control_step: float = _CONTROL_STEP
    episode_steps: int = _EPISODE_STEPS
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    observation_groups: Sequence[tuple[str, int]] = ()
    controls: Sequence[Control] = ()
    words: Words = field(default_factory=Words)
    as_trained: Callable[[Mapping[str, Any]], Domain] | None = None
    coached: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Callable[..., str] | None = None
    make_scene: Callable[..., Any] | None = None

    def styled_env(
        self,
        space: StyleSpace,
        num_envs: int,
        seed: int | None = None,
        *,
        transforms: Sequence[Transform] = (),
        num_threads: int | None = None,
        reward: StyleReward | None = None,
        **options: Any,
    ) -> CoachableEnv:
        """Make an environment with styles.

        Args:
            space: the agent's styles.
            num_envs: N.
            seed: of the initial states and of the styles that are drawn.
            transforms: further ones, such as `EpisodeSums`.
            num_threads: physics threads, where `make_env` takes them.
            reward: style reward; default: the domain's own.
            **options: further arguments of `make_env`.
        """
        if _takes(self.make_env, "num_threads"):
            options["num_threads"] = num_threads
        simulation = self.make_env(num_envs=num_envs, **options)
        reward = self.make_reward(space) if reward is None else reward
        return coachable_env(simulation, space, reward, *transforms, seed=seed)

    def cells(self) -> list[dict[str, Any]]:
        """The styles of the evaluation grid, by parameter name."""
        if isinstance(self.grid, Mapping):
            return [dict(zip(self.grid, values, strict=True)) for values in product(*self.grid.values())]
        return [dict(cell) for cell in self.grid]


def _takes(function: Any, argument: str) -> bool:
    """Whether a function accepts a keyword argument; of a class, whether its constructor does."""
    while isinstance(function, partial) or hasattr(function, "__wrapped__"):
        function = function.func if isinstance(function, partial) else function.__wrapped__
    # A class of TorchRL seems to take anything, because its metaclass does.
    parameters = signature(function.__init__ if isinstance(function, type) else function).parameters
    return argument in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())


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
        ValueError: if no installed package registers such a domain, or more than one does; lists the domains that
            exist, or names the packages.
        TypeError: if a package registers something that is not a `Domain`.
    """
    entries = list(entry_points(group=_GROUP, name=name))
    if not entries:
        names = domain_names()
        expected = f"expected one of {names}" if names else "no package registers any; install this one anew with pip"
        raise ValueError(f"unknown domain {name!r}: {expected}")
    if len(entries) > 1:
        packages = " and ".join(sorted(entry.dist.name if entry.dist else entry.value for entry in entries))
        raise ValueError(f"the packages {packages} register a domain {name!r} each: uninstall or rename all but one")
    domain = entries[0].load()
    if not isinstance(domain, Domain):
        value = entries[0].value
        raise TypeError(f"the entry point {name} = {value!r} is a {type(domain).__name__}: expected a Domain")
    return domain if config is None or domain.as_trained is None else domain.as_trained(config.get("env", {}))

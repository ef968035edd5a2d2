"""`Domain`: the declaration of a domain for training, evaluation and coaching."""

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

from coachable.defaults import EnvPictures, RewardMeasures, WorkedOut, steps_per_episode, style_grid, time_per_step
from coachable.ranges import around
from coachable.scene.frame import Stage
from coachable.signals import Signal
from coachable.styles import Setpoint, StyleReward, StyleSpace
from coachable.transforms import CoachableEnv, coachable_env

_GROUP = "coachable.domains"  # entry points: name = "package.module:DOMAIN"


class StepMeasures(Protocol):
    """What is measured in each env step."""

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Measure one env step.

        Args:
            transition: Output of `env.step`, batch shape (N,), with `style` and `next`.

        Returns:
            Measured values (N,) by name.
        """
        ...


class StyleMeasures(StepMeasures, Protocol):
    """Measured style of an agent, in the units of the request."""

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """Summarise whole episodes, or parts of them.

        Args:
            record: Outputs of `step` (T, N), by name.
            alive: Steps that count (T, N) bool.

        Returns:
            Summarised values (N,) by name; NaN where an episode has no value.
        """
        ...

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the steps (T, N) bool in which the agent complied with its style."""
        ...


class Renderer(Protocol):
    """Renderer of one env of a batch."""

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Draw a picture (height, width, 3) uint8 of one row of the batch."""
        ...

    def close(self) -> None:
        """Release the graphics context."""
        ...


@dataclass(frozen=True)
class Control:
    """Live control: a value that is steered while the agent acts and that the policy reads in its observation.

    Attributes:
        parameter: Name, range, unit and neutral value.
        apply: Function that writes a value into the base environment.
        circular: Whether values wrap around at the ends of the range, as angles do.
        rate: Largest change per second while a new value is approached, in the parameter's unit; None for at once.
    """

    parameter: Setpoint
    apply: Callable[[EnvBase, float], None]
    circular: bool = False
    rate: float | None = None

    def fit(self, value: float) -> float:
        """Wrap a value around or clamp it to the control's range.

        Raises:
            ValueError: If the value is not finite.
        """
        low, high = self.parameter.low, self.parameter.high
        if not math.isfinite(value):
            raise ValueError(f"{self.parameter.name} = {value}: expected a number in [{low:g}, {high:g}].")
        return around(value, low, high) if self.circular else min(max(value, low), high)


@dataclass(frozen=True)
class EnvOption:
    """Option of an environment that `coachable coach`, `evaluate` and `export web` offer, as `--NAME VALUE`.

    Attributes:
        name: Name of the argument of `make_env`, and of the option.
        read: Function that makes the argument from the text on the command line. It raises a `ValueError` or an
            `OSError` whose message says what is wrong with the text.
        help: What the option is, for people.
    """

    name: str
    read: Callable[[str], Any]
    help: str


@dataclass(frozen=True)
class Push:
    """Push that a coach may give the agent.

    Attributes:
        apply: Function of the base environment and the strength forward and to the left, in the agent's direction.
        largest: Largest strength.
        unit: Unit of the strength.
    """

    apply: Callable[[EnvBase, float, float], None]
    largest: float
    unit: str

    def fit(self, forward: float, left: float) -> tuple[float, float]:
        """Scale a push, by its strength forward and to the left, down to the largest strength.

        Raises:
            ValueError: If a component is not finite.
        """
        strength = math.hypot(forward, left)
        if not math.isfinite(strength):
            raise ValueError(f"a push of {forward} forward and {left} left: expected numbers in {self.unit}")
        scale = min(1.0, self.largest / strength) if strength else 1.0
        return forward * scale, left * scale


@dataclass(frozen=True)
class Recorded:
    """What the exported page plays if the domain's simulation does not run in a browser.

    Attributes:
        grid: Styles of the recordings, as in `Domain.grid`; None for the domain's grid.
        seconds: Length of a recording, which an episode's end may cut short [s].
        alike: Function from a number of episodes to options of `make_env` with which that many episodes begin alike, so
            that styles can be compared; by default they begin differently.
        columns: Measures that the page shows, with the format of their values; None for the domain's `columns`.
        opens: Number of the style that the page shows at first; by default the last one, which asks for most.
        title: Title of the page; "" for one from the domain's name.
        summary: One sentence for the visitor.
    """

    grid: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]] | None = None
    seconds: float = 30.0
    alike: Callable[[int], Mapping[str, Any]] | None = None
    columns: Mapping[str, str] | None = None
    opens: int = -1
    title: str = ""
    summary: str = "Ask for a style, and see what the agent does and what is measured."


@dataclass(frozen=True)
class Words:
    """Words for a domain, in addition to the names and help texts of its styles.

    Attributes:
        vocabulary: Phrases by meaning; see `coachable.coach.phrases.grammar.StyleGrammar`.
        presets: Named styles.
        examples: Phrases that the phrase box suggests.
        names: What parameters and measures are called on pages, if not by their own names without underscores.
        terminated: Verb for a terminated episode in the past tense, such as "fell" in "the agent fell".
    """

    vocabulary: Mapping[str, Sequence[str]] = field(default_factory=dict)
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    examples: Sequence[str] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    terminated: str = "ended"

    def name(self, name: str) -> str:
        """Return what a parameter or a measure is called on pages."""
        return self.names.get(name, name.replace("_", " "))


_MEASURES: Any = WorkedOut(lambda domain: RewardMeasures(domain.make_reward(domain.make_space())))
_GRID: Any = WorkedOut(lambda domain: style_grid(domain.make_space()))
_CONTROL_STEP: Any = WorkedOut(lambda domain: time_per_step(domain.make_env))
_EPISODE_STEPS: Any = WorkedOut(lambda domain: steps_per_episode(domain.make_env))


@dataclass(frozen=True, repr=False, eq=False)
class Domain:
    """Declaration of a domain: its environment, styles and style reward; all other fields have defaults.

    Attributes:
        name: Name on the command line.
        make_env: `(num_envs, ...) -> EnvBase`, without style transforms; it may also take `num_threads`.
        make_space: `() -> StyleSpace`, the styles on which its agents are trained.
        make_reward: `(space) -> StyleReward`; a recipe may pass further settings.
        measures: Measured style; by default `RewardMeasures`, from the terms of the style reward.
        make_renderer: `(width, height) -> Renderer`; by default `EnvPictures`, the environment's own pictures.
        make_stage: `() -> coachable.scene.frame.Stage`, the scene that the page shows in 3-D; None shows the renderer's
            pictures.
        make_web: `(space, ...) -> coachable.export.web.part.PagePart`, for a page on which the agent acts in the
            browser; it takes the `env_options`, too. None if the simulation cannot run there: pages play recordings.
        recorded: What such a page plays.
        grid: Values of each style parameter, of which the evaluation grid has all combinations, or a list of styles by
            parameter name. By default a few values over each parameter's evaluation range.
        control_step: Duration of one env step [s]; by default from the environment's attributes, or 1.
        episode_steps: Length of a full episode; by default from the environment's attributes, or 1000.
        trials: Options of `make_env` by label, such as disturbances, under which `coachable evaluate` counts the
            episodes in the default style that survive.
        targets: Largest acceptable median of a metric over the styles, by the metric's name.
        columns: Metrics of the published table, in order, with the format of their values; by default all.
        units: Units of measured quantities by name, for the axes of figures and the page of `coachable coach`.
        beside: Style parameter to which a measure belongs, by the measure's name; needed where that name does not
            contain the parameter's.
        observation_groups: Blocks of the observation, in order, for explanations and exported models; by default every
            entry is explained on its own.
        action_groups: Blocks of the action, in order, for exported models.
        controls: Live controls, which are steered while the agent acts.
        push: Push that a coach may give the agent; None if the environment has none.
        window: Time over which a session measures the style [s].
        words: Words for the domain, for phrases and presets.
        as_trained: Function from `env` of a training's configuration to this domain with these settings (such as the
            machines or cars); None if trainings do not differ.
        env_options: Options of `make_env` on the command line.
        coached: Options of `make_env` for coaching and films, if they differ from those of evaluations.
        evaluation: Function that replaces the grid and the switching test of `coachable evaluate`: `(domain, policy,
            folder, settings) -> report`, with the loaded policy and `coachable.evaluation.evaluation_settings`.

    Raises:
        TypeError: If `make_env`, `make_space` or `make_reward` is no function.
        ValueError: If `control_step` or `episode_steps` is not positive.
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
    trials: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    targets: Mapping[str, float] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[str, str] = field(default_factory=dict)
    observation_groups: Sequence[Signal] = ()
    action_groups: Sequence[Signal] = ()
    controls: Sequence[Control] = ()
    push: Push | None = None
    window: float = 2.0
    words: Words = field(default_factory=Words)
    as_trained: Callable[[Mapping[str, Any]], Domain] | None = None
    env_options: Sequence[EnvOption] = ()
    coached: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Callable[..., str] | None = None
    make_stage: Callable[[], Stage] | None = None
    make_web: Callable[..., Any] | None = None
    recorded: Recorded = field(default_factory=Recorded)

    def __post_init__(self) -> None:
        given = vars(self)
        for name in ("make_env", "make_space", "make_reward"):
            if not callable(given[name]):
                raise TypeError(f"{name} of the domain {self.name!r} is {given[name]!r}: expected a function")
        step, steps = given["control_step"], given["episode_steps"]
        if not isinstance(step, WorkedOut) and not 0.0 < step < math.inf:
            raise ValueError(f"control_step of the domain {self.name!r} is {step}: expected seconds, above 0")
        if not isinstance(steps, WorkedOut) and not (steps >= 1 and steps == int(steps)):
            raise ValueError(f"episode_steps of the domain {self.name!r} is {steps}: expected a whole number from 1")

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
            space: The agent's style space.
            num_envs: Number of environments N.
            seed: Seed of the initial states and of drawn styles.
            transforms: Further transforms, such as `EpisodeSums`.
            num_threads: Number of physics threads, if `make_env` takes it.
            reward: Style reward; by default the domain's own.
            **options: Further arguments of `make_env`.
        """
        if accepts(self.make_env, "num_threads"):
            options["num_threads"] = num_threads
        simulation = self.make_env(num_envs=num_envs, **options)
        reward = self.make_reward(space) if reward is None else reward
        return coachable_env(simulation, space, reward, *transforms, seed=seed)

    def read_options(self, texts: Mapping[str, str]) -> dict[str, Any]:
        """Return arguments of `make_env` from texts, by the names of `env_options`.

        Raises:
            ValueError: If there is no such option, or a text does not describe a value.
        """
        known = {option.name: option for option in self.env_options}
        for name in texts:
            if name not in known:
                offered = " or ".join(f"--{option.name} ({option.help})" for option in self.env_options)
                raise ValueError(f"{self.name} has no option --{name}: expected {offered or 'no options of its own'}")
        return {name: known[name].read(text) for name, text in texts.items()}

    def with_options(self, options: Mapping[str, Any]) -> Domain:
        """Return this domain with arguments of `make_env` and `make_web`, such as those from `read_options`."""
        make_web = self.make_web and partial(self.make_web, **options)
        return self.with_fields(make_env=partial(self.make_env, **options), make_web=make_web)

    def with_fields(self, **values: Any) -> Domain:
        """Return this domain with other values of some fields.

        Other than with `dataclasses.replace`, defaults that are computed from other fields are computed when they are
        first read, and from the new values.
        """
        return Domain(**(vars(self) | values))

    def cells(self) -> list[dict[str, Any]]:
        """Return the styles of the evaluation grid, by parameter name."""
        return _cells(self.grid)

    def recorded_cells(self) -> list[dict[str, Any]]:
        """Return the styles that the exported page plays, by parameter name."""
        return _cells(self.grid if self.recorded.grid is None else self.recorded.grid)


def _cells(grid: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    if isinstance(grid, Mapping):
        return [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    return [dict(cell) for cell in grid]


def accepts(function: Any, argument: str) -> bool:
    """Return whether a function, or the constructor of a class, accepts a keyword argument."""
    while isinstance(function, partial) or hasattr(function, "__wrapped__"):
        function = function.func if isinstance(function, partial) else function.__wrapped__
    # The metaclass of TorchRL's classes takes any argument, so look at the constructor.
    parameters = signature(function.__init__ if isinstance(function, type) else function).parameters
    return argument in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def domain_names() -> list[str]:
    """List the domains that installed packages register, including this one."""
    return sorted({entry.name for entry in entry_points(group=_GROUP)})


def load_domain(name: str, config: Mapping[str, Any] | None = None) -> Domain:
    """Return the declaration of a registered domain.

    A package registers a domain by an entry point of the group `coachable.domains`, which names its `Domain`:
    `[project.entry-points."coachable.domains"]` in pyproject.toml, `pendulum = "my_package.domain:DOMAIN"` below it.

    Args:
        name: Name of the domain.
        config: Configuration of a training whose settings the domain gets, see `Domain.as_trained`.

    Raises:
        ValueError: If no installed package registers such a domain, or more than one does.
        TypeError: If a package registers something that is not a `Domain`.
    """
    entries = list(entry_points(group=_GROUP, name=name))
    if not entries:
        names = domain_names()
        expected = (
            f"expected one of {names}" if names else "no package registers a domain: reinstall coachable with pip"
        )
        raise ValueError(f"unknown domain {name!r}: {expected}")
    if len(entries) > 1:
        packages = " and ".join(sorted(entry.dist.name if entry.dist else entry.value for entry in entries))
        raise ValueError(f"the packages {packages} register a domain {name!r} each: uninstall or rename all but one")
    domain = entries[0].load()
    if not isinstance(domain, Domain):
        value = entries[0].value
        raise TypeError(f"the entry point {name} = {value!r} is a {type(domain).__name__}: expected a Domain")
    return domain if config is None or domain.as_trained is None else domain.as_trained(config.get("env", {}))

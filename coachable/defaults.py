"""Defaults of a `Domain` that declares only an environment, a style space and a style reward."""

import math
from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np
import torch
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, SerialEnv, StepCounter, TransformedEnv

from coachable.gl import RenderingError
from coachable.keys import STYLE, STYLE_FEATURES
from coachable.offscreen import OffscreenMujoco
from coachable.styles import (
    Choice,
    ChoiceTolerance,
    SetpointTolerance,
    StyleReward,
    StyleSpace,
    WeightedFeature,
    WeightedSum,
    feature,
)

_SLACK = 0.05  # of a set-point's range: a measured value this close to the request complies
_MET = 0.9  # least tolerance with which a choice counts as met
_GRID = (5, 3)  # values of a numeric parameter in the grid, of a single one and of several
_LARGEST_GRID = 36  # cells; beyond it parameters are varied one at a time
_EPISODE_STEPS = 1000


class WorkedOut:
    """Default of a field of `Domain` that is computed from other fields when it is first read.

    Args:
        work_out: Function from the domain to the value.
    """

    def __init__(self, work_out: Callable[[Any], Any]) -> None:
        self._work_out = work_out

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, domain: Any, owner: type) -> Any:
        if domain is None:
            return self  # the dataclass uses it as the field's default
        if vars(domain)[self._name] is self:
            vars(domain)[self._name] = self._work_out(domain)
        return vars(domain)[self._name]

    def __set__(self, domain: Any, value: Any) -> None:
        vars(domain)[self._name] = value


class RewardMeasures:
    """Measured style from the terms of the style reward.

    - `SetpointTolerance`: the feature that it compares with the request, under the set-point's name, and the distance
      from the request as `<name>_error`. Steps in which its gate is 0 have no value. If several features are compared
      with it, each has the name of its term instead.
    - `WeightedFeature`, `WeightedSum`: the feature that the weight scales, under the weight's name, unless it scales
      several features.
    - Any other term: its reward per step before scaling, as `<term>_reward`.

    The agent complies in a step if every such set-point differs from the request by at most 5 % of its range and every
    `ChoiceTolerance` is at least 0.9. If the reward has neither term, no step can be judged.

    Args:
        reward: The domain's style reward.
    """

    needs = "a set-point or choice that the style reward compares with a feature"
    """What is needed to judge whether the agent complies."""

    def __init__(self, reward: StyleReward) -> None:
        self._reward = reward
        self._sources: dict[str, set[str]] = {}
        """Features that are compared with a set-point or scaled by a weight, by the parameter's name."""
        for term in reward.terms.values():
            if isinstance(term, SetpointTolerance | WeightedFeature | WeightedSum):
                for position, parameter in enumerate(term.parameters):
                    source = f"{term.key} {position} {getattr(term, 'gate', None)}"
                    self._sources.setdefault(parameter, set()).add(source)

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Return the measures (N,) of a step by name; see `StyleMeasures.step`."""
        theta, features = transition.get(STYLE), transition.get(("next", STYLE_FEATURES))
        style, paid = self._reward.space.view(theta), self._reward.terms_of(features, theta)
        found: dict[str, Tensor] = {}
        for name, term in self._reward.terms.items():
            if isinstance(term, SetpointTolerance):
                target, label = style[term.parameter], self._label(name, term)
                value = feature(features, term.key)
                if term.gate is not None:
                    value = torch.where(feature(features, term.gate) != 0, value, torch.nan)
                found |= {label: value, f"{label}_error": (value - target).abs()}
            elif isinstance(term, WeightedFeature | WeightedSum):
                scaled = feature(features, term.key)
                columns = (scaled,) if isinstance(term, WeightedFeature) else scaled.unbind(-1)
                pairs = zip(term.parameters, columns, strict=True)
                found |= {parameter: column for parameter, column in pairs if len(self._sources[parameter]) == 1}
            else:
                found[f"{name}_reward"] = paid[name]
        return found

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """Return means (N,) over the steps that count, by name; see `StyleMeasures.summarise`."""
        return {name: torch.where(alive, values, torch.nan).nanmean(0) for name, values in record.items()}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return whether the agent complies in each step, (T, N) bool; see `StyleMeasures.complies`."""
        kept = [
            record[name] <= limit if is_error else record[name] >= limit for name, limit, is_error in self._limits()
        ]
        return torch.stack([*kept, self.judged(record)]).all(0)

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the steps (T, N) bool in which every value that is compared with a request exists."""
        values = [~record[name].isnan() for name, _, _ in self._limits()]
        return torch.stack(values).all(0) if values else torch.zeros_like(next(iter(record.values())), dtype=torch.bool)

    def _label(self, name: str, term: SetpointTolerance) -> str:
        return term.parameter if len(self._sources[term.parameter]) == 1 else name

    def _limits(self) -> list[tuple[str, float, bool]]:
        """Return names of measures, their limits, and whether the limit is the largest complying value or the least."""
        limits: list[tuple[str, float, bool]] = []
        for name, term in self._reward.terms.items():
            if isinstance(term, SetpointTolerance):
                parameter = self._reward.space[term.parameter]
                slack = _SLACK * (parameter.high - parameter.low)
                limits.append((f"{self._label(name, term)}_error", slack, True))
            elif isinstance(term, ChoiceTolerance):
                limits.append((f"{name}_reward", _MET, False))
        return limits


class EnvPictures:
    """Renderer that uses the environment's own pictures: `render()` of Gymnasium, or the camera of a dm_control task.

    Args:
        width: Width of a picture [px].
        height: Height of a picture [px].
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        self.size = (width, height)
        self._model: Any = None
        self._mujoco: OffscreenMujoco | None = None

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Draw a picture (height, width, 3) uint8 of one row of a batch.

        Raises:
            RenderingError: If the environment draws no pictures; the message says what to declare instead.
        """
        simulation, _ = simulation_of(env, row)
        if hasattr(simulation, "physics"):  # dm_control
            return self._draw_mujoco(simulation.physics.model.ptr, simulation.physics.data.ptr)
        name = type(getattr(simulation, "unwrapped", simulation)).__name__
        if getattr(simulation, "render_mode", None) != "rgb_array":
            raise RenderingError(
                f"{name} draws no pictures: make it with render_mode='rgb_array' where it is a "
                "Gymnasium environment, or give the Domain a make_renderer"
            )
        try:
            picture = simulation.render()
        except Exception as error:  # environments of other libraries may raise anything
            raise RenderingError(f"{name} draws no pictures: {str(error) or type(error).__name__}") from error
        return self._fitted(picture)

    def _draw_mujoco(self, model: Any, data: Any) -> np.ndarray:
        if self._mujoco is None or self._model is not model:  # an environment may make a new model for each episode
            self.close()
            buffer = model.vis.global_  # limits the size of pictures
            width, height = min(self.size[0], buffer.offwidth), min(self.size[1], buffer.offheight)
            self._model, self._mujoco = model, OffscreenMujoco(model, width, height)
        return self._fitted(self._mujoco.draw(data))

    def _fitted(self, picture: Any) -> np.ndarray:
        return np.asarray(Image.fromarray(np.asarray(picture, dtype=np.uint8)).resize(self.size))

    def close(self) -> None:
        """Release MuJoCo's OpenGL context, if there is one."""
        if self._mujoco is not None:
            self._mujoco.close()
            self._mujoco = None


def simulation_of(env: EnvBase, row: int = 0) -> tuple[Any, int]:
    """Return the simulation of one row without TorchRL's transforms and wrappers, and how often it is stepped.

    Returns:
        The innermost environment that can be reached in this process, and its number of steps per step of `env`.
    """
    inner: Any = env
    repeats = 1
    while True:
        if isinstance(inner, TransformedEnv):
            inner = inner.base_env
        elif isinstance(inner, SerialEnv):
            inner.start() if inner.is_closed else None
            inner, row = inner._envs[row], 0
        elif isinstance(vars(inner).get("envs"), list):  # copies of a Gymnasium environment
            inner, row = inner.envs[row], 0
        elif "_env" in vars(inner) and isinstance(inner, EnvBase):  # TorchRL's wrapper of another library
            repeats *= max(1, int(getattr(inner, "frame_skip", 1) or 1))
            inner = inner._env
        else:
            return inner, repeats


def time_per_step(make_env: Callable[..., EnvBase]) -> float:
    """Return the duration of one step of an environment [s], or 1 if its attributes do not contain it."""
    env = make_env(num_envs=1)
    simulation, repeats = simulation_of(env)
    steps_per_second = (getattr(simulation, "metadata", None) or {}).get("render_fps") or 1.0
    innermost = getattr(simulation, "unwrapped", simulation)
    if hasattr(simulation, "control_timestep"):  # dm_control
        found = simulation.control_timestep()
    else:  # `dt` is Gymnasium's, of classic control and MuJoCo
        found = getattr(innermost, "control_step", None) or getattr(innermost, "dt", None) or 1.0 / steps_per_second
    env.close()
    return float(found) * repeats


def steps_per_episode(make_env: Callable[..., EnvBase]) -> int:
    """Return the length of a full episode of an environment, or 1000 steps if its attributes do not contain it."""
    env = make_env(num_envs=1)
    simulation, repeats = simulation_of(env)
    limits = (
        getattr(getattr(simulation, "spec", None), "max_episode_steps", None),  # Gymnasium, if it is registered
        _time_limit(simulation),
        getattr(simulation, "_step_limit", None),  # dm_control
        getattr(simulation, "episode_steps", None),
        _step_count(env, repeats),
    )
    env.close()
    found = next((limit for limit in limits if limit is not None and np.isfinite(limit)), _EPISODE_STEPS * repeats)
    return max(1, int(found) // repeats)


def _time_limit(simulation: Any) -> int | None:
    """Return the limit of Gymnasium's wrapper `TimeLimit`, or None if there is no such wrapper."""
    while simulation is not None and "_max_episode_steps" not in vars(simulation):
        simulation = vars(simulation).get("env")
    return None if simulation is None else simulation._max_episode_steps


def _step_count(env: EnvBase, repeats: int) -> int | None:
    """Return the limit of TorchRL's `StepCounter` in steps of the simulation, or None if there is no such transform."""
    while isinstance(env, TransformedEnv):
        for transform in env.transform if isinstance(env.transform, Compose) else [env.transform]:
            if isinstance(transform, StepCounter) and transform.max_steps is not None:
                return transform.max_steps * repeats
        env = env.base_env
    return None


def style_grid(space: StyleSpace) -> list[dict[str, Any]]:
    """Return the styles to evaluate: every option, and a few values over each parameter's evaluation range.

    These are all combinations if there are at most 36. Otherwise one parameter is varied at a time, with the others at
    their defaults.
    """
    numeric = [p for p in space.parameters if not isinstance(p, Choice)]
    count = _GRID[0] if len(numeric) == 1 else _GRID[1]
    values = {
        p.name: p.options if isinstance(p, Choice) else _spread(*p.evaluation_range, count) for p in space.parameters
    }
    if np.prod([len(options) for options in values.values()]) <= _LARGEST_GRID:
        return [dict(zip(values, cell, strict=True)) for cell in product(*values.values())]
    default = {p.name: p.default for p in space.parameters}  # as declared; theta is rounded to float32
    others = ((name, v) for name, options in values.items() for v in options if not _alike(v, default[name]))
    return [default, *({**default, name: v} for name, v in others)]


def _alike(value: Any, other: Any) -> bool:
    if isinstance(value, str):
        return value == other
    return math.isclose(value, other, rel_tol=1e-5)  # `_spread` rounds to six digits


def _spread(low: float, high: float, count: int) -> list[float]:
    """Return evenly spaced values of at most six digits."""
    return [min(max(float(f"{value:.6g}"), low), high) for value in np.linspace(low, high, count)]

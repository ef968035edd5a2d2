"""What a domain gets that declares only an environment, a style space and a style reward."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any, cast

import numpy as np
import torch
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv

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
    scalar_feature,
)

__all__ = ["EnvPictures", "RewardMeasures", "simulation_of", "steps_per_episode", "style_grid", "time_per_step"]

_SLACK = 0.05  # of a set-point's range: a measured value this close to the request complies
_MET = 0.9  # a choice's tolerance from which on it counts as met
_GRID = (5, 3)  # values of a numeric parameter in the grid, of a single one and of several
_LARGEST_GRID = 36  # cells; beyond it parameters are varied one at a time
_EPISODE_STEPS = 1000


class RewardMeasures:
    """Measured style by the terms of the style reward.

    - `SetpointTolerance`: the feature that it compares with the request, under the set-point's name, and the distance
      from the request as `<name>_error`. Steps in which its gate is 0 have no value.
    - `WeightedFeature`, `WeightedSum`: the feature that the weight scales, under the weight's name.
    - Any other term: what it pays per step before its scale, as `<term>_reward`.

    The agent complies in steps in which every such set-point is within 5 % of its range of the request and every
    `ChoiceTolerance` pays at least 0.9. A reward without either gives nothing to judge.

    Args:
        reward: of the domain.
    """

    needs = "a set-point or choice that the style reward compares with a feature"
    """What it takes to tell whether the agent complies."""

    def __init__(self, reward: StyleReward) -> None:
        self._reward = reward

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """See `StyleMeasures.step`."""
        theta, features = transition.get(STYLE), transition.get(("next", STYLE_FEATURES))
        style, paid = self._reward.space.view(theta), self._reward.terms_of(features, theta)
        found: dict[str, Tensor] = {}
        for name, term in self._reward.terms.items():
            if isinstance(term, SetpointTolerance):
                target = style[term.parameter]
                value = scalar_feature(features, term.key, target)
                if term.gate is not None:
                    value = torch.where(scalar_feature(features, term.gate, target) != 0, value, torch.nan)
                found |= {term.parameter: value, f"{term.parameter}_error": (value - target).abs()}
            elif isinstance(term, WeightedFeature):
                found[term.parameter] = scalar_feature(features, term.key, style[term.parameter])
            elif isinstance(term, WeightedSum):
                values = cast(Tensor, features) if term.key is None else feature(features, term.key)
                found |= dict(zip(term.parameters, values.unbind(-1), strict=True))
            else:
                found[f"{name}_reward"] = paid[name]
        return found

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """See `StyleMeasures.summarise`: means over the steps that count."""
        return {name: torch.where(alive, values, torch.nan).nanmean(0) for name, values in record.items()}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """See `StyleMeasures.complies`."""
        kept = [
            record[name] <= limit if is_error else record[name] >= limit for name, limit, is_error in self._limits()
        ]
        return torch.stack([*kept, self.judged(record)]).all(0)

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """(T, N) bool: every value that is compared with a request exists."""
        values = [~record[name].isnan() for name, _, _ in self._limits()]
        return torch.stack(values).all(0) if values else torch.zeros_like(next(iter(record.values())), dtype=torch.bool)

    def _limits(self) -> list[tuple[str, float, bool]]:
        """Name of a measure, its limit, and whether that is the largest value that complies or else the smallest."""
        limits: list[tuple[str, float, bool]] = []
        for name, term in self._reward.terms.items():
            if isinstance(term, SetpointTolerance):
                parameter = self._reward.space[term.parameter]
                slack = term.half_width + _SLACK * (parameter.high - parameter.low)
                limits.append((f"{term.parameter}_error", slack, True))
            elif isinstance(term, ChoiceTolerance):
                limits.append((f"{name}_reward", _MET, False))
        return limits


class EnvPictures:
    """Pictures that the environment draws itself: `render()` of Gymnasium, or the camera of a dm_control task.

    Args:
        width: of a picture [px].
        height: of a picture [px].
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        self.size = (width, height)
        self._model: Any = None
        self._mujoco: OffscreenMujoco | None = None

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of one row.

        Raises:
            RenderingError: if the environment draws no pictures; says what to declare instead.
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
        except Exception as error:  # whatever the environment needs for it
            raise RenderingError(f"{name} draws no pictures: {error}") from error
        return self._fitted(picture)

    def _draw_mujoco(self, model: Any, data: Any) -> np.ndarray:
        if self._mujoco is None or self._model is not model:  # an environment may make another one for each episode
            self.close()
            buffer = model.vis.global_  # the largest picture that MuJoCo draws
            width, height = min(self.size[0], buffer.offwidth), min(self.size[1], buffer.offheight)
            self._model, self._mujoco = model, OffscreenMujoco(model, width, height)
        return self._fitted(self._mujoco.draw(data))

    def _fitted(self, picture: Any) -> np.ndarray:
        return np.asarray(Image.fromarray(np.asarray(picture, dtype=np.uint8)).resize(self.size))

    def close(self) -> None:
        """Release the OpenGL context, where MuJoCo draws."""
        if self._mujoco is not None:
            self._mujoco.close()
            self._mujoco = None


def simulation_of(env: EnvBase, row: int = 0) -> tuple[Any, int]:
    """Return the simulation of one row, below the transforms and wrappers of TorchRL, and how often it is stepped.

    Args:
        env: of any batch size.
        row: of the batch.

    Returns:
        The innermost environment that can be reached in this process, and its steps in one step of `env`.
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
    """Return the duration of one step of an environment [s] as it tells it; 1 where it does not."""
    env = make_env(num_envs=1)
    simulation, repeats = simulation_of(env)
    steps_per_second = (getattr(simulation, "metadata", None) or {}).get("render_fps")
    innermost = getattr(simulation, "unwrapped", simulation)
    if hasattr(simulation, "control_timestep"):  # dm_control
        found = simulation.control_timestep()
    elif getattr(innermost, "control_step", None):
        found = innermost.control_step
    elif getattr(innermost, "dt", None):  # Gymnasium: classic control and MuJoCo
        found = innermost.dt
    else:
        found = 1.0 / steps_per_second if steps_per_second else 1.0
    env.close()
    return float(found) * repeats


def steps_per_episode(make_env: Callable[..., EnvBase]) -> int:
    """Return the length of a full episode as an environment tells it; 1000 steps where it does not."""
    env = make_env(num_envs=1)
    simulation, repeats = simulation_of(env)
    limits = (
        getattr(getattr(simulation, "spec", None), "max_episode_steps", None),  # Gymnasium
        getattr(simulation, "_step_limit", None),  # dm_control
        getattr(simulation, "episode_steps", None),
    )
    env.close()
    found = next((limit for limit in limits if limit is not None and np.isfinite(limit)), _EPISODE_STEPS * repeats)
    return max(1, int(found) // repeats)


def style_grid(space: StyleSpace) -> list[dict[str, Any]]:
    """Return the styles to evaluate: every option, and a few values over each parameter's evaluation range.

    All combinations where there are at most 36, otherwise one parameter at a time, the others at their defaults.
    """
    numeric = [p for p in space.parameters if not isinstance(p, Choice)]
    count = _GRID[0] if len(numeric) == 1 else _GRID[1]
    values = {
        p.name: p.options if isinstance(p, Choice) else _spread(*p.evaluation_range, count) for p in space.parameters
    }
    if np.prod([len(options) for options in values.values()]) <= _LARGEST_GRID:
        return [dict(zip(values, cell, strict=True)) for cell in product(*values.values())]
    default = space.describe(space.default)
    return [default, *({**default, name: v} for name, options in values.items() for v in options if v != default[name])]


def _spread(low: float, high: float, count: int) -> list[float]:
    """Evenly spaced values with few digits."""
    return [min(max(float(f"{value:.6g}"), low), high) for value in np.linspace(low, high, count)]

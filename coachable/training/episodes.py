"""Statistics of collected episodes and of updates between two rows of the log."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from coachable.keys import STYLE, STYLE_FEATURES, STYLE_REWARD, TASK_REWARD

_LONG_EPISODE = 10_000  # steps

_SUMS = "episode_sums"
_SUMMED = {"reward": "return", TASK_REWARD: "task_return", STYLE_REWARD: "style_return"}


class EpisodeSums(Transform):
    """Environment transform that writes the running episode's summed rewards and its length: `episode_sums` (N, 4).

    The columns are reward, task reward, style reward and steps. TorchRL's `RewardSum` cannot sum the task reward, which
    is an observation. Put this transform after `StyleRewardTransform`.
    """

    def __init__(self) -> None:
        super().__init__(in_keys=list(_SUMMED), out_keys=[_SUMS])

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rewards = [next_tensordict.get(key) for key in _SUMMED]
        step = torch.cat([*rewards, torch.ones_like(rewards[0])], -1)
        return next_tensordict.set(_SUMS, tensordict.get(_SUMS) + step)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, len(_SUMMED) + 1)
        return tensordict_reset.set(_SUMS, torch.zeros(shape, device=tensordict_reset.device))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the sums."""
        assert isinstance(observation_spec, Composite)
        shape = torch.Size((*observation_spec.shape, len(_SUMMED) + 1))
        observation_spec[_SUMS] = Unbounded(shape=shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec


class Means:
    """Running means of scalars on any device; nothing is read from the device before `flush`.

    Example:
        >>> means = Means()
        >>> means.add({"loss": torch.tensor(1.0)})
        >>> means.add({"loss": torch.tensor(3.0)})
        >>> means.flush()
        {'loss': 2.0}
    """

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, values: Mapping[str, Tensor], count: int = 1) -> None:
        """Add one value of one element per name, which is the sum of `count` numbers."""
        for name, value in values.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value.clone()
            self._counts[name] = self._counts.get(name, 0) + count

    def flush(self) -> dict[str, float]:
        """Return the means since the last call, and reset them."""
        means = {name: total.item() / self._counts[name] for name, total in self._sums.items()}
        self._sums, self._counts = {}, {}
        return means


class EpisodeWatch:
    """Warns once if no episode ends, because a style is drawn when an episode begins."""

    def __init__(self) -> None:
        self._steps = 0
        self._watches = True

    def add(self, data: TensorDictBase) -> None:
        """Add collected transitions `[N, T]` of N environments."""
        if not self._watches:
            return
        self._steps += data.shape[-1]
        ended = bool(data.get(("next", "done")).any())
        self._watches = not ended and self._steps < _LONG_EPISODE
        if not ended and not self._watches:
            warnings.warn(
                f"no episode has ended in {_LONG_EPISODE:,} steps of each environment: a style is drawn when an "
                f"episode begins, so only {data.numel() // data.shape[-1]} styles were seen. Expected a time limit, "
                "such as gymnasium.wrappers.TimeLimit or torchrl.envs.StepCounter",
                stacklevel=2,
            )


class EpisodeStatistics:
    """Statistics of the training's episodes: return, length, task reward and style terms.

    Args:
        style_terms: Maps style features `(B, F)` and theta `(B, d)` to named, unscaled terms `(B,)`; None omits them.
    """

    def __init__(self, style_terms: Callable[[Any, Tensor], Mapping[str, Tensor]] | None = None) -> None:
        self.style_terms = style_terms
        self._ended: list[Tensor] = []
        self._terminated: list[Tensor] = []
        self._steps = Means()

    def add(self, data: TensorDictBase) -> None:
        """Add collected transitions `[B]`."""
        after = data.get("next")
        sums = after.get(_SUMS, None)
        done = after.get("done").reshape(-1)
        if sums is not None and done.any():
            self._ended.append(sums[done])
            self._terminated.append(after.get("terminated").reshape(-1)[done])
        rewards = {name: after.get(name, None) for name in (TASK_REWARD, STYLE_REWARD)}
        per_step = {f"step/{name}": value.sum() for name, value in rewards.items() if value is not None}
        features = after.get(STYLE_FEATURES, None)
        if self.style_terms is not None and features is not None:
            terms = self.style_terms(features, data.get(STYLE))
            per_step |= {f"step/style_{name}": value.sum() for name, value in terms.items()}
        self._steps.add(per_step, len(done))  # batches of asynchronous workers differ in size

    def flush(self) -> dict[str, float]:
        """Return the statistics since the last call, and reset them.

        Returns:
            `episode/count`; `episode/return`, `episode/task_return`, `episode/style_return`, `episode/length` and
            `episode/terminated` (share), averaged over the episodes that ended, if any did; and `step/*`, averaged over
            env-steps.
        """
        result: dict[str, float] = {"episode/count": 0}
        if self._ended:
            ended = torch.cat(self._ended)
            result["episode/count"] = len(ended)
            names = [*_SUMMED.values(), "length"]
            result |= {f"episode/{name}": mean for name, mean in zip(names, ended.mean(0).tolist(), strict=True)}
            result["episode/terminated"] = torch.cat(self._terminated).float().mean().item()
        self._ended, self._terminated = [], []
        return result | self._steps.flush()

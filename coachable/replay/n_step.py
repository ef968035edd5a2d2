"""Assembly of n-step transitions from streams of one-step transitions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from coachable.keys import EVENTS, STYLE_FEATURES, STYLE_REWARD, TASK_REWARD
from coachable.ranges import COUNT, SHARE
from coachable.replay.steps import Steps

Key = str | tuple[str, ...]
REWARDS = (("next", "reward"), ("next", TASK_REWARD), ("next", STYLE_REWARD))


class NStep:
    """Assembler of n-step transitions, which sum rewards over up to `n_steps` steps.

    The transition at t gets `R_t = sum_{l<k} gamma^l r_{t+l}`, the `next` entries of step t+k-1, and `steps_to_next_obs
    = k` `(..., 1)` (TorchRL's key, from which losses compute the discount `gamma^k`). k is `n_steps`, or less if the
    episode ends first, terminated or truncated. A loss bootstraps unless `("next", "terminated")`.

    Steps whose sum is incomplete are held back until the following steps arrive, so that several calls per episode give
    the same transitions as one. `flush` completes all sums at the end of the data.

    Args:
        n_steps: Number of steps to sum, N.
        gamma: Discount per step.
        discounted_keys: Keys of further entries to sum besides the rewards. Include `("next", "style_features")` only
            if the style reward is linear in the features. Without it, n-step transitions have no features, because
            relabelling from the last step's features would be wrong.
        patience: Number of steps after which a stream has ended if nothing of it arrived.

    Raises:
        ValueError: If `n_steps` is not positive or `gamma` lies outside [0, 1].
    """

    def __init__(self, n_steps: int, gamma: float, discounted_keys: Sequence[Key] = (), patience: int = 2**62) -> None:
        COUNT.check("n_steps", n_steps)
        SHARE.check("gamma", gamma)
        self.n_steps = n_steps
        self.gamma = gamma
        further = (key if isinstance(key, str) else tuple(key) for key in discounted_keys)
        self.summed = tuple(dict.fromkeys((*REWARDS, *further)))
        self.patience = patience
        self._data: TensorDictBase | None = None
        self._steps: Steps | None = None

    def push(self, data: TensorDictBase, steps: Steps) -> tuple[TensorDictBase, Steps]:
        """Add steps and return the transitions that they complete, in the order of completion.

        Args:
            data: One-step transitions `(steps,)`.
            steps: Their bookkeeping. A returned transition has that of its first step.
        """
        if self._data is not None and self._steps is not None:
            data = torch.cat([self._data, data])  # type: ignore[assignment]
            steps = Steps.cat([self._steps, steps])
        return self._emit(data, steps, finish=False)

    def flush(self, streams: np.ndarray | None = None) -> tuple[TensorDictBase, Steps] | None:
        """Return steps that are held back, with their sums ended at the last step.

        Args:
            streams: Numbers of the streams, `(k,)` int, whose steps to return; None returns all.

        Returns:
            The transitions and their bookkeeping, or None without such steps.
        """
        if self._data is None or self._steps is None:
            return None
        if streams is None:
            return self._emit(self._data, self._steps, finish=True)
        ending = np.isin(self._steps.stream, streams)
        if not ending.any():
            return None
        data, steps = self._data, self._steps
        emitted = self._emit(data[torch.from_numpy(ending)], steps[ending], finish=True)
        if not ending.all():
            self._data, self._steps = data[torch.from_numpy(~ending)], steps[~ending]
        return emitted

    def _emit(self, data: TensorDictBase, steps: Steps, finish: bool) -> tuple[TensorDictBase, Steps]:
        cut = steps.in_episodes()
        row = np.arange(len(steps))
        last = cut.last[cut.number]
        full = row + self.n_steps - 1
        # A piece is closed by its own end, or by having been abandoned.
        abandoned = steps.arrival[cut.order[cut.last]] < steps.arrival.max() - self.patience
        closed = cut.ends[cut.last] | abandoned | finish
        complete = (full <= last) | closed[cut.number]
        last = np.minimum(full, last)

        emitted = np.flatnonzero(complete)
        emitted = emitted[np.lexsort((emitted, cut.order[last[emitted]]))]  # by the step that completes the sum

        transitions = self._sum(data, cut.order, emitted, last[emitted])
        held = np.sort(cut.order[~complete])
        self._data = data[torch.from_numpy(held).to(data.device or "cpu")] if len(held) else None
        self._steps = steps[held] if len(held) else None
        return transitions, steps[cut.order[emitted]]

    def _sum(self, data: TensorDictBase, order: np.ndarray, start: np.ndarray, last: np.ndarray) -> TensorDictBase:
        device = data.device or "cpu"
        first_row = torch.from_numpy(order[start]).to(device)
        count = torch.from_numpy(last - start + 1).to(device)
        following: TensorDictBase = data.get("next")  # type: ignore[assignment]
        out: Any = data.exclude("next")[first_row]
        nxt: Any = following[torch.from_numpy(order[last]).to(device)]
        if ("next", STYLE_FEATURES) not in self.summed:
            nxt = nxt.exclude(STYLE_FEATURES)
        if following.get(EVENTS, None) is not None:
            nxt.set(EVENTS, following.get(EVENTS)[first_row])  # those by which the transition was assigned to tables
        out.set("next", nxt)
        for key in self.summed:
            value: Any = data.get(key, None)
            if value is None:
                continue
            if not value.is_floating_point():
                value = value.to(torch.float32)
            total = value[first_row].clone()
            for lag in range(1, self.n_steps):
                at = torch.from_numpy(order[np.minimum(start + lag, last)]).to(device)
                mask = (count > lag).reshape(-1, *[1] * (total.ndim - 1))
                total += torch.where(mask, self.gamma**lag * value[at], 0.0)
            out.set(key, total)
        out.set("steps_to_next_obs", count.unsqueeze(-1))
        return out

    def clear(self) -> None:
        """Drop the steps that are held back."""
        self._data = self._steps = None

    def state_dict(self) -> dict[str, Any]:
        """Return the steps that are held back."""
        if self._data is None or self._steps is None:
            return {}
        return {"data": self._data.to_dict(), "steps": self._steps.state_dict()}

    def load_state_dict(self, state: dict[str, Any], device: torch.device | None = None) -> None:
        """Restore the steps that `state_dict` returned, on a device."""
        self.clear()
        if state:
            self._steps = Steps.from_state_dict(state["steps"])
            data = TensorDict(state["data"], batch_size=[len(self._steps)], device=device)
            self._data = data.apply(torch.clone)  # TensorDict.clone adds 0, which turns -0.0 into 0.0

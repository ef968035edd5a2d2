"""Runs of an environment from a seed, which are recorded in a contract and repeated when it is verified."""

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.contract.contract import Contract, Recorded
from coachable.contract.exported_model import OnnxRun
from coachable.domain import Domain
from coachable.keys import STYLE
from coachable.styles import StyleSpace
from coachable.training.rollout import Rollout

STEPS = 200  # of the policy's run
STYLE_STEPS = 50  # between two styles
REST_STEPS = 40
PROBE = 0.25  # of an axis: small, so that even four times as much is no more than its bound
SEED = 0


class Rig:
    """One environment that can be run again and again from the same start; `close` it at the end.

    Attributes:
        widths: Widths of its observation and action.
    """

    def __init__(self, domain: Domain, space: StyleSpace) -> None:
        self.space = space
        self.env = domain.styled_env(space, 1, num_threads=1, **domain.coached)
        self._rollout = Rollout(self.env)
        self.widths = (self.env.observation_spec["observation"].shape[-1], self.env.action_spec.shape[-1])

    def run(self, seed: int, steps: int, act: Callable[[int, np.ndarray], tuple[Tensor, np.ndarray]]) -> np.ndarray:
        """Run an episode until its end, or for some steps.

        Args:
            seed: Seed of the start.
            steps: Largest number of steps.
            act: Function of the number of the step, from 0, and the observation (D,) that returns style and action.

        Returns:
            Observations (T + 1, D) before the first step and after each.
        """
        self._rollout.seed(seed)
        self._rollout.begin(self.space.default[None])
        seen: list[np.ndarray] = [self._observed()]

        def asked(now: TensorDictBase) -> TensorDictBase:
            style, action = act(len(seen) - 1, seen[-1])
            return now.set(STYLE, style[None]).set("action", torch.from_numpy(action)[None])

        for _ in self._rollout.episode(asked, steps):
            seen.append(self._observed())
        return np.stack(seen)

    def repeat(self, seed: int, action: np.ndarray, style: np.ndarray | None = None) -> np.ndarray:
        """Run an episode with given actions.

        Args:
            seed: Seed of the start.
            action: Actions (T, A).
            style: Raw styles (T, d); None for the space's default style.

        Returns:
            Observations (T + 1, D) before the first step and after each, fewer if the episode ends.
        """
        default = self.space.default
        styles = None if style is None else torch.from_numpy(style)
        return self.run(seed, len(action), lambda k, _: (default if styles is None else styles[k], action[k]))

    def close(self) -> None:
        """Release the environment."""
        self.env.close()

    def _observed(self) -> np.ndarray:
        return self._rollout.observation[0].numpy().copy()


def neutral_action(contract: Contract) -> np.ndarray:
    """Return the action (A,) with axes at 0 and the first value of each choice."""
    action = np.zeros(contract.widths[1], np.float32)
    action[np.cumsum([0, *contract.choice_sizes])[:-1]] = 1.0
    return action


def record(rig: Rig, contract: Contract, policy: OnnxRun) -> Recorded:
    """Record the runs of a contract: the exported policy's, one at rest, and a step for each entry of the action."""
    styles = [contract.space.default]
    styles += contract.space.sample((STEPS // STYLE_STEPS,), torch.Generator().manual_seed(SEED)).unbind()
    asked: list[np.ndarray] = []
    given: list[np.ndarray] = []

    def act(step: int, observation: np.ndarray) -> tuple[Tensor, np.ndarray]:
        style = styles[step // STYLE_STEPS]
        asked.append(style.numpy())
        given.append(policy.act(observation[None], asked[-1][None])[0])
        return style, given[-1]

    observation = rig.run(SEED, STEPS, act)
    probes = probe_actions(contract)
    return Recorded(
        seed=SEED,
        observation=observation,
        style=np.stack(asked),
        action=np.stack(given),
        rest=rig.repeat(SEED, np.tile(neutral_action(contract), (REST_STEPS, 1))),
        probe_action=probes,
        probe=np.stack([rig.repeat(SEED, action[None])[1] for action in probes]),
    )


def probe_actions(contract: Contract) -> np.ndarray:
    """Return the neutral action with one axis at a quarter, or with one other value of a choice, (P, A)."""
    neutral = neutral_action(contract)
    probes = []
    first = 0
    for size in contract.choice_sizes:
        for value in range(1, size):
            probe = neutral.copy()
            probe[first : first + size] = np.eye(size, dtype=np.float32)[value]
            probes.append(probe)
        first += size
    for axis in range(first, contract.widths[1]):
        probe = neutral.copy()
        probe[axis] = PROBE
        probes.append(probe)
    return np.stack(probes)

"""`Rivals`, a mixture of scripted opponents and past copies of the agent's policy."""

import copy
from collections import deque
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from coachable.envs.racing.race.counter_rng import uniforms
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.run import Field
from coachable.keys import STYLE

_STREAM = 7919  # keeps the draws apart from those of the starts


class Rivals:
    """Driver that controls each car either by script, with a random share of the grip, or by a past copy of the policy.

    Whether a car is scripted, its share of the grip and its style are drawn at the start of each race; which copy
    drives it changes when a copy is added. Without a policy to follow, all cars are scripted.

    Args:
        driver: Scripted driver.
        styles: Lowest and highest value of each entry of theta, (d,) each, between which the styles of the copies are
            drawn.
        scripted: Share of scripted cars.
        slowest: Smallest share of the scripted driver's grip; the largest is 1.
        keep: Number of copies that are kept, the newest ones.
        interval: Number of control steps between copies.

    Raises:
        ValueError: If a share is not in [0, 1], or if `keep` or `interval` is less than 1.
    """

    def __init__(
        self,
        driver: LineFollower,
        styles: tuple[Tensor, Tensor],
        *,
        scripted: float = 0.5,
        slowest: float = 0.82,
        keep: int = 4,
        interval: int = 2000,
    ) -> None:
        if not 0.0 <= scripted <= 1.0 or not 0.0 < slowest <= 1.0:
            raise ValueError(f"scripted is {scripted} and slowest is {slowest}: expected 0 to 1, and more than 0 to 1")
        if keep < 1 or interval < 1:
            raise ValueError(f"keep is {keep} and interval {interval}: expected at least one copy and one step")
        self.driver, self.styles, self.scripted, self.slowest, self.interval = (
            driver,
            styles,
            scripted,
            slowest,
            interval,
        )
        self.copies: deque[nn.Module] = deque(maxlen=keep)
        self.policy: nn.Module | None = None
        self._steps = 0

    def follow(self, policy: nn.Module) -> None:
        """Copy this policy from now on.

        Args:
            policy: Module that reads `observation` and `style` and writes `action`.
        """
        self.policy = policy

    @torch.no_grad()
    def __call__(self, field: Field, observation: Tensor) -> Tensor:
        """Return actions (M, 2) for the last M cars of a field."""
        m = len(observation)
        # Uniform numbers of each car that decide whether it is scripted, its share of the grip, and its copy.
        who, grip, which = uniforms(field.seeds + _STREAM, field.episode, 3, field.cars).reshape(3, -1)
        action = self.driver(field, observation, self.slowest + (1.0 - self.slowest) * grip)
        self._copy_if_due()
        if not self.copies:
            return action
        which = torch.where(who < self.scripted, -1.0, torch.floor(which * len(self.copies)))[-m:]
        style = self._styles(field)[-m:]
        for number, policy in enumerate(self.copies):
            cars = (which == number).nonzero()[:, 0]
            if len(cars):
                seen = TensorDict({"observation": observation[cars], STYLE: style[cars]}, [len(cars)])
                action[cars] = policy(seen)["action"].to(action)
        return action

    def state(self) -> dict[str, Any]:
        """Return the copies and the number of steps taken, for exact resumption."""
        return {"steps": self._steps, "copies": [copy.deepcopy(policy.state_dict()) for policy in self.copies]}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned.

        Raises:
            ValueError: If there are copies, but no policy to follow.
        """
        if state["copies"] and self.policy is None:
            raise ValueError("the state has copies of a policy, but none is followed: call follow(policy) before")
        self._steps = state["steps"]
        self.copies.clear()
        for weights in state["copies"]:
            past = self._frozen()
            past.load_state_dict(weights)
            self.copies.append(past)

    def _copy_if_due(self) -> None:
        if self.policy is None:
            return
        self._steps += 1
        if self._steps % self.interval == 0:
            self.copies.append(self._frozen())

    def _frozen(self) -> nn.Module:
        """Return a copy of the policy without gradients, on the environment's device."""
        if self.policy is None:
            raise ValueError("there is no policy to copy: call follow(policy) before")
        return copy.deepcopy(self.policy).to(self.styles[0].device).requires_grad_(False)

    def _styles(self, field: Field) -> Tensor:
        """Draw a style for each car (N, d), which stays the same throughout a race."""
        low, high = self.styles
        u = uniforms(field.seeds + 2 * _STREAM, field.episode, len(low), field.cars).reshape(len(low), -1)
        return (low[:, None] + (high - low)[:, None] * u).T

"""`Garage`, which assigns a car model to each race."""

from typing import Any

import torch
from torch import Tensor

from coachable.envs.racing.physics.cars import POOL_GT3, Car, car_pool, load_car
from coachable.envs.racing.race.counter_rng import uniforms

GT3_POOL = "gt3_pool"
POOLS = ("pool", GT3_POOL)
_BASE, _RATE = 0.1, 0.05  # of the adaptive sampling: p in proportion to 0.1 + mean spins


class Garage:
    """One shipped car for all races, or a pool from which each race draws one model for all of its cars.

    Models that spin are drawn more often, with p proportional to 0.1 + EMA(spins per car and episode) (our choice, for
    the paper's adaptive sampling), unless `adaptive` is False. The 50 models of "gt3_pool", on which the paper
    evaluates agents, take turns: consecutive races, and consecutive episodes of a race, have different ones.

    Args:
        name: Name of a shipped car, "pool" or "gt3_pool".
        cars: Number A of cars in a race.
        races: Number B of races.
        device: Device of the parameters.
        adaptive: Whether models that spin are drawn more often.

    Raises:
        ValueError: If there is no such car.
    """

    def __init__(self, name: str, cars: int, races: int, device: torch.device, *, adaptive: bool = True) -> None:
        self.pooled, self.adaptive, self.in_turn = name in POOLS, adaptive, name == GT3_POOL
        self.typical = load_car("gt3" if self.pooled else name)
        self.cars, self.device = cars, device
        self.car: Car = self.typical
        if self.pooled:
            self.pool = car_pool()[:, : POOL_GT3 if self.in_turn else None].to(device)  # (P, 530), or (P, 50)
            self.spinning = torch.zeros(self.pool.shape[1], device=device)
            self.model = torch.zeros(races, dtype=torch.int64, device=device)
            self._assemble()

    def reset(self) -> None:
        """Forget how often the models have spun."""
        if self.pooled:
            self.spinning.zero_()

    def draw(self, races: Tensor, seeds: Tensor, episode: Tensor, spins: Tensor) -> None:
        """Draw new models, after updating how often the old ones spin.

        Args:
            races: Whether each race draws a model, (B,) bool.
            seeds: Seed of each race (B,) int64.
            episode: Number of episodes that each race has started (B,) int64.
            spins: Number of spins of each car in the episode that ends (A * B,).
        """
        mean = spins.reshape(self.cars, -1).mean(0)
        ended = races & (episode > 1)
        total = torch.zeros_like(self.spinning).index_add_(0, self.model, torch.where(ended, mean, 0.0))
        count = torch.zeros_like(self.spinning).index_add_(0, self.model, ended.to(mean.dtype))
        change = total / count.clamp(min=1.0) - self.spinning
        self.spinning = self.spinning + _RATE * torch.where(count > 0, change, 0.0)
        if self.in_turn:
            drawn = (seeds + episode) % self.pool.shape[1]
        else:
            odds = (_BASE + (self.spinning if self.adaptive else 0.0 * self.spinning)).cumsum(0)
            u = uniforms(seeds ^ 0x5DEECE66D, episode, 1, 1)[0, 0]
            drawn = torch.bucketize(u * odds[-1], odds[:-1], right=True)
        self.model = torch.where(races, drawn, self.model)
        self._assemble()

    def state(self) -> dict[str, Any]:
        """Return the tensors for exact resumption."""
        return {"spinning": self.spinning.clone(), "model": self.model.clone()} if self.pooled else {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        if self.pooled:
            self.spinning = state["spinning"].to(self.device, copy=True)
            self.model = state["model"].to(self.device, copy=True)
            self._assemble()

    def _assemble(self) -> None:
        self.car = Car.unpack(self.pool[:, self.model].repeat(1, self.cars))

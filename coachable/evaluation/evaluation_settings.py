"""What an evaluation was asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coachable.evaluation.rollouts import RolloutOptions
    from coachable.evaluation.sweep import WeightSweep


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of `coachable evaluate`; the evaluation of a domain uses those that apply to it.

    Attributes:
        episodes: per style.
        switch_episodes: with styles that switch; 0 for none.
        steps: length of an episode in control steps; None for the domain's own.
        seed: of initial states, styles and sampled actions. The same seed gives the same files.
        num_threads: physics threads, where the simulator has its own.
        progress: show progress bars.
        sweeps: episodes along each weight, where a report has made them already (`sweep_weights`); else None.

    Raises:
        ValueError: if `episodes` is below 1.
    """

    episodes: int = 20
    switch_episodes: int = 60
    steps: int | None = None
    seed: int = 0
    num_threads: int | None = None
    progress: bool = True
    sweeps: Sequence[WeightSweep] | None = None

    def __post_init__(self) -> None:
        """Refuses what cannot be evaluated."""
        if self.episodes < 1:
            raise ValueError(f"episodes per style must be at least 1, got {self.episodes}")

    @property
    def rollout(self) -> RolloutOptions:
        """The settings of every rollout, as keyword arguments."""
        return {
            "steps": self.steps,
            "seed": self.seed,
            "num_threads": self.num_threads,
            "progress": self.progress,
        }

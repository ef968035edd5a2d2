"""Settings of an evaluation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from coachable.evaluation.episode_records import RolloutOptions
from coachable.evaluation.sweep import WeightSweep


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of `coachable evaluate`; the evaluation of a domain uses those that apply to it.

    Attributes:
        episodes: Number of episodes per style.
        switch_episodes: Number of episodes in which the style switches; 0 for none.
        steps: Length of an episode in control steps, or None for the domain's own.
        seed: Seed of initial states, styles and sampled actions. The same seed gives the same files.
        num_threads: Number of physics threads, if the simulator has its own.
        progress: Whether to show progress bars.
        env_options: Arguments of `make_env` by name, from `Domain.read_options`. A domain's own evaluation decides
            what they change; the general one measures the agent under them.
        sweeps: Episodes along each weight, if a report has already recorded them (`sweep_weights`); otherwise None.

    Raises:
        ValueError: If `episodes` is below 1.
    """

    episodes: int = 20
    switch_episodes: int = 60
    steps: int | None = None
    seed: int = 0
    num_threads: int | None = None
    progress: bool = True
    env_options: Mapping[str, Any] = field(default_factory=dict)
    sweeps: Sequence[WeightSweep] | None = None

    def __post_init__(self) -> None:
        """Check the number of episodes."""
        if self.episodes < 1:
            raise ValueError(f"episodes per style must be at least 1, got {self.episodes}")

    @property
    def rollout(self) -> RolloutOptions:
        """Settings of every rollout, as keyword arguments."""
        return {"steps": self.steps, "seed": self.seed, "num_threads": self.num_threads, "progress": self.progress}

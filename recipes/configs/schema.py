"""What a configuration contains, and of which type; recipe_ranges.py says in which range its numbers make sense.

Groups whose YAML names a `_target_` (loss, replay, sampler, collector, environment) have whatever entries it takes.
"""

from dataclasses import dataclass, field
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

Target = dict[str, Any]
"""A function or class under `_target_`, and its arguments."""


@dataclass
class Impersonation:
    """Relabelling of sampled transitions."""

    n: int


@dataclass
class Network:
    """Actor and critics."""

    actor: Target
    critic: Target
    num_critics: int


@dataclass
class Learner:
    """Optimisers; the fields are arguments of `coachable.training.Learner`."""

    _target_: str
    update_order: str
    actor_lr: float
    critic_lr: float
    adam_eps: float
    tau: float
    max_grad_norm: float | None
    precision: str
    compile: bool


@dataclass
class Loop:
    """When the training does what; the fields are those of `TrainSettings`."""

    _target_: str
    total_frames: int
    batch_size: int
    warmup_frames: int
    utd_ratio: float | None
    throttle: float | None
    anneal: float
    anneal_entropy: float
    eval_interval: int
    log_interval: float
    checkpoint_interval: float


@dataclass
class Evaluation:
    """Episodes of each evaluation."""

    num_envs: int
    max_steps: int


@dataclass
class Checkpoints:
    """How many to keep, and whether the newest one holds the replay buffer."""

    keep: int
    replay: bool


@dataclass
class Wandb:
    """Weights & Biases."""

    mode: str
    project: str


@dataclass
class Threads:
    """Numbers of threads; None takes what is free."""

    simulator: int | None
    learner: int | None


@dataclass
class Settings:
    """Configuration of a recipe, resolved."""

    summary: str
    domain: str
    preset: str
    seed: int
    device: str
    run_dir: str
    resume: str | None
    init_from: str | None
    init_new_observations: int
    env: Target
    style_reward: dict[str, Any]
    sampler: Target
    gamma: float
    alpha: float
    entropy_samples: int
    network: Network
    loss: Target
    learner: Learner
    n_steps: int
    replay: Target
    replay_capacity: int
    events: Target | None
    event_capacity: int
    event_share: float
    event_horizon: int
    critic_support: dict[str, float]
    mirror: float
    impersonation: Impersonation
    collector: Target
    train: Loop
    init_random_frames: int
    eval: Evaluation
    checkpoint: Checkpoints
    wandb: Wandb
    threads: Threads
    family: str | None = None  # of racing
    fast: Any = "auto"  # hand-written passes of the learner
    stage: str | None = None
    stages: list[dict[str, Any]] = field(default_factory=list)
    preset_for: dict[str, str] | None = None
    extra: dict[str, Any] = field(default_factory=dict)  # entries that the command line adds with +KEY=VALUE


def typed_settings(config: dict[str, Any]) -> Settings:
    """Return a plain configuration as typed settings.

    Args:
        config: Plain containers, resolved.

    Raises:
        ValueError: If a key is missing or unknown, or a value has another type.
    """
    known = Settings.__dataclass_fields__
    sorted_out = {key: value for key, value in config.items() if key in known}
    sorted_out["extra"] = {key: value for key, value in config.items() if key not in known}
    try:
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Settings), sorted_out))
    except OmegaConfBaseException as error:
        raise ValueError(f"the configuration is wrong at {error.full_key}: {str(error).splitlines()[0]}") from None
    assert isinstance(settings, Settings)
    return settings

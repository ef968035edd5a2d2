"""Schema of the configurations: the types that Hydra composes against, and the ranges of the numbers.

`register_schema` registers them with Hydra; the YAML file of a recipe names its class first in its list of defaults.
Unknown keys and values of another type are then errors. Groups with a `_target_` (loss, replay, sampler, collector,
environment) have the arguments of the target as entries, whose names `Target.build` compares with the target's.
"""

from dataclasses import asdict, dataclass, field, fields, is_dataclass, make_dataclass
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from recipe_target import Target
from torchrl.objectives import LossModule

from coachable.ranges import AMOUNT, COUNT, NOT_NEGATIVE, POSITIVE, SHARE, Range
from coachable.training.train_settings import TrainSettings

ATOMS = Range("[2, inf)", whole=True)


def within(expected: Range) -> Any:
    """Return a dataclass field for a number in a range."""
    return field(metadata={"range": expected})


def arguments(**ranges: Range | list[Range] | type[bool]) -> Any:
    """Return a dataclass field for a target.

    Args:
        **ranges: Range by the name of an argument, also a nested one; in a list the range of each of several numbers;
            `bool` for a switch, which older files write as 0 or 1. A number with the name of one of `Settings` has its
            range. Others must be finite; the target checks them.
    """
    return field(metadata={"ranges": ranges})


@dataclass
class Impersonation:
    """Relabelling of sampled transitions."""

    n: int = within(AMOUNT)
    own_table: bool = False


@dataclass
class Support:
    """Support of categorical critics: the range of returns."""

    v_min: float
    v_max: float


@dataclass
class Network:
    """Actor and critics."""

    actor: Target = arguments(widths=[COUNT], categorical=[COUNT], axes=AMOUNT, head_gain=NOT_NEGATIVE)
    critic: Target = arguments(widths=[COUNT], num_outputs=COUNT, num_atoms=ATOMS)
    num_critics: int = within(COUNT)


@dataclass
class Learner:
    """Optimisers; the fields are arguments of `coachable.training.Learner`."""

    _target_: str
    update_order: str
    precision: str
    compile: bool
    actor_lr: float = within(NOT_NEGATIVE)
    critic_lr: float = within(NOT_NEGATIVE)
    adam_eps: float = within(POSITIVE)
    tau: float = within(Range("(0, 1]"))
    max_grad_norm: float | None = within(Range("(0, inf)", optional=True))

    def build(self, loss: LossModule) -> Any:
        """Make the learner of a loss."""
        return Target(asdict(self)).build(loss)


@dataclass(frozen=True)
class Loop(TrainSettings):
    """Training loop: `TrainSettings` with its ranges."""

    _target_: str = ""


@dataclass
class Evaluation:
    """Episodes of each evaluation."""

    num_envs: int = within(COUNT)
    max_steps: int = within(COUNT)


@dataclass
class Checkpoints:
    """Checkpoints: how many to keep, and whether the newest one contains the replay buffer."""

    replay: bool
    keep: int = within(COUNT)


@dataclass
class Wandb:
    """Settings of Weights & Biases."""

    mode: str
    project: str


@dataclass
class Threads:
    """Numbers of threads; None uses the free cores."""

    simulator: int | None = within(Range("[1, inf)", whole=True, optional=True))
    learner: int | None = within(Range("[1, inf)", whole=True, optional=True))


@dataclass(kw_only=True)
class Settings:
    """Configuration of a recipe; the numbers of `env` are those of all recipes' environments."""

    summary: str
    domain: str
    preset: str
    device: str
    fast: Any  # hand-written passes of the learner: on, off or auto
    run_dir: str | None
    resume: str | None
    init_from: str | None
    init_new_observations: int = within(AMOUNT)
    seed: int = within(Range("[0, 4e9]", whole=True))
    stages: list[dict[str, Any]]
    stage: str | None
    env: Target = arguments(
        num_envs=COUNT, episode_steps=COUNT, cars=COUNT, seconds=POSITIVE, shares=[SHARE], weights=[NOT_NEGATIVE]
    )
    style_reward: dict[str, Any] = arguments(**{"margin": POSITIVE, "in_corners": bool, "*": NOT_NEGATIVE})
    sampler: Target = arguments(share=SHARE, neutral=SHARE, independent=SHARE, positive=SHARE, full=SHARE)
    gamma: float = within(SHARE)
    alpha: float = within(POSITIVE)
    entropy_samples: int = within(COUNT)
    n_steps: int = within(COUNT)
    replay_capacity: int = within(COUNT)
    events: dict[str, Any] | None
    event_capacity: int = within(COUNT)
    event_share: float = within(Range("(0, 1)"))
    event_horizon: int = within(COUNT)
    critic_support: Support
    mirror: float = within(SHARE)
    impersonation: Impersonation
    learner: Learner
    loss: Target = arguments(alpha_init=POSITIVE, num_quantiles=COUNT, num_atoms=ATOMS, sigma_ratio=POSITIVE)
    network: Network  # after `loss`, whose numbers it takes, so that a wrong one is reported where it was set
    replay: Target = arguments(table_capacities=[COUNT], table_proportions=[SHARE], capacity=COUNT)
    collector: Target = arguments(
        num_collectors=COUNT,
        steps_per_batch=COUNT,
        cpus_per_worker=POSITIVE,
        group_size=COUNT,
        weights_every=COUNT,
        queue_size=COUNT,
        worker_throttle=Range("(0, inf)", optional=True),
        patience=POSITIVE,
    )
    train: Loop
    init_random_frames: int = within(AMOUNT)
    eval: Evaluation
    checkpoint: Checkpoints
    wandb: Wandb
    threads: Threads


@dataclass(kw_only=True)
class FamilySettings(Settings):
    """Configuration of a recipe for several families of styles."""

    family: str


def register_schema() -> None:
    """Register the classes with Hydra under their names in the lists of defaults."""
    store = ConfigStore.instance()
    store.store("settings", composed_type(Settings))
    store.store("family_settings", composed_type(FamilySettings))


def composed_type(kind: Any) -> Any:
    """Return the type of values during composition, in which each field is missing at first.

    The types are wider than declared, because OmegaConf rejects 1e6 as an `int` and accepts 2 as a `bool`;
    `checked_values` in recipe_checks.py checks these values.
    """
    if not is_dataclass(kind):
        return {Target: dict[str, Any], int: int | float, int | None: int | float | None, bool: Any}.get(kind, kind)
    entries = []
    for entry in fields(kind):
        composed = composed_type(entry.type)
        start = field(default_factory=composed) if is_dataclass(composed) else field(default=MISSING)
        entries.append((entry.name, composed, start))
    return make_dataclass(kind.__name__, entries)  # pyright: ignore[reportAttributeAccessIssue]

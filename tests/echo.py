"""A tiny batched environment with one style parameter, and a small training on it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import EnvBase
from torchrl.objectives import SACLoss

from coachable.keys import STYLE_FEATURES, TASK_REWARD
from coachable.networks import make_critic, make_gaussian_actor
from coachable.styles import Setpoint, StyleReward, StyleSpace, Term
from coachable.training import Learner
from coachable.training.checkpoint import CheckpointStore
from coachable.training.collection import make_collector
from coachable.training.episodes import EpisodeSums
from coachable.training.logging import MetricsLog, Progress
from coachable.training.train_settings import TrainSettings
from coachable.training.trainer import Trainer
from coachable.training.weights import agent_state
from coachable.transforms import CoachableEnv, coachable_env


class StyleEchoEnv(EnvBase):
    """N walks on a line; the style asks for an action: style reward `-|a - target|`, task reward 0.

    Episodes end (terminated) where |position| > 3, and after 20 steps (truncated).
    """

    runs_past_time_limit = True

    def __init__(self, num_envs: int = 4, seed: int = 0, resumable: bool = True) -> None:
        super().__init__(batch_size=[num_envs])
        shape = (num_envs,)
        self.observation_spec = Composite(
            observation=Unbounded((num_envs, 3)),
            **{TASK_REWARD: Unbounded((num_envs, 1)), STYLE_FEATURES: Unbounded((num_envs, 1))},
            shape=shape,
        )
        self.action_spec = Bounded(-1.0, 1.0, (num_envs, 1))
        self.reward_spec = Unbounded((num_envs, 1))
        names = ("done", "terminated", "truncated")
        self.done_spec = Composite({name: Binary(1, (num_envs, 1), dtype=torch.bool) for name in names}, shape=shape)
        self.position = torch.zeros(num_envs, 1)
        self.age = torch.zeros(num_envs, 1, dtype=torch.long)
        self.generator = torch.Generator()
        self.poison: dict[str, float] = {}  # written into row 1 of these entries, from step `poisoned_from` on
        self.poisoned_from = 0
        self.steps = 0
        if resumable:
            self.simulator_state = self._simulator_state
            self.load_simulator_state = self._load_simulator_state
        self._set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _observation(self) -> torch.Tensor:
        return torch.cat([self.position, self.position.sin(), self.age / 20], -1)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self.position, dtype=torch.bool) if mask is None else mask.reshape(self.position.shape)
        drawn = torch.rand(self.position.shape, generator=self.generator) - 0.5
        self.position = torch.where(mask, drawn, self.position)
        self.age = torch.where(mask, 0, self.age)
        return self._package(torch.zeros_like(self.position), reset=True)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        noise = torch.randn(self.position.shape, generator=self.generator)
        self.position = self.position + action + 0.3 * noise
        self.age = self.age + 1
        self.steps += 1
        out = self._package(action, reset=False)
        for key, value in self.poison.items() if self.steps >= self.poisoned_from else ():
            out[key][1, -1] = value
        return out

    def _package(self, action: torch.Tensor, *, reset: bool) -> TensorDictBase:
        terminated = (self.position.abs() > 3) & (not reset)
        truncated = (self.age >= 20) & ~terminated
        out = {
            "observation": self._observation(),
            TASK_REWARD: torch.zeros_like(self.position),
            STYLE_FEATURES: action.clone(),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        if not reset:
            out["reward"] = torch.zeros_like(self.position)
        return TensorDict(out, batch_size=self.batch_size)

    def _simulator_state(self) -> dict[str, Any]:
        return {
            "position": self.position.clone(),
            "age": self.age.clone(),
            "generator": self.generator.get_state(),
        }

    def _load_simulator_state(self, state: dict[str, Any]) -> None:
        self.position, self.age = state["position"].clone(), state["age"].clone()
        self.generator.set_state(state["generator"])


def echo_space() -> StyleSpace:
    return StyleSpace([Setpoint("target", -0.8, 0.8)], name="echo")


def _distance(features: torch.Tensor, style: Any) -> torch.Tensor:
    return -(features[..., 0] - style["target"]).abs()


def make_echo_env(seed: int = 0, num_envs: int = 4, **settings: Any) -> CoachableEnv:
    space = echo_space()
    reward = StyleReward(space, {"target": Term(_distance, parameters=("target",))})
    return coachable_env(StyleEchoEnv(num_envs, **settings), space, reward, EpisodeSums(), seed=seed)


def make_train(
    run_dir: Path,
    *,
    total_frames: int = 400,
    width: int = 16,
    space: StyleSpace | None = None,
    seed: int = 0,
    resumable: bool = True,
    num_envs: int = 4,
    checkpoints: CheckpointStore | None = None,
    actor_lr: float = 1e-3,
    make_env: Callable[..., Any] = make_echo_env,
    **settings: Any,
) -> Trainer:
    """Makes a small training on one thread; `settings` are those of `TrainSettings`."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    space = space or echo_space()
    actor = make_gaussian_actor(3, 1, space, (width,))
    critics = [make_critic(3, 1, space, (width,)) for _ in range(2)]
    spec = Bounded(-1.0, 1.0, (1,))
    loss = SACLoss(actor, critics, action_spec=spec, loss_function="l2", fixed_alpha=True, alpha_init=0.01)
    loss.make_value_estimator(gamma=0.9)
    run_dir.mkdir(parents=True, exist_ok=True)
    network = {"actor": {"_target_": "coachable.networks.make_gaussian_actor", "obs_dim": 3, "action_dim": 1}}
    network["actor"]["widths"] = [width]
    defaults = {"batch_size": 16, "warmup_frames": 40, "utd_ratio": 0.25, "checkpoint_interval": 1e9}
    return Trainer(
        collector=make_collector(
            lambda s: make_env(s, num_envs, resumable=resumable),
            actor,
            frames_per_batch=num_envs,
            init_random_frames=40,
            seed=seed,
        ),
        replay=TensorDictReplayBuffer(storage=LazyTensorStorage(300)),
        learner=Learner(loss, actor_lr=actor_lr, critic_lr=1e-3, precision="fp32"),
        settings=TrainSettings(total_frames=total_frames, **{**defaults, **settings}),
        log=MetricsLog(run_dir),
        progress=Progress(total_frames, every=1e9),
        checkpoints=checkpoints or CheckpointStore(run_dir / "checkpoints"),
        describe=lambda: agent_state(
            domain="echo", space=space, actor=actor, loss_module=loss, network=network, config={"seed": seed}
        ),
    )

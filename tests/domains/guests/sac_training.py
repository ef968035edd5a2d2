"""Training without a recipe: soft actor-critic with relabelled styles, for a domain of continuous actions."""

from functools import partial
from pathlib import Path

from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SACLoss

from coachable import training
from coachable.domain import Domain
from coachable.networks import make_critic, make_gaussian_actor
from coachable.transforms import TaskImpersonation


def train(domain: Domain, run: Path, frames: int = 20_000) -> None:
    """Train an agent of a domain; the folder `run` is then an agent for every command."""
    space, env = domain.make_space(), domain.make_env(1)
    obs_dim, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    sizes = {"obs_dim": obs_dim, "action_dim": action_dim, "widths": [64, 64]}
    actor = make_gaussian_actor(space=space, **sizes)
    critics = [make_critic(space=space, **sizes) for _ in range(2)]
    loss = SACLoss(actor, critics, action_spec=Bounded(-1.0, 1.0, (action_dim,)), loss_function="l2")
    loss.make_value_estimator(gamma=0.98)
    relabel = TaskImpersonation(domain.make_reward(space), n=2)
    network = {"actor": {"_target_": "coachable.networks.make_gaussian_actor", **sizes}}
    agent = {"domain": domain.name, "space": space, "actor": actor, "loss_module": loss, "network": network}
    styled = partial(domain.styled_env, space, 8, transforms=[training.EpisodeSums()])
    training.Trainer(
        collector=training.make_collector(styled, actor, frames_per_batch=8, init_random_frames=200),
        replay=TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), transform=relabel),
        learner=training.Learner(loss),
        settings=training.TrainSettings(frames, warmup_frames=200, utd_ratio=0.25),
        log=training.MetricsLog(run),
        progress=training.Progress(frames),
        checkpoints=training.CheckpointStore(run / "checkpoints"),
        describe=partial(training.agent_state, **agent, config={}),
    ).run()

"""Every recipe with its simulators in processes of their own."""

import multiprocessing
import os
import re
import signal
import sys
from functools import partial
from importlib import import_module

import pytest
import torch
from recipe_config import compose_config, run_recipe
from tensordict.nn import TensorDictModule

from coachable.networks import make_gaussian_actor
from coachable.styles import StyleReward, Term
from coachable.training import collection
from coachable.training.checkpoint import find_checkpoint, read_state
from coachable.training.collection import collector_state, load_collector_state, make_collector
from coachable.training.episodes import EpisodeSums
from coachable.training.simulators import UnsavableError
from coachable.transforms import coachable_env
from tests.echo import StyleEchoEnv, echo_space
from tests.recipes.test_every_combination import RECIPES, TINY


@pytest.fixture
def quick_starts():
    """Workers start in a moment as copies of a process that has imported what they need; by default each imports it."""
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("forkserver", force=True)
    multiprocessing.set_forkserver_preload(["coachable.training.trainer", "torchrl.collectors", "gymnasium", *RECIPES])
    yield
    multiprocessing.set_start_method(before, force=True)


def build(recipe, run_dir, *arguments):
    process = ["collector=process", "collector.num_collectors=1", "train.utd_ratio=0.5", f"run_dir={run_dir}"]
    return import_module(recipe).build(compose_config(recipe, [*TINY, *process, *arguments]))


def watch_actions(train, visit=lambda: None):
    """Lists how far the actions that arrive are from what the policy would do now; `visit` is called at each batch."""
    actor, store, distances = train.learner.loss_module.actor_network, train._store, []
    key = next(key for key in ("loc", "preferences") if key in actor.out_keys)

    def watch(data):
        arrived = data.contiguous().reshape(-1)
        with torch.no_grad():
            expected = actor[0](arrived.select(*actor[0].in_keys))[key]
        distances.append((expected - arrived[key]).abs().max().item())
        visit()
        store(data)

    train._store = watch
    return distances


def require_trained(train, distances):
    assert train.learner.updates >= 2
    assert max(distances[-2:]) < 1e-4, "the workers act with the weights of the last update"
    for name, value in train.learner.loss_module.named_parameters():
        assert torch.isfinite(value).all(), name


def start_of(module):
    return torch.cat([p.detach().flatten() for p in module.parameters()])


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_trains_with_a_worker(recipe, tmp_path, quick_starts):
    train = build(recipe, tmp_path)
    actor = train.learner.loss_module.actor_network
    before, distances = start_of(actor), watch_actions(train)
    train.run()
    require_trained(train, distances)
    assert not torch.equal(start_of(actor), before)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_all_processes_ends_workers_and_training(number, tmp_path, quick_starts):
    """Workers leave SIGINT to the training process, and SIGTERM ends them."""
    train = build("humanoid_sac", tmp_path, "collector.num_collectors=2", "train.total_frames=10_000")
    workers = [worker.pid for worker in train.collector.procs]

    def interrupt():
        if train.learner.updates >= 4:
            for process in (*workers, os.getpid()):
                os.kill(process, number)

    distances = watch_actions(train, interrupt)
    train.run()
    assert train.frames < 100
    require_trained(train, distances)
    assert (tmp_path / "checkpoints" / "LATEST").exists()
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_workers_start_as_by_default(tmp_path):
    train = build("humanoid_sac", tmp_path, "collector.num_collectors=2")
    distances = watch_actions(train)
    train.run()
    require_trained(train, distances)
    assert not multiprocessing.active_children()


def refuse(seed):
    raise ValueError("num_envs is 2: expected a multiple of three")


def test_an_error_of_the_environment_in_a_worker_is_one_sentence(monkeypatch, quick_starts, tmp_path):
    def build(config):
        actor = TensorDictModule(torch.nn.Linear(1, 1), in_keys=["observation"], out_keys=["action"])
        return make_collector(refuse, actor, frames_per_batch=2, backend="process")

    monkeypatch.setattr(sys, "argv", ["rare_targets.py", "preset=smoke", f"run_dir={tmp_path}"])
    with pytest.raises(SystemExit) as refused:
        run_recipe("rare_targets", build)
    assert refused.value.code == "error: num_envs is 2: expected a multiple of three"


class BreakingEnv(StyleEchoEnv):
    """Breaks in its ninth step, in the worker with the second seed."""

    def __init__(self, killed: bool, seed: int) -> None:
        super().__init__(seed=seed)
        self.killed = killed

    def _step(self, tensordict):
        if self.steps == 8 and self.generator.initial_seed() == collection._derived(0, 1):
            if self.killed:
                os.kill(os.getpid(), signal.SIGKILL)
            raise ZeroDivisionError("the pole has no length")
        return super()._step(tensordict)


def breaking_env(killed, seed):
    term = Term(lambda features, style: features[..., 0], parameters=("target",))
    reward = StyleReward(echo_space(), {"target": term})
    return coachable_env(BreakingEnv(killed, seed), echo_space(), reward, EpisodeSums(), seed=seed)


@pytest.mark.parametrize(
    ("killed", "end"),
    [
        (False, "raised ZeroDivisionError: the pole has no length"),
        (True, "ended with exit status -9"),  # as by the system when memory is short
    ],
)
def test_the_end_of_a_worker_in_a_later_step_is_one_sentence(
    killed, end, monkeypatch, quick_starts, make_train, tmp_path
):
    def build(config):
        train = make_train(tmp_path, checkpoint_interval=0)
        actor, make_env = train.learner.loss_module.actor_network, partial(breaking_env, killed)
        train.collector = make_collector(make_env, actor, frames_per_batch=8, backend="process", num_collectors=2)
        return train

    monkeypatch.setattr(sys, "argv", ["rare_targets.py", "preset=smoke", f"run_dir={tmp_path}"])
    with pytest.raises(SystemExit) as ended:
        run_recipe("rare_targets", build)
    stopped = r"The training stopped at env-step [1-9]\d*, without another checkpoint\."
    assert re.fullmatch(rf"error: a worker process {end}\. {stopped}", str(ended.value.code))
    assert not multiprocessing.active_children()
    assert read_state(find_checkpoint(tmp_path))["loop"]["frames"] > 0  # of an earlier iteration


def collected(seed, resumed=None):
    """Styles and actions of the first two batches of two workers."""
    torch.manual_seed(seed)
    actor = make_gaussian_actor(3, 1, echo_space(), (8,))
    collector = make_collector(
        partial(breaking_env, False), actor, frames_per_batch=16, backend="process", num_collectors=2, seed=seed
    )
    try:
        if resumed is not None:
            with pytest.raises(UnsavableError):
                load_collector_state(collector, resumed)
        batch = next(iter(collector)).contiguous()
        return batch["style"].clone(), batch["action"].clone(), collector_state(collector)
    finally:
        collector.shutdown()


def test_workers_have_seeds_of_their_own_and_new_ones_after_a_resumption(quick_starts):
    styles, actions, state = collected(0)
    again = collected(0)
    assert torch.equal(styles, again[0]) and torch.equal(actions, again[1])
    assert len(styles.unique()) == 2 * 4  # no two environments have the same style
    assert not torch.isin(collected(1)[0], styles).any()  # also not those of another training
    assert not torch.isin(collected(0, resumed=state)[0], styles).any()


class MirroredEnv(StyleEchoEnv):
    """Shows in its first observation what the policy that it follows does there."""

    def follow(self, policy):
        self.policy = policy

    def _step(self, tensordict):
        with torch.no_grad():
            loc = self.policy[0](tensordict.select(*self.policy[0].in_keys))["loc"]
        out = super()._step(tensordict)
        out["observation"][..., :1] = loc
        return out


def mirrored_env(seed):
    term = Term(lambda features, style: features[..., 0], parameters=("target",))
    reward = StyleReward(echo_space(), {"target": term})
    return coachable_env(MirroredEnv(seed=seed), echo_space(), reward, EpisodeSums(), seed=seed)


def test_an_environment_with_copies_of_the_policy_gets_the_newest_in_its_worker(quick_starts, make_train, tmp_path):
    train = make_train(tmp_path, total_frames=80, warmup_frames=20, utd_ratio=0.5)
    train.collector.shutdown()
    actor = train.learner.loss_module.actor_network
    train.collector = make_collector(mirrored_env, actor, frames_per_batch=4, backend="process")
    distances, store = [], train._store

    def watch(data):
        arrived = data.contiguous().reshape(-1)
        with torch.no_grad():
            expected = actor[0](arrived.select(*actor[0].in_keys))["loc"]
        distances.append((expected - arrived["next", "observation"][..., :1]).abs().max().item())
        store(data)

    train._store = watch
    train.run()
    assert train.learner.updates > 20 and max(distances) < 1e-4

"""StyleRewardTransform: the reward while collecting is the one computed from stored transitions, bit for bit."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    Compose,
    ExcludeTransform,
    RenameTransform,
    RewardSum,
    SerialEnv,
    Transform,
    TransformedEnv,
    check_env_specs,
    step_mdp,
)

from coachable.transforms import StyleRewardTransform, StyleSampler, coachable_env


@pytest.fixture
def make_env(space, make_style_reward, make_base_env):
    def make(num_envs=4, seed=0, rewards_apart=False, transforms=()):
        base = make_base_env(num_envs, rewards_apart=rewards_apart)
        return coachable_env(base, space, make_style_reward(space), *transforms, seed=seed)

    return make


@pytest.mark.parametrize("rewards_apart", [False, True])
def test_specs(make_env, rewards_apart):
    env = make_env(rewards_apart=rewards_apart)
    check_env_specs(env)
    # the task reward is bounded by [0, 1], the sum is not
    assert isinstance(env.full_reward_spec["reward"], Unbounded)
    home = env.full_reward_spec if rewards_apart else env.observation_spec
    assert {"style_reward", "task_reward"} <= set(home.keys())


@pytest.mark.parametrize("rewards_apart", [False, True])
def test_reward_of_stored_transitions_is_bitwise_equal(make_env, space, make_style_reward, rewards_apart):
    rollout = make_env(num_envs=8, rewards_apart=rewards_apart).rollout(40, break_when_any_done=False)
    reward = make_style_reward(space)  # another instance, as the learner's process has
    for stored in (rollout, rollout.contiguous(), rollout.contiguous().reshape(-1)):
        style_reward = reward(stored["next", "style_features"], stored["style"])
        assert stored["next", "style_reward"].equal(style_reward)
        assert stored["next", "reward"].equal(stored["next", "task_reward"] + style_reward)
        assert stored["next", "reward"].dtype == torch.float32
    assert rollout["next", "style_reward"].abs().min() > 0


def test_reward_of_expanded_samples_is_bitwise_equal(make_env, space, make_style_reward):
    """[B] to [B, n+1] with the original style in column 0, as relabelling does."""
    rollout = make_env(num_envs=8).rollout(40, break_when_any_done=False)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(320), batch_size=64)
    buffer.extend(rollout.contiguous().reshape(-1))
    sample = buffer.sample()
    reward = make_style_reward(space)
    wide = sample.unsqueeze(1).expand(64, 5)
    for batch in (wide, wide.clone()):
        batch = batch.clone(recurse=False)
        theta = batch["style"].clone()
        theta[:, 1:] = space.sample((64, 4))
        total = batch["next", "task_reward"] + reward(batch["next", "style_features"], theta)
        assert total.shape == (64, 5, 1)
        assert total[:, 0].equal(sample["next", "reward"])
        for column in range(1, 5):
            alone = sample["next", "task_reward"] + reward(sample["next", "style_features"], theta[:, column])
            assert total[:, column].equal(alone)


def test_uses_the_style_that_the_policy_saw(make_env, space, make_style_reward):
    env, reward = make_env(), make_style_reward(space)
    td = env.reset()
    for _ in range(5):
        td["style"] = space.sample((4,))
        seen = td["style"].clone()
        out = env.step(env.rand_action(td))
        assert out["next", "style_reward"].equal(reward(out["next", "style_features"], seen))
        td = step_mdp(out)


def test_collected_batches(make_env, space, make_style_reward):
    collector = Collector(make_env(num_envs=8), None, frames_per_batch=80, total_frames=160)
    reward = make_style_reward(space)
    for batch in collector:
        style_reward = reward(batch["next", "style_features"], batch["style"])
        assert batch["next", "reward"].equal(batch["next", "task_reward"] + style_reward)
    collector.shutdown()


def test_rewards_of_an_environment_in_float64_have_the_declared_dtype(make_base_env, space, make_style_reward):
    base = make_base_env()
    base.reward_spec = base.reward_spec.to(torch.float64)  # the task reward is float32
    env = coachable_env(base, space, make_style_reward(space), seed=0)
    assert env.reward_spec.dtype == env.rollout(3)["next", "reward"].dtype == torch.float32


def test_style_rewards_are_float32_beside_a_task_reward_in_float64(make_base_env, space, make_style_reward):
    base = make_base_env()
    spec = base.observation_spec.clone()
    spec["task_reward"] = Unbounded((*base.batch_size, 1), dtype=torch.float64)
    base.observation_spec = spec

    def with_wide_task_reward(function):
        def call(tensordict=None, **options):
            out = function(tensordict, **options)
            return out.set("task_reward", out["task_reward"].double())

        return call

    base._step, base._reset = with_wide_task_reward(base._step), with_wide_task_reward(base._reset)
    env = coachable_env(base, space, make_style_reward(space), seed=0)
    assert env.reset()["style_reward"].dtype == env.rollout(3)["next", "style_reward"].dtype == torch.float32


def test_inside_serial_env(make_env, space, make_style_reward):
    env = SerialEnv(2, make_env)
    check_env_specs(env)
    rollout = env.rollout(10, break_when_any_done=False)
    expected = make_style_reward(space)(rollout["next", "style_features"], rollout["style"])
    assert rollout["next", "style_reward"].equal(expected)
    env.close()


def test_reset_emits_a_zero_style_reward_beside_the_task_reward(make_env):
    assert make_env().reset()["style_reward"].eq(0).all()
    assert "style_reward" not in make_env(rewards_apart=True).reset()


def test_style_reward_can_be_summed_over_episodes(make_env):
    sums = RewardSum(in_keys=["reward", "style_reward"])
    env = make_env(rewards_apart=True, transforms=(sums,))
    check_env_specs(env)
    rollout = env.rollout(5)
    torch.testing.assert_close(
        rollout["next", "episode_style_reward"][:, 0], rollout["next", "style_reward"][:, 0], rtol=0, atol=0
    )


def test_what_is_missing_is_named(space, make_style_reward, make_base_env):
    base, reward = make_base_env(), make_style_reward(space)
    lonely = TransformedEnv(base, StyleRewardTransform(reward))
    with pytest.raises(KeyError, match=r"step got no style.*put a StyleSampler before"):
        lonely.step(lonely.rand_action(lonely.reset()))
    rename = RenameTransform(["style_features"], ["features"])
    wrong = TransformedEnv(base, Compose(rename, StyleSampler(space), StyleRewardTransform(reward)))
    with pytest.raises(KeyError, match=r"emitted .*features.* expects task_reward and style_features"):
        wrong.step(wrong.rand_action(wrong.reset()))


def test_an_environment_without_task_reward_is_told_how_to_add_it(space, make_style_reward, make_base_env):
    base = TransformedEnv(make_base_env(), ExcludeTransform("task_reward", "style_features"))
    with pytest.raises(KeyError, match=r"declare observation, reward, style: .* expects task_reward and .*; add"):
        coachable_env(base, space, make_style_reward(space)).rollout(2)


def test_nested_features_are_refused_when_the_specs_are_read(space, make_style_reward, make_base_env):
    env = coachable_env(make_base_env(nested=True), space, make_style_reward(space))
    with pytest.raises(ValueError, match=r"declare style_features with the entries values: expected one tensor"):
        _ = env.observation_spec


class Squeezed(Transform):
    """An environment that forgets the last dimension of an entry."""

    def __init__(self, key):
        super().__init__()
        self.key = key

    def _step(self, tensordict, next_tensordict):
        return next_tensordict.set(self.key, next_tensordict[self.key][..., 0])


@pytest.mark.parametrize(
    "key, message",
    [
        ("style_features", r"style_features is \(4,\): expected \(4, F\)"),
        ("task_reward", r"task_reward is \(4,\): expected \(4, 1\)"),
    ],
)
def test_entries_without_a_last_dimension_are_refused(key, message, make_base_env, space, make_style_reward):
    """They would broadcast, so that every environment was paid for the features of another one."""
    transforms = Compose(Squeezed(key), StyleSampler(space, seed=0), StyleRewardTransform(make_style_reward(space)))
    env = TransformedEnv(make_base_env(4), transforms)
    with pytest.raises(ValueError, match=message):
        env.rand_step(env.reset())

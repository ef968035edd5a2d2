"""StyleSampler and CoachableEnv: seeds, resets, imposed styles, workers, checkpoints, collectors."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
    step_mdp,
)

from coachable.styles import PointMass, Product, StyleRangeWarning, Uniform, UniformChoice
from coachable.transforms import CoachableEnv, StyleSampler, coachable_env


@pytest.fixture
def make_env(space, make_style_reward, make_base_env):
    def make(num_envs=4, seed=None, p_done=0.2):
        reward = make_style_reward(space)
        return coachable_env(make_base_env(num_envs, p_done), space, reward, StepCounter(10), seed=seed)

    return make


def styles_after(env, seed, steps=12):
    env.set_seed(seed)
    return env.rollout(steps, break_when_any_done=False)["style"]


def changed(rollout):
    """Where the style of the next row differs, (N, T-1)."""
    return (rollout["style"][:, 1:] != rollout["style"][:, :-1]).any(-1)


def test_specs(make_env, space):
    env = make_env()
    check_env_specs(env, seed=0)
    spec = env.observation_spec["style"]
    assert spec.shape == (4, 4) and spec.dtype == torch.float32
    assert spec.space.low[2].equal(space.low) and spec.space.high[1].equal(space.high)
    assert "style" in set(env.state_spec.keys())
    space.validate(env.reset()["style"])


def test_style_changes_exactly_when_an_episode_ends(make_env, space):
    rollout = make_env(num_envs=8, seed=0).rollout(60, break_when_any_done=False)
    done = rollout["next", "done"][:, :-1, 0]
    assert done.any() and not done.all(0).any()  # resets are partial
    assert changed(rollout).equal(done)
    # the transition that ends an episode still carries the old style on both sides
    assert rollout["next", "style"].equal(rollout["style"])
    space.validate(rollout["style"])


def test_seeds(make_env):
    env = make_env()
    first = styles_after(env, 3)
    assert styles_after(env, 3).equal(first)
    assert styles_after(make_env(), 3).equal(first)
    assert not styles_after(env, 4).equal(first)
    assert make_env(seed=3).reset()["style"].equal(first[:, 0])


def test_set_seed_returns_the_next_seed(make_env, make_base_env):
    assert make_env().set_seed(5) == make_base_env().set_seed(5)
    assert make_env().set_seed(5, static_seed=True) == 5


def test_a_lone_sampler_is_seeded_too(space, make_base_env):
    draws = []
    for _ in range(2):
        env = CoachableEnv(make_base_env(), StyleSampler(space))
        env.set_seed(0)
        draws.append(env.reset()["style"])
    assert draws[0].equal(draws[1])


def test_more_transforms_around_keep_the_seed(make_env):
    draws = [styles_after(TransformedEnv(make_env(), StepCounter(step_count_key="steps")), 7) for _ in range(2)]
    assert draws[0].equal(draws[1])


def test_unseeded_environments_differ(make_env):
    assert not make_env().reset()["style"].equal(make_env().reset()["style"])


def test_styles_are_not_the_numbers_of_the_environment(space):
    """An environment seeded with the same number draws its start states from the same stream: not the styles."""
    sampler = StyleSampler(space, seed=11)
    assert sampler.generator.initial_seed() != 11
    other = space.with_sampler(Product([UniformChoice(2), Uniform([0.3, 0.0], [0.65, 1.0])]))
    assert StyleSampler(other, seed=11).generator.initial_seed() == sampler.generator.initial_seed()
    seeds = {StyleSampler(space, seed=seed).generator.initial_seed() for seed in range(-5, 200)}
    assert len(seeds) == 205


def test_styles_are_drawn_from_the_sampler_of_the_space(space, make_style_reward, make_base_env):
    corner = space.with_sampler(PointMass([0.0, 1.0, 0.65, 105.0]))
    env = coachable_env(make_base_env(), corner, make_style_reward(corner))
    assert env.reset()["style"].equal(torch.tensor([0.0, 1.0, 0.65, 105.0]).expand(4, 4))


def test_imposed_at_reset(make_env, space):
    env = make_env(p_done=0.0)
    theta = space.sample((4,))
    reset = env.reset(TensorDict({"style": theta}, [4]))
    assert reset["style"].equal(theta)
    rollout = env.rollout(5, auto_reset=False, tensordict=reset)
    assert rollout["style"].equal(theta.unsqueeze(1).expand(4, 5, 4))
    theta.fill_(9.0)  # the caller's tensor is not the environment's
    assert rollout["style"].max() < 106 and not reset["style"].eq(9).any()


def test_imposed_styles_may_leave_the_range_but_not_be_nan(make_env, space):
    env = make_env()
    beyond = (space.high * 1.5).expand(4, -1)
    assert env.reset(TensorDict({"style": beyond}, [4]))["style"].equal(beyond)
    with pytest.raises(ValueError, match=r"none of them NaN, for \['pose', 'length', 'fuel'\]"):
        env.reset(TensorDict({"style": torch.full((4, 4), torch.nan)}, [4]))
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 4\) numbers"):
        env.reset(TensorDict({"style": torch.zeros(4, 3)}, [4]))


def test_imposed_at_a_partial_reset(make_env, space):
    env = make_env(p_done=0.0)
    td = env.rollout(2)[:, -1]["next"].exclude("reward", "style_reward")
    before, theta = td["style"].clone(), space.sample((4,))
    mask = torch.tensor([[True], [False], [True], [False]])
    td = env.reset(td.set("style", theta).set("_reset", mask))
    rows = mask.squeeze(-1)
    assert td["style"][rows].equal(theta[rows])
    # rows that are not reset keep what the tensordict says, as TorchRL does for every entry
    assert td["style"][~rows].equal(theta[~rows]) and not before.equal(theta)


def test_changed_in_mid_episode(make_env, space):
    env = make_env(p_done=0.0)
    td = env.reset()
    old, new = td["style"].clone(), space.sample((4,))
    first = env.step(env.rand_action(td))
    td = step_mdp(first)
    td["style"] = new
    second = env.step(env.rand_action(td))
    assert first["style"].equal(old) and first["next", "style"].equal(old)
    assert second["style"].equal(new) and second["next", "style"].equal(new)
    reward = env.transform[1].style_reward
    assert second["next", "style_reward"].equal(reward(second["next", "style_features"], new))
    assert step_mdp(second)["style"].equal(new)


def test_writing_in_place_does_not_rewrite_history(make_env):
    env = make_env(p_done=0.0)
    td = env.step(env.rand_action(env.reset()))
    old = td["style"].clone()
    following = step_mdp(td)
    following["style"].fill_(0.5)
    assert td["style"].equal(old)


def test_hold_and_release(make_env, space):
    env = make_env(num_envs=8, seed=0, p_done=0.4)
    theta = space.make(pose="b", length=0.5)
    env.hold_style(theta)
    rollout = env.rollout(20, break_when_any_done=False)
    assert rollout["next", "done"].any() and rollout["style"].eq(theta).all()
    each = space.sample((8,))
    env.hold_style(each)
    assert env.rollout(20, break_when_any_done=False)["style"].eq(each.unsqueeze(1)).all()
    # an explicit style wins over the held one
    other = space.sample((8,))
    assert env.reset(TensorDict({"style": other}, [8]))["style"].equal(other)
    env.release_style()
    assert changed(env.rollout(20, break_when_any_done=False)).any()


def test_hold_clamps_or_raises(make_env, space):
    env = make_env()
    far = space.make(length=0.5)
    far[2] = 2.0
    with pytest.warns(StyleRangeWarning, match="length = 2 m"):
        env.hold_style(far)
    assert env.reset()["style"][:, 2].eq(space.high[2]).all()
    with pytest.raises(ValueError, match="length = 2 m"):
        env.hold_style(far, strict=True)
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 4\)"):
        env.hold_style(torch.zeros(3))
    with pytest.raises(RuntimeError, match="no StyleSampler"):
        CoachableEnv(env.base_env, Compose()).hold_style(far)


def test_a_sampler_clamps_what_it_holds_unless_it_is_strict(space):
    far = space.make(length=0.5)
    far[2] = 2.0
    sampler = StyleSampler(space)
    with pytest.warns(StyleRangeWarning, match="length = 2 m"):
        sampler.hold(far)
    with pytest.raises(ValueError, match="length = 2 m"):
        sampler.hold(far, strict=True)


def test_holding_does_not_advance_the_stream(make_env, space):
    env, twin = make_env(seed=1), make_env(seed=1)
    env.hold_style(space.default)
    env.reset()
    env.release_style()
    assert env.reset()["style"].equal(twin.reset()["style"])


def test_state_dict_continues_the_stream(make_env):
    env = make_env(seed=0)
    env.reset()
    state = copy.deepcopy(env.state_dict())
    expected = [env.reset()["style"] for _ in range(3)]
    restored = make_env(seed=99)
    restored.load_state_dict(state)
    assert all(restored.reset()["style"].equal(style) for style in expected)


def test_state_dict_is_loadable_without_pickle(make_env, tmp_path):
    env = make_env(seed=0)
    torch.save(env.state_dict(), tmp_path / "env.pt")
    expected = env.reset()["style"]
    env.load_state_dict(torch.load(tmp_path / "env.pt", weights_only=True))
    assert env.reset()["style"].equal(expected)


def test_pickled_samplers_keep_a_seed_and_otherwise_get_a_new_one(space):
    for copied in (copy.deepcopy, lambda transform: pickle.loads(pickle.dumps(transform))):
        seeded = StyleSampler(space, seed=1)
        assert copied(seeded).generator.get_state().equal(seeded.generator.get_state())
        unseeded = StyleSampler(space)
        assert not copied(unseeded).generator.get_state().equal(unseeded.generator.get_state())


def assert_workers_differ_and_repeat(env, space):
    first = styles_after(env, 3, steps=30)  # (workers, N, T, d)
    assert not first[0].equal(first[1])
    assert styles_after(env, 3, steps=30).equal(first)
    rollout = env.rollout(30, break_when_any_done=False)
    moved = (rollout["style"][:, :, 1:] != rollout["style"][:, :, :-1]).any(-1)
    assert moved.equal(rollout["next", "done"][:, :, :-1, 0]) and moved.any()
    theta = space.sample((2, 4))
    assert env.reset(TensorDict({"style": theta}, [2, 4]))["style"].equal(theta)
    held = space.make(pose="b")
    env.hold_style(held)
    assert env.rollout(30, break_when_any_done=False)["style"].eq(held).all()
    env.release_style()
    env.reset()
    state = copy.deepcopy(env.state_dict())
    expected = env.reset()["style"]
    env.load_state_dict(state)
    assert env.reset()["style"].equal(expected)


def test_inside_serial_env(make_env, space):
    env = SerialEnv(2, make_env)
    check_env_specs(env, seed=0)
    assert not env.reset()["style"][0].equal(env.reset()["style"][1])
    assert_workers_differ_and_repeat(env, space)
    env.close()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_inside_parallel_env(make_env, space):
    env = ParallelEnv(2, make_env, mp_start_method="fork")
    try:
        unseeded = env.reset()["style"]
        assert not unseeded[0].equal(unseeded[1])
        assert_workers_differ_and_repeat(env, space)
    finally:
        env.close()


def test_around_serial_env(space, make_style_reward, make_base_env):
    env = coachable_env(SerialEnv(2, make_base_env), space, make_style_reward(space), seed=0)
    check_env_specs(env)
    first = styles_after(env, 3)
    assert first.shape == (2, 4, 12, 4) and styles_after(env, 3).equal(first)
    env.close()


def test_collector(make_env, space):
    collector = Collector(make_env(num_envs=8, seed=0), None, frames_per_batch=160, total_frames=480)
    seen = []
    for batch in collector:
        assert batch.shape == (8, 20)
        space.validate(batch["style"])
        assert changed(batch).equal(batch["next", "done"][:, :-1, 0])
        assert batch["next", "style"].equal(batch["style"])
        seen.append(batch["style"].clone())
    collector.shutdown()
    assert len(seen) == 3
    again = Collector(make_env(num_envs=8, seed=0), None, frames_per_batch=160, total_frames=160)
    assert next(iter(again))["style"].equal(seen[0])
    again.shutdown()


def test_reward_sum_beside(space, make_style_reward, make_base_env):
    env = coachable_env(make_base_env(p_done=0.0), space, make_style_reward(space), RewardSum())
    check_env_specs(env, seed=0)
    rollout = env.rollout(6)
    expected = rollout["next", "reward"].cumsum(1)
    torch.testing.assert_close(rollout["next", "episode_reward"], expected)


def test_simulators_that_reset_themselves_are_refused(make_env):
    env = make_env()
    with pytest.raises(NotImplementedError, match="native_autoreset=False"):
        env._reset_on_native_autoreset(env.reset(), env.reset())

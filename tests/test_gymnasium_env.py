"""`GymnasiumEnv`: an environment of Gymnasium trains here."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import check_env_specs
from torchrl.objectives import SACLoss

from coachable.networks import make_critic, make_gaussian_actor
from coachable.styles import Setpoint, StyleReward, StyleSpace, Term
from coachable.training import Learner
from coachable.training.collection import evaluate_policy, make_collector
from coachable.training.episodes import EpisodeSums
from coachable.training.logging import MetricsLog, Progress
from coachable.training.train_settings import TrainSettings
from coachable.training.trainer import Trainer
from coachable.transforms import coachable_env

gymnasium = pytest.importorskip("gymnasium")
from gymnasium import spaces  # noqa: E402

from coachable.gym import GymnasiumEnv  # noqa: E402
from coachable.gym.actions import action_components, native_action  # noqa: E402
from tests.gym_walk import SPACE, STEPS, Walk, moved, style_reward  # noqa: E402


@pytest.mark.parametrize(
    "make, features",
    [
        (Walk, moved),
        ("CartPole-v1", lambda observation, action, info: [observation[0], action]),
        ("Pendulum-v1", lambda observation, action, info: observation[2:]),
    ],
)
def test_torchrl_approves(make, features):
    env = GymnasiumEnv(make, features, num_envs=3, seed=0)
    check_env_specs(env)
    env.close()


def test_a_batch_equals_its_environments_one_by_one():
    env = GymnasiumEnv(Walk, moved, num_envs=3, seed=7)
    rollout = env.rollout(12, policy=env.rand_action, break_when_any_done=False, auto_cast_to_device=False)
    seeds = np.random.SeedSequence(7).generate_state(3).tolist()
    for row, seed in enumerate(seeds):
        walk = Walk()
        observation, _ = walk.reset(seed=seed)
        for step in rollout[row].unbind(0):
            np.testing.assert_array_equal(step["observation"], observation)
            observation, reward, terminated, truncated, _ = walk.step(step["action"].numpy())
            after = step["next"]
            np.testing.assert_array_equal(after["observation"], observation)
            assert after["task_reward"].item() == after["reward"].item() == reward
            assert after["terminated"].item() == terminated and after["truncated"].item() == truncated
            np.testing.assert_array_equal(after["style_features"], step["action"])
            if terminated or truncated:
                observation, _ = walk.reset()


def test_a_partial_reset_touches_nothing_else():
    env = GymnasiumEnv(Walk, moved, num_envs=3, seed=0)
    before = env.rollout(2)[:, -1]["next"]
    mask = torch.tensor([[False], [True], [False]])
    after = env.reset(before.select("observation").set("_reset", mask))
    np.testing.assert_array_equal(after["observation"][[0, 2]], before["observation"][[0, 2]])
    assert after["observation"][1, 1] == 0


def test_an_ended_episode_may_be_stepped_on():
    """Evaluation goes on with the others, and no longer counts this one."""
    env = GymnasiumEnv(Walk, moved, num_envs=2, seed=0)
    current = env.reset()
    for step in range(STEPS + 2):
        current = env.step(current.set("action", torch.zeros(2, 1)))["next"]
        assert current["truncated"].all() == (step == STEPS - 1)
        current = current.exclude("reward", "task_reward", "style_features")
    assert current["observation"][0, 1].item() == pytest.approx(2 / STEPS)


def test_one_seed_one_run():
    rollouts = []
    for _ in range(2):
        torch.manual_seed(0)
        env = coachable_env(GymnasiumEnv(Walk, moved, num_envs=2), SPACE, style_reward(), seed=4)
        rollouts.append(env.rollout(12, break_when_any_done=False))
    assert (rollouts[0] == rollouts[1]).all()


def test_every_component_of_an_action_space():
    space = spaces.Dict(
        {
            "buttons": spaces.MultiDiscrete([3, 2]),
            "jump": spaces.Discrete(4, start=2),
            "sticks": spaces.Tuple([spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64)]),
            "switch": spaces.MultiBinary(2),
        }
    )
    assert action_components(space) == ([3, 2, 4, 2, 2], 2)
    action = native_action(space, iter([2, 0, 1, 1, 0]), iter([0.5, -1.0]))
    assert space.contains(action)
    np.testing.assert_array_equal(action["buttons"], [2, 0])
    assert action["jump"] == 3
    np.testing.assert_allclose(action["sticks"][0], [1.0, 0.0])
    np.testing.assert_array_equal(action["switch"], [1, 0])


@pytest.mark.parametrize(
    "space", [spaces.Box(-np.inf, np.inf, (2,)), spaces.Text(3), spaces.Discrete(1), spaces.MultiDiscrete([2, 1])]
)
def test_other_action_spaces_are_refused(space):
    class Odd(Walk):
        action_space = space

    with pytest.raises(ValueError, match="not supported: expected Box with finite bounds"):
        GymnasiumEnv(Odd, moved)


@pytest.mark.parametrize("count", [1, 3])
def test_features_of_a_changing_number_are_refused(count):
    env = GymnasiumEnv(Walk, lambda o, a, i: [1.0] * (2 if o[1] == 1 / STEPS else count), num_envs=2)
    with pytest.raises(ValueError, match=f"features returned {count} numbers: expected 2, as at first"):
        env.rollout(2)


def test_features_that_are_no_row_of_numbers_are_refused():
    with pytest.raises(ValueError, match=r"features returned \[\[1.0\], \[1.0, 2.0\]\]: expected \(F,\), the numbers"):
        GymnasiumEnv(Walk, lambda o, a, i: [[1.0], [1.0, 2.0]])


def test_an_observation_without_a_key_of_its_space_is_refused():
    class Halved(Walk):
        observation_space = spaces.Dict(left=Walk.observation_space, right=Walk.observation_space)

        def _observation(self):
            return {"left": super()._observation()}

    with pytest.raises(ValueError, match=r"does not fit its space Dict\(.*\) \(KeyError: 'right'\): \{'left'"):
        GymnasiumEnv(Halved, lambda o, a, i: [1.0]).reset()


def test_an_observation_of_another_size_than_its_space_is_refused():
    class Short(Walk):
        def _observation(self):
            return super()._observation()[:1]

    with pytest.raises(ValueError, match="an observation has 1 numbers: expected 2, as its space has"):
        GymnasiumEnv(Short, moved).reset()


def test_an_environment_in_place_of_a_function_that_makes_one_is_refused():
    with pytest.raises(ValueError, match="expected the name of a registered environment, or a function that makes one"):
        GymnasiumEnv(gymnasium.make("Pendulum-v1"), lambda obs, action, info: obs)


def test_copies_that_are_not_separate_environments_are_refused():
    walk = Walk()
    with pytest.raises(ValueError, match="make returned the same Walk twice: expected a new environment at each call"):
        GymnasiumEnv(lambda: gymnasium.wrappers.TimeLimit(walk, 3), moved, num_envs=2)
    assert GymnasiumEnv(lambda: walk, moved, num_envs=1).envs == [walk]
    with pytest.raises(ValueError, match="make returned a SyncVectorEnv, which holds several environments"):
        GymnasiumEnv(lambda: gymnasium.vector.SyncVectorEnv([Walk, Walk]), moved)


def test_an_action_of_another_width_is_refused():
    env = GymnasiumEnv(Walk, moved, num_envs=1)
    with pytest.raises(ValueError, match=r"action has the shape \(1, 3\): expected \(1, 1\)"):
        env.step(env.reset().set("action", torch.zeros(1, 3)))


def test_a_diverged_policy_is_named():
    env = GymnasiumEnv(Walk, moved, num_envs=1)
    with pytest.raises(ValueError, match="NaN"):
        env.step(env.reset().set("action", torch.full((1, 1), torch.nan)))


def test_training_on_a_gymnasium_environment(tmp_path):
    """Our loop, unchanged, learns the requested stride: its error falls from about 0.5 to below 0.2."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    space = StyleSpace([Setpoint("stride", -0.5, 0.5)])
    reward = StyleReward(space, {"stride": Term(lambda f, s: -(f[..., 0] - s["stride"]).abs(), parameters=("stride",))})

    def make_env(seed, num_envs=16):
        return coachable_env(GymnasiumEnv(Walk, moved, num_envs, seed=seed), space, reward, EpisodeSums(), seed=seed)

    actor = make_gaussian_actor(2, 1, space, (32,))
    critics = [make_critic(2, 1, space, (32,)) for _ in range(2)]
    loss = SACLoss(
        actor, critics, action_spec=make_env(0).action_spec[0], loss_function="l2", fixed_alpha=True, alpha_init=0.01
    )
    loss.make_value_estimator(gamma=0.9)
    Trainer(
        collector=make_collector(make_env, actor, frames_per_batch=16, init_random_frames=200),
        replay=TensorDictReplayBuffer(storage=LazyTensorStorage(5000)),
        learner=Learner(loss, actor_lr=3e-3, critic_lr=3e-3, precision="fp32"),
        settings=TrainSettings(total_frames=2400, batch_size=64, warmup_frames=200, utd_ratio=0.1),
        log=MetricsLog(tmp_path),
        progress=Progress(2400, every=1e9),
        checkpoints=None,
        describe=dict,
    ).run()
    outcome = evaluate_policy(make_env(1, 64), actor, max_steps=STEPS)
    assert (outcome["task_return"] - outcome["return"]) / outcome["length"] < 0.2


def test_the_documented_program_runs():
    text = (Path(__file__).resolve().parent.parent / "docs" / "guides" / "gymnasium.md").read_text()
    exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), {})


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.Box(-100, 100, (1,), np.int8), [-100, -50, 0, 50, 100]),
        (spaces.Box(-1, 1, (1,), np.int64), [-1, 0, 0, 0, 1]),
        (spaces.Box(0, 3, (1,), np.int32), [0, 1, 2, 2, 3]),
        (spaces.Box(-60000, 60000, (1,), np.float16), [-60000, -30000, 0, 30000, 60000]),
    ],
)
def test_boxes_of_small_types_are_scaled_and_rounded(space, expected):
    units = (-0.999, -0.5, 0.0, 0.5, 0.999)  # a tanh does not reach the ends
    taken = [native_action(space, iter(()), iter([unit])) for unit in units]
    assert all(action in space for action in taken)
    np.testing.assert_allclose([action[0] for action in taken], expected, rtol=0.01)


def test_wrappers_with_running_means_start_alike_with_the_same_seed():
    def make():
        return gymnasium.wrappers.NormalizeObservation(Walk())

    starts = [GymnasiumEnv(make, moved, 2, seed=0).reset()["observation"] for _ in range(2)]
    torch.testing.assert_close(*starts, rtol=0, atol=0)


def returns(*result):
    class Odd(Walk):
        def step(self, action):
            observation, *_, info = super().step(action)
            return (observation, *result, info)

    return Odd


@pytest.mark.parametrize(
    "result, message",
    [
        ((None, False, False), "step returned reward=None: expected one number"),
        (("1.5", False, False), "step returned reward='1.5'"),
        ((np.ones(2), False, False), r"step returned reward=array\(\[1., 1.\]\)"),
        ((1.0, "False", False), "step returned terminated='False'"),
        ((1.0, False, None), "step returned truncated=None"),
        ((1.0, False), "step returned 4 values: expected observation, reward, terminated, truncated and info"),
    ],
)
def test_results_of_a_step_that_are_no_numbers_are_refused(result, message):
    with pytest.raises(ValueError, match=message):
        GymnasiumEnv(returns(*result), moved)


def test_a_reward_may_be_an_array_of_one_number():
    env = GymnasiumEnv(returns(np.array([1.5]), np.array(False), np.bool_(True)), moved, num_envs=1)
    after = env.rand_step(env.reset())["next"]
    assert after["task_reward"].item() == 1.5 and after["truncated"].item() and not after["terminated"].item()


def test_a_function_that_makes_no_environment_is_refused():
    with pytest.raises(ValueError, match="make returned None: expected an environment of Gymnasium"):
        GymnasiumEnv(lambda: None, moved)

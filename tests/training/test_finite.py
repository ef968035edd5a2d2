"""Numbers that are not finite stop a training before they reach replay or a weight; checkpoints stay as they were."""

import math

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from coachable.finite import LARGEST, NonFiniteError, require_finite
from coachable.gym import GymnasiumEnv
from coachable.styles import StyleReward, Term
from coachable.training.checkpoint import CheckpointStore, find_checkpoint, read_state
from coachable.training.episodes import EpisodeSums
from coachable.transforms import coachable_env
from tests import echo

BAD = [math.nan, math.inf, -math.inf, 1e30]
BEFORE = 12  # env-steps of four environments until the number appears, 8 of them after the warm-up
RANDOM = 40  # env-steps before the policy acts


@pytest.fixture
def training(make_train, tmp_path):
    """Makes a training with a checkpoint after every batch."""

    def make(**options):
        checkpoints = CheckpointStore(tmp_path / "run" / "checkpoints", keep=1, replay=False)
        settings = {"warmup_frames": 4, "batch_size": 4, "checkpoint_interval": 0.0, "checkpoints": checkpoints}
        return make_train(total_frames=400, **settings, **options)

    return make


def poisoned(train, values, after=BEFORE):
    simulation = train.collector.env.base_env
    simulation.poison, simulation.poisoned_from = values, after // 4 + 1
    return train


def assert_stops(train, message, before=BEFORE, collected=BEFORE + 4):
    with pytest.raises(NonFiniteError, match=message) as stopped:
        train.run()
    assert str(stopped.value).endswith(f"stopped at env-step {collected}, without another checkpoint.")
    assert len(train.replay) == before
    state = read_state(find_checkpoint(train.checkpoints.directory.parent))
    assert state["loop"]["frames"] == before, "nothing was saved after the number appeared"
    for name, value in train.learner.loss_module.state_dict().items():
        assert torch.isfinite(value).all() and torch.equal(value, state["learner"]["loss_module"][name]), name


def words(value):
    return f"{value:g}".replace("+", r"\+")


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("key", ["observation", "task_reward", "style_features"])
def test_what_an_environment_emits(training, key, bad):
    message = rf"next/{key} is {words(bad)}.* in environment 1, step 1 of 1 of the last batch"
    assert_stops(poisoned(training(), {key: bad}), message)


@pytest.mark.parametrize("bad", BAD)
def test_what_a_style_term_returns(training, monkeypatch, bad):
    def term(features, style):
        return torch.where(features[..., 0] == 7.0, bad, 0.0) + 0.0 * style["target"]

    monkeypatch.setattr(echo, "_distance", term)
    train = poisoned(training(), {"style_features": 7.0})
    assert_stops(train, rf"^next/reward is {words(bad)} in environment 1")


def test_features_whose_infinity_no_reward_shows(training, monkeypatch):
    monkeypatch.setattr(
        echo, "_distance", lambda features, style: 1 / (1 + features[..., 0] ** 2) + 0 * style["target"]
    )
    assert_stops(poisoned(training(), {"style_features": math.inf}), "^next/style_features is inf in environment 1")


@pytest.mark.parametrize("bad", BAD)
def test_a_style(training, bad):
    train = training()
    # Four environments have their first styles: nothing is stored before.
    train.collector._carrier["style"][2] = bad
    with pytest.raises(NonFiniteError, match=rf"style is {words(bad)}.* in environment 2"):
        train.run()
    assert len(train.replay) == 0 and not train.checkpoints.directory.exists()


def spoil_weights(train, after):
    """Makes the policy's weights NaN behind the learner's back, after so many env-steps."""
    weights = next(iter(train.learner.loss_module.actor_network_params.values(True, True)))
    simulation = train.collector.env.base_env
    steps, step = iter(range(1, 1000)), simulation._step

    def spoil(tensordict):
        if 4 * next(steps) == after:
            weights.data.fill_(math.nan)
        return step(tensordict)

    simulation._step = spoil
    train._update = lambda *_: None  # which would notice it first
    train.checkpoints = None
    return train


def test_actions_of_a_policy_whose_weights_are_not_finite(training):
    train = spoil_weights(training(), RANDOM)
    with pytest.raises(NonFiniteError, match=r"action is nan.* in environment 0, step 1 of 1"):
        train.run()
    assert len(train.replay) == RANDOM


def test_weights_that_are_not_finite_from_the_start(training):
    train = training()
    next(iter(train.learner.loss_module.actor_network_params.values(True, True))).data.fill_(math.nan)
    with pytest.raises(NonFiniteError, match=r"actor_network_params\S+ contains NaN or infinity"):
        train.run()


class Faulty(gymnasium.Env):
    """Three numbers, one axis; something is NaN at the seventh step of the second copy."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    made = 0

    def __init__(self, fault: str) -> None:
        self.fault, self.steps = fault, 0
        self.number, Faulty.made = Faulty.made, Faulty.made + 1

    def reset(self, *, seed=None, options=None):
        return np.zeros(3, dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        nan = math.nan if self.steps > BEFORE // 4 and self.number == 1 else 0.0
        observation = np.full(3, nan if self.fault == "observation" else 0.0, dtype=np.float32)
        return observation, nan if self.fault == "task_reward" else 0.0, False, False, {"nan": nan}


def make_faulty_env(fault):
    def make(seed, num_envs, resumable):
        Faulty.made = 0
        features = (lambda obs, action, info: [info["nan"]]) if fault == "style_features" else lambda *_: [0.0]
        base = GymnasiumEnv(lambda: Faulty(fault), features, num_envs)
        space = echo.echo_space()
        reward = StyleReward(space, {"target": Term(echo._distance, parameters=("target",))})
        return coachable_env(base, space, reward, EpisodeSums(), seed=seed)

    return make


@pytest.mark.parametrize("fault", ["observation", "task_reward", "style_features"])
def test_what_a_gymnasium_environment_returns(training, fault):
    assert_stops(training(make_env=make_faulty_env(fault)), rf"next/{fault} is nan.* in environment 1, step 1 of 1")


def test_an_environment_that_refuses_nan_actions_names_its_row(training):
    train = spoil_weights(training(make_env=make_faulty_env("none")), RANDOM)
    message = r"action contains NaN in environment 0: the policy has diverged, .* stopped at env-step 40,"
    with pytest.raises(NonFiniteError, match=message):
        train.run()


def test_rewards_whose_squares_overflow_when_styles_are_relabelled_change_no_weight(training):
    """Finite themselves, so that they are stored; the loss is what overflows."""
    train = training()
    sample = train.replay.sample

    def overflowing(size):
        batch = sample(size)
        batch["next", "reward"] = batch["next", "reward"] + 1e25
        return batch

    train.replay.sample = overflowing
    with pytest.raises(NonFiniteError, match=r"loss_qvalue is inf.* at update 1: no weight was changed by it"):
        train.run()
    state = read_state(find_checkpoint(train.checkpoints.directory.parent))
    for name, value in train.learner.loss_module.state_dict().items():
        assert torch.equal(value, state["learner"]["loss_module"][name]), name


def transitions(rows, steps):
    features = TensorDict({"gait": {"length": torch.zeros(rows, steps, 2)}}, [rows, steps])
    data = {
        "action": torch.zeros(rows, steps, 3),
        "next": {"reward": torch.zeros(rows, steps, 1), "features": features},
    }
    data["next"]["done"] = torch.zeros(rows, steps, 1, dtype=torch.bool)
    return TensorDict(data, [rows, steps])


def test_the_first_step_is_named_and_there_the_first_environment():
    data = transitions(4, 5)
    require_finite(data)
    data["next", "features", "gait", "length"][1, 4, 0] = math.nan
    data["next", "features", "gait", "length"][3, 2, 1] = -math.inf
    data["next", "reward"][3, 2] = math.nan
    data["next", "reward"][0, 3] = math.inf
    with pytest.raises(NonFiniteError) as refused:
        require_finite(data)
    assert "next/features/gait/length is -inf" in str(refused.value) and "next/reward is nan" in str(refused.value)
    assert "in environment 3, step 3 of 5 of the last batch" in str(refused.value)
    with pytest.raises(NonFiniteError, match="in environment 0, step 4 of 5"):
        require_finite(data[0])


def test_large_numbers_are_numbers_and_flags_are_no_matter():
    data = transitions(2, 1)
    data["action"][1, 0, 2] = -LARGEST
    require_finite(data)
    data["action"][1, 0, 2] *= 1.01
    with pytest.raises(NonFiniteError, match=r"action is -1.01e\+18 in environment 1, step 1 of 1"):
        require_finite(data)

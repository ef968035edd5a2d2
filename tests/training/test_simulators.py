"""Trainings on environments of other libraries: resumed exactly, or with one sentence that says what is not."""

import pytest
import torch
from torchrl.envs import Compose, DMControlEnv, DoubleToFloat, EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.transforms import StepCounter

from coachable.training.simulators import UnsavableError, load_simulator, save_simulator


def _cheetahs(seed: int) -> EnvBase:
    env = SerialEnv(2, lambda: DMControlEnv("cheetah", "run", frame_skip=4, time_limit=0.4))
    env.set_seed(seed)
    return env


def _rollout(env: EnvBase, td, actions):
    seen = []
    for action in actions:
        stepped, td = env.step_and_maybe_reset(td.set("action", action))
        seen.append(stepped["next"].select("position", "velocity", "reward", "done").clone())
    return torch.stack(seen), td


def test_dm_control_goes_on_bit_for_bit_over_the_ends_of_episodes():
    pytest.importorskip("dm_control")
    one, other = _cheetahs(1), _cheetahs(2)
    actions = torch.rand(30, 2, 6, generator=torch.Generator().manual_seed(0)) * 2 - 1
    _, td = _rollout(one, one.reset(), actions[:7])
    other.reset()
    load_simulator(other, save_simulator(one))
    expected, _ = _rollout(one, td.clone(), actions[7:])
    found, _ = _rollout(other, td.clone(), actions[7:])
    assert expected["done"].any()
    assert (expected == found).all()


def test_transforms_of_a_part_are_restored_with_it(make_echo_env):
    def part():
        return TransformedEnv(make_echo_env(3), Compose(StepCounter(), DoubleToFloat()))

    one, other = SerialEnv(1, part), SerialEnv(1, part)
    one.rollout(3)
    other.reset()
    load_simulator(other, save_simulator(one))
    states = [env._envs[0].base_env.base_env.simulator_state() for env in (one, other)]
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]), name


def test_a_state_that_does_not_fit_is_refused(make_echo_env):
    env = SerialEnv(2, lambda: make_echo_env(3))
    env.reset()
    state = save_simulator(env)
    for damaged in ({"parts": state["parts"][:1]}, {}, {"parts": [{}, {}]}):
        with pytest.raises(UnsavableError, match="the saved state does not fit"):
            load_simulator(env, damaged)

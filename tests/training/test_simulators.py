"""Trainings on environments of other libraries: resumed exactly, or with one sentence that says what is not."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, DMControlEnv, DoubleToFloat, EnvBase, GymWrapper, SerialEnv, TransformedEnv
from torchrl.envs.transforms import StepCounter

from coachable.training.collection import collector_state, load_collector_state
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


def test_what_a_dm_control_task_writes_into_its_model_is_restored():
    pytest.importorskip("dm_control")
    one, other = DMControlEnv("reacher", "easy"), DMControlEnv("reacher", "easy")
    for seed, env in enumerate((one, other)):
        env.set_seed(seed)
        env.reset()
    load_simulator(other, save_simulator(one))
    action = TensorDict({"action": torch.zeros(2, dtype=torch.float64)}, [])
    expected, found = one.step(action.clone())["next"], other.step(action.clone())["next"]
    assert torch.equal(expected["to_target"], found["to_target"])


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


def test_parts_that_cannot_be_saved_are_named():
    gymnasium = pytest.importorskip("gymnasium")
    env = SerialEnv(1, lambda: GymWrapper(make_dreamer(gymnasium)))
    env.reset()
    with pytest.raises(UnsavableError, match=r"Dreamer\.dream is of type Dream, which cannot be saved"):
        save_simulator(env)


class Dream:
    """Something that no file can hold."""


def make_dreamer(gymnasium):
    class Dreamer(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

        def reset(self, *, seed=None, options=None):
            self.dream = Dream()
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 0.0, False, False, {}

    return Dreamer()


class Workers:
    """What a collector with workers in other processes shows of itself."""

    def __init__(self) -> None:
        self._frames, self._iter, self.told = 0, 0, 0
        self.seeds: list[int] = []

    def set_seed(self, seed: int) -> None:
        self.seeds.append(seed)

    def update_policy_weights_(self) -> None:
        self.told += 1


def test_workers_in_other_processes_get_the_weights_and_the_count_of_frames():
    """Otherwise they would act at random again for `init_random_frames`, and once with the weights of a new agent."""
    before, after = Workers(), Workers()
    before._frames, before._iter = 480, 12
    with pytest.raises(UnsavableError, match=r"environments in other processes cannot be saved \(collector=direct"):
        load_collector_state(after, collector_state(before))
    assert (after._frames, after._iter, after.told, len(after.seeds)) == (480, 12, 1, 1)


def test_a_run_with_workers_is_resumed_in_one_process(make_train):
    workers, direct = Workers(), make_train().collector
    workers._frames = 480
    with pytest.raises(UnsavableError, match="the checkpoint does not hold their state"):
        load_collector_state(direct, collector_state(workers))
    assert direct._frames == 480
    direct.shutdown()

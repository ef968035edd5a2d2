"""State of environments of other libraries: saved, restored exactly, or refused by name."""

import io

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium")
from gymnasium import spaces  # noqa: E402

from coachable.object_state import UnsavableError, load_object, save_object  # noqa: E402

# Humanoid's reward reads the centres of mass before a step, which MuJoCo leaves as of the step before the last.
MUJOCO = ["HalfCheetah-v5", "Humanoid-v5"]


class Dice(gymnasium.Env):
    """Keeps whatever a test gives it."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, **attributes):
        vars(self).update(attributes)


def through_a_file(state):
    stream = io.BytesIO()
    torch.save(state, stream)
    stream.seek(0)
    return torch.load(stream, weights_only=True)


def course(env, actions):
    """Everything that an environment answers, over the ends of episodes."""
    answers = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        answers.append((np.asarray(observation).tobytes(), float(reward), bool(terminated), bool(truncated)))
        if terminated or truncated:
            answers.append(np.asarray(env.reset()[0]).tobytes())
    return answers


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", *MUJOCO])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_restored_environment_goes_on_bit_for_bit(name):
    if name in MUJOCO:
        pytest.importorskip("mujoco")
    one, other = (gymnasium.make(name, max_episode_steps=40) for _ in range(2))
    one.reset(seed=1), other.reset(seed=2)
    one.action_space.seed(0)
    actions = [one.action_space.sample() for _ in range(120)]
    course(one, actions[:25])
    load_object(other, through_a_file(save_object(one)))
    assert course(one, actions[25:]) == course(other, actions[25:])


@pytest.mark.parametrize("inner", [lambda space: space, lambda space: spaces.Dict(a=space)], ids=["plain", "dict"])
def test_spaces_go_on_drawing_samples(inner):
    one, other = (Dice(space=inner(spaces.Box(-1.0, 1.0, (3,)))) for _ in range(2))
    one.space.seed(1), other.space.seed(2)
    load_object(other, through_a_file(save_object(one)))
    np.testing.assert_equal(other.space.sample(), one.space.sample())


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        3,
        2.5,
        [1, (2.0, None)],
        {"a": [1], 2: (True,)},
        np.arange(3),
        np.float32(0.5),
        np.ones(2, dtype=bool),
    ],
)
def test_plain_attributes_come_back_as_they_were(value):
    env = Dice(thing=None)
    load_object(env, through_a_file(save_object(Dice(thing=value))))
    assert type(env.thing) is type(value)
    np.testing.assert_equal(env.thing, value)


@pytest.mark.parametrize("make", [np.random.default_rng, np.random.RandomState], ids=["Generator", "RandomState"])
def test_random_generators_go_on(make):
    one, other = Dice(dice=make(1)), Dice(dice=make(2))
    one.dice.standard_normal(3)
    load_object(other, through_a_file(save_object(one)))
    assert one.dice.standard_normal(5).tolist() == other.dice.standard_normal(5).tolist()


def test_what_cannot_be_saved_is_named():
    with pytest.raises(UnsavableError, match=r"Dice\.world is of type object, which cannot be saved"):
        save_object(gymnasium.wrappers.TimeLimit(Dice(world=object()), 5))


def test_text_is_not_taken_from_a_checkpoint():
    state = save_object(Dice(model="/elsewhere/model.xml"))
    with pytest.raises(UnsavableError, match=r"Dice\.model is text that changes"):
        load_object(Dice(model="model.xml"), state)
    load_object(Dice(model="/elsewhere/model.xml"), state)


def test_methods_are_not_taken_from_a_checkpoint():
    with pytest.raises(UnsavableError, match=r"Dice\.step belongs to its class"):
        load_object(Dice(sides=6), {"sides": 4, "step": 5})


def test_what_all_copies_share_is_left_out():
    shared = {"rule": abs, "kind": int, "library": np}
    assert set(save_object(Dice(steps=1, **shared))) == {"steps"}


def test_what_attributes_share_is_shared_again():
    def make(position):
        agent, bag = np.array([position]), {"gold": [1]}
        return Dice(agent=agent, bodies=[agent, np.ones(1)], bag=bag, gold=bag["gold"], player=Dice(bag=bag))

    env = make(0.0)
    load_object(env, through_a_file(save_object(make(5.0))))
    env.agent += 1.0
    env.gold.append(2)
    assert env.bodies[0] is env.agent
    assert env.bodies[0].tolist() == [6.0]
    assert env.player.bag is env.bag
    assert env.bag == {"gold": [1, 2]}


def test_a_view_of_another_array_is_refused():
    state = np.zeros(4)
    with pytest.raises(UnsavableError, match=r"Dice\.position is a view"):
        save_object(Dice(state=state, position=state[:2]))

"""What a domain gets that declares only an environment, a style space and a style reward."""

from functools import partial, wraps

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, DMControlEnv, PendulumEnv, RewardSum, SerialEnv, StepCounter, TransformedEnv

from coachable.defaults import EnvPictures, RewardMeasures, simulation_of, steps_per_episode, style_grid, time_per_step
from coachable.domain import Domain
from coachable.gl import RenderingError
from coachable.keys import STYLE, STYLE_FEATURES
from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Weight
from coachable.styles.terms import ChoiceTolerance, SetpointTolerance, Term, WeightedFeature, WeightedSum
from coachable.transforms import StyleFeatures
from tests.echo import StyleEchoEnv, echo_space

SPACE = StyleSpace(
    [Setpoint("speed", 0.0, 2.0), Choice("hat", ("on", "off")), Weight("fire", -1, 1), Weight("ice", -1, 1)]
)


def measures(gate=None) -> RewardMeasures:
    """Of features speed, hat, fire, ice, gate."""
    terms = {
        "pace": SetpointTolerance("speed", 0, margin=1.0, gate=gate),
        "head": ChoiceTolerance("hat", slice(1, 2), torch.tensor([[1.0], [0.0]]), torch.tensor([[1.0], [0.0]]), 0.5),
        "fire": WeightedFeature("fire", 2),
        "ice": WeightedSum(["ice"], slice(3, 4)),
        "both": Term(lambda features, style: style["fire"] * style["ice"] + features[..., 0], ("fire", "ice")),
    }
    return RewardMeasures(StyleReward(SPACE, terms))


def step(found: RewardMeasures, features, **style):
    theta = SPACE.make(**style).expand(len(features), -1)
    return found.step(TensorDict({STYLE: theta, "next": {STYLE_FEATURES: torch.tensor(features)}}, [len(features)]))


def test_measures_are_what_the_terms_read_and_pay():
    found = step(measures(), [[1.5, 1.0, 7.0, 8.0, 1.0]], speed=1.25, hat="on", fire=0.5, ice=0.5)
    assert {name: value.item() for name, value in found.items()} == pytest.approx(
        {"speed": 1.5, "speed_error": 0.25, "head_reward": 1.0, "fire": 7.0, "ice": 8.0, "both_reward": 1.75}
    )


def test_a_parameter_of_several_features_is_measured_by_term_or_by_its_reward():
    terms = {
        "left": SetpointTolerance("speed", 0, margin=1.0),
        "right": SetpointTolerance("speed", 1, margin=1.0),
        "hat": Term(lambda features, style: features[..., 0] * style["hat"][..., 0], ("hat",)),
        "fire": WeightedFeature("fire", 2),
        "both": WeightedSum(["fire", "ice"], slice(3, 5)),
    }
    found = RewardMeasures(StyleReward(SPACE, terms))
    record = step(found, [[1.5, 1.0, 7.0, 8.0, 9.0]], speed=1.0, hat="off")
    assert {name: value.item() for name, value in record.items()} == {
        **{"left": 1.5, "left_error": 0.5, "right": 1.0, "right_error": 0.0, "hat_reward": 0.0, "ice": 9.0}
    }
    assert not found.complies({name: value[None] for name, value in record.items()}).any()


def test_a_guide_on_the_same_feature_keeps_the_name_of_the_set_point():
    terms = {
        "exact": SetpointTolerance("speed", 0, margin=0.1),
        "guide": SetpointTolerance("speed", 0, margin=2.0),
        "rest": Term(
            lambda features, style: 0 * (style["fire"] + style["ice"] + style["hat"][..., 0]), ("fire", "ice", "hat")
        ),
    }
    record = step(RewardMeasures(StyleReward(SPACE, terms)), [[1.5, 0, 0, 0, 0]], speed=1.0)
    assert record["speed"].item() == 1.5 and record["speed_error"].item() == 0.5


def test_it_complies_within_a_twentieth_of_the_range_and_with_the_choice():
    record = step(
        measures(), [[1.0, 1.0, 0, 0, 1], [1.09, 1.0, 0, 0, 1], [1.11, 1.0, 0, 0, 1], [1.0, 0.0, 0, 0, 1]], speed=1.0
    )
    record = {name: value[None] for name, value in record.items()}
    assert measures().complies(record).tolist() == [[True, True, False, False]]
    assert measures().judged(record).all()


def test_steps_whose_gate_is_closed_are_not_judged():
    gated = measures(gate=4)
    record = step(gated, [[1.0, 1.0, 0.0, 0.0, 1.0], [2.0, 1.0, 0.0, 0.0, 0.0]], speed=1.0)
    record = {name: value[:, None] for name, value in record.items()}
    assert gated.judged(record)[:, 0].tolist() == [True, False] == gated.complies(record)[:, 0].tolist()
    assert gated.summarise(record, torch.ones(2, 1, dtype=torch.bool))["speed"].item() == 1.0


def test_weights_alone_give_nothing_to_judge():
    reward = StyleReward(StyleSpace([Weight("fire", -1, 1)]), {"fire": WeightedFeature("fire", 0)})
    record = {"fire": torch.ones(3, 2)}
    assert not RewardMeasures(reward).judged(record).any() and not RewardMeasures(reward).complies(record).any()


def test_the_grid_combines_a_few_values_or_varies_one_parameter_at_a_time():
    cells = style_grid(StyleSpace([Choice("hat", ("on", "off")), Setpoint("speed", 1 / 3, 2.0)]))
    assert len(cells) == 10 and cells[0] == {"hat": "on", "speed": 1 / 3} and cells[-1]["speed"] == 2.0
    unrounded = StyleSpace([Setpoint(f"s{i}", 0.1, 0.7) for i in range(4)])  # (0.1 + 0.7) / 2 is not quite 0.4
    assert len(style_grid(unrounded)) == 1 + 4 * 2
    wide = StyleSpace([Weight(f"w{i}", 0.0, 2.0) for i in range(5)])
    cells = style_grid(wide)
    assert len(cells) == 1 + 5 * 2 and all(sum(v != 0 for v in cell.values()) <= 1 for cell in cells)
    for cell in cells:
        wide.make(strict=True, **cell)


def test_time_is_asked_of_the_environment_when_it_is_first_read():
    made = []

    def make_env(num_envs):
        made.append(num_envs)
        env = StyleEchoEnv(num_envs)
        env.control_step = 0.25
        env.episode_steps = 20
        return env

    domain = Domain("echo", make_env, echo_space, lambda space: None)  # pyright: ignore[reportArgumentType]
    assert made == []
    assert (domain.control_step, domain.episode_steps, domain.control_step) == (0.25, 20, 0.25)
    assert made == [1, 1]
    quick = Domain("echo", make_env, echo_space, lambda space: None).with_options({})  # pyright: ignore
    quicker = quick.with_fields(make_env=lambda num_envs: StyleEchoEnv(num_envs), control_step=0.5)
    assert made == [1, 1], "and not when a domain is made from another one"
    assert (quicker.control_step, quicker.episode_steps, quick.control_step) == (0.5, 1000, 0.25)
    assert (time_per_step(StyleEchoEnv), steps_per_episode(StyleEchoEnv)) == (1.0, 1000)


def test_the_time_limit_of_an_environment_that_is_not_registered_is_found():
    gymnasium = pytest.importorskip("gymnasium")
    from coachable.gym import GymnasiumEnv

    class Unregistered(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

        def step(self, action):
            return np.zeros(1, np.float32), 0.0, False, False, {}

    def limit(make):
        return steps_per_episode(partial(GymnasiumEnv, make, lambda observation, action, info: [0.0]))

    wrappers = gymnasium.wrappers
    assert limit(lambda: wrappers.FlattenObservation(wrappers.TimeLimit(Unregistered(), 40))) == 40
    assert limit(Unregistered) == 1000


def test_the_limit_of_a_step_counter_is_found():
    def make_env(num_envs):
        counted = TransformedEnv(StyleEchoEnv(num_envs), Compose(StepCounter(), StepCounter(30, step_count_key="n")))
        return TransformedEnv(counted, RewardSum(), auto_unwrap=False)

    assert steps_per_episode(make_env) == 30


@pytest.mark.parametrize(
    ("make_env", "expected"),
    [
        (StyleEchoEnv, None),
        (partial(StyleEchoEnv, resumable=False), None),
        (lambda num_envs, num_threads: StyleEchoEnv(num_envs + num_threads - 1), 3),
        (wraps(StyleEchoEnv)(lambda **options: StyleEchoEnv(**options)), None),
    ],
)
def test_threads_reach_an_environment_that_takes_them(make_env, expected):
    reward = StyleReward(echo_space(), {"target": Term(lambda features, style: style["target"], ("target",))})
    domain = Domain("echo", make_env, echo_space, lambda space: reward)
    assert domain.styled_env(echo_space(), 1, num_threads=3).batch_size == (expected or 1,)


def test_the_simulation_of_a_row_lies_below_transforms_and_batches():
    serial = SerialEnv(2, lambda: TransformedEnv(PendulumEnv(), StyleFeatures(lambda after: after["th"][None], 1)))
    inner = simulation_of(TransformedEnv(serial), 1)[0]
    assert isinstance(inner, PendulumEnv)
    serial.close()


def test_an_environment_that_draws_nothing_says_what_to_declare():
    with pytest.raises(RenderingError, match=r"StyleEchoEnv draws no pictures: .*make_renderer"):
        EnvPictures(8, 6).draw(StyleEchoEnv(1))


def test_pictures_of_dm_control_may_be_larger_than_mujoco_draws():
    env = DMControlEnv("cartpole", "balance")
    pictures = EnvPictures(800, 600)
    try:
        picture = pictures.draw(env)
    except RenderingError as error:
        pytest.skip(str(error))
    assert picture.shape == (600, 800, 3) and picture.std() > 0
    assert (pictures.draw(env) == picture).all()
    pictures.close()
    env.close()


def test_pictures_are_fitted_to_the_size():
    env = StyleEchoEnv(1)
    env.render_mode = "rgb_array"
    env.render = lambda: torch.zeros(3, 4, 3, dtype=torch.uint8).numpy()
    assert EnvPictures(8, 6).draw(env).shape == (6, 8, 3)
    env.render = _broken
    with pytest.raises(RenderingError, match="no window"):
        EnvPictures(8, 6).draw(env)


def _broken():
    raise OSError("no window")

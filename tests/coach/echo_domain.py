"""A domain that is no humanoid: a walk on a line whose policy does what the style asks for, in one component."""

from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coachable.coach.session.session import CoachSession
from coachable.domain import Domain
from coachable.keys import STYLE, STYLE_FEATURES
from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Term, Weight
from tests.echo import StyleEchoEnv


def echo_space() -> StyleSpace:
    return StyleSpace(
        [
            Setpoint("target", -0.8, 0.8, unit="m", help="displacement in each step"),
            Choice("mood", ("calm", "wild_card"), help="temper"),
            Weight("fire", -0.5, 2.0, help="burning"),
        ],
        name="echo",
    )


class EchoMeasures:
    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        action = transition["next", STYLE_FEATURES][:, 0]
        error = (action - transition[STYLE][:, 0]).abs()
        return {"target": action, "target_error": error, "pace": action.abs(), "fire": action**2}

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        return {name: torch.where(alive, record[name], torch.nan).nanmean(0) for name in ("target", "pace", "fire")}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        return record["target_error"] < 1e-6


class EchoRenderer:
    def __init__(self, width: int = 64, height: int = 48) -> None:
        self.size = (height, width)

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        while isinstance(env, TransformedEnv):
            env = env.base_env
        image = np.zeros((*self.size, 3), dtype=np.uint8)
        column = int((float(env.position[row]) / 6 + 0.5) * self.size[1]) % self.size[1]
        image[:, column] = 255
        return image

    def close(self) -> None:
        pass


def make_env(num_envs: int, num_threads: int = 1, seed: int = 0) -> EnvBase:
    return StyleEchoEnv(num_envs, seed)


def distance(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
    return -(features[..., 0] - style["target"]).abs()


ECHO = Domain(
    name="echo",
    make_env=make_env,
    make_space=echo_space,
    make_reward=lambda space: StyleReward(space, {"target": Term(distance, parameters=("target", "mood", "fire"))}),
    measures=EchoMeasures(),
    make_renderer=EchoRenderer,
    grid={},
    control_step=0.05,
    episode_steps=20,
    units={"pace": "m/step"},
)


def echo_session(**settings) -> CoachSession:
    """Its action is the target of the style it sees."""
    policy = TensorDictModule(lambda style: style[..., :1].clone(), in_keys=[STYLE], out_keys=["action"])
    return CoachSession(policy, echo_space(), ECHO, **settings)

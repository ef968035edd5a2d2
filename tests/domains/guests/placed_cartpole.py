"""The cart-pole of the DeepMind Control suite, which can be asked where to balance."""

from torchrl.envs import CatTensors, Compose, DMControlEnv, DoubleToFloat, EnvBase, SerialEnv, TransformedEnv

from coachable.domain import Domain
from coachable.styles import Setpoint, SetpointTolerance, StyleReward, StyleSpace
from coachable.transforms import StyleFeatures


def make_space() -> StyleSpace:
    return StyleSpace([Setpoint("place", -1.0, 1.0, unit="m", help="where the cart stands, right is positive")])


def make_reward(space: StyleSpace) -> StyleReward:
    return StyleReward(space, {"place": SetpointTolerance("place", 0, margin=1.0)})


def make_env(num_envs: int = 8, seed: int = 0) -> EnvBase:
    carts = SerialEnv(num_envs, lambda: DMControlEnv("cartpole", "balance"))
    place = StyleFeatures(lambda after: after["position"][..., :1], 1)
    observation = CatTensors(["position", "velocity"], "observation")
    single = DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"])
    env = TransformedEnv(carts, Compose(place, observation, single))
    env.set_seed(seed)
    return env


DOMAIN = Domain("placed_cartpole", make_env, make_space, make_reward)

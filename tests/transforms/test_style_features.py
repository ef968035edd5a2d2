"""Style features of an environment that has none."""

import pytest
import torch
from torchrl.envs import PendulumEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from coachable.transforms import StyleFeatures


def test_the_reward_is_the_task_reward_and_the_function_makes_the_features():
    env = TransformedEnv(PendulumEnv(), StyleFeatures(lambda after: torch.stack([after["th"], after["thdot"]], -1), 2))
    check_env_specs(env)
    after = env.rollout(3)["next"]
    assert (after["task_reward"] == after["reward"]).all()
    assert (after["style_features"] == torch.stack([after["th"], after["thdot"]], -1)).all()


@pytest.mark.parametrize("size", [1, 3])
def test_features_of_another_number_than_was_said_are_refused(size):
    features = StyleFeatures(lambda after: torch.stack([after["th"], after["thdot"]], -1), size)
    with pytest.raises(ValueError, match=rf"have the shape \(2,\): expected \({size},\)"):
        TransformedEnv(PendulumEnv(), features).rollout(1)

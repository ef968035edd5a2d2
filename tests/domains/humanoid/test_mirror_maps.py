"""A mirrored humanoid, acting as in the mirror, is the mirror image of the original: shown by the physics itself."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from coachable.domains.humanoid.mirror_maps import ACTION, OBSERVATION, humanoid_mirror_maps
from coachable.envs.humanoid import HumanoidEnv
from coachable.envs.humanoid.model import NUM_POSITIONS
from coachable.transforms.mirror import MirrorMap, MirrorSymmetry


def image(mirror, vector):
    return vector[..., list(mirror.source)] * torch.tensor(mirror.sign)


def mirror_state(state):
    """Mirror of a MuJoCo state (time, qpos, qvel)."""
    mirrored = state.copy()
    joints = np.array(OBSERVATION.source[:21])
    signs = np.array(OBSERVATION.sign[:21])
    positions, velocities = state[1 : 1 + NUM_POSITIONS], state[1 + NUM_POSITIONS :]
    mirrored[1 : 1 + NUM_POSITIONS] = np.concatenate(
        [positions[:3] * [1, -1, 1], positions[3:7] * [1, -1, 1, -1], positions[7:][joints] * signs]
    )
    mirrored[1 + NUM_POSITIONS :] = np.concatenate(
        [velocities[:3] * [1, -1, 1], velocities[3:6] * [-1, 1, -1], velocities[6:][joints] * signs]
    )
    return mirrored


@pytest.mark.parametrize("styled_speed", [False, True])
def test_a_mirrored_walker_stays_the_mirror_image(styled_speed):
    env = HumanoidEnv(num_envs=2, seed=4, num_threads=1, styled_speed=styled_speed)
    feature_map = humanoid_mirror_maps(styled_speed)["next", "style_features"]
    env.reset()
    simulation = env.simulation
    simulation.velocities[0] = np.random.default_rng(0).uniform(-0.5, 0.5, 27)
    simulation.positions[0, 2] += 0.05  # both feet come down within the rollout
    simulation.state[1] = mirror_state(simulation.state[0])
    kinematics = simulation.kinematics()
    env.gait.reset(np.arange(2), np.array([0, 1]), kinematics.feet[..., :2], env._knees(), kinematics.soles)
    generator = torch.Generator().manual_seed(0)
    strikes = 0
    for _ in range(20):
        action = 0.4 * (torch.rand(21, generator=generator) * 2 - 1)
        after = env.step(TensorDict({"action": torch.stack([action, image(ACTION, action)])}, [2]))["next"]
        observation, features = after["observation"], after["style_features"]
        torch.testing.assert_close(image(OBSERVATION, observation[0]), observation[1], atol=2e-4, rtol=0)
        torch.testing.assert_close(image(feature_map, features[0]), features[1], atol=2e-4, rtol=0)
        torch.testing.assert_close(after["task_reward"][0], after["task_reward"][1], atol=1e-4, rtol=0)
        strikes += int(features[0, 6])
    assert strikes > 0  # the gait took part


def test_transform_mirrors_whole_transitions():
    batch = TensorDict(
        {
            "observation": torch.randn(64, 82),
            "action": torch.randn(64, 21),
            "style": torch.randn(64, 4),
            "next": {"observation": torch.randn(64, 82), "style_features": torch.randn(64, 13)},
        },
        [64],
    )
    result = MirrorSymmetry(humanoid_mirror_maps(), probability=0.5, seed=1)(batch)
    mirrored = (result["action"] != batch["action"]).any(-1)
    assert 16 < mirrored.sum() < 48
    for key, mirror in humanoid_mirror_maps().items():
        assert torch.equal(result[key][mirrored], image(mirror, batch[key][mirrored]))
        assert torch.equal(result[key][~mirrored], batch[key][~mirrored])
    assert torch.equal(result["style"], batch["style"])


def test_the_generator_is_saved():
    mirror, other = (MirrorSymmetry({"action": MirrorMap((0,), (-1.0,))}, seed=seed) for seed in (1, 2))
    batch = TensorDict({"action": torch.ones(100, 1)}, [100])
    mirror(batch)
    other.load_state_dict(mirror.state_dict())
    assert torch.equal(mirror(batch)["action"], other(batch)["action"])


def test_bad_maps_are_refused():
    with pytest.raises(ValueError, match="not each other's mirror image"):
        MirrorMap((1, 2, 0), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="probability of MirrorSymmetry is"):
        MirrorSymmetry({}, probability=2.0)
    with pytest.raises(ValueError, match="has 3 entries, its mirror map 2"):
        MirrorSymmetry({"action": MirrorMap((1, 0), (1.0, 1.0))})(TensorDict({"action": torch.ones(4, 3)}, [4]))

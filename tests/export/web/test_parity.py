"""The page's code, in Node with the physics in WebAssembly, computes what Python computes."""

import json

import mujoco
import numpy as np
import pytest
import torch

from coachable.envs.humanoid import HumanoidEnv
from coachable.envs.humanoid.features import COMPLETED, LENGTH
from coachable.envs.humanoid.model import CONTROL_STEP, PHYSICS_STEPS_PER_CONTROL
from coachable.networks.plain import DeterministicAction
from coachable.training.weights import load_policy

STYLE = [0.0, 0.0, 1.0, 0.475]


def recorded_walk(steps, style):
    """A walk of the shipped agent: raw quantities, observations and step lengths of the environment itself."""
    plain = DeterministicAction(load_policy("humanoid").actor).eval()
    env = HumanoidEnv(num_envs=1, num_threads=1, seed=1)
    data, theta = env.reset(), torch.tensor([style])
    gait = [np.reshape(array, -1).astype(float) for array in env.gait.arrays().values()]
    start = {
        "positions": env.simulation.positions[0].tolist(),
        "memory": np.concatenate(gait).tolist(),
        "observation": data["observation"][0].tolist(),
    }
    states, actions, expected = [], [], []
    model = env.simulation.model.kinematics
    geometry = mujoco.MjData(model)
    for _ in range(steps):
        with torch.no_grad():
            data["action"] = plain(data["observation"], theta)[0]
        actions.append(data["action"][0].tolist())
        data = env.step(data)["next"]
        geometry.qpos[:], geometry.qvel[:] = env.simulation.positions[0], env.simulation.velocities[0]
        mujoco.mj_forward(model, geometry)
        state = {"positions": geometry.qpos, "velocities": geometry.qvel, "sensors": geometry.sensordata}
        states.append({name: array.tolist() for name, array in state.items()})
        expected.append((data["observation"][0].numpy(), data["style_features"][0].numpy(), data["terminated"].item()))
    env.close()
    return start, states, actions, expected


@pytest.fixture(scope="module")
def walk():
    return recorded_walk(1000, STYLE)


def test_a_thousand_steps_have_the_same_observations_and_step_lengths(drive, walk):
    """The states are Python's: rounding differs between builds of MuJoCo, and a walk amplifies it."""
    start, states, _, expected = walk
    results = drive("replay", start=start, style=STYLE, states=states)
    observations = np.array([result["observation"] for result in results])
    assert np.abs(observations - [observation for observation, _, _ in expected]).max() < 1e-5
    struck = np.array([features[COMPLETED] > 0 for _, features, _ in expected])
    lengths = np.array([features[LENGTH] for _, features, _ in expected])
    measured = np.array([result["measured"][1] for result in results], dtype=float)  # null is NaN
    assert struck.sum() > 30
    assert np.array_equal(~np.isnan(measured), struck)
    np.testing.assert_allclose(measured[struck], lengths[struck], atol=1e-6)
    assert [result["terminated"] for result in results] == [terminated for _, _, terminated in expected]


def test_the_physics_agree_until_rounding_shows(drive, walk, site):
    """Python steps the same XML; the builds may differ in version, so only the first steps are compared."""
    start, _, actions, _ = walk
    manifest = json.loads((site / "manifest.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(site / manifest["models"]["dynamics"]))
    data = mujoco.MjData(model)
    data.qpos[:] = start["positions"]
    results = drive("physics", start=start, actions=actions[:10])
    for action, result in zip(actions, results, strict=False):
        data.ctrl[:] = action
        for _ in range(PHYSICS_STEPS_PER_CONTROL):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(result["positions"], data.qpos, atol=1e-6)


def test_the_walker_follows_as_it_does_in_python(drive, walk):
    lengths = [features[LENGTH] for _, features, _ in walk[3][100:400] if features[COMPLETED]]
    results = drive("walk", style=STYLE, steps=400)
    assert not any(result["terminated"] for result in results)
    measured = [result["measured"][1] for result in results[100:] if result["measured"][1] is not None]
    assert abs(np.mean(measured) - np.mean(lengths)) < 0.03
    assert np.mean([result["measured"][0] for result in results[100:]]) > 0.8


def test_the_manifest_has_the_constants_of_the_environment(site):
    manifest = json.loads((site / "manifest.json").read_text())
    assert manifest["physics"]["control_step"] == CONTROL_STEP
    assert manifest["physics"]["substeps"] == PHYSICS_STEPS_PER_CONTROL
    assert manifest["physics"]["fall_height"] == 1.1
    assert len(manifest["starts"]) == 16

"""The batched humanoid against dm_control's own, from the same states and actions."""

import numpy as np
import pytest
from dm_control import suite

from coachable.envs.humanoid.model import NUM_POSITIONS
from coachable.envs.humanoid.observation import suite_observation
from coachable.envs.humanoid.rewards import move_reward
from coachable.envs.humanoid.simulation import HumanoidSimulation

NUM_ENVS = 3


@pytest.fixture
def reference():
    return suite.load("humanoid", "walk", task_kwargs={"random": 0})


def start(reference, height, seed):
    """Put dm_control into an upright random posture at `height` above standing; returns its state."""
    random = np.random.default_rng(seed)
    reference.reset()
    physics = reference.physics
    with physics.reset_context():
        physics.data.qpos[:] = 0.0
        physics.data.qpos[2] = 1.2855 + height
        physics.data.qpos[3] = 1.0
        physics.data.qpos[7:] = random.uniform(-0.2, 0.0, 21)
        physics.data.qvel[:] = random.uniform(-0.3, 0.3, 27)
    return physics.data.qpos.copy(), physics.data.qvel.copy()


def flatten(observation):
    return np.concatenate([np.atleast_1d(value) for value in observation.values()])


def simulate_both(reference, height, steps, amplitude):
    """Yields dm_control's and our (state, observation, reward) after each of `steps` control steps, for three seeds."""
    simulation = HumanoidSimulation(NUM_ENVS)
    starts = [start(reference, height, seed) for seed in range(NUM_ENVS)]
    for row, (positions, velocities) in enumerate(starts):
        simulation.positions[row], simulation.velocities[row] = positions, velocities
    actions = np.random.default_rng(7).uniform(-amplitude, amplitude, (steps, NUM_ENVS, 21))
    ours = []
    for action in actions:
        assert not simulation.step(action).any()
        ours.append((simulation.state.copy(), simulation.kinematics()))
    for row in range(NUM_ENVS):
        start(reference, height, row)
        for step in range(steps):
            expected = reference.step(actions[step, row])
            state, kinematics = ours[step]
            positions, velocities = state[:, 1 : 1 + NUM_POSITIONS], state[:, 1 + NUM_POSITIONS :]
            observed = suite_observation(positions, velocities, kinematics, np.zeros(NUM_ENVS))[row]
            yield reference.physics, expected, positions[row], velocities[row], observed, kinematics, row


@pytest.mark.parametrize(
    ("height", "steps", "amplitude", "tolerance"),
    [(300.0, 200, 0.05, 1e-9), (0.0, 20, 1.0, 1e-6)],
    ids=["200 steps in free flight", "20 steps with contacts"],
)
def test_states_and_observations_follow_dm_control(reference, height, steps, amplitude, tolerance):
    contacts = 0
    for physics, expected, positions, velocities, observed, _, _ in simulate_both(reference, height, steps, amplitude):
        contacts += physics.data.ncon
        np.testing.assert_allclose(positions, physics.data.qpos, atol=tolerance, rtol=0)
        np.testing.assert_allclose(velocities, physics.data.qvel, atol=tolerance * 10, rtol=0)
        np.testing.assert_allclose(observed, flatten(expected.observation), atol=tolerance * 10, rtol=0)
    assert (contacts > 0) == (height == 0.0)


def test_suite_reward_follows_from_our_features(reference):
    """The suite's walk reward needs head height, torso axis, speed and controls: all of them ours."""
    from dm_control.utils.rewards import tolerance

    for physics, expected, _, _, _, kinematics, row in simulate_both(reference, 0.0, 20, 1.0):
        speed = np.linalg.norm(kinematics.com_velocity[row, :2])
        upright = tolerance(
            kinematics.torso_axes[row, 2, 2], bounds=(0.9, np.inf), sigmoid="linear", margin=1.9, value_at_margin=0
        )
        effortless = tolerance(physics.control(), margin=1, value_at_margin=0, sigmoid="quadratic").mean()
        one = np.ones(1)  # full speed, upright, facing the course, no effort: what remains is the head's height
        standing = move_reward(one, kinematics.head_height[[row]], one, one, np.zeros((1, 21)))[0]
        move = (5 * tolerance(speed, bounds=(1, np.inf), margin=1, value_at_margin=0, sigmoid="linear") + 1) / 6
        assert standing * upright * move * (4 + effortless) / 5 == pytest.approx(expected.reward, abs=1e-6)


def test_foot_clearance_tells_contact(reference):
    """A foot whose lowest point is below the floor has a MuJoCo contact with it, and no other foot has."""
    agreement = []
    for physics, _, _, _, _, kinematics, row in simulate_both(reference, 0.0, 20, 1.0):
        floor = physics.model.name2id("floor", "geom")
        pairs = [{int(c.geom1), int(c.geom2)} for c in physics.data.contact[: physics.data.ncon]]
        geoms = {geom for pair in pairs if floor in pair for geom in pair}
        for side, foot in enumerate(("right", "left")):
            touches = any(physics.model.name2id(f"{half}_{foot}_foot", "geom") in geoms for half in ("right", "left"))
            agreement.append(touches == (kinematics.foot_clearance[row, side] < 0))
    assert np.mean(agreement) == 1.0

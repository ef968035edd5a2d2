"""Our building blocks against the single-track drift model of the package commonroad-vehicle-models."""

import copy

import numpy as np
import torch
from scipy.integrate import solve_ivp
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std

from tests.envs.racing.single_track import derivative, integrate

VEHICLE = parameters_vehicle2()


def reference(state, inputs):
    return vehicle_dynamics_std(copy.copy(list(state)), list(inputs), VEHICLE)


def random_states(n, seed=0):
    random = np.random.default_rng(seed)
    low = [-100, -100, -1.1, 0.0, -3, -2, -0.6, 0, 0]
    high = [100, 100, 1.1, 55.0, 3, 2, 0.6, 150, 150]
    return random.uniform(low, high, (n, 9)), random.uniform([-0.6, -14], [0.6, 14], (n, 2))


def test_derivatives_agree_to_1e_12():
    states, inputs = random_states(500)
    expected = np.array([reference(s, u) for s, u in zip(states, inputs, strict=True)])
    found = derivative(torch.tensor(states.T), *torch.tensor(inputs.T), VEHICLE).T.numpy()
    scale = np.abs(expected).max(0)
    assert np.abs((found - expected) / scale).max() < 1e-12


def test_derivatives_at_walking_pace_agree():
    states, inputs = random_states(200, seed=1)
    states[:, 3] *= 0.4 / 55
    states[:, 7:] *= 0.01
    expected = np.array([reference(s, u) for s, u in zip(states, inputs, strict=True)])
    found = derivative(torch.tensor(states.T), *torch.tensor(inputs.T), VEHICLE).T.numpy()
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_trajectories_agree_to_1e_6_m_after_one_second():
    """Steering to the left while braking, coasting and driving."""
    start = np.array([0, 0, 0, 18.0, 0, 0, 0, 18.0 / VEHICLE.R_w, 18.0 / VEHICLE.R_w])
    inputs = np.array([(0.15, -7.0), (0.15, 0.0), (0.15, 0.63 * 9.81)])
    rate, acceleration = torch.tensor(inputs.T)
    end = integrate(torch.tensor(start)[:, None].repeat(1, 3), rate, acceleration, VEHICLE, 1e-3, 1000)
    for given, found in zip(inputs, end[:2].T.numpy(), strict=True):
        solved = solve_ivp(lambda _, s, u=given: reference(s, u), (0, 1), start, method="LSODA", rtol=1e-11, atol=1e-11)
        assert np.hypot(*(found - solved.y[:2, -1])) < 1e-6

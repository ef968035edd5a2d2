"""Cars on an endless plane, for physics without a track."""

import pytest
import torch

from coachable.envs.racing.physics.cars import Resources, load_car
from coachable.envs.racing.physics.dynamics import WheelSet, substep
from coachable.envs.racing.physics.state import HEATS, INPUT_ROWS, ROW, SPINS, STATE_ROWS, CarInputs

INPUT = {name: row for row, name in enumerate(CarInputs._fields)}


class Plane:
    """N cars of one kind on tarmac without end."""

    def __init__(self, car="gt3", n=1, speed=0.0, heat=80.0, fuel=30.0, resources=None, dtype=torch.float64, h=0.01):
        self.car, self.h = load_car(car), h
        self.resources = resources or Resources()
        self.wheels = WheelSet.of(self.car, dtype=dtype)
        self.state = torch.zeros(STATE_ROWS, n, dtype=dtype)
        self.inputs = torch.zeros(INPUT_ROWS, n, dtype=dtype)
        for name in ("drag_factor", "front_lift_factor", "grip_factor", "wear_factor", "node_tx"):
            self.inputs[INPUT[name]] = 1.0
        for name in ("left", "right", "margin"):
            self.inputs[INPUT[name]] = 1e6
        self.set("vx", speed)
        self.state[SPINS] = self.get("vx") / self.car.wheel_radius
        self.state[HEATS] = heat
        self.set("fuel", fuel)
        self.set("gear", 1.0 + (self.get("vx") / 14.0).floor().clamp(max=4.0))

    def get(self, name):
        return self.state[ROW[name]]

    def set(self, name, value):
        self.state[ROW[name]] = value

    def command(self, steer=None, throttle=0.0, brake=0.0):
        """Pedals, and a steering command that holds at once."""
        self.inputs[INPUT["throttle"]], self.inputs[INPUT["brake"]] = throttle, brake
        self.inputs[INPUT["steer_step"]] = 0.0
        if steer is not None:
            self.set("steer_command", steer)

    def step(self, steps=1):
        for _ in range(steps):
            self.state = substep(self.state, self.inputs, self.car, self.wheels, self.resources, self.h)
        return self


@pytest.fixture
def plane():
    return Plane

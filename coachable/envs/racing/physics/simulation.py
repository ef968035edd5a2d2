"""Control steps of N cars with substeps, contacts and their compilation."""

import logging
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.compiler import nested_compile_region

from coachable.envs.racing.physics.cars import Car, Resources
from coachable.envs.racing.physics.contact import Bodies, collide
from coachable.envs.racing.physics.dynamics import WheelSet, substep, total_mass
from coachable.envs.racing.physics.state import ROW

CONTROL_STEP = 0.1  # [s]
SUBSTEPS = 10  # 40 is the accurate mode
_LOG = logging.getLogger(__name__)


def maybe_compile(function: Callable[..., Any], device: torch.device, wanted: bool) -> Callable[..., Any]:
    """Compile a function if this is wanted and possible, otherwise return it unchanged.

    Args:
        function: Function to compile.
        device: Device that it runs on. On a CPU, `torch.compile` needs a C++ compiler; a warning is logged if there is
            none.
        wanted: Whether to compile.
    """
    if not wanted:
        return function
    if device.type == "cpu" and not any(shutil.which(name) for name in ("g++", "clang++", "c++")):
        _LOG.warning("compile=True has no effect: torch.compile needs a C++ compiler on a CPU (g++ or clang++)")
        return function
    return torch.compile(function, dynamic=False)


class Simulation:
    """Physics of B races of A cars, without track or task, as a pure function of state and inputs.

    Args:
        car: Parameters of all cars, or of each.
        resources: Wear and fuel rates.
        cars: Number A of cars in a race.
        substeps: Number of substeps per control step: 10 by default, 40 for accurate runs.
        compile: Whether to compile the substeps, which takes about half a minute and makes them 5 to 10 times faster on
            a CPU.
        device: Device of all tensors.
        dtype: Type of the parameters of the wheels: float32, or float64 for checks.

    Raises:
        ValueError: If `substeps` is less than 1.
    """

    def __init__(
        self,
        car: Car,
        resources: Resources,
        *,
        cars: int = 1,
        substeps: int = SUBSTEPS,
        compile: bool = False,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if substeps < 1:
            raise ValueError(f"substeps is {substeps}: expected at least 1 per control step")
        self.device = torch.device(device)
        self.cars, self.substeps, self.h = cars, substeps, CONTROL_STEP / substeps
        self.resources = resources
        self.car, self.wheels = _apart(car), WheelSet.of(car, self.device, dtype)
        self._advance = maybe_compile(self._substeps, self.device, compile)

    def set_cars(self, car: Car) -> None:
        """Replace the parameters of the cars by tensors (N,), with one value per car."""
        self.car, self.wheels = _apart(car), WheelSet.of(car, self.device, self.wheels.x.dtype)

    def step(self, state: Tensor, inputs: Tensor, group: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Advance the cars by one control step.

        Args:
            state: State (29, N), in which column k * B + b is car k of race b.
            inputs: Inputs (15, N).
            group: Groups (A, B) of cars that interact; required if A > 1.

        Returns:
            The new state (29, N), and for A > 1 each pair's largest squared relative speed in contact, (A // 2, A, B)
            [m²/s²].
        """
        impact = None
        if self.cars > 1:
            races = state.shape[1] // self.cars
            impact = state.new_zeros(self.cars // 2, self.cars, races)
        return self._advance(state, inputs, self.car, self.wheels, group, impact)

    def _substeps(
        self,
        state: Tensor,
        inputs: Tensor,
        car: Car,
        wheels: WheelSet,
        group: Tensor | None,
        impact: Tensor | None,
    ) -> tuple[Tensor, Tensor | None]:
        # The loop is compiled as a whole, so that guards are checked once per control step. The nested region lets the
        # compiler reuse the code of one substep for all.
        if group is None or impact is None:

            @nested_compile_region
            def move(state: Tensor) -> Tensor:
                return substep(state, inputs, car, wheels, self.resources, self.h)

            for _ in range(self.substeps):
                state = move(state)  # pyright: ignore[reportAssignmentType]
            return state, None

        @nested_compile_region
        def move_all(state: Tensor, impact: Tensor) -> tuple[Tensor, Tensor]:
            return self._many_cars(state, inputs, car, wheels, group, impact)

        for _ in range(self.substeps):
            state, impact = move_all(state, impact)  # pyright: ignore[reportCallIssue]
        return state, impact

    def _many_cars(
        self, state: Tensor, inputs: Tensor, car: Car, wheels: WheelSet, group: Tensor, impact: Tensor
    ) -> tuple[Tensor, Tensor]:
        state = substep(state, inputs, car, wheels, self.resources, self.h)
        bodies = bodies_of(state, car, self.cars)
        push, impact = collide(bodies, group, impact)
        dvx = push.vx * bodies.cos + push.vy * bodies.sin
        dvy = push.vy * bodies.cos - push.vx * bodies.sin
        change = torch.stack([part.reshape(-1) for part in (push.x, push.y, dvx, dvy, push.yaw_rate)])
        return torch.cat([state[:2] + change[:2], state[2:3], state[3:6] + change[2:], state[6:]]), impact


def _apart(car: Car) -> Car:
    """Copy the parameters to tensors that share no memory, because a compiled region refuses views of one tensor."""

    def copied(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(copied(entry) for entry in value)
        return value.clone() if isinstance(value, Tensor) else value

    return replace(car, **{field.name: copied(getattr(car, field.name)) for field in fields(car)})


def bodies_of(state: Tensor, car: Car, cars: int) -> Bodies:
    """Return the cars of a state (29, A * B) as rectangles (A, B).

    Args:
        state: State (29, A * B).
        car: Parameters.
        cars: Number of cars per race A.

    Returns:
        Rectangles (A, B).
    """
    yaw, vx, vy = state[ROW["yaw"]], state[ROW["vx"]], state[ROW["vy"]]
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    rectangle = (
        state[ROW["x"]],
        state[ROW["y"]],
        cos,
        sin,
        vx * cos - vy * sin,
        vx * sin + vy * cos,
        state[ROW["yaw_rate"]],
        total_mass(car, state[ROW["fuel"]]),
        car.yaw_inertia,
        0.5 * car.length,
        0.5 * car.width,
    )
    return Bodies(*(f.reshape(cars, -1) if isinstance(f, Tensor) else f for f in rectangle))

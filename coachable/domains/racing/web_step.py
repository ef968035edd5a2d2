"""A car alone on a circuit on a page: a control step of `RacingEnv` as functions of one row of numbers."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from coachable.domain import Recorded
from coachable.domains.racing.car_scene import body, wheel
from coachable.domains.racing.car_view import (
    GAUGES,
    VALUES,
    CarSize,
    aimed,
    car_poses,
    gauge_values,
    rolled_further,
    skid_marks,
    turned_camera,
)
from coachable.domains.racing.circuit_scene import circuit, outline
from coachable.domains.racing.metrics import RacingMeasures
from coachable.domains.racing.stage import CARS, MARKS, SKID, SKID_HEIGHT, SKID_SIZE, RacingStage
from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.physics.dynamics import substep
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.physics.state import ROW, STATE_ROWS
from coachable.envs.racing.race.run import RUN_ROWS
from coachable.export.web.part import Measure
from coachable.export.web.step_part import StepPart, Steps
from coachable.keys import STYLE, STYLE_FEATURES
from coachable.scene.frame import Map
from coachable.styles import StyleSpace

KILOMETRES = "kilometres"  # along the track, in a control step
OPENS = {
    "drift": {"slip_angle_rear": 3.0, "slip_ratio_rear": 3.0},
    "resources": {"overtake": 1.0, "defend": 1.0, "tire": 0.0, "fuel": 0.0},
}
IDLE = {"resources": ("overtake", "defend")}
IDLE_NOTES = {"resources": "No other car drives here, so there are no sliders for overtaking and defending."}
_COMMON = (
    Measure("pace", "", "pace along the track", "m/s", digits=1),
    Measure("off", "", "off the track", share=True),
)
MEASURES = {
    "drift": (
        Measure(
            "slip_angle_front", "slip_angle_front", "slip angle of the front tyres", "deg", comparable=False, digits=0
        ),
        Measure("sideslip_corners", "slip_angle_rear", "sideslip in corners", "deg", comparable=False, digits=0),
        Measure("sideslip_straights", "slip_angle_rear", "sideslip on straights", "deg", comparable=False, digits=0),
        Measure("slip_ratio_front", "slip_ratio_front", "slip ratio of the front tyres", comparable=False),
        Measure("slip_ratio_rear", "slip_ratio_rear", "slip ratio of the rear tyres", comparable=False),
        *_COMMON,
    ),
    "resources": (
        Measure("wear_per_km", "tire", "tyre wear per km", "%", comparable=False, per=KILOMETRES),
        Measure("fuel_per_km", "fuel", "fuel per km", "l", comparable=False, per=KILOMETRES),
        *_COMMON,
        Measure(KILOMETRES, "", ""),
    ),
}
_STARTS = 8


class _Command(nn.Module):
    """State and constants before the first substep."""

    def __init__(self, env: RacingEnv) -> None:
        super().__init__()
        self.env = env

    def forward(self, memory: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        state, run, compound = _recall(memory, self.env)[:3]
        return self.env.referee.command(state, run, action.clamp(-1.0, 1.0), compound)


class _Advance(nn.Module):
    """One substep."""

    def __init__(self, env: RacingEnv) -> None:
        super().__init__()
        self.env = env

    def forward(self, state: Tensor, inputs: Tensor) -> tuple[Tensor]:
        physics = self.env.simulation
        return (substep(state, inputs, physics.car, physics.wheels, physics.resources, physics.h),)


class _Judge(nn.Module):
    """Result of a control step, and what is to be seen."""

    def __init__(self, env: RacingEnv, measures: RacingMeasures, names: Sequence[str]) -> None:
        super().__init__()
        self.env, self.measures, self.names = env, measures, tuple(names)
        self.size = CarSize.of(env.garage.car)

    def forward(self, memory: Tensor, action: Tensor, style: Tensor, old: Tensor, new: Tensor) -> tuple[Tensor, ...]:
        env = self.env
        _, run, compound, seen = _recall(memory, env)
        verdict = env.referee.judge(
            old, new, run, action.clamp(-1.0, 1.0), compound, env.simulation.car, env.simulation.wheels
        )
        transition = {
            STYLE: style,
            ("next", "observation"): verdict.observation,
            ("next", STYLE_FEATURES): verdict.features,
            ("next", "telemetry"): verdict.telemetry,
        }
        found = self.measures.step(transition)  # pyright: ignore[reportArgumentType]
        found[KILOMETRES] = found["pace"] * (CONTROL_STEP / 1000.0)
        found |= {"wear_per_km": 100.0 * found["wear"], "fuel_per_km": found["fuel"]}
        figures, marks, gauges, view, seen = _see(verdict.state.numpy()[:, 0], seen.numpy()[0], self.size)
        after = torch.cat([verdict.state.T, verdict.run.T, compound.T, torch.from_numpy(seen)[None]], dim=1)
        return (
            verdict.observation,
            torch.stack([found[name] for name in self.names], dim=1),
            *(torch.from_numpy(values)[None] for values in (figures, marks, gauges, view)),
            after,
            verdict.terminated,
        )


def _racing_steps(env: RacingEnv, family: str, style: Tensor) -> Steps:
    """Return a control step of a car that is alone, from its environment after a reset and a style (1, d)."""
    # The functions are those of the environment and of the domain's scene. The whole state is one row: state of the
    # physics, state of the task, compound, and what the picture remembers.
    names = [measure.name for measure in MEASURES[family]]
    return Steps(
        command=_Command(env),
        advance=_Advance(env),
        substeps=env.simulation.substeps,
        judge=_Judge(env, RacingMeasures(family), names),
        memory=memory_of(env)[:1],
        action=torch.zeros(1, 2),
        style=style,
    )


def memory_of(env: RacingEnv) -> Tensor:
    """Return the whole states (N, S) of cars that are alone, at the start of an episode."""
    rows, size = torch.cat([env.state.T, env.run.T, env.compound.T], dim=1), CarSize.of(env.garage.car)
    seen = [torch.from_numpy(_start(state, size)[-1]) for state in env.state.T.cpu().numpy()]
    return torch.cat([rows, torch.stack(seen)], dim=1)


def racing_web(
    space: StyleSpace, family: str, told: Recorded, make_env: Callable[..., RacingEnv], **options: Any
) -> StepPart:
    """Return the part of the page of a car that is alone.

    Args:
        space: The agent's style space.
        family: Name of the family, "drift" or "resources".
        told: Title and summary of the page.
        make_env: Function that makes the environment in which the agent is shown.
        **options: Its options that differ, such as `track`.
    """
    make_env = partial(make_env, **options)
    env = make_env(num_envs=1, seed=0)
    env.reset()
    size, track = CarSize.of(env.garage.car), env.tracks[0]
    return StepPart(
        title=told.title,
        summary=told.summary,
        measures=MEASURES[family],
        starts=_starts(make_env(num_envs=_STARTS, seed=0)),
        physics={
            "control_step": CONTROL_STEP,
            "substeps": env.simulation.substeps,
            "episode_steps": env.episode_steps,
            "track": track.name,
        },
        terminated="retired",
        opens=OPENS[family],
        idle=IDLE.get(family, ()),
        idle_note=IDLE_NOTES.get(family, ""),
        picture="The car on its circuit, seen from behind",
        window=10.0,
        steps=_racing_steps(env, family, space.default[None]),
        figures=[body(size.kind, size.length, size.width, CARS[0]), *[wheel(size.radius)] * 4],
        backdrop=circuit(track),
        viewpoint=RacingStage.viewpoint,
        legend=[entry for entry in RacingStage.legend if entry[0] != CARS[1]],
        marks=MARKS,
        mark_size=SKID_SIZE,
        mark_height=SKID_HEIGHT,
        mark_colour=SKID,
        gauges=GAUGES,
        values=VALUES,
        map=Map(outline(track), [(0.0, 0.0)], CARS[:1]),
    )


def _recall(memory: Tensor, env: RacingEnv) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Split a whole state (1, S) into state (29, 1), task state (25, 1), compound (11, 1), and the rest (1, 17)."""
    widths = (STATE_ROWS, RUN_ROWS, len(env.compound))
    state, run, compound, seen = memory.split((*widths, memory.shape[1] - sum(widths)), dim=1)
    return state.T, run.T, compound.T, seen


def _see(state: np.ndarray, seen: np.ndarray, size: CarSize) -> tuple[np.ndarray, ...]:
    """Return figures, marks, gauges, view, and what the picture remembers, after a control step.

    Args:
        state: State (29,) after the step.
        seen: What the picture remembers (17,): angles, slips and places of the wheels, and the camera's direction.
        size: Size of the car.
    """
    rolled = rolled_further(state, seen[:4])
    figures, slip = car_poses(state, rolled, size), size.slip(state)
    places = figures[1:, :2]
    marks = skid_marks(seen[8:16].reshape(4, 2), seen[4:8], places, slip)
    camera = turned_camera(seen[16], aimed(state))
    return figures, marks, gauge_values(state, slip), _view(state, camera), _remember(rolled, slip, places, camera)


def _start(state: np.ndarray, size: CarSize) -> tuple[np.ndarray, ...]:
    """Return figures, gauges, view, and what the picture remembers, at the start of an episode."""
    rolled = rolled_further(state, np.zeros(4, np.float32))
    figures, slip, camera = car_poses(state, rolled, size), size.slip(state), aimed(state)
    places = figures[1:, :2]
    return figures, gauge_values(state, slip), _view(state, camera), _remember(rolled, slip, places, camera)


def _view(state: np.ndarray, camera: np.ndarray) -> np.ndarray:
    height = np.full_like(camera, RacingStage.viewpoint.height)
    return np.stack([state[ROW["x"]], state[ROW["y"]], height, camera])


def _remember(rolled: np.ndarray, slip: np.ndarray, places: np.ndarray, camera: np.ndarray) -> np.ndarray:
    return np.concatenate([rolled, slip, places.reshape(8), np.stack([camera])])


def _starts(env: RacingEnv) -> list[dict[str, list]]:
    observation = env.reset()["observation"]
    size, starts = CarSize.of(env.garage.car), []
    for state, memory, observed in zip(env.state.T.numpy(), memory_of(env), observation, strict=True):
        figures, gauges, view, _ = _start(state, size)
        start = {"memory": memory, "observation": observed, "figures": figures, "gauges": gauges, "camera": view}
        starts.append({name: values.tolist() for name, values in start.items()})
    return starts

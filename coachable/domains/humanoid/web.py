"""The humanoid on a page: its physics, and its features as one function with explicit memory."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from coachable.domains.humanoid.metrics import FORWARD_SPEED, HumanoidMeasures
from coachable.domains.humanoid.stage import web_scene
from coachable.envs.humanoid.env import EPISODE_STEPS, FALL_HEIGHT, PUSH_DURATION, STEP_MAX, HumanoidEnv
from coachable.envs.humanoid.features import WALK, WALK_SIZE, pack_style_features
from coachable.envs.humanoid.gait import GaitTracker
from coachable.envs.humanoid.model import (
    CONTROL_STEP,
    PHYSICS_STEP,
    PHYSICS_STEPS_PER_CONTROL,
    build_model,
    dynamics_spec,
    kinematics_spec,
)
from coachable.envs.humanoid.observation import observe
from coachable.envs.humanoid.simulation import read_kinematics
from coachable.export.web.part import Measure, WebPart
from coachable.keys import STYLE, STYLE_FEATURES
from coachable.styles import StyleSpace

HEADING = "heading"  # direction of travel, of which the domain measures only the parts along and across the course
OPENS = {"pose": "t_pose", "step_length": 0.50}  # what is easy to see
MEASURES = (
    Measure("pose_held", "pose", "arms in this pose", share=True),
    Measure("step_length", "step_length", "last steps", "m", at_marks=True),
    Measure("forward_speed", "", "speed", "m/s"),
    Measure(HEADING, "course", "walks towards", "deg", circular=True),
)
GAIT_MEASURES = (*MEASURES[:2], Measure("speed", "speed", "speed", "m/s"), MEASURES[3])
PUSH_FORCE = 120.0  # [N]
_STARTS = 16


class WalkFeatures(nn.Module):
    """Observation, gait and measured style of one walker, as a function of the simulator's raw quantities.

    It calls the functions of the environment and its measures and adds none of its own, so that an exported graph
    computes what training computes. Forces and powers are left out: their entries in the memory stay 0.

    Args:
        measures: The domain's measured style.
        names: Names of the measures to return.
        step_max: Option of the `HumanoidEnv`.
    """

    def __init__(self, measures: HumanoidMeasures, names: Sequence[str], step_max: float = STEP_MAX) -> None:
        super().__init__()
        self.measures, self.names, self.step_max = measures, tuple(names), step_max
        self.model = build_model()
        empty = GaitTracker.create(1, step_max).arrays()
        ends = np.cumsum([array.size for array in empty.values()]).tolist()
        places = zip(empty.items(), [0, *ends[:-1]], ends, strict=True)
        self._memory = [(name, begin, end, array.shape, array.dtype.type) for (name, array), begin, end in places]

    def example(self, style: Tensor) -> dict[str, Tensor]:
        """Return example arguments by name.

        Args:
            style: A raw style (1, d).
        """
        sizes = {
            "positions": self.model.dynamics.nq,
            "velocities": self.model.dynamics.nv,
            "sensors": self.model.kinematics.nsensordata,
            "controls": 1,
        }
        arguments = {name: torch.rand(1, size, dtype=torch.float64) for name, size in sizes.items()}
        return arguments | {"style": style, "memory": torch.zeros(1, self._memory[-1][2], dtype=torch.float64)}

    def forward(
        self, positions: Tensor, velocities: Tensor, sensors: Tensor, controls: Tensor, style: Tensor, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """Return what `coachable.export.web.part.WebPart.features` returns.

        Args:
            positions: Positions of the simulator (1, nq).
            velocities: Velocities of the simulator (1, nv).
            sensors: Sensors of the kinematics model (1, S).
            controls: Live controls (1, 1): the course [deg].
            style: Raw style (1, d).
            memory: Memory of the gait (1, M).
        """
        state, speeds = positions.numpy(), velocities.numpy()
        course = np.deg2rad(controls.numpy()[:, 0])
        gait, model = self._recall(memory.numpy()), self.model
        kinematics = read_kinematics(sensors.numpy(), model)
        report = gait.update(kinematics, state[:, model.knee_positions], np.zeros((1, 2)), course)
        features = pack_style_features(state[:, model.arm_positions], report)
        observation = torch.from_numpy(observe(state, speeds, kinematics, course, gait.observe(course)))
        transition: Any = {
            STYLE: style,
            ("next", "observation"): observation,
            ("next", STYLE_FEATURES): torch.from_numpy(features),
            ("next", WALK): torch.zeros(1, WALK_SIZE),
        }
        measured = self.measures.step(transition)
        forward, left = observation[:, FORWARD_SPEED], observation[:, FORWARD_SPEED + 1]
        measured[HEADING] = (controls[:, 0] + torch.atan2(left, forward).rad2deg()).float()
        place = gait.prints[np.arange(1), report.foot]
        ahead = place - kinematics.feet[np.arange(1), report.foot, :2]
        mark = np.concatenate([place, ahead, report.foot[:, None]], axis=1)
        mark = np.where(report.completed[:, None], mark, np.nan)
        return (
            observation,
            torch.stack([measured[name] for name in self.names], dim=1),
            torch.from_numpy(mark),
            torch.from_numpy(_remember(gait)),
            torch.from_numpy(kinematics.head_height < FALL_HEIGHT),
        )

    def _recall(self, memory: np.ndarray) -> GaitTracker:
        arrays = {
            name: memory[:, begin:end].copy().reshape(shape).astype(dtype)
            for name, begin, end, shape, dtype in self._memory
        }
        return GaitTracker(**arrays, step_max=self.step_max)


def _remember(gait: GaitTracker) -> np.ndarray:
    rows = [array.reshape(len(array), -1).astype(np.float64) for array in gait.arrays().values()]
    return np.concatenate(rows, axis=1)


def humanoid_web(
    space: StyleSpace,
    measures: HumanoidMeasures,
    shown: Sequence[Measure] = MEASURES,
    step_max: float = STEP_MAX,
) -> WebPart:
    """Return the humanoid's part of the page.

    Args:
        space: The agent's style space.
        measures: The domain's measured style.
        shown: Those of them that the page shows.
        step_max: Option of the `HumanoidEnv`.
    """
    asked = "an arm pose, a step length and a speed" if "speed" in space else "a step length and an arm pose"
    features = WalkFeatures(measures, [measure.name for measure in shown], step_max)
    return WebPart(
        title="A walker that you coach",
        summary=f"Ask for {asked}, and see beside each request what the walker does.",
        dynamics=_xml(dynamics_spec()),
        kinematics=_xml(kinematics_spec()),
        features=features,
        example=features.example(space.sample((1,))),
        measures=shown,
        starts=_starts(step_max),
        physics={
            "control_step": CONTROL_STEP,
            "physics_step": PHYSICS_STEP,
            "substeps": PHYSICS_STEPS_PER_CONTROL,
            "episode_steps": EPISODE_STEPS,
            "fall_height": FALL_HEIGHT,
            "step_max": step_max,
        },
        push={"force": PUSH_FORCE, "duration": PUSH_DURATION},
        followed="torso",
        scene=web_scene(),
        opens=OPENS,
        terminated="fell",
        picture="The walker, seen from the side",
        licence="The humanoid's model is from dm_control, Copyright The dm_control Authors, Apache-2.0.",
    )


def _xml(spec: Any) -> str:
    """Return a specification as XML, without the textures, which would take most of the loading time."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in spec.textures:
        spec.delete(texture)
    spec.compile()
    return spec.to_xml()


def _starts(step_max: float) -> list[dict[str, list[float]]]:
    env = HumanoidEnv(num_envs=_STARTS, num_threads=1, seed=0, step_max=step_max)
    try:
        observation = env.reset()["observation"]
        memory, positions = _remember(env.gait), env.simulation.positions
        rows = zip(positions, memory, observation, strict=True)
        return [{"positions": p.tolist(), "memory": m.tolist(), "observation": o.tolist()} for p, m, o in rows]
    finally:
        env.close()

"""Off-screen images of one humanoid."""

from __future__ import annotations

from typing import cast

import mujoco
import numpy as np
from torchrl.envs import EnvBase

from coachable.envs.humanoid.env import HumanoidEnv
from coachable.envs.humanoid.model import load_spec
from coachable.offscreen import OffscreenMujoco

CAMERA_DISTANCE = 3.2  # [m]
CAMERA_ELEVATION = -12.0  # [deg]
# Seen from the right-hand front, so that arms and both legs are visible.
CAMERA_AZIMUTH = 125.0  # [deg] relative to the course


class HumanoidRenderer:
    """Renderer of one humanoid of a `HumanoidEnv` or of an environment around it; the camera follows the torso.

    Args:
        width: Width of the image [px].
        height: Height of the image [px].

    Raises:
        RenderingError: If no OpenGL library is installed.
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        spec = load_spec()
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._offscreen = OffscreenMujoco(self._model, width, height)
        camera = self._offscreen.camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.distance, camera.elevation = CAMERA_DISTANCE, CAMERA_ELEVATION

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Return an image (height, width, 3) uint8 of the current state of one row."""
        while not isinstance(env, HumanoidEnv):
            env = cast(EnvBase, env.base_env)
        positions, course = env.simulation.positions[row], float(env.course[row])
        self._data.qpos[:] = positions
        mujoco.mj_forward(self._model, self._data)
        camera = self._offscreen.camera
        camera.lookat[:] = (positions[0], positions[1], 0.9)  # a fixed height, because the torso moves up and down
        camera.azimuth = CAMERA_AZIMUTH + np.rad2deg(course)
        return self._offscreen.draw(self._data)

    def close(self) -> None:
        """Release the OpenGL context."""
        self._offscreen.close()

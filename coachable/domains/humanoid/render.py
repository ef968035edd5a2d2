"""Frames of one humanoid, headless."""

from __future__ import annotations

import mujoco
import numpy as np

from coachable.envs.humanoid.model import NUM_POSITIONS, load_spec
from coachable.offscreen import OffscreenMujoco

CAMERA_DISTANCE = 3.2  # [m]
CAMERA_ELEVATION = -12.0  # [deg]
# Seen from the right-hand front, so that arms and both legs are visible.
CAMERA_AZIMUTH = 125.0  # [deg] relative to the course


class HumanoidRenderer:
    """Draws a humanoid's state as an RGB image, the camera following the torso.

    Args:
        width: image width [px].
        height: image height [px].
        shadows: draw shadows and reflections, which cost three to four times the rest in software.

    Raises:
        RuntimeError: if no OpenGL library is installed; names the package that gives one.
    """

    def __init__(self, width: int = 640, height: int = 480, *, shadows: bool = False) -> None:
        spec = load_spec()
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._offscreen = OffscreenMujoco(self._model, width, height, shadows=shadows)
        camera = self._offscreen.camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.distance, camera.elevation = CAMERA_DISTANCE, CAMERA_ELEVATION

    def draw(self, positions: np.ndarray, course: float = 0.0) -> np.ndarray:
        """Image of a posture.

        Args:
            positions: (28,) generalised positions.
            course: direction that counts as forward [rad].

        Returns:
            (height, width, 3) uint8.
        """
        if positions.shape != (NUM_POSITIONS,):
            raise ValueError(f"expected {NUM_POSITIONS} generalised positions, got shape {positions.shape}")
        self._data.qpos[:] = positions
        mujoco.mj_forward(self._model, self._data)
        camera = self._offscreen.camera
        camera.lookat[:] = (positions[0], positions[1], 0.9)  # a fixed height, steady while the torso bobs
        camera.azimuth = CAMERA_AZIMUTH + np.rad2deg(course)
        return self._offscreen.draw(self._data)

    def close(self) -> None:
        """Release the OpenGL context."""
        self._offscreen.close()

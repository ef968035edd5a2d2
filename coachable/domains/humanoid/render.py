"""Frames of one humanoid, headless."""

from __future__ import annotations

from importlib import import_module

import mujoco
import numpy as np

from coachable.envs.humanoid.model import NUM_POSITIONS, load_spec
from coachable.gl import INSTALL_HINT, NO_BACKEND, RenderingError, choose_gl_backend

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
        self._gl = _make_gl_context(width, height)
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, maxgeom=1000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = shadows
        self._option = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.distance, self._camera.elevation = CAMERA_DISTANCE, CAMERA_ELEVATION

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
        # A fixed height keeps the horizon steady while the torso bobs.
        self._camera.lookat[:] = (positions[0], positions[1], 0.9)
        self._camera.azimuth = CAMERA_AZIMUTH + np.rad2deg(course)
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        self._gl.make_current()
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        image = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(image, None, self._viewport, self._context)
        return np.flipud(image)

    def close(self) -> None:
        """Release the OpenGL context."""
        self._context.free()
        self._gl.free()


def _make_gl_context(width: int, height: int):
    """An OpenGL context of the chosen backend, made current.

    `mujoco.Renderer` is not used because it knows only the backend that was set when MuJoCo was first imported.
    """
    backend = choose_gl_backend()
    if backend == NO_BACKEND:
        raise RenderingError(INSTALL_HINT)
    try:
        context = import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise RenderingError(f"MUJOCO_GL={backend} failed ({error}): {INSTALL_HINT}") from error
    return context

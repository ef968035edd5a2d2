"""Offscreen rendering of MuJoCo models."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from coachable.gl import INSTALL_HINT, NO_BACKEND, RenderingError, choose_gl_backend


class OffscreenMujoco:
    """Renderer that draws states of a MuJoCo model as RGB images.

    `mujoco.Renderer` is not used because it supports only the backend that was set when MuJoCo was first imported. Use
    and close this object in the thread in which it was made, to which the OpenGL context belongs.

    Args:
        model: Compiled model, with an offscreen buffer of at least the size of the image.
        width: Image width [px].
        height: Image height [px].
        most: Largest number of geoms of a picture.
        haze: Whether what is far fades, as the model's settings say.

    Raises:
        RenderingError: If no OpenGL library is installed; the message names the package to install.

    Attributes:
        camera: The model's first camera, or a free one that shows the whole model if it has none.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, most: int = 1000, haze: bool = False) -> None:
        self._model = model
        self._gl = _make_gl_context(width, height)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=most)
        for slow in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[slow] = False  # they take most of the time of software rendering
        self._scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = haze
        self._option = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self.camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, self.camera)
        if model.ncam:
            self.camera.type, self.camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0

    def draw(self, data: mujoco.MjData, decorate: Callable[[mujoco.MjvScene], None] = lambda scene: None) -> np.ndarray:
        """Draw a state.

        Args:
            data: The state.
            decorate: Function that adds geoms to the scene.

        Returns:
            An image (height, width, 3) uint8.
        """
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._option, None, self.camera, everything, self._scene)
        decorate(self._scene)
        self._gl.make_current()
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        image = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(image, None, self._viewport, self._context)
        return np.flipud(image)

    def close(self) -> None:
        """Release the OpenGL context."""
        self._gl.make_current()  # another renderer's context may be the current one
        self._context.free()
        self._gl.free()


def _make_gl_context(width: int, height: int) -> Any:
    """Make an OpenGL context of the chosen backend, and make it the current one."""
    backend = choose_gl_backend()
    if backend == NO_BACKEND:
        raise RenderingError(INSTALL_HINT)
    try:
        context = _gl_context_class(backend)(width, height)
        context.make_current()
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise RenderingError(f"MUJOCO_GL={backend} failed ({error}): {INSTALL_HINT}") from error
    return context


def _gl_context_class(backend: str) -> Any:
    """Return MuJoCo's class of OpenGL contexts of a backend, which can be imported only where the backend works."""
    if backend == "egl":
        from mujoco.egl import GLContext
    elif backend == "osmesa":
        from mujoco.osmesa import GLContext
    elif backend == "glfw":
        from mujoco.glfw import GLContext
    else:
        raise ImportError(f"there is no backend {backend}: expected egl, osmesa or glfw")
    return GLContext

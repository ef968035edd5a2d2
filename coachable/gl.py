"""Which OpenGL library renders, decided before MuJoCo is imported."""

from __future__ import annotations

import ctypes.util
import os

NO_BACKEND = "disable"


class RenderingError(RuntimeError):
    """Pictures cannot be drawn on this machine as it is."""


INSTALL_HINT = (
    "no OpenGL library was found for headless rendering; install one, e.g. on Debian `apt-get install libosmesa6` "
    "(software) or `apt-get install libegl1` (EGL), or set MUJOCO_GL to glfw, egl or osmesa"
)


def choose_gl_backend() -> str:
    """Set MUJOCO_GL where the user did not, to a backend that exists here, and return it.

    Without a display, MuJoCo and dm_control would try GLFW first, warn and fail. Software rendering by OSMesa is taken
    before EGL because it needs no device.
    """
    chosen = os.environ.get("MUJOCO_GL")
    if chosen is None:
        if os.environ.get("DISPLAY"):
            chosen = "glfw"
        elif ctypes.util.find_library("OSMesa"):
            chosen = "osmesa"
        elif ctypes.util.find_library("EGL"):
            chosen = "egl"
        else:
            chosen = NO_BACKEND
        os.environ["MUJOCO_GL"] = chosen
    return chosen

"""Choice of the OpenGL library for rendering, before MuJoCo is imported."""

import ctypes.util
import os

NO_BACKEND = "disable"


class RenderingError(RuntimeError):
    """Pictures cannot be drawn with the present settings and libraries of this machine."""


INSTALL_HINT = (
    "no OpenGL library was found for headless rendering; install one, e.g. on Debian `apt-get install libosmesa6` "
    "(software) or `apt-get install libegl1` (EGL), or set MUJOCO_GL to glfw, egl or osmesa"
)


def choose_gl_backend() -> str:
    """Set the environment variable MUJOCO_GL to an available backend, unless you have set it, and return it.

    Without a display, MuJoCo and dm_control would try GLFW first, warn and fail. Software rendering by OSMesa is
    preferred to EGL because it needs no device.
    """
    if "MUJOCO_GL" not in os.environ:
        libraries = {"osmesa": "OSMesa", "egl": "EGL"}
        found = (backend for backend, library in libraries.items() if ctypes.util.find_library(library))
        os.environ["MUJOCO_GL"] = "glfw" if os.environ.get("DISPLAY") else next(found, NO_BACKEND)
    return os.environ["MUJOCO_GL"]

"""What the page shows of the agent: MuJoCo bodies in 3-D, or the domain's own picture."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from coachable.coach.session import CoachSession

if TYPE_CHECKING:
    import viser

_PICTURES_PER_SECOND = 12.0
_DRAWING_SHARE = 0.3  # of the loop's time, at most: the agent acts in the rest
_PICTURE_SIZE = (800, 600)  # [px]
_BORDER = 235  # grey
_ASPECTS = (0.25, 4.0)  # of windows that pictures are fitted to
_START = (2.0, -2.0, 1.3)  # [m], of the camera
_VISERS_START = (3.0, 3.0, 3.0)  # before a browser has heard of it
_PHONE = 576  # [px]; in narrower windows viser's panel covers the lower right


class View(Protocol):
    """Draws a session; called only in the thread that steps it."""

    def update(self) -> None:
        """Shows the present state."""
        ...

    def close(self) -> None:
        """Releases what it holds."""
        ...


class HumanoidView:
    """The humanoid in 3-D, followed by the camera, with an arrow along the course.

    mjviser is at 0.0.x: this is the only place that touches it.
    """

    def __init__(self, server: viser.ViserServer, session: CoachSession) -> None:
        import mujoco
        from mjviser import ViserMujocoScene

        from coachable.envs.humanoid.model import load_spec

        self._server, self._env = server, cast(Any, session.base_env)
        self._mujoco = mujoco
        self._model = load_spec().compile()
        self._data = mujoco.MjData(self._model)
        self._scene = ViserMujocoScene(server, self._model, num_envs=1)
        self._scene.camera_tracking_enabled = False  # it would also follow the bobbing of the torso
        self._torso = self._model.body("torso").id
        server.scene.set_up_direction("+z")
        server.initial_camera.position = _START
        server.initial_camera.look_at = (0.0, 0.0, 0.85)
        server.on_client_connect(_watch_from_above_the_panel)
        self._arrow: Any = None
        self._course: float | None = None

    def update(self) -> None:
        """See `View.update`. The world moves, so that the camera, which belongs to the viewer, need not."""
        self._data.qpos[:] = self._env.simulation.positions[0]
        self._mujoco.mj_kinematics(self._model, self._data)
        offset = np.array([*self._data.xpos[self._torso, :2], 0.0])
        with self._server.atomic():
            self._scene.update_from_arrays(self._data.xpos[None] - offset, self._data.xmat.reshape(1, -1, 3, 3))
            self._scene.fixed_bodies_frame.position = -offset
            self._point(float(self._env.course[0]))

    def _point(self, course: float) -> None:
        if course == self._course:
            return
        self._course = course
        ahead = np.array([np.cos(course), np.sin(course), 0.0])
        start = np.array([0.0, 0.0, 0.01]) + 0.5 * ahead
        self._arrow = self._server.scene.add_arrows(
            "/course", np.array([[start, start + 0.7 * ahead]]), colors=(31, 119, 180), shaft_radius=0.015
        )

    def close(self) -> None:
        """See `View.close`."""


def _watch_from_above_the_panel(client: viser.ClientHandle) -> None:
    """Shows the agent in the upper part of a narrow window, also after the browser has put its camera at the start."""
    _raise_agent(client.camera)
    client.camera.on_update(_raise_agent)


def _raise_agent(camera: viser.CameraHandle) -> None:
    """Takes a narrow window's camera back and points it lower, unless the user has moved it."""
    untouched = any(np.allclose(camera.position, start, atol=1e-3) for start in (_START, _VISERS_START))
    if camera.image_width <= _PHONE and untouched:
        with contextlib.suppress(ValueError):  # the browser told of a camera that cannot be
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = (3.0, -3.0, 1.3)
            camera.look_at = (0.0, 0.0, -0.9)


class PictureView:
    """The domain's renderer as the background of the page, drawn only while somebody looks, slow ones less often."""

    def __init__(self, server: viser.ViserServer, session: CoachSession) -> None:
        self._server, self._session = server, session
        self._renderer = session.domain.make_renderer(*_PICTURE_SIZE)
        self._due = 0.0

    def update(self) -> None:
        """See `View.update`."""
        now, clients = time.perf_counter(), self._server.get_clients()
        if now < self._due or not clients:
            return
        picture = self._renderer.draw(self._session.env)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a browser has just gone away
            for client in clients.values():
                camera = client.camera
                fitted = padded(picture, camera.aspect, upper_left=camera.image_width <= _PHONE)
                client.scene.set_background_image(fitted, format="jpeg", jpeg_quality=85)
        taken = time.perf_counter() - now
        self._due = now + max(1.0 / _PICTURES_PER_SECOND, taken / _DRAWING_SHARE)

    def close(self) -> None:
        """See `View.close`."""
        self._renderer.close()


_SCENES: dict[str, Callable[[viser.ViserServer, CoachSession], View]] = {"humanoid": HumanoidView}


def padded(picture: np.ndarray, aspect: float, upper_left: bool = False) -> np.ndarray:
    """A picture with borders, so that a window of that width per height does not distort it.

    Args:
        picture: (height, width, 3) uint8.
        aspect: width per height of the window, as its browser tells; far beyond those of screens it is not followed.
        upper_left: leave the borders below and on the right, otherwise the picture is in the middle.
    """
    height, width = picture.shape[:2]
    aspect = min(max(aspect, _ASPECTS[0]), _ASPECTS[1]) if aspect > 0 else width / height
    across, down = max(0, round(height * aspect) - width), max(0, round(width / aspect) - height)
    before = (0, 0) if upper_left else (down // 2, across // 2)
    sides = ((before[0], down - before[0]), (before[1], across - before[1]), (0, 0))
    return np.pad(picture, sides, constant_values=_BORDER)


class NoView:
    """A note why there is nothing to see; coaching works without."""

    def __init__(self, server: viser.ViserServer, reason: str) -> None:
        server.gui.add_markdown(f"**No view:** {reason}")

    def update(self) -> None:
        """See `View.update`."""

    def close(self) -> None:
        """See `View.close`."""


def make_view(server: viser.ViserServer, session: CoachSession) -> View:
    """The 3-D view of a domain that has one, otherwise its renderer's picture, otherwise the reason why not."""
    try:
        return _SCENES.get(session.domain.name, PictureView)(server, session)
    except (ImportError, RuntimeError) as error:  # an extra or an OpenGL library is missing
        return NoView(server, str(error))

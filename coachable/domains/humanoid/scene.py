"""3-D view of the humanoid on the live page."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from coachable.coach.page.views import PHONE
from coachable.coach.session.session import CoachSession
from coachable.envs.humanoid.model import load_spec

if TYPE_CHECKING:
    import viser

_START = (2.0, -2.0, 1.3)  # [m], initial position of the camera
_VISERS_START = (3.0, 3.0, 3.0)  # [m], viser's default until the browser receives `_START`


class HumanoidScene:
    """3-D view of the humanoid, which the camera follows, with an arrow along the course.

    Only this class uses mjviser, because mjviser's interface is not stable yet (version 0.0.x).
    """

    def __init__(self, server: viser.ViserServer, session: CoachSession) -> None:
        import mujoco
        from mjviser import ViserMujocoScene

        self._server, self._env = server, cast(Any, session.base_env)
        self._mujoco = mujoco
        self._model = load_spec().compile()
        self._data = mujoco.MjData(self._model)
        self._scene = ViserMujocoScene(server, self._model, num_envs=1)
        self._scene.camera_tracking_enabled = False  # it would also follow the torso up and down
        self._torso = self._model.body("torso").id
        server.scene.set_up_direction("+z")
        server.initial_camera.position = _START
        server.initial_camera.look_at = (0.0, 0.0, 0.85)
        server.on_client_connect(_watch_from_above_the_panel)
        self._arrow: Any = None
        self._course: float | None = None

    def update(self) -> None:
        """Show the present state; see `View.update`.

        The world moves instead of the camera, because each viewer controls their own camera.
        """
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
    """Show the agent in the upper part of a narrow window, also after the browser has reset its camera."""
    _raise_agent(client.camera)
    client.camera.on_update(_raise_agent)


def _raise_agent(camera: viser.CameraHandle) -> None:
    """Move a narrow window's camera back and point it lower, unless the user has moved it."""
    untouched = any(np.allclose(camera.position, start, atol=1e-3) for start in (_START, _VISERS_START))
    if camera.image_width <= PHONE and untouched:
        with contextlib.suppress(ValueError):  # the browser reported an invalid camera
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = (3.0, -3.0, 1.3)
            camera.look_at = (0.0, 0.0, -0.9)

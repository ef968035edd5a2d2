"""Views of the agent on the page: a 3-D scene, or the pictures of the domain's renderer."""

from __future__ import annotations

import time
import warnings
from typing import TYPE_CHECKING

import numpy as np

from coachable.coach.page.scene_view import PHONE, SceneView, View
from coachable.coach.page.widgets import escaped
from coachable.coach.session.session import CoachSession

if TYPE_CHECKING:
    import viser

_PICTURES_PER_SECOND = 12.0
_DRAWING_SHARE = 0.3  # largest share of the loop's time for drawing
_PICTURE_SIZE = (800, 600)  # [px]
_BORDER = 235  # grey
_ASPECTS = (0.25, 4.0)  # of windows that pictures are fitted to


class PictureView(View):
    """Pictures of the domain's renderer as the background of the page, drawn while a browser is connected."""

    def __init__(self, server: viser.ViserServer, session: CoachSession) -> None:
        self._server, self._session = server, session
        self._renderer = session.domain.make_renderer(*_PICTURE_SIZE)
        try:
            self._renderer.draw(session.env)
        except Exception:
            self._renderer.close()
            raise
        self._due = 0.0

    def update(self, share: float = 1.0) -> None:
        """See `View.update`."""
        now, clients = time.perf_counter(), self._server.get_clients()
        if now < self._due or not clients:
            return
        picture = self._renderer.draw(self._session.env)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a browser has just gone away
            for client in clients.values():
                camera = client.camera
                fitted = padded(picture, camera.aspect, upper_left=camera.image_width <= PHONE)
                client.scene.set_background_image(fitted, format="jpeg", jpeg_quality=85)
        taken = time.perf_counter() - now
        self._due = now + max(1.0 / _PICTURES_PER_SECOND, taken / _DRAWING_SHARE)

    def close(self) -> None:
        """See `View.close`."""
        self._renderer.close()


def padded(picture: np.ndarray, aspect: float, upper_left: bool = False) -> np.ndarray:
    """Add borders to a picture, so that a window of another aspect ratio does not distort it.

    Args:
        picture: Picture (height, width, 3) uint8.
        aspect: Width per height of the window, clamped to 0.25 to 4; other values than positive ones add no border.
        upper_left: Whether the picture is in the upper left corner instead of the middle.

    Returns:
        The picture with grey borders (height', width', 3) uint8.
    """
    height, width = picture.shape[:2]
    aspect = min(max(aspect, _ASPECTS[0]), _ASPECTS[1]) if aspect > 0 else width / height
    across, down = max(0, round(height * aspect) - width), max(0, round(width / aspect) - height)
    before = (0, 0) if upper_left else (down // 2, across // 2)
    sides = ((before[0], down - before[0]), (before[1], across - before[1]), (0, 0))
    return np.pad(picture, sides, constant_values=_BORDER)


def make_view(server: viser.ViserServer, session: CoachSession) -> View:
    """Make the domain's 3-D view if it has one, else a view of its renderer's pictures, else a note with the reason."""
    try:
        if session.domain.make_stage is not None:
            return SceneView(server, session, session.domain.make_stage())
        return PictureView(server, session)
    except Exception as error:  # an extra or an OpenGL library is missing, or the domain's own view fails
        server.gui.add_markdown(f"**No view:** {escaped(str(error))}")
        return View()  # coaching works without one

"""What the page shows of the agent: MuJoCo bodies in 3-D, or the domain's own picture."""

from __future__ import annotations

import time
import warnings
from typing import TYPE_CHECKING, Protocol

import numpy as np

from coachable.coach.session.session import CoachSession

if TYPE_CHECKING:
    import viser

_PICTURES_PER_SECOND = 12.0
_DRAWING_SHARE = 0.3  # of the loop's time, at most: the agent acts in the rest
_PICTURE_SIZE = (800, 600)  # [px]
_BORDER = 235  # grey
_ASPECTS = (0.25, 4.0)  # of windows that pictures are fitted to
PHONE = 576  # [px]; in narrower windows viser's panel covers the lower right


class View(Protocol):
    """Draws a session; called only in the thread that steps it."""

    def update(self) -> None:
        """Shows the present state."""
        ...

    def close(self) -> None:
        """Releases what it holds."""
        ...


class PictureView:
    """The domain's renderer as the background of the page, drawn only while somebody looks, slow ones less often."""

    def __init__(self, server: viser.ViserServer, session: CoachSession) -> None:
        self._server, self._session = server, session
        self._renderer = session.domain.make_renderer(*_PICTURE_SIZE)
        self._renderer.draw(session.env)  # one that cannot draw says so now
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
                fitted = padded(picture, camera.aspect, upper_left=camera.image_width <= PHONE)
                client.scene.set_background_image(fitted, format="jpeg", jpeg_quality=85)
        taken = time.perf_counter() - now
        self._due = now + max(1.0 / _PICTURES_PER_SECOND, taken / _DRAWING_SHARE)

    def close(self) -> None:
        """See `View.close`."""
        self._renderer.close()


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
        return (session.domain.make_scene or PictureView)(server, session)
    except (ImportError, RuntimeError) as error:  # an extra or an OpenGL library is missing
        return NoView(server, str(error))

"""The page's web server: on this machine only, and nothing leaves it."""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING

from coachable.extras import how_to_install

if TYPE_CHECKING:
    import viser


def make_server(host: str = "127.0.0.1", port: int = 8080) -> viser.ViserServer:
    """Starts an empty page; a port that is in use gives way to the next free one.

    Args:
        host: address to listen on. Whoever reaches it can steer, so leave it at this machine's own.
        port: first port to try.

    Raises:
        ImportError: without viser; names the extra to install.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError(f"the page needs viser and mjviser: {how_to_install('ui')}") from error

    class LocalServer(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Refuses viser's tunnel through a public host, which any browser could ask for."""

    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = LocalServer(host=host, port=port, label="coachable", verbose=False)
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="large", brand_color=(31, 119, 180)
    )
    server.gui.set_panel_label("coachable")
    server.gui.main_panel.dock_right()
    return server

"""The page's web server: on this machine only, and nothing leaves it."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from typing import TYPE_CHECKING

from coachable.extras import how_to_install

if TYPE_CHECKING:
    import viser

_PORTS = 65535
_TRIED = 100  # ports, before giving up


def make_server(host: str = "127.0.0.1", port: int = 8080) -> viser.ViserServer:
    """Starts an empty page; a port that is in use gives way to the next free one.

    Only browsers that were sent to one of the page's own names, and scripts of the page itself, are answered: see
    `coachable.coach.page.guard`.

    Args:
        host: address to listen on. Whoever reaches it can steer, so leave it at this machine's own.
        port: first port to try; 0 takes any that is free.

    Raises:
        ImportError: without viser; names the extra to install.
        OSError: if one cannot listen there.
        ValueError: if there is no such port.
    """
    if not 0 <= port <= _PORTS:
        raise ValueError(f"there is no port {port}: expected a number from 0 to {_PORTS}")
    try:
        import viser
    except ImportError as error:
        raise ImportError(f"the page needs viser and mjviser: {how_to_install('ui')}") from error
    from coachable.coach.page.guard import Guard

    class LocalServer(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Refuses viser's tunnel through a public host, which any browser could ask for."""

    guard = Guard(host)
    free = free_port(host, port)  # viser tries 1000 others for whatever reason, and then waits for ever
    with guard.around(), contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = LocalServer(host=host, port=free, label="coachable", verbose=False)
    if not guard.active:
        server.stop()
        raise ImportError(
            f"viser {viser.__version__} starts its server in another way than the guard of the page knows"
        )
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="large", brand_color=(31, 119, 180)
    )
    server.gui.set_panel_label("coachable")
    server.gui.main_panel.dock_right()
    return server


def free_port(host: str, port: int) -> int:
    """The first free port from `port` on.

    Raises:
        OSError: if one cannot listen at that address, or no port is free.
    """
    for candidate in range(port, min(port + _TRIED, _PORTS + 1)):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host or None, candidate, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            with socket.socket(family, kind, protocol) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind(address)
                return trial.getsockname()[1]
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise OSError(f"cannot listen on {host}, port {candidate}: {error.strerror or error}") from None
    raise OSError(f"no port from {port} to {candidate} is free on {host}: choose another with --port")


def page_address(host: str, port: int) -> str:
    """What to type into a browser on this machine."""
    name = "localhost" if host in ("", "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}"

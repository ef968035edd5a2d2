"""Web server of the page, which by default is reachable from this machine only."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from coachable.extras import how_to_install
from coachable.scene.palette import BLUE

if TYPE_CHECKING:
    import viser

    from coachable.coach.page.api import CoachApi
    from coachable.coach.page.guard import Guard

_PORTS = 65535
_GUARDS: WeakKeyDictionary[viser.ViserServer, Guard] = WeakKeyDictionary()
_TRIED = 100  # ports, before giving up


def make_server(host: str = "127.0.0.1", port: int = 8080) -> viser.ViserServer:
    """Start a server with an empty page.

    It answers only browsers that open one of the page's own host names, and scripts of the page itself; see
    `coachable.coach.page.guard`.

    Args:
        host: Address to listen on. Everyone who can reach it can steer the agent, so prefer the default.
        port: First port to try; if it is in use, the next free one is taken. 0 takes any free port.

    Returns:
        The running server.

    Raises:
        ImportError: If viser is not installed; the message names the extra to install.
        OSError: If the server cannot listen at that address.
        ValueError: If there is no such port.
    """
    if not 0 <= port <= _PORTS:
        raise ValueError(f"there is no port {port}: expected a number from 0 to {_PORTS}")
    try:
        import viser
    except ImportError as error:
        raise ImportError(f"the page needs viser: {how_to_install('ui')}") from error
    from coachable.coach.page.guard import Guard

    class LocalServer(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Ignore requests of browsers for viser's tunnel through a public host."""

    guard = Guard(host)
    free = free_port(host, port)  # viser itself tries 1000 ports after any error, and then waits forever
    with guard.around(), contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = LocalServer(host=host, port=free, label="coachable", verbose=False)
    _GUARDS[server] = guard
    if not guard.active:
        server.stop()
        raise ImportError(f"viser {viser.__version__} starts its server in a way that the page cannot guard")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", brand_color=BLUE)
    server.gui.set_panel_label("coachable")
    server.gui.main_panel.dock_right()
    return server


def serve_api(server: viser.ViserServer, api: CoachApi) -> None:
    """Let other programs use an API on the port of a server from `make_server`."""
    _GUARDS[server].api = api


def free_port(host: str, port: int) -> int:
    """Find the first free port of an address, from `port` on; 0 finds any free one.

    Raises:
        OSError: If one cannot listen at that address, or if 100 ports in a row are in use.
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
    """Return the address of the page for a browser on this machine, from the host and port of `make_server`."""
    from coachable.coach.page.guard import EVERYWHERE

    name = "localhost" if host in EVERYWHERE else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}"

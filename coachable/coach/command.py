"""`coachable coach`: opens the page and keeps it running."""

from __future__ import annotations

import argparse
import threading
import webbrowser
from collections.abc import Callable
from typing import Any


def add_parser(commands: Any, source_help: str, run: Callable[[argparse.Namespace], int]) -> None:
    """Adds the sub-command to the command line."""
    parser = commands.add_parser("coach", help="coach an agent while it acts, on a page in the browser")
    parser.add_argument("source", help=source_help)
    parser.add_argument("--port", type=int, default=8080, help="first port to try (default: %(default)s)")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; whoever reaches it can steer (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--open", action="store_true", dest="open_browser", help="open the page in the browser")
    parser.set_defaults(run=run)


def serve(
    source: str,
    *,
    say: Callable[[str], None],
    port: int = 8080,
    host: str = "127.0.0.1",
    seed: int = 0,
    open_browser: bool = False,
) -> None:
    """Serves the page of an agent until interrupted.

    Args:
        source: as for `CoachSession.open`.
        say: where the page's address is announced.
        port: first port to try; one that is in use gives way to the next.
        host: address to listen on.
        seed: of the first session.
        open_browser: open the page in the user's browser.

    Raises:
        CheckpointError: if there is no such agent.
        ImportError: without the extra `ui`.
    """
    from coachable.coach.server import make_server

    # First of all, so that the page is there while the agent is still being loaded.
    server = make_server(host, port)
    try:
        loading = server.gui.add_markdown(f"Loading **{source}** ...")
        found = server.get_port()
        note = "" if found == port else f" (port {port} is in use)"
        say(f"coaching {source} at http://{host}:{found}{note}; Ctrl-C ends it")
        if open_browser:
            webbrowser.open(f"http://{host}:{found}")

        from coachable.coach.page import CoachPage
        from coachable.coach.session import CoachSession

        page = CoachPage(server, CoachSession.open(source, seed=seed))
        loading.remove()
        page.start()
        threading.Event().wait()
    except KeyboardInterrupt:
        say("ended")
    finally:
        server.stop()

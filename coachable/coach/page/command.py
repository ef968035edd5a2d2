"""`coachable coach`: serve the coaching page of an agent."""

import argparse
import io
import threading
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout, suppress
from typing import Any

ENV_OPTIONS = (
    "Further options after the source belong to the agent's domain; the error for an unknown one lists the valid ones."
)


def add_parser(commands: Any, source_help: str, run: Callable[[argparse.Namespace], int]) -> None:
    """Add the sub-command `coach` to the sub-parsers of the command line; `run` returns its exit status."""
    text = "coach an agent while it acts, on a page in the browser"
    parser = commands.add_parser("coach", help=text, epilog=ENV_OPTIONS)
    parser.add_argument("source", help=source_help)
    parser.add_argument("--port", type=int, default=8080, help="first port to try (default: %(default)s)")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; whoever reaches it can steer (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--open", action="store_true", dest="open_browser", help="open the page in the browser")
    parser.set_defaults(run=run)


def read_env_options(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> dict[str, str]:
    """Return options of a domain's environment by name; the domain checks later whether they exist.

    Args:
        parser: Parser that does not know them; it ends the program if they are not pairs of a name and a value.
        arguments: `--NAME VALUE` or `--NAME=VALUE`, any number of them.
    """
    options: dict[str, str] = {}
    rest = iter(arguments)
    for argument in rest:
        name, equals, value = argument.removeprefix("--").partition("=")
        value = value if equals else next(rest, "")
        if not argument.startswith("--") or not name or not value or value.startswith("--"):
            parser.error(f"unrecognized arguments: {' '.join(arguments)}")
        options[name.replace("-", "_")] = value
    return options


def serve(
    source: str,
    *,
    say: Callable[[str], None],
    port: int = 8080,
    host: str = "127.0.0.1",
    seed: int = 0,
    open_browser: bool = False,
    env_options: Mapping[str, str] | None = None,
) -> None:
    """Serve the page of an agent until you interrupt it.

    Args:
        source: The agent, see `CoachSession.open`.
        say: Called with the address of the page as soon as the agent acts, and at the end.
        port: First port to try.
        host: Address to listen on.
        seed: Seed of the session.
        open_browser: Whether to open the page in your browser.
        env_options: Options of the domain's environment as texts.

    Raises:
        CheckpointError: If there is no such agent.
        ValueError: If the agent's domain has no such option, or not with such a value.
        ImportError: If the extra `ui` is not installed.
        OSError: If the server cannot listen at that address.
    """
    from coachable.coach.page.server import make_server, page_address

    with suppress(KeyboardInterrupt), ExitStack() as closing:
        # The server starts first, so that an address at which it cannot listen is reported at once.
        server = make_server(host, port)
        closing.callback(_quietly, server.stop)
        loading = server.gui.add_markdown("Loading the agent ...")

        from coachable.coach.page.coach_page import CoachPage
        from coachable.coach.session.session import CoachSession

        session = CoachSession.open(source, seed=seed, env_options=env_options)
        closing.callback(session.close)
        page = CoachPage(server, session)
        closing.callback(page.stop)
        loading.remove()
        page.start()
        found = server.get_port()
        address = page_address(host, found)
        note = "" if port in (0, found) else f" (port {port} is in use)"
        say(f"coaching {source} at {address}{note}; Ctrl-C ends it")
        if open_browser:
            webbrowser.open(address)
        wait()
    say("ended")


def wait() -> None:
    """Wait until interrupted."""
    threading.Event().wait()


def _quietly(stop: Callable[[], None]) -> None:
    with redirect_stdout(io.StringIO()):  # viser prints that it stops
        stop()

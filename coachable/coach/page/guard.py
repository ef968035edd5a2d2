"""Guard that restricts which requests and messages the page's web server accepts.

viser accepts requests for any host name and from any origin, and processes every message of a connection. The guard
sits between viser and the `websockets` library that it uses: it checks the headers of each request and the content of
each message.
"""

import asyncio
import contextlib
import http
import ipaddress
import logging
import math
import re
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import websockets.asyncio.server as server
from websockets import Headers
from websockets.http11 import Request, Response

from coachable.coach.page.api import PATH, PROTOCOL, CoachApi
from coachable.coach.page.looks import dressed, pad_page

EVERYWHERE = ("", "*", "0.0.0.0", "::")
"""Hosts that stand for all addresses of this machine."""

_THIS_MACHINE = ("localhost", "127.0.0.1", "::1")
_HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([^\[\]:@/\s]+))(?::\d{1,5})?", re.IGNORECASE)
_VISER = re.compile(r"viser-v[\w.+-]{1,32}")
_PAD = "/pad"  # page for keys and gamepads
_CONNECTIONS = 64  # at the same time
_LONGEST_MESSAGE = 1 << 20  # [byte]; viser's page uploads files in pieces of half this size
_UPLOADED = 16 << 20  # [byte], per connection
_PIECES = 64  # of an uploaded file
_MESSAGES_PER_SECOND = 300.0  # per connection; further messages wait
_LONGEST_TEXT = 20_000  # [characters] in a text box
_LARGEST_WINDOW = 1 << 16  # [px]
_FOREIGN_SOURCES = ("websocket", "playbackPath")  # query parameters that make the page show another server's content

_log = logging.getLogger("coachable.page")
_log.addHandler(logging.NullHandler())  # refused content must not be printed to the terminal


class Guard:
    """Guard that serves viser's page, at the address `host`, to its own origin and host names only.

    Attributes:
        active: Whether a guarded server was started.
        api: The API for other programs, once there is an agent.
    """

    def __init__(self, host: str) -> None:
        self.active = False
        self.api: CoachApi | None = None
        self._everywhere = host in EVERYWHERE
        self._names = {*_THIS_MACHINE, host.lower().strip("[]")}
        if self._everywhere:
            self._names.add(socket.gethostname().lower())

    @contextlib.contextmanager
    def around(self) -> Iterator[None]:
        """Guard the server that is started in this block; viser has no setting for this."""
        serve = server.serve
        setattr(server, "serve", self._serve(serve))  # noqa: B010, `serve` is a class
        try:
            yield
        finally:
            setattr(server, "serve", serve)  # noqa: B010

    def _serve(self, serve: Callable[..., Any]) -> Callable[..., Any]:
        def guarded(handler: Any, host: str, port: int, **settings: Any) -> Any:
            self.active = True
            asyncio.get_running_loop().set_exception_handler(_note)
            choose = settings.get("select_subprotocol") or (lambda *_: None)
            settings |= {
                "select_subprotocol": lambda c, offered: PROTOCOL if PROTOCOL in offered else choose(c, offered),
                "process_request": self._request(settings.get("process_request") or (lambda *_: None)),
                "create_connection": GuardedConnection,
                "max_size": _LONGEST_MESSAGE,
                "logger": _log,
            }
            return serve(self._handler(handler), host, port, **settings)

        return guarded

    def _handler(self, viser: Callable[..., Any]) -> Callable[..., Any]:
        async def handle(connection: Any) -> None:
            if connection.subprotocol != PROTOCOL:
                await viser(connection)
            elif self.api is None:
                await connection.close(1013, "the agent is being loaded: try again")
            else:
                await self.api.serve(connection)

        return handle

    def _request(self, answer: Callable[..., Response | None]) -> Callable[..., Response | None]:
        def judge(connection: server.ServerConnection, request: Request) -> Response | None:
            reason = self.refusal(request)
            if reason:
                return _refused(http.HTTPStatus.FORBIDDEN, reason)
            if _is_upgrade(request.headers) and len(connection.server.connections) >= _CONNECTIONS:
                return _refused(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{_CONNECTIONS} browsers are connected already")
            response = self._read(request) or answer(connection, request)
            if response is not None:
                response = dressed(response)
                response.headers.update(_protection(request.headers["Host"]))
            return response

        return judge

    def _read(self, request: Request) -> Response | None:
        """Return the answer to a request over HTTP if the path is the API's or that of the page for keys."""
        if request.path == _PAD:
            return _answered(pad_page(), "text/html; charset=utf-8")
        if not request.path.startswith(f"{PATH}/"):
            return None
        found = None if self.api is None else self.api.read(request.path)
        if found is None:
            status = http.HTTPStatus.SERVICE_UNAVAILABLE if self.api is None else http.HTTPStatus.NOT_FOUND
            return _refused(status, "the agent is being loaded" if self.api is None else "there is nothing here")
        return _answered(found, "application/json")

    def refusal(self, request: Request) -> str:
        """Return why a request is refused, or an empty text if it is accepted."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_mine(hosts[0]):
            return "this host name is not the page's own: open the page under the address that it was announced with"
        own = f"http://{hosts[0]}".lower()
        upgrade = _is_upgrade(request.headers)
        if any(origin.lower() != own for origin in origins) or len(origins) > 1 or (upgrade and not origins):
            return "only the page itself may talk to this server"
        protocol = request.headers.get("Sec-WebSocket-Protocol", "")
        if upgrade and not (protocol == PROTOCOL if request.path == PATH else _VISER.fullmatch(protocol)):
            return "this is not a connection of the page"
        if set(parse_qs(urlsplit(request.path).query, keep_blank_values=True)) & set(_FOREIGN_SOURCES):
            return "the page shows this server only"
        return ""

    def _is_mine(self, host: str) -> bool:
        """Return whether a `Host` header names this server, at any port, because ports may be forwarded."""
        match = _HOST.fullmatch(host)
        name = (match[1] or match[2]).lower() if match else ""
        return name in self._names or (self._everywhere and _is_address(name))


class GuardedConnection(server.ServerConnection):
    """Connection of a browser that passes on only the messages that the page needs."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._uploaded = 0
        self._free_at = 0.0  # time from which on the next message may be received

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next accepted message; a malformed message closes the connection."""
        while True:
            message = await super().recv(decode)
            await self._keep_pace()
            if self.subprotocol == PROTOCOL:
                return message
            try:
                wanted = _is_wanted(message)
            except Exception as error:  # random bytes can raise anything
                _log.info("a message was refused: %s", error)
                await self.close(1007, "this is not a message of the page")
                continue
            if wanted == "FileTransferPart":
                self._uploaded += len(message)
                if self._uploaded > _UPLOADED:
                    await self.close(1009, "too much was uploaded")
                    continue
            if wanted:
                return message

    async def _keep_pace(self) -> None:
        now = time.monotonic()
        self._free_at = max(self._free_at, now - 1.0) + 1.0 / _MESSAGES_PER_SECOND
        if self._free_at > now:
            await asyncio.sleep(self._free_at - now)


def _is_wanted(raw: bytes | str) -> str:
    """Return the type of a browser's message if the page needs it, otherwise ""; raise if it is none of the page."""
    if isinstance(raw, str):
        raise ValueError("got a text: expected bytes")
    message = msgspec.msgpack.decode(raw)
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ValueError("got a message without a type: expected a mapping with the entry 'type'")
    kind = message["type"]
    if kind == "GuiUpdateMessage":
        return kind if _is_value(message.get("updates")) else ""
    if kind == "ViewerCameraMessage":
        sizes = (message.get("image_width"), message.get("image_height"))
        fits = all(isinstance(size, int) and 0 < size < _LARGEST_WINDOW for size in sizes)
        return kind if fits and _is_finite([v for v in message.values() if not isinstance(v, str)]) else ""
    if kind == "FileTransferStartUpload":
        size, pieces = message.get("size_bytes"), message.get("part_count")
        fits = isinstance(size, int) and isinstance(pieces, int) and 0 <= size <= _UPLOADED and 0 <= pieces <= _PIECES
        return kind if fits else ""
    return kind if kind in ("FileTransferPart", "GuiFormSubmitMessage") else ""


def _is_value(updates: Any) -> bool:
    """Return whether an update sets the value of a widget and nothing else."""
    if not isinstance(updates, dict) or set(updates) != {"value"}:
        return False
    value = updates["value"]
    return isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= _LONGEST_TEXT)


def _is_finite(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_is_finite, value))
    return isinstance(value, int | float) and math.isfinite(value)


def _is_upgrade(headers: Headers) -> bool:
    return headers.get("Upgrade", "").lower() == "websocket"


def _is_address(name: str) -> bool:
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return False


def _refused(status: http.HTTPStatus, reason: str) -> Response:
    return _answered(f"Refused: {reason}.\n", "text/plain; charset=utf-8", status)


def _answered(text: str, kind: str, status: http.HTTPStatus = http.HTTPStatus.OK) -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": kind, "Cache-Control": "no-store", "Content-Length": str(len(body))})
    return Response(status.value, status.phrase, headers, body)


def _protection(host: str) -> dict[str, str]:
    """Return headers that forbid frames of other pages, and connections of the page to other servers."""
    policy = (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
        f"connect-src 'self' ws://{host} data: blob:; frame-ancestors 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "Cross-Origin-Resource-Policy": "same-origin",
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
    }


def _note(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error in one of viser's handlers without a traceback, because any message may cause one."""
    _log.warning("a message was not carried out: %s", context.get("exception") or context["message"])

"""`CoachApi`: coaching from other programs, as JSON over HTTP and a WebSocket on the page's port."""

import asyncio
import contextlib
import json
import math
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from websockets.exceptions import ConnectionClosed

from coachable.coach.session.bindings import Binding, make_bindings
from coachable.coach.session.loop import LiveLoop
from coachable.coach.session.readout import StyleReport
from coachable.coach.session.session import CoachSession
from coachable.files import parse_json
from coachable.styles import StyleRangeWarning

PATH = "/api"
PROTOCOL = "coachable-v1"
"""Sub-protocol of the WebSocket."""

_LONGEST = 1 << 16  # [characters] of a message
_RATES = (0.1, 50.0)  # [Hz]
_PATIENCE = 5.0  # [s] until a change has been made
_STATE = f"{PATH}/state"
_SPACE = f"{PATH}/space"


class CoachApi:
    """Access of other programs to a session that a loop steps.

    Requests are JSON objects with the entry `do`; docs/guides/coach_from_code.md lists them. Every change is made in
    the loop's thread before the next step, as those of the page are.
    """

    def __init__(self, loop: LiveLoop) -> None:
        self._loop = loop
        self._bindings = make_bindings(loop.session.space, loop.session.domain.controls)
        self._space = _describe(loop.session, self._bindings)
        self._state: dict[str, Any] = {}
        self._rates: dict[object, float] = {}
        self._lock = threading.Lock()  # of the rates, which two threads use
        self._due = 0.0

    def on_step(self) -> None:
        """Publish the state as often as the fastest subscriber wants; the loop's thread calls this after a step."""
        with self._lock:
            rate = max(self._rates.values(), default=0.0)
        now = time.perf_counter()
        if rate and now >= self._due:
            self._due = now + 1.0 / rate
            self.publish(self._loop.session.report())

    def publish(self, report: StyleReport) -> None:
        """Replace the state that other programs read, in the loop's thread."""
        session = self._loop.session
        self._state = {
            "step": session.step_count,
            "time": session.step_count * session.domain.control_step,
            "paused": self._loop.paused,
            "problem": self._loop.problem,
            "controls": session.controls,
            **asdict(report),
        }

    def read(self, path: str) -> str | None:
        """Return the answer to an HTTP request as JSON, or None if there is nothing at the path."""
        found = {_SPACE: self._space, _STATE: self._state}.get(path)
        return None if found is None else json.dumps(found)

    async def serve(self, connection: Any) -> None:
        """Answer the messages of a WebSocket until it closes."""
        key, sending = object(), None
        try:
            async for message in connection:
                answer, rate = await self._answer(message)
                await connection.send(json.dumps(answer))
                if rate is not None:
                    if sending is not None:
                        sending.cancel()
                    self._subscribe(key, rate)
                    sending = asyncio.create_task(self._send(connection, rate)) if rate else None
        except ConnectionClosed:
            pass
        finally:
            self._subscribe(key, 0.0)
            if sending is not None:
                sending.cancel()

    def _subscribe(self, key: object, rate: float) -> None:
        with self._lock:
            self._rates.pop(key, None)
            if rate:
                self._rates[key] = rate

    async def _send(self, connection: Any, rate: float) -> None:
        """Send each new state, at most `rate` times per second."""
        sent: dict[str, Any] = {}
        with contextlib.suppress(ConnectionClosed):
            while True:
                if self._state and self._state is not sent:
                    sent = self._state
                    await connection.send(json.dumps({"state": sent}))
                await asyncio.sleep(1.0 / rate)

    async def _answer(self, message: str | bytes) -> tuple[dict[str, Any], float | None]:
        """Return the answer to a message, and the rate of a new subscription."""
        try:
            request = _parse(message)
        except ValueError as error:
            return {"error": str(error)}, None
        echo = {"id": request["id"]} if "id" in request else {}
        try:
            answer, rate = await self._carry_out(request)
        except ValueError as error:
            return {**echo, "error": str(error)}, None
        return {**echo, **answer}, rate

    async def _carry_out(self, request: Mapping[str, Any]) -> tuple[dict[str, Any], float | None]:
        what = request.get("do")
        if what == "space":
            return {"space": self._space}, None
        if what == "read":
            return {"state": self._state}, None
        if what == "subscribe":
            rate = _number("rate", request.get("rate"))
            if rate and not _RATES[0] <= rate <= _RATES[1]:
                raise ValueError(f"rate = {rate:g}: expected 0, or {_RATES[0]:g} to {_RATES[1]:g} per second")
            return {"rate": rate}, rate
        return await self._change(_bound(what, request, self._bindings) or _change_of(what, request)), None

    async def _change(self, change: Callable[[CoachSession], Any]) -> dict[str, Any]:
        """Make a change in the loop's thread and return what is then in force."""
        running = asyncio.get_running_loop()
        done: asyncio.Future[dict[str, Any]] = running.create_future()

        def finish(answer: dict[str, Any]) -> None:
            if not done.done():
                done.set_result(answer)

        def make(session: CoachSession) -> None:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", StyleRangeWarning)  # the answer has what lies outside
                    change(session)
                report = session.report()
                self.publish(report)  # so that a state which is read after the answer has the change
                answer = {"style": session.style, "controls": session.controls, "outside": report.outside}
            except Exception as error:  # the client must not wait for an answer that never comes
                answer = {"error": str(error) or type(error).__name__}
            with contextlib.suppress(RuntimeError):  # the server has stopped meanwhile
                running.call_soon_threadsafe(finish, answer)

        self._loop.submit(make)
        try:
            return await asyncio.wait_for(done, _PATIENCE)
        except TimeoutError:
            raise ValueError(f"the request was not carried out within {_PATIENCE:g} s") from None


def _describe(session: CoachSession, bindings: Sequence[Binding]) -> dict[str, Any]:
    """Return the declarations that a program needs to coach a session, as plain values for JSON."""
    space = session.space.to_dict()
    controls = [asdict(c.parameter) | {"circular": c.circular} for c in session.domain.controls]
    push = session.domain.push
    return {
        "domain": session.domain.name,
        "control_step": session.domain.control_step,
        "parameters": space["parameters"],
        "controls": controls,
        "push": None if push is None else {"largest": push.largest, "unit": push.unit},
        "presets": dict(session.presets),
        "units": dict(session.domain.units),
        "names": dict(session.domain.words.names),
        "bindings": [asdict(binding) for binding in bindings],
    }


def _parse(message: str | bytes) -> dict[str, Any]:
    request = parse_json(message, "the message", _LONGEST)
    if not isinstance(request, dict):
        raise ValueError(f"the message is a {type(request).__name__}: expected an object with the entry 'do'")
    own = request.get("id", 0)
    if not isinstance(own, int | str) and not (isinstance(own, float) and math.isfinite(own)):
        raise ValueError("the id of the message is neither a number nor a text")
    return request


def _change_of(what: Any, request: Mapping[str, Any]) -> Callable[[CoachSession], Any]:
    if what == "set":
        style = _values("style", request.get("style"))
        return lambda session: session.set(**_known(style, session.space.names))
    if what == "steer":
        controls = {name: _number(name, value) for name, value in _values("controls", request.get("controls")).items()}
        return lambda session: session.steer(**_known(controls, session.controls))
    if what == "push":
        forward, left = (_number(name, request.get(name, 0.0)) for name in ("forward", "left"))
        return lambda session: session.push(forward, left)
    if what == "reset":
        seed = request.get("seed")
        if seed is not None and type(seed) is not int:
            raise ValueError(f"seed = {seed!r}: expected a whole number")
        return lambda session: session.reset(seed)
    expected = "'space', 'read', 'subscribe', 'set', 'steer', 'press', 'move', 'push' or 'reset'"
    raise ValueError(f"do = {str(what)[:40]!r}: expected {expected}")


def _bound(what: Any, request: Mapping[str, Any], bindings: Sequence[Binding]) -> Callable[[CoachSession], Any] | None:
    """Return the change of a key, button or axis that was used, or None for other requests."""
    if what == "press":
        given = request.get("key", request.get("button"))
        for binding in bindings:
            pair: tuple[Any, ...] = binding.keys if "key" in request else binding.buttons
            if type(given) in (str, int) and given in pair:
                return lambda session: binding.press(session, 1 if pair.index(given) else -1)
        raise ValueError(f"nothing is bound to {str(given)[:40]!r}: expected a key or button of the bindings")
    if what == "move":
        axis, position = request.get("axis"), _number("position", request.get("position"))
        found = next((b for b in bindings if b.axis is not None and type(axis) is int and b.axis == axis), None)
        if found is None:
            raise ValueError(f"nothing is bound to axis {str(axis)[:40]}: expected an axis of the bindings")
        return lambda session: found.move(session, position)
    return None


def _known(values: Mapping[str, Any], names: Any) -> Mapping[str, Any]:
    """Check names before they become keywords."""
    unknown = [name[:40] for name in values if name not in names]
    if unknown:
        raise ValueError(f"nothing is named {unknown[0]!r}: expected some of {list(names)}")
    return values


def _values(what: str, values: Any) -> dict[str, float | str]:
    if not isinstance(values, dict) or not values:
        raise ValueError(f"{what} is missing: expected values by name")
    return {name: value if isinstance(value, str) else _number(name, value) for name, value in values.items()}


def _number(name: str, value: Any) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):
            if math.isfinite(float(value)):
                return float(value)
    raise ValueError(f"{name[:40]} = {str(value)[:40]}: expected a number")

"""`CoachPage`: the coaching page in the browser, a client of `CoachSession`."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from coachable.coach.page.api import CoachApi
from coachable.coach.page.film import FilmStudio
from coachable.coach.page.server import serve_api
from coachable.coach.page.views import View, make_view
from coachable.coach.page.widgets import Chart, MeasuredText, ParameterWidget, escaped, write
from coachable.coach.phrases.grammar import Understanding
from coachable.coach.session.loop import LiveLoop
from coachable.coach.session.plan import read_plan
from coachable.coach.session.readout import StyleReport
from coachable.coach.session.recording import Recording
from coachable.coach.session.session import CoachSession
from coachable.domain import Domain, Push
from coachable.evaluation.wording import measured_text, measures_by_parameter, with_unit
from coachable.keys import TASK_REWARD
from coachable.styles import Parameter, StyleSpace

if TYPE_CHECKING:
    import viser

_FRAMES_PER_SECOND = 45.0  # at most
_REPORTS_PER_SECOND = 5.0
_OVERLAYS_PER_SECOND = 10.0
_FILM_SECONDS = 10.0
_SPEEDS = (0.1, 4.0)
_LONGEST_PHRASE, _LONGEST_PLAN, _LONGEST_NAME = 200, 2000, 40  # characters
_PRESETS = 50
_STRENGTHS = 20  # of a push, that the slider can have
_DIRECTIONS = {"forward": (1.0, 0.0), "left": (0.0, 1.0), "back": (-1.0, 0.0), "right": (0.0, -1.0)}  # of a push
_LARGEST_FILE = 8 << 20  # [byte]
_S = TypeVar("_S", str, bytes)
_T = TypeVar("_T")
_PAUSE, _RESUME, _STEP, _RESET = "Pause", "Resume", "Step", "Reset"


class CoachPage:
    """Widgets, view and read-outs of one session.

    Every browser that opens the page shows and steers the same session. Widgets submit their requests to the loop,
    which makes them before the next step.

    Args:
        server: Server with an empty page.
        session: The session; after `start`, only the loop's thread may use it.

    Attributes:
        loop: Loop that steps the session.
        widgets: Widgets by parameter name, including the live controls.
        push_strength: Slider of the strength of a push, where the domain has one.
        push_buttons: Buttons of its directions.
    """

    def __init__(self, server: viser.ViserServer, session: CoachSession) -> None:
        self.server, self.session = server, session
        self.loop = LiveLoop(session, self._on_step, on_stop=self._close_view, on_wait=self._draw)
        self._api = CoachApi(self.loop)
        self._view: View | None = None
        self._reading = threading.Lock()
        self._studio = FilmStudio(session, lambda note: write(self.film_note, escaped(note)))
        self._frame_due = self._report_due = self._overlay_due = 0.0
        self.widgets: dict[str, ParameterWidget] = {}
        self.measured: dict[str, MeasuredText] = {}
        self.overlay = server.gui.add_html("")
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Coach"):  # requests come first, right after the scene
            self._add_style()
            self._add_influences()
            self._add_phrase_box()
            self.view_folder = server.gui.add_folder("View")
        with tabs.add_tab("Plan"):
            self._add_presets()
        with tabs.add_tab("Session"):
            self._add_session()
        self.status = server.gui.add_markdown("")
        self._add_run()
        server.gui.add_html('<p class="links"><a href="/pad" target="_blank">Keyboard and gamepad</a></p>')

    def start(self) -> None:
        """Start the loop, and let other programs coach the session, too."""
        self.loop.start()
        serve_api(self.server, self._api)

    def stop(self) -> None:
        """End the loop; the session stays open."""
        self.loop.stop()
        self._studio.close()

    def _close_view(self) -> None:
        """Close the view, in the loop's thread, to which its OpenGL context belongs."""
        if self._view is not None:
            self._view.close()

    def _add_style(self) -> None:
        domain, space, gui = self.session.domain, self.session.space, self.server.gui
        with gui.add_folder("Style"):
            for parameter in space.parameters:
                self._add_widget(parameter, self.session.style[parameter.name], self._set)
                self.measured[parameter.name] = MeasuredText(self.server, parameter, domain, space)
            self.others = gui.add_markdown("")
            with gui.add_folder("Further measures", expand_by_default=False):
                self.further = gui.add_markdown("")
        folder = gui.add_folder("Requested and measured")
        self.chart = Chart(self.server, folder, space, domain, self.loop.show)

    def _add_influences(self) -> None:
        """Add what acts on the agent beside its style."""
        if self.session.domain.controls:
            with self.server.gui.add_folder("Steering"):
                for control in self.session.domain.controls:
                    name = control.parameter.name
                    self._add_widget(control.parameter, self.session.controls[name], self._steer)
        if self.session.domain.push is not None:
            self._add_push(self.session.domain.push)

    def _add_widget(self, parameter: Parameter, value: float | str, request: Callable[[ParameterWidget], None]) -> None:
        name = parameter.name
        title = with_unit(self.session.domain.words.name(name), parameter.unit)
        self.widgets[name] = ParameterWidget(self.server, parameter, value, lambda: request(self.widgets[name]), title)

    def _add_push(self, push: Push) -> None:
        """Add a slider for the strength of a push, and a button for each direction."""
        gui = self.server.gui
        with gui.add_folder("Push the agent"):
            step = push.largest / _STRENGTHS
            self.push_strength = gui.add_slider(f"strength [{push.unit}]", step, push.largest, step, push.largest / 2)
            self.push_buttons = gui.add_button_group("towards", tuple(_DIRECTIONS))

        def push_agent(_event: object) -> None:
            forward, left = _DIRECTIONS[self.push_buttons.value]
            strength = float(self.push_strength.value)
            self.loop.submit(lambda session: session.push(forward * strength, left * strength))

        self.push_buttons.on_click(push_agent)

    def _set(self, widget: ParameterWidget) -> None:
        def change(session: CoachSession) -> None:
            self.chart.follow(widget.parameter.name)
            session.set(**widget.take())

        self.loop.submit(change)

    def _steer(self, widget: ParameterWidget) -> None:
        self.loop.submit(lambda session: session.steer(**widget.take()))  # pyright: ignore[reportArgumentType]

    def _add_phrase_box(self) -> None:
        gui, understand = self.server.gui, self.session.understand
        with gui.add_form("In words") as form:
            examples = "; ".join(self.session.grammar.examples)
            self.phrase = gui.add_text("phrase", "", hint=f"such as: {examples}; a bit more")
            self.say = gui.add_button("Apply")
            self.answer = gui.add_markdown("")
        self.say.on_click(lambda _: form.submit())
        form.on_submit(lambda _: self._aside("phrase", self.phrase.value, _LONGEST_PHRASE, understand, self._say))

    def _say(self, session: CoachSession, understood: Understanding) -> None:
        session.follow(understood)
        write(self.answer, escaped(str(understood)))
        asked = next((name for name in understood.changes if name in session.space), None)
        if asked is not None:
            self.chart.follow(asked)

    def _aside(
        self, what: str, given: _S, longest: int, read: Callable[[_S], _T], then: Callable[[CoachSession, _T], None]
    ) -> None:
        """Read a user's input in viser's thread, so that the agent does not wait, and submit the result to the loop."""
        if len(given) > longest:
            unit = "characters" if isinstance(given, str) else "bytes"
            self.loop.refuse(f"the {what} has {len(given):,} {unit}: at most {longest:,} are read")
        elif not self._reading.acquire(blocking=False):
            self.loop.refuse("the input before is still being read")
        else:
            try:
                meant = read(given)
                self.loop.submit(lambda session: then(session, meant))
            except Exception as error:  # nothing above this thread reports it
                self.loop.refuse(str(error))
            finally:
                self._reading.release()

    def _add_run(self) -> None:
        gui = self.server.gui
        self.run = gui.add_button_group("run", (_PAUSE, _STEP, _RESET))
        self.speed = gui.add_slider("speed", *_SPEEDS, 0.1, 1.0, hint="simulated seconds per second; 1 is real time")
        self.run.on_click(lambda _: self._press(self.run.value))
        self.speed.on_update(lambda _: self._change_speed())

    def _press(self, button: str) -> None:
        if button == _STEP:
            self.loop.single_step()
        elif button == _RESET:
            self.loop.submit(lambda session: session.reset())
        elif button in (_PAUSE, _RESUME):
            self.loop.paused = button == _PAUSE
            self.loop.submit(lambda _: None)  # shows the state

    def _change_speed(self) -> None:
        low, high = _SPEEDS
        if low <= self.speed.value <= high:  # false for NaN
            self.loop.speed = float(self.speed.value)
        else:
            self.loop.refuse(f"speed = {self.speed.value}: expected a number from {low:g} to {high:g}")
            self.speed.value = self.loop.speed

    def _add_presets(self) -> None:
        gui = self.server.gui
        self._given_presets = {name.lower() for name in self.session.presets}  # which visitors must not replace
        with gui.add_folder("Presets"):
            self.preset = gui.add_dropdown("preset", list(self.session.presets))
            apply = gui.add_button("Apply preset")
            self.preset_name = gui.add_text("new name", "")
            keep = gui.add_button("Save style as preset")
        with gui.add_folder("Schedule"):
            example = next(iter(self.session.grammar.examples), "default")
            gui.add_markdown(f"One `SECONDS: PHRASE` or `SECONDS: PRESET` per line, such as `3: {example}`.")
            self.plan = gui.add_text("plan", "", multiline=True)
            self.run_plan = gui.add_button("Run schedule")
            cancel = gui.add_button("Stop schedule")

        apply.on_click(lambda _: self.loop.submit(lambda session: session.apply(self.preset.value)))
        keep.on_click(lambda _: self.loop.submit(self._save_preset))
        read, schedule = partial(read_plan, session=self.session), CoachSession.schedule
        self.run_plan.on_click(lambda _: self._aside("plan", self.plan.value, _LONGEST_PLAN, read, schedule))
        cancel.on_click(lambda _: self.loop.submit(lambda session: session.cancel()))

    def _save_preset(self, session: CoachSession) -> None:
        name = self.preset_name.value.strip()
        if not name:
            raise ValueError("give the preset a name first")
        if name.lower() in self._given_presets:
            raise ValueError(f"the preset {name!r} came with the agent: expected another name")
        if len(name) > _LONGEST_NAME or len(session.presets) >= _PRESETS:
            raise ValueError(f"expected at most {_PRESETS} presets, each name of at most {_LONGEST_NAME} characters")
        session.presets[name] = session.style
        self.preset.options = tuple(session.presets)
        self.preset.value = name

    def _add_session(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Episodes"):
            self.hold = gui.add_checkbox("hold the style", True, hint="if off, each episode draws one, as in training")
            self.seed = gui.add_number("seed", self.session.recording().seed, min=0, step=1)
            reseed = gui.add_button("Start over with seed", hint="also begins a new recording")
        with gui.add_folder("Recording"):
            save = gui.add_button("Download JSON", hint="everything since the last seed; replays exactly")
            again = gui.add_button("Replay from the start")
            self.upload = gui.add_upload_button("Replay a JSON file", mime_type="application/json")
            stop = gui.add_button("Stop replay")
            shoot = gui.add_button(f"Film the last {_FILM_SECONDS:g} s (mp4)")
            self.film_note = gui.add_markdown("")

        self.hold.on_update(lambda _: self.loop.submit(lambda session: setattr(session, "hold", self.hold.value)))
        reseed.on_click(lambda _: self.loop.submit(lambda session: session.reset(int(self.seed.value))))
        save.on_click(lambda event: self.loop.submit(lambda session: self._send_recording(session, event.client)))
        again.on_click(lambda _: self.loop.submit(lambda session: session.replay(session.recording())))
        limit, read, replay = _LARGEST_FILE, _read_recording, CoachSession.replay
        self.upload.on_upload(lambda _: self._aside("file", self.upload.value.content, limit, read, replay))
        stop.on_click(lambda _: self.loop.submit(lambda session: session.cancel()))
        shoot.on_click(lambda event: self.loop.submit(lambda session: self._shoot(session, event.client)))

    def _send_recording(self, session: CoachSession, client: viser.ClientHandle | None) -> None:
        """Send the recording to the browser that asked for it, without the path of the agent on this machine."""
        recording = session.recording()
        recording = replace(recording, source=Path(recording.source).name)
        (client or self.server).send_file_download(f"{recording.domain}.json", recording.to_json().encode())

    def _shoot(self, session: CoachSession, client: viser.ClientHandle | None) -> None:
        name, receiver = f"{session.domain.name}.mp4", client or self.server
        self._studio.shoot(session.recording(), _FILM_SECONDS, lambda film: receiver.send_file_download(name, film))

    def _on_step(self) -> None:
        """Show the state of the session; the loop calls this in its thread."""
        now = time.perf_counter()
        self._api.on_step()
        for name, value in (self.session.style | self.session.controls).items():
            with contextlib.suppress(TypeError, ValueError):  # a browser may have sent it something else than a value
                self.widgets[name].follow(value)
        if now >= self._report_due or self.loop.paused or self.session.ended is not None:
            self._report_due = now + 1.0 / _REPORTS_PER_SECOND
            report = self.session.report()
            self._api.publish(report)
            self._show(report)
        # The view comes last: if it fails, the read-outs still show the problem.
        if self._view is None:
            with self.view_folder:
                self._view = make_view(self.server, self.session)
        self._draw()

    def _draw(self) -> None:
        """Update the view, unless that was done a moment ago; the loop calls this in its thread."""
        now = time.perf_counter()
        if self._view is not None and (now >= self._frame_due or self.loop.paused):
            self._frame_due = now + 1.0 / _FRAMES_PER_SECOND
            self._view.update(self.loop.share)
            if now >= self._overlay_due or self.loop.paused:
                self._overlay_due = now + 1.0 / _OVERLAYS_PER_SECOND
                write(self.overlay, self._view.overlay)

    def _show(self, report: StyleReport) -> None:
        with self.server.atomic():
            write(self.status, self._status(report))
            buttons = (_RESUME if self.loop.paused else _PAUSE, _STEP, _RESET)
            if self.run.options != buttons:
                self.run.options = buttons
            domain, space = self.session.domain, self.session.space
            groups = measures_by_parameter(space, [*report.measured, *report.unmeasured], domain.beside)
            for name, text in self.measured.items():
                text.update(report, groups[name])
            rest = [m for m in groups[""] if m in report.measured]
            told = [m for m in rest if m in domain.columns or (not domain.columns and m != TASK_REWARD)]
            for box, names in ((self.others, told), (self.further, [m for m in rest if m not in told])):
                write(box, listed(domain, space, {name: report.measured[name] for name in names}))
            self.chart.add(self.session.step_count * self.session.domain.control_step, report)

    def _status(self, report: StyleReport) -> str:
        if self.loop.problem:
            first = f"**Problem:** {escaped(self.loop.problem)}"
        elif report.ended is not None:
            first = f"**The agent {report.ended}** after {report.episode_time:.1f} s; a new episode begins."
        else:
            first = verdict(report)
        running = "between episodes" if report.ended is not None else f"{self.loop.factor:.2f} of real time"
        state = "**paused**" if self.loop.paused else running
        if self.session.replaying:
            state += " · replaying"
        elif self.session.scheduled:
            state += f" · {self.session.scheduled} scheduled"
        endings = "".join(f" · {reason}: {count}" for reason, count in report.endings.items())
        return f"{first}\n\n{state} · episode {report.episode}, {report.episode_time:.1f} s{endings}"


def _read_recording(content: bytes) -> Recording:
    try:
        return Recording.from_json(content.decode())
    except UnicodeDecodeError:
        raise ValueError("this is not a recording: expected JSON written by a coaching session") from None


def listed(domain: Domain, space: StyleSpace, measured: Mapping[str, float]) -> str:
    """Return measured values with their names as Markdown."""
    shown = [(domain.words.name(name), measured_text(domain, space, name, value)) for name, value in measured.items()]
    texts = [f"{escaped(name)} **{escaped(value)}**" for name, value in shown]
    return f"also measured: {', '.join(texts)}" if texts else ""


def verdict(report: StyleReport) -> str:
    """Return a sentence that says whether the agent complies with the request, as far as it was measured."""
    if not report.asks:
        return "Nothing is asked for: every weight is 0."
    if report.complied_after is None:
        if report.complying is None:
            return f"Request not judged yet, after {report.since_request:.1f} s: that takes {report.needs}."
        return f"Request not yet met, after {report.since_request:.1f} s."
    first = f"first after {report.complied_after:.1f} s"
    if report.complying is None:
        return f"Request met {first}; nothing to judge in the last {report.seconds:.1f} s."
    now = f"{report.complying:.0%} of what was judged in the last {report.seconds:.1f} s"
    return f"**Request met**, {first}: {now}." if report.complying >= 0.5 else f"Request met {first}, but only {now}."

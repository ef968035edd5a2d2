"""Timeline of a session: the recording of past events, and the coming events of a plan or a replay."""

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

from torch import Tensor

from coachable.coach.session.recording import Recording, ReplayMismatch, checksum

_CHECK_EVERY = 40  # steps

Event = Mapping[str, Any]


class Timeline:
    """Past and coming events of a session, by the step before which they happen.

    Args:
        recording: Recording with the session's start and without events, which are added here.

    Attributes:
        step: Number of steps so far.
        replayed: The recording that is being replayed, or None after its last step.
    """

    def __init__(self, recording: Recording) -> None:
        self.step = 0
        self.replayed: Recording | None = None
        self._recording = recording
        self._agenda: deque[tuple[int, Event]] = deque()
        self._expected: dict[int, int] = {}
        self._repeats = False  # whether the coming events are those of a recording

    def note(self, event: Event) -> None:
        """Record an event before the next step."""
        self._recording.events.append({"step": self.step, **event})

    def plan(self, agenda: Mapping[int, Event]) -> None:
        """Replace the coming events by those of a plan, by the number of steps from now."""
        self.cancel()
        self._agenda = deque((self.step + later, agenda[later]) for later in sorted(agenda))

    def repeat(self, recording: Recording) -> None:
        """Replace the coming events by those of a recording, and compare observations with it from now on."""
        self._agenda = deque((event["step"], event) for event in recording.events)
        self.replayed, self._expected, self._repeats = recording, dict(recording.checks), True

    def cancel(self) -> None:
        """Drop all coming events."""
        self._agenda.clear()
        self.replayed, self._expected, self._repeats = None, {}, False

    def take_over(self) -> None:
        """End a replay because of a new request; a plan continues."""
        if self._repeats:
            self.cancel()

    @property
    def coming(self) -> int:
        """Number of coming events."""
        return len(self._agenda)

    def due(self) -> Iterator[Event]:
        """Take the events that happen before the next step."""
        while self._agenda and self._agenda[0][0] <= self.step:
            yield self._agenda.popleft()[1]

    def advance(self, observation: Tensor) -> None:
        """Count a step, record its checksum every 40 steps, and compare a replay with its recording.

        Args:
            observation: The observation (1, D) after the step.

        Raises:
            ReplayMismatch: If they differ; later steps are not compared.
        """
        self.step += 1
        due = self._expected.pop(self.step, None)
        if self.step % _CHECK_EVERY == 0:
            self._recording.checks.append((self.step, checksum(observation)))
        if self.replayed is not None and self.step >= self.replayed.steps:
            self.replayed = None
        if due is not None and due != checksum(observation):
            self._expected = {}
            raise ReplayMismatch(
                f"the replay differs from the recording at step {self.step}: it was made with other weights than those "
                f"of {self._recording.source!r}, with other versions, or on another processor"
            )

    def recording(self, observation: Tensor) -> Recording:
        """Return a copy of the recording up to now.

        Args:
            observation: Current observation (1, D), whose checksum is added.
        """
        copy = Recording.from_json(self._recording.to_json())
        copy.steps = self.step
        if self.step % _CHECK_EVERY:
            copy.checks.append((self.step, checksum(observation)))
        return copy

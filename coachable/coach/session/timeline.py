"""What was asked when: keeps the recording, and what is still to come of a plan or a replay."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

from torch import Tensor

from coachable.coach.session.recording import Recording, ReplayMismatch, checksum

_CHECK_EVERY = 40  # steps

Event = Mapping[str, Any]


class Timeline:
    """The events of a session, past and future, by the step before which they happen.

    Args:
        recording: empty, with the session's start; written here.

    Attributes:
        step: number of steps so far.
        replayed: the recording that is being repeated, None after its last step.
    """

    def __init__(self, recording: Recording) -> None:
        self.step = 0
        self.replayed: Recording | None = None
        self._recording = recording
        self._agenda: deque[tuple[int, Event]] = deque()
        self._expected: dict[int, int] = {}

    def note(self, event: Event) -> None:
        """Records what happens before the next step."""
        self._recording.events.append({"step": self.step, **event})

    def plan(self, agenda: Mapping[int, Event]) -> None:
        """Replaces what is to come by events at so many steps from now."""
        self.cancel()
        self._agenda = deque((self.step + later, agenda[later]) for later in sorted(agenda))

    def repeat(self, recording: Recording) -> None:
        """Replaces what is to come by a recording; from now on observations are compared with it."""
        self._agenda = deque((event["step"], event) for event in recording.events)
        self.replayed, self._expected = recording, dict(recording.checks)

    def cancel(self) -> None:
        """Drops what is to come."""
        self._agenda.clear()
        self.replayed, self._expected = None, {}

    def take_over(self) -> None:
        """Ends a replay, because somebody asked for something else; a plan goes on."""
        if self.replayed is not None:
            self.cancel()

    @property
    def coming(self) -> int:
        """Number of events that are to come."""
        return len(self._agenda)

    def due(self) -> Iterator[Event]:
        """Takes the events that happen before the next step."""
        while self._agenda and self._agenda[0][0] <= self.step:
            yield self._agenda.popleft()[1]

    def advance(self, observation: Tensor) -> None:
        """Notes a step and now and then its checksum, and compares a replay with its recording.

        Raises:
            ReplayMismatch: if they differ; the comparison ends there.
        """
        self.step += 1
        due = self._expected.pop(self.step, None)
        found = checksum(observation) if due is not None or self.step % _CHECK_EVERY == 0 else None
        if found is not None and self.step % _CHECK_EVERY == 0:
            self._recording.checks.append((self.step, found))
        source = self._recording.source
        if self.replayed is not None and self.step >= self.replayed.steps:
            self.replayed = None
        if due is not None and due != found:
            self._expected = {}
            raise ReplayMismatch(
                f"the replay differs from the recording at step {self.step}: it was made with other weights than those "
                f"of {source!r}, with other versions, or on another processor"
            )

    def recording(self, observation: Tensor) -> Recording:
        """A copy of the recording up to now, with a checksum of the present observation."""
        copy = Recording.from_json(self._recording.to_json())
        copy.steps = self.step
        if self.step % _CHECK_EVERY:
            copy.checks.append((self.step, checksum(observation)))
        return copy

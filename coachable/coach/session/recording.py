"""A coached session as JSON: the seed and what was asked when, which is enough to run it again exactly."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from coachable.domain import Control
from coachable.styles import Choice, Parameter, StyleSpace

SCHEMA_VERSION = 1


class ReplayMismatch(RuntimeError):
    """A replay does not reach the recorded states."""


@dataclass
class Recording:
    """A session since it was last seeded.

    Attributes:
        domain: name of the domain.
        source: where the policy came from, as the user gave it.
        seed: of the initial states.
        style: request at the start, by parameter name.
        controls: live controls at the start.
        endless: whether time limits were ignored.
        events: `{"step": k, ...}` in order, each applied before step k (from 0) with one of `style` (what changed),
            `controls` (what changed) and `reset` (true).
        steps: length.
        checks: step and checksum of the observation after it, by which a replay notices that it differs.
    """

    domain: str
    source: str
    seed: int
    style: dict[str, float | str]
    controls: dict[str, float]
    endless: bool = True
    events: list[dict[str, Any]] = field(default_factory=list)
    steps: int = 0
    checks: list[tuple[int, int]] = field(default_factory=list)

    def to_json(self) -> str:
        """The recording as a JSON string; floats keep every bit."""
        return json.dumps({"version": SCHEMA_VERSION, **asdict(self)}, indent=1, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Recording:
        """Reads what `to_json` wrote.

        Raises:
            ValueError: if it is no recording, or one of another version.
        """
        try:
            values = json.loads(text)
            version = values.pop("version")
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
            raise ValueError("this is no recording: expected JSON written by a coaching session") from None
        if version != SCHEMA_VERSION:
            raise ValueError(f"recording has schema version {version!r}: this release reads version {SCHEMA_VERSION}")
        try:
            recording = cls(**values)
        except TypeError as error:
            raise ValueError(f"this recording is incomplete or has unknown entries: {error}") from None
        wrong = next((name for name, is_right in _SCHEMA.items() if not is_right(getattr(recording, name))), None)
        if wrong is not None:
            raise ValueError(f"this recording's {wrong!r} is not what a coaching session writes")
        recording.checks = [(step, checksum) for step, checksum in recording.checks]
        return recording

    def check(self, domain: str, space: StyleSpace, controls: Mapping[str, Control]) -> None:
        """Sees whether a session can replay this.

        Args:
            domain: of the session.
            space: its styles.
            controls: its live controls, by name.

        Raises:
            ValueError: naming what the session lacks.
        """
        if self.domain != domain:
            raise ValueError(f"the recording belongs to {self.domain!r}, this session to {domain!r}")
        check_seed(self.seed)
        for style in (self.style, *(event.get("style", {}) for event in self.events)):
            for name, value in style.items():
                if name not in space:
                    raise ValueError(
                        f"the recording has the unknown style parameter {name!r}: {domain} has {space.names}"
                    )
                if not is_trained(space[name], value):
                    raise ValueError(f"the recording asks for {name} = {value!r}, which lies outside the trained range")
        for steering in (self.controls, *(event.get("controls", {}) for event in self.events)):
            for name, value in steering.items():
                if name not in controls:
                    raise ValueError(f"no live control named {name!r}: {domain} has {list(controls)}")
                if controls[name].fit(value) != value:
                    raise ValueError(f"the recording steers {name} = {value}, which lies outside its range")

    def save(self, file: Path | str) -> Path:
        """Writes the JSON file."""
        file = Path(file)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(self.to_json(), encoding="utf-8")
        return file

    @classmethod
    def load(cls, file: Path | str) -> Recording:
        """Reads a JSON file; see `from_json`."""
        return cls.from_json(Path(file).read_text(encoding="utf-8"))


def check_seed(seed: int) -> None:
    """Sees whether every random generator takes a seed.

    Raises:
        ValueError: if not.
    """
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed = {seed}: expected a whole number from 0 to 2**63 - 1")


def is_trained(parameter: Parameter, value: float | str) -> bool:
    """Return whether agents were trained on a value: one of the options, or a number in the range, as float32."""
    if isinstance(parameter, Choice):
        return value in parameter.options
    return not isinstance(value, str) and bool(
        np.float32(parameter.low) <= np.float32(value) <= np.float32(parameter.high)
    )


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_style(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(v, str) or _is_number(v) for v in value.values())


def _is_steering(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_number, value.values()))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_event(value: Any) -> bool:
    return isinstance(value, dict) and all(key in _EVENT and _EVENT[key](v) for key, v in value.items())


def _are_events(value: Any) -> bool:
    if not isinstance(value, list) or not all(_is_event(event) and "step" in event for event in value):
        return False
    steps = [event["step"] for event in value]
    return steps == sorted(steps)


def _are_checks(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(check, list) and len(check) == 2 and all(map(_is_count, check)) for check in value
    )


_EVENT: dict[str, Callable[[Any], bool]] = {
    "step": _is_count,
    "style": _is_style,
    "controls": _is_steering,
    "reset": lambda value: value is True,
}
_SCHEMA: dict[str, Callable[[Any], bool]] = {
    "domain": lambda value: isinstance(value, str),
    "source": lambda value: isinstance(value, str),
    "seed": _is_count,
    "style": _is_style,
    "controls": _is_steering,
    "endless": lambda value: isinstance(value, bool),
    "events": _are_events,
    "steps": _is_count,
    "checks": _are_checks,
}


def checksum(observation: Tensor) -> int:
    """Of every bit of an observation."""
    return zlib.crc32(observation.detach().cpu().contiguous().numpy().tobytes())

"""Recording of a coached session as JSON: the seed and all requests, from which it can be replayed exactly."""

from __future__ import annotations

import json
import math
import sys
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from coachable.domain import Control, Push
from coachable.outputs import complete_file
from coachable.styles import Choice, Parameter, StyleSpace

SCHEMA_VERSION = 2


class ReplayMismatch(RuntimeError):
    """A replay reaches other states than the recorded ones."""


@dataclass
class Recording:
    """Recording of a session since it was last seeded.

    Attributes:
        domain: Name of the domain.
        source: Where the policy came from, as the user gave it.
        seed: Seed of the initial states.
        style: Request at the start, by parameter name.
        controls: Live controls at the start, by name.
        events: `{"step": k, ...}` in order, each applied before step k (from 0), with one of `style` (changed
            parameters), `controls` (changed controls), `push` (forward and left) and `reset` (true).
        steps: Number of steps.
        checks: Pairs of a step and the checksum of the observation after it, with which a replay is compared.
    """

    domain: str
    source: str
    seed: int
    style: dict[str, float | str]
    controls: dict[str, float]
    events: list[dict[str, Any]] = field(default_factory=list)
    steps: int = 0
    checks: list[tuple[int, int]] = field(default_factory=list)

    def to_json(self) -> str:
        """Return the recording as a JSON string that keeps every bit of the floats."""
        return json.dumps({"version": SCHEMA_VERSION, **asdict(self)}, indent=1, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Recording:
        """Read a recording from the output of `to_json`.

        Raises:
            ValueError: If the text is not a recording, or one of another schema version.
        """
        try:
            values = json.loads(text)
            version = values.pop("version")
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
            raise ValueError("this is not a recording: expected JSON written by a coaching session") from None
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

    def check(self, domain: str, space: StyleSpace, controls: Mapping[str, Control], push: Push | None) -> None:
        """Check that a session can replay this recording, from the declarations of its domain.

        Raises:
            ValueError: If the session has another domain, or lacks a style parameter, a control, a push or a value.
        """
        if self.domain != domain:
            raise ValueError(f"the recording belongs to {self.domain!r}, this session to {domain!r}")
        check_seed(self.seed)
        for style in (self.style, *(event.get("style", {}) for event in self.events)):
            for name, value in style.items():
                if name not in space:
                    raise ValueError(f"the recording has the unknown style parameter {name!r}: expected {space.names}")
                if not is_trained(space[name], value):
                    raise ValueError(f"the recording asks for {name} = {value!r}, which lies outside the trained range")
        for steering in (self.controls, *(event.get("controls", {}) for event in self.events)):
            for name, value in steering.items():
                if name not in controls:
                    raise ValueError(f"no live control named {name!r}: {domain} has {list(controls)}")
                if controls[name].fit(value) != value:
                    raise ValueError(f"the recording steers {name} = {value}, which lies outside its range")
        for pushed in (event["push"] for event in self.events if "push" in event):
            if push is None:
                raise ValueError(f"the recording has a push: {domain} has none")
            if math.hypot(*pushed) > push.largest * (1.0 + 1e-9):
                raise ValueError(f"the recording has a push of {pushed}: expected at most {push.largest:g} {push.unit}")

    def save(self, file: Path | str) -> Path:
        """Write the recording to a JSON file, whose folder is created if missing, and return the path."""
        file = Path(file)
        file.parent.mkdir(parents=True, exist_ok=True)
        with complete_file(file) as unfinished:
            unfinished.write_text(self.to_json(), encoding="utf-8")
        return file

    @classmethod
    def load(cls, file: Path | str) -> Recording:
        """Read a recording from a JSON file; see `from_json`."""
        return cls.from_json(Path(file).read_text(encoding="utf-8"))


def check_seed(seed: int) -> None:
    """Check that every random generator takes a seed.

    Raises:
        ValueError: If it is no whole number, is negative or has more than 63 bits.
    """
    if not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise ValueError(f"seed = {seed!r}: expected a whole number from 0 to 2**63 - 1")


def is_trained(parameter: Parameter, value: float | str) -> bool:
    """Return whether a value is one of the options, or a number in the range of the parameter, as float32."""
    if isinstance(parameter, Choice):
        return value in parameter.options
    with np.errstate(over="ignore"):  # a larger number becomes infinite, which no range holds
        return not isinstance(value, str) and bool(
            np.float32(parameter.low) <= np.float32(value) <= np.float32(parameter.high)
        )


def within_json(value: float | str) -> float:
    """Return a number, or the largest one of its sign if it is infinite, which JSON does not have."""
    return min(max(float(value), -sys.float_info.max), sys.float_info.max)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e38


def _are_events(value: Any) -> bool:
    fits = isinstance(value, list) and all(
        isinstance(event, dict) and "step" in event and all(k in _EVENT and _EVENT[k](v) for k, v in event.items())
        for event in value
    )
    return fits and all(before["step"] <= after["step"] for before, after in pairwise(value))


def _are_checks(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(check, list) and len(check) == 2 and all(map(_is_count, check)) for check in value
    )


_SHARED: dict[str, Callable[[Any], bool]] = {
    "style": lambda value: isinstance(value, dict) and all(isinstance(v, str) or _is_number(v) for v in value.values()),
    "controls": lambda value: isinstance(value, dict) and all(map(_is_number, value.values())),
}
_EVENT = {
    **_SHARED,
    "step": _is_count,
    "push": lambda value: isinstance(value, list) and len(value) == 2 and all(map(_is_number, value)),
    "reset": lambda value: value is True,
}
_SCHEMA = {
    **_SHARED,
    **dict.fromkeys(("domain", "source"), lambda value: isinstance(value, str)),
    **dict.fromkeys(("seed", "steps"), _is_count),
    "events": _are_events,
    "checks": _are_checks,
}


def checksum(observation: Tensor) -> int:
    """Return the CRC-32 of every bit of an observation (1, D)."""
    return zlib.crc32(observation.detach().cpu().contiguous().numpy().tobytes())

"""`Contract`: what an exported model says about its inputs, outputs and environment, with a recorded trajectory."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from coachable.files import parse_json
from coachable.signals import Signal
from coachable.styles import StyleSpace

SCHEMA_VERSION = 3
"""Version of the file's inputs, outputs and metadata."""

_LONGEST_TEXT = 1 << 20  # [characters] of an entry of the metadata, except the recording
_LONGEST_RECORDING = 1 << 26
_MOST_NUMBERS = 1 << 24  # in the arrays of a recording
_MOST_ROWS = 10_000  # of such an array; an environment has to be stepped as often
_MOST_ENTRIES = 1 << 17  # of an observation or an action


class ContractError(ValueError):
    """The contract of a model is missing, of another version, or not what this package writes."""


@dataclass(frozen=True)
class Recorded:
    """Runs of the environment, all from the start that the seed gives. K steps have K + 1 observations.

    Attributes:
        seed: Seed of the environment.
        observation: Observations (T + 1, D) of a run of the policy.
        style: Theta (T, d) of each step of that run.
        action: Deterministic actions (T, A) of that run; the one-hots of choices come first.
        rest: Observations (K + 1, D) of a run with the neutral action: axes at 0, and the first value of each choice.
        probe_action: Actions (P, A), each neutral but for one axis or one choice.
        probe: Observations (P, D) after one step with each of them.
    """

    seed: int
    observation: np.ndarray
    style: np.ndarray
    action: np.ndarray
    rest: np.ndarray
    probe_action: np.ndarray
    probe: np.ndarray

    def to_json(self) -> str:
        """Return the seed and the arrays as JSON, the arrays as base64 of compressed little-endian float32."""
        arrays = {name: value for name, value in vars(self).items() if name != "seed"}
        packed = {name: {"shape": list(value.shape), "data": _packed(value)} for name, value in arrays.items()}
        return json.dumps({"seed": self.seed, **packed})

    @classmethod
    def from_json(cls, text: str, widths: tuple[int, int, int]) -> Recorded:
        """Read the output of `to_json`, given the widths of observation, style and action.

        Raises:
            ContractError: If it is something else, or if its arrays do not fit the widths or each other.
        """
        values = _json(text, "recording", dict, _LONGEST_RECORDING)
        seed = values.pop("seed", None)
        if type(seed) is not int or not 0 <= seed < 2**63:
            raise ContractError(f"its recording has the seed {seed!r}: expected a whole number of at least 0")
        columns = {"observation": 0, "style": 1, "action": 2, "rest": 0, "probe_action": 2, "probe": 0}
        if set(values) != set(columns):
            raise ContractError(f"its recording has the arrays {sorted(values)}: expected {sorted(columns)}")
        arrays = {name: _unpacked(name, values[name], widths[width]) for name, width in columns.items()}
        steps = len(arrays["style"])
        fits = len(arrays["action"]) == steps and len(arrays["observation"]) == steps + 1 and steps >= 1
        if not fits or len(arrays["probe"]) != len(arrays["probe_action"]) or len(arrays["rest"]) < 1:
            raise ContractError("the arrays of its recording do not have the lengths of one run")
        if len(arrays["probe"]) < 1:
            raise ContractError("its recording has no probes: expected a step with each axis and choice of the action")
        return cls(seed, **arrays)


@dataclass(frozen=True)
class Contract:
    """Description of a policy as a function of an observation and a style.

    Attributes:
        space: Style space, in the order of theta.
        observation: Blocks of the observation, in order.
        action: Blocks of the action, in order; those of choices come first.
        choice_sizes: Number of values of each choice; empty for actions of axes alone.
        domain: Name of the domain.
        control_step: Time between two actions [s], None if unknown.
        environment: Options of the environment of the training, in plain containers.
        frames: Number of frames of the training, None if unknown.
        updates: Number of updates of the training, None if unknown.
        recorded: Recorded runs, None if there are none.
    """

    space: StyleSpace
    observation: tuple[Signal, ...]
    action: tuple[Signal, ...]
    choice_sizes: tuple[int, ...]
    domain: str
    control_step: float | None
    environment: dict[str, Any]
    frames: int | None
    updates: int | None
    recorded: Recorded | None

    @property
    def widths(self) -> tuple[int, int]:
        """Widths of the observation and of the action."""
        return _width(self.observation), _width(self.action)

    def to_metadata(self) -> dict[str, str]:
        """Return the contract as strings by name, for the metadata of a file; what is unknown is left out."""
        known = {
            "schema_version": SCHEMA_VERSION,
            "domain": self.domain,
            "style_space": self.space.to_json(),
            "observation": json.dumps([asdict(signal) for signal in self.observation]),
            "action": json.dumps([asdict(signal) for signal in self.action]),
            "choice_sizes": json.dumps(self.choice_sizes) if self.choice_sizes else None,
            "control_step": self.control_step,
            "environment": json.dumps(self.environment, allow_nan=False),
            "frames": self.frames,
            "updates": self.updates,
            "recording": self.recorded.to_json() if self.recorded else None,
        }
        return {name: str(value) for name, value in known.items() if value is not None}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Contract:
        """Read the output of `to_metadata`, which may come from anybody.

        Raises:
            ContractError: If an entry is missing or is not what `to_metadata` writes; the message names it.
        """
        _check_version(metadata.get("schema_version"))
        if missing := [n for n in ("domain", "style_space", "observation", "action") if n not in metadata]:
            raise ContractError(f"its contract lacks {', '.join(missing)}")
        try:
            space = StyleSpace.from_dict(_json(metadata["style_space"], "style space", dict))
        except ContractError:
            raise
        except Exception as error:  # a description from elsewhere may raise anything
            raise ContractError(f"its style space cannot be used: {error or type(error).__name__}") from None
        observation, action = (_signals(metadata[name], name) for name in ("observation", "action"))
        sizes = _json(metadata.get("choice_sizes", "[]"), "choice sizes", list)
        if any(type(size) is not int or size < 2 for size in sizes) or sum(sizes) > _width(action):
            raise ContractError(f"its choices have the sizes {sizes}: expected numbers of at least 2 within the action")
        widths = _width(observation), space.dim, _width(action)
        recorded = Recorded.from_json(metadata["recording"], widths) if "recording" in metadata else None
        return cls(
            space=space,
            observation=observation,
            action=action,
            choice_sizes=tuple(sizes),
            domain=metadata["domain"],
            control_step=_positive(metadata.get("control_step")),
            environment=_json(metadata.get("environment", "{}"), "environment", dict),
            frames=_count(metadata.get("frames"), "frames"),
            updates=_count(metadata.get("updates"), "updates"),
            recorded=recorded,
        )


def _width(signals: Sequence[Signal]) -> int:
    return sum(signal.width for signal in signals)


def _check_version(version: str | None) -> None:
    if version is None:
        raise ContractError("it has no contract: expected a file written by coachable export")
    if not version.isdecimal() or len(version) > 9:
        raise ContractError(f"its contract has the version {version[:20]!r}: expected {SCHEMA_VERSION}")
    if int(version) > SCHEMA_VERSION:
        raise ContractError(
            f"its contract has version {version}, which is newer than version {SCHEMA_VERSION} of this release: "
            "install a newer coachable"
        )
    if int(version) < SCHEMA_VERSION:
        raise ContractError(f"its contract has version {version}: expected {SCHEMA_VERSION}; export the agent anew")


def _json(text: str, what: str, kind: type, longest: int = _LONGEST_TEXT) -> Any:
    try:
        value = parse_json(text, f"its {what}", longest)
    except ValueError as error:
        raise ContractError(str(error)) from None
    if not isinstance(value, kind):
        raise ContractError(f"its {what} is a {type(value).__name__}: expected a {kind.__name__}")
    return value


def _signals(text: str, what: str) -> tuple[Signal, ...]:
    signals = []
    for entry in _json(text, what, list):
        try:
            unit, entries = entry["unit"], tuple(entry["entries"])
            unit = unit if isinstance(unit, str) else tuple(unit)
            texts = [entry["name"], *entries, *([unit] if isinstance(unit, str) else unit)]
            if type(entry["width"]) is not int or not all(isinstance(text, str) for text in texts):
                raise TypeError("expected texts and a whole number")
            signals.append(Signal(entry["name"], entry["width"], unit, entries))
        except (KeyError, TypeError, ValueError) as error:
            raise ContractError(f"its {what} has a block that cannot be used: {error}") from None
    if not 0 < _width(signals) <= _MOST_ENTRIES:
        raise ContractError(f"its {what} has {_width(signals):,} entries: expected 1 to {_MOST_ENTRIES:,}")
    return tuple(signals)


def _positive(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ContractError(f"its control step is {text[:20]!r}: expected a time above 0 s")
    return value


def _count(text: str | None, what: str) -> int | None:
    if text is None:
        return None
    if not text.isdecimal() or len(text) > 18:
        raise ContractError(f"its {what} are {text[:20]!r}: expected a whole number")
    return int(text)


def _packed(array: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(array, "<f4").tobytes(), 9)).decode()


def _unpacked(name: str, entry: Any, width: int) -> np.ndarray:
    shape, data = (entry.get("shape"), entry.get("data")) if isinstance(entry, dict) else (None, None)
    if not isinstance(shape, list) or len(shape) != 2 or any(type(n) is not int or n < 0 for n in shape):
        raise ContractError(f"the array {name} of its recording has the shape {shape!r}: expected two numbers")
    if shape[1] != width or shape[0] > _MOST_ROWS or shape[0] * shape[1] > _MOST_NUMBERS:
        raise ContractError(
            f"the array {name} of its recording has the shape {shape}: expected {width} columns, as its blocks have, "
            f"at most {_MOST_ROWS:,} rows and {_MOST_NUMBERS:,} numbers"
        )
    size = 4 * shape[0] * shape[1]
    try:
        unpacking = zlib.decompressobj()
        content = unpacking.decompress(base64.b64decode(str(data), validate=True), size + 1)
    except (ValueError, TypeError, zlib.error):
        raise ContractError(f"the array {name} of its recording cannot be unpacked") from None
    if len(content) != size:
        raise ContractError(f"the array {name} of its recording does not have the size of its shape {shape}")
    array = np.frombuffer(content, "<f4").reshape(shape).astype(np.float32)
    if not np.isfinite(array).all():
        raise ContractError(f"the array {name} of its recording has values that are not finite")
    return array

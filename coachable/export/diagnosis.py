"""Diagnosis of an environment that does not behave as a contract says: what differs, and which mistake explains it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import gcd
from typing import NamedTuple

import numpy as np

from coachable.contract.contract import Contract, Recorded
from coachable.export.recorder import neutral_action
from coachable.signals import Signal, entry_names

CAUSES = (
    "order of the observation",
    "scale of the observation",
    "control rate",
    "order of the action",
    "scale of the action",
)
"""Mistakes that can be told from each other."""

TOLERANCE = 1e-3
"""Largest difference of an entry, as a share of its largest value, or of 1 if that is larger."""

_RATIOS = sorted({(p // gcd(p, q), q // gcd(p, q)) for p in range(1, 11) for q in range(1, 11)} - {(1, 1)})
_RATE_FITS = 0.05  # largest median error of a control rate, as a share of the motion
_RESPONSE_FITS = 0.3  # largest error of a response to an action, as a share of the response
_MOVED_FITS = 0.05  # likewise, where an entry acts as another one
_LISTED = 4  # entries in a sentence


@dataclass(frozen=True)
class Diagnosis:
    """One difference between an environment and a contract.

    Attributes:
        cause: One of `CAUSES`, or an empty text if none of them explains the difference.
        text: A sentence that names the entries.
    """

    cause: str
    text: str


class _Match(NamedTuple):
    """Entry `column` of the environment is `factor` times entry `source` of the contract."""

    column: int
    source: int
    factor: float


def diagnose(contract: Contract, recorded: Recorded, repeat: Callable[..., np.ndarray]) -> list[Diagnosis]:
    """Repeat the recorded runs in an environment and explain the differences.

    At rest the actions do not matter, so observations and the control rate are judged there first. The response to
    each entry of the action is judged next, with the mistakes of the observation undone.

    Args:
        contract: The contract.
        recorded: Its recording.
        repeat: Function of actions (T, A), and optionally styles (T, d), that runs the environment from the recorded
            seed and returns the observations (T + 1, D).

    Returns:
        The differences; the list is empty if there are none.
    """
    at_rest = np.tile(neutral_action(contract), (len(recorded.rest) - 1, 1))
    rest = repeat(at_rest)
    run = repeat(recorded.action, recorded.style)
    probe = np.stack([repeat(action[None])[1] for action in recorded.probe_action])
    names = entry_names(contract.observation)
    size = np.maximum(1.0, np.abs(np.concatenate([recorded.rest, recorded.observation])).max(0))
    pairs = [_common(recorded.rest, rest), _common(recorded.observation, run), (recorded.probe, probe)]
    if not any(_wrong(wanted, found, size).any() for wanted, found in pairs) and len(run) == len(recorded.observation):
        return []
    first = _first_difference(recorded, rest, run, size, names)
    wanted, found = (np.concatenate(side) for side in zip(*pairs, strict=True))
    matches = _matches(wanted, found, size)
    if matches is None:
        matches = _matches(*pairs[0], size)
    if matches is None:
        rate = _control_rate(contract, recorded, repeat)
        return [first, rate] if rate else [first]
    undone = probe.copy()
    for match in matches:
        undone[:, match.source] = probe[:, match.column] / match.factor
    return [first, *_observations(contract, matches, names), *_actions(contract, recorded, undone)]


def _common(wanted: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = min(len(wanted), len(found))
    return wanted[:length], found[:length]


def _wrong(wanted: np.ndarray, found: np.ndarray, size: np.ndarray) -> np.ndarray:
    return ~(np.abs(found - wanted) <= TOLERANCE * size)


def _first_difference(
    recorded: Recorded, rest: np.ndarray, run: np.ndarray, size: np.ndarray, names: Sequence[str]
) -> Diagnosis:
    """Return the first step and entry that differ, in the policy's run or else at rest."""
    for where, wanted, found in (("", recorded.observation, run), (" with the neutral action", recorded.rest, rest)):
        common = _common(wanted, found)
        wrong = _wrong(*common, size)
        if wrong.any():
            step = int(wrong.any(1).argmax())
            column = int(np.abs((common[1] - common[0]) / size)[step].argmax())
            others = int(wrong[step].sum()) - 1
            also = f", and {others} other entries differ" if others else ""
            return Diagnosis(
                "",
                f"step {step}{where}: {names[column]} is {common[1][step, column]:.6g}, "
                f"recorded was {common[0][step, column]:.6g}{also}",
            )
    if len(run) != len(recorded.observation):
        return Diagnosis("", f"the episode ends after {len(run) - 1} steps, recorded were {len(recorded.action)}")
    return Diagnosis("", "observations after single actions differ")


def _matches(wanted: np.ndarray, found: np.ndarray, size: np.ndarray) -> list[_Match] | None:
    """Explain every entry that differs by another entry or another scale; None if one cannot be explained."""
    wrong = _wrong(wanted, found, size).any(0)
    # Other entries that differ are the likeliest sources of a permuted one.
    candidates = [*np.flatnonzero(wrong).tolist(), *np.flatnonzero(~wrong).tolist()]
    matches = []
    for column in np.flatnonzero(wrong).tolist():
        match = _match(column, wanted, found[:, column], size, candidates)
        if match is None:
            return None
        matches.append(match)
    return matches


def _match(
    column: int, wanted: np.ndarray, found: np.ndarray, size: np.ndarray, candidates: Sequence[int]
) -> _Match | None:
    factor = _factor(wanted[:, column], found)
    if _fits(wanted[:, column], found, factor):
        return _Match(column, column, factor)
    equal = [(float(np.abs(wanted[:, k] - found).max()), k) for k in candidates if k != column]
    error, source = min(equal, key=lambda pair: pair[0], default=(np.inf, column))
    if error <= TOLERANCE * size[source]:
        return _Match(column, source, 1.0)
    for source in candidates:
        factor = _factor(wanted[:, source], found)
        if np.ptp(wanted[:, source]) > TOLERANCE and _fits(wanted[:, source], found, factor):
            return _Match(column, source, factor)
    return None


def _factor(wanted: np.ndarray, found: np.ndarray) -> float:
    """Return the factor by which one column is best made of another, or 0."""
    square = float(wanted @ wanted)
    return float(wanted @ found) / square if square > 1e-12 else 0.0


def _fits(wanted: np.ndarray, found: np.ndarray, factor: float) -> bool:
    """Return whether one column is a multiple of another that is large enough to tell."""
    tells = factor != 0.0 and np.abs(wanted).max() > TOLERANCE
    return bool(tells and (np.abs(factor * wanted - found) <= TOLERANCE * np.abs(found).max()).all())


def _control_rate(contract: Contract, recorded: Recorded, repeat: Callable[..., np.ndarray]) -> Diagnosis | None:
    """Return the ratio of control steps with which the environment at rest repeats the recording."""
    wanted = recorded.rest
    moving = np.ptp(wanted, axis=0) > TOLERANCE
    found = repeat(np.tile(neutral_action(contract), (4 * len(wanted), 1)))
    best = (_RATE_FITS, 1, 1)
    for p, q in _RATIOS:  # q steps of the environment are p of the contract
        count = min((len(wanted) - 1) // p, (len(found) - 1) // q)
        if count:
            there, here = wanted[p : p * count + 1 : p, moving], found[q : q * count + 1 : q, moving]
            motion = np.abs(there - wanted[:1, moving]).mean(0) + 1e-6
            best = min(best, (float(np.median(np.abs(here - there).mean(0) / motion)), p, q))
    _, p, q = best
    if p == q:
        return None
    step = contract.control_step
    lasts = f"{step * p / q:g} s instead of {step:g} s, " if step else ""
    return Diagnosis("control rate", f"a step lasts {lasts}{p / q:g} times as long as in the contract")


def _observations(contract: Contract, matches: Sequence[_Match], names: Sequence[str]) -> Iterator[Diagnosis]:
    """Report matches, those of a block with equal factors in one sentence."""
    moved = [match for match in matches if match.source != match.column]
    if moved:
        pairs = [f"{names[m.column]} holds {_times(m.factor)}{names[m.source]}" for m in moved]
        yield Diagnosis("order of the observation", _listed(pairs))
    blocks = _blocks(contract.observation)
    scaled = [match for match in matches if match.source == match.column]
    for (block, factor), group in groupby(scaled, key=lambda m: (blocks[m.column], f"{m.factor:.3g}")):
        entries = list(group)
        which = f"all of {block.name}" if len(entries) == block.width else _listed([names[m.column] for m in entries])
        unit = block.unit_of(0) if isinstance(block.unit, str) else ""
        note = f"; 1 stands for {unit}" if unit else ""
        yield Diagnosis("scale of the observation", f"{which}: {factor} times what was recorded{note}")


def _actions(contract: Contract, recorded: Recorded, probe: np.ndarray) -> Iterator[Diagnosis]:
    """Compare the responses to each entry of the action with the recorded ones."""
    idle = recorded.rest[1] if len(recorded.rest) > 1 else recorded.rest[0]
    wanted, found = recorded.probe - idle, probe - idle
    names, blocks = entry_names(contract.action), _blocks(contract.action)
    columns = (recorded.probe_action - neutral_action(contract)).argmax(1)
    moved: list[str] = []
    scaled: dict[str, list[tuple[int, float]]] = {}
    for k, column in enumerate(columns.tolist()):
        size = float(np.linalg.norm(wanted[k]))
        if np.linalg.norm(found[k] - wanted[k]) <= 0.1 * TOLERANCE + 0.01 * size:
            continue
        factors = np.array([_factor(response, found[k]) for response in wanted])
        errors = np.linalg.norm(found[k] - factors[:, None] * wanted, axis=1)
        best = int(errors.argmin())
        if errors[k] <= max(_RESPONSE_FITS * abs(factors[k]), 0.01) * size and errors[k] <= 5.0 * errors[best]:
            scaled.setdefault(blocks[column].name, []).append((column, float(factors[k])))
        elif errors[best] <= _MOVED_FITS * np.linalg.norm(found[k]):
            moved.append(f"{names[column]} acts as {_times(factors[best])}{names[int(columns[best])]}")
    if moved:
        yield Diagnosis("order of the action", _listed(moved))
    for block, entries in scaled.items():
        # Where limbs touch the ground a response is not quite proportional to the action, so most entries decide.
        middle = float(np.median([factor for _, factor in entries]))
        alike = [column for column, factor in entries if abs(factor - middle) <= 0.1 * abs(middle)]
        width = blocks[entries[0][0]].width
        if len(alike) > 1 and 2 * len(alike) > len(entries) and 3 * len(alike) > width:
            text = f"{block}: about {middle:.2g} times the effect, seen in {len(alike)} of {width} entries"
        else:
            text = _listed([f"{names[column]}: about {factor:.2g} times the effect" for column, factor in entries])
        yield Diagnosis("scale of the action", text)


def _blocks(signals: Sequence[Signal]) -> list[Signal]:
    """Return the block of every entry."""
    return [signal for signal in signals for _ in range(signal.width)]


def _times(factor: float) -> str:
    return "" if abs(factor - 1.0) <= TOLERANCE else f"{factor:.3g} times "


def _listed(texts: Sequence[str]) -> str:
    more = f", and {len(texts) - _LISTED} more" if len(texts) > _LISTED else ""
    return ", ".join(texts[:_LISTED]) + more

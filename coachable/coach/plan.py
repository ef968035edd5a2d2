"""A schedule of styles written in words: "0: T-pose; 3: arms up, shorter steps"."""

from __future__ import annotations

import re

from coachable.coach.grammar import Value
from coachable.coach.session import CoachSession

_ENTRY = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(?:s\b)?\s*[: ]\s*(.+)")


def read_plan(text: str, session: CoachSession) -> dict[float, dict[str, Value]]:
    """Reads a schedule, to be handed to `CoachSession.schedule`.

    Args:
        text: `SECONDS: PHRASE`, separated by semicolons or new lines. Each phrase is understood relative to the style
            before it, or names a preset.
        session: whose style space, words and presets to use; it is not changed.

    Raises:
        ValueError: naming the entry that was not understood.
    """
    style, plan, previous = dict(session.style), {}, None
    for entry in filter(str.strip, re.split(r"[;\n]", text)):
        match = _ENTRY.fullmatch(entry)
        if match is None:
            raise ValueError(f"'{entry.strip()}' is no SECONDS: PHRASE, such as '3: arms up'")
        seconds, phrase = float(match[1]), match[2].strip()
        preset = next((values for name, values in session.presets.items() if name.lower() == phrase.lower()), None)
        if preset is None:
            previous = session.grammar.read(phrase, style | session.controls, previous)
            fixed = [name for name in previous.changes if name not in session.space]
            if previous.failed or fixed:
                raise ValueError(
                    f"at {seconds:g} s: " + "; ".join([*previous.failed, *(f"{n} is no style" for n in fixed)])
                )
            preset = previous.changes
        style |= preset
        plan[seconds] = plan.get(seconds, {}) | preset
    if not plan:
        raise ValueError("the schedule is empty: write SECONDS: PHRASE, such as '3: arms up'")
    return plan

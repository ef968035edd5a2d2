"""Schedules of styles in words, such as "0: T-pose; 3: arms up, shorter steps"."""

import re
from operator import itemgetter

from coachable.coach.phrases.grammar import Value
from coachable.coach.session.session import CoachSession

MAX_PLAN = 20_000  # characters
_ENTRY = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(?:s\b)?\s*[: ]\s*(?!\d+\s*:)(.+)")  # not minutes and seconds


def read_plan(text: str, session: CoachSession) -> dict[float, dict[str, Value]]:
    """Read a schedule in words for `CoachSession.schedule`.

    Args:
        text: Entries `SECONDS: PHRASE`, separated by semicolons or new lines, of at most 20,000 characters. Each
            phrase names a preset, or is read relative to the style before it.
        session: Session whose style space, words and presets are used; it is not changed.

    Returns:
        Requested values by parameter name, by time [s].

    Raises:
        ValueError: If the text is empty or too long, or an entry is not understood.
    """
    if len(text) > MAX_PLAN:
        raise ValueError(f"the schedule has {len(text):,} characters: expected at most {MAX_PLAN:,}")
    example = f"'3: {next(iter(session.grammar.examples), 'default')}'"
    style, plan, previous = dict(session.style), {}, None
    # "Back to normal" also names these, which a plan leaves as they are.
    neutral = {control.parameter.name: control.parameter.default for control in session.domain.controls}
    entries = []
    for entry in filter(str.strip, re.split(r"[;\n]", text)):
        match = _ENTRY.fullmatch(entry)
        if match is None:
            raise ValueError(f"'{entry.strip()}' is not of the form SECONDS: PHRASE, such as {example}")
        entries.append((float(match[1]), match[2].strip()))
    for seconds, phrase in sorted(entries, key=itemgetter(0)):  # "shorter" refers to what is in force then
        presets = list(session.presets.items())  # another thread may add one
        preset = next((values for name, values in presets if name.lower() == phrase.lower()), None)
        if preset is None:
            previous = session.grammar.read(phrase, style | session.controls, previous)
            changes = {name: value for name, value in previous.changes.items() if neutral.get(name) != value}
            fixed = [name for name in changes if name not in session.space]
            hint = [f"try: {', '.join(previous.examples)}"] if previous.examples else []
            if previous.failed or fixed:
                problems = [*previous.failed, *(f"{name} is not a style" for name in fixed), *hint]
                raise ValueError(f"at {seconds:g} s: " + "; ".join(problems))
            preset = changes
        style |= preset
        plan[seconds] = plan.get(seconds, {}) | preset
    if not plan:
        raise ValueError(f"the schedule is empty: write SECONDS: PHRASE, such as {example}")
    return plan

"""HTML page of a report: a single file with tables and inline pictures, without scripts."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coachable.evaluation.runs import Estimate
from coachable.evaluation.wording import readable

__all__ = ["Page", "paragraph", "picture", "shown", "table"]

_NOTHING = "n/a"
_DENSITY = 1.5  # pixels of a picture per pixel of the page

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2430; background: #fff; max-width: 1040px; margin: 2rem auto;
  padding: 0 1.2rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .4rem; border-bottom: 1px solid #d5dbe3; padding-bottom: .2rem; }
p { max-width: 78ch; margin: .5rem 0; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; background: #eef1f5; vertical-align: bottom; }
th, td { padding: .28rem .65rem; border-bottom: 1px solid #e3e8ee; }
td.number, th.number { text-align: right; white-space: nowrap; }
td small { color: #5b6675; }
figure { margin: 1rem 0; }
img { max-width: 100%; height: auto; }
nav a { margin-right: 1rem; }
a { color: #1d5fa8; }
code { background: #f2f4f7; padding: .1rem .3rem; border-radius: 3px; }
footer { color: #5b6675; font-size: 13px; margin-top: 3rem; }
"""


class Page:
    """HTML page that is made of sections.

    Args:
        title: Title of the page.
        lead: Paragraph below the title.
    """

    def __init__(self, title: str, lead: str) -> None:
        self.title, self.lead = title, lead
        self._sections: list[tuple[str, str]] = []

    def section(self, title: str, *parts: str) -> None:
        """Add a section of parts from `paragraph`, `picture` and `table`."""
        self._sections.append((title, "\n".join(parts)))

    def text(self, footer: str) -> str:
        """Return the HTML text of the page."""
        name = html.escape(self.title)
        links = " ".join(f'<a href="#s{i}">{html.escape(t)}</a>' for i, (t, _) in enumerate(self._sections))
        body = "\n".join(
            f'<h2 id="s{i}">{html.escape(title)}</h2>\n{content}' for i, (title, content) in enumerate(self._sections)
        )
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width">\n'
            f'<link rel="icon" href="data:,">\n<title>{name}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n'
            f"<h1>{name}</h1>\n{paragraph(self.lead)}\n<nav>{links}</nav>\n{body}\n"
            f"<footer>{html.escape(footer)}</footer>\n</body>\n</html>\n"
        )


def paragraph(text: str) -> str:
    """Return a paragraph of plain text as HTML."""
    return f"<p>{html.escape(text)}</p>"


def picture(path: Path, description: str) -> str:
    """Return a PNG file as inline HTML, at the scale that all pictures share."""
    content = path.read_bytes()
    width = int.from_bytes(content[16:20], "big")  # from the header (PNG specification, IHDR)
    data = base64.b64encode(content).decode()
    return (
        f'<figure><img width="{round(width / _DENSITY)}" alt="{html.escape(description)}" '
        f'src="data:image/png;base64,{data}"></figure>'
    )


def table(rows: Sequence[Mapping[str, Any]], formats: Mapping[str, str], colour: bool = False) -> str:
    """Return rows as an HTML table.

    Args:
        rows: Values by column name; an `Estimate` is shown with its interval.
        formats: Format specification of numbers by column or metric; by default ".3g".
        colour: Whether to shade the estimates of a column from the lowest (white) to the highest value.
    """
    columns = list(rows[0])
    numeric = {c for c in columns if any(isinstance(row[c], Estimate | float | int) for row in rows)}
    ranges = {c: _range([row[c].value for row in rows if isinstance(row[c], Estimate)]) for c in columns}
    head = "".join(f"<th{_class(c in numeric)}>{html.escape(readable(c))}</th>" for c in columns)
    lines = []
    for row in rows:
        cells = []
        for column in columns:
            value = row[column]
            form = formats.get(str(row.get("metric", "")), formats.get(column, ".3g"))
            shade = _shade(value, ranges[column]) if colour and isinstance(value, Estimate) else ""
            cells.append(f"<td{_class(column in numeric)}{shade}>{_cell(value, form)}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="scroll"><table>\n<tr>{head}</tr>\n' + "\n".join(lines) + "\n</table></div>"


def shown(value: Any, form: str) -> str:
    """Return a value as text: a number in a format, an estimate with its interval, "n/a" for NaN."""
    if isinstance(value, Estimate):
        if math.isnan(value.value):
            return _NOTHING
        return f"{shown(value.value, form)} [{shown(value.low, form)}, {shown(value.high, form)}]"
    if isinstance(value, float):
        return _NOTHING if math.isnan(value) else format(value, form)
    return readable(value)


def _cell(value: Any, form: str) -> str:
    if isinstance(value, Estimate) and not math.isnan(value.value):
        interval = f"[{shown(value.low, form)}, {shown(value.high, form)}]"
        return f"{html.escape(shown(value.value, form))} <small>{html.escape(interval)}</small>"
    return html.escape(shown(value, form))


def _class(numeric: bool) -> str:
    return ' class="number"' if numeric else ""


def _range(values: Sequence[float]) -> tuple[float, float]:
    known = [value for value in values if not math.isnan(value)]
    return (min(known), max(known)) if known else (0.0, 0.0)


def _shade(value: Estimate, bounds: tuple[float, float]) -> str:
    low, high = bounds
    if math.isnan(value.value) or high <= low:
        return ""
    return f' style="background: rgba(29, 95, 168, {0.30 * ((value.value - low) / (high - low)):.3f})"'

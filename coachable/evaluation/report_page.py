"""HTML page of a report: a single file with tables and inline pictures, without scripts."""

import base64
import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coachable.evaluation.runs import Estimate
from coachable.evaluation.wording import readable
from coachable.scene.look import ICON, TITLE, icon_link, stylesheet

_NOTHING = "n/a"
_DENSITY = 1.5  # pixels of a picture per pixel of the page

_STYLE = """
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink); }
main { max-width: 1120px; margin: 0 auto; padding: 1.5rem; }
header { display: flex; gap: .9rem; align-items: flex-start; }
header svg { flex: none; width: 46px; height: 46px; }
h1 { margin: .3rem 0; font-size: 1.5rem; line-height: 1.25; letter-spacing: -.01em; }
h2 { margin: 0 0 .6rem; font-size: 1.15rem; }
p { max-width: 78ch; margin: .5rem 0; color: var(--soft); font-size: .925rem; }
section { margin: 1.25rem 0; padding: 1.1rem 1.25rem; background: var(--panel); border: 1px solid var(--line);
  border-radius: 12px; }
nav { display: flex; flex-wrap: wrap; gap: .4rem; margin: 1rem 0; }
nav a { padding: .3rem .8rem; border: 1px solid var(--line); border-radius: 999px; background: var(--panel);
  font-size: .9rem; text-decoration: none; }
a { color: var(--requested); }
a:hover { border-color: var(--requested); }
a:focus-visible, .scroll:focus-visible { outline: 3px solid var(--measured); outline-offset: 2px; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: var(--soft); vertical-align: bottom; }
th, td { padding: .3rem .65rem; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { position: sticky; left: 0; padding-left: 0; background: var(--panel); }
td { min-width: 9rem; }
td:first-child { min-width: 6.5rem; }
td.number, th.number { min-width: 0; text-align: right; white-space: nowrap; }
td[style] { background: color-mix(in srgb, var(--measured) calc(var(--share) * 32%), var(--panel)); }
td small { color: var(--soft); }
td[style] small { color: inherit; }
figure { margin: .8rem 0; }
figure img { display: block; max-width: 100%; height: auto; }
footer { margin: 2rem 0 0; color: var(--soft); font-size: .8rem; overflow-wrap: anywhere; }
@media (max-width: 700px) {
  main { padding: .9rem .6rem; }
  section { padding: .8rem .7rem; }
  h1 { font-size: 1.2rem; }
  td:first-child { max-width: 9.5rem; }
  figure img { max-width: none; }
}
/* Figures are drawn on white: the dark page turns their lightness around and keeps their hues. */
@media (prefers-color-scheme: dark) { figure img { filter: invert(1) hue-rotate(180deg); mix-blend-mode: screen; } }
@media print { section { break-inside: avoid; } }
"""


class Page:
    """HTML page of a title, a paragraph below it, and sections."""

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
            f'<section>\n<h2 id="s{i}">{html.escape(title)}</h2>\n{content}\n</section>'
            for i, (title, content) in enumerate(self._sections)
        )
        icon = ICON.read_text(encoding="utf-8").replace("<svg", '<svg aria-hidden="true"', 1)
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f'<link rel="icon" href="{icon_link()}">\n<title>{TITLE}: {name}</title>\n'
            f"<style>\n{stylesheet()}{_STYLE}</style>\n</head>\n<body>\n<main>\n"
            f"<header>{icon}<div><h1>{name}</h1>\n{paragraph(self.lead)}</div></header>\n"
            f"<nav>{links}</nav>\n{body}\n<footer>{html.escape(footer)}</footer>\n</main>\n</body>\n</html>\n"
        )


def paragraph(text: str) -> str:
    """Return a paragraph of plain text as HTML."""
    return f"<p>{html.escape(text)}</p>"


def picture(path: Path, description: str) -> str:
    """Return a PNG file as inline HTML with a description in words, at the scale that all pictures share."""
    content = path.read_bytes()
    width = int.from_bytes(content[16:20], "big")  # from the header (PNG specification, IHDR)
    data = base64.b64encode(content).decode()
    return (
        f'<figure class="scroll" tabindex="0"><img width="{round(width / _DENSITY)}" '
        f'alt="{html.escape(description)}" src="data:image/png;base64,{data}"></figure>'
    )


def table(
    rows: Sequence[Mapping[str, Any]],
    formats: Mapping[str, str],
    colour: bool = False,
    titles: Mapping[str, str] | None = None,
) -> str:
    """Return rows as an HTML table.

    Args:
        rows: Values by column name; an `Estimate` is shown with its interval.
        formats: Format specification of numbers by column or metric; by default ".3g".
        colour: Whether to shade the estimates of a column, the highest value most.
        titles: Headings by column or metric; by default their readable names.
    """
    columns, titles = list(rows[0]), titles or {}
    numeric = {c for c in columns if any(isinstance(row[c], Estimate | float | int) for row in rows)}
    ranges = {c: _range([row[c].value for row in rows if isinstance(row[c], Estimate)]) for c in columns}
    head = "".join(f"<th{_class(c in numeric)}>{html.escape(titles.get(c, readable(c)))}</th>" for c in columns)
    lines = []
    for row in rows:
        cells = []
        for column in columns:
            value = titles.get(row[column], row[column]) if column == "metric" else row[column]
            form = formats.get(str(row.get("metric", "")), formats.get(column, ".3g"))
            shade = _shade(value, ranges[column]) if colour and isinstance(value, Estimate) else ""
            cells.append(f"<td{_class(column in numeric)}{shade}>{_cell(value, form)}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="scroll" tabindex="0"><table>\n<tr>{head}</tr>\n' + "\n".join(lines) + "\n</table></div>"


def shown(value: Any, form: str) -> str:
    """Return a value as text: a number in a format, an estimate with its interval, "n/a" for NaN.

    Args:
        value: A number, an `Estimate` or a word.
        form: Format of numbers, such as ".2f".
    """
    if isinstance(value, Estimate):
        if math.isnan(value.value):
            return _NOTHING
        return f"{shown(value.value, form)} {_interval(value, form)}".rstrip()
    if isinstance(value, float):
        return _NOTHING if math.isnan(value) else format(value, form)
    return readable(value)


def _cell(value: Any, form: str) -> str:
    if isinstance(value, Estimate) and not math.isnan(value.value):
        interval = _interval(value, form)
        return html.escape(shown(value.value, form)) + (f" <small>{html.escape(interval)}</small>" if interval else "")
    return html.escape(shown(value, form))


def _interval(value: Estimate, form: str) -> str:
    return "" if math.isnan(value.low) else f"[{shown(value.low, form)}, {shown(value.high, form)}]"


def _class(numeric: bool) -> str:
    return ' class="number"' if numeric else ""


def _range(values: Sequence[float]) -> tuple[float, float]:
    known = [value for value in values if not math.isnan(value)]
    return (min(known), max(known)) if known else (0.0, 0.0)


def _shade(value: Estimate, bounds: tuple[float, float]) -> str:
    low, high = bounds
    if math.isnan(value.value) or high <= low:
        return ""
    return f' style="--share: {(value.value - low) / (high - low):.2f}"'

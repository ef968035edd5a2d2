"""Looks that the live page, the static page, reports, films and figures share: colours, type, title and icon."""

from dataclasses import dataclass, fields
from pathlib import Path
from urllib.parse import quote

from coachable.scene import palette
from coachable.scene.palette import Colour, css, mixed

TITLE = "coachable"
FONT = 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", "Liberation Sans", sans-serif'
ICON = Path(__file__).with_name("icon.svg")


@dataclass(frozen=True)
class Look:
    """Colours of a page.

    Attributes:
        ground: Behind everything.
        panel: Behind text and figures.
        line: Borders and lines of tables.
        ink: Text.
        soft: Text of less weight.
        requested: What was asked for, links and buttons.
        measured: What was measured.
        trained: Range on which the agent was trained.
        track: Range outside of it.
        on_accent: Text on the colour `requested`.
    """

    ground: Colour
    panel: Colour
    line: Colour
    ink: Colour
    soft: Colour
    requested: Colour
    measured: Colour
    trained: Colour
    track: Colour
    on_accent: Colour


LIGHT = Look(
    ground=(233, 237, 241),
    panel=(255, 255, 255),
    line=(211, 218, 226),
    ink=(24, 33, 43),
    soft=(86, 100, 115),
    requested=(10, 99, 194),
    measured=(180, 72, 12),
    trained=(185, 214, 246),
    track=(227, 232, 238),
    on_accent=(255, 255, 255),
)
DARK = Look(
    ground=(18, 23, 29),
    panel=(26, 33, 41),
    line=(50, 61, 73),
    ink=(231, 236, 242),
    soft=(163, 176, 190),
    requested=(108, 178, 255),
    measured=(255, 166, 107),
    trained=(43, 75, 111),
    track=(42, 51, 61),
    on_accent=(16, 22, 29),
)

LINES: tuple[Colour, ...] = (
    palette.BLUE,
    palette.VERMILION,
    palette.GREEN,
    palette.ORANGE,
    palette.PURPLE,
    palette.SKY,
    palette.STEEL,
    mixed(palette.BLUE, palette.INK, 0.6),
    mixed(palette.VERMILION, palette.INK, 0.5),
    mixed(palette.GREEN, palette.INK, 0.5),
)
"""Colours of the lines of a figure, in order."""


def stylesheet() -> str:
    """Return the colours and the font as CSS variables, with the dark colours where the browser prefers them.

    Example:
        >>> "--requested: #0a63c2;" in stylesheet()
        True
    """
    light, dark = (
        "".join(f"  --{field.name.replace('_', '-')}: {css(getattr(look, field.name))};\n" for field in fields(Look))
        for look in (LIGHT, DARK)
    )
    font = f"  color-scheme: light dark;\n  font: 16px/1.45 {FONT};\n"
    return f":root {{\n{light}{font}}}\n@media (prefers-color-scheme: dark) {{\n:root {{\n{dark}}}\n}}\n"


def icon_link() -> str:
    """Return the icon as a link that contains it, for pages of a single file."""
    return f"data:image/svg+xml,{quote(ICON.read_text(encoding='utf-8'))}"

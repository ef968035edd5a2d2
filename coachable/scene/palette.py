"""Colours of scenes; those of pages, films and figures are in `coachable.scene.look`.

The hues are those of Okabe and Ito, which people with any of the common kinds of colour blindness can tell apart
(https://jfly.uni-koeln.de/color/). Each of them is readable on the light and on the dark page.
"""

Colour = tuple[int, int, int]
"""Red, green and blue from 0 to 255."""

ORANGE: Colour = (230, 159, 0)
SKY: Colour = (86, 180, 233)
GREEN: Colour = (0, 158, 115)
YELLOW: Colour = (240, 228, 66)
BLUE: Colour = (0, 114, 178)
VERMILION: Colour = (213, 94, 0)
PURPLE: Colour = (204, 121, 167)

WHITE: Colour = (240, 240, 236)
SILVER: Colour = (176, 180, 186)
STEEL: Colour = (118, 124, 132)
SLATE: Colour = (74, 80, 88)
INK: Colour = (34, 37, 43)

AIR: Colour = (214, 224, 234)
HAZE: Colour = (195, 202, 210)
"""Colours of the sky above, and of the horizon, into which distant objects fade."""
NIGHT_AIR: Colour = (16, 22, 31)
NIGHT_HAZE: Colour = (30, 38, 48)
"""The same where the page is dark."""

REQUESTED, MEASURED = (10, 122, 186), VERMILION
"""What was asked for and what was measured, in charts and scenes; the blue is lighter, for the dark page."""


def css(colour: Colour) -> str:
    """Return a colour as it is written in CSS.

    Example:
        >>> css((0, 114, 178))
        '#0072b2'
    """
    return "#" + "".join(f"{channel:02x}" for channel in colour)


def mixed(one: Colour, other: Colour, share: float) -> Colour:
    """Return a mixture of two colours.

    Args:
        one: Colour at share 0.
        other: Colour at share 1.
        share: Share of `other`.
    """
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(one, other, strict=True))
    return red, green, blue

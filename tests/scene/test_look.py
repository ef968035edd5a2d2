"""The shared look: its text can be read, its colours differ for the colour-blind, its icon is one file."""

import re
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest

from coachable.scene import look
from coachable.scene.palette import css
from tests.scene.test_parts import BLINDNESS, lab, linear, luminance


def contrast(one, other):
    high, low = sorted((luminance(one) + 0.05, luminance(other) + 0.05), reverse=True)
    return high / low


@pytest.mark.parametrize("colours", [look.LIGHT, look.DARK], ids=["light", "dark"])
def test_text_has_the_contrast_that_reading_needs(colours):
    """At least 4.5 to 1, as WCAG 2.1 asks for text."""
    for text in (colours.ink, colours.soft, colours.requested, colours.measured):
        assert contrast(text, colours.panel) >= 4.5 and contrast(text, colours.ground) >= 4.5
    assert contrast(colours.on_accent, colours.requested) >= 4.5


@pytest.mark.parametrize("kind", [None, *BLINDNESS])
def test_requested_and_measured_differ_for_the_colour_blind(kind):
    seen = np.eye(3) if kind is None else np.array(BLINDNESS[kind])
    for colours in (look.LIGHT, look.DARK):
        one, other = (lab(seen @ linear(colour)) for colour in (colours.requested, colours.measured))
        assert np.linalg.norm(one - other) > 30


def test_lines_of_figures_stand_out_and_differ():
    assert len(set(look.LINES)) == 10
    assert all(contrast(colour, (255, 255, 255)) >= 2.0 for colour in look.LINES)


def test_the_stylesheet_has_every_colour_for_light_and_dark():
    light, dark = look.stylesheet().split("@media (prefers-color-scheme: dark)")
    for text, colours in ((light, look.LIGHT), (dark, look.DARK)):
        written = dict(re.findall(r"--([\w-]+): (#\w{6});", text))
        assert written == {name.replace("_", "-"): css(colour) for name, colour in vars(colours).items()}


def test_the_icon_is_a_picture_that_a_link_contains():
    kind, _, content = look.icon_link().partition(",")
    assert kind == "data:image/svg+xml" and '"' not in content and "'" not in content
    assert ElementTree.fromstring(unquote(content)).get("viewBox") == "0 0 64 64"

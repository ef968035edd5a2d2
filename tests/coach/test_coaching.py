"""The additions of each domain: they fit its styles, and its words mean what they seem to mean."""

import pytest

from coachable.coach.coaching import coaching_of
from coachable.coach.grammar import StyleGrammar
from coachable.envs.combat.styles import combat_style_space
from coachable.envs.humanoid import humanoid_style_space
from coachable.envs.racing.styles import aggressiveness_style_space, drift_style_space, resource_style_space

SPACES = {
    "humanoid": humanoid_style_space,
    "combat": combat_style_space,
    "racing_drift": drift_style_space,
    "racing_resources": resource_style_space,
    "racing_aggressiveness": aggressiveness_style_space,
}


@pytest.mark.parametrize("domain", SPACES)
def test_words_and_presets_fit_the_styles(domain):
    space, coaching = SPACES[domain](), coaching_of(domain)
    assert coaching.fitting(space) == coaching, "nothing is left out"
    for preset in coaching.presets.values():
        space.make(strict=True, **preset)


@pytest.mark.parametrize(
    ("domain", "phrase", "changes"),
    [
        ("combat", "freeze it", {"frost": 0.6}),
        ("combat", "burn it, but no plasma", {"fire": 0.9, "plasma": -0.03}),
        ("combat", "break its weapon", {"part_weapon": 1.0}),
        ("racing_drift", "go sideways", {"slip_angle_rear": 5.0}),
        ("racing_drift", "no drifting", {"slip_angle_rear": -0.4}),
        ("racing_resources", "save your tyres", {"tire": 12000.0}),
        ("racing_resources", "burn fuel", {}),
        ("racing_resources", "attack", {"overtake": 2.0}),
        ("racing_aggressiveness", "keep 0.8 m distance beside", {"lateral": 0.8}),
    ],
)
def test_phrases(domain, phrase, changes):
    space, coaching = SPACES[domain](), coaching_of(domain)
    understood = StyleGrammar(space, coaching.vocabulary).read(phrase, space.describe(space.default))
    assert understood.changes == pytest.approx(changes)
    assert understood.failed == ()


def test_everything_at_its_default_is_said_once():
    space = combat_style_space()
    understood = StyleGrammar(space).read("back to normal", space.describe(space.default))
    assert str(understood) == "everything stays at its default"

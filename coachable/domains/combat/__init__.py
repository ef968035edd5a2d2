"""Domain of fights with a gamepad in a style that is chosen at run time."""

from coachable.domains.combat.events import combat_events
from coachable.domains.combat.styles import combat_style_reward, combat_style_space

__all__ = ["combat_events", "combat_style_reward", "combat_style_space"]

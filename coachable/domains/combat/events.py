"""What fills the event tables of the combat domain."""

from collections.abc import Sequence

from coachable.domains.combat.styles import combat_style_space
from coachable.replay.routing import StyleEvents


def combat_events(
    styles: Sequence[str] | None = None, reward_scale: str = "sim", kill_event: bool = False
) -> StyleEvents:
    """One event per style, admitted if the fight's weight of it is not 0 (paper), and optionally dead machines.

    Args:
        styles: as in `CombatEnv`.
        reward_scale: as in `CombatEnv`.
        kill_event: as in `CombatEnv`.
    """
    return StyleEvents.of(combat_style_space(styles, reward_scale), extra=["kill"] if kill_event else [])

"""Events that fill the replay tables of the combat domain."""

from collections.abc import Sequence

from coachable.domains.combat.styles import combat_style_space
from coachable.replay.routing import KeyEvents, StyleEvents


def combat_events(
    styles: Sequence[str] | None = None,
    reward_scale: str = "sim",
    kill_event: bool = False,
    every_style: bool = False,
) -> KeyEvents | StyleEvents:
    """Return one event per style, which counts if the style's weight in the fight is not 0 (paper).

    Args:
        styles: Names of the styles, as in `CombatEnv`.
        reward_scale: "sim" or "paper", as in `CombatEnv`.
        kill_event: Whether the death of all machines is an event, as in `CombatEnv`.
        every_style: Whether an event counts in every fight, whatever is requested (ours). What led to it can be
            relabelled with a style that asks for it (`tables` of `TaskImpersonation`).
    """
    space = combat_style_space(styles, reward_scale)
    extra = ["kill"] if kill_event else []
    return KeyEvents([*space.names, *extra]) if every_style else StyleEvents(space, extra)

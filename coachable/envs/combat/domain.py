"""Declaration of the combat domain."""

from __future__ import annotations

from typing import Any

from coachable.domain import Domain
from coachable.envs.combat.constants import CONTROL_STEP, EPISODE_STEPS
from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.features import observation_groups
from coachable.envs.combat.measures import CombatMeasures
from coachable.envs.combat.render import CombatRenderer
from coachable.envs.combat.styles import combat_style_reward, combat_style_space


def make_combat_env(
    num_envs: int = 128, seed: int | None = None, num_threads: int | None = None, **options: Any
) -> CombatEnv:
    """A `CombatEnv` that emits `components` for the measures. `num_threads` is not used: threads are torch's own."""
    return CombatEnv(num_envs, seed=seed, components=True, **options)


DOMAIN = Domain(
    name="combat",
    make_env=make_combat_env,
    make_space=combat_style_space,
    make_reward=combat_style_reward,
    measures=CombatMeasures(),
    make_renderer=CombatRenderer,
    # One style at a time is 20 cells, the product of 18 weights 2^18: the damage matrix is an evaluation of its own.
    grid={"skykiller": (-0.3, 0.0, 0.3)},
    control_step=CONTROL_STEP,
    episode_steps=EPISODE_STEPS,
    columns={"won": ".0%", "damage": ".0f", "style_score": ".2f"},
    observation_groups=observation_groups("full"),
)

"""A batched arena where a player with a gamepad fights machines; stand-in for the paper's Horizon Forbidden West."""

from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.events import combat_events
from coachable.envs.combat.styles import combat_style_reward, combat_style_space

__all__ = ["CombatEnv", "combat_events", "combat_style_reward", "combat_style_space"]

"""A batched arena where a player with a gamepad fights machines; stand-in for the paper's Horizon Forbidden West."""

from coachable.envs.combat.env import CombatEnv

__all__ = ["CombatEnv"]

"""Batched arena in which a player with a gamepad fights machines, in place of the paper's Horizon Forbidden West."""

from coachable.envs.combat.env import CombatEnv

__all__ = ["CombatEnv"]

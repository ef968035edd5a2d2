"""Simulation of tyre-limited car racing in batched torch, with wear, fuel and several cars."""

from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.env import RacingEnv

__all__ = ["RacingEnv", "Track", "load_track"]

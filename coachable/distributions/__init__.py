"""Distributions over actions and returns: pure numerics."""

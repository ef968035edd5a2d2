"""Distributions over actions and returns, in pure torch."""

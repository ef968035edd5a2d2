"""Agents that run without this library."""

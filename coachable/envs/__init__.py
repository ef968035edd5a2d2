"""Simulators. Each folder is one; none imports another."""

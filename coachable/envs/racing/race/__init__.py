"""Races on a circuit with rules, starts, rivals and observations."""

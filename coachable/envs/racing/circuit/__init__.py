"""Circuits: centre line, width, the racing line and its speed profile."""

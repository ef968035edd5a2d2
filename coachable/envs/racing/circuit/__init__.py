"""Circuits with their centre lines and widths, racing lines and speed profiles."""

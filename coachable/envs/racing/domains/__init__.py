"""Declarations of the three racing domains, one per family of style."""

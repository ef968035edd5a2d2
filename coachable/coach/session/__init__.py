"""Coaching an agent from a script: sessions, episodes, recordings and reports."""

"""Coaching a trained agent: the session, phrases, and the page in the browser."""

"""Coaching a trained agent: the session, the page in the browser, and the export to other programs."""

"""Coaching page in the browser: the scene, sliders, charts and films."""

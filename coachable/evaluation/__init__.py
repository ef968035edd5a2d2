"""Evaluation of agents over a grid of styles: compliance with the request, and success at the task."""

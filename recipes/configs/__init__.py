"""Configurations of the recipes: YAML files, and what they may contain."""

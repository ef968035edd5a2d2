"""Configurations of the recipes as YAML files, and their schema."""

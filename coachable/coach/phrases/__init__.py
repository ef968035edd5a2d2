"""Phrases such as "shorter steps" read as changes of a style, by rules."""

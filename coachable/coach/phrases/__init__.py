"""Rules that read phrases such as "shorter steps" as changes of a style."""

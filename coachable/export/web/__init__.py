"""A page on which a trained agent acts in the visitor's browser."""

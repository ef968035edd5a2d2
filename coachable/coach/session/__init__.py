"""A coached agent without a page: session, episodes, recordings, what was asked and what was measured."""

"""Does the agent do what was asked, and its task as well? Measured over a grid of styles."""

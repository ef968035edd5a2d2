"""Contract of an exported model, and running such a model without trusting it."""

"""What there is to see: scenes of primitives, drawn by the live page and by films."""

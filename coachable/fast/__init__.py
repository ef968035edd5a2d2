"""Optional speed: hand-written passes, kernels and an optimiser that `accelerate` puts in the place of plain torch.

The rest of the library never imports this package, and tests compare it with the plain modules.
"""

from coachable.fast.accelerate import accelerate

__all__ = ["accelerate"]

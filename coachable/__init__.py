"""Style-conditioned reinforcement learning on TorchRL: train one agent, coach it while it acts.

Names are imported on first use, so that `import coachable` loads neither torch nor a simulator, a logger or a plotting
library.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from coachable.gl import choose_gl_backend

choose_gl_backend()  # MuJoCo, which TorchRL imports, reads the variable only when it is imported

if TYPE_CHECKING:
    from coachable.coach.session.session import CoachSession
    from coachable.replay import EventTableBuffer
    from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Weight
    from coachable.transforms import CoachableEnv, StyleRewardTransform, StyleSampler, TaskImpersonation, coachable_env

__version__ = "0.1.0.dev0"

# Public names by module, which `__getattr__` imports lazily (PEP 562).
_NAMES = {
    "coachable.styles": "Choice Setpoint StyleReward StyleSpace Weight",
    "coachable.replay": "EventTableBuffer",
    "coachable.coach.session.session": "CoachSession",
    "coachable.transforms": "CoachableEnv StyleRewardTransform StyleSampler TaskImpersonation coachable_env",
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "Choice",
    "CoachSession",
    "CoachableEnv",
    "EventTableBuffer",
    "Setpoint",
    "StyleReward",
    "StyleRewardTransform",
    "StyleSampler",
    "StyleSpace",
    "TaskImpersonation",
    "Weight",
    "__version__",
    "coachable_env",
]


def __getattr__(name: str) -> object:
    if name in _MODULE_OF:
        return getattr(import_module(_MODULE_OF[name]), name)
    raise AttributeError(f"module 'coachable' has no attribute {name!r}; it offers {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__

"""Style-conditioned reinforcement learning on TorchRL: train one agent, coach it while it acts.

Names are imported on first use, so that `import coachable` loads neither torch nor a simulator, a logger or a plotting
library.
"""

from types import ModuleType
from typing import TYPE_CHECKING

from coachable.gl import choose_gl_backend

choose_gl_backend()  # MuJoCo, which TorchRL imports, reads the variable only when it is imported

if TYPE_CHECKING:
    from coachable.coach.session.session import CoachSession
    from coachable.replay import EventTableBuffer
    from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Weight
    from coachable.transforms import CoachableEnv, StyleRewardTransform, StyleSampler, TaskImpersonation, coachable_env

__version__ = "0.1.0.dev0"


def _styles() -> ModuleType:
    from coachable import styles

    return styles


def _replay() -> ModuleType:
    from coachable import replay

    return replay


def _transforms() -> ModuleType:
    from coachable import transforms

    return transforms


def _session() -> ModuleType:
    from coachable.coach.session import session

    return session


# Functions that import the module of each public name, which `__getattr__` calls on first use (PEP 562).
_IMPORTS = {
    "Choice": _styles,
    "CoachSession": _session,
    "CoachableEnv": _transforms,
    "EventTableBuffer": _replay,
    "Setpoint": _styles,
    "StyleReward": _styles,
    "StyleRewardTransform": _transforms,
    "StyleSampler": _transforms,
    "StyleSpace": _styles,
    "TaskImpersonation": _transforms,
    "Weight": _styles,
    "coachable_env": _transforms,
}

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
    if name in _IMPORTS:
        return getattr(_IMPORTS[name](), name)
    raise AttributeError(f"module 'coachable' has no attribute {name!r}; it offers {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__

"""Style-conditioned reinforcement learning on TorchRL: train one agent, coach it while it acts.

Names are imported on first use (PEP 562), so that `import coachable` loads neither torch nor a simulator, a logger or a
plotting library.
"""

from typing import TYPE_CHECKING

from coachable.gl import choose_gl_backend

choose_gl_backend()  # MuJoCo, which TorchRL imports, reads the variable only when it is imported

if TYPE_CHECKING:
    from coachable.coach.session.session import CoachSession
    from coachable.replay import EventTableBuffer
    from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Weight
    from coachable.transforms import CoachableEnv, StyleRewardTransform, StyleSampler, TaskImpersonation, coachable_env

__version__ = "0.1.0.dev0"

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
    if name in ("Choice", "Setpoint", "StyleReward", "StyleSpace", "Weight"):
        from coachable import styles as module
    elif name in ("CoachableEnv", "StyleRewardTransform", "StyleSampler", "TaskImpersonation", "coachable_env"):
        from coachable import transforms as module
    elif name == "EventTableBuffer":
        from coachable import replay as module
    elif name == "CoachSession":
        from coachable.coach.session import session as module
    else:
        raise AttributeError(f"module 'coachable' has no attribute {name!r}; it offers {', '.join(__all__)}")
    return getattr(module, name)


def __dir__() -> list[str]:
    return __all__

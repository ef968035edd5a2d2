"""TorchRL transforms: styles and style rewards in environments, relabelling in replay, gamepad actions."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coachable.transforms.mirror import MirrorMap, MirrorSymmetry
    from coachable.transforms.style_features import StyleFeatures
    from coachable.transforms.style_reward import StyleRewardTransform
    from coachable.transforms.style_sampler import CoachableEnv, StyleSampler, coachable_env
    from coachable.transforms.task_impersonation import TaskImpersonation

# Resolved on first use, so that one transform does not load the others.
_MODULE_OF = {
    "CoachableEnv": "coachable.transforms.style_sampler",
    "MirrorMap": "coachable.transforms.mirror",
    "MirrorSymmetry": "coachable.transforms.mirror",
    "StyleFeatures": "coachable.transforms.style_features",
    "StyleRewardTransform": "coachable.transforms.style_reward",
    "StyleSampler": "coachable.transforms.style_sampler",
    "TaskImpersonation": "coachable.transforms.task_impersonation",
    "coachable_env": "coachable.transforms.style_sampler",
}

__all__ = [
    "CoachableEnv",
    "MirrorMap",
    "MirrorSymmetry",
    "StyleFeatures",
    "StyleRewardTransform",
    "StyleSampler",
    "TaskImpersonation",
    "coachable_env",
]


def __getattr__(name: str) -> object:
    if name in _MODULE_OF:
        return getattr(import_module(_MODULE_OF[name]), name)
    raise AttributeError(f"module 'coachable.transforms' has no attribute {name!r}; it offers {', '.join(__all__)}")

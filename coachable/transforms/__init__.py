"""TorchRL transforms: styles and style rewards for environments, relabelling and mirror images for replay."""

from coachable.transforms.mirror import MirrorMap, MirrorSymmetry, mirror_map
from coachable.transforms.style_features import StyleFeatures
from coachable.transforms.style_reward import StyleRewardTransform
from coachable.transforms.style_sampler import CoachableEnv, StyleSampler, coachable_env
from coachable.transforms.task_impersonation import TaskImpersonation

__all__ = [
    "CoachableEnv",
    "MirrorMap",
    "MirrorSymmetry",
    "StyleFeatures",
    "StyleRewardTransform",
    "StyleSampler",
    "TaskImpersonation",
    "coachable_env",
    "mirror_map",
]

"""TensorDict keys that TorchRL does not already define.

TorchRL's own keys (`observation`, `action`, `reward`, `done`, ...) are used verbatim. Shapes below are per entry of the
batch, written `(..., size)`.
"""

STYLE = "style"
"""Raw, un-encoded style theta, `(..., d_theta)`, float32, in the units of the `StyleSpace`."""

TASK_REWARD = "task_reward"
"""Reward of the task alone, free of the style, `(..., 1)`."""

STYLE_FEATURES = "style_features"
"""What the style terms read: one tensor `(..., F)`, or a nested tensordict. Free of the style."""

STYLE_REWARD = "style_reward"
"""Style part of the reward, `(..., 1)`; logged only, `reward = task_reward + style_reward`."""

EVENTS = "events"
"""Boolean `(..., n_events)`, what the event tables route by."""

SCENARIO = "scenario"
"""How the episode started, integer `(..., 1)`; what multi-tables route by, where an environment has scenarios."""

TABLE = "table"
"""Which replay table a sample came from, integer `(...,)`."""

"""TensorDict keys that TorchRL does not already define.

TorchRL's own keys (`observation`, `action`, `reward`, `done`, ...) are used verbatim. Shapes below are per entry of the
batch, written `(..., size)`.
"""

STYLE = "style"
"""Raw, un-encoded style theta, `(..., d_theta)`, float32, in the units of the `StyleSpace`."""

TASK_REWARD = "task_reward"
"""Reward of the task alone, independent of the style, `(..., 1)`."""

STYLE_FEATURES = "style_features"
"""Inputs of the style terms, independent of the style, `(..., F)`."""

STYLE_REWARD = "style_reward"
"""Style part of the reward, `(..., 1)`; logged only, `reward = task_reward + style_reward`."""

EVENTS = "events"
"""Events of a step, boolean `(..., n_events)`, by which transitions are routed to event tables."""

SCENARIO = "scenario"
"""Scenario in which the episode started, integer `(..., 1)`, by which transitions are routed to multi-tables."""

TABLE = "table"
"""Index of the replay table of a sample, integer `(...,)`."""

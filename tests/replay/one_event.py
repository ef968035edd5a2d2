"""Steps of one environment with one event, and buffers for them."""

import torch
from tensordict import TensorDict

from coachable.replay import EventTableBuffer, KeyEvents


def steps(ids, fired, done=None, **extra) -> TensorDict:
    """One environment, one event."""
    n = len(ids)
    done = torch.zeros(n, 1, dtype=torch.bool) if done is None else torch.tensor(done).reshape(n, 1)
    fired = torch.tensor(fired).reshape(n, -1)
    return TensorDict({"id": torch.tensor(ids), **extra, "next": {"done": done, "events": fired}}, [n])


def one_event_buffer(horizon: int, base: int = 100, fed: int = 100, **kwargs) -> EventTableBuffer:
    return EventTableBuffer(
        {"default": base, "hit": fed}, events=KeyEvents(["hit"]), event_horizon=horizon, num_envs=1, **kwargs
    )

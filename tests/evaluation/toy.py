"""An environment and measures whose outcome is known: the action is the measured style."""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from coachable.styles import Term


class ToyEnv(EnvBase):
    """`style_features` is the action; the task pays 1 per step. Ends after 5 steps where the action exceeds a limit."""

    def __init__(self, num_envs, num_threads=None, limit=1.6):
        super().__init__(batch_size=[num_envs])
        self.limit = torch.as_tensor(limit).expand(num_envs).unsqueeze(-1)
        n = num_envs
        one = Unbounded(shape=(n, 1))
        self.observation_spec = Composite(observation=one, task_reward=one, style_features=one, shape=(n,))
        self.action_spec = Bounded(0, 4, shape=(n, 1))
        self.reward_spec = one.clone()
        flags = {name: Binary(n=1, shape=(n, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(flags, shape=(n,))
        self.steps = 0

    def _set_seed(self, seed):
        pass

    def _outputs(self, value, terminated):
        values = {"observation": value.clone(), "style_features": value.clone()}
        paid = {name: torch.ones_like(value) for name in ("task_reward", "reward")}
        flags = {"done": terminated, "terminated": terminated.clone(), "truncated": torch.zeros_like(terminated)}
        return TensorDict({**values, **paid, **flags}, self.batch_size)

    def _reset(self, tensordict=None, **_):
        self.steps = 0
        zero = torch.zeros(*self.batch_size, 1)
        return self._outputs(zero, zero.bool()).exclude("reward")

    def _step(self, tensordict):
        self.steps += 1
        action = tensordict["action"]
        return self._outputs(action, (action > self.limit) & (self.steps >= 5))


class ToyMeasures:
    """The speed, which is the action, and its distance from the request, which is column 2 of theta."""

    def step(self, transition):
        value = transition["next", "style_features"].squeeze(-1)
        return {"speed": value, "error": (value - transition["style"][:, 2]).abs()}

    def summarise(self, record, alive):
        return {name: torch.where(alive, values, torch.nan).nanmean(0) for name, values in record.items()}

    def complies(self, record):
        return record["error"] < 0.01


IGNORED = Term(lambda features, style: 0 * style["speed"] + 0 * style["hat"][..., 0], parameters=("speed", "hat"))
"""Term that pays nothing for the speed and the hat."""

"""A step of a fight can be traced, as docs/guides/export.md says."""

import pytest
import torch

from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.fight import run_step
from coachable.envs.combat.gamepad import canonical_rows
from coachable.envs.combat.state import State
from coachable.envs.combat.step_frames import Noise

pytestmark = pytest.mark.slow  # tracing takes a minute


class Step(torch.nn.Module):
    """A step from a copy of the state, without branches on values."""

    def __init__(self, env):
        super().__init__()
        self.env, self.names = env, list(env.state.tensors())

    def forward(self, pad, noise, *state):
        after = State(**{name: value.clone() for name, value in zip(self.names, state, strict=True)})
        components = run_step(after, pad, self.env.rules, Noise(*noise), self.env._ammo, self.env._sections)
        return components, *after.tensors().values()


def test_the_traced_step_is_that_of_the_environment():
    env = CombatEnv(num_envs=1, seed=0)
    data, program = env.reset(), None
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        pad = canonical_rows(env.action_spec.rand().to(torch.float32).T.contiguous())
        drawn = Noise.draw(env.num_enemies, 1, generator)
        noise = [getattr(drawn, name) for name in Noise.__dataclass_fields__]
        arguments = (pad, noise, *env.state.tensors().values())
        with torch.no_grad():
            program = program or torch.export.export(Step(env), arguments)
            expected = Step(env)(*arguments)
            for found, value in zip(program.module()(*arguments), expected, strict=True):
                torch.testing.assert_close(found, value)
        data = env.step(env.rand_action(data))["next"]

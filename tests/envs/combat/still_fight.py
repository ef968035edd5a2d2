"""A fight in which one machine stands still and the pad is scripted, for rules in closed form."""

import math

import torch
from tensordict import TensorDict

from coachable.envs.combat import CombatEnv
from coachable.envs.combat import constants as c
from coachable.envs.combat.rewards import COMPONENT_SLICES
from coachable.envs.combat.tables import WEAPONS
from coachable.envs.combat.traits import SPREAD
from tests.envs.combat.pressing import press

NOTHING = press()
NEVER = 1e6  # frames


def still_fight(machine="Ravager", distance=12.0, num_envs=1, parts=False, **options):
    """The machine neither moves nor attacks, straight ahead of the player at the centre; arrows fly straight."""
    env = CombatEnv(num_envs, seed=0, machines=[machine], sites=["Ice-lake"], components=True, **options)
    env.reset()
    s, one = env.state, torch.ones(num_envs)
    s.position, s.velocity = torch.zeros(2, num_envs), torch.zeros(2, num_envs)
    s.anchor, s.distance = s.position.clone(), distance * one
    s.yaw, s.pitch = 0.0 * one, 0.0 * one
    s.enemy_position = torch.stack((distance * one, 0.0 * one)).unsqueeze(1).repeat(1, env.num_enemies, 1)
    s.enemy_yaw = torch.full_like(s.enemy_yaw, math.pi)
    s.enemy_velocity = torch.zeros_like(s.enemy_velocity)
    s.pause = torch.full_like(s.pause, NEVER)
    if not parts:
        s.count = torch.zeros_like(s.count)
    env.traits.speed = torch.zeros_like(env.traits.speed)
    env._ammo[:, SPREAD] = 0.0
    return env


def hold(env, weapon, section=0):
    env.state.weapon = torch.full_like(env.state.weapon, WEAPONS.index(weapon))
    env.state.section = torch.full_like(env.state.section, section)


def aim_at_body(env):
    """Camera at the centre of the first machine's body."""
    s = env.state
    x, y = s.enemy_position[:, 0] - s.position
    rise = s.enemy_z[0] + env.traits.radius[0] - c.EYE_HEIGHT
    s.yaw, s.pitch = torch.atan2(y, x), torch.atan2(rise, (x * x + y * y).sqrt())


def act(env, *actions):
    """Components of each step, (steps, N, 44), and the last transition's `next`."""
    seen, after = [], None
    for action in actions:
        td = TensorDict({"action": action.expand(env.num_envs, 24).clone()}, [env.num_envs])
        after = env._step(td)
        seen.append(after["components"])
    return torch.stack(seen), after


def part(components, name):
    return components[..., COMPONENT_SLICES[name]]


SHOOT = press("L2", "R2")


def act_plain(env, action):
    return env._step(TensorDict({"action": action.expand(env.num_envs, 24).clone()}, [env.num_envs]))

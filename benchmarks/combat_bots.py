"""Scripted players that read the full state, as a baseline and to check the game's balance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.gamepad import GAMEPAD, HEADS
from coachable.envs.combat.player import facing, wrap
from coachable.envs.combat.state import ACTIVE, TELEGRAPH, nearest, pick
from coachable.envs.combat.tables import AMMO, KINDS, WEAPONS
from coachable.envs.combat.traits import FARTHEST, KIND, SPEED

_BERRY_BELOW = 430.0  # [HP]
_DODGE_WITHIN, _DODGE_SHARE, _SHOT_SHARE = 0.22, 0.6, 0.42  # [s] before an attack, probabilities per step
_SHOT_WITHIN = 0.25  # [s] before a shot lands
_NEAR, _FAR, _STRAFE = 11.0, 16.0, 0.8  # [m], [m], of the stick
_RANGED = KINDS.index("ranged")


def to_stick(direction: Tensor, yaw: Tensor) -> Tensor:
    """Convert directions of the world to a stick; the inverse of `from_stick`.

    Args:
        direction: (2, N).
        yaw: Direction of the camera, counter-clockwise from +x (N,) [rad].

    Returns:
        Stick (2, N), x to the right and y forward.
    """
    x, y = direction
    fx, fy = facing(yaw)
    return torch.stack((fy * x - fx * y, fx * x + fy * y))


@dataclass(frozen=True)
class Bot:
    """Scripted player with one way to fight.

    Attributes:
        name: Name in reports.
        ammo: Ammo that it shoots, or None for the spear.
    """

    name: str
    ammo: str | None = None

    def act(self, env: CombatEnv, generator: torch.Generator) -> Tensor:
        """Return the actions (N, 24) in the present state of an environment.

        Args:
            env: Environment of N fights.
            generator: Random generator of the decisions to dodge.
        """
        s, traits, n = env.state, env.traits, env.num_envs
        second = nearest(s)
        offset = pick(s.enemy_position, second) - s.position
        distance = offset.square().sum(0).sqrt().clamp(min=1e-3)
        turned = to_stick(offset / distance, s.yaw)  # sideways and ahead of the camera
        choice = torch.zeros((len(HEADS), n), dtype=torch.int64)
        choice[4:] = 1  # thumbs on the sticks
        axes = torch.zeros((4, n))

        if self.ammo is None:
            gap = distance - pick(traits.radius, second) - c.BODY_RADIUS
            axes[:2] = turned * (gap > 1.5)
            axes[2:] = self._aim(env, second, aiming=False, flight=torch.zeros(n))
            choice[3] = HEADS["right_shoulder"].index("R1")
        else:
            weapon, section = next(
                (w, i) for w, names in enumerate(AMMO) for i, a in enumerate(names) if a == self.ammo
            )
            angle = 2 * math.pi / len(WEAPONS) * (weapon + (section + 0.5) / len(AMMO[weapon]))
            ready = (s.weapon == weapon) & (s.section == section)
            # Hold the range: forward when far, backward when near, and strafe.
            ahead = (1.0 * (distance > _FAR) - 1.0 * (distance < _NEAR)).unsqueeze(0)
            sideways = torch.stack((turned[1], -turned[0]))
            axes[:2] = (_STRAFE * sideways + ahead * turned).clamp(-1.0, 1.0)
            speed = env._ammo[weapon * 3 + section, SPEED]
            aim = self._aim(env, second, aiming=True, flight=distance / speed)
            axes[2:] = torch.where(ready, aim, torch.tensor([math.cos(angle), math.sin(angle)]).unsqueeze(1))
            choice[2] = torch.where(ready, HEADS["left_shoulder"].index("L2"), HEADS["left_shoulder"].index("L1"))
            choice[3] = torch.where(ready, HEADS["right_shoulder"].index("R2"), 0)

        dodges = self._dodges(env, generator)
        choice[0] = torch.where(dodges, HEADS["face"].index("square"), 0)
        choice[5] = torch.where(dodges, 0, choice[5])  # the thumb leaves the stick
        axes[:2] = torch.where(dodges, torch.stack((torch.ones(n), torch.zeros(n))), axes[:2])
        eats = (s.hp < _BERRY_BELOW) & (s.berries > 0) & ~dodges
        choice[1] = torch.where(eats, HEADS["dpad"].index("up"), 0)
        choice[4] = torch.where(eats, 0, choice[4])
        return GAMEPAD.from_choices(choice.T, axes.T.clamp(-1.0, 1.0))

    @staticmethod
    def _aim(env: CombatEnv, second: Tensor, aiming: bool, flight: Tensor) -> Tensor:
        """Return the right stick (2, N) that aims at the place of the nearest body after the shot's flight [s]."""
        s = env.state
        target = pick(s.enemy_position, second) + pick(s.enemy_velocity, second) * flight - s.position
        level = target.square().sum(0).sqrt()
        rise = pick(s.enemy_z + env.traits.radius, second) - c.EYE_HEIGHT
        yaw_error = wrap(torch.atan2(target[1], target[0]) - s.yaw)
        pitch_error = torch.atan2(rise, level) - s.pitch
        rate = (c.AIM_TURN_RATE if aiming else c.TURN_RATE) * c.CONTROL_STEP
        wanted = torch.stack((-yaw_error / rate, pitch_error / (c.PITCH_FACTOR * rate))).clamp(-1.0, 1.0)
        return wanted.sign() * wanted.abs().pow(1.0 / c.STICK_EXPONENT)

    @staticmethod
    def _dodges(env: CombatEnv, generator: torch.Generator) -> Tensor:
        """Draw whether to dodge, (N,) bool, in the fights in which an attack or a shot is about to hit."""
        s, traits = env.state, env.traits
        kind = traits.attacks[KIND].gather(0, s.attack.unsqueeze(0))[0]
        reach = traits.attacks[FARTHEST].gather(0, s.attack.unsqueeze(0))[0]
        gap = (s.enemy_position - s.position.unsqueeze(1)).square().sum(0).sqrt() - traits.radius - c.BODY_RADIUS
        late = (s.phase == TELEGRAPH) & (s.phase_timer < _DODGE_WITHIN * c.FPS)
        threat = (late | (s.phase == ACTIVE)) & (kind != _RANGED) & (gap < reach + 3.0) & (s.enemy_hp > 0)
        shots = (s.land_timer > 0) & (s.land_timer < _SHOT_WITHIN * c.FPS)
        luck = torch.rand(env.num_envs, generator=generator)
        return (threat.any(0) & (luck < _DODGE_SHARE)) | (shots.any(0).any(0) & (luck < _SHOT_SHARE))


BOTS: dict[str, Bot] = {bot.name: bot for bot in (*(Bot(a, a) for names in AMMO for a in names), Bot("Spear"))}
"""Bots by name: one per ammo, and one with the spear."""

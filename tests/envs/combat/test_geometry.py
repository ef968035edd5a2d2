"""Rays, spheres and pillars against plain geometry in the frame of the world, in numpy."""

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from coachable.envs.combat import CombatEnv
from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import shoot
from coachable.envs.combat.machine import ray_blocked_at, segment_blocked
from coachable.envs.combat.state import NUM_TIMERS
from coachable.envs.combat.tables import AMMO
from coachable.envs.combat.traits import AMMO_SLOTS, BLAST, RANGE, SPEED, SPREAD

N = 400
PILLARS = torch.tensor(c.PILLARS, dtype=torch.float64).T  # (2, 4)
SECTIONS = [AMMO_SLOTS * weapon + i for weapon, names in enumerate(AMMO) for i in range(len(names))]


def entries(ray, centre, radius):
    """Distance at which rays (3, ...) enter spheres, infinite where they miss."""
    along = (ray * centre).sum(0)
    inside = radius**2 - ((centre - along * ray) ** 2).sum(0)
    return np.where((inside >= 0) & (along >= 0), along - np.sqrt(np.maximum(inside, 0)), np.inf)


def double(owner):
    """The same with every float in double precision, so that no decision hangs on the last bit."""
    values = {field.name: getattr(owner, field.name).clone() for field in fields(owner)}
    return type(owner)(**{n: v.double() if v.is_floating_point() else v for n, v in values.items()})


def shots(enemies):
    """Enemies 8 to 30 m away, one nearly behind the other; a shot at some part or body of the first."""
    env, random = CombatEnv(N, seed=0, num_enemies=enemies), np.random.default_rng(enemies)
    env.reset()
    s, traits = double(env.state), double(env.traits)

    def uniform(low, high, *shape):
        return torch.from_numpy(random.uniform(low, high, (*shape, N)))

    bearing, distance = uniform(-3, 3) + uniform(-0.05, 0.05, enemies), uniform(8, 30, enemies)
    s.position = uniform(-5, 5, 2)
    s.enemy_position = s.position.unsqueeze(1) + distance * torch.stack((bearing.cos(), bearing.sin()))
    s.enemy_velocity, s.enemy_yaw = uniform(-3, 3, 2, enemies), uniform(-3, 3, enemies)
    s.enemy_hp = traits.hp * (uniform(0, 1, enemies) < 0.9)
    s.count = (uniform(0, 1, *s.count.shape[:2]) < 0.8) * traits.units
    s.technique, s.timers = (uniform(0, 1) < 0.5).double(), torch.zeros(NUM_TIMERS, N, dtype=torch.float64)
    ammo = env._ammo.double()[torch.from_numpy(random.choice(SECTIONS, N))].T[:11]
    intent = SimpleNamespace(shooting=uniform(0, 1) < 0.9, loaded=torch.ones(N).double(), ammo=ammo)

    # Where the spheres of bodies and parts will be when the shot arrives, from the eye: (3, E, N), (3, 12, E, N).
    rise = s.enemy_z + traits.radius - c.EYE_HEIGHT
    level = s.enemy_position - s.position.unsqueeze(1) + s.enemy_velocity * distance / ammo[SPEED]
    body = torch.cat((level, rise.unsqueeze(0)))
    x, y, z = traits.offset
    cos, sin = s.enemy_yaw.cos(), s.enemy_yaw.sin()
    parts = body.unsqueeze(1) + torch.stack((cos * x - sin * y, sin * x + cos * y, z))

    target = torch.where(uniform(0, 1) < 0.7, parts[:, 0, 0], body[:, 0]) + uniform(-0.3, 0.3, 3)
    s.yaw, s.pitch = torch.atan2(target[1], target[0]), torch.atan2(target[2], target[:2].norm(dim=0))
    return s, traits, intent, distance, uniform(-1, 1, 2), body.numpy(), parts.numpy()


@pytest.mark.parametrize("enemies", [1, 2])
def test_a_shot_meets_the_nearest_sphere_and_its_blast_reaches_parts_near_the_impact(enemies):
    s, traits, intent, distance, spread, body, parts = shots(enemies)
    pillar = torch.where(torch.arange(N) % 10 == 0, 12.0, torch.inf).double()
    yaw, pitch = ((a + intent.ammo[SPREAD] * b).numpy() for a, b in ((s.yaw, spread[0]), (s.pitch, spread[1])))
    ray = np.stack((np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)))
    there, alive = s.count.numpy() > 0, s.enemy_hp.numpy() > 0
    radius, part_radius = traits.radius.numpy(), traits.part_radius.numpy()
    at_parts = np.where(there, entries(ray[:, None, None], parts, part_radius), np.inf)
    first = np.minimum(at_parts.min(0), entries(ray[:, None], body, c.BODY_SPHERE * radius))
    limit = np.minimum(intent.ammo[RANGE].numpy(), pillar.numpy())
    living = np.where(alive, first, np.inf)
    met = intent.shooting.numpy() & (living <= limit) & (living == living.min(0))
    struck = met & (at_parts == first)
    gap = np.linalg.norm(np.where(met, first, 0) * ray[:, None, None] - parts, axis=0)
    blast = intent.ammo[BLAST].numpy()
    share = np.maximum(struck, np.clip(1 - gap / (blast + part_radius), 0, None) * (met & (blast > 0))) * there
    factor = 1.0 + s.technique.numpy() * (c.TECHNIQUE_FACTOR - 1.0)
    through = 1.0 + (struck * traits.hit_factor.numpy()).sum(0)

    relative = s.enemy_position - s.position.unsqueeze(1)
    hit, body_factor, part_factor = shoot(s, intent, traits, relative, distance, spread, pillar)
    np.testing.assert_array_equal(hit, met)
    np.testing.assert_allclose(body_factor, met * factor * through)
    np.testing.assert_allclose(part_factor, share * factor, atol=1e-6)
    np.testing.assert_array_equal(intent.loaded, ~intent.shooting)
    # All of it happens: shots that meet nothing, a body, a part, and blasts that also reach other parts.
    reached = (share > 0).sum((0, 1))
    assert (~met.any(0)).sum() > 20 and (met.any(0) & ~struck.any((0, 1))).sum() > 20
    assert struck.any(0).sum(-1).min() > 5 and (reached > 1).sum() > 20 and (reached[blast == 0] <= 1).all()


def test_a_pillar_blocks_the_segments_that_come_within_its_radius():
    start, end = torch.from_numpy(np.random.default_rng(0).uniform(-16, 16, (2, 2, 2, 100)))
    points = start + torch.linspace(0, 1, 301).double().view(-1, 1, 1, 1) * (end - start)  # (301, 2, E, N)
    away = (points.unsqueeze(2) - PILLARS.view(2, 4, 1, 1)).norm(dim=1).amin((0, 1))
    clear = (away - c.PILLAR_RADIUS).abs() > 0.01  # the points are at most 0.15 m apart
    blocked = segment_blocked(start, end, PILLARS)
    assert torch.equal(blocked[clear], (away < c.PILLAR_RADIUS)[clear])
    assert 0.1 < blocked.float().mean() < 0.5 and clear.float().mean() > 0.9


def test_a_level_ray_ends_where_it_enters_a_pillar():
    random, step = np.random.default_rng(0), 0.1
    position = torch.from_numpy(random.uniform(-15, 15, (2, 200)))
    position = position[:, (position.unsqueeze(1) - PILLARS.unsqueeze(-1)).norm(dim=0).amin(0) > 2.0]
    yaw = torch.from_numpy(random.uniform(-3.2, 3.2, position.shape[1]))
    reach = torch.arange(0, 45, step).double().view(-1, 1, 1)
    away = (position + reach * torch.stack((yaw.cos(), yaw.sin()))).unsqueeze(2) - PILLARS.unsqueeze(-1)
    away = away.norm(dim=1).amin(1)  # (450, N) from the axis of the nearest pillar
    clear = (away.amin(0) - c.PILLAR_RADIUS).abs() > 0.01
    inside = away < c.PILLAR_RADIUS
    entered = torch.where(inside.any(0), inside.double().argmax(0) * step - step / 2, torch.inf).double()
    found = ray_blocked_at(position, yaw, PILLARS)
    torch.testing.assert_close(found[clear], entered[clear], atol=step / 2 + 1e-6, rtol=0)
    assert 0.05 < found.isfinite().float().mean() < 0.9

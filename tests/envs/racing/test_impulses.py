"""Impulses of walls and cars against the mechanics of rigid bodies, written with matrices in numpy."""

import numpy as np
import pytest
import torch

from coachable.envs.racing.physics import contact
from coachable.envs.racing.physics.body import wall_impulse, wheel_velocity
from coachable.envs.racing.physics.contact import Bodies, collide, overlap

MASS, INERTIA, RESTITUTION = 1300.0, 2100.0, 0.3


def motions(n=50, seed=0):
    """Velocities, points of the body and unit normals, (N,) each."""
    random = np.random.default_rng(seed)
    velocity = random.uniform([-20, -20, -3], [20, 20, 3], (n, 3))
    point, angle = random.uniform(-2.5, 2.5, (n, 2)), random.uniform(-np.pi, np.pi, n)
    return velocity, point, np.stack([np.cos(angle), np.sin(angle)], -1)


def columns(values):
    return tuple(torch.tensor(values).unbind(-1))


def hit_wall(velocity, point, normal, friction, restitution=RESTITUTION):
    touching = torch.ones(len(velocity), dtype=torch.bool)
    hit = wall_impulse(
        columns(velocity), columns(point), columns(normal), touching, MASS, INERTIA, restitution, friction
    )
    return torch.stack(hit, -1).numpy()


def at_point(velocity, point):
    """Velocity of a point of the body (N, 2)."""
    return velocity[:, :2] + velocity[:, 2:] * np.stack([-point[:, 1], point[:, 0]], -1)


def mobility(point, mass=MASS, inertia=INERTIA):
    """(N, 2, 2): how much velocity a unit impulse at the point gives to the point."""
    arm = np.stack([-point[:, 1], point[:, 0]], -1)
    return np.eye(2) / mass + arm[:, :, None] * arm[:, None, :] / inertia


def test_a_wall_without_friction_returns_its_share_of_the_approach():
    velocity, point, normal = motions()
    change = hit_wall(velocity, point, normal, friction=0.0)
    before = (at_point(velocity, point) * normal).sum(-1)
    after = (at_point(velocity + change, point) * normal).sum(-1)
    expected = np.where(before > 0, -RESTITUTION * before, before)
    np.testing.assert_allclose(after, expected, atol=1e-9)
    impulse = MASS * change[:, :2]
    np.testing.assert_allclose(np.einsum("nij,nj->ni", mobility(point), impulse), at_point(change, point), atol=1e-9)
    np.testing.assert_allclose(impulse[:, 0] * normal[:, 1], impulse[:, 1] * normal[:, 0], atol=1e-6)


def test_friction_of_a_wall_is_bounded_by_the_push_and_opposes_the_sliding():
    velocity, point, normal = motions(seed=1)
    change = hit_wall(velocity, point, normal, friction=0.2)
    tangent = np.stack([-normal[:, 1], normal[:, 0]], -1)
    impulse = MASS * change[:, :2]
    push, sliding = -(impulse * normal).sum(-1), (impulse * tangent).sum(-1)
    along = (at_point(velocity, point) * tangent).sum(-1)
    approaching = (at_point(velocity, point) * normal).sum(-1) > 0
    assert 10 < approaching.sum() < 40
    assert (push[approaching] > 0).all() and np.abs(push[~approaching]).max() < 1e-9
    assert (np.abs(sliding) <= 0.2 * push + 1e-6).all()
    assert (sliding * along <= 1e-9).all()
    # Where the limit does not matter, the friction alone would stop the point's sliding.
    stopping = -along / np.einsum("ni,nij,nj->n", tangent, mobility(point), tangent)
    expected = np.clip(stopping, -0.2 * push, 0.2 * push)
    np.testing.assert_allclose(sliding, expected, atol=1e-6)
    assert (np.abs(stopping) < 0.2 * push).sum() > 0
    np.testing.assert_allclose(
        INERTIA * change[:, 2], point[:, 0] * impulse[:, 1] - point[:, 1] * impulse[:, 0], atol=1e-6
    )


def test_a_wall_that_is_not_touched_does_nothing():
    velocity, point, normal = map(columns, motions())
    hit = wall_impulse(velocity, point, normal, torch.zeros(50, dtype=torch.bool), MASS, INERTIA, 0.3, 0.2)
    assert all((part == 0).all() for part in hit)


def pairs(n=400, seed=0):
    """Two rectangles of different mass and inertia, with random poses close together, and a third one far away."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low, high):
        return low + (high - low) * torch.rand(3, n, generator=g, dtype=torch.float64)

    x, yaw = uniform(-2, 2), uniform(-3, 3)
    x[2] = 1000.0
    mass, inertia = uniform(700, 1500), uniform(1000, 3000)
    motion = (uniform(-20, 20), uniform(-20, 20), uniform(-1, 1))
    return Bodies(x, uniform(-2, 2), yaw.cos(), yaw.sin(), *motion, mass, inertia, 2.3, 1.0)


def closing(b, push, o):
    """Relative velocity of the two cars where they touch, before and after, along the normal and across it."""
    found = []
    for scale in (0.0, 1.0):
        vx, vy, rate = (v + scale * p for v, p in ((b.vx, push.vx), (b.vy, push.vy), (b.yaw_rate, push.yaw_rate)))
        qx, qy = o.x + b.x[0] - b.x[1], o.y + b.y[0] - b.y[1]
        ax, ay = wheel_velocity(vx[0], vy[0], rate[0], o.x, o.y)
        bx, by = wheel_velocity(vx[1], vy[1], rate[1], qx, qy)
        ux, uy = ax - bx, ay - by
        found.append((ux * o.nx + uy * o.ny, uy * o.nx - ux * o.ny))
    return found


def first_and_second(b):
    return tuple(Bodies(*(f[k] if isinstance(f, torch.Tensor) else f for f in b)) for k in (0, 1))


def test_cars_without_friction_part_with_their_share_of_the_closing_speed(monkeypatch):
    monkeypatch.setattr(contact, "FRICTION", 0.0)
    b = pairs()
    o = overlap(*first_and_second(b))
    push, impact = collide(b, torch.zeros(b.x.shape, dtype=torch.int64), torch.zeros(1, *b.x.shape).double())
    (before, across), (after, _) = closing(b, push, o)
    touching = o.depth > 0
    assert 50 < (touching & (before < 0)).sum() < touching.sum()
    expected = torch.where(touching & (before < 0), -contact.RESTITUTION * before, before)
    torch.testing.assert_close(after, expected)
    torch.testing.assert_close(impact[0, 0], torch.where(touching, before**2 + across**2, 0.0))


def test_overlapping_cars_are_moved_apart_the_lighter_one_further():
    b = pairs(seed=1)
    o = overlap(*first_and_second(b))
    push, _ = collide(b, torch.zeros(b.x.shape, dtype=torch.int64), torch.zeros(1, *b.x.shape).double())
    apart = (push.x[0] - push.x[1]) * o.nx + (push.y[0] - push.y[1]) * o.ny
    torch.testing.assert_close(apart, 0.8 * o.depth.clamp(min=0))
    torch.testing.assert_close(b.mass[0] * push.x[0], -b.mass[1] * push.x[1])
    torch.testing.assert_close(b.mass[0] * push.y[0], -b.mass[1] * push.y[1])


@pytest.mark.parametrize("cars", [2, 3])
def test_friction_stops_cars_that_slide_along_each_other(cars, monkeypatch):
    """Bumper to bumper, sliding sideways: friction without limit leaves no relative speed where they touch."""
    monkeypatch.setattr(contact, "FRICTION", 1e9)
    x = torch.tensor([0.0, 4.5, 100.0], dtype=torch.float64)[:cars, None]
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    mass, inertia = (
        torch.tensor([[900.0], [1400.0], [1000.0]]).double()[:cars],
        torch.tensor([[1500.0], [2500.0], [9.0]]),
    )
    vx, vy = torch.tensor([[2.0], [-1.0], [0.0]]).double()[:cars], torch.tensor([[5.0], [-3.0], [0.0]]).double()[:cars]
    b = Bodies(x, zero, one, zero, vx, vy, zero, mass, inertia.double()[:cars], 2.3, 1.0)
    push, _ = collide(b, torch.zeros(cars, 1, dtype=torch.int64), torch.zeros(cars // 2, cars, 1).double())
    o = overlap(*first_and_second(b))
    (normal, _), (after_normal, after_across) = closing(b, push, o)
    torch.testing.assert_close(after_normal, -contact.RESTITUTION * normal)
    # Two cars are visited twice, each time with the point of contact on the other's bumper, 0.1 m apart.
    torch.testing.assert_close(after_across, torch.zeros_like(after_across), atol=1e-9 if cars == 3 else 0.3, rtol=0)
    assert (push.yaw_rate[:2].abs() > 0.1).all()

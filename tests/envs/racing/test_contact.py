"""Cars as rectangles: overlap, momentum, gaps; cars against walls."""

import numpy as np
import pytest
import torch

from coachable.envs.racing.physics.contact import Bodies, body_gaps, collide, overlap
from coachable.envs.racing.physics.state import ROW, CarInputs
from coachable.envs.racing.physics.surface import locate
from coachable.envs.racing.race.task import impacts_of

LENGTH, WIDTH = 4.6, 2.0
INPUT = {name: row for row, name in enumerate(CarInputs._fields)}


def bodies(x, y, yaw, vx=0.0, vy=0.0, yaw_rate=0.0, mass=1300.0):
    def full(value):
        return torch.as_tensor(value, dtype=torch.float64).expand(np.shape(x)).clone()

    yaw = full(yaw)
    return Bodies(
        full(x),
        full(y),
        yaw.cos(),
        yaw.sin(),
        full(vx),
        full(vy),
        full(yaw_rate),
        full(mass),
        2000.0,
        LENGTH / 2,
        WIDTH / 2,
    )


def corners(x, y, yaw):
    local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [LENGTH / 2, WIDTH / 2]
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return local @ turn + [x, y]


def inside(point, x, y, yaw):
    dx, dy = point[0] - x, point[1] - y
    along, across = dx * np.cos(yaw) + dy * np.sin(yaw), dy * np.cos(yaw) - dx * np.sin(yaw)
    return abs(along) <= LENGTH / 2 and abs(across) <= WIDTH / 2


def cross(o, a, b):
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def overlap_by_edges(first, second):
    """Another way to find it: a vertex of one lies inside the other, or two edges cross."""
    p, q = corners(*first), corners(*second)
    if any(inside(c, *second) for c in p) or any(inside(c, *first) for c in q):
        return True
    for i in range(4):
        for j in range(4):
            a, b, c, d = p[i], p[(i + 1) % 4], q[j], q[(j + 1) % 4]
            if cross(a, b, c) * cross(a, b, d) < 0 and cross(c, d, a) * cross(c, d, b) < 0:
                return True
    return False


def test_overlap_agrees_with_another_method():
    random = np.random.default_rng(0)
    poses = random.uniform([-4, -4, -4], [4, 4, 4], (400, 3))
    others = random.uniform([-4, -4, -4], [4, 4, 4], (400, 3))
    found = overlap(bodies(*poses.T), bodies(*others.T)).depth.numpy() > 0
    expected = np.array([overlap_by_edges(a, b) for a, b in zip(poses, others, strict=True)])
    assert 50 < expected.sum() < 350
    assert (found == expected).all()


def test_the_point_of_contact_lies_in_both_cars():
    random = np.random.default_rng(1)
    poses, others = (random.uniform([-3, -3, -4], [3, 3, 4], (300, 3)) for _ in range(2))
    found = overlap(bodies(*poses.T), bodies(*others.T))
    for k in np.flatnonzero(found.depth.numpy() > 0):
        point = poses[k, :2] + [found.x[k].item(), found.y[k].item()]
        for pose in (poses[k], others[k]):
            dx, dy = point - pose[:2]
            along = dx * np.cos(pose[2]) + dy * np.sin(pose[2])
            assert abs(along) < LENGTH / 2 + 1.0


def test_contacts_conserve_momentum_and_lose_energy():
    """Five cars thrown together at random; friction and restitution only take energy."""
    generator = torch.Generator().manual_seed(0)

    def uniform(low, high):
        return low + (high - low) * torch.rand(5, 200, generator=generator, dtype=torch.float64)

    group = torch.zeros(5, 200, dtype=torch.int64)
    b = bodies(uniform(-6, 6), uniform(-6, 6), uniform(-3, 3), uniform(-20, 20), uniform(-20, 20), uniform(-1, 1))
    b = b._replace(mass=uniform(700, 1500))
    push, impact = collide(b, group, torch.zeros(2, 5, 200, dtype=torch.float64))
    touched = (impacts_of(impact, 5) > 0).any(0)
    assert 100 < touched.sum() < 999
    for change in (push.vx, push.vy):
        assert (b.mass * change).sum(0).abs().max() < 1e-8
    spin = 2000.0 * push.yaw_rate + b.mass * (b.x * push.vy - b.y * push.vx)
    assert spin.sum(0).abs().max() < 1e-7
    assert (b.mass * push.x).sum(0).abs().max() < 1e-8
    assert (push.vx[~touched] == 0).all()
    pairs = (impacts_of(impact, 5) > 0).sum(0)
    single = pairs.sum(0) == 2  # one contact in the race: several at once may add energy to each other

    def energy(vx, vy, yaw_rate):
        return (b.mass * (vx**2 + vy**2) + 2000.0 * yaw_rate**2).sum(0) / 2

    before, after = energy(b.vx, b.vy, b.yaw_rate), energy(b.vx + push.vx, b.vy + push.vy, b.yaw_rate + push.yaw_rate)
    assert single.sum() > 5
    assert ((after - before)[single] <= 1e-6 * before[single]).all()


@pytest.mark.parametrize("cars", [2, 3, 4])
def test_head_on_contact_returns_the_restitution(cars):
    """Two equal cars in line at ±10 m/s: 0.15 of the speed returns, whatever the number of cars in the race."""
    x = torch.tensor([0.0, 4.5, 100.0, 200.0], dtype=torch.float64)[:cars, None]
    b = bodies(x, 0.0, 0.0)
    b = b._replace(vx=torch.tensor([10.0, -10.0, 0.0, 0.0], dtype=torch.float64)[:cars, None])
    push, impact = collide(b, torch.zeros(cars, 1, dtype=torch.int64), torch.zeros(cars // 2, cars, 1).double())
    torch.testing.assert_close((b.vx + push.vx)[:2, 0], torch.tensor([-1.5, 1.5], dtype=torch.float64))
    assert impacts_of(impact, cars)[:, 0, 0].max() == 400.0


def test_cars_of_different_groups_pass_through_each_other():
    b = bodies(torch.tensor([[0.0], [1.0]]), 0.0, 0.0)
    push, impact = collide(b, torch.tensor([[0], [1]]), torch.zeros(1, 2, 1).double())
    assert all((part == 0).all() for part in push)
    assert (impact == 0).all()


def test_gaps_are_those_of_the_projections():
    ego = bodies(torch.tensor([0.0, 0.0, 0.0]), 0.0, 0.0)
    other = bodies(torch.tensor([10.0, 1.0, 0.0]), torch.tensor([0.0, 3.0, 5.0]), torch.tensor([0.0, 0.0, np.pi / 2]))
    long, lat = body_gaps(ego, other)
    torch.testing.assert_close(long, torch.tensor([10 - LENGTH, 0.0, 0.0]).double())
    torch.testing.assert_close(lat, torch.tensor([0.0, 3 - WIDTH, 5 - WIDTH / 2 - LENGTH / 2]).double())


def test_distance_to_an_arc_is_exact():
    """A circle to the left with radius 50 m around (0, 50)."""
    angle = torch.linspace(-0.6, 0.6, 25, dtype=torch.float64)
    radius = torch.linspace(35, 65, 25, dtype=torch.float64)
    one = torch.ones_like(angle)
    arc = locate(radius * angle.sin(), 50 - radius * angle.cos(), 0 * one, 0 * one, one, 0 * one, one / 50)
    torch.testing.assert_close(arc.offset, 50 - radius, atol=1e-9, rtol=0)
    torch.testing.assert_close(arc.ahead, 50 * angle, atol=2e-4, rtol=0)
    torch.testing.assert_close(arc.nx, -angle.sin(), atol=1e-9, rtol=0)


def test_walls_throw_back_and_stop(plane):
    cars = plane(n=2, speed=30.0)
    cars.set("yaw", torch.tensor([0.5, -0.5]).double())
    cars.inputs[INPUT["left"]] = cars.inputs[INPUT["right"]] = 6.0
    cars.inputs[INPUT["margin"]] = 10.0
    energies, reach = [], []
    for _ in range(200):
        cars.step()
        spin = 2000.0 * cars.get("yaw_rate") ** 2 / cars.car.mass
        energies.append(cars.get("vx") ** 2 + cars.get("vy") ** 2 + spin)
        reach.append(cars.get("y").abs().clone())
    assert torch.stack(reach).max() < 16.0
    assert (cars.state[ROW["wall_time"]] > 0).all()
    assert (torch.stack(energies).diff(dim=0) < 0.5).all()
    torch.testing.assert_close(cars.get("y")[0], -cars.get("y")[1])

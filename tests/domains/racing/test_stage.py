"""Scene of a race: cars have shapes and turn their wheels, and leave marks only where they slide."""

import math

import numpy as np
import pytest
import torch

from coachable.domains.racing.car_scene import (
    GRAND_TOURER,
    OPEN_WHEEL,
    STREET,
    body,
    kind_of,
    wheel_places,
    wheel_slip,
)
from coachable.domains.racing.car_view import SLIDING, CarSize, car_poses
from coachable.domains.racing.circuit_scene import circuit, outline
from coachable.domains.racing.stage import CARS, SKID, RacingStage
from coachable.envs.racing import RacingEnv
from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.physics.cars import load_car
from coachable.envs.racing.physics.state import ROW, SPINS
from coachable.scene.parts import rotated


@pytest.fixture
def env():
    env = RacingEnv(1, track="lakeside", seed=0)
    env.reset()
    return env


def rolling(env, vx=30.0, vy=0.0, spin=1.0):
    """The car rolls straight on, sideways at vy, with wheels that turn `spin` times as fast as the road passes."""
    state = env.state
    state[[ROW["yaw"], ROW["yaw_rate"], ROW["steer"]]] = 0.0
    state[ROW["vx"]], state[ROW["vy"]] = vx, vy
    state[SPINS] = spin * vx / env.garage.car.wheel_radius
    env.state = state


def advance(env, metres):
    env.state[ROW["x"]] += metres


@pytest.mark.parametrize(
    "motion, slides",
    [({}, False), ({"vy": 1.0}, False), ({"vy": 9.0}, True), ({"spin": 1.5}, True), ({"spin": 0.5}, True)],
    ids=["rolling", "a small slip angle", "drifting", "wheelspin", "locking"],
)
def test_skid_marks_only_where_a_wheel_slides(env, motion, slides):
    stage = RacingStage()
    rolling(env, **motion)
    for _ in range(4):
        frame = stage.frame(env)
        advance(env, 3.0)
    marks = frame.marks.of("box")
    assert len(marks) == (12 if slides else 0)  # three between four states, of four wheels
    if slides:
        assert marks.sizes[:, 0] == pytest.approx(3.0, abs=1e-3) and (marks.colours == SKID).all()
        places = wheel_places(*(getattr(env.garage.car, n) for n in _WHEELS))
        x, y = float(env.state[ROW["x"]]) - 10.5, float(env.state[ROW["y"]])
        assert marks.positions[:4, :2] == pytest.approx(places + np.array([x, y]), abs=1e-2)
    assert ("sliding" in frame.gauges[3].text) == slides


_WHEELS = ("front_axle", "rear_axle", "track_front", "track_rear")


def test_slip_is_1_where_the_tyre_has_its_largest_force():
    car = load_car("gt3")
    places = wheel_places(*(getattr(car, name) for name in _WHEELS))
    state = np.zeros(29)
    state[ROW["vx"]] = 50.0
    state[SPINS] = 50.0 * (1 + car.peak_slip_ratio) / car.wheel_radius
    arguments = (places, car.wheel_radius, car.peak_slip_ratio, car.peak_slip_angle)
    assert wheel_slip(state, *arguments) == pytest.approx(1.0, rel=0.01)
    state[SPINS] = 50.0 / car.wheel_radius
    state[ROW["vy"]] = 50.0 * math.tan(car.peak_slip_angle)
    assert wheel_slip(state, *arguments) == pytest.approx(1.0, rel=0.01)
    state[ROW["steer"]] = car.peak_slip_angle  # the front wheels point where the car goes
    slip = wheel_slip(state, *arguments)
    assert slip[:2] == pytest.approx(0.08, abs=0.1) and slip[2:] == pytest.approx(1.0, rel=0.01)
    assert SLIDING > 1.0


def test_marks_end_with_the_episode(env):
    stage = RacingStage()
    rolling(env, vy=9.0)
    for _ in range(3):
        stage.frame(env)
        advance(env, 3.0)
    env.reset()
    assert len(stage.frame(env).marks) == 0


def test_kinds_of_cars():
    assert [kind_of(load_car(name).lift_area) for name in ("x2019", "gt3", "street")] == [
        OPEN_WHEEL,
        GRAND_TOURER,
        STREET,
    ]
    shapes = {kind: body(kind, 4.6, 2.0, CARS[0]) for kind in (OPEN_WHEEL, GRAND_TOURER, STREET)}
    assert len(shapes[GRAND_TOURER]) == len(shapes[STREET]) + 6  # splitter, wing, two posts, two end plates
    for shape in shapes.values():
        boxes = shape.of("box")
        reach = np.abs(boxes.positions) + boxes.sizes / 2
        assert reach[:, 0].max() == pytest.approx(2.3, abs=0.2) and reach[:, 1].max() <= 1.05


def test_front_wheels_are_steered_and_all_roll(env):
    stage = RacingStage()
    rolling(env)
    before = stage.frame(env).parts.of("cylinder")
    env.state[ROW["steer"]] = 0.3
    after = stage.frame(env).parts.of("cylinder")
    assert len(after) == 8  # tyre and rim of four wheels
    axles = [rotated(turn, np.array([[0.0, 0.0, 1.0]]))[0] for turn in after.wxyzs]
    turned = [math.degrees(math.acos(min(1.0, abs(axle[1])))) for axle in axles]
    assert turned[:4] == pytest.approx([math.degrees(0.3)] * 4, abs=0.5) and turned[4:] == pytest.approx(
        [0.0] * 4, abs=0.5
    )
    assert not np.allclose(before.wxyzs, after.wxyzs)
    turn = car_poses(np.zeros(29), np.full(4, 0.1), CarSize.of(env.garage.car))[1, 3:]
    spoke = rotated(turn, np.array([[0.0, 0.0, 0.3]]))[0]
    assert spoke[0] > 0, "the top of a wheel that rolls forward moves forward"


def test_every_car_that_is_met_is_drawn_in_its_own_colour():
    env = RacingEnv(3, cars=3, track="ring", seed=0)
    env.reset()
    env.group[:] = 0
    frame = RacingStage().frame(env, 1)
    seen = {tuple(colour) for colour in frame.parts.of("box").colours.tolist()}
    assert set(CARS[:3]) <= seen and not {*CARS[3:]} & seen - {(213, 94, 0), (240, 228, 66)}
    assert len(frame.map.places) == 3
    assert frame.map.places[0] == pytest.approx(env.state[:2, 1].tolist())


def test_the_circuit_has_kerbs_in_bends_and_none_on_straights():
    track = load_track("lakeside")
    scenery = {surface.name: surface for surface in circuit(track).surfaces}
    table = track.table.numpy()
    assert {"grass", "run_off", "tarmac", "lines", "walls", "kerbs_0", "kerbs_1"} == set(scenery)
    for name in ("kerbs_0", "kerbs_1"):
        corners = scenery[name].vertices[:, None, :2]
        nearest = np.hypot(*np.moveaxis(corners - table[:, :2], -1, 0)).argmin(1)
        bend = np.maximum(np.abs(table[nearest, 4]), np.abs(table[nearest - 1, 4]))
        assert bend.min() > 1 / 350
    tarmac = scenery["tarmac"]
    a, b, c = (tarmac.vertices[tarmac.faces[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)[:, 2] / 2
    assert (area > 0).all() and area.sum() == pytest.approx(track.length * 12.0, rel=0.01)
    for surface in scenery.values():
        assert surface.faces.max() < len(surface.vertices)
    straight = circuit(load_track("ring")).surfaces
    assert len(straight) == 7  # a ring of 200 m bends everywhere
    assert len(outline(track)) < 240


def test_no_tree_stands_on_the_track():
    track = load_track("endurance")
    trees = circuit(track).parts.of("cylinder").positions[:, :2]
    table = track.table.numpy()
    assert len(trees) > 100
    distance = torch.cdist(torch.from_numpy(trees), torch.from_numpy(table[:, :2])).amin(1)
    assert float(distance.min()) > (table[:, 5:7].max(1) + table[:, 7]).max()

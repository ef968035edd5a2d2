"""A control step of racing as a graph, in Python and in Node, computes what the environment computes."""

import json

import numpy as np
import pytest
import torch

from coachable.domain import load_domain
from coachable.domains.racing.web_step import MEASURES, memory_of
from coachable.keys import STYLE, STYLE_FEATURES
from coachable.networks.plain import DeterministicAction
from coachable.training.weights import domain_of, load_policy

STYLES = ([0.0, 0.0, 0.0, 0.0], [0.0, 5.0, 0.0, 5.0], [-0.4, -0.4, 0.0, 0.0], [5.0, 5.0, 5.0, 5.0])
STEPS = 1000
SEEN = 17  # entries of the whole state that only the picture needs
STEP_TOLERANCE = 1e-4  # after one step from the same state, relative to values above 1
FREE_STEPS, FREE_TOLERANCE = 100, 0.01  # [m], of the place of a car that drives on its own


@pytest.fixture(scope="module")
def agent():
    return load_policy("racing_drift")


@pytest.fixture(scope="module")
def drive(agent):
    """1000 steps of the shipped agent with changing styles: each state, what followed, and what was measured."""
    plain, domain = DeterministicAction(agent.actor).eval(), domain_of(agent)
    env = domain.make_env(num_envs=1, seed=3)
    data, steps = env.reset(), []
    for step in range(STEPS):
        theta = torch.tensor([STYLES[step * len(STYLES) // STEPS]])
        memory, observation = memory_of(env), data["observation"]
        with torch.no_grad():
            (action,) = plain(observation, theta)
        after = env.step(data.set("action", action))["next"]
        transition = {
            STYLE: theta,
            **{("next", key): after[key] for key in ("observation", STYLE_FEATURES, "telemetry")},
        }
        measured = domain.measures.step(transition)
        steps.append(
            {
                "memory": memory.numpy(),
                "observation": observation.numpy(),
                "action": action.numpy(),
                "style": theta.numpy(),
                "memory_after": torch.cat([env.state.T, env.run.T, env.compound.T], dim=1).numpy(),
                "observation_after": after["observation"].numpy(),
                "terminated": bool(after["terminated"]),
                "measured": [float(measured.get(measure.name, torch.nan)) for measure in MEASURES["drift"]],
            }
        )
        data = env.reset() if after["done"].item() else after.exclude("reward")
    return steps


@pytest.fixture(scope="module")
def graph(stepped_site):
    onnxruntime = pytest.importorskip("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(stepped_site / "step.onnx", options)
    names = [output.name for output in session.get_outputs()]

    def step(memory, action, style):
        return dict(zip(names, session.run(None, {"memory": memory, "action": action, "style": style}), strict=True))

    return step


def apart(found, expected):
    """Largest difference, relative to expected values above 1; NaN has to be in the same places."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    assert (np.isnan(found) == np.isnan(expected)).all()
    return np.nanmax(np.abs(found - expected) / np.maximum(1.0, np.abs(expected)))


def test_each_of_1000_steps_is_that_of_the_environment(drive, graph):
    worst = {"memory_after": 0.0, "observation": 0.0, "measured": 0.0}
    for step in drive:
        found = graph(step["memory"], step["action"], step["style"])
        expected = {**step, "observation": step["observation_after"], "measured": [step["measured"]]}
        found["memory_after"] = found["memory_after"][:, :-SEEN]
        assert found["terminated"].item() == step["terminated"]
        worst = {name: max(value, apart(found[name], expected[name])) for name, value in worst.items()}
    print(worst)  # shown by pytest -s
    assert max(worst.values()) < STEP_TOLERANCE


def test_a_car_that_drives_on_its_own_stays_where_it_is_in_python(drive, graph, agent):
    plain, away = DeterministicAction(agent.actor).eval(), []
    memory, observation = drive[0]["memory"], drive[0]["observation"]
    for step in drive[:FREE_STEPS]:
        with torch.no_grad():
            (action,) = plain(torch.from_numpy(observation), torch.from_numpy(step["style"]))
        found = graph(memory, action.numpy(), step["style"])
        memory, observation = found["memory_after"], found["observation"]
        away.append(np.hypot(*(memory[0, :2] - step["memory_after"][0, :2])))
    print(away[49], away[-1])  # shown by pytest -s
    assert max(away) < FREE_TOLERANCE


def test_the_page_computes_the_same_in_node(drive, drive_steps):
    for style in STYLES:
        states = [step for step in drive if np.allclose(step["style"], style)]
        rows = ("memory", "observation", "action")
        task = {"style": style, "states": [{name: step[name][0].tolist() for name in rows} for step in states]}
        results = drive_steps("replay", **task)
        assert len(results) == STEPS // len(STYLES)
        for step, result in zip(states, results, strict=True):
            assert result["terminated"] == step["terminated"]
            assert apart([result["memory"][:-SEEN]], step["memory_after"]) < STEP_TOLERANCE
            assert apart([result["observation"]], step["observation_after"]) < STEP_TOLERANCE
            measured = [np.nan if value is None else value for value in result["measured"]]
            assert apart(measured, step["measured"]) < STEP_TOLERANCE


def test_the_car_slides_when_asked_to_and_not_otherwise(drive_steps):
    corner = [measure.name for measure in MEASURES["drift"]].index("sideslip_corners")
    angles = []
    for style in ([0.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 3.0]):
        drive = drive_steps("drive", style=style, steps=300, start=0)
        print(f"{drive['milliseconds']:.1f} ms per control step")  # shown by pytest -s
        values = [result["measured"][corner] for result in drive["results"][50:]]
        angles.append(np.mean([value for value in values if value is not None]))
        assert len(drive["seen"]["figures"]) == 5 * 7
    assert angles[1] > angles[0] + 15.0


def test_the_manifest_has_the_constants_of_the_environment(stepped_site):
    manifest = json.loads((stepped_site / "manifest.json").read_text())
    assert manifest["kind"] == "stepped" and len(manifest["starts"]) == 8
    assert manifest["physics"] == {"control_step": 0.1, "substeps": 10, "episode_steps": 1500, "track": "ridge"}
    assert sum(file.stat().st_size for file in stepped_site.rglob("*") if file.is_file()) < 25e6
    assert not (stepped_site / "third_party" / "@mujoco").exists()


@pytest.mark.parametrize("env", [{"cars": 3}, {"car": "pool"}])
def test_traffic_and_pools_of_cars_are_recorded(env):
    assert load_domain("racing_resources").make_web is not None
    assert load_domain("racing_resources", {"env": env}).make_web is None
    assert load_domain("racing_aggressiveness").make_web is None


def test_a_car_that_is_alone_is_not_asked_to_overtake():
    domain = load_domain("racing_resources")
    assert domain.make_web is not None
    part = domain.make_web(domain.make_space())
    assert set(part.idle) == {"overtake", "defend"} and "No other car" in part.idle_note
    assert not {measure.parameter for measure in part.measures} & set(part.idle)


def test_a_page_has_the_circuit_and_the_observation_of_its_training():
    settings = {"track": "ring", "course_points": 5, "curvature": True}
    domain = load_domain("racing_drift", {"env": settings})
    assert domain.make_web is not None
    part = domain.make_web(domain.make_space())
    assert part.physics["track"] == "ring"
    moved = domain.with_options({"track": "lakeside"})
    assert moved.make_web is not None and moved.make_web(domain.make_space()).physics["track"] == "lakeside"
    assert len(part.starts[0]["observation"]) == sum(group.width for group in domain.observation_groups)

"""Mistakes that people make when they bring a policy elsewhere are found in their environment, and named."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

from coachable.cli import main
from coachable.contract.exported_model import read_model
from coachable.domain import Domain, load_domain
from coachable.envs.humanoid.env import HumanoidEnv
from coachable.envs.humanoid.observation import OBSERVATION_GROUPS
from coachable.envs.racing.race.observation import own_columns
from coachable.export.diagnosis import CAUSES
from coachable.export.onnx import export, write_onnx
from coachable.export.verify import verify
from coachable.gym import GymnasiumEnv
from coachable.networks import make_gaussian_actor
from coachable.signals import Signal
from coachable.styles import StyleReward, StyleSpace, Weight, WeightedFeature
from coachable.training.weights import LoadedPolicy

pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")

ORDER, SCALE, RATE, ACTION_ORDER, ACTION_SCALE = CAUSES
VELOCITY = slice(40, 67)
SPACE = StyleSpace([Weight("effort", -1.0, 1.0)], name="pendulum")


def pendulum(gravity=10.0, dt=0.05, length=1.0, arrange=lambda o: o, force=lambda a: a, start=0):
    """Two pendulums in one environment, so that there is an order to get wrong; the second one is lighter."""

    class Pendulums(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-10.0, 10.0, (6,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.angle = self.np_random.uniform(-2.0, 2.0, 2) + start
            self.speed = self.np_random.uniform(-1.0, 1.0, 2)
            return self.seen(), {}

        def seen(self):
            rows = np.stack([np.cos(self.angle), np.sin(self.angle), self.speed / 8.0], 1)
            return arrange(rows.ravel().astype(np.float32))

        def step(self, action):
            for _ in range(round(dt / 0.005)):
                torque = force(np.asarray(action)) * np.array([6.0, 12.0])
                self.speed = self.speed + 0.005 * (gravity * np.sin(self.angle) / length + torque)
                self.angle = self.angle + 0.005 * self.speed
            return self.seen(), 0.0, False, False, {}

    return lambda num_envs=1, **_: GymnasiumEnv(Pendulums, lambda obs, action, info: obs[2:3], num_envs)


def pendulum_domain(**mistakes):
    entries = ("cosine", "sine", "speed")
    blocks = [Signal(f"{arm}_arm", 3, ("", "", "8 rad/s"), entries) for arm in ("left", "right")]
    return Domain(
        "pendulums",
        pendulum(**mistakes),
        lambda: SPACE,
        lambda space: StyleReward(space, {"effort": WeightedFeature("effort", 0)}),
        control_step=0.05,
        episode_steps=200,
        observation_groups=blocks,
        action_groups=[Signal("motors", 2, ("6 rad/s^2", "12 rad/s^2"), ("left", "right"))],
    )


@pytest.fixture(scope="module")
def pendulum_file(tmp_path_factory):
    torch.manual_seed(0)
    actor = make_gaussian_actor(6, 2, SPACE, widths=(16,)).eval()
    agent = LoadedPolicy(actor, SPACE, {}, {"domain": "pendulums", "source": "here", "frames": 0, "updates": 0})
    file = tmp_path_factory.mktemp("verify") / "pendulums.onnx"
    write_onnx(agent, pendulum_domain(), file)
    return file


@pytest.fixture(scope="module")
def humanoid_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("verify") / "humanoid.onnx"
    export("humanoid", file)
    return file


def swapped(observation):
    return observation[[3, 4, 5, 0, 1, 2]]


def faster(observation):
    return observation * np.array([1, 1, 8, 1, 1, 8], np.float32)


PENDULUM_MISTAKES = {
    "left and right are swapped": ({"arrange": swapped}, ORDER, "left_arm: cosine holds right_arm: cosine"),
    "speeds are in rad/s": ({"arrange": faster}, SCALE, "left_arm: speed: 8 times what was recorded"),
    "every second frame": ({"dt": 0.1}, RATE, "a step lasts 0.1 s instead of 0.05 s"),
    "50 Hz": ({"dt": 0.02}, RATE, "a step lasts 0.02 s instead of 0.05 s"),
    "motors are swapped": ({"force": lambda a: a[::-1]}, ACTION_ORDER, "motors: left acts as motors: right"),
    "motors are swapped with their gears": (
        {"force": lambda a: a[::-1] * [2, 0.5]},
        ACTION_ORDER,
        "motors: right acts as 2 times motors: left",
    ),
    "motors are weak": ({"force": lambda a: 0.5 * a}, ACTION_SCALE, "motors: about 0.5 times the effect"),
    "a motor is reversed": ({"force": lambda a: a * [1, -1]}, ACTION_SCALE, "motors: right: about -1 times"),
}


def causes(verdict):
    return {cause for cause in CAUSES for problem in verdict.problems if problem.startswith(f"wrong {cause}: ")}


def test_the_environment_of_the_export_agrees(pendulum_file, humanoid_file):
    for file, domain in ((pendulum_file, pendulum_domain()), (humanoid_file, None)):
        verdict = verify(file, domain)
        assert verdict.problems == ()
        assert "reproduces the 200 recorded actions" in verdict.checked[0]
        assert "reproduces the observations of" in verdict.checked[1]


@pytest.mark.parametrize("mistake", PENDULUM_MISTAKES)
def test_mistakes_are_named(mistake, pendulum_file):
    change, cause, sentence = PENDULUM_MISTAKES[mistake]
    verdict = verify(pendulum_file, pendulum_domain(**change))
    assert causes(verdict) == {cause}
    assert any(sentence in problem for problem in verdict.problems), verdict.problems
    assert verdict.problems[0].startswith("the environment differs: step ")


def test_two_mistakes_are_told_apart(pendulum_file):
    both = {"arrange": faster, "force": lambda a: 2.0 * a}
    assert causes(verify(pendulum_file, pendulum_domain(**both))) == {SCALE, ACTION_SCALE}


def test_what_has_no_known_cause_is_told_with_step_and_entry(pendulum_file):
    verdict = verify(pendulum_file, pendulum_domain(start=0.5))
    assert causes(verdict) == set()
    assert verdict.problems[0].startswith("the environment differs: step 0: ")
    assert "recorded was" in verdict.problems[0]


class Joints(HumanoidEnv):
    """The legs change places in the joint angles, and nowhere else."""

    def _observe(self, kinematics, rows):
        observation = super()._observe(kinematics, rows)
        return observation[:, [0, 1, 2, *range(9, 15), *range(3, 9), *range(15, 82)]]


class Velocities(HumanoidEnv):
    """Velocities that are not scaled."""

    def _observe(self, kinematics, rows):
        observation = super()._observe(kinematics, rows)
        observation[:, VELOCITY] *= 10.0
        return observation


class Torques(HumanoidEnv):
    """Motors of twice the torque."""

    def _step(self, tensordict):
        return super()._step(tensordict.set("action", 2.0 * tensordict["action"]))


class Motors(HumanoidEnv):
    """Motors in the order of the joints."""

    def _step(self, tensordict):
        order = [1, 0, *range(2, 7), 8, 7, *range(9, 13), 14, 13, *range(15, 21)]
        return super()._step(tensordict.set("action", tensordict["action"][:, order]))


class Frames(HumanoidEnv):
    """Two control steps instead of one."""

    def _step(self, tensordict):
        super()._step(tensordict)
        return super()._step(tensordict)


@pytest.mark.parametrize(
    ("env", "cause", "sentence"),
    [
        (Joints, ORDER, "joint_angles: right_hip_x holds joint_angles: left_hip_x"),
        (Velocities, SCALE, "all of velocity: 10 times what was recorded"),
        (Torques, ACTION_SCALE, "motors: about 2 times the effect"),
        (Motors, ACTION_ORDER, "motors: abdomen_y acts as motors: abdomen_z"),
        (Frames, RATE, "a step lasts 0.05 s instead of 0.025 s"),
    ],
)
def test_mistakes_with_the_humanoid_are_named(env, cause, sentence, humanoid_file):
    verdict = verify(humanoid_file, replace(load_domain("humanoid"), make_env=env))
    assert causes(verdict) == {cause}
    assert any(sentence in problem for problem in verdict.problems), verdict.problems


def racing_with(file, observe=lambda o: o, repeat=1):
    """Return the domain of a driver's file with a mistake in the observation, or with longer control steps."""
    domain = load_domain("racing_resources", {"env": read_model(file)[0].environment})

    def make_env(**options):
        env = domain.make_env(**options)
        step, reset = env._step, env._reset

        def seen(tensordict):
            return tensordict.set("observation", observe(tensordict["observation"].clone()))

        def longer_step(tensordict):
            for _ in range(repeat - 1):
                step(tensordict)
            return seen(step(tensordict))

        env._step, env._reset = longer_step, lambda *args, **kwargs: seen(reset(*args, **kwargs))
        return env

    return replace(domain, make_env=make_env)


def test_mistakes_with_racing_are_named(tmp_path):
    file = tmp_path / "racing.onnx"
    export("racing_resources", file)
    assert verify(file, racing_with(file)).problems == ()
    loads = own_columns("tyre_load")

    def rotated(observation):
        observation[:, loads] = observation[:, loads].roll(1, 1)
        return observation

    def metres_per_second(observation):
        observation[:, 0] *= 50.0
        return observation

    for mistake, cause, sentence in (
        ({"observe": rotated}, ORDER, "tyre_load: front_left holds tyre_load: rear_right"),
        ({"observe": metres_per_second}, SCALE, "motion: forward_speed: 50 times what was recorded"),
        ({"repeat": 2}, RATE, "a step lasts 0.2 s instead of 0.1 s"),
    ):
        verdict = verify(file, racing_with(file, **mistake))
        assert causes(verdict) == {cause}
        assert any(sentence in problem for problem in verdict.problems), verdict.problems


def test_wrong_declarations_are_named(humanoid_file, pendulum_file):
    domain = load_domain("humanoid")
    (problem,) = verify(humanoid_file, replace(domain, control_step=0.02)).problems
    assert problem == "wrong control rate: a step of humanoid lasts 0.02 s, expected 0.025 s"
    angles, *others = OBSERVATION_GROUPS
    exchanged = replace(domain, observation_groups=(*others, angles))
    (problem,) = verify(humanoid_file, exchanged).problems
    assert "wrong order of the observation: block 1 is 'head_height' with 1 entries, expected 'joint_angles'" in problem
    degrees = replace(domain, observation_groups=(replace(angles, unit="deg"), *others))
    (problem,) = verify(humanoid_file, degrees).problems
    assert "1 of joint_angles: abdomen_z stands for 'deg', expected 'rad'" in problem
    backwards = replace(domain, observation_groups=(replace(angles, entries=angles.entries[::-1]), *others))
    (problem,) = verify(humanoid_file, backwards).problems
    assert "entry 1 of joint_angles is 'joint_angles: left_elbow', expected 'joint_angles: abdomen_z'" in problem
    other = replace(pendulum_domain(), observation_groups=(), action_groups=())
    other = replace(other, make_space=lambda: StyleSpace([Weight("calm", 0, 1)]))
    assert verify(pendulum_file, other).problems == ("pendulums has the styles calm: expected effort",)


def test_another_graph_is_noticed(pendulum_file, tmp_path):
    """The weights changed, the contract did not."""
    import onnx

    model = onnx.load(pendulum_file)
    for tensor in model.graph.initializer:
        if "bias" in tensor.name:
            tensor.CopyFrom(onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(tensor) + 0.3, tensor.name))
    changed = tmp_path / "changed.onnx"
    onnx.save(model, changed)
    (problem,) = verify(changed, pendulum_domain()).problems
    assert problem.startswith("the graph gives other actions: step 0, motors: ")


def test_the_command(humanoid_file, pendulum_file, capsys, monkeypatch):
    assert main(["verify", str(humanoid_file)]) == 0
    assert "the environment of humanoid reproduces" in capsys.readouterr().out
    assert main(["verify", str(pendulum_file)]) == 0
    assert "no installed package has the domain 'pendulums'" in capsys.readouterr().out
    assert main(["verify", str(pendulum_file), "--domain", "humanoid"]) == 1
    assert "humanoid has the styles pose, step_length: expected effort" in capsys.readouterr().err
    monkeypatch.setattr("coachable.domain.load_domain", lambda *_: pendulum_domain(dt=0.1))
    monkeypatch.setattr("coachable.export.verify.load_domain", lambda *_: pendulum_domain(dt=0.1))
    assert main(["verify", str(pendulum_file), "--domain", "mine"]) == 1
    assert "wrong control rate" in capsys.readouterr().err


def test_the_recording_covers_styles_and_every_entry_of_the_action(humanoid_file):
    contract, policy = read_model(humanoid_file)
    recorded = contract.recorded
    assert recorded is not None
    assert recorded.action.shape == (200, 21) and len(np.unique(recorded.style, axis=0)) > 2
    np.testing.assert_array_equal(recorded.probe_action, 0.25 * np.eye(21, dtype=np.float32))
    np.testing.assert_array_equal(policy.act(recorded.observation[:1], recorded.style[:1]), recorded.action[:1])

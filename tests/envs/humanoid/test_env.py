"""`HumanoidEnv` as a TorchRL environment, and the properties that dm_control asks of every task."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from coachable.domains.humanoid import gait_style_space, humanoid_style_reward, humanoid_style_space
from coachable.envs.humanoid import HumanoidEnv
from coachable.envs.humanoid.features import BEARING, SPEED
from coachable.envs.humanoid.model import CONTROL_STEP, JOINTS, MOTORS, build_model
from coachable.envs.humanoid.observation import OBSERVATION_GROUPS, suite_observation
from coachable.transforms import TaskImpersonation, coachable_env
from tests.envs.contract import assert_set_seed_restarts_the_stream, roll


def make_env(num_envs=3, seed=0, **options):
    return HumanoidEnv(num_envs=num_envs, seed=seed, num_threads=1, **options)


def actions(env, steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(steps, env.num_envs, 21, generator=generator) * 2 - 1


@pytest.mark.parametrize("styled_speed", [False, True])
def test_specs_hold(styled_speed):
    check_env_specs(make_env(styled_speed=styled_speed), seed=0)


def test_observations_are_finite_and_none_is_constant():
    env = make_env(num_envs=8)
    seen = roll(env, actions(env, 60))["observation"].reshape(-1, 82)
    assert torch.isfinite(seen).all()
    assert (seen.std(0) > 0).all()
    assert seen.abs().max() < 30  # scaled: joint speeds reach tens of rad/s


def test_the_same_seed_gives_the_same_episodes_and_another_does_not():
    runs = [roll(make_env(seed=seed), actions(make_env(), 20))["observation"] for seed in (1, 1, 2)]
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0][0], runs[2][0])


def test_set_seed_restarts_the_stream():
    assert_set_seed_restarts_the_stream(make_env)


def test_batched_step_equals_stepping_alone():
    env = make_env(num_envs=4)
    together = roll(env, actions(env, 30))["observation"]
    start = make_env(num_envs=4)
    start.reset()
    states = start.simulator_state()
    for row in range(4):
        alone = make_env(num_envs=1)
        alone.reset()
        state = {k: v[row : row + 1] if isinstance(v, torch.Tensor) else v for k, v in states.items()}
        alone.load_simulator_state(state)
        seen, current = [], TensorDict({}, [1])
        for action in actions(env, 30):
            current = alone.step(current.set("action", action[row : row + 1]))["next"]
            seen.append(current["observation"].clone())
        torch.testing.assert_close(torch.stack(seen)[:, 0], together[:, row], rtol=0, atol=0)


def test_partial_reset_touches_nothing_else():
    env = make_env()
    roll(env, actions(env, 5))
    before = {name: value.clone() for name, value in env.simulator_state().items() if isinstance(value, torch.Tensor)}
    mask = torch.tensor([[False], [True], [False]])
    env.reset(TensorDict({"_reset": mask}, [3]))
    after = env.simulator_state()
    for name, value in before.items():
        assert torch.equal(after[name][[0, 2]], value[[0, 2]]), name
    assert after["steps"].tolist() == [5, 0, 5]


def test_outputs_do_not_share_memory_with_the_env():
    env = make_env()
    current = env.reset()
    kept = current["observation"]
    copy = kept.clone()
    env.step(current.set("action", torch.zeros(3, 21)))
    assert torch.equal(kept, copy)


def test_episodes_start_upright_with_the_feet_on_the_ground_and_random_arms():
    env = make_env(num_envs=64)
    env.reset()
    kinematics = env.simulation.kinematics()
    np.testing.assert_allclose(kinematics.head_height, 1.4755, atol=1e-3)
    np.testing.assert_allclose(kinematics.foot_clearance.min(axis=1), 0.0, atol=1e-9)
    positions = env.simulation.positions
    others = np.setdiff1d(np.arange(7, 28), env.simulation.model.arm_positions)
    assert (positions[:, others] == 0).all()
    assert (positions[:, env.simulation.model.arm_positions].std(axis=0) > 0.2).all()
    heading = 2 * np.arctan2(positions[:, 6], positions[:, 3])
    assert np.abs(heading).max() <= 0.3
    assert set(env.gait.expected) == {0, 1}


def test_episodes_start_with_a_speed_along_the_course():
    env = make_env(num_envs=200, start_speed=0.8)
    env.steer(np.pi / 2)
    env.reset()
    speeds = env.simulation.velocities[:, :3]
    assert np.allclose(speeds[:, [0, 2]], 0, atol=1e-12)
    assert speeds[:, 1].min() >= 0 and speeds[:, 1].max() <= 0.8
    assert speeds[:, 1].mean() == pytest.approx(0.4, abs=5 * 0.8 / np.sqrt(12 * 200))
    assert not env.simulation.velocities[:, 3:].any()


def test_no_arm_touches_the_body_at_the_start():
    env = make_env(num_envs=1)
    state = env.simulation.state[0].copy()
    state[3] += 1.0  # above the floor, so that only contacts of the body with itself count
    assert len(env._postures) == 512
    for posture in env._postures[::8]:
        state[1 + env.simulation.model.arm_positions] = posture
        assert env.simulation.count_contacts(state) == 0


def test_a_fall_terminates_and_time_truncates():
    env = make_env(num_envs=1)
    current = env.reset()
    for _ in range(200):
        current = env.step(current.set("action", torch.zeros(1, 21)))["next"]
        if current["terminated"].item():
            break
    assert current["terminated"].item() and current["done"].item()
    assert not current["truncated"].item()
    assert env.simulation.kinematics().head_height[0] < 1.1
    short = make_env(num_envs=1, episode_steps=3)
    current = short.reset()
    for _ in range(3):
        current = short.step(current.set("action", torch.zeros(1, 21)))["next"]
        assert current["done"].item() == current["truncated"].item()
    assert current["truncated"].item()
    assert not current["terminated"].item()


def test_standing_still_terminates_where_a_timeout_ends_the_episode():
    env, free = make_env(step_max=0.1, end_at_timeout=True), make_env(step_max=0.1)
    zeros = torch.zeros(3, 21)
    data = env.reset()
    limit = round(0.1 / CONTROL_STEP)
    for step in range(1, limit + 2):
        data = env.step(data.set("action", zeros))["next"]
        assert data["terminated"].all().item() is (step > limit)
    assert not data["truncated"].any()
    data = free.reset()
    for _ in range(limit + 1):
        data = free.step(data.set("action", zeros))["next"]
    assert not data["done"].any()


def test_exploding_physics_ends_the_episode_without_a_non_finite_number():
    env = make_env()
    current = env.reset()
    env.simulation.velocities[1, 5] = 1e12
    after = env.step(current.set("action", torch.zeros(3, 21)))["next"]
    assert after["terminated"].flatten().tolist() == [False, True, False]
    assert torch.isfinite(after["style_features"]).all()
    assert torch.isfinite(after["task_reward"]).all()


def test_the_walker_sees_the_course_not_the_compass():
    """Turning body and course together by any angle leaves every observation and reward as it was."""
    base, turned = make_env(num_envs=2), make_env(num_envs=2)
    angle = 1.1
    for env in (base, turned):
        env.set_seed(3)
    turned.steer(angle)
    first, second = base.reset(), turned.reset()
    torch.testing.assert_close(first["observation"], second["observation"], rtol=0, atol=1e-5)
    for action in actions(base, 10):
        first = base.step(first.set("action", action))["next"]
        second = turned.step(second.set("action", action))["next"]
    for key in ("observation", "task_reward", "style_features"):
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=1e-3)


def test_saved_state_continues_exactly():
    env, other = make_env(), make_env(seed=9)
    sequence = actions(env, 12)
    roll(env, sequence[:6])
    other.reset()
    other.load_simulator_state(env.simulator_state())
    for action in sequence[6:]:
        a = env.step(TensorDict({"action": action}, [3]))["next"]
        b = other.step(TensorDict({"action": action}, [3]))["next"]
        for key in ("observation", "reward", "style_features", "done"):
            assert torch.equal(a[key], b[key])
    assert torch.equal(env.reset()["observation"], other.reset()["observation"])


def test_state_of_another_size_is_refused():
    with pytest.raises(ValueError, match="state of 3 envs given, this env has 2"):
        make_env(num_envs=2).load_simulator_state(make_env(num_envs=3).simulator_state())


def test_a_diverged_policy_is_named():
    env = make_env()
    with pytest.raises(ValueError, match="action contains NaN"):
        env.step(env.reset().set("action", torch.full((3, 21), torch.nan)))
    with pytest.raises(ValueError, match=r"action has the shape \(3, 1\): expected \(3, 21\)"):
        env.step(env.reset().set("action", torch.zeros(3, 1)))


@pytest.mark.parametrize(
    "options",
    [
        {"num_envs": 0},
        {"step_max": 0.0},
        {"start_speed": -0.1},
        {"costs": {"powr": 1.0}},
        {"costs": {"power": -1.0}},
        {"push_force": -1.0},
        {"push_interval": 0.0},
        {"push_share": 1.5},
    ],
)
def test_bad_arguments_are_refused(options):
    with pytest.raises(ValueError, match=r"must be|expected|powr"):
        HumanoidEnv(**{"num_threads": 1, **options})


def test_reward_is_task_plus_style_under_the_style_that_the_policy_saw():
    space = humanoid_style_space()
    reward = humanoid_style_reward(space)
    env = coachable_env(make_env(num_envs=5), space, reward, seed=0)
    data = env.rollout(40, break_when_any_done=False)
    expected = data["next", "task_reward"] + reward(data["next", "style_features"], data["style"])
    assert torch.equal(data["next", "reward"], expected)


def test_a_styled_speed_changes_the_task_reward_and_adds_two_features():
    plain, styled = make_env(), make_env(styled_speed=True, costs={"power": 0.5})
    first, second = plain.reset(), styled.reset()
    for action in actions(plain, 5):
        first = plain.step(first.set("action", action))["next"]
        second = styled.step(second.set("action", action))["next"]
        assert torch.equal(first["observation"], second["observation"])
        features = second["style_features"]
        assert features.shape == (3, 15) and torch.equal(first["style_features"], features[:, :13])
        speed = second["observation"][:, 37]  # along the course
        torch.testing.assert_close(features[:, SPEED], speed)
        moving = (1 - (1 - speed).clamp(min=0)).clamp(min=-1)  # none is faster than 1.2 m/s
        torch.testing.assert_close(first["task_reward"][:, 0], moving * features[:, BEARING])
        cost = 0.5 * torch.from_numpy(styled.simulation.power()).clamp(max=3000).float() / 1000
        torch.testing.assert_close(second["task_reward"][:, 0], features[:, BEARING] - cost)


def test_another_speed_is_relabelled_without_the_simulator():
    space = gait_style_space()
    reward = humanoid_style_reward(space)
    env = coachable_env(make_env(num_envs=5, styled_speed=True), space, reward, seed=0)
    data = env.rollout(40, break_when_any_done=False).reshape(-1)
    relabelled = TaskImpersonation(reward, n=2)(data)
    assert torch.equal(relabelled["next", "reward"][:, 0], data["next", "reward"])
    expected = data["next", "task_reward"] + reward(data["next", "style_features"], relabelled["style"][:, 2])
    assert torch.equal(relabelled["next", "reward"][:, 2], expected)


def test_only_speeds_of_joints_are_scaled():
    """The suite's 67 numbers, of which the last 27 are speeds in tenths, the pelvis and the gait."""
    env = make_env(num_envs=2)
    seen = roll(env, actions(env, 3))["observation"][-1].numpy()
    simulation, kinematics = env.simulation, env.simulation.kinematics()
    suite = suite_observation(simulation.positions, simulation.velocities, kinematics, env.course)
    np.testing.assert_allclose(seen[:, :40], suite[:, :40], atol=1e-6)
    np.testing.assert_allclose(seen[:, 40:67], 0.1 * simulation.velocities, atol=1e-6)
    np.testing.assert_allclose(seen[:, 67:71], kinematics.pelvis_quaternion, atol=1e-6)
    np.testing.assert_allclose(seen[:, 71:], env.gait.observe(env.course), atol=1e-6)
    assert sum(group.width for group in OBSERVATION_GROUPS) == 82


def test_directions_turn_with_the_course():
    """As if the walkers had been turned instead: a course to the left lets everything point to the right."""
    env = make_env(num_envs=4)
    roll(env, actions(env, 40))
    before = env._observe(env.simulation.kinematics(), np.arange(4))
    env.steer(np.pi / 2)
    after = env._observe(env.simulation.kinematics(), np.arange(4))
    for start in (77, 79):  # of the step and of the stride
        assert np.abs(before[:, start : start + 2]).max() > 0.1
        np.testing.assert_allclose(after[:, start], before[:, start + 1], atol=1e-6)
        np.testing.assert_allclose(after[:, start + 1], -before[:, start], atol=1e-6)


def test_joints_and_motors_have_the_names_of_the_model():
    model = build_model().dynamics
    assert [model.joint(i).name for i in range(1, model.njnt)] == list(JOINTS)
    motors = {model.actuator(i).name: gear for i, gear in enumerate(model.actuator_gear[:, 0])}
    assert list(motors.items()) == list(MOTORS.items())


def test_threads_share_the_physics_and_change_no_number():
    """One thread is the caller's own, so that there is no pool to wake."""
    one, two = (HumanoidEnv(num_envs=3, num_threads=n, seed=0) for n in (1, 2))
    assert (one.simulation.num_threads, two.simulation.num_threads) == (0, 2)
    assert torch.equal(*(roll(env, actions(env, 3))["observation"] for env in (one, two)))
    two.close()


def test_forces_under_the_feet_of_a_standing_humanoid_add_up_to_its_weight():
    env = make_env(num_envs=1)
    current = env.reset()
    sums = []
    for _ in range(8):  # it begins to fall later
        current = env.step(current.set("action", torch.zeros(1, 21)))["next"]
        sums.append(env.simulation._forces.sum(axis=-1).mean() / env.simulation.model.weight)
    assert np.mean(sums) == pytest.approx(1.0, abs=0.15)
    assert env.simulation.model.weight == pytest.approx(40.844 * 9.81, rel=1e-3)


def test_power_is_torque_times_speed():
    """One joint turns at a known speed under a known command, whichever the order of motors and joints."""
    env = make_env(num_envs=1)
    simulation = env.simulation
    model = simulation.model.dynamics
    motor, joint = "right_ankle_x", "right_ankle_x"  # in the motors before, in the joints after the other ankle
    index = [model.actuator(i).name for i in range(model.nu)].index(motor)
    simulation._states_out[:] = 0.0
    simulation._states_out[..., 1 + 28 + int(model.joint(joint).dofadr[0])] = -3.0
    simulation._controls[:] = 0.0
    simulation._controls[..., index] = 0.5
    assert simulation.power()[0] == pytest.approx(0.5 * model.actuator_gear[index, 0] * 3.0)


def test_costs_are_taken_off_the_task_reward_and_change_nothing_else():
    weights = {"power": 0.5, "clearance": 2.0}
    plain, costly = make_env(), make_env(costs=weights)
    first, second = plain.reset(), costly.reset()
    for action in actions(plain, 5):
        first = plain.step(first.set("action", action))["next"]
        second = costly.step(second.set("action", action))["next"]
    for key in ("observation", "style_features", "walk"):
        assert torch.equal(first[key], second[key])
    clearance = plain.simulation.kinematics().foot_clearance.max(axis=1)
    lost = 0.5 * np.minimum(plain.simulation.power() / 1000, 3.0) + 2.0 * np.clip((clearance - 0.06) / 0.15, 0, 3)
    np.testing.assert_allclose((first["task_reward"] - second["task_reward"])[:, 0], lost, rtol=1e-4)


def test_a_push_moves_the_body_by_its_impulse_and_ends():
    still, pushed = make_env(num_envs=2), make_env(num_envs=2)
    for env in (still, pushed):
        env.reset()
    pushed.push_torso(np.array([[0.0, 0.0, 0.0], [0.0, 60.0, 0.0]]))
    zero = TensorDict({"action": torch.zeros(2, 21)}, [2])
    for _ in range(8):  # 0.2 s
        still.step(zero.clone())
        pushed.step(zero.clone())
    gained = pushed.simulation.kinematics().com_velocity - still.simulation.kinematics().com_velocity
    assert (gained[0] == 0).all()
    impulse = 60.0 * 0.2 / 40.844  # [m/s]; the floor adds and takes some
    assert 0.3 * impulse < gained[1, 1] < 1.2 * impulse
    assert abs(gained[1, 0]) < 0.1 * impulse
    assert (pushed._push_left == 0).all()
    assert (pushed._pushes() == 0).all()


def test_random_pushes_come_as_often_and_as_hard_as_asked():
    env = make_env(num_envs=200, push_force=100.0, push_interval=0.5)
    env.reset()
    forces = np.stack([env._pushes() for _ in range(400)])  # 10 s
    sizes = np.linalg.norm(forces, axis=-1)
    assert (forces[..., 2] == 0).all() and 99.0 < sizes.max() <= 100.0
    begins = ((sizes[1:] > 0) & (sizes[:-1] != sizes[1:])).sum()
    assert begins / 200 == pytest.approx(10 / (0.5 + 0.2), rel=0.05)  # none begins while one lasts
    assert np.abs(forces.mean(axis=(0, 1))).max() < 2.0  # from every side


def test_random_pushes_are_in_a_share_of_the_environments():
    env = make_env(num_envs=10, push_force=100.0, push_interval=0.5, push_share=0.3)
    env.reset()
    pushed = np.any([env._pushes() != 0 for _ in range(400)], axis=(0, 2))
    assert pushed.tolist() == [True] * 3 + [False] * 7


def test_regular_pushes_have_the_full_force_at_equal_intervals():
    env = make_env(num_envs=50, push_force=100.0, push_interval=0.5, push_share=0.2, regular_pushes=True)
    env.reset()
    forces = []
    for _ in range(60):  # 1.5 s
        forces.append(env._pushes())
        env.steps += 1
    sizes = np.linalg.norm(forces, axis=-1)
    pushed = (np.arange(60) % 20 < 8) & (np.arange(60) >= 20)  # each for 0.2 s, the first after 0.5 s
    np.testing.assert_allclose(sizes, np.where(pushed, 100.0, 0.0)[:, None].repeat(50, 1))
    angles = np.arctan2(forces[20][:, 1], forces[20][:, 0])
    assert angles.std() > 1.0  # from every side


def test_pushes_continue_exactly_from_a_saved_state():
    env, other = make_env(push_force=80.0, push_interval=0.1), make_env(seed=9, push_force=80.0, push_interval=0.1)
    roll(env, actions(env, 6))
    other.reset()
    other.load_simulator_state(env.simulator_state())
    assert (env._push_left > 0).any()
    for action in actions(env, 6, seed=1):
        a = env.step(TensorDict({"action": action}, [3]))["next"]
        b = other.step(TensorDict({"action": action}, [3]))["next"]
        assert torch.equal(a["observation"], b["observation"])

"""`CombatEnv` as a TorchRL environment, and what must hold in every fight."""

from dataclasses import fields

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from coachable.domains.combat import combat_style_reward, combat_style_space
from coachable.envs.combat import CombatEnv
from coachable.envs.combat.features import observation_groups, observation_size
from coachable.envs.combat.fight import run_step
from coachable.envs.combat.gamepad import canonical_rows
from coachable.envs.combat.rewards import COMPONENT_SLICES
from coachable.envs.combat.state import State
from coachable.envs.combat.step_frames import Noise
from coachable.envs.combat.tables import MACHINES, STYLES
from coachable.styles.mixtures import style_mixture
from coachable.transforms import coachable_env
from tests.envs.contract import assert_set_seed_restarts_the_stream, roll


def make_env(num_envs=3, seed=0, **options):
    return CombatEnv(num_envs=num_envs, seed=seed, **options)


def actions(env, steps, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return env.action_spec.rand((steps,))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"observation": "small", "traps": 0, "styles": ("melee", "skykiller"), "kill_event": True},
        {"num_enemies": 2, "machines": ["Sunwing", "Slaughterspine"], "components": True, "assist": "off"},
    ],
)
def test_specs_hold(options):
    check_env_specs(make_env(**options), seed=0)


def test_observation_sizes_are_the_designs():
    assert (observation_size("full"), observation_size("small")) == (629, 190)
    widths = {group.name: group.width for group in observation_groups("full")}
    assert widths["Active weapon + ammo"] == 21
    assert widths["Traps: pose + inventory"] == 52
    assert widths["Enemy parts pose"] + widths["Enemy parts health"] == 132
    assert len(widths) == len(observation_groups("full"))


def test_the_same_seed_gives_the_same_fights_and_another_does_not():
    sequence = actions(make_env(), 12)
    runs = [roll(make_env(seed=seed), sequence[:steps])["observation"] for seed, steps in ((1, 12), (1, 12), (2, 1))]
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0][0], runs[2][0])


def test_set_seed_restarts_the_stream():
    assert_set_seed_restarts_the_stream(make_env)


def test_batched_step_equals_stepping_alone():
    together = make_env(num_envs=3, seed=3)
    together.reset()
    alone = [make_env(num_envs=1) for _ in range(3)]
    states = together.simulator_state()
    for row, env in enumerate(alone):
        env.load_simulator_state({k: v[row : row + 1] if k != "random" else v for k, v in states.items()})
    for action in actions(together, 15):
        noise = Noise.draw(1, 3, together._random)
        for row, env in enumerate([*alone, together]):
            rows = slice(None) if env is together else slice(row, row + 1)
            pad = canonical_rows(action.T[:, rows].contiguous())
            own = Noise(*(getattr(noise, field.name)[..., rows] for field in fields(noise)))
            run_step(env.state, pad, env.rules, own, env._ammo, env._sections)
    for name, value in together.state.tensors().items():
        for row, env in enumerate(alone):
            theirs = env.state.tensors()[name][..., 0]
            torch.testing.assert_close(theirs, value[..., row], rtol=1e-4, atol=1e-3, msg=name)


def test_partial_reset_touches_nothing_else_and_leaks_nothing():
    env = make_env()
    roll(env, actions(env, 12))
    before = {name: value.clone() for name, value in env.simulator_state().items() if name != "random"}
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    after = env.simulator_state()
    for name, value in before.items():
        assert torch.equal(after[name][[0, 2]], value[[0, 2]]), name
    assert after["steps"].tolist() == [12, 0, 12]
    # All that is not drawn is as in an env that has never been stepped.
    drawn = {"position", "yaw", "weapon", "magazine", "anchor", "distance", "site", "machine", "count", "part_hp"}
    drawn |= {"cooldown", "pause", "strafe"} | {n for n in after if n.startswith("enemy_")}
    new = make_env(seed=9).simulator_state()
    for name in set(before) - drawn:
        assert torch.equal(after[name][1], new[name][1]), name
    # The first difference of a fight starts from its own state.
    still = torch.zeros(3, 24)
    still[:, [0, 4, 10, 13, 16, 18]] = 1.0
    env.emit_components = True
    first = env._step(TensorDict({"action": still}, [3]))["components"][1]
    for name in ("lure", "proximity", "ammo_change", "smoothness"):
        assert (first[COMPONENT_SLICES[name]] == 0).all(), name


def test_the_scenario_of_a_fight_is_its_machine():
    env = make_env(num_envs=40, machines=["Ravager", "Scrounger", "Ravager"])
    assert env.scenario_names == ("Ravager", "Scrounger")
    numbers = env.reset()["scenario"]
    assert [list(MACHINES)[i] for i in env.state.machine[0]] == [env.scenario_names[i] for i in numbers.flatten()]
    assert set(numbers.flatten().tolist()) == {0, 1}
    assert torch.equal(env.rand_step()["next", "scenario"], numbers)
    env.assign(["Scrounger", "Longleg"] * 20, ["Ice-lake"] * 40)
    assert env.reset()["scenario"].flatten().tolist() == [1, -1] * 20


def test_outputs_do_not_share_memory_with_the_env():
    env = make_env()
    current = env.reset()
    kept = {key: current[key] for key in ("observation", "style_features")}
    copies = {key: value.clone() for key, value in kept.items()}
    env.step(current.set("action", actions(env, 1)[0]))
    for key, value in kept.items():
        assert torch.equal(value, copies[key])


def test_saved_state_continues_exactly():
    env, other = make_env(num_enemies=2), make_env(seed=9, num_enemies=2)
    sequence = actions(env, 12)
    roll(env, sequence[:6])
    other.load_simulator_state(env.simulator_state())
    for action in sequence[6:]:
        a = env.step(TensorDict({"action": action}, [3]))["next"]
        b = other.step(TensorDict({"action": action}, [3]))["next"]
        for key in ("observation", "reward", "style_features", "events", "done"):
            assert torch.equal(a[key], b[key])
    assert torch.equal(env.reset()["observation"], other.reset()["observation"])


def test_state_of_another_size_is_refused():
    with pytest.raises(ValueError, match="state of 3 envs with 1 enemies given, this env has 2 with 1"):
        make_env(num_envs=2).load_simulator_state(make_env().simulator_state())


def test_time_truncates():
    env = make_env(episode_steps=3, machines=["Specter Prime"])
    data = env.rollout(3, break_when_any_done=False)
    assert data["next", "truncated"][:, -1].all()
    assert not data["next", "done"][:, :-1].any()
    assert not data["next", "terminated"].any()


def test_scenarios_can_be_assigned():
    env = make_env()
    env.assign(["Burrower", "Sunwing", "Slaughterspine"], ["Arena", "Ice-lake", "Arena"])
    env.reset()
    assert env.traits.hp[0].tolist() == [95, 1600, 7500]
    assert env.state.site.tolist() == [2, 0, 2]
    assert env.state.enemy_z[0].tolist() == [0, 6, 0]
    with pytest.raises(ValueError, match="expected 3 of each"):
        env.assign(["Burrower"], ["Arena"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0: expected a whole number of at least 1"),
        ({"num_enemies": 3}, "num_enemies is 3: expected a whole number in"),
        ({"machines": ["Scrounger", "Toaster"]}, "machines are .*Toaster"),
        ({"machines": []}, "expected a list of at least one"),
        ({"sites": ["Moon"]}, "sites are .*Moon"),
        ({"styles": ["lazy"]}, "styles are .*lazy"),
        ({"styles": "melee"}, "styles are 'melee': expected a list of distinct ones"),
        ({"observation": "pixels"}, "observation is 'pixels'"),
        ({"reward_scale": "huge"}, "reward_scale is 'huge'"),
        ({"assist": "max"}, "assist is 'max'"),
    ],
)
def test_bad_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_env(**options)


def test_a_diverged_policy_is_named():
    env = make_env()
    with pytest.raises(ValueError, match="action contains NaN"):
        env.step(env.reset().set("action", torch.full((3, 24), torch.nan)))
    with pytest.raises(ValueError, match=r"action has the shape \(3, 1\): expected \(3, 24\)"):
        env.step(env.reset().set("action", torch.zeros(3, 1)))


def check_invariants(env: CombatEnv, before: State, transition: TensorDict) -> None:
    """What holds in every fight after every step."""
    s, after = env.state, transition["next"]
    parts = {name: after["components"][:, piece] for name, piece in COMPONENT_SLICES.items()}
    for key in ("observation", "task_reward", "style_features", "components"):
        assert torch.isfinite(after[key]).all(), key
    assert after["observation"].abs().max() <= 2.0
    for value, high in ((s.hp, 700.0), (s.stamina, 100.0), (s.weapon_stamina, 100.0), (s.berries, 14.0)):
        assert (value >= 0).all()
        assert (value <= high).all()
    assert (s.enemy_hp >= 0).all()
    assert (s.enemy_hp <= env.traits.hp).all()
    assert (s.count >= 0).all()
    assert (s.gauge >= 0).all()
    assert (s.gauge < 1).all()
    assert (s.inventory >= 0).all()
    lost = (before.enemy_hp - s.enemy_hp).sum(0)
    tolerance = {"rtol": 1e-4, "atol": 1e-2}
    torch.testing.assert_close(parts["damage"][:, 0], lost, **tolerance)
    by_source = parts["weapon_damage"].sum(1) + parts["melee_damage"][:, 0] + parts["trap_damage"][:, 0]
    torch.testing.assert_close(by_source, parts["damage"][:, 0], **tolerance)
    assert (parts["state_damage"] <= parts["damage"] + 1e-2).all()
    removed = (before.count - s.count).sum((0, 1))
    torch.testing.assert_close(parts["removals"].sum(1), removed)
    gap = (s.enemy_position - s.position.unsqueeze(1)).square().sum(0).sqrt() - env.traits.radius
    assert ((gap >= 0.5 - 1e-3) | (s.enemy_hp <= 0)).all()
    for name, low, high in (
        ("off_screen", 0, 1.8661),
        ("smoothness", 0, 5.657),
        ("ammo_change", -2, 2),
        ("lure", -1, 1),
        ("proximity", -1, 1),
        ("buildup", -0.1, 1),
    ):
        assert parts[name].min() >= low - 1e-5, name
        assert parts[name].max() <= high + 1e-5, name
    ended = (s.enemy_hp <= 0).all(0) | (s.hp <= 0) | (parts["out_of_bounds"][:, 0] > 0)
    assert torch.equal(after["terminated"][:, 0], ended)


def run_random(num_envs: int, steps: int, **options) -> None:
    env = make_env(num_envs=num_envs, components=True, episode_steps=40, **options)
    current = env.reset()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for _ in range(steps):
            before = State(**env.state.tensors())
            action = env.action_spec.rand()
            fought = env.step(current.set("action", action))
            check_invariants(env, before, fought)
            _, current = fought, env.maybe_reset(fought["next"].exclude("reward"))


@pytest.mark.parametrize("options", [{}, {"num_enemies": 2}, {"machines": ["Sunwing", "Burrower", "Lancehorn"]}])
def test_invariants_over_random_steps(options):
    run_random(num_envs=300, steps=24, **options)  # 21 600 steps in all


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"num_enemies": 2}])
def test_invariants_over_a_million_random_steps(options):
    run_random(num_envs=2048, steps=250, **options)


def test_the_reward_is_recomputed_exactly_for_any_style():
    space = combat_style_space()
    reward = combat_style_reward(space)
    env = coachable_env(make_env(num_envs=40), space, reward, seed=0)
    data = env.rollout(12, break_when_any_done=False)
    after = data["next"]
    assert torch.equal(after["reward"], after["task_reward"] + reward(after["style_features"], data["style"]))
    theta = space.sample((40, 12), torch.Generator().manual_seed(1))
    expected = torch.zeros(40, 12)
    for i in range(18):
        expected = expected + theta[..., i] * after["style_features"][..., i]
    assert torch.equal(reward(after["style_features"], theta)[..., 0], expected)


def test_the_style_changes_rewards_and_nothing_else():
    space = combat_style_space()
    runs = []
    for scale in (0.0, 1.0):
        env = coachable_env(make_env(num_envs=16), space, combat_style_reward(space), seed=0)
        env.hold_style(scale * space.high)
        sequence = actions(env.base_env, 12)
        current, seen = env.reset(), []
        for action in sequence:
            fought = env.step(current.set("action", action))
            seen.append(fought["next"].select("observation", "terminated", "events", "style_features", "task_reward"))
            current = fought["next"]
        runs.append(torch.stack(seen))
    for key in ("observation", "terminated", "events", "style_features", "task_reward"):
        assert torch.equal(runs[0][key], runs[1][key]), key


def test_styles_select_columns():
    everything, few = make_env(), make_env(styles=("skykiller", "melee"), kill_event=True)
    sequence = actions(everything, 12)
    for env in (everything, few):
        env.reset()
    for action in sequence:
        a, b = (env.step(TensorDict({"action": action}, [3]))["next"] for env in (everything, few))
        columns = [STYLES.index("skykiller"), STYLES.index("melee")]
        assert torch.equal(a["style_features"][:, columns], b["style_features"])
        assert torch.equal(a["events"][:, columns], b["events"][:, :2])
    assert b["events"].shape == (3, 3)


def test_the_papers_mixture():
    space = combat_style_space()
    theta = space.sample((20000,), torch.Generator().manual_seed(0))
    count = (theta != 0).sum(-1)
    for wanted, share in ((0, 0.03), (1, 0.87), (18, 0.10)):
        found = (count == wanted).float().mean().item()
        assert abs(found - share) < 5 * (share * (1 - share) / 20000) ** 0.5
    hot = style_mixture(space, "one_hot").sample((2000,), torch.Generator().manual_seed(0))
    single = (hot != 0).sum(-1) == 1
    assert ((hot[single] == 0) | (hot[single] == space.high)).all()
    independent = style_mixture(space, "independent").sample((2000,), torch.Generator().manual_seed(0))
    assert set((independent != 0).sum(-1).tolist()) == {0, 18}
    assert len(combat_style_space(styles=("melee", "skykiller")).names) == 2
    with pytest.raises(ValueError, match="reward_scale is 'real'"):
        combat_style_space(reward_scale="real")


def test_all_machines_and_sites_are_drawn():
    env = make_env(num_envs=2000)
    env.reset()
    assert len(env.state.machine.unique()) == len(MACHINES)
    assert len(env.state.site.unique()) == 3
    places = torch.cat([env.state.position, env.state.enemy_position[:, 0]], 1)
    assert places.square().sum(0).sqrt().max() <= 25.0 + 1e-4
    apart = (env.state.position - env.state.enemy_position[:, 0]).square().sum(0).sqrt()
    assert apart.min() >= 8.0 - 1e-4

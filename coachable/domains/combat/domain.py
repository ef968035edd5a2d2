"""Declaration of the combat domain."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from coachable.domain import Domain, Recorded
from coachable.domains.combat.fights import evaluate_fights
from coachable.domains.combat.metrics import CombatMeasures
from coachable.domains.combat.stage import CombatStage
from coachable.domains.combat.styles import combat_style_reward, combat_style_space, single_styles
from coachable.domains.combat.words import WORDS
from coachable.envs.combat.constants import CONTROL_STEP, EPISODE_STEPS
from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.features import observation_groups
from coachable.envs.combat.gamepad import ACTION_GROUPS
from coachable.envs.combat.tables import SITES, STYLES
from coachable.scene.renderer import SceneRenderer


def _make_combat_env(
    num_envs: int = 128, seed: int | None = None, num_threads: int | None = None, **options: Any
) -> CombatEnv:
    """Make a `CombatEnv` that emits `components` for the measures; torch's own threads are used, not `num_threads`."""
    return CombatEnv(num_envs, seed=seed, components=True, **options)


def _as_trained(settings: Mapping[str, Any]) -> Domain:
    """Return the domain with the machines, styles, observation and episode length of a training."""
    options = {name: value for name, value in settings.items() if name not in ("_target_", "num_envs", "components")}
    styles: Sequence[str] | None = settings.get("styles")
    scale = settings.get("reward_scale", "sim")
    make_space = partial(combat_style_space, styles, scale)
    machines: Sequence[str] = settings.get("machines") or ("Scrounger",)
    return replace(
        DOMAIN,
        recorded=replace(DOMAIN.recorded, alike=lambda _: {"machines": machines[-1:], "sites": SITES[-1:]}),
        make_env=partial(_make_combat_env, **options),
        make_space=make_space,
        measures=CombatMeasures(styles, scale),
        grid=single_styles(make_space()),
        episode_steps=settings.get("episode_steps", EPISODE_STEPS),
        observation_groups=observation_groups(settings.get("observation", "full")),
    )


DOMAIN = Domain(
    name="combat",
    make_env=_make_combat_env,
    make_space=combat_style_space,
    make_reward=combat_style_reward,
    measures=CombatMeasures(),
    make_renderer=partial(SceneRenderer, CombatStage),
    make_stage=CombatStage,
    window=20.0,
    grid=single_styles(combat_style_space()),
    control_step=CONTROL_STEP,
    episode_steps=EPISODE_STEPS,
    columns={"won": ".0%", "damage": ".0f", "style_score": ".2f"},
    units={"damage": "HP"} | {name: "HP" for name in STYLES if not name.startswith("part_")},
    observation_groups=observation_groups("full"),
    action_groups=ACTION_GROUPS,
    words=WORDS,
    as_trained=_as_trained,
    evaluation=evaluate_fights,
    recorded=Recorded(
        seconds=45.0,
        opens=1,
        title="A fighter who uses what you ask for",
        summary="Ask for a way to fight, and see how much of the damage it does.",
    ),
)

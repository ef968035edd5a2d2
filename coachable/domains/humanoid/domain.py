"""Declaration of the humanoid domain."""

from functools import partial

from coachable.domain import Domain
from coachable.domains.humanoid.metrics import HumanoidMeasures
from coachable.domains.humanoid.stage import HumanoidStage
from coachable.domains.humanoid.styles import POSES, humanoid_style_reward, humanoid_style_space
from coachable.domains.humanoid.web import humanoid_web
from coachable.domains.humanoid.words import COURSE, PUSH, WORDS
from coachable.envs.humanoid.env import EPISODE_STEPS, HumanoidEnv
from coachable.envs.humanoid.model import CONTROL_STEP
from coachable.envs.humanoid.observation import ACTION_GROUPS, OBSERVATION_GROUPS
from coachable.scene.renderer import SceneRenderer

DOMAIN = Domain(
    name="humanoid",
    make_env=HumanoidEnv,
    make_space=humanoid_style_space,
    make_reward=humanoid_style_reward,
    measures=HumanoidMeasures(),
    make_renderer=partial(SceneRenderer, HumanoidStage),
    make_stage=HumanoidStage,
    make_web=partial(humanoid_web, measures=HumanoidMeasures()),
    grid={"pose": POSES, "step_length": (0.30, 0.35, 0.40, 0.45, 0.50, 0.55, 0.60, 0.65)},
    control_step=CONTROL_STEP,
    episode_steps=EPISODE_STEPS,
    trials={f"pushes of {force:g} N": {"push_force": force, "regular_pushes": True} for force in (100.0, 150.0)},
    targets={"clearance": 0.15, "knee_asymmetry": 10.0, "strike_force": 3.0, "drift": 0.5, "power": 680.0},
    columns={
        "survived": ".0%",
        "forward_speed": ".2f",
        "pose_held": ".0%",
        "measured_step_length": ".3f",
        "step_length_error": ".3f",
        "power": ".0f",
        "strike_force": ".1f",
        "clearance": ".2f",
        "strike_pitch": ".0f",
        "swing_knee": ".0f",
        "knee_asymmetry": ".0f",
        "drift": ".2f",
    },
    units={
        "forward_speed": "m/s",
        "step_length_error": "m",
        "power": "W",
        "strike_force": "body weights",
        "clearance": "m",
        "strike_pitch": "deg",
        "swing_knee": "deg",
        "knee_asymmetry": "deg",
        "drift": "m",
    },
    controls=(COURSE,),
    push=PUSH,
    words=WORDS,
    observation_groups=OBSERVATION_GROUPS,
    action_groups=ACTION_GROUPS,
)

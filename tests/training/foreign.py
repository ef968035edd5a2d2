"""What opens the files of a training, and changes of their content."""

import torch
from recipe_config import build_checked, compose_config

from coachable.coach.session.session import CoachSession
from coachable.domains.humanoid import humanoid_style_space
from coachable.evaluation.evaluate import evaluate
from coachable.evaluation.report import report
from coachable.evaluation.video import render
from coachable.export.onnx import export
from coachable.training.weights import export_weights, initialise_from, load_policy

RECIPE = "rare_targets"
TINY = ["preset=smoke", "threads.learner=1", "threads.simulator=1", "train.eval_interval=0", "eval.max_steps=5"]
TINY += [
    "init_random_frames=8",
    "train.warmup_frames=8",
    "train.batch_size=18",
    "train.total_frames=40",
    "event_capacity=100",
]


def build(config):
    import rare_targets

    return build_checked(rare_targets.build, config)


def resume(run):
    return build(compose_config(RECIPE, [f"resume={run}", "train.total_frames=60"]))


def changed(file, change):
    state = torch.load(file, weights_only=True)
    change(state)
    torch.save(state, file)


def openers(out):
    """Every function that opens an agent, by the name of its command."""
    return {
        "load_policy": load_policy,
        "export": lambda source: export(source, out / "policy.onnx"),
        "weights": lambda source: export_weights(source, out / "weights.pt"),
        "evaluate": lambda source: evaluate(source, out / "evaluation", episodes=1, progress=False),
        "report": lambda source: report([source], out / "report", progress=False),
        "render": lambda source: render(source, out / "film.png"),
        "coach": CoachSession.open,
        "init_from": lambda source: initialise_from(
            source, torch.nn.Module(), torch.nn.Module(), humanoid_style_space()
        ),
    }


def put(config, place, value):
    *parents, last = place.split(".")
    for parent in parents:
        config = config[parent]
    config[last] = value

"""What an agent learns with workers on Ray, and with weights of another age, beside the training in one process.

    python benchmarks/cluster_learning.py                                  combat, preset small, seeds 0 to 2: hours
    python benchmarks/cluster_learning.py --env humanoid --only local workers            first stage of cpu
    python benchmarks/cluster_learning.py --frames 20_000 --seeds 0 --only local workers      to try it out

All trainings have the same env-steps and the same updates per env-step. `workers` are 8 on Ray with 16 environments
each, with default settings. `fresh` are the same with short batches that do not wait in the queue, and `every_1000` the
same with 1000 updates between two offers of weights, so that weights are younger or older than those of `workers`. A
training that was interrupted is continued by the same command, one that has ended is not repeated. At its end, an agent
is evaluated again in more episodes. The table is printed, and learning curves with intervals over the seeds are drawn
in `--out`.
"""

import argparse
import math
import statistics
import sys
from pathlib import Path

from coachable.evaluation.curves import draw_learning_curves, read_metric
from coachable.evaluation.many_seeds import train_seeds

RECIPES = Path(__file__).resolve().parent.parent / "recipes"
ENVIRONMENTS = {  # recipe, its settings, what is measured of the style, and the episodes of the last evaluation
    "combat": ("combat_cat_rac.py", ["preset=small"], "eval/style_score", 1000),
    "humanoid": ("humanoid_sac.py", ["preset=cpu", "stage=walk"], "eval/step_length_error", 100),
}
QUIET = ["wandb.mode=off", "threads.learner=1", "threads.simulator=1"]
WORKERS = ["collector=ray", "collector.num_collectors=8", "collector.group_size=8", "env.num_envs=16"]
WORKERS += ["collector.cpus_per_worker=0.1"]
VARIANTS = {
    "local": [],
    "fresh": [*WORKERS, "collector.steps_per_batch=2", "collector.queue_size=1"],
    "workers": WORKERS,
    "every_1000": [*WORKERS, "collector.weights_every=1000"],
}
HEADINGS = (
    "weights",
    "seeds",
    "return",
    "std",
    "style",
    "std",
    "staleness [updates]",
    "env-steps",
    "updates",
    "minutes",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENVIRONMENTS, default="combat", help="(%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="(%(default)s)")
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--frames", type=int, help="env-steps of each training; those of the preset")
    parser.add_argument("--out", type=Path, default=Path("runs/cluster_learning"))
    options = parser.parse_args()
    recipe, settings, style, episodes = ENVIRONMENTS[options.env]
    options.out /= options.env
    common = [*settings, *QUIET, "train.checkpoint_interval=300"]
    if options.frames:
        common += [f"train.total_frames={options.frames}", f"train.eval_interval={max(1, options.frames // 4)}"]
        common += [f"train.warmup_frames={min(30_000, options.frames // 10)}"]
    curves: dict[str, list[Path]] = {}
    print("| " + " | ".join(HEADINGS) + " |\n|" + "-|" * len(HEADINGS))
    for name in options.only:
        folder = options.out / name
        if failed := train_seeds(RECIPES / recipe, [*common, *VARIANTS[name]], options.seeds, folder):
            sys.exit(f"{name}: {failed}")
        runs = [folder / f"seed_{seed}" for seed in options.seeds]
        for run in runs:
            evaluate([*settings, *QUIET], recipe, run, episodes)
        print("| " + " | ".join([name, f"{len(runs)}", *cells(runs, VARIANTS[name], style)]) + " |", flush=True)
        curves[name] = runs
        draw_learning_curves(curves, options.out / "learning.png", x="frames", y="eval/return", smooth=1)


def evaluate(settings: list[str], recipe: str, run: Path, episodes: int) -> None:
    """Evaluate a run's agent, by a training that begins with it and ends after one round without updates."""
    arguments = [f"init_from={run}", "train.total_frames=1", "train.utd_ratio=0", f"eval.num_envs={episodes}"]
    if failed := train_seeds(RECIPES / recipe, [*settings, *arguments], [0], evaluation_of(run).parent):
        sys.exit(f"evaluation of {run}: {failed}")


def evaluation_of(run: Path) -> Path:
    return run.with_name(f"{run.name}_evaluated") / "seed_0"


def cells(runs: list[Path], arguments: list[str], style: str) -> list[str]:
    ends = [evaluation_of(run) for run in runs]
    measures = {name: [read_metric(run, "frames", name)[1][-1] for run in ends] for name in ("eval/return", style)}
    stale = [read_metric(run, "frames", "workers/staleness")[1].mean() for run in runs] if arguments else [0.0]
    counted = ("frames", "updates", "minutes")  # from the start of each stage; the first column sums them
    totals = {name: [read_metric(run, name, name)[0][-1] for run in runs] for name in counted}
    return [
        *(f"{of(values):.3g}" for values in measures.values() for of in (statistics.mean, spread)),
        f"{statistics.mean(stale):.0f}",
        *(f"{statistics.mean(totals[name]):.0f}" for name in ("frames", "updates")),
        f"{statistics.mean(totals['minutes']):.1f}",
    ]


def spread(values: list[float]) -> float:
    return statistics.stdev(values) if len(values) > 1 else math.nan


if __name__ == "__main__":
    main()

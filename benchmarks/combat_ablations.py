"""Trainings of the fighter with one thing changed: style score and wins, over seeds (paper, Appendix D).

python benchmarks/combat_ablations.py                                  trains what is missing, then draws
python benchmarks/combat_ablations.py --variants base sac --seeds 0    some of it; the figure has every finished run
python benchmarks/combat_ablations.py --seeds                          trains nothing, draws

A training that was interrupted is continued. Several commands with different seeds may run at the same time.
"""

import argparse
import gc
import logging
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

from combat_cat_rac import build
from recipe_config import compose_config

from coachable.domain import load_domain
from coachable.domains.combat.fights import damage_rows, fight_matrix, style_label
from coachable.domains.combat.styles import single_styles
from coachable.envs.combat.traits import MACHINE_NAMES
from coachable.evaluation.curves import read_metric, summarise_runs
from coachable.evaluation.statistics import bootstrap_interval
from coachable.evaluation.style_grid import write_csv
from coachable.training.checkpoint import CheckpointError, find_checkpoint, read_state
from coachable.training.rng import preserved_rng
from coachable.training.trainer import Trainer
from coachable.training.weights import LoadedPolicy

VARIANTS: dict[str, list[str]] = {
    "base": [],
    "sac": ["loss=sac_categorical"],
    "samples_1": ["entropy_samples=1"],
    "samples_1000": ["entropy_samples=1000"],
    "impersonation_0": ["impersonation.n=0"],
    "impersonation_2": ["impersonation.n=2"],
    "impersonation_4": ["impersonation.n=4"],
    "impersonation_8": ["impersonation.n=8"],
    "uniform": ["replay=uniform"],
    "one_hot": ["sampler=one_hot"],
    "independent": ["sampler=independent"],
    "unclipped": ["learner.max_grad_norm=null"],
}
LABELS = {
    "sac": "categorical SAC",
    "samples_1": "1 entropy sample",
    "samples_1000": "1000 entropy samples",
    "impersonation_0": "no impersonation",
    "impersonation_2": "2 further styles",
    "impersonation_4": "4 further styles",
    "impersonation_8": "8 further styles",
    "uniform": "uniform replay",
    "one_hot": "styles one-hot",
    "independent": "styles independent",
    "unclipped": "gradients not clipped",
}
PANELS = {
    "loss and its entropy samples": ("sac", "samples_1", "samples_1000"),
    "impersonation and replay": ("impersonation_0", "impersonation_2", "impersonation_4", "impersonation_8", "uniform"),
    "training styles": ("one_hot", "independent"),
    "gradients": ("unclipped",),
}
METRICS = {"eval/style_score": "style score", "eval/won": "fights won"}
EVALUATIONS = 8  # during a training
SEED = 10_000  # of the fights that evaluate: the same every time


def train(variant: str, seed: int, run_dir: Path, args: argparse.Namespace) -> None:
    """Train, or continue what was interrupted."""
    common = [f"threads.simulator={args.threads}", f"threads.learner={args.threads}"]
    try:
        state = read_state(find_checkpoint(run_dir))
        frames, wanted = state["loop"]["frames"], state["config"]["train"]["total_frames"]
        if args.frames is not None and wanted != args.frames:
            raise SystemExit(f"{run_dir} is a training of {wanted} env-steps, --frames asks for {args.frames}")
        if frames >= wanted:
            return
        config = compose_config("combat_cat_rac", [f"resume={run_dir}", *common])
    except CheckpointError:
        overrides = [f"preset={args.preset}", f"seed={seed}", f"run_dir={run_dir}", *VARIANTS[variant], *common]
        overrides += [] if args.frames is None else [f"train.total_frames={args.frames}"]
        config = compose_config("combat_cat_rac", overrides)
        config["train"]["eval_interval"] = max(1, config["train"]["total_frames"] // EVALUATIONS)
    if config["stages"]:
        raise SystemExit(f"preset {args.preset} has stages: expected one without, such as small or middle")
    training = build(config)
    training.evaluate = evaluation(training, config, args.episodes)
    training.run()
    if training.frames < config["train"]["total_frames"]:
        raise SystemExit(f"{run_dir} was stopped after {training.frames} env-steps; the same command continues it")
    for replay in (run_dir / "checkpoints").glob("*/replay"):  # more than a gigabyte, of use only to go on training
        shutil.rmtree(replay)


def evaluation(training: Trainer, config: dict[str, Any], episodes: int) -> Callable[[], Mapping[str, float]]:
    """Style scores and wins, by style, as `coachable evaluate` measures them."""
    domain = load_domain("combat", config)
    space = domain.make_space()
    agent = LoadedPolicy(training.collector.policy, space, config, {})
    cells = single_styles(space)
    machines = [(name,) for name in config["env"]["machines"] or MACHINE_NAMES]

    def evaluate() -> dict[str, float]:
        with preserved_rng():
            fights = fight_matrix(
                domain,
                agent,
                cells,
                machines,
                episodes=episodes,
                steps=domain.episode_steps,
                seed=SEED,
                progress=False,
            )
        rows = damage_rows(fights, [style_label(cell) for cell in cells])
        scores = {row["style"]: row["style_score"] for row in rows if row["style_score"] is not None}
        values = {"style_score": np.mean(list(scores.values())), "won": np.mean([row["won"] for row in rows])}
        values |= {f"style_score/{name}": score for name, score in scores.items()}
        values |= {f"won/{row['style']}": row["won"] for row in rows}
        return {name: float(value) for name, value in values.items()}

    return evaluate


def finished(runs: Path) -> dict[str, list[Path]]:
    """Return the folders of the trainings that came to their end, by variant."""
    found: dict[str, list[Path]] = {}
    for variant in VARIANTS:
        for folder in sorted(runs.glob(f"{variant}_[0-9]*")):
            try:
                state = read_state(find_checkpoint(folder))
            except CheckpointError:
                continue
            if state["loop"]["frames"] >= state["config"]["train"]["total_frames"]:
                found.setdefault(variant, []).append(folder)
    return found


def last(run: Path, metric: str) -> float:
    return float(read_metric(run, "frames", metric)[1][-1])


def pace(folders: Sequence[Path]) -> float:
    """Minutes per million env-steps of a variant, without evaluations.

    Of each training the tenth percentile over its log intervals counts, and of these the least, because the machine may
    have been busy with something else.
    """
    found = []
    for folder in folders:
        frames, updating = read_metric(folder, "frames", "seconds/update")
        seconds = updating + sum(read_metric(folder, "frames", f"seconds/{part}")[1] for part in ("collect", "store"))
        trained = (np.diff(updating) > 0) & (np.diff(frames) > 0)
        found.append(np.percentile(np.diff(seconds)[trained] / np.diff(frames)[trained], 10))
    return min(found) * 1e6 / 60


def at(run: Path, frames: float, metric: str) -> float:
    """Return a metric after a number of env-steps, interpolated between evaluations."""
    return float(np.interp(frames, *read_metric(run, "frames", metric)))


def final_rows(runs: Mapping[str, Sequence[Path]]) -> list[dict[str, Any]]:
    """Per variant: means and 95 % bootstrap intervals over seeds of the last evaluation, and means at equal time.

    Equal time is that in which the fastest variant finishes.
    """
    rows, paces = [], {variant: pace(folders) for variant, folders in runs.items()}
    shortest = min(last(folder, "frames") * paces[variant] for variant, folders in runs.items() for folder in folders)
    for variant, folders in runs.items():
        row: dict[str, Any] = {"variant": variant, "changed": " ".join(VARIANTS[variant]), "seeds": len(folders)}
        for metric in METRICS:
            values, name = np.array([last(folder, metric) for folder in folders]), metric.removeprefix("eval/")
            low, high = bootstrap_interval(values)
            row |= {name: float(values.mean()), f"{name}_low": low, f"{name}_high": high}
            row[f"{name}_by_seed"] = " ".join(f"{value:.3f}" for value in values)
            row[f"{name}_at_equal_time"] = float(np.mean([at(f, shortest / paces[variant], metric) for f in folders]))
        row["frames"] = int(np.mean([last(folder, "frames") for folder in folders]))
        row["updates"] = int(np.mean([last(folder, "updates") for folder in folders]))
        row["minutes"] = row["frames"] * paces[variant] / 1e6
        row["equal_time_minutes"] = shortest / 1e6
        rows.append(row)
    return rows


def draw(runs: Mapping[str, Sequence[Path]], path: Path, paces: Mapping[str, float] | None = None) -> None:
    """Style score and wins over env-steps or minutes: the base in every column, beside it what the column changes.

    Args:
        runs: Trainings by variant.
        path: Image file.
        paces: Minutes per million env-steps by variant, if the horizontal axis shows minutes.
    """
    panels = {title: [v for v in members if v in runs] for title, members in PANELS.items()}
    panels = {title: members for title, members in panels.items() if members} or {"base": []}
    size = (4.2 * len(panels), 6.0)
    figure, grid = plt.subplots(2, len(panels), figsize=size, squeeze=False, sharex=True, layout="constrained")
    for (row, metric), (column, (title, members)) in product(enumerate(METRICS), enumerate(panels.items())):
        axes = grid[row, column]
        for number, variant in enumerate(["base", *members]):
            if variant not in runs:
                continue
            x, mean, (low, high) = summarise_runs(runs[variant], "frames", metric, smooth=1)
            x = x if paces is None else x * paces[variant] / 1e6
            colour = "black" if variant == "base" else f"C{number - 1}"
            label = f"{LABELS.get(variant, variant)} ({len(runs[variant])})"
            axes.plot(x, mean, color=colour, label=label)
            axes.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        axes.set_ylim(-0.03, 1.03)
        axes.grid(alpha=0.3)
        if row == 0:
            axes.set_title(title, fontsize=10)
        else:
            axes.set_xlabel("env-steps" if paces is None else "minutes")
            axes.legend(fontsize=7, title="(seeds)", title_fontsize=7)
        if column == 0:
            axes.set_ylabel(METRICS[metric])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="NAME")
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2], help="(default: 0 1 2)")
    parser.add_argument("--frames", type=int, help="env-steps of each training (default: the preset's)")
    parser.add_argument("--preset", default="small", help="of recipes/combat_cat_rac.py (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=10, help="fights per style and machine of an evaluation")
    parser.add_argument("--threads", type=int, default=1, help="(default: %(default)s)")
    parser.add_argument("--runs", type=Path, default=Path("runs/combat_ablations"), help="(default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("docs/results/combat"), help="(default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces every buffer it allocates
    for seed, variant in product(args.seeds, args.variants):  # an interrupted comparison has whole seeds
        train(variant, seed, (args.runs / f"{variant}_{seed}").absolute(), args)
        gc.collect()  # a replay buffer of more than a gigabyte

    runs = finished(args.runs)
    if not runs:
        raise SystemExit(f"{args.runs} has no finished training")
    draw(runs, args.out / "ablations.png")
    draw(runs, args.out / "ablations_minutes.png", {variant: pace(folders) for variant, folders in runs.items()})
    rows = final_rows(runs)
    write_csv(rows, args.out / "ablations.csv")
    for row in rows:
        print(
            f"{row['variant']:16} {row['seeds']} seeds: style score {row['style_score']:.2f}, won {row['won']:.0%}, "
            f"{row['minutes']:.0f} minutes"
        )


if __name__ == "__main__":
    main()

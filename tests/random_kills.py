"""Trainings that are killed at random moments and resumed, compared with ones that nobody interrupted.

python -m tests.random_kills                                      100 kills over all recipes
python -m tests.random_kills --kills 10 --recipe combat_cat_rac   one recipe
python -m tests.random_kills --recipe rare_targets train.total_frames=2000

SIGKILL reaches a training at a moment drawn uniformly over the time that all of it takes: while it starts, collects,
updates, evaluates, or writes a checkpoint or a row of metrics. It is resumed and killed again, several times. In the
end everything that its last checkpoint holds has to equal the uninterrupted training's, bit for bit, and its metrics
have to tell of every episode and every evaluation once.
"""

import argparse
import csv
import importlib
import mmap
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coachable.training.checkpoint import CheckpointError, find_checkpoint, read_state
from coachable.training.trainer import Trainer

RECIPES = Path(__file__).resolve().parent.parent / "recipes"
PARTS = ("start", "collect", "store", "update", "evaluate", "log", "checkpoint", "wait", "between")
UNEQUAL = ("config", "seconds")  # of a checkpoint: where the run is, and how long its parts took

TINY = ["preset=smoke", "threads.simulator=1", "threads.learner=1", "eval.max_steps=5", "train.total_frames=320"]
TINY += ["init_random_frames=48", "train.warmup_frames=48", "train.batch_size=32", "train.utd_ratio=0.125"]
TINY += ["train.eval_interval=80"]
INTERVALS = {"log_interval": 0.2, "checkpoint_interval": 0.2}  # [s]

_FOREVER = float("inf")

Make = Callable[[Path | None], Trainer]
"""Makes a training, resumed from a folder where one is given."""


@dataclass
class Course:
    """How a training went.

    Attributes:
        kills: the part of the loop into which each of them fell.
        lost: seconds between the last checkpoint and the kill, or since the start where there was none.
        problems: what differs from the uninterrupted training.
    """

    kills: list[str] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def run_with_kills(make: Make, run_dir: Path, *, delays: Sequence[float] = (), calls: Sequence[int] = ()) -> Course:
    """Runs a training to its end, though it is killed and resumed again and again.

    Args:
        make: makes the training.
        run_dir: its folder.
        delays: [s] from a start or resumption to a kill, one after the other.
        calls: Python and C functions that the loop calls until then, instead; see `count_calls`.

    Raises:
        RuntimeError: if it fails of its own accord.
    """
    course = Course()
    for delay, call in [*((delay, 0) for delay in delays), *((_FOREVER, call) for call in calls), (_FOREVER, 0)]:
        killed_in, lost = _run_once(make, run_dir, delay, call)
        if killed_in is None:
            break
        course.kills.append(killed_in)
        course.lost.append(lost)
    return course


def count_calls(run: Callable[[], Any]) -> int:
    """Python and C functions that are called by `run`, and what it calls in turn."""
    count = 0

    def another(_frame: Any, event: str, _argument: Any) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(another)
    try:
        run()
    finally:
        sys.setprofile(None)
    return count


def _run_once(make: Make, run_dir: Path, delay: float, call: int) -> tuple[str | None, float]:
    """Runs or resumes a training in a process of its own; returns where it was killed, and what that cost."""
    try:
        resume = find_checkpoint(run_dir)
    except CheckpointError:
        resume = None
    part = mmap.mmap(-1, 1)  # shared with the child
    log = run_dir.with_suffix(".log")
    started = time.time()

    def run() -> None:
        train = _publish_part(make(resume), part)
        if call:
            _die_at(call)
        train.run()

    child = os.fork()
    if child == 0:
        _be_child(run, log)
    status = _wait(child, delay)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL:
        complete = [file.stat().st_mtime for file in run_dir.glob("checkpoints/frames_*/metadata.json")]
        return PARTS[part[0]], time.time() - max([started, *complete])
    if status != 0:
        raise RuntimeError(f"the training in {run_dir} failed:\n{log.read_text()[-3000:]}")
    return None, 0.0


def _be_child(run: Callable[[], None], log: Path) -> None:
    """Runs and ends this process, without a return to the caller's."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    try:
        run()
        os._exit(0)
    except BaseException:
        os.write(2, traceback.format_exc().encode())
        os._exit(1)


def _die_at(call: int) -> None:
    """Ends this process at one of the next function calls as a kill from outside does."""
    left = call

    def count(_frame: Any, event: str, _argument: Any) -> None:
        nonlocal left
        left -= event in ("call", "c_call")
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(count)


def _wait(child: int, delay: float) -> int:
    """Status of a process that ends within `delay` [s], or is killed then."""
    end = time.monotonic() + delay
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status
        time.sleep(min(0.005, max(0.0, end - time.monotonic())))
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def _publish_part(train: Trainer, part: mmap.mmap) -> Trainer:
    """Lets the parent process see which part of the loop is being run."""
    timed = train._timed

    @contextmanager
    def watched(name: str) -> Iterator[None]:
        part[0] = PARTS.index(name)
        with timed(name):
            yield
        part[0] = PARTS.index("between")

    train._timed = watched  # pyright: ignore[reportAttributeAccessIssue]
    part[0] = PARTS.index("between")
    return train


def differences(run: Path, reference: Path) -> list[str]:
    """Names what two finished trainings do not have in common, bit for bit: checkpoints, replay, metrics."""
    found, expected = _contents(run), _contents(reference)
    names = [name for name in expected | found if name not in found or name not in expected]
    return names + [name for name, value in expected.items() if name in found and not _equal(value, found[name])]


def _contents(run: Path) -> dict[str, Any]:
    """Everything that the last checkpoint and the metrics say, flat."""
    folder = find_checkpoint(run)
    state = {name: value for name, value in read_state(folder).items() if name not in UNEQUAL}
    contents = dict(_leaves(state, "state"))
    if (folder / "replay").exists():  # the checkpoint of a finished stage has none
        contents |= dict(_leaves(torch.load(folder / "replay" / "state.pt", weights_only=True), "replay"))
    for file in sorted((folder / "replay").glob("*.npy")):
        contents[f"replay/{file.stem}"] = torch.from_numpy(np.load(file))
    return contents | _metrics(run)


def _metrics(run: Path) -> dict[str, Any]:
    text = (run / "metrics.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    frames = [int(row["frames"]) for row in rows]
    evaluations = [{k: v for k, v in row.items() if k.startswith(("frames", "eval/")) and v} for row in rows]
    return {
        "metrics/whole lines": text.endswith("\n") and None not in [v for row in rows for v in row.values()],
        "metrics/in order": frames == sorted(frames),
        "metrics/episodes": sum(int(row["episode/count"] or 0) for row in rows),
        "metrics/evaluations": [row for row in evaluations if len(row) > 1],
    }


def _leaves(value: Any, name: str) -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [leaf for key, part in value.items() for leaf in _leaves(part, f"{name}/{key}")]
    if isinstance(value, list | tuple):
        return [leaf for i, part in enumerate(value) for leaf in _leaves(part, f"{name}/{i}")]
    return [(name, value)]


def _equal(a: Any, b: Any) -> bool:
    if not isinstance(a, torch.Tensor) or not isinstance(b, torch.Tensor):
        return type(a) is type(b) and a == b
    return a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()


# -- recipes -----------------------------------------------------------------------------------------------------------


def make_recipe(recipe: str, run_dir: Path, arguments: list[str], resume: Path | None) -> Trainer:
    """Builds a recipe's training as its command line does."""
    from recipe_config import compose_config

    chosen = [f"resume={resume}"] if resume else [*TINY, *arguments, f"run_dir={run_dir}"]
    config = compose_config(recipe, chosen)
    config["train"] |= INTERVALS
    return importlib.import_module(recipe).build(config)


def kill_recipe(
    recipe: str, folder: Path, kills: int, per_run: int, rng: random.Random, arguments: list[str]
) -> Course:
    """Kills trainings of one recipe, `per_run` times each, until `kills` are reached."""
    importlib.import_module(recipe)  # once, not in every child
    reference = folder / f"{recipe}_reference"
    reference.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    run_with_kills(partial(make_recipe, recipe, reference, arguments), reference)
    span = time.monotonic() - started
    total, exact, runs = Course(), 0, 0
    while len(total.kills) < kills:
        runs += 1
        run = folder / f"{recipe}_{runs}"
        delays = [rng.uniform(0.0, span) for _ in range(min(per_run, kills - len(total.kills)))]
        started = time.monotonic()
        course = run_with_kills(partial(make_recipe, recipe, run, arguments), run, delays=delays)
        if not course.kills:  # it was faster than the one before: the machine was busier then
            span = time.monotonic() - started
        problems = differences(run, reference)
        exact += not problems
        total.kills += course.kills
        total.lost += course.lost
        total.problems += [f"{run.name}: {', '.join(problems[:8])} ({len(problems)} in all)"] if problems else []
    where = ", ".join(f"{count} {part}" for part, count in Counter(total.kills).most_common())
    print(f"{recipe}: {len(total.kills)} kills ({where}); {exact} of {runs} trainings of {span:.1f} s are exact")
    print(f"  seconds since the last checkpoint: {np.mean(total.lost):.2f} on average, {max(total.lost):.2f} at most")
    for problem in total.problems:
        print(f"  {problem}")
    sys.stdout.flush()
    return total


def main() -> int:
    """Kills as the command line says."""
    recipes = sorted(file.stem for file in (RECIPES / "configs").glob("*_*.yaml"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="over all recipes (default: 100)")
    parser.add_argument("--per-run", type=int, default=4, help="kills of one training before it may end (default: 4)")
    parser.add_argument("--recipe", choices=recipes, action="append", help="only this one; may be repeated")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("arguments", nargs="*", help="KEY=VALUE for the recipes")
    options = parser.parse_args()
    torch.set_num_threads(1)  # threads of this process would not survive a fork
    sys.path.insert(0, str(RECIPES))
    chosen = options.recipe or recipes
    rng = random.Random(options.seed)
    shares = [len(part) for part in np.array_split(range(options.kills), len(chosen))]
    with tempfile.TemporaryDirectory() as folder:
        courses = [
            kill_recipe(recipe, Path(folder), kills, options.per_run, rng, options.arguments)
            for recipe, kills in zip(chosen, shares, strict=True)
        ]
    failed = sum(bool(course.problems) for course in courses)
    print(f"{sum(len(course.kills) for course in courses)} kills, {failed} of {len(chosen)} recipes with differences")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())

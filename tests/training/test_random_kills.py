"""A training that is killed at any moment loses nothing but what came after its last checkpoint."""

import random
from functools import partial

import pytest

from coachable.training.checkpoint import find_checkpoint
from coachable.training.collection import evaluate_policy
from coachable.training.rng import seed_everything
from tests.random_kills import RECIPES, count_calls, differences, kill_recipe, run_with_kills

pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


def _make(make_train, make_echo_env, run_dir, resume):
    """Checkpoints after every round, so that kills fall into their writes, and evaluations every few rounds."""
    seed_everything(0)
    train = make_train(run_dir, total_frames=56, eval_interval=24, checkpoint_interval=0.0, log_interval=0.05)
    env = make_echo_env(5)

    def evaluate():
        env.set_seed(5)
        return evaluate_policy(env, train.collector.policy, max_steps=4)

    train.evaluate = evaluate
    if resume is not None:
        train.resume(resume)
    return train


def test_a_killed_training_ends_like_an_uninterrupted_one(make_train, make_echo_env, tmp_path):
    make = partial(_make, make_train, make_echo_env)
    whole = tmp_path / "whole"
    total = count_calls(make(whole, None).run)
    rng = random.Random(1)
    calls = [rng.randrange(1, total // 3) for _ in range(6)]
    course = run_with_kills(partial(make, tmp_path / "killed"), tmp_path / "killed", calls=calls)
    assert len(course.kills) >= 3
    assert differences(tmp_path / "killed", whole) == []
    assert sorted(p.name for p in (tmp_path / "killed").iterdir()) == ["checkpoints", "metrics.csv"]
    assert not [p.name for p in find_checkpoint(whole).parent.iterdir() if p.name.startswith(".")]


@pytest.mark.slow
@pytest.mark.parametrize("recipe", sorted(file.stem for file in (RECIPES / "configs").glob("*_*.yaml")))
def test_every_recipe_survives_kills(recipe, tmp_path):
    course = kill_recipe(recipe, tmp_path, kills=6, per_run=3, rng=random.Random(recipe), arguments=[])
    assert len(course.kills) == 6 and course.problems == []

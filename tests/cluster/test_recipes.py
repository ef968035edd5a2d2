"""Recipes with `collector=ray`, on the workers of a cluster."""

from importlib import import_module

import pytest
import torch
from recipe_config import compose_config

from tests.recipes.test_every_combination import TINY

pytestmark = pytest.mark.ray


@pytest.mark.parametrize("recipe", ["humanoid_sac", "combat_cat_rac", "racing_qr_sac"])
def test_a_recipe_trains_on_ray(recipe, cluster, tmp_path):
    arguments = [*TINY, "collector=ray", "collector.num_collectors=2", "collector.steps_per_batch=2"]
    arguments += ["train.total_frames=80", "train.utd_ratio=0.125", "train.log_interval=0", f"run_dir={tmp_path}"]
    train = import_module(recipe).build(compose_config(recipe, arguments))
    actor = train.learner.loss_module.actor_network
    before = torch.cat([p.detach().flatten() for p in actor.parameters()])
    workers = set()
    store = train._store

    def watch(data):
        workers.update(data["collector", "worker"].unique().tolist())
        store(data)

    train._store = watch
    latest = train.run()
    assert train.frames >= 80 and train.learner.updates > 0
    assert workers <= {0, 1} and latest["workers/restarts"] == 0
    assert not torch.equal(before, torch.cat([p.detach().flatten() for p in actor.parameters()]))
    assert (tmp_path / "checkpoints" / "LATEST").exists()

"""Train a fighter with a gamepad whose way of fighting is chosen at run time (Cat-RAC, impersonation, event tables).

python recipes/combat_cat_rac.py                          small on a CPU, full on a GPU
python recipes/combat_cat_rac.py preset=middle            more machines and styles
python recipes/combat_cat_rac.py preset=smoke             every part once, within a minute

The ablations of Appendix D:
python recipes/combat_cat_rac.py loss=sac_categorical
python recipes/combat_cat_rac.py impersonation.n=0
python recipes/combat_cat_rac.py sampler=independent      or one_hot
"""

from typing import Any

from recipe_config import run_recipe
from recipe_training import build_training

from coachable.domains.combat import combat_style_reward, combat_style_space
from coachable.training.loop import Train


def build(config: dict[str, Any]) -> Train:
    """Composes the training."""
    env = config["env"]
    return build_training(config, combat_style_space(env["styles"], env["reward_scale"]), combat_style_reward)


if __name__ == "__main__":
    run_recipe("combat_cat_rac", build)

"""Train the DMC humanoid to walk with a requested arm pose and step length (SAC).

python recipes/humanoid_sac.py                            cpu or gpu, whatever this machine has
python recipes/humanoid_sac.py preset=smoke               every part once, within a minute
python recipes/humanoid_sac.py preset=paper               the paper's settings
python recipes/humanoid_sac.py loss=qr_sac                another loss; see --help for all groups
python recipes/humanoid_sac.py train.batch_size=512 seed=1 run_dir=runs/mine
python recipes/humanoid_sac.py resume=runs/mine           continue where it stopped
python recipes/humanoid_sac.py init_from=runs/mine        new training from its actor and critics
"""

from typing import Any

from recipe_config import run_recipe
from recipe_training import build_training

from coachable.domains.humanoid import humanoid_style_reward, humanoid_style_space
from coachable.domains.humanoid.mirror_maps import humanoid_mirror_maps
from coachable.training.loop import Train


def build(config: dict[str, Any]) -> Train:
    """Composes the training."""
    return build_training(config, humanoid_style_space(), humanoid_style_reward, mirror_maps=humanoid_mirror_maps())


if __name__ == "__main__":
    run_recipe("humanoid_sac", build)

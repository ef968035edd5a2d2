"""Train a racing driver whose style is chosen at run time (QR-SAC).

python recipes/racing_qr_sac.py                                        tyre and fuel saving, cpu or gpu
python recipes/racing_qr_sac.py family=drift sampler=with_requests     drifting on request
python recipes/racing_qr_sac.py family=aggressiveness                  margins to two agents and two rivals
python recipes/racing_qr_sac.py preset=smoke                           every part once, within a minute

Margins are kept better after four stages: alone, keeping away from others, overtaking them, and all of it as asked.

python recipes/racing_qr_sac.py preset=cpu_alone run_dir=runs/alone
python recipes/racing_qr_sac.py preset=cpu_races init_from=runs/alone run_dir=runs/races
python recipes/racing_qr_sac.py preset=cpu_passing init_from=runs/races run_dir=runs/passing
python recipes/racing_qr_sac.py preset=cpu_late_races init_from=runs/passing
"""

from typing import Any

from recipe_config import run_recipe
from recipe_training import build_training

from coachable.domains.racing.families import family_style
from coachable.training.loop import Train


def build(config: dict[str, Any]) -> Train:
    """Composes the training."""
    space, make_reward = family_style(config["family"])
    return build_training(config, space, make_reward)


if __name__ == "__main__":
    run_recipe("racing_qr_sac", build)

"""The contestants of benchmarks/combat.py, each in a process of its own: `python combat_workers.py NAME`."""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from contest import serve

FIGHTS = 2048
DRAWN = 8  # different actions, in turn
TICS = 7  # of 35 per second: the 0.2 s of a combat step


def advance(fights: Any, current: Any, actions: Any, steps: int) -> Any:
    """So many steps of all fights, finished ones reset."""
    for step in range(steps):
        _, current = fights.step_and_maybe_reset(current.set("action", actions[step % len(actions)]))
    return current


def ours() -> Callable[[int], None]:
    """`FIGHTS` fights, one thread; a unit of work is one step of all of them."""
    import torch

    from coachable.envs.combat import CombatEnv

    torch.set_num_threads(1)
    fights = CombatEnv(FIGHTS, seed=0)
    actions = fights.action_spec.rand((DRAWN,))
    current = fights.reset()

    def run(steps: int) -> None:
        nonlocal current
        current = advance(fights, current, actions, steps)

    return run


def vizdoom() -> Callable[[int], None]:
    """One ViZDoom death match with monsters and the list of objects; a unit of work is one action of seven tics."""
    import random

    import vizdoom as doom

    game = doom.DoomGame()
    game.load_config(str(Path(doom.scenarios_path) / "deathmatch.cfg"))
    game.set_window_visible(False)
    game.set_screen_resolution(doom.ScreenResolution.RES_160X120)
    game.set_objects_info_enabled(True)
    game.set_seed(0)
    game.set_doom_config_path(str(Path(tempfile.mkdtemp()) / "vizdoom.ini"))  # otherwise written where one stands
    game.init()
    draw = random.Random(0)
    buttons = game.get_available_buttons_size()

    def run(actions: int) -> None:
        for _ in range(actions):
            if game.is_episode_finished():
                game.new_episode()
            game.get_state()
            game.make_action([draw.randint(0, 1) for _ in range(buttons)], TICS)

    return run


WORKERS = {"coachable": ours, "vizdoom": vizdoom}

if __name__ == "__main__":
    serve(WORKERS, sys.argv[1], warmup=5)

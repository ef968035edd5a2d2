"""Where the time and the memory of the humanoid recipe go, measured in the recipe itself.

    python benchmarks/loop.py                      networks as in the paper, 3 x 512
    python benchmarks/loop.py preset=cpu           any overrides of the recipe

Runs `recipes/humanoid_sac.py` without evaluation and checkpoints for a number of rounds after the warm-up, and prints
the share of wall time that went into physics (`mujoco.rollout`), into updates and all the rest, and the peak memory
once the replay buffer is full.
"""

import resource
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "recipes"))

ROUNDS = 60
WARMUP_ROUNDS = 10
PAPER_NETWORK = ["network.actor.widths=[512,512,512]", "network.critic.widths=[512,512,512]"]


def main(overrides: list[str]) -> None:
    from humanoid_sac import build
    from mujoco import rollout
    from recipe_config import compose_config

    physics = 0.0
    plain = rollout.Rollout.rollout

    def timed(*args, **kwargs):
        nonlocal physics
        start = time.perf_counter()
        result = plain(*args, **kwargs)
        physics += time.perf_counter() - start
        return result

    rollout.Rollout.rollout = timed
    with tempfile.TemporaryDirectory() as folder:
        quick = ["init_random_frames=0", "train.warmup_frames=0", "train.eval_interval=0", "checkpoint.replay=false"]
        config = compose_config("humanoid_sac", [*PAPER_NETWORK, *quick, *overrides, f"run_dir={folder}"])
        train = build(config)
        _fill(train, config["replay_capacity"])
        batches = iter(train.collector)
        for round_number in range(WARMUP_ROUNDS + ROUNDS):
            if round_number == WARMUP_ROUNDS:
                physics, updates = 0.0, train.learner.updates
                train.seconds = dict.fromkeys(train.seconds, 0.0)
                start = time.perf_counter()
            data = train._collect(batches)
            train._store(data)
            train._update(data.numel(), None)
            train._log_if_due()
        wall = time.perf_counter() - start
        updates = train.learner.updates - updates
    steps = ROUNDS * config["env"]["num_envs"]
    rest = wall - physics - train.seconds["update"]
    print(f"{steps / wall:.0f} env-steps/s, {updates / wall:.1f} updates/s")
    print("| part | share of wall time |\n|-|-|")
    for name, seconds in (("physics", physics), ("updates", train.seconds["update"]), ("everything else", rest)):
        print(f"| {name} | {seconds / wall:.1%} |")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak:.2f} GiB with {len(train.replay):,} transitions stored")


def _fill(train, capacity: int) -> None:
    """Fill the replay buffer with copies of one collected round."""
    data = next(iter(train.collector)).contiguous().reshape(-1).select(*train.replay_keys)
    block = data.expand(64, *data.shape).reshape(-1)
    while len(train.replay) < capacity:
        train.replay.extend(block)


if __name__ == "__main__":
    main(sys.argv[1:])

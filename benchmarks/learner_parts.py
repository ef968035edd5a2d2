"""Parts of other learners and settings, tried one by one on the first two stages of the humanoid's preset `cpu`.

    python benchmarks/learner_parts.py                                   all parts, two seeds: half a day on one core
    python benchmarks/learner_parts.py --only none held_noise --seeds 0 --core 1     several may run side by side
    python benchmarks/learner_parts.py --seeds                           trains nothing, prints what has ended

Every training has 0.7 M env-steps of the first stage and `--frames` of the second one, and as many updates, but for
`double_utd`. The deterministic policy is then measured over five episodes of 1000 steps in each of the 24 styles. A
training that was interrupted starts again. Most parts are those of FlashSAC (arXiv 2604.04539); its networks with batch
norm are not among them.
"""

import argparse
import functools
import json
import math
import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

import humanoid_sac
import numpy as np
import torch
from contest import processor
from recipe_config import compose_config
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import Transform

from coachable.domain import load_domain
from coachable.evaluation.curves import read_metric
from coachable.evaluation.style_grid import evaluate_grid
from coachable.training.curriculum import Curriculum
from coachable.training.learner import Learner
from coachable.training.trainer import Trainer
from coachable.training.weights import load_policy

COMMON = ["preset=cpu", "threads.learner=1", "threads.simulator=1", "train.eval_interval=0", "wandb.mode=off"]
COMMON += ["checkpoint.replay=false"]
SCALE = 1 / 70  # of rewards, so that values are at most about 5
COLUMNS = ("without a fall", "step error [m]", "arms in pose", "clearance [m]", "minutes", "updates")


class HeldNoise(TensorDictModuleBase):
    """Tanh-Gaussian policy whose noise stays the same for n steps, where n has a zeta law with exponent 2, up to 16."""

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor = actor
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys
        self.spans = torch.arange(1.0, 17.0) ** -2
        self.noise = torch.zeros(0)
        self.left = torch.zeros(0)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = self.actor(tensordict)
        loc, scale = out["loc"], out["scale"]
        if self.noise.shape != loc.shape:
            self.noise, self.left = torch.zeros_like(loc), torch.zeros(loc.shape[:-1])
        ends = self.left <= 0
        spans = 1.0 + torch.multinomial(self.spans, ends.numel(), replacement=True)
        self.left = torch.where(ends, spans, self.left) - 1
        self.noise = torch.where(ends[:, None], torch.randn_like(loc), self.noise)
        return out.set("action", torch.tanh(loc + scale * self.noise).clamp(-1 + 1e-6, 1 - 1e-6))


class ChangedReward(Transform):
    """Replay transform that scales rewards, and takes a cost off those of transitions that end in a fall."""

    def __init__(self, scale: float = 1.0, fall: float = 0.0) -> None:
        super().__init__()
        self.scale, self.fall = scale, fall

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        reward, terminated = tensordict["next", "reward"], tensordict["next", "terminated"]
        return tensordict.set(("next", "reward"), self.scale * (reward - self.fall * terminated))


def scaled_rewards(train: Trainer) -> None:
    train.replay.append_transform(ChangedReward(SCALE))


def costly_falls(train: Trainer) -> None:
    train.replay.append_transform(ChangedReward(fall=400.0))


def unit_rows(train: Trainer) -> None:
    """Keep every row of the hidden layers at length 1."""
    loss = train.learner.loss_module
    weights = [w for name, w in loss.named_parameters() if ".blocks." in name and name.endswith("linear.weight")]

    def normalise() -> None:
        with torch.no_grad():
            for weight in weights:
                weight.div_(weight.norm(dim=-1, keepdim=True))

    normalise()
    after_update(train.learner, lambda metrics: normalise())


def entropy_target(train: Trainer) -> None:
    """Follow the entropy of a standard deviation of 0.15 with the entropy weight."""
    learner = train.learner
    target = 21 / 2 * math.log(2 * math.pi * math.e * 0.15**2)

    def adjust(metrics: dict[str, Tensor]) -> None:
        assert learner._log_alpha is not None
        learner._log_alpha -= 3e-4 * max(-1.0, min(1.0, float(metrics["entropy"]) - target))
        learner.scale_entropy_weight(1.0)

    after_update(learner, adjust)


def every_second(train: Trainer) -> None:
    """Update the policy in every second update of the critics."""
    learner = train.learner
    update = learner._update_actor
    last: dict[str, Any] = {}

    def sometimes(batch: TensorDictBase) -> dict[str, Tensor]:
        if not last or learner.updates % 2 == 0:
            last["metrics"] = update(batch)
        return dict(last["metrics"])

    learner._update_actor = sometimes


def after_update(learner: Learner, act: Callable[[dict[str, Tensor]], None]) -> None:
    update = learner.update

    @functools.wraps(update)
    def wrapped(batch: TensorDictBase) -> dict[str, Tensor]:
        metrics = update(batch)
        act(metrics)
        return metrics

    learner.update = wrapped


@dataclass(frozen=True)
class Part:
    """What differs: arguments of the recipe, what is done to the training of each stage, and the collecting policy."""

    arguments: tuple[str, ...] = ()
    change: Callable[[Trainer], None] = lambda train: None
    policy: Callable[[Any], nn.Module] = lambda actor: actor


PARTS = {
    "none": Part(),
    "gamma_98": Part(("gamma=0.98",)),
    "gamma_985": Part(("gamma=0.985",)),
    "costly_falls": Part(change=costly_falls),
    "entropy_target": Part(change=entropy_target),
    "held_noise": Part(policy=HeldNoise),
    "every_second": Part(change=every_second),
    "unit_rows": Part(change=unit_rows),
    "scaled_rewards": Part((f"alpha={0.05 * SCALE}",), scaled_rewards),
    "categorical": Part(
        ("loss=sac_categorical", "critic_support.v_min=-5", "critic_support.v_max=8", f"alpha={0.05 * SCALE}"),
        scaled_rewards,
    ),
    "batch_512": Part(("train.batch_size=512",)),
    "tau_005": Part(("learner.tau=0.005",)),
    "one_step": Part(("n_steps=1",)),
    "three_steps": Part(("n_steps=3",)),
    "lr_6e-4": Part(("learner.actor_lr=6e-4", "learner.critic_lr=6e-4")),
    "alpha_02": Part(("alpha=0.02",)),
    "double_utd": Part(("train.utd_ratio=0.125",)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1], help="(%(default)s)")
    parser.add_argument("--frames", type=int, default=1_000_000, help="of the second stage (%(default)s)")
    parser.add_argument("--core", type=int, help="core that the trainings keep to")
    parser.add_argument("--out", type=Path, default=Path("runs/learner_parts"))
    options = parser.parse_args()
    if options.core is not None:
        os.sched_setaffinity(0, {options.core})
    torch.set_num_threads(1)
    for seed in options.seeds:
        for name in options.only:
            file = result_file(options, name, seed)
            if not file.exists():
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(json.dumps(train_and_measure(name, seed, file.with_suffix(""), options.frames)))
    print(f"{processor()}\n| part | seeds | " + " | ".join(COLUMNS) + " |\n|" + "-|" * (len(COLUMNS) + 2))
    for name in PARTS:
        files = sorted(options.out.glob(f"{name}_{options.frames}_*.json"))
        found = [json.loads(file.read_text()) for file in files]
        if found:
            cells = [" / ".join(f"{row[column]:.3g}" for row in found) for column in COLUMNS]
            print(f"| {name} | {len(found)} | " + " | ".join(cells) + " |")


def result_file(options: argparse.Namespace, name: str, seed: int) -> Path:
    return options.out / f"{name}_{options.frames}_{seed}.json"


def train_and_measure(name: str, seed: int, run_dir: Path, frames: int) -> dict[str, float]:
    part = PARTS[name]
    shutil.rmtree(run_dir, ignore_errors=True)
    config = compose_config("humanoid_sac", [*COMMON, *part.arguments, f"seed={seed}", f"run_dir={run_dir}"])
    del config["stages"][2:]
    config["stages"][1]["train"]["total_frames"] = frames
    make_collector = humanoid_sac.boxes.make_collector

    def build(stage: dict[str, Any]) -> Trainer:
        with patch.object(
            humanoid_sac.boxes, "make_collector", lambda run, env, actor: make_collector(run, env, part.policy(actor))
        ):
            train = humanoid_sac.build(stage)
        part.change(train)
        return train

    began = time.perf_counter()
    curriculum = Curriculum(config, build)
    curriculum.run()
    if curriculum.train.stopped:
        sys.exit("the training was interrupted: the same command starts it again")
    minutes = (time.perf_counter() - began) / 60
    row = measure(run_dir) | {"minutes": minutes, "updates": read_metric(run_dir, "updates", "updates")[0][-1]}
    shutil.rmtree(run_dir)
    return row


def measure(run_dir: Path) -> dict[str, float]:
    agent = load_policy(str(run_dir))
    domain = load_domain("humanoid", agent.config)
    episodes = evaluate_grid(domain, agent.actor, agent.space, episodes=5, num_threads=1, progress=False).episodes
    means = (float(np.nanmean(episodes[key])) for key in ("survived", "step_length_error", "pose_held", "clearance"))
    return dict(zip(COLUMNS, means, strict=False))


if __name__ == "__main__":
    main()

"""One SAC update on equal work, in several codebases; runs as a worker process that answers on its standard output.

Each peer needs only its own packages, so that peers may live in another virtual environment:

    python benchmarks/learner_workers.py sb3

`learner.py` drives several of them in turn, see `contest.py`.

`learner_work.py` has the work. "resnet" stands for the residual network with layer norm; the others are plain ReLU
networks of the same widths, which is slightly less work.
"""

import sys

from contest import serve
from our_learners import coachable, gamepad, our_loss
from peer_learners import sbx, single_file, stable_baselines3, torchrl

MATMUL_FLOPS = 2 * 1024**3


def matmul(precision, size=1024):
    """The yardstick: products of large square matrices; one "update" stands for one product."""
    import torch

    dtype = {"fp32": torch.float32, "bf16": torch.bfloat16}[precision]
    a, b = torch.randn(size, size).to(dtype), torch.randn(size, size).to(dtype)
    out = torch.empty(size, size, dtype=dtype)

    def run(n):
        for _ in range(n):
            torch.mm(a, b, out=out)

    return run


WORKERS = {
    "coachable-fp32": lambda: coachable("fp32"),
    "coachable-bf16": lambda: coachable("bf16"),
    "coachable-bf16-policy-first": lambda: coachable("bf16", order="policy_first"),
    "coachable-bf16-autocast": lambda: coachable("bf16", fast="off"),
    "coachable-qr_sac": lambda: our_loss("qr_sac"),
    "coachable-rac": lambda: our_loss("rac"),
    "coachable-cat_rac": lambda: our_loss("cat_rac"),
    "coachable-cat_rac-fp32": lambda: our_loss("cat_rac", "fp32"),
    "coachable-sac_categorical": lambda: our_loss("sac_categorical"),
    "coachable-cat_rac-gamepad": lambda: gamepad(1000),
    "coachable-cat_rac-gamepad-1-sample": lambda: gamepad(1),
    "torchrl": lambda: torchrl("mlp"),
    "torchrl-resnet": lambda: torchrl("resnet"),
    "single-file-fp32": lambda: single_file("fp32"),
    "single-file-bf16": lambda: single_file("bf16"),
    "single-file-resnet-fp32": lambda: single_file("fp32", "resnet"),
    "single-file-resnet-bf16": lambda: single_file("bf16", "resnet"),
    "sb3": stable_baselines3,
    "sbx-1": lambda: sbx(1),
    "sbx-8": lambda: sbx(8),
    "matmul-fp32": lambda: matmul("fp32"),
    "matmul-bf16": lambda: matmul("bf16"),
}
PEERS = ("sb3", "sbx-1", "sbx-8")  # these run in the peers' interpreter


if __name__ == "__main__":
    serve(WORKERS, sys.argv[1], warmup=8)

"""One SAC update on equal work, in several codebases; runs as a worker process that answers on its standard output.

Each peer needs only its own packages, so that peers may live in another virtual environment:

    python benchmarks/learner_workers.py sb3

`learner.py` drives several of them in turn, see `contest.py`.

The work: batch 256, observation 84 + style 4, action 21, policy and twin critics of 3 x 512 (or LEARNER_WIDTH), fixed
temperature 0.01, squared error, Adam, Polyak 0.005. "resnet" stands for the residual network with layer norm; the
others are plain ReLU networks of the same widths, which is slightly less work.
"""

import copy
import itertools
import math
import os
import sys

from contest import serve

B, OBS, STYLE, ACT, LAYERS = 256, 84, 4, 21, 3
WIDTH = int(os.environ.get("LEARNER_WIDTH", "512"))
ALPHA, GAMMA, TAU, LR = 0.01, 0.99, 0.005, 1e-4


def macs_per_sample() -> int:
    """Multiply-accumulates of one update per sample: what the algorithm needs, without any shortcut.

    No gradients for inputs that need none, none for the critics' weights in the policy's loss.
    """
    trunk = (LAYERS - 1) * WIDTH * WIDTH
    actor = (OBS + STYLE) * WIDTH + trunk + WIDTH * 2 * ACT
    critic = (OBS + STYLE + ACT) * WIDTH + trunk + WIDTH
    actor_dx = trunk + WIDTH * 2 * ACT
    critic_dx = trunk + WIDTH
    target = actor + 2 * critic
    critic_loss = 2 * (critic + critic + critic_dx)
    actor_loss = actor + 2 * critic + 2 * (critic_dx + ACT * WIDTH) + actor + actor_dx
    return target + critic_loss + actor_loss


def flops_per_update() -> int:
    return 2 * B * macs_per_sample()


def make_batch(size=B):
    """Return `size` random transitions, which are the same at each call."""
    import torch
    from tensordict import TensorDict

    gen = torch.Generator().manual_seed(0)

    def normal(n):
        return torch.randn(size, n, generator=gen)

    style = torch.rand(size, STYLE, generator=gen)
    done = torch.zeros(size, 1, dtype=torch.bool)
    done[::50] = True
    return TensorDict(
        {
            "observation": normal(OBS),
            "style": style,
            "action": torch.tanh(normal(ACT)),
            "next": {
                "observation": normal(OBS),
                "style": style,
                "reward": normal(1),
                "done": done,
                "terminated": done,
            },
        },
        [size],
    )


class _Space:
    dim = STYLE

    def encode(self, theta):
        return theta * 0.5


def _updates(learner, batch):
    def run(n):
        for _ in range(n):
            learner.update(batch)

    return run


def sac_learner(width=WIDTH, device="cpu", **options):
    """Return our learner of SAC with networks of `LAYERS` x `width`; `options` are those of `Learner`."""
    import torch
    from torchrl.objectives import SACLoss

    from coachable.networks import make_critic, make_gaussian_actor
    from coachable.training.learner import Learner

    torch.manual_seed(0)
    widths = (width,) * LAYERS
    loss = SACLoss(
        make_gaussian_actor(OBS, ACT, _Space(), widths),
        [make_critic(OBS, ACT, _Space(), widths) for _ in range(2)],
        loss_function="l2",
        fixed_alpha=True,
        alpha_init=ALPHA,
    )
    loss.make_value_estimator(gamma=GAMMA)
    return Learner(loss.to(device), actor_lr=LR, critic_lr=LR, tau=TAU, **options)


def coachable(precision, fast="on", order="simultaneous"):
    from coachable.fast import accelerate

    learner = sac_learner(precision=precision, update_order=order)
    accelerate(learner, fast)
    return _updates(learner, make_batch())


def our_loss(name, precision="bf16"):
    """Another of our losses on the same trunks, policy first as in the paper's recipes."""
    import torch

    from coachable.fast import accelerate
    from coachable.losses import CategoricalSACLoss, CatRACLoss, QRSACLoss, RACLoss
    from coachable.networks import make_critic, make_gaussian_actor, make_hl_gauss_critic
    from coachable.training.learner import Learner

    torch.manual_seed(0)
    widths, bins = (WIDTH,) * LAYERS, {"v_min": -600.0, "v_max": 1000.0, "num_atoms": 255}
    make_loss, arguments = {
        "qr_sac": (QRSACLoss, {"num_quantiles": 32}),
        "rac": (RACLoss, {"entropy_samples": 1000}),
        "cat_rac": (CatRACLoss, {"entropy_samples": 1000, **bins}),
        "sac_categorical": (CategoricalSACLoss, bins),
    }[name]

    def critic():
        if "v_min" in arguments:
            return make_hl_gauss_critic(OBS, ACT, _Space(), widths, **bins)
        return make_critic(OBS, ACT, _Space(), widths, num_outputs=arguments.get("num_quantiles", 1))

    loss = make_loss(make_gaussian_actor(OBS, ACT, _Space(), widths), [critic(), critic()], alpha=ALPHA, **arguments)
    loss.make_value_estimator(gamma=GAMMA)
    learner = Learner(loss, actor_lr=LR, critic_lr=LR, tau=TAU, precision=precision, update_order="policy_first")
    accelerate(learner)
    return _updates(learner, make_batch())


def gamepad(entropy_samples):
    """Cat-RAC on the gamepad of the combat domain: six heads of buttons, four Gaussian axes."""
    import torch

    from coachable.envs.combat.gamepad import GAMEPAD
    from coachable.fast import accelerate
    from coachable.losses import CatRACLoss
    from coachable.networks.hl_gauss_critic import make_hl_gauss_critic
    from coachable.networks.mixed import make_mixed_actor
    from coachable.training import Learner

    torch.manual_seed(0)
    widths = [WIDTH] * LAYERS
    critics = [make_hl_gauss_critic(OBS, GAMEPAD.action_dim, _Space(), widths) for _ in range(2)]
    actor = make_mixed_actor(OBS, GAMEPAD, _Space(), widths)
    loss = CatRACLoss(actor, critics, alpha=ALPHA, entropy_samples=entropy_samples)
    loss.make_value_estimator(gamma=GAMMA)
    learner = Learner(loss, actor_lr=LR, critic_lr=LR, tau=TAU, precision="bf16", update_order="policy_first")
    accelerate(learner)
    batch = make_batch()
    batch["action"] = GAMEPAD.spec(batch.batch_size).rand()
    return _updates(learner, batch)


def torchrl(network):
    """TorchRL's `SACLoss` as its own SAC recipe uses it: one critic module vmapped, plain Adam, one backward."""
    import torch
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torch import nn
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import SACLoss, SoftUpdate, group_optimizers

    torch.manual_seed(0)
    cells = [WIDTH] * LAYERS
    if network == "mlp":
        trunk = MLP(in_features=OBS + STYLE, out_features=2 * ACT, num_cells=cells, activation_class=nn.ReLU)
        policy = nn.Sequential(trunk, NormalParamExtractor(scale_mapping="biased_softplus_1.0", scale_lb=0.1))
        policy = TensorDictModule(_Cat(policy), in_keys=["observation", "style"], out_keys=["loc", "scale"])
        critic_in = OBS + STYLE + ACT
        critic = ValueOperator(
            MLP(in_features=critic_in, out_features=1, num_cells=cells, activation_class=nn.ReLU),
            in_keys=["observation", "style", "action"],
        )
        actor = ProbabilisticActor(
            policy,
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": -torch.ones(ACT), "high": torch.ones(ACT), "tanh_loc": False},
        )
    else:
        from coachable.networks import make_critic, make_gaussian_actor

        actor, critic = make_gaussian_actor(OBS, ACT, _Space(), cells), make_critic(OBS, ACT, _Space(), cells)
    loss = SACLoss(
        actor, critic, num_qvalue_nets=2, loss_function="l2", fixed_alpha=True, alpha_init=ALPHA, target_entropy=-ACT
    )
    loss.make_value_estimator(gamma=GAMMA)
    targets = SoftUpdate(loss, eps=1 - TAU)
    optimizer = group_optimizers(
        torch.optim.Adam(list(loss.actor_network_params.flatten_keys().values()), lr=LR),
        torch.optim.Adam(list(loss.qvalue_network_params.flatten_keys().values()), lr=LR),
    )
    batch = make_batch()

    def run(n):
        for _ in range(n):
            losses = loss(batch)
            (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).sum().backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            targets.step()

    return run


def _Cat(module):
    import torch
    from torch import nn

    class Cat(nn.Module):
        def __init__(self):
            super().__init__()
            self.module = module

        def forward(self, *inputs):
            return self.module(torch.cat(inputs, -1))

    return Cat()


def single_file(precision, network="mlp"):
    """A plain PyTorch update in the style of single-file implementations, with fused Adam and foreach Polyak."""
    import torch
    import torch.nn.functional as F
    from torch import nn

    torch.manual_seed(0)

    class Block(nn.Module):
        def __init__(self, i, o):
            super().__init__()
            self.linear, self.norm, self.pad = nn.Linear(i, o), nn.LayerNorm(o), o - i

        def forward(self, x):
            return F.relu(self.norm(self.linear(x))) + F.pad(x, (0, self.pad))

    def mlp(i, o):
        sizes = [i] + [WIDTH] * LAYERS
        layers = []
        for a, b in itertools.pairwise(sizes):
            layers += [Block(a, b)] if network == "resnet" else [nn.Linear(a, b), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(WIDTH, o))

    actor = mlp(OBS + STYLE, 2 * ACT)
    critics = [mlp(OBS + STYLE + ACT, 1) for _ in range(2)]
    targets = copy.deepcopy(critics)
    live = [p for q in critics for p in q.parameters()]
    slow = [p for q in targets for p in q.parameters()]
    opt_actor = torch.optim.Adam(actor.parameters(), lr=LR, fused=True)
    opt_critic = torch.optim.Adam(live, lr=LR, fused=True)
    half_log_2pi = 0.5 * math.log(2 * math.pi)

    def sample(x):
        mean, raw = actor(x).float().chunk(2, -1)
        log_std = -5 + 3.5 * (torch.tanh(raw) + 1)
        noise = torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        log_prob = -0.5 * noise.square() - log_std - half_log_2pi - 2 * (math.log(2) - u - F.softplus(-2 * u))
        return torch.tanh(u), log_prob.sum(-1, keepdim=True)

    data = make_batch()
    obs = torch.cat((data["observation"], data["style"]), -1)
    next_obs = torch.cat((data["next", "observation"], data["next", "style"]), -1)
    action, reward, done = data["action"], data["next", "reward"], data["next", "terminated"].float()

    def update():
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            with torch.no_grad():
                next_action, next_log_prob = sample(next_obs)
                x = torch.cat((next_obs, next_action), -1)
                value = torch.minimum(targets[0](x), targets[1](x)).float() - ALPHA * next_log_prob
                y = reward + GAMMA * (1 - done) * value
            x = torch.cat((obs, action), -1)
            loss_q = sum(F.mse_loss(q(x).float(), y) for q in critics)
        opt_critic.zero_grad()
        loss_q.backward()
        opt_critic.step()
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            new_action, log_prob = sample(obs)
            x = torch.cat((obs, new_action), -1)
            loss_pi = (ALPHA * log_prob - torch.minimum(critics[0](x), critics[1](x)).float()).mean()
        opt_actor.zero_grad()
        loss_pi.backward()
        opt_actor.step()
        with torch.no_grad():
            torch._foreach_lerp_(slow, live, TAU)

    def run(n):
        for _ in range(n):
            update()

    return run


def _gym_model(module, **policy):
    import gymnasium as gym
    import numpy as np
    import torch as th
    from stable_baselines3.common.logger import configure

    th.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))

    class Env(gym.Env):
        observation_space = gym.spaces.Box(-np.inf, np.inf, (OBS + STYLE,), np.float32)
        action_space = gym.spaces.Box(-1, 1, (ACT,), np.float32)

        def reset(self, *, seed=None, options=None):
            return np.zeros(OBS + STYLE, np.float32), {}

        def step(self, action):
            return np.zeros(OBS + STYLE, np.float32), 0.0, False, False, {}

    model = module.SAC(
        "MlpPolicy",
        Env(),
        learning_rate=LR,
        buffer_size=8 * B,
        batch_size=B,
        tau=TAU,
        gamma=GAMMA,
        ent_coef=ALPHA,
        policy_kwargs={"net_arch": [WIDTH] * LAYERS, **policy},
        seed=0,
        device="cpu",
    )
    model._setup_learn(1000)
    model.set_logger(configure(None, []))
    rng = np.random.default_rng(0)
    for _ in range(8 * B):
        obs, nxt = rng.standard_normal((2, 1, OBS + STYLE), np.float32)
        model.replay_buffer.add(obs, nxt, np.tanh(rng.standard_normal((1, ACT))), rng.standard_normal(1), [False], [{}])
    return model


def stable_baselines3():
    import stable_baselines3

    model = _gym_model(stable_baselines3)
    return lambda n: model.train(gradient_steps=n, batch_size=B)


def sbx(per_call, **policy):
    import sbx as module

    model = _gym_model(module, **policy)

    def run(n):
        for _ in range(n // per_call):
            model.train(gradient_steps=per_call, batch_size=B)
        model.policy.actor_state.params["params"]["Dense_0"]["bias"].block_until_ready()

    return run


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

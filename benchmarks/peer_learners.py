"""The same update in other codebases, on the work of `learner_work`; each needs only its own packages."""

import copy
import itertools
import math
import os

from learner_work import ACT, ALPHA, GAMMA, LAYERS, LR, OBS, STYLE, TAU, WIDTH, B, ScaledStyle, make_batch


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

        actor, critic = make_gaussian_actor(OBS, ACT, ScaledStyle(), cells), make_critic(OBS, ACT, ScaledStyle(), cells)
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

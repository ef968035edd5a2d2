"""Our learners on the work of `learner_work`."""

from learner_work import ACT, ALPHA, GAMMA, LAYERS, LR, OBS, TAU, WIDTH, ScaledStyle, make_batch


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
        make_gaussian_actor(OBS, ACT, ScaledStyle(), widths),
        [make_critic(OBS, ACT, ScaledStyle(), widths) for _ in range(2)],
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
            return make_hl_gauss_critic(OBS, ACT, ScaledStyle(), widths, **bins)
        return make_critic(OBS, ACT, ScaledStyle(), widths, num_outputs=arguments.get("num_quantiles", 1))

    loss = make_loss(
        make_gaussian_actor(OBS, ACT, ScaledStyle(), widths), [critic(), critic()], alpha=ALPHA, **arguments
    )
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
    critics = [make_hl_gauss_critic(OBS, GAMEPAD.action_dim, ScaledStyle(), widths) for _ in range(2)]
    actor = make_mixed_actor(OBS, GAMEPAD, ScaledStyle(), widths)
    loss = CatRACLoss(actor, critics, alpha=ALPHA, entropy_samples=entropy_samples)
    loss.make_value_estimator(gamma=GAMMA)
    learner = Learner(loss, actor_lr=LR, critic_lr=LR, tau=TAU, precision="bf16", update_order="policy_first")
    accelerate(learner)
    batch = make_batch()
    batch["action"] = GAMEPAD.spec(batch.batch_size).rand()
    return _updates(learner, batch)

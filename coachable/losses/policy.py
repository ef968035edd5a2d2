"""`PolicyReader`, which converts the output of a supported TorchRL actor to a `MixedAction`."""

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictSequential
from torchrl.data import TensorSpec
from torchrl.modules import TanhNormal

from coachable.distributions.action_heads import ActionHeads, MixedActionSpec
from coachable.distributions.mixed_action import MixedAction


class PolicyReader:
    """Reader of the distribution of an actor as a `MixedAction`.

    It evaluates the deterministic part of the actor and does not build the actor's own distribution. A `TanhNormal`
    takes longer to build than to sample. It also samples and scores in separate steps, which gives wrong densities
    where tanh saturates (see `sample_tanh_gaussian`).

    Args:
        actor: A `ProbabilisticActor` with a `MixedAction` or a `TanhNormal`.
        loss_name: Name for error messages.
        continuous_only: Whether to reject categorical heads.
        action_spec: Spec of the environment's action, which is checked against the actor; None for no check.

    Raises:
        ValueError: If the loss does not support the actor's distribution, its bounds or the action spec.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        loss_name: str,
        *,
        continuous_only: bool,
        action_spec: TensorSpec | None = None,
    ) -> None:
        head = actor[-1] if isinstance(actor, ProbabilisticTensorDictSequential) else None
        kind = getattr(head, "distribution_class", None)
        if not (isinstance(head, ProbabilisticTensorDictModule) and isinstance(kind, type)):
            raise ValueError(
                f"{loss_name} needs a ProbabilisticActor, got {type(actor).__name__}: build it with "
                "make_gaussian_actor or make_mixed_actor"
            )
        options: dict[str, Any] = dict(head.distribution_kwargs)
        for name, bound in (("low", -1.0), ("high", 1.0)):
            if bool((torch.as_tensor(options.get(name, bound)) != bound).any()):
                raise ValueError(
                    f"{loss_name} serves actions in [-1, 1], but the actor has {name}={options[name]}: rescale actions "
                    "in the environment instead (torchrl.envs.ActionScaling)"
                )
        if issubclass(kind, MixedAction):
            heads = options.get("heads")
        elif issubclass(kind, TanhNormal) and not options.get("tanh_loc", False):
            heads = None  # axes only, counted in the first call
        else:
            raise ValueError(
                f"{loss_name} serves positive-part categorical heads and tanh-Gaussian axes (without tanh_loc), not "
                f"{kind.__name__}: build the actor with make_gaussian_actor or make_mixed_actor"
            )
        categorical = heads.categorical if heads is not None else ()
        if continuous_only and categorical:
            raise ValueError(
                f"{loss_name} serves continuous actions only, but the actor has categorical heads {categorical}: "
                "use CatRACLoss, RACLoss or CategoricalSACLoss"
            )
        _check_spec(action_spec, loss_name, heads)
        self._heads: ActionHeads | None = heads
        names = getattr(head, "dist_keys", head.in_keys)
        self._parameters = list(zip(names, head.in_keys, strict=True))
        # Shares the actor's modules, so that parameters replaced in the actor are used here.
        self.body = TensorDictSequential(*cast(Any, actor.module)[:-1])

    def read(self, tensordict: TensorDictBase) -> MixedAction:
        """Return the distribution at the states of `tensordict`, which is not changed."""
        outputs = self.body(tensordict.select(*self.body.in_keys, strict=False))
        parameters = {name: outputs.get(key) for name, key in self._parameters}
        if self._heads is None:
            self._heads = ActionHeads(axes=parameters["loc"].shape[-1])
        return MixedAction(**parameters, heads=self._heads)


def _check_spec(spec: TensorSpec | None, loss_name: str, heads: ActionHeads | None) -> None:
    if spec is None:
        return
    categorical = heads.categorical if heads is not None else ()
    if isinstance(spec, MixedActionSpec):
        if spec.heads != heads:
            raise ValueError(
                f"{loss_name}: the environment's action is {spec.heads}, the actor's is "
                f"{heads or 'tanh-Gaussian axes alone'}: expected make_mixed_actor with the environment's heads (in a "
                "recipe network=gamepad with network.actor.heads)"
            )
    elif not spec.dtype.is_floating_point or categorical:
        raise ValueError(
            f"{loss_name} cannot serve the action spec {type(spec).__name__}(shape={tuple(spec.shape)}, "
            f"dtype={spec.dtype}) with an actor of {heads or 'tanh-Gaussian axes'}: give the environment the spec "
            "ActionHeads(...).spec(), or a Bounded one for continuous actions"
        )

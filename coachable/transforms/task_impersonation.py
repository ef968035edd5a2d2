"""`TaskImpersonation`, which relabels sampled transitions with further styles (paper, Task Impersonation)."""

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from coachable.keys import STYLE, STYLE_FEATURES, STYLE_REWARD, TABLE, TASK_REWARD
from coachable.ranges import AMOUNT
from coachable.styles.reward import StyleReward
from coachable.styles.samplers import Sampler


class TaskImpersonation(Transform):
    """Replay transform from `[B]` to `[B, n+1]` that adds n newly drawn styles to every transition.

    Column 0 keeps the stored style and reward. Each of the columns 1 to n gets a style that is drawn independently for
    every transition from the training distribution, and `reward = task_reward + style_reward(style_features, style)`.
    `style` and `("next", "style")` are both written, and `style_reward` if the data has it. Nothing is filtered,
    weighted or written back (paper). Other entries are expanded without a copy, so do not write to them in place. With
    n = 0 the sample is returned unchanged, and no random number is drawn.

    TorchRL expands `index`, `table` and `priority_weight` of a sample over the columns if it has one dimension: not
    with `SliceSampler` or storages of several dimensions. A priority update uses the largest priority of a transition's
    columns (`EventTableBuffer`, or the default reduction of TorchRL's buffers).

    Transitions of several steps can be relabelled only if the style reward is linear in the features; others raise. The
    buffer must then sum the features as well (`discounted_keys` of `EventTableBuffer`).

    Args:
        style_reward: The environment's style reward, from the sampler of whose space the styles are drawn.
        n: Number of further styles per transition (paper: 4).
        seed: Seed of the transform's own generator, whose state is in the state dict.
        tables: Samplers by the number of a table of `EventTableBuffer` (ours). Column 1 of a transition from such a
            table is drawn from the table's sampler, so that what led to an event is relabelled with a style that asks
            for the event. Without it, with 18 styles one label in 20 asks for it.

    Raises:
        ValueError: If n is negative, or a sampler of a table draws styles of another size.

    Examples:
        >>> from tensordict import TensorDict
        >>> from coachable.styles import StyleSpace, Weight, WeightedFeature
        >>> space = StyleSpace([Weight("fuel", 0.0, 1.0)])
        >>> relabel = TaskImpersonation(StyleReward(space, {"fuel": WeightedFeature("fuel", 0)}), n=2)
        >>> one = torch.ones(8, 1)
        >>> nxt = {"task_reward": one, "style_features": one, "reward": 2 * one, "style": one}
        >>> batch = relabel(TensorDict({"style": one, "next": nxt}, [8]))
        >>> batch.shape, bool((batch["next", "reward"] == 1 + batch["style"]).all())
        (torch.Size([8, 3]), True)
    """

    def __init__(
        self, style_reward: StyleReward, n: int = 4, seed: int = 0, tables: Mapping[int, Sampler] | None = None
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        AMOUNT.check("n of TaskImpersonation", n)
        self.style_reward = style_reward
        self.space = style_reward.space
        self.n = int(n)
        self.tables = dict(tables or {})
        for each in self.tables.values():
            if each.dim != self.space.dim:
                raise ValueError(
                    f"a sampler of TaskImpersonation's tables draws styles of {each.dim} numbers: expected "
                    f"{self.space.dim} ({', '.join(self.space.names)})"
                )
        self.generator = torch.Generator().manual_seed(seed)
        self._checked = False

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabel a sample.

        Args:
            tensordict: Transitions `[...]` with style, features and task reward.

        Returns:
            A new tensordict `[..., n+1]`, or the input itself for n = 0.

        Raises:
            KeyError: If an entry is missing.
            ValueError: If the stored style has another size than the space, transitions sum several steps and the style
                reward is not linear in the features, or stored rewards are not the sum of task and style reward.
        """
        if not self.n:
            return tensordict
        self._refuse_sums(tensordict)
        stored, features, task_reward, reward = self._entries(tensordict)
        if not self._checked and reward.numel():
            self._checked = True
            self._check_reward(task_reward + self.style_reward(features, stored), reward)
        shape = tensordict.batch_size
        # Batches of one, because `Shared` gives several rows of a batch the same style.
        drawn = self.space.sampler.sample((*shape, self.n, 1), self.generator, stored.device).squeeze(-2)
        table = tensordict.get(TABLE, None)
        if self.tables and table is None:
            raise KeyError(
                f"TaskImpersonation with tables found no {TABLE!r} in the sample: expected an EventTableBuffer"
            )
        for number, sampler in self.tables.items():
            rows = (table == number).nonzero(as_tuple=True)
            drawn[(*rows, 0)] = sampler.sample((len(rows[0]),), self.generator, stored.device)
        dim = len(shape)
        style_reward = self.style_reward(features.unsqueeze(dim).expand(*shape, self.n, -1), drawn)

        columns = self.n + 1
        out = tensordict.unsqueeze(dim).expand(*shape, columns)
        out.set(STYLE, torch.cat([stored.unsqueeze(dim), drawn], dim))
        following = tensordict.get(("next", STYLE), None)
        following = stored if following is None else following
        out.set(("next", STYLE), torch.cat([following.unsqueeze(dim), drawn], dim))
        relabelled = task_reward.unsqueeze(dim) + style_reward
        out.set(("next", "reward"), torch.cat([reward.unsqueeze(dim), relabelled], dim))
        logged = tensordict.get(("next", STYLE_REWARD), None)
        if logged is not None:
            out.set(("next", STYLE_REWARD), torch.cat([logged.unsqueeze(dim), style_reward], dim))
        return out

    def _refuse_sums(self, tensordict: TensorDictBase) -> None:
        steps = tensordict.get("steps_to_next_obs", None)
        if steps is None or steps.max() <= 1:
            return
        sums = f"TaskImpersonation got sums over up to {int(steps.max())} steps"
        if not self.style_reward.is_linear:
            raise ValueError(
                f"{sums}: the style reward is not linear in its features, so that another style's reward does not "
                "follow from their sum. Store single steps (n_steps=1), or give TaskImpersonation n=0."
            )
        if ("next", "original_reward") in tensordict.keys(True):
            raise ValueError(
                f"{sums} from TorchRL's MultiStep, which sums no style features: let EventTableBuffer sum rewards and "
                "features (n_steps, discounted_keys)"
            )

    def _entries(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        wanted = (STYLE, ("next", STYLE_FEATURES), ("next", TASK_REWARD), ("next", "reward"))
        found = [tensordict.get(key, None) for key in wanted]
        missing = [key for key, value in zip(wanted, found, strict=True) if value is None]
        if missing:
            raise KeyError(
                f"TaskImpersonation found no {', '.join(map(repr, missing))} in the sample: store them. "
                "An n-step buffer keeps features only if discounted_keys lists them."
            )
        stored, features, task_reward, reward = found
        if stored.shape[-1] != self.space.dim:
            raise ValueError(
                f"the sampled {STYLE!r} has shape {tuple(stored.shape)}: expected {self.space.dim} numbers "
                f"({', '.join(self.space.names)}). Give TaskImpersonation the space that the data was collected with."
            )
        return stored, features, task_reward, reward

    def _check_reward(self, expected: Tensor, reward: Tensor) -> None:
        """Refuse rewards that something else has changed, since new labels would have rewards of another scale."""
        if not torch.allclose(expected, reward.to(expected.dtype), rtol=1e-3, atol=1e-3):
            worst = int((expected - reward).abs().argmax())
            raise ValueError(
                f"a stored reward is {reward.flatten()[worst]:g}, but task_reward + style_reward is "
                f"{expected.flatten()[worst]:g}. TaskImpersonation needs the environment's style reward, and no "
                "transform after StyleRewardTransform that changes rewards, such as RewardScaling or VecNorm"
            )

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "TaskImpersonation relabels replay samples: give it to a replay buffer (transform= or append_transform), "
            "not to an environment"
        )

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the state of the generator, for `state_dict`."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restore the generator from `state_dict`."""
        self.generator.set_state(state["generator"].cpu().clone())

    def extra_repr(self) -> str:
        """Return the number of styles per transition, for `repr`."""
        return f"n={self.n}"

"""`StyleSampler`, which draws a style at every reset, and `CoachableEnv`, an environment with styles."""

import secrets
import zlib
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

from coachable.keys import STYLE
from coachable.styles.reward import StyleReward
from coachable.styles.space import StyleSpace
from coachable.transforms.style_reward import StyleRewardTransform

_MASK = (1 << 64) - 1


def derive_seed(seed: int, salt: str) -> int:
    """Combine a seed with the name of a stream to a seed below 2^63, so that streams are independent.

    The bits are mixed by the finaliser of splitmix64 (Steele et al. 2014).
    """
    z = (int(seed) * 0x9E3779B97F4A7C15 + zlib.crc32(salt.encode())) & _MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
    return (z ^ (z >> 31)) >> 1  # torch needs a seed below 2^63


class StyleSampler(Transform):
    """Environment transform that draws theta at reset and copies it from step to step.

    The style is stored only in the tensordict. If you write another `style` before a step, it is used from that step
    on. A partial reset changes it only in the environments that are reset. The style after a reset is the caller's
    (`env.reset(TensorDict({"style": theta}, [N]))`), or otherwise the one set by `hold`, or otherwise a new draw.

    Args:
        space: Style space, from whose sampler the styles are drawn.
        seed: Seed of this transform's generator; None for one from the operating system, so that workers differ.
            `CoachableEnv.set_seed` also sets it.
    """

    def __init__(self, space: StyleSpace, seed: int | None = None) -> None:
        super().__init__(in_keys=[], out_keys=[STYLE])
        self.space = space
        self.generator = torch.Generator()
        self._held: Tensor | None = None
        self._seeded = False
        self.set_seed(seed)

    def set_seed(self, seed: int | None = None) -> None:
        """Set the seed of the generator; None for one from the operating system."""
        self._seeded = seed is not None
        # Otherwise the styles would correlate with the start states of an environment that has the same seed.
        self.generator.manual_seed(secrets.randbits(63) if seed is None else derive_seed(seed, f"style:{STYLE}"))

    def hold(self, theta: Tensor, strict: bool = False) -> None:
        """Use a style at every reset, including automatic ones, until `release`; running episodes keep theirs.

        Args:
            theta: Style `(dim,)` for all environments, or one for each `(*batch, dim)`.
            strict: Whether to raise instead of clamping to the trained range with a warning.

        Raises:
            ValueError: If the shape is wrong, a value is NaN, or theta is out of range with `strict`.
        """
        self._held = self.space.clamp(theta.detach(), strict=strict)

    def release(self) -> None:
        """Draw styles again from the next reset on."""
        self._held = None

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # Styles for all rows, of which TorchRL keeps only those that are reset.
        given = tensordict.get(STYLE, None)
        shape, device = tensordict_reset.batch_size, tensordict_reset.device
        if given is not None:
            style = self._checked(given)
        elif self._held is not None:
            style = self._held.to(device).expand(*shape, self.space.dim).clone()
        else:
            style = self.space.sampler.sample(shape, self.generator, device)
        return tensordict_reset.set(STYLE, style)

    def _checked(self, given: Tensor) -> Tensor:
        """Return a copy of the caller's style, which may lie outside the trained range."""
        if given.shape[-1] != self.space.dim or bool(given.isnan().any()):
            raise ValueError(
                f"reset got the style {given.tolist()}: expected (..., {self.space.dim}) numbers, none of them NaN, "
                f"for {list(self.space.names)}."
            )
        return given.to(torch.float32, copy=True)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        style = tensordict.get(STYLE, None)
        if style is None:
            raise KeyError(
                f"step got no {STYLE!r}: call reset first, and keep the key in the tensordict (CatTensors removes what "
                "it joins unless del_keys=False)"
            )
        # A copy, so that changing the next style in place does not change this transition's.
        return next_tensordict.set(STYLE, style.clone())

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        raise NotImplementedError(
            "StyleSampler does not follow simulators that reset themselves inside step (TorchRL's native_autoreset): "
            "episodes would keep the style of the one before. Build the environment with native_autoreset=False."
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the style, with the space's bounds."""
        shape = torch.Size((*observation_spec.shape, self.space.dim))
        device = observation_spec.device
        low, high = self.space.low.to(device).expand(shape), self.space.high.to(device).expand(shape)
        observation_spec[STYLE] = Bounded(low, high, shape=shape, dtype=torch.float32, device=device)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Add the style, because otherwise a style given at reset would be ignored."""
        return self.transform_observation_spec(state_spec)

    def get_extra_state(self) -> Tensor:
        """Return the state of the generator, `(bytes,)` uint8, for `state_dict`."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator from the result of `get_extra_state`, `(bytes,)` uint8."""
        self.generator.set_state(state.to("cpu", torch.uint8))
        self._seeded = True

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        state["generator"] = state["generator"].get_state()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        generator_state = state.pop("generator")
        super().__setstate__(state)
        self.generator = torch.Generator()
        if self._seeded:
            self.generator.set_state(generator_state)
        else:  # copies in workers must not draw the same styles
            self.set_seed(None)


class CoachableEnv(TransformedEnv):
    """`TransformedEnv` whose `set_seed` also seeds its transforms, which TorchRL's does not."""

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed the environment and its transforms.

        Seed an environment before you give it to a collector, whose constructor resets it.

        Args:
            seed: The seed.
            static_seed: Whether the next environment gets the same seed, as in TorchRL.

        Returns:
            Seed for the next environment.
        """
        following = super().set_seed(seed, static_seed=static_seed)
        for module in self.transform.modules():
            if hasattr(module, "set_seed"):
                module.set_seed(seed)  # type: ignore[operator]
        return following

    def hold_style(self, theta: Tensor, strict: bool = False) -> None:
        """Use a style at every reset until `release_style`; see `StyleSampler.hold`.

        Args:
            theta: Styles `(dim,)` or `(N, dim)`, not encoded.
            strict: Raise instead of clamping a style outside the range.
        """
        for sampler in self._samplers():
            sampler.hold(theta, strict)

    def release_style(self) -> None:
        """Draw styles again from the next reset on."""
        for sampler in self._samplers():
            sampler.release()

    def _samplers(self) -> list[StyleSampler]:
        samplers = [m for m in self.transform.modules() if isinstance(m, StyleSampler)]
        if not samplers:
            raise RuntimeError("this environment has no StyleSampler: build it with coachable_env(...) to hold styles.")
        return samplers


def coachable_env(
    base_env: EnvBase,
    space: StyleSpace,
    style_reward: StyleReward,
    *transforms: Transform,
    seed: int | None = None,
) -> CoachableEnv:
    """Add `StyleSampler`, `StyleRewardTransform` and any further transforms to an environment, in this order.

    Args:
        base_env: Environment that emits `task_reward` and `style_features` and does not use theta.
        space: Style space, from whose sampler the styles are drawn.
        style_reward: Style reward.
        *transforms: Further transforms, such as `StepCounter` or `RewardSum`.
        seed: Seed of the environment and its transforms; None does not seed them.

    Returns:
        The environment, ready for a collector.
    """
    styles = StyleSampler(space, seed=seed)
    chain = Compose(styles, StyleRewardTransform(style_reward), *transforms)  # pyright: ignore[reportCallIssue]
    env = CoachableEnv(base_env=base_env, transform=chain)
    if seed is not None:
        env.set_seed(seed)
    return env

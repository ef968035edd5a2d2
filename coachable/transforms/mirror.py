"""`MirrorSymmetry`: sampled transitions as their mirror image."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from coachable.ranges import SHARE


@dataclass(frozen=True)
class MirrorMap:
    """Mirror image of a vector: `mirrored[i] = sign[i] * vector[source[i]]`.

    Attributes:
        source: where each entry of the image comes from.
        sign: +1 or -1 each.
    """

    source: tuple[int, ...]
    sign: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check that mirroring twice changes nothing."""
        if len(self.source) != len(self.sign):
            raise ValueError(f"a mirror map needs as many signs as sources, got {len(self.sign)}, {len(self.source)}")
        for i, (j, sign) in enumerate(zip(self.source, self.sign, strict=True)):
            if self.source[j] != i or self.sign[j] != sign or abs(sign) != 1:
                raise ValueError(
                    f"entries {i} and {j} are not each other's mirror image: mirroring twice must be nothing"
                )

    @property
    def width(self) -> int:
        """Length of the vectors."""
        return len(self.source)


class MirrorSymmetry(Transform):
    """Replay transform that replaces a random part of the sampled transitions by their mirror image.

    For bodies and tasks that are symmetric, the image of a transition is as true as the transition, so that every
    experience teaches both sides, and neither the policy nor its gait prefers one. The paper does not use it.

    Args:
        maps: by key, in the order of the vector's entries; keys that are not named stay (rewards, flags, styles that
            mean the same on both sides).
        probability: share of mirrored transitions.
        seed: of the transform's own generator, whose state is in the state dict.

    Raises:
        ValueError: if the probability is none, or a vector's width is not its map's.

    Example:
        >>> from tensordict import TensorDict
        >>> swap = MirrorMap(source=(1, 0), sign=(-1, -1))
        >>> mirror = MirrorSymmetry({"action": swap}, probability=1.0)
        >>> mirror(TensorDict({"action": torch.tensor([[1.0, 2.0]])}, [1]))["action"]
        tensor([[-2., -1.]])
    """

    def __init__(self, maps: Mapping[NestedKey, MirrorMap], probability: float = 0.5, seed: int = 0) -> None:
        super().__init__(in_keys=[], out_keys=[])
        SHARE.check("probability of MirrorSymmetry", probability)
        self.probability = probability
        self.generator = torch.Generator().manual_seed(seed)
        self._maps = {
            key: (torch.tensor(mirror.source), torch.tensor(mirror.sign, dtype=torch.float32))
            for key, mirror in maps.items()
        }

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Mirrors a random part of a batch `[B]`."""
        shape = tensordict.batch_size
        chosen = torch.rand((*shape, 1), generator=self.generator) < self.probability
        result = tensordict.copy()
        for key, (source, sign) in self._maps.items():
            value = tensordict.get(key, None)
            if value is None:  # n-step transitions have no style features
                continue
            if value.shape[-1] != len(source):
                raise ValueError(f"{key!r} has {value.shape[-1]} entries, its mirror map {len(source)}")
            image = value.index_select(-1, source.to(value.device)) * sign.to(value)
            result.set(key, torch.where(chosen.to(value.device), image, value))
        return result

    def get_extra_state(self) -> Tensor:
        """State of the generator, for `state_dict`."""
        return self.generator.get_state()

    def set_extra_state(self, state: Any) -> None:
        """Restore the generator from `state_dict`."""
        self.generator.set_state(state.to("cpu", torch.uint8))

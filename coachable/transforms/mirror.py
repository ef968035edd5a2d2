"""`MirrorSymmetry`, which replaces sampled transitions by their mirror images."""

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
        source: Index of the source of each entry of the image.
        sign: Sign of each entry, +1 or -1.

    Raises:
        ValueError: If mirroring a vector twice would change it.
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
                    f"entries {i} and {j} are not each other's mirror image: expected a map that is its own inverse"
                )

    @property
    def width(self) -> int:
        """Number of entries of a vector."""
        return len(self.source)


class MirrorSymmetry(Transform):
    """Replay transform that replaces a random part of the sampled transitions by their mirror images.

    If body and task are symmetric, the image of a transition is a valid transition, so that the policy learns both
    sides from each and prefers neither. The paper does not use it.

    Args:
        maps: Maps by key. Other entries do not change, such as rewards and styles without a side.
        probability: Share of mirrored transitions.
        seed: Seed of the transform's own generator, whose state is in the state dict.

    Raises:
        ValueError: If `probability` is not in [0, 1].

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
        """Mirror a random part of a batch `[B]`.

        Raises:
            ValueError: If an entry and its map have different widths.
        """
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
        """Return the state of the generator, `(bytes,)` uint8, for `state_dict`."""
        return self.generator.get_state()

    def set_extra_state(self, state: Any) -> None:
        """Restore the generator from `state_dict`."""
        self.generator.set_state(state.to("cpu", torch.uint8))

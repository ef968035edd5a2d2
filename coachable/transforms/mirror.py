"""`MirrorSymmetry`, which replaces sampled transitions by their mirror images, and the maps that it needs."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from coachable.ranges import SHARE
from coachable.signals import Signal

_SIDE = re.compile("left|right")


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


def mirror_map(groups: Sequence[Signal], turned: Mapping[str, Sequence[str]]) -> MirrorMap:
    """Return the mirror map of adjacent blocks of an observation or an action, from the names of their entries.

    An entry whose name has "left" or "right" swaps with the entry of the same block whose name has the other, if there
    is one.

    Args:
        groups: The blocks, in order.
        turned: Patterns of the entries whose sign changes, by block. Every block needs an entry here, so that none is
            forgotten.

    Raises:
        ValueError: If it is not known how a block looks in the mirror.

    Example:
        >>> wheels = Signal("slip_angle", 2, "", ("front_left", "front_right"))
        >>> mirror_map([Signal("fuel", 1), wheels], {"fuel": (), "slip_angle": ("*",)})
        MirrorMap(source=(0, 2, 1), sign=(1.0, -1.0, -1.0))
    """
    source: list[int] = []
    sign: list[float] = []
    for group in groups:
        if group.name not in turned:
            raise ValueError(
                f"block {group.name!r} has no mirror image: expected one of {', '.join(turned)}. Add it to the "
                "domain's patterns, or set mirror=0"
            )
        first = len(source)
        entries = group.entries or tuple(f"{group.name} {index}" for index in range(group.width))
        for index, entry in enumerate(entries):
            other = _SIDE.sub(lambda side: "right" if side[0] == "left" else "left", entry, count=1)
            source.append(first + (entries.index(other) if other in entries else index))
            sign.append(-1.0 if any(fnmatchcase(entry, pattern) for pattern in turned[group.name]) else 1.0)
    return MirrorMap(tuple(source), tuple(sign))


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

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "MirrorSymmetry mirrors replay samples: give it to a replay buffer (transform= or append_transform), "
            "not to an environment"
        )

    def get_extra_state(self) -> Tensor:
        """Return the state of the generator, `(bytes,)` uint8, for `state_dict`."""
        return self.generator.get_state()

    def set_extra_state(self, state: Any) -> None:
        """Restore the generator from `state_dict`."""
        self.generator.set_state(state.to("cpu", torch.uint8))

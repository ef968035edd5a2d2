"""`StyleView`: theta by name, as reward terms see it."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from coachable.styles.space import StyleSpace


class StyleView(Mapping[str, Tensor]):
    """Named, lazily sliced columns of theta.

    `view["step_length"]` is `(...,)` for a `Weight` or `Setpoint` and `(..., n_options)` for a `Choice`. Slicing only
    what is read keeps a reward cheap in spaces of many parameters.
    """

    __slots__ = ("_space", "theta")

    def __init__(self, space: "StyleSpace", theta: Tensor) -> None:
        self._space = space
        self.theta = theta

    def __getitem__(self, name: str) -> Tensor:
        try:
            return self.theta[..., self._space.columns[name]]
        except KeyError:
            raise KeyError(f"no style parameter named {name}: expected {', '.join(self)}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._space.names)

    def __len__(self) -> int:
        return len(self._space.names)

    def block(self, names: tuple[str, ...]) -> Tensor:
        """Several parameters at once, in that order, `(..., sum of widths)`."""
        columns = self._space.columns_of(names)
        return self.theta if columns is None else self.theta[..., columns]

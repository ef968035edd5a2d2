"""`StyleView`: theta by name, as reward terms see it."""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from torch import Tensor

Columns: TypeAlias = slice | list[int] | None


class StyleView(Mapping[str, Tensor]):
    """Named, lazily sliced columns of theta.

    `view["step_length"]` is `(...,)` for a `Weight` or `Setpoint` and `(..., n_options)` for a `Choice`. Slicing only
    what is read keeps a reward cheap in spaces of many parameters.

    Args:
        columns: Column of each parameter: an integer, or a slice for a `Choice`.
        columns_of: Columns of several parameters at once, None for all of theta; see `StyleSpace.columns_of`.
        theta: `(..., dim)`, raw.
    """

    __slots__ = ("_columns", "_columns_of", "theta")

    def __init__(
        self,
        columns: Mapping[str, int | slice],
        columns_of: Callable[[tuple[str, ...]], Columns],
        theta: Tensor,
    ) -> None:
        self._columns, self._columns_of = columns, columns_of
        self.theta = theta

    def __getitem__(self, name: str) -> Tensor:
        try:
            return self.theta[..., self._columns[name]]
        except KeyError:
            raise KeyError(f"no style parameter named {name}: expected {', '.join(self)}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def block(self, names: tuple[str, ...]) -> Tensor:
        """Several parameters at once, in that order, `(..., sum of widths)`."""
        columns = self._columns_of(names)
        return self.theta if columns is None else self.theta[..., columns]

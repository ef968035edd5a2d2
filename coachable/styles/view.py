"""`StyleView`, a mapping of names to columns of theta, for reward terms."""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from torch import Tensor

Columns: TypeAlias = slice | list[int] | None


class StyleView(Mapping[str, Tensor]):
    """Mapping of parameter names to columns of theta.

    `view["step_length"]` is `(...,)` for a `Weight` or `Setpoint` and `(..., n_options)` for a `Choice`. Columns are
    sliced lazily, so that a reward is fast in spaces of many parameters.

    Args:
        columns: Column of each parameter: an integer, or a slice for a `Choice`.
        columns_of: Returns the columns of several parameters, see `StyleSpace.columns_of`.
        theta: Styles `(..., dim)`, not encoded.
    """

    __slots__ = ("_columns", "_columns_of", "theta")

    def __init__(
        self, columns: Mapping[str, int | slice], columns_of: Callable[[tuple[str, ...]], Columns], theta: Tensor
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
        """Return the columns of several parameters in that order, `(..., sum of widths)`."""
        columns = self._columns_of(names)
        return self.theta if columns is None else self.theta[..., columns]

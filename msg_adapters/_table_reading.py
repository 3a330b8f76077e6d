"""Reading a PointCloud2 as a table: its columns are looked at in place, by a plan made once for each field list."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from msg_adapters._table import CODES, WORD, cov_name, upper_pairs
from msg_adapters.arrays import Floats, MessageError

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2

#: How many missing fields an error names.
NAMED_MISSING = 8
#: How many of the present ones.
NAMED_PRESENT = 40
_DTYPES = {order: {code: np.dtype(order + code) for code in CODES.values()} for order in "<>"}


class Signature(NamedTuple):
    """What a plan depends on; hashable."""

    fields: tuple[tuple[str, int, int, int], ...]  # name, offset, datatype, count
    point_step: int


_PLACE = operator.attrgetter("name", "offset", "datatype", "count")


def signature(msg: PointCloud2) -> Signature:
    """Return the layout of a cloud's points."""
    return Signature(tuple(map(_PLACE, msg.fields)), msg.point_step)


class Column(NamedTuple):
    """Where a scalar field stands in a row, and its type (a value of CODES)."""

    name: str
    offset: int
    code: str


class Block(NamedTuple):
    """Columns which are read together as a matrix of doubles.

    `words` holds the index of each in a row seen as 8-byte words, when all are aligned doubles.
    """

    columns: tuple[Column, ...]
    words: NDArray[np.intp] | None


class Fields:
    """The fields of a cloud by name, with the checks of those which are wanted."""

    def __init__(self, sig: Signature) -> None:
        self._step = sig.point_step
        self._by_name: dict[str, tuple[int, int, int]] = {}
        self._repeated: set[str] = set()
        for name, *place in sig.fields:
            if name in self._by_name:
                self._repeated.add(name)
            self._by_name[name] = (place[0], place[1], place[2])

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __str__(self) -> str:
        """Name the first fields."""
        names = ", ".join(itertools.islice(self, NAMED_PRESENT))
        return names + (", ..." if len(self._by_name) > NAMED_PRESENT else "") or "no fields"

    def require(self, names: Iterable[str], note: str = "") -> None:
        """Raise `missing_field`, naming those of `names` (lazily read) that are absent."""
        missing = list(itertools.islice((n for n in names if n not in self), NAMED_MISSING))
        if missing:
            raise MessageError(
                "missing_field",
                f"The cloud must have the fields {', '.join(missing)}{note}. Got {self}.",
            )

    def column(self, name: str, count: int = 1) -> Column:
        """Find a field of `count` values.

        Raises
        ------
        MessageError    `bad_field`: given twice, wrong count, unknown datatype; `wrong_data_length`: it
                        does not fit the point
        """
        offset, datatype, got = self._by_name[name]
        if name in self._repeated:
            raise MessageError("bad_field", f"The field '{name}' must be given once. Got it more than once.")
        if got != count:
            raise MessageError("bad_field", f"The field '{name}' must have the count {count}. Got {got}.")
        if datatype not in CODES:
            raise MessageError("bad_field", f"The field '{name}' must have a datatype from 1 to 8. Got {datatype}.")
        code = CODES[datatype]
        if offset + count * int(code[1]) > self._step:
            raise MessageError(
                "wrong_data_length",
                f"The field '{name}' must end within the point_step of {self._step} bytes. Got {count} x {code} at "
                f"offset {offset}.",
            )
        return Column(name, offset, code)

    def optional(self, name: str) -> Column | None:
        """Find a scalar field, or None."""
        return self.column(name) if name in self else None

    def block(self, names: Iterable[str]) -> Block:
        """Find scalar fields to be read together."""
        columns = tuple(self.column(n) for n in names)
        aligned = self._step % WORD == 0 and all(c.code == "f8" and c.offset % WORD == 0 for c in columns)
        return Block(columns, np.array([c.offset // WORD for c in columns], np.intp) if aligned else None)

    def covariance(self, axes: Sequence[str], note: str = "") -> Block:
        """Find the covariance, n*n names row by row, each pair under either order of its axes.

        Raises
        ------
        MessageError    `missing_field`; `bad_field` when one name stands for two pairs of axes
        """
        named = {pair: self._pair_name(*pair) for pair in upper_pairs(axes)} if self._enough(len(axes)) else {}
        self.require((named.get(p) or self._pair_name(*p) for p in upper_pairs(axes)), note)
        if len(set(named.values())) < len(named):
            raise MessageError("bad_field", f"Covariance names must be distinct. Axes {', '.join(axes)} share some.")
        both = named | {(b, a): name for (a, b), name in named.items()}
        return self.block(both[a, b] for a in axes for b in axes)

    def _enough(self, size: int) -> bool:
        """Whether there are fields enough for a covariance: a hostile field list shall not cost its square."""
        return len(self._by_name) >= size * (size + 1) // 2

    def _pair_name(self, a: str, b: str) -> str:
        return cov_name(b, a) if cov_name(a, b) not in self and cov_name(b, a) in self else cov_name(a, b)


class Rows:
    """The rows of a cloud, read in place.

    Raises
    ------
    MessageError    `wrong_data_length`: data, row_step, point_step, width and height do not fit
    """

    def __init__(self, msg: PointCloud2) -> None:
        height, width, step, row_step = msg.height, msg.width, msg.point_step, msg.row_step
        self._data = msg.data
        line = width * step
        # Rows of an organised cloud may be padded; a single row has nothing to be aligned with.
        if row_step != line if height == 1 else height > 1 and row_step < line:
            raise MessageError(
                "wrong_data_length", f"row_step must be width * point_step = {width} * {step} bytes. Got {row_step}."
            )
        if len(self._data) != row_step * height:
            raise MessageError(
                "wrong_data_length",
                f"data must have row_step * height = {row_step} * {height} bytes. Got {len(self._data)}.",
            )
        self.count = int(width * height)
        self._dtypes = _DTYPES[">" if msg.is_bigendian else "<"]
        self._step = step
        self._flat = row_step == line
        self._shape = (self.count,) if self._flat else (height, width)
        self._strides = (step,) if self._flat else (row_step, step)

    def column(self, column: Column, count: int | None = None) -> NDArray[Any]:
        """Return one field of all rows, (rows,), or (rows, count); may be a view of the message."""
        dtype = self._dtypes[column.code]
        inner = () if count is None else (count,)
        if self.count == 0:
            return np.empty((0, *inner), dtype)
        strides = self._strides if count is None else (*self._strides, dtype.itemsize)
        seen: NDArray[Any] = np.ndarray(self._shape + inner, dtype, self._data, column.offset, strides)
        return seen if self._flat else seen.reshape(self.count, *inner)

    def floats(self, column: Column) -> Floats:
        """Return a copy of one field as doubles, (rows,)."""
        return self.column(column).astype(np.float64)

    def integers(self, column: Column, dtype: type[np.generic], code: str) -> NDArray[Any]:
        """Return a copy of one field as integers of type `dtype`, (rows,); `code` is its exact wire type.

        Raises
        ------
        MessageError    `bad_field`: sent as another type, with a value that `dtype` cannot hold
        """
        got = self.column(column)
        if column.code == code:
            return got.astype(dtype)
        with np.errstate(invalid="ignore"):
            out = got.astype(dtype)
        if (out != got).any():
            worst = got[np.flatnonzero(out != got)[0]]
            raise MessageError("bad_field", f"The field '{column.name}' must hold integers ({code}). Got {worst}.")
        return out

    def matrix(self, block: Block) -> Floats:
        """Return a copy of a block, (rows, columns)."""
        if self.count == 0:
            return np.empty((0, len(block.columns)))
        if block.words is None or not self._flat:
            out = np.empty((self.count, len(block.columns)))
            for k, column in enumerate(block.columns):
                out[:, k] = self.column(column)
            return out
        words: NDArray[Any] = np.ndarray((self.count, self._step // WORD), self._dtypes["f8"], self._data)
        # The mode only spares numpy a buffer; every index is in range.
        return np.asarray(words.take(block.words, axis=1, mode="clip"), np.float64)

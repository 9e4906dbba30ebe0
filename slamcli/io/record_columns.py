"""Records as columns: values of a known type to arrays of numbers and bytes, and back.

The type decides what is read: numbers, texts, arrays, tuples, tables, and records of these by their
fields. Nothing in the arrays names a class or a function.
"""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from slamcli.core import arrays as array_types
from slamcli.core.arrays import AnyArray
from slamcli.core.geometry import Pose2

Value = TypeVar("Value")

_NUMBERS: dict[Any, str] = {bool: "|b1", int: "<i8", float: "<f8"}
_CASTS: dict[Any, Any] = {bool: bool, int: int, float: float}
# Of each array: its type, whether its columns are contiguous, its dimensions, and their lengths.
_MAX_DIMENSIONS = 3
_ARRAY_COLUMNS = 3 + _MAX_DIMENSIONS
# Types that some modules import for the annotations alone.
_NAMES = {**vars(array_types), "Pose2": Pose2}


def to_columns(kind: type[Value], value: Value) -> dict[str, AnyArray]:
    """Return the arrays of a value of a type; `from_columns` returns the same value."""
    columns: dict[str, AnyArray] = {}
    _write(kind, [value], "", columns)
    return columns


def from_columns(kind: type[Value], columns: Mapping[str, AnyArray]) -> Value:
    """Return the value of a type that its arrays have.

    Raises
    ------
    ValueError
        When they are not of such a value.
    """
    try:
        value: Value = _read(kind, 1, "", columns)[0]
    except (KeyError, IndexError, TypeError, OverflowError, MemoryError) as error:
        raise ValueError(f"its content is not as expected: {error!r}") from error
    return value


def _write(kind: Any, values: Sequence[Any], name: str, columns: dict[str, AnyArray]) -> None:
    """Add the columns of values of one type."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind in _NUMBERS:
        columns[name] = np.array(values, _NUMBERS[kind])
    elif kind is str or origin is Literal:
        _write_bytes([value.encode("utf-8", "surrogateescape") for value in values], name, columns)
    elif kind is bytes:
        _write_bytes(values, name, columns)
    elif _array_kinds(kind):
        _write_arrays(_array_kinds(kind), values, name, columns)
    elif origin in {Union, types.UnionType}:
        columns[f"{name}?"] = np.array([value is not None for value in values], "|b1")
        _write(_optional(parts), [value for value in values if value is not None], name, columns)
    elif origin in {dict, tuple, list}:
        _write_many(kind, values, name, columns)
    else:
        for field, part in _fields(kind).items():
            _write(part, [getattr(value, field) for value in values], f"{name}.{field}", columns)


def _write_many(kind: Any, values: Sequence[Any], name: str, columns: dict[str, AnyArray]) -> None:
    """Add the columns of tables and sequences."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is tuple and parts[1:] != (Ellipsis,):
        for place, part in enumerate(parts):
            _write(part, [value[place] for value in values], f"{name}.{place}", columns)
        return
    _write_lengths(values, name, columns)
    # Of a table, these are its keys.
    _write(parts[0], [one for value in values for one in value], f"{name}.item", columns)
    if origin is dict:
        every = [one for value in values for one in value.values()]
        _write(parts[1], every, f"{name}.value", columns)


def _read(kind: Any, count: int, name: str, columns: Mapping[str, AnyArray]) -> list[Any]:
    """Return `count` values of one type."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind in _NUMBERS:
        return list(map(_CASTS[kind], _column(columns, name, _NUMBERS[kind], count).tolist()))
    if kind is bytes:
        return _read_bytes(count, name, columns)
    if kind is str or origin is Literal:
        texts = [
            text.decode("utf-8", "surrogateescape") for text in _read_bytes(count, name, columns)
        ]
        if origin is Literal and not set(texts) <= set(parts):
            raise ValueError(f"{name} is none of {parts}")
        return texts
    if _array_kinds(kind):
        return _read_arrays(_array_kinds(kind), count, name, columns)
    if origin in {Union, types.UnionType}:
        present = _column(columns, f"{name}?", "|b1", count).tolist()
        found = iter(_read(_optional(parts), sum(present), name, columns))
        return [next(found) if there else None for there in present]
    if origin in {dict, tuple, list}:
        return _read_many(kind, count, name, columns)
    read = [_read(part, count, f"{name}.{field}", columns) for field, part in _fields(kind).items()]
    return [kind(*values) for values in zip(*read, strict=True)]


def _read_many(kind: Any, count: int, name: str, columns: Mapping[str, AnyArray]) -> list[Any]:
    """Return `count` tables or sequences."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is tuple and parts[1:] != (Ellipsis,):
        places = [_read(p, count, f"{name}.{n}", columns) for n, p in enumerate(parts)]
        return list(zip(*places, strict=True))
    lengths = _lengths(count, name, columns)
    items = iter(_read(parts[0], sum(lengths), f"{name}.item", columns))
    if origin is dict:
        values = iter(_read(parts[1], sum(lengths), f"{name}.value", columns))
        return [{next(items): next(values) for _ in range(length)} for length in lengths]
    return [origin(next(items) for _ in range(length)) for length in lengths]


@lru_cache
def _fields(kind: Any) -> dict[str, Any]:
    """Return a record's fields and their types."""
    if not is_dataclass(kind):
        raise TypeError(f"{kind} is no record")
    hints = get_type_hints(kind, localns=_NAMES)
    return {field: hints[field] for field in kind.__dataclass_fields__}


def _array_kinds(kind: Any) -> tuple[str, ...]:
    """Return the element types of an array type, or of a union of such; none of another type."""
    if get_origin(kind) in {Union, types.UnionType}:
        found = [_array_kinds(part) for part in get_args(kind)]
        return tuple(one for part in found for one in part) if all(found) else ()
    origin: Any = get_origin(kind)
    if origin is NDArray:  # a type alias of its own from numpy 2.5 on
        (scalar,) = get_args(kind)
    elif origin is np.ndarray:
        scalar = get_args(get_args(kind)[1])[0]
    else:
        return ()
    return (np.dtype(scalar).newbyteorder("<").str,)


def _optional(parts: tuple[Any, ...]) -> Any:
    """Return the type of what may be None."""
    (inner,) = (part for part in parts if part is not types.NoneType)
    return inner


def _write_arrays(
    kinds: tuple[str, ...], values: Sequence[AnyArray], name: str, columns: dict[str, AnyArray]
) -> None:
    rows, data = [], []
    for value in values:
        # The order in memory is kept: sums of products depend on it in their last bit.
        by_columns = value.flags.f_contiguous and not value.flags.c_contiguous
        shape = [*value.shape, *[1] * (_MAX_DIMENSIONS - value.ndim)]
        rows.append([kinds.index(value.dtype.str), by_columns, value.ndim, *shape])
        data.append(value.tobytes("F" if by_columns else "C"))
    columns[f"{name}.shape"] = np.array(rows, "<i8").reshape(-1, _ARRAY_COLUMNS)
    _write_bytes(data, name, columns)


def _read_arrays(
    kinds: tuple[str, ...], count: int, name: str, columns: Mapping[str, AnyArray]
) -> list[AnyArray]:
    rows = columns[f"{name}.shape"]
    if rows.shape != (count, _ARRAY_COLUMNS) or rows.dtype != "<i8" or rows.min(initial=0) < 0:
        raise ValueError(f"the shapes of {name} are wrong")
    found = []
    for (kind, by_columns, dimensions, *shape), data in zip(
        rows.tolist(), _read_bytes(count, name, columns), strict=True
    ):
        values = np.frombuffer(data, kinds[kind]).copy()
        order: Literal["F", "C"] = "F" if by_columns else "C"
        found.append(values.reshape(shape[:dimensions], order=order))
    return found


def _write_bytes(values: Sequence[bytes], name: str, columns: dict[str, AnyArray]) -> None:
    _write_lengths(values, name, columns)
    columns[name] = np.frombuffer(b"".join(values), "|u1")


def _read_bytes(count: int, name: str, columns: Mapping[str, AnyArray]) -> list[bytes]:
    ends = np.cumsum([0, *_lengths(count, name, columns)]).tolist()
    data = _column(columns, name, "|u1", ends[-1]).tobytes()
    return [data[start:end] for start, end in pairwise(ends)]


def _write_lengths(values: Sequence[Any], name: str, columns: dict[str, AnyArray]) -> None:
    columns[f"{name}#"] = np.array([len(value) for value in values], "<i8")


def _lengths(count: int, name: str, columns: Mapping[str, AnyArray]) -> list[int]:
    lengths = _column(columns, f"{name}#", "<i8", count)
    if lengths.min(initial=0) < 0:
        raise ValueError(f"a length of {name} is negative")
    return [int(length) for length in lengths]


def _column(columns: Mapping[str, AnyArray], name: str, kind: str, count: int) -> AnyArray:
    column = columns[name]
    if column.dtype != kind or column.shape != (count,):
        raise ValueError(f"{name} is {column.dtype} of shape {column.shape}")
    return column

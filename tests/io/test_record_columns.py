"""Records to columns and back; what is no such record is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2
from slamcli.io.array_file import read_arrays, write_arrays
from slamcli.io.record_columns import from_columns, to_columns

MAGIC = b"test 1\n"


@dataclass(frozen=True)
class Inner:
    pose: Pose2 | None
    kind: Literal["a", "b"]


@dataclass(frozen=True, eq=False)
class Record:
    number: int
    text: str
    data: bytes
    matrix: Float64Array
    either: UInt8Array | Float32Array
    pair: tuple[float, float]
    many: list[Inner]
    table: dict[tuple[int, int], list[int]]
    maybe: Float64Array | None


RECORD = Record(
    -5,
    "käse\udcff",
    b"\0x",
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.float32([1, 2]),
    (0.1, math.inf),
    [Inner(Pose2(1.0, 2.0, 3.0), "b"), Inner(None, "a")],
    {(1, 2): [3], (0, 1): []},
    None,
)


def test_a_record_comes_back_as_it_was_through_a_file(tmp_path: Path) -> None:
    path = tmp_path / "state"
    write_arrays(path, MAGIC, {"located": 3}, to_columns(Record, RECORD))
    header, columns = read_arrays(path, MAGIC)
    back = from_columns(Record, columns)
    assert header == {"located": 3}
    for name in ("number", "text", "data", "pair", "many", "table", "maybe"):
        assert getattr(back, name) == getattr(RECORD, name)
    assert list(back.table) == list(RECORD.table)
    assert back.matrix.flags.f_contiguous
    np.testing.assert_array_equal(back.matrix, RECORD.matrix)
    assert back.either.dtype == np.float32
    assert back.either.flags.writeable


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "state"
    write_arrays(path, MAGIC, {}, to_columns(Record, RECORD))
    whole = path.read_bytes()
    for number in range(0, len(whole), 37):
        for damaged in (whole[:number], whole[:number] + b"#" + whole[number + 1 :]):
            path.write_bytes(damaged)
            if damaged != whole:
                with pytest.raises(InputError, match="damaged"):
                    read_arrays(path, MAGIC)


def test_columns_that_are_no_such_record_are_refused() -> None:
    whole = to_columns(Record, RECORD)
    for name, column in whole.items():
        missing = {other: array for other, array in whole.items() if other != name}
        longer, other = np.concatenate([column, column[:1]]), column.astype(np.float32)
        for columns in (missing, {**whole, name: longer}, {**whole, name: other}):
            if not len(column) and columns.get(name) is longer:
                continue
            with pytest.raises(ValueError, match=r"wrong|is (float32|.* of shape)|not as expected"):
                from_columns(Record, columns)
    with pytest.raises(ValueError, match="none of"):
        from_columns(Record, {**whole, ".many.item.kind": np.frombuffer(b"zz", np.uint8)})

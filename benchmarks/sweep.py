"""Sweeps over cells of a benchmark: sharded, resumable, one row of a CSV file written a cell."""

from __future__ import annotations

import argparse
import csv
import fcntl
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2

Row = dict[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that all sweeps have."""
    parser.add_argument("--csv", type=Path, help="rows; the cells that it has are skipped")
    parser.add_argument("--shard", default="0/1", help="I/N: every N-th cell, from the I-th on")
    parser.add_argument("--limit", type=int, help="run this many cells at most")
    parser.add_argument("--summary", action="store_true", help="print what the rows say, run none")
    parser.add_argument("--reasons", action="store_true", help="print false links and lost frames")


def run(
    cells: Sequence[Any], measure: Callable[[Any], Row], arguments: argparse.Namespace
) -> list[dict[str, str]]:
    """Measure the cells of this shard that have no row yet; return all rows there are.

    Several shards may write one file at a time.

    Parameters
    ----------
    cells : sequence of dataclass
    measure : callable
        Of a cell to the columns of its result.
    """
    cv2.setNumThreads(1)
    shard, shards = map(int, arguments.shard.split("/"))
    path: Path | None = arguments.csv
    rows = read_rows(path)
    columns = list(asdict(cells[0]))
    done = {tuple(row[name] for name in columns) for row in rows}
    wanted = [c for c in cells[shard::shards] if tuple(map(str, asdict(c).values())) not in done]
    if arguments.summary:
        wanted = []
    for cell in wanted[: arguments.limit]:
        row = asdict(cell) | measure(cell)
        print(", ".join(f"{name} {value}" for name, value in row.items()), flush=True)
        rows.append({name: str(value) for name, value in row.items()})
        if path is not None:
            append_row(path, row)
    return rows if path is None else read_rows(path)


def read_rows(path: Path | None) -> list[dict[str, str]]:
    """Return the rows of a file; none where there is no file."""
    if path is None or not path.exists():
        return []
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def append_row(path: Path, row: Row) -> None:
    """Append a row, under a header where the file is new."""
    with path.open("a", newline="") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        writer = csv.DictWriter(stream, list(row))
        if stream.seek(0, 2) == 0:
            writer.writeheader()
        writer.writerow(row)


def total(rows: Sequence[dict[str, str]], column: str) -> int:
    """Return the sum of a column of whole numbers."""
    return sum(int(row[column]) for row in rows)


def share(part: int, whole: int) -> str:
    """Return a part of a whole in words."""
    return f"{part} of {whole} ({100.0 * part / whole:.2f} %)" if whole else "none of none"

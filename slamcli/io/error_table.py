"""A table of trajectories' errors, for spreadsheets (CSV) and papers (LaTeX)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence

from slamcli.core.trajectory import Evaluation

Row = Sequence[str | float]

_HEADER = (
    "trajectory",
    "poses",
    "not placed",
    "path (m)",
    "ATE rmse (mm)",
    "ATE median (mm)",
    "ATE largest (mm)",
    "heading rmse (deg)",
    "RPE rmse (mm)",
    "NEES",
)
_LATEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


def table_rows(found: Mapping[str, Evaluation]) -> list[Row]:
    """Return a row a trajectory, in the order of the header; nan where a value is not known."""
    rows: list[Row] = []
    for name, one in found.items():
        whole = one.whole
        nees = math.nan if whole.consistency is None else whole.consistency.nees
        rows.append(
            (
                *(name, whole.poses, one.unplaced, whole.path_metres),
                *(1000.0 * whole.absolute.rmse, 1000.0 * whole.absolute.median),
                *(1000.0 * whole.absolute.largest, whole.heading.rmse),
                *(1000.0 * whole.relative.rmse, nees),
            )
        )
    return rows


def _csv(rows: Sequence[Row]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_HEADER)
    writer.writerows([_text(value, "") for value in row] for row in rows)
    return stream.getvalue()


def _latex(rows: Sequence[Row]) -> str:
    """Return a table in the style of the package booktabs."""
    lines = [[name.translate(_LATEX) for name in _HEADER]]
    lines += [[_text(value, "--").translate(_LATEX) for value in row] for row in rows]
    head, *body = (" & ".join(cells) + r" \\" for cells in lines)
    columns = "l" + "r" * (len(_HEADER) - 1)
    return "\n".join(
        [
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            head,
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _text(value: str | float, unknown: str) -> str:
    if isinstance(value, float):
        return unknown if math.isnan(value) else f"{value:.4g}"
    return str(value)


TABLES: dict[str, Callable[[Sequence[Row]], str]] = {".csv": _csv, ".tex": _latex}

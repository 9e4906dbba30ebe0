"""`slam evaluate`: the errors of poses against true ones, as lines and as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slamcli.core.errors import InputError
from slamcli.core.trajectory import Accuracy, Evaluation, Statistics
from slamcli.io.trajectories import read_trajectory
from slamcli.stages.evaluation import evaluate as evaluate_poses


@dataclass(frozen=True, slots=True)
class EvaluateReport:
    """The errors as lines to print and as JSON.

    Attributes
    ----------
    lines : tuple of str
    json : str
    """

    lines: tuple[str, ...]
    json: str


def evaluate(poses: Path, truth: Path, *, tolerance_seconds: float, delta: int) -> EvaluateReport:
    """Compare a file of poses with a file of true ones, each in any format that can be read.

    Raises
    ------
    InputError
    """
    estimate, true = read_trajectory(poses), read_trajectory(truth)
    for path, trajectory in ((poses, estimate), (truth, true)):
        if not len(trajectory):
            raise InputError(f"{path} has no frame with a pose")
    found = evaluate_poses(estimate, true, tolerance_seconds=tolerance_seconds, delta=delta)
    return EvaluateReport(
        tuple(_lines(found)),
        json.dumps(_without_nan(asdict(found)), indent=2, ensure_ascii=False),
    )


def _lines(found: Evaluation) -> list[str]:
    lines = [
        f"{found.matched} poses of {found.truth_poses} true ones compared by {found.matched_by}; "
        f"{found.unplaced} frames not placed"
    ]
    if len(found.fragments) > 1:
        for part in found.fragments:
            lines += [f"fragment {part.fragment}", *_describe(part)]
        lines.append("all fragments, each aligned for itself")
    return [*lines, *_describe(found.whole)]


def _describe(part: Accuracy) -> list[str]:
    share = part.absolute_share_of_path
    of_path = "" if math.isnan(share) else f" ({share:.4%} of the path)"
    steps = "pose to pose" if part.delta == 1 else f"over {part.delta} poses"
    lines = [
        f"  path          {part.path_metres:.3f} m, {part.poses} poses",
        f"  ATE           {_statistics(part.absolute, ' mm', of_path)}",
        f"  heading       {_statistics(part.heading, '°')}",
        f"  RPE           {_statistics(part.relative, ' mm')}, {steps}",
        f"  RPE heading   {_statistics(part.relative_heading, '°')}, {steps}",
    ]
    if part.consistency is not None:
        lines.append(
            f"  NEES          {part.consistency.nees:.2f} (3 when the sigmas are honest), "
            f"{part.consistency.within_95_percent:.0%} of the poses within their 95 % bound"
        )
    return lines


def _statistics(errors: Statistics, unit: str, remark: str = "") -> str:
    if math.isnan(errors.rmse):
        return "too few poses"
    scale = 1000.0 if unit == " mm" else 1.0
    return (
        f"rmse {scale * errors.rmse:.4g}{unit}{remark}, mean {scale * errors.mean:.4g}{unit}, "
        f"median {scale * errors.median:.4g}{unit}, largest {scale * errors.largest:.4g}{unit}"
    )


def _without_nan(value: Any) -> Any:
    """Return the same with None in place of nan, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _without_nan(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and math.isnan(value) else value

"""How far poses are from the truth: absolute (SE2-aligned) and from frame to frame."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from slamcli.core.geometry import Pose2
from slamcli.core.robust import fit_rigid_2d


@dataclass(frozen=True)
class Accuracy:
    """Of one trajectory; lengths in metres, angles in degrees."""

    placed: int
    absolute_metres: float
    relative_metres: float
    relative_degrees: float
    worst_metres: float
    worst_degrees: float
    path_metres: float


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def read_poses(path: Path) -> dict[str, Pose2]:
    """Poses by frame name, of poses.csv or truth.csv."""
    return {
        row["frame"]: Pose2(float(row["x"]), float(row["y"]), float(row["heading"]))
        for row in read_rows(path)
        if row["x"]
    }


def compare(estimated: dict[str, Pose2], truth: dict[str, Pose2]) -> Accuracy:
    """The worst errors are without alignment: both start at the first frame."""
    names = [name for name in truth if name in estimated]
    ours, theirs = [estimated[name] for name in names], [truth[name] for name in names]
    places = np.array([(pose.x, pose.y) for pose in ours])
    true_places = np.array([(pose.x, pose.y) for pose in theirs])
    truth_from_map = fit_rigid_2d(true_places, places)
    aligned = np.linalg.norm(truth_from_map.apply(places) - true_places, axis=1)
    steps = [
        (t0.inverse() @ t1).inverse() @ (e0.inverse() @ e1)
        for (e0, e1), (t0, t1) in zip(pairwise(ours), pairwise(theirs), strict=True)
    ]
    raw = [t.inverse() @ e for e, t in zip(ours, theirs, strict=True)]
    return Accuracy(
        placed=len(names),
        absolute_metres=float(np.sqrt(np.mean(aligned**2))),
        relative_metres=float(np.sqrt(np.mean([s.translation_length**2 for s in steps]))),
        relative_degrees=float(np.degrees(np.sqrt(np.mean([s.theta**2 for s in steps])))),
        worst_metres=max(error.translation_length for error in raw),
        worst_degrees=float(np.degrees(max(abs(error.theta) for error in raw))),
        path_metres=sum((a.inverse() @ b).translation_length for a, b in pairwise(theirs)),
    )

"""Trajectory evaluation: ATE, RPE, and the consistency of the sigmas (NEES).

ATE and RPE as in Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012,
in the plane: the evo package gives the same numbers.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.errors import InputError
from slamcli.core.geometry import compose_poses, relative_poses
from slamcli.core.robust import fit_rigid_2d
from slamcli.core.trajectory import (
    Accuracy,
    Consistency,
    ErrorSeries,
    Evaluation,
    Statistics,
    Trajectory,
)

_MIN_ALIGNED = 2
_BOUND_95 = float(chdtri(3, 0.05))


def evaluate(
    estimate: Trajectory, truth: Trajectory, *, tolerance_seconds: float, delta: int
) -> Evaluation:
    """Compare two trajectories pose by pose, every fragment under its own alignment.

    Parameters
    ----------
    estimate, truth : Trajectory
    tolerance_seconds : float
        Largest difference of two stamps of the same moment.
    delta : int
        Over how many poses the relative motion is compared, at least 1.

    Raises
    ------
    InputError
        When the two have no moments in common, or nothing to find them by.
    """
    matched_by, ours, theirs = match_poses(estimate, truth, tolerance_seconds)
    numbers = estimate.fragments[ours]
    parts = []
    for fragment in np.unique(numbers):
        chosen = numbers == fragment
        poses, true_poses = estimate.poses[ours[chosen]], truth.poses[theirs[chosen]]
        sigmas = None if estimate.sigmas is None else estimate.sigmas[ours[chosen]]
        parts.append(_Errors(int(fragment), poses, true_poses, sigmas, delta))
    return Evaluation(
        matched_by,
        len(ours),
        len(truth),
        estimate.unplaced,
        _accuracy(None, parts, delta),
        tuple(_accuracy(part.fragment, [part], delta) for part in parts),
    )


def error_series(
    name: str, estimate: Trajectory, truth: Trajectory, tolerance_seconds: float
) -> ErrorSeries:
    """Return the errors along the truth's path; fragments of one pose have none.

    Raises
    ------
    InputError
        As `evaluate`.
    """
    _, ours, theirs = match_poses(estimate, truth, tolerance_seconds)
    order = np.argsort(theirs, kind="stable")
    ours, theirs = ours[order], theirs[order]
    steps = np.linalg.norm(np.diff(truth.poses[:, :2], axis=0, prepend=truth.poses[:1, :2]), axis=1)
    along, numbers = np.cumsum(steps)[theirs], estimate.fragments[ours]
    aligned = np.full((len(ours), 2), np.nan)
    errors, turns = np.full(len(ours), np.nan), np.full(len(ours), np.nan)
    for fragment in np.unique(numbers):
        chosen = numbers == fragment
        part = _Errors(
            int(fragment), estimate.poses[ours[chosen]], truth.poses[theirs[chosen]], None, 1
        )
        if part.count >= _MIN_ALIGNED:
            aligned[chosen], errors[chosen], turns[chosen] = (
                part.aligned,
                part.places,
                part.headings,
            )
    sigmas = np.full(len(ours), np.nan)
    if estimate.sigmas is not None:
        sigmas = np.hypot(*estimate.sigmas[ours, :2].T)
    return ErrorSeries(name, numbers, along, aligned, errors, turns, sigmas)


def match_poses(
    estimate: Trajectory, truth: Trajectory, tolerance_seconds: float
) -> tuple[str, Int64Array, Int64Array]:
    """Return by what poses were matched, and the indices of the pairs in both trajectories."""
    if estimate.stamps is not None and truth.stamps is not None:
        pairs = _nearest_pairs(estimate.stamps, truth.stamps, tolerance_seconds)
        if not len(pairs):
            spans = [f"{s.min():.3f} to {s.max():.3f} s" for s in (estimate.stamps, truth.stamps)]
            raise InputError(
                f"no stamps within {tolerance_seconds:g} s of one another: the poses span "
                f"{spans[0]}, the truth {spans[1]}"
            )
        return "stamps", pairs[:, 0], pairs[:, 1]
    if estimate.names is not None and truth.names is not None:
        index_of = {name: index for index, name in enumerate(truth.names)}
        common = [(i, index_of[name]) for i, name in enumerate(estimate.names) if name in index_of]
        if not common:
            raise InputError(
                f"no frame name in common: the poses begin with {estimate.names[0]}, "
                f"the truth with {truth.names[0]}"
            )
        pairs = np.array(common, dtype=np.int64)
        return "frame names", pairs[:, 0], pairs[:, 1]
    if len(estimate) != len(truth):
        raise InputError(
            f"{len(estimate)} poses and {len(truth)} true ones without stamps or names in common; "
            "only files of equal length can be compared row by row"
        )
    rows = np.arange(len(truth))
    return "order", rows, rows


class _Errors:
    """The errors of one fragment, each in an array; the absolute ones after alignment."""

    def __init__(
        self,
        fragment: int,
        poses: Float64Array,
        true_poses: Float64Array,
        sigmas: Float64Array | None,
        delta: int,
    ) -> None:
        self.fragment = fragment
        self.count = len(poses)
        self.truth_from_map = fit_rigid_2d(true_poses[:, :2], poses[:, :2])
        pose = self.truth_from_map
        aligned = compose_poses((pose.x, pose.y, pose.theta), poses)
        self.aligned = aligned[:, :2]
        self.places = np.linalg.norm(aligned[:, :2] - true_poses[:, :2], axis=1)
        self.headings = np.degrees(np.abs(relative_poses(true_poses, aligned)[:, 2]))
        if self.count < _MIN_ALIGNED:
            # An alignment by one pose has no error left, whatever that pose is.
            self.places = self.headings = np.empty(0)
        motions = relative_poses(poses[:-delta:delta], poses[delta::delta])
        true_motions = relative_poses(true_poses[:-delta:delta], true_poses[delta::delta])
        differences = relative_poses(true_motions, motions)
        self.steps = np.linalg.norm(differences[:, :2], axis=1)
        self.turns = np.degrees(np.abs(differences[:, 2]))
        self.path = float(np.linalg.norm(np.diff(true_poses[:, :2], axis=0), axis=1).sum())
        self.normalised = (
            np.empty(0) if sigmas is None else _normalised_errors(poses, true_poses, sigmas)
        )


def _accuracy(fragment: int | None, parts: list[_Errors], delta: int) -> Accuracy:
    path = sum(part.path for part in parts)
    absolute = _statistics([part.places for part in parts])
    normalised = np.concatenate([part.normalised for part in parts])
    consistency = None
    if len(normalised):
        within = float((normalised <= _BOUND_95).mean())
        consistency = Consistency(len(normalised), float(normalised.mean()), within)
    return Accuracy(
        fragment,
        sum(part.count for part in parts),
        path,
        absolute,
        absolute.rmse / path if path else math.nan,
        _statistics([part.headings for part in parts]),
        _statistics([part.steps for part in parts]),
        _statistics([part.turns for part in parts]),
        delta,
        None if fragment is None else parts[0].truth_from_map,
        consistency,
    )


def _statistics(parts: list[Float64Array]) -> Statistics:
    errors = np.concatenate(parts)
    if not len(errors):
        return Statistics(math.nan, math.nan, math.nan, math.nan)
    return Statistics(
        float(np.sqrt(np.mean(errors**2))),
        float(errors.mean()),
        float(np.median(errors)),
        float(errors.max()),
    )


def _normalised_errors(
    poses: Float64Array, true_poses: Float64Array, sigmas: Float64Array
) -> Float64Array:
    """Return the squared error over variance, summed over x, y, heading, of each pose but one.

    The map lies where its most certain pose is, so that pose is laid on its truth and left out. A
    best alignment would hide a part of the error.
    """
    known = np.flatnonzero(np.isfinite(sigmas).all(axis=1) & (sigmas > 0.0).all(axis=1))
    if len(known) < 2:
        return np.empty(0)
    anchor = known[int(np.argmin(np.sum(sigmas[known] ** 2, axis=1)))]
    rest = known[known != anchor]
    motions = relative_poses(true_poses[anchor], true_poses[rest])
    expected = compose_poses(poses[anchor], motions)
    error = poses[rest] - expected
    error[:, 2] = relative_poses(expected, poses[rest])[:, 2]
    summed: Float64Array = np.sum((error / sigmas[rest]) ** 2, axis=1)
    return summed


def _nearest_pairs(
    stamps: Float64Array, true_stamps: Float64Array, tolerance_seconds: float
) -> Int64Array:
    """Return (M, 2) indices of stamps nearest to one another, each used once, in time's order."""
    ours, theirs = np.argsort(stamps, kind="stable"), np.argsort(true_stamps, kind="stable")
    turned = len(theirs) < len(ours)
    few, many = (
        (true_stamps[theirs], stamps[ours]) if turned else (stamps[ours], true_stamps[theirs])
    )
    after = np.clip(np.searchsorted(many, few), 1, max(1, len(many) - 1))
    before = after - 1
    after = np.minimum(after, len(many) - 1)
    nearest = np.where(np.abs(many[after] - few) < np.abs(few - many[before]), after, before)
    distances = np.abs(many[nearest] - few)
    best: dict[int, int] = {}
    for index in np.flatnonzero(distances <= tolerance_seconds):
        rival = best.get(int(nearest[index]))
        if rival is None or distances[index] < distances[rival]:
            best[int(nearest[index])] = int(index)
    pairs = [
        (ours[other], theirs[index]) if turned else (ours[index], theirs[other])
        for other, index in best.items()
    ]
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)

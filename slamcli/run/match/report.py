"""The report of `slam match`: the measurements for a program, and lines for a reader."""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2, invert
from slamcli.core.records import FeatureAlignment
from slamcli.registration import RegistrationResult
from slamcli.run.inputs import Inputs
from slamcli.run.match.fitting import PairFit, PairImage


def measured_facts(
    inputs: Inputs, pictures: tuple[PairImage, PairImage], fit: PairFit
) -> dict[str, object]:
    """Return everything measured, by name, ready for JSON."""
    alignment = fit.alignment
    matrix = _second_from_first(pictures, fit)
    facts: dict[str, object] = {
        "first": str(inputs.files[0].path),
        "second": str(inputs.files[1].path),
        "fits": not fit.reason,
        "reason": fit.reason,
        "model": alignment.model,
        "unit": inputs.calibration.unit,
        "features": {
            "method": str(fit.recipe),
            "first": len(fit.first),
            "second": len(fit.second),
        },
        "matches": len(alignment.matches),
        "inliers": alignment.inlier_count,
        "residual_median": _number(alignment.median_residual),
        "residual_rms": _number(alignment.rms_residual),
        "spread": _number(alignment.spread),
        "correlation": _number(fit.correlation),
        "second_from_first": None if matrix is None else matrix.tolist(),
    }
    if fit.trial is not None:
        facts["search"] = _search_facts(fit.trial)
    if fit.obstacles is not None:
        facts["obstacles"] = {
            "cells": [int(np.count_nonzero(marks.unlike)) for marks in fit.obstacles],
            "compared_cells": [int(np.count_nonzero(marks.judged)) for marks in fit.obstacles],
            "inliers": fit.obstacle_inliers,
        }
    if matrix is not None and alignment.model in {"rigid", "similarity"}:
        facts["scale"] = math.hypot(matrix[0, 0], matrix[1, 0])
        facts["rotation_degrees"] = math.degrees(math.atan2(matrix[1, 0], matrix[0, 0]))
        facts["translation"] = [float(matrix[0, 2]), float(matrix[1, 2])]
    if alignment.pose is not None and alignment.covariance is not None:
        facts["first_from_second"] = _pose_facts(alignment.pose, alignment.covariance)
    return facts


def _second_from_first(pictures: tuple[PairImage, PairImage], fit: PairFit) -> Float64Array | None:
    """Return metres to metres, or for plain pictures pixel to pixel (x right, y down)."""
    first_from_second = fit.alignment.a_from_b
    if first_from_second is None:
        return None
    matrix = invert(first_from_second)
    first, second = pictures
    if first.calibration.unit == "px":
        matrix = (
            second.view.grid.pixel_from_metres @ matrix @ invert(first.view.grid.pixel_from_metres)
        )
    return np.asarray(matrix / matrix[2, 2])


def _search_facts(trial: RegistrationResult) -> dict[str, object]:
    return {
        "decided": trial.link is not None,
        "reason": trial.reason,
        "score": trial.score,
        "overlap": trial.overlap,
        "rival": _number(trial.rival),
        "confirmed_share": _number(trial.confirmed),
    }


def _pose_facts(pose: Pose2, covariance: Float64Array) -> dict[str, float]:
    sigmas = np.sqrt(np.diag(covariance))
    return {
        "x": pose.x,
        "y": pose.y,
        "heading_degrees": math.degrees(pose.theta),
        "sigma_x": float(sigmas[0]),
        "sigma_y": float(sigmas[1]),
        "sigma_heading_degrees": math.degrees(float(sigmas[2])),
    }


def _number(value: float) -> float | None:
    """Return the number, or None for nan and inf, which JSON does not have."""
    return value if math.isfinite(value) else None


def report_lines(facts: dict[str, object], fit: PairFit) -> list[str]:
    """Return the report for a reader; one line when nothing fits."""
    alignment = fit.alignment
    if fit.reason:
        return [f"no fit ({fit.recipe}, {alignment.model}): {fit.reason}"]
    unit = str(facts["unit"])
    method = str(fit.recipe) if fit.trial is None else "a search over the pixels"
    lines = [f"fit: {alignment.model}, by {method}", *_transform_lines(facts, alignment, unit)]
    if unit == "m" and alignment.pose is not None and alignment.covariance is not None:
        lines.append(_motion_line(alignment.pose, alignment.covariance))
    if fit.obstacles is not None and any(marks.unlike.any() for marks in fit.obstacles):
        lines.append(
            "something seems to stand on the floor (red in the drawing); inliers on it: "
            f"{fit.obstacle_inliers}"
        )
    if fit.trial is not None:
        return [*lines, *_search_lines(fit.trial, fit.correlation)]
    # Residuals are read in millimetres of floor, or in pixels.
    scale, short = (1000.0, "mm") if unit == "m" else (1.0, unit)
    return [
        *lines,
        f"{alignment.inlier_count} inliers of {len(alignment.matches)} matches "
        f"({len(fit.first)} and {len(fit.second)} features)",
        f"residual: median {alignment.median_residual * scale:.3f} {short}, "
        f"rms {alignment.rms_residual * scale:.3f} {short}; correlation {fit.correlation:.2f}",
    ]


def _transform_lines(facts: dict[str, object], alignment: FeatureAlignment, unit: str) -> list[str]:
    """Return the transform: its matrix, and scale, rotation and translation where it has them."""
    matrix = np.array(facts["second_from_first"])
    axes = "x ahead, y left of the robot" if unit == "m" else "x right, y down in the picture"
    lines = [f"second = M first, in {unit} ({axes})"]
    lines += [f"  [{row[0]:12.6f} {row[1]:12.6f} {row[2]:12.4f}]" for row in matrix[:2]]
    if alignment.model == "homography":
        lines.append(f"  [{matrix[2, 0]:12.4e} {matrix[2, 1]:12.4e} {matrix[2, 2]:12.4f}]")
    if "scale" in facts:
        lines.append(
            f"scale {facts['scale']:.4f}, rotation {facts['rotation_degrees']:.3f} degrees, "
            f"translation ({matrix[0, 2]:.3f}, {matrix[1, 2]:.3f}) {unit}"
        )
    return lines


def _motion_line(pose: Pose2, covariance: Float64Array) -> str:
    sigmas = np.sqrt(np.diag(covariance))
    return (
        f"the robot moved x {pose.x:.4f} m, y {pose.y:.4f} m and turned "
        f"{math.degrees(pose.theta):.3f} degrees (sigmas {sigmas[0] * 1000:.2f} mm, "
        f"{sigmas[1] * 1000:.2f} mm, {math.degrees(sigmas[2]):.4f} degrees)"
    )


def _search_lines(trial: RegistrationResult, correlation: float) -> list[str]:
    """Return how certain a motion found by the pixels is."""
    lines = [
        f"score {trial.score:.2f} (how likely it is right); correlation {correlation:.3f}, "
        f"overlap {trial.overlap:.0%}; the next best motion explains {trial.rival:.0%} of what "
        "this one does"
    ]
    if not math.isnan(trial.confirmed):
        lines.append(f"{trial.confirmed:.0%} of the floor's patches agree by themselves")
    return lines

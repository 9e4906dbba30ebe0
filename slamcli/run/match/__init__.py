"""`slam match`: one pair of pictures to the transform between them, or why nothing fits."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.config import FeatureMethod, FeatureOptions, MatchOptions, TransformModel
from slamcli.core.errors import InputError, OutputError
from slamcli.core.geometry import apply_homography, invert
from slamcli.drawing.correlation_surface import draw_surface
from slamcli.drawing.matches import draw_matches
from slamcli.drawing.obstacles import draw_obstacles
from slamcli.io.files import refuse_existing, write_image
from slamcli.registration import RegistrationResult
from slamcli.run.inputs import Inputs, open_inputs
from slamcli.run.match.fitting import (
    AUTO_FRONTS,
    FeatureRecipe,
    PairFit,
    PairImage,
    birdseye_picture,
    fit_pair,
    plain_picture,
    read_picture,
    search_pair,
)
from slamcli.run.match.obstacles import without_obstacles
from slamcli.run.networks import (
    NO_NETWORKS,
    NetworkFiles,
    with_match_network,
    with_point_network,
)
from slamcli.stages import view
from slamcli.stages.dense import ObstacleMask

PLAIN_RATIO = 0.8
DRAWING_SUFFIXES = (".png", ".jpg")
_MARGIN_GRAY = 245


@dataclass(frozen=True, slots=True)
class PairOptions:
    """What `slam match` was told.

    Attributes
    ----------
    features, matching
        Of the stages of those names, their method, count, model and ratio apart.
    method : str
        ``auto`` tries ORB and SIFT, on the pictures as they are and enlarged.
    count : int or None
        Most features a picture; None: 500, or what each front of ``auto`` takes.
    model : str or None
        None: rigid with a calibration, else similarity, which measures the scale.
    ratio : float or None
        None: as `matching` says with a calibration, else the stricter one for many features.
    networks : NetworkFiles
    """

    features: FeatureOptions
    matching: MatchOptions
    method: FeatureMethod | Literal["auto"] = "auto"
    count: int | None = None
    model: TransformModel | None = None
    ratio: float | None = None
    networks: NetworkFiles = NO_NETWORKS


@dataclass(frozen=True, slots=True)
class MatchReport:
    """What to tell the user.

    Attributes
    ----------
    lines : tuple of str
    json : str
        The same for a program.
    exit_code : int
        1 when nothing fits.
    """

    lines: tuple[str, ...]
    json: str
    exit_code: int


def match(
    first: Path,
    second: Path,
    calibration_path: Path | None,
    drawing: Path | None,
    options: PairOptions,
    *,
    overwrite: bool,
) -> MatchReport:
    """Fit a pair of pictures; with a calibration, their bird's-eye views in metres.

    Raises
    ------
    InputError, CalibrationError, OutputError
    """
    if drawing is not None:
        if drawing.suffix.lower() not in DRAWING_SUFFIXES:
            suffixes = " or ".join(DRAWING_SUFFIXES)
            raise OutputError(f"cannot draw {drawing}: name it {suffixes}")
        refuse_existing(drawing, overwrite=overwrite)
    inputs = open_inputs([first, second], calibration_path)
    if len(inputs.files) != 2:
        raise InputError(f"{first} and {second} must be two image files, not folders")
    pictures = _open(inputs)
    features, matching = _resolved(options, inputs)
    fit = fit_pair(*pictures, _fronts(options, inputs), features, matching)
    if fit.reason and inputs.calibration_path is not None and matching.model == "rigid":
        fit = search_pair(*pictures, fit)
    if inputs.calibration_path is not None:
        fit = without_obstacles(*pictures, fit, matching.min_inliers)
    facts = _facts(inputs, pictures, fit)
    note = inputs.note if inputs.calibration_path else "no calibration: pixel units"
    lines = [*([note] if note else []), *_lines(facts, fit)]
    if drawing is not None:
        write_image(drawing, _draw(pictures, fit, lines))
        lines.append(f"drawing: {drawing}")
    return MatchReport(
        tuple(lines), json.dumps(facts, indent=2, ensure_ascii=False), 1 if fit.reason else 0
    )


def _open(inputs: Inputs) -> tuple[PairImage, PairImage]:
    frames = [read_picture(file) for file in inputs.files]
    if inputs.calibration_path is None:
        return plain_picture(frames[0]), plain_picture(frames[1])
    calibration = inputs.calibration
    scale = view.registration_metres_per_pixel(calibration)
    return (
        birdseye_picture(frames[0], calibration, scale),
        birdseye_picture(frames[1], calibration, scale),
    )


def _fronts(options: PairOptions, inputs: Inputs) -> tuple[FeatureRecipe, ...]:
    if options.method != "auto":
        return (FeatureRecipe(options.method, 1, options.count),)
    # A bird's-eye view has its scale already; enlarging it would add nothing.
    plain = inputs.calibration_path is None
    fronts = (front for front in AUTO_FRONTS if plain or front.enlargement == 1)
    return tuple(replace(front, count=options.count or front.count) for front in fronts)


def _resolved(options: PairOptions, inputs: Inputs) -> tuple[FeatureOptions, MatchOptions]:
    plain = inputs.calibration_path is None
    model: TransformModel = options.model or ("similarity" if plain else "rigid")
    ratio = options.ratio or (PLAIN_RATIO if plain else options.matching.ratio)
    matching = with_match_network(options.matching, options.networks, options.method)
    if model != "rigid":
        matching = replace(matching, max_size_ratio=None)
    return (
        with_point_network(options.features, options.networks, options.method),
        replace(matching, model=model, ratio=ratio),
    )


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


def _facts(
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
        "features": {"method": str(fit.front), "first": len(fit.first), "second": len(fit.second)},
        "matches": len(alignment.matches),
        "inliers": alignment.inlier_count,
        "residual_median": _number(alignment.median_residual),
        "residual_rms": _number(alignment.rms_residual),
        "spread": _number(alignment.spread),
        "correlation": _number(fit.correlation),
        "second_from_first": None if matrix is None else matrix.tolist(),
    }
    if fit.trial is not None:
        facts["search"] = {
            "decided": fit.trial.link is not None,
            "reason": fit.trial.reason,
            "score": fit.trial.score,
            "overlap": fit.trial.overlap,
            "rival": _number(fit.trial.rival),
            "confirmed_share": _number(fit.trial.confirmed),
        }
    if fit.obstacles is not None:
        facts["obstacles"] = {
            "cells": [int(np.count_nonzero(marks.unlike)) for marks in fit.obstacles],
            "judged_cells": [int(np.count_nonzero(marks.judged)) for marks in fit.obstacles],
            "inliers": fit.obstacle_inliers,
        }
    if matrix is not None and alignment.model in {"rigid", "similarity"}:
        facts["scale"] = math.hypot(matrix[0, 0], matrix[1, 0])
        facts["rotation_degrees"] = math.degrees(math.atan2(matrix[1, 0], matrix[0, 0]))
        facts["translation"] = [float(matrix[0, 2]), float(matrix[1, 2])]
    if alignment.pose is not None and alignment.covariance is not None:
        sigmas = np.sqrt(np.diag(alignment.covariance))
        facts["first_from_second"] = {
            "x": alignment.pose.x,
            "y": alignment.pose.y,
            "heading_degrees": math.degrees(alignment.pose.theta),
            "sigma_x": float(sigmas[0]),
            "sigma_y": float(sigmas[1]),
            "sigma_heading_degrees": math.degrees(float(sigmas[2])),
        }
    return facts


def _number(value: float) -> float | None:
    """JSON has no nan."""
    return value if math.isfinite(value) else None


def _lines(facts: dict[str, object], fit: PairFit) -> list[str]:
    """Return the report for a reader; one line when nothing fits."""
    alignment = fit.alignment
    if fit.reason:
        return [f"no fit ({fit.front}, {alignment.model}): {fit.reason}"]
    unit = str(facts["unit"])
    matrix = np.array(facts["second_from_first"])
    # Residuals are read in millimetres of floor, or in pixels.
    scale, short = (1000.0, "mm") if unit == "m" else (1.0, unit)
    axes = "x ahead, y left of the robot" if unit == "m" else "x right, y down in the picture"
    by = str(fit.front) if fit.trial is None else "its pixels (the features did not convince)"
    lines = [f"fit: {alignment.model}, by {by}", f"second = M first, in {unit} ({axes})"]
    lines += [f"  [{row[0]:12.6f} {row[1]:12.6f} {row[2]:12.4f}]" for row in matrix[:2]]
    if alignment.model == "homography":
        lines.append(f"  [{matrix[2, 0]:12.4e} {matrix[2, 1]:12.4e} {matrix[2, 2]:12.4f}]")
    if "scale" in facts:
        lines.append(
            f"scale {facts['scale']:.4f}, rotation {facts['rotation_degrees']:.3f} degrees, "
            f"translation ({matrix[0, 2]:.3f}, {matrix[1, 2]:.3f}) {unit}"
        )
    if unit == "m" and alignment.pose is not None and alignment.covariance is not None:
        pose, sigmas = alignment.pose, np.sqrt(np.diag(alignment.covariance))
        lines.append(
            f"the robot moved x {pose.x:.4f} m, y {pose.y:.4f} m and turned "
            f"{math.degrees(pose.theta):.3f} degrees (sigmas {sigmas[0] * 1000:.2f} mm, "
            f"{sigmas[1] * 1000:.2f} mm, {math.degrees(sigmas[2]):.4f} degrees)"
        )
    if fit.obstacles is not None and any(marks.unlike.any() for marks in fit.obstacles):
        lines.append(
            "something seems to stand on the floor (red in the drawing); matches on it that would "
            f"fit: {fit.obstacle_inliers}"
        )
    if fit.trial is not None:
        return [
            *lines,
            f"score {fit.trial.score:.2f} (how likely it is right); correlation "
            f"{fit.correlation:.3f}, overlap {fit.trial.overlap:.0%}; the next best motion "
            f"explains {fit.trial.rival:.0%} of what this one does",
            *_patches(fit.trial),
        ]
    lines += [
        f"{alignment.inlier_count} inliers of {len(alignment.matches)} matches "
        f"({len(fit.first)} and {len(fit.second)} features)",
        f"residual: median {alignment.median_residual * scale:.3f} {short}, "
        f"rms {alignment.rms_residual * scale:.3f} {short}; correlation {fit.correlation:.2f}",
    ]
    return lines


def _draw(pictures: tuple[PairImage, PairImage], fit: PairFit, lines: list[str]) -> UInt8Array:
    """Draw plain pictures as they are, calibrated ones as their bird's-eye views."""
    first, second = pictures
    matches = fit.alignment.matches
    first_pixels = first.view.grid.pixel_from_metres
    second_pixels = second.view.grid.pixel_from_metres
    matrix = None if fit.reason else fit.alignment.a_from_b
    drawing = draw_matches(
        _shown(first, None if fit.obstacles is None else fit.obstacles[0]),
        _shown(second, None if fit.obstacles is None else fit.obstacles[1]),
        apply_homography(first_pixels, fit.first.points[matches[:, 0]]),
        apply_homography(second_pixels, fit.second.points[matches[:, 1]]),
        fit.alignment.inliers,
        None if matrix is None else second_pixels @ invert(matrix) @ invert(first_pixels),
        lines,
    )
    if fit.trial is None or fit.trial.search is None:
        return drawing
    found = fit.trial.search
    surface = draw_surface(found.surface, found.metres_per_pixel)
    width = max(drawing.shape[1], surface.shape[1])
    return np.vstack([_widened(drawing, width), _widened(surface, width)])


def _widened(picture: UInt8Array, width: int) -> UInt8Array:
    """Return a picture with a bright margin at its right."""
    wide = np.full((picture.shape[0], width, 3), _MARGIN_GRAY, np.uint8)
    wide[:, : picture.shape[1]] = picture
    return wide


def _shown(picture: PairImage, marks: ObstacleMask | None) -> UInt8Array:
    """Return a picture in colour, what stands on its floor in red."""
    plain = picture.calibration.unit == "px"
    shown = view.to_colour(picture.frame.image if plain else picture.view.image)
    if marks is None:
        return shown
    cells_from_pixel = marks.cells_from_metres @ picture.view.grid.metres_from_pixel
    return draw_obstacles(shown, marks.unlike, cells_from_pixel)


def _patches(trial: RegistrationResult) -> list[str]:
    """Return how many of the floor's patches agree, in a line, when enough of them tell."""
    if math.isnan(trial.confirmed):
        return []
    return [f"{trial.confirmed:.0%} of the floor's patches agree by themselves"]

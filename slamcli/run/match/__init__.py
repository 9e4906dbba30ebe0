"""`slam match`: the transform between two pictures, or why nothing fits."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.config import FeatureMethod, FeatureOptions, MatchOptions, TransformModel
from slamcli.core.errors import InputError, OutputError
from slamcli.core.geometry import apply_homography, invert
from slamcli.drawing.correlation_surface import draw_surface
from slamcli.drawing.matches import draw_matches
from slamcli.drawing.obstacles import draw_obstacles
from slamcli.io.files import write_drawing
from slamcli.io.outputs import refuse_existing
from slamcli.run.inputs import Inputs, open_inputs
from slamcli.run.match.fitting import (
    AUTO_RECIPES,
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
from slamcli.run.match.report import measured_facts, report_lines
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
    """The options of `slam match`.

    Attributes
    ----------
    features, matching
        Of the stages of those names, their method, count, model and ratio apart.
    method : str
        ``auto`` tries ORB and SIFT, on the pictures as they are and enlarged.
    count : int or None
        Most features a picture; None: 500, or what each recipe of ``auto`` takes.
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
    """The output of `slam match`.

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
    if drawing is not None and drawing.suffix.lower() not in DRAWING_SUFFIXES:
        suffixes = " or ".join(DRAWING_SUFFIXES)
        raise OutputError(f"cannot write the drawing {drawing}: name it {suffixes}")
    inputs = open_inputs([first, second], calibration_path)
    if drawing is not None:
        read = (*inputs.paths, *options.networks.paths)
        refuse_existing(drawing, inputs=read, overwrite=overwrite)
    if len(inputs.files) != 2:
        raise InputError(f"{first} and {second} must be two image files, not folders")
    pictures = _open(inputs)
    features, matching = _resolved(options, inputs)
    fit = fit_pair(*pictures, _recipes(options, inputs), features, matching)
    if fit.reason and inputs.calibration_path is not None and matching.model == "rigid":
        fit = search_pair(*pictures, fit)
    if inputs.calibration_path is not None:
        fit = without_obstacles(*pictures, fit, matching.min_inliers)
    facts = measured_facts(inputs, pictures, fit)
    note = inputs.note if inputs.calibration_path else "no calibration: pixel units"
    lines = [*note.splitlines(), *report_lines(facts, fit)]
    if drawing is not None:
        write_drawing(drawing, _draw(pictures, fit, lines))
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


def _recipes(options: PairOptions, inputs: Inputs) -> tuple[FeatureRecipe, ...]:
    if options.method != "auto":
        return (FeatureRecipe(options.method, 1, options.count),)
    # A bird's-eye view has its scale already; enlarging it would add nothing.
    plain = inputs.calibration_path is None
    recipes = (recipe for recipe in AUTO_RECIPES if plain or recipe.enlargement == 1)
    return tuple(replace(recipe, count=options.count or recipe.count) for recipe in recipes)


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
    """Return a picture in colour, obstacles on its floor in red."""
    plain = picture.calibration.unit == "px"
    shown = view.to_colour(picture.frame.image if plain else picture.view.image)
    if marks is None:
        return shown
    cells_from_pixel = marks.cells_from_metres @ picture.view.grid.metres_from_pixel
    return draw_obstacles(shown, marks.unlike, cells_from_pixel)

"""Fits of two pictures: the feature recipes that `slam match` tries, their order and acceptance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from slamcli.core.camera.calibration import Calibration, top_down_calibration
from slamcli.core.config import FeatureMethod, FeatureOptions, MapperOptions, MatchOptions
from slamcli.core.deferred import Deferred
from slamcli.core.errors import FrameError, InputError
from slamcli.core.geometry import Grid
from slamcli.core.records import FeatureAlignment, Features, Frame, PreparedFrame, View
from slamcli.io.frames import FrameFile, read_frame
from slamcli.registration import RegistrationResult, register
from slamcli.registration.preparation import assemble, make_pyramids
from slamcli.stages import align, dense, features, local_correlation, view

# Least correlation of the two pictures under a fit, the median over small windows of the overlap
# [guarded by tests/run/match/test_match.py].
MIN_CORRELATION = 0.4
# With several recipes to choose from, so few inliers are accepted when the pixels agree this well
# [guarded by tests/run/match].
MIN_CONFIRMED_INLIERS = 6
CONFIRMING_CORRELATION = 0.7
# With this many times the inliers needed, no other recipe is tried.
_STRONG_FACTOR = 2
# Enlarging a picture beyond this many pixels costs seconds.
_MAX_ENLARGED_PIXELS = 6_000_000


@dataclass(frozen=True, slots=True)
class FeatureRecipe:
    """One way to find features in two pictures.

    Attributes
    ----------
    method : str
    enlargement : int
        Times that the pictures are enlarged before: small things then fill a descriptor's patch.
    count : int or None
        Most features a picture; None: as the options say.
    """

    method: FeatureMethod
    enlargement: int = 1
    count: int | None = None

    def __str__(self) -> str:
        return self.method.upper() + (f" x{self.enlargement}" if self.enlargement > 1 else "")


# From fast to slow: what fits two similar pictures comes first; small or blurred ones need an
# enlargement, or the scale space of SIFT, which ORB's eight levels only approximate
# [guarded by tests/run/match].
AUTO_RECIPES: Final = (
    FeatureRecipe("orb", 1, 4000),
    FeatureRecipe("orb", 2, 10000),
    FeatureRecipe("sift", 1, 5000),
    FeatureRecipe("sift", 2, 10000),
)


@dataclass(frozen=True, slots=True, eq=False)
class PairImage:
    """One of the two pictures: as read, and as a view.

    Attributes
    ----------
    frame : Frame
    view : View
        Gray: the bird's-eye view, or the picture itself in pixel units.
    calibration : Calibration
    """

    frame: Frame
    view: View
    calibration: Calibration


@dataclass(frozen=True, slots=True, eq=False)
class PairFit:
    """Result of fitting the pair with one recipe.

    Attributes
    ----------
    recipe : FeatureRecipe
    alignment : FeatureAlignment
        Of ``first_from_second``.
    first, second : Features
    correlation : float
        Median over small windows of the overlap; nan when nothing could be compared.
    reason : str
        Why it is rejected; empty when it is accepted.
    trial : RegistrationResult or None
        Result of the search over the pixels, when the features were rejected.
    obstacles : (ObstacleMask, ObstacleMask) or None
        Where an obstacle stands on the floor, in either view; None when nothing fits, or in plain
        pictures.
    obstacle_inliers : int
        How many inliers of the features lie on it; they were left out where that helped.
    """

    recipe: FeatureRecipe
    alignment: FeatureAlignment
    first: Features
    second: Features
    correlation: float
    reason: str
    trial: RegistrationResult | None = None
    obstacles: tuple[dense.ObstacleMask, dense.ObstacleMask] | None = None
    obstacle_inliers: int = 0


def read_picture(file: FrameFile) -> Frame:
    """Return a frame; raises InputError that names the file."""
    try:
        return read_frame(file)
    except FrameError as error:
        raise InputError(f"{file.path}: {error}") from error


def plain_picture(frame: Frame, enlargement: int = 1) -> PairImage:
    """Return a picture as a view of itself: one unit is one of its own pixels."""
    gray = view.to_gray(frame.image)
    height, width = gray.shape
    mask = np.full(gray.shape, 255, np.uint8) if frame.mask is None else frame.mask
    grid = Grid(0.0, 0.0, 1.0 / enlargement, width * enlargement, height * enlargement)
    if enlargement > 1:
        size = (grid.width, grid.height)
        gray = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_CUBIC), np.uint8)
        mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    return PairImage(frame, View(grid, gray, mask), top_down_calibration((width, height)))


def birdseye_picture(frame: Frame, calibration: Calibration, metres_per_pixel: float) -> PairImage:
    """Return a frame as a bird's-eye view; raises InputError when another camera took it."""
    try:
        view.check_frame(frame, calibration)
    except FrameError as error:
        raise InputError(f"{frame.name}: {error}") from error
    resampler = view.make_view_resampler(calibration, metres_per_pixel)
    seen = view.make_compared_views(frame, [resampler])[0]
    return PairImage(frame, seen, calibration)


def compared_views(picture: PairImage, *, far: bool) -> list[View]:
    """Return the views of a bird's-eye picture that are compared by their pixels, near and far."""
    resamplers = view.make_compared_resamplers(
        picture.calibration, picture.view.grid.metres_per_pixel, far=far
    )
    return view.make_compared_views(picture.frame, resamplers)


def fit_pair(
    first: PairImage,
    second: PairImage,
    recipes: tuple[FeatureRecipe, ...],
    feature_options: FeatureOptions,
    match_options: MatchOptions,
) -> PairFit:
    """Try recipes in order; return the first strong fit, else that of the highest correlation.

    A fit with fewer inliers than `match_options` require is accepted too, when there are several
    recipes to try, if the correlation is at least `CONFIRMING_CORRELATION`.
    """
    enough = match_options.min_inliers
    strong = _STRONG_FACTOR * enough if len(recipes) > 1 else enough
    if len(recipes) > 1:
        match_options = replace(match_options, min_inliers=min(enough, MIN_CONFIRMED_INLIERS))
    fits: list[PairFit] = []
    for recipe in recipes:
        if fits and not _affordable(recipe, first, second):
            continue
        fit = _fit_by(recipe, first, second, feature_options, match_options)
        few = fit.alignment.inlier_count < enough
        fit = _confirm(fit, CONFIRMING_CORRELATION if few else MIN_CORRELATION)
        if not fit.reason and fit.alignment.inlier_count >= strong:
            return fit
        fits.append(fit)
    accepted = [fit for fit in fits if not fit.reason]
    if accepted:
        return max(accepted, key=lambda fit: fit.correlation)
    return max(fits, key=lambda fit: fit.alignment.inlier_count)


def _confirm(fit: PairFit, min_correlation: float) -> PairFit:
    """Return the fit, rejected where the pixels do not confirm it."""
    if fit.reason or fit.correlation >= min_correlation:
        return fit
    if math.isnan(fit.correlation):
        return replace(fit, reason="the overlap shows too little to confirm the fit by its pixels")
    return replace(
        fit,
        reason=f"the pictures do not look alike under the fit: correlation {fit.correlation:.2f}; "
        f"at least {min_correlation:.2f} is needed",
    )


def _affordable(recipe: FeatureRecipe, first: PairImage, second: PairImage) -> bool:
    pixels = sum(p.view.grid.width * p.view.grid.height for p in (first, second))
    return recipe.enlargement == 1 or pixels * recipe.enlargement**2 <= _MAX_ENLARGED_PIXELS


def _fit_by(
    recipe: FeatureRecipe,
    first: PairImage,
    second: PairImage,
    feature_options: FeatureOptions,
    match_options: MatchOptions,
) -> PairFit:
    options = replace(
        feature_options, method=recipe.method, count=recipe.count or feature_options.count
    )
    found = []
    for picture in (first, second):
        shown = picture.view
        if recipe.enlargement > 1:
            shown = plain_picture(picture.frame, recipe.enlargement).view
        found.append(features.extract(shown, picture.calibration, options))
    alignment = align.align(found[0], found[1], match_options)
    correlation = math.nan
    if alignment.a_from_b is not None and alignment.accepted:
        correlation = local_correlation.local_correlation(
            first.view, second.view, alignment.a_from_b
        )
    return PairFit(recipe, alignment, found[0], found[1], correlation, alignment.reason)


def _prepared(index: int, picture: PairImage, found: Features) -> PreparedFrame:
    """Return a bird's-eye picture as the mapper would register it."""
    frame = replace(picture.frame, index=index)
    views = compared_views(picture, far=True)
    pyramids = Deferred.of(make_pyramids(views))
    return assemble(frame, pyramids, Deferred.of(picture.view), Deferred.of(found))


def search_pair(first: PairImage, second: PairImage, fit: PairFit) -> PairFit:
    """Search the motion between two bird's-eye views by their pixels, after their features failed.

    Returns
    -------
    PairFit
        Of the motion found, or the given one with both reasons.
    """
    prepared = [_prepared(0, first, fit.first), _prepared(1, second, fit.second)]
    options = MapperOptions(max_turn_degrees=180.0)
    trial = register(
        prepared[0], prepared[1], None, first.calibration, options, window=dense.SearchWindow()
    )
    if trial.link is None:
        reason = fit.reason if trial.search is None else f"{fit.reason}; {trial.reason}"
        return replace(fit, reason=reason, trial=trial)
    pose = trial.link.a_from_b
    alignment = replace(
        fit.alignment,
        model="rigid",
        a_from_b=pose.matrix,
        pose=pose,
        covariance=trial.link.covariance,
        inliers=np.zeros(len(fit.alignment.matches), np.bool_),
        residuals=np.full(len(fit.alignment.matches), np.nan),
        reason="",
    )
    return replace(fit, alignment=alignment, correlation=trial.correlation, reason="", trial=trial)

"""Drawings of `slam stitch --debug`: every registration of a frame, with its matches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slamcli.core.arrays import Float64Array, Int32Array, UInt8Array
from slamcli.core.geometry import apply_homography, invert
from slamcli.core.records import PreparedFrame
from slamcli.drawing.matches import draw_matches
from slamcli.io.files import write_drawing
from slamcli.registration import RegistrationResult
from slamcli.stages import view


def draw_trials(trials: Sequence[RegistrationResult], folder: Path) -> None:
    """Draw the registrations of one frame, those that placed it and those that failed."""
    for trial in trials:
        first, second, fit = trial.keyframe, trial.prepared, trial.alignment
        picture_first, points_first, to_first = _drawable(first, fit.matches[:, 0])
        picture_second, points_second, to_second = _drawable(second, fit.matches[:, 1])
        if trial.link is not None:
            a_from_b: Float64Array | None = trial.link.a_from_b.matrix
            verdict = f"placed, score {trial.score:.3f}, correlation {trial.correlation:.3f}"
        else:
            a_from_b = fit.a_from_b if fit.accepted else None
            verdict = trial.reason
        second_from_first = None
        if a_from_b is not None:
            second_from_first = to_second @ invert(a_from_b) @ invert(to_first)
        header = [
            f"{second.name} on {first.name}: {verdict}",
            f"{fit.inlier_count} inliers of {len(fit.matches)} matches, "
            f"overlap {trial.overlap:.0%}; the robot looks to the right",
        ]
        drawing = draw_matches(
            picture_first,
            picture_second,
            points_first,
            points_second,
            fit.inliers,
            second_from_first,
            header,
        )
        write_drawing(folder / f"{second.index:04d}_to_{first.index:04d}.png", drawing)


def _drawable(
    prepared: PreparedFrame, chosen: Int32Array
) -> tuple[UInt8Array, Float64Array, Float64Array]:
    """Return a frame's view, its chosen points in that view's pixels, and pixel_from_metres.

    An old keyframe has only the coarser view that is compared.
    """
    assert prepared.features is not None
    if prepared.view is not None:
        image, pixel_from_metres = prepared.view.image, prepared.view.grid.pixel_from_metres
    else:
        first = prepared.levels[0]
        image, pixel_from_metres = first.image, first.pixel_from_metres
    points = apply_homography(pixel_from_metres, prepared.features.points[chosen])
    return view.to_colour(image), points, pixel_from_metres

"""An oblique camera calibrated by the pixels of a floor with lines and edges, but few features.

Cameras of a coarse grid of focal lengths and pitches are tried: under the right one the bird's-eye
views of consecutive pictures are rigid motions of one another, which a correlation search finds.
The best are refined together with all motions, from coarse to fine detail.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.camera.footprint import default_metres_per_pixel, footprint
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.stages.dense import Candidate, SearchWindow, make_levels, search
from slamcli.stages.view import make_view, make_view_resampler
from slamcli.survey.features import local_detail
from slamcli.survey.in_order import InOrder
from slamcli.survey.oblique_camera import ObliqueCamera
from slamcli.survey.photometric import BEND, CAMERA, LOG_FOCAL, PITCH, ROLL, Aligned, Alignment

# [All numbers here: guarded by tests/survey/test_oblique_by_pixels.py.]
# The cameras that are tried: pitch in degrees, and focal length in widths of the picture.
_PITCHES, _FOCALS = (15.0, 22.0, 30.0, 40.0, 52.0), (0.55, 0.75, 1.0, 1.35)
# Pictures are searched in this width, in views of about so many pixels, and refined in these.
_SEARCH_WIDTH, _VIEW_PIXELS, _COARSE_WIDTH, _FINE_WIDTH = 320, 30_000, 200, 400
_SIGMAS_PIXELS, _FINE_SIGMA_PIXELS, _STEPS = (4.0, 2.0, 1.0), 1.0, 20
_MIN_OVERLAP, _MIN_SEARCH_CORRELATION, _MIN_CORRELATION = 0.3, 0.35, 0.75
_REFINED, _MIN_PAIRS = 5, 3
MAX_PICTURES = 6
Guess = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class _Refined:
    """A camera with the pictures it is found by: from number `first` on."""

    first: int
    pairs: list[tuple[int, int]]
    aligned: Aligned

    @property
    def score(self) -> float:
        """How well the pairs agree, and how many do."""
        good = self.aligned.correlations[self.aligned.correlations > _MIN_CORRELATION]
        return float(-np.log1p(-np.minimum(good, 0.999)).sum())


def camera_by_pixels(
    pictures: Sequence[UInt8Array], in_order: InOrder = map
) -> ObliqueCamera | None:
    """Return the camera under which consecutive pictures are rigid motions on the floor.

    None when there is none.

    Parameters
    ----------
    pictures : sequence of (H, W) uint8
        Of one size, consecutive.
    in_order : callable
        Like `map`; may work ahead.
    """
    width = pictures[0].shape[1]
    coarse = [local_detail(one, None, _COARSE_WIDTH) for one in pictures]
    guesses = list(product(_FOCALS, _PITCHES))
    steps = list(in_order(partial(_steps, [_small(one) for one in pictures]), guesses))
    ranked = sorted(zip(guesses, steps, strict=True), key=lambda one: -_score(one[1]))
    refined = [_refined(coarse, *one) for one in ranked[:_REFINED]]
    best = max((one for one in refined if one), key=lambda one: one.score, default=None)
    if best is None:
        return None
    fine = _finest(pictures, best)
    if fine is None:
        return None
    values, sigmas = fine.values[:CAMERA], fine.sigmas
    lens = width * math.exp(values[LOG_FOCAL])
    camera = ObliqueCamera(
        lens,
        float(values[PITCH]),
        float(values[ROLL]),
        float(values[BEND]),
        float(sigmas[LOG_FOCAL]),
        float(sigmas[PITCH]),
        math.nan,
    )
    return camera.checked()


def _small(picture: UInt8Array) -> UInt8Array:
    scale = min(1.0, _SEARCH_WIDTH / picture.shape[1])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _steps(pictures: Sequence[UInt8Array], guess: Guess) -> list[Candidate | None]:
    """Return the best motion between consecutive pictures' views, under a guessed camera."""
    height, width = pictures[0].shape
    focal, pitch = guess
    camera = ObliqueCamera(width * focal, math.radians(pitch), 0.0, 0.0, math.nan, math.nan, 0.0)
    calibration = camera.calibration((width, height), None)
    finest = default_metres_per_pixel(calibration)
    grid = footprint(calibration, finest)
    shrink = math.sqrt(grid.width * grid.height / _VIEW_PIXELS)
    resampler = make_view_resampler(calibration, finest * shrink, antialias=True)
    frames = [Frame(number, "", None, one) for number, one in enumerate(pictures)]
    coarsest = [make_levels(make_view(one, resampler, gray=True))[-1] for one in frames]
    found = []
    for a, b in pairwise(coarsest):
        motions = search(a, b, SearchWindow(), min_overlap=_MIN_OVERLAP, count=1).candidates
        found.append(motions[0] if motions else None)
    return found


def _score(steps: Sequence[Candidate | None]) -> float:
    return sum(max(0.0, one.correlation - _MIN_SEARCH_CORRELATION) for one in steps if one)


def _refined(
    details: Sequence[Float32Array], guess: Guess, steps: Sequence[Candidate | None]
) -> _Refined | None:
    """Return a guessed camera refined with the longest run of consecutive motions found."""
    good = [one is not None and one.correlation > _MIN_SEARCH_CORRELATION for one in steps]
    first, last = _longest_run(good)
    if last - first < _MIN_PAIRS:
        return None
    poses = [Pose2()]
    for one in steps[first:last]:
        assert one is not None
        poses.append(poses[-1] @ one.a_from_b)
    motions = [(pose.x, pose.y, pose.theta) for pose in poses[1:]]
    values = np.append([math.log(guess[0]), math.radians(guess[1]), 0.0, 0.0], np.ravel(motions))
    pairs = [(number, number + 1) for number in range(last - first)]
    run = details[first : last + 1]
    for sigma in _SIGMAS_PIXELS:
        aligned = Alignment([_blurred(one, sigma) for one in run], pairs).solve(values, _STEPS)
        values = aligned.values
    return _Refined(first, pairs, aligned)


def _finest(pictures: Sequence[UInt8Array], best: _Refined) -> Aligned | None:
    """Return the alignment of finer detail of the pictures that agree; None if too few do."""
    first, last = _longest_run((best.aligned.correlations > _MIN_CORRELATION).tolist())
    if last - first < _MIN_PAIRS:
        return None
    count = last - first + 1
    run = pictures[best.first + first : best.first + last + 1]
    details = [_blurred(local_detail(one, None, _FINE_WIDTH), _FINE_SIGMA_PIXELS) for one in run]
    pairs = [(a, a + step) for step in (1, 2) for a in range(count - step)]
    aligned = Alignment(details, pairs).solve(
        _from_picture(best.aligned.values, first, last), _STEPS
    )
    agree = aligned.correlations[: count - 1] > _MIN_CORRELATION
    return aligned if agree.sum() >= _MIN_PAIRS else None


def _from_picture(values: Float64Array, first: int, last: int) -> Float64Array:
    """Return the values with the poses of some pictures alone, in the frame of the first."""
    poses = [Pose2(), *(Pose2(*row) for row in values[CAMERA:].reshape(-1, 3).tolist())]
    origin = poses[first].inverse()
    moved = [origin @ pose for pose in poses[first + 1 : last + 1]]
    return np.append(values[:CAMERA], np.ravel([(pose.x, pose.y, pose.theta) for pose in moved]))


def _longest_run(good: Sequence[bool]) -> tuple[int, int]:
    """Return the first and one past the last of the longest run of what is good."""
    best = start = stop = 0
    for number, one in enumerate([*good, False]):
        if not one:
            if number - start > best:
                best, first = number - start, start
                stop = first + best
            start = number + 1
    return stop - best, stop


def _blurred(detail: Float32Array, sigma: float) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(detail, (0, 0), sigma), np.float32)

"""The lens that all frames of a survey share, and how freely its mount moves."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.arrays import Float64Array
from slamcli.survey.projection import Projections, project

# Sigma of the prior of the lens's bend.
_BEND_SIGMA = 0.05


@dataclass(frozen=True, slots=True)
class LensPrior:
    """What is known of a lens beforehand.

    Attributes
    ----------
    log_focal : float
        Logarithm of the focal length in pixels.
    focal_sigma : float
        Of that; 0 for a focal length that is known.
    bend_sigma : float
        Of the bend, about 0; 0 for a lens without distortion.
    """

    log_focal: float
    focal_sigma: float
    bend_sigma: float = _BEND_SIGMA


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """The lens that all frames share.

    Attributes
    ----------
    focal_pixels : float
    bend : float
        Radial distortion in the corners: a share of the radius.
    radius_pixels : float
        Of the corners.
    prior : LensPrior or None
        None where the focal length is known.
    camera_from_nadir : (3, 3) float64 or None
        See `projection.project`; None for a camera that looks down.
    """

    focal_pixels: float
    bend: float
    radius_pixels: float
    prior: LensPrior | None = None
    camera_from_nadir: Float64Array | None = None

    def project(self, states: Float64Array) -> Projections:
        """Return the homographies of (N, 6) states."""
        return project(states, self.focal_pixels, self.camera_from_nadir)


@dataclass(frozen=True, slots=True)
class Mount:
    """How freely the camera moves: sigmas of the priors of every frame's tilt and scale.

    Attributes
    ----------
    tilt_sigma : float
        Radians, of pitch and roll; 0 for a camera that is fixed looking straight down.
    scale_sigma : float
        Of the logarithm of the scale.
    """

    tilt_sigma: float
    scale_sigma: float

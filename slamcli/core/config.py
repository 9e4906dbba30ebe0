"""Options of all stages, with their defaults; the command line and run.toml use the same fields."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from slamcli.core.errors import InputError

if TYPE_CHECKING:  # numpy, which `slam stitch --help` need not load
    from pathlib import Path

    from slamcli.core.networks import MatchNetwork, PointNetwork

FeatureMethod = Literal["orb", "sift", "aliked", "disk"]
TransformModel = Literal["rigid", "similarity", "affine", "homography"]
MatchFilter = Literal["ratio", "cross-check"]
MapFormat = Literal["png", "geotiff", "deepzoom", "nav2"]
Layer = Literal["resolution", "views", "last-frame"]
Blend = Literal["best", "feather", "multiband", "median", "mean"]

# Pictures enlarged more than this take memory and show nothing new.
_MAX_ENLARGEMENT = 8.0


@dataclass(frozen=True, slots=True)
class FeatureOptions:
    """Options of feature detection; ORB's defaults are OpenCV's and those of the 2015 thesis.

    Attributes
    ----------
    method : str
    count : int
        Most points kept a picture.
    spread : bool
        Keep the strongest points of every part of the picture, not the strongest of all: a rigid
        fit gains more from a wide base than from strong corners side by side.
    refine : bool
        Refine ORB's points, on whole pixels of their pyramid level, to sub-pixel positions.
    upright : bool
        Describe ORB's and SIFT's points without rotation invariance: more distinctive while the
        robot turns by less than some 10 degrees between two frames, without matches beyond.
    network : PointNetwork or None
        Of ALIKED or DISK.
    scale_factor, levels, edge_threshold, first_level, wta_k, patch_size, fast_threshold
        Of ORB (Rublee et al., ICCV 2011); edge_threshold and patch_size in pixels.
    min_fast_threshold : int
        Used where `fast_threshold` finds fewer than `count` points: a floor of low contrast.
    contrast_threshold : float
        Of SIFT.
    clean : bool
        Low-pass the picture, then turn dark pixels black (``clean_image`` of the thesis).
    clean_kernel_pixels : int
        Side of the low-pass's box.
    clean_threshold : int
        Gray level below which a pixel becomes black.
    roi : bool
        Leave out points near the border of the region seen (``_apply_roi`` of the thesis).
    roi_border_pixels : int
        Width of that border, in the pixels of a point's pyramid level.
    """

    method: FeatureMethod = "orb"
    count: int = 500
    spread: bool = True
    refine: bool = True
    upright: bool = False
    network: PointNetwork | None = None
    scale_factor: float = 1.2
    levels: int = 8
    edge_threshold: int = 31
    first_level: int = 0
    wta_k: int = 2
    patch_size: int = 31
    fast_threshold: int = 20
    min_fast_threshold: int = 5
    contrast_threshold: float = 0.04
    clean: bool = False
    clean_kernel_pixels: int = 5
    clean_threshold: int = 100
    roi: bool = True
    roi_border_pixels: int = 16

    def __post_init__(self) -> None:
        if self.first_level >= self.levels:
            raise InputError(
                f"a first level of {self.first_level} needs more than {self.levels} levels"
            )
        enlargement = self.scale_factor**self.first_level
        if enlargement > _MAX_ENLARGEMENT:
            raise InputError(
                f"a first level of {self.first_level} at a scale factor of {self.scale_factor:g} "
                f"enlarges pictures {enlargement:.3g} times; at most {_MAX_ENLARGEMENT:g} is done"
            )


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """Options of descriptor matching and of the fit to the matches (RANSAC).

    Attributes
    ----------
    model : str
        Degrees of freedom: rigid 3, similarity 4, affine 6, homography 8.
    filter : str
        Which matches are kept: those clearly better than the second best, or those that are each
        other's best.
    ratio : float
        Of Lowe's ratio test: best over second-best distance must be below it. Hundreds of points on
        a worn floor need a larger one than thousands in a photograph.
    network : MatchNetwork or None
        Matches the points in place of the nearest descriptors and the filter.
    max_distance : float or None
        Descriptor distance above which a match is dropped (the cost filter of the thesis).
    max_size_ratio : float or None
        A point of the floor is as large in every bird's-eye view: a match whose points' sizes
        differ by more than this factor is dropped. None: the views' scales are not known.
    max_angle_radians : float
        Largest difference between the rotation of an inlier's two points and that of the rigid fit
        or similarity: nearly all true matches are within it, others only by chance.
    threshold : float or None
        A match is an inlier when its residual is below this: metres (pixels without calibration).
        None: `threshold_sigmas` times the sigma that follows from both points' own.
    threshold_sigmas : float
        Large, as the points' sigmas leave out a calibration's errors.
    confidence : float
        Probability that RANSAC has drawn a sample of inliers only when it stops.
    max_iterations : int
    min_inliers : int
    min_inlier_ratio : float
        Smallest share of inliers among the matches.
    min_spread : float
        Smallest ratio of the inliers' narrower extent to that of all points of the view.
    max_residual_ratio : float
        Largest ratio of the inliers' root mean square residual to the threshold. Chance matches
        have residuals of even density over the disc, which gives 0.71; true ones small residuals.
    max_rival_share : float
        Largest share, of the inliers, of matches that agree on another transform: beyond it the fit
        is ambiguous.
    max_scale : float
        Largest scale, or 1 over the smallest, that a similarity, affinity or homography may have
        anywhere among the inliers.
    max_stretch : float
        Largest ratio of the scales in two directions that an affinity or homography may have.
    search_radius : float or None
        Given a prior, matches farther from it are left out: metres (pixels without calibration).
        None: a hundred times the points' typical sigma.
    search_angle_radians : float
        Uncertainty of the prior's heading; times a point's distance it adds to the radius.
    seed : int
    """

    model: TransformModel = "rigid"
    filter: MatchFilter = "ratio"
    ratio: float = 0.9
    network: MatchNetwork | None = None
    max_distance: float | None = None
    max_size_ratio: float | None = 1.4
    max_angle_radians: float = math.radians(30.0)
    threshold: float | None = None
    threshold_sigmas: float = 5.0
    confidence: float = 0.999
    max_iterations: int = 5000
    min_inliers: int = 12
    min_inlier_ratio: float = 0.1
    min_spread: float = 0.1
    max_residual_ratio: float = 0.62
    max_rival_share: float = 0.5
    max_scale: float = 8.0
    max_stretch: float = 2.0
    search_radius: float | None = None
    search_angle_radians: float = 0.1
    seed: int = 0


@dataclass(frozen=True, slots=True)
class NetworkFiles:
    """Files of trained networks, and how points are matched.

    Attributes
    ----------
    weights : Path or None
        Of ALIKED or DISK, as ONNX.
    network_size : (int, int) or None
        Width and height of the pictures that they take; None: what the published files take.
    matcher : str
    matcher_weights : Path or None
        Of LightGlue, as ONNX.
    """

    weights: Path | None = None
    network_size: tuple[int, int] | None = None
    matcher: Literal["nearest", "lightglue"] = "nearest"
    matcher_weights: Path | None = None


@dataclass(frozen=True, slots=True)
class MapperOptions:
    """Options of the mapper: registration of frames, keyframes, loop closure.

    Attributes
    ----------
    features, matching
        The model is always rigid.
    metres_per_pixel : float or None
        Resolution of the views that are matched; None chooses it from the camera's sampling.
    recent_keyframes : int
        Number of latest keyframes that a frame is compared with.
    keyframe_overlap : float
        A frame that shares less of its floor with the current keyframe becomes a keyframe.
    min_overlap : float
        Smallest share of floor in common for a fit to be accepted.
    max_turn_degrees : float
        Largest turn between two frames that are compared: floors with lines and squares look the
        same again after a quarter or half turn.
    min_score : float
        Smallest correlation of the overlap's pixels for a fit to be accepted, in [-1, 1].
    tilt_sigma_degrees : float
        Standard deviation of the camera's pitch from frame to frame.
    refine : bool
        Refine each fit on the pixels themselves (photometric refinement).
    dense : bool
        Search for the motion by correlation of pixels where features do not suffice.
    search_angle_degrees : float
        Largest turn to either side in that search.
    search_share_of_range : float
        Radius of that search around the motion model's prediction, as a share of the camera's
        range.
    min_dense_score : float
        Smallest correlation of the overlap's detail for a searched motion to be accepted.
    max_rival_evidence : float
        Largest evidence for another motion, as a share of that for the best one.
    max_sigma_share : float
        Largest sigma of a searched motion, in any direction, as a share of the camera's range.
    max_step_metres : float or None
        Largest distance between two consecutive frames. On a floor with a repeating pattern, less
        than half its period makes the motion unambiguous. None: unknown.
    max_hypotheses : int
        Motions of a search that are followed to the finest pyramid level.
    convincing_inliers : int
    convincing_score : float
        A fit with at least this many inliers and this correlation needs no search.
    loops : bool
        Recognise floor that was mapped before: loop closure and relocalisation.
    """

    features: FeatureOptions = field(default_factory=lambda: FeatureOptions(count=1000))
    matching: MatchOptions = field(default_factory=MatchOptions)
    metres_per_pixel: float | None = None
    recent_keyframes: int = 5
    keyframe_overlap: float = 0.7
    min_overlap: float = 0.1
    max_turn_degrees: float = 75.0
    min_score: float = 0.3
    tilt_sigma_degrees: float = 0.1
    refine: bool = True
    dense: bool = True
    search_angle_degrees: float = 40.0
    search_share_of_range: float = 0.25
    min_dense_score: float = 0.45
    max_rival_evidence: float = 0.75
    max_sigma_share: float = 0.015
    max_step_metres: float | None = None
    max_hypotheses: int = 3
    convincing_inliers: int = 120
    convincing_score: float = 0.5
    loops: bool = True


@dataclass(frozen=True, slots=True)
class PaintOptions:
    """Options of painting the map's picture from frames with poses.

    Attributes
    ----------
    metres_per_pixel : float or None
        None chooses it from the camera's sampling.
    blend : str
        Blending of several views of one spot.
    gain : bool
        Even out exposure and vignetting.
    obstacles : bool
        Keep obstacles and moving things out of the map where another view shows the floor.
    """

    metres_per_pixel: float | None = None
    blend: Blend = "best"
    gain: bool = True
    obstacles: bool = True


@dataclass(frozen=True, slots=True)
class Datum:
    """Position and heading of the map's origin on Earth.

    Attributes
    ----------
    latitude_degrees, longitude_degrees : float
        WGS84.
    east_heading_radians : float
        From the east, counter-clockwise, to the map's x axis.
    """

    latitude_degrees: float
    longitude_degrees: float
    east_heading_radians: float = 0.0


@dataclass(frozen=True, slots=True)
class ProductOptions:
    """Options of the map's files.

    Attributes
    ----------
    paint : PaintOptions
    formats : tuple of str
    layers : tuple of str
        Further values that are written for every pixel.
    nav_lines : bool
        Painted lines are occupied in the Nav2 map, in place of obstacles.
    nav_metres_per_pixel : float
        Of the Nav2 map; never finer than the mosaic.
    turn_radians : float
        Counter-clockwise rotation of the map.
    crop : (float, float, float, float) or None
        x_min, y_min, x_max, y_max of the turned map, metres.
    memory_bytes : int
        Of the whole process; pictures and canvases get what the poses leave of it.
    datum : Datum or None
    """

    paint: PaintOptions = field(default_factory=PaintOptions)
    formats: tuple[MapFormat, ...] = ("png",)
    layers: tuple[Layer, ...] = ()
    nav_lines: bool = False
    nav_metres_per_pixel: float = 0.01
    turn_radians: float = 0.0
    crop: tuple[float, float, float, float] | None = None
    memory_bytes: int = 1_400_000_000
    datum: Datum | None = None

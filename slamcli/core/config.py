"""Options that cross walls, with their defaults; a command's flags and run.toml mirror them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from slamcli.core.errors import InputError

if TYPE_CHECKING:  # numpy, which `slam --help` need not wait for
    from slamcli.core.networks import MatchNetwork, PointNetwork

FeatureMethod = Literal["orb", "sift", "aliked", "disk"]
TransformModel = Literal["rigid", "similarity", "affine", "homography"]
MatchFilter = Literal["ratio", "cross-check"]
MapFormat = Literal["png", "geotiff", "deepzoom", "nav2"]
Layer = Literal["resolution", "views", "last-frame"]
Blend = Literal["best", "feather", "multiband", "median", "mean"]

# FrameCache enlarged more than this eat the memory and show nothing new.
_MAX_ENLARGEMENT = 8.0


@dataclass(frozen=True, slots=True)
class FeatureOptions:
    """What is found in a picture. ORB's defaults are OpenCV's and the 2015 thesis's.

    Attributes
    ----------
    method : str
    count : int
        Most points kept a picture.
    spread : bool
        Keep the strongest points of every part of the picture, not the strongest of all: for a
        rigid fit a wide base is worth more than sharp corners side by side.
    refine : bool
        Move ORB's points, which lie on whole pixels of their pyramid level, to sub-pixel places.
    upright : bool
        Describe ORB's and SIFT's points as the robot sees them, not turned with the texture: more
        telling while the robot turns by less than some 10 degrees between two frames, blind beyond.
    network : PointNetwork or None
        What ALIKED and DISK are.
    scale_factor, levels, edge_threshold, first_level, wta_k, patch_size, fast_threshold
        ORB's own (Rublee et al., ICCV 2011); edge_threshold and patch_size in pixels.
    min_fast_threshold : int
        Tried when `fast_threshold` finds fewer than `count` points: a floor of low contrast.
    contrast_threshold : float
        SIFT's own.
    clean : bool
        The thesis's ``clean_image``: a low-pass, then a threshold.
    clean_kernel_pixels : int
        Side of the low-pass's box.
    clean_threshold : int
        Gray level below which a pixel becomes black.
    roi : bool
        The thesis's ``_apply_roi``: leave out points near the border of what was seen.
    roi_border_pixels : int
        How near.
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
    """How two sets of features become one transform.

    Attributes
    ----------
    model : str
        Degrees of freedom: rigid 3, similarity 4, affine 6, homography 8.
    filter : str
        Which matches are kept: those clearly better than the second best, or those that are each
        other's best.
    ratio : float
        Lowe's: best over second-best distance must be below it. Hundreds of points on a worn
        floor want a milder one than thousands in a photograph.
    network : MatchNetwork or None
        Pairs the points in place of the nearest descriptors and the filter.
    max_distance : float or None
        Descriptor distance above which a match is dropped (the thesis's cost filter).
    max_size_ratio : float or None
        A point of the floor is as large in every bird's-eye view: a match whose points' sizes
        differ by more than this factor is dropped. None: the views' scales are not known.
    max_angle_radians : float
        By so much more or less than a rigid fit or a similarity turns may an inlier's surroundings
        be turned: true matches are within it but for a few, others by chance.
    threshold : float or None
        A match is an inlier when its residual is below this: metres (pixels without calibration).
        None: `threshold_sigmas` times what the sigmas of both points explain.
    threshold_sigmas : float
        Generous, as the points' sigmas know nothing of a calibration's errors.
    confidence : float
        Of RANSAC having drawn one all-inlier sample when it stops.
    max_iterations : int
    min_inliers : int
    min_inlier_ratio : float
        Share of the matches that must be inliers.
    min_spread : float
        Of the inliers over the view: their narrower extent over that of all points of the view.
    max_residual_ratio : float
        Of the inliers' root mean square residual to the threshold. Matches that agree by chance
        fill the disc evenly, which gives 0.71; true ones crowd at its centre.
    max_rival_share : float
        Of the inliers: with more matches than this agreeing on another transform, neither is.
    max_scale : float
        Largest scale, or 1 over the smallest, that a similarity, affinity or homography may have
        anywhere among the inliers.
    max_stretch : float
        Largest ratio of the scales in two directions that an affinity or homography may have.
    search_radius : float or None
        Given a guess, matches farther from it are not tried: metres (pixels without calibration).
        None: a hundred times the points' typical sigma.
    search_angle_radians : float
        The guess's uncertainty in heading; adds its share of a point's distance to the radius.
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
class MapperOptions:
    """How frames become poses.

    Attributes
    ----------
    features, matching
        Of the stages of those names; the model is always rigid.
    metres_per_pixel : float or None
        Resolution of the views that are matched; None chooses it from the camera's sampling.
    recent_keyframes : int
        How many of the latest keyframes a new frame is compared with.
    keyframe_overlap : float
        A frame that shares less of its floor with the current keyframe becomes one itself.
    min_overlap : float
        Least share of floor that two frames must both see for their fit to be believed.
    max_turn_degrees : float
        Most that the robot may have turned between two frames that are compared: floors with lines
        and squares look the same again after a quarter or half turn.
    min_score : float
        Least correlation of the overlap's pixels for a fit to be believed, in [-1, 1].
    tilt_sigma_degrees : float
        By how much the camera's pitch varies from frame to frame, one standard deviation.
    refine : bool
        Refine each fit on the pixels themselves.
    dense : bool
        Search the pixels for the motion where features do not convince.
    search_angle_degrees : float
        Turns tried to either side by that search.
    search_share_of_range : float
        How far around the motion that the robot's latest one foretells it looks, as a share of how
        far the camera sees.
    min_dense_score : float
        Least correlation of the overlap's detail for what a search found to be believed.
    max_rival_evidence : float
        Most that another motion may explain, as a share of what the best one does.
    max_sigma_share : float
        A searched motion less well known than this, as a share of how far the camera sees, in any
        direction is not believed.
    max_step_metres : float or None
        The farthest that the robot goes between two frames that follow each other. Where a floor
        repeats, less than half its period tells which of its like spots is meant. None: not known.
    most_hypotheses : int
        So many motions of a search are followed to the finest level.
    convincing_inliers : int
    convincing_score : float
        A fit with so many inliers, whose pixels correlate so well, needs no search.
    loops : bool
        Look for floor that was seen before: to close loops, and to know a robot that was carried.
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
    """How placed frames become the picture of the map.

    Attributes
    ----------
    metres_per_pixel : float or None
        None chooses it from the camera's sampling.
    blend : str
        How the views of a spot become one colour.
    gain : bool
        Even out exposure and vignetting.
    obstacles : bool
        Keep what stands on the floor or moved out of it, where another view saw the floor.
    """

    metres_per_pixel: float | None = None
    blend: Blend = "best"
    gain: bool = True
    obstacles: bool = True


@dataclass(frozen=True, slots=True)
class Datum:
    """Where the map's origin lies on the earth.

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
    """What is written of the map.

    Attributes
    ----------
    paint : PaintOptions
    formats : tuple of str
    layers : tuple of str
        What else is written for every pixel.
    nav_lines : bool
        Painted lines are obstacles in the Nav2 map, in place of what stands.
    nav_metres_per_pixel : float
        Of the Nav2 map; never finer than the mosaic.
    turn_radians : float
        The map is turned counter-clockwise by so much.
    crop : (float, float, float, float) or None
        x_min, y_min, x_max, y_max of the turned map, metres.
    memory_bytes : int
        For all that the process holds; pictures and canvases get what the poses leave of it.
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

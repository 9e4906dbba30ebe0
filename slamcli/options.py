"""Every command-line option that more than one command takes, defined once."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slamcli.core.config import (
    Datum,
    FeatureOptions,
    MapperOptions,
    MatchOptions,
    PaintOptions,
    ProductOptions,
)
from slamcli.core.telemetry import TelemetryOptions

if TYPE_CHECKING:
    from slamcli.run.networks import NetworkFiles

Options = TypeVar("Options")
Command = TypeVar("Command", bound=Callable[..., Any])
Decorator = Callable[[Command], Command]

PATH = click.Path(path_type=Path)
NOT_NEGATIVE = click.FloatRange(min=0)
POSITIVE = click.FloatRange(min=0, min_open=True)

frames = click.argument("frames", nargs=-1, required=True, type=PATH)
calibration = click.option(
    "-c",
    "--calibration",
    type=PATH,
    help="From `slam calibrate`. Default: calibration.yaml in the frames' folder; without one "
    "the frames are taken as top-down pictures, in pixel units.",
)
overwrite = click.option("--overwrite", is_flag=True, help="Replace earlier results.")
seed = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all randomness."
)
max_range = click.option(
    "--max-range",
    type=POSITIVE,
    help="Metres on the floor beyond which the image is not used, in place of the calibration's.",
)
metres_per_pixel = click.option(
    "--metres-per-pixel",
    type=POSITIVE,
    help="Resolution of the result. Default: chosen from how finely the camera sees the floor.",
)
self_calibrate = click.option(
    "--self-calibrate/--no-self-calibrate",
    default=False,
    help="Refine the camera by the frames themselves, where they determine it, and each frame's "
    "tilt and height; or take the calibration as it is [default].",
)
workers = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Threads; the result is the same for any number. Default: one a processor.",
)


def output(what: str, *, required: bool = False, default: str | None = None) -> Decorator[Any]:
    """Return the -o/--output option; `what` completes "Where ... goes"."""
    return click.option(
        "-o",
        "--output",
        type=PATH,
        required=required,
        default=default,
        show_default=default is not None,
        help=f"Where {what} goes.",
    )


def stacked(*decorators: Decorator[Any]) -> Decorator[Any]:
    """Return one decorator for several options, shown in the order given."""

    def decorate(command: Any) -> Any:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


def picked(kind: type[Options], told: Mapping[str, Any]) -> Options:
    """Return the options of one kind from all that the command line says; unsaid: the default."""
    names = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    said = {name: value for name, value in told.items() if name in names and value is not None}
    return kind(**said)


_FEATURES = FeatureOptions()
_MATCHING = MatchOptions()

FEATURES = ("orb", "sift", "aliked", "disk")


class Size(click.ParamType[tuple[int, int]]):
    """Width and height in pixels, such as 640x480."""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """Return (width, height); a usage error says what form is wanted."""
        match = re.fullmatch(r"(\d+)x(\d+)", str(value))
        if match is None or min(int(match[1]), int(match[2])) < 64:
            self.fail(f"{value!r} is not of the form 640x480, 64 or more each", param, ctx)
        return int(match[1]), int(match[2])


feature_details = stacked(
    click.option(
        "--weights", type=PATH, help="ALIKED, DISK: the network, an ONNX file that you have."
    ),
    click.option(
        "--network-size",
        type=Size(),
        help="ALIKED, DISK: pixels that the network takes. Default: 640x640, 1024x1024.",
    ),
    click.option(
        "--upright/--no-upright",
        default=_FEATURES.upright,
        help="Describe ORB's and SIFT's points as the robot sees them, for frames that differ "
        "little in heading, or turned with their surroundings [default].",
    ),
    click.option(
        "--spread/--no-spread",
        default=_FEATURES.spread,
        help="Keep the strongest points of every part of the picture [default], or of all of it.",
    ),
    click.option(
        "--refine/--no-refine",
        default=_FEATURES.refine,
        help="Place ORB's points to a fraction of a pixel [default], or on whole pixels.",
    ),
    click.option(
        "--clean/--no-clean",
        default=_FEATURES.clean,
        help="Low-pass the picture and make what is dark black, before [default: not].",
    ),
    click.option(
        "--clean-kernel",
        "clean_kernel_pixels",
        type=click.IntRange(min=1),
        default=_FEATURES.clean_kernel_pixels,
        show_default=True,
        help="Side of that low-pass's box, pixels.",
    ),
    click.option(
        "--clean-threshold",
        type=click.IntRange(0, 255),
        default=_FEATURES.clean_threshold,
        show_default=True,
        help="Gray level up to which it makes black.",
    ),
    click.option(
        "--roi/--no-roi",
        default=_FEATURES.roi,
        help="Leave out points near the border of what was seen [default], or keep them.",
    ),
    click.option(
        "--roi-border",
        "roi_border_pixels",
        type=click.IntRange(min=0),
        default=_FEATURES.roi_border_pixels,
        show_default=True,
        help="How near, in pixels of a point's pyramid level.",
    ),
    click.option(
        "--levels",
        type=click.IntRange(1, 32),
        default=_FEATURES.levels,
        show_default=True,
        help="ORB: levels of the pyramid.",
    ),
    click.option(
        "--scale-factor",
        type=click.FloatRange(1.01, 4.0),
        default=_FEATURES.scale_factor,
        show_default=True,
        help="ORB: from one level to the next.",
    ),
    click.option(
        "--first-level",
        type=click.IntRange(0, 31),
        default=_FEATURES.first_level,
        show_default=True,
        help="ORB: the level that is the picture itself; those below are enlarged.",
    ),
    click.option(
        "--edge-threshold",
        type=click.IntRange(min=1),
        default=_FEATURES.edge_threshold,
        show_default=True,
        help="ORB: pixels left out at each level's border.",
    ),
    click.option(
        "--patch-size",
        type=click.IntRange(min=5),
        default=_FEATURES.patch_size,
        show_default=True,
        help="ORB: pixels that a descriptor compares.",
    ),
    click.option(
        "--wta-k",
        type=click.IntRange(2, 4),
        default=_FEATURES.wta_k,
        show_default=True,
        help="ORB: points compared for each element of a descriptor.",
    ),
    click.option(
        "--fast-threshold",
        type=click.IntRange(1, 255),
        default=_FEATURES.fast_threshold,
        show_default=True,
        help="ORB: contrast of a corner.",
    ),
    click.option(
        "--min-fast-threshold",
        type=click.IntRange(1, 255),
        default=_FEATURES.min_fast_threshold,
        show_default=True,
        help="ORB: tried when that finds too few.",
    ),
    click.option(
        "--contrast-threshold",
        type=POSITIVE,
        default=_FEATURES.contrast_threshold,
        show_default=True,
        help="SIFT: contrast of a point.",
    ),
)

match_details = stacked(
    click.option(
        "--matcher",
        type=click.Choice(["nearest", "lightglue"]),
        default="nearest",
        show_default=True,
        help="Pair points by the nearest descriptors, or ALIKED's and DISK's by LightGlue.",
    ),
    click.option(
        "--matcher-weights", type=PATH, help="LightGlue: the network, an ONNX file that you have."
    ),
    click.option(
        "--filter",
        type=click.Choice(["ratio", "cross-check"]),
        default=_MATCHING.filter,
        show_default=True,
        help="Keep matches better than the second best, or that are each other's best.",
    ),
    click.option(
        "--ratio",
        type=click.FloatRange(0, 1, min_open=True),
        help="Largest ratio of the best to the second-best distance. "
        f"Default: {_MATCHING.ratio}, on plain pictures 0.8.",
    ),
    click.option(
        "--max-size-ratio",
        type=click.FloatRange(min=1),
        default=_MATCHING.max_size_ratio,
        show_default=True,
        help="Rigid fits: largest ratio of the sizes of two points that match.",
    ),
    click.option("--max-distance", type=POSITIVE, help="Largest distance of two descriptors."),
    click.option(
        "--threshold",
        type=POSITIVE,
        help="Largest residual of an inlier: metres, or pixels without a calibration. "
        "Default: from how well each point is known.",
    ),
    click.option(
        "--confidence",
        type=click.FloatRange(0, 1, min_open=True, max_open=True),
        default=_MATCHING.confidence,
        show_default=True,
        help="RANSAC stops when it has drawn a clean sample with this probability.",
    ),
    click.option(
        "--max-iterations",
        type=click.IntRange(min=1),
        default=_MATCHING.max_iterations,
        show_default=True,
        help="Most samples that RANSAC draws.",
    ),
    click.option(
        "--min-inliers",
        type=click.IntRange(min=2),
        default=_MATCHING.min_inliers,
        show_default=True,
        help="Fewest matches that must agree.",
    ),
    seed,
)


_MAPPER = MapperOptions()
_TELEMETRY = TelemetryOptions()

mapper_options = stacked(
    click.option(
        "--features",
        "method",
        type=click.Choice(FEATURES),
        default=_MAPPER.features.method,
        show_default=True,
    ),
    click.option(
        "--count",
        type=click.IntRange(min=1),
        default=_MAPPER.features.count,
        show_default=True,
        help="Most features a frame.",
    ),
    click.option(
        "--view-metres-per-pixel",
        type=POSITIVE,
        help="Resolution of the views that are matched. Default: from the camera's sampling.",
    ),
    click.option(
        "--recent-keyframes",
        type=click.IntRange(min=1),
        default=_MAPPER.recent_keyframes,
        show_default=True,
        help="How many keyframes back a frame is compared with.",
    ),
    click.option(
        "--keyframe-overlap",
        type=click.FloatRange(0, 1),
        default=_MAPPER.keyframe_overlap,
        show_default=True,
        help="A frame that shares less floor with the latest keyframe becomes one.",
    ),
    click.option(
        "--min-overlap",
        type=click.FloatRange(0, 1),
        default=_MAPPER.min_overlap,
        show_default=True,
        help="Least share of floor that a believed fit leaves in common.",
    ),
    click.option(
        "--max-turn",
        type=click.FloatRange(0, 180),
        default=_MAPPER.max_turn_degrees,
        show_default=True,
        help="Degrees: most that the robot turns between two frames that are compared.",
    ),
    click.option(
        "--min-score",
        type=click.FloatRange(-1, 1),
        default=_MAPPER.min_score,
        show_default=True,
        help="Least correlation of the overlap's pixels for a fit to be believed.",
    ),
    click.option(
        "--tilt-sigma",
        type=NOT_NEGATIVE,
        default=_MAPPER.tilt_sigma_degrees,
        show_default=True,
        help="Degrees by which the camera's pitch varies from frame to frame.",
    ),
    click.option(
        "--dense/--no-dense",
        default=_MAPPER.dense,
        help="Search the pixels for the motion where features do not convince [default], or not.",
    ),
    click.option(
        "--search-angle",
        type=click.FloatRange(0, 180),
        default=_MAPPER.search_angle_degrees,
        show_default=True,
        help="Degrees of turn to either side that this search tries.",
    ),
    click.option(
        "--max-rival",
        type=click.FloatRange(0, 1),
        default=_MAPPER.max_rival_evidence,
        show_default=True,
        help="A motion is ambiguous when another explains more than this share of what it does.",
    ),
    click.option(
        "--max-step",
        "max_step_metres",
        type=POSITIVE,
        help="Metres; the farthest that the robot goes from one frame to the next. On a floor that "
        "repeats, less than half its period tells which of its like spots is meant.",
    ),
    click.option(
        "--loops/--no-loops",
        default=_MAPPER.loops,
        help="Look for floor that was seen before [default], or take the frames as a chain.",
    ),
    click.option(
        "--refine-pixels/--no-refine-pixels",
        default=_MAPPER.refine,
        help="Refine each fit on the pixels themselves [default], or leave it to the features.",
    ),
)


def networks_of(told: Mapping[str, Any]) -> NetworkFiles:
    """Return what the flags say of networks."""
    from slamcli.run.networks import NetworkFiles

    return picked(NetworkFiles, told)


def mapper_of(told: Mapping[str, Any]) -> MapperOptions:
    """Return what the flags of a command that maps ask for."""
    return MapperOptions(
        features=picked(FeatureOptions, told),
        matching=picked(MatchOptions, told),
        metres_per_pixel=told["view_metres_per_pixel"],
        recent_keyframes=told["recent_keyframes"],
        keyframe_overlap=told["keyframe_overlap"],
        min_overlap=told["min_overlap"],
        max_turn_degrees=told["max_turn"],
        min_score=told["min_score"],
        tilt_sigma_degrees=told["tilt_sigma"],
        refine=told["refine_pixels"],
        dense=told["dense"],
        search_angle_degrees=told["search_angle"],
        max_rival_evidence=told["max_rival"],
        loops=told["loops"],
    )


class Measured(click.ParamType["tuple[float, ...] | None"]):
    """So many numbers, separated by commas, or the word auto: None."""

    def __init__(self, count: int, name: str) -> None:
        self.count, self.name = count, name

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...] | None:
        """Return the numbers; a usage error says what form is wanted."""
        if value == "auto":
            return None
        try:
            numbers = tuple(map(float, value.split(",")))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count or not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r} is not of the form {self.name}", param, ctx)
        return numbers


telemetry_options = stacked(
    click.option(
        "--odometry",
        type=PATH,
        help="The robot's odometry: CSV with stamp (s), x, y (m), heading (rad), or TUM. It "
        "carries the robot over floor that shows nothing.",
    ),
    click.option(
        "--compass",
        type=PATH,
        help="Headings: CSV with stamp and heading (rad from east) or bearing (from north).",
    ),
    click.option(
        "--gps",
        type=PATH,
        help="Places: CSV with stamp, latitude, longitude (WGS84). Needs slamcli[geo].",
    ),
    click.option(
        "--time-offset",
        type=Measured(1, "SECONDS|auto"),
        default="0",
        show_default=True,
        help="Added to the readings' stamps to get the frames'. auto finds it from odometry.",
    ),
    click.option(
        "--lever-arm",
        type=Measured(2, "AHEAD,LEFT|auto"),
        default="0,0",
        show_default=True,
        help="Metres from the robot's origin to the GPS antenna. auto estimates it.",
    ),
    click.option(
        "--odometry-sigma",
        type=POSITIVE,
        default=_TELEMETRY.odometry_distance_share,
        show_default=True,
        help="One standard deviation of odometry's distances, as a share of them.",
    ),
)


def telemetry_of(told: Mapping[str, Any]) -> TelemetryOptions:
    """Return what the flags of a command that takes readings ask for."""
    offset = told["time_offset"]
    return TelemetryOptions(
        time_offset_seconds=0.0 if offset is None else offset[0],
        lever_arm_metres=told["lever_arm"],
        odometry_distance_share=told["odometry_sigma"],
    )


class Choices(click.ParamType[tuple[str, ...]]):
    """Any of some words, separated by commas."""

    def __init__(self, words: tuple[str, ...]) -> None:
        self.words = words
        self.name = ",".join(words)

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        """Return the words chosen, in their own order; a usage error says which there are."""
        chosen = {word.strip() for word in value.split(",")} if isinstance(value, str) else value
        unknown = sorted(set(chosen) - {*self.words, ""})
        if unknown:
            self.fail(f"{unknown[0]!r} is none of {', '.join(self.words)}", param, ctx)
        return tuple(word for word in self.words if word in chosen)


camera_options = stacked(
    click.option("--size", type=Size(), default="640x480", show_default=True),
    click.option("--height", type=POSITIVE, default=0.3, show_default=True, help="Metres."),
    click.option(
        "--pitch",
        type=click.FloatRange(1, 90),
        default=38.0,
        show_default=True,
        help="Degrees below the horizontal.",
    ),
    click.option(
        "--roll",
        type=click.FloatRange(-45, 45),
        default=0.0,
        show_default=True,
        help="Degrees, right side down.",
    ),
    click.option(
        "--field-of-view",
        type=click.FloatRange(5, 150),
        default=62.0,
        show_default=True,
        help="Degrees across the picture's width.",
    ),
    click.option("--k1", type=float, default=0.0, show_default=True, help="Radial distortion."),
    click.option("--k2", type=float, default=0.0, show_default=True, help="Radial distortion."),
)
disturbance_options = stacked(
    click.option("--noise", type=NOT_NEGATIVE, default=2.0, show_default=True, help="Gray levels."),
    click.option(
        "--motion-blur",
        type=click.FloatRange(0, 1),
        default=0.0,
        show_default=True,
        help="Share of a step that the shutter is open for.",
    ),
    click.option(
        "--flicker",
        type=click.FloatRange(0, 0.95),
        default=0.0,
        show_default=True,
        help="Largest change of exposure, as a share.",
    ),
    click.option(
        "--vignetting",
        type=click.FloatRange(0, 1),
        default=0.15,
        show_default=True,
        help="Share of the brightness lost in the corners.",
    ),
    click.option(
        "--rocking",
        type=NOT_NEGATIVE,
        default=0.0,
        show_default=True,
        help="Degrees by which pitch and roll vary from frame to frame (one sigma).",
    ),
    click.option(
        "--bounce",
        type=NOT_NEGATIVE,
        default=0.0,
        show_default=True,
        help="Metres by which the height varies from frame to frame (one sigma).",
    ),
    click.option(
        "--boxes",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Things that stand on the floor along the way; every third one moves.",
    ),
    click.option(
        "--walkers",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Pairs of legs that cross the view.",
    ),
)
floor_options = stacked(
    click.option(
        "--floor",
        default="asphalt",
        show_default=True,
        help="asphalt, bare, carpet, concrete, course, planks, terrazzo, tiles, or a picture.",
    ),
    click.option(
        "--floor-metres-per-pixel",
        type=POSITIVE,
        default=0.001,
        show_default=True,
        help="Of a picture given as the floor.",
    ),
    click.option(
        "--wear",
        type=click.FloatRange(0, 1),
        default=0.5,
        show_default=True,
        help="How scuffed the floor is; 0: a course in pure black and white, all tiles alike.",
    ),
    click.option(
        "--room",
        type=NOT_NEGATIVE,
        default=0.0,
        show_default=True,
        help="Metres; side of a square room whose walls the camera sees; 0 is none.",
    ),
)
path_options = stacked(
    click.option(
        "--path",
        default="loop",
        show_default=True,
        help="line, loop, lawnmower, drift, or a CSV of poses with columns x, y, heading.",
    ),
    click.option(
        "--length", type=POSITIVE, default=8.0, show_default=True, help="Metres of the way."
    ),
    click.option("--frames", type=click.IntRange(min=1), default=100, show_default=True),
    click.option("--frame-rate", type=POSITIVE, default=10.0, show_default=True),
    click.option(
        "--lane",
        type=POSITIVE,
        default=0.6,
        show_default=True,
        help="Metres between the lawnmower's lanes.",
    ),
)


class Bytes(click.ParamType[int]):
    """An amount of memory, such as 500M or 2G."""

    name = "bytes"

    def convert(self, value: Any, param: Any, ctx: Any) -> int:
        """Return the bytes; a usage error says what form is wanted."""
        if isinstance(value, int):
            return value
        parts = re.fullmatch(r"(\d+(?:\.\d+)?)([kMGT]?)B?", value)
        if parts is None or float(parts[1]) <= 0:
            self.fail(f"{value!r} is no amount such as 500M or 2G", param, ctx)
        factor: int = 1000 ** " kMGT".index(parts[2] or " ")
        return round(float(parts[1]) * factor)


class Reals(click.ParamType[tuple[float, ...]]):
    """So many numbers, separated by commas."""

    def __init__(self, counts: tuple[int, ...], name: str) -> None:
        self.counts, self.name = counts, name

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...]:
        """Return the numbers; a usage error says what form is wanted."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in self.counts or not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r} is not of the form {self.name}", param, ctx)
        return numbers


_PRODUCTS = ProductOptions()

product_options = stacked(
    metres_per_pixel,
    click.option(
        "--blend",
        type=click.Choice(["best", "feather", "multiband", "median", "mean"]),
        default=_PRODUCTS.paint.blend,
        show_default=True,
        help="How the views of a spot become one: best takes the sharpest and hides the seams.",
    ),
    click.option(
        "--gain/--no-gain",
        default=_PRODUCTS.paint.gain,
        help="Even out exposure and vignetting [default], or paint pictures as they are.",
    ),
    click.option(
        "--standing/--no-standing",
        default=_PRODUCTS.paint.standing,
        help="Keep what stands on the floor or moves out of it, in standing.png [default], or not.",
    ),
    click.option(
        "--format",
        "formats",
        type=Choices(("png", "geotiff", "deepzoom", "nav2")),
        default="png",
        show_default=True,
        help="Of the map, separated by commas: png, geotiff, deepzoom, nav2.",
    ),
    click.option(
        "--layers",
        type=Choices(("resolution", "views", "last-frame")),
        default="",
        help="Also write for every pixel, separated by commas: resolution, views, last-frame.",
    ),
    click.option(
        "--nav-lines", is_flag=True, help="Nav2: painted lines are obstacles, not what stands."
    ),
    click.option(
        "--nav-resolution",
        type=POSITIVE,
        default=_PRODUCTS.nav_metres_per_pixel,
        show_default=True,
        help="Nav2: metres a pixel, at most.",
    ),
    click.option(
        "--rotate", type=float, default=0.0, show_default=True, help="Degrees counter-clockwise."
    ),
    click.option(
        "--crop",
        type=Reals((4,), "x_min,y_min,x_max,y_max"),
        help="Paint only x_min,y_min,x_max,y_max, metres in the rotated map.",
    ),
    click.option(
        "--datum",
        type=Reals((2, 3), "latitude,longitude[,heading]"),
        help="GeoTIFF: latitude,longitude of the map's origin and, counter-clockwise from east, "
        "the heading of its x axis, degrees.",
    ),
    click.option(
        "--memory",
        type=Bytes(),
        default="2G",
        show_default=True,
        help="For pictures and canvases; the map may be larger.",
    ),
)


def products_of(told: Mapping[str, Any]) -> ProductOptions:
    """Return what the flags of `product_options` ask for."""
    datum = told["datum"]
    return ProductOptions(
        paint=PaintOptions(
            metres_per_pixel=told["metres_per_pixel"],
            blend=told["blend"],
            gain=told["gain"],
            standing=told["standing"],
        ),
        formats=told["formats"],
        layers=told["layers"],
        nav_lines=told["nav_lines"],
        nav_metres_per_pixel=told["nav_resolution"],
        turn_radians=math.radians(told["rotate"]),
        crop=told["crop"],
        memory_bytes=told["memory"],
        datum=None
        if datum is None
        else Datum(datum[0], datum[1], math.radians(datum[2] if len(datum) > 2 else 0.0)),
    )

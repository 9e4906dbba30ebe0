"""Options of a simulated drive: its camera, disturbances, floor and path."""

from __future__ import annotations

from functools import partial

import click

from slamcli.cli.options.common import seed
from slamcli.cli.options.features import SIZE
from slamcli.cli.options.fields import option, stacked
from slamcli.cli.options.sections import (
    CAMERA,
    DISTURBANCES,
    ESSENTIAL,
    FLOOR,
    IMAGING,
    OUTPUT,
    expert,
    section,
)
from slamcli.cli.options.values import (
    AT_LEAST_ONE,
    NOT_NEGATIVE,
    PATH,
    POSITIVE,
    SHARE,
    Number,
    Whole,
)
from slamcli.core.bounds import HERTZ, TILT_DEGREES, Bounds
from slamcli.simulation.config import SimulationOptions

_drive = partial(option, SimulationOptions())
_camera = partial(option, SimulationOptions().camera)
_surface = partial(option, SimulationOptions().surface)
_imaging = partial(option, SimulationOptions().imaging)
_disturbance = partial(option, SimulationOptions().disturbances)
# More, or larger ones, take minutes or gigabytes before the first frame.
# [guarded by tests/robustness/boundaries.py]
_NUMBER = Whole(Bounds(0, 1_000, whole=True))
# More cover a tile wholly, and take seconds for each of hundreds of tiles.
_MARKS = Whole(Bounds(0, 100, whole=True))

_floor = section(
    ESSENTIAL,
    _drive(
        "floor",
        "--floor",
        text="A kind of floor, or a picture file. Kinds: asphalt, bare, carpet, carpet-tiles, "
        "concrete, course, paper, parquet, planks, road, terrazzo, tiles.",
    ),
)

_floor_details = expert(
    FLOOR,
    _drive(
        "floor_metres_per_pixel",
        "--floor-metres-per-pixel",
        POSITIVE,
        "Resolution of a picture given as --floor.",
    ),
    _surface(
        "wear",
        "--wear",
        SHARE,
        "How worn the floor is; at 0 a course is pure black and white, and all tiles are alike.",
    ),
    _surface(
        "tile_metres",
        "--tile",
        Number(Bounds(0.01, 5)),
        "Metres: side of a tile (tiles, carpet-tiles), joint to joint; of 20 squares of paper.",
    ),
    _surface(
        "grout_metres", "--grout", Number(Bounds(0, 10)), "Metres: width of the tiles' grout."
    ),
    _surface("marks", "--marks", _MARKS, "Number of spots on every tile, each at its own place."),
    click.option(
        "--layout",
        type=PATH,
        help="TOML file of a course's board, lines and squares; default: that of 2015.",
    ),
    _drive(
        "room_metres",
        "--room",
        NOT_NEGATIVE,
        "Metres: side of a square room whose walls the camera sees; 0 is no room.",
    ),
)

floor_options = stacked(_floor, _floor_details)

path_options = section(
    ESSENTIAL,
    _drive(
        "path",
        "--path",
        text="line, loop, lawnmower, drift, or a CSV of poses. Drift is a loop with free heading; "
        "the CSV has columns x, y, heading.",
    ),
    _drive("length_metres", "--length", POSITIVE, "Metres: length of the path."),
    _drive("frames", "--frames", AT_LEAST_ONE, "Number of frames."),
    _drive("frame_rate_hertz", "--frame-rate", Number(HERTZ), "Frames per second."),
    expert(
        ESSENTIAL,
        _drive("lane_metres", "--lane", POSITIVE, "Metres: distance between a lawnmower's lanes."),
    ),
)

_camera_pose = section(
    CAMERA,
    _camera("size", "--size", SIZE, "Width and height of a frame, in pixels."),
    _camera("height_metres", "--height", POSITIVE, "Metres: the camera's height over the floor."),
    _camera(
        "pitch_degrees",
        "--pitch",
        Number(Bounds(1, 90)),
        "Degrees: the camera's pitch below the horizontal.",
    ),
)

_camera_details = expert(
    CAMERA,
    _camera(
        "roll_degrees",
        "--roll",
        Number(Bounds(-45, 45)),
        "Degrees: the camera's roll, right side down.",
    ),
    _camera(
        "field_of_view_degrees",
        "--field-of-view",
        Number(Bounds(5, 150)),
        "Degrees: field of view across the picture's width.",
    ),
    _camera("k1", "--k1", Number(Bounds(-10, 10)), "Radial distortion of the lens, r^2."),
    _camera("k2", "--k2", Number(Bounds(-10, 10)), "Radial distortion of the lens, r^4."),
)

camera_options = stacked(_camera_pose, _camera_details)

imaging_options = expert(
    IMAGING,
    _imaging(
        "light",
        "--light/--no-light",
        text="Floors reflect light, and the camera encodes it (sRGB), with photon noise; else "
        "pictures are blended of encoded gray levels, and all options of this group but this one "
        "have no effect.",
    ),
    _imaging(
        "lens_blur_pixels",
        "--lens-blur",
        Number(Bounds(0, 100)),
        "Pixels: standard deviation of the lens's point spread.",
    ),
    _imaging("bayer", "--bayer/--no-bayer", text="One colour a pixel, and demosaicing."),
    _imaging(
        "sharpening",
        "--sharpening",
        Number(Bounds(0, 100)),
        "Share of an unsharp mask that the camera adds, with its halo.",
    ),
    _imaging(
        "rolling_shutter",
        "--rolling-shutter",
        SHARE,
        "Share of the time between two frames from the first row's exposure to the last's.",
    ),
    _imaging(
        "lamp_share",
        "--lamp",
        SHARE,
        "Greatest change of the light, as a share, by a lamp's pattern at the camera.",
    ),
    _imaging("dust", "--dust", _NUMBER, "Number of spots on the lens's glass."),
    _imaging(
        "auto_exposure",
        "--auto-exposure/--no-auto-exposure",
        text="Every picture has the same mean light.",
    ),
)

disturbance_options = expert(
    DISTURBANCES,
    _disturbance(
        "noise_gray",
        "--noise",
        Number(Bounds(0, 255)),
        "Gray levels: standard deviation of a mid-gray pixel's noise.",
    ),
    _disturbance(
        "motion_blur",
        "--motion-blur",
        SHARE,
        "Share of the time between two frames that the shutter is open for.",
    ),
    _disturbance(
        "flicker", "--flicker", Number(Bounds(0, 0.95)), "Largest change of exposure, as a share."
    ),
    _disturbance(
        "vignetting", "--vignetting", SHARE, "Share of the brightness lost in the corners."
    ),
    _disturbance(
        "rocking_degrees",
        "--rocking",
        Number(TILT_DEGREES),
        "Degrees: standard deviation of pitch and roll from frame to frame.",
    ),
    _disturbance(
        "bounce_metres",
        "--bounce",
        Number(Bounds(0, 1)),
        "Metres: standard deviation of the camera's height from frame to frame.",
    ),
    _disturbance(
        "boxes",
        "--boxes",
        _NUMBER,
        "Number of boxes that stand on the floor along the path; every third one moves.",
    ),
    _disturbance(
        "walkers", "--walkers", _NUMBER, "Number of pairs of legs that walk through the view."
    ),
)

output_options = expert(
    OUTPUT,
    _drive(
        "square_side_metres",
        "--square-side",
        POSITIVE,
        "Metres: side of the calibration square in square.png.",
    ),
    _drive(
        "jpeg_quality",
        "--jpeg-quality",
        Whole(Bounds(1, 100, whole=True)),
        "Quality of the frames' JPEG files.",
    ),
)

seed_option = section(ESSENTIAL, seed(SimulationOptions()))

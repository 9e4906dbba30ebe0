"""Options of a simulated drive, with their defaults; `slam simulate` uses the same fields."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """A pinhole camera with radial distortion on a robot.

    Attributes
    ----------
    size : (int, int)
        Width and height in pixels.
    height_metres : float
        Above the floor.
    pitch_degrees, roll_degrees : float
        Below the horizontal; right side down.
    field_of_view_degrees : float
        Across the picture's width, without distortion.
    k1, k2 : float
        Radial distortion (plumb_bob).
    """

    size: tuple[int, int] = (640, 480)
    height_metres: float = 0.30
    pitch_degrees: float = 38.0
    roll_degrees: float = 0.0
    field_of_view_degrees: float = 62.0
    k1: float = 0.0
    k2: float = 0.0


@dataclass(frozen=True, slots=True)
class CourseLayout:
    """White lines and squares on a dark board: x along it from its left end, y from its middle.

    Attributes
    ----------
    board_metres : (float, float)
        Length and width.
    line_metres, square_metres : float
        Width of a line; side of a square.
    lines : tuple of ((x, y), (x, y))
        Along either axis.
    squares : tuple of (x, y)
        Their corners of least x and y.
    """

    board_metres: tuple[float, float]
    line_metres: float
    square_metres: float
    lines: tuple[tuple[tuple[float, float], tuple[float, float]], ...]
    squares: tuple[tuple[float, float], ...]


# The IEEE SoutheastCon hardware competition, as we draw its course.
COURSE_OF_2015 = CourseLayout(
    board_metres=(2.4384, 1.2192),
    line_metres=0.0254,
    square_metres=0.3048,
    lines=(
        ((0.45, -0.56), (0.45, 0.56)),
        ((0.385, 0.0), (0.45, 0.0)),
        ((0.60, 0.0), (2.25, 0.0)),
        ((0.60, 0.0), (0.60, -0.56)),
        ((0.76, 0.0), (0.76, 0.20)),
        ((1.12, 0.0), (1.12, -0.20)),
        ((1.42, 0.0), (1.42, 0.20)),
        ((1.88, 0.0), (1.88, -0.20)),
        ((2.25, 0.0), (2.25, 0.40)),
    ),
    squares=((0.08, -0.1524), (0.61, 0.20), (0.97, -0.5048), (1.27, 0.20), (1.73, -0.5048)),
)


@dataclass(frozen=True, slots=True)
class FloorOptions:
    """What a floor is made of, besides its kind.

    Attributes
    ----------
    wear : float
        0 to 1: how scuffed and dusty a floor is; at 0 all tiles are alike, and planks have only
        five prints.
    tile_metres : float
        Side of a tile, from joint to joint (tiles, carpet tiles), or of 20 squares of paper.
    grout_metres : float
        Width of the tiles' grout.
    marks : int
        Spots on every tile, each at a place of its own: 3 to 10 mm, 10 to 40 % darker or lighter.
    layout : CourseLayout
        Of a line course.
    """

    wear: float = 0.5
    tile_metres: float = 0.10
    grout_metres: float = 0.003
    marks: int = 0
    layout: CourseLayout = field(default_factory=lambda: COURSE_OF_2015)


@dataclass(frozen=True, slots=True)
class DisturbanceOptions:
    """Disturbances of the pictures: noise, blur, light, a rocking camera, obstacles.

    Attributes
    ----------
    noise_gray : float
        Standard deviation of each pixel; of one at the mid-tone, in light.
    motion_blur : float
        Share of the time between two frames that the shutter is open for.
    flicker : float
        Largest change of exposure, as a share, either way.
    vignetting : float
        Share of the brightness lost in the corners.
    rocking_degrees : float
        Standard deviation of pitch and roll from frame to frame.
    bounce_metres : float
        Standard deviation of the camera's height from frame to frame.
    boxes : int
        Boxes that stand on the floor along the path; every third one moves.
    walkers : int
        Pairs of legs that walk through the view at some time.
    """

    noise_gray: float = 2.0
    motion_blur: float = 0.0
    flicker: float = 0.0
    vignetting: float = 0.15
    rocking_degrees: float = 0.0
    bounce_metres: float = 0.0
    boxes: int = 0
    walkers: int = 0


@dataclass(frozen=True, slots=True)
class ImagingOptions:
    """What is between the floor and the file: lens, sensor, and the camera's own processing.

    Attributes
    ----------
    light : bool
        Floors reflect light, on a linear scale, and the camera encodes it (sRGB); else pictures
        are blended of encoded gray levels, as the first worlds were.
    lens_blur_pixels : float
        Standard deviation of the lens's point spread.
    bayer : bool
        One colour a pixel, and demosaicing.
    sharpening : float
        Of the encoded picture: share of an unsharp mask, with its halo.
    rolling_shutter : float
        Share of the time between two frames from the first row's exposure to the last's.
    auto_exposure : bool
        Every picture is brought to the same mean.
    lamp_share : float
        Greatest change of the light by a pattern that moves with the camera.
    dust : int
        Spots on the glass.
    """

    light: bool = True
    lens_blur_pixels: float = 0.5
    bayer: bool = False
    sharpening: float = 0.0
    rolling_shutter: float = 0.0
    auto_exposure: bool = False
    lamp_share: float = 0.0
    dust: int = 0


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """Errors of the simulated odometry, compass and GPS.

    Attributes
    ----------
    odometry_scale_error : float
        Share of the distance by which odometry is too long.
    odometry_heading_drift : float
        Radians per metre, a constant.
    odometry_noise : float
        Standard deviation per step, as a share of its length, and of its turn.
    compass_sigma_degrees, compass_declination_degrees : float
    gps_sigma_metres : float
    datum_degrees : (float, float)
        WGS84 latitude and longitude of the map's origin; the map's x points east.
    """

    odometry_scale_error: float = 0.01
    odometry_heading_drift: float = 0.005
    odometry_noise: float = 0.02
    compass_sigma_degrees: float = 3.0
    compass_declination_degrees: float = 4.0
    gps_sigma_metres: float = 1.0
    datum_degrees: tuple[float, float] = (29.6436, -82.3549)


@dataclass(frozen=True, slots=True)
class SimulationOptions:
    """Options of a simulated drive: floor, path, camera, disturbances, sensors.

    Attributes
    ----------
    floor : str
        A kind of floor, or the file of a picture.
    floor_metres_per_pixel : float
        Of a picture.
    surface : FloorOptions
        Of a kind of floor.
    room_metres : float
        Side of a square room about the first frame, whose walls the camera sees; 0 is no room.
    path : str
        ``line``, ``loop``, ``lawnmower``, ``drift`` (a loop with free heading),
        or the file of a CSV with columns x, y, heading.
    length_metres : float
        Of the path.
    frames : int
    frame_rate_hertz : float
    lane_metres : float
        Distance between a lawnmower's lanes.
    square_side_metres : float
        Of the calibration square.
    jpeg_quality : int
    camera, imaging, disturbances, sensors
    seed : int
    """

    floor: str = "asphalt"
    floor_metres_per_pixel: float = 0.001
    surface: FloorOptions = field(default_factory=FloorOptions)
    room_metres: float = 0.0
    path: str = "loop"
    length_metres: float = 8.0
    frames: int = 100
    frame_rate_hertz: float = 10.0
    lane_metres: float = 0.6
    square_side_metres: float = 0.3048
    jpeg_quality: int = 92
    camera: CameraOptions = field(default_factory=CameraOptions)
    imaging: ImagingOptions = field(default_factory=ImagingOptions)
    disturbances: DisturbanceOptions = field(default_factory=DisturbanceOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    seed: int = 0

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
class DisturbanceOptions:
    """Disturbances of the pictures: noise, blur, light, a rocking camera, obstacles.

    Attributes
    ----------
    noise_gray : float
        Standard deviation of each pixel.
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
    wear : float
        0 to 1: how scuffed and dusty a floor is; at 0 all tiles are alike, and planks have only
        five patterns.
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
    camera, disturbances, sensors
    seed : int
    """

    floor: str = "asphalt"
    floor_metres_per_pixel: float = 0.001
    wear: float = 0.5
    room_metres: float = 0.0
    path: str = "loop"
    length_metres: float = 8.0
    frames: int = 100
    frame_rate_hertz: float = 10.0
    lane_metres: float = 0.6
    square_side_metres: float = 0.3048
    jpeg_quality: int = 92
    camera: CameraOptions = field(default_factory=CameraOptions)
    disturbances: DisturbanceOptions = field(default_factory=DisturbanceOptions)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    seed: int = 0

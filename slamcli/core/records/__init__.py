"""The records that cross the walls between stages; all frozen, arrays never written to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from slamcli.core.geometry import invert

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.core.config import FeatureOptions, TransformModel
    from slamcli.core.geometry import Grid, Pose2

DescriptorNorm = Literal["hamming", "hamming2", "l2"]
DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
LinkKind = Literal["step", "loop", "odometry", "compass", "gps", "partial"]
Status = Literal["tracked", "predicted", "lost"]
Unit = Literal["m", "px"]


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A camera over a flat floor.

    The robot frame lies on the floor straight below the camera: x ahead (the floor projection of
    the optical axis), y left, z up (ROS REP 103).

    Attributes
    ----------
    camera_matrix : (3, 3) float64, pixels
    distortion : (k,) float64
        Coefficients of `distortion_model`, in ROS camera_info order.
    distortion_model : str
        ``plumb_bob`` (k 4 or 5), ``rational_polynomial`` (k 8) or ``equidistant`` (fisheye, k 4).
    image_size : (int, int)
        Width and height in pixels.
    robot_from_image : (3, 3) float64
        Undistorted pixel (column, row) to floor metres (x, y).
    height_metres : float
        Of the camera's centre above the floor.
    pitch_radians : float
        Of the optical axis below the horizontal: positive looks down.
    roll_radians : float
        About the optical axis: positive lowers the camera's right side.
    max_range_metres : float
        Distance on the floor from the robot's origin beyond which the image is not used.
    focal_sigma_pixels, height_sigma_metres, pitch_sigma_radians, roll_sigma_radians : float
        One standard deviation of each; nan where it is not known.
    unit : str
        ``m``, or ``px`` for top-down frames without a calibration, where every "metre" is a pixel
        and height, pitch and roll are nan.
    """

    camera_matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    distortion_model: DistortionModel
    image_size: tuple[int, int]
    robot_from_image: NDArray[np.float64]
    height_metres: float
    pitch_radians: float
    roll_radians: float
    max_range_metres: float
    focal_sigma_pixels: float = float("nan")
    height_sigma_metres: float = float("nan")
    pitch_sigma_radians: float = float("nan")
    roll_sigma_radians: float = float("nan")
    unit: Unit = "m"

    @property
    def image_from_robot(self) -> NDArray[np.float64]:
        """(3, 3): floor metres to undistorted pixel; w > 0 in front of the camera."""
        return invert(self.robot_from_image)


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """A camera's lens and sensor, without where it is mounted.

    Attributes
    ----------
    camera_matrix : (3, 3) float64, pixels
    distortion : (k,) float64
        Coefficients of `distortion_model`, in ROS camera_info order.
    distortion_model : str
        As in `Calibration`.
    image_size : (int, int)
        Width and height in pixels.
    """

    camera_matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    distortion_model: DistortionModel
    image_size: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture of a sequence.

    Attributes
    ----------
    index : int
        Place in the sequence, from 0.
    name : str
    stamp : float or None
        Seconds.
    image : (H, W, 3) or (H, W) uint8, BGR or gray
    mask : (H, W) uint8 or None
        255 where the picture is opaque; None when all of it is.
    """

    index: int
    name: str
    stamp: float | None
    image: NDArray[np.uint8]
    mask: NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DenseLevel:
    """One level of a view's pyramid, ready to be compared pixel by pixel.

    Attributes
    ----------
    pixel_from_metres : (3, 3) float64
        Robot frame to this level's pixels.
    metres_per_pixel : float
    image, mask : (h, w) uint8
        The view, shrunk; 255 in the mask where all of a pixel was seen.
    detail : (h, w) float32
        The image without its slow brightness, which belongs to lamp and lens.
    inside : (h, w) uint8
        255 where the detail and its gradient are free of the mask's border.
    weight : (h, w) float32
        1 there, else 0.
    points : (N, 2) float64
        The pixels whose gradients tell most, metres, robot frame.
    values : (N,) float64
        Their detail.
    gradients : (N, 2) float64
        Of the detail, per metre.
    noise_gray : float
        One standard deviation of the camera's noise in the detail.
    normalised : (h, w) float32
        The detail with its local contrast evened out; 0 outside.
    energy : float
        The mean of its square, of what is inside.
    frame_noise_gray : float
        One standard deviation of the camera's noise in the frame itself; 0 where unknown.
    """

    pixel_from_metres: NDArray[np.float64]
    metres_per_pixel: float
    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    detail: NDArray[np.float32]
    inside: NDArray[np.uint8]
    weight: NDArray[np.float32]
    points: NDArray[np.float64]
    values: NDArray[np.float64]
    gradients: NDArray[np.float64]
    noise_gray: float
    normalised: NDArray[np.float32]
    energy: float
    frame_noise_gray: float


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """What one frame gives to the mapper: all that can be computed without any other frame.

    Attributes
    ----------
    index, name, stamp
        Of the frame.
    view : View or None
        Gray; None when the frame could not be used.
    features : Features or None
    reason : str
        Why the frame could not be used; empty when it could.
    levels : tuple of DenseLevel
        Of the view, from half resolution on.
    far_levels : tuple of DenseLevel
        Of a coarser view that reaches farther; empty where the camera sees no farther.
    repeats : (K, 2) float64
        Shifts, metres in the robot's axes, by which the view looks like itself.
    """

    index: int
    name: str
    stamp: float | None
    view: View | None
    features: Features | None
    reason: str = ""
    levels: tuple[DenseLevel, ...] = ()
    far_levels: tuple[DenseLevel, ...] = ()
    repeats: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame as it is kept for as long as the map lasts, to be compared with later ones.

    Attributes
    ----------
    index, name, stamp
        Of the frame.
    features : Features
    image, mask : bytes
        Of its view at half resolution, as JPEG and PNG.
    """

    index: int
    name: str
    stamp: float | None
    features: Features
    image: bytes
    mask: bytes


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A bird's-eye picture of the floor.

    Attributes
    ----------
    grid : Grid
        In the robot frame: the robot looks along x, to the right of the picture.
    image : (h, w) or (h, w, 3) uint8
    mask : (h, w) uint8
        255 where floor was really seen, else 0.
    frame_noise_gray : float
        One standard deviation of the camera's noise in the picture it was made of; 0 where unknown.
    """

    grid: Grid
    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    frame_noise_gray: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """What a detector found in a view, still in pixels: for drawings, and to become Features.

    Attributes
    ----------
    pixels : (N, 2) float64
        Column and row in the view.
    sizes : (N,) float32, pixels
        Diameter of what the descriptor is centred on.
    angles : (N,) float32, degrees
        Clockwise in the picture, in [0, 360); nan where the descriptor does not turn.
    responses : (N,) float32
    octaves : (N,) int32
        Pyramid level; 0 is the view itself.
    scales : (N,) float32
        Pixels of the view to a pixel of the pyramid level.
    sigmas : (N,) float32, pixels
        One standard deviation of the place, in the view.
    descriptors : (N, D) uint8 or float32
    norm : str
        How descriptors are compared.
    """

    pixels: NDArray[np.float64]
    sizes: NDArray[np.float32]
    angles: NDArray[np.float32]
    responses: NDArray[np.float32]
    octaves: NDArray[np.int32]
    scales: NDArray[np.float32]
    sigmas: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | NDArray[np.float32]
    norm: DescriptorNorm

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Points of the floor with what they look like; above this record there are no pixels.

    Attributes
    ----------
    points : (N, 2) float32, metres, robot frame
    descriptors : (N, D) uint8 (compare by Hamming distance) or float32 (by L2)
    scores : (N,) float32
        The detector's response: larger is stronger.
    sigmas : (N, 2) float32, metres
        One standard deviation along the line of sight on the floor, and across it.
    sizes : (N,) float32, metres
        Diameter of what the descriptor is centred on.
    angles : (N,) float32, radians
        Which way its surroundings are turned, counter-clockwise from the robot's x; nan where the
        descriptor does not turn with them.
    norm : str
        How descriptors are compared; ``hamming2`` counts pairs of bits (ORB with WTA_K 3 or 4).
    """

    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | NDArray[np.float32]
    scores: NDArray[np.float32]
    sigmas: NDArray[np.float32]
    sizes: NDArray[np.float32]
    angles: NDArray[np.float32]
    norm: DescriptorNorm = "hamming"

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """One transform fitted to the matches of two sets of features, or why none is believed.

    Attributes
    ----------
    model : str
    a_from_b : (3, 3) float64 or None
        Metres to metres; None when nothing at all could be fitted.
    pose : Pose2 or None
        The same when the model is rigid.
    covariance : (3, 3) float64 or None
        Of `pose`: x, y (m) and theta (rad), in b's own axes (GTSAM's tangent space).
    matches : (M, 2) int32
        Indices into a's and b's features.
    inliers : (M,) bool
    residuals : (M,) float64, metres
        Of all matches; nan without a fit.
    spread : float
        Of the inliers over the view: their narrower extent over that of all its points.
    reason : str
        Why the transform is not to be believed; empty when it is.
    """

    model: TransformModel
    a_from_b: NDArray[np.float64] | None
    pose: Pose2 | None
    covariance: NDArray[np.float64] | None
    matches: NDArray[np.int32]
    inliers: NDArray[np.bool_]
    residuals: NDArray[np.float64]
    spread: float
    reason: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the transform passed every gate."""
        return not self.reason

    @property
    def inlier_count(self) -> int:
        """How many matches agree with the transform."""
        return int(self.inliers.sum())

    @property
    def median_residual(self) -> float:
        """Of the inliers, in metres; nan without any."""
        return float(np.median(self.residuals[self.inliers])) if self.inliers.any() else np.nan

    @property
    def rms_residual(self) -> float:
        """Root mean square over the inliers, in metres; nan without any."""
        if not self.inliers.any():
            return np.nan
        return float(np.sqrt(np.mean(self.residuals[self.inliers] ** 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A measured motion between two frames.

    Attributes
    ----------
    a, b : int
        Frame indices.
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m) and theta (rad), in b's own axes (GTSAM's tangent space).
    inliers : int
    score : float
        How likely the motion is right, in [0, 1]; nan when no picture told it.
    kind : str
    """

    a: int
    b: int
    a_from_b: Pose2
    covariance: NDArray[np.float64]
    inliers: int
    score: float
    kind: LinkKind


@dataclass(frozen=True, slots=True)
class Rocking:
    """By how much the camera of one frame stood differently from the calibration.

    Attributes
    ----------
    pitch_radians, roll_radians : float
    height_metres : float
    """

    pitch_radians: float = 0.0
    roll_radians: float = 0.0
    height_metres: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """Where the robot was for one frame, or why that is not known.

    Attributes
    ----------
    index, name, stamp
        Of the frame.
    map_from_robot : Pose2 or None
        None when lost.
    status : str
    reason : str
        Why the frame is not tracked, or a remark; mostly empty when it is.
    fragment : int
        Which connected map the pose belongs to; -1 when lost.
    covariance : (3, 3) float64 or None
        Of x, y (m), theta (rad), in the robot's own axes.
    inliers : int
    score : float
        Of the surest link that placed the frame; nan without one.
    revised : tuple of int
        Frames whose earlier estimates this update changed.
    odom_from_robot : Pose2 or None
        The motions of all frames so far added up: it drifts and never jumps (ROS REP 105), for a
        controller, while `map_from_robot` may be revised. None when lost.
    rocking : Rocking or None
        How its camera stood; None for as calibrated.
    """

    index: int
    name: str
    stamp: float | None
    map_from_robot: Pose2 | None
    status: Status
    reason: str = ""
    fragment: int = -1
    covariance: NDArray[np.float64] | None = None
    inliers: int = 0
    score: float = float("nan")
    revised: tuple[int, ...] = field(default=())
    odom_from_robot: Pose2 | None = None
    rocking: Rocking | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FloorMap:
    """What a finished drive leaves behind to find oneself by.

    Attributes
    ----------
    calibration : Calibration
        Of the camera that made it.
    features : FeatureOptions
        How its points were found; a frame to be located is treated alike.
    metres_per_pixel : float
        Of the views.
    tilt_sigma_degrees : float
        By how much the camera's pitch varied.
    keyframes : tuple of Keyframe
        Those that are placed.
    estimates : tuple of PoseEstimate
        One for every frame, in order.
    links : tuple of Link
        Between them; odometry's too.
    """

    calibration: Calibration
    features: FeatureOptions
    metres_per_pixel: float
    tilt_sigma_degrees: float
    keyframes: tuple[Keyframe, ...]
    estimates: tuple[PoseEstimate, ...]
    links: tuple[Link, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A frame that has its place, ready to be painted.

    Attributes
    ----------
    index : int
        Of the frame.
    map_from_robot : Pose2
    calibration : Calibration
        Of this frame: its tilt and height may differ from the others'; the lens and the picture's
        size may not.
    """

    index: int
    map_from_robot: Pose2
    calibration: Calibration


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """A painted piece of the map.

    Attributes
    ----------
    grid : Grid
        In the map frame.
    image : (h, w, 3) uint8, BGR
    sharpness : (h, w) float32
        Pixels of a picture to a metre of floor, in the view that saw the floor best; 0 where
        nothing was seen.
    standing : (h, w, 4) uint8 BGRA or None
        What is not floor: opaque where it stands, half transparent where it was for a time only;
        None when there is nothing.
    views : (h, w) uint16
        How many frames saw the floor here, of those that were compared.
    latest : (h, w) int32
        Index of the last frame that did; -1 for none.
    """

    grid: Grid
    image: NDArray[np.uint8]
    sharpness: NDArray[np.float32]
    standing: NDArray[np.uint8] | None
    views: NDArray[np.uint16]
    latest: NDArray[np.int32]

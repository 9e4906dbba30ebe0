"""A frame, its bird's-eye view, its pyramid levels, and the keyframe that is kept of it."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.geometry import Grid
from slamcli.core.records.features import Features


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture of a sequence.

    Attributes
    ----------
    index : int
        Position in the sequence, from 0.
    name : str
    stamp : float or None
        Seconds.
    image : (H, W, 3) or (H, W) uint8, BGR or gray
    mask : (H, W) uint8 or None
        255 where the picture is opaque; None when all of it is.
    digest : bytes
        Of the file that it was decoded from; empty for one that was not.
    """

    index: int
    name: str
    stamp: float | None
    image: UInt8Array
    mask: UInt8Array | None = None
    digest: bytes = b""


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
    image: UInt8Array
    mask: UInt8Array
    frame_noise_gray: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PyramidLevel:
    """One level of a view's image pyramid, ready for photometric comparison.

    Attributes
    ----------
    pixel_from_metres : (3, 3) float64
        Robot frame to this level's pixels.
    metres_per_pixel : float
    image, mask : (h, w) uint8
        The view, shrunk; 255 in the mask where all of a pixel was seen.
    detail : (h, w) float32
        The image without its low frequencies of brightness, which are of lamp and lens.
    inside : (h, w) uint8
        255 where the detail and its gradient are free of the mask's border.
    weight : (h, w) float32
        1 there, else 0.
    points : (N, 2) float64
        The pixels with the strongest gradients, metres, robot frame.
    values : (N,) float64
        Their detail.
    gradients : (N, 2) float64
        Of the detail, per metre.
    noise_gray : float
        One standard deviation of the camera's noise in the detail.
    normalised : (h, w) float32
        The detail with normalised local contrast; 0 outside.
    energy : float
        The mean of its square over what is inside.
    frame_noise_gray : float
        One standard deviation of the camera's noise in the frame itself; 0 where unknown.
    """

    pixel_from_metres: Float64Array
    metres_per_pixel: float
    image: UInt8Array
    mask: UInt8Array
    detail: Float32Array
    inside: UInt8Array
    weight: Float32Array
    points: Float64Array
    values: Float64Array
    gradients: Float64Array
    noise_gray: float
    normalised: Float32Array
    energy: float
    frame_noise_gray: float


@dataclass(frozen=True, slots=True, eq=False)
class PreparedFrame:
    """A frame prepared for registration: all that can be computed without any other frame.

    Attributes
    ----------
    index, name, stamp
        Of the frame.
    view : View or None
        Gray; None when the frame could not be used.
    features : Features or None
    reason : str
        Why the frame could not be used; empty when it could.
    levels : tuple of PyramidLevel
        Of the view, from half resolution on.
    far_levels : tuple of PyramidLevel
        Of a coarser view of the floor beyond; empty where the camera sees no farther.
    repeats : (K, 2) float64 or None
        Shifts, metres in the robot's axes, by which the view looks like itself; None where they
        were not looked for yet.
    digest : bytes
        Of the frame's file; empty when there is none or it could not be read.
    """

    index: int
    name: str
    stamp: float | None
    view: View | None
    features: Features | None
    reason: str = ""
    levels: tuple[PyramidLevel, ...] = ()
    far_levels: tuple[PyramidLevel, ...] = ()
    repeats: Float64Array | None = None
    digest: bytes = b""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame that is kept as long as the map, for loop closure and relocalisation.

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

"""A frame, its bird's-eye view, its pyramid levels, and the keyframe that is kept of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from slamcli.core.deferred import Deferred
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
class Template:
    """The points of a level that another view is aligned with.

    Attributes
    ----------
    points : (N, 2) float64
        The pixels with the strongest gradients, metres, robot frame.
    slopes : (5, N) float64
        How their detail changes with x, y (per metre) and with a turn about the robot (per
        radian), then the detail itself and 1: rows, as numpy takes columns of rows quickly.
    """

    points: Float64Array
    slopes: Float64Array

    @classmethod
    def of(cls, points: Float64Array, values: Float64Array, gradients: Float64Array) -> Template:
        """Return the template of points with their detail (N,) and its gradients (N, 2)."""
        slopes = np.empty((5, len(points)))
        slopes[:2] = gradients.T
        slopes[2] = slopes[1] * points[:, 0] - slopes[0] * points[:, 1]
        slopes[3] = values
        slopes[4] = 1.0
        return cls(points, slopes)

    def part(self, chosen: BoolArray | slice) -> Template:
        """Return some of the points."""
        return Template(
            np.ascontiguousarray(self.points[chosen]),
            np.ascontiguousarray(self.slopes[:, chosen]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class NormalisedDetail:
    """A level's detail with normalised local contrast.

    Attributes
    ----------
    values : (h, w) float32
        0 outside.
    energy : float
        The mean of its square over what is inside.
    """

    values: Float32Array
    energy: float


@dataclass(frozen=True, slots=True, eq=False)
class PyramidLevel:
    """One level of a view's image pyramid, ready for photometric comparison.

    What only keyframes or only difficult pairs need is computed when it is needed.

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
    template : Deferred of Template
    contrast : Deferred of NormalisedDetail
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
    template: Deferred[Template]
    contrast: Deferred[NormalisedDetail]
    frame_noise_gray: float

    @property
    def points(self) -> Float64Array:
        """Of the template."""
        return self.template.value.points

    def part(self, chosen: BoolArray | slice) -> PyramidLevel:
        """Return the level with some of the template's points."""
        return replace(self, template=Deferred.of(self.template.value.part(chosen)))

    @property
    def normalised(self) -> Float32Array:
        """Values of the detail with normalised local contrast."""
        return self.contrast.value.values

    @property
    def energy(self) -> float:
        """Of the detail with normalised local contrast."""
        return self.contrast.value.energy


@dataclass(frozen=True, slots=True, eq=False)
class SampledLevel:
    """The finest level of a view that is not painted: read from the picture at single places.

    Attributes
    ----------
    pixel_from_metres : (3, 3) float64
        Robot frame to this level's pixels.
    metres_per_pixel : float
    mask : (h, w) uint8
        255 where floor is seen.
    inside : (h, w) uint8
        255 where the detail and its gradient are free of the mask's border.
    places : (h, w, 3) float32
        Column and row of the frame's picture at which each pixel is seen, and how many times the
        picture is halved until its pixels are as coarse as the level's.
    pictures : tuple of (H, W) uint8
        The frame's picture, smoothed, halved as many times as its number.
    around : (h / 2, w / 2) float32
        The mean brightness around each pixel of the second level.
    """

    pixel_from_metres: Float64Array
    metres_per_pixel: float
    mask: UInt8Array
    inside: UInt8Array
    places: Float32Array
    pictures: tuple[UInt8Array, ...]
    around: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class SparseView:
    """A view of which only what tracking compares is made.

    Attributes
    ----------
    finest : SampledLevel
    second : PyramidLevel
        Painted at its own resolution.
    """

    finest: SampledLevel
    second: PyramidLevel


@dataclass(frozen=True, slots=True, eq=False)
class Pyramids:
    """The image pyramids of a frame's views that are compared, or why there are none.

    Attributes
    ----------
    near : tuple of PyramidLevel
        Empty when the frame could not be used.
    far : tuple of PyramidLevel
        Of a coarser view of the floor beyond; empty where the camera sees no farther.
    reason : str
        Why the frame could not be used; empty when it could.
    """

    near: tuple[PyramidLevel, ...] = ()
    far: tuple[PyramidLevel, ...] = ()
    reason: str = ""


NO_PERIODS: Deferred[Float64Array] = Deferred.of(np.empty((0, 2)))
NO_PYRAMIDS: Deferred[Pyramids] = Deferred.of(Pyramids())
NO_SPARSE_VIEW: Deferred[SparseView | None] = Deferred.of(None)


@dataclass(frozen=True, slots=True, eq=False)
class PreparedFrame:
    """A frame prepared for registration: all that can be computed without any other frame.

    Its views, its features and the periods of its floor are computed when they are first needed.

    Attributes
    ----------
    index, name, stamp
        Of the frame.
    painting : Deferred of View, or None
        The gray view that features are detected in; None when the frame could not be used, and of
        keyframes that were stored.
    extraction : Deferred of Features, or None
        None when the frame could not be used.
    reason : str
        Why the frame could not be used, as far as is known; empty when it could.
    pyramids : Deferred of Pyramids
        Of the views that are compared, which are coarser.
    sparse : Deferred of SparseView or None
        Of the near one; None when the frame could not be used, has a mask of its own or was stored.
    periodicity : Deferred of (K, 2) float64
        Shifts, metres in the robot's axes, by which the view looks like itself.
    digest : bytes
        Of the frame's file; empty when there is none or it could not be read.
    tracked : Deferred of (PyramidLevel, PyramidLevel), or None
        What sparse views are aligned with: the two finest levels, the points of the first with
        their detail in the frame's own sparse view.
    finer : Deferred of PreparedFrame, or None
        The same frame at the full resolution, where `levels` are of half of it.
    """

    index: int
    name: str
    stamp: float | None
    painting: Deferred[View] | None
    extraction: Deferred[Features] | None
    reason: str = ""
    pyramids: Deferred[Pyramids] = NO_PYRAMIDS
    sparse: Deferred[SparseView | None] = NO_SPARSE_VIEW
    periodicity: Deferred[Float64Array] = NO_PERIODS
    digest: bytes = b""
    tracked: Deferred[tuple[PyramidLevel, PyramidLevel]] | None = None
    finer: Deferred[PreparedFrame] | None = None

    @property
    def levels(self) -> tuple[PyramidLevel, ...]:
        """The near pyramid, made when it is first needed; empty when the frame cannot be used."""
        return self.pyramids.value.near

    @property
    def far_levels(self) -> tuple[PyramidLevel, ...]:
        """The far pyramid, likewise; empty too where the camera sees no farther."""
        return self.pyramids.value.far

    @property
    def view(self) -> View | None:
        """The view of `painting`, made when it is first needed."""
        return None if self.painting is None else self.painting.value

    @property
    def features(self) -> Features | None:
        """The view's features, extracted when they are first needed; None as `extraction`."""
        return None if self.extraction is None else self.extraction.value

    @property
    def repeats(self) -> Float64Array:
        """The shifts of `periodicity`, found when they are first needed."""
        return self.periodicity.value


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame that is kept as long as the map, for loop closure and relocalisation.

    Attributes
    ----------
    index, name, stamp
        Of the frame.
    features : Features
    image, mask : bytes
        Of its view that is compared, as JPEG and PNG.
    """

    index: int
    name: str
    stamp: float | None
    features: Features
    image: bytes
    mask: bytes

"""The options of `slam stitch`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from slamcli.core.config import FrameSelection, MapperOptions, ProductOptions
from slamcli.core.telemetry import TelemetryOptions
from slamcli.run.networks import NO_NETWORKS, NetworkFiles

Mount = Literal["auto", "rigid", "gimbal", "hand"]
SelfCalibrate = Literal["auto", "always", "never"]


@dataclass(frozen=True, slots=True)
class ScaleBar:
    """Two pixels of a frame, column and row, and their distance on the floor."""

    frame: str
    first: tuple[float, float]
    second: tuple[float, float]
    metres: float


@dataclass(frozen=True, slots=True)
class StitchOptions:
    """Options of `slam stitch`; run.toml lists them.

    Attributes
    ----------
    mapper : MapperOptions
    telemetry : TelemetryOptions
    networks : NetworkFiles
    products : ProductOptions
        What is painted and written.
    max_range_metres : float or None
        Overrides the calibration's far limit.
    frame_rate : float or None
        Frames per second, for stamps.
    selection : FrameSelection
        Which frames of a video are used.
    mount : str
        How the camera is carried: ``rigid`` leaves it three degrees of freedom, ``gimbal`` its
        height too, ``hand`` six; ``auto`` finds out.
    unordered : bool
        The frames come in no order: pairs are found by appearance alone.
    intrinsics_path : Path or None
        The lens of a camera without a calibration.
    height_metres : float or None
        Of a camera without a calibration; None leaves the unit of length to the frames.
    scale : ScaleBar or None
    control : Path or None
        Control points, which give frames from above without a calibration their metres.
    self_calibrate : str
        Refine the camera by the frames, where they determine it: ``always``, ``never`` or, where
        they contradict the calibration, ``auto``.
    debug : bool
        Also draw every frame's matches.
    export : tuple of str
        Other files to write; see `slamcli.run.stitch.exports`.
    extend : Path or None
        A finished map that the frames are added to.
    resume : bool
        Continue an earlier run of the same frames and options that was cut off.
    strict : bool
        Exit 3 when any frame is lost.
    """

    mapper: MapperOptions
    telemetry: TelemetryOptions = field(default_factory=TelemetryOptions)
    networks: NetworkFiles = NO_NETWORKS
    products: ProductOptions = field(default_factory=ProductOptions)
    max_range_metres: float | None = None
    frame_rate: float | None = None
    selection: FrameSelection = field(default_factory=FrameSelection)
    mount: Mount = "auto"
    unordered: bool = False
    intrinsics_path: Path | None = None
    height_metres: float | None = None
    scale: ScaleBar | None = None
    control: Path | None = None
    self_calibrate: SelfCalibrate = "auto"
    debug: bool = False
    export: tuple[str, ...] = ()
    extend: Path | None = None
    resume: bool = False
    strict: bool = False

    @property
    def moves_freely(self) -> bool:
        """Whether the mount is given as one that is not rigid."""
        return self.mount in {"gimbal", "hand"}

    @property
    def level(self) -> bool:
        """Whether the mount is given as one that does not tilt."""
        return self.mount == "gimbal"

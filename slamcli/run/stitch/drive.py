"""A drive to be stitched: opened with its camera and readings, then with every frame located."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.config import MapperOptions
from slamcli.core.errors import CalibrationError, InputError
from slamcli.core.records import PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.io.calibrations import load_intrinsics
from slamcli.io.map_file import map_path
from slamcli.io.toml import Scalar
from slamcli.mapping.mapper import Mapper
from slamcli.run.inputs import CAMERA_OF_FRAMES, NO_CALIBRATION, Inputs, open_inputs
from slamcli.run.networks import with_match_network, with_point_network
from slamcli.run.paint import outputs
from slamcli.run.paint.thumbnails import Thumbnails
from slamcli.run.session.session import Session
from slamcli.run.stitch import exports
from slamcli.run.stitch.extend import open_extension
from slamcli.run.stitch.options import StitchOptions
from slamcli.run.stitch.static_light import without_static_light
from slamcli.run.telemetry import (
    Telemetry,
    TelemetryFiles,
    feed,
    read_telemetry,
    unused_note,
    with_antenna,
)
from slamcli.selfcal import RegisteredDrive, SelfCalibration


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What is stitched.

    Attributes
    ----------
    sources : tuple of Path
        Folders and files of the frames; with `--extend` those of the finished map first.
    inputs : Inputs
    telemetry_files : TelemetryFiles
    telemetry : Telemetry
        Their readings.
    options : StitchOptions
        With `--extend`, features and scale are those of the finished map.
    mapper : Mapper
        New: no frame has passed through it yet. With `--extend` it has the finished map's frames.
    intrinsics : Intrinsics or None
        The lens of a camera without a calibration, where it is known.
    """

    sources: tuple[Path, ...]
    inputs: Inputs
    telemetry_files: TelemetryFiles
    telemetry: Telemetry
    options: StitchOptions
    mapper: Mapper
    intrinsics: Intrinsics | None = None

    @property
    def paths(self) -> list[Path]:
        """All files that are read."""
        files, networks = self.telemetry_files, self.options.networks
        options = self.options
        given = (options.control, options.intrinsics_path)
        others = (files.odometry, files.compass, files.gps, *given, *networks.paths)
        extended = options.extend
        found = [*others, None if extended is None else map_path(extended)]
        return [*self.inputs.paths, *(path for path in found if path is not None)]


@dataclass(frozen=True, slots=True, eq=False)
class SurveyFacts:
    """What a survey found of its camera: rows of the closing table, and a section of run.toml."""

    rows: tuple[tuple[str, str], ...]
    section: dict[str, Scalar]


@dataclass(frozen=True, slots=True, eq=False)
class LocatedDrive:
    """A drive whose frames have a pose, or the reason why they have none.

    Attributes
    ----------
    drive : Drive
    mapper : Mapper
        After the last frame.
    registered : RegisteredDrive
        Camera, poses and links; refined by the self-calibration if there was one.
    thumbnails : Thumbnails
        Of the frames decoded on the way.
    vanished : tuple of str
        Names of the frames whose files were there at first and could not be read later.
    time_offset : str
        A line on the sensors' clock against the frames'; empty when it was not to be found.
    self_calibration : SelfCalibration or None
        None where the camera was not refined.
    camera_note : str
        Why it was not, where it was looked at.
    survey : SurveyFacts or None
        Of frames without a calibration that were located as a survey.
    on_earth : dict of int to Georeference
        Where a survey's maps lie, by the GPS of its photos.
    scale_rows : tuple of (str, str)
        How a map without a calibration got its metres.
    """

    drive: Drive
    mapper: Mapper
    registered: RegisteredDrive
    thumbnails: Thumbnails
    vanished: tuple[str, ...]
    time_offset: str
    self_calibration: SelfCalibration | None = None
    camera_note: str = ""
    survey: SurveyFacts | None = None
    on_earth: dict[int, Georeference] = field(default_factory=dict)
    scale_rows: tuple[tuple[str, str], ...] = ()

    @property
    def calibration(self) -> Calibration:
        """The camera that the poses are for."""
        return self.registered.calibration

    @property
    def note(self) -> str:
        """What was chosen and left out of the inputs, as the frames turned out to be."""
        if self.calibration.unit == "px":
            return self.drive.inputs.note
        return self.drive.inputs.note.replace(NO_CALIBRATION, CAMERA_OF_FRAMES)

    @property
    def georeferences(self) -> dict[int, Georeference]:
        """Where on Earth each map lies, as far as it is known."""
        return self.on_earth or self.mapper.georeferences

    @property
    def reached(self) -> int:
        """How many frames the run came to: all, unless it was interrupted."""
        return len(self.registered.estimates)

    @property
    def estimates(self) -> list[PoseEstimate]:
        """One estimate for every frame, also for those that an interrupted run did not reach."""
        reason = "not reached: interrupted"
        left = self.drive.inputs.files[self.reached :]
        return [
            *self.registered.estimates,
            *(PoseEstimate(f.index, f.name, f.stamp, None, "lost", reason) for f in left),
        ]


def open_drive(
    sources: Sequence[Path],
    calibration_path: Path | None,
    options: StitchOptions,
    telemetry_files: TelemetryFiles,
    session: Session,
) -> Drive:
    """Open all that a stitch reads, and refuse what could not be done or written later.

    Raises
    ------
    InputError, CalibrationError, MapError
    """
    extension = None
    if options.extend is None:
        inputs = open_inputs(
            sources,
            calibration_path,
            options.frame_rate,
            options.max_range_metres,
            options.selection,
            session.progress,
        )
        unused = unused_note(sources, telemetry_files)
        telemetry_options, antenna = with_antenna(options.telemetry, telemetry_files.gps)
        options = replace(options, telemetry=telemetry_options)
        inputs = replace(inputs, note="\n".join(filter(None, (inputs.note, unused, antenna))))
    else:
        _check_extension(options, calibration_path, telemetry_files)
        extension = open_extension(options.extend, sources, options.frame_rate)
        inputs, sources = extension.inputs, extension.sources
        options = replace(
            options,
            mapper=extension.options(options.mapper),
            selection=extension.floor_map.selection,
        )
    intrinsics = _intrinsics(options, inputs, telemetry_files)
    alone = inputs.calibration_path is None and extension is None and not telemetry_files.any
    if alone and options.mount == "auto":
        inputs = replace(inputs, files=without_static_light(inputs.files, session))
    if session.scheduler:
        # The cluster's workers run in folders of their own.
        absolute = [replace(file, path=file.path.absolute()) for file in inputs.files]
        inputs = replace(inputs, files=absolute)
    telemetry = read_telemetry(telemetry_files, inputs, options.telemetry.time_offset_seconds)
    exports.check_exports(options.export, inputs.files, has_gps=bool(telemetry.gps))
    outputs.check_products(options.products, inputs.calibration)
    if options.self_calibrate == "always" and telemetry_files.any:
        raise InputError(
            "--self-calibrate works by the frames alone; refine the camera first "
            "(slam calibrate --refine), then give what comes of it with the other sensors"
        )
    mapper = Mapper(inputs.calibration, _with_networks(options), options.telemetry)
    if extension is not None:
        mapper.extend(extension.floor_map)
    if not telemetry.find_time_offset:
        feed(mapper, telemetry)
    return Drive(tuple(sources), inputs, telemetry_files, telemetry, options, mapper, intrinsics)


def _intrinsics(
    options: StitchOptions, inputs: Inputs, telemetry_files: TelemetryFiles
) -> Intrinsics | None:
    """Return the lens; refuse it, and frames in no order, where neither can be used."""
    sensors = telemetry_files.any or options.extend is not None
    if options.unordered and sensors:
        raise InputError(
            "--unordered works by the frames alone; leave out --odometry, --compass, --gps and "
            "--extend"
        )
    if options.intrinsics_path is None:
        return None
    if inputs.calibration_path is not None or sensors:
        raise InputError(
            "--intrinsics is the lens of frames alone, without a calibration, other sensors or a "
            "map to extend; slam calibrate --intrinsics makes a calibration of it"
        )
    intrinsics = load_intrinsics(options.intrinsics_path)
    if intrinsics.image_size != inputs.calibration.image_size:
        wanted, size = intrinsics.image_size, inputs.calibration.image_size
        raise CalibrationError(
            f"{options.intrinsics_path} is for {wanted[0]}x{wanted[1]} images, but the frames have "
            f"{size[0]}x{size[1]}"
        )
    return intrinsics


def _check_extension(
    options: StitchOptions, calibration_path: Path | None, telemetry_files: TelemetryFiles
) -> None:
    """Refuse what a finished map cannot be extended with."""
    if calibration_path is not None or options.max_range_metres is not None:
        raise InputError("--extend takes the map's own camera; leave out -c and --max-range")
    if options.self_calibrate == "always" or telemetry_files.any:
        raise InputError(
            "--extend works by the frames alone, with the camera as it is; leave out "
            "--self-calibrate, --odometry, --compass and --gps, or stitch both drives anew"
        )


def _with_networks(options: StitchOptions) -> MapperOptions:
    """Return the mapper's options with the networks of its features and matching loaded."""
    mapper, files = options.mapper, options.networks
    method = mapper.features.method
    return replace(
        mapper,
        features=with_point_network(mapper.features, files, method),
        matching=with_match_network(mapper.matching, files, method),
    )

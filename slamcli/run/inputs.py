"""The inputs of a command: its frames, as a list of files, and their calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from slamcli.core.camera.calibration import Calibration, top_down_calibration
from slamcli.core.config import FrameSelection
from slamcli.core.errors import CalibrationError, FrameError, InputError
from slamcli.core.records import FloorMap, PoseEstimate
from slamcli.io.calibrations import load_calibration
from slamcli.io.containers.part import Progress, silent
from slamcli.io.frames import FrameFile, list_frames, of_camera
from slamcli.io.images.unread import unread_note

CALIBRATION_NAME = "calibration.yaml"
# Notes on frames without a calibration: as they are opened, and where a camera was found for them.
NO_CALIBRATION = "no calibration: top-down frames, pixel units"
CAMERA_OF_FRAMES = "no calibration: the camera and the scale are found from the frames"
# From so many files, evenly spread, the common size is taken when no calibration says it.
_SIZE_SAMPLES = 15


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """The frames of a command and their camera.

    Attributes
    ----------
    files : list of FrameFile
    calibration : Calibration
    calibration_path : Path or None
        None when the frames are taken as top-down pictures in pixel units.
    note : str
        Which calibration was chosen, when it was not named, and what of the sources is not read.
    """

    files: list[FrameFile]
    calibration: Calibration
    calibration_path: Path | None
    note: str

    @property
    def paths(self) -> list[Path]:
        """All files that are read, each once."""
        calibration = [] if self.calibration_path is None else [self.calibration_path]
        return list(dict.fromkeys([*calibration, *(file.path for file in self.files)]))


def open_inputs(
    sources: Sequence[Path],
    calibration_path: Path | None,
    frame_rate: float | None = None,
    max_range_metres: float | None = None,
    selection: FrameSelection | None = None,
    progress: Progress = silent,
) -> Inputs:
    """Return the frames and their calibration: the named one, else the one in their folder.

    Without any the frames are taken as top-down pictures, in pixel units.

    Raises
    ------
    InputError, CalibrationError
        When there is no frame, none that can be read, or the calibration is broken or of another
        image size than every frame that can be read.
    """
    files = list_frames(sources, frame_rate, selection, progress)
    path, note = calibration_path, ""
    if path is None:
        # A broken link too: without its calibration, frames would be in pixels.
        beside = _calibration_paths(sources, files)
        path = next((one for one in beside if one.is_symlink() or one.exists()), None)
        note = "" if path is None else f"calibration found: {path}"
    taken = taken_notes(files)
    unread = unread_note(files)
    if path is None:
        calibration = top_down_calibration(_common_size(files))
        return Inputs(files, calibration, None, _lines(NO_CALIBRATION, *taken, unread))
    calibration = load_calibration(path)
    if max_range_metres is not None:
        calibration = replace(calibration, max_range_metres=max_range_metres)
    check_size(files, calibration, path)
    files = of_camera(files, calibration.image_size)
    return Inputs(files, calibration, path, _lines(note, *taken, unread))


def taken_notes(files: Sequence[FrameFile]) -> list[str]:
    """Return a line for each video or bag: how many of its frames were taken."""
    notes = dict.fromkeys(file.part.note for file in files if file.part is not None)
    return [note for note in notes if note]


def _lines(*notes: str) -> str:
    return "\n".join(note for note in notes if note)


def map_sources(floor_map: FloorMap, path: Path, remedy: str) -> tuple[Path, ...]:
    """Return the folders and files of a map's frames.

    Parameters
    ----------
    path : Path
        Of the map, for messages.
    remedy : str
        What to do when they are not there.

    Raises
    ------
    InputError
    """
    if not floor_map.sources:
        raise InputError(
            f"{path} does not record where its frames are, as maps do since format version 3: "
            "stitch them again or, to render the map, give them with --frames"
        )
    gone = next((source for source in floor_map.sources if not source.exists()), None)
    if gone is not None:
        raise InputError(f"{gone}, where {path} has its frames, does not exist; {remedy}")
    return floor_map.sources


def map_file_of(files: Sequence[FrameFile], estimate: PoseEstimate, *, remedy: str) -> FrameFile:
    """Return the file of one frame of a map, by its place in the sequence and its name.

    Raises
    ------
    InputError
        When another file has that place; with what to do.
    """
    if estimate.index < len(files) and files[estimate.index].name == estimate.name:
        return files[estimate.index]
    raise InputError(
        f"the frames are not those of the map: frame {estimate.index} was {estimate.name}; {remedy}"
    )


def _calibration_paths(sources: Sequence[Path], files: Sequence[FrameFile]) -> list[Path]:
    folders = [source for source in sources if source.is_dir()]
    folders += [files[0].path.parent]
    return [folder / CALIBRATION_NAME for folder in folders]


def _sizes(files: Sequence[FrameFile]) -> Iterator[tuple[int, int]]:
    """Yield the width and height that each file declares; raises InputError when none does."""
    reason, any_size = "", False
    for file in files:
        try:
            size = file.size()
        except FrameError as error:
            reason = reason or f"{file.name}: {error}"
            continue
        any_size = True
        yield size
    if not any_size:
        raise InputError(f"none of the {len(files)} frames can be read; the first, {reason}")


def _common_size(files: Sequence[FrameFile]) -> tuple[int, int]:
    """Return the width and height of most frames: the first may be a thumbnail, or a plan."""
    sampled = files[:: max(1, len(files) // _SIZE_SAMPLES)]
    try:
        sizes = list(_sizes(sampled))
    except InputError:
        sizes = list(islice(_sizes(files), 1))
    return Counter(sizes).most_common(1)[0][0]


def check_size(files: Sequence[FrameFile], calibration: Calibration, path: Path) -> None:
    """Refuse a calibration of another image size early, not once for every frame."""
    wanted = calibration.image_size
    if wanted in _sizes(files):
        return
    size = _common_size(files)
    raise CalibrationError(
        f"{path} is for {wanted[0]}x{wanted[1]} images, but the frames have {size[0]}x{size[1]}; "
        "calibrate with a photo of the frames' size"
    )

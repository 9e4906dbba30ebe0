"""`slam stitch --extend`: a finished map and a later drive as one sequence of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError
from slamcli.core.records import FloorMap
from slamcli.io.frames import list_frames
from slamcli.io.map_file import MAP_NAME, load_map
from slamcli.io.runs import read_run
from slamcli.run.inputs import Inputs, check_size
from slamcli.run.render import file_of


@dataclass(frozen=True, slots=True, eq=False)
class Extension:
    """What it takes to go on with a finished map.

    Attributes
    ----------
    floor_map : FloorMap
    sources : tuple of Path
        Of all frames, the map's first.
    inputs : Inputs
        All frames, and the map's camera.
    """

    floor_map: FloorMap
    sources: tuple[Path, ...]
    inputs: Inputs

    def options(self, told: MapperOptions) -> MapperOptions:
        """Return a mapper's options with the map's own ways of seeing."""
        return replace(
            told,
            features=self.floor_map.features,
            metres_per_pixel=self.floor_map.metres_per_pixel,
            tilt_sigma_degrees=self.floor_map.tilt_sigma_degrees,
        )


def open_extension(finished: Path, later: Sequence[Path], frame_rate: float | None) -> Extension:
    """Return a finished map and the frames of a later drive, in the order of their taking.

    As poses of the map may move, its frames are painted again and must still be where they were.

    Parameters
    ----------
    finished : Path
        Output of `slam stitch`, or the map in it.
    later : sequence of Path

    Raises
    ------
    InputError, MapError, CalibrationError
    """
    floor_map, run = load_map(finished), read_run(finished)
    remedy = "put them back, or stitch both drives anew"
    gone = next((source for source in run.sources if not source.exists()), None)
    if gone is not None:
        raise InputError(
            f"{gone}, where the frames of the map were, does not exist; they are painted again "
            f"with the later ones: {remedy}"
        )
    known = {source.resolve() for source in run.sources}
    again = next((source for source in later if source.resolve() in known), None)
    if again is not None:
        raise InputError(f"{again} is part of that map already; give the frames of a later drive")
    sources = (*run.sources, *later)
    files = list_frames(sources, frame_rate)
    for estimate in floor_map.estimates:
        file_of(files, estimate, remedy=remedy)
    path = finished / MAP_NAME if finished.is_dir() else finished
    check_size(list_frames(later), floor_map.calibration, path)
    note = f"the map of {finished} is gone on with, by its own camera and features"
    return Extension(floor_map, sources, Inputs(files, floor_map.calibration, path, note))

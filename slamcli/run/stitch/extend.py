"""`slam stitch --extend`: a finished map and the frames of a later drive as one sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError
from slamcli.core.records import FloorMap
from slamcli.io.frames import list_frames, of_camera
from slamcli.io.map_file import load_map, map_path
from slamcli.run.inputs import Inputs, check_size, map_file_of, map_sources


@dataclass(frozen=True, slots=True, eq=False)
class Extension:
    """A finished map and the frames of both drives, to be stitched as one sequence.

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

    def options(self, given: MapperOptions) -> MapperOptions:
        """Return a mapper's options with the map's own features, resolution and tilt sigma."""
        return replace(
            given,
            features=self.floor_map.features,
            metres_per_pixel=self.floor_map.metres_per_pixel,
            tilt_sigma_degrees=self.floor_map.tilt_sigma_degrees,
        )


def open_extension(finished: Path, later: Sequence[Path], frame_rate: float | None) -> Extension:
    """Return a finished map and the frames of a later drive, in the order they were taken.

    As poses of the map may move, its frames are painted again and must still be where they were.

    Parameters
    ----------
    finished : Path
        Output of `slam stitch`, or the map in it; only its map.slam is read.
    later : sequence of Path

    Raises
    ------
    InputError, MapError, CalibrationError
    """
    floor_map = load_map(finished)
    path = map_path(finished)
    remedy = "put them back, as they are painted again, or stitch both drives as one"
    known = map_sources(floor_map, path, remedy)
    resolved = {source.resolve() for source in known}
    again = next((source for source in later if source.resolve() in resolved), None)
    if again is not None:
        raise InputError(f"{again} is part of that map already; give the frames of a later drive")
    sources = (*known, *later)
    files = list_frames(sources, frame_rate, floor_map.selection)
    for estimate in floor_map.estimates:
        map_file_of(files, estimate, remedy=remedy)
    added = [file for file in files if any(file.path.is_relative_to(one) for one in later)]
    check_size(added, floor_map.calibration, path)
    files = of_camera(files, floor_map.calibration.image_size)
    note = f"extending the map of {finished}, with its own camera and features"
    return Extension(floor_map, sources, Inputs(files, floor_map.calibration, path, note))

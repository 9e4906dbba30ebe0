"""`slam view --rerun`: a finished map as a recording for rerun's viewer."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import FrameError, InputError, MapError
from slamcli.core.records import FloorMap, PoseEstimate
from slamcli.io.files import read_text
from slamcli.io.frames import FrameFile, list_frames, read_frame, read_image
from slamcli.io.map_file import load_map, map_path
from slamcli.io.outputs import refuse_existing
from slamcli.io.rerun_recording import FloorTexture, check_rerun, write_rerun
from slamcli.run.inputs import map_file_of, map_sources

_FLOOR_PIXELS, _PICTURE_PIXELS = 4096, 640
_JPEG_QUALITY = 80
_REMEDY = "the recording has no pictures of the frames"


def export_rerun(run: Path, output: Path, *, overwrite: bool) -> list[str]:
    """Write a run's map, path and pictures into a recording; return lines on what is in it.

    Parameters
    ----------
    run : Path
        Output folder of `slam stitch`.

    Raises
    ------
    InputError, MapError, OutputError
    """
    check_rerun()
    floor_map = load_map(run, for_locating=False)
    files, note = _files(floor_map, run)
    read = [map_path(run), *_mosaics(run), *(file.path for file in files)]
    refuse_existing(output, inputs=read, overwrite=overwrite)

    def picture_of(estimate: PoseEstimate) -> bytes | None:
        try:
            file = map_file_of(files, estimate, remedy=_REMEDY)
            return _jpeg(read_frame(file).image)
        except (FrameError, InputError):
            return None

    write_rerun(output, floor_map, _floors(run), picture_of)
    lines = [note] if note else []
    return [*lines, f"{len(floor_map.estimates)} frames", f"written to {output}"]


def _files(floor_map: FloorMap, run: Path) -> tuple[list[FrameFile], str]:
    """Return the frames' files, and why there are none."""
    try:
        sources = map_sources(floor_map, run, _REMEDY)
        return list_frames(sources, selection=floor_map.selection), ""
    except (InputError, MapError) as error:
        return [], str(error)


def _mosaics(run: Path) -> list[Path]:
    return sorted((run if run.is_dir() else run.parent).glob("mosaic*.png"))


def _floors(run: Path) -> list[FloorTexture]:
    """Return the mosaics of a run, of at most some size."""
    found = []
    for path in _mosaics(run):
        numbers = read_text(path.with_suffix(".pgw"), "world file").split()
        a, d, b, e, c, f = map(float, numbers)
        image = read_image(path)
        height, width = image.shape[:2]
        pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
        # A world file has the middle of the first pixel.
        corners = (pixels - (0.5, 0.5, 0.0)) @ np.array([[a, d], [b, e], [c, f]])
        found.append(FloorTexture(path.stem, _within(image, _FLOOR_PIXELS), corners))
    return found


def _within(image: UInt8Array, max_pixels: int) -> UInt8Array:
    """Return an image reduced to a longest side."""
    scale = min(1.0, max_pixels / max(image.shape[:2]))
    if scale == 1.0:
        return image
    reduced = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(reduced, np.uint8)


def _jpeg(image: UInt8Array) -> bytes:
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, data = cv2.imencode(".jpg", _within(image, _PICTURE_PIXELS), quality)
    return data.tobytes()

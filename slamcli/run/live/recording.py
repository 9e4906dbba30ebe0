"""The recording of a live camera: a folder of frames, named by their stamps, as they come."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slamcli.core.errors import OutputError
from slamcli.core.records import Frame, PreparedFrame
from slamcli.io.files import write_image
from slamcli.io.frames import FrameFile
from slamcli.io.live_camera import Shot


class Recording:
    """Frames as JPEG, which `slam stitch` reads with the same result as while they came.

    Parameters
    ----------
    folder : Path
        Made where it is missing; must be empty.

    Attributes
    ----------
    files : list of FrameFile

    Raises
    ------
    OutputError
        When there is something in the folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.files: list[FrameFile] = []
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder} is there; give --record a new folder")

    def keep(self, shot: Shot, index: int) -> FrameFile:
        """Write one picture; raises OutputError."""
        frame = frame_of(shot, index)
        path = self._folder / f"{frame.name}.jpg"
        write_image(path, shot.image, durable=False)
        height, width = shot.image.shape[:2]
        file = FrameFile(index, path, frame.stamp, camera_size=(width, height))
        self.files.append(file)
        return file

    def note_digest(self, prepared: PreparedFrame) -> None:
        """Note a frame's content: no other is painted later."""
        self.files[prepared.index] = replace(self.files[prepared.index], digest=prepared.digest)


def frame_of(shot: Shot, index: int) -> Frame:
    """Return a picture as a frame, named by its stamp, to the microsecond."""
    name = f"{shot.stamp:.6f}"
    return Frame(index, name, float(name), shot.image)

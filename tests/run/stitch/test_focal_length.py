"""The focal length that photos note."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from photo_files import exif_of, write_photo

from slamcli.io.frames import list_frames
from slamcli.run.stitch.focal_length import noted_focal_pixels

PICTURE = np.full((48, 64, 3), 120, np.uint8)


def test_most_photos_decide(tmp_path: Path) -> None:
    for number, millimetres in enumerate((24, 24, 70)):
        write_photo(tmp_path / f"{number}.jpg", PICTURE, exif_of(focal_35mm=millimetres))
    files = list_frames([tmp_path])
    # A full-frame camera's diagonal is 43.27 mm.
    assert noted_focal_pixels(files, (64, 48)) == pytest.approx(24 / 43.2666 * 80.0, rel=1e-4)


def test_photos_without_notes_have_none(tmp_path: Path) -> None:
    write_photo(tmp_path / "0.jpg", PICTURE, exif_of())
    assert noted_focal_pixels(list_frames([tmp_path]), (64, 48)) is None

"""The focal length that photos note in their EXIF, as that of the same view on 35 mm film."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamcli.core.errors import FrameError
from slamcli.io.frames import FrameFile
from slamcli.io.images.photo import read_photo_info

# Of so many photos, evenly spread.
_SAMPLES = 9


def noted_focal_pixels(files: Sequence[FrameFile], size: tuple[int, int]) -> float | None:
    """Return the focal length of pictures of `size`, by most of the photos; None without."""
    found = []
    for file in files[:: max(1, len(files) // _SAMPLES)]:
        try:
            focal = read_photo_info(file.path).focal_pixels(size)
        except FrameError:
            continue
        if focal is not None:
            found.append(focal)
    return float(np.median(found)) if found else None

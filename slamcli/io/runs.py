"""The sections of run.toml that say which camera and which frames a run had."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.io import calibration_codec
from slamcli.io.toml import Scalar


def camera_section(calibration: Calibration) -> dict[str, Scalar]:
    """Return a calibration as a table of run.toml, every number in full, nan for the unknown."""
    section: dict[str, Scalar] = {}
    numbers: dict[str, Scalar] = {}
    for name, value in calibration_codec.to_dict(calibration).items():
        if isinstance(value, str):
            section[name] = value
        elif isinstance(value, list | tuple):
            section[name] = tuple(map(float, np.ravel(value)))
        else:
            numbers[name] = math.nan if value is None else value
    return {**section, **numbers}


def source_text(sources: Sequence[Path]) -> tuple[str, ...]:
    """Return the absolute paths of the folders and files that frames were read from."""
    return tuple(str(source.absolute()) for source in sources)

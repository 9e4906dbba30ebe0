"""Fixtures that more than one test module needs."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import pytest

# The tests already fill the processors.
cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The outside test data; its README tells what it is."""
    folder = os.environ.get("SLAMCLI_DATA")
    if not folder:
        pytest.skip("needs the outside test data: set SLAMCLI_DATA to its folder")
    return Path(folder).resolve()


@pytest.fixture(scope="session")
def samples_folder() -> Path:
    """The samples that the repository ships."""
    return Path(__file__).resolve().parent.parent / "samples"

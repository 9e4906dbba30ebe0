"""GeoTIFF: what GDAL refuses to write is one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamcli.core.errors import OutputError
from slamcli.io.raster import geotiff

rasterio = pytest.importorskip("rasterio")


def test_an_error_of_gdal_is_an_output_error_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = geotiff.RasterLayout((8, 8), 1, "uint8", np.eye(2, 3), None)

    def full(*_: object) -> None:
        raise rasterio._err.CPLE_AppDefinedError(1, 1, "IO error writing tag data")

    monkeypatch.setattr(geotiff, "_copy_as_cog", full)
    with pytest.raises(OutputError, match="IO error writing tag data"):
        geotiff.write_geotiff(tmp_path / "a.tif", layout, [(0, 0, np.ones((8, 8), np.uint8))])
    assert not list(tmp_path.iterdir())

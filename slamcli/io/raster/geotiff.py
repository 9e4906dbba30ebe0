"""Cloud-optimised GeoTIFF, written block by block by GDAL (through rasterio)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.core.arrays import Float64Array, GenericArray
from slamcli.core.config import Datum
from slamcli.core.errors import InputError, OutputError

_CACHE_MEGABYTES = 128


def check_geotiff() -> None:
    """Raise InputError when the library that writes GeoTIFF is not installed."""
    _rasterio()


def write_geotiff(
    path: Path,
    shape: tuple[int, int],
    bands: int,
    kind: str,
    blocks: Iterable[tuple[int, int, GenericArray]],
    transform: Float64Array,
    datum: Datum | None,
    nodata: float | None = None,
) -> None:
    """Write a tiled, deflated BigTIFF with overviews, laid out as COG; unseen blocks are left out.

    Parameters
    ----------
    shape : (int, int)
        Height and width, pixels.
    bands : int
        4 is red, green, blue and alpha; 1 is a layer.
    kind : str
        Numpy's name of the type.
    blocks : iterable of (row, column, (h, w[, bands]) array)
        Where each lies, and its pixels; colours as BGRA.
    transform : (3, 3) float64
        Metres from pixels, whole numbers at the upper left pixel's corner.
    datum : Datum or None
        Where the map lies on the earth; without one it has no coordinate system.

    Raises
    ------
    InputError
        When rasterio is not installed.
    OutputError
    """
    rasterio = _rasterio()
    plain = path.with_name(f".{path.stem}.plain.tif")
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": shape[0],
        "width": shape[1],
        "count": bands,
        "dtype": kind,
        "tiled": True,
        "blockxsize": 512,
        "blockysize": 512,
        "sparse_ok": True,
        "bigtiff": "IF_SAFER",
        "compress": "deflate",
        "zlevel": 1,
        "predictor": 3 if kind == "float32" else 2,
        "transform": rasterio.Affine(*transform[0], *transform[1]),
    }
    if bands == 4:
        profile |= {"photometric": "RGB", "alpha": "unspecified"}
    if nodata is not None:
        profile["nodata"] = nodata
    if datum is not None:
        profile["crs"] = _local_crs(datum)
    try:
        with (
            warnings.catch_warnings(),
            rasterio.Env(GDAL_CACHEMAX=_CACHE_MEGABYTES, GDAL_TIFF_INTERNAL_MASK=True),
        ):
            warnings.simplefilter("ignore")
            with rasterio.open(plain, "w", **profile) as target:
                if bands == 4:
                    colours = rasterio.enums.ColorInterp
                    target.colorinterp = (
                        colours.red,
                        colours.green,
                        colours.blue,
                        colours.alpha,
                    )
                for row, column, pixels in blocks:
                    _write_block(rasterio, target, row, column, pixels)
            rasterio.shutil.copy(
                plain,
                path,
                driver="COG",
                COMPRESS="DEFLATE",
                LEVEL=6,
                PREDICTOR="YES",
                BLOCKSIZE=512,
                BIGTIFF="IF_SAFER",
                SPARSE_OK="YES",
                OVERVIEWS="IGNORE_EXISTING",
                OVERVIEW_RESAMPLING="AVERAGE" if bands == 4 else "NEAREST",
            )
    except rasterio.errors.RasterioError as error:
        raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}") from error
    finally:
        plain.unlink(missing_ok=True)


def _write_block(rasterio: Any, target: Any, row: int, column: int, pixels: GenericArray) -> None:
    """Write the part of a block that lies inside of the raster."""
    top, left = max(0, row), max(0, column)
    bottom, right = (
        min(target.height, row + pixels.shape[0]),
        min(target.width, column + pixels.shape[1]),
    )
    if top >= bottom or left >= right:
        return
    part = pixels[top - row : bottom - row, left - column : right - column]
    window = rasterio.windows.Window(left, top, right - left, bottom - top)
    if part.ndim == 2:
        target.write(part, 1, window=window)
    else:
        target.write(np.moveaxis(part[..., [2, 1, 0, 3]], -1, 0), window=window)


def _local_crs(datum: Datum) -> str:
    """Return metres east and north of the datum, as PROJ's azimuthal equidistant projection."""
    latitude, longitude = datum.latitude_degrees, datum.longitude_degrees
    return f"+proj=aeqd +lat_0={latitude:.9f} +lon_0={longitude:.9f} +datum=WGS84 +units=m +no_defs"


def _rasterio() -> Any:
    try:
        import rasterio
        import rasterio.enums
        import rasterio.errors
        import rasterio.shutil
        import rasterio.windows
    except ImportError as error:
        raise InputError(
            "GeoTIFF needs rasterio; install it with: pip install slamcli[geotiff]"
        ) from error
    return rasterio

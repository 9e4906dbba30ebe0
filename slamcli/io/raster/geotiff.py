"""Cloud-optimised GeoTIFF (COG), written block by block by GDAL through rasterio."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.core.arrays import Float64Array, GenericArray
from slamcli.core.errors import InputError, OutputError

# GDAL's own cache of blocks, in place of its default of 5 % of the memory
# [guarded by benchmarks/scale.py: memory does not grow with the map].
_CACHE_MEGABYTES = 128
_BLOCK_PIXELS = 512
_COLOUR_BANDS = 4


def check_geotiff() -> None:
    """Raise InputError when the library that writes GeoTIFF is not installed."""
    _rasterio()


@dataclass(frozen=True, slots=True, eq=False)
class RasterLayout:
    """Size, pixel type and place on the ground of a raster.

    Attributes
    ----------
    shape : (int, int)
        Height and width, pixels.
    bands : int
        4 is red, green, blue and alpha; 1 is a layer.
    kind : str
        Numpy's name of the type.
    transform : (3, 3) float64
        Metres of that system, or of the map, from pixels; whole numbers at the upper left pixel's
        corner.
    crs : str or None
        The coordinate system that the transform leads to, as PROJ knows it; None for none.
    nodata : float or None
        What a pixel of a layer has where nothing was seen.
    """

    shape: tuple[int, int]
    bands: int
    kind: str
    transform: Float64Array
    crs: str | None
    nodata: float | None = None


def write_geotiff(
    path: Path, layout: RasterLayout, blocks: Iterable[tuple[int, int, GenericArray]]
) -> None:
    """Write a tiled, deflated BigTIFF with overviews, laid out as COG; unseen blocks are left out.

    Parameters
    ----------
    blocks : iterable of (row, column, (h, w[, bands]) array)
        Where each lies, and its pixels; colours as BGRA.

    Raises
    ------
    InputError
        When rasterio is not installed.
    OutputError
    """
    rasterio = _rasterio()
    plain = path.with_name(f".{path.stem}.plain.tif")
    try:
        with (
            warnings.catch_warnings(),
            rasterio.Env(GDAL_CACHEMAX=_CACHE_MEGABYTES, GDAL_TIFF_INTERNAL_MASK=True),
        ):
            warnings.simplefilter("ignore")
            _write_plain(rasterio, plain, layout, blocks)
            _copy_as_cog(rasterio, plain, path, layout)
    # GDAL's own errors, of a full disk among them, are no RasterioError.
    except (rasterio.errors.RasterioError, rasterio._err.CPLE_BaseError) as error:
        raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}") from error
    finally:
        plain.unlink(missing_ok=True)


def _profile(rasterio: Any, layout: RasterLayout) -> dict[str, Any]:
    """Return how GDAL's GTiff driver is to create the raster."""
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": layout.shape[0],
        "width": layout.shape[1],
        "count": layout.bands,
        "dtype": layout.kind,
        "tiled": True,
        "blockxsize": _BLOCK_PIXELS,
        "blockysize": _BLOCK_PIXELS,
        "sparse_ok": True,
        "bigtiff": "IF_SAFER",
        "compress": "deflate",
        "zlevel": 1,
        "predictor": 3 if layout.kind == "float32" else 2,
        "transform": rasterio.Affine(*layout.transform[0], *layout.transform[1]),
    }
    if layout.bands == _COLOUR_BANDS:
        profile |= {"photometric": "RGB", "alpha": "unspecified"}
    if layout.nodata is not None:
        profile["nodata"] = layout.nodata
    if layout.crs is not None:
        profile["crs"] = layout.crs
    return profile


def _write_plain(
    rasterio: Any,
    path: Path,
    layout: RasterLayout,
    blocks: Iterable[tuple[int, int, GenericArray]],
) -> None:
    """Write the blocks, in any order, into a TIFF without overviews."""
    with rasterio.open(path, "w", **_profile(rasterio, layout)) as target:
        if layout.bands == _COLOUR_BANDS:
            colours = rasterio.enums.ColorInterp
            target.colorinterp = (colours.red, colours.green, colours.blue, colours.alpha)
        for row, column, pixels in blocks:
            _write_block(rasterio, target, row, column, pixels)


def _copy_as_cog(rasterio: Any, plain: Path, path: Path, layout: RasterLayout) -> None:
    """Copy a TIFF with overviews and in a COG's order, which GDAL writes only as a copy."""
    rasterio.shutil.copy(
        plain,
        path,
        driver="COG",
        COMPRESS="DEFLATE",
        LEVEL=6,
        PREDICTOR="YES",
        BLOCKSIZE=_BLOCK_PIXELS,
        BIGTIFF="IF_SAFER",
        SPARSE_OK="YES",
        OVERVIEWS="IGNORE_EXISTING",
        OVERVIEW_RESAMPLING="AVERAGE" if layout.bands == _COLOUR_BANDS else "NEAREST",
    )


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

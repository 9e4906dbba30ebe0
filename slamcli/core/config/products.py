"""Options of the map that is painted and of its files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

MapFormat = Literal["png", "geotiff", "deepzoom", "nav2"]
Layer = Literal["resolution", "views", "last-frame"]
Blend = Literal["best", "feather", "multiband", "median", "mean"]


@dataclass(frozen=True, slots=True)
class PaintOptions:
    """Options of painting the map's picture from frames with poses.

    Attributes
    ----------
    metres_per_pixel : float or None
        None chooses it from the camera's sampling.
    blend : str
        Blending of several views of one spot.
    gain : bool
        Even out exposure and vignetting.
    obstacles : bool
        Keep obstacles and moving things out of the map where another view shows the floor.
    """

    metres_per_pixel: float | None = None
    blend: Blend = "best"
    gain: bool = True
    obstacles: bool = True


@dataclass(frozen=True, slots=True)
class Datum:
    """Position and heading of the map's origin on Earth.

    Attributes
    ----------
    latitude_degrees, longitude_degrees : float
        WGS84.
    east_heading_radians : float
        From the east, counter-clockwise, to the map's x axis.
    """

    latitude_degrees: float
    longitude_degrees: float
    east_heading_radians: float = 0.0


@dataclass(frozen=True, slots=True)
class ProductOptions:
    """Options of the map's files.

    Attributes
    ----------
    paint : PaintOptions
    formats : tuple of str
    layers : tuple of str
        Further values that are written for every pixel.
    nav_lines : bool
        Painted lines are occupied in the Nav2 map, in place of obstacles.
    nav_metres_per_pixel : float
        Of the Nav2 map; never finer than the mosaic.
    turn_radians : float
        Counter-clockwise rotation of the map.
    crop : (float, float, float, float) or None
        x_min, y_min, x_max, y_max of the turned map, metres.
    memory_bytes : int
        Of the whole process; pictures and canvases get what the poses leave of it.
    datum : Datum or None
    crs : str
        Coordinate system of the GeoTIFF, which it implies: ``EPSG:`` and a code, or ``auto`` for
        the UTM zone, as without.
    """

    paint: PaintOptions = field(default_factory=PaintOptions)
    formats: tuple[MapFormat, ...] = ("png",)
    layers: tuple[Layer, ...] = ()
    nav_lines: bool = False
    nav_metres_per_pixel: float = 0.01
    turn_radians: float = 0.0
    crop: tuple[float, float, float, float] | None = None
    memory_bytes: int = 1_400_000_000
    datum: Datum | None = None
    crs: str = ""

    @property
    def all_formats(self) -> tuple[MapFormat, ...]:
        """The formats, with GeoTIFF where a coordinate system is given for it."""
        more = self.crs and "geotiff" not in self.formats
        return (*self.formats, "geotiff") if more else self.formats

"""Geodesy: latitude and longitude as metres east and north of a datum, by pyproj.

pyproj is imported here and nowhere else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array
from slamcli.core.errors import InputError


def projection(datum_degrees: tuple[float, float]) -> str:
    """Return the PROJ string of a datum's plane: transverse Mercator, true to scale at the datum.

    Conformal; lengths are true to a millionth within 9 km (Snyder, Map Projections: A Working
    Manual, 1987, sec. 8).
    """
    latitude, longitude = datum_degrees
    return f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +datum=WGS84 +units=m"


class LocalPlane:
    """The transverse Mercator plane at a datum.

    Parameters
    ----------
    datum_degrees : (float, float)
        WGS84 latitude and longitude of its origin.

    Raises
    ------
    InputError
        When pyproj is not installed.
    """

    def __init__(self, datum_degrees: tuple[float, float]) -> None:
        try:
            from pyproj import CRS, Transformer
        except ImportError as error:
            raise InputError("GPS needs pyproj: pip install slamcli[geo]") from error
        self._datum_degrees = datum_degrees
        plane = CRS.from_proj4(projection(datum_degrees))
        self._plane_from_earth = Transformer.from_crs("EPSG:4326", plane, always_xy=True)

    def __reduce__(self) -> tuple[object, ...]:
        # A run's state contains the datum; pyproj's own objects are made again.
        return LocalPlane, (self._datum_degrees,)

    def east_north(self, latitude_degrees: float, longitude_degrees: float) -> tuple[float, float]:
        """Return metres east and north of the datum."""
        east, north = self._plane_from_earth.transform(longitude_degrees, latitude_degrees)
        return float(east), float(north)

    def geodetic(self, east_north: ArrayLike) -> Float64Array:
        """Return (N, 2) WGS84 latitude and longitude, degrees, of (N, 2) metres."""
        metres = np.asarray(east_north, dtype=np.float64).reshape(-1, 2)
        longitudes, latitudes = self._plane_from_earth.transform(
            metres[:, 0], metres[:, 1], direction="INVERSE"
        )
        return np.column_stack([latitudes, longitudes])

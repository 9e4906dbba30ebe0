"""Geodesy: latitude and longitude as metres east and north of a datum, by pyproj.

pyproj is imported here and nowhere else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array
from slamcli.core.config import Datum
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2

# The Universal Transverse Mercator system ends there. [by definition]
_MAX_UTM_DEGREES = 84.0
_STEP_METRES = 50.0


def projection(datum_degrees: tuple[float, float]) -> str:
    """Return the PROJ string of a datum's plane: transverse Mercator, true to scale at the datum.

    Conformal; lengths are true to a millionth within 9 km (Snyder, Map Projections: A Working
    Manual, 1987, sec. 8).
    """
    latitude, longitude = datum_degrees
    return f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +datum=WGS84 +units=m"


@dataclass(frozen=True, slots=True)
class MapProjection:
    """A map's place in a projected coordinate system that other programs know.

    Attributes
    ----------
    crs : str
        ``EPSG:n`` of the zone of the Universal Transverse Mercator system; beyond its latitudes
        the PROJ string of the plane at the datum.
    projected_from_map : (3, 3) float64
        A similarity: metres east and north, from metres of the map.
    """

    crs: str
    projected_from_map: Float64Array

    @property
    def turn_radians(self) -> float:
        """Angle from the projection's east to the map's x axis, counter-clockwise."""
        return math.atan2(self.projected_from_map[1, 0], self.projected_from_map[0, 0])


def check_crs(crs: str) -> None:
    """Refuse a code that is of no projected system in metres; ``auto`` and nothing are none.

    Raises
    ------
    InputError
        Also when pyproj is not installed.
    """
    if crs in {"", "auto"}:
        return
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ImportError as error:
        raise InputError("GPS needs pyproj: pip install slamcli[geo]") from error
    try:
        system = CRS.from_user_input(crs)
    except CRSError as error:
        raise InputError(f"--crs {crs} is not known to PROJ") from error
    if not (system.is_projected and all(axis.unit_name == "metre" for axis in system.axis_info)):
        raise InputError(f"--crs {crs} is no projected system in metres; auto is the UTM zone")


def project_map(datum: Datum, crs: str = "auto") -> MapProjection:
    """Return where a map lies in the system of its zone, or in one that is named by its code.

    Its scale and the convergence of the meridians are those at the map's origin: within 1 km the
    error is below 0.1 mm, as both planes are conformal.

    Raises
    ------
    InputError
        When pyproj is not installed, or the map lies beyond the named system.
    """
    latitude, longitude = datum.latitude_degrees, datum.longitude_degrees
    turn = Pose2(0.0, 0.0, datum.east_heading_radians).matrix
    if crs in {"", "auto"}:
        if abs(latitude) > _MAX_UTM_DEGREES:
            return MapProjection(projection((latitude, longitude)), turn)
        zone = int((longitude + 180.0) % 360.0 // 6.0) + 1
        crs = f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
    steps = np.array([(0.0, 0.0), (-_STEP_METRES, 0.0), (_STEP_METRES, 0.0)])
    origin, west, east = LocalPlane((latitude, longitude)).projected(steps, crs)
    x, y = (east - west) / (2.0 * _STEP_METRES)
    if not np.isfinite([*origin, x, y]).all():
        raise InputError(f"--crs {crs} does not reach {latitude:.4f}, {longitude:.4f}")
    there = np.array([[x, -y, origin[0]], [y, x, origin[1]], [0.0, 0.0, 1.0]])
    return MapProjection(crs, there @ turn)


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
        self._transformer = Transformer.from_crs
        self._plane = plane
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

    def projected(self, east_north: ArrayLike, crs: str) -> Float64Array:
        """Return (N, 2) metres in another projected system, of (N, 2) metres."""
        metres = np.asarray(east_north, dtype=np.float64).reshape(-1, 2)
        transformer = self._transformer(self._plane, crs, always_xy=True)
        return np.column_stack(transformer.transform(metres[:, 0], metres[:, 1]))

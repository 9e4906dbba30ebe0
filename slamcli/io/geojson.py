"""Trajectories and obstacles as GeoJSON (RFC 7946), for QGIS and web maps."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from slamcli.core.arrays import Float64Array
from slamcli.io.files import write_text


@dataclass(frozen=True, slots=True, eq=False)
class Polygon:
    """An outline, (N, 2) in the map, counter-clockwise, and what is known of it."""

    corners: Float64Array
    properties: Mapping[str, object]


def write_geojson(path: Path, tracks: Mapping[int, Float64Array]) -> None:
    """Write one line a fragment.

    Parameters
    ----------
    path : Path
    tracks : mapping of fragment to (N, 2) WGS84 latitude and longitude, degrees
    """
    features = []
    for fragment, positions in tracks.items():
        # GeoJSON puts the longitude first; nine decimals are a tenth of a millimetre.
        coordinates = [[round(lon, 9), round(lat, 9)] for lat, lon in positions.tolist()]
        properties = {"fragment": fragment, "frames": len(coordinates)}
        geometry = _geometry(coordinates)
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    collection = {"type": "FeatureCollection", "features": features}
    write_text(path, json.dumps(collection) + "\n")


def _geometry(coordinates: list[list[float]]) -> dict[str, object]:
    """Return a line; cut where it crosses 180 degrees of longitude (RFC 7946, section 3.1.9)."""
    if len(coordinates) == 1:
        return {"type": "Point", "coordinates": coordinates[0]}
    lines = [[coordinates[0]]]
    for before, after in pairwise(coordinates):
        if abs(after[0] - before[0]) > 180.0:
            side = math.copysign(180.0, before[0])
            gap = after[0] + 2.0 * side - before[0]
            share = (side - before[0]) / gap
            latitude = round(before[1] + share * (after[1] - before[1]), 9)
            lines[-1].append([side, latitude])
            lines.append([[-side, latitude]])
        lines[-1].append(after)
    if len(lines) == 1:
        return {"type": "LineString", "coordinates": lines[0]}
    return {"type": "MultiLineString", "coordinates": lines}


def write_polygons(path: Path, polygons: Sequence[Polygon], unit: str = "m") -> None:
    """Write outlines in lengths of the map, as the collection's own member says.

    GeoJSON's coordinates are degrees by default; those of a floor have no place on Earth.
    """
    features = []
    for polygon in polygons:
        ring = [[round(x, 6), round(y, 6)] for x, y in polygon.corners.tolist()]
        geometry = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
        features.append(
            {"type": "Feature", "properties": dict(polygon.properties), "geometry": geometry}
        )
    collection = {
        "type": "FeatureCollection",
        "coordinates": f"{unit} in the map frame",
        "features": features,
    }
    write_text(path, json.dumps(collection) + "\n")

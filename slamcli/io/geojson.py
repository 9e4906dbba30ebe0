"""Trajectories as GeoJSON (RFC 7946), for QGIS and web maps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from slamcli.core.arrays import Float64Array
from slamcli.io.files import write_text


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
        geometry: dict[str, object] = {"type": "LineString", "coordinates": coordinates}
        if len(coordinates) == 1:
            geometry = {"type": "Point", "coordinates": coordinates[0]}
        properties = {"fragment": fragment, "frames": len(coordinates)}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    collection = {"type": "FeatureCollection", "features": features}
    write_text(path, json.dumps(collection) + "\n")

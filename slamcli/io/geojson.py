"""The way driven as GeoJSON (RFC 7946), for QGIS, web maps and the like."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from slamcli.io.files import write_text

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray


def write_geojson(path: Path, tracks: Mapping[int, NDArray[np.float64]]) -> None:
    """Write one line a fragment.

    Parameters
    ----------
    path : Path
    tracks : mapping of fragment to (N, 2) WGS84 latitude and longitude, degrees
    """
    features = []
    for fragment, places in tracks.items():
        # GeoJSON puts the longitude first; nine decimals are a tenth of a millimetre.
        coordinates = [[round(lon, 9), round(lat, 9)] for lat, lon in places.tolist()]
        geometry: dict[str, object] = {"type": "LineString", "coordinates": coordinates}
        if len(coordinates) == 1:
            geometry = {"type": "Point", "coordinates": coordinates[0]}
        properties = {"fragment": fragment, "frames": len(coordinates)}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    collection = {"type": "FeatureCollection", "features": features}
    write_text(path, json.dumps(collection) + "\n")

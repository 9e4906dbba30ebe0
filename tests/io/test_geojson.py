"""Tracks as GeoJSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from slamcli.io.geojson import write_geojson


def test_a_line_is_cut_where_it_crosses_the_180th_meridian(tmp_path: Path) -> None:
    track = np.array([[-17.0, 179.9], [-17.1, 179.99], [-17.3, -179.99], [-17.4, -179.9]])
    write_geojson(tmp_path / "track.geojson", {0: track, 1: track[:2], 2: track[:1]})
    crossing, plain, point = json.loads((tmp_path / "track.geojson").read_text())["features"]
    assert crossing["geometry"] == {
        "type": "MultiLineString",
        "coordinates": [
            [[179.9, -17.0], [179.99, -17.1], [180.0, -17.2]],
            [[-180.0, -17.2], [-179.99, -17.3], [-179.9, -17.4]],
        ],
    }
    assert crossing["properties"]["frames"] == 4
    assert plain["geometry"]["type"] == "LineString"
    assert point["geometry"] == {"type": "Point", "coordinates": [179.9, -17.0]}

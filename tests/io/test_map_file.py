"""map.slam: what versions 2 and 3 have, and what is refused; forged files are in test_localizer."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from floor_pictures import forward_camera

from slamcli.core.camera.footprint import compared_grid, footprint
from slamcli.core.config import FeatureOptions
from slamcli.core.errors import MapError
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import Features, FloorMap, Keyframe, Link, PoseEstimate
from slamcli.io.map_file import FORMAT_VERSION, load_map, save_map


class Network:
    """Stands for a learned method's network, which no file can have."""

    size = (64, 64)


def picture_of(grid: Grid, steps: int) -> np.ndarray:
    """Return a picture of waves of 5 cm along x, of every so many-th pixel."""
    columns = np.arange(0, grid.width, steps)
    x = grid.x_min + (columns + 0.5) * grid.metres_per_pixel
    rows = -(-grid.height // steps)
    return np.tile(np.rint(128.0 + 100.0 * np.sin(2.0 * np.pi * x / 0.05)), (rows, 1)).astype(
        np.uint8
    )


def example(*, older: bool = False) -> FloorMap:
    """Return a map; with pictures as in format version 2 and 3, if older."""
    generator = np.random.default_rng(0)
    floats = generator.random((5, 4)).astype(np.float32) + np.float32(0.1)
    features = Features(
        floats[:, :2],
        generator.integers(0, 256, (5, 32), np.uint8),
        floats[:, 2],
        floats[:, 2:],
        floats[:, 3],
        floats[:, 0],
    )
    estimates = (
        PoseEstimate(0, "ä 0.png", 1.5, Pose2(), "tracked", "", 0, np.eye(3) * 1e-6, 9, 0.5),
        PoseEstimate(1, "1.png", None, None, "lost", "too dark"),
    )
    camera = forward_camera()
    grid = footprint(camera, 0.001) if older else compared_grid(camera, 0.001)
    picture = picture_of(grid, 2 if older else 1)
    image = cv2.imencode(".jpg", picture)[1].tobytes()
    mask = cv2.imencode(".png", np.full_like(picture, 255))[1].tobytes()
    keyframe = Keyframe(0, "ä 0.png", 1.5, features, image, mask)
    sources = (Path("/drives/first"), Path("/drives/ä/7.png"))
    return FloorMap(
        forward_camera(), FeatureOptions(), 0.001, 0.2, (keyframe,), estimates, (), sources
    )


def edited(path: Path, change: Any, version: int = FORMAT_VERSION) -> Path:
    """Write a map's file again with another header and version, and a checksum that is right."""
    data = path.read_bytes()
    start = data.index(b"\n") + 1 + 32
    length = int.from_bytes(data[start : start + 8], "little")
    header = json.loads(data[start + 8 : start + 8 + length])
    change(header)
    text = json.dumps(header, sort_keys=True).encode()
    body = len(text).to_bytes(8, "little") + text + data[start + 8 + length :]
    first_line = f"slamcli map {version}\n".encode()
    path.write_bytes(first_line + hashlib.sha256(body).digest() + body)
    return path


def as_version_2(path: Path) -> Path:
    """Turn a map's file into what was written before sources were recorded."""
    return edited(path, lambda header: header.pop("sources"), version=2)


def test_a_map_comes_back_with_its_sources(tmp_path: Path) -> None:
    path = tmp_path / "map.slam"
    link = Link(0, 1, Pose2(0.1), np.eye(3) * 1e-6, 20, 0.9, "step")
    save_map(path, replace(example(), links=(link,)))
    read = load_map(tmp_path)
    assert read.sources == example().sources
    assert [e.name for e in read.estimates] == ["ä 0.png", "1.png"]
    assert read.estimates[1].reason == "too dark"
    assert read.links[0].a_from_b == Pose2(0.1)
    assert read.keyframes[0].image == example().keyframes[0].image
    np.testing.assert_array_equal(
        read.keyframes[0].features.descriptors, example().keyframes[0].features.descriptors
    )
    save_map(tmp_path / "again.slam", read)
    assert (tmp_path / "again.slam").read_bytes() == path.read_bytes()


def test_a_map_of_version_2_loads_without_sources_its_pictures_where_they_were(
    tmp_path: Path,
) -> None:
    path = tmp_path / "map.slam"
    save_map(path, example(older=True))
    read = load_map(as_version_2(path))
    assert read.sources == ()
    assert len(read.keyframes) == 1
    assert read.calibration.height_metres == 0.3
    grid = compared_grid(read.calibration, read.metres_per_pixel)
    image, mask = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        for data in (read.keyframes[0].image, read.keyframes[0].mask)
    )
    assert image.shape == (grid.height, grid.width)
    seen = mask == 255
    assert seen.mean() > 0.95
    off = image.astype(float) - picture_of(grid, 1)
    # A millimetre, half of a pixel, would be 9.
    assert np.sqrt(np.mean(off[seen] ** 2)) < 3.0


def test_a_map_of_learned_features_can_be_rendered_but_not_located_in(tmp_path: Path) -> None:
    path = tmp_path / "map.slam"
    options = FeatureOptions(method="aliked", network=Network())  # type: ignore[arg-type]
    save_map(path, replace(example(), features=options))
    read = load_map(path, for_locating=False)
    assert (read.keyframes, read.features.method) == ((), "aliked")
    assert read.estimates[0].map_from_robot == Pose2()
    with pytest.raises(MapError, match="ALIKED features") as caught:
        load_map(path)
    assert "\n" not in str(caught.value)
    save_map(tmp_path / "again.slam", read)
    assert (tmp_path / "again.slam").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("sources", ["/drives", ["", "/a"], [1], ["a\0b"], ["a" * 40_000], None])
def test_sources_that_are_no_paths_are_refused(tmp_path: Path, sources: object) -> None:
    path = tmp_path / "map.slam"
    save_map(path, example())
    with pytest.raises(MapError, match="sources"):
        load_map(edited(path, lambda header: header.update(sources=sources)))


def test_a_calibration_that_is_no_camera_is_refused_with_the_file_named(tmp_path: Path) -> None:
    path = tmp_path / "map.slam"
    save_map(path, example())
    forged = edited(path, lambda header: header["calibration"].update(height_metres=0.4))
    with pytest.raises(MapError, match=r"map\.slam: its robot_from_image does not agree"):
        load_map(forged)

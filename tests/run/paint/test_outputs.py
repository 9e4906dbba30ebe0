"""What is written of a map, read back by the rules of each format and by rasterio."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
import yaml
from command_line import slam

from slamcli.core.config import Datum
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.core.records import Tile
from slamcli.io.frames import list_frames, read_frame
from slamcli.io.map_file import load_map, save_map
from slamcli.io.raster import deepzoom, geotiff, world_file
from slamcli.io.raster.tile_store import TileStore
from slamcli.run.paint import budget, frame_cache, thumbnails
from slamcli.simulation.drive import geodetic_from_local
from slamcli.stages.mosaic.source_image import SourceImage

rasterio = pytest.importorskip("rasterio")
warp = pytest.importorskip("rasterio.warp")
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
EVERYTHING = ("--format", "png,geotiff,deepzoom,nav2", "--layers", "resolution,views,last-frame")
COARSE = ("--metres-per-pixel", "0.004")


@pytest.fixture(scope="module")
def written(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("out") / "map"
    datum = ("--datum", "29.6436,-82.3549,30")
    result = slam("stitch", drive, "-o", output, *EVERYTHING, *COARSE, *datum)
    assert result.exit_code == 0, result.output
    assert "tiles; about" in result.output
    assert not any(path.name.startswith(".") for path in output.iterdir())
    return output


def picture(folder: Path, name: str = "mosaic.png") -> np.ndarray:
    image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def test_the_geotiff_is_a_cog_with_the_pngs_pixels_in_its_place(written: Path) -> None:
    png = picture(written)
    with rasterio.open(written / "mosaic.tif") as tif:
        assert tif.profile["tiled"]
        assert tif.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert tif.count == 4
        assert tif.colorinterp[3] == rasterio.enums.ColorInterp.alpha
        np.testing.assert_array_equal(np.moveaxis(tif.read(), 0, -1)[..., [2, 1, 0, 3]], png)
        world = np.loadtxt(written / "mosaic.pgw")
        x, y = tif.transform @ (0.5, 0.5)
        assert tif.crs.to_epsg() == 32617
        # The map's x axis is 30 degrees north of east; 1e-9 degrees are a tenth of a millimetre.
        turned = Pose2(0.0, 0.0, np.radians(30.0)).apply([world[4:6]])
        expected = geodetic_from_local(turned, (29.6436, -82.3549))[0]
        longitude, latitude = warp.transform(tif.crs, "EPSG:4326", [x], [y])
        np.testing.assert_allclose((latitude[0], longitude[0]), expected, atol=1e-9)


def test_a_map_with_a_place_on_earth_is_rendered_with_north_up(
    written: Path, drive: Path, tmp_path: Path
) -> None:
    """As GPS leaves it in map.slam: its corners are where the map says, in its zone's metres."""
    floor_map = load_map(written)
    datum = Datum(-33.9, 18.4, np.radians(30.0))
    save_map(tmp_path / "on_earth" / "map.slam", replace(floor_map, datums=((0, datum),)))
    assert load_map(tmp_path / "on_earth").datums == ((0, datum),)
    output = tmp_path / "out"
    formats = ("--format", "png,geotiff")
    result = slam(
        "render", tmp_path / "on_earth", "--frames", drive, "-o", output, *COARSE, *formats
    )
    assert result.exit_code == 0, result.output
    world = np.loadtxt(output / "mosaic.pgw").reshape(3, 2).T
    with rasterio.open(output / "mosaic.tif") as tif:
        assert tif.crs.to_epsg() == 32734
        assert tif.transform.b == tif.transform.d == 0.0
        assert tif.transform.a == -tif.transform.e == pytest.approx(0.004, rel=1e-3)
        for column, row in ((0, 0), (tif.width - 1, 0), (0, tif.height - 1)):
            x, y = tif.transform @ (column + 0.5, row + 0.5)
            longitude, latitude = warp.transform(tif.crs, "EPSG:4326", [x], [y])
            turned = Pose2(0.0, 0.0, datum.east_heading_radians).apply([world @ (column, row, 1)])
            expected = geodetic_from_local(turned, (-33.9, 18.4))[0]
            np.testing.assert_allclose((latitude[0], longitude[0]), expected, atol=1e-9)


def test_the_layers_tell_how_each_pixel_was_seen(written: Path) -> None:
    seen = picture(written)[..., 3] > 0
    with rasterio.open(written / "resolution.tif") as tif:
        resolution = tif.read(1)
    np.testing.assert_array_equal(resolution > 0, seen)
    assert 0.0004 < resolution[seen].min() < resolution[seen].max() < 0.03
    micrometres = picture(written, "resolution.png")
    np.testing.assert_allclose(micrometres, resolution * 1e6, atol=0.51)
    with rasterio.open(written / "views.tif") as tif:
        views = tif.read(1)
    assert views.dtype == np.uint16
    np.testing.assert_array_equal(picture(written, "views.png"), views)
    assert views.max() == 5
    with rasterio.open(written / "last-frame.tif") as tif:
        assert tif.nodata == -1
        np.testing.assert_array_equal(tif.read(1) + 1, picture(written, "last-frame.png"))
        assert tif.read(1).max() == 4


def test_the_pyramid_follows_deep_zooms_rules(written: Path) -> None:
    png = picture(written)
    root = ET.parse(written / "mosaic.dzi").getroot()
    space = "{http://schemas.microsoft.com/deepzoom/2009}"
    assert root.tag == f"{space}Image"
    side = int(root.attrib["TileSize"])
    size = root.find(f"{space}Size")
    assert size is not None
    width, height = int(size.attrib["Width"]), int(size.attrib["Height"])
    top = (max(width, height) - 1).bit_length()
    levels = sorted(int(path.name) for path in (written / "mosaic_files").iterdir())
    assert levels == list(range(top + 1))
    assert picture(written, "mosaic_files/0/0_0.png").shape[:2] == (1, 1)
    whole = np.zeros((height, width, 4), np.uint8)
    for path in (written / "mosaic_files" / str(top)).iterdir():
        column, row = map(int, path.stem.split("_"))
        tile = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        place = whole[row * side :, column * side :]
        place[: tile.shape[0], : tile.shape[1]] = tile
    rows, columns = np.nonzero(whole[..., 3])
    cut = whole[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    np.testing.assert_array_equal(cut, png)


def test_a_pyramid_of_odd_size_ends_in_one_pixel(tmp_path: Path) -> None:
    tile = np.full((8, 8, 4), 255, np.uint8)
    deepzoom.write_deep_zoom(tmp_path, "m", (37, 21), 8, [(0, 0, tile), (2, 4, tile)])
    shapes = {
        path.name: cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape[:2]
        for path in (tmp_path / "m_files" / "6").iterdir()
    }
    assert shapes == {"0_0.png": (8, 8), "4_2.png": (5, 5)}
    assert cv2.imread(str(tmp_path / "m_files/0/0_0.png"), -1).shape == (1, 1, 4)


def load_nav2(folder: Path, name: str = "nav2.yaml") -> tuple[np.ndarray, Grid]:
    """Read a map as Nav2's map_server does (trinary): -1 unknown, 0 free, 100 occupied.

    Of a picture with transparency it takes the mean of all channels, that one included.
    """
    description = yaml.safe_load((folder / name).read_text())
    assert description["mode"] == "trinary"
    pixels = cv2.imread(str(folder / description["image"]), cv2.IMREAD_UNCHANGED)
    gray = pixels if pixels.ndim == 2 else pixels.mean(axis=2)
    occupancy = (255 - gray.astype(float)) / 255
    cells = np.full(gray.shape, -1)
    cells[occupancy < description["free_thresh"]] = 0
    cells[occupancy > description["occupied_thresh"]] = 100
    x, y, yaw = description["origin"]
    assert yaw == 0
    scale = description["resolution"]
    height, width = gray.shape
    return cells, Grid(x, y + height * scale, scale, width, height)


def test_a_mosaic_is_no_occupancy_to_map_server(written: Path) -> None:
    """Neither is its dark floor occupied, nor what was not seen, nor its bright floor free."""
    cells, _ = load_nav2(written, "mosaic.yaml")
    assert (cells == -1).all()


def test_the_nav2_map_is_free_where_views_from_apart_agree(
    written: Path, drive: Path, tmp_path: Path
) -> None:
    finer = ("--metres-per-pixel", "0.001", "--crop", "0.3,-0.3,0.8,0.3", "--format", "nav2,png")
    result = slam("render", written, "--frames", drive, "-o", tmp_path / "fine", *finer)
    assert result.exit_code == 0, result.output
    cells, grid = load_nav2(tmp_path / "fine")
    assert grid.metres_per_pixel == pytest.approx(0.008)
    png, world = picture(tmp_path / "fine"), np.loadtxt(tmp_path / "fine" / "mosaic.pgw")
    rows, columns = np.nonzero(cells == 0)
    metres = apply_homography(grid.metres_from_pixel, np.column_stack([columns, rows]))
    pixels = np.rint((metres - world[4:6]) / (world[0], world[3])).astype(int)
    inside = np.all((pixels >= 0) & (pixels < png.shape[1::-1]), axis=1)
    seen = png[pixels[inside, 1], pixels[inside, 0], 3] > 0
    assert seen.mean() > 0.97
    # The course's marks are paint: there is no obstacle on it.
    assert not (cells == 100).any()
    assert (cells == 0).mean() > 0.5
    assert json.loads((tmp_path / "fine" / "obstacles.geojson").read_text())["features"] == []
    # Cells of 32 mm: five frames are too near to one another to confirm any of them.
    assert (load_nav2(written)[0] == -1).all()


def test_render_paints_the_same_map_and_others_without_locating(
    written: Path, drive: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(drive, moved)
    again = tmp_path / "again"
    result = slam("render", written, "--frames", moved, "-o", again, *COARSE)
    assert result.exit_code == 0, result.output
    before, after = picture(written).astype(int), picture(again).astype(int)
    assert np.abs(before - after).mean() < 0.05
    part = tmp_path / "part"
    arguments = (
        "--rotate",
        "90",
        "--crop",
        "-0.3,0.4,0.3,0.8",
        "--nav-lines",
        "--format",
        "png,nav2",
    )
    result = slam("render", written / "mosaic.png", "-o", part, *COARSE, *arguments)
    assert result.exit_code == 0, result.output
    cropped = picture(part)
    assert cropped.shape[:2] == (100, 150)
    world = np.loadtxt(part / "mosaic.pgw").reshape(3, 2).T
    place = world @ (75, 50, 1)
    whole = np.loadtxt(written / "mosaic.pgw")
    column, row = np.rint((place - whole[4:6]) / (whole[0], whole[3])).astype(int)
    np.testing.assert_allclose(
        cropped[45:56, 70:81, :3].mean(),
        before[row - 5 : row + 6, column - 5 : column + 6, :3].mean(),
        atol=6,
    )
    assert yaml.safe_load((part / "nav2.yaml").read_text())["origin"][2] == pytest.approx(
        -np.pi / 2
    )


def test_render_says_what_is_missing(written: Path, tmp_path: Path, drive: Path) -> None:
    result = slam("render", tmp_path, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert "map.slam" in result.output
    fewer = tmp_path / "fewer"
    fewer.mkdir()
    shutil.copy(drive / "0003.jpg", fewer)
    result = slam("render", written, "--frames", fewer, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert "--frames" in result.output
    result = slam("render", written, "--crop", "90,90,91,91", "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert "crop" in result.output


def test_too_little_memory_and_too_large_a_png_are_refused(written: Path, tmp_path: Path) -> None:
    result = slam("render", written, "-o", tmp_path / "out", "--memory", "20M")
    assert result.exit_code == 1
    assert "--memory" in result.output.splitlines()[-1]
    result = slam("render", written, "-o", tmp_path / "out", "--metres-per-pixel", "0.00005")
    assert result.exit_code == 1
    assert "--format geotiff" in result.output.splitlines()[-1]
    assert slam("render", written, "--memory", "much").exit_code == 2
    assert slam("stitch", "x", "--datum", "1,x").exit_code == 2


def test_pictures_get_what_the_process_leaves_of_the_memory(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    held = {}
    for megabytes in (0, 60, 190):
        pages = tmp_path / f"{megabytes}"
        pages.write_text(f"9 {megabytes * 1_000_000 // os.sysconf('SC_PAGE_SIZE')} 9")
        monkeypatch.setattr(budget, "_RESIDENT", pages)
        held[megabytes] = budget.max_pictures(1_000_000, 200_000_000, 20_000_000, 2)
    assert held[0] == 180
    assert held[60] == pytest.approx(120, abs=1)
    assert 0 < held[190] < 10
    monkeypatch.setattr(budget, "_RESIDENT", tmp_path / "nowhere")
    assert budget.max_pictures(1_000_000, 200_000_000, 20_000_000, 2) == 180


def test_a_picture_leaves_memory_with_the_last_tile_that_needs_it() -> None:
    needed = [[0, 1, 2], [2, 3], [1, 3, 4]]
    assert budget.max_at_once(needed) == 3
    made: list[int] = []

    def make(number: int) -> SourceImage:
        made.append(number)
        return SourceImage((), 0, np.zeros((1, 1), np.uint8), 1.0, None)

    kept = frame_cache.FrameCache(make, 9, {0: 1, 1: 2, 2: 2, 3: 2, 4: 1})
    for numbers in needed:
        for number in numbers:
            kept(number)
        kept.done(numbers)
    assert made == [0, 1, 2, 3, 4]
    for number in range(5):
        kept(number)
    assert made == [0, 1, 2, 3, 4] * 2


def test_a_thumbnail_that_was_kept_is_what_reading_the_frame_again_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 256, (50, 70, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{index}.jpg"), noise)
    files = list_frames([tmp_path])
    kept = thumbnails.Thumbnails()
    small = thumbnails.read_thumbnail(files[0])
    assert small.shape == (13, 18)
    monkeypatch.setattr(thumbnails, "_MAX_BYTES", 2 * small.nbytes)
    for file in files:
        kept.keep(read_frame(file, gray=True))
    for file in files[:2]:
        np.testing.assert_array_equal(kept.take(file), thumbnails.read_thumbnail(file))
        assert kept.take(file) is None
    assert kept.take(files[2]) is None
    kept.keep(read_frame(files[2], gray=True))
    assert pickle.loads(pickle.dumps(kept)).take(files[2]) is None
    assert kept.take(files[2]) is not None


def test_a_missing_library_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    result = slam("stitch", Path(__file__).parent, "--format", "geotiff")
    assert result.exit_code == 1
    with pytest.raises(Exception, match=r"slamcli\[geotiff\]"):
        geotiff.check_geotiff()


def test_a_store_takes_only_what_was_seen_and_finds_it_again(tmp_path: Path) -> None:
    side, scale = 512, 0.01
    image = np.random.default_rng(0).integers(0, 255, (side, side, 3), dtype=np.uint8)
    pixels_per_metre = np.zeros((side, side), np.float32)
    pixels_per_metre[10:60, 20:90] = 100.0
    views, latest = np.ones((side, side), np.uint16), np.zeros((side, side), np.int32)
    grid = Grid(0.0, 0.0, scale, side, side)
    store = TileStore(tmp_path, side, ("views",))
    store.put(0, 0, Tile(grid, image, pixels_per_metre, None, views, latest))
    store.put(-3, 200000, Tile(grid, image, pixels_per_metre, None, views, latest))
    store.put(5, 5, None)
    again = TileStore(tmp_path, side, ("views",))
    assert again.keys() == [(-3, 200000), (0, 0)]
    assert (5, 5) in again
    assert again.seen_pixels() == 2 * 50 * 70
    assert again.bounds() == (10 - 3 * side, 60, 20, 200000 * side + 90)
    part, mask = again.flatten(Grid(0.0, 0.0, scale, 100, 70))
    np.testing.assert_array_equal(part, image[:70, :100])
    assert mask.sum() == 255 * 50 * 70


def test_a_turned_world_file_maps_pixels_into_the_map(tmp_path: Path) -> None:
    grid, turn = Grid(1.0, 2.0, 0.5, 4, 4), Pose2(0.0, 0.0, np.pi / 2)
    world_file.write_world_file(tmp_path / "m.pgw", grid, turn)
    a, d, b, e, c, f = np.loadtxt(tmp_path / "m.pgw")
    np.testing.assert_allclose((a * 2 + b * 1 + c, d * 2 + e * 1 + f), (-1.25, 2.25), atol=1e-9)

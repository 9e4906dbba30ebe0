"""The mosaic: tiles painted from images of a known floor, blends, exposure, obstacles."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from floor_pictures import asphalt, forward_camera, photograph
from numpy.typing import NDArray

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.camera.projection import project_floor
from slamcli.core.camera.resolution import floor_sampling, resolution_image
from slamcli.core.config import Blend, PaintOptions
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.core.records import Frame, PosedFrame, Tile
from slamcli.stages.mosaic import (
    blend,
    compensation,
    exposure,
    obstacles,
    source_image,
    tiles,
    view_consistency,
)
from slamcli.stages.mosaic.exposure import Exposure
from slamcli.stages.mosaic.painter import Painter
from slamcli.stages.mosaic.sampling import sample_image

SCALE = 0.001
FLOOR = asphalt(1400, seed=3)
FLOOR_GRID = Grid(0.0, 0.7, SCALE, 1400, 1400)
KEY = tiles.TileKey(-1, 1)
POSES = [Pose2(0.05 * number, 0.1 - 0.01 * number, 0.03 * number) for number in range(8)]


def pictures(gains: tuple[float, ...] = (1.0,) * 8) -> list[Frame]:
    calibration = forward_camera()
    frames = []
    for index, (pose, gain) in enumerate(zip(POSES, gains, strict=True)):
        image = photograph(FLOOR, FLOOR_GRID, calibration, pose).astype(np.float32)
        noise = np.random.default_rng(index).normal(0.0, 1.0, image.shape)
        seen = np.clip(np.rint(gain * image + noise), 0, 255).astype(np.uint8)
        frames.append(Frame(index, f"{index}.png", None, seen))
    return frames


def paint(
    frames: list[Frame],
    how: Blend = "best",
    light: Exposure | None = None,
    *,
    obstacles: bool = True,
    calibrations: list[Calibration] | None = None,
) -> Tile:
    calibration = forward_camera()
    own = calibrations or [calibration] * len(frames)
    posed_frames = [
        PosedFrame(frame.index, POSES[frame.index], one)
        for frame, one in zip(frames, own, strict=True)
    ]
    painter = Painter(calibration, SCALE, PaintOptions(blend=how, obstacles=obstacles), light)
    made = [painter.picture(frame, number) for number, frame in enumerate(frames)]
    numbers = dict(painter.plan(posed_frames))[KEY]
    tile = painter.paint(KEY, posed_frames, numbers, made.__getitem__)
    assert tile is not None
    return tile


def truth() -> NDArray[np.float64]:
    grid = tiles.tile_grid(KEY, SCALE)
    column = round((grid.x_min - FLOOR_GRID.x_min) / SCALE)
    row = round((FLOOR_GRID.y_max - grid.y_max) / SCALE)
    return FLOOR[row : row + 512, column : column + 512].astype(np.float64)


def decibels(tile: Tile, inside: NDArray[np.bool_] | None = None) -> float:
    chosen = tile.pixels_per_metre > 0 if inside is None else inside
    error = (tile.image[..., 1].astype(np.float64) - truth())[chosen]
    return 10 * math.log10(255**2 / float(np.mean(error**2)))


def energy(image: NDArray[np.generic], inside: NDArray[np.bool_]) -> float:
    values = image.astype(np.float32)
    across, down = cv2.Sobel(values, cv2.CV_32F, 1, 0), cv2.Sobel(values, cv2.CV_32F, 0, 1)
    return float(
        (across**2 + down**2)[cv2.erode(inside.astype(np.uint8), np.ones((5, 5))) > 0].mean()
    )


def test_the_best_blend_is_nearer_to_the_floor_and_keeps_more_texture_than_the_mean() -> None:
    frames = pictures()
    best, mean = paint(frames), paint(frames, "mean")
    seen = (best.pixels_per_metre > 0) & (mean.pixels_per_metre > 0)
    assert seen.mean() > 0.8
    np.testing.assert_array_equal(best.pixels_per_metre > 0, mean.pixels_per_metre > 0)
    assert decibels(best) > 27.0
    assert decibels(best) > decibels(mean) + 0.5
    true = energy(truth(), seen)
    assert energy(best.image[..., 1], seen) > 1.1 * energy(mean.image[..., 1], seen)
    assert 0.5 < energy(best.image[..., 1], seen) / true < 1.1


@pytest.mark.parametrize("how", ["feather", "multiband", "median"])
def test_every_blend_shows_the_floor(how: Blend) -> None:
    frames = pictures()
    tile = paint(frames, how)
    np.testing.assert_array_equal(tile.pixels_per_metre > 0, paint(frames).pixels_per_metre > 0)
    assert decibels(tile) > 25.0


def test_exposure_is_found_and_compensated() -> None:
    gains = (1.0, 1.2, 0.8, 1.0, 1.1, 0.75, 1.25, 0.8)
    frames = pictures(gains)
    calibration = forward_camera()
    light = solved(frames, calibration)
    np.testing.assert_allclose(light.gains * gains / np.median(light.gains * gains), 1.0, atol=0.01)
    assert abs(sum(light.vignetting)) < 0.03
    assert decibels(paint(frames, light=light)) > decibels(paint(pictures())) - 1.0
    assert decibels(paint(frames)) < 22.0


def solved(frames: list[Frame], calibration: Calibration) -> Exposure:
    return exposure.estimate_exposure(observed(frames, calibration))


def observed(frames: list[Frame], calibration: Calibration) -> list[exposure.FloorBrightness]:
    hull, step = footprint_hull(calibration), exposure.comparison_step(calibration)
    return [
        exposure.observe(
            cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), calibration, hull, pose, step
        )
        for frame, pose in zip(frames, POSES, strict=True)
    ]


def test_a_point_seen_all_day_long_is_compared_in_some_of_its_views() -> None:
    """Ten times over the same path: the gains are found from a share of the samples."""
    gains = (1.0, 1.2, 0.8, 1.0, 1.1, 0.75, 1.25, 0.8)
    calibration = forward_camera()
    seen = observed(pictures(gains), calibration)
    light = exposure.estimate_exposure(seen * 10)
    evened = light.gains * np.tile(gains, 10)
    np.testing.assert_allclose(evened / np.median(evened), 1.0, atol=0.015)


def test_exposure_is_compared_wherever_the_map_begins() -> None:
    """The gains do not depend on where the points lie, on either side of the origin."""
    for corner in ((0, -1), (0, 0), (-1, 0), (-1, -1)):
        places = np.array([corner, (corner[0], corner[1] + 1), (3, 2)], np.int32)
        plain = np.ones(3, np.float32)
        frames = [
            exposure.FloorBrightness(places, np.full(3, np.log(gray)), 0.5 * plain, plain)
            for gray in (100.0, 120.0)
        ]
        gains = exposure.estimate_exposure(frames).gains
        assert gains[0] / gains[1] == pytest.approx(1.2, rel=0.01)


def test_gains_are_lowered_where_bright_floor_would_clip() -> None:
    shared = np.array([(x, 0) for x in range(50)], np.int32)
    bright = np.array([(x, 1) for x in range(50)], np.int32)

    def frame(points: np.ndarray, grays: list[float]) -> exposure.FloorBrightness:
        plain = np.ones(len(points), np.float32)
        return exposure.FloorBrightness(points, np.log(grays), 0.0 * plain, plain)

    # The first is darker than the others, and it alone sees floor of 220 gray levels.
    dark = frame(np.concatenate([shared, bright]), [120.0] * 50 + [220.0] * 50)
    light = exposure.estimate_exposure(
        [dark, frame(shared, [160.0] * 50)] + [frame(shared, [160.0] * 50) for _ in range(2)]
    )
    assert light.gains[0] / light.gains[1] == pytest.approx(160.0 / 120.0, rel=0.01)
    assert 220.0 * light.gains[0] < 246.0
    alike = exposure.estimate_exposure([frame(shared, [120.0] * 50), frame(shared, [130.0] * 50)])
    assert np.median(alike.gains) == pytest.approx(1.0, abs=0.05)


def test_vignetting_is_found_and_compensated() -> None:
    calibration = forward_camera()
    falls = compensation.brightening_image(calibration.image_size, (-0.25, 0.0))
    assert falls is not None
    frames = [
        replace(frame, image=np.rint(frame.image * falls[..., None]).astype(np.uint8))
        for frame in pictures()
    ]
    light = solved(frames, calibration)
    radius = np.array([0.2, 0.5, 0.9])
    found = light.vignetting[0] * radius + light.vignetting[1] * radius**2
    np.testing.assert_allclose(found, 0.25 * radius, atol=0.02)
    np.testing.assert_allclose(light.gains, 1.0, atol=0.02)
    evened = compensation.correct(
        frames[0].image, 1.0, compensation.brightening_image((640, 480), (0.25, 0))
    )
    assert np.abs(evened.astype(int) - pictures()[0].image).max() <= 2


def test_an_obstacle_in_some_views_is_left_out_of_the_mosaic_and_kept_in_its_own_layer() -> None:
    clean, frames = paint(pictures()), pictures()
    calibration = forward_camera()
    place = np.array([[0.72, 0.18], [0.84, 0.18], [0.84, 0.3], [0.72, 0.3]])
    for number in (6, 7):
        pixels, _ = project_floor(calibration, POSES[number].inverse().apply(place))
        spoilt = frames[number].image.copy()
        cv2.fillConvexPoly(spoilt, np.rint(pixels).astype(np.int32), (20, 20, 220))
        frames[number] = replace(frames[number], image=spoilt)
    kept, through = paint(frames), paint(frames, obstacles=False)
    assert decibels(kept) > decibels(clean) - 1.0
    assert decibels(through) < decibels(clean) - 3.0
    assert clean.obstacles is None
    assert kept.obstacles is not None
    grid = tiles.tile_grid(KEY, SCALE)
    middle = grid.pixel_from_metres @ (*place.mean(axis=0), 1.0)
    shown = kept.obstacles[round(middle[1]), round(middle[0])]
    np.testing.assert_allclose(shown[:3], (20, 20, 220), atol=3)
    assert shown[3] == obstacles.PASSED_ALPHA


def test_an_obstacle_is_followed_to_where_only_two_views_see_the_floor() -> None:
    cells = np.full((4, 20, 20, 3), 100, np.uint8)
    weights = np.ones((4, 20, 20), np.float32)
    weights[1:3, 10:] = 0.0
    cells[0, 4:16, 6:13] = 20
    weights[0] = 2.0
    shows = view_consistency.floor_views(cells, weights)
    assert not shows[0, 5:15, 6:13].any()
    assert shows[3].all()
    assert shows[0, :, :4].all()


def rough_floor(views: int) -> np.ndarray:
    """Cells of one floor, as views with a little noise of their own see it."""
    generator = np.random.default_rng(4)
    floor = generator.normal(110.0, 6.0, (40, 40, 1))
    noisy = floor + generator.normal(0.0, 2.0, (views, 40, 40, 3))
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("pixels_per_metre", [[1.0, 3.0], [3.0, 1.0], [1.0, 3.0, 1.0]])
def test_an_obstacle_ends_where_floor_continues(pixels_per_metre: list[float]) -> None:
    # Two views of a spot do not outvote each other, and one of high resolution outvotes two: the
    # only evidence for an obstacle in the second view is that its content ends where they differ.
    cells = rough_floor(len(pixels_per_metre))
    cells[1, 12:26, 14:30] = (60, 90, 70)
    weights = np.full((len(pixels_per_metre), 40, 40), 1.0, np.float32)
    weights *= np.array(pixels_per_metre, np.float32)[:, None, None]
    shows = view_consistency.floor_views(cells, weights, 2)
    assert not shows[1, 12:26, 14:30].any()
    assert shows[0].all()
    assert shows[1, :8].all()
    assert shows[1, :, 34:].all()


def test_an_obstacle_at_a_views_border_is_found_however_narrow_its_part() -> None:
    cells = rough_floor(3)
    cells[1, 12:26, 14:30] = (60, 90, 70)
    weights = np.ones((3, 40, 40), np.float32)
    weights[1] = 3.0
    # The first sees two columns of it, which elsewhere would pass for a displaced edge.
    weights[0, :, 16:] = 0.0
    shows = view_consistency.floor_views(cells, weights, 2)
    assert not shows[1, 12:26, 14:30].any()
    assert shows[0, :, :16].all()
    assert shows[2].all()


def test_two_views_that_differ_everywhere_decide_nothing() -> None:
    cells = np.stack([np.full((8, 8, 3), 50, np.uint8), np.full((8, 8, 3), 200, np.uint8)])
    assert view_consistency.floor_views(cells, np.ones((2, 8, 8), np.float32)).all()


def test_each_frame_may_have_a_tilt_of_its_own() -> None:
    tilted = replace(
        forward_camera(),
        robot_from_image=compose_robot_from_image(
            forward_camera().camera_matrix, 0.3, math.radians(46.0), 0.0
        ),
    )
    frames = pictures()
    odd = photograph(FLOOR, FLOOR_GRID, tilted, POSES[7])
    frames[7] = replace(frames[7], image=odd)
    own = [forward_camera()] * 8
    own[7] = tilted
    assert decibels(paint(frames, calibrations=own, obstacles=False)) > 27.0
    assert decibels(paint(frames, obstacles=False)) < 25.0


def test_a_lens_is_read_through_where_each_point_lies() -> None:
    bent = replace(forward_camera(), distortion=np.array([-0.25, 0.06, 0.001, -0.001, 0.0]))
    straight = forward_camera()
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
    places = undistort_points(bent, np.column_stack([columns.ravel(), rows.ravel()]))
    xy = places.astype(np.float32).reshape(480, 640, 2)
    smooth = cv2.GaussianBlur(FLOOR, (0, 0), 4.0)
    seen = photograph(smooth, FLOOR_GRID, straight, POSES[0])
    image = cv2.remap(seen, xy[..., 0], xy[..., 1], cv2.INTER_CUBIC)
    grid = Grid(0.4, 0.2, SCALE, 200, 200)
    read = []
    for calibration, pixels in ((bent, image), (straight, seen)):
        usable = source_image.border_fade(resolution_image(calibration))
        made = source_image.make_source_image(pixels, usable, None, 1)
        read.append(sample_image(made, calibration, POSES[0], grid))
    both = (read[0].weight > 0) & (read[1].weight > 0)
    assert both.mean() > 0.9
    difference = read[0].image[both].astype(int) - read[1].image[both]
    assert np.abs(difference).mean() < 0.7


@pytest.mark.parametrize("scale", [0.003, 0.008])
def test_a_coarse_map_lies_where_the_floor_does(scale: float) -> None:
    """Whichever levels of the pyramid it is read from, made here or by the decoder."""
    calibration = forward_camera()
    smooth = cv2.GaussianBlur(FLOOR, (0, 0), 8.0)
    picture = photograph(smooth, FLOOR_GRID, calibration, POSES[0])
    half = cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA)
    usable = source_image.border_fade(resolution_image(calibration))
    grid = Grid(0.2, 0.2, scale, round(0.4 / scale), round(0.4 / scale))
    whole, halved = (
        sample_image(
            source_image.make_source_image(pixels, usable, None, 3, halvings=halvings),
            calibration,
            POSES[0],
            grid,
        )
        for pixels, halvings in ((picture, 0), (half, 1))
    )
    np.testing.assert_array_equal(whole.weight, halved.weight)
    columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    metres = apply_homography(grid.metres_from_pixel, np.dstack([columns, rows]))
    places = apply_homography(FLOOR_GRID.pixel_from_metres, metres).astype(np.float32)
    true = cv2.remap(smooth, places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    inside = cv2.erode((whole.weight > 0).astype(np.uint8), np.ones((5, 5))) > 0
    down, across = np.gradient(true)
    slopes = np.column_stack([across[inside], down[inside], np.ones(np.count_nonzero(inside))])
    for look in (whole, halved):
        difference = look.image[..., 1][inside] - true[inside]
        shift = np.linalg.lstsq(slopes, difference, rcond=None)[0]
        assert np.abs(shift[:2]).max() * scale < 0.0001
    if source_image.may_be_halved(calibration, scale):
        np.testing.assert_array_equal(whole.image, halved.image)


def test_an_image_is_decoded_at_half_its_size_for_coarse_maps_alone() -> None:
    calibration = forward_camera()
    assert source_image.may_be_halved(calibration, 0.008)
    assert not source_image.may_be_halved(calibration, 0.004)
    assert not source_image.may_be_halved(replace(calibration, image_size=(639, 480)), 0.008)


def test_the_pyramid_of_a_small_image_ends_with_one_pixel() -> None:
    image = np.full((16, 40, 3), 90, np.uint8)
    made = source_image.make_source_image(image, np.full((16, 40), 255, np.uint8), None, 6)
    assert [level.shape[:2] for level in made.levels] == [
        (16, 40),
        (8, 20),
        (4, 10),
        (2, 5),
        (1, 2),
    ]


def test_weight_grows_with_resolution_and_fades_at_the_border() -> None:
    pixels_per_metre = np.full((100, 100), 500.0, np.float32)
    pixels_per_metre[:, 80:] = 0.0
    fade = source_image.border_fade(pixels_per_metre)
    assert fade[40, 40] == 255
    assert 0 < fade[40, 79] < fade[40, 70] < 255
    assert not fade[:, 80:].any()
    calibration = forward_camera()
    painter = Painter(calibration, SCALE)
    look = painter.patch(pictures()[0], Pose2())
    grid = painter.extent([Pose2()])
    near, far = (grid.pixel_from_metres @ (x, 0.0, 1.0) for x in (0.3, 0.6))
    weights = [look.weight[round(p[1]), round(p[0])] for p in (near, far)]
    sampled = floor_sampling(calibration, [(0.3, 0.0), (0.6, 0.0)])
    np.testing.assert_allclose(weights, 1.0 / np.sqrt(sampled.prod(axis=1)), rtol=0.01)


def test_the_plan_names_every_tile_that_a_frame_sees() -> None:
    outline = np.array([[0.1, 0.1], [1.6, 0.2], [1.5, 1.4], [0.2, 0.9]])
    keys = tiles.tiles_under(outline, SCALE)
    x, y = np.meshgrid(np.arange(0.0, 2.0, 0.01), np.arange(0.0, 2.0, 0.01))
    points = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
    inside = [
        cv2.pointPolygonTest(outline.astype(np.float32), (float(p[0]), float(p[1])), False) > 0
        for p in points
    ]
    side = tiles.TILE_PIXELS * SCALE
    needed = {
        tiles.TileKey(-int(p[1] // side) - 1, int(p[0] // side))
        for p, hit in zip(points, inside, strict=True)
        if hit
    }
    assert needed <= set(keys)
    assert len(keys) <= len(needed) + 2
    for key in keys:
        grid = tiles.tile_grid(key, SCALE)
        assert grid.x_max > 0.1
        assert grid.y_max > 0.1


def test_floor_driven_over_ten_times_is_painted_from_few_of_its_views() -> None:
    calibration, generator = forward_camera(), np.random.default_rng(0)
    poses = [
        Pose2(0.04 * place, 0.0, 0.0) @ Pose2(*generator.normal(0.0, (0.004, 0.004, 0.01)))
        for _ in range(10)
        for place in range(30)
    ]
    posed_frames = [PosedFrame(number, pose, calibration) for number, pose in enumerate(poses)]
    plan = Painter(calibration, SCALE).plan(posed_frames)
    chosen = {number for _, numbers in plan for number in numbers}
    assert len(chosen) < 0.45 * len(poses)
    corners = np.array([pose.apply(footprint_hull(calibration)) for pose in poses]).reshape(-1, 2)
    points = generator.uniform(corners.min(axis=0), corners.max(axis=0), (4000, 2))
    best, views = np.zeros((2, len(points))), np.zeros((2, len(points)))
    for number, pose in enumerate(poses):
        floor = pose.inverse().apply(points)
        _, seen = project_floor(calibration, floor)
        resolution = 1.0 / np.sqrt(floor_sampling(calibration, floor[seen]).prod(axis=1))
        for kind in (0, 1) if number in chosen else (0,):
            best[kind, seen] = np.maximum(best[kind, seen], resolution)
            views[kind, seen] += 1
    seen = views[0] > 0
    assert np.mean(views[1, seen] > 0) > 0.996
    both = views[1] > 0
    assert np.quantile(best[1, both] / best[0, both], 0.01) > 0.9
    assert np.mean(views[1, views[0] >= 40] >= 5) > 0.99


def test_a_line_is_an_obstacle_and_a_field_is_not() -> None:
    image = np.full((200, 200, 3), 40, np.uint8)
    image[95:100] = 230
    image[120:180, 20:180] = 230
    mask = np.full((200, 200), 255, np.uint8)
    mask[:, :10] = 0
    found = obstacles.line_cells(image, mask, 0.005)
    assert found[95:100, 20:].all()
    assert not found[150, 60:140].any()
    assert not found[40].any()


def test_a_strip_across_a_tile_is_covered_by_windows_that_it_mostly_fills() -> None:
    rows, columns = np.indices((88, 88))
    strip = np.abs(rows - columns) < 5
    windows = blend.views.windows_around(strip)
    covered = np.zeros(strip.shape, np.int64)
    for window in windows:
        covered[window.cells] += 1
    inner = slice(tiles.MARGIN_CELLS, -tiles.MARGIN_CELLS)
    assert (covered[inner, inner][strip[inner, inner]] == 1).all()
    assert covered.max() == 1
    assert covered.sum() < 0.35 * 64**2
    assert len(windows) <= 16
    assert blend.views.windows_around(np.zeros_like(strip)) == []


def test_blends_are_by_name() -> None:
    assert list(blend.BLENDS) == ["best", "feather", "multiband", "median", "mean"]

"""`slam stitch` and `slam warp` as a user runs them, against the samples' truth."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from click.testing import Result
from command_line import slam
from PIL import Image
from trajectories import compare, read_poses, read_rows

from slamcli.core.geometry import Grid, apply_homography

COLUMNS = (
    "index,frame,stamp,status,reason,fragment,x,y,heading,"
    "sigma_x,sigma_y,sigma_heading,inliers,score,rocking_pitch,rocking_roll,rocking_height"
)


@pytest.fixture(scope="module")
def calibration(samples_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    result = slam("calibrate", samples_folder / "course" / "square.png", "-o", path)
    assert result.exit_code == 0, result.output
    return path


@pytest.fixture(scope="module")
def course_map(
    samples_folder: Path, calibration: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    output = tmp_path_factory.mktemp("map") / "out"
    result = slam("stitch", samples_folder / "course", "-c", calibration, "-o", output)
    assert result.exit_code == 0, result.output
    assert "placed       40 (100%)" in result.output
    return output


@pytest.fixture
def few_frames(samples_folder: Path, calibration: Path, tmp_path: Path) -> Path:
    """Four frames of the sample with their calibration, to be spoilt."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for index in range(4):
        shutil.copy(samples_folder / "course" / "frames" / f"{index:04d}.jpg", folder)
    shutil.copy(calibration, folder / "calibration.yaml")
    return folder


def test_the_sample_is_mapped_to_its_truth(course_map: Path, samples_folder: Path) -> None:
    truth = read_poses(samples_folder / "course" / "truth.csv")
    accuracy = compare(read_poses(course_map / "poses.csv"), truth)
    assert accuracy.placed == 40
    assert accuracy.absolute_metres < 0.001 * accuracy.path_metres
    assert accuracy.relative_metres < 0.001
    assert accuracy.worst_metres < 0.01
    assert accuracy.worst_degrees < 0.3


def test_the_sample_is_mapped_as_recorded(course_map: Path) -> None:
    """A change that moves poses says so; other processors and library versions may by this much."""
    recorded = read_poses(Path(__file__).parents[2] / "golden" / "course_poses.csv")
    accuracy = compare(read_poses(course_map / "poses.csv"), recorded)
    assert accuracy.placed == 40
    assert accuracy.worst_metres < 1e-4
    assert accuracy.worst_degrees < 0.005


def test_the_mosaic_is_the_floor_at_its_place(course_map: Path, samples_folder: Path) -> None:
    mosaic = cv2.imread(str(course_map / "mosaic.png"), cv2.IMREAD_UNCHANGED)
    assert mosaic.shape[2] == 4
    description = yaml.safe_load((course_map / "mosaic.yaml").read_text())
    assert description["image"] == "mosaic.png"
    scale = description["resolution"]
    x_min, y_min, _ = description["origin"]
    grid = Grid(x_min, y_min + scale * mosaic.shape[0], scale, mosaic.shape[1], mosaic.shape[0])
    world = np.loadtxt(course_map / "mosaic.pgw")
    centre = apply_homography(grid.metres_from_pixel, [[0.0, 0.0]])[0]
    np.testing.assert_allclose(world, [scale, 0, 0, -scale, *centre], atol=1e-9)
    # The squares of the course are 0.3048 m wide in the map too.
    white = ((mosaic[..., 1] > 170) & (mosaic[..., 3] > 0)).astype(np.uint8)
    closed = cv2.morphologyEx(white, cv2.MORPH_CLOSE, np.ones((15, 15)))
    squares = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((40, 40)))
    contours, _ = cv2.findContours(squares, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    # A contour runs through pixel centres, so a figure is one pixel wider than it.
    sizes = scale * (np.array([cv2.minAreaRect(contour)[1] for contour in contours]) + 1.0)
    whole = sizes[np.all(np.abs(sizes - 0.3048) < 0.02, axis=1)]
    assert len(whole) >= 2
    np.testing.assert_allclose(whole, 0.3048, atol=0.004)


def test_a_run_tells_what_it_did(course_map: Path) -> None:
    assert (course_map / "poses.csv").read_text().splitlines()[0] == COLUMNS
    recorded = tomllib.loads((course_map / "run.toml").read_text())
    assert recorded["counts"] == {
        "frames": 40,
        "placed": 40,
        "predicted": 0,
        "lost": 0,
        "fragments": 1,
        "links": recorded["counts"]["links"],
        "switched_off": 0,
    }
    assert recorded["options"]["mapper"]["matching"]["model"] == "rigid"
    assert cv2.imread(str(course_map / "trajectory.png")) is not None
    assert not (course_map / "matches").exists()
    assert sorted(p.name for p in course_map.iterdir()) == [
        "map.slam",
        "mosaic.pgw",
        "mosaic.png",
        "mosaic.yaml",
        "poses.csv",
        "report.html",
        "run.toml",
        "timing.toml",
        "trajectory.png",
    ]


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_the_bytes_are_the_same_for_any_number_of_workers(
    few_frames: Path, tmp_path: Path, workers: int, samples_folder: Path, calibration: Path
) -> None:
    import slamcli
    from slamcli.io.frames import list_frames, read_frame
    from slamcli.io.poses import write_poses

    for index in range(4, 9):
        shutil.copy(samples_folder / "course" / "frames" / f"{index:04d}.jpg", few_frames)
    outputs = []
    for number in (workers, 1):
        outputs.append(tmp_path / f"out{number}{len(outputs)}")
        result = slam("stitch", few_frames, "-o", outputs[-1], "--workers", number)
        assert result.exit_code == 0, result.output
    for name in ("poses.csv", "mosaic.png", "mosaic.yaml", "trajectory.png", "report.html"):
        assert (outputs[0] / name).read_bytes() == (outputs[1] / name).read_bytes(), name
    mapper = slamcli.Mapper(slamcli.load_calibration(calibration))
    for file in list_frames([few_frames]):
        mapper.update(read_frame(file))
    write_poses(tmp_path / "streamed.csv", mapper.finish())
    assert (tmp_path / "streamed.csv").read_bytes() == (outputs[0] / "poses.csv").read_bytes()


def test_debug_draws_every_comparison(few_frames: Path, tmp_path: Path) -> None:
    assert slam("stitch", few_frames, "-o", tmp_path / "out", "--debug").exit_code == 0
    drawings = list((tmp_path / "out" / "matches").glob("*.png"))
    assert {path.name[:4] for path in drawings} == {"0001", "0002", "0003"}


def spoil(frames: Path) -> dict[str, str]:
    """Put one of every bad frame among the good ones; return words of each one's reason."""
    good = cv2.imread(str(frames / "0001.jpg"))
    data = (frames / "0001.jpg").read_bytes()
    (frames / "0001a_truncated.jpg").write_bytes(data[: len(data) // 2])
    (frames / "0001b_zero.jpg").write_bytes(b"")
    (frames / "0001c_text.jpg").write_text("no picture")
    cv2.imwrite(str(frames / "0001d_pixel.png"), np.zeros((1, 1, 3), np.uint8))
    cv2.imwrite(str(frames / "0001e_small.png"), cv2.resize(good, (320, 240)))
    cv2.imwrite(str(frames / "0001f_black.png"), np.zeros_like(good))
    cv2.imwrite(str(frames / "0001g_white.png"), np.full_like(good, 255))
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(good[..., ::-1]).save(frames / "0001h_turned.jpg", exif=exif)
    return {
        "0001a_truncated.jpg": "truncated",
        "0001b_zero.jpg": "empty",
        "0001c_text.jpg": "not an image",
        "0001d_pixel.png": "too small",
        "0001e_small.png": "320x240",
        "0001f_black.png": "black",
        "0001g_white.png": "white",
        "0001h_turned.jpg": "480x640",
    }


def test_bad_frames_become_rows_with_reasons_and_the_run_goes_on(
    few_frames: Path, tmp_path: Path, samples_folder: Path
) -> None:
    reasons = spoil(few_frames)
    good = cv2.imread(str(few_frames / "0002.jpg"))
    gray = cv2.cvtColor(good, cv2.COLOR_BGR2GRAY)
    cv2.imwrite(str(few_frames / "0002a_gray.png"), gray)
    cv2.imwrite(str(few_frames / "0002b_deep.png"), good.astype(np.uint16) * 257)
    cv2.imwrite(str(few_frames / "0002c_alpha.png"), np.dstack([good, np.full_like(gray, 255)]))
    Image.fromarray(good[..., ::-1]).convert("CMYK").save(few_frames / "0002d_cmyk.jpg", quality=95)
    shutil.copy(few_frames / "0003.jpg", few_frames / "0003a again ä.jpg")
    result = slam("stitch", few_frames, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    rows = {row["frame"]: row for row in read_rows(tmp_path / "out" / "poses.csv")}
    assert len(rows) == 4 + len(reasons) + 5
    for name, words in reasons.items():
        assert rows[name]["status"] == "lost"
        assert rows[name]["x"] == ""
        assert words in rows[name]["reason"], rows[name]
    truth = read_poses(samples_folder / "course" / "truth.csv")
    placed = read_poses(tmp_path / "out" / "poses.csv")
    for name in rows.keys() - reasons.keys():
        error = truth[f"{name[:4]}.jpg"].inverse() @ placed[name]
        assert error.translation_length < 0.002, name
    assert "same picture" in rows["0003a again ä.jpg"]["reason"]


def refused(result: Result, *words: str) -> None:
    assert result.exit_code == 1, result.output
    lines = result.output.strip().splitlines()
    assert len(lines) == 1, result.output
    for word in words:
        assert word in lines[0]


def test_bad_input_is_one_line_and_leaves_nothing(few_frames: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(slam("stitch", empty, "-o", output), "no images")
    refused(slam("stitch", tmp_path / "absent", "-o", output), "does not exist")
    refused(slam("stitch", few_frames, "-c", tmp_path / "no.yaml", "-o", output), "no.yaml")
    (empty / "0.jpg").write_bytes(b"")
    refused(slam("stitch", empty, "-o", output), "none of the 1 frames", "0.jpg")
    assert not output.exists()
    output.write_text("a file")
    refused(slam("stitch", few_frames, "-o", output), "it is a file")
    refused(slam("stitch", few_frames, "-o", output / "below"), "cannot write")


def test_a_calibration_of_another_size_is_refused(few_frames: Path, tmp_path: Path) -> None:
    for path in few_frames.glob("*.jpg"):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (320, 240)))
    result = slam("stitch", few_frames, "-o", tmp_path / "out")
    refused(result, "640x480", "320x240", "calibration.yaml")


def test_a_map_is_not_overwritten_unless_told(few_frames: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    assert slam("stitch", few_frames, "-o", output).exit_code == 0
    before = (output / "poses.csv").read_bytes()
    (few_frames / "0003.jpg").unlink()
    refused(slam("stitch", few_frames, "-o", output), "--overwrite")
    assert (output / "poses.csv").read_bytes() == before
    assert slam("stitch", few_frames, "-o", output, "--overwrite").exit_code == 0
    assert (output / "poses.csv").read_bytes() != before


def test_the_default_output_stands_beside_the_frames(few_frames: Path) -> None:
    assert slam("stitch", few_frames).exit_code == 0
    assert (few_frames.parent / "frames_mosaic" / "mosaic.png").is_file()


def test_usage_errors_exit_2() -> None:
    assert slam("stitch").exit_code == 2
    assert slam("stitch", "x", "--workers", "0").exit_code == 2


def test_a_mosaic_too_large_is_refused_with_what_fits(few_frames: Path, tmp_path: Path) -> None:
    result = slam("stitch", few_frames, "-o", tmp_path / "out", "--metres-per-pixel", "0.00004")
    refused_line = result.output.strip().splitlines()[-1]
    assert result.exit_code == 1
    assert "--metres-per-pixel" in refused_line
    # What was located is kept: the command can be repeated with --resume and another resolution.
    assert {path.name for path in (tmp_path / "out").iterdir()} <= {".resume"}


@pytest.mark.parametrize("scale", ["0.000001", "0.5", "1000"])
def test_a_resolution_that_paints_nothing_is_refused_at_once(
    few_frames: Path, tmp_path: Path, scale: str
) -> None:
    result = slam("stitch", few_frames, "-o", tmp_path / "out", "--metres-per-pixel", scale)
    assert result.exit_code == 1
    assert "give --metres-per-pixel from" in result.output.strip().splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_frames_without_a_calibration_are_top_down_in_pixels(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).standard_normal((600, 700)).astype(np.float32)
    floor = cv2.GaussianBlur(noise, (0, 0), 2.0)
    picture = np.clip(128 + 50 * floor / floor.std(), 0, 255).astype(np.uint8)
    folder = tmp_path / "top down"
    folder.mkdir()
    for index, (column, row) in enumerate([(0, 0), (60, 20), (120, 50), (180, 40)]):
        window = picture[row : row + 400, column : column + 480]
        cv2.imwrite(str(folder / f"view {index}.png"), window)
    result = slam("stitch", folder, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "pixel units" in result.output
    poses = list(read_poses(tmp_path / "out" / "poses.csv").values())
    expected = [(0, 0), (60, -20), (120, -50), (180, -40)]
    np.testing.assert_allclose([(p.x, p.y) for p in poses], expected, atol=0.1)
    mosaic = cv2.imread(str(tmp_path / "out" / "mosaic.png"))
    np.testing.assert_array_equal(mosaic[0:50, 0:100, 0], picture[0:50, 0:100])


def test_warp_writes_metric_pictures(few_frames: Path, tmp_path: Path) -> None:
    result = slam("warp", few_frames, "-o", tmp_path / "views", "--metres-per-pixel", "0.002")
    assert result.exit_code == 0, result.output
    view = cv2.imread(str(tmp_path / "views" / "0000.png"), cv2.IMREAD_UNCHANGED)
    world = np.loadtxt(tmp_path / "views" / "0000.pgw")
    np.testing.assert_allclose(world[[0, 3]], [0.002, -0.002])
    assert view[0, 0, 3] == 0
    assert (view[..., 3] == 255).mean() > 0.3
    assert world[4] == pytest.approx(0.16, abs=0.01)
    refused(slam("warp", few_frames, "-o", tmp_path / "views"), "--overwrite")

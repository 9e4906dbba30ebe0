"""What is not read is counted and named, and samples of 12 bits in 16 are no black."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from slamcli.io.containers import heic
from slamcli.io.files import write_drawing, write_image
from slamcli.io.frames import list_frames, read_frame, read_image, read_reduced_gray
from slamcli.io.images.own import is_marked
from slamcli.io.images.unread import unread_note
from slamcli.io.raster import png
from slamcli.run.inputs import open_inputs

PICTURE = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1))


def note_of(*sources: Path) -> str:
    return unread_note(list_frames(sources))


def test_other_files_of_a_folder_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(heic, "find_spec", lambda _: None)
    for name in ("1.jpg", "2.jpg"):
        cv2.imwrite(str(tmp_path / name), PICTURE)
    assert note_of(tmp_path) == ""
    for name in ("1.heic", "2.HEIC", "clip.mp4", "what.bin", "truth.csv", "settings.yaml"):
        (tmp_path / name).write_bytes(b"x")
    counts = "not read: 2 HEIC files, 1 other file, 1 video file"
    assert note_of(tmp_path) == f"{counts}, HEIC needs pip install 'slamcli[heic]'"
    assert "not read: 2 HEIC files" in open_inputs([tmp_path], None).note
    # A picture that is named alone is no folder of frames.
    assert note_of(tmp_path / "1.jpg") == ""


def test_pages_are_frames_and_none_is_left(tmp_path: Path) -> None:
    pages = [Image.fromarray(PICTURE // n) for n in (1, 2, 3)]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    pages[0].save(tmp_path / "b.tif")
    assert note_of(tmp_path) == ""
    assert len(list_frames([tmp_path])) == 4
    pages[0].save(tmp_path / "c.gif", save_all=True, append_images=pages[1:])
    assert note_of(tmp_path / "c.gif") == ""
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif")[..., 0], PICTURE)


@pytest.mark.parametrize(("suffix", "kind"), [("png", "PNG"), ("webp", "WebP")])
def test_further_frames_of_animations_are_counted(tmp_path: Path, suffix: str, kind: str) -> None:
    pages = [Image.fromarray(PICTURE // n) for n in (1, 2, 3)]
    path = tmp_path / f"0.{suffix}"
    pages[0].save(path, save_all=True, append_images=pages[1:], lossless=True)
    assert note_of(tmp_path) == f"not read: 2 further {kind} frames"
    np.testing.assert_array_equal(read_image(path)[..., 0], PICTURE)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_what_this_program_drew_is_no_frame(tmp_path: Path, suffix: str) -> None:
    colours = np.dstack([PICTURE] * 3)
    for number in range(2):
        write_image(tmp_path / f"{number}{suffix}", colours)
    write_drawing(tmp_path / f"calibration{suffix}", colours)
    assert [file.name for file in list_frames([tmp_path])] == [f"0{suffix}", f"1{suffix}"]
    assert note_of(tmp_path) == f"not read: 1 picture made by slamcli (calibration{suffix})"
    # It is a picture all the same, whatever reads it.
    drawn = tmp_path / f"calibration{suffix}"
    np.testing.assert_array_equal(read_image(drawn), cv2.imread(str(drawn)))
    np.testing.assert_array_equal(read_image(drawn), read_image(tmp_path / f"0{suffix}"))
    with Image.open(drawn) as picture:
        assert picture.size == (64, 48)


def test_every_picture_for_people_has_the_mark(tmp_path: Path) -> None:
    pixels = np.zeros((48, 64, 4), np.uint8)
    png.write_png(tmp_path / "mosaic.png", 64, 48, [png.compress(pixels)])
    write_drawing(tmp_path / "deep.png", np.zeros((48, 64), np.uint16))
    write_image(tmp_path / "frame.png", PICTURE)
    assert [is_marked(path) for path in sorted(tmp_path.iterdir())] == [True, False, True]


@pytest.mark.parametrize("suffix", ["png", "tif", "pgm"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_samples_of_fewer_bits_in_16_are_no_black(tmp_path: Path, suffix: str, bits: int) -> None:
    deep = PICTURE.astype(np.uint16) << (bits - 8)
    path = tmp_path / f"0.{suffix}"
    if suffix == "pgm":
        head = f"P5 64 48 {2**bits - 1}\n".encode()
        path.write_bytes(head + deep.astype(">u2").tobytes())
    else:
        cv2.imwrite(str(path), deep)
    (file,) = list_frames([path])
    np.testing.assert_array_equal(read_frame(file).image, np.dstack([PICTURE] * 3))
    np.testing.assert_array_equal(read_frame(file, gray=True).image, PICTURE)
    np.testing.assert_array_equal(read_image(path)[..., 1], PICTURE)
    assert read_frame(file, halved=True).image.shape == (24, 32, 3)
    assert read_reduced_gray(file).shape == (12, 16)


def test_the_range_is_the_same_for_all_frames_of_a_run(tmp_path: Path) -> None:
    for name, divisor in (("0", 8), ("1", 1), ("2", 2)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), (PICTURE // divisor).astype(np.uint16) << 4)
    means = [read_frame(file).image.mean() for file in list_frames([tmp_path])]
    np.testing.assert_allclose(means, [(PICTURE // n).mean() for n in (8, 1, 2)])

"""Frames as they come: every format read alike, every fault named in one line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from slamcli.core.errors import FrameError, InputError
from slamcli.io.frames import list_frames, read_frame, read_image
from slamcli.stages.view import to_gray

RED_LEFT = np.zeros((48, 64, 3), np.uint8)
RED_LEFT[:, :32] = (0, 0, 200)
RED_LEFT[:, 32:] = (180, 40, 10)


def save(path: Path, image: np.ndarray = RED_LEFT) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def reason_of(path: Path) -> str:
    with pytest.raises(FrameError) as caught:
        read_image(path)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_names_sort_as_people_count(tmp_path: Path) -> None:
    for name in ("frame10.png", "frame2.png", "Frame1.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    assert [f.name for f in list_frames([tmp_path])] == ["Frame1.png", "frame2.png", "frame10.png"]


def test_a_folder_of_tum_stands_for_its_colour_pictures_by_their_stamps(tmp_path: Path) -> None:
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
        for stamp in ("1305031102.211214", "1305031102.175304"):
            save(tmp_path / name / f"{stamp}.png")
    (tmp_path / "rgb.txt").write_text("# color images")
    files = list_frames([tmp_path])
    assert [file.path.parent.name for file in files] == ["rgb", "rgb"]
    assert [file.stamp for file in files] == [1305031102.175304, 1305031102.211214]


def test_a_cameras_card_stands_for_all_its_pictures(tmp_path: Path) -> None:
    for folder in ("100MEDIA", "101MEDIA", "99MEDIA"):
        (tmp_path / "DCIM" / folder).mkdir(parents=True)
        save(tmp_path / "DCIM" / folder / "DJI_0001.JPG")
    for source in (tmp_path, tmp_path / "DCIM"):
        folders = [file.path.parent.name for file in list_frames([source])]
        assert folders == ["99MEDIA", "100MEDIA", "101MEDIA"]


def test_a_folder_stands_for_its_frames_folder(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    save(tmp_path / "frames" / "0.png")
    save(tmp_path / "square.png")
    assert [f.name for f in list_frames([tmp_path])] == ["0.png"]


def test_spaces_and_other_scripts_in_names(tmp_path: Path) -> None:
    folder = tmp_path / "Fußboden 床"
    folder.mkdir()
    Image.fromarray(RED_LEFT[..., ::-1]).save(folder / "bild ä 1.png")
    (file,) = list_frames([folder])
    np.testing.assert_array_equal(read_frame(file).image, RED_LEFT)


def test_stamps_come_from_epoch_names_or_the_frame_rate(tmp_path: Path) -> None:
    save(tmp_path / "1446412345.250000.png")
    assert list_frames([tmp_path])[0].stamp == 1446412345.25
    save(tmp_path / "1.png")
    assert list_frames([tmp_path], frame_rate=10.0)[0].stamp == 0.0


@pytest.mark.parametrize("missing", ["nothing", "empty"])
def test_no_images(tmp_path: Path, missing: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"does not exist|no images"):
        list_frames([tmp_path / missing])


def test_gray_rgba_and_16_bit_are_read_as_8_bit_bgr(tmp_path: Path) -> None:
    gray = np.full((20, 30), 77, np.uint8)
    np.testing.assert_array_equal(read_image(save(tmp_path / "g.png", gray)), np.dstack([gray] * 3))
    rgba = np.dstack([RED_LEFT, np.full((48, 64), 255, np.uint8)])
    np.testing.assert_array_equal(read_image(save(tmp_path / "a.png", rgba)), RED_LEFT)
    deep = RED_LEFT.astype(np.uint16) * 257
    for name in ("d.png", "d.tif"):
        np.testing.assert_array_equal(read_image(save(tmp_path / name, deep)), RED_LEFT)


def test_transparent_pixels_are_masked_out(tmp_path: Path) -> None:
    alpha = np.full((48, 64), 255, np.uint8)
    alpha[:10] = 0
    save(tmp_path / "a.png", np.dstack([RED_LEFT, alpha]))
    frame = read_frame(list_frames([tmp_path])[0])
    assert frame.mask is not None
    np.testing.assert_array_equal(frame.mask, alpha)


def test_cmyk_is_converted(tmp_path: Path) -> None:
    picture = Image.new("CMYK", (64, 48), (0, 255, 255, 0))
    picture.save(tmp_path / "c.jpg", quality=95)
    blue, green, red = read_image(tmp_path / "c.jpg")[24, 32].astype(int)
    assert red > 200
    assert max(blue, green) < 80


@pytest.mark.parametrize("kind", ["jpg", "png", "webp", "tif", "turned", "cmyk", "deep", "rgba"])
def test_gray_is_what_the_colours_come_to(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"0.{kind if kind in {'jpg', 'webp', 'tif'} else 'png'}"
    picture = Image.fromarray(RED_LEFT[..., ::-1])
    exif = Image.Exif()
    exif[0x0112] = 6
    if kind == "turned":
        path = tmp_path / "0.jpg"
        picture.save(path, exif=exif, quality=95)
    elif kind == "cmyk":
        path = tmp_path / "0.jpg"
        picture.convert("CMYK").save(path, quality=95)
    elif kind == "deep":
        save(path, RED_LEFT.astype(np.uint16) * 257)
    elif kind == "rgba":
        save(path, np.dstack([RED_LEFT, np.full(RED_LEFT.shape[:2], 255, np.uint8)]))
    else:
        picture.save(path)
    (file,) = list_frames([tmp_path])
    gray = to_gray(read_frame(file, gray=True).image).astype(int)
    assert np.abs(gray - to_gray(read_frame(file).image)).max() <= 2


@pytest.mark.parametrize("kind", ["jpg", "png", "webp", "turned", "cmyk"])
def test_a_pixel_of_half_the_size_is_the_mean_of_four(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"0.{kind if kind in {'png', 'webp'} else 'jpg'}"
    smooth = np.tile(np.linspace(0, 255, 64, dtype=np.uint8)[None, :, None], (48, 1, 3))
    picture = Image.fromarray(np.dstack([smooth[..., 0], smooth[:, ::-1, 1], smooth[..., 2]]))
    exif = Image.Exif()
    exif[0x0112] = 6 if kind == "turned" else 1
    picture.convert("CMYK" if kind == "cmyk" else "RGB").save(path, exif=exif, quality=95)
    (file,) = list_frames([tmp_path])
    whole, half = read_frame(file).image, read_frame(file, halved=True).image
    height, width = whole.shape[0] // 2, whole.shape[1] // 2
    assert half.shape == (height, width, 3)
    means = whole.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
    assert np.abs(half - means).mean() < 1.5


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_exif_orientation_is_applied(tmp_path: Path, suffix: str) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / f"turned.{suffix}"
    Image.fromarray(RED_LEFT[..., ::-1]).save(path, exif=exif, quality=95)
    image = read_image(path)
    assert image.shape == (64, 48, 3)
    assert image[5, 24, 2] > 150
    assert image[58, 24, 2] < 60


def test_a_wide_sample_format_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    assert cv2.imwrite(str(path), RED_LEFT.astype(np.float32))
    assert "32 bits a sample cannot be read" in reason_of(path)


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_truncated_file_is_refused(tmp_path: Path, suffix: str, share: float) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    whole = save(tmp_path / f"whole.{suffix}", noise).read_bytes()
    path = tmp_path / f"cut.{suffix}"
    path.write_bytes(whole[: int(len(whole) * share)])
    assert "truncated" in reason_of(path)


def test_other_faults_are_named(tmp_path: Path) -> None:
    (tmp_path / "zero.png").write_bytes(b"")
    assert "empty (0 bytes)" in reason_of(tmp_path / "zero.png")
    (tmp_path / "text.png").write_text("not a picture")
    assert "not an image" in reason_of(tmp_path / "text.png")
    assert "too small" in reason_of(save(tmp_path / "one.png", np.zeros((1, 1, 3), np.uint8)))
    assert "cannot be read" in reason_of(tmp_path / "absent.png")

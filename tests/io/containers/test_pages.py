"""Files of several pages, and HEIC photos."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from command_line import slam
from photo_files import exif_of
from PIL import Image

from slamcli.core.errors import FrameError, InputError
from slamcli.io.containers import heic, pages
from slamcli.io.frames import list_frames, read_frame
from slamcli.io.images.unread import unread_note
from slamcli.io.telemetry import read_gps
from slamcli.run.inputs import open_inputs

pillow_heif.register_heif_opener()


def noise(count: int, size: tuple[int, int] = (48, 32)) -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    return list(generator.integers(0, 256, (count, size[1], size[0], 3), dtype=np.uint8))


def write_pages(path: Path, pages: list[Image.Image]) -> Path:
    pages[0].save(path, save_all=True, append_images=pages[1:])
    return path


def test_every_page_of_a_tiff_is_a_frame(tmp_path: Path) -> None:
    pictures = noise(12)
    write_pages(tmp_path / "stack.tif", [Image.fromarray(p[..., ::-1]) for p in pictures])
    inputs = open_inputs([tmp_path], None, frame_rate=10.0)
    assert [f.name for f in inputs.files[:2]] == ["stack_01.tif", "stack_02.tif"]
    assert "stack.tif: 12 of 12 pages taken" in inputs.note
    assert "not read" not in inputs.note
    sent = pickle.loads(pickle.dumps(inputs.files))
    for number in (11, 0, 5):
        np.testing.assert_array_equal(read_frame(sent[number]).image, pictures[number])
    assert inputs.files[3].stamp == pytest.approx(0.3)


def test_without_imageio_the_first_page_is_read_and_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = noise(3)
    write_pages(tmp_path / "stack.tif", [Image.fromarray(p[..., ::-1]) for p in pictures])
    monkeypatch.setattr(pages, "find_spec", lambda _: None)
    (file,) = list_frames([tmp_path])
    np.testing.assert_array_equal(read_frame(file).image, pictures[0])
    named = "not read: 2 further TIFF pages, pages need pip install 'slamcli[pages]'"
    assert unread_note([file]) == named


def test_pages_of_16_bits_share_one_range(tmp_path: Path) -> None:
    ramp = np.tile(np.arange(48, dtype=np.uint16) * 80, (32, 1))
    both = [Image.fromarray(ramp), Image.fromarray(ramp // 80)]
    write_pages(tmp_path / "stack.tif", both)
    bright, dark = (read_frame(f).image.max() for f in list_frames([tmp_path / "stack.tif"]))
    assert (bright, dark) == (3760 >> 4, 47 >> 4)


def test_reduced_copies_are_no_frames(tmp_path: Path) -> None:
    (picture,) = noise(1)
    whole = Image.fromarray(picture)
    write_pages(tmp_path / "map.tif", [whole, whole.resize((24, 16))])
    (file,) = list_frames([tmp_path])
    assert (file.name, file.part) == ("map.tif", None)
    assert unread_note([file]) == "not read: 1 further TIFF page"


def test_every_picture_of_a_gif_is_a_frame(tmp_path: Path) -> None:
    pictures = [cv2.GaussianBlur(one, (0, 0), 6.0) // 32 * 32 for one in noise(3)]
    path = write_pages(tmp_path / "a.gif", [Image.fromarray(p[..., ::-1]) for p in pictures])
    files = list_frames([path])
    assert len(files) == 3
    for file, picture in zip(files, pictures, strict=True):
        difference = read_frame(file).image.astype(int) - picture
        assert np.abs(difference).mean() < 8.0


def test_a_damaged_page_costs_that_page(tmp_path: Path) -> None:
    pages = [Image.fromarray(p) for p in noise(3)]
    path = tmp_path / "stack.tif"
    pages[0].save(path, save_all=True, append_images=pages[1:], compression="tiff_deflate")
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    path.write_bytes(data)
    outcomes = []
    for file in list_frames([path]):
        try:
            read_frame(file)
            outcomes.append("read")
        except FrameError as error:
            outcomes.append(str(error))
    assert outcomes[0] == outcomes[2] == "read"
    assert "refuses" in outcomes[1]


def test_a_heic_photo_is_read(tmp_path: Path) -> None:
    picture = cv2.GaussianBlur(noise(1, (96, 64))[0], (0, 0), 6.0)
    path = tmp_path / "IMG_1.HEIC"
    Image.fromarray(picture[..., ::-1]).save(path, format="HEIF", quality=95)
    (file,) = list_frames([tmp_path])
    assert (file.name, file.size()) == ("IMG_1.HEIC", (96, 64))
    assert np.abs(read_frame(file).image.astype(int) - picture).mean() < 3.0
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FrameError, match="damaged"):
        read_frame(list_frames([path])[0])


def test_extracted_heic_photos_keep_the_stamps_of_their_places(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for number, picture in enumerate(noise(3)):
        exif = exif_of(time=f"2024:05:06 12:00:0{number}", place=(52.0, 13.0 + number, 30.0))
        path = tmp_path / "photos" / f"IMG_{number}.heic"
        Image.fromarray(picture).save(path, format="HEIF", exif=exif)
    result = slam("extract", tmp_path / "photos", "-o", tmp_path / "files")
    assert result.exit_code == 0, result.output
    files = list_frames([tmp_path / "files" / "frames"])
    places = read_gps(tmp_path / "files" / "gps.csv")
    assert len(files) == 3
    assert [file.stamp for file in files] == [one.stamp for one in places]


def test_without_pillow_heif_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.fromarray(noise(1)[0]).save(tmp_path / "IMG_1.heic", format="HEIF")
    monkeypatch.setattr(heic, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"pip install 'slamcli\[heic\]'"):
        list_frames([tmp_path])
    cv2.imwrite(str(tmp_path / "a.png"), noise(1)[0])
    (file,) = list_frames([tmp_path])
    assert unread_note([file]).endswith("1 HEIC file, HEIC needs pip install 'slamcli[heic]'")

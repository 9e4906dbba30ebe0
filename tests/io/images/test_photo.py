"""What cameras note in photos: read where it is there, and never a failure where it is damaged."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from photo_files import exif_of, write_photo

from slamcli.io.frames import list_frames
from slamcli.io.images.photo import PhotoInfo, photo_info, read_photo_info

PICTURE = np.full((48, 64, 3), 120, np.uint8)
NOON = datetime(2024, 5, 6, 12, 0, 0, tzinfo=UTC).timestamp()
DRONE = exif_of(
    time="2024:05:06 14:00:00",
    subseconds="250",
    zone="+02:00",
    place=(-33.8567844, 151.2152967, 87.5),
    focal_35mm=24,
)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_time_place_and_lens_are_read(tmp_path: Path, suffix: str) -> None:
    info = read_photo_info(write_photo(tmp_path / f"p.{suffix}", PICTURE, DRONE))
    assert info.seconds == pytest.approx(NOON + 0.25)
    assert info.place_degrees == pytest.approx((-33.8567844, 151.2152967), abs=1e-7)
    assert info.altitude_metres == pytest.approx(87.5)
    # A full-frame camera's diagonal is 43.27 mm.
    assert info.focal_pixels((4000, 3000)) == pytest.approx(24 / 43.2666 * 5000.0, rel=1e-4)


def test_dji_notes_height_and_direction(tmp_path: Path) -> None:
    dji = {
        "RelativeAltitude": "+31.40",
        "GimbalYawDegree": "-12.5",
        "GimbalPitchDegree": "-90.00",
        "RtkStdLat": "0.012",
        "RtkStdLon": "0.015",
    }
    info = read_photo_info(write_photo(tmp_path / "p.jpg", PICTURE, DRONE, dji))
    assert info.relative_altitude_metres == 31.4
    assert (info.yaw_degrees, info.pitch_degrees) == (-12.5, -90.0)
    assert info.place_sigma_metres == 0.015


def test_no_fix_is_no_place() -> None:
    assert PhotoInfo(latitude_degrees=0.0, longitude_degrees=0.0).place_degrees is None


def test_damage_is_never_a_failure(tmp_path: Path) -> None:
    whole = write_photo(tmp_path / "p.jpg", PICTURE, DRONE).read_bytes()
    generator = np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(whole[: int(generator.integers(20, len(whole)))])
        for place in generator.integers(0, min(len(data), 400), 6):
            data[place] = int(generator.integers(0, 256))
        info = photo_info(bytes(data))
        assert info.latitude_degrees is None or abs(info.latitude_degrees) <= 90.0


def test_photos_have_the_time_of_capture_as_their_stamp(tmp_path: Path) -> None:
    for number in range(3):
        exif = exif_of(time=f"2024:05:06 12:00:0{number}", subseconds="5")
        write_photo(tmp_path / f"DJI_{number}.jpg", PICTURE, exif)
    stamps = [file.stamp for file in list_frames([tmp_path])]
    assert stamps == pytest.approx([NOON + 0.5, NOON + 1.5, NOON + 2.5])
    assert list_frames([tmp_path], frame_rate=2.0)[2].stamp == 1.0


def test_whole_seconds_without_a_place_are_no_stamps(tmp_path: Path) -> None:
    for number in range(3):
        exif = exif_of(time=f"2024:05:06 12:00:0{number}")
        write_photo(tmp_path / f"{number}.jpg", PICTURE, exif)
    assert list_frames([tmp_path])[0].stamp is None


def test_heic_photos_have_their_notes_too(tmp_path: Path) -> None:
    pillow_heif.register_heif_opener()
    for number in range(2):
        exif = exif_of(time=f"2024:05:06 12:00:0{number}", subseconds="5")
        write_photo(tmp_path / f"IMG_{number}.heic", PICTURE, exif)
    assert [f.stamp for f in list_frames([tmp_path])] == pytest.approx([NOON + 0.5, NOON + 1.5])

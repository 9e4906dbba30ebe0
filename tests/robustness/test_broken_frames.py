"""Two hundred frames, forty of them broken in ten ways: their reasons, and the others' poses."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slam
from worlds import CAMERA, make_photographer, take

from slamcli.core.geometry import Pose2
from slamcli.io.calibrations import save_calibration

COUNT, BROKEN = 200, 40
STEP_METRES = 0.025
MAX_DIFFERENCE_METRES = 1e-5


def zeroed(data: bytes, byte: bytes = b"\0") -> bytes:
    start, count = len(data) // 2, len(data) // 4
    return data[:start] + count * byte + data[start + count :]


def thumbnail(data: bytes) -> bytes:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_BGR)
    return cv2.imencode(".jpg", cv2.resize(image, (160, 120)))[1].tobytes()


def claiming_30000_pixels(data: bytes) -> bytes:
    place = data.find(b"\xff\xc0") + 5
    return data[:place] + bytes.fromhex("7530 7530") + data[place + 4 :]


def wrong_png(data: bytes) -> bytes:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_BGR)
    changed = bytearray(cv2.imencode(".png", image)[1].tobytes())
    changed[len(changed) // 2] ^= 4
    return bytes(changed)


WAYS: dict[str, Callable[[bytes], bytes] | None] = {
    "the file is empty": lambda _: b"",
    "truncated, the end of the file is missing": lambda data: data[: 2 * len(data) // 3],
    "a stretch of the file is zero": zeroed,
    "a stretch of the file is erased": lambda data: zeroed(data, b"\xff"),
    "a PostScript file": lambda data: b"%!PS-Adobe-3.0\n" + data,
    "of the kind AVIF": lambda data: b"\0\0\0\x20ftypavif" + data,
    "160x120 pixels, but the run's camera has 640x480": thumbnail,
    "the header declares 30000x30000 pixels": claiming_30000_pixels,
    "a checksum of the PNG": wrong_png,
    "it is not a file (a folder, a pipe or a device)": None,
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    photographer = make_photographer(camera=replace(CAMERA, size=(640, 480)))
    (folder / "frames").mkdir()
    save_calibration(folder / "frames" / "calibration.yaml", photographer.calibration)
    for number in range(COUNT):
        image = take(photographer, Pose2(STEP_METRES * number), number)
        cv2.imwrite(str(folder / "frames" / f"{number:04d}.jpg"), image)
    return folder


def poses(folder: Path, output: Path) -> dict[str, dict[str, str]]:
    result = slam("stitch", folder, "-o", output, "--metres-per-pixel", "0.004")
    assert result.exit_code == 0, result.output
    with (output / "poses.csv").open() as stream:
        return {row["frame"]: row for row in csv.DictReader(stream)}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
def test_broken_frames_have_their_reason_and_leave_the_others_alone(
    drive: Path, tmp_path: Path
) -> None:
    broken, good = tmp_path / "broken", tmp_path / "good"
    shutil.copytree(drive / "frames", broken)
    shutil.copytree(drive / "frames", good)
    wanted: dict[str, str] = {}
    for number in range(BROKEN):
        name = f"{5 * number + 2:04d}.jpg"
        text, change = list(WAYS.items())[number % len(WAYS)]
        wanted[name] = text
        (good / name).unlink()
        data = (broken / name).read_bytes()
        if change is None:
            (broken / name).unlink()
            os.mkfifo(broken / name)
        else:
            (broken / name).write_bytes(change(data))
    found, reference = poses(broken, tmp_path / "1"), poses(good, tmp_path / "2")
    assert len(found) == COUNT
    for name, text in wanted.items():
        assert found[name]["status"] == "lost"
        assert text in found[name]["reason"], name
    assert set(reference) == set(found) - set(wanted)
    for name, row in reference.items():
        assert row["x"], f"{name} is not placed: {row['reason']}"
        for column in ("x", "y"):
            assert abs(float(row[column]) - float(found[name][column])) < MAX_DIFFERENCE_METRES

"""Properties of the picture readers, of any bytes and of any picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("hypothesis")
pytest.importorskip("PIL")

import picture_formats
from fuzz import Format, outcome_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamcli.core.errors import FrameError
from slamcli.io.frames import list_frames, read_frame, read_image
from slamcli.io.images import exif

BOUNDED = settings(
    max_examples=60,
    deadline=2000,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
STARTS = (
    *(b"\xff\xd8\xff\xc0", b"\xff\xd8\xff\xda", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"II+\0"),
    *(b"BM", b"GIF89a", b"P1 ", b"P4\n", b"P6\n", b"RIFF\xff\0\0\0WEBPVP8 ", b"RIFF\0\0\0\0WEBP"),
    *(b"%!PS", b"\0\0\0\x20ftypavif", b""),
)
CORPUS = {
    f"{name} {number}": (kind, data)
    for name, kind in picture_formats.FORMATS.items()
    for number, data in enumerate(kind.corpus())
}


def reason_or_picture(path: Path, data: bytes) -> None:
    kind = Format(path.suffix, list, picture_formats.read, (FrameError,))
    outcome = outcome_of(kind, data, path.parent)
    assert outcome.kind in {"clean", "reason"}, outcome.text


@BOUNDED
@given(start=st.sampled_from(STARTS), rest=st.binary(max_size=400))
def test_any_bytes_are_a_picture_or_a_reason(tmp_path: Path, start: bytes, rest: bytes) -> None:
    reason_or_picture(tmp_path / "any.jpg", start + rest)


@BOUNDED
@given(name=st.sampled_from(sorted(CORPUS)), share=st.floats(0, 1))
def test_any_cut_is_a_picture_or_a_reason(tmp_path: Path, name: str, share: float) -> None:
    kind, data = CORPUS[name]
    reason_or_picture(tmp_path / f"cut{kind.suffix}", data[: int(share * len(data))])


@BOUNDED
@given(
    name=st.sampled_from(sorted(CORPUS)),
    places=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4),
)
def test_any_changed_bytes_are_a_picture_or_a_reason(
    tmp_path: Path, name: str, places: list[tuple[float, int]]
) -> None:
    kind, data = CORPUS[name]
    changed = bytearray(data)
    for share, value in places:
        changed[int(share * len(data))] = value
    reason_or_picture(tmp_path / f"changed{kind.suffix}", bytes(changed))


@BOUNDED
@given(
    width=st.integers(16, 70),
    height=st.integers(16, 70),
    channels=st.sampled_from((1, 3)),
    suffix=st.sampled_from((".png", ".bmp", ".tif", ".pnm")),
    seed=st.integers(0, 99),
)
def test_a_lossless_picture_is_read_as_it_was_written(
    tmp_path: Path, width: int, height: int, channels: int, suffix: str, seed: int
) -> None:
    shape = (height, width, channels)
    pixels = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    path = tmp_path / f"0{suffix}"
    cv2.imwrite(str(path), pixels)
    np.testing.assert_array_equal(read_image(path), np.broadcast_to(pixels, (height, width, 3)))
    (file,) = list_frames([path])
    assert read_frame(file).mask is None


@BOUNDED
@given(code=st.integers(1, 8))
def test_turning_a_picture_eight_ways_keeps_its_pixels(code: int) -> None:
    pixels = np.arange(20 * 30, dtype=np.int64).reshape(20, 30).astype(np.uint8)
    turned = exif.turn(pixels, code)
    assert turned.shape == ((30, 20) if code >= 5 else (20, 30))
    np.testing.assert_array_equal(np.sort(turned.ravel()), np.sort(pixels.ravel()))


@given(block=st.binary(max_size=60))
def test_any_exif_block_gives_an_orientation(block: bytes) -> None:
    assert 1 <= exif.orientation(block) <= 8

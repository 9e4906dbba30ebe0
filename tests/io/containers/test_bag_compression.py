"""Compressed bags: a small file that would become gigabytes is refused before it does."""

from __future__ import annotations

import bz2
import io
import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_files import write_bag

from slamcli.core.errors import InputError
from slamcli.io.containers import bag_compression
from slamcli.io.containers.bag_compression import (
    BoundedFile,
    DecompressionError,
    bound_decompression,
    bounded,
)
from slamcli.io.frames import list_frames

reader_2 = pytest.importorskip("rosbags.rosbag2.reader")
lz4 = pytest.importorskip("lz4.frame")
ZEROS = bytes(50_000_000)


def zstd_of_rosbags() -> object:
    from rosbags.rosbag2 import storage_mcap

    return storage_mcap.zstd


@pytest.fixture(params=["zstd", "lz4", "bz2"])
def codec(request: pytest.FixtureRequest) -> tuple[Callable[[bytes], bytes], Callable[..., bytes]]:
    zstd = zstd_of_rosbags()
    return {
        "zstd": (zstd.compress, bounded(zstd.ZstdDecompressor)),  # type: ignore[attr-defined]
        "lz4": (lz4.compress, bounded(lz4.LZ4FrameDecompressor)),
        "bz2": (bz2.compress, bounded(bz2.BZ2Decompressor)),
    }[request.param]


def test_a_block_has_at_most_its_claimed_size(
    codec: tuple[Callable[[bytes], bytes], Callable[..., bytes]],
) -> None:
    compress, decompress = codec
    text = b"pictures" * 1000
    assert decompress(compress(text), len(text)) == text
    assert decompress(compress(text) + compress(text)) == 2 * text
    with pytest.raises(DecompressionError, match="larger than it may be"):
        decompress(compress(ZEROS), 1000)
    with pytest.raises((DecompressionError, RuntimeError, OSError, EOFError)):
        decompress(compress(text)[:-5], len(text))


def test_a_file_becomes_at_most_a_multiple_of_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_compression, "_MAX_CHUNK_BYTES", 10_000_000)
    zstd = zstd_of_rosbags()
    small = BoundedFile(io.BufferedReader(io.BytesIO(zstd.compress(b"bag"))), zstd)  # type: ignore[attr-defined, arg-type]
    assert (small.read(), small.read()) == (b"bag", b"")
    bomb = BoundedFile(io.BufferedReader(io.BytesIO(zstd.compress(ZEROS))), zstd)  # type: ignore[attr-defined, arg-type]
    with pytest.raises(DecompressionError, match="larger than it may be"):
        shutil.copyfileobj(bomb, io.BytesIO())


def test_a_bag_whose_file_is_a_bomb_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_compression, "_MAX_CHUNK_BYTES", 10_000_000)
    bound_decompression()
    pictures = [np.zeros((46, 60, 3), np.uint8)]
    folder = write_bag(tmp_path / "drive", pictures, lambda _: None)
    (file,) = folder.glob("*.db3")
    text = (folder / "metadata.yaml").read_text()
    for key, value in (("compression_format", "zstd"), ("compression_mode", "FILE")):
        text = text.replace(f"{key}: ''", f"{key}: '{value}'")
    (folder / "metadata.yaml").write_text(text.replace(file.name, f"{file.name}.zstd"))
    zstd, data = zstd_of_rosbags(), file.read_bytes()
    file.unlink()
    (folder / f"{file.name}.zstd").write_bytes(zstd.compress(data))  # type: ignore[attr-defined]
    assert len(list_frames([folder])) == 1
    (folder / f"{file.name}.zstd").write_bytes(zstd.compress(ZEROS))  # type: ignore[attr-defined]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="larger than it may be"):
        list_frames([folder])
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000

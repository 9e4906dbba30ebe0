"""Bounded decompression of bags: a small file that claims or becomes gigabytes is refused.

rosbags decompresses whole chunks, messages and files by whatever size comes of them. Its functions
are replaced by ones with a bound; they have no other place to set it.
"""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable
from importlib import import_module
from types import SimpleNamespace
from typing import Any

# Of a chunk or a message: recorders begin a new chunk after some megabytes.
_MAX_CHUNK_BYTES = 2**29
# Of a file: bytes for each compressed one, where it is larger than a chunk may be. Pictures have 2
# to 20; zeros, thousands.
_MAX_FILE_RATIO = 200
_PIECE_BYTES = 2**20


class DecompressionError(Exception):
    """What is compressed is damaged, or larger than any recorder makes it."""


def bound_decompression() -> None:
    """Bound what rosbags decompresses, in this process."""
    places = ("rosbags.rosbag1.reader", "rosbags.rosbag2.reader", "rosbags.rosbag2.storage_mcap")
    modules: list[Any] = [import_module(place) for place in (*places, "lz4.frame")]
    reader_1, reader_2, storage_mcap, lz4 = modules
    if isinstance(reader_2.zstd, SimpleNamespace):
        return
    zstd = reader_2.zstd
    of_zstd = bounded(zstd.ZstdDecompressor)
    of_lz4 = bounded(lz4.LZ4FrameDecompressor)
    storage_mcap.DECOMPRESSORS.update(zstd=of_zstd, lz4=of_lz4)
    reader_1.decompressors.update(lz4=of_lz4, bz2=bounded(bz2.BZ2Decompressor))
    reader_2.zstd = SimpleNamespace(
        decompress=of_zstd, open=lambda stream, _mode: BoundedFile(stream, zstd)
    )


def bounded(make: Callable[[], Any]) -> Callable[..., bytes]:
    """Return a function that decompresses one block of bytes, up to a bound or a claimed size."""

    def decompress(data: bytes, size: int = _MAX_CHUNK_BYTES) -> bytes:
        left, parts = min(size, _MAX_CHUNK_BYTES), list[bytes]()
        while data:
            one = make()
            parts.append(one.decompress(data, max_length=left + 1))
            left -= len(parts[-1])
            if left < 0:
                raise DecompressionError("what is compressed in it is larger than it may be")
            if not one.eof:
                raise DecompressionError("what is compressed in it ends too early")
            data = one.unused_data
        return parts[0] if len(parts) == 1 else b"".join(parts)

    return decompress


class BoundedFile(io.RawIOBase):
    """A compressed file, read up to a multiple of its size.

    Parameters
    ----------
    stream : binary file
    zstd : module
    """

    def __init__(self, stream: io.BufferedReader, zstd: Any) -> None:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        self._left = max(_MAX_CHUNK_BYTES, _MAX_FILE_RATIO * size)
        self._inner = zstd.open(stream, "rb")

    def readable(self) -> bool:
        """Return True."""
        return True

    def read(self, size: int = _PIECE_BYTES) -> bytes:
        """Return the next bytes; raises DecompressionError beyond the bound."""
        piece: bytes = self._inner.read(size if size > 0 else _PIECE_BYTES)
        self._left -= len(piece)
        if self._left < 0:
            raise DecompressionError("what is compressed in it is larger than it may be")
        return piece

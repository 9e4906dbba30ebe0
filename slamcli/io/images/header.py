"""The header of a picture file: what it declares before a pixel is decoded, and its limits."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.errors import FrameError

# A picture of zeros is a thousandth of its size as a file: decoding it stays within 1.3 GB.
# [guarded by tests/io/images]
MAX_PIXELS, MAX_DEEP_PIXELS = 150_000_000, 64_000_000
_SHALLOW_BITS = 8
MIN_SIDE_PIXELS = 16
_FIRST_TRANSPOSED = 5  # of the EXIF codes


@dataclass(frozen=True, slots=True)
class Header:
    """What the header of a picture declares.

    Attributes
    ----------
    width, height : int
        Pixels, before any turn.
    sample_bits : int
        Bits of a sample as they are stored: 8 or less, or 16; for PNM those of its maximum.
    orientation : int
        EXIF code, 1 to 8.
    has_alpha : bool
        Whether a mask of opaque pixels can be read.
    """

    width: int
    height: int
    sample_bits: int = 8
    orientation: int = 1
    has_alpha: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels, as the picture is to be seen."""
        turned = self.orientation >= _FIRST_TRANSPOSED
        return (self.height, self.width) if turned else (self.width, self.height)

    def __post_init__(self) -> None:
        """Refuse a size that is no frame's; raises FrameError."""
        if min(self.width, self.height) < MIN_SIDE_PIXELS:
            raise FrameError(f"{self.width}x{self.height} pixels is too small to show a floor")
        limit = MAX_PIXELS if self.sample_bits <= _SHALLOW_BITS else MAX_DEEP_PIXELS
        if self.width * self.height > limit:
            raise FrameError(
                f"the header declares {self.width}x{self.height} pixels, too many to be decoded; "
                "save it smaller"
            )


def truncated() -> FrameError:
    """Return the error of a file that is shorter than its header declares."""
    return FrameError("damaged: truncated, the end of the file is missing")


def check_length(data: bytes, needed_bytes: int) -> None:
    """Raise FrameError when the file is shorter than its header requires."""
    if len(data) < needed_bytes:
        raise truncated()

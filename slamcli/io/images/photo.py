"""What a camera noted in a photo: time, place, height, direction, lens; from EXIF, DJI's XMP."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from itertools import pairwise
from pathlib import Path

from slamcli.core.bounds import (
    ANGLE,
    COORDINATE,
    LATITUDE_DEGREES,
    LONGITUDE_DEGREES,
    SIGMA_METRES,
    Bounds,
)
from slamcli.core.errors import FrameError
from slamcli.io.images.exif import EXIF_START
from slamcli.io.images.tiff import SIGNATURES

# What describes a photo is at its beginning: an EXIF segment has at most 64 KB, and so has XMP.
_HEAD_BYTES = 512 * 1024
_MAX_ENTRIES, _MAX_TEXT = 1024, 256
_EXIF, _GPS = 0x8769, 0x8825
_TIME, _SUBSECONDS, _ZONE, _FOCAL_35MM = 0x9003, 0x9291, 0x9011, 0xA405
_LATITUDE, _LONGITUDE, _ALTITUDE_BELOW, _ALTITUDE, _GPS_ERROR = 2, 4, 5, 6, 31
_TEXT, _SHORT, _LONG = 2, 3, 4
_RATIONALS = {5: "I", 10: "i"}
_BYTES = {1: 1, _TEXT: 1, _SHORT: 2, _LONG: 4, 5: 8, 7: 1, 9: 4, 10: 8, 13: 4}
# From the widest fisheye to the longest telescope, millimetres.
_FOCAL_LIMITS = Bounds(1.0, 1e5)
# Of an attribute or an element of XMP.
_DJI = re.compile(rb'drone-dji:(\w{1,40})(?:="|>)([-+]?\d{1,10}(?:\.\d{1,12})?)["<]')
_CLOCK = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d):(\d\d):(\d\d)")
_OFFSET = re.compile(r"([+-])(\d\d):(\d\d)")


@dataclass(frozen=True, slots=True)
class PhotoInfo:
    """What a photo says of itself; None for what it does not say.

    Attributes
    ----------
    seconds : float or None
        Time of capture since 1970; of a clock without a time zone as if it were UTC.
    has_subseconds : bool
    latitude_degrees, longitude_degrees : float or None
        WGS84.
    altitude_metres : float or None
        Above sea level.
    place_sigma_metres : float or None
        Of the place.
    relative_altitude_metres : float or None
        Above the place of take-off (DJI).
    yaw_degrees, pitch_degrees : float or None
        Of the optical axis (DJI's gimbal): clockwise from north; -90 straight down.
    focal_35mm : float or None
        Focal length of a camera with the same field of view and a film of 36 x 24 mm.
    """

    seconds: float | None = None
    has_subseconds: bool = False
    latitude_degrees: float | None = None
    longitude_degrees: float | None = None
    altitude_metres: float | None = None
    place_sigma_metres: float | None = None
    relative_altitude_metres: float | None = None
    yaw_degrees: float | None = None
    pitch_degrees: float | None = None
    focal_35mm: float | None = None

    @property
    def place_degrees(self) -> tuple[float, float] | None:
        """Latitude and longitude, when both are known and not those of a receiver without a fix."""
        latitude, longitude = self.latitude_degrees, self.longitude_degrees
        if latitude is None or longitude is None or (latitude, longitude) == (0.0, 0.0):
            return None
        return latitude, longitude

    def focal_pixels(self, size: tuple[int, int]) -> float | None:
        """Return the focal length for a picture of this width and height."""
        if self.focal_35mm is None:
            return None
        # Makers compare the diagonals (CIPA DCG-001).
        return self.focal_35mm * math.hypot(*size) / math.hypot(36.0, 24.0)


def read_photo_info(path: Path) -> PhotoInfo:
    """Return what a picture file says of itself; raises FrameError when it cannot be opened."""
    try:
        if not path.is_file():
            return PhotoInfo()
        with path.open("rb") as stream:
            return photo_info(stream.read(_HEAD_BYTES))
    except OSError as error:
        raise FrameError(f"cannot be read: {error.strerror or error}") from error


def photo_info(head: bytes) -> PhotoInfo:
    """Return what the beginning of a picture file says; never raises on damage."""
    block = _exif_block(head)
    main = _directory(block, _first_offset(block))
    exif = _directory(block, _offset(main, _EXIF))
    gps = _directory(block, _offset(main, _GPS))
    seconds, has_subseconds = _seconds(exif)
    dji = {name.decode(): float(value) for name, value in _DJI.findall(head)}
    altitude = _within(COORDINATE, _number(gps, _ALTITUDE))
    return PhotoInfo(
        seconds,
        has_subseconds,
        _degrees(gps, _LATITUDE, LATITUDE_DEGREES.high),
        _degrees(gps, _LONGITUDE, LONGITUDE_DEGREES.high / 2),
        None if altitude is None else (-altitude if _below(gps) else altitude),
        _within(SIGMA_METRES, _number(gps, _GPS_ERROR)) or _rtk_sigma(dji),
        _within(COORDINATE, dji.get("RelativeAltitude")),
        _within(ANGLE, dji.get("GimbalYawDegree")),
        _within(ANGLE, dji.get("GimbalPitchDegree")),
        _within(_FOCAL_LIMITS, _number(exif, _FOCAL_35MM)),
    )


def _within(limits: Bounds, value: float | None) -> float | None:
    """Return a number, None where it is none that a camera measures."""
    return value if value in limits else None


def photo_stamps(infos: Sequence[PhotoInfo]) -> list[float] | None:
    """Return the times of a series of photos, seconds; None unless they are those of their order.

    A clock of whole seconds is taken only with GPS, which shows that the photos are of a survey.
    """
    stamps = [info.seconds for info in infos if info.seconds is not None]
    exact = any(info.has_subseconds for info in infos)
    placed = all(info.place_degrees is not None for info in infos)
    if len(stamps) < len(infos) or not (exact or placed) or len(stamps) < 2:
        return None
    increasing = all(before < after for before, after in pairwise(stamps))
    return stamps if increasing else None


_Directory = dict[int, tuple[int, list[float] | str]]


def _exif_block(head: bytes) -> bytes:
    """Return the TIFF-like block of a JPEG, WebP, HEIC or PNG, or the TIFF itself."""
    if head.startswith(SIGNATURES):
        return head
    place = head.find(EXIF_START)
    if place >= 0:
        return head[place + len(EXIF_START) :]
    for chunk, skipped in ((b"eXIf", 4), (b"EXIF", 8)):  # of PNG, and of WebP with its length
        place = head.find(chunk)
        if place >= 0:
            return head[place + skipped :]
    return b""


def _order(block: bytes) -> str:
    return ">" if block[:2] == b"MM" else "<"


def _first_offset(block: bytes) -> int:
    if len(block) < 8 or block[:2] not in {b"II", b"MM"}:
        return 0
    return int(struct.unpack_from(f"{_order(block)}I", block, 4)[0])


def _directory(block: bytes, offset: int) -> _Directory:
    """Return the texts and numbers of a directory by tag; what lies outside is left out."""
    found: _Directory = {}
    order = _order(block)
    if not 8 <= offset <= len(block) - 2:
        return found
    (count,) = struct.unpack_from(f"{order}H", block, offset)
    for place in range(offset + 2, offset + 2 + 12 * min(count, _MAX_ENTRIES), 12):
        if place + 12 > len(block):
            break
        tag, kind, number = struct.unpack_from(f"{order}HHI", block, place)
        length = _BYTES.get(kind, 0) * number
        if not 0 < length <= _MAX_TEXT:
            continue
        at = place + 8 if length <= 4 else struct.unpack_from(f"{order}I", block, place + 8)[0]
        value = block[at : at + length]
        if len(value) == length:
            found[tag] = kind, _value(value, kind, number, order)
    return found


def _value(value: bytes, kind: int, number: int, order: str) -> list[float] | str:
    if kind == _TEXT:
        return value.split(b"\0")[0].decode("ascii", "replace")
    if kind in _RATIONALS:
        parts = struct.unpack(f"{order}{2 * number}{_RATIONALS[kind]}", value)
        pairs = zip(parts[::2], parts[1::2], strict=True)
        return [top / bottom if bottom else math.nan for top, bottom in pairs]
    letter = {1: "B", 7: "B", _SHORT: "H", _LONG: "I", 9: "i", 13: "I"}[kind]
    return list(struct.unpack(f"{order}{number}{letter}", value))


def _numbers(directory: _Directory, tag: int) -> list[float]:
    value = directory.get(tag, (0, ""))[1]
    return [] if isinstance(value, str) else value


def _number(directory: _Directory, tag: int) -> float | None:
    values = _numbers(directory, tag)
    return values[0] if values and math.isfinite(values[0]) else None


def _text(directory: _Directory, tag: int) -> str:
    value = directory.get(tag, (0, ""))[1]
    return value if isinstance(value, str) else ""


def _offset(directory: _Directory, tag: int) -> int:
    value = _number(directory, tag)
    return 0 if value is None else int(value)


def _degrees(gps: _Directory, tag: int, limit: float) -> float | None:
    """Return a latitude or longitude of degrees, minutes and seconds, and a letter before it."""
    values = _numbers(gps, tag)
    if len(values) != 3 or not all(map(math.isfinite, values)):
        return None
    degrees = values[0] + values[1] / 60.0 + values[2] / 3600.0
    negative = _text(gps, tag - 1).upper() in {"S", "W"}
    return None if degrees > limit else -degrees if negative else degrees


def _below(gps: _Directory) -> bool:
    return _number(gps, _ALTITUDE_BELOW) == 1.0


def _rtk_sigma(dji: dict[str, float]) -> float | None:
    """Return the larger sigma of a place that was measured against a base station, metres."""
    sigmas = [dji[name] for name in ("RtkStdLat", "RtkStdLon") if dji.get(name) in SIGMA_METRES]
    return max(sigmas, default=None)


def _seconds(exif: _Directory) -> tuple[float | None, bool]:
    """Return the time of capture, and whether it has parts of a second."""
    match = _CLOCK.match(_text(exif, _TIME))
    if match is None:
        return None, False
    zone = _OFFSET.match(_text(exif, _ZONE))
    offset = timedelta(0)
    if zone is not None:
        offset = timedelta(hours=int(zone[2]), minutes=int(zone[3]))
        offset = -offset if zone[1] == "-" else offset
    try:
        year, month, day, hour, minute, second = map(int, match.groups())
        clock = timezone(offset) if offset else UTC
        moment = datetime(year, month, day, hour, minute, second, tzinfo=clock)
    except ValueError:
        return None, False
    digits = re.match(r"\d{1,9}", _text(exif, _SUBSECONDS).strip())
    part = float(f"0.{digits[0]}") if digits else 0.0
    return moment.timestamp() + round(part, 6), digits is not None

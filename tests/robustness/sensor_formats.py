"""GPS tracks, the notes of photos and control points for the fuzzer."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from functools import reduce
from operator import xor
from pathlib import Path

from fuzz import Format
from photo_files import XMP, exif_of
from picture_formats import expect, picture
from PIL import Image
from table_formats import finite, these

from slamcli.core.bounds import LATITUDE_DEGREES, LONGITUDE_DEGREES
from slamcli.core.errors import FrameError, InputError
from slamcli.io.control_points import read_control_points
from slamcli.io.images.photo import PhotoInfo, photo_stamps
from slamcli.io.picture_files import photo_info_of
from slamcli.io.telemetry import read_gps

GPX = (
    b'<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="t" '
    b'xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n'
    b'<trkpt lat="29.64" lon="-82.35"><time>2026-01-02T03:04:05Z</time><hdop>1.2</hdop></trkpt>\n'
    b'<trkpt lat="29.65" lon="-82.36"><time>2026-01-02T03:04:06.5+01:00</time></trkpt>\n'
    b"</trkseg></trk></gpx>\n"
)
SENTENCES = (
    b"GPRMC,030405.00,A,2938.4,N,08221.0,W,0.1,90.0,020126,,",
    b"GPGGA,030405.00,2938.4000,N,08221.0000,W,1,08,0.9,30.0,M,,M,,",
    b"GNGGA,030406.50,2938.4001,N,08221.0002,W,4,12,0.5,30.0,M,,M,,",
    b"GNRMC,030406.50,V,,,,,,,020126,,",
)
CONTROL = (
    b"frame,column,row,x,y\n0.png,10,20,0,0\n0.png,50,20,1.5,0\n1.png,10,40,0,-1\n",
    b"name,u,v,lat,lon\n0.png,10,20,29.64,-82.35\n1.png,50,20,29.65,-82.36\n",
)
_SENTENCE = re.compile(rb"\$([^*$\r\n]*)\*..")


def sentences(*chosen: bytes) -> bytes:
    """Return sentences with their checksums."""
    return with_checksums(b"".join(b"$%b*00\r\n" % sentence for sentence in chosen))


def with_checksums(data: bytes) -> bytes:
    return _SENTENCE.sub(lambda m: b"$%b*%02X" % (m[1], reduce(xor, m[1], 0)), data)


def photos() -> list[bytes]:
    """Return photos with notes in EXIF and XMP, of several formats."""
    exif = exif_of(
        time="2026:01:02 03:04:05",
        subseconds="25",
        zone="+01:00",
        place=(29.64, -82.35, 31.5),
        focal_35mm=24,
    )
    attributes = (
        'drone-dji:RelativeAltitude="+20.5" drone-dji:GimbalPitchDegree="-90" '
        'drone-dji:GimbalYawDegree="12.5" drone-dji:RtkStdLat="0.02" drone-dji:RtkStdLon="0.03"'
    )
    xmp = XMP.format(attributes=attributes).encode()
    found = []
    for kind, more in (("JPEG", {"xmp": xmp}), ("JPEG", {}), ("PNG", {}), ("WEBP", {"xmp": xmp})):
        stream = io.BytesIO()
        Image.fromarray(picture()).save(stream, kind, exif=exif, **more)
        found.append(stream.getvalue())
    return found


def expect_notes(info: PhotoInfo) -> None:
    """Raise SilentlyWrongError for notes that no photo has."""
    numbers = [value for value in vars_of(info) if isinstance(value, float)]
    expect(all(map(math.isfinite, numbers)), "a note that is not finite")
    place = info.place_degrees
    if place is not None:
        expect(place[0] in LATITUDE_DEGREES and place[1] in LONGITUDE_DEGREES, "no place on Earth")
    sigma, focal = info.place_sigma_metres, info.focal_35mm
    expect(sigma is None or 1e-6 <= sigma <= 1e7, "a sigma that no solver can use")
    expect(focal is None or 0.5 <= focal <= 1e5, "a focal length that no lens has")
    for metres in (info.altitude_metres, info.relative_altitude_metres):
        expect(metres is None or abs(metres) <= 1e7, "a height beyond the air")


def vars_of(info: PhotoInfo) -> list[object]:
    return [getattr(info, name) for name in PhotoInfo.__dataclass_fields__]


def read_notes(path: Path) -> None:
    info = photo_info_of(path)
    expect_notes(info)
    photo_stamps([info, info])


def one_line(read: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return the reader, whose messages name the file."""

    def checked(path: Path) -> None:
        try:
            finite(read)(path)
        except InputError as error:
            expect(path.name in str(error), f"a reason that does not name the file: {error}")
            raise

    return checked


def read_points(path: Path) -> None:
    points = read_control_points(path)
    expect(bool((abs(points.places) <= 1e7).all()), "a control point beyond any floor")


_TRACKS: Sequence[bytes] = (
    sentences(*SENTENCES),
    sentences(*SENTENCES[1:3]),
    sentences(SENTENCES[0]),
)
FORMATS = {
    "nmea": Format(".nmea", these(*_TRACKS), one_line(read_gps), (InputError,), with_checksums),
    "gpx": Format(".gpx", these(GPX), one_line(read_gps), (InputError,)),
    "control": Format(".csv", these(*CONTROL), one_line(read_points), (InputError,)),
    "notes": Format(".jpg", photos, read_notes, (FrameError,)),
}

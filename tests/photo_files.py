"""Photos for tests, with the notes of a drone's camera in EXIF and XMP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>'
)


def exif_of(
    *,
    time: str = "",
    subseconds: str = "",
    zone: str = "",
    place: tuple[float, float, float] | None = None,
    focal_35mm: int = 0,
    orientation: int = 1,
) -> Image.Exif:
    """Return the EXIF block of a photo; a place is latitude, longitude and altitude."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    found: dict[int, Any] = exif.get_ifd(0x8769)
    texts = {0x9003: time, 0x9291: subseconds, 0x9011: zone}
    found |= {tag: text for tag, text in texts.items() if text}
    if focal_35mm:
        found[0xA405] = focal_35mm
    if place is not None:
        gps: dict[int, Any] = exif.get_ifd(0x8825)
        gps |= {1: "N" if place[0] >= 0 else "S", 2: _sexagesimal(place[0])}
        gps |= {3: "E" if place[1] >= 0 else "W", 4: _sexagesimal(place[1])}
        gps |= {5: b"\0", 6: place[2]}
    return exif


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    whole = int(abs(degrees))
    minutes = int((abs(degrees) - whole) * 60.0)
    return float(whole), float(minutes), (abs(degrees) - whole - minutes / 60.0) * 3600.0


def write_photo(
    path: Path, picture: np.ndarray, exif: Image.Exif, dji: dict[str, str] | None = None
) -> Path:
    """Write a BGR picture as the suffix says, with DJI's attributes if there are any."""
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in (dji or {}).items())
    more = {"xmp": XMP.format(attributes=attributes).encode()} if dji else {}
    image = Image.fromarray(np.ascontiguousarray(picture[..., ::-1]))
    image.save(path, exif=exif, quality=95, **more)
    return path

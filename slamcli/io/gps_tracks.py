"""GPS tracks as receivers and phones write them: NMEA 0183 sentences, and GPX."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from xml.etree import ElementTree as ET

from slamcli.core.errors import InputError
from slamcli.core.telemetry import GPS_SIGMA_METRES, GpsReading

_SENTENCE = re.compile(r"\$(G[A-Z])(RMC|GGA),([^*\r\n]{0,200})\*([0-9A-Fa-f]{2})")
_CLOCK = re.compile(r"(\d\d)(\d\d)(\d\d)(?:\.(\d{1,9}))?")
_DATE = re.compile(r"(\d\d)(\d\d)(\d\d)")
_ANGLE = re.compile(r"(\d{1,3})(\d\d\.\d{1,12}|\d\d)")
_DECIMAL = r"\d{1,4}(?:\.\d{1,6})?"
# Two digits of the year from here on are of the last century.
_FIRST_YEAR = 70
# The date of a track that has none.
_NO_DATE = (1, 1, 70)
# Of a receiver with the best constellation: its error is about that times the dilution.
_SIGMA_PER_DILUTION = GPS_SIGMA_METRES


def is_track(text: str) -> bool:
    """Return whether a text is GPX or has sentences of NMEA."""
    start = text[:2000].lstrip("\ufeff \t\r\n")
    return start.startswith(("<", "$")) or _SENTENCE.search(start) is not None


def read_track(path: Path, text: str) -> list[GpsReading]:
    """Return the places of a track, in the order of time.

    Raises
    ------
    InputError
        When there is none, or the file is damaged.
    """
    gpx = text.lstrip("\ufeff \t\r\n").startswith("<")
    found = sorted(_of_gpx(path, text) if gpx else _of_nmea(text), key=lambda one: one.stamp)
    if not found:
        raise InputError(f"{path} has no places with a time in it")
    return found


def _of_gpx(path: Path, text: str) -> Iterator[GpsReading]:
    """Yield the track points that have a time."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path} declares entities, which no GPX needs: it is not read")
    try:
        root = ET.fromstring(text.lstrip("\ufeff \t\r\n"))
        for point in root.iter():
            if point.tag.rpartition("}")[2] not in {"trkpt", "rtept", "wpt"}:
                continue
            fields = {child.tag.rpartition("}")[2]: child.text or "" for child in point}
            if "time" not in fields:
                continue
            moment = datetime.fromisoformat(fields["time"].strip())
            moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            dilution = float(fields.get("hdop") or 1.0)
            place = float(point.get("lat", "nan")), float(point.get("lon", "nan"))
            yield GpsReading(moment.timestamp(), *place, _sigma(dilution))
    except (ET.ParseError, InputError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is no sound GPX: {' '.join(str(error).split())}") from error


def _of_nmea(text: str) -> Iterator[GpsReading]:
    """Yield the places of sentences with a right checksum and a fix.

    GGA has the quality of the fix, RMC the date: where there are both, places are those of GGA.
    """
    date, qualified = _NO_DATE, "GGA," in text
    for talker, kind, body, checksum in _SENTENCE.findall(text):
        if reduce(xor, f"{talker}{kind},{body}".encode()) != int(checksum, 16):
            continue
        fields = body.split(",")
        day = _DATE.fullmatch(fields[8]) if kind == "RMC" and len(fields) > 8 else None
        if day is not None:
            date = int(day[1]), int(day[2]), int(day[3])
        if kind == "GGA" and len(fields) > 7 and fields[5] not in {"", "0"}:
            dilution = float(fields[7]) if re.fullmatch(_DECIMAL, fields[7]) else 1.0
            reading = _reading(date, fields[0], fields[1:5], _sigma(dilution))
        elif kind == "RMC" and not qualified and len(fields) > 8 and fields[1] == "A":
            reading = _reading(date, fields[0], fields[2:6], GPS_SIGMA_METRES)
        else:
            continue
        if reading is not None:
            yield reading


def _reading(
    date: tuple[int, int, int], clock: str, place: list[str], sigma: float
) -> GpsReading | None:
    """Return a place; None for fields that are not of the form."""
    time = _CLOCK.fullmatch(clock)
    latitude, longitude = _degrees(place[0], place[1], "NS"), _degrees(place[2], place[3], "EW")
    if time is None or latitude is None or longitude is None:
        return None
    day, month, year = date
    year += 1900 if year >= _FIRST_YEAR else 2000
    try:
        hour, minute, second = int(time[1]), int(time[2]), int(time[3])
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        part = float(f"0.{time[4]}") if time[4] else 0.0
        return GpsReading(moment.timestamp() + part, latitude, longitude, sigma)
    except (ValueError, InputError):
        return None


def _degrees(text: str, side: str, sides: str) -> float | None:
    """Return the degrees of ``4916.45`` and ``N``: 49 degrees, 16.45 minutes north.

    The second of the two sides is negative; None for another, or for 60 minutes and more.
    """
    match = _ANGLE.fullmatch(text)
    minutes = 60.0 if match is None else float(match[2])
    if match is None or minutes >= 60.0 or side not in tuple(sides):
        return None
    degrees = int(match[1]) + minutes / 60.0
    return -degrees if side == sides[1] else degrees


def _sigma(dilution: float) -> float:
    """Return the sigma for a horizontal dilution of precision, metres."""
    usable = math.isfinite(dilution) and dilution > 0.0
    return _SIGMA_PER_DILUTION * dilution if usable else GPS_SIGMA_METRES

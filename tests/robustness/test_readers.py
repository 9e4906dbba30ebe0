"""Properties of the readers of tables, tracks, notes, configurations and states, of any bytes."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("hypothesis")
pytest.importorskip("PIL")

import run_formats
import sensor_formats
import table_formats
from fuzz import outcome_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamcli.io.telemetry import read_gps

BOUNDED = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
KINDS = table_formats.FORMATS | sensor_formats.FORMATS | run_formats.FORMATS
DEGREES = st.floats(-90.0, 90.0).map(lambda degrees: round(degrees, 7))


def reason_or_clean(name: str, data: bytes, folder: Path) -> None:
    outcome = outcome_of(KINDS[name], data, folder)
    assert outcome.kind in {"clean", "reason"}, outcome.text


@pytest.mark.parametrize("name", sorted(KINDS))
@BOUNDED
@given(rest=st.binary(max_size=200), share=st.floats(0, 1))
def test_any_end_is_read_or_a_reason(name: str, tmp_path: Path, rest: bytes, share: float) -> None:
    start = KINDS[name].corpus()[0]
    reason_or_clean(name, start[: int(share * len(start))] + rest, tmp_path)


@pytest.mark.parametrize("name", sorted(KINDS))
@BOUNDED
@given(place=st.floats(0, 1, exclude_max=True), text=st.text(max_size=6))
def test_any_text_within_is_read_or_a_reason(
    name: str, tmp_path: Path, place: float, text: str
) -> None:
    data = bytearray(KINDS[name].corpus()[-1])
    at = int(place * len(data))
    data[at : at + len(text)] = text.encode()
    reason_or_clean(name, KINDS[name].repair(bytes(data)), tmp_path)


def nmea(latitude: float, longitude: float) -> bytes:
    """Return a sentence with a place."""
    words = []
    for degrees, sides, width in ((latitude, "NS", 2), (longitude, "EW", 3)):
        whole, minutes = divmod(round(abs(degrees) * 60e7), 60 * 10**7)
        side = sides[degrees < 0]
        words.append(f"{whole:0{width}d}{minutes // 10**7:02d}.{minutes % 10**7:07d},{side}")
    return sensor_formats.sentences(f"GPGGA,030405.00,{','.join(words)},1,08,0.9".encode())


@BOUNDED
@given(latitude=DEGREES, longitude=DEGREES)
def test_a_place_in_a_track_is_read_as_it_was_written(
    tmp_path: Path, latitude: float, longitude: float
) -> None:
    gpx = (
        f'<gpx><trkpt lat="{latitude!r}" lon="{longitude!r}">'
        "<time>2026-01-02T03:04:05Z</time></trkpt></gpx>"
    )
    for name, data in (("a.nmea", nmea(latitude, longitude)), ("a.gpx", gpx.encode())):
        (tmp_path / name).write_bytes(data)
        (reading,) = read_gps(tmp_path / name)
        assert reading.latitude_degrees == pytest.approx(latitude, abs=1e-8)
        assert reading.longitude_degrees == pytest.approx(longitude, abs=1e-8)
        assert reading.stamp % 86400 == 3 * 3600 + 4 * 60 + 5


@pytest.mark.parametrize("place", ["4960.0,N", "4916.4,X", "4916.4,", "916.4,N"])
def test_a_latitude_of_another_form_is_no_place(tmp_path: Path, place: str) -> None:
    sentence = sensor_formats.sentences(f"GPGGA,030405,{place},00830.0,E,1,08,0.9".encode())
    good = nmea(1.0, 2.0)
    (tmp_path / "a.nmea").write_bytes(good + sentence)
    found = read_gps(tmp_path / "a.nmea")
    assert len(found) == (2 if place == "916.4,N" else 1)


def test_a_configuration_nested_too_deeply_is_one_line(tmp_path: Path) -> None:
    for name, text in (("config", b"a = " + 50_000 * b"["), ("config", 10_000 * b"k" + b" = 1")):
        outcome = outcome_of(KINDS[name], text, tmp_path)
        assert outcome.kind == "reason"
        assert len(outcome.text) < 400

"""Tables of readings as loggers write them, and tracks of NMEA and GPX."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import pytest

from slamcli.core.errors import InputError
from slamcli.io.telemetry import read_compass, read_gps, read_odometry
from slamcli.io.trajectories import read_trajectory

NOON = datetime(2024, 5, 6, 12, 0, 0, tzinfo=UTC).timestamp()


def written(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "readings.csv"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    "text",
    [
        "stamp,latitude,longitude\n1.5,52.25,13.5\n2.5,52.5,13.75\n",
        "stamp;latitude;longitude\n1,5;52,25;13,5\n2,5;52,5;13,75\n",
        "stamp\tlatitude\tlongitude\n1.5\t52.25\t13.5\n2.5\t52.5\t13.75\n",
        "\ufeffTime [s], Latitude (deg), Longitude (°)\r\n1.5,52.25,13.5\r\n2.5,52.5,13.75\r\n",
        "time_ms,lat,lon\n1500,52.25,13.5\n2500,52.5,13.75\n",
        "timestamp (ns),gps_lat,gps_lon\n1500000000,52.25,13.5\n2500000000,52.5,13.75\n",
        "# of a rover, by hand\n#stamp,lat,lon\n1.5,52.25,13.5\n2.5,52.5,13.75\n",
        "# of a rover, by hand\n\nstamp,lat,lon\n1.5,52.25,13.5\n2.5,52.5,13.75\n",
        "stamp lat  lon\n1.5 52.25  13.5\n2.5 52.5  13.75\n",
        "__time,/fix/altitude,/fix/latitude,/fix/longitude\n1.5,4,52.25,13.5\n2.5,4,52.5,13.75\n",
        "elapsed,gps.lat,gps.lon\n1.5,52.25,13.5\n2.5,52.5,13.75\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_separators_encodings_and_names_of_columns(
    tmp_path: Path, text: str, encoding: str
) -> None:
    if encoding == "utf-16":
        text = text.removeprefix("\ufeff")
    first, second = read_gps(written(tmp_path, text, encoding))
    assert (first.stamp, first.latitude_degrees, first.longitude_degrees) == (1.5, 52.25, 13.5)
    assert (second.stamp, second.latitude_degrees) == (2.5, 52.5)


@pytest.mark.parametrize(
    "stamps",
    [
        ("2024-05-06T12:00:00Z", "2024-05-06T12:00:00.250000+00:00"),
        ("2024-05-06 12:00:00", "2024-05-06 12:00:00.25"),
        ("2024-05-06T14:00:00+02:00", "2024-05-06T14:00:00.250+02:00"),
        (f"{NOON:.0f}", f"{NOON:.0f}.25"),
        (f"{NOON:.0f}000", f"{NOON:.0f}250"),
        (f"{NOON:.0f}000000", f"{NOON:.0f}250000"),
        (f"{NOON:.0f}000000000", f"{NOON:.0f}250000000"),
    ],
)
def test_times_are_read_whatever_they_are_written_in(
    tmp_path: Path, stamps: tuple[str, str]
) -> None:
    text = "field.header.stamp,heading\n" + "".join(f"{stamp},0.5\n" for stamp in stamps)
    readings = read_compass(written(tmp_path, text))
    assert [one.stamp for one in readings] == [NOON, NOON + 0.25]


@pytest.mark.parametrize("day", ["2024-05-06", "2024/05/06"])
def test_day_and_time_may_be_two_columns(tmp_path: Path, day: str) -> None:
    path = written(tmp_path, f"Date,Time,heading\n{day},12:00:00,0.5\n{day},12:00:00.25,0.5\n")
    assert [one.stamp for one in read_compass(path)] == [NOON, NOON + 0.25]
    (one,) = read_compass(written(tmp_path, f"time,heading\n{day} 12:00:00.25,0.5\n"))
    assert one.stamp == NOON + 0.25


def test_orientations_may_be_quaternions(tmp_path: Path) -> None:
    """As `rostopic echo -p` writes odometry."""
    half = math.radians(15.0)
    names = ("position.x", "position.y", "position.z", *(f"orientation.{a}" for a in "xyzw"))
    header = ",".join(["%time", "field.header.stamp", *(f"field.pose.pose.{n}" for n in names)])
    row = f"5,1700000000250000000,1.5,-2.5,0,0,0,{math.sin(half)},{math.cos(half)}"
    (one,) = read_odometry(written(tmp_path, f"{header}\n{row}\n"))
    assert one.stamp == 1_700_000_000.25
    assert (one.pose.x, one.pose.y, one.pose.theta) == pytest.approx((1.5, -2.5, 2 * half))


@pytest.mark.parametrize(
    ("header", "row"),
    [
        # A simulation under ROS 1, whose clock begins at 0.
        (
            "%time,field.header.stamp,field.pose.pose.position.x,field.pose.pose.position.y,"
            "field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
            "field.pose.pose.orientation.z,field.pose.pose.orientation.w",
            "2250000000,2250000000,1.5,-2.5,0,0,0,1",
        ),
        # PlotJuggler.
        (
            "__time,/odom/pose/pose/position/x,/odom/pose/pose/position/y,"
            "/odom/pose/pose/orientation/x,/odom/pose/pose/orientation/y,"
            "/odom/pose/pose/orientation/z,/odom/pose/pose/orientation/w,/odom/twist/linear/x",
            "2.25,1.5,-2.5,0,0,0,1,9",
        ),
        # Messages as tables.
        ("header.stamp.sec,header.stamp.nanosec,pose.x,pose.y,yaw", "2,250000000,1.5,-2.5,0"),
        (",timestamp,pose_x,pose_y,theta", "0,2.25,1.5,-2.5,0"),
        ("t;x_mm;y_mm;yaw_deg", "2,25;1500,0;-2500,0;0"),
        ("t,x [cm],y [cm],yaw [rad]", "2.25,150,-250,0"),
        ("time,x_m,y_m,heading_degrees", "2.25,1.5,-2.5,0"),
        (
            "__time,/odom/pose/pose/position/x,/odom/pose/pose/position/y,"
            "/odom/pose/pose/orientation/yaw,/imu/orientation/yaw",
            "2.25,1.5,-2.5,0,3",
        ),
        ("#stamp,x,y,theta", "2.25,1.5,-2.5,0"),
        ("t x y yaw", "2.25 1.5 -2.5 0"),
    ],
)
def test_odometry_is_read_as_loggers_write_it(tmp_path: Path, header: str, row: str) -> None:
    (one,) = read_odometry(written(tmp_path, f"{header}\n{row}\n"))
    assert one.stamp == 2.25
    assert (one.pose.x, one.pose.y, one.pose.theta) == pytest.approx((1.5, -2.5, 0.0))


def test_columns_of_several_topics_are_named(tmp_path: Path) -> None:
    names = [f"/{topic}/pose/pose/position/{axis}" for topic in ("odom", "ekf") for axis in "xy"]
    text = ",".join(["__time", *names, "yaw"]) + "\n1,2,3,4,5,6\n"
    with pytest.raises(InputError, match=r"several columns x: odom\.pose\.pose\.position\.x, ekf"):
        read_odometry(written(tmp_path, text))


@pytest.mark.parametrize("word", ["yesterday", "1e400", "nan", "", "1e999999999", "2024-13-01"])
def test_what_is_no_time_is_named_with_its_line(tmp_path: Path, word: str) -> None:
    with pytest.raises(InputError, match=r"line 3: stamp is .*2024-05-06T12:00:00Z is needed$"):
        read_compass(written(tmp_path, f"stamp,heading\n1,0\n{word},0\n"))


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no column stamp; its header is x_mm, heading"):
        read_compass(written(tmp_path, "x [mm];heading\n1;2\n"))
    assert read_trajectory(written(tmp_path, "x,y,heading\n1,2,3\n")).stamps is None


def nmea(body: str) -> str:
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n"


RMC = "GNRMC,120000.25,A,4916.4500,N,12311.1200,W,0.5,054.7,060524,020.3,E"
GGA = "GPGGA,120000.25,4916.4500,N,12311.1200,W,4,08,0.5,545.4,M,46.9,M,,"


@pytest.mark.parametrize(("sentences", "sigma"), [((RMC, GGA), 1.5), ((RMC,), 3.0)])
def test_sentences_of_nmea_are_places(
    tmp_path: Path, sentences: tuple[str, ...], sigma: float
) -> None:
    text = "".join(map(nmea, sentences))
    bad = nmea(RMC).replace("4916", "4917") + nmea(RMC.replace(",A,", ",V,")) + "$GPRMC,,,\n"
    (one,) = read_gps(written(tmp_path, text + bad))
    assert one.stamp == NOON + 0.25
    assert one.latitude_degrees == pytest.approx(49.2741667)
    assert one.longitude_degrees == pytest.approx(-123.1853333)
    assert one.sigma_metres == sigma


def test_a_gpx_track_is_places(tmp_path: Path) -> None:
    points = "".join(
        f'<trkpt lat="52.{n}" lon="13.5"><ele>3</ele><time>2024-05-06T12:00:0{n}Z</time></trkpt>'
        for n in (2, 1)
    )
    text = (
        '<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
        f'{points}<trkpt lat="1" lon="2"/></trkseg></trk></gpx>'
    )
    first, second = read_gps(written(tmp_path, text))
    assert (first.stamp, first.latitude_degrees) == (NOON + 1, 52.1)
    assert (second.stamp, second.longitude_degrees) == (NOON + 2, 13.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<gpx><trk>", "no sound GPX"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><gpx/>', "declares entities"),
        ("<gpx/>", "no places with a time"),
        ('<gpx><trkpt lat="x" lon="1"><time>2024-05-06</time></trkpt></gpx>', "no sound GPX"),
        ("$GPGGA,,,\n", "no places with a time"),
    ],
)
def test_a_damaged_track_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_gps(written(tmp_path, text))

"""Tables, calibrations, maps and layouts for the fuzzer: good files, and what reads them."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from fuzz import Format, SilentlyWrongError
from worlds import make_photographer, take

from slamcli.core.config import MapperOptions
from slamcli.core.errors import CalibrationError, InputError, MapError
from slamcli.core.geometry import Pose2
from slamcli.io.calibrations import calibration_text, load_calibration, load_intrinsics, load_origin
from slamcli.io.map_file import load_map, save_map
from slamcli.io.sequences import sequence_of
from slamcli.io.telemetry import read_compass, read_gps, read_odometry
from slamcli.io.trajectories import read_trajectory
from slamcli.mapping.localizer import Locator
from slamcli.mapping.mapper import Mapper
from slamcli.run.layouts import read_layout

TUM = b"# stamp x y z qx qy qz qw\n0 0.1 0.2 0 0 0 0 1\n1 0.2 0.2 0 0 0 0.7071068 0.7071068\n"
KITTI = b"1 0 0 0.1 0 1 0 0.2 0 0 1 0\n0 -1 0 0.3 1 0 0 0.4 0 0 1 0\n"
POSES = (
    b"index,frame,stamp,status,reason,fragment,x,y,heading,sigma_x,sigma_y,sigma_heading\n"
    b"0,a.png,0.0,tracked,,0,0.1,0.2,0.3,1e-3,1e-3,1e-4\n1,b.png,0.1,lost,dark,,,,,,,\n"
)
ODOMETRY = b"stamp,x,y,heading\n0.0,0.0,0.0,0.0\n0.1,0.01,0.0,0.1\n0.2,0.02,1e-3,0.2\n"
COMPASS = (
    b"stamp,heading,sigma\n0,0.1,0.05\n1,0.2,0.05\n",
    b"time,bearing_degrees,sigma_degrees\n0,90,3\n1,91,3\n",
)
GPS = (
    b"stamp,latitude,longitude,sigma\n0,29.64,-82.35,1.0\n1,29.65,-82.36,1.0\n",
    b"\xef\xbb\xbft,lat,lon\n0,29.64,-82.35\n1,29.65,-82.36\n",
)
HD_GROUND = (
    b"seq/0.png 1 0 10 0 1 20 0 0 1\nseq/1.png, 0, -1, 3, 1, 0, 4, 0, 0, 1\n"
    b"seq/2.png * 1 0 5 0 1 6 0 0 1\n"
)
SEQUENCES = (
    b"# stamp path\n0.100000 0.png\n0.200000 1.png\n",
    b"0.png\n1.png\n",
    HD_GROUND.replace(b"seq/2", b"seq/1"),
)
CAMERA_INFO = (
    b"image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    b"  data: [600.0, 0.0, 319.5, 0.0, 601.0, 239.5, 0.0, 0.0, 1.0]\ndistortion_model: plumb_bob\n"
    b"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.2, 3e-1, 0.001, -1E-3, 0]\n",
    b"header:\n  stamp:\n    sec: 12\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\n"
    b"d: [-0.2, 0.3, 0.001, -0.001, 0.0]\n"
    b"k: [600.0, 0.0, 319.5, 0.0, 601.0, 239.5, 0.0, 0.0, 1.0]\n"
    b"binning_x: 0\nroi:\n  x_offset: 0\n  width: 0\n---\n",
    b"%YAML:1.0\n---\nimage_Width: 640\nimage_Height: 480\nCamera_Matrix: !!opencv-matrix\n"
    b"   rows: 3\n   cols: 3\n   dt: d\n   data: [ 600., 0., 319.5, 0., 601., 239.5, 0., 0., 1. ]\n"
    b"Distortion_Coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
    b"   data: [ -0.2, 0.3, 0.001, -0.001, 0. ]\n",
)
LAYOUT = (
    b"board_metres = [2.0, 1.0]\nline_metres = 0.02\nsquare_metres = 0.05\n"
    b"lines = [[[0.1, 0.1], [1.0, 0.1]]]\nsquares = [[0.5, 0.5]]\n"
)


def calibrations() -> list[bytes]:
    return [calibration_text(make_photographer().calibration).encode()]


@cache
def drive() -> tuple[list[np.ndarray], bytes]:
    """Return pictures, and the map file made of them."""
    world = make_photographer()
    pictures = [take(world, Pose2(0.03 * k, 0.0, 0.0)) for k in range(3)]
    mapper = Mapper(world.calibration, MapperOptions(dense=False))
    for picture in pictures:
        mapper.update(picture)
    mapper.finish()
    floor_map = mapper.floor_map()
    assert floor_map is not None
    with tempfile.TemporaryDirectory() as folder:
        save_map(Path(folder) / "map.slam", floor_map)
        return pictures, (Path(folder) / "map.slam").read_bytes()


def with_map_checksum(data: bytes) -> bytes:
    start = data.find(b"\n") + 1
    body = data[start + 32 :]
    return data[:start] + hashlib.sha256(body).digest() + body


def read_calibration(path: Path) -> None:
    calibration = load_calibration(path)
    load_origin(path)
    load_intrinsics(path)
    if not np.isfinite(calibration.robot_from_image).all():
        raise SilentlyWrongError("a homography that is not finite")


def read_map(path: Path) -> None:
    """Load a map and locate in it, which never raises."""
    estimate = Locator(load_map(path)).locate(drive()[0][1])
    if estimate.map_from_robot is None and not estimate.reason:
        raise SilentlyWrongError("lost without a reason")


def read_list(path: Path) -> None:
    """List the pictures of a text file."""
    for folder in (path.parent, path.parent / "seq"):
        folder.mkdir(exist_ok=True)
        for number in range(2):
            (folder / f"{number}.png").touch()
    sequence = sequence_of(path)
    if sequence is None or not all(one.path.is_file() for one in sequence):
        raise SilentlyWrongError("no list of pictures")
    if not all(one.stamp is None or np.isfinite(one.stamp) for one in sequence):
        raise SilentlyWrongError("a stamp that is not finite")


def finite(read: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return the reader, which also holds that numbers are finite and within bounds."""

    def checked(path: Path) -> None:
        found = read(path)
        readings = found if isinstance(found, list) else []
        stamps = [reading.stamp for reading in readings]
        if stamps != sorted(stamps):
            raise SilentlyWrongError("stamps out of order")
        poses = getattr(found, "poses", np.zeros((0, 3)))
        if not (np.abs(poses[:, :2]) <= 1e7).all() or not np.isfinite(poses).all():
            raise SilentlyWrongError("a pose beyond any floor")

    return checked


def read_lens(path: Path) -> None:
    found = load_intrinsics(path)
    if not np.isfinite(found.camera_matrix).all() or not np.isfinite(found.distortion).all():
        raise SilentlyWrongError("a lens that is not finite")


def these(*files: bytes) -> Callable[[], Sequence[bytes]]:
    return lambda: files


FORMATS = {
    "calibration": Format(".yaml", calibrations, read_calibration, (CalibrationError,)),
    "camera_info": Format(".yaml", these(*CAMERA_INFO), read_lens, (CalibrationError,)),
    "poses": Format(
        ".csv", these(POSES, TUM, KITTI, HD_GROUND), finite(read_trajectory), (InputError,)
    ),
    "sequence": Format(".txt", these(*SEQUENCES), read_list, (InputError,)),
    "odometry": Format(".csv", these(ODOMETRY, TUM), finite(read_odometry), (InputError,)),
    "compass": Format(".csv", these(*COMPASS), finite(read_compass), (InputError,)),
    "gps": Format(".csv", these(*GPS), finite(read_gps), (InputError,)),
    "layout": Format(".toml", these(LAYOUT), finite(read_layout), (InputError,)),
    "map": Format(
        ".slam",
        lambda: [drive()[1]],
        read_map,
        (MapError, CalibrationError, InputError),
        with_map_checksum,
    ),
}

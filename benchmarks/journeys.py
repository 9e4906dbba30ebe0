"""Five journeys, each by the one command that a user types first, from files of public tools.

Run: python benchmarks/journeys.py [--frames N] [--transcripts] [--only NAME] [--keep FOLDER]. A
drive around a loop over asphalt is given as a phone's video (H.264, stored on its side, turned by
its metadata), a ROS 2 bag and a ROS 1 bag of four topics (by rosbags), and a live stream on this
machine; a flight as a drone's photos with EXIF GPS and DJI's XMP. Printed is what each command
took, how many frames it placed, and the error against the truth (ATE). It exits with 1 where a
frame is not placed or the error is above what the journey allows.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from drives import Drive, make_drive
from numpy.typing import NDArray

# The makers of the files are those of the tests.
sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from bag_files import START, BagWriter
from flights import FOCAL, SIZE, floor_picture, nadir_states, photographs
from live_stream import free_port, stream
from photo_files import exif_of, write_photo
from video_files import write_video

from slamcli.core.camera.calibration import Rocking
from slamcli.core.geometry import Pose2
from slamcli.simulation.config import SimulationOptions
from slamcli.stages.geodesy import LocalPlane
from slamcli.survey.ground import below_camera

RATE = 20.0
# A drone over a field: metres to a pixel of its floor, and where it is.
METRES, DATUM, GPS_METRES = 0.05, (47.3, 8.5), 0.1


@dataclass(frozen=True)
class Journey:
    """One user's first command.

    Attributes
    ----------
    words : list of str
        Of the command, from its name on.
    truth : list of (float, Pose2)
        Poses with their stamps; those of photos, which have none, in their order.
    max_ate_metres : float
    """

    words: list[str]
    truth: list[tuple[float, Pose2]]
    max_ate_metres: float


@dataclass(frozen=True)
class Outcome:
    """What a command took, printed and made."""

    seconds: float
    printed: str
    frames: int
    placed: int
    ate_metres: float


def drive_of(frames: int) -> Drive:
    """Return the drive: a loop of 2.5 cm a frame."""
    return make_drive(
        SimulationOptions(
            floor="asphalt", length_metres=0.025 * frames, frames=frames, frame_rate_hertz=RATE
        )
    )


def pictures_of(drive: Drive) -> list[NDArray[np.uint8]]:
    """Return all frames of a drive."""
    return [drive.image(index) for index in range(len(drive.truth))]


def truth_of(drive: Drive, start: float = 0.0) -> list[tuple[float, Pose2]]:
    """Return a drive's poses with the stamps that its file has."""
    return [(start + index / RATE, pose) for index, pose in enumerate(drive.truth)]


def video(drive: Drive, folder: Path) -> Journey:
    """Return the journey of a maker who films the floor with a phone."""
    stored = [np.rot90(picture, -1) for picture in pictures_of(drive)]
    path = folder / "floor.mp4"
    write_video(
        path, stored, codec="libx264", pixels="yuv420p", rate=int(RATE), turn_degrees=90,
        keyframe_every=30,
    )  # fmt: skip
    words = ["stitch", str(path), "-c", str(drive.folder / "camera.yaml")]
    return Journey(words, truth_of(drive), 0.002)


def bag(drive: Drive, path: Path) -> None:
    """Write a bag of pictures, the lens, odometry and a compass."""
    readings = {round(one.stamp * RATE): one for one in drive.odometry}
    focal = float(drive.calibration.camera_matrix[0, 0])
    with BagWriter(path) as one:
        one.lens("/camera/camera_info", drive.calibration.image_size, focal)
        for index, picture in enumerate(pictures_of(drive)):
            seconds = index / RATE
            data = cv2.imencode(".png", picture)[1].tobytes()
            one.compressed("/camera/image_raw/compressed", seconds, data)
            pose = readings[index].pose
            one.odometry("/odom", seconds, pose.x, pose.y, pose.theta)
            one.imu(seconds, drive.truth[index].theta)


def ros2(drive: Drive, folder: Path) -> Journey:
    """Return the journey of a student who has recorded a robot with ROS 2."""
    path = folder / "lab_mcap"
    bag(drive, path)
    words = ["stitch", str(path), "-c", str(drive.folder / "camera.yaml")]
    return Journey(words, truth_of(drive, START), 0.001)


def ros1(drive: Drive, folder: Path) -> Journey:
    """Return the journey of an engineer with a vehicle's bag of ROS 1 and wheel odometry."""
    path = folder / "shift.bag"
    bag(drive, path)
    words = ["stitch", str(path), "-c", str(drive.folder / "camera.yaml"), "--odometry", str(path)]
    return Journey(words, truth_of(drive, START), 0.001)


def drone(_: Drive, folder: Path) -> Journey:
    """Return the journey of a mapper who comes back with a drone's photos."""
    (folder / "photos").mkdir()
    generator, plane = np.random.default_rng(1), LocalPlane(DATUM)
    states = nadir_states(4, 5, generator)
    earth_from_map = Pose2(12.0, -7.0, 0.7)
    focal_35mm = round(FOCAL * math.hypot(36.0, 24.0) / math.hypot(*SIZE))
    truth = []
    for number, picture in enumerate(photographs(floor_picture(), states)):
        x, y, heading, log_scale, pitch, roll = states[number].tolist()
        rocking = Rocking(pitch, roll, FOCAL * (math.exp(log_scale) - 1.0))
        below = below_camera(Pose2(x, y, heading), rocking, FOCAL)
        place = earth_from_map.apply(METRES * np.array([below]))
        latitude, longitude = plane.geodetic(place + generator.normal(0.0, GPS_METRES, 2))[0]
        exif = exif_of(
            time=f"2024:05:06 12:00:{number:02}",
            place=(latitude, longitude, 400.0),
            focal_35mm=focal_35mm,
        )
        dji = {
            "RelativeAltitude": f"{METRES * FOCAL * math.exp(log_scale):+.2f}",
            "GimbalPitchDegree": "-90.0",
        }
        write_photo(folder / "photos" / f"DJI_{number:04}.jpg", np.dstack([picture] * 3), exif, dji)
        truth.append((float(number), Pose2(METRES * x, METRES * y, heading)))
    words = ["stitch", str(folder / "photos"), "--crs", "auto", "--format", "geotiff"]
    return Journey(words, truth, 0.1)


def live(drive: Drive, _: Path) -> Journey:
    """Return the journey of a robot whose camera another program of this machine streams."""
    words = ["live", "{stream}", "-c", str(drive.folder / "camera.yaml")]
    return Journey([*words, "--no-browser"], truth_of(drive), 0.002)


JOURNEYS = {"video": video, "ros2": ros2, "ros1": ros1, "drone": drone, "live": live}


@contextmanager
def words_of(journey: Journey, drive: Drive) -> Iterator[list[str]]:
    """Yield the command's words; a stream runs meanwhile where one is needed."""
    if "{stream}" not in journey.words:
        yield journey.words
        return
    port = free_port()
    with stream(pictures_of(drive), port) as address:
        words = [address if word == "{stream}" else word for word in journey.words]
        yield [*words, "--port", str(port)]


def run(journey: Journey, drive: Drive, folder: Path) -> Outcome:
    """Type a journey's command, and compare the poses with the truth."""
    output = folder / "map"
    with words_of(journey, drive) as words:
        began = time.monotonic()
        command = [sys.executable, "-m", "slamcli", *words, "-o", str(output)]
        done = subprocess.run(
            command, check=False, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        seconds = time.monotonic() - began
    printed = f"$ {' '.join(['slam', *words])}\n{done.stdout}-> {done.returncode}\n"
    if not (output / "poses.csv").exists():
        return Outcome(seconds, printed, 0, 0, math.nan)
    with (output / "poses.csv").open(newline="") as rows:
        poses = list(csv.DictReader(rows))
    placed = sum(row["status"] != "lost" for row in poses)
    ate = ate_metres(output / "poses.csv", poses, journey.truth, folder)
    return Outcome(seconds, printed, len(poses), placed, ate)


def ate_metres(
    path: Path,
    poses: Sequence[dict[str, str]],
    truth: Sequence[tuple[float, Pose2]],
    folder: Path,
) -> float:
    """Return the root mean square error of poses, by `slam evaluate`.

    Frames whose stamps are not the truth's own (of a live stream, or of photos) are in its order.
    """
    first = float(poses[0]["stamp"] or -1.0)
    own = truth[0][0] - 1e-3 <= first <= truth[-1][0] + 1e-3
    with (folder / "truth.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("stamp", "frame", "x", "y", "heading"))
        for number, (stamp, pose) in enumerate(truth):
            if own:
                writer.writerow((repr(stamp), "", pose.x, pose.y, pose.theta))
            elif number < len(poses):
                name = poses[number]["frame"]
                writer.writerow(("", name, pose.x, pose.y, pose.theta))
    command = [sys.executable, "-m", "slamcli", "evaluate", str(path), str(folder / "truth.csv")]
    done = subprocess.run([*command, "--json"], check=False, capture_output=True, text=True)
    if done.returncode:
        print(done.stderr)
        return math.nan
    return float(json.loads(done.stdout)["whole"]["absolute"]["rmse"])


def main() -> int:
    """Take the journeys; return 1 where one of them fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=240, help="of the drive")
    parser.add_argument("--only", choices=JOURNEYS, help="one journey")
    parser.add_argument("--transcripts", action="store_true", help="print what was printed")
    parser.add_argument("--keep", type=Path, help="folder for all files")
    arguments = parser.parse_args()
    drive, failed = drive_of(arguments.frames), False
    with tempfile.TemporaryDirectory() as scratch:
        for name, make in JOURNEYS.items():
            if arguments.only not in {None, name}:
                continue
            folder = (arguments.keep or Path(scratch)) / name
            folder.mkdir(parents=True)
            journey = make(drive, folder)
            outcome = run(journey, drive, folder)
            good = (
                0 < outcome.frames == outcome.placed
                and outcome.ate_metres <= journey.max_ate_metres
            )
            failed |= not good
            print(
                f"{name}: {outcome.seconds:.1f} s, {outcome.placed} of {outcome.frames} placed, "
                f"ATE {1000.0 * outcome.ate_metres:.3f} mm{'' if good else ': FAILED'}",
                flush=True,
            )
            if arguments.transcripts:
                print(outcome.printed, flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

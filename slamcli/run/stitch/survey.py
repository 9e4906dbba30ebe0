"""Frames without a calibration as a survey: a camera whose height and tilt vary over a plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking, top_down_calibration
from slamcli.core.camera.mounting import rocked
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import FloorMap, Link, PoseEstimate
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.images.canvas import canvas_scale, common_canvas
from slamcli.io.toml import Scalar
from slamcli.run.session.session import Session
from slamcli.run.stitch.drive import Drive, SurveyFacts
from slamcli.run.stitch.focal_length import noted_focal_pixels
from slamcli.run.stitch.lost_in_survey import lost_reason
from slamcli.selfcal import RegisteredDrive
from slamcli.survey import Survey, SurveyFeatures, SurveyMap, survey, survey_features
from slamcli.survey.bundle import Lens, covariances
from slamcli.survey.oblique import floor_motion
from slamcli.survey.pairs import Pair, find_pair, fit_similarity
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL

# Nominal focal length without a better source, in widths of the picture: between a phone's and a
# drone's. A camera that looks straight down needs no better one.
_FOCAL_WIDTHS = 1.2
# Two frames in sequence whose scales differ by more than this share, or whose matches leave a rigid
# motion by more than this share of the picture, are not of a rigid top-down mount.
_RIGID_SCALE, _RIGID_SHARE, _PROBES = 0.004, 0.0015, 3


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """A frame's features, or why it has none, and the digest of its file."""

    features: SurveyFeatures | None
    reason: str = ""
    digest: bytes = b""


@dataclass(frozen=True, slots=True, eq=False)
class SurveyedDrive:
    """A drive located as a survey.

    Attributes
    ----------
    registered : RegisteredDrive
    files : list of FrameFile
        All of them, brought to the common canvas.
    facts : SurveyFacts
    """

    registered: RegisteredDrive
    files: list[FrameFile]
    facts: SurveyFacts


def may_be_survey(drive: Drive) -> bool:
    """Return whether frames may be located as a survey: no calibration, sensor or earlier map."""
    options = drive.options
    return (
        drive.inputs.calibration_path is None
        and options.extend is None
        and options.self_calibrate != "always"
        and not drive.telemetry_files.any
        and options.mount != "rigid"
    )


def describe_file(file: FrameFile) -> Described:
    """Return a frame's features."""
    try:
        frame = read_frame(file, gray=True)
    except FrameError as error:
        return Described(None, str(error))
    return Described(survey_features(frame.image, frame.mask), digest=frame.digest)


@dataclass(frozen=True, slots=True)
class Probe:
    """What some pairs of consecutive frames show.

    Attributes
    ----------
    free : bool
        Whether one contradicts a rigid top-down mount.
    apart : bool
        Whether most show a floor, and above it something else that moves differently.
    """

    free: bool
    apart: bool


def probe(files: Sequence[FrameFile], session: Session) -> Probe:
    """Compare some consecutive frames."""
    starts = np.unique(np.linspace(0, len(files) - 2, _PROBES).round().astype(int)).tolist()
    pairs = [(files[number], files[number + 1]) for number in starts if number >= 0]
    found = [one for one in session.ordered(_probe, pairs) if one is not None]
    apart = sum(one.apart for one in found)
    return Probe(any(one.free for one in found), 2 * apart > max(2, len(found)))


def _probe(files: tuple[FrameFile, FrameFile]) -> Probe | None:
    first, second = (describe_file(file).features for file in files)
    if first is None or second is None:
        return None
    motion = floor_motion(first, second)
    free = _is_free(find_pair(0, 1, first, second))
    return Probe(free, motion is not None and motion.apart)


def _is_free(pair: Pair) -> bool:
    if pair.reason:
        return False
    similarity = fit_similarity(pair.pixels_b, pair.pixels_a)
    scale = math.hypot(similarity[0, 0], similarity[1, 0])
    residual = np.linalg.norm(apply_homography(similarity, pair.pixels_b) - pair.pixels_a, axis=1)
    side = 2.0 * float(np.abs(pair.pixels_a).max())
    return abs(math.log(scale)) > _RIGID_SCALE or float(np.median(residual)) > _RIGID_SHARE * side


def locate_survey(
    files: Sequence[FrameFile], described: Sequence[Described], drive: Drive, session: Session
) -> SurveyedDrive:
    """Return the drive located as a survey.

    Parameters
    ----------
    described : sequence of Described
        Of the first files; the others were not reached.
    """
    sizes = [one.features.size for one in described if one.features is not None]
    canvas = common_canvas(sizes) if sizes else drive.inputs.calibration.image_size
    mixed = any(size != canvas for size in sizes)
    read = zip(files, described, strict=False)
    files = [
        *(replace(file, digest=one.digest, canvas=canvas if mixed else None) for file, one in read),
        *files[len(described) :],
    ]
    features = [_on_canvas(one, canvas) for one in described]
    radius = 0.5 * math.hypot(*canvas)
    found = survey(
        features,
        Lens(noted_focal_pixels(files, canvas) or _FOCAL_WIDTHS * max(canvas), 0.0, radius),
        partial(session.stage, "comparing frames"),
    )
    calibration = _camera(canvas, found)
    estimates, links = _records(found, files, described, calibration)
    placed = [one for one in estimates if one.map_from_robot is not None]
    floor_map = None
    if placed:
        options = drive.mapper.options
        floor_map = FloorMap(
            calibration,
            options.features,
            1.0,
            options.tilt_sigma_degrees,
            (),
            tuple(estimates),
            tuple(links),
        )
    registered = RegisteredDrive(calibration, estimates, links, frozenset(), floor_map)
    return SurveyedDrive(registered, files, SurveyFacts(_rows(found), _section(found)))


def _on_canvas(one: Described, canvas: tuple[int, int]) -> SurveyFeatures:
    """Return features in pixels of the canvas; none for a frame that cannot be used."""
    if one.features is None:
        return survey_features(np.zeros((canvas[1], canvas[0]), np.uint8))
    if one.features.size == canvas:
        return one.features
    scale = canvas_scale(one.features.size, canvas)
    size = round(scale * one.features.size[0]), round(scale * one.features.size[1])
    return replace(one.features, size=size, pixels=scale * one.features.pixels)


def _camera(canvas: tuple[int, int], found: Survey) -> Calibration:
    """Return the nominal camera of a survey, with the lens of its largest map."""
    camera = top_down_calibration(canvas)
    if not found.maps:
        return camera
    lens = found.maps[0].bundle.lens
    matrix = camera.camera_matrix.copy()
    matrix[0, 0] = matrix[1, 1] = lens.focal_pixels
    k1 = lens.bend * (lens.focal_pixels / lens.radius_pixels) ** 2
    return replace(camera, camera_matrix=matrix, distortion=np.array([k1, 0.0, 0.0, 0.0, 0.0]))


def _records(
    found: Survey,
    files: Sequence[FrameFile],
    described: Sequence[Described],
    calibration: Calibration,
) -> tuple[list[PoseEstimate], list[Link]]:
    """Return an estimate for every file that was reached, and the links between them."""
    estimates: dict[int, PoseEstimate] = {}
    links: list[Link] = []
    for fragment, one in enumerate(found.maps):
        placed = _placed(one, fragment, files, calibration)
        links += [_link(pair, placed, calibration, one) for pair in one.pairs]
        estimates |= placed
    for number, one_described in enumerate(described):
        if number not in estimates:
            file = files[number]
            reason = one_described.reason or lost_reason(
                number, found, files, one_described.features
            )
            estimates[number] = PoseEstimate(
                file.index, file.name, file.stamp, None, "lost", reason
            )
    return [estimates[number] for number in sorted(estimates)], links


def _placed(
    one: SurveyMap, fragment: int, files: Sequence[FrameFile], calibration: Calibration
) -> dict[int, PoseEstimate]:
    focal = float(calibration.camera_matrix[0, 0])
    spread = covariances(one.bundle, range(len(one.frames)), (0, 1, 2))
    found = {}
    for state, frame, in_map in zip(one.bundle.states, one.frames, spread, strict=True):
        file, pose = files[frame], Pose2(*state[:3].tolist())
        own = [pair for pair in one.pairs if frame in (pair.a, pair.b)]
        turn = np.eye(3)
        turn[:2, :2] = pose.matrix[:2, :2]
        found[frame] = PoseEstimate(
            file.index,
            file.name,
            file.stamp,
            pose,
            "tracked",
            fragment=fragment,
            covariance=turn.T @ in_map @ turn,
            inliers=max(pair.inliers for pair in own),
            score=min(1.0, max(pair.correlation for pair in own)),
            rocking=Rocking(
                float(state[PITCH]),
                float(state[ROLL]),
                focal * (math.exp(float(state[LOG_SCALE])) - 1.0),
            ),
        )
    return found


def _link(
    pair: Pair, placed: dict[int, PoseEstimate], calibration: Calibration, one: SurveyMap
) -> Link:
    """Return the motion that a pair measured, on the floor, by the tilt and height of both."""
    first, second = (_undistorted_centre(placed[n], calibration) for n in (pair.a, pair.b))
    plane = first @ pair.a_from_b @ invert(second)
    plane = plane / plane[2, 2]
    there = plane[:2, 2]
    turn = plane[:2, :2] - np.outer(there, plane[2, :2])
    heading = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    noise = one.bundle.noise_pixels**2 / max(1, len(pair.pixels_a))
    base = float(np.var(pair.pixels_a, axis=0).sum()) + 1.0
    return Link(
        placed[pair.a].index,
        placed[pair.b].index,
        Pose2(float(there[0]), float(there[1]), heading),
        np.diag([noise, noise, noise / base]),
        pair.inliers,
        min(1.0, pair.correlation),
        "step" if pair.b == pair.a + 1 else "loop",
    )


def _undistorted_centre(estimate: PoseEstimate, calibration: Calibration) -> Float64Array:
    """Return (3, 3): pixels from the picture's middle to the floor below a frame."""
    assert estimate.rocking is not None
    middle = np.eye(3)
    middle[:2, 2] = calibration.camera_matrix[:2, 2]
    return rocked(calibration, estimate.rocking).robot_from_image @ middle


def _rows(found: Survey) -> tuple[tuple[str, str], ...]:
    if not found.maps:
        return ()
    mount, lens = found.maps[0].bundle.mount, found.maps[0].bundle.lens
    text = (
        f"looks down with six degrees of freedom: tilt {math.degrees(mount.tilt_sigma):.2g}°, "
        f"height {mount.scale_sigma:.2g} of itself from frame to frame, "
        f"lens bends the corners by {lens.bend:.1%}"
    )
    rows = [("camera", text)]
    if found.contradicted:
        rows.append(("links off", f"{len(found.contradicted)}, contradicted by the others"))
    return tuple(rows)


def _section(found: Survey) -> dict[str, Scalar]:
    if not found.maps:
        return {}
    bundle = found.maps[0].bundle
    return {
        "tilt_sigma_degrees": math.degrees(bundle.mount.tilt_sigma),
        "scale_sigma": bundle.mount.scale_sigma,
        "bend": bundle.lens.bend,
        "median_pair_pixels": float(np.median(bundle.pair_pixels)),
        "contradicted_pairs": len(found.contradicted),
    }

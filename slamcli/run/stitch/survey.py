"""Frames without a calibration as a survey: a camera whose height and tilt vary over a plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slamcli.core.camera.calibration import Calibration, Intrinsics, top_down_calibration
from slamcli.core.geometry import apply_homography
from slamcli.core.records import FloorMap
from slamcli.io.frames import FrameFile
from slamcli.io.images.canvas import common_canvas
from slamcli.io.toml import Scalar
from slamcli.run.session.session import Session
from slamcli.run.stitch.describing import Described, describe_file, describe_slanted, on_canvas
from slamcli.run.stitch.drive import Drive, SurveyFacts
from slamcli.run.stitch.focal_length import noted_focal_pixels
from slamcli.run.stitch.survey_records import records
from slamcli.selfcal import RegisteredDrive
from slamcli.survey import Survey, survey
from slamcli.survey.lens import Lens, LensPrior
from slamcli.survey.mounted import calibrated_lens, known_lens
from slamcli.survey.oblique import floor_motion
from slamcli.survey.oblique_camera import NOTED_FOCAL_SIGMA
from slamcli.survey.pairs import Pair, find_pair, fit_similarity

# Nominal focal length without a better source, in widths of the picture: between a phone's and a
# drone's, and the sigma of its logarithm. Only frames that tilt determine it better.
_FOCAL_WIDTHS, _FOCAL_SIGMA = 1.2, 0.5
# Two frames in sequence whose scales differ by more than this share, or whose matches leave a rigid
# motion by more than this share of the picture, are not of a rigid top-down mount.
_RIGID_SCALE, _RIGID_SHARE, _PROBES = 0.004, 0.0015, 3


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


NO_PROBE = Probe(free=True, apart=False)


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
    features = [on_canvas(one, canvas) for one in described]
    known = drive.intrinsics
    lens = _lens(files, canvas) if known is None else known_lens(known)
    stage = partial(session.stage, "comparing frames")
    # The pictures of a known lens are described without its distortion, and are not read again.
    slanted = None if known is not None else lambda number: describe_slanted(files[number])
    found = survey(features, lens, stage, level=drive.options.level, slanted=slanted)
    camera = _camera(canvas, found) if known is None else _with_lens(known)
    return _surveyed(found, files, described, drive, camera)


def locate_calibrated(
    described: Sequence[Described], drive: Drive, session: Session
) -> SurveyedDrive:
    """Return a drive with a calibration located with six degrees of freedom about it."""
    inputs = drive.inputs
    features = [on_canvas(one, inputs.calibration.image_size) for one in described]
    read = zip(inputs.files, described, strict=False)
    files = [
        *(replace(file, digest=one.digest) for file, one in read),
        *inputs.files[len(described) :],
    ]
    lens = calibrated_lens(inputs.calibration)
    found = survey(
        features, lens, partial(session.stage, "comparing frames"), level=drive.options.level
    )
    return _surveyed(found, files, described, drive, inputs.calibration)


def _surveyed(
    found: Survey,
    files: list[FrameFile],
    described: Sequence[Described],
    drive: Drive,
    calibration: Calibration,
) -> SurveyedDrive:
    """Return the records of a survey."""
    estimates, links = records(found, files, described, calibration)
    placed = [one for one in estimates if one.map_from_robot is not None]
    floor_map = None
    if placed:
        options = drive.mapper.options
        floor_map = FloorMap(
            calibration,
            options.features,
            1.0 if calibration.is_top_down else drive.mapper.metres_per_pixel,
            options.tilt_sigma_degrees,
            (),
            tuple(estimates),
            tuple(links),
        )
    registered = RegisteredDrive(calibration, estimates, links, frozenset(), floor_map)
    return SurveyedDrive(registered, files, SurveyFacts(_rows(found, calibration), _section(found)))


def _lens(files: Sequence[FrameFile], canvas: tuple[int, int]) -> Lens:
    """Return the first guess of the lens, with what is known of it."""
    focal, sigma = noted_focal_pixels(files, canvas), NOTED_FOCAL_SIGMA
    if focal is None:
        focal, sigma = _FOCAL_WIDTHS * max(canvas), _FOCAL_SIGMA
    return Lens(focal, 0.0, 0.5 * math.hypot(*canvas), LensPrior(math.log(focal), sigma))


def _with_lens(intrinsics: Intrinsics) -> Calibration:
    """Return the nominal camera of frames from above with a known lens."""
    return replace(
        top_down_calibration(intrinsics.image_size),
        camera_matrix=intrinsics.camera_matrix,
        distortion=intrinsics.distortion,
        distortion_model=intrinsics.distortion_model,
    )


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


def _rows(found: Survey, calibration: Calibration) -> tuple[tuple[str, str], ...]:
    if not found.maps:
        return ()
    mount, lens = found.maps[0].bundle.mount, found.maps[0].bundle.lens
    down = calibration.is_top_down
    text = (
        f"{'looks down' if down else 'moves'} with six degrees of freedom: "
        f"tilt ±{math.degrees(mount.tilt_sigma):.2g}°, "
        f"height ±{mount.scale_sigma:.1%} from frame to frame"
    )
    if down:
        text += f", lens bends the corners by {lens.bend:.1%}"
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

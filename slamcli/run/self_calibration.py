"""Self-calibration by a drive's frames, for `slam stitch` and `slam calibrate --refine`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Rocking
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.mounting import rocked
from slamcli.core.config import MapperOptions
from slamcli.core.errors import CalibrationError, InputError
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.io.calibrations import CalibrationSource, load_origin, save_calibration
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.outputs import refuse_existing
from slamcli.io.runs import camera_section
from slamcli.io.toml import Scalar
from slamcli.run.command_report import Report
from slamcli.run.frame_loop import register
from slamcli.run.inputs import Inputs, open_inputs
from slamcli.run.session.session import Session
from slamcli.selfcal import (
    THOROUGH,
    Effort,
    RegisteredDrive,
    SelfCalibration,
    contradiction_pixels,
    contradicts,
    refine_calibration,
)
from slamcli.stages import adjustment
from slamcli.stages import calibrate as solving

# Of the calibration photo's corners, and of a frame's tilt that was adjusted: one sigma.
_CORNER_PIXELS = 0.5
_LEAST_TILT = 1e-5


def calibrate_by_frames(
    sources: Sequence[Path],
    calibration_path: Path | None,
    output: Path,
    max_range_metres: float | None,
    *,
    overwrite: bool,
    session: Session,
) -> Report:
    """Refine an existing calibration by a drive's frames and write it.

    Raises
    ------
    InputError, CalibrationError, OutputError
        CalibrationError when the frames do not determine the camera.
    """
    path = output if output.suffix.lower() in {".yaml", ".yml"} else output / "calibration.yaml"
    inputs = open_inputs(
        sources, calibration_path, None, max_range_metres, progress=session.progress
    )
    refuse_existing(path, inputs=inputs.paths, overwrite=overwrite)
    if inputs.calibration_path is None:
        raise InputError("--refine starts from a calibration; give it with -c")
    options = MapperOptions()
    first = register(inputs.files, options, session, inputs.calibration)
    done = self_calibrate(inputs, first, options, session)
    if done.verdict == "not applied":
        raise CalibrationError(f"the calibration is left as it was: {done.reason}")
    origin = load_origin(inputs.calibration_path)
    save_calibration(path, done.registration.calibration, origin)
    lines = [inputs.note] if inputs.note else []
    lines += [*describe(done), f"wrote {path}"]
    camera = camera_section(done.registration.calibration)
    return Report(tuple(lines), {"output": path, **run_section(done), **camera})


def look(inputs: Inputs, first: RegisteredDrive, session: Session) -> tuple[bool, str]:
    """Return whether the frames contradict their calibration, and a line on what was found."""
    here = session.on_this_machine()
    pixels = contradiction_pixels(
        first, lambda index: read_frame(inputs.files[index], gray=True), here.ordered
    )
    if math.isnan(pixels):
        return False, ""
    return contradicts(pixels), f"as calibrated: the frames agree with it to {pixels:.2f} px"


def self_calibrate(
    inputs: Inputs,
    first: RegisteredDrive,
    options: MapperOptions,
    session: Session,
    effort: Effort = THOROUGH,
) -> SelfCalibration:
    """Refine camera and poses by the frames that have been registered."""
    session.notify("refining the camera by the frames: bundle adjustment, then locating anew")
    origin = None if inputs.calibration_path is None else load_origin(inputs.calibration_path)
    here = session.on_this_machine()
    return refine_calibration(
        first,
        lambda index: read_frame(inputs.files[index]),
        partial(register, inputs.files, options, here),
        here.ordered,
        partial(true_scale, origin, _index_of(origin, inputs.files)),
        effort,
    )


def _index_of(origin: CalibrationSource | None, files: Sequence[FrameFile]) -> int | None:
    """Return which frame is the calibration photo, by its name."""
    named = [file.index for file in files if origin is not None and file.path.name == origin.photo]
    return named[0] if len(named) == 1 else None


def true_scale(
    origin: CalibrationSource | None,
    photo_index: int | None,
    found: adjustment.Adjustment,
) -> float:
    """Return by how much a camera's height must grow for its calibration square to have its size.

    The refined camera changes how large the square seems in its photo, which has a pose of its own:
    least squares on the reprojection of its corners, by size, place and tilt. 1 without a square.

    Parameters
    ----------
    origin : CalibrationSource or None
    photo_index : int or None
        Index of the frame that is the calibration photo, whose tilt and height were adjusted; of
        another photo the tilt is as likely as those of the frames.
    found : Adjustment
    """
    if origin is None or origin.target.split()[:1] not in (["square"], ["aruco"]):
        return 1.0
    # Slow to load, and used by few runs of `slam stitch`.
    from scipy.optimize import least_squares

    calibration, own = (
        found.calibration,
        found.poses.get(-1 if photo_index is None else photo_index),
    )
    if own is not None:
        calibration = rocked(calibration, own.rocking)
    sigmas = np.full(2, _LEAST_TILT) if own is not None else found.rocking_sigmas[:2]
    sigmas = np.maximum(sigmas, _LEAST_TILT)
    corners = solving.sort_corners(origin.corners, calibration.image_size)
    target = solving.square_target(origin.side_metres)
    pixels = undistort_points(calibration, corners)
    floor = apply_homography(calibration.robot_from_image, pixels)
    edge, side = floor[1] - floor[0], target[1] - target[0]
    yaw = math.atan2(edge[1], edge[0]) - math.atan2(side[1], side[0])

    def misfit(values: Float64Array) -> Float64Array:
        size, x, y, theta, pitch, roll = (float(value) for value in values)
        placed = Pose2(x, y, theta).apply(math.exp(size) * target)
        tilted = rocked(calibration, Rocking(pitch, roll))
        seen = apply_homography(tilted.image_from_robot, placed)
        return np.concatenate([(seen - pixels).ravel() / _CORNER_PIXELS, values[4:] / sigmas])

    start = np.array([0.0, *floor.mean(axis=0), yaw, 0.0, 0.0])
    solution = least_squares(misfit, start, method="lm", x_scale="jac")
    return math.exp(-float(solution.x[0]))


def describe(done: SelfCalibration) -> list[str]:
    """Return lines of text: whether the camera was changed, and how well it fits the frames."""
    lines = [f"{'camera':<12} {done.verdict}: {done.reason}"]
    if math.isfinite(done.pixels_after):
        lines.append(
            f"{'matches':<12} {done.pixels_before:.2f} px apart before, "
            f"{done.pixels_after:.2f} px after (median)"
        )
    if done.rocking_sigmas is not None:
        pitch, roll, height = done.rocking_sigmas
        calibration = done.registration.calibration
        metres = height * calibration.height_metres
        sway = f"{metres:.2g} h" if calibration.unit == "h" else f"{1000.0 * metres:.2g} mm"
        lines.append(
            f"{'rocking':<12} pitch {math.degrees(pitch):.2g}°, roll {math.degrees(roll):.2g}°, "
            f"height {sway} from frame to frame"
        )
    return lines


def run_section(done: SelfCalibration) -> dict[str, Scalar]:
    """Return the section of run.toml."""
    calibration = done.registration.calibration
    section: dict[str, Scalar] = {
        "verdict": done.verdict,
        "reason": done.reason,
        "rounds": done.rounds,
        "focal_pixels": float(calibration.camera_matrix[0, 0]),
        "principal_column_pixels": float(calibration.camera_matrix[0, 2]),
        "principal_row_pixels": float(calibration.camera_matrix[1, 2]),
        "height_metres": calibration.height_metres,
        "pitch_degrees": math.degrees(calibration.pitch_radians),
        "roll_degrees": math.degrees(calibration.roll_radians),
        "k1": float(calibration.distortion[0]),
        "k2": float(calibration.distortion[1]),
    }
    if math.isfinite(done.pixels_after):
        section |= {"pixels_before": done.pixels_before, "pixels_after": done.pixels_after}
    if done.rocking_sigmas is not None:
        pitch, roll, height = (float(sigma) for sigma in done.rocking_sigmas)
        section |= {
            "rocking_pitch_degrees": math.degrees(pitch),
            "rocking_roll_degrees": math.degrees(roll),
            "rocking_height_metres": height * calibration.height_metres,
        }
    return section

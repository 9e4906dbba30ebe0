"""The camera on the page: as it was calibrated, and as self-calibration found it."""

from __future__ import annotations

import math

from slamcli.core.camera.calibration import Calibration
from slamcli.run.report.run import FinishedRun
from slamcli.run.self_calibration import describe


def camera_table(run: FinishedRun) -> dict[str, object]:
    """Return rows of name, value before, value after, its sigma, and the verdict in words.

    Without self-calibration the last two columns are empty.
    """
    if run.survey is not None:
        return {"rows": [], "lines": [text for _, text in run.survey]}
    done = run.self_calibration
    before, after = run.given, run.calibration
    lines = [] if done is None else [" ".join(line.split()) for line in describe(done)]
    if not math.isfinite(before.height_metres):
        return {"rows": [], "lines": lines}
    first, second, sigmas = _values(before), _values(after), _sigmas(after)
    changed = done is not None and done.verdict == "refined"
    rows = [
        [name, value, second[name] if changed else "", sigmas.get(name, "") if changed else ""]
        for name, value in first.items()
    ]
    return {"rows": rows, "lines": lines}


def _values(camera: Calibration) -> dict[str, str]:
    matrix, lens = camera.camera_matrix, [f"{k:.4f}" for k in camera.distortion[:2]]
    return {
        "focal length": f"{matrix[0, 0]:.1f} px",
        "principal point": f"{matrix[0, 2]:.1f}, {matrix[1, 2]:.1f} px",
        "radial distortion k1, k2": ", ".join(lens),
        "height": f"{camera.height_metres:.4f} {camera.unit}",
        "pitch": f"{math.degrees(camera.pitch_radians):z.2f}°",
        "roll": f"{math.degrees(camera.roll_radians):z.2f}°",
        "range": f"{camera.max_range_metres:.2f} {camera.unit}",
    }


def _sigmas(camera: Calibration) -> dict[str, str]:
    values = {
        "focal length": (camera.focal_sigma_pixels, "px"),
        "height": (camera.height_sigma_metres, camera.unit),
        "pitch": (math.degrees(camera.pitch_sigma_radians), "°"),
        "roll": (math.degrees(camera.roll_sigma_radians), "°"),
    }
    return {
        name: f"± {value:.2g} {unit}".replace(" °", "°")
        for name, (value, unit) in values.items()
        if math.isfinite(value) and value > 0
    }

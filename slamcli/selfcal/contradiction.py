"""A quick test whether frames contradict their calibration: a few pairs that lie well apart."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from slamcli.core.camera.calibration import Rocking
from slamcli.selfcal.bundle import NONE, InOrder, RegisteredDrive, fit, median_pixels
from slamcli.selfcal.correspondences import FramePair, Matcher, Read
from slamcli.stages import adjustment

# One pair for so many frames, within these bounds: a twentieth of what registering them takes.
_FRAMES_A_PAIR, _MIN_PAIRS, _MAX_PAIRS = 16, 3, 8
_MATCHES_A_PAIR, _MIN_MATCHES = 60, 12
# Any informative spots do: they are chosen at half the size.
_CHOSEN_ON = 1
# Spots of a rigid camera that is right lie 0.02 to 0.2 px apart, those of one that is off by a
# per cent or by a lens 1 px and more [benchmarks/self_calibration.py].
_MAX_PIXELS = 0.35


def contradiction_pixels(drive: RegisteredDrive, read: Read, in_order: InOrder) -> float:
    """Return how far apart spots that two frames share lie, median, where the camera is rigid.

    Nan when too few pairs show what can be compared.
    """
    if not math.isfinite(drive.calibration.height_metres):
        return math.nan
    pairs = _wide_pairs(drive)
    if len(pairs) < _MIN_PAIRS:
        return math.nan
    poses = {
        estimate.index: adjustment.FramePose(estimate.map_from_robot, Rocking())
        for estimate in drive.estimates
        if estimate.map_from_robot is not None
    }
    matcher = Matcher(drive.calibration, poses, drive.links, read, adjustment.MAX_LEVEL, _CHOSEN_ON)
    found = in_order(partial(matcher.match, count=_MATCHES_A_PAIR), pairs)
    matches = [match for match in found if match is not None and len(match) >= _MIN_MATCHES]
    if len(matches) < _MIN_PAIRS:
        return math.nan
    rigid = fit(drive.calibration, poses, matches, NONE, np.zeros(3))
    return median_pixels(rigid, matches)


def contradicts(pixels: float) -> bool:
    """Return whether frames that lie so far apart contradict their calibration."""
    return pixels > _MAX_PIXELS


def _wide_pairs(drive: RegisteredDrive) -> list[FramePair]:
    """Return pairs of linked frames from the wider half of all, evenly spread over the drive."""
    placed = {e.index: e.map_from_robot for e in drive.estimates if e.map_from_robot is not None}
    lengths: dict[FramePair, float] = {}
    for number, link in enumerate(drive.links):
        if number in drive.switched_off or link.a not in placed or link.b not in placed:
            continue
        motion = link.a_from_b
        turn = drive.calibration.height_metres * abs(motion.theta)
        lengths[min(link.a, link.b), max(link.a, link.b)] = math.hypot(motion.x, motion.y) + turn
    if not lengths:
        return []
    middle = float(np.median(list(lengths.values())))
    wide = sorted(pair for pair, length in lengths.items() if length >= middle)
    count = min(max(len(placed) // _FRAMES_A_PAIR, _MIN_PAIRS), _MAX_PAIRS, len(wide))
    chosen = np.linspace(0, len(wide) - 1, count).round().astype(int).tolist()
    return [wide[number] for number in chosen]

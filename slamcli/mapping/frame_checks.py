"""Checks of what a caller passes as a frame: its index, name, stamp, pixels and mask."""

from __future__ import annotations

import operator
from dataclasses import replace
from typing import Any

import numpy as np

from slamcli.core.bounds import (
    ANGLE,
    COORDINATE,
    FRAME_INDEX,
    SIGMA_METRES,
    SIGMA_RADIANS,
    STAMP,
    quoted,
)
from slamcli.core.camera.calibration import Calibration
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, PreparedFrame
from slamcli.stages.view import check_frame

# The index of the estimate of a frame that has none of its own; no map keeps it.
NO_INDEX = -1


def checked_frame(frame: object, calibration: Calibration) -> Frame:
    """Return a frame whose fields have their types and bounds, its pixels contiguous.

    Nothing is copied before the picture is known to be of the camera's size.

    Raises
    ------
    FrameError
    """
    if not isinstance(frame, Frame):
        raise FrameError(f"not a Frame but of the type {type(frame).__name__}")
    index, stamp = _index(frame.index), _stamp(frame.stamp)
    if not isinstance(frame.name, str):
        raise FrameError(f"its name is of the type {type(frame.name).__name__}; give a text")
    image, mask = _plain(frame.image, "picture"), frame.mask
    checked = Frame(index, frame.name, stamp, image)
    check_frame(checked, calibration)
    if mask is not None:
        mask = _plain(mask, "mask")
        if mask.dtype not in (np.uint8, np.bool_):
            raise FrameError("its mask is not an array of 8-bit pixels, 255 where it is opaque")
        if mask.shape != image.shape[:2]:
            raise FrameError(f"its mask has shape {mask.shape}, not that of the picture")
        if mask.dtype == np.bool_:
            mask = mask.astype(np.uint8) * np.uint8(255)
        mask = np.ascontiguousarray(mask)
    return replace(checked, image=np.ascontiguousarray(image), mask=mask)


def fault_of_expectation(pose: object, sigma: object = (1.0, 1.0)) -> str:
    """Return what is wrong with an expected pose and its sigmas (metres, radians); else nothing."""
    if not isinstance(pose, Pose2):
        return f"the expected pose is {quoted(pose)}; a Pose2 is needed"
    if pose.x not in COORDINATE or pose.y not in COORDINATE or pose.theta not in ANGLE:
        return f"the expected pose is {quoted(pose)}; numbers within the bounds of a map are needed"
    bounds = (SIGMA_METRES, SIGMA_RADIANS)
    if (
        not isinstance(sigma, tuple)
        or len(sigma) != len(bounds)
        or not all(number in limits for number, limits in zip(sigma, bounds, strict=True))
    ):
        return f"the sigmas are {quoted(sigma)}; metres and radians from 1e-6 on are needed"
    return ""


def refused(frame: object, reason: str) -> PreparedFrame:
    """Return a frame that cannot be used, with what is sound of its index, name and stamp."""
    try:
        index = _index(getattr(frame, "index", None))
    except FrameError:
        index = NO_INDEX
    try:
        stamp = _stamp(getattr(frame, "stamp", None))
    except FrameError:
        index, stamp = NO_INDEX, None
    name = getattr(frame, "name", "")
    return PreparedFrame(index, name if isinstance(name, str) else "", stamp, None, None, reason)


def is_known(prepared: object) -> bool:
    """Return whether a prepared frame has an index and a stamp that a map can keep."""
    if not isinstance(prepared, PreparedFrame) or prepared.index not in FRAME_INDEX:
        return False
    return prepared.stamp is None or prepared.stamp in STAMP


def _index(value: Any) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = NO_INDEX
    if isinstance(value, bool) or number not in FRAME_INDEX:
        raise FrameError(f"its index is {quoted(value)}; {FRAME_INDEX} is needed")
    return number


def _stamp(value: Any) -> float | None:
    if value is None:
        return None
    number = value.item() if isinstance(value, np.generic) else value
    if number not in STAMP:
        raise FrameError(f"its stamp is {quoted(value)}; {STAMP} or None is needed")
    return float(number)


def _plain(value: Any, what: str) -> Any:
    """Return a plain array of numpy's."""
    if not isinstance(value, np.ndarray):
        raise FrameError(f"its {what} is not an array of 8-bit pixels")
    if isinstance(value, np.ma.MaskedArray):
        raise FrameError(f"its {what} is a masked array; give the mask as the frame's own")
    return value.view(np.ndarray)

"""Self-calibration of a finished map in the library: camera and poses refined by its own frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from slamcli.core.camera.calibration import Calibration
from slamcli.core.errors import FrameError
from slamcli.core.records import Frame
from slamcli.mapping.frame_checks import refused
from slamcli.mapping.keyframe_views import with_new_views
from slamcli.mapping.mapper import Mapper
from slamcli.selfcal import BRIEF, RegisteredDrive, SelfCalibration, refine_calibration
from slamcli.selfcal.bundle import InOrder


def self_calibrate(
    mapper: Mapper, read: Callable[[int], Frame], in_order: InOrder = map
) -> SelfCalibration:
    """Return camera, poses and map refined by the frames, where these determine the camera.

    The mapper is finished and stays as it is; its height above the floor is kept. Frames are read
    again: those that overlap, and all where some were lost, which are then registered anew.

    Parameters
    ----------
    mapper : Mapper
        After `finish`, without other sensors.
    read : callable
        Returns a frame by its index; may raise FrameError.
    in_order : callable
        Like `map`, such as that of a `ThreadPoolExecutor`.
    """

    def register(calibration: Calibration) -> RegisteredDrive:
        anew = Mapper(calibration, mapper.options)
        for known in mapper.estimates:
            try:
                anew.update(read(known.index))
            except FrameError as error:
                anew.step(refused(known, str(error)))
        anew.finish()
        return registration_of(anew)

    first = registration_of(mapper)
    done = refine_calibration(first, read, register, in_order, lambda _found: 1.0, BRIEF)
    floor_map = done.registration.floor_map
    if done.verdict == "not applied" or floor_map is None:
        return done
    registration = replace(done.registration, floor_map=with_new_views(floor_map, read))
    return replace(done, registration=registration)


def registration_of(mapper: Mapper) -> RegisteredDrive:
    """Return the poses, links and map of a mapper after the last frame."""
    return RegisteredDrive(
        mapper.calibration,
        mapper.estimates,
        mapper.links,
        mapper.switched_off,
        mapper.floor_map(),
    )

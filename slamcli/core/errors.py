"""The errors that a user can cause, under one root that the command line turns into a message."""

from __future__ import annotations


class SlamcliError(Exception):
    """Root of all errors of this package; its text is one line: what, where and what to do."""


class InputError(SlamcliError):
    """Something given (a folder, an option's value, a file) cannot be used."""


class FrameError(SlamcliError):
    """One frame cannot be used; the run goes on and the text becomes that frame's reason."""


def other_size(size: tuple[int, int], wanted: tuple[int, int]) -> FrameError:
    """Return the error of a frame whose width and height are not those of the run's camera."""
    return FrameError(
        f"{size[0]}x{size[1]} pixels, but the run's camera has {wanted[0]}x{wanted[1]}"
    )


class CalibrationError(SlamcliError):
    """A calibration is missing, broken or does not fit, or a photo does not yield one."""


class MapError(SlamcliError):
    """A map file is missing, damaged, or has values that no map can have."""


class OutputError(SlamcliError):
    """A result cannot be written to the given path."""

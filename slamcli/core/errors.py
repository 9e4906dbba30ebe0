"""The errors that a user can cause, under one root that the command line turns into a message."""

from __future__ import annotations


class SlamcliError(Exception):
    """Root of all errors of this package; its text is one line: what, where and what to do."""


class InputError(SlamcliError):
    """Something given (a folder, an option's value, a file) cannot be used."""


class FrameError(SlamcliError):
    """One frame cannot be used; the run goes on and the text becomes that frame's reason."""


class CalibrationError(SlamcliError):
    """A calibration is missing, broken or does not fit, or a photo does not yield one."""


class MapError(SlamcliError):
    """A map file is missing, damaged, or has values that no map can have."""


class OutputError(SlamcliError):
    """A result cannot be written to the given path."""

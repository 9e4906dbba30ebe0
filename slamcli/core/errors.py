"""Every error that a user can cause, under one root, so that one boundary turns all into a line."""

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
    """A map file is missing, damaged, or not one that can be believed."""


class OutputError(SlamcliError):
    """A result cannot be written where it was asked for."""

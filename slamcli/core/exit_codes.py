"""The exit codes of every command."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """What a command's exit code means; the same for all commands."""

    DONE = 0
    """All was done."""
    ERROR = 1
    """An error, said in one line, with nothing half-written; or no fit, or no frame placed."""
    USAGE = 2
    """Wrong usage; click's own."""
    INCOMPLETE = 3
    """Written, but incomplete: most frames lost, or any with --strict, or unreadable by now."""
    INTERRUPTED = 130
    """Ctrl-C, SIGTERM or SIGHUP; written is what there was, and `--resume` goes on from there.

    The shell's own code of a program that SIGINT ended; one code for all three, as a script that
    resumes need not know which of them it was.
    """


def of_placement(placed: int, frames: int, *, strict: bool = False) -> ExitCode:
    """Return the exit code of a command that placed some of its frames.

    Without any it is an error. Fewer than half are incomplete; with `strict`, fewer than all.
    """
    if placed == 0:
        return ExitCode.ERROR
    complete = placed == frames if strict else 2 * placed >= frames
    return ExitCode.DONE if complete else ExitCode.INCOMPLETE

"""What a command prints beside its result: how much of it, in which colours, and into which log."""

from __future__ import annotations

import io
import logging
import os
import re
import sys
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import click

from slamcli.cli.options.sections import OUTPUT, expert, section
from slamcli.cli.options.values import PATH
from slamcli.cli.streams import LenientStream
from slamcli.core.errors import OutputError
from slamcli.core.names import printable, readable

_KEY = __name__
# Of a file that may be appended to: nothing, or the line with the command.
_LOG_START = re.compile(rb"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d slam\b|$)")
_MAX_START_BYTES = 30


@dataclass(slots=True)
class Messages:
    """The messages of one command.

    Attributes
    ----------
    quiet : bool
        No progress and no notes on the standard error.
    verbose : bool
        Also what is for experts: log records of the library, with tracebacks.
    log : text file or None
        Takes all messages, each with its time.
    log_path : Path or None
    """

    quiet: bool = False
    verbose: bool = False
    log: TextIO | None = field(default=None, repr=False)
    log_path: Path | None = None

    def show(self, line: str, *, error: bool = False) -> None:
        """Print a line that is no result."""
        line = printable(line)
        self.record(line)
        if error or not self.quiet:
            click.echo(click.style(line, fg="red") if error else line, err=True, color=_colour())

    def record(self, text: str) -> None:
        """Write lines into the log alone."""
        if self.log is not None:
            now = time.strftime("%Y-%m-%d %H:%M:%S")
            self.log.writelines(f"{now} {line}\n" for line in text.splitlines())
            self.log.flush()


def messages() -> Messages:
    """Return the messages of the command that runs."""
    context = click.get_current_context(silent=True)
    if context is None:
        return Messages()
    found: Messages = context.meta.setdefault(_KEY, Messages())
    return found


def result(text: str) -> None:
    """Print a result on the standard output; the log has it too."""
    text = printable(text)
    messages().record(text)
    click.echo(text)


def choose(context: click.Context, option: click.Parameter, value: Any) -> None:
    """Take one of the options of messages; each comes before the command's own."""
    if not value or context.resilient_parsing:
        return
    found = messages()
    if option.name == "quiet":
        found.quiet = True
    elif option.name == "verbose":
        found.verbose = True
        _log_library(context, logging.StreamHandler(), logging.DEBUG)
    else:
        found.log, raw = _open_log(value)
        found.log_path = value
        # An error is shown after the command's own context has ended.
        context.find_root().call_on_close(partial(_close_log, found, raw))
        found.record(" ".join(["slam", *map(readable, sys.argv[1:])]))
        _log_library(context, logging.StreamHandler(found.log), logging.INFO)


def _open_log(path: Path) -> tuple[TextIO, LenientStream]:
    """Open a log to append to it, which cannot stop the work. Raises OutputError."""
    try:
        if path.is_symlink() or (path.exists() and not (path.is_file() and _is_log(path))):
            raise OutputError(f"cannot write the log {path}: there is something else; name a log")
        raw = LenientStream(io.FileIO(path, "a"), owned=True)
    except OSError as error:
        raise OutputError(f"cannot write the log {path}: {error.strerror}") from error
    text = io.TextIOWrapper(io.BufferedWriter(raw), "utf-8", errors="backslashreplace")
    return text, raw


def _close_log(found: Messages, raw: LenientStream) -> None:
    """End the log, and say on the standard error when a part of it is missing."""
    log, found.log = found.log, None
    if log is not None:
        log.close()
    if raw.fault is not None:
        reason = raw.fault.strerror or raw.fault
        found.show(f"the log {found.log_path} is not complete: {reason}", error=True)


def _is_log(path: Path) -> bool:
    """Return whether a file is empty or begins as a log does."""
    with path.open("rb") as file:
        return _LOG_START.match(file.read(_MAX_START_BYTES)) is not None


def _log_library(context: click.Context, handler: logging.Handler, level: int) -> None:
    """Send the records of the package's own logger to a handler, until the command ends."""
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s %(levelname)s %(message)s"))
    logger = logging.getLogger("slamcli")
    logger.addHandler(handler)
    handler.setLevel(level)
    context.find_root().call_on_close(lambda: logger.removeHandler(handler))


_option = partial(click.option, is_eager=True, expose_value=False, callback=choose)

message_options = section(
    OUTPUT,
    _option("-q", "--quiet", is_flag=True, help="Print the result alone: no progress, no notes."),
    _option("--log-file", type=PATH, help="Also log all messages in a file. Each with its time."),
    expert(
        OUTPUT,
        _option("-v", "--verbose", is_flag=True, help="Print failures with their tracebacks."),
    ),
)


def _colour() -> bool | None:
    """Return whether to use colours: where there is a terminal, unless NO_COLOR is set."""
    return False if os.environ.get("NO_COLOR") else None

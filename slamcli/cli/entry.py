"""The entry point of `slam`: settings of the environment, then the command line."""

from __future__ import annotations

import os
import signal
import sys

from slamcli.cli.streams import LenientStream, replace_streams

# A file to which failures are logged with their tracebacks.
_LOG_VARIABLE = "SLAMCLI_LOG"


def main() -> None:
    """Run the command line."""
    output = replace_streams()
    # Frames already occupy all processors, so that the linear algebra's own threads only wait for
    # one another. numpy reads this as it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("MKL_NUM_THREADS", "1")
    # A frame that cannot be decoded is reported once, with its reason; OpenCV would repeat it.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if os.environ.get(_LOG_VARIABLE):
        _log_to(os.environ[_LOG_VARIABLE])
    from slamcli.cli.main import main as command_line

    code: object = None
    try:
        command_line(prog_name="slam")
    except SystemExit as end:
        code = end.code
    except KeyboardInterrupt:
        # Between two handlers of the command line.
        code = 130
    # What is done is done: Python's end is not to be interrupted, with a traceback.
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    sys.exit(_exit_code(code, output))


def _log_to(path: str) -> None:
    import logging

    try:
        logging.basicConfig(filename=path, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    except OSError as error:
        sys.stderr.write(f"Error: cannot write the log {path}: {error.strerror}\n")
        sys.exit(1)


def _exit_code(code: object, output: LenientStream | None) -> int | str | None:
    """Return the exit code: an error when what was to be printed is lost."""
    if output is not None:
        sys.stdout.flush()
        if output.fault is not None and not code:
            sys.stderr.write(f"Error: cannot print the result: {output.fault.strerror}\n")
            return 1
    return code if isinstance(code, int | str) else None

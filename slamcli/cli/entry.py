"""The entry point of `slam`: settings of the environment, then the command line."""

from __future__ import annotations

import os


def main() -> None:
    """Run the command line."""
    # Frames already occupy all processors, so that the linear algebra's own threads only wait for
    # one another. numpy reads this as it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("MKL_NUM_THREADS", "1")
    # A frame that cannot be decoded is reported once, with its reason; OpenCV would repeat it.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from slamcli.cli.main import main as command_line

    command_line(prog_name="slam")

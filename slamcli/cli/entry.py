"""Where `slam` starts: a plain `slam --help` is answered before click is loaded.

Loading click takes three times as long as starting Python; who only asks what there is need not
wait for it. A test holds that the text is click's own, of 80 columns.
"""

from __future__ import annotations

import os
import sys

HELP = """\
Usage: slam [OPTIONS] COMMAND [ARGS]...

  Turn what a robot's camera saw of the floor into one metric map.

Options:
  --version   Show the version and exit.
  -h, --help  Show this message and exit.

Commands:
  calibrate  Calibrate from PHOTOS of a square.
  detect     Draw the points found in FRAMES.
  evaluate   Measure how far POSES are from the TRUTH.
  locate     Find FRAMES in a finished MAP.
  match      Find the transform from FIRST to SECOND.
  render     Paint the map of RUN again, otherwise.
  simulate   Simulate a drive over a floor into OUTPUT.
  stitch     Stitch FRAMES into one map.
  warp       Warp FRAMES to metric bird's-eye pictures.
"""


def main() -> None:
    """Run the command line."""
    if sys.argv[1:] in (["-h"], ["--help"]):
        sys.stdout.write(HELP)
        return
    # Frames already fill the processors; for matrices as small as theirs the linear algebra's own
    # threads only wait for one another. It reads this as it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("MKL_NUM_THREADS", "1")
    from slamcli.cli.main import main as command_line

    command_line(prog_name="slam")

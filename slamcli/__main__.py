"""The command `python -m slamcli`, the same as `slam`."""

from __future__ import annotations

from slamcli.cli.entry import main

if __name__ == "__main__":
    main()

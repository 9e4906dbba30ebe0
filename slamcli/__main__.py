"""`python -m slamcli` is `slam`."""

from __future__ import annotations

from slamcli.cli.entry import main

main()

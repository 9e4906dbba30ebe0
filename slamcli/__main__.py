"""`python -m slamcli` is `slam`."""

from __future__ import annotations

from slamcli.entry import main

main()

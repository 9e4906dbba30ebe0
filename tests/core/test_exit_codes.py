"""When a command that places frames is done, incomplete, or has failed."""

from __future__ import annotations

import pytest

from slamcli.core.exit_codes import ExitCode, of_placement


@pytest.mark.parametrize(
    ("placed", "frames", "strict", "code"),
    [
        (12, 12, True, ExitCode.DONE),
        (11, 12, False, ExitCode.DONE),
        (11, 12, True, ExitCode.INCOMPLETE),
        (6, 12, False, ExitCode.DONE),
        (5, 12, False, ExitCode.INCOMPLETE),
        (0, 12, False, ExitCode.ERROR),
        (0, 12, True, ExitCode.ERROR),
    ],
)
def test_a_placement_has_its_exit_code(
    placed: int, frames: int, strict: bool, code: ExitCode
) -> None:
    assert of_placement(placed, frames, strict=strict) == code

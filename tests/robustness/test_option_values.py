"""Hostile values of every numeric option of every command: each is one clear line, or works."""

from __future__ import annotations

from typing import Any

import click
import pytest
from click.testing import CliRunner
from spied_commands import ARGUMENTS, LOADED, calls, flag_of

from slamcli.cli.main import main
from slamcli.cli.options.values import Bytes, Degrees, Number, Numbers, Whole
from slamcli.core.bounds import Bounds

__all__ = ["calls"]  # a fixture
HOSTILE = (
    "nan",
    "inf",
    "-inf",
    "0",
    "-1",
    "1e-300",
    "1e300",
    "1e18",
    "9" * 18,
    "9" * 400,
    "9" * 5000,
    "1_000",
    "٣",
    "0x10",
    "",
    "text",
    "1\x00",
)
# Of these, no option of a number is one of.
NEVER = {"nan", "inf", "-inf", "1e300", "9" * 400, "9" * 5000, "", "text", "0x10", "1\x00"}
NUMERIC = (Number, Whole, Numbers, Degrees, Bytes)
OPTIONS = [
    (name, parameter)
    for name, command in LOADED.items()
    for parameter in command.params
    if isinstance(parameter, click.Option) and isinstance(parameter.type, NUMERIC)
]
OF_CLICK = (click.types.IntParamType, click.types.FloatParamType)


def values_of(parameter: click.Option, hostile: str) -> list[str]:
    """Return the hostile number as the option takes it: alone, and as each of several."""
    kind = parameter.type
    if not isinstance(kind, Numbers):
        return [hostile]
    count = kind.counts[-1]
    good = "100" if kind.limits.whole else "1"
    lists = [[hostile if k == n else good for k in range(count)] for n in range(count)]
    groups = [kind.separator.join(numbers) for numbers in lists]
    return [" ".join([group] * kind.groups) for group in groups]


def run(command: str, flag: str, value: str) -> Any:
    return CliRunner().invoke(main, [command, *ARGUMENTS[command], f"{flag}={value}"])


def test_options_are_walked() -> None:
    tried = sum(len(values_of(one, value)) for _, one in OPTIONS for value in HOSTILE)
    assert len(OPTIONS) > 80
    assert tried >= 1500


def test_no_option_takes_a_number_without_bounds() -> None:
    unbounded = [
        f"{name} {flag_of(parameter)}"
        for name, command in LOADED.items()
        for parameter in command.params
        if isinstance(parameter, click.Option)
        and not parameter.count
        and isinstance(parameter.type, OF_CLICK)
        and not isinstance(parameter.type, NUMERIC)
    ]
    assert not unbounded, "use Number or Whole of slamcli.cli.options.values"


@pytest.mark.parametrize(
    ("command", "parameter"),
    [pytest.param(name, one, id=f"{name} {flag_of(one)}") for name, one in OPTIONS],
)
def test_a_hostile_value_is_a_usage_error_or_reaches_the_work(
    command: str, parameter: click.Option, calls: list[tuple[str, list[Any]]]
) -> None:
    flag = flag_of(parameter)
    for hostile in HOSTILE:
        for value in values_of(parameter, hostile):
            result = run(command, flag, value)
            shown = f"{flag}={value[:50]}"
            assert result.exit_code in {0, 1, 2}, (shown, result.exception)
            assert result.exception is None or isinstance(result.exception, SystemExit), shown
            assert result.exit_code != 0 or hostile not in NEVER, shown
            if result.exit_code != 0:
                assert not calls, shown
                assert len(result.output) < 500, shown
                assert "Error: " in result.output, shown
            calls.clear()


@pytest.mark.parametrize(
    ("value", "inside"),
    [
        (0.0, False),
        (1, True),
        (1.5, True),
        (2.0, False),
        (True, False),
        ("1", False),
        (None, False),
        (float("nan"), False),
        (float("inf"), False),
        (10**400, False),
    ],
)
def test_bounds_contain_finite_numbers_alone(value: object, inside: bool) -> None:
    assert (value in Bounds(0, 2, open_low=True, open_high=True)) is inside


def test_whole_bounds_contain_integers_alone() -> None:
    limits = Bounds(0, 2, whole=True)
    assert 2 in limits
    assert 2.0 not in limits
    assert 3 not in limits

"""Every option of the command line reaches the work, and its default is the dataclass's own."""

from __future__ import annotations

import importlib
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner
from spied_commands import ARGUMENTS, LOADED, calls, flag_of

from slamcli.cli.main import COMMANDS, SlamGroup, main
from slamcli.cli.options.common import default_output
from slamcli.cli.options.fields import destination, filled, option
from slamcli.core.config import MapperOptions, ProductOptions

__all__ = ["calls"]  # a fixture
# Every command opens a session of its own: threads, a progress bar, what Ctrl-C sets.
OF_THE_SESSION = {"workers", "progress", "notify", "interruption"}
# These are of the refinement of a calibration alone, which --refine with a folder calls.
REFINING = {("calibrate", "--calibration"), ("calibrate", "--workers")}
# These are of the command line itself: tests/cli/test_command.py has them.
OF_THE_COMMAND_LINE = {"--config", "--help-all", "--verbose", "--quiet", "--log-file"}
TEXTS = {
    "--crs": "EPSG:25832",
    "--scale": "c.png,1,2,30,40,0.5",
    "--format": "geotiff",
    "--layers": "views",
    "--export": "tum",
    "--size": "320x240",
    "--crop": "0,0,1,1",
    "--datum": "1,2",
    "--corners": "1,2 30,2 30,40 1,40",
    "--memory": "2G",
    "--time-offset": "0.5",
    "--lever-arm": "1,2",
    "--scheduler": "tcp://here:1",
    "--chessboard": "8x6",
    "--gamma": "2.2",
    "--network-size": "640x480",
    "--first-level": "1",
    "--rotate": "30",
}


def other_value(parameter: click.Option) -> list[str]:
    """Return the option as given with a value that is not its default."""
    flag, kind = flag_of(parameter), parameter.type
    if parameter.is_flag or parameter.secondary_opts:
        return [parameter.secondary_opts[0] if parameter.default is True else flag]
    if flag in TEXTS:
        return [flag, TEXTS[flag]]
    if isinstance(kind, click.Choice):
        return [flag, next(c for c in kind.choices if c != parameter.default)]
    if isinstance(kind, click.IntRange | click.FloatRange):
        low = 1 if kind.min is None else kind.min
        high = low + 8 if kind.max is None else kind.max
        value: float = next(
            v
            for share in (0.5, 0.25, 0.75)
            if (v := low + share * (high - low)) != parameter.default
        )
        return [flag, str(int(value) if isinstance(kind, click.IntRange) else value)]
    if kind in (click.FLOAT, click.INT):
        return [flag, "3"]
    return [flag, "frames/c.png"]


OPTIONS = [
    (name, parameter)
    for name, command in LOADED.items()
    for parameter in command.params
    if isinstance(parameter, click.Option)
    and parameter.name != "help"
    and flag_of(parameter) not in OF_THE_COMMAND_LINE
]


def test_all_commands_are_loaded() -> None:
    assert isinstance(main, SlamGroup)
    assert list(LOADED) == list(COMMANDS)
    assert {name for name, _ in OPTIONS} == set(COMMANDS)


@pytest.mark.parametrize(
    ("command", "parameter"),
    [pytest.param(name, one, id=f"{name} {flag_of(one)}") for name, one in OPTIONS],
)
def test_every_option_changes_the_call_or_what_is_printed(
    command: str, parameter: click.Option, calls: list[tuple[str, list[Any]]]
) -> None:
    given = ARGUMENTS[command]
    if (command, flag_of(parameter)) in REFINING:
        given = ["frames", "--refine"]
    found = []
    for more in ([], other_value(parameter)):
        result = CliRunner().invoke(main, [command, *given, *more])
        assert result.exit_code == 0, (more, result.output, result.exception)
        found.append((repr(calls.pop()), result.output))
        assert not calls
    assert found[0] != found[1], f"slam {command} {flag_of(parameter)} changes nothing"


def changed(options: Any) -> list[str]:
    """Return the fields of a dataclass, and of those within it, that are not their defaults."""
    found = []
    for field in fields(options):
        value = getattr(options, field.name)
        default = field.default
        if field.default_factory is not MISSING:
            default = field.default_factory()
        if default is MISSING and is_dataclass(value):
            found += changed(value)
        elif default is not MISSING and value != default:
            found.append(field.name)
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_without_options_all_dataclasses_have_their_own_defaults(
    command: str, calls: list[tuple[str, list[Any]]]
) -> None:
    result = CliRunner().invoke(main, [command, *ARGUMENTS[command]])
    assert result.exit_code == 0, (result.output, result.exception)
    for value in calls[0][1]:
        if is_dataclass(value):
            assert set(changed(value)) <= OF_THE_SESSION, value


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_complete(command: str) -> None:
    loaded = LOADED[command]
    first = loaded.get_short_help_str(limit=200)
    assert COMMANDS[command] == first
    assert len(first) <= 65, "the list of commands would break the line, of 80 columns"
    for parameter in loaded.params:
        assert not isinstance(parameter, click.Option) or parameter.help, parameter.name


def test_the_stricter_ratio_in_the_help_is_that_of_the_work() -> None:
    plain = importlib.import_module("slamcli.run.match").PLAIN_RATIO
    parameter = next(p for p in LOADED["match"].params if "--ratio" in p.opts)
    assert isinstance(parameter, click.Option)
    assert f"else {plain}." in (parameter.help or "")


def test_filled_fills_nested_dataclasses_and_leaves_the_rest() -> None:
    start = MapperOptions(max_step_metres=2.0)
    flags = {
        destination(start, "min_score"): 0.6,
        destination("FeatureOptions", "count"): 7,
        destination("Other", "loops"): False,
    }
    expected = replace(start, min_score=0.6, features=replace(start.features, count=7))
    assert filled(start, flags) == expected
    with pytest.raises(AttributeError):
        option(start, "max_stride", "--max-step")


def value_of(option_name: str, text: str) -> Any:
    """Return what `slam stitch`, `calibrate` or `simulate` makes of an option's text."""
    for name in ("stitch", "calibrate", "simulate"):
        for parameter in LOADED[name].params:
            if option_name in parameter.opts:
                return parameter.type.convert(text, parameter, None)
    raise KeyError(option_name)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("--size", "640x480", (640, 480)),
        ("--chessboard", "8x6", (8, 6)),
        ("--corners", "1,2 3,4  5,6 7,8.5", ((1, 2), (3, 4), (5, 6), (7, 8.5))),
        ("--crop", "-1, 0,1,1e1", (-1, 0, 1, 10)),
        ("--datum", "1,2", (1, 2)),
        ("--datum", "1,2,90", (1, 2, 90)),
        ("--time-offset", "-0.5", (-0.5,)),
        ("--lever-arm", "auto", None),
        ("--format", "nav2, png", ("png", "nav2")),
        ("--memory", "1.5M", 1_500_000),
    ],
)
def test_a_list_of_numbers_or_words_is_read(name: str, text: str, value: Any) -> None:
    assert value_of(name, text) == value


@pytest.mark.parametrize(
    ("name", "text", "form"),
    [
        ("--size", "640x32", "WxH, each a whole number from 64 to 8192"),
        ("--size", "640.5x480", "WxH"),
        ("--chessboard", "8x2", "8x6, each a whole number from 3"),
        ("--corners", "1,2 3,4 5,6", "x,y x,y x,y x,y"),
        ("--corners", "1,2 3,4 5,6 7,nan", "x,y x,y x,y x,y"),
        ("--crop", "auto", "x_min,y_min,x_max,y_max"),
        ("--datum", "1", "latitude,longitude"),
        ("--time-offset", "1,2", "SECONDS"),
        ("--lever-arm", "inf,0", "AHEAD,LEFT"),
        ("--format", "jpeg", "png, geotiff, deepzoom, nav2"),
        ("--memory", "0", "500M or 2G"),
    ],
)
def test_a_value_of_another_form_is_refused_with_the_form(name: str, text: str, form: str) -> None:
    with pytest.raises(click.BadParameter, match=r"of the form|none of|no amount") as raised:
        value_of(name, text)
    assert form in raised.value.message


def test_the_default_output_of_the_root_is_in_it() -> None:
    assert default_output(Path("/"), "mosaic") == Path("/_mosaic")
    assert default_output(Path("/some/drive.mp4"), "mosaic") == Path("/some/drive_mosaic")


def test_angles_and_bytes_are_written_as_they_are_read() -> None:
    shown = ProductOptions()
    rotate = next(p for p in LOADED["render"].params if "--rotate" in p.opts)
    memory = next(p for p in LOADED["render"].params if "--memory" in p.opts)
    assert rotate.type.convert("180", None, None) == pytest.approx(3.14159265)
    assert rotate.default == "0.0"
    assert memory.type.convert(memory.default, None, None) == shown.memory_bytes

"""Sections of a command's help, and which options only `--help-all` shows.

To add an option, put its declaration into a `section`, or an `expert` one, of its subject: nothing
else decides where help lists it. `--help` shows the first sentence of each option that is not for
experts, on one line: keep it below 50 characters, and the help of a command below 40 lines.
"""

from __future__ import annotations

from typing import Any

import click

from slamcli.cli.options.fields import Decorator, stacked

ESSENTIAL = "Options"
CAMERA = "Camera"
SENSORS = "Sensors"
OUTPUT = "Output"
PERFORMANCE = "Performance"
MAPPING = "Mapping"
FEATURES = "Feature points"
MATCHING = "Matching"
FLOOR = "Floor"
IMAGING = "Imaging"
DISTURBANCES = "Disturbances"
# In the order in which help shows them; others follow.
SECTIONS = (
    ESSENTIAL,
    CAMERA,
    SENSORS,
    OUTPUT,
    PERFORMANCE,
    MAPPING,
    FEATURES,
    MATCHING,
    FLOOR,
    IMAGING,
    DISTURBANCES,
)
_SECTION, _EXPERT = "slam_section", "slam_expert"


def section(name: str, *options: Decorator[Any], expert: bool = False) -> Decorator[Any]:
    """Return one decorator for options of a section of the help; an inner section goes first."""

    def decorate(command: Any) -> Any:
        before = len(getattr(command, "__click_params__", ()))
        decorated = stacked(*options)(command)
        for parameter in getattr(decorated, "__click_params__", ())[before:]:
            vars(parameter).setdefault(_SECTION, name)
            vars(parameter).setdefault(_EXPERT, expert)
        return decorated

    return decorate


def expert(name: str, *options: Decorator[Any]) -> Decorator[Any]:
    """Return one decorator for options of a section that only `--help-all` shows."""
    return section(name, *options, expert=True)


def section_of(parameter: click.Parameter) -> str:
    """Return the section of an option."""
    return str(vars(parameter).get(_SECTION, ESSENTIAL))


def is_expert(parameter: click.Parameter) -> bool:
    """Return whether only `--help-all` shows an option."""
    return bool(vars(parameter).get(_EXPERT, False))

"""Options that fill the fields of a dataclass: flag, default and destination in one definition."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slamcli.cli.options.values import Value

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Options = TypeVar("Options", bound=DataclassInstance)

Command = TypeVar("Command", bound=Callable[..., Any])

Decorator = Callable[[Command], Command]


def destination(group: DataclassInstance | str, field: str) -> str:
    """Return the name under which click passes on the value of a field."""
    return f"{group if isinstance(group, str) else type(group).__name__}_{field}"


def option(
    group: DataclassInstance | str,
    field: str,
    flag: str,
    kind: click.ParamType[Any] | None = None,
    text: str = "",
    **attributes: Any,
) -> Decorator[Any]:
    """Return the option whose value `filled` puts into a field of a dataclass.

    Parameters
    ----------
    group : dataclass instance or str
        Its field is the default, written as the option takes it. Only the class's name where the
        class would load numpy: then there is no default, unless `attributes` gives one.
    attributes
        As `click.option` takes them.
    """
    if not isinstance(group, str):
        default = getattr(group, field)
        attributes["default"] = kind.text(default) if isinstance(kind, Value) else default
        attributes["is_flag"] = isinstance(default, bool)
    attributes.setdefault("show_default", attributes.get("default", "") != "")
    return click.option(flag, destination(group, field), type=kind, help=text, **attributes)


def filled(start: Options, flags: Mapping[str, Any]) -> Options:
    """Return the dataclass with the values of the flags; nested dataclasses are filled as well.

    Parameters
    ----------
    start : dataclass instance
        Its own values stay where no flag is defined.
    flags : mapping of str
        Values by `destination`, as click passes them.
    """
    changes: dict[str, Any] = {}
    for field in fields(start):
        name, value = destination(start, field.name), getattr(start, field.name)
        if name in flags:
            changes[field.name] = flags[name]
        elif is_dataclass(value) and not isinstance(value, type):
            changes[field.name] = filled(value, flags)
    return replace(start, **changes)


def stacked(*decorators: Decorator[Any]) -> Decorator[Any]:
    """Return one decorator for several options, shown in the order given."""

    def decorate(command: Any) -> Any:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate

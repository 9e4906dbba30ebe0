"""What the documentation takes from the code at build time: all options, all public names."""

from __future__ import annotations

import inspect
from typing import Any

import click

import slamcli
from slamcli.cli.main import main


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the markers of a page by what the code says (an event of MkDocs)."""
    for marker, text in (("<!-- options -->", options), ("<!-- api -->", api)):
        if marker in markdown:
            markdown = markdown.replace(marker, text())
    return markdown


def options() -> str:
    """Return one section a command: its usage, its help text and a table of its options."""
    group = click.Context(main, info_name="slam")
    sections = []
    for name in main.list_commands(group):
        command = main.get_command(group, name)
        assert command is not None
        context = click.Context(command, parent=group, info_name=name)
        records = [p.get_help_record(context) for p in command.get_params(context)]
        rows = [f"| `{names}` | {_cell(text)} |" for names, text in filter(None, records)]
        usage = command.get_usage(context).removeprefix("Usage: ")
        table = "| option | meaning |\n|---|---|\n" + "\n".join(rows)
        help_text = inspect.cleandoc(command.help or "")
        sections.append(f"## slam {name}\n\n`{usage}`\n\n{help_text}\n\n{table}")
    return "\n\n".join(sections)


def api() -> str:
    """Return a directive of mkdocstrings for every public name, in the order of `__all__`."""
    found = [(name, getattr(slamcli, name)) for name in slamcli.__all__]
    return "\n\n".join(f"::: {thing.__module__}.{name}" for name, thing in found if callable(thing))


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())

"""The command line that repeats a run: what was given, without what does not change the result."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Any

import click

# Where results go, how quickly, and what becomes of earlier ones.
_LEFT_OUT = {
    "output",
    "overwrite",
    "StitchOptions_resume",
    "scheduler",
    "workers",
    "as_json",
    "verbose",
    "quiet",
    "log_file",
}
_WORDS = "slamcli.words"


def remember(context: click.Context, words: Sequence[str]) -> None:
    """Keep the words that a command is called with, for `repeating`."""
    context.meta[_WORDS] = list(words)


def repeating(context: click.Context) -> str:
    """Return a command line with the arguments and options as the user gave them."""
    given, _, _ = context.command.make_parser(context).parse_args(list(context.meta[_WORDS]))
    arguments, options = list[str](), list[str]()
    for parameter in context.command.params:
        value = given.get(parameter.name or "")
        if parameter.name in _LEFT_OUT or value is None:
            continue
        if isinstance(parameter, click.Option):
            options += _words(parameter, value)
        elif isinstance(value, str | list | tuple):  # else it comes from --config
            arguments += [value] if isinstance(value, str) else value
    return shlex.join(["slam", context.command.name or "", *arguments, *options])


def _words(option: click.Option, value: Any) -> list[str]:
    """Return an option as it may be given."""
    long, off = (max(names, key=len, default="") for names in (option.opts, option.secondary_opts))
    if option.is_flag:
        return [long if value else off]
    return [long, *value] if isinstance(value, list | tuple) else [long, value]

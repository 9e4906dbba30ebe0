"""The kind of all commands: sections in the help, options from a file, messages, both spellings."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from slamcli.cli.configuration import config_option, configuration_of
from slamcli.cli.messages import message_options, messages
from slamcli.cli.options.fields import stacked
from slamcli.cli.options.sections import SECTIONS, is_expert, section_of
from slamcli.cli.options.values import Switch
from slamcli.core.errors import OutputError

# With more lines --help has its short form.
_MAX_LINES = 40
# Width of the names in the short help, and of what stands before and after its texts.
_NAMES_WIDTH = 27
_INDENT = 2
_HELP_ALL = "help_all"
# Parameters that name what is written.
_OUTPUTS = {"output", "plot", "table", "rerun", "record"}


class SlamCommand(click.Command):
    """A command whose help has sections, and a short form without the options for experts."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; flags that may have a value are given one first."""
        return super().parse_args(ctx, self.spelled_out(args))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; its log and its configuration are no other file of it."""
        _check_own_files(ctx)
        return super().invoke(ctx)

    def spelled_out(self, arguments: list[str]) -> list[str]:
        """Return the arguments, with the value of each flag that may go without one."""
        for option in self.params:
            if isinstance(option.type, Switch):
                arguments = option.type.spelled_out(option.opts[0], arguments)
        return arguments

    def get_help_option(self, ctx: click.Context) -> click.Option | None:
        """Return the -h option."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.help = "Show this help; --help-all has all options."
        return option

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, by section; the short form where all would be more than a page."""
        shown = [p for p in self.get_params(ctx) if isinstance(p, click.Option) and not p.hidden]
        names = dict.fromkeys([*SECTIONS, *(section_of(option) for option in shown)])
        sections = {name: [o for o in shown if section_of(o) == name] for name in names}
        whole = click.HelpFormatter(width=formatter.width)
        _write_whole(ctx, whole, sections)
        lines = f"{formatter.getvalue()}{whole.getvalue()}".splitlines()
        if len(lines) <= _MAX_LINES or ctx.meta.get(__name__):
            formatter.write(whole.getvalue())
            return
        formatter.write_paragraph()
        for name, members in sections.items():
            members = [one for one in members if not is_expert(one)]
            _write_short(formatter, name, [one for one in members if one.name != _HELP_ALL])


def command() -> Callable[[Any], click.Command]:
    """Return the decorator of a function as a command of `slam`."""

    def decorate(function: Any) -> click.Command:
        with_common = stacked(config_option, message_options, _help_all)
        settings = {"token_normalize_func": british}
        # The options common to all commands come after the command's own.
        own = list(getattr(function, "__click_params__", ()))
        function.__click_params__ = []
        with_common(function)
        function.__click_params__ += own
        return click.command(cls=SlamCommand, context_settings=settings)(function)

    return decorate


def _check_own_files(ctx: click.Context) -> None:
    """Refuse a log that is an input or output, and an output that is the file of --config.

    Raises
    ------
    OutputError
    """
    given = {name: _paths_of(value) for name, value in ctx.params.items()}
    log = messages().log_path
    if log is not None and any(_is_same(log, path) for paths in given.values() for path in paths):
        raise OutputError(f"cannot write the log {log}: the command uses it; name another one")
    read = configuration_of(ctx)
    for name in _OUTPUTS & given.keys():
        for path in given[name]:
            if read is not None and _is_same(read, path):
                raise OutputError(
                    f"cannot write {path}: it is an input of this command; name another --output"
                )


def _paths_of(value: object) -> list[Path]:
    values = value if isinstance(value, (list, tuple)) else [value]
    return [one for one in values if isinstance(one, Path)]


def _is_same(a: Path, b: Path) -> bool:
    return a.resolve() == b.resolve() or (a.exists() and b.exists() and a.samefile(b))


def british(name: str) -> str:
    """Return the name of an option as it is defined: British spelling, and hyphens."""
    return name.replace("meters", "metres").replace("_per_", "-per-")


def _show_all(ctx: click.Context, _option: click.Parameter, value: bool) -> None:
    """Print the help with all options and end."""
    if value and not ctx.resilient_parsing:
        ctx.meta[__name__] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


_help_all = click.option(
    "--help-all",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_all,
    help="Show all options, with their defaults.",
)


def _write_whole(
    ctx: click.Context, formatter: click.HelpFormatter, sections: Mapping[str, list[click.Option]]
) -> None:
    """Write all options with their whole texts, by section."""
    for name, members in sections.items():
        records = [record for one in members if (record := one.get_help_record(ctx)) is not None]
        if records:
            with formatter.section(name):
                formatter.write_dl(records)


def _write_short(formatter: click.HelpFormatter, name: str, options: list[click.Option]) -> None:
    """Write a section of the short help: one line an option, with its text's first sentence."""
    if not options:
        return
    formatter.write(f"{click.style(f'{name}:', bold=True)}\n")
    for option in options:
        names = _short_names(option)
        text = (option.help or "").split(". ")[0].removesuffix(".")
        width = formatter.width - _INDENT - _NAMES_WIDTH
        first, *others = textwrap.wrap(text, width) or [""]
        formatter.write(f"{'':{_INDENT}}{names:<{_NAMES_WIDTH - 1}} {first}\n")
        for line in others:
            formatter.write(f"{'':{_INDENT + _NAMES_WIDTH}}{line}\n")


def _short_names(option: click.Option) -> str:
    """Return an option's names; of a pair --x/--no-x the one that changes the default."""
    if option.secondary_opts:
        return (option.secondary_opts if option.default is True else option.opts)[0]
    names = ", ".join(sorted(option.opts, key=len))
    if option.is_flag or option.count:
        return names
    kind = option.metavar or option.type.get_metavar(option, click.Context(click.Command(None)))
    kind = kind or option.type.name.upper().removesuffix(" RANGE")
    whole = f"{names} {kind}"
    return whole if len(whole) < _NAMES_WIDTH else f"{names} ..."

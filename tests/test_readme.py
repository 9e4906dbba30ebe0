"""README and documentation: every command line, option and link in them works as printed."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import click
import pytest

from slamcli.cli.main import main

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
MAX_README_WORDS = 1000
PAGES = sorted((ROOT / "docs").rglob("*.md"))
DOCUMENTS = [
    README,
    ROOT / "CONTRIBUTING.md",
    ROOT / "samples" / "README.md",
    ROOT / "calibration" / "README.md",
    *PAGES,
]
# Of other programs, which the pages name; and an American spelling, which is taken as well.
OTHER_OPTIONS = {"--nthreads", "--once", "--meters-per-pixel"}


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def lines_of(path: Path) -> list[str]:
    """Return the command lines of a page's blocks, and those within its sentences."""
    text = text_of(path)
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", text, re.M | re.S)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("slam ")]


LINES = [
    pytest.param(line, id=f"{path.relative_to(ROOT)}: {line}")
    for path in DOCUMENTS
    for line in dict.fromkeys(lines_of(path))
]


def command_named(name: str) -> click.Command:
    command = main.get_command(click.Context(main), name)
    assert command is not None, name
    return command


def test_every_command_stands_in_the_readme() -> None:
    for name in main.list_commands(click.Context(main)):
        assert f"`slam {name}`" in text_of(README)


def test_the_readme_is_short() -> None:
    assert len(text_of(README).split()) <= MAX_README_WORDS


@pytest.mark.parametrize("line", LINES)
def test_every_command_line_is_accepted(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = shlex.split(line, comments=True)[1:]
    if words[-1] in {"--help", "--version"}:
        return
    monkeypatch.chdir(tmp_path)
    if "--config" in words:
        file = Path(words[words.index("--config") + 1])
        file.parent.mkdir(exist_ok=True)
        file.write_text('version = "0"\nsources = ["frames"]\n[options]\n', encoding="utf-8")
    command_named(words[0]).make_context(words[0], words[1:], parent=click.Context(main))


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_option_within_a_sentence_is_there(path: Path) -> None:
    context = click.Context(main)
    commands = [command_named(name) for name in main.list_commands(context)]
    known = {
        word
        for command in [main, *commands]
        for parameter in command.get_params(context)
        for word in (*parameter.opts, *parameter.secondary_opts)
    }
    prose = re.sub(r"^```.*?^```", "", text_of(path), flags=re.M | re.S)
    for code in re.findall(r"`([^`]+)`", prose):
        for word in re.findall(r"(?<![\w-])--[a-z][a-z-]+", code):
            assert word in known | OTHER_OPTIONS, word


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_to_a_file(path: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text_of(path)):
        if not target.startswith(("http://", "https://")):
            assert (path.parent / target).exists(), target


def test_every_file_that_the_pages_name_in_the_package_is_there() -> None:
    for path in (ROOT / "CONTRIBUTING.md", *PAGES):
        for name in re.findall(r"`(?:slamcli/)?([a-z_0-9/]+(?:/|\.py))`", text_of(path)):
            places = (ROOT / "slamcli" / name, ROOT / name, ROOT / "examples" / name)
            folder = name.split("/")[0]
            if (ROOT / "slamcli" / folder).is_dir() or name.endswith(".py"):
                assert any(place.exists() for place in places), f"{path.name}: {name}"


def test_every_number_of_the_readmes_results_is_in_the_benchmarks() -> None:
    results = text_of(README).partition("## Results")[2].partition("\n## ")[0]
    rows = [line for line in results.splitlines() if line.startswith("|")]
    assert len(rows) > 10
    measured = text_of(ROOT / "benchmarks" / "README.md")
    for row in rows:
        for number in re.findall(r"\d+(?:\.\d+|/\d+)", row):
            assert number in measured, row


def test_the_make_targets_are_there() -> None:
    makefile = text_of(ROOT / "Makefile")
    named = {
        target
        for path in [*DOCUMENTS, *(ROOT / ".github").rglob("*.yml")]
        for target in re.findall(r"(?:^|`|run: )make ([a-z-]+)", text_of(path), re.M)
    }
    assert {"demo", "test", "docs", "samples"} <= named
    for target in named:
        assert f"\n{target}:" in makefile, target
    assert "make test" in text_of(ROOT / ".ci" / "run")


def test_the_extras_that_the_pages_name_are_there() -> None:
    extras = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]["optional-dependencies"]
    for path in DOCUMENTS:
        for extra in re.findall(r"slamcli\[([a-z]+)\]", text_of(path)):
            assert extra in extras

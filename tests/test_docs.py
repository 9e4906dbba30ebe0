"""The documentation: complete beside the code, small pictures, and a build without a warning."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cv2
import pytest

import slamcli

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
IMAGES = sorted((DOCS / "images").iterdir())
MAX_IMAGE_BYTES = 150_000


def loaded(name: str) -> ModuleType:
    """Return a script of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_troubleshooting_has_every_message_of_the_code_and_no_other() -> None:
    """`python docs/messages.py` prints the difference."""
    messages = loaded("messages")
    code, page = messages.messages(), messages.documented()
    assert len(code) > 150
    assert not code - page, "docs/troubleshooting.md lacks these"
    assert not page - code, "docs/troubleshooting.md has these, and the code has not"


def test_a_new_message_would_be_found() -> None:
    """The comparison sees errors, and reasons given as plain sentences, with values as dots."""
    messages = loaded("messages")
    source = 'raise InputError(f"{path} is not a good {kind} of file")\n'
    tree = messages.ast.parse(source)
    assert list(messages._of_errors(tree)) == ["… is not a good … of file"]
    reason = messages.ast.parse(
        'def gate():\n    """Doc of it."""\n    return "the fit is too bad"'
    )
    assert list(messages._sentences(reason)) == ["the fit is too bad"]


@pytest.mark.parametrize("path", IMAGES, ids=lambda path: path.name)
def test_a_picture_is_small_and_shown(path: Path) -> None:
    assert path.stat().st_size <= MAX_IMAGE_BYTES
    assert cv2.imread(str(path)) is not None
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    assert any(f"images/{path.name})" in page.read_text(encoding="utf-8") for page in pages)
    assert f'"{path.name}"' in (DOCS / "figures.py").read_text(encoding="utf-8")


def test_every_page_is_in_the_navigation() -> None:
    named = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    assert named == {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}


def test_options_and_api_come_from_the_code() -> None:
    hooks = loaded("hooks")
    options = hooks.on_page_markdown("<!-- options -->", page=None)
    assert "## slam stitch" in options
    assert "| `--max-step FLOAT" in options
    api = hooks.on_page_markdown("<!-- api -->", page=None)
    for name in slamcli.__all__:
        assert f".{name}\n" in f"{api}\n" or name.startswith("__")


def test_it_builds_without_a_warning_and_fetches_nothing_when_viewed(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="needs mkdocs: pip install slamcli[docs], or make docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    fetched = re.compile(r"<(?:script|link|img)[^>]+(?:src|href)=\"(?:https?:)?//[^\"]+\"")
    for page in tmp_path.rglob("*.html"):
        assert not fetched.findall(page.read_text(encoding="utf-8")), page.name

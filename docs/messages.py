"""Every message by which the code refuses something, for docs/troubleshooting.md.

`python docs/messages.py` prints those that the page lacks, and those of the page that are gone from
the code; tests/test_docs.py holds that there are none. A value that a message fills in is `…`.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "slamcli"
PAGE = ROOT / "docs" / "troubleshooting.md"
VALUE = "…"
# The text of these is a line that the user sees.
ERRORS = {
    "CalibrationError",
    "FieldError",
    "FrameError",
    "InputError",
    "MapError",
    "OutputError",
}
# Where a frame, a motion or a camera is accepted or rejected: a sentence there is a reason.
DECIDING = (
    "io/frames.py",
    "io/networks.py",
    "mapping/",
    "registration/",
    "run/match/fitting.py",
    "selfcal/",
    "run/stitch/lost_in_survey.py",
    "stages/align/",
    "survey/",
)
# Names of the confidence model's inputs, and what changed in a camera: no reasons.
NOT_REASONS = ("registration/confidence.py", "selfcal/apply.py")
MIN_WORDS = 4


def messages() -> set[str]:
    """Return the messages of the code, their values as `…`."""
    found: set[str] = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found |= {text for text in _of_errors(tree) if _has_words(text, 2)}
        if name.startswith(DECIDING) and name not in NOT_REASONS:
            found |= {text for text in _sentences(tree) if _has_words(text, MIN_WORDS)}
    return found


def documented() -> set[str]:
    """Return the messages in the first column of the page's tables."""
    cells = re.findall(r"^\|(.*?)\|", PAGE.read_text(encoding="utf-8"), re.M)
    return {text for cell in cells for text in re.findall(r"`([^`]+)`", cell)}


def _of_errors(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args:
            # A FieldError takes the name of the field, and the rest of the sentence.
            text = _text(node.args[-1])
            if node.func.id in ERRORS and text:
                yield f"{VALUE} {text}" if node.func.id == "FieldError" else text


def _sentences(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return  # a docstring
    text = _text(node)
    if text is not None:
        yield text
        return
    for child in ast.iter_child_nodes(node):
        yield from _sentences(child)


def _text(node: ast.AST) -> str | None:
    """Return a string with its values as `…`; None for what is none."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        text = node.value
    elif isinstance(node, ast.JoinedStr):
        text = "".join(str(v.value) if isinstance(v, ast.Constant) else VALUE for v in node.values)
    else:
        return None
    return " ".join(text.replace("`", "'").replace("|", "/").split())


def _has_words(text: str, least: int) -> bool:
    """Return whether so many words, of which half are not values, make it a sentence."""
    words = re.findall(r"[^\W\d_]{2,}", text)
    return len(words) >= min(least, 2) and len(text.split()) >= least


def main() -> int:
    """Print what the page lacks, and what it has too much; return 1 when there is any."""
    code, page = messages(), documented()
    for text in sorted(code - page):
        print(f"lacking: {text}")
    for text in sorted(page - code):
        print(f"gone:    {text}")
    return int(code != page)


if __name__ == "__main__":
    sys.exit(main())

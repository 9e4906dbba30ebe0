"""What is shipped: everything that is kept under version control, and nothing else."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# The build itself takes these.
BY_THE_BUILD = {"slamcli", "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in", ".gitignore"}


def test_the_source_distribution_has_all_files() -> None:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no working tree")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, check=True)
    tops = {name.split("/")[0] for name in listed.stdout.decode().splitlines()}
    manifest = (ROOT / "MANIFEST.in").read_text(encoding="utf-8")
    named = set(re.sub(r"#.*|^\w*-?\w+ ", "", manifest, flags=re.M).split())
    assert tops - BY_THE_BUILD <= named


def test_the_container_installs_extras_that_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = re.search(r'"\.\[(.*)\]"', (ROOT / "Dockerfile").read_text(encoding="utf-8"))
    assert extras is not None
    assert set(extras[1].split(",")) <= set(project["optional-dependencies"])
    minors = [line[-2:] for line in project["classifiers"] if ":: 3." in line]
    assert minors == ["11", "12", "13", "14"]

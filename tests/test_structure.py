"""The floors of the house: a module imports only what stands below it; stages are strangers."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamcli.cli import entry
from slamcli.cli.main import main

PACKAGE = Path(__file__).resolve().parent.parent / "slamcli"
FLOORS = {
    "core": 1,
    "stages": 2,
    "io": 2,
    "simulation": 2,
    "drawing": 2,
    "registration": 3,
    "selfcal": 3,
    "mapping": 4,
    "run": 5,
    "cli": 6,
    "__main__": 7,
}
TOP = max(FLOORS.values())
ONE_ROOM = {
    "dask": ("run/session/cluster",),
    "distributed": ("run/session/cluster",),
    "gtsam": (),
    "pyproj": ("stages/geodesy",),
    "rasterio": ("io/raster/geotiff",),
    "tqdm": ("cli/progress",),
    "click": ("cli",),
}
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


def imports_of(module: Path) -> set[str]:
    tree = ast.parse((PACKAGE / module).read_text(encoding="utf-8"))
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            assert node.module
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def room_of(parts: tuple[str, ...]) -> str:
    return parts[0].removesuffix(".py")


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_a_module_imports_only_what_stands_below_it(module: Path) -> None:
    room = room_of(module.parts)
    if room == "__init__":
        return
    for name in imports_of(module):
        parts = tuple(name.split("."))
        if parts[0] != "slamcli" or parts[1] in {"__version__"}:
            continue
        if len(parts) > 1 and parts[1] in FLOORS:
            other = parts[1]
            allowed = FLOORS[other] < FLOORS[room] or other == room or FLOORS[room] == TOP
            assert allowed, f"{module} (floor {FLOORS[room]}) imports {name}"


@pytest.mark.parametrize("module", [m for m in MODULES if m.parts[0] == "stages"], ids=str)
def test_stages_are_strangers(module: Path) -> None:
    stage = room_of(module.parts[1:])
    for name in imports_of(module):
        parts = name.split(".")
        if parts[:2] == ["slamcli", "stages"] and len(parts) > 2:
            assert parts[2] == stage, f"{module} imports {name}"


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_an_outside_library_lives_in_its_room(module: Path) -> None:
    places = {module.with_suffix("").as_posix(), room_of(module.parts)}
    for name in imports_of(module):
        rooms = ONE_ROOM.get(name.split(".")[0])
        if rooms is not None:
            assert places & set(rooms), f"{module} imports {name}"


def loaded_by(statements: str) -> set[str]:
    """Return the modules that a fresh Python has loaded after some statements."""
    code = f"import sys\n{statements}\nprint(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(done.stderr.split())


def test_help_loads_no_heavy_library() -> None:
    plain = loaded_by("from slamcli.cli.entry import main; sys.argv = ['slam', '--help']; main()")
    assert not {"click", "cv2", "numpy", "typing"} & plain
    commands = loaded_by("import slamcli.cli.main")
    assert not {"cv2", "numpy", "scipy", "gtsam", "imageio", "tqdm", "yaml"} & commands


def test_the_ready_help_is_what_click_would_print() -> None:
    printed = CliRunner().invoke(main, ["--help"], prog_name="slam", terminal_width=80)
    assert printed.output == entry.HELP


@pytest.mark.parametrize(("given", "kept"), [(None, "1"), ("3", "3")])
def test_linear_algebra_keeps_to_one_thread_unless_told_otherwise(
    given: str | None, kept: str
) -> None:
    """Set before numpy is loaded, which reads it then."""
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    environment |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
    code = (
        "import os, sys; from slamcli.cli.entry import main; assert 'numpy' not in sys.modules\n"
        "sys.argv = ['slam', '--version']\n"
        "try:\n    main()\nexcept SystemExit:\n    print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment
    )
    assert done.stdout.split()[-1] == kept

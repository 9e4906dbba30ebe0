"""The floors of the package: which module imports which, and what `slam --help` loads."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import slamcli

PACKAGE = Path(__file__).resolve().parent.parent / "slamcli"
FLOORS = {
    "core": 1,
    "stages": 2,
    "io": 2,
    "simulation": 2,
    "drawing": 2,
    "registration": 3,
    "selfcal": 3,
    "survey": 3,
    "mapping": 4,
    "run": 5,
    "cli": 6,
    "__main__": 7,
}
TOP = max(FLOORS.values())
ONE_ROOM = {
    "av": ("io/containers/video",),
    "imageio": ("io/containers/pages",),
    "pillow_heif": ("io/containers/heic",),
    "rerun": ("io/rerun_recording",),
    "rosbags": ("io/containers/bag", "io/containers/bag_compression"),
    "dask": ("run/session/cluster",),
    "distributed": ("run/session/cluster",),
    "gtsam": (),
    "pyproj": ("stages/geodesy",),
    "simplejpeg": ("io/images/jpeg",),
    "rasterio": ("io/raster/geotiff",),
    "matplotlib": ("drawing/errors",),
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


def test_all_modules_are_in_folders() -> None:
    files = {path.name for path in PACKAGE.iterdir() if path.is_file()}
    assert files == {"__init__.py", "__init__.pyi", "__main__.py", "py.typed"}


def test_there_are_few_floors() -> None:
    assert TOP <= 8
    folders = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert folders == set(FLOORS) - {"__main__"}


def name_of(module: Path) -> str:
    return ".".join(("slamcli", *module.with_suffix("").parts)).removesuffix(".__init__")


def import_graph() -> dict[str, set[str]]:
    """Return the modules that each module imports, wherever in it and for whatever purpose."""
    names = {name_of(module) for module in MODULES}
    graph: dict[str, set[str]] = {}
    for module in MODULES:
        found = imports_of(module)
        owners = {name if name in names else name.rpartition(".")[0] for name in found}
        graph[name_of(module)] = (owners & names) - {name_of(module)}
    return graph


def find_circle(graph: dict[str, set[str]]) -> list[str]:
    """Return modules of which each imports the next, the last one the first; or nothing."""
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return path[path.index(name) :]
        if name in done:
            return []
        for other in sorted(graph[name]):
            if circle := visit(other, [*path, name]):
                return circle
        done.add(name)
        return []

    return next((circle for name in sorted(graph) if (circle := visit(name, []))), [])


def test_there_is_no_import_circle() -> None:
    graph = import_graph()
    assert len(graph["slamcli.mapping.mapper"]) > 3
    assert find_circle(graph) == []
    assert find_circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]


def loaded_by(statements: str) -> set[str]:
    """Return the modules that a fresh Python has loaded after some statements."""
    code = f"import sys\n{statements}\nprint(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(done.stderr.split())


HEAVY = {"cv2", "numpy", "scipy", "gtsam", "simplejpeg", "tqdm", "yaml", "imageio", "PIL"}
RUN_MAIN = "from slamcli.cli.entry import main\ntry:\n    main()\nexcept SystemExit:\n    pass"


@pytest.mark.parametrize("flag", ["--help", "--version"])
def test_help_and_version_load_neither_heavy_libraries_nor_any_command(flag: str) -> None:
    """`slam --help` is to take at most five times as long as Python's own start."""
    loaded = loaded_by(f"sys.argv = ['slam', '{flag}']\n{RUN_MAIN}")
    assert "slamcli.cli.main" in loaded
    assert not HEAVY & loaded
    own = {name for name in loaded if name.startswith("slamcli.")}
    assert own <= {
        *("slamcli.cli", "slamcli.cli.entry", "slamcli.cli.main", "slamcli.cli.streams"),
        *("slamcli.core", "slamcli.core.errors", "slamcli.core.exit_codes"),
    }


def test_the_help_of_a_command_loads_no_heavy_library() -> None:
    commands = sorted(path.stem for path in (PACKAGE / "cli").glob("*.py"))
    names = [name for name in commands if name not in {"__init__", "progress"}]
    assert len(names) > 9
    assert not HEAVY & loaded_by("\n".join(f"import slamcli.cli.{name}" for name in names))


def test_the_public_names_are_the_same_for_running_code_and_for_type_checkers() -> None:
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    in_stub = {alias.name: node.module for node in imports for alias in node.names}
    assert all(alias.asname == alias.name for node in imports for alias in node.names)
    assert in_stub == slamcli._MODULES
    assert slamcli.__all__ == sorted(["__version__", *in_stub])
    for name in slamcli.__all__:
        assert getattr(slamcli, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        _ = slamcli.nothing
    data = (PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8")
    assert 'slamcli = ["py.typed", "__init__.pyi"]' in data


@pytest.mark.parametrize(("given", "kept"), [(None, "1"), ("3", "3")])
def test_linear_algebra_has_one_thread_unless_the_environment_says_otherwise(
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

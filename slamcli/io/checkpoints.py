"""Checkpoints: the state of an unfinished run, in a hidden folder of its output, to resume it."""

from __future__ import annotations

import hashlib
import io
import pickle
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from slamcli.core.errors import OutputError, SlamcliError
from slamcli.io.files import write_bytes, write_text

_FOLDER = ".resume"
_KEY, _STATE = "run.txt", "mapper.pickle"
# A state is read back from a folder that others may have written to: only these are loaded.
_PATHS = {"PosixPath", "WindowsPath"}
_ALLOWED = {
    "pathlib": _PATHS,
    "pathlib._local": _PATHS,
    "builtins": {"set", "frozenset", "slice", "range", "complex", "bytearray"},
    "collections": {"OrderedDict", "deque", "defaultdict"},
    "numpy": {"ndarray", "dtype", "bool_"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
}


class Checkpoint:
    """The saved state of one run, in its output until that is complete; a context manager.

    It is deleted on success, and on an error that is reported to the user; a killed program leaves
    it for the next run.

    Parameters
    ----------
    folder : Path
        Of the output.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / _FOLDER
        self._key = ""
        self._kept = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        if not self._kept and (error is None or isinstance(error, SlamcliError)):
            self.close()

    def keep(self) -> None:
        """Do not delete the state at the end: the user has interrupted the run."""
        self._kept = True

    @property
    def tiles(self) -> Path:
        """Where finished tiles are kept."""
        return self.folder / "tiles"

    @property
    def drawings(self) -> Path:
        """Where drawings are kept until the run is complete."""
        return self.folder / "matches"

    def open(self, key: str, *, resume: bool) -> bool:
        """Begin a run; return whether an earlier one of the same key can be resumed.

        The state of any other earlier run is deleted.
        """
        self._key = key
        path = self.folder / _KEY
        same = resume and path.is_file() and path.read_text(encoding="utf-8") == key
        if not same:
            self.close()
        return same

    def save(self, state: object) -> None:
        """Write a state, in place of the one before."""
        if not (self.folder / _KEY).is_file():
            write_text(self.folder / _KEY, self._key)
        write_bytes(self.folder / _STATE, pickle.dumps(state, protocol=pickle.HIGHEST_PROTOCOL))

    def load(self) -> object | None:
        """Return the state written last; None when there is none that can be read."""
        try:
            data = (self.folder / _STATE).read_bytes()
            return _Unpickler(io.BytesIO(data)).load()  # type: ignore[no-any-return]
        except FileNotFoundError:
            return None
        except (OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
            return None

    def close(self) -> None:
        """Delete the state, the tiles and the drawings."""
        try:
            if self.folder.exists():
                shutil.rmtree(self.folder)
        except OSError as error:
            raise OutputError(f"cannot delete {self.folder}: {error.strerror or error}") from error


def run_key(options: str, paths: Sequence[Path]) -> str:
    """Return a digest that identifies a run: its options, its files by name, size and time."""
    digest = hashlib.sha256(options.encode())
    for path in paths:
        try:
            status = path.stat()
            entry = f"{path.absolute()}\n{status.st_size}\n{status.st_mtime_ns}\n"
        except OSError:
            entry = f"{path.absolute()}\n-\n"
        digest.update(entry.encode())
    return digest.hexdigest() + "\n"


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return a class of this package or a plain container; refuse all else."""
        if module == "slamcli" or module.startswith("slamcli."):
            return super().find_class(module, name)
        if name in _ALLOWED.get(module, ()):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in a run's state")

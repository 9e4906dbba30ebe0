"""Checkpoints: the state of an unfinished run, in a hidden folder of its output, to resume it."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from slamcli.core.arrays import AnyArray
from slamcli.core.errors import InputError, OutputError
from slamcli.io.array_file import read_arrays, write_arrays

_FOLDER = ".resume"
# The state that was saved last, and the one before it, for when the last is damaged.
_STATE, _EARLIER = "mapper.state", "mapper.earlier"
_MAGIC = b"slamcli state 1\n"
_TILES = "tiles"


class Checkpoint:
    """The saved state of one run, in its output until that is complete; a context manager.

    It is deleted by a run that is complete, and by nothing else but `begin` with `overwrite`.

    Parameters
    ----------
    output : Path
        Folder, locked by this run.
    """

    def __init__(self, output: Path) -> None:
        self.folder = output / _FOLDER
        self._output = output
        self._key = ""
        self._kept = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        if not self._kept and (error is None or self._is_empty()):
            self.close()

    def _is_empty(self) -> bool:
        """Return whether nothing was located and nothing painted."""
        header, _, _ = self._read()
        if header is None:
            return not any(path.exists() for path in self._paths)
        return header.get("located") == 0 and not (self.folder / _TILES).exists()

    def keep(self) -> None:
        """Do not delete the state at the end: the run is not complete."""
        self._kept = True

    def tiles(self, options: str) -> Path:
        """Return where finished tiles are kept that were painted with some options."""
        digest = hashlib.sha256((self._key + options).encode("utf-8", "surrogateescape"))
        return self.folder / _TILES / digest.hexdigest()

    @property
    def drawings(self) -> Path:
        """Where drawings are kept until the run is complete."""
        return self.folder / "matches"

    @property
    def state_path(self) -> Path:
        """The file of the state."""
        return self.folder / _STATE

    def begin(self, key: str, *, resume: bool, overwrite: bool) -> bool:
        """Begin a run; return whether an earlier one of the same key is resumed.

        Parameters
        ----------
        key : str
            From `run_key`.
        resume : bool
            Go on with an interrupted run.
        overwrite : bool
            Delete the state of an interrupted run that is not resumed.

        Raises
        ------
        OutputError
            When there is an interrupted run, and neither was given or it is another one.
        """
        self._key = key
        if self.folder.is_symlink():
            raise OutputError(f"cannot write {self.folder}: it is a link; delete it")
        if not any(path.exists() for path in self._paths):
            # Of a run that was killed before its first state was saved.
            self.close()
            return False
        header, _, _ = self._read()
        # Whose a damaged state is cannot be known; its tiles are found by the key.
        same = header is None or header.get("key") == key
        if same and resume:
            return True
        # Where nothing was located, nothing is lost by beginning anew.
        if overwrite or (header is not None and header.get("located") == 0):
            self.close()
            return False
        far = "its saved state is damaged"
        if header is not None:
            far = f"{header.get('located')} of {header.get('total')} located"
        if same:
            raise OutputError(
                f"{self._output} has an interrupted run, {far}: --resume to go on, or "
                "--overwrite to begin anew"
            )
        raise OutputError(
            f"{self._output} has an interrupted run of other frames or options, {far}: repeat "
            "that command with --resume to go on, or --overwrite to begin anew"
        )

    def save(self, state: Mapping[str, AnyArray], located: int, total: int) -> None:
        """Write a state, beside the one before, of a run that has located some of its frames.

        Raises
        ------
        OutputError
        """
        latest, earlier = self._paths
        header = {"key": self._key, "located": located, "total": total}
        try:
            if latest.exists():
                latest.replace(earlier)
        except OSError as error:
            raise OutputError(f"cannot write {latest}: {error.strerror or error}") from error
        write_arrays(latest, _MAGIC, header, state)

    def load(self) -> tuple[dict[str, AnyArray] | None, list[str]]:
        """Return the latest state that can be read, if any, and what is wrong with later ones."""
        _, state, faults = self._read()
        return state, faults

    def close(self) -> None:
        """Delete the state, the tiles and the drawings."""
        try:
            # The states first: without them all else means nothing.
            for path in self._paths:
                path.unlink(missing_ok=True)
            if self.folder.exists():
                shutil.rmtree(self.folder)
        except OSError as error:
            raise OutputError(f"cannot delete {self.folder}: {error.strerror or error}") from error

    @property
    def _paths(self) -> tuple[Path, Path]:
        """The states, the later one first."""
        return self.folder / _STATE, self.folder / _EARLIER

    def _read(self) -> tuple[dict[str, Any] | None, dict[str, AnyArray] | None, list[str]]:
        """Return header and arrays of the latest state that can be read, and all faults."""
        faults: list[str] = []
        for path in filter(Path.exists, self._paths):
            try:
                return *read_arrays(path, _MAGIC), faults
            except InputError as error:
                faults.append(str(error))
        return None, None, faults


def run_key(options: str, paths: Sequence[Path]) -> str:
    """Return a digest that identifies a run: its options, its files by name, size and time."""
    digest = hashlib.sha256(options.encode("utf-8", "surrogateescape"))
    for path in paths:
        try:
            status = path.stat()
            entry = f"\n{status.st_size}\n{status.st_mtime_ns}\n"
        except OSError:
            entry = "\n-\n"
        digest.update(os.fsencode(path.absolute()) + entry.encode())
    return digest.hexdigest() + "\n"

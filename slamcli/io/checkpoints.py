"""Checkpoints: the state of an unfinished run, in a hidden folder of its output, to resume it."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

from slamcli.core.arrays import AnyArray
from slamcli.core.errors import InputError, OutputError
from slamcli.io.array_file import read_arrays, write_arrays
from slamcli.io.files import write_text

_FOLDER = ".resume"
_KEY, _STATE = "run.txt", "mapper.state"
_MAGIC = b"slamcli state 1\n"


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
        if not self._kept and error is None:
            self.close()

    def keep(self) -> None:
        """Do not delete the state at the end: the run is not complete."""
        self._kept = True

    @property
    def tiles(self) -> Path:
        """Where finished tiles are kept."""
        return self.folder / "tiles"

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
        path = self.folder / _KEY
        if not path.is_file():
            # Drawings of a run that was killed before its first state was saved.
            self.close()
            return False
        same = path.read_bytes() == key.encode()
        if same and resume:
            return True
        if overwrite:
            self.close()
            return False
        if same:
            raise OutputError(
                f"{self._output} has an interrupted run, {self._progress()}: --resume to go on, or "
                "--overwrite to begin anew"
            )
        raise OutputError(
            f"{self._output} has an interrupted run of other frames or options, "
            f"{self._progress()}: repeat that command with --resume to go on, or --overwrite to "
            "begin anew"
        )

    def save(self, state: Mapping[str, AnyArray], located: int, total: int) -> None:
        """Write a state, in place of the one before, of a run that has located some of its frames.

        Raises
        ------
        OutputError
        """
        if not (self.folder / _KEY).is_file():
            write_text(self.folder / _KEY, self._key)
        header = {"located": located, "total": total}
        write_arrays(self.state_path, _MAGIC, header, state)

    def load(self) -> dict[str, AnyArray]:
        """Return the state written last.

        Raises
        ------
        InputError
            Names the file when it cannot be read, or is damaged.
        """
        return read_arrays(self.state_path, _MAGIC)[1]

    def close(self) -> None:
        """Delete the state, the tiles and the drawings."""
        try:
            # The key first: without it all else means nothing.
            (self.folder / _KEY).unlink(missing_ok=True)
            if self.folder.exists():
                shutil.rmtree(self.folder)
        except OSError as error:
            raise OutputError(f"cannot delete {self.folder}: {error.strerror or error}") from error

    def _progress(self) -> str:
        """Return how far the interrupted run is."""
        try:
            header, _ = read_arrays(self.state_path, _MAGIC)
        except InputError:
            return "its saved state is damaged"
        return f"{header.get('located')} of {header.get('total')} located"


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

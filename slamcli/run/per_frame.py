"""The skeleton of `slam warp` and `slam detect`: files written for each frame by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from glob import escape
from pathlib import Path
from typing import TypeVar

from slamcli.core.errors import FrameError, InputError
from slamcli.io.frames import FrameFile
from slamcli.io.outputs import output_folder
from slamcli.run.session.session import Session

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Skipped:
    """A frame that could not be used: its name and why."""

    reason: str


@contextmanager
def frame_outputs(
    files: list[FrameFile],
    output: Path,
    suffixes: tuple[str, ...],
    *more: str,
    inputs: Iterable[Path | None],
    overwrite: bool,
) -> Iterator[Path]:
    """Yield a staging folder for files named after each frame's stem and a suffix, and for more.

    Raises
    ------
    InputError, OutputError
        InputError when two frames would write the same file.
    """
    stems = [Path(file.name).stem for file in files]
    if len(set(stems)) < len(stems):
        raise InputError("two frames have the same name; give their folders one at a time")
    products = (*more, *(f"{escape(stem)}{suffix}" for stem in stems for suffix in suffixes))
    with output_folder(output, products, inputs=inputs, overwrite=overwrite) as staging:
        yield staging


def each_frame(
    stage: str, work: Callable[[FrameFile], Result], files: list[FrameFile], session: Session
) -> list[Result | Skipped]:
    """Return ``work(file)`` for every frame, or why it was skipped, in order.

    Raises
    ------
    InputError
        When every frame was skipped.
    """
    results = list(session.stage(stage, partial(_attempt, work), files))
    skipped = [result.reason for result in results if isinstance(result, Skipped)]
    if len(skipped) == len(files):
        raise InputError(f"none of the {len(files)} frames can be used; the first, {skipped[0]}")
    return results


def _attempt(work: Callable[[FrameFile], Result], file: FrameFile) -> Result | Skipped:
    try:
        return work(file)
    except FrameError as error:
        return Skipped(f"{file.name}: {error}")

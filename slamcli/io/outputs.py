"""What a command may write: never over one of its inputs, a link, or what is no file or folder."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from slamcli.core.errors import OutputError
from slamcli.io.files import STAGING_PREFIX, sync_files, sync_folder
from slamcli.io.locks import lock_on


def refuse_existing(path: Path, *, inputs: Iterable[Path | None], overwrite: bool) -> None:
    """Refuse a file to be written that may not be replaced.

    Parameters
    ----------
    path : Path
    inputs : iterable of Path or None
        All that the command reads.
    overwrite : bool
        Whether an earlier result may be replaced.

    Raises
    ------
    OutputError
        When it exists and is a folder, a link, a device, an input, or not to be replaced.
    """
    _refuse_special(path)
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder; name a file")
    if not path.exists():
        return
    _refuse_inputs([path], inputs)
    if not overwrite:
        raise OutputError(f"{path} exists; use --overwrite or another --output")


@contextmanager
def output_folder(
    folder: Path, products: Sequence[str], *, inputs: Iterable[Path | None], overwrite: bool
) -> Iterator[Path]:
    """Lock `folder` and yield a staging folder in it; parameters are those of `staging_folder`."""
    with (
        locked_folder(folder),
        staging_folder(folder, products, inputs=inputs, overwrite=overwrite) as staging,
    ):
        yield staging


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Make an output folder when it is missing, and keep other runs out of it meanwhile.

    One that was made in vain is deleted.

    Raises
    ------
    OutputError
        When it is no folder or a link, cannot be written, or another run writes into it.
    """
    _refuse_special(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"cannot write into {folder}: it is a file; name a folder")
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = lock_on(folder)
        lock.__enter__()
    except OSError as error:
        raise _cannot_write(folder, error) from error
    try:
        yield
    finally:
        lock.__exit__(None, None, None)
        if is_new:
            # Fails where there is something in it.
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def staging_folder(
    folder: Path, products: Sequence[str], *, inputs: Iterable[Path | None], overwrite: bool
) -> Iterator[Path]:
    """Yield an empty staging folder; on success its entries move into `folder`, else it is deleted.

    Those of runs that were killed are deleted, too.

    Parameters
    ----------
    folder : Path
        Where the results go: a `locked_folder`.
    products : sequence of str
        Glob patterns of the names that this command may write into `folder`. One that is there
        already is an error, unless `overwrite`, which removes it. Nothing else is ever touched.
    inputs : iterable of Path or None
        All that the command reads: no product may replace it.

    Raises
    ------
    OutputError
        When the folder cannot be written or has earlier products.
    """
    refuse_earlier(folder, products, inputs=inputs, overwrite=overwrite)
    try:
        for path in folder.glob(f"{STAGING_PREFIX}*"):
            remove_folder(path)
        # tempfile makes its paths absolute; messages have the folder as the user named it.
        staging = folder / Path(tempfile.mkdtemp(dir=folder, prefix=STAGING_PREFIX)).name
    except OSError as error:
        raise _cannot_write(folder, error) from error
    try:
        yield staging
        _publish(staging, folder, products)
    except OSError as error:
        raise _cannot_write(folder, error) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def refuse_earlier(
    folder: Path, products: Sequence[str], *, inputs: Iterable[Path | None], overwrite: bool
) -> None:
    """Refuse a folder whose earlier products may not be replaced, as `staging_folder` does."""
    earlier = _products_in(folder, products)
    _refuse_inputs(earlier, inputs)
    for path in earlier:
        _refuse_special(path)
    if earlier and not overwrite:
        raise OutputError(
            f"{folder} already has {earlier[0].name}; use --overwrite or another --output"
        )


def remove_folder(folder: Path) -> None:
    """Delete a folder that this program made, and all that is in it."""
    shutil.rmtree(folder, ignore_errors=True)


def move_folder(source: Path, target: Path) -> None:
    """Move a folder within one file system; does nothing when there is none."""
    try:
        if source.is_dir():
            source.replace(target)
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from error


def _publish(staging: Path, folder: Path, products: Sequence[str]) -> None:
    """Replace the earlier products of a folder by those in the staging folder."""
    sync_files(staging)
    for path in _products_in(folder, products):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    for path in sorted(staging.iterdir()):
        path.replace(folder / path.name)
    sync_folder(folder)


def _cannot_write(folder: Path, error: OSError) -> OutputError:
    return OutputError(f"cannot write into {folder}: {error.strerror or error}")


def _products_in(folder: Path, products: Sequence[str]) -> list[Path]:
    return sorted({path for pattern in products for path in folder.glob(pattern)})


def _refuse_special(path: Path) -> None:
    """Refuse a link, which would be replaced, and what is neither a file nor a folder."""
    if path.is_symlink():
        raise OutputError(f"cannot write {path}: it is a link; name {path.resolve()} itself")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OutputError(f"cannot write {path}: it is a device or the like; name a file")


def _refuse_inputs(earlier: Sequence[Path], inputs: Iterable[Path | None]) -> None:
    """Refuse outputs that would replace an input, or a folder with one in it."""
    if not earlier:
        return
    # Links that lead nowhere are among them, from Python 3.13 on.
    files = {_identity(path): path for path in earlier if path.exists()}
    folders = [path.resolve() for path in earlier if path.is_dir()]
    for given in inputs:
        if given is None or not given.exists():
            continue
        replaced = files.get(_identity(given))
        if replaced is None and folders:
            where = given.resolve()
            replaced = next((one for one in folders if where.is_relative_to(one)), None)
        if replaced is not None:
            raise OutputError(
                f"cannot write {replaced}: it is an input of this command; name another --output"
            )


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino

"""A mutation fuzzer of every reader: each input is read in a child of bounded time and memory.

Run: python tests/robustness/fuzz.py [--count 5000] [--formats jpeg,png] [--seed 0]. A mutation
follows from its format and number alone. What fails is kept in the folder `findings`, which a test
reads again. A new reader needs a `Format` in the FORMATS of a module that `formats` lists.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

HERE = Path(__file__).resolve().parent
FINDINGS = HERE / "findings"
MAX_SECONDS = 10.0
MAX_BYTES = 2 * 1024**3
# Of address space: a decoder that claims more fails, and memory that is used is measured.
MAX_ADDRESS_BYTES = 8 * 1024**3
INTERESTING = (0, 1, 2, 7, 8, 15, 16, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**31 - 1)
OUTCOMES = ("clean", "reason", "traceback", "hang", "memory", "silent wrong")


class SilentlyWrongError(Exception):
    """What a reader gave without an error is not what it promises."""


@dataclass(frozen=True, slots=True)
class Format:
    """A kind of input.

    Attributes
    ----------
    suffix : str
        Of the file's name, with its dot.
    corpus : callable
        Gives good files, which are mutated.
    read : callable
        Reads a file; raises one of `reasons`, or SilentlyWrongError.
    reasons : tuple of exception types
        What the reader promises to raise.
    repair : callable
        Puts checksums right, so that half of the mutations reach what lies behind them.
    """

    suffix: str
    corpus: Callable[[], Sequence[bytes]]
    read: Callable[[Path], None]
    reasons: tuple[type[Exception], ...]
    repair: Callable[[bytes], bytes] = bytes


@dataclass(frozen=True, slots=True)
class Outcome:
    """One of OUTCOMES, and what was said."""

    kind: str
    text: str = ""


def formats() -> dict[str, Format]:
    """Return all kinds of input, by name."""
    sys.path[:0] = [str(HERE), str(HERE.parent)]
    import container_formats
    import picture_formats
    import run_formats
    import sensor_formats
    import table_formats

    modules = (picture_formats, table_formats, sensor_formats, container_formats, run_formats)
    return {name: kind for module in modules for name, kind in module.FORMATS.items()}


def mutation(name: str, kind: Format, corpus: Sequence[bytes], number: int) -> bytes:
    """Return a mutated file; it follows from the format's name and the number."""
    rng = random.Random(f"{name} {number}")
    data = bytearray(rng.choice(corpus))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        if data:
            rng.choice(MUTATORS)(data, rng, corpus)
    return kind.repair(bytes(data)) if rng.random() < 0.5 else bytes(data)


def _place(data: bytearray, rng: random.Random) -> int:
    """Return an offset; half of them in the first bytes, where headers are."""
    return rng.randrange(min(len(data), 200) if rng.random() < 0.5 else len(data))


def _flip(data: bytearray, rng: random.Random, _corpus: Sequence[bytes]) -> None:
    data[_place(data, rng)] ^= 1 << rng.randrange(8)


def _set_number(data: bytearray, rng: random.Random, _corpus: Sequence[bytes]) -> None:
    place, size = _place(data, rng), rng.choice((1, 2, 4, 8))
    number = rng.choice(INTERESTING) * rng.choice((1, -1)) % 256**size
    data[place : place + size] = number.to_bytes(size, rng.choice(("little", "big")))


def _set_random(data: bytearray, rng: random.Random, _corpus: Sequence[bytes]) -> None:
    place = _place(data, rng)
    data[place : place + rng.randrange(1, 9)] = rng.randbytes(rng.randrange(1, 9))


def _delete(data: bytearray, rng: random.Random, _corpus: Sequence[bytes]) -> None:
    place = _place(data, rng)
    del data[place : place + rng.choice((1, 2, 4, 16, 100))]


def _repeat(data: bytearray, rng: random.Random, _corpus: Sequence[bytes]) -> None:
    place = _place(data, rng)
    part = data[place : place + rng.choice((1, 4, 12, 64))]
    data[place:place] = part * rng.choice((1, 2, 50))


def _blank(data: bytearray, rng: random.Random, _corpus: Sequence[bytes]) -> None:
    place = _place(data, rng)
    count = min(rng.choice((2, 8, 64, 600)), len(data) - place)
    data[place : place + count] = rng.choice((b"\0", b"\xff", b" ")) * count


def _cut(data: bytearray, rng: random.Random, _corpus: Sequence[bytes]) -> None:
    del data[_place(data, rng) :]


def _splice(data: bytearray, rng: random.Random, corpus: Sequence[bytes]) -> None:
    other = rng.choice(corpus)
    place = rng.randrange(len(other))
    data[_place(data, rng) :] = other[place:]


MUTATORS = (_flip, _set_number, _set_random, _delete, _repeat, _blank, _cut, _splice)


def outcome_of(kind: Format, data: bytes, folder: Path) -> Outcome:
    """Return what becomes of a file, read in this process."""
    path = folder / f"input{kind.suffix}"
    path.write_bytes(data)
    try:
        kind.read(path)
    except SilentlyWrongError as error:
        return Outcome("silent wrong", str(error))
    except kind.reasons as error:
        text = str(error)
        if "\n" in text or not text:
            return Outcome("silent wrong", f"no one-line reason: {text!r}")
        return Outcome("reason", text)
    except BaseException:  # noqa: BLE001 - whatever it is, it ended a run
        return Outcome("traceback", traceback.format_exc())
    return Outcome("clean")


def _serve(pipe: Connection) -> None:
    """Read what the parent sends, one input after the other."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESS_BYTES, MAX_ADDRESS_BYTES))
    kinds = formats()
    with tempfile.TemporaryDirectory() as folder:
        while True:
            name, data = pipe.recv()
            before = _peak_bytes()
            outcome = outcome_of(kinds[name], data, Path(folder))
            if _peak_bytes() > max(before, MAX_BYTES):
                outcome = Outcome("memory", f"{_peak_bytes() / 1e9:.1f} GB; {outcome.text}")
            pipe.send(outcome)


def _peak_bytes() -> int:
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


class Child:
    """A process that reads inputs, and is replaced when one has hung or killed it."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()
        self._seconds = 60.0  # the first input waits for the imports

    def read(self, name: str, data: bytes) -> Outcome:
        """Return what becomes of an input."""
        self._pipe.send((name, data))
        seconds, self._seconds = self._seconds, MAX_SECONDS
        outcome = Outcome("hang", f"over {seconds:.0f} s")
        with contextlib.suppress(EOFError, OSError):
            if self._pipe.poll(seconds):
                outcome = Outcome("traceback", "the process was killed")
                outcome = self._pipe.recv()
        if outcome.kind in {"hang", "memory"} or not self._process.is_alive():
            self.close()
            self._start()
        return outcome

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def run(
    child: Child, name: str, count: int, first: int = 0, findings: Path | None = FINDINGS
) -> Iterator[tuple[int, Outcome]]:
    """Yield the number and the outcome of each mutation of a format; keep what fails."""
    kind = formats()[name]
    corpus = kind.corpus()
    for number in range(first, first + count):
        data = mutation(name, kind, corpus, number)
        outcome = child.read(name, data)
        if outcome.kind not in {"clean", "reason"} and findings is not None:
            findings.mkdir(exist_ok=True)
            (findings / f"{name}-{number}{kind.suffix}").write_bytes(data)
        yield number, outcome


def main() -> int:
    """Print a row for each format; exit 1 when anything failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="mutations of each format")
    parser.add_argument("--seed", type=int, default=0, help="number of the first mutation")
    parser.add_argument("--formats", default=",".join(formats()), help="names, comma-separated")
    arguments = parser.parse_args()
    print("| input | tried | " + " | ".join(OUTCOMES) + " |")
    print("|---" * (len(OUTCOMES) + 2) + "|")
    failed, child = False, Child()
    for name in arguments.formats.split(","):
        found: Counter[str] = Counter()
        for number, outcome in run(child, name, arguments.count, arguments.seed):
            found[outcome.kind] += 1
            if outcome.kind not in {"clean", "reason"}:
                failed = True
                print(f"{name} {number}: {outcome.kind}\n{outcome.text}", file=sys.stderr)
        cells = [name, arguments.count, *(found[kind] for kind in OUTCOMES)]
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)
    child.close()
    return int(failed)


if __name__ == "__main__":
    # As the module that the formats import, so that there is one of each class.
    import fuzz

    sys.exit(fuzz.main())

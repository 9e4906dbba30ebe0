"""A short run of the fuzzer, and what it once found."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("PIL")
pytest.importorskip("av")
pytest.importorskip("rosbags")

import fuzz

COUNT = 60
# Of formats whose libraries take long to open a file.
SLOW = {"bag": 5, "mcap": 5, "db3": 5}


@pytest.fixture(scope="module")
def child() -> Iterator[fuzz.Child]:
    one = fuzz.Child()
    yield one
    one.close()


@pytest.mark.parametrize("name", fuzz.formats())
def test_no_mutation_ends_in_anything_but_a_reason(name: str, child: fuzz.Child) -> None:
    failed = [
        (number, outcome)
        for number, outcome in fuzz.run(child, name, SLOW.get(name, COUNT), findings=None)
        if outcome.kind not in {"clean", "reason"}
    ]
    assert failed == []


@pytest.mark.parametrize("path", sorted(fuzz.FINDINGS.glob("*-*")), ids=lambda path: path.name)
def test_what_was_found_is_mended(path: Path, child: fuzz.Child) -> None:
    outcome = child.read(path.name.split("-", maxsplit=1)[0], path.read_bytes())
    assert outcome.kind in {"clean", "reason"}, outcome.text


@pytest.mark.parametrize("name", fuzz.formats())
def test_good_files_of_the_corpus_are_read(name: str, tmp_path: Path) -> None:
    kind = fuzz.formats()[name]
    kinds = {fuzz.outcome_of(kind, data, tmp_path).kind for data in kind.corpus()}
    assert kinds == ({"reason"} if name == "foreign" else {"clean"})


def test_a_mutation_follows_from_its_number(tmp_path: Path) -> None:
    kind = fuzz.formats()["png"]
    corpus = kind.corpus()
    twice = [fuzz.mutation("png", kind, corpus, 7) for _ in range(2)]
    assert twice[0] == twice[1] != fuzz.mutation("png", kind, corpus, 8)

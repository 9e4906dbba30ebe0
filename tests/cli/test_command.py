"""What all commands have in common: sections of the help, --config, messages, both spellings."""

from __future__ import annotations

import errno
import io
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner
from spied_commands import ARGUMENTS, LOADED, calls

from slamcli.cli.main import COMMANDS, main
from slamcli.cli.options.sections import SECTIONS, is_expert, section_of
from slamcli.cli.progress import ProgressBar

__all__ = ["calls"]  # a fixture
Calls = list[tuple[str, list[Any]]]


def run(*words: str) -> click.testing.Result:
    return CliRunner().invoke(main, list(words))


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_short_and_help_all_complete(command: str) -> None:
    short, whole = run(command, "--help").output, run(command, "--help-all").output
    assert len(short.splitlines()) <= 40
    assert max(map(len, short.splitlines())) <= 80
    for parameter in LOADED[command].params:
        if not isinstance(parameter, click.Option):
            continue
        flags = {*parameter.opts, *parameter.secondary_opts}
        assert flags <= set(re.findall(r"--?[a-z0-9][a-z0-9-]*", whole)), flags
        assert section_of(parameter) in SECTIONS
        if not is_expert(parameter) and parameter.name != "help_all":
            assert any(flag in short for flag in flags), flags
            sentence = (parameter.help or "").split(". ")[0].removesuffix(".")
            assert short == whole or len(sentence) <= 51, sentence


def test_a_command_of_many_options_hides_those_for_experts() -> None:
    short = run("stitch", "--help").output
    assert "--odometry" in short
    assert "--wta-k" not in short
    assert "--wta-k" in run("stitch", "--help-all").output
    headings = [line[:-1] for line in short.splitlines() if line in {f"{s}:" for s in SECTIONS}]
    assert headings == ["Options", "Camera", "Sensors", "Output", "Performance"]


@pytest.mark.parametrize("flag", ["--meters-per-pixel", "--metres_per_pixel", "--metres-per-pixel"])
def test_american_spelling_and_underscores_are_taken(flag: str, calls: Calls) -> None:
    result = run("warp", "frames", flag, "0.25")
    assert result.exit_code == 0, result.output
    assert 0.25 in calls[0][1]


def options_of(calls: Calls) -> Any:
    return next(v for v in calls[-1][1] if type(v).__name__ == "StitchOptions")


def test_a_file_by_hand_gives_options_and_the_command_line_overrides_them(
    calls: Calls, tmp_path: Path
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(
        "min-score = 0.4\nmeters_per_pixel = 0.002\nself_calibrate = true\nloops = false\n"
        'crop = [0, 0.5, 1, 2]\nformat = ["png", "nav2"]\nrotate = 30\nmemory = "2G"\n'
        '[stitch]\nlever-arm = "auto"\n[match]\nratio = 0.5\n'
    )
    assert run("stitch", "frames", "--config", str(file), "--min-score", "0.6").exit_code == 0
    found = options_of(calls)
    assert found.mapper.min_score == 0.6
    assert found.mapper.loops is False
    assert found.mapper.matching.ratio == 0.9
    assert found.self_calibrate == "always"
    assert found.telemetry.lever_arm_metres is None
    assert found.products.paint.metres_per_pixel == 0.002
    assert found.products.crop == (0, 0.5, 1, 2)
    assert found.products.formats == ("png", "nav2")
    assert found.products.turn_radians == pytest.approx(0.5235987755982988)
    assert found.products.memory_bytes == 2_000_000_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("min-scor = 0.4", "'min-scor' is no option of slam stitch; min-score is one"),
        ("min-score = 4", "4 is not a number from 0 to 1"),
        ("crop = [0, 1]", "is not of the form"),
        ("min-score = ", "is no TOML file"),
    ],
)
def test_a_file_of_nonsense_is_refused(
    text: str, message: str, calls: Calls, tmp_path: Path
) -> None:
    (tmp_path / "mine.toml").write_text(text)
    result = run("stitch", "frames", "--config", str(tmp_path / "mine.toml"))
    assert result.exit_code in {1, 2}
    assert message in result.output.replace("\n", " ")
    assert not calls


CHANGED = [
    "--min-score",
    "0.35",
    "--count",
    "700",
    "--ratio",
    "0.8",
    "--odometry-sigma",
    "0.03",
    "--lever-arm",
    "auto",
    "--rotate",
    "33.3",
    "--crop",
    "0,0.1,1,2",
    "--datum",
    "29.6,-82.3,12.5",
    "--format",
    "png,nav2",
    "--memory",
    "1.5G",
    "--max-range",
    "1.7",
    "--time-offset",
    "-0.25",
    "--export",
    "tum",
    "--strict",
    "--workers",
    "3",
    "--no-loops",
    "--blend",
    "mean",
    "--height",
    "0.7",
    "--network-size",
    "640x480",
    "--filter",
    "cross-check",
    "--mount",
    "hand",
    "--threshold",
    "0.012",
]


def test_a_run_toml_gives_the_options_of_its_run(calls: Calls, tmp_path: Path) -> None:
    from types import SimpleNamespace

    from slamcli.io import toml
    from slamcli.run.stitch import report

    assert run("stitch", "frames", *CHANGED).exit_code == 0
    options = options_of(calls)
    drive: Any = SimpleNamespace(options=options)
    session: Any = SimpleNamespace(workers=3, scheduler="")
    frames = str(tmp_path / "frames")
    sections = {"": {"version": "0", "sources": (frames,), "calibration": "cal.yaml"}}
    sections |= report._option_sections(drive, session)
    toml.write_toml(tmp_path / "run.toml", sections)
    result = run("stitch", "--config", str(tmp_path / "run.toml"))
    assert result.exit_code == 0, (result.output, result.exception)
    given = calls[-1][1]
    assert options_of(calls) == options
    assert (Path(frames),) in given
    assert Path("cal.yaml") in given
    assert next(v for v in given if type(v).__name__ == "Session").workers == 3


def test_a_run_toml_with_what_no_option_gives_is_refused(calls: Calls, tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('version = "0"\n[options.mapper]\nmax_hypotheses = 9\n')
    result = run("stitch", "frames", "--config", str(file))
    assert "no option gives options.mapper.max_hypotheses = 9" in result.output
    assert tomllib.loads(file.read_text())["options"]


def test_messages_are_logged_with_their_times(calls: Calls, tmp_path: Path) -> None:
    log = tmp_path / "slam.log"
    for _ in range(2):
        assert run("warp", "frames", "--log-file", str(log)).exit_code == 0
    lines = log.read_text().splitlines()
    assert len(lines) == 4
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d slam.*", lines[0])
    assert lines[1].endswith(" a line")
    other = tmp_path / "notes.txt"
    other.write_text("mine")
    refused = run("warp", "frames", "--log-file", str(other))
    assert refused.exit_code == 1
    assert "there is something else" in refused.output
    assert other.read_text() == "mine"


def test_an_error_is_logged(tmp_path: Path) -> None:
    log = tmp_path / "slam.log"
    result = run(
        "evaluate", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "--log-file", str(log)
    )
    assert result.exit_code == 1
    (line,) = result.output.splitlines()
    assert line.startswith("Error: ")
    assert log.read_text().splitlines()[-1].endswith(line)


@pytest.mark.parametrize("text", ["2026-01-02,0,0,0\n", "2026-01-02 03:04:05,0,0,0\n"])
def test_a_table_that_begins_with_a_date_is_no_log(text: str, calls: Calls, tmp_path: Path) -> None:
    table = tmp_path / "odometry.csv"
    table.write_text(text)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for path in (table, tmp_path / "link"):
        refused = run("warp", "frames", "--log-file", str(path))
        assert "there is something else" in refused.output
    assert table.read_text() == text
    assert not (tmp_path / "nowhere").exists()
    assert not calls


def test_a_log_or_a_configuration_is_no_output(calls: Calls, tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    for words in (
        ["warp", "frames", "-o", str(file), "--log-file", str(file)],
        ["stitch", "frames", "--odometry", str(file), "--log-file", str(file)],
    ):
        refused = run(*words)
        assert refused.exit_code == 1
        assert "the command uses it; name another one" in refused.output
    file.write_text("ratio = 0.5\n")
    linked = tmp_path / "b.png"
    linked.hardlink_to(file)
    for path in (file, linked):
        refused = run("match", "a.png", "b.png", "-o", str(path), "--config", str(file))
        assert refused.exit_code == 1
        assert "is an input of this command" in refused.output
    assert not calls


def test_a_log_on_a_full_disk_does_not_stop_the_work(
    calls: Calls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(io.FileIO):
        def write(self, _: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("slamcli.cli.messages.io.FileIO", Full)
    result = run("warp", "frames", "--log-file", str(tmp_path / "slam.log"))
    assert result.exit_code == 0, result.output
    assert calls
    assert "slam.log is not complete: No space left on device" in result.output


def test_progress_in_a_log_has_times_a_rate_and_the_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr("slamcli.cli.progress.time.monotonic", lambda: clock[0])
    with ProgressBar() as bar:
        for done in range(1, 401):
            clock[0] += 0.5
            bar("locating", done, 400)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "locating 60/400, 2/s, 0:30 so far, 2:50 left"
    assert "locating 80/400, 2/s, 0:40 so far, 2:40 left" in lines
    assert lines[-1] == "locating 400/400, 2/s, 3:20 so far"
    assert 6 <= len(lines) <= 14


def test_a_stage_that_begins_anew_has_a_rate_of_its_own(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr("slamcli.cli.progress.time.monotonic", lambda: clock[0])
    with ProgressBar() as bar:
        for _ in range(2):
            # Minutes of other work.
            clock[0] += 300.0
            for done in range(1, 11):
                clock[0] += 1.0
                bar("locating", done, 10)
    lines = capsys.readouterr().err.splitlines()
    assert "locating 1/10, 10:11 so far" in lines
    assert lines[-1] == "locating 10/10, 1/s, 10:20 so far"


def test_quiet_prints_the_result_alone(capsys: pytest.CaptureFixture[str]) -> None:
    from slamcli.cli.messages import messages

    with click.Context(click.Command("x")):
        messages().quiet = True
        with ProgressBar() as bar:
            bar("locating", 1, 1)
            bar.notify("a note")
        messages().show("Error: it is named all the same", error=True)
    assert capsys.readouterr().err == "Error: it is named all the same\n"


def test_the_version_names_what_it_runs_on(monkeypatch: pytest.MonkeyPatch) -> None:
    assert re.fullmatch(r"slam \d+\.\d+\.\d+\n", run("--version").output)
    monkeypatch.setattr(sys, "argv", ["slam", "-v", "--version"])
    printed = run("-v", "--version").output
    for name in ("Python", "numpy", "opencv-python-headless", "pyproj"):
        assert re.search(rf"^{name} +\d", printed, re.MULTILINE), name
    assert "pytest" not in printed


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_takes_the_options_of_messages(command: str, calls: Calls) -> None:
    assert run(command, *ARGUMENTS[command], "-q", "-v").exit_code == 0
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), "auto"),
        (("--self-calibrate",), "always"),
        (("--self-calibrate", "never"), "never"),
        (("--self-calibrate=auto",), "auto"),
        (("--no-self-calibrate",), "never"),
    ],
)
@pytest.mark.parametrize("frames_last", [False, True])
def test_self_calibration_by_a_flag_or_a_word(
    calls: Calls, arguments: tuple[str, ...], expected: str, frames_last: bool
) -> None:
    given = (*arguments, "frames") if frames_last else ("frames", *arguments)
    assert run("stitch", *given).exit_code == 0
    assert options_of(calls).self_calibrate == expected
    assert run("stitch", "frames", "--self-calibrate=maybe").exit_code == 2

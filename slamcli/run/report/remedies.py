"""Lost frames grouped by reason, each with the advice of the troubleshooting page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache

from slamcli.core.records import PoseEstimate
from slamcli.run.report.page import resource

_PAGE = "troubleshooting.md"
_VALUE = "…"
# The frame that a registration was tried with.
_COMPARED = re.compile(r" \(to .*\)$")
_LINK = re.compile(r"\[([^]]*)\]\([^)]*\)")


def lost_groups(estimates: Iterable[PoseEstimate]) -> list[dict[str, object]]:
    """Return the lost frames by reason, the most frequent first.

    Each group has its reason, values as dots where they differ, the indices of its frames, and what
    to try: text in which code is between backticks.
    """
    groups: dict[str, list[PoseEstimate]] = {}
    for estimate in estimates:
        if estimate.map_from_robot is None:
            groups.setdefault(message_of(estimate.reason), []).append(estimate)
    ordered = sorted(groups.items(), key=lambda item: (-len(item[1]), item[1][0].index))
    return [
        {
            "reason": members[0].reason if len({m.reason for m in members}) == 1 else message,
            "frames": [member.index for member in members],
            "remedy": remedies().get(message, ""),
        }
        for message, members in ordered
    ]


def message_of(reason: str) -> str:
    """Return a reason as the troubleshooting page lists it, its values as dots."""
    for candidate in (reason, _COMPARED.sub("", reason)):
        fitting = [text for text, pattern in _patterns().items() if pattern.fullmatch(candidate)]
        if fitting:
            return max(fitting, key=len)
    return reason


@lru_cache
def remedies() -> Mapping[str, str]:
    """Return what the troubleshooting page says about each message."""
    found: dict[str, str] = {}
    for line in resource(_PAGE).splitlines():
        cells = line.strip().strip("|").split("|")
        if line.startswith("|") and len(cells) == 2:
            for message in re.findall(r"`([^`]+)`", cells[0]):
                found.setdefault(message, _LINK.sub(r"\1", cells[1].strip()))
    found.setdefault("not reached: interrupted", "Repeat the command with `--resume`.")
    return found


@lru_cache
def _patterns() -> Mapping[str, re.Pattern[str]]:
    # A message of values alone fits everything.
    return {
        text: re.compile(".*?".join(map(re.escape, text.split(_VALUE))), re.DOTALL)
        for text in remedies()
        if len(text.replace(_VALUE, "").strip(" :,.;()")) >= 4
    }

"""The top of the page: how good the result is, the worst reasons with the photos that show them, and every check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.verdict import Finding, Level, Verdict
from stages.report.capture_figures import photos_named
from stages.report.collect import Started
from stages.report.page import Picture

TROUBLES_SHOWN = 6  # with their photos; the table below has all
PHOTOS_SHOWN = 4  # of one trouble, the worst first
MEANING: Mapping[Level, str] = {
    "good": "Every check is within its limits.",
    "usable": "An artist can work with it; something is worse than it could be.",
    "unusable": "Do not hand it on.",
}
MARKS: Mapping[Level, str] = {"good": "\u2713", "usable": "!", "unusable": "\u2715"}  # besides colour and word


@dataclass(frozen=True, slots=True)
class Trouble:
    """A finding that is not good. pictures: of the photos that it names; unseen: names of those that are not shown."""

    stage: str
    finding: Finding
    pictures: Sequence[Picture]
    unseen: Sequence[str]


@dataclass(frozen=True, slots=True)
class VerdictShown:
    """Everything that the page shows of it. checks: (stage, finding) of all; more: troubles that only the table has."""

    level: Level
    meaning: str
    marks: Mapping[Level, str]
    troubles: Sequence[Trouble]
    more: int
    checks: Sequence[tuple[str, Finding]]


def verdict_shown(verdict: Verdict, r: Started, side: int) -> VerdictShown:
    """side: pixels of the photos' larger side."""
    found = verdict.troubles()
    troubles = []
    for stage, f in found[:TROUBLES_SHOWN]:
        pictures = photos_named(r, f.views[:PHOTOS_SHOWN], side)
        shown = {p.caption for p in pictures}
        troubles.append(Trouble(stage, f, pictures, [name for name in f.views if name not in shown]))
    return VerdictShown(
        verdict.level, MEANING[verdict.level], MARKS, troubles, len(found) - len(troubles), verdict.in_order()
    )

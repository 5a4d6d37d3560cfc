"""The verdict on top of the page: level, the worst findings with their photos, and a table of all checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.verdict import Finding, Level, Verdict
from stages.report.capture_figures import photos_named
from stages.report.collect import Started
from stages.report.page import Picture

TROUBLES_SHOWN = 6  # with their photos; the table has all findings
PHOTOS_SHOWN = 4  # of one finding, the worst first
MEANING: Mapping[Level, str] = {
    "good": "Every check is within its limits.",
    "usable": "An artist can work with the asset, but at least one check misses its limit for good.",
    "unusable": "Do not use or deliver this asset.",
}
MARKS: Mapping[Level, str] = {"good": "\u2713", "usable": "!", "unusable": "\u2715"}  # in addition to colour and text


@dataclass(frozen=True, slots=True)
class Trouble:
    """A finding that is not good. pictures: photos that it names; unseen: names of further photos, not shown."""

    stage: str
    finding: Finding
    pictures: Sequence[Picture]
    unseen: Sequence[str]


@dataclass(frozen=True, slots=True)
class VerdictShown:
    """Data of this section. checks: (stage, finding) of all; more: number of further findings that are not good."""

    level: Level
    meaning: str
    marks: Mapping[Level, str]
    troubles: Sequence[Trouble]
    more: int
    checks: Sequence[tuple[str, Finding]]


def verdict_shown(verdict: Verdict, r: Started, side: int) -> VerdictShown:
    """The data of this section. side: longer side of the photos, pixels."""
    found = verdict.troubles()
    troubles = []
    for stage, f in found[:TROUBLES_SHOWN]:
        pictures = photos_named(r, f.views[:PHOTOS_SHOWN], side)
        shown = {p.caption for p in pictures}
        troubles.append(Trouble(stage, f, pictures, [name for name in f.views if name not in shown]))
    return VerdictShown(
        verdict.level, MEANING[verdict.level], MARKS, troubles, len(found) - len(troubles), verdict.in_order()
    )

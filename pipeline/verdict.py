"""Quality of a result: each stage compares measured figures with limits and states what to do.

A `Finding` is one measured figure with its limits. The verdict of a stage is the worst of its findings; that of an
asset is the worst of all stages. `good`: nothing to do. `usable`: an artist can work with it, but a figure misses its
limit. `unusable`: do not use or deliver it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

Level = Literal["good", "usable", "unusable"]
LEVELS: tuple[Level, ...] = ("good", "usable", "unusable")  # from best to worst


class Finding(BaseModel):
    """One measured figure of a stage and its level.

    check: its name, lower case with underscores, the same in every run. value: as measured, in `unit`. limit: the limit
    for `good`, as text ("at least 0.9"). said: message, one plain sentence with the figure. remedy: what to do, for
    levels other than good. views: names of the affected photos, the worst first.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    check: str
    level: Level
    value: float | None
    unit: str = ""
    limit: str
    said: str
    remedy: str = ""
    views: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.level}: {self.sentence}"

    @property
    def sentence(self) -> str:
        """The message, the affected photos, and what to do."""
        named = f" ({', '.join(self.views[:5])}{', ...' if len(self.views) > 5 else ''})" if self.views else ""
        what = f"{self.said.rstrip('.')}{named}."
        return f"{what} What to do: {self.remedy.rstrip('.')}." if self.remedy and self.level != "good" else what


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a figure for good and for usable; if they are equal, there is no level between.

    lower: the limits are lower limits (else upper ones). A figure that is not finite is unusable.
    """

    good: float
    usable: float
    lower: bool = True

    def __post_init__(self) -> None:
        ordered = self.usable <= self.good if self.lower else self.usable >= self.good
        if not ordered:
            raise ValueError(f"usable ({self.usable}) must not be stricter than good ({self.good})")

    def level(self, value: float) -> Level:
        """The level of one figure."""
        if not np.isfinite(value):
            return "unusable"
        sign = 1 if self.lower else -1
        if sign * value >= sign * self.good:
            return "good"
        return "usable" if sign * value >= sign * self.usable else "unusable"

    def words(self, unit: str = "") -> str:
        """The limit for `good`: "at least 0.9"."""
        return f"at {'least' if self.lower else 'most'} {self.good:g}{' ' + unit if unit else ''}"


def judged(
    check: str, value: float, limits: Limits, said: str, remedy: str, *, unit: str = "", views: Sequence[str] = ()
) -> Finding:
    """The finding of one figure. remedy, views: kept only for levels other than good."""
    level = limits.level(float(value))
    return Finding(
        check=check,
        level=level,
        value=round(float(value), 5) if np.isfinite(value) else None,
        unit=unit,
        limit=limits.words(unit),
        said=said,
        remedy="" if level == "good" else remedy,
        views=() if level == "good" else tuple(views),
    )


def worst(findings: Iterable[Finding | Level]) -> Level:
    """The worst level of findings or levels; good if there are none."""
    levels = [f if isinstance(f, str) else f.level for f in findings]
    return max(levels, key=LEVELS.index, default="good")


@dataclass(frozen=True, slots=True)
class Verdict:
    """The findings of several stages. findings: by the stage's name, in the order of the stages."""

    findings: Mapping[str, tuple[Finding, ...]]

    @property
    def level(self) -> Level:
        """The worst of all stages."""
        return worst(self.stages.values())

    @property
    def stages(self) -> dict[str, Level]:
        """The worst level of each stage."""
        return {name: worst(found) for name, found in self.findings.items()}

    def in_order(self) -> list[tuple[str, Finding]]:
        """All findings as (stage, finding), in the order of the stages."""
        return [(name, f) for name, found in self.findings.items() for f in found]

    def troubles(self) -> list[tuple[str, Finding]]:
        """Findings that are not good, the worst first, then in the order of the stages."""
        return sorted((x for x in self.in_order() if x[1].level != "good"), key=lambda x: -LEVELS.index(x[1].level))

    def reasons(self) -> tuple[str, ...]:
        """One sentence per finding that is not good: what is wrong, in which photos, what to do."""
        return tuple(f"{name}: {finding}" for name, finding in self.troubles())

    def record(self, *, every: bool = False) -> dict[str, Any]:
        """The verdict as plain values for JSON; with every finding, or only with those that are not good."""
        listed = self.in_order() if every else self.troubles()
        return {
            "level": self.level,
            "stages": self.stages,
            "findings": [{"stage": name, **finding.model_dump(mode="json")} for name, finding in listed],
        }


def verdict_of(artifacts: Mapping[str, Any]) -> Verdict:
    """The verdict of finished artifacts, by stage name. An artifact without findings is good."""
    return Verdict({name: tuple(getattr(a, "findings", ())) for name, a in artifacts.items()})


def verdict_of_inputs(inputs: Any, **own: Iterable[Finding]) -> Verdict:
    """The verdict of a stage's inputs (a dataclass of located artifacts) and of the stage's own findings.

    own: those findings, by the name of the stage, which has no artifact yet.
    """
    before = {f.name: getattr(inputs, f.name).artifact for f in dataclasses.fields(inputs)}
    return Verdict({**verdict_of(before).findings, **{name: tuple(found) for name, found in own.items()}})

"""How good a run's result is, by the findings of its stages; and what follows: words, exit codes, states.

The levels are those of `pipeline.verdict`. `--strict` changes what counts as failed and nothing that is made.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pipeline.contract import Done
from pipeline.verdict import LEVELS, Finding, Level, Verdict, verdict_of

REFUSED = 3  # exit code: the run came to its end, and its result is not good enough
REASONS_SHOWN = 5  # at the end of a run; all are in run.json and in the report


def verdict_of_done(done: Iterable[Done[Any]]) -> Verdict:
    """The verdict of the stages that are done."""
    return verdict_of({d.stage: d.located.artifact for d in done})


def level_in(record: Mapping[str, Any]) -> Level | None:
    """The level in a run.json; None where it has none."""
    verdict = record.get("verdict")
    level = verdict.get("level") if isinstance(verdict, Mapping) else None
    return level if level in LEVELS else None


def is_refused(level: Level | None, strict: bool) -> bool:
    """Whether a result of this level counts as failed."""
    return level == "unusable" or (strict and level == "usable")


def exit_code(record: Mapping[str, Any]) -> int:
    """0, or 3 where the result is refused. record: what run.json holds; empty after --dry-run."""
    strict = bool(record.get("request", {}).get("strict"))
    return REFUSED if is_refused(level_in(record), strict) else 0


def state_name(level: Level | None) -> str | None:
    """The name of the completed state that a run ends with on a Prefect server; None for Prefect's own."""
    return None if level is None or level == "good" else level.capitalize()


def level_of_state(name: str | None) -> Level:
    """The level that belongs to the name of a completed state."""
    return next((x for x in LEVELS if state_name(x) == name), "good")


def last_lines(record: Mapping[str, Any]) -> list[str]:
    """The last lines of a run: the verdict, the stages that it is from, and the worst reasons."""
    verdict = record.get("verdict")
    if not isinstance(verdict, Mapping):
        return []
    lines = [_reason(f) for f in verdict["findings"][:REASONS_SHOWN]]
    more = len(verdict["findings"]) - len(lines)
    if more > 0:
        lines.append(f"and {more} more: see run.json")
    return [headline(verdict["level"], verdict["stages"]), *(f"  {line}" for line in lines)]


def headline(level: str, stages: Mapping[str, str], what: str = "verdict") -> str:
    """ "verdict: usable (masks usable; the other 8 stages are good)"."""
    by_level = {x: [n for n, found in stages.items() if found == x] for x in ("unusable", "usable")}
    parts = [f"{', '.join(names)} {x}" for x, names in by_level.items() if names]
    rest = len(stages) - sum(map(len, by_level.values()))
    if parts and rest:
        parts.append(f"the other {rest} good")
    return f"{what}: {level}" + (f" ({'; '.join(parts)})" if parts else "")


def _reason(finding: Mapping[str, Any]) -> str:
    content = {k: v for k, v in finding.items() if k != "stage"}
    return f"{finding['stage']}: {Finding.model_validate(content)}"

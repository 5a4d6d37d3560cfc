"""About how long the rest of a run takes: from earlier runs in the same store, else from a table of measured ones."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.contract import Done, StageConfig
from pipeline.store import RUN
from stages.registry import ALSO
from workflows.run.plan import Plan, Step, preview

# Seconds on two cores without a GPU, other work beside it. draft: until the surface, medians of four captures of 36 to
# 100 photos; behind it, a person made from the head template. studio and film: the scanned head of docs/benchmarks.md,
# divided among the stages as in workflows/run/budget.py. For orders of magnitude: earlier runs on the same machine
# replace it stage by stage.
SECONDS: dict[str, dict[str, float]] = {
    "draft": {
        "inverse_rendering": 100,
        "surface": 10,
        "template": 50,
        "uv": 16,
        "reflectance": 300,
        "bake": 60,
        "usd": 80,
        "report": 20,
    },
    "studio": {
        "inverse_rendering": 780,
        "surface": 15,
        "template": 55,
        "uv": 25,
        "reflectance": 300,
        "bake": 60,
        "usd": 45,
        "report": 10,
    },
    "film": {
        "inverse_rendering": 1500,
        "surface": 60,
        "template": 60,
        "uv": 60,
        "reflectance": 300,
        "bake": 300,
        "usd": 150,
        "report": 30,
    },
}
# The stages before the fit, whatever the preset: the demo, 16 photos of 160 px, on two cores that other work shared.
EARLY: dict[str, float] = {"capture": 15, "poses": 55, "masks": 55, "together": 20}
REUSED = 0.3  # seconds to compare a stored result with its hashes
LIGHT_STAGE_ONLY = frozenset({"reflectance"})  # other captures pass through at once
NOT_OF_TIME = frozenset({"seed", "name", "holdout", "author", "license", "subject_consent", "asset_version"})
LOOKED_AT = 50  # earlier runs of a stage that are read, the latest first


def remaining_time(plan: Plan, done: Sequence[Done[Any]], elapsed: float) -> str:
    """A line for the user on the stages that are not done. elapsed: seconds of the run so far."""
    rest = [s.name for s in plan.stages[len(done) :]]
    which = rest[0] if len(rest) == 1 else f"{rest[0]} to {rest[-1]}"
    if plan.request.budget is not None:
        left = max(0.0, plan.request.budget - elapsed)
        return f"the rest ({which}) has what is left of the budget: about {_words(left)}"
    stored = {step.stage for step in preview(plan) if step.action == "reused"}
    found = {name: _of_stage(plan, name) for name in rest if name not in stored}
    if not found:
        return f"the rest ({which}) is in the store already"
    if any(seconds is None for seconds, _ in found.values()):
        return f"the rest ({which}): no time is known for the preset {plan.request.preset} on this machine"
    total = sum(seconds or 0.0 for seconds, _ in found.values())
    origins = {origin for _, origin in found.values()}
    origin = "earlier runs here" if origins == {"runs"} else "measured on two cores"
    return f"the rest ({which}) takes about {_words(total)} ({origin})"


@dataclass(frozen=True, slots=True)
class Expected:
    """What is expected of one stage: how long it takes (s; None where nothing is known), and how it is known: "runs",
    "table", or "store" for a result that is there already."""

    step: Step
    seconds: float | None
    origin: str


def expected(plan: Plan) -> list[Expected]:
    """Every stage of the plan, in order. Only manifests and records in the store are read."""
    found = []
    for step in preview(plan):
        seconds, origin = (REUSED, "store") if step.action == "reused" else _of_stage(plan, step.stage)
        found.append(Expected(step, seconds, origin))
    return found


def _of_stage(plan: Plan, name: str) -> tuple[float | None, str]:
    """Seconds of a stage and where they are from: "runs" or "table"."""
    earlier = _earlier(plan, name, plan.configs[name])
    if earlier:
        return statistics.median(earlier), "runs"
    if name in LIGHT_STAGE_ONLY and getattr(plan.source.artifact, "kind", "") != "olat":
        return 0.0, "table"
    alone = name.removeprefix(ALSO)
    return SECONDS.get(plan.request.preset, {}).get(alone, EARLY.get(alone)), "table"


def _earlier(plan: Plan, name: str, config: StageConfig) -> list[float]:
    """Seconds of this stage in earlier runs with the same settings, whatever they were of."""
    return [float(run["seconds"]) for _, run in records(plan, name, config)]


def records(plan: Plan, name: str, config: StageConfig) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Folder and run.json of earlier results of a stage with the same settings on the same device, the latest first.

    They are looked for in the plan's store, and in those of the runs beside it: runs/anna when runs/bert is planned.
    """
    stores = {plan.store.root, *plan.out.parent.glob("*/.store")}
    paths = [p for store in stores for p in store.glob(f"{name}/*/{RUN}")]
    wanted = _timed(config.model_dump(mode="json"))
    for path in sorted(paths, key=_modified, reverse=True)[:LOOKED_AT]:
        try:
            run = json.loads(path.read_text())
            if _timed(run["config"]) == wanted and run["device"] == plan.device and float(run["seconds"]) >= 0:
                yield path.parent, run
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue  # a run that is being removed, or of a version that wrote something else


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # it is being removed
        return 0.0


def _timed(config: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in config.items() if k not in NOT_OF_TIME}


def _words(seconds: float) -> str:
    if seconds < 90:
        return f"{max(10, round(seconds, -1)):.0f} seconds"
    return f"{seconds / 60:.0f} minutes" if seconds < 5400 else f"{seconds / 3600:.1f} hours"

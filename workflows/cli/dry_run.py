"""`neuface run --dry-run`: what would run and why, how long it takes, and what it needs. Nothing is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stages.presets import configs_for
from stages.registry import ALSO
from workflows.cli.console import Console
from workflows.run.estimate import Expected, expected
from workflows.run.forecast import in_words
from workflows.run.needs import Needs, free_memory_mb, needs
from workflows.run.plan import Plan
from workflows.run.reasons import reasons
from workflows.run.room import free_bytes

ORIGINS = {"runs": "earlier runs here", "table": "measured on two cores", "store": ""}


def dry_run(plan: Plan, console: Console) -> None:
    """Print the plan on standard output, or tell it as an event."""
    stages = expected(plan)
    why, wanted = reasons(plan, [e.step for e in stages]), needs(plan, stages)
    if console.events is not None:
        console.result("plan", **_for_programs(plan, stages, why, wanted))
        return
    print("\n".join([*_table(stages, why), *_settings(plan), _time(plan, stages), *_room(plan, wanted)]))


def differing(plan: Plan) -> dict[str, tuple[Any, Any]]:
    """Settings of the planned stages that are not the preset's: stage.name -> (value, the preset's)."""
    found: dict[str, tuple[Any, Any]] = {}
    own = [s for s in plan.stages if not s.name.startswith(ALSO)]  # those of a second capture have the same settings
    for name, preset in configs_for(plan.request.preset, {}, registry=own).items():
        ours, theirs = plan.configs[name].model_dump(mode="json"), preset.model_dump(mode="json")
        found |= {f"{name}.{k}": (v, theirs.get(k)) for k, v in ours.items() if v != theirs.get(k)}
    return found


def _table(stages: Sequence[Expected], why: Mapping[str, str]) -> list[str]:
    """A line for each stage: what happens, how long, why."""
    lines = []
    for e in stages:
        time = "" if e.step.action == "reused" else "time not known" if e.seconds is None else in_words(e.seconds)
        key = f"({e.step.key[:12]})" if e.step.key and e.step.action == "reused" else ""
        lines.append(f"{e.step.stage:18} {e.step.action:10} {time:12} {why.get(e.step.stage, key)}".rstrip())
    return lines


def _settings(plan: Plan) -> list[str]:
    found = differing(plan)
    if not found:
        return [f"settings: those of the preset {plan.request.preset}"]
    lines = [f"settings that differ from the preset {plan.request.preset}:"]
    return [*lines, *(f"  {name} = {value} (preset: {theirs})" for name, (value, theirs) in found.items())]


def _time(plan: Plan, stages: Sequence[Expected]) -> str:
    if plan.request.budget is not None:
        return f"time: {in_words(plan.request.budget)}, the budget; the fit is sized when the stages before it are done"
    made = [e for e in stages if e.step.action != "reused"]
    if not made:
        return "time: seconds; everything is in the store"
    unknown = [e.step.stage for e in made if e.seconds is None]
    origins = ", ".join(sorted({ORIGINS[e.origin] for e in made if e.seconds is not None}))
    known = f"about {in_words(sum(e.seconds or 0.0 for e in made))} ({origins})" if len(unknown) < len(made) else ""
    missing = f"not known for {', '.join(unknown)}" if unknown else ""
    return "time: " + "; ".join(t for t in (known, missing) if t)


def _room(plan: Plan, wanted: Needs) -> list[str]:
    free = free_bytes(plan.store.root)
    there = "" if free is None else f"; {_bytes(free)} are free on the disk of {plan.store.root}"
    lines = [f"disk: about {_bytes(wanted.disk)}{there}"]
    if wanted.memory is not None:
        memory = free_memory_mb()
        there = "" if memory is None else f"; {memory / 1024:.1f} GB are free"
        lines.append(f"memory: about {wanted.memory / 1000:.1f} GB{there}")
    return lines


def _bytes(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def _for_programs(plan: Plan, stages: Sequence[Expected], why: Mapping[str, str], wanted: Needs) -> dict[str, Any]:
    rows = [
        {
            "stage": e.step.stage,
            "action": e.step.action,
            "why": why.get(e.step.stage, ""),
            "key": e.step.key,
            "seconds": e.seconds,
            "origin": e.origin,
        }
        for e in stages
    ]
    settings = {name: {"value": v, "preset": theirs} for name, (v, theirs) in differing(plan).items()}
    needed = {"disk_bytes": round(wanted.disk), "memory_mb": wanted.memory}
    return {"stages": rows, "settings": settings, **needed}

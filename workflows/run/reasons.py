"""Why a stage would run: what is new or has changed since the run that the output folder is from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline import threads
from pipeline.contract import Stage
from pipeline.store import RUN, Store, read_object
from stages.registry import SOURCE
from workflows.run.moved import keys_of, store_of
from workflows.run.plan import Plan, Step

SETTINGS_SHOWN = 3  # of one stage


def reasons(plan: Plan, steps: Sequence[Step]) -> dict[str, str]:
    """A few words for each step of `preview`, by stage; nothing for a stage whose result is reused."""
    before, made = _keys_before(plan), set[str]()
    found = {}
    for stage, step in zip(plan.stages, steps, strict=True):
        if step.action == "reused":
            continue
        found[stage.name] = _reason(plan, stage, step, before.get(stage.name), made)
        made.add(stage.name)
    return found


def _reason(plan: Plan, stage: Stage[Any, Any, Any], step: Step, before: str | None, made: set[str]) -> str:
    """made: the stages before it that would run."""
    if stage.name in plan.anew:
        return "asked for with --from-stage"
    if step.action == "made anew":
        return "what the store has is damaged"
    resumes = "; goes on from its checkpoint" if step.key and _has_checkpoint(plan.store, stage.name, step.key) else ""
    if before is None:
        return "new" + resumes
    settings = _settings_changed(plan, stage, before)
    names = [f.name for f in dataclasses.fields(stage.inputs)]
    inputs = [n for n in names if n in made]
    if settings:
        return f"setting changed: {settings}" + resumes
    if inputs:
        return f"input changed: {', '.join(inputs)}"
    if (known := _threads_changed(plan, stage, before)) is not None:
        return f"number of threads changed: {known}" + resumes
    if not plan.store.folder(stage.name, before).is_dir():
        return "no longer in the store" + resumes
    if SOURCE in names:
        return "the photos changed, or the program did" + resumes
    return "the program changed" + resumes


def _keys_before(plan: Plan) -> dict[str, str]:
    """Stage -> key of the run that the output folder is from; empty where there is none, or it used another store."""
    record = read_object(plan.out / "run.json")
    if store_of(record, plan.out).resolve() != plan.store.root.resolve():
        return {}
    return dict(keys_of(record))


def _settings_changed(plan: Plan, stage: Stage[Any, Any, Any], before: str) -> str:
    """ "bake.size 1024 -> 4096"; empty if none did, or it is not known."""
    old = read_object(plan.store.folder(stage.name, before) / RUN).get("config")
    if not isinstance(old, Mapping):
        return ""
    new = plan.configs[stage.name].model_dump(mode="json")
    changed = [f"{stage.name}.{n} {old.get(n)} -> {new[n]}" for n in new if n in old and old[n] != new[n]]
    more = len(changed) - SETTINGS_SHOWN
    return ", ".join(changed[:SETTINGS_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _threads_changed(plan: Plan, stage: Stage[Any, Any, Any], before: str) -> str | None:
    """ "2 -> 1"; None if it did not change, is not known, or makes no difference to this stage."""
    old, now = read_object(plan.store.folder(stage.name, before) / RUN).get("threads"), threads.in_use()
    if stage.any_threads or not isinstance(old, list) or old == now:
        return None
    return next((f"{a} -> {b}" for a, b in zip(old, now, strict=False) if a != b), "")


def _has_checkpoint(store: Store, stage: str, key: str) -> bool:
    return any(store.scratch(stage, key).glob("*"))

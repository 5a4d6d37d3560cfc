"""The registered head of a finished capture, from the store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.artifacts import Artifact, CameraSet, Located, TextureSet, UvMesh
from pipeline.head_artifacts import RegisteredHead
from pipeline.store import Store, read_object
from workflows.batch.state import Entry

WHOLE = ("poses", "template")  # small: their files are compared with their hashes; a damaged picture is named when read
KINDS: dict[str, type[Artifact]] = {"poses": CameraSet, "template": RegisteredHead, "uv": UvMesh, "bake": TextureSet}


@dataclass(frozen=True, slots=True)
class Found:
    """A registered head, its unit, and the maps on it. baked: None if the run ended before, or the maps are those of
    the scan."""

    name: str
    template: Located[RegisteredHead]
    poses: Located[CameraSet]
    baked: Located[TextureSet] | None


def head_of(entry: Entry, out: Path, store: Store) -> Found | str:
    """The head of a capture, or why it has none that can be used. A damaged one is removed from the store."""
    if entry.state == "failed":
        return f"its run failed: {_first_line(entry.fault.message if entry.fault else '')}"
    record = read_object(out / entry.name / "run.json")
    if entry.state == "unusable" or entry.level == "unusable":
        return f"its result is unusable: {_worst(record)}"
    if entry.state != "done":
        return "its run has not come to its end"
    stages = record.get("stages", {})
    found = {n: _stored(store, n, str(stages[n].get("key"))) for n in KINDS if isinstance(stages.get(n), dict)}
    template, poses, uv, bake = (found.get(n) for n in ("template", "poses", "uv", "bake"))
    if "template" not in stages:
        return "its run ended before the head template"
    if template is None or poses is None:
        record_of = out / entry.name / "run.json"
        return f"its head is gone from the store, or was damaged: remove {record_of} and run the batch again"
    if not template.artifact.registered:
        return f"the head template could not be registered: {template.artifact.reason}"
    of_head = bake if uv is not None and uv.artifact.of_template else None
    return Found(entry.name, template, poses, of_head)


def _stored(store: Store, stage: str, key: str) -> Located[Any] | None:
    if stage in WHOLE:
        return store.load(stage, key, KINDS[stage])
    try:
        return Located(store.manifest(stage, key, KINDS[stage]), store.folder(stage, key))
    except (OSError, ValidationError):
        return None


def _first_line(text: str) -> str:
    return next((line for line in text.strip().splitlines()), "no reason is known")


def _worst(record: dict[str, Any]) -> str:
    """What the first finding of a verdict says."""
    findings: Any = record.get("verdict", {}).get("findings") or ({},)
    return str(findings[0].get("said") or "see its report")

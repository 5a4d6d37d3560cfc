"""How much disk and memory a run is expected to need: from earlier runs on this machine, else from measured ones."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import dataclass

from pipeline.store import file_refs
from workflows.run.estimate import Expected, records
from workflows.run.host_info import kilobytes
from workflows.run.plan import Plan
from workflows.run.room import size_of

# MB that a stage keeps in the store besides photos and maps: the demo in draft, 16 photos of 160 px. Others: about 1.
KEPT_MB = {"inverse_rendering": 21, "surface": 7, "uv": 2}
COPIES_OF_PHOTOS = {"capture": 1}  # stage -> how often it writes what the photos take
BYTES_A_TEXEL = {"bake": 67, "usd": 67}  # of all maps together, of the demo's head; the asset has copies
PUBLISHED = ("usd", "report")  # they are copied from the store to the folder of the results
MEMORY_MB = {"draft": 2700.0, "studio": 3700.0, "film": 5000.0}  # peaks of the scanned head of docs/benchmarks.md


@dataclass(frozen=True, slots=True)
class Needs:
    """disk: bytes that the run adds. memory: MB at its peak; None where it is not known."""

    disk: float
    memory: float | None


def needs(plan: Plan, stages: Iterable[Expected]) -> Needs:
    """Of the stages that would run."""
    disk, peaks = 0.0, list[float]()
    for one in stages:
        if one.step.action == "reused":
            continue
        name = one.step.stage
        earlier = list(records(plan, name, plan.configs[name]))
        size = statistics.median(size_of(folder) for folder, _ in earlier) if earlier else _kept(plan, name)
        disk += size * (2 if name in PUBLISHED else 1)
        peaks += [float(run["peak_memory_mb"]) for _, run in earlier if isinstance(run.get("peak_memory_mb"), float)]
    table = MEMORY_MB.get(plan.request.preset)
    memory = max(peaks, default=0.0)
    return Needs(disk, memory if memory and disk else table)


def _kept(plan: Plan, stage: str) -> float:
    """Bytes of a stage's result, where no earlier run tells."""
    photos = sum(ref.size for ref in file_refs(plan.source.artifact))
    side = int(getattr(plan.configs.get("bake"), "size", 0))
    return (
        1e6 * KEPT_MB.get(stage, 1)
        + photos * COPIES_OF_PHOTOS.get(stage, 0)
        + BYTES_A_TEXEL.get(stage, 0) * side * side
    )


def free_memory_mb() -> float | None:
    """MB that this machine can give to a program now; None where the system does not tell."""
    return kilobytes("MemAvailable") / 1024 or None

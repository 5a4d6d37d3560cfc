"""How much disk and memory a run is expected to need: from earlier runs on this machine, else from measured ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pipeline.store import MANIFEST, file_refs, read_object
from stages.registry import ALSO
from workflows.run.estimate import Expected, records
from workflows.run.host_info import kilobytes
from workflows.run.plan import Plan
from workflows.run.spare_page import owns_its_store

# MB that a stage keeps besides photos and maps: the demo in draft (40 photos of 384 px, 8 held out). Others: about 1.
KEPT_MB = {"inverse_rendering": 23, "surface": 15, "uv": 1, "usd": 45, "report": 15}
COPIES_OF_PHOTOS = {"capture": 1}  # stage -> how often it writes what the photos take
BYTES_A_TEXEL = {"bake": 31, "usd": 9}  # of all maps together, of the demo's head; usd has links to the others
MEMORY_MB = {"draft": 2700.0, "studio": 3700.0, "film": 5000.0}  # peaks of the scanned head of docs/benchmarks.md


@dataclass(frozen=True, slots=True)
class Needs:
    """disk: bytes that the run adds. memory: MB at its peak; None where it is not known."""

    disk: float
    memory: float | None


def needs(plan: Plan, stages: Iterable[Expected]) -> Needs:
    """Of the stages that would run."""
    disk, peaks, seen = 0.0, list[float](), set[int]()
    own = owns_its_store(plan)
    once = {"usd": own, "report": own and not plan.request.keep_all}  # whether OUT needs no copy
    for one in stages:
        if one.step.action == "reused":
            continue
        name = one.step.stage
        earlier = list(records(plan, name, plan.configs[name]))
        size = _bytes_of(earlier[0][0], seen) if earlier else _kept(plan, name)
        disk += size * (1 if once.get(name, True) else 2)
        peaks += [float(run["peak_memory_mb"]) for _, run in earlier if isinstance(run.get("peak_memory_mb"), float)]
    table = MEMORY_MB.get(plan.request.preset)
    memory = max(peaks, default=0.0)
    return Needs(disk, memory if memory and disk else table)


def _bytes_of(folder: Path, seen: set[int]) -> float:
    """Bytes of an earlier result. A file that another result shares counts once; one that the store gave up counts."""
    files = [p for p in folder.rglob("*") if p.is_file() and not p.is_symlink()]
    status = {p.relative_to(folder).as_posix(): p.lstat() for p in files}
    new = {s.st_ino: s.st_size for s in status.values() if s.st_ino not in seen}
    seen.update(new)
    listed = read_object(folder / MANIFEST).get("files")
    refs = [f for f in listed if isinstance(f, dict)] if isinstance(listed, list) else []
    gone = (f.get("size") for f in refs if f.get("path") not in status)
    return sum(new.values()) + sum(size for size in gone if isinstance(size, int))


def _kept(plan: Plan, stage: str) -> float:
    """Bytes of a stage's result, where no earlier run tells."""
    source = plan.also if plan.also is not None and stage.startswith(ALSO) else plan.source
    photos = sum(ref.size for ref in file_refs(source.artifact))
    side = int(getattr(plan.configs.get("bake"), "size", 0))
    return (
        1e6 * KEPT_MB.get(stage, 1)
        + photos * COPIES_OF_PHOTOS.get(stage.removeprefix(ALSO), 0)
        + BYTES_A_TEXEL.get(stage, 0) * side * side
    )


def free_memory_mb() -> float | None:
    """MB that this machine can give to a program now; None where the system does not tell."""
    return kilobytes("MemAvailable") / 1024 or None

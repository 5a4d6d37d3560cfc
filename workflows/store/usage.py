"""`neuface store ls`: what takes space in a store, by stage and by run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.store import Store
from workflows.run.room import size_of
from workflows.store.gc import pieces
from workflows.store.roots import roots


@dataclass(frozen=True, slots=True)
class OfStage:
    """results: finished ones, and their bytes; unfinished: bytes of checkpoints and of what dead processes left."""

    stage: str
    results: int
    size: int
    unfinished: int


@dataclass(frozen=True, slots=True)
class OfRun:
    """A published folder. size: bytes of the results that it is from; alone: of those that no other folder needs."""

    out: Path
    size: int
    alone: int


@dataclass(frozen=True, slots=True)
class Usage:
    """The largest first. unneeded: bytes of finished results that no published folder is from."""

    stages: tuple[OfStage, ...]
    runs: tuple[OfRun, ...]
    unneeded: int

    @property
    def size(self) -> int:
        """Bytes of all results, finished or not."""
        return sum(s.size + s.unfinished for s in self.stages)


def usage(store: Store) -> Usage:
    """Read the sizes of all results. What a process removes meanwhile is not counted."""
    sizes, unfinished = Counter[tuple[str, str]](), Counter[str]()
    for stage, key, kind, path in pieces(store):
        if kind:
            unfinished[stage] += size_of(path)
        else:
            sizes[stage, key] += size_of(path)
    names = {stage for stage, _ in sizes} | set(unfinished)
    stages = [
        OfStage(name, sum(s == name for s, _ in sizes), sum(v for (s, _), v in sizes.items() if s == name), left)
        for name, left in ((n, unfinished[n]) for n in names)
    ]
    found = {root.out: set(root.keys.items()) for root in roots(store)}
    users = Counter(pair for pairs in found.values() for pair in pairs)
    runs = [
        OfRun(out, sum(sizes[p] for p in pairs), sum(sizes[p] for p in pairs if users[p] == 1))
        for out, pairs in found.items()
    ]
    unneeded = sum(size for pair, size in sizes.items() if pair not in users)
    return Usage(
        tuple(sorted(stages, key=lambda s: (-s.size - s.unfinished, s.stage))),
        tuple(sorted(runs, key=lambda r: (-r.size, r.out))),
        unneeded,
    )


def table(found: Usage) -> Iterator[str]:
    """Lines for people."""
    yield f"{'stage':20} {'results':>8} {'MB':>10} {'unfinished MB':>15}"
    for s in found.stages:
        yield f"{s.stage:20} {s.results:8} {s.size / 1e6:10.1f} {s.unfinished / 1e6:15.1f}"
    if found.runs:
        yield ""
        yield f"{'MB':>10} {'MB of it alone':>15}  run"
    for r in found.runs:
        yield f"{r.size / 1e6:10.1f} {r.alone / 1e6:15.1f}  {r.out}"
    yield ""
    yield f"{found.size / 1e6:.1f} MB in all, {found.unneeded / 1e6:.1f} MB of results that no published folder is from"

"""`neuface batch --dry-run`: which captures would run, and what would be made of them. Nothing is written."""

from __future__ import annotations

from collections.abc import Iterator

from workflows.batch.loop import Work, checked, prepared
from workflows.batch.neutral import subjects
from workflows.batch.request import BatchRequest
from workflows.batch.state import BatchState


def preview(request: BatchRequest) -> Iterator[str]:
    """Lines for the user.

    Raises:
        StageError: no captures. UsageError: a wrong request.
    """
    state = BatchState(request.folder)
    works = [prepared(i, state, request) for i in checked(request)]
    for work in works:
        yield f"{work.item.name:30} {_would(work)}"
    pairs = [(w.item, w.entry) for w in works]
    people = subjects(pairs, request.neutral) if request.neutral is not None else []
    for person in people:
        shapes = ", ".join(person.others) or "no other expression"
        neutral = person.neutral.name if person.neutral else "no capture of the neutral expression"
        yield f"{person.name:30} measured on {neutral}: {shapes}" if person.neutral else f"{person.name:30} {neutral}"
    if request.average:
        heads = [p for p in people if p.neutral] if request.neutral is not None else works
        yield f"{'average':30} of up to {len(heads)} heads"


def _would(work: Work) -> str:
    if work.item.fault is not None:
        return f"can't run: {work.item.fault}"
    if work.entry.state in ("waiting", "submitted"):
        return f"runs (attempt {work.entry.attempt + (work.entry.state == 'waiting')})"
    return f"{work.entry.state} before"

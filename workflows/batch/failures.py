"""Why a capture failed, and whether trying again can help.

A fault of the capture will be there again: one attempt is enough. A lost process (killed, machine gone, server away)
is tried again; so is a fit that ran out of memory, with half the rays a step. A disk that is full would fail every
capture after this one too: the batch stops; run the same command again when there is space.
"""

from __future__ import annotations

import re
from typing import Literal

from pydantic import BaseModel, ConfigDict

from pipeline.errors import Cancelled, DiskError, MemoryLimitError, NeufaceError, TimeLimitError

Kind = Literal["capture", "disk", "limit", "memory", "lost", "bug", "stopped"]
PASSES = ("lost", "memory")
BACK_OFF, LONGEST = 5.0, 300.0  # seconds before the second attempt, doubled for each further one; and at most
SMALLEST_BATCH = 256  # rays a step: below it memory is not what the fit runs out of

OWN: tuple[tuple[type[NeufaceError], Kind], ...] = (
    (DiskError, "disk"),
    (MemoryLimitError, "memory"),
    (TimeLimitError, "limit"),
    (Cancelled, "stopped"),
)
_KINDS: tuple[tuple[str, Kind], ...] = (
    (r"\bDiskError\b", "disk"),
    (r"\bMemoryLimitError\b", "memory"),
    (r"\bTimeLimitError\b", "limit"),
    (r"\bCancelled\b", "stopped"),
    (r"\b(StageError|UsageError|ParameterTypeError|ParameterBindError)\b", "capture"),
    (r"\bMemoryError\b|OutOfMemory|out of memory|allocate memory", "memory"),
    (
        r"\b(Connect|Read|Write|RemoteProtocol|LocalProtocol|PrefectHTTPStatus)Error\b"
        r"|\b(Connect|Read|Write|Pool)Timeout\b|\b(CrashedRun|ConcurrencySlotAcquisitionServiceError)\b",
        "lost",
    ),
)


class Failure(BaseModel):
    """What went wrong with one attempt."""

    model_config = ConfigDict(frozen=True)

    kind: Kind
    message: str
    stage: str | None = None

    @property
    def passes(self) -> bool:
        """Whether another attempt can help."""
        return self.kind in PASSES


def failure_of(error: BaseException, stage: str | None = None) -> Failure:
    """The failure behind an exception."""
    if isinstance(error, NeufaceError):
        kind: Kind = "capture"
        for of, named in OWN:
            if isinstance(error, of):
                kind = named
        return Failure(kind=kind, message=str(error), stage=stage)
    return failure_in(f"{type(error).__name__}: {error}", stage)


def failure_in(text: str, stage: str | None = None) -> Failure:
    """The failure behind a message that names an exception's type, such as the state of a flow run."""
    for pattern, kind in _KINDS:
        if re.search(pattern, text):
            return Failure(kind=kind, message=text, stage=stage)
    return Failure(kind="bug", message=text, stage=stage)


def back_off(attempt: int) -> float:
    """Seconds to wait after `attempt` (from 1) failed."""
    return min(LONGEST, BACK_OFF * 2.0 ** (attempt - 1))


def smaller(batch: int) -> str | None:
    """The setting that halves a fit's memory, or None when that can't be the remedy any more."""
    return f"inverse_rendering.batch={batch // 2}" if batch // 2 >= SMALLEST_BATCH else None

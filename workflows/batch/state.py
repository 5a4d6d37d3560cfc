"""The state of each capture of a batch, on disk after every change: a batch that was killed resumes from here."""

from __future__ import annotations

import hashlib
import json
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from pipeline.artifacts import RelativePath
from pipeline.verdict import Level
from workflows.batch.captures import Item
from workflows.batch.failures import Failure
from workflows.run.verdict import is_refused

State = Literal["waiting", "submitted", "done", "unusable", "failed"]
ENDED: tuple[State, ...] = ("done", "unusable")  # the run came to its end; "unusable": so its stages judged the result


class Entry(BaseModel):
    """One capture's state.

    attempt: counts every try, over all commands; it is in the key that keeps a server from running one try twice.
    level: how good the result is, where that is known.
    sets: settings changed by earlier attempts (a smaller batch). fingerprint: of request and capture files. measured:
    file of the measured expressions that the asset has, or is to get.
    """

    model_config = ConfigDict(extra="forbid")

    name: str
    capture: str
    state: State = "waiting"
    level: Level | None = None
    attempt: int = 0
    fingerprint: str = ""
    sets: tuple[str, ...] = ()
    fault: Failure | None = None
    earlier: tuple[Failure, ...] = ()
    asset: RelativePath | None = None
    measured: str = ""


class Measured(BaseModel):
    """What became of one person's expressions on the neutral. shapes: their names, each with its capture; left_out:
    captures that are no shape, with the reason; file: of the shapes; reason: why there are none."""

    model_config = ConfigDict(frozen=True)

    subject: str
    neutral: str = ""
    shapes: dict[str, str] = {}
    figures: dict[str, dict[str, float]] = {}
    left_out: dict[str, str] = {}
    file: str = ""
    reason: str = ""


class Averaged(BaseModel):
    """What became of the average head. captures: those in it; left_out: the others, with the reason; reason: why there
    is none. Figures as in pipeline.head_artifacts.AverageHead."""

    model_config = ConfigDict(frozen=True)

    captures: tuple[str, ...] = ()
    left_out: dict[str, str] = {}
    sharpness: dict[str, float] = {}
    deviation_mm: dict[str, dict[str, float]] = {}
    metric: bool = True
    reason: str = ""


@dataclass(slots=True)
class Summary:
    """The end of a batch."""

    entries: list[Entry] = field(default_factory=list)
    held: Failure | None = None  # why captures were left waiting
    measured: list[Measured] = field(default_factory=list)
    average: Averaged | None = None

    @property
    def total(self) -> int:
        """Number of captures."""
        return len(self.entries)

    @property
    def failed(self) -> int:
        """Captures whose run did not come to its end, for whatever reason."""
        return sum(e.state not in ENDED for e in self.entries)

    def refused(self, strict: bool) -> int:
        """Captures whose run ended with a result that is not good enough."""
        return sum(e.state in ENDED and is_refused(e.level, strict) for e in self.entries)

    def counts(self) -> dict[str, int]:
        """Captures by state."""
        return {
            s: sum(e.state == s for e in self.entries) for s in ("done", "unusable", "failed", "submitted", "waiting")
        }


class BatchState:
    """The entries of a batch, a file each, below `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "captures"

    def read(self, item: Item) -> Entry:
        """The entry of a capture; a new one where there is none that can be read."""
        path = self._path(item.name)
        try:
            entry = Entry.model_validate_json(path.read_bytes())
        except (OSError, ValidationError):
            return Entry(name=item.name, capture=str(item.capture))
        return entry if entry.name == item.name else Entry(name=item.name, capture=str(item.capture))

    def write(self, entry: Entry) -> None:
        """Replace the entry's file as a whole."""
        path = self._path(entry.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.partial-{uuid.uuid4().hex[:8]}")
        partial.write_text(entry.model_dump_json(indent=1))
        partial.replace(path)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name.replace('/', '__')}.json"


def idempotency_key(entry: Entry, out: str) -> str:
    """The same for the same try of the same capture, from whichever command and machine it is submitted."""
    parts = [out, entry.name, entry.fingerprint, entry.attempt]
    return "neuface-" + hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:40]

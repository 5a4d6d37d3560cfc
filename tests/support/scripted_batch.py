"""A small tree of captures, and a batch whose runs end as a script says."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pipeline.verdict import Level
from workflows.batch.failures import Failure
from workflows.batch.loop import Ended, run_batch
from workflows.batch.request import BatchRequest
from workflows.batch.state import Entry
from workflows.run.request import RunRequest


def capture_tree(folder: Path) -> Path:
    """Five captures of three subjects, out of order by name."""
    root = folder / "tree"
    for name in ("1/1_neutral", "1/2_smile", "2/1_neutral", "10/1_neutral", "10/16_grin"):
        (root / name).mkdir(parents=True)
        (root / name / "params.json").write_text("{}")
        (root / name / "0.jpg").write_bytes(name.encode())
    return root


class Scripted:
    """A Runner whose runs end as a script says: a list of faults for each capture, None when done."""

    slots = 2

    def __init__(
        self,
        out: Path,
        script: dict[str, list[Failure | None]],
        batch: int = 4096,
        levels: dict[str, Level] | None = None,
    ) -> None:
        self.out, self.script, self.batch, self.levels = out, script, batch, levels or {}
        self.started: list[tuple[str, int, tuple[str, ...]]] = []
        self.under_way: list[str] = []
        self.most = 0

    def start(self, entry: Entry, request: RunRequest) -> None:
        self.started.append((entry.name, entry.attempt, request.sets))
        self.under_way.append(entry.name)
        self.most = max(self.most, len(self.under_way))

    def poll(self) -> Iterable[Ended]:
        if not self.under_way:
            return []
        name = self.under_way.pop(0)
        fault = self.script.get(name, [None]).pop(0) if self.script.get(name) else None
        if fault is None:
            (self.out / name).mkdir(parents=True, exist_ok=True)
            (self.out / name / "run.json").write_text("{}")
        return [Ended(name, fault, self.batch, self.levels.get(name))]

    def close(self, stopped: bool) -> Iterable[Ended]:
        ended = [Ended(n, Failure(kind="stopped", message="stopped")) for n in self.under_way]
        self.under_way = []
        return ended


def request(tree: Path, **changes: Any) -> BatchRequest:
    return BatchRequest(root=str(tree), out=str(tree.parent / "out"), **changes)


LOST, MEMORY = Failure(kind="lost", message="gone"), Failure(kind="memory", message="full")
BAD, DISK = Failure(kind="capture", message="bad photo\nmore"), Failure(kind="disk", message="no space")


def go(tree: Path, script: dict[str, list[Failure | None]], **changes: Any) -> tuple[Any, Scripted]:
    asked = request(tree, **changes)
    runner = Scripted(Path(asked.out), script)
    return run_batch(asked, runner), runner

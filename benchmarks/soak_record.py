"""What a soak (benchmarks/soak.py) found: how results are judged, and its page docs/benchmarks/soak.md."""

from __future__ import annotations

import json
import os
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.kill_matrix import survivors
from benchmarks.kill_pool import PREFECTS
from pipeline.artifacts import sha256_of
from workflows.run.run_lock import is_held

ROOT = Path(__file__).resolve().parents[1]
PAGE, RECORD = ROOT / "docs/benchmarks/soak.md", ROOT / "docs/benchmarks/soak.json"
SAMPLE = 1.0  # seconds between two looks at the processes
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Found:
    """A soak. events: what happened, in words, with the captures finished by then; faults: empty if all is well.

    runs: on the server, by state; attempts: captures by their number of attempts; seconds: of the clock;
    processor_minutes: of all processes but the database, sampled each second.
    """

    made: str
    seed: int
    captures: int
    events: list[tuple[int, str]]
    runs: dict[str, int]
    attempts: dict[str, int]
    stored: int
    seconds: float
    processor_minutes: float
    faults: list[str] = field(default_factory=list)


# ------------------------------------------------------------------ what must hold
def faults_in(
    out: Path, names: list[str], stored: list[str], runs: list[tuple[str, str]], wanted: dict[str, str]
) -> Iterator[str]:
    """Nothing lost, nothing twice, nothing damaged, nothing left.

    stored: a line for each result that came into the store; runs: capture and state of every run that the server had;
    wanted: hash of each capture's asset in a batch that nothing disturbed.
    """
    store = out / ".store"
    for name in names:
        record = out / name / "run.json"
        if not record.is_file():
            yield f"{name} is lost"
        elif json.loads(record.read_text())["asset_hash"] != wanted[name]:
            yield f"{name} has other bytes than undisturbed"
        if is_held(store, out / name):
            yield f"the lock of {name} is held"
    yield from (f"made twice: {line}" for line, times in Counter(stored).items() if times > 1)
    completed = Counter(name for name, state in runs if state == "COMPLETED")
    yield from (f"{name} completed {times} times" for name, times in completed.items() if times > 1)
    yield from (f"damaged: {path}" for path in damaged(store))
    kinds = (".store/*/*.partial-*", ".store/*/*.scratch", "*/*/.*.partial-*", "*/*/.*.old-*", "batch/*.tmp*")
    yield from (f"left {path.relative_to(out)}" for kind in kinds for path in sorted(out.glob(kind)))


def damaged(store: Path) -> Iterator[Path]:
    """Files of finished results that are not what their manifests say."""
    for manifest in sorted(store.glob("*/*/manifest.json")):
        for path, digest in _hashes(json.loads(manifest.read_text())):
            file = manifest.parent / path
            if not file.is_file() or sha256_of(file) != digest:
                yield file


def _hashes(content: Any) -> Iterator[tuple[str, str]]:
    """(path, sha256) of every file that a manifest names."""
    if isinstance(content, dict) and {"path", "sha256"} <= content.keys():
        yield content["path"], content["sha256"]
    elif isinstance(content, dict | list):
        for value in content.values() if isinstance(content, dict) else content:
            yield from _hashes(value)


def temporary_faults(folder: Path) -> Iterator[str]:
    """Files in TMPDIR that are not Prefect's own."""
    for path in sorted(folder.iterdir()):
        if not any(path.match(pattern) for pattern in PREFECTS):
            yield f"left {path.name} in TMPDIR"


# ------------------------------------------------------------------ processor time
@contextmanager
def processor_time(mark: str) -> Iterator[dict[int, float]]:
    """Seconds of processor time of each process with the mark, as far as it was seen."""
    seen, stop = dict[int, float](), threading.Event()

    def look() -> None:
        while not stop.wait(SAMPLE):
            for pid in survivors(mark):
                try:
                    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                except OSError:
                    continue
                seen[pid] = (int(words[11]) + int(words[12])) / TICKS

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield seen
    finally:
        stop.set()
        thread.join()


# ------------------------------------------------------------------ the page
def page(found: Found) -> str:
    """The document."""
    runs = ", ".join(f"{count} {state.lower()}" for state, count in sorted(found.runs.items()))
    attempts = ", ".join(f"{count} in {n}" for n, count in sorted(found.attempts.items()))
    lines = [
        "# Soak",
        "",
        f"A batch of {found.captures} captures on a server with two workers (the pool of",
        "[operations.md](../operations.md)), while processes are killed, the disk runs full, the server restarts and",
        "the clock jumps. Captures are three small photos; behind the real stage capture are toys that work in steps",
        "with checkpoints. What is done when is decided by the seed, in order of finished captures. Made by",
        "",
        f"    python -m benchmarks.soak FOLDER --seed {found.seed} --captures {found.captures} --write",
        "",
        "What must hold: every capture has its asset, with the bytes of a batch that nothing disturbed; no result came",
        "into the store twice and no capture completed twice; every stored file is what its manifest says; no process,",
        "held lock, partial or scratch folder, or file of ours in TMPDIR is left.",
        "",
        "| finished captures | what happened |",
        "|---|---|",
        *(f"| {at} | {said} |" for at, said in found.events),
        "",
        f"Result: **{'no fault' if not found.faults else f'{len(found.faults)} faults'}**. Runs on the server: {runs}.",
        f"Captures by attempts that the batch counts: {attempts}. {found.stored} results were stored, for",
        f"{found.captures} captures of three stages. It took {found.seconds / 60:.0f} minutes and"
        f" {found.processor_minutes:.0f} minutes of processor time.",
        "",
        *(f"- {fault}" for fault in found.faults),
        f"Made on {found.made}.",
    ]
    return "\n".join(lines) + "\n"


def recorded() -> Found:
    """The soak of the page."""
    content = json.loads(RECORD.read_text())
    return Found(**{**content, "events": [(at, said) for at, said in content["events"]]})

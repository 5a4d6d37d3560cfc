"""What a folder of a run shows: the run at work, or what one left, and what is wrong with it. Nothing is written.

Every file may be missing, half written, of another version, or not ours at all.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import StageError
from pipeline.store import MANIFEST, read_object
from workflows.live.folder import FOLDER, FORMAT, PICTURES, STATE, is_state, read_small
from workflows.live.publisher import told
from workflows.run.moved import keys_of, store_of
from workflows.run.published import LIST, listed
from workflows.run.run_lock import is_held

REPORT = "report/index.html"
NAMED = 5  # missing files that are named
AT_WORK = ("running", "pausing", "paused", "stops after the stage")
LINKS = (  # of what a run leaves: file, words
    (REPORT, "the report"),
    ("report/metrics.json", "its figures for programs"),
    ("run.json", "the run's record"),
)


@dataclass(frozen=True, slots=True)
class Look:
    """What the page shows. alive: whether a run is at work in the folder now. state: what it tells, or the last one
    told; empty without one. record: run.json. troubles: what is wrong, each with what to do."""

    out: Path
    alive: bool
    state: dict[str, Any]
    record: dict[str, Any]
    troubles: tuple[str, ...]

    @property
    def whole(self) -> bool:
        """Whether the report says everything: the run ended, and nothing is wrong."""
        return not self.alive and not self.state and not self.troubles and (self.out / REPORT).is_file()

    def json(self) -> dict[str, Any]:
        """For the page."""
        verdict = self.record.get("verdict")
        return {
            "name": self.out.name,
            "alive": self.alive,
            "now": time.time(),
            "whole": self.whole,
            "state": self.state,
            "verdict": verdict if isinstance(verdict, dict) else {},
            "links": [{"path": p, "words": words} for p, words in LINKS if (self.out / p).is_file()],
            "troubles": list(self.troubles),
        }


def look_at(out: Path) -> Look:
    """Read the folder."""
    state = read_small(out / FOLDER / STATE)
    whole = is_state(state) and state.get("format") == FORMAT and told(state)
    record = read_object(out / "run.json")
    alive = _alive(out, state, record)
    shown = state if whole else {}
    if shown:
        pictures = shown.get("pictures")
        there = pictures if isinstance(pictures, dict) else {}
        shown["pictures"] = {n: p for n, p in there.items() if n in PICTURES and (out / FOLDER / n).is_file()}
    troubles = tuple(_troubles(out, state, shown, record, alive))
    return Look(out, alive, shown, record, troubles)


def check_is_run(out: Path) -> None:
    """Raises StageError where there is nothing that a run could have left."""
    names = ("run.json", FOLDER, "report", "asset", ".store", LIST)
    if not out.is_dir() or not any((out / n).exists() for n in names):
        raise StageError(
            "this folder holds nothing of a run",
            where=out,
            value="no such folder" if not out.is_dir() else "none of " + ", ".join(names[:5]),
            limit="the --out of a run that goes on or ended",
            remedy="name that folder; for one that begins, wait until it has read the photos",
        )


def _alive(out: Path, state: dict[str, Any], record: dict[str, Any]) -> bool:
    """Whether a process holds the run's lock, in the store of the state, of the record, or beside the results."""
    stores = [state.get("store"), record.get("store"), str(out / ".store")]
    with suppress(OSError, ValueError, StageError):
        return any(is_held(Path(s), out) for s in stores if isinstance(s, str) and s)
    return False


def _troubles(
    out: Path, told_state: dict[str, Any], state: dict[str, Any], record: dict[str, Any], alive: bool
) -> Iterator[str]:
    """What is wrong with the folder, in words."""
    if told_state and not state:
        yield f"{FOLDER}/{STATE} is damaged or of another version: how far that run was is not known."
    if not alive and state.get("status") in AT_WORK:
        yield ("The run ended without a word: its process was killed, or the machine went down. Run the same command "
               "again: finished stages and checkpoints are kept.")  # fmt: skip
    if alive or (state and not record):
        return
    if not record:
        yield "There is no run.json that can be read: no run has ended here yet, or the file is damaged."
    elif not {"stages", "request", "store"} <= record.keys() or not isinstance(record.get("stages"), dict):
        yield "run.json is of another version, or damaged: some of it is not shown."
    else:
        yield from _of_the_record(out, record)
    yield from _missing(out)


def _of_the_record(out: Path, record: dict[str, Any]) -> Iterator[str]:
    if not isinstance(record.get("verdict"), dict):
        yield "run.json has no verdict: it is of an older version. `neuface report` makes the report again."
    if "report" in record["stages"] and not (out / REPORT).is_file():
        yield f"{REPORT} is missing. Make it again with: neuface report {out}"
    if "report" not in record["stages"]:
        yield f"The run ended after {_last(record)}: there is no report of it."
    request = record["request"] if isinstance(record["request"], dict) else {}
    before = request.get("out")
    if isinstance(before, str) and before and Path(before).absolute().resolve() != out.resolve():
        lost = not store_of(record, out).is_dir()
        more = " Its store is not where it was: `neuface report` can't find finished stages." if lost else ""
        yield f"The folder was moved: the run wrote to {before}.{more}"
    elif not _has_stages(record, out):
        yield "The finished stages are no longer in the store: a next run makes them again."


def _has_stages(record: dict[str, Any], out: Path) -> bool:
    """Whether the store has the manifests of all stages."""
    store = store_of(record, out)
    return all((store / stage / key / MANIFEST).is_file() for stage, key in keys_of(record))


def _last(record: dict[str, Any]) -> str:
    return list(record["stages"])[-1] if record["stages"] else "none of the stages"


def _missing(out: Path) -> Iterator[str]:
    """Published files that are gone."""
    lost = [p for p in listed(out) if not (out / p).is_file() and not p.startswith(f"{FOLDER}/")]
    if lost:
        more = f" and {len(lost) - NAMED} more" if len(lost) > NAMED else ""
        yield f"Published files are missing: {', '.join(sorted(lost)[:NAMED])}{more}. Run the same command again."

"""Which published folders a store serves: what they name is kept, the rest is garbage sooner or later."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.store import Store, read_object
from workflows.run.moved import keys_of

ROOTS = ".roots"


@dataclass(frozen=True, slots=True)
class Root:
    """A published run: its folder, its capture's folder as requested, and the keys of its stages."""

    out: Path
    capture: str
    keys: Mapping[str, str]


def note_root(store: Store, out: Path, keys: Mapping[str, str]) -> None:
    """Remember that `out` was published from these artifacts."""
    path = store.root / ROOTS / f"{_name(out)}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.stem}.partial-{uuid.uuid4().hex[:8]}")
    partial.write_text(json.dumps({"out": str(out.resolve()), "keys": dict(keys)}))
    partial.replace(path)


def forget_root(store: Store, out: Path) -> None:
    """The folder is no longer there."""
    (store.root / ROOTS / f"{_name(out)}.json").unlink(missing_ok=True)


def notes_of_moved(store: Store, keys: Mapping[str, str]) -> Iterator[Path]:
    """Notes of a run with these keys at a place where no run is any more: they name its former folder."""
    for path in sorted((store.root / ROOTS).glob("*.json")):
        out = _out_of(path)
        if read_object(path).get("keys") == dict(keys) and out is not None and not (out / "run.json").is_file():
            yield path


def roots(store: Store) -> Iterator[Root]:
    """Every published folder that still exists, by its run.json: a later run may have replaced it."""
    folders = {_out_of(p) for p in sorted((store.root / ROOTS).glob("*.json"))}
    beside = store.root.parent  # OUT/.store: the run, or the batch's captures, in OUT
    if store.root.name == ".store":
        folders |= {p.parent for pattern in ("run.json", "*/run.json", "*/*/run.json") for p in beside.glob(pattern)}
    for out in sorted(f for f in folders if f is not None):
        record = read_object(out / "run.json")
        if _serves(store, record):
            asked = record.get("request")
            capture = str(asked.get("capture", "")) if isinstance(asked, dict) else ""
            yield Root(out, capture, dict(keys_of(record)))


def _serves(store: Store, record: dict[str, Any]) -> bool:
    """Whether run.json names this store, or one that is not known there by its place any more: a folder that was moved,
    or is mounted elsewhere, has the run's results under the run's keys."""
    if not isinstance(record.get("stages"), dict):
        return False
    if Path(str(record.get("store", ""))).resolve() == store.root.resolve():
        return True
    return any(store.folder(stage, key).is_dir() for stage, key in keys_of(record))


def _out_of(path: Path) -> Path | None:
    out = read_object(path).get("out")
    return Path(out) if isinstance(out, str) else None


def _name(out: Path) -> str:
    return hashlib.sha256(str(out.resolve()).encode()).hexdigest()[:32]

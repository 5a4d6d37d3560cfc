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


def roots(store: Store) -> Iterator[Root]:
    """Every published folder that still exists, by its run.json: a later run may have replaced it."""
    folders = {_out_of(p) for p in sorted((store.root / ROOTS).glob("*.json"))}
    beside = store.root.parent  # OUT/.store: the run, or the batch's captures, in OUT
    if store.root.name == ".store":
        folders |= {p.parent for pattern in ("run.json", "*/run.json", "*/*/run.json") for p in beside.glob(pattern)}
    for out in sorted(f for f in folders if f is not None):
        record = read_object(out / "run.json")
        stages = record.get("stages")
        if isinstance(stages, dict) and _serves(store, record):
            keys = {n: str(s["key"]) for n, s in stages.items() if isinstance(s, dict) and "key" in s}
            yield Root(out, str(record.get("request", {}).get("capture", "")), keys)


def _serves(store: Store, record: dict[str, Any]) -> bool:
    return Path(str(record.get("store", ""))).resolve() == store.root.resolve()


def _out_of(path: Path) -> Path | None:
    out = read_object(path).get("out")
    return Path(out) if isinstance(out, str) else None


def _name(out: Path) -> str:
    return hashlib.sha256(str(out.resolve()).encode()).hexdigest()[:32]

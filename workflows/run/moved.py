"""The store of a finished run, also where its folder was moved or is mounted at another place since."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from workflows.run.request import OWN_STORE


def store_of(record: Mapping[str, Any], out: Path) -> Path:
    """Where run.json says; if that is gone, OUT's own store, which moves with OUT. It need not exist."""
    recorded, own = Path(str(record.get("store") or OWN_STORE)), out / OWN_STORE
    return own if not recorded.is_dir() and own.is_dir() else recorded


def keys_of(record: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """(stage, key) of each finished stage that run.json names."""
    stages = record.get("stages")
    for name, stage in stages.items() if isinstance(stages, Mapping) else ():
        if isinstance(stage, Mapping) and stage.get("key"):
            yield name, str(stage["key"])

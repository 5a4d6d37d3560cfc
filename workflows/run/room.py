"""Is there enough room, on a disk and of addresses? Asked before the work, not after minutes of it.

What is asked for is the least that will surely be written: sizes of files that are copied, and a few bytes a texel. A
disk that fills up all the same is reported when a write fails (`pipeline/errors.py`).
"""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pipeline.contract import Stage, StageConfig, key
from pipeline.errors import DiskError, StageError
from pipeline.store import MANIFEST, Store, file_refs

SPARE = 4 << 20  # bytes: manifests, records, and a stage's small files
BYTES_A_TEXEL = 8  # of all maps together; those of the demo's head have 67
ADDRESSES = 6e9  # bytes: libraries end the process, without a word, where they get none. A draft uses up to 5e9
# Stage -> inputs whose files it copies.
COPIED = {"capture": ("source",), "also_capture": ("also_source",), "usd": ("bake",)}


def check_room_for_stage(stage: Stage[Any, Any, Any], inputs: Any, config: StageConfig, store: Store) -> None:
    """Raises DiskError if the store's disk has less room than the stage needs; a stored result needs none."""
    if not (store.folder(stage.name, key(stage, inputs, config)) / MANIFEST).is_file():
        check_room(store.root, least(stage.name, inputs, config), f"for the stage {stage.name}", "--store")


def check_room_for_copies(out: Path, files: Iterable[Path]) -> None:
    """Raises DiskError if the disk of `out` has less free bytes than copies of the files have."""
    check_room(out, SPARE + sum(p.stat().st_size for p in files), "for the results", "--out")


def least(stage: str, inputs: Any, config: StageConfig) -> int:
    """Bytes that a stage writes at least, less than half of what is measured."""
    copied = (getattr(inputs, name, None) for name in COPIED.get(stage, ()))
    size = sum(ref.size for located in copied if located is not None for ref in file_refs(located.artifact))
    texels = int(getattr(config, "size", 0)) ** 2 if stage == "bake" else 0
    return SPARE + size + BYTES_A_TEXEL * texels


def check_addresses() -> None:
    """Raises StageError where the shell limits a process's address space (ulimit -v) below what a run needs."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < ADDRESSES:
        raise StageError(
            "this process may use too little memory",
            where="the shell's limit of the address space (ulimit -v)",
            value=f"{limit / 1e9:.1f} GB",
            limit=f"at least {ADDRESSES / 1e9:.0f} GB, or none",
            remedy="ulimit -v unlimited; to limit memory, use a control group (systemd-run -p MemoryMax=8G)",
        )


def size_of(folder: Path) -> int:
    """Bytes of the files below a folder; links are not followed."""
    return sum(p.lstat().st_size for p in folder.rglob("*") if p.is_file() and not p.is_symlink())


def check_room(folder: Path, needed: int, what: str, option: str) -> None:
    """Raises DiskError if less than `needed` bytes are free for this user on the disk of `folder`, which may not exist.

    A file system that does not know its free bytes has enough.
    """
    free = free_bytes(folder)
    if free is not None and free < needed:
        raise DiskError(
            "not enough space is left on the disk",
            where=folder,
            value=f"{free / 1e6:.1f} MB free on the disk of {_mount_of(_nearest(folder))}",
            limit=f"at least {needed / 1e6:.1f} MB {what}",
            remedy=f"free space on this disk, or choose another one with {option}; finished stages are kept",
        )


def free_bytes(folder: Path) -> int | None:
    """Bytes that are free for this user on the disk of a folder, which may not exist; None if it does not tell."""
    total, _, free = shutil.disk_usage(_nearest(folder))
    return free if total > 0 else None


def _nearest(folder: Path) -> Path:
    """The folder, or the first above it that exists."""
    return next(p for p in (folder, *folder.absolute().parents) if p.is_dir())


def _mount_of(folder: Path) -> Path:
    place = folder.resolve()
    while not os.path.ismount(place):
        place = place.parent
    return place

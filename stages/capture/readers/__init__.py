"""Ways in which a capture says where its cameras were: one module each, found by looking at the folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.artifacts import CaptureKind
from stages.capture.readers import colmap, facescape, idr, metashape, realityscan, transforms
from stages.capture.readers.described import Described, Reader

# the most explicit first: a COLMAP model is often the by-product of a transforms.json beside it
READERS: dict[CaptureKind, Reader] = {
    "facescape": facescape,
    "transforms": transforms,
    "idr": idr,
    "metashape": metashape,
    "realityscan": realityscan,
    "colmap": colmap,
}


def find_reader(folder: Path) -> tuple[CaptureKind, list[Path]] | None:
    """The kind of description in `folder` and its files, or None: photos alone."""
    for kind, reader in READERS.items():
        files = reader.find(folder)
        if files:
            return kind, files
    return None


def describe(kind: CaptureKind, folder: Path, files: Sequence[Path]) -> Described:
    """What the files of that kind say of the views."""
    return READERS[kind].read(folder, files)


__all__ = ["READERS", "Described", "Reader", "describe", "find_reader"]

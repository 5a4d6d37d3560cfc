"""Readers of given cameras: one module for each format. The format is detected from the folder's files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.capture_artifacts import CaptureKind
from stages.capture.readers import colmap, facescape, idr, metashape, olat, realityscan, transforms
from stages.capture.readers.described import Described, Reader

# the most explicit first: a light stage has FaceScape's params.json too,
# and a COLMAP model is often the by-product of a transforms.json beside it
READERS: dict[CaptureKind, Reader] = {
    "olat": olat,
    "facescape": facescape,
    "transforms": transforms,
    "idr": idr,
    "metashape": metashape,
    "realityscan": realityscan,
    "colmap": colmap,
}


def find_reader(folder: Path) -> tuple[CaptureKind, list[Path]] | None:
    """The format of the cameras' files in `folder`, and these files; None for photos alone."""
    for kind, reader in READERS.items():
        files = reader.find(folder)
        if files:
            return kind, files
    return None


def describe(kind: CaptureKind, folder: Path, files: Sequence[Path]) -> Described:
    """The views of the cameras' files of that format."""
    return READERS[kind].read(folder, files)


__all__ = ["READERS", "Described", "Reader", "describe", "find_reader"]

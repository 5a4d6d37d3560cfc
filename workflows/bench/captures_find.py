"""Which captures lie in a folder, what is run of each, and which of its photos are held out.

A folder's own `truth/` is only for scoring: no run gets its path, and no reader of captures opens it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import UsageError
from workflows.batch.captures import natural

PROJECT = Path(__file__).resolve().parents[2]
DEFAULT_ROOT = PROJECT.parent / "shared" / "captures"  # beside the project
PHOTOS = "images"
LIGHT_STAGE = ("lights.json", "olat")  # photos with one light at a time
ALL_ON, CAMERAS = "full_on", "params.json"  # of a light stage: the photos with all lights on, and their cameras
NO_ALL_ON = f"light stage without photos in {ALL_ON}/ or without {CAMERAS}"
NO_PHOTOS = "no photos and no cameras that are understood"

# What a figure over held-out views was measured on must never change: the captures' own rule, by name.
HELD_OUT = {
    "head_a": "every:5:2",
    "head_b": "every:5:2",
    "person_e": "every:5:2",
    "skull_studio": "every:7:3",
}
HELD_OUT_ELSE = "every:8:3"


@dataclass(frozen=True, slots=True)
class Found:
    """A capture. folder: all of it, with its truth; capture: what a run is given; skipped: why it can't be run."""

    name: str
    folder: Path
    capture: Path
    holdout: str
    skipped: str = ""


def root_of(given: str | None) -> Path:
    """The folder of captures. UsageError if it is not there."""
    root = Path(given) if given is not None else DEFAULT_ROOT
    if root.is_dir():
        return root.resolve()
    raise UsageError(
        "there is no folder of captures",
        where="--root",
        value="a file" if root.exists() else "nothing" if given is not None else "none given, none beside the project",
        limit="a folder with one folder for each capture",
        remedy="name it with --root",
    )


def find(root: Path, only: Sequence[str] = (), holdout: str | None = None) -> list[Found]:
    """Every capture of a folder, or those that are named, in natural order. UsageError for a name that is not there."""
    folders = sorted((p for p in root.iterdir() if p.is_dir() and p.name[0] != "."), key=lambda p: natural(p.name))
    names = [p.name for p in folders]
    unknown = [n for n in only if n not in names]
    if unknown or not names:
        raise UsageError(
            "there is no such capture" if unknown else "there are no captures",
            where=root,
            value=", ".join(unknown) or "no folder",
            limit="one of " + ", ".join(names) if names else "one folder for each capture",
            remedy="check the names after --only" if unknown else "name another folder with --root",
        )
    return [_found(p, holdout) for p in folders if not only or p.name in only]


def _found(folder: Path, holdout: str | None) -> Found:
    rule = holdout or HELD_OUT.get(folder.name, HELD_OUT_ELSE)
    if all((folder / n).exists() for n in LIGHT_STAGE):
        whole = (folder / CAMERAS).is_file() and _readable(folder / ALL_ON)
        return Found(folder.name, folder, folder, rule, "" if whole else NO_ALL_ON)
    for place in (folder, folder / PHOTOS):
        if _readable(place):
            return Found(folder.name, folder, place, rule)
    return Found(folder.name, folder, folder, rule, NO_PHOTOS)


def _readable(folder: Path) -> bool:
    """Whether it is a capture that a run can read; nothing is decoded or hashed."""
    from stages.capture.readers import find_reader
    from stages.capture.readers.described import PHOTO_SUFFIXES
    from stages.capture.scan import FILM_SUFFIXES

    if not folder.is_dir():
        return False
    suffixes = [p.suffix.lower() for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    if any(s in PHOTO_SUFFIXES for s in suffixes) or sum(s in FILM_SUFFIXES for s in suffixes) == 1:
        return True
    return find_reader(folder) is not None

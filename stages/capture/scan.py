"""Recognises what lies in the user's folder and hashes it; nothing is decoded here.

Understood: a FaceScape folder (`params.json` beside `{index}.jpg|jpeg|png|tif|tiff|exr`) or a plain folder of photos;
in both, `mask/` or `masks/` with one file per photo, matched by stem. Hidden files and other sub-folders are ignored.
"""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.artifacts import CaptureSource, FileRef, Located
from pipeline.errors import StageError
from stages.capture.facescape import read_params, view_indices

PARAMS = "params.json"
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
FOREIGN_SUFFIXES = (".heic", ".heif", ".webp", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".bmp")
MASK_FOLDERS = ("mask", "masks")
MIN_PHOTOS = 3  # two views leave depth along their common line open, and nothing to check it against


def scan_capture(folder: Path) -> Located[CaptureSource]:
    """What `folder` holds, by content.

    Raises:
        StageError: no such folder, no photos or too few of them, `params.json` is not readable, two files for one view.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "nothing"
        raise StageError(
            "the capture folder is not there",
            where=folder,
            value=kind,
            limit="a folder with photos",
            remedy="check the path; name the folder that holds the photos, not a photo",
        )
    params = folder / PARAMS
    photos = _pictures(folder)
    if params.is_file():
        photos = _named_by(params, photos)
    if not photos:
        raise _no_photos(folder, params.is_file())
    if len(photos) < MIN_PHOTOS:
        found = ", ".join(p.name for p in photos)
        raise StageError(
            "too few photos",
            where=folder,
            value=f"{len(photos)} ({found})",
            limit=f"at least {MIN_PHOTOS} views",
            remedy="photograph the subject from more sides; 30 to 60 views all around serve best",
        )
    source = CaptureSource(
        kind="facescape" if params.is_file() else "photos",
        photos=tuple(FileRef.of(folder, p) for p in photos),
        params=FileRef.of(folder, params) if params.is_file() else None,
        masks=tuple(FileRef.of(folder, p) for p in _masks_of(folder, photos)),
    )
    return Located(source, folder)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts 2.jpg before 10.jpg."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(p), p) if p.isdecimal() else (1, 0, p.lower()) for p in parts)


def _pictures(folder: Path) -> list[Path]:
    """Photos directly in the folder, in natural order."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES)
    return sorted((p for p in found if not p.name.startswith(".") and p.is_file()), key=lambda p: natural_key(p.name))


def _named_by(params: Path, photos: list[Path]) -> list[Path]:
    """The photos that params.json names, by index. One file per view."""
    indices = set(view_indices(read_params(params)))
    named: dict[int, Path] = {}
    for photo in photos:
        if not photo.stem.isdecimal() or int(photo.stem) not in indices:
            continue
        index = int(photo.stem)
        if index in named:
            raise StageError(
                "two photos for one view",
                where=f"view {index}",
                value=f"{named[index].name} and {photo.name}",
                limit="one file per view",
                remedy="take one of them out of the folder",
            )
        named[index] = photo
    return [named[i] for i in sorted(named)]


def _masks_of(folder: Path, photos: list[Path]) -> list[Path]:
    """Mask files that belong to a photo: `STEM.png`, or the photo's whole name and a suffix (`a.jpg.png`)."""
    present = [folder / m for m in MASK_FOLDERS if (folder / m).is_dir()]
    if len(present) > 1:
        raise StageError(
            "two folders of masks",
            where=folder,
            value="mask/ and masks/",
            limit="one of them",
            remedy="rename or remove one",
        )
    owners = {name: p for p in photos for name in (p.stem, p.name)}
    found: dict[Path, Path] = {}
    for mask in _pictures(present[0]) if present else []:
        owner = owners.get(mask.stem)
        if owner is not None and owner in found:
            raise StageError(
                "two masks for one photo",
                where=owner.name,
                value=f"{found[owner].name} and {mask.name}",
                limit="one mask per photo",
                remedy="take one of them out of the folder",
            )
        if owner is not None:
            found[owner] = mask
    return [found[p] for p in photos if p in found]


def _no_photos(folder: Path, has_params: bool) -> StageError:
    foreign = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in FOREIGN_SUFFIXES)
    deeper = sorted(p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".") and _pictures(p))
    value, remedy = "none", "put the photos directly into this folder"
    if has_params:
        value, remedy = "none that params.json names", "put 0.jpg, 1.jpg, ... beside params.json"
    elif foreign:
        value, remedy = f"{len(foreign)} files such as {foreign[0]}", "convert them to JPEG, PNG, TIFF or EXR"
    elif deeper:
        value, remedy = f"none here, some in {deeper[0]}/", f"name {deeper[0]}/ as the capture, or move the photos up"
    return StageError(
        "no photos in the capture folder",
        where=folder,
        value=value,
        limit="at least 3 of " + " ".join(s[1:] for s in PHOTO_SUFFIXES),
        remedy=remedy,
    )

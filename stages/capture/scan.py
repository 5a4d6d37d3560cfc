"""Detects the format of the user's folder and hashes its files; no picture is decoded here.

Supported: a folder with a cameras' file (`stages.capture.readers`), a plain folder of photos, a folder with one video.
Beside photos, `mask/` or `masks/` may have one file per photo, matched by stem, and `clean_plate/` the same views
without the subject. `shots.py` says how several photos of one view are recognised. Hidden files and other sub-folders
are ignored.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import CaptureKind, CaptureSource
from pipeline.errors import StageError
from pipeline.transforms import rows
from stages.capture.readers import describe, facescape, find_reader, idr, transforms
from stages.capture.readers.described import (
    HEIF_SUFFIXES,
    PHOTO_SUFFIXES,
    RAW_SUFFIXES,
    Declared,
    Described,
    natural_key,
)
from stages.capture.readers.facescape_scale import metres_from_world
from stages.capture.readers.olat import Pictures, pictures_of
from stages.capture.readers.values import printable
from stages.capture.shots import Shots, grouped

FILM_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
FOREIGN_SUFFIXES = (".heic", ".heif", ".webp", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".bmp",
                    ".jxl", ".jp2", ".jfif", ".rw2", ".orf", ".pef", ".srw", ".hif", ".heics", ".gif", ".psd", ".tga",
                    ".crw", ".x3f", ".3fr", ".fff", ".iiq", ".nrw", ".rwl", ".erf", ".kdc", ".dcr", ".mrw", ".sr2",
                    ".srf", ".gpr")  # fmt: skip
CAMERA_FILES = (*transforms.NAMES, *idr.NAMES, facescape.PARAMS)
# In this order of preference: linear floats, then 16 bits where the format has them, then the camera's own picture. A
# raw file comes last, because its colours are not those that the photographer chose.
KINDS = ((".exr",), (".tif", ".tiff"), (".png",), (".jpg", ".jpeg"), HEIF_SUFFIXES, RAW_SUFFIXES)
MASK_FOLDERS, PLATE_FOLDERS = ("mask", "masks"), ("clean_plate",)
MIN_PHOTOS = 3  # two views leave the depth along their common line undetermined, and nothing can check it


def scan_capture(folder: Path) -> Located[CaptureSource]:
    """The files of `folder` with their hashes, and its format. `folder` may also be a video file.

    Raises:
        StageError: no such folder, no photos or too few of them, cameras that can't be read, two files for one view.
    """
    folder = Path(folder).absolute()
    if folder.is_file() and folder.suffix.lower() in FILM_SUFFIXES:
        return _video(folder)
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "nothing"
        raise StageError(
            "the capture folder does not exist",
            where=folder,
            value=kind,
            limit="a folder with photos",
            remedy="check the path; give the folder that contains the photos, not a photo",
        )
    for name in CAMERA_FILES:  # a link that leads nowhere must not turn given cameras into solved ones
        _is_readable_file(folder / name)
    found = find_reader(folder)
    if found is not None:
        return _described(folder, *found)
    found_photos = _photos(folder)
    shots = grouped(folder, found_photos, partial(_photos, beside=found_photos), given=False)
    photos = shots.photos
    videos = [p for p in sorted(folder.iterdir()) if p.suffix.lower() in FILM_SUFFIXES and not p.name.startswith(".")]
    if not photos and len(videos) == 1:
        return _video(videos[0])
    if not photos:
        raise _no_photos(folder, videos)
    _enough(folder, [p.name for p in photos])
    masks, plates = _beside(folder, photos, MASK_FOLDERS, "mask"), _beside(folder, photos, PLATE_FOLDERS, "plate")
    return Located(_source("photos", folder, photos, [], masks, plates, shots), folder)


def _described(folder: Path, kind: CaptureKind, files: Sequence[Path]) -> Located[CaptureSource]:
    described = describe(kind, folder, files)
    photos = [v.photo for v in described.views if v.photo is not None]
    if not photos:
        raise _none_named(folder, files[0], described)
    _once(described.views)
    shots = grouped(folder, photos, partial(_photos, beside=photos), given=True)
    masks = {v.photo: v.mask for v in described.views if v.photo is not None and v.mask is not None}
    by_stem = (
        _beside(folder, [p for p in photos if p not in masks], MASK_FOLDERS, "mask") if len(masks) < len(photos) else []
    )
    plates = _beside(folder, photos, PLATE_FOLDERS, "plate")
    return Located(_source(kind, folder, shots.photos, files, [*masks.values(), *by_stem], plates, shots), folder)


def _source(
    kind: CaptureKind,
    folder: Path,
    photos: Sequence[Path],
    cameras: Sequence[Path],
    masks: Sequence[Path],
    plates: Sequence[Path],
    shots: Shots,
) -> CaptureSource:
    pictures = pictures_of(folder) if kind == "olat" else Pictures()
    stage = sorted([*pictures.single.values(), *pictures.tracking.values()])
    for path in (*photos, *cameras, *masks, *plates, *stage, *shots.files()):
        _can_be_written(path)
    refs = [tuple(FileRef.of(folder, p) for p in files) for files in (photos, cameras, masks, plates, stage)]
    world = metres_from_world(folder) if kind == "facescape" else None
    brackets, pairs = shots.manifest(folder)
    return CaptureSource(kind=kind, photos=refs[0], cameras=refs[1], masks=refs[2], plates=refs[3],
                         metres_from_world=None if world is None else rows(world),
                         passed_over=_passed_over(photos), stage=refs[4], brackets=brackets, pairs=pairs,
                         twins=() if cameras else _twins(shots))  # fmt: skip


def _passed_over(photos: Sequence[Path]) -> tuple[str, ...]:
    """Names of the pictures beside the photos whose format is not supported. A raw or HEIC file with a photo's stem is
    that photo's original, and is not listed."""
    read = {(p.parent, p.stem) for p in photos}
    beside = sorted({f for p in {q.parent for q in photos} for f in p.iterdir()}, key=lambda f: natural_key(f.name))
    foreign = (f for f in beside if f.suffix.lower() in FOREIGN_SUFFIXES and not f.name.startswith("."))
    return tuple(printable(f.name) for f in foreign if (f.parent, f.stem) not in read)


def _can_be_written(path: Path) -> None:
    """Raises StageError for a file name that is not UTF-8: a manifest can't contain it."""
    if path.name != path.name.encode("utf-8", "replace").decode():
        raise StageError(
            "a file's name is not UTF-8",
            where=ascii(path.name),
            value="bytes that are not characters",
            limit="names in UTF-8",
            remedy="rename the file; letters, digits, _ and - are safe everywhere",
        )


def _video(path: Path) -> Located[CaptureSource]:
    return Located(CaptureSource(kind="video", photos=(FileRef.of(path.parent, path),)), path.parent)


def _enough(folder: Path, names: Sequence[str]) -> None:
    if len(names) < MIN_PHOTOS:
        raise StageError(
            "too few photos",
            where=folder,
            value=f"{len(names)} ({', '.join(names)})",
            limit=f"at least {MIN_PHOTOS} views",
            remedy="photograph the subject from more sides; 30 to 60 views all around are best",
        )


def _once(views: Sequence[Declared]) -> None:
    """Raises StageError if two views have the same photo or the same number."""
    for what in ("photo", "number"):
        of: dict[object, str] = {}
        for view in views:
            mark = view.photo if what == "photo" else view.index
            if mark in of:
                raise StageError(
                    f"two views have the same {what}",
                    where=view.name,
                    value=f"{of[mark]} and {view.name}",
                    limit=f"a different {what} for each view",
                    remedy="remove one of them from the cameras' file",
                )
            of[mark] = view.name


def _photos(folder: Path, beside: Sequence[Path] = ()) -> list[Path]:
    """Photos directly in the folder, in natural order: of files with one stem the one of the first of KINDS.

    beside: photos that are taken already. They are preferred, and files of their formats to others: the second photos
    of pairs and clean plates are compared with them.
    """
    chosen, like = set(beside), {p.suffix.lower() for p in beside}

    def rank(path: Path) -> tuple[bool, bool, int]:
        suffix = path.suffix.lower()
        return path not in chosen, suffix not in like, next(i for i, kind in enumerate(KINDS) if suffix in kind)

    of_stem: dict[str, Path] = {}
    for path in sorted(_pictures(folder, [s for kind in KINDS for s in kind]), key=rank):
        of_stem.setdefault(path.stem, path)
    return sorted(of_stem.values(), key=lambda p: natural_key(p.name))


def _twins(shots: Shots) -> tuple[str, ...]:
    """Names of the files beside the photos that are the same photo in another format."""
    used = {*shots.photos, *shots.files()}
    stems, known = {(p.parent, p.stem) for p in used}, {s for kind in KINDS for s in kind}
    beside = sorted({f for p in {q.parent for q in used} for f in p.iterdir()}, key=lambda f: natural_key(f.name))
    return tuple(printable(f.name) for f in beside
                 if f not in used and (f.parent, f.stem) in stems and f.suffix.lower() in known)  # fmt: skip


def _pictures(folder: Path, suffixes: Sequence[str] = PHOTO_SUFFIXES) -> list[Path]:
    """Pictures directly in the folder, in natural order. Raises StageError if one of them is no file."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    for path in found:
        _is_readable_file(path)
    return sorted((p for p in found if p.is_file()), key=lambda p: natural_key(p.name))


def _is_readable_file(path: Path) -> None:
    """Raises StageError for a link that leads nowhere, a pipe or a device. Nothing, a file and a folder are none."""
    if os.path.lexists(path) and not path.is_file() and not path.is_dir():
        link = path.is_symlink()
        raise StageError(
            "this is no file",
            where=printable(str(path)),
            value=f"a link to {printable(str(path.readlink()))}" if link else "a pipe, a socket or a device",
            limit="a file, or a link to one",
            remedy="put the file back that it leads to, or remove it" if link else "remove it from the folder",
        )


def _beside(folder: Path, photos: Sequence[Path], folders: Sequence[str], what: str) -> list[Path]:
    """The photos' masks or clean plates: `STEM.png`, or the photo's whole name and a suffix (`a.jpg.png`)."""
    present = [folder / m for m in folders if (folder / m).is_dir()]
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
    plate = folders == PLATE_FOLDERS  # a clean plate is a photo, a mask is drawn
    for mask in (_photos(present[0], photos) if plate else _pictures(present[0])) if present else []:
        owner = owners.get(mask.stem)
        if owner is not None and owner in found:
            raise StageError(
                f"two {what}s for one photo",
                where=owner.name,
                value=f"{found[owner].name} and {mask.name}",
                limit=f"one {what} per photo",
                remedy="remove one of them from the folder",
            )
        if owner is not None:
            found[owner] = mask
    return [found[p] for p in photos if p in found]


def _none_named(folder: Path, description: Path, described: Described) -> StageError:
    foreign = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in FOREIGN_SUFFIXES)
    value = described.warnings[0] if described.warnings else "; ".join(described.left_out[:3]) or "none"
    remedy = "put the photos where the file expects them, or into images/; or remove the file to solve the cameras"
    if description.name == "params.json":
        remedy = "put 0.jpg, 1.jpg, ... beside params.json"
    if foreign:
        remedy = f"convert files such as {foreign[0]} to JPEG, PNG, TIFF or EXR"
    return StageError(
        "no photos in the capture folder",
        where=folder,
        value=f"none of those that {description.name} lists: {value}",
        limit=f"at least {MIN_PHOTOS} of " + " ".join(s[1:] for s in PHOTO_SUFFIXES),
        remedy=remedy,
    )


def _no_photos(folder: Path, videos: Sequence[Path]) -> StageError:
    foreign = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in FOREIGN_SUFFIXES)
    deeper = sorted(p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".") and _photos(p))
    value, remedy = "none", "put the photos directly into this folder"
    if foreign:
        value, remedy = f"{len(foreign)} files such as {foreign[0]}", "convert them to JPEG, PNG, TIFF or EXR"
    elif videos:
        value, remedy = f"{len(videos)} videos", f"give one of them as the capture, such as {videos[0].name}"
    elif deeper:
        value, remedy = f"none here, some in {deeper[0]}/", f"give {deeper[0]}/ as the capture, or move the photos up"
    return StageError(
        "no photos in the capture folder",
        where=folder,
        value=value,
        limit=f"at least {MIN_PHOTOS} of " + " ".join(s[1:] for s in (*PHOTO_SUFFIXES, *HEIF_SUFFIXES, *RAW_SUFFIXES)),
        remedy=remedy,
    )

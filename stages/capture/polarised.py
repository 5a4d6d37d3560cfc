"""Imports the parallel-polarised photos of a capture's pairs, and checks each against its cross-polarised one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import CaptureSource, CaptureView
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import F32, read_alpha, read_linear
from stages.capture import hdr
from stages.capture.candidates import Candidate
from stages.capture.import_photo import ImportedPhoto, import_photo
from stages.capture.readers.values import some_of

BRIGHTER = 1.01  # of the parallel photo's mean: a cross-polarised one that is brighter is not what it is said to be
ALIKE = 0.99  # of it: above, the filters do not differ, or nothing shines
MIDDLE = 0.5  # of the frame's edges: where photos are compared
NAMED = 5


def with_pairs(
    source: Located[CaptureSource], candidates: Sequence[Candidate], views: list[CaptureView],
    photos: Sequence[ImportedPhoto], warnings: list[str], context: Context,
) -> list[CaptureView]:  # fmt: skip
    """The views with their parallel-polarised photos. A pair whose camera moved in between keeps the cross-polarised
    photo only, and is named.

    Raises:
        StageError: sizes differ, or a cross-polarised photo is brighter than its parallel one.
    """
    out, moved, alike = [], [], []
    for done, (candidate, view, photo) in enumerate(zip(candidates, views, photos, strict=True)):
        if candidate.parallel is None:
            out.append(view)
            continue
        context.check()
        context.progress(done, len(views), f"checking the pair of {candidate.name}")
        target = context.workdir / "parallel" / f"{candidate.index}_{PurePath(candidate.parallel.path).name}"
        other = import_photo(source.path(candidate.parallel), candidate.parallel, target, candidate.size)
        _one_size(candidate, photo, other)
        exposure = _exposure(photo, other)
        cross, parallel = read_linear(photo.image), read_linear(other.image)
        found = hdr.compare(cross, parallel, exposure)
        if found.known and found.shift != (0.0, 0.0):  # highlights alone are no reason
            moved.append(candidate.name)
            _forget(other)
            out.append(view)
            continue
        share = _ratio(cross, parallel / np.float32(exposure), (photo.clipped, other.clipped))
        if share > BRIGHTER:
            raise _brighter(candidate, share)
        if share > ALIKE:
            alike.append(candidate.name)
        out.append(view.model_copy(update={
            "parallel": FileRef.of(context.workdir, other.image), "parallel_exposure": round(exposure, 6),
            "parallel_clipped": None if other.clipped is None else FileRef.of(context.workdir, other.clipped),
        }))  # fmt: skip
    if moved:
        warnings.append(f"the camera moved between the photos of {len(moved)} polarised pairs "
                        f"({some_of(moved, NAMED)}); their parallel-polarised photos are not used; "
                        "use a tripod")  # fmt: skip
    if alike:
        warnings.append(f"the photos of {len(alike)} polarised pairs hardly differ "
                        f"({some_of(alike, NAMED)}): the filters are not crossed, or nothing shines")  # fmt: skip
    return out


def _forget(photo: ImportedPhoto) -> None:
    photo.image.unlink()
    if photo.clipped is not None:
        photo.clipped.unlink()


def _one_size(candidate: Candidate, photo: ImportedPhoto, other: ImportedPhoto) -> None:
    assert candidate.parallel is not None
    if (other.width, other.height) != (photo.width, photo.height):
        raise StageError(
            "the photos of a polarised pair are not of one size",
            where=f"{candidate.name} and {PurePath(candidate.parallel.path).name}",
            value=f"{photo.width} x {photo.height} and {other.width} x {other.height}",
            limit="one size",
            remedy="give original files of one camera; or capture.polarised=off, which uses the cross-polarised ones",
        )


def _exposure(photo: ImportedPhoto, other: ImportedPhoto) -> float:
    """Exposure of the parallel photo over that of the cross one, by EXIF; 1 if it is unknown."""
    one, two = photo.exif.exposure, other.exif.exposure
    return 1.0 if one is None or two is None else two / one


def _ratio(cross: F32, parallel: F32, ends: tuple[Path | None, Path | None]) -> float:
    """Mean of the cross photo over that of the parallel one, where neither is clipped, in the middle of the frame."""
    free = np.ones(cross.shape[:2], np.bool_)
    for path in ends:
        if path is not None:
            free &= read_alpha(path) == 0
    height, width = cross.shape[:2]
    h, w = round((1 - MIDDLE) / 2 * height), round((1 - MIDDLE) / 2 * width)
    inside = np.zeros((height, width), np.bool_)
    inside[h : height - h, w : width - w] = True
    free &= inside
    below = float(parallel[free].mean()) if free.any() else 0.0
    return float(cross[free].mean()) / below if below > 0 else 0.0


def _brighter(candidate: Candidate, share: float) -> StageError:
    assert candidate.parallel is not None
    return StageError(
        "a cross-polarised photo is brighter than its parallel-polarised one",
        where=f"{candidate.name} and {PurePath(candidate.parallel.path).name}",
        value=f"{share:.3f} times as bright",
        limit=f"{BRIGHTER}",
        remedy="exchange the two if their names are the wrong way round; take both at one exposure, or with EXIF; or "
        "set capture.polarised=off",
    )

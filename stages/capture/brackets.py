"""Photos of one view at several exposures become one linear photo per view; the maths is in hdr.py.

All views of a capture with brackets are stored as 16-bit float EXR in one unit: that of the median view's own photo,
times one gain, so that nearly all of what is in the middle of the frames is below 1. A view whose photos can't be
merged keeps its middle exposure, in the same unit.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path, PurePath

import numpy as np

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import CaptureSource
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import F32, read_encoded, write_exr
from stages.capture import hdr
from stages.capture.candidates import Candidate
from stages.capture.exif import Exif
from stages.capture.import_photo import Decoded, decoded
from stages.capture.photometry import EQUAL

STATED = 1 / 3  # stops by which a name or brackets.json may differ from EXIF: cameras step in thirds and round
BRIGHTEST, LEVEL = 0.99, 0.9  # this quantile of the middle half of the frames becomes this value
MIDDLE = 0.5  # of the frame's edges


@dataclass(frozen=True, slots=True)
class MergedView:
    """A view's merged photo on disk: values in its own unit; exposure: EXIF's of that unit, None if unknown. count:
    number of exposures in it. top: brightest values in the middle of the frame."""

    values: Path
    ends: Path
    exif: Exif
    profile: str | None
    exposure: float | None
    count: int
    top: float


class MergedPhotos:
    """The merged photos of a capture. `photo` gives one in the common unit; `count` the exposures in it. held: numbers
    of held-out views, which do not decide the gain."""

    def __init__(self, views: dict[int, MergedView], held: Set[int]) -> None:
        self._views = views
        known = [v.exposure for v in views.values()]
        exposures = [e for e in known if e is not None]
        self._common = float(np.median(exposures)) if len(exposures) == len(known) and exposures else None
        tops = [v.top * self._scale(v) for n, v in views.items() if n not in held]
        top = float(np.median(tops)) if tops else 0.0
        self.gain = round(min(1.0, LEVEL / top), 6) if top > 0 else 1.0

    def _scale(self, view: MergedView) -> float:
        return 1.0 if self._common is None or view.exposure is None else self._common / view.exposure

    def photo(self, index: int) -> Decoded:
        """The photo of the view with this number, as import_photo takes it."""
        view = self._views[index]
        values = np.asarray(read_encoded(view.values)[..., :3], np.float32) * np.float32(self._scale(view) * self.gain)
        exif = view.exif if self._common is None else replace(view.exif, exposure=self._common)
        return Decoded(values, exif, view.profile, clipped=np.load(view.ends, allow_pickle=False))

    def count(self, index: int) -> int:
        """Number of exposures in a view's photo."""
        return self._views[index].count

    def release(self, index: int) -> None:
        """Delete the files of a view that was imported."""
        for path in (self._views[index].values, self._views[index].ends):
            path.unlink(missing_ok=True)


def merged_photos(
    source: Located[CaptureSource], candidates: Sequence[Candidate], held: Set[int], warnings: list[str],
    context: Context,
) -> MergedPhotos | None:  # fmt: skip
    """Merge the exposures of every view; None for a capture without brackets. Views that keep one exposure are named.

    Raises:
        StageError: a file is damaged, photos of a view differ in size, their exposures are unknown or contradict each
            other.
    """
    if not any(c.bracket for c in candidates):
        return None
    folder = context.scratch / "merged"
    folder.mkdir(parents=True, exist_ok=True)
    views = {}
    for done, candidate in enumerate(candidates):
        context.check()
        context.progress(done, len(candidates), f"merging the exposures of {candidate.name}")
        views[candidate.index] = _view(source, candidate, folder, warnings)
    single = [c.name for c in candidates if c.bracket is None]
    if single:
        warnings.append(f"{len(single)} of {len(candidates)} views have one exposure only, such as {single[0]}; they "
                        "are used as they are")  # fmt: skip
    return MergedPhotos(views, held)


def _view(source: Located[CaptureSource], candidate: Candidate, folder: Path, warnings: list[str]) -> MergedView:
    refs = [candidate.ref, *(candidate.bracket.others if candidate.bracket else ())]
    photos = [decoded(source.path(r), r) for r in refs]
    _one_size(candidate.name, refs, photos)
    exposures = _exposures(candidate, refs, photos)
    used, base = _usable(candidate.name, refs, photos, exposures, warnings)
    relative = [exposures[n] / exposures[base] for n, _ in used]
    made = hdr.merge([photos[n].image for n, _ in used], relative, [s for _, s in used])
    values, ends = folder / f"{candidate.index}.exr", folder / f"{candidate.index}.npy"
    write_exr(values, made.radiance)
    np.save(ends, made.clipped)
    return MergedView(values, ends, photos[base].exif, photos[base].profile, photos[base].exif.exposure, len(used),
                      _top(made.radiance))  # fmt: skip


def _one_size(view: str, refs: Sequence[FileRef], photos: Sequence[Decoded]) -> None:
    shapes = [(p.image.shape[1], p.image.shape[0], p.exif.orientation) for p in photos]
    for ref, shape in zip(refs, shapes, strict=True):
        if shape != shapes[0]:
            raise StageError(
                "the exposures of a view are not of one size",
                where=f"{view}, {PurePath(ref.path).name}",
                value=f"{shape[0]} x {shape[1]}" + (", turned" if shape[:2] == shapes[0][:2] else ""),
                limit=f"{shapes[0][0]} x {shapes[0][1]} as {PurePath(refs[0].path).name}",
                remedy="give original files of one camera; or capture.brackets=off to use one exposure of each view",
            )


def _exposures(candidate: Candidate, refs: Sequence[FileRef], photos: Sequence[Decoded]) -> list[float]:
    """Exposure of each photo, relative to the first; of EXIF if all have it, else as stated."""
    stated = list(candidate.bracket.exposures) if candidate.bracket else [1.0]
    known = [p.exif.exposure for p in photos]
    written = [e for e in known if e is not None]
    if len(written) < len(known):
        if not stated:
            missing = PurePath(refs[known.index(None)].path).name
            raise StageError(
                "the exposure of a photo in a bracket is unknown",
                where=f"{candidate.name}, {missing}",
                value="no exposure time, aperture and ISO in its EXIF",
                limit="EXIF in every photo, or seconds in brackets.json, or names such as a_ev-2.jpg",
                remedy="write brackets.json; or capture.brackets=off to use one exposure of each view",
            )
        return [s / stated[0] for s in stated]
    found = [e / written[0] for e in written]
    if stated:
        off = [float(np.log2(s / stated[0] / e)) for s, e in zip(stated, found, strict=True)]
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) > STATED:
            raise StageError(
                "the exposures of a bracket contradict the photos' EXIF",
                where=f"{candidate.name}, {PurePath(refs[worst].path).name}",
                value=f"{abs(off[worst]):.2f} stops {'more' if off[worst] > 0 else 'less'} than EXIF, against "
                f"{PurePath(refs[0].path).name}",
                limit=f"{STATED:.2f} stops",
                remedy="correct the names or brackets.json; without them EXIF counts",
            )
    return found


def _usable(
    view: str, refs: Sequence[FileRef], photos: Sequence[Decoded], exposures: Sequence[float], warnings: list[str]
) -> tuple[list[tuple[int, tuple[float, float]]], int]:
    """Which photos are merged, with their shifts, and the one whose unit and place count: the view's own, or the middle
    exposure of a view that is not merged."""
    alone = [(0, (0.0, 0.0))]
    if len(photos) == 1:
        return alone, 0
    if max(exposures) <= EQUAL * min(exposures):
        warnings.append(f"{view}: the {len(photos)} photos of its bracket have one exposure; only "
                        f"{PurePath(refs[0].path).name} is used")  # fmt: skip
        return alone, 0
    used, why = list(alone), ""
    for n in range(1, len(photos)):
        found = hdr.compare(photos[0].image, photos[n].image, exposures[n] / exposures[0])
        name = PurePath(refs[n].path).name
        if not found.known:
            continue  # nothing that both show, such as a black frame: it adds nothing that can be trusted
        if abs(found.stops) > hdr.TALE:
            more = "brighter" if found.stops > 0 else "darker"
            why = f"{name} is {abs(found.stops):.1f} stops {more} than its exposure"
        elif not found.same:
            why = f"something moved before {name}"
        else:
            used.append((n, found.shift))
        if why:
            middle = int(np.argsort(exposures)[len(exposures) // 2])
            warnings.append(f"{view}: its exposures are not merged, because {why}; only "
                            f"{PurePath(refs[middle].path).name} is used")  # fmt: skip
            return [(middle, (0.0, 0.0))], middle
    return used, 0


def _top(radiance: F32) -> float:
    h, w = (round((1 - MIDDLE) / 2 * n) for n in radiance.shape[:2])
    inside = radiance[h : radiance.shape[0] - h, w : radiance.shape[1] - w]
    return float(np.quantile(inside.max(2), BRIGHTEST))

"""Which photos of the user's folder may be used, with the files of each, and the warnings about the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import Bracket, CaptureSource, GivenCamera
from pipeline.errors import StageError
from stages.capture.quality import blurred
from stages.capture.readers import describe
from stages.capture.readers.described import indices_of

if TYPE_CHECKING:
    from stages.capture.import_photo import ImportedPhoto

MOST_COPIES = 0.5  # share of photos with given cameras that may be copies of another: more is no slip of one name


@dataclass(frozen=True, slots=True)
class Candidate:
    """A photo that may be used. size: (width, height) in pixels. serial: the camera body. plate: the clean plate.
    bracket: the view's other exposures. parallel: the other photo of a polarised pair."""

    index: int
    name: str
    ref: FileRef
    camera: GivenCamera | None = None
    size: tuple[int, int] | None = None
    serial: str = ""
    mask: FileRef | None = None
    plate: FileRef | None = None
    bracket: Bracket | None = None
    parallel: FileRef | None = None


@dataclass(frozen=True, slots=True)
class Selection:
    """candidates: photos that may be used. left_out: a note on each of the others; absent: their names."""

    candidates: list[Candidate]
    left_out: list[str]
    absent: list[str]
    warnings: list[str]

    def leave_out(self, candidate: Candidate, why: str) -> None:
        """Exclude a candidate after all, with a note and a warning."""
        self.left_out.append(f"{candidate.name}: {why}")
        self.absent.append(candidate.name)
        self.warnings.append(f"{candidate.name} is left out: {why}")


def candidates_of(source: Located[CaptureSource]) -> Selection:
    """All photos that the folder, or its cameras' file, lists, in the order of their numbers."""
    found = _listed(source)
    brackets = {b.photo: b for b in source.artifact.brackets}
    parallel = {p.cross: p.parallel for p in source.artifact.pairs}
    return replace(found, candidates=[
        replace(c, bracket=brackets.get(c.ref.path), parallel=parallel.get(c.ref.path)) for c in found.candidates
    ])  # fmt: skip


def _listed(source: Located[CaptureSource]) -> Selection:
    photos = source.artifact.photos
    by_stem, plates = ({PurePath(f.path).stem: f for f in files}
                       for files in (source.artifact.masks, source.artifact.plates))  # fmt: skip
    if not source.artifact.cameras:
        views = {b.photo: b.name for b in source.artifact.brackets if PurePath(b.photo).parent.name == b.name}
        names = [views.get(p.path, PurePath(p.path).stem) + PurePath(p.path).suffix for p in photos]
        candidates = [Candidate(i, n, p, mask=_of(by_stem, n), plate=_of(plates, n))
                 for i, n, p in zip(indices_of(names), names, photos, strict=True)]  # fmt: skip
        return Selection(sorted(candidates, key=lambda c: c.index), [], [], [])
    described = describe(source.artifact.kind, source.folder, [source.path(c) for c in source.artifact.cameras])
    refs, masks = ({f.path: f for f in files} for files in (photos, source.artifact.masks))
    out = []
    for v in described.views:
        path = "" if v.photo is None else v.photo.relative_to(source.folder).as_posix()
        if path not in refs:  # it is missing, or another exposure or the other half of a pair
            continue
        ref = refs[path]
        own = masks.get(v.mask.relative_to(source.folder).as_posix()) if v.mask is not None else None
        out.append(Candidate(v.index, v.name, ref, v.camera, v.size, v.serial, own or _of(by_stem, v.name),
                              _of(plates, v.name)))  # fmt: skip
    return Selection(
        sorted(out, key=lambda c: c.index), list(described.left_out), list(described.absent), list(described.warnings)
    )


def _of(by_stem: dict[str, FileRef], name: str) -> FileRef | None:
    """The mask or clean plate of a photo: `a.png` or `a.jpg.png` for a.jpg."""
    return by_stem.get(PurePath(name).stem) or by_stem.get(name)


def without_duplicates(selection: Selection, given: bool) -> list[Candidate]:
    """The candidates without duplicate files. Duplicates with given cameras are kept, with a warning: one of the
    cameras is wrong, and it is unknown which.

    Raises:
        StageError: most photos with given cameras are copies. Copies agree with each other, so that the comparison of
            cameras with photos would find nothing wrong.
    """
    first: dict[str, str] = {}
    if given:
        _not_mostly_copies(selection.candidates)
    kept = []
    for c in selection.candidates:
        other = first.setdefault(c.ref.sha256, c.name)
        if other == c.name:
            kept.append(c)
        elif given:
            kept.append(c)
            selection.warnings.append(
                f"{c.name} is the same file as {other}, but has another camera; remove one of them"
            )
        else:
            selection.leave_out(c, f"it is the same file as {other}; replace it by the correct photo, or remove it")
    return kept


def _not_mostly_copies(candidates: list[Candidate]) -> None:
    copies = len(candidates) - len({c.ref.sha256 for c in candidates})
    if copies > MOST_COPIES * len(candidates):
        raise StageError(
            "most photos are copies of others, but have cameras of their own",
            where=_most_copied(candidates),
            value=f"{copies} of {len(candidates)} photos are copies",
            limit=f"at most {MOST_COPIES:.0%}",
            remedy="copy the right photos into the folder, each with the name that its camera gives",
        )


def _most_copied(candidates: list[Candidate]) -> str:
    """Name of the photo that stands there most often."""
    most = Counter(c.ref.sha256 for c in candidates).most_common(1)[0][0]
    return next(c.name for c in candidates if c.ref.sha256 == most)


def useful(
    candidates: list[Candidate], photos: list[ImportedPhoto], selection: Selection, drop_blurred: bool,
    held: Set[int] = frozenset(),
) -> tuple[list[Candidate], list[ImportedPhoto]]:  # fmt: skip
    """Candidates and photos without the blank and the blurred ones, whose copies are deleted. held: indices of the
    photos that are held out; the limit for blurred photos is that of the others."""
    seen = [(p.detail, c.index not in held) for c, p in zip(candidates, photos, strict=True) if p.detail is not None]
    soft = iter(blurred(*zip(*seen, strict=True)) if drop_blurred and seen else [False] * len(seen))
    kept = []
    for candidate, photo in zip(candidates, photos, strict=True):
        if photo.detail is None:
            selection.leave_out(candidate, "it is blank (all pixels are equal); take the photo again")
        elif next(soft):
            selection.leave_out(candidate, "it is far more blurred than the others; take the photo again, or set "
                            "capture.drop_blurred=false")  # fmt: skip
        else:
            kept.append((candidate, photo))
            continue
        _remove(photo)
    return [c for c, _ in kept], [p for _, p in kept]


def _remove(photo: ImportedPhoto) -> None:
    """Delete the copied files of a photo that is not used after all."""
    photo.image.unlink()
    if photo.clipped is not None:
        photo.clipped.unlink()

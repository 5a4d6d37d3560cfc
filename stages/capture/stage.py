"""capture: the user's folder in, checked photos with their cameras and masks out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath

from pydantic import Field, field_validator

from pipeline.artifacts import Capture, CaptureSource, CaptureView, FileRef, Located
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import StageError
from stages.capture.facescape import DeclaredView, declared_view, is_valid, read_params, view_indices
from stages.capture.holdout import check_rule, held_out


@dataclass(frozen=True, slots=True)
class Inputs:
    """What `stages.capture.scan.scan_capture` found."""

    source: Located[CaptureSource]


class Config(StageConfig):
    """Settings of the capture stage."""

    holdout: str = Field("none", description="views kept from the fit: none | every:N:K | names:a.jpg,b.jpg")
    min_views: int = Field(3, ge=3, description="fewest views that must remain for the fit")

    @field_validator("holdout")
    @classmethod
    def _grammar(cls, rule: str) -> str:
        return check_rule(rule)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A photo that takes part."""

    index: int
    name: str
    ref: FileRef
    declared: DeclaredView | None = None


def run(inputs: Inputs, config: Config, context: Context) -> Capture:
    """Check every photo, mask and given camera, and copy what takes part into the artifact.

    Raises:
        StageError: a file that is not whole or of the wrong size, a bad camera, a useless mask, too few views.
    """
    source = inputs.source.artifact
    candidates, left_out, absent, warnings = _candidates(inputs.source)
    held = held_out(config.holdout, [(c.index, c.name) for c in candidates], absent)
    if config.holdout != "none" and not held:
        warnings.append(f"the hold-out rule {config.holdout} matches no view that takes part")
    _enough(len(candidates) - len(held), len(held), left_out, config.min_views)
    masks = {PurePath(m.path).stem: m for m in source.masks}
    views = []
    for done, candidate in enumerate(candidates):
        context.check()
        context.progress(done, len(candidates), f"checking {candidate.name}")
        mask = masks.get(PurePath(candidate.name).stem) or masks.get(candidate.name)
        views.append(_view(inputs.source, candidate, mask, candidate.index in held, context))
    warnings += _duplicates(candidates) + _partly_masked(views)
    return Capture(kind=source.kind, views=tuple(views), left_out=tuple(left_out), warnings=tuple(warnings))


def _candidates(source: Located[CaptureSource]) -> tuple[list[_Candidate], list[str], list[str], list[str]]:
    """Views that take part, notes on those left out, the latter's photo names, warnings."""
    photos = source.artifact.photos
    if source.artifact.params is None:
        indices = _indices([PurePath(p.path).stem for p in photos])
        found = [_Candidate(i, PurePath(p.path).name, p) for i, p in zip(indices, photos, strict=True)]
        return sorted(found, key=lambda c: c.index), [], [], []
    params = read_params(source.path(source.artifact.params))
    by_index = {int(PurePath(p.path).stem): p for p in photos}
    taken, left_out, absent, warnings = [], [], [], []
    for index in view_indices(params):
        ref = by_index.get(index)
        name = PurePath(ref.path).name if ref else f"{index}"
        if not is_valid(params, index):
            left_out.append(f"{name}: params.json marks it invalid")
            absent.append(name)
        elif ref is None:
            left_out.append(f"{name}: its photo is missing")
            warnings.append(f"params.json names view {index}, but its photo is missing")
        else:
            taken.append(_Candidate(index, name, ref, declared_view(params, index)))
    return taken, left_out, absent, warnings


def _indices(stems: list[str]) -> list[int]:
    """The stems as numbers if all are, and all different; else the photos' order."""
    if all(s.isdecimal() and len(s) < 10 for s in stems) and len({int(s) for s in stems}) == len(stems):
        return [int(s) for s in stems]
    return list(range(len(stems)))


def _view(
    source: Located[CaptureSource], candidate: _Candidate, mask: FileRef | None, held: bool, context: Context
) -> CaptureView:
    from stages.capture.gather import gather_mask, gather_photo

    declared = candidate.declared
    size = (declared.width, declared.height) if declared else None
    name = f"{candidate.index}_{candidate.name}".replace("\\", "_")
    photo = gather_photo(source.path(candidate.ref), candidate.ref, context.workdir / "photos" / name, size)
    mask_path = None
    if mask is not None:
        suffix = ".png" if photo.turned else Path(mask.path).suffix.lower()
        mask_path = context.workdir / "masks" / f"{candidate.index}_{Path(name).stem.split('_', 1)[1]}{suffix}"
        gather_mask(source.path(mask), mask, mask_path, photo)
    focal = photo.exif.focal_px(photo.width, photo.height)
    return CaptureView(
        index=candidate.index, name=candidate.name, image=context.file(photo.image), width=photo.width,
        height=photo.height, camera=declared.camera if declared else None,
        mask=context.file(mask_path) if mask_path else None, focal_px=round(focal, 6) if focal else None,
        camera_group=_group(photo.width, photo.height, declared.serial if declared else "", photo.exif.body,
                            photo.exif.focal_mm or photo.exif.focal_35mm),
        holdout=held,
    )  # fmt: skip


def _group(width: int, height: int, serial: str, body: str, focal: float | None) -> str:
    """Views that went through the same body and lens at the same size and focal length have the same group."""
    lens = f"{focal:.2f} mm" if focal else ""
    return " | ".join(p for p in (f"{width}x{height}", serial, body, lens) if p)


def _enough(fitted: int, held: int, left_out: list[str], limit: int) -> None:
    if fitted < limit:
        raise StageError("too few views remain for the fit", where="capture",
                         value=f"{fitted} to fit, {held} held out, {len(left_out)} left out",
                         limit=f"at least {limit} views", remedy="hold out fewer views, or add photos")  # fmt: skip


def _duplicates(candidates: list[_Candidate]) -> list[str]:
    """A note for each photo whose bytes another one has too."""
    first: dict[str, str] = {}
    notes = []
    for c in candidates:
        if c.ref.sha256 in first:
            notes.append(f"{c.name} is the same file as {first[c.ref.sha256]}")
        first.setdefault(c.ref.sha256, c.name)
    return notes


def _partly_masked(views: list[CaptureView]) -> list[str]:
    masked = sum(v.mask is not None for v in views)
    return [f"only {masked} of {len(views)} views have a mask"] if 0 < masked < len(views) else []


STAGE = Stage(name="capture", version=1, inputs=Inputs, config=Config, output=Capture, run=run)

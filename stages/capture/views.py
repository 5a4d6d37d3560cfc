"""Builds the capture's views from checked photos: masks, clean plates, positions, exposures, colour correction; also
the warnings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import CaptureSource, CaptureView, ColourChart
from pipeline.contract import Context
from stages.capture.brackets import MergedPhotos
from stages.capture.candidates import Candidate
from stages.capture.colour_correction import correct_colours, read_charts
from stages.capture.develop import is_raw
from stages.capture.exif import metres_from
from stages.capture.icc_profile import foreign, is_srgb
from stages.capture.import_photo import ImportedPhoto, import_mask, import_photo
from stages.capture.photometry import exposures
from stages.capture.readers.values import some_of

NAMED = 20  # file names in one warning


def photo_of(
    source: Located[CaptureSource], candidate: Candidate, done: tuple[int, int], chart: bool, context: Context,
    merged: MergedPhotos | None = None,
) -> ImportedPhoto:  # fmt: skip
    """Check and copy the photo of a candidate. done: number of finished photos, of all. chart: search for a colour
    checker. merged: photos of several exposures, which are taken in place of the files."""
    context.check()
    context.progress(*done, f"checking {candidate.name}")
    target = context.workdir / "photos" / _stored_name(candidate)
    own = None if merged is None else merged.photo(candidate.index)
    found = import_photo(source.path(candidate.ref), candidate.ref, target, candidate.size, chart=chart, merged=own)
    if merged is not None:
        merged.release(candidate.index)
    return found


def _stored_name(candidate: Candidate) -> str:
    return f"{candidate.index}_{candidate.name}".replace("\\", "_")


def view_of(
    source: Located[CaptureSource], candidate: Candidate, photo: ImportedPhoto, held: bool, warnings: list[str],
    context: Context,
) -> CaptureView:  # fmt: skip
    """The manifest's entry of a candidate. Its mask and clean plate are checked and copied."""
    mask_path, mask = None, candidate.mask
    if mask is not None:
        suffix = ".png" if photo.turned else Path(mask.path).suffix.lower()
        mask_path = context.workdir / "masks" / f"{candidate.index}_{PurePath(candidate.name).stem}{suffix}"
        fault = import_mask(source.path(mask), mask, mask_path, photo)
        if fault is not None:
            warnings.append(f"{fault}; now the photo is segmented instead")
            mask_path = None
    plate = _plate(source, candidate, photo, warnings, context)
    focal = photo.exif.focal_px(photo.width, photo.height)
    return CaptureView(
        index=candidate.index, name=candidate.name, image=context.file(photo.image), width=photo.width,
        height=photo.height, camera=candidate.camera, mask=context.file(mask_path) if mask_path else None, plate=plate,
        focal_px=round(focal, 6) if focal else None,
        camera_group=_group(photo.width, photo.height, candidate.serial, photo.exif.body,
                            photo.exif.focal_mm or photo.exif.focal_35mm),
        clipped=context.file(photo.clipped) if photo.clipped else None,
        flash=photo.exif.flash,
        holdout=held,
    )  # fmt: skip


def contradicting_flash(views: Sequence[CaptureView]) -> list[str]:
    """A warning if EXIF says of some photos that the flash fired, and of others that it did not."""
    fired = {on: [v.name for v in views if v.flash is on] for on in (True, False)}
    if not fired[True] or not fired[False]:
        return []
    on = len(fired[True]) <= len(fired[False])
    few = fired[on]
    some = some_of(few, NAMED)
    return [f"the flash fired in {len(fired[True])} photos and not in {len(fired[False])}, by their EXIF: "
            f"{some} {'with' if on else 'without'} flash; one light is fitted to all photos, so take these out, or "
            "photograph all with or all without flash"]  # fmt: skip


def with_places(views: list[CaptureView], photos: list[ImportedPhoto]) -> list[CaptureView]:
    """The views with their GPS positions in metres relative to the first one: for privacy, not the place on earth."""
    origin = next((p.exif.place for p in photos if p.exif.place is not None), None)
    if origin is None:
        return views
    return [v if p.exif.place is None else v.model_copy(update={"place_m": metres_from(p.exif.place, origin)})
            for v, p in zip(views, photos, strict=True)]  # fmt: skip


def with_exposures(views: list[CaptureView], photos: list[ImportedPhoto], warnings: list[str]) -> list[CaptureView]:
    """The views with their exposures, if all have them in EXIF and the pixels of the fitted photos confirm them."""
    fitted = [not v.holdout for v in views]
    found = exposures([p.exif.exposure for p in photos], [p.light for p in photos], fitted)
    if found is None:
        return views
    warnings.append(f"exposures differ by a factor of {max(found) / min(found):.3g}; this is corrected by the photos' "
                    "EXIF; set the exposure by hand for more accurate colours")  # fmt: skip
    return [v.model_copy(update={"exposure": round(e, 6)}) for v, e in zip(views, found, strict=True)]


def with_chart(
    views: list[CaptureView], photos: list[ImportedPhoto], warnings: list[str], wanted: bool, context: Context
) -> tuple[list[CaptureView], ColourChart | None]:
    """The views after colour correction, and the colour checker's result; unchanged views and None without one. A
    checker in a held-out photo is not used: that photo is there to be predicted."""
    unused = [v.name for v, p in zip(views, photos, strict=True) if v.holdout and p.chart is not None]
    if unused:
        warnings.append(f"the colour checker in {', '.join(unused[:NAMED])} is not used, because these photos are held "
                        "out")  # fmt: skip
    reading = read_charts(views, [None if v.holdout else p.chart for v, p in zip(views, photos, strict=True)], wanted)
    warnings += reading.warnings
    if reading.chart is None:
        return views, None

    def tick(done: int, name: str) -> None:
        context.check()
        context.progress(done, len(views), f"correcting the colours of {name}")

    return correct_colours(reading.chart, views, context.workdir, tick), reading.chart


def colours_drift(views: Sequence[CaptureView], photos: Sequence[ImportedPhoto]) -> bool:
    """Whether the camera changed exposure or white balance between the photos of the fit."""
    fitted = [(v, p) for v, p in zip(views, photos, strict=True) if not v.holdout]
    return any(p.exif.white_balance == "auto" or v.exposure != 1 for v, p in fitted)


def _plate(
    source: Located[CaptureSource], candidate: Candidate, photo: ImportedPhoto, warnings: list[str], context: Context
) -> FileRef | None:
    """The view's clean plate, checked and rotated as its photo; None if there is none or its size differs."""
    if candidate.plate is None:
        return None
    path = source.path(candidate.plate)
    target = context.workdir / "plates" / f"{candidate.index}_{path.name}"
    plate = import_photo(path, candidate.plate, target, candidate.size)
    if plate.clipped is not None:
        plate.clipped.unlink()  # only the photo's own clipped pixels are needed
    if (plate.width, plate.height) == (photo.width, photo.height):
        return context.file(plate.image)
    plate.image.unlink()
    sizes = f"{plate.width} x {plate.height} pixels, the photo {photo.width} x {photo.height}"
    warnings.append(f"the clean plate of {candidate.name} has {sizes}; take it with the same camera at the same size")
    return None


def _group(width: int, height: int, serial: str, body: str, focal: float | None) -> str:
    """The camera group: equal for views of one camera body, lens, size and focal length."""
    lens = f"{focal:.2f} mm" if focal else ""
    return " | ".join(p for p in (f"{width}x{height}", serial, body, lens) if p)


def foreign_colours(candidates: list[Candidate], photos: list[ImportedPhoto]) -> list[str]:
    """A warning for each ICC profile that is not sRGB, or what a photo says in its place."""
    named: dict[str, list[str]] = {}
    for candidate, photo in zip(candidates, photos, strict=True):
        if photo.profile is not None and not is_srgb(photo.profile):
            named.setdefault(photo.profile, []).append(candidate.name)
    told = []
    for profile, names in sorted(named.items()):
        what, taken, wanted = foreign(profile)
        told.append(f"{len(names)} photos {what}, such as {names[0]}; their colours are read as {taken}; export them "
                    f"as {wanted} for correct colours")  # fmt: skip
    return told


def not_read(names: Sequence[str]) -> list[str]:
    """A warning about pictures in the folder whose format is not supported."""
    if not names:
        return []
    some = some_of(names, NAMED)
    return [f"{len(names)} pictures are not used, because their format is not supported: {some}; convert them to JPEG, "
            "PNG, TIFF or EXR, or move them out of the folder"]  # fmt: skip


def twins(names: Sequence[str]) -> list[str]:
    """A warning about files that are one of the photos in another format."""
    if not names:
        return []
    some = some_of(names, NAMED)
    return [f"{len(names)} files are not used, because a photo of the same name is taken in their place: {some}; to "
            "use them, move the others out of the folder"]  # fmt: skip


def mixed_kinds(candidates: Sequence[Candidate]) -> list[str]:
    """A warning if some photos are developed from raw files and others are not."""
    raw = [c.name for c in candidates if is_raw(Path(c.name))]
    if not 0 < len(raw) < len(candidates):
        return []
    return [f"{len(raw)} of {len(candidates)} photos are raw, such as {raw[0]}; the camera's own pictures have another "
            "tone curve; give all photos as raw or none"]  # fmt: skip


def partly_masked(views: list[CaptureView]) -> list[str]:
    """A warning if some views have a given mask and others do not."""
    masked = sum(v.mask is not None for v in views)
    return [f"only {masked} of {len(views)} views have a given mask"] if 0 < masked < len(views) else []

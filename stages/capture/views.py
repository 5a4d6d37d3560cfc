"""From checked photos to the capture's views: masks, plates, places, exposures, a colour chart, and what is told."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

from pipeline.artifacts import CaptureSource, CaptureView, ColourChart, FileRef, Located
from pipeline.contract import Context
from stages.capture.candidates import Candidate
from stages.capture.colour_correction import bring_to, read_charts
from stages.capture.exif import metres_from
from stages.capture.icc_profile import is_srgb
from stages.capture.import_photo import ImportedPhoto, import_mask, import_photo
from stages.capture.photometry import exposures

NAMED = 20  # files in one note


def photo_of(
    source: Located[CaptureSource], candidate: Candidate, done: tuple[int, int], chart: bool, context: Context
) -> ImportedPhoto:
    """The checked photo of a candidate, copied. done: how many are, of how many. chart: look for a colour chart."""
    context.check()
    context.progress(*done, f"checking {candidate.name}")
    target = context.workdir / "photos" / _stored_name(candidate)
    return import_photo(source.path(candidate.ref), candidate.ref, target, candidate.size, chart=chart)


def _stored_name(candidate: Candidate) -> str:
    return f"{candidate.index}_{candidate.name}".replace("\\", "_")


def view_of(
    source: Located[CaptureSource], candidate: Candidate, photo: ImportedPhoto, held: bool, warnings: list[str],
    context: Context,
) -> CaptureView:  # fmt: skip
    """A candidate with its checked photo as the manifest has it; its mask and plate are checked and copied."""
    mask_path, mask = None, candidate.mask
    if mask is not None:
        suffix = ".png" if photo.turned else Path(mask.path).suffix.lower()
        mask_path = context.workdir / "masks" / f"{candidate.index}_{PurePath(candidate.name).stem}{suffix}"
        fault = import_mask(source.path(mask), mask, mask_path, photo)
        if fault is not None:
            warnings.append(f"{fault}; until then it is made from the photo")
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
        holdout=held,
    )  # fmt: skip


def with_places(views: list[CaptureView], photos: list[ImportedPhoto]) -> list[CaptureView]:
    """The views with their GPS positions, relative to the first: where on earth it was is nobody's business."""
    origin = next((p.exif.place for p in photos if p.exif.place is not None), None)
    if origin is None:
        return views
    return [v if p.exif.place is None else v.model_copy(update={"place_m": metres_from(p.exif.place, origin)})
            for v, p in zip(views, photos, strict=True)]  # fmt: skip


def with_exposures(views: list[CaptureView], photos: list[ImportedPhoto], warnings: list[str]) -> list[CaptureView]:
    """The views with their exposures, where EXIF tells them and the photos bear it out."""
    found = exposures([p.exif.exposure for p in photos], [p.light for p in photos])
    if found is None:
        return views
    warnings.append(f"exposures differ by a factor of {max(found) / min(found):.3g}; the photos are brought to one by "
                    "their EXIF; set the exposure by hand for truer colours")  # fmt: skip
    return [v.model_copy(update={"exposure": round(e, 6)}) for v, e in zip(views, found, strict=True)]


def with_chart(
    views: list[CaptureView], photos: list[ImportedPhoto], warnings: list[str], wanted: bool, context: Context
) -> tuple[list[CaptureView], ColourChart | None]:
    """The views in the colours of the chart that some of them show, and what it said; as they are without one."""
    reading = read_charts(views, [p.chart for p in photos], wanted)
    warnings += reading.warnings
    if reading.chart is None:
        return views, None

    def tick(done: int, name: str) -> None:
        context.check()
        context.progress(done, len(views), f"bringing {name} to the chart's white")

    return bring_to(reading.chart, views, context.workdir, tick), reading.chart


def _plate(
    source: Located[CaptureSource], candidate: Candidate, photo: ImportedPhoto, warnings: list[str], context: Context
) -> FileRef | None:
    """The view without its subject, checked and turned as its photo is; None if there is none or it does not fit."""
    if candidate.plate is None:
        return None
    path = source.path(candidate.plate)
    target = context.workdir / "plates" / f"{candidate.index}_{path.name}"
    plate = import_photo(path, candidate.plate, target, candidate.size)
    if plate.clipped is not None:
        plate.clipped.unlink()  # of the subject's photo alone
    if (plate.width, plate.height) == (photo.width, photo.height):
        return context.file(plate.image)
    plate.image.unlink()
    sizes = f"{plate.width} x {plate.height} and its photo {photo.width} x {photo.height}"
    warnings.append(f"the clean plate of {candidate.name} is {sizes}; take it with the same camera at the same size")
    return None


def _group(width: int, height: int, serial: str, body: str, focal: float | None) -> str:
    """Views that went through the same body and lens at the same size and focal length have the same group."""
    lens = f"{focal:.2f} mm" if focal else ""
    return " | ".join(p for p in (f"{width}x{height}", serial, body, lens) if p)


def foreign_colours(candidates: list[Candidate], photos: list[ImportedPhoto]) -> list[str]:
    """A note for each colour profile that is not sRGB."""
    named: dict[str, list[str]] = {}
    for candidate, photo in zip(candidates, photos, strict=True):
        if photo.profile is not None and not is_srgb(photo.profile):
            named.setdefault(photo.profile, []).append(candidate.name)
    return [f"{len(names)} photos have the colour profile {profile!r}, such as {names[0]}; their colours are taken as "
            "sRGB: export them as sRGB for true ones" for profile, names in sorted(named.items())]  # fmt: skip


def not_read(names: Sequence[str]) -> list[str]:
    """A note on pictures in the folder whose format is not read."""
    if not names:
        return []
    some = ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")
    return [f"{len(names)} pictures are not used, because their format is not read: {some}; convert them to JPEG, PNG, "
            "TIFF or EXR, or move them out of the folder"]  # fmt: skip


def partly_masked(views: list[CaptureView]) -> list[str]:
    """A note where some views have a mask of the user's, and others don't."""
    masked = sum(v.mask is not None for v in views)
    return [f"only {masked} of {len(views)} views have a mask"] if 0 < masked < len(views) else []

"""capture: the user's folder in, checked photos with their cameras and masks out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Literal

from pydantic import Field, field_validator

from pipeline.artifacts import Capture, CaptureSource, CaptureView, ColourChart, FileRef, GivenCamera, Located
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import StageError
from stages.capture.holdout import check_rule, held_out
from stages.capture.readers import describe
from stages.capture.readers.described import indices_of

if TYPE_CHECKING:
    from stages.capture.gather import Gathered


@dataclass(frozen=True, slots=True)
class Inputs:
    """What `stages.capture.scan.scan_capture` found."""

    source: Located[CaptureSource]


class Config(StageConfig):
    """Settings of the capture stage."""

    holdout: str = Field("none", description="views kept from the fit: none | every:N:K | names:a.jpg,b.jpg")
    min_views: int = Field(3, ge=3, description="fewest views that must remain for the fit")
    frames: int = Field(60, ge=8, le=500, description="frames to take from a film, spread over the camera's way")
    drop_blurred: bool = Field(True, description="leave out photos with far less detail than the others")

    chart: Literal["auto", "on", "off"] = Field(
        "auto",
        description="a colour chart of 24 patches in some photos: off: not looked for; on: must be found; its white "
        "becomes the photos' white and unit",
    )

    @field_validator("holdout")
    @classmethod
    def _grammar(cls, rule: str) -> str:
        return check_rule(rule)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A photo that may take part."""

    index: int
    name: str
    ref: FileRef
    camera: GivenCamera | None = None
    size: tuple[int, int] | None = None
    serial: str = ""
    mask: FileRef | None = None
    plate: FileRef | None = None


@dataclass(frozen=True, slots=True)
class _Found:
    """Photos that may take part; notes on those that don't, with their names; warnings."""

    candidates: list[_Candidate]
    left_out: list[str]
    absent: list[str]
    warnings: list[str]

    def leave_out(self, candidate: _Candidate, why: str) -> None:
        """One that takes no part after all: a photo that is of no use is told as a warning too."""
        self.left_out.append(f"{candidate.name}: {why}")
        self.absent.append(candidate.name)
        self.warnings.append(f"{candidate.name} is left out: {why}")


def run(inputs: Inputs, config: Config, context: Context) -> Capture:
    """Check every photo, mask and given camera, and copy what takes part into the artifact.

    Photos that can't help (blank, blurred far beyond the others, the same file twice) and masks of no use are left
    out and named, as long as enough remains.

    Raises:
        StageError: a file that is not whole or of the wrong size, a bad camera, too few views.
    """
    source = _photos_of_film(inputs.source, config, context)
    found = _candidates(source)
    given = source.artifact.cameras != ()
    candidates = _without_doubles(found, given)
    photos = [_photo(source, c, (done, len(candidates)), config, context) for done, c in enumerate(candidates)]
    candidates, photos = _useful(candidates, photos, found, config)
    held = held_out(config.holdout, [(c.index, c.name) for c in candidates], found.absent)
    if config.holdout != "none" and not held:
        found.warnings.append(f"the hold-out rule {config.holdout} matches no view that takes part")
    _enough(len(candidates) - len(held), len(held), found.left_out, config.min_views)
    views = [_view(source, c, p, c.index in held, found.warnings, context)
             for c, p in zip(candidates, photos, strict=True)]  # fmt: skip
    views = _with_exposures(_with_places(views, photos), photos, found.warnings)
    views, chart = _with_chart(views, photos, found.warnings, config, context)
    drift = any(p.exif.white_balance == "auto" for p in photos) or any(v.exposure != 1 for v in views)
    warnings = found.warnings + _foreign_colours(candidates, photos) + _partly_masked(views)
    return Capture(kind=source.artifact.kind, views=tuple(views), colours_drift=drift, chart=chart,
                   metres_from_world=source.artifact.metres_from_world,
                   left_out=tuple(found.left_out), warnings=tuple(warnings))  # fmt: skip


def _photos_of_film(source: Located[CaptureSource], config: Config, context: Context) -> Located[CaptureSource]:
    """The source itself; of a film, its frames."""
    if source.artifact.kind != "video":
        return source
    from stages.capture.film import frames_of

    def tick(done: int, total: int) -> None:
        context.check()
        context.progress(done, total, "looking through the film")

    frames = frames_of(source.path(source.artifact.photos[0]), context.scratch / "frames", config.frames, tick)
    photos = tuple(FileRef.of(context.scratch / "frames", f) for f in frames)
    return Located(CaptureSource(kind="video", photos=photos), context.scratch / "frames")


def _candidates(source: Located[CaptureSource]) -> _Found:
    photos = source.artifact.photos
    by_stem, plates = ({PurePath(f.path).stem: f for f in files}
                       for files in (source.artifact.masks, source.artifact.plates))  # fmt: skip
    if not source.artifact.cameras:
        names = [PurePath(p.path).name for p in photos]
        found = [_Candidate(i, n, p, mask=_of(by_stem, n), plate=_of(plates, n))
                 for i, n, p in zip(indices_of(names), names, photos, strict=True)]  # fmt: skip
        return _Found(sorted(found, key=lambda c: c.index), [], [], [])
    said = describe(source.artifact.kind, source.folder, [source.path(c) for c in source.artifact.cameras])
    refs, masks = ({f.path: f for f in files} for files in (photos, source.artifact.masks))
    out = []
    for v in said.views:
        if v.photo is None:
            continue
        ref = refs[v.photo.relative_to(source.folder).as_posix()]
        own = masks.get(v.mask.relative_to(source.folder).as_posix()) if v.mask is not None else None
        out.append(_Candidate(v.index, v.name, ref, v.camera, v.size, v.serial, own or _of(by_stem, v.name),
                              _of(plates, v.name)))  # fmt: skip
    return _Found(sorted(out, key=lambda c: c.index), list(said.left_out), list(said.absent), list(said.warnings))


def _of(by_stem: dict[str, FileRef], name: str) -> FileRef | None:
    """The file beside a photo: `a.png` or `a.jpg.png` for a.jpg."""
    return by_stem.get(PurePath(name).stem) or by_stem.get(name)


def _without_doubles(found: _Found, given: bool) -> list[_Candidate]:
    """Photos whose bytes another one has too are left out; of ones with cameras it is only told, for one camera is
    wrong and the file does not say which."""
    first: dict[str, str] = {}
    kept = []
    for c in found.candidates:
        other = first.setdefault(c.ref.sha256, c.name)
        if other == c.name:
            kept.append(c)
        elif given:
            kept.append(c)
            found.warnings.append(f"{c.name} is the same file as {other}, with another camera; take one of them out")
        else:
            found.leave_out(c, f"it is the same file as {other}")
    return kept


def _photo(
    source: Located[CaptureSource], candidate: _Candidate, done: tuple[int, int], config: Config, context: Context
) -> Gathered:
    from stages.capture.gather import gather_photo

    context.check()
    context.progress(*done, f"checking {candidate.name}")
    target = context.workdir / "photos" / _stored_name(candidate)
    return gather_photo(source.path(candidate.ref), candidate.ref, target, candidate.size, chart=config.chart != "off")


def _stored_name(candidate: _Candidate) -> str:
    return f"{candidate.index}_{candidate.name}".replace("\\", "_")


def _useful(
    candidates: list[_Candidate], photos: list[Gathered], found: _Found, config: Config
) -> tuple[list[_Candidate], list[Gathered]]:
    """Without blank and blurred photos, whose copies are removed."""
    from stages.capture.suspects import blurred

    seen = [p.detail for p in photos if p.detail is not None]
    soft = iter(blurred(seen) if config.drop_blurred and seen else [False] * len(seen))
    kept = []
    for candidate, photo in zip(candidates, photos, strict=True):
        if photo.detail is None:
            found.leave_out(candidate, "it is blank (one level all over); take the photo again")
        elif next(soft):
            found.leave_out(candidate, "it is blurred far beyond the others; take the photo again, or set "
                            "capture.drop_blurred=false")  # fmt: skip
        else:
            kept.append((candidate, photo))
            continue
        _remove(photo)
    return [c for c, _ in kept], [p for _, p in kept]


def _remove(photo: Gathered) -> None:
    """A photo that takes no part after all leaves nothing behind."""
    photo.image.unlink()
    if photo.clipped is not None:
        photo.clipped.unlink()


def _view(
    source: Located[CaptureSource], candidate: _Candidate, photo: Gathered, held: bool, warnings: list[str],
    context: Context,
) -> CaptureView:  # fmt: skip
    from stages.capture.gather import gather_mask

    mask_path, mask = None, candidate.mask
    if mask is not None:
        suffix = ".png" if photo.turned else Path(mask.path).suffix.lower()
        mask_path = context.workdir / "masks" / f"{candidate.index}_{PurePath(candidate.name).stem}{suffix}"
        fault = gather_mask(source.path(mask), mask, mask_path, photo)
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


def _with_places(views: list[CaptureView], photos: list[Gathered]) -> list[CaptureView]:
    """The views with their GPS positions, relative to the first: where on earth it was is nobody's business."""
    from stages.capture.exif import metres_from

    origin = next((p.exif.place for p in photos if p.exif.place is not None), None)
    if origin is None:
        return views
    return [v if p.exif.place is None else v.model_copy(update={"place_m": metres_from(p.exif.place, origin)})
            for v, p in zip(views, photos, strict=True)]  # fmt: skip


def _with_exposures(views: list[CaptureView], photos: list[Gathered], warnings: list[str]) -> list[CaptureView]:
    """The views with their exposures, where EXIF tells them and the photos bear it out."""
    from stages.capture.photometry import exposures

    found = exposures([p.exif.exposure for p in photos], [p.light for p in photos])
    if found is None:
        return views
    warnings.append(f"exposures differ by a factor of {max(found) / min(found):.3g}; the photos are brought to one by "
                    "their EXIF; set the exposure by hand for truer colours")  # fmt: skip
    return [v.model_copy(update={"exposure": round(e, 6)}) for v, e in zip(views, found, strict=True)]


def _with_chart(
    views: list[CaptureView], photos: list[Gathered], warnings: list[str], config: Config, context: Context
) -> tuple[list[CaptureView], ColourChart | None]:
    """The views in the colours of the chart that some of them show, and what it said; as they are without one."""
    from stages.capture.charted import bring_to, read_charts

    said = read_charts(views, [p.chart for p in photos], config.chart == "on")
    warnings += said.told
    if said.chart is None:
        return views, None

    def tick(done: int, name: str) -> None:
        context.check()
        context.progress(done, len(views), f"bringing {name} to the chart's white")

    return bring_to(said.chart, views, context.workdir, tick), said.chart


def _plate(
    source: Located[CaptureSource], candidate: _Candidate, photo: Gathered, warnings: list[str], context: Context
) -> FileRef | None:
    """The view without its subject, checked and turned as its photo is; None if there is none or it does not fit."""
    from stages.capture.gather import gather_photo

    if candidate.plate is None:
        return None
    path = source.path(candidate.plate)
    target = context.workdir / "plates" / f"{candidate.index}_{path.name}"
    plate = gather_photo(path, candidate.plate, target, candidate.size)
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


def _enough(fitted: int, held: int, left_out: list[str], limit: int) -> None:
    if fitted < limit:
        raise StageError("too few views remain for the fit", where="capture",
                         value=f"{fitted} to fit, {held} held out, {len(left_out)} left out",
                         limit=f"at least {limit} views", remedy="hold out fewer views, or add photos")  # fmt: skip


def _foreign_colours(candidates: list[_Candidate], photos: list[Gathered]) -> list[str]:
    """A note for each colour profile that is not sRGB."""
    from stages.capture.profile import is_srgb

    named: dict[str, list[str]] = {}
    for candidate, photo in zip(candidates, photos, strict=True):
        if photo.profile is not None and not is_srgb(photo.profile):
            named.setdefault(photo.profile, []).append(candidate.name)
    return [f"{len(names)} photos have the colour profile {profile!r}, such as {names[0]}; their colours are taken as "
            "sRGB: export them as sRGB for true ones" for profile, names in sorted(named.items())]  # fmt: skip


def _partly_masked(views: list[CaptureView]) -> list[str]:
    masked = sum(v.mask is not None for v in views)
    return [f"only {masked} of {len(views)} views have a mask"] if 0 < masked < len(views) else []


STAGE = Stage(name="capture", version=4, inputs=Inputs, config=Config, output=Capture, run=run)

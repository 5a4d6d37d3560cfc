"""Imports the pictures of a light stage: copies those that can be used, and says why the others are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import CaptureSource, CaptureView, LightStage, StageFrame
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import F32, read_encoded, write_exr
from pipeline.verdict import Finding
from stages.capture.light_stage_checks import Sequences, Single, accounted, judge, suspicious, thumbnail
from stages.capture.readers.olat import FEWEST, LIGHTS, Lamps, pictures_of, read_lights

BRIGHTEST, LEVEL = 0.99, 0.9  # this quantile of the subject's values becomes this value in the views
SUBJECT = 0.05  # of a picture's brightest value: darker pixels are the background or deep shadow
CLIPPED = 0.02  # share of a picture's pixels at one same largest value: it is saturated
NAMED = 12  # names in a warning


@dataclass(frozen=True, slots=True)
class Imported:
    """The stage's manifest, its views with readable levels, findings and warnings."""

    stage: LightStage
    views: list[CaptureView]
    findings: tuple[Finding, ...]
    warnings: list[str]


def import_stage(source: Located[CaptureSource], views: Sequence[CaptureView], context: Context) -> Imported:
    """Check and copy every picture of a light stage.

    Pictures that can't be used (of lights without calibration, doubled, saturated, of lights that failed or were
    exchanged) are left out and named.
    Raises StageError if a picture is damaged, not linear, or not of its camera's size, or too few lights are left.
    """
    lamps = read_lights(source.path(next(f for f in source.artifact.cameras if f.path.endswith(LIGHTS))))
    found, notes = pictures_of(source.folder), list(lamps.notes)
    sizes = {v.index: (v.width, v.height) for v in views}
    notes += [f"{pair}: two files for one picture" for pair in found.doubled]
    notes += _not_calibrated(found.single, lamps)
    wanted = {k: p for k, p in found.single.items() if k[0] in sizes and k[1] in lamps.lights}
    singles, saturated = _singles(source, wanted, lamps, sizes, context)
    full = {v.index: thumbnail(_linear(context.workdir / v.image.path, lamps, sizes[v.index])) for v in views}
    sequences = Sequences(lamps.lights, singles, full)
    wrong = suspicious(sequences)
    notes += [f"light {n}: {why}" for n, why in sorted(wrong.items())]
    kept = [k for k in sorted(singles) if k[1] not in wrong and k not in saturated]
    used = sorted({n for _, n in kept})
    _enough(used, notes)
    frames = [StageFrame(camera=c, number=n, image=context.file(singles[c, n].copy)) for c, n in kept]
    for key in set(singles) - set(kept):
        singles[key].copy.unlink()
    tracking = _tracking(source, {k: p for k, p in found.tracking.items() if k[0] in sizes}, lamps, sizes, context)
    gain = _gain(context.workdir, views)
    share = accounted(Sequences(lamps.lights, {k: singles[k] for k in kept}, full))
    lights = tuple(lamps.lights[n] for n in used)
    stage = LightStage(lights=lights, frames=tuple(frames), tracking=tracking, gain=gain, share=share)
    missing = sorted(f"{c}/{n}" for c in sizes for n in lamps.lights if (c, n) not in found.single)
    findings = judge(sequences, missing, sorted(f"{c}/{n}" for c, n in saturated), wrong, len(lamps.lights))
    return Imported(stage, _levelled(context, views, gain), findings, _told(notes))


def _not_calibrated(found: dict[tuple[int, int], Path], lamps: Lamps) -> list[str]:
    unknown = sorted({n for _, n in found} - set(lamps.lights))
    return [f"light {n}: it has pictures but no calibration in {LIGHTS}" for n in unknown]


def _singles(
    source: Located[CaptureSource],
    wanted: dict[tuple[int, int], Path],
    lamps: Lamps,
    sizes: dict[int, tuple[int, int]],
    context: Context,
) -> tuple[dict[tuple[int, int], Single], set[tuple[int, int]]]:
    """Copies and thumbnails of the pictures under single lights, and which of them are saturated."""
    known = {f.path: f for f in source.artifact.stage}
    out: dict[tuple[int, int], Single] = {}
    saturated = set()
    for done, ((camera, number), path) in enumerate(sorted(wanted.items())):
        context.check()
        context.progress(done, len(wanted), f"checking light {number}")
        picture = _linear(path, lamps, sizes[camera])
        target = context.workdir / "olat" / str(camera) / f"{number:03d}.exr"
        write_exr(target, picture.clip(0, _HALF), half=True)
        ref = known.get(path.relative_to(source.folder).as_posix())
        out[camera, number] = Single(thumbnail(picture), ref.sha256 if ref else "", target)
        if _is_saturated(picture):
            saturated.add((camera, number))
    return out, saturated


_HALF = float(np.finfo(np.float16).max)


def _linear(path: Path, lamps: Lamps, size: tuple[int, int]) -> F32:
    """(H, W, 3) linear values of a picture. Integer files are linear only where lights.json says so."""
    image = read_encoded(path)
    if (image.shape[1], image.shape[0]) != size:
        raise StageError(
            "a picture of the light stage is not of its camera's size",
            where=f"{path.parent.name}/{path.name}",
            value=f"{image.shape[1]} x {image.shape[0]}",
            limit=f"{size[0]} x {size[1]}",
            remedy="use the pictures at the size that was calibrated",
        )
    values = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[..., :3]
    if np.issubdtype(values.dtype, np.integer):
        if not lamps.linear or values.dtype == np.uint8:
            raise StageError(
                "a picture of the light stage is not linear",
                where=f"{path.parent.name}/{path.name}",
                value=f"a file of {8 * values.dtype.itemsize} bits, which is taken as sRGB",
                limit='float EXR; or 16 bits with "encoding": "linear" in lights.json',
                remedy="export linear EXR from the raw files",
            )
        values = values / np.float32(np.iinfo(values.dtype.name).max)
    if not np.isfinite(values).all():
        raise StageError(
            "a picture of the light stage has values that are not finite",
            where=f"{path.parent.name}/{path.name}",
            value=f"{int((~np.isfinite(values)).sum())} values",
            limit="finite linear values",
            remedy="export the picture again",
        )
    return np.asarray(values, np.float32)


def _is_saturated(picture: F32) -> bool:
    """Many pixels of the brightest channel have one same largest value, which light alone never does."""
    brightest = picture.max(2)
    top = float(brightest.max())
    return top > 0 and float((brightest >= top * (1 - 1e-6)).mean()) > CLIPPED


def _tracking(
    source: Located[CaptureSource],
    wanted: dict[tuple[int, int], Path],
    lamps: Lamps,
    sizes: dict[int, tuple[int, int]],
    context: Context,
) -> tuple[StageFrame, ...]:
    out = []
    for (camera, frame), path in sorted(wanted.items()):
        context.check()
        target = context.workdir / "tracking" / str(camera) / f"{frame:03d}.exr"
        write_exr(target, _linear(path, lamps, sizes[camera]).clip(0, _HALF), half=True)
        out.append(StageFrame(camera=camera, number=frame, image=context.file(target)))
    return tuple(out)


def _gain(folder: Path, views: Sequence[CaptureView]) -> float:
    """One factor for all views, so that nearly all of the subject is in a photo's range."""
    tops = []
    for view in views:
        values = np.asarray(read_encoded(folder / view.image.path)[..., :3], np.float32).max(2)
        lit = values[values > SUBJECT * float(values.max())]
        tops.append(float(np.quantile(lit, BRIGHTEST)) if lit.size else 0.0)
    top = float(np.median(tops))
    return round(LEVEL / top, 6) if top > 0 else 1.0


def _levelled(context: Context, views: Sequence[CaptureView], gain: float) -> list[CaptureView]:
    """The views with files times gain; integer files are in a photo's range already, and become float ones."""
    out = []
    for view in views:
        path = context.workdir / view.image.path
        stored = read_encoded(path)[..., :3]
        scale = 1.0 if not np.issubdtype(stored.dtype, np.integer) else 1.0 / float(np.iinfo(stored.dtype.name).max)
        target = path.with_suffix(".exr")
        path.unlink()
        write_exr(target, np.asarray(stored * scale * gain, np.float32))
        out.append(view.model_copy(update={"image": FileRef.of(context.workdir, target), "clipped": None}))
    return out


def _enough(used: Sequence[int], notes: Sequence[str]) -> None:
    if len(used) < FEWEST:
        raise StageError(
            "too few lights of the stage can be used",
            where="olat/",
            value=f"{len(used)}" + (f" ({notes[0]})" if notes else ""),
            limit=f"at least {FEWEST}",
            remedy="copy all pictures olat/CAMERA/LIGHT.exr, and lights.json",
        )


def _told(notes: Sequence[str]) -> list[str]:
    more = [f"{len(notes) - NAMED} more notes on the light stage's pictures"] if len(notes) > NAMED else []
    return [f"left out: {n}" for n in notes[:NAMED]] + more

"""The checks of a capture's photos: number, size, sharpness, exposure, duplicates, subject.

The limits come from measured captures: rigs and renders (good), hand-held arcs of people and objects under lamps or a
flash (usable). A photo is compared with the photos of the same camera if there are at least FEW_ALIKE of them: cameras
differ in noise and gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.transforms import F64
from pipeline.verdict import Finding, Limits, judged
from stages.capture.photo_figures import PhotoFigures

FEW_ALIKE = 5  # fewest photos of one camera for a median of its own
SOFT = 0.6  # of the median detail: sharp photos of rigs and videos stay above .61, motion-blurred ones are at .51, .57
DARK = 40.0  # levels of 255: the lit part of the subject is at 98 and more in every capture measured
DOUBLE = 0.7  # levels, RMS of thumbnails: neighbours in a video differ by at least 1.27, a re-saved photo by .3
MANY_CLIPPED, STOPS = 0.03, 1.5  # a photo is listed beyond: share of its centre; stops from its camera's median

# the fit needs 3; renders of 16 views without the held-out ones (13) still give a complete head
PHOTOS = Limits(12, 8)
# a light stage has few cameras and many lights; seven and eight of them, with given poses, gave a complete head
STAGE_PHOTOS = Limits(6, 3)
# pixels of the shorter edge: demo captures of 128 still have a face; below 64 a photo is refused
EDGE = Limits(120, 64)
# shares of photos
LEFT_OUT = Limits(0.1, 0.4, lower=False)
BLURRED = Limits(0.02, 0.3, lower=False)
TOO_DARK = Limits(0.02, 0.3, lower=False)
DOUBLES = Limits(0.0, 0.25, lower=False)
CROWDED = Limits(0.02, 0.5, lower=False)
# median detail: .067 to .2 of rigs, renders and phones, .054 of a compressed video; .02 blurred by 3 pixels
SHARPNESS = Limits(0.06, 0.02)
# mean share of the photos' centre: .002 at most in good captures, .066 selfies by a window, .21 a skull under lamps
CLIPPED = Limits(0.03, 0.3, lower=False)
# stops that a tenth of the photos deviate from their camera's median: .3 to .9 in rigs, 1.2 in a room with a window
EXPOSURE = Limits(1.3, 2.5, lower=False)
# photos with a face whose landmarks are found: three give the face's direction; objects have none
FACES = Limits(3, 0)
# levels: 1.4 for a bald head in soft light, 2 to 7 for others; a white wall with noise of 2 levels has .5
STRUCTURE = Limits(0.6, 0.6)
# files of unsupported formats, as a share of all pictures in the folder
FORMATS = Limits(0.0, 1.0, lower=False)
# share of the given masks: segmentation replaces the others, and mostly works
GIVEN_MASKS = Limits(0.0, 1.0, lower=False)


@dataclass(frozen=True, slots=True)
class Photo:
    """A photo that is used. width, height: pixels. group: equal for photos of one camera. exposure: see
    pipeline.artifacts."""

    name: str
    group: str
    width: int
    height: int
    exposure: float
    holdout: bool
    look: PhotoFigures


def judge(
    photos: Sequence[Photo], left_out: Sequence[str], passed_over: Sequence[str], *, light_stage: bool = False
) -> tuple[Finding, ...]:
    """All findings of a capture. left_out: names of the photos left out. passed_over: of files in other formats.
    light_stage: the photos are those of a light stage under all lights; light_stage_checks.py judges its lights."""
    return (
        _count(photos, light_stage),
        _left_out(len(photos), left_out),
        _formats(len(photos) + len(left_out), passed_over),
        _size(photos),
        *_sharp(photos),
        _exposed(photos),
        _bright(photos),
        _clipped(photos),
        _doubles(photos),
        *_subject(photos),
    )


def given_masks(masked: int, useless: Sequence[str]) -> list[Finding]:
    """The check of the given masks: not empty, not full, of the photo's size. Empty if no mask is given. masked: number
    of usable masks; useless: names of the photos of the others."""
    total = masked + len(useless)
    if not total:
        return []
    return [judged("given_masks", len(useless) / total, GIVEN_MASKS,
                   f"{len(useless)} of {total} given masks are empty, full or not of their photo's size; these photos "
                   "are segmented instead" if useless else f"all {total} given masks can be used",
                   "draw these masks again at the photo's size, 0 on the background and 255 on the subject",
                   views=useless)]  # fmt: skip


def _count(photos: Sequence[Photo], light_stage: bool) -> Finding:
    fitted = sum(not p.holdout for p in photos)
    said = f"{fitted} photos are used in the fit" + (", each under all lights of the stage" if light_stage else "")
    remedy = (
        "use more cameras, or hold out fewer"
        if light_stage
        else "take 30 to 60 photos all around the subject, 15 degrees apart or less"
    )
    return judged("photos", fitted, STAGE_PHOTOS if light_stage else PHOTOS, said, remedy, unit="photos")


def _left_out(kept: int, names: Sequence[str]) -> Finding:
    share = len(names) / max(1, kept + len(names))
    return judged("photos_left_out", share, LEFT_OUT,
                  f"{len(names)} of {kept + len(names)} photos are blank, blurred or duplicates, and are left out",
                  "take these photos again", views=names)  # fmt: skip


def _formats(read: int, names: Sequence[str]) -> Finding:
    message = (
        f"{len(names)} files are ignored, because their format is not supported"
        if names
        else "all pictures can be read"
    )
    return judged("formats", len(names) / max(1, read + len(names)), FORMATS, message,
                  "convert them to JPEG, PNG, TIFF or EXR, or move them out of the folder", views=names)  # fmt: skip


def _size(photos: Sequence[Photo]) -> Finding:
    edges = np.array([min(p.width, p.height) for p in photos])
    small = [p.name for p, e in sorted(zip(photos, edges, strict=True), key=lambda x: x[1]) if e < EDGE.good]
    median = float(np.median(edges))
    return judged("photo_size", median, EDGE, f"the photos' shorter edge has a median of {median:.0f} pixels",
                  "use the original photos, not previews", unit="px", views=small)  # fmt: skip


def _sharp(photos: Sequence[Photo]) -> tuple[Finding, Finding]:
    detail = np.array([p.look.detail for p in photos])
    against = detail / np.maximum(_of_group(photos, detail), 1e-9)
    soft = _named(photos, against, against < SOFT)
    median = float(np.median(detail))
    return (
        judged("sharpness", median, SHARPNESS, f"the median detail of the photos is {median:.3f}",
               "focus on the eyes, hold the camera still or use more light, and export without smoothing or strong "
               "compression"),
        judged("blurred_photos", len(soft) / len(photos), BLURRED,
               f"{len(soft)} of {len(photos)} photos are far less sharp than the others of their camera",
               "take these photos again with a shorter exposure, or remove them", views=soft),
    )  # fmt: skip


def _exposed(photos: Sequence[Photo]) -> Finding:
    stops = np.log2([max(p.look.light / p.exposure, 1e-6) for p in photos])
    off = np.abs(stops - _of_group(photos, stops))
    value = float(np.quantile(off, 0.9))
    return judged("exposure_steps", value, EXPOSURE,
                  f"a tenth of the photos are at least {value:.1f} stops brighter or darker than the others",
                  "set exposure and white balance by hand and do not change the light", unit="stops",
                  views=_named(photos, -off, off > STOPS))  # fmt: skip


def _bright(photos: Sequence[Photo]) -> Finding:
    bright = np.array([p.look.bright for p in photos])
    dark = _named(photos, bright, bright < DARK)
    return judged("dark_photos", len(dark) / len(photos), TOO_DARK,
                  f"{len(dark)} of {len(photos)} photos are nearly black in the centre",
                  "take these photos again with more light or a longer exposure", views=dark)  # fmt: skip


def _clipped(photos: Sequence[Photo]) -> Finding:
    share = np.array([p.look.clipped for p in photos])
    value = float(share.mean())
    return judged("clipped", value, CLIPPED, f"{value:.1%} of the pixels in the centre of the photos are clipped",
                  "reduce the exposure until highlights on the subject are not clipped, and keep bright windows and "
                  "lamps out of the picture", views=_named(photos, -share, share > MANY_CLIPPED))  # fmt: skip


def _doubles(photos: Sequence[Photo]) -> Finding:
    thumbs = np.stack([p.look.thumb for p in photos]).reshape(len(photos), -1)
    names = []
    for i in range(1, len(photos)):
        apart = np.sqrt(np.square(thumbs[:i] - thumbs[i]).mean(1))
        if apart.min() < DOUBLE:
            names.append(f"{photos[i].name} = {photos[int(np.argmin(apart))].name}")
    return judged("same_photo_twice", len(names) / len(photos), DOUBLES,
                  f"{len(names)} of {len(photos)} photos are the same picture as another one" if names else
                  "no two photos are the same picture",
                  "replace one photo of each pair by the correct one, or remove it", views=names)  # fmt: skip


def _subject(photos: Sequence[Photo]) -> tuple[Finding, Finding, Finding]:
    faces = sum(p.look.face for p in photos)
    crowd = [p.name for p in photos if p.look.faces > 1]
    structure = float(np.median([p.look.structure for p in photos]))
    shown = structure if faces < FACES.good else max(structure, STRUCTURE.good)  # a smooth face is a subject too
    return (
        judged("subject", shown, STRUCTURE,
               "the centre of the photos shows a subject" if STRUCTURE.level(shown) == "good" else
               "the centre of the photos shows neither a face nor any structure",
               "photograph a person or an object with visible detail, in the middle of the frame", unit="levels"),
        judged("faces", faces, FACES, f"a face is found in {faces} of {len(photos)} photos",
               "take at least three photos of a person's face from the front, evenly lit; nothing to do for an object, "
               "whose front is chosen from the cameras", unit="photos"),
        judged("two_people", len(crowd) / len(photos), CROWDED,
               f"{len(crowd)} of {len(photos)} photos show two faces of similar size" if crowd else
               "no photo shows two faces of similar size",
               "photograph one person alone, or crop the photos to one person", views=crowd),
    )  # fmt: skip


def _of_group(photos: Sequence[Photo], values: F64) -> F64:
    """(N,) for each photo the median of `values` (N,) over its camera's photos, or over all photos if those are few."""
    groups = np.array([p.group for p in photos])
    out = np.full(len(photos), float(np.median(values)))
    for group in np.unique(groups):
        alike = groups == group
        if alike.sum() >= FEW_ALIKE:
            out[alike] = np.median(values[alike])
    return out


def _named(photos: Sequence[Photo], order: F64, which: npt.NDArray[np.bool_]) -> list[str]:
    """Names of the photos where `which` (N,) is true, sorted by `order` (N,)."""
    return [photos[int(i)].name for i in np.argsort(order, kind="stable") if which[i]]

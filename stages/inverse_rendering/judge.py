"""The checks of the fit: errors in the fitted photos, initial geometry, and results of the model selection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.artifacts import MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.maths.light_frame import FLASH, TURNTABLE, WORLD
from pipeline.people import shows_person
from pipeline.verdict import Finding, Limits, judged
from stages.inverse_rendering.config import PRIORS
from stages.inverse_rendering.cross_validation import more
from stages.inverse_rendering.model_selection import CROSSED, GIVEN, MIN_SPECULAR, Facts
from stages.inverse_rendering.residuals import ViewError, decibels

# Drafts of measured captures, all subject pixels of the fitted photos, the photos' noise subtracted: scanned head
# 38 dB, a rendered man with frayed shoulders 22, a man on an arc of cameras 20, a person in a rig whose head was lost
# 7. Below 18 dB a face is not recognisable.
FIT_ERROR = Limits(27.0, 18.0)
# The face alone in the same drafts: 38, 29, 21 and 5 dB. Hair and eyes move between photos, and a draft blurs them:
# 25 to 37 dB with correct shape, 13 to 20 with wrong shape.
LABELS = {"face": Limits(27.0, 20.0), "hair": Limits(22.0, 15.0), "eyes": Limits(22.0, 13.0)}
MIN_LABELLED = 100  # fewest pixels over all photos for the error of a label
BELOW = 6.0  # dB below the median of the photos, twice the error; photos with a good PSNR are never listed
WORST_VIEWS = Limits(0.0, 0.1, lower=False)  # share of the photos
# dB from the best to the last running PSNR: 0 on good captures, 1.6 on one with moving shadows.
FELL = Limits(0.5, 3.0, lower=False)
# Share of the subject's pixels where the model is empty: scanned head .0001, frayed shoulders .016, a blob of the hull
# .022, the missing head .60.
MISSING = Limits(0.02, 0.1, lower=False)
# Share of the background where the model is not empty: scanned head .0005, an arc of cameras .006, frayed shoulders
# .013, an arm that only a few photos show .041.
BEYOND = Limits(0.05, 0.25, lower=False)
# Share of rays for which hull and masks differ: .002 on a scanned head, .017 and .035 on two people, .315 where one
# wrong mask cut the head off.
START = Limits(0.05, 0.15, lower=False)
# Error on the validation views at the model selection, over their mean radiance: scanned head .05, a man with a phone
# .19, one on an arc of cameras .28, the missing head .45, a skull under moving shadows .51.
AGREE = Limits(0.12, 0.35, lower=False)
# Ratio of what the specular term explains to the remaining error, as in model_selection.py; 0: it explains nothing.
SPECULAR = Limits(MIN_SPECULAR, 0.0)
# Error of a light that moves over a still one's, where it was chosen: .64 for a skull under a flash, .64 for a head on
# a turntable; people in a still light have .97. Never good, because shadows are not modelled then.
MOVES = Limits(0.0, 1.0, lower=False)
# Share of the photos that had no flash by their EXIF, where a flash on the camera is modelled: they had another light.
UNLIT = Limits(0.0, 0.3, lower=False)
ALWAYS = Limits(0.0, 0.0)
MAX_NAMED = 12


@dataclass(frozen=True, slots=True)
class Fitted:
    """errors: of the fitted photos. history: running PSNR in dB at each tenth of the fit. facts: of the model selection
    (model_selection.py) and of the initial geometry (choose_start.py)."""

    errors: Sequence[ViewError]
    capture: Capture
    masks: MaskSet
    history: Sequence[float]
    facts: Facts


def findings(f: Fitted) -> tuple[Finding, ...]:
    """All findings of a fit, in the order of the report."""
    return (*start(f), *errors(f), *by_label(f), *views(f), *empty(f), *fell(f), *choices(f))


def start(f: Fitted) -> list[Finding]:
    """The check whether the initial hull has the masks' silhouettes."""
    error = _number(f.facts, "relief", "silhouette_error_of_prior")
    if error is None or f.facts.get("geometry", {}).get("prior") != PRIORS["hull"]:
        return []  # other initial geometries need not have the silhouettes
    message = f"the initial geometry contradicts the masks of the validation views in {error:.1%} of the rays"
    remedy = (
        "check the masks in the report: a mask that lacks a part of the subject removes it from the model; correct or "
        "remove that mask"
    )
    return [judged("start_silhouette", error, START, message, remedy)]


def errors(f: Fitted) -> list[Finding]:
    """The check of the median PSNR of the fitted photos, the photos' noise subtracted."""
    if not f.errors:
        return []
    own = np.array([max(e.square - e.noise**2, 0.0) for e in f.errors])
    value, noise = decibels(float(np.median(own))), decibels(float(np.median([e.noise for e in f.errors])) ** 2)
    relative = float(np.median([e.relative for e in f.errors]))
    message = (
        f"the median PSNR of the fitted photos is {value:.1f} dB (error {relative:.0%} of their mean radiance); their "
        f"noise limits it to {noise:.1f} dB"
    )
    remedy = (
        "the subject or the light changed between the photos, or the shape is wrong: check masks and cameras in the "
        "report, and photograph again without movement and from more directions"
    )
    return [judged("fit_error", value, FIT_ERROR, message, remedy, unit="dB", views=_worst(f, f.errors))]


def by_label(f: Fitted) -> list[Finding]:
    """The checks of the PSNR of face, hair and eyes, over all photos with such labels."""
    out = []
    for name, limits in LABELS.items():
        parts = [(e, e.labels[name]) for e in f.errors if name in e.labels]
        pixels = sum(p.pixels for _, p in parts)
        if pixels < MIN_LABELLED:
            continue
        value = decibels(sum(p.pixels * max(p.square - e.noise**2, 0.0) for e, p in parts) / pixels)
        message = f"the PSNR of the {name} in {len(parts)} fitted photos is {value:.1f} dB"
        remedy = f"check the {name} in the report's views: if its shape is wrong, photograph it from more directions"
        out.append(judged(f"fit_error_{name}", value, limits, message, remedy, unit="dB"))
    return out


def views(f: Fitted) -> list[Finding]:
    """The check for photos with a much lower PSNR than the others, over the pixels that the model covers."""
    if not f.errors:
        return []
    least = min(float(np.median([e.psnr for e in f.errors])) - BELOW, FIT_ERROR.good)
    bad = [e for e in f.errors if e.psnr < least]
    count = f"{len(bad)} of {len(f.errors)} photos are" if bad else "no photo is"
    message = f"{count} fitted with less than {least:.1f} dB, far below the median"
    remedy = "check these photos for another subject, movement, blur, a wrong mask or camera; remove them and run again"
    return [judged("worst_views", len(bad) / len(f.errors), WORST_VIEWS, message, remedy, views=_worst(f, bad))]


def empty(f: Fitted) -> list[Finding]:
    """The checks of the subject's pixels without model, and of the background's pixels with model."""
    if not f.errors:
        return []
    value = float(np.mean([e.missing for e in f.errors]))
    message = f"the model is missing in {value:.1%} of the subject's pixels in the fitted photos"
    remedy = "a part of the subject is missing: check for masks or cameras that contradict the others"
    lacking = sorted((e for e in f.errors if e.missing > MISSING.usable), key=lambda e: -e.missing)
    out = [judged("fit_missing", value, MISSING, message, remedy, views=_names(f, lacking))]
    value = float(np.mean([e.beyond for e in f.errors]))
    message = f"the model covers {value:.1%} of the background's pixels around the subject in the fitted photos"
    remedy = "something that most masks exclude was modelled: check for masks that include more than the others"
    covered = sorted((e for e in f.errors if e.beyond > BEYOND.usable), key=lambda e: -e.beyond)
    return [*out, judged("fit_beyond", value, BEYOND, message, remedy, views=_names(f, covered))]


def fell(f: Fitted) -> list[Finding]:
    """The check how far the final PSNR is below its best value."""
    known = [p for p in f.history if math.isfinite(p)]
    if len(known) < 2:
        return []
    value = max(max(known) - known[-1], 0.0)
    message = (
        f"the final PSNR of the fitted photos is {known[-1]:.1f} dB; the best during the fit was {max(known):.1f} dB"
    )
    remedy = (
        "the model selection made the fit worse, because the light or the subject changes between photos; set "
        "inverse_rendering.specular=off or inverse_rendering.calibration=on and compare"
    )
    return [judged("psnr_fell", value, FELL, message, remedy, unit="dB")]


def choices(f: Fitted) -> list[Finding]:
    """The checks of the model selection's figures."""
    return [*_light_moves(f), *_flash_fired(f), *_photos_agree(f), *_specular(f), *_colours(f), *_light(f)]


def _light_moves(f: Fitted) -> list[Finding]:
    """Whether the light moved with the camera, by the photos. The value is the error of that model over a still
    light's."""
    fact = f.facts.get("light_frame", {})
    frame = str(fact.get("frame", WORLD))
    still, own = (_number(f.facts, "light_frame", f"error_{name}") for name in (WORLD, frame))
    if frame == WORLD or fact.get("why") == "setting" or still is None or own is None:
        return []
    what = {FLASH: "a flash on the camera", TURNTABLE: "the subject turns while the room stands still"}
    message = (
        f"the light moves with the camera ({what.get(frame, 'lamps fixed to it')}): this explains the photos with "
        f"{own / max(still, 1e-9):.2f} times the error of a still light"
    )
    remedy = (
        "nothing to do if that is so, but shadows of the subject on itself are not modelled then; else set "
        "inverse_rendering.light_frame=world"
    )
    return [judged("light_moves", own / max(still, 1e-9), MOVES, message, remedy)]


def _flash_fired(f: Fitted) -> list[Finding]:
    """Whether the photos of a flash on the camera all have it, by those whose EXIF says whether it fired."""
    if f.facts.get("light_frame", {}).get("frame") != FLASH:
        return []
    told = [v for v in f.capture.views if v.flash is not None and not v.holdout]
    dark = [v.name for v in told if not v.flash]
    if not told or len(dark) == len(told):
        return []  # all say no: the flash was another program's or a lamp on the camera
    value = len(dark) / len(told)
    message = f"a flash on the camera is modelled; by their EXIF it did not fire in {len(dark)} of {len(told)} photos"
    remedy = "take the named photos out, or photograph all with flash: one light is fitted to all photos"
    return [judged("flash_fired", value, UNLIT, message, remedy, views=dark[:MAX_NAMED])]


def _photos_agree(f: Fitted) -> list[Finding]:
    with_it = _number(f.facts, "specular", "error_with")
    without = _number(f.facts, "specular", "error_without")
    if with_it is None or without is None:
        return []
    value = min(with_it, without)
    message = f"the colours of the same place differ between photos by {value:.0%} of the mean radiance"
    remedy = (
        "light, subject or exposure changes from photo to photo, or the surface is wrong: use a fixed exposure, a "
        "constant light and a still subject"
    )
    return [judged("photos_agree", value, AGREE, message, remedy)]


def _specular(f: Fitted) -> list[Finding]:
    """The check of the specular term: its absence is an error for skin, but may be right for objects."""
    fact = f.facts.get("specular", {})
    without, best = _number(f.facts, "specular", "error_without"), _number(f.facts, "specular", "error_with")
    if fact.get("why") in ("setting", CROSSED) or without is None or best is None:
        return []
    value = max(more(without, best), 0.0) / max(best, 1e-9)
    if fact.get("modelled"):
        message = f"the specular term explains {value:.2f} times the remaining error: it is modelled"
        return [judged("specular", value, Limits(0.0, 0.0), message, "")]
    message = (
        f"no highlights were detected: a specular term explains {value:.2f} times the remaining error, "
        f"{MIN_SPECULAR:g} is needed; F0 is zero"
    )
    remedy = (
        "the asset looks matt under new light; photograph with fixed exposure under a light with edges (window, soft "
        "box) from more directions, or set inverse_rendering.specular=on"
    )
    return [judged("specular", value, SPECULAR if shows_person(f.masks) else ALWAYS, message, remedy)]


def _colours(f: Fitted) -> list[Finding]:
    fact = f.facts.get("calibration", {})
    without, with_it = _number(f.facts, "calibration", "error_without"), _number(f.facts, "calibration", "error_with")
    if fact.get("why") == "setting" or without is None or with_it is None:
        return []
    value = max(more(without, with_it), 0.0)
    message = f"a colour matrix for each photo explains {value:.1%} of their mean radiance: it is "
    return [judged("calibration", value, ALWAYS, message + ("fitted" if fact.get("modelled") else "not used"), "")]


def _light(f: Fitted) -> list[Finding]:
    """That the light was given, if it was. Whether it is right shows in the error of the fitted photos."""
    fact = f.facts.get("light", {})
    if fact.get("why") != GIVEN:
        return []
    return [
        judged("light_given", 1.0, ALWAYS, f"the light is given ({fact.get('from', '')}) and was not estimated", "")
    ]


def _worst(f: Fitted, of: Sequence[ViewError]) -> tuple[str, ...]:
    return _names(f, sorted(of, key=lambda e: (-e.square, e.index)))


def _names(f: Fitted, of: Sequence[ViewError]) -> tuple[str, ...]:
    names = {v.index: v.name for v in f.capture.views}
    return tuple(names.get(e.index, str(e.index)) for e in of[:MAX_NAMED])


def _number(facts: Facts, part: str, name: str) -> float | None:
    """A figure of the model selection; None if it was not measured."""
    value = facts.get(part, {}).get(name)
    return float(value) if isinstance(value, int | float) and math.isfinite(float(value)) else None

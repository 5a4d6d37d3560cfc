"""How good the fit is: what it leaves unexplained of the photos, where it began, and what it found out on its way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.artifacts import Capture, MaskSet
from pipeline.people import shows_person
from pipeline.verdict import Finding, Limits, judged
from stages.inverse_rendering.cross_validation import more
from stages.inverse_rendering.model_selection import FAINT, Facts
from stages.inverse_rendering.residuals import ViewError, decibels

# Drafts of measured captures, all subject pixels of the fitted photos, the photos' noise taken off: scanned head 38 dB,
# a rendered man with frayed shoulders 22, a man on an arc of cameras 20, a rig's person whose head was lost 7. Below
# 18 dB a face is not recognised.
FIT_ERROR = Limits(27.0, 18.0)
# The face alone in the same drafts: 38, 29, 21 and 5 dB. Hair and eyes move between photos, and a draft blurs them:
# 25 to 37 dB where the shape is right, 13 to 20 where it is not.
LABELS = {"face": Limits(27.0, 20.0), "hair": Limits(22.0, 15.0), "eyes": Limits(22.0, 13.0)}
MIN_LABELLED = 100  # pixels over all photos, below which an error by label is chance
BELOW = 6.0  # dB below the median of the photos: twice the error. One that is shown well counts for none of these
WORST_VIEWS = Limits(0.0, 0.1, lower=False)  # share of the photos
# dB that the running PSNR may end below its best: rises to the end on sound captures, 1.6 on one with moving shadows.
FELL = Limits(0.5, 3.0, lower=False)
# Share of the subject's pixels that the field leaves empty: scanned head .0001, frayed shoulders .016, a blob of the
# hull .022, the lost head .60.
MISSING = Limits(0.02, 0.1, lower=False)
# Share of the background near the subject, and beyond, where the field is not empty: scanned head .0005, an arc
# of cameras .006, frayed shoulders .013, an arm that only a few photos show .041.
BEYOND = Limits(0.05, 0.25, lower=False)
# Share of rays that the hull answers otherwise than the masks: .002 on a scanned head, .017 and .035 on two people,
# .315 where one wrong mask cut the head off.
START = Limits(0.05, 0.15, lower=False)
# Error of the photos kept back at the time of the evidence, over their mean radiance: scanned head .05, a man with a
# phone .19, one on an arc of cameras .28, the lost head .45, a skull under moving shadows .51.
AGREE = Limits(0.12, 0.35, lower=False)
# What a highlight explains over what stays unexplained, as the decision weighs them (model_selection.py). At 0 nothing
# at all.
SHINE = Limits(FAINT, 0.0)
ALWAYS = Limits(0.0, 0.0)
MAX_NAMED = 12


@dataclass(frozen=True, slots=True)
class Fitted:
    """errors: of the fitted photos. history: running PSNR at each tenth of the fit. facts: how the model
    was decided (model_selection.py). prior: what the fit began as (settings.py)."""

    errors: Sequence[ViewError]
    capture: Capture
    masks: MaskSet
    history: Sequence[float]
    facts: Facts
    prior: str = "hull"


def findings(f: Fitted) -> tuple[Finding, ...]:
    """Everything that is judged of a fit, in the order of the report."""
    return (*start(f), *errors(f), *by_label(f), *views(f), *empty(f), *fell(f), *choices(f))


def start(f: Fitted) -> list[Finding]:
    """Whether the hull that the fit began as has the shape of the masks."""
    error = _number(f.facts, "relief", "silhouette_error_of_prior")
    if error is None or f.prior != "hull":
        return []
    message = f"the shape that the fit began with disagrees with {error:.1%} of what the masks of unused photos show"
    remedy = (
        "look at the masks in the report: one that lacks a part of the subject cuts that part off; mend or leave it out"
    )
    return [judged("start_silhouette", error, START, message, remedy)]


def errors(f: Fitted) -> list[Finding]:
    """PSNR of the median photo without what its noise alone would cost."""
    if not f.errors:
        return []
    own = np.array([max(e.square - e.noise**2, 0.0) for e in f.errors])
    value, noise = decibels(float(np.median(own))), decibels(float(np.median([e.noise for e in f.errors])) ** 2)
    relative = float(np.median([e.relative for e in f.errors]))
    message = (
        f"the fitted model shows the photos with {value:.1f} dB in the median ({relative:.0%} of their mean radiance "
        f"is unexplained); their noise alone would allow {noise:.1f} dB"
    )
    remedy = (
        "the photos do not show one still subject in one light, or the shape is wrong: check masks and cameras in the "
        "report, and photograph again without movement and from more directions"
    )
    return [judged("fit_error", value, FIT_ERROR, message, remedy, unit="dB", views=_worst(f, f.errors))]


def by_label(f: Fitted) -> list[Finding]:
    """PSNR of face, hair and eyes alone, over all photos that have such labels."""
    out = []
    for name, limits in LABELS.items():
        parts = [(e, e.labels[name]) for e in f.errors if name in e.labels]
        pixels = sum(p.pixels for _, p in parts)
        if pixels < MIN_LABELLED:
            continue
        value = decibels(sum(p.pixels * max(p.square - e.noise**2, 0.0) for e, p in parts) / pixels)
        message = f"the fitted model shows the {name} with {value:.1f} dB in {len(parts)} photos"
        remedy = f"look at the {name} in the report's views: where shape is wrong, photograph it from more directions"
        out.append(judged(f"fit_error_{name}", value, limits, message, remedy, unit="dB"))
    return out


def views(f: Fitted) -> list[Finding]:
    """Photos that the model explains much worse than the others, where it is at all."""
    if not f.errors:
        return []
    least = min(float(np.median([e.psnr for e in f.errors])) - BELOW, FIT_ERROR.good)
    bad = [e for e in f.errors if e.psnr < least]
    count = f"{len(bad)} of {len(f.errors)} photos are" if bad else "no photo is"
    message = f"{count} shown with less than {least:.1f} dB, far below the median photo"
    remedy = (
        "look at these photos: another subject, movement, blur, a wrong mask or camera; leave them out and run again"
    )
    return [judged("worst_views", len(bad) / len(f.errors), WORST_VIEWS, message, remedy, views=_worst(f, bad))]


def empty(f: Fitted) -> list[Finding]:
    """How much of the subject the field does not have, and how much it has beside it."""
    if not f.errors:
        return []
    value = float(np.mean([e.missing for e in f.errors]))
    message = f"{value:.1%} of the subject's pixels in the fitted photos see nothing of the model"
    remedy = "a part of the subject is missing: look for masks or cameras that contradict the others"
    lacking = sorted((e for e in f.errors if e.missing > MISSING.usable), key=lambda e: -e.missing)
    out = [judged("fit_missing", value, MISSING, message, remedy, views=_names(f, lacking))]
    value = float(np.mean([e.beyond for e in f.errors]))
    message = f"{value:.1%} of the background's pixels around the subject in the fitted photos see the model"
    remedy = "something that most masks leave out was modelled: look for masks that show more than the others"
    covered = sorted((e for e in f.errors if e.beyond > BEYOND.usable), key=lambda e: -e.beyond)
    return [*out, judged("fit_beyond", value, BEYOND, message, remedy, views=_names(f, covered))]


def fell(f: Fitted) -> list[Finding]:
    """By how much the fit ended below its best."""
    known = [p for p in f.history if math.isfinite(p)]
    if len(known) < 2:
        return []
    value = max(max(known) - known[-1], 0.0)
    message = f"the fitted photos ended at {known[-1]:.1f} dB; the best on the way was {max(known):.1f} dB"
    remedy = (
        "what the fit decided half way made it worse: the light or the subject changes between photos; set "
        "inverse_rendering.specular=off or inverse_rendering.calibration=on and compare"
    )
    return [judged("psnr_fell", value, FELL, message, remedy, unit="dB")]


def choices(f: Fitted) -> list[Finding]:
    """What the evidence said, and how clearly."""
    return [*_agree(f), *_shine(f), *_colours(f)]


def _agree(f: Fitted) -> list[Finding]:
    with_it = _number(f.facts, "specular", "error_with")
    without = _number(f.facts, "specular", "error_without")
    if with_it is None or without is None:
        return []
    value = min(with_it, without)
    message = f"the photos' colours disagree by {value:.0%} of their mean where several show the same place"
    remedy = (
        "light, subject or exposure changes from photo to photo, or the surface is wrong: fix the exposure, keep light "
        "and subject still"
    )
    return [judged("photos_agree", value, AGREE, message, remedy)]


def _shine(f: Fitted) -> list[Finding]:
    """Matt skin is a loss, since all skin shines; of other things it may be true."""
    fact = f.facts.get("specular", {})
    dull, best = _number(f.facts, "specular", "error_without"), _number(f.facts, "specular", "error_with")
    if fact.get("why") == "setting" or dull is None or best is None:
        return []
    value = max(more(dull, best), 0.0) / max(best, 1e-9)
    if fact.get("modelled"):
        message = f"highlights are {value:.2f} of what stays unexplained: they were modelled"
        return [judged("specular", value, Limits(0.0, 0.0), message, "")]
    message = f"no highlight was told from what stays unexplained ({value:.2f} of it, {FAINT:g} is needed): F0 is zero"
    remedy = (
        "the asset looks matt under new light; photograph with fixed exposure under a light with edges (window, soft "
        "box) from more directions, or set inverse_rendering.specular=on"
    )
    return [judged("specular", value, SHINE if shows_person(f.masks) else ALWAYS, message, remedy)]


def _colours(f: Fitted) -> list[Finding]:
    fact = f.facts.get("calibration", {})
    without, with_it = _number(f.facts, "calibration", "error_without"), _number(f.facts, "calibration", "error_with")
    if fact.get("why") == "setting" or without is None or with_it is None:
        return []
    value = max(more(without, with_it), 0.0)
    message = f"colours of their own explain {value:.1%} of the photos' mean radiance: they were "
    return [judged("calibration", value, ALWAYS, message + ("fitted" if fact.get("modelled") else "left out"), "")]


def _worst(f: Fitted, of: Sequence[ViewError]) -> tuple[str, ...]:
    return _names(f, sorted(of, key=lambda e: (-e.square, e.index)))


def _names(f: Fitted, of: Sequence[ViewError]) -> tuple[str, ...]:
    names = {v.index: v.name for v in f.capture.views}
    return tuple(names.get(e.index, str(e.index)) for e in of[:MAX_NAMED])


def _number(facts: Facts, part: str, name: str) -> float | None:
    """A figure of a decision, None where it was not judged."""
    value = facts.get(part, {}).get(name)
    return float(value) if isinstance(value, int | float) and math.isfinite(float(value)) else None

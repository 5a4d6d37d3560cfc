"""The checks of the registration: measured figures are compared with limits.

Source of the limits: a scanned bald head in a studio and rendered persons (docs/stages/template.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.eyes.iris import LEAST_PIXELS
from pipeline.registration.identity_fit import MAX_RESIDUAL
from pipeline.verdict import Finding, Limits, judged

DISTANCE = Limits(0.3, 1.0, lower=False)
MOST = Limits(1.5, 3.0, lower=False)  # .9 to 1.2 on captures from all sides
LANDMARKS = Limits(4.0, 8.0, lower=False)  # the network's own scatter is 2 to 3 mm
FOLDED = Limits(4, 40, lower=False)  # of 4,906; an old man with thin lips has one where they press together
PIERCED = Limits(0, 200, lower=False)
SHOWN_THROUGH = Limits(0, 20, lower=False)  # of 6,293 points; four of them were a dark spot beside a nose

SHAPE = "look at the surface in the report; better masks and cameras make it smoother"


def judge(figures: Mapping[str, float]) -> tuple[Finding, ...]:
    """All findings of a registered template, including the good ones. figures: of the artifact."""
    f = figures
    return (
        judged("distance_mm", f["distance_mm"], DISTANCE,
               f"half of the seen skin lies within {f['distance_mm']:.2g} mm of the fitted surface before displacement",
               SHAPE, unit="mm"),
        judged("distance_95_mm", f["distance_95_mm"], MOST,
               f"95 % of the seen skin lies within {f['distance_95_mm']:.2g} mm of the fitted surface before "
               "displacement", SHAPE, unit="mm"),
        judged("landmarks_mm", f["landmarks_mm"], LANDMARKS,
               f"the face's landmarks lie {f['landmarks_mm']:.2g} mm (median) from the template's",
               "take sharper photos of the face from the front and both sides", unit="mm"),
        judged("folded", f["folded"], FOLDED, f"{f['folded']:g} quads of the head are folded", SHAPE),
        judged("pierced", f["pierced"], PIERCED,
               f"{f['pierced']:g} edges of the face pass through another part of it", SHAPE),
        judged("shown_through", f["shown_through"], SHOWN_THROUGH,
               f"{f['shown_through']:g} points of the mouth's inside lie outside of the face", SHAPE),
    )  # fmt: skip


def faults(quality: Sequence[Finding], eyes: str) -> str:
    """The first fault of a registered template, for assets that are made from it only without one; "" for none. eyes:
    why they are not fitted."""
    wrong = [f.said for f in quality if f.level != "good"]
    if eyes:
        wrong.append(f"its eyes could not be fitted ({eyes})")
    return f"{wrong[0]}; uv.mesh=template takes the template nevertheless" if wrong else ""


MIN_FACES = 0.1  # of the photos: persons have 0.25 or more also if photographed all around, a statue had 0.06
SCALES = (0.75, 1.75)  # metres per metre of the template: a child's head to the largest of adults
MAX_WEIGHT = 3.0  # root mean square of the identity weights: persons have 1
MAX_DISTANCE = 3.0  # mm, median: the template is not on this head
MIN_SEEN = 0.03  # of the skin


def refused_faces(agree: int, photos: int) -> str:
    """Why so few photos with a face are not a person's; "" if they are enough. agree: of `photos`."""
    if agree < MIN_FACES * photos:
        return f"only {agree} of {photos} photos agree on a face: a statue, or photos of something else"
    return ""


def refused_object(sources: Sequence[str]) -> str:
    """Why a subject is no person by how it was segmented; "" if it may be one. sources: of its masks."""
    if any(s.startswith("object") for s in sources):
        return "segmented as an object, not as a person (masks.method)"
    return ""


def refused_placing(residual_mm: float, scale: float, *, metric: bool) -> str:
    """Why the landmarks do not place the template; "" if they do. scale: metres per metre of the template."""
    if residual_mm > 1000 * MAX_RESIDUAL:
        return f"the template's landmarks are {residual_mm:.2g} mm off (median), more than {1000 * MAX_RESIDUAL:g}"
    if metric and not SCALES[0] <= scale <= SCALES[1]:
        return f"the head would be {scale:.2g} times the template's size, outside of {SCALES[0]:g} to {SCALES[1]:g}"
    return ""


def refused_irises(pixels: float) -> str:
    """Why photos are too coarse for the template's eyes; "" if they are not. pixels: across an iris."""
    if pixels < LEAST_PIXELS:
        return f"an iris is {pixels:.2g} pixels across, fewer than {LEAST_PIXELS:g}"
    return ""


def refused_fit(figures: Mapping[str, float]) -> str:
    """Why the finished registration does not hold; "" if it does."""
    checks = (
        (
            figures["identity_rms"] <= MAX_WEIGHT,
            f"identity weights of {figures['identity_rms']:.2g} (root mean square)",
        ),
        (figures["distance_mm"] <= MAX_DISTANCE, f"{figures['distance_mm']:.2g} mm (median) from the fitted surface"),
        (figures["seen"] >= MIN_SEEN, f"the photos show {figures['seen']:.1%} of its skin"),
    )
    return next((f"the template does not fit this head: {why}" for ok, why in checks if not ok), "")

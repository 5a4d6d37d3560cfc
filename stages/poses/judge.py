"""How good the cameras are: how many photos have one, whether they fit the photos, and what of the subject they see.

Limits are from the captures that they were measured on: rigs (54 and 36 views), 44 photos by hand all around, and an
arc of a film before a face (27 degrees), which is usable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.artifacts import Camera, CameraSet, Capture, CaptureView
from pipeline.directions import Counts, around, count_seen, parts, share_seen, spread, view_directions
from pipeline.transforms import F64, matrix
from pipeline.verdict import Finding, Limits, judged
from stages.poses.normalise import PLAUSIBLE_ROI

AROUND = "photograph all around the subject, a step of 15 degrees at a time, also from above and below"
HIDDEN = 0.5  # a part of the head of which less is seen is named
PER = 1000.0  # pixels of the longer edge to which errors in pixels are brought

PLACED = Limits(0.9, 0.6)  # 43 of 44 by hand; 30 of 66 of a skull under a flash, which is of no use
GROUPS = Limits(
    0.1, 0.5, lower=False
)  # largest other group against the photos placed: half as many is a second subject
CONTRADICTED = Limits(0.05, 0.5, lower=False)  # one bumped camera of 20 is left out; from half on nobody knows which
REPROJECTION = Limits(1.5, 3.0, lower=False)  # px per 1000: .5 and 1.0 in captures by hand that are right
FOCAL = Limits(0.15, 0.4, lower=False)  # from EXIF: right solutions within 2 %, a wrong one was 41 % off
POINTS = Limits(500, 100)  # 651 on a person by hand, all around; below 100 a principal point or a front is not told
FLAT = Limits(0.05, 0.05)  # thickness of the points against their length: a wall has .01, a face from the front .3
SEEN = Limits(0.85, 0.3)  # of the directions around: rigs .96 and 1, by hand .92, an arc before a face .40
FRONT_SEEN = Limits(0.9, 0.5)
SPREAD = Limits(60.0, 10.0)  # degrees: 174 and more all around, 27 an arc; below 10 depth is not told
MIRRORED = Limits(0.0, 0.5, lower=False)


def judge(found: CameraSet, capture: Capture, points: F64 | None) -> tuple[Counts, tuple[Finding, ...]]:
    """Which directions the fitted views see, and all findings that cameras alone allow. points: (M, 3) sparse points in
    asset coordinates, None where cameras were given."""
    views, stated = capture.views, found.source == "given" and capture.kind == "facescape"
    fitted = fitted_cameras(found.cameras, views)
    directions = view_directions(fitted)
    counts = count_seen(directions)
    out = [_placed(found), *_errors(found), *_focal(found, views), _scale(found, stated),
           *_points(found, points), *_seen(counts), _spread(directions)]  # fmt: skip
    return counts, tuple(out)


def fitted_cameras(cameras: Sequence[Camera], views: Sequence[CaptureView]) -> list[Camera]:
    """The cameras whose photos are not held out."""
    held = {v.index for v in views if v.holdout}
    return [c for c in cameras if c.index not in held]


def contradicted(wrong: Sequence[str], known: int, total: int) -> Finding:
    """Given cameras held against their photos. wrong: names of views that contradict; known: views that tell."""
    share = len(wrong) / max(1, known)
    return judged("cameras_against_photos", share, CONTRADICTED,
                  f"the photos contradict the cameras of {len(wrong)} of {known} views that tell (of {total})",
                  "check that photos and cameras are in the same order and of the same size, or set "
                  "poses.method=colmap to have the cameras solved", views=wrong)  # fmt: skip


def groups(placed: int, others: Sequence[Sequence[str]]) -> Finding:
    """The largest group of photos that fit together, but not with the placed ones. others: names in each."""
    largest = max(others, key=len, default=())
    message = (
        f"{len(largest)} photos fit together, but not with the {placed} others"
        if largest
        else "all placed photos \
fit together"
    )
    return judged("largest_other_group", len(largest) / max(1, placed), GROUPS, message,
                  "photograph the way between the groups; if they show another subject, make a capture of their own",
                  views=largest)  # fmt: skip


def mirrored(names: Sequence[str], total: int) -> Finding:
    """Photos that fit the others only when they are turned over from left to right."""
    return judged("mirrored_photos", len(names) / max(1, total), MIRRORED,
                  f"{len(names)} of {total} photos are the mirror image of what the others show" if names else
                  "no photo is a mirror image",
                  "use the originals: a phone's front camera mirrors what it saves unless that is switched off",
                  views=names)  # fmt: skip


def _placed(found: CameraSet) -> Finding:
    total = len(found.cameras) + len(found.unregistered)
    return judged("photos_placed", len(found.cameras) / max(1, total),
                  PLACED,
                  f"{len(found.cameras)} of {total} photos have a camera that fits",
                  "take the photos around one still subject, sharp, each overlapping the next by two thirds; remove "
                  "those named if they show something else", views=found.unregistered)  # fmt: skip


def _errors(found: CameraSet) -> list[Finding]:
    if found.reprojection_error_px is None:
        return []
    edge = float(np.median([max(c.width, c.height) for c in found.cameras]))
    value = found.reprojection_error_px * PER / edge
    worst = sorted(found.view_errors_px.items(), key=lambda x: -x[1])
    far = [n for n, e in worst if e * PER / edge > REPROJECTION.good]
    message = f"points on the subject are {found.reprojection_error_px:.2f} px from where the photos show them"
    return [judged("reprojection_error", value, REPROJECTION, message,
                   "keep subject and lens still; take photos that overlap more", unit="px per 1000 px",
                   views=far)]  # fmt: skip


def _focal(found: CameraSet, views: Sequence[CaptureView]) -> list[Finding]:
    known = {v.index: v.focal_px for v in views if v.focal_px}
    ratios = {c.name: c.K[0][0] / known[c.index] for c in found.cameras if c.index in known}
    if found.source != "colmap" or not ratios:
        return []
    off = abs(float(np.median(list(ratios.values()))) - 1)
    return [judged("focal_length", off, FOCAL, f"the solved focal length is {off:.0%} off what EXIF says",
                   "take more photos with more overlap, all at one zoom; the solution is doubtful",
                   views=sorted(ratios, key=lambda n: -abs(ratios[n] - 1)))]  # fmt: skip


def _scale(found: CameraSet, stated: bool) -> Finding:
    """A size in metres must be a head's. One that is not known is no fault of the photos; stated: but of cameras in a
    format that says its unit, of which none makes a head."""
    low, high = PLAUSIBLE_ROI
    capture_unit = float(np.cbrt(np.linalg.det(matrix(found.capture_from_asset)[:3, :3])))
    radius = found.roi_radius * (1.0 if found.metric else capture_unit)
    known = found.metric or stated
    off = max(low / radius, radius / high, 1.0) if known else 1.0
    message = f"the views see {radius:.3g} {'m' if found.metric else 'units'} around the subject"
    return judged("scale", off, Limits(1.0, float("inf"), lower=False),
                  (message if known else "the size of the subject is not known, and made a head's")
                  + (f", where a head is {low} to {high} m" if off > 1 else ""),
                  "check poses.unit, poses.distance, poses.marker_mm or poses.pupils_mm", unit="times")  # fmt: skip


def _points(found: CameraSet, points: F64 | None) -> list[Finding]:
    if points is None:
        return []
    own = points[np.linalg.norm(points, axis=1) <= found.roi_radius]
    out = [judged("points_on_subject", len(own), POINTS, f"{len(own)} points on the subject are shared by photos",
                  "use sharper photos with more overlap; skin without pores needs a closer camera or more light",
                  unit="points")]  # fmt: skip
    if len(own) >= 3:
        size = np.linalg.svd(own - own.mean(0), compute_uv=False)
        thick = float(size[-1] / max(size[0], 1e-12))
        flat = FLAT.level(thick) != "good"
        out.append(judged("depth_of_subject", thick, FLAT,
                          "the points lie in one plane: the photos show a wall or a picture" if flat else
                          "the points fill a body", "photograph a person or an object, from all around"))  # fmt: skip
    return out


def _seen(counts: Counts) -> list[Finding]:
    shares = {name: share_seen(counts, where) for name, where in parts().items()}
    hidden = [f"the {n} ({s:.0%} seen)" for n, s in shares.items() if s < HIDDEN and n != "underside"]
    all_round = share_seen(counts, around())
    unseen = f"; hardly seen by any photo: {', '.join(hidden)}" if hidden else ""
    return [
        judged("directions_seen", all_round, SEEN,
               f"{all_round:.0%} of the directions around the subject are seen by a photo{unseen}", AROUND),
        judged("front_seen", shares["front"], FRONT_SEEN, f"{shares['front']:.0%} of the front is seen by a photo",
               "photograph the face from both sides, in steps of 15 degrees; if this is its front already, its "
               "direction is wrong: take photos in which the face is seen"),
    ]  # fmt: skip


def _spread(directions: F64) -> Finding:
    degrees = spread(directions)
    return judged("view_spread", degrees, SPREAD, f"the views are at most {degrees:.0f} degrees apart",
                  f"{AROUND}; photos from one side tell no depth", unit="degrees")  # fmt: skip

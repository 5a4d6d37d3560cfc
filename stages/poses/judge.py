"""The checks of the cameras: how many photos have one, their errors, and which directions of the subject they see.

The limits come from measured captures: rigs (54 and 36 views), 44 hand-held photos all around, and a video of an arc in
front of a face (27 degrees), which is usable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.artifacts import Camera, CameraSet
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.directions import Counts, around, count_seen, parts, share_seen, spread, view_directions
from pipeline.transforms import F64, matrix, scale_of
from pipeline.verdict import Finding, Limits, judged
from stages.poses.normalise import PLAUSIBLE_ROI

AROUND = "photograph all around the subject, a step of 15 degrees at a time, also from above and below"
HIDDEN = 0.5  # parts of the head of which a smaller share is seen are listed
PER = 1000.0  # errors are in pixels per 1000 pixels of the longer edge

PLACED = Limits(0.9, 0.6)  # 43 of 44 by hand; 30 of 66 of a skull under a flash, which is unusable
GROUPS = Limits(
    0.1, 0.5, lower=False
)  # largest other group relative to the registered photos: half as many is a second subject
CONTRADICTED = Limits(0.05, 0.5, lower=False)  # one bumped camera of 20 is left out; from half on it is unknown which
REPROJECTION = Limits(1.5, 3.0, lower=False)  # px per 1000: .5 and 1.0 in correct hand-held captures
FOCAL = Limits(0.15, 0.4, lower=False)  # from EXIF: correct solutions within 2 %, a wrong one was 41 % off
POINTS = Limits(500, 100)  # 651 on a person by hand, all around; fewer than 100 give no principal point and no front
FLAT = Limits(0.05, 0.05)  # thickness of the points relative to their length: a wall .01, a face from the front .3
SEEN = Limits(0.85, 0.3)  # of the directions around: rigs .96 and 1, by hand .92, an arc in front of a face .40
FRONT_SEEN = Limits(0.9, 0.5)
SPREAD = Limits(60.0, 10.0)  # degrees: at least 174 all around, 27 an arc; below 10 depth can't be triangulated
MIRRORED = Limits(0.0, 0.5, lower=False)


def judge(found: CameraSet, capture: Capture, points: F64 | None) -> tuple[Counts, tuple[Finding, ...]]:
    """Directions seen by the fitted views, and the findings. points: (M, 3) sparse points in asset coordinates, or
    None."""
    views, stated = capture.views, found.source == "given" and capture.kind in ("facescape", "olat")
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
    """The check of given cameras against the photos. wrong: names of contradicted views; known: number of views with
    enough matches; total: of all views."""
    share = len(wrong) / max(1, known)
    return judged("cameras_against_photos", share, CONTRADICTED,
                  f"the photos contradict {len(wrong)} of {known} cameras (of {total} views, {known} have enough "
                  "matches for the check)",
                  "check that photos and cameras are in the same order and of the same size, or set "
                  "poses.method=colmap to solve the cameras from the photos", views=wrong)  # fmt: skip


def groups(placed: int, others: Sequence[Sequence[str]]) -> Finding:
    """The check of the largest group of photos that fit together, but not with the registered ones. placed: number of
    the latter; others: names in each group."""
    largest = max(others, key=len, default=())
    message = (
        f"{len(largest)} photos fit together, but not with the {placed} others"
        if largest
        else "all registered photos fit together"
    )
    return judged("largest_other_group", len(largest) / max(1, placed), GROUPS, message,
                  "take photos between the groups; if they show another subject, put them into a separate capture",
                  views=largest)  # fmt: skip


def mirrored(names: Sequence[str], total: int) -> Finding:
    """The check for photos that fit the others only when flipped horizontally. total: number of all photos."""
    return judged("mirrored_photos", len(names) / max(1, total), MIRRORED,
                  f"{len(names)} of {total} photos are mirror images" if names else
                  "no photo is a mirror image",
                  "use the original photos; a phone's front camera saves mirror images unless that is switched off",
                  views=names)  # fmt: skip


def _placed(found: CameraSet) -> Finding:
    total = len(found.cameras) + len(found.unregistered)
    return judged("photos_placed", len(found.cameras) / max(1, total),
                  PLACED,
                  f"{len(found.cameras)} of {total} photos have a camera",
                  "take sharp photos around one still subject, each overlapping the next by two thirds; remove the "
                  "listed photos if they show something else", views=found.unregistered)  # fmt: skip


def _errors(found: CameraSet) -> list[Finding]:
    if found.reprojection_error_px is None:
        return []
    edge = float(np.median([max(c.width, c.height) for c in found.cameras]))
    value = found.reprojection_error_px * PER / edge
    worst = sorted(found.view_errors_px.items(), key=lambda x: -x[1])
    far = [n for n, e in worst if e * PER / edge > REPROJECTION.good]
    message = f"the mean reprojection error is {found.reprojection_error_px:.2f} px"
    return [judged("reprojection_error", value, REPROJECTION, message,
                   "keep the subject still and the zoom fixed; take photos that overlap more", unit="px per 1000 px",
                   views=far)]  # fmt: skip


def _focal(found: CameraSet, views: Sequence[CaptureView]) -> list[Finding]:
    known = {v.index: v.focal_px for v in views if v.focal_px}
    ratios = {c.name: c.K[0][0] / known[c.index] for c in found.cameras if c.index in known}
    if found.source != "colmap" or not ratios:
        return []
    off = abs(float(np.median(list(ratios.values()))) - 1)
    return [judged("focal_length", off, FOCAL, f"the solved focal length differs by {off:.0%} from EXIF",
                   "the cameras may be wrong; take more photos with more overlap, all at one zoom",
                   views=sorted(ratios, key=lambda n: -abs(ratios[n] - 1)))]  # fmt: skip


def _scale(found: CameraSet, stated: bool) -> Finding:
    """The check of the subject's size, which must be a head's if the scale is known. An unknown scale is no fault,
    unless the cameras' format defines its unit (stated) and no unit gives a head's size."""
    low, high = PLAUSIBLE_ROI
    capture_unit = scale_of(matrix(found.capture_from_asset))
    radius = found.roi_radius * (1.0 if found.metric else capture_unit)
    known = found.metric or stated
    off = max(low / radius, radius / high, 1.0) if known else 1.0
    message = f"the region of interest has a radius of {radius:.3g} {'m' if found.metric else 'units'}"
    return judged("scale", off, Limits(1.0, float("inf"), lower=False),
                  (message if known else "the subject's size is unknown; it is scaled to the size of a head")
                  + (f"; a head has {low} to {high} m" if off > 1 else ""),
                  "check poses.unit, poses.distance, poses.marker_mm or poses.pupils_mm", unit="times")  # fmt: skip


def _points(found: CameraSet, points: F64 | None) -> list[Finding]:
    if points is None:
        return []
    own = points[np.linalg.norm(points, axis=1) <= found.roi_radius]
    out = [judged("points_on_subject", len(own), POINTS, f"{len(own)} sparse points lie on the subject",
                  "use sharper photos with more overlap; skin without pores needs a closer camera or more light",
                  unit="points")]  # fmt: skip
    if len(own) >= 3:
        size = np.linalg.svd(own - own.mean(0), compute_uv=False)
        thick = float(size[-1] / max(size[0], 1e-12))
        flat = FLAT.level(thick) != "good"
        out.append(judged("depth_of_subject", thick, FLAT,
                          "the points lie in one plane: the photos show a wall or a picture" if flat else
                          "the points are not flat", "photograph a person or an object, from all around"))  # fmt: skip
    return out


def _seen(counts: Counts) -> list[Finding]:
    shares = {name: share_seen(counts, where) for name, where in parts().items()}
    hidden = [f"the {n} ({s:.0%} seen)" for n, s in shares.items() if s < HIDDEN and n != "underside"]
    all_round = share_seen(counts, around())
    unseen = f"; hardly visible in any photo: {', '.join(hidden)}" if hidden else ""
    return [
        judged("directions_seen", all_round, SEEN,
               f"photos cover {all_round:.0%} of the directions around the subject{unseen}", AROUND),
        judged("front_seen", shares["front"], FRONT_SEEN, f"photos cover {shares['front']:.0%} of the front",
               "photograph the face from both sides, in steps of 15 degrees; if the photos show the face already, the "
               "front was detected wrongly: take photos in which the face is clearly visible"),
    ]  # fmt: skip


def _spread(directions: F64) -> Finding:
    degrees = spread(directions)
    return judged("view_spread", degrees, SPREAD, f"the views are at most {degrees:.0f} degrees apart",
                  f"{AROUND}; photos from one side do not determine depth", unit="degrees")  # fmt: skip

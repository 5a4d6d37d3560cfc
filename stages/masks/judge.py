"""The checks of the masks: do they agree on one closed body of a head's size, and do the cameras see all of it?

Symbols: r radius of the region of interest. The visual hull is carved by the fitted views' masks and tolerates a few
wrong ones, as in hull_consistency.py. The limits come from measured captures: rigs and a person by hand all around
(good), a video of an arc in front of a face and a skull seen from three sides (usable).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pipeline.artifacts import Camera
from pipeline.directions import STEEP, elevations, grid
from pipeline.hull import Hull, cloud, render_silhouette, surface_points, visual_hull
from pipeline.transforms import F64, matrix
from pipeline.verdict import Finding, Limits, judged
from stages.masks.hull_consistency import CUBE, WRONG_SHARE, tolerated
from stages.masks.region import F32, region

CELLS = 48  # along each edge of the hull's cube: 5 mm for a head, .1 to .3 s
POOR = 0.85  # IoU with the hull below which wrong masks are searched; the worst mask of a good capture has .92
APART, SPREADS = 0.06, 4.0  # IoU and robust standard deviations below the median: correct masks differ by .03
MAX_NAMED = 8  # most photos excluded one by one, each with a hull of .1 to .3 s
SHOWS = 0.02, 0.9  # share of the photo: nearly empty, nearly full; heads have .28 to .67
NECK = -30.0  # degrees of elevation below which neck and shoulders begin
HEAD_LITRES, HEAD_SHARE = 5.5, 0.27  # inside r: measured 4.7 to 7.6 litres, .22 to .31 of the ball
SEEN_SQUARE = float(np.cos(np.radians(STEEP)))

AGREEMENT = Limits(0.93, 0.8)  # median IoU: .966 to .989
DISAGREEING = Limits(0.02, 0.25, lower=False)  # share of the fitted views
EMPTY_OR_FULL = Limits(0.02, 0.25, lower=False)  # share of the views
BOTH_WAYS = Limits(0.0, 0.25, lower=False)  # share of the given masks that are inverted relative to most
FACES = Limits(3.0, 0.0)  # fewest photos that agree on the face, for head and extent
GUESSED = Limits(0.0, 1.0, lower=False)  # share of the views
OPEN = Limits(0.06, 0.6, lower=False)  # 0 to .02 all around, .19 from three sides, .47 an arc in front of a face
SIZE = Limits(2.2, 6.0, lower=False)  # times: a child's head has half of an adult's
SIZE_NOMINAL = Limits(2.2, 3.3, lower=False)  # times: 3.7 fills the region of interest
UNSEEN = Limits(0.15, 0.9, lower=False)  # .0 to .11 all around, .17 from three sides, .88 an arc in front of a thing
# The head template cuts the hull of an arc in front of a face, and how much of a hull such photos leave unseen depends
# on their number: .87 with 87 of them, .97 with 22 of the same.
UNSEEN_HEAD = Limits(0.15, 1.0, lower=False)

ALL_AROUND = "photograph all around the subject, also from above, in steps of 15 degrees; or cut the missing sides off"


@dataclass(frozen=True, slots=True)
class Seen:
    """A view's mask. alpha: (h, w), small. iou: with the hull of the others. fitted: neither held out nor dropped."""

    name: str
    camera: Camera
    alpha: F32
    source: str
    coverage: float
    iou: float | None
    holdout: bool
    dropped: bool

    @property
    def fitted(self) -> bool:
        """Whether the fit uses it."""
        return not self.holdout and not self.dropped


def judge(
    views: Sequence[Seen], first: Sequence[Seen], roi_radius: float, metric: bool, faces: int
) -> tuple[Finding, ...]:  # fmt: skip
    """All findings of the masks. first: before any view was segmented again, because a mask from the others' hull hides
    that its photo shows something else. roi_radius: asset units. metric: asset units are metres. faces: number of
    photos with the subject's face."""
    out = [*_agreement(views, disagreeing(first, roi_radius)), _coverage(views), *_inverted(views), _guessed(views)]
    carving = [v for v in views if v.fitted]
    if not carving:
        return tuple(out)
    hull = _carved(carving, roi_radius, tolerated(len(carving)))
    return (*out, *hull_findings(hull, [v.camera for v in carving], roi_radius, metric, faces > 0))


def extent_finding(faces: int, agreeing: int, cut: bool) -> Finding | None:
    """The check of the extent, that is, the part of a person that the asset covers; None if no photo shows a face.

    faces, agreeing: fitted photos with a face, and those whose landmarks agree in 3D. cut: the subject continues beyond
    its extent."""
    if not faces:
        return None
    if agreeing:
        what = "the head, the neck and the upper shoulders" if cut else "everything that the masks show"
        message = f"{agreeing} photos agree on the position of the head; the asset covers {what}"
    else:
        message = (
            f"a face is found in {faces} photos, but they do not agree on its position; the asset covers everything "
            "that the masks show"
        )
    return judged("extent", agreeing, FACES, message,
                  "take evenly lit photos of the face from the front and both sides; check the cameras")  # fmt: skip


def hull_findings(
    hull: Hull, cameras: Sequence[Camera], roi_radius: float, metric: bool, face: bool
) -> tuple[Finding, Finding, Finding]:  # fmt: skip
    """The checks whether the hull is closed, of a head's size, and visible. metric: asset units are metres; face:
    photos show the subject's face, so that it is a head."""
    litres = metric and face
    opening = open_share(hull, roi_radius)
    volume = volume_within(hull, roi_radius)
    ball = 4 / 3 * np.pi * roi_radius**3
    share, head = volume / ball, HEAD_LITRES / 1e3 / ball if litres else HEAD_SHARE
    times = max(share, 1e-9) / head
    message = f"{1e3 * volume:.1f} litres" if litres else f"{share:.0%} of the region of interest"
    usual = f"{HEAD_LITRES:g} litres" if litres else f"{HEAD_SHARE:.0%}"
    hidden = unseen_share(hull, cameras, roi_radius)
    return (
        judged("hull_open", opening, OPEN,
               f"the visual hull of the masks covers {opening:.0%} of the edge of the region of interest",
               f"{ALL_AROUND}; check that the background is not part of the masks"),
        judged("hull_volume", max(times, 1 / times), SIZE if litres else SIZE_NOMINAL,
               f"the visual hull of the masks has {message}, a head about {usual}",
               "check the masks (is the background part of them, or is the subject cut off?) and the scale; "
               "photograph from more sides", unit="times"),
        judged("hull_unseen", hidden, UNSEEN_HEAD if face else UNSEEN,
               f"no camera sees {hidden:.0%} of the visual hull within {STEEP:.0f} degrees of its normal",
               ALL_AROUND),
    )  # fmt: skip


def open_share(hull: Hull, roi_radius: float) -> float:
    """Share of the edge of the region of interest, above the neck, that is inside the hull."""
    at = np.floor((grid() * roi_radius - hull.lo) / hull.cell).astype(np.intp).clip(0, np.array(hull.level.shape) - 1)
    inside = hull.level[at[..., 0], at[..., 1], at[..., 2]] <= 0
    weight = (np.cos(np.radians(elevations())) * (elevations() > NECK))[:, None] * np.ones(inside.shape)
    return float((weight * inside).sum() / weight.sum())


def volume_within(hull: Hull, roi_radius: float) -> float:
    """Volume of the hull in the region of interest, cubic asset units."""
    inside = hull.centres(hull.level <= 0)
    return float((np.linalg.norm(inside, axis=1) <= roi_radius).sum() * hull.cell**3)


def unseen_share(hull: Hull, cameras: Sequence[Camera], roi_radius: float) -> float:
    """Share of the hull's surface in the region of interest that no camera sees within STEEP of its normal; occlusion
    is ignored."""
    points = surface_points(hull)
    points = points[np.linalg.norm(points, axis=1) < roi_radius]
    if not len(points):
        return 1.0
    slope = np.stack(np.gradient(ndimage.gaussian_filter(hull.level, 1.0)), -1)  # outwards: level increases outwards
    at = np.floor((points - hull.lo) / hull.cell).astype(np.intp).clip(0, np.array(hull.level.shape) - 1)
    normals = slope[at[:, 0], at[:, 1], at[:, 2]].astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    best: F64 = np.full(len(points), -1.0)
    for camera in cameras:
        towards = matrix(camera.world_from_cam)[:3, 3] - points
        best = np.maximum(best, (towards * normals).sum(1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-12))
    return float((best < SEEN_SQUARE).mean())


def disagreeing(first: Sequence[Seen], roi_radius: float) -> list[str]:
    """Names of the voting views whose masks disagree with the rest, the worst first.

    Two wrong masks can carve the hull so that correct ones differ from it more than they do. So a hull that tolerates a
    tenth of wrong views is carved, the view that differs most is excluded, and so on until the rest agree.
    """
    left = [v for v in first if not v.holdout and v.iou is not None]
    lost = [v.name for v in first if not v.holdout and v.iou is None]
    if all((v.iou or 0.0) >= POOR for v in left):
        return lost
    out: list[str] = []
    for _ in range(MAX_NAMED):
        if len(left) < 3:
            break
        ious = _ious(left, _carved(left, roi_radius, max(1, round(WRONG_SHARE * len(left)))), roi_radius)
        median = float(np.median(ious))
        spread = 1.4826 * float(np.median(np.abs(ious - median)))
        worst = int(np.argmin(ious))
        if ious[worst] >= median - max(APART, SPREADS * spread):
            break
        out.append(left.pop(worst).name)
    if not out:  # no outlier: all views that agree poorly
        out = [v.name for v in sorted(left, key=lambda v: v.iou or 0.0) if (v.iou or 0.0) < POOR]
    return out + lost


def _carved(views: Sequence[Seen], roi_radius: float, lenient: int) -> Hull:
    edge = CUBE * roi_radius
    return visual_hull([v.camera for v in views], [v.alpha for v in views], [-edge] * 3, [edge] * 3, 2 * edge / CELLS,
                       min_views=min(3, len(views)), max_outside=lenient, outside_share=WRONG_SHARE)  # fmt: skip


def _ious(views: Sequence[Seen], hull: Hull, roi_radius: float) -> F64:
    """(N,) IoU of each mask with the hull's silhouette within the region of interest."""
    points = cloud(hull)
    out = []
    for v in views:
        h, w = v.alpha.shape
        disc = region(v.camera, roi_radius)
        here = np.ones((h, w), bool) if disc is None else disc.scaled(w / v.camera.width).covers(h, w)
        mask, shown = v.alpha >= 0.5, render_silhouette(points, v.camera, h, w) >= 0.5
        out.append((mask & shown & here).sum() / max(1, ((mask | shown) & here).sum()))
    return np.array(out, np.float64)


def _agreement(views: Sequence[Seen], wrong: Sequence[str]) -> tuple[Finding, Finding]:
    voting = [v for v in views if not v.holdout]
    known = [v.iou for v in voting if v.iou is not None]
    median = float(np.median(known)) if known else 0.0
    named = list(wrong) or [v.name for v in voting if v.dropped]
    return (
        judged("mask_agreement", median, AGREEMENT,
               f"the median IoU of a mask with the visual hull of all masks is {median:.0%}",
               "check the masks and the cameras: the subject must be the same, must not move, and must be white in "
               "every mask", views=named),
        judged("masks_disagreeing", len(named) / max(1, len(voting)), DISAGREEING,
               f"the masks of {len(named)} of {len(voting)} photos contradict the others",
               "check these photos and their masks for another subject, movement, missing parts or a wrong camera; "
               "correct or remove them", views=named),
    )  # fmt: skip


def _coverage(views: Sequence[Seen]) -> Finding:
    odd = sorted((v for v in views if not SHOWS[0] <= v.coverage <= SHOWS[1]), key=lambda v: v.coverage)
    return judged("masks_empty_or_full", len(odd) / max(1, len(views)), EMPTY_OR_FULL,
                  f"{len(odd)} of {len(views)} masks are nearly empty or nearly full",
                  "correct these masks, or remove them so that the photos are segmented; the subject's head must be "
                  "within the frame and at least a fifth of it", views=[v.name for v in odd])  # fmt: skip


def _inverted(views: Sequence[Seen]) -> list[Finding]:
    given = [v for v in views if v.source.startswith("given")]
    wrong = [v for v in given if v.source != "given"]
    if not given:
        return []
    rest = min(len(wrong), len(given) - len(wrong)) / len(given)
    limits = (
        BOTH_WAYS if rest or not wrong else Limits(-1.0, 1.0, lower=False)
    )  # all are inverted: corrected, with a message
    return [judged("masks_inverted", rest, limits,
                   f"{len(wrong)} of {len(given)} given masks are black on the subject and were inverted",
                   "save all masks white on the subject and black on the background",
                   views=[v.name for v in wrong])]  # fmt: skip


def _guessed(views: Sequence[Seen]) -> Finding:
    guessed = [v for v in views if v.source.startswith("grabcut")]
    return judged("masks_guessed", len(guessed) / max(1, len(views)), GUESSED,
                  f"{len(guessed)} of {len(views)} masks are from colours alone: neither a person nor a uniform "
                  "background was found" if guessed else "no mask is from colours alone",
                  "use a uniform background, or give masks")  # fmt: skip

"""The camera of a photo that hardly matches a model: a few first poses, refined and judged by all that the photo shows
(`agreement.py`)."""

from __future__ import annotations

from stages.poses.agreement import I64, Agreement, Judged, Points
from stages.poses.register import Lens, Registered, register

ACCEPTED, KEPT = 5.0, 3.0  # scores of `agreement` for a new photo, and for one that has a camera
LEAST = 25  # matched places of a new photo
FEW, SMALL_SHARE = 8, 0.05  # matches that fit a first pose, and their share
WITHIN = (12 / 856, 8 / 856, 6 / 856)  # of the longest edge: matches by which the pose is refined, and
REFINED_SHARE = 0.2  # the share of them that must fit it
SEEDS = 3  # first poses that are tried


def place(photo: Judged, points: Points, sightings: I64, lens: Lens, seed: int) -> Registered | None:
    """The camera of a photo in a model; None where none agrees with it. sightings: (L, 2) its features and the points
    that they may show."""
    best: tuple[Agreement, Registered] | None = None
    for n in range(SEEDS):
        first = _camera(photo, points, sightings, lens, seed + n, SMALL_SHARE)
        if first is None:
            continue
        refined = _refined(photo, points, first, lens, seed)
        found = points.agreement(photo, refined.pose)
        if best is None or found.score > best[0].score:
            best = found, refined
    if best is None or best[0].score < ACCEPTED or best[0].matches < LEAST:
        return None
    return best[1]


def _camera(photo: Judged, points: Points, matches: I64, lens: Lens, seed: int, share: float) -> Registered | None:
    return register(photo.uv(matches), points.model.points[matches[:, 1]], lens, photo.size, seed, FEW, share)


def _refined(photo: Judged, points: Points, first: Registered, lens: Lens, seed: int) -> Registered:
    """The camera by all matches around its pose, in narrowing windows."""
    best = first
    for within in WITHIN:
        matches = points.matches(photo, best.pose, within * max(photo.size))
        found = _camera(photo, points, matches, lens, seed, REFINED_SHARE)
        if found is None:
            break
        best = found
    return best

"""Fits the eyes of a registered head: ball to the surface between the lids, iris to the photos.

An eye whose iris the photos do not resolve, or whose lids are closed, stays the template's own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.eyes.ball import IRIS, RADIUS, SPREAD, Eye, sphere_on, turned
from pipeline.eyes.iris import LEAST_PIXELS, Iris, find_iris
from pipeline.eyes.picture import directions_at, photos_of, plane, shown_between_lids, sights
from pipeline.meshes import F64
from pipeline.registration.scan import Scan
from pipeline.visibility import FittedPhoto, Occluder

SIDE = 160  # pixels of the picture in which the iris is searched
REACH = 0.003  # metres: the surface further from the ball is none of the eye
ALIKE = 1e-5  # metres: by which the radii of a person's eyes differ
APART = np.radians(20.0)  # between the gazes of both eyes: more, and one of them is no iris
SIZES = 0.15  # largest relative difference of their irises


@dataclass(frozen=True, slots=True)
class FittedBall:
    """eye; off: median distance of the surface from the ball, metres; pixels across the iris; score and shown: of its
    edge; reason: why the eye stays the template's own, "" if it does not."""

    eye: Eye
    off: float
    pixels: float
    score: float
    shown: float
    reason: str


def fitted_eyes(
    balls: Mapping[str, F64], axes: F64, scan: Scan, views: Sequence[FittedPhoto], lids: Occluder, unit: float
) -> dict[str, FittedBall]:
    """By part. balls: the vertices (n, 3) of the template's eyes where the skin puts them; axes (3, 3): rows to the
    person's left, up, front; lids: the head without its eyes; unit: world units of one metre."""
    starts = {name: _start(ball, axes, unit, RADIUS * unit) for name, ball in balls.items()}
    photos = {name: photos_of(eye, views, lids, SIDE) for name, eye in starts.items()}
    first = {name: _ball(eye, scan, photos[name], lids, unit, SPREAD) for name, eye in starts.items()}
    radius = float(np.mean([eye.radius for eye, _ in first.values()])) if first else 0.0
    starts = {name: _start(ball, axes, unit, radius) for name, ball in balls.items()}
    same = {name: _ball(eye, scan, photos[name], lids, unit, ALIKE) for name, eye in starts.items()}
    return paired({name: _with_iris(eye, off, photos[name], lids, unit) for name, (eye, off) in same.items()})


def unseen_eye(ball: F64, axes: F64, unit: float, reason: str) -> FittedBall:
    """An eye that stays the template's own without a look at the photos: ball (n, 3) its vertices, axes as above."""
    middle = 0.5 * (ball.min(0) + ball.max(0))
    return FittedBall(Eye(middle, RADIUS * unit, axes, IRIS * unit), 0.0, 0.0, 0.0, 0.0, reason)


def paired(found: Mapping[str, FittedBall]) -> dict[str, FittedBall]:
    """Two eyes with an iris of the same size; both with a reason if they are no pair."""
    good = [f.eye for f in found.values() if not f.reason]
    if len(good) != 2:
        return dict(found)
    one, other = good
    apart = float(np.arccos(np.clip(one.axes[2] @ other.axes[2], -1, 1)))
    sizes = abs(one.iris - other.iris) / max(one.iris, other.iris)
    if apart > APART or sizes > SIZES:
        why = f"the two gazes are {np.degrees(apart):.0f} degrees apart, the irises differ by {sizes:.0%}"
        return {name: replace(f, reason=f.reason or why) for name, f in found.items()}
    iris = (one.iris + other.iris) / 2
    return {name: replace(f, eye=replace(f.eye, iris=iris)) for name, f in found.items()}


def _start(ball: F64, axes: F64, unit: float, radius: float) -> Eye:
    """An eye of this radius whose front is that of a ball (n, 3) where the skin puts it."""
    middle = 0.5 * (ball.min(0) + ball.max(0))
    own = float(np.linalg.norm(ball - middle, axis=1).mean())
    return Eye(middle + (own - radius) * axes[2], radius, axes, IRIS * unit)


def _ball(
    start: Eye, scan: Scan, views: Sequence[FittedPhoto], lids: Occluder, unit: float, spread: float
) -> tuple[Eye, float]:
    """The ball on the fitted surface where it is seen between the lids, and the surface's median distance from it.
    spread: deviation of its radius from that of the start, metres."""
    eye, off = start, 0.0
    for _ in range(2):
        directions = directions_at(plane(SIDE)[shown_between_lids(eye, views, lids, SIDE)])
        if not len(directions):
            break
        normals = directions @ eye.axes
        points = eye.points(directions)
        signed, weight = scan.along(points, normals, REACH * unit)
        use = np.isfinite(signed) & (weight > 0)
        there = points[use] + signed[use, None] * normals[use]
        centre, size = sphere_on(there, weight[use], start.centre, start.radius, unit, spread)
        eye = replace(eye, centre=centre, radius=size)
        away = np.abs(np.linalg.norm(there - centre, axis=1) - size)
        off = float(np.median(away)) if len(away) else 0.0
    return eye, off


def _with_iris(eye: Eye, off: float, views: Sequence[FittedPhoto], lids: Occluder, unit: float) -> FittedBall:
    seen = sights(eye, views, lids, SIDE)
    iris = find_iris(*seen.combined(), float(np.arcsin(IRIS * unit / eye.radius)))
    found = replace(eye, axes=turned(eye.axes, iris.gaze @ eye.axes), iris=eye.radius * float(np.sin(iris.angle)))
    pixels = 2 * found.iris * float(np.median(seen.pixels)) if len(seen.pixels) else 0.0
    return FittedBall(found, off, pixels, iris.score, iris.shown, _why_not(pixels, iris))


def _why_not(pixels: float, iris: Iris) -> str:
    """Why the iris is not known; "" if it is."""
    if pixels < LEAST_PIXELS:
        return f"the iris is {pixels:.2g} pixels across, fewer than {LEAST_PIXELS:g}"
    if not iris.found:
        return f"no edge of an iris: score {iris.score:.2g}, {iris.shown:.0%} of the circle seen"
    return ""

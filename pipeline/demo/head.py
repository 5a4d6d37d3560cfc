"""The demo head: smooth ellipsoids and tubes, combined as a signed distance.

World frame: metres, right-handed, +Y up, +Z out of the face, +X to the head's left; the origin lies
between the eyes' height and the middle of the skull. Inside, shapes are written in millimetres.
The distance is negative inside, exact on the surface to first order, and its gradient norm is near one.

    f(p) = (((skull + face + neck) - sockets + lids + nose + lips ...) + ears) and above the neck's cut

Paired parts are built once on the folded coordinate |x|, so that the head is exactly symmetric.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from pipeline.demo.shapes import (
    F64,
    Distance,
    Frame,
    arched,
    ellipsoid,
    half_space,
    mirrored,
    plain,
    rotation,
    smooth_common,
    smooth_cut,
    smooth_union,
    spline,
    tube,
    turned,
    wrapped,
)
from pipeline.threads import side_by_side

BOUNDS: F64 = np.array([[-0.1043, -0.1807, -0.1249], [0.1057, 0.1349, 0.1353]])
"""Corners (2, 3) of a box that holds the whole head, metres; odd, so that no grid node meets a flat face."""

NECK_CUT = -0.168
"""Height of the plane that ends the neck, metres."""

_MM = 1000.0
_FOLD_MM = 1.0
_WIDEST_JOINT = 17.0  # of the joints made inside _within
_EYES = (31.0, 0.0, 80.0, 38.0)  # balls x, y, z, radius that hold the features of the face, millimetres
_MOUTH = (12.0, -72.0, 90.0, 42.0)
_NOSE = (6.0, -20.0, 94.0, 48.0)
_EARS = (78.0, -20.0, -15.0, 48.0)
_LID = (32.0, -2.0, 64.0)  # centre and radii of the closed lids
_LID_RADII = (17.0, 14.0, 14.0)
# Curves of the ear, in its own frame: x, y, z and the tube's radius.
_HELIX = spline(
    [
        (9, -2, 0.5, 2.2),
        (12, 12, 0, 2.5),
        (8, 26, 0.8, 2.7),
        (-4, 30, 1.6, 2.7),
        (-14, 20, 2.2, 2.7),
        (-15.6, 4, 2.2, 2.7),
        (-12, -12, 1.8, 2.8),
        (-3, -24, 0.5, 3.2),
    ],
    5,
)
_ANTIHELIX = spline(
    [(2, 22, 1.4, 1.4), (-6, 14, 2.0, 2.0), (-8.6, 2, 2.2, 2.0), (-6, -11, 2.2, 2.0), (1, -18, 1.6, 1.8)], 5
)
_CHEEK_FOLD = spline([(17, -40, 96), (25, -54, 94), (32, -70, 84)], 6)
_ARCH_AXIS = 56.0  # the arch of the teeth: z of its axis, and its radius
_ARCH_RADIUS = 38.0
_BLOCK = 4096  # points at a time: the temporaries then stay in the processor's cache


def signed_distance(points: F64) -> F64:
    """Signed distance (N,) in metres at `points` (N, 3)."""
    p = np.ascontiguousarray(points.T) * _MM
    blocks = list(side_by_side(
        lambda i: _sculpture(p[:, i : i + _BLOCK], False).value, range(0, p.shape[1], _BLOCK)
    ))  # fmt: skip
    return np.concatenate(blocks) / _MM if blocks else np.zeros(0)


def distance_and_gradient(points: F64) -> tuple[F64, F64]:
    """Signed distance (N,) in metres and its exact gradient (N, 3), dimensionless, at `points` (N, 3)."""
    p = np.ascontiguousarray(points.T) * _MM
    value = np.empty(p.shape[1])
    gradient = np.empty(p.shape)
    for i in range(0, p.shape[1], _BLOCK):
        block = _sculpture(p[:, i : i + _BLOCK], True)
        assert block.gradient is not None
        value[i : i + _BLOCK] = block.value / _MM
        gradient[:, i : i + _BLOCK] = block.gradient
    return value, np.ascontiguousarray(gradient.T)


def _sculpture(points: F64, with_gradient: bool) -> Distance:
    """The whole head at `points` (3, N), millimetres."""
    middle = plain(points, with_gradient)
    pair = mirrored(middle, _FOLD_MM)
    head = smooth_union(_skull(middle, pair), _neck(middle, pair), 28.0)
    head = _within(_EYES, head, points, with_gradient, _eyes)
    head = _within(_MOUTH, head, points, with_gradient, _mouth)
    head = _within(_NOSE, head, points, with_gradient, _nose)
    head = _within(_EARS, head, points, with_gradient, _ears)
    return smooth_common(head, half_space(middle, (0.0, -1.0, 0.0), -NECK_CUT * _MM), 5.0)


def _within(
    ball: tuple[float, float, float, float],
    head: Distance,
    points: F64,
    with_gradient: bool,
    sculpt: Callable[[Distance, Frame, Frame], Distance],
) -> Distance:
    """Apply `sculpt` only to the points that it can change.

    `ball` is x, y, z, radius, and holds the added or removed shapes. A joint of width k acts only where a
    shape is within k of the head's surface, so outside the ball by more than |head| + k nothing happens.
    """
    x, y, z, radius = ball
    away = np.sqrt((np.abs(points[0]) - x) ** 2 + (points[1] - y) ** 2 + (points[2] - z) ** 2)
    touched = np.flatnonzero(away - radius < np.abs(head.value) + _WIDEST_JOINT)
    if touched.size == 0:
        return head
    middle = plain(points[:, touched], with_gradient)
    old = head.gradient
    part = Distance(head.value[touched], None if old is None else old[:, touched])
    part = sculpt(part, middle, mirrored(middle, _FOLD_MM))
    head.value[touched] = part.value
    if old is not None and part.gradient is not None:
        old[:, touched] = part.gradient
    return head


def _skull(middle: Frame, pair: Frame) -> Distance:
    """Cranium, forehead, brows, cheekbones, jaw and chin."""
    s = ellipsoid(middle, (0, 34, -10), (75, 80, 93))
    s = smooth_union(s, ellipsoid(middle, (0, 40, 26), (61, 50, 61)), 30.0)
    s = smooth_union(s, ellipsoid(middle, (0, -14, 4), (65, 52, 66)), 30.0)
    s = smooth_union(s, ellipsoid(middle, (0, -42, 30), (52, 68, 56)), 30.0)
    s = smooth_union(s, ellipsoid(_along(pair, (46, -20, 50), yaw=0.95), (0, 0, 0), (25, 12, 11)), 30.0)
    s = smooth_union(s, ellipsoid(pair, (40, -52, 38), (20, 32, 28)), 26.0)
    s = smooth_union(s, _jaw(pair), 30.0)
    s = smooth_union(s, ellipsoid(middle, (0, -97, 73), (18, 14, 16)), 20.0)
    s = smooth_union(s, ellipsoid(middle, (0, -62, 63), (34, 29, 31)), 24.0)
    brow = ellipsoid(_along(pair, (21, 19, 79), yaw=0.25, roll=0.14), (0, 0, 0), (19, 6.5, 8))
    s = smooth_union(s, brow, 18.0)
    outer_brow = ellipsoid(_along(pair, (45, 17, 65), yaw=0.85, roll=-0.18), (0, 0, 0), (16, 7, 8))
    s = smooth_union(s, outer_brow, 18.0)
    # The temples are shallow bowls.
    return smooth_cut(s, ellipsoid(pair, (92, 24, 46), (22, 24, 24)), 22.0)


def _jaw(pair: Frame) -> Distance:
    ramus = tube(pair, [(49, -25, 4), (44, -66, 14)], (12, 13))
    body = tube(pair, [(44, -66, 14), (12, -98, 66)], (13, 12.5))
    return smooth_union(ramus, body, 16.0)


def _along(frame: Frame, centre: tuple[float, float, float], yaw: float, roll: float = 0.0) -> Frame:
    """Frame at `centre` whose x axis points sideways, turned back by `yaw` and up by `roll`."""
    return turned(frame, centre, rotation(yaw=yaw, roll=roll).T)


def _neck(middle: Frame, pair: Frame) -> Distance:
    """Neck with its two oblique muscles, the throat and a hint of the trapezius."""
    n = tube(middle, [(0, -40, -30), (0, -230, -36)], (50, 55))
    muscle = tube(pair, [(52, -50, -24), (12, -190, 32)], (9, 9))
    n = smooth_union(n, muscle, 24.0)
    throat = tube(middle, [(0, -90, 20), (0, -200, 14)], (12, 14))
    n = smooth_union(n, throat, 24.0)
    slope = tube(pair, [(20, -60, -54), (58, -215, -50)], (14, 20))
    n = smooth_union(n, slope, 30.0)
    return smooth_union(n, ellipsoid(middle, (0, -132, 29), (8, 12, 8)), 16.0)


def _eyes(head: Distance, middle: Frame, pair: Frame) -> Distance:
    """Sockets, and closed lids over the eyeballs with the lid line and the upper crease."""
    head = smooth_cut(head, ellipsoid(pair, (31, 1, 97), (20, 12, 18)), 17.0)
    head = smooth_cut(head, ellipsoid(pair, (15, 2, 93), (6, 9, 10)), 10.0)
    head = smooth_union(head, ellipsoid(pair, _LID, _LID_RADII), 13.0)
    edge, crease = _lid_curves()
    head = smooth_cut(head, tube(pair, edge, (0.7,) * len(edge)), 2.4)
    return smooth_cut(head, tube(pair, crease, (0.7,) * len(crease)), 4.5)


@cache
def _lid_curves() -> tuple[list[list[float]], list[list[float]]]:
    """The edge of the closed upper lid, and the crease above it."""
    edge = [(x, float(lid_line(np.asarray(x))[0])) for x in (17.0, 24.5, 32.0, 39.5, 47.0)]
    crease = [(20.0, 2.5), (25.0, 5.0), (32.0, 6.0), (40.0, 4.6), (46.0, 0.5)]
    return _on_lid(edge, 1.3), _on_lid(crease, 1.6)


def _on_lid(curve: list[tuple[float, float]], above: float) -> list[list[float]]:
    """Curve (x, y) laid onto the lid's ellipsoid, `above` millimetres in front of it, finely divided."""
    rows = []
    for x, y in spline(curve, 5):
        rest = 1.0 - ((x - _LID[0]) / _LID_RADII[0]) ** 2 - ((y - _LID[1]) / _LID_RADII[1]) ** 2
        rows.append([x, y, _LID[2] + _LID_RADII[2] * float(np.sqrt(max(rest, 0.04))) + above])
    return rows


def _nose(head: Distance, middle: Frame, pair: Frame) -> Distance:
    """Bridge, tip, wings, septum and nostrils."""
    head = smooth_union(head, tube(middle, [(0, 12, 76), (0, -32, 93)], (8, 13)), 12.0)
    head = smooth_union(head, tube(middle, [(0, 4, 85), (0, -34, 104)], (4.5, 6)), 12.0)
    head = smooth_union(head, ellipsoid(middle, (0, -36.5, 105), (10, 8.2, 9.6)), 11.0)
    wing = ellipsoid(turned(pair, (12, -40, 95), rotation(yaw=-0.35)), (0, 0, 0), (5.8, 7, 11))
    head = smooth_union(head, wing, 7.0)
    head = smooth_union(head, tube(middle, [(0, -42, 105), (0, -47, 94)], (4.6, 4.8)), 6.0)
    nostril = ellipsoid(turned(pair, (7.0, -46.5, 99), rotation(yaw=-0.4)), (0, 0, 0), (3.0, 4.6, 6.2))
    return smooth_cut(head, nostril, 3.0)


def _mouth(head: Distance, middle: Frame, pair: Frame) -> Distance:
    """Philtrum, lips with their line, the groove above the chin and the folds beside the mouth.

    The lips are written on the unrolled arch of the teeth: x along the arch, z above it.
    """
    arch, arch_pair = (wrapped(f, _ARCH_AXIS, _ARCH_RADIUS) for f in (middle, pair))
    head = smooth_cut(head, ellipsoid(arch, (0, -85.5, 10), (20, 5, 11)), 10.0)
    fold = tube(pair, _CHEEK_FOLD, (1.2,) * len(_CHEEK_FOLD))
    head = smooth_cut(head, fold, 8.0)
    head = smooth_cut(head, ellipsoid(arch, (0, -54, 4.6), (3.2, 9.5, 4.4)), 4.5)
    upper = arched(arch_pair, -0.004)
    head = smooth_union(head, ellipsoid(upper, (8, -65.2, -2.0), (18.5, 4.0, 4.4)), 7.0)
    head = smooth_union(head, ellipsoid(arch, (0, -66.2, -1.0), (7, 3.6, 4.8)), 5.0)
    lower = arched(arch, 0.003)
    head = smooth_union(head, ellipsoid(lower, (0, -73.2, -2.6), (21, 4.6, 5.8)), 7.5)
    line = arched(arch, -0.002)
    head = smooth_cut(head, tube(line, [(-25, -69.2, 1.6), (25, -69.2, 1.6)], (1.0, 1.0)), 3.0)
    return smooth_cut(head, ellipsoid(arch_pair, (28, -71, 2.0), (3, 3, 3)), 5.0)


def _ears(head: Distance, middle: Frame, pair: Frame) -> Distance:
    """Auricles: a dished plate with helix, antihelix, tragus and lobe, in a frame of their own.

    Ear frame: +x towards the face, +y up, +z away from the head.
    """
    to_ear = rotation(pitch=0.0, roll=-0.22) @ _ear_axes(flare=0.38)
    ear = turned(pair, (74, -20, -14), to_ear)
    plate = ellipsoid(ear, (0, 0, 0), (17, 30, 4.6))
    # The root fills the gap behind the bowl, so that the ear encloses no tunnel.
    plate = smooth_union(plate, ellipsoid(ear, (2, -2, -8), (9, 17, 10)), 5.0)
    plate = smooth_union(plate, _curve(ear, _HELIX), 3.0)
    plate = smooth_union(plate, ellipsoid(ear, (1, -27, 0.5), (7.5, 8.5, 3.6)), 4.0)
    plate = smooth_cut(plate, ellipsoid(ear, (-1, 1, 6.8), (11.5, 23, 5.0)), 3.0)
    plate = smooth_cut(plate, ellipsoid(ear, (3, -6, 4), (8, 10.5, 6.5)), 3.0)
    plate = smooth_union(plate, _curve(ear, _ANTIHELIX), 3.0)
    plate = smooth_union(plate, ellipsoid(ear, (10.5, -7, 2.0), (3.4, 5.5, 3.4)), 3.0)
    return smooth_union(head, plate, 6.0)


def _curve(frame: Frame, curve: list[list[float]]) -> Distance:
    """Tube along rows of x, y, z, radius."""
    return tube(frame, [row[:3] for row in curve], [row[3] for row in curve])


def _ear_axes(flare: float) -> F64:
    """Orthogonal (3, 3) to the ear frame from the folded frame: x from +Z, y from +Y, z from +X, flared."""
    axes = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    # The plate turns about the vertical so that its rear edge stands away from the skull.
    c, s = np.cos(flare), np.sin(flare)
    turn = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    return np.asarray(turn @ axes)


def mouth_coordinates(points: F64) -> tuple[F64, F64, F64]:
    """Arc length along the teeth, height, and distance before the arch, (N,) each, millimetres.

    `points` (N, 3) metres; the domain excludes the arch's axis.
    """
    arch = wrapped(plain(np.ascontiguousarray(points.T) * _MM, False), _ARCH_AXIS, _ARCH_RADIUS).points
    return arch[0], arch[1], arch[2]


def lip_borders(along: F64) -> tuple[F64, F64]:
    """Heights of the upper and the lower border of the lips' red at arc length `along`, millimetres."""
    x = np.abs(along)
    bow = 1.1 * np.exp(-((x / 3.0) ** 2))
    upper = -66.2 + 4.0 * np.sqrt(np.maximum(1.0 - ((x - 6.0) / 22.0) ** 2, 0.0)) - 0.004 * x * x - bow
    lower = -72.3 - 4.7 * np.sqrt(np.maximum(1.0 - (x / 27.0) ** 2, 0.0)) + 0.003 * x * x
    return upper, lower


def lid_line(side: F64) -> tuple[F64, float]:
    """Height of the closed lid's edge at |x| = `side`, and half its length about |x| = 32; millimetres."""
    return -9.4 + 0.0235 * (side - 32.0) ** 2, 15.0

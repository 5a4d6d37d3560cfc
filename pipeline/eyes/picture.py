"""The front of an eyeball as a picture, from the photos.

The picture is azimuthal equidistant: a place at angle t from the gaze, in direction (x, y) to the person's left and up,
is t (x, y). Each photo that sees a place between the lids gives a colour there; with a low quantile over the photos the
lamps' reflections, which move over a wet eye from photo to photo, drop out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.eyes.ball import Eye
from pipeline.images import read_linear
from pipeline.meshes import F32, F64, Mask
from pipeline.transforms import inverse_rigid, matrix
from pipeline.visibility import FittedPhoto, Occluder, view_cosines

REACH = 1.2  # radians from the gaze to the picture's border
PHOTOS = 24  # the best ones are read
BORDER = 0.0006  # metres: what the lids show less than this is the lids' own edge, or blurred with it
QUANTILE = 0.35
LEAST_COSINE = 0.3
FRONTAL = 0.45  # radians around the gaze in which photos are compared


@dataclass(frozen=True, slots=True)
class Sights:
    """What photos show of an eye: colour (n, side^2, 3) linear, weight (n, side^2) 0 where one does not show it, pixels
    (n,) of each photo per metre; views (n,): rows of the photos."""

    colour: F32
    weight: F32
    pixels: F64
    views: tuple[int, ...]
    side: int

    def shown(self) -> Mask:
        """(side, side) whether any photo shows it."""
        return np.asarray((self.weight > 0).any(0).reshape(self.side, self.side))

    def combined(self) -> tuple[F32, F32]:
        """(side, side, 3) colours, 0 where nothing is seen, and (side, side) sums of the weights."""
        colour = quantile(self.colour, self.weight, QUANTILE)
        total = self.weight.sum(0)
        return colour.reshape(self.side, self.side, 3), total.reshape(self.side, self.side)


def plane(side: int) -> F64:
    """(side, side, 2) places of a picture's pixels, radians; row 0 on top."""
    at = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(at, -at)
    return np.asarray(REACH * np.stack([x, y], -1))


def directions_at(places: F64) -> F64:
    """(..., 3) unit directions of places (..., 2)."""
    t = np.linalg.norm(places, axis=-1, keepdims=True)
    return np.concatenate([np.sinc(t / np.pi) * places, np.cos(t)], -1)


def places_of(directions: F64) -> F64:
    """(..., 2) places of unit directions (..., 3). Domain: not opposite to the gaze."""
    across = directions[..., :2]
    t = np.arctan2(np.linalg.norm(across, axis=-1), directions[..., 2])[..., None]
    return np.asarray(across / np.maximum(np.sinc(t / np.pi), 1e-9))


def looked_up(image: F32, places: F64) -> F32:
    """(N, C) values of a picture (side, side, C) at places (N, 2), bilinear; beyond its border those at the border."""
    side = len(image)
    column = ((places[:, 0] / REACH + 1) * side / 2 - 0.5).clip(0, side - 1)
    row = ((1 - places[:, 1] / REACH) * side / 2 - 0.5).clip(0, side - 1)
    left, top = (np.minimum(v.astype(np.int64), side - 2) for v in (column, row))
    x, y = ((v - low)[:, None].astype(np.float32) for v, low in ((column, left), (row, top)))
    upper = image[top, left] * (1 - x) + image[top, left + 1] * x
    lower = image[top + 1, left] * (1 - x) + image[top + 1, left + 1] * x
    return np.asarray(upper * (1 - y) + lower * y, np.float32)


@dataclass(frozen=True, slots=True)
class _Sight:
    """A photo that shows an eye: its row, how well (score), cosines (side^2,), pixels (side^2, 2), and pixels per
    metre."""

    row: int
    score: float
    cosine: F64
    uv: F64
    fine: float


def shown_between_lids(eye: Eye, views: Sequence[FittedPhoto], lids: Occluder, side: int) -> Mask:
    """(side, side) what the photos that `sights` reads show of the eye; without reading them."""
    best = _best_sights(eye, views, lids, side)
    return np.asarray(np.any([s.cosine > 0 for s in best] or [np.zeros(side * side, bool)], 0).reshape(side, side))


def photos_of(eye: Eye, views: Sequence[FittedPhoto], lids: Occluder, side: int) -> tuple[FittedPhoto, ...]:
    """The photos that show the eye best; for an eye that is moved a little afterwards, only these need to be asked."""
    return tuple(views[s.row] for s in _best_sights(eye, views, lids, side))


def sights(eye: Eye, views: Sequence[FittedPhoto], lids: Occluder, side: int) -> Sights:
    """What the photos show of the eye between the lids (a mesh without the eye)."""
    best = _best_sights(eye, views, lids, side)
    colours, weights = [], []
    most = max((s.fine for s in best), default=1.0)
    for s in best:
        photo = views[s.row].photo
        assert photo is not None
        image = np.asarray(read_linear(photo)[..., :3], np.float32)
        camera = views[s.row].camera
        scale = np.array([image.shape[1] / camera.width, image.shape[0] / camera.height])
        at = np.nan_to_num(s.uv * scale - 0.5).astype(np.float32).reshape(side, side, 2)
        colours.append(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR).reshape(-1, 3))
        weights.append((s.cosine * s.fine / most) ** 2)
    shape = (len(best), side * side)
    return Sights(
        np.asarray(colours, np.float32).reshape(*shape, 3), np.asarray(weights, np.float32).reshape(shape),
        np.array([s.fine for s in best]), tuple(s.row for s in best), side,
    )  # fmt: skip


def _best_sights(eye: Eye, views: Sequence[FittedPhoto], lids: Occluder, side: int) -> list[_Sight]:
    """The photos that show the eye best."""
    directions = directions_at(plane(side).reshape(-1, 2))
    points, normals = eye.points(directions), directions @ eye.axes
    front = directions[:, 2] > np.cos(FRONTAL)
    border = np.ones((1 + 2 * round(BORDER / eye.radius / (2 * REACH / side)),) * 2, np.uint8)
    found = []
    for i, view in enumerate(views):
        if view.photo is None:
            continue
        cosine, uv = view_cosines(view, points, normals, lids)
        open_ = cv2.erode((cosine > 0).astype(np.uint8).reshape(side, side), border).ravel() > 0
        cosine = np.where(open_ & (cosine > LEAST_COSINE), cosine, 0.0)
        fine = resolution(view, eye)
        if cosine.any():
            found.append(_Sight(i, float(cosine[front].sum()) * fine, cosine, uv, fine))
    return sorted(found, key=lambda f: (-f.score, f.row))[:PHOTOS]


def resolution(view: FittedPhoto, eye: Eye) -> float:
    """Pixels of a photo per metre at the eye."""
    camera_from_world = inverse_rigid(matrix(view.camera.world_from_cam))
    depth = float(camera_from_world[2, :3] @ eye.centre + camera_from_world[2, 3])
    K = matrix(view.camera.K)
    return float(np.sqrt(K[0, 0] * K[1, 1])) / max(depth, 1e-9)


def quantile(values: F32, weights: F32, share: float) -> F32:
    """(N, C) the weighted quantile over the first axis of values (n, N, C) with weights (n, N), channel by channel; 0
    without weight."""
    if not len(values):
        return np.zeros(values.shape[1:], np.float32)
    out = np.zeros(values.shape[1:], np.float32)
    for channel in range(values.shape[2]):
        order = np.argsort(values[..., channel], axis=0, kind="stable")
        w = np.take_along_axis(weights, order, 0)
        reached = np.cumsum(w, axis=0) >= share * w.sum(0)
        row = np.take_along_axis(order, reached.argmax(0)[None], 0)
        out[:, channel] = np.take_along_axis(values[..., channel], row, 0)[0]
    return np.where(weights.sum(0)[:, None] > 0, out, 0).astype(np.float32)

"""What the photos show behind the subject, as a lat-long picture of radiance.

The fit knows the light by what it does to the subject, and that is smooth. Behind the subject the photos show it
directly: the dark wall beside a cheek, a window. Only directions count, as if all of it were far away. At the subject's
outline that is right however near a wall is: a ray that grazes the surface goes on to the place that the pixel beside
the outline shows, and surfaces reflect most of what grazes them.

Each photo is looked up in every direction of the picture. Several photos that show background there: their median.
Gaps of a few degrees, where the subject or the frame is in the way, continue the nearest directions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.artifacts import FittedFace, Located
from pipeline.camera import PinholeCamera
from pipeline.colour import srgb_from_linear
from pipeline.maths.latlong import latlong_directions, latlong_weights
from pipeline.maths.smoothstep import smoothstep

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.int64]

WIDTH = 256  # columns of the picture: 1.4 degrees
BACKGROUND = 0.02  # largest alpha of a pixel of the background
AWAY = 0.01  # of a photo's longest edge: pixels nearer to the subject are mixed with it
AHEAD = 0.2  # least cosine between a direction and the camera's axis
NEAREST = 8  # directions that a gap continues
REACH = np.radians(4.0), np.radians(10.0)  # from what photos show: nearer is known, farther is not
CLIPPED = 0.5  # share of a pixel, and of the photos that show a direction
ONE_COLOUR = 0.9  # share of a background's pixels of the same 8-bit colour, from which it was painted
FEWEST, SPREAD = 3, 0.5  # photos that can contradict each other; mean deviation of the logarithm of what they show
LEAST = 0.005  # of all directions: less says nothing


@dataclass(frozen=True, slots=True)
class Surroundings:
    """radiance (H, W, 3) linear, in the units of the fitted light; where photos show nothing, that of the nearest
    directions. away (H, W): radians to the nearest direction that a photo shows. clipped (H, W): 1 where photos are
    clipped, so that the light is no darker than `radiance`. facing (H, W): mean over the photos of max(n . v, 0), how
    well they see a surface with the normal n of this place of the picture."""

    radiance: F32
    away: F32
    clipped: F32
    facing: F32

    @property
    def share(self) -> F32:
        """(H, W) 1 where the radiance is known, 0 where it is not."""
        near = 1 - smoothstep(self.away.astype(np.float64), *REACH)
        return np.asarray(near * (1 - self.clipped), np.float32)

    def facts(self) -> dict[str, float]:
        """For the report: shares of all directions that are known, and that are clipped."""
        weights = latlong_weights(self.away.shape[1], len(self.away)) / (4 * np.pi)
        parts = {"known": self.share, "clipped": self.clipped}
        return {k: round(float((x * weights).sum()), 4) for k, x in parts.items()}

    def save(self, path: Path) -> None:
        """Write the arrays as an npz file."""
        np.savez_compressed(path, radiance=self.radiance, away=self.away, clipped=self.clipped, facing=self.facing)

    @classmethod
    def load(cls, path: Path) -> Surroundings:
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            return cls(stored["radiance"], stored["away"], stored["clipped"], stored["facing"])


@dataclass(frozen=True, slots=True)
class Backdrop:
    """A photo's part: rgb (H, W, 3) linear, alpha (H, W) of the subject, clipped (H, W) share of each pixel or None,
    the camera, and response (3, 3) from the fit's colours to the photo's."""

    rgb: F32
    alpha: F32
    clipped: F32 | None
    K: F64
    world_from_cam: F64
    distortion: F64
    response: F64


def surroundings(photos: Iterable[Backdrop], width: int = WIDTH) -> Surroundings | None:
    """What photos show around the subject; None where that is next to nothing, where their backgrounds were painted,
    or where they contradict each other."""
    directions = latlong_directions(width, width // 2).reshape(-1, 3)
    colours, clipped, towards = [], [], []
    for photo in photos:
        towards.append(-photo.world_from_cam[:3, 2])
        found = _looked_up(photo, directions)
        if found is not None:
            colours.append(found[0])
            clipped.append(found[1])
    if not colours:
        return None
    every, bright = np.stack(colours), np.stack(clipped)
    times = np.isfinite(every[..., 0]).sum(0)
    seen = np.flatnonzero(times)
    solid = np.broadcast_to(latlong_weights(width, width // 2) / (4 * np.pi), (width // 2, width)).ravel()
    if solid[seen].sum() < LEAST or _contradict(every[:, times >= FEWEST]):
        return None
    median = np.nanmedian(every[:, seen], 0)
    radiance, away, open_ = _continued(directions, seen, median, bright[:, seen].sum(0) > CLIPPED * times[seen])
    facing = (directions @ np.array(towards).T).clip(min=0).mean(1)
    shape = width // 2, width
    return Surroundings(
        radiance.reshape(*shape, 3).astype(np.float32),
        away.reshape(shape).astype(np.float32),
        open_.reshape(shape).astype(np.float32),
        facing.reshape(shape).astype(np.float32),
    )


def _looked_up(photo: Backdrop, directions: F64) -> tuple[F32, Bool] | None:
    """(N, 3) the photo's radiance in directions (N, 3), NaN where it shows no background, and (N,) whether it is
    clipped there; None if its background was painted."""
    height, width = photo.alpha.shape
    step = max(1, round(AWAY * max(height, width)))
    near = cv2.dilate((photo.alpha > BACKGROUND).astype(np.uint8), np.ones((2 * step + 1,) * 2, np.uint8)) > 0
    if near.all() or _painted(photo.rgb[~near]):
        return None
    turn = np.eye(4)
    turn[:3, :3] = photo.world_from_cam[:3, :3]  # what is far away does not depend on the camera's place
    pixel, shown = PinholeCamera(photo.K, turn, width, height, photo.distortion).pixels(directions)
    shown &= directions @ turn[:3, 2] > AHEAD
    shown[shown] = ~near[pixel[shown, 1], pixel[shown, 0]]
    ahead = np.flatnonzero(shown)
    column, row = pixel[ahead].T
    mean = _mean_around(photo.rgb, ~near, step)
    out, bright = np.full((len(directions), 3), np.nan, np.float32), np.zeros(len(directions), np.bool_)
    out[ahead] = (mean[row, column] @ np.linalg.inv(photo.response).T).clip(min=0)
    if photo.clipped is not None:
        bright[ahead] = photo.clipped[row, column] > CLIPPED
    return out, bright


def _painted(pixels: F32) -> bool:
    """Whether the background (N, 3) has one colour: one that was cut off. A photo is never without noise."""
    levels = np.round(255 * np.asarray(srgb_from_linear(pixels.clip(0, 1)))).astype(np.int64)
    return bool(np.unique(levels @ (65536, 256, 1), return_counts=True)[1].max() >= ONE_COLOUR * len(levels))


def _mean_around(rgb: F32, where: Bool, step: int) -> F32:
    """(H, W, 3) mean of the pixels `where` (H, W) around each pixel, nearer than `step`: a pixel of the picture is
    larger than one of the photo."""
    size, part = (2 * step - 1,) * 2, where.astype(np.float32)
    total = cv2.blur(rgb * part[..., None], size)
    return np.asarray(total / np.maximum(cv2.blur(part, size), 1e-6)[..., None], np.float32)


def _contradict(shown: F32) -> bool:
    """Whether photos show different things in the same directions: shown (photos, N, 3), NaN where nothing. So it is
    where the camera stood still and the subject turned."""
    if shown.shape[1] == 0:
        return False
    level = np.log(shown.mean(-1) + 1e-3)
    spread = float(np.median(np.nanmean(np.abs(level - np.nanmedian(level, 0)), 0)))
    return spread > SPREAD


def _continued(directions: F64, seen: Indices, colour: F32, bright: Bool) -> tuple[F64, F64, Bool]:
    """Radiance (N, 3), radians to the nearest seen direction (N,), and whether that is clipped and near (N,), in all
    directions (N, 3). seen (M,): those with a colour (M, 3) and bright (M,)."""
    count = min(NEAREST, len(seen))
    chord, which = (x.reshape(len(directions), count) for x in cKDTree(directions[seen]).query(directions, count))
    weight = 1 / (chord + 1e-3) ** 2
    weight /= weight.sum(1, keepdims=True)
    away = 2 * np.arcsin(np.minimum(chord[:, 0] / 2, 1))
    clipped = ((weight * bright[which]).sum(1) > CLIPPED) & (away < sum(REACH) / 2)
    return (weight[..., None] * colour[which]).sum(1), away, clipped


def surroundings_of(face: Located[FittedFace]) -> Surroundings | None:
    """What the photos of a fit show around its subject, if that tells something of the light."""
    ref = face.artifact.surroundings
    return None if ref is None else Surroundings.load(face.path(ref))

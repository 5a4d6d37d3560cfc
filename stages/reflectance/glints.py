"""Pictures of a field's glints: reflections of lamps on its corneas (pipeline/eyes/mirror.py), spread over pixels as by
optics.

How much of a lamp's light arrives at a cornea is what arrives at the field's texels beside the reflection. A mirror of
radius R turns by a / 2 for a lamp that is a radians aside, so that a lamp of that spread is R a / 2 wide on it.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from pipeline.camera import PinholeCamera
from pipeline.eyes.mirror import intensity, reflected, summed
from pipeline.images import F32
from pipeline.meshes import unit
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, inverse_rigid, project
from stages.reflectance.field import Field, Lamp

BLUR = 0.5  # pixels: standard deviation of optics and demosaicing
REACH = 4.0  # standard deviations to each side that a glint is spread over, and half a pixel
CLEAR = 0.005  # metres above the cornea at which rays start: the fitted surface is that far off between the lids
AROUND = 0.0015  # metres: texels around a reflection
LEAST = 1e-3  # share of the light below which there is no glint


def glints(field: Field, camera: PinholeCamera, lamp: Lamp) -> F32:
    """(H, W, 3) radiance of a lamp's reflections in the corneas of a field."""
    out = np.zeros((camera.height, camera.width, 3))
    place, strength = lamp.position[None], lamp.strength[None]
    for cornea, texels in field.mirrors:
        x, n = reflected(cornea.centre, cornea.radius, camera.eye, place)
        share = float(cornea.share(n)[0])
        if share < LEAST or not unblocked(field.whole, x, n, camera.eye)[0]:
            continue
        share *= float(arriving_at(texels, lamp, x)[0])
        if share < LEAST:
            continue
        total = share * intensity(cornea.radius, cornea.f0, x, place, strength)[0] * summed(camera, x)[0]
        uv, depth = project(camera.K, inverse_rigid(camera.world_from_cam), camera.distortion, x)
        width = cornea.radius * lamp.spread / 2 * camera.K[0, 0] / depth[0]
        _spread(out, uv[0], total, float(np.hypot(BLUR, width)))
    return out.astype(np.float32)


def unblocked(caster: RayCaster, x: F64, n: F64, eye: F64) -> np.ndarray:
    """(N,) whether no part of the head is between x (N, 3), on a sphere with normals n (N, 3), and an eye (3,)."""
    start = x + CLEAR * n
    return np.asarray(caster.first_faces(start, unit(eye - start)) < 0)


def arriving_at(texels: Field, lamp: Lamp, x: F64) -> F64:
    """(N,) share of a lamp's light that arrives around x (N, 3), by texels near there: their mean within AROUND, the
    nearest one without any."""
    if not len(texels.known):
        return np.zeros(len(x))
    found = texels.arrives(lamp).astype(np.float64)
    away = np.linalg.norm(texels.points.position[None] - x[:, None], axis=2)
    near = (away < AROUND).astype(np.float64)
    alone = near.sum(1) == 0
    near[alone, away[alone].argmin(1)] = 1
    return np.asarray(near @ found / near.sum(1))


def _spread(out: F64, place: F64, value: F64, width: float) -> None:
    """Add value (3,) around a place (x, y; the first pixel's corner is 0) of a picture (H, W, 3), by a Gaussian of this
    standard deviation in pixels."""
    if not np.isfinite(place).all():
        return
    reach, parts, spans = int(np.ceil(REACH * width + 0.5)), [], []
    for centre, size in ((place[1], out.shape[0]), (place[0], out.shape[1])):
        middle = int(np.floor(np.clip(centre, -reach - 1, size + reach + 1)))
        first, last = max(middle - reach, 0), min(middle + reach + 1, size)
        if first >= last:
            return
        parts.append(np.diff(erf((np.arange(first, last + 1) - centre) / (np.sqrt(2) * width))) / 2)
        spans.append(slice(first, last))
    out[spans[0], spans[1]] += parts[0][:, None, None] * parts[1][:, None] * value

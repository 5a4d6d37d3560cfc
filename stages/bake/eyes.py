"""Colours of the fitted eyes: what the photos show between the lids, completed where they show nothing.

Symbols: I radiance that the photos show (a low quantile, without the lamps' reflections), G what the wet surface
reflects of the captured light towards a photo (pipeline/eyes/material.py), S radiance of a surface of albedo 1 there
(stages/bake/detail.py); a = (I - G) / S, at least LEAST of I / S. Renderers of the asset add G again. What no photo
shows of the iris takes the median of its ring around the gaze; the sclera behind the lids that of the sclera that is
seen. Seen and completed fade over FADE.

Standard shaders get a / S' of the traced light S' instead (standard_fit.py). Behind the lids S' is about 0, but no
photo shows that a ratio is needed there: the usual one of the eye is taken, and what opens later has its colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from pipeline.artifacts import Located
from pipeline.eyes.ball import Eye
from pipeline.eyes.iris import angle_from
from pipeline.eyes.material import F0, ROUGHNESS
from pipeline.eyes.picture import REACH, Sights, directions_at, looked_up, places_of, plane, sights
from pipeline.fields.protocol import Field
from pipeline.head_artifacts import FittedEye, RegisteredHead
from pipeline.lighting.moving import Standpoint
from pipeline.maths import brdf
from pipeline.meshes import F32, F64, Indices, Mask, Mesh
from pipeline.registration.head import load_head, of_triangles
from pipeline.smoothing import continued
from pipeline.transforms import matrix
from pipeline.visibility import FittedPhoto, Occluder
from stages.bake.detail import lit_at_least, shade

SIDE = 256  # pixels of an eye's picture: 0.12 mm
FADE = 0.0008  # metres
LIMBUS = 1.1  # angles of the iris from which on the ball is sclera
RINGS = 24  # of the iris
LEAST = 0.2
OPEN = 0.5  # ambient occlusion from which on a point of an eye is not behind a lid
RIM = 0.001  # metres over which the correction becomes the eye's usual one
WIDTH, ATTENUATION = ROUGHNESS**4 / 2, "exponential"  # 1 / kappa of a lobe of alpha = ROUGHNESS^2: nearly a mirror
PLAIN = (0.62, 0.56, 0.52)  # albedo of a sclera that no photo shows


@dataclass(frozen=True, slots=True)
class Eyes:
    """of_vertex (V,): number of the eye of each vertex of the mesh, -1 for none. eyes, albedo: each eye and the picture
    (SIDE, SIDE, 3) of its albedo."""

    of_vertex: Indices
    eyes: tuple[Eye, ...]
    albedo: tuple[F32, ...]

    def at(self, vertex: Indices, points: F64) -> tuple[Indices, F32]:
        """Of points (N, 3) on triangles with a vertex (N,): the rows (n,) on an eye, and their albedo (n, 3)."""
        which = self.of_vertex[vertex]
        rows = np.flatnonzero(which >= 0)
        out = np.zeros((len(rows), 3), np.float32)
        for i, (eye, image) in enumerate(zip(self.eyes, self.albedo, strict=True)):
            own = which[rows] == i
            out[own] = looked_up(image, places_of(eye.local(points[rows[own]])))
        return rows, out


def usual_behind_lids(eyes: Eyes, mesh: Mesh, correction: F64, shown: Mask) -> F32:
    """(V, 3) the correction (V, 3) of the albedo for standard shaders, with the median of an eye's shown vertices (V,)
    where it is not shown. An eye that is nowhere shown has a correction of 1."""
    out = correction.copy()
    for i in range(len(eyes.eyes)):
        own = eyes.of_vertex == i
        some = np.flatnonzero(own)
        row = np.cumsum(own) - 1
        faces = row[mesh.faces[own[mesh.faces].all(1)]]
        usual = np.median(out[some][shown[some]], axis=0) if shown[some].any() else np.ones(3)
        if not shown[some].any() or not len(faces):
            out[some] = usual
            continue
        ball = Mesh(mesh.vertices[some], mesh.normals[some], faces.astype(mesh.faces.dtype))
        out[some] = continued(ball, out[some], shown[some], np.broadcast_to(usual, (len(some), 3)), RIM)
    return np.asarray(out, np.float32)


def eye_of(stored: FittedEye) -> Eye:
    """The eye of an artifact."""
    return Eye(np.array(stored.centre), stored.radius, np.array(stored.axes), stored.iris)


def painted_eyes(
    registered: Located[RegisteredHead], field: Field, mesh: Mesh, views: Sequence[FittedPhoto], responses: F64
) -> Eyes | None:
    """The fitted eyes of the textured mesh, which begins with the head's quads; None without any. responses (views, 3,
    3): e_n A_n of each photo."""
    stored, ref = registered.artifact.eyes, registered.artifact.head
    if not stored or ref is None:
        return None
    names = registered.artifact.parts
    head = load_head(registered.path(ref))
    part = of_triangles(head, head.part, registered.artifact.regions)
    of_vertex = np.full(len(mesh.vertices), -1, np.int64)
    for i, one in enumerate(stored):
        of_vertex[np.unique(mesh.faces[: len(part)][part == names.index(one.part)])] = i
    lids = mesh.faces[(of_vertex[mesh.faces] < 0).all(1)]
    occluder = Occluder(Mesh(mesh.vertices, mesh.normals, lids))
    eyes = tuple(eye_of(one) for one in stored)
    seen = (sights(eye, views, occluder, SIDE) for eye in eyes)
    pictures = tuple(painted(eye, s, field, responses, views) for eye, s in zip(eyes, seen, strict=True))
    return Eyes(of_vertex, eyes, pictures)


def painted(eye: Eye, seen: Sights, field: Field, responses: F64, views: Sequence[FittedPhoto]) -> F32:
    """(SIDE, SIDE, 3) albedo of an eye. views: the photos."""
    side, moving = seen.side, field.moving_light
    directions = directions_at(plane(side).reshape(-1, 2))
    x, n = eye.points(directions).astype(np.float32), (directions @ eye.axes).astype(np.float32)
    ratio = np.asarray(field.irradiance_ratio(x), np.float32)
    lit = shade(field.light, n, ratio)
    plain = np.empty_like(seen.colour)
    for i, view in enumerate(seen.views):
        plain[i] = seen.colour[i] @ np.linalg.inv(responses[view]).T.astype(np.float32)
        station = Standpoint.of(matrix(views[view].camera.world_from_cam))
        wet = reflected(field, x, n, station) * ratio
        plain[i] = np.maximum(plain[i] - wet, LEAST * plain[i])
        if moving is not None:
            plain[i] *= lit / lit_at_least(moving.irradiance(x, n, station), field.light)
    shown, weight = Sights(plain, seen.weight, seen.pixels, seen.views, side).combined()
    return completed(shown / lit.reshape(side, side, 3), weight > 0, eye)


def reflected(field: Field, x: F32, n: F32, eye: Standpoint) -> F32:
    """(N, 3) radiance that the wet surface at x with unit normals n (N, 3) reflects towards a camera: Schlick's share
    of the captured light in the mirror direction, as the exported material does."""
    away = (eye.centre - x).astype(np.float32)
    wo = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    share = F0 + (1 - F0) * (1 - (wo * n).sum(1, keepdims=True).clip(0, 1)) ** 5
    width = np.full(len(x), WIDTH, np.float32)
    if field.moving_light is not None:
        light = field.moving_light.reflected(x, n, width, eye, ATTENUATION)
    else:
        mirror = brdf.reflect(torch.from_numpy(wo), torch.from_numpy(np.ascontiguousarray(n, np.float32)))
        of_sky = torch.from_numpy(np.asarray(field.light, np.float32))
        light = brdf.light_integral(mirror, torch.from_numpy(width), of_sky, ATTENUATION).numpy()
    return np.asarray(share * light, np.float32)


def completed(albedo: F32, seen: Mask, eye: Eye) -> F32:
    """(side, side, 3) the albedo of an eye where it is seen (side, side), continued where it is not."""
    side = len(albedo)
    angle = angle_from(np.array([0.0, 0.0, 1.0]), side)
    limbus = float(np.arcsin(eye.iris / eye.radius))
    white = seen & (angle > LIMBUS * limbus)
    sclera = np.median(albedo[white], axis=0) if white.any() else np.array(PLAIN)
    around = np.tile(np.asarray(sclera, np.float32), (side, side, 1))
    ring = np.minimum((angle / limbus * RINGS).astype(np.int64), RINGS)
    known = np.full((RINGS + 1, 3), np.nan)
    for r in range(RINGS):
        own = seen & (ring == r)
        if own.any():
            known[r] = np.median(albedo[own], axis=0)
    known[RINGS] = sclera
    at = np.flatnonzero(np.isfinite(known[:, 0]))
    profile = np.stack([np.interp(np.arange(RINGS + 1), at, known[at, c]) for c in range(3)], 1)
    inside = ring < RINGS
    around[inside] = profile[ring[inside]]
    pixel = 2 * REACH / side * eye.radius
    away = cv2.distanceTransform(seen.astype(np.uint8), cv2.DIST_L2, 5) * pixel
    share = np.clip(away / FADE, 0, 1)[..., None]
    return np.asarray(around + share * (np.where(seen[..., None], albedo, 0) - around), np.float32).clip(0, 1)

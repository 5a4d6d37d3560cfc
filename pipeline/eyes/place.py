"""Fitted eyes in the registered head: the template's eye as a ball with a cornea, and lids that end inside of it.

The control cage of an eye keeps the template's shape, turned along the gaze and scaled so that its limit surface has
the ball's radius on average; the displacement makes it the ball with its cornea. The lids' inner edges that are sunk
into the template's own eye are sunk into the fitted one, so that no slit opens.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.eyes.ball import CORNEA, IRIS, Eye, cornea_height
from pipeline.meshes import F64, Indices, Mask
from pipeline.registration.followers import room
from pipeline.registration.head import limit_surface
from pipeline.registration.subdivision import Level, subdivided
from pipeline.template.model import SKIN, Template

SUNK = 0.97  # of the radius: where the lids' inner edges end
BEYOND = 1.25  # of the radius: what lies further out is not the lids' inner edge
LIFTED = 0.9  # of the room between lids and ball: what a cornea may take


def with_eyes(template: Template, rest: F64, vertices: F64, eyes: Mapping[str, Eye]) -> F64:
    """(V, 3) vertices with the fitted eyes, by part. rest (V, 3): the identity's vertices, in the world; vertices: the
    registered head's."""
    out = vertices.copy()
    skin = template.part_vertices(SKIN)
    for part, eye in eyes.items():
        own = template.part_vertices(part)
        out[own] = eye.centre + _shape(template, part) * eye.radius @ eye.axes
        out[skin] = _sunk(out[skin], room(rest[own], rest[skin]) < 1, eye)
    return out


def _shape(template: Template, part: str) -> F64:
    """(n, 3) the cage of an eye about its middle, of radius 1."""
    own = template.part_vertices(part)
    x = template.vertices[own]
    middle = 0.5 * (x.min(0) + x.max(0))
    quads = np.searchsorted(own, template.quads[template.parts[part]])
    points, _, _ = limit_surface(x - middle, subdivided(quads, len(own), 1))
    return np.asarray((x - middle) / np.linalg.norm(points, axis=1).mean())


def _sunk(skin: F64, hidden: Mask, eye: Eye) -> F64:
    """(M, 3) the skin, with the places that are hidden (M,) in the template's eye inside of this one."""
    away = skin - eye.centre
    far = np.linalg.norm(away, axis=1) / eye.radius
    out_ = hidden & (far > SUNK) & (far < BEYOND)
    scale = np.where(out_, SUNK / np.maximum(far, 1e-30), 1.0)
    return np.asarray(eye.centre + away * scale[:, None])


def eye_displacement(points: F64, normals: F64, own: Indices, lids: F64, eye: Eye, unit: float) -> F64:
    """(n,) metres along the limit normals that put an eye's limit points on the ball with its cornea. points, normals
    (N, 3): of the whole head; own (n,): the eye's rows; lids (M, 3): places of the skin, which the cornea does not
    reach. unit: world units of one metre."""
    away = points[own] - eye.centre
    length = np.linalg.norm(away, axis=1)
    toward = away / length[:, None]
    height = _cornea(toward, eye) * _share_free(lids, eye, unit)
    slope = np.maximum((toward * normals[own]).sum(1), 0.5)
    return np.asarray((eye.radius + height - length) / slope)


def _cornea(toward: F64, eye: Eye) -> F64:
    angle = np.arccos(np.clip(toward @ eye.axes[2], -1, 1))
    return cornea_height(angle, eye.radius, eye.iris, CORNEA / IRIS * eye.iris)


def _share_free(lids: F64, eye: Eye, unit: float) -> float:
    """How much of the cornea's height there is room for, 0 to 1."""
    away = lids - eye.centre
    length = np.linalg.norm(away, axis=1)
    near = (length > eye.radius) & (length < 1.5 * eye.radius)
    height = _cornea(away[near] / length[near, None], eye)
    over = height > 1e-5 * unit
    if not over.any():
        return 1.0
    return float(np.clip((LIFTED * (length[near][over] - eye.radius) / height[over]).min(), 0, 1))


def eye_rows(level: Level, quads: Indices, levels: int) -> Indices:
    """(n,) vertices of the subdivided cage that belong to quads of the cage."""
    fine = (quads[:, None] * 4**levels + np.arange(4**levels)).ravel()
    return np.asarray(np.unique(level.quads[fine]), np.int64)
